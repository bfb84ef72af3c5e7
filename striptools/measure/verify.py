"""Prove a scene against its source: the same faces, and rays that hit what the source says they must.

Source of the rules: `judgement`; of the bound: `bound`; of what is certain at edges and vertices: `aimed`; of
the structural
check: `structure`. Cost: rays x faces pairs for the rays that every face is tried for (about 0.3 ms a ray and
100,000 faces), microseconds for each further aimed ray.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any, Protocol

import numpy as np

from striptools.errors import UsageError
from striptools.measure.aimed import Surface
from striptools.measure.judgement import Judge, SetResult
from striptools.measure.oracle import Oracle, OracleHits
from striptools.measure.ray_sets import RaySet, aimed_sets, camera_set, inside_sets, secondary_set
from striptools.measure.strays import Strays, is_simplified, own_source, strays_of
from striptools.measure.structure import Structure, compare_structure, rounded_positions
from striptools.mesh.clean import clean
from striptools.mesh.mesh import Mesh
from striptools.reducem.placed import Placed
from striptools.reducem.scene import Scene
from striptools.stopwatch import Watch
from striptools.trace.hit import Hits
from striptools.types import TriangleTest


class Traces(Protocol):
    """What verify needs of a tracer."""

    def closest_hit(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """The closest hits of rays; see `striptools.trace.Tracer`."""
        ...


@dataclass(frozen=True)
class VerifyOptions:
    """How much is traced.

    Args:
        rays: Rays of each kind (camera, secondary, at edges, at vertices) that every face of the source is
            tried for.
        aimed_rays: Rays in all aimed at edges and vertices; those beyond `rays` are judged by the faces at
            their target. A closed mesh gets a quarter more from inside.
        pair_budget: The most pairs of a ray and a face to try; on a large model fewer rays are drawn to keep
            to it.
        seed: Of the random choices.

    Raises:
        UsageError: A number is negative, or the budget not positive.
    """

    rays: int = 1024
    aimed_rays: int = 65536
    pair_budget: int = 1 << 30
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.rays, self.aimed_rays, self.seed) < 0 or self.pair_budget < 1:
            raise UsageError(f"cannot verify with {self}", remedy="numbers of rays of 0 or more are wanted")


DEFAULT_OPTIONS = VerifyOptions()


@dataclass(frozen=True)
class VerifyReport:
    """What verifying found.

    Attributes:
        sets: A result for each kind of rays.
        structure: How the scene's faces compare with the source's.
        rays_wanted: Rays of each kind that were asked to be tried against every face.
        rays_tried: Rays of each kind that were: fewer where the model is too large for the budget.
        error_bound: The scene's.
        closed: Whether every edge of the scene's surface has exactly two faces in opposite directions.
        open_edges: Edges that have not: nothing is certain there.
        strays: How far the scene is from its source, where it was simplified; all else is then judged by the
            scene's own triangles. Else None.
    """

    sets: tuple[SetResult, ...]
    structure: Structure
    rays_wanted: int
    rays_tried: int
    error_bound: float
    closed: bool
    open_edges: int
    strays: Strays | None = None

    @property
    def rays(self) -> int:
        """Rays traced, each judged once."""
        return sum(part.rays for part in self.sets)

    @property
    def disagreements(self) -> int:
        """Rays with a wrong answer, leaks apart."""
        return sum(part.disagreements for part in self.sets)

    @property
    def leaks(self) -> int:
        """Rays that slipped through where a hit was certain."""
        return sum(part.leaks for part in self.sets)

    @property
    def uncertain(self) -> int:
        """Rays about which float32 leaves a choice."""
        return sum(part.uncertain for part in self.sets)

    @property
    def uncertain_differences(self) -> int:
        """Uncertain rays that every face was tried for and whose answer is not the exact one."""
        return sum(part.uncertain_differences or 0 for part in self.sets)

    @property
    def aimed_rays(self) -> int:
        """Rays aimed at edges and vertices."""
        return sum(part.rays for part in self.sets if _is_aimed(part))

    @property
    def aimed_certain(self) -> int:
        """Aimed rays for which a hit is certain."""
        return sum(part.certain for part in self.sets if _is_aimed(part))

    @property
    def max_t_error(self) -> float:
        """The largest |t - t of the reported face|."""
        return max((part.max_t_error for part in self.sets), default=0.0)

    @property
    def max_t_ratio(self) -> float:
        """The largest such error in parts of its bound."""
        return max((part.max_t_ratio for part in self.sets), default=0.0)

    @property
    def max_uv_error(self) -> float:
        """The largest distance between a ray and the point its u and v mean, in the model's unit."""
        return max((part.max_uv_error for part in self.sets), default=0.0)

    @property
    def flaws(self) -> tuple[str, ...]:
        """The first few flaws of each set in words."""
        return tuple(flaw for part in self.sets for flaw in part.flaws)

    @property
    def ok(self) -> bool:
        """Whether nothing is wrong: no disagreement, no leak, every face there, no farther than declared."""
        near = self.strays is None or self.strays.ok
        return near and self.disagreements == 0 and self.leaks == 0 and self.structure.errors == 0

    def to_dict(self) -> dict[str, Any]:
        """Everything as plain values for JSON: totals, `structure`, and `sets` row by row."""
        totals = (
            "ok",
            "rays",
            "disagreements",
            "leaks",
            "max_t_error",
            "max_t_ratio",
            "max_uv_error",
            "uncertain",
            "uncertain_differences",
            "aimed_rays",
            "aimed_certain",
            "rays_wanted",
            "rays_tried",
            "error_bound",
            "closed",
            "open_edges",
        )
        found: dict[str, Any] = {name: getattr(self, name) for name in totals}
        found["structure"] = {**asdict(self.structure), "errors": self.structure.errors}
        found["strays"] = None if self.strays is None else {**asdict(self.strays), "ok": self.strays.ok}
        found["sets"] = [{**asdict(part), "flaws": list(part.flaws)} for part in self.sets]
        return found


