"""The paper's table on any model: memory of a two-level presorted hierarchy, and what it costs rays.

Source: Eisemann, Bauszat, Guthe, Magnor, "Geometry Presorting for Implicit Object Space Partitioning" (EGSR
2012), additional material, table 1 and figure 1: kilobytes (of 1000 bytes) of the first n levels as plain
nodes, 5 to 16 levels. Differences:

1. Beside the bytes stand tests and rays a second: of primary rays of one camera, and of one
   cosine-distributed ray from each hit.
2. No level at all is a row too, and so is a whole SAH BVH: plain nodes down to two triangles, in the same
   walk. The default eight-wide SAH hierarchy over the same triangles stands beside them.
3. The two ways to test a presorted node (`trace.walk_presorted`) are compared without levels, with ten, and
   under the whole BVH.

All are traced in turn, a slice of the rays each, and compared by the median of the runs' ratios.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from striptools.hierarchies.presorted import EVERY_LEVEL, Presorted, level_limit, presort
from striptools.measure.plots import LIGHT, legend_below, require_plots, save_figure, titled
from striptools.measure.study import (
    StudyOptions,
    mean_counters,
    rates_and_ratios,
    study_rays,
    tell_no_one,
    timed_in_turn,
    wide_bytes,
)
from striptools.mesh.mesh import Mesh
from striptools.pipeline import convert
from striptools.reducem.placed import Placed
from striptools.reducem.scene import Remap, Scene
from striptools.stopwatch import Watch
from striptools.threads import every_core
from striptools.trace import Tracer
from striptools.trace.counters import Counters
from striptools.trace.layout import Layout
from striptools.trace.leaves import lay_out_rebuilt
from striptools.trace.presorted import NodeTest, lay_out_presorted

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["PAPER", "PresortedRow", "PresortedStudy", "plot", "presorted_of", "study", "tables"]

LEVELS = tuple(range(5, 17))
"""Those of the paper's table."""

COMPARED = (0, 10, EVERY_LEVEL)
"""Levels under which both node tests are measured."""

PAPER = {
    "Breaking Lion": (1, 2, 4, 8, 16, 33, 65, 131, 260, 515, 1001, 1904),
    "Crytek Sponza": (1, 2, 4, 7, 14, 26, 50, 94, 171, 303, 535, 919),
    "Fairy": (1, 2, 4, 8, 16, 32, 61, 112, 202, 354, 582, 902),
    "Robot Girl": (1, 2, 3, 6, 11, 20, 37, 69, 134, 264, 513, 966),
    "Thai Statue": (1, 2, 3, 5, 9, 17, 34, 67, 132, 262, 520, 1035),
    "Venice": (1, 2, 4, 8, 16, 33, 65, 130, 255, 494, 939, 1757),
}
"""Kilobytes of each scene, by level."""

WIDE = "wide SAH"
"""The default walk's name."""

_PRIMARY, _SECONDARY = "#1b6ca8", "#c8553d"


@dataclass(frozen=True)
class Traced:
    """What rays of one kind cost.

    Attributes:
        rate: Rays a second, in the fastest run; 0 where there is no ray.
        ratio: That over the rate of the whole SAH BVH: the median of the runs' ratios.
        boxes: Boxes and slabs that a ray tests, on the average.
        triangles: Triangles that a ray tests.
        node_bytes: Bytes of plain nodes that a ray reads.
        geometry_bytes: Bytes of triangles that a ray reads: of coordinates, where the geometry is presorted.
    """

    rate: float
    ratio: float
    boxes: float
    triangles: float
    node_bytes: float
    geometry_bytes: float

    @property
    def tests(self) -> float:
        """Tests of any kind."""
        return self.boxes + self.triangles


@dataclass(frozen=True)
class PresortedRow:
    """One hierarchy.

    Attributes:
        levels: Plain levels; `EVERY_LEVEL` for a whole SAH BVH, None for the default walk.
        node_test: How presorted nodes are tested; None for the default walk.
        node_bytes: Bytes of plain nodes; of wide ones in the default walk.
        trees: Presorted trees below.
        primary: Of primary rays.
        secondary: Of secondary rays.
    """

    levels: int | None
    node_test: NodeTest | None
    node_bytes: int
    trees: int
    primary: Traced
    secondary: Traced

    @property
    def name(self) -> str:
        """What tables call it."""
        if self.levels is None:
            return WIDE
        return "whole SAH" if self.levels == EVERY_LEVEL else str(self.levels)


