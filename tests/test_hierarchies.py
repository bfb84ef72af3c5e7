"""The hierarchy over strips, its expansion to triangles, and the checks that prove both."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from striptools.errors import UnreadableSceneError, UsageError
from striptools.hierarchies.check import check_binary_tree, check_strip_hierarchy
from striptools.hierarchies.in_strip import BinaryTree, expand_hierarchy
from striptools.hierarchies.strip_bvh import StripHierarchy, build_strip_hierarchy
from striptools.partition.boxes import range_boxes
from striptools.partition.sah import PartitionOptions


def random_boxes(count, seed, lattice):
    random = np.random.default_rng(seed)
    low = random.integers(0, lattice, (count, 3)) / np.float32(8)
    return np.concatenate([low, low + random.integers(0, 3, (count, 3))], axis=1).astype(np.float32)


@st.composite
def strips_of_boxes(draw):
    """Triangle boxes in strips, and the hierarchy over the strips, all in file order."""
    lengths = np.array(draw(st.lists(st.integers(1, 20), min_size=1, max_size=30)), np.int32)
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    boxes = random_boxes(starts[-1], draw(st.integers(0, 2**32 - 1)), draw(st.sampled_from([1, 4, 1000])))
    order, hierarchy = build_strip_hierarchy(range_boxes(boxes, starts), lengths, PartitionOptions())
    boxes = np.concatenate([boxes[starts[strip] : starts[strip + 1]] for strip in order])
    starts = np.concatenate([[0], np.cumsum(lengths[order])]).astype(np.int32)
    return boxes, starts, hierarchy


def expanded_slowly(hierarchy, starts):
    """The triangles below each node in preorder, by plain recursion from the definition."""
    sizes, places = [], {}

    def triangles(count):
        sizes.append(count)
        if count > 1:
            triangles((count + 1) // 2)
            triangles(count // 2)

    def strips(node, first, count):
        if count == 1:
            triangles(int(starts[first + 1] - starts[first]))
            return
        places[node] = len(sizes)
        sizes.append(int(starts[first + count] - starts[first]))
        left = int(hierarchy.left_count[node])
        strips(node + 1, first, left)
        strips(node + left, first + left, count - left)

    strips(0, 0, len(starts) - 1)
    return sizes, [places[node] for node in range(len(hierarchy.left_count))]


@given(strips_of_boxes())
def test_the_hierarchy_holds_its_strips_and_the_expansion_its_triangles(case):
    boxes, starts, hierarchy = case
    check_strip_hierarchy(hierarchy, range_boxes(boxes, starts))
    tree = expand_hierarchy(hierarchy, starts, boxes)
    check_binary_tree(tree, boxes)
    assert tree.triangle_count == len(boxes)
    assert hierarchy.strip_count == len(starts) - 1


@given(strips_of_boxes())
def test_fast_expansion_equals_the_definition(case):
    boxes, starts, hierarchy = case
    tree = expand_hierarchy(hierarchy, starts, boxes)
    sizes, places = expanded_slowly(hierarchy, starts)
    np.testing.assert_array_equal(tree.size, sizes)
    np.testing.assert_array_equal(tree.boxes[places], hierarchy.boxes)


@given(strips_of_boxes())
def test_boxes_are_exact(case):
    boxes, starts, hierarchy = case
    tree = expand_hierarchy(hierarchy, starts, boxes)
    first = np.cumsum(tree.size == 1) - (tree.size == 1)
    for node, (begin, count) in enumerate(zip(first, tree.size, strict=True)):
        below = boxes[begin : begin + count]
        np.testing.assert_array_equal(tree.boxes[node, :3], below[:, :3].min(axis=0))
        np.testing.assert_array_equal(tree.boxes[node, 3:], below[:, 3:].max(axis=0))


@given(st.lists(st.integers(1, 9), min_size=1, max_size=40), st.integers(0, 2**32 - 1))
def test_the_order_names_each_strip_once(lengths, seed):
    boxes = random_boxes(len(lengths), seed, 4)
    order, hierarchy = build_strip_hierarchy(boxes, np.array(lengths, np.int32), PartitionOptions())
    np.testing.assert_array_equal(np.sort(order), np.arange(len(lengths)))
    check_strip_hierarchy(hierarchy, boxes[order])


def example(strips=12):
    lengths = np.arange(1, strips + 1, dtype=np.int32)
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    boxes = random_boxes(starts[-1], 7, 1000)
    order, hierarchy = build_strip_hierarchy(range_boxes(boxes, starts), lengths, PartitionOptions())
    boxes = np.concatenate([boxes[starts[strip] : starts[strip + 1]] for strip in order])
    starts = np.concatenate([[0], np.cumsum(lengths[order])]).astype(np.int32)
    return boxes, starts, hierarchy


@pytest.mark.parametrize("count", [0, 12, 2**32 - 1])
def test_an_empty_child_is_found(count):
    boxes, starts, hierarchy = example()
    left = hierarchy.left_count.copy()
    left[0] = count
    broken = replace(hierarchy, left_count=left)
    with pytest.raises(UnreadableSceneError, match=r"node 0.*empty child"):
        check_strip_hierarchy(broken, range_boxes(boxes, starts))
    with pytest.raises(UsageError, match="empty child"):
        expand_hierarchy(broken, starts, boxes)


@pytest.mark.parametrize("node", range(11))
@pytest.mark.parametrize("plane", range(6))
def test_a_box_a_little_too_small_is_found(node, plane):
    boxes, starts, hierarchy = example()
    small = hierarchy.boxes.copy()
    small[node, plane] = np.nextafter(small[node, plane], np.float32(np.inf if plane < 3 else -np.inf))
    with pytest.raises(UnreadableSceneError, match=f"node {node}: .*does not hold"):
        check_strip_hierarchy(replace(hierarchy, boxes=small), range_boxes(boxes, starts))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_box_that_is_not_finite_is_found(value):
    boxes, starts, hierarchy = example()
    broken = hierarchy.boxes.copy()
    broken[3, 2] = value
    with pytest.raises(UnreadableSceneError, match=r"node 3.*not finite"):
        check_strip_hierarchy(replace(hierarchy, boxes=broken), range_boxes(boxes, starts))


def test_another_number_of_strips_is_found():
    boxes, starts, hierarchy = example()
    with pytest.raises(UnreadableSceneError, match="node for each strip"):
        check_strip_hierarchy(hierarchy, range_boxes(boxes, starts)[:-1])
    with pytest.raises(UsageError, match="12 strips does not fit 11"):
        expand_hierarchy(hierarchy, starts[:-1], boxes)


def test_every_changed_size_of_a_binary_tree_is_found():
    boxes, starts, hierarchy = example(5)
    tree = expand_hierarchy(hierarchy, starts, boxes)
    for node in range(len(tree.size)):
        for size in (-1, 0, 1, 2, 3, len(boxes), 2**31 - 1):
            changed = tree.size.copy()
            changed[node] = size
            if size != tree.size[node]:
                with pytest.raises(UnreadableSceneError):
                    check_binary_tree(BinaryTree(tree.boxes, changed), boxes)


@pytest.mark.parametrize("plane", range(6))
def test_every_shrunk_box_of_a_binary_tree_is_found(plane):
    boxes, starts, hierarchy = example(5)
    tree = expand_hierarchy(hierarchy, starts, boxes)
    for node in range(len(tree.size)):
        changed = tree.boxes.copy()
        changed[node, plane] = np.nextafter(
            changed[node, plane], np.float32(np.inf if plane < 3 else -np.inf)
        )
        with pytest.raises(UnreadableSceneError, match=f"node {node}: a box does not hold"):
            check_binary_tree(BinaryTree(changed, tree.size), boxes)
        # The parent is named here, because no box holds one that is not a number.
        changed[node, plane] = np.nan
        with pytest.raises(UnreadableSceneError, match="a box does not hold"):
            check_binary_tree(BinaryTree(changed, tree.size), boxes)


def test_a_tree_over_other_triangles_is_found():
    boxes, starts, hierarchy = example(5)
    tree = expand_hierarchy(hierarchy, starts, boxes)
    with pytest.raises(UnreadableSceneError, match="one leaf a triangle"):
        check_binary_tree(tree, boxes[:-1])
    with pytest.raises(UnreadableSceneError, match="does not hold its triangle"):
        check_binary_tree(tree, boxes + np.float32(1))


def test_one_triangle_is_a_tree():
    empty = StripHierarchy(np.zeros((0, 6), np.float32), np.zeros(0, np.uint32))
    box = random_boxes(1, 0, 4)
    tree = expand_hierarchy(empty, np.array([0, 1], np.int32), box)
    check_binary_tree(tree, box)
    check_strip_hierarchy(empty, box)
    np.testing.assert_array_equal(tree.boxes, box)


def test_a_chain_as_deep_as_it_is_long_is_no_matter():
    strips = 5000
    left = np.ones(strips - 1, np.uint32)
    boxes = np.tile(np.array([[0, 0, 0, 1, 1, 1]], np.float32), (strips, 1))
    hierarchy = StripHierarchy(boxes[1:], left)
    check_strip_hierarchy(hierarchy, boxes)
    check_binary_tree(expand_hierarchy(hierarchy, np.arange(strips + 1, dtype=np.int32), boxes), boxes)
