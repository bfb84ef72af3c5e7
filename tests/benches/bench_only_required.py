"""What each thing costs that a scene or a query may do without: bytes and rays a second with it and without.

    python tests/benches/bench_only_required.py MODEL [MODEL ...] [--repeats 15] [--record]

Bytes are of the file without its container, and of all arrays that a tracer keeps. Rays are those of
`bench_trace`'s camera, one thread, with and without by turns; times are of the processor, and a ratio is the
median of the ratios of runs next to each other. That what is off is absent is proved by
tests/test_only_required.py.
"""

import argparse
import statistics
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from results import Row, append

import striptools
from striptools.mesh.attributes import Attribute
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert
from striptools.reducem.scene import Scene
from striptools.trace import Tracer
from striptools.trace.rays import Camera, camera_rays

BENCH = {
    "takes": "paths",
    "models": ["bunny", "dragon"],
    "full": [[]],
    "quick": [],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

PIXELS = 512
PLAIN = Options(remap=False, geometry_only=True)


def main() -> int:
    """Measure each model and print its rows."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    for path in arguments.models:
        mesh = striptools.load_mesh(path).flattened().geometry()
        rows = [*sizes(path.stem, mesh), *times(path.stem, convert(mesh, PLAIN), arguments.repeats)]
        for row in rows:
            line = f"{row.mesh}: {row.metric}: {row.value:.4g} with, {row.peer_value:.4g} without, {row.unit}"
            sys.stdout.write(f"{line}, ratio {row.ratio:.3f}\n")
        if arguments.record:
            append(rows)
    return 0


def sizes(name: str, mesh: Mesh) -> Iterator[Row]:
    """Bytes a triangle in the file and in a tracer."""
    plain = convert(mesh, PLAIN)
    remap, stored = convert(mesh, replace(PLAIN, remap=True)), convert(mesh, replace(PLAIN, boxes="stored"))
    normals = np.zeros((mesh.vertex_count, 3), np.float32)
    normals[:, 2] = np.arange(mesh.vertex_count) % 1000
    lit = convert(replace(mesh, attributes=(Attribute("normal", "vertex", normals),)), Options(remap=False))
    count = plain.triangle_count

    def row(metric: str, with_it: float, without: float) -> Row:
        given = (with_it / count, "bytes per triangle", "without", without / count, with_it / without)
        return Row("only_required", name, count, metric, *given)

    for what, scene in (("remap", remap), ("boxes stored", stored), ("1000 different normals", lit)):
        yield row(f"file: {what}", _file(scene), _file(plain))
    for resident in ("compressed", "expanded"):
        kept = {
            what: Tracer(scene, device="cpu", resident=resident).resident_bytes
            for what, scene in (("plain", plain), ("remap", remap), ("1000 different normals", lit))
        }
        for what in ("remap", "1000 different normals"):
            yield row(f"{resident} in memory: {what}", kept[what], kept["plain"])


def _file(scene: Scene) -> int:
    parts = scene.part_bytes()
    return sum(parts.values()) - parts["container"]


def times(name: str, scene: Scene, repeats: int) -> Iterator[Row]:
    """Rays a second of queries with and without."""
    rays = camera_rays(Camera.framing(scene.positions, width=PIXELS, height=PIXELS))
    for resident in ("expanded", "compressed"):
        tracer = Tracer(scene, device="cpu", threads=1, resident=resident)
        queries: list[tuple[str, Callable[..., Any], Callable[..., Any]]] = [
            ("u and v", tracer.closest_hit, partial(tracer.closest_hit, weights=False)),
            (
                "counters",
                partial(tracer.closest_hit, counters=True),
                partial(tracer.closest_hit, packets=False),
            ),
            ("the closest hit, not any", tracer.closest_hit, tracer.any_hit),
        ]
        for what, with_it, without in queries:
            pairs = [(_seconds(with_it, rays), _seconds(without, rays)) for _ in range(repeats + 1)][1:]
            on, off = (len(rays[0]) / min(column) / 1e6 for column in zip(*pairs, strict=True))
            ratio = statistics.median(two / one for one, two in pairs)
            metric = f"{resident}: {what}"
            yield Row(
                "only_required", name, scene.triangle_count, metric, on, "Mray/s", "without", off, ratio
            )


def _seconds(query: Callable[..., Any], rays: tuple[np.ndarray, ...]) -> float:
    start = time.process_time()
    query(*rays)
    return time.process_time() - start


if __name__ == "__main__":
    sys.exit(main())
