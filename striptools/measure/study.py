"""The paper's Table 3.2 on any model: what a stripifier costs in memory and in rays, all else being equal.

Source: Lauterbach, Yoon, Tang, Manocha, "ReduceM: Interactive and Memory Efficient Ray Tracing of Large
Models" (EGSR 2008), the table that singles out the effect of stripification: STRIPE, Strip-RT and Tipsify
under the same representation, their memory and their frames a second with primary rays at 1024 x 1024.

Every variant goes through the same pipeline but for its ordering, and its scene is traced as it lies, by the
same program. Differences:
1. Frames are counted in rays: one camera that frames the model, one ray a pixel; beside them one
   cosine-distributed ray from each hit, which the paper does not have.
2. Variants are traced in turn, a slice of the rays each, and compared by the median of the runs' ratios, so
   that what else the machine does falls on all alike.
3. A turn bit stands for a swap vertex, so strips that turn the same way often cost nothing more here. Memory
   with swap vertices, an index in its block of a byte each, stands beside it.
4. STRIPE-like strips and Tipsify's are given without a longest length, as published, and once more with the
   one of Strip-RT.
5. Speed can be bought with memory: strips of few triangles are compact whoever makes them. So Strip-RT is
   measured once more with the shortest strips that take no more memory than Tipsify's.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Generic, TypeVar

import numpy as np

from striptools.errors import UsageError
from striptools.measure.quality import StripQuality, full_tree_cost, strip_quality, traversal_steps
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert_with_report
from striptools.reducem.scene import Scene
from striptools.stopwatch import Watch
from striptools.strips.ordering import LARGEST_LENGTH, OrderingOptions
from striptools.trace import Tracer
from striptools.trace.counters import Counters
from striptools.trace.device import DeviceKind
from striptools.trace.layout import Layout
from striptools.trace.rays import THREE_QUARTER, UP_CHOICES, Camera, camera_rays, cosine_rays
from striptools.types import RayVectors

REFERENCE = "strip-rt"
"""The variant whose rate is divided by those of the others."""

SWAP_BYTES = 1
"""What a repeated vertex takes: an index of a block."""

SHORT_LENGTHS = (3, 4, 5, 6, 8, 10, 12, 16, 24, 32, 48)
"""Longest lengths tried, the shortest first, for Strip-RT at no more than Tipsify's memory."""

SLICE = 2**17
"""Rays that a variant traces before it is the next one's turn."""

LIFT = 1e-5
"""How far off the surface secondary rays start, in parts of the model's diagonal."""

RAY_KINDS = ("camera", "AO", "random")
"""Rays of a camera; one from each of their hits; from anywhere in the bounds in any direction."""


@dataclass(frozen=True)
class PaperRow:
    """A row of the paper's table: memory in MB and frames a second of STRIPE, Strip-RT and Tipsify."""

    model: str
    megatriangles: float
    megabytes: tuple[int, int, int]
    frames: tuple[float, float, float]


PAPER = (
    PaperRow("Powerplant", 12.7, (350, 272, 271), (28.57, 31.25, 29.05)),
    PaperRow("Double Eagle", 82, (2672, 1818, 1795), (11.90, 12.5, 11.31)),
    PaperRow("Puget Sound", 134, (2736, 2834, 2687), (7.58, 12.05, 6.45)),
    PaperRow("Boeing 777", 364, (12128, 8914, 8894), (3.75, 4.76, 3.8)),
    PaperRow("St. Matthew", 372, (7531, 7290, 7002), (3.36, 4.81, 3.15)),
)


def paper_range(method: str) -> tuple[float, float] | None:
    """The least and the largest of the paper's ratios of Strip-RT's frames a second over a baseline's.

    Args:
        method: `stripe` or `tipsify`; None is returned for any other.
    """
    if method not in ("stripe", "tipsify"):
        return None
    place = 0 if method == "stripe" else 2
    ratios = [row.frames[1] / row.frames[place] for row in PAPER]
    return min(ratios), max(ratios)


