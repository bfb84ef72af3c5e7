"""Ray queries with trimesh's interface, so that its users can switch by one line.

    mesh.ray = striptools.trace.trimesh_rays.RayMeshIntersector(mesh)

Names, arguments, shapes and dtypes are those of `trimesh.ray.ray_pyembree.RayMeshIntersector` (trimesh 5).
Which faces are met is the tracer's float32 answer; where on their planes the rays meet them is then computed
in float64 from the mesh's own vertices.

What differs from trimesh:

1. Hits come sorted by ray and then by distance, always the same; trimesh's come by depth or in no order.
2. A ray through an edge or a corner is one hit there, on the face of the least index. (In trimesh that is so
   with Embree; its own ray tracer lists each face unless locations are asked for.)
3. An origin on the surface, to within `ON_SURFACE` of the mesh's size, meets it at distance 0.
4. `contains_points` decides by `Tracer.contains`, by parity, from one ray a point and without chance.
"""

from typing import Any

import numpy as np
from jaxtyping import Bool, Float64, Int64

from striptools.errors import UnreadableMeshError, UsageError
from striptools.mesh.mesh import Mesh
from striptools.pipeline import convert
from striptools.trace.gathering import MOST_HITS
from striptools.trace.tracer import Tracer

ON_SURFACE = 1e-9
"""Distance behind the origin at which a hit still counts, in the mesh's size (rounding in float64)."""

SAME_PLACE = 1e-8
"""Distance along the ray at which two hits are one, in the mesh's size."""

BACK = 2.0**-21
"""How far rays start behind their origins, in the largest coordinate: what rounding to float32 may move."""

EDGE_ON = 1e-12
"""Sine of the angle between ray and face below which the plane does not tell where they meet."""


class ArgumentError(UsageError, ValueError):
    """Arguments that do not fit together; also a ValueError, which is what trimesh raises."""


