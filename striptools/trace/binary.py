"""A scene laid out for the walk through a binary hierarchy of 32-byte nodes."""

from typing import TYPE_CHECKING

import numpy as np

from striptools.hierarchies.binary import binary_depth
from striptools.hierarchies.loose_octree import LooseBvh
from striptools.hierarchies.options import OverName
from striptools.trace.single import SingleLayout, lay_out_leaves, padded, triangles_of_objects
from striptools.trace.walk_binary import BinaryScene
from striptools.types import Counts

if TYPE_CHECKING:
    from striptools.reducem.scene import Scene


def lay_out_loose(scene: "Scene", hierarchy: LooseBvh, _threads: int = 1) -> SingleLayout:
    """Lay a scene out for the walk through the hierarchy that a loose octree gave."""
    return lay_out_binary(scene, hierarchy.nodes, hierarchy.order, hierarchy.over)


def lay_out_binary(scene: "Scene", nodes: np.ndarray, order: Counts | None, over: OverName) -> SingleLayout:
    """Lay a scene out for the walk through any binary hierarchy.

    Args:
        scene: Whose triangles they are.
        nodes: (m, 8) uint32 in preorder, as `LooseBvh` has them, for which `check_binary_nodes` holds.
        order: (p,) int32, the objects as leaves name them; None where they lie in that order.
        over: What the objects are.
    """
    starts = scene.objects(over)
    objects = np.arange(len(starts) - 1, dtype=np.int32) if order is None else order
    triangles, place = triangles_of_objects(starts, objects)
    is_leaf = nodes[:, 7] > 0
    first = nodes[is_leaf, 6].astype(np.int64)
    leaves, held, frame = lay_out_leaves(scene, triangles, np.append(place[first], place[-1]))
    rows = _rows(nodes, is_leaf, held.scale)
    root = nodes[0, :6].view(np.float32) * held.scale
    return SingleLayout(BinaryScene(padded(rows), leaves, frame), held, binary_depth(nodes), root)


def _rows(nodes: np.ndarray, is_leaf: np.ndarray, scale: np.float32) -> np.ndarray:
    """(k, 16) float32, the inner nodes as the walk reads them; one over a leaf that is all."""
    inner = np.flatnonzero(~is_leaf)
    rows = np.full((max(1, len(inner)), 16), np.nan, np.float32)
    boxes = nodes[:, :6].view(np.float32)
    name = np.where(is_leaf, -np.cumsum(is_leaf), np.cumsum(~is_leaf) - 1).astype(np.int32)
    if len(inner) == 0:
        rows[0, 0:12:2] = boxes[0] * scale
        rows[0, 12:13].view(np.int32)[:] = name[0]
        return rows
    for side, child in enumerate((inner + 1, nodes[inner, 6].astype(np.int64))):
        rows[:, side:12:2] = boxes[child] * scale
        rows[:, 12 + side] = name[child].view(np.float32)
    return rows
