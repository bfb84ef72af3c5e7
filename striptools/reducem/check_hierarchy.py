"""The rules that a hierarchy of a section of its own keeps (SPEC.md, section 4.12).

Nodes are followed level by level, of which there may be few, so that nothing recurses and a damaged file
costs no more than a sound one. Cost: O(n log n).
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from striptools.hierarchies.kdtree import KdTree
from striptools.hierarchies.presorted import Presorted
from striptools.hierarchies.slbvh import Slbvh
from striptools.hierarchies.stored import StoredHierarchy
from striptools.partition.boxes import range_boxes
from striptools.reducem import layout
from striptools.reducem.issues import unreadable
from striptools.reducem.stored_hierarchy import hierarchy_length, items_of, over_of
from striptools.types import Boxes, Counts

if TYPE_CHECKING:
    from striptools.reducem.scene import Scene

__all__ = ["cells_of", "check_hierarchy", "hierarchy_depth"]

CHUNK = 1 << 20
"""Triangles of references that are looked at together."""

KD_LEAF = 3
SLBVH_LEAF = 4


def check_hierarchy(scene: "Scene", hierarchy: StoredHierarchy, where: str) -> None:
    """Make sure that a hierarchy reaches every triangle of a scene and that its boxes hold what is below.

    Args:
        scene: Whose triangles it is over; at least one.
        hierarchy: The one in question.
        where: What an error names as its place.

    Raises:
        UnreadableSceneError: Naming the first rule broken, by its code.
    """
    place, nodes = f"{where}: HIER", hierarchy.nodes
    width = 2 if isinstance(hierarchy, KdTree) else 8
    if nodes.ndim != 2 or nodes.shape[1] != width or len(nodes) > layout.NODE_LIMIT:
        raise unreadable("RDM562", place)
    if hierarchy_length(hierarchy) > layout.most_hierarchy_bytes(scene.triangle_count):
        raise unreadable("RDM114", place)
    objects = scene.objects(over_of(hierarchy))
    if isinstance(hierarchy, KdTree):
        return _check_cells(scene, hierarchy, objects, place)
    if isinstance(hierarchy, Presorted):
        return _check_presorted(scene, hierarchy, place)
    order = _order(items_of(hierarchy), len(objects) - 1, place)
    boxes = range_boxes(scene.triangle_boxes(), objects)[order]
    if isinstance(hierarchy, Slbvh):
        return _check_heap(hierarchy.nodes, boxes, place)
    return _check_preorder(hierarchy.nodes, boxes, place)


def hierarchy_depth(hierarchy: StoredHierarchy) -> int:
    """The nodes on the longest way down a sound hierarchy, those of presorted trees among them."""
    nodes = hierarchy.nodes
    if isinstance(hierarchy, Slbvh):
        return int(np.flatnonzero(nodes.any(axis=1))[-1]).bit_length()
    if isinstance(hierarchy, Presorted):
        below = np.frexp(((np.diff(hierarchy.starts) + 1) // 2).astype(np.float64))[1]
        if len(nodes) == 0:
            return int(below[0])
        tree, leaves = _preorder(nodes, "HIER")
        depth = np.zeros(len(nodes), np.int64)
        for number, level in enumerate(tree.levels, 1):
            depth[level] = number
        return int((depth[leaves] + below).max())
    if isinstance(hierarchy, KdTree):
        is_inner, second = nodes[:, 1] & 3 != KD_LEAF, nodes[:, 1] >> 2
    else:
        is_inner, second = nodes[:, 7] == 0, nodes[:, 6]
    left = np.where(is_inner, np.arange(1, len(nodes) + 1), -1)
    return len(_tree(left, np.where(is_inner, second.astype(np.int64), -1), 0, "HIER").levels)


@dataclass(frozen=True, eq=False)
class _Tree:
    """Nodes that are a tree.

    Attributes:
        left: (m,) int64, the first child of each; -1 for a leaf.
        right: (m,) int64, the second one.
        levels: The nodes by their depth, the root first.
    """

    left: Counts
    right: Counts
    levels: list[Counts]

    def contents(self, boxes: Boxes) -> Boxes:
        """The boxes around what is below each node, given those of leaves."""
        for level in reversed(self.levels):
            inner = level[self.left[level] >= 0]
            first, second = boxes[self.left[inner]], boxes[self.right[inner]]
            boxes[inner] = _union(first, second)
        return boxes


def _union(first: Boxes, second: Boxes) -> Boxes:
    return np.concatenate(
        [np.minimum(first[:, :3], second[:, :3]), np.maximum(first[:, 3:], second[:, 3:])], axis=1
    )


def _tree(left: Counts, right: Counts, root: int, place: str) -> _Tree:
    """Follow the children of inner nodes from the root down."""
    count = len(left)
    inner = np.flatnonzero(left >= 0)
    for child in (left[inner], right[inner]):
        outside = (child <= inner) | (child >= count)
        if outside.any():
            raise unreadable("RDM564", f"{place}: node {inner[outside][0]}")
    times = np.bincount(np.concatenate([left[inner], right[inner]]), minlength=count)
    times[root] += 1
    if (times > 1).any():
        raise unreadable("RDM564", f"{place}: node {np.flatnonzero(times > 1)[0]}")
    levels = [np.array([root])]
    while len(levels[-1]):
        if len(levels) > layout.DEEPEST_HIERARCHY:
            raise unreadable("RDM565", place)
        going = levels[-1][left[levels[-1]] >= 0]
        levels.append(np.concatenate([left[going], right[going]]))
    return _Tree(left, right, levels[:-1])


def _check_in_preorder(tree: _Tree, place: str) -> None:
    """Make sure that all nodes are reached, and stand one subtree behind the other."""
    size = np.ones(len(tree.left), np.int64)
    for level in reversed(tree.levels):
        inner = level[tree.left[level] >= 0]
        size[inner] += size[tree.left[inner]] + size[tree.right[inner]]
    inner = np.flatnonzero(tree.left >= 0)
    apart = tree.right[inner] != tree.left[inner] + size[tree.left[inner]]
    if size[0] != len(size) or apart.any():
        raise unreadable("RDM564", f"{place}: node {inner[apart][0] if apart.any() else 0}")


def _order(items: np.ndarray | None, count: int, place: str) -> np.ndarray:
    """The object at each place."""
    if items is None:
        return np.arange(count)
    if len(items) != count:
        raise unreadable("RDM562", place)
    if (items < 0).any() or (items >= count).any() or (np.bincount(items, minlength=count) != 1).any():
        raise unreadable("RDM567", place)
    return items


def _check_boxes(nodes: np.ndarray, reached: Counts, contents: Boxes, place: str) -> None:
    boxes = nodes[reached, :6].view(np.float32)
    below = contents[reached]
    held = (boxes[:, :3] <= below[:, :3]) & (boxes[:, 3:] >= below[:, 3:])
    wrong = np.flatnonzero(~held.all(axis=1))
    if len(wrong):
        raise unreadable("RDM568", f"{place}: node {reached[wrong[0]]}")


def _check_heap(nodes: np.ndarray, boxes: Boxes, place: str) -> None:
    """An SLBVH over objects with these boxes, in the order of its places."""
    count = len(nodes)
    if count < 2 or count & (count - 1):
        raise unreadable("RDM562", place)
    there = nodes.any(axis=1)
    is_leaf = there & (nodes[:, 6] & SLBVH_LEAF > 0)
    number = np.arange(count)
    inner = there & ~is_leaf
    inner[0] = False
    tree = _tree(np.where(inner, 2 * number, -1), np.where(inner, 2 * number + 1, -1), 1, place)
    reached = np.concatenate(tree.levels)
    is_reached = np.zeros(count, np.bool_)
    is_reached[reached] = True
    if (is_reached != there).any():
        raise unreadable("RDM564", f"{place}: node {np.flatnonzero(is_reached != there)[0]}")
    if (nodes[reached, 6] & 3 == 3).any() or (nodes[is_leaf, 6] & 3).any():
        raise unreadable("RDM563", place)
    held, first = (nodes[:, 6] >> 3).astype(np.int64), nodes[:, 7].astype(np.int64)
    parents = number[inner]
    left, right = 2 * parents, 2 * parents + 1
    shared = (first[left] == first[parents]) & (first[right] == first[parents] + held[left])
    shared &= held[left] + held[right] == held[parents]
    if first[1] != 0 or held[1] != len(boxes) or not shared.all() or (held[is_leaf] == 0).any():
        raise unreadable("RDM566", place)
    leaves = np.flatnonzero(is_leaf)
    contents = np.zeros((count, 6), np.float32)
    contents[leaves] = _leaf_boxes(boxes, first[leaves], held[leaves])
    _check_boxes(nodes, reached, tree.contents(contents), place)


def _leaf_boxes(boxes: Boxes, first: Counts, held: Counts) -> Boxes:
    """The boxes around leaves that have each place once between them."""
    order = np.argsort(first, kind="stable")
    around = np.zeros((len(first), 6), np.float32)
    around[order] = range_boxes(boxes, np.append(first[order], len(boxes)).astype(np.int32))
    return around


def _check_once(first: Counts, held: Counts, count: int, place: str) -> None:
    """Make sure that ranges of places have each of so many once."""
    order = np.lexsort((held, first))
    ends = np.cumsum(held[order])
    if len(first) == 0 or ends[-1] != count or (first[order] != ends - held[order]).any():
        raise unreadable("RDM566", place)


def _preorder(nodes: np.ndarray, place: str) -> tuple[_Tree, Counts]:
    """The tree of nodes with boxes in preorder, and its leaves."""
    if len(nodes) == 0:
        raise unreadable("RDM562", place)
    is_inner = nodes[:, 7] == 0
    number = np.arange(len(nodes))
    right = np.where(is_inner, nodes[:, 6].astype(np.int64), -1)
    tree = _tree(np.where(is_inner, number + 1, -1), right, 0, place)
    _check_in_preorder(tree, place)
    return tree, np.flatnonzero(~is_inner)


def _check_preorder(nodes: np.ndarray, boxes: Boxes, place: str) -> None:
    """A BVH in preorder over objects with these boxes, in the order of its places."""
    tree, leaves = _preorder(nodes, place)
    first, held = nodes[leaves, 6].astype(np.int64), nodes[leaves, 7].astype(np.int64)
    _check_once(first, held, len(boxes), place)
    contents = np.zeros((len(nodes), 6), np.float32)
    contents[leaves] = _leaf_boxes(boxes, first, held)
    _check_boxes(nodes, np.arange(len(nodes)), tree.contents(contents), place)


def _check_presorted(scene: "Scene", hierarchy: Presorted, place: str) -> None:
    starts, nodes = hierarchy.starts.astype(np.int64), hierarchy.nodes
    if len(starts) < 2 or (len(nodes) == 0 and len(starts) > 2):
        raise unreadable("RDM562", place)
    if starts[0] != 0 or starts[-1] != scene.triangle_count or (np.diff(starts) < 1).any():
        raise unreadable("RDM567", place)
    boxes = scene.triangle_boxes()
    _check_slabs(boxes, starts, place)
    if len(nodes) == 0:
        return
    tree, leaves = _preorder(nodes, place)
    first, held = nodes[leaves, 6].astype(np.int64), nodes[leaves, 7].astype(np.int64)
    if not (np.array_equal(first, starts[:-1]) and np.array_equal(held, np.diff(starts))):
        raise unreadable("RDM566", place)
    contents = np.zeros((len(nodes), 6), np.float32)
    contents[leaves] = range_boxes(boxes, starts.astype(np.int32))
    _check_boxes(nodes, np.arange(len(nodes)), tree.contents(contents), place)


def _check_slabs(boxes: Boxes, starts: Counts, place: str) -> None:
    """Make sure that the two triangles of each node span all below it on the node's axis."""
    sizes = np.diff(starts)
    counts = (sizes + 1) // 2
    begin = np.cumsum(counts) - counts
    tree = np.repeat(np.arange(len(sizes)), counts)
    number = np.arange(len(tree)) - begin[tree]
    pairs = starts[tree] + 2 * number
    own = range_boxes(boxes, np.append(pairs, len(boxes)).astype(np.int32))
    below = own.copy()
    depth = np.frexp((number + 1).astype(np.float64))[1] - 1
    by_depth = np.argsort(depth, kind="stable")
    levels = np.split(by_depth, np.cumsum(np.bincount(depth))[:-1])
    for level in reversed(levels[1:]):
        for child in (level[number[level] % 2 == 1], level[number[level] % 2 == 0]):
            parent = begin[tree[child]] + (number[child] - 1) // 2
            below[parent] = _union(below[parent], below[child])
    rows, axis = np.arange(len(own)), depth % 3
    wrong = (own[rows, axis] > below[rows, axis]) | (own[rows, axis + 3] < below[rows, axis + 3])
    if wrong.any():
        raise unreadable("RDM568", f"{place}: triangle {pairs[np.flatnonzero(wrong)[0]]}")


