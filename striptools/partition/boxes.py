"""Bounding boxes of faces, of ranges of items and of the nodes of a preorder tree, all exact float32."""

from typing import TYPE_CHECKING

import numpy as np

from striptools.kernels import boxes as kernels
from striptools.kernels.hierarchy import boxes_from_below
from striptools.threads import in_chunks
from striptools.types import Boxes, Counts, FaceIds, Faces, Positions

if TYPE_CHECKING:
    from striptools.partition.object_split import ObjectTree


def face_boxes(positions: Positions, faces: Faces, threads: int = 1) -> Boxes:
    """The exact bounding box of each face, (n, 6) float32, the same for any number of threads."""
    positions, faces = np.ascontiguousarray(positions, np.float32), np.ascontiguousarray(faces)
    boxes = np.zeros((len(faces), 6), np.float32)
    in_chunks(lambda part: kernels.face_boxes(positions, faces, *part, boxes), len(faces), threads)
    return boxes


def range_boxes(boxes: Boxes, starts: Counts, items: FaceIds | None = None) -> Boxes:
    """The box around each range of items, (s, 6) float32.

    Args:
        boxes: (n, 6) one box an item.
        starts: (s+1,) rising: range i is the items at places starts[i]:starts[i+1], at least one.
        items: (n,) int32, the item at each place; left out where item k is at place k.
    """
    if items is None:
        items = np.arange(len(boxes), dtype=np.int32)
    around = np.zeros((len(starts) - 1, 6), np.float32)
    kernels.range_boxes(np.ascontiguousarray(boxes), items, starts, around)
    return around


def node_boxes(tree: "ObjectTree", item_boxes: Boxes) -> Boxes:
    """The exact box of every node of an object tree, (2n-1, 6) float32, in its preorder numbering."""
    return boxes_from_below(tree.size, np.ascontiguousarray(item_boxes[tree.order]))
