"""Seeds of classic strips: the longest straight lines of faces, then links in rounds of rising price.

A half-edge is 3 * face + slot; `forward` tells for each whether it runs from the smaller vertex to the
larger, so that two half-edges of one ring run in opposite directions exactly where it differs. `mate` (3n,)
is the half-edge linked to this one or -1, `links` (n,) how many links a face has. A *turn* is 0 where a face
is left by the slot after the one it was entered by and 1 where it is left by the one after that; classic
strips are cheapest where turns alternate, and a *line* is a run of faces whose turns do.

The loops behind strips/alternating.py.
"""

from collections import namedtuple

import numpy as np

from striptools.kernels.compiled import helper, kernel, maker

Lines = namedtuple("Lines", "leave begin end following head")
"""leave (3n,) the half-edge each face of all lines is left by, line after line; begin and end of each piece
of a line in there; the next piece of the same length; head (longest + 1,) the first piece of each length."""


@helper
def other_link(mate, h):
    """The linked half-edge of the face of h that is not h; -1 where there is none."""
    base = h - h % 3
    for x in range(base, base + 3):
        if x != h and mate[x] >= 0:
            return x
    return -1


@helper
def repeats_across(h, g, mate):
    """1 where the faces of the linked half-edges h and g are both passed by the same turn, else 0."""
    p = other_link(mate, h)
    if p < 0:
        return 0
    q = other_link(mate, g)
    if q < 0:
        return 0
    return 1 if (h - p + 3) % 3 == (q - g + 3) % 3 else 0


@helper
def repeats_at(h, mate):
    """repeats_across the link of half-edge h; 0 for h = -1."""
    return repeats_across(h, mate[h], mate) if h >= 0 else 0


@helper
def repeats_near(h, g, mate):
    """Repeated turns across the link of h and g and the links before and after it."""
    here = repeats_across(h, g, mate)
    return here + repeats_at(other_link(mate, h), mate) + repeats_at(other_link(mate, g), mate)


@helper
def onward(ring, forward, h, turn):
    """How a line that leaves a face across h by `turn` leaves the next face: a half-edge, -1 at its end.

    Edges of more than two faces end a line: their rings leave a choice, which is the search's to make.
    """
    g = ring[h]
    if g == h or ring[g] != h or forward[g] == forward[h]:
        return -1
    slot = g % 3
    return g - slot + (slot + (2 if turn == 0 else 1)) % 3


@helper
def first_of_line(ring, forward, state):
    """The first face of the line through the face state // 3 past its slot state % 3: how it is left."""
    # Walk against the line to its end, or once round.
    start = state - state % 3 + (state + 1) % 3
    h = start
    turn = 1
    while True:
        x = onward(ring, forward, h, turn)
        if x < 0:
            break
        h = x
        turn = 1 - turn
        if h == start and turn == 1:
            break
    # Turn round: leave by the slot that was the entry.
    slot = h % 3
    return h - slot + (slot + (2 if turn == 0 else 1)) % 3, 1 - turn


@maker
def find_lines(ring, forward, least, lines):
    """List the lines of at least `least` faces; returns how many. Every face lies on three lines."""
    seen = np.zeros(ring.shape[0], np.bool_)
    count = 0
    at = 0
    for state in range(ring.shape[0]):
        if seen[state]:
            continue
        h, turn = first_of_line(ring, forward, state)
        first = at
        while h >= 0:
            # A face and the slot that the line passes by name the line.
            slot = h % 3
            passed = h - slot + (slot + (1 if turn == 0 else 2)) % 3
            if seen[passed]:
                break
            seen[passed] = True
            lines.leave[at] = h
            at += 1
            h = onward(ring, forward, h, turn)
            turn = 1 - turn
        if at - first >= least:
            lines.begin[count] = first
            lines.end[count] = at
            count += 1
        else:
            at = first
    return count


@helper
def put_piece(lines, piece, begin, end):
    """Keep a piece with the others of its length."""
    lines.begin[piece] = begin
    lines.end[piece] = end
    lines.following[piece] = lines.head[end - begin]
    lines.head[end - begin] = piece


@helper
def split_piece(lines, piece, pieces, least, taken, stamp, scan):
    """Put back what is free of a piece, run by run; returns whether all of it is, pieces and scans so far.

    A run ends at a face that is taken and before a face that it holds already, where a line crosses itself.
    """
    begin = lines.begin[piece]
    end = lines.end[piece]
    spare = piece
    run = begin
    for p in range(begin, end + 1):
        face = lines.leave[p] // 3 if p < end else -1
        crossed = face >= 0 and stamp[face] == scan
        if face >= 0 and not taken[face] and not crossed:
            stamp[face] = scan
            continue
        if p - run == end - begin:
            return True, pieces, scan + 1
        # Put the run back under the piece's own number first, then under new ones.
        if p - run >= least:
            if spare < 0:
                spare = pieces
                pieces += 1
            put_piece(lines, spare, run, p)
            spare = -1
        scan += 1
        run = p if crossed and not taken[face] else p + 1
        if run == p:
            stamp[face] = scan
    return False, pieces, scan + 1


