"""Archives: what comes out is what went in, fast equals slow, and no byte of a stream leads astray."""

import io
from dataclasses import replace

import numpy as np
import pytest
from conftest import ROOT
from hypothesis import given
from hypothesis import strategies as st
from scenes import scenes, small_scene
from test_blocks import KINDS, MINUS, coordinates, ribbon, strips_of

import striptools
from formats import VECTORS, agree, errors_of, make, mended
from striptools.errors import UnreadableSceneError
from striptools.options import Options
from striptools.reducem import archive, layout
from striptools.reducem.blocks import Blocks, check_headers, decode_blocks, encode_blocks
from striptools.reducem.inspection import Inspection, Section
from striptools.reducem.quantize import PrecisionOptions
from striptools.reducem.reader import read_scene
from striptools.reducem.validate_archive import content_limit, join_blocks, join_planes
from striptools.reducem.validate_blocks import inspect_headers
from striptools.strips.ordering import Sequences
from striptools.strips.topology import encode_strips, split_fans


def saved(scene, *, archive=False):
    file = io.BytesIO()
    scene.save(file, archive=archive)
    return file.getvalue()


def blocks_that_share(kind, counts, seed, minus):
    """Blocks of ribbons over one pool of points, so that some points are in several blocks."""
    random = np.random.default_rng(seed)
    pool = coordinates(kind, 300, random)
    if minus:
        pool[random.random(pool.shape) < 0.3] = MINUS
    faces, starts, firsts = [], [], [0]
    for count in counts:
        local = ribbon(count, int(random.integers(3, count + 3)), random)
        starts += (strips_of(local, random, 64).starts[:-1] + firsts[-1]).tolist()
        faces.append(random.permutation(300)[local].astype(np.int32))
        firsts.append(firsts[-1] + len(local))
    faces = np.concatenate(faces)
    order = np.arange(len(faces), dtype=np.int32)
    strips = encode_strips(faces, Sequences(order, np.array([*starts, len(faces)], np.int32)))
    strips = split_fans(strips, faces)
    return encode_blocks(pool, strips, np.searchsorted(strips.starts, firsts).astype(np.int32))


def plan_of(blocks, decoded):
    """The blocks as the vectors' maker takes them."""
    modes, widths = blocks.axes()
    flips = np.zeros(len(decoded.turns), np.bool_) if decoded.flips is None else decoded.flips
    made, strip = [], 0
    for k, header in enumerate(blocks.headers):
        first, end = decoded.vertex_starts[k], decoded.vertex_starts[k + 1]
        strips = []
        while strip < len(decoded.starts) - 1 and decoded.starts[strip] < decoded.block_starts[k + 1]:
            begin, last = decoded.starts[strip], decoded.starts[strip + 1]
            index = decoded.vertices[begin + 2 * strip : last + 2 * strip + 2] - first
            letters = (
                "".join(str(int(bit)) for bit in bits[begin + 1 : last]) for bits in (decoded.turns, flips)
            )
            strips.append(make.Strip(index.tolist(), *letters))
            strip += 1
        if not header[2] >> 24:
            strips = [one._replace(flips="") for one in strips]
        anchors = header[3:6].view(np.int32).tolist()
        exponents = header[6:8].view(np.uint8)[3:6].tolist()
        columns = (anchors, widths[k].tolist(), modes[k].tolist(), exponents)
        axes = tuple(make.Axis(*row) for row in zip(*columns, strict=True))
        made.append(make.Block(strips, decoded.positions[first:end].tolist(), axes))
    return made


def joined(blocks, content):
    """The words that the kernels make of a content, or None."""
    target = Blocks(blocks.headers, np.zeros_like(blocks.words))
    check_headers(target, blocks.triangle_count)
    try:
        archive.from_content(content, target)
    except UnreadableSceneError:
        return None
    return target.words.tobytes()


def of_validator(blocks):
    """The headers as the validator holds them."""
    inspection = Inspection(b"", "test")
    sections = (
        Section("BLKH", 0, 0, blocks.headers.tobytes()),
        Section("BLKD", 0, 2, bytes(blocks.words.nbytes)),
    )
    headers = inspect_headers(inspection, *sections)
    assert inspection.findings == []
    return headers


def check_all_ways(blocks):
    """Assert that kernels, maker and validator agree on blocks."""
    decoded = decode_blocks(blocks)
    content = archive.content_of(blocks, decoded)
    assert content == make.content(make.streams(plan_of(blocks, decoded)))
    headers = of_validator(blocks)
    assert len(content) <= content_limit(headers)
    assert joined(blocks, content) == blocks.words.tobytes()
    assert join_blocks(content, headers, blocks.words.nbytes) == blocks.words.tobytes()


@given(
    st.sampled_from(KINDS),
    st.lists(st.integers(1, 256) | st.integers(1, 6), min_size=1, max_size=3),
    st.integers(0, 2**32 - 1),
    st.booleans(),
)
def test_blocks_of_any_numbers_come_back_and_fast_equals_slow(kind, counts, seed, minus):
    check_all_ways(blocks_that_share(kind, counts, seed, minus))


