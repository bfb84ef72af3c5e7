"""A wide hierarchy as a binary one, which a GPU walks with one ray a thread.

A wide node of k children becomes k - 1 binary ones: its lanes are halved, quartered and paired, in the order
they have, which follows the octants. Boxes are joined and triangles are those of the leaves, so that hits are
the same.
"""

from typing import Any, NamedTuple

import numpy as np

from striptools.trace.leaves import aligned_full, size_class
from striptools.trace.walk import DONE, NO_NAME, WIDTH, Frame
from striptools.trace.walk_wide import WideScene


class BinaryScene(NamedTuple):
    """A scene as arrays on a device.

    Attributes:
        nodes: (m, 16) float32: low and high corner of the first child's box, of the second's, NaN where there
            is none; then the bits of the children (int32): a node, or a negative number: `DONE`, or a leaf,
            the complement of its first triangle * 8 + its triangles - 1.
        triangles: (n, 12) float32: x of corners a, b, c, then y, then z, then the bits of the face (int32).
        frame: How rays are seen.
    """

    nodes: Any
    triangles: Any
    frame: Frame

    @property
    def node_count(self) -> int:
        """Nodes and those that fill up the size class."""
        return len(self.nodes)

    @property
    def has_faces(self) -> bool:
        """Names are faces."""
        return False


def binary_scene(wide: WideScene) -> BinaryScene:
    """The binary hierarchy of a wide one, by NumPy."""
    boxes, child = wide.nodes[:, :6], wide.nodes[:, 6].view(np.int32)
    face = wide.blocks[:, 9].view(np.int32)
    there = face != NO_NAME
    triangles = aligned_full((size_class(int(there.sum())), 12), np.nan)
    lanes = wide.blocks.swapaxes(1, 2)[there]
    triangles[: len(lanes), :10] = lanes
    count = there.sum(axis=1)
    leaf_code = ~((np.cumsum(count) - count) << 3 | np.maximum(count - 1, 0))

    # Lanes by eight, four, two and one: whether anything is in them, and its box.
    held = [child != DONE]
    box = [boxes]
    while held[-1].shape[1] > 2:
        a, b = held[-1][:, ::2], held[-1][:, 1::2]
        low = np.fmin(box[-1][:, :3, ::2], box[-1][:, :3, 1::2])
        high = np.fmax(box[-1][:, 3:, ::2], box[-1][:, 3:, 1::2])
        held.append(a | b)
        box.append(np.concatenate([low, high], axis=1))

    # The first node of a wide one is always made, the others where both their children are there.
    pairs = [h[:, ::2] & h[:, 1::2] for h in held]
    made = np.concatenate([held[2].any(axis=1, keepdims=True), pairs[1], pairs[0]], axis=1)
    number = (np.cumsum(made.ravel()) - 1).reshape(made.shape).astype(np.int32)
    code = np.where(
        child >= 0, number[np.maximum(child, 0), 0], leaf_code[np.where(child < 0, ~child, 0) % len(face)]
    )
    codes = [np.where(held[0], code, DONE).astype(np.int32)]
    for level, first in ((0, 3), (1, 1)):
        a, b = codes[-1][:, ::2], codes[-1][:, 1::2]
        own = number[:, first : first + a.shape[1]]
        codes.append(np.where(pairs[level], own, np.where(held[level][:, ::2], a, b)))

    nodes = aligned_full((size_class(int(made.sum())), 16), np.nan)
    for level, first in ((2, 0), (1, 1), (0, 3)):
        for k in range(WIDTH // 2 >> level):
            at = number[made[:, first + k], first + k]
            for side in range(2):
                lane = 2 * k + side
                mine = made[:, first + k]
                nodes[at, 6 * side : 6 * side + 6] = box[level][mine, :, lane]
                nodes[at, 12 + side] = codes[level][mine, lane].view(np.float32)
    return BinaryScene(nodes, triangles, wide.frame)
