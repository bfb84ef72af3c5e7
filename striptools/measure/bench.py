"""The figures of this project on any models, beside the peers that are installed, kept in a results file.

A row is a figure, with machine and versions. What is measured here needs no clone: bytes, seconds, rays a
second, and what verify says. The figures that need a clone's own scripts (long runs, peers' encoders, GPUs)
are in tests/benches, in the same columns; `bench_scripts` runs them.
"""

import csv
import datetime
import io
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from striptools.measure.environment import machine, versions
from striptools.measure.study import tell_no_one
from striptools.measure.verify import VerifyOptions, verify
from striptools.mesh.atomic import write_atomically
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert_with_report
from striptools.reducem.quantize import PrecisionOptions
from striptools.reducem.scene import Scene
from striptools.stopwatch import Watch
from striptools.trace import Tracer
from striptools.trace.rays import Camera, camera_rays

COLUMNS = (
    "date", "machine", "versions", "bench", "mesh", "triangles", "metric", "value", "unit",
    "peer", "peer_value", "ratio", "note",
)  # fmt: skip

RATES = ("M rays/s", "Mray/s", "Mrays/s", "rays/s", "M triangles/s")
"""Units of which more is better."""

COSTS = ("bytes per triangle", "B/tri", "B", "s", "per triangle", "vertices per triangle", "faces", "rays")
"""Units of which less is better, and of the figures without a unit those that begin so."""

COSTS_BY_NAME = ("vertices per triangle", "relative expected cost", "seconds")

COUNTS = (
    "rays verified", "aimed rays", "uncertain rays", "wrong faces", "steps", "open edges",
    "Draco", "meshoptimizer", "vtkStripper", "pyffi", "plain CUDA", "warp",
)  # fmt: skip
"""What is in the names of figures that are neither better nor worse: of an input, or of a peer alone."""

NOISE = 0.25
"""How much worse seconds, rates and peaks of memory may be before it is said, where a run is long; bytes and
counts not at all."""

RATIO_NOISE = 0.4
"""What is left of it where a figure is a ratio to a peer's of the same run."""

SHORT = 0.02
"""Seconds that are too short to be compared."""

NAME = "package"
_GRID = Options(precision=PrecisionOptions(16))


