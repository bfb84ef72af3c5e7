"""Slow twins of the encoder and decoder of blocks: integers and fractions, after SPEC.md 4.2 and 4.3."""

import struct
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

Corners = tuple[int, int, int]


@dataclass
class Block:
    """What a block holds: local corners of its triangles, where strips start, and its vertices' bits."""

    triangles: list[Corners]
    starts: list[int]
    turns: list[int]
    flips: list[int]
    index: list[int]
    vertices: list[Corners]


class Bits:
    """A bit stream as one integer."""

    def __init__(self, words: np.ndarray) -> None:
        self.number = int.from_bytes(words.astype("<u4").tobytes(), "little")

    def __call__(self, place: int, width: int) -> int:
        return self.number >> place & ((1 << width) - 1)


def read_blocks(headers: np.ndarray, words: np.ndarray) -> list[Block]:
    """Every block of valid sections."""
    bits = Bits(words)
    return [_read(header.astype("<u4").tobytes(), bits) for header in headers]


def _read(header: bytes, bits: Bits) -> Block:
    _, word, k, q, s, flags, *rest = struct.unpack("<IIBBBB3i3B3BH", header)
    anchors, axes, exponents = rest[:3], rest[3:6], rest[6:9]
    k, q, s = k + 1, q + 1, s + 1
    place = 32 * word
    starts = [bits(place + t, 1) for t in range(k)]
    turns = [bits(place + k + t, 1) for t in range(k)]
    place += 2 * k
    flips = [bits(place + t, 1) if flags & 1 else 0 for t in range(k)]
    place += k * (flags & 1)
    w = (q - 1).bit_length()
    index = [bits(place + w * j, w) for j in range(k + 2 * s)]
    place += w * (k + 2 * s)
    vertices = []
    for _ in range(q):
        vertex = []
        for axis in range(3):
            width = axes[axis] & 63
            vertex.append(
                _coordinate(axes[axis] >> 6, width, anchors[axis], exponents[axis], bits(place, width))
            )
            place += width
        vertices.append(tuple(vertex))
    return Block(_triangles(starts, turns, flips, index), starts, turns, flips, index, vertices)


def _coordinate(mode: int, width: int, anchor: int, exponent: int, u: int) -> int:
    i = anchor + u
    if mode == 2:
        return i if i >= 0 else 0x80000000 + (-1 - i)
    if mode == 1 and u == (1 << width) - 1:
        return 0x80000000
    return word_of(i * Fraction(2) ** (exponent - 149))


def word_of(value: Fraction) -> int:
    """The bits of the float32 that a fraction is exactly."""
    word = struct.unpack("<I", struct.pack("<f", float(value)))[0]
    assert Fraction(struct.unpack("<f", struct.pack("<I", word))[0]) == value
    return word


def _triangles(starts: list[int], turns: list[int], flips: list[int], index: list[int]) -> list[Corners]:
    triangles, i = [], -1
    a = b = c = 0
    for t, start in enumerate(starts):
        if start:
            i += 1
            a, b, c = index[t + 2 * i : t + 2 * i + 3]
        else:
            w = index[t + 2 * i + 2]
            a, b, c = (a, c, w) if turns[t] else (c, b, w)
        triangles.append((b, a, c) if flips[t] else (a, b, c))
    return triangles


def alone(block: Block, t: int) -> Corners:
    """Triangle t by the rule of SPEC.md 4.3 for a triangle alone."""
    i = sum(block.starts[: t + 1]) - 1
    t0 = max(p for p in range(t + 1) if block.starts[p])
    index, turns = block.index, block.turns
    c = index[t + 2 * i + 2]
    if t == t0:
        a, b = index[t + 2 * i], index[t + 2 * i + 1]
    else:
        u = max((p for p in range(t0 + 1, t + 1) if turns[p] != turns[t]), default=None)
        if turns[t] == 0:
            a, b = index[t + 2 * i + 1], index[(t0 if u is None else u) + 2 * i + 1]
        else:
            b, a = index[t + 2 * i + 1], index[t0 + 2 * i if u is None else u + 2 * i + 1]
    return (b, a, c) if block.flips[t] else (a, b, c)


def axis_widths(words: list[int]) -> list[int | None]:
    """The width that each mode asks for, for the bits of coordinates; None where it cannot hold them."""
    minus = 0x80000000 in words
    values = [
        Fraction(struct.unpack("<f", struct.pack("<I", word))[0]) for word in words if word != 0x80000000
    ]
    units = [int(value * 2**149) for value in values]
    finest = min(((unit & -unit).bit_length() - 1 for unit in units if unit), default=0)
    scaled = [unit >> min(finest, 255) for unit in units]
    fits = all(abs(unit) < 2**31 for unit in scaled)
    spread = max(scaled, default=0) - min(scaled, default=0)
    zero = spread.bit_length() if fits and not minus else None
    one = ((spread + 1).bit_length() if scaled else 1) if fits and minus else None
    ordered = [word if word < 0x80000000 else 0x80000000 - 1 - word for word in words]
    return [
        w if w is None or w <= 32 else None for w in (zero, one, (max(ordered) - min(ordered)).bit_length())
    ]
