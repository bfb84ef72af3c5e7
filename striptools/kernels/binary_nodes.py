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
def write_node(forest, node, box, word, held):
    """Write a node: a leaf over so many objects from the first one, or an inner node and its second child."""
    for k in range(6):
        forest.corners[node, k] = box[k]
    forest.nodes[node, 6] = np.uint32(word)
    forest.nodes[node, 7] = np.uint32(held)


@inlined
def put_leaf(forest, entry, last, item, boxes, row, leaf_cost):
    """Put object `item`, which has a row of boxes, on the stack; returns its node, before the last one."""
    # Unsigned indices are not looked at for being negative; a row read whole may not overlap what is written.
    node, entry, row = np.uint64(last - 1), np.uint64(entry), np.uint64(row)
    box = (boxes[row, 0], boxes[row, 1], boxes[row, 2], boxes[row, 3], boxes[row, 4], boxes[row, 5])
    for k in range(6):
        forest.box[entry, k] = box[k]
    write_node(forest, node, box, item, 1)
    forest.cost[entry] = leaf_cost * half_area(box[0], box[1], box[2], box[3], box[4], box[5])
    forest.items[entry, 0] = item
    forest.items[entry, 1] = item + 1
    forest.place[entry, 0] = last - 1
    forest.place[entry, 1] = last
    return last - 1


@inlined
def smaller(a, b):
    """The smaller of two: one instruction, where min minds numbers that are none."""
    return a if a < b else b


@inlined
def larger(a, b):
    """The larger of two."""
    return a if a > b else b


@inlined
def join_two(forest, left, last, most, node_cost, leaf_cost):
    """Make the subtree on top and the one below it, to its right, one; returns the node written last.

    Up to `most` objects become a leaf where that is no dearer.
    """
    left, right = np.uint64(left), np.uint64(left - 1)
    old = forest.box
    box = (
        smaller(old[left, 0], old[right, 0]),
        smaller(old[left, 1], old[right, 1]),
        smaller(old[left, 2], old[right, 2]),
        larger(old[left, 3], old[right, 3]),
        larger(old[left, 4], old[right, 4]),
        larger(old[left, 5], old[right, 5]),
    )
    area = half_area(box[0], box[1], box[2], box[3], box[4], box[5])
    first, end = forest.items[left, 0], forest.items[right, 1]
    cost = forest.cost[left] + forest.cost[right] + node_cost * area
    if end - first <= most and leaf_cost * area <= cost:
        # Write the leaf over the nodes of both.
        cost = leaf_cost * area
        node = np.int64(forest.place[right, 1]) - 1
        write_node(forest, np.uint64(node), box, first, end - first)
    else:
        node = last - 1
        write_node(forest, np.uint64(node), box, forest.place[right, 0], 0)
    for k in range(6):
        forest.box[right, k] = box[k]
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
