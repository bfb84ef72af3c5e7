"""What strips are worth: how long, how many vertices and indices, how compact, and what a ray pays for them.

All of it is read from a scene as it is stored, so a strip that was cut by a block counts as cut. Costs and
areas are those of the one cost model, partition/sah.py, in node visits and in parts of the root's area.

Cost: O(n log n) time, that of the full tree to compare with; about 200 bytes a triangle.
"""

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from striptools.hierarchies.in_strip import BinaryTree, expand_hierarchy
from striptools.hierarchies.strip_bvh import build_block_hierarchy
from striptools.partition.boxes import face_boxes, node_boxes, range_boxes
from striptools.partition.object_split import split_objects
from striptools.partition.sah import PartitionOptions, expected_cost, half_area
from striptools.reducem.scene import Scene
from striptools.strips.ordering import Sequences
from striptools.strips.topology import RESTART, Strips, classic_strips
from striptools.types import Bools, Boxes, Counts, FaceIds, RayVectors

if TYPE_CHECKING:
    from striptools.trace import Tracer


@dataclass(frozen=True)
class StripQuality:
    """Figures of a scene's strips.

    Attributes:
        triangles: Triangles in all strips.
        strips: Strips.
        singletons: Strips of one triangle.
        longest: Triangles of the longest strip.
        lengths: How many strips have from `k` to `2 k - 1` triangles, by k = 1, 2, 4, ...
        vertices_per_triangle: Entries of the strips over triangles: a strip of n triangles has n + 2.
        swaps: Equal turns in a row: each is a vertex to repeat where strips have to alternate.
        classic_indices: Indices of the strips written as classic ones, cut at flips, over triangles,
            everything counted: swaps, restarts and whatever else `classic_strips` needs.
        classic_indices_without_restarts: The same less the restarts.
        strip_area: Half surface area of all strips' boxes, over that of the root's: how many strips a ray
            that meets the root's box is expected to enter.
        half_strip_area: The same of the two halves into which the implicit hierarchy splits each strip of two
            triangles and more.
        half_share: half_strip_area over strip_area of the same strips, at most 2: there each half's box is as
            large as its strip's, and the implicit hierarchy gains nothing by it.
        cost: Expected cost of a ray through binary hierarchies, one triangle a leaf, in node visits: SAH
            trees over the blocks and over the strips of each block, balanced ones inside the strips.
        full_cost: The same through a full SAH tree over the triangles, one a leaf, in node visits.
        relative_cost: cost / full_cost.
    """

    triangles: int
    strips: int
    singletons: int
    longest: int
    lengths: dict[int, int] = field(repr=False)
    vertices_per_triangle: float
    swaps: int
    classic_indices: float
    classic_indices_without_restarts: float
    strip_area: float
    half_strip_area: float
    half_share: float
    cost: float
    full_cost: float

    @property
    def relative_cost(self) -> float:
        """Expected cost over that of a full SAH tree."""
        return self.cost / self.full_cost


def strip_quality(
    scene: Scene,
    options: PartitionOptions | None = None,
    *,
    full_cost: float | None = None,
    threads: int = 1,
) -> StripQuality:
    """Measure the strips of a scene.

    Args:
        scene: Any scene.
        options: Those of the full tree; the defaults of PartitionOptions when left out.
        full_cost: What `full_tree_cost` gave for the same triangles, where it is known already.
        threads: Threads of the full tree's split.
    """
    boxes = face_boxes(scene.positions, scene.faces())
    lengths = np.diff(scene.starts)
    tree = quality_tree(scene, boxes, threads=threads)
    if full_cost is None:
        full_cost = full_tree_cost(boxes, options, threads=threads)
    strip_area, half_area_, half_share = _areas(boxes, scene.starts)
    indices, restarts = _classic(scene)
    return StripQuality(
        triangles=scene.triangle_count,
        strips=scene.strip_count,
        singletons=int((lengths == 1).sum()),
        longest=int(lengths.max()),
        lengths=length_histogram(lengths),
        vertices_per_triangle=len(scene.vertices) / scene.triangle_count,
        swaps=count_swaps(scene.turns, scene.starts),
        classic_indices=indices / scene.triangle_count,
        classic_indices_without_restarts=(indices - restarts) / scene.triangle_count,
        strip_area=strip_area,
        half_strip_area=half_area_,
        half_share=half_share,
        cost=expected_cost(tree.boxes, tree.size),
        full_cost=full_cost,
    )


def quality_tree(scene: Scene, triangle_boxes: Boxes, *, threads: int = 1) -> BinaryTree:
    """The binary tree that `StripQuality.cost` is the cost of; arguments as for `in_strip_tree`."""
    return in_strip_tree(scene, triangle_boxes, threads=threads)[1]


