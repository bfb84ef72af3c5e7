"""Kernels of the quantised eight-wide nodes and of the runs that are their leaves.

A node is a record of sixteen words, SPEC 4.4; here its words and its bytes are two views of one array. Boxes
are put on the grid by exact arithmetic: the difference of two float32 is a float64 and its rounding error,
and cells are counted from both.
"""

import numpy as np

from striptools.kernels.compiled import inlined, kernel
from striptools.kernels.hierarchy import boxes_from_below
from striptools.kernels.object_split import (
    ITEM,
    WEIGHT,
    area,
    finish_few,
    join,
    room_for_short,
    row_box,
    split_short,
)
from striptools.kernels.wide import EMPTY, WIDTH, assign_lanes, cheapest_forests, gather_children

MOST_TRIANGLES = 256
"""Triangles of a block, and so its runs at most."""

LOW = 16
"""The first byte of a record's planes: low x, y, z, then high x, y, z, a byte a slot."""

MOST_PLANE = 255


@inlined
def rounding_error(a, b):
    """What the float64 difference a - b lacks of the exact one (Shewchuk's Two-Diff)."""
    x = a - b
    b_virtual = a - x
    a_virtual = x + b_virtual
    return (a - a_virtual) + (b_virtual - b)


@inlined
def cells_down(value, low, per_unit):
    """The last border of cells that is not above a float32 value, exactly; `low` is border 0."""
    a = np.float64(value)
    b = np.float64(low)
    cells = (a - b) * per_unit
    whole = np.floor(cells)
    short = whole == cells and rounding_error(a, b) < 0.0
    return np.int64(whole) - (1 if short else 0)


@inlined
def cells_up(value, low, per_unit):
    """The first border of cells that is not below a float32 value, exactly; `low` is border 0."""
    a = np.float64(value)
    b = np.float64(low)
    cells = (a - b) * per_unit
    whole = np.ceil(cells)
    short = whole == cells and rounding_error(a, b) > 0.0
    return np.int64(whole) + (1 if short else 0)


@kernel
def write_planes(record, boxes, children, child_in, low, per_unit, cells):
    """Write the origin, the shifts and the planes of a record; returns the three shifts.

    Args:
        record: (64,) uint8, written.
        boxes: (k, 6) float32.
        children: (8,) int64, the row of `boxes` of each child.
        child_in: (8,) int64, the child in each slot, -1 in empty ones.
        low: (3,) float32, the grid's.
        per_unit: (3,) float64, cells in a unit of length, a power of two.
        cells: (2, 8) int64, room.
    """
    shifts = (np.int64(0), np.int64(0), np.int64(0))
    for axis in range(3):
        # Put the children's boxes on the grid, and find the node's own.
        least = np.int64(1) << 40
        most = np.int64(0)
        for slot in range(WIDTH):
            if child_in[slot] >= 0:
                row = children[child_in[slot]]
                cells[0, slot] = cells_down(boxes[row, axis], low[axis], per_unit[axis])
                cells[1, slot] = cells_up(boxes[row, 3 + axis], low[axis], per_unit[axis])
                least = min(least, cells[0, slot])
                most = max(most, cells[1, slot])

        # Choose the finest steps that reach from side to side.
        shift = np.int64(0)
        while (most - least + (np.int64(1) << shift) - 1) >> shift > MOST_PLANE:
            shift += 1
        record[8 + 2 * axis] = least & 255
        record[9 + 2 * axis] = least >> 8

        # Round each child's sides outward to steps; turn empty slots inside out.
        for slot in range(WIDTH):
            below = np.int64(1)
            above = np.int64(0)
            if child_in[slot] >= 0:
                below = (cells[0, slot] - least) >> shift
                above = (cells[1, slot] - least + (np.int64(1) << shift) - 1) >> shift
            record[LOW + WIDTH * axis + slot] = below
            record[LOW + WIDTH * (3 + axis) + slot] = above
        shifts = (shifts[1], shifts[2], shift)
    return shifts


