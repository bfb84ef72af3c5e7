"""Kernels of the SLBVH: which objects each node of the heap has, balanced SAH halves, boxes from below.

A node is a row of eight words, PRIM_COUNT and PRIM_POS the last two; the first six are the bits of its box.
"""

from collections import namedtuple

import numpy as np

from striptools.kernels.boxes import half_area
from striptools.kernels.compiled import helper, inlined, kernel

PRIM_COUNT = 6
PRIM_POS = 7
LEAF = 4
COUNT_SHIFT = 3
MOST_WAITING = 32

Lists = namedtuple("Lists", "items spare goes_left")
"""items (3, p) int32, in each range its objects by rising centre on each axis; room for p int32 and uint8."""


@inlined
def count_of(words, node):
    """Objects below a node, 0 where it is empty."""
    return np.int64(words[node, PRIM_COUNT]) >> COUNT_SHIFT


@inlined
def place_of_change(codes, begin, end):
    """The first place of a range whose code has the highest bit in which its codes differ; -1 for none."""
    differing = codes[begin] ^ codes[end - 1]
    if differing == 0:
        return np.int64(-1)
    bit = np.uint64(1)
    while differing > np.uint64(1):
        differing >>= np.uint64(1)
        bit <<= np.uint64(1)
    without, having = begin, end - 1
    while having - without > 1:
        middle = (without + having) // 2
        if codes[middle] & bit != 0:
            having = middle
        else:
            without = middle
    return having


