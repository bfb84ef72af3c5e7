"""OFF through trimesh, which gets the numbers it needs and no more.

trimesh sorts mixed polygons by their number of corners and drops faces of two corners without a word. So
polygons are cut into fans here, in file order, and it reads triangles.
"""

from __future__ import annotations

import re
from io import BytesIO
from typing import IO

import numpy as np

from striptools.errors import UnreadableMeshError
from striptools.mesh.readers.parsed import (
    EXPORT_AGAIN,
    Parsed,
    decode_text,
    fan_out,
    narrow,
    numbers,
    strict_numbers,
)

KEYWORD = re.compile(rb"(ST)?(CN?|NC?)?OFF\b", re.IGNORECASE)


def read_off(file: IO[bytes]) -> Parsed:
    """Read an ASCII OFF file (also with normals, colours or texture coordinates, which are passed over).

    Raises:
        UnreadableMeshError: For whatever is wrong with it.
    """
    from trimesh.exchange.off import load_off

    lines = _content_lines(decode_text(file.read()))
    vertex_count, face_count, body = _read_counts(lines)
    vertices = body[:vertex_count]
    if any(len(line.split()) < 3 for line in vertices):
        raise UnreadableMeshError(
            "a vertex of the OFF file has fewer than 3 coordinates", remedy=EXPORT_AGAIN
        )
    faces, notes = fan_out(*_read_polygons(body[vertex_count : vertex_count + face_count]))
    _require_indices(faces, vertex_count)
    rows = "\n".join(f"3 {a} {b} {c}" for a, b, c in faces.tolist()).encode()
    text = b"OFF\n%d %d 0\n" % (vertex_count, len(faces)) + b"\n".join(vertices) + b"\n" + rows
    with strict_numbers():
        found = load_off(BytesIO(text))
    return Parsed(narrow(found["vertices"]), found["faces"].reshape(-1, 3), notes)


def _content_lines(text: bytes) -> list[bytes]:
    lines = (line.split(b"#", 1)[0].strip() for line in text.split(b"\n"))
    return [line for line in lines if line]


def _read_counts(lines: list[bytes]) -> tuple[int, int, list[bytes]]:
    """The numbers of vertices and faces, and the lines after them, of which there are enough."""
    keyword = KEYWORD.match(lines[0]) if lines else None
    if keyword is None:
        raise UnreadableMeshError("not an ASCII OFF file: it does not begin with OFF")
    rest = lines[0][keyword.end() :].strip()
    lines = [rest, *lines[1:]] if rest else lines[1:]
    counts = lines[0].split()[:2] if lines else []
    if len(counts) < 2 or not all(re.fullmatch(rb"\d{1,18}", one) for one in counts):
        raise UnreadableMeshError("the OFF file has no line with its counts", remedy=EXPORT_AGAIN)
    vertices, faces = (int(one) for one in counts)
    if vertices + faces > len(lines) - 1:
        raise UnreadableMeshError(
            f"the OFF file announces {vertices} vertices and {faces} faces,"
            f" but only {len(lines) - 1} lines follow",
            remedy="the file is cut short or its counts are wrong",
        )
    return vertices, faces, lines[1:]


def _read_polygons(lines: list[bytes]) -> tuple[np.ndarray, np.ndarray]:
    rows = [line.split() for line in lines]
    lengths = numbers(b" ".join(row[0] for row in rows), np.int64)
    for k, (row, length) in enumerate(zip(rows, lengths, strict=True)):
        if not 0 <= length < len(row):
            raise UnreadableMeshError(
                f"face {k} of the OFF file has another length than it says", remedy=EXPORT_AGAIN
            )
    corners = b" ".join(b" ".join(row[1 : 1 + length]) for row, length in zip(rows, lengths, strict=True))
    return lengths, numbers(corners, np.int64)


def _require_indices(faces: np.ndarray, vertex_count: int) -> None:
    from striptools.mesh.mesh import first_face_out_of_range

    bad = first_face_out_of_range(faces, vertex_count)
    if bad is not None:
        raise UnreadableMeshError(f"face {bad} names a vertex that does not exist", remedy=EXPORT_AGAIN)
