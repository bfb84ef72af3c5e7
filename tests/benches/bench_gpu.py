"""Tracing on a GPU against the CPU path in the same process: the same hits, and rays a second.

    python tests/benches/bench_gpu.py MODEL [MODEL ...] [--rays 20] [--repeats 5]
        [--kinds expanded compressed rebuilt] [--under slbvh ...] [--twin] [--record] [--note TEXT]

MODEL is a mesh or a scene file. Camera rays: 1024 x 1024 pixels in tiles of 8 x 8, the model framed; ambient
occlusion: one cosine-distributed ray from each point seen; random rays: 2**rays chords of the bounding
sphere. Every answer of the GPU is compared with the CPU's: a difference in face or in a bit of t counts.
Rates are given of whole calls, transfers and weighing of hits included, and of the device alone: rays made
ready and walked, rays and results in its memory, occlusion rays repeated until there are as many as random
ones. `--kinds` are residencies, or `rebuilt`, expanded under a hierarchy that the tracer makes. `--twin`
measures there the kernel's plain-JAX twin too; hierarchies named by `--under` have no kernel and are walked
by vmap. `--record` appends the figures to `results.csv`.
"""

import argparse
import sys
import time
from pathlib import Path

import jax
import numpy as np
from jax.sharding import NamedSharding
from results import Row, append

import striptools
from striptools.hierarchies.options import HierarchyOptions
from striptools.reducem.scene import Scene
from striptools.trace import Tracer
from striptools.trace.device import quiet_jax
from striptools.trace.launch import RAYS, program
from striptools.trace.rays import Camera, camera_rays, cosine_rays

