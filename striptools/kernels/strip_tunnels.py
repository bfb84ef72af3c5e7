"""Tunnels: chains of rotations that end in a merge, the loops behind strips/tunnelling.py.

Faces of a range are numbered by their place in it. A *strip* is a row of faces, kept in an arena `rows`;
rows of changed strips go to the arena's top. While a chain is tried nothing is written there: a *virtual row*
is a list of pieces of the arena, each run forwards or backwards. A strip's *end* is
the last face of its row, its *head* the first. A *rotation* links the end t of strip a to an inner face u of
strip b and cuts one of u's links; the part of b on the far side of the cut leaves b for a, and the face w
at the near side is the new end. Within one strip (a = b) the cut must face t, or a ring would close.

Boxes are (n, 6) float32: minus the low corner, then the high corner, so that a union is six maxima; they are
scaled by a power of two to lie within -1 and 1, so that no area overflows float32 and no box is rounded.
"""

from collections import namedtuple

import numpy as np

from striptools.kernels.compiled import helper, inlined, kernel, maker, spliced
from striptools.kernels.strip_linking import may_link

LONGEST = 256
"""Strips of more faces than this are left alone: an evaluation costs as much as its strips are long."""

MOST_ROTATIONS = 400
"""A search from one end gives up after this many rotations."""

NONE = np.int64(-1)
ZERO = np.int64(0)
ONE = np.int64(1)
FORWARDS = np.bool_(False)
"""Constants of the types of variables: for a bare 0 Numba compiles once more what takes it."""

TOP_WEIGHT = 4.0
"""What the hierarchy over the strips costs for a strip, in areas of the strip's box."""

Ground = namedtuple("Ground", "ring faces boxes mirror room line flips")
"""What a search does not change: ring (3n,), faces (n, 3), boxes (n, 6) float32, the table of `mirrors`, for
evaluations room (LONGEST, 6) float32 and line (LONGEST,) int32, and flips, whether edges may be run the same
way by both faces."""

Strips = namedtuple("Strips", "rows begin length kept changed where mate")
"""The strips: rows (r,) int32, the arena; by strip begin and length (s,) int32 of its row, kept (s,) float64,
its cost, and changed (s,) int32, when it was changed last; where (n, 2) int32, strip and place of each face;
mate (3n,) int32, the linked half-edge or -1."""

Search = namedtuple("Search", "level path saved shape cost pieces moves best spare order tried first")
"""Working room of one search:
level (k, 4) int64 by depth: next move, how many there are, virtual row, its end face;
path (k, 14) int64, the rotations done: half-edges h, g, cut, its mate, rows a and b, how many rows there
were, begin, count, length of a and of b, top of the pieces; saved (k, 2) float64 the costs of a and b;
shape (k, 4) int64 by virtual row: strip, begin and count of its pieces, length; cost (k,) float64 (negative:
not known); pieces (p, 2) int64: first and last place in the arena;
moves (k, MOST_ROTATIONS, 8) int64 by depth: half-edges h, g, cut, side of the cut, row b (-1: as it lies in
the arena), its strip, place of u, new end w;
best (k, 3) int64 the rotations h, g, cut of the best find, then its merge;
for the passes: spare (n,) int32, order and tried (s,) int32, first (LONGEST + 2,) int32."""


@maker
def room_for_search(deepest, faces, strips):
    """Room for a search of so many rotations over so many faces in so many strips."""
    depths = deepest + 2
    return Search(
        np.empty((depths, 4), np.int64),
        np.empty((depths, 14), np.int64),
        np.empty((depths, 2), np.float64),
        np.empty((depths + 1, 4), np.int64),
        np.empty(depths + 1, np.float64),
        np.empty((2 * depths * (depths + 2), 2), np.int64),
        np.empty((depths, MOST_ROTATIONS, 8), np.int64),
        np.empty((depths, 3), np.int64),
        np.empty(faces, np.int32),
        np.empty(strips, np.int32),
        np.empty(strips, np.int32),
        np.empty(LONGEST + 2, np.int32),
    )


@kernel
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


