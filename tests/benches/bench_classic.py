"""Classic strips on real models: indices per triangle with and without restarts, and what they cost to find.

    python tests/benches/bench_classic.py FOLDER [MESH ...] [--effort fast|normal|best] [--record]

FOLDER holds `MESH.ply` files, cleaned before anything is timed. Each model is done twice, and the faster run
counts. Every index list is decoded and compared with the faces. `--record` appends the figures to
`results.csv`.
"""

import argparse
import os
import sys
import time
from pathlib import Path

import numpy as np
from results import Row, append

from striptools.mesh.adjacency import build_adjacency
from striptools.mesh.clean import clean
from striptools.mesh.io import load_mesh
from striptools.strips.alternating import AlternatingOptions, Effort, alternating_strips
from striptools.strips.topology import classic_strips, count_classic, decode_classic, encode_strips

BENCH = {
    "takes": "folder",
    "models": [
        "bunny",
        "dragon",
        "dem_jacksboro",
        "icub",
        "kicad_acepack",
        "chandelier",
        "tree_japanesemaple",
        "ugly_bunny_holes",
    ],
    "full": [[], ["--effort", "best"]],
    "quick": [[]],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

MESHES = (
    "bunny", "dragon", "dem_jacksboro", "icub", "kicad_acepack", "chandelier", "tree_japanesemaple",
    "ugly_bunny_holes",
)  # fmt: skip

RUNS = 2


def main() -> int:
    """Measure each model, print its row, and say how many failed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("meshes", nargs="*", default=MESHES)
    parser.add_argument("--effort", choices=("fast", "normal", "best"), default="normal")
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    failed = 0
    for name in arguments.meshes:
        rows = measure(name, arguments.folder / f"{name}.ply", arguments.effort)
        figures = {row.metric: row.value for row in rows}
        line = ", ".join(f"{key} {value:.5g}" for key, value in figures.items())
        sys.stdout.write(f"{name} ({arguments.effort}): {line}\n")
        sys.stdout.flush()
        failed += bool(figures["faces lost"])
        if arguments.record:
            append(rows)
    return 1 if failed else 0


def measure(name: str, path: Path, effort: Effort) -> list[Row]:
    """Find, count, write and decode the classic strips of one model."""
    mesh = clean(load_mesh(path)).mesh
    adjacency = build_adjacency(mesh.faces, mesh.vertex_count)
    threads = len(os.sched_getaffinity(0))
    seconds = []
    for _ in range(RUNS):
        start = time.perf_counter()
        sequences = alternating_strips(adjacency, mesh.faces, AlternatingOptions(effort), threads)
        seconds.append(time.perf_counter() - start)
    strips = encode_strips(mesh.faces, sequences)
    count = count_classic(strips)
    lost = int(
        (sorted_rows(decode_classic(classic_strips(strips))) != sorted_rows(mesh.faces)).any(axis=1).sum()
    )
    triangles = mesh.triangle_count
    stitched_price = alternating_strips(adjacency, mesh.faces, AlternatingOptions(effort, 4), threads)
    stitched = count_classic(encode_strips(mesh.faces, stitched_price), None)
    figures = [
        ("indices per triangle without restarts", (count.indices - count.restarts) / triangles, ""),
        ("indices per triangle with restarts", count.indices / triangles, ""),
        ("indices per triangle stitched for glTF", stitched.indices / triangles, ""),
        ("strips", len(strips.starts) - 1, ""),
        ("joins", count.joins, ""),
        ("seconds", min(seconds), "s"),
        ("faces lost", lost, "faces"),
    ]
    note = f"effort {effort}"
    return [
        Row("classic", name, triangles, metric, value, unit, note=note) for metric, value, unit in figures
    ]


def sorted_rows(faces: np.ndarray) -> np.ndarray:
    """Each row turned so that its least vertex comes first, and the rows in order."""
    corners = (np.arange(3) + np.argmin(faces, axis=1)[:, None]) % 3
    rows = np.take_along_axis(faces, corners, axis=1)
    return rows[np.lexsort(rows.T)]


if __name__ == "__main__":
    sys.exit(main())
