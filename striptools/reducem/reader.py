"""Read a scene file, or refuse it with one line; formats/reducem/SPEC.md is what it reads by.

A stream is read in pieces and never past one byte more than its header declares, so that memory is bounded by
the bytes that are really there: no count is believed that the file's length does not bear out.
"""

import io
import zlib
from pathlib import Path
from typing import IO

import numpy as np

from striptools.hierarchies.strip_bvh import StripHierarchy
from striptools.reducem import layout
from striptools.reducem.check import check_scene
from striptools.reducem.issues import unreadable
from striptools.reducem.scene import Remap, Scene

__all__ = ["PIECE", "read_scene"]

PIECE = 1 << 20
"""Bytes asked of a stream at once."""


def read_scene(source: str | Path | bytes | bytearray | memoryview | IO[bytes]) -> Scene:
    """Read a scene file.

    Args:
        source: A path, the file's bytes, or a binary stream of it, which must end where the file does.

    Returns:
        The scene, every rule of the format checked.

    Raises:
        UnreadableSceneError: The file cannot be read or is no valid scene file; the line gives the
            place and an issue's code (formats/reducem/ISSUES.md).
    """
    if isinstance(source, bytes | bytearray | memoryview):
        return _decode(_gather(io.BytesIO(source), "scene"), "scene")
    if not isinstance(source, str | Path):
        where = str(getattr(source, "name", "the input stream"))
        return _decode(_gather(source, where), where)
    where = str(source)
    try:
        with Path(source).open("rb") as file:
            data = _gather(file, where)
    except (OSError, ValueError) as error:
        raise unreadable("RDM001", where) from error
    return _decode(data, where)


def _gather(stream: IO[bytes], where: str) -> bytearray:
    # A bytearray, because kernels would be compiled a second time for read-only arrays.
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
            wanted = int(_header(data, where)["total_length"]) + 1
    return data


def _header(data: bytearray, where: str) -> np.void:
    if len(data) < layout.HEADER.size:
        whole_magic = bytes(data[: len(layout.MAGIC)]) == layout.MAGIC[: len(data)]
        raise unreadable("RDM101" if whole_magic else "RDM102", where)
    if bytes(data[: len(layout.MAGIC)]) != layout.MAGIC:
        raise unreadable("RDM102", where)
    header = np.frombuffer(bytes(data[: layout.HEADER.size]), layout.HEADER.dtype)[0]
    if (int(header["major"]), int(header["minor"])) != layout.VERSION:
        raise unreadable("RDM103", f"{where}: version {header['major']}.{header['minor']}")
    return header


def _decode(data: bytearray, where: str) -> Scene:
    sections = _sections(data, where)
    scene = _scene(sections, where)
    check_scene(scene, where)
    return scene


def _sections(data: bytearray, where: str) -> dict[bytes, memoryview]:
    header = _header(data, where)
    if len(data) != int(header["total_length"]):
        raise unreadable("RDM104", where)
    count = int(header["section_count"])
    table_end = layout.HEADER.size + count * layout.ENTRY.size
    if not 1 <= count <= layout.SECTION_LIMIT or table_end > len(data):
        raise unreadable("RDM105", where)
    view = memoryview(data)
    checksum = zlib.crc32(view[layout.HEADER.size : table_end], zlib.crc32(view[: layout.HEADER.size - 4]))
    if checksum != int(header["checksum"]):
        raise unreadable("RDM106", where)
    if header["reserved"]:
        raise unreadable("RDM107", where)
    table = np.frombuffer(bytes(view[layout.HEADER.size : table_end]), layout.ENTRY.dtype)
    return _cut(view, table, table_end, where)


def _cut(view: memoryview, table: np.ndarray, end: int, where: str) -> dict[bytes, memoryview]:
    known = {section.kind: section for section in layout.SECTIONS}
    seen: set[bytes] = set()
    sections: dict[bytes, memoryview] = {}
    for entry in table:
        kind, place = _kind(entry, where)
        if kind in seen:
            raise unreadable("RDM112", place)
        seen.add(kind)
        end = _check_place(view, entry, end, place)
        _check_flags(entry, known.get(kind), place)
        payload = view[int(entry["offset"]) : end]
        if zlib.crc32(payload) != int(entry["checksum"]):
            raise unreadable("RDM110", place)
        if kind in known:
            sections[kind] = payload
    if layout.aligned(end) != len(view):
        raise unreadable("RDM104", where)
    _check_padding(view, end, len(view), where)
    return sections


