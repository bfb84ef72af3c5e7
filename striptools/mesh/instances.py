"""Geometries of a mesh and the places where they stand: what a repeated mesh is stored once for.

A mesh may be several geometries, each a range of its faces and a range of its vertices, and instances that
place them: a geometry and a matrix each. The arithmetic that applies a matrix is written out and fixed, one
rounding in float64 a step, so that a scene placed by its file and a source placed by its loader have the same
bits (SPEC.md, section 4.11).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from jaxtyping import Float64

from striptools.errors import LimitError, UsageError
from striptools.mesh.attributes import Attribute, turn_normals
from striptools.types import Counts

Matrices = Float64[np.ndarray, "k 3 4"]

SURE = 1e-14
"""A determinant of float64 has the sign that it shows where it is above this part of its terms' size."""

LEAST_SURE = 1e-280
"""Below it products may have lost bits for being small."""

FARTHEST = 2.0**127
"""The largest coordinate that an instance may give, by the bounds of all geometries."""


@dataclass(frozen=True, eq=False)
class Geometries:
    """Which faces and vertices of a mesh each geometry is.

    Args:
        face_starts: `(g+1,)` int32, the first face of each geometry, from 0, then all.
        vertex_starts: `(g+1,)` int32, the first vertex of each, from 0, then all.
    """

    face_starts: Counts
    vertex_starts: Counts

    def __len__(self) -> int:
        return len(self.face_starts) - 1

    def faces(self, geometry: int) -> slice:
        """The faces of a geometry."""
        return slice(int(self.face_starts[geometry]), int(self.face_starts[geometry + 1]))

    def vertices(self, geometry: int) -> slice:
        """The vertices of a geometry."""
        return slice(int(self.vertex_starts[geometry]), int(self.vertex_starts[geometry + 1]))


@dataclass(frozen=True, eq=False)
class Instances:
    """Where geometries stand, in an order that numbers the faces of all of them.

    Args:
        geometry: `(k,)` int32, which geometry each instance is.
        matrix: `(k, 3, 4)` float64: a point v of the geometry stands at matrix[:, :3] v + matrix[:, 3].
            Finite, with a determinant of its first three columns that is not zero; mirrors may be among them.

    Raises:
        UsageError: Where a shape is another one, or a matrix none of these.
    """

    geometry: Counts
    matrix: Matrices

    def __post_init__(self) -> None:
        geometry = np.ascontiguousarray(self.geometry, np.int32)
        matrix = np.ascontiguousarray(self.matrix, np.float64)
        if geometry.ndim != 1 or matrix.shape != (len(geometry), 3, 4) or len(geometry) == 0:
            raise UsageError(
                f"matrices have shape {matrix.shape}", where="instances", remedy="give (k, 3, 4)"
            )
        wrong = np.flatnonzero(~np.isfinite(matrix).all(axis=(1, 2)))
        if len(wrong):
            raise UsageError(f"the matrix of instance {wrong[0]} is not finite", where="instances")
        flat = np.flatnonzero(determinant_signs(matrix) == 0)
        if len(flat):
            raise UsageError(f"the matrix of instance {flat[0]} has a determinant of 0", where="instances")
        object.__setattr__(self, "geometry", geometry)
        object.__setattr__(self, "matrix", matrix)

    def __len__(self) -> int:
        return len(self.geometry)

    def __iter__(self) -> Iterator[tuple[int, np.ndarray]]:
        """Each geometry's number with its `(3, 4)` matrix."""
        return zip(self.geometry.tolist(), self.matrix, strict=True)

    @property
    def stretch(self) -> float:
        """By how much the most stretching of them lengthens a distance, at most."""
        return float(np.linalg.norm(self.matrix[:, :, :3], ord=2, axis=(1, 2)).max()) * (1 + 2.0**-20)

    @property
    def mirrored(self) -> np.ndarray:
        """`(k,)` bool: which turn the winding of their faces."""
        return determinant_signs(self.matrix) < 0


