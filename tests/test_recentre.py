from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import grid, meshes

from striptools.errors import UsageError
from striptools.mesh.clean import CleanOptions, clean
from striptools.mesh.mesh import Mesh
from striptools.mesh.recentre import LEAST_GAIN, choose_origin


def survey(offset=(4.5e5, 5.4e6, 300.0)):
    positions, faces = grid(12, 12)
    random = np.random.default_rng(1)
    return Mesh(positions * 100.0 + random.random(positions.shape) + offset, faces)


def exact_error(mesh, cleaned):
    """The largest change of a coordinate, in fractions, over the vertices that are left."""
    origin = [
        Fraction(one) for one in (cleaned.origin if cleaned.origin is not None else np.zeros(3)).tolist()
    ]
    largest = Fraction(0)
    pairs = zip(mesh.faces[cleaned.source_face].reshape(-1), cleaned.mesh.faces.reshape(-1), strict=True)
    for before, after in set(pairs):
        for axis in range(3):
            value = origin[axis] + Fraction(float(cleaned.mesh.positions[after, axis]))
            largest = max(largest, abs(value - Fraction(float(mesh.positions[before, axis]))))
    return largest


def test_a_survey_gets_an_origin_and_keeps_its_millimetres():
    mesh = survey()
    without = clean(mesh, CleanOptions(recentre="never"))
    cleaned = clean(mesh)
    assert without.origin is None
    assert without.largest_rounding > 0.1
    assert cleaned.origin is not None
    assert cleaned.largest_rounding < 1e-4
    error = exact_error(mesh, cleaned)
    assert error <= cleaned.largest_rounding
    assert float(error) == pytest.approx(cleaned.largest_rounding)


def test_what_gains_little_stays_where_it_is():
    mesh = survey((0.0, 0.0, 0.0))
    assert clean(mesh).origin is None
    np.testing.assert_array_equal(clean(mesh).mesh.positions, mesh.positions.astype(np.float32))


def test_float32_never_moves():
    mesh = survey()
    narrow = Mesh(mesh.positions.astype(np.float32), mesh.faces)
    assert clean(narrow).origin is None
    assert clean(Mesh(narrow.positions.astype(np.float64), mesh.faces)).origin is None


@given(meshes(), st.sampled_from([0.0, 1e3, 1e8, -1e15]), st.sampled_from([1.0, 1e-3, 1e5]))
def test_what_an_origin_costs_is_measured(mesh, offset, scale):
    with np.errstate(all="ignore"):
        moved = Mesh(mesh.positions.astype(np.float64) * scale + offset, mesh.faces)
    cleaned, without = clean(moved), clean(moved, CleanOptions(recentre="never"))
    if cleaned.origin is not None:
        assert cleaned.largest_rounding * LEAST_GAIN <= without.largest_rounding
    assert exact_error(moved, cleaned) <= cleaned.largest_rounding


def test_bad_vertices_do_not_move_the_origin():
    mesh = survey()
    positions = np.concatenate([mesh.positions, [[np.nan, 0, 0], [1e300, 1e300, 0], [np.inf, 0, 0]]])
    more = Mesh(positions, np.concatenate([mesh.faces, [[0, 1, len(positions) - 1]]]))
    cleaned = clean(more)
    np.testing.assert_array_equal(cleaned.origin, clean(mesh).origin)
    assert cleaned.counts["non_finite"] == 1


def test_no_finite_vertex_has_no_origin():
    positions = np.full((3, 3), np.nan)
    assert choose_origin(positions, positions.astype(np.float32)) is None


def test_another_word_is_refused():
    with pytest.raises(UsageError, match="recentre 'always'"):
        CleanOptions(recentre="always")