def in_strip_tree(scene: Scene, triangle_boxes: Boxes, *, threads: int = 1) -> tuple[FaceIds, BinaryTree]:
    """The implicit trees inside strips, balanced, under SAH trees over strips and blocks.

    Args:
        scene: Of at least one triangle.
        triangle_boxes: (n, 6) float32, in file order.
        threads: Threads of the split over blocks.

    Returns:
        (n,) int32, the triangle in file order that each leaf has; and the tree, one triangle a leaf.
    """
    lengths = np.diff(scene.starts)
    block_strips = np.searchsorted(scene.starts, scene.block_starts).astype(np.int32)
    strip_boxes = range_boxes(triangle_boxes, scene.starts)
    given = (strip_boxes, lengths, block_strips, PartitionOptions())
    order, hierarchy = build_block_hierarchy(*given, threads=threads)
    places = Sequences(np.arange(len(triangle_boxes), dtype=np.int32), scene.starts).reordered(order)
    return places.faces, expand_hierarchy(hierarchy, places.starts, triangle_boxes[places.faces])


def length_histogram(lengths: Counts) -> dict[int, int]:
    """How many of the lengths, each 1 or more, are from k to 2 k - 1, by k = 1, 2, 4, ..."""
    if len(lengths) == 0:
        return {}
    # frexp is exact where log2 is not: lengths are 0.5 <= m < 1 times 2**e.
    counts = np.bincount(np.frexp(lengths.astype(np.float64))[1] - 1)
    return {1 << e: int(count) for e, count in enumerate(counts)}


def count_swaps(turns: Bools, starts: Counts) -> int:
    """Count equal turns in a row.

    Args:
        turns: (n,) bool; those of first triangles are not looked at.
        starts: (s+1,) int32, the first triangle of each strip, then n.
    """
    equal = turns[1:] == turns[:-1]
    # A turn is compared with the one before it, so the first two triangles of a strip have none to compare.
    firsts = starts[:-1]
    equal[firsts[firsts > 0] - 1] = False
    equal[firsts[firsts < len(equal)]] = False
    return int(equal.sum())


def full_tree_cost(
    triangle_boxes: Boxes, options: PartitionOptions | None = None, *, threads: int = 1
) -> float:
    """Expected cost of a ray through a full binned SAH tree with one triangle a leaf, in node visits.

    Args:
        triangle_boxes: (n, 6) float32, n >= 1.
        options: Those of the split; the defaults of PartitionOptions when left out.
        threads: Threads of the split.
    """
    tree = split_objects(triangle_boxes, options, threads=threads)
    return expected_cost(node_boxes(tree, triangle_boxes), tree.size)


def traversal_steps(tracer: "Tracer", origins: RayVectors, directions: RayVectors) -> float:
    """How many wide nodes and leaves a ray visits before its closest hit is sure, on the average.

    Args:
        tracer: Of the scene to measure.
        origins: (r, 3).
        directions: (r, 3), r >= 1.
    """
    counters = tracer.closest_hit(origins, directions, counters=True).counters
    if counters is None or len(origins) == 0:
        return 0.0
    return float(counters.steps.mean(dtype=np.float64))


def _areas(boxes: Boxes, starts: Counts) -> tuple[float, float, float]:
    """Area of the strips, of their halves, and the halves' over that of the strips that have halves."""
    root = float(half_area(range_boxes(boxes, np.array([0, len(boxes)])))[0])
    strips = half_area(range_boxes(boxes, starts))
    whole = np.diff(starts) > 1
    first, after = starts[:-1][whole], starts[1:][whole]
    # The larger half comes first, as in hierarchies/in_strip.py.
    middle = first + (after - first + 1) // 2
    halves = 0.0
    for begin, end in ((first, middle), (middle, after)):
        halves += float(half_area(_spans(boxes, begin, end)).sum())
    split = float(strips[whole].sum())
    unit = root if root > 0.0 else 1.0
    return float(strips.sum()) / unit, halves / unit, halves / split if split > 0.0 else 1.0


def _spans(boxes: Boxes, begin: Counts, end: Counts) -> Boxes:
    """The boxes round the ranges begin:end, which rise and do not overlap but may leave gaps."""
    if len(begin) == 0:
        return np.zeros((0, 6), np.float32)
    edges = np.stack([begin, end], axis=1).reshape(-1)
    # reduceat runs the last range to the end of the array, so it is cut there.
    boxes = boxes[: edges[-1]]
    lo = np.minimum.reduceat(boxes[:, :3], edges[:-1], axis=0)[::2]
    hi = np.maximum.reduceat(boxes[:, 3:], edges[:-1], axis=0)[::2]
    return np.concatenate([lo, hi], axis=1)


def _classic(scene: Scene) -> tuple[int, int]:
    """Indices of the scene's strips written as classic ones, and how many of these are restarts."""
    # A vertex of several blocks is one vertex to a classic strip.
    strips = Strips(
        scene.leaders[scene.vertices],
        scene.turns,
        scene.starts,
        np.arange(scene.triangle_count, dtype=np.int32),
        np.zeros(scene.triangle_count, np.uint8),
        scene.flips,
    )
    indices = classic_strips(strips)
    return len(indices), int((indices == RESTART).sum())
