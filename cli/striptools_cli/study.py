"""`striptools study`: repeat a table of the literature on a model of one's own."""

import dataclasses
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Annotated, Literal

import typer

from striptools.measure.plots import plot_study, require_plots, titled
from striptools.measure.study import Study, StudyOptions, StudyRow, paper_range, study_strips
from striptools.mesh.atomic import write_atomically
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.stopwatch import Watch
from striptools.strips.ordering import OrderingOptions
from striptools_cli import log, notice
from striptools_cli.options import Threads, format_option, from_option, quiet_option
from striptools_cli.options_trace import Device, Up, runs_option, side_option
from striptools_cli.progress import StageProgress
from striptools_cli.report import Format, render, render_table
from striptools_cli.streams import STANDARD, Source, folder_for, input_format, say

Subject = Literal["strips", "presorted", "slbvh", "kdtree", "loose-octree", "hierarchies"]

_DEFAULTS = StudyOptions()
_ORDER = OrderingOptions()
_QUICK = {"side": 128, "runs": 3}
_MODULES = {"loose-octree": "study_loose"}
"""Of `striptools.measure`, for the subjects whose module is not named after them."""


def run(
    subject: Annotated[Subject, typer.Argument(help="What to compare.")],
    mesh: Annotated[str, typer.Argument(metavar="MESH", help="The model; - for standard input.")],
    out: Annotated[
        str | None,
        typer.Option(
            metavar="DIR", help="Write MODEL-SUBJECT.png (a plot) and .csv there.", show_default="no"
        ),
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Few rays and runs: a first impression.")] = False,
    side: Annotated[int | None, side_option(8192, _DEFAULTS.side)] = None,
    runs: Annotated[int | None, runs_option(_DEFAULTS.runs)] = None,
    max_length: Annotated[
        int, typer.Option(min=1, metavar="N", help="Most triangles in a strip of Strip-RT.")
    ] = _ORDER.max_length,
    up: Up = "y",
    device: Device = "auto",
    threads: Threads = None,
    from_format: Annotated[str | None, from_option("MESH")] = None,
    form: Annotated[Format, format_option("the tables")] = "text",
    quiet: Annotated[bool, quiet_option("errors and tables")] = False,
) -> None:
    """Compare what methods make of a mesh, all else being equal, and what their papers say.

    `strips` repeats Table 3.2 of the Strip-RT paper: memory and traced rays a second of the same scene
    with strips by Strip-RT, by a STRIPE-like greedy and by Tipsify, beside the paper's own ratios and the
    strips' quality. `presorted`, `slbvh`, `kdtree` and `loose-octree` do the like for those hierarchies, and
    `hierarchies` puts all of them into one table. Needs the extra trace, and with --out the extra plots.
    """
    log.set_up(quiet=quiet)
    if out is not None:
        require_plots()
    folder = None if out is None else folder_for(out)
    options = StudyOptions(
        options=Options(ordering=OrderingOptions(max_length), threads=threads),
        side=side or (_QUICK if quick else {}).get("side", _DEFAULTS.side),
        runs=runs or (_QUICK if quick else {}).get("runs", _DEFAULTS.runs),
        up=up,
        device=device,
        threads=threads,
    )
    file = Source.open(mesh)
    source = load_mesh(file.file, file_format=input_format(file, from_format) or None)
    notice.before_tracing(quiet=quiet)
    with StageProgress(quiet=quiet) as progress:
        done = (_strips_done if subject == "strips" else _other_done)(
            subject, source, options, progress.watch
        )
    say(done.printed(form, file.title))
    if folder is not None:
        stem = "standard-input" if mesh == STANDARD else Path(file.title).stem
        picture = folder / f"{stem}-{subject}.png"
        table = picture.with_suffix(".csv")
        if done.plot is not None:
            done.plot(picture, file.title)
        write_atomically(table, done.printed("csv", "").encode())
        if not quiet:
            written = table if done.plot is None else f"{picture} and {table.name}"
            say(f"written: {written}\n", error=True)


@dataclasses.dataclass(frozen=True)
class _Done:
    """A study that is done: what prints it by a format and a title, and what draws it, if anything does."""

    printed: Callable[[Format, str], str]
    plot: Callable[[Path, str], object] | None


def _strips_done(_subject: Subject, source: Mesh, options: StudyOptions, watch: Watch) -> _Done:
    study = study_strips(source, options, watch=watch)
    return _Done(
        lambda form, title: printed(study, form, title), lambda path, title: plot_study(study, path, title)
    )


def _other_done(subject: Subject, source: Mesh, options: StudyOptions, watch: Watch) -> _Done:
    """A study whose module has `study`, `tables`, and maybe `plot`."""
    module = import_module(f"striptools.measure.{_MODULES.get(subject, f'study_{subject}')}")
    study = module.study(source, options, watch=watch)
    plot = getattr(module, "plot", None)
    return _Done(
        lambda form, title: printed_tables(module.tables(study), form, title),
        None if plot is None else lambda path, title: plot(study, path, title),
    )


Tables = list[tuple[str, list[dict[str, object]]]]


def printed_tables(tables: Tables, form: Format, title: str) -> str:
    """Tables as text, json, csv or md, one after another; those of csv have an empty line between them."""
    if form == "json":
        return render({"tables": [{"title": name, "rows": rows} for name, rows in tables]}, "json")
    parts = [render_table(rows, form, titled(title, name)) for name, rows in tables if rows]
    return "\n".join(parts)


def printed(study: Study, form: Format, title: str) -> str:
    """The study as text, json, csv or md: what tracing costs, then what the strips are."""
    speed, strips = [_speed(study, row) for row in study.rows], [_strips(row) for row in study.rows]
    if form == "json":
        facts = dataclasses.asdict(study)
        for part, row in zip(facts["rows"], study.rows, strict=True):
            part["paper_ratio"] = paper_range(row.method)
            part["quality"]["relative_cost"] = row.quality.relative_cost
        return render(facts, "json")
    if form == "csv":
        rows = [{**one, **other} for one, other in zip(speed, strips, strict=True)]
        return render_table(rows, "csv")
    heading = f"{title}: {study.triangles:,} triangles, {study.primary_rays:,} primary and "
    heading += f"{study.secondary_rays:,} secondary rays on {', '.join(study.devices)}"
    heading += "; lead: rays a second of strip-rt over the row's"
    return render_table(speed, form, heading) + "\n" + render_table(strips, form, "Strips")


def _speed(study: Study, row: StudyRow) -> dict[str, object]:
    band = paper_range(row.method)
    return {
        "variant": row.variant,
        "MB": row.scene_bytes / 1e6,
        "B/triangle": row.scene_bytes / study.triangles,
        "with_swaps": row.swap_bytes / study.triangles,
        "Mrays/s": row.primary_rate / 1e6,
        "lead": row.primary_ratio,
        "paper's_lead": f"{band[0]:.2f}-{band[1]:.2f}" if band else "",
        "steps": row.primary_steps,
        "secondary_Mrays/s": row.secondary_rate / 1e6,
        "secondary_lead": row.secondary_ratio,
        "secondary_steps": row.secondary_steps,
    }


def _strips(row: StudyRow) -> dict[str, object]:
    quality = row.quality
    return {
        "variant": row.variant,
        "strips": quality.strips,
        "singletons": quality.singletons,
        "longest": quality.longest,
        "vertices/triangle": quality.vertices_per_triangle,
        "classic_indices/triangle": quality.classic_indices,
        "without_restarts": quality.classic_indices_without_restarts,
        "swaps": quality.swaps,
        "strip_area": quality.strip_area,
        "half_share": quality.half_share,
        "relative_cost": quality.relative_cost,
        "order_s": row.order_seconds,
    }
