"""Attributes of a scene: a table of distinct rows and, bit-packed, which one each vertex, corner or face has.

The layout and its reasons are in formats/reducem/SPEC.md, sections 4.7 and 4.8. A model has few normals and
colours for its corners, or as many as vertices; either way a row is stored once.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from striptools.errors import LimitError
from striptools.mesh.attributes import (
    DOMAINS,
    DTYPES,
    MOST_MATERIALS,
    WIDTHS,
    Attribute,
    Domain,
    Material,
    Name,
    distinct_rows,
    first_equal,
)
from striptools.mesh.mesh import Mesh
from striptools.reducem import layout
from striptools.reducem.issues import unreadable
from striptools.strips.topology import Strips
from striptools.types import Faces

__all__ = ["Column", "check_columns", "check_materials", "columns_of", "decode_columns", "encode_columns"]

KINDS: dict[bytes, Name] = {b"NORM": "normal", b"TEXC": "texcoord", b"COLR": "color", b"GRUP": "group"}
TYPES = ("<f4", "u1", "<u2", "<u4")
"""Of the values, by their code."""

CHUNK = 1 << 16
"""Numbers packed at a time; a multiple of 8, so that each time begins at a byte."""


@dataclass(frozen=True, eq=False)
class Column:
    """An attribute as a scene holds it.

    Args:
        name: As in `Attribute`.
        domain: A row a block vertex (`vertex`), a corner of each triangle as decoded (`corner`), or a
            triangle in file order (`face`).
        rows: `(m, k)` the distinct values in order of first use, none twice.
        numbers: `(entries,)` int32, the row of each vertex, corner or triangle.
    """

    name: Name
    domain: Domain
    rows: np.ndarray
    numbers: np.ndarray

    @cached_property
    def attribute(self) -> Attribute:
        """The values themselves."""
        return Attribute(self.name, self.domain, self.rows[self.numbers])

    @property
    def width(self) -> int:
        """Bits of a number in the file: none where there is one row, or one for each entry."""
        return index_width(len(self.rows), len(self.numbers))

    @property
    def byte_count(self) -> int:
        """Bytes in the file, the record left out."""
        return filled(self.rows.nbytes) + filled(-(-self.width * len(self.numbers) // 8))


def index_width(rows: int, entries: int) -> int:
    """The bits of a number of a row."""
    return 0 if rows == entries else (rows - 1).bit_length()


def filled(length: int) -> int:
    """A length filled up to words of four bytes."""
    return -(-length // 4) * 4


def columns_of(mesh: Mesh, strips: Strips, faces: Faces, vertex_count: int) -> tuple[Column, ...]:
    """The attributes of a mesh in the order of a scene of it.

    Args:
        mesh: The mesh that the strips are of.
        strips: Which face each triangle is, and how it is turned.
        faces: `(n, 3)` int32, the scene's triangles: places among its block vertices.
        vertex_count: How many block vertices there are.
    """
    turned = (np.arange(3) + strips.rotation[:, None]) % 3
    vertex = np.zeros(vertex_count, np.int32)
    vertex[faces.reshape(-1)] = np.take_along_axis(mesh.faces[strips.source_face], turned, axis=1).reshape(-1)
    corner = 3 * strips.source_face.astype(np.int64)[:, None] + turned
    places = {"vertex": vertex, "corner": corner.reshape(-1), "face": strips.source_face}
    return tuple(
        Column(one.name, one.domain, *distinct_rows(one.values[places[one.domain]]))
        for one in mesh.attributes
    )


def section_length(columns: Sequence[Column]) -> int:
    """Bytes of the section of some columns; 0 where there is none."""
    if not columns:
        return 0
    return layout.ATTRIBUTES_HEAD + sum(layout.ATTRIBUTE.size + one.byte_count for one in columns)


def encode_columns(columns: Sequence[Column]) -> bytes:
    """The section of some columns; no bytes where there is none."""
    if not columns:
        return b""
    records = np.zeros(len(columns), layout.ATTRIBUTE.dtype)
    parts = []
    for record, one in zip(records, columns, strict=True):
        kind = next(kind for kind, name in KINDS.items() if name == one.name)
        dtype = "<u4" if one.name == "group" else one.rows.dtype.newbyteorder("<").str.replace("|", "")
        record["name"], record["domain"] = kind, DOMAINS.index(one.domain)
        record["components"], record["type"] = one.rows.shape[1], TYPES.index(dtype)
        record["width"], record["rows"] = one.width, len(one.rows)
        data = one.rows.astype(dtype).tobytes()
        bits = _pack(one.numbers, one.width)
        parts += [data, bytes(-len(data) % 4), bits, bytes(-len(bits) % 4)]
    head = len(columns).to_bytes(4, "little") + bytes(4)
    return b"".join([head, records.tobytes(), *parts])


def decode_columns(raw: np.ndarray, entries: dict[Domain, int], where: str) -> tuple[Column, ...]:
    """The columns of a section.

    Args:
        raw: The bytes of the section, uint8.
        entries: How many vertices, corners and triangles the scene has.
        where: What errors name as their place.

    Raises:
        UnreadableSceneError: The section breaks a rule.
    """
    place = f"{where}: ATTR"
    if len(raw) < layout.ATTRIBUTES_HEAD:
        raise unreadable("RDM522", place)
    count, reserved = np.frombuffer(raw[: layout.ATTRIBUTES_HEAD].tobytes(), "<u4").tolist()
    if not 1 <= count <= len(KINDS):
        raise unreadable("RDM521", place)
    if reserved:
        raise unreadable("RDM107", place)
    at = layout.ATTRIBUTES_HEAD + count * layout.ATTRIBUTE.size
    if at > len(raw):
        raise unreadable("RDM522", place)
    columns = []
    for record in np.frombuffer(raw[layout.ATTRIBUTES_HEAD : at].tobytes(), layout.ATTRIBUTE.dtype):
        one, at = _decode_column(record, raw, at, entries, place)
        columns.append(one)
    if at != len(raw):
        raise unreadable("RDM522", place)
    return tuple(columns)


def check_columns(
    columns: Sequence[Column], entries: dict[Domain, int], materials: Sequence[Material], where: str
) -> None:
    """Make sure that columns keep the rules of the format.

    Raises:
        UnreadableSceneError: They do not.
    """
    place = f"{where}: ATTR"
    if len({one.name for one in columns}) < len(columns):
        raise unreadable("RDM521", place)
    for one in columns:
        if len(one.numbers) != entries[one.domain]:
            raise unreadable("RDM522", f"{place}: {one.name}")
        _check_numbers(one.numbers, len(one.rows), f"{place}: {one.name}")
        if (first_equal(one.rows) != np.arange(len(one.rows))).any():
            raise unreadable("RDM526", f"{place}: {one.name}")
    group = next((one for one in columns if one.name == "group"), None)
    if group is None and materials:
        raise unreadable("RDM117", f"{where}: MATL")
    if group is not None and not materials:
        raise unreadable("RDM113", f"{where}: MATL")
    if group is not None and not 0 <= group.rows.min() <= group.rows.max() < len(materials):
        raise unreadable("RDM528", f"{place}: group")


def encode_materials(materials: Sequence[Material]) -> bytes:
    """The section of some materials; no bytes where there is none.

    Raises:
        LimitError: They are more than the format can hold.
    """
    if not materials:
        return b""
    rows = [
        {"name": one.name, "base_color": list(one.base_color)} | ({"group": one.group} if one.group else {})
        for one in materials
    ]
    text = json.dumps(rows, ensure_ascii=False, allow_nan=False, separators=(",", ":"))
    data = text.encode("utf-8", "replace")
    if len(data) > layout.MATERIALS_LIMIT or len(rows) > MOST_MATERIALS:
        raise LimitError(f"{len(rows)} materials are too many", remedy="leave out all but the geometry")
    return data


def fitting(mesh: Mesh) -> Mesh:
    """The mesh without its groups, and with a note, where their materials are more than a scene can hold."""
    try:
        encode_materials(mesh.materials)
    except LimitError as error:
        kept = tuple(one for one in mesh.attributes if one.name != "group")
        note = f"groups left out: {error.what}"
        return replace(mesh, notes=(*mesh.notes, note), attributes=kept, materials=())
    return mesh


def check_materials(rows: Any, where: str) -> tuple[Material, ...]:
    """The materials of decoded JSON.

    Raises:
        UnreadableSceneError: They break a rule.
    """
    if not isinstance(rows, list) or not 1 <= len(rows) <= MOST_MATERIALS:
        raise unreadable("RDM531", f"{where}: MATL")
    materials = []
    for k, row in enumerate(rows):
        material = _material(row)
        if material is None:
            raise unreadable("RDM531", f"{where}: MATL: material {k}")
        materials.append(material)
    return tuple(materials)


def _material(row: Any) -> Material | None:
    if not isinstance(row, dict) or not row.keys() <= {"name", "base_color", "group"}:
        return None
    name, colour, group = row.get("name"), row.get("base_color"), row.get("group", "")
    if not isinstance(name, str) or not isinstance(group, str) or not isinstance(colour, list):
        return None
    numbers = [one for one in colour if isinstance(one, int | float) and not isinstance(one, bool)]
    if len(colour) != 4 or len(numbers) != 4 or not all(0 <= one <= 1 for one in numbers):
        return None
    red, green, blue, alpha = (float(one) for one in numbers)
    return Material(name, (red, green, blue, alpha), group)


def _decode_column(
    record: np.void, raw: np.ndarray, at: int, entries: dict[Domain, int], place: str
) -> tuple[Column, int]:
    """The column whose data begin at a byte, and where the next one's begin."""
    name, domain, dtype = _meaning(record, place)
    place = f"{place}: {name}"
    rows, width, count = int(record["rows"]), int(record["width"]), entries[domain]
    if not 1 <= rows <= count or width != index_width(rows, count):
        raise unreadable("RDM523", place)
    length = rows * int(record["components"]) * dtype.itemsize
    packed = math.ceil(width * count / 8)
    end = at + filled(length) + filled(packed)
    if end > len(raw):
        raise unreadable("RDM522", place)
    begin = at + filled(length)
    if raw[at + length : begin].any() or raw[begin + packed : end].any():
        raise unreadable("RDM527", place)
    table = np.frombuffer(raw[at : at + length].tobytes(), dtype).reshape(rows, -1)
    if name == "group" and table.max() >= 2**31:
        raise unreadable("RDM528", place)
    native = np.int32 if name == "group" else dtype.newbyteorder("=")
    numbers = _unpack(raw[begin : begin + packed], count, width, place)
    numbers = np.arange(count, dtype=np.int32) if rows == count else numbers
    _check_numbers(numbers, rows, place)
    return Column(name, domain, table.astype(native), numbers), end


