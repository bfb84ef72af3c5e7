"""A scene laid out for the walk, expanded: wide nodes, leaf blocks, and the way from a face to its place."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Int32

from striptools.errors import LimitError
from striptools.hierarchies.packed import wide_tree
from striptools.hierarchies.rebuilt import rebuild, rebuild_pieces
from striptools.hierarchies.wide import EMPTY, WIDTH, WideTree
from striptools.kernels.weighing import weigh_hits
from striptools.kernels.weighing_double import block_corners
from striptools.kernels.wide import fill_leaf_blocks
from striptools.reducem.resident import size_class
from striptools.trace.box import MARGIN
from striptools.trace.counters import Counters
from striptools.trace.layout import Found, PacketView, Rays, packet_view
from striptools.trace.walk import DONE, NO_NAME, Frame
from striptools.trace.walk_wide import WideScene

if TYPE_CHECKING:
    from striptools.reducem.placed import Placed
    from striptools.reducem.scene import Scene

CACHE_LINE = 64


@dataclass(frozen=True, eq=False)
class LeafBlocks:
    """Triangles as the tests read them.

    Attributes:
        blocks: (l, 10, 8) float32, see `kernels.wide.fill_leaf_blocks`; sizes are padded.
        place: (f,) int32, of each face: (block * 8 + lane) * 4 + turn; one of them where it has several.
        triangle_of: (f,) int32, the triangle in file order of each face that hits report, -1 for faces not in
            the scene; (0,) where triangles are their own faces.
        scale: float32 power of two that positions were multiplied by.
    """

    blocks: np.ndarray
    place: Int32[np.ndarray, " f"]
    triangle_of: Int32[np.ndarray, " f"]
    scale: np.float32

    def corners_of(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `layout.Layout`."""
        corners, turns = np.zeros((len(names), 3, 3), np.float32), np.zeros(len(names), np.int32)
        block_corners(names, self.place, self.blocks, corners, turns)
        return corners, turns

    def weigh(self, rays: Rays, at: np.ndarray, traced: tuple[np.ndarray, ...], found: Found) -> None:
        """Fill in what was found of the rays `at`: t, face, u, v and triangle."""
        given = (at, traced[0], traced[1], self.place, self.blocks, self.scale, self.triangle_of)
        weigh_hits(rays[0], rays[1], *given, *found)


