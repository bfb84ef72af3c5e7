"""Read a scene file, or refuse it with one line; formats/reducem/SPEC.md is what it reads by.

A file is mapped and a stream is read, in pieces and never past one byte more than its header declares, so
that memory is bounded by the bytes that are really there: no count is believed that the file's length does
not bear out. Opening looks at the header and the section table. A section is looked at when it is first
asked for: its padding and checksums, its length by the counts, then the rules of what it holds.
`read_scene` asks for all.
"""

import io
import json
import mmap
import os
import re
import stat
import zlib
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import IO, Any

import numpy as np

from striptools.hierarchies.packed import BoxGrid, PackedNodes
from striptools.hierarchies.stored import StoredHierarchy
from striptools.mesh.attributes import Domain, Material
from striptools.reducem import check, layout
from striptools.reducem.archive import expanded, expanded_blocks
from striptools.reducem.attributes import Column, check_columns, check_materials, decode_columns
from striptools.reducem.blocks import Blocks, check_headers
from striptools.reducem.check_hierarchy import check_hierarchy
from striptools.reducem.geometries import (
    SceneGeometries,
    SceneInstances,
    check_faces,
    check_geometries,
    check_instance_rules,
    decode_geometries,
    decode_instances,
    roots_of,
)
from striptools.reducem.issues import unreadable
from striptools.reducem.plain_triangles import PlainTriangles, decode_triangles
from striptools.reducem.scene import Remap, Scene
from striptools.reducem.stored_hierarchy import decode_hierarchy

__all__ = ["PIECE", "open_scene", "read_scene"]

PIECE = 1 << 20
"""Bytes asked of a stream at once."""

MOST_TRIANGLES = (2**31 - 1) // 3
"""Strip vertices, at most three a triangle, are numbered in int32 here."""

LEVELS = 32
"""How deep metadata may be nested."""

Source = str | Path | bytes | bytearray | memoryview | IO[bytes]


def read_scene(source: Source) -> Scene:
    """Read a scene file and check all of it.

    Args:
        source: A path, the file's bytes, or a binary stream of it, which must end where the file does.

    Returns:
        The scene, every rule of the format checked.

    Raises:
        UnreadableSceneError: The file cannot be read or is no valid scene file; the line gives the
            place and an issue's code (formats/reducem/ISSUES.md).
        MissingExtraError: It is an archive, and its codec is not installed.
    """
    scene = open_scene(source)
    scene.check()
    return scene


def open_scene(source: Source) -> Scene:
    """Open a scene file: header and section table are checked now, all else when it is first asked for.

    Args:
        source: As for `read_scene`. A file is mapped, and must not be changed in place while the scene is
            used; a stream is read whole.

    Returns:
        A scene whose fields and methods may raise what `read_scene` raises; `scene.check()` checks all.

    Raises:
        UnreadableSceneError: The file cannot be read, or its header or section table is not valid.
    """
    if isinstance(source, bytes | bytearray | memoryview):
        return _File(_gather(io.BytesIO(source), "scene"), "scene").scene()
    if not isinstance(source, str | Path):
        where = str(getattr(source, "name", "the input stream"))
        return _File(_gather(source, where), where).scene()
    where = str(source)
    try:
        with Path(source).open("rb") as file:
            view = _mapped(file) or _gather(file, where)
    except (OSError, ValueError) as error:
        raise unreadable("RDM001", where) from error
    return _File(view, where).scene()


def _mapped(file: IO[bytes]) -> memoryview | None:
    """The bytes of a regular file, or None for what cannot be mapped.

    The mapping is private and may be written to, because kernels would be compiled a second time for arrays
    that may not.
    """
    status = os.fstat(file.fileno())
    if not stat.S_ISREG(status.st_mode) or status.st_size < layout.HEADER.size:
        return None
    return memoryview(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY))


