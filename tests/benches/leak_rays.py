"""Rays of the leak table: runs of them, each from one place, at edges or vertices that lie side by side.

32 targets that follow each other in the order of the scene make a run, and its rays are a packet where they
come from one place or go along one axis. What is certain of a ray is `striptools.measure.aimed`'s: by the
faces at its target, and from inside a closed surface by there being a way out. After rounding to float32
faces collapse and vertices meet; a surface is closed where each edge is run as often one way as the other, so
that the number of times that it winds round a point is defined.
"""

from dataclasses import dataclass

import numpy as np

from striptools.measure.aimed import Fans, Surface, judge_fans
from striptools.measure.bound import frame_rays
from striptools.measure.oracle import Oracle
from striptools.measure.ray_sets import camera_set, find_inside
from striptools.mesh.clean import clean
from striptools.mesh.mesh import Mesh
from striptools.trace.rays import to_float32

RUN = 32
PLACES_ROUND = 64
SEARCH = 96
"""Camera rays among whose hits places inside are looked for."""

OFFSET_WAY = np.array([2.0, -3.0, 6.0]) / 7
"""Where a model is moved to: a direction that no axis shares."""


@dataclass(frozen=True)
class Place:
    """Where a model stands: scaled, and moved by so many of its diagonals."""

    scale: float = 1.0
    offset: float = 0.0

    def __str__(self) -> str:
        """What the table calls it."""
        return f"scale {self.scale:g}, offset {self.offset:g}"

    def matrix(self, mesh: Mesh) -> np.ndarray:
        """(3, 4) float64 that puts a mesh there."""
        diagonal = float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0])) * self.scale
        away = OFFSET_WAY * (self.offset * diagonal)
        return np.concatenate([np.eye(3) * self.scale, away[:, None]], axis=1)

    def put(self, mesh: Mesh) -> Mesh:
        """The mesh there, rounded to float32."""
        matrix = self.matrix(mesh)
        moved = np.asarray(mesh.positions, np.float64) * self.scale + matrix[:, 3]
        return Mesh(moved.astype(np.float32), mesh.faces)


