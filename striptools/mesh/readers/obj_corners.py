"""What an OBJ file says beside positions and faces: vt, vn, colours, o, g, usemtl, mtllib.

Nothing here refuses a file: what makes no sense is left out and a note says so.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from striptools.errors import UnreadableMeshError
from striptools.mesh.attributes import (
    MOST_MATERIALS,
    WHITE,
    WIDTHS,
    Attribute,
    Material,
    Name,
    number_materials,
    tidy_name,
)
from striptools.mesh.readers.parsed import Fans, counted, decode_text, left_out, numbers

GROUP_LINE = re.compile(rb"^[ \t]*(o|g|usemtl|mtllib)(?:[ \t]+(.*))?$", re.MULTILINE)
VALUE_LINES: dict[Name, re.Pattern[bytes]] = {
    "texcoord": re.compile(rb"^[ \t]*vt[ \t]+(.*)$", re.MULTILINE),
    "normal": re.compile(rb"^[ \t]*vn[ \t]+(.*)$", re.MULTILINE),
}
LARGEST_LIBRARY = 1 << 24
"""Bytes of a material file that are read at most."""

Notes = tuple[str, ...]


def read_corner_values(
    text: bytes, face_line: re.Pattern[bytes], fans: Fans
) -> tuple[tuple[Attribute, ...], Notes]:
    """The texture coordinates and normals that the faces' corners name, a row a corner.

    Args:
        text: The file, without comments and continued lines.
        face_line: Finds the corners of each face.
        fans: How the faces were cut.
    """
    values = {name: pattern.findall(text) for name, pattern in VALUE_LINES.items()}
    if not any(values.values()):
        return (), ()
    faces = face_line.findall(text)
    indices = _corner_indices(b" ".join(faces))
    if indices is None:
        return (), ("texture coordinates and normals left out: the faces name them in no known way",)
    lengths = [len(line.split()) for line in faces]
    found, notes = [], ()
    columns: tuple[tuple[Name, int], ...] = (("normal", 2), ("texcoord", 1))
    for name, column in columns:
        if values[name] and indices[:, column].any():
            before = _lines_before(text, VALUE_LINES[name], face_line, lengths, indices[:, column])
            one, more = _corner_attribute(name, values[name], before, fans)
            found, notes = found + one, notes + more
    return tuple(found), notes


def read_colours(lines: list[bytes]) -> tuple[tuple[Attribute, ...], Notes]:
    """The colours that stand behind the coordinates, x y z r g b, where every vertex has one."""
    coloured = sum(len(line.split()) == 6 for line in lines)
    if not coloured:
        return (), ()
    try:
        table = numbers(b" ".join(lines)).reshape(len(lines), -1) if coloured == len(lines) else None
    except (UnreadableMeshError, ValueError):
        table = None
    if table is None:
        return (), (f"the colours of {counted(coloured, 'vertex', 'vertices')} left out: not every one has",)
    with np.errstate(over="ignore"):
        return (Attribute("color", "vertex", table[:, 3:6].astype(np.float32)),), ()


def read_groups(
    text: bytes, face_line: re.Pattern[bytes], fans: Fans, folder: Path | None
) -> tuple[tuple[Attribute, ...], tuple[Material, ...], Notes]:
    """The objects, groups and materials of the faces, as one number a triangle, and what they stand for."""
    lines = [(line.start(), line[1], line[2] or b"") for line in GROUP_LINE.finditer(text)]
    if not any(word != b"mtllib" for _, word, _ in lines):
        return (), (), ()
    starts, states = _group_states(lines)
    faces = np.array([line.start() for line in face_line.finditer(text)], np.int64)
    state = np.searchsorted(np.array(starts, np.int64), faces, side="right")[fans.polygons]
    colours, notes = _read_libraries([name for _, word, name in lines if word == b"mtllib"], folder)
    materials = [Material(name, colours.get(name, WHITE), group) for name, group in states]
    groups, used = number_materials(materials, state)
    if len(used) > MOST_MATERIALS:
        return (), (), (*notes, f"{len(used)} groups left out: at most {MOST_MATERIALS} are kept")
    return (Attribute("group", "face", groups),), used, notes


def _corner_indices(corners: bytes) -> np.ndarray | None:
    """`(corners, 3)` int64: position, texture coordinate, normal; 0 where there is none."""
    marked = re.sub(rb"/(?=\s|$)", b"/0", corners.replace(b"//", b"/0/"))
    stream = np.frombuffer(marked, np.uint8)
    blank = (stream == 32) | ((stream >= 9) & (stream <= 13))
    begins = ~blank
    begins[1:] &= blank[:-1]
    token = np.cumsum(begins) - 1
    slashes = np.bincount(token[stream == ord("/")], minlength=int(np.count_nonzero(begins)))
    try:
        found = numbers(marked.replace(b"/", b" "), np.int64)
    except UnreadableMeshError:
        return None
    if len(found) != len(slashes) + slashes.sum():
        return None
    place = np.arange(len(slashes)) + np.cumsum(slashes) - slashes
    indices = np.zeros((len(slashes), 3), np.int64)
    for k in range(3):
        there = slashes >= k
        indices[there, k] = found[place[there] + k]
    return indices


def _lines_before(
    text: bytes,
    value_line: re.Pattern[bytes],
    face_line: re.Pattern[bytes],
    lengths: list[int],
    indices: np.ndarray,
) -> np.ndarray:
    """Indices from 0, those that count back from their face's line resolved; -1 where there is none."""
    if indices.min() >= 0:
        return indices - 1
    values = np.array([line.start() for line in value_line.finditer(text)], np.int64)
    faces = np.array([line.start() for line in face_line.finditer(text)], np.int64)
    before = np.repeat(np.searchsorted(values, faces), lengths)
    back = np.where(indices + before < 0, -2, indices + before)
    return np.where(indices < 0, back, indices - 1)