@dataclass(frozen=True)
class PresortedStudy:
    """What the study found.

    Attributes:
        triangles: Triangles of the model.
        primary_rays: Primary rays in a run.
        secondary_rays: Secondary rays in a run.
        devices: What it was traced on.
        rows: By rising levels, then the whole SAH BVH, some with both node tests, and the default walk.
    """

    triangles: int
    primary_rays: int
    secondary_rays: int
    devices: tuple[str, ...]
    rows: tuple[PresortedRow, ...]

    @property
    def by_levels(self) -> tuple[PresortedRow, ...]:
        """The rows of the paper's table, with none at all and all of them."""
        return tuple(row for row in self.rows if row.levels is not None and row.node_test == "bandwidth")

    @property
    def wide(self) -> PresortedRow:
        """The default walk's row."""
        return next(row for row in self.rows if row.levels is None)

    def both_tests(self, levels: int) -> tuple[PresortedRow, ...]:
        """The rows of both node tests under so many levels."""
        return tuple(row for row in self.rows if row.levels == levels)


@dataclass(frozen=True)
class _Entry:
    """A hierarchy ready to trace: what is known of its row, and its tracer."""

    levels: int | None
    node_test: NodeTest | None
    node_bytes: int
    trees: int
    tracer: Tracer


def presorted_of(scene: Scene | Placed, levels: int, threads: int = 1) -> tuple[Placed, Presorted]:
    """The triangles of a scene sorted, and what stands above them.

    Args:
        scene: Of at least one triangle.
        levels: Plain levels.
        threads: To build with.
    """
    faces, remap = scene.faces(), scene.remap
    order, presorted = presort(scene.positions[faces], levels, threads)
    if remap is not None:
        remap = Remap(remap.face[order], remap.rotation[order])
    count = len(faces)
    placed = Placed(
        scene.positions,
        faces[order],
        np.arange(count + 1, dtype=np.int32),
        np.array([0, count], np.int32),
        remap,
        scene.error_bound,
        scene.source_face_count,
        scene.origin,
    )
    return placed, presorted


def study(mesh: Mesh, options: StudyOptions | None = None, *, watch: Watch | None = None) -> PresortedStudy:
    """Measure presorted geometry under more and more plain levels on one model.

    Args:
        mesh: The model.
        options: Of the study; the defaults of StudyOptions when left out.
        watch: Called with a stage's name (`convert`, `compile`, `trace`) and the fraction done.

    Raises:
        UnreadableMeshError: Cleaning leaves no face.
    """
    options = options or StudyOptions()
    tell = watch or tell_no_one
    tell("convert", 0.0)
    scene = convert(mesh, replace(options.options, instances=False))
    entries = _entries(scene, options, tell)
    tracers = {str(place): entry.tracer for place, entry in enumerate(entries)}
    rays = study_rays(scene, entries[-1].tracer, options)
    counted = []
    for entry in entries:
        tell("compile", len(counted) / len(entries))
        counted.append([mean_counters(entry.tracer, part) for part in rays])
    times = [*timed_in_turn(tracers, rays, options.runs, tell).values()]
    whole = times[[(entry.levels, entry.node_test) for entry in entries].index((EVERY_LEVEL, "bandwidth"))]
    rows = []
    for entry, seconds, counters in zip(entries, times, counted, strict=True):
        rates = rates_and_ratios(rays, seconds, whole)
        primary, secondary = (Traced(*rate, *_costs(k)) for rate, k in zip(rates, counters, strict=True))
        facts = (entry.levels, entry.node_test, entry.node_bytes, entry.trees)
        rows.append(PresortedRow(*facts, primary, secondary))
    counts = [len(part.origins) for part in rays]
    devices = tuple(str(device) for device in entries[-1].tracer.devices)
    return PresortedStudy(scene.triangle_count, counts[0], counts[1], devices, tuple(rows))


def _entries(scene: Scene, options: StudyOptions, tell: Watch) -> list[_Entry]:
    """Every hierarchy: by rising levels, each with one node test or both, and the default walk at last."""
    threads = options.threads or every_core()
    entries = []
    levels_asked = (0, *LEVELS, EVERY_LEVEL)
    for done, levels in enumerate(levels_asked):
        tell("convert", (done + 1) / (len(levels_asked) + 1))
        placed, presorted = presorted_of(scene, levels, threads)
        node_tests: tuple[NodeTest, ...] = ("bandwidth", "direct") if levels in COMPARED else ("bandwidth",)
        for node_test in node_tests:
            layout = lay_out_presorted(placed, presorted, threads, node_test=node_test)
            size, trees = presorted.nodes.nbytes, len(presorted.starts) - 1
            entries.append(_Entry(levels, node_test, size, trees, _tracer(layout, options)))
    layout = lay_out_rebuilt(scene, threads, once=True)
    return [*entries, _Entry(None, None, wide_bytes(layout), 0, _tracer(layout, options))]