def _gather(stream: IO[bytes], where: str) -> memoryview:
    data = bytearray()
    wanted = layout.HEADER.size
    header_seen = False
    while len(data) < wanted:
        try:
            piece = stream.read(min(PIECE, wanted - len(data)))
        except OSError as error:
            raise unreadable("RDM001", where) from error
        if not piece:
            break
        data += piece
        if len(data) >= layout.HEADER.size and not header_seen:
            header_seen = True
            wanted = int(_header(memoryview(data), where)["total_length"]) + 1
    return memoryview(data)


def _header(data: memoryview, where: str) -> np.void:
    if bytes(data[: len(layout.MAGIC)]) != layout.MAGIC[: len(data)]:
        raise unreadable("RDM102", where)
    if len(data) < layout.HEADER.size:
        raise unreadable("RDM101", where)
    header = np.frombuffer(bytes(data[: layout.HEADER.size]), layout.HEADER.dtype)[0]
    if (int(header["major"]), int(header["minor"])) != layout.VERSION:
        raise unreadable("RDM103", f"{where}: version {header['major']}.{header['minor']}")
    return header


@dataclass(frozen=True)
class _Entry:
    """A row of the section table, the end of the section before it, and its place for errors."""

    kind: bytes
    before: int
    place: str
    flags: int
    codec: int
    offset: int
    stored_length: int
    raw_length: int
    stored_checksum: int
    raw_checksum: int

    @property
    def end(self) -> int:
        return self.offset + self.stored_length


