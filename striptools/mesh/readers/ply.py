"""PLY, binary and ASCII.

The header is read here and checked against the size of the file before anything is allocated. A binary file
whose lists all have one length, the ordinary case, goes through trimesh. trimesh refuses lists of several
lengths in a binary file, trusts the first list's length for all others, splits vertices by texture coordinate
and turns the order of mixed polygons about; so what its fast path does not read faithfully, and all ASCII
files, are walked row by row (kernels/rows.py). A test holds the two ways equal. What other columns say is
decided in ply_columns.py.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import IO

import numpy as np

from striptools.errors import UnreadableMeshError
from striptools.mesh.readers.parsed import (
    EXPORT_AGAIN,
    Fans,
    Parsed,
    counted,
    fan_out,
    file_size,
    left_out,
    numbers,
    strict_numbers,
)
from striptools.mesh.readers.ply_columns import (
    WEDGES,
    Columns,
    Read,
    columns_note,
    face_attributes,
    vertex_attributes,
)

LONGEST_HEADER = 1 << 20
INDEX_NAMES = ("vertex_indices", "vertex_index")
SIZES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"}
SIZES |= {"float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"}
SIZES |= {"int32": "i4", "uint32": "u4", "int64": "i8", "uint64": "u8", "float32": "f4", "float64": "f8"}
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}


@dataclass(frozen=True)
class Property:
    """A column of an element: a number, or a list with a number of entries before it."""

    name: str
    dtype: np.dtype
    count: np.dtype | None = None

    @property
    def least_size(self) -> int:
        """The fewest bytes a row's share can take."""
        return (self.count or self.dtype).itemsize


@dataclass(frozen=True)
class Element:
    """A table of the file."""

    name: str
    rows: int
    properties: tuple[Property, ...]

    @property
    def has_list(self) -> bool:
        """Whether rows may differ in size."""
        return any(column.count for column in self.properties)

    @property
    def least_size(self) -> int:
        """The fewest bytes a row can take."""
        return sum(column.least_size for column in self.properties)

    def find(self, *names: str) -> int:
        """The number of the first property with one of the names, or -1."""
        return next((k for k, column in enumerate(self.properties) if column.name in names), -1)

    def others(self, *names: str) -> Columns:
        """The columns of other names, with their types; None for lists."""
        found: Columns = {}
        for one in self.properties:
            if one.name not in names:
                found.setdefault(one.name, None if one.count else one.dtype)
        return found


@dataclass(frozen=True)
class Header:
    """The header of a PLY file: byte order ("" for ASCII), its tables, where their rows begin, textures."""

    order: str
    elements: tuple[Element, ...]
    end: int
    textures: tuple[str, ...] = ()

    def element(self, name: str) -> Element:
        """The element of a name; an empty one where there is none."""
        return next((one for one in self.elements if one.name == name), Element(name, 0, ()))


def read_ply(file: IO[bytes]) -> Parsed:
    """Read a PLY file: the vertices' x, y, z, the faces' vertex indices, and what else is known of them.

    N-gons are cut into fans.

    Raises:
        UnreadableMeshError: For whatever is wrong with it.
    """
    size = file_size(file)
    header = parse_header(file.read(min(size, LONGEST_HEADER)))
    check_sizes(header, size)
    if header.order and not header.element("vertex").has_list:
        parsed = _through_trimesh(file, header)
        if parsed is not None:
            return parsed
    file.seek(header.end)
    return walk_tables(file.read(), header)


