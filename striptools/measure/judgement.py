"""Judge what a tracer reports for a set of rays against the source mesh.

The rules, for a ray taken as it is in float32:

1. A reported face is one that the ray may hit (`Pairs.possible`), t lies within the ray's bound of that
   face's t, and u and v mean a point on the ray. Without a remap the scene's own triangle is what is judged
   so, and where every face of the source was tried, one of the faces that the ray may hit must have that t
   and (where nothing was moved) that normal.
2. Where a hit is certain, a hit is reported, and none farther than that one may be: for one face alone (rays
   judged by every face of the source), or for the faces round an edge or a vertex together (`aimed`). From
   inside a closed mesh there is always a hit.
3. Of faces with equal corners in equal order, which tie exactly, the least source face is reported.

A ray that breaks 2 at an edge or a vertex, or from inside, is a leak; any other break is a disagreement. A
ray is uncertain where a face that is not certain, by itself or with its neighbours, may come before the
certain hit; where it then differs from the exact answer, that is counted, and no flaw. Aimed rays are
uncertain where their fan is.
"""

from dataclasses import dataclass

import numpy as np

from striptools.measure.aimed import Surface, judge_fans
from striptools.measure.bound import Pairs, RayFrames, frame_rays, gamma, judge_pairs, shear_points
from striptools.measure.oracle import Candidates, Oracle, OracleHits
from striptools.measure.ray_sets import RaySet
from striptools.measure.structure import least_first
from striptools.mesh.clean import weld_vertices
from striptools.reducem.placed import Placed
from striptools.reducem.scene import Scene
from striptools.trace.hit import Hits

MOST_FLAWS_TOLD = 5
SAME_NORMAL = 0.999
THINNEST = 2.0**-40
"""Height over length of a face, below which float64 does not tell its normal."""


@dataclass(frozen=True)
class SetResult:
    """What became of a set of rays.

    Attributes:
        name: The set.
        rays: How many were traced.
        against_every_face: Whether each was judged by every face of the source, or by the faces at its
            target.
        hits: How many the tracer reported to hit.
        certain: Rays with nothing uncertain about them.
        uncertain: The others.
        uncertain_differences: Uncertain rays whose answer is not the exact one; None where that is not known.
        disagreements: Rays with a wrong answer, leaks apart.
        leaks: Rays that slipped through where a hit was certain.
        max_t_error: The largest |t - t of the reported face|, in t's unit.
        max_t_ratio: The largest such error in parts of its bound; near 1 only for faces seen edge-on, where t
            may lie anywhere in the face.
        max_uv_error: The largest distance between the ray and the point of u and v, in the model's unit.
        max_uv_ratio: The largest such distance in parts of its bound.
        flaws: The first few flaws in words.
    """

    name: str
    rays: int
    against_every_face: bool
    hits: int
    certain: int
    uncertain: int
    uncertain_differences: int | None
    disagreements: int
    leaks: int
    max_t_error: float
    max_t_ratio: float
    max_uv_error: float
    max_uv_ratio: float
    flaws: tuple[str, ...]


