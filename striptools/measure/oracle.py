"""The oracle: every triangle of the SOURCE mesh against every ray, in float64 NumPy.

It shares nothing with the tracer: no hierarchy, no strips, no XLA, no float32 arithmetic. A ray is the
float32 ray that the tracer gets, taken to float64 without a rounding. For each ray it tells the exact closest
hit and every face that a float32 tracer might report, judged by `bound`.

How every triangle is considered in a fraction of a millisecond a ray: the ray is the point 0 of a sheared
plane (see `bound`), a vertex gets four bits (left of, right of, below, above that point by more than the
largest slack of any face), and a triangle whose corners share a bit cannot hold the point. Sixteen rays share
one 64-bit word a vertex, so one gather of the three corners tests sixteen rays; the few survivors are judged
exactly. Cost: O(faces) a ray. `tests/test_oracle.py` holds this equal to a loop over all pairs.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from striptools.measure.bound import BEYOND_FACE, Pairs, RayFrames, frame_rays, judge_pairs, lateral_slack
from striptools.mesh.mesh import Mesh
from striptools.types import TriangleTest

RAYS_A_WORD = 16
VERTICES_A_CHUNK = 4096
PAIRS_A_CHUNK = 1 << 18


@dataclass(frozen=True)
class Candidates:
    """Every face that a float32 tracer may report, sorted by ray, then t, then face.

    Attributes:
        ray: (k,) intp.
        face: (k,) int32, of the source mesh.
        pairs: What `bound.judge_pairs` says of each, in the same order.
    """

    ray: np.ndarray
    face: np.ndarray
    pairs: Pairs


@dataclass(frozen=True)
class OracleHits:
    """The exact closest hits and the candidates around them.

    Attributes:
        t: (r,) float64, infinite on a miss; in units of the direction's length.
        face: (r,) int32, the source's, least among those of equal t; -1 on a miss.
        u: (r,) float64, the weight of the face's second corner.
        v: (r,) float64, the weight of the face's third corner.
        candidates: See `Candidates`.
    """

    t: np.ndarray
    face: np.ndarray
    u: np.ndarray
    v: np.ndarray
    candidates: Candidates


def source_corners(mesh: Mesh) -> np.ndarray:
    """(v, 3) float64: the positions as a scene holds them, that is rounded to float32."""
    with np.errstate(over="ignore"):
        return np.asarray(mesh.positions).astype(np.float32).astype(np.float64)


class Oracle:
    """Closest hits of rays with a mesh by brute force.

    Args:
        mesh: The source mesh. Positions are rounded to float32, as the scene's are; faces with a non-finite
            corner are left out, faces without area are never hit.
        error_bound: How far the vertices of the traced scene may lie off the source's, in the model's unit:
            it widens what counts as possible and narrows what counts as certain.
        test: What triangles are tested by; so does it. The exact hits are the same.
    """

    def __init__(self, mesh: Mesh, error_bound: float = 0.0, test: TriangleTest = "watertight") -> None:
        self.error_bound = float(error_bound)
        self.test: TriangleTest = test
        self.positions = source_corners(mesh)
        finite = np.all(np.isfinite(self.positions), axis=1)
        self._finite_face = np.flatnonzero(np.all(finite[mesh.faces], axis=1)).astype(np.int32)
        self.faces = np.asarray(mesh.faces)
        kept = self.faces[self._finite_face]
        used = np.zeros(len(self.positions), bool)
        used[kept] = True
        number = np.cumsum(used) - 1
        self._corner = np.ascontiguousarray(number[kept].T.astype(np.intp))
        points = self.positions[used]
        self._low = points.min(axis=0) if len(points) else np.zeros(3)
        self._high = points.max(axis=0) if len(points) else np.zeros(3)
        self._centre = (self._low + self._high) / 2
        self._points = points - self._centre
        self.bounds = np.stack([self._low, self._high])
        self.diagonal = float(np.linalg.norm(self._high - self._low))

    def closest_hit(
        self, origins: np.ndarray, directions: np.ndarray, step: Callable[[int], None] | None = None
    ) -> OracleHits:
        """Exact closest hits, 0 < t, of float32 rays.

        Args:
            origins: (r, 3) float32.
            directions: (r, 3) float32, of any length.
            step: Called with the number of rays done since its last call.
        """
        frames = frame_rays(origins, directions)
        count = len(frames.depth)
        found = []
        for first in range(0, count, RAYS_A_WORD):
            rays = np.arange(first, min(first + RAYS_A_WORD, count))
            found += [self._judge(frames, ray, face) for ray, face in self._survivors(frames, rays)]
            if step is not None:
                step(len(rays))
        return _gather_hits(count, found)

    def judge(self, frames: RayFrames, ray: np.ndarray, face: np.ndarray) -> Pairs:
        """What pairs of a ray and a face of the source say; (k,) and (k,)."""
        return judge_pairs(frames, ray, self.positions[self.faces[face]], self.error_bound, self.test)

    def _judge(self, frames: RayFrames, ray: np.ndarray, face: np.ndarray) -> Candidates:
        pairs = self.judge(frames, ray, face)
        keep = np.flatnonzero(pairs.possible | pairs.inside)
        return Candidates(ray[keep], face[keep], take_pairs(pairs, keep))

    def _survivors(self, frames: RayFrames, rays: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Pairs of a ray and a face that the corners' bits do not rule out, a bounded chunk at a time."""
        face, lane = _unruled(self._vertex_codes(frames, rays), self._corner, len(rays))
        ray = rays[lane]
        for start in range(0, len(ray), PAIRS_A_CHUNK):
            part = slice(start, start + PAIRS_A_CHUNK)
            yield ray[part], self._finite_face[face[part]]

    def _vertex_codes(self, frames: RayFrames, rays: np.ndarray) -> np.ndarray:
        """(vertices,) uint64: bit 16 g + i says it is beyond ray i to the left, right, below, above (g)."""
        rays = np.resize(rays, RAYS_A_WORD)
        across = _projections(frames, rays)
        origins = frames.origins[rays]
        at = np.einsum("ri,sir->sr", origins - self._centre, across)
        reach = np.abs(np.stack([self._low, self._high]) - origins[:, None]).max(axis=(1, 2))
        slack = (BEYOND_FACE + 1) * lateral_slack(reach, self.error_bound)
        low, high = (np.tile(limit[:, None], (1, VERTICES_A_CHUNK, 1)) for limit in (at - slack, at + slack))
        codes = np.zeros((len(self._points), 4), "<u2")
        for first in range(0, len(codes), VERTICES_A_CHUNK):
            points = self._points[first : first + VERTICES_A_CHUNK]
            rows = slice(first, first + len(points))
            for side in range(2):
                place = points @ across[side]
                codes[rows, 2 * side] = _pack_lanes(place < low[side, : len(points)])
                codes[rows, 2 * side + 1] = _pack_lanes(place > high[side, : len(points)])
        return codes.view("<u8").reshape(-1)


