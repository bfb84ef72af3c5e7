"""Recursive SAH object split down to one item: the loops behind partition/object_split.py.

The items stand as *rows* of 32 bytes: the box, the item and its weight, so that a split moves an item with
everything that belongs to it and every pass reads memory in order. A *range* is `begin:end` of the rows;
every split reorders it in place and stably, so that the items of a range always stand in rising index and
"the first of equals" is "the least index". Disjoint ranges may be split by different threads at once.

Centres are twice the box centre (lo + hi) in float64, where the sum of two float32 cannot overflow.
"""

from collections import namedtuple

import numpy as np

from striptools.kernels.boxes import half_area
from striptools.kernels.compiled import helper, inlined, kernel, maker

Rows = namedtuple("Rows", "boxes numbers words")
"""Three views of one array of n rows: (n, 8) float32, of which the first six are the box; (n, 8) int32, of
which ITEM and WEIGHT are the others; (n, 4) uint64, by which rows are moved."""

ITEM = 6
WEIGHT = 7

Tree = namedtuple("Tree", "order leaf_node parent size")
"""The tree as it grows: arrays of (n,), (n,), (2n-1,) and (2n-1,) int32."""

Bins = namedtuple("Bins", "boxes weight right_cost full")
"""boxes (3 b, 6) float32 and weight (3 b,) int64 for b bins, axis after axis; right_cost (b,) float64 and
full (b,) int64 are room for one axis."""

Short = namedtuple("Short", "boxes weight centre rank before right_cost goes_left stack")
"""A short range while it is split: its rows in float64, by their first places; rank (4, k), the places by
rising centre on each axis; and room."""

ALIGNED_BLOCKS = 12
"""Ranges of at most so many blocks are split in alignment with them."""

SLOTS = 256
"""Values of a digit: splits that are aligned see centres in 65536 slots along each axis."""

EMPTY_BOX = (np.float32(np.inf),) * 3 + (np.float32(-np.inf),) * 3


@kernel
def fill_rows(boxes, weights, begin, end, rows):
    """Write the rows of the items `begin:end`; weights of no entry stand for 1 each.

    Returns the first item whose box is not finite or inverted or whose weight is below 1, -1 where there is
    none.
    """
    for item in range(begin, end):
        # Refuse what cannot be split; a comparison with NaN says no.
        weight = weights[item] if weights.shape[0] > 0 else 1
        good = weight >= 1
        for axis in range(3):
            low = boxes[item, axis]
            high = boxes[item, 3 + axis]
            good = good and -np.inf < low and low <= high and high < np.inf
        if not good:
            return item
        # Copy the box beside the item and its weight.
        for k in range(6):
            rows.boxes[item, k] = boxes[item, k]
        rows.numbers[item, ITEM] = item
        rows.numbers[item, WEIGHT] = weight
    return -1


@inlined
def centre(boxes, position, axis):
    """Twice the centre of a box along an axis."""
    return np.float64(boxes[position, axis]) + np.float64(boxes[position, 3 + axis])


@inlined
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


@inlined
def row_box(boxes, row):
    """A row of boxes as a tuple."""
    return (boxes[row, 0], boxes[row, 1], boxes[row, 2], boxes[row, 3], boxes[row, 4], boxes[row, 5])


@inlined
def area(box):
    """Half area of a box that is not empty."""
    return half_area(box[0], box[1], box[2], box[3], box[4], box[5])


@inlined
def grow_bounds(bounds, side, x, y, z):
    """Make the bounds of a side (rows least x y z, most x y z) hold a centre."""
    bounds[side, 0] = min(bounds[side, 0], x)
    bounds[side, 1] = min(bounds[side, 1], y)
    bounds[side, 2] = min(bounds[side, 2], z)
    bounds[side, 3] = max(bounds[side, 3], x)
    bounds[side, 4] = max(bounds[side, 4], y)
    bounds[side, 5] = max(bounds[side, 5], z)


