"""Tunnels: chains of rotations that end in a merge, the loops behind strips/tunnelling.py.

Faces of a range are numbered by their place in it. A *strip* is a row of faces, kept in an arena `rows`; new
rows go to the arena's top, so that a rotation is undone by pointing back at the old row. A strip's *end* is
the last face of its row, its *head* the first. A *rotation* links the end t of strip a to an inner face u of
strip b and cuts one of u's links; the part of b on the far side of the cut leaves b for a, and the face w
at the near side is the new end. Within one strip (a = b) the cut must face t, or a ring would close.

Boxes are (n, 6) float32: minus the low corner, then the high corner, so that a union is six maxima; they are
scaled by a power of two to lie within -1 and 1, so that no area overflows float32 and no box is rounded.
"""

from collections import namedtuple

import numpy as np
from numba import njit

from striptools.kernels.strip_topology import may_flip

LONGEST = 256
"""Strips of more faces than this are left alone: an evaluation costs as much as its strips are long."""

MOST_ROTATIONS = 400
"""A search from one end gives up after this many rotations."""

TOP_WEIGHT = 4.0
"""What the hierarchy over the strips costs for a strip, in areas of the strip's box."""

Ground = namedtuple("Ground", "ring faces boxes mirror room flips")
"""What a search does not change: ring (3n,), faces (n, 3), boxes (n, 6) float32, the table of `mirrors`,
room (LONGEST, 6) float32 for evaluations, and flips, whether edges may be run the same way by both faces."""

Strips = namedtuple("Strips", "rows begin length cost kept changed where mate")
"""The strips: rows (r,) int32, the arena; by strip begin and length (s,) int32 of its row, cost (s,) float64
of the row it has now (negative: not known) and kept (s,) that of the last accepted one, and changed (s,)
int32, when that was; where (n, 2) int32, strip and place of each face; mate (3n,) int32, the linked half-edge
or -1."""

Search = namedtuple("Search", "level path saved touched best")
"""Working room of one search: level (k, 4) int32 by depth: strip, slot, half-edge, side that are tried now;
path (k, 10) int32, the rotations done: half-edges h, g, cut, its mate, then strip, begin, length of a and of
b; saved (k, 2) float64 their costs; touched (k,) int32 strips; best (k, 3) int32 the rotations h, g, cut of
the best find, then its merge."""


@njit(cache=True, nogil=True)
def mirrors():
    """The table of reversed bits: entry m + i is i < m, m a power of two, with its log2(m) bits reversed."""
    table = np.zeros(2 * LONGEST, np.int32)
    # Put each number's lowest bit, the next longer number's last, in front.
    m = 1
    while m < LONGEST:
        for i in range(m):
            table[2 * m + 2 * i] = table[m + i]
            table[2 * m + 2 * i + 1] = table[m + i] + m
        m *= 2
    return table


@njit(cache=True, nogil=True, inline="always")
def box_area(boxes, row):
    """Half area of a box."""
    x = boxes[row, 3] + boxes[row, 0]
    y = boxes[row, 4] + boxes[row, 1]
    z = boxes[row, 5] + boxes[row, 2]
    return np.float64(x * y + y * z + z * x)


@njit(cache=True, nogil=True, inline="always")
def join_boxes(boxes, one, other, out, row):
    """Write the box around two to a row of `out`."""
    for q in range(6):
        a = boxes[one, q]
        b = boxes[other, q]
        out[row, q] = a if a > b else b


@njit(cache=True, nogil=True)
def row_cost(rows, begin, length, boxes, mirror, room):
    """Areas of the inner nodes of the balanced tree over a row, and TOP_WEIGHT times that of its root.

    The lowest level that is full has m nodes, of one face or two; node i has two where i with its bits
    reversed is below length - m, because each halving gives the odd face to the left.
    """
    if length == 1:
        return TOP_WEIGHT * box_area(boxes, rows[begin])
    m = 1
    while 2 * m < length:
        m *= 2
    # Box the pairs of that level.
    total = 0.0
    k = begin
    pairs = length - m
    for i in range(m):
        if mirror[m + i] < pairs:
            join_boxes(boxes, rows[k], rows[k + 1], room, i)
            total += box_area(room, i)
            k += 2
        else:
            one = rows[k]
            for q in range(6):
                room[i, q] = boxes[one, q]
            k += 1
    # Join them level by level, in place.
    while m > 1:
        m //= 2
        for i in range(m):
            join_boxes(room, 2 * i, 2 * i + 1, room, i)
            total += box_area(room, i)
    return total + TOP_WEIGHT * box_area(room, 0)


