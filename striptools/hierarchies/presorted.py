"""Presorted geometry: a tree whose bounds are its own triangles, under a few levels of plain nodes.

Source: Eisemann, Bauszat, Guthe, Magnor, "Geometry Presorting for Implicit Object Space Partitioning" (EGSR
2012). Each node owns two triangles, which span it on one axis, x for a root and then in turn; the other
triangles are halved, and so on. Nodes stand breadth first, left-packed: the node at triangle i of a tree owns
i and i+1, and its children are at 2i+2 and 2i+4. Nothing but the order of triangles is stored.

Two-level (the paper's additional material): the first n levels are plain nodes of 32 bytes by the surface
area heuristic, at most (2**n - 1) * 32 bytes, and each of their leaves is a presorted tree.

Differences and decisions:

1. Of the triangles that begin first on the axis the one that ends last is owned, then the one of least
   number; then, of the others, that which ends last. Where the first spans both planes the second is
   therefore the one that reaches farthest of the rest.
2. The rest is halved by centre on the axis of the children: what cuts them apart is what their own slabs
   tell. Equal centres go by number.
3. "Halves" are the shares of a left-packed heap: all levels but the last are full, and where the count is
   odd the last node owns one triangle.
4. A plain node over two triangles or fewer is a leaf whatever its level: one presorted node owns them.

Cost: O(n log n) time; 29 bytes a triangle of room beside the boxes, and 56 of the SAH tree where there are
levels. The order is the same for any number of threads.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from striptools.errors import LimitError, UnreadableSceneError
from striptools.hierarchies.options import HierarchyOptions
from striptools.kernels import presorted as kernels
from striptools.kernels.hierarchy import boxes_from_below
from striptools.partition.object_split import LARGEST_DEPTH, check_boxes, split_objects
from striptools.threads import in_parts, run_jobs
from striptools.types import Boxes, Counts

__all__ = [
    "EVERY_LEVEL",
    "NODE_BYTES",
    "Presorted",
    "build_presorted",
    "check_presorted",
    "level_limit",
    "presort",
    "tree_depth",
]

TriangleCorners = Float32[np.ndarray, "n 3 3"]
"""Corners of triangles: triangle, corner, axis."""

NODE_BYTES = 32
EVERY_LEVEL = LARGEST_DEPTH + 1

MOST_TRIANGLES = 2**29
"""A place and an axis still fit 31 bits."""

SMALLEST_JOB = 4096
"""Ranges of fewer triangles than this are not worth a thread's attention."""


@dataclass(frozen=True, eq=False)
class Presorted:
    """The part of a presorted scene that is not its triangles in their order.

    Attributes:
        nodes: (t, 8) uint32, the plain SAH nodes above in preorder, the root first; none where there are no
            levels. The bits of the box's low and high corner (six float32), then of an inner node the place
            of its second child (the first follows it) and 0, of a leaf the first triangle of its tree and how
            many there are.
        starts: (r+1,) int32, the first triangle of each presorted tree below them, then how many triangles
            there are; a scene without levels is one tree.
    """

    nodes: np.ndarray
    starts: np.ndarray

    @property
    def leaf_places(self) -> np.ndarray:
        """(r,) intp: the plain nodes that are leaves, in the order of their trees; none without levels."""
        return np.flatnonzero(self.nodes[:, 7])


def level_limit(levels: int) -> int:
    """The most bytes that so many levels of plain nodes can take."""
    return (2**levels - 1) * NODE_BYTES


def build_presorted(
    corners: TriangleCorners, options: HierarchyOptions | None = None, threads: int = 1
) -> tuple[Counts, Presorted]:
    """Sort triangles so that their order is a hierarchy.

    Args:
        corners: (n, 3, 3) float32, finite, n >= 1: the corners of each triangle.
        options: How many `levels` of plain nodes stand above; the defaults of HierarchyOptions when left out.
        threads: How many threads share the work; the order is the same for any number.

    Returns:
        order (n,) int32, the triangle, in the order given, that goes to each place; and what stands above.

    Raises:
        UsageError: No triangle, or one with a coordinate that is not finite.
        LimitError: 2**29 triangles or more.
    """
    return presort(corners, (options or HierarchyOptions("presorted")).levels, threads)


