"""The collapse to eight-wide nodes: whole, contained, of least cost, and the checks that say so."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import clean_meshes

from striptools.errors import UnreadableSceneError
from striptools.hierarchies.in_strip import BinaryTree
from striptools.hierarchies.wide import (
    BROAD,
    EMPTY,
    EMPTY_LANE_COST,
    LEAF_BLOCK_COST,
    WIDE_NODE_COST,
    WIDTH,
    check_wide_tree,
    collapse,
)
from striptools.partition.boxes import face_boxes, node_boxes
from striptools.partition.object_split import split_objects
from striptools.partition.sah import PartitionOptions, half_area


def binary_tree(boxes):
    """A tree over boxes, and the boxes in the order of its leaves."""
    tree = split_objects(boxes, PartitionOptions())
    return BinaryTree(node_boxes(tree, boxes), tree.size), boxes[tree.order]


def random_tree(count, seed=0):
    random = np.random.default_rng(seed)
    low = random.random((count, 3), np.float32)
    boxes = np.concatenate([low, low + random.random((count, 3), np.float32) * np.float32(0.2)], axis=1)
    return binary_tree(boxes)


def least_cost(tree, leaf_size, width):
    """The least expected cost by trying everything: the definition, not the algorithm."""
    area = half_area(tree.boxes)
    area = area / area[0]

    def children(p):
        return p + 1, p + 2 * int(tree.size[p + 1])

    def as_leaf(p):
        return area[p] * (LEAF_BLOCK_COST + EMPTY_LANE_COST * (leaf_size - tree.size[p]))

    @cache
    def alone(p):
        leaf = as_leaf(p) if tree.size[p] <= leaf_size else np.inf
        inner = area[p] * WIDE_NODE_COST + spread(p, width) if tree.size[p] > 1 else np.inf
        return min(leaf, inner)

    @cache
    def spread(p, among):
        left, right = children(p)
        return min(standing(left, k) + standing(right, among - k) for k in range(1, among))

    @cache
    def standing(p, among):
        return alone(p) if among == 1 or tree.size[p] == 1 else min(alone(p), spread(p, among))

    root = WIDE_NODE_COST * area[0]
    return root + (spread(0, width) if tree.size[0] > 1 else as_leaf(0))


@given(clean_meshes(), st.integers(1, 8), st.sampled_from([WIDTH, BROAD]))
def test_collapsed_tree_is_whole(mesh, leaf_size, width):
    tree, boxes = binary_tree(face_boxes(mesh.positions, mesh.faces))
    wide = collapse(tree, leaf_size, width)
    assert wide.child.shape == (len(wide.boxes), width)
    check_wide_tree(wide, boxes)
    assert wide.leaf_count.max() <= leaf_size
    assert 1 <= wide.depth <= len(wide.boxes)


def wide_cost(tree, leaf_size=WIDTH):
    """The expected cost of a ray that meets the root's box, in visits to a wide node."""
    used = tree.child != EMPTY
    boxes = np.moveaxis(tree.boxes, 1, 2)
    area = half_area(boxes.reshape(-1, 6)).reshape(used.shape)
    leaf = np.where(tree.child < 0, -(tree.child + 1), 0) * used
    empty = leaf_size - tree.leaf_count[leaf]
    cost = np.where(tree.child >= 0, WIDE_NODE_COST, LEAF_BLOCK_COST + EMPTY_LANE_COST * empty)
    lanes = boxes[0][used[0]]
    root = half_area(np.concatenate([lanes[:, :3].min(axis=0), lanes[:, 3:].max(axis=0)])[None])[0]
    share = area / root if root > 0 else np.ones_like(area)
    return float(WIDE_NODE_COST + (share * cost)[used].sum())


@pytest.mark.parametrize("width", [WIDTH, BROAD])
@pytest.mark.parametrize("leaf_size", [1, 2, 8])
@pytest.mark.parametrize("count", [1, 2, 8, 9, 40, 200])
def test_cost_is_the_least(count, leaf_size, width):
    tree, _ = random_tree(count, seed=count)
    least = least_cost(tree, leaf_size, width)
    assert wide_cost(collapse(tree, leaf_size, width), leaf_size) == pytest.approx(least, rel=1e-5)


def test_lanes_say_on_which_side_of_the_centre_a_child_lies():
    """Two times two times four corners of a box: sixteen children, each in the lane of its own."""
    x, y, z = np.meshgrid([-3, -1, 1, 3], [-1, 1], [-1, 1], indexing="ij")
    middle = np.stack([x, y, z], axis=-1).reshape(-1, 3).astype(np.float32)
    tree, _ = binary_tree(np.concatenate([middle - 0.5, middle + 0.5], axis=1))
    wide = collapse(tree, 1, BROAD)
    assert len(wide.child) == 1
    for lane in range(BROAD):
        centre = wide.boxes[0, :3, lane] + wide.boxes[0, 3:, lane]
        sides = (centre > 0).astype(int)
        assert [lane >> 1 & 1, lane >> 2 & 1, lane >> 3 & 1] == sides.tolist()
        # Of those on one side in x the lowest bit tells the outer from the inner, front to back.
        assert lane & 1 == int(centre[0] in (6, -2))


def test_same_input_gives_same_tree():
    tree, _ = random_tree(500)
    one, two = collapse(tree), collapse(tree)
    assert one.boxes.tobytes() == two.boxes.tobytes()
    assert one.child.tobytes() == two.child.tobytes()


def test_coordinates_near_the_largest_float_do_no_harm():
    corners = np.array([[-3e38] * 3 + [3e38] * 3] * 20, np.float32)
    tree, boxes = binary_tree(corners)
    check_wide_tree(collapse(tree), boxes)


def spoil_child(tree):
    child = tree.child.copy()
    child[0, np.flatnonzero(child[0] > 0)[0]] = 0
    return replace(tree, child=child)


def spoil_leaf_link(tree):
    child = tree.child.copy()
    at = np.argwhere((child < 0) & (child != EMPTY))
    child[tuple(at[0])] = child[tuple(at[1])]
    return replace(tree, child=child)


def spoil_count(tree):
    count = tree.leaf_count.copy()
    count[0] = 9
    return replace(tree, leaf_count=count)


def spoil_cover(tree):
    first = tree.leaf_first.copy()
    first[1] = first[0]
    return replace(tree, leaf_first=first)


def spoil_box(tree):
    boxes = tree.boxes.copy()
    lane = np.flatnonzero(tree.child[0] != EMPTY)[0]
    boxes[0, 0, lane] = np.nextafter(boxes[0, 0, lane], np.float32(np.inf))
    return replace(tree, boxes=boxes)


def spoil_empty(tree):
    boxes = tree.boxes.copy()
    node, lane = np.argwhere(tree.child == EMPTY)[0]
    boxes[node, :, lane] = 0
    return replace(tree, boxes=boxes)


@pytest.mark.parametrize(
    "spoil", [spoil_child, spoil_leaf_link, spoil_count, spoil_cover, spoil_box, spoil_empty]
)
def test_check_finds_each_flaw(spoil):
    tree, boxes = random_tree(1000)
    wide = collapse(tree)
    check_wide_tree(wide, boxes)
    with pytest.raises(UnreadableSceneError):
        check_wide_tree(spoil(wide), boxes)
