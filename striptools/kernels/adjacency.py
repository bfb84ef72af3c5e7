"""Half-edge rings by two counting sorts: linear whatever the mesh, fans of 100,000 faces included."""

import numpy as np

from striptools.kernels.compiled import helper, kernel, maker

LONGEST_RING = 4
"""Half-edges on a ring; the last ring of an edge may have one more, so that none is left alone."""


@maker
def sort_half_edges(faces, vertex_count, order, scratch):
    """Fill `order` with the half-edges sorted by (smaller vertex, larger vertex, half-edge)."""
    half_edges = 3 * faces.shape[0]

    # Count the half-edges by larger vertex, and turn the counts into first places.
    place = np.zeros(vertex_count + 1, np.int32)
    for face in range(faces.shape[0]):
        for slot in range(3):
            place[max(faces[face, slot], faces[face, (slot + 1) % 3]) + 1] += 1
    for vertex in range(vertex_count):
        place[vertex + 1] += place[vertex]

    # Put every half-edge in its place by larger vertex.
    for half in range(half_edges):
        face = half // 3
        slot = half - 3 * face
        high = max(faces[face, slot], faces[face, (slot + 1) % 3])
        scratch[place[high]] = half
        place[high] += 1

    # Sort that list by smaller vertex, keeping the order of equals.
    place[:] = 0
    for face in range(faces.shape[0]):
        for slot in range(3):
            place[min(faces[face, slot], faces[face, (slot + 1) % 3]) + 1] += 1
    for vertex in range(vertex_count):
        place[vertex + 1] += place[vertex]
    for k in range(half_edges):
        half = scratch[k]
        face = half // 3
        slot = half - 3 * face
        low = min(faces[face, slot], faces[face, (slot + 1) % 3])
        order[place[low]] = half
        place[low] += 1


@helper
def interleave_windings(faces, order, begin, end, row):
    """Write the half-edges `order[begin:end]` of one edge to `row`, forward and backward in turn."""
    forward = begin
    backward = begin
    count = 0
    while count < end - begin:
        # Take the next half-edge that runs from the smaller to the larger vertex.
        while forward < end:
            half = order[forward]
            forward += 1
            if faces[half // 3, half % 3] < faces[half // 3, (half + 1 - 3 * (half // 3)) % 3]:
                row[count] = half
                count += 1
                break

        # Take the next one that runs the other way.
        while backward < end:
            half = order[backward]
            backward += 1
            if faces[half // 3, half % 3] > faces[half // 3, (half + 1 - 3 * (half // 3)) % 3]:
                row[count] = half
                count += 1
                break


@helper
def close_rings(row, count, ring):
    """Cut `row[:count]` into rings of at most `LONGEST_RING` (the last takes in a lone rest), closed."""
    begin = 0
    while begin < count:
        end = min(begin + LONGEST_RING, count)
        if count - end == 1:
            end = count
        for k in range(begin, end - 1):
            ring[row[k]] = row[k + 1]
        ring[row[end - 1]] = row[begin]
        begin = end


@kernel
def ring_half_edges(faces, vertex_count):
    """Next half-edge of the same undirected edge for each half-edge, `(3n,)` int32; itself on a border."""
    half_edges = 3 * faces.shape[0]
    ring = np.empty(half_edges, np.int32)
    order = np.empty(half_edges, np.int32)
    # The ring array serves as scratch until the sort is done.
    sort_half_edges(faces, vertex_count, order, ring)
    for half in range(half_edges):
        ring[half] = half
    row = np.empty(64, np.int32)

    # Walk the runs of half-edges of one undirected edge.
    begin = np.int64(0)
    while begin < half_edges:
        face = order[begin] // 3
        slot = order[begin] - 3 * face
        a = faces[face, slot]
        b = faces[face, (slot + 1) % 3]
        end = begin + 1
        while end < half_edges:
            face = order[end] // 3
            slot = order[end] - 3 * face
            c = faces[face, slot]
            d = faces[face, (slot + 1) % 3]
            if not ((a == c and b == d) or (a == d and b == c)):
                break
            end += 1

        # Leave borders and edges from a vertex to itself alone; close the rings of the others.
        count = end - begin
        if count > 1 and a != b:
            if count > row.shape[0]:
                row = np.empty(2 * count, np.int32)
            interleave_windings(faces, order, begin, end, row)
            close_rings(row, count, ring)
        begin = end
    return ring
