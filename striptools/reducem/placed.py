"""The triangles of a scene with every instance where it stands: what an expanded tracer holds of it.

Instances are one after another, as `mesh.Mesh.flattened` puts those of the source, so that a triangle is
known by the source's own number of its face there.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from striptools.errors import LimitError
from striptools.mesh.instances import Instances, placed_faces, placed_positions
from striptools.mesh.mesh import MOST_FACES
from striptools.mesh.recentre import Origin
from striptools.partition.boxes import face_boxes
from striptools.reducem.scene import Remap, Scene, bounds_of
from striptools.threads import every_core
from striptools.types import Boxes, Counts, Faces, Positions

__all__ = ["Placed", "place_scene"]

SLACK = 1 + 2.0**-20
"""Rounding of what is said of distances."""


@dataclass(frozen=True, eq=False)
class Placed:
    """A scene's triangles where they stand; names as in `Scene`.

    Attributes:
        positions: (q, 3) float32 vertices of all instances in a row.
        triangles: (n, 3) int32, places in `positions`; mirrors have their winding turned.
        starts: (s+1,) int32, the first triangle of each strip, then n.
        instance_starts: (k+1,) int32, the first triangle of each instance, then n.
        remap: The face of the flattened source that each triangle is, and how it is turned; None where the
            scene has no remap.
        error_bound: How far a position may be from that of the flattened source, both rounded to float32.
        source_face_count: Faces of the flattened source, but for any behind the last instance's.
        origin: See `Scene`.
    """

    positions: Positions
    triangles: Faces
    starts: Counts
    instance_starts: Counts
    remap: Remap | None
    error_bound: float
    source_face_count: int
    origin: Origin | None

    @property
    def triangle_count(self) -> int:
        """Triangles of all instances."""
        return len(self.triangles)

    @cached_property
    def low(self) -> np.ndarray:
        """(3,) float32, the least coordinates, -0.0 as 0.0."""
        return bounds_of(self.positions)[0]

    @cached_property
    def high(self) -> np.ndarray:
        """(3,) float32, the largest."""
        return bounds_of(self.positions)[1]

    def faces(self) -> Faces:
        """(n, 3) int32 triangles, instances in their order, those of each in file order."""
        return self.triangles

    def triangle_boxes(self, threads: int | None = None) -> Boxes:
        """The exact box of each triangle, (n, 6) float32."""
        return face_boxes(self.positions, self.triangles, threads or every_core())


def place_scene(scene: Scene) -> Placed:
    """Place the instances of a scene that has some.

    Raises:
        LimitError: Where they have more triangles than a mesh may have.
    """
    assert scene.instances is not None
    if scene.remap is not None and _source_face_count(scene) > 2**31 - 1:
        raise LimitError("the source has more than 2^31 - 1 faces with all instances", remedy="split it")
    spans, instances = scene.spans, scene.instances.placed
    triangles = placed_faces(scene.faces(), spans, instances, MOST_FACES)
    positions = placed_positions(scene.positions, spans, instances)
    counts = np.diff(spans.face_starts)[instances.geometry]
    instance_starts = np.append(np.int32(0), np.cumsum(counts, dtype=np.int32))
    return Placed(
        positions.astype(np.float32),
        triangles,
        _strip_starts(scene, instances, instance_starts),
        instance_starts,
        None if scene.remap is None else _remap(scene, scene.remap, instances),
        _bound(scene.error_bound, positions, instances),
        _source_face_count(scene),
        scene.origin,
    )


def _strip_starts(scene: Scene, instances: Instances, instance_starts: Counts) -> Counts:
    first = scene.spans.face_starts
    strip = np.searchsorted(scene.starts, first)
    parts = [
        scene.starts[strip[geometry] : strip[geometry + 1]] - first[geometry] + at
        for (geometry, _), at in zip(instances, instance_starts[:-1], strict=True)
    ]
    return np.concatenate([*parts, instance_starts[-1:]]).astype(np.int32)


def _remap(scene: Scene, remap: Remap, instances: Instances) -> Remap:
    """The remap of all instances: a mirror runs through the corners the other way round."""
    assert scene.geometries is not None
    assert scene.instances is not None
    offset = scene.instances.first_face.astype(np.int64) - scene.geometries.first_face[instances.geometry]
    face, rotation = [], []
    for (geometry, _), more, mirrored in zip(instances, offset.tolist(), instances.mirrored, strict=True):
        part = scene.spans.faces(geometry)
        face.append((remap.face[part] + more).astype(np.int32))
        turned = (3 - remap.rotation[part]) % 3 if mirrored else remap.rotation[part]
        rotation.append(turned.astype(np.uint8))
    return Remap(np.concatenate(face), np.concatenate(rotation))


def _bound(error_bound: float, positions: np.ndarray, instances: Instances) -> float:
    """How far placed positions may be off: by the longest stretch, and by the rounding of both sides."""
    if error_bound == 0.0:
        return 0.0
    rounding = math.sqrt(3.0) * float(np.abs(positions).max(initial=0.0)) * 2.0**-23
    return (error_bound * instances.stretch + rounding) * SLACK


def _source_face_count(scene: Scene) -> int:
    assert scene.geometries is not None
    assert scene.instances is not None
    ends = scene.instances.first_face + scene.geometries.face_count[scene.instances.geometry]
    return int(ends.max())
