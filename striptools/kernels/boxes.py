"""Bounding boxes of faces and of tree nodes, and the half area that the cost model weighs by."""

import numpy as np
from numba import njit

from striptools.kernels.compiled import kernel


@njit(cache=True, nogil=True, forceinline=True)
def half_area(lo_x, lo_y, lo_z, hi_x, hi_y, hi_z):
    """Half the surface area in float64: finite float32 boxes cannot overflow it."""
    x = np.float64(hi_x) - np.float64(lo_x)
    y = np.float64(hi_y) - np.float64(lo_y)
    z = np.float64(hi_z) - np.float64(lo_z)
    return x * y + y * z + z * x


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


@kernel
def node_boxes(order, size, item_boxes, boxes):
    """Fill boxes (2n-1, 6) of a preorder tree from the boxes of its items."""
    # Walk backwards, so that children come before their parents and leaves in falling position.
    position = order.shape[0]
    for node in range(size.shape[0] - 1, -1, -1):
        # Copy the item's box into a leaf.
        if size[node] == 1:
            position -= 1
            for k in range(6):
                boxes[node, k] = item_boxes[order[position], k]
            continue
        # Join the boxes of the two children.
        left = node + 1
        right = node + 2 * size[left]
        for axis in range(3):
            boxes[node, axis] = min(boxes[left, axis], boxes[right, axis])
            boxes[node, 3 + axis] = max(boxes[left, 3 + axis], boxes[right, 3 + axis])
