"""The leak test: rays aimed exactly at edge midpoints and vertices, from outside and inside, in four places.

    python tests/benches/bench_leaks.py FOLDER [MESH ...] [--rays 1000000] [--record]

FOLDER holds `MESH.ply` files. Each model is traced where it lies, scaled by 1e-3 and by 1e3, and moved 100
diagonals away, with `--rays` aimed rays each time (and a quarter more from inside a closed model). A leak is
a ray for which a hit at its target is certain and which the tracer lets through; see
`striptools.measure.aimed`. Where a model is scaled or moved, positions are rounded to float32 again: moved
100 diagonals, its grid is much coarser, faces collapse and are dropped, and what is then open is said.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from results import Row, append

import striptools
from striptools.measure.verify import VerifyOptions, VerifyReport, verify
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer

BENCH = {
    "takes": "folder",
    "models": ["dragon"],
    "full": [[]],
    "quick": [["--rays", "2000"]],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

PLACES = ("as it lies", "scaled by 1e-3", "scaled by 1e3", "moved 100 diagonals")


def main() -> int:
    """Measure each model at each place, print a row each, and fail where one leaks or disagrees."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("meshes", nargs="*", default=["dragon"])
    parser.add_argument("--rays", type=int, default=1_000_000)
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    failed = 0
    for name in arguments.meshes:
        source = load_mesh(arguments.folder / f"{name}.ply")
        for place in PLACES:
            rows = measure(name, placed(source, place), place, arguments.rays)
            failed += any(row.value for row in rows if row.metric.endswith(("leaks", "disagreements")))
            if arguments.record:
                append(rows)
    return 1 if failed else 0


def placed(source: Mesh, place: str) -> Mesh:
    """The mesh at one of `PLACES`, in float32."""
    positions = np.asarray(source.positions, np.float64)
    diagonal = float(np.linalg.norm(source.bounds[1] - source.bounds[0]))
    factor = {"scaled by 1e-3": 1e-3, "scaled by 1e3": 1e3}.get(place, 1.0)
    # 100 diagonals from the origin, along a direction that no axis shares.
    away = np.array([2.0, -3.0, 6.0]) / 7 * 100 * diagonal if place.startswith("moved") else np.zeros(3)
    return Mesh((positions * factor + away).astype(np.float32), source.faces)


def measure(name: str, mesh: Mesh, place: str, rays: int) -> list[Row]:
    """Convert, trace and judge one model at one place."""
    scene = striptools.convert(mesh)
    tracer = Tracer(scene)
    start = time.perf_counter()
    report = verify(scene, mesh, VerifyOptions(rays=256, aimed_rays=rays), tracer=tracer)
    seconds = time.perf_counter() - start
    tell(name, place, report, seconds)
    figures = [
        ("aimed rays", report.aimed_rays, "rays"),
        ("aimed rays whose hit is certain", report.aimed_certain, "rays"),
        ("leaks", report.leaks, "rays"),
        ("disagreements", report.disagreements, "rays"),
        ("wrong faces", report.structure.errors, "faces"),
        ("largest t error in parts of its bound", report.max_t_ratio, ""),
        ("open edges", report.open_edges, "edges"),
        ("verify", seconds, "s"),
    ]
    return [
        Row("leaks", name, scene.triangle_count, f"{place}: {metric}", value, unit)
        for metric, value, unit in figures
    ]


def tell(name: str, place: str, report: VerifyReport, seconds: float) -> None:
    """Print one line for the place and one for each set of rays."""
    lines = [
        f"{name} {place}: {report.aimed_rays} aimed rays, {report.aimed_certain} certain, "
        f"{report.leaks} leaks, {report.disagreements} disagreements, "
        f"{report.structure.present} faces, {report.open_edges} open edges, "
        f"t error {report.max_t_ratio:.2f} of its bound, {seconds:.1f} s"
    ]
    for part in report.sets:
        lines.append(
            f"    {part.name}: {part.rays} rays, {part.hits} hit, {part.certain} certain, "
            f"{part.leaks} leaks, {part.disagreements} disagreements, t {part.max_t_ratio:.2f} and u, v "
            f"{part.max_uv_ratio:.2f} of their bounds"
        )
    sys.stdout.writelines(f"{line}\n" for line in lines)
    sys.stdout.writelines(f"    {flaw}\n" for flaw in report.flaws)
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
