"""All hierarchies over one model in one table: what they take, what they should cost rays, what they cost.

The default eight-wide hierarchy, expanded and compressed; the trees inside strips walked as they are, binary;
SLBVH, kd-tree, loose octree and presorted geometry, over triangles. Each is traced in turn with the default
one, a slice of the rays each, and rates are told of the fastest run; it is given back before the next one. In
the same run each is judged by the oracle over the source mesh, and its hits on all rays of the study are
compared with the default's, bit for bit.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from striptools.hierarchies.in_strip import BinaryTree
from striptools.hierarchies.loose_octree import LooseBvh
from striptools.hierarchies.options import HierarchyOptions
from striptools.measure.hierarchy_cost import hierarchy_cost
from striptools.measure.plots import LIGHT, legend_below, name_rows, require_plots, save_figure, titled
from striptools.measure.quality import full_tree_cost, in_strip_tree
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
from striptools.measure.verify import VerifyOptions, verify
from striptools.mesh.mesh import Mesh
from striptools.partition.object_split import split_objects
from striptools.partition.sah import PartitionOptions
from striptools.pipeline import convert
from striptools.reducem.layout import BLOCK_TRIANGLES
from striptools.reducem.scene import Scene
from striptools.stopwatch import Watch
from striptools.threads import every_core
from striptools.trace import Tracer
from striptools.trace.hit import Hits
from striptools.trace.tracer import ResidentKind

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["HierarchiesStudy", "HierarchyRow", "RayCost", "plot", "study", "tables"]

WIDE, OTHER = "reducem", "other"

JUDGED = VerifyOptions(rays=64, aimed_rays=4096)
"""How much of each is judged by the oracle."""

OTHERS = (
    HierarchyOptions("slbvh", balance="sah"),
    HierarchyOptions("slbvh", balance="morton"),
    HierarchyOptions("kdtree", metric="corrected"),
    HierarchyOptions("loose-octree"),
    HierarchyOptions("presorted"),
)

_COLOURS = ("#1b6ca8", "#e0a030", "#c8553d")


@dataclass(frozen=True)
class RayCost:
    """What rays of one kind cost.

    Attributes:
        rate: Rays a second, in the fastest run; 0 where there is no ray.
        ratio: That over the rate of the default hierarchy, expanded: the median of the runs' ratios.
        boxes: Boxes, planes and slabs that a ray tests, on the average.
        triangles: Triangles that a ray tests.
    """

    rate: float
    ratio: float
    boxes: float
    triangles: float


@dataclass(frozen=True)
class HierarchyRow:
    """One hierarchy.

    Attributes:
        name: What tables call it.
        build_seconds: Of the build from triangles or strips: the second of two, the first may compile.
        file_bytes: What a scene file of it takes, remap and attributes left out; None where none holds it.
        hierarchy_bytes: Those of the hierarchy among them, or what its nodes would take.
        cost: Expected cost of a ray, over that of a full SAH tree.
        rays: What rays cost, by `RAY_KINDS`.
        judged: Rays that the oracle judged.
        disagreements: Those with a wrong answer.
        leaks: Those that slipped through.
        different: Rays of the study whose hits are not those of the default hierarchy.
    """

    name: str
    build_seconds: float
    file_bytes: int | None
    hierarchy_bytes: int
    cost: float
    rays: tuple[RayCost, ...]
    judged: int
    disagreements: int
    leaks: int
    different: int


HierarchiesStudy = KindsStudy[HierarchyRow]
"""What the study found: a row of the default hierarchy first."""


@dataclass(frozen=True)
class _Candidate:
    """A hierarchy to measure: its name, what builds it, how it is kept, and whether a file can hold it."""

    name: str
    build: Callable[[], Scene]
    resident: ResidentKind = "expanded"
    has_file: bool = True


def study(mesh: Mesh, options: StudyOptions | None = None, *, watch: Watch | None = None) -> HierarchiesStudy:
    """Measure all hierarchies over one model.

    Args:
        mesh: The model, as loaded.
        options: Of the study; the defaults of StudyOptions when left out.
        watch: Called with a stage's name and the fraction done.

    Raises:
        UnreadableMeshError: Cleaning leaves no face.
        LimitError: A hierarchy takes more than its limit.
    """
    options = options or StudyOptions()
    tell = watch or tell_no_one
    tell("convert", 0.0)
    # Faces are compared by the source's numbers, whatever the order of triangles.
    scene = convert(mesh, replace(options.options, instances=False, remap=True, boxes="rebuilt"))
    threads = options.threads or every_core()
    wide = Tracer(scene, device=options.device, threads=options.threads, resident="expanded")
    rays = rays_of_each_kind(scene, wide, options)
    run = _Run(mesh, scene, rays, wide, options, tell, full_tree_cost(scene.triangle_boxes(threads)))
    candidates = _candidates(scene, threads)
    rows = []
    for done, candidate in enumerate(candidates):
        tell("build", done / len(candidates))
        rows.append(run.row(candidate))
    return HierarchiesStudy.of(scene, wide, rays, rows)


def _candidates(scene: Scene, threads: int) -> list[_Candidate]:
    default = [
        _Candidate(WIDE, lambda: _completed(scene, threads)),
        _Candidate(f"{WIDE}, compressed", lambda: _completed(scene, threads), "compressed"),
        _Candidate("in strips, binary", lambda: _binary(scene, threads), has_file=False),
    ]
    return default + [
        _Candidate(_name(one), lambda one=one: scene.under(one, threads), "expanded") for one in OTHERS
    ]


def _name(options: HierarchyOptions) -> str:
    parts = {"slbvh": options.balance, "kdtree": options.metric, "presorted": f"{options.levels} levels"}
    return ", ".join(filter(None, [options.name, parts.get(options.name)]))


def _completed(scene: Scene, threads: int) -> Scene:
    """A copy of the scene after all that its hierarchy takes: the split that blocks are cut from, boxes."""
    fresh = replace(scene)
    split_objects(fresh.triangle_boxes(threads), PartitionOptions(block=BLOCK_TRIANGLES), threads=threads)
    fresh.with_boxes(threads)
    return fresh


def _binary(scene: Scene, threads: int) -> Scene:
    """The scene under the trees inside its strips, binary, one triangle a leaf."""
    order, tree = in_strip_tree(scene, scene.triangle_boxes(threads), threads=threads)
    return replace(scene, hierarchy=LooseBvh("triangles", _nodes_of(tree), order.astype(np.int32)))


def _nodes_of(tree: BinaryTree) -> np.ndarray:
    """A preorder tree, one triangle a leaf, as nodes with boxes: (2n-1, 8) uint32."""
    nodes = np.zeros((len(tree.size), 8), np.uint32)
    nodes[:, :6] = np.ascontiguousarray(tree.boxes, np.float32).view(np.uint32)
    is_leaf = tree.size == 1
    inner = np.flatnonzero(~is_leaf)
    nodes[inner, 6] = inner + 2 * tree.size[inner + 1]
    nodes[is_leaf, 6] = np.arange(int(is_leaf.sum()))
    nodes[is_leaf, 7] = 1
    return nodes


class _Run:
    """What all rows are measured by."""

    def __init__(
        self,
        mesh: Mesh,
        scene: Scene,
        rays: tuple[RaySet, ...],
        wide: Tracer,
        options: StudyOptions,
        tell: Watch,
        full_cost: float,
    ) -> None:
        self.mesh, self.scene, self.rays, self.wide = mesh, scene, rays, wide
        self.options, self.tell, self.full_cost = options, tell, full_cost
        self.hits = [wide.closest_hit(part.origins, part.directions) for part in rays]

    def row(self, candidate: _Candidate) -> HierarchyRow:
        """Build it twice, trace it in turn with the default one, and judge it."""
        candidate.build()
        start = time.perf_counter()
        scene = candidate.build()
        seconds = time.perf_counter() - start
        options = self.options
        tracer = Tracer(scene, device=options.device, threads=options.threads, resident=candidate.resident)
        counted = [mean_counters(tracer, part) for part in self.rays]
        times = timed_in_turn({WIDE: self.wide, OTHER: tracer}, self.rays, options.runs, self.tell)
        rates = rates_and_ratios(self.rays, times[OTHER], times[WIDE])
        costs = [RayCost(*rate, k.boxes, k.triangles) for rate, k in zip(rates, counted, strict=True)]
        hits = [tracer.closest_hit(part.origins, part.directions) for part in self.rays]
        different = sum(_different(one, other) for one, other in zip(hits, self.hits, strict=True))
        report = verify(scene, self.mesh, JUDGED, tracer=tracer)
        sizes = _sizes(scene, has_file=candidate.has_file)
        cost = hierarchy_cost(scene) / self.full_cost
        judged = (report.rays, report.disagreements + report.structure.errors, report.leaks, different)
        return HierarchyRow(candidate.name, seconds, *sizes, cost, tuple(costs), *judged)


def _different(one: Hits, other: Hits) -> int:
    """How many hits are not the same, bit for bit."""
    wrong = one.face != other.face
    for mine, theirs in ((one.t, other.t), (one.u, other.u), (one.v, other.v)):
        wrong |= mine.view(np.uint32) != theirs.view(np.uint32)
    return int(wrong.sum())


def _sizes(scene: Scene, *, has_file: bool) -> tuple[int | None, int]:
    """Bytes of the file, remap and attributes left out, and of the hierarchy among them."""
    if not has_file:
        assert scene.hierarchy is not None
        return None, scene.hierarchy.nodes.nbytes
    parts = scene.part_bytes()
    own = parts["hierarchy"] + parts["top_level"] + parts["in_block_hierarchy"]
    return sum(parts.values()) - parts["remap"] - parts["attributes"], own


def tables(study: HierarchiesStudy) -> list[tuple[str, list[dict[str, object]]]]:
    """The study as one table."""
    counts = ", ".join(f"{count:,} {kind}" for count, kind in zip(study.ray_counts, RAY_KINDS, strict=True))
    title = f"{study.triangles:,} triangles, {counts} rays on {', '.join(study.devices)}"
    return [(title, [_row(study, row) for row in study.rows])]


def _row(study: HierarchiesStudy, row: HierarchyRow) -> dict[str, object]:
    size = None if row.file_bytes is None else row.file_bytes / study.triangles
    found: dict[str, object] = {
        "hierarchy": row.name,
        "build_s": row.build_seconds,
        "B/tri": size,
        "own_B/tri": row.hierarchy_bytes / study.triangles,
        "cost": row.cost,
    }
    for kind, cost in zip(RAY_KINDS, row.rays, strict=True):
        found[f"{kind}_boxes"], found[f"{kind}_tris"] = cost.boxes, cost.triangles
        found[f"{kind}_Mrays/s"], found[f"{kind}_ratio"] = cost.rate / 1e6, cost.ratio
    found |= {"judged": row.judged, "wrong": row.disagreements, "leaks": row.leaks}
    return found | {"different_hits": row.different}


def plot(study: HierarchiesStudy, target: str | Path | IO[bytes], title: str = "") -> int:
    """Draw the study as a PNG picture: memory, cost, tests and rays a second.

    Target, title, result and errors are those of `plots.plot_study`.
    """
    figure = require_plots().Figure(figsize=(14, 9), dpi=110, layout="constrained")
    memory, cost, boxes, triangles, rate, build = figure.subplots(2, 3, sharey=True).reshape(-1)
    rows, count = study.rows, study.triangles
    _plot_memory(memory, study)
    _bars(cost, rows, [[row.cost for row in rows]], ["#1b6ca8"])
    cost.set_title("expected cost over a full SAH tree's", fontsize=10)
    for axes, name, what in (
        (boxes, "boxes", "boxes, planes, slabs tested by a ray"),
        (triangles, "triangles", "triangles tested by a ray"),
    ):
        _bars(axes, rows, [[getattr(r.rays[k], name) for r in rows] for k in range(len(RAY_KINDS))], _COLOURS)
        axes.set_title(what, fontsize=10)
    _bars(rate, rows, [[r.rays[k].rate / 1e6 for r in rows] for k in range(len(RAY_KINDS))], _COLOURS)
    rate.set_title("million rays a second, fastest run", fontsize=10)
    _bars(build, rows, [[row.build_seconds for row in rows]], ["#1b6ca8"])
    build.set_title("build, seconds", fontsize=10)
    legend_below(rate, columns=3, labels=RAY_KINDS)
    name_rows(memory, [row.name for row in rows])
    figure.suptitle(titled(title, f"{count:,} triangles under each hierarchy"))
    return save_figure(figure, target)


def _plot_memory(axes: "Axes", study: HierarchiesStudy) -> None:
    place = np.arange(len(study.rows))
    own = [row.hierarchy_bytes / study.triangles for row in study.rows]
    whole = [(row.file_bytes or 0) / study.triangles for row in study.rows]
    axes.barh(place, whole, 0.72, color=LIGHT)
    axes.barh(place, own, 0.72, color="#1b6ca8")
    for y, (part, total) in enumerate(zip(own, whole, strict=True)):
        text = f" {part:.3g} of {total:.3g}" if total else f" {part:.3g}, no file"
        axes.annotate(text, (max(part, total), y), va="center", fontsize=7)
    axes.set_title("bytes per triangle: hierarchy (blue) of file", fontsize=10)
    axes.margins(x=0.3)


def _bars(
    axes: "Axes",
    rows: tuple[HierarchyRow, ...],
    groups: list[list[float]],
    colours: tuple[str, ...] | list[str],
) -> None:
    """Bars of each row, one for each group, with what they say."""
    place, width = np.arange(len(rows)), 0.8 / len(groups)
    for number, (values, colour) in enumerate(zip(groups, colours, strict=True)):
        at = place + width * (number - (len(groups) - 1) / 2)
        axes.barh(at, values, 0.9 * width, color=colour)
        for y, value in zip(at, values, strict=True):
            axes.annotate(f" {value:.3g}", (value, y), va="center", fontsize=7)
    axes.margins(x=0.15)