def parse_header(text: bytes) -> Header:
    """Read the header at the start of `text`.

    Raises:
        UnreadableMeshError: Where it is none, or names a type or format that PLY does not have.
    """
    if not re.match(rb"ply[ \t]*\r?\n", text):
        raise UnreadableMeshError("not a PLY file: it does not begin with a line `ply`")
    closing = re.search(rb"^end_header[ \t]*(\r\n|\n|\r(?!\n))", text, re.MULTILINE)
    if closing is None:
        raise UnreadableMeshError("the PLY header never ends", remedy=EXPORT_AGAIN)
    order = None
    elements: list[tuple[str, int, list[Property]]] = []
    textures = []
    for line in text[: closing.start()].decode("latin-1").splitlines()[1:]:
        words = line.split()
        if words[:1] == ["format"]:
            order = FORMATS.get(" ".join(words[1:2]))
        elif words[:1] == ["element"]:
            elements.append(_parse_element(line, words))
        elif words[:1] == ["property"]:
            if not elements:
                raise UnreadableMeshError(
                    "a property before any element in the PLY header", remedy=EXPORT_AGAIN
                )
            elements[-1][2].append(_parse_property(line, words, order or "<"))
        elif words[:2] == ["comment", "TextureFile"]:
            textures.append(" ".join(words[2:]))
    if order is None:
        raise UnreadableMeshError("the PLY header names no known format", remedy=EXPORT_AGAIN)
    tables = tuple(Element(name, rows, tuple(columns)) for name, rows, columns in elements)
    return Header(order, tables, closing.end(), tuple(textures))


def check_sizes(header: Header, size: int) -> None:
    """Raise where the rows that the header announces cannot fit in a file of `size` bytes.

    An ASCII row takes two bytes a value at least. So whatever passes is bounded by the size of the file.
    """
    left = size - header.end
    for element in header.elements:
        least = element.least_size if header.order else 2 * len(element.properties)
        if not element.properties and element.rows:
            raise UnreadableMeshError(f"the PLY element {element.name} has rows but no properties")
        # The last row of an ASCII file may lack its line end.
        if element.rows * least > left + (not header.order):
            raise UnreadableMeshError(
                f"the PLY header announces {element.rows} rows of `{element.name}`,"
                f" but only {max(left, 0)} bytes follow",
                remedy="the file is cut short or its header is wrong",
            )
        left -= element.rows * least


def walk_tables(data: bytes, header: Header) -> Parsed:
    """Read the tables behind a header row by row, whatever the lengths of their lists."""
    stream = np.frombuffer(data, np.uint8) if header.order else numbers(data)
    positions, polygons = np.zeros((0, 3), np.float32), (np.zeros(0, np.int64), np.zeros(0, np.int64))
    vertices = faces = None
    place = 0
    for element in header.elements:
        if element.name == "vertex":
            positions = _read_positions(stream, place, element, header)
            vertices = element, partial(_plain_column, stream, place, element, header)
        target = element.find(*INDEX_NAMES) if element.name == "face" else -1
        starts, lengths, after = _walk(stream, place, element, header, target)
        if target >= 0:
            polygons = lengths, _gather(stream, starts, lengths, element.properties[target], header)
            faces = element, partial(_entries, stream, place, element, header)
        place = after
    fans = fan_out(polygons[0])
    notes = fans.notes
    if place < len(stream):
        what = "byte" if header.order else "number"
        notes += (f"{counted(len(stream) - place, what, what + 's')} after the last element ignored",)
    parsed = Parsed(positions, polygons[1][fans.corners], notes)
    if vertices is None or faces is None:
        return parsed
    wedges = partial(_pairs, faces[1], polygons[0])
    return _with_attributes(parsed, vertices, (faces[0], partial(_singles, faces[1])), wedges, fans, header)


def _with_attributes(
    parsed: Parsed,
    vertices: tuple[Element, Read],
    faces: tuple[Element, Read],
    wedges: Callable[[str], np.ndarray | None],
    fans: Fans | Callable[[], Fans],
    header: Header,
) -> Parsed:
    """The mesh with what its other columns say; the same mesh where it has no others."""
    own, others = vertices[0].others("x", "y", "z"), faces[0].others(*INDEX_NAMES)
    if not own and not others and not header.textures:
        return parsed
    attributes, names = vertex_attributes(own, vertices[1])
    if others:
        fans = fans if isinstance(fans, Fans) else fans()
        more, left = face_attributes(others, faces[1], wedges, fans, {one.name for one in attributes})
        attributes, names = attributes + more, names + left
    notes = parsed.notes + columns_note(names) + left_out(header.textures, "texture", "textures")
    return Parsed(parsed.positions, parsed.faces, notes, tuple(attributes))


def _parse_element(line: str, words: list[str]) -> tuple[str, int, list[Property]]:
    if len(words) != 3 or not re.fullmatch(r"\d{1,18}", words[2]):
        raise UnreadableMeshError(f"the PLY header line `{line[:60]}` makes no sense", remedy=EXPORT_AGAIN)
    return words[1], int(words[2]), []


