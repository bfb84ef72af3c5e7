"""From sequences of faces to generalised strips: the loops behind strips/topology.py.

Sets of slots are bit masks (bit k for slot k). Slot k of a face is its edge from corner k to corner (k + 1)
% 3.
"""

from numba import njit

ALL_SLOTS = 7


@njit(cache=True, nogil=True)
def meeting_slot(faces, t, leave, u):
    """The set of slots of face u that run slot `leave` of face t in the opposite direction."""
    a = faces[t, leave]
    b = faces[t, (leave + 1) % 3]
    met = 0
    for slot in range(3):
        if faces[u, slot] == b and faces[u, (slot + 1) % 3] == a:
            met |= 1 << slot
    return met


@njit(cache=True, nogil=True)
def slots_after(faces, t, entered, u):
    """The set of slots face u can be entered by from face t, itself entered by one of the set `entered`.

    A face is never left by the slot it was entered by. An empty set, 0, stands for a face that starts a
    strip.
    """
    reached = 0
    for leave in range(3):
        if entered == 0 or entered & ~(1 << leave):
            reached |= meeting_slot(faces, t, leave, u)
    return reached


@njit(cache=True, nogil=True)
def choose_entries(faces, order, starts, entries):
    """Fill entries (n,) uint8 with the slot each face is entered by (3 for the first of a strip).

    Faces that share more than one edge leave a choice; the one of least slots from the strip's end backwards
    is taken. Returns the first position that its predecessor cannot lead to, -1 where all can.
    """
    for strip in range(starts.shape[0] - 1):
        begin = starts[strip]
        end = starts[strip + 1]
        # Go forward with the sets of slots each face can be entered by.
        reached = 0
        entries[begin] = 0
        for k in range(begin + 1, end):
            reached = slots_after(faces, order[k - 1], reached, order[k])
            if reached == 0:
                return k
            entries[k] = reached
        # Go back and keep one slot of each set, such that the face before can be left to it.
        wanted = ALL_SLOTS
        for k in range(end - 1, begin, -1):
            kept = entries[k] & wanted
            slot = 0
            while not kept >> slot & 1:
                slot += 1
            entries[k] = slot
            # The face before must be entered by another slot than one it can be left by to here.
            wanted = 0
            for leave in range(3):
                if meeting_slot(faces, order[k - 1], leave, order[k]) >> slot & 1:
                    wanted |= ALL_SLOTS ^ (1 << leave)
        entries[begin] = 3
    return -1


@njit(cache=True, nogil=True)
def leaving_slot(faces, t, entry, u, entered):
    """The least slot of face t, not its entry, that slot `entered` of face u runs against."""
    for slot in range(3):
        if slot != entry and meeting_slot(faces, t, slot, u) >> entered & 1:
            return slot
    return 3


@njit(cache=True, nogil=True)
def encode(faces, order, starts, entries, vertices, turns, rotation):
    """Fill vertices (n + 2s,), turns (n,) and rotation (n,) from sequences and entry slots."""
    for strip in range(starts.shape[0] - 1):
        begin = starts[strip]
        end = starts[strip + 1]
        place = begin + 2 * strip
        # Turn the first face so that the strip leaves it by the edge from corner 1 to corner 2.
        first = order[begin]
        turn = 0
        if end - begin > 1:
            turn = (leaving_slot(faces, first, 3, order[begin + 1], entries[begin + 1]) + 2) % 3
        for corner in range(3):
            vertices[place + corner] = faces[first, (corner + turn) % 3]
        rotation[begin] = turn
        turns[begin] = False
        for k in range(begin + 1, end):
            # Corner 0 of the running triangle is where its entry slot starts; the new vertex is the third.
            face = order[k]
            rotation[k] = entries[k]
            vertices[place + 2 + k - begin] = faces[face, (entries[k] + 2) % 3]
            # The face before is left by the slot one (no bit) or two (bit) places after its own first corner.
            leave = leaving_slot(faces, order[k - 1], entries[k - 1], face, entries[k])
            turns[k] = (leave + 3 - rotation[k - 1]) % 3 == 2
