"""What a validation looks at in attributes and materials (SPEC.md, sections 4.7 and 4.8)."""

import struct
from typing import NamedTuple

import numpy as np

from striptools.reducem.inspection import Inspection, Section

__all__ = ["inspect_attributes", "inspect_materials"]

_MOST_MATERIALS = 2**16
_NAMES = {
    b"NORM": ((3,), (0,), (0, 1, 2)),
    b"TEXC": ((2,), (0,), (0, 1, 2)),
    b"COLR": ((3, 4), (0, 1, 2), (0, 1, 2)),
    b"GRUP": ((1,), (3,), (2,)),
}
"""The components, types and domains that each may have."""
_SIZES = (4, 1, 2, 4)


class _Record(NamedTuple):
    """A record of an attribute, and the byte of the section where it begins."""

    at: int
    name: bytes
    domain: int
    components: int
    type: int
    width: int
    rows: int
    reserved: int


def inspect_attributes(inspection: Inspection, section: Section, materials: int | None) -> None:
    """Look at the attributes.

    Args:
        inspection: Of a file whose section BLKH or TRIS is there.
        section: ATTR.
        materials: How many materials there are; None where there is no saying.
    """
    data = section.data
    if len(data) < 8:
        return inspection.found("RDM522", "ATTR", section.offset)
    count, reserved = struct.unpack_from("<II", data)
    if reserved:
        inspection.found("RDM107", "ATTR", section.at(4))
    if not 1 <= count <= 4:
        return inspection.found("RDM521", f"ATTR: {count} attributes", section.at(0))
    if 8 + 16 * count > len(data):
        return inspection.found("RDM522", "ATTR", section.offset)
    records = [_Record(at, *struct.unpack_from("<4sBBBBII", data, at)) for at in range(8, 8 + 16 * count, 16)]
    if not all([_meaning(inspection, section, record) for record in records]):
        return None
    if len({record.name for record in records}) < count:
        inspection.found("RDM521", "ATTR: a name twice", section.at(8))
    triangles = struct.unpack_from("<I", inspection.sections["SCEN"].data)[0]
    entries = (_vertices(inspection, triangles), 3 * triangles, triangles)
    at = 8 + 16 * count
    for record in records:
        end = _values(inspection, section, record, at, entries[record.domain], materials)
        if end is None:
            return None
        at = end
    if at != len(data):
        inspection.found("RDM522", "ATTR", section.at(at))
    return _needs(inspection, records, materials)


def _vertices(inspection: Inspection, triangles: int) -> int:
    """How many vertices the blocks, or the plain triangles, have."""
    if "TRIS" in inspection.sections:
        return len(inspection.sections["TRIS"].data) // 12 - triangles
    headers = np.frombuffer(inspection.sections["BLKH"].data, np.uint8).reshape(-1, 32)
    return int(headers[:, 9].astype(np.int64).sum()) + len(headers)


def inspect_materials(inspection: Inspection, section: Section, rows: object) -> int | None:
    """Look at the materials, decoded; gives how many there are, None where they are none."""
    if not isinstance(rows, list) or not 1 <= len(rows) <= _MOST_MATERIALS:
        inspection.found("RDM531", "MATL", section.offset)
        return None
    for k, row in enumerate(rows):
        if not _is_material(row):
            inspection.found("RDM531", f"MATL: material {k}", section.offset)
            return None
    return len(rows)


def _is_material(row: object) -> bool:
    if not isinstance(row, dict) or set(row) - {"name", "base_color", "group"}:
        return False
    colour = row.get("base_color")
    if not isinstance(row.get("name"), str) or not isinstance(row.get("group", ""), str):
        return False
    return (
        isinstance(colour, list) and len(colour) == 4 and all(type(x) in (int, float) for x in colour)
    ) and all(0 <= x <= 1 for x in colour)


def _needs(inspection: Inspection, records: list[_Record], materials: int | None) -> None:
    """Groups need materials, and materials groups."""
    grouped = any(record.name == b"GRUP" for record in records)
    if grouped and materials == 0 and "MATL" not in inspection.undecoded:
        inspection.found("RDM113", "MATL", 32)
    if not grouped and "MATL" in inspection.sections:
        inspection.found("RDM117", "MATL", inspection.sections["MATL"].offset)


