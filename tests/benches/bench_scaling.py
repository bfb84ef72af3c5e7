"""How much faster two cores trace than one: camera rays and ambient occlusion, by turns, in one process.

    python tests/benches/bench_scaling.py MODEL [MODEL ...] [--seconds 60] [--side 768] [--record]

One core is all threads of the process pinned to the first core and one device; two cores are two devices and
no pins. One device beside a free core is measured too: the tracer's host kernels then have that core. Other
programs may run on the machine, so a time counts only where a loop that does nothing but compute ran on two
threads in the least time of one, right before and right after (`QUIET`), and is taken only once nothing else
has run for a moment; what is compared are least times. `--everything` counts all. Linux only.
"""

import argparse
import sys
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

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
            pinned, beside, both, turns = by_turns(calls[0], calls[1], seconds, quiet)
            what = f"{kind}, {query.replace('_', ' ')}"
            said = f"{len(rays[0])} rays, {turns} times each"
            if turns:
                note = f"{said}; one device beside a free core {beside / both:.3g}"
                row = Row(
                    "scaling", name, scene.triangle_count, what, pinned / both, "of one core", note=note
                )
                rows.append(row)
                said = f"{pinned / both:.3f} of one core, {beside / both:.3f} of one device ({said})"
            sys.stdout.write(f"{name}: {what}: {said}, {1000 * both:.0f} ms\n")
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


def by_turns(one: Call, two: Call, seconds: float, quiet: float) -> tuple[float, float, float, int]:
    """Least seconds of one pinned, one beside a free core, and two; and how often the rarest counted."""
    ways = ((one, {0}), (one, {0, 1}), (two, {0, 1}))
    times: list[list[float]] = [[] for _ in ways]
    one()
    two()
    alone = min(timed(spin) for _ in range(30))
    end, turn = time.perf_counter() + seconds, 0
    while time.perf_counter() < end and min(map(len, times)) < ENOUGH:
        await_quiet(end if quiet < np.inf else 0.0)
        call, cores = ways[turn % len(ways)]
        alone = min(alone, timed(spin))
        before = together() / alone
        pin(cores)
        spent = timed(call)
        pin({0, 1})
        after = together()
        if max(before, after / alone) <= quiet:
            times[turn % len(ways)].append(spent)
        turn += 1
    pinned, beside, both = (min(each, default=np.inf) for each in times)
    return pinned, beside, both, min(map(len, times))


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
