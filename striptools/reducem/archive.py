"""The codecs of archives (SPEC.md, section 6): bytes put in an order that packs well, in one Zstandard frame.

Records become planes of their bytes. Block data are taken apart with the help of their headers: a vertex of a
strip is named by the edges that lead to it, one that an earlier block holds is not told again, and a new one
is told by how far it is from the parallelogram over the triangle before it (Touma, Gotsman, "Triangle Mesh
Compression", Graphics Interface 1998), in the block's own integers, so that nothing is rounded.

Cost: O(n), one thread; see Notes.
"""

from types import ModuleType

import numpy as np

from striptools.errors import MissingExtraError
from striptools.kernels import archive as kernels
from striptools.reducem import layout
from striptools.reducem.blocks import Blocks, Decoded, check_headers
from striptools.reducem.issues import unreadable
from striptools.types import Words

__all__ = ["LEVEL", "content_of", "expanded", "expanded_blocks", "from_content", "packed", "packed_blocks"]

LEVEL = 9
"""Of Zstandard: half of the bytes hardly shrink at any level, and the rest gains little from a higher one."""


def packed(payload: bytes | memoryview, kind: bytes) -> tuple[int, bytes]:
    """A section's codec, by its kind, and its stored bytes.

    Args:
        payload: The raw bytes of the section.
        kind: One of `layout.SECTIONS`, neither block data nor the scene record.

    Raises:
        MissingExtraError: The package `zstandard` is not installed.
    """
    width = layout.PLANE_WIDTHS.get(kind)
    if width is None:
        return layout.CODEC_ZSTD, _compressed(payload)
    return layout.CODEC_PLANES, _compressed(_planes(np.frombuffer(payload, np.uint8), width))


def packed_blocks(blocks: Blocks, decoded: Decoded) -> tuple[int, bytes]:
    """The codec and the stored bytes of block data.

    Args:
        blocks: Sound ones.
        decoded: What they hold.

    Raises:
        MissingExtraError: The package `zstandard` is not installed.
    """
    return layout.CODEC_BLOCKS, _compressed(content_of(blocks, decoded))


def expanded(stored: memoryview, codec: int, kind: bytes, raw_length: int, where: str) -> np.ndarray:
    """The bytes of a section of codec 1 or 3, (raw_length,) uint8 and writable.

    Args:
        stored: The stored bytes.
        codec: CODEC_ZSTD, or CODEC_PLANES for a kind that may have it.
        kind: Of section.
        raw_length: How many bytes there have to be; no more are allocated for the frame.
        where: What an error names as its place.

    Raises:
        UnreadableSceneError: It is no such frame.
        MissingExtraError: The package `zstandard` is not installed.
    """
    raw = np.frombuffer(bytearray(_decompressed(stored, raw_length, raw_length, where)), np.uint8)
    if codec == layout.CODEC_ZSTD:
        return raw
    width = layout.PLANE_WIDTHS[kind]
    rows = raw_length // width
    out = np.zeros(raw_length, np.uint8)
    out[: rows * width].reshape(rows, width)[:] = raw[: rows * width].reshape(width, rows).T
    out[rows * width :] = raw[rows * width :]
    return out


