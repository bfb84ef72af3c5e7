"""The scripts of a clone that measure what takes peers, GPUs or long runs: found, planned, run one by one.

A script is tests/benches/bench_GROUP.py. It says by a literal `BENCH`, which is read and never run, how it is
called:

    takes   "paths" of models, a "folder" and names in it, "named" for names behind --mesh, or "nothing"
    models  names of those that the project's figures are of; without it, any
    full    lists of arguments, a run each
    quick   the same where little time is given; none where that is not enough
    needs   packages without which it cannot run, or "gpu"
    peers   packages that it measures beside, where they are there

It is given `--record`, and writes its figures to the file that `STRIPTOOLS_RESULTS` names. Each run is a
process of its own, as when somebody calls the script: a figure is the same either way.
"""

import ast
import csv
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from striptools.measure.bench import Row
from striptools.mesh.io import load_mesh, save_mesh
from striptools.mesh.mesh import Mesh

RESULTS = "STRIPTOOLS_RESULTS"
"""The variable that names the file for a script's figures."""

PART = 6000
"""Triangles of the part of a model that is measured where little time is given."""


@dataclass(frozen=True)
class Script:
    """A script, and how it is called; see the head of this module.

    Attributes:
        group: Its name without `bench_`.
        path: Where it is.
        takes: What it is given models as.
        models: Names; empty for any.
        full: Arguments of each run.
        quick: Arguments of each run where little time is given.
        needs: What must be there.
        peers: What is measured beside it.
    """

    group: str
    path: Path
    takes: Literal["paths", "folder", "named", "nothing"]
    models: tuple[str, ...]
    full: tuple[tuple[str, ...], ...]
    quick: tuple[tuple[str, ...], ...]
    needs: tuple[str, ...]
    peers: tuple[str, ...]

    def missing(self) -> list[str]:
        """What it needs and is not here."""
        return [name for name in self.needs if not _is_here(name)]

    def absent(self) -> list[str]:
        """The peers that are not installed."""
        return [name for name in (*self.needs, *self.peers) if name != "gpu" and not _is_here(name)]

    def chosen(self, models: list[Path]) -> list[Path]:
        """Of the models those that its figures are of; all where none of them is."""
        return [path for path in models if path.stem in self.models] or models

    def calls(self, models: list[Path], *, quick: bool) -> Iterator[list[str]]:
        """The command line of each run, without the interpreter."""
        for arguments in self.quick if quick else self.full:
            for given in self._given(models):
                yield [str(self.path), *given, *arguments, "--record"]

    def _given(self, models: list[Path]) -> Iterator[list[str]]:
        if self.takes in ("paths", "nothing"):
            yield [str(path) for path in models if self.takes == "paths"]
            return
        # Scripts that take a folder read .ply files in it.
        for folder in sorted({path.parent for path in models}):
            names = [path.stem for path in models if path.parent == folder and path.suffix == ".ply"]
            if names:
                named = [word for name in names for word in ("--mesh", name)]
                yield [str(folder), *(named if self.takes == "named" else names)]


def scripts(clone: Path) -> list[Script]:
    """The scripts of a clone, in the order of their names; none where this is no clone."""
    return [_planned(path) for path in sorted((clone / "tests" / "benches").glob("bench_*.py"))]


def _planned(path: Path) -> Script:
    """What a script says of itself."""
    found = {}
    for line in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(line, ast.Assign) and getattr(line.targets[0], "id", "") == "BENCH":
            found = ast.literal_eval(line.value)
    runs = {kind: tuple(tuple(run) for run in found.get(kind, ())) for kind in ("full", "quick")}
    names = {kind: tuple(found.get(kind, ())) for kind in ("models", "needs", "peers")}
    return Script(path.stem.removeprefix("bench_"), path, found.get("takes", "paths"), **runs, **names)


def _is_here(name: str) -> bool:
    if name != "gpu":
        return find_spec(name) is not None
    import jax

    return jax.default_backend() == "gpu"


def run_script(script: Script, models: list[Path], *, quick: bool) -> tuple[list[Row], list[str]]:
    """Run a script on models.

    Returns:
        Its figures, and what went wrong, in words, a run each.
    """
    rows, wrong = [], []
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rows.csv"
        for call in script.calls(models, quick=quick):
            environment = os.environ | {RESULTS: str(file)}
            done = subprocess.run(
                [sys.executable, *call], env=environment, capture_output=True, text=True, check=False
            )
            if done.returncode:
                said = (done.stderr or done.stdout).strip().splitlines() or ["it said nothing"]
                wrong.append(f"{script.group}: ended with {done.returncode}: {said[-1]}")
        if file.exists():
            rows = rows_of(file)
    return rows, wrong


def rows_of(file: Path) -> list[Row]:
    """The figures in a results file, in its order."""
    with file.open(newline="", encoding="utf-8") as lines:
        return [_row(row) for row in csv.DictReader(lines)]


def _row(cells: dict[str, str]) -> Row:
    what = (cells["bench"], cells["mesh"], int(cells["triangles"]), cells["metric"])
    peer_value, ratio = (float(cells[name]) if cells[name] else None for name in ("peer_value", "ratio"))
    return Row(*what, float(cells["value"]), cells["unit"], cells["peer"], peer_value, ratio, cells["note"])


def part_of(model: Path, folder: Path) -> Path:
    """Write the first triangles of a model into a folder, under a name that says so."""
    mesh = load_mesh(model)
    path = folder / f"part_of_{model.stem}.ply"
    save_mesh(Mesh(mesh.positions, mesh.faces[:PART]), path)
    return path
