"""The event build of a kd-tree: the loops behind hierarchies/kdtree.py.

A *cell* is a box of space with the objects in it, each with its *part*: the box of what of it is in the cell.
An *event* is a side of a part along an axis, in one word of 64 bits that sorts as it should: the position in
the upper 32, its bits turned so that unsigned numbers rise with it, then two bits of kind (END before PLANAR
before START), then the place of the object in its cell. Events are sorted once; a split keeps them sorted.
"""

from collections import namedtuple

import numpy as np

from striptools.kernels.boxes import half_area
from striptools.kernels.compiled import helper, inlined, kernel, maker

Cell = namedtuple("Cell", "bounds parts objects events begin_y begin_z room")
"""bounds (6,) float32, low then high; parts (k, 6) float32; objects (k,) uint32, rising; events (e,) uint64,
those along x, from begin_y on along y, from begin_z on along z; room float64, the most leaves and references
of the tree below, together, at least k + 1."""

Plane = namedtuple("Plane", "axis position planar_below cost")
"""Where to split: axis -1 is nowhere; objects that lie in the plane go below it or above."""

Costs = namedtuple("Costs", "traversal intersection empty_bonus corrected")
"""`partition.sah.KdCosts` as float64, and whether the metric is corrected for mail-boxing."""

END, PLANAR, START = np.uint64(0), np.uint64(1), np.uint64(2)
KIND_SHIFT = np.uint64(30)
POSITION_SHIFT = np.uint64(32)
PLACE = np.uint64((1 << 30) - 1)
HEAD = np.uint64(0xFFFFFFFFC0000000)
LEAF = 3
RUN = 16
"""Words that are sorted by insertion before runs of them are merged."""

BELOW, ABOVE = 0, 1


@inlined
def word_of(position, kind, place):
    """The event of a side."""
    bits = np.float32(position + np.float32(0)).view(np.int32)
    turned = np.int64(bits) ^ (np.int64(0x7FFFFFFF) if bits < 0 else np.int64(0))
    upper = np.uint64(turned + np.int64(0x80000000))
    return upper << POSITION_SHIFT | kind << KIND_SHIFT | np.uint64(place)


@inlined
def position_of(event):
    """The position of an event."""
    turned = np.int64(event >> POSITION_SHIFT) - np.int64(0x80000000)
    bits = turned ^ (np.int64(0x7FFFFFFF) if turned < 0 else np.int64(0))
    return np.int32(bits).view(np.float32)


@inlined
def put_events(events, count, low, high, place):
    """Append the events of a part along an axis; return how many there are then."""
    if low == high:
        events[count] = word_of(low, PLANAR, place)
        return count + 1
    events[count] = word_of(low, START, place)
    events[count + 1] = word_of(high, END, place)
    return count + 2


@helper
def sort_words(words, count, room):
    """Sort the first words: by insertion in short runs, then by merging these."""
    for begin in range(0, count, RUN):
        for k in range(begin + 1, min(begin + RUN, count)):
            word = words[k]
            place = k
            while place > begin and words[place - 1] > word:
                words[place] = words[place - 1]
                place -= 1
            words[place] = word
    width = RUN
    while width < count:
        for begin in range(0, count, 2 * width):
            middle = min(begin + width, count)
            merge_words(words[begin:middle], words[middle : min(begin + 2 * width, count)], room[begin:])
        for k in range(count):
            words[k] = room[k]
        width *= 2


@helper
def merge_words(one, other, out):
    """Merge two sorted arrays of words into a third."""
    i = 0
    j = 0
    for k in range(one.shape[0] + other.shape[0]):
        if j == other.shape[0] or (i < one.shape[0] and one[i] <= other[j]):
            out[k] = one[i]
            i += 1
        else:
            out[k] = other[j]
            j += 1


