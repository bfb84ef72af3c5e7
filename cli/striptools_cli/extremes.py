"""`striptools extremes`: every extreme case through every mode of tracing, judged by the exact answer."""

from pathlib import Path
from typing import Annotated

import typer

from striptools.errors import EXIT_DONE, EXIT_ISSUES, UsageError
from striptools.measure.extreme_rows import ROWS, Row
from striptools.measure.extremes import MODES, ExtremesReport, RowResult, rows_of, run_extremes
from striptools_cli import log, notice
from striptools_cli.options import format_option, quiet_option
from striptools_cli.progress import StageProgress
from striptools_cli.report import Format, render_table
from striptools_cli.streams import say


def run(
    quick: Annotated[
        bool, typer.Option("--quick", help="Few and small cases, none of 2^24 triangles.")
    ] = False,
    meshes: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Add a row for each mesh file in a folder.")
    ] = None,
    only: Annotated[
        list[str] | None, typer.Option(metavar="WORD", help="Only rows with this in their name; repeatable.")
    ] = None,
    form: Annotated[Format, format_option("the table")] = "text",
    quiet: Annotated[bool, quiet_option()] = False,
) -> None:
    """Run every extreme case through every mode of tracing, and say whether each did what was expected.

    What is expected is written down beside each case: the bound is kept, a clear error, or a documented
    limit. The table has each mode's verdict and the largest error over its bound. Any other verdict than the
    one expected ends in exit code 1.
    """
    log.set_up(quiet=quiet)
    rows = _chosen(meshes, only)
    with StageProgress(quiet=quiet) as progress:
        notice.before_tracing(quiet=quiet)
        report = run_extremes(rows, quick=quick, tell=lambda name: progress.watch(name, 0.0))
    if not quiet:
        say(
            render_table(
                [_short(row) for row in table(report)] if form == "text" else table(report),
                form,
                summary(report),
            )
        )
        if form == "text":
            say("".join(f"  {line}\n" for line in remarks(report)))
    raise typer.Exit(EXIT_DONE if report.ok else EXIT_ISSUES)


def _chosen(meshes: Path | None, only: list[str] | None) -> list[Row]:
    if meshes is not None and not meshes.is_dir():
        raise UsageError("no such folder", where=str(meshes), remedy="give a folder of mesh files")
    rows = [*ROWS, *(rows_of(meshes) if meshes is not None else [])]
    rows = [row for row in rows if not only or any(word in row.name for word in only)]
    if not rows:
        raise UsageError("no row has that name", where="--only", remedy="leave it out to see all names")
    return rows


def table(report: ExtremesReport) -> list[dict[str, object]]:
    """A record for each row: what is expected, what every mode did, and the largest error over bound."""
    return [_record(row) for row in report.rows] + [
        {
            "row": f"XLA: {probe.name}",
            "expected": "guard holds",
            "ok": probe.guarded,
            **{mode.name: "guard holds" if probe.guarded else "VIOLATED" for mode in MODES},
            "error_over_bound": 0.0,
            "detail": f"{'' if probe.taken else 'not '}taken where nothing guards against it",
        }
        for probe in report.probes
    ]


def _record(result: RowResult) -> dict[str, object]:
    row = result.row
    both = {row.verdict(grid=False), row.verdict(grid=True)}
    expected = row.expected if len(both) == 1 else f"{row.expected}; {row.on_grid} on a grid"
    flaws = [
        f"{mode.name}: {outcome.detail}"
        for mode, outcome in zip(result.modes, result.outcomes, strict=True)
        if outcome.verdict != row.verdict(grid=mode.on_grid)
    ]
    return {
        "row": row.name,
        "expected": expected,
        "ok": result.ok,
        **{m.name: _cell(o.verdict, o.ratio) for m, o in zip(result.modes, result.outcomes, strict=True)},
        "error_over_bound": max(outcome.ratio for outcome in result.outcomes),
        "detail": "; ".join(flaws) or row.limit,
    }


def _cell(verdict: str, ratio: float) -> str:
    return f"{verdict} {ratio:.2f}" if ratio else verdict


def _short(record: dict[str, object]) -> dict[str, object]:
    """A record for a narrow table: of verdicts as expected only the error over bound."""
    names = {mode.name for mode in MODES}
    expected = str(record["expected"]).split("; ")
    kept = {name: value for name, value in record.items() if name != "detail"}
    for name in names:
        verdict = str(kept[name])
        if any(verdict.startswith(one.removesuffix(" on a grid")) for one in expected) and record["ok"]:
            kept[name] = next(iter(verdict.split()[2:]), "-")
    return kept


def summary(report: ExtremesReport) -> str:
    """The verdict in one line."""
    wrong = sum(not row.ok for row in report.rows) + sum(not probe.guarded for probe in report.probes)
    as_expected = "all as expected" if wrong == 0 else f"{wrong} NOT as expected"
    return f"{len(report.rows)} rows, {as_expected}; the tightest error is {report.tightest:.2f} of its bound"


def remarks(report: ExtremesReport) -> list[str]:
    """What the largest errors were, by kind."""
    outcomes = [outcome for row in report.rows for outcome in row.outcomes]
    kinds = {
        "t over its bound": "t_ratio",
        "hit point over its bound": "point_ratio",
        "move of a vertex over the declared bound": "move_ratio",
    }
    lines = [
        f"{kind}: {max((getattr(o, name) for o in outcomes), default=0.0):.2f}"
        for kind, name in kinds.items()
    ]
    need = max((outcome.box_need for outcome in outcomes), default=0.0)
    flaws = [f"{row['row']}: {row['detail']}" for row in table(report) if not row["ok"]]
    return [
        *flaws,
        *lines,
        f"boxes had to be wider by {need:.2f} u of the largest coordinate (they are by 8 u and 32 u)",
    ]
