"""Bounding boxes of faces and of ranges of items, and the half area that the cost model weighs by."""

import numpy as np

from striptools.kernels.compiled import inlined, kernel


@inlined
def half_area(lo_x, lo_y, lo_z, hi_x, hi_y, hi_z):
    """Half the surface area in float64: finite float32 boxes cannot overflow it."""
    x = np.float64(hi_x) - np.float64(lo_x)
    y = np.float64(hi_y) - np.float64(lo_y)
    z = np.float64(hi_z) - np.float64(lo_z)
    return x * y + y * z + z * x


@inlined
def area_of(boxes, p):
    """Half the surface area of one of (n, 6) boxes."""
    return half_area(boxes[p, 0], boxes[p, 1], boxes[p, 2], boxes[p, 3], boxes[p, 4], boxes[p, 5])


@kernel
def face_boxes(positions, faces, begin, end, boxes):
    """Fill boxes (n, 6) with the bounds of the three corners of the faces `begin:end`."""
    for face in range(begin, end):
        a, b, c = faces[face, 0], faces[face, 1], faces[face, 2]
        for axis in range(3):
            one, two, three = positions[a, axis], positions[b, axis], positions[c, axis]
            boxes[face, axis] = min(min(one, two), three)
            boxes[face, 3 + axis] = max(max(one, two), three)


@kernel
def range_boxes(boxes, items, starts, out):
    """Fill out (s, 6) with the box around each range `items[starts[i] : starts[i + 1]]`, none empty."""
    for part in range(starts.shape[0] - 1):
        # Start from the first box and grow by the others.
        for k in range(6):
            out[part, k] = boxes[items[starts[part]], k]
        for place in range(starts[part] + 1, starts[part + 1]):
            item = items[place]
            for axis in range(3):
                out[part, axis] = min(out[part, axis], boxes[item, axis])
                out[part, 3 + axis] = max(out[part, 3 + axis], boxes[item, 3 + axis])
