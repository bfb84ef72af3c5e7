"""The closest point: within its bound of trying every triangle in float64, the same in each residency."""

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from scenes import scene_of, scenes, small_scene
from strategies import book, cube, fan, grid, soup, sphere, stack
from test_hoisting import assert_hoisted
from test_trace import clean, going_round

from striptools.errors import StriptoolsError, UsageError
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer
from striptools.trace.closest import program
from striptools.trace.walk_points import PointOptions

BOUND = 2.0**-20
"""What the docstring promises, in the largest coordinate of point and scene."""

COLUMNS = ("point", "distance", "face", "u", "v", "triangle")


def distance_to(triangles, point):
    """Distances from a point to triangles (n, 3, 3) in float64 by Ericson's seven regions (section 5.1.5)."""
    return np.array([np.linalg.norm(foot_on(*triangle, point) - point) for triangle in triangles])


def foot_on(a, b, c, p):
    ab, ac, bc = b - a, c - a, c - b
    d1, d2 = ab @ (p - a), ac @ (p - a)
    d3, d4 = ab @ (p - b), ac @ (p - b)
    d5, d6 = ab @ (p - c), ac @ (p - c)
    if d1 <= 0 and d2 <= 0:
        return a
    if d3 >= 0 and d4 <= d3:
        return b
    if d6 >= 0 and d5 <= d6:
        return c
    vc, vb, va = d1 * d4 - d3 * d2, d5 * d2 - d1 * d6, d3 * d6 - d5 * d4
    if vc <= 0 and d1 >= 0 and d3 <= 0:
        return a + ab * (d1 / (d1 - d3))
    if vb <= 0 and d2 >= 0 and d6 <= 0:
        return a + ac * (d2 / (d2 - d6))
    if va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0:
        return b + bc * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))
    whole = va + vb + vc
    return a + ab * (vb / whole) + ac * (vc / whole)


def around(positions, count, seed):
    """Points around and inside the box, on vertices, and far away."""
    random = np.random.default_rng(seed)
    low, high = positions.min(axis=0).astype(np.float64), positions.max(axis=0).astype(np.float64)
    size = np.maximum(high - low, np.abs(positions).max() * 1e-3)
    points = low - 0.5 * size + random.random((count, 3)) * 2 * size
    points[::5] = positions[random.integers(0, len(positions), len(points[::5]))]
    points[1::9] *= 30
    return points.astype(np.float32)


def assert_closest(scene, points, found):
    triangles = scene.positions[scene.faces()].astype(np.float64)
    least = np.array([distance_to(triangles, point).min() for point in points.astype(np.float64)])
    bound = BOUND * np.maximum(np.abs(points).max(axis=1), np.abs(scene.positions).max())
    assert (np.abs(found.distance - least) <= bound).all()
    off = np.linalg.norm(found.point.astype(np.float64) - points, axis=1) - found.distance
    assert (np.abs(off) <= bound).all()
    return least


@pytest.mark.parametrize("resident", ["expanded", "compressed"])
@pytest.mark.parametrize(
    "shape",
    [grid(9, 9), fan(100), book(26), soup(200, 1, 1000), soup(100, 2, 3), stack(9), cube(), sphere(2)],
)
def test_equals_trying_every_triangle(shape, resident):
    scene = scene_of(Mesh(*clean(shape)), spare_faces=3)
    points = around(scene.positions, 120, 1)
    found = Tracer(scene, device="cpu", threads=1, resident=resident).closest_point(points)
    least = assert_closest(scene, points, found)
    assert (least == 0).any()
    assert (least > 0).any()


@settings(max_examples=6)
@given(scenes(), st.integers(0, 2**32 - 1))
def test_any_scene_the_same_in_both_residencies(drawn, seed):
    _, scene = drawn
    # Points around it would not be finite.
    assume(np.abs(scene.positions).max() < 1e30)
    points = around(scene.positions, 25, seed)
    one, other = (
        Tracer(scene, device="cpu", threads=1, resident=kind).closest_point(points)
        for kind in ("expanded", "compressed")
    )
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert_closest(scene, points, one)


