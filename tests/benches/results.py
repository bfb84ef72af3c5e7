"""The results file: a row a figure, with machine, versions and the peer of the same run."""

import csv
import datetime
from dataclasses import dataclass
from pathlib import Path

from striptools.measure.environment import machine, versions

FILE = Path(__file__).with_name("results.csv")
COLUMNS = (
    "date", "machine", "versions", "bench", "mesh", "triangles", "metric", "value", "unit",
    "peer", "peer_value", "ratio", "note",
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One figure.

    Attributes:
        bench: The script that measured it, without `bench_` and `.py`.
        mesh: The model's name.
        triangles: How many triangles the scene has.
        metric: What was measured.
        value: The figure.
        unit: Its unit.
        peer: Who was measured in the same run, empty for nobody.
        peer_value: The peer's figure in the same unit.
        ratio: Ours over the peer's: the median of adjacent-in-time ratios.
        note: Anything needed to repeat it.
    """

    bench: str
    mesh: str
    triangles: int
    metric: str
    value: float
    unit: str
    peer: str = ""
    peer_value: float | None = None
    ratio: float | None = None
    note: str = ""


def append(rows: list[Row]) -> None:
    """Add rows to the results file, with today's date, this machine and the versions at work."""
    new = not FILE.exists()
    with FILE.open("a", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        if new:
            out.writerow(COLUMNS)
        for row in rows:
            out.writerow(
                [datetime.date.today().isoformat(), machine(), versions(), row.bench, row.mesh, row.triangles,
                 row.metric, _short(row.value), row.unit, row.peer, _short(row.peer_value), _short(row.ratio),
                 row.note]
            )  # fmt: skip


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
