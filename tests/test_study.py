"""The study of stripifiers: the same triangles in every row, the paper's ratios, tables, plot, refusals."""

import csv
import dataclasses
import io
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from strategies import sphere

import striptools
from striptools.errors import MissingExtraError, UsageError
from striptools.measure.plots import plot_study
from striptools.measure.study import PAPER, Study, StudyOptions, paper_range, study_strips, variants
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.strips.ordering import LARGEST_LENGTH, OrderingOptions
from striptools_cli.study import printed

QUICK = StudyOptions(Options(ordering=OrderingOptions(32)), side=16, runs=2)


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    return Mesh(*sphere(3))


@pytest.fixture(scope="module")
def study(mesh: Mesh) -> Study:
    return study_strips(mesh, QUICK)


def test_the_paper_s_ratios_are_those_of_its_table() -> None:
    assert [round(ratio, 2) for ratio in paper_range("stripe") or ()] == [1.05, 1.59]
    assert [round(ratio, 2) for ratio in paper_range("tipsify") or ()] == [1.08, 1.87]
    assert paper_range("strip-rt") is paper_range("paper") is None
    assert max(row.megabytes[1] / row.megabytes[2] for row in PAPER) < 1.056


def test_variants_are_strip_rt_the_paper_and_the_baselines() -> None:
    found = variants(OrderingOptions(32, effort="best"))
    assert list(found) == ["strip-rt", "paper", "stripe", "stripe, 32", "tipsify", "tipsify, 32"]
    assert found["strip-rt"] == OrderingOptions(32, effort="best")
    assert [found[name].max_length for name in ("stripe", "tipsify")] == [LARGEST_LENGTH] * 2
    assert {ordering.method for ordering in found.values()} == {"strip-rt", "paper", "stripe", "tipsify"}


def test_every_row_is_measured(study: Study) -> None:
    first = study.rows[0]
    assert first.variant == "strip-rt"
    assert (first.primary_ratio, first.secondary_ratio) == (1.0, 1.0)
    assert (study.triangles, study.primary_rays) == (512, 256)
    assert 0 < study.secondary_rays < study.primary_rays
    for row in study.rows:
        assert row.quality.triangles == study.triangles
        assert min(row.primary_rate, row.secondary_rate, row.primary_ratio, row.secondary_ratio) > 0
        assert row.primary_steps >= 1
        assert row.secondary_steps >= 1
        assert row.order_seconds >= 0
        assert row.swap_bytes == row.scene_bytes - 512 // 8 + row.quality.swaps
        assert row.quality.longest <= (row.max_length or 512)
        assert row.quality.full_cost == first.quality.full_cost


def test_short_strips_take_no_more_memory_than_tipsify_s(study: Study) -> None:
    by_name = {row.variant: row for row in study.rows}
    short = study.rows[-1]
    assert short.method == "strip-rt"
    assert short.variant == f"strip-rt, {short.max_length}"
    assert short.scene_bytes <= by_name["tipsify"].scene_bytes
    assert short.quality.relative_cost < by_name["tipsify"].quality.relative_cost


def test_a_study_tells_how_far_it_is(mesh: Mesh) -> None:
    told = []
    study_strips(
        mesh, dataclasses.replace(QUICK, runs=1), watch=lambda stage, part: told.append((stage, part))
    )
    assert list(dict.fromkeys(stage for stage, _ in told)) == ["convert", "compile", "trace"]
    assert all(0 <= part < 1 for _, part in told)


def test_a_model_that_no_ray_meets_is_studied_all_the_same() -> None:
    # A triangle edge-on to the camera: no hit, so no secondary ray.
    edge_on = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 1]], np.float32)
    tilt = np.array([0.55, 0.38, 1.0])
    across = np.cross(tilt, [0, 1, 0])
    positions = (edge_on[:, :1] * tilt + edge_on[:, 2:] * across).astype(np.float32)
    study = study_strips(Mesh(positions, np.array([[0, 1, 2]], np.int32)), QUICK)
    assert study.triangles == 1
    assert all(row.secondary_ratio == 1.0 for row in study.rows if study.secondary_rays == 0)


@pytest.mark.parametrize("wrong", [{"side": 7}, {"side": 10_000}, {"runs": 0}, {"up": "w"}])
def test_options_out_of_range_are_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(UsageError, match=next(iter(wrong))):
        StudyOptions(**wrong)  # pyright: ignore[reportArgumentType]


# Tables and plot


def test_tables_hold_every_row_in_every_format(study: Study) -> None:
    names = [row.variant for row in study.rows]
    text = printed(study, "text", "ball.ply")
    assert text.startswith("ball.ply: 512 triangles, 256 primary")
    assert all(text.count(f"\n  {name} ") == 2 for name in names)
    assert "1.05-1.59" in text
    assert "1.08-1.87" in text
    rows = list(csv.DictReader(io.StringIO(printed(study, "csv", ""))))
    assert [row["variant"] for row in rows] == names
    assert float(rows[0]["relative_cost"]) == study.rows[0].quality.relative_cost
    facts = json.loads(printed(study, "json", ""))
    assert [row["variant"] for row in facts["rows"]] == names
    assert facts["rows"][0]["quality"]["lengths"]["16"] >= 0
    assert facts["triangles"] == 512
    assert printed(study, "md", "ball.ply").count("\n|") == 2 * (len(names) + 2)


def test_the_plot_is_a_picture_and_the_same_each_time(study: Study) -> None:
    image = pytest.importorskip("PIL.Image", reason="the extra trace is not installed")
    pytest.importorskip("matplotlib", reason="the extra plots is not installed")
    one, other = io.BytesIO(), io.BytesIO()
    assert plot_study(study, one, "ball.ply") == len(one.getvalue())
    plot_study(study, other, "ball.ply")
    assert one.getvalue() == other.getvalue()
    picture = np.asarray(image.open(one))
    assert picture.shape[:2] == (880, 1320)
    assert len(np.unique(picture.reshape(-1, picture.shape[2]), axis=0)) > 20


def test_plots_name_the_extra_they_need(study: Study, monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingExtraError, match=r"striptools\[plots\]"):
        plot_study(study, tmp_path / "x.png")
    assert list(tmp_path.iterdir()) == []


# The verb


@pytest.fixture
def ball(mesh: Mesh, tmp_path: Path) -> Path:
    striptools.save_mesh(mesh, tmp_path / "ball.ply")
    return tmp_path / "ball.ply"


def test_study_prints_json_and_writes_plot_and_table(ball: Path, run) -> None:
    pytest.importorskip("matplotlib", reason="the extra plots is not installed")
    out = ball.parent / "new" / "folder"
    options = ["--side", 16, "--runs", 1, "--max-length", 32, "--out", out, "--format", "json", "--quiet"]
    code, printed_, err = run("study", "strips", ball, *options)
    assert (code, err) == (0, "")
    assert json.loads(printed_)["rows"][1]["variant"] == "paper"
    assert sorted(path.name for path in out.iterdir()) == ["ball-strips.csv", "ball-strips.png"]


def test_study_refuses_before_it_works(ball: Path, run, monkeypatch) -> None:
    assert run("study", "colours", ball)[0] == 2
    assert run("study", "strips", ball, "--side", 4)[0] == 2
    assert run("study", "strips", ball.parent / "no.ply")[0] == 3
    code, _, err = run("study", "strips", ball, "--out", ball)
    assert (code, "is no folder" in err) == (2, True)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    code, printed_, err = run("study", "strips", ball, "--out", ball.parent / "new")
    assert (code, printed_) == (2, "")
    assert "striptools[plots]" in err
    assert not (ball.parent / "new").exists()
