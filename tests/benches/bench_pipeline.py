"""The whole way on real models: convert, verify, convert back, and what each costs.

    python tests/benches/bench_pipeline.py FOLDER [MESH ...] [--record]

FOLDER holds `MESH.ply` files. Each model has a process of its own. There a small mesh is converted first,
which brings in all imports and compiled kernels; the first conversion of the model then gives the peak of
memory, and the second one the seconds.
`--record` appends the figures to `results.csv`.
"""

import argparse
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from results import Row, append

import striptools
from striptools.mesh.clean import clean
from striptools.mesh.io import load_mesh, save_mesh
from striptools.pipeline import STAGES

MESHES = (
    "bunny", "dragon", "dem_jacksboro", "icub", "kicad_acepack", "chandelier", "tree_japanesemaple",
    "soup_bunny", "ugly_bunny_holes",
)  # fmt: skip


def main() -> int:
    """Measure each model, print its row, and say how many failed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("meshes", nargs="*", default=MESHES)
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    failed = 0
    for name in arguments.meshes:
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as process:
            rows = process.submit(measure, name, arguments.folder / f"{name}.ply").result()
        figures = {row.metric: row.value for row in rows}
        line = ", ".join(f"{key} {value:.6g}" for key, value in figures.items())
        sys.stdout.write(f"{name}: {line}\n")
        sys.stdout.flush()
        failed += bool(figures["disagreements"] or figures["leaks"] or figures["faces lost on the way back"])
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
