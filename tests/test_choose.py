"""Choosing: the smallest precision that keeps an error, budgets, targets against a full sweep."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from striptools.choose import (
    LARGEST_ERRORS,
    TARGETS,
    Row,
    Wish,
    best_row,
    convert_to_wish,
    shipped_table,
)
from striptools.errors import UsageError
from striptools.mesh.clean import clean
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert
from striptools.reducem.quantize import LEAST_BITS, MOST_BITS, PrecisionOptions
from striptools.reducem.resident import resident_bytes
from striptools.trace import Tracer

CHANDELIER = Path(__file__).parent.parent / "samples" / "chandelier.ply"


@pytest.fixture(scope="module")
def part() -> Mesh:
    """A tenth of the sample."""
    mesh = load_mesh(CHANDELIER)
    return clean(Mesh(mesh.positions, mesh.faces[:13_000])).mesh


@pytest.mark.parametrize("error", [3e-3, 1e-3, 1e-4, 3e-5, 1e-6])
def test_max_error_takes_the_smallest_precision_that_keeps_it(part: Mesh, error: float) -> None:
    diagonal = float(np.linalg.norm(part.bounds[1] - part.bounds[0]))
    chosen = convert(part, Options(precision=PrecisionOptions(max_error=error, relative=True)))
    assert chosen.error_bound <= error * diagonal
    bounds = {
        bits: convert(part, Options(precision=PrecisionOptions(bits))).error_bound
        for bits in range(LEAST_BITS, MOST_BITS + 1)
    }
    smallest = min(bits for bits, bound in bounds.items() if bound <= error * diagonal)
    assert chosen.error_bound == bounds[smallest]


@pytest.mark.parametrize("resident", ["expanded", "compressed"])
@pytest.mark.parametrize("bits", [None, 12])
def test_resident_bytes_are_those_of_the_tracer(part: Mesh, resident, bits: int | None) -> None:
    scene = convert(part, Options(precision=PrecisionOptions(bits)))
    kept = Tracer(scene, resident=resident).resident_bytes
    assert resident_bytes(scene, resident) == kept
    stored = scene.storing_boxes()
    kept = Tracer(stored, resident=resident).resident_bytes
    assert resident_bytes(stored, resident) == kept


def test_a_budget_takes_the_finest_that_fits(part: Mesh) -> None:
    plain = convert(part)
    expanded, compressed = (resident_bytes(plain, way) for way in ("expanded", "compressed"))
    assert compressed < expanded
    for budget, way in ((expanded, "expanded"), (expanded - 1, "compressed"), (compressed, "compressed")):
        scene, _, choice = convert_to_wish(part, Options(), Wish(budget))
        assert choice.resident == way
        assert scene.grid_exponent is None
        assert choice.resident_bytes <= budget
        assert scene.metadata["chosen"] == choice.to_dict()
    # Size classes are steps: a fifth less is another one.
    budget = int(0.8 * compressed)
    scene, _, choice = convert_to_wish(part, Options(), Wish(budget))
    bits = choice.options.precision.bits
    assert bits is not None
    assert choice.resident_bytes <= budget
    finer = convert(part, Options(precision=PrecisionOptions(bits + 1))) if bits < MOST_BITS else plain
    assert resident_bytes(finer, "compressed") > budget
    assert Tracer(scene, resident="compressed").resident_bytes <= budget


def test_a_budget_that_cannot_be_kept_is_refused(part: Mesh) -> None:
    with pytest.raises(UsageError, match="cannot be kept"):
        convert_to_wish(part, Options(), Wish(1000))
    tight = Options(precision=PrecisionOptions(max_error=1e-6, relative=True))
    least = resident_bytes(convert(part, tight), "compressed")
    with pytest.raises(UsageError, match="cannot be kept"):
        convert_to_wish(part, tight, Wish(least - 1))
    assert convert_to_wish(part, tight, Wish(least))[2].resident_bytes <= least


def test_small_is_within_a_tenth_of_the_best_of_a_sweep(part: Mesh) -> None:
    scene, _, choice = convert_to_wish(part, Options(), Wish(target="small"))
    diagonal = float(np.linalg.norm(part.bounds[1] - part.bounds[0]))
    assert scene.error_bound <= LARGEST_ERRORS["small"] * diagonal
    assert "target small" in choice.why

    def size(options: Options) -> float:
        found = convert(part, options)
        if found.error_bound > LARGEST_ERRORS["small"] * diagonal:
            return np.inf
        return sum(found.part_bytes().values())

    swept = [size(Options(precision=PrecisionOptions(bits))) for bits in range(LEAST_BITS, MOST_BITS + 1)]
    assert sum(scene.part_bytes().values()) <= 1.1 * min(swept)


@pytest.mark.parametrize("target", TARGETS)
def test_a_target_takes_the_best_row_of_its_table(part: Mesh, target) -> None:
    rows = (
        Row("default", "lossless", 1.0, 1.0, 1.0, 0.0),
        Row("block size", "64", 1.1, 0.8, 0.9, 0.0),
        Row("strip cap", "8", 1.2, 1.1, 1.5, 0.0),
        Row("residency", "compressed", 0.2, 1.0, 0.7, 0.0),
        Row("simplification", "1%", 0.01, 0.01, 9.0, 0.1),
    )
    wanted = {"quality": "default", "balanced": "residency", "small": "block size", "fast": "strip cap"}
    assert best_row(rows, target, 0.0).factor == wanted[target]
    choice = convert_to_wish(part, Options(), Wish(target=target, table=rows))[2]
    assert choice.resident == ("compressed" if target == "balanced" else "expanded")
    assert choice.options.ordering.block == (64 if target == "small" else Options().ordering.block)
    assert choice.options.ordering.max_length == (8 if target == "fast" else Options().ordering.max_length)


def test_what_is_not_clearly_better_leaves_the_default() -> None:
    rows = (Row("default", "", 1.0, 1.0, 1.0, 0.0), Row("boxes", "stored", 1.0, 1.3, 1.03, 0.0))
    assert best_row(rows, "fast", 0.0).factor == "default"


def test_a_pair_that_is_not_clearly_better_leaves_one_factor() -> None:
    alone = Row("residency", "compressed", 0.22, 1.0, 0.6, 0.0)
    pair = Row("residency x boxes", "compressed, stored", 0.213, 1.3, 0.6, 0.0)
    rows = (Row("default", "", 1.0, 1.0, 1.0, 0.0), alone, pair)
    assert best_row(rows, "balanced", 0.0) == alone
    better = replace(pair, memory=0.2)
    assert best_row((*rows, better), "balanced", 0.0) == better


def test_the_shipped_table_is_whole() -> None:
    rows = shipped_table()
    assert rows[0].factor == "default"
    assert (rows[0].memory, rows[0].disk, rows[0].speed) == (1.0, 1.0, 1.0)
    assert {"precision", "simplification", "hierarchy", "residency"} <= {row.factor for row in rows}


def test_a_wish_out_of_range() -> None:
    with pytest.raises(UsageError, match="out of range"):
        Wish(budget=0)
    with pytest.raises(UsageError, match="not known"):
        Wish(target="best")  # pyright: ignore[reportArgumentType]
