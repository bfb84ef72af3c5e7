"""Closest points through shared instances: the bits of the flattened scene, within their bound in float64."""

from dataclasses import replace

import numpy as np
import pytest
from test_closest_point import BOUND, COLUMNS, distance_to
from test_hoisting import assert_hoisted
from test_instanced_queries import placed_corners, tracers
from test_instances import SCENES, load
from test_shared_instances import KINDS, crowded, mesh_of, random_matrices, sphere

from striptools.errors import StriptoolsError
from striptools.pipeline import convert
from striptools.trace import Tracer, closest, instanced
from striptools.trace.closest import program
from striptools.trace.instanced import stretch_bounds
from striptools.trace.standing import Standing
from striptools.trace.walk import DONE
from striptools.trace.walk_points import PointOptions


@pytest.fixture(scope="module")
def crowd():
    """Thirty instances of three geometries, one far from its own zero, sheared, mirrored; and the scene."""
    return crowded(5, 30, sphere(15, 10))


def points_of(scene, count, seed=0):
    """Points around a scene and in it, at its vertices and next to them, and from near to far away."""
    random, placed = np.random.default_rng(seed), scene.placed()
    low, high = placed.low.astype(np.float64), placed.high.astype(np.float64)
    size = np.maximum(high - low, np.abs([low, high]).max() * 1e-3)
    points = low - 0.3 * size + random.random((count, 3)) * 1.6 * size
    vertices = placed.positions[random.integers(0, len(placed.positions), count)]
    points[::4] = vertices[::4]
    points[1::4] = vertices[1::4] + random.normal(size=(len(points[1::4]), 3)) * 1e-3 * size
    points[2::12] *= 10.0 ** random.uniform(0, 6, (len(points[2::12]), 1))
    return points.astype(np.float32)


def assert_same(ours, theirs):
    for name in COLUMNS:
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes(), name


@pytest.mark.parametrize("resident", KINDS)
@pytest.mark.parametrize("name", sorted(SCENES))
def test_closest_points_are_those_of_the_flattened_scene_bit_for_bit(name, resident):
    scene = convert(load(SCENES[name]))
    shared, flat = tracers(scene, resident)
    points = points_of(scene, 2000)
    ours = shared.closest_point(points)
    assert_same(ours, flat.closest_point(points))
    assert len(np.unique(ours.triangle)) > 40


@pytest.mark.parametrize("resident", KINDS)
def test_those_of_thirty_sheared_and_mirrored_instances_too(crowd, resident):
    _, scene = crowd
    shared, flat = tracers(scene, resident)
    points = points_of(scene, 10000, 1)
    ours = shared.closest_point(points)
    assert_same(ours, flat.closest_point(points))
    numbers = shared._numbers
    assert len(np.unique(numbers.instance_of(ours.triangle))) == len(scene.instances)
    assert_same(shared.closest_point(points, signed=True), shared.closest_point(points, signed=True))


@pytest.mark.parametrize("resident", KINDS)
def test_an_instance_that_its_matrix_brings_back_from_far_away(resident):
    """Products of the matrix are 1000 times what they add up to; others are specks."""
    random = np.random.default_rng(2)
    far = np.array([1000.0, -2000.0, 500.0])
    matrices = random_matrices(random, 6, 0.5)
    matrices[:4, :, 3] -= np.einsum("kij,j->ki", matrices[:4, :, :3], far)
    matrices[4:, :, :3] *= 1e-5
    scene = convert(mesh_of([sphere(9, 12, far), sphere()], [0, 0, 0, 0, 1, 1], matrices))
    shared, flat = tracers(scene, resident)
    points = points_of(scene, 3000)
    assert_same(shared.closest_point(points), flat.closest_point(points))


@pytest.mark.parametrize("resident", KINDS)
def test_distances_are_the_least_of_all_triangles_in_float64(crowd, resident):
    mesh, scene = crowd
    corners = placed_corners(mesh)
    points = points_of(scene, 60, 3)
    found = tracers(scene, resident)[0].closest_point(points)
    for k, point in enumerate(points.astype(np.float64)):
        # Those whose corners are farther than the found one by more than their own size are left out.
        reach = np.linalg.norm(corners - corners[:, :1], axis=2).max(axis=1)
        near = np.linalg.norm(corners[:, 0] - point, axis=1) - reach <= found.distance[k] * 1.01 + 1e-3
        least = distance_to(corners[near], point).min()
        bound = BOUND * max(np.abs(point).max(), np.abs(corners).max())
        assert abs(found.distance[k] - least) <= bound
        assert np.linalg.norm(found.point[k] - point) - found.distance[k] <= bound


def test_u_and_v_say_where_on_the_flattened_face_it_is(crowd):
    mesh, scene = crowd
    points = points_of(scene, 2000, 4)
    flat = mesh.flattened()
    for resident in KINDS:
        found = tracers(scene, resident)[0].closest_point(points)
        a, b, c = flat.positions[flat.faces[found.face]].astype(np.float64).transpose(1, 0, 2)
        u, v = found.u[:, None].astype(np.float64), found.v[:, None].astype(np.float64)
        np.testing.assert_allclose((1 - u - v) * a + u * b + v * c, found.point, atol=1e-5)


