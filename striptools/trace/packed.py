"""A scene laid out for the walk as it lies in its file: packed blocks, quantised nodes, runs."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from striptools.hierarchies.packed import BoxGrid, PackedNodes
from striptools.kernels import packed_hits as kernels
from striptools.threads import in_chunks
from striptools.trace.leaves import Found, Rays, aligned_zeros, reach_of, scale_of, size_class
from striptools.trace.walk import WIDTH, Decode, Frame
from striptools.trace.walk_packed import MARGIN, SLACK_WORDS, PackedScene

if TYPE_CHECKING:
    from striptools.reducem.blocks import Blocks
    from striptools.reducem.scene import Scene

SMALLEST = 64
"""Blocks below which another thread is not worth its start."""

STEPS = 16
"""Size classes to each doubling: 4 % of memory at most for programs that scenes share."""


@dataclass(frozen=True, eq=False)
class PackedLayout:
    """What a tracer keeps of a packed scene.

    Attributes:
        arrays: For the device, as NumPy arrays.
        blocks: How many blocks there are.
        rotations: (n,) uint8 of the remap, or (0,).
        decode: How leaves are decoded.
        depth: The most nodes on a way from the root down.
    """

    arrays: PackedScene
    blocks: int
    rotations: np.ndarray
    decode: Decode
    depth: int

    @property
    def root(self) -> tuple[np.ndarray, np.ndarray]:
        """(6, 8) float32 boxes of the root's children in cells, NaN where there is none, and children."""
        word, record = self.arrays.nodes[0].astype(np.int64), self.arrays.planes[0]
        origin = np.array([word[2] & 0xFFFF, word[2] >> 16, word[3] & 0xFFFF])
        shift = np.array([word[0] >> 28, word[3] >> 24 & 15, word[3] >> 28])
        planes = record[16:].reshape(2, 3, WIDTH).astype(np.int64)
        empty = planes[0, 0] > planes[1, 0]
        boxes = (origin[:, None] + (planes << shift[:, None])).reshape(6, WIDTH).astype(np.float32)
        inner = np.unpackbits(record[14:15], bitorder="little") == 1
        leaf = ~inner & ~empty
        rank = np.cumsum(leaf) - 1
        child = np.where(inner, (word[0] & 0xFFFFFFF) + np.cumsum(inner) - 1, -1 - np.arange(WIDTH))
        top = int(self.arrays.top_count)
        if top:
            child = np.where(leaf, top + (word[1] & 0xFFFFFF) + rank, child)
        return np.where(empty, np.float32(np.nan), boxes), child.astype(np.int32)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays; planes are the nodes' memory."""
        arrays = self.arrays
        held = (arrays.nodes, arrays.headers, arrays.words, arrays.first_run, arrays.runs, arrays.faces)
        return sum(a.nbytes for a in held) + self.rotations.nbytes

    def named(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Faces of triangles, the triangles, and how the corners of the file's are turned."""
        faces = self.arrays.faces[names] if self.arrays.has_faces else names
        turns = self.rotations[names] if len(self.rotations) else np.zeros(len(names), np.uint8)
        return faces, names, turns

    def weigh(self, rays: Rays, at: np.ndarray, traced: tuple[np.ndarray, ...], found: Found) -> None:
        """Fill in what was found of the rays `at`: t, face, u, v and triangle."""
        arrays = self.arrays
        headers = arrays.headers[: self.blocks]
        kept = (
            headers,
            arrays.words,
            arrays.faces,
            self.rotations,
            arrays.frame.scale,
            int(arrays.scale_exponent),
        )
        kernels.weigh_packed_hits(rays[0], rays[1], at, traced[0], traced[1], *kept, *found)


def lay_out_packed(scene: "Scene", threads: int = 1) -> PackedLayout:
    """Lay a scene out for the walk through its blocks; nodes that the file does not hold are built."""
    packed, blocks = scene.with_boxes(threads), scene.blocks
    assert packed.first_run is not None
    assert packed.runs is not None
    nodes = _padded(packed.nodes, len(packed.nodes) + 1)
    planes = nodes.view(np.uint8)
    kernels.mark_leaves(nodes, planes, packed.top_count)
    described = _described(packed, blocks, threads)
    scale = scale_of(scene)
    exponent = int(np.frexp(scale)[1]) - 1
    faces, rotations = _names(scene)
    arrays = PackedScene(
        nodes,
        planes,
        _padded(blocks.headers, blocks.count),
        _padded(blocks.words, len(blocks.words) + SLACK_WORDS),
        _padded(packed.first_run, blocks.count),
        _padded(described, len(described)),
        faces,
        np.uint32(packed.top_count),
        np.int32(exponent),
        _frame(scene, scale, exponent),
    )
    count = len(packed.nodes)
    depth = int(kernels.depth_of(nodes[:count], planes[:count], packed.top_count))
    return PackedLayout(arrays, blocks.count, rotations, decode_of(blocks, exponent), depth)


def _described(packed: PackedNodes, blocks: "Blocks", threads: int) -> np.ndarray:
    """(r,) uint32: what the walk is told of each run."""
    assert packed.first_run is not None
    assert packed.runs is not None
    described = np.zeros(len(packed.runs), np.uint32)
    starts = np.append(packed.first_run, len(packed.runs)).astype(np.int64)
    given = (blocks.headers, blocks.words, starts, packed.runs)
    in_chunks(lambda part: kernels.describe_runs(*given, *part, described), blocks.count, threads, SMALLEST)
    return described


def decode_of(blocks: "Blocks", scale_exponent: int) -> Decode:
    """What a walk has to compile in for these blocks.

    Args:
        blocks: Whose rules are kept.
        scale_exponent: That of the power of two that coordinates are multiplied by.
    """
    headers = blocks.headers
    mode, width = blocks.axes()
    exponents = np.stack([headers[:, 6] >> 24, headers[:, 7] & 0xFF, headers[:, 7] >> 8 & 0xFF], axis=1)
    # An axis of nothing but zeros has the least exponent there is.
    zero = (headers[:, 3:6] == 0) & (width <= mode)
    least = int(np.where((mode == 2) | zero, 0, exponents.astype(np.int64) - 149).min())
    least = min(least, int(kernels.least_exponent(headers, blocks.words)))
    return Decode(
        words=max(1, (int(width.sum(axis=1).max()) + 31 + 31) // 32),
        minus_zero=bool((mode == 1).any()),
        as_bits=bool((mode == 2).any()),
        flips=bool((headers[:, 2] >> 24 & 1).any()),
        tiny=min(least, least + scale_exponent) < -126,
    )


def _frame(scene: "Scene", scale: np.float32, exponent: int) -> Frame:
    """The grid of the boxes, scaled; cells too small or too large for float32 make no difference."""
    grid: BoxGrid = scene.grid
    cells = grid.cell + exponent
    unit = np.where(cells < -126, 0.0, np.ldexp(1.0, np.clip(cells, -126, 60)))
    low = (grid.low.astype(np.float64) * float(scale)).astype(np.float32)
    return Frame(scale, reach_of(scene, scale), low, unit.astype(np.float32), MARGIN)


def _names(scene: "Scene") -> tuple[np.ndarray, np.ndarray]:
    """The face that a hit on each triangle is reported as, and how its corners are turned; or nothing."""
    if scene.remap is None:
        return np.zeros(0, np.int32), np.zeros(0, np.uint8)
    return _padded(scene.remap.face, len(scene.remap.face)), scene.remap.rotation


def _padded(values: np.ndarray, count: int) -> np.ndarray:
    """A copy with zeros behind it up to a size class, from a cache line on."""
    padded = aligned_zeros((size_class(count, STEPS), *values.shape[1:]), values.dtype.type)
    padded[: len(values)] = values
    return padded


__all__ = ["PackedLayout", "PackedNodes", "decode_of", "lay_out_packed"]
