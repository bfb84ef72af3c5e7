"""The results file and the scripts: what is written comes back, what got worse is said, groups are run."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from striptools.measure import bench as module
from striptools.measure.bench import QUICK, BenchOptions, Row, append, bench, got_worse, last_rows
from striptools.measure.bench_scripts import Script, part_of, rows_of, run_script, scripts
from striptools.measure.verify import VerifyOptions
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools_cli import bench as command

Run = Callable[..., tuple[int, str, str]]
CLONE = Path(__file__).parent.parent
CHANDELIER = CLONE / "samples" / "chandelier.ply"

ROWS = [
    Row("package", "m", 10, "file", 6.5, "bytes per triangle"),
    Row("package", "m", 10, "rays", 2.0, "M rays/s", "embreex", 4.0, 0.5),
    Row("package", "m", 10, "speed", 1.0, "M triangles/s"),
    Row("package", "m", 10, "verify: leaks", 0, "rays"),
    Row("archive", "m", 10, "archive", 4.0, "bytes per triangle", "meshoptimizer", 4.0, 1.0),
    Row("pipeline", "m", 10, "stage load", 1.0, "s"),
    Row("pipeline", "m", 10, "stage order", 0.01, "s"),
    Row("archive", "m", 10, "Draco -cl 10", 4.0, "bytes per triangle"),
    Row("pipeline", "m", 10, "rays verified", 4, "rays"),
    Row("strips", "m", 10, "vertices per triangle", 1.0, ""),
    Row("speed", "m", 10, "stage write", 1.0, "s", note="2 threads, same 0.5"),
]


def test_nothing_is_worse_than_itself(tmp_path: Path) -> None:
    file = tmp_path / "bench.csv"
    assert last_rows(file) == {}
    assert got_worse(ROWS, last_rows(file)) == []
    append(ROWS, file)
    append(ROWS, file)
    assert len(file.read_text().splitlines()) == 1 + 2 * len(ROWS)
    assert got_worse(ROWS, last_rows(file)) == []


@pytest.mark.parametrize(
    ("row", "change", "worse"),
    [
        (0, {"value": 6.51}, True),
        (0, {"value": 6.4}, False),
        (1, {"value": 1.0}, False),  # The machine is slower, the ratio is not.
        (1, {"ratio": 0.44}, True),
        (1, {"ratio": 0.46}, False),
        (1, {"ratio": 0.4, "peer": "another"}, False),  # A ratio to somebody else says nothing.
        (2, {"value": 0.7}, True),
        (2, {"value": 0.8}, False),
        (2, {"value": 2.0}, False),
        (3, {"value": 1}, True),
        (4, {"ratio": 1.11}, True),  # Less is better, of a ratio too.
        (4, {"ratio": 1.0, "value": 9.0}, False),
        (4, {"ratio": 0.5}, False),
        (5, {"value": 1.3}, True),
        (5, {"value": 1.2}, False),
        (5, {"value": 0.1}, False),
        (6, {"value": 0.019}, False),  # Too short to tell.
        (6, {"value": 0.03}, True),
        (7, {"value": 9.0}, False),  # Of a peer alone.
        (8, {"value": 9}, False),  # How many rays there were is no merit.
        (9, {"value": 1.01}, True),
        (10, {"value": 3.0, "note": "4 threads"}, False),  # Other parameters, another figure.
        (10, {"value": 3.0, "note": "2 threads, same 0.25"}, True),
    ],
)
def test_what_got_worse_is_said(tmp_path: Path, row: int, change: dict[str, float], worse: bool) -> None:
    file = tmp_path / "bench.csv"
    append(ROWS, file)
    found = got_worse([replace(ROWS[row], **change)], last_rows(file))
    assert len(found) == worse
    if worse:
        assert ROWS[row].metric in found[0]


def test_another_machine_is_not_compared_with(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    append(ROWS, tmp_path / "bench.csv")
    monkeypatch.setattr(module, "machine", lambda: "another")
    assert last_rows(tmp_path / "bench.csv") == {}


def test_a_model_has_every_figure() -> None:
    whole = load_mesh(CHANDELIER)
    options = replace(QUICK, side=16, runs=1, verify=VerifyOptions(rays=4, aimed_rays=64))
    rows = bench({"part": Mesh(whole.positions, whole.faces[:2000])}, options)
    found = {row.metric: row.value for row in rows}
    assert found["verify: leaks"] == found["verify: disagreements"] == 0
    assert 0 < found["file on a grid of 16 bits"] < found["file"] < found["as traced, compressed"]
    assert found["camera rays, one thread"] > 0


def test_rows_come_back_as_they_were_written(tmp_path: Path) -> None:
    append(ROWS, tmp_path / "bench.csv")
    assert rows_of(tmp_path / "bench.csv") == ROWS


@pytest.mark.parametrize("script", scripts(CLONE), ids=lambda script: script.group)
def test_each_script_says_how_it_is_called(script) -> None:
    assert script.full
    text = script.path.read_text()
    for run in (*script.full, *script.quick):
        for flag in (word for word in (*run, "--record") if word.startswith("--")):
            assert f'add_argument("{flag}"' in text
    taken = {
        "paths": ["models", "meshes"],
        "folder": ["folder"],
        "named": ["folders"],
        "nothing": ["--record"],
    }
    assert any(f'add_argument("{name}"' in text for name in taken[script.takes])


def test_what_the_results_hold_is_measured_by_a_script_or_here() -> None:
    """No figure is left that one command does not repeat."""
    groups = {script.group for script in scripts(CLONE)}
    benches = {row.bench for row in rows_of(CLONE / "tests" / "benches" / "results.csv")}
    assert benches <= groups | {"package"}


FAKE = '''"""Fake."""
import argparse, os, sys
from striptools.measure.bench import Row, append
from pathlib import Path
BENCH = {BENCH}
parser = argparse.ArgumentParser()
parser.add_argument("models", nargs="+")
parser.add_argument("--value", type=float, default=1.0)
parser.add_argument("--record", action="store_true")
given = parser.parse_args()
rows = [Row("fake", Path(model).stem, 1, "size", given.value, "B") for model in given.models]
append(rows, Path(os.environ["STRIPTOOLS_RESULTS"]))
sys.exit(END)
'''


def clone_with(folder: Path, plan: dict[str, object], end: int = 0) -> Path:
    """A clone with one script."""
    benches = folder / "clone" / "tests" / "benches"
    benches.mkdir(parents=True, exist_ok=True)
    text = FAKE.replace("END", str(end)).replace("{BENCH}", repr(plan))
    (benches / "bench_fake.py").write_text(text)
    return folder / "clone"


def test_a_script_is_run_on_its_models(tmp_path: Path) -> None:
    plan = {"models": ["a", "b"], "full": [[], ["--value", "2"]], "quick": [["--value", "3"]]}
    (script,) = scripts(clone_with(tmp_path, plan))
    models = [tmp_path / name for name in ("a.ply", "c.ply", "b.ply")]
    assert script.chosen(models) == [models[0], models[2]]
    assert script.chosen(models[1:2]) == models[1:2]
    rows, wrong = run_script(script, script.chosen(models), quick=False)
    assert [(row.mesh, row.value) for row in rows] == [("a", 1), ("b", 1), ("a", 2), ("b", 2)]
    assert wrong == []
    rows, wrong = run_script(script, models[1:2], quick=True)
    assert [(row.mesh, row.value) for row in rows] == [("c", 3)]


def test_models_are_named_as_a_script_takes_them(tmp_path: Path) -> None:
    models = [tmp_path / "a.ply", tmp_path / "b.obj", tmp_path / "more" / "c.ply"]
    for takes, wanted in (
        ("paths", [[str(path) for path in models]]),
        ("folder", [[str(tmp_path), "a"], [str(tmp_path / "more"), "c"]]),
        ("named", [[str(tmp_path), "--mesh", "a"], [str(tmp_path / "more"), "--mesh", "c"]]),
        ("nothing", [[]]),
    ):
        (script,) = scripts(clone_with(tmp_path, {"takes": takes, "full": [["--x"]], "quick": []}))
        calls = list(script.calls(models, quick=False))
        assert calls == [[str(script.path), *given, "--x", "--record"] for given in wanted]


def test_a_script_that_fails_is_told(tmp_path: Path) -> None:
    (script,) = scripts(clone_with(tmp_path, {"full": [[]], "quick": [["--nonsense"]]}, end=3))
    rows, wrong = run_script(script, [tmp_path / "a.ply"], quick=False)
    assert len(rows) == 1
    assert wrong == ["fake: ended with 3: it said nothing"]
    rows, wrong = run_script(script, [tmp_path / "a.ply"], quick=True)
    assert rows == []
    assert "unrecognized arguments" in wrong[0]


def test_what_a_script_needs_is_looked_for(tmp_path: Path) -> None:
    plan = {"full": [[]], "quick": [[]], "needs": ["numpy", "no_such_package"], "peers": ["nor_this", "csv"]}
    (script,) = scripts(clone_with(tmp_path, plan))
    assert script.missing() == ["no_such_package"]
    assert script.absent() == ["no_such_package", "nor_this"]


def test_a_part_of_a_model_is_a_model(tmp_path: Path) -> None:
    path = part_of(CHANDELIER, tmp_path)
    assert path.stem == "part_of_chandelier"
    assert load_mesh(path).triangle_count == 6000


def test_the_command_compares_and_ends_with_1_where_something_got_worse(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    model, file = tmp_path / "one.ply", tmp_path / "bench.csv"
    model.write_bytes(part_of(CHANDELIER, tmp_path).read_bytes())
    # Only on a bare machine it is said that the tracer is compiled.
    monkeypatch.setattr(command.notice, "before_tracing", lambda **_: None)

    def measured(value: str, *more: str, end: int = 0, needs: tuple[str, ...] = ()) -> tuple[int, str]:
        plan = {"full": [["--value", value]], "quick": [["--value", value]], "needs": needs}
        monkeypatch.setattr(command, "_CLONE", clone_with(tmp_path, plan, end))
        code, _, said = run("bench", model, "--results", file, "--only", "fake", *more)
        *lines, took = said.splitlines(keepends=True)
        assert re.fullmatch(r"took \d+ s\n", took)
        return code, "".join(lines)

    assert measured("10") == (0, "no earlier figures of this machine to compare with\n")
    assert measured("10") == (0, "nothing got worse\n")
    code, said = measured("11")
    assert code == 1
    assert said.startswith("worse: fake: one: size: 11 B, was 10 on ")
    code, said = measured("11", end=3)
    assert (code, said) == (1, "failed: fake: ended with 3: it said nothing\n")
    monkeypatch.setattr(command, "_CLONE", clone_with(tmp_path, {"full": [[]]}))
    said = run("bench", model, "--quick", "--only", "fake", "--results", file)[2]
    assert "left out: fake (takes long)" in said
    assert "left out: fake (needs no_such_package)" in measured("11", needs=("no_such_package",))[1]
    # With little time another model is measured, which has no earlier figures.
    assert measured("99", "--quick") == (0, "nothing got worse\n")
    assert [row.mesh for row in rows_of(file)] == ["one"] * 4 + ["part_of_one"]
    code, _, said = run("bench", model, "--only", "nothing")
    assert code == 2
    assert "give one of package, fake" in said


def test_without_a_clone_the_package_is_measured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    monkeypatch.setattr(command, "_CLONE", tmp_path)
    model = part_of(CHANDELIER, tmp_path)
    code, _, said = run("bench", model, "--quick", "--results", tmp_path / "bench.csv")
    assert code == 0
    assert "in a clone's tests/benches" in said
    assert {row.bench for row in rows_of(tmp_path / "bench.csv")} == {"package"}


QUICK_GROUPS = {
    *("archive", "classic", "format", "instances", "pipeline", "resident"),
    *("speed", "strips", "strips_peers", "trace", "trade"),
}
"""What is measured where little time is given: a figure of each part, and each installed peer."""


def test_quick_runs_the_quick_cases_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    models = [tmp_path / name for name in ("first.ply", "second.ply")]
    for model in models:
        model.write_bytes(part_of(CHANDELIER, tmp_path).read_bytes())
    measured, ran = [], []

    def own(given: dict[str, Mesh], options: BenchOptions) -> list[Row]:
        measured.append((list(given), options))
        return []

    def script_run(script: Script, given: list[Path], *, quick: bool) -> tuple[list[Row], list[str]]:
        ran.extend((script, given, call) for call in script.calls(given, quick=quick))
        return [], []

    monkeypatch.setattr(command, "bench", own)
    monkeypatch.setattr(command, "run_script", script_run)
    code, out, _ = run("bench", *models, "--quick", "--results", tmp_path / "bench.csv", "--format", "json")
    assert code == 0
    assert json.loads(out)["seconds"] >= 0
    assert measured == [(["first"], QUICK)]
    assert {script.group for script, *_ in ran} - {"gpu", "gpu_yardstick"} == QUICK_GROUPS - {
        script.group for script in scripts(CLONE) if script.missing()
    }
    for script, given, call in ran:
        assert [path.stem for path in given] == ["part_of_first"]
        assert any(tuple(call[-1 - len(case) : -1]) == case for case in script.quick)
    # Without it all of them, and what takes long.
    ran.clear()
    assert run("bench", models[0], "--results", tmp_path / "bench.csv")[0] == 0
    assert {"leaks", "hierarchies", "scaling"} <= {script.group for script, *_ in ran}
    assert measured[-1] == (["first"], BenchOptions())


def test_what_was_measured_before_an_interruption_is_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    def interrupted(*_: object, **__: object) -> tuple[list[Row], list[str]]:
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "_CLONE", clone_with(tmp_path, {"full": [[]]}))
    monkeypatch.setattr(command, "bench", lambda *_: [Row("package", "one", 1, "file", 2.0, "B")])
    monkeypatch.setattr(command, "run_script", interrupted)
    file = tmp_path / "bench.csv"
    code, _, _ = run("bench", part_of(CHANDELIER, tmp_path), "--results", file)
    assert code == 130
    assert [row.metric for row in rows_of(file)] == ["file"]


def test_a_real_script_is_run(tmp_path: Path) -> None:
    (script,) = (script for script in scripts(CLONE) if script.group == "strips")
    rows, wrong = run_script(script, [part_of(CHANDELIER, tmp_path)], quick=True)
    assert wrong == []
    assert {row.bench for row in rows} == {"strips"}
    assert len(rows) > 10
