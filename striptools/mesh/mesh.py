"""The mesh as loaded: positions, triangles and what loading had to do to them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from striptools.errors import LimitError, UsageError
from striptools.mesh.attributes import NAMES, Attribute, Material, check_attributes
from striptools.mesh.instances import (
    Geometries,
    Instances,
    check_instances,
    placed_attributes,
    placed_faces,
    placed_positions,
)
from striptools.types import Faces, SourcePositions

if TYPE_CHECKING:
    import networkx

MOST_FACES = (2**31 - 1) // 3
"""The most faces a mesh may have: half-edges, three a face, are numbered in int32."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh: an indexed list of triangles, in the order and winding of its source.

    Args:
        positions: `(v, 3)` float32 or float64, the vertices in the model's unit; any value may stand in it,
            NaN and infinities too (`striptools.mesh.clean` drops what cannot be used).
        faces: `(f, 3)` int32, each row three vertex indices in winding order.
        notes: What loading did to arrive here, one short phrase each ("12 n-gons triangulated").
        attributes: What else the source says of vertices, corners and faces, at most one of a name; kept in
            the order of `NAMES`.
        materials: What the numbers of the attribute `group` stand for.
        unit: The length that 1 stands for ("m", "mm", "in"), where the source says so.
        geometries: Which faces and vertices are one geometry, where geometries stand in several places; None
            for a plain mesh. No face has vertices of two.
        instances: Where they stand, there where `geometries` are.

    Raises:
        UsageError: Where an array has another shape or dtype, or an index is out of range.
        LimitError: Where there are more than `MOST_FACES` faces.
    """

    positions: SourcePositions
    faces: Faces
    notes: tuple[str, ...] = ()
    attributes: tuple[Attribute, ...] = ()
    materials: tuple[Material, ...] = ()
    unit: str | None = None
    geometries: Geometries | None = None
    instances: Instances | None = None

    def __post_init__(self) -> None:
        positions = _rows_of_three(self.positions, "positions")
        faces = _rows_of_three(self.faces, "faces")
        if positions.dtype not in (np.float32, np.float64):
            raise UsageError(f"positions are {positions.dtype}", remedy="float32 or float64 is wanted")
        if faces.dtype.kind not in "iu":
            raise UsageError(f"faces are {faces.dtype}", remedy="integer indices are wanted")
        if len(faces) > MOST_FACES:
            raise LimitError(
                f"{len(faces)} faces", remedy=f"at most {MOST_FACES} are handled; split the model"
            )
        bad = first_face_out_of_range(faces, len(positions))
        if bad is not None:
            raise UsageError(f"face {bad} names a vertex that does not exist", where="faces")
        object.__setattr__(self, "positions", np.ascontiguousarray(positions))
        object.__setattr__(self, "faces", np.ascontiguousarray(faces, np.int32))
        object.__setattr__(self, "notes", tuple(self.notes))
        attributes = sorted(self.attributes, key=lambda one: NAMES.index(one.name))
        object.__setattr__(self, "attributes", tuple(attributes))
        object.__setattr__(self, "materials", tuple(self.materials))
        check_attributes(self.attributes, self.materials, len(positions), len(faces))
        check_instances(self.geometries, self.instances, len(positions), self.faces)

    def attribute(self, name: str) -> Attribute | None:
        """The attribute of a name, or None."""
        return next((one for one in self.attributes if one.name == name), None)

    def geometry(self) -> Mesh:
        """The mesh without attributes and materials, and a note on what was left out."""
        if not self.attributes:
            return replace(self, materials=())
        note = f"left out: {', '.join(one.plural for one in self.attributes)}"
        return replace(self, notes=(*self.notes, note), attributes=(), materials=())

    @property
    def triangle_count(self) -> int:
        """How many faces there are."""
        return len(self.faces)

    @property
    def vertex_count(self) -> int:
        """How many vertices there are, whether a face uses them or not."""
        return len(self.positions)

    def flattened(self) -> Mesh:
        """The plain mesh of all instances, one after another; the mesh itself where it has none.

        Positions are float64 where a matrix moves them, else as they are; a mirror turns the winding of its
        faces, whose second and third corner change places; normals are turned and of length 1.

        Raises:
            LimitError: Where that has more than `MOST_FACES` faces.
        """
        if self.geometries is None or self.instances is None:
            return self
        given = (self.geometries, self.instances)
        return replace(
            self,
            faces=placed_faces(self.faces, *given, MOST_FACES),
            positions=placed_positions(self.positions, *given),
            attributes=placed_attributes(self.attributes, *given),
            geometries=None,
            instances=None,
        )

    def parts(self) -> list[Mesh]:
        """A plain mesh for each geometry, where it does not stand anywhere yet; the mesh itself if plain."""
        if self.geometries is None:
            return [self]
        return [self._part(k) for k in range(len(self.geometries))]

    def _part(self, geometry: int) -> Mesh:
        assert self.geometries is not None
        faces, vertices = self.geometries.faces(geometry), self.geometries.vertices(geometry)
        rows = {"face": faces, "vertex": vertices, "corner": slice(3 * faces.start, 3 * faces.stop)}
        return replace(
            self,
            positions=self.positions[vertices],
            faces=self.faces[faces] - np.int32(vertices.start),
            attributes=tuple(replace(one, values=one.values[rows[one.domain]]) for one in self.attributes),
            geometries=None,
            instances=None,
        )

    @cached_property
    def bounds(self) -> np.ndarray:
        """`(2, 3)` float64: least and greatest corner of the finite vertices; zeros where there is none."""
        finite = self.positions[np.isfinite(self.positions).all(axis=1)]
        if len(finite) == 0:
            return np.zeros((2, 3))
        return np.stack([finite.min(axis=0), finite.max(axis=0)]).astype(np.float64)

    def dual_graph(self) -> networkx.Graph:
        """The face adjacency as a networkx graph; see `striptools.mesh.adjacency.dual_graph`."""
        from striptools.mesh.adjacency import build_adjacency, dual_graph

        return dual_graph(build_adjacency(self.faces, self.vertex_count), self.faces)


def first_face_out_of_range(faces: np.ndarray, vertex_count: int) -> int | None:
    """The first row of `faces` that names a vertex outside `0 .. vertex_count - 1`, or None."""
    if len(faces) == 0 or (faces.min() >= 0 and faces.max() < vertex_count):
        return None
    return int(np.flatnonzero(((faces < 0) | (faces >= vertex_count)).any(axis=1))[0])


def _rows_of_three(array: object, name: str) -> np.ndarray:
    rows = np.asarray(array)
    if rows.ndim != 2 or rows.shape[1] != 3:
        raise UsageError(f"{name} have shape {rows.shape}", remedy="rows of three are wanted")
    return rows