@kernel
def fill_ranges(count, codes, largest_leaf, words):
    """Give each node of a heap of zeros its objects.

    Args:
        count: Objects.
        codes: (count,) uint64, rising: nodes are split where the highest bit changes, or as near to there as
            leaves room in the levels below; without an entry they are halved, the left half the larger.
        largest_leaf: A node of at most that many is a leaf; the heap has room for `count` objects.
        words: (2**d, 8) uint32, written.
    """
    words[1, PRIM_COUNT] = count << COUNT_SHIFT
    room = np.int64(largest_leaf) * (len(words) // 2)
    for node in range(1, len(words)):
        # Each level has room for half as many objects a node as the one above.
        room = room // 2 if node & (node - 1) == 0 else room
        total = count_of(words, node)
        if 0 < total <= largest_leaf:
            words[node, PRIM_COUNT] |= np.uint32(LEAF)
        elif total > 0:
            first = np.int64(words[node, PRIM_POS])
            left = (total + 1) // 2
            if len(codes) > 0:
                change = place_of_change(codes, first, first + total)
                left = min(max(change - first, total - room), room) if change >= 0 else left
            # Hand the first part to the left child and the rest to the right one.
            words[2 * node, PRIM_COUNT] = left << COUNT_SHIFT
            words[2 * node, PRIM_POS] = first
            words[2 * node + 1, PRIM_COUNT] = (total - left) << COUNT_SHIFT
            words[2 * node + 1, PRIM_POS] = first + left


@inlined
def area_around(boxes, items, axis, begin, end):
    """Half the area of the box around the objects at some places."""
    item = items[axis, begin]
    lo_x, lo_y, lo_z = boxes[item, 0], boxes[item, 1], boxes[item, 2]
    hi_x, hi_y, hi_z = boxes[item, 3], boxes[item, 4], boxes[item, 5]
    for place in range(begin + 1, end):
        item = items[axis, place]
        lo_x, lo_y, lo_z = min(lo_x, boxes[item, 0]), min(lo_y, boxes[item, 1]), min(lo_z, boxes[item, 2])
        hi_x, hi_y, hi_z = max(hi_x, boxes[item, 3]), max(hi_y, boxes[item, 4]), max(hi_z, boxes[item, 5])
    return half_area(lo_x, lo_y, lo_z, hi_x, hi_y, hi_z)


@inlined
def centre(boxes, item, axis):
    """Twice the centre of a box along an axis, in float64, where the sum of two float32 cannot overflow."""
    return np.float64(boxes[item, axis]) + np.float64(boxes[item, 3 + axis])


@helper
def best_axis(boxes, lists, begin, middle, end):
    """The axis along which halves have the least SAH cost; of equals that of the widest centres, the first.

    Two objects cost the same along any axis, but only along some do they lie one behind the other.
    """
    best = np.inf
    best_extent = -1.0
    chosen = 0
    for axis in range(3):
        cost = area_around(boxes, lists.items, axis, begin, middle) * (middle - begin)
        cost += area_around(boxes, lists.items, axis, middle, end) * (end - middle)
        extent = centre(boxes, lists.items[axis, end - 1], axis)
        extent -= centre(boxes, lists.items[axis, begin], axis)
        if cost < best or (cost == best and extent > best_extent):
            best = cost
            best_extent = extent
            chosen = axis
    return chosen


@helper
def part_lists(lists, axis, begin, middle, end):
    """Part the lists of the other axes as the one of `axis` is parted at the middle, all in order."""
    for place in range(begin, end):
        lists.goes_left[lists.items[axis, place]] = 1 if place < middle else 0
    for other in range(3):
        if other == axis:
            continue
        # Close up the left half and set the right one apart; an item goes to both, but one counts.
        left = begin
        right = begin
        for place in range(begin, end):
            item = lists.items[other, place]
            lists.items[other, left] = item
            lists.spare[right] = item
            left += lists.goes_left[item]
            right += 1 - lists.goes_left[item]
        for k in range(end - middle):
            lists.items[other, middle + k] = lists.spare[begin + k]


@kernel
def halve_by_sah(boxes, lists, words, node, once):
    """Choose the axis of a node and of all below, and part the lists by the halves along it.

    Args:
        boxes: (p, 6) float32.
        lists: Of all objects; only the node's range is touched.
        words: (2**d, 8) uint32 with the ranges; axes are written.
        node: A node that is not empty.
        once: Leave its children alone.
    """
    waiting = np.empty(MOST_WAITING, np.int64)
    waiting[0] = node
    depth = 1
    while depth > 0:
        depth -= 1
        here = waiting[depth]
        if words[here, PRIM_COUNT] & np.uint32(LEAF) != 0:
            continue
        begin = np.int64(words[here, PRIM_POS])
        middle = begin + count_of(words, 2 * here)
        end = begin + count_of(words, here)
        axis = best_axis(boxes, lists, begin, middle, end)
        part_lists(lists, axis, begin, middle, end)
        words[here, PRIM_COUNT] |= np.uint32(axis)
        if not once:
            waiting[depth], waiting[depth + 1] = 2 * here + 1, 2 * here
            depth += 2


@kernel
def box_nodes(boxes, order, words, floats):
    """Write the exact box of every node that is not empty, children before parents.

    Args:
        boxes: (p, 6) float32.
        order: (p,) int32.
        words: (2**d, 8) uint32 with the ranges.
        floats: The same memory as float32, written.
    """
    for node in range(len(words) - 1, 0, -1):
        if words[node, PRIM_COUNT] == 0:
            continue
        if words[node, PRIM_COUNT] & np.uint32(LEAF) == 0:
            # Join the children.
            for k in range(3):
                floats[node, k] = min(floats[2 * node, k], floats[2 * node + 1, k])
                floats[node, 3 + k] = max(floats[2 * node, 3 + k], floats[2 * node + 1, 3 + k])
            continue
        # Join the objects.
        first = np.int64(words[node, PRIM_POS])
        for k in range(6):
            floats[node, k] = boxes[order[first], k]
        for place in range(first + 1, first + count_of(words, node)):
            item = order[place]
            for k in range(3):
                floats[node, k] = min(floats[node, k], boxes[item, k])
                floats[node, 3 + k] = max(floats[node, 3 + k], boxes[item, 3 + k])


@kernel
def axes_from_boxes(words, floats):
    """Give each inner node the axis along which its right child's box lies farthest behind its left one's."""
    for node in range(1, len(words) // 2):
        if words[node, PRIM_COUNT] == 0 or words[node, PRIM_COUNT] & np.uint32(LEAF) != 0:
            continue
        best = -np.inf
        chosen = 0
        for axis in range(3):
            behind = centre(floats, 2 * node + 1, axis) - centre(floats, 2 * node, axis)
            if behind > best:
                best = behind
                chosen = axis
        words[node, PRIM_COUNT] |= np.uint32(chosen)
