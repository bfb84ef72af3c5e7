"""Writer and reader: round trips, lazy opening, archives, streams; the laws are in tests/test_laws.py."""

import builtins
import io
import json
import os
import struct
import time
import tracemalloc
import zlib
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import scene_of, scenes, small_scene
from strategies import grid

import striptools
from formats import mended
from striptools.errors import MissingExtraError, UnreadableSceneError, WriteError
from striptools.mesh.attributes import Material
from striptools.mesh.mesh import Mesh
from striptools.reducem import layout
from striptools.reducem.attributes import Column
from striptools.reducem.issues import ISSUES
from striptools.reducem.reader import PIECE, open_scene, read_scene
from striptools.reducem.validate import validate


def bytes_of(scene, **options):
    file = io.BytesIO()
    scene.save(file, **options)
    return file.getvalue()


def full_scene():
    """A scene with every kind of section, of several blocks."""
    scene = small_scene(flips=True, block=6, boxes="stored")
    colours = np.arange(6, dtype=np.uint8).reshape(2, 3), np.arange(scene.vertex_count, dtype=np.int32) % 2
    groups = np.int32([[1], [0]]), np.minimum(np.arange(scene.triangle_count, dtype=np.int32), 1)
    return replace(
        scene,
        metadata={"generator": "a test", "source": "s"},
        columns=(Column("color", "vertex", *colours), Column("group", "face", *groups)),
        materials=(Material("red"), Material("", (0.0, 0.5, 1.0, 0.25), "body")),
        origin=np.array([1e6, 0.0, -2e6]),
    )


@pytest.fixture(params=["plain", "full"])
def data(request):
    return bytes_of(small_scene() if request.param == "plain" else full_scene())


def table_of(data):
    """The section table as lists `[kind, flags, codec, offset, stored, raw, checksum, raw checksum]`."""
    count = struct.unpack_from("<I", data, 12)[0]
    return [list(row) for row in struct.iter_unpack("<4sHHQQQII", bytes(data[32 : 32 + 40 * count]))]


def place_of(data, kind):
    return next(row[3] for row in table_of(data) if row[0] == kind)


def arrays(scene):
    remap = () if scene.remap is None else (scene.remap.face, scene.remap.rotation)
    packed = scene.packed
    stored = () if packed.runs is None else (packed.first_run, packed.runs)
    return (
        *(scene.blocks.headers, scene.blocks.words, packed.nodes, *stored, *remap),
        *(scene.positions, scene.vertices, scene.turns, scene.starts, scene.faces(), scene.low, scene.high),
        *(array for one in scene.columns for array in (one.rows, one.numbers)),
        *(() if scene.origin is None else (scene.origin,)),
    )


def assert_same(one, other):
    for a, b in zip(arrays(one), arrays(other), strict=True):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        assert a.tobytes() == b.tobytes()
    for name in (
        "error_bound",
        "source_face_count",
        "grid_exponent",
        "metadata",
        "materials",
        "boxes",
        "block_count",
    ):
        assert getattr(one, name) == getattr(other, name)
    assert one.packed.top_count == other.packed.top_count
    assert one.packed.longest_run == other.packed.longest_run


@given(scenes(), st.booleans())
def test_a_scene_comes_back_bit_for_bit(case, archive):
    _, scene = case
    data = bytes_of(scene, archive=archive)
    again = read_scene(data)
    assert_same(scene, again)
    assert validate(data) == []
    assert bytes_of(again) == bytes_of(scene)
    assert len(data) <= len(bytes_of(scene))


def test_path_stream_and_bytes_read_alike(data, tmp_path):
    path = tmp_path / "small.rdm"
    path.write_bytes(data)
    for source in (path, str(path), data, bytearray(data), memoryview(data), io.BytesIO(data)):
        for read in (read_scene, open_scene):
            assert bytes_of(read(source)) == data
            if isinstance(source, io.BytesIO):
                source.seek(0)