def _meaning(record: np.void, place: str) -> tuple[Name, Domain, np.dtype]:
    name = KINDS.get(bytes(record["name"]))
    domain, kind, width = (int(record[key]) for key in ("domain", "type", "components"))
    if record["reserved"]:
        raise unreadable("RDM107", place)
    if name is None or domain >= len(DOMAINS) or kind >= len(TYPES) or width not in WIDTHS[name]:
        raise unreadable("RDM521", place)
    dtype = np.dtype(TYPES[kind])
    wanted = ("uint32",) if name == "group" else DTYPES[name]
    if dtype.newbyteorder("=").name not in wanted or (name == "group" and DOMAINS[domain] != "face"):
        raise unreadable("RDM521", place)
    return name, DOMAINS[domain], dtype


def _check_numbers(numbers: np.ndarray, rows: int, place: str) -> None:
    """Make sure that every number is a row's, each row used, and first used in order."""
    if len(numbers) == 0 or numbers.min() < 0 or numbers.max() >= rows:
        raise unreadable("RDM524", place)
    largest = np.maximum.accumulate(numbers)
    if numbers[0] != 0 or (np.diff(largest) > 1).any() or largest[-1] != rows - 1:
        raise unreadable("RDM525", place)


def _pack(numbers: np.ndarray, width: int) -> bytes:
    """Numbers of so many bits each, one behind the other, lowest bit first."""
    parts = []
    for begin in range(0, len(numbers) if width else 0, CHUNK):
        words = numbers[begin : begin + CHUNK].astype("<u4")
        bits = np.unpackbits(words.view(np.uint8).reshape(-1, 4), axis=1, bitorder="little")[:, :width]
        parts.append(np.packbits(bits.reshape(-1), bitorder="little").tobytes())
    return b"".join(parts)


def _unpack(data: np.ndarray, count: int, width: int, place: str) -> np.ndarray:
    """So many numbers of packed bytes, int32; the bits behind the last must be zero."""
    numbers = np.zeros(count, np.int32)
    step = CHUNK * width // 8
    for k in range(-(-count // CHUNK) if width else 0):
        bits = np.unpackbits(data[k * step : (k + 1) * step], bitorder="little")
        here = min(CHUNK, count - k * CHUNK)
        if bits[here * width :].any():
            raise unreadable("RDM527", place)
        wide = np.zeros((here, 32), np.uint8)
        wide[:, :width] = bits[: here * width].reshape(here, width)
        words = np.packbits(wide, axis=1, bitorder="little").view("<u4").reshape(-1)
        numbers[k * CHUNK : k * CHUNK + here] = words.view("<i4")
    return numbers
