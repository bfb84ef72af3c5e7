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
5. Nodes are numbered in preorder by size alone, so ids do not depend on threads or schedule.

Cost: O(n log n) time in practice; 63 bytes an item of working memory beside the tree's 24.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from striptools.errors import LimitError, UsageError
from striptools.kernels import object_split as kernels
from striptools.partition.sah import PartitionOptions
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
    check_boxes(boxes)
    count = len(boxes)
    weights = _checked_weights(weights, count)
    work = kernels.Work(
        items=np.arange(count, dtype=np.int32),
        boxes=np.array(boxes, np.float32, order="C"),
        weights=weights,
        side=np.zeros((count, 3), np.uint8),
        spare_items=np.zeros(count, np.int32),
        spare_boxes=np.zeros((count, 6), np.float32),
        spare_weights=np.zeros(count, np.int32),
    )
    tree = kernels.Tree(
        leaf_node=np.zeros(count, np.int32),
        parent=np.full(2 * count - 1, -1, np.int32),
        size=np.zeros(2 * count - 1, np.int32),
    )
    _split_in_threads(work, tree, options, threads)
    return ObjectTree(work.items, tree.leaf_node, tree.parent, tree.size)


def check_boxes(boxes: Boxes) -> None:
    """Raise unless boxes are what split_objects takes: at least one, finite, not inverted.

    Raises:
        UsageError: Naming the first bad box.
        LimitError: More than LARGEST_ITEMS boxes.
    """
    if boxes.ndim != 2 or boxes.shape[1] != 6 or len(boxes) == 0:
        raise UsageError(
            f"boxes have shape {boxes.shape}", where="split_objects", remedy="give (n, 6), n >= 1"
        )
    if len(boxes) > LARGEST_ITEMS:
        raise LimitError(f"{len(boxes)} items", where="split_objects", remedy=f"give at most {LARGEST_ITEMS}")
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


def _checked_weights(weights: Counts | None, count: int) -> Counts:
    if weights is None:
        return np.ones(count, np.int32)
    if len(weights) != count or weights.min() < 1:
        raise UsageError("weights must be >= 1, one an item", where="split_objects")
    return np.array(weights, np.int32)


def _split_in_threads(
    work: kernels.Work, tree: kernels.Tree, options: PartitionOptions, threads: int
) -> None:
    """Split the top here until the ranges are small enough to share out, then those in a pool."""
    count = len(work.items)
    limits = (options.bins, options.sweep_below, SAH_DEPTH)
    grain = 0 if threads <= 1 else max(SMALLEST_JOB, count // (8 * threads))
    # A range over `grain` has ranges of at least one item below it, so jobs never outnumber the items.
    jobs = np.zeros((count if grain else 1, 4), np.int64)
    found = kernels.split_ranges(work, tree, 0, 0, count, 0, *limits, grain, jobs)
    if not found:
        return

    def split_job(job: list[int]) -> int:
        node, begin, end, depth = job
        return kernels.split_ranges(work, tree, node, begin, end, depth, *limits, 0, jobs)

    with ThreadPoolExecutor(threads) as pool:
        list(pool.map(split_job, jobs[:found].tolist()))


def _expect(holds: bool, what: str) -> None:
    if not holds:
        raise UsageError(what, where="object tree")