def check_instances(
    geometries: Geometries | None, instances: Instances | None, vertices: int, faces: np.ndarray
) -> None:
    """Raise `UsageError` where geometries or instances do not fit a mesh of these vertices and faces."""
    if (geometries is None) != (instances is None):
        raise UsageError("geometries without instances, or the other way round", where="instances")
    if geometries is None or instances is None:
        return
    totals = ((geometries.face_starts, len(faces)), (geometries.vertex_starts, vertices))
    for starts, total in totals:
        if len(starts) != len(geometries) + 1 or starts[0] != 0 or starts[-1] != total:
            raise UsageError("geometries do not hold all faces and vertices", where="geometries")
        if (np.diff(starts) < 0).any():
            raise UsageError("geometries are not one after another", where="geometries")
    owner = np.repeat(np.arange(len(geometries)), np.diff(geometries.face_starts))
    least, most = geometries.vertex_starts[owner], geometries.vertex_starts[owner + 1]
    if (faces < least[:, None]).any() or (faces >= most[:, None]).any():
        raise UsageError("a face has a vertex of another geometry", where="geometries")
    if instances.geometry.min() < 0 or instances.geometry.max() >= len(geometries):
        raise UsageError("an instance of a geometry that does not exist", where="instances")
    if len(np.unique(instances.geometry)) < len(geometries):
        raise UsageError("a geometry that stands nowhere", where="instances", remedy="leave it out")


def determinant_signs(matrix: np.ndarray) -> np.ndarray:
    """The sign of the determinant of the first three columns, in real numbers: `(k,)` int8.

    Args:
        matrix: `(k, 3, 3)` or `(k, 3, 4)` float64, finite.
    """
    with np.errstate(all="ignore"):
        a, b, c = matrix[:, 0, :3], matrix[:, 1, :3], matrix[:, 2, :3]
        terms = [a[:, i] * (b[:, j] * c[:, k]) for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))]
        terms += [-(a[:, i] * (b[:, j] * c[:, k])) for i, j, k in ((0, 2, 1), (1, 0, 2), (2, 1, 0))]
        value, size = sum(terms), sum(map(np.abs, terms))
        # What an inner product loses below the least float64 is multiplied by an entry of the first row.
        least = LEAST_SURE * np.maximum(np.abs(a).max(axis=1), 1)
        sure = (np.abs(value) > np.maximum(SURE * size, least)) & np.isfinite(size)
    signs = np.where(sure, np.sign(np.where(sure, value, 0)), 0).astype(np.int8)
    for row in np.flatnonzero(~sure):
        signs[row] = _exact_sign(matrix[row, :3])
    return signs


