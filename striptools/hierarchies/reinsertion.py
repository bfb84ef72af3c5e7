"""A binary hierarchy made cheaper: subtrees are taken out and put in where they cost least.

Source: Bittner, Hapala & Havran, "Fast Insertion-Based Optimization of Bounding Volume Hierarchies" (Computer
Graphics Forum 2013); the search for a place, up from where the subtree was and down into each sibling on the
way, with what has been saved so far as its bound, is that of Meister & Bittner, "Parallel Reinsertion for
Bounding Volume Hierarchy Optimization" (EG 2018), section 3.

Differences and decisions:
1. One subtree after the other, so that each sees what the last one changed: the same tree whatever the
   threads.
2. Nodes that become a leaf of the wide tree are left as they are: their areas are paid in any case.
3. In each of `ROUNDS` rounds the largest `SHARE` of nodes, largest first; a round that saves less than
   `LEAST_ROUND` of the area of all inner nodes is the last.
4. A search looks at no more than `MOST_PLACES` places, so that no heap of overlapping triangles makes it
   quadratic.
5. A tree is changed only where that takes at least a `1 - WORTH`th part of the area of its inner nodes away.
   Of less, rays see nothing: trees split from above overlap less than others of the same cost (Aila, Karras &
   Laine, "On Quality Metrics of Bounding Volume Hierarchies", HPG 2013). Scanned models save 1 to 2 %,
   buildings and boards a quarter.

Cost: O(n) nodes in each round, a search from tens of places (scanned models) to hundreds (buildings); 60
bytes a node while it runs.
"""

import numpy as np

from striptools.hierarchies.in_strip import BinaryTree
from striptools.kernels import reinsertion as kernels
from striptools.types import Counts

ROUNDS = 4
SHARE = 0.2
LEAST_ROUND = 0.005
MOST_PLACES = 4096
WORTH = 0.97

LEAST_MOVE = 1e-4
"""A move is worth it that saves this part of the area of the node that it takes away."""

_ROOM = 4096
"""Places that wait to be looked at; a tree so deep that this is not enough is searched in part."""


def reinsert(tree: BinaryTree, order: Counts, kept: np.ndarray) -> tuple[BinaryTree, Counts]:
    """Move subtrees of a hierarchy to where they cost least.

    Args:
        tree: Over n >= 1 items, m = 2n-1 nodes.
        order: (n,) int32, the item at each leaf.
        kept: (m,) bool, nodes that are left as they are, with all below them.

    Returns:
        The new tree and the item at each of its leaves; those given, where moving saves too little.
    """
    nodes = len(tree.size)
    links = kernels.Links(
        np.zeros(nodes, np.int32), np.zeros((nodes, 2), np.int32), np.zeros((nodes, 6), np.float32)
    )
    kernels.link(tree.size, tree.boxes, kept, links)
    linked = np.concatenate([[0], np.flatnonzero(links.parent >= 0)]).astype(np.int32)
    search = kernels.Search(np.zeros(_ROOM, np.int32), np.zeros(_ROOM), np.zeros((1, 6), np.float32))
    chosen, before = max(1, int(len(linked) * SHARE)), kernels.inner_area(links)
    for _ in range(ROUNDS):
        largest = np.argsort(-kernels.areas(links, linked), kind="stable")[:chosen]
        moved, saved = kernels.move_each(links, linked[largest], LEAST_MOVE, MOST_PLACES, search)
        if moved == 0 or saved < LEAST_ROUND * kernels.inner_area(links):
            break
    if kernels.inner_area(links) > WORTH * before:
        return tree, order
    size, boxes, items = kernels.in_preorder(links, tree.size, tree.boxes, order)
    return BinaryTree(boxes, size), items