def test_of_corners_as_close_both_residencies_take_the_same():
    """A body of 1e-8 seen from 1e7 away: float64 cannot tell its corners apart, and leaves turn them."""
    positions = np.array(
        [[0, 0, 0], [1e-8, 0, 0], [0, 1e-8, 0], [0, 0, 1e-8], [0, 0, 1e8], [1e8, 0, 5e7]], np.float32
    )
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3], [0, 4, 5]], np.int32)
    scene = scene_of(Mesh(positions, faces), remap=False, max_length=2, flips=False, block=4)
    points = around(scene.positions, 25, 0)
    one, other = (
        Tracer(scene, device="cpu", threads=1, resident=kind).closest_point(points)
        for kind in ("expanded", "compressed")
    )
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_u_and_v_give_the_point_from_the_sources_first_corner():
    positions, faces = sphere(2)
    random = np.random.default_rng(1)
    faces = np.take_along_axis(faces, (np.arange(3) + random.integers(0, 3, (len(faces), 1))) % 3, axis=1)
    points = random.normal(size=(500, 3)).astype(np.float32)
    for resident in ("expanded", "compressed"):
        tracer = Tracer(scene_of(Mesh(positions, faces)), device="cpu", resident=resident)
        found = tracer.closest_point(points)
        a, b, c = (positions[faces[found.face, k]] for k in range(3))
        u, v = found.u[:, None], found.v[:, None]
        np.testing.assert_allclose((1 - u - v) * a + u * b + v * c, found.point, atol=1e-6)
        assert ((found.u > 0) & (found.v > 0) & (found.u + found.v < 1)).mean() > 0.1


def test_signs_are_those_of_containment():
    scene = scene_of(Mesh(*sphere(2)))
    points = around(scene.positions, 400, 2)
    tracer = Tracer(scene, device="cpu", threads=1)
    plain, signed = tracer.closest_point(points), tracer.closest_point(points, signed=True)
    np.testing.assert_array_equal(np.abs(signed.distance), plain.distance)
    np.testing.assert_array_equal(
        signed.distance[plain.distance > 0] < 0, tracer.contains(points)[plain.distance > 0]
    )
    assert 8 < (signed.distance < 0).sum() < 380


def test_threads_hierarchies_and_walking_all_at_once_change_nothing():
    scene = scene_of(Mesh(*sphere(3)))
    points = around(scene.positions, 777, 3)
    one = Tracer(scene, device="cpu", threads=1)
    expected = one.closest_point(points)
    several = Tracer(scene, device="cpu").closest_point(points)
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(several, name), getattr(expected, name))
    rebuilt = Tracer(scene, device="cpu", hierarchy="rebuilt").closest_point(points)
    np.testing.assert_array_equal(rebuilt.distance, expected.distance)
    ready = np.concatenate(
        [points * one._layout.arrays.frame.scale, np.ones((777, 1))], axis=1, dtype=np.float32
    )
    at_once = program(one._mesh, PointOptions(one._stack_size, True, None))(one._scene, ready)
    np.testing.assert_array_equal(np.asarray(at_once[0]), expected.face)


@pytest.mark.parametrize("unit", [2.0**-60, 2.0**60])
def test_units_change_nothing(unit):
    positions, faces = sphere(2)
    points = around(positions, 100, 4)
    one, other = (
        Tracer(scene_of(Mesh(positions * np.float32(s), faces)), device="cpu", threads=1).closest_point(
            points * np.float32(s)
        )
        for s in (1, unit)
    )
    np.testing.assert_array_equal(one.face, other.face)
    np.testing.assert_array_equal(one.distance * np.float32(unit), other.distance)


def test_points_that_are_none_have_none_and_wrong_arguments_are_told():
    tracer = Tracer(small_scene(), device="cpu", threads=1)
    bad = np.array([[np.nan, 0, 0], [0, np.inf, 0], [1e30, 0, 0], [0, 0, 0]])
    found = tracer.closest_point(bad)
    np.testing.assert_array_equal(found.face >= 0, [False, False, False, True])
    assert np.isinf(found.distance[:3]).all()
    assert np.isnan(found.point[:3]).all()
    assert tracer.closest_point(np.zeros((0, 3))).point.shape == (0, 3)
    with pytest.raises(UsageError, match="points"):
        tracer.closest_point(np.zeros((3, 2)))


def test_a_tree_that_goes_round_ends_and_is_told():
    tracer = going_round()
    with pytest.raises(StriptoolsError, match="did not end"):
        tracer.closest_point(np.zeros((4, 3)))


@pytest.mark.parametrize("resident", ["expanded", "compressed"])
def test_the_walk_is_hoisted(resident):
    tracer = Tracer(small_scene(), device="cpu", resident=resident)
    options = PointOptions(tracer._stack_size, False, tracer._layout.decode)
    points = np.zeros((256 * len(tracer.devices), 4), np.float32)
    assert_hoisted(program(tracer._mesh, options).lower(tracer._scene, points))
