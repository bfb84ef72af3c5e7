"""The closest point of the surface: points in, what is closest out, weighed in float64."""

from functools import lru_cache, partial
from typing import Any

import numpy as np
from jax.sharding import Mesh
from jaxtyping import Float32

from striptools.trace.gathering import check_ended
from striptools.trace.hit import ClosestPoints
from striptools.trace.instanced import InstancedLayout
from striptools.trace.launch import GPU_TILES, TILES, split_over, stream_through
from striptools.trace.layout import Layout
from striptools.trace.walk import MISS
from striptools.trace.walk_points import FARTHEST, PointOptions, closest_triangles
from striptools.trace.walk_points_instances import walk_point as walk_point_among_instances

POINTS_AT_ONCE = 1 << 16


@lru_cache(maxsize=16)
def program(mesh: Mesh, options: PointOptions, shared: bool = False) -> Any:
    """The jitted function from a scene and points to `walk_points.Closest`, the points over the devices.

    To `walk_points_instances.ClosestInstance` where geometries are shared by instances.
    """
    walk_one = walk_point_among_instances if shared else None
    return split_over(mesh, partial(closest_triangles, options=options, walk_one=walk_one), 1)


def nothing_closest(count: int) -> ClosestPoints:
    """What is closest to points where there is nothing."""
    return ClosestPoints(
        np.full((count, 3), np.nan, np.float32),
        np.full(count, np.inf, np.float32),
        np.full(count, MISS),
        np.zeros(count, np.float32),
        np.zeros(count, np.float32),
        np.full(count, MISS),
    )


def closest_points(
    scene: Any, layout: Layout, points: Float32[np.ndarray, "r 3"], mesh: Mesh, options: PointOptions
) -> ClosestPoints:
    """What is closest to each point.

    Raises:
        StriptoolsError: A walk did not end.
    """
    found = nothing_closest(len(points))
    scale = layout.arrays.frame.scale
    with np.errstate(over="ignore", invalid="ignore"):
        scaled = points * scale
        known = np.abs(scaled).max(axis=1, initial=0) <= FARTHEST
    ready = np.concatenate([np.where(known[:, None], scaled, 0), known[:, None]], axis=1, dtype=np.float32)
    sizes = GPU_TILES if options.batch else TILES
    shared = isinstance(layout, InstancedLayout)
    for part, traced in stream_through(program(mesh, options, shared), scene, (ready,), mesh, sizes):
        check_ended(traced[0])
        for first in range(0, part.stop - part.start, POINTS_AT_ONCE):
            chosen = slice(first, min(first + POINTS_AT_ONCE, part.stop - part.start))
            there = slice(part.start + chosen.start, part.start + chosen.stop)
            _weigh(layout, points, there, tuple(column[chosen] for column in traced), found)
    return found


def _weigh(
    layout: Layout,
    points: np.ndarray,
    part: slice,
    closest: tuple[np.ndarray, ...],
    found: ClosestPoints,
) -> None:
    """Say where on their triangles the closest points are: of names, and instances if there are any."""
    met = np.flatnonzero(closest[0] >= 0)
    at = met + part.start
    named = [column[met] for column in closest]
    face, triangle, _ = layout.named(*named)
    corners, turn = layout.corners_of(*named)
    triangles = corners.astype(np.float64).swapaxes(1, 2) / float(layout.arrays.frame.scale)
    # Corner j as the tests have it is the face's corner (j + turn) % 3; of two as close its first is taken.
    of_face = (np.arange(3) - turn[:, None]) % 3
    triangles = np.take_along_axis(triangles, of_face[..., None], axis=1)
    weights = closest_weights(triangles, points[at].astype(np.float64))
    place = (weights[..., None] * triangles).sum(axis=1)
    found.point[at] = place
    found.distance[at] = np.linalg.norm(place - points[at], axis=1)
    found.face[at], found.triangle[at] = face, triangle
    found.u[at], found.v[at] = weights[:, 1], weights[:, 2]


def closest_weights(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """The weights of corners, (n, 3), of the point of each triangle (n, 3, 3) closest to a point (n, 3).

    The best of the closest points of the three sides and, where it is inside, of the foot, in float64.
    """
    seen = triangles - points[:, None]
    chosen = np.zeros((len(points), 3))
    least = np.full(len(points), np.inf)
    for weights, valid in _candidates(seen):
        square = ((weights[..., None] * seen).sum(axis=1) ** 2).sum(axis=1)
        better = valid & (square < least)
        chosen[better], least[better] = weights[better], square[better]
    return chosen


def _candidates(seen: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Weights and whether they are there, of each side and of the foot."""
    found = []
    for j in range(3):
        start, way = seen[:, j], seen[:, (j + 1) % 3] - seen[:, j]
        length = (way * way).sum(axis=1)
        share = np.clip(-(start * way).sum(axis=1) / np.where(length > 0, length, 1.0), 0.0, 1.0)
        weights = np.zeros((len(seen), 3))
        weights[:, j], weights[:, (j + 1) % 3] = 1.0 - share, share
        found.append((weights, np.ones(len(seen), np.bool_)))
    normal = np.cross(seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0])
    areas = np.stack(
        [(np.cross(seen[:, (j + 1) % 3], seen[:, (j + 2) % 3]) * normal).sum(axis=1) for j in range(3)],
        axis=1,
    )
    whole = areas.sum(axis=1)
    inside = (areas >= 0).all(axis=1) & (whole > 0)
    found.append((areas / np.where(inside, whole, 1.0)[:, None], inside))
    return found