@kernel
def room_for_emission():
    """Room for `emit_nodes`: stacks of `gather_children`, children, their lanes, and cells."""
    return (
        np.empty(4 * WIDTH, np.int64),
        np.empty(4 * WIDTH, np.int64),
        np.empty(WIDTH, np.int64),
        np.empty(WIDTH, np.int64),
        np.empty(WIDTH, np.int64),
        np.empty(WIDTH, np.int64),
        np.empty((2, WIDTH), np.int64),
    )


@kernel
def emit_nodes(
    boxes,
    size,
    split,
    items,
    low,
    per_unit,
    words,
    records,
    root,
    free,
    shift_rows,
    step,
    tag,
    leaves,
    stack,
    room,
):
    """Write the wide nodes that `cheapest_forests` chose, one item a leaf.

    Args:
        boxes: (2k-1, 6) float32, preorder.
        size: (2k-1,) int32, items below each node.
        split: (2k-1, 9) int8, of `cheapest_forests`.
        items: (k,) int32, the item at each leaf.
        low: (3,) float32, the grid's.
        per_unit: (3,) float64, cells in a unit of length.
        words: (w, 16) uint32, the records, written.
        records: (w, 64) uint8, the same memory.
        root: The row of the root.
        free: The first row for others.
        shift_rows: What is taken from a row to give the node that `base` names.
        step: What a leaf counts in the word `leaves`.
        tag: What else stands in that word where there are leaves.
        leaves: (k,) int32, written: items in the order in which leaves are numbered.
        stack: (k + 8, 3) int64, room.
        room: Of `room_for_emission`.

    Returns:
        The first row that is still free.
    """
    nodes, budget, children, lane_of, child_in, first_of, cells = room
    stack[0, 0] = root
    stack[0, 1] = 0
    stack[0, 2] = 0
    waiting = 1
    leaf_count = 0
    while waiting > 0:
        waiting -= 1
        row = stack[waiting, 0]
        p = stack[waiting, 1]
        first = stack[waiting, 2]

        # Choose the children and their slots; a root of one item is its own only child.
        children[0] = p
        found = 1
        if size[p] > 1:
            found = gather_children(p, size, split, nodes, budget, children)
        assign_lanes(boxes, p, children, found, lane_of)
        for slot in range(WIDTH):
            child_in[slot] = -1
        for i in range(found):
            child_in[lane_of[i]] = i
            first_of[i] = first
            first += size[children[i]]

        # Number the leaves and the inner children by slot.
        first_leaf = leaf_count
        inner = np.int64(0)
        base = free
        for slot in range(WIDTH):
            i = child_in[slot]
            if i < 0:
                continue
            if size[children[i]] == 1:
                leaves[leaf_count] = items[first_of[i]]
                leaf_count += 1
            else:
                inner |= np.int64(1) << slot
                free += 1

        # Let the inner children wait, the first on top: what is visited together lies together.
        row_of = free
        for slot in range(WIDTH - 1, -1, -1):
            if (inner >> slot) & 1:
                row_of -= 1
                stack[waiting, 0] = row_of
                stack[waiting, 1] = children[child_in[slot]]
                stack[waiting, 2] = first_of[child_in[slot]]
                waiting += 1

        # Write the record.
        shifts = write_planes(records[row], boxes, children, child_in, low, per_unit, cells)
        words[row, 0] = (base - shift_rows if inner > 0 else 0) | shifts[0] << 28
        words[row, 1] = first_leaf * step | tag if leaf_count > first_leaf else 0
        records[row, 14] = inner
        records[row, 15] = shifts[1] | shifts[2] << 4
    return free


