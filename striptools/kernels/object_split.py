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


@njit(cache=True, nogil=True)
def centre(boxes, position, axis):
    """Twice the centre of a box along an axis."""
    return np.float64(boxes[position, axis]) + np.float64(boxes[position, 3 + axis])


@njit(cache=True, nogil=True)
def grow(target, row, source, position):
    """Make box `row` of target hold box `position` of source too."""
    for axis in range(3):
        if source[position, axis] < target[row, axis]:
            target[row, axis] = source[position, axis]
        if source[position, 3 + axis] > target[row, 3 + axis]:
            target[row, 3 + axis] = source[position, 3 + axis]


@njit(cache=True, nogil=True)
def empty_box(target, row):
    """Make box `row` hold nothing."""
    for axis in range(3):
        target[row, axis] = np.inf
        target[row, 3 + axis] = -np.inf


@njit(cache=True, nogil=True)
def row_area(boxes, row):
    """Half area of a box that is not empty."""
    return half_area(boxes[row, 0], boxes[row, 1], boxes[row, 2], boxes[row, 3], boxes[row, 4], boxes[row, 5])


@njit(cache=True, nogil=True)
def centre_bounds(boxes, begin, end, least, most):
    """Fill least (3,) and most (3,) with the bounds of the centres of a range."""
    for axis in range(3):
        least[axis] = np.inf
        most[axis] = -np.inf
    for position in range(begin, end):
        for axis in range(3):
            value = centre(boxes, position, axis)
            if value < least[axis]:
                least[axis] = value
            if value > most[axis]:
                most[axis] = value


@njit(cache=True, nogil=True)
def fill_bins(work, begin, end, bins, least, most, bin_boxes, bin_weight):
    """Sort a range into bins on all three axes at once; side[i, axis] is the bin of item i."""
    # Empty the bins.
    for row in range(3 * bins):
        empty_box(bin_boxes, row)
        bin_weight[row] = 0
    # Put every item into its bin of each axis that has an extent.
    for axis in range(3):
        extent = most[axis] - least[axis]
        if not extent > 0.0:
            continue
        scale = bins / extent
        for position in range(begin, end):
            slot = int((centre(work.boxes, position, axis) - least[axis]) * scale)
            if slot > bins - 1:
                slot = bins - 1
            work.side[position, axis] = slot
            bin_weight[axis * bins + slot] += work.weights[position]
            grow(bin_boxes, axis * bins + slot, work.boxes, position)


@njit(cache=True, nogil=True)
def best_bin(bins, least, most, bin_boxes, bin_weight, right_cost, box):
    """The axis and the last bin on the left of the cheapest split; axis -1 where all centres are equal."""
    best = np.inf
    best_axis = -1
    best_slot = 0
    for axis in range(3):
        if not most[axis] > least[axis]:
            continue
        # Gather the cost of everything to the right of each boundary; none without items there.
        empty_box(box, 0)
        weight = 0
        for slot in range(bins - 1, 0, -1):
            row = axis * bins + slot
            grow(box, 0, bin_boxes, row)
            weight += bin_weight[row]
            right_cost[slot] = row_area(box, 0) * weight if weight > 0 else np.inf
        # Sweep from the left and keep the first of the cheapest boundaries.
        empty_box(box, 0)
        weight = 0
        for slot in range(bins - 1):
            row = axis * bins + slot
            grow(box, 0, bin_boxes, row)
            weight += bin_weight[row]
            if weight > 0:
                cost = row_area(box, 0) * weight + right_cost[slot + 1]
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
def sweep(work, begin, end, least, most, rank, key, right_cost, box):
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
        empty_box(box, 0)
        weight = 0
        for j in range(count - 1, 0, -1):
            grow(box, 0, work.boxes, rank[j])
            weight += work.weights[rank[j]]
            right_cost[j] = row_area(box, 0) * weight
        # Sweep from the left and keep the first of the cheapest places.
        empty_box(box, 0)
        weight = 0
        place = 0
        for j in range(count - 1):
            grow(box, 0, work.boxes, rank[j])
            weight += work.weights[rank[j]]
            cost = row_area(box, 0) * weight + right_cost[j + 1]
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
    box = np.empty((1, 6), np.float32)
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
                if sweep(work, begin, end, least, most, rank, key, right_cost, box):
                    middle = partition(work, begin, end, 0, 0)
            else:
                fill_bins(work, begin, end, bins, least, most, bin_boxes, bin_weight)
                axis, slot = best_bin(bins, least, most, bin_boxes, bin_weight, right_cost, box)
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