@kernel
def take_longest_lines(ring, forward, least, mate, links):
    """Link the faces of the longest line, then of the longest of what is left, down to `least` faces."""
    half_edges = ring.shape[0]
    room = half_edges // least + 2
    lines = Lines(
        np.empty(half_edges, np.int32),
        np.empty(room, np.int32),
        np.empty(room, np.int32),
        np.empty(room, np.int32),
        np.full(half_edges + 1, -1, np.int32),
    )
    pieces = find_lines(ring, forward, least, lines)
    longest = 0
    for piece in range(pieces - 1, -1, -1):
        longest = max(longest, lines.end[piece] - lines.begin[piece])
        put_piece(lines, piece, lines.begin[piece], lines.end[piece])
    taken = np.zeros(half_edges // 3, np.bool_)
    stamp = np.full(half_edges // 3, -1, np.int32)
    scan = 0
    length = longest
    while length >= least:
        piece = lines.head[length]
        if piece < 0:
            length -= 1
            continue
        lines.head[length] = lines.following[piece]
        whole, pieces, scan = split_piece(lines, piece, pieces, least, taken, stamp, scan)
        if not whole:
            continue
        # Take the piece: link each of its faces to the next.
        for p in range(lines.begin[piece], lines.end[piece]):
            h = lines.leave[p]
            taken[h // 3] = True
            if p + 1 < lines.end[piece]:
                g = ring[h]
                mate[h] = g
                mate[g] = h
                links[h // 3] += 1
                links[g // 3] += 1


@helper
def strip_of(owner, t):
    """The face that stands for the strip of t, paths halved on the way."""
    while owner[t] != t:
        owner[t] = owner[owner[t]]
        t = owner[t]
    return t


@helper
def may_link(h, g, forward, mate, links):
    """Whether h and g are free and opposite, and the face of g has a free end."""
    return mate[g] < 0 and forward[g] != forward[h] and links[g // 3] < 2


@helper
def open_links(t, ring, forward, mate, links):
    """How many links face t could still take."""
    count = 0
    for h in range(3 * t, 3 * t + 3):
        g = ring[h]
        while mate[h] < 0 and g != h:
            count += may_link(h, g, forward, mate, links)
            g = ring[g]
    return count


@helper
def cheapest_link(t, most, ring, forward, mate, links, owner):
    """The link of face t that adds fewest repeated turns, at most `most`; then to the least linkable face."""
    best = (most + 1) << 8
    best_h = -1
    best_g = -1
    for h in range(3 * t, 3 * t + 3):
        g = ring[h]
        while mate[h] < 0 and g != h:
            u = g // 3
            if may_link(h, g, forward, mate, links) and strip_of(owner, u) != strip_of(owner, t):
                mate[h] = g
                mate[g] = h
                added = repeats_near(h, g, mate)
                mate[h] = -1
                mate[g] = -1
                price = (added << 8) + open_links(u, ring, forward, mate, links)
                if price < best:
                    best = price
                    best_h = h
                    best_g = g
            g = ring[g]
    return best_h, best_g


@kernel
def link_faces(most, ring, forward, mate, links, owner):
    """Grow strips from each face in turn by links that add at most `most` repeated turns; how many were made.

    `owner` (n,) leads from each face to the face that stands for its strip.
    """
    made = 0
    for first in range(links.shape[0]):
        t = first
        while links[t] < 2:
            h, g = cheapest_link(t, most, ring, forward, mate, links, owner)
            if h < 0:
                break
            u = g // 3
            mate[h] = g
            mate[g] = h
            links[t] += 1
            links[u] += 1
            owner[strip_of(owner, u)] = strip_of(owner, t)
            made += 1
            t = u
    return made


@kernel
def name_strips(mate, owner):
    """Let each face lead to the least face that it is linked with, directly or not."""
    for t in range(owner.shape[0]):
        owner[t] = t
    for h in range(mate.shape[0]):
        if mate[h] > h:
            a = strip_of(owner, h // 3)
            b = strip_of(owner, mate[h] // 3)
            owner[max(a, b)] = min(a, b)


@kernel
def price_of(mate, strip_price):
    """Indices above one a triangle: strip_price a strip and one for each repeated turn."""
    linked = 0
    repeats = 0
    for h in range(mate.shape[0]):
        if mate[h] > h:
            linked += 1
            repeats += repeats_across(h, mate[h], mate)
    return strip_price * (mate.shape[0] // 3 - linked) + repeats
