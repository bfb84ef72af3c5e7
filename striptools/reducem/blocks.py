"""Blocks: groups of up to 256 triangles and 256 vertices, packed as the scene file holds them.

Source: formats/reducem/SPEC.md, 4.2 and 4.3. Each axis of a block is written the narrowest way that gives
back every bit: multiples of the finest set bit (mode 0), the same with a number set aside for -0.0 (mode 1),
or the float32 bits themselves in the order of the numbers (mode 2). Of equally narrow ones the least mode is
taken, and the anchor is the least integer, so that there is one encoding.

Cost: O(n); 14 bytes of address room a triangle while encoding, of which what the blocks take is touched.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt32

from striptools.errors import UsageError
from striptools.kernels import blocks as kernels
from striptools.kernels.packed_hits import describe_runs
from striptools.reducem.issues import unreadable
from striptools.reducem.layout import ZERO_WORDS
from striptools.strips.topology import Strips
from striptools.threads import in_chunks
from striptools.types import Bools, Counts, Positions, Words

__all__ = ["Blocks", "Decoded", "decode_blocks", "described_runs", "encode_blocks"]

Headers = UInt32[np.ndarray, "b 8"]

SMALLEST_CHUNK = 64
"""Blocks below which another thread is not worth its start."""

_CODES = {
    kernels.WRONG_TOTAL: "RDM201",
    kernels.WRONG_FIRST: "RDM601",
    kernels.WRONG_WORD: "RDM602",
    kernels.WRONG_COUNTS: "RDM603",
    kernels.WRONG_AXIS: "RDM604",
    kernels.RESERVED: "RDM107",
    kernels.STRAY_BITS: "RDM605",
    kernels.WRONG_LENGTH: "RDM606",
    kernels.WRONG_STARTS: "RDM607",
    kernels.TURNED_FIRST: "RDM608",
    kernels.NO_FLIPS: "RDM609",
    kernels.LONG_FAN: "RDM610",
    kernels.NO_VERTEX: "RDM611",
    kernels.TOO_EARLY: "RDM612",
    kernels.NOT_USED: "RDM613",
    kernels.REPEATED: "RDM614",
    kernels.NO_NUMBER: "RDM615",
}


@dataclass(frozen=True, eq=False)
class Blocks:
    """Packed blocks, the words of the sections BLKH and BLKD.

    Attributes:
        headers: (b, 8) uint32, a 32-byte record each.
        words: (w,) uint32, the data of all blocks and the words of zero behind them; (0,) without a block.
    """

    headers: Headers
    words: Words

    @property
    def count(self) -> int:
        """How many blocks there are."""
        return len(self.headers)

    @property
    def triangle_count(self) -> int:
        """Triangles of all blocks."""
        if not self.count:
            return 0
        return int(self.headers[-1, 0]) + int(self.headers[-1, 2] & 0xFF) + 1

    @property
    def triangle_starts(self) -> np.ndarray:
        """(b+1,) int64, the first triangle of each block, then how many there are."""
        return np.append(self.headers[:, 0].astype(np.int64), self.triangle_count)

    def totals(self) -> dict[str, int]:
        """Count over all blocks: `vertices`, `strips`, `connectivity_bits`, `position_bits`, `words`."""
        names = ("vertices", "strips", "connectivity_bits", "position_bits", "words")
        return dict(zip(names, map(int, kernels.sum_parts(self.headers)), strict=True))

    def axes(self) -> tuple[np.ndarray, np.ndarray]:
        """Mode and width of each block's axes, (b, 3) uint8 each."""
        described = np.stack([self.headers[:, 6] >> np.uint32(8 * axis) for axis in range(3)], axis=1)
        return (described >> 6 & 3).astype(np.uint8), (described & 63).astype(np.uint8)


@dataclass(frozen=True, eq=False)
class Decoded:
    """What blocks hold.

    A vertex that several blocks use stands once for each of them.

    Attributes:
        positions: (q, 3) float32, the vertices of all blocks in a row.
        vertex_starts: (b+1,) int32, the first vertex of each block, then q.
        vertices: (n+2s,) int32, the strip vertices, places in `positions`.
        turns: (n,) bool.
        flips: (n,) bool, or None where no triangle has one.
        starts: (s+1,) int32, the first triangle of each strip, then n.
        block_starts: (b+1,) int32, the first triangle of each block, then n.
    """

    positions: Positions
    vertex_starts: Counts
    vertices: Counts
    turns: Bools
    flips: Bools | None
    starts: Counts
    block_starts: Counts


