"""What a tracer works out of nodes, runs and headers, against what SPEC 4.2, 4.4 and 4.5 say of them."""

import numpy as np
import pytest
from scenes import scene_of
from strategies import grid, soup, sphere

from striptools.kernels.packed_hits import BIAS, HEAD
from striptools.mesh.clean import clean
from striptools.mesh.mesh import Mesh
from striptools.trace.packed import lay_out_packed


def of_all_magnitudes():
    """A soup with coordinates of every mode, denormals among them."""
    random = np.random.default_rng(3)
    positions, faces = soup(400, 1, 1000)
    positions = positions * np.float32(10.0) ** random.integers(-42, 1, positions.shape).astype(np.float32)
    positions[random.random(positions.shape) < 0.05] = -0.0
    return clean(Mesh(positions, faces)).mesh


SCENES = {
    "one block": lambda: scene_of(Mesh(*grid(4, 4)), remap=False),
    "many": lambda: scene_of(Mesh(*sphere(5)), block=64),
    "flips": lambda: scene_of(Mesh(*sphere(4)), flips=True),
    "magnitudes": lambda: scene_of(of_all_magnitudes()),
}


@pytest.fixture(scope="module", params=SCENES)
def scene(request):
    return SCENES[request.param]()


def slots_by_spec(packed):
    """Where the child in each slot is: a node, or a run's first triangle, strip, turns and step back."""
    found = []
    records = packed.nodes.view(np.uint8).reshape(-1, 64)
    for node, (words, record) in enumerate(zip(packed.nodes.tolist(), records.tolist(), strict=True)):
        inner, low, high = record[14], record[16:24], record[40:48]
        row, leaves = [], 0
        for slot in range(8):
            if inner >> slot & 1:
                row.append((words[0] & 0xFFFFFFF) + bin(inner & (1 << slot) - 1).count("1"))
            elif low[slot] > high[slot]:
                row.append(None)
            else:
                block = words[1] & 0xFFFFFF
                if node < packed.top_count:
                    row.append(packed.top_count + block + leaves)
                else:
                    run = int(packed.runs[int(packed.first_run[block]) + (words[1] >> 24) + leaves])
                    turns = [run >> 19 + j & 1 for j in range((run >> 8 & 7) + 1)]
                    row.append((run & 0xFF, run >> 11 & 0xFF, turns, run >> 27))
                leaves += 1
        found.append(row)
    return found


def said_of(slot):
    """The same, of what is worked out."""
    if slot < 1 << 31:
        return slot
    turns = slot >> 21 & 0x1FF
    count = turns.bit_length() - 1
    if count == 0:
        return None
    return slot & 0xFF, slot >> 8 & 0xFF, [turns >> j & 1 for j in range(count)], slot >> 16 & 31


def test_slots_say_what_nodes_and_runs_say(scene):
    packed, slots = scene.with_boxes(), lay_out_packed(scene).arrays.slots.tolist()
    expected = slots_by_spec(packed)
    assert [[said_of(slot) for slot in row] for row in slots[: len(expected)]] == expected
    assert any(isinstance(child, tuple) for row in expected for child in row)


def test_blocks_say_what_headers_say(scene):
    layout = lay_out_packed(scene)
    scale_exponent = int(np.log2(layout.arrays.frame.scale))
    for header, said in zip(scene.blocks.headers.tolist(), layout.arrays.blocks.tolist(), strict=False):
        first, word, counts, *anchors = header[:6]
        triangles, vertices, strips = ((counts >> shift & 0xFF) + 1 for shift in (0, 8, 16))
        flips, width = counts >> 24 & 1, (vertices - 1).bit_length()
        indices = (2 + flips) * triangles
        begin = indices + (triangles + 2 * strips) * width
        packed = header[6] | header[7] << 32
        offset = 0
        for axis in range(3):
            bits, mode = packed >> 8 * axis & 63, packed >> 8 * axis + 6 & 3
            exponent = scale_exponent + (0 if mode == 2 else (packed >> 24 + 8 * axis & 0xFF) - 149)
            anchor, mask, power, rest = said[4 * axis : 4 * axis + 4]
            assert (anchor, mask) == (anchors[axis], (1 << bits) - 1)
            assert rest == offset | mode << 7 | (exponent + BIAS) << 9 | bits << 19
            if -126 <= exponent <= 127:
                assert np.uint32(power).view(np.float32) == np.float32(2.0) ** exponent
            offset += bits
        assert said[HEAD : HEAD + 2] == [first, word]
        assert said[HEAD + 2] == triangles - 1 | width << 8 | flips << 12 | begin << 13
        assert said[HEAD + 3] == offset | indices << 7


def test_triangles_are_decoded_by_them(scene):
    layout = lay_out_packed(scene)
    corners, turns = layout.corners_of(layout.names())
    # Corner j of those in the order of tests is the reported face's (j + turn) % 3.
    rotations = 0 if scene.remap is None else scene.remap.rotation.astype(np.int64)
    place = (np.arange(3) + turns[:, None] - np.reshape(rotations, (-1, 1))) % 3
    exact = scene.positions[scene.faces()].astype(np.float64) * float(layout.arrays.frame.scale)
    exact[np.abs(exact) < np.finfo(np.float32).tiny] = 0
    expected = np.take_along_axis(exact, place[:, :, None], axis=1)
    np.testing.assert_array_equal(corners.transpose(0, 2, 1), expected)
