"""Cut an object tree into ranges of leaves: the loop behind partition/cut.py."""

import numpy as np

from striptools.kernels.compiled import helper, kernel


@helper
def meets_few(faces, order, begin, end, seen, stamp, most):
    """Whether the faces order[begin:end] have at most `most` different vertices; marks them with `stamp`."""
    count = 0
    for position in range(begin, end):
        for corner in range(3):
            vertex = faces[order[position], corner]
            if seen[vertex] != stamp:
                seen[vertex] = stamp
                count += 1
        if count > most:
            return False
    return True


@kernel
def cut_ranges(size, order, faces, seen, most_items, most_vertices, starts):
    """Write the first positions of the largest subtrees within both limits; returns how many there are.

    A single item always passes. `seen` has an entry a vertex, none of them a node's number; without entries
    only items count.
    """
    count = 0
    # Their type from the start: for a bare 0 Numba would compile meets_few once more.
    node = np.int64(0)
    begin = np.int64(0)
    while begin < order.shape[0]:
        items = size[node]
        fits = items == 1
        if not fits and items <= most_items:
            fits = seen.shape[0] == 0 or meets_few(
                faces, order, begin, begin + items, seen, node, most_vertices
            )  # fmt: skip
        # Take the whole subtree and step behind it, or look at its left child.
        if fits:
            starts[count] = begin
            count += 1
            begin += items
            node += 2 * items - 1
        else:
            node += 1
    return count


@kernel
def group_strips(size, order, starts, faces, seen, most_triangles, most_vertices, firsts):
    """Write the first places of the largest subtrees over strips within both limits; returns how many.

    Args:
        size: (2s-1,) int32, the strips below each node of a preorder tree.
        order: (s,) int32, the strip at each leaf.
        starts: (s+1,) int32, the first of each strip's faces.
        faces: (n, 3) int32, in the order of the strips.
        seen: (v,) int32, -1.
        most_triangles: The most faces of a group; no strip has more.
        most_vertices: The most different vertices of a group; no strip has more.
        firsts: (s+1,) int32 to fill with places in `order`.
    """
    count = 0
    node = 0
    begin = 0
    while begin < order.shape[0]:
        # Count the faces and the vertices of the subtree until they are too many.
        items = size[node]
        triangles = 0
        vertices = 0
        for place in range(begin, begin + items if items > 1 else begin):
            strip = order[place]
            triangles += starts[strip + 1] - starts[strip]
            if triangles > most_triangles or vertices > most_vertices:
                break
            for k in range(starts[strip], starts[strip + 1]):
                for corner in range(3):
                    if seen[faces[k, corner]] != node:
                        seen[faces[k, corner]] = node
                        vertices += 1
        # Take the whole subtree and step behind it, or look at its left child.
        if triangles <= most_triangles and vertices <= most_vertices:
            firsts[count] = begin
            count += 1
            begin += items
            node += 2 * items - 1
        else:
            node += 1
    return count
