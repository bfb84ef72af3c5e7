"""The results file: what is written comes back, and what got worse is said, no more and no less."""

from dataclasses import replace
from pathlib import Path

import pytest

from striptools.measure import bench as module
from striptools.measure.bench import QUICK, Row, append, bench, got_worse, last_rows
from striptools.measure.verify import VerifyOptions
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh

CHANDELIER = Path(__file__).parent.parent / "samples" / "chandelier.ply"

ROWS = [
    Row("package", "m", 10, "file", 6.5, "bytes per triangle"),
    Row("package", "m", 10, "rays", 2.0, "M rays/s", "embreex", 4.0, 0.5),
    Row("package", "m", 10, "speed", 1.0, "M triangles/s"),
    Row("package", "m", 10, "verify: leaks", 0, "rays"),
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
        (2, {"value": 0.7}, True),
        (2, {"value": 0.8}, False),
        (2, {"value": 2.0}, False),
        (3, {"value": 1}, True),
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