class Target:
    """A mesh that rays are aimed at.

    Args:
        mesh: In float32.
        order: (n,) int32, faces of the mesh in an order that keeps near ones together.

    Attributes:
        surface: Of its faces that cleaning keeps.
        kept: Which faces of the mesh these are.
        closed: Whether the surface is.
        inside: (k, 3) float32 places that it winds round, none where it is not closed.
    """

    def __init__(self, mesh: Mesh, order: np.ndarray) -> None:
        self.mesh = mesh
        self.kept = clean(mesh).source_face
        self.surface = Surface(mesh.positions, mesh.faces[self.kept])
        self.closed = is_closed(self.surface.faces)
        rank = np.zeros(mesh.triangle_count, np.int32)
        rank[order] = np.arange(len(order), dtype=np.int32)
        rank = rank[self.kept]
        surface, every = self.surface, np.arange(len(self.surface.vertices))
        self._edges = surface.edges[np.argsort(rank[surface.edges // 3], kind="stable")]
        self._vertices = every[np.argsort(rank[surface.corner_at(every) // 3], kind="stable")]
        used = surface.positions[surface.vertices].astype(np.float64)
        self.bounds = np.stack([used.min(axis=0), used.max(axis=0)])
        self.diagonal = float(np.linalg.norm(self.bounds[1] - self.bounds[0]))
        self.inside = self._find_inside() if self.closed else np.zeros((0, 3), np.float32)

    def _find_inside(self) -> np.ndarray:
        oracle = Oracle(self.mesh)
        camera = camera_set(self.bounds, SEARCH, np.random.default_rng(1))
        return find_inside(oracle, camera, oracle.closest_hit(camera.origins, camera.directions))

    def edges(self, runs: int, random: np.random.Generator) -> "Aims":
        """Runs of edge midpoints."""
        edges = _runs(self._edges, runs, random)
        surface = self.surface
        return Aims(surface.edge_midpoints(edges), surface.normals_at(edges), surface.edge_fans(edges))

    def vertices(self, runs: int, random: np.random.Generator) -> "Aims":
        """Runs of vertices."""
        places = _runs(self._vertices, runs, random)
        surface = self.surface
        at = surface.positions[surface.vertices[places]].astype(np.float64)
        return Aims(at, surface.normals_at(surface.corner_at(places)), surface.vertex_fans(places))


def _runs(targets: np.ndarray, runs: int, random: np.random.Generator) -> np.ndarray:
    first = random.integers(0, max(1, len(targets) - RUN + 1), runs)
    return targets[(first[:, None] + np.arange(RUN)).reshape(-1) % len(targets)]


def is_closed(faces: np.ndarray) -> bool:
    """Whether every edge is run as often one way as the other."""
    start = faces.reshape(-1).astype(np.int64)
    end = np.roll(faces, -1, axis=1).reshape(-1).astype(np.int64)
    key = np.minimum(start, end) * (int(faces.max(initial=0)) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    return len(faces) > 0 and not np.add.reduceat(np.sign(end - start)[order], first).any()


@dataclass(frozen=True)
class Aims:
    """What rays are aimed at: points and unit normals there, (r, 3) float64, and the faces round them."""

    points: np.ndarray
    normals: np.ndarray
    fans: Fans


@dataclass(frozen=True)
class Rays:
    """Rays of the table.

    Attributes:
        origins: (r, 3) float32.
        directions: (r, 3) float32, not of unit length.
        fans: The faces round each one's target.
        enclosed: (r,) bool, which start inside a closed surface.
    """

    origins: np.ndarray
    directions: np.ndarray
    fans: Fans
    enclosed: np.ndarray

    def __len__(self) -> int:
        return len(self.origins)

    def part(self, count: int) -> "Rays":
        """The first ones."""
        rays = slice(count)
        return Rays(
            self.origins[rays], self.directions[rays], self.fans.part(0, min(count, len(self))),
            self.enclosed[rays],
        )  # fmt: skip


def from_outside(target: Target, aims: Aims, random: np.random.Generator) -> Rays:
    """Half of the runs from places round the model, a quarter from near each target, a quarter along axes."""
    diagonal, kind = target.diagonal, _kind_of_run(aims)
    way = _unit(random.normal(size=(PLACES_ROUND, 3)))
    around = target.bounds.mean(axis=0) + diagonal * way * random.uniform(0.8, 3, (PLACES_ROUND, 1))
    origins = np.repeat(around[random.integers(0, PLACES_ROUND, len(kind) // RUN)], RUN, axis=0)
    slanted = _unit(aims.normals + _unit(random.normal(size=aims.normals.shape)) * 0.94)
    near = aims.points + slanted * diagonal * 10 ** random.uniform(-4, -0.5, (len(kind), 1))
    origins = to_float32(np.where((kind == 1)[:, None], near, origins))
    none = np.zeros(len(kind), np.bool_)
    rays = Rays(origins, _towards(aims.points, origins), aims.fans, none)
    return _along_axes(rays, aims, kind == 2, np.full(len(kind), 1.5 * diagonal), random)


def from_inside(target: Target, aims: Aims, random: np.random.Generator) -> Rays:
    """Three quarters of the runs from places inside, a quarter along axes from behind each target."""
    kind = _kind_of_run(aims)
    chosen = random.integers(0, len(target.inside), len(kind) // RUN)
    origins = np.repeat(target.inside[chosen], RUN, axis=0)
    rays = Rays(origins, _towards(aims.points, origins), aims.fans, kind != 2)
    reach = target.diagonal * 10 ** random.uniform(-3, -0.5, len(kind))
    return _along_axes(rays, aims, kind == 2, -reach, random)


def _kind_of_run(aims: Aims) -> np.ndarray:
    return np.arange(len(aims.points)) // RUN % 4


def _along_axes(
    rays: Rays, aims: Aims, which: np.ndarray, reach: np.ndarray, random: np.random.Generator
) -> Rays:
    """Some of the rays parallel to an axis, one for a run, from so far on the side of the first's normal."""
    rows = np.flatnonzero(which)
    if len(rows) == 0:
        return rays
    axis = np.repeat(random.integers(0, 3, len(rows) // RUN), RUN)
    side = np.where(aims.normals[rows[::RUN], axis[::RUN]] < 0, -1.0, 1.0).repeat(RUN)
    origins, directions = rays.origins.copy(), rays.directions.copy()
    origins[rows] = to_float32(aims.points[rows])
    origins[rows, axis] = to_float32(aims.points[rows, axis] + side * reach[rows])
    directions[rows] = 0
    directions[rows, axis] = -np.sign(side * reach[rows])
    return Rays(origins, directions, rays.fans, rays.enclosed)


def _towards(points: np.ndarray, origins: np.ndarray) -> np.ndarray:
    return to_float32(points - origins.astype(np.float64))


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)


@dataclass(frozen=True)
class Verdict:
    """What rays must do, (r,) each.

    Attributes:
        certain: Whether it must hit at its target at the latest.
        enclosed: Whether it must hit something.
        farthest: The largest t allowed, infinite where not certain.
    """

    certain: np.ndarray
    enclosed: np.ndarray
    farthest: np.ndarray

    def part(self, count: int) -> "Verdict":
        """Of the first ones."""
        return Verdict(self.certain[:count], self.enclosed[:count], self.farthest[:count])

    @property
    def sure(self) -> np.ndarray:
        """(r,) bool: rays that could leak."""
        return self.certain | self.enclosed

    @property
    def t_max(self) -> np.ndarray:
        """(r,) float32: any hit nearer than this will do."""
        with np.errstate(over="ignore"):
            rounded = self.farthest.astype(np.float32)
        return np.nextafter(np.nextafter(rounded, np.float32(np.inf)), np.float32(np.inf))

    def leaks(self, t: np.ndarray, slack: np.ndarray | float = 0.0) -> np.ndarray:
        """(r,) bool: rays that slip through, by the t reported, infinite on a miss."""
        t = t.astype(np.float64)
        beyond = self.certain & ~(t <= self.farthest + slack)
        return beyond | (self.enclosed & ~np.isfinite(t))


def judge(surface: Surface, rays: Rays) -> Verdict:
    """What rays must do."""
    found = judge_fans(frame_rays(rays.origins, rays.directions), surface, rays.fans)
    return Verdict(found.certain, rays.enclosed, found.farthest)
