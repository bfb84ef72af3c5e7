"""From sequences of faces to generalised strips: the loops behind strips/topology.py.

Sets of slots are bit masks (bit k for slot k). Slot k of a face is its edge from corner k to corner (k + 1)
% 3. A face is *flipped* where it is read with its first two corners swapped.
"""

import numpy as np
from numba import njit

ALL_SLOTS = 7


def _usable_crossings(entered):
    """Which of the nine crossings may be taken out of a face entered by one of a set of slots.

    A face is never left by the slot it was entered by; with two slots to choose from, or none (the first face
    of a strip), every crossing stays possible.
    """
    rows = [0 if entered == 1 << leave else ALL_SLOTS << 3 * leave for leave in range(3)]
    return sum(rows)


def _entries_before(leaving):
    """The slots by which a face may be entered that has to be left by one of a set of slots."""
    return sum(
        {1 << entry for entry in range(3) for leave in range(3) if leaving >> leave & 1 and leave != entry}
    )


LEAST_SLOT = np.array([3, 0, 1, 0, 2, 0, 1, 0], np.uint8)
"""The least slot of each set; 3 for the empty one."""

USABLE = np.array([_usable_crossings(entered) for entered in range(8)], np.int64)
ENTRIES_BEFORE = np.array([_entries_before(leaving) for leaving in range(8)], np.int64)


@njit(cache=True, nogil=True, forceinline=True)
def crossings(faces, t, u):
    """The ways from face t to face u, edges run in opposite directions: a set of bits 3 * leave + enter."""
    a, b, c = faces[t, 0], faces[t, 1], faces[t, 2]
    x, y, z = faces[u, 0], faces[u, 1], faces[u, 2]
    ways = 0
    ways |= ((x == b) & (y == a)) << 0 | ((y == b) & (z == a)) << 1 | ((z == b) & (x == a)) << 2
    ways |= ((x == c) & (y == b)) << 3 | ((y == c) & (z == b)) << 4 | ((z == c) & (x == b)) << 5
    ways |= ((x == a) & (y == c)) << 6 | ((y == a) & (z == c)) << 7 | ((z == a) & (x == c)) << 8
    return ways


@njit(cache=True, nogil=True)
def may_flip(faces, t, u):
    """Whether a strip may cross from face t to face u by an edge that both run the same way.

    It may not where they run some other edge in opposite directions, which takes a repeated vertex: an
    encoder would not know which of them are flipped.
    """
    return crossings(faces, t, u) == 0


@njit(cache=True, nogil=True, forceinline=True)
def slots_entered(ways):
    """The slots of the second face that a set of crossings enters by."""
    return (ways | ways >> 3 | ways >> 6) & ALL_SLOTS


@njit(cache=True, nogil=True, forceinline=True)
def slots_left(ways, entered):
    """The slots of the first face by which a set of crossings comes to slot `entered` of the second."""
    ways >>= entered
    return ways & 1 | ways >> 2 & 2 | ways >> 4 & 4


@njit(cache=True, nogil=True)
def slots_after(faces, t, entered, u):
    """The set of slots face u can be entered by from face t, itself entered by one of the set `entered`.

    A face is never left by the slot it was entered by. An empty set, 0, stands for a face that starts a
    strip.
    """
    return slots_entered(crossings(faces, t, u) & USABLE[entered])


@njit(cache=True, nogil=True)
def longest_strip(starts, first, last):
    """The most faces of the strips `first:last`, at least 1."""
    longest = 1
    for strip in range(first, last):
        longest = max(longest, starts[strip + 1] - starts[strip])
    return longest


@njit(cache=True, nogil=True, forceinline=True)
def gather_strip(faces, order, begin, end, rows):
    """Copy the faces `order[begin:end]` to rows, where the passes that follow find them in order."""
    for k in range(begin, end):
        for corner in range(3):
            rows[k - begin, corner] = faces[order[k], corner]


@njit(cache=True, nogil=True, forceinline=True)
def flip(rows, k):
    """Swap the first two corners of a row."""
    rows[k, 0], rows[k, 1] = rows[k, 1], rows[k, 0]