class _File:
    """A scene file's bytes and its section table, checked; and the way from its sections to a scene."""

    def __init__(self, view: memoryview, where: str) -> None:
        self.view, self.where = view, where
        self.entries = _table(view, where)

    def scene(self) -> Scene:
        scene = Scene.lazily(self.load, self.check)
        scene.__dict__["_where"] = self.where
        return scene

    def load(self, name: str, scene: Scene) -> object:
        """A field of the scene, checked."""
        loaders: dict[str, Callable[[], object]] = {
            "blocks": self.blocks,
            "packed": lambda: self.packed(scene),
            "remap": self.remap,
            "columns": lambda: self.columns(scene),
            "materials": self.materials,
            "metadata": self.metadata,
            "geometries": lambda: self.geometries(scene),
            "instances": lambda: self.instances(scene),
            "triangles": self.triangles,
            "hierarchy": lambda: self.hierarchy(scene),
        }
        return loaders[name]() if name in loaders else self.of_record(name)

    def check(self, scene: Scene) -> None:
        """Check all: the sections, those that are passed over too, and what they hold."""
        for entry in self.entries.values():
            self.stored(entry)
        check.check_scene(scene, self.where)

    def stored(self, entry: _Entry) -> memoryview:
        """The stored bytes of a section, it and the padding on both its sides checked."""
        for start, end in ((entry.before, entry.offset), (entry.end, layout.aligned(entry.end))):
            if any(self.view[start:end]):
                raise unreadable("RDM108", entry.place)
        payload = self.view[entry.offset : entry.end]
        if zlib.crc32(payload) != entry.stored_checksum:
            raise unreadable("RDM110", entry.place)
        return payload

    def section(self, section: layout.Section, least: int, most: int | None = None) -> np.ndarray:
        """The decoded bytes of a section, uint8; none where it is not there and need not be.

        Args:
            section: Which.
            least: The bytes that it must have by the counts; 0 where it must not be there.
            most: The most bytes, where it is not the least that it must have; such a section may be missing.
        """
        entry = self.entries.get(section.kind)
        place = f"{self.where}: {section.kind.decode()}"
        most = least if most is None else most
        if entry is None:
            if least:
                raise unreadable("RDM113", place)
            return np.zeros(0, np.uint8)
        if most == 0:
            raise unreadable("RDM117", place)
        if not least <= entry.raw_length <= most:
            raise unreadable(_TOO_LONG.get(section.kind, "RDM114"), place)
        payload = self.stored(entry)
        if entry.codec == layout.CODEC_RAW:
            return np.frombuffer(payload, np.uint8)
        if entry.codec == layout.CODEC_BLOCKS:
            given = (self.headers(), self.record["triangle_count"], entry.raw_length, self.where)
            raw = expanded_blocks(payload, *given).astype("<u4", copy=False).view(np.uint8)
        else:
            raw = expanded(payload, entry.codec, entry.kind, entry.raw_length, place)
        if zlib.crc32(raw.data) != entry.raw_checksum:
            raise unreadable("RDM122", place)
        return raw

    @cached_property
    def record(self) -> dict[str, Any]:
        """The scene record, the ranges of its fields checked."""
        raw = self.section(layout.SCENE, layout.SCENE_RECORD.size)
        row = np.frombuffer(raw.tobytes(), layout.SCENE_RECORD.dtype)[0]
        record = {field.name: row[field.name].tolist() for field in layout.SCENE_RECORD.fields}
        if record["triangle_count"] == 0 and raw[_BOUNDS].any():
            raise unreadable("RDM208", f"{self.where}: SCEN")
        _check_record(record, self.entries.keys(), f"{self.where}: SCEN")
        if record["triangle_count"] > MOST_TRIANGLES or record["source_face_count"] > 2**31 - 1:
            raise unreadable("RDM124", f"{self.where}: SCEN")
        return record

    def of_record(self, name: str) -> object:
        """A field of the scene that is in its record."""
        record = self.record
        triple = {key: [record[f"{key}_{axis}"] for axis in "xyz"] for key in ("low", "high", "cell")}
        low, high = np.array(triple["low"], np.float32), np.array(triple["high"], np.float32)
        fields: dict[str, object] = {
            "grid": BoxGrid(low, np.array(triple["cell"], np.int32)),
            "low": low,
            "high": high,
            "grid_exponent": record["grid_exponent"] if record["flags"] & layout.ON_GRID else None,
            "error_bound": record["error_bound"],
            "source_face_count": record["source_face_count"],
            "origin": np.array([record[f"origin_{axis}"] for axis in "xyz"])
            if record["flags"] & layout.HAS_ORIGIN
            else None,
        }
        return fields.get(name)

    def headers(self) -> np.ndarray:
        """The headers of blocks as they are stored, (b, 8) uint32."""
        raw = self.section(layout.BLOCK_HEADERS, layout.BLOCK_HEADER.size * self.record["block_count"])
        return _array(raw, "<u4", np.uint32).reshape(-1, 8)

    def blocks(self) -> Blocks:
        """The blocks, their headers checked."""
        count, headers = self.record["block_count"], self.headers()
        most = layout.MOST_BLOCK_BYTES * count + layout.MOST_BEHIND_BLOCKS if count else 0
        words = self.section(layout.BLOCK_DATA, layout.ALIGNMENT if count else 0, most)
        if len(words) % 4:
            raise unreadable("RDM606", f"{self.where}: BLKD")
        blocks = Blocks(headers, _array(words, "<u4", np.uint32))
        if count:
            check_headers(blocks, self.record["triangle_count"], self.where)
        return blocks

    def packed(self, scene: Scene) -> PackedNodes:
        """The hierarchy, checked against the decoded blocks."""
        record, runs = self.record, None
        first_run = None
        nodes = self.section(layout.NODES, layout.NODE_RECORD.size * record["node_count"])
        blocks, run_count = record["block_count"], record["run_count"]
        stored = bool(record["flags"] & layout.BOXES_STORED)
        begin = layout.aligned(4 * blocks)
        rest = self.section(layout.RUNS, begin + 4 * run_count if stored else 0)
        if rest[4 * blocks : begin].any():
            raise unreadable("RDM108", f"{self.where}: RUNS")
        if stored:
            first_run = _array(rest[: 4 * blocks], "<u4", np.uint32)
            runs = _array(rest[begin:], "<u4", np.uint32)
        words = _array(nodes, "<u4", np.uint32).reshape(-1, 16)
        packed = PackedNodes(words, record["top_count"], first_run, runs, record["longest_run"])
        scene.__dict__["packed"] = packed
        try:
            check.check_nodes(scene, self.where)
        except BaseException:
            del scene.__dict__["packed"]
            raise
        return packed

    def remap(self) -> Remap | None:
        """The remap, checked."""
        count, faces = self.record["triangle_count"], self.record["source_face_count"]
        length = layout.remap_length(count)
        if layout.REMAP.kind not in self.entries:
            return None
        raw = self.section(layout.REMAP, length)
        packed = raw[4 * count :]
        rotation = np.stack([packed & 3, packed >> 2 & 3, packed >> 4 & 3, packed >> 6], axis=1).reshape(-1)
        if rotation[count:].any():
            raise unreadable("RDM504", f"{self.where}: RMAP")
        remap = Remap(_array(raw[: 4 * count], "<i4", np.int32), np.ascontiguousarray(rotation[:count]))
        check.check_remap(remap, count, faces, self.where)
        return remap

    def columns(self, scene: Scene) -> tuple[Column, ...]:
        """The attributes, checked."""
        count = self.record["triangle_count"]
        raw = self.section(layout.ATTRIBUTES, 0, layout.most_attribute_bytes(count) if count else 0)
        columns = ()
        if len(raw):
            entries: dict[Domain, int] = {"vertex": scene.vertex_count, "corner": 3 * count, "face": count}
            columns = decode_columns(raw, entries, self.where)
            check_columns(columns, entries, scene.materials, self.where)
        elif scene.materials:
            raise unreadable("RDM117", f"{self.where}: MATL")
        return columns

    def materials(self) -> tuple[Material, ...]:
        """What the groups stand for, checked."""
        most = layout.MATERIALS_LIMIT if self.record["triangle_count"] else 0
        raw = self.section(layout.MATERIALS, 0, most)
        return check_materials(self.json(raw, "MATL", "RDM531", "RDM531"), self.where) if len(raw) else ()

    def metadata(self) -> dict[str, Any]:
        """The metadata, checked."""
        raw = self.section(layout.METADATA, 0, layout.METADATA_LIMIT)
        if not len(raw):
            return {}
        metadata = self.json(raw, "META", "RDM901", "RDM904")
        check.check_metadata(metadata, self.where)
        return metadata

    def geometries(self, scene: Scene) -> SceneGeometries | None:
        """The geometries, checked."""
        size, record = layout.GEOMETRY.size, self.record
        is_other = layout.HIERARCHY.kind in self.entries
        raw = self.section(layout.GEOMETRIES, 0, 0 if is_other else size * record["block_count"])
        self.check_both()
        if not len(raw):
            return None
        if len(raw) % size:
            raise unreadable("RDM114", f"{self.where}: GEOM")
        geometries = decode_geometries(raw)
        roots = roots_of(geometries, record["block_count"], record["top_count"])
        starts = scene.blocks.triangle_starts
        check_geometries(geometries, roots, starts, record["source_face_count"], self.where)
        if scene.remap is not None:
            check_faces(geometries, roots, starts, scene.remap.face, self.where)
        return geometries

    def instances(self, scene: Scene) -> SceneInstances | None:
        """The instances, checked."""
        size = layout.INSTANCE.size
        is_other = layout.HIERARCHY.kind in self.entries
        most = size * layout.INSTANCE_LIMIT if self.record["triangle_count"] and not is_other else 0
        raw = self.section(layout.INSTANCES, 0, most)
        geometries = scene.geometries
        if geometries is None:
            return None
        if len(raw) % size:
            raise unreadable("RDM114", f"{self.where}: INST")
        instances = decode_instances(raw)
        check_instance_rules(instances, geometries, scene.low, scene.high, self.where)
        return instances

    def check_both(self) -> None:
        """Make sure that geometries and instances are both there, or neither is."""
        there = [section.kind in self.entries for section in (layout.GEOMETRIES, layout.INSTANCES)]
        if any(there) and not all(there):
            raise unreadable("RDM113", f"{self.where}: {'INST' if there[0] else 'GEOM'}")

    def triangles(self) -> PlainTriangles | None:
        """The plain triangles, checked by themselves."""
        if layout.TRIANGLES.kind not in self.entries:
            return None
        count = self.record["triangle_count"]
        raw = self.section(layout.TRIANGLES, *(layout.triangle_lengths(count) if count else (0, 0)))
        return decode_triangles(raw, count, self.where)

    def hierarchy(self, scene: Scene) -> StoredHierarchy | None:
        """A hierarchy other than the default one, checked against the triangles."""
        if layout.HIERARCHY.kind not in self.entries:
            return None
        count = self.record["triangle_count"]
        most = layout.most_hierarchy_bytes(count) if count else 0
        found = decode_hierarchy(self.section(layout.HIERARCHY, min(1, count), most), self.where)
        check_hierarchy(scene, found, self.where)
        scene.__dict__["_sound"] = found
        return found

    def json(self, raw: np.ndarray, kind: str, malformed: str, deep: str) -> Any:
        """The JSON of a section; `malformed` and `deep` are the codes of what may be wrong with it."""
        place = f"{self.where}: {kind}"
        try:
            text = raw.tobytes().decode("utf-8")
        except UnicodeDecodeError as error:
            raise unreadable(malformed, place) from error
        if _levels(text) > LEVELS:
            raise unreadable(deep, place)
        try:
            return json.loads(text, parse_int=_integer, parse_constant=_no_number)
        except ValueError as error:
            raise unreadable(malformed, place) from error


