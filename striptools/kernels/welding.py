"""Equal rows and near points by hashing: linear, and the first row always stands for the others."""

import numpy as np
from numba import njit

LOW_WORD = np.uint64(0xFFFFFFFF)
SMALLEST_CELL = 1e-44
"""In the unit of the points: a finer grid than float32 would overflow and tell nothing more apart."""


@njit(cache=True, nogil=True)
def scramble(word):
    """A 32-bit permutation that spreads every bit (Wellons 2018, "Prospecting for hash functions").

    Kept in 64 bits, where a product of two 32-bit numbers does not overflow, so that it runs without Numba
    too.
    """
    word = ((word ^ (word >> np.uint64(16))) * np.uint64(0x7FEB352D)) & LOW_WORD
    word = ((word ^ (word >> np.uint64(15))) * np.uint64(0x846CA68B)) & LOW_WORD
    return word ^ (word >> np.uint64(16))


@njit(cache=True, nogil=True)
def mix_bits(a, b, c):
    """A 32-bit hash of three 32-bit words."""
    return scramble(np.uint64(c) ^ scramble(np.uint64(b) ^ scramble(np.uint64(a))))


@njit(cache=True, nogil=True)
def first_equal_rows(words):
    """For each row of `words`, `(n, 3)` uint32, the index of the first row equal to it, `(n,)` int32."""
    rows = words.shape[0]
    slots = 16
    while slots < 2 * rows:
        slots *= 2
    mask = np.uint64(slots - 1)
    table = np.full(slots, -1, np.int32)
    first = np.empty(rows, np.int32)
    for row in range(rows):
        a = words[row, 0]
        b = words[row, 1]
        c = words[row, 2]

        # Probe from the row's own slot until an equal row or a free slot is found.
        slot = mix_bits(a, b, c) & mask
        known = table[slot]
        while known >= 0 and (words[known, 0] != a or words[known, 1] != b or words[known, 2] != c):
            slot = (slot + np.uint64(1)) & mask
            known = table[slot]
        if known < 0:
            table[slot] = row
            known = row
        first[row] = known
    return first


@njit(cache=True, nogil=True)
def bits_of_whole_number(x):
    """A word that tells whole float64 numbers apart where they fit 32 bits, and is any word elsewhere."""
    folded = x - 4294967296.0 * np.floor(x / 4294967296.0)
    return np.uint32(np.uint64(folded))


@njit(cache=True, nogil=True)
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
