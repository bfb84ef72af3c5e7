"""Subtrees of a binary hierarchy moved to where they cost least: the loops behind hierarchies/reinsertion.py.

The tree is linked both ways, so that a subtree is moved by a few changes; its nodes keep their numbers.
"""

from collections import namedtuple

import numpy as np

from striptools.kernels.boxes import area_of, half_area
from striptools.kernels.compiled import helper, inlined, kernel

Links = namedtuple("Links", "parent children boxes")
"""parent (m,) int32, -1 for the root, node 0; children (m, 2) int32, -1 where a node is left as it is; boxes
(m, 6) float32."""

Search = namedtuple("Search", "node saved box")
"""Room: node (k,) int32 and saved (k,) float64 of places to look at, and box (1, 6) float32."""


@inlined
def joined_area(boxes, p, q):
    """Half the surface area of the box around two."""
    return half_area(
        min(boxes[p, 0], boxes[q, 0]),
        min(boxes[p, 1], boxes[q, 1]),
        min(boxes[p, 2], boxes[q, 2]),
        max(boxes[p, 3], boxes[q, 3]),
        max(boxes[p, 4], boxes[q, 4]),
        max(boxes[p, 5], boxes[q, 5]),
    )


@kernel
def link(size, boxes, kept, links):
    """Link a preorder tree both ways, down to the nodes that are `kept` as they are.

    Returns how many nodes were linked; those below are left out, and their parents are -1.
    """
    nodes = np.int64(0)
    links.parent[:] = -1
    waiting = np.empty(len(size), np.int32)
    waiting[0] = 0
    held = 1
    while held > 0:
        held -= 1
        p = waiting[held]
        nodes += 1
        for k in range(6):
            links.boxes[p, k] = boxes[p, k]
        if size[p] == 1 or kept[p]:
            links.children[p, 0] = -1
            links.children[p, 1] = -1
            continue
        left = p + 1
        right = p + 2 * size[left]
        links.children[p, 0] = left
        links.children[p, 1] = right
        links.parent[left] = p
        links.parent[right] = p
        waiting[held] = right
        waiting[held + 1] = left
        held += 2
    return nodes


@inlined
def sibling(links, p):
    """The other child of a node's parent."""
    parent = links.parent[p]
    other = links.children[parent, 0]
    return links.children[parent, 1] if other == p else other


@helper
def best_place(links, x, most, search):
    """Where a subtree would save most: the node that it would become the sibling of, and what that saves.

    Args:
        links: The tree.
        x: The subtree's root, neither the tree's nor a child of it.
        most: How many places to look at; the best of these is taken.
        search: Room.

    Returns:
        The node, -1 where none saves anything, and the half area saved over all nodes.
    """
    own = area_of(links.boxes, x)
    there = sibling(links, x)
    pivot = links.parent[x]
    best = 0.0
    place = np.int32(-1)
    # With x goes its parent; the boxes above shrink to what `search.box` holds.
    saved = area_of(links.boxes, pivot)
    for k in range(6):
        search.box[0, k] = links.boxes[there, k]
    out = there
    looked = 0
    while True:
        # Look at `out` and what is below it: a new parent is paid, and what the boxes on the way grow by.
        search.node[0] = out
        search.saved[0] = saved
        held = 1
        while held > 0:
            held -= 1
            node = search.node[held]
            before = search.saved[held]
            looked += 1
            if before - own <= best:
                continue
            gain = before - joined_area(links.boxes, x, node)
            if gain > best and node != there:
                best = gain
                place = node
            below = gain + area_of(links.boxes, node)
            if below - own > best and links.children[node, 0] >= 0 and held + 2 <= len(search.node):
                search.node[held] = links.children[node, 0]
                search.node[held + 1] = links.children[node, 1]
                search.saved[held] = below
                search.saved[held + 1] = below
                held += 2
        # Go up: the box at the pivot shrinks, unless x is put beside it; its sibling is next.
        if links.parent[pivot] < 0 or looked >= most:
            return place, best
        if pivot != links.parent[x]:
            saved -= area_of(search.box, 0)
            if saved > best:
                best = saved
                place = pivot
            saved += area_of(links.boxes, pivot)
        out = sibling(links, pivot)
        pivot = links.parent[pivot]
        for k in range(3):
            search.box[0, k] = min(search.box[0, k], links.boxes[out, k])
            search.box[0, 3 + k] = max(search.box[0, 3 + k], links.boxes[out, 3 + k])