def test_a_stream_that_gives_a_byte_at_a_time_is_read(data):
    class Trickle(io.BytesIO):
        def read(self, size=-1):
            return super().read(min(size, 1))

    assert bytes_of(read_scene(Trickle(data))) == data


def test_a_pipe_is_read_as_a_stream(data, tmp_path):
    read_end, write_end = os.pipe()
    with open(write_end, "wb") as file:
        file.write(data)
    with open(read_end, "rb"):
        assert bytes_of(open_scene(f"/dev/fd/{read_end}")) == data


def test_saving_to_a_path_and_to_a_stream_gives_the_same_bytes(data, tmp_path):
    assert read_scene(data).save(tmp_path / "a.rdm") == len(data)
    assert (tmp_path / "a.rdm").read_bytes() == data
    assert os.listdir(tmp_path) == ["a.rdm"]


def test_an_open_file_can_be_replaced_by_its_own_scene(tmp_path):
    scene = full_scene()
    scene.save(tmp_path / "a.rdm")
    opened = open_scene(tmp_path / "a.rdm")
    opened.save(tmp_path / "a.rdm")
    assert_same(scene, opened)
    assert (tmp_path / "a.rdm").read_bytes() == bytes_of(scene)


def test_every_section_is_aligned_and_named_once():
    data = bytes_of(full_scene())
    rows = table_of(data)
    kinds = [section.kind for section in layout.SECTIONS]
    beside = (b"GEOM", b"INST", b"HIER", b"TRIS")
    assert [row[0] for row in rows] == [kind for kind in kinds if kind not in beside]
    assert all(row[3] % 64 == 0 and row[4] > 0 for row in rows)
    assert len(data) % 64 == 0


def test_what_a_scene_does_not_need_is_left_out():
    kinds = [row[0] for row in table_of(bytes_of(small_scene(remap=False)))]
    assert kinds == [b"SCEN", b"BLKH", b"BLKD"]


# Opening


def test_opening_a_large_file_costs_nothing(tmp_path):
    scene = scene_of(Mesh(*grid(300, 300)))
    scene.save(tmp_path / "grid.rdm")
    least = min(_seconds(lambda: striptools.open(tmp_path / "grid.rdm")) for _ in range(5))
    assert least < 0.01
    assert_same(scene, striptools.open(tmp_path / "grid.rdm"))


def _seconds(work):
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def broken_at(data, kind, tmp_path):
    """A file with one wrong bit in a section, and none of its checksums mended."""
    damaged = bytearray(data)
    damaged[place_of(data, kind)] ^= 1
    (tmp_path / "broken.rdm").write_bytes(damaged)
    return tmp_path / "broken.rdm"


USES = {
    b"SCEN": lambda scene: scene.error_bound,
    b"BLKH": lambda scene: scene.triangle_count,
    b"BLKD": lambda scene: scene.positions,
    b"NODE": lambda scene: scene.with_boxes(),
    b"RUNS": lambda scene: scene.packed,
    b"RMAP": lambda scene: scene.remap,
    b"META": lambda scene: scene.metadata,
}


@pytest.mark.parametrize("kind", USES)
def test_a_damaged_section_is_refused_when_it_is_used_and_by_check(kind, tmp_path):
    path = broken_at(bytes_of(full_scene()), kind, tmp_path)
    scene = striptools.open(path)
    for _ in range(2):
        with pytest.raises(UnreadableSceneError, match=f"{kind.decode()}: RDM110"):
            USES[kind](scene)
    with pytest.raises(UnreadableSceneError, match="RDM110"):
        scene.check()
    with pytest.raises(UnreadableSceneError, match="RDM110"):
        read_scene(path)


def test_an_undamaged_section_of_a_damaged_file_can_be_used(tmp_path):
    scene = striptools.open(broken_at(bytes_of(full_scene()), b"RMAP", tmp_path))
    assert scene.faces().shape == (13, 3)
    assert scene.with_boxes().longest_run == 8
    with pytest.raises(UnreadableSceneError, match="RMAP"):
        scene.to_mesh()