@spliced
def box_area(boxes, row):
    """Half area of a box."""
    x = boxes[row, 3] + boxes[row, 0]
    y = boxes[row, 4] + boxes[row, 1]
    z = boxes[row, 5] + boxes[row, 2]
    return np.float64(x * y + y * z + z * x)


@spliced
def join_boxes(boxes, one, other, out, row):
    """Write the box around two to a row of `out`."""
    for q in range(6):
        a = boxes[one, q]
        b = boxes[other, q]
        out[row, q] = a if a > b else b


@helper
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


@helper
def relabel(rows, begin, first, length, strip, where):
    """Tell the faces of a row from place `first` on which strip they are in, and where."""
    for place in range(first, length):
        face = rows[begin + place]
        where[face, 0] = strip
        where[face, 1] = place


@helper
def append_places(pieces, begin, count, first, last, top):
    """Write the pieces of the places first:last of a virtual row to the top; returns the new top."""
    place = 0
    for k in range(begin, begin + count):
        one = pieces[k, 0]
        step = 1 if pieces[k, 1] >= one else -1
        faces = (pieces[k, 1] - one) * step + 1
        low = max(first - place, 0)
        high = min(last - place, faces)
        if low < high:
            pieces[top, 0] = one + step * low
            pieces[top, 1] = one + step * (high - 1)
            top += 1
        place += faces
    return top


@helper
def turn_pieces(pieces, begin, end):
    """Turn a virtual row round."""
    while begin < end:
        end -= 1
        one = pieces[begin, 0]
        other = pieces[begin, 1]
        pieces[begin, 0] = pieces[end, 1]
        pieces[begin, 1] = pieces[end, 0]
        pieces[end, 0] = other
        pieces[end, 1] = one
        begin += 1


@inlined
def take_up(strips, search, used, s, top):
    """Make strip s, as it lies in the arena, the virtual row `used`; returns the new top of the pieces."""
    shape = search.shape
    shape[used, 0] = s
    shape[used, 1] = top
    shape[used, 2] = 1
    shape[used, 3] = strips.length[s]
    search.pieces[top, 0] = strips.begin[s]
    search.pieces[top, 1] = strips.begin[s] + strips.length[s] - 1
    search.cost[used] = strips.kept[s]
    return top + 1


@inlined
def locate(strips, search, used, face):
    """The virtual row that holds a face (-1: its strip is as it lies in the arena) and the place there."""
    where, shape, pieces = strips.where, search.shape, search.pieces
    s = where[face, 0]
    place = np.int64(where[face, 1])
    found = NONE
    known = False
    for slot in range(used):
        known = known or shape[slot, 0] == s
    # Look for its place in the arena among the pieces.
    if known:
        x = strips.begin[s] + place
        for slot in range(used):
            before = 0
            begin = shape[slot, 1]
            for k in range(begin, begin + shape[slot, 2]):
                one = pieces[k, 0]
                other = pieces[k, 1]
                if one <= x <= other or other <= x <= one:
                    found = slot
                    place = before + abs(x - one)
                before += abs(other - one) + 1
    return found, place


@inlined
def face_at(rows, search, slot, place):
    """The face at a place of a virtual row."""
    begin = search.shape[slot, 1]
    face = NONE
    for k in range(begin, begin + search.shape[slot, 2]):
        one = search.pieces[k, 0]
        other = search.pieces[k, 1]
        faces = abs(other - one) + 1
        if 0 <= place < faces:
            face = rows[one + place] if other >= one else rows[one - place]
        place -= faces
    return face


@inlined
def write_row(rows, search, slot, backwards, out, k):
    """Write the faces of a virtual row, forwards or from its end, to out from k on; returns the end."""
    begin = search.shape[slot, 1]
    count = search.shape[slot, 2]
    for i in range(count):
        if backwards:
            other = search.pieces[begin + count - 1 - i, 0]
            one = search.pieces[begin + count - 1 - i, 1]
        else:
            one = search.pieces[begin + i, 0]
            other = search.pieces[begin + i, 1]
        step = 1 if other >= one else -1
        for x in range(abs(other - one) + 1):
            out[k] = rows[one + step * x]
            k += 1
    return k


