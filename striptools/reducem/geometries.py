"""Geometries and instances of a scene: their records, their rules, and the triangles where they stand.

The layout and its reasons are in formats/reducem/SPEC.md, sections 4.10 and 4.11. A scene without them is one
geometry that stands where it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt32

from striptools.hierarchies.packed import Roots
from striptools.mesh.instances import FARTHEST, Instances, Matrices, determinant_signs, reach
from striptools.reducem import layout
from striptools.reducem.issues import unreadable
from striptools.types import Counts, Words

__all__ = ["SceneGeometries", "SceneInstances", "check_geometries", "check_instance_rules", "roots_of"]


GeometryRows = UInt32[np.ndarray, "g 4"]


@dataclass(frozen=True, eq=False)
class SceneGeometries:
    """The geometries of a scene.

    Attributes:
        rows: (g, 4) uint32: the first block of each, its first node over blocks, its first source face, and
            how many source faces it has.
    """

    rows: GeometryRows

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def first_face(self) -> np.ndarray:
        """(g,) int64, the first source face of each."""
        return self.rows[:, 2].astype(np.int64)

    @property
    def face_count(self) -> np.ndarray:
        """(g,) int64, how many source faces each has."""
        return self.rows[:, 3].astype(np.int64)


@dataclass(frozen=True, eq=False)
class SceneInstances:
    """The instances of a scene, as a file has them.

    Attributes:
        geometry: (k,) uint32, which geometry each is.
        first_face: (k,) uint32, the number that its geometry's first source face has among the faces of all
            instances of the source.
        matrix: (k, 3, 4) float64, see `mesh.instances.Instances`.
    """

    geometry: Words
    first_face: Words
    matrix: Matrices

    def __len__(self) -> int:
        return len(self.geometry)

    @property
    def placed(self) -> Instances:
        """Where the geometries stand."""
        return Instances(self.geometry.astype(np.int32), self.matrix)


def roots_of(geometries: SceneGeometries | None, blocks: int, tops: int) -> Roots:
    """Which blocks and nodes over blocks each geometry has; all are one where there are none."""
    rows = np.zeros((1, 4), np.uint32) if geometries is None else geometries.rows
    return Roots(np.append(rows[:, 0].astype(np.int64), blocks), np.append(rows[:, 1].astype(np.int64), tops))


def encode_geometries(geometries: SceneGeometries | None) -> bytes:
    """The section of the geometries; no bytes where there are none."""
    return b"" if geometries is None else geometries.rows.astype("<u4").tobytes()


def encode_instances(instances: SceneInstances | None) -> bytes:
    """The section of the instances; no bytes where there are none."""
    if instances is None:
        return b""
    records = np.zeros(len(instances), layout.INSTANCE.dtype)
    records["geometry"], records["first_face"] = instances.geometry, instances.first_face
    records["matrix"] = instances.matrix.reshape(-1, 12)
    return records.tobytes()


def decode_geometries(raw: np.ndarray) -> SceneGeometries:
    """The geometries of a section of whole records."""
    return SceneGeometries(np.frombuffer(raw.tobytes(), "<u4").astype(np.uint32).reshape(-1, 4))


def decode_instances(raw: np.ndarray) -> SceneInstances:
    """The instances of a section of whole records."""
    records = np.frombuffer(raw.tobytes(), layout.INSTANCE.dtype)
    return SceneInstances(
        records["geometry"].astype(np.uint32),
        records["first_face"].astype(np.uint32),
        np.ascontiguousarray(records["matrix"], np.float64).reshape(-1, 3, 4),
    )


def check_geometries(
    geometries: SceneGeometries, roots: Roots, block_starts: Counts, source_face_count: int, where: str
) -> None:
    """Make sure that geometries share out blocks, nodes over blocks and source faces.

    Args:
        geometries: The geometries.
        roots: Theirs, of `roots_of`.
        block_starts: (b+1,) int32, the first triangle of each block, then n.
        source_face_count: Faces of the source.
        where: What the error names as its place.

    Raises:
        UnreadableSceneError: They do not.
    """
    blocks, tops = np.diff(roots.blocks), np.diff(roots.tops)
    right = (blocks > 0) & (tops >= 0) & ((tops > 0) == (blocks > 1))
    if roots.blocks[0] != 0 or roots.tops[0] != 0 or not right.all():
        raise unreadable("RDM541", f"{where}: GEOM")
    triangles = np.diff(block_starts[roots.blocks])
    first, count = geometries.first_face, geometries.face_count
    ends = np.append(first[1:], source_face_count)
    if (first + count > ends).any() or (count < triangles).any():
        raise unreadable("RDM542", f"{where}: GEOM")


def check_faces(
    geometries: SceneGeometries, roots: Roots, block_starts: Counts, face: np.ndarray, where: str
) -> None:
    """Make sure that the triangles of each geometry come from its own source faces.

    Raises:
        UnreadableSceneError: One does not.
    """
    owner = np.repeat(np.arange(len(geometries)), np.diff(block_starts[roots.blocks]))
    own = face.astype(np.int64) - geometries.first_face[owner]
    wrong = np.flatnonzero((own < 0) | (own >= geometries.face_count[owner]))
    if len(wrong):
        raise unreadable("RDM543", f"{where}: RMAP: triangle {wrong[0]}")


def check_instance_rules(
    instances: SceneInstances, geometries: SceneGeometries, low: np.ndarray, high: np.ndarray, where: str
) -> None:
    """Make sure that instances place each geometry, by sound matrices, within reach, their faces in order.

    Args:
        instances: The instances.
        geometries: What they place.
        low: (3,) float32, the scene's least coordinates.
        high: (3,) float32, its largest.
        where: What the error names as its place.

    Raises:
        UnreadableSceneError: They do not.
    """
    place = f"{where}: INST"
    used = np.unique(instances.geometry)
    if len(used) == 0 or used[-1] >= len(geometries) or len(used) < len(geometries):
        raise unreadable("RDM551", place)
    finite = np.array(np.isfinite(instances.matrix).all(axis=(1, 2)))
    sound = finite.copy()
    sound[finite] = determinant_signs(instances.matrix[finite]) != 0
    if not sound.all():
        raise unreadable("RDM552", f"{place}: instance {np.flatnonzero(~sound)[0]}")
    far = np.flatnonzero(~(reach(instances.matrix, low, high) <= FARTHEST))
    if len(far):
        raise unreadable("RDM553", f"{place}: instance {far[0]}")
    ends = instances.first_face.astype(np.int64) + geometries.face_count[instances.geometry]
    limits = np.append(instances.first_face[1:].astype(np.int64), layout.SOURCE_FACE_LIMIT)
    late = np.flatnonzero(ends > limits)
    if len(late):
        raise unreadable("RDM554", f"{place}: instance {late[0]}")
