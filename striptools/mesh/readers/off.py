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
from striptools.mesh.attributes import WIDTHS, Attribute, Name
from striptools.mesh.readers.parsed import (
    EXPORT_AGAIN,
    Fans,
    Parsed,
    counted,
    decode_text,
    fan_out,
    narrow,
    numbers,
    strict_numbers,
)

KEYWORD = re.compile(rb"(ST)?(CN?|NC?)?OFF\b", re.IGNORECASE)


def read_off(file: IO[bytes]) -> Parsed:
    """Read an ASCII OFF file, also with normals, colours or texture coordinates.

    Raises:
        UnreadableMeshError: For whatever is wrong with it.
    """
    from trimesh.exchange.off import load_off

    lines = _content_lines(decode_text(file.read()))
    kind, vertex_count, face_count, body = _read_counts(lines)
    vertices = body[:vertex_count]
    if any(len(line.split()) < 3 for line in vertices):
        raise UnreadableMeshError(
            "a vertex of the OFF file has fewer than 3 coordinates", remedy=EXPORT_AGAIN
        )
    polygons = [line.split() for line in body[vertex_count : vertex_count + face_count]]
    lengths, corners = _read_polygons(polygons)
    fans = fan_out(lengths)
    faces = corners[fans.corners]
    _require_indices(faces, vertex_count)
    rows = "\n".join(f"3 {a} {b} {c}" for a, b, c in faces.tolist()).encode()
    table = b"\n".join(vertices)
    if not table.isascii():
        raise UnreadableMeshError("text where a number should be", remedy=EXPORT_AGAIN)
    text = b"OFF\n%d %d 0\n" % (vertex_count, len(faces)) + table + b"\n" + rows
    with strict_numbers():
        found = load_off(BytesIO(text))
    attributes, notes = _read_attributes(kind, vertices, polygons, fans)
    return Parsed(
        narrow(found["vertices"]), found["faces"].reshape(-1, 3), fans.notes + notes, tuple(attributes)
    )


def _read_attributes(
    kind: bytes, vertices: list[bytes], polygons: list[list[bytes]], fans: Fans
) -> tuple[list[Attribute], tuple[str, ...]]:
    """What the columns behind positions and indices say, by the letters before OFF (Geomview's order)."""
    rows = [line.split()[3:] for line in vertices]
    found, notes = [], ()
    place = 3 if b"N" in kind else 0
    end = len(rows[0]) - (2 if kind.startswith(b"ST") else 0) if rows else 0
    columns: list[tuple[Name, bool, int, int]] = [
        ("normal", place > 0, 0, place),
        ("color", b"C" in kind, place, end),
        ("texcoord", kind.startswith(b"ST"), end, end + 2),
    ]
    for name, there, begin, stop in columns:
        values = _table([row[begin:stop] for row in rows], name) if there and stop >= begin else None
        if values is not None:
            found.append(Attribute(name, "vertex", values))
        elif there:
            notes += (f"the {name} of {counted(len(rows), 'vertex', 'vertices')} left out: not one for each",)
    behind = [row[1 + int(row[0]) :] for row in polygons]
    coloured = sum(bool(row) for row in behind)
    colours = _table(behind, "color") if coloured == len(behind) and b"C" not in kind else None
    if colours is not None:
        found.append(Attribute("color", "face", colours[fans.polygons]))
    elif coloured:
        notes += (f"the colours of {counted(coloured, 'face', 'faces')} left out",)
    return found, notes


def _table(rows: list[list[bytes]], name: Name) -> np.ndarray | None:
    """Equally long rows of numbers as values of an attribute, or None where they are not that."""
    width = len(rows[0]) if rows else 0
    if width not in WIDTHS[name] or any(len(row) != width for row in rows):
        return None
    try:
        values = numbers(b" ".join(b" ".join(row) for row in rows)).reshape(len(rows), width)
    except (UnreadableMeshError, ValueError):
        return None
    # Colours are whole numbers to 255 or fractions; a file that needs neither a point nor more is the first.
    whole = name == "color" and not any(b"." in one or b"e" in one.lower() for row in rows for one in row)
    if whole and not ((values >= 0) & (values <= 255)).all():
        return None
    with np.errstate(over="ignore"):
        return values.astype(np.uint8 if whole else np.float32)


def _content_lines(text: bytes) -> list[bytes]:
    lines = (line.split(b"#", 1)[0].strip() for line in text.split(b"\n"))
    return [line for line in lines if line]


def _read_counts(lines: list[bytes]) -> tuple[bytes, int, int, list[bytes]]:
    """The letters before OFF, the numbers of vertices and faces, the lines after: there are enough."""
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
    return keyword[0][:-3].upper(), vertices, faces, lines[1:]


def _read_polygons(rows: list[list[bytes]]) -> tuple[np.ndarray, np.ndarray]:
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
