"""Instances that share their geometry against the same scene flattened: bytes, rays a second, hits.

    python tests/benches/bench_instances.py MODEL [MODEL ...] [--instances 1000] [--record] [--note TEXT]

A model stands in many places: turned, stretched unevenly, every other one mirrored. Rays go from all round to
where instances stand. Where the flattened scene would have more than `MOST` triangles only its bytes are
said, estimated. Times are of the processor.
"""

import argparse
import statistics
import sys
import time
from pathlib import Path

import numpy as np
from results import Row, append

import striptools
from striptools.mesh.instances import Geometries, Instances
from striptools.mesh.mesh import Mesh
from striptools.reducem.scene import Scene
from striptools.trace import Tracer
from striptools.trace.memory import EXPANDED_BYTES

BENCH = {
    "takes": "paths",
    "models": ["bunny", "dragon"],
    "full": [[]],
    "quick": [["--instances", "20", "--repeats", "1"]],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

MOST = 8_000_000
RAYS = 100_000
SPREAD = 20.0


def main() -> int:
    """Measure each model and print its rows."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--instances", type=int, default=1000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--note", default="")
    arguments = parser.parse_args()
    for path in arguments.models:
        scene = crowd_of(striptools.load_mesh(path), arguments.instances)
        note = ", ".join(filter(None, [f"{arguments.instances} instances", arguments.note]))
        rows = measure(path.stem, scene, arguments.repeats, note)
        for row in rows:
            peer = "" if not row.peer else f", {row.peer} {row.peer_value:.3g}, ratio {row.ratio:.3g}"
            sys.stdout.write(f"{row.mesh}: {row.metric} {row.value:.4g} {row.unit}{peer} {row.note}\n")
        if arguments.record:
            append(rows)
    return 0


def crowd_of(mesh: Mesh, count: int) -> Scene:
    """A scene of a model that stands in many places."""
    random = np.random.default_rng(0)
    positions = np.asarray(mesh.positions, np.float64)
    positions = positions - (positions.min(axis=0) + positions.max(axis=0)) / 2
    positions /= np.abs(positions).max()
    turned = np.linalg.qr(random.normal(size=(count, 3, 3)))[0]
    matrix = turned * 10 ** random.uniform(-1, 0.5, (count, 1, 3))
    matrix[(np.linalg.det(matrix) < 0) != (np.arange(count) % 2 == 1), :, 0] *= -1
    matrix = np.concatenate([matrix, SPREAD * random.normal(size=(count, 3, 1))], axis=2)
    ranges = (np.array([0, len(mesh.faces)], np.int32), np.array([0, len(positions)], np.int32))
    placed = Instances(np.zeros(count, np.int32), matrix)
    given = {"geometries": Geometries(*ranges), "instances": placed}
    return striptools.convert(Mesh(positions.astype(np.float32), mesh.faces, **given))


def measure(name: str, scene: Scene, repeats: int, note: str) -> list[Row]:
    """Bytes of all ways to keep a scene, and rays a second, taken by turns."""
    placed = scene.placed_count
    tracers = {
        kind: Tracer(scene, device="cpu", threads=1, instances="shared", resident=kind)
        for kind in ("expanded", "compressed")
    }
    flat_bytes, flat, said = EXPANDED_BYTES * placed, None, "flattened, estimated"
    if placed <= MOST:
        flat = Tracer(scene, device="cpu", threads=1, instances="flattened")
        flat_bytes, said = flat.resident_bytes, "flattened"
    rays = rays_at(scene)
    rows = []
    for kind, tracer in tracers.items():
        held = tracer.resident_bytes
        peer = (said, flat_bytes, held / flat_bytes)
        rows.append(Row("instances", name, placed, f"{kind}: bytes kept", held, "B", *peer, note))
    everyone = {**tracers, **({} if flat is None else {"flattened": flat})}
    seconds = {kind: [] for kind in everyone}
    for _ in range(repeats + 1):
        for kind, tracer in everyone.items():
            begin = time.process_time()
            tracer.closest_hit(*rays, packets=False)
            seconds[kind].append(time.process_time() - begin)
    for kind, runs in seconds.items():
        rate = RAYS / statistics.median(runs[1:]) / 1e6
        peer = ("", None, None)
        if flat is not None and kind != "flattened":
            theirs = RAYS / statistics.median(seconds["flattened"][1:]) / 1e6
            peer = ("flattened", theirs, rate / theirs)
        rows.append(Row("instances", name, placed, f"{kind}: closest hit", rate, "Mrays/s", *peer, note))
    if flat is not None:
        ours, theirs = tracers["expanded"].closest_hit(*rays), flat.closest_hit(*rays)
        different = int((ours.face != theirs.face).sum())
        rows.append(
            Row("instances", name, placed, "faces other than flattened", different, "rays", note=note)
        )
    return rows


def rays_at(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Rays from all round, each to somewhere near where an instance stands."""
    assert scene.instances is not None
    random = np.random.default_rng(1)
    origins = random.normal(size=(RAYS, 3)) * 3 * SPREAD
    stands = scene.instances.matrix[random.integers(0, len(scene.instances), RAYS), :, 3]
    directions = stands + random.normal(size=(RAYS, 3)) * 0.5 - origins
    return origins.astype(np.float32), directions.astype(np.float32)


if __name__ == "__main__":
    sys.exit(main())
