"""A scene laid out for the walk as it lies in its file: packed blocks, quantised nodes, runs."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from striptools.errors import LimitError
from striptools.hierarchies.packed import BoxGrid
from striptools.kernels import packed_hits as kernels
from striptools.kernels.packed_nodes import slot_children
from striptools.kernels.weighing_double import packed_corners
from striptools.trace.counters import Counters
from striptools.trace.layout import Found, PacketView, Rays, blocks_of, packet_view
from striptools.trace.leaves import CACHE_LINE, aligned_zeros, reach_of, scale_of, size_class
from striptools.trace.walk import WIDTH, Decode, Frame
from striptools.trace.walk_packed import MARGIN, PackedScene

if TYPE_CHECKING:
    from striptools.reducem.blocks import Blocks
    from striptools.reducem.scene import Scene

MOST_BLOCKS = 2**23
"""Blocks that a hit can name: an int32 holds 256 times as much."""

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
    def triangles(self) -> int:
        """How many there are."""
        last = self._blocks[-1]
        return int(last[kernels.HEAD]) + int(last[kernels.HEAD + 2] & 0xFF) + 1

    @property
    def _blocks(self) -> np.ndarray:
        """What is said of the blocks, without what fills up the size class."""
        return self.arrays.blocks[: self.blocks]

    @property
    def root(self) -> tuple[np.ndarray, np.ndarray]:
        """(6, 8) float32 boxes of the root's children in cells, NaN where there is none, and children."""
        word, record = self.arrays.nodes[0].astype(np.int64), self.arrays.planes[0].reshape(64)
        origin = np.array([word[2] & 0xFFFF, word[2] >> 16, word[3] & 0xFFFF])
        shift = np.array([word[0] >> 28, word[3] >> 24 & 15, word[3] >> 28])
        planes = record[16:].reshape(2, 3, WIDTH).astype(np.int64)
        empty = planes[0, 0] > planes[1, 0]
        boxes = (origin[:, None] + (planes << shift[:, None])).reshape(6, WIDTH).astype(np.float32)
        said = self.arrays.slots[0].view(np.int32)
        child = np.where(said < 0, -1 - np.arange(WIDTH), said)
        return np.where(empty, np.float32(np.nan), boxes), child.astype(np.int32)

    @property
    def seen_by_packets(self) -> PacketView | None:
        """What packets are readied by."""
        boxes, _ = self.root
        low, high = np.nanmin(boxes[:3], axis=1), np.nanmax(boxes[3:6], axis=1)
        frame = self.arrays.frame
        box = np.concatenate([low * frame.unit + frame.low, high * frame.unit + frame.low])
        return packet_view(frame, box.astype(np.float32), self.triangles)

    @property
    def missed(self) -> Counters:
        """What a ray that meets none of the root's children counts."""
        return self.arrays.counters_of(1, 0, 0)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays; planes are the nodes' memory."""
        arrays = self.arrays
        held = (arrays.nodes, arrays.slots, arrays.blocks, arrays.words, arrays.faces)
        return sum(a.nbytes for a in held) + self.rotations.nbytes

    @property
    def shared_bytes(self) -> int:
        """Bytes that nodes and planes share here, which a GPU keeps twice."""
        return self.arrays.planes.nbytes

    def corners_of(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `layout.Layout`."""
        corners, turns = np.zeros((len(names), 3, 3), np.float32), np.zeros(len(names), np.int32)
        packed_corners(names, self._blocks, self.arrays.words, self.rotations, corners, turns)
        return corners, turns

    def named(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Faces and triangles of what the walk names, and how the corners of the file's are turned."""
        triangles = (self._blocks[names >> 8, kernels.HEAD] + (names & 0xFF)).astype(np.int32)
        faces = self.arrays.faces[triangles] if self.arrays.has_faces else triangles
        turns = self.rotations[triangles] if len(self.rotations) else np.zeros(len(names), np.uint8)
        return faces, triangles, turns

    def names(self) -> np.ndarray:
        """See `layout.Layout`: 256 times the block and the number there."""
        said = self._blocks[:, kernels.HEAD :].astype(np.int64)
        first, count = said[:, 0], (said[:, 2] & 0xFF) + 1
        block = np.repeat(np.arange(self.blocks), count)
        return (block << 8 | (np.arange(len(block)) - first[block])).astype(np.int32)

    def corner_blocks(self, most: int) -> Iterator[np.ndarray]:
        """See `layout.Layout`: decoded."""
        names = self.names()
        for first in range(0, len(names), most * WIDTH):
            yield blocks_of(self.corners_of(names[first : first + most * WIDTH])[0])

    def weigh(self, rays: Rays, at: np.ndarray, traced: tuple[np.ndarray, ...], found: Found) -> None:
        """Fill in what was found of the rays `at`: t, face, u, v and triangle."""
        arrays = self.arrays
        kept = (self._blocks, arrays.words, arrays.faces, self.rotations, arrays.frame.scale)
        kernels.weigh_packed_hits(rays[0], rays[1], at, traced[0], traced[1], *kept, *found)


def lay_out_packed(scene: "Scene", threads: int = 1) -> PackedLayout:
    """Lay a scene out for the walk through its blocks; nodes that the file does not hold are built.

    Nodes and streams of a scene that holds its boxes are taken as they lie, in a mapped file too, where that
    is from a cache line on; others are copied to a size class, so that scenes of like size share a program.
    What headers and runs say is worked out, as to do so at each visit would take longer than the visit.

    JAX uses arrays that start at a cache line where they lie on a CPU, and copies others. So nodes and planes
    are one memory there; a GPU has them twice, as words and as bytes.
    """
    packed, blocks = scene.with_boxes(threads), scene.blocks
    if blocks.count > MOST_BLOCKS:
        raise LimitError(
            f"{blocks.count} blocks are more than {MOST_BLOCKS}",
            where="compressed scene",
            remedy="trace it expanded",
        )
    assert packed.first_run is not None
    assert packed.runs is not None
    stored = scene.packed.runs is not None
    laid: Callable[[np.ndarray], np.ndarray] = _aligned if stored else _padded
    scale = scale_of(scene)
    exponent = int(np.frexp(scale)[1]) - 1
    faces, rotations = _names(scene, laid)
    nodes, count = laid(packed.nodes), len(packed.nodes)
    slots = aligned_zeros((len(nodes), WIDTH), np.uint32)
    child = np.zeros((count, WIDTH), np.int32)
    slot_children(packed.nodes, packed.top_count, packed.first_run, child)
    kernels.describe_slots(child, packed.runs, slots[:count])
    # Classes are of words: few blocks do not take the room of a thousand.
    words = kernels.BLOCK_WORDS * blocks.count
    rows = (words if stored else size_class(words, STEPS)) // kernels.BLOCK_WORDS
    said = aligned_zeros((rows, kernels.BLOCK_WORDS), np.uint32)
    kernels.describe_blocks(blocks.headers, exponent, said)
    planes = nodes.view(np.uint8).reshape(-1, WIDTH, WIDTH)
    frame = _frame(scene, scale, exponent)
    arrays = PackedScene(nodes, planes, slots, said, laid(blocks.words), faces, frame)
    depth = int(kernels.depth_of(slots[:count]))
    return PackedLayout(arrays, blocks.count, rotations, decode_of(blocks, exponent), depth)


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


def _names(scene: "Scene", laid: Callable[[np.ndarray], np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """The face that a hit on each triangle is reported as, and how its corners are turned; or nothing."""
    if scene.remap is None:
        return np.zeros(0, np.int32), np.zeros(0, np.uint8)
    return laid(scene.remap.face), scene.remap.rotation


def _padded(values: np.ndarray) -> np.ndarray:
    """A copy with zeros behind it up to a size class, from a cache line on."""
    padded = aligned_zeros((size_class(len(values), STEPS), *values.shape[1:]), values.dtype.type)
    padded[: len(values)] = values
    return padded


def _aligned(values: np.ndarray) -> np.ndarray:
    """The values from a cache line on: themselves, or a copy where they start elsewhere."""
    if values.ctypes.data % CACHE_LINE == 0:
        return values
    copy = aligned_zeros(values.shape, values.dtype.type)
    copy[:] = values
    return copy


__all__ = ["PackedLayout", "decode_of", "lay_out_packed"]