@dataclass(frozen=True)
class Row:
    """One figure.

    Attributes:
        bench: What measured it.
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


@dataclass(frozen=True)
class BenchOptions:
    """How much is measured.

    Attributes:
        side: Pixels across and down, a ray each.
        runs: Runs whose median is taken.
        verify: How many rays are proved.
    """

    side: int = 512
    runs: int = 9
    verify: VerifyOptions = field(default_factory=lambda: VerifyOptions(rays=256, aimed_rays=16384))


QUICK = BenchOptions(side=128, runs=3, verify=VerifyOptions(rays=32, aimed_rays=2048))


def bench(models: dict[str, Mesh], options: BenchOptions, watch: Watch | None = None) -> list[Row]:
    """Measure models, one after the other.

    Args:
        models: By name, as loaded.
        options: How much.
        watch: Called with a model's name and the fraction done of all.
    """
    tell = watch or tell_no_one
    rows = []
    for done, (name, mesh) in enumerate(models.items()):
        tell(name, done / len(models))
        rows += _model_rows(name, mesh, options)
    return rows


def _model_rows(name: str, mesh: Mesh, options: BenchOptions) -> list[Row]:
    convert_with_report(mesh)
    seconds, scene = [], None
    for _ in range(options.runs):
        start = time.perf_counter()
        scene, _ = convert_with_report(mesh)
        seconds.append(time.perf_counter() - start)
    assert scene is not None
    count = scene.triangle_count
    parts, grid = scene.part_bytes(), convert_with_report(mesh, _GRID)[0].part_bytes()
    tracer, packed = Tracer(scene), Tracer(scene, resident="compressed")
    report = verify(scene, mesh, options.verify, tracer=tracer)
    figures = [
        ("file", _geometry(parts) / count, "bytes per triangle"),
        ("file on a grid of 16 bits", _geometry(grid) / count, "bytes per triangle"),
        ("as traced, compressed", packed.resident_bytes / count, "bytes per triangle"),
        ("as traced, expanded", tracer.resident_bytes / count, "bytes per triangle"),
        ("strip vertices", len(scene.vertices) / count, "vertices per triangle"),
        ("mesh to scene", count / min(seconds) / 1e6, "M triangles/s"),
        ("verify: disagreements", report.disagreements, "rays"),
        ("verify: leaks", report.leaks, "rays"),
    ]  # fmt: skip
    return [Row(NAME, name, count, *figure) for figure in figures] + _rates(name, scene, options)


def _geometry(parts: dict[str, int]) -> int:
    return sum(parts.values()) - parts["remap"] - parts["attributes"]


def _rates(name: str, scene: Scene, options: BenchOptions) -> list[Row]:
    """Camera rays a second, one thread, in turn with embreex where that is installed."""
    placed = scene.placed()
    rays = camera_rays(Camera.framing(placed.positions, width=options.side, height=options.side))
    tracer = Tracer(scene, threads=1)
    peer = _embree(placed.positions[placed.faces()])
    ours, theirs = [], []
    # The first run compiles, and does not count.
    for run in range(options.runs + 1):
        seconds = _timed(lambda: tracer.closest_hit(*rays, packets=False))
        other = None if peer is None else _timed(lambda: peer(*rays))
        if run:
            ours.append(seconds)
            theirs += [] if other is None else [other]
    rate = len(rays[0]) / min(ours) / 1e6
    row = ("camera rays, one thread", rate, "M rays/s")
    if not theirs:
        return [Row(NAME, name, scene.triangle_count, *row)]
    ratio = median(other / one for one, other in zip(ours, theirs, strict=True))
    return [Row(NAME, name, scene.triangle_count, *row, "embreex", len(rays[0]) / min(theirs) / 1e6, ratio)]


def _embree(corners: np.ndarray) -> Callable[[np.ndarray, np.ndarray], np.ndarray] | None:
    """What traces the same triangles by embreex; None where it is not installed."""
    try:
        rtcore: Any = import_module("embreex.rtcore")
        rtcore_scene: Any = import_module("embreex.rtcore_scene")
        meshes: Any = import_module("embreex.mesh_construction")
    except ImportError:
        return None
    device = rtcore.EmbreeDevice()
    scene = rtcore_scene.EmbreeScene(device)
    kept = [device, meshes.TriangleMesh(scene, corners)]

    def closest(origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        # Embree's objects live as long as this function.
        _ = kept
        far = np.full(len(origins), np.float32(1e37))
        return scene.run(origins, directions, dists=far, query="INTERSECT")

    return closest


def has_embree() -> bool:
    """Whether embreex is installed, which rates are measured beside."""
    return find_spec("embreex") is not None


def _timed(work: Callable[[], object]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def append(rows: list[Row], file: Path) -> None:
    """Add rows to a results file, with today's date, this machine and the versions at work.

    Raises:
        WriteError: It could not be written.
    """
    text = io.StringIO()
    out = csv.writer(text, lineterminator="\n")
    if not file.exists():
        out.writerow(COLUMNS)
    for row in rows:
        out.writerow(
            [datetime.date.today().isoformat(), machine(), versions(), row.bench, row.mesh, row.triangles,
             row.metric, _short(row.value), row.unit, row.peer, _short(row.peer_value), _short(row.ratio),
             row.note]
        )  # fmt: skip
    before = file.read_bytes() if file.exists() else b""
    write_atomically(file, before + text.getvalue().encode())


Last = dict[tuple[str, str, str, str], dict[str, str]]
"""Rows of a results file by bench, mesh, metric and the parameters that the note says."""


def last_rows(file: Path) -> Last:
    """The last row of each figure that this machine measured."""
    if not file.exists():
        return {}
    with file.open(newline="", encoding="utf-8") as lines:
        rows = [row for row in csv.DictReader(lines) if row.get("machine") == machine()]
    return {(row["bench"], row["mesh"], row["metric"], _parameters(row["note"])): row for row in rows}


def _parameters(note: str) -> str:
    """A note without the figures in it: whole numbers are parameters, others were measured."""
    return re.sub(r"\d*\.\d+(e[+-]?\d+)?|\d+e[+-]?\d+", "", note)


def got_worse(rows: list[Row], before: Last, *, noise: float = NOISE) -> list[str]:
    """Which figures are worse than the last ones of this machine, by more than noise, in words.

    A ratio to a peer of the same run is what is compared where there was one before; else the figure itself.

    Args:
        rows: The new ones.
        before: The last ones.
        noise: How much worse what is noisy may be.
    """
    found = []
    for row in rows:
        last = before.get((row.bench, row.mesh, row.metric, _parameters(row.note)))
        better = _better(row)
        if last is None or better == 0:
            continue
        by_ratio = row.ratio is not None and bool(last["ratio"]) and last["peer"] == row.peer
        was = float(last["ratio"] if by_ratio else last["value"])
        now = row.ratio if by_ratio and row.ratio is not None else row.value
        is_time = row.unit == "s" or row.metric.startswith("seconds")
        if is_time and max(row.value, float(last["value"])) < SHORT:
            continue
        slack = _slack(row, by_ratio, noise)
        limit = was * (1 + slack) * (1 + 1e-5) if better < 0 else was * (1 - slack) * (1 - 1e-5)
        if now > limit if better < 0 else now < limit:
            what = f"ratio to {row.peer}" if by_ratio else row.unit
            found.append(
                f"{row.bench}: {row.mesh}: {row.metric}: {now:.4g} {what}, was {was:.4g} on {last['date']}"
            )
    return found


def _better(row: Row) -> int:
    """1 where more is better, -1 where less is, else 0; a ratio to a peer goes as its figure does."""
    if any(part in row.metric for part in COUNTS):
        return 0
    if row.unit in RATES:
        return 1
    return -1 if row.unit in COSTS or (not row.unit and row.metric.startswith(COSTS_BY_NAME)) else 0


def _slack(row: Row, by_ratio: bool, noise: float) -> float:
    """How much worse, relatively, is no worse."""
    timed = row.unit == "s" or row.unit in RATES or row.metric.startswith("seconds")
    if timed:
        return noise * RATIO_NOISE if by_ratio else noise
    return noise if "peak" in row.metric else 0.0


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"
