"""The loose octree: its key, both theorems, its cells, and the hierarchy that is built from them."""

from dataclasses import replace
from itertools import combinations, pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import scenes
from strategies import stack

from striptools.errors import UnreadableSceneError, UsageError
from striptools.hierarchies.binary import LEAF_COST, check_binary_nodes
from striptools.hierarchies.loose_octree import (
    LooseBvh,
    build_linear_bvh,
    build_loose_octree,
    build_sah_bvh,
    check_loose,
)
from striptools.hierarchies.options import HierarchyOptions
from striptools.kernels.binary_nodes import DEEPEST
from striptools.kernels.loose_octree import FINER_BITS, LEVELS, depth_first_keys, place_words
from striptools.kernels.morton import morton_codes, radix_order
from striptools.partition.boxes import face_boxes, range_boxes
from striptools.partition.sah import half_area

BUILDERS = (build_loose_octree, build_linear_bvh, build_sah_bvh)


# ---- The key and the theorems of the paper, on nodes (level, code) of a binary tree of L' levels.


def nodes_depth_first(depth):
    """All nodes of a complete binary tree, by plain recursion."""
    found = []

    def visit(level, code):
        found.append((level, code))
        if level < depth:
            visit(level + 1, 2 * code)
            visit(level + 1, 2 * code + 1)

    visit(0, 0)
    return found


def key_of(node, depth):
    level, code = node
    adjusted = code << (depth - level)
    return level - adjusted.bit_count() + 2 * adjusted


def common_prefix(one, other, depth):
    """How many leading bits m' of both share."""
    m, n = (code << (depth - level) for level, code in (one, other))
    return depth - (m ^ n).bit_length()


def theta(one, other, depth):
    return min(other[0], common_prefix(one, other, depth))


def eta(one, other, depth):
    """The level of the lowest common ancestor, by going up."""
    (a, m), (b, n) = one, other
    while (a, m) != (b, n):
        if a >= b:
            a, m = a - 1, m >> 1
        else:
            b, n = b - 1, n >> 1
    return a


def descends(node, ancestor):
    return node[0] >= ancestor[0] and node[1] >> (node[0] - ancestor[0]) == ancestor[1]


def triples_that_fail(nodes, depth, measure, same_side=False):
    """Triples h < i < j, of nodes by key, where a measure does not stand for eta, or ties wrongly."""
    failed = []
    for h, i, j in combinations(nodes, 3):
        if same_side:
            i, h = h, i
        here, there = measure(i, h, depth), measure(i, j, depth)
        as_eta = np.sign(eta(i, h, depth) - eta(i, j, depth))
        tie_is_right = here != there or (descends(i, h) and descends(j, h) and not descends(j, i))
        if np.sign(here - there) != as_eta or not (tie_is_right or same_side):
            failed.append((h, i, j))
    return failed


@pytest.mark.parametrize("depth", range(11))
def test_the_key_is_the_place_in_the_depth_first_order(depth):
    nodes = nodes_depth_first(depth)
    assert [key_of(node, depth) for node in nodes] == list(range(len(nodes)))
    cells = [((2 * code + 1) << (depth - level)) << FINER_BITS for level, code in nodes]
    words, keys = np.array(cells, np.uint64), np.zeros(len(nodes), np.uint64)
    depth_first_keys(words, 0, len(words), 0, depth, keys)
    np.testing.assert_array_equal(keys, np.arange(len(nodes)) << FINER_BITS)


@pytest.mark.parametrize("depth", range(1, 6))
def test_theta_may_stand_for_eta_and_ties_only_below_the_cell_before(depth):
    assert triples_that_fail(nodes_depth_first(depth), depth, theta) == []


@st.composite
def distinct_nodes(draw):
    depth = draw(st.integers(1, LEVELS))
    levels = draw(st.lists(st.integers(0, depth), min_size=3, max_size=12))
    near = draw(st.integers(0, 2**depth - 1))
    nodes = set()
    for level in levels:
        # Most of them on one way down or beside it.
        code = near if draw(st.booleans()) else draw(st.integers(0, 2**depth - 1))
        nodes.add((level, (code >> (depth - level)) ^ draw(st.integers(0, min(1, 2**level - 1)))))
    return depth, sorted(nodes, key=lambda node: key_of(node, depth))


