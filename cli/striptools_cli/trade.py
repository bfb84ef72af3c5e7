"""`striptools trade`: what bytes, speed and error are traded for each other, measured on any mesh."""

from pathlib import Path
from typing import Annotated

import typer

from striptools.errors import MissingExtraError
from striptools.measure.plots_trade import plot_trade
from striptools.measure.report_html import pictures_of, report_html, sentences, shortfalls, target_lines
from striptools.measure.trade import Point, Trade, TradeOptions, trade
from striptools.mesh.atomic import write_atomically
from striptools.mesh.io import load_mesh
from striptools.options import Options
from striptools_cli import log, notice
from striptools_cli.options import Threads, format_option, from_option, quiet_option
from striptools_cli.options_trace import Device, Up, runs_option, side_option
from striptools_cli.progress import StageProgress
from striptools_cli.report import Format, render, render_table
from striptools_cli.streams import STANDARD, Source, folder_for, input_format, say

_DEFAULTS = TradeOptions()
_QUICK = {"side": 256, "runs": 5, "picture": 128, "verify_rays": 16, "aimed_rays": 2048}
_TEXT = (
    "memory_per_triangle", "disk_per_triangle", "build_seconds", "primary_ratio", "secondary_ratio",
    "largest_error", "declared_bound", "t_rms", "normal_rms", "wrong_per_million", "leaks", "psnr", "flip",
)  # fmt: skip
"""What fits a terminal; json and csv have every figure."""


def run(
    meshes: Annotated[
        list[str], typer.Argument(metavar="MESH...", help="Models; - for standard input.", show_default=False)
    ],
    out: Annotated[
        str | None,
        typer.Option(
            metavar="DIR",
            help="Write report.html, plot.png, tables and pictures there, for several models a folder each; "
            "go on where an interrupted run of the same was.",
            show_default="no",
        ),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Few points and rays: a first impression.")] = False,
    side: Annotated[int | None, side_option(4096, _DEFAULTS.side)] = None,
    runs: Annotated[int | None, runs_option(_DEFAULTS.runs)] = None,
    up: Up = "y",
    device: Device = "auto",
    threads: Threads = None,
    from_format: Annotated[str | None, from_option("MESH")] = None,
    form: Annotated[Format, format_option("the points")] = "text",
    quiet: Annotated[bool, quiet_option("errors and tables")] = False,
) -> None:
    """Measure what bytes, speed and error are traded for each other, one factor at a time.

    Around the default: precision, simplification, strip cap, block size, hierarchy, boxes, residency, box
    precision, the triangle test, a few pairs, and what the targets of convert choose. Every point is traced
    in turn with the default and judged against the source. Boxes in files have 8 bits a plane, expanded ones
    float32; fewer bits are measured, not stored. Needs the extras trace and, for some points, simplify; with
    --out plots too.
    """
    log.set_up(quiet=quiet)
    folder = None if out is None else folder_for(out)
    few = _QUICK if quick else {}
    options = TradeOptions(
        options=Options(threads=threads),
        quick=quick,
        side=side or few.get("side", _DEFAULTS.side),
        runs=runs or few.get("runs", _DEFAULTS.runs),
        picture=few.get("picture", _DEFAULTS.picture),
        verify_rays=few.get("verify_rays", _DEFAULTS.verify_rays),
        aimed_rays=few.get("aimed_rays", _DEFAULTS.aimed_rays),
        up=up,
        device=device,
        threads=threads,
    )
    notice.before_tracing(quiet=quiet)
    done = []
    for mesh in meshes:
        name = "standard-input" if mesh == STANDARD else Path(mesh).stem
        place = folder if folder is None or len(meshes) == 1 else folder_for(str(folder / name))
        done.append(_traded(mesh, name, options, place, from_format, quiet))
        if form != "json":
            say(printed(done[-1], form))
    if form == "json":
        say(
            printed(done[0], form)
            if len(done) == 1
            else render({"trades": [one.to_dict() for one in done]}, form)
        )


def _traded(
    mesh: str, name: str, options: TradeOptions, folder: Path | None, from_format: str | None, quiet: bool
) -> Trade:
    """Measure one model, and write its report."""
    file = Source.open(mesh)
    source = load_mesh(file.file, file_format=input_format(file, from_format) or None)
    with StageProgress(quiet=quiet) as progress:
        found = trade(source, options, model=name, folder=folder, watch=progress.watch)
    if folder is not None:
        _write(found, folder)
        if not quiet:
            say(f"written: {folder / 'report.html'}, plot.png, table.csv, points.json\n", error=True)
    return found


def printed(found: Trade, form: Format) -> str:
    """The points as text, json, csv or md."""
    if form == "json":
        return render(found.to_dict(), "json")
    if form == "csv":
        return render_table([vars(point) for point in found.points], "csv")
    rows = [_row(point) for point in found.points]
    heading = f"{found.model}: {found.triangles:,} triangles; lengths in diagonals, rays over the default's"
    lines = sentences(found) + target_lines(found) + shortfalls(found)
    lines += [f"left out: {name}: {why}" for name, why in found.left_out.items()]
    return render_table(rows, form, heading) + "".join(f"\n{line}\n" for line in lines)


def _row(point: Point) -> dict[str, object]:
    return {"name": point.name, **{name: getattr(point, name) for name in _TEXT}}


def _write(found: Trade, folder: Path) -> None:
    try:
        plot = plot_trade(found)
        write_atomically(folder / "plot.png", plot)
    except MissingExtraError as error:
        plot = None
        say(f"striptools: no plots: {error}\n", error=True)
    write_atomically(folder / "table.csv", printed(found, "csv").encode())
    write_atomically(folder / "points.json", printed(found, "json").encode())
    write_atomically(folder / "report.html", report_html(found, plot, pictures_of(found, folder)).encode())
