"""The implicit balanced hierarchy inside a strip, and the one tree over all triangles that it completes.

Source: Lauterbach et al., EGSR 2008, section 3: a strip stands for a hierarchy without storing it, because
its triangles are ordered and the tree over them is balanced. Differences: axis-aligned boxes from the decoded
vertices, made once when a scene is opened, where the original re-derives s-kd planes per ray.

A node over k > 1 consecutive triangles halves them into ceil(k/2) and floor(k/2). The first half is the
larger one because then the left child's size is (k+1) >> 1 and the place of every node follows from its range
alone.

Cost: O(n) time, 56 bytes a triangle for the tree.
"""

from dataclasses import dataclass

from striptools.errors import UsageError
from striptools.hierarchies.strip_bvh import StripHierarchy
from striptools.kernels.hierarchy import boxes_from_below, expanded_sizes, strip_ranges
from striptools.types import Boxes, Counts

__all__ = ["BinaryTree", "expand_hierarchy"]


@dataclass(frozen=True, eq=False)
class BinaryTree:
    """A binary tree over n triangles in file order, one a leaf, in preorder: the layout of `ObjectTree`.

    The left child of an inner node p is p+1, its right child p + 2*size[p+1]; leaf k in preorder is triangle
    k, so every node covers a range of consecutive triangles.

    Attributes:
        boxes: (2n-1, 6) float32.
        size: (2n-1,) int32, the triangles below each node; 1 at a leaf.
    """

    boxes: Boxes
    size: Counts

    @property
    def triangle_count(self) -> int:
        """The number of leaves."""
        return (len(self.size) + 1) // 2


def expand_hierarchy(hierarchy: StripHierarchy, starts: Counts, triangle_boxes: Boxes) -> BinaryTree:
    """Join the hierarchy over strips and the implicit ones inside them into one tree over all triangles.

    Args:
        hierarchy: Over the s strips, in file order.
        starts: (s+1,) int32, the first triangle of each strip, then n.
        triangle_boxes: (n, 6) float32 boxes of the decoded triangles, in file order.

    Returns:
        The tree. Nodes over two strips and more have the hierarchy's own boxes; those of a strip and below
        are exact, from `triangle_boxes`.

    Raises:
        UsageError: The hierarchy does not reach each strip once, or is over another number of strips.
    """
    strips = len(starts) - 1
    if strips < 1 or hierarchy.strip_count != strips:
        raise UsageError(f"a hierarchy over {hierarchy.strip_count} strips does not fit {strips} strips")
    first, count, broken = strip_ranges(hierarchy.left_count, strips)
    if broken >= 0:
        raise UsageError("the hierarchy over strips has a node with an empty child", where=f"node {broken}")
    size, place = expanded_sizes(hierarchy.left_count, first, count, starts)
    boxes = boxes_from_below(size, triangle_boxes)
    boxes[place] = hierarchy.boxes
    return BinaryTree(boxes, size)
