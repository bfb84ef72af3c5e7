"""Seconds by stage from a loaded mesh to a scene file on disk, and the peak of memory.

    python tests/benches/bench_speed.py MESH.ply [MESH.ply ...] [--threads 1 2] [--runs 3] [--record]

Loading is timed apart. Every kernel is compiled on the first faces of the mesh before; each stage counts with
its least time of all runs, the whole with that of one run, memory with its most. `--cold` measures a first
process with an empty cache of compiled kernels and a second one instead. `--record` appends the figures to
`results.csv`.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from results import Row, append

from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.options import STAGES, Options
from striptools.pipeline import convert_with_report

BENCH = {
    "takes": "paths",
    "models": ["dragon", "dragon_3m5", "dem_jacksboro", "terrain_1m", "terrain_4m", "terrain_16m"],
    "full": [[], ["--cold"]],
    "quick": [["--threads", "2", "--runs", "1"]],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

WARM_UP_FACES = 50_000
TIMED = tuple(stage for stage in STAGES if stage != "load")

COLD = """
import sys, time
begin = time.perf_counter()
from striptools.mesh.mesh import Mesh
from striptools.pipeline import convert
import numpy as np
corners = np.random.default_rng(1).random((60000, 3)).astype(np.float32)
scene = convert(Mesh(corners, np.arange(60000, dtype=np.int32).reshape(-1, 3)))
scene.save(sys.argv[1])
print(time.perf_counter() - begin)
"""


def main() -> int:
    """Measure what is asked for and print a table."""
    parser = argparse.ArgumentParser(description="Seconds by stage and the peak of memory.")
    parser.add_argument("meshes", nargs="*", type=Path)
    parser.add_argument("--threads", nargs="+", type=int, default=[1, 2])
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--cold", action="store_true")
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    columns = ("mesh", "triangles", "threads", "load", *TIMED, "write", "total", "cpu", "Mtri/s", "bytes/tri")
    if arguments.meshes:
        say(columns)
    for path in arguments.meshes:
        begin = time.perf_counter()
        mesh = load_mesh(path)
        loading = time.perf_counter() - begin
        for threads in arguments.threads:
            rows = measure(path.stem, mesh, threads, arguments.runs, loading)
            say((path.stem, mesh.triangle_count, threads, *(f"{row.value:.3g}" for row in rows)))
            if arguments.record:
                append(rows)
    if arguments.cold:
        rows = measure_start()
        say([f"{row.metric} {row.value:.3g} {row.unit}" for row in rows])
        if arguments.record:
            append(rows)
    return 0


def say(cells: Iterable[object]) -> None:
    """Print a row of the table."""
    sys.stdout.write("  ".join(f"{cell!s:>9}" for cell in cells) + "\n")
    sys.stdout.flush()


def measure(name: str, mesh: Mesh, threads: int, runs: int, loading: float) -> list[Row]:
    """The figures of one mesh and number of threads."""
    options = Options(threads=threads)
    convert_with_report(Mesh(mesh.positions, mesh.faces[:WARM_UP_FACES].copy()), options)
    best = dict.fromkeys((*TIMED, "write", "total", "cpu"), np.inf)
    peak = 0
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(runs):
            begin, cpu = time.perf_counter(), time.process_time()
            scene, report = convert_with_report(mesh, options)
            converted = time.perf_counter()
            scene.save(Path(folder) / "scene.rdm")
            end = time.perf_counter()
            seconds = report.seconds | {
                "write": end - converted, "total": end - begin, "cpu": time.process_time() - cpu
            }  # fmt: skip
            best = {stage: min(best[stage], seconds[stage]) for stage in best}
            peak = max(peak, report.peak_bytes)
            del scene
    triangles = mesh.triangle_count
    note = f"{threads} threads, least of {runs} runs"
    figures = [
        ("load", loading, "s"),
        *((f"stage {stage}", best[stage], "s") for stage in (*TIMED, "write")),
        ("clean to file", best["total"], "s"),
        ("clean to file, processor time", best["cpu"], "s"),
        ("speed", triangles / best["total"] / 1e6, "M triangles/s"),
        ("peak memory above the loaded mesh", peak / triangles, "bytes per triangle"),
    ]
    return [Row("speed", name, triangles, *figure, note=note) for figure in figures]


def measure_start() -> list[Row]:
    """Seconds of a process that has to compile every kernel, and of the next one, 20,000 faces each."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"NUMBA_CACHE_DIR": folder}
        command = [sys.executable, "-c", COLD, str(Path(folder) / "scene.rdm")]
        seconds = []
        for _ in range(2):
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
            seconds.append(float(done.stdout))
    names = ("first process, with compilation", "second process")
    return [
        Row("speed", "soup", 20_000, name, value, "s") for name, value in zip(names, seconds, strict=True)
    ]


if __name__ == "__main__":
    sys.exit(main())