@kernel
def cut_strip(boxes, begin, end, longest, price, cost, back):
    """Choose the runs of one strip: least sum of half areas and of a price a run.

    Args:
        boxes: (n, 6) float32, of the triangles.
        begin: The strip's first triangle.
        end: Where it ends.
        longest: The most triangles of a run.
        price: What a run costs beside its area.
        cost: (257,) float64, room.
        back: (257,) int64, written: triangles of the run that ends before each place.
    """
    cost[0] = 0.0
    for place in range(1, end - begin + 1):
        box = row_box(boxes, begin + place - 1)
        best = cost[place - 1] + area(box)
        back[place] = 1
        for count in range(2, min(longest, place) + 1):
            box = join(box, boxes, begin + place - count)
            c = cost[place - count] + area(box)
            if c <= best:
                best = c
                back[place] = count
        cost[place] = best + price


@kernel
def cut_block(boxes, strip_starts, strip, begin, end, longest, price, cost, back, run_first, run_count):
    """Cut the strips of a block into runs.

    Args:
        boxes: (n, 6) float32, of the triangles.
        strip_starts: (s+1,) int32.
        strip: The block's first strip.
        begin: The block's first triangle.
        end: Where it ends.
        longest: The most triangles of a run.
        price: What a run costs beside its area, in half areas of the block.
        cost: (257,) float64, room.
        back: (257,) int64, room.
        run_first: (256,) int64, written: the first triangle of each run, counted in the block.
        run_count: (256,) int64, written: its triangles.

    Returns:
        The number of runs, and the first strip of the next block.
    """
    whole = row_box(boxes, begin)
    for triangle in range(begin + 1, end):
        whole = join(whole, boxes, triangle)
    price *= area(whole)
    runs = np.int64(0)
    while strip < len(strip_starts) - 1 and strip_starts[strip] < end:
        first = np.int64(strip_starts[strip])
        stop = np.int64(strip_starts[strip + 1])
        cut_strip(boxes, first, stop, longest, price, cost, back)

        # Count the runs, then write them from the last to the first.
        found = np.int64(0)
        place = stop - first
        while place > 0:
            place -= back[place]
            found += 1
        place = stop - first
        for run in range(runs + found - 1, runs - 1, -1):
            run_count[run] = back[place]
            place -= back[place]
            run_first[run] = first - begin + place
        runs += found
        strip += 1
    return runs, strip


