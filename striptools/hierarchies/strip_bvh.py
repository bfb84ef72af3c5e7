"""The SAH hierarchy over strips, above the implicit hierarchies inside them: what strips are measured by.

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
from striptools.partition.boxes import range_boxes
from striptools.partition.object_split import split_objects
from striptools.partition.sah import PartitionOptions
from striptools.types import Boxes, Counts, Words

__all__ = ["StripHierarchy", "build_block_hierarchy", "build_strip_hierarchy"]


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


def build_block_hierarchy(
    strip_boxes: Boxes,
    triangle_counts: Counts,
    block_strips: Counts,
    options: PartitionOptions,
    threads: int = 1,
) -> tuple[Counts, StripHierarchy]:
    """Build a hierarchy over blocks, and under each block one over its strips, as one hierarchy over strips.

    Args:
        strip_boxes: (s, 6) float32, s >= 1, the strips of a block one after another.
        triangle_counts: (s,) int32 triangles of each strip, its weight in the heuristic.
        block_strips: (b+1,) int32, the first strip of each block, then s.
        options: Those of the object splits.
        threads: Threads of the object split over blocks; the result does not depend on it.

    Returns:
        `order` (s,) int32, the strip that goes to place k, and the hierarchy over the strips in that order.
    """
    counts = np.asarray(triangle_counts, np.int32)
    block_boxes = range_boxes(strip_boxes, block_strips)
    block_counts = np.add.reduceat(counts, block_strips[:-1]).astype(np.int32)
    top = split_objects(block_boxes, options, weights=block_counts, threads=threads)
    strips = np.diff(block_strips)[top.order]
    behind = np.append(0, np.cumsum(strips))
    orders, sizes, place = [], [], 0
    for size in top.size.tolist():
        if size > 1:
            # All blocks below it follow, and so do their strips.
            sizes.append([behind[place + size] - behind[place]])
            continue
        begin, end = block_strips[top.order[place]], block_strips[top.order[place] + 1]
        below = split_objects(strip_boxes[begin:end], options, weights=counts[begin:end])
        orders.append(begin + below.order)
        sizes.append(below.size)
        place += 1
    order, size = np.concatenate(orders).astype(np.int32), np.concatenate(sizes).astype(np.int32)
    boxes = boxes_from_below(size, np.ascontiguousarray(strip_boxes[order]))
    inner = np.flatnonzero(size > 1)
    return order, StripHierarchy(boxes[inner], size[inner + 1].astype(np.uint32))
