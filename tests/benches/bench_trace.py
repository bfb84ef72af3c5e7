"""Tracing against embreex, and open3d where it is installed, in the same run, all of it on one core.

    python tests/benches/bench_trace.py MODEL [MODEL ...] [--repeats 15] [--hierarchy both] [--record]
        [--beside] [--note TEXT]

MODEL is a mesh or a scene file. Camera rays: 1024 x 1024 pixels in tiles of 8 x 8, the model framed.
Ambient occlusion: one cosine-distributed ray from each point that the camera sees. Both are asked for
closest hits with and without weights (u and v, which peers work out but do not hand over), occlusion for
any hit too. Random rays: 2**18 from anywhere in the model's bounds in any direction. Through the stored
hierarchy of the scene, a rebuilt one, or both. The tracers take turns; a ratio is the median of the ratios
of runs next to each other in time. The process stays on one core, or what the tracer does beside its walk
would have another for nothing; `--beside` leaves it that. Linux only.
"""

import os

os.environ["OMP_NUM_THREADS"] = "1"

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from cores import pin
from peers import PEERS
from results import Row, append

import striptools
from striptools.measure.study import random_rays
from striptools.reducem.scene import Scene
from striptools.trace import Tracer
from striptools.trace.rays import Camera, camera_rays, cosine_rays
from striptools.trace.tracer import HierarchyKind

BENCH = {
    "takes": "paths",
    "models": ["bunny", "dragon", "dragon_3m5", "dem_jacksboro", "powerplant"],
    "full": [[]],
    "quick": [["--repeats", "5"]],
    "needs": ["embreex"],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

PIXELS = 1024
TILE = 8
RANDOM = 2**18

Rays = tuple[np.ndarray, np.ndarray]


def main() -> int:
    """Measure each model and print a row for each kind of ray."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--hierarchy", choices=("stored", "rebuilt", "both"), default="both")
    parser.add_argument("--beside", action="store_true", help="host work may use another core")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--note", default="")
    arguments = parser.parse_args()
    if not arguments.beside:
        pin({max(os.sched_getaffinity(0))})
    where = "one thread, host work beside it" if arguments.beside else "one core"
    for path in arguments.models:
        scene = striptools.open(path) if path.suffix == ".rdm" else striptools.convert(path)
        kinds = ("stored", "rebuilt") if arguments.hierarchy == "both" else (arguments.hierarchy,)
        rows = [
            row
            for kind in kinds
            for row in measure(path.stem, scene, kind, arguments.repeats, where, arguments.note)
        ]
        for row in rows:
            peer = f", {row.peer} {row.peer_value:.3g}, ratio {row.ratio:.3f}" if row.peer_value else ""
            sys.stdout.write(f"{row.mesh}: {row.metric} {row.value:.3g} {row.unit}{peer} {row.note}\n")
            sys.stdout.flush()
        if arguments.record:
            append(rows)
    return 0


def measure(
    name: str, scene: Scene, hierarchy: HierarchyKind, repeats: int, where: str, note: str
) -> list[Row]:
    """Build both tracers, then let them take turns on each kind of ray."""
    Tracer(scene, device="cpu", threads=1, hierarchy=hierarchy)
    start = time.perf_counter()
    tracer = Tracer(scene, device="cpu", threads=1, hierarchy=hierarchy)
    build = time.perf_counter() - start
    corners = scene.positions[scene.faces()]
    count = scene.triangle_count
    note = "; ".join(filter(None, [where, f"{hierarchy} hierarchy", note]))
    rows: list[Row] = []
    camera, anywhere = tiled_camera_rays(scene), random_rays(scene, RANDOM)
    occlusion: Rays | None = None
    for peer_name, make in PEERS:
        start = time.perf_counter()
        try:
            peer = make(corners)
        except ImportError:
            continue
        peer_build = time.perf_counter() - start
        given = "trace", name, count, "tracer build", build, "s", peer_name, peer_build
        rows.append(Row(*given, build / peer_build, note))
        if occlusion is None:
            occlusion = occlusion_rays(corners, camera, peer.faces(*camera))
        for metric, rays, call, other in (
            ("camera rays, closest hit", camera, "closest", peer.faces),
            ("AO rays, closest hit", occlusion, "closest", peer.faces),
            ("camera rays, closest hit without weights", camera, "faces", peer.faces),
            ("AO rays, closest hit without weights", occlusion, "faces", peer.faces),
            ("AO rays, any hit", occlusion, "any", peer.any),
            ("random rays, closest hit", (anywhere.origins, anywhere.directions), "closest", peer.faces),
        ):
            found = _compare(name, count, metric, rays, asked(tracer, call), other, repeats, note)
            rows.append(replace(found, peer=peer_name))
    return rows


def asked(tracer: Tracer, call: str) -> Callable:
    """What peers tell: a face, or whether there is one; ours tells t too, and weights if they are asked."""
    if call == "any":
        return tracer.any_hit
    return lambda *rays: tracer.closest_hit(*rays, weights=call == "closest").triangle


def _compare(
    name: str,
    triangles: int,
    metric: str,
    rays: Rays,
    ours: Callable,
    theirs: Callable,
    repeats: int,
    note: str,
) -> Row:
    """Take turns; millions of rays a second of each, and the median ratio."""
    same = float((ours(*rays) == theirs(*rays)).mean())
    times = [(_seconds(theirs, rays), _seconds(ours, rays)) for _ in range(repeats)]
    count = len(rays[0])
    rate, peer_rate = (
        count / min(column) / 1e6 for column in (list(zip(*times, strict=True))[k] for k in (1, 0))
    )
    ratio = statistics.median(peer / mine for peer, mine in times)
    remark = f"{count} rays, same answer {same:.6f}; {note}"
    return Row("trace", name, triangles, metric, rate, "Mray/s", "embreex", peer_rate, ratio, remark)


def _seconds(call: Callable, rays: Rays) -> float:
    start = time.perf_counter()
    call(*rays)
    return time.perf_counter() - start


def tiled_camera_rays(scene: Scene) -> Rays:
    """Rays of a picture of the whole model, tile by tile."""
    camera = Camera.framing(scene.positions, width=PIXELS, height=PIXELS)
    tiles = PIXELS // TILE
    return tuple(
        np.ascontiguousarray(
            rays.reshape(tiles, TILE, tiles, TILE, 3).transpose(0, 2, 1, 3, 4).reshape(-1, 3)
        )
        for rays in camera_rays(camera)
    )


def occlusion_rays(corners: np.ndarray, rays: Rays, triangle: np.ndarray) -> Rays:
    """One ray from each point seen, to the side it is seen from."""
    hit = np.flatnonzero(triangle >= 0)
    origin, direction = (a[hit].astype(np.float64) for a in rays)
    a, b, c = (corners[triangle[hit], k].astype(np.float64) for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    towards = (normal * direction).sum(axis=1, keepdims=True)
    normal = np.where(towards > 0, -normal, normal)
    depth = ((a - origin) * normal).sum(axis=1) / np.minimum((direction * normal).sum(axis=1), -1e-12)
    size = float(np.linalg.norm(np.ptp(corners.reshape(-1, 3), axis=0)))
    return cosine_rays(origin + depth[:, None] * direction, normal, offset=1e-4 * size)


if __name__ == "__main__":
    sys.exit(main())
