"""OBJ: the numbers of the vertices through trimesh, the faces here.

trimesh's reading of OBJ faces cannot be kept from working over what it reads: it counts relative indices from
the end of the file instead of from the line they stand on, takes index 0 for 1, regroups faces by material
and object, and splits vertices by texture coordinate. So the faces' position indices are read here, and
trimesh gets the vertex lines alone, each cut down to three numbers where their lengths differ (it would read
them as one flat table). What corners and groups carry is read in obj_corners.py.
"""

from __future__ import annotations

import re
from io import BytesIO
from pathlib import Path
from typing import IO

import numpy as np

from striptools.errors import UnreadableMeshError
from striptools.mesh.readers.obj_corners import read_colours, read_corner_values, read_groups
from striptools.mesh.readers.parsed import (
    EXPORT_AGAIN,
    Parsed,
    counted,
    decode_text,
    fan_out,
    narrow,
    numbers,
    strict_numbers,
)

VERTEX_LINE = re.compile(rb"^[ \t]*v[ \t]+(.*)$", re.MULTILINE)
FACE_LINE = re.compile(rb"^[ \t]*fo?(?![^ \t\n])(.*)$", re.MULTILINE)
OTHER_LINE = re.compile(rb"^[ \t]*(l|p|curv|curv2|surf)[ \t]", re.MULTILINE)

# trimesh leaves such a sign out and so would read 3.1-e2 as 310.
BROKEN_EXPONENT = re.compile(rb"[+-]e", re.IGNORECASE)


def read_obj(file: IO[bytes], folder: Path | None = None) -> Parsed:
    """Read an OBJ file: the faces of all objects and groups in file order; n-gons are cut into fans.

    Args:
        file: The open file.
        folder: Where the material files that it names may lie; None where they cannot be looked for.

    Raises:
        UnreadableMeshError: Naming the vertex or face where something is no number or cannot be an index.
    """
    text = decode_text(file.read()).replace(b"\\\n", b" ")
    if b"#" in text:
        text = re.sub(rb"#.*", b"", text)
    positions = _read_vertices(VERTEX_LINE.findall(text))
    lengths, corners = _read_corners(text, len(positions))
    fans = fan_out(lengths)
    faces, notes = corners[fans.corners], fans.notes
    others = len(OTHER_LINE.findall(text))
    if others:
        notes += (
            f"{counted(others, 'point, line or curve element', 'point, line or curve elements')} left out",
        )
    attributes, more = read_corner_values(text, FACE_LINE, fans)
    colours, odd = read_colours(VERTEX_LINE.findall(text))
    groups, materials, last = read_groups(text, FACE_LINE, fans, folder)
    attributes = (*attributes, *colours, *groups)
    return Parsed(narrow(positions), faces, notes + more + odd + last, attributes, materials)


def _read_vertices(lines: list[bytes]) -> np.ndarray:
    from trimesh.exchange.obj import load_obj

    if not lines:
        return np.zeros((0, 3))
    lengths = {len(line.split()) for line in lines}
    if min(lengths) < 3:
        short = next(k for k, line in enumerate(lines) if len(line.split()) < 3)
        raise UnreadableMeshError(f"vertex {short + 1} has fewer than 3 coordinates", remedy=EXPORT_AGAIN)
    if len(lengths) > 1:
        lines = [b" ".join(line.split()[:3]) for line in lines]
    table = b"v " + b"\nv ".join(lines) + b"\n"
    if not table.isascii():
        raise UnreadableMeshError("text where a number should be", remedy=EXPORT_AGAIN)
    odd = BROKEN_EXPONENT.search(table)
    if odd:
        place = table.count(b"\n", 0, odd.start()) + 1
        raise UnreadableMeshError(
            f"vertex {place} has a number with a sign before its exponent", remedy=EXPORT_AGAIN
        )
    with strict_numbers():
        return load_obj(BytesIO(table))["vertices"]


def _read_corners(text: bytes, vertex_count: int) -> tuple[np.ndarray, np.ndarray]:
    """How many corners each face has, and their vertices counted from 0."""
    lines = FACE_LINE.findall(text)
    lengths = np.array([len(line.split()) for line in lines], np.int64)
    corners = numbers(re.sub(rb"/\S*", b"", b" ".join(lines)), np.int64)
    face = np.repeat(np.arange(len(lengths)), lengths)
    if len(corners) != len(face):
        raise UnreadableMeshError("a face has a corner without a vertex index", remedy=EXPORT_AGAIN)
    zero = np.flatnonzero(corners == 0)
    if len(zero):
        raise UnreadableMeshError(
            f"face {face[zero[0]]} uses index 0", remedy="indices of OBJ files start at 1"
        )
    if len(corners) and corners.min() < 0:
        return lengths, np.where(corners < 0, corners + _vertices_before(text)[face], corners - 1)
    return lengths, corners - 1


def _vertices_before(text: bytes) -> np.ndarray:
    """How many vertex lines stand before each face line: relative indices count back from there."""
    vertices = np.array([line.start() for line in VERTEX_LINE.finditer(text)], np.int64)
    faces = np.array([line.start() for line in FACE_LINE.finditer(text)], np.int64)
    return np.searchsorted(vertices, faces)