class Judge:
    """Judges the hits of one scene against its source.

    Args:
        oracle: Of the source, with the scene's error bound.
        surface: Of the source's faces that the scene holds.
        surface_face: (n,) int32, the source face of each face of `surface`.
        scene: What was traced, its instances where they stand.
    """

    def __init__(
        self, oracle: Oracle, surface: Surface, surface_face: np.ndarray, scene: Scene | Placed
    ) -> None:
        self.oracle = oracle
        self.surface = surface
        self.scene = scene
        self._row_of_face = np.full(len(oracle.faces), -1, np.int32)
        self._row_of_face[surface_face] = np.arange(len(surface_face), dtype=np.int32)
        self._first_equal = _first_equal_faces(surface, surface_face, len(oracle.faces))

    def judge(self, rays: RaySet, hits: Hits, exact: OracleHits | None) -> SetResult:
        """Judge the hits of a ray set; `exact` is the oracle's answer where every face was tried."""
        frames = frame_rays(rays.origins, rays.directions)
        reported = self._check_reported(frames, hits)
        t = hits.t.astype(np.float64)
        single, union, uncertain = self._certain_reach(rays, frames, exact)
        valid = reported.valid
        if exact is not None and self.scene.remap is None:
            valid = valid & self._matches_source(hits, exact.candidates)
        beyond = (t > single) | (t > union)
        leak = beyond & ((rays.fans is not None) | ~(t > single))
        if rays.inside:
            leak |= ~hits.hit
        wrong = ((hits.hit & ~valid) | beyond | self._ties_wrongly(hits)) & ~leak
        differ = None
        if exact is not None:
            tolerance = np.where(hits.hit, reported.t_bound, 0.0)
            with np.errstate(invalid="ignore"):
                near = (hits.hit == (exact.face >= 0)) & ~(np.abs(t - exact.t) > tolerance)
            differ = int((uncertain & ~near).sum())
        return SetResult(
            rays.name,
            len(rays),
            exact is not None,
            int(hits.hit.sum()),
            int((~uncertain).sum()),
            int(uncertain.sum()),
            differ,
            int(wrong.sum()),
            int(leak.sum()),
            *reported.extremes(hits.hit & valid),
            _tell(rays.name, hits, exact, wrong, leak),
        )

    def _check_reported(self, frames: RayFrames, hits: Hits) -> "Reported":
        """Rule 1: each reported face by itself."""
        ray = np.flatnonzero(hits.hit)
        face = hits.face[ray]
        if self.scene.remap is None:
            corners = self.scene.positions[self.scene.faces()[hits.triangle[ray]]].astype(np.float64)
            pairs = judge_pairs(frames, ray, corners, 0.0, self.oracle.test)
            known = np.ones(len(ray), bool)
        else:
            known = (face < len(self._row_of_face)) & np.isfinite(hits.t[ray])
            face = np.where(known, face, 0)
            known &= self._row_of_face[face] >= 0
            corners = self.oracle.positions[self.oracle.faces[face]]
            pairs = self.oracle.judge(frames, ray, face)
        return compare_reported(frames, ray, hits, pairs, corners, known)

    def _certain_reach(
        self, rays: RaySet, frames: RayFrames, exact: OracleHits | None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The largest t allowed by single faces and by unions, (r,) each, and which rays are uncertain."""
        count = len(rays)
        single, union = np.full(count, np.inf), np.full(count, np.inf)
        uncertain = np.zeros(count, bool)
        if rays.fans is not None:
            verdicts = judge_fans(frames, self.surface, rays.fans, self.oracle.error_bound)
            union = verdicts.farthest
            uncertain = ~verdicts.certain
        if exact is None:
            return single, union, uncertain
        candidates = exact.candidates
        certain = candidates.pairs.certain
        np.minimum.at(single, candidates.ray[certain], candidates.pairs.farthest[certain])
        held = certain.copy()
        doubtful = np.flatnonzero(~certain)
        verdict, reach = self._promote(frames, candidates, doubtful)
        held[doubtful] = verdict
        np.minimum.at(union, candidates.ray[doubtful], reach)
        nearest = candidates.pairs.t - candidates.pairs.t_bound
        loose = ~held & (nearest <= np.minimum(single, union)[candidates.ray])
        uncertain = np.bincount(candidates.ray[loose], minlength=count) > 0
        return single, union, uncertain

    def _promote(
        self, frames: RayFrames, candidates: Candidates, doubtful: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Doubtful pairs at an edge or a vertex: are the faces there certain together, and how far."""
        verdict, reach = np.zeros(len(doubtful), bool), np.full(len(doubtful), np.inf)
        row = self._row_of_face[candidates.face[doubtful]]
        near = ~candidates.pairs.clear[doubtful]
        faced = (candidates.pairs.side[doubtful] != 0) & (row >= 0)
        at_edge = np.flatnonzero(faced & (near.sum(axis=1) == 1))
        at_vertex = np.flatnonzero(faced & (near.sum(axis=1) == 2))
        # The edge opposite corner i starts at corner i + 1; two near edges meet at the third corner.
        half_edges = 3 * row[at_edge] + (np.argmax(near[at_edge], axis=1) + 1) % 3
        corner = np.argmin(near[at_vertex], axis=1)
        places = np.searchsorted(self.surface.vertices, self.surface.faces[row[at_vertex], corner])
        for index, target, fans_of in (
            (at_edge, half_edges, self.surface.edge_fans),
            (at_vertex, places, self.surface.vertex_fans),
        ):
            # All faces round a vertex ask for its fan, and hubs have a hundred thousand: judge it once a ray.
            asked = np.stack([candidates.ray[doubtful[index]], target], axis=1)
            asked, pair = np.unique(asked, axis=0, return_inverse=True)
            ray, fans, pair = asked[:, 0], fans_of(asked[:, 1]), pair.reshape(-1)
            found = judge_fans(_frames_of(frames, ray), self.surface, fans, self.oracle.error_bound)
            verdict[index], reach[index] = found.certain[pair], found.farthest[pair]
        return verdict, reach

    def _matches_source(self, hits: Hits, candidates: Candidates) -> np.ndarray:
        """Without a remap: whether a face of the source has the reported t and normal."""
        ray = candidates.ray
        t = hits.t.astype(np.float64)[ray]
        with np.errstate(invalid="ignore"):
            same = hits.hit[ray] & (np.abs(t - candidates.pairs.t) <= candidates.pairs.t_bound)
        if self.scene.error_bound == 0:
            ours = _normals(self.scene.positions[self.scene.faces()[hits.triangle[ray]]].astype(np.float64))
            theirs = _normals(self.oracle.positions[self.oracle.faces[candidates.face]])
            unclear = ~(ours.any(axis=1) & theirs.any(axis=1))
            same &= unclear | ((ours * theirs).sum(axis=1) >= SAME_NORMAL)
        return np.bincount(ray[same], minlength=len(hits.t)) > 0

    def _ties_wrongly(self, hits: Hits) -> np.ndarray:
        """Rule 3."""
        if self.scene.remap is None or len(self._first_equal) == 0:
            return np.zeros(len(hits.t), bool)
        face = np.clip(hits.face, 0, len(self._first_equal) - 1)
        return hits.hit & (self._first_equal[face] < hits.face) & (hits.face < len(self._first_equal))


@dataclass(frozen=True)
class Reported:
    """The reported hits by themselves, (r,) each; rays that miss have no error."""

    valid: np.ndarray
    t_bound: np.ndarray
    t_error: np.ndarray
    t_ratio: np.ndarray
    uv_error: np.ndarray
    uv_ratio: np.ndarray

    def extremes(self, counted: np.ndarray) -> tuple[float, float, float, float]:
        """The largest errors and ratios among the rays counted."""
        columns = (self.t_error, self.t_ratio, self.uv_error, self.uv_ratio)
        greatest = [float(column[counted].max(initial=0.0)) for column in columns]
        return greatest[0], greatest[1], greatest[2], greatest[3]


def compare_reported(
    frames: RayFrames, ray: np.ndarray, hits: Hits, pairs: Pairs, corners: np.ndarray, known: np.ndarray
) -> Reported:
    """Compare hits, of the rays (k,) `ray`, with what is said of the pairs that they report.

    Args:
        frames: Of all rays.
        ray: Which rays hit.
        hits: Of all rays.
        pairs: (k,), of each hit's ray and face.
        corners: (k, 3, 3) float64 of those faces.
        known: (k,) bool, whether the face is one that may be reported at all.
    """
    t, u, v = (column[ray].astype(np.float64) for column in (hits.t, hits.u, hits.v))
    with np.errstate(all="ignore"):
        t_error = np.abs(t - pairs.t)
        t_ratio = t_error / pairs.t_bound
        weights = np.stack([1 - u - v, u, v], axis=1)
        points = (weights[:, :, None] * corners).sum(axis=1)
        seen = shear_points(frames, ray, points[:, None])[:, 0]
        aside = np.hypot(seen[:, 0], seen[:, 1])
        along = np.abs(seen[:, 2] - t * frames.depth[ray])
        uv_ratio = np.maximum(aside / pairs.lateral, along / pairs.depth_error)
    fine = known & pairs.possible & (t > 0) & (t_ratio <= 1) & (uv_ratio <= 1)
    fine &= (u >= 0) & (v >= 0) & (u + v <= 1 + gamma(8))
    columns = (fine, pairs.t_bound, t_error, t_ratio, np.hypot(aside, along), uv_ratio)
    return Reported(*(_spread(column, ray, len(hits.t)) for column in columns))


def _spread(values: np.ndarray, ray: np.ndarray, count: int) -> np.ndarray:
    spread = np.zeros(count, values.dtype)
    spread[ray] = values
    return spread


def _frames_of(frames: RayFrames, ray: np.ndarray) -> RayFrames:
    return RayFrames(**{name: value[ray] for name, value in vars(frames).items()})


def _normals(corners: np.ndarray) -> np.ndarray:
    """Unit normals; zero for a needle so thin that rounding in float64 decides where its normal points."""
    a, b, c = corners.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    longest = np.maximum(np.linalg.norm(b - a, axis=1), np.linalg.norm(c - a, axis=1))[:, None]
    clear = length > THINNEST * longest**2
    return np.where(clear, normals, 0.0) / np.where(clear, length, 1.0)


def _first_equal_faces(surface: Surface, surface_face: np.ndarray, face_count: int) -> np.ndarray:
    """(faces,) int32: the least source face with the same corners in the same order, or the face itself."""
    first = np.arange(face_count, dtype=np.int32)
    if len(surface_face) == 0:
        return first
    order = np.argsort(surface_face, kind="stable")
    rows = least_first(surface.faces[order])
    leader, _ = weld_vertices(rows.view(np.float32))
    first[surface_face[order]] = surface_face[order][leader]
    return first


def _tell(
    name: str, hits: Hits, exact: OracleHits | None, wrong: np.ndarray, leak: np.ndarray
) -> tuple[str, ...]:
    told = []
    for ray in np.flatnonzero(wrong | leak)[:MOST_FLAWS_TOLD]:
        kind = "leak" if leak[ray] else "disagreement"
        ours = f"face {hits.face[ray]} at t {hits.t[ray]:.9g}" if hits.face[ray] >= 0 else "a miss"
        line = f"{kind}: {name} ray {ray}: {ours}"
        if exact is not None:
            theirs = f"face {exact.face[ray]} at t {exact.t[ray]:.12g}" if exact.face[ray] >= 0 else "a miss"
            line += f", the oracle says {theirs}"
        told.append(line)
    return tuple(told)
