"""Greedy linking: one pass over the edges between faces, the nearest in the tree first, instead of rounds.

Source: the step "Ordering" of Lauterbach, Yoon, Tang, Manocha, "ReduceM: Interactive and Memory Efficient Ray
Tracing of Large Models" (EGSR 2008), whose aim (compact strips) and means (the SAH object tree) are kept.

Differences from strips/ordering.py, which has the paper's rounds:
1. Every pair of half-edges that run one edge in opposite directions (in any, where flips are allowed) is
   ranked once, by the size of the smallest subtree that holds both faces, in classes of half an octave. The
   pairs of the least class are linked first; within a class in the order of their half-edges (faces stand in
   the tree's order).
2. A pair is linked where both faces have a free end there, they are of different paths, and the cap holds.
   What is linked stays linked: nothing is ranked again, and there is no balance term.
3. In a class, edges of two faces come before edges of more: what two faces leave free on an edge of four is
   a way for the other two, and two faces that share all their edges are best linked by one that nobody else
   needs.
4. Classes, not exact sizes: within half an octave the difference is noise, and a counting sort does.

Cost: O(E) and a climb to the common node a pair, which is short because neighbours in space are neighbours
in the tree; 40 bytes a face of working memory.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from striptools.errors import UsageError
from striptools.kernels.strip_linking import link_range
from striptools.kernels.strip_ordering import renumber, walk_links
from striptools.strips.ordering import OrderingOptions, Sequences
from striptools.types import Faces

if TYPE_CHECKING:
    from striptools.mesh.adjacency import Adjacency
    from striptools.partition.object_split import ObjectTree


def link_faces(
    adjacency: Adjacency, faces: Faces, tree: ObjectTree, options: OrderingOptions | None = None
) -> Sequences:
    """Join the faces of a whole mesh, in one range, by greedy linking alone.

    Args:
        adjacency: Rings of half-edges of `faces`.
        faces: (n, 3) int32.
        tree: Object tree with one face an item.
        options: Only the cap is looked at, for no flips are made; the defaults of OrderingOptions when left
            out.

    Returns:
        Sequences of at most max_length faces, each from its end that comes first in the tree, in the order of
        those ends.

    Raises:
        UsageError: Arrays that do not belong together.
    """
    count = len(faces)
    if len(adjacency.ring) != 3 * count or len(tree.leaf_node) != count:
        raise UsageError("adjacency, faces and tree are not of one mesh", where="link_faces")
    place = np.zeros(count, np.int32)
    place[tree.order] = np.arange(count, dtype=np.int32)
    placed, ring = np.zeros((count, 3), np.int32), np.zeros(3 * count, np.int32)
    renumber(faces, adjacency.ring, tree.order, place, placed, ring)
    mate, links = np.zeros(3 * count, np.int32), np.zeros(count, np.uint8)
    most = (options or OrderingOptions()).max_length
    link_range(ring, placed, tree.leaf_node[tree.order], tree.parent, tree.size, most, False, mate, links)
    order, starts = np.zeros(count, np.int32), np.zeros(count + 1, np.int32)
    strips = walk_links(mate, links, order, starts)
    return Sequences(tree.order[order], starts[: strips + 1].copy())
