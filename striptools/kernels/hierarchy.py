"""Kernels of the binary hierarchies: topology from counts, boxes from below.

All trees lie in preorder. A tree of one triangle a leaf, over k triangles at node p, occupies nodes p ..
p+2k-2; its left child is p+1 and its right child p+2*size[p+1]. A tree of inner nodes alone, over k strips at
p, occupies p .. p+k-2; left[p] strips go left, to p+1, the others right, to p+left[p]; a child of one strip
is no node.
"""

import numpy as np

from striptools.kernels.compiled import kernel


@kernel
def strip_ranges(left_count, strip_count):
    """Give each inner node its first strip and its number of strips, or name the first node that cannot be.

    Args:
        left_count: (s-1,) uint32.
        strip_count: s >= 1.

    Returns:
        first (s-1,) int32, count (s-1,) int32, and the first node with an empty child, -1 where there is
        none; the arrays mean nothing from such a node on.
    """
    nodes = strip_count - 1
    first = np.zeros(nodes, np.int32)
    count = np.zeros(nodes, np.int32)
    waiting_first = np.empty(nodes + 1, np.int32)
    waiting_count = np.empty(nodes + 1, np.int32)
    waiting_first[0] = 0
    waiting_count[0] = strip_count
    waiting = 1 if nodes > 0 else 0
    for node in range(nodes):
        # Take the subtree that preorder puts here.
        waiting -= 1
        here, total = waiting_first[waiting], waiting_count[waiting]
        first[node], count[node] = here, total

        # Refuse an empty child.
        left = np.int64(left_count[node])
        if left < 1 or left >= total:
            return first, count, node

        # Let the right child wait below the left one; a single strip is a leaf and has no node.
        if total - left > 1:
            waiting_first[waiting], waiting_count[waiting] = here + left, total - left
            waiting += 1
        if left > 1:
            waiting_first[waiting], waiting_count[waiting] = here, left
            waiting += 1
    return first, count, -1


@kernel
def expanded_sizes(left_count, first, count, starts):
    """Lay out one tree over all triangles: the hierarchy over strips, then balanced halves in each strip.

    Args:
        left_count: (s-1,) uint32, a hierarchy that `strip_ranges` has found whole.
        first: (s-1,) int32 of `strip_ranges`.
        count: (s-1,) int32 of `strip_ranges`.
        starts: (s+1,) int32, the first triangle of each strip, then the number of triangles.

    Returns:
        size (2n-1,) int32, the triangles below each node, and place (s-1,) int32, the node of the new tree at
        which each node of the hierarchy stands.
    """
    strips = len(starts) - 1
    nodes = strips - 1
    size = np.zeros(2 * starts[strips] - 1, np.int32)
    place = np.zeros(nodes, np.int32)
    strip_place = np.zeros(strips, np.int64)

    # Place the children of each inner node behind it; preorder has placed the node itself before.
    for node in range(nodes):
        at = np.int64(place[node])
        left = np.int64(left_count[node])
        begin = first[node]
        middle = begin + left
        end = begin + count[node]
        size[at] = starts[end] - starts[begin]
        right_at = at + 2 * np.int64(starts[middle] - starts[begin])
        if left > 1:
            place[node + 1] = at + 1
        else:
            strip_place[begin] = at + 1
        if end - middle > 1:
            place[node + left] = right_at
        else:
            strip_place[middle] = right_at

    # Halve each strip down to single triangles: a node's halves are found from its own size, in preorder.
    for strip in range(strips):
        at = strip_place[strip]
        triangles = starts[strip + 1] - starts[strip]
        size[at] = triangles
        for node in range(at, at + 2 * triangles - 1):
            if size[node] > 1:
                left_half = (size[node] + 1) // 2
                size[node + 1] = left_half
                size[node + 2 * left_half] = size[node] - left_half
    return size, place


@kernel
def boxes_from_below(size, leaf_boxes):
    """Box every node of a preorder tree over one item a leaf, children before parents.

    Args:
        size: (2n-1,) int32, the items below each node.
        leaf_boxes: (n, 6) float32, in the order of the leaves.

    Returns:
        (2n-1, 6) float32.
    """
    nodes = len(size)
    boxes = np.empty((nodes, 6), np.float32)
    leaf = len(leaf_boxes)
    for node in range(nodes - 1, -1, -1):
        # Copy a leaf's box; the leaves come by from the last to the first.
        if size[node] == 1:
            leaf -= 1
            for k in range(6):
                boxes[node, k] = leaf_boxes[leaf, k]
            continue

        # Join the two children, which lie behind the node.
        left = node + 1
        right = node + 2 * size[left]
        for k in range(3):
            low, other_low = boxes[left, k], boxes[right, k]
            high, other_high = boxes[left, k + 3], boxes[right, k + 3]
            boxes[node, k] = low if low <= other_low else other_low
            boxes[node, k + 3] = high if high >= other_high else other_high
    return boxes
