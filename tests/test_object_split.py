"""The object split against a slow twin that keeps lists and tries every split in plain NumPy."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import clean_meshes

from striptools.errors import LimitError, UsageError
from striptools.partition import object_split
from striptools.partition.boxes import face_boxes, node_boxes, range_boxes
from striptools.partition.object_split import (
    LARGEST_DEPTH,
    ObjectTree,
    check_boxes,
    check_object_tree,
    split_objects,
)
from striptools.partition.sah import PartitionOptions, expected_cost, half_area


def slow_split(boxes: np.ndarray, options: PartitionOptions, weights: np.ndarray) -> ObjectTree:
    """The tree by recursion over lists of items."""
    order: list[int] = []
    parent, size = [], []
    leaf_node = np.zeros(len(boxes), np.int32)

    def split(items: np.ndarray, above: int) -> None:
        node = len(size)
        parent.append(above)
        size.append(len(items))
        if len(items) == 1:
            leaf_node[items[0]] = node
            order.append(int(items[0]))
            return
        left = slow_left_side(boxes[items], options, weights[items])
        split(items[left], node)
        split(items[~left], node)

    split(np.arange(len(boxes)), -1)
    return ObjectTree(
        np.array(order, np.int32), leaf_node, np.array(parent, np.int32), np.array(size, np.int32)
    )


def slow_left_side(boxes: np.ndarray, options: PartitionOptions, weights: np.ndarray) -> np.ndarray:
    """Which items of a range go left, as booleans."""
    count = len(boxes)
    best, left = np.inf, np.arange(count) < (count + 1) // 2
    if count == 2:
        return left
    centres = boxes[:, :3].astype(np.float64) + boxes[:, 3:]
    for axis in range(3):
        centre = centres[:, axis]
        extent = centre.max() - centre.min()
        if extent == 0:
            continue
        if count < options.sweep_below:
            rank = np.zeros(count, int)
            rank[np.argsort(centre, kind="stable")] = np.arange(count)
        else:
            rank = ((centre - centre.min()) * (options.bins / extent)).astype(int)
            rank = np.minimum(rank, options.bins - 1)
        for place in range(rank.max()):
            side = rank <= place
            cost = slow_cost(boxes, weights, side) + slow_cost(boxes, weights, ~side)
            if cost < best:
                best, left = cost, side
    return left


def slow_cost(boxes: np.ndarray, weights: np.ndarray, side: np.ndarray) -> float:
    if not side.any():
        return np.inf
    box = np.concatenate([boxes[side, :3].min(axis=0), boxes[side, 3:].max(axis=0)])
    return half_area(box[None])[0] * int(weights[side].sum())


def equal_trees(one: ObjectTree, other: ObjectTree) -> bool:
    names = ("order", "leaf_node", "parent", "size")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


@st.composite
def item_boxes(draw: st.DrawFn) -> np.ndarray:
    """Boxes on a lattice (many ties), of any magnitude, some of them points, some of them alike."""
    count = draw(st.integers(1, 60))
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    lattice = draw(st.sampled_from([1, 2, 10, 10**6]))
    scale = np.float32(draw(st.sampled_from([1e-40, 1e-8, 1.0, 1e8, 3e31])))
    lo = random.integers(-lattice, lattice + 1, (count, 3))
    extent = random.integers(0, lattice + 1, (count, 3)) * random.integers(0, 2, (count, 1))
    return (np.concatenate([lo, lo + extent], axis=1).astype(np.float32) * scale).astype(np.float32)


some_options = st.builds(
    PartitionOptions, bins=st.sampled_from([2, 3, 16]), sweep_below=st.sampled_from([2, 5, 13])
)


def random_boxes(count: int, seed: int = 1) -> np.ndarray:
    lo = np.random.default_rng(seed).random((count, 3), np.float32)
    return np.concatenate([lo, lo + np.float32(0.01)], axis=1)


@given(item_boxes(), some_options, st.integers(0, 2**32 - 1))
def test_split_equals_the_slow_twin(boxes: np.ndarray, options: PartitionOptions, seed: int):
    weights = np.random.default_rng(seed).integers(1, 5, len(boxes)).astype(np.int32)
    tree = split_objects(boxes, options, weights)
    check_object_tree(tree)
    assert equal_trees(tree, slow_split(boxes, options, weights))


@given(clean_meshes())
def test_split_of_any_mesh_equals_the_slow_twin(mesh):
    boxes = face_boxes(mesh.positions, mesh.faces)
    tree = split_objects(boxes)
    check_object_tree(tree)
    assert equal_trees(tree, slow_split(boxes, PartitionOptions(), np.ones(len(boxes), np.int32)))


@given(item_boxes(), st.integers(2, 5))
def test_the_tree_is_the_same_for_any_number_of_threads(boxes: np.ndarray, threads: int):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(object_split, "SMALLEST_JOB", 1)
        assert equal_trees(split_objects(boxes, threads=threads), split_objects(boxes))


def test_a_large_tree_is_the_same_for_any_number_of_threads():
    boxes = random_boxes(30_000)
    one = split_objects(boxes)
    assert all(equal_trees(one, split_objects(boxes, threads=threads)) for threads in (2, 3, 8))


def test_items_with_one_centre_are_split_in_halves():
    boxes = np.tile(np.array([[0, 0, 0, 1, 1, 1]], np.float32), (100, 1))
    boxes[::2] *= np.array([-1, -1, -1, 2, 2, 2], np.float32)
    boxes[:, :3] = -boxes[:, 3:]
    tree = split_objects(boxes)
    assert tree.order.tolist() == list(range(100))
    assert tree.size[1] == 50
    assert tree.depth.max() == 7


def test_no_input_makes_a_tree_deeper_than_the_limit():
    # Each point lies twice as far out as the one before, so that every split parts a few from the rest.
    place = np.float32(2.0) ** np.arange(-140, 120, dtype=np.float32)
    tree = split_objects(np.repeat(place[:, None], 6, axis=1))
    check_object_tree(tree)
    assert 60 < tree.depth.max() <= LARGEST_DEPTH


def test_ranges_at_the_depth_limit_are_halved(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(object_split, "SAH_DEPTH", 2)
    tree = split_objects(random_boxes(4000))
    check_object_tree(tree)
    assert tree.depth.max() <= 2 + 12


def test_one_item_is_a_root_that_is_a_leaf():
    tree = split_objects(random_boxes(1))
    assert [array.tolist() for array in (tree.order, tree.leaf_node, tree.parent, tree.size)] == [
        [0],
        [0],
        [-1],
        [1],
    ]


def test_split_leaves_its_input_alone():
    boxes, weights = random_boxes(50), np.ones(50, np.int32)
    boxes.flags.writeable = weights.flags.writeable = False
    split_objects(boxes, weights=weights)


def test_the_sah_tree_is_cheaper_than_a_balanced_one():
    boxes = random_boxes(2000)
    tree = split_objects(boxes)
    halves = split_objects(np.tile(np.array([[0, 0, 0, 1, 1, 1]], np.float32), (2000, 1)))
    cost = expected_cost(node_boxes(tree, boxes), tree.size)
    assert cost < 0.2 * expected_cost(node_boxes(halves, boxes), halves.size)


@given(item_boxes())
def test_boxes_of_nodes_are_the_bounds_of_their_items(boxes: np.ndarray):
    tree = split_objects(boxes)
    nodes = node_boxes(tree, boxes)
    first = np.cumsum(tree.size == 1) - (tree.size == 1)
    for node, size in enumerate(tree.size):
        items = boxes[tree.order[first[node] : first[node] + size]]
        assert nodes[node].tolist() == [*items[:, :3].min(axis=0), *items[:, 3:].max(axis=0)]


def test_boxes_of_faces_and_ranges():
    positions = np.array([[0, 0, 0], [1, 5, -1], [2, -3, 4], [9, 9, 9]], np.float32)
    faces = np.array([[0, 1, 2], [1, 2, 3], [3, 0, 1]], np.int32)
    boxes = face_boxes(positions, faces)
    assert boxes.tolist() == [[0, -3, -1, 2, 5, 4], [1, -3, -1, 9, 9, 9], [0, 0, -1, 9, 9, 9]]
    assert range_boxes(boxes, np.array([0, 1, 3])).tolist() == [[0, -3, -1, 2, 5, 4], [0, -3, -1, 9, 9, 9]]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_boxes_that_are_not_finite_are_refused(value: float):
    boxes = random_boxes(5)
    boxes[3, 2] = value
    with pytest.raises(UsageError, match="box 3"):
        split_objects(boxes)


def test_other_boxes_that_are_refused(monkeypatch: pytest.MonkeyPatch):
    boxes = random_boxes(5)
    boxes[4, 0], boxes[4, 3] = 1, 0
    with pytest.raises(UsageError, match="box 4"):
        check_boxes(boxes)
    for shape in ((0, 6), (5, 3), (6,)):
        with pytest.raises(UsageError, match="shape"):
            check_boxes(np.zeros(shape, np.float32))
    monkeypatch.setattr(object_split, "LARGEST_ITEMS", 4)
    with pytest.raises(LimitError, match="5 items"):
        check_boxes(random_boxes(5))


@pytest.mark.parametrize("weights", [[1, 1], [1, 0, 1]])
def test_weights_that_are_refused(weights: list[int]):
    with pytest.raises(UsageError, match="weights"):
        split_objects(random_boxes(3), weights=np.array(weights, np.int32))


FAULTS = {
    "an item twice": ("order", 3, lambda tree: tree.order[4]),
    "an item that is none": ("order", 3, lambda tree: len(tree.order)),
    "a leaf of another item": ("leaf_node", 5, lambda tree: tree.leaf_node[6]),
    "an inner node as leaf": ("leaf_node", 5, lambda _: 0),
    "a root with a parent": ("parent", 0, lambda _: 1),
    "a wrong parent": ("parent", 7, lambda tree: tree.parent[7] + 1),
    "a wrong root size": ("size", 0, lambda tree: tree.size[0] - 1),
    "an empty node": ("size", 4, lambda _: 0),
    "a node larger than its parent": ("size", 1, lambda tree: tree.size[0]),
    "a leaf that is none": ("size", -1, lambda _: 2),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_check_finds_each_fault(fault: str):
    name, place, value = FAULTS[fault]
    tree = split_objects(random_boxes(20))
    array = getattr(tree, name).copy()
    array[place] = value(tree)
    with pytest.raises(UsageError, match="object tree"):
        check_object_tree(replace(tree, **{name: array}))


@pytest.mark.parametrize("name", ["order", "leaf_node", "parent", "size"])
def test_check_finds_a_missing_row(name: str):
    tree = split_objects(random_boxes(20))
    with pytest.raises(UsageError, match="object tree"):
        check_object_tree(replace(tree, **{name: getattr(tree, name)[:-1]}))