BENCH = {
    "takes": "paths",
    "models": ["bunny", "chandelier", "dragon", "powerplant"],
    "full": [["--twin", "--under", "slbvh"]],
    "quick": [["--rays", "16", "--repeats", "2"]],
    "needs": ["gpu"],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

KINDS = {
    "expanded": {"resident": "expanded"},
    "compressed": {"resident": "compressed"},
    "rebuilt": {"hierarchy": "rebuilt"},
}
"""How the tracer is asked for each."""

PIXELS = 1024
TILE = 8

Rays = tuple[np.ndarray, np.ndarray]


def main() -> int:
    """Measure each model; 1 where any answer differs, 2 where there is no GPU."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--rays", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--kinds", nargs="*", choices=KINDS, default=list(KINDS))
    parser.add_argument("--under", nargs="*", default=[])
    parser.add_argument("--twin", action="store_true")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--note", default="")
    arguments = parser.parse_args()
    if jax.default_backend() != "gpu":
        sys.stderr.write("JAX finds no GPU here\n")
        return 2
    differ = 0
    for path in arguments.models:
        scene = striptools.open(path) if path.suffix == ".rdm" else striptools.convert(path)
        cpu = Tracer(scene, device="cpu", resident="expanded")
        for what in (*arguments.kinds, *arguments.under):
            rows = measure(path.stem, scene, what, cpu, arguments)
            for row in rows:
                sys.stdout.write(f"{row.mesh}: {row.metric} {row.value:.6g} {row.unit} ({row.note})\n")
                sys.stdout.flush()
                differ += int(row.value) if row.metric.startswith("differing") else 0
            if arguments.record:
                append(rows)
    return 1 if differ else 0


def measure(name: str, scene: Scene, what: str, cpu: Tracer, arguments: argparse.Namespace) -> list[Row]:
    """Trace every kind of ray on both devices; `what` is one of `KINDS` or another hierarchy."""
    if what in KINDS:
        gpu = Tracer(scene, device="gpu", **KINDS[what])  # pyright: ignore[reportArgumentType]
    else:
        gpu = Tracer(scene.under(HierarchyOptions(what)), device="gpu")  # pyright: ignore[reportArgumentType]
    device = str(gpu.devices[0].device_kind)
    rows = []
    for kind, rays in ray_kinds(scene, cpu, 2**arguments.rays):
        ours, wanted = gpu.closest_hit(*rays), cpu.closest_hit(*rays, packets=False)
        wrong = int(((ours.face != wanted.face) | (ours.t.view(np.int32) != wanted.t.view(np.int32))).sum())
        wrong_any = int((gpu.any_hit(*rays) != (wanted.face >= 0)).sum())
        note = "; ".join(filter(None, [f"{device}, {what}, {len(rays[0])} rays", arguments.note]))
        count = scene.triangle_count
        rows += [
            Row("gpu", name, count, f"differing closest hits, {kind}", wrong, "rays", note=note),
            Row("gpu", name, count, f"differing any hits, {kind}", wrong_any, "rays", note=note),
            rate(name, count, f"{kind} rays, closest hit", gpu.closest_hit, rays, arguments.repeats, note),
            rate(name, count, f"{kind} rays, any hit", gpu.any_hit, rays, arguments.repeats, note),
        ]
        many = repeated(rays, 2**arguments.rays)
        for twin in (False, True)[: 1 + arguments.twin]:
            for any_hit, asked in ((False, "closest hit"), (True, "any hit")):
                value, by = device_rate(gpu, many, arguments.repeats, any_hit=any_hit, twin=twin)
                metric = f"{kind} rays, {asked}, {by}, on the device alone"
                rows.append(Row("gpu", name, count, metric, value, "Mray/s", note=note))
    return rows


def repeated(rays: Rays, count: int) -> Rays:
    """So many of them: where there are fewer, from the first on again."""
    origins, directions = (np.resize(a, (count, 3)) for a in rays)
    return origins, directions


def device_rate(tracer: Tracer, rays: Rays, repeats: int, *, any_hit: bool, twin: bool) -> tuple[float, str]:
    """Millions of rays a second of many calls in a row, rays and results in the device's memory; by what."""
    options = tracer._options(any_hit=any_hit)
    assert options is not None
    if twin:
        options = options._replace(kernel=False)
    run = program(tracer._mesh, options)
    count = len(rays[0])
    # Placed as the tracer places them: the program is the one that it has compiled.
    given = jax.device_put([*rays, np.full(count, np.inf, np.float32)], NamedSharding(tracer._mesh, RAYS))
    calls, best = 20 if options.kernel else 1, np.inf
    with quiet_jax():
        for _ in range(repeats + 1):
            start = time.perf_counter()
            jax.block_until_ready([run(tracer._scene, *given) for _ in range(calls)])
            best = min(best, time.perf_counter() - start)
    by = "kernel" if options.kernel else "twin" if twin else "vmap"
    return calls * count / best / 1e6, by


def rate(name: str, count: int, metric: str, call: object, rays: Rays, repeats: int, note: str) -> Row:
    """Millions of rays a second of the fastest call."""
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        call(*rays)  # pyright: ignore[reportCallIssue]
        best = min(best, time.perf_counter() - start)
    return Row("gpu", name, count, metric, len(rays[0]) / best / 1e6, "Mray/s", note=note)


def ray_kinds(scene: Scene, cpu: Tracer, count: int) -> list[tuple[str, Rays]]:
    """Camera rays, occlusion rays from what they see, and chords of the bounding sphere."""
    camera = Camera.framing(scene.positions, width=PIXELS, height=PIXELS)
    tiles = PIXELS // TILE
    origins, directions = (
        np.ascontiguousarray(r.reshape(tiles, TILE, tiles, TILE, 3).swapaxes(1, 2).reshape(-1, 3))
        for r in camera_rays(camera)
    )
    hits = cpu.closest_hit(origins, directions, packets=False)
    met = np.flatnonzero(hits.face >= 0)
    corners = scene.positions[scene.faces()[hits.triangle[met]]].astype(np.float64)
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    way = directions[met].astype(np.float64)
    normal = np.where((normal * way).sum(axis=1, keepdims=True) > 0, -normal, normal)
    low, high = scene.positions.min(axis=0), scene.positions.max(axis=0)
    size = float(np.linalg.norm(high - low))
    points = origins[met].astype(np.float64) + hits.t[met, None].astype(np.float64) * way
    occlusion = cosine_rays(points, normal, offset=1e-4 * size)
    draw = np.random.default_rng(1).normal(size=(2, count, 3))
    ends = (low + high) / 2 + size / 2 * draw / np.linalg.norm(draw, axis=2, keepdims=True)
    chords = ends[0].astype(np.float32), (ends[1] - ends[0]).astype(np.float32)
    return [("camera", (origins, directions)), ("AO", occlusion), ("random", chords)]


if __name__ == "__main__":
    sys.exit(main())
