"""PLY with normals, texture coordinates and colours: binary, little endian, columns named as others do.

Texture coordinates of corners are a list of the face, as MeshLab has them; corners that differ in anything
else get vertices of their own.
"""

from __future__ import annotations

import numpy as np

from striptools.mesh.attributes import Attribute
from striptools.mesh.mesh import Mesh
from striptools.mesh.writers.split import split_vertices

NAMES = {"normal": ("nx", "ny", "nz"), "texcoord": ("s", "t"), "color": ("red", "green", "blue", "alpha")}
TYPES = {"f4": "float", "f8": "double", "u1": "uchar", "u2": "ushort"}

Column = tuple[str, str, np.ndarray]
"""A column's name, its NumPy type, its values."""


def encode_ply(mesh: Mesh) -> bytes:
    """The mesh as a PLY file; positions are float or double as they are, groups are left out."""
    colour = mesh.attribute("color")
    of_faces = colour if colour is not None and colour.domain == "face" else None
    mesh = split_vertices(mesh, ("normal",) if of_faces is not None else ("normal", "color"))
    kind = f"f{mesh.positions.dtype.itemsize}"
    vertices: list[Column] = [(axis, kind, mesh.positions[:, k]) for k, axis in enumerate(("x", "y", "z"))]
    lists = None
    for one in mesh.attributes:
        if one.domain == "vertex":
            vertices += _columns(one)
        elif one.name == "texcoord":
            lists = one.at_corners(mesh.faces).reshape(-1, 6)
    faces = _columns(of_faces) if of_faces is not None else []
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {mesh.vertex_count}"]
    head += [f"property {TYPES[kind]} {name}" for name, kind, _ in vertices]
    head += [f"element face {mesh.triangle_count}", "property list uchar int vertex_indices"]
    head += ["property list uchar float texcoord"] if lists is not None else []
    head += [f"property {TYPES[kind]} {name}" for name, kind, _ in faces] + ["end_header", ""]
    table = _table([(name, "<" + kind) for name, kind, _ in vertices], mesh.vertex_count)
    for name, _, values in vertices:
        table[name] = values
    return "\n".join(head).encode() + table.tobytes() + _face_rows(mesh, lists, faces)


def _columns(one: Attribute) -> list[Column]:
    kind = one.values.dtype.str[1:]
    return [(name, kind, one.values[:, k]) for k, name in enumerate(NAMES[one.name][: one.values.shape[1]])]


def _face_rows(mesh: Mesh, lists: np.ndarray | None, faces: list[Column]) -> bytes:
    fields: list = [("3", "u1"), ("indices", "<i4", (3,))]
    fields += [("6", "u1"), ("pairs", "<f4", (6,))] if lists is not None else []
    table = _table([*fields, *((name, "<" + kind) for name, kind, _ in faces)], mesh.triangle_count)
    table["3"], table["indices"] = 3, mesh.faces
    if lists is not None:
        table["6"], table["pairs"] = 6, lists
    for name, _, values in faces:
        table[name] = values
    return table.tobytes()


def _table(fields: list, rows: int) -> np.ndarray:
    return np.zeros(rows, np.dtype(fields))
