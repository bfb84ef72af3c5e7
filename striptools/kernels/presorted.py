"""Kernels of presorted geometry: plain nodes above, triangles sorted into implicit trees, and their proof.

A tree over m triangles is a heap of ceil(m / 2) nodes, left-packed: node k owns the triangles 2k and 2k+1 of
the tree, its children are the nodes 2k+1 and 2k+2. Where m is odd the last node owns one.
"""

import numpy as np

from striptools.kernels.compiled import inlined, kernel

DEEPEST = 64
"""Ranges that may wait: one for each level of a heap."""

LEFT, RIGHT, OWNED = 0, 1, 2


@kernel
def top_nodes(size, boxes, levels, words, floats, starts):
    """Write the first levels of a preorder tree over one triangle a leaf as plain nodes.

    Args:
        size: (2n-1,) int32, the triangles below each node.
        boxes: (2n-1, 6) float32.
        levels: How many levels there may be, 1 or more; a node of the last one, or over two triangles or
            fewer, is a leaf.
        words: (>= nodes, 8) uint32, written: see `hierarchies.presorted.Presorted`.
        floats: The same memory as float32.
        starts: (>= leaves + 1,) int32, written: the first triangle of each leaf, then n.

    Returns:
        The number of nodes and of leaves.
    """
    stack = np.empty((levels + 1, 3), np.int64)
    stack[0, 0], stack[0, 1], stack[0, 2] = 0, 1, -1
    waiting, nodes, leaves, first = 1, 0, 0, 0
    while waiting > 0:
        # Take the next node of the preorder; its parent learns where a second child stands.
        waiting -= 1
        node, level, parent = stack[waiting, 0], stack[waiting, 1], stack[waiting, 2]
        if parent >= 0:
            words[parent, 6] = nodes
        for k in range(6):
            floats[nodes, k] = boxes[node, k]
        # End at the last level, or where a single presorted node owns all there is.
        if level == levels or size[node] <= 2:
            words[nodes, 6] = first
            words[nodes, 7] = size[node]
            starts[leaves] = first
            first += size[node]
            leaves += 1
        else:
            left = node + 1
            right = node + 2 * size[left]
            stack[waiting, 0], stack[waiting, 1], stack[waiting, 2] = right, level + 1, nodes
            stack[waiting + 1, 0], stack[waiting + 1, 1], stack[waiting + 1, 2] = left, level + 1, -1
            waiting += 2
        nodes += 1
    starts[leaves] = first
    return nodes, leaves


@kernel
def plain_depth(words):
    """The most nodes on a way down plain nodes, (t, 8) uint32.

    A child that is none, or stands before its parent, counts for nothing.
    """
    depth = np.zeros(len(words), np.int64)
    most = 0
    for node in range(len(words)):
        depth[node] += 1
        most = max(most, depth[node])
        if words[node, 7] == 0:
            for child in (node + 1, np.int64(words[node, 6])):
                if node < child < len(words):
                    depth[child] = max(depth[child], depth[node])
    return most


@inlined
def left_share(count):
    """How many triangles go left below a node that owns two of `count`, three or more."""
    nodes = (count + 1) // 2
    row = 1
    while 2 * row <= nodes:
        row *= 2
    # The last level has room for `row` nodes and holds `last`; the left half of it is filled first.
    last = nodes - (row - 1)
    half = row // 2
    left = 2 * (half - 1 + min(last, half))
    # The node that owns one triangle is the last of all.
    return left - count % 2 if last <= half else left


@inlined
def wins(reach, other_reach, spread, other_spread, item, other):
    """Whether an item reaches farther than another, or as far and spreads more, or has the lesser number."""
    if reach != other_reach:
        return reach > other_reach
    if spread != other_spread:
        return spread > other_spread
    return item < other


@inlined
def lowest(boxes, items, axis, begin, end):
    """The place of the item that begins first on an axis; of several that of the one that ends last."""
    best = begin
    for place in range(begin + 1, end):
        one, two = items[axis, place], items[axis, best]
        low, other_low = boxes[one, axis], boxes[two, axis]
        if wins(-low, -other_low, boxes[one, axis + 3], boxes[two, axis + 3], one, two):
            best = place
    return best


@inlined
def highest(boxes, items, axis, begin, end, but):
    """The place of the item that ends last on an axis, but for one place; of several: that begins first."""
    best = begin if but != begin else begin + 1
    for place in range(best + 1, end):
        one, two = items[axis, place], items[axis, best]
        low, other_low = boxes[one, axis], boxes[two, axis]
        if place != but and wins(boxes[one, axis + 3], boxes[two, axis + 3], -low, -other_low, one, two):
            best = place
    return best


