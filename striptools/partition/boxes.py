"""Bounding boxes of faces, of ranges of items and of the nodes of a preorder tree, all exact float32."""

from typing import TYPE_CHECKING

import numpy as np

from striptools.kernels import boxes as kernels
from striptools.types import Boxes, Counts, Faces, Positions

if TYPE_CHECKING:
    from striptools.partition.object_split import ObjectTree


def face_boxes(positions: Positions, faces: Faces) -> Boxes:
    """The exact bounding box of each face, (n, 6) float32."""
    boxes = np.zeros((len(faces), 6), np.float32)
    kernels.face_boxes(np.ascontiguousarray(positions, np.float32), np.ascontiguousarray(faces), boxes)
    return boxes


def range_boxes(boxes: Boxes, starts: Counts) -> Boxes:
    """The box around each range of items, (s, 6) float32.

    Args:
        boxes: (n, 6) one box an item.
        starts: (s+1,) rising: range i is the items starts[i]:starts[i+1], at least one.
    """
    lo = np.minimum.reduceat(boxes[:, :3], starts[:-1], axis=0)
    hi = np.maximum.reduceat(boxes[:, 3:], starts[:-1], axis=0)
    return np.ascontiguousarray(np.concatenate([lo, hi], axis=1))


def node_boxes(tree: "ObjectTree", item_boxes: Boxes) -> Boxes:
    """The exact box of every node of an object tree, (2n-1, 6) float32, in its preorder numbering."""
    boxes = np.zeros((len(tree.size), 6), np.float32)
    kernels.node_boxes(tree.order, tree.size, np.ascontiguousarray(item_boxes), boxes)
    return boxes
