"""What the bits of boxes are worth: an expanded scene under the planes of its file, and planes of fewer bits.

A compressed scene is traced through 8 bits a plane on a grid of the node's own (SPEC 4.4); an expanded one
through the same hierarchy with exact boxes in float32. Here is what lies between: the expanded hierarchy with
boxes as large as the file's, and both with planes that keep only the highest bits. There is no fourth corner,
a compressed scene with float32 boxes: its nodes have a byte a plane.

Boxes grow, outward, and nothing else changes: hits are the same, and the memory is, since what is traced
stays a byte a plane or a float32. What fewer bits cost is visits to nodes and triangles that boxes no longer
keep rays from. Each box holds the triangles below it, but not always the boxes of the node below it, whose
grid is another.
"""

from dataclasses import replace

import numpy as np

from striptools.errors import UsageError
from striptools.hierarchies.packed import BoxGrid, slots_of, wide_tree
from striptools.hierarchies.wide import WideBoxes
from striptools.reducem.scene import Scene
from striptools.trace.leaves import WideLayout, lay_out_wide

PLANE_BITS = 8
"""Bits of a plane in a file."""

_FIRST_PLANE = 16


def coarsened(scene: Scene, bits: int, threads: int = 1) -> Scene:
    """The scene with its boxes stored, of whose planes the highest `bits` are kept, outward.

    Args:
        scene: Under the default hierarchy.
        bits: 1 to 8; with 8 boxes are as in the file.
        threads: To build boxes with that the scene does not hold.

    Raises:
        UsageError: `bits` is out of its range.
    """
    if not 1 <= bits <= PLANE_BITS:
        raise UsageError(f"{bits} is out of range", where="bits of a plane", remedy="give 1 to 8")
    packed = scene.with_boxes(threads)
    nodes = packed.nodes.copy()
    planes = nodes.view(np.uint8)[:, _FIRST_PLANE:].reshape(-1, 2, 3, 8)
    below = (1 << PLANE_BITS - bits) - 1
    there = planes[:, :1] <= planes[:, 1:]
    wider = np.stack([planes[:, 0] & ~np.uint8(below), planes[:, 1] | np.uint8(below)], axis=1)
    np.copyto(planes, wider, where=there)
    return replace(scene, packed=replace(packed, nodes=nodes))


def plane_boxes(nodes: np.ndarray, grid: BoxGrid) -> WideBoxes:
    """(m, 6, 8) float32: the boxes of packed nodes, never smaller; inverted (inf, -inf) in empty slots.

    Args:
        nodes: (m, 16) uint32.
        grid: The scene's.
    """
    slots = slots_of(nodes)
    cell = np.ldexp(1.0, grid.cell)[:, None]
    low, high = (grid.low.astype(np.float64)[:, None] + part * cell for part in (slots.low, slots.high))
    boxes = np.concatenate([_rounded(low, -np.inf), _rounded(high, np.inf)], axis=1)
    empty = np.repeat(slots.empty[:, None], 3, axis=1)
    boxes[:, :3][empty], boxes[:, 3:][empty] = np.inf, -np.inf
    return boxes


def _rounded(values: np.ndarray, towards: float) -> np.ndarray:
    """Values as float32, rounded towards one infinity."""
    near = values.astype(np.float32)
    passed = near > values if towards < 0 else near < values
    return np.where(passed, np.nextafter(near, np.float32(towards)), near)


def lay_out_planes(scene: Scene, threads: int = 1) -> WideLayout:
    """Lay a scene out, expanded, for the walk through its hierarchy with boxes as its nodes have them."""
    packed = scene.with_boxes(threads)
    boxes = plane_boxes(packed.nodes, scene.grid)
    return lay_out_wide(scene, wide_tree(packed, scene.triangle_boxes(threads), scene.block_starts, boxes))
