"""Presorted geometry: its order, its proof, its walk, and the study of its levels."""

import dataclasses
import io
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rays import axial_rays, far_rays, rays_at, rays_from_inside
from shapes import SHAPES, THIN, UNITS, moved_sphere
from strategies import book, clean_meshes, cube, sphere, stack, tetrahedron
from test_hoisting import assert_hoisted
from test_trace import beyond_box, excused

import striptools
from striptools.errors import LimitError, StriptoolsError, UnreadableSceneError, UsageError
from striptools.hierarchies import presorted as module
from striptools.hierarchies.options import HierarchyOptions
from striptools.hierarchies.presorted import (
    EVERY_LEVEL,
    Presorted,
    build_presorted,
    check_presorted,
    level_limit,
    presort,
    tree_depth,
)
from striptools.kernels.presorted import plain_depth
from striptools.kernels.rays import ROW
from striptools.measure import study_presorted
from striptools.measure.exact import exact_pair
from striptools.measure.study import StudyOptions
from striptools.measure.study_presorted import PAPER, presorted_of
from striptools.mesh.clean import clean
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.partition.object_split import split_objects
from striptools.trace import Tracer
from striptools.trace import presorted as layouts
from striptools.trace.launch import program
from striptools.trace.presorted import lay_out_presorted

ALL_SHAPES = {**SHAPES, "thin": THIN}
FIELDS = ("t", "face", "u", "v")
NODE_TESTS = ("bandwidth", "direct")

levels_drawn = st.sampled_from([0, 1, 2, 3, 6, 20])


def random_corners(count, seed=0):
    return np.random.default_rng(seed).normal(size=(count, 3, 3)).astype(np.float32)


def options(levels):
    return HierarchyOptions("presorted", levels=levels)


# ---- The order.


def slow_order(boxes):
    """The paper's order of one tree over all boxes, by recursion on lists."""
    count = len(boxes)
    order = [-1] * count
    low, high = boxes[:, :3].astype(np.float64), boxes[:, 3:].astype(np.float64)

    def below(node):
        owned = max(0, min(2, count - 2 * node))
        return owned + below(2 * node + 1) + below(2 * node + 2) if owned else 0

    def sort(items, node, axis):
        if not items:
            return
        first = min(items, key=lambda i: (low[i, axis], -high[i, axis], i))
        order[2 * node] = first
        rest = [i for i in items if i != first]
        if rest:
            second = min(rest, key=lambda i: (-high[i, axis], low[i, axis], i))
            order[2 * node + 1] = second
            rest.remove(second)
        axis = (axis + 1) % 3
        rest.sort(key=lambda i: (low[i, axis] + high[i, axis], i))
        left = below(2 * node + 1)
        sort(rest[:left], 2 * node + 1, axis)
        sort(rest[left:], 2 * node + 2, axis)

    sort(list(range(count)), 0, 0)
    return np.array(order)


def boxes_of(corners):
    return np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)


def assert_sorted(corners, levels, threads=1):
    order, presorted = build_presorted(corners, options(levels), threads)
    boxes = boxes_of(corners)
    given_order = split_objects(boxes).order if levels else np.arange(len(boxes))
    starts = presorted.starts
    for begin, end in pairwise(starts):
        of_tree = given_order[begin:end]
        np.testing.assert_array_equal(order[begin:end], of_tree[slow_order(boxes[of_tree])])
    check_presorted(presorted, corners[order])
    return order, presorted


@settings(max_examples=25)
@given(clean_meshes(), levels_drawn)
def test_the_order_is_the_slow_one(mesh, levels):
    order, presorted = assert_sorted(mesh.positions[mesh.faces], levels)
    assert (order.dtype, presorted.nodes.dtype, presorted.starts.dtype) == (np.int32, np.uint32, np.int32)


@pytest.mark.parametrize("count", range(1, 36))
def test_any_count_makes_a_tree(count):
    """Counts that do not fill the heap, odd ones among them: the last node owns one triangle."""
    order, presorted = assert_sorted(random_corners(count), 0)
    assert sorted(order) == list(range(count))
    assert (len(presorted.nodes), presorted.starts.tolist()) == (0, [0, count])


def test_two_extremes_of_one_triangle_leave_the_second_place_to_the_next():
    """A triangle that spans all: the other one that is owned is the one that reaches farthest of the rest."""
    corners = random_corners(9)
    corners[4, :, 0] = [-50, 0, 50]
    corners[7, 1, 0] = 40
    order, _ = build_presorted(corners, options(0))
    assert order[:2].tolist() == [4, 7]