def presort(corners: TriangleCorners, levels: int, threads: int = 1) -> tuple[Counts, Presorted]:
    """`build_presorted` with any number of plain levels: with `EVERY_LEVEL` a whole SAH tree stands above."""
    boxes = _boxes(corners)
    check_boxes(boxes)
    if len(boxes) >= MOST_TRIANGLES:
        raise LimitError(f"{len(boxes)} triangles", where="build_presorted", remedy="split the model")
    if levels == 0:
        given = np.arange(len(boxes), dtype=np.int32)
        found = Presorted(np.zeros((0, 8), np.uint32), np.array([0, len(boxes)], np.int32))
    else:
        given, found = _split_above(boxes, levels, threads)
        boxes = boxes[given]
    return given[_sort(boxes, found.starts, threads)], found


def tree_depth(count: int) -> int:
    """Nodes on the longest way down a presorted tree of so many triangles."""
    return ((count + 1) // 2).bit_length()


def check_presorted(presorted: Presorted, corners: TriangleCorners) -> None:
    """Make sure that every triangle is reached once and that nodes and slabs hold what is below them.

    The trees are proved by arithmetic: in a left-packed heap each node but the root has one parent, so where
    the trees' ranges cover the triangles each is owned once. Slabs hold by induction from the last node up.

    Args:
        presorted: What stands above.
        corners: (n, 3, 3) float32, n >= 1, of the triangles in their places.

    Raises:
        UnreadableSceneError: Naming the first flaw found.
    """
    boxes, starts, nodes = _boxes(corners), presorted.starts, presorted.nodes
    _require(bool(np.isfinite(boxes).all()), "a triangle's corner is not finite", 0)
    rises = len(starts) >= 2 and starts[0] == 0 and starts[-1] == len(boxes)
    _require(bool(rises and (np.diff(starts) > 0).all()), "the trees do not hold every triangle once", 0)
    if len(nodes):
        _check_links(presorted)
        _check_boxes(presorted, boxes)
    else:
        _require(len(starts) == 2, "there are several trees and no node above them", 0)
    spilled = kernels.first_spill(boxes, starts)
    if spilled >= 0:
        raise _error("a slab does not hold what is below it", f"triangle {spilled}")


def _boxes(corners: TriangleCorners) -> Boxes:
    return np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)


def _split_above(boxes: Boxes, levels: int, threads: int) -> tuple[Counts, Presorted]:
    """The first levels of a SAH tree, and the triangles in the order of its leaves."""
    tree = split_objects(boxes, threads=threads)
    node_boxes = boxes_from_below(tree.size, boxes[tree.order])
    words = np.zeros((min(2**levels - 1, len(tree.size)), 8), np.uint32)
    starts = np.zeros(min(2 ** (levels - 1), len(boxes)) + 1, np.int32)
    nodes, leaves = kernels.top_nodes(tree.size, node_boxes, levels, words, words.view(np.float32), starts)
    return tree.order, Presorted(words[:nodes].copy(), starts[: leaves + 1].copy())


