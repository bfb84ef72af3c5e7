"""Search for cheaper classic strips: chains of rotations, found in place and undone, priced in indices.

The *end* of a strip is a face with a free side. A **rotation** links an end t to a face u inside a strip and
cuts one of the two links of u; the face w on the far side of the cut becomes the end that the chain goes on
from. A **chain** is K rotations, then perhaps a link to another strip's end (one strip fewer). Its price is
the change of strip_price * strips + repeated turns + misfits. The repeated turns can be read near the links
it changes, the misfits at the ends of the strips: a *misfit* is a strip that begins, from whichever end it is
written, with a turn that costs an index (see classic_strips.py).

Which strip a face lies in, after the rotations so far, is not written to the faces. A table of *pieces* holds
it: runs of strips as they were before the chain, each with the label of the strip it is part of now and a
coordinate sign * pos + shift that rises or falls steadily along that strip, and their end faces. So a
rotation costs a copy of a short table whatever the strips' lengths, and only a chain that is carried out
renumbers faces.

The loops behind strips/alternating.py; half-edges, mate and forward are those of alternating_lines.py.
"""

from collections import namedtuple

import numpy as np

from striptools.kernels.alternating_lines import other_link, repeats_across, repeats_at, repeats_near
from striptools.kernels.compiled import helper, kernel, maker

Cover = namedtuple("Cover", "ring forward mate owner pos first last misfit part stale")
"""ring, forward, mate (3n,); owner (n,) the strip of a face and pos (n,) its place in it; first and last
(strips,) the end faces of a strip, -1 once joined to another; misfit (strips,) uint8, 1 for misfits; part
(n,) which worker may touch a face; stale (strips,) uint8: bit 0 for strips to be searched, bit 1 for those
that met a face of another part."""

Desk = namedtuple("Desk", "frames pieces used steps best")
"""Scratch of one search. frames (K+1, 8): the state of each depth; pieces (K+1, room, 8) and used (K+1,): the
table of each depth; steps (K+1, 4) and best (K+2, 4): h, g, cut and its mate of each rotation, now and of the
best chain, whose row 0 is K, linked or not, h, g of the last link."""

END, LABEL, AT, OUTWARD, PRICE, SLOT, CURSOR, SIDE = range(8)
STRIP, LOW, HIGH, NAME, SIGN, SHIFT, LOW_FACE, HIGH_FACE = range(8)

ROOM = 96
"""Pieces in a table; a chain that needs more is not followed further."""

CUT_OFF = -2
"""Label of the strip that a search from a cut leaves behind."""

ANY_PART = -1
STALE, MET = 1, 2


@maker
def new_desk(deepest):
    """Scratch for chains of up to `deepest` rotations."""
    return Desk(
        np.zeros((deepest + 1, 8), np.int64),
        np.zeros((deepest + 1, ROOM, 8), np.int64),
        np.zeros(deepest + 1, np.int64),
        np.zeros((deepest + 1, 4), np.int64),
        np.zeros((deepest + 2, 4), np.int64),
    )


@kernel
def begins_badly(face, mate):
    """Whether a strip written from its end `face` on repeats an index for its first turn, which is 0 then."""
    for h in range(3 * face, 3 * face + 3):
        if mate[h] >= 0:
            entry = mate[h]
            leave = other_link(mate, entry)
            return leave >= 0 and (leave - entry + 3) % 3 == 1
    return False


@helper
def number_strip(face, strip, cover):
    """Number the faces of a strip from its end `face` on."""
    mate = cover.mate
    cover.first[strip] = face
    begin = face
    came = -1
    place = 0
    while True:
        cover.owner[face] = strip
        cover.pos[face] = place
        place += 1
        leave = -1
        for h in range(3 * face, 3 * face + 3):
            if mate[h] >= 0 and h != came:
                leave = h
        if leave < 0:
            break
        came = mate[leave]
        face = came // 3
    cover.last[strip] = face
    cover.misfit[strip] = begins_badly(begin, mate) and begins_badly(face, mate)


@helper
def links_of(face, mate):
    """The two last linked half-edges of a face, -1 for those that are not."""
    one = -1
    two = -1
    for h in range(3 * face, 3 * face + 3):
        if mate[h] >= 0:
            two = one
            one = h
    return one, two


@kernel
def number_strips(cover):
    """Number every strip, in the order of its least end; returns how many."""
    cover.owner[:] = -1
    strips = 0
    for face in range(cover.owner.shape[0]):
        if cover.owner[face] < 0 and links_of(face, cover.mate)[1] < 0:
            number_strip(face, strips, cover)
            strips += 1
    return strips


