"""The command lines of trade, bench, and of convert's wishes: what is printed, and what is refused."""

import json
from pathlib import Path

import pytest

import striptools
from striptools.measure.trade_points import settings
from striptools.mesh.clean import clean
from striptools.mesh.io import load_mesh, save_mesh
from striptools.mesh.mesh import Mesh
from striptools_cli.app import main

CHANDELIER = Path(__file__).parent.parent / "samples" / "chandelier.ply"


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    whole = load_mesh(CHANDELIER)
    path = tmp_path_factory.mktemp("model") / "part.ply"
    save_mesh(clean(Mesh(whole.positions, whole.faces[:3000])).mesh, path)
    return path


def test_a_budget_is_kept_and_recorded(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["convert", str(model), str(tmp_path / "a.rdm"), "--budget", "150kB"]) == 0
    assert "chosen: budget 150,000 bytes: " in capsys.readouterr().out
    scene = striptools.open(tmp_path / "a.rdm")
    assert scene.metadata["chosen"]["resident"] == "compressed"
    assert scene.metadata["chosen"]["resident_bytes"] <= 150_000


def test_a_target_says_why(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["convert", str(model), str(tmp_path / "a.rdm"), "--target", "small"]) == 0
    assert "target small" in capsys.readouterr().out
    assert "target small" in striptools.open(tmp_path / "a.rdm").metadata["chosen"]["why"]


def test_simplified_is_said_and_recorded(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    pytest.importorskip("fast_simplification")
    assert main(["convert", str(model), str(tmp_path / "a.rdm"), "--simplify", "50%"]) == 0
    assert "simplified: " in capsys.readouterr().out
    scene = striptools.open(tmp_path / "a.rdm")
    assert scene.triangle_count == scene.metadata["simplified"]["triangles"] < 2000


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--budget", "many"], "is no size"),
        (["--budget", "1B"], "cannot be kept"),
        (["--budget", "1MB", "--bits", "12"], "--bits is what is to be chosen"),
        (["--target", "best"], "is not known"),
        (["--target", "fast", "--block", "64"], "are what is to be chosen"),
        (["--table", "x.json"], "no --target"),
        (["--target", "fast", "--table", "none.json"], "is no table"),
        (["--simplify", "few"], "is no share"),
        (["--simplify", "0%"], "out of range"),
        (["--simplify-error", "x"], "is no error"),
        (["--simplify", "10%", "--simplify-error", "1e-9rel"], "stray"),
    ],
)
def test_wishes_that_cannot_be_kept(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture, options: list[str], said: str
) -> None:
    assert main(["convert", str(model), str(tmp_path / "a.rdm"), *options]) == 2
    captured = capsys.readouterr()
    assert said in captured.err
    assert captured.err.count("\n") == 1
    assert not (tmp_path / "a.rdm").exists()


def test_wishes_are_for_scenes(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["convert", str(model), str(tmp_path / "a.ply"), "--strips", "--target", "small"]) == 2
    assert "OUT is none" in capsys.readouterr().err


def test_trade_prints_points_and_writes_a_report(
    model: Path, tmp_path: Path, capsys: pytest.CaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("matplotlib")
    monkeypatch.setattr("striptools.measure.trade.settings", lambda *a, **k: settings(*a, **k)[:2])
    arguments = [
        "trade",
        str(model),
        "--quick",
        "--side",
        "32",
        "--runs",
        "1",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main([*arguments, "--format", "json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert [point["factor"] for point in facts["points"]] == ["default", "precision"]
    written = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"report.html", "plot.png", "table.csv", "points.json", "default.png"} <= written
    # Its points are a table to choose by.
    table = ["--target", "small", "--table", str(tmp_path / "out" / "points.json")]
    assert main(["convert", str(model), str(tmp_path / "a.rdm"), *table]) == 0
    capsys.readouterr()
    assert main([*arguments, "--format", "csv"]) == 0
    assert len(capsys.readouterr().out.splitlines()) == 3


def test_bench_adds_to_its_file(model: Path, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    arguments = ["bench", str(model), "--quick", "--results", str(tmp_path / "b.csv"), "--format", "json"]
    arguments += ["--only", "package"]
    assert main(arguments) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["worse"] == []
    assert len((tmp_path / "b.csv").read_text().splitlines()) == 1 + len(facts["rows"])
