"""How much faster two cores trace than one: camera rays and ambient occlusion, by turns, in one process.

    python tests/benches/bench_scaling.py MODEL [MODEL ...] [--seconds 60] [--side 1024] [--record]

MODEL is a mesh or a scene file. One core is all threads of the process pinned to the first core and one
device; two cores are two devices and no pins. One device beside a free core is measured too: the tracer's
host kernels then have that core. Other programs may run on the machine or beside it, so least times are
compared, which are those of its quietest moments (if two cores seldom have the same one, the ratio is too
small), and medians, too. Beside both stands what two cores gave a loop that only computes, in the same
minutes: as much as the tracer could gain. Linux only.
"""

import argparse
import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from cores import pin
from numba import njit
from results import Row, append

import striptools
from striptools.reducem.scene import Scene
from striptools.trace import Tracer
from striptools.trace.rays import Camera, camera_rays, cosine_rays

BENCH = {
    "takes": "paths",
    "models": ["dragon"],
    "full": [[]],
    "quick": [],
}

SPINS = 10_000_000
"""Turns of the loop: some hundredths of a second."""

ENOUGH = 60
"""Times after which nothing more is measured."""

Call = Callable[[], object]


def main() -> int:
    """Measure each model and print a row for each kind of rays."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0, help="at most, for each kind of rays")
    parser.add_argument("--side", type=int, default=1024)
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    for path in arguments.models:
        scene = striptools.open(path) if path.suffix == ".rdm" else striptools.convert(path)
        rows = measure(path.stem, scene, arguments.side, arguments.seconds)
        if arguments.record:
            append(rows)
    return 0


def measure(name: str, scene: Scene, side: int, seconds: float) -> list[Row]:
    """The rows of one model."""
    one, two = (Tracer(scene, device="cpu", threads=k, hierarchy="rebuilt") for k in (1, 2))
    camera = camera_rays(Camera.framing(scene.positions, width=side, height=side))
    bounce = bounced(scene, two, *camera)
    rows = []
    for kind, rays, packets in (
        ("camera", camera, False),
        ("camera in packets", camera, True),
        ("ambient occlusion", bounce, False),
    ):
        for query in ("closest_hit", "any_hit"):
            calls = [partial(getattr(tracer, query), *rays, packets=packets) for tracer in (one, two)]
            found = by_turns(calls[0], calls[1], seconds)
            what = f"{kind}, {query.replace('_', ' ')}"
            for times, of in (("least times", found.least), ("medians", found.median)):
                gain, beside, loop = of.pinned / of.both, of.pinned / of.beside, 2 * of.alone / of.together
                said = f"{len(rays[0])} rays, {found.turns} times each; one device beside a free core "
                said += f"{beside:.3g}; a loop that only computes {loop:.3g}"
                row = Row("scaling", name, scene.triangle_count, f"{what}, {times}", gain, "of one core")
                rows.append(replace(row, note=said))
                sys.stdout.write(f"{name}: {row.metric}: {gain:.3f} of one core ({said})\n")
            sys.stdout.flush()
    return rows


def bounced(
    scene: Scene, tracer: Tracer, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rays of ambient occlusion from where a camera's hit."""
    hits = tracer.closest_hit(origins, directions)
    hit = np.flatnonzero(hits.hit)
    way = directions[hit].astype(np.float64)
    a, b, c = scene.positions[scene.faces()[hits.triangle[hit]]].astype(np.float64).transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= -np.sign((normals * way).sum(axis=1, keepdims=True))
    points = origins[hit] + hits.t[hit, None] * way
    return cosine_rays(points, normals, seed=1, offset=1e-5 * float(np.linalg.norm(scene.high - scene.low)))


class Times(NamedTuple):
    """Seconds of a call on one core, on one device beside a free core and on two devices, and of the loop on
    one core and on two.
    """

    pinned: float
    beside: float
    both: float
    alone: float
    together: float


class Found(NamedTuple):
    """What was measured, and how often each."""

    least: Times
    median: Times
    turns: int


def by_turns(one: Call, two: Call, seconds: float) -> Found:
    """Time calls and the loop, one after the other, again and again."""
    one()
    two()
    spin()
    ways = ((one, {0}), (one, {0, 1}), (two, {0, 1}), (spin, {0, 1}), (together, {0, 1}))
    times: list[list[float]] = []
    end = time.perf_counter() + seconds
    while time.perf_counter() < end and len(times) < ENOUGH:
        turn = []
        for call, cores in ways:
            pin(cores)
            turn.append(timed(call))
        times.append(turn)
    columns = np.array(times)
    return Found(Times(*columns.min(axis=0)), Times(*np.median(columns, axis=0)), len(times))


def together() -> None:
    """The loop on two threads at once."""
    threads = [threading.Thread(target=spin) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def spin() -> None:
    """Compute, without Python's lock and without memory."""
    whirl(SPINS)


@njit(nogil=True)
def whirl(turns: int) -> int:
    """Four chains of products and sums: as many instructions a cycle as a walk has."""
    a, b, c, d = 1, 2, 3, 4
    for turn in range(turns):
        a = a * 3 + turn
        b = b * 5 + a
        c = c * 7 + turn
        d ^= c + b
    return a + b + c + d


def timed(work: Call) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    sys.exit(main())
