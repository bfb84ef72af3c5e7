"""Blocks of strips for the tests, made by the real stages, as arrays."""

from dataclasses import dataclass

import numpy as np

from striptools.hierarchies.packed import BoxGrid, PackedNodes, box_grid, build_inner, build_top
from striptools.partition.boxes import face_boxes, range_boxes
from striptools.partition.object_split import split_objects
from striptools.partition.sah import PartitionOptions
from striptools.strips.ordering import OrderingOptions
from striptools.strips.stripify import cut_for, stripify
from striptools.strips.topology import Strips, encode_strips


@dataclass(frozen=True, eq=False)
class Blocks:
    """Faces in file order, and how they are cut."""

    positions: np.ndarray
    faces: np.ndarray
    strips: Strips
    block_starts: np.ndarray
    boxes: np.ndarray
    grid: BoxGrid
    packed: PackedNodes

    @property
    def strip_starts(self):
        return self.strips.starts


def blocks_of(mesh, *, block=256, max_length=64, longest_run=8, threads=1):
    """The blocks of a clean mesh under their nodes."""
    boxes = face_boxes(mesh.positions, mesh.faces)
    options = OrderingOptions(block=block, max_length=max_length)
    tree = split_objects(boxes, PartitionOptions(block=block))
    sequences = stripify(mesh.faces, mesh.vertex_count, boxes, tree, options)
    starts = cut_for(tree, mesh.faces, mesh.vertex_count, options).starts
    grid = box_grid(mesh.positions[mesh.faces].min((0, 1)), mesh.positions[mesh.faces].max((0, 1)))
    block_boxes = range_boxes(boxes, starts, sequences.faces)
    order, top = build_top(block_boxes, np.diff(starts), grid, threads)

    # Strips in the order of the blocks.
    first = np.searchsorted(sequences.starts, starts)
    strips = np.concatenate([np.arange(first[b], first[b + 1]) for b in order]).astype(np.int32)
    encoded = encode_strips(mesh.faces, sequences.reordered(strips))
    block_starts = np.append(0, np.cumsum(np.diff(starts)[order])).astype(np.int32)
    faces = decode(mesh.faces, encoded)
    boxes = face_boxes(mesh.positions, faces)
    inner, first_run, runs = build_inner(
        boxes, block_starts, encoded.starts, grid, len(top), longest_run, threads
    )
    packed = PackedNodes(np.concatenate([top, inner]), len(top), first_run, runs, longest_run)
    return Blocks(mesh.positions, faces, encoded, block_starts, boxes, grid, packed)


def decode(faces, strips):
    """The faces in file order, turned as the strips turn them."""
    corners = (np.arange(3) + strips.rotation[:, None]) % 3
    return np.ascontiguousarray(np.take_along_axis(faces[strips.source_face], corners, axis=1))