@kernel
def build_blocks(
    boxes,
    block_starts,
    strip_starts,
    begin,
    end,
    longest,
    run_price,
    node_price,
    low,
    per_unit,
    rows,
    tree,
    words,
    records,
    run_counts,
    runs,
):
    """Cut the strips of the blocks `begin:end` into runs and write the nodes over them.

    Args:
        boxes: (n, 6) float32, of the triangles in file order.
        block_starts: (b+1,) int32, in triangles.
        strip_starts: (s+1,) int32, in triangles.
        begin: The first block.
        end: Where they end.
        longest: The most triangles of a run.
        run_price: What a run costs beside its area, in half areas of the block.
        node_price: What a node costs beside its visits, in visits of the block's root.
        low: (3,) float32, the grid's.
        per_unit: (3,) float64, cells in a unit of length.
        rows: Room, an `object_split.Rows` of 256.
        tree: Room, an `object_split.Tree` over 256 items.
        words: (>= end - begin + nodes, 16) uint32, written: the roots, then the others, whose number 0 is the
            one behind the roots.
        records: The same memory as (.., 64) uint8.
        run_counts: (b,) uint32, written for these blocks.
        runs: (>= r,) uint32, written: the runs of these blocks, bits 0 to 10 of them.

    Returns:
        How many nodes there are beside the roots, and how many runs.
    """
    cost = np.empty(MOST_TRIANGLES + 1, np.float64)
    back = np.empty(MOST_TRIANGLES + 1, np.int64)
    run_first = np.empty(MOST_TRIANGLES, np.int64)
    run_count = np.empty(MOST_TRIANGLES, np.int64)
    leaves = np.empty(MOST_TRIANGLES, np.int32)
    stack = np.empty((MOST_TRIANGLES + WIDTH, 3), np.int64)
    leaf_boxes = np.empty((MOST_TRIANGLES, 6), np.float32)
    short = room_for_short(MOST_TRIANGLES)
    room = room_for_emission()
    one, none = np.float32(1.0), np.float32(0.0)
    price = np.float32(node_price)
    roots = end - begin
    free = roots
    written = np.int64(0)
    strip = np.int64(np.searchsorted(strip_starts, block_starts[begin]))
    for block in range(begin, end):
        # Cut the strips into runs.
        first = np.int64(block_starts[block])
        stop = np.int64(block_starts[block + 1])
        count, strip = cut_block(
            boxes, strip_starts, strip, first, stop, longest, run_price, cost, back, run_first, run_count
        )

        # Box the runs.
        for run in range(count):
            triangle = first + run_first[run]
            box = row_box(boxes, triangle)
            for k in range(1, run_count[run]):
                box = join(box, boxes, triangle + k)
            rows.boxes[run, 0], rows.boxes[run, 1], rows.boxes[run, 2] = box[0], box[1], box[2]
            rows.boxes[run, 3], rows.boxes[run, 4], rows.boxes[run, 5] = box[3], box[4], box[5]
            rows.numbers[run, ITEM] = run
            rows.numbers[run, WEIGHT] = 1

        # Split them by the surface area heuristic, box the tree, and collapse it.
        if count > 2:
            split_short(rows, tree, 0, 0, count, 0, MOST_TRIANGLES, short)
        else:
            short.rank[0, 0] = 0
            short.rank[0, 1] = 1
            finish_few(rows, tree, 0, 0, np.int64(0), count, short.rank, np.int64(0))
        for place in range(count):
            for k in range(6):
                leaf_boxes[place, k] = rows.boxes[tree.order[place], k]
        size = tree.size[: 2 * count - 1]
        node_boxes = boxes_from_below(size, leaf_boxes[:count])
        split, _, _ = cheapest_forests(node_boxes, size, WIDTH, 1, one, one, none, price)

        # Write the nodes, then the runs in the order that the nodes give them.
        tag = np.int64(block)
        free = emit_nodes(
            node_boxes, size, split, tree.order, low, per_unit, words, records, block - begin, free, roots,
            np.int64(1 << 24), tag, leaves, stack, room,
        )  # fmt: skip
        for k in range(count):
            run = leaves[k]
            runs[written + k] = run_first[run] | (run_count[run] - 1) << 8
        run_counts[block] = count
        written += count
    return free - roots, written


@kernel
def build_top(boxes, size, items, low, per_unit, words, records, order):
    """Write the nodes over blocks.

    Args:
        boxes: (2b-1, 6) float32, preorder.
        size: (2b-1,) int32, blocks below each node; b >= 2.
        items: (b,) int32, the block at each leaf.
        low: (3,) float32, the grid's.
        per_unit: (3,) float64, cells in a unit of length.
        words: (b, 16) uint32, written.
        records: The same memory as (b, 64) uint8.
        order: (b,) int32, written: the block that goes to each place.

    Returns:
        How many nodes there are.
    """
    one, none = np.float32(1.0), np.float32(0.0)
    split, _, _ = cheapest_forests(boxes, size, WIDTH, 1, one, one, none, none)
    stack = np.empty((len(items) + WIDTH, 3), np.int64)
    count = emit_nodes(
        boxes, size, split, items, low, per_unit, words, records, np.int64(0), np.int64(1), np.int64(0),
        np.int64(1), np.int64(0), order, stack, room_for_emission(),
    )  # fmt: skip
    mark_leaves(words, records, count)
    return count


@kernel
def mark_leaves(words, records, count):
    """Write to bits 24 to 31 of the word `leaves` of nodes over blocks which of their slots are leaves."""
    for node in range(count):
        leaves = np.int64(0)
        for slot in range(WIDTH):
            used = records[node, LOW + slot] <= records[node, LOW + 3 * WIDTH + slot]
            if used and (records[node, 14] >> slot) & 1 == 0:
                leaves |= np.int64(1) << slot
        words[node, 1] |= leaves << 24