@kernel
def root_cell(boxes, room):
    """The cell that holds all objects, and their sorted events; its tree has `room`, see `Cell`."""
    count = boxes.shape[0]
    bounds = np.empty(6, np.float32)
    for axis in range(3):
        bounds[axis] = np.inf
        bounds[3 + axis] = -np.inf
    parts = np.empty((count, 6), np.float32)
    objects = np.empty(count, np.uint32)
    for k in range(count):
        objects[k] = k
        for axis in range(3):
            # Adding zero makes a zero positive, so that equal positions have equal bits.
            parts[k, axis] = boxes[k, axis] + np.float32(0)
            parts[k, 3 + axis] = boxes[k, 3 + axis] + np.float32(0)
            bounds[axis] = min(bounds[axis], parts[k, axis])
            bounds[3 + axis] = max(bounds[3 + axis], parts[k, 3 + axis])

    # Write the events of each axis after those of the one before, and sort them.
    events = np.empty(6 * count, np.uint64)
    spare = np.empty(2 * count, np.uint64)
    begin = np.zeros(4, np.int64)
    for axis in range(3):
        section = events[begin[axis] :]
        found = 0
        for k in range(count):
            found = put_events(section, found, parts[k, axis], parts[k, 3 + axis], k)
        sort_words(section, found, spare)
        begin[axis + 1] = begin[axis] + found
    return Cell(bounds, parts, objects, events[: begin[3]].copy(), begin[1], begin[2], room)


@inlined
def split_cost(costs, below, above, both, share_below, share_above, share_both):
    """Expected cost of a split whose sides are leaves: Hunt's formula, or without its last term."""
    tests = share_below * below + share_above * above
    if costs.corrected:
        tests -= share_both * both
    cost = costs.traversal + costs.intersection * tests
    return cost * (1.0 - costs.empty_bonus) if below == 0 or above == 0 else cost


@kernel
def best_plane(cell, costs):
    """The plane of least cost inside a cell, first axis and first position among equals.

    None where no plane costs less than testing all objects.
    """
    count = cell.objects.shape[0]
    bounds = cell.bounds
    best = Plane(-1, np.float32(0), False, costs.intersection * count)
    whole = half_area(bounds[0], bounds[1], bounds[2], bounds[3], bounds[4], bounds[5])
    if not whole > 0.0:
        return best
    for axis in range(3):
        low = bounds[axis]
        high = bounds[3 + axis]
        one = (axis + 1) % 3
        other = (axis + 2) % 3
        across = np.float64(bounds[3 + one]) - np.float64(bounds[one])
        down = np.float64(bounds[3 + other]) - np.float64(bounds[other])
        # A ray is on both sides with the probability of crossing the plane.
        ring = (across + down) / whole
        share_both = across * down / whole
        begin = 0 if axis == 0 else (cell.begin_y if axis == 1 else cell.begin_z)
        end = cell.begin_y if axis == 0 else (cell.begin_z if axis == 1 else cell.events.shape[0])
        below = 0
        above = count
        k = begin
        while k < end:
            # Count what starts, lies and ends at a position.
            upper = cell.events[k] >> POSITION_SHIFT
            position = position_of(cell.events[k])
            ends = 0
            planar = 0
            starts = 0
            while k < end and cell.events[k] >> POSITION_SHIFT == upper:
                kind = (cell.events[k] >> KIND_SHIFT) & np.uint64(3)
                ends += kind == END
                planar += kind == PLANAR
                starts += kind == START
                k += 1

            # Weigh a split there, with the planar ones below or above.
            above -= planar + ends
            if low < position < high:
                share_below = share_both + (np.float64(position) - np.float64(low)) * ring
                share_above = share_both + (np.float64(high) - np.float64(position)) * ring
                both = below + planar + above - count
                cost = split_cost(costs, below + planar, above, both, share_below, share_above, share_both)
                if cost < best.cost:
                    best = Plane(axis, position, True, cost)
                if planar > 0:
                    cost = split_cost(
                        costs, below, above + planar, both, share_below, share_above, share_both
                    )
                    if cost < best.cost:
                        best = Plane(axis, position, False, cost)
            below += planar + starts
    return best