def _tracer(layout: Layout, options: StudyOptions) -> Tracer:
    return Tracer.of_layout(layout, device=options.device, threads=options.threads)


def _costs(counters: Counters) -> tuple[float, float, float, float]:
    return counters.boxes, counters.triangles, counters.node_bytes, counters.geometry_bytes


def tables(study: PresortedStudy) -> list[tuple[str, list[dict[str, object]]]]:
    """The study as tables, each a title and rows: memory and speed by levels, node tests, the paper's own."""
    by_levels = [_row(row) for row in (*study.by_levels, study.wide)]
    title = f"{study.triangles:,} triangles, {study.primary_rays:,} primary and {study.secondary_rays:,} "
    title += f"secondary rays on {', '.join(study.devices)}; ratios are to the whole SAH BVH in the same walk"
    node_tests = [_node_test(row) for levels in COMPARED for row in study.both_tests(levels)]
    paper = [
        {"scene": name, **{str(level): size for level, size in zip(LEVELS, sizes, strict=True)}}
        for name, sizes in PAPER.items()
    ]
    here = {str(row.levels): round(row.node_bytes / 1000) for row in study.by_levels}
    paper.append({"scene": "this model", **{str(level): here[str(level)] for level in LEVELS}})
    return [
        (title, by_levels),
        ("Node tests: bytes of coordinates read and time, a ray", node_tests),
        ("The paper's table and this model: kilobytes by levels", paper),
    ]


def _row(row: PresortedRow) -> dict[str, object]:
    limited = row.levels is not None and row.levels < EVERY_LEVEL
    return {
        "levels": row.name,
        "kB": row.node_bytes / 1000,
        "limit_kB": level_limit(row.levels) / 1000 if limited and row.levels is not None else None,
        "trees": row.trees,
        "tests/ray": row.primary.tests,
        "B_read/ray": row.primary.node_bytes + row.primary.geometry_bytes,
        "Mrays/s": row.primary.rate / 1e6,
        "ratio": row.primary.ratio,
        "secondary_tests/ray": row.secondary.tests,
        "secondary_B_read/ray": row.secondary.node_bytes + row.secondary.geometry_bytes,
        "secondary_Mrays/s": row.secondary.rate / 1e6,
        "secondary_ratio": row.secondary.ratio,
    }


def _node_test(row: PresortedRow) -> dict[str, object]:
    found: dict[str, object] = {"levels": row.name, "node_test": row.node_test}
    for prefix, traced in (("", row.primary), ("secondary_", row.secondary)):
        found[f"{prefix}coordinate_B"] = traced.geometry_bytes
        found[f"{prefix}slabs"] = traced.boxes
        found[f"{prefix}triangles"] = traced.triangles
        found[f"{prefix}Mrays/s"] = traced.rate / 1e6
    return found


def plot(study: PresortedStudy, target: str | Path | IO[bytes], title: str = "") -> int:
    """Draw a study as a PNG picture: memory, tests a ray and rays a second, by levels.

    Target, title, result and errors are those of `plots.plot_study`.
    """
    figure = require_plots().Figure(figsize=(15, 5), dpi=110, layout="constrained")
    memory, tests, rate = figure.subplots(1, 3)
    _plot_memory(memory, study)
    _plot_curves(tests, study, "tests", 1.0)
    tests.set_title("boxes, slabs and triangles tested by a ray", fontsize=10)
    _plot_curves(rate, study, "rate", 1e6)
    rate.set_title("traced rays, millions a second (fastest run)", fontsize=10)
    figure.suptitle(titled(title, f"{study.triangles:,} triangles, presorted under plain SAH levels"))
    return save_figure(figure, target)