def test_of_instances_in_the_same_place_it_is_the_first():
    scene = convert(load(SCENES["twice the same place"]))
    shared, _ = tracers(scene)
    found = shared.closest_point(points_of(scene, 500))
    assert (shared._numbers.instance_of(found.triangle) == 0).all()


def test_threads_and_points_all_at_once_change_nothing(crowd):
    _, scene = crowd
    points = points_of(scene, 777, 5)
    one = Tracer(scene, device="cpu", threads=1, instances="shared")
    expected = one.closest_point(points)
    assert_same(Tracer(scene, device="cpu", instances="shared").closest_point(points), expected)
    scaled = points * one._layout.arrays.frame.scale
    ready = np.concatenate([scaled, np.ones((777, 1))], axis=1, dtype=np.float32)
    for walked in zip(
        *(
            program(one._mesh, PointOptions(one._stack_size, batch, None), True)(one._standing, ready)
            for batch in (False, True)
        ),
        strict=True,
    ):
        np.testing.assert_array_equal(*map(np.asarray, walked))


def test_points_that_are_none_have_none():
    tracer, _ = tracers(convert(load(SCENES["mirrored"])))
    bad = np.array([[np.nan, 0, 0], [0, np.inf, 0], [1e30, 0, 0], [0, 0, 0]])
    found = tracer.closest_point(bad)
    np.testing.assert_array_equal(found.face >= 0, [False, False, False, True])
    assert np.isinf(found.distance[:3]).all()
    assert tracer.closest_point(np.zeros((0, 3))).point.shape == (0, 3)


@pytest.mark.parametrize("over_instances", [True, False])
def test_nodes_that_go_round_end_and_are_told(over_instances):
    tracer, _ = tracers(convert(load(SCENES["mirrored"])))
    arrays = tracer._layout.arrays
    nodes = (arrays if over_instances else arrays.geometries).nodes.copy()
    children = nodes[0, 6].view(np.int32)
    children[children != DONE] = 0
    if over_instances:
        arrays = arrays._replace(nodes=nodes)
    else:
        arrays = arrays._replace(geometries=arrays.geometries._replace(nodes=nodes))
    tracer._take(replace(tracer._layout, arrays=arrays))
    with pytest.raises(StriptoolsError, match="did not end"):
        tracer.closest_point(np.zeros((4, 3)))


@pytest.mark.parametrize("resident", KINDS)
def test_the_walk_is_hoisted(resident):
    tracer, _ = tracers(convert(load(SCENES["mirrored"])), resident)
    options = PointOptions(tracer._stack_size, False, tracer._layout.decode)
    assert_hoisted(
        program(tracer._mesh, options, True).lower(tracer._standing, np.zeros((256, 4), np.float32)), loops=3
    )


def test_no_vector_becomes_shorter_than_its_bound_says():
    random = np.random.default_rng(8)
    places = random_matrices(random, 400)
    places[:100, :, :3] = np.linalg.qr(random.normal(size=(100, 3, 3)))[0]
    places[100:200, :, :3] = np.linalg.qr(random.normal(size=(100, 3, 3)))[0] * [1e-5, 1.0, 30.0]
    bounds = stretch_bounds(places).astype(np.float64)
    assert (bounds[:200, :, :3] == np.eye(3)).all()
    vectors = random.normal(size=(400, 200, 3)) * 10 ** random.uniform(-4, 4, (400, 1, 3))
    lengths = np.linalg.norm(np.einsum("kij,knj->kni", places[:, :, :3], vectors), axis=2)
    least = np.linalg.norm(
        np.einsum("kij,knj->kni", bounds[:, :, :3], vectors) * bounds[:, None, :, 3], axis=2
    )
    assert (least <= lengths).all()
    # All have room for a small instance far away: what is lost is little.
    assert (least >= lengths * (1 - 2.0**-12)).all()


def test_a_bound_that_says_too_much_would_be_seen(crowd, monkeypatch):
    _, scene = crowd
    points = points_of(scene, 2000, 6)
    flat = tracers(scene)[1].closest_point(points)
    monkeypatch.setattr(
        instanced, "stretch_bounds", lambda places: stretch_bounds(places) * np.float32([1, 1, 1, 1.5])
    )
    assert (tracers(scene)[0].closest_point(points).face != flat.face).any()


def test_corners_that_are_not_placed_as_flattening_does_would_be_seen(crowd, monkeypatch):
    """By one rounding, or in another order where an instance is mirrored."""
    _, scene = crowd
    points = points_of(scene, 2000, 7)
    shared, flat = tracers(scene)
    right = flat.closest_point(points)
    placed = Standing._placed

    def one_rounding_more(self, own):
        return tuple(tuple(a + (a - a * np.float32(1 + 2e-7)) for a in axis) for axis in placed(self, own))

    def not_exchanged(self, own):
        return placed(self._replace(mirrored=self.mirrored & False), own)

    for fault in (one_rounding_more, not_exchanged):
        monkeypatch.setattr(Standing, "_placed", fault)
        closest.program.cache_clear()
        wrong = shared.closest_point(points)
        assert any(getattr(wrong, name).tobytes() != getattr(right, name).tobytes() for name in COLUMNS)
    closest.program.cache_clear()