@inlined
def clear_bounds(bounds):
    """Make all bounds hold nothing."""
    for side in range(bounds.shape[0]):
        for axis in range(3):
            bounds[side, axis] = np.inf
            bounds[side, 3 + axis] = -np.inf


@inlined
def centre_bounds(boxes, begin, end, bounds):
    """Fill the first row of bounds with those of the centres of a range."""
    clear_bounds(bounds)
    for position in range(begin, end):
        grow_bounds(
            bounds, 0, centre(boxes, position, 0), centre(boxes, position, 1), centre(boxes, position, 2)
        )


@inlined
def bin_scale(bounds, axis, bins):
    """What makes the bins of an axis one apart; 0 where all centres are equal."""
    extent = bounds[0, 3 + axis] - bounds[0, axis]
    return bins / extent if extent > 0.0 else 0.0


@inlined
def put_in_bin(bins, row, box, weight):
    """Make a bin hold an item."""
    bins.weight[row] += weight
    bins.boxes[row, 0] = min(bins.boxes[row, 0], box[0])
    bins.boxes[row, 1] = min(bins.boxes[row, 1], box[1])
    bins.boxes[row, 2] = min(bins.boxes[row, 2], box[2])
    bins.boxes[row, 3] = max(bins.boxes[row, 3], box[3])
    bins.boxes[row, 4] = max(bins.boxes[row, 4], box[4])
    bins.boxes[row, 5] = max(bins.boxes[row, 5], box[5])


@inlined
def fill_bins(rows, begin, end, bounds, bins):
    """Sort a range into bins on all three axes at once."""
    # Make every bin hold nothing.
    for row in range(bins.weight.shape[0]):
        bins.weight[row] = 0
        for axis in range(3):
            bins.boxes[row, axis] = np.inf
            bins.boxes[row, 3 + axis] = -np.inf
    # Put every item into its bin of each axis.
    count = bins.right_cost.shape[0]
    last = count - 1
    x, y, z = bounds[0, 0], bounds[0, 1], bounds[0, 2]
    x_scale = bin_scale(bounds, 0, count)
    y_scale = bin_scale(bounds, 1, count)
    z_scale = bin_scale(bounds, 2, count)
    for position in range(begin, end):
        box = row_box(rows.boxes, position)
        weight = rows.numbers[position, WEIGHT]
        x_bin = min(int((centre(rows.boxes, position, 0) - x) * x_scale), last)
        y_bin = min(int((centre(rows.boxes, position, 1) - y) * y_scale), last)
        z_bin = min(int((centre(rows.boxes, position, 2) - z) * z_scale), last)
        put_in_bin(bins, x_bin, box, weight)
        put_in_bin(bins, count + y_bin, box, weight)
        put_in_bin(bins, 2 * count + z_bin, box, weight)


@inlined
def best_bin(bounds, bins):
    """The axis and the last bin on the left of the cheapest split; axis -1 where all centres are equal."""
    count = bins.right_cost.shape[0]
    best = np.inf
    best_axis = -1
    best_slot = 0
    for axis in range(3):
        if not bounds[0, 3 + axis] > bounds[0, axis]:
            continue
        # List the bins that hold items: a boundary behind an empty one costs what the one before it costs.
        row = axis * count
        full = 0
        for slot in range(count):
            bins.full[full] = slot
            full += 1 if bins.weight[row + slot] > 0 else 0
        # Gather the cost of everything to the right of each boundary.
        box = EMPTY_BOX
        weight = 0
        for k in range(full - 1, 0, -1):
            slot = bins.full[k]
            box = join(box, bins.boxes, row + slot)
            weight += bins.weight[row + slot]
            bins.right_cost[k] = area(box) * weight
        # Sweep from the left and keep the first of the cheapest boundaries.
        box = EMPTY_BOX
        weight = 0
        for k in range(full - 1):
            slot = bins.full[k]
            box = join(box, bins.boxes, row + slot)
            weight += bins.weight[row + slot]
            cost = area(box) * weight + bins.right_cost[k + 1]
            if cost < best:
                best = cost
                best_axis = axis
                best_slot = slot
    return best_axis, best_slot