@inlined
def box_anew(links, p):
    """Box a node around its children; return whether that changed it."""
    left, right = links.children[p, 0], links.children[p, 1]
    changed = False
    for k in range(3):
        low = min(links.boxes[left, k], links.boxes[right, k])
        high = max(links.boxes[left, 3 + k], links.boxes[right, 3 + k])
        changed = changed or low != links.boxes[p, k] or high != links.boxes[p, 3 + k]
        links.boxes[p, k] = low
        links.boxes[p, 3 + k] = high
    return changed


@helper
def refit(links, p):
    """Box a node and those above it anew, as far up as boxes change."""
    while p >= 0 and box_anew(links, p):
        p = links.parent[p]


@inlined
def put_in_place(links, old, new):
    """Make the parent of a node have another in its place."""
    parent = links.parent[old]
    side = 0 if links.children[parent, 0] == old else 1
    links.children[parent, side] = new
    links.parent[new] = parent


@helper
def move(links, x, place):
    """Make a subtree the sibling of another node; its old parent is the parent of both."""
    parent = links.parent[x]
    above = links.parent[parent]
    put_in_place(links, parent, sibling(links, x))
    refit(links, above)
    put_in_place(links, place, parent)
    links.children[parent, 0] = place
    links.children[parent, 1] = x
    links.parent[place] = parent
    links.parent[x] = parent
    # Its old box was of another place: that it stays the same says nothing of those above.
    box_anew(links, parent)
    refit(links, links.parent[parent])


@kernel
def move_each(links, nodes, least, most, search):
    """Move subtrees, one after the other, each to where it saves most half area.

    Args:
        links: The tree, changed.
        nodes: (k,) int32, the roots of the subtrees; the tree's root and its children are passed over.
        least: No move that saves less than this part of the area of a subtree's parent.
        most: See `best_place`.
        search: Room.

    Returns:
        How many were moved, and the half area saved.
    """
    moved = 0
    saved = 0.0
    for x in nodes:
        parent = links.parent[x]
        if parent < 0 or links.parent[parent] < 0:
            continue
        place, gain = best_place(links, x, most, search)
        if place >= 0 and gain > least * area_of(links.boxes, parent):
            move(links, x, place)
            moved += 1
            saved += gain
    return moved, saved


@kernel
def inner_area(links):
    """The sum of half areas of all nodes with children."""
    total = 0.0
    for p in range(len(links.parent)):
        if (p == 0 or links.parent[p] >= 0) and links.children[p, 0] >= 0:
            total += area_of(links.boxes, p)
    return total


@kernel
def areas(links, nodes):
    """Half areas of nodes, (k,) float64."""
    found = np.empty(len(nodes))
    for k in range(len(nodes)):
        found[k] = area_of(links.boxes, nodes[k])
    return found


@kernel
def in_preorder(links, size, boxes, order):
    """Number the nodes of a linked tree in preorder again.

    Args:
        links: The tree; nodes that were kept as they are stand for what is below them in the old one.
        size: (2n-1,) int32 of the old tree, in preorder.
        boxes: (2n-1, 6) float32 of the old tree.
        order: (n,) int32, the item at each leaf of the old tree.

    Returns:
        Size, boxes and order of the new one.
    """
    nodes = len(size)
    new_size = np.empty(nodes, np.int32)
    new_boxes = np.empty((nodes, 6), np.float32)
    new_order = np.empty(len(order), np.int32)
    # Of each old node the first leaf below it.
    first = np.empty(nodes, np.int32)
    first[0] = 0
    for p in range(nodes):
        if size[p] > 1:
            first[p + 1] = first[p]
            first[p + 2 * size[p + 1]] = first[p] + size[p + 1]
    # Walk down, left before right; sizes of inner nodes come last, from below.
    waiting = np.empty(nodes, np.int32)
    above = np.empty(nodes, np.int32)
    parent = np.full(nodes, -1, np.int32)
    waiting[0] = 0
    above[0] = -1
    held = 1
    place = 0
    leaf = 0
    while held > 0:
        held -= 1
        p = waiting[held]
        parent[place] = above[held]
        if links.children[p, 0] >= 0:
            new_size[place] = 0
            new_boxes[place] = links.boxes[p]
            waiting[held] = links.children[p, 1]
            above[held] = place
            waiting[held + 1] = links.children[p, 0]
            above[held + 1] = place
            held += 2
            place += 1
            continue
        for k in range(2 * size[p] - 1):
            new_size[place + k] = size[p + k]
            new_boxes[place + k] = boxes[p + k]
        for k in range(size[p]):
            new_order[leaf + k] = order[first[p] + k]
        place += 2 * size[p] - 1
        leaf += size[p]
    for p in range(nodes - 1, 0, -1):
        if parent[p] >= 0:
            new_size[parent[p]] += new_size[p]
    return new_size, new_boxes, new_order
