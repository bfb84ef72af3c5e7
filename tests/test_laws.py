"""Laws of decoders: whatever bytes a file has, it is refused with a code or is a valid scene, soon."""

import io
import time
import tracemalloc

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import scenes

from formats import VECTORS, agree, errors_of, make, mended, plans, reference
from striptools.errors import UnreadableSceneError
from striptools.reducem.reader import read_scene
from striptools.reducem.validate import validate

SMALL = ("triangle", "remap_flips", "boxes_two_blocks", "metadata", "unknown_sections", "presorted_one_tree")
DEEP = ("boxes_triangle", "flips", "mode_1_narrow", "heap_strips", "loose_strips", "cells_strips")
DEEP += ("presorted_one_tree",)
MOST_SECONDS = 2.0
MOST_BYTES = 30_000_000


def vector(name):
    return (VECTORS / "valid" / f"{name}.rdm").read_bytes()


def refused_by_all(data):
    assert errors_of(data)
    with pytest.raises(reference.RefusedError):
        reference.read(data)
    with pytest.raises(UnreadableSceneError, match="RDM"):
        read_scene(data)


@pytest.mark.parametrize("name", SMALL)
def test_every_prefix_is_refused(name):
    data = vector(name)
    for length in range(len(data)):
        refused_by_all(data[:length])


@pytest.mark.parametrize("name", SMALL)
@pytest.mark.parametrize("byte", [0, 1, 255])
def test_every_byte_more_is_refused(name, byte):
    data = vector(name)
    for more in (1, 2, 63, 64, 65, 128):
        refused_by_all(data + bytes([byte]) * more)


@pytest.mark.parametrize("name", SMALL)
def test_every_flipped_bit_is_refused(name):
    data = bytearray(vector(name))
    for bit in range(8 * len(data)):
        data[bit // 8] ^= 1 << bit % 8
        refused_by_all(bytes(data))
        data[bit // 8] ^= 1 << bit % 8


@pytest.mark.parametrize("name", DEEP)
def test_every_flipped_bit_under_mended_checksums_is_judged_alike(name):
    data = bytearray(vector(name))
    valid = 0
    for bit in range(8 * len(data)):
        data[bit // 8] ^= 1 << bit % 8
        valid += not agree(mended(bytes(data)))
        data[bit // 8] ^= 1 << bit % 8
    assert 0 < valid < 8 * len(data) / 2


@given(plans(), st.data())
def test_files_that_no_encoder_chose_are_read_alike(plan, data):
    made = make.encode(plan)
    assert agree(made) == set()
    damaged = bytearray(made)
    for _ in range(data.draw(st.integers(1, 3))):
        damaged[data.draw(st.integers(32, len(made) - 1))] = data.draw(st.integers(0, 255))
    agree(mended(bytes(damaged)))


@given(plans())
def test_the_plans_decode_to_their_points_and_strips(plan):
    decoded = reference.read(make.encode(plan))
    wanted = make.decoding(plan)
    assert ["".join(f"{bits:08x}" for bits in vertex) for vertex in decoded.vertices] == wanted["vertices"]
    assert decoded.faces == wanted["faces"]


@given(scenes())
def test_scenes_of_the_pipeline_are_read_alike(drawn):
    file = io.BytesIO()
    drawn[1].save(file)
    assert agree(file.getvalue()) == set()


@given(scenes())
def test_archives_of_the_pipeline_are_valid(drawn):
    pytest.importorskip("zstandard")
    file = io.BytesIO()
    drawn[1].save(file, archive=True)
    assert agree(file.getvalue()) == set()
    assert validate(file.getvalue()) == []


@given(st.binary(max_size=400))
def test_noise_is_refused(noise):
    refused_by_all(noise)
    refused_by_all(vector("triangle")[:32] + noise)


@pytest.mark.parametrize(
    "kind",
    ["nodes_huge", "blocks_huge", "sections_many", "packed_bomb", "metadata_very_deep", "hierarchy_huge"],
)
def test_no_count_is_believed_that_the_bytes_do_not_bear_out(kind):
    data = (VECTORS / "invalid" / f"{kind}.rdm").read_bytes()
    for look in (validate, lambda data: refused_by_all(data)):
        tracemalloc.start()
        start = time.perf_counter()
        look(data)
        seconds, peak = time.perf_counter() - start, tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert seconds < MOST_SECONDS
        assert peak < MOST_BYTES
