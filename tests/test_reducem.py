"""Writer, reader and validator: the laws of a decoder, tried exhaustively on a small file."""

import io
import os
import struct
import tracemalloc
from functools import lru_cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import scenes, small_scene, table_of, with_checksums

from striptools.errors import UnreadableSceneError, WriteError
from striptools.hierarchies.check import check_binary_tree
from striptools.hierarchies.in_strip import expand_hierarchy
from striptools.partition.boxes import face_boxes
from striptools.reducem import layout
from striptools.reducem.issues import ISSUES
from striptools.reducem.reader import PIECE, read_scene
from striptools.reducem.validate import validate


def bytes_of(scene):
    file = io.BytesIO()
    scene.save(file)
    return file.getvalue()


@lru_cache
def small_bytes(*, flips=False):
    return bytes_of(small_scene(flips=flips))


@pytest.fixture
def data():
    return small_bytes()


@pytest.fixture(params=[False, True], ids=["plain", "flips"])
def either(request):
    return small_bytes(flips=request.param)


def arrays(scene):
    remap = () if scene.remap is None else (scene.remap.face, scene.remap.rotation)
    hierarchy = (scene.hierarchy.boxes, scene.hierarchy.left_count)
    flips = () if scene.flips is None else (scene.flips,)
    return (scene.positions, scene.vertices, scene.turns, *flips, scene.starts, *hierarchy, *remap)


def errors(data):
    return [finding.issue.code for finding in validate(data) if finding.issue.severity == "error"]


def read_or_code(data):
    try:
        return read_scene(data), None
    except UnreadableSceneError as error:
        return None, error.what.split()[0]


def verdict(data):
    """None where the bytes are a scene, which is then proved usable; else the code they are refused with.

    Reader and validator share no code, and have to agree.
    """
    codes = errors(data)
    scene, code = read_or_code(data)
    if scene is None:
        assert code in codes, (code, codes)
        assert ISSUES[code].severity == "error"
        return code
    assert codes == []
    boxes = face_boxes(scene.positions, scene.faces())
    check_binary_tree(expand_hierarchy(scene.hierarchy, scene.starts, boxes), boxes)
    assert scene.to_mesh().triangle_count == scene.triangle_count
    return None


@given(scenes())
def test_a_scene_comes_back_bit_for_bit(case):
    _, scene = case
    data = bytes_of(scene)
    again = read_scene(data)
    for one, other in zip(arrays(scene), arrays(again), strict=True):
        assert one.dtype == other.dtype
        assert one.shape == other.shape
        assert one.tobytes() == other.tobytes()
    assert (again.error_bound, again.source_face_count) == (scene.error_bound, scene.source_face_count)
    assert validate(data) == []
    assert bytes_of(again) == data


def test_path_stream_and_bytes_read_alike(either, tmp_path):
    path = tmp_path / "small.rdm"
    path.write_bytes(either)
    for source in (path, str(path), either, bytearray(either), memoryview(either), io.BytesIO(either)):
        assert bytes_of(read_scene(source)) == either
        if isinstance(source, io.BytesIO):
            source.seek(0)
        assert validate(source) == []


def test_a_stream_that_gives_a_byte_at_a_time_is_read(data):
    class Trickle(io.BytesIO):
        def read(self, size=-1):
            return super().read(min(size, 1))

    assert bytes_of(read_scene(Trickle(data))) == data


def test_saving_to_a_path_and_to_a_stream_gives_the_same_bytes(data, tmp_path):
    small_scene().save(tmp_path / "a.rdm")
    assert (tmp_path / "a.rdm").read_bytes() == data
    assert os.listdir(tmp_path) == ["a.rdm"]


def test_every_section_is_aligned_and_named_once(data):
    rows = table_of(data)
    kinds = [section.kind for section in layout.SECTIONS if section is not layout.FLIPS]
    assert [row[0] for row in rows] == kinds
    flipped = table_of(small_bytes(flips=True))
    assert [row[0] for row in flipped] == [section.kind for section in layout.SECTIONS]
    assert all(row[2] % 64 == 0 and row[3] > 0 for row in rows)
    assert len(data) % 64 == 0


def test_the_remap_and_an_empty_hierarchy_are_left_out():
    assert b"RMAP" not in [row[0] for row in table_of(bytes_of(small_scene(remap=False)))]


def test_every_prefix_is_refused(either):
    for length in range(len(either)):
        assert verdict(either[:length]) in {"RDM101", "RDM102", "RDM104"}


def test_every_extra_byte_is_refused(data):
    for byte in range(256):
        assert verdict(data + bytes([byte])) == "RDM104"


