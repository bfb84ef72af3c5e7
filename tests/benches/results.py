"""The results file: a row a figure, with machine, versions and the peer of the same run."""

import csv
import datetime
import importlib.metadata
import os
import platform
from dataclasses import dataclass
from pathlib import Path

FILE = Path(__file__).with_name("results.csv")
COLUMNS = (
    "date", "machine", "versions", "bench", "mesh", "triangles", "metric", "value", "unit",
    "peer", "peer_value", "ratio", "note",
)  # fmt: skip
PACKAGES = (
    "striptools", "numpy", "numba", "trimesh", "jax", "embreex", "meshoptimizer", "vtk", "PyFFI",
    "DracoPy", "zstandard",
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


def machine() -> str:
    """The processor and how many cores of it this process may use."""
    model = platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = [line for line in info.read_text().splitlines() if "model name" in line]
        names = [line.split(":", 1)[1].strip() for line in lines]
        model = names[0] if names else model
    return f"{model}, {len(os.sched_getaffinity(0))} cores"


def versions() -> str:
    """Python and the packages whose version may change a figure."""
    found = [f"python {platform.python_version()}"]
    for package in PACKAGES:
        try:
            found.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    return "; ".join(found)


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
