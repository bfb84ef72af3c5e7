"""`striptools validate`: name every rule of the format that a scene file breaks."""

from typing import Annotated

import typer

from striptools.errors import EXIT_DONE, EXIT_ISSUES
from striptools.reducem.issues import Finding, unreadable
from striptools.reducem.validate import validate
from striptools_cli import log
from striptools_cli.options import SceneFile, format_option
from striptools_cli.report import Format, render, render_table
from striptools_cli.streams import Source, say

_NO_SCENE = ("RDM001", "RDM102")
_NAMES = ("severity", "code", "clause", "offset", "place", "message", "remedy")


def run(
    source: SceneFile,
    form: Annotated[Format, format_option("the findings")] = "text",
) -> None:
    """Name every rule of the format that a scene file breaks, and the byte where it does.

    The codes are explained in formats/reducem/ISSUES.md, the clauses are sections of SPEC.md beside it. Any
    error ends in exit code 1; what is only said for information does not.
    """
    log.set_up()
    file = Source.open(source)
    findings = validate(file.file)
    for finding in findings:
        if finding.issue.code in _NO_SCENE:
            raise unreadable(finding.issue.code, file.name)
    errors = sum(finding.issue.severity == "error" for finding in findings)
    rows = [describe(finding) for finding in findings]
    say(_report(rows, errors, form, file.title))
    raise typer.Exit(EXIT_ISSUES if errors else EXIT_DONE)


def describe(finding: Finding) -> dict[str, object]:
    """A finding as a record."""
    issue = finding.issue
    facts = (
        issue.severity,
        issue.code,
        issue.clause,
        finding.offset,
        finding.place,
        issue.message,
        issue.remedy,
    )
    return dict(zip(_NAMES, facts, strict=True))


def _report(rows: list[dict[str, object]], errors: int, form: Format, title: str) -> str:
    if form == "json":
        return render({"valid": errors == 0, "errors": errors, "findings": rows}, form)
    kinds = "1 kind of error" if errors == 1 else f"{errors} kinds of errors"
    verdict = f"{title}: {f'NOT valid, {kinds}' if errors else 'valid'}"
    if form == "text":
        return render({f"{row['code']} {i}": _line(row) for i, row in enumerate(rows, 1)}, form, verdict)
    return render_table(rows, form, verdict, names=_NAMES)


def _line(row: dict[str, object]) -> str:
    byte = "" if row["offset"] is None else f"byte {row['offset']}"
    where = ", ".join(str(part) for part in (byte, row["place"]) if part)
    return f"{row['severity']}, {where}: {row['message']} (SPEC {row['clause']}; {row['remedy']})"
