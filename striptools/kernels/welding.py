"""Equal rows and near points by hashing: linear, and the first row always stands for the others."""

import numpy as np

from striptools.kernels.compiled import helper, kernel

LOW_WORD = np.uint64(0xFFFFFFFF)
NEAR_PROBES = 6
"""How often the neighbourhood of a face's least vertex is probed before a slot far from it."""

SMALLEST_CELL = 1e-44
"""In the unit of the points: a finer grid than float32 would overflow and tell nothing more apart."""


@helper
def scramble(word):
    """A 32-bit permutation that spreads every bit (Wellons 2018, "Prospecting for hash functions").

    Kept in 64 bits, where a product of two 32-bit numbers does not overflow, so that it runs without Numba
    too.
    """
    word = ((word ^ (word >> np.uint64(16))) * np.uint64(0x7FEB352D)) & LOW_WORD
    word = ((word ^ (word >> np.uint64(15))) * np.uint64(0x846CA68B)) & LOW_WORD
    return word ^ (word >> np.uint64(16))


@helper
def mix_bits(a, b, c):
    """A 32-bit hash of three 32-bit words."""
    return scramble(np.uint64(c) ^ scramble(np.uint64(b) ^ scramble(np.uint64(a))))


@helper
def table_size(rows):
    """A power of two of at least twice so many rows."""
    slots = 16
    while slots < 2 * rows:
        slots *= 2
    return slots


@helper
def part_of(mixed, parts):
    """Which of `parts` a hash belongs to, by its high bits: the low ones choose the slot."""
    return np.int64(mixed >> np.uint64(16)) * parts >> 16


@kernel
def first_equal_rows(words, part, parts, first):
    """Note the first equal row of each row of `words`, `(n, 3)` uint32, of one part by hash.

    Equal rows are of one part, so that all parts together note the same for any number of parts.

    Args:
        words: The rows.
        part: Which part, 0 to parts - 1.
        parts: How many parts there are.
        first: `(n,)` int32 to fill for the rows of the part.

    Returns:
        How many rows of the part have an equal one before them.
    """
    # Count the rows of the part, for a table of the right size.
    rows = words.shape[0]
    mine = rows
    if parts > 1:
        mine = 0
        for row in range(rows):
            mine += 1 if part_of(mix_bits(words[row, 0], words[row, 1], words[row, 2]), parts) == part else 0
    mask = np.uint64(table_size(mine) - 1)
    table = np.full(np.int64(mask) + 1, -1, np.int32)
    repeats = 0
    for row in range(rows):
        a = words[row, 0]
        b = words[row, 1]
        c = words[row, 2]
        mixed = mix_bits(a, b, c)
        if part_of(mixed, parts) != part:
            continue

        # Probe from the row's own slot until an equal row or a free slot is found.
        slot = mixed & mask
        known = table[slot]
        while known >= 0 and (words[known, 0] != a or words[known, 1] != b or words[known, 2] != c):
            slot = (slot + np.uint64(1)) & mask
            known = table[slot]
        if known < 0:
            table[slot] = row
            known = row
        first[row] = known
        repeats += 1 if known != row else 0
    return repeats


@kernel
def least_first(faces, face):
    """The corners of a face, turned so that the least comes first."""
    a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
    if b < a and b < c:
        return b, c, a
    if c < a and c < b:
        return c, a, b
    return a, b, c


