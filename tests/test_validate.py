"""The validator says what is wrong, where and how to mend it; the command ends in the right exit code."""

import csv
import io
import json
import struct
import subprocess
import sys
from functools import partial

import numpy as np
import pytest

from formats import VECTORS, cases, make
from striptools.reducem.issues import ISSUES
from striptools.reducem.validate import validate

GOOD = VECTORS / "valid" / "boxes_two_blocks.rdm"
BAD = VECTORS / "invalid" / "index_too_large.rdm"
MOST_SECONDS = 20.0


def only(path_or_data, code):
    (finding,) = [finding for finding in validate(path_or_data) if finding.issue.code == code]
    return finding


def section(data, kind):
    """Where a section begins."""
    for at in range(32, 32 + 40 * data[12], 40):
        if data[at : at + 4] == kind:
            return struct.unpack_from("<Q", data, at + 8)[0]
    raise AssertionError(kind)


@pytest.mark.parametrize(
    ("name", "code", "kind", "byte"),
    [
        ("error_nan", "RDM202", b"SCEN", 32),
        ("cell_high", "RDM206", b"SCEN", 68),
        ("reserved_2", "RDM107", b"SCEN", 28),
        ("low_minus_zero", "RDM205", b"SCEN", 44),
        ("first_triangle_later", "RDM601", b"BLKH", 32),
        ("word_again", "RDM602", b"BLKH", 36),
        ("unused_word", "RDM605", b"BLKD", 127),
        ("leak_high_y", "RDM707", b"NODE", 64 + 16),
        ("run_of_another_block", "RDM704", b"NODE", 128 + 4),
        ("run_overlap", "RDM803", b"RUNS", 64),
        ("remap_beyond", "RDM502", b"RMAP", 16),
        ("rotation", "RDM501", b"RMAP", 21),
        ("metadata_bytes", "RDM901", b"META", 7),
    ],
)
def test_a_finding_names_the_byte(name, code, kind, byte):
    data = (VECTORS / "invalid" / f"{name}.rdm").read_bytes()
    finding = only(data, code)
    assert finding.offset == section(data, kind) + byte
    assert finding.place.startswith(kind.decode())


def test_a_finding_of_a_bit_names_the_byte_it_is_in():
    data = BAD.read_bytes()
    finding = only(data, "RDM611")
    # Four start bits, four turn bits, and five indices of three bits before the wrong one.
    assert finding.offset == section(data, b"BLKD") + (8 + 5 * 3) // 8
    assert finding.place == "BLKD: block 0, index 5"


def test_a_flaw_that_is_there_often_is_said_once_with_its_number():
    plan = make.Plan(cases.blocks_of(9), record={"source_face_count": 99}, remap=[(7, 3)] * 18)
    finding = only(make.encode(plan), "RDM501")
    assert finding.place == "RMAP: triangle 0 (the first of 18)"


def test_paths_streams_and_bytes_are_the_same():
    data = BAD.read_bytes()
    found = [[(f.issue.code, f.offset) for f in validate(source)] for source in (BAD, data, io.BytesIO(data))]
    assert found[0] == found[1] == found[2]


def test_what_cannot_be_read_is_a_finding(tmp_path):
    assert [f.issue.code for f in validate(tmp_path)] == ["RDM001"]
    assert [f.issue.code for f in validate(tmp_path / "missing.rdm")] == ["RDM001"]


def test_every_finding_has_a_remedy_and_a_clause():
    for issue in ISSUES.values():
        assert issue.remedy
        assert issue.clause
        assert issue.severity in ("error", "information")


def test_without_its_codec_an_archive_is_passed_over_and_said_to_be(monkeypatch):
    monkeypatch.setitem(sys.modules, "zstandard", None)
    findings = validate(VECTORS / "valid" / "archive.rdm")
    assert [(f.issue.code, f.place) for f in findings] == [
        ("RDM123", kind) for kind in ("BLKH", "BLKD", "NODE", "RUNS", "RMAP", "META")
    ]
    assert {f.issue.severity for f in findings} == {"information"}
    # What the frame says of itself is judged without it.
    for name in ("packed_cut", "packed_twice", "packed_dictionary", "packed_window", "packed_other_length"):
        assert "RDM121" in [f.issue.code for f in validate(VECTORS / "invalid" / f"{name}.rdm")]


def test_a_large_chain_of_nodes_ends_soon():
    whole = ((0, 0, 0), (255, 255, 255))
    nodes = [make.Node([make.Slot(True, *whole)], base=i + 1) for i in range(20_000)]
    nodes.append(make.Node([make.Slot(False, *whole)]))
    assert validate(make.encode(make.Plan([cases.TRIANGLE], stored=True, nodes=nodes))) == []


def test_a_real_model_is_valid_and_judged_in_seconds(real_mesh, tmp_path):
    import time

    import striptools

    path = tmp_path / "bunny.rdm"
    striptools.convert(striptools.load_mesh(real_mesh("bunny"))).save(path)
    start = time.perf_counter()
    assert validate(path) == []
    assert time.perf_counter() - start < MOST_SECONDS


