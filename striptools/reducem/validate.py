"""Name every flaw of a scene file, without the reader, so that it shares none of the reader's blind spots.

It reads the bytes by the specification and takes from this package only the issue catalogue. A layer is
looked at where the one below it is whole: header, table, scene record, blocks, nodes. Time and memory are
linear in the length of the file, or in the decoded lengths of an archive once the counts have borne them out.
"""

import json
import math
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import IO, NoReturn

import numpy as np

from striptools.reducem.inspection import Inspection, Section
from striptools.reducem.issues import ISSUES, Finding
from striptools.reducem.validate_archive import content_limit, join_blocks, join_planes
from striptools.reducem.validate_attributes import inspect_attributes, inspect_materials
from striptools.reducem.validate_blocks import Blocks, inspect_blocks, inspect_headers
from striptools.reducem.validate_hierarchy import inspect_hierarchy
from striptools.reducem.validate_instances import inspect_geometries, inspect_instances, inspect_owners
from striptools.reducem.validate_nodes import inspect_nodes
from striptools.reducem.validate_packed import unpack
from striptools.reducem.validate_triangles import inspect_triangles

__all__ = ["validate"]

_NEEDED = ("SCEN", "BLKH", "BLKD", "NODE", "RUNS", "GEOM", "INST", "HIER", "TRIS")
_PASSED_OVER = ("RMAP", "ATTR", "MATL", "META")
_KNOWN = (*_NEEDED, *_PASSED_OVER)
_OPTIONAL = (*_PASSED_OVER, "GEOM", "INST", "HIER")
_WIDTHS = {"BLKH": 32, "NODE": 64, "RUNS": 4, "RMAP": 4, "HIER": 4, "TRIS": 4}
"""Bytes of a record for the kinds that may have codec 3."""
_MOST_METADATA = 2**20
_MOST_MATERIALS = 2**22
_TOO_LONG = {"META": "RDM902", "MATL": "RDM532"}
_MOST_LEVELS = 32


def validate(source: str | Path | bytes | bytearray | memoryview | IO[bytes]) -> list[Finding]:
    """Name every flaw of a scene file.

    Args:
        source: A path, the file's bytes, or a binary stream of it; it is read to its end.

    Returns:
        The findings, a kind of flaw once for each section, in the order in which they were looked for; no one
        of severity `error` means that the file is valid.
    """
    where = str(source) if isinstance(source, str | Path) else str(getattr(source, "name", "scene"))
    try:
        if isinstance(source, str | Path):
            data = Path(source).read_bytes()
        elif isinstance(source, bytes | bytearray | memoryview):
            data = bytes(source)
        else:
            data = source.read()
    except (OSError, ValueError):
        return [Finding(ISSUES["RDM001"], where)]
    inspection = Inspection(data, where)
    # NumPy warns of arithmetic with what is not finite, a signalling NaN say; the rules say what is wrong.
    with np.errstate(all="ignore"):
        for layer in (_header, _table, _contents):
            if not layer(inspection):
                break
    return inspection.findings


def _header(inspection: Inspection) -> bool:
    """Look at the header; says whether the table can be looked at."""
    data = inspection.data
    magic = b"\x89RDM\r\n\x1a\n"
    if data[:8] != magic[: len(data)]:
        inspection.found("RDM102", "", 0)
        return False
    if len(data) < 32:
        inspection.found("RDM101", "", len(data))
        return False
    major, minor, count, total, reserved, checksum = struct.unpack_from("<HHIQII", data, 8)
    if (major, minor) != (0, 4):
        inspection.found("RDM103", f"version {major}.{minor}", 8)
        return False
    if total != len(data) or total % 64:
        inspection.found("RDM104", f"{len(data)} bytes, not {total}", 16)
    if reserved:
        inspection.found("RDM107", "header", 24)
    if not 1 <= count <= 64 or 32 + 40 * count > len(data):
        inspection.found("RDM105", f"{count} sections", 12)
        return False
    if zlib.crc32(data[32 : 32 + 40 * count], zlib.crc32(data[:28])) != checksum:
        inspection.found("RDM106", "", 28)
    return True


