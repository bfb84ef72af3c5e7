"""Loops over the arrays of a scene: vertices numbered by first use, and the rules that a scene file keeps."""

import numpy as np

from striptools.kernels.compiled import kernel

KEEPS_RULES = 0
OUTSIDE = 1
"""A strip vertex that is no vertex."""
TOO_EARLY = 2
"""A strip vertex that is new and not the next one."""


@kernel
def renumber_by_first_use(vertices, place, numbered, used):
    """Number vertices in the order of their first use.

    Args:
        vertices: (c,) int32 strip vertices.
        place: (v,) int32, all -1; filled with the number of each vertex.
        numbered: (c,) int32 to fill with the numbers of the strip vertices.
        used: (v,) int32 to fill with the vertex of each number.

    Returns:
        How many vertices are used.
    """
    count = 0
    for k in range(vertices.shape[0]):
        vertex = vertices[k]
        if place[vertex] < 0:
            place[vertex] = count
            used[count] = vertex
            count += 1
        numbered[k] = place[vertex]
    return count


@kernel
def gather_rows(rows, chosen, begin, end, out):
    """Copy the rows `chosen[begin:end]` of (v, 3) to their places in out."""
    for k in range(begin, end):
        for axis in range(3):
            out[k, axis] = rows[chosen[k], axis]


@kernel
def gather_items(items, chosen, begin, end, out):
    """Copy the items `chosen[begin:end]` to their places in out."""
    for k in range(begin, end):
        out[k] = items[chosen[k]]


@kernel
def first_vertex_flaw(vertices, vertex_count):
    """A rule that strip vertices break, the first place where they do, and the largest vertex.

    A vertex outside the range goes before one that comes too early, wherever they stand.
    """
    largest = np.int64(-1)
    early = np.int64(-1)
    for k in range(vertices.shape[0]):
        vertex = np.int64(vertices[k])
        if vertex < 0 or vertex >= vertex_count:
            return OUTSIDE, k, largest
        if vertex > largest + 1 and early < 0:
            early = k
        largest = max(largest, vertex)
    return (KEEPS_RULES if early < 0 else TOO_EARLY), early, largest


@kernel
def first_row_not_finite(rows, begin, end):
    """The first of the rows `begin:end` of (n, 3) with an entry that is not finite, or -1."""
    for k in range(begin, end):
        if not (np.isfinite(rows[k, 0]) and np.isfinite(rows[k, 1]) and np.isfinite(rows[k, 2])):
            return k
    return -1


@kernel
def first_repeated_corner(faces, begin, end):
    """The first of the faces `begin:end` with two corners that are one vertex, or -1."""
    for k in range(begin, end):
        a, b, c = faces[k, 0], faces[k, 1], faces[k, 2]
        if a == b or b == c or c == a:
            return k
    return -1


@kernel
def strip_boxes(positions, vertices, starts, first, last, boxes):
    """Fill boxes (s, 6) with the bounds of the vertices of the strips `first:last`."""
    for strip in range(first, last):
        begin = starts[strip] + 2 * strip
        vertex = vertices[begin]
        lo_x = hi_x = positions[vertex, 0]
        lo_y = hi_y = positions[vertex, 1]
        lo_z = hi_z = positions[vertex, 2]
        for k in range(begin + 1, starts[strip + 1] + 2 * strip + 2):
            vertex = vertices[k]
            lo_x, hi_x = min(lo_x, positions[vertex, 0]), max(hi_x, positions[vertex, 0])
            lo_y, hi_y = min(lo_y, positions[vertex, 1]), max(hi_y, positions[vertex, 1])
            lo_z, hi_z = min(lo_z, positions[vertex, 2]), max(hi_z, positions[vertex, 2])
        boxes[strip, 0], boxes[strip, 3] = lo_x, hi_x
        boxes[strip, 1], boxes[strip, 4] = lo_y, hi_y
        boxes[strip, 2], boxes[strip, 5] = lo_z, hi_z


@kernel
def has_repeat(items, seen):
    """Whether an item stands twice; every item is a place in seen, all False."""
    for k in range(items.shape[0]):
        if seen[items[k]]:
            return True
        seen[items[k]] = True
    return False
