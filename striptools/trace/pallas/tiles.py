"""Scenes as a kernel sees them: what rays, a thread each, read of nodes and leaves.

What a ray has but one of is an array (rays,). What it has of four lanes at once, children of its node or
triangles of its leaf, is a tile (rays, 4), all of it in the ray's thread: one read of 16 bytes.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple, Protocol, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.experimental.pallas import triton as plgpu

from striptools.trace.box import FAR_FACTOR
from striptools.trace.pallas.arithmetic import KernelArithmetic
from striptools.trace.triangle import Shear, edge_functions, sheared
from striptools.trace.walk import WIDTH, Decode, Frame, Leaf, WalkScene
from striptools.trace.walk_packed import (
    PackedScene,
    power_of_two,
    used_bytes,
)
from striptools.trace.walk_wide import WideScene

RAYS = 32
"""Rays of a program at a time, which is a warp."""

HALF = 4
"""Lanes of a tile."""

ROOM = np.float32(2.0**-22)
"""How much boxes of packed nodes are widened, in units of 2**15 steps: see `PackedTile.lanes_met`."""

Three = tuple[Array, Array, Array]
Point = tuple[Array, Array]
"""A corner as a ray sees it that is upright in 0."""


class Sides(NamedTuple):
    """A ray as box tests see it: `box.Slab`, its sides in the order in which the ray meets them.

    Attributes:
        near: Minus origin times inverse direction for near sides, (rays,) float32 along each axis.
        far: The same for far sides.
        inverse: The inverse direction.
        near_rows: The rows of near sides among a node's six, int32.
        far_rows: Those of far sides: kept, since what is computed costs more.
    """

    near: Three
    far: Three
    inverse: Three
    near_rows: Three
    far_rows: Three


class Tile(Protocol):
    """A scene within a kernel: arrays are references to the GPU's memory."""

    def among(self, mask: Array) -> Self:
        """The same, for the rays in the mask: what is read for others is nothing, and unknown."""
        ...

    def lanes_met(self, node: Array, sides: Sides, limit: Array) -> list[Array]:
        """(rays, 4) bool of each half: the nodes' children whose boxes the rays meet, from 0 to `limit`.

        Of any ray: reading under no mask saves setting to zero what is read.
        """
        ...

    def child_of(self, node: Array, lane: Array) -> Array:
        """The child in a lane, as the walk names it."""
        ...

    def find_leaf(self, child: Array) -> Any:
        """Where the triangles of leaves are; for rays that are not in the mask, some leaf."""
        ...

    def lanes_crossed(self, shear: Shear, where: Any, decode: Decode | None) -> Array:
        """Int32: bits of lanes whose triangles the rays may go through, by their edge functions."""
        ...

    def triangle_of(self, axes: Three, where: Any, lane: Array, decode: Decode | None) -> Leaf:
        """The triangles in one lane of leaves, (rays,) each, their corners along these axes."""
        ...

    def faces_of(self, names: Array) -> Array:
        """The faces of hits, negative where there is none."""
        ...


class Source(NamedTuple):
    """How a kernel takes a scene: the arrays it is given, and the tile made of references to them."""

    arrays: list[Any]
    tile: Callable[[list[Any], KernelArithmetic], Any]


def source_of(scene: WalkScene) -> Source:
    """The arrays of a scene that a kernel reads."""
    if isinstance(scene, PackedScene):
        held = [a for a in _packed_arrays(scene) if a.size]
        return Source(held, partial(PackedTile.of, scene))
    assert isinstance(scene, WideScene)
    return Source(
        [scene.nodes, scene.blocks], lambda refs, arithmetic: WideTile(refs[0], refs[1], arithmetic)
    )


FRAME_WORDS = 9


def frame_words(frame: Frame) -> Array:
    """(9,) float32, as a kernel takes it."""
    words = [jnp.reshape(frame.scale, 1), jnp.reshape(frame.reach, 1), frame.low, frame.unit]
    return jnp.concatenate([*words, jnp.reshape(frame.margin, 1)])


def frame_at(words: Any) -> Frame:
    """The frame, of references."""
    scale, reach, *rest = (words[k] for k in range(FRAME_WORDS))
    return Frame(scale, reach, tuple(rest[0:3]), tuple(rest[3:6]), rest[6])


def lane_numbers(half: Any = 0) -> Array:
    """(rays, 4) int32: the numbers of the lanes of a half."""
    return lax.broadcasted_iota(np.int32, (RAYS, HALF), 1) + HALF * half


def bits_in(flags: Array, bits: Array) -> Array:
    """The sum of the bits of lanes whose flag is set."""
    return jnp.sum(jnp.where(flags, bits, np.int32(0)), axis=1)


def three(values: Iterable[Array]) -> Three:
    """Three of them, as a tuple."""
    a, b, c = values
    return a, b, c


def each(values: Array) -> Array:
    """What each ray has one of, for all of its lanes."""
    return values[:, None]


