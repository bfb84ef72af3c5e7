"""Name every flaw of a scene file, without the reader, so that it shares none of the reader's blind spots.

It reads the bytes by the specification with `struct`, walks the hierarchy in plain Python, and takes from
this package only the issue catalogue and the decoding of strips.
"""

import math
import struct
import zlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO

import numpy as np

from striptools.reducem.issues import ISSUES, Finding
from striptools.strips.topology import decode_strips

__all__ = ["validate"]

_NEEDED = {b"SCEN", b"POSN", b"SVTX", b"TURN", b"STRT", b"HIER"}
_UNDERSTOOD = _NEEDED | {b"FLIP"}
_KNOWN = _UNDERSTOOD | {b"RMAP"}


@dataclass
class _Parsed:
    """What is known of a file so far, and what was found."""

    data: bytes
    where: str
    findings: list[Finding] = field(default_factory=list)
    sections: dict[bytes, bytes] = field(default_factory=dict)

    def found(self, code: str, place: str = "") -> None:
        where = f"{self.where}: {place}" if place else self.where
        self.findings.append(Finding(ISSUES[code], where))

    @property
    def has_errors(self) -> bool:
        return any(finding.issue.severity == "error" for finding in self.findings)


def validate(source: str | Path | bytes | bytearray | memoryview | IO[bytes]) -> list[Finding]:
    """Name every flaw of a scene file.

    A layer is looked at only where the one below it is whole: header, table, contents.

    Args:
        source: A path, the file's bytes, or a binary stream of it; it is read to its end.

    Returns:
        The findings in the order of the file; no one of severity `error` means that it is valid.
    """
    where = "scene"
    try:
        if isinstance(source, str | Path):
            where, data = str(source), Path(source).read_bytes()
        elif isinstance(source, bytes | bytearray | memoryview):
            data = bytes(source)
        else:
            where, data = str(getattr(source, "name", "the input stream")), source.read()
    except (OSError, ValueError):
        return [Finding(ISSUES["RDM001"], where)]
    parsed = _Parsed(data, where)
    for layer in (_header, _table, _scene):
        layer(parsed)
        if parsed.has_errors:
            break
    return parsed.findings


def _header(parsed: _Parsed) -> None:
    data = parsed.data
    magic = b"\x89RDM\r\n\x1a\n"
    if data[:8] != magic[: len(data)]:
        return parsed.found("RDM102")
    if len(data) < 32:
        return parsed.found("RDM101")
    major, minor, count, total, reserved, checksum = struct.unpack_from("<HHIQII", data, 8)
    if (major, minor) != (0, 2):
        return parsed.found("RDM103", f"version {major}.{minor}")
    if total != len(data):
        parsed.found("RDM104")
    if count < 1 or count > 64 or 32 + 32 * count > len(data):
        return parsed.found("RDM105")
    if zlib.crc32(data[:28] + data[32 : 32 + 32 * count]) != checksum:
        return parsed.found("RDM106")
    if reserved:
        parsed.found("RDM107")
    return None


def _table(parsed: _Parsed) -> None:
    data = parsed.data
    count = struct.unpack_from("<I", data, 12)[0]
    end = 32 + 32 * count
    seen: set[bytes] = set()
    for kind, flags, offset, length, checksum, reserved in struct.iter_unpack("<4sIQQII", data[32:end]):
        place = kind.decode("ascii", "backslashreplace")
        start = end + -end % 64
        if offset != start or length == 0 or offset + length > len(data):
            return parsed.found("RDM109", place)
        if data[end:start].strip(b"\0"):
            parsed.found("RDM108", place)
        end = offset + length
        if kind in seen:
            parsed.found("RDM112", place)
        seen.add(kind)
        _entry(parsed, kind, flags, reserved, place)
        payload = data[offset:end]
        if zlib.crc32(payload) != checksum:
            parsed.found("RDM110", place)
        parsed.sections[kind] = payload
    if end + -end % 64 != len(data):
        return parsed.found("RDM104")
    if data[end:].strip(b"\0"):
        parsed.found("RDM108")
    return None


def _entry(parsed: _Parsed, kind: bytes, flags: int, reserved: int, place: str) -> None:
    if flags > 1 or reserved:
        parsed.found("RDM107", place)
    elif kind not in _KNOWN:
        parsed.found("RDM111" if flags else "RDM115", place)
    elif flags != (kind in _UNDERSTOOD):
        parsed.found("RDM116", place)


def _scene(parsed: _Parsed) -> None:
    sections = parsed.sections
    if b"SCEN" not in sections:
        return parsed.found("RDM113", "SCEN")
    if len(sections[b"SCEN"]) != 24:
        return parsed.found("RDM114", "SCEN")
    triangles, vertices, strips, source_faces, error_bound = struct.unpack("<4Id", sections[b"SCEN"])
    if not (1 <= strips <= triangles <= 2**29 and 3 <= vertices <= triangles + 2 * strips):
        return parsed.found("RDM201", "SCEN")
    if not triangles <= source_faces <= 2**30:
        parsed.found("RDM201", "SCEN")
    if not (math.isfinite(error_bound) and error_bound >= 0):
        parsed.found("RDM202", "SCEN")
    _lengths(parsed, triangles, vertices, strips)
    if not parsed.has_errors:
        _contents(parsed, triangles, vertices, strips)
        if b"RMAP" in sections:
            _remap(parsed, source_faces)
    return None