class RayMeshIntersector:
    """Answers ray queries about a trimesh mesh, by a tracer made at the first query and after each change.

    Args:
        geometry: A `trimesh.Trimesh`, or any object with `vertices` (v, 3), `faces` (n, 3) and a hash that
            changes with them.
        scale_to_box: Taken and not needed: the tracer scales by a power of two.
        options: For `Tracer`: device, threads, resident and so on.
    """

    def __init__(self, geometry: Any, scale_to_box: bool = True, **options: Any) -> None:
        self.mesh = geometry
        self._scale_to_box = scale_to_box
        self._options = options
        self._made: tuple[int, Tracer | None] | None = None

    @property
    def tracer(self) -> Tracer | None:
        """The tracer of the mesh as it is now; None where no face can be hit."""
        key = hash(self.mesh)
        if self._made is None or self._made[0] != key:
            self._made = (key, self._new_tracer())
        return self._made[1]

    def _new_tracer(self) -> Tracer | None:
        positions = np.array(self.mesh.vertices, np.float64)
        faces = np.array(self.mesh.faces, np.int32)
        if not len(faces):
            return None
        try:
            return Tracer(convert(Mesh(positions.reshape(-1, 3), faces.reshape(-1, 3))), **self._options)
        except UnreadableMeshError:
            # Cleaning leaves no face: none has an area.
            return None

    def intersects_location(
        self, ray_origins: Any, ray_directions: Any, multiple_hits: bool = True, **options: Any
    ) -> tuple[Float64[np.ndarray, "m 3"], Int64[np.ndarray, " m"], Int64[np.ndarray, " m"]]:
        """Where rays meet the mesh.

        Args:
            ray_origins: (r, 3).
            ray_directions: (r, 3).
            multiple_hits: Every place on the way, not the first alone.
            options: `max_hits` of `intersects_id`.

        Returns:
            locations: (m, 3) float64.
            index_ray: (m,) int64.
            index_tri: (m,) int64.

        Raises:
            ArgumentError: Origins and directions are not of one shape (r, 3).
        """
        face, ray, places = self._hits(ray_origins, ray_directions, multiple_hits, **options)
        return places, ray, face

    def intersects_id(
        self,
        ray_origins: Any,
        ray_directions: Any,
        multiple_hits: bool = True,
        max_hits: int = 100,
        return_locations: bool = False,
    ) -> tuple[np.ndarray, ...]:
        """Which faces rays meet.

        Args:
            ray_origins: (r, 3).
            ray_directions: (r, 3).
            multiple_hits: Every face on the way, not the first alone.
            max_hits: The most of one ray.
            return_locations: Say where, too.

        Returns:
            index_tri: (m,) int64.
            index_ray: (m,) int64.
            locations: (m, 3) float64, if asked for.

        Raises:
            ArgumentError: Origins and directions are not of one shape (r, 3).
        """
        found = self._hits(ray_origins, ray_directions, multiple_hits, max_hits)
        return found if return_locations else found[:2]

    def intersects_first(self, ray_origins: Any, ray_directions: Any) -> Int64[np.ndarray, " r"]:
        """The face that each ray meets first, -1 for none; errors as for `intersects_id`."""
        first = np.full(len(np.asarray(ray_origins)), -1, np.int64)
        face, ray, _ = self._hits(ray_origins, ray_directions, multiple_hits=False)
        first[ray] = face
        return first

    def intersects_any(self, ray_origins: Any, ray_directions: Any) -> Bool[np.ndarray, " r"]:
        """Whether each ray meets the mesh; errors as for `intersects_id`."""
        return self.intersects_first(ray_origins, ray_directions) >= 0

    def contains_points(self, points: Any) -> Bool[np.ndarray, " r"]:
        """Whether each point, (r, 3), is inside the mesh, which has to be closed.

        Raises:
            ArgumentError: The points are not of this shape.
        """
        given = np.asarray(points, np.float64)
        if given.ndim != 2 or given.shape[1] != 3:
            raise ArgumentError(f"of shape {given.shape}", where="points", remedy="give (points, 3)")
        tracer = self.tracer
        if tracer is None:
            return np.zeros(len(given), np.bool_)
        return tracer.contains(given - tracer.origin)

    def _hits(
        self, ray_origins: Any, ray_directions: Any, multiple_hits: bool, max_hits: int = 100
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Faces, rays and places, sorted by ray and distance."""
        origins, directions = _rays(ray_origins, ray_directions)
        tracer = self.tracer
        if tracer is None or not len(origins):
            return np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, 3))
        wanted = max(int(max_hits), 0) if multiple_hits else 1
        ray, face, t = _one_a_place(*self._met(tracer, origins, directions, multiple_hits), self._same_place)
        keep = _rank(ray) < wanted
        ray, face, t = ray[keep], face[keep], t[keep]
        return face, ray, origins[ray] + t[:, None] * directions[ray]

    @property
    def _same_place(self) -> float:
        return SAME_PLACE * self._size

    @property
    def _size(self) -> float:
        """The diagonal of the mesh's box."""
        return float(np.linalg.norm(np.ptp(np.asarray(self.mesh.vertices, np.float64), axis=0)))

    def _met(
        self, tracer: Tracer, origins: np.ndarray, directions: np.ndarray, every: bool
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Rays, faces and distances of hits not behind the origins, sorted by ray, distance and face."""
        near = origins - tracer.origin
        # From far away, start before the sphere around the mesh: float32 then rounds less.
        centre = np.mean(self.mesh.bounds, axis=0) - tracer.origin
        ahead_of = ((centre - near) * directions).sum(axis=1) - self._size
        reach = np.abs(np.asarray(self.mesh.bounds) - tracer.origin).max()
        forward = np.where(ahead_of > 0, ahead_of, 0.0)
        starts = near + forward[:, None] * directions
        forward = forward - BACK * np.maximum(np.abs(starts).max(axis=1), reach)
        starts = near + forward[:, None] * directions
        parts = []
        left = np.arange(len(origins))
        k = 4 if every else 1
        while len(left):
            # Ask for twice as many hits of the rays that may have more.
            hits = tracer.all_hits(starts[left], directions[left], k=k)
            row, column = np.nonzero(hits.face >= 0)
            ray, face = left[row], hits.face[row, column].astype(np.int64)
            t = self._distances(origins[ray], directions[ray], face, forward[ray] + hits.t[row, column])
            ahead = t >= -ON_SURFACE * self._size
            has_first = np.bincount(row[ahead], minlength=len(left)) > 0
            more = (hits.count == k) & (k < MOST_HITS) & (every | ~has_first)
            done = ahead & ~more[row]
            parts.append((ray[done], face[done], np.maximum(t[done], 0.0)))
            left = left[more]
            k = min(4 * k, MOST_HITS)
        ray, face, t = (np.concatenate(columns) for columns in zip(*parts, strict=True))
        order = np.lexsort((face, t, ray))
        return ray[order], face[order], t[order]

    def _distances(
        self, origins: np.ndarray, directions: np.ndarray, face: np.ndarray, guess: np.ndarray
    ) -> np.ndarray:
        """Where rays meet the planes of faces, in float64; the guess, where they run along them."""
        corners = np.asarray(self.mesh.vertices, np.float64)[np.asarray(self.mesh.faces)[face]]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        slope = (normal * directions).sum(axis=1)
        height = (normal * (corners[:, 0] - origins)).sum(axis=1)
        steep = np.abs(slope) > EDGE_ON * np.linalg.norm(normal, axis=1)
        return np.where(steep, height / np.where(steep, slope, 1.0), guess)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_made": None}

    def __copy__(self) -> "RayMeshIntersector":
        return RayMeshIntersector(self.mesh, self._scale_to_box, **self._options)

    def __deepcopy__(self, memo: Any) -> "RayMeshIntersector":
        return self.__copy__()


def _rays(ray_origins: Any, ray_directions: Any) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions in float64."""
    origins, directions = np.asarray(ray_origins, np.float64), np.asarray(ray_directions, np.float64)
    if origins.shape != directions.shape:
        raise ArgumentError(
            f"origins of shape {origins.shape} for directions of shape {directions.shape}",
            remedy="give one of each per ray",
        )
    if origins.ndim != 2 or origins.shape[1] != 3:
        raise ArgumentError(f"of shape {origins.shape}", where="rays", remedy="give (rays, 3)")
    length = np.linalg.norm(directions, axis=1, keepdims=True)
    return origins, directions / np.where(length > 0, length, 1.0)


def _one_a_place(
    ray: np.ndarray, face: np.ndarray, t: np.ndarray, least: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of sorted hits of a ray that follow each other within `least`, the first t and the least face."""
    if not len(ray):
        return ray, face, t
    new = np.ones(len(ray), np.bool_)
    new[1:] = (ray[1:] != ray[:-1]) | (t[1:] - t[:-1] > least)
    first = np.flatnonzero(new)
    return ray[first], np.minimum.reduceat(face, first), t[first]


def _rank(ray: np.ndarray) -> np.ndarray:
    """How many entries of its ray come before each of sorted ones."""
    return np.arange(len(ray)) - np.searchsorted(ray, ray)
