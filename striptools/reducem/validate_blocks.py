"""The validator's look into blocks: headers, strips, indices, vertices; and the bounds that nodes must hold.

Blocks are decoded many at a time with NumPy, by the closed form of section 4.3 and not by its loop, so that
this shares neither code nor method with the reader.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from striptools.reducem.inspection import Inspection, Section

__all__ = [
    "Blocks",
    "Geometry",
    "grid_of",
    "inspect_blocks",
    "inspect_bounds",
    "inspect_headers",
    "off_grid",
]

_AT_ONCE = 1 << 15
"""Triangles to decode at once."""

_HEADER = np.dtype(
    {
        "names": ["first", "word", "counts", "flags", "anchors", "axes", "exponents", "reserved"],
        "formats": ["<u4", "<u4", ("u1", 3), "u1", ("<i4", 3), ("u1", 3), ("u1", 3), "<u2"],
        "offsets": [0, 4, 8, 11, 12, 24, 27, 30],
        "itemsize": 32,
    }
)


@dataclass(frozen=True)
class Geometry:
    """What the nodes lean on, where every block could be decoded.

    Attributes:
        starts: (b + 1,) int64, the first triangle of each block, and n.
        begins: (n,) bool, whether a strip begins at each triangle.
        turns: (n,) bool, the turn bit of each triangle.
        low: (n, 3) float32, the least coordinates of each triangle.
        high: (n, 3) float32, the largest.
        corners: (n, 3, 3) float32, where there is HIER; else none.
    """

    starts: np.ndarray
    begins: np.ndarray
    turns: np.ndarray
    low: np.ndarray
    high: np.ndarray
    corners: np.ndarray


@dataclass
class Blocks:
    """The headers of all blocks as int64 columns, and the words of their data.

    `base` is the first bit of a block, `first` its first triangle, `bits` its length, `k`, `q` and `s` its
    counts, `f` its flip bits a triangle, `c` its indices, `w` their width; `widths`, `modes`, `exponents` and
    `anchors` are (b, 3). `whole` says which blocks can be decoded.
    """

    headers: Section
    data: Section
    words: np.ndarray
    word: np.ndarray
    first: np.ndarray
    k: np.ndarray
    q: np.ndarray
    s: np.ndarray
    f: np.ndarray
    c: np.ndarray
    w: np.ndarray
    widths: np.ndarray
    modes: np.ndarray
    exponents: np.ndarray
    anchors: np.ndarray
    bits: np.ndarray
    whole: np.ndarray

    @property
    def base(self) -> np.ndarray:
        """The first bit of each block."""
        return 32 * self.word

    def bit_at(self, bit: int) -> int:
        """The byte of the file where a bit of the data is."""
        return self.data.at(bit // 8)


def inspect_blocks(inspection: Inspection) -> Geometry | None:
    """Look at the blocks; gives their geometry where all of them could be decoded and are sound."""
    blocks = inspect_headers(inspection, inspection.sections["BLKH"], inspection.sections["BLKD"])
    counted = int(blocks.k.sum()) == int.from_bytes(inspection.sections["SCEN"].data[:4], "little")
    if not counted:
        inspection.found("RDM201", "SCEN", inspection.sections["SCEN"].at(0))
    parts = [_decode(inspection, blocks, chunk) for chunk in _chunks(blocks)]
    sound = [part for part in parts if part is not None]
    if not blocks.whole.all() or len(sound) < len(parts):
        return None
    begins, turns, low, high, corners, lowest, highest = (
        np.concatenate(column) for column in zip(*sound, strict=True)
    )
    inspect_bounds(inspection, lowest, highest)
    if not counted:
        return None
    starts = np.concatenate([[0], np.cumsum(blocks.k)])
    return Geometry(starts, begins, turns, low, high, corners)


def inspect_headers(inspection: Inspection, headers: Section, data: Section) -> Blocks:
    """Look at the headers and at where they say that the data of blocks lie."""
    blocks = _headers(inspection, headers, data)
    _places(inspection, blocks)
    return blocks


def _headers(inspection: Inspection, headers: Section, data: Section) -> Blocks:
    """Look at each header by itself."""
    rows = np.frombuffer(headers.data, _HEADER)
    k, q, s = (rows["counts"].astype(np.int64) + 1).T
    f = rows["flags"].astype(np.int64) & 1
    c = k + 2 * s
    w = np.frexp(q - 1)[1].astype(np.int64)
    widths, modes = rows["axes"].astype(np.int64) & 63, rows["axes"].astype(np.int64) >> 6
    bits = (2 + f) * k + c * w + q * widths.sum(axis=1)

    def check(code: str, wrong: np.ndarray, at: int) -> np.ndarray:
        inspection.found_where(code, wrong, lambda i: f"BLKH: block {i}", lambda i: headers.at(32 * i + at))
        return wrong

    check("RDM107", (rows["flags"] > 1) | (rows["reserved"] != 0), 11)
    wrong = check("RDM603", (q < 3) | (s > k), 9)
    odd = (
        (widths > 32)
        | (modes > 2)
        | ((modes == 1) & (widths == 0))
        | ((modes == 2) & (rows["exponents"] > 0))
    )
    wrong |= check("RDM604", odd.any(axis=1), 24)
    words = np.concatenate([np.frombuffer(data.data, "<u4", len(data.data) // 4), np.zeros(2, "<u4")])
    word = rows["word"].astype(np.int64)
    wrong |= 32 * word + bits > 32 * (len(words) - 2)
    # Vertices of no width take no bytes: without this, a header alone could ask for 256 of them.
    check("RDM613", ~wrong & (q > c), 9)
    columns = (word, rows["first"].astype(np.int64), k, q, s, f, c, w, widths, modes)
    exponents, anchors = rows["exponents"].astype(np.int64) - 149, rows["anchors"].astype(np.int64)
    return Blocks(headers, data, words, *columns, exponents, anchors, bits, ~wrong & (q <= c))


def _places(inspection: Inspection, blocks: Blocks) -> None:
    """Look at where blocks begin and end, and at the words behind the last."""
    headers = blocks.headers

    def place(i: int) -> str:
        return f"BLKH: block {i}"

    first = np.cumsum(blocks.k) - blocks.k
    length = -(-blocks.bits // 32)
    word = np.cumsum(length) - length
    inspection.found_where("RDM601", blocks.first != first, place, lambda i: headers.at(32 * i))
    blocks.whole &= blocks.word == word
    misplaced = inspection.found_where("RDM602", blocks.word != word, place, lambda i: headers.at(32 * i + 4))
    end = int(length.sum())
    wanted = 4 * (end + 16 + -(end + 16) % 16)
    if len(blocks.data.data) != wanted:
        inspection.found("RDM606", f"BLKD: {len(blocks.data.data)} bytes, not {wanted}", blocks.data.offset)
    if misplaced:
        return
    used = 32 * word + blocks.bits
    loose = np.zeros(len(used), np.bool_)
    inside = 32 * (word + length) <= 32 * (len(blocks.words) - 2)
    loose[inside] = _bits(blocks.words, used[inside], -used[inside] % 32) != 0
    inspection.found_where("RDM605", loose, lambda i: f"BLKD: block {i}", lambda i: blocks.bit_at(used[i]))
    rest = blocks.data.data[4 * end :].lstrip(b"\0")
    if rest:
        inspection.found(
            "RDM605", "BLKD: after the last block", blocks.data.at(len(blocks.data.data) - len(rest))
        )


def _chunks(blocks: Blocks) -> Iterator[np.ndarray]:
    """The numbers of the blocks that can be decoded, some at a time."""
    numbers = np.flatnonzero(blocks.whole)
    part = np.cumsum(blocks.c[numbers]) // _AT_ONCE
    yield from (piece for piece in np.split(numbers, np.flatnonzero(np.diff(part)) + 1) if len(piece))


def _bits(words: np.ndarray, at: np.ndarray, width: np.ndarray | int) -> np.ndarray:
    """Numbers of up to 32 bits at any bits of the words, as int64."""
    word = at >> 5
    pair = words[word].astype(np.uint64) | words[word + 1].astype(np.uint64) << np.uint64(32)
    mask = (np.int64(1) << np.asarray(width, np.int64)) - 1
    return (pair >> (at & 31).astype(np.uint64)).astype(np.int64) & mask


def _rows(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """For rows of these lengths: where each begins, the row of each item, and its number in the row."""
    starts = np.cumsum(counts) - counts
    row = np.repeat(np.arange(len(counts)), counts)
    return starts, row, np.arange(len(row)) - starts[row]


def _decode(inspection: Inspection, blocks: Blocks, chunk: np.ndarray) -> tuple[np.ndarray, ...] | None:
    """Look at some blocks: strip begins, turns, triangle bounds, corners, bounds of all, where sound."""
    strips = _strips(inspection, blocks, chunk)
    index = _indices(inspection, blocks, chunk)
    vertices = _vertices(inspection, blocks, chunk)
    if strips is None or index is None or vertices is None:
        return None
    corners = _corners(blocks, chunk, index, *strips)
    _, row, t = _rows(blocks.k[chunk])
    a, b, c = corners
    inspection.found_where(
        "RDM614",
        (a == b) | (b == c) | (c == a),
        lambda i: f"BLKD: block {chunk[row[i]]}, triangle {t[i]}",
        lambda i: blocks.data.at(4 * int(blocks.word[chunk[row[i]]])),
    )
    offsets = (np.cumsum(blocks.q[chunk]) - blocks.q[chunk])[row]
    positions = [vertices[corner + offsets] for corner in corners]
    low, high = np.minimum.reduce(positions), np.maximum.reduce(positions)
    kept = np.stack(positions, axis=1)[: None if "HIER" in inspection.sections else 0]
    return *strips, low, high, kept, vertices.min(axis=0)[None], vertices.max(axis=0)[None]


def _strips(
    inspection: Inspection, blocks: Blocks, chunk: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Look at start, turn and flip bits; gives the first two where the starts make strips."""
    starts, row, t = _rows(blocks.k[chunk])
    at = blocks.base[chunk][row] + t
    k, f = blocks.k[chunk], blocks.f[chunk]
    begins, turns = (_bits(blocks.words, place, 1) == 1 for place in (at, at + k[row]))
    flips = (_bits(blocks.words, at + 2 * k[row], 1) == 1) & (f[row] == 1)

    def check(code: str, wrong: np.ndarray, part: int) -> bool:
        return inspection.found_where(
            code,
            wrong,
            lambda i: f"BLKD: block {chunk[row[i]]}, triangle {t[i]}",
            lambda i: blocks.bit_at(at[i] + part * k[row[i]]),
        )

    counts = np.add.reduceat(begins.astype(np.int64), starts)
    wrong = np.zeros(len(at), np.bool_)
    wrong[starts] = ~begins[starts] | (counts != blocks.s[chunk])
    broken = check("RDM607", wrong, 0)
    check("RDM608", begins & (turns | flips), 1)
    none = np.zeros(len(at), np.bool_)
    none[starts] = (f == 1) & ~np.logical_or.reduceat(flips, starts)
    check("RDM609", none, 2)
    check("RDM610", _too_long(begins | (t == 0), turns), 1)
    return None if broken else (begins, turns)


