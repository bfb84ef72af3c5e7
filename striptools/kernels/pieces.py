"""Boxes around parts of triangles: the loops behind hierarchies/pieces.py."""

import numpy as np

from striptools.kernels.boxes import half_area
from striptools.kernels.compiled import helper, inlined, kernel

CELLS = 2.0**20
"""Cells of the scene along each axis, in whose faces triangles are cut."""

CORNERS = 80
"""Most corners of a part: three, and one for each of the 60 planes that may cut it."""

ROUNDING = 2.0**-40
"""What corners of a part are off by at most, over the largest coordinate: 60 cuts, each of a few 2**-53."""


@kernel
def spare_areas(positions, faces, begin, end, spare):
    """Fill in, of the faces `begin:end`, what half the area of their box has to spare.

    A triangle cut into ever smaller parts is held by boxes of as much half area as the sum of its three
    projections along the axes.
    """
    low = np.empty(3)
    high = np.empty(3)
    one = np.empty(3)
    two = np.empty(3)
    for face in range(begin, end):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        for k in range(3):
            x, y, z = np.float64(positions[a, k]), np.float64(positions[b, k]), np.float64(positions[c, k])
            low[k] = min(x, y, z)
            high[k] = max(x, y, z)
            one[k] = y - x
            two[k] = z - x
        least = 0.5 * (
            abs(one[1] * two[2] - one[2] * two[1])
            + abs(one[2] * two[0] - one[0] * two[2])
            + abs(one[0] * two[1] - one[1] * two[0])
        )
        spare[face] = max(0.0, half_area(low[0], low[1], low[2], high[0], high[1], high[2]) - least)


@inlined
def cell(value, low, extent):
    """The cell that a coordinate is in."""
    place = (value - low) / extent * CELLS
    return np.int64(min(max(place, 0.0), CELLS - 1.0))


@inlined
def bound(part, corners, box):
    """Fill in the box, (6,), of a part of a triangle."""
    for k in range(3):
        box[k] = part[0, k]
        box[3 + k] = part[0, k]
    for i in range(1, corners):
        for k in range(3):
            box[k] = min(box[k], part[i, k])
            box[3 + k] = max(box[3 + k], part[i, k])


@helper
def chosen_plane(box, low, extent):
    """The axis and place of the plane that cuts a box, -1 for none.

    It is a face of the largest cells of the octree over the scene that the box is not within; of axes that
    have one of those, the one along which the box is longest.
    """
    most = np.int64(0)
    axis = -1
    place = 0.0
    for k in range(3):
        # Find the highest bit in which the cells of both sides differ.
        last = cell(box[3 + k], low[k], extent)
        differ = cell(box[k], low[k], extent) ^ last
        step = np.int64(1)
        while 2 * step <= differ:
            step *= 2
        if differ == 0 or step < most:
            continue
        # Prefer the longest axis of those that differ in it.
        at = low[k] + (last // step * step) / CELLS * extent
        longer = axis < 0 or step > most or box[3 + k] - box[k] > box[3 + axis] - box[axis]
        if box[k] < at < box[3 + k] and longer:
            most = step
            axis = k
            place = at
    return axis, place


@helper
def keep_side(part, corners, axis, place, low_side, kept):
    """Write what of a convex part lies on one side of a plane; return its corners."""
    found = 0
    for i in range(corners):
        j = i + 1 if i + 1 < corners else 0
        here = part[i, axis] - place
        there = part[j, axis] - place
        inside = here <= 0.0 if low_side else here >= 0.0
        if inside:
            for k in range(3):
                kept[found, k] = part[i, k]
            found += 1
        # Cut the edge where it crosses; both sides get the same corner.
        if (here < 0.0 < there) or (there < 0.0 < here):
            share = here / (here - there)
            for k in range(3):
                kept[found, k] = part[i, k] + share * (part[j, k] - part[i, k])
            kept[found, axis] = place
            found += 1
    return found


@inlined
def longest_side(box):
    """The longest side of a box."""
    return max(box[3] - box[0], box[4] - box[1], box[5] - box[2])


@kernel
def piece_boxes(positions, faces, cuts, low, extent, boxes, triangle):
    """Cut triangles, and box the parts.

    Args:
        positions: (v, 3) float32.
        faces: (n, 3) int32.
        cuts: (n,) int64, how often each may be cut.
        low: (3,) float64, the least corner of the scene.
        extent: Its longest side, positive.
        boxes: (>= n + sum of cuts, 6) float32, written: a triangle's own box where it is not cut; boxes of
            parts hold them, and lie within the triangle's.
        triangle: As long, int32, written: whose part each is, rising.

    Returns:
        How many parts there are.
    """
    room = cuts.max() + 2
    waiting = np.empty((room, CORNERS, 3))
    corners = np.empty(room, np.int64)
    left = np.empty(room, np.int64)
    below = np.empty((CORNERS, 3))
    above = np.empty((CORNERS, 3))
    whole = np.empty(6)
    box = np.empty(6)
    side = np.empty(6)
    parts = 0
    for face in range(len(faces)):
        for j in range(3):
            for k in range(3):
                waiting[0, j, k] = positions[faces[face, j], k]
        bound(waiting[0], 3, whole)
        slack = 0.0
        for k in range(6):
            slack = max(slack, abs(whole[k]) * ROUNDING)
        corners[0] = 3
        left[0] = cuts[face]
        held = 1
        while held > 0:
            held -= 1
            part = waiting[held]
            bound(part, corners[held], box)
            axis = -1
            place = 0.0
            if left[held] > 0 and corners[held] < CORNERS - 1:
                axis, place = chosen_plane(box, low, extent)

            # Write the box of a part that stays whole, rounded outwards.
            if axis < 0:
                for k in range(3):
                    least = max(box[k] - slack, whole[k])
                    most = min(box[3 + k] + slack, whole[3 + k])
                    near, far = np.float32(least), np.float32(most)
                    boxes[parts, k] = np.nextafter(near, np.float32(-np.inf)) if near > least else near
                    boxes[parts, 3 + k] = np.nextafter(far, np.float32(np.inf)) if far < most else far
                triangle[parts] = face
                parts += 1
                continue

            # Cut it, and share what is left of its cuts out by the length of both sides.
            count_below = keep_side(part, corners[held], axis, place, True, below)
            count_above = keep_side(part, corners[held], axis, place, False, above)
            bound(below, count_below, box)
            bound(above, count_above, side)
            share = longest_side(box) / (longest_side(box) + longest_side(side))
            rest = left[held] - 1
            left[held] = np.int64(rest * share + 0.5)
            left[held + 1] = rest - left[held]
            corners[held] = count_below
            corners[held + 1] = count_above
            for i in range(count_below):
                for k in range(3):
                    waiting[held, i, k] = below[i, k]
            for i in range(count_above):
                for k in range(3):
                    waiting[held + 1, i, k] = above[i, k]
            held += 2
    return parts
