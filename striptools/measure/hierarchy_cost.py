"""What a ray is expected to pay for a hierarchy, whatever its kind, by the one cost model.

Inner nodes and triangle tests count the same, each weighted by its surface area over the root's: the area of
boxes, of a kd-tree's cells, of what the slabs of a presorted tree leave of the box above it. A wide node
counts as one, though it has eight boxes.
"""

import numpy as np

from striptools.hierarchies.kdtree import KdTree
from striptools.hierarchies.packed import wide_tree
from striptools.hierarchies.presorted import Presorted
from striptools.hierarchies.slbvh import Slbvh
from striptools.hierarchies.stored import StoredHierarchy
from striptools.hierarchies.wide import EMPTY
from striptools.partition.boxes import range_boxes
from striptools.partition.sah import half_area
from striptools.reducem.check_hierarchy import cells_of
from striptools.reducem.scene import Scene
from striptools.reducem.stored_hierarchy import items_of, over_of
from striptools.types import Boxes, Counts

__all__ = ["hierarchy_cost", "presorted_regions"]


def hierarchy_cost(scene: Scene) -> float:
    """The expected cost of a ray that meets the root's box, in visits of a node.

    Args:
        scene: Of at least one triangle.
    """
    hierarchy, boxes = scene.hierarchy, scene.triangle_boxes()
    if hierarchy is None:
        return _of_wide(scene, boxes)
    if isinstance(hierarchy, Presorted):
        return _of_presorted(hierarchy, boxes)
    sizes = np.diff(scene.objects(over_of(hierarchy))).astype(np.float64)
    if isinstance(hierarchy, KdTree):
        is_leaf = hierarchy.nodes[:, 1] & 3 == 3
        held = (hierarchy.nodes[:, 1] >> 2).astype(np.int64) * is_leaf
        tests = _sums(sizes[hierarchy.references], hierarchy.nodes[:, 0].astype(np.int64) * is_leaf, held)
        return _weighted(cells_of(hierarchy), np.where(is_leaf, tests, 1.0), 0)
    is_leaf, first, held = _leaves(hierarchy)
    order = items_of(hierarchy)
    tests = _sums(sizes if order is None else sizes[order], first, held)
    root = 1 if isinstance(hierarchy, Slbvh) else 0
    visited = hierarchy.nodes.any(axis=1)
    return _weighted(hierarchy.nodes[:, :6].view(np.float32), np.where(is_leaf, tests, 1.0) * visited, root)


def _leaves(hierarchy: StoredHierarchy) -> tuple[np.ndarray, Counts, Counts]:
    """Which nodes with boxes are leaves, and which places those have."""
    nodes = hierarchy.nodes.astype(np.int64)
    if isinstance(hierarchy, Slbvh):
        is_leaf = nodes[:, 6] & 4 > 0
        return is_leaf, nodes[:, 7] * is_leaf, (nodes[:, 6] >> 3) * is_leaf
    is_leaf = nodes[:, 7] > 0
    return is_leaf, nodes[:, 6] * is_leaf, nodes[:, 7]


def _sums(values: np.ndarray, first: Counts, held: Counts) -> np.ndarray:
    """The sums of ranges of values."""
    ends = np.append(0.0, np.cumsum(values))
    return ends[first + held] - ends[first]


def _weighted(boxes: Boxes, prices: np.ndarray, root: int) -> float:
    areas = half_area(np.ascontiguousarray(boxes)).astype(np.float64)
    return float((areas * prices).sum() / areas[root]) if areas[root] > 0.0 else float(prices.sum())


def _of_wide(scene: Scene, boxes: Boxes) -> float:
    wide = wide_tree(scene.with_boxes(), boxes, scene.block_starts)
    lanes = np.ascontiguousarray(wide.boxes.transpose(0, 2, 1)).reshape(-1, 6)
    child = wide.child.reshape(-1)
    is_leaf = (child < 0) & (child != EMPTY)
    prices = np.where(child >= 0, 1.0, 0.0)
    prices[is_leaf] = wide.leaf_count[-child[is_leaf] - 1]
    root = np.concatenate([boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0)])[None]
    there = prices > 0.0
    return _weighted(np.concatenate([root, lanes[there]]), np.append(1.0, prices[there]), 0)


def _of_presorted(hierarchy: Presorted, boxes: Boxes) -> float:
    regions, owned, is_inner = presorted_regions(hierarchy, boxes)
    nodes = hierarchy.nodes
    plain = nodes[nodes[:, 7] == 0, :6].view(np.float32)
    root = np.concatenate([boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0)])[None]
    prices = np.concatenate([[0.0], np.ones(len(plain)), owned + is_inner])
    return _weighted(np.concatenate([root, plain, regions]), prices, 0)


def presorted_regions(hierarchy: Presorted, boxes: Boxes) -> tuple[Boxes, np.ndarray, np.ndarray]:
    """What the slabs on the way to each node of presorted trees leave of the box of its tree.

    Args:
        hierarchy: Sound.
        boxes: (n, 6) float32, of the triangles in file order.

    Returns:
        The regions of the nodes, tree after tree, (k, 6) float32; how many triangles each owns, (k,); and
        whether it has a child, (k,) bool.
    """
    starts = hierarchy.starts.astype(np.int64)
    counts = (np.diff(starts) + 1) // 2
    begin = np.cumsum(counts) - counts
    tree = np.repeat(np.arange(len(counts)), counts)
    number = np.arange(len(tree)) - begin[tree]
    pairs = np.append(starts[tree] + 2 * number, starts[-1])
    own = range_boxes(boxes, pairs.astype(np.int32))
    depth = np.frexp(number + 1.0)[1] - 1
    regions = range_boxes(boxes, starts.astype(np.int32))[tree]
    for level in range(int(depth.max()) + 1):
        rows = np.flatnonzero(depth == level)
        if level > 0:
            regions[rows] = regions[begin[tree[rows]] + (number[rows] - 1) // 2]
        axis = level % 3
        regions[rows, axis] = np.maximum(regions[rows, axis], own[rows, axis])
        regions[rows, axis + 3] = np.minimum(regions[rows, axis + 3], own[rows, axis + 3])
    return regions, np.diff(pairs), 2 * number + 1 < counts[tree]
