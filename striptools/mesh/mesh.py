"""The mesh as loaded: positions, triangles and what loading had to do to them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from striptools.errors import LimitError, UsageError
from striptools.mesh.attributes import NAMES, Attribute, Material, check_attributes
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