def encode_blocks(positions: Positions, strips: Strips, block_strips: Counts, threads: int = 1) -> Blocks:
    """Pack strips into blocks.

    Args:
        positions: (v, 3) float32, finite.
        strips: Those of a block one after another; no more than 30 equal turn bits in a row.
        block_strips: (b+1,) int32, the first strip of each block, then s.
        threads: How many threads share the blocks; the bytes are the same for any number.

    Raises:
        UsageError: A block of more than 256 triangles or vertices, or without a triangle.
    """
    bits = np.ascontiguousarray(positions, np.float32).view(np.uint32)
    count = len(block_strips) - 1
    headers = np.zeros((count, 8), np.uint32)
    flips = np.zeros(0, np.bool_) if strips.flips is None else strips.flips
    firsts = strips.starts[block_strips]

    def encode(part: tuple[int, int]) -> Words:
        begin, end = part
        triangles, strip_count = (
            int(firsts[end] - firsts[begin]),
            int(block_strips[end] - block_strips[begin]),
        )
        corners = triangles + 2 * strip_count
        room = np.zeros((3 * triangles + (8 + 96) * corners) // 32 + end - begin + 1, np.uint32)
        given = (bits, strips.vertices, strips.turns, flips, strips.starts, block_strips)
        used = int(kernels.encode(*given, begin, end, headers, room))
        if used < 0:
            raise UsageError("more than 256 triangles or vertices, or none", where=f"block {-1 - used}")
        return room[:used]

    if count == 0:
        return Blocks(headers, np.zeros(0, np.uint32))
    chunks = in_chunks(lambda part: (part, encode(part)), count, threads, SMALLEST_CHUNK)
    total = 0
    for (begin, end), words in chunks:
        headers[begin:end, 1] += np.uint32(total)
        total += len(words)
    rest = ZERO_WORDS + -total % 16
    return Blocks(headers, np.concatenate([*(words for _, words in chunks), np.zeros(rest, np.uint32)]))


def decode_blocks(blocks: Blocks, threads: int = 1, where: str = "scene") -> Decoded:
    """Unpack blocks, and check every rule that they have to keep.

    Args:
        blocks: From a file or from `encode_blocks`.
        threads: How many threads share the blocks.
        where: What an error names as its place.

    Raises:
        UnreadableSceneError: Naming the first rule broken, by its code.
    """
    check_headers(blocks, blocks.triangle_count, where)
    headers, words = blocks.headers, blocks.words
    triangles = blocks.triangle_count
    counts = headers[:, 2]
    vertex_starts = _starts((counts >> 8 & 0xFF) + 1)
    strip_starts = _starts((counts >> 16 & 0xFF) + 1)
    strips = int(strip_starts[-1])
    positions = np.zeros((int(vertex_starts[-1]), 3), np.float32)
    vertices = np.zeros(triangles + 2 * strips, np.int32)
    turns, starts = np.zeros(triangles, np.bool_), np.full(strips + 1, triangles, np.int32)
    has_flips = bool((counts >> 24).any())
    flips = np.zeros(triangles if has_flips else 0, np.bool_)
    target = (positions, positions.view(np.uint32), vertices, turns, flips, starts)
    flaws = in_chunks(
        lambda part: kernels.decode(headers, words, vertex_starts, strip_starts, *part, *target),
        blocks.count,
        threads,
        SMALLEST_CHUNK,
    )
    _refuse(next((flaw for flaw in flaws if flaw[0]), (0, 0)), "BLKD", where)
    block_starts = np.append(headers[:, 0], triangles).astype(np.int32)
    return Decoded(
        positions, vertex_starts, vertices, turns, flips if has_flips else None, starts, block_starts
    )


def described_runs(blocks: Blocks, first_run: np.ndarray, runs: np.ndarray, threads: int = 1) -> np.ndarray:
    """Say of runs where in their strips their triangles lie: SPEC 4.5.

    Args:
        blocks: Whose rules are kept.
        first_run: (b,) uint32, where each block's runs begin.
        runs: (r,) uint32, whose bits 0 to 10 are read.
        threads: How many threads share the blocks.

    Returns:
        (r,) uint32, all bits of them.
    """
    described = np.zeros(len(runs), np.uint32)
    starts = np.append(first_run, len(runs)).astype(np.int64)
    given = (blocks.headers, blocks.words, starts, runs)
    in_chunks(lambda part: describe_runs(*given, *part, described), blocks.count, threads, SMALLEST_CHUNK)
    return described


def check_headers(blocks: Blocks, triangle_count: int, where: str = "scene") -> None:
    """Make sure that headers keep the rules that safe decoding rests on.

    Raises:
        UnreadableSceneError: They do not.
    """
    if blocks.count == 0 and len(blocks.words) == triangle_count == 0:
        return
    _refuse(kernels.header_flaw(blocks.headers, blocks.words, triangle_count), "BLKH", where)


def _starts(counts: np.ndarray) -> Counts:
    starts = np.zeros(len(counts) + 1, np.int32)
    np.cumsum(counts, out=starts[1:])
    return starts


def _refuse(flaw: tuple[int, int], section: str, where: str) -> None:
    if flaw[0]:
        raise unreadable(_CODES[int(flaw[0])], f"{where}: {section}: block {flaw[1]}")


# Notes. Block sizes, lossless: vertices per triangle, bytes a triangle of the file and as traced with boxes,
# duplication of vertices, expected cost over a full SAH tree's; then rays a second of expanded and of
# compressed tracing, camera / ambient occlusion, over expanded blocks of 256 (one thread, least of 7 runs):
#
#     dragon  64   1.141   7.27  10.07   1.449  1.066   1.05 / 0.99   0.69 / 0.74
#            128   1.107   6.61   9.05   1.312  1.080   1.02 / 0.99   0.65 / 0.74
#            256   1.086   6.29   8.56   1.220  1.093   1.00 / 1.00   0.61 / 0.70
#     icub    64   1.188   8.76  11.69   1.658  1.100   0.96 / 1.02   0.55 / 0.59
#            128   1.143   7.98  10.57   1.493  1.121   1.01 / 0.98   0.58 / 0.59
#            256   1.112   7.54   9.94   1.372  1.138   1.00 / 1.00   0.56 / 0.59
#
# 256, the largest that local numbers of 8 bits allow, is the default: it gives the smallest file by 5 to
# 6 %, and the hierarchy that is 1 to 2 % dearer costs traced rays less than that. Boxes inside blocks are
# rebuilt by default: stored ones are a quarter of the file, and 871,000 triangles get them back in 0.045
# s.