@kernel
def clip_part(corners, bounds, part, room):
    """Shrink a part, the box of what of a triangle is in some box, to what of it is in `bounds`.

    Args:
        corners: (3, 3) float32.
        bounds: (6,) float32.
        part: (6,) float32, which meets the bounds; written. Rounded outward.
        room: (2, 12, 3) float64.
    """
    count = 3
    now = 0
    for j in range(3):
        for axis in range(3):
            room[0, j, axis] = corners[j, axis]

    # Cut the polygon by each side in turn (Sutherland and Hodgman, 1974).
    for side in range(6):
        axis = side % 3
        sign = 1.0 if side < 3 else -1.0
        plane = np.float64(bounds[side])
        kept = 0
        for j in range(count):
            k = j + 1 if j + 1 < count else 0
            here = (room[now, j, axis] - plane) * sign
            there = (room[now, k, axis] - plane) * sign
            if here >= 0.0:
                for a in range(3):
                    room[1 - now, kept, a] = room[now, j, a]
                kept += 1
            if (here > 0.0 and there < 0.0) or (here < 0.0 and there > 0.0):
                share = here / (here - there)
                for a in range(3):
                    room[1 - now, kept, a] = room[now, j, a] + share * (room[now, k, a] - room[now, j, a])
                room[1 - now, kept, axis] = plane
                kept += 1
        now = 1 - now
        count = kept

    # Round the polygon's box outward, and never leave the bounds nor the part.
    for axis in range(3):
        low = max(part[axis], bounds[axis])
        high = min(part[3 + axis], bounds[3 + axis])
        least = np.inf
        most = -np.inf
        for j in range(count):
            least = min(least, room[now, j, axis])
            most = max(most, room[now, j, axis])
        if count > 0:
            low = max(low, min(rounded_down(least), high))
            high = min(high, max(-rounded_down(-most), low))
        part[axis] = low
        part[3 + axis] = high


@inlined
def rounded_down(value):
    """The largest float32 that is at most a value."""
    near = np.float32(value)
    return np.nextafter(near, np.float32(-np.inf)) if near > value else near


@helper
def shares_of(cell, plane, place, straddles):
    """Say of each object which place it gets below and above the plane, -1 for none; return how many."""
    below = 0
    above = 0
    for k in range(cell.objects.shape[0]):
        low = cell.parts[k, plane.axis]
        high = cell.parts[k, 3 + plane.axis]
        flat = low == high and low == plane.position
        goes_below = low < plane.position or (flat and plane.planar_below)
        goes_above = high > plane.position or (flat and not plane.planar_below)
        straddles[k] = goes_below and goes_above
        place[BELOW, k] = below if goes_below else -1
        place[ABOVE, k] = above if goes_above else -1
        below += goes_below
        above += goes_above
    return below, above


@maker
def child_cell(cell, plane, side, count, share, place, straddles, corners, room):
    """The cell on one side of a plane."""
    bounds = cell.bounds.copy()
    bounds[plane.axis + (3 if side == BELOW else 0)] = plane.position
    parts = np.empty((count, 6), np.float32)
    objects = np.empty(count, np.uint32)
    straddlers = 0

    # Take the objects, and clip those that are on both sides.
    for k in range(cell.objects.shape[0]):
        to = place[k]
        if to >= 0:
            objects[to] = cell.objects[k]
            for j in range(6):
                parts[to, j] = cell.parts[k, j]
            if straddles[k]:
                straddlers += 1
                if corners.shape[0] > 0:
                    clip_part(corners[cell.objects[k]], bounds, parts[to], room)
                elif side == BELOW:
                    parts[to, 3 + plane.axis] = plane.position
                else:
                    parts[to, plane.axis] = plane.position

    # Of each axis keep the events in their order, and merge in new ones for what was clipped.
    events = np.empty(6 * count, np.uint64)
    kept = np.empty(2 * count, np.uint64)
    fresh = np.empty(2 * straddlers, np.uint64)
    spare = np.empty(2 * straddlers, np.uint64)
    total = 0
    begin_y = 0
    begin_z = 0
    for axis in range(3):
        first = 0 if axis == 0 else (cell.begin_y if axis == 1 else cell.begin_z)
        last = cell.begin_y if axis == 0 else (cell.begin_z if axis == 1 else cell.events.shape[0])
        old = 0
        for e in range(first, last):
            k = np.int64(cell.events[e] & PLACE)
            if place[k] >= 0 and not straddles[k]:
                kept[old] = (cell.events[e] & HEAD) | np.uint64(place[k])
                old += 1
        new = 0
        for k in range(cell.objects.shape[0]):
            to = place[k]
            if to >= 0 and straddles[k]:
                new = put_events(fresh, new, parts[to, axis], parts[to, 3 + axis], to)
        sort_words(fresh, new, spare)
        merge_words(kept[:old], fresh[:new], events[total:])
        total += old + new
        if axis == 0:
            begin_y = total
        if axis == 1:
            begin_z = total
    return Cell(bounds, parts, objects, events[:total].copy(), begin_y, begin_z, share)


