"""Which way and in which order classic strips are written, and the writing itself.

A strip of k triangles has k - 2 *turns*, those of its inner triangles: 0 where a triangle is left by its edge
b -> c, 1 where by c -> a, seen from the way it is written. A triangle at an even place of the index list
turns by 0 for nothing and one at an odd place by 1; else an index is repeated, which moves all that follows
by one place. So a strip written from one end costs k + 2, one for each pair of equal turns, and one more
where its second triangle does not turn as its place wants. Written from the other end all turns are the other
ones. The loops behind strips/topology.py.
"""

from collections import namedtuple

import numpy as np

from striptools.kernels.compiled import helper, kernel

Ends = namedtuple("Ends", "vertex turn repeats length")
"""vertex (s, 2) where each way of writing a strip begins, turn (s, 2) uint8 the first turn of each way, 2
where it has none; repeats (s,) pairs of equal turns; length (s,) triangles."""

Plan = namedtuple("Plan", "strip way corner joined")
"""Place by place: the strip, its way (0 from its first triangle, 1 from its last), the corner a lone triangle
begins with, and 1 where it begins with the vertex that ended the strip before."""

NO_TURN = 2
MOST_LOOKED_AT = 16
"""So many strips that meet at a vertex are looked at before a strip is begun elsewhere."""


@kernel
def describe(faces, turns, starts):
    """The ends of each strip: faces (n, 3) its decoded triangles, turns and starts as in Strips."""
    strips = starts.shape[0] - 1
    ends = Ends(
        np.empty((strips, 2), np.int32),
        np.full((strips, 2), NO_TURN, np.uint8),
        np.zeros(strips, np.int32),
        np.empty(strips, np.int32),
    )
    for s in range(strips):
        begin = starts[s]
        last = starts[s + 1] - 1
        ends.length[s] = last - begin + 1
        # A strip begins with the corner that its first crossing does not touch.
        ends.vertex[s, 0] = faces[begin, (1 if turns[begin + 1] else 0) if last > begin else 0]
        ends.vertex[s, 1] = faces[last, 2]
        if last - begin < 2:
            continue
        ends.turn[s, 0] = turns[begin + 2]
        ends.turn[s, 1] = 1 - turns[last]
        for k in range(begin + 3, last + 1):
            ends.repeats[s] += turns[k] == turns[k - 1]
    return ends


@kernel
def misfit(ends, s, way, place):
    """1 where a strip written so from this place on repeats an index for its first turn."""
    turn = ends.turn[s, way]
    return 1 if turn != NO_TURN and turn == place % 2 else 0


@kernel
def meet(faces, starts, ends, vertex_count):
    """Strips by the vertices they may begin with: (vertices + 1,) first places and (m,) codes.

    A code is 4 * strip + way, or 4 * strip + corner of a lone triangle, which begins with any corner.
    """
    first = np.zeros(vertex_count + 1, np.int64)
    strips = ends.length.shape[0]
    for s in range(strips):
        if ends.length[s] == 1:
            for corner in range(3):
                first[faces[starts[s], corner] + 1] += 1
        else:
            first[ends.vertex[s, 0] + 1] += 1
            first[ends.vertex[s, 1] + 1] += 1
    for v in range(vertex_count):
        first[v + 1] += first[v]
    codes = np.empty(first[vertex_count], np.int64)
    place = first[:-1].copy()
    for s in range(strips):
        for k in range(3 if ends.length[s] == 1 else 2):
            v = faces[starts[s], k] if ends.length[s] == 1 else ends.vertex[s, k]
            codes[place[v]] = 4 * s + k
            place[v] += 1
    return first, codes


