"""Closest points on triangles by branch and bound through an implicit binary tree of boxes, in float64.

The tree has the boxes of node i's children at 2i and 2i + 1, the root at 1; its leaves are runs of `LEAF`
consecutive triangles, the last ones empty.
"""

import numpy as np

from striptools.kernels.compiled import helper, kernel

LEAF = 4
"""Triangles of a leaf."""

DEEPEST = 64
"""Nodes that may wait: more than a tree over 2**31 triangles has levels, two for each."""


@helper
def square_to_triangle(x, y, z, corners, item):
    """The square of the distance to a triangle (Ericson, "Real-Time Collision Detection", section 5.1.5)."""
    ax, ay, az = corners[item, 0, 0], corners[item, 0, 1], corners[item, 0, 2]
    ux, uy, uz = corners[item, 1, 0] - ax, corners[item, 1, 1] - ay, corners[item, 1, 2] - az
    vx, vy, vz = corners[item, 2, 0] - ax, corners[item, 2, 1] - ay, corners[item, 2, 2] - az
    px, py, pz = x - ax, y - ay, z - az

    # Find the region of the plane that the foot is in by the signs of edge functions.
    d1, d2 = ux * px + uy * py + uz * pz, vx * px + vy * py + vz * pz
    uu, uv, vv = ux * ux + uy * uy + uz * uz, ux * vx + uy * vy + uz * vz, vx * vx + vy * vy + vz * vz
    d3, d4 = d1 - uu, d2 - uv
    d5, d6 = d1 - uv, d2 - vv
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        s, t = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        s, t = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        s, t = 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        s, t = d1 / (d1 - d3), 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        s, t = 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        t = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        s = 1.0 - t
    else:
        s, t = vb / (va + vb + vc), vc / (va + vb + vc)

    # Whatever rounding made of the foot, it is a point of the triangle.
    s = min(max(s, 0.0), 1.0)
    t = min(max(t, 0.0), 1.0 - s)
    fx, fy, fz = px - s * ux - t * vx, py - s * uy - t * vy, pz - s * uz - t * vz
    return fx * fx + fy * fy + fz * fz


@helper
def square_to_box(x, y, z, boxes, node):
    """The square of the distance to a box; infinite for an empty one."""
    dx = max(max(boxes[node, 0] - x, x - boxes[node, 3]), 0.0)
    dy = max(max(boxes[node, 1] - y, y - boxes[node, 4]), 0.0)
    dz = max(max(boxes[node, 2] - z, z - boxes[node, 5]), 0.0)
    return dx * dx + dy * dy + dz * dz


@kernel
def closest_triangles(points, corners, boxes, begin, end, square, item):
    """Fill the square of the distance to the closest triangle, and which it is, for points `begin:end`.

    Args:
        points: (q, 3) float64.
        corners: (n, 3, 3) float64, in the order of the tree.
        boxes: (2p, 6) float64, p a power of two.
        begin: The first point.
        end: Behind the last.
        square: (q,) float64, filled.
        item: (q,) int32, filled.
    """
    leaves = boxes.shape[0] // 2
    stack = np.empty(DEEPEST, np.int64)
    for point in range(begin, end):
        x, y, z = points[point, 0], points[point, 1], points[point, 2]
        best, found = np.inf, np.int32(0)
        stack[0] = 1
        height = 1
        while height > 0:
            height -= 1
            node = stack[height]
            if square_to_box(x, y, z, boxes, node) >= best:
                continue

            # Try the triangles of a leaf.
            if node >= leaves:
                first = (node - leaves) * LEAF
                for triangle in range(first, min(first + LEAF, corners.shape[0])):
                    away = square_to_triangle(x, y, z, corners, triangle)
                    if away < best:
                        best, found = away, np.int32(triangle)
                continue

            # Put the nearer child on top.
            one, two = 2 * node, 2 * node + 1
            if square_to_box(x, y, z, boxes, one) < square_to_box(x, y, z, boxes, two):
                one, two = two, one
            stack[height], stack[height + 1] = one, two
            height += 2
        square[point] = best
        item[point] = found


@kernel
def farthest_corner(pieces, corners, items, begin, end, square):
    """Fill the least, over some triangles, of the largest square distance of a piece's corners to it.

    Args:
        pieces: (k, 3, 3) float64, triangles.
        corners: (n, 3, 3) float64.
        items: (k, j) int32, the triangles to try for each piece.
        begin: The first piece.
        end: Behind the last.
        square: (k,) float64, filled.
    """
    for piece in range(begin, end):
        least = np.inf
        for k in range(items.shape[1]):
            most = 0.0
            for corner in range(3):
                x, y, z = pieces[piece, corner, 0], pieces[piece, corner, 1], pieces[piece, corner, 2]
                most = max(most, square_to_triangle(x, y, z, corners, items[piece, k]))
            least = min(least, most)
        square[piece] = least
