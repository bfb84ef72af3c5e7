"""Grids: one for the whole mesh, no vertex beyond the declared bound, shared vertices one point still."""

import io
import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from strategies import clean_meshes, cube, meshes, sphere

import striptools
from striptools.errors import StriptoolsError, UnreadableMeshError, UsageError
from striptools.mesh.clean import clean
from striptools.mesh.mesh import Mesh
from striptools.reducem.quantize import (
    PrecisionOptions,
    check_bound,
    exponent_for_error,
    grid_bound,
    grid_exponent_for,
    quantise,
    snap,
)
from striptools.reducem.reader import read_scene
from striptools.reducem.validate import validate

BITS = st.integers(8, 24)
EXPONENTS = st.integers(-149, 104)
MOST = float(np.finfo(np.float32).max)
FLOATS = st.floats(-MOST, MOST, width=32) | st.sampled_from([0.0, -0.0, 1e-45, -1e-40, 0.5, 1.5, 2.5, MOST])


@given(st.lists(st.tuples(FLOATS, FLOATS, FLOATS), min_size=1, max_size=30), EXPONENTS)
def test_snapping_is_to_the_nearest_and_once_is_enough(rows, exponent):
    positions = np.array(rows, np.float32)
    snapped = snap(positions, exponent)
    assert snapped.dtype == np.float32
    assert np.isfinite(snapped).all()
    assert not np.signbit(snapped[snapped == 0]).any()
    np.testing.assert_array_equal(snap(snapped, exponent).view(np.uint32), snapped.view(np.uint32))
    cells = np.ldexp(snapped.astype(np.float64), -exponent)
    np.testing.assert_array_equal(cells, np.rint(cells))
    moved = np.abs(snapped.astype(np.float64) - positions)
    assert moved.max() <= math.ldexp(0.5, exponent)
    assert np.linalg.norm(moved, axis=1).max() <= grid_bound(exponent)


def test_of_two_equally_near_ones_the_even_one_is_taken():
    positions = np.array([[0.5, 1.5, 2.5], [-0.5, -1.5, -2.5]], np.float32)
    np.testing.assert_array_equal(snap(positions, 0), [[0, 2, 2], [0, -2, -2]])


@given(clean_meshes(), BITS)
def test_the_grid_has_at_most_so_many_bits_and_a_finer_one_has_more(mesh, bits):
    low, high = mesh.bounds
    exponent = grid_exponent_for(mesh.bounds, bits)

    def steps(at):
        return float((np.rint(np.ldexp(high, -at)) - np.rint(np.ldexp(low, -at))).max())

    assert exponent == 104 or steps(exponent) < 2**bits
    assert exponent == -149 or steps(exponent - 1) >= 2**bits
    largest = grid_bound(exponent)
    assert exponent_for_error(mesh.bounds, largest) >= exponent


def test_the_smallest_bits_whose_bound_is_small_enough_are_taken():
    bounds = np.array([[0, 0, 0], [1, 2, 3]], np.float64)
    for bits in range(8, 25):
        exponent = grid_exponent_for(bounds, bits)
        assert exponent_for_error(bounds, grid_bound(exponent)) == exponent
    assert exponent_for_error(bounds, 1e9) == grid_exponent_for(bounds, 8)
    already = grid_bound(grid_exponent_for(bounds, 10))
    assert exponent_for_error(bounds, already * 1.5, already) < grid_exponent_for(bounds, 10)
    with pytest.raises(UsageError, match="more than 24 bits"):
        exponent_for_error(bounds, 1e-9)


@pytest.mark.parametrize(
    "wrong",
    [{"bits": 7}, {"bits": 25}, {"max_error": 0.0}, {"max_error": math.inf}, {"bits": 9, "max_error": 1.0}],
)
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(UsageError):
        PrecisionOptions(**wrong)


@given(meshes(), BITS, st.booleans(), st.sampled_from(["rebuilt", "stored"]))
@settings(max_examples=40)
def test_no_corner_is_farther_from_its_source_than_declared(mesh, bits, remap, boxes):
    assume(clean(mesh).mesh.triangle_count)
    options = striptools.Options(precision=PrecisionOptions(bits), remap=remap, boxes=boxes)
    kept = clean(mesh)
    if quantise(kept, options.precision).cleaned.mesh.triangle_count == 0:
        with pytest.raises(UnreadableMeshError, match="after quantising"):
            striptools.convert(mesh, options)
        return
    scene, report = striptools.convert_with_report(mesh, options)
    file = io.BytesIO()
    scene.save(file)
    assert validate(file.getvalue()) == []
    back = read_scene(file.getvalue())
    assert (back.grid_exponent, back.error_bound) == (scene.grid_exponent, scene.error_bound)
    assert report.largest_error <= scene.error_bound
    counts = report.counts
    dropped = ("quantised_repeated_vertex", "quantised_zero_area")
    assert kept.mesh.triangle_count == counts["faces_out"] + sum(counts[name] for name in dropped)
    if not remap:
        return
    theirs = np.asarray(mesh.positions, np.float64)[mesh.faces[np.sort(scene.remap.face)]]
    found = back.to_mesh()
    moved = np.linalg.norm(found.positions[found.faces].astype(np.float64) - theirs, axis=2)
    assert moved.max() <= scene.error_bound


