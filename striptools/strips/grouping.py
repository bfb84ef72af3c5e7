"""Strips in blocks: at most so many triangles and vertices, and no strip in two of them.

Strip-RT with blocks cuts the object tree first and orders inside the ranges, which are the blocks. What
orders the mesh as a whole (the other methods, or no block size) is grouped afterwards: strips too long for
a block are cut, an object split over the strips' boxes is made, each counted with its triangles, and its
largest subtrees within the limits are the blocks.

Cost: that of the ordering, and of an object split over the strips.
"""

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from striptools.kernels.cut import group_strips
from striptools.partition.boxes import range_boxes
from striptools.partition.object_split import split_objects
from striptools.partition.sah import PartitionOptions
from striptools.strips.ordering import LARGEST_STRIP_BLOCK, OrderingOptions, Sequences
from striptools.strips.stripify import Progress, cut_for, order_cut, stripify
from striptools.strips.tunnelling import EFFORTS
from striptools.types import Boxes, Counts, Faces

if TYPE_CHECKING:
    from striptools.partition.object_split import ObjectTree

__all__ = ["group_sequences", "reorder_blocks", "stripify_in_blocks"]


def stripify_in_blocks(
    faces: Faces,
    vertex_count: int,
    boxes: Boxes,
    tree: "ObjectTree",
    options: OrderingOptions,
    partition: PartitionOptions | None = None,
    threads: int = 1,
    watch: Progress | None = None,
) -> tuple[Sequences, Counts]:
    """Order faces into strips by the method asked for, and the strips into blocks.

    Args:
        faces: (n, 3) int32, indices below `vertex_count`.
        vertex_count: How many vertices there are.
        boxes: (n, 6) float32, the faces' boxes.
        tree: Object tree with one face an item.
        options: Method, cap, effort and blocks.
        partition: Options of an object split over strips; the defaults when left out.
        threads: How many threads share the work; the strips are the same for any number.
        watch: Told how far the work is.

    Returns:
        The sequences, and (b+1,) int32, the place of the first face of each block, then n.
    """
    if options.method == "strip-rt" and options.block is not None:
        cut = cut_for(tree, faces, vertex_count, options)
        effort = EFFORTS[options.effort]
        given = (faces, vertex_count, boxes, tree, cut, options.max_length, effort)
        return order_cut(*given, threads, watch, flips=options.flips), cut.starts
    sequences = stripify(faces, vertex_count, boxes, tree, options, threads, watch)
    most = options.block or LARGEST_STRIP_BLOCK
    return group_sequences(sequences, faces, vertex_count, boxes, most, partition, threads)


def group_sequences(
    sequences: Sequences,
    faces: Faces,
    vertex_count: int,
    boxes: Boxes,
    most: int = LARGEST_STRIP_BLOCK,
    partition: PartitionOptions | None = None,
    threads: int = 1,
) -> tuple[Sequences, Counts]:
    """Group strips into blocks.

    Args:
        sequences: Faces in strip order.
        faces: (n, 3) int32.
        vertex_count: How many vertices there are.
        boxes: (n, 6) float32, the faces' boxes.
        most: The most triangles, and the most vertices, of a block, 4 or more.
        partition: Options of the object split; the defaults when left out.
        threads: Threads of the object split; the result does not depend on it.

    Returns:
        The sequences in the order of the blocks, those too long cut, and (b+1,) int32, the place of the first
        face of each block, then n.
    """
    # A strip of k triangles has at most k + 2 vertices.
    sequences = _cut_long(sequences, most - 2)
    strip_boxes = range_boxes(boxes, sequences.starts, sequences.faces)
    plain = replace(partition or PartitionOptions(), block=None)
    tree = split_objects(strip_boxes, plain, sequences.lengths.astype(np.int32), threads)
    placed, seen = faces[sequences.faces], np.full(vertex_count, -1, np.int32)
    firsts = np.zeros(len(tree.order) + 1, np.int32)
    count = group_strips(tree.size, tree.order, sequences.starts, placed, seen, most, most, firsts)
    firsts[count] = len(tree.order)
    ordered = sequences.reordered(tree.order)
    return ordered, ordered.starts[firsts[: count + 1]]


def reorder_blocks(sequences: Sequences, block_starts: Counts, order: Counts) -> tuple[Sequences, Counts]:
    """The same blocks in another order.

    Args:
        sequences: The strips of a block one after another.
        block_starts: (b+1,) int32, the place of the first face of each block, then n.
        order: (b,) a permutation: new block i is the old block order[i].
    """
    firsts = np.searchsorted(sequences.starts, block_starts)
    counts = np.diff(firsts)[order]
    shift = np.repeat(firsts[:-1][order] - (np.cumsum(counts) - counts), counts)
    strips = np.arange(len(sequences.starts) - 1) + shift
    starts = np.concatenate([[0], np.cumsum(np.diff(block_starts)[order])])
    return sequences.reordered(strips), starts.astype(np.int32)


def _cut_long(sequences: Sequences, most: int) -> Sequences:
    """The same faces, strips of more than `most` cut every `most` faces."""
    lengths = sequences.lengths
    if int(lengths.max(initial=0)) <= most:
        return sequences
    pieces = -(-lengths // most)
    within = np.arange(int(pieces.sum())) - np.repeat(np.cumsum(pieces) - pieces, pieces)
    starts = np.repeat(sequences.starts[:-1], pieces) + most * within
    return Sequences(sequences.faces, np.append(starts, sequences.starts[-1]).astype(np.int32))
