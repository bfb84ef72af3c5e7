"""Blocks: what goes in comes out, bit for bit, as narrow as the content allows, and every flaw is refused."""

from dataclasses import replace

import numpy as np
import pytest
from block_twin import alone, axis_widths, read_blocks
from hypothesis import given
from hypothesis import strategies as st

from striptools.errors import UnreadableSceneError, UsageError
from striptools.reducem.blocks import Blocks, decode_blocks, encode_blocks
from striptools.strips.ordering import Sequences
from striptools.strips.topology import Strips, decode_strips, encode_strips, split_fans

KINDS = ("normal", "lattice", "tiny", "denormal", "huge", "crossing", "planar", "border", "any")
MINUS = np.float32(-0.0)


def coordinates(kind: str, count: int, random: np.random.Generator) -> np.ndarray:
    """(count, 3) float32 of a kind that an encoder may stumble over."""
    unit = random.uniform(-1, 1, (count, 3))
    if kind == "any":
        words = random.integers(0, 2**32, (count, 3), np.uint64).astype(np.uint32)
        words[(words & 0x7F800000) == 0x7F800000] ^= np.uint32(1 << 30)
        return words.view(np.float32)
    made = {
        "normal": unit * 50 + 100,
        "lattice": random.integers(-30, 30, (count, 3)) * 0.25,
        "tiny": unit * 1e-30,
        "denormal": unit * 1e-40,
        "huge": unit * 3e38,
        "crossing": unit,
        "planar": np.concatenate([unit[:, :2] + 3, np.full((count, 1), 0.1)], axis=1),
        "border": 1 + unit * 1e-4,
    }[kind]
    return made.astype(np.float32)


def strips_of(faces: np.ndarray, random: np.random.Generator, longest: int) -> Strips:
    """Strips of faces as they stand, cut where a face does not follow, and at random lengths."""
    starts, begin = [0], 0
    for k in range(1, len(faces)):
        if k - begin >= random.integers(1, longest + 1) or not follows(faces, begin, k):
            starts.append(k)
            begin = k
    sequences = Sequences(np.arange(len(faces), dtype=np.int32), np.array([*starts, len(faces)], np.int32))
    return split_fans(encode_strips(faces, sequences), faces)


def follows(faces: np.ndarray, begin: int, end: int) -> bool:
    order = np.arange(end - begin + 1, dtype=np.int32)
    try:
        encode_strips(faces[begin : end + 1], Sequences(order, np.array([0, len(order)], np.int32)))
    except UsageError:
        return False
    return True


def ribbon(count: int, vertex_count: int, random: np.random.Generator) -> np.ndarray:
    """Faces in a row, each over an edge of the one before, that use exactly so many vertices."""
    faces = [(0, 1, 2)]
    while len(faces) < count:
        a, b, c = faces[-1]
        used = max(max(face) for face in faces) + 1
        w = used if used < vertex_count else int(random.integers(0, vertex_count))
        one, two = ((a, c, w), (c, b, w)) if random.random() < 0.5 else ((c, b, w), (a, c, w))
        rows = [row for row in (one, two) if len(set(row)) == 3]
        if rows:
            faces.append(rows[0])
    return np.array(faces, np.int32)


def packed(positions: np.ndarray, strips: Strips, block_strips: list[int] | None = None) -> Blocks:
    ends = [0, len(strips.starts) - 1] if block_strips is None else block_strips
    return encode_blocks(positions, strips, np.array(ends, np.int32))


def same_bits(one: np.ndarray, two: np.ndarray) -> bool:
    return np.array_equal(one.view(np.uint32), two.view(np.uint32))