@given(distinct_nodes())
def test_theorems_hold_for_any_nodes_of_distinct_keys(drawn):
    depth, nodes = drawn
    assert triples_that_fail(nodes, depth, theta) == []


def test_theorems_fail_for_the_plain_prefix_without_their_premise_and_for_equal_keys():
    nodes = nodes_depth_first(3)
    assert triples_that_fail(nodes, 3, common_prefix)
    assert triples_that_fail(nodes, 3, theta, same_side=True)
    twice = [node for node in nodes for _ in range(2)]
    assert triples_that_fail(twice, 3, theta)


# ---- Cells.


def words_of(boxes, low, side, by_extent=True):
    words = np.zeros(len(boxes), np.uint64)
    place_words(boxes, 0, len(boxes), np.array(low, np.float64), side, by_extent, words)
    return [int(word) for word in words]


def level_and_code(word):
    cell = word >> FINER_BITS
    spare = (cell & -cell).bit_length() - 1
    return LEVELS - spare, cell >> (spare + 1)


def cell_box(level, code, loose):
    """The corners of a binary cell of the unit cube, in exact binary fractions."""
    low, high = [0.0, 0.0, 0.0], [1.0, 1.0, 1.0]
    for step in range(level):
        axis = step % 3
        middle = (low[axis] + high[axis]) / 2
        if code >> (level - 1 - step) & 1:
            low[axis] = middle
        else:
            high[axis] = middle
    more = [(end - begin) / 2 * loose for begin, end in zip(low, high, strict=True)]
    return [low[k] - more[k] for k in range(3)] + [high[k] + more[k] for k in range(3)]


def holds(outer, inner):
    return all(outer[k] <= inner[k] and outer[k + 3] >= inner[k + 3] for k in range(3))