def _meaning(inspection: Inspection, section: Section, record: _Record) -> bool:
    """Look at what a record says of itself."""
    place = f"ATTR: {ascii(record.name)[2:-1]}"
    if record.reserved:
        inspection.found("RDM107", place, section.at(record.at + 12))
    if record.name not in _NAMES:
        inspection.found("RDM521", place, section.at(record.at))
        return False
    components, types, domains = _NAMES[record.name]
    fields = ((4, record.domain, domains), (5, record.components, components), (6, record.type, types))
    for at, value, allowed in fields:
        if value not in allowed:
            inspection.found("RDM521", place, section.at(record.at + at))
            return False
    return True


def _values(
    inspection: Inspection, section: Section, record: _Record, at: int, count: int, materials: int | None
) -> int | None:
    """Look at the data of an attribute; gives the byte where the next one's begin, None if there is none."""
    place = f"ATTR: {record.name.decode()}"
    rows, alone = record.rows, record.rows == count
    wanted = 0 if alone else (rows - 1).bit_length()
    if not 1 <= rows <= count or record.width != wanted:
        inspection.found("RDM523", place, section.at(record.at + (7 if 1 <= rows <= count else 8)))
        return None
    size = record.components * _SIZES[record.type]
    middle = at + rows * size
    begin = middle + -middle % 4
    bits = record.width * count
    end = begin + 4 * -(-bits // 32)
    if end > len(section.data):
        inspection.found("RDM522", place, section.at(len(section.data)))
        return None
    if any(section.data[middle:begin]):
        inspection.found("RDM527", place, section.at(middle))
    _rows(inspection, section, record, at, materials)
    stream = np.unpackbits(np.frombuffer(section.data, np.uint8, end - begin, begin), bitorder="little")
    if stream[bits:].any():
        inspection.found("RDM527", place, section.at(begin + bits // 8))
    # Where there is one row no index is stored, and a count that no bytes bear out must not be believed.
    if record.width:
        _indices(inspection, section, record, begin, _numbers(stream[:bits], count, record.width))
    return end


def _numbers(bits: np.ndarray, count: int, width: int) -> np.ndarray:
    """The numbers of so many bits each, int64."""
    numbers = np.zeros(count, np.int64)
    for k in range(width):
        numbers |= bits[k::width].astype(np.int64) << k
    return numbers


def _rows(inspection: Inspection, section: Section, record: _Record, at: int, materials: int | None) -> None:
    """Look at the rows: none twice, groups with a material."""
    place, size = f"ATTR: {record.name.decode()}", record.components * _SIZES[record.type]
    table = np.frombuffer(section.data, np.uint8, record.rows * size, at).reshape(record.rows, size)
    order = np.lexsort(table.T)
    again = np.zeros(record.rows, np.bool_)
    again[order[1:]] = (table[order[1:]] == table[order[:-1]]).all(axis=1)
    inspection.found_where(
        "RDM526", again, lambda i: f"{place}: row {i}", lambda i: section.at(at + size * i)
    )
    if record.name == b"GRUP":
        most = _MOST_MATERIALS if materials is None or "MATL" not in inspection.sections else materials
        beyond = table.view("<u4")[:, 0] >= most
        inspection.found_where(
            "RDM528", beyond, lambda i: f"{place}: row {i}", lambda i: section.at(at + size * i)
        )


def _indices(
    inspection: Inspection, section: Section, record: _Record, begin: int, numbers: np.ndarray
) -> None:
    """Look at the indices: each a row's, all rows used, in the order of their first use."""
    place = f"ATTR: {record.name.decode()}"

    def where(i: int) -> int:
        return section.at(begin + i * record.width // 8)

    inspection.found_where("RDM524", numbers >= record.rows, lambda i: f"{place}: entry {i}", where)
    largest = np.maximum.accumulate(np.concatenate([[-1], numbers]))
    early = numbers > largest[:-1] + 1
    if not inspection.found_where("RDM525", early, lambda i: f"{place}: entry {i}", where):
        inspection.found_where(
            "RDM525", largest[-1:] < record.rows - 1, lambda _: f"{place}: a row unused", lambda _: where(0)
        )