@njit(cache=True, nogil=True)
def relabel(rows, begin, first, length, strip, where):
    """Tell the faces of a row from place `first` on which strip they are in, and where."""
    for place in range(first, length):
        face = rows[begin + place]
        where[face, 0] = strip
        where[face, 1] = place


@njit(cache=True, nogil=True)
def reverse(strips, a, top):
    """Turn the row of strip a round in the arena's top; returns the new top."""
    rows = strips.rows
    begin = strips.begin[a]
    length = strips.length[a]
    for i in range(length):
        rows[top + i] = rows[begin + length - 1 - i]
    strips.begin[a] = top
    relabel(rows, top, 0, length, a, strips.where)
    return top + length


@njit(cache=True, nogil=True)
def rotate(strips, path, saved, d, a, h, g, cut, top):
    """Do a rotation of strip a's end and note at path[d] how to undo it; returns the new top."""
    rows, begins, lengths, cost, where, mate = (
        strips.rows, strips.begin, strips.length, strips.cost, strips.where, strips.mate,
    )  # fmt: skip
    u = g // 3
    b = where[u, 0]
    p = where[u, 1]
    back = mate[cut]
    q = where[back // 3, 1]
    begin = begins[a]
    length = lengths[a]
    # Note the strips as they are, and change the links.
    path[d, 0] = h
    path[d, 1] = g
    path[d, 2] = cut
    path[d, 3] = back
    path[d, 4] = a
    path[d, 5] = begin
    path[d, 6] = length
    path[d, 7] = b
    path[d, 8] = begins[b]
    path[d, 9] = lengths[b]
    saved[d, 0] = cost[a]
    saved[d, 1] = cost[b]
    mate[cut] = -1
    mate[back] = -1
    mate[h] = g
    mate[g] = h
    # Write strip a's row anew: what stays in place, then the part beyond the link.
    k = top
    if a == b:
        for i in range(p + 1):
            rows[k] = rows[begin + i]
            k += 1
        for i in range(length - 1, p, -1):
            rows[k] = rows[begin + i]
            k += 1
        begins[a] = top
        cost[a] = -1.0
        relabel(rows, top, p + 1, length, a, where)
        return k
    for i in range(length):
        rows[k] = rows[begin + i]
        k += 1
    other = begins[b]
    rest = lengths[b]
    if q < p:
        for i in range(p, rest):
            rows[k] = rows[other + i]
            k += 1
    else:
        for i in range(p, -1, -1):
            rows[k] = rows[other + i]
            k += 1
    begins[a] = top
    lengths[a] = k - top
    relabel(rows, top, length, k - top, a, where)
    # Leave strip b the rest, its new end last.
    if q < p:
        lengths[b] = p
    else:
        begins[b] = k
        lengths[b] = rest - 1 - p
        for i in range(rest - 1, p, -1):
            rows[k] = rows[other + i]
            k += 1
        relabel(rows, begins[b], 0, lengths[b], b, where)
    cost[a] = -1.0
    cost[b] = -1.0
    return k


@njit(cache=True, nogil=True)
def undo(strips, path, saved, d):
    """Undo the rotation of path[d]; returns the top as it was before."""
    top = strips.begin[path[d, 4]]
    mate = strips.mate
    mate[path[d, 0]] = -1
    mate[path[d, 1]] = -1
    mate[path[d, 2]] = path[d, 3]
    mate[path[d, 3]] = path[d, 2]
    # Point at the old rows, and let the faces that moved know.
    for k in range(2):
        s = path[d, 4 + 3 * k]
        strips.begin[s] = path[d, 5 + 3 * k]
        strips.length[s] = path[d, 6 + 3 * k]
        strips.cost[s] = saved[d, k]
    b = path[d, 7]
    relabel(strips.rows, strips.begin[b], 0, strips.length[b], b, strips.where)
    return top


@njit(cache=True, nogil=True)
def known_cost(strips, ground, s):
    """The cost of strip s's row, worked out where it is not known."""
    if strips.cost[s] < 0.0:
        strips.cost[s] = row_cost(
            strips.rows, strips.begin[s], strips.length[s], ground.boxes, ground.mirror, ground.room
        )
    return strips.cost[s]


@njit(cache=True, nogil=True)
def change_of(strips, ground, touched, count, skip, other):
    """By how much the strips touched[:count], each once, have become dearer; two of them count as gone."""
    change = 0.0
    for i in range(count):
        s = touched[i]
        again = False
        for j in range(i):
            again = again or touched[j] == s
        if again:
            continue
        change -= strips.kept[s]
        if s != skip and s != other:
            change += known_cost(strips, ground, s)
    return change


@njit(cache=True, nogil=True)
def append_row(strips, a, c, head_first, top):
    """Write strip a's row and behind it strip c's, from its head or end, to the top; returns the length."""
    rows = strips.rows
    k = top
    begin = strips.begin[a]
    for i in range(strips.length[a]):
        rows[k] = rows[begin + i]
        k += 1
    begin = strips.begin[c]
    length = strips.length[c]
    if head_first:
        for i in range(length):
            rows[k] = rows[begin + i]
            k += 1
    else:
        for i in range(length - 1, -1, -1):
            rows[k] = rows[begin + i]
            k += 1
    return k - top


@njit(cache=True, nogil=True)
def may_merge(strips, ground, w, freed, t, b, rest, most):
    """Whether w, an end of strip b of `rest` faces once its link by `freed` is cut, may find a partner."""
    for slot in range(3):
        h = 3 * w + slot
        if strips.mate[h] >= 0 and h != freed:
            continue
        g = ground.ring[h]
        while g != h:
            v = g // 3
            if strips.mate[g] < 0 and v != w and v != t:
                c = strips.where[v, 0]
                place = strips.where[v, 1]
                length = strips.length[c]
                if (
                    (place == 0 or place == length - 1)
                    and (c == b or length + rest <= most)
                    and (
                        ground.faces[v, g % 3] != ground.faces[w, slot]
                        or (ground.flips and may_flip(ground.faces, w, v))
                    )
                ):
                    return True
            g = ground.ring[g]
    return False


@njit(cache=True, nogil=True)
def find_tunnel(strips, ground, search, start, rotations, neutral, price, allowance, most, top):
    """Look from the end of strip `start` for the best chain of exactly so many rotations, then a merge.

    A chain is worth `price` where it ends in a merge, less what it makes the strips dearer, which is at most
    `allowance`; with `neutral` chains without a merge count too. Writes the best chain that is worth more
    than nothing to search.best, the merge behind the rotations (half-edge -1: none).

    Returns:
        Whether there is one, and how much dearer it makes the strips.
    """
    level, path, saved, touched, best = search
    rows, begins, lengths, where, mate = (
        strips.rows, strips.begin, strips.length, strips.where, strips.mate,
    )  # fmt: skip
    ring = ground.ring
    faces = ground.faces
    found = False
    found_change = 0.0
    # A change that rounding could explain is worth nothing.
    best_worth = 1e-6 * strips.kept[start]
    done = 0
    d = 0
    touched[0] = start
    level[0, 0] = start
    level[0, 1] = 0
    level[0, 2] = -1
    while True:
        a = level[d, 0]
        slot = level[d, 1]
        # Step back where all edges of this end have been tried.
        if slot == 3:
            if d == 0:
                return found, found_change
            d -= 1
            top = undo(strips, path, saved, d)
            level[d, 3] += 1
            continue
        # Find the next half-edge to go through.
        t = rows[begins[a] + lengths[a] - 1]
        h = 3 * t + slot
        g = level[d, 2]
        if g < 0:
            if mate[h] >= 0:
                level[d, 1] += 1
                continue
            g = ring[h]
            level[d, 2] = g
            level[d, 3] = 0
        if g == h:
            level[d, 1] += 1
            level[d, 2] = -1
            continue
        side = level[d, 3]
        u = g // 3
        if (
            side > 1
            or u == t
            or (faces[u, g % 3] == faces[t, slot] and not (ground.flips and may_flip(faces, t, u)))
        ):
            level[d, 2] = ring[g]
            level[d, 3] = 0
            continue
        b = where[u, 0]
        p = where[u, 1]
        length = lengths[b]
        if mate[g] < 0 and (p == 0 or p == length - 1):
            # Merge with the strip that ends here, and see what that is worth.
            level[d, 3] = 2
            if d == rotations and a != b and lengths[a] + length <= most:
                touched[d + 1] = b
                change = change_of(strips, ground, touched, d + 2, a, b)
                if price - change > best_worth and change <= allowance:
                    total = append_row(strips, a, b, p == 0, top)
                    change += row_cost(rows, top, total, ground.boxes, ground.mirror, ground.room)
                    if price - change > best_worth and change <= allowance:
                        best_worth = price - change
                        found = True
                        found_change = change
                        for i in range(d):
                            for k in range(3):
                                best[i, k] = path[i, k]
                        best[d, 0] = h
                        best[d, 1] = g
            continue
        if d == rotations or length > LONGEST:
            level[d, 3] = 2
            continue
        # Cut u's link towards the head (side 0) or towards the end (side 1); see that the lengths are right.
        if a == b:
            refused = side == 0 or p + 1 >= length - 1
            rest = length
        elif side == 0:
            refused = p == 0 or lengths[a] + length - p > most
            rest = p
        else:
            refused = p == length - 1 or lengths[a] + p + 1 > most
            rest = length - 1 - p
        if refused or done >= MOST_ROTATIONS:
            level[d, 3] += 1
            continue
        w = rows[begins[b] + p - 1 + 2 * side]
        cut = 3 * u
        while mate[cut] < 0 or mate[cut] // 3 != w:
            cut += 1
        # Go through a half-edge that is linked only where it is that link that is cut.
        refused = mate[g] >= 0 and cut != g
        # Never cut a link that this chain has made, nor go where no merge can follow.
        for i in range(d):
            refused = refused or path[i, 0] == cut or path[i, 1] == cut
        if not refused and d == rotations - 1 and rotations > neutral:
            refused = not may_merge(strips, ground, w, mate[cut], t, b, rest, most)
        if refused:
            level[d, 3] += 1
            continue
        top = rotate(strips, path, saved, d, a, h, g, cut, top)
        done += 1
        d += 1
        touched[d] = b
        level[d, 0] = b
        level[d, 1] = 0
        level[d, 2] = -1
        # See what the rotations are worth without a merge.
        if d == rotations and rotations <= neutral:
            change = change_of(strips, ground, touched, d + 1, -1, -1)
            if -change > best_worth:
                best_worth = -change
                found = True
                found_change = change
                for i in range(d):
                    for k in range(3):
                        best[i, k] = path[i, k]
                best[d, 0] = -1


@njit(cache=True, nogil=True)
def accept(strips, ground, search, start, rotations, now, top):
    """Do the best chain that find_tunnel left, for good; returns the new top."""
    touched = search.touched
    best = search.best
    a = start
    touched[0] = a
    count = 1
    for d in range(rotations):
        b = strips.where[best[d, 1] // 3, 0]
        top = rotate(strips, search.path, search.saved, d, a, best[d, 0], best[d, 1], best[d, 2], top)
        a = b
        touched[count] = b
        count += 1
    # Append the other strip to the last end's.
    if best[rotations, 0] >= 0:
        h = best[rotations, 0]
        g = best[rotations, 1]
        c = strips.where[g // 3, 0]
        length = append_row(strips, a, c, strips.where[g // 3, 1] == 0, top)
        strips.mate[h] = g
        strips.mate[g] = h
        strips.length[c] = 0
        strips.kept[c] = 0.0
        strips.begin[a] = top
        relabel(strips.rows, top, strips.length[a], length, a, strips.where)
        strips.length[a] = length
        strips.cost[a] = -1.0
        top += length
    # Keep the costs.
    for i in range(count):
        s = touched[i]
        if strips.length[s] > 0:
            strips.kept[s] = known_cost(strips, ground, s)
            strips.changed[s] = now
    return top


@njit(cache=True, nogil=True)
def compact(strips, spare):
    """Move the rows of the strips that are left to the arena's bottom, in order; returns the top."""
    k = 0
    for s in range(strips.begin.shape[0]):
        begin = strips.begin[s]
        strips.begin[s] = k
        for i in range(strips.length[s]):
            spare[k] = strips.rows[begin + i]
            k += 1
    strips.rows[:k] = spare[:k]
    return k


@njit(cache=True, nogil=True)
def by_length(length, order, longest):
    """List the strips of up to `longest` faces in `order`, the shortest first, equals by number."""
    first = np.zeros(longest + 2, np.int32)
    for s in range(length.shape[0]):
        if 0 < length[s] <= longest:
            first[length[s] + 1] += 1
    for k in range(longest + 1):
        first[k + 1] += first[k]
    for s in range(length.shape[0]):
        if 0 < length[s] <= longest:
            order[first[length[s]]] = s
            first[length[s]] += 1
    return first[longest]


@njit(cache=True, nogil=True)
def changed_near(strips, ring, s, since):
    """Whether strip s, or one that its ends might go into, has been changed after a time."""
    if strips.changed[s] > since:
        return True
    begin = strips.begin[s]
    for k in range(2):
        t = strips.rows[begin + k * (strips.length[s] - 1)]
        for h in range(3 * t, 3 * t + 3):
            g = ring[h]
            while g != h:
                if strips.changed[strips.where[g // 3, 0]] > since:
                    return True
                g = ring[g]
    return False


@njit(cache=True, nogil=True)
def search_range(strips, ground, most, deepest, neutral, price_share, rise, passes, leaves):
    """Improve the strips of a range in passes over them, the shortest first, from both ends.

    Args:
        strips: Their rows at the arena's bottom; cost, kept and changed are set here.
        ground: The range.
        most: The most faces of a strip.
        deepest: The most rotations of a chain.
        neutral: The most rotations of a chain without a merge.
        price_share: What a strip fewer is worth, in mean costs of a strip at the start.
        rise: By which share the cost may become larger than at the start.
        passes: How often, at most.
        leaves: Areas of all faces' boxes: what the cost has besides the strips'.

    Returns:
        The cost at the start and at the end.
    """
    count = strips.begin.shape[0]
    faces = ground.faces.shape[0]
    longest = min(most, LONGEST)
    search = Search(
        np.empty((deepest + 2, 4), np.int32),
        np.empty((deepest + 2, 10), np.int32),
        np.empty((deepest + 2, 2), np.float64),
        np.empty(deepest + 3, np.int32),
        np.empty((deepest + 2, 3), np.int32),
    )
    spare = np.empty(faces, np.int32)
    order = np.empty(count, np.int32)
    tried = np.full(count, -1, np.int32)
    # Cost the strips as they are.
    strips.cost[:] = -1.0
    strips.changed[:] = 0
    start_cost = leaves
    searched = 0
    for s in range(count):
        strips.kept[s] = 0.0
        if strips.length[s] <= LONGEST:
            strips.kept[s] = known_cost(strips, ground, s)
            start_cost += strips.kept[s]
            searched += 1
    if searched == 0:
        return start_cost, start_cost
    price = price_share * (start_cost - leaves) / searched
    cost = start_cost
    most_cost = start_cost * (1.0 + rise)
    top = faces
    room = (2 * deepest + 4) * LONGEST
    now = 0
    for _ in range(passes):
        accepted = 0
        waiting = by_length(strips.length, order, longest)
        for k in range(waiting):
            s = order[k]
            if strips.length[s] == 0 or not changed_near(strips, ground.ring, s, tried[s]):
                continue
            tried[s] = now
            for side in range(2):
                if strips.length[s] == 0 or (side == 1 and strips.length[s] == 1):
                    break
                if top + room > strips.rows.shape[0]:
                    top = compact(strips, spare)
                # Turn the head to the back, so that the search goes out from it.
                begin = strips.begin[s]
                before = top
                if side == 0:
                    top = reverse(strips, s, top)
                    strips.cost[s] = -1.0
                found = False
                for rotations in range(deepest + 1):
                    found, change = find_tunnel(
                        strips, ground, search, s, rotations, neutral, price, most_cost - cost, longest, top
                    )
                    if found:
                        now += 1
                        top = accept(strips, ground, search, s, rotations, now, top)
                        cost += change
                        accepted += 1
                        break
                if not found and side == 0:
                    top = before
                    strips.begin[s] = begin
                    strips.cost[s] = strips.kept[s]
                    relabel(strips.rows, begin, 0, strips.length[s], s, strips.where)
        if accepted == 0:
            break
    return start_cost, cost