@njit(cache=True, nogil=True, forceinline=True)
def choose_strip(rows, count, flips_allowed, ways, entries, flipped):
    """Fill entries (count,) with the slot each row is entered by, 3 for the first; ways with all crossings.

    A row that runs no edge against the one before it, read as that is, is flipped in place where that helps
    and is allowed; flipped (count,) says which were. Faces that share more than one edge leave a choice; the
    one of least slots from the strip's end backwards is taken. Returns the first row that its predecessor
    cannot lead to, -1 where all can.
    """
    # Go forward with the sets of slots each face can be entered by.
    reached = 0
    broken = -1
    turned_over = False
    flipped[0] = False
    for k in range(1, count):
        if turned_over:
            flip(rows, k)
        ways[k] = crossings(rows, k - 1, k)
        if ways[k] == 0 and flips_allowed:
            flip(rows, k)
            ways[k] = crossings(rows, k - 1, k)
            turned_over = not turned_over
        flipped[k] = turned_over
        reached = slots_entered(ways[k] & USABLE[reached])
        entries[k] = reached
        if reached == 0 and broken < 0:
            broken = k
    # Go back and keep one slot of each set, such that the face before can be left to it.
    wanted = ALL_SLOTS
    for k in range(count - 1, 0, -1):
        slot = np.int64(LEAST_SLOT[entries[k] & wanted])
        entries[k] = slot
        wanted = ENTRIES_BEFORE[slots_left(ways[k], slot)]
    entries[0] = 3
    return broken


@njit(cache=True, nogil=True)
def first_break(faces, order, starts, flips_allowed):
    """The first position of any strip that its predecessor cannot lead to, -1 where all can."""
    longest = longest_strip(starts, 0, starts.shape[0] - 1)
    rows = np.empty((longest, 3), np.int32)
    ways = np.empty(longest, np.int64)
    entries = np.empty(longest, np.int64)
    flipped = np.empty(longest, np.bool_)
    for strip in range(starts.shape[0] - 1):
        gather_strip(faces, order, starts[strip], starts[strip + 1], rows)
        count = starts[strip + 1] - starts[strip]
        broken = choose_strip(rows, count, flips_allowed, ways, entries, flipped)
        if broken >= 0:
            return starts[strip] + broken
    return -1


@njit(cache=True, nogil=True)
def encode(faces, order, starts, first, last, flips_allowed, vertices, turns, rotation, flips):
    """Fill vertices (n + 2s,), turns (n,) and rotation (n,) of the strips `first:last`; set bits of flips.

    Returns the first position that its predecessor cannot lead to, -1 where all can, and whether any face is
    flipped. Where none is, flips (n,), all False before, is not touched.
    """
    longest = longest_strip(starts, first, last)
    rows = np.empty((longest, 3), np.int32)
    ways = np.empty(longest, np.int64)
    entries = np.empty(longest, np.int64)
    flipped = np.empty(longest, np.bool_)
    any_flipped = False
    for strip in range(first, last):
        # Find the slots by which the faces are entered.
        begin = starts[strip]
        count = starts[strip + 1] - begin
        place = begin + 2 * strip
        gather_strip(faces, order, begin, begin + count, rows)
        broken = choose_strip(rows, count, flips_allowed, ways, entries, flipped)
        if broken >= 0:
            return begin + broken, any_flipped

        # Turn the first face so that the strip leaves it by the edge from corner 1 to corner 2.
        turn = 0
        if count > 1:
            turn = (LEAST_SLOT[slots_left(ways[1], entries[1])] + 2) % 3
        for corner in range(3):
            vertices[place + corner] = rows[0, (corner + turn) % 3]
        rotation[begin] = turn
        turns[begin] = False
        for k in range(1, count):
            # Corner 0 of the running triangle is where its entry slot starts; the new vertex is the third.
            entry = entries[k]
            vertices[place + 2 + k] = rows[k, (entry + 2) % 3]
            # The face before is left by the slot one (no bit) or two (bit) places after its own first corner.
            leave = LEAST_SLOT[slots_left(ways[k], entry) & ~(1 << entries[k - 1])]
            turns[begin + k] = (leave + 3 - turn) % 3 == 2
            turn = entry
            # A flipped face is written with the corners swapped back, which turns it the other way round.
            if flipped[k]:
                rotation[begin + k] = (3 - entry) % 3
                flips[begin + k] = True
                any_flipped = True
            else:
                rotation[begin + k] = entry
    return -1, any_flipped


@njit(cache=True, nogil=True)
def decode(vertices, turns, starts, first, last, faces):
    """Fill faces (n, 3) with the triangles of strips `first:last`."""
    for strip in range(first, last):
        # The first triangle is the first three vertices.
        begin = starts[strip]
        place = begin + 2 * strip
        a, b, c = vertices[place], vertices[place + 1], vertices[place + 2]
        faces[begin, 0], faces[begin, 1], faces[begin, 2] = a, b, c
        # Each other one has the newest vertex and, by its bit, one of the two before it.
        for k in range(begin + 1, starts[strip + 1]):
            if turns[k]:
                b = c
            else:
                a, b = c, b
            c = vertices[place + 2 + k - begin]
            faces[k, 0], faces[k, 1], faces[k, 2] = a, b, c


@njit(cache=True, nogil=True)
def swap_flipped(flips, first, last, faces):
    """Swap the first two corners of those of the faces `first:last` whose bit is set."""
    for k in range(first, last):
        if flips[k]:
            flip(faces, k)