def test_equal_triangles_go_by_number():
    positions, faces = stack(11)
    order, _ = build_presorted(positions[faces], options(0))
    assert order[:2].tolist() == [0, 1]
    assert order[2:6].tolist() == [2, 3, 8, 9]


@pytest.mark.parametrize("levels", [0, 1, 4, 9])
def test_threads_do_not_change_the_order(monkeypatch, levels):
    monkeypatch.setattr(module, "SMALLEST_JOB", 8)
    corners = random_corners(40_000, 3)
    one, two, five = (build_presorted(corners, options(levels), threads) for threads in (1, 2, 5))
    for other in (two, five):
        np.testing.assert_array_equal(one[0], other[0])
        np.testing.assert_array_equal(one[1].nodes, other[1].nodes)
        np.testing.assert_array_equal(one[1].starts, other[1].starts)
    check_presorted(one[1], corners[one[0]])


@given(clean_meshes(), st.integers(0, 20))
def test_plain_nodes_are_never_above_the_paper_s_limit(mesh, levels):
    _, presorted = build_presorted(mesh.positions[mesh.faces], options(levels))
    assert presorted.nodes.nbytes <= level_limit(levels)


def test_plain_levels_are_those_asked_for():
    corners = random_corners(1000)
    for levels in range(1, 9):
        _, presorted = build_presorted(corners, options(levels))
        assert plain_depth(presorted.nodes) == levels
        trees = np.diff(presorted.starts)
        assert len(presorted.nodes) == 2 * len(trees) - 1
        np.testing.assert_array_equal(presorted.nodes[presorted.leaf_places, 7], trees)
    _, whole = presort(corners, EVERY_LEVEL)
    assert np.diff(whole.starts).max() <= 2
    assert build_presorted(corners)[1].nodes.nbytes <= level_limit(HierarchyOptions().levels)


def test_what_cannot_be_sorted_is_told(monkeypatch):
    with pytest.raises(UsageError, match="n >= 1"):
        build_presorted(np.zeros((0, 3, 3), np.float32))
    wrong = random_corners(5)
    wrong[3, 1, 2] = np.nan
    with pytest.raises(UsageError, match="box 3 is not finite"):
        build_presorted(wrong, options(0))
    monkeypatch.setattr(module, "MOST_TRIANGLES", 5)
    with pytest.raises(LimitError, match="5 triangles"):
        build_presorted(random_corners(5))


def test_depths_are_those_of_heaps():
    assert [tree_depth(count) for count in (1, 2, 3, 6, 7, 14, 15)] == [1, 1, 2, 2, 3, 3, 4]


# ---- The proof.


def sorted_case(levels):
    corners = random_corners(61, 7)
    order, presorted = build_presorted(corners, options(levels))
    return corners[order].copy(), presorted


def with_word(presorted, node, word, value):
    nodes = presorted.nodes.copy()
    nodes[node, word] = value
    return dataclasses.replace(presorted, nodes=nodes)


