"""Recursive SAH object split of boxed items down to ONE item a leaf, with the inverse map from item to leaf.

Source: Lauterbach, Yoon, Tang, Manocha, "ReduceM: Interactive and Memory Efficient Ray Tracing of Large
Models" (EGSR 2008), step "Partitioning"; the binned search is Wald's ("On fast Construction of SAH-based
Bounding Volume Hierarchies", RT 2007). The cost model is partition/sah.py.

Differences and decisions:
1. Large ranges are searched by bins on all three axes, ranges below `sweep_below` items exactly.
2. A range goes down to one item whatever that costs: the split of least area(left) * weight(left) +
   area(right) * weight(right) is taken; first axis, then first place among equals.
3. Ranges whose centres are all equal are halved, the first half (the larger one of an odd count) to the left.
4. Ranges at depth SAH_DEPTH or deeper are halved too, so that no input makes a tree deeper than
   LARGEST_DEPTH.
5. With `block` set, ranges of more than one block and up to ALIGNED_BLOCKS are swept exactly over the places
   that ask for no block more: ceil(left / block) + ceil(right / block) = ceil(all / block). Blocks cut from
   the tree (partition/cut.py) are then filled to 94 % instead of 68 % (dragon, blocks of 256).
6. Nodes are numbered in preorder by size alone, so ids do not depend on threads or schedule.

Cost: O(n log n) time in practice; 32 bytes an item of working memory beside the tree's 24, and up to 32 more
for the right sides of the ranges in work, before most of the tree is touched.
"""

from dataclasses import dataclass

import numpy as np

from striptools.errors import LimitError, UsageError
from striptools.kernels import object_split as kernels
from striptools.partition.sah import PartitionOptions
from striptools.threads import in_chunks, run_jobs
from striptools.types import Boxes, Counts

LARGEST_ITEMS = 2**30
"""Node ids of a tree over this many items still fit int32."""

SAH_DEPTH = 96
LARGEST_DEPTH = SAH_DEPTH + 30
"""No leaf lies deeper than this below the root (depth 0): SAH_DEPTH, then log2(LARGEST_ITEMS) halvings."""

SMALLEST_JOB = 4096
"""Ranges of fewer items than this are not worth a thread's attention."""


@dataclass(frozen=True)
class ObjectTree:
    """A binary tree over n items, one item a leaf, its 2n-1 nodes in preorder.

    A node over k items owns 2k-1 consecutive nodes from its own id p on: its left child is p + 1, its right
    child p + 2 * size[p + 1]. Node 0 is the root. The leaves stand in the order of `order`. `a` is an
    ancestor of `b` (or `b` itself) exactly when a <= b < a + 2 * size[a] - 1.

    Attributes:
        order: (n,) int32, the item at each leaf from left to right.
        leaf_node: (n,) int32, the leaf of each ITEM (the inverse map).
        parent: (2n-1,) int32, -1 for the root.
        size: (2n-1,) int32, items below each node.
    """

    order: Counts
    leaf_node: Counts
    parent: Counts
    size: Counts

    @property
    def depth(self) -> Counts:
        """(2n-1,) int32: inner nodes above each node; computed on each call."""
        return kernels.depths(self.parent)


def split_objects(
    boxes: Boxes,
    options: PartitionOptions | None = None,
    weights: Counts | None = None,
    threads: int = 1,
) -> ObjectTree:
    """Split items recursively by the surface area heuristic, down to one item a leaf.

    Args:
        boxes: (n, 6) float32, finite, lo <= hi, n >= 1.
        options: Bins and sweep limit; the defaults of PartitionOptions when left out.
        weights: (n,) int32 >= 1, what each item costs to test (a strip: its triangles); 1 each when left out.
        threads: How many threads share the work; the tree is the same for any number.

    Returns:
        The tree, for which `check_object_tree` holds.

    Raises:
        UsageError: No item, boxes that are not finite or inverted, or weights below 1.
        LimitError: More than LARGEST_ITEMS items.
    """
    options = options or PartitionOptions()
    _check_shape(boxes)
    if weights is not None and len(weights) != len(boxes):
        raise UsageError("weights must be >= 1, one an item", where="split_objects")
    count = len(boxes)
    rows = _make_rows(boxes, weights, threads)
    tree = kernels.Tree(
        order=np.zeros(count, np.int32),
        leaf_node=np.zeros(count, np.int32),
        parent=np.zeros(2 * count - 1, np.int32),
        size=np.zeros(2 * count - 1, np.int32),
    )
    tree.parent[0] = -1
    _split_in_threads(rows, tree, options, threads)
    return ObjectTree(*tree)


