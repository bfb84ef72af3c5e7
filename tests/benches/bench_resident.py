"""Tracing packed blocks as they lie against the same scene expanded: one process, one thread, by turns.

    python tests/benches/bench_resident.py MODEL [MODEL ...] [--repeats 21] [--record] [--note TEXT]

MODEL is a mesh or a scene file. Rays are those of `bench_trace`: a camera's, in packets and one by one, all
of its picture and a run from the middle, and ambient occlusion from what it sees, closest hit and any hit.
Times are of the processor, so that other work on the machine tells less; a ratio is the median of the ratios
of runs next to each other.
Bytes are of all arrays that a tracer keeps.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from bench_trace import Rays, occlusion_rays, tiled_camera_rays
from results import Row, append

import striptools
from striptools.reducem.scene import Scene
from striptools.trace import Tracer

BENCH = {
    "takes": "paths",
    "models": ["bunny", "dragon"],
    "full": [[]],
    "quick": [["--repeats", "3"]],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

RAYS = 1 << 17
"""Of each kind: a run from the middle of the picture."""


def main() -> int:
    """Measure each model and print a row for each kind of ray."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--repeats", type=int, default=21)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--note", default="")
    arguments = parser.parse_args()
    for path in arguments.models:
        scene = striptools.open(path) if path.suffix == ".rdm" else striptools.convert(path)
        rows = measure(path.stem, scene, arguments.repeats, arguments.note)
        for row in rows:
            peer = f", {row.peer} {row.peer_value:.3g}, ratio {row.ratio:.3f}"
            sys.stdout.write(f"{row.mesh}: {row.metric} {row.value:.3g} {row.unit}{peer} {row.note}\n")
        sys.stdout.flush()
        if arguments.record:
            append(rows)
    return 0


def measure(name: str, scene: Scene, repeats: int, note: str) -> list[Row]:
    """Lay the scene out both ways, and let the two take turns on each kind of ray."""
    packed, wide = (
        Tracer(scene, device="cpu", threads=1, resident=kind) for kind in ("compressed", "expanded")
    )
    count = scene.triangle_count
    held, peer_held = packed.resident_bytes / count, wide.resident_bytes / count
    ratio = held / peer_held
    rows = [Row("resident", name, count, "bytes kept", held, "B/tri", "expanded", peer_held, ratio, note)]
    camera = tiled_camera_rays(scene)
    seen = wide.closest_hit(*camera).triangle
    occlusion = middle(occlusion_rays(scene.positions[scene.faces()], camera, seen))
    for metric, rays, call, packets in (
        ("camera rays, the whole picture, closest hit", camera, "closest_hit", True),
        ("camera rays one by one, the whole picture, closest hit", camera, "closest_hit", False),
        ("camera rays one by one, closest hit", middle(camera), "closest_hit", False),
        ("AO rays, closest hit", occlusion, "closest_hit", False),
        ("AO rays, any hit", occlusion, "any_hit", False),
    ):
        ours, theirs = (partial(getattr(one, call), packets=packets) for one in (packed, wide))
        rows.append(_compare(name, count, metric, rays, ours, theirs, repeats, note))
    return rows


def middle(rays: Rays) -> Rays:
    """A run of rays from the middle."""
    begin = max(0, (len(rays[0]) - RAYS) // 2)
    return rays[0][begin : begin + RAYS], rays[1][begin : begin + RAYS]


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
    """Millions of rays a second of both, and the median ratio."""
    one, two = ours(*rays), theirs(*rays)
    same = float(np.mean(one == two) if isinstance(one, np.ndarray) else np.mean(one.t == two.t))
    times = [(_seconds(ours, rays), _seconds(theirs, rays)) for _ in range(repeats)]
    rate, peer_rate = (len(rays[0]) / min(column) / 1e6 for column in zip(*times, strict=True))
    ratio = statistics.median(peer / mine for mine, peer in times)
    remark = "; ".join(filter(None, [f"{len(rays[0])} rays, one thread, same t {same:.6f}", note]))
    return Row("resident", name, triangles, metric, rate, "Mray/s", "expanded", peer_rate, ratio, remark)


def _seconds(call: Callable, rays: Rays) -> float:
    start = time.process_time()
    call(*rays)
    return time.process_time() - start


if __name__ == "__main__":
    sys.exit(main())
