"""The surface of a scene where it stands, as pictures need it: of triangles hit, and nothing flattened."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float64, Int32

from striptools.mesh.instances import placed_positions
from striptools.trace.instanced import InstanceNumbers

if TYPE_CHECKING:
    from striptools.reducem.scene import Scene

Triangles = Int32[np.ndarray, " k"]
Colours = Float64[np.ndarray, "k 3"]

MOST_POINTS = 1 << 23
"""Vertices of all instances up to which a picture is framed by each of them; beyond, by their boxes."""

PLAIN = 0.72
"""The base colour, linear, of what has no material."""


@dataclass(frozen=True, eq=False)
class Surface:
    """What the triangles of a scene look like; they are numbered as those of `Scene.placed`.

    Args:
        scene: The scene.
    """

    scene: Scene

    @cached_property
    def _numbers(self) -> InstanceNumbers | None:
        return None if self.scene.instances is None else InstanceNumbers.of(self.scene)

    def _own(self, triangle: Triangles) -> tuple[np.ndarray, np.ndarray | None]:
        """The triangle in file order, and the instance where there are any."""
        numbers = self._numbers
        if numbers is None:
            return triangle, None
        instance = numbers.instance_of(triangle)
        first = self.scene.spans.face_starts.astype(np.int64)[numbers.geometry[instance]]
        return (triangle - numbers.first_triangle[instance] + first).astype(np.int32), instance

    def corners(self, triangle: Triangles) -> Float64[np.ndarray, "k 3 3"]:
        """The corners of triangles where they stand, a row a corner."""
        own, instance = self._own(triangle)
        corners = self.scene.positions[self.scene.faces()[own]].astype(np.float64)
        if instance is None or self.scene.instances is None:
            return corners
        matrix = self.scene.instances.matrix[instance]
        return np.einsum("kij,kcj->kci", matrix[:, :, :3], corners) + matrix[:, None, :, 3]

    def normals(self, triangle: Triangles) -> Float64[np.ndarray, "k 3"]:
        """Unit normals, whichever side they are on."""
        a, b, c = self.corners(triangle).transpose(1, 0, 2)
        size = np.maximum(np.abs(b - a).max(axis=1), np.abs(c - a).max(axis=1))[:, None]
        normals = np.cross((b - a) / size, (c - a) / size)
        return normals / np.linalg.norm(normals, axis=1, keepdims=True)

    def strips(self, triangle: Triangles) -> np.ndarray:
        """Which strip each is in, those of one instance after those of another."""
        own, instance = self._own(triangle)
        strip = np.searchsorted(self.scene.starts, own, side="right") - 1
        return strip if instance is None else strip + instance * (len(self.scene.starts) - 1)

    def colours(self, triangle: Triangles) -> Colours:
        """The base colours of materials, linear; grey where there are none."""
        group = next((one for one in self.scene.attributes if one.name == "group"), None)
        if group is None or not self.scene.materials:
            return np.full((len(triangle), 3), PLAIN)
        colours = np.array([material.base_color[:3] for material in self.scene.materials], np.float64)
        return colours[group.values[self._own(triangle)[0], 0]]

    @cached_property
    def points(self) -> np.ndarray:
        """(k, 3), points that a whole picture has to hold: vertices, or corners of boxes of very many."""
        scene = self.scene
        if scene.instances is None:
            return scene.positions
        spans, instances = scene.spans, scene.instances.placed
        if int(np.diff(spans.vertex_starts).astype(np.int64)[instances.geometry].sum()) <= MOST_POINTS:
            return placed_positions(scene.positions, spans, instances)
        parts = [scene.positions[spans.vertices(g)].astype(np.float64) for g in range(len(spans))]
        sides = np.array([[part.min(axis=0), part.max(axis=0)] for part in parts])[instances.geometry]
        place = (np.arange(8)[:, None] >> np.arange(3)) & 1
        corners = sides[:, place, np.arange(3)]
        matrix = instances.matrix
        return (np.einsum("kij,kcj->kci", matrix[:, :, :3], corners) + matrix[:, None, :, 3]).reshape(-1, 3)

    @cached_property
    def bounds(self) -> Float64[np.ndarray, "2 3"]:
        """The least and the largest coordinates of `points`; zeros where there are none."""
        points = self.points
        if len(points) == 0:
            return np.zeros((2, 3))
        return np.array([points.min(axis=0), points.max(axis=0)], np.float64)