def test_a_triangle_beyond_any_slab_above_it_is_found():
    for place in range(2, 61):
        for corner, axis, far in ((0, 0, -99), (1, 1, 99), (2, 2, -99), (1, 0, 99)):
            corners, presorted = sorted_case(0)
            corners[place, corner, axis] = far
            depth = (place // 2 + 1).bit_length() - 1
            if axis in {above % 3 for above in range(depth)}:
                with pytest.raises(UnreadableSceneError, match="slab does not hold"):
                    check_presorted(presorted, corners)
            elif axis != depth % 3:
                check_presorted(presorted, corners)


def test_triangles_in_each_other_s_places_are_found():
    corners, presorted = sorted_case(0)
    corners[[0, 40]] = corners[[40, 0]]
    with pytest.raises(UnreadableSceneError, match=r"triangle \d+: a slab does not hold"):
        check_presorted(presorted, corners)


@pytest.mark.parametrize("starts", [[0, 60], [1, 61], [0, 61, 61], [0, 30, 20, 61], [0], [0, 70, 61]])
def test_trees_that_do_not_hold_every_triangle_are_found(starts):
    corners, presorted = sorted_case(0)
    wrong = dataclasses.replace(presorted, starts=np.array(starts, np.int32))
    with pytest.raises(UnreadableSceneError, match="every triangle once"):
        check_presorted(wrong, corners)


def test_several_trees_want_a_node_above():
    corners, presorted = sorted_case(2)
    with pytest.raises(UnreadableSceneError, match="no node above"):
        check_presorted(Presorted(np.zeros((0, 8), np.uint32), presorted.starts), corners)


def test_links_that_go_astray_are_found():
    corners, presorted = sorted_case(3)
    assert len(presorted.nodes) == 7
    for value in (0, 1, 2, 3, 5, 6, 7, 2**32 - 1):
        with pytest.raises(UnreadableSceneError, match=r"out of place|end its subtree|not reached"):
            check_presorted(with_word(presorted, 0, 6, value), corners)
    with pytest.raises(UnreadableSceneError, match="out of place"):
        check_presorted(with_word(presorted, 2, 7, 0), corners)
    with pytest.raises(UnreadableSceneError, match="end its subtree"):
        check_presorted(with_word(presorted, 1, 7, 4), corners)
    more = np.concatenate([presorted.nodes, presorted.nodes[-1:]])
    with pytest.raises(UnreadableSceneError, match="end its subtree"):
        check_presorted(Presorted(more, presorted.starts), corners)
    leaf = np.flatnonzero(presorted.nodes[:, 7])[1]
    for word in (6, 7):
        wrong = with_word(presorted, leaf, word, presorted.nodes[leaf, word] + 1)
        with pytest.raises(UnreadableSceneError, match="trees in turn"):
            check_presorted(wrong, corners)


def test_boxes_that_hold_too_little_are_found():
    corners, presorted = sorted_case(3)
    for node in range(len(presorted.nodes)):
        for side in range(6):
            for wrong in (np.nan, np.inf if side < 3 else -np.inf, 0.0):
                bits = np.float32(wrong).view(np.uint32)
                with pytest.raises(UnreadableSceneError, match="box does not hold"):
                    check_presorted(with_word(presorted, node, side, bits), corners)


def test_corners_that_are_no_numbers_are_found():
    corners, presorted = sorted_case(0)
    corners[60, 2, 1] = np.inf
    with pytest.raises(UnreadableSceneError, match="not finite"):
        check_presorted(presorted, corners)


def test_the_depth_of_damaged_nodes_is_bounded():
    nodes = np.zeros((5, 8), np.uint32)
    nodes[:, 6] = [0, 2**32 - 1, 1, 4, 9]
    assert plain_depth(nodes) == 5
    assert plain_depth(nodes[:0]) == 0


# ---- The walk.


def scene_of(mesh, *, remap=True):
    return striptools.convert(mesh, Options(remap=remap, threads=1))


def tracer_of(scene, levels, node_test="bandwidth"):
    layout = lay_out_presorted(*presorted_of(scene, levels), node_test=node_test)
    return Tracer.of_layout(layout, device="cpu", threads=1)


def assert_same(scene, origins, directions, levels=0, t_max=None, node_tests=NODE_TESTS):
    """Every field of every ray is that of the default walk, and any hit is the same; but those `excused`."""
    expected = Tracer(scene, device="cpu", threads=1).closest_hit(origins, directions, t_max=t_max)
    placed, presorted = presorted_of(scene, levels)
    for node_test in node_tests:
        layout = lay_out_presorted(placed, presorted, node_test=node_test)
        tracer = Tracer.of_layout(layout, device="cpu", threads=1)
        hits = tracer.closest_hit(origins, directions, t_max=t_max)
        sure = ~excused(scene, expected, placed, hits, origins, directions)
        for field in FIELDS:
            ours, theirs = getattr(hits, field), getattr(expected, field)
            np.testing.assert_array_equal(ours[sure], theirs[sure], err_msg=field)
        np.testing.assert_array_equal(tracer.any_hit(origins, directions, t_max=t_max), expected.hit)
        if scene.remap is not None:
            met = hits.hit
            np.testing.assert_array_equal(placed.remap.face[hits.triangle[met]], hits.face[met])
    return expected


@settings(max_examples=8)
@given(clean_meshes(), st.integers(0, 2**32 - 1), st.booleans(), levels_drawn)
def test_any_mesh_has_the_same_hits(mesh, seed, remap, levels):
    scene = scene_of(mesh, remap=remap)
    if not remap:
        # Faces are then places, which sorting changes: hits are told apart by t alone.
        origins, directions = rays_at(scene, 60, seed)
        expected = Tracer(scene, device="cpu", threads=1).closest_hit(origins, directions)
        placed, presorted = presorted_of(scene, levels)
        tracer = Tracer.of_layout(lay_out_presorted(placed, presorted), device="cpu", threads=1)
        hits = tracer.closest_hit(origins, directions)
        sure = ~excused(scene, expected, placed, hits, origins, directions)
        np.testing.assert_array_equal(hits.t[sure], expected.t[sure])
        return
    assert_same(scene, *rays_at(scene, 60, seed), levels)


def specks_beside_a_mountain():
    """Pages of 1e-8 beside a tetrahedron at 1e10, from afar: products of scaled coordinates underflow."""
    (pages, leaves), (corners, sides) = book(24), tetrahedron()
    positions = np.concatenate([pages.astype(np.float64) * 1e-8, corners * 1e8 + 1e10]).astype(np.float32)
    mesh = Mesh(positions, np.concatenate([leaves, sides + np.int32(len(pages))]))
    return mesh, np.float32([[-7.0710677e-09, -8.7041299e08, 5e-09]]), np.float32([[0, 8.70413e08, 0]])


def slivers_seen_obliquely():
    """Two slivers, 1e-8 by 1e-4, from five lengths away: weights along them are off by thousandths."""
    near, far = np.float32(1e-4), np.float32(1.0001e-4)
    positions = np.array([[near, near, near], [near, far, near], [far, far, 0], [far, far, far]])
    mesh = Mesh(positions, np.array([[0, 1, 2], [1, 3, 2]], np.int32))
    origins = np.float32([[-1.56112379e-04, 1.16838755e-05, 3.10770731e-04]])
    return mesh, origins, np.float32([[2.5612173e-06, 8.8326124e-07, -2.6116593e-06]])


@pytest.mark.parametrize(
    ("case", "exact"), [(specks_beside_a_mountain, 1.0), (slivers_seen_obliquely, 99.99831467903682)]
)
def test_a_hit_beyond_its_box_may_be_found_on_one_path_only(case, exact):
    """The limit that `excused` stands for, `measure.bound`, term 9."""
    mesh, origins, directions = case()
    scene = scene_of(mesh)
    corners = mesh.positions[mesh.faces].astype(np.float64)
    pairs = [exact_pair(origins[0], directions[0], each) for each in corners]
    assert min(float(pair.t) for pair in pairs if pair.hit) == exact
    expected = Tracer(scene, device="cpu", threads=1).closest_hit(origins, directions)
    placed, presorted = presorted_of(scene, 0)
    tracer = Tracer.of_layout(lay_out_presorted(placed, presorted), device="cpu", threads=1)
    hits = tracer.closest_hit(origins, directions)
    assert max(expected.t[0], hits.t[0]) < exact * (1 - 2.0**-20)
    assert (expected.t[0], expected.face[0]) != (hits.t[0], hits.face[0])
    assert excused(scene, expected, placed, hits, origins, directions).all()
    # What is right is not excused.
    right = dataclasses.replace(expected, t=np.float32([pairs[expected.face[0]].t]))
    assert not beyond_box(scene, right, origins, directions).any()


@pytest.mark.parametrize("levels", [0, 3])
@pytest.mark.parametrize("shape", ALL_SHAPES)
def test_shapes_have_the_same_hits(shape, levels):
    scene = scene_of(clean(Mesh(*ALL_SHAPES[shape])).mesh)
    hits = assert_same(scene, *rays_at(scene, 600, 5), levels)
    assert hits.hit.sum() > 50


@pytest.mark.parametrize(("scale", "offset"), UNITS)
def test_units_and_offsets_have_the_same_hits(scale, offset):
    scene = scene_of(clean(Mesh(*moved_sphere(scale, offset))).mesh)
    for levels in (0, 4):
        assert_same(scene, *rays_at(scene, 400, 7), levels)


@pytest.fixture(scope="module")
def ball():
    return scene_of(Mesh(*sphere(5)))


@pytest.mark.parametrize("distance", [1e2, 1e4, 1e6])
def test_far_origins_have_the_same_hits(ball, distance):
    hits = assert_same(ball, *far_rays(ball, distance), 2)
    assert hits.hit.mean() > 0.3


def test_limits_of_t_are_the_same(ball):
    origins, directions = rays_at(ball, 2000, 6)
    assert_same(ball, origins, directions, 5, t_max=np.float32(1))
    assert_same(ball, origins, directions, 0, t_max=np.linspace(0, 2, len(origins)).astype(np.float32))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rays_along_axes_in_the_planes_of_slabs(axis):
    scene = scene_of(clean(Mesh(*cube())).mesh)
    for sign in (1.0, -1.0):
        origins, directions, _ = axial_rays(axis, sign)
        for levels in (0, 2):
            assert assert_same(scene, origins, directions, levels).hit.all()


def test_no_ray_leaves_a_closed_sphere(ball):
    assert assert_same(ball, *rays_from_inside(ball)).hit.all()


@pytest.mark.parametrize("levels", [0, 10])
def test_real_models_have_the_same_hits(real_mesh, levels):
    for name in ("chandelier", "tree_japanesemaple"):
        scene = striptools.convert(real_mesh(name))
        assert_same(scene, *rays_at(scene, 3000, 11), levels)


def test_rays_that_are_none_hit_nothing(ball):
    origins = np.float32([[0, 0, 0], [0, 0, 0], [np.nan, 0, 0], [9, 9, 9]])
    directions = np.float32([[0, 0, 0], [np.inf, 0, 0], [1, 0, 0], [1, 0, 0]])
    assert not assert_same(ball, origins, directions, 3).hit.any()


def test_all_rays_at_once_have_the_same_hits(ball):
    """The GPU's way of walking, on a CPU."""
    origins, directions = rays_at(ball, 200, 13)
    for node_test in NODE_TESTS:
        tracer = tracer_of(ball, 4, node_test)
        plain = tracer.closest_hit(origins, directions)
        tracer._on_gpu = True
        np.testing.assert_array_equal(tracer.closest_hit(origins, directions).t, plain.t)


def test_threads_trace_the_same(ball):
    origins, directions = rays_at(ball, 700, 14)
    layout = lay_out_presorted(*presorted_of(ball, 3))
    one, two = (Tracer.of_layout(layout, device="cpu", threads=threads) for threads in (1, 2))
    np.testing.assert_array_equal(
        one.closest_hit(origins, directions).t, two.closest_hit(origins, directions).t
    )


@pytest.mark.parametrize(("any_hit", "count"), [(False, False), (True, False), (False, True)])
@pytest.mark.parametrize("node_test", NODE_TESTS)
def test_walks_are_hoisted(ball, node_test, any_hit, count):
    tracer = tracer_of(ball, 3, node_test)
    given_options = tracer._options(any_hit=any_hit, counting=count)
    rows, live = np.zeros((256, ROW), np.float32), np.full(1, 256, np.int32)
    lowered = program(tracer._mesh, given_options).lower(tracer._scene, rows, live)
    assert_hoisted(lowered, loops=3)


def test_nodes_that_go_round_end(ball):
    placed, presorted = presorted_of(ball, 4)
    presorted.nodes[1, 6] = 0
    tracer = Tracer.of_layout(lay_out_presorted(placed, presorted), device="cpu", threads=1)
    with pytest.raises(StriptoolsError, match="did not end"):
        tracer.closest_hit(*rays_at(ball, 50, 0))


def test_a_scene_holds_its_triangles_once(ball, monkeypatch):
    layout = lay_out_presorted(*presorted_of(ball, 3))
    assert np.shares_memory(layout.arrays.corners, layout.leaves.blocks)
    room = len(layout.arrays.corners)
    # Corners and faces; nodes; the way from a face back.
    expected = 40 * room + layout.arrays.nodes.nbytes + 8 * ball.triangle_count
    assert layout.nbytes == expected
    monkeypatch.setattr(layouts, "MOST_TRIANGLES", ball.triangle_count)
    with pytest.raises(LimitError, match="use another hierarchy"):
        lay_out_presorted(*presorted_of(ball, 3))


# ---- Counting.


@pytest.fixture(scope="module")
def counted(ball):
    origins, directions = rays_at(ball, 1500, 12)
    return {
        (levels, test): tracer_of(ball, levels, test).closest_hit(origins, directions, counters=True).counters
        for levels in (0, 3, EVERY_LEVEL)
        for test in NODE_TESTS
    }


@pytest.mark.parametrize("levels", [0, 3, EVERY_LEVEL])
def test_the_bandwidth_order_reads_less(counted, levels):
    bandwidth, direct = (counted[levels, test] for test in NODE_TESTS)
    np.testing.assert_array_equal(bandwidth.nodes, direct.nodes)
    np.testing.assert_array_equal(bandwidth.leaves, direct.leaves)
    np.testing.assert_array_equal(bandwidth.node_bytes, direct.node_bytes)
    assert (bandwidth.triangles <= direct.triangles).all()
    assert (bandwidth.geometry_bytes <= direct.geometry_bytes).all()
    assert bandwidth.geometry_bytes.sum() < direct.geometry_bytes.sum()


def test_counts_add_up(counted):
    """Without levels each node is two triangles: six coordinates of a slab, the other twelve of a test."""
    direct = counted[0, "direct"]
    walked = direct.node_bytes > 0
    assert walked.any()
    np.testing.assert_array_equal(direct.boxes[walked], direct.nodes[walked] + 1)
    np.testing.assert_array_equal(direct.node_bytes[walked], 32)
    np.testing.assert_array_equal(direct.geometry_bytes, 24 * (direct.nodes + direct.triangles))
    bandwidth = counted[0, "bandwidth"]
    # A slab of a node, two of triangles where it is met; each further axis is twelve bytes.
    met = direct.triangles // 2
    further = bandwidth.boxes - walked - bandwidth.nodes - 2 * met
    np.testing.assert_array_equal(
        bandwidth.geometry_bytes[walked], (24 * bandwidth.nodes + 12 * further)[walked]
    )


def test_levels_save_tests_and_cost_node_bytes(counted):
    rows = [counted[levels, "bandwidth"] for levels in (0, 3, EVERY_LEVEL)]
    tests = [int((row.boxes + row.triangles).sum()) for row in rows]
    assert tests == sorted(tests, reverse=True)
    assert np.all(np.diff([int(row.node_bytes.sum()) for row in rows]) > 0)
    assert np.all(np.diff([int(row.geometry_bytes.sum()) for row in rows]) < 0)


# ---- The study.


@pytest.fixture(scope="module")
def study():
    told = []
    found = study_presorted.study(
        Mesh(*sphere(4)),
        StudyOptions(Options(threads=1), side=16, runs=2, device="cpu", threads=1),
        watch=lambda stage, part: told.append((stage, part)),
    )
    assert list(dict.fromkeys(stage for stage, _ in told)) == ["convert", "compile", "trace"]
    assert all(0 <= part < 1 for _, part in told)
    return found


def test_the_paper_s_table_keeps_its_limit():
    for sizes in PAPER.values():
        assert len(sizes) == len(study_presorted.LEVELS)
        for levels, size in zip(study_presorted.LEVELS, sizes, strict=True):
            assert size <= round(level_limit(levels) / 1000)


def test_every_row_is_measured(study):
    assert study.triangles == 2048
    assert [row.levels for row in study.by_levels] == [0, *range(5, 17), EVERY_LEVEL]
    for row in study.rows:
        assert min(row.primary.rate, row.primary.ratio, row.secondary.rate, row.primary.tests) > 0
    for row in study.by_levels[:-1]:
        assert row.node_bytes <= level_limit(row.levels)
    assert all(len(study.both_tests(levels)) == 2 for levels in study_presorted.COMPARED)
    assert study.by_levels[-1].primary.ratio == 1.0
    assert study.wide.name == "wide SAH"


def test_tables_name_every_row(study):
    by_levels, node_tests, paper = (rows for _, rows in study_presorted.tables(study))
    names = ["0", *map(str, range(5, 17)), "whole SAH", "wide SAH"]
    assert [row["levels"] for row in by_levels] == names
    assert by_levels[1]["limit_kB"] == 0.992
    assert len(node_tests) == 6
    assert [row["scene"] for row in paper] == [*PAPER, "this model"]
    assert paper[-1]["5"] == 1


def test_the_plot_is_a_picture_and_the_same_each_time(study):
    image = pytest.importorskip("PIL.Image", reason="the extra trace is not installed")
    pytest.importorskip("matplotlib", reason="the extra plots is not installed")
    one, other = io.BytesIO(), io.BytesIO()
    assert study_presorted.plot(study, one, "ball.ply") == len(one.getvalue())
    study_presorted.plot(study, other, "ball.ply")
    assert one.getvalue() == other.getvalue()
    picture = np.asarray(image.open(one))
    assert picture.shape[:2] == (550, 1650)
    assert len(np.unique(picture.reshape(-1, picture.shape[2]), axis=0)) > 20
