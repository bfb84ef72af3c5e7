"""What a mesh carries beside its geometry: normals, texture coordinates, colours, groups with materials.

An attribute has a row a vertex, a corner or a face. Rows are compared, and kept, bit for bit: two NaNs are
equal where their bits are, and the two zeros differ. A corner that has no normal or texture coordinate where
others have one holds NaN.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from striptools.errors import UsageError
from striptools.types import FaceIds, Faces

Name = Literal["normal", "texcoord", "color", "group"]
Domain = Literal["vertex", "corner", "face"]
NAMES: tuple[Name, ...] = get_args(Name)
DOMAINS: tuple[Domain, ...] = get_args(Domain)

DTYPES: dict[Name, tuple[str, ...]] = {
    "normal": ("float32",),
    "texcoord": ("float32",),
    "color": ("float32", "uint8", "uint16"),
    "group": ("int32",),
}
WIDTHS: dict[Name, tuple[int, ...]] = {"normal": (3,), "texcoord": (2,), "color": (3, 4), "group": (1,)}

WHITE = (1.0, 1.0, 1.0, 1.0)
MOST_MATERIALS = 1 << 16
LONGEST_NAME = 120
"""Characters of a material's or group's name that are kept."""


@dataclass(frozen=True, eq=False)
class Attribute:
    """One kind of value over a mesh.

    Args:
        name: `normal` (a direction in the model's frame, as long as the source has it), `texcoord` (u and v
            as the source has them), `color` (3 or 4 components, red first; integers stand for fractions of
            their type's largest, floats are 0 to 1) or `group` (of faces: the number of its material).
        domain: Whether there is a row a vertex, a face, or a corner: row `3 f + c` for corner c of face f.
        values: `(rows, k)` float32; uint8 or uint16 too for colours; int32, k = 1, for groups.

    Raises:
        UsageError: Where a name, domain, shape or dtype is none of these.
    """

    name: Name
    domain: Domain
    values: np.ndarray

    def __post_init__(self) -> None:
        if self.name not in NAMES or self.domain not in DOMAINS:
            raise UsageError(f"an attribute {self.name!r} of a {self.domain!r}", where="attributes")
        values = np.ascontiguousarray(self.values)
        if values.ndim != 2 or values.shape[1] not in WIDTHS[self.name]:
            raise UsageError(f"values of {self.name} have shape {values.shape}", where="attributes")
        if values.dtype.name not in DTYPES[self.name]:
            raise UsageError(
                f"values of {self.name} are {values.dtype}",
                where="attributes",
                remedy=f"{' or '.join(DTYPES[self.name])} is wanted",
            )
        if self.name == "group" and (self.domain != "face" or values.min(initial=0) < 0):
            raise UsageError("groups are numbers from 0 on, one a face", where="attributes")
        object.__setattr__(self, "values", values)

    @property
    def plural(self) -> str:
        """What its values are called in words for people."""
        return "groups and materials" if self.name == "group" else f"{self.name}s"

    def at_corners(self, faces: Faces) -> np.ndarray:
        """`(3 f, k)`: the value at each corner of the mesh's faces."""
        if self.domain == "vertex":
            return self.values[faces.reshape(-1)]
        return np.repeat(self.values, 3, axis=0) if self.domain == "face" else self.values


@dataclass(frozen=True)
class Material:
    """What the faces of a group look like.

    Args:
        name: The material's name; empty where it has none.
        base_color: Red, green, blue, alpha, each 0 to 1.
        group: The name of the object or group that the faces belong to; empty where it has none.
    """

    name: str = ""
    base_color: tuple[float, float, float, float] = WHITE
    group: str = ""


def check_attributes(
    attributes: Sequence[Attribute], materials: Sequence[Material], vertices: int, faces: int
) -> None:
    """Raise `UsageError` where attributes do not fit a mesh of so many vertices and faces."""
    names = [one.name for one in attributes]
    if len(set(names)) < len(names):
        raise UsageError("two attributes of one name", where="attributes")
    rows = {"vertex": vertices, "corner": 3 * faces, "face": faces}
    for one in attributes:
        if len(one.values) != rows[one.domain]:
            raise UsageError(
                f"{len(one.values)} values of {one.name} for {rows[one.domain]} "
                + {"vertex": "vertices", "corner": "corners", "face": "faces"}[one.domain],
                where="attributes",
            )
        if one.name == "group" and one.values.max(initial=-1) >= len(materials):
            raise UsageError(
                f"group {one.values.max()} has no material, of {len(materials)}", where="attributes"
            )


def tidy_name(name: str) -> str:
    """A name fit to be kept: printable, and no longer than `LONGEST_NAME`."""
    return "".join(letter if letter.isprintable() else " " for letter in name)[:LONGEST_NAME].strip()


def as_words(values: np.ndarray) -> np.ndarray:
    """The rows of values as `(rows, 3)` or `(rows, 4)` uint32, equal where their bits are."""
    rows, width = values.shape
    if values.dtype.itemsize == 4:
        words = np.zeros((rows, max(width, 3)), np.uint32)
        words[:, :width] = values.view(np.uint32)
        return words
    words = np.zeros((rows, 3), np.uint32)
    parts = 4 // values.dtype.itemsize
    for k in range(width):
        words[:, k // parts] |= values[:, k].astype(np.uint32) << np.uint32(
            8 * values.dtype.itemsize * (k % parts)
        )
    return words


def first_equal(values: np.ndarray) -> np.ndarray:
    """The first row with the same bits as each row, `(rows,)` int32."""
    from striptools.kernels.welding import first_equal_rows

    words = as_words(values)
    first = np.zeros(len(words), np.int32)
    first_equal_rows(np.ascontiguousarray(words[:, :3]), 0, 1, first)
    if words.shape[1] == 3:
        return first
    again = np.zeros((len(words), 3), np.uint32)
    again[:, 0], again[:, 1] = first.view(np.uint32), words[:, 3]
    first_equal_rows(again, 0, 1, first)
    return first


def distinct_rows(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The distinct rows in order of first use, and for each row the number of its equal there, int32."""
    first = first_equal(values)
    is_first = first == np.arange(len(first), dtype=np.int32)
    number = np.cumsum(is_first, dtype=np.int32) - 1
    return values[is_first], number[first]


def same_rows(one: np.ndarray, two: np.ndarray) -> np.ndarray:
    """Which rows of two arrays of one shape and dtype have the same bits, `(rows,)` bool."""
    bits = {1: np.uint8, 2: np.uint16, 4: np.uint32}[one.dtype.itemsize]
    return (np.ascontiguousarray(one).view(bits) == np.ascontiguousarray(two).view(bits)).all(axis=1)


def narrowed(corners: np.ndarray, name: Name, faces: Faces, vertices: int) -> tuple[Attribute, np.ndarray]:
    """An attribute given at corners, in the smallest domain that holds it exactly.

    Args:
        corners: `(3 f, k)` values, corner by corner.
        name: The attribute's.
        faces: `(f, 3)` int32, in which every vertex is used.
        vertices: How many vertices there are.

    Returns:
        The attribute, and the corners whose value is not that of their vertex's first corner, `(3 f,)` bool.
    """
    flat = faces.reshape(-1)
    first = np.zeros(vertices, np.int64)
    first[flat[::-1]] = np.arange(len(flat))[::-1]
    differs = ~same_rows(corners, corners[first[flat]])
    table = corners.reshape(len(faces), 3, corners.shape[1])
    a_face = all(same_rows(table[:, k], table[:, 0]).all() for k in (1, 2))
    if not differs.any() and (vertices <= len(faces) or not a_face):
        return Attribute(name, "vertex", corners[first]), differs
    if a_face:
        return Attribute(name, "face", table[:, 0]), differs
    return Attribute(name, "corner", corners), differs


def follow(
    attributes: Sequence[Attribute], faces: Faces, source_face: FaceIds, welded: Faces, leaders: np.ndarray
) -> tuple[tuple[Attribute, ...], int]:
    """The attributes of a mesh after cleaning, each in the smallest domain that holds it exactly.

    Args:
        attributes: Those of the mesh before.
        faces: `(f, 3)` int32, the faces before.
        source_face: `(n,)` int32, the face that each kept face was; corners keep their order.
        welded: `(n, 3)` int32, the kept faces in the numbering after.
        leaders: `(v,)` the vertex before that each vertex after is.

    Returns:
        The attributes, and how many vertices carry several values of one of them.
    """
    found: list[Attribute] = []
    seams = np.zeros(len(leaders), np.bool_)
    for one in attributes:
        if one.domain == "face":
            found.append(Attribute(one.name, "face", one.values[source_face]))
            continue
        kept = faces[source_face]
        if one.domain == "vertex" and _one_value(one.values, kept, welded, leaders):
            found.append(Attribute(one.name, "vertex", one.values[leaders]))
            continue
        if one.domain == "vertex":
            corners = one.values[kept.reshape(-1)]
        else:
            width = one.values.shape[1]
            corners = one.values.reshape(len(faces), 3, width)[source_face].reshape(3 * len(kept), width)
        attribute, differs = narrowed(corners, one.name, welded, len(leaders))
        seams[welded.reshape(-1)[differs]] = True
        found.append(attribute)
    return tuple(found), int(np.count_nonzero(seams))


def _one_value(values: np.ndarray, kept: Faces, welded: Faces, leaders: np.ndarray) -> bool:
    """Whether every corner has the value of the vertex that stands for it."""
    there = leaders[welded]
    moved = there != kept
    return bool(same_rows(values[there[moved]], values[kept[moved]]).all())


def join_attributes(
    parts: Sequence[tuple[int, int, Sequence[Attribute]]],
) -> tuple[tuple[Attribute, ...], tuple[str, ...]]:
    """The attributes of meshes put one after another, of a row a vertex or face each.

    What a part lacks is filled in: NaN for normals and texture coordinates, white for colours. Where parts
    store a colour differently the whole is float32.

    Args:
        parts: Of each mesh, how many vertices and faces it has, and its attributes, none of corners.

    Returns:
        The attributes, and a note for each that some parts lack.
    """
    names: list[Name] = [
        name for name in NAMES if any(one.name == name for _, _, found in parts for one in found)
    ]
    joined, notes = [], []
    for name in names:
        own = [next((one for one in found if one.name == name), None) for _, _, found in parts]
        present = [one for one in own if one is not None]
        domain, width = present[0].domain, max(one.values.shape[1] for one in present)
        dtypes = {one.values.dtype for one in present}
        dtype = dtypes.pop() if len(dtypes) == 1 else np.dtype(np.float32)
        rows = [faces if domain == "face" else vertices for vertices, faces, _ in parts]
        blocks = [_filled(one, count, width, dtype, name) for one, count in zip(own, rows, strict=True)]
        joined.append(Attribute(name, domain, np.concatenate(blocks)))
        if len(present) < len(own):
            notes.append(f"{len(own) - len(present)} of {len(own)} parts have no {name}")
    return tuple(joined), tuple(notes)


def _filled(one: Attribute | None, rows: int, width: int, dtype: np.dtype, name: Name) -> np.ndarray:
    full = 1 if dtype.kind == "f" else np.iinfo(dtype).max
    empty = full if name == "color" else np.nan if dtype.kind == "f" else 0
    values = np.full((rows, width), empty, dtype)
    if one is not None:
        values[:, : one.values.shape[1]] = as_type(one.values, dtype)
    return values


def as_type(values: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """Values as another type: integers stand for fractions of their type's largest where floats are asked."""
    if values.dtype == dtype or dtype.kind != "f" or values.dtype.kind == "f":
        return values.astype(dtype, copy=False)
    return (values / np.float64(np.iinfo(values.dtype).max)).astype(dtype)


def turn_normals(values: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """Normals under a transform of positions: by the inverse transpose, then of length 1, float32.

    Args:
        values: `(v, 3)` float32.
        matrix: `(3, 3)` float64; where it is singular a normal may come out as zero.
    """
    # The cofactors are the inverse transpose times the determinant, and there without one too.
    cofactors = np.stack([np.cross(matrix[(k + 1) % 3], matrix[(k + 2) % 3]) for k in range(3)])
    with np.errstate(all="ignore"):
        sign = -1.0 if np.linalg.det(matrix) < 0 else 1.0
        x, y, z = values.astype(np.float64).T
        rows = sign * cofactors
        turned = np.stack([(row[0] * x + row[1] * y) + row[2] * z for row in rows], axis=1)
        length = np.sqrt((turned * turned).sum(axis=1, keepdims=True))
        return np.where(length > 0, turned / length, turned).astype(np.float32)


def number_materials(
    materials: Sequence[Material], face_materials: np.ndarray
) -> tuple[np.ndarray, tuple[Material, ...]]:
    """Groups of faces and their materials, equal ones made one, in order of first use by a face.

    Args:
        materials: Any number, some perhaps equal or unused.
        face_materials: `(f,)` the number of each face's.

    Returns:
        `(f, 1)` int32 groups and the materials that they number.
    """
    unique = {one: k for k, one in reversed(list(enumerate(materials)))}
    same = np.array([unique[one] for one in materials], np.int64)
    faces = same[face_materials].astype(np.int32).reshape(-1, 1)
    rows, groups = distinct_rows(faces)
    return groups.reshape(-1, 1), tuple(materials[int(k)] for k in rows[:, 0])
