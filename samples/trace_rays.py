"""Rays of your own through a scene: closest hits, any hits, and the way back to the source's faces.

python samples/trace_rays.py [MODEL]
"""

import sys
from pathlib import Path

import numpy as np

import striptools
from striptools.trace import Tracer

HERE = Path(__file__).parent


def main(model: Path = HERE / "chandelier.ply") -> None:
    """Trace a grid of rays through a model and print what they met."""
    mesh = striptools.load_mesh(model)
    tracer = Tracer(striptools.convert(mesh))

    # A grid of parallel rays that look down the last axis, from outside the model.
    lowest, highest = mesh.bounds
    x, y = np.meshgrid(np.linspace(lowest[0], highest[0], 64), np.linspace(lowest[1], highest[1], 64))
    above = np.full(x.size, highest[2] + 1.0)
    origins = np.stack([x.ravel(), y.ravel(), above], axis=1).astype(np.float32)
    directions = np.broadcast_to(np.array([0.0, 0.0, -1.0], np.float32), origins.shape)

    hits = tracer.closest_hit(origins, directions)
    hit = hits.face >= 0
    print(f"{hit.sum():,} of {len(origins):,} rays hit; the nearest at t = {hits.t.min():.4f}")

    # u and v weigh the second and third corner of the source's own face.
    corners = mesh.positions[mesh.faces[hits.face[hit]]].astype(np.float64)
    u, v = hits.u[hit, None].astype(np.float64), hits.v[hit, None].astype(np.float64)
    points = (1 - u - v) * corners[:, 0] + u * corners[:, 1] + v * corners[:, 2]
    reached = origins[hit] + hits.t[hit, None] * directions[hit]
    print(f"largest distance between the two ways to the hit points: {np.abs(points - reached).max():.2e}")

    # From just above each hit point back up: is anything in the way?
    points[:, 2] += 1e-3 * (highest[2] - lowest[2])
    lifted = points.astype(np.float32)
    shaded = tracer.any_hit(lifted, -directions[hit])
    print(f"{shaded.sum():,} of {hit.sum():,} hit points are covered from above")


if __name__ == "__main__":
    main(*(Path(argument) for argument in sys.argv[1:2]))
