"""The kept reports of trades: targets choose near the best point of each, and README says what they say."""

import json
import re
from pathlib import Path
from typing import Any

import pytest

from striptools.choose import TARGETS, median_row, read_table, shipped_table
from striptools.measure.report_html import sentences
from striptools.measure.trade import Trade
from striptools.measure.trade_points import chosen_by_targets, settings
from striptools.measure.trade_targets import chosen_of
from striptools.options import Options

ROOT = Path(__file__).parent.parent
REPORTS = ROOT / "samples" / "reports"
MODELS = ("bunny", "chandelier", "dem_jacksboro", "dragon", "kicad_acepack")
WORSE = 1.1


def kept(model: str) -> dict[str, Any]:
    return json.loads((REPORTS / f"trade-{model}.json").read_text(encoding="utf-8"))


@pytest.mark.parametrize("model", MODELS)
def test_targets_are_within_a_tenth_of_the_best_point(model: str) -> None:
    found = chosen_of(kept(model))
    assert [one.target for one in found] == list(TARGETS)
    assert all(one.ratio <= WORSE for one in found), [one for one in found if one.ratio > WORSE]


@pytest.mark.parametrize("model", MODELS)
def test_reports_are_of_what_targets_choose_now(model: str) -> None:
    """A fault: the table changed, and what it chooses now was not measured."""
    facts = kept(model)
    quick = len(facts["points"]) < len(settings(Options()))
    assert facts["targets"] == chosen_by_targets(Options(), settings(Options(), quick=quick))
    assert set(facts["targets"].values()) <= {point["name"] for point in facts["points"]}


def test_a_worse_choice_is_found() -> None:
    facts = kept("bunny")
    point = next(point for point in facts["points"] if point["name"] == facts["targets"]["small"])
    before = point["disk_per_triangle"]
    point["disk_per_triangle"] = 1.2 * before
    small = next(one for one in chosen_of(facts) if one.target == "small")
    assert small.best != small.point
    assert small.ratio > 1.05
    # As small as it was, but beyond the bound, or with a leak.
    for name, value in (("declared_bound", 1e-3), ("leaks", 1)):
        worse = {**point, "disk_per_triangle": before, name: value}
        others = [other for other in facts["points"] if other["name"] != point["name"]]
        found = chosen_of({**facts, "points": [*others, worse]})
        assert next(one for one in found if one.target == "small").ratio > WORSE


def test_the_best_point_equals_a_plain_search() -> None:
    """The slow twin, for `balanced`."""
    facts = kept("chandelier")
    base = facts["points"][0]
    costs = {}
    for point in facts["points"]:
        row = median_row([(point, base)])
        wrong = point["leaks"] or point["disagreements"] or point["declared_bound"] > 1e-5
        left_out = ("simplification", "triangle test", "box precision", "traced hierarchy")
        if wrong or any(part in point["factor"] for part in left_out):
            continue
        costs[point["name"]] = row.memory / row.speed
    found = next(one for one in chosen_of(facts) if one.target == "balanced")
    assert found.best == min(costs, key=lambda name: costs[name])
    assert found.best_cost == min(costs.values())


def test_readme_says_what_the_report_says() -> None:
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    assert "samples/reports/trade-bunny.png" in text
    plain = re.sub(r"\s+", " ", text)
    assert all(sentence in plain for sentence in sentences(Trade.from_dict(kept("bunny"))))


def test_the_package_s_table_is_of_these_reports() -> None:
    whole = [f for f in map(kept, MODELS) if len(f["points"]) >= len(settings(Options()))]
    models = json.loads((ROOT / "striptools" / "choose_table.json").read_text(encoding="utf-8"))["models"]
    assert sorted(models) == sorted(facts["model"] for facts in whole)
    rows = {(row.factor, row.value) for row in shipped_table()}
    assert rows == {(row.factor, row.value) for row in read_table(REPORTS / "trade-bunny.json")}