@given(scenes())
def test_a_scene_expands_to_the_file_written_without_an_archive(case):
    scene = case[1]
    check_all_ways(scene.blocks)
    raw, packed = saved(scene), saved(scene, archive=True)
    assert saved(read_scene(packed)) == raw
    assert errors_of(packed) == set()


@pytest.mark.parametrize("bits", [None, 16, 8])
def test_a_sample_expands_to_the_file_written_without_an_archive(bits):
    precision = PrecisionOptions() if bits is None else PrecisionOptions(bits=bits)
    scene = striptools.convert(ROOT / "samples" / "chandelier.ply", Options(precision=precision))
    if bits == 16:
        check_all_ways(scene.blocks)
    for one in (scene, scene.storing_boxes(), replace(scene, remap=None)):
        raw, packed = saved(one), saved(one, archive=True)
        assert len(packed) < 0.75 * len(raw)
        assert saved(read_scene(packed)) == raw
        assert saved(one, archive=True) == packed
    assert errors_of(packed) == set()


def test_a_vertex_of_an_earlier_block_is_told_once():
    blocks = blocks_that_share("normal", [200, 200], 1, minus=False)
    content = make.streams(plan_of(blocks, decode_blocks(blocks)))
    assert 0 < sum(content["known"]) == len(content["places"])
    assert len(content["known"]) - sum(content["known"]) == len(content["x"]) <= 300


# Hostile bytes


def test_every_prefix_and_every_byte_more_is_refused():
    blocks = blocks_that_share("crossing", [9, 30, 5], 2, minus=True)
    content = archive.content_of(blocks, decode_blocks(blocks))
    headers = of_validator(blocks)
    for damaged in [content[:length] for length in range(len(content))] + [content + b"\0", content * 2]:
        assert joined(blocks, damaged) is None
        assert join_blocks(damaged, headers, blocks.words.nbytes) is None


@pytest.mark.parametrize("kind", ["crossing", "any", "denormal"])
def test_every_flipped_bit_is_refused_or_decodes_alike(kind):
    blocks = blocks_that_share(kind, [9, 20, 5], 3, minus=True)
    content = bytearray(archive.content_of(blocks, decode_blocks(blocks)))
    headers = of_validator(blocks)
    refused = 0
    for bit in range(8 * len(content)):
        content[bit // 8] ^= 1 << bit % 8
        fast = joined(blocks, bytes(content))
        assert fast == join_blocks(bytes(content), headers, blocks.words.nbytes)
        assert fast != blocks.words.tobytes()
        refused += fast is None
        content[bit // 8] ^= 1 << bit % 8
    assert 0 < refused < 8 * len(content)


@given(st.integers(0, 2**32 - 1), st.data())
def test_any_bytes_are_refused_or_decode_alike(seed, data):
    blocks = blocks_that_share("any", [12, 3, 40], seed, minus=True)
    content = bytearray(archive.content_of(blocks, decode_blocks(blocks)))
    for _ in range(data.draw(st.integers(1, 20))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    words = join_blocks(bytes(content), of_validator(blocks), blocks.words.nbytes)
    assert joined(blocks, bytes(content)) == words


@pytest.mark.parametrize("bits", [1, 7, 2**31])
def test_headers_of_other_numbers_are_no_way_out(bits):
    blocks = blocks_that_share("crossing", [40, 40], 4, minus=False)
    content = archive.content_of(blocks, decode_blocks(blocks))
    headers = blocks.headers.copy()
    headers[1, 3:6] += np.uint32(bits)
    other = Blocks(headers, blocks.words)
    words = joined(other, content)
    assert words == join_blocks(content, of_validator(other), blocks.words.nbytes)
    assert words != blocks.words.tobytes()


def test_every_prefix_and_flipped_bit_of_a_small_archive_is_refused():
    data = saved(small_scene(block=4), archive=True)
    for length in range(0, len(data), 3):
        with pytest.raises(UnreadableSceneError, match="RDM"):
            read_scene(data[:length])
    damaged = bytearray(data)
    for bit in range(8 * len(data)):
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(UnreadableSceneError, match="RDM"):
            read_scene(bytes(damaged))
        damaged[bit // 8] ^= 1 << bit % 8


@pytest.mark.parametrize("name", ["archive_blocks", "archive_blocks_modes"])
def test_every_flipped_bit_under_mended_checksums_is_judged_alike(name):
    data = bytearray((VECTORS / "valid" / f"{name}.rdm").read_bytes())
    for bit in range(8 * len(data)):
        data[bit // 8] ^= 1 << bit % 8
        agree(mended(bytes(data)))
        data[bit // 8] ^= 1 << bit % 8


# Planes


@given(st.binary(max_size=300), st.sampled_from(sorted(layout.PLANE_WIDTHS)))
def test_planes_come_back(raw, kind):
    width = layout.PLANE_WIDTHS[kind]
    codec, stored = archive.packed(raw or b"\0", kind)
    assert codec == layout.CODEC_PLANES
    back = archive.expanded(memoryview(stored), codec, kind, len(raw or b"\0"), "test")
    assert back.tobytes() == (raw or b"\0")
    assert join_planes(make.planes(raw, width), width) == raw