@dataclass(frozen=True)
class _Entry:
    """A row of the section table, and the byte of the file where it begins."""

    at: int
    kind: str
    flags: int
    codec: int
    offset: int
    stored_length: int
    raw_length: int
    stored_checksum: int
    raw_checksum: int

    @property
    def place(self) -> str:
        """The kind as one word on one line."""
        return ascii(self.kind)[1:-1]

    @property
    def end(self) -> int:
        return self.offset + self.stored_length


def _table(inspection: Inspection) -> bool:
    """Look at the table and what lies between sections; says whether the sections can be looked at."""
    data = inspection.data
    end = 32 + 40 * struct.unpack_from("<I", data, 12)[0]
    entries: list[_Entry] = []
    for at in range(32, end, 40):
        kind, *fields = struct.unpack_from("<4sHHQQQII", data, at)
        entry = _Entry(at, kind.decode("latin-1"), *fields)
        start = end + -end % 64
        if entry.stored_length == 0 or entry.raw_length == 0:
            inspection.found("RDM109", entry.place, at + (16 if entry.stored_length == 0 else 24))
            return False
        if entry.offset != start or entry.end > len(data):
            inspection.found("RDM109", entry.place, at + 8)
            return False
        _padding(inspection, end, start)
        if entry.kind in {other.kind for other in entries}:
            inspection.found("RDM112", entry.place, at)
        _entry(inspection, entry)
        entries.append(entry)
        end = entry.end
    if end + -end % 64 != len(data):
        inspection.found("RDM104", f"the last section ends at byte {end}", 16)
    _padding(inspection, end, len(data))
    return _sections(inspection, entries)


def _padding(inspection: Inspection, start: int, end: int) -> None:
    rest = inspection.data[start:end].lstrip(b"\0")
    if rest:
        inspection.found("RDM108", "", end - len(rest))


def _entry(inspection: Inspection, entry: _Entry) -> None:
    """Look at one row of the table, and at the checksum of the stored bytes."""
    if entry.flags > 1:
        inspection.found("RDM107", entry.place, entry.at + 4)
    if entry.kind not in _KNOWN:
        if entry.flags & 1:
            inspection.found("RDM111", entry.place, entry.at + 4)
        else:
            inspection.found("RDM115", entry.place, entry.at)
    elif (entry.flags & 1) != (entry.kind in _NEEDED):
        inspection.found("RDM116", entry.place, entry.at + 4)
    raw = (entry.stored_length, entry.stored_checksum)
    if entry.codec == 0 and raw != (entry.raw_length, entry.raw_checksum):
        inspection.found("RDM118", entry.place, entry.at + 24)
    if entry.kind in _KNOWN and entry.codec > 3:
        inspection.found("RDM119", entry.place, entry.at + 6)
    elif entry.kind == "SCEN" and entry.codec != 0:
        inspection.found("RDM120", entry.place, entry.at + 6)
    elif not _codec_fits(entry):
        inspection.found("RDM125", entry.place, entry.at + 6)
    if zlib.crc32(inspection.data[entry.offset : entry.end]) != entry.stored_checksum:
        inspection.found("RDM110", entry.place, entry.at + 32)


def _codec_fits(entry: _Entry) -> bool:
    """Whether the codec is one that the kind may have; a kind that is not known may have any."""
    if entry.kind not in _KNOWN or entry.codec == 0:
        return True
    if entry.codec == 1:
        return entry.kind != "INST"
    return entry.kind == "BLKD" if entry.codec == 2 else entry.kind in _WIDTHS


def _sections(inspection: Inspection, entries: list[_Entry]) -> bool:
    """Decode the known sections; says whether there is a scene record."""
    first: dict[str, _Entry] = {}
    for entry in entries:
        if entry.kind in _KNOWN:
            first.setdefault(entry.kind, entry)
    if "SCEN" not in first:
        inspection.found("RDM113", "SCEN", 32)
        return False
    entry = first.pop("SCEN")
    if entry.codec != 0:
        return False
    payload = inspection.data[entry.offset : entry.end]
    inspection.sections["SCEN"] = Section("SCEN", entry.offset, 0, payload)
    if len(payload) != 96:
        inspection.found("RDM114", "SCEN", entry.at + 16)
        return False
    lengths = _lengths(*struct.unpack_from("<5I", payload), payload[24] & 1)
    _other_hierarchy(inspection, first.pop("HIER", None), lengths)
    # Block data may lean on the headers, wherever those lie.
    for kind, entry in sorted(first.items(), key=lambda item: item[1].codec == 2):
        _decode(inspection, entry, lengths[kind])
    for kind, (least, _) in lengths.items():
        if least and kind not in first and kind not in _OPTIONAL:
            inspection.found("RDM113", kind, 32)
    return True