# The command


@pytest.fixture
def run(run):
    return partial(run, "validate")


def test_a_valid_file_is_said_to_be_so(run):
    assert run(GOOD) == (0, "boxes_two_blocks.rdm: valid\n", "")


def test_information_is_no_fault(run):
    code, out, _ = run(VECTORS / "valid" / "unknown_sections.rdm")
    assert code == 0
    assert out.startswith("unknown_sections.rdm: valid\n")
    assert out.count("RDM115") == 2


def test_a_fault_ends_in_1_and_one_line(run):
    code, out, err = run(VECTORS / "invalid" / "error_negative.rdm")
    assert (code, err) == (1, "")
    assert out.splitlines() == [
        "error_negative.rdm: NOT valid, 1 kind of error",
        f"  RDM202 1  error, byte {192 + 32}, SCEN: the error bound is negative or not finite "
        "(SPEC 4.1; report it to the maker of the program that wrote the file)",
    ]


def test_json_is_a_record_and_csv_and_md_are_tables(run):
    facts = json.loads(run(BAD, "--format", "json")[1])
    assert facts["valid"] is False
    assert facts["errors"] == len(facts["findings"]) == 3
    rows = list(csv.DictReader(io.StringIO(run(BAD, "--format", "csv")[1])))
    assert [row["code"] for row in rows] == [finding["code"] for finding in facts["findings"]]
    assert [int(row["offset"]) for row in rows] == [finding["offset"] for finding in facts["findings"]]
    assert run(BAD, "--format", "md")[1].count("\n") == 7
    assert run(GOOD, "--format", "csv")[1] == "severity,code,clause,offset,place,message,remedy\n"
    assert json.loads(run(GOOD, "--format", "json")[1]) == {"valid": True, "errors": 0, "findings": []}


@pytest.mark.parametrize("name", ["cut_0", "cut_5", "cut_31", "major_1", "sections_many"])
def test_damage_of_any_kind_is_a_fault(run, name):
    assert run(VECTORS / "invalid" / f"{name}.rdm")[0] == 1


@pytest.mark.parametrize("name", ["magic", "other_file", "magic_text_mode"])
def test_a_file_of_another_magic_ends_in_3(run, name):
    code, out, err = run(VECTORS / "invalid" / f"{name}.rdm")
    assert (code, out) == (3, "")
    assert "RDM102" in err
    assert err.count("\n") == 1


def test_a_file_that_cannot_be_opened_ends_in_3(run, tmp_path):
    assert run(tmp_path / "missing.rdm")[0] == 3
    code, out, err = run(tmp_path)
    assert (code, out) == (3, "")
    assert "RDM001" in err


def test_standard_input_is_read():
    command = [sys.executable, "-m", "striptools_cli.app", "validate", "-"]
    done = subprocess.run(command, input=GOOD.read_bytes(), capture_output=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (0, b"standard input: valid\n")


# The reference reader's command line


def reader(*arguments):
    command = [sys.executable, "-I", str(VECTORS.parent / "reference" / "reader.py"), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)


def test_the_reference_reader_prints_a_summary():
    done = reader(GOOD)
    assert (done.returncode, done.stderr) == (0, "")
    assert "triangles: 4\n" in done.stdout
    assert "nodes: 3, 1 of them over blocks\n" in done.stdout


def test_the_reference_reader_prints_an_obj():
    done = reader("--obj", GOOD)
    lines = [line.split() for line in done.stdout.splitlines()]
    positions = np.array([line[1:] for line in lines if line[0] == "v"], np.float32)
    np.testing.assert_array_equal(positions, [p for block in cases.blocks_of(2) for p in block.points])
    assert [line[1:] for line in lines if line[0] == "f"] == [
        ["1", "2", "3"],
        ["3", "2", "4"],
        ["5", "6", "7"],
        ["7", "6", "8"],
    ]


def test_the_reference_reader_refuses_in_one_line():
    done = reader(BAD)
    assert (done.returncode, done.stdout) == (1, "")
    assert done.stderr.startswith("SPEC 4.3: block 0")
    assert done.stderr.count("\n") == 1
    assert reader(GOOD, BAD).returncode == 2
    assert reader(VECTORS / "valid" / "archive.rdm").stderr.count("a Zstandard decoder") == 1


def test_the_reference_reader_and_the_maker_need_the_standard_library_alone():
    for folder, name in ((VECTORS.parent / "reference", "reader"), (VECTORS, "cases")):
        script = (
            f"import sys; sys.path[:0] = [{str(folder)!r}]; import {name}; "
            "names = {module.partition('.')[0] for module in sys.modules} - sys.stdlib_module_names; "
            "print(sorted(names - {'__main__', 'reader', 'make', 'cases', 'sitecustomize'}))"
        )
        done = subprocess.run(
            [sys.executable, "-I", "-S", "-c", script], capture_output=True, text=True, check=True
        )
        assert done.stdout == "[]\n"