def _check_cells(scene: "Scene", hierarchy: KdTree, objects: Counts, place: str) -> None:
    """A kd-tree over objects that are ranges of triangles."""
    nodes, references = hierarchy.nodes, hierarchy.references.astype(np.int64)
    if len(nodes) == 0:
        raise unreadable("RDM562", place)
    axis, value = nodes[:, 1] & 3, (nodes[:, 1] >> 2).astype(np.int64)
    is_inner = axis != KD_LEAF
    number = np.arange(len(nodes))
    left = np.where(is_inner, number + 1, -1)
    tree = _tree(left, np.where(is_inner, value, -1), 0, place)
    _check_in_preorder(tree, place)
    leaves = np.flatnonzero(~is_inner)
    first, held = nodes[leaves, 0].astype(np.int64), value[leaves]
    if (first != np.cumsum(held) - held).any() or held.sum() != len(references):
        raise unreadable("RDM566", place)
    leaf = np.repeat(np.arange(len(leaves)), held)
    falls = (np.diff(references) <= 0) & (np.diff(leaf) == 0)
    if falls.any() or (references >= len(objects) - 1).any():
        raise unreadable("RDM567", place)
    root = np.concatenate([hierarchy.low, hierarchy.high])
    low, high = scene.positions.min(axis=0), scene.positions.max(axis=0)
    if not ((root[:3] <= low).all() and (root[3:] >= high).all()):
        raise unreadable("RDM568", f"{place}: node 0")
    cells = _cells(tree, nodes, axis, root, place)
    _check_corners(scene, objects, cells[leaves][leaf], references, place)