def _other_hierarchy(
    inspection: Inspection, entry: _Entry | None, lengths: dict[str, tuple[int, int]]
) -> None:
    """Decode HIER where it is there, for what must be there besides follows from it."""
    found = None
    if entry is not None:
        _decode(inspection, entry, lengths["HIER"])
        lengths |= {"GEOM": (0, 0), "INST": (0, 0)}
        found = inspection.sections.get("HIER")
    if entry is None or (found is not None and found.data[0] != 4):
        lengths["TRIS"] = (0, 0)
    elif found is None:
        lengths["TRIS"] = (0, lengths["TRIS"][1])


def _lengths(n: int, b: int, m: int, _top: int, r: int, stored: int) -> dict[str, tuple[int, int]]:
    """The least and the most bytes of each section by the counts; (0, 0) where it must not be there."""
    runs, remap = (-(-b // 16) * 64 + 4 * r) * stored, 4 * n + -(-n // 4)
    lengths = {"BLKH": (32 * b, 32 * b), "BLKD": (64, 3936 * b + 128) if b else (0, 0)}
    lengths |= {"NODE": (64 * m, 64 * m), "RUNS": (runs, runs)}
    lengths |= {"RMAP": (remap, remap), "META": (1, _MOST_METADATA)}
    beside = {"ATTR": (1, 256 * (n + 1)), "MATL": (1, _MOST_MATERIALS)}
    beside |= {"GEOM": (16, 16 * b), "INST": (104, 104 * 2**24)}
    beside |= {"HIER": (1, 1024 * (n + 1)), "TRIS": (12 * (n + 3), 48 * n)}
    return lengths | (beside if n else dict.fromkeys(beside, (0, 0)))


def _decode(inspection: Inspection, entry: _Entry, lengths: tuple[int, int]) -> None:
    """Decode one section whose length is what the counts say, or note that it is not."""
    inspection.undecoded.add(entry.kind)
    if lengths[1] == 0:
        return inspection.found("RDM117", entry.place, entry.at)
    if not lengths[0] <= entry.raw_length <= lengths[1]:
        return inspection.found(_TOO_LONG.get(entry.kind, "RDM114"), entry.place, entry.at + 24)
    payload = inspection.data[entry.offset : entry.end]
    if entry.codec:
        payload = _expanded(inspection, entry, payload)
        if payload is None:
            return None
        if zlib.crc32(payload) != entry.raw_checksum:
            inspection.found("RDM122", entry.place, entry.at + 36)
    if len(payload) == entry.raw_length:
        inspection.undecoded.remove(entry.kind)
        inspection.sections[entry.kind] = Section(entry.kind, entry.offset, entry.codec, payload)
    return None


def _expanded(inspection: Inspection, entry: _Entry, stored: bytes) -> bytes | None:
    """The decoded bytes of a section that is not raw, or None where that is found to be impossible."""
    if entry.codec > 3 or not _codec_fits(entry):
        return None
    limits, blocks = (entry.raw_length, entry.raw_length), None
    if entry.codec == 2:
        blocks = _sound_headers(inspection, entry)
        if blocks is None:
            return None
        limits = (1, content_limit(blocks))
    code, payload = unpack(stored, *limits)
    if code:
        inspection.found(code, entry.place, entry.offset)
        return None
    if blocks is not None:
        payload = join_blocks(payload, blocks, entry.raw_length)
        if payload is None:
            inspection.found("RDM126", entry.place, entry.offset)
        return payload
    return join_planes(payload, _WIDTHS[entry.kind]) if entry.codec == 3 else payload


def _sound_headers(inspection: Inspection, entry: _Entry) -> Blocks | None:
    """The headers of blocks, where they keep every rule with block data of that length, all zero."""
    headers, found = inspection.sections.get("BLKH"), len(inspection.findings)
    if headers is None:
        return None
    if entry.raw_length % 4:
        inspection.found("RDM606", entry.place, entry.at + 24)
        return None
    nothing = Section(entry.kind, entry.offset, entry.codec, bytes(entry.raw_length))
    blocks = inspect_headers(inspection, headers, nothing)
    if int(blocks.k.sum()) != int.from_bytes(inspection.sections["SCEN"].data[:4], "little"):
        inspection.found("RDM201", "SCEN", inspection.sections["SCEN"].at(0))
    return blocks if len(inspection.findings) == found else None


def _contents(inspection: Inspection) -> bool:
    """Look into the sections, each where it and what it leans on are whole."""
    sections = inspection.sections
    _record(inspection, sections["SCEN"])
    parts = inspect_geometries(inspection)
    geometry = inspect_triangles(inspection) if "TRIS" in sections else None
    if "BLKH" in sections:
        geometry = inspect_blocks(inspection) if "BLKD" in sections else None
        if "NODE" in sections and parts is not None:
            inspect_nodes(inspection, geometry, parts)
    if "HIER" in sections:
        inspect_hierarchy(inspection, geometry)
    if "RMAP" in sections:
        _remap(inspection, sections["RMAP"])
        inspect_owners(inspection, parts)
    if "INST" in sections:
        inspect_instances(inspection)
    _beside(inspection)
    if "META" in sections:
        _metadata(inspection, sections["META"])
    return True


def _beside(inspection: Inspection) -> None:
    """Look at attributes and materials."""
    sections, materials = inspection.sections, 0
    if "MATL" in sections:
        rows = _json(inspection, sections["MATL"], "RDM531", "RDM531")
        materials = None if rows is _NO_JSON else inspect_materials(inspection, sections["MATL"], rows)
    if "ATTR" in sections and ("BLKH" in sections or "TRIS" in sections):
        inspect_attributes(inspection, sections["ATTR"], materials)
    elif "MATL" in sections and "ATTR" not in inspection.undecoded and "ATTR" not in sections:
        inspection.found("RDM117", "MATL", sections["MATL"].offset)


def _record(inspection: Inspection, section: Section) -> None:
    """Look at the fields of the scene record."""
    n, b, m, top, r, source_faces, flags, reserved, grid = struct.unpack_from("<6IBBh", section.data)
    reserved_2 = section.data[28:32] != bytes(4)
    *cells, longest = struct.unpack_from("<3hH", section.data, 64)
    there = inspection.sections.keys() | inspection.undecoded
    stored, several, is_plain, is_other = flags & 1, "GEOM" in there, "TRIS" in there, "HIER" in there
    for at, wrong in ((24, flags > 7), (25, reserved), (28, reserved_2)):
        if wrong:
            inspection.found("RDM107", "SCEN", section.at(at))
    counts = (
        (4, b > 2**24 or (b == 0) != (n == 0 or is_plain) or not b <= n <= (n if is_plain else 256 * b)),
        (8, m > 2**28 or (m < top + b if stored else m != top)),
        (12, top > 0 if b < 2 or is_other else top == 0 and not several),
        (24, stored and is_other),
        (16, not b <= r <= n if stored else r),
        (20, source_faces < n),
    )
    for at, wrong in counts:
        if wrong:
            inspection.found("RDM201", "SCEN", section.at(at))
    _numbers(inspection, section)
    if not (-149 <= grid <= 104 if flags & 2 else grid == 0):
        inspection.found("RDM203", "SCEN", section.at(26))
    for axis, cell in enumerate(cells):
        if not -149 <= cell <= 127:
            inspection.found("RDM206", "SCEN", section.at(64 + 2 * axis))
    if not (1 <= longest <= 8 if stored else longest == 0):
        inspection.found("RDM207", "SCEN", section.at(70))
    origin = struct.unpack_from("<3d", section.data, 72)
    if not all(map(math.isfinite, origin)) or not (any(origin) if flags & 4 else not any(section.data[72:])):
        inspection.found("RDM209", "SCEN", section.at(72))
    _empty(inspection, section, n, flags & 5)


def _numbers(inspection: Inspection, section: Section) -> None:
    """Look at the floats of the scene record by themselves."""
    error_bound, *bounds = struct.unpack_from("<d6f", section.data, 32)
    if not (math.isfinite(error_bound) and error_bound >= 0):
        inspection.found("RDM202", "SCEN", section.at(32))
    for i, bound in enumerate(bounds):
        if not math.isfinite(bound):
            inspection.found("RDM205", "SCEN", section.at(40 + 4 * i))
            break


def _empty(inspection: Inspection, section: Section, triangles: int, more: int) -> None:
    """Look at what an empty scene must not have; its counts are looked at with the others."""
    if triangles == 0:
        if more:
            inspection.found("RDM208", "SCEN", section.at(24))
        rest = section.data[40:70].lstrip(b"\0")
        if rest:
            inspection.found("RDM208", "SCEN", section.at(70 - len(rest)))


def _remap(inspection: Inspection, section: Section) -> None:
    """Look at the faces and rotations of the remap."""
    n, source_faces = (int(x) for x in np.frombuffer(inspection.sections["SCEN"].data, "<u4")[[0, 5]])
    faces = np.frombuffer(section.data, "<u4", n)
    packed = np.frombuffer(section.data, np.uint8, offset=4 * n)
    rotations = (packed[:, None] >> np.array([0, 2, 4, 6], np.uint8) & 3).ravel()

    def name(t: int) -> str:
        return f"RMAP: triangle {t}"

    inspection.found_where("RDM501", rotations[:n] == 3, name, lambda t: section.at(4 * n + t // 4))
    inspection.found_where("RDM504", rotations[n:] != 0, lambda t: name(n - 1), lambda t: section.at(5 * n))
    inspection.found_where("RDM502", faces >= source_faces, name, lambda t: section.at(4 * t))
    order = np.argsort(faces, kind="stable")
    again = np.zeros(n, np.bool_)
    again[order[1:]] = faces[order[1:]] == faces[order[:-1]]
    inspection.found_where("RDM503", again, name, lambda t: section.at(4 * t))


def _metadata(inspection: Inspection, section: Section) -> None:
    """Look at the metadata."""
    metadata = _json(inspection, section, "RDM901", "RDM904")
    if metadata is _NO_JSON:
        return None
    if not isinstance(metadata, dict):
        return inspection.found("RDM901", "META", section.offset)
    for name in ("generator", "source", "unit"):
        if not isinstance(metadata.get(name, ""), str):
            inspection.found("RDM903", f"META: {name}", section.offset)
    return None


def _json(inspection: Inspection, section: Section, malformed: str, deep: str) -> object:
    """The JSON of a section, or that there is none; nothing is followed down before its depth is known."""
    kind = section.kind
    try:
        text = section.data.decode("utf-8")
    except UnicodeDecodeError as error:
        return _refused(inspection, malformed, kind, section.at(error.start))
    if _levels(text) > _MOST_LEVELS:
        return _refused(inspection, deep, kind, section.offset)
    try:
        return json.loads(text, parse_int=_small, parse_constant=_no_number)
    except json.JSONDecodeError as error:
        return _refused(inspection, malformed, kind, section.at(len(text[: error.pos].encode())))
    except ValueError:
        return _refused(inspection, malformed, kind, section.offset)


_NO_JSON = object()


def _refused(inspection: Inspection, code: str, place: str, offset: int) -> object:
    inspection.found(code, place, offset)
    return _NO_JSON


def _small(digits: str) -> int:
    # Python refuses to read more than 4,300 digits, JSON does not.
    return int(digits) if len(digits) < 4 else 9999


def _levels(text: str) -> int:
    """How deep arrays and objects are nested; brackets in strings do not count."""
    codes = np.frombuffer(text.encode("utf-32-le", "surrogatepass"), "<u4")
    quotes, slashes = codes == ord('"'), codes == ord("\\")
    # A quote counts unless the row of backslashes before it is odd.
    last_other = np.maximum.accumulate(np.where(slashes, -1, np.arange(len(codes))))
    before = np.concatenate([[-1], last_other[:-1]]) if len(codes) else last_other
    rows = np.arange(len(codes)) - 1 - before
    in_string = np.cumsum(quotes & (rows % 2 == 0)) % 2 == 1
    opening = ((codes == ord("[")) | (codes == ord("{"))) & ~in_string
    closing = ((codes == ord("]")) | (codes == ord("}"))) & ~in_string
    return int(np.cumsum(opening.astype(np.int64) - closing).max(initial=0))


def _no_number(name: str) -> NoReturn:
    raise ValueError(f"{name} is no JSON")
