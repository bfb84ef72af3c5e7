"""A presorted scene laid out for its walk: triangles in their order, and the few nodes above."""

from typing import TYPE_CHECKING, Literal

import numpy as np

from striptools.errors import LimitError
from striptools.hierarchies.presorted import Presorted, tree_depth
from striptools.kernels.presorted import plain_depth
from striptools.trace.box import MARGIN
from striptools.trace.leaves import LeafBlocks, aligned_zeros, fill_blocks, reach_of, size_class
from striptools.trace.single import SingleLayout, padded
from striptools.trace.walk import WIDTH, Frame
from striptools.trace.walk_presorted import DirectScene, PresortedScene

if TYPE_CHECKING:
    from striptools.reducem.placed import Placed
    from striptools.reducem.scene import Scene

NodeTest = Literal["direct", "bandwidth"]

MOST_TRIANGLES = 2**26
"""A triangle's place, times 32, still fits 31 bits."""


def lay_out_presorted(
    scene: "Scene | Placed", hierarchy: Presorted, threads: int = 1, *, node_test: NodeTest = "bandwidth"
) -> SingleLayout:
    """Lay a scene out for the walk of its presorted hierarchy.

    Triangles are held once, as the walk reads them, 36 bytes each: u and v of hits come from there too.

    Args:
        scene: Whose triangles stand in the hierarchy's order.
        hierarchy: What stands above.
        threads: Not used: nothing is built.
        node_test: How nodes are tested, see `walk_presorted`.

    Raises:
        LimitError: 2**26 triangles or more.
    """
    count = scene.triangle_count
    if count >= MOST_TRIANGLES:
        where, remedy = "lay_out_presorted", "use another hierarchy"
        raise LimitError(f"{count} triangles", where=where, remedy=remedy)
    held, faces = _hold(scene, count)
    nodes = _nodes(scene, hierarchy, held.scale)
    zero, one = np.zeros(3, np.float32), np.ones(3, np.float32)
    frame = Frame(held.scale, reach_of(scene, held.scale), zero, one, MARGIN)
    kind = PresortedScene if node_test == "bandwidth" else DirectScene
    arrays = kind(held.blocks.reshape(-1, 3, 3), faces, nodes, frame)
    depth = plain_depth(hierarchy.nodes) + tree_depth(int(np.diff(hierarchy.starts).max()))
    return SingleLayout(arrays, held, depth, nodes[0, :6].view(np.float32))


def _hold(scene: "Scene | Placed", count: int) -> tuple[LeafBlocks, np.ndarray]:
    """Triangles in file order, each a block of one lane, and the face each is reported as."""
    first = np.arange(0, count, WIDTH, dtype=np.int32)
    filled = fill_blocks(scene, first, np.minimum(count - first, WIDTH).astype(np.int32))
    room = size_class(count + 1)
    lanes = aligned_zeros((room, 9, 1), np.float32)
    blocks = filled.blocks[: len(first)]
    lanes[:count, :, 0] = blocks[:, :9].transpose(0, 2, 1).reshape(-1, 9)[:count]
    faces = aligned_zeros((room,), np.int32)
    faces[:count] = blocks[:, 9].reshape(-1)[:count].view(np.int32)
    triangle = filled.triangle_of if len(filled.triangle_of) else np.arange(len(filled.place), dtype=np.int32)
    place = np.maximum(triangle, 0) * np.int32(4 * WIDTH) + (filled.place & 3)
    return LeafBlocks(lanes, place, filled.triangle_of, filled.scale), faces


def _nodes(scene: "Scene | Placed", hierarchy: Presorted, scale: np.float32) -> np.ndarray:
    """Plain nodes as the walk reads them; a leaf over all triangles where the hierarchy has none."""
    nodes = hierarchy.nodes
    if len(nodes) == 0:
        nodes = np.zeros((1, 8), np.uint32)
        nodes[0, :6] = np.concatenate([scene.low, scene.high]).astype(np.float32).view(np.uint32)
        nodes[0, 7] = hierarchy.starts[-1]
    nodes = padded(nodes)
    sides = nodes[:, :6].view(np.float32)
    sides *= scale
    return nodes
