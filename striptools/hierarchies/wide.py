"""Wide hierarchies, of 8 or 16 children a node: the form in which the tracer walks a scene.

Ylitie, Karras & Laine, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs" (HPG 2017),
section 3.2: a dynamic programme finds, for every binary node, the cheapest way to stand for it with 1 child
to one less than a node has, and from these the wide tree of least expected cost that keeps the order of the
binary one.
Section 3.3: the lane of a child tells on which side of its parent's centre it lies, so that a ray visits
lanes front to back by an exclusive-or with its octant.

Differences:

1. A leaf is one block of up to eight triangles tested at once, so a test costs the same however many it
   holds; but one that is not full takes room in caches for those that others have to hold.
2. Lanes are given to children greedily, the best fit first, not by an auction; of sixteen, a fourth bit says
   on which side of the half along x.
3. Boxes stay float32.

Cost: O(n) time, about 40 bytes a binary node while it runs.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32, Int32

from striptools.errors import UnreadableSceneError
from striptools.hierarchies.in_strip import BinaryTree
from striptools.kernels.wide import BROAD, EMPTY, WIDTH, cheapest_forests, emit_wide
from striptools.types import Boxes, Counts

WideBoxes = Float32[np.ndarray, "w 6 k"]
WideCorners = Float32[np.ndarray, "w 3 k"]
WideChildren = Int32[np.ndarray, "w k"]

WIDE_NODE_COST = 1.0
"""Expected time of a visit to a wide node: all boxes at once."""

LEAF_BLOCK_COST = 1.0
"""Expected time of testing a leaf, in visits to a wide node: up to eight triangles at once."""

EMPTY_LANE_COST = 0.08
"""What a leaf costs more for each triangle that it might have held besides: see the notes of `rebuilt`."""


@dataclass(frozen=True, eq=False)
class WideTree:
    """A hierarchy whose nodes have up to k children and whose leaves are runs of triangles in file order.

    Attributes:
        boxes: (w, 6, k) float32, lo xyz and hi xyz of each lane's child; inverted (inf, -inf) in empty lanes.
        child: (w, k) int32, k 8 or 16: a node (>= 0, after its parent; the root is 0), a leaf q as -(q + 1),
            or `EMPTY` = -2**31.
        leaf_first: (l,) int32, the first triangle of each leaf.
        leaf_count: (l,) int32, 1 to 8 triangles of each leaf.
        depth: The most nodes on a way from the root down.
    """

    boxes: WideBoxes
    child: WideChildren
    leaf_first: Counts
    leaf_count: Counts
    depth: int


class Forests(NamedTuple):
    """The cheapest way to stand for each node of a binary hierarchy; see `kernels.wide.cheapest_forests`.

    Attributes:
        split: (2n-1, k + 1) int8.
        as_leaf: (2n-1,) bool, a node alone is cheapest as a leaf.
        cost: The expected cost of the whole tree for a ray that meets the root's box.
    """

    split: np.ndarray
    as_leaf: np.ndarray
    cost: float


def cheapest(tree: BinaryTree, leaf_size: int = WIDTH, width: int = WIDTH) -> Forests:
    """Find the wide hierarchy of least expected cost.

    Args:
        tree: A preorder hierarchy over n >= 1 triangles in file order.
        leaf_size: The most triangles of a leaf, 1 to 8.
        width: Children of a node, 8 or 16.
    """
    costs = (np.float32(each) for each in (WIDE_NODE_COST, LEAF_BLOCK_COST, EMPTY_LANE_COST, 0))
    split, as_leaf, cost = cheapest_forests(tree.boxes, tree.size, width, leaf_size, *costs)
    return Forests(split, as_leaf, float(cost))


def collapse(tree: BinaryTree, leaf_size: int = WIDTH, width: int = WIDTH) -> WideTree:
    """Collapse a binary hierarchy, given as to `cheapest`, to the wide one of least expected cost."""
    return emit(tree, cheapest(tree, leaf_size, width))


def emit(tree: BinaryTree, forests: Forests) -> WideTree:
    """Lay out the wide hierarchy that `cheapest` found."""
    split, as_leaf, _ = forests
    boxes, child, first, count, depth = emit_wide(tree.boxes, tree.size, split, as_leaf)
    return WideTree(boxes, child, first, count, int(depth))


def check_wide_tree(tree: WideTree, triangle_boxes: Boxes) -> None:
    """Make sure that every triangle is in one leaf, boxes hold what is below them, and no way goes round.

    Args:
        tree: What to check.
        triangle_boxes: (n, 6) float32, the boxes of the triangles in file order.

    Raises:
        UnreadableSceneError: Naming the first flaw found.
    """
    _check_links(tree)
    _check_cover(tree, len(triangle_boxes))
    low, high = _held_boxes(tree, triangle_boxes)
    empty = tree.child == EMPTY
    fits = ((tree.boxes[:, :3] <= low) & (tree.boxes[:, 3:] >= high)).all(axis=1)
    _require(bool((fits | empty).all()), "a box does not hold what is below it")
    inverted = (tree.boxes[:, :3] > tree.boxes[:, 3:]).all(axis=1)
    _require(
        bool((inverted == empty).all()), "a box is inverted where there is a child, or not where none is"
    )


def _check_links(tree: WideTree) -> None:
    """Every node but the root, and every leaf, is the child of one node, which comes before it."""
    child = tree.child.ravel()
    lanes = np.flatnonzero(child >= 0)
    nodes = child[lanes]
    _require(np.array_equal(np.sort(nodes), np.arange(1, len(tree.child))), "a node has not one parent")
    _require(bool((nodes > lanes // tree.child.shape[1]).all()), "a node comes before its parent")
    leaves = -(child[(child < 0) & (child != EMPTY)] + 1)
    _require(np.array_equal(np.sort(leaves), np.arange(len(tree.leaf_first))), "a leaf has not one parent")


def _check_cover(tree: WideTree, triangles: int) -> None:
    """The leaves hold 1 to 8 triangles each, and every triangle once."""
    count = tree.leaf_count
    _require(bool(((count >= 1) & (count <= WIDTH)).all()), "a leaf does not hold 1 to 8 triangles")
    order = np.argsort(tree.leaf_first, kind="stable")
    ends = np.cumsum(count[order])
    starts_right = np.array_equal(tree.leaf_first[order], ends - count[order])
    _require(starts_right and int(count.sum()) == triangles, "the leaves do not hold every triangle once")


def _held_boxes(tree: WideTree, triangle_boxes: Boxes) -> tuple[WideCorners, WideCorners]:
    """What each lane's box has to hold: its leaf's triangles, or the boxes of its node's lanes."""
    order = np.argsort(tree.leaf_first, kind="stable")
    starts = tree.leaf_first[order]
    leaf_low = np.zeros((len(order), 3), np.float32)
    leaf_high = np.zeros((len(order), 3), np.float32)
    leaf_low[order] = np.minimum.reduceat(triangle_boxes[:, :3], starts)
    leaf_high[order] = np.maximum.reduceat(triangle_boxes[:, 3:], starts)
    inner = np.maximum(tree.child, 0)
    leaf = np.where((tree.child < 0) & (tree.child != EMPTY), -(tree.child + 1), 0)
    is_inner = (tree.child >= 0)[..., None]
    low = np.where(is_inner, tree.boxes[:, :3].min(axis=2)[inner], leaf_low[leaf])
    high = np.where(is_inner, tree.boxes[:, 3:].max(axis=2)[inner], leaf_high[leaf])
    return np.moveaxis(low, 2, 1), np.moveaxis(high, 2, 1)


def _require(holds: bool, flaw: str) -> None:
    if not holds:
        raise UnreadableSceneError(flaw, where="wide hierarchy", remedy="convert the model again")


__all__ = [
    "BROAD",
    "EMPTY",
    "WIDTH",
    "Forests",
    "WideTree",
    "cheapest",
    "check_wide_tree",
    "collapse",
    "emit",
]