def _table(view: memoryview, where: str) -> dict[bytes, _Entry]:
    """The sections by their kinds, all that the table alone tells checked."""
    header = _header(view, where)
    if len(view) != int(header["total_length"]):
        raise unreadable("RDM104", where)
    count = int(header["section_count"])
    end = layout.HEADER.size + count * layout.ENTRY.size
    if not 1 <= count <= layout.SECTION_LIMIT or end > len(view):
        raise unreadable("RDM105", where)
    checksum = zlib.crc32(view[layout.HEADER.size : end], zlib.crc32(view[: layout.HEADER.size - 4]))
    if checksum != int(header["checksum"]):
        raise unreadable("RDM106", where)
    if header["reserved"]:
        raise unreadable("RDM107", where)
    entries: dict[bytes, _Entry] = {}
    for row in np.frombuffer(bytes(view[layout.HEADER.size : end]), layout.ENTRY.dtype):
        entry = _entry(row, end, where)
        if entry.stored_length == 0 or entry.raw_length == 0:
            raise unreadable("RDM109", entry.place)
        if entry.offset != layout.aligned(end) or entry.end > len(view):
            raise unreadable("RDM109", entry.place)
        if entry.kind in entries:
            raise unreadable("RDM112", entry.place)
        _check_entry(entry)
        entries[entry.kind] = entry
        end = entry.end
    if layout.aligned(end) != len(view):
        raise unreadable("RDM104", where)
    return entries


