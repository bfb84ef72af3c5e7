"""What an SLBVH costs beside the default walk: bytes, build, tests and rays a second, by balance and objects.

Source: Murguia et al., "Bit-Trail Traversal for Stackless LBVH on DirectCompute" (GPU Pro 4, 2013), which
claims a smaller footprint than other stackless hierarchies, although empty nodes are stored, and no stack.
The excerpt we have prints no table; this one is ours: Morton and balanced SAH builds over triangles, strips
and blocks of one scene, each beside the eight-wide walk with its stack, over the same triangles and rays.

Each heap is traced in turn with the wide walk, a slice of the rays each, and compared by the median of the
runs' ratios; it is given back before the next one, so that two are in memory at a time.
"""

import time
from dataclasses import dataclass, replace

import numpy as np

from striptools.hierarchies.options import BalanceName, HierarchyOptions, OverName
from striptools.hierarchies.slbvh import Slbvh, build_slbvh
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
    wide_bytes,
)
from striptools.mesh.mesh import Mesh
from striptools.partition.boxes import range_boxes
from striptools.pipeline import convert
from striptools.reducem.scene import Scene
from striptools.stopwatch import Watch
from striptools.threads import every_core
from striptools.trace import Tracer
from striptools.trace.counters import Counters
from striptools.trace.leaves import lay_out

__all__ = ["RayCost", "SlbvhRow", "SlbvhStudy", "study", "tables"]

BALANCES: tuple[BalanceName, ...] = ("sah", "morton")
OVERS: tuple[OverName, ...] = ("triangles", "strips", "blocks")

WIDE, HEAP = "wide", "slbvh"

TRAIL_BYTES = 8
"""What a ray keeps to find its way: a node and a trail."""

ENTRY_BYTES = 8
"""An entry of the wide walk's stack: a node and its lanes left."""


@dataclass(frozen=True)
class RayCost:
    """What rays of one kind cost.

    Attributes:
        rate: Rays a second, in the fastest run; 0 where there is no ray.
        ratio: That over the rate of the wide walk: the median of the runs' ratios.
        boxes: Boxes that a ray tests, on the average; of an SLBVH, as many as nodes visited.
        triangles: Triangles that a ray tests.
        bytes_read: Bytes of nodes and of triangles that a ray reads.
    """

    rate: float
    ratio: float
    boxes: float
    triangles: float
    bytes_read: float


@dataclass(frozen=True)
class SlbvhRow:
    """One hierarchy.

    Attributes:
        balance: How it was built; None for the wide walk.
        over: What its leaves hold.
        objects: How many there are.
        depth: Levels below the root.
        build_seconds: Of the build alone, from boxes; None for the wide walk.
        node_bytes: Bytes of all nodes, empty ones included.
        empty: The share of nodes that are empty; 0 for the wide walk, which has none.
        state_bytes: Bytes that a ray keeps to find its way.
        rays: What rays cost, by `RAY_KINDS`.
    """

    balance: BalanceName | None
    over: OverName
    objects: int
    depth: int
    build_seconds: float | None
    node_bytes: int
    empty: float
    state_bytes: int
    rays: tuple[RayCost, ...]


SlbvhStudy = KindsStudy[SlbvhRow]
"""What the study found: a row of the wide walk, then balance by balance."""


def study(mesh: Mesh, options: StudyOptions | None = None, *, watch: Watch | None = None) -> SlbvhStudy:
    """Measure SLBVHs over one model.

    Args:
        mesh: The model.
        options: Of the study; the defaults of StudyOptions when left out.
        watch: Called with a stage's name (`convert`, `compile`, `trace`) and the fraction done.

    Raises:
        UnreadableMeshError: Cleaning leaves no face.
        LimitError: A heap takes more than the limit.
    """
    options = options or StudyOptions()
    tell = watch or tell_no_one
    tell("convert", 0.0)
    scene = convert(mesh, replace(options.options, instances=False))
    wide = Tracer(scene, device=options.device, threads=options.threads)
    rays = rays_of_each_kind(scene, wide, options)
    counted = [mean_counters(wide, part) for part in rays]
    rows = []
    for balance in BALANCES:
        for over in OVERS:
            tell("compile", len(rows) / (len(BALANCES) * len(OVERS)))
            slbvh, seconds = _built(scene, balance, over, options.threads or every_core())
            walked = replace(scene, hierarchy=slbvh)
            tracer = Tracer(walked, device=options.device, threads=options.threads)
            times = timed_in_turn({WIDE: wide, HEAP: tracer}, rays, options.runs, tell)
            costs = _costs(rays, [mean_counters(tracer, part) for part in rays], times[HEAP], times[WIDE])
            rows.append(_row(slbvh, balance, seconds, costs))
            if len(rows) == 1:
                rows.insert(0, _wide_row(scene, _costs(rays, counted, times[WIDE], times[WIDE])))
    return SlbvhStudy.of(scene, wide, rays, rows)