@kernel
def mark_repeated_faces(faces, keep, vertex_count, part, parts, repeated):
    """Mark the kept faces that repeat an earlier kept one up to rotation, of one part by least vertex.

    Args:
        faces: `(n, 3)` int32, no vertex twice in a kept face.
        keep: `(n,)` bool.
        vertex_count: How many vertices there are.
        part: Which part, 0 to parts - 1.
        parts: How many parts there are.
        repeated: `(n,)` bool, all False, to fill for the faces of the part.
    """
    # Count the faces of the part, for a table of the right size.
    begin = vertex_count * part // parts
    end = vertex_count * (part + 1) // parts
    mine = np.int64(0)
    for face in range(faces.shape[0]):
        least = min(min(faces[face, 0], faces[face, 1]), faces[face, 2])
        mine += 1 if begin <= least < end else 0
    slots = table_size(mine)
    mask = slots - 1
    table = np.full(slots, -1, np.int32)
    spread = max(1, slots // max(1, end - begin))
    for face in range(faces.shape[0]):
        a, b, c = least_first(faces, face)
        if not (begin <= a < end and keep[face]):
            continue

        # Probe near the place of the least vertex first, where neighbours in the mesh are neighbours in the
        # table; then, for that place may be crowded far and wide, in steps and from a slot that all three
        # choose.
        slot = (a - begin) * spread & mask
        step = np.int64(1)
        known = table[slot]
        probes = 1
        while known >= 0 and (a, b, c) != least_first(faces, known):
            if probes == NEAR_PROBES:
                slot = np.int64(mix_bits(a, b, c))
                step = np.int64(mix_bits(c, a, b)) | 1
            slot = slot + step & mask
            known = table[slot]
            probes += 1
        if known < 0:
            table[slot] = face
        else:
            repeated[face] = True


@kernel
def mark_used(faces, begin, end, used):
    """Mark the vertices of the faces `begin:end`; threads that mark the same vertex write the same."""
    for face in range(begin, end):
        for corner in range(3):
            used[faces[face, corner]] = True


@kernel
def renumber_faces(faces, place, begin, end):
    """Put the vertices of the faces `begin:end` in their new places."""
    for face in range(begin, end):
        for corner in range(3):
            faces[face, corner] = place[faces[face, corner]]


@helper
def bits_of_whole_number(x):
    """A word that tells whole float64 numbers apart where they fit 32 bits, and is any word elsewhere."""
    folded = x - 4294967296.0 * np.floor(x / 4294967296.0)
    return np.uint32(np.uint64(folded))


@kernel
def nearest_leaders(points, distance):
    """Join each point to the nearest earlier leader within `distance`, or make it a leader.

    Args:
        points: `(n, 3)` float32.
        distance: The greatest displacement, positive and finite, in the unit of the points.

    Returns:
        The leader of each point, `(n,)` int32 (a leader leads itself; so does a point that is not finite),
        and the greatest distance from a point to its leader.
    """
    count = points.shape[0]
    slots = 16
    while slots < count:
        slots *= 2
    mask = np.uint64(slots - 1)
    newest = np.full(slots, -1, np.int32)
    older = np.full(count, -1, np.int32)
    leader = np.empty(count, np.int32)
    farthest = 0.0
    # Cells a little wider than the distance: no rounding of a quotient moves a neighbour two cells away.
    cell = 1.001 * max(distance, SMALLEST_CELL)
    for point in range(count):
        leader[point] = point
        x = np.float64(points[point, 0])
        y = np.float64(points[point, 1])
        z = np.float64(points[point, 2])
        if not (np.isfinite(x) and np.isfinite(y) and np.isfinite(z)):
            continue
        column = np.floor(x / cell)
        line = np.floor(y / cell)
        layer = np.floor(z / cell)

        # Look through the 27 cells round the point; other cells that share a slot do no harm.
        best = np.inf
        chosen = -1
        for step in range(27):
            slot = mix_bits(
                bits_of_whole_number(column + (step % 3 - 1)),
                bits_of_whole_number(line + (step // 3 % 3 - 1)),
                bits_of_whole_number(layer + (step // 9 - 1)),
            )
            other = newest[slot & mask]
            while other >= 0:
                dx = np.float64(points[other, 0]) - x
                dy = np.float64(points[other, 1]) - y
                dz = np.float64(points[other, 2]) - z
                away = np.sqrt(dx * dx + dy * dy + dz * dz)
                if away <= distance and (away < best or (away == best and other < chosen)):
                    best = away
                    chosen = other
                other = older[other]

        # Follow the nearest leader, or start a new cluster in the point's own cell.
        if chosen >= 0:
            leader[point] = chosen
            farthest = max(farthest, best)
        else:
            slot = mix_bits(
                bits_of_whole_number(column), bits_of_whole_number(line), bits_of_whole_number(layer)
            )
            older[point] = newest[slot & mask]
            newest[slot & mask] = point
    return leader, farthest