def _entry(row: np.void, before: int, where: str) -> _Entry:
    # NumPy drops trailing zero bytes of a string; a kind keeps its four.
    kind = bytes(row["kind"]).ljust(4, b"\0")
    rest = [int(row[field.name]) for field in layout.ENTRY.fields[1:]]
    return _Entry(kind, before, f"{where}: {kind.decode('ascii', 'backslashreplace')}", *rest)


def _check_entry(entry: _Entry) -> None:
    section = _KNOWN.get(entry.kind)
    if entry.flags & ~layout.MUST_UNDERSTAND:
        raise unreadable("RDM107", entry.place)
    if section is None and entry.flags:
        raise unreadable("RDM111", entry.place)
    if section is not None and bool(entry.flags) != section.must_understand:
        raise unreadable("RDM116", entry.place)
    stored = (entry.stored_length, entry.stored_checksum)
    if entry.codec == layout.CODEC_RAW and stored != (entry.raw_length, entry.raw_checksum):
        raise unreadable("RDM118", entry.place)
    if section is not None and entry.codec > layout.CODEC_PLANES:
        raise unreadable("RDM119", entry.place)
    if section is not None and entry.codec not in layout.codecs_of(section):
        raise unreadable("RDM120" if section is layout.SCENE else "RDM125", entry.place)