def _parse_property(line: str, words: list[str], order: str) -> Property:
    is_list = words[1:2] == ["list"]
    types = words[2:4] if is_list else words[1:2]
    if len(words) != (5 if is_list else 3) or not all(one in SIZES for one in types):
        raise UnreadableMeshError(f"the PLY header line `{line[:60]}` makes no sense", remedy=EXPORT_AGAIN)
    dtypes = [np.dtype(order + SIZES[one]) for one in types]
    if is_list and dtypes[0].kind == "f":
        raise UnreadableMeshError(
            f"the PLY header line `{line[:60]}` counts in floating point", remedy=EXPORT_AGAIN
        )
    return Property(words[-1], dtypes[-1], dtypes[0] if is_list else None)


def _through_trimesh(file: IO[bytes], header: Header) -> Parsed | None:
    """The mesh by trimesh, or None where its reader is not faithful to this file or refuses it."""
    from trimesh.exchange.ply import load_ply

    face = header.element("face")
    column = face.find(*INDEX_NAMES)
    if column < 0 or face.rows == 0 or len({one.name for one in header.elements}) < len(header.elements):
        return None
    file.seek(0)
    try:
        with strict_numbers():
            raw = load_ply(file, skip_materials=True, fix_texture=False)["metadata"]["_ply_raw"]
    except (ValueError, TypeError, KeyError, IndexError):
        return None
    vertices, rows = raw["vertex"]["data"], raw["face"]["data"][face.properties[column].name]
    if (
        rows.dtype.names is None
        or rows["f1"].ndim != 2
        or rows["f1"].shape[1] != 3
        or (rows["f0"] != 3).any()
    ):
        return None
    parsed = Parsed(_stack_axes([vertices[axis] for axis in "xyz"]), rows["f1"])
    return _with_columns(parsed, vertices, raw["face"]["data"], header)


def _with_columns(parsed: Parsed, vertices: np.ndarray, faces: np.ndarray, header: Header) -> Parsed | None:
    """The mesh of triangles with what its other columns say, or None where their lists have other lengths."""
    element = header.element("face")

    def wedges(name: str) -> np.ndarray | None:
        return faces[name]["f1"].reshape(-1, 2)

    for name in WEDGES:
        pairs = faces[name] if element.others().get(name, 0) is None else None
        if pairs is not None and (pairs["f1"].shape[1:] != (6,) or (pairs["f0"] != 6).any()):
            return None
    return _with_attributes(
        parsed,
        (header.element("vertex"), lambda name: vertices[name]),
        (element, lambda name: faces[name]),
        wedges,
        lambda: fan_out(np.full(element.rows, 3)),
        header,
    )


def _stack_axes(axes: list[np.ndarray]) -> np.ndarray:
    """Three columns as positions: float32 where each is stored in no more than that, else float64."""
    narrow = all(np.can_cast(axis.dtype, np.float32, "safe") for axis in axes)
    positions = np.zeros((len(axes[0]), 3), np.float32 if narrow else np.float64)
    for k, axis in enumerate(axes):
        positions[:, k] = axis
    return positions


def _read_positions(stream: np.ndarray, place: int, element: Element, header: Header) -> np.ndarray:
    columns = [element.find(axis) for axis in "xyz"]
    if min(columns) < 0 or element.has_list:
        raise UnreadableMeshError("the PLY vertices have no plain x, y and z", remedy=EXPORT_AGAIN)
    table = _plain_table(stream, place, element, header)
    if header.order:
        return _stack_axes([table[f"column{k}"] for k in columns])
    with np.errstate(over="ignore"):
        return _stack_axes([table[:, k].astype(element.properties[k].dtype) for k in columns])


def _plain_table(stream: np.ndarray, place: int, element: Element, header: Header) -> np.ndarray:
    """The rows of an element without lists: of named columns, or of numbers in an ASCII file."""
    if header.order:
        row = np.dtype([(f"column{k}", one.dtype) for k, one in enumerate(element.properties)])
        return np.frombuffer(stream, row, element.rows, place)
    table = stream[place : place + element.rows * len(element.properties)]
    if len(table) < element.rows * len(element.properties):
        raise UnreadableMeshError("the PLY file ends among its vertices", remedy="the file is cut short")
    return table.reshape(element.rows, -1)


