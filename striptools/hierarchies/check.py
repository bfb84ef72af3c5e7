"""Proofs that a hierarchy may be trusted: every leaf reached once, every box holding what is below it.

The binary trees here are proved locally. Where each inner node splits its items into two non-empty parts
whose sizes add up, and the root has them all, preorder leaves no choice: each item is one leaf, reached from
the root once. Where each box holds the boxes of both children, it holds everything below, by induction.
"""

import numpy as np

from striptools.errors import UnreadableSceneError
from striptools.hierarchies.in_strip import BinaryTree
from striptools.hierarchies.strip_bvh import StripHierarchy
from striptools.kernels.hierarchy import strip_ranges
from striptools.types import Bools, Boxes

__all__ = ["check_binary_tree", "check_strip_hierarchy", "strip_hierarchy_flaw"]

WRONG_SIZE = "does not have a node for each strip but one"
EMPTY_CHILD = "has a node with an empty child"
NOT_FINITE = "has a box that is not finite"
NOT_HELD = "has a box that does not hold what is below it"


def strip_hierarchy_flaw(hierarchy: StripHierarchy, strip_boxes: Boxes) -> tuple[str, int] | None:
    """Find the first flaw of a hierarchy over strips.

    Args:
        hierarchy: The hierarchy in question.
        strip_boxes: (s, 6) float32 boxes of the strips' decoded vertices, s >= 1.

    Returns:
        One of this module's flaws and the node that has it; None where there is none.
    """
    strips = len(strip_boxes)
    left = hierarchy.left_count
    if len(left) != strips - 1 or hierarchy.boxes.shape != (strips - 1, 6):
        return WRONG_SIZE, 0
    node = _first(np.logical_not(np.isfinite(hierarchy.boxes).all(axis=1)))
    if node >= 0:
        return NOT_FINITE, node
    first, count, broken = strip_ranges(left, strips)
    if broken >= 0:
        return EMPTY_CHILD, int(broken)
    places, lefts = np.arange(strips - 1), left.astype(np.int64)
    node = _first(
        _spills(hierarchy, strip_boxes, places + 1, lefts, first)
        | _spills(hierarchy, strip_boxes, places + lefts, count - lefts, first + lefts)
    )
    return None if node < 0 else (NOT_HELD, node)


def check_strip_hierarchy(hierarchy: StripHierarchy, strip_boxes: Boxes) -> None:
    """Make sure that a hierarchy reaches each strip once and that its boxes hold what is below them.

    Args:
        hierarchy: The hierarchy in question.
        strip_boxes: (s, 6) float32 boxes of the strips' decoded vertices, s >= 1.

    Raises:
        UnreadableSceneError: Naming the first flaw found.
    """
    flaw = strip_hierarchy_flaw(hierarchy, strip_boxes)
    if flaw is not None:
        raise _error(f"the hierarchy over strips {flaw[0]}", flaw[1])


def check_binary_tree(tree: BinaryTree, triangle_boxes: Boxes) -> None:
    """Make sure that a tree reaches each triangle once and that its boxes hold what is below them.

    Args:
        tree: The tree in question.
        triangle_boxes: (n, 6) float32 boxes of the decoded triangles in file order, n >= 1.

    Raises:
        UnreadableSceneError: Naming the first flaw found.
    """
    size, boxes, nodes = tree.size.astype(np.int64), tree.boxes, 2 * len(triangle_boxes) - 1
    if len(size) != nodes or boxes.shape != (nodes, 6) or size[0] != len(triangle_boxes):
        raise _error("the tree over triangles has not one leaf a triangle", 0)
    inner = np.flatnonzero(size != 1)
    left = np.minimum(inner + 1, nodes - 1)
    right = inner + 2 * size[left]
    inside = (size[inner] > 1) & (size[left] >= 1) & (size[left] < size[inner]) & (right < nodes)
    right = np.where(inside, right, 0)
    broken = _first(~inside | (size[right] != size[inner] - size[left]))
    if broken >= 0:
        raise _error("the tree over triangles does not split its triangles in two", int(inner[broken]))
    leaves = np.flatnonzero(size == 1)
    spilled = _first(~(_holds(boxes[inner], boxes[left]) & _holds(boxes[inner], boxes[right])))
    if spilled >= 0:
        raise _error("a box does not hold its children's", int(inner[spilled]))
    spilled = _first(~_holds(boxes[leaves], triangle_boxes))
    if spilled >= 0:
        raise _error("a box does not hold its triangle", int(leaves[spilled]))


def _spills(
    hierarchy: StripHierarchy, strip_boxes: Boxes, child: np.ndarray, count: np.ndarray, first: np.ndarray
) -> Bools:
    is_node = count > 1
    boxes = strip_boxes[first]
    boxes[is_node] = hierarchy.boxes[child[is_node]]
    return ~_holds(hierarchy.boxes, boxes)


def _holds(outer: Boxes, inner: Boxes) -> Bools:
    # Written so that a comparison with NaN says no.
    held = (outer[:, :3] <= inner[:, :3]) & (outer[:, 3:] >= inner[:, 3:])
    return np.logical_and.reduce(held, axis=1)


def _first(flags: Bools) -> int:
    return int(np.argmax(flags)) if flags.any() else -1


def _error(what: str, node: int) -> UnreadableSceneError:
    return UnreadableSceneError(what, where=f"node {node}", remedy="convert the model again")
