"""How much faster rays that jump about are traced for being sorted, against the same rays as they come.

    python tests/benches/bench_order.py MODEL [MODEL ...] [--repeats 9] [--record]

Ambient occlusion from what a camera sees, in an order drawn by chance, and rays from anywhere in any
direction; closest and any hits, through a rebuilt hierarchy, on one core. The two ways take turns; a ratio is
the median of the ratios of runs next to each other in time. A scene small enough to be left alone is sorted
for too. Linux only.
"""

import argparse
import os
import statistics
import sys
import time
from pathlib import Path

import numpy as np
from bench_scaling import bounced
from cores import pin
from results import Row, append

import striptools
from striptools.measure.study import random_rays
from striptools.reducem.scene import Scene
from striptools.trace import Tracer, streams
from striptools.trace.rays import Camera, camera_rays

BENCH = {
    "takes": "paths",
    "models": ["bunny", "dem_jacksboro", "dragon", "dragon_3m5", "powerplant"],
    "full": [[]],
    "quick": [],
}

SIDE = 1024
RANDOM = 2**19
WAYS = {"sorted": 0, "as they come": sys.maxsize}
"""Bytes of a scene for which rays are sorted, by way."""


def main() -> int:
    """Measure each model and print a row for each kind of rays."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--repeats", type=int, default=9)
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    pin({max(os.sched_getaffinity(0))})
    for path in arguments.models:
        scene = striptools.open(path) if path.suffix == ".rdm" else striptools.convert(path)
        tracer = Tracer(scene, device="cpu", threads=1, hierarchy="rebuilt")
        bounce = bounced(
            scene, tracer, *camera_rays(Camera.framing(scene.positions, width=SIDE, height=SIDE))
        )
        shuffled = np.random.default_rng(1).permutation(len(bounce[0]))
        anywhere = random_rays(scene, RANDOM)
        for kind, rays in (
            ("shuffled occlusion rays", tuple(a[shuffled] for a in bounce)),
            ("random rays", (anywhere.origins, anywhere.directions)),
        ):
            for query in ("closest_hit", "any_hit"):
                row = measure(path.stem, scene, tracer, kind, query, rays, arguments.repeats)
                sys.stdout.write(f"{row.mesh}: {row.metric} {row.value:.3g} {row.unit}, ")
                sys.stdout.write(f"as they come {row.peer_value:.3g}, ratio {row.ratio:.3f}\n")
                sys.stdout.flush()
                if arguments.record:
                    append([row])
    return 0


def measure(name: str, scene: Scene, tracer: Tracer, kind: str, query: str, rays: tuple, repeats: int) -> Row:
    """Trace rays both ways by turns; the same must be found."""
    times: dict[str, list[float]] = {way: [] for way in WAYS}
    found = {}
    for turn in range(repeats + 1):
        for way, least in WAYS.items():
            streams.LEAST_SORTED = least
            start = time.perf_counter()
            hits = getattr(tracer, query)(*rays)
            # The first turn compiles.
            times[way] += [time.perf_counter() - start] if turn else []
            found[way] = hits if query == "any_hit" else hits.face
    if not np.array_equal(*found.values()):
        raise SystemExit(f"{name}: {kind}, {query}: other hits where rays are sorted")
    ratio = statistics.median(plain / mine for mine, plain in zip(*times.values(), strict=True))
    count = len(rays[0])
    rate, plain_rate = (count / min(spent) / 1e6 for spent in times.values())
    what = f"{kind}, {query.replace('_', ' ')}, sorted"
    note = f"{count} rays; one core; rebuilt hierarchy; the peer is the same tracer with rays as they come"
    given = "order", name, scene.triangle_count, what
    return Row(*given, rate, "Mray/s", "as they come", plain_rate, ratio, note)


if __name__ == "__main__":
    sys.exit(main())