@dataclass(frozen=True)
class StudyOptions:
    """What is compared, and by how many rays.

    Attributes:
        options: What every variant's conversion is asked for; its ordering is Strip-RT's.
        side: Pixels across and down; one primary ray a pixel, 8 to 8192.
        runs: Runs whose ratios are taken the median of, 1 or more.
        up: The model's axis that points to the picture's top.
        device: Where to trace.
        threads: Threads to trace with; None for every core.
    """

    options: Options = field(default_factory=Options)
    side: int = 1024
    runs: int = 9
    up: str = "y"
    device: DeviceKind = "auto"
    threads: int | None = None

    def __post_init__(self) -> None:
        if not 8 <= self.side <= 8192:
            raise UsageError(f"{self.side} is out of range", where="side", remedy="give 8 to 8192")
        if self.runs < 1:
            raise UsageError(f"{self.runs} is out of range", where="runs", remedy="give 1 or more")
        if self.up not in UP_CHOICES:
            raise UsageError(f"up is {self.up!r}", remedy=f"one of {', '.join(UP_CHOICES)} is wanted")


@dataclass(frozen=True)
class StudyRow:
    """One variant.

    Attributes:
        variant: Its name.
        method: The method of its ordering.
        max_length: The longest strip it was allowed; None for any length.
        scene_bytes: Bytes of the scene that tracing needs: every part but the remap and attributes.
        swap_bytes: The same with the paper's swap vertices, a byte each, in place of turn bits.
        order_seconds: Seconds of the stage that made the strips.
        primary_rate: Primary rays a second, in the fastest run.
        secondary_rate: Secondary rays a second, in the fastest run; 0 where no primary ray hit.
        primary_ratio: Strip-RT's rate over this one's: the median of the runs' ratios.
        secondary_ratio: The same of secondary rays; 1 where there are none.
        primary_steps: Wide nodes and leaves that a primary ray visits, on the average.
        secondary_steps: The same of secondary rays.
        quality: The strips' own figures.
    """

    variant: str
    method: str
    max_length: int | None
    scene_bytes: int
    swap_bytes: int
    order_seconds: float
    primary_rate: float
    secondary_rate: float
    primary_ratio: float
    secondary_ratio: float
    primary_steps: float
    secondary_steps: float
    quality: StripQuality


@dataclass(frozen=True)
class Study:
    """What the study found.

    Attributes:
        triangles: Triangles of every scene.
        primary_rays: Primary rays in a run.
        secondary_rays: Secondary rays in a run.
        devices: What it was traced on.
        rows: A row a variant; the first is Strip-RT.
    """

    triangles: int
    primary_rays: int
    secondary_rays: int
    devices: tuple[str, ...]
    rows: tuple[StudyRow, ...]


@dataclass(frozen=True)
class RaySet:
    """Rays to trace."""

    origins: RayVectors
    directions: RayVectors


Row = TypeVar("Row")


@dataclass(frozen=True)
class KindsStudy(Generic[Row]):
    """What a study with rays of each kind found.

    Attributes:
        triangles: Triangles of the scene.
        ray_counts: Rays in a run, by `RAY_KINDS`.
        devices: What it was traced on.
        rows: A row a hierarchy.
    """

    triangles: int
    ray_counts: tuple[int, ...]
    devices: tuple[str, ...]
    rows: tuple[Row, ...]

    @classmethod
    def of(cls, scene: Scene, tracer: Tracer, rays: tuple[RaySet, ...], rows: list[Row]) -> "KindsStudy[Row]":
        """The study of a scene, traced with these rays on the devices of a tracer."""
        devices = tuple(str(device) for device in tracer.devices)
        return cls(scene.triangle_count, tuple(len(part.origins) for part in rays), devices, tuple(rows))


def variants(ordering: OrderingOptions) -> dict[str, OrderingOptions]:
    """The orderings that are compared, by name: Strip-RT as asked for, as the paper has it, the baselines.

    Args:
        ordering: Strip-RT's options; the baselines take its longest length where they take one at all.
    """
    found = {REFERENCE: ordering, "paper": replace(ordering, method="paper")}
    for method in ("stripe", "tipsify"):
        found[method] = replace(ordering, method=method, max_length=LARGEST_LENGTH)
        found[f"{method}, {ordering.max_length}"] = replace(ordering, method=method)
    return found


