"""OBJ with texture coordinates and normals of corners, colours of vertices, groups, and a material file."""

from __future__ import annotations

import numpy as np

from striptools.mesh.attributes import Attribute, Material, as_type, distinct_rows
from striptools.mesh.mesh import Mesh


def encode_obj(mesh: Mesh, library: str = "") -> bytes:
    """The mesh as an OBJ file: the digits that bring back the same float32, or float64 where positions are.

    Corners whose value is NaN name none. Colours of corners or faces are left out.

    Args:
        mesh: What to write.
        library: The name of the material file beside it; empty where there is none.
    """
    text = [f"mtllib {library}\n"] if library and mesh.materials else []
    text.append(_vertex_lines(mesh))
    corners = [mesh.faces.reshape(-1).astype(np.int64) + 1]
    for name, word in (("texcoord", "vt"), ("normal", "vn")):
        one = mesh.attribute(name)
        if one is None:
            corners.append(np.zeros_like(corners[0]))
            continue
        rows, numbers = distinct_rows(one.at_corners(mesh.faces))
        there = ~np.isnan(rows).any(axis=1)
        place = np.where(there, np.cumsum(there), 0)
        text.append(_lines(word, rows[there], 9))
        corners.append(place[numbers])
    text += _face_lines(mesh, np.stack(corners, axis=1))
    return "".join(text).encode()


def encode_library(materials: tuple[Material, ...]) -> bytes:
    """The material file: a colour and an opacity for each name."""
    colours = {one.name: one.base_color for one in reversed(materials) if one.name}
    lines = [
        f"newmtl {name}\nKd {red:.9g} {green:.9g} {blue:.9g}\nd {alpha:.9g}\n"
        for name, (red, green, blue, alpha) in reversed(colours.items())
    ]
    return "".join(lines).encode()


def _vertex_lines(mesh: Mesh) -> str:
    digits = 9 if mesh.positions.dtype == np.float32 else 17
    colour = mesh.attribute("color")
    if colour is None or colour.domain != "vertex":
        return _lines("v", mesh.positions, digits)
    fractions = as_type(colour.values[:, :3], np.dtype(np.float32))
    return _lines("v", np.concatenate([mesh.positions.astype(np.float64), fractions], axis=1), digits)


def _lines(word: str, rows: np.ndarray, digits: int) -> str:
    line = f"{word}{f' %.{digits}g' * rows.shape[1]}\n"
    return (line * len(rows)) % tuple(rows.reshape(-1).tolist())


def _face_lines(mesh: Mesh, corners: np.ndarray) -> list[str]:
    """The faces, with a line before each at which the group changes."""
    lines = _corner_words(corners)
    faces = [f"f {a} {b} {c}\n" for a, b, c in zip(lines[::3], lines[1::3], lines[2::3], strict=True)]
    group = mesh.attribute("group")
    if group is None:
        return faces
    return _with_groups(faces, group, mesh.materials)


def _corner_words(corners: np.ndarray) -> list[str]:
    rows = corners.tolist()
    if not corners[:, 1:].any():
        return [str(v) for v, _, _ in rows]
    return [f"{v}/{t or ''}/{n or ''}".rstrip("/") for v, t, n in rows]


def _with_groups(faces: list[str], group: Attribute, materials: tuple[Material, ...]) -> list[str]:
    numbers = group.values[:, 0]
    parts, named = any(one.group for one in materials), any(one.name for one in materials)
    changes = np.flatnonzero(np.diff(numbers, prepend=-1)).tolist()
    out: list[str] = []
    for begin, end in zip(changes, [*changes[1:], len(faces)], strict=True):
        one = materials[int(numbers[begin])]
        out += [f"g {one.group or 'default'}\n"] if parts else []
        out += [f"usemtl {one.name or 'default'}\n"] if named else []
        out += faces[begin:end]
    return out