def test_vertices_that_meet_become_one_and_flat_faces_are_counted():
    positions = np.array(
        [[0, 0, 0], [256, 0, 0], [0, 256, 0], [0.25, 0, 0], [128, 0.25, 0], [7, 7.6, 9], [7, 7.4, 0]],
        np.float32,
    )
    faces = np.array([[0, 1, 2], [0, 3, 2], [0, 1, 4], [3, 1, 2], [5, 6, 1]], np.int32)
    cleaned = clean(Mesh(positions, faces))
    moved = quantise(cleaned, PrecisionOptions(9))
    assert moved.grid_exponent == 0
    counts = moved.cleaned.counts
    assert counts["quantised_repeated_vertex"] == 1
    assert counts["quantised_zero_area"] == 1
    assert counts["quantised_vertices_welded"] == 1
    assert counts["faces_out"] == moved.cleaned.mesh.triangle_count == 3
    assert counts["duplicate_faces_kept"] == 1
    np.testing.assert_array_equal(moved.cleaned.source_face, [0, 3, 4])
    fewer = quantise(cleaned, PrecisionOptions(9), drop_duplicates=True)
    assert fewer.cleaned.mesh.triangle_count == 2
    assert fewer.cleaned.counts["duplicate_faces_dropped"] == 1


def test_a_face_that_turns_over_is_counted_and_kept():
    positions = np.array([[0, 0, 0], [300, 100.4, 0], [150, 50.6, 0], [0, 0, 300]], np.float32)
    cleaned = clean(Mesh(positions, np.array([[0, 1, 2], [0, 1, 3]], np.int32)))
    flat = np.array([[0, 0, 0], [300, 100, 0], [150, 50, 0]])
    assert np.cross(flat[1] - flat[0], flat[2] - flat[0]).tolist() == [0, 0, 0]
    moved = quantise(clean(replace(cleaned.mesh, positions=positions + np.float32(0.3))), PrecisionOptions(9))
    for bits in range(8, 14):
        moved = quantise(cleaned, PrecisionOptions(bits))
        after = snap(cleaned.mesh.positions, moved.grid_exponent).astype(np.float64)
        flipped = 0
        for a, b, c in cleaned.mesh.faces:
            old, new = (
                np.cross(p[b] - p[a], p[c] - p[a]) for p in (cleaned.mesh.positions.astype(np.float64), after)
            )
            flipped += float(old @ new) < 0
        assert moved.cleaned.counts["quantised_flipped"] == flipped


def test_neighbouring_blocks_share_their_vertices_bit_for_bit():
    mesh = Mesh(*sphere(4))
    options = striptools.Options(
        precision=PrecisionOptions(10), ordering=striptools.OrderingOptions(block=32)
    )
    scene = striptools.convert(mesh, options)
    assert scene.block_count > 60
    # A closed surface stays closed: every edge still has two faces.
    back = scene.to_mesh()
    edges = np.sort(np.concatenate([back.faces[:, [0, 1]], back.faces[:, [1, 2]], back.faces[:, [2, 0]]]))
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    assert scene.bytes_per_triangle() < striptools.convert(mesh).bytes_per_triangle()


def test_doubles_are_bound_with_their_rounding():
    positions, faces = cube()
    mesh = Mesh(positions.astype(np.float64) * 1000 + 1 / 3, faces)
    scene, report = striptools.convert_with_report(
        mesh, striptools.Options(precision=PrecisionOptions(max_error=1e-2, relative=False))
    )
    assert scene.error_bound <= 1e-2
    assert scene.error_bound > grid_bound(scene.grid_exponent)
    assert report.largest_error <= scene.error_bound
    relative = PrecisionOptions(max_error=1e-4, relative=True)
    scene = striptools.convert(mesh, striptools.Options(precision=relative))
    assert scene.error_bound <= 1e-4 * math.sqrt(3) * 1000


def test_a_vertex_beyond_the_bound_is_a_fault_of_this_program():
    mesh = Mesh(*cube())
    moved = Mesh(mesh.positions + np.float32(0.5), mesh.faces)
    ids = np.arange(len(mesh.faces), dtype=np.int32)
    assert check_bound(mesh, moved, ids, 0.9) == pytest.approx(math.sqrt(0.75))
    with pytest.raises(StriptoolsError, match="more than the declared"):
        check_bound(mesh, moved, ids, 0.8)