def study_strips(mesh: Mesh, options: StudyOptions | None = None, *, watch: Watch | None = None) -> Study:
    """Compare stripifiers on one model.

    Args:
        mesh: The model.
        options: Of the study; the defaults of StudyOptions when left out.
        watch: Called with a stage's name (`convert`, `compile`, `trace`) and the fraction done.

    Returns:
        A row a variant, of the same triangles and rays.

    Raises:
        UnreadableMeshError: Cleaning leaves no face.
        UsageError: An option is out of its range.
    """
    options = options or StudyOptions()
    tell = watch or tell_no_one
    orderings = variants(options.options.ordering)
    scenes: dict[str, Scene] = {}
    seconds: dict[str, float] = {}
    for done, (name, ordering) in enumerate(orderings.items()):
        tell("convert", done / len(orderings))
        scenes[name], seconds[name] = _convert(mesh, options.options, ordering)
    short = _short_strips(mesh, options.options, most_bytes=_bytes(scenes["tipsify"]))
    if short is not None:
        name = f"{REFERENCE}, {short[0].max_length}"
        orderings[name], scenes[name], seconds[name] = short
    tell("compile", 0.0)
    tracers = {
        name: Tracer(scene, device=options.device, threads=options.threads) for name, scene in scenes.items()
    }
    rays = study_rays(scenes[REFERENCE], tracers[REFERENCE], options)
    steps = _steps(tracers, rays, tell)
    times = timed_in_turn(tracers, rays, options.runs, tell)
    quality = _qualities(scenes, options.options)
    rows = [
        _row(name, orderings[name], scenes[name], seconds[name], times, steps[name], quality[name], rays)
        for name in orderings
    ]
    counts = [len(part.origins) for part in rays]
    devices = tuple(str(device) for device in tracers[REFERENCE].devices)
    return Study(scenes[REFERENCE].triangle_count, counts[0], counts[1], devices, tuple(rows))


def _convert(mesh: Mesh, options: Options, ordering: OrderingOptions) -> tuple[Scene, float]:
    """The scene of an ordering, and the seconds that the ordering took."""
    scene, report = convert_with_report(mesh, replace(options, ordering=ordering))
    return scene, report.seconds["order"]


def _short_strips(
    mesh: Mesh, options: Options, most_bytes: int
) -> tuple[OrderingOptions, Scene, float] | None:
    """Strip-RT with the shortest longest length that takes no more than some bytes; None if none does."""
    for length in SHORT_LENGTHS:
        ordering = replace(options.ordering, max_length=length)
        if length >= options.ordering.max_length:
            break
        scene, seconds = _convert(mesh, options, ordering)
        if _bytes(scene) <= most_bytes:
            return ordering, scene, seconds
    return None


def _bytes(scene: Scene) -> int:
    """What tracing needs of a scene: every part but the remap and attributes."""
    parts = scene.part_bytes()
    return sum(parts.values()) - parts["remap"] - parts["attributes"]


def study_rays(
    scene: Scene,
    tracer: Tracer,
    options: StudyOptions,
    view: tuple[float, float, float] = THREE_QUARTER,
) -> tuple[RaySet, RaySet]:
    """Primary rays of one camera, and a secondary one from each of their hits, towards its side."""
    size = {"width": options.side, "height": options.side}
    camera = Camera.framing(scene.positions, **size, view=view, up=options.up)
    origins, directions = camera_rays(camera)
    hits = tracer.closest_hit(origins, directions)
    hit = np.flatnonzero(hits.face >= 0)
    way = directions[hit].astype(np.float64)
    points = origins[hit] + hits.t[hit, None] * way
    a, b, c = scene.positions[scene.faces()[hits.triangle[hit]]].astype(np.float64).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.where(length > 0, length, 1.0)
    normals *= np.where((normals * way).sum(axis=1, keepdims=True) > 0, -1.0, 1.0)
    diagonal = float(np.linalg.norm(np.ptp(scene.positions.astype(np.float64), axis=0)))
    offset = LIFT * diagonal + 2.0**-20 * np.abs(points).max(axis=1, initial=0.0)
    return RaySet(origins, directions), RaySet(*cosine_rays(points, normals, offset=offset))