@pytest.mark.parametrize("word", [0, 1, 2, 3, 4])
def test_wrong_nodes_under_right_checksums_are_refused_before_they_are_walked(word):
    data = bytearray(bytes_of(full_scene()))
    data[place_of(data, b"NODE") + 4 * word] ^= 0xFF
    scene = open_scene(mended(bytes(data)))
    assert scene.faces().shape == (13, 3)
    for use in (lambda: scene.packed, scene.with_boxes, scene.check):
        with pytest.raises(UnreadableSceneError, match=r"RDM70\d"):
            use()


# Archives


def test_an_archive_expands_to_the_file_written_without_it(tmp_path):
    scene = replace(scene_of(Mesh(*grid(40, 40)), block=64, boxes="stored"), metadata={"source": "grid"})
    raw, packed = bytes_of(scene), bytes_of(scene, archive=True)
    assert len(packed) < len(raw)
    rows = table_of(packed)
    assert rows[0][:3] == [b"SCEN", 1, 0]
    assert [row[2] for row in rows] == [0, 3, 2, 3, 3, 3, 0]
    assert all(row[4] < row[5] for row in rows if row[2])
    assert validate(packed) == []
    assert bytes_of(read_scene(packed)) == raw
    (tmp_path / "a.rdm").write_bytes(packed)
    assert bytes_of(striptools.open(tmp_path / "a.rdm")) == raw
    assert bytes_of(scene, archive=True) == packed


def test_without_its_codec_an_archive_is_refused_by_name(monkeypatch):
    scene = scene_of(Mesh(*grid(9, 9)))
    packed = bytes_of(scene, archive=True)
    plain_import = builtins.__import__

    def refuse(name, *rest):
        if name == "zstandard":
            raise ImportError(name)
        return plain_import(name, *rest)

    monkeypatch.setattr(builtins, "__import__", refuse)
    for use in (lambda: read_scene(packed), lambda: bytes_of(scene, archive=True)):
        with pytest.raises(MissingExtraError, match=r"zstandard .*striptools\[archive\]"):
            use()
    assert open_scene(packed).error_bound == 0.0


def repacked(data, kind, stored):
    """An archive whose section of this kind, the last one, has other stored bytes."""
    rows = table_of(data)
    at = next(k for k, row in enumerate(rows) if row[0] == kind)
    assert at == len(rows) - 1
    body = bytearray(data[: rows[at][3]]) + stored + bytes(-len(stored) % 64)
    struct.pack_into("<QQ", body, 32 + 40 * at + 8, rows[at][3], len(stored))
    struct.pack_into("<Q", body, 16, len(body))
    return mended(bytes(body))


def test_a_frame_that_is_not_what_the_table_says_is_refused():
    import zstandard

    scene = scene_of(Mesh(*grid(30, 30)))
    packed = bytes_of(scene, archive=True)
    raw_length = table_of(packed)[-1][5]
    right = bytes(raw_length)
    wrong = {
        "RDM122": zstandard.compress(right),
        "RDM121": zstandard.compress(right + b"\0"),
        "shorter": zstandard.compress(right[:-1]),
        "behind": zstandard.compress(right) + b"\0",
        "no frame": b"zstd, or not",
        "bomb": zstandard.ZstdCompressor(write_content_size=False).compress(bytes(50_000_000)),
    }
    for name, stored in wrong.items():
        data = repacked(packed, b"RMAP", stored)
        scene = open_scene(data)
        tracemalloc.start()
        with pytest.raises(UnreadableSceneError, match="RDM122" if name == "RDM122" else "RDM121"):
            _ = scene.remap
        assert tracemalloc.get_traced_memory()[1] < 1_000_000
        tracemalloc.stop()


# Metadata


