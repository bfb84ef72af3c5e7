"""Simplification: the share, the distance both ways against brute force, errors kept or refused."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from striptools.errors import UsageError
from striptools.measure.strays import Strays, own_source, strays_of
from striptools.measure.verify import VerifyOptions, verify
from striptools.mesh.attributes import Attribute
from striptools.mesh.io import save_mesh
from striptools.mesh.mesh import Mesh
from striptools.mesh.simplify import SimplifyOptions, simplify
from striptools.mesh.surface_distance import Surface, deviation
from striptools.options import Options
from striptools.pipeline import convert, convert_with_report
from striptools.reducem.quantize import PrecisionOptions

pytest.importorskip("fast_simplification")

Run = Callable[..., tuple[int, str, str]]


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


def needles() -> Mesh:
    """A height field so long that every vertex has angles under 2.6 degrees, where nothing collapses."""
    mesh = wavy()
    return replace(mesh, positions=mesh.positions * np.float32([1000, 1, 1]))


def test_a_share_that_is_not_reached_is_told(tmp_path: Path, run: Run) -> None:
    found = simplify(needles(), SimplifyOptions(keep=0.25))
    assert found.wanted == round(0.25 * needles().triangle_count)
    assert found.mesh.triangle_count > 2 * found.wanted
    assert found.is_short
    reached = simplify(wavy(), SimplifyOptions(keep=0.25))
    assert reached.wanted == found.wanted
    assert not reached.is_short
    assert not simplify(wavy(), SimplifyOptions(largest_error=5e-3)).is_short
    told = f"; {found.wanted:,} were asked, but no further edge collapses"
    assert told in convert_said(needles(), tmp_path / "needles", run)
    assert "were asked" not in convert_said(wavy(), tmp_path / "wavy", run)


def convert_said(mesh: Mesh, folder: Path, run: Run) -> str:
    """What a conversion to a quarter of the triangles says."""
    folder.mkdir()
    save_mesh(mesh, folder / "model.ply")
    code, said, _ = run("convert", folder / "model.ply", folder / "scene.rdm", "--simplify", "25%")
    assert code == 0
    return said


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


FEW = VerifyOptions(rays=32, aimed_rays=512)
WAYS = {
    "plain": Options(),
    "without a remap": Options(remap=False),
    "on a grid": Options(precision=PrecisionOptions(10)),
    "within an error": Options(simplify=SimplifyOptions(largest_error=2e-3)),
}


def source_mesh(way: str) -> Mesh:
    """A mesh that cleaning changes: two faces without an area, normals; far away in float64 where asked."""
    mesh = wavy()
    faces = np.concatenate([np.zeros((2, 3), np.int32), mesh.faces])
    normals = Attribute("normal", "vertex", np.ones((mesh.vertex_count, 3), np.float32))
    positions = mesh.positions.astype(np.float64) / 3 + 1e7 if way == "far away" else mesh.positions
    return Mesh(positions, faces, attributes=(normals,))


def simplified(way: str) -> tuple[Mesh, Options]:
    options = WAYS.get(way, Options())
    if not options.simplify.asked:
        options = replace(options, simplify=SimplifyOptions(keep=0.2))
    return source_mesh(way), options


@pytest.mark.parametrize("way", [*WAYS, "far away"])
def test_a_simplified_scene_is_proved_against_the_mesh_before(way: str) -> None:
    mesh, options = simplified(way)
    scene = convert(mesh, options)
    report = verify(scene, mesh, FEW)
    assert report.ok
    assert report.rays > 500
    strays = report.strays
    assert strays is not None
    told = scene.metadata["simplified"]
    assert told["hausdorff_of_source"][0] * 0.99 - scene.error_bound <= strays.of_source
    assert told["hausdorff_of_result"][0] * 0.99 - scene.error_bound <= strays.of_result
    # The distance is that of the surfaces: vertices of each, by the slow way round.
    points = mesh.positions[np.unique(mesh.faces)].astype(np.float64)
    assert Surface(scene.to_mesh()).closest(points)[0].max() <= strays.of_source
    assert report.to_dict()["strays"]["ok"]


@pytest.mark.parametrize("which", ["source", "result"])
def test_a_scene_that_strays_farther_than_it_says_is_not_proved(which: str) -> None:
    mesh, options = simplified("plain")
    scene = convert(mesh, options)
    told = dict(scene.metadata["simplified"])
    told[f"hausdorff_of_{which}"] = [0.0, told[f"hausdorff_of_{which}"][0] * 0.9]
    report = verify(replace(scene, metadata={"simplified": told}), mesh, FEW)
    assert report.disagreements == report.leaks == 0
    assert not report.ok


def test_another_mesh_is_not_taken_for_the_source() -> None:
    mesh, options = simplified("plain")
    scene = convert(mesh, options)
    moved = replace(mesh, positions=mesh.positions + np.float32([0, 0, 0.05]))
    report = verify(scene, moved, FEW)
    assert report.strays is not None
    assert not report.strays.ok
    fewer = replace(mesh, faces=mesh.faces[:-1])
    with pytest.raises(UsageError, match="faces once clean"):
        strays_of(scene, fewer)


@pytest.mark.parametrize("told", [{}, [], {"triangles_before": 4}, {"hausdorff_of_source": [1]}, "x"])
def test_a_scene_that_does_not_say_how_far_it_strays_is_refused(told: object) -> None:
    mesh, options = simplified("plain")
    scene = replace(convert(mesh, options), metadata={"simplified": told})
    with pytest.raises(UsageError, match="not how far"):
        verify(scene, mesh, FEW)


def test_distances_that_are_no_numbers_are_refused() -> None:
    mesh, options = simplified("plain")
    scene = convert(mesh, options)
    for wrong in (-1.0, np.inf, np.nan, None, "far"):
        told = scene.metadata["simplified"] | {"hausdorff_of_result": [0.0, wrong]}
        with pytest.raises(UsageError, match="not how far"):
            strays_of(replace(scene, metadata={"simplified": told}), mesh)


def test_a_wrong_hit_of_a_simplified_scene_is_seen() -> None:
    """Rays are judged by the scene's own triangles: one that the tracer loses is a leak or a disagreement."""

    class Blind:
        def __init__(self, tracer) -> None:
            self.tracer = tracer

        def closest_hit(self, origins: np.ndarray, directions: np.ndarray):
            hits = self.tracer.closest_hit(origins, directions)
            hits.face[::3] = hits.triangle[::3] = -1
            hits.t[::3] = np.inf
            return hits

    from striptools.trace import Tracer

    mesh, options = simplified("plain")
    scene = convert(mesh, options)
    report = verify(scene, mesh, FEW, tracer=Blind(Tracer(scene)))
    assert report.leaks + report.disagreements > 0
    assert not report.ok