def _plain_column(
    stream: np.ndarray, place: int, element: Element, header: Header, name: str
) -> np.ndarray | None:
    """A column of an element without lists, in its own type; None where it does not fit that."""
    table, k = _plain_table(stream, place, element, header), element.find(name)
    return table[f"column{k}"] if header.order else _fitted(table[:, k], element.properties[k].dtype)


def _entries(
    stream: np.ndarray, place: int, element: Element, header: Header, name: str
) -> tuple[np.ndarray, np.ndarray | None]:
    """How many entries a column has in each row, and all of them; None where one does not fit its type."""
    k = element.find(name)
    starts, lengths, _ = _walk(stream, place, element, header, k)
    found = _gather_entries(stream, starts, lengths, element.properties[k], header)
    return lengths, found if header.order else _fitted(found, element.properties[k].dtype)


def _singles(entries: Callable[[str], tuple[np.ndarray, np.ndarray | None]], name: str) -> np.ndarray | None:
    return entries(name)[1]


def _pairs(
    entries: Callable[[str], tuple[np.ndarray, np.ndarray | None]], lengths: np.ndarray, name: str
) -> np.ndarray | None:
    """The pairs of a list column, where there is one a corner."""
    found, values = entries(name)
    return None if values is None or (found != 2 * lengths).any() else values.reshape(-1, 2)


def _fitted(values: np.ndarray, dtype: np.dtype) -> np.ndarray | None:
    """Numbers of text as the type that the header gives them."""
    if dtype.kind != "f":
        least, most = np.iinfo(dtype).min, np.iinfo(dtype).max
        if not ((values >= least) & (values <= most)).all():
            return None
    with np.errstate(over="ignore"):
        return values.astype(dtype)


def _walk(
    stream: np.ndarray, place: int, element: Element, header: Header, target: int
) -> tuple[np.ndarray, np.ndarray, int]:
    """Where the target list of each row begins, how long it is, and where the next element begins."""
    from striptools.kernels.rows import walk_bytes, walk_numbers

    lists = np.array([one.count is not None for one in element.properties])
    starts = np.zeros(element.rows if target >= 0 else 0, np.int64)
    lengths = np.zeros_like(starts)
    if not element.has_list:
        width = element.least_size if header.order else len(element.properties)
        end = place + element.rows * width
        bad = -1 if end <= len(stream) else element.rows - 1
    elif header.order:
        widths = np.array([one.dtype.itemsize for one in element.properties])
        count_widths = np.array([one.count.itemsize if one.count else 0 for one in element.properties])
        signed = np.array([one.count.kind == "i" if one.count else False for one in element.properties])
        layout = np.stack([widths, count_widths, signed], axis=1).astype(np.int64)
        end, bad = walk_bytes(
            stream, place, element.rows, layout, header.order == ">", target, starts, lengths
        )
    else:
        end, bad = walk_numbers(stream, place, element.rows, lists, target, starts, lengths)
    if bad >= 0:
        raise UnreadableMeshError(
            f"row {bad} of `{element.name}` does not fit in the PLY file",
            remedy="the file is cut short or a list's length is wrong",
        )
    return starts, lengths, int(end)


def _gather(
    stream: np.ndarray, starts: np.ndarray, lengths: np.ndarray, column: Property, header: Header
) -> np.ndarray:
    """The entries of all target lists, one after another, as indices."""
    found = _gather_entries(stream, starts, lengths, column, header)
    if found.dtype.kind == "f" and not ((np.abs(found) < 2**53) & (found == np.floor(found))).all():
        raise UnreadableMeshError("a PLY vertex index is no number that an index can be", remedy=EXPORT_AGAIN)
    return found.astype(np.int64)


def _gather_entries(
    stream: np.ndarray, starts: np.ndarray, lengths: np.ndarray, column: Property, header: Header
) -> np.ndarray:
    from striptools.kernels.rows import gather_runs

    if header.order:
        return gather_runs(stream, starts, lengths * column.dtype.itemsize).view(column.dtype)
    return gather_runs(stream, starts, lengths)
