"""Binary hierarchies of 32-byte nodes in preorder: over any objects, with leaves of one or a few.

Cost of the proof: O(n) time, one pass over nodes and boxes.
"""

import numpy as np
from jaxtyping import UInt32

from striptools.errors import UnreadableSceneError
from striptools.hierarchies.options import OverName
from striptools.kernels import binary_nodes as kernels
from striptools.partition.object_split import ObjectTree
from striptools.partition.sah import NODE_COST
from striptools.types import Boxes, Counts

Nodes = UInt32[np.ndarray, "m 8"]

LEAF_TRIANGLES = 8
"""The most triangles of a leaf: as many as are tested at once."""

LEAF_COST = 1.5
"""Expected time of testing up to so many triangles at once, in visits to an inner node."""

_FLAWS = {
    kernels.HOLDS_NOT_ALL: "ends before all nodes and objects are reached",
    kernels.NO_PREORDER: "has a node whose children are not where preorder puts them",
    kernels.TOO_DEEP: f"is deeper than {kernels.DEEPEST} nodes",
    kernels.NO_LEAF: "has a leaf that does not go on where the one before it ends",
    kernels.NOT_HELD: "has a box that does not hold what is below it",
}


def most_in_leaf(over: OverName) -> int:
    """How many objects a leaf may have: triangles are tested eight at a time, strips have more each."""
    return LEAF_TRIANGLES if over == "triangles" else 1


def nodes_of_tree(tree: ObjectTree, boxes: Boxes, leaf_size: int) -> Nodes:
    """The nodes of an object tree.

    Args:
        tree: Over p objects.
        boxes: (p, 6) float32, of the objects.
        leaf_size: The most objects that are joined to one leaf, where that is no dearer.

    Returns:
        (m, 8) uint32, as `LooseBvh` has them, over the objects in `tree.order`.
    """
    nodes, first = kernels.join_by_size(tree.size, tree.order, boxes, leaf_size, NODE_COST, LEAF_COST)
    return nodes if first == 0 else kernels.to_front(nodes, first)


def binary_depth(nodes: Nodes) -> int:
    """The most inner nodes above a leaf, of nodes that are known to be whole."""
    return int(kernels.depth_of(nodes))


def check_binary_nodes(nodes: Nodes, order: Counts | None, boxes: Boxes) -> None:
    """Make sure that each object is reached once and that all boxes hold what is below them.

    Args:
        nodes: (m, 8) uint32 in preorder, as `LooseBvh` has them.
        order: (p,) int32, the objects as leaves name them; None where they lie in that order.
        boxes: (p, 6) float32, of the objects, p >= 1.

    Raises:
        UnreadableSceneError: Naming the first flaw found.
    """
    count = len(boxes)
    if nodes.dtype != np.uint32 or nodes.ndim != 2 or nodes.shape[1] != 8 or len(nodes) == 0:
        raise _error(f"the hierarchy's nodes are {nodes.dtype} of shape {nodes.shape}", "nodes")
    if order is None:
        order = np.arange(count, dtype=np.int32)
    if len(order) != count or not np.array_equal(np.sort(order), np.arange(count)):
        raise _error("the hierarchy's order is no permutation of its objects", "order")
    nodes = np.ascontiguousarray(nodes)
    flaw, node = kernels.first_flaw(nodes, nodes.view(np.float32), order, np.ascontiguousarray(boxes))
    if flaw != 0:
        raise _error(f"the hierarchy {_FLAWS[flaw]}", f"node {node}")


def _error(what: str, where: str) -> UnreadableSceneError:
    return UnreadableSceneError(what, where=where, remedy="convert the model again")
