"""Recursive SAH object split down to one item: the loops behind partition/object_split.py.

A *range* is `begin:end` of the working arrays (`items`, `boxes`, `weights`), which every split reorders in
place and stably, so that the items of a range always stand in rising index and "the first of equals" is "the
least index". The arrays of a `Work` tuple are indexed by absolute position: disjoint ranges may be split by
different threads at once.

Centres are twice the box centre (lo + hi) in float64, where the sum of two float32 cannot overflow.
"""

from collections import namedtuple

import numpy as np
from numba import njit

from striptools.kernels.boxes import half_area

Work = namedtuple(
    "Work",
    "items boxes weights side spare_items spare_boxes spare_weights",
)
"""Working arrays of n rows: the items and their boxes and weights in the order so far; side (n, 3) uint8,
what fill_bins or sweep say of each; and room for the right side of a stable partition."""

Tree = namedtuple("Tree", "leaf_node parent size")
"""The tree as it grows: arrays of (n,), (2n-1,) and (2n-1,) int32."""


EMPTY_BOX = (np.float32(np.inf),) * 3 + (np.float32(-np.inf),) * 3


@njit(cache=True, nogil=True)
def centre(boxes, position, axis):
    """Twice the centre of a box along an axis."""
    return np.float64(boxes[position, axis]) + np.float64(boxes[position, 3 + axis])


@njit(cache=True, nogil=True)
def join(box, boxes, row):
    """The box (a tuple of six, kept in registers) around a box and a row of boxes."""
    return (
        min(box[0], boxes[row, 0]),
        min(box[1], boxes[row, 1]),
        min(box[2], boxes[row, 2]),
        max(box[3], boxes[row, 3]),
        max(box[4], boxes[row, 4]),
        max(box[5], boxes[row, 5]),
    )


@njit(cache=True, nogil=True)
def area(box):
    """Half area of a box that is not empty."""
    return half_area(box[0], box[1], box[2], box[3], box[4], box[5])


@njit(cache=True, nogil=True)
def empty_bins(bin_boxes, bin_weight):
    """Make every bin hold nothing."""
    for row in range(bin_weight.shape[0]):
        bin_weight[row] = 0
        for axis in range(3):
            bin_boxes[row, axis] = np.inf
            bin_boxes[row, 3 + axis] = -np.inf


@njit(cache=True, nogil=True)
def centre_bounds(boxes, begin, end, least, most):
    """Fill least (3,) and most (3,) with the bounds of the centres of a range."""
    for axis in range(3):
        low = np.inf
        high = -np.inf
        for position in range(begin, end):
            value = centre(boxes, position, axis)
            low = min(low, value)
            high = max(high, value)
        least[axis] = low
        most[axis] = high


@njit(cache=True, nogil=True)
def fill_bins(work, begin, end, bins, least, most, bin_boxes, bin_weight):
    """Sort a range into bins on all three axes at once; side[i, axis] is the bin of item i."""
    empty_bins(bin_boxes, bin_weight)
    # Scale each axis that has an extent so that its bins are one apart.
    scale = np.zeros(3, np.float64)
    for axis in range(3):
        if most[axis] > least[axis]:
            scale[axis] = bins / (most[axis] - least[axis])
    # Put every item into its bin of each axis.
    for position in range(begin, end):
        box = join(EMPTY_BOX, work.boxes, position)
        for axis in range(3):
            slot = min(int((centre(work.boxes, position, axis) - least[axis]) * scale[axis]), bins - 1)
            work.side[position, axis] = slot
            row = axis * bins + slot
            bin_weight[row] += work.weights[position]
            bin_boxes[row, 0] = min(bin_boxes[row, 0], box[0])
            bin_boxes[row, 1] = min(bin_boxes[row, 1], box[1])
            bin_boxes[row, 2] = min(bin_boxes[row, 2], box[2])
            bin_boxes[row, 3] = max(bin_boxes[row, 3], box[3])
            bin_boxes[row, 4] = max(bin_boxes[row, 4], box[4])
            bin_boxes[row, 5] = max(bin_boxes[row, 5], box[5])