@inlined
def partition(rows, begin, end, axis, last_left, bin_count, bounds, spare, sides):
    """Move items in bins after `last_left` behind the others, both in order; returns the middle.

    Rows of the right side wait in `spare`; the bounds of the centres on both sides go to `sides`.
    """
    clear_bounds(sides)
    # Close up the left side and set the right side apart: a row goes to both places, but only one counts.
    least = bounds[0, axis]
    scale = bin_scale(bounds, axis, bin_count)
    middle = begin
    waiting = 0
    for position in range(begin, end):
        slot = min(int((centre(rows.boxes, position, axis) - least) * scale), bin_count - 1)
        right = 1 if slot > last_left else 0
        grow_bounds(
            sides,
            right,
            centre(rows.boxes, position, 0),
            centre(rows.boxes, position, 1),
            centre(rows.boxes, position, 2),
        )
        a, b = rows.words[position, 0], rows.words[position, 1]
        c, d = rows.words[position, 2], rows.words[position, 3]
        rows.words[middle, 0], rows.words[middle, 1] = a, b
        rows.words[middle, 2], rows.words[middle, 3] = c, d
        spare[waiting, 0], spare[waiting, 1] = a, b
        spare[waiting, 2], spare[waiting, 3] = c, d
        middle += 1 - right
        waiting += right
    # Bring the right side back.
    for k in range(waiting):
        for word in range(4):
            rows.words[middle + k, word] = spare[k, word]
    return middle


@inlined
def load_short(rows, begin, count, short):
    """Copy a short range to `short`, and rank it by centre on each axis, equals in order."""
    for i in range(count):
        for k in range(6):
            short.boxes[i, k] = rows.boxes[begin + i, k]
        short.weight[i] = rows.numbers[begin + i, WEIGHT]
        for axis in range(3):
            short.centre[axis, i] = short.boxes[i, axis] + short.boxes[i, 3 + axis]
    for axis in range(3):
        # Count how many stand before each: a comparison a pair and no branch.
        for i in range(count):
            before = 0
            for j in range(i):
                later = 1 if short.centre[axis, j] > short.centre[axis, i] else 0
                short.before[j] += later
                before += 1 - later
            short.before[i] = before
        for i in range(count):
            short.rank[axis, short.before[i]] = i


@inlined
def sweep(short, begin, end):
    """The axis and the place (the first on the right) of the cheapest split over all places of all axes.

    Axis -1 where all centres are equal.
    """
    best = np.inf
    best_axis = -1
    best_place = 0
    for axis in range(3):
        if not short.centre[axis, short.rank[axis, end - 1]] > short.centre[axis, short.rank[axis, begin]]:
            continue
        # Gather the cost of the right side of each place.
        last = short.rank[axis, end - 1]
        box = row_box(short.boxes, last)
        weight = short.weight[last]
        short.right_cost[end - 1] = area(box) * weight
        for j in range(end - 2, begin, -1):
            i = short.rank[axis, j]
            box = join(box, short.boxes, i)
            weight += short.weight[i]
            short.right_cost[j] = area(box) * weight
        # Sweep from the left and keep the first of the cheapest places.
        box = row_box(short.boxes, short.rank[axis, begin])
        weight = 0.0
        for j in range(begin, end - 1):
            i = short.rank[axis, j]
            box = join(box, short.boxes, i)
            weight += short.weight[i]
            cost = area(box) * weight + short.right_cost[j + 1]
            if cost < best:
                best = cost
                best_axis = axis
                best_place = j + 1
    return best_axis, best_place


@inlined
def part_ranks(short, begin, end, axis, place):
    """Part the ranks of the other axes as the split at `place` of `axis` parts it, all in order."""
    for j in range(begin, end):
        short.goes_left[short.rank[axis, j]] = 1 if j < place else 0
    for other in range(3):
        if other == axis:
            continue
        # Close up the left side; the right side waits behind the ranks of all axes.
        left = begin
        waiting = 0
        for j in range(begin, end):
            i = short.rank[other, j]
            short.rank[other, left] = i
            short.rank[3, waiting] = i
            left += short.goes_left[i]
            waiting += 1 - short.goes_left[i]
        for k in range(waiting):
            short.rank[other, left + k] = short.rank[3, k]