def test_every_flipped_bit_is_refused(either):
    for at in range(len(either)):
        for bit in range(8):
            flipped = bytearray(either)
            flipped[at] ^= 1 << bit
            assert verdict(bytes(flipped)) is not None, (at, bit)


def test_every_flipped_bit_under_right_checksums_is_refused_or_a_scene(either):
    accepted = 0
    for at in range(len(either)):
        if 28 <= at < 32:
            continue
        for bit in range(8):
            flipped = bytearray(either)
            flipped[at] ^= 1 << bit
            if 12 <= at < 16 and struct.unpack_from("<I", flipped, 12)[0] * 32 + 32 > len(either):
                assert verdict(bytes(flipped)) == "RDM105"
                continue
            accepted += verdict(with_checksums(flipped)) is None
    assert accepted > 0


@settings(max_examples=150)
@given(st.data())
def test_any_words_under_right_checksums_are_refused_or_a_scene(draw):
    data = small_bytes()
    changed = bytearray(data)
    values = st.sampled_from([0, 1, 2, 3, 2**29, 2**30, 2**31 - 1, 2**31, 2**32 - 1, 0x7F800000, 0x7FC00000])
    for _ in range(draw.draw(st.integers(1, 4))):
        _, _, offset, length, _, _ = draw.draw(st.sampled_from(table_of(data)))
        at = offset + 4 * draw.draw(st.integers(0, max(0, length // 4 - 1)))
        struct.pack_into("<I", changed, at, draw.draw(values | st.integers(0, 20)))
    verdict(with_checksums(changed))


def repacked(data, change):
    """A file of the same sections after `change(rows)`, laid out anew; a row is `[kind, flags, payload]`."""
    rows = [
        [kind, flags, data[offset : offset + length]] for kind, flags, offset, length, _, _ in table_of(data)
    ]
    change(rows)
    offset = layout.aligned(32 + 32 * len(rows))
    table, body = b"", b""
    for kind, flags, payload in rows:
        table += struct.pack("<4sIQQII", kind, flags, offset + len(body), len(payload), 0, 0)
        body += payload + bytes(-len(payload) % 64)
    header = data[:12] + struct.pack("<IQII", len(rows), offset + len(body), 0, 0)
    return with_checksums(header + table + bytes(offset - 32 - len(table)) + body)


def test_laying_out_anew_changes_nothing(data):
    assert repacked(data, lambda rows: None) == data


def test_an_unknown_section_is_passed_over_unless_it_must_be_understood(data):
    extra = repacked(data, lambda rows: rows.append([b"XTRA", 0, b"abc"]))
    assert bytes_of(read_scene(extra)) == data
    assert [finding.issue.code for finding in validate(extra)] == ["RDM115"]
    assert verdict(repacked(data, lambda rows: rows.append([b"XTRA", 1, b"abc"]))) == "RDM111"


@pytest.mark.parametrize("at", range(6))
def test_a_missing_section_is_refused(data, at):
    assert verdict(repacked(data, lambda rows: rows.pop(at))) == "RDM113"


@pytest.mark.parametrize("at", range(7))
def test_a_section_that_is_longer_shorter_twice_or_wrongly_flagged_is_refused(data, at):
    def longer(rows):
        rows[at][2] += bytes(4)

    def shorter(rows):
        rows[at][2] = rows[at][2][:-1]

    def flagged(rows):
        rows[at][1] ^= 1

    assert verdict(repacked(data, longer)) == "RDM114"
    assert verdict(repacked(data, shorter)) in {"RDM113", "RDM114"}
    assert verdict(repacked(data, flagged)) == "RDM116"
    assert verdict(repacked(data, lambda rows: rows.append(rows[at]))) == "RDM112"


def with_flips(data, payload):
    def change(rows):
        rows[:] = [row for row in rows if row[0] != b"FLIP"] + [[b"FLIP", 1, payload]]

    return repacked(data, change)


def test_each_rule_of_flip_bits_has_its_code():
    data = small_bytes(flips=True)
    (good,) = (data[row[2] : row[2] + row[3]] for row in table_of(data) if row[0] == b"FLIP")
    assert verdict(with_flips(data, good)) is None
    assert verdict(with_flips(data, bytes([good[0], good[1] | 0x20]))) == "RDM309"
    assert verdict(with_flips(data, bytes([good[0] | 1, good[1]]))) == "RDM310"
    assert verdict(with_flips(data, bytes(2))) == "RDM311"
    assert verdict(with_flips(data, good + bytes(1))) == "RDM114"
    unflagged = repacked(data, lambda rows: rows[4].__setitem__(1, 0))
    assert table_of(unflagged)[4][0] == b"FLIP"
    assert verdict(unflagged) == "RDM116"


def test_a_file_without_flip_bits_is_a_scene_of_one_winding():
    assert read_scene(small_bytes()).flips is None
    flipped = read_scene(small_bytes(flips=True))
    assert flipped.flips.any()
    dropped = repacked(small_bytes(flips=True), lambda rows: rows.pop(4))
    assert verdict(dropped) is None
    assert (read_scene(dropped).faces() != flipped.faces()).any(axis=1).tolist() == flipped.flips.tolist()


def test_an_empty_section_and_too_many_sections_are_refused(data):
    assert verdict(repacked(data, lambda rows: rows.append([b"XTRA", 0, b""]))) == "RDM109"
    many = repacked(data, lambda rows: rows.extend([[b"%04d" % k, 0, b"x"] for k in range(64)]))
    assert verdict(many) == "RDM105"


def test_the_order_of_sections_is_free(data):
    assert bytes_of(read_scene(repacked(data, list.reverse))) == data


@pytest.mark.parametrize("version", [(0, 1), (0, 3), (1, 0), (65535, 2)])
def test_another_version_is_refused_by_name(data, version):
    other = with_checksums(data[:8] + struct.pack("<HH", *version) + data[12:])
    with pytest.raises(UnreadableSceneError, match=rf"version {version[0]}\.{version[1]}.*RDM103"):
        read_scene(other)
    assert verdict(other) == "RDM103"


def test_a_file_that_is_not_there_or_a_folder_is_refused(tmp_path):
    for source in (tmp_path / "none.rdm", tmp_path, "a\0b"):
        with pytest.raises(UnreadableSceneError, match="RDM001"):
            read_scene(source)
        assert [finding.issue.code for finding in validate(source)] == ["RDM001"]


def test_the_line_names_place_flaw_and_remedy(data, tmp_path):
    path = tmp_path / "torn.rdm"
    path.write_bytes(data[:-1])
    with pytest.raises(UnreadableSceneError) as caught:
        read_scene(path)
    assert (
        str(caught.value)
        == f"{path}: RDM104 the file is not as long as its header says ({ISSUES['RDM104'].remedy})"
    )
    assert str(validate(path)[0]) == str(caught.value)


def test_an_endless_stream_without_the_magic_is_left_at_once():
    class Zeros(io.RawIOBase):
        asked = 0

        def read(self, size=-1):
            Zeros.asked += size
            return bytes(size)

    with pytest.raises(UnreadableSceneError, match="RDM102"):
        read_scene(Zeros())
    assert Zeros.asked <= PIECE


@pytest.mark.parametrize("claim", ["length", "triangles", "sections"])
def test_no_claim_of_a_file_makes_the_reader_allocate(data, claim):
    read_scene(data)
    changed = bytearray(data)
    scene_at = table_of(data)[0][2]
    if claim == "length":
        struct.pack_into("<Q", changed, 16, 2**62)
    elif claim == "triangles":
        struct.pack_into("<4I", changed, scene_at, 2**29, 2**29, 2**29, 2**30)
        changed = with_checksums(changed)
    else:
        struct.pack_into("<I", changed, 12, 2**32 - 1)
    tracemalloc.start()
    try:
        with pytest.raises(UnreadableSceneError):
            read_scene(io.BytesIO(bytes(changed)))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    # SPEC.md, section 6: ten times the bytes that are there, and one piece of a stream with change.
    assert peak <= 10 * len(data) + 2 * PIECE


def test_reading_stays_within_the_declared_memory():
    rows = 300
    scene = grid_scene(rows)
    data = bytes_of(scene)
    read_scene(data)
    tracemalloc.start()
    try:
        read_scene(io.BytesIO(data))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak <= 10 * len(data) + 2 * PIECE


def grid_scene(rows):
    from scenes import scene_of
    from strategies import grid

    from striptools.mesh.mesh import Mesh

    return scene_of(Mesh(*grid(rows, rows)))


def test_a_stream_that_refuses_is_a_write_error():
    class Full(io.BytesIO):
        def write(self, data):
            raise OSError(28, "No space left on device")

    with pytest.raises(WriteError, match="No space left"):
        small_scene().save(Full())


def test_the_same_scene_gives_the_same_bytes(data):
    assert bytes_of(small_scene()) == data
    assert np.frombuffer(data[:8], np.uint8).tobytes() == layout.MAGIC