def cells_of(hierarchy: KdTree) -> Boxes:
    """The cell of each node of a sound kd-tree, (m, 6) float32."""
    nodes = hierarchy.nodes
    axis = nodes[:, 1] & 3
    right = np.where(axis != KD_LEAF, (nodes[:, 1] >> 2).astype(np.int64), -1)
    tree = _tree(np.where(axis != KD_LEAF, np.arange(1, len(nodes) + 1), -1), right, 0, "HIER")
    return _cells(tree, nodes, axis, np.concatenate([hierarchy.low, hierarchy.high]), "HIER")


def _cells(tree: _Tree, nodes: np.ndarray, axes: np.ndarray, root: np.ndarray, place: str) -> Boxes:
    """The cell of each node, (m, 6) float32."""
    cells = np.zeros((len(nodes), 6), np.float32)
    cells[0] = root
    planes = np.ascontiguousarray(nodes[:, 0]).view(np.float32)
    for level in tree.levels:
        inner = level[tree.left[level] >= 0]
        axis, plane = axes[inner].astype(np.int64), planes[inner]
        inside = (plane >= cells[inner, axis]) & (plane <= cells[inner, axis + 3])
        if not inside.all():
            raise unreadable("RDM563", f"{place}: node {inner[~inside][0]}")
        for child, side in ((tree.left[inner], 3), (tree.right[inner], 0)):
            cells[child] = cells[inner]
            cells[child, axis + side] = plane
    return cells