def test_own_faces_stand_at_their_numbers() -> None:
    scene = convert(source_mesh("plain"))
    alone, mesh = own_source(scene)
    assert mesh.triangle_count == scene.source_face_count == alone.source_face_count
    assert (mesh.faces[:2] == 0).all()
    assert alone.remap is not None
    kept = mesh.positions[mesh.faces[alone.remap.face]]
    turned = kept[np.arange(len(kept))[:, None], (np.arange(3) + alone.remap.rotation[:, None]) % 3]
    np.testing.assert_array_equal(turned, scene.positions[scene.faces()])


def test_nothing_strays_where_all_is_declared() -> None:
    assert Strays(1.0, 2.0, 1.0, 2.0).ok
    assert not Strays(1.1, 2.0, 1.0, 2.0).ok
    assert not Strays(1.0, 2.1, 1.0, 2.0).ok


def test_the_command_line_proves_what_it_simplified(tmp_path: Path, run: Run) -> None:
    model, scene = tmp_path / "wavy.ply", tmp_path / "wavy.rdm"
    save_mesh(wavy(), model)
    code, said, _ = run("convert", model, scene, "--simplify", "20%")
    assert code == 0
    assert "the source strays at most" in said
    verify_it = ("verify", scene, "--against", model, "--rays", 16, "--aimed-rays", 64)
    code, said, _ = run(*verify_it)
    assert code == 0
    assert "no farther than declared" in said.splitlines()[0]
    save_mesh(wavy(height=0.2), model)
    code, said, _ = run(*verify_it)
    assert code == 1
    assert "FARTHER than declared" in said.splitlines()[0]
    code, _, said = run("convert", model, tmp_path / "b.rdm", "--simplify", "5%", "--simplify-error", "1e-6")
    assert code == 2
    assert "stray by up to" in said
