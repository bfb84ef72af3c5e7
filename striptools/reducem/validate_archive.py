"""The validator's way into packed sections of codecs 2 and 3 (SPEC.md, section 6), without the reader's.

Plain loops over Python numbers find the vertices of strips; the bits of all blocks are put in place at once.
"""

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from striptools.reducem.validate_blocks import Blocks

__all__ = ["content_limit", "join_blocks", "join_planes"]

_ALL = 2**32


class _UnfitError(Exception):
    """The streams are not what the headers ask for."""


def join_planes(planes: bytes, width: int) -> bytes:
    """The records of `width` bytes whose first bytes come first, then their second ones, and what is left."""
    rows = len(planes) // width
    out = bytearray(planes)
    for k in range(width):
        out[k : rows * width : width] = planes[k * rows : (k + 1) * rows]
    return bytes(out)


def content_limit(blocks: Blocks) -> int:
    """The most bytes that the frame of codec 2 may hold."""
    n, c, q = (int(column.sum()) for column in (blocks.k, blocks.c, blocks.q))
    flips = int((blocks.f * blocks.k).sum())
    return 2 * _whole(n) + _whole(flips) + _whole(2 * c) + c + _whole(q) + 12 * q


def join_blocks(content: bytes, blocks: Blocks, raw_length: int) -> bytes | None:
    """The block data in a frame of codec 2, or None where the streams are not what the headers ask for.

    Args:
        content: The bytes of the frame.
        blocks: The headers, all sound.
        raw_length: The bytes of the block data, which fits the headers.
    """
    try:
        streams = _split(content, blocks)
        index, guesses = _strips(streams, blocks)
        numbers = _vertices(streams, blocks, guesses)
    except _UnfitError:
        return None
    return _packed(streams, blocks, index, numbers, raw_length)


@dataclass(frozen=True)
class _Streams:
    """The streams as lists of numbers; bits are 0 or 1, `rest` has a list for each axis."""

    starts: list[int]
    turns: list[int]
    flips: list[int]
    ways: list[int]
    steps: list[int]
    known: list[int]
    places: list[int]
    rest: list[list[int]]


def _split(content: bytes, blocks: Blocks) -> _Streams:
    """Cut the bytes of a frame into streams."""
    at = 0

    def take(count: int) -> bytes:
        nonlocal at
        at += count
        if at > len(content):
            raise _UnfitError
        return content[at - count : at]

    def bits(count: int) -> list[int]:
        unpacked = np.unpackbits(np.frombuffer(take(_whole(count)), np.uint8), bitorder="little")
        if unpacked[count:].any():
            raise _UnfitError
        return unpacked[:count].tolist()

    def words(count: int) -> list[int]:
        first, second, third, fourth = (np.frombuffer(take(count), np.uint8).astype(np.int64) for _ in "1234")
        return (first + second * 2**8 + third * 2**16 + fourth * 2**24).tolist()

    n, c, q = (int(column.sum()) for column in (blocks.k, blocks.c, blocks.q))
    starts, turns, flips = bits(n), bits(n), bits(int((blocks.f * blocks.k).sum()))
    pairs = bits(2 * c)
    ways = [low + 2 * high for low, high in zip(pairs[::2], pairs[1::2], strict=True)]
    steps = list(take(ways.count(3)))
    known = bits(q)
    places = words(sum(known))
    rest = [words(q - sum(known)) for _ in range(3)]
    if at != len(content):
        raise _UnfitError
    return _Streams(starts, turns, flips, ways, steps, known, places, rest)


Guess = tuple[int, int, int]
"""Vertices a, b, o of a block whose parallelogram a + b - o is the guess; -1 for zero."""


def _strips(streams: _Streams, blocks: Blocks) -> tuple[list[int], list[Guess]]:
    """The indices of all strips, and what each vertex is guessed from."""
    index: list[int] = []
    guesses: list[Guess] = []
    ways, steps = iter(streams.ways), iter(streams.steps)
    first = 0
    for k, q, c in zip(blocks.k.tolist(), blocks.q.tolist(), blocks.c.tolist(), strict=True):
        given = (streams.starts[first : first + k], streams.turns[first : first + k])
        before = len(guesses)
        indices = list(_block(*given, ways, steps, c, q, guesses))
        if len(indices) != c or len(guesses) != before + q:
            raise _UnfitError
        index += indices
        first += k
    return index, guesses


def _block(
    starts: list[int],
    turns: list[int],
    ways: Iterator[int],
    steps: Iterator[int],
    room: int,
    q: int,
    guesses: list[Guess],
) -> Iterator[int]:
    """The indices of a block's strips, no more than there is room for."""
    after, before = {}, {}
    largest, begin = -1, len(guesses)
    a = b = c = -1
    for t, (start, turn) in enumerate(zip(starts, turns, strict=True)):
        corners = [-1, -1, -1] if start else [a, c, b] if turn else [c, b, a]
        room -= 3 if start else 1
        if room < 0 or (t == 0 and not start):
            raise _UnfitError
        opposite = corners[2]
        for corner in (0, 1, 2) if start else (2,):
            x, y = corners[0], corners[corner == 2]
            way = next(ways)
            if way == 0:
                w = largest + 1
                last = largest if corner == 0 else corners[corner - 1]
                guesses.append((last, last, last) if start else (x, y, opposite))
            elif way == 3:
                w = largest - next(steps)
            else:
                w = (before.get(y, -1) if way == 1 else after.get(x, -1)) if corner else -1
            if not 0 <= w < q or len(guesses) - begin > q:
                raise _UnfitError
            largest = max(largest, w)
            corners[corner] = w
            yield w
        a, b, c = corners
        for x, y in ((a, b), (b, c), (c, a)):
            if after.get(y) != x:
                after[x], before[y] = y, x