def _check_corners(scene: "Scene", objects: Counts, cells: Boxes, references: np.ndarray, place: str) -> None:
    """Make sure that each corner of each triangle lies in a leaf that refers to the triangle's object.

    Args:
        scene: Whose triangles they are.
        objects: (p+1,) int32, the first triangle of each object, then n.
        cells: (k, 6) float32, the cell of the leaf of each reference.
        references: (k,) the object of each.
        place: What an error names as its place.
    """
    begin, sizes = objects[references].astype(np.int64), np.diff(objects)[references].astype(np.int64)
    corners, found = scene.positions[scene.faces()], np.zeros((scene.triangle_count, 3), np.bool_)
    ends = np.cumsum(sizes)
    at = 0
    while at < len(references):
        # As many references as have a chunk of triangles between them, at least one.
        end = max(at + 1, int(np.searchsorted(ends, ends[at] - sizes[at] + CHUNK)))
        row = np.repeat(np.arange(at, end), sizes[at:end])
        triangle = begin[row] + np.arange(len(row)) - (ends - sizes - (ends[at] - sizes[at]))[row]
        cell = cells[row][:, None]
        inside = ((corners[triangle] >= cell[..., :3]) & (corners[triangle] <= cell[..., 3:])).all(axis=2)
        which, corner = np.nonzero(inside)
        found[triangle[which], corner] = True
        at = end
    if not found.all():
        raise unreadable("RDM568", f"{place}: triangle {np.flatnonzero(~found.all(axis=1))[0]}")