@given(
    st.sampled_from(KINDS),
    st.integers(1, 256),
    st.integers(3, 256),
    st.booleans(),
    st.integers(0, 2**32 - 1),
)
def test_a_block_comes_back_bit_for_bit(kind, count, vertices, minus, seed):
    random = np.random.default_rng(seed)
    vertices = min(vertices, count + 2)
    faces = ribbon(count, vertices, random)
    positions = coordinates(kind, vertices, random)
    if minus:
        positions[random.random(positions.shape) < 0.3] = MINUS
    strips = strips_of(faces, random, 64)
    blocks = packed(positions, strips)
    decoded = decode_blocks(blocks)
    assert same_bits(decoded.positions[decoded.vertices], positions[strips.vertices])
    np.testing.assert_array_equal(decoded.turns, strips.turns)
    np.testing.assert_array_equal(decoded.starts, strips.starts)
    assert decoded.flips is None
    (twin,) = read_blocks(blocks.headers, blocks.words)
    assert np.array_equal(np.array(twin.vertices, np.uint32), decoded.positions.view(np.uint32))
    rows = decode_strips(decoded.vertices, decoded.turns, decoded.starts)
    assert np.array_equal(rows, twin.triangles)
    assert [alone(twin, t) for t in range(count)] == twin.triangles
    modes, widths = blocks.axes()
    for axis in range(3):
        words = decoded.positions.view(np.uint32)[:, axis].tolist()
        by_mode = axis_widths(words)
        narrowest = min(w for w in by_mode if w is not None)
        assert (int(modes[0, axis]), int(widths[0, axis])) == (by_mode.index(narrowest), narrowest)