@kernel
def split_cell(cell, plane, corners):
    """The cells below and above a plane, and whether there is room for both; they share it by their objects.

    Args:
        cell: The cell.
        plane: As from `best_plane`, strictly inside it.
        corners: (n, 3, 3) float32 of the objects where they are triangles to be clipped, else (0, 3, 3).
    """
    count = cell.objects.shape[0]
    place = np.empty((2, count), np.int32)
    straddles = np.empty(count, np.bool_)
    room = np.empty((2, 12, 3), np.float64)
    below, above = shares_of(cell, plane, place, straddles)
    asked = below + above + 2
    if cell.room < asked:
        return cell, cell, False
    one = cell.room * (below + 1) / asked
    other = cell.room * (above + 1) / asked
    return (
        child_cell(cell, plane, BELOW, below, one, place[BELOW], straddles, corners, room),
        child_cell(cell, plane, ABOVE, above, other, place[ABOVE], straddles, corners, room),
        True,
    )


@kernel
def grow_tree(cell, depth, deepest, costs, corners):
    """The tree under a cell.

    Args:
        cell: The cell.
        depth: Of the cell.
        deepest: Cells at this depth are leaves.
        costs: `Costs`.
        corners: See `split_cell`.

    Returns:
        Nodes (m, 2) uint32 and references (k,) uint32 as in `hierarchies.kdtree.KdTree`.
    """
    nodes = np.empty((1024, 2), np.uint32)
    references = np.empty(1024, np.uint32)
    count = 0
    used = 0
    waiting = [(cell, depth, -1)]
    while len(waiting) > 0:
        cell, depth, parent = waiting.pop()
        if count == nodes.shape[0]:
            more = np.empty((2 * count, 2), np.uint32)
            more[:count] = nodes
            nodes = more
        if parent >= 0:
            nodes[parent, 1] |= np.uint32(4 * count)

        # Split where it pays and there is room.
        plane = best_plane(cell, costs)
        below, above, fits = cell, cell, False
        if plane.axis >= 0 and depth < deepest:
            below, above, fits = split_cell(cell, plane, corners)
        if fits:
            nodes[count, 0] = np.float32(plane.position).view(np.uint32)
            nodes[count, 1] = plane.axis
            waiting.append((above, depth + 1, count))
            waiting.append((below, depth + 1, -1))
            count += 1
            continue

        # Else make a leaf of the objects.
        here = cell.objects.shape[0]
        while used + here > references.shape[0]:
            longer = np.empty(2 * references.shape[0], np.uint32)
            longer[:used] = references[:used]
            references = longer
        references[used : used + here] = cell.objects
        nodes[count, 0] = used
        nodes[count, 1] = 4 * here + LEAF
        used += here
        count += 1
    return nodes[:count].copy(), references[:used].copy()


SOUND = 0
NOT_INSIDE, NOT_PREORDER, NOT_IN_ORDER, NOT_OBJECTS, TOO_DEEP, NOT_REACHED = range(1, 7)


@kernel
def structure_flaw(nodes, references, low, high, objects, deepest):
    """The first flaw of a tree's form, and the node that has it; SOUND where there is none.

    Sound means: nodes are in preorder, each reached once; every split lies inside its cell, so that cells
    tile the root's; leaves take the references one after another, each those of `objects` in rising order.
    """
    count = nodes.shape[0]
    bounds = np.empty((deepest + 1, 6), np.float32)
    above = np.empty(deepest + 1, np.int64)
    used = np.int64(0)
    here = np.int64(0)
    depth = 0
    height = 0
    depths = np.empty(deepest + 1, np.int64)
    cell = np.empty(6, np.float32)
    for axis in range(3):
        cell[axis] = low[axis]
        cell[3 + axis] = high[axis]
    while True:
        if here >= count:
            return NOT_PREORDER, count - 1
        axis = np.int64(nodes[here, 1] & 3)
        if axis != LEAF:
            # Keep the cell above a split for later, and go on below it.
            position = np.uint32(nodes[here, 0]).view(np.float32)
            if depth == deepest:
                return TOO_DEEP, here
            if not (cell[axis] < position and position < cell[3 + axis]):
                return NOT_INSIDE, here
            bounds[height] = cell
            bounds[height, axis] = position
            above[height] = np.int64(nodes[here, 1] >> 2)
            depth += 1
            depths[height] = depth
            height += 1
            cell[3 + axis] = position
            here += 1
            continue

        # A leaf's references follow those of the leaf before it.
        length = np.int64(nodes[here, 1] >> 2)
        if np.int64(nodes[here, 0]) != used or used + length > references.shape[0]:
            return NOT_IN_ORDER, here
        for k in range(used, used + length):
            if references[k] >= objects or (k > used and references[k] <= references[k - 1]):
                return NOT_OBJECTS, here
        used += length
        here += 1
        if height == 0:
            break
        height -= 1
        if above[height] != here:
            return NOT_PREORDER, here - 1
        depth = depths[height]
        cell[:] = bounds[height]
    if here != count or used != references.shape[0]:
        return NOT_REACHED, here - 1
    return SOUND, 0