@kernel
def slot_children(words, top_count, first_run, child):
    """Write what each slot holds: a node, a run (of all runs) as -(run + 1), or `EMPTY`.

    Args:
        words: (m, 16) uint32.
        top_count: Nodes over blocks.
        first_run: (b,) uint32.
        child: (m, 8) int32, written.
    """
    for node in range(len(words)):
        base = np.int64(words[node, 0]) & 0xFFFFFFF
        leaf = np.int64(words[node, 1]) & 0xFFFFFF
        if node >= top_count:
            leaf = np.int64(first_run[leaf]) + (np.int64(words[node, 1]) >> 24)
        inner = np.int64(words[node, 3]) >> 16 & 255
        for slot in range(WIDTH):
            below = np.int64(words[node, 4 + slot // 4]) >> 8 * (slot % 4) & 255
            above = np.int64(words[node, 10 + slot // 4]) >> 8 * (slot % 4) & 255
            if (inner >> slot) & 1:
                child[node, slot] = base
                base += 1
            elif below > above:
                child[node, slot] = EMPTY
            elif node < top_count:
                child[node, slot] = top_count + leaf
                leaf += 1
            else:
                child[node, slot] = -(leaf + 1)
                leaf += 1


@kernel
def exact_boxes(child, leaf_first, leaf_count, triangle_boxes):
    """The exact box of what each slot holds, inside out in empty slots: (m, 6, 8) float32.

    Args:
        child: (m, 8) int32, nodes after their parents, leaves as -(leaf + 1), or `EMPTY`.
        leaf_first: (r,) int32, in file order.
        leaf_count: (r,) int32.
        triangle_boxes: (n, 6) float32.
    """
    boxes = np.empty((len(child), 6, WIDTH), np.float32)
    for node in range(len(child) - 1, -1, -1):
        for slot in range(WIDTH):
            # Join the boxes of a leaf's triangles, or of a node's slots.
            c = child[node, slot]
            for axis in range(3):
                low = np.float32(np.inf)
                high = np.float32(-np.inf)
                if c >= 0:
                    for k in range(WIDTH):
                        low = min(low, boxes[c, axis, k])
                        high = max(high, boxes[c, axis + 3, k])
                elif c != EMPTY:
                    first = leaf_first[-(c + 1)]
                    for t in range(first, first + leaf_count[-(c + 1)]):
                        low = min(low, triangle_boxes[t, axis])
                        high = max(high, triangle_boxes[t, axis + 3])
                boxes[node, axis, slot] = low
                boxes[node, axis + 3, slot] = high
    return boxes


@kernel
def in_visiting_order(child, boxes):
    """Renumber nodes such that those visited together lie together, parents first.

    Args:
        child: (m, 8) int32, each node but 0 the child of one slot.
        boxes: (m, 6, 8) float32.

    Returns:
        Both in the new order, and the most nodes on a way down.
    """
    count = len(child)
    placed_child = np.empty_like(child)
    placed_boxes = np.empty_like(boxes)
    stack = np.empty((count + WIDTH, 3), np.int64)
    stack[0, 0] = 0
    stack[0, 1] = 0
    stack[0, 2] = 1
    waiting = 1
    free = 1
    depth = np.int64(1)
    while waiting > 0:
        waiting -= 1
        old = stack[waiting, 0]
        new = stack[waiting, 1]
        level = stack[waiting, 2]
        depth = max(depth, level)
        for k in range(6):
            for slot in range(WIDTH):
                placed_boxes[new, k, slot] = boxes[old, k, slot]

        # Number the children here, and visit the first of them next.
        for slot in range(WIDTH):
            c = child[old, slot]
            placed_child[new, slot] = free if c >= 0 else c
            free += 1 if c >= 0 else 0
        for slot in range(WIDTH - 1, -1, -1):
            if child[old, slot] >= 0:
                stack[waiting, 0] = child[old, slot]
                stack[waiting, 1] = placed_child[new, slot]
                stack[waiting, 2] = level + 1
                waiting += 1
    return placed_child, placed_boxes, depth