@helper
def piece_of(face, depth, cover, desk):
    """The row of the table at `depth` that holds a face; its whole strip is added where it is new."""
    strip = cover.owner[face]
    place = cover.pos[face]
    pieces = desk.pieces
    for k in range(desk.used[depth]):
        if pieces[depth, k, STRIP] == strip and pieces[depth, k, LOW] <= place <= pieces[depth, k, HIGH]:
            return k
    k = desk.used[depth]
    desk.used[depth] += 1
    pieces[depth, k, STRIP] = strip
    pieces[depth, k, LOW] = 0
    pieces[depth, k, HIGH] = cover.pos[cover.last[strip]]
    pieces[depth, k, NAME] = strip
    pieces[depth, k, SIGN] = 1
    pieces[depth, k, SHIFT] = 0
    pieces[depth, k, LOW_FACE] = cover.first[strip]
    pieces[depth, k, HIGH_FACE] = cover.last[strip]
    return k


@helper
def copy_cut(depth, one, other, u, w, cover, desk):
    """Copy the table one depth down; where rows `one` and `other` are one, cut it between faces u and w."""
    pieces = desk.pieces
    used = desk.used[depth]
    for k in range(used):
        for column in range(8):
            pieces[depth + 1, k, column] = pieces[depth, k, column]
    if one == other:
        for column in range(8):
            pieces[depth + 1, used, column] = pieces[depth, one, column]
        before = u if cover.pos[u] < cover.pos[w] else w
        pieces[depth + 1, one, HIGH] = cover.pos[before]
        pieces[depth + 1, one, HIGH_FACE] = before
        pieces[depth + 1, used, LOW] = cover.pos[before] + 1
        pieces[depth + 1, used, LOW_FACE] = w if before == u else u
        used += 1
    desk.used[depth + 1] = used


@helper
def rotate_pieces(depth, u, w, cover, desk):
    """Make the table one depth down, of the end's rotation to u that cuts u from w; whether it may be done.

    A cut in the end's own strip must lie between u and the end, or the strip would close to a ring.
    """
    frames = desk.frames
    k = piece_of(u, depth, cover, desk)
    kw = piece_of(w, depth, cover, desk)
    pieces = desk.pieces
    at_u = pieces[depth, k, SIGN] * cover.pos[u] + pieces[depth, k, SHIFT]
    at_w = pieces[depth, kw, SIGN] * cover.pos[w] + pieces[depth, kw, SHIFT]
    name = pieces[depth, k, NAME]
    own = frames[depth, LABEL]
    at = frames[depth, AT]
    outward = frames[depth, OUTWARD]
    to_w = 1 if at_w > at_u else -1
    if name == own and to_w != outward:
        return False
    copy_cut(depth, k, kw, u, w, cover, desk)
    for i in range(desk.used[depth + 1]):
        if pieces[depth + 1, i, NAME] != name:
            continue
        sign = pieces[depth + 1, i, SIGN]
        shift = pieces[depth + 1, i, SHIFT]
        beyond = (sign * pieces[depth + 1, i, LOW] + shift - at_u) * to_w > 0
        if name == own and beyond:
            # Turn the part from the end to w round, so that the end comes to lie next to u.
            pieces[depth + 1, i, SIGN] = -sign
            pieces[depth + 1, i, SHIFT] = at_u + outward + at - shift
        elif name != own and not beyond:
            # Append the part from u on to the end.
            flip = -outward * to_w
            pieces[depth + 1, i, NAME] = own
            pieces[depth + 1, i, SIGN] = flip * sign
            pieces[depth + 1, i, SHIFT] = at + outward + flip * (shift - at_u)
    frames[depth + 1, LABEL] = name
    frames[depth + 1, OUTWARD] = outward if name == own else -to_w
    frames[depth + 1, AT] = at_u + outward + at - at_w if name == own else at_w
    return True


