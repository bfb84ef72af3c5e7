"""One record, four shapes: text for people, json and csv for programs, md for reports.

A record is a mapping from names to numbers, strings, booleans, None, lists, or further records. Text groups
thousands and rounds to four digits; the other shapes give every value in full. A table is a list of records
with the same names.
"""

import csv
import io
import json
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Literal

Format = Literal["text", "json", "csv", "md"]
Record = Mapping[str, object]

_UNITS = ("B", "kB", "MB", "GB", "TB")


def render(record: Record, form: Format, title: str = "") -> str:
    """Write a record down.

    Args:
        record: What to write; names keep their order.
        form: `text`, `json`, `csv` or `md`.
        title: A heading for text and md; json and csv leave it out.

    Returns:
        Lines, each ended by a newline.
    """
    writers: dict[Format, Callable[[Record, str], str]] = {
        "text": _text,
        "json": _json,
        "csv": _csv,
        "md": _markdown,
    }
    return writers[form](record, title)


def render_table(
    rows: Sequence[Record], form: Format, title: str = "", *, names: Sequence[str] | None = None
) -> str:
    """Write records with the same names down as a table, a row each.

    Args:
        rows: The records; names and rows keep their order.
        form: `text`, `json`, `csv` or `md`.
        title: A heading for text and md; json and csv leave it out.
        names: Their names; needed only where there may be no row.

    Returns:
        Lines, each ended by a newline.
    """
    if form == "json":
        return json.dumps(_jsonable(list(rows)), indent=2, allow_nan=False) + "\n"
    names = list(rows[0] if names is None else names)
    cells = [[_plain(row[name]) for name in names] for row in rows]
    if form == "csv":
        lines = io.StringIO()
        csv.writer(lines, lineterminator="\n").writerows([names, *([_cell(c) for c in row] for row in cells)])
        return lines.getvalue()
    if form == "md":
        heading = [f"## {_escaped(title)}", ""] if title else []
        table = [names, ["---"] * len(names), *([_cell(c) for c in row] for row in cells)]
        table = [f"| {' | '.join(_escaped(cell) for cell in row)} |" for row in table]
        return "".join(f"{line}\n" for line in [*heading, *table])
    heads = [name.replace("_", " ") for name in names]
    return _text_table([heads, *([human_value(c) for c in row] for row in cells)], title)


def human_bytes(count: int) -> str:
    """A number of bytes in decimal units: `812 B`, `1.3 MB`."""
    size = float(count)
    for unit in _UNITS:
        if size < 999.95 or unit == _UNITS[-1]:
            return f"{count} B" if unit == "B" else f"{size:.1f} {unit}"
        size /= 1000.0
    raise AssertionError("the last unit takes every size")


def human_value(value: object) -> str:
    """A value as a person reads it: `1,234,567`, `0.001235`, `yes`, `none`."""
    value = _plain(value)
    if value is None:
        return "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.4g}" if abs(value) < 1e4 or not math.isfinite(value) else f"{value:,.0f}"
    if isinstance(value, list | tuple):
        return ", ".join(human_value(item) for item in value) or "none"
    return str(value)


def flatten(record: Record, prefix: str = "") -> Iterator[tuple[str, object]]:
    """The values of a record and of the records in it, with dotted names."""
    for name, value in record.items():
        if isinstance(value, Mapping):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", _plain(value)


def _text(record: Record, title: str) -> str:
    rows = list(_text_rows(record, "  " if title else ""))
    width = max((len(label) for label, _ in rows), default=0)
    lines = [title] if title else []
    lines += [f"{label:<{width}}  {value}".rstrip() for label, value in rows]
    return "".join(f"{line}\n" for line in lines)


def _text_rows(record: Record, indent: str) -> Iterator[tuple[str, str]]:
    for name, value in record.items():
        label = indent + name.replace("_", " ")
        if isinstance(value, Mapping):
            yield label, ""
            yield from _text_rows(value, indent + "  ")
        else:
            yield label, human_value(value)


def _text_table(rows: list[list[str]], title: str) -> str:
    """Columns as wide as they need: the first to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = [title] if title else []
    for first, *rest in rows:
        cells = [f"{cell:>{width}}" for cell, width in zip(rest, widths[1:], strict=True)]
        lines.append("  ".join([f"  {first:<{widths[0]}}", *cells]).rstrip())
    return "".join(f"{line}\n" for line in lines)


def _json(record: Record, _title: str) -> str:
    return json.dumps(_jsonable(record), indent=2, allow_nan=False) + "\n"


def _jsonable(value: object) -> object:
    if isinstance(value, Mapping):
        return {str(name): _jsonable(item) for name, item in value.items()}
    value = _plain(value)
    if isinstance(value, list | tuple):
        return [_jsonable(item) for item in value]
    # JSON has no word for infinity or NaN.
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _csv(record: Record, _title: str) -> str:
    lines = io.StringIO()
    writer = csv.writer(lines, lineterminator="\n")
    writer.writerow(("name", "value"))
    writer.writerows((name, _cell(value)) for name, value in flatten(record))
    return lines.getvalue()


def _markdown(record: Record, title: str) -> str:
    heading = [f"## {_escaped(title)}", ""] if title else []
    rows = [f"| {_escaped(name)} | {_escaped(_cell(value))} |" for name, value in flatten(record)]
    return "".join(f"{line}\n" for line in [*heading, "| name | value |", "|---|---|", *rows])


def _cell(value: object) -> str:
    if isinstance(value, list | tuple):
        return "; ".join(_cell(_plain(item)) for item in value)
    if isinstance(value, bool):
        return "true" if value else "false"
    return "" if value is None else str(value)


def _escaped(text: str) -> str:
    return text.replace("|", "\\|").replace("\n", " ")


def _plain(value: object) -> object:
    # NumPy scalars know their Python twin.
    item = getattr(value, "item", None)
    return item() if callable(item) else value