def expanded_blocks(
    stored: memoryview, headers: np.ndarray, triangle_count: int, raw_length: int, where: str
) -> Words:
    """The words of block data of codec 2, (raw_length / 4,) uint32.

    Args:
        stored: The stored bytes.
        headers: (b, 8) uint32, of any content.
        triangle_count: The triangles that the blocks must have.
        raw_length: How many bytes there have to be.
        where: What an error names as the file.

    Raises:
        UnreadableSceneError: The headers break a rule, or the stored bytes do not decode with them.
        MissingExtraError: The package `zstandard` is not installed.
    """
    place = f"{where}: BLKD"
    if raw_length % 4:
        raise unreadable("RDM606", place)
    blocks = Blocks(headers, np.zeros(raw_length // 4, np.uint32))
    check_headers(blocks, triangle_count, where)
    counts = _Counts(headers)
    if not counts.all_used:
        raise unreadable("RDM613", place)
    content = _decompressed(stored, None, counts.most_bytes, place)
    from_content(content, blocks, place)
    return blocks.words


def content_of(blocks: Blocks, decoded: Decoded) -> bytes:
    """The bytes that codec 2 puts into a frame; arguments as for `packed_blocks`."""
    headers, counts = blocks.headers, _Counts(blocks.headers)
    slots = 1 << max(1, 2 * counts.vertices).bit_length()
    table = np.full(slots, -1, np.int32)
    ways, steps = np.zeros(counts.corners, np.uint8), np.zeros(counts.corners, np.uint8)
    known, back = np.zeros(counts.vertices, np.bool_), np.zeros(counts.vertices, np.uint32)
    rest = np.zeros((3, counts.vertices), np.uint32)
    given = (decoded.positions.view(np.uint32), decoded.vertex_starts, decoded.vertices, decoded.turns)
    step_count, known_count, distinct = kernels.pack(
        headers, blocks.words, *given, decoded.starts, table, ways, known, steps, back, rest
    )
    is_start = np.zeros(counts.triangles, np.bool_)
    is_start[decoded.starts[:-1]] = True
    flips = np.zeros(0, np.bool_) if decoded.flips is None else decoded.flips[counts.flip_triangles]
    ways.resize(-(-counts.corners // 4) * 4)
    quads = ways.reshape(-1, 4)
    parts = [
        *(np.packbits(bits, bitorder="little") for bits in (is_start, decoded.turns, flips)),
        quads[:, 0] | quads[:, 1] << 2 | quads[:, 2] << 4 | quads[:, 3] << 6,
        steps[:step_count],
        np.packbits(known, bitorder="little"),
        _word_planes(back[:known_count]),
        *(_word_planes(rest[axis, :distinct]) for axis in range(3)),
    ]
    return b"".join(part.tobytes() for part in parts)


def from_content(content: bytes, blocks: Blocks, where: str = "scene") -> None:
    """Fill the words of blocks from the bytes in a frame of codec 2.

    Args:
        content: The bytes.
        blocks: Headers that `check_headers` passes with these words, which are zero.
        where: What an error names as its place.

    Raises:
        UnreadableSceneError: The bytes are not what the headers ask for.
    """
    headers, counts = blocks.headers, _Counts(blocks.headers)
    streams = _Streams(content, where)
    is_start, turns = streams.bits(counts.triangles), streams.bits(counts.triangles)
    flips = streams.bits(counts.flips)
    pairs = streams.bits(2 * counts.corners)
    ways = pairs[::2] | pairs[1::2] << 1
    steps = streams.take(int(np.count_nonzero(ways == kernels.STEP)))
    known = streams.bits(counts.vertices)
    known_count = int(np.count_nonzero(known))
    distinct = counts.vertices - known_count
    back = streams.words(known_count)
    rest = np.stack([streams.words(distinct) for _ in range(3)])
    streams.end()
    real = np.zeros((distinct, 3), np.float32)
    given = (is_start, turns, flips, ways, known, steps, back, rest, real, real.view(np.uint32))
    flaw, block = kernels.unpack(headers, *given, blocks.words)
    if flaw:
        raise unreadable("RDM126", f"{where}: block {block}")


class _Counts:
    """What the headers of blocks say of all of them together."""

    def __init__(self, headers: np.ndarray) -> None:
        packed = headers[:, 2]
        triangles, vertices, strips = ((packed >> shift & 0xFF).astype(np.int64) + 1 for shift in (0, 8, 16))
        self.triangles, self.vertices = int(triangles.sum()), int(vertices.sum())
        self.corners = self.triangles + 2 * int(strips.sum())
        self.all_used = bool((vertices <= triangles + 2 * strips).all())
        # A block with flip bits has one for each of its triangles.
        with_flips = (packed >> 24 & layout.BLOCK_FLIPS).astype(np.bool_)
        self.flips = int(triangles[with_flips].sum())
        self.flip_triangles = np.repeat(with_flips, triangles)

    @property
    def most_bytes(self) -> int:
        """The most bytes that codec 2 may put into a frame."""
        bits = (2 * self.triangles, self.flips, 2 * self.corners, self.vertices)
        return sum(-(-count // 8) for count in bits) + 1 + self.corners + 12 * self.vertices


class _Streams:
    """The streams of codec 2, one taken after the other."""

    def __init__(self, content: bytes, where: str) -> None:
        self.rest, self.where = np.frombuffer(content, np.uint8), where

    def take(self, count: int) -> np.ndarray:
        """So many bytes, (count,) uint8."""
        if count > len(self.rest):
            raise unreadable("RDM126", self.where)
        taken, self.rest = self.rest[:count], self.rest[count:]
        return taken

    def bits(self, count: int) -> np.ndarray:
        """So many bits, (count,) uint8; those behind them in the last byte must be zero."""
        bits = np.unpackbits(self.take(-(-count // 8)), bitorder="little")
        if bits[count:].any():
            raise unreadable("RDM126", self.where)
        return bits[:count]

    def words(self, count: int) -> np.ndarray:
        """So many numbers from planes of their bytes, (count,) uint32."""
        planes = self.take(4 * count).reshape(4, count)
        return np.ascontiguousarray(planes.T).reshape(-1).view("<u4").astype(np.uint32, copy=False)

    def end(self) -> None:
        """Make sure that nothing is left."""
        if len(self.rest):
            raise unreadable("RDM126", self.where)


def _planes(raw: np.ndarray, width: int) -> bytes:
    rows = len(raw) // width
    return raw[: rows * width].reshape(rows, width).T.tobytes() + raw[rows * width :].tobytes()


def _word_planes(numbers: np.ndarray) -> np.ndarray:
    return numbers.astype("<u4", copy=False).view(np.uint8).reshape(-1, 4).T


def _compressed(payload: bytes | memoryview) -> bytes:
    """The payload as one frame that says how long it is."""
    return _library("scene").ZstdCompressor(level=LEVEL, write_checksum=False).compress(payload)


def _decompressed(stored: memoryview, length: int | None, most: int, where: str) -> bytes:
    """The bytes in a frame with nothing behind it: so many, or any number up to the most."""
    library = _library(where)
    try:
        frame = library.get_frame_parameters(stored)
        known = frame.content_size != library.CONTENTSIZE_UNKNOWN
        # A frame of a single segment has no window of its own: its content is the window.
        largest = 1 << layout.LARGEST_WINDOW
        wrong = known and (frame.content_size > most if length is None else frame.content_size != length)
        # The field of a dictionary must not be there, not even for dictionary 0, which is none.
        if stored[4] & 3 or frame.window_size > largest or wrong:
            raise unreadable("RDM121", where)
        decoder = library.ZstdDecompressor(max_window_size=largest)
        content = decoder.decompress(stored, max_output_size=most, allow_extra_data=False)
    except library.ZstdError as error:
        raise unreadable("RDM121", where) from error
    if length is not None and len(content) != length:
        raise unreadable("RDM121", where)
    return content


def _library(where: str) -> ModuleType:
    try:
        import zstandard
    except ImportError as error:
        raise MissingExtraError(
            "an archive needs the package zstandard", where=where, remedy="pip install 'striptools[archive]'"
        ) from error
    return zstandard


# Notes. What was tried on the dragon, bytes per triangle, lossless / 16 bits, at level 12 of Zstandard:
# - Indices by how far they are behind the newest one, 0.49; with the ends of open edges beside them, 0.35.
#   Edges that are looked up in `before` instead of `after` lose the open ones of closing triangles: 0.43.
# - A byte for each way costs 0.30, two bits 0.22: a frame finds more in four ways together.
# - Places as distances from the newest vertex, 0.144; from the known vertex before, 0.115; from the place of
#   a corner of the triangle where that is known, 0.114.
# - Parallelogram, 3.23 / 1.44. Averaged with those about the open edges, 3.40 / 1.52; a weaker one,
#   (3 (a + b) - 2 o) / 4, 3.37 / 1.47; the middle of an edge for a third vertex, 3.24 / 1.45.
# - Differences of the bits of float32 in their order, as mode 2 has them: 3.21, but 1.88 for 16 bits.
# - Classes of sizes with three bits behind the first, and the other bits raw, instead of planes: 3.15 / 1.41,
#   but what repeats is lost: kicad_acepack takes 1.46 instead of 1.13.
# - Planes of differences between records: headers 0.069 instead of 0.070, nodes and remap larger. Without the
#   fields that follow from others headers would take 0.058.
# - Planes of a remap, 1.79 instead of 3.03; of stored nodes, 1.19 instead of 1.34; of runs, 0.20 instead of
#   0.23.
# - Levels 3, 6, 9, 12, 19 of block data: 3.98, 3.94, 3.93, 3.93, 3.86 in 0.06, 0.12, 0.25, 0.5, 4 s.