def finest_cell(box):
    """The finest loose cell that holds a box, by trying all levels from the finest up."""
    centre = (box[:3].astype(np.float64) + box[3:]) / 2
    grid = [min(int(c * 2**16), 2**16 - 1) for c in centre]
    for level in range(LEVELS, -1, -1):
        code = 0
        for step in range(level):
            code = 2 * code + (grid[step % 3] >> (15 - step // 3) & 1)
        if holds(cell_box(level, code, loose=1), box):
            return level, code
    raise AssertionError("the root's loose cell holds everything inside the root's")


@st.composite
def unit_boxes(draw):
    """Boxes on a lattice of the unit cube, of any size, some of them points or flat."""
    exponent = draw(st.integers(1, 17))
    rows = []
    for _ in range(draw(st.integers(1, 12))):
        ends = [sorted(draw(st.tuples(*[st.integers(0, 2**exponent)] * 2))) for _ in range(3)]
        if draw(st.booleans()):
            ends = [(a, min(b, a + draw(st.integers(0, 3)))) for a, b in ends]
        rows.append([a for a, _ in ends] + [b for _, b in ends])
    return (np.array(rows) * 2.0**-exponent).astype(np.float32)


@given(unit_boxes())
def test_an_object_goes_to_the_finest_loose_cell_that_holds_it(boxes):
    found = [level_and_code(word) for word in words_of(boxes, [0, 0, 0], 1.0)]
    assert found == [finest_cell(box) for box in boxes]


def test_every_bit_of_a_code_of_63_bits_counts():
    steps = np.random.default_rng(3).permutation(64)
    points = (1 + np.float32(2.0**-21) * np.stack([steps, steps // 2, steps // 4], axis=1)) / 2
    boxes = np.concatenate([points, points], axis=1).astype(np.float32)
    boxes = np.concatenate([boxes, [[0, 0, 0, 0, 0, 0], [1, 1, 1, 1, 1, 1]]]).astype(np.float32)
    codes = morton_codes(boxes, np.zeros(3), np.ones(3))
    assert len(np.unique(codes)) > 32
    for build in (build_loose_octree, build_linear_bvh):
        np.testing.assert_array_equal(build(boxes).order, radix_order(codes))


# ---- The hierarchy.


def closeness(words, places):
    """How close objects at two places are: the level of the common cell, then finer bits, then places."""
    one, other = (words[place] for place in places)
    if one == other:
        return 2, 64 - (places[0] ^ places[1]).bit_length()
    if one >> FINER_BITS == other >> FINER_BITS:
        return 1, 64 - (one ^ other).bit_length()
    return 0, eta(level_and_code(one), level_and_code(other), LEVELS)


def built_slowly(boxes, words, keys):
    """Nodes of one object a leaf, by recursion: a range is split where its neighbours are least close."""
    order = sorted(range(len(boxes)), key=lambda item: (keys[item], item))
    words = [words[item] for item in order]
    close = [closeness(words, pair) for pair in pairwise(range(len(order)))]
    rows = []

    def build(first, end):
        inside = boxes[order[first:end]]
        rows.append([*inside[:, :3].min(axis=0), *inside[:, 3:].max(axis=0), first, end - first])
        if end - first > 1:
            # The first of the least: what lies in a cell is split from all that lies below it.
            middle = min(range(first, end - 1), key=lambda place: close[place]) + 1
            here = len(rows) - 1
            build(first, middle)
            rows[here][6:] = [len(rows), 0]
            build(middle, end)

    build(0, len(order))
    nodes = np.zeros((len(rows), 8), np.uint32)
    nodes[:, :6] = np.array([row[:6] for row in rows], np.float32).view(np.uint32)
    nodes[:, 6:] = [row[6:] for row in rows]
    return order, nodes


@st.composite
def any_boxes(draw):
    """Boxes of very different size on a lattice, some equal, some points, some nearly everything."""
    random = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    count, lattice = draw(st.integers(1, 120)), draw(st.sampled_from([1, 4, 1000, 10**6]))
    low = random.integers(-lattice, lattice + 1, (count, 3)).astype(np.float64)
    size = lattice * 2.0 ** random.integers(-12, 2, (count, 1)) * random.integers(0, 3, (count, 3))
    boxes = np.concatenate([low, low + size], axis=1)
    boxes = boxes[random.integers(0, count, count)] if draw(st.booleans()) else boxes
    return (boxes * draw(st.sampled_from([1.0, 1e-30, 1e25])) + draw(st.sampled_from([0.0, 1e4]))).astype(
        np.float32
    )


def keys_slowly(boxes, by_extent):
    low = boxes[:, :3].min(axis=0).astype(np.float64)
    side = float((boxes[:, 3:] - low).max()) or 1.0
    words = words_of(boxes, low, side, by_extent)
    keys = [(key_of(level_and_code(word), LEVELS), word & (2**FINER_BITS - 1)) for word in words]
    return words, keys


@given(any_boxes())
def test_the_sweep_equals_the_recursion(boxes):
    for build, by_extent in ((build_loose_octree, True), (build_linear_bvh, False)):
        built = build(boxes, leaf_size=1)
        order, nodes = built_slowly(boxes, *keys_slowly(boxes, by_extent))
        np.testing.assert_array_equal(np.arange(len(boxes)) if built.order is None else built.order, order)
        np.testing.assert_array_equal(built.nodes, nodes)


@given(any_boxes(), st.sampled_from([None, 1, 3]))
def test_every_hierarchy_is_whole(boxes, leaf_size):
    for build in BUILDERS:
        built = build(boxes, leaf_size=leaf_size)
        check_loose(built, boxes)
        assert built.nodes[:, 7].max() <= (leaf_size or 8)
        assert built.nodes.flags.c_contiguous


def cheapest(nodes, most):
    """Cost, first object and number of objects of the tree with the best leaves, by recursion."""
    area = half_area(nodes[:, :6].view(np.float32))

    def visit(node):
        if nodes[node, 7]:
            return LEAF_COST * area[node], int(nodes[node, 7])
        (left, a), (right, b) = visit(node + 1), visit(int(nodes[node, 6]))
        inner = left + right + area[node]
        return (min(inner, LEAF_COST * area[node]) if a + b <= most else inner), a + b

    return visit(0)


@given(any_boxes())
def test_leaves_are_joined_where_that_is_cheaper(boxes):
    for build in BUILDERS:
        single, joined = build(boxes, leaf_size=1), build(boxes)
        assert joined.nodes[:, 7].sum() == len(boxes)
        ours, _ = cheapest(joined.nodes, 1)
        best, _ = cheapest(single.nodes, 8)
        assert ours == pytest.approx(best, rel=1e-12)


@given(scenes(), st.sampled_from(["triangles", "strips", "blocks"]))
def test_any_objects_of_a_scene(drawn, over):
    _, scene = drawn
    boxes = range_boxes(scene.triangle_boxes(), scene.objects(over))
    built = build_loose_octree(boxes, HierarchyOptions("loose-octree", over=over))
    assert built.over == over
    assert over == "triangles" or built.nodes[:, 7].max() == 1
    check_loose(built, boxes)


def test_equal_objects_make_a_balanced_tree():
    boxes = face_boxes(*stack(1000))
    built = build_loose_octree(boxes, leaf_size=1)
    check_loose(built, boxes)
    assert built.order is None
    assert deepest_leaf(built.nodes) == 10


def deepest_leaf(nodes, node=0):
    if nodes[node, 7]:
        return 0
    return 1 + max(deepest_leaf(nodes, child) for child in (node + 1, int(nodes[node, 6])))


def plates(count=4000, seed=5):
    """A sheet of small boxes, and among them plates half as long and wide as the sheet."""
    random = np.random.default_rng(seed)
    low = random.random((count, 3)) * [1, 1, 0.02]
    large = np.arange(count)[:, None] < count // 50
    size = np.where(large, [0.5, 0.5, 0.0], 0.004) * random.random((count, 3))
    return np.concatenate([low, low + size], axis=1).astype(np.float32)[random.permutation(count)]


def rods(count=4000, seed=5):
    """Small boxes, and among them thin rods along the axes."""
    random = np.random.default_rng(seed)
    low = random.random((count, 3))
    size = np.where(np.arange(count)[:, None] < count // 10, np.eye(3)[random.integers(0, 3, count)] * 0.6, 0)
    return np.concatenate([low, low + size + 0.003], axis=1).astype(np.float32)[random.permutation(count)]


def cost_of(built):
    area = half_area(built.nodes[:, :6].view(np.float32))
    return area.sum() / area[0]


@pytest.mark.parametrize("boxes", [plates(), rods()])
def test_where_sizes_are_mixed_it_is_cheaper_than_by_centres_alone(boxes):
    loose, linear, sah = (cost_of(build(boxes, leaf_size=1)) for build in BUILDERS)
    assert loose < 0.8 * linear
    assert loose < 1.1 * sah


def test_threads_do_not_matter():
    boxes = plates(40000)
    one, three = (build_loose_octree(boxes, threads=threads) for threads in (1, 3))
    np.testing.assert_array_equal(one.nodes, three.nodes)
    np.testing.assert_array_equal(one.order, three.order)


def test_the_largest_boxes_there_are():
    largest = np.finfo(np.float32).max
    boxes = np.array([[-largest] * 3 + [largest] * 3, [0] * 6, [1e-45] * 6, [-largest] * 6], np.float32)
    for build in BUILDERS:
        check_loose(build(boxes), boxes)


@pytest.mark.parametrize("build", BUILDERS)
@pytest.mark.parametrize(
    "boxes",
    [
        np.zeros((0, 6), np.float32),
        np.zeros((3, 4), np.float32),
        np.array([[0, 0, 0, 1, np.nan, 1]], np.float32),
        np.array([[0, 0, 0, 1, 1, np.inf]], np.float32),
        np.array([[0, 0, 0, 1, 1, 1], [0, 2, 0, 1, 1, 1]], np.float32),
    ],
)
def test_boxes_that_are_none_are_refused(build, boxes):
    with pytest.raises(UsageError, match="box"):
        build(boxes)


# ---- Every fault is found.


def chain(length):
    """Nodes over `length` points whose first children are all leaves."""
    nodes = np.zeros((2 * length - 1, 8), np.uint32)
    nodes[::2, 6] = np.arange(2, 2 * length + 1, 2)
    nodes[1::2, 6] = np.arange(length - 1)
    nodes[1::2, 7] = 1
    nodes[-1, 6:] = length - 1, 1
    return nodes, np.zeros((length, 6), np.float32)


def good():
    boxes = plates(50)
    return build_loose_octree(boxes, leaf_size=3), boxes


def inner_and_leaf(built):
    is_inner = built.nodes[:, 7] == 0
    pairs = np.flatnonzero(is_inner[:-1] & is_inner[1:])
    return int(pairs[len(pairs) // 2]), int(np.flatnonzero(~is_inner)[3])


def break_box(built, inner, leaf):
    built.nodes[inner, :6].view(np.float32)[3] -= 1


def break_leaf_box(built, inner, leaf):
    built.nodes[leaf, :6].view(np.float32)[0] += 1


def break_box_by_nan(built, inner, leaf):
    built.nodes[0, :6].view(np.float32)[4] = np.nan


def break_second_child(built, inner, leaf):
    built.nodes[inner, 6] = inner + 2


def break_to_itself(built, inner, leaf):
    built.nodes[inner, 6] = inner


def break_to_nowhere(built, inner, leaf):
    built.nodes[inner, 6] = 2**32 - 1


def break_leaf_first(built, inner, leaf):
    built.nodes[leaf, 6] += 1


def break_leaf_count(built, inner, leaf):
    built.nodes[leaf, 7] = 2**32 - 1


def break_last_leaf(built, inner, leaf):
    built.nodes[-1, 7] += 1


@pytest.mark.parametrize(
    ("fault", "flaw"),
    [
        (break_box, "does not hold"),
        (break_leaf_box, "does not hold"),
        (break_box_by_nan, "does not hold"),
        (break_second_child, "preorder"),
        (break_to_itself, "preorder"),
        (break_to_nowhere, "preorder"),
        (break_leaf_first, "go on where"),
        (break_leaf_count, "go on where"),
        (break_last_leaf, "go on where"),
    ],
)
def test_a_fault_is_found(fault, flaw):
    built, boxes = good()
    fault(built, *inner_and_leaf(built))
    with pytest.raises(UnreadableSceneError, match=flaw):
        check_loose(built, boxes)


def test_faults_of_the_whole_are_found():
    built, boxes = good()
    for order in (built.order[:-1], np.zeros_like(built.order), built.order + 1):
        with pytest.raises(UnreadableSceneError, match="permutation"):
            check_loose(replace(built, order=order), boxes)
    for nodes in (built.nodes[:0], built.nodes[:, :7], built.nodes.astype(np.int64)):
        with pytest.raises(UnreadableSceneError, match="nodes are"):
            check_loose(LooseBvh("triangles", nodes, built.order), boxes)
    for nodes in (built.nodes[:-1], np.concatenate([built.nodes, built.nodes[-1:]])):
        with pytest.raises(UnreadableSceneError, match=r"preorder|go on where|ends before"):
            check_loose(LooseBvh("triangles", nodes, built.order), boxes)
    with pytest.raises(UnreadableSceneError, match="ends before"):
        check_binary_nodes(chain(1)[0], None, np.zeros((2, 6), np.float32))
    with pytest.raises(UnreadableSceneError, match="permutation"):
        check_loose(built, boxes[:-1])


def test_a_tree_that_is_too_deep_is_refused():
    check_binary_nodes(chain(DEEPEST + 1)[0], None, chain(DEEPEST + 1)[1])
    nodes, boxes = chain(DEEPEST + 2)
    with pytest.raises(UnreadableSceneError, match="deeper"):
        check_binary_nodes(nodes, None, boxes)