def _sort(boxes: Boxes, starts: Counts, threads: int) -> Counts:
    """The triangle at each place of all trees."""
    count = len(boxes)
    tree = np.repeat(np.arange(len(starts) - 1, dtype=np.int32), np.diff(starts))
    items = np.zeros((3, count), np.int32)

    def rank(part: int, parts: int) -> None:
        for axis in range(part, 3, parts):
            centre = boxes[:, axis].astype(np.float64) + boxes[:, axis + 3]
            items[axis] = np.lexsort((centre, tree))

    in_parts(rank, count, min(threads, 3))
    order, spare, side = np.zeros(count, np.int32), np.zeros(count, np.int32), np.zeros(count, np.uint8)
    room = (boxes, items, spare, side, order)
    smallest = max(SMALLEST_JOB, count // (16 * threads))

    def sort(first: int, last: int, begin: int, end: int, node: int, axis: int) -> list[list[int]]:
        # Several trees that are large together come back as two jobs, and so do the halves of a large one.
        if last - first == 1:
            grain = end - begin - 1 if end - begin > smallest else 0
            jobs = np.zeros((2, 4), np.int64)
            found = kernels.sort_range(*room, int(starts[first]), begin, end, node, axis, grain, jobs)
            return [[first, last, *job] for job in jobs[:found].tolist()]
        if starts[last] - starts[first] <= smallest:
            kernels.sort_trees(*room, starts, first, last)
            return []
        middle = (first + last) // 2
        return [whole(first, middle), whole(middle, last)]

    def whole(first: int, last: int) -> list[int]:
        return [first, last, int(starts[first]), int(starts[last]), 0, 0]

    run_jobs(sort, tuple(whole(0, len(starts) - 1)), threads)
    return order


def _check_links(presorted: Presorted) -> None:
    """Nodes are in preorder, every one but the root the child of one, and leaves have the trees in turn."""
    second, count = presorted.nodes[:, 6].astype(np.int64), presorted.nodes[:, 7].astype(np.int64)
    nodes, starts = len(second), presorted.starts.astype(np.int64)
    waiting: list[int] = [nodes]
    for node in range(nodes):
        # The subtree at hand ends where the next one waits to begin.
        if count[node] == 0:
            _require(node + 1 < second[node] < waiting[-1], "a node's second child is out of place", node)
            waiting.append(int(second[node]))
        else:
            _require(waiting.pop() == node + 1, "a leaf does not end its subtree", node)
    _require(not waiting, "a node is not reached", nodes - 1)
    leaf = presorted.leaf_places
    fits = len(leaf) == len(starts) - 1
    fits = fits and np.array_equal(second[leaf], starts[:-1]) and np.array_equal(count[leaf], np.diff(starts))
    _require(fits, "the leaves do not have the trees in turn", 0)


def _check_boxes(presorted: Presorted, triangle_boxes: Boxes) -> None:
    """Boxes hold their children's, and those of leaves their triangles'."""
    nodes, starts = presorted.nodes, presorted.starts
    boxes, leaf = nodes[:, :6].view(np.float32), presorted.leaf_places
    low = np.minimum.reduceat(triangle_boxes[:, :3], starts[:-1])
    high = np.maximum.reduceat(triangle_boxes[:, 3:], starts[:-1])
    _check_held(boxes, leaf, low, high)
    inner = np.flatnonzero(nodes[:, 7] == 0)
    for child in (inner + 1, nodes[inner, 6].astype(np.int64)):
        _check_held(boxes, inner, boxes[child, :3], boxes[child, 3:])


def _check_held(boxes: Boxes, outer: np.ndarray, low: np.ndarray, high: np.ndarray) -> None:
    # Written so that a comparison with NaN says no.
    held = ((boxes[outer, :3] <= low) & (boxes[outer, 3:] >= high)).all(axis=1)
    for node in outer[~held][:1]:
        raise _error("a box does not hold what is below it", f"node {node}")


def _require(holds: bool, flaw: str, node: int) -> None:
    if not holds:
        raise _error(flaw, f"node {node}")


def _error(flaw: str, where: str) -> UnreadableSceneError:
    return UnreadableSceneError(flaw, where=f"presorted hierarchy, {where}", remedy="convert the model again")


# Notes. Tried and lost: a root whose axis is the one before the longest side of its tree's box, so that the
# first halving is across that side, saves 0 to 4 % of the nodes visited (bunny, chandelier, dem_jacksboro;
# 0 to 14 levels): not worth a rule that every reader would have to know.
