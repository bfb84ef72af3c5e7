"""A scene laid out for the walk through a kd-tree."""

from typing import TYPE_CHECKING

import numpy as np

from striptools.errors import UsageError
from striptools.hierarchies.kdtree import KdTree
from striptools.kernels.kdtree import LEAF, depth_of
from striptools.trace.leaves import LeafBlocks, aligned_zeros, size_class
from striptools.trace.single import SingleLayout, lay_out_leaves, padded
from striptools.trace.walk import MISS, WIDTH
from striptools.trace.walk_kdtree import KdScene, Strips, Triangles

if TYPE_CHECKING:
    from striptools.reducem.scene import Scene

MAILBOXES = (0, 1, 2, 4, 8, 16, 32, 64)
"""Sizes of a mail-box: powers of two, and none."""


def lay_out_kdtree(
    scene: "Scene", hierarchy: KdTree, threads: int = 1, mailbox: int | None = None
) -> SingleLayout:
    """Lay a scene out for the walk through its kd-tree.

    Args:
        scene: Whose objects the tree is over.
        hierarchy: The tree.
        threads: Not used.
        mailbox: References that a ray remembers, one of `MAILBOXES`; None for what the tree says. Hits are
            the same.

    Raises:
        UsageError: A mail-box of another size.
    """
    size = hierarchy.mailbox if mailbox is None else mailbox
    if size not in MAILBOXES:
        raise UsageError(
            f"{size} is no size of a mail-box", remedy=f"give one of {', '.join(map(str, MAILBOXES))}"
        )
    starts = scene.objects(hierarchy.over)
    if hierarchy.over == "triangles":
        starts = np.unique(np.append(np.arange(0, scene.triangle_count, WIDTH), starts[-1])).astype(np.int32)
    leaves, held, frame = lay_out_leaves(scene, np.arange(scene.triangle_count, dtype=np.int32), starts)
    things = Triangles(_rows(held)) if hierarchy.over == "triangles" else Strips(leaves)
    cell = np.concatenate([hierarchy.low, hierarchy.high]).astype(np.float32) * held.scale
    nodes, references = _nodes(hierarchy, held.scale), padded(hierarchy.references.astype(np.int32))
    arrays = KdScene(nodes, references, things, np.full(size, MISS, np.int32), cell, frame)
    return SingleLayout(arrays, held, int(depth_of(hierarchy.nodes)) + 1, cell)


def _nodes(hierarchy: KdTree, scale: np.float32) -> np.ndarray:
    """Nodes as the walk reads them: splits scaled, those that fill up the size class leaves of nothing."""
    nodes = padded(hierarchy.nodes.view(np.int32), LEAF)
    inner = np.flatnonzero(hierarchy.nodes[:, 1] & 3 != LEAF)
    nodes[inner, 0] = (hierarchy.nodes[inner, 0].view(np.float32) * scale).view(np.int32)
    return nodes


def _rows(held: LeafBlocks) -> np.ndarray:
    """Triangle after triangle, as blocks have them lane by lane."""
    rows = aligned_zeros((size_class(WIDTH * len(held.blocks)), held.blocks.shape[1]), np.float32)
    rows[: WIDTH * len(held.blocks)] = held.blocks.transpose(0, 2, 1).reshape(-1, held.blocks.shape[1])
    return rows