def _vertices(streams: _Streams, blocks: Blocks, guesses: list[Guess]) -> list[tuple[int, int, int]]:
    """The numbers u of all vertices."""
    numbers: list[tuple[int, int, int]] = []
    distinct: list[tuple[tuple[int, int, int], list[_Axis]]] = []
    places = iter(streams.places)
    rest = zip(*streams.rest, strict=True)
    last = 0
    for block, q in enumerate(blocks.q.tolist()):
        axes = [_Axis(blocks, block, axis) for axis in range(3)]
        base = len(numbers)
        for _ in range(q):
            vertex = len(numbers)
            if streams.known[vertex]:
                last = (last + _unfolded(next(places), _ALL - 1)) % _ALL
                if last >= len(distinct):
                    raise _UnfitError
                values = [axis.value(u) for u, axis in zip(*distinct[last], strict=True)]
                found = [axis.number(value) for axis, value in zip(axes, values, strict=True)]
            else:
                a, b, o = ((0, 0, 0) if i < 0 else numbers[base + i] for i in guesses[vertex])
                guess = [a[axis] + b[axis] - o[axis] for axis in range(3)]
                found = [axis.moved(g, r) for axis, g, r in zip(axes, guess, next(rest), strict=True)]
                distinct.append(((found[0], found[1], found[2]), axes))
            numbers.append((found[0], found[1], found[2]))
    return numbers


def _unfolded(number: int, every: int) -> int:
    return every - number // 2 if number % 2 else number // 2


class _Axis:
    """How one axis of a block is written."""

    def __init__(self, blocks: Blocks, block: int, axis: int) -> None:
        columns = (blocks.modes, blocks.anchors, blocks.exponents)
        self.mode, self.anchor, self.exponent = (int(column[block, axis]) for column in columns)
        self.every = 2 ** int(blocks.widths[block, axis]) - 1

    def moved(self, guess: int, rest: int) -> int:
        """The number as far from the guess as the stream says."""
        if rest > self.every:
            raise _UnfitError
        return (guess + _unfolded(rest, self.every)) & self.every

    def value(self, u: int) -> float:
        """The coordinate that a number stands for."""
        if self.mode == 1 and u == self.every:
            return -0.0
        number = self.anchor + u
        if self.mode == 2:
            if not -0x7F800000 <= number < 0x7F800000:
                raise _UnfitError
            bits = number if number >= 0 else 0x80000000 - 1 - number
            return struct.unpack("<f", struct.pack("<I", bits))[0]
        value = math.ldexp(number, self.exponent)
        try:
            exact = struct.unpack("<f", struct.pack("<f", value))[0] == value
        except OverflowError:
            exact = False
        if abs(number) >= 2**31 or not exact:
            raise _UnfitError
        return value

    def number(self, value: float) -> int:
        """The number that stands for a coordinate."""
        is_minus_zero = value == 0 and math.copysign(1, value) < 0
        if self.mode == 2:
            bits = struct.unpack("<I", struct.pack("<f", value))[0]
            u = (bits if bits < 2**31 else -1 - (bits - 2**31)) - self.anchor
        elif is_minus_zero:
            u = self.every if self.mode == 1 else -1
        else:
            cells = math.ldexp(value, -self.exponent)
            u = int(cells) - self.anchor if cells.is_integer() else -1
            if self.mode == 1 and u == self.every:
                u = -1
        if not 0 <= u <= self.every:
            raise _UnfitError
        return u


def _packed(
    streams: _Streams,
    blocks: Blocks,
    index: list[int],
    numbers: list[tuple[int, int, int]],
    raw_length: int,
) -> bytes:
    """The streams in the places that section 4.2 gives them."""
    words = np.zeros(raw_length // 4 + 1, np.uint64)

    def put(begin: np.ndarray, counts: np.ndarray, widths: np.ndarray, values: np.ndarray) -> None:
        # Values of a block stand behind each other from its bit `begin` on.
        row = np.repeat(np.arange(len(counts)), counts)
        item = np.arange(len(row)) - (np.cumsum(counts) - counts)[row]
        at = begin[row] + item * widths[row]
        shifted = values.astype(np.uint64) << (at & 31).astype(np.uint64)
        np.add.at(words, at >> 5, shifted & np.uint64(_ALL - 1))
        np.add.at(words, (at >> 5) + 1, shifted >> np.uint64(32))

    base, ones = 32 * blocks.word, np.ones_like(blocks.k)
    put(base, blocks.k, ones, np.array(streams.starts))
    put(base + blocks.k, blocks.k, ones, np.array(streams.turns))
    put(base + 2 * blocks.k, blocks.f * blocks.k, ones, np.array(streams.flips, np.int64))
    put(base + (2 + blocks.f) * blocks.k, blocks.c, blocks.w, np.array(index))
    at = base + (2 + blocks.f) * blocks.k + blocks.c * blocks.w
    table = np.array(numbers, np.int64)
    for axis in range(3):
        put(at, blocks.q, blocks.widths.sum(axis=1), table[:, axis])
        at = at + blocks.widths[:, axis]
    return words[:-1].astype("<u4").tobytes()


def _whole(bits: int) -> int:
    return -(-bits // 8)