@pytest.mark.parametrize("count", [1, 255, 256])
@pytest.mark.parametrize("vertices", [3, 4, 5, 128, 129, 255, 256])
def test_limits_of_a_block(count, vertices):
    random = np.random.default_rng(count * 1000 + vertices)
    if vertices > count + 2:
        # Triangles that share nothing, so that every one is a strip of its own.
        vertices = min(vertices, 3 * count)
        faces = np.array([[3 * k, 3 * k + 1, 3 * k + 2] for k in range(vertices // 3)], np.int32)
    else:
        faces = ribbon(count, vertices, random)
    positions = coordinates("normal", vertices, random)
    strips = strips_of(faces, random, 200)
    decoded = decode_blocks(packed(positions, strips))
    assert same_bits(decoded.positions[decoded.vertices], positions[strips.vertices])


@pytest.mark.parametrize("width", range(25))
@pytest.mark.parametrize("step", [-1, 0, 1])
def test_widths_at_their_limits(width, step):
    spread = max(0, min(2**width + step, 2**24))
    positions = np.array([[0, 1, 7], [spread, 1, 7], [spread // 2, 1, 7]], np.float32)
    strips = encode_strips(
        np.array([[0, 1, 2]], np.int32), Sequences(np.array([0], np.int32), np.array([0, 1], np.int32))
    )
    blocks = packed(positions, strips)
    assert same_bits(decode_blocks(blocks).positions, positions)
    assert blocks.axes()[1][0, 1:].tolist() == [0, 0]
    assert blocks.axes()[1][0, 0] <= spread.bit_length()


def many_blocks(seed: int) -> tuple[np.ndarray, Strips, list[int]]:
    random = np.random.default_rng(seed)
    parts = [ribbon(int(random.integers(1, 257)), int(random.integers(3, 200)), random) for _ in range(300)]
    faces = np.concatenate(parts)
    positions = coordinates("normal", int(faces.max()) + 1, random)
    first = np.cumsum([0, *(len(part) for part in parts)])
    starts = np.unique(
        np.concatenate(
            [strips_of(part, random, 64).starts[:-1] + f for part, f in zip(parts, first[:-1], strict=True)]
        )
    )
    sequences = Sequences(
        np.arange(len(faces), dtype=np.int32), np.append(starts, len(faces)).astype(np.int32)
    )
    strips = split_fans(encode_strips(faces, sequences), faces)
    return positions, strips, np.searchsorted(strips.starts, first).tolist()


def test_threads_do_not_change_a_byte():
    positions, strips, block_strips = many_blocks(1)
    ends = np.array(block_strips, np.int32)
    one = encode_blocks(positions, strips, ends, 1)
    for threads in (2, 5):
        more = encode_blocks(positions, strips, ends, threads)
        np.testing.assert_array_equal(one.headers, more.headers)
        np.testing.assert_array_equal(one.words, more.words)
        a, b = decode_blocks(one, 1), decode_blocks(more, threads)
        assert same_bits(a.positions, b.positions)
        np.testing.assert_array_equal(a.vertices, b.vertices)
    decoded = decode_blocks(one)
    assert same_bits(decoded.positions[decoded.vertices], positions[strips.vertices])
    np.testing.assert_array_equal(decoded.starts, strips.starts)
    np.testing.assert_array_equal(decoded.block_starts, strips.starts[ends])
    total = one.totals()
    assert total["vertices"] == len(decoded.positions)
    assert total["strips"] == len(decoded.starts) - 1
    assert len(one.words) % 16 == 0
    assert 16 <= len(one.words) - total["words"] < 32


def test_flip_bits_come_back():
    random = np.random.default_rng(7)
    faces = ribbon(90, 60, random)
    positions = coordinates("normal", 60, random)
    strips = strips_of(faces, random, 30)
    flips = random.random(90) < 0.3
    flips[strips.starts[:-1]] = False
    blocks = packed(positions, replace(strips, flips=flips))
    decoded = decode_blocks(blocks)
    np.testing.assert_array_equal(decoded.flips, flips)
    (twin,) = read_blocks(blocks.headers, blocks.words)
    assert twin.flips == flips.astype(int).tolist()
    rows = decode_strips(decoded.vertices, decoded.turns, decoded.starts)
    rows[flips, :2] = rows[flips, 1::-1]
    assert np.array_equal(rows, twin.triangles)
    assert [alone(twin, t) for t in range(90)] == twin.triangles


@pytest.mark.parametrize("blades", [31, 32, 33, 62, 63, 64, 150])
@pytest.mark.parametrize("turned", [0, 1, 2])
def test_long_fans_are_cut(blades, turned):
    rim = 1 + np.arange(blades)
    faces = np.stack([0 * rim, rim, 1 + rim], axis=1).astype(np.int32)
    faces = np.ascontiguousarray(np.roll(faces, turned, axis=1))
    for way in (faces, np.ascontiguousarray(faces[::-1])):
        order = np.arange(blades, dtype=np.int32)
        strips = split_fans(encode_strips(way, Sequences(order, np.array([0, blades], np.int32))), way)
        # The second bit is free, so that 32 faces may do with one strip.
        assert blades == 32 or (len(strips.starts) == 2) == (blades < 32)
        positions = coordinates("normal", blades + 2, np.random.default_rng(0))
        if blades <= 254:
            decoded = decode_blocks(packed(positions, strips))
            assert np.array_equal(
                decoded.positions[decode_strips(decoded.vertices, decoded.turns, decoded.starts)],
                positions[decode_strips(strips.vertices, strips.turns, strips.starts)],
            )


def test_no_block_holds_too_much():
    random = np.random.default_rng(3)
    faces = ribbon(257, 40, random)
    positions = coordinates("normal", 257, random)
    with pytest.raises(UsageError, match="block 0: more than 256"):
        packed(positions, strips_of(faces, random, 64))
    wide = np.arange(258, dtype=np.int32).reshape(-1, 3)
    with pytest.raises(UsageError, match="more than 256"):
        packed(coordinates("normal", 258, random), strips_of(wide, random, 64))


@given(st.integers(0, 2**32 - 1), st.data())
def test_a_flipped_bit_is_refused_or_another_block(seed, data):
    random = np.random.default_rng(seed % 5)
    faces = ribbon(40, 25, random)
    blocks = packed(coordinates("crossing", 25, random), strips_of(faces, random, 12))
    broken = Blocks(blocks.headers.copy(), blocks.words.copy())
    target = data.draw(st.sampled_from(["headers", "words"]))
    flat = getattr(broken, target).reshape(-1).view(np.uint8)
    at = data.draw(st.integers(0, 8 * len(flat) - 1))
    flat[at // 8] ^= np.uint8(1 << at % 8)
    try:
        decoded = decode_blocks(broken)
    except UnreadableSceneError:
        return
    (twin,) = read_blocks(broken.headers, broken.words)
    assert np.array_equal(np.array(twin.vertices, np.uint32), decoded.positions.view(np.uint32))


def edit_header(row: int, bits: int, *, whole: bool = False):
    """Replace a word of the first header, or set bits of it."""

    def change(blocks: Blocks) -> Blocks:
        blocks.headers[0, row] = bits if whole else blocks.headers[0, row] | np.uint32(bits)
        return blocks

    return change


def edit_data(bit: int, value: int, width: int = 1):
    """Replace bits of the data."""

    def change(blocks: Blocks) -> Blocks:
        for k in range(width):
            place, mask = (bit + k) // 32, np.uint32(1 << (bit + k) % 32)
            blocks.words[place] = blocks.words[place] & ~mask | (mask if value >> k & 1 else np.uint32(0))
        return blocks

    return change


# The block has 40 triangles and 25 vertices: indices of 5 bits from bit 80 on, the first three are 0, 1, 2.
FLAWS = {
    "RDM107": edit_header(2, 1 << 25),
    "RDM601": edit_header(0, 1),
    "RDM602": edit_header(1, 1),
    "RDM603": edit_header(2, 39 | 1 << 8 | 3 << 16, whole=True),
    "RDM604": edit_header(6, 0xC0),
    "RDM605": edit_data(-1, 1),
    "RDM606": lambda blocks: Blocks(blocks.headers, np.append(blocks.words, np.zeros(16, np.uint32))),
    "RDM607": edit_data(0, 0),
    "RDM608": edit_data(40, 1),
    "RDM611": edit_data(80, 31, 5),
    "RDM612": edit_data(80, 1, 5),
    "RDM614": edit_data(90, 0, 5),
    "RDM615": edit_header(3, 0x7FFFFFFF, whole=True),
}


@pytest.mark.parametrize("code", FLAWS)
def test_each_flaw_has_its_code(code):
    random = np.random.default_rng(11)
    faces = ribbon(40, 25, random)
    blocks = packed(coordinates("lattice", 25, random), strips_of(faces, random, 12))
    with pytest.raises(UnreadableSceneError, match=f"scene: BLK[HD]: block [01]: {code} "):
        decode_blocks(FLAWS[code](blocks))


def test_flaws_of_strips_have_their_codes():
    random = np.random.default_rng(5)
    fan = np.stack([0 * np.arange(40), 1 + np.arange(40), 2 + np.arange(40)], axis=1).astype(np.int32)
    positions = coordinates("normal", 42, random)
    whole = encode_strips(fan, Sequences(np.arange(40, dtype=np.int32), np.array([0, 40], np.int32)))
    with pytest.raises(UnreadableSceneError, match="RDM610"):
        decode_blocks(packed(positions, whole))
    blocks = packed(positions, replace(split_fans(whole, fan), flips=np.arange(40) == 5))
    with pytest.raises(UnreadableSceneError, match="RDM609"):
        decode_blocks(edit_data(80 + 5, 0)(blocks))
    pair = encode_strips(fan[:2], Sequences(np.arange(2, dtype=np.int32), np.array([0, 2], np.int32)))
    blocks = packed(positions, pair)
    # The last of four indices, of two bits from bit 8 on, is no longer the fourth vertex.
    with pytest.raises(UnreadableSceneError, match="RDM613"):
        decode_blocks(edit_data(4 + 6, 0, 2)(blocks))