@helper
def rank_by_place(rank, begin, end):
    """Rank a range by place instead of centre, on all axes."""
    for j in range(begin + 1, end):
        i = rank[0, j]
        k = j - 1
        while k >= begin and rank[0, k] > i:
            rank[0, k + 1] = rank[0, k]
            k -= 1
        rank[0, k + 1] = i
    for j in range(begin, end):
        rank[1, j] = rank[0, j]
        rank[2, j] = rank[0, j]


@inlined
def finish_leaf(rows, tree, node, first, place, i):
    """Put row `first + i` into the leaf `node`, the one at `place`."""
    item = rows.numbers[first + i, ITEM]
    tree.size[node] = 1
    tree.order[place] = item
    tree.leaf_node[item] = node


@inlined
def finish_few(rows, tree, node, first, begin, count, rank, axis):
    """Finish the node over the one or two rows that `rank[axis]` has from `begin` on, in their order."""
    if count == 1:
        finish_leaf(rows, tree, node, first, first + begin, rank[axis, begin])
    else:
        tree.size[node] = 2
        tree.parent[node + 1] = node
        tree.parent[node + 2] = node
        i, j = rank[axis, begin], rank[axis, begin + 1]
        finish_leaf(rows, tree, node + 1, first, first + begin, min(i, j))
        finish_leaf(rows, tree, node + 2, first, first + begin + 1, max(i, j))


@inlined
def split_short(rows, tree, node, first, count, depth, sah_depth, short):
    """Split the range of `node` over 3 rows and more, the first of them `first`, down to single items."""
    load_short(rows, first, count, short)
    begin = np.int64(0)
    end = count
    waiting = 0
    while True:
        # Split by the cheapest place, or in halves by place where there is none to find.
        tree.size[node] = end - begin
        axis, middle = -1, begin
        if depth < sah_depth:
            axis, middle = sweep(short, begin, end)
        if axis < 0:
            rank_by_place(short.rank, begin, end)
            axis = 0
            middle = begin + (end - begin + 1) // 2
        if middle - begin > 2 or end - middle > 2:
            part_ranks(short, begin, end, axis, middle)
        # Number the children: the left one follows its parent, the right one the left one's subtree.
        left = node + 1
        right = node + 2 * (middle - begin)
        tree.parent[left] = node
        tree.parent[right] = node
        depth += 1
        # Finish a side of one or two; of two longer sides the right one waits.
        if end - middle <= 2:
            finish_few(rows, tree, right, first, middle, end - middle, short.rank, axis)
        else:
            short.stack[waiting, 0] = right
            short.stack[waiting, 1] = middle
            short.stack[waiting, 2] = end
            short.stack[waiting, 3] = depth
            waiting += 1
        if middle - begin > 2:
            node = left
            end = middle
            continue
        finish_few(rows, tree, left, first, begin, middle - begin, short.rank, axis)
        # Take up the next waiting range.
        if waiting == 0:
            break
        waiting -= 1
        node = short.stack[waiting, 0]
        begin = short.stack[waiting, 1]
        end = short.stack[waiting, 2]
        depth = short.stack[waiting, 3]


@maker
def room_for_short(longest):
    """Room to split a short range of `longest` items."""
    return Short(
        np.empty((longest, 6), np.float64),
        np.empty(longest, np.float64),
        np.empty((3, longest), np.float64),
        np.empty((4, longest), np.int64),
        np.empty(longest, np.int64),
        np.empty(longest, np.float64),
        np.empty(longest, np.int64),
        np.empty((longest, 4), np.int64),
    )


