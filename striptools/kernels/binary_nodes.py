"""Binary nodes of 32 bytes in preorder: joined from below, checked, measured.

A preorder read backwards meets every node behind both of its children. So nodes are written from the end of
an array to its front, out of a stack of finished subtrees, the leftmost on top: a leaf is put on it, a join
makes one subtree of the two on top. Nothing is moved or looked up afterwards.
"""

from typing import Any, NamedTuple

import numpy as np

from striptools.kernels.boxes import half_area
from striptools.kernels.compiled import inlined, kernel, maker

DEEPEST = 254
"""The most inner nodes above a leaf."""

STACK = DEEPEST + 2


class Forest(NamedTuple):
    """Finished subtrees, and the nodes they consist of.

    Attributes:
        box: (STACK, 6) float32 around each subtree.
        cost: (STACK,) float64, expected cost of each, in areas.
        items: (STACK, 2) int32, its first object, and the one behind its last.
        place: (STACK, 2) int32, its root, and the node that was written last before it.
        nodes: (m, 8) uint32, filled from the end.
        corners: The same memory as float32.
    """

    box: Any
    cost: Any
    items: Any
    place: Any
    nodes: Any
    corners: Any


@maker
def new_forest(nodes):
    """No subtree yet, and room for so many nodes."""
    words = np.empty((nodes, 8), np.uint32)
    return Forest(
        np.empty((STACK, 6), np.float32),
        np.empty(STACK, np.float64),
        np.empty((STACK, 2), np.int32),
        np.empty((STACK, 2), np.int32),
        words,
        words.view(np.float32),
    )


@inlined
def write_leaf(forest, entry, node, first, end):
    """Write the leaf over the objects first:end, with the box of a subtree."""
    for k in range(6):
        forest.corners[node, k] = forest.box[entry, k]
    forest.nodes[node, 6] = np.uint32(first)
    forest.nodes[node, 7] = np.uint32(end - first)


@inlined
def put_leaf(forest, entry, last, item, boxes, box, leaf_cost):
    """Put object `item`, which has a row of boxes, on the stack; returns its node, before the last one."""
    node = last - 1
    for k in range(6):
        forest.box[entry, k] = boxes[box, k]
    forest.items[entry, 0] = item
    forest.items[entry, 1] = item + 1
    forest.place[entry, 0] = node
    forest.place[entry, 1] = last
    write_leaf(forest, entry, node, item, item + 1)
    forest.cost[entry] = leaf_cost * half_area(
        boxes[box, 0], boxes[box, 1], boxes[box, 2], boxes[box, 3], boxes[box, 4], boxes[box, 5]
    )
    return node


@inlined
def join_two(forest, left, last, most, node_cost, leaf_cost):
    """Make the subtree on top and the one below it, to its right, one; returns the node written last.

    Up to `most` objects become a leaf where that is no dearer.
    """
    right = left - 1
    for k in range(3):
        forest.box[right, k] = min(forest.box[left, k], forest.box[right, k])
        forest.box[right, k + 3] = max(forest.box[left, k + 3], forest.box[right, k + 3])
    area = half_area(
        forest.box[right, 0],
        forest.box[right, 1],
        forest.box[right, 2],
        forest.box[right, 3],
        forest.box[right, 4],
        forest.box[right, 5],
    )
    first, end = forest.items[left, 0], forest.items[right, 1]
    cost = forest.cost[left] + forest.cost[right] + node_cost * area
    if end - first <= most and leaf_cost * area <= cost:
        # Write the leaf over the nodes of both.
        node = forest.place[right, 1] - 1
        cost = leaf_cost * area
        write_leaf(forest, right, node, first, end)
    else:
        node = last - 1
        for k in range(6):
            forest.corners[node, k] = forest.box[right, k]
        forest.nodes[node, 6] = np.uint32(forest.place[right, 0])
        forest.nodes[node, 7] = np.uint32(0)
    forest.cost[right] = cost
    forest.items[right, 0] = first
    forest.place[right, 0] = node
    return node