def check_boxes(boxes: Boxes) -> None:
    """Raise unless boxes are what split_objects takes: at least one, finite, not inverted.

    Raises:
        UsageError: Naming the first bad box.
        LimitError: More than LARGEST_ITEMS boxes.
    """
    _check_shape(boxes)
    with np.errstate(invalid="ignore"):
        bad = ~(np.isfinite(boxes).all(axis=1) & (boxes[:, :3] <= boxes[:, 3:]).all(axis=1))
    if bad.any():
        row = int(bad.argmax())
        raise UsageError(
            f"box {row} is not finite or inverted: {boxes[row].tolist()}",
            where="split_objects",
            remedy="clean the mesh first",
        )


def check_object_tree(tree: ObjectTree) -> None:
    """Raise unless the tree is whole: each item once, preorder sizes and parents, and the inverse map.

    Raises:
        UsageError: Naming the first broken node or item.
    """
    count, nodes = len(tree.order), len(tree.size)
    _expect(count >= 1 and nodes == 2 * count - 1, f"{nodes} nodes over {count} items")
    _expect(len(tree.leaf_node) == count and len(tree.parent) == nodes, "arrays of unequal length")
    _expect(np.array_equal(np.sort(tree.order), np.arange(count)), "order is no permutation of the items")
    node = kernels.first_broken_node(tree.parent, tree.size)
    _expect(node < 0, f"node {node} breaks the preorder layout")
    leaves = np.flatnonzero(tree.size == 1)
    wrong = np.flatnonzero(tree.leaf_node[tree.order] != leaves)
    _expect(len(wrong) == 0, f"the inverse map of the item at position {wrong[:1]} misses its leaf")


def _check_shape(boxes: Boxes) -> None:
    if boxes.ndim != 2 or boxes.shape[1] != 6 or len(boxes) == 0:
        raise UsageError(
            f"boxes have shape {boxes.shape}", where="split_objects", remedy="give (n, 6), n >= 1"
        )
    if len(boxes) > LARGEST_ITEMS:
        raise LimitError(f"{len(boxes)} items", where="split_objects", remedy=f"give at most {LARGEST_ITEMS}")


def _make_rows(boxes: Boxes, weights: Counts | None, threads: int) -> kernels.Rows:
    """The working rows of all items; the kernel that writes them also finds what cannot be split."""
    words = np.zeros((len(boxes), 4), np.uint64)
    rows = kernels.Rows(words.view(np.float32), words.view(np.int32), words)
    boxes = np.ascontiguousarray(boxes, np.float32)
    shares = np.zeros(0, np.int32) if weights is None else np.ascontiguousarray(weights, np.int32)
    bad = in_chunks(lambda part: kernels.fill_rows(boxes, shares, *part, rows), len(boxes), threads)
    item = next((item for item in bad if item >= 0), -1)
    if item >= 0:
        check_boxes(boxes[: item + 1])
        raise UsageError(f"item {item} weighs {shares[item]}: weights must be >= 1", where="split_objects")
    return rows


def _split_in_threads(
    rows: kernels.Rows, tree: kernels.Tree, options: PartitionOptions, threads: int
) -> None:
    """Split range by range in a pool while they are large, then each down to single items."""
    count = len(rows.words)
    limits = (options.bins, options.sweep_below, SAH_DEPTH, options.block or 0)
    smallest = max(SMALLEST_JOB, count // (16 * threads))

    def split(node: int, begin: int, end: int, depth: int) -> list[list[int]]:
        # A large range is split once and its halves come back as jobs, for any thread that is free; its room
        # for right sides is given back before the tree grows.
        grain = end - begin - 1 if end - begin > smallest else 0
        jobs = np.zeros((2, 4), np.int64)
        found = kernels.split_ranges(rows, tree, node, begin, end, depth, *limits, grain, jobs)
        return jobs[:found].tolist()

    run_jobs(split, (0, 0, count, 0), threads)


def _expect(holds: bool, what: str) -> None:
    if not holds:
        raise UsageError(what, where="object tree")


# Notes. Stanford dragon (871,306 faces), milliseconds of processor time, one thread, before and after rows
# that move with their boxes: boxes 43 / 6, split 630 / 395, hierarchy over 22,700 strips 54 / 19; the same
# trees. By size of the ranges: below 13 items 220 / 95; 13 to 64 items 110 / 85; more 300 / 245. What gave
# most: short ranges ranked on all axes once and never moved (counting ranks takes a quarter of the time of
# insertion, whose branches nobody can predict); a row of 32 bytes instead of three arrays and a table of
# sides; the bounds of the children's centres taken while they are moved; empty bins passed over (a tenth);
# `forceinline`, for a call costs two atomic counts for each array it is given. Two threads: 290 with the
# boxes while others took a part of the machine. Tried and lost: LLVM's SLP vectoriser (15 % for the old
# loops, nothing sure for these, and it is a setting of the whole process). Not tried: one binning pass by
# several threads; halves are jobs, so that only the root is split by one thread alone.
# Aligned ranges are sorted by a merge sort of ours: compiling NumPy's took more than half a second.