@helper
def next_at(vertex, place, first, reached, codes, ends, used):
    """The code of an unused strip that begins with a vertex and fits the place; -1 where there is none.

    Strips whose turn asks for this place come before short ones, which fit anywhere.
    """
    # Leave out for good what is used at the head of the list.
    while (
        first[vertex] + reached[vertex] < first[vertex + 1]
        and (used[codes[first[vertex] + reached[vertex]] // 4])
    ):
        reached[vertex] += 1
    found = -1
    begin = first[vertex] + reached[vertex]
    for k in range(begin, min(begin + MOST_LOOKED_AT, first[vertex + 1])):
        s = codes[k] // 4
        if used[s]:
            continue
        if ends.turn[s, 0] == NO_TURN:
            if found < 0:
                found = codes[k]
        elif not misfit(ends, s, codes[k] % 4, place):
            return codes[k]
    return found


@helper
def last_vertex(faces, starts, ends, s, way, corner, place):
    """The vertex that a strip written so from this place on ends with."""
    if ends.length[s] == 1:
        return faces[starts[s], (corner + (2 if place % 2 == 0 else 1)) % 3]
    return ends.vertex[s, 1 - way]


@helper
def begin_at(start, place, ends, used):
    """The first of a few unused strips from `start` on that fits the place from one end, as a code.

    Where none does it is `start` itself from its first end.
    """
    for s in range(start, min(start + MOST_LOOKED_AT, used.shape[0])):
        for way in range(2):
            if not used[s] and not misfit(ends, s, way, place):
                return 4 * s + (0 if ends.length[s] == 1 else way)
    return 4 * start


@kernel
def plan(faces, starts, ends, vertex_count, apart, keep_places):
    """Lay the strips out in chains; returns the plan, the number of indices and of joins.

    `apart` indices lie between strips that do not share a vertex, and the place goes on through them where
    `keep_places`, else starts anew. Greedy: each chain begins with one of the first unused strips, from an
    end that fits, and goes on with strips that begin where it ended and fit the place.
    """
    strips = ends.length.shape[0]
    out = Plan(
        np.empty(strips, np.int32), np.zeros(strips, np.uint8), np.zeros(strips, np.uint8),
        np.zeros(strips, np.uint8),
    )  # fmt: skip
    first, codes = meet(faces, starts, ends, vertex_count)
    reached = np.zeros(vertex_count, np.int64)
    used = np.zeros(strips, np.bool_)
    total = 0
    joins = 0
    place = 0
    done = 0
    start = 0
    while start < strips:
        if used[start]:
            start += 1
            continue
        if done > 0:
            total += apart
            place = place + apart if keep_places else 0
        code = begin_at(start, place, ends, used)
        joined = 0
        while code >= 0:
            s = code // 4
            lone = ends.length[s] == 1
            way = 0 if lone else code % 4
            corner = code % 4 if lone else 0
            used[s] = True
            out.strip[done] = s
            out.way[done] = way
            out.corner[done] = corner
            out.joined[done] = joined
            done += 1
            vertex = last_vertex(faces, starts, ends, s, way, corner, place)
            length = ends.length[s] + 2 + ends.repeats[s] + misfit(ends, s, way, place)
            total += length
            place += length
            code = next_at(vertex, place, first, reached, codes, ends, used)
            joined = 1
            joins += code >= 0
    return out, total, joins


@helper
def write_strip(faces, turns, begin, end, way, corner, base, at, out):
    """Write one strip at out[at:], whose place 0 is `base`; returns where it ends."""
    count = end - begin
    # Write the first triangle, its winding by its place.
    first = begin if way == 0 else end - 1
    shift = corner
    if count > 1:
        shift = 2 if way == 1 else (1 if turns[begin + 1] else 0)
    second = 1 if (at - base) % 2 == 0 else 2
    out[at] = faces[first, shift]
    out[at + 1] = faces[first, (shift + second) % 3]
    out[at + 2] = faces[first, (shift + 3 - second) % 3]
    at += 3
    for k in range(1, count):
        if way == 0:
            face = begin + k
            added = faces[face, 2]
            turn = turns[face]
        else:
            face = end - 1 - k
            added = faces[face, 1 if turns[face + 1] else 0]
            turn = 1 - turns[min(face + 2, end - 1)]
        # Where the triangle before does not turn as its place wants, repeat its first vertex before its last.
        if k > 1 and turn != (at - 3 - base) % 2:
            out[at] = out[at - 1]
            out[at - 1] = out[at - 3]
            at += 1
        out[at] = added
        at += 1
    return at


@kernel
def write(faces, turns, starts, out_plan, restart, stitched, out):
    """Write strips by a plan, `restart` between those not joined or, `stitched`, two repeated vertices."""
    at = 0
    base = 0
    for k in range(out_plan.strip.shape[0]):
        s = out_plan.strip[k]
        if k > 0 and not out_plan.joined[k]:
            if stitched:
                # Leave room for the last vertex again and the first one of this strip.
                out[at] = out[at - 1]
                at += 2
            else:
                out[at] = restart
                at += 1
                base = at
        begin = at
        at = write_strip(
            faces, turns, starts[s], starts[s + 1], out_plan.way[k], out_plan.corner[k], base, at, out
        )
        if k > 0 and stitched and not out_plan.joined[k]:
            out[begin - 1] = out[begin]
    return at