@inlined
def rotate(strips, search, d, used, a, b, p, side, h, g, cut, top):
    """Do a rotation of virtual row a's end into place p of b, and note at path[d] how to undo it.

    Side 0 cuts b before p, side 1 behind p. Returns the new top of the pieces.
    """
    path, shape, cost, pieces = search.path, search.shape, search.cost, search.pieces
    mate = strips.mate
    back = mate[cut]
    # Note the rows as they are, and change the links.
    path[d, 0] = h
    path[d, 1] = g
    path[d, 2] = cut
    path[d, 3] = back
    path[d, 4] = a
    path[d, 5] = b
    path[d, 6] = used
    for k in range(3):
        path[d, 7 + k] = shape[a, 1 + k]
        path[d, 10 + k] = shape[b, 1 + k]
    search.saved[d, 0] = cost[a]
    search.saved[d, 1] = cost[b]
    mate[cut] = -1
    mate[back] = -1
    mate[h] = g
    mate[g] = h
    begin = shape[a, 1]
    length = shape[a, 3]
    cost[a] = -1.0
    cost[b] = -1.0
    shape[a, 1] = top
    # Within one strip, turn round what is behind the link.
    if a == b:
        middle = append_places(pieces, begin, shape[a, 2], ZERO, p + 1, top)
        end = append_places(pieces, begin, shape[a, 2], p + 1, length, middle)
        turn_pieces(pieces, middle, end)
        shape[a, 2] = end - top
    else:
        # Append the part beyond the link to row a.
        other = shape[b, 1]
        count = shape[b, 2]
        rest = shape[b, 3]
        low = p if side == 0 else ZERO
        high = rest if side == 0 else p + 1
        middle = append_places(pieces, begin, shape[a, 2], ZERO, length, top)
        end = append_places(pieces, other, count, low, high, middle)
        if side == 1:
            turn_pieces(pieces, middle, end)
        shape[a, 2] = end - top
        shape[a, 3] = length + high - low
        # Leave row b the rest, its new end last.
        top = end
        low = ZERO if side == 0 else p + 1
        high = p if side == 0 else rest
        end = append_places(pieces, other, count, low, high, top)
        if side == 1:
            turn_pieces(pieces, top, end)
        shape[b, 1] = top
        shape[b, 2] = end - top
        shape[b, 3] = high - low
    return end


@inlined
def undo(strips, search, d):
    """Undo the rotation of path[d]; returns how many virtual rows there were before."""
    path, shape = search.path, search.shape
    mate = strips.mate
    mate[path[d, 0]] = -1
    mate[path[d, 1]] = -1
    mate[path[d, 2]] = path[d, 3]
    mate[path[d, 3]] = path[d, 2]
    a = path[d, 4]
    b = path[d, 5]
    for k in range(3):
        shape[a, 1 + k] = path[d, 7 + k]
        shape[b, 1 + k] = path[d, 10 + k]
    search.cost[a] = search.saved[d, 0]
    search.cost[b] = search.saved[d, 1]
    return path[d, 6]


@inlined
def change_of(strips, ground, search, used, skip, other):
    """By how much the virtual rows, but for two that are gone, are dearer than the strips were."""
    change = 0.0
    for slot in range(used):
        change -= strips.kept[search.shape[slot, 0]]
        if slot != skip and slot != other:
            # Work the cost out where it is not known.
            if search.cost[slot] < 0.0:
                length = write_row(strips.rows, search, slot, FORWARDS, ground.line, ZERO)
                search.cost[slot] = row_cost(
                    ground.line, ZERO, length, ground.boxes, ground.mirror, ground.room
                )
            change += search.cost[slot]
    return change


@inlined
def is_end(mate, face):
    """Whether a face has fewer than two links, and so stands at an end of its row."""
    free = 0
    for h in range(3 * face, 3 * face + 3):
        free += 1 if mate[h] < 0 else 0
    return free > 1


