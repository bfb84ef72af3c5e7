"""The whole way on real models: convert, verify, convert back, and what each costs.

    python tests/benches/bench_pipeline.py FOLDER [MESH ...] [--bits 20 16 12] [--record]

FOLDER holds `MESH.ply` files. Each model has a process of its own. There a small mesh is converted first,
which brings in all imports and compiled kernels; the first conversion of the model then gives the peak of
memory, and the second one the seconds.
With `--bits` the scenes on these grids are verified instead: against their own decoded meshes exactly, and
against the source within the bound that they declare. `--record` appends the figures to `results.csv`.
"""

import argparse
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from results import Row, append

import striptools
from striptools.mesh.clean import clean
from striptools.mesh.io import load_mesh, save_mesh
from striptools.options import STAGES, Options
from striptools.reducem.quantize import PrecisionOptions

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
        "soup_bunny",
        "ugly_bunny_holes",
        "dragon_3m5",
    ],
    "full": [[], ["--bits", "20", "16", "12"]],
    "quick": [[]],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

MESHES = (
    "bunny", "dragon", "dem_jacksboro", "icub", "kicad_acepack", "chandelier", "tree_japanesemaple",
    "soup_bunny", "ugly_bunny_holes",
)  # fmt: skip


FAULTS = ("disagreements", "leaks", "faces lost on the way back")
"""What there must be none of."""


def main() -> int:
    """Measure each model, print its row, and say how many failed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("meshes", nargs="*", default=MESHES)
    parser.add_argument("--bits", nargs="+", type=int, default=[])
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    failed = 0
    for name in arguments.meshes:
        path = arguments.folder / f"{name}.ply"
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
            if arguments.bits:
                rows = process.submit(measure_grids, name, path, arguments.bits).result()
            else:
                rows = process.submit(measure, name, path).result()
        line = ", ".join(f"{row.metric} {row.value:.6g} {row.note}".strip() for row in rows)
        sys.stdout.write(f"{name}: {line}\n")
        sys.stdout.flush()
        failed += any(row.value for row in rows if row.metric.split(",")[0] in FAULTS)
        if arguments.record:
            append(rows)
    return 1 if failed else 0


def measure(name: str, path: Path) -> list[Row]:
    """Convert, verify and convert back one model."""
    from striptools.measure.verify import verify

    warm_up()
    _, first = striptools.convert_with_report(path)
    scene, report = striptools.convert_with_report(path)
    with tempfile.TemporaryDirectory() as folder:
        scene.save(Path(folder) / "scene.rdm")
        stored = striptools.open(Path(folder) / "scene.rdm")
        save_mesh(stored.to_mesh(), Path(folder) / "back.ply")
        lost = faces_lost(path, Path(folder) / "back.ply")
    proof = verify(stored, load_mesh(path))
    triangles = scene.triangle_count
    figures = [
        ("pipeline after warm-up", report.seconds["total"], "s"),
        *((f"stage {stage}", report.seconds[stage], "s") for stage in STAGES),
        ("peak memory above the imports", first.peak_bytes / triangles, "bytes per triangle"),
        ("vertices per triangle in strips", len(scene.vertices) / triangles, ""),
        ("strips", scene.strip_count, ""),
        ("traceable sections as stored", scene.bytes_per_triangle(), "bytes per triangle"),
        ("rays verified", proof.rays, "rays"),
        ("aimed rays whose hit is certain", proof.aimed_certain, "rays"),
        ("disagreements", proof.disagreements, "rays"),
        ("leaks", proof.leaks, "rays"),
        ("uncertain rays", proof.uncertain, "rays"),
        ("largest t error", proof.max_t_error, "ray lengths"),
        ("faces lost on the way back", lost, "faces"),
    ]
    return [Row("pipeline", name, triangles, metric, value, unit) for metric, value, unit in figures]


def measure_grids(name: str, path: Path, widths: list[int]) -> list[Row]:
    """Verify one model on grids, against what was decoded and against the source."""
    from striptools.measure.verify import verify

    source = load_mesh(path)
    rows = []
    for width in widths:
        scene = striptools.convert(source, Options(precision=PrecisionOptions(bits=width)))
        exact = replace(scene, remap=None, source_face_count=scene.triangle_count, error_bound=0.0)
        for title, traced, mesh in (
            ("decoded mesh", exact, exact.to_mesh()),
            ("source", scene, source),
        ):
            proof = verify(traced, mesh)
            note = f"{width} bits, bound {traced.error_bound:.3g}, {proof.rays} rays"
            for metric, value in (("disagreements", proof.disagreements), ("leaks", proof.leaks)):
                rows.append(
                    Row(
                        "pipeline", name, scene.triangle_count, f"{metric}, {title}", value, "rays", note=note
                    )
                )
    return rows


def warm_up() -> None:
    """Convert a bent grid through a file, so that every import and kernel of the way is there."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(40), np.arange(40)))
    corner = np.flatnonzero((x < 39) & (y < 39)).astype(np.int32)
    faces = np.concatenate([corner[:, None] + [0, 1, 41], corner[:, None] + [0, 41, 40]]).astype(np.int32)
    positions = np.stack([x, y, x * y / 40], axis=1).astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        save_mesh(striptools.Mesh(positions, faces), Path(folder) / "grid.ply")
        striptools.convert(Path(folder) / "grid.ply")


def faces_lost(source: Path, back: Path) -> int:
    """Count the faces that cleaning kept and the way back did not bring in source order, bit for bit."""
    kept = clean(load_mesh(source)).mesh
    restored = load_mesh(back)
    if kept.faces.shape != restored.faces.shape:
        return abs(kept.triangle_count - restored.triangle_count) or kept.triangle_count
    want = kept.positions[kept.faces].astype(np.float32).view(np.uint32)
    got = restored.positions[restored.faces].astype(np.float32).view(np.uint32)
    return int((want != got).any(axis=(1, 2)).sum())


if __name__ == "__main__":
    sys.exit(main())
