"""`striptools bench`: the project's figures on any models, kept in a file and compared with the last ones."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

import striptools
from striptools.errors import UsageError
from striptools.measure.bench import QUICK, BenchOptions, append, bench, got_worse, last_rows
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools_cli import log, notice
from striptools_cli.options import format_option, quiet_option
from striptools_cli.progress import StageProgress
from striptools_cli.report import Format, render, render_table
from striptools_cli.streams import say

_CLONE = Path(striptools.__file__).parent.parent
_SHOWN = ("mesh", "metric", "value", "unit", "peer", "peer_value", "ratio")


def run(
    models: Annotated[
        list[str] | None,
        typer.Argument(
            metavar="[MESH...]", help="Models; without any a clone's samples.", show_default=False
        ),
    ] = None,
    meshes: Annotated[
        str | None, typer.Option(metavar="DIR", help="Every .ply, .obj, .stl and .glb in a folder too.")
    ] = None,
    results: Annotated[
        str,
        typer.Option(metavar="FILE", help="The file that figures are compared with and added to."),
    ] = "bench.csv",
    quick: Annotated[bool, typer.Option("--quick", help="Few rays and runs.")] = False,
    form: Annotated[Format, format_option("the figures")] = "text",
    quiet: Annotated[bool, quiet_option("errors and figures")] = False,
) -> None:
    """Measure bytes, seconds, rays a second and verification, and say what got worse on this machine.

    Figures are added to FILE with machine and versions. embreex is measured in the same run where it is
    installed. What needs a clone (other peers, GPUs, long runs) is in its tests/benches, and listed.
    """
    log.set_up(quiet=quiet)
    paths = _paths(models or [], meshes)
    loaded: dict[str, Mesh] = {path.stem: load_mesh(path) for path in paths}
    file = Path(results)
    before = last_rows(file)
    notice.before_tracing(quiet=quiet)
    with StageProgress(quiet=quiet) as progress:
        rows = bench(loaded, QUICK if quick else BenchOptions(), progress.watch)
    append(rows, file)
    worse = got_worse(rows, before)
    if form == "json":
        say(render({"rows": [asdict(row) for row in rows], "worse": worse}, "json"))
        return
    table = [{name: getattr(row, name) for name in _SHOWN} for row in rows]
    say(render_table(table, form, f"added to {file}"))
    if not quiet:
        said = [f"worse: {line}" for line in worse] or [
            "nothing got worse" if before else "no earlier figures of this machine to compare with"
        ]
        say("".join(f"{line}\n" for line in [*said, *_scripts()]), error=True)


def _paths(models: list[str], folder: str | None) -> list[Path]:
    paths = [Path(name) for name in models]
    if folder is not None:
        suffixes = (".ply", ".obj", ".stl", ".glb")
        paths += sorted(path for path in Path(folder).glob("*") if path.suffix.lower() in suffixes)
    if not paths:
        paths = sorted((_CLONE / "samples").glob("*.ply"))
    if not paths:
        raise UsageError("no model to measure", remedy="name some, or a folder by --meshes")
    return paths


def _scripts() -> list[str]:
    """What else a clone can measure: its scripts, and what each is for."""
    found = sorted((_CLONE / "tests" / "benches").glob("bench_*.py"))
    heads = [path.read_text(encoding="utf-8").split('"""')[1].splitlines()[0] for path in found]
    lines = [f"  {path.relative_to(_CLONE)}: {head}" for path, head in zip(found, heads, strict=True)]
    return ["further figures, each by a script of this clone:", *lines] if lines else []
