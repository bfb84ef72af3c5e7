"""Containment: parity counts edges and corners right, winding numbers are those of float64, both agree."""

import numpy as np
import pytest
from scenes import scene_of, small_scene
from strategies import cube, grid, sphere, tetrahedron
from test_trace import clean

from striptools.errors import UsageError
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer
from striptools.trace.containment import WAY

RANDOM = np.random.default_rng(0)


def solid_angles(positions, faces, points):
    """Winding numbers by float64 solid angles, one triangle and point at a time."""
    corners = positions[faces].astype(np.float64)
    numbers = []
    for point in points.astype(np.float64):
        a, b, c = (corners[:, j] - point for j in range(3))
        la, lb, lc = (np.linalg.norm(p, axis=1) for p in (a, b, c))
        dots = [(p * q).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))]
        below = la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb
        numbers.append(2 * np.arctan2((a * np.cross(b, c)).sum(axis=1), below).sum() / (4 * np.pi))
    return np.array(numbers)


def places(positions, faces, count=1500):
    """Points in and around a mesh, and such from which the test's rays run through corners and edges."""
    low, high = positions.min(axis=0), positions.max(axis=0)
    spread = low - 0.2 * (high - low) + RANDOM.random((count, 3)) * 1.4 * (high - low)
    corners = positions[faces[RANDOM.integers(0, len(faces), count)]]
    at_corner = RANDOM.random((count, 1)) < 0.5
    targets = np.where(at_corner, corners[:, 0], corners[:, :2].mean(axis=1))
    aimed = targets - WAY * RANDOM.random((count, 1)) * 1.5
    return np.concatenate([spread, aimed]).astype(np.float32)


def nested():
    """A cube with a hollow, whose faces look inward."""
    outer, faces = clean(cube())
    inner = outer * np.float32(0.25) + np.float32(0.375)
    return np.concatenate([outer, inner]), np.concatenate([faces, faces[:, ::-1] + len(outer)])


SHAPES = {"sphere": sphere(3), "cube": cube(), "tetrahedron": tetrahedron(), "nested": nested()}


@pytest.mark.parametrize("resident", ["expanded", "compressed"])
@pytest.mark.parametrize("name", SHAPES)
def test_parity_agrees_with_solid_angles(name, resident):
    positions, faces = clean(SHAPES[name])
    points = places(positions, faces)
    truth = solid_angles(positions, faces, points)
    clear = np.abs(np.abs(truth) - 0.5) > 0.4
    # Points in a face's plane, on or near the surface.
    assert clear.mean() > 0.9
    tracer = Tracer(scene_of(Mesh(positions, faces)), device="cpu", threads=1, resident=resident)
    np.testing.assert_array_equal(tracer.contains(points)[clear], (np.abs(truth) > 0.5)[clear])


@pytest.mark.parametrize("resident", ["expanded", "compressed"])
@pytest.mark.parametrize("name", SHAPES)
def test_winding_numbers_agree_with_float64(name, resident):
    positions, faces = clean(SHAPES[name])
    points = places(positions, faces, 200)
    truth = solid_angles(positions, faces, points)
    tracer = Tracer(scene_of(Mesh(positions, faces)), device="cpu", threads=1, resident=resident)
    clear = np.abs(np.abs(truth) - 0.5) > 0.45
    np.testing.assert_allclose(tracer.winding_numbers(points)[clear], truth[clear], atol=1e-4)
    np.testing.assert_array_equal(
        tracer.contains(points, method="winding")[clear], tracer.contains(points)[clear]
    )


def test_counting_all_hits_instead_would_be_seen():
    """The aimed points tell: a ray through an edge meets two faces."""
    positions, faces = clean(sphere(2))
    points = places(positions, faces)
    tracer = Tracer(scene_of(Mesh(positions, faces)), device="cpu", threads=1)
    hits = tracer.count_hits(points, np.tile(WAY, (len(points), 1)))
    assert (hits % 2 != tracer.contains(points)).any()


def test_how_faces_are_wound_does_not_matter_to_parity():
    positions, faces = clean(sphere(2))
    flipped = faces.copy()
    flipped[::3] = flipped[::3, ::-1]
    points = places(positions, faces)
    one, other = (Tracer(scene_of(Mesh(positions, f)), device="cpu", threads=1) for f in (faces, flipped))
    np.testing.assert_array_equal(one.contains(points), other.contains(points))


def test_winding_bears_a_hole():
    positions, faces = clean(sphere(3))
    open_faces = faces[8:]
    tracer = Tracer(scene_of(Mesh(positions, open_faces)), device="cpu", threads=1)
    inside = np.array([[0, 0, 0], [0.1, 0.2, -0.3]], np.float32)
    np.testing.assert_array_equal(tracer.contains(inside, method="winding"), [True, True])
    np.testing.assert_array_equal(tracer.contains(inside + 20, method="winding"), [False, False])


def test_a_flat_sheet_has_half_a_winding_number_beside_it():
    tracer = Tracer(scene_of(Mesh(*clean(grid(64, 64)))), device="cpu", threads=1)
    above, below = tracer.winding_numbers(np.array([[32.2, 32.1, 0.01], [32.2, 32.1, -0.01]], np.float32))
    assert abs(abs(above) - 0.5) < 0.01
    assert above == pytest.approx(-below, abs=1e-4)


def test_points_that_are_not_finite_are_outside_and_wrong_arguments_told():
    tracer = Tracer(small_scene(), device="cpu", threads=1)
    bad = np.array([[np.nan, 0, 0], [0, np.inf, 0]])
    assert not tracer.contains(bad).any()
    assert not tracer.contains(bad, method="winding").any()
    assert tracer.contains(np.zeros((0, 3))).shape == (0,)
    with pytest.raises(UsageError, match="points"):
        tracer.contains(np.zeros(3))
    with pytest.raises(UsageError, match="no such method"):
        tracer.contains(np.zeros((1, 3)), method="guess")