def passes(near: list[Array], far: list[Array], limit: Array, arithmetic: KernelArithmetic) -> Array:
    """As `box.passes`, sides in order; where there is no box, all of them are not a number."""
    entry = lax.max(lax.max(near[0], near[1]), lax.max(near[2], jnp.zeros_like(near[2])))
    leaving = lax.min(far[0], lax.min(far[1], far[2])) * FAR_FACTOR
    return entry <= arithmetic.least(leaving, limit)


def may_be_inside(a: Point, b: Point, c: Point, arithmetic: KernelArithmetic) -> Array:
    """Whether a ray may go through triangles: their edge functions do not have different signs.

    In whatever order corners come, edge functions are the same numbers or all of the other sign. Not where
    none of them is a number: such a triangle is none, or too far away to be hit.
    """
    smaller, larger = arithmetic.sifting.smaller, arithmetic.sifting.larger
    x, y = zip(a, b, c, strict=True)
    p, q, r = edge_functions(x, y, arithmetic.sifting)
    return smaller(-smaller(smaller(p, q), r), larger(larger(p, q), r)) <= 0


class WideTile(NamedTuple):
    """References to a `WideScene`."""

    nodes: Any
    blocks: Any
    arithmetic: KernelArithmetic
    mask: Any = None

    def among(self, mask: Array) -> "WideTile":
        """The same, for the rays in the mask."""
        return self._replace(mask=mask)

    def lanes_met(self, node: Array, sides: Sides, limit: Array) -> list[Array]:
        """As `WideScene.lanes_met`."""
        met = []
        for half in range(WIDTH // HALF):
            near, far = [], []
            for axis in range(3):
                for found, row, at in (
                    (near, sides.near_rows[axis], sides.near[axis]),
                    (far, sides.far_rows[axis], sides.far[axis]),
                ):
                    side = plgpu.load(self.nodes.at[each(node), each(row), lane_numbers(half)])
                    found.append(self.arithmetic.fused(side, each(sides.inverse[axis]), each(at)))
            met.append(passes(near, far, each(limit), self.arithmetic))
        return met

    def child_of(self, node: Array, lane: Array) -> Array:
        """As `WideScene.child_of`."""
        return _bits(plgpu.load(self.nodes.at[node, 6, lane], mask=self.mask))

    def find_leaf(self, child: Array) -> Array:
        """As `WideScene.find_leaf`."""
        return ~child

    def lanes_crossed(self, shear: Shear, where: Array, decode: Decode | None) -> Array:
        """Lane by lane, of any ray: see `lanes_met`."""
        seen = jax.tree.map(each, shear)

        def sift(half: Any, crossed: Array) -> Array:
            lanes = lane_numbers(half)

            def corner(axis: Array, k: int) -> Array:
                row = each(axis.astype(np.int32) * 3 + k)
                return plgpu.load(self.blocks.at[each(where), row, lanes])

            x, y, z = (three(corner(axis, k) for k in range(3)) for axis in shear.axes)
            x, y, _ = sheared(x, y, z, seen, self.arithmetic.sifting)
            a, b, c = zip(x, y, strict=True)
            may = may_be_inside(a, b, c, self.arithmetic)
            return crossed | bits_in(may, np.int32(1) << lanes)

        # A loop: corners of one half at a time take fewer registers, and more warps are at work.
        return lax.fori_loop(0, WIDTH // HALF, sift, jnp.zeros_like(where))

    def triangle_of(self, axes: Three, where: Array, lane: Array, decode: Decode | None) -> Leaf:
        """As `WideScene.leaf_of`."""

        def read(row: Array | np.int32) -> Array:
            return plgpu.load(self.blocks.at[where, row, lane], mask=self.mask)

        x, y, z = (three(read(axis.astype(np.int32) * 3 + k) for k in range(3)) for axis in axes)
        return Leaf(x, y, z, None, None, _bits(read(np.int32(9))))

    def faces_of(self, names: Array) -> Array:
        """Names are faces."""
        return names


def _packed_arrays(scene: PackedScene) -> list[Any]:
    """All but the frame and the planes, which nodes have too."""
    return [scene.nodes, scene.slots, scene.blocks, scene.words, scene.faces]


class PackedTile(PackedScene):
    """References to a `PackedScene`; what they mean is decoded there."""

    arithmetic: KernelArithmetic
    mask: Any
    lane: Any

    @classmethod
    def of(cls, scene: PackedScene, refs: list[Any], arithmetic: KernelArithmetic) -> "PackedTile":
        """References in the order of `_packed_arrays`."""
        nodes, slots, blocks, words = refs[:4]
        faces = refs[4] if scene.has_faces else scene.faces
        tile = cls._make((nodes, None, slots, blocks, words, faces, scene.frame))
        tile.arithmetic, tile.mask, tile.lane = arithmetic, None, None
        return tile

    def among(self, mask: Array | None, lane: Array | None = None) -> "PackedTile":
        """The same, for the rays in the mask."""
        tile = self._replace()
        tile.arithmetic, tile.mask, tile.lane = self.arithmetic, mask, lane
        return tile

    def lanes_met(self, node: Array, sides: Sides, limit: Array) -> list[Array]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """As `PackedScene.lanes_met`, with room for what is rounded otherwise.

        A byte q is taken as 1 + q / 2**15, which one instruction makes of it. A plane's distance is that
        times 2**15 s, s the step of planes, plus where they count from less 2**15 s. The last difference, and
        its sum with the room, are off by no more than 2**-23 of 2**15 s and of where planes count from; sides
        are moved by twice the first. The second, and the product with the origin, make of the 7 uM of
        `walk_packed` 16 uM: with the triangle test's 8 uM less than the margin there.
        """
        words = [word for k in range(0, 16, HALF) for word in self._words_of(node, k)]
        origins, shifts = self._grid(words)
        used = used_bytes(words[4], words[10]), used_bytes(words[5], words[11])
        fused = self.arithmetic.fused
        grid = []
        for axis in range(3):
            origin, inverse = origins[axis].astype(np.float32), sides.inverse[axis]
            steps = inverse * power_of_two(shifts[axis] + 15)
            room = abs(steps) * ROOM
            start = fused(origin, inverse, sides.near[axis]) - steps - room
            grid.append((steps, start, fused(origin, inverse, sides.far[axis]) - steps + room))
        met = []
        for half in range(WIDTH // HALF):
            near, far = [], []
            for axis, (steps, start, end) in enumerate(grid):
                low, high = words[4 + 2 * axis + half], words[10 + 2 * axis + half]
                up = sides.near_rows[axis] == axis
                for found, word, at in (
                    (near, jnp.where(up, low, high), start),
                    (far, jnp.where(up, high, low), end),
                ):
                    side = self.arithmetic.one_and_byte(each(word), lane_numbers())
                    found.append(fused(side, each(steps), each(at)))
            filled = (each(used[half].astype(np.int32)) & np.int32(0x80) << 8 * lane_numbers()) != 0
            met.append(passes(near, far, each(limit), self.arithmetic) & filled)
        return met

    def lanes_crossed(self, shear: Shear, where: Any, decode: Decode | None) -> Array:
        """Along the strip: a triangle has two corners of the one before it, and one vertex more."""
        assert decode is not None
        block, axes = self.block_along(where, shear.axes)
        turns, width = where.turns, block.index_width
        length = self.triangles_of(where) - 1

        def corner(at: Array) -> Point:
            index = self._windows(block.word, block.indices + at * width, np.uint32(0), 2)
            index = index & ((np.uint32(1) << width) - 1)
            x, y, z = (three(a * 3) for a in self._positions(block, (index,), axes, decode))
            (x, *_), (y, *_), _ = sheared(x, y, z, shear, self.arithmetic.sifting)
            return x, y

        place = where.place

        def test(carried: Any) -> Any:
            k, far, near, crossed = carried
            last = lax.min(k, length).astype(np.uint32)
            newest = corner(place + last + 1)
            may = may_be_inside(far, near, newest, self.arithmetic) & (k <= length)
            turned = ((turns >> last ^ turns >> (last + 1)) & 1) != 0
            far = tuple(jnp.where(turned, b, a) for a, b in zip(far, near, strict=True))
            return k + 1, far, newest, crossed | jnp.where(may, np.int32(1) << k, np.int32(0))

        most = jnp.max(jnp.where(self.mask, length, np.int32(-1)))
        first = corner(place - where.back), corner(place)
        start = np.int32(0), *first, jnp.zeros_like(length)
        return lax.while_loop(lambda carried: carried[0] <= most, test, start)[3]

    def triangle_of(self, axes: Three, where: Any, lane: Array, decode: Decode | None) -> Leaf:
        """As `PackedScene.leaf_of`."""
        return self.among(self.mask, lane.astype(np.uint32)).leaf_of(axes, where, decode)

    def _words_of(self, node: Array, first: int) -> list[Array]:
        """Four words of nodes, of any ray, in one read."""
        words = plgpu.load(self.nodes.at[each(node), first + lane_numbers()])
        return [bits_in(lane_numbers() == k, words.astype(np.int32)).astype(np.uint32) for k in range(HALF)]

    def _lanes(self) -> Array:
        return self.lane

    def _at(self, values: Any, places: Any) -> Array:
        return plgpu.load(values.at[places], mask=self.mask)

    def _row(self, rows: Any, row: Array, first: Any, count: int) -> list[Array]:
        return [plgpu.load(rows.at[row, first + k], mask=self.mask) for k in range(count)]

    def _words_at(self, places: Array, count: int) -> list[Array]:
        return [self._at(self.words, places + k) for k in range(count)]

    def _settled(self, values: Any) -> Any:
        return jax.tree.map(self.arithmetic.exact.settled, values)


def _bits(values: Array) -> Array:
    return lax.bitcast_convert_type(values, np.int32)