def _pack_lanes(flags: np.ndarray) -> np.ndarray:
    """(k, 16) bool to (k,) uint16, lane i in bit i."""
    return np.packbits(flags.reshape(-1), bitorder="little").view("<u2")


def _projections(frames: RayFrames, rays: np.ndarray) -> np.ndarray:
    """(2, 3, k): matrices that take points to the sheared x, and to the sheared y, of each of the rays."""
    lane = np.arange(len(rays))
    axes = frames.axes[rays]
    across = np.zeros((2, 3, len(rays)))
    for side in range(2):
        across[side, axes[:, side], lane] = 1.0
        across[side, axes[:, 2], lane] = -frames.shear[rays, side]
    return across


def _unruled(codes: np.ndarray, corner: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Faces and lanes (rays of the word) whose three corners are not all beyond one side."""
    beyond = np.take(codes, corner[0])
    beyond &= np.take(codes, corner[1])
    beyond &= np.take(codes, corner[2])
    beyond |= beyond >> np.uint64(32)
    beyond |= beyond >> np.uint64(16)
    lanes = np.uint64((1 << count) - 1)
    near = np.flatnonzero((beyond & lanes) != lanes)
    missed = beyond[near, None] >> np.arange(count, dtype=np.uint64) & np.uint64(1)
    row, lane = np.nonzero(missed == 0)
    return near[row], lane


def take_pairs(pairs: Pairs, index: np.ndarray) -> Pairs:
    """The pairs of an index array, in its order."""
    return Pairs(**{name: value[index] for name, value in vars(pairs).items()})


def _gather_hits(ray_count: int, found: list[Candidates]) -> OracleHits:
    """Sort the candidates by ray, t and face, and take each ray's first exact hit."""
    if not found:
        none = np.zeros(0, np.intp)
        nothing = judge_pairs(frame_rays(np.zeros((0, 3)), np.zeros((0, 3))), none, np.zeros((0, 3, 3)))
        found = [Candidates(none, none.astype(np.int32), nothing)]
    ray = np.concatenate([part.ray for part in found])
    face = np.concatenate([part.face for part in found])
    pairs = Pairs(
        **{k: np.concatenate([vars(part.pairs)[k] for part in found]) for k in vars(found[0].pairs)}
    )
    order = np.lexsort((face, pairs.t, ray))
    ray, face, pairs = ray[order], face[order], take_pairs(pairs, order)
    exact = np.flatnonzero(pairs.inside)
    hit_ray, first = np.unique(ray[exact], return_index=True)
    chosen = exact[first]
    t, hit_face = np.full(ray_count, np.inf), np.full(ray_count, -1, np.int32)
    u, v = np.zeros(ray_count), np.zeros(ray_count)
    t[hit_ray], hit_face[hit_ray] = pairs.t[chosen], face[chosen]
    u[hit_ray], v[hit_ray] = pairs.u[chosen], pairs.v[chosen]
    return OracleHits(t, hit_face, u, v, Candidates(ray, face, pairs))
