"""What the columns of a PLY file say beside positions and indices: normals, texture coordinates, colours.

PLY has no fixed names for these; the ones known here are those of common writers. A column that is none of
them, or of a type that makes no sense for it, is left out and a note names it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from striptools.mesh.attributes import Attribute, Domain, Name
from striptools.mesh.readers.parsed import Fans, left_out

NORMALS = (("nx", "ny", "nz"),)
TEXCOORDS = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
COLOURS = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
KNOWN: tuple[tuple[Name, tuple[tuple[str, ...], ...]], ...] = (
    ("normal", NORMALS),
    ("texcoord", TEXCOORDS),
    ("color", COLOURS),
)
ALPHAS = {"red": "alpha", "r": "a", "diffuse_red": "diffuse_alpha"}
WEDGES = ("texcoord",)

Columns = dict[str, np.dtype | None]
"""The columns of an element beside positions and indices, with their types; None for lists."""

Read = Callable[[str], np.ndarray | None]
"""Reads a column by its name; None where what is there does not fit its type."""


def vertex_attributes(columns: Columns, read: Read) -> tuple[list[Attribute], list[str]]:
    """The attributes that the columns of the vertices are, and the names of the columns left out."""
    found, used = [], set()
    for name, choices in KNOWN:
        names = _choose(columns, choices)
        one = _attribute(name, "vertex", names, columns, read)
        if one is not None:
            found.append(one)
            used.update(names)
    return found, [f"vertex {name}" for name in columns if name not in used]


def face_attributes(
    columns: Columns, read: Read, wedges: Callable[[str], np.ndarray | None], fans: Fans, known: set[str]
) -> tuple[list[Attribute], list[str]]:
    """The same for the faces, a row a triangle or corner; without attributes of a name in `known`.

    Args:
        columns: Those of the faces.
        read: Reads a column, a row a polygon.
        wedges: Reads a list of two numbers a corner, `(all corners of polygons, 2)`, or gives None.
        fans: How the polygons were cut.
        known: The attributes that the vertices have.
    """
    found, used = [], set()
    names = _choose(columns, COLOURS)
    colour = _attribute("color", "face", names, columns, read) if "color" not in known else None
    if colour is not None:
        found.append(Attribute("color", "face", colour.values[fans.polygons]))
        used.update(names)
    for name in WEDGES:
        values = wedges(name) if name in columns and "texcoord" not in known else None
        if values is not None:
            corners = values[fans.corners.reshape(-1)].astype(np.float32)
            found.append(Attribute("texcoord", "corner", corners))
            used.add(name)
    return found, [f"face {name}" for name in columns if name not in used]


def columns_note(names: list[str]) -> tuple[str, ...]:
    """The note on columns left out."""
    return left_out(names, "property", "properties")


def _choose(columns: Columns, choices: tuple[tuple[str, ...], ...]) -> tuple[str, ...]:
    """The first group of names of which all are columns of numbers; with alpha where that is there too."""
    for names in choices:
        if all(columns.get(name) is not None for name in names):
            alpha = ALPHAS.get(names[0], "")
            return (*names, alpha) if columns.get(alpha) == columns[names[0]] else names
    return ()


def _attribute(
    name: Name, domain: Domain, names: tuple[str, ...], columns: Columns, read: Read
) -> Attribute | None:
    types = {columns[one] for one in names}
    if not names or not all(_fits(name, dtype) for dtype in types if dtype):
        return None
    values = [read(one) for one in names]
    if any(one is None for one in values):
        return None
    same = types.pop() if len(types) == 1 else None
    whole = same is not None and same.kind == "u"
    target = np.dtype(np.float32) if same is None or not whole else same.newbyteorder("=")
    with np.errstate(over="ignore", invalid="ignore"):
        table = np.stack([np.asarray(one) for one in values], axis=1).astype(target)
    return Attribute(name, domain, table)


def _fits(name: Name, dtype: np.dtype) -> bool:
    """Whether numbers of a type can be an attribute: floats, or unsigned fractions for colours."""
    return dtype.kind == "f" or (name == "color" and dtype.kind == "u" and dtype.itemsize <= 2)