def _too_long(begins: np.ndarray, turns: np.ndarray) -> np.ndarray:
    """Where a triangle's turn bit is the 31st equal one in a row, its strip's first left out."""
    number = np.arange(len(turns))
    changed = begins | np.concatenate([[True], begins[:-1] | (turns[1:] != turns[:-1])])
    since = number - np.maximum.accumulate(np.where(changed, number, 0))
    return ~begins & (since == 30)


def _indices(inspection: Inspection, blocks: Blocks, chunk: np.ndarray) -> np.ndarray | None:
    """Look at the indices; gives them where each names a vertex."""
    _, row, j = _rows(blocks.c[chunk])
    q, w = blocks.q[chunk], blocks.w[chunk]
    at = (blocks.base + (2 + blocks.f) * blocks.k)[chunk][row] + j * w[row]
    index = _bits(blocks.words, at, w[row])

    def check(code: str, wrong: np.ndarray) -> bool:
        return inspection.found_where(
            code,
            wrong,
            lambda i: f"BLKD: block {chunk[row[i]]}, index {j[i]}",
            lambda i: blocks.bit_at(at[i]),
        )

    broken = check("RDM611", index >= q[row])
    # The number of the block, times more than any index, begins each block's maximum anew.
    largest = np.maximum.accumulate(index + 1 + 1024 * row) - 1024 * row
    before = np.where(j == 0, 0, np.concatenate([[0], largest[:-1]]))
    check("RDM612", index > before)
    used = np.bincount(np.unique((256 * row + index)[index < q[row]]) // 256, minlength=len(chunk))
    inspection.found_where(
        "RDM613",
        used < q,
        lambda i: f"BLKD: block {chunk[i]}",
        lambda i: blocks.bit_at(int((blocks.base + (2 + blocks.f) * blocks.k)[chunk[i]])),
    )
    return None if broken else index


def _corners(
    blocks: Blocks, chunk: np.ndarray, index: np.ndarray, begins: np.ndarray, turns: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The corners of each triangle, without flips, by the closed form of section 4.3."""
    _, row, _ = _rows(blocks.k[chunk])
    number = np.arange(len(row))
    # Blocks lie one behind the other in `index`, so strips can be counted through: two more indices a strip.
    at = number + 2 * (np.cumsum(begins) - 1)
    first = np.maximum.accumulate(np.where(begins, number, 0))
    further = ~begins
    last = [np.maximum.accumulate(np.where(further & (turns == turn), number, -1)) for turn in (False, True)]
    other = np.where(turns, last[0], last[1])
    strip = at - number
    opposite = np.where(other > first, other + strip + 1, first + strip + np.where(turns, 0, 1))
    a = index[np.where(begins, at, np.where(turns, opposite, at + 1))]
    b = index[np.where(begins | turns, at + 1, opposite)]
    return a, b, index[at + 2]


def _vertices(inspection: Inspection, blocks: Blocks, chunk: np.ndarray) -> np.ndarray | None:
    """Look at the coordinates; gives them as (q, 3) float32 where all are finite and exact."""
    _, row, j = _rows(blocks.q[chunk])
    widths = blocks.widths[chunk]
    at = (blocks.base + (2 + blocks.f) * blocks.k + blocks.c * blocks.w)[chunk][row] + j * widths.sum(1)[row]
    grid = grid_of(inspection)
    columns, sound = [], True
    for axis in range(3):
        width = widths[row, axis]
        u = _bits(blocks.words, at, width)
        value, wrong = _coordinates(blocks, chunk[row], axis, u, width)
        for code, flaw in (("RDM615", wrong), ("RDM204", ~wrong & off_grid(value, grid))):
            inspection.found_where(
                code,
                flaw,
                lambda i, axis=axis: f"BLKD: block {chunk[row[i]]}, vertex {j[i]}, axis {'xyz'[axis]}",
                lambda i, at=at: blocks.bit_at(at[i]),
            )
        sound &= not wrong.any()
        columns.append(value)
        at = at + width
    return np.stack(columns, axis=1) if sound else None


def _coordinates(
    blocks: Blocks, block: np.ndarray, axis: int, u: np.ndarray, width: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The float32 coordinates of numbers `u`, and where there is none."""
    mode, number = blocks.modes[block, axis], blocks.anchors[block, axis] + u
    exact = np.ldexp(number.astype(np.float64), blocks.exponents[block, axis])
    with np.errstate(over="ignore"):
        scaled = exact.astype(np.float32)
    wrong = (np.abs(number) > 2**31 - 1) | ~np.isfinite(scaled) | (scaled != exact)
    minus = (mode == 1) & (u == (np.int64(1) << width) - 1)
    magnitude = np.where(number >= 0, number, -1 - number)
    pattern = np.where(number >= 0, magnitude, magnitude | 0x80000000).astype(np.uint32).view(np.float32)
    value = np.where(minus, np.float32(-0.0), np.where(mode == 2, pattern, scaled))
    wrong = np.where(mode == 2, magnitude >= 0x7F800000, wrong & ~minus)
    return np.where(wrong, np.float32(0.0), value), wrong


def grid_of(inspection: Inspection) -> int | None:
    """The exponent of the scene's grid, where it has one."""
    record = inspection.sections["SCEN"].data
    return int.from_bytes(record[26:28], "little", signed=True) if record[24] & 2 else None


def off_grid(value: np.ndarray, grid: int | None) -> np.ndarray:
    """Where a coordinate is no multiple of 2^grid; exact, for a float64 holds every quotient."""
    if grid is None or not -149 <= grid <= 104:
        return np.zeros(len(value), np.bool_)
    cells = np.ldexp(value.astype(np.float64), -grid)
    return np.floor(cells) != cells


def inspect_bounds(inspection: Inspection, lowest: np.ndarray, highest: np.ndarray) -> None:
    """Look whether low and high of the scene record are the bounds of all vertices, -0.0 written as 0.0."""
    section = inspection.sections["SCEN"]
    # Adding 0.0 turns -0.0 into 0.0.
    wanted = np.concatenate([lowest.min(axis=0), highest.max(axis=0)]) + np.float32(0.0)
    written = np.frombuffer(section.data, "<u4", 6, 40)
    inspection.found_where(
        "RDM205",
        wanted.view(np.uint32) != written,
        lambda i: f"SCEN: {('low', 'high')[i // 3]}_{'xyz'[i % 3]}",
        lambda i: section.at(40 + 4 * i),
    )
