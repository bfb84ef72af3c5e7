"""Questions about a closed mesh: all hits of rays, points inside, closest points, and a derivative.

python samples/queries.py
"""

import jax
import jax.numpy as jnp
import numpy as np
import trimesh

import striptools
from striptools.trace import Tracer
from striptools.trace.functional import Geometry, closest_hit
from striptools.trace.trimesh_rays import RayMeshIntersector


def main() -> None:
    """Ask what a ball has to tell, where the right answers are known."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    mesh = striptools.Mesh(np.asarray(ball.vertices, np.float32), np.asarray(ball.faces, np.int32))
    tracer = Tracer(striptools.convert(mesh))
    random = np.random.default_rng(0)

    # Rays through the ball go in and out: the distance between is a chord.
    origins = np.column_stack([random.uniform(-0.6, 0.6, (1000, 2)), np.full(1000, -3.0)])
    directions = np.tile([0.0, 0.0, 1.0], (1000, 1))
    hits = tracer.all_hits(origins, directions, k=4)
    chords = 2 * np.sqrt(1 - (origins[:, :2] ** 2).sum(axis=1))
    off = np.abs(hits.t[:, 1] - hits.t[:, 0] - chords).max()
    print(f"hits of a ray: {hits.count.min()} to {hits.count.max()}; chords within {off:.4f}")

    # The distance from the surface, negative inside, is the radius less 1.
    points = random.normal(size=(1000, 3))
    found = tracer.closest_point(points, signed=True)
    radius = np.linalg.norm(points, axis=1)
    print(f"inside: {tracer.contains(points).sum()} of 1000 points, by their radius {(radius < 1).sum()}")
    print(f"signed distances within {np.abs(found.distance - (radius - 1)).max():.4f}")

    # How far rays go before they hit, as a loss, and its derivative by the vertices.
    geometry = Geometry.of(tracer, mesh.faces)

    def depth(positions: jax.Array) -> jax.Array:
        return closest_hit(geometry, positions, origins, directions).t.mean()

    pull = jax.jit(jax.grad(depth))(jnp.asarray(mesh.positions))
    print(f"all vertices moved along the rays by 1: the rays go {pull[:, 2].sum():.3f} farther")

    # A user of trimesh changes one line.
    ball.ray = RayMeshIntersector(ball)
    print(f"through trimesh: {ball.contains(points).sum()} of 1000 points inside")


if __name__ == "__main__":
    main()
