"""The results file: a row a figure, with machine, versions and the peer of the same run."""

import os
from pathlib import Path

from striptools.measure import bench
from striptools.measure.bench import Row
from striptools.measure.bench_scripts import RESULTS

FILE = Path(os.environ.get(RESULTS, Path(__file__).with_name("results.csv")))

__all__ = ["FILE", "Row", "append"]


def append(rows: list[Row]) -> None:
    """Add rows to the results file, with today's date, this machine and the versions at work."""
    bench.append(rows, FILE)