@inlined
def may_merge(strips, ground, search, used, w, freed, t, b, rest, most):
    """Whether w, an end of strip b of `rest` faces once its link by `freed` is cut, may find a partner."""
    found = False
    for slot in range(3):
        h = 3 * w + slot
        g = h
        if strips.mate[h] < 0 or h == freed:
            g = ground.ring[h]
        while g != h and not found:
            v = g // 3
            if (
                strips.mate[g] < 0
                and v != w
                and v != t
                and is_end(strips.mate, v)
                and may_link(ground.faces, h, g, ground.flips)
            ):
                c, _ = locate(strips, search, used, v)
                s = search.shape[c, 0] if c >= 0 else strips.where[v, 0]
                length = search.shape[c, 3] if c >= 0 else strips.length[s]
                found = s == b or length + rest <= most
            g = ground.ring[g]
    return found


@inlined
def list_moves(strips, ground, search, used, d, rotations, neutral, most):
    """List in moves[d] the rotations that the end at depth d may do, MOST_ROTATIONS at most: how many.

    The last one before a merge is listed only where a merge may follow, unless it may do without (neutral).
    """
    path, shape, moves = search.path, search.shape, search.moves
    rows, mate, ring, faces = strips.rows, strips.mate, ground.ring, ground.faces
    count = 0
    a = search.level[d, 2]
    t = search.level[d, 3]
    for slot in range(3):
        h = 3 * t + slot
        g = ring[h] if mate[h] < 0 else h
        while g != h:
            u = g // 3
            # A half-edge that is linked may be gone through where it is that link that is cut.
            inner = u != t and (mate[g] >= 0 or not is_end(mate, u)) and may_link(faces, h, g, ground.flips)
            b = NONE
            p = ZERO
            s = ZERO
            length = ZERO
            if inner:
                b, p = locate(strips, search, used, u)
                s = shape[b, 0] if b >= 0 else np.int64(strips.where[u, 0])
                length = shape[b, 3] if b >= 0 else strips.length[s]
                inner = length <= LONGEST
            # Cut u's link towards the head (side 0) or the end (side 1); see that the lengths are right.
            for side in range(2 if inner else 0):
                if a == b:
                    refused = side == 0 or p + 1 >= length - 1
                    rest = length
                elif side == 0:
                    refused = p == 0 or shape[a, 3] + length - p > most
                    rest = p
                else:
                    refused = p == length - 1 or shape[a, 3] + p + 1 > most
                    rest = length - 1 - p
                if refused or count == MOST_ROTATIONS:
                    continue
                place = p - 1 + 2 * side
                w = face_at(rows, search, b, place) if b >= 0 else rows[strips.begin[s] + place]
                cut = 3 * u
                while mate[cut] < 0 or mate[cut] // 3 != w:
                    cut += 1
                # Never cut a link that this chain has made, nor go where no merge can follow.
                refused = mate[g] >= 0 and cut != g
                for i in range(d):
                    refused = refused or path[i, 0] == cut or path[i, 1] == cut
                if not refused and d == rotations - 1 and rotations > neutral:
                    refused = not may_merge(strips, ground, search, used, w, mate[cut], t, s, rest, most)
                if not refused:
                    moves[d, count, 0] = h
                    moves[d, count, 1] = g
                    moves[d, count, 2] = cut
                    moves[d, count, 3] = side
                    moves[d, count, 4] = b
                    moves[d, count, 5] = s
                    moves[d, count, 6] = p
                    moves[d, count, 7] = w
                    count += 1
            g = ring[g]
    return count


@inlined
def keep_best(search, d, h, g):
    """Write the rotations done so far, and the merge by half-edges h and g behind them, to search.best."""
    for i in range(d):
        for k in range(3):
            search.best[i, k] = search.path[i, k]
    search.best[d, 0] = h
    search.best[d, 1] = g


