"""A scene laid out for the walk through its SLBVH: the heap scaled, and leaf blocks by leaf."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from striptools.hierarchies.slbvh import PRIM_POS, Slbvh
from striptools.trace.counters import Counters
from striptools.trace.leaves import aligned_zeros
from striptools.trace.single import SingleLayout, lay_out_leaves, triangles_of_objects
from striptools.trace.walk_slbvh import NODE_BYTES, SlbvhScene

if TYPE_CHECKING:
    from striptools.reducem.scene import Scene

LEAST_NODES = 1024
"""Smaller heaps are filled up to that, so that small scenes share a program."""


@dataclass(frozen=True, eq=False)
class SlbvhLayout(SingleLayout):
    """What a tracer keeps of a scene under an SLBVH."""

    @property
    def missed(self) -> Counters:
        """A ray that misses the root's box visits the root."""
        return Counters(1, 0, 1, 0, NODE_BYTES, 0)


def lay_out_slbvh(scene: "Scene", slbvh: Slbvh, threads: int = 1) -> SlbvhLayout:
    """Lay a scene out for the walk through an SLBVH over its triangles, strips or blocks.

    The copy of the heap that is walked has in a leaf's PrimPos the number of the leaf, from left to right.
    """
    leaf_nodes = np.flatnonzero(slbvh.is_leaf)
    leaf_nodes = leaf_nodes[np.argsort(slbvh.nodes[leaf_nodes, PRIM_POS])]
    triangles, begin = triangles_of_objects(scene.objects(slbvh.over), slbvh.objects())
    starts = np.append(begin[slbvh.nodes[leaf_nodes, PRIM_POS]], begin[-1]).astype(np.int32)
    leaves, held, frame = lay_out_leaves(scene, triangles, starts)
    nodes = aligned_zeros((max(LEAST_NODES, len(slbvh.nodes)), 8), np.float32)
    np.multiply(slbvh.boxes, held.scale, out=nodes[: len(slbvh.nodes), :6])
    words = nodes.view(np.uint32)[: len(slbvh.nodes)]
    words[:, 6:] = slbvh.nodes[:, 6:]
    words[leaf_nodes, PRIM_POS] = np.arange(len(leaf_nodes), dtype=np.uint32)
    return SlbvhLayout(SlbvhScene(nodes, leaves, frame), held, slbvh.depth + 1, nodes[1, :6].copy())
