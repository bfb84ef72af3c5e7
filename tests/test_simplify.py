"""Simplification: the share, the distance both ways against brute force, errors kept or refused."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from striptools.errors import UsageError
from striptools.mesh.mesh import Mesh
from striptools.mesh.simplify import SimplifyOptions, simplify
from striptools.mesh.surface_distance import Surface, deviation
from striptools.pipeline import Options, convert_with_report

pytest.importorskip("fast_simplification")


def wavy(side: int = 24, height: float = 0.1) -> Mesh:
    """A height field over a grid."""
    x, y = np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side), indexing="ij")
    positions = np.stack([x, y, height * np.sin(6.3 * x) * np.sin(6.3 * y)], axis=2).reshape(-1, 3)
    at = np.arange(side * side).reshape(side, side)
    one = np.stack([at[:-1, :-1], at[1:, :-1], at[1:, 1:]], axis=2).reshape(-1, 3)
    two = np.stack([at[:-1, :-1], at[1:, 1:], at[:-1, 1:]], axis=2).reshape(-1, 3)
    return Mesh(positions.astype(np.float32), np.concatenate([one, two]).astype(np.int32))


def slow_distance(point: np.ndarray, triangle: np.ndarray, steps: int = 200) -> float:
    """The least distance to points of a fine grid on the triangle."""
    u, v = np.meshgrid(np.linspace(0, 1, steps), np.linspace(0, 1, steps))
    inside = u + v <= 1
    weights = np.stack([1 - u - v, u, v], axis=2)[inside]
    return float(np.linalg.norm(weights @ triangle - point, axis=1).min())


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**31))
def test_closest_equals_a_search_over_every_triangle(seed: int) -> None:
    random = np.random.default_rng(seed)
    corners = random.normal(size=(9, 3, 3)).astype(np.float32)
    # A needle too, whose plane says nothing.
    corners[0, 2] = corners[0, 0] + (corners[0, 1] - corners[0, 0]) * np.float32(0.5)
    surface = Surface(Mesh(corners.reshape(-1, 3), np.arange(27, dtype=np.int32).reshape(-1, 3)))
    points = random.normal(size=(4, 3)) * 2
    found, _ = surface.closest(points)
    for point, distance in zip(points, found, strict=True):
        slow = min(slow_distance(point, triangle) for triangle in corners.astype(np.float64))
        assert distance <= slow + 1e-6
        assert distance >= slow - 0.05


def test_bounds_hold_the_largest_distance_of_samples() -> None:
    mesh = wavy()
    flat = Mesh(
        np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32),
        np.array([[0, 1, 2], [0, 2, 3]], np.int32),
    )
    found = deviation(mesh, Surface(flat), tolerance=0.01)
    highest = float(np.abs(mesh.positions[:, 2]).max())
    assert found.lower <= highest * (1 + 1e-6)
    assert found.upper >= highest * (1 - 1e-6)
    assert found.upper <= found.lower * 1.011
    # From the flat surface the farthest point lies inside its two triangles, not at a corner.
    back = deviation(flat, Surface(mesh), tolerance=0.01)
    random = np.random.default_rng(1)
    samples = np.concatenate([random.random((20_000, 2)), np.zeros((20_000, 1))], axis=1)
    farthest = float(Surface(mesh).closest(samples)[0].max())
    corners = float(Surface(mesh).closest(flat.positions.astype(np.float64))[0].max())
    assert corners < 0.5 * farthest
    assert back.lower <= back.upper <= back.lower * 1.011
    assert back.upper >= farthest
    assert back.lower <= farthest * 1.05


def test_a_surface_does_not_stray_from_itself() -> None:
    mesh = wavy()
    found = deviation(mesh, Surface(mesh))
    assert found.lower == 0.0
    assert found.upper < 1e-9


def test_a_limit_is_decided_on_the_right_side() -> None:
    mesh, surface = wavy(), Surface(wavy(8))
    exact = deviation(mesh, surface, tolerance=1e-3)
    assert deviation(mesh, surface, limit=exact.upper * 1.1).upper <= exact.upper * 1.1
    assert deviation(mesh, surface, limit=exact.lower * 0.9).lower > exact.lower * 0.9


@pytest.mark.parametrize("keep", [0.5, 0.1])
def test_a_share_is_kept_and_measured(keep: float) -> None:
    mesh = wavy()
    found = simplify(mesh, SimplifyOptions(keep=keep))
    assert found.triangles_before == mesh.triangle_count
    assert found.mesh.triangle_count <= 1.05 * keep * mesh.triangle_count + 1
    away, _ = Surface(found.mesh).closest(mesh.positions.astype(np.float64))
    assert away.max() <= found.of_source.upper
    again = simplify(mesh, SimplifyOptions(keep=keep), threads=1)
    assert np.array_equal(again.mesh.positions, found.mesh.positions)
    assert again.to_dict() == found.to_dict()


def test_an_error_is_kept_with_fewer_triangles() -> None:
    mesh = wavy()
    coarse = simplify(mesh, SimplifyOptions(largest_error=5e-3))
    fine = simplify(mesh, SimplifyOptions(largest_error=5e-4))
    assert coarse.error_bound <= 5e-3
    assert fine.error_bound <= 5e-4
    assert coarse.mesh.triangle_count < fine.mesh.triangle_count < mesh.triangle_count


def test_a_share_that_strays_too_far_is_refused() -> None:
    with pytest.raises(UsageError, match="stray"):
        simplify(wavy(), SimplifyOptions(keep=0.05, largest_error=1e-6))


@pytest.mark.parametrize("options", [{"keep": 0.0}, {"keep": 1.5}, {"largest_error": -1.0}])
def test_options_out_of_range(options: dict[str, float]) -> None:
    with pytest.raises(UsageError, match="out of range"):
        SimplifyOptions(**options)


def test_a_conversion_says_what_it_simplified() -> None:
    scene, report = convert_with_report(wavy(), Options(simplify=SimplifyOptions(keep=0.25)))
    assert report.simplified is not None
    assert scene.triangle_count == report.simplified.mesh.triangle_count
    assert scene.metadata["simplified"] == report.simplified.to_dict()
