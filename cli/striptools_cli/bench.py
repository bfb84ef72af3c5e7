"""`striptools bench`: the project's figures on any models, kept in a file and compared with the last ones."""

import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

import striptools
from striptools.errors import EXIT_DONE, EXIT_ISSUES, UsageError
from striptools.measure.bench import (
    NAME,
    NOISE,
    QUICK,
    BenchOptions,
    Row,
    append,
    bench,
    got_worse,
    has_embree,
    last_rows,
)
from striptools.measure.bench_scripts import Script, part_of, run_script, scripts
from striptools.mesh.io import load_mesh
from striptools_cli import log, notice
from striptools_cli.options import format_option, quiet_option
from striptools_cli.progress import StageProgress
from striptools_cli.report import Format, render, render_table
from striptools_cli.streams import say

_CLONE = Path(striptools.__file__).parent.parent
_SHOWN = ("bench", "mesh", "metric", "value", "unit", "peer", "peer_value", "ratio")


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
    only: Annotated[
        list[str] | None,
        typer.Option(
            metavar="GROUP", help="Only this group of figures; may be given again.", show_default=False
        ),
    ] = None,
    quick: Annotated[
        bool,
        typer.Option(
            "--quick",
            help="Few rays and runs, a part of the first model, no group that takes long: under two minutes.",
        ),
    ] = False,
    tolerance: Annotated[
        float | None,
        typer.Option(
            metavar="PERCENT",
            min=0,
            help="How much slower is no worse; 25, or 50 with --quick. Bytes and counts have none.",
            show_default=False,
        ),
    ] = None,
    form: Annotated[Format, format_option("the figures")] = "text",
    quiet: Annotated[bool, quiet_option("errors and figures")] = False,
) -> None:
    """Measure every figure beside the installed peers, and say what got worse on this machine.

    Figures are added to FILE with machine and versions, a group at a time. The group `package` (bytes,
    seconds, rays a second, verification) is there wherever striptools is; a clone has a group for each script
    in its tests/benches. Ends with 1 where a figure got worse or a script failed.
    """
    log.set_up(quiet=quiet)
    groups = _groups(only or [])
    paths = _paths(models or [], meshes)
    file = Path(results)
    before = last_rows(file)
    notice.before_tracing(quiet=quiet)
    begun = time.monotonic()
    rows: list[Row] = []
    wrong: list[str] = []
    with StageProgress(quiet=quiet) as progress:
        # A run may take hours: what each group found is kept as soon as it is known.
        for found, said in _measured(groups, paths, quick=quick, progress=progress):
            append(found, file)
            rows, wrong = rows + found, wrong + said
    seconds = time.monotonic() - begun
    share = tolerance / 100 if tolerance is not None else NOISE * (2 if quick else 1)
    worse = got_worse(rows, before, noise=share)
    if form == "json":
        found = {"rows": [asdict(row) for row in rows], "worse": worse, "failed": wrong, "seconds": seconds}
        say(render(found, "json"))
    else:
        table = [{name: getattr(row, name) for name in _SHOWN} for row in rows]
        say(render_table(table, form, f"added to {file}", names=_SHOWN))
    said = [*(f"failed: {line}" for line in wrong), *(f"worse: {line}" for line in worse)]
    if not said and not quiet:
        said = ["nothing got worse" if before else "no earlier figures of this machine to compare with"]
    if not quiet:
        said += [*_left_out(groups, quick=quick), f"took {seconds:.0f} s"]
    say("".join(f"{line}\n" for line in said), error=True)
    raise typer.Exit(EXIT_ISSUES if wrong or worse else EXIT_DONE)


def _groups(only: list[str]) -> dict[str, Script | None]:
    """The groups that are asked for; None stands for the package's own figures.

    Raises:
        UsageError: One of them is not here.
    """
    groups: dict[str, Script | None] = {NAME: None}
    groups |= {script.group: script for script in scripts(_CLONE)}
    for name in only:
        if name not in groups:
            raise UsageError(f"no group {name!r}", where="--only", remedy=f"give one of {', '.join(groups)}")
    return {name: script for name, script in groups.items() if name in only or not only}


def _measured(
    groups: dict[str, Script | None], paths: list[Path], *, quick: bool, progress: StageProgress
) -> Iterator[tuple[list[Row], list[str]]]:
    """The figures of each group that can be measured here, and what went wrong."""
    with tempfile.TemporaryDirectory() as folder:
        paths = paths[:1] if quick else paths
        given = [part_of(paths[0], Path(folder))] if quick and any(groups.values()) else paths
        for done, (name, script) in enumerate(groups.items()):
            progress.watch(name, done / len(groups))
            if script is None:
                loaded = {path.stem: load_mesh(path) for path in paths}
                yield bench(loaded, QUICK if quick else BenchOptions()), []
            elif not script.missing():
                yield run_script(script, script.chosen(given), quick=quick)


def _left_out(groups: dict[str, Script | None], *, quick: bool) -> list[str]:
    """What could not be measured, in a line or two."""
    missing = {name: script.missing() for name, script in groups.items() if script}
    lines = []
    left = [f"{name} (needs {', '.join(what)})" for name, what in missing.items() if what]
    left += [
        f"{name} (takes long)" for name, script in groups.items() if quick and script and not script.quick
    ]
    if left:
        lines.append(f"left out: {'; '.join(left)}")
    absent = {peer for script in groups.values() if script for peer in script.absent()}
    absent |= set() if has_embree() or NAME not in groups else {"embreex"}
    if absent:
        lines.append(f"peers that are not installed: {', '.join(sorted(absent))}")
    if not any(scripts(_CLONE)):
        lines.append("further groups, beside other peers, are in a clone's tests/benches")
    return lines


def _paths(models: list[str], folder: str | None) -> list[Path]:
    paths = [Path(name) for name in models]
    if folder is not None:
        suffixes = (".ply", ".obj", ".stl", ".glb")
        paths += sorted(path for path in Path(folder).glob("*") if path.suffix.lower() in suffixes)
    if not paths:
        paths = sorted((_CLONE / "samples").glob("*.ply"))
    if not paths:
        raise UsageError("no model to measure", remedy="name some, or a folder by --meshes")
    return [path.resolve() for path in paths]
