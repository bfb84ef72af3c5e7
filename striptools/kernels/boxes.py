"""Bounding boxes of faces and of tree nodes, and the half area that the cost model weighs by."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def half_area(lo_x, lo_y, lo_z, hi_x, hi_y, hi_z):
    """Half the surface area in float64: finite float32 boxes cannot overflow it."""
    x = np.float64(hi_x) - np.float64(lo_x)
    y = np.float64(hi_y) - np.float64(lo_y)
    z = np.float64(hi_z) - np.float64(lo_z)
    return x * y + y * z + z * x


@njit(cache=True, nogil=True)
def face_boxes(positions, faces, boxes):
    """Fill boxes (n, 6) with the bounds of each face's three corners."""
    for face in range(faces.shape[0]):
        # Start from the first corner.
        for axis in range(3):
            boxes[face, axis] = positions[faces[face, 0], axis]
            boxes[face, 3 + axis] = positions[faces[face, 0], axis]
        # Grow by the other two.
        for corner in range(1, 3):
            for axis in range(3):
                value = positions[faces[face, corner], axis]
                if value < boxes[face, axis]:
                    boxes[face, axis] = value
                if value > boxes[face, 3 + axis]:
                    boxes[face, 3 + axis] = value


@njit(cache=True, nogil=True)
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
