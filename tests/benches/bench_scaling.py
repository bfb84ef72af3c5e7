"""How much faster two cores trace than one: camera rays and ambient occlusion, by turns, in one process.

    python tests/benches/bench_scaling.py MODEL [MODEL ...] [--seconds 60] [--side 768] [--record]

One core is all threads of the process pinned to the first core and one device; two cores are two devices and
no pins. One device beside a free core is measured too: the tracer's host kernels then have that core. Other
programs may run on the machine, so a time counts only where a loop that does nothing but compute ran on two
threads in the least time of one, right before and right after (`QUIET`), and is taken only once nothing else
has run for a moment; what is compared are least times. Where the machine is never that quiet, `--everything`
counts all: what is compared are medians, and beside them stands what two cores gave that loop in the same
moments, which is as much as the tracer can gain. Linux only.
"""

import argparse
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from cores import pin
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

QUIET = 1.1
"""Time of the loop on two threads, over its least time on one, up to which the machine is taken for quiet."""

CALM = 5
"""Looks in a row at which no other thread of the machine runs before a time is taken."""

SPINS = 100
ENOUGH = 25
"""Times that count after which nothing more is measured."""

SPIN = np.linspace(0.0, 1.0, 30_000)
Call = Callable[[], object]


def main() -> int:
    """Measure each model and print a row for each kind of rays."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--seconds", type=float, default=60.0, help="at most, for each kind of rays")
    parser.add_argument("--side", type=int, default=768)
    parser.add_argument("--everything", action="store_true")
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    for path in arguments.models:
        mesh = striptools.load_mesh(path)
        quiet = np.inf if arguments.everything else QUIET
        rows = measure(path.stem, striptools.convert(mesh), arguments.side, arguments.seconds, quiet)
        if arguments.record:
            append(rows)
    return 0


def measure(name: str, scene: Scene, side: int, seconds: float, quiet: float) -> list[Row]:
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
            found = by_turns(calls[0], calls[1], seconds, quiet)
            what = f"{kind}, {query.replace('_', ' ')}"
            said = f"{len(rays[0])} rays, {found.turns} times each"
            if found.turns:
                gain, beside = found.pinned / found.both, found.beside / found.both
                said += f"; one device beside a free core {beside:.3g}"
                said += f"; a loop that only computes {found.loop:.3g}"
                rows.append(Row("scaling", name, scene.triangle_count, what, gain, "of one core", note=said))
                said = f"{gain:.3f} of one core ({said}), {1000 * found.both:.0f} ms"
            sys.stdout.write(f"{name}: {what}: {said}\n")
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


class Found(NamedTuple):
    """Seconds of a call on one core, on one device beside a free core and on two devices; how often the
    rarest counted; and how much faster than on one core the loop ran on two.
    """

    pinned: float
    beside: float
    both: float
    turns: int
    loop: float


def by_turns(one: Call, two: Call, seconds: float, quiet: float) -> Found:
    """Least times of what counts, or medians where all does."""
    ways = ((one, {0}), (one, {0, 1}), (two, {0, 1}))
    times: list[list[float]] = [[] for _ in ways]
    loops: list[float] = []
    one()
    two()
    least = min(timed(spin) for _ in range(30))
    end, turn = time.perf_counter() + seconds, 0
    while time.perf_counter() < end and min(map(len, times)) < ENOUGH:
        await_quiet(end if quiet < np.inf else 0.0)
        call, cores = ways[turn % len(ways)]
        alone = timed(spin)
        least = min(least, alone)
        before = together()
        pin(cores)
        spent = timed(call)
        pin({0, 1})
        after = together()
        if max(before, after) <= quiet * least:
            times[turn % len(ways)].append(spent)
            loops.append(2 * alone / before)
        turn += 1
    turns = min(map(len, times))
    if turns == 0:
        return Found(np.inf, np.inf, np.inf, 0, np.nan)
    pinned, beside, both = (float(np.median(each)) if quiet == np.inf else min(each) for each in times)
    return Found(pinned, beside, both, turns, float(np.median(loops)))


def await_quiet(end: float) -> None:
    """Sleep until nothing else has run for a moment, or until that time."""
    seen = 0
    while seen < CALM and time.perf_counter() < end:
        running = next(
            line for line in Path("/proc/stat").read_text().splitlines() if "procs_running" in line
        )
        seen = seen + 1 if int(running.split()[1]) <= 1 else 0
        time.sleep(0.004)


def together() -> float:
    """Seconds of the loop on two threads at once."""
    threads = [threading.Thread(target=spin) for _ in range(2)]
    begun = time.perf_counter()
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    return time.perf_counter() - begun


def spin() -> None:
    """Compute, without Python's lock."""
    room = np.zeros_like(SPIN)
    for _ in range(SPINS):
        np.exp(SPIN, out=room)


def timed(work: Call) -> float:
    """Seconds that a call takes."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    sys.exit(main())