def _plot_memory(axes: "Axes", study: PresortedStudy) -> None:
    rows = [row for row in study.by_levels if row.levels in LEVELS]
    for place, sizes in enumerate(PAPER.values()):
        label = f"the paper's {len(PAPER)} scenes" if place == 0 else None
        axes.plot(LEVELS, sizes, color=LIGHT, linewidth=0.9, label=label)
    axes.plot(LEVELS, [level_limit(n) / 1000 for n in LEVELS], color="#222222", linestyle=":", label="limit")
    axes.plot(LEVELS, [row.node_bytes / 1000 for row in rows], color=_PRIMARY, marker="o", label="this model")
    whole = study.both_tests(EVERY_LEVEL)[0]
    axes.axhline(
        whole.node_bytes / 1000, color=_PRIMARY, linestyle="--", linewidth=0.8, label="whole SAH BVH"
    )
    axes.set_yscale("log")
    axes.set_title("plain nodes, kilobytes", fontsize=10)
    _finish(axes)


def _plot_curves(axes: "Axes", study: PresortedStudy, what: str, unit: float) -> None:
    """A figure of each kind of rays by levels; across, those of the whole SAH BVH and the default walk."""
    whole = study.both_tests(EVERY_LEVEL)[0]
    rows = [row for row in study.by_levels if row is not whole]
    levels = [row.levels for row in rows if row.levels is not None]
    for kind, colour in (("primary", _PRIMARY), ("secondary", _SECONDARY)):
        values = [getattr(getattr(row, kind), what) / unit for row in rows]
        axes.plot(levels, values, color=colour, marker="o", markersize=4, label=kind)
        for row, style in ((whole, "--"), (study.wide, "-.")):
            value = getattr(getattr(row, kind), what) / unit
            axes.axhline(value, color=colour, linestyle=style, linewidth=0.8, label=f"{row.name}, {kind}")
    axes.set_ylim(bottom=0)
    _finish(axes)


def _finish(axes: "Axes") -> None:
    axes.set_xlabel("plain levels", fontsize=9)
    legend_below(axes, columns=2, drop=0.12)


# Notes. Rays a second over those of the whole SAH BVH in the same walk, primary/secondary, by plain levels,
# and of the default walk over eight-wide nodes; megabytes of the whole SAH BVH. One study a mesh, 256 x 256
# primary rays, 5 runs, one thread, by process time, as the machine was busy. Plain nodes of 5 to 16 levels
# take 1 kB to 1.6-2.1 MB on all of them, never above the limit. (Power plant: 128 x 128 rays, 3 runs.)
#
#     mesh                0          5          10         12         14         16         wide       MB
#     bunny               0.43/0.47  0.55/0.50  0.68/0.64  0.78/0.74  0.90/0.88  1.00/0.98  1.87/2.27  2.4
#     chandelier          0.20/0.32  0.33/0.40  0.63/0.65  0.84/0.86  1.00/1.06  1.04/1.06  2.12/2.07  5.0
#     tree_japanesemaple  0.34/0.44  0.40/0.46  0.56/0.60  0.71/0.77  0.91/0.99  1.05/1.13  2.53/2.58  8.1
#     icub                0.34/0.34  0.46/0.45  0.65/0.62  0.74/0.72  0.87/0.86  0.98/1.00  1.70/1.99  10.0
#     dem_jacksboro       0.32/0.27  0.48/0.40  0.74/0.65  0.85/0.78  0.97/0.95  1.10/1.09  1.79/2.20  8.8
#     dragon              0.49/0.49  0.64/0.54  0.80/0.70  0.85/0.77  0.95/0.88  1.04/1.05  1.81/2.23  33.4
#     powerplant          0.39/0.33  0.34/0.30  0.46/0.39  0.55/0.51  0.72/0.73  1.00/1.00  3.99/3.38  87.9
#
# On the power plant's long thin pipes five levels are slower than none: why was not looked into.
#
# Sixteen levels trace about as fast as the whole BVH (0.98 to 1.13 of it), on the dragon with a sixteenth of
# its nodes and a third more tests: presumably because plain nodes cost cache lines of their own, and
# presorted ones are read with the triangles.
#
# On the first six the bandwidth order reads 0.62-0.67 of the direct test's coordinates without levels and
# 0.65-0.71 under ten, and is 1.21-1.40 and 1.06-1.15 times as fast here: without levels it tests 1 to 13
# triangles a ray instead of 41 to 193, and a watertight test costs more than a slab. Under the whole BVH it
# reads 0.91-1.00 and is 0.96-1.01 times as fast. (Power plant: 0.76-0.81 and 1.13-1.23; under the whole BVH
# 1.00 and 0.93-0.99.) The paper tested directly: its graphics cards gained nothing by the order.