@njit(cache=True, nogil=True)
def best_bin(bins, least, most, bin_boxes, bin_weight, right_cost):
    """The axis and the last bin on the left of the cheapest split; axis -1 where all centres are equal."""
    best = np.inf
    best_axis = -1
    best_slot = 0
    for axis in range(3):
        if not most[axis] > least[axis]:
            continue
        # Gather the cost of everything to the right of each boundary; none without items there.
        box = EMPTY_BOX
        weight = 0
        for slot in range(bins - 1, 0, -1):
            row = axis * bins + slot
            box = join(box, bin_boxes, row)
            weight += bin_weight[row]
            right_cost[slot] = area(box) * weight if weight > 0 else np.inf
        # Sweep from the left and keep the first of the cheapest boundaries.
        box = EMPTY_BOX
        weight = 0
        for slot in range(bins - 1):
            row = axis * bins + slot
            box = join(box, bin_boxes, row)
            weight += bin_weight[row]
            if weight > 0:
                cost = area(box) * weight + right_cost[slot + 1]
                if cost < best:
                    best = cost
                    best_axis = axis
                    best_slot = slot
    return best_axis, best_slot


@njit(cache=True, nogil=True)
def sort_by_centre(boxes, begin, count, axis, rank, key):
    """Fill rank (count,) with the positions of a short range by rising centre, equals in order."""
    for i in range(count):
        value = centre(boxes, begin + i, axis)
        j = i - 1
        while j >= 0 and key[j] > value:
            key[j + 1] = key[j]
            rank[j + 1] = rank[j]
            j -= 1
        key[j + 1] = value
        rank[j + 1] = begin + i


@njit(cache=True, nogil=True)
def sweep(work, begin, end, least, most, rank, key, right_cost):
    """Find the cheapest split of a short range over all places of all axes; side[i, 0] is 1 on its right.

    Returns False where all centres are equal.
    """
    count = end - begin
    best = np.inf
    for axis in range(3):
        if not most[axis] > least[axis]:
            continue
        sort_by_centre(work.boxes, begin, count, axis, rank, key)
        # Gather the cost of the right side of each place.
        box = EMPTY_BOX
        weight = 0
        for j in range(count - 1, 0, -1):
            box = join(box, work.boxes, rank[j])
            weight += work.weights[rank[j]]
            right_cost[j] = area(box) * weight
        # Sweep from the left and keep the first of the cheapest places.
        box = EMPTY_BOX
        weight = 0
        place = 0
        for j in range(count - 1):
            box = join(box, work.boxes, rank[j])
            weight += work.weights[rank[j]]
            cost = area(box) * weight + right_cost[j + 1]
            if cost < best:
                best = cost
                place = j + 1
        # Note the sides while this axis is the best.
        if place > 0:
            for j in range(count):
                work.side[rank[j], 0] = 0 if j < place else 1
    return best < np.inf


@njit(cache=True, nogil=True)
def move_row(items, boxes, weights, to, from_items, from_boxes, from_weights, source):
    """Copy one working row."""
    items[to] = from_items[source]
    weights[to] = from_weights[source]
    for k in range(6):
        boxes[to, k] = from_boxes[source, k]


@njit(cache=True, nogil=True)
def partition(work, begin, end, axis, last_left):
    """Move items with side[i, axis] > last_left behind the others, both in order; returns the middle."""
    # Close up the left side and set the right side apart.
    middle = begin
    spare = begin
    for position in range(begin, end):
        if work.side[position, axis] <= last_left:
            if middle != position:
                move_row(
                    work.items,
                    work.boxes,
                    work.weights,
                    middle,
                    work.items,
                    work.boxes,
                    work.weights,
                    position,
                )
            middle += 1
        else:
            move_row(
                work.spare_items, work.spare_boxes, work.spare_weights, spare,
                work.items, work.boxes, work.weights, position,
            )  # fmt: skip
            spare += 1
    # Bring the right side back.
    for k in range(spare - begin):
        move_row(
            work.items, work.boxes, work.weights, middle + k,
            work.spare_items, work.spare_boxes, work.spare_weights, begin + k,
        )  # fmt: skip
    return middle