@inlined
def find_tunnel(strips, ground, search, rotations, neutral, price, allowance, most):
    """Look from the end of virtual row 0 for the best chain of exactly so many rotations, then a merge.

    A chain is worth `price` where it ends in a merge, less what it makes the strips dearer, which is at most
    `allowance`; with `neutral` chains without a merge count too. Writes the best chain that is worth more
    than nothing to search.best, the merge behind the rotations (half-edge -1: none).

    Returns:
        Whether there is one, and how much dearer it makes the strips.
    """
    level, path, shape, moves = search.level, search.path, search.shape, search.moves
    rows, mate, ring, faces = strips.rows, strips.mate, ground.ring, ground.faces
    found = False
    found_change = 0.0
    # A change that rounding could explain is worth nothing.
    best_worth = 1e-6 * strips.kept[shape[0, 0]]
    done = 0
    used = ONE
    top = ONE
    d = ZERO
    level[0, 2] = 0
    level[0, 3] = face_at(rows, search, ZERO, shape[0, 3] - 1)
    arrived = True
    while True:
        if arrived and d < rotations:
            level[d, 0] = 0
            level[d, 1] = list_moves(strips, ground, search, used, d, rotations, neutral, most)
        elif arrived:
            # See what the rotations are worth without a merge.
            a = level[d, 2]
            t = level[d, 3]
            if 0 < d <= neutral:
                change = change_of(strips, ground, search, used, NONE, NONE)
                if -change > best_worth:
                    best_worth = -change
                    found = True
                    found_change = change
                    keep_best(search, d, NONE, NONE)
            # Merge with each strip that ends beside this end, and see what that is worth.
            for slot in range(3):
                h = 3 * t + slot
                g = ring[h] if mate[h] < 0 else h
                while g != h:
                    u = g // 3
                    if mate[g] < 0 and u != t and is_end(mate, u) and may_link(faces, h, g, ground.flips):
                        b, p = locate(strips, search, used, u)
                        s = shape[b, 0] if b >= 0 else np.int64(strips.where[u, 0])
                        length = shape[b, 3] if b >= 0 else strips.length[s]
                        if a != b and shape[a, 3] + length <= most:
                            with_b = used
                            if b < 0:
                                b = used
                                with_b = used + 1
                                take_up(strips, search, b, s, top)
                            change = change_of(strips, ground, search, with_b, a, b)
                            if price - change > best_worth and change <= allowance:
                                k = write_row(rows, search, a, FORWARDS, ground.line, ZERO)
                                k = write_row(rows, search, b, p > 0, ground.line, k)
                                change += row_cost(
                                    ground.line, ZERO, k, ground.boxes, ground.mirror, ground.room
                                )
                            if price - change > best_worth and change <= allowance:
                                best_worth = price - change
                                found = True
                                found_change = change
                                keep_best(search, d, h, g)
                    g = ring[g]
        # Step back where all has been tried.
        if d == rotations or level[d, 0] == level[d, 1] or done == MOST_ROTATIONS:
            if d == 0:
                break
            d -= 1
            top = path[d, 13]
            used = undo(strips, search, d)
            arrived = False
            continue
        # Do the next rotation.
        k = level[d, 0]
        level[d, 0] = k + 1
        b = moves[d, k, 4]
        path[d, 13] = top
        before = used
        if b < 0:
            b = used
            used += 1
            top = take_up(strips, search, b, moves[d, k, 5], top)
        h, g, cut, side, p = moves[d, k, 0], moves[d, k, 1], moves[d, k, 2], moves[d, k, 3], moves[d, k, 6]
        top = rotate(strips, search, d, before, level[d, 2], b, p, side, h, g, cut, top)
        done += 1
        d += 1
        level[d, 2] = b
        level[d, 3] = moves[d - 1, k, 7]
        arrived = True
    return found, found_change