@dataclass(frozen=True, eq=False)
class ExpandedLayout:
    """What a tracer keeps of an expanded scene, whatever its hierarchy.

    Attributes:
        arrays: For the device, as NumPy arrays; a `walk.WalkScene`.
        leaves: The blocks among them, and the way from a face to its place.
        depth: The most nodes on a way from the root down.
    """

    arrays: Any
    leaves: LeafBlocks
    depth: int

    @property
    def decode(self) -> None:
        """Nothing is packed."""

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        kept = _arrays_in(self.arrays)
        return sum(a.nbytes for a in kept) + self.leaves.place.nbytes + self.leaves.triangle_of.nbytes

    @property
    def shared_bytes(self) -> int:
        """No two arrays share any."""
        return 0

    def corners_of(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `layout.Layout`."""
        return self.leaves.corners_of(names)

    def named(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Faces and triangles of what the walk names, and how the corners of its leaves are turned."""
        triangle_of = self.leaves.triangle_of
        triangles = triangle_of[names] if len(triangle_of) else names
        return names, triangles, self.leaves.place[names] & 3

    def names(self) -> np.ndarray:
        """See `layout.Layout`: the faces that they are reported as."""
        triangle_of = self.leaves.triangle_of
        if len(triangle_of) == 0:
            return np.arange(len(self.leaves.place), dtype=np.int32)
        faces = np.flatnonzero(triangle_of >= 0).astype(np.int32)
        return faces[np.argsort(triangle_of[faces])]

    def corner_blocks(self, most: int) -> Iterator[np.ndarray]:
        """See `layout.Layout`: those that the walk has."""
        blocks = self.leaves.blocks
        for first in range(0, len(blocks), most):
            yield blocks[first : first + most, :9]

    def weigh(self, rays: Rays, at: np.ndarray, traced: tuple[np.ndarray, ...], found: Found) -> None:
        """Fill in what was found of the rays `at`: t, face, u, v and triangle."""
        self.leaves.weigh(rays, at, traced, found)


@dataclass(frozen=True, eq=False)
class WideLayout(ExpandedLayout):
    """What a tracer keeps of an expanded scene under eight-wide nodes.

    Attributes:
        repeats: Whether some triangle is in several leaves.
    """

    repeats: bool = False

    @property
    def seen_by_packets(self) -> PacketView | None:
        """What packets are readied by."""
        boxes = self.arrays.nodes[0]
        box = np.concatenate([np.nanmin(boxes[:3], axis=1), np.nanmax(boxes[3:6], axis=1)])
        return packet_view(self.arrays.frame, box, len(self.leaves.place))

    @property
    def root(self) -> tuple[np.ndarray, np.ndarray]:
        """(7, k) float32, boxes of the root's children, NaN where there is none, and (k,) int32 children."""
        node = self.arrays.nodes[0]
        return node, node[6].view(np.int32)

    @property
    def missed(self) -> Counters:
        """What a ray that meets none of the root's children counts."""
        return self.arrays.counters_of(1, 0, 0)


def _arrays_in(arrays: Any) -> list[np.ndarray]:
    """The arrays of named tuples within each other, but those of a frame."""
    if isinstance(arrays, Frame):
        return []
    if isinstance(arrays, tuple):
        return [array for part in arrays for array in _arrays_in(part)]
    return [arrays] if isinstance(arrays, np.ndarray) else []


def lay_out(scene: "Scene", threads: int = 1) -> WideLayout:
    """Lay a scene out for the walk through its own hierarchy."""
    boxes = scene.triangle_boxes(threads)
    return lay_out_wide(scene, wide_tree(scene.with_boxes(threads), boxes, scene.block_starts))


def lay_out_rebuilt(
    scene: "Scene | Placed", threads: int = 1, *, once: bool = False, width: int = WIDTH
) -> WideLayout:
    """Lay a scene out for the walk through a new SAH hierarchy over its triangles, whatever their strips.

    Args:
        scene: Whose triangles they are.
        threads: How many share the work.
        once: Each triangle is in one leaf; else large ones are in several, which is faster to walk, but not
            for what counts triangles.
        width: Children of a node, 8, or 16 for a CPU.
    """
    if once:
        return lay_out_wide(scene, *rebuild(scene.triangle_boxes(threads), threads, width=width))
    return lay_out_wide(scene, *rebuild_pieces(scene.positions, scene.faces(), threads, width=width))


def lay_out_wide(
    scene: "Scene | Placed", wide: WideTree, order: Int32[np.ndarray, " n"] | None = None
) -> WideLayout:
    """Lay a scene out for the walk through any wide hierarchy over its triangles.

    Args:
        scene: Whose triangles they are.
        wide: Its leaves are runs of places.
        order: (k,) int32, the triangle in file order at each place, k >= n where some are in several leaves;
            None where they are in file order.
    """
    held = fill_blocks(scene, wide.leaf_first, wide.leaf_count, order)
    nodes = _nodes(wide, held.scale)
    zero, one = np.zeros(3, np.float32), np.ones(3, np.float32)
    frame = Frame(held.scale, reach_of(scene, held.scale), zero, one, MARGIN)
    repeats = order is not None and len(order) > scene.triangle_count
    return WideLayout(WideScene(nodes, held.blocks, frame), held, wide.depth, repeats)


def fill_blocks(
    scene: "Scene | Placed",
    first: Int32[np.ndarray, " l"],
    count: Int32[np.ndarray, " l"],
    order: Int32[np.ndarray, " k"] | None = None,
) -> LeafBlocks:
    """Lay triangles out in blocks of up to eight.

    Args:
        scene: Whose triangles they are.
        first: (l,) int32, the first place of each block.
        count: (l,) int32, how many it holds, 1 to 8.
        order: (k,) int32, the triangle in file order at each place; None where they are in file order.
    """
    faces = scene.faces()
    ids, rotations = _names(scene, len(faces))
    triangle = np.arange(len(faces), dtype=np.int32) if order is None else order
    faces, ids, rotations = faces[triangle], ids[triangle], rotations[triangle]
    scale = scale_of(scene)
    blocks = aligned_full((size_class(len(first)), 10, WIDTH), np.nan)
    blocks[:, 9] = NO_NAME.view(np.float32)
    face_count = int(ids.max()) + 1
    place = np.zeros(face_count, np.int32)
    given = (scene.positions, faces, ids, rotations, scale, first, count)
    fill_leaf_blocks(*given, blocks, blocks.view(np.int32), place)
    triangle_of = np.zeros(0, np.int32)
    if scene.remap is not None:
        triangle_of = np.full(face_count, -1, np.int32)
        triangle_of[ids] = triangle
    return LeafBlocks(blocks, place, triangle_of, scale)


def _names(scene: "Scene | Placed", count: int) -> tuple[Int32[np.ndarray, " n"], np.ndarray]:
    """The face that a hit on each triangle is reported as, and how its corners are turned."""
    if scene.remap is None:
        return np.arange(count, dtype=np.int32), np.zeros(count, np.uint8)
    return scene.remap.face, scene.remap.rotation


def _nodes(wide: WideTree, scale: np.float32) -> np.ndarray:
    """Wide nodes as the walk reads them: scaled, empty lanes not a number, padded to a size class."""
    count = len(wide.boxes)
    nodes = aligned_full((size_class(count + 1), 7, wide.child.shape[1]), np.nan)
    np.multiply(wide.boxes, scale, out=nodes[:count, :6])
    np.copyto(nodes[:count, :6], np.nan, where=(wide.child == EMPTY)[:, None])
    children = nodes[:, 6].view(np.int32)
    children[:] = DONE
    children[:count] = wide.child
    return nodes


def scale_of(scene: "Scene | Placed") -> np.float32:
    """The power of two that brings the largest coordinate to 1 to 2.

    Scaling by it is exact, and the model's unit no longer matters.

    Raises:
        LimitError: All coordinates are denormal.
    """
    return scale_for(_largest(scene))


def scale_for(largest: float) -> np.float32:
    """The power of two that brings the largest coordinate to 1 to 2; 1 where it is next to nothing."""
    if largest < float(np.finfo(np.float32).tiny):
        raise LimitError(
            f"the largest coordinate, {largest:.4g}, is less than 2**-126, which counts as zero",
            where="scene",
            remedy="convert the mesh in a smaller unit",
        )
    exponent = int(np.floor(np.log2(largest)))
    return np.float32(2.0 ** -min(max(exponent, -126), 126))


def reach_of(scene: "Scene | Placed", scale: np.float32) -> np.float32:
    """The largest scaled coordinate."""
    return np.float32(_largest(scene) * float(scale))


def _largest(scene: "Scene | Placed") -> float:
    """The largest coordinate."""
    return float(np.abs([scene.low, scene.high]).max())


def aligned_full(shape: tuple[int, ...], value: float) -> np.ndarray:
    """A float32 array that starts at a cache line: CPU devices use such arrays where they lie, uncopied."""
    array = aligned_zeros(shape, np.float32)
    array.fill(value)
    return array


def aligned_zeros(shape: tuple[int, ...], dtype: type[np.generic]) -> np.ndarray:
    """An array of zeros that starts at a cache line."""
    return aligned(partial(np.zeros, dtype=np.uint8), shape, dtype)


def aligned(room: Callable[[int], np.ndarray], shape: tuple[int, ...], dtype: type[np.generic]) -> np.ndarray:
    """An array that starts at a cache line, in whatever room for so many bytes has."""
    length = int(np.prod(shape)) * np.dtype(dtype).itemsize
    memory = room(length + CACHE_LINE)
    start = -memory.ctypes.data % CACHE_LINE
    return memory[start : start + length].view(dtype).reshape(shape)
