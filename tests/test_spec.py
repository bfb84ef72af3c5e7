"""The specification and the code say the same: tables, sections, limits, issues and the worked bytes."""

import re
import struct

import numpy as np
import pytest
from conftest import ROOT

from formats import cases, make, reference
from striptools.reducem import layout
from striptools.reducem.issues import ISSUES, catalogue
from striptools.reducem.reader import read_scene
from striptools.reducem.validate import validate

FORMAT = ROOT / "formats" / "reducem"
SPEC = (FORMAT / "SPEC.md").read_text(encoding="utf-8")
EXAMPLE = SPEC.split("## 9. A worked example", 1)[1]
TYPES = {
    **{"8 x char": "S8", "4 x char": "S4", "8 x u8": "8u1", "24 x u8": "24u1", "u8": "u1"},
    "12 x f64": "12<f8",
    **{f"{kind}{8 * size}": f"<{kind}{size}" for kind in "iuf" for size in (2, 4, 8)},
}
LENGTHS = {
    "96": lambda n, b, m, r: 96,
    "32b": lambda n, b, m, r: 32 * b,
    "64m": lambda n, b, m, r: 64 * m,
    "align(4b) + 4r": lambda n, b, m, r: -(-b // 16) * 64 + 4 * r,
    "4n + ceil(n/4)": lambda n, b, m, r: 4 * n + -(-n // 4),
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
    block = re.search(r"```hex\n(.*?)```", EXAMPLE, re.DOTALL)
    length = re.search(r"the file has (\d+) bytes", EXAMPLE)
    assert block
    assert length
    data = bytearray(int(length.group(1)))
    for line in block.group(1).splitlines():
        at, words = line.split(":")
        data[int(at, 16) : int(at, 16) + 16] = bytes.fromhex(words)
    return bytes(data)


def numbers(text):
    """All rows in brackets as tuples of numbers."""
    return [tuple(float(x) for x in row.split(",")) for row in re.findall(r"\(([-\d., ]*)\)", text)]


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


def test_the_makers_records_are_the_specifications_tables():
    found = tables(SPEC, "offset | bytes | type | field | rule")
    assert [row[3] for row in found[0]] == [*make.HEADER, "checksum"]
    for rows, fields in zip(found[1:4], (make.ENTRY, make.RECORD, make.BLOCK), strict=True):
        assert [(row[3], int(row[1])) for row in rows] == [
            (name, struct.calcsize(f"<{kind}")) for name, kind in fields.items()
        ]


def test_the_sections_are_the_specifications_table():
    (rows,) = tables(SPEC, "kind | must be understood | bytes | content")
    assert [(row[0].encode(), row[1] == "yes") for row in rows] == [
        (section.kind, section.must_understand) for section in layout.SECTIONS
    ]
    for n, b, m, r in [(1, 1, 0, 1), (13, 2, 4, 9), (1000, 7, 33, 500)]:
        lengths = layout.section_lengths(n, b, m, r, boxes_stored=True)
        written = {row[0].encode(): LENGTHS[row[2]](n, b, m, r) for row in rows if row[2] in LENGTHS}
        assert written == lengths
        assert layout.section_lengths(n, b, m, r, boxes_stored=False)[b"RUNS"] == 0


def test_the_codecs_are_the_specifications_table():
    (rows,) = tables(SPEC, "codec | name | for | what the frame holds")
    assert [(int(row[0]), row[1]) for row in rows] == [
        (layout.CODEC_RAW, "raw"),
        (layout.CODEC_ZSTD, "zstd"),
        (layout.CODEC_BLOCKS, "blocks"),
        (layout.CODEC_PLANES, "planes"),
    ]
    for codec, _, kinds, _ in rows[2:]:
        having = [s.kind.decode() for s in layout.SECTIONS if int(codec) in layout.codecs_of(s)]
        assert kinds.split(", ") == having
    widths = [f"{width} in {kind.decode()}" for kind, width in layout.PLANE_WIDTHS.items()]
    assert f"bytes of a record, {', '.join(widths[:3])} and {widths[3]}" in SPEC.replace("\n", " ")
    assert f"2^{layout.LARGEST_WINDOW} bytes" in SPEC


def test_the_limits_are_the_specifications():
    assert f"1 to {layout.SECTION_LIMIT} |" in SPEC
    assert f"{layout.GRID_EXPONENTS[0]} to {layout.GRID_EXPONENTS[-1]} where positions lie on a grid" in SPEC
    assert f"{layout.CELL_EXPONENTS[0]} to {layout.CELL_EXPONENTS[-1]} |" in SPEC
    assert f"1 to {layout.LONGEST_RUN}; 0 where boxes are not stored" in SPEC
    assert f"for its k triangles, 1 to {layout.BLOCK_TRIANGLES} |" in SPEC
    assert f"for its q vertices, 3 to {layout.BLOCK_VERTICES} |" in SPEC
    assert f"No more than {layout.LONGEST_EQUAL_TURNS} turn bits in a row" in SPEC
    assert f"there must be {layout.ZERO_WORDS} words of zero" in SPEC
    assert "at most 2^24; 0 exactly" in SPEC
    assert (layout.BLOCK_LIMIT, layout.NODE_LIMIT, layout.METADATA_LIMIT) == (2**24, 2**28, 2**20)
    # A block's stream is longest with all its triangles apart, and 32 bits for each coordinate.
    words = -(-(3 * 256 + 3 * 256 * 8 + 256 * 96) // 32)
    assert f"no more than {4 * words}b + 128" in SPEC
    assert 4 * words == layout.MOST_BLOCK_BYTES


def test_the_issues_are_the_catalogue():
    text = (FORMAT / "ISSUES.md").read_text(encoding="utf-8")
    assert text == catalogue()
    (rows,) = tables(text, "code | severity | clause | message | remedy")
    assert rows == [[i.code, i.severity, i.clause, i.message, i.remedy] for i in ISSUES.values()]


def test_every_clause_is_a_heading():
    headings = set(re.findall(r"^#+ (\d+(?:\.\d+)?)\.? ", SPEC, re.MULTILINE))
    assert {issue.clause for issue in ISSUES.values()} <= headings


def test_the_version_and_the_magic_are_the_specifications():
    assert f"**Version** {layout.VERSION[0]}.{layout.VERSION[1]} of the format" in SPEC
    assert f"major is {layout.VERSION[0]} and minor {layout.VERSION[1]}" in SPEC
    assert layout.MAGIC.hex(" ").upper() in SPEC


def test_the_worked_bytes_are_the_vector():
    assert example() == make.encode(cases.worked_example())
    assert validate(example()) == []


def test_the_worked_bytes_are_the_container_that_the_text_says():
    data = example()
    told = re.search(r"\*\*Container\.\*\*(.*?)\n\n", EXAMPLE, re.DOTALL)
    assert told
    places = [int(at, 16) for at in re.findall(r"\b0[0-9A-F]{2}\b", told[1])][1:]
    assert places == list(range(32, 32 + 40 * data[12], 40))
    sections = re.findall(r"([A-Z]{4}) at ([0-9A-F]{3})", told[1].replace("\n", " "))
    assert len(sections) == data[12]
    for kind, at in sections:
        row = data.index(kind.encode())
        assert struct.unpack_from("<Q", data, row + 8)[0] == int(at, 16)
        assert data[row + 4] == (kind != "RMAP")


def test_the_worked_bits_are_those_of_the_table():
    data = example()
    stream = int.from_bytes(data[0x200:0x240], "little")
    (rows,) = tables(EXAMPLE, "part | first bit | bits, in numbers of |")
    for _, first, widths, written in rows:
        at = int(first)
        row = [int(width) for width in widths.split(" and ")]
        values = [int(x) for x in re.findall(r"\d+", written)]
        for i, value in enumerate(values):
            width = row[i % len(row)]
            assert stream >> at & (1 << width) - 1 == value
            at += width
    assert at == 41
    assert f"the words {data[0x203:0x1FF:-1].hex().upper()} and {data[0x207:0x203:-1].hex().upper()}" in SPEC


def test_the_worked_bytes_are_the_scene_that_the_text_says():
    scene = read_scene(example())
    counts = (scene.triangle_count, scene.block_count, scene.source_face_count)
    assert f"n = {counts[0]}, b = {counts[1]}, m = {len(scene.packed.nodes)}, top_count = " in EXAMPLE
    assert f"source_face_count = {counts[2]}" in EXAMPLE
    faces = numbers(EXAMPLE.split("The triangles, in file order:", 1)[1].split("\n\n")[0])
    np.testing.assert_array_equal(scene.faces(), faces)
    told = [
        numbers(EXAMPLE.split(word, 1)[1].split("Triangle 1")[0]) for word in ("vertices are", "block 0, are")
    ]
    positions = np.array([*told[0], *told[1][:4]], np.float32)
    np.testing.assert_array_equal(scene.positions.view(np.uint32), positions.view(np.uint32))
    source = dict(
        zip(scene.remap.face.tolist(), scene.to_mesh().positions[scene.to_mesh().faces], strict=False)
    )
    rows = re.findall(r"(\d): (\([^)]*\))", EXAMPLE.split("in these\npositions:", 1)[1])
    order = np.argsort(scene.remap.face)
    assert [int(face) for face, _ in rows] == scene.remap.face[order].tolist()
    assert len(source) == len(rows)
    for (face, row), t in zip(rows, order, strict=True):
        turned = np.roll(scene.faces()[t], scene.remap.rotation[t])
        assert numbers(row) == [tuple(turned.astype(float))], face


def test_the_worked_bytes_are_written_again_by_the_writer(tmp_path):
    path = tmp_path / "again.rdm"
    read_scene(example()).save(path)
    assert path.read_bytes() == example()


def test_the_decoding_of_the_specification_gives_the_same_triangles():
    scene = read_scene(example())
    assert reference.read(example()).faces == scene.faces().tolist()
