"""What a loose octree's BVH costs to build and to trace, beside an LBVH and the binned SAH build.

Source: Gu, Jendersie, Grosch, "Fast and Dynamic Construction of Bounding Volume Hierarchies based on Loose
Octrees" (VMV 2018), whose claim is a build as fast as an LBVH's and a hierarchy that stays good where objects
are of very different size. We have its supplement alone, without tables, so this one is ours: the three
builds over the same triangles and over the same strips, walked by the same program.

1. Build seconds are processor time on one thread, of all that lies between the objects' boxes and 32-byte
   nodes; the builds take turns. Triangles and strips lie in the order of the scene file, and once more at
   random, as a mesh off the shelf may have them.
2. Expected cost is that of a tree over the objects, one a leaf, then balanced halves down to single
   triangles, by the one cost model, over that of a full binned SAH tree over the triangles.
3. Traced hierarchies have leaves as they are built to be used: up to eight triangles, or one strip.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from striptools.hierarchies.in_strip import expand_hierarchy
from striptools.hierarchies.loose_octree import (
    LooseBvh,
    build_linear_bvh,
    build_loose_octree,
    build_sah_bvh,
)
from striptools.hierarchies.options import HierarchyOptions, OverName
from striptools.hierarchies.strip_bvh import StripHierarchy
from striptools.measure.quality import full_tree_cost
from striptools.measure.study import (
    RAY_KINDS,
    KindsStudy,
    RaySet,
    StudyOptions,
    mean_counters,
    rates_and_ratios,
    rays_of_each_kind,
    tell_no_one,
    timed_in_turn,
)
from striptools.mesh.mesh import Mesh
from striptools.partition.boxes import range_boxes
from striptools.partition.sah import expected_cost
from striptools.pipeline import convert
from striptools.reducem.scene import Scene
from striptools.stopwatch import Watch
from striptools.trace import Tracer
from striptools.trace.counters import Counters
from striptools.trace.single import triangles_of_objects
from striptools.types import Boxes, Counts

__all__ = ["BUILDS", "LooseRow", "LooseStudy", "RayCost", "study", "tables"]

LOOSE, LINEAR, SAH = BUILDS = ("loose octree", "LBVH", "binned SAH")

OVERS: tuple[OverName, ...] = ("triangles", "strips")

_Build = Callable[[Boxes, int | None], LooseBvh]


@dataclass(frozen=True)
class RayCost:
    """What rays of one kind cost.

    Attributes:
        rate: Rays a second, in the fastest run; 0 where there is no ray.
        ratio: That over the rate with the SAH build over the same objects: the median of the runs' ratios.
        tests: Boxes and triangles that a ray tests, on the average.
        triangles: Of these, triangles.
    """

    rate: float
    ratio: float
    tests: float
    triangles: float


@dataclass(frozen=True)
class LooseRow:
    """One hierarchy.

    Attributes:
        build: How it was built, of `BUILDS`.
        over: What its leaves hold.
        objects: How many there are.
        seconds: Of the build, the median of the runs.
        shuffled_seconds: The same with the objects in random order.
        lead: Seconds of the SAH build over these: the median of the runs' ratios.
        node_bytes: Bytes of its nodes.
        relative_cost: Expected cost over that of a full binned SAH tree over the triangles.
        rays: What rays cost, by `RAY_KINDS`.
    """

    build: str
    over: OverName
    objects: int
    seconds: float
    shuffled_seconds: float
    lead: float
    node_bytes: int
    relative_cost: float
    rays: tuple[RayCost, ...]


LooseStudy = KindsStudy[LooseRow]
"""What the study found: for triangles, then for strips, a row of each build."""


def study(mesh: Mesh, options: StudyOptions | None = None, *, watch: Watch | None = None) -> LooseStudy:
    """Compare the three builds on one model.

    Args:
        mesh: The model.
        options: Of the study; the defaults of StudyOptions when left out.
        watch: Called with a stage's name (`convert`, `build`, `compile`, `trace`) and the fraction done.

    Raises:
        UnreadableMeshError: Cleaning leaves no face.
    """
    options = options or StudyOptions()
    tell = watch or tell_no_one
    tell("convert", 0.0)
    scene = convert(mesh, replace(options.options, instances=False))
    boxes = scene.triangle_boxes(options.threads)
    tell("build", 0.0)
    full_cost = full_tree_cost(boxes)
    built = {}
    for done, over in enumerate(OVERS):
        tell("build", done / len(OVERS))
        built |= {(name, over): part for name, part in _built(scene, boxes, over, options.runs).items()}
    tell("compile", 0.0)
    walked = {key: replace(scene, hierarchy=part.hierarchy) for key, part in built.items()}
    tracers = {
        f"{name}, {over}": Tracer(one, device=options.device, threads=options.threads)
        for (name, over), one in walked.items()
    }
    first = tracers[f"{LOOSE}, triangles"]
    rays = rays_of_each_kind(scene, first, options)
    counted = {key: [mean_counters(tracer, part) for part in rays] for key, tracer in tracers.items()}
    times = timed_in_turn(tracers, rays, options.runs, tell)
    rows = []
    for (name, over), part in built.items():
        key, reference = f"{name}, {over}", f"{SAH}, {over}"
        costs = _costs(rays, counted[key], times[key], times[reference])
        rows.append(_row(name, over, part, built[SAH, over], full_cost, costs))
    return LooseStudy.of(scene, first, rays, rows)


@dataclass(frozen=True)
class _Built:
    """A hierarchy, seconds of each run in file order and shuffled, and its expected cost."""

    hierarchy: LooseBvh
    seconds: np.ndarray
    cost: float


def _built(scene: Scene, triangle_boxes: Boxes, over: OverName, runs: int) -> dict[str, _Built]:
    starts = scene.objects(over)
    boxes, weights = range_boxes(triangle_boxes, starts), np.diff(starts).astype(np.int32)
    mixed = np.random.default_rng(1).permutation(len(boxes))
    orders = ((boxes, weights), (np.ascontiguousarray(boxes[mixed]), weights[mixed]))
    seconds = {name: np.zeros((runs, len(orders))) for name in BUILDS}
    # The first run compiles and warms up, and does not count.
    for run in range(-1, runs):
        for kind, given in enumerate(orders):
            for name in BUILDS:
                start = time.process_time()
                _builder(name, over, given[1])(given[0], None)
                seconds[name][max(run, 0), kind] = time.process_time() - start
    found = {}
    for name in BUILDS:
        build = _builder(name, over, weights)
        tree = _cost_of(build(boxes, 1), starts, triangle_boxes)
        found[name] = _Built(build(boxes, None), seconds[name], tree)
    return found


def _builder(name: str, over: OverName, weights: Counts) -> _Build:
    options = HierarchyOptions("loose-octree", over=over)
    if name == SAH:
        return lambda boxes, leaf_size: build_sah_bvh(boxes, options, 1, leaf_size, weights)
    build = build_loose_octree if name == LOOSE else build_linear_bvh
    return lambda boxes, leaf_size: build(boxes, options, 1, leaf_size)


def _cost_of(hierarchy: LooseBvh, starts: Counts, triangle_boxes: Boxes) -> float:
    """Expected cost of a hierarchy of one object a leaf, with balanced trees in the objects."""
    nodes, order = hierarchy.nodes, hierarchy.order
    inner = np.flatnonzero(nodes[:, 7] == 0)
    # The first child's nodes are twice its leaves less one.
    left = (nodes[inner, 6] - inner) // 2
    over_objects = StripHierarchy(nodes[inner, :6].view(np.float32), left.astype(np.uint32))
    objects = np.arange(len(starts) - 1, dtype=np.int32) if order is None else order
    triangles, place = triangles_of_objects(starts, objects)
    tree = expand_hierarchy(over_objects, place, np.ascontiguousarray(triangle_boxes[triangles]))
    return expected_cost(tree.boxes, tree.size)


def _costs(
    rays: tuple[RaySet, ...], counted: list[Counters], seconds: np.ndarray, of_sah: np.ndarray
) -> tuple[RayCost, ...]:
    return tuple(
        RayCost(*rates, each.boxes + each.triangles, each.triangles)
        for rates, each in zip(rates_and_ratios(rays, seconds, of_sah), counted, strict=True)
    )


def _row(
    name: str, over: OverName, part: _Built, sah: _Built, full_cost: float, costs: tuple[RayCost, ...]
) -> LooseRow:
    seconds, shuffled = np.median(part.seconds, axis=0)
    lead = float(np.median(sah.seconds[:, 0] / part.seconds[:, 0]))
    nodes = part.hierarchy.nodes
    given = (float(seconds), float(shuffled), lead, nodes.nbytes, part.cost / full_cost)
    return LooseRow(name, over, int(nodes[:, 7].sum()), *given, costs)


def tables(study: LooseStudy) -> list[tuple[str, list[dict[str, object]]]]:
    """The study as tables, each a title and rows: the hierarchies, then each kind of rays."""
    title = (
        f"{study.triangles:,} triangles on {', '.join(study.devices)}; lead: seconds of {SAH} over the row's"
    )
    parts: list[tuple[str, list[dict[str, object]]]] = [
        (title, [_hierarchy(study, row) for row in study.rows])
    ]
    for kind, name in enumerate(RAY_KINDS):
        heading = f"{study.ray_counts[kind]:,} {name} rays; ratio: rays a second over those of {SAH}"
        parts.append((heading, [_rays(row, row.rays[kind]) for row in study.rows]))
    return parts


def _hierarchy(study: LooseStudy, row: LooseRow) -> dict[str, object]:
    return {
        "build": row.build,
        "over": row.over,
        "objects": row.objects,
        "build_s": row.seconds,
        "shuffled_s": row.shuffled_seconds,
        "lead": row.lead,
        "B/triangle": row.node_bytes / study.triangles,
        "relative_cost": row.relative_cost,
    }


def _rays(row: LooseRow, cost: RayCost) -> dict[str, object]:
    return {
        "build": row.build,
        "over": row.over,
        "tests": cost.tests,
        "triangles": cost.triangles,
        "Mrays/s": cost.rate / 1e6,
        "ratio": cost.ratio,
    }