def random_rays(scene: Scene, count: int) -> RaySet:
    """Rays from anywhere in a scene's bounds in any direction, the same ones each time."""
    random = np.random.default_rng(1)
    low, high = scene.low.astype(np.float64), scene.high.astype(np.float64)
    origins = low + (high - low) * random.random((count, 3))
    return RaySet(origins.astype(np.float32), random.normal(size=(count, 3)).astype(np.float32))


def rays_of_each_kind(scene: Scene, tracer: Tracer, options: StudyOptions) -> tuple[RaySet, ...]:
    """Rays by `RAY_KINDS`; a random one to four pixels."""
    return (*study_rays(scene, tracer, options), random_rays(scene, options.side**2 // 4))


def ray_counters(tracer: Tracer, rays: RaySet) -> Counters:
    """What each ray visits, tests and reads."""
    counters = tracer.closest_hit(rays.origins, rays.directions, counters=True).counters
    assert counters is not None
    return counters


def mean_counters(tracer: Tracer, rays: RaySet) -> Counters:
    """What a ray visits, tests and reads on the average, a float each; 0 where there is no ray."""
    counters = ray_counters(tracer, rays)
    return Counters(*(float(np.mean(each)) if len(each) else 0.0 for each in counters))


def wide_bytes(layout: Layout) -> int:
    """Bytes of the wide nodes of a layout that are in use."""
    used = np.isfinite(layout.arrays.nodes[:, 0]).any(axis=1)
    return int(used.sum()) * layout.arrays.nodes[0].nbytes


def _steps(
    tracers: dict[str, Tracer], rays: tuple[RaySet, RaySet], tell: Watch
) -> dict[str, tuple[float, float]]:
    found = {}
    for done, (name, tracer) in enumerate(tracers.items()):
        tell("compile", done / len(tracers))
        first, second = (traversal_steps(tracer, part.origins, part.directions) for part in rays)
        found[name] = (first, second)
    return found


def timed_in_turn(
    tracers: dict[str, Tracer],
    rays: tuple[RaySet, ...],
    runs: int,
    tell: Watch,
    clock: Callable[[], float] = time.perf_counter,
) -> dict[str, np.ndarray]:
    """(runs, k) seconds of each variant, for k kinds of rays; all in turn within each run."""
    times = {name: np.zeros((runs, len(rays))) for name in tracers}
    names = list(tracers)
    # The first run compiles and warms up, and does not count.
    for run in range(-1, runs):
        tell("trace", (run + 1) / (runs + 1))
        for kind, part in enumerate(rays):
            for turn, first in enumerate(range(0, len(part.origins), SLICE)):
                # Another one begins each time, so that none always follows the same other one.
                begin = (turn + run) % len(names)
                for name in names[begin:] + names[:begin]:
                    seconds = _seconds(tracers[name], part, slice(first, first + SLICE), clock)
                    times[name][max(run, 0), kind] += seconds if run >= 0 else 0.0
    return times


def _seconds(tracer: Tracer, rays: RaySet, part: slice, clock: Callable[[], float]) -> float:
    start = clock()
    # One by one: packets are of one walk, and hide what a hierarchy costs a ray.
    tracer.closest_hit(rays.origins[part], rays.directions[part], packets=False)
    return clock() - start


def _qualities(scenes: dict[str, Scene], options: Options) -> dict[str, StripQuality]:
    reference = scenes[REFERENCE]
    boxes = reference.triangle_boxes(options.threads)
    threads = options.threads or 1
    full_cost = full_tree_cost(boxes, options.partition, threads=threads)
    return {name: strip_quality(scene, full_cost=full_cost) for name, scene in scenes.items()}


def _row(
    name: str,
    ordering: OrderingOptions,
    scene: Scene,
    seconds: float,
    times: dict[str, np.ndarray],
    steps: tuple[float, float],
    quality: StripQuality,
    rays: tuple[RaySet, RaySet],
) -> StudyRow:
    primary, secondary = (
        rate_and_ratio(len(part.origins), times[name][:, kind], times[REFERENCE][:, kind])
        for kind, part in enumerate(rays)
    )
    return StudyRow(
        variant=name,
        method=ordering.method,
        max_length=ordering.max_length if ordering.max_length < LARGEST_LENGTH else None,
        scene_bytes=_bytes(scene),
        swap_bytes=_bytes(scene) - scene.triangle_count // 8 + SWAP_BYTES * quality.swaps,
        order_seconds=seconds,
        primary_rate=primary[0],
        secondary_rate=secondary[0],
        primary_ratio=primary[1],
        secondary_ratio=secondary[1],
        primary_steps=steps[0],
        secondary_steps=steps[1],
        quality=quality,
    )


def rate_and_ratio(rays: int, seconds: np.ndarray, of_reference: np.ndarray) -> tuple[float, float]:
    """Rays a second in the fastest run, and the reference's rate over it; 0 and 1 where there are no rays."""
    if rays == 0:
        return 0.0, 1.0
    return rays / float(seconds.min()), float(np.median(seconds / of_reference))


def rates_and_ratios(
    rays: tuple[RaySet, ...], seconds: np.ndarray, of_reference: np.ndarray
) -> list[tuple[float, float]]:
    """Of each kind of rays: rays a second in the fastest run, and this rate over the reference's.

    Args:
        rays: Of k kinds.
        seconds: (runs, k).
        of_reference: The same of the reference.
    """
    found = []
    for kind, part in enumerate(rays):
        rate, lead = rate_and_ratio(len(part.origins), seconds[:, kind], of_reference[:, kind])
        found.append((rate, 1 / lead))
    return found


def tell_no_one(_stage: str, _fraction: float) -> None:
    """The watch of who does not watch."""


# Notes. Strip-RT's lead in primary / secondary rays a second and what a triangle takes, in blocks of 256:
# one study a mesh, 7 runs on two busy cores (rows of one and the same scene differed by up to 5 %), 1024
# x 1024 primary rays. The paper has 1.05-1.59 over STRIPE and 1.08-1.87 over Tipsify, whose bytes are
# Strip-RT's within 5.5 %. The baselines order the whole mesh; their strips are then put into blocks by a
# SAH split over them.
#
#     mesh                STRIPE-like    Tipsify        bytes: Strip-RT, STRIPE-like, Tipsify
#     bunny               1.39 / 1.58    1.19 / 1.26    6.70  8.41  7.37
#     chandelier          1.24 / 1.35    1.22 / 1.25    6.86  6.36  6.83
#     kicad_acepack       1.35 / 1.02    1.41 / 0.93    7.65  7.21  8.18
#     dem_jacksboro       1.43 / 1.79    1.26 / 1.31    5.18  8.05  5.70
#     icub                1.36 / 1.51    1.17 / 1.29    7.54  7.73  8.10
#     tree_japanesemaple  1.06 / 1.09    1.17 / 1.28    7.51  6.58  7.06
#     ugly_bunny_holes    1.25 / 1.35    1.11 / 1.14    6.76  7.65  7.30
#     dragon              1.24 / 1.18    1.23 / 1.28    6.29  6.88  6.80
#     dragon_3m5          1.27 / 1.54    1.21 / 1.31    6.05  7.33  6.63
#     powerplant          1.44 / 0.83    3.25 / 1.62    7.15  6.87  7.03
#
# Before strips were stored in blocks the lead over Tipsify was smaller (0.96 to 1.61 for secondary rays):
# its strips, ended wherever the order breaks, took half as many bytes again and were compact for being
# short.
#
# Where Strip-RT is not ahead, the blocks are the reason. They are cut from the object tree in alignment
# with whole blocks, which puts large triangles beside small ones; strips that are grouped afterwards are
# split by SAH alone. On the power plant's long thin pipes the first costs 1.019 of a full SAH tree, the
# second 0.988 to 0.999 whoever made the strips (Strip-RT with `--block 0`: 0.993), so that STRIPE-like
# strips are walked in 42 steps against 46; the halves of a strip have 1.94 of its area there, and no
# order of triangles can win. On kicad_acepack secondary rays take two steps in all, and rows differ by
# what runs of one row do.