@inlined
def accept(strips, ground, search, rotations, now, top):
    """Do the best chain that find_tunnel left, for good; returns the new top of the arena."""
    best, shape = search.best, search.shape
    rows = strips.rows
    used = ONE
    a = ZERO
    end = ONE
    for d in range(rotations):
        u = best[d, 1] // 3
        b, p = locate(strips, search, used, u)
        with_b = used
        if b < 0:
            b = used
            with_b = used + 1
            end = take_up(strips, search, used, np.int64(strips.where[u, 0]), end)
        cut = best[d, 2]
        _, q = locate(strips, search, with_b, strips.mate[cut] // 3)
        side = ZERO if q < p else ONE
        end = rotate(strips, search, d, used, a, b, p, side, best[d, 0], best[d, 1], cut, end)
        used = with_b
        a = b
    # Append the other strip to the last end's.
    gone = NONE
    p = ZERO
    h = best[rotations, 0]
    if h >= 0:
        g = best[rotations, 1]
        gone, p = locate(strips, search, used, g // 3)
        if gone < 0:
            gone = used
            end = take_up(strips, search, used, np.int64(strips.where[g // 3, 0]), end)
            used += 1
        strips.mate[h] = g
        strips.mate[g] = h
        search.cost[a] = -1.0
    # Write the rows to the arena, and keep their costs.
    for slot in range(used):
        if slot != gone:
            k = write_row(rows, search, slot, FORWARDS, rows, top)
            if slot == a and gone >= 0:
                k = write_row(rows, search, gone, p > 0, rows, k)
            shape[slot, 1] = top
            shape[slot, 3] = k - top
            top = k
    for slot in range(used):
        s = shape[slot, 0]
        if slot == gone:
            strips.length[s] = 0
            strips.kept[s] = 0.0
            continue
        begin = shape[slot, 1]
        length = shape[slot, 3]
        strips.begin[s] = begin
        strips.length[s] = length
        relabel(rows, begin, 0, length, s, strips.where)
        strips.kept[s] = row_cost(rows, begin, length, ground.boxes, ground.mirror, ground.room)
        strips.changed[s] = now
    return top


@helper
def compact(strips, spare):
    """Move the rows of the strips that are left to the arena's bottom, in order; returns the top."""
    k = 0
    for s in range(strips.begin.shape[0]):
        begin = strips.begin[s]
        strips.begin[s] = k
        for i in range(strips.length[s]):
            spare[k] = strips.rows[begin + i]
            k += 1
    for i in range(k):
        strips.rows[i] = spare[i]
    return k


@helper
def by_length(length, order, longest, first):
    """List the strips of up to `longest` faces in `order`, the shortest first, equals by number.

    Returns how many there are; first (longest + 2,) is room.
    """
    for k in range(longest + 2):
        first[k] = 0
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


@inlined
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


@maker
def search_range(strips, ground, search, most, deepest, neutral, price_share, rise, passes, leaves):
    """Improve the strips of a range in passes over them, the shortest first, from both ends.

    Args:
        strips: Their rows at the arena's bottom; cost, kept and changed are set here.
        ground: The range.
        search: Room, as `room_for_search` makes it.
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
    # Cost the strips as they are.
    start_cost = leaves
    searched = 0
    for s in range(count):
        strips.kept[s] = 0.0
        strips.changed[s] = 0
        search.tried[s] = -1
        if strips.length[s] <= LONGEST:
            strips.kept[s] = row_cost(
                strips.rows,
                np.int64(strips.begin[s]),
                np.int64(strips.length[s]),
                ground.boxes,
                ground.mirror,
                ground.room,
            )
            start_cost += strips.kept[s]
            searched += 1
    if searched == 0:
        return start_cost, start_cost
    price = price_share * (start_cost - leaves) / searched
    cost = start_cost
    most_cost = start_cost * (1.0 + rise)
    top = np.int64(faces)
    room = (2 * deepest + 4) * LONGEST
    now = ZERO
    for _ in range(passes):
        accepted = 0
        waiting = by_length(strips.length, search.order, longest, search.first)
        for k in range(waiting):
            s = np.int64(search.order[k])
            if strips.length[s] == 0 or not changed_near(strips, ground.ring, s, search.tried[s]):
                continue
            search.tried[s] = now
            for side in range(2):
                if strips.length[s] == 0 or (side == 1 and strips.length[s] == 1):
                    break
                if top + room > strips.rows.shape[0]:
                    top = compact(strips, search.spare)
                for rotations in range(deepest + 1):
                    # Go out from the end, or turned round from the head.
                    take_up(strips, search, ZERO, s, ZERO)
                    if side == 0:
                        turn_pieces(search.pieces, ZERO, ONE)
                    found, change = find_tunnel(
                        strips, ground, search, rotations, neutral, price, most_cost - cost, longest
                    )
                    if found:
                        now += 1
                        top = accept(strips, ground, search, rotations, now, top)
                        cost += change
                        accepted += 1
                        break
        if accepted == 0:
            break
    return start_cost, cost