@njit(cache=True, nogil=True)
def split_ranges(work, tree, node, begin, end, depth, bins, sweep_below, sah_depth, grain, jobs):
    """Split the range of `node` down to single items, or to ranges of at most `grain` items.

    Ranges of `grain` items or fewer (but more than one) are written to jobs (rows node, begin, end, depth)
    and left alone; grain 0 leaves none. Returns the number of jobs. Ranges at `sah_depth` or deeper are
    halved.
    """
    bin_boxes = np.empty((3 * bins, 6), np.float32)
    bin_weight = np.empty(3 * bins, np.int64)
    right_cost = np.empty(max(bins, sweep_below), np.float64)
    rank = np.empty(sweep_below, np.int64)
    key = np.empty(sweep_below, np.float64)
    least = np.empty(3, np.float64)
    most = np.empty(3, np.float64)
    # The larger side waits and the smaller goes first: at most log2(n) ranges wait.
    stack = np.empty((64, 4), np.int64)
    waiting = 0
    job_count = 0
    while True:
        count = end - begin
        tree.size[node] = count
        if count == 1 or count <= grain:
            # Finish a leaf, or set a range aside for another thread.
            if count == 1:
                tree.leaf_node[work.items[begin]] = node
            else:
                jobs[job_count, 0] = node
                jobs[job_count, 1] = begin
                jobs[job_count, 2] = end
                jobs[job_count, 3] = depth
                job_count += 1
            # Take up the next waiting range.
            if waiting == 0:
                return job_count
            waiting -= 1
            node = stack[waiting, 0]
            begin = stack[waiting, 1]
            end = stack[waiting, 2]
            depth = stack[waiting, 3]
            continue
        # Split by the cheapest place, or in halves where there is none to find.
        middle = begin + (count + 1) // 2
        if count > 2 and depth < sah_depth:
            centre_bounds(work.boxes, begin, end, least, most)
            if count < sweep_below:
                if sweep(work, begin, end, least, most, rank, key, right_cost):
                    middle = partition(work, begin, end, 0, 0)
            else:
                fill_bins(work, begin, end, bins, least, most, bin_boxes, bin_weight)
                axis, slot = best_bin(bins, least, most, bin_boxes, bin_weight, right_cost)
                if axis >= 0:
                    middle = partition(work, begin, end, axis, slot)
        # Number the children: the left one follows its parent, the right one the left one's subtree.
        left = node + 1
        right = node + 2 * (middle - begin)
        tree.parent[left] = node
        tree.parent[right] = node
        depth += 1
        if middle - begin > end - middle:
            stack[waiting, 0] = left
            stack[waiting, 1] = begin
            stack[waiting, 2] = middle
            node = right
            begin = middle
        else:
            stack[waiting, 0] = right
            stack[waiting, 1] = middle
            stack[waiting, 2] = end
            node = left
            end = middle
        stack[waiting, 3] = depth
        waiting += 1


@njit(cache=True, nogil=True)
def depths(parent):
    """Inner nodes above each node of a preorder tree, (2n-1,) int32."""
    depth = np.empty(parent.shape[0], np.int32)
    depth[0] = 0
    for node in range(1, parent.shape[0]):
        depth[node] = depth[parent[node]] + 1
    return depth


@njit(cache=True, nogil=True)
def first_broken_node(parent, size):
    """The first node whose size, children or parent break the preorder layout; -1 where none does."""
    nodes = size.shape[0]
    # Look at the root on its own.
    if parent[0] != -1 or 2 * size[0] - 1 != nodes:
        return 0
    for node in range(nodes):
        # Refuse sizes whose subtree would not fit.
        if size[node] < 1 or node + 2 * size[node] - 1 > nodes:
            return node
        if size[node] == 1:
            continue
        # Find the children, and see that they fill the node and know it.
        left = node + 1
        if size[left] < 1 or size[left] >= size[node]:
            return node
        right = node + 2 * size[left]
        if size[left] + size[right] != size[node] or parent[left] != node or parent[right] != node:
            return node
    return -1