_TOO_LONG = {layout.METADATA.kind: "RDM902", layout.MATERIALS.kind: "RDM532"}
_BOUNDS = slice(40, 70)
"""Low, high and cell in the scene record: all bits are zero where there is no triangle."""

_KNOWN = {section.kind: section for section in layout.SECTIONS}


def _check_record(record: dict[str, Any], kinds: Collection[bytes], place: str) -> None:
    """Make sure that the counts agree with each other; the numbers are looked at with the scene's fields."""
    has_geometries, is_plain = layout.GEOMETRIES.kind in kinds, layout.TRIANGLES.kind in kinds
    has_hierarchy = layout.HIERARCHY.kind in kinds
    names = ("triangle_count", "block_count", "node_count", "top_count", "run_count", "source_face_count")
    n, b, m, top, r, faces = (record[name] for name in names)
    stored = record["flags"] & layout.BOXES_STORED
    if record["flags"] > 7 or record["reserved"] or record["reserved_2"]:
        raise unreadable("RDM107", place)
    check.check_origin(
        [record[f"origin_{axis}"] for axis in "xyz"], bool(record["flags"] & layout.HAS_ORIGIN), place
    )
    if n == 0 and record["flags"] & (layout.BOXES_STORED | layout.HAS_ORIGIN):
        raise unreadable("RDM208", place)
    nodes = m >= top + b if stored else m == top
    most = 2**32 if is_plain else layout.BLOCK_TRIANGLES * b
    counts = b <= layout.BLOCK_LIMIT and (b == 0) == (n == 0 or is_plain) and b <= n <= most
    runs = b <= r <= n if stored else r == 0
    tops = top == 0 if b < 2 or has_hierarchy else top > 0 or has_geometries
    nodes = nodes and not (has_hierarchy and stored)
    if not (counts and m <= layout.NODE_LIMIT and nodes and tops and runs and faces >= n):
        raise unreadable("RDM201", place)
    if not record["flags"] & layout.ON_GRID and record["grid_exponent"]:
        raise unreadable("RDM203", place)
    if not (1 <= record["longest_run"] <= layout.LONGEST_RUN if stored else record["longest_run"] == 0):
        raise unreadable("RDM207", place)
    if record["flags"] & layout.ON_GRID and record["grid_exponent"] not in layout.GRID_EXPONENTS:
        raise unreadable("RDM203", place)
    if not (np.isfinite(record["error_bound"]) and record["error_bound"] >= 0.0):
        raise unreadable("RDM202", place)
    if not all(np.isfinite(record[f"{key}_{axis}"]) for key in ("low", "high") for axis in "xyz"):
        raise unreadable("RDM205", place)
    if not all(record[f"cell_{axis}"] in layout.CELL_EXPONENTS for axis in "xyz"):
        raise unreadable("RDM206", place)


def _array(payload: np.ndarray, stored: str, native: type) -> np.ndarray:
    return payload.view(stored).astype(native, copy=False)


def _levels(text: str) -> int:
    """How deep arrays and objects are nested; brackets in strings do not count."""
    bare = np.frombuffer(re.sub(r'"(?:[^"\\]|\\.)*"?', "", text, flags=re.DOTALL).encode(), np.uint8)
    opening = (bare == ord("[")) | (bare == ord("{"))
    closing = (bare == ord("]")) | (bare == ord("}"))
    return int(np.cumsum(opening.astype(np.int32) - closing).max(initial=0))


def _integer(digits: str) -> int | str:
    # Python refuses to read more than 4,300 digits, JSON does not.
    return int(digits) if len(digits) < 4000 else digits


def _no_number(name: str) -> None:
    raise ValueError(f"{name} is no JSON")
