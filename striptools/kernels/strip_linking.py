"""One greedy pass over the dual edges: the loops behind strips/linking.py.

Faces of a range are numbered by their place in it. `mate` (3n,) int32 holds the half-edge linked to each
half-edge, or -1; `links` (n,) uint8 the links of each face.
"""

import numpy as np
from numba import njit

from striptools.kernels.strip_topology import may_flip

CLASSES = 128
"""Two classes an octave of subtree sizes, each for edges of two faces and of more."""


@njit(cache=True, nogil=True)
def size_class(count):
    """Which of the classes a subtree of `count` >= 2 items falls in: two an octave."""
    octave = 0
    while count >> (octave + 1):
        octave += 1
    return 2 * octave + (count >> (octave - 1) & 1)


@njit(cache=True, nogil=True)
def common_size(a, b, parent, size):
    """Items below the lowest node that holds both nodes."""
    while not a <= b < a + 2 * size[a] - 1:
        a = parent[a]
    return size[a]


@njit(cache=True, nogil=True, forceinline=True)
def may_link(faces, h, g, flips):
    """Whether half-edges h and g of one edge may be linked: run in opposite directions, or with a flip."""
    if faces[h // 3, h % 3] != faces[g // 3, g % 3]:
        return True
    return flips and may_flip(faces, h // 3, g // 3)


@njit(cache=True, nogil=True)
def link_range(ring, faces, leaf, parent, size, most, flips, mate, links):
    """Link the faces of a range into paths of at most `most` faces, the nearest in the tree first.

    Args:
        ring: (3n,) int32 rings of half-edges.
        faces: (n, 3) int32.
        leaf: (n,) int32, each face's leaf in the tree.
        parent: The tree's.
        size: The tree's.
        most: The most faces of a path.
        flips: Whether to link through edges that both faces run the same way, too.
        mate: (3n,) int32 to fill.
        links: (n,) uint8 to fill.

    Returns:
        How many half-edges are followed on their ring by one that they must not be linked to, for the winding
        of their faces alone: those that no half-edge is left for, more or less.
    """
    count = faces.shape[0]
    half_edges = 3 * count
    mate[:] = -1
    links[:] = 0
    # Give every pair of half-edges that may be linked the class of its common node.
    first = np.zeros(CLASSES + 1, np.int32)
    pair_class = np.empty(2 * half_edges, np.uint8)
    pairs = 0
    refused = 0
    for h in range(half_edges):
        g = ring[h]
        while g != h:
            if g > h and g // 3 != h // 3:
                if not may_link(faces, h, g, flips):
                    refused += (ring[h] == g) + (ring[g] == h)
                    g = ring[g]
                    continue
                common = common_size(leaf[h // 3], leaf[g // 3], parent, size)
                c = 2 * size_class(common) + (ring[g] != h or ring[h] != g)
                pair_class[pairs] = c
                first[c + 1] += 1
                pairs += 1
            g = ring[g]
    for c in range(CLASSES):
        first[c + 1] += first[c]
    # Sort the pairs by class, those of one class as they were found.
    leave = np.empty(pairs, np.int32)
    enter = np.empty(pairs, np.int32)
    pair = 0
    for h in range(half_edges):
        g = ring[h]
        while g != h:
            if g > h and g // 3 != h // 3 and may_link(faces, h, g, flips):
                at = first[pair_class[pair]]
                first[pair_class[pair]] += 1
                leave[at] = h
                enter[at] = g
                pair += 1
            g = ring[g]
    # Link each pair whose half-edges and faces are free, unless that closes a path or makes it too long.
    far = np.arange(count).astype(np.int32)
    length = np.ones(count, np.int32)
    for pair in range(pairs):
        h = leave[pair]
        g = enter[pair]
        t = h // 3
        u = g // 3
        if links[t] > 1 or links[u] > 1 or mate[h] >= 0 or mate[g] >= 0:
            continue
        if far[t] == u or length[t] + length[u] > most:
            continue
        mate[h] = g
        mate[g] = h
        links[t] += 1
        links[u] += 1
        # Let the two ends of the joined path know each other and its length.
        one = far[t]
        other = far[u]
        total = length[t] + length[u]
        far[one] = other
        far[other] = one
        length[one] = total
        length[other] = total
    return refused
