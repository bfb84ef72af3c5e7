"""All hierarchies give the same hits as the default one: a million rays a model, aimed ones among them.

    python tests/benches/bench_hierarchies.py MODEL [MODEL ...] [--rays 1000000] [--record] [--note TEXT]

MODEL is a mesh or a scene file. Two fifths of the rays are a camera's, the others go from outside exactly at
midpoints of edges and at vertices, a few along axes. A hit is t, face, u and v, bit for bit. Ends with 1
where one differs.
"""

import argparse
import sys
import time
from pathlib import Path

import numpy as np
from results import Row, append

import striptools
from striptools.hierarchies.options import OVER, HierarchyOptions
from striptools.reducem.scene import Scene
from striptools.trace import Tracer
from striptools.trace.rays import Camera, camera_rays

Rays = tuple[np.ndarray, np.ndarray]

BENCH = {
    "takes": "paths",
    "models": ["bunny", "dem_jacksboro", "icub", "chandelier", "tree_japanesemaple", "dragon", "powerplant"],
    "full": [[]],
    "quick": [],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

EYES = 64
"""Points outside that rays are aimed from."""

OTHERS = (
    *(HierarchyOptions("slbvh", over, balance="sah") for over in OVER["slbvh"]),
    HierarchyOptions("slbvh", balance="morton"),
    *(HierarchyOptions("kdtree", over, metric="corrected") for over in OVER["kdtree"]),
    HierarchyOptions("kdtree", metric="plain"),
    *(HierarchyOptions("loose-octree", over) for over in OVER["loose-octree"]),
    HierarchyOptions("presorted", levels=0),
    HierarchyOptions("presorted", levels=10),
)


def main() -> int:
    """Compare on each model, print a row a hierarchy, and fail where a hit differs."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--rays", type=int, default=1_000_000)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--note", default="")
    arguments = parser.parse_args()
    failed = False
    for path in arguments.models:
        scene = striptools.open(path) if path.suffix == ".rdm" else striptools.convert(path)
        rows = measure(path.stem, scene, arguments.rays, arguments.note)
        failed |= any(row.value for row in rows)
        if arguments.record:
            append(rows)
    return int(failed)


def measure(name: str, scene: Scene, count: int, note: str) -> list[Row]:
    """Trace the same rays through the default hierarchy and through each other one."""
    rays = mixed_rays(scene, count)
    wanted = Tracer(scene, device="cpu").closest_hit(*rays, packets=False)
    rows = []
    for options in OTHERS:
        begun = time.perf_counter()
        under = scene.under(options)
        hits = Tracer(under, device="cpu").closest_hit(*rays)
        pairs = ((hits.t, wanted.t), (hits.face, wanted.face), (hits.u, wanted.u), (hits.v, wanted.v))
        different = np.zeros(len(hits.t), np.bool_)
        for one, other in pairs:
            different |= one != other
        metric = f"{options.name} over {options.objects}, hits different from the default's"
        told = "; ".join(filter(None, [f"{len(hits.t)} rays", details(options), note]))
        rows.append(
            Row("hierarchies", name, scene.triangle_count, metric, int(different.sum()), "rays", note=told)
        )
        seconds = time.perf_counter() - begun
        sys.stdout.write(f"{name}: {metric} {rows[-1].value:.0f} ({told}; {seconds:.0f} s)\n")
        sys.stdout.flush()
    return rows


def details(options: HierarchyOptions) -> str:
    """What a hierarchy was built by."""
    known = {"slbvh": options.balance, "kdtree": options.metric, "presorted": f"{options.levels} levels"}
    return known.get(options.name, "")


def mixed_rays(scene: Scene, count: int) -> Rays:
    """Rays of a camera, then rays aimed at midpoints of edges and at vertices."""
    side = int(np.sqrt(0.4 * count))
    camera = camera_rays(Camera.framing(scene.positions, width=side, height=side))
    random = np.random.default_rng(5)
    corners = scene.positions[scene.faces()].astype(np.float64)
    left = count - len(camera[0])
    face, corner = random.integers(len(corners), size=left), random.integers(3, size=left)
    target = corners[face, corner]
    halves = np.arange(left) % 2 == 0
    target[halves] = 0.5 * (target[halves] + corners[face[halves], (corner[halves] + 1) % 3])
    low, high = scene.low.astype(np.float64), scene.high.astype(np.float64)
    way = random.normal(size=(EYES, 3))
    way[:6] = np.concatenate([np.eye(3), -np.eye(3)])
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    eyes = 0.5 * (low + high) + 1.5 * np.linalg.norm(high - low) * way
    origin = eyes[random.integers(EYES, size=left)].astype(np.float32)
    # A tenth goes along an axis, exactly.
    along = np.flatnonzero(np.arange(left) % 10 == 0)
    axis = random.integers(3, size=len(along))
    origin[along] = target[along]
    origin[along, axis] = (low - 0.5 * np.linalg.norm(high - low))[axis]
    aimed = origin, (target - origin).astype(np.float32)
    return tuple(np.concatenate(pair).astype(np.float32) for pair in zip(camera, aimed, strict=True))


if __name__ == "__main__":
    sys.exit(main())