@kernel
def to_front(nodes, first):
    """Copy the nodes from `first` on to an array of their own: (m, 8) uint32."""
    out = np.empty((nodes.shape[0] - first, 8), np.uint32)
    for node in range(out.shape[0]):
        for k in range(8):
            out[node, k] = nodes[first + node, k]
        if out[node, 7] == 0:
            out[node, 6] -= np.uint32(first)
    return out


@kernel
def join_by_size(size, order, boxes, most, node_cost, leaf_cost):
    """The nodes of a preorder tree over one object a leaf, and their number counted from the end.

    Args:
        size: (2p-1,) int32, objects below each node.
        order: (p,) int32, the object of each leaf.
        boxes: (p, 6) float32, of the objects.
        most: The most objects that a leaf may be made of.
        node_cost: Cost of visiting an inner node.
        leaf_cost: Cost of visiting a leaf.

    Returns:
        (2p-1, 8) uint32, and the first of them that is one.
    """
    forest = new_forest(size.shape[0])
    last = size.shape[0]
    item = order.shape[0]
    height = 0
    for node in range(size.shape[0] - 1, -1, -1):
        if size[node] == 1:
            item -= 1
            last = put_leaf(forest, height, last, item, boxes, order[item], leaf_cost)
            height += 1
        else:
            height -= 1
            last = join_two(forest, height, last, most, node_cost, leaf_cost)
    return forest.nodes, last


HOLDS_NOT_ALL = 1
NO_PREORDER = 2
TOO_DEEP = 3
NO_LEAF = 4
NOT_HELD = 5


@inlined
def spills(corners, outer, boxes, inner):
    """Whether one box does not hold another, or either is not a number."""
    for k in range(3):
        if not corners[outer, k] <= boxes[inner, k] or not corners[outer, k + 3] >= boxes[inner, k + 3]:
            return True
    return False


@kernel
def first_flaw(nodes, corners, order, boxes):
    """Find the first flaw of binary nodes in preorder.

    Args:
        nodes: (m, 8) uint32, m >= 1.
        corners: The same memory as float32.
        order: (p,) int32, a permutation: the object at each place of the leaves.
        boxes: (p, 6) float32, of the objects.

    Returns:
        One of this module's flaws and the node that has it, or 0 and the most inner nodes above a leaf.
    """
    count = nodes.shape[0]
    waiting = np.empty(STACK, np.int64)
    above = np.empty(STACK, np.int64)
    height = 0
    depth = 0
    deepest = 0
    item = 0
    for node in range(count):
        word = np.int64(nodes[node, 6])
        held = np.int64(nodes[node, 7])
        if held == 0:
            # An inner node: its first child follows, its second one waits, and its box holds both.
            if word <= node + 1 or word >= count:
                return NO_PREORDER, node
            if depth == DEEPEST:
                return TOO_DEEP, node
            depth += 1
            waiting[height] = word
            above[height] = depth
            height += 1
            if spills(corners, node, corners, node + 1) or spills(corners, node, corners, word):
                return NOT_HELD, node
            continue
        # A leaf: it goes on where the one before it has ended, and its box holds its objects.
        if word != item or held > order.shape[0] - item:
            return NO_LEAF, node
        for place in range(word, word + held):
            if spills(corners, node, boxes, order[place]):
                return NOT_HELD, node
        item += held
        deepest = max(deepest, depth)
        # The node behind a leaf is the one that has waited least.
        if height == 0:
            if node + 1 < count or item < order.shape[0]:
                return HOLDS_NOT_ALL, node
        else:
            height -= 1
            depth = above[height]
            if waiting[height] != node + 1:
                return NO_PREORDER, node
    return 0, deepest


@kernel
def depth_of(nodes):
    """The most inner nodes above a leaf, of nodes without a flaw."""
    above = np.empty(STACK, np.int64)
    height = 0
    depth = 0
    deepest = 0
    for node in range(nodes.shape[0]):
        if nodes[node, 7] == 0:
            depth += 1
            above[height] = depth
            height += 1
            deepest = max(deepest, depth)
        elif height > 0:
            height -= 1
            depth = above[height]
    return deepest
