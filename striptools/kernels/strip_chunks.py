"""From ranges of the object tree's order to strips, range by range: the loops behind strips/stripify.py.

A thread works on whole ranges alone: it gathers a range's faces and boxes, finds neighbours inside it, links,
tunnels, and writes the faces in strip order to the range's own slice of the output.
"""

from math import frexp, ldexp

import numpy as np
from numba import njit

from striptools.kernels.adjacency import ring_half_edges
from striptools.kernels.strip_linking import link_range
from striptools.kernels.strip_ordering import walk_links
from striptools.kernels.strip_tunnels import (
    LONGEST,
    Ground,
    Strips,
    box_area,
    mirrors,
    row_cost,
    search_range,
)


@njit(cache=True, nogil=True)
def gather_faces(faces, order, begin, end, number, gathered):
    """Copy the faces order[begin:end] with their vertices numbered by first use; returns how many there are.

    `number` has -1 for every vertex, before and after.
    """
    count = 0
    for i in range(end - begin):
        for corner in range(3):
            vertex = faces[order[begin + i], corner]
            if number[vertex] < 0:
                number[vertex] = count
                count += 1
            gathered[i, corner] = number[vertex]
    # Forget the numbers.
    for i in range(end - begin):
        for corner in range(3):
            number[faces[order[begin + i], corner]] = -1
    return count


@njit(cache=True, nogil=True)
def gather_boxes(boxes, order, begin, end, gathered):
    """Copy the boxes of order[begin:end] in the form of strip_tunnels; returns the sum of their areas."""
    # Find the power of two that brings every coordinate below 1.
    largest = 0.0
    for position in range(begin, end):
        for k in range(6):
            largest = max(largest, abs(np.float64(boxes[order[position], k])))
    scale = ldexp(1.0, -frexp(largest)[1])
    # Write each box as minus the low corner, then the high corner.
    total = 0.0
    for i in range(end - begin):
        face = order[begin + i]
        for k in range(3):
            gathered[i, k] = -boxes[face, k] * scale
            gathered[i, 3 + k] = boxes[face, 3 + k] * scale
        total += box_area(gathered, i)
    return total


@njit(cache=True, nogil=True)
def tunnel_range(ring, faces, boxes, mate, links, leaves, most, effort, flips, order, starts):
    """Improve linked faces by tunnels and write them in strip order; returns strips, cost before and after.

    Args:
        ring: (3n,) int32.
        faces: (n, 3) int32.
        boxes: (n, 6) float32 in the form of strip_tunnels.
        mate: (3n,) int32 links, changed in place.
        links: (n,) uint8 of each face.
        leaves: The sum of the boxes' half areas.
        most: The most faces of a strip.
        effort: rotations, neutral rotations, price, rise, passes.
        flips: Whether strips may cross edges that both faces run the same way.
        order: (n,) int32 to fill with faces.
        starts: (n + 1,) int32 to fill with the first place of each strip.
    """
    count = faces.shape[0]
    deepest, neutral, price, rise, passes = effort
    rows = np.empty(2 * count + 2 * (2 * deepest + 4) * LONGEST, np.int32)
    strip_count = walk_links(mate, links, rows, starts)
    strips = Strips(
        rows,
        starts[:strip_count].copy(),
        starts[1 : strip_count + 1] - starts[:strip_count],
        np.empty(strip_count, np.float64),
        np.empty(strip_count, np.float64),
        np.empty(strip_count, np.int32),
        np.empty((count, 2), np.int32),
        mate,
    )
    for s in range(strip_count):
        for place in range(strips.length[s]):
            strips.where[rows[strips.begin[s] + place], 0] = s
            strips.where[rows[strips.begin[s] + place], 1] = place
    ground = Ground(ring, faces, boxes, mirrors(), np.empty((LONGEST, 6), np.float32), flips)
    before, after = search_range(strips, ground, most, deepest, neutral, price, rise, passes, leaves)
    # Write the strips by the place of their first faces, each turned the cheaper way.
    k = 0
    written = 0
    turned = np.empty(LONGEST, np.int32)
    for face in range(count):
        if strips.where[face, 1] > 0:
            continue
        s = strips.where[face, 0]
        begin = strips.begin[s]
        length = strips.length[s]
        starts[written] = k
        written += 1
        for place in range(length):
            order[k + place] = rows[begin + place]
        if length <= LONGEST:
            for place in range(length):
                turned[place] = rows[begin + length - 1 - place]
            other = row_cost(turned, 0, length, boxes, ground.mirror, ground.room)
            if other < strips.kept[s]:
                order[k : k + length] = turned[:length]
                after += other - strips.kept[s]
        k += length
    starts[written] = k
    return written, before, after


@njit(cache=True, nogil=True)
def order_ranges(
    faces,
    boxes,
    order,
    leaf_node,
    parent,
    size,
    starts,
    first,
    last,
    most,
    effort,
    flips,
    number,
    placed,
    is_first,
):
    """Order the faces of the ranges first:last of a cut into strips.

    Args:
        faces: (n, 3) int32.
        boxes: (n, 6) float32.
        order: (n,) int32, the face at each place of the tree.
        leaf_node: The tree's.
        parent: The tree's.
        size: The tree's.
        starts: (k+1,) int32, the cut.
        first: The first range to do.
        last: The first range not to do.
        most: The most faces of a strip.
        effort: rotations (negative: link only), neutral rotations, price, rise, passes.
        flips: Whether strips may cross edges that both faces run the same way.
        number: (v,) int32, -1 everywhere before and after: this thread's own.
        placed: (n,) int32 to fill with the faces in strip order, in these ranges.
        is_first: (n,) bool to fill with whether a strip starts there, in these ranges.

    Returns:
        The cost of all ranges after linking and at the end, and the half-edges that `link_range` refused.
    """
    before = 0.0
    after = 0.0
    refused = 0
    for k in range(first, last):
        begin = starts[k]
        end = starts[k + 1]
        count = end - begin
        # Gather the range and find the neighbours in it.
        here = np.empty((count, 3), np.int32)
        vertices = gather_faces(faces, order, begin, end, number, here)
        ring = ring_half_edges(here, vertices)
        leaf = np.empty(count, np.int32)
        for i in range(count):
            leaf[i] = leaf_node[order[begin + i]]
        # Link, then tunnel.
        mate = np.empty(3 * count, np.int32)
        links = np.empty(count, np.uint8)
        refused += link_range(ring, here, leaf, parent, size, most, flips, mate, links)
        row = np.empty(count, np.int32)
        first_places = np.empty(count + 1, np.int32)
        if effort[0] < 0:
            strips = walk_links(mate, links, row, first_places)
        else:
            scaled = np.empty((count, 6), np.float32)
            leaves = gather_boxes(boxes, order, begin, end, scaled)
            strips, was, became = tunnel_range(
                ring, here, scaled, mate, links, leaves, most, effort, flips, row, first_places
            )
            before += was
            after += became
        # Write the faces and where strips start.
        for i in range(count):
            placed[begin + i] = order[begin + row[i]]
            is_first[begin + i] = False
        for s in range(strips):
            is_first[begin + first_places[s]] = True
    return before, after, refused
