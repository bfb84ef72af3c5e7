"""The specification and the code say the same: tables, sections, issues and the worked bytes."""

import io
import re

import numpy as np
import pytest
from conftest import ROOT

from striptools.reducem import layout
from striptools.reducem.issues import ISSUES
from striptools.reducem.reader import read_scene
from striptools.reducem.validate import validate

FORMAT = ROOT / "formats" / "reducem"
SPEC = (FORMAT / "SPEC.md").read_text(encoding="utf-8")
TYPES = {"8 x char": "S8", "4 x char": "S4", "u16": "<u2", "u32": "<u4", "u64": "<u8", "f64": "<f8"}
LENGTHS = {
    "24": lambda n, v, s: 24,
    "12v": lambda n, v, s: 12 * v,
    "4c": lambda n, v, s: 4 * (n + 2 * s),
    "ceil(n/8)": lambda n, v, s: -(-n // 8),
    "4(s+1)": lambda n, v, s: 4 * (s + 1),
    "28(s-1)": lambda n, v, s: 28 * (s - 1),
    "4n": lambda n, v, s: 4 * n,
}
"""What the formulas in the specification's table of sections mean."""


def tables(text, header):
    """The rows of each table whose header row is this one."""
    blocks = re.findall(rf"^\| {re.escape(header)} \|\n\|[-|:]+\|\n((?:\|.*\n)+)", text, re.MULTILINE)
    return [
        [[cell.strip() for cell in row.strip("|").split("|")] for row in block.splitlines()]
        for block in blocks
    ]


def example():
    block = re.search(r"```hex\n(.*?)```", SPEC, re.DOTALL)
    length = re.search(r"the file has (\d+) bytes", SPEC)
    assert block
    assert length
    data = bytearray(int(length.group(1)))
    for line in block.group(1).splitlines():
        at, words = line.split(":")
        data[int(at, 16) : int(at, 16) + 16] = bytes.fromhex(words)
    return bytes(data)


def test_the_records_are_the_specifications_tables():
    found = tables(SPEC, "offset | bytes | type | field | rule")
    assert len(found) == len(layout.RECORDS)
    for rows, record in zip(found, layout.RECORDS, strict=True):
        written = [(int(row[0]), int(row[1]), TYPES[row[2]], row[3]) for row in rows]
        assert written == [(field.offset, field.size, field.kind, field.name) for field in record.fields]


@pytest.mark.parametrize("record", layout.RECORDS, ids=lambda record: record.name)
def test_the_fields_of_a_record_leave_no_byte_out(record):
    assert record.dtype.itemsize == record.size
    assert [record.dtype.fields[field.name][1] for field in record.fields] == [
        f.offset for f in record.fields
    ]
    assert [record.dtype[field.name].itemsize for field in record.fields] == [f.size for f in record.fields]


def test_the_sections_are_the_specifications_table():
    (rows,) = tables(SPEC, "kind | must be understood | bytes | content")
    assert [(row[0].encode(), row[1] == "yes") for row in rows] == [
        (section.kind, section.must_understand) for section in layout.SECTIONS
    ]
    for n, v, s in [(1, 3, 1), (13, 15, 4), (1000, 700, 33)]:
        lengths = layout.section_lengths(n, v, s, flips=True, remap=True)
        assert [LENGTHS[row[2]](n, v, s) for row in rows] == list(lengths.values())


def test_the_issues_are_the_catalogue():
    text = (FORMAT / "ISSUES.md").read_text(encoding="utf-8")
    (rows,) = tables(text, "code | severity | clause | message | remedy")
    assert rows == [[i.code, i.severity, i.clause, i.message, i.remedy] for i in ISSUES.values()]


def test_every_clause_is_a_heading():
    headings = set(re.findall(r"^#+ (\d+(?:\.\d+)?)\.? ", SPEC, re.MULTILINE))
    assert {issue.clause for issue in ISSUES.values()} <= headings


def test_the_version_and_the_magic_are_the_specifications():
    assert f"**Version** {layout.VERSION[0]}.{layout.VERSION[1]} of the format" in SPEC
    assert layout.MAGIC.hex(" ").upper() in SPEC


def test_the_worked_bytes_are_the_scene_that_the_text_says():
    data = example()
    assert validate(data) == []
    scene = read_scene(data)
    counts = (scene.triangle_count, scene.vertex_count, scene.strip_count, scene.source_face_count)
    assert counts == (4, 8, 2, 5)
    assert [tuple(face) for face in scene.faces().tolist()] == rows_after("The triangles, in file order:")
    source = {
        int(face): row for face, row in zip(scene.remap.face, scene.to_mesh().faces.tolist(), strict=False)
    }
    said = re.findall(r"(\d): (\([^)]*\))", SPEC.rsplit("in these positions:", 1)[1])
    assert source == {int(face): [int(x) for x in row.strip("()").split(",")] for face, row in said}
    np.testing.assert_array_equal(scene.hierarchy.boxes, [[0, 0, 0, 5, 1, 0]])
    again = io.BytesIO()
    scene.save(again)
    assert again.getvalue() == data


def test_the_decoding_of_the_specification_gives_the_same_triangles():
    scene = read_scene(example())
    emitted = []
    for i in range(scene.strip_count):
        at = scene.starts[i] + 2 * i
        a, b, c = scene.vertices[at : at + 3]
        emitted.append((a, b, c))
        for t in range(scene.starts[i] + 1, scene.starts[i + 1]):
            w = scene.vertices[at + 2 + t - scene.starts[i]]
            a, b, c = (a, c, w) if scene.turns[t] else (c, b, w)
            emitted.append((b, a, c) if scene.flips[t] else (a, b, c))
    np.testing.assert_array_equal(emitted, scene.faces())


def rows_after(sentence):
    line = SPEC.split(sentence, 1)[1].strip().splitlines()[0]
    return [tuple(int(x) for x in row.split(",")) for row in re.findall(r"\(([^)]*)\)", line)]