@helper
def next_neighbour(frame, mine, strip, cover):
    """Move the frame's cursor to the next half-edge that its end could link to; whether there is one."""
    ring = cover.ring
    mate = cover.mate
    t = frame[END]
    while frame[SLOT] < 3:
        h = 3 * t + frame[SLOT]
        if mate[h] >= 0:
            frame[SLOT] += 1
            continue
        g = ring[h] if frame[CURSOR] < 0 else ring[frame[CURSOR]]
        frame[CURSOR] = g
        if g == h:
            frame[SLOT] += 1
            frame[CURSOR] = -1
        elif mate[g] < 0 and g // 3 != t and cover.forward[g] != cover.forward[h]:
            if mine == ANY_PART or cover.part[g // 3] == mine:
                return True
            cover.stale[strip] |= MET
    return False


@helper
def keep_best(rotations, linked, h, g, desk):
    """Write down the chain at hand as the best one."""
    desk.best[0, 0] = rotations
    desk.best[0, 1] = linked
    desk.best[0, 2] = h
    desk.best[0, 3] = g
    for k in range(rotations):
        for column in range(4):
            desk.best[k + 1, column] = desk.steps[k, column]


@helper
def ends_of(name, depth, desk):
    """The two end faces of the strip of a label."""
    pieces = desk.pieces
    low = 0
    high = 0
    low_face = -1
    high_face = -1
    for k in range(desk.used[depth]):
        if pieces[depth, k, NAME] != name:
            continue
        sign = pieces[depth, k, SIGN]
        one = sign * pieces[depth, k, LOW] + pieces[depth, k, SHIFT]
        other = sign * pieces[depth, k, HIGH] + pieces[depth, k, SHIFT]
        if low_face < 0 or min(one, other) < low:
            low = min(one, other)
            low_face = pieces[depth, k, LOW_FACE] if sign > 0 else pieces[depth, k, HIGH_FACE]
        if high_face < 0 or max(one, other) > high:
            high = max(one, other)
            high_face = pieces[depth, k, HIGH_FACE] if sign > 0 else pieces[depth, k, LOW_FACE]
    return low_face, high_face


@helper
def misfits_before(depth, cover, desk):
    """Misfits among the strips in the table, as they were before the chain."""
    count = 0
    for k in range(desk.used[depth]):
        if desk.pieces[depth, k, LOW] == 0:
            count += cover.misfit[desk.pieces[depth, k, STRIP]]
    return count


@helper
def misfits_after(depth, linked_to, t, u, cover, desk):
    """Misfits among the strips in the table, those of t and of `linked_to`, whose end is u, being one."""
    mate = cover.mate
    own = desk.frames[depth, LABEL]
    count = 0
    for k in range(desk.used[depth]):
        name = desk.pieces[depth, k, NAME]
        known = name == linked_to
        for j in range(k):
            known = known or desk.pieces[depth, j, NAME] == name
        if known:
            continue
        low, high = ends_of(name, depth, desk)
        if name == own and u >= 0:
            one, other = ends_of(linked_to, depth, desk)
            low = high if low == t else low
            high = other if one == u else one
        count += begins_badly(low, mate) and begins_badly(high, mate)
    return count


@helper
def price_of_link(depth, h, g, strip_price, best, cover, desk):
    """The chain's price where it ends by linking h and g; `best` where it is no less or closes a ring."""
    frame = desk.frames[depth]
    mate = cover.mate
    name = desk.pieces[depth, piece_of(g // 3, depth, cover, desk), NAME]
    if name == frame[LABEL]:
        return best
    mate[h] = g
    mate[g] = h
    price = frame[PRICE] - strip_price + repeats_near(h, g, mate) - misfits_before(depth, cover, desk)
    if price < best:
        price += misfits_after(depth, name, h // 3, g // 3, cover, desk)
    mate[h] = -1
    mate[g] = -1
    return price


@helper
def price_of_stop(depth, best, cover, desk):
    """The chain's price where it ends without a link; `best` or more where it is no less."""
    price = desk.frames[depth, PRICE] - misfits_before(depth, cover, desk)
    if price < best:
        price += misfits_after(depth, CUT_OFF - 1, -1, -1, cover, desk)
    return price


@helper
def rotate(depth, h, g, cut, cover, desk):
    """Do a rotation and open the frame below; returns whether it may be done."""
    mate = cover.mate
    frames = desk.frames
    across = mate[cut]
    u = g // 3
    w = across // 3
    # Refuse to cut what this chain has linked, and to come back to the end at once.
    if w == frames[depth, END] or desk.used[depth] + 3 >= ROOM:
        return False
    for k in range(depth):
        if desk.steps[k, 0] == cut or desk.steps[k, 1] == cut:
            return False
    if not rotate_pieces(depth, u, w, cover, desk):
        return False
    # Count the repeated turns round the cut and, after it, round the new link.
    kept = other_link(mate, cut)
    price = frames[depth, PRICE] - repeats_near(cut, across, mate)
    mate[cut] = -1
    mate[across] = -1
    mate[h] = g
    mate[g] = h
    price += repeats_across(h, g, mate) + repeats_at(kept, mate) + repeats_at(other_link(mate, h), mate)
    desk.steps[depth, 0] = h
    desk.steps[depth, 1] = g
    desk.steps[depth, 2] = cut
    desk.steps[depth, 3] = across
    frames[depth + 1, END] = w
    frames[depth + 1, PRICE] = price
    frames[depth + 1, SLOT] = 0
    frames[depth + 1, CURSOR] = -1
    frames[depth + 1, SIDE] = 0
    return True


@helper
def undo_rotation(depth, cover, desk):
    """Put the links back as they were before the rotation at `depth`."""
    mate = cover.mate
    mate[desk.steps[depth, 0]] = -1
    mate[desk.steps[depth, 1]] = -1
    mate[desk.steps[depth, 2]] = desk.steps[depth, 3]
    mate[desk.steps[depth, 3]] = desk.steps[depth, 2]


@helper
def find_chain(rotations, strip_price, must_link, mine, cover, desk):
    """Try all chains of exactly so many rotations from the frame at depth 0; the best price, 0 if none pays.

    The best chain of negative price is left in desk.best; the first found among equals.
    """
    frames = desk.frames
    mate = cover.mate
    strip = cover.owner[frames[0, END]]
    best = 0
    depth = 0
    while depth >= 0:
        frame = frames[depth]
        # Go to the next neighbour unless the second cut at this one is to be tried; step back after all.
        if frame[SIDE] == 0 and not next_neighbour(frame, mine, strip, cover):
            depth -= 1
            if depth >= 0:
                undo_rotation(depth, cover, desk)
            continue
        h = 3 * frame[END] + frame[SLOT]
        g = frame[CURSOR]
        one, two = links_of(g // 3, mate)
        if two < 0:
            # Another end: the chain may stop here by a link.
            if depth == rotations:
                price = price_of_link(depth, h, g, strip_price, best, cover, desk)
                if price < best:
                    best = price
                    keep_best(rotations, 1, h, g, desk)
            continue
        if depth == rotations:
            continue
        cut = one if frame[SIDE] == 0 else two
        frame[SIDE] = 1 - frame[SIDE]
        if rotate(depth, h, g, cut, cover, desk):
            depth += 1
            price = best if must_link or depth < rotations else price_of_stop(depth, best, cover, desk)
            if price < best:
                best = price
                keep_best(rotations, 0, -1, -1, desk)
    return best


@helper
def start_at_end(t, cover, desk):
    """Set depth 0 to an end face and its strip."""
    strip = cover.owner[t]
    desk.used[0] = 0
    piece_of(t, 0, cover, desk)
    frame = desk.frames[0]
    frame[END] = t
    frame[LABEL] = strip
    frame[AT] = cover.pos[t]
    frame[OUTWARD] = 1 if t == cover.last[strip] else -1
    frame[PRICE] = 0
    frame[SLOT] = 0
    frame[CURSOR] = -1
    frame[SIDE] = 0


@helper
def start_at_cut(h, g, strip_price, cover, desk):
    """Cut the link of h and g and set depth 0 to the face of h, an end now."""
    t = h // 3
    start_at_end(t, cover, desk)
    price = strip_price - repeats_near(h, g, cover.mate)
    cover.mate[h] = -1
    cover.mate[g] = -1
    after = 1 if cover.pos[g // 3] > cover.pos[t] else 0
    pieces = desk.pieces
    for column in range(8):
        pieces[0, 1, column] = pieces[0, 0, column]
    pieces[0, 0, HIGH] = min(cover.pos[t], cover.pos[g // 3])
    pieces[0, 0, HIGH_FACE] = t if after else g // 3
    pieces[0, 1, LOW] = pieces[0, 0, HIGH] + 1
    pieces[0, 1, LOW_FACE] = g // 3 if after else t
    pieces[0, after, NAME] = CUT_OFF
    desk.used[0] = 2
    desk.frames[0, OUTWARD] = 1 if after else -1
    desk.frames[0, PRICE] = price


@helper
def changed_faces(t, cover, desk, faces):
    """List the faces whose links the best chain changes, begun at t; returns how many."""
    count = 1
    faces[0] = t
    rotations = desk.best[0, 0]
    for k in range(1, rotations + 1):
        faces[count] = desk.best[k, 1] // 3
        faces[count + 1] = desk.best[k, 3] // 3
        count += 2
    if desk.best[0, 1]:
        faces[count] = desk.best[0, 3] // 3
        count += 1
    return count


@helper
def carry_out(t, cut_from, cover, desk, faces, strips):
    """Do the best chain found from t and number the strips it touches anew; marks stale what it may help."""
    mate = cover.mate
    best = desk.best
    count = changed_faces(t, cover, desk, faces)
    if cut_from >= 0:
        faces[count] = cut_from
        count += 1
    # List the strips, whose numbers the new ones take over, and their ends.
    touched = 0
    bits = STALE
    for k in range(count):
        known = False
        for j in range(touched):
            known = known or strips[j] == cover.owner[faces[k]]
        if not known:
            strips[touched] = cover.owner[faces[k]]
            bits |= cover.stale[strips[touched]]
            touched += 1
    changed = count
    for j in range(touched):
        faces[count] = cover.first[strips[j]]
        faces[count + 1] = cover.last[strips[j]]
        count += 2
    # Change the links: first all cuts, then all links.
    for k in range(1, best[0, 0] + 1):
        mate[best[k, 2]] = -1
        mate[best[k, 3]] = -1
    for k in range(1, best[0, 0] + 1):
        mate[best[k, 0]] = best[k, 1]
        mate[best[k, 1]] = best[k, 0]
    if best[0, 1]:
        mate[best[0, 2]] = best[0, 3]
        mate[best[0, 3]] = best[0, 2]
    # Number each strip from its end that is met first.
    for k in range(count):
        cover.owner[faces[k]] = -1
    done = 0
    for k in range(count):
        if cover.owner[faces[k]] < 0 and links_of(faces[k], mate)[1] < 0:
            number_strip(faces[k], strips[done], cover)
            cover.stale[strips[done]] = bits
            done += 1
    for j in range(done, touched):
        cover.first[strips[j]] = -1
        cover.last[strips[j]] = -1
        cover.stale[strips[j]] = 0
    # Let the strips next to the change be searched again.
    for k in range(changed):
        for h in range(3 * faces[k], 3 * faces[k] + 3):
            g = cover.ring[h]
            while g != h:
                if cover.part[g // 3] == cover.part[faces[k]]:
                    cover.stale[cover.owner[g // 3]] |= STALE
                g = cover.ring[g]


@helper
def search_strip(strip, deepest, strip_price, must_link, mine, cover, desk, faces, strips):
    """Carry out the first chain that pays from either end of a strip, of fewest rotations; what it saves."""
    saved = 0
    for side in range(2):
        if cover.first[strip] < 0 or (side == 1 and cover.first[strip] == cover.last[strip]):
            break
        t = np.int64(cover.first[strip] if side == 0 else cover.last[strip])
        for rotations in range(deepest + 1):
            start_at_end(t, cover, desk)
            price = find_chain(rotations, strip_price, must_link, mine, cover, desk)
            if price < 0:
                carry_out(t, -1, cover, desk, faces, strips)
                saved -= price
                break
    return saved


@kernel
def search_strips(ids, passes, deepest, strip_price, mine, cover):
    """Search from the ends of the stale strips among `ids`, shortest first, pass after pass; what it saves.

    In the first pass every chain must end in a link: fewer strips first, fewer repeated turns afterwards.
    """
    desk = new_desk(deepest)
    faces = np.empty(6 * deepest + 16, np.int64)
    strips = np.empty(6 * deepest + 16, np.int64)
    lengths = np.empty(ids.shape[0], np.int64)
    saved = 0
    for p in range(passes):
        must_link = np.bool_(p == 0)
        for k in range(ids.shape[0]):
            lengths[k] = cover.pos[cover.last[ids[k]]] if cover.first[ids[k]] >= 0 else -1
        before = saved
        for k in np.argsort(lengths, kind="mergesort"):
            strip = ids[k]
            while cover.first[strip] >= 0 and cover.stale[strip] & STALE:
                cover.stale[strip] &= MET
                saved += search_strip(
                    strip, deepest, strip_price, must_link, mine, cover, desk, faces, strips
                )
        if must_link:
            for strip in ids:
                cover.stale[strip] |= STALE
        elif saved == before:
            break
    return saved


@kernel
def search_cuts(deepest, strip_price, must_link, mine, cover):
    """Search from every link between equal turns as if it were cut; a chain must make up for the cut."""
    desk = new_desk(deepest)
    faces = np.empty(6 * deepest + 16, np.int64)
    strips = np.empty(6 * deepest + 16, np.int64)
    mate = cover.mate
    saved = 0
    for h in range(mate.shape[0]):
        for rotations in range(deepest + 1):
            g = np.int64(mate[h])
            if g < 0 or repeats_across(h, g, mate) == 0:
                break
            start_at_cut(h, g, strip_price, cover, desk)
            price = find_chain(rotations, strip_price, must_link, mine, cover, desk)
            if price < 0:
                carry_out(h // 3, g // 3, cover, desk, faces, strips)
                saved -= price
                break
            mate[h] = g
            mate[g] = h
    return saved
