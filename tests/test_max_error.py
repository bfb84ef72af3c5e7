"""`--max-error` takes the smallest precision whose bound keeps it: at each bound, just below, just above."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from strategies import cube, grid, soup, sphere
from test_instances import SCENES, load

from striptools.errors import UsageError
from striptools.mesh.clean import CleanOptions, clean
from striptools.mesh.io import save_mesh
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert
from striptools.reducem import quantize
from striptools.reducem.quantize import PrecisionOptions, quantise
from striptools.reducem.reader import read_scene

BITS = range(8, 25)


def ball(scale: float = 1.0, shift: float = 0.0, dtype: type = np.float32) -> Mesh:
    positions, faces = sphere(2)
    return Mesh((positions.astype(np.float64) * scale + shift).astype(dtype), faces)


MESHES = {
    "cube": (lambda: Mesh(*cube()), {}),
    "plane": (lambda: Mesh(*grid(9, 9)), {}),
    "ball": (ball, {}),
    "ball, small": (lambda: ball(1e-20), {}),
    "ball, large": (lambda: ball(1e20), {}),
    "ball, far away": (lambda: ball(1.0, 3e4), {}),
    "ball, in float64": (lambda: ball(1 / 3, 0.1, np.float64), {}),
    "ball, in float64, far away": (lambda: ball(1 / 3, 1e6, np.float64), {}),
    "soup, welded": (lambda: Mesh(*soup(200, 4, 100)), {"weld": 1e-3}),
    "instances": (lambda: load(SCENES["repeated"]), {}),
    "instances, stretched": (lambda: load(SCENES["mirrored"]), {}),
    "instances, nested": (lambda: load(SCENES["nested"]), {}),
}


def cleaned_of(name: str):
    make, options = MESHES[name]
    mesh = make()
    stretch = 1.0 if mesh.instances is None else mesh.instances.stretch
    return clean(mesh, CleanOptions(**options)), stretch


def placed_bound(moved, stretch: float) -> float:
    """The bound that a grid keeps where everything stands."""
    return moved.error_bound * (stretch * quantize.SLACK if stretch != 1.0 else 1.0)


@pytest.mark.parametrize("name", MESHES)
def test_the_smallest_bits_that_keep_an_error_are_taken(name: str) -> None:
    cleaned, stretch = cleaned_of(name)
    grids = [quantise(cleaned, PrecisionOptions(bits)) for bits in BITS]
    bounds = [placed_bound(moved, stretch) for moved in grids]
    assert bounds == sorted(bounds, reverse=True)
    assert len(set(bounds)) > 10
    for bound in bounds:
        for largest in (math.nextafter(bound, 0.0), bound, math.nextafter(bound, math.inf)):
            # The definition, in the order of bits.
            wanted = next((moved for moved, one in zip(grids, bounds, strict=True) if one <= largest), None)
            asked = PrecisionOptions(max_error=largest)
            if wanted is None:
                assert bound == bounds[-1]
                with pytest.raises(UsageError, match="more than 24 bits"):
                    quantise(cleaned, asked)
                continue
            found = quantise(cleaned, asked)
            assert found.grid_exponent == wanted.grid_exponent
            assert placed_bound(found, stretch) <= largest


def test_below_a_bound_another_precision_is_taken() -> None:
    """The test above tells neighbours apart: a hair below a bound the grid is finer."""
    cleaned, _ = cleaned_of("ball")
    for bits in BITS[:-1]:
        bound = quantise(cleaned, PrecisionOptions(bits)).error_bound
        at, below = (
            quantise(cleaned, PrecisionOptions(max_error=largest)).grid_exponent
            for largest in (bound, math.nextafter(bound, 0.0))
        )
        assert below < at


@pytest.mark.parametrize("off", [-1, 1])
def test_a_precision_that_is_one_off_would_be_seen(off: int, monkeypatch: pytest.MonkeyPatch) -> None:
    right = quantize.exponent_for_error
    monkeypatch.setattr(quantize, "exponent_for_error", lambda *given: right(*given) + off)
    with pytest.raises(AssertionError):
        test_the_smallest_bits_that_keep_an_error_are_taken("ball")


@pytest.mark.parametrize("name", ["ball", "instances, stretched"])
def test_no_corner_is_farther_than_asked_where_everything_stands(name: str) -> None:
    mesh = MESHES[name][0]()
    source = mesh.flattened()
    for largest in (0.3, 0.01, 1e-4):
        scene = convert(mesh, Options(precision=PrecisionOptions(max_error=largest), threads=1))
        placed = scene.placed()
        assert placed.remap is not None
        face, rotation = placed.remap.face, placed.remap.rotation
        turned = source.faces[face][np.arange(len(face))[:, None], (np.arange(3) + rotation[:, None]) % 3]
        away = placed.positions[placed.faces()].astype(np.float64) - source.positions[turned]
        assert 0 < np.linalg.norm(away, axis=2).max() <= largest * (1 + 1e-6)


def test_relative_errors_count_in_diagonals() -> None:
    cleaned, _ = cleaned_of("ball")
    low, high = cleaned.mesh.bounds
    diagonal = float(np.linalg.norm(high - low))
    for bits in BITS:
        moved = quantise(cleaned, PrecisionOptions(bits))
        share = math.nextafter(moved.error_bound / diagonal, math.inf)
        found = quantise(cleaned, PrecisionOptions(max_error=share, relative=True))
        assert found.grid_exponent == moved.grid_exponent


def test_the_command_line_takes_the_number_as_it_is(
    tmp_path: Path, run: Callable[..., tuple[int, str, str]]
) -> None:
    save_mesh(ball(), tmp_path / "ball.ply")
    for bits in (9, 14, 23):
        bound = convert(ball(), Options(precision=PrecisionOptions(bits))).error_bound
        for largest, there in ((bound, bits), (math.nextafter(bound, 0.0), bits + 1)):
            files = (tmp_path / "ball.ply", tmp_path / "ball.rdm")
            assert run("convert", *files, "--max-error", repr(largest), "--force", "--quiet")[0] == 0
            wanted = convert(ball(), Options(precision=PrecisionOptions(there))).grid_exponent
            assert read_scene(tmp_path / "ball.rdm").grid_exponent == wanted


@pytest.mark.parametrize(("name", "finer"), [("repeated", 0), ("mirrored", 2), ("nested", 2)])
def test_instances_take_no_bit_more_than_their_stretch(name: str, finer: int) -> None:
    """Stretches of 1, 3 and 4: the grid is that of the flattened scene's box, finer by 0, 2 and 2 powers."""
    mesh = load(SCENES[name])
    found = quantise(clean(mesh), PrecisionOptions(12)).grid_exponent
    assert found == quantize.grid_exponent_for(mesh.flattened().bounds, 12) - finer