def _lengths(parsed: _Parsed, triangles: int, vertices: int, strips: int) -> None:
    wanted = {
        b"POSN": vertices * 12,
        b"SVTX": (triangles + strips * 2) * 4,
        b"TURN": -(-triangles // 8),
        b"STRT": strips * 4 + 4,
        b"HIER": (strips - 1) * 28,
    }
    if b"FLIP" in parsed.sections:
        wanted[b"FLIP"] = wanted[b"TURN"]
    if b"RMAP" in parsed.sections:
        wanted[b"RMAP"] = triangles * 4
    for kind, length in wanted.items():
        if kind not in parsed.sections and length:
            parsed.found("RDM113", kind.decode())
        elif len(parsed.sections.get(kind, b"")) != length:
            parsed.found("RDM114", kind.decode())


def _contents(parsed: _Parsed, triangles: int, vertices: int, strips: int) -> None:
    positions = np.frombuffer(parsed.sections[b"POSN"], "<f4").reshape(vertices, 3)
    starts = np.frombuffer(parsed.sections[b"STRT"], "<u4").astype(np.int64)
    index = np.frombuffer(parsed.sections[b"SVTX"], "<u4").astype(np.int64)
    bits = np.unpackbits(np.frombuffer(parsed.sections[b"TURN"], np.uint8), bitorder="little")
    for row in np.argwhere(~np.isfinite(positions))[:1]:
        parsed.found("RDM301", f"POSN: position {row[0]}")
    if bits[triangles:].any():
        parsed.found("RDM304", "TURN")
    if starts[0] != 0 or starts[-1] != triangles or (np.diff(starts) <= 0).any():
        parsed.found("RDM302", "STRT")
    elif bits[starts[:-1]].any():
        parsed.found("RDM303", "TURN")
    flips = _flips(parsed, triangles, starts)
    if (index >= vertices).any():
        parsed.found("RDM305", "SVTX")
    else:
        _first_uses(parsed, index, vertices)
    if not parsed.has_errors:
        turns = bits[:triangles].astype(np.bool_)
        _repeats(parsed, decode_strips(index.astype(np.int32), turns, starts.astype(np.int32), flips))
        _hierarchy(parsed, positions[index], starts + 2 * np.arange(strips + 1), strips)


def _flips(parsed: _Parsed, triangles: int, starts: np.ndarray) -> np.ndarray | None:
    if b"FLIP" not in parsed.sections:
        return None
    bits = np.unpackbits(np.frombuffer(parsed.sections[b"FLIP"], np.uint8), bitorder="little")
    if bits[triangles:].any():
        parsed.found("RDM309", "FLIP")
    if bits[starts[starts < triangles]].any():
        parsed.found("RDM310", "FLIP")
    if not bits[:triangles].any():
        parsed.found("RDM311", "FLIP")
    return bits[:triangles].astype(np.bool_)


def _first_uses(parsed: _Parsed, index: np.ndarray, vertices: int) -> None:
    used, first_use = np.unique(index, return_index=True)
    if len(used) < vertices:
        parsed.found("RDM307", "POSN")
    if (np.diff(first_use) < 0).any() or (used[: len(first_use)] != np.arange(len(used))).any():
        parsed.found("RDM306", "SVTX")


def _repeats(parsed: _Parsed, faces: np.ndarray) -> None:
    ordered = np.sort(faces, axis=1)
    for row in np.argwhere(ordered[:, 1:] == ordered[:, :-1])[:1]:
        parsed.found("RDM308", f"SVTX: triangle {row[0]}")


def _hierarchy(parsed: _Parsed, corners: np.ndarray, ends: np.ndarray, strips: int) -> None:
    payload = parsed.sections.get(b"HIER", b"")
    boxes = np.frombuffer(payload[: 24 * (strips - 1)], "<f4").reshape(strips - 1, 6)
    lefts = np.frombuffer(payload[24 * (strips - 1) :], "<u4").tolist()
    for row in np.argwhere(~np.isfinite(boxes))[:1]:
        return parsed.found("RDM402", f"HIER: node {row[0]}")
    children = _children(lefts, strips)
    if isinstance(children, int):
        return parsed.found("RDM401", f"HIER: node {children}")
    leaf_low = np.minimum.reduceat(corners, ends[:-1])
    leaf_high = np.maximum.reduceat(corners, ends[:-1])
    # Leaves stand behind the nodes, so that one index names either.
    low, high = np.concatenate([boxes[:, :3], leaf_low]), np.concatenate([boxes[:, 3:], leaf_high])
    for side in np.array(children, np.int64).reshape(-1, 2).T:
        spilled = (low[side] < boxes[:, :3]) | (high[side] > boxes[:, 3:])
        for row in np.argwhere(spilled)[:1]:
            return parsed.found("RDM403", f"HIER: node {row[0]}")
    return None


def _children(lefts: list[int], strips: int) -> list[tuple[int, int]] | int:
    nodes = strips - 1
    children: list[tuple[int, int]] = []
    waiting = [(0, strips)]
    for node, left in enumerate(lefts):
        first, count = waiting.pop()
        right = count - left
        if left < 1 or right < 1:
            return node
        if right > 1:
            waiting.append((first + left, right))
        if left > 1:
            waiting.append((first, left))
        children.append(
            (node + 1 if left > 1 else nodes + first, node + left if right > 1 else nodes + first + left)
        )
    return children


def _remap(parsed: _Parsed, source_faces: int) -> None:
    words = np.frombuffer(parsed.sections[b"RMAP"], "<u4").astype(np.int64)
    if (words >= 3 << 30).any():
        parsed.found("RDM501", "RMAP")
    faces = words % (1 << 30)
    if (faces >= source_faces).any():
        parsed.found("RDM502", "RMAP")
    if len(np.unique(faces)) < len(faces):
        parsed.found("RDM503", "RMAP")
