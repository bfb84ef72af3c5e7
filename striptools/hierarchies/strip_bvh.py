"""The SAH hierarchy over strips: what a scene file stores above the implicit hierarchies inside the strips.

Source: Lauterbach, Yoon, Tang, Manocha, "ReduceM: Interactive and Memory Efficient Ray Tracing of Large
Models", EGSR 2008, section 3: a hierarchy whose leaves are strips stands over the strips' own implicit ones.
Differences:

1. Axis-aligned boxes instead of an s-kd-tree: exact boxes inside a strip cost no stored byte, because they
   are rebuilt from its vertices, and at the same tree they cull more than two planes do.
2. Each strip counts with its number of triangles in the surface area heuristic, the one of `partition.sah`.
3. Only inner nodes are stored, 28 bytes each. Strips lie in the order of the leaves, so that every node
   covers a range of consecutive strips, and a count says all about a node's children.

Cost: that of one object split over the strips.
"""

from dataclasses import dataclass

import numpy as np

from striptools.kernels.hierarchy import boxes_from_below
from striptools.partition.object_split import split_objects
from striptools.partition.sah import PartitionOptions
from striptools.types import Boxes, Counts, Words

__all__ = ["StripHierarchy", "build_strip_hierarchy"]


@dataclass(frozen=True, eq=False)
class StripHierarchy:
    """The inner nodes of a binary tree over s strips, in preorder; leaf i is strip i.

    A node at p over k strips has its left child over `left_count[p]` strips at p+1 and its right child over
    the others at p + left_count[p]; a child of one strip is that strip and no node. A scene of one strip has
    no node.

    Attributes:
        boxes: (s-1, 6) float32; each holds the boxes of both children.
        left_count: (s-1,) uint32, from 1 to k-1.
    """

    boxes: Boxes
    left_count: Words

    @property
    def strip_count(self) -> int:
        """The number of leaves."""
        return len(self.left_count) + 1


def build_strip_hierarchy(
    strip_boxes: Boxes, triangle_counts: Counts, options: PartitionOptions, threads: int = 1
) -> tuple[Counts, StripHierarchy]:
    """Build the hierarchy over strips by the surface area heuristic.

    Args:
        strip_boxes: (s, 6) float32, s >= 1.
        triangle_counts: (s,) int32 triangles of each strip, its weight in the heuristic.
        options: Those of the object split.
        threads: Threads of the object split; the result does not depend on it.

    Returns:
        `order` (s,) int32, the strip that goes to place k, and the hierarchy over the strips in that order.
    """
    tree = split_objects(strip_boxes, options, weights=np.asarray(triangle_counts, np.int32), threads=threads)
    boxes = boxes_from_below(tree.size, np.ascontiguousarray(strip_boxes[tree.order]))
    inner = np.flatnonzero(tree.size > 1)
    return tree.order, StripHierarchy(boxes[inner], tree.size[inner + 1].astype(np.uint32))