def _corner_attribute(
    name: Name, lines: list[bytes], indices: np.ndarray, fans: Fans
) -> tuple[list[Attribute], Notes]:
    width = WIDTHS[name][0]
    # A texture coordinate may stand alone, its second number being 0 then, or have a third.
    rows = [line.split()[:width] for line in lines]
    rows = [row + [b"0"] * (width - len(row)) if name == "texcoord" else row for row in rows]
    try:
        table = numbers(b" ".join(b" ".join(row) for row in rows)).reshape(len(rows), width)
    except (UnreadableMeshError, ValueError):
        return [], (f"{counted(len(lines), name, name + 's')} left out: one makes no sense",)
    deep = sum(len(line.split()) > width for line in lines)
    notes = (f"further numbers of {counted(deep, name, name + 's')} left out",) if deep else ()
    chosen = indices[fans.corners.reshape(-1)]
    wrong = int(np.count_nonzero((chosen < -1) | (chosen >= len(table))))
    if wrong:
        notes += (f"{counted(wrong, 'corner names', 'corners name')} a {name} that does not exist",)
    there = (chosen >= 0) & (chosen < len(table))
    values = np.full((len(chosen), width), np.nan, np.float32)
    with np.errstate(over="ignore"):
        values[there] = table[chosen[there]].astype(np.float32)
    return ([Attribute(name, "corner", values)] if there.any() else []), notes


def _group_states(lines: list[tuple[int, bytes, bytes]]) -> tuple[list[int], list[tuple[str, str]]]:
    """Where the material or group changes, and their names before the first change and after each."""
    material = group = part = ""
    starts: list[int] = []
    states = [("", "")]
    for start, word, rest in lines:
        name = tidy_name(rest.decode("utf-8", "replace"))
        if word == b"mtllib":
            continue
        if word == b"usemtl":
            material = name
        elif word == b"o":
            part, group = name, ""
        else:
            group = name
        starts.append(start)
        states.append((material, tidy_name("/".join(one for one in (part, group) if one))))
    return starts, states


def _read_libraries(names: list[bytes], folder: Path | None) -> tuple[dict[str, tuple], Notes]:
    """The base colours of the materials in the files named, and notes on files and textures left out."""
    colours: dict[str, tuple] = {}
    missing, textures = [], 0
    for raw in dict.fromkeys(names):
        name = raw.decode("utf-8", "replace").strip()
        data = _read_beside(name, folder)
        if data is None:
            missing.append(name)
        else:
            textures += _read_library(data, colours)
    notes = left_out(missing, "material file", "material files")
    if textures:
        notes += (f"{counted(textures, 'texture', 'textures')} of materials left out",)
    return colours, notes


def _read_beside(name: str, folder: Path | None) -> bytes | None:
    """The bytes of a file in the folder or below, or None where there is none to be read."""
    if folder is None or not name:
        return None
    try:
        root = folder.resolve()
        path = (root / name.replace("\\", "/")).resolve()
        if not path.is_relative_to(root) or not path.is_file() or path.stat().st_size > LARGEST_LIBRARY:
            return None
        return decode_text(path.read_bytes())
    except (OSError, ValueError, UnreadableMeshError):
        return None


def _read_library(text: bytes, colours: dict[str, tuple]) -> int:
    """Note the colour and opacity of each material; returns how many textures there are."""
    name, textures = None, 0
    for line in text.split(b"\n"):
        word, _, rest = line.strip().partition(b" ")
        if word == b"newmtl":
            name = tidy_name(rest.decode("utf-8", "replace"))
            colours.setdefault(name, WHITE)
        elif word.lower().startswith((b"map_", b"bump", b"disp", b"refl")):
            textures += 1
        elif name is not None and word in (b"Kd", b"d", b"Tr"):
            colours[name] = _changed(colours[name], word, rest)
    return textures


def _changed(colour: tuple, word: bytes, rest: bytes) -> tuple:
    """A colour with Kd, d or Tr taken in; as it was where that makes no sense."""
    try:
        values = [float(one) for one in rest.split()]
    except ValueError:
        return colour
    if not values or not all(0.0 <= one <= 1.0 for one in values):
        return colour
    if word == b"Kd":
        return (*(values if len(values) == 3 else values[:1] * 3), colour[3])
    return (*colour[:3], values[0] if word == b"d" else 1.0 - values[0])