def _kind(entry: np.void, where: str) -> tuple[bytes, str]:
    # NumPy drops trailing zero bytes of a string; a kind keeps its four.
    kind = bytes(entry["kind"]).ljust(4, b"\0")
    return kind, f"{where}: {kind.decode('ascii', 'backslashreplace')}"


def _check_place(view: memoryview, entry: np.void, end: int, place: str) -> int:
    offset, length = int(entry["offset"]), int(entry["length"])
    if offset != layout.aligned(end) or length == 0 or offset + length > len(view):
        raise unreadable("RDM109", place)
    _check_padding(view, end, offset, place)
    return offset + length


def _check_padding(view: memoryview, start: int, stop: int, place: str) -> None:
    if any(view[start:stop]):
        raise unreadable("RDM108", place)


def _check_flags(entry: np.void, section: layout.Section | None, place: str) -> None:
    flags = int(entry["flags"])
    if flags & ~layout.MUST_UNDERSTAND or entry["reserved"]:
        raise unreadable("RDM107", place)
    if section is None and flags:
        raise unreadable("RDM111", place)
    if section is not None and bool(flags) != section.must_understand:
        raise unreadable("RDM116", place)


def _scene(sections: dict[bytes, memoryview], where: str) -> Scene:
    record = _record(sections, where)
    triangles, vertices, strips = (
        int(record[name]) for name in ("triangle_count", "vertex_count", "strip_count")
    )
    corners = triangles + 2 * strips
    if not (1 <= strips <= triangles <= layout.TRIANGLE_LIMIT and 3 <= vertices <= corners):
        raise unreadable("RDM201", f"{where}: SCEN")
    has_flips, has_remap = layout.FLIPS.kind in sections, layout.REMAP.kind in sections
    lengths = layout.section_lengths(triangles, vertices, strips, flips=has_flips, remap=has_remap)
    for kind, length in lengths.items():
        _check_length(kind, length, len(sections.get(kind, b"")), where)
    boxes_end = 24 * (strips - 1)
    hierarchy = sections.get(layout.HIERARCHY.kind, memoryview(bytearray()))
    return Scene(
        positions=_array(sections[layout.POSITIONS.kind], "<f4", np.float32).reshape(-1, 3),
        vertices=_array(sections[layout.STRIP_VERTICES.kind], "<i4", np.int32),
        turns=_bits(sections[layout.TURNS.kind], triangles, "RDM304", f"{where}: TURN"),
        flips=_bits(sections[layout.FLIPS.kind], triangles, "RDM309", f"{where}: FLIP")
        if has_flips
        else None,
        starts=_array(sections[layout.STRIP_STARTS.kind], "<i4", np.int32),
        hierarchy=StripHierarchy(
            _array(hierarchy[:boxes_end], "<f4", np.float32).reshape(-1, 6),
            _array(hierarchy[boxes_end:], "<u4", np.uint32),
        ),
        remap=_remap(sections[layout.REMAP.kind]) if has_remap else None,
        error_bound=float(record["error_bound"]),
        source_face_count=int(record["source_face_count"]),
    )


def _record(sections: dict[bytes, memoryview], where: str) -> np.void:
    payload = sections.get(layout.SCENE.kind, memoryview(b""))
    _check_length(layout.SCENE.kind, layout.SCENE_RECORD.size, len(payload), where)
    return np.frombuffer(payload, layout.SCENE_RECORD.dtype)[0]


def _check_length(kind: bytes, wanted: int, found: int, where: str) -> None:
    if wanted != found:
        raise unreadable("RDM114" if found else "RDM113", f"{where}: {kind.decode()}")


def _array(payload: memoryview, stored: str, native: type) -> np.ndarray:
    return np.frombuffer(payload, stored).astype(native, copy=False)


def _bits(payload: memoryview, triangles: int, code: str, where: str) -> np.ndarray:
    bits = np.unpackbits(np.frombuffer(payload, np.uint8), bitorder="little").view(np.bool_)
    if bits[triangles:].any():
        raise unreadable(code, where)
    return bits[:triangles]


def _remap(payload: memoryview) -> Remap:
    words = _array(payload, "<u4", np.uint32)
    face = (words & np.uint32((1 << layout.ROTATION_SHIFT) - 1)).astype(np.int32)
    return Remap(face, (words >> np.uint32(layout.ROTATION_SHIFT)).astype(np.uint8))
