"""Winding numbers through shared instances: those of float64, mirrors wound as flattening winds them."""

import numpy as np
import pytest
from test_containment import solid_angles
from test_instanced_queries import few as few
from test_instanced_queries import placed_corners, tracers
from test_shared_instances import KINDS, mesh_of, random_matrices, sphere

from striptools.pipeline import convert
from striptools.trace import Tracer, containment
from striptools.trace.instanced import InstancedLayout

CLOSE = 1e-4
"""More than what float32 sums are off, away from surfaces: ten times what `containment` says."""


def truth_of(mesh, points):
    """Winding numbers in float64, of the flattened source's faces."""
    flat = mesh.flattened()
    return solid_angles(flat.positions, flat.faces, points)


def points_in(mesh, count, seed=0):
    """Points all over a scene, and one in the middle of each sphere."""
    random, corners = np.random.default_rng(seed), placed_corners(mesh)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    points = random.uniform(low, high, (count, 3))
    middles = mesh.instances.matrix[:, :, 3]
    return np.concatenate([points, middles]).astype(np.float32)


@pytest.mark.parametrize("resident", KINDS)
def test_they_are_those_of_float64_and_of_the_flattened_scene(few, resident):
    mesh, scene = few
    points = points_in(mesh, 300)
    truth = truth_of(mesh, points)
    shared, flat = tracers(scene, resident)
    ours, theirs = shared.winding_numbers(points), flat.winding_numbers(points)
    clear = np.abs(truth - np.round(truth)) < 1e-3
    assert clear.mean() > 0.9
    # All are wound outwards where they stand, the mirrored ones too, so that numbers add up.
    assert truth.max() > 1.9
    assert truth.min() > -1e-6
    np.testing.assert_allclose(ours[clear], truth[clear], atol=CLOSE)
    np.testing.assert_allclose(ours[clear], theirs[clear], atol=CLOSE)
    np.testing.assert_array_equal(
        shared.contains(points, method="winding")[clear], (np.abs(truth) > 0.5)[clear]
    )


@pytest.mark.parametrize("resident", KINDS)
def test_corners_are_those_of_the_flattened_scene_bit_for_bit(few, resident):
    """Each triangle once, its corners and its winding, whatever the order."""
    _, scene = few
    shared, flat = tracers(scene, resident)

    def triangles(tracer, most):
        layout = tracer._layout
        blocks = np.concatenate(list(layout.corner_blocks(most)))
        rows = blocks.transpose(0, 2, 1).reshape(-1, 9) / layout.arrays.frame.scale
        rows = rows[~np.isnan(rows[:, 0])]
        return rows[np.lexsort(rows.T)]

    ours = triangles(shared, 5)
    assert len(ours) == scene.placed_count
    np.testing.assert_array_equal(ours, triangles(flat, 1000))
    np.testing.assert_array_equal(ours, triangles(shared, 4096))


def test_both_residencies_and_any_threads_give_the_same_bits(few):
    mesh, scene = few
    points = points_in(mesh, 600, 1)
    found = {tracers(scene, resident)[0].winding_numbers(points).tobytes() for resident in KINDS} | {
        Tracer(scene, device="cpu", instances="shared").winding_numbers(points).tobytes()
    }
    assert len(found) == 1


def test_an_open_sheet_in_many_places_has_the_sum_of_its_solid_angles():
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
    mesh = mesh_of([(positions, faces)], np.zeros(40), random_matrices(np.random.default_rng(2), 40))
    # Where an instance's own zero stands is a corner.
    points = points_in(mesh, 300, 2)[:300]
    for resident in KINDS:
        found = tracers(convert(mesh), resident)[0].winding_numbers(points)
        np.testing.assert_allclose(found, truth_of(mesh, points), atol=CLOSE)


def test_more_triangles_than_a_part_holds(monkeypatch):
    mesh = mesh_of([sphere(40, 60)], np.zeros(6), random_matrices(np.random.default_rng(4), 6))
    scene = convert(mesh)
    points = points_in(mesh, 100, 3)
    expected = tracers(scene)[0].winding_numbers(points)
    monkeypatch.setattr(containment, "BLOCKS_AT_ONCE", 128)
    parts = list(tracers(scene)[0]._layout.corner_blocks(128))
    assert max(len(part) for part in parts) == 128
    assert len(parts) > 10
    for resident in KINDS:
        found = tracers(scene, resident)[0].winding_numbers(points)
        np.testing.assert_allclose(found, expected, atol=1e-5)


def test_points_that_are_none_are_outside():
    mesh = mesh_of([sphere()], np.zeros(2), random_matrices(np.random.default_rng(0), 2))
    tracer, _ = tracers(convert(mesh))
    bad = np.array([[np.nan, 0, 0], [0, np.inf, 0]])
    assert not tracer.winding_numbers(bad).any()
    assert tracer.winding_numbers(np.zeros((0, 3))).shape == (0,)


def test_mirrors_that_are_not_wound_again_would_be_seen(few, monkeypatch):
    mesh, scene = few
    points = points_in(mesh, 100, 5)
    truth = truth_of(mesh, points)
    right = InstancedLayout.corners_of

    def without_mirrors(self, names, instance):
        corners, turns = right(self, names, instance)
        corners[self.mirrored[instance]] = corners[self.mirrored[instance]][:, :, [0, 2, 1]]
        return corners, turns

    monkeypatch.setattr(InstancedLayout, "corners_of", without_mirrors)
    assert (np.abs(tracers(scene)[0].winding_numbers(points) - truth) > 0.5).any()