@kernel
def sort_range(boxes, items, spare, side, order, base, begin, end, node, axis, grain, jobs):
    """Sort the triangles `begin:end` below a node into their places.

    Args:
        boxes: (n, 6) float32, of triangles.
        items: (3, n) int32, the triangles of the range by rising centre on each axis; consumed.
        spare: (n,) int32, room; the range's own part is used.
        side: (n,) uint8, room, by triangle.
        order: (n,) int32, written: the triangle at each place.
        base: The first place of the tree.
        begin: Of the range in `items`.
        end: Of the range in `items`.
        node: In its tree.
        axis: Of the node's slab.
        grain: Ranges of so many triangles or fewer are left alone, and written to jobs.
        jobs: (k, 4) int64, written: begin, end, node, axis.

    Returns:
        The number of jobs.
    """
    stack = np.empty((DEEPEST, 4), np.int64)
    waiting = found = 0
    while True:
        if end - begin <= grain:
            jobs[found, 0], jobs[found, 1], jobs[found, 2], jobs[found, 3] = begin, end, node, axis
            found += 1
            count = 0
        else:
            # Own the triangle that begins first, then that which ends last of the others.
            count = end - begin
            one = lowest(boxes, items, axis, begin, end)
            order[base + 2 * node] = items[axis, one]
            side[items[axis, one]] = OWNED
            if count > 1:
                two = highest(boxes, items, axis, begin, end, one)
                order[base + 2 * node + 1] = items[axis, two]
                side[items[axis, two]] = OWNED
        if count <= 2:
            # Take up the next waiting range.
            if waiting == 0:
                return found
            waiting -= 1
            begin, end = stack[waiting, 0], stack[waiting, 1]
            node, axis = stack[waiting, 2], stack[waiting, 3]
            continue

        # Halve the rest by centre on the axis of the children.
        axis = (axis + 1) % 3
        left = left_share(count)
        taken = 0
        for place in range(begin, end):
            item = items[axis, place]
            if side[item] != OWNED:
                side[item] = LEFT if taken < left else RIGHT
                taken += 1

        # Bring the halves apart on all axes, each still by rising centre; what is owned is left out.
        for k in range(3):
            to, kept = begin, begin
            for place in range(begin, end):
                item = items[k, place]
                if side[item] == LEFT:
                    items[k, to] = item
                    to += 1
                elif side[item] == RIGHT:
                    spare[kept] = item
                    kept += 1
            for place in range(begin, kept):
                items[k, to] = spare[place]
                to += 1

        # The right half waits.
        middle = begin + left
        if left < count - 2:
            stack[waiting, 0], stack[waiting, 1] = middle, begin + count - 2
            stack[waiting, 2], stack[waiting, 3] = 2 * node + 2, axis
            waiting += 1
        end = middle
        node = 2 * node + 1


@kernel
def sort_trees(boxes, items, spare, side, order, starts, first, last):
    """Sort the trees `first:last`, see `sort_range`.

    Args:
        boxes: (n, 6) float32, of triangles.
        items: (3, n) int32, the triangles of each tree by rising centre on each axis; consumed.
        spare: (n,) int32, room.
        side: (n,) uint8, room, zeros.
        order: (n,) int32, written.
        starts: (r+1,) int32.
        first: The first tree.
        last: One more than the last.
    """
    jobs = np.empty((0, 4), np.int64)
    for tree in range(first, last):
        begin, end = np.int64(starts[tree]), np.int64(starts[tree + 1])
        sort_range(
            boxes, items, spare, side, order, begin, begin, end, np.int64(0), np.int64(0), np.int64(0), jobs
        )


@kernel
def first_spill(boxes, starts):
    """The first triangle of a node whose slab does not hold what is below it; -1 where there is none.

    Args:
        boxes: (n, 6) float32, of triangles in their places.
        starts: (r+1,) int32, rising from 0 to n.
    """
    longest = 0
    for tree in range(len(starts) - 1):
        longest = max(longest, starts[tree + 1] - starts[tree])
    span = np.empty(((longest + 1) // 2, 6), np.float32)
    for tree in range(len(starts) - 1):
        base = np.int64(starts[tree])
        count = starts[tree + 1] - base
        nodes = (count + 1) // 2
        # Go up from the last node: children have their spans before their parents.
        depth, row = 0, 1
        while 2 * row <= nodes:
            depth, row = depth + 1, 2 * row
        for node in range(nodes - 1, -1, -1):
            while node + 1 < row:
                depth, row = depth - 1, row // 2
            # Span the owned triangles, and look at the slab that they give.
            place = base + 2 * node
            also = min(place + 1, base + count - 1)
            for k in range(3):
                span[node, k] = min(boxes[place, k], boxes[also, k])
                span[node, 3 + k] = max(boxes[place, 3 + k], boxes[also, 3 + k])
            axis = depth % 3
            low, high = span[node, axis], span[node, 3 + axis]
            # Join what is below, and compare; a comparison with NaN says no.
            for child in range(2 * node + 1, min(2 * node + 3, nodes)):
                for k in range(3):
                    span[node, k] = min(span[node, k], span[child, k])
                    span[node, 3 + k] = max(span[node, 3 + k], span[child, 3 + k])
            if not (low <= span[node, axis] and span[node, 3 + axis] <= high):
                return place
    return np.int64(-1)