def _exact_sign(matrix: np.ndarray) -> int:
    a, b, c = ([Fraction(value) for value in row[:3]] for row in matrix.tolist())
    value = (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    return (value > 0) - (value < 0)


def is_identity(matrix: np.ndarray) -> bool:
    """Whether a `(3, 4)` or `(4, 4)` matrix leaves everything as it is, its bits too."""
    return bool(np.array_equal(matrix[:3], np.eye(4)[:3]))


def place(positions: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """The positions moved by a matrix, `(v, 3)` float64: ((m0 x + m1 y) + m2 z) + m3 in each row of it.

    Every step rounds to float64, and none is fused with another.

    Args:
        positions: `(v, 3)`.
        matrix: `(3, 4)` or `(4, 4)` float64.
    """
    moved = np.zeros((len(positions), 3))
    with np.errstate(all="ignore"):
        x, y, z = positions.astype(np.float64).T
        for axis in range(3):
            m = matrix[axis]
            moved[:, axis] = ((m[0] * x + m[1] * y) + m[2] * z) + m[3]
    return moved


def reach(matrix: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """The largest coordinate that each matrix gives to points of a box, or more: `(k,)` float64.

    Args:
        matrix: `(k, 3, 4)` float64.
        low: `(3,)`, the least coordinates of the box.
        high: `(3,)`, the largest.
    """
    with np.errstate(all="ignore"):
        x, y, z = np.maximum(np.abs(low), np.abs(high)).astype(np.float64)
        m = np.abs(matrix)
        return (((m[:, :, 0] * x + m[:, :, 1] * y) + m[:, :, 2] * z) + m[:, :, 3]).max(axis=1)


def placed_bounds(positions: np.ndarray, geometries: Geometries, instances: Instances) -> np.ndarray:
    """The least and the largest corner of the boxes of all instances, `(2, 3)` float64, in their places."""
    sides = np.zeros((len(geometries), 2, 3))
    for geometry in range(len(geometries)):
        part = positions[geometries.vertices(geometry)]
        finite = part[np.isfinite(part).all(axis=1)]
        if len(finite):
            sides[geometry] = finite.min(axis=0), finite.max(axis=0)
    middle, half = sides.sum(axis=1) / 2, (sides[:, 1] - sides[:, 0]) / 2
    matrix = instances.matrix[:, :, :3]
    centre = np.einsum("kij,kj->ki", matrix, middle[instances.geometry]) + instances.matrix[:, :, 3]
    size = np.einsum("kij,kj->ki", np.abs(matrix), half[instances.geometry])
    return np.stack([(centre - size).min(axis=0), (centre + size).max(axis=0)])


def placed_positions(positions: np.ndarray, geometries: Geometries, instances: Instances) -> np.ndarray:
    """The vertices of all instances one after another; those of the identity have the bits that they had."""
    return np.concatenate(
        [
            part if is_identity(matrix) else place(part, matrix)
            for geometry, matrix in instances
            for part in [positions[geometries.vertices(geometry)]]
        ]
    )


def placed_faces(faces: np.ndarray, geometries: Geometries, instances: Instances, most: int) -> np.ndarray:
    """The faces of all instances one after another, over the vertices of `placed_positions`, int32.

    A mirror turns the winding: the second and third corner change places.

    Raises:
        LimitError: Where they are more than `most`, or their vertices too many.
    """
    counts, vertices = (
        np.diff(starts).astype(np.int64)[instances.geometry]
        for starts in (geometries.face_starts, geometries.vertex_starts)
    )
    if counts.sum() > most or vertices.sum() > 2**31 - 1:
        raise LimitError(f"{counts.sum()} triangles with all instances", remedy=f"at most {most} are handled")
    placed, first = np.zeros((int(counts.sum()), 3), np.int32), 0
    at = (np.cumsum(vertices) - vertices).tolist()
    for (geometry, _), offset, mirrored in zip(instances, at, instances.mirrored, strict=True):
        part = faces[geometries.faces(geometry)] + np.int32(offset - int(geometries.vertex_starts[geometry]))
        placed[first : first + len(part)] = part[:, [0, 2, 1]] if mirrored else part
        first += len(part)
    return placed


def placed_attributes(
    attributes: tuple[Attribute, ...], geometries: Geometries, instances: Instances
) -> tuple[Attribute, ...]:
    """The attributes of all instances one after another: corners follow mirrors, normals are turned."""
    return tuple(_placed_attribute(one, geometries, instances) for one in attributes)


def _placed_attribute(one: Attribute, geometries: Geometries, instances: Instances) -> Attribute:
    parts = []
    for (geometry, matrix), mirrored in zip(instances, instances.mirrored, strict=True):
        faces, vertices = geometries.faces(geometry), geometries.vertices(geometry)
        if one.domain == "corner":
            values = one.values[3 * faces.start : 3 * faces.stop]
            if mirrored:
                rows = values.reshape(faces.stop - faces.start, 3, values.shape[1])
                values = rows[:, [0, 2, 1]].reshape(values.shape)
        else:
            values = one.values[vertices if one.domain == "vertex" else faces]
        if one.name == "normal" and not is_identity(matrix):
            values = turn_normals(values, matrix[:, :3])
        parts.append(values)
    return Attribute(one.name, one.domain, np.concatenate(parts))