@kernel
def depth_of(nodes):
    """The most nodes above one of a sound tree."""
    count = nodes.shape[0]
    depth = np.zeros(count, np.int32)
    most = 0
    for k in range(count):
        most = max(most, depth[k])
        if nodes[k, 1] & 3 != LEAF:
            depth[k + 1] = depth[k] + 1
            depth[nodes[k, 1] >> 2] = depth[k] + 1
    return most


@helper
def is_in_leaf(nodes, references, node, thing):
    """Whether a leaf has an object among its rising references."""
    first = np.int64(nodes[node, 0])
    last = first + np.int64(nodes[node, 1] >> 2)
    while first < last:
        middle = (first + last) // 2
        if references[middle] < thing:
            first = middle + 1
        else:
            last = middle
    end = np.int64(nodes[node, 0]) + np.int64(nodes[node, 1] >> 2)
    return first < end and references[first] == thing


@kernel
def first_missed(nodes, references, low, high, boxes, corners):
    """The first object that a leaf of a sound tree lacks, and that leaf; -1 where there is none.

    An object must be on each side of a plane that a part of it is on, clipped as the build clips it, and on
    one of them where it lies in the plane.
    """
    # A frame is a node, its cell and the part; at most one waits a level, and one choice an axis.
    deepest = depth_of(nodes)
    frames = np.empty((deepest + 2, 12), np.float32)
    frame_node = np.empty(deepest + 2, np.int64)
    choices = np.empty((deepest + 2, 12), np.float32)
    choice_node = np.empty(deepest + 2, np.int64)
    choice_height = np.empty(deepest + 2, np.int64)
    room = np.empty((2, 12, 3), np.float64)
    now = np.empty(12, np.float32)
    for thing in range(boxes.shape[0]):
        height = 1
        chosen = 0
        frame_node[0] = 0
        for axis in range(3):
            frames[0, axis] = low[axis]
            frames[0, 3 + axis] = high[axis]
            frames[0, 6 + axis] = boxes[thing, axis]
            frames[0, 9 + axis] = boxes[thing, 3 + axis]
        while height > 0:
            # A choice is settled when all that was to be done for it is done.
            height -= 1
            while chosen > 0 and choice_height[chosen - 1] > height:
                chosen -= 1
            node = frame_node[height]
            now[:] = frames[height]
            axis = np.int64(nodes[node, 1] & 3)
            if axis == LEAF:
                if is_in_leaf(nodes, references, node, thing):
                    continue
                # Try the other side of the last plane that it lay in.
                if chosen == 0:
                    return thing, node
                chosen -= 1
                height = choice_height[chosen]
                frame_node[height] = choice_node[chosen]
                frames[height] = choices[chosen]
                height += 1
                continue

            # Go to both sides, or to one of them with the other for a choice.
            position = np.uint32(nodes[node, 0]).view(np.float32)
            above = np.int64(nodes[node, 1] >> 2)
            goes_below = now[6 + axis] < position
            goes_above = now[9 + axis] > position
            if not goes_below and not goes_above:
                choice_height[chosen] = height
                choice_node[chosen] = above
                choices[chosen] = now
                choices[chosen, axis] = position
                chosen += 1
                goes_below = True
            for side in range(2):
                if (side == 0 and goes_above) or (side == 1 and goes_below):
                    frames[height] = now
                    frames[height, (0 if side == 0 else 3) + axis] = position
                    if goes_below and goes_above:
                        part = frames[height, 6:]
                        if corners.shape[0] > 0:
                            clip_part(corners[thing], frames[height, :6], part, room)
                        else:
                            part[(0 if side == 0 else 3) + axis] = position
                    frame_node[height] = above if side == 0 else node + 1
                    height += 1
    return -1, 0