def _built(scene: Scene, balance: BalanceName, over: OverName, threads: int) -> tuple[Slbvh, float]:
    """A heap, and the seconds of the second of two builds: the first may compile."""
    boxes = range_boxes(scene.triangle_boxes(threads), scene.objects(over))
    options = HierarchyOptions("slbvh", over=over, balance=balance)
    build_slbvh(boxes[:1], options, threads)
    start = time.perf_counter()
    slbvh = build_slbvh(boxes, options, threads)
    return slbvh, time.perf_counter() - start


def _costs(
    rays: tuple[RaySet, ...], counted: list[Counters], seconds: np.ndarray, of_wide: np.ndarray
) -> tuple[RayCost, ...]:
    return tuple(
        RayCost(*rates, each.boxes, each.triangles, each.node_bytes + each.geometry_bytes)
        for rates, each in zip(rates_and_ratios(rays, seconds, of_wide), counted, strict=True)
    )


def _row(slbvh: Slbvh, balance: BalanceName, seconds: float, costs: tuple[RayCost, ...]) -> SlbvhRow:
    # Node 0 is no node, and not an empty one.
    empty = 1 - np.count_nonzero(slbvh.counts) / (len(slbvh.nodes) - 1)
    facts = (len(slbvh.objects()), slbvh.depth, seconds, slbvh.nodes.nbytes)
    return SlbvhRow(balance, slbvh.over, *facts, empty, TRAIL_BYTES, costs)


def _wide_row(scene: Scene, costs: tuple[RayCost, ...]) -> SlbvhRow:
    """The default walk; its nodes are laid out from the scene's own, so that there is no build to time."""
    layout = lay_out(scene)
    size = wide_bytes(layout)
    stack = ENTRY_BYTES * (layout.depth + 2)
    return SlbvhRow(None, "triangles", scene.triangle_count, layout.depth, None, size, 0.0, stack, costs)


def tables(study: SlbvhStudy) -> list[tuple[str, list[dict[str, object]]]]:
    """The study as tables, each a title and rows: the hierarchies, then each kind of rays."""
    title = f"{study.triangles:,} triangles on {', '.join(study.devices)}"
    parts: list[tuple[str, list[dict[str, object]]]] = [
        (title, [_hierarchy(study, row) for row in study.rows])
    ]
    for kind, name in enumerate(RAY_KINDS):
        rays = f"{study.ray_counts[kind]:,} {name} rays; ratios are to the wide walk"
        parts.append((rays, [_rays(row, row.rays[kind]) for row in study.rows]))
    return parts


def _hierarchy(study: SlbvhStudy, row: SlbvhRow) -> dict[str, object]:
    return {
        **_name(row),
        "objects": row.objects,
        "depth": row.depth,
        "build_s": row.build_seconds,
        "B/triangle": row.node_bytes / study.triangles,
        "empty": row.empty,
        "B/ray": row.state_bytes,
    }


def _rays(row: SlbvhRow, cost: RayCost) -> dict[str, object]:
    return {
        **_name(row),
        "boxes": cost.boxes,
        "triangles": cost.triangles,
        "B_read": cost.bytes_read,
        "Mrays/s": cost.rate / 1e6,
        "ratio": cost.ratio,
    }


def _name(row: SlbvhRow) -> dict[str, object]:
    return {"hierarchy": WIDE if row.balance is None else row.balance, "over": row.over}


# Notes. Rate over that of the wide walk, camera / AO / random rays, by processor time, one thread (65,536
# camera rays, 3 runs, a busy machine: 5 to 10 % of noise); bytes of nodes a triangle; share of empty nodes.
# The wide walk's nodes take 5.9 to 6.4 bytes a triangle.
#
#                        sah, triangles            sah, strips              morton, triangles
#     bunny          .61/.52/.75  15.1  26 %   .54/.46/.52  3.8  34 %   .48/.36/.52  15.1  43 %
#     dragon         .71/.58/.65   9.6   0 %   .70/.57/.64  4.8  43 %   .42/.29/.26   9.6  16 %
#     dem_jacksboro  .58/.50/.59  15.2  29 %   .64/.52/.53  3.8  17 %   .30/.23/.23  15.2  45 %
#     chandelier     .40/.49/.38  15.8  44 %   .51/.59/.61  3.9  36 %   .28/.33/.32  15.8  47 %
#     powerplant     .29/.33/.28  12.9   0 %   .42/.45/.43  6.4  42 %   .56/.30/.19  12.9  37 %
#
# A ray keeps 8 bytes to find its way instead of 80 to 120. Over blocks, nodes take 0.3 to 0.5 bytes a
# triangle, and whole blocks are tested: 0.15 to 0.58. Over strips less memory than the wide nodes, and where
# triangles differ much in size more speed than over triangles too: a strip holds together what halves by
# count tear apart.