@pytest.mark.parametrize(
    ("text", "code"),
    [
        (b"[]", "RDM901"),
        (b"{", "RDM901"),
        (b"\xff", "RDM901"),
        (b'{"a":NaN}', "RDM901"),
        (b'{"unit":3}', "RDM903"),
        (b'{"a":' + b"[" * 40 + b"]" * 40 + b"}", "RDM904"),
    ],
)
def test_metadata_that_are_none_are_refused(text, code):
    data = bytes_of(replace(small_scene(), metadata={"a": "x" * 100}))
    changed = mended(repacked(data, b"META", text.ljust(len(text))))
    count = struct.unpack_from("<I", changed, 12)[0]
    again = bytearray(changed)
    struct.pack_into("<Q", again, 32 + 40 * (count - 1) + 24, len(text))
    with pytest.raises(UnreadableSceneError, match=code):
        read_scene(mended(bytes(again)))


def test_any_json_comes_back():
    metadata = {"generator": "g", "": [1, {"x": None}], "größe": 1.5, "deep": "[[[[{{{{" * 9, "big": 10**50}
    back = read_scene(bytes_of(replace(small_scene(), metadata=metadata)))
    assert back.metadata == metadata
    assert json.dumps(back.metadata) == json.dumps(metadata)


# Refusals


@pytest.mark.parametrize("version", [(0, 1), (0, 3), (0, 5), (1, 0), (65535, 4)])
def test_another_version_is_refused_by_name(data, version):
    other = mended(data[:8] + struct.pack("<HH", *version) + data[12:])
    with pytest.raises(UnreadableSceneError, match=rf"version {version[0]}\.{version[1]}.*RDM103"):
        open_scene(other)


def test_a_file_that_is_not_there_or_a_folder_is_refused(tmp_path):
    for source in (tmp_path / "none.rdm", tmp_path, "a\0b"):
        with pytest.raises(UnreadableSceneError, match="RDM001"):
            open_scene(source)


def test_the_line_names_place_flaw_and_remedy(data, tmp_path):
    path = tmp_path / "torn.rdm"
    path.write_bytes(data[:-1])
    with pytest.raises(UnreadableSceneError) as caught:
        open_scene(path)
    assert (
        str(caught.value)
        == f"{path}: RDM104 the file is not as long as its header says ({ISSUES['RDM104'].remedy})"
    )


def test_an_empty_or_tiny_file_is_refused(tmp_path):
    for content, code in ((b"", "RDM101"), (layout.MAGIC, "RDM101"), (b"ply\n", "RDM102")):
        (tmp_path / "tiny.rdm").write_bytes(content)
        with pytest.raises(UnreadableSceneError, match=code):
            open_scene(tmp_path / "tiny.rdm")


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
    if claim == "length":
        struct.pack_into("<Q", changed, 16, 2**62)
    elif claim == "triangles":
        struct.pack_into("<6I", changed, place_of(data, b"SCEN"), 2**29, 2**22, 2**20, 2**20, 0, 2**30)
        changed = mended(bytes(changed))
    else:
        struct.pack_into("<I", changed, 12, 2**32 - 1)
    tracemalloc.start()
    try:
        with pytest.raises(UnreadableSceneError):
            read_scene(io.BytesIO(bytes(changed)))
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak <= 10 * len(data) + 2 * PIECE


def test_a_stream_that_refuses_is_a_write_error():
    class Full(io.BytesIO):
        def write(self, data):
            raise OSError(28, "No space left on device")

    with pytest.raises(WriteError, match="No space left"):
        small_scene().save(Full())


def test_a_write_that_fails_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    (tmp_path / "a.rdm").write_bytes(b"old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("striptools.reducem.writer._chunks", fail)
    with pytest.raises(WriteError, match="No space left"):
        small_scene().save(tmp_path / "a.rdm")
    assert (tmp_path / "a.rdm").read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["a.rdm"]


def test_the_same_scene_gives_the_same_bytes(data):
    assert bytes_of(small_scene()) == bytes_of(small_scene())
    assert data[:8] == layout.MAGIC
    header = zlib.crc32(data[:28] + data[32 : 32 + 40 * len(table_of(data))])
    assert header == struct.unpack_from("<I", data, 28)[0]