@inlined
def rank_by_centre(rows, begin, count, bounds, axis, key, first, order, other):
    """List the places of a range by rising slots of their centres in order (count,), equals by place.

    There are SLOTS ** 2 slots along the axis; key and other (count,) and first (SLOTS + 1,) int64 are room.
    """
    low = bounds[0, axis]
    slots = (SLOTS * SLOTS - 1) / (bounds[0, 3 + axis] - low)
    for i in range(count):
        key[i] = np.int64((centre(rows.boxes, begin + i, axis) - low) * slots)
        other[i] = i
    # Sort by the lower digit of the slots, then by the upper one.
    for digit in range(2):
        for k in range(SLOTS + 1):
            first[k] = 0
        for i in range(count):
            first[1 + (key[i] // SLOTS if digit else key[i] % SLOTS)] += 1
        for k in range(SLOTS):
            first[k + 1] += first[k]
        for k in range(count):
            i = other[k] if digit == 0 else order[k]
            slot = key[i] // SLOTS if digit else key[i] % SLOTS
            if digit == 0:
                order[first[slot]] = i
            else:
                other[first[slot]] = i
            first[slot] += 1
    for k in range(count):
        order[k] = other[k]


@maker
def aligned_place(rows, begin, end, bounds, block, right_cost, goes_right):
    """Find the cheapest place, over three axes, that splits a range without asking for one block more.

    Returns:
        How many items go left (0 where all centres are equal); goes_right (count,) bool tells of each place.
    """
    count = end - begin
    blocks = (count + block - 1) // block
    best = np.inf
    best_place = 0
    key = np.empty(count, np.int64)
    rank = np.empty(count, np.int64)
    other = np.empty(count, np.int64)
    first = np.empty(SLOTS + 1, np.int64)
    for axis in range(3):
        if not bounds[0, 3 + axis] > bounds[0, axis]:
            continue
        rank_by_centre(rows, begin, count, bounds, axis, key, first, rank, other)
        # Gather the cost of the right side of each place.
        box = EMPTY_BOX
        weight = 0
        for j in range(count - 1, 0, -1):
            box = join(box, rows.boxes, begin + rank[j])
            weight += rows.numbers[begin + rank[j], WEIGHT]
            right_cost[j] = area(box) * weight
        # Sweep from the left and keep the first of the cheapest places that are allowed.
        box = EMPTY_BOX
        weight = 0
        best_here = 0
        for place in range(1, count):
            box = join(box, rows.boxes, begin + rank[place - 1])
            weight += rows.numbers[begin + rank[place - 1], WEIGHT]
            if (place + block - 1) // block + (count - place + block - 1) // block == blocks:
                cost = area(box) * weight + right_cost[place]
                if cost < best:
                    best = cost
                    best_here = place
        # Note the sides while the order is known.
        if best_here > 0:
            best_place = best_here
            for j in range(count):
                goes_right[rank[j]] = j >= best_here
    return best_place


@maker
def align(rows, begin, end, bounds, block, right_cost, spare, sides):
    """Split a range of few blocks so that they fill well; returns the middle, or `begin` where none is found.

    Rows move like those of `partition`: stably, with the bounds of the centres on both sides.
    """
    goes_right = np.empty(end - begin, np.bool_)
    if aligned_place(rows, begin, end, bounds, block, right_cost, goes_right) == 0:
        return begin
    clear_bounds(sides)
    middle = begin
    waiting = 0
    for position in range(begin, end):
        right = 1 if goes_right[position - begin] else 0
        grow_bounds(
            sides,
            right,
            centre(rows.boxes, position, 0),
            centre(rows.boxes, position, 1),
            centre(rows.boxes, position, 2),
        )
        for word in range(4):
            value = rows.words[position, word]
            rows.words[middle, word] = value
            spare[waiting, word] = value
        middle += 1 - right
        waiting += right
    # Bring the right side back.
    for k in range(waiting):
        for word in range(4):
            rows.words[middle + k, word] = spare[k, word]
    return middle


@kernel
def split_ranges(rows, tree, node, begin, end, depth, bin_count, sweep_below, sah_depth, block, grain, jobs):
    """Split the range of `node` down to single items, or to ranges of at most `grain` items.

    Ranges of `grain` items or fewer are written to jobs (rows node, begin, end, depth) and left alone; grain
    0 leaves none. Returns the number of jobs. Ranges at `sah_depth` or deeper are halved. Ranges of more than
    `block` items, up to ALIGNED_BLOCKS blocks, are split so that they fill the least number of blocks; block
    0 aligns none.
    """
    right_cost = np.empty(ALIGNED_BLOCKS * block + 1, np.float64)
    bins = Bins(
        np.empty((3 * bin_count, 6), np.float32),
        np.empty(3 * bin_count, np.int64),
        np.empty(bin_count, np.float64),
        np.empty(bin_count, np.int64),
    )
    short = room_for_short(max(2, sweep_below))
    spare = np.empty((end - begin + 1, 4), np.uint64)
    bounds = np.empty((1, 6), np.float64)
    sides = np.empty((2, 6), np.float64)
    # The larger side waits and the smaller goes first: at most log2(n) ranges wait.
    stack = np.empty((64, 4), np.int64)
    stack_bounds = np.empty((64, 6), np.float64)
    centre_bounds(rows.boxes, begin, end, bounds)
    waiting = 0
    job_count = 0
    while True:
        count = end - begin
        if count <= grain or count <= 2 or count < sweep_below:
            # Finish a short range, or set a range aside for another thread.
            if count <= grain:
                jobs[job_count, 0] = node
                jobs[job_count, 1] = begin
                jobs[job_count, 2] = end
                jobs[job_count, 3] = depth
                job_count += 1
            elif count <= 2:
                short.rank[0, 0] = 0
                short.rank[0, 1] = 1
                finish_few(rows, tree, node, begin, np.int64(0), count, short.rank, np.int64(0))
            else:
                split_short(rows, tree, node, begin, count, depth, sah_depth, short)
            # Take up the next waiting range.
            if waiting == 0:
                break
            waiting -= 1
            node = stack[waiting, 0]
            begin = stack[waiting, 1]
            end = stack[waiting, 2]
            depth = stack[waiting, 3]
            for k in range(6):
                bounds[0, k] = stack_bounds[waiting, k]
            continue
        # Split by the cheapest boundary of bins, or in halves where there is none to find.
        tree.size[node] = count
        axis, slot = -1, 0
        middle = begin
        if depth < sah_depth and block < count <= ALIGNED_BLOCKS * block:
            middle = align(rows, begin, end, bounds, block, right_cost, spare, sides)
        elif depth < sah_depth:
            fill_bins(rows, begin, end, bounds, bins)
            axis, slot = best_bin(bounds, bins)
        if middle > begin:
            pass
        elif axis >= 0:
            middle = partition(rows, begin, end, axis, slot, bin_count, bounds, spare, sides)
        else:
            middle = begin + (count + 1) // 2
            for k in range(6):
                sides[0, k] = bounds[0, k]
                sides[1, k] = bounds[0, k]
        # Number the children: the left one follows its parent, the right one the left one's subtree.
        left = node + 1
        right = node + 2 * (middle - begin)
        tree.parent[left] = node
        tree.parent[right] = node
        depth += 1
        larger = 0 if middle - begin > end - middle else 1
        for k in range(6):
            stack_bounds[waiting, k] = sides[larger, k]
            bounds[0, k] = sides[1 - larger, k]
        stack[waiting, 0] = right if larger else left
        stack[waiting, 1] = middle if larger else begin
        stack[waiting, 2] = end if larger else middle
        stack[waiting, 3] = depth
        waiting += 1
        node = left if larger else right
        if larger:
            end = middle
        else:
            begin = middle
    return job_count


@kernel
def depths(parent):
    """Inner nodes above each node of a preorder tree, (2n-1,) int32."""
    depth = np.empty(parent.shape[0], np.int32)
    depth[0] = 0
    for node in range(1, parent.shape[0]):
        depth[node] = depth[parent[node]] + 1
    return depth


@kernel
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