def _is_aimed(part: SetResult) -> bool:
    return part.name not in ("camera", "secondary")


def verify(
    scene: Scene,
    source: Mesh,
    options: VerifyOptions = DEFAULT_OPTIONS,
    *,
    tracer: Traces | None = None,
    watch: Watch | None = None,
    test: TriangleTest = "watertight",
) -> VerifyReport:
    """Trace a scene and prove the answers against its source.

    Args:
        scene: The scene.
        source: The mesh it was made from, as loaded: not cleaned. For a scene with instances also with
            them; flattened, its faces that vanish where an instance stands are taken for missing. For a
            simplified scene the mesh before: the surfaces are then compared (`strays`), and rays judged by
            the scene's own triangles.
        options: How much is traced.
        tracer: What traces the scene; a `striptools.trace.Tracer` of it when None.
        watch: Called with "structure" or "rays" and the fraction done.
        test: What `tracer` tests triangles by: each has a bound of its own. `fast` leaks.

    Raises:
        UsageError: The source has another number of faces than the one that the scene was made from.
    """
    if is_simplified(scene, source):
        strays = strays_of(scene, source)
        return replace(verify(*own_source(scene), options, tracer=tracer, watch=watch), strays=strays)
    placed = scene.placed()
    source, kept = _where_it_stands(scene, placed, source)
    if scene.origin is not None:
        # Rays and answers are in the frame about the origin; so is the source from here on.
        source = replace(source, positions=source.positions - scene.origin)
    tell = watch or (lambda stage, fraction: None)
    tell("structure", 0.0)
    structure = compare_structure(placed, source, kept)
    oracle = Oracle(source, placed.error_bound, test)
    surface_face = traced_faces(placed, source, kept)
    surface = Surface(rounded_positions(source), source.faces[surface_face])
    tell("structure", 1.0)
    if tracer is None:
        from striptools.trace import Tracer

        tracer = Tracer(scene, instances="flattened", test=test)
    judge = Judge(oracle, surface, surface_face, placed)
    tried = min(options.rays, options.pair_budget // (4 * max(1, source.triangle_count)))
    runner = _Runner(judge, tracer, tell, 4 * tried)
    sets = _run_sets(runner, options, tried)
    return VerifyReport(
        tuple(sets), structure, options.rays, tried, placed.error_bound, surface.closed, surface.open_edges
    )


def _where_it_stands(scene: Scene, placed: Scene | Placed, source: Mesh) -> tuple[Mesh, np.ndarray]:
    """The source with its instances in their places, and the faces there that cleaning keeps, (k,) int32.

    What a scene with instances has cleaned, and rounded to float32, are the geometries before they stand.
    """
    apart = scene.instances is not None and source.instances is not None
    source = source if apart else source.flattened()
    expected = scene.source_face_count if apart else placed.source_face_count
    more = placed is not scene and not apart and source.triangle_count > expected
    fits = source.triangle_count == expected or more
    if scene.remap is not None and not fits:
        raise UsageError(
            f"the source has {source.triangle_count} faces, the scene's had {expected}",
            remedy="give the file that was converted",
        )
    kept = clean(source).source_face
    if not apart or source.instances is None or source.geometries is None:
        return source, kept
    is_kept = np.zeros(source.triangle_count, np.bool_)
    is_kept[kept] = True
    there = [is_kept[source.geometries.faces(geometry)] for geometry, _ in source.instances]
    flat = replace(source, positions=rounded_positions(source)).flattened()
    return flat, np.flatnonzero(np.concatenate(there)).astype(np.int32)


def traced_faces(scene: Scene | Placed, source: Mesh, kept: np.ndarray) -> np.ndarray:
    """The source faces that the scene holds; all that cleaning keeps where it does not say."""
    if scene.remap is None:
        return kept
    there = np.zeros(source.triangle_count, bool)
    face = scene.remap.face
    there[face[(face >= 0) & (face < source.triangle_count)]] = True
    return np.flatnonzero(there).astype(np.int32)


class _Runner:
    """Traces and judges ray sets and tells how far it is."""

    def __init__(self, judge: Judge, tracer: Traces, tell: Watch, expected: int) -> None:
        self.judge, self.tracer, self.tell = judge, tracer, tell
        self._expected, self._done = max(1, expected), 0

    def exact(self, rays: RaySet) -> OracleHits:
        return self.judge.oracle.closest_hit(rays.origins, rays.directions, self._step)

    def run(self, rays: RaySet, exact: OracleHits | None) -> SetResult:
        return self.judge.judge(rays, self.tracer.closest_hit(rays.origins, rays.directions), exact)

    def _step(self, rays: int) -> None:
        self._done += rays
        self.tell("rays", min(1.0, self._done / self._expected))


def _run_sets(runner: _Runner, options: VerifyOptions, tried: int) -> list[SetResult]:
    judge = runner.judge
    random = np.random.default_rng(options.seed)
    bounds = judge.oracle.bounds
    used = judge.surface.positions[judge.surface.vertices]
    camera = camera_set(used if len(used) else bounds, tried, random)
    seen = runner.exact(camera)
    results = [runner.run(camera, seen)]
    secondary = secondary_set(judge.oracle, camera, seen, tried, options.seed)
    results.append(runner.run(secondary, runner.exact(secondary)))
    for rays in aimed_sets(judge.surface, bounds, options.aimed_rays // 2, random):
        first = rays.part(0, min(tried, len(rays)), rays.name)
        rest = rays.part(len(first), len(rays), f"{rays.name}, at target")
        results += [runner.run(first, runner.exact(first)), runner.run(rest, None)]
    inside = inside_sets(judge.oracle, judge.surface, camera, seen, options.aimed_rays // 4, random)
    results += [runner.run(rays, None) for rays in inside]
    runner.tell("rays", 1.0)
    return results
