"""A scene of packed blocks, as the walk sees it: nodes and bit streams as a scene file has them.

Nodes follow Ylitie, Karras & Laine, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs"
(HPG 2017), leaves Lauterbach et al., ReduceM (EGSR 2008): a leaf is up to eight triangles of a strip, decoded
where they are tested. What the bits mean is SPEC 4.2 to 4.5. Hits are those of `walk_wide`, bit for bit: the
same corners, scaled by the same power of two, in the same test.

Differences:

1. A leaf is named by its node and slot. What is in a node's slots, and what the headers of blocks say, is
   worked out when the scene is laid out (`kernels.packed_hits`), 32 bytes a node and 64 a block: to do so at
   each visit took a third of a leaf's instructions and a tenth of a node's. Of a run it says where its
   triangles' corners are in the strip, so that no start or turn bit is read.
2. What no block of the scene needs is not compiled in (`walk.Decode`).
3. Corners are not put in the canonical order; only the sums are made in it (`triangle.crossing_of`).
4. Lanes hold triangles, not faces: the remap is read where two hits have the same t, and nowhere else.

**Boxes.** With L the grid's low and c its cell on an axis, scaled, a plane K = origin + (q << shift) is at
L + cK exactly, and K, below 2**24, is an exact float32. Of a ray at o with (rounded) inverse direction v the
distance to it, with margin m, is computed as

    K * cv - ((o + m) - L) * v,   cv exact, c a power of two.

In units of position, with u = 2^-24 and M the largest of |o| and the scene's coordinates, rounding o + m and
taking L away and multiplying by v moves it by at most u (M + 2 * 2M); the product with K by u 2M, none of it
where fused. The last sum is relative to the distance itself, which `box.FAR_FACTOR` allows for. That is 7 uM,
and the triangle test needs 8 uM more (`box.REACH`): `MARGIN` is 32 uM, a power of two. A cell that
would be denormal counts as zero: its planes move by less than 2^-100.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from striptools.kernels.packed_hits import BIAS, HEAD
from striptools.trace.box import Slab, passes
from striptools.trace.counters import Counters
from striptools.trace.numerics import index
from striptools.trace.triangle import Corners, pick
from striptools.trace.walk import (
    DONE,
    WIDTH,
    Best,
    Decode,
    Frame,
    Leaf,
    Sighted,
    Traced,
    WalkOptions,
    found_in,
    sifted,
    walk_rays,
)
from striptools.trace.walk_packets import walk_packets

MARGIN = np.float32(2.0**-19)
"""Widening of a box in units of the largest coordinate of ray origin and scene."""

LANES = 8

NODE_BYTES = 64 + 4
"""What a node reads: its boxes, and what is said of the slot that is visited next."""

LEAF_BYTES = 4 + 4 + 64
"""What a leaf reads beside its triangles: of its run, its block's number, and of its block."""

TRIANGLE_BYTES = 3 + 3 * 10
"""What a triangle reads, about: three indices of a byte and three vertices of 80 bits."""

BLOCK_BITS = 0xFFFFFF


class PackedScene(NamedTuple):
    """The sections of a scene file as arrays on a device.

    Attributes:
        nodes: (m, 16) uint32, SPEC 4.4.
        planes: (m, 8, 8) uint8, the same bytes: on a CPU the same memory, on a GPU an array of its own.
        slots: (m, 8) uint32, of each node's children, as `kernels.packed_hits.describe_slots` writes them.
        blocks: (b, 16) uint32, as `kernels.packed_hits.describe_blocks` writes them.
        words: (w,) uint32, the streams, and zeros behind them that a load may touch.
        faces: (n,) int32, the reported face of each triangle in file order; (0,) where they are their own.
        frame: How rays are seen: boxes are counted from the grid's low, in its cells.
    """

    nodes: Any
    planes: Any
    slots: Any
    blocks: Any
    words: Any
    faces: Any
    frame: Frame

    @property
    def width(self) -> int:
        """Children of a node."""
        return WIDTH

    @property
    def node_count(self) -> int:
        """Nodes, and those that fill up a size class."""
        return len(self.nodes)

    @property
    def has_faces(self) -> bool:
        """Whether there is a remap."""
        return len(self.faces) > 0

    def lanes_met(self, node: Array, slab: Slab, limit: Array) -> Array:
        """(8,) bool: the node's children whose boxes the ray meets, from 0 to `limit`."""
        at = index(node)
        planes = self._planes_of(at)
        head = self._row(self.nodes, at, 0, 4)
        origins, shifts = self._grid(head)
        low, high = [], []
        for axis in range(3):
            origin, shift = origins[axis], shifts[axis]
            near, far = ((origin + (planes[row] << shift)).astype(jnp.float32) for row in (axis, axis + 3))
            low.append(near * slab.inverse[axis] - slab.low[axis])
            high.append(far * slab.inverse[axis] - slab.high[axis])
        return passes(low, high, limit) & (planes[0] <= planes[3])

    def boxes_of(self, node: Array) -> Array:
        """(6, 8) float32: the boxes of a node's children, scaled and rounded; NaN in empty lanes."""
        at = index(node)
        planes = self._planes_of(at)
        origins, shifts = (jnp.stack(each) for each in self._grid(self._row(self.nodes, at, 0, 4)))
        cells = origins[:, None] + (planes.reshape(2, 3, LANES) << shifts[:, None])
        boxes = cells.astype(jnp.float32) * self.frame.unit[:, None] + self.frame.low[:, None]
        return jnp.where(planes[0] <= planes[3], boxes.reshape(6, LANES), jnp.float32(jnp.nan))

    def sides_of(self, node: Array, rows: tuple[Array, ...]) -> list[Array]:
        """Sides of a node's boxes, scaled and rounded; not a number where there is none."""
        planes = [self._planes(node, row, jnp.uint32(0), LANES) for row in rows]
        sides = self._sides(node, rows, planes)
        sides[0] = jnp.where(planes[0] <= planes[1], sides[0], jnp.float32(jnp.nan))
        return sides

    def sides_in(self, node: Array, rows: tuple[Array, ...], lane: Array) -> list[Array]:
        """Sides of the box in one lane."""
        return self._sides(node, rows, [self._planes(node, row, lane, 1)[0] for row in rows])

    def _planes(self, node: Array, row: Array, lane: Array, count: int) -> Array:
        # Masks say what is known to be inside.
        at = (index(node), (row + 2) & 7, lane & 7)
        return lax.dynamic_slice(self.planes, at, (1, 1, count))[0, 0].astype(jnp.int32)

    def _sides(self, node: Array, rows: tuple[Array, ...], planes: list[Array]) -> list[Array]:
        """Where planes in rows lie, two of an axis at a time, scaled."""
        origins, shifts = self._grid(self._row(self.nodes, index(node), 0, 4))
        sides = []
        for k in range(0, len(rows), 2):
            axis = jnp.where(rows[k] >= 3, rows[k] - 3, rows[k])
            unit, low = (lax.dynamic_slice(a, (axis,), (1,))[0] for a in (self.frame.unit, self.frame.low))
            for each in planes[k : k + 2]:
                cells = pick(origins, axis) + (each << pick(shifts, axis))
                sides.append(cells.astype(jnp.float32) * unit + low)
        return sides

    def walk_packets(self, ready: Array, options: WalkOptions, live: Array | None = None) -> Traced:
        """Walk packets made ready."""
        return walk_packets(self, ready, options, live)

    def child_of(self, node: Array, lane: Array) -> Array:
        """The child in a lane; a leaf is -(8 node + slot + 1)."""
        said = self._row(self.slots, index(node), lane & 7, 1)[0].astype(jnp.int32)
        child = jnp.where(said < 0, (~(index(node) << 3 | (lane & 7))).astype(jnp.int32), said)
        # The bottom of a stack has a lane that no node has.
        return jnp.where(lane > 7, DONE, child)

    def find_leaf(self, child: Array) -> "_Run":
        """The run of a leaf; some run where the child is none."""
        code = index(~child)
        node = code >> 3
        block = self._row(self.nodes, node, 1, 1)[0] & BLOCK_BITS
        return _Run(block, self._row(self.slots, node, code & 7, 1)[0])

    def leaf_of(self, axes: tuple[Array, Array, Array], where: "_Run", decode: Decode | None) -> Leaf:
        """The triangles of a run, decoded, their corners along these axes."""
        assert decode is not None
        x, y, z = self._decoded(where, axes, decode)
        return Leaf(x, y, z, _first_corner_along(x, y, z, axes), *self._named(where))

    def leaf_for_packets(
        self, axes: tuple[Array, Array, Array], where: "_Run", decode: Decode | None
    ) -> Callable[[], Leaf]:
        """The same, decoded once: behind a cond, or XLA decodes it anew for every use."""
        assert decode is not None
        nothing = ((jnp.zeros(LANES),) * 3,) * 3
        # Always so, which XLA does not know.
        x, y, z = lax.cond(
            where.block <= BLOCK_BITS, lambda: self._decoded(where, axes, decode), lambda: nothing
        )
        turn = _first_corner_along(x, y, z, axes)
        return lambda: Leaf(x, y, z, turn, *self._named(where))

    def _named(self, where: "_Run") -> tuple[Array, Array]:
        """Which lanes hold a triangle of a run, and their names."""
        lane = self._lanes()
        return where.turns >> lane > 1, (where.block << 8 | (where.first + lane)).astype(jnp.int32)

    def _decoded(
        self, where: "_Run", axes: tuple[Array, Array, Array], decode: Decode
    ) -> tuple[Corners, Corners, Corners]:
        """Coordinates along axes of the corners a, b, c of a run's triangles, scaled."""
        block, along = self.block_along(where, axes)
        found = self._positions(block, self._corners(block, where, decode.flips), along, decode)
        x, y, z = ((a, b, c) for a, b, c in found)
        return x, y, z

    def block_along(self, where: "_Run", axes: tuple[Array, Array, Array]) -> tuple["_Block", list["_Axis"]]:
        """What is said of a run's block, and of its axes in this order."""
        along = [self._settled(self._row(self.blocks, where.block, axis * 4 & 12, 4)) for axis in axes]
        block = self._settled(self._row(self.blocks, where.block, HEAD, 4))
        return _Block(*block), [_Axis(*axis) for axis in along]

    def visit_leaf(self, ray: Sighted, where: "_Run", best: Best, options: WalkOptions) -> Best:
        """Decode the triangles of a run and test them, against the closest hit so far."""

        def decoded() -> Leaf:
            return self.leaf_of(ray.shear.axes, where, options.decode)

        # For any hit a leaf is cheaper tested at once than decoded twice.
        find = found_in if options.any_hit else sifted
        return find(decoded, ray, best, options, self.faces_of if self.has_faces else None)

    def triangles_of(self, where: "_Run") -> Array:
        """() int32: how many triangles a run has."""
        return (31 - _leading_zeros(where.turns)).astype(jnp.int32)

    def counters_of(self, nodes: Any, leaves: Any, triangles: Any) -> Counters:
        """A node is eight boxes and a slot; a leaf its run and block, indices and vertices: see the notes."""
        bytes_read = leaves * LEAF_BYTES + triangles * TRIANGLE_BYTES
        return Counters(nodes, leaves, nodes * 8, triangles, nodes * NODE_BYTES, bytes_read)

    def walk_rays(self, ready: Array, options: WalkOptions, live: Array | None = None) -> Traced:
        """Walk r rays made ready."""
        return walk_rays(self, ready, options, live)

    def faces_of(self, names: Array) -> Array:
        """The faces of hits; a name that is none keeps its number."""
        block, place = index(names) >> 8, index(names) & 0xFF
        triangle = self._at(self.blocks, (block, np.uint32(HEAD))) + place
        face = self._at(self.faces, triangle) if self.has_faces else triangle.astype(jnp.int32)
        return jnp.where(names < 0, names, face)

    def _grid(self, head: Any) -> tuple[Corners, Corners]:
        """Where planes are counted from and how far they are shifted, int32 along each axis."""
        x, y, z = (a.astype(jnp.int32) for a in (head[2] & 0xFFFF, head[2] >> 16, head[3] & 0xFFFF))
        along_x, along_y, along_z = (
            a.astype(jnp.int32) for a in (head[0] >> 28, head[3] >> 24 & 15, head[3] >> 28)
        )
        return (x, y, z), (along_x, along_y, along_z)

    # What follows says how arrays are read; the walk on a GPU reads them in its own way.

    def _lanes(self) -> Array:
        """The number of each lane, uint32."""
        return jnp.arange(LANES, dtype=jnp.uint32)

    def _at(self, values: Array, places: Any) -> Array:
        """Values at places, or at rows and columns, that are known to be inside."""
        return values.at[places].get(mode="promise_in_bounds")

    def _row(self, rows: Array, row: Array, first: Any, count: int) -> Any:
        """Some values of a row, one after the other."""
        return lax.dynamic_slice(rows, (row, jnp.asarray(first, jnp.uint32)), (1, count))[0]

    def _planes_of(self, node: Array) -> Any:
        """(6, 8) int32: the lanes' planes on each axis, low and high."""
        planes = lax.dynamic_slice(self.planes, (node, jnp.uint32(2), jnp.uint32(0)), (1, 6, LANES))[0]
        return planes.astype(jnp.int32)

    def _words_at(self, places: Array, count: int) -> list[Array]:
        """Words at places, at the places behind them, and so on: one gather, cheaper than several."""
        dimensions = lax.GatherDimensionNumbers(
            offset_dims=(0,), collapsed_slice_dims=(), start_index_map=(0,)
        )
        inside = lax.GatherScatterMode.PROMISE_IN_BOUNDS
        rows = lax.gather(self.words, places[:, None], dimensions, slice_sizes=(count,), mode=inside)
        return [rows[k] for k in range(count)]

    def _settled(self, values: Any) -> Any:
        """Values that are not computed again for each use."""
        return lax.optimization_barrier(values)

    def _corners(self, block: "_Block", run: "_Run", flips: bool) -> tuple[Array, Array, Array]:
        """The indices of corners a, b, c of a run's triangles, (8,) uint32 each."""
        lane = self._lanes()

        # The far corner is what the last other turn left behind.
        turned = (run.turns >> lane & 1) != 0
        other = jnp.where(turned, ~run.turns, run.turns) & ((np.uint32(2) << lane) - 1)
        last = 31 - _leading_zeros(other)

        indices, width, place = block.indices, block.index_width, run.place
        mask = (np.uint32(1) << width) - 1
        near = self._windows(block.word, indices + place * width, width * lane)
        far = self._windows(block.word, indices + place * width, width * jnp.where(other == 0, 0, last))
        before = self._windows(block.word, indices + (place - run.back) * width, np.uint32(0), 2)
        far = jnp.where(other == 0, before, far) & mask
        if flips:
            flipped = self._windows(block.word, 2 * block.triangles + run.first, lane, 3) & block.has_flips
            turned = turned ^ (flipped != 0)
        newest, near = near >> width & mask, near & mask
        return jnp.where(turned, far, near), jnp.where(turned, near, far), newest

    def _windows(self, word: Array, bit: Array, further: Any, count: int = 4) -> Array:
        """Uint32: 32 bits of a stream from `bit` plus each of `further` on, all of them in `count` words."""
        at = word + (bit >> 5)
        loaded = [self._at(self.words, at + k) for k in range(count)]
        bits = (bit & 31) + further
        place, shift = bits >> 5, bits & 31
        lower, upper = loaded[0], loaded[1]
        for k in range(1, count - 1):
            lower, upper = (
                jnp.where(place == k, loaded[k], lower),
                jnp.where(place == k, loaded[k + 1], upper),
            )
        return lower >> shift | upper << 1 << (31 - shift)

    def _positions(
        self, block: "_Block", corners: tuple[Array, ...], axes: list["_Axis"], decode: Decode
    ) -> list[list[Array]]:
        """Scaled coordinates of the corners along axes, (8,) float32 each."""
        found = []
        for corner in corners:
            bit = block.vertices + corner * block.stride
            shift = bit & 31
            loaded = [*self._words_at(block.word + (bit >> 5), decode.words), jnp.zeros_like(bit)]
            vertex = [a >> shift | b << 1 << (31 - shift) for a, b in pairwise(loaded)]
            found.append([_coordinate(vertex, axis, decode) for axis in axes])
        return [[vertex[axis] for vertex in found] for axis in range(3)]


class _Run(NamedTuple):
    """Where the triangles of a leaf are: () uint32 each.

    Attributes:
        block: The block.
        said: What `kernels.packed_hits.describe_slots` says of the run.
    """

    block: Array
    said: Array

    @property
    def first(self) -> Array:
        """The first triangle."""
        return self.said & 0xFF

    @property
    def place(self) -> Array:
        """Of its near corner among the block's indices."""
        return self.first + 2 * (self.said >> 8 & 0xFF) + 1

    @property
    def back(self) -> Array:
        """How far before that its far corner is."""
        return self.said >> 16 & 31

    @property
    def turns(self) -> Array:
        """Bits: of each triangle its turn, and a one behind the last."""
        return self.said >> 21 & 0x1FF


class _Block(NamedTuple):
    """What `kernels.packed_hits.describe_blocks` says of a block: () uint32 each."""

    first_triangle: Array
    word: Array
    counts: Array
    places: Array

    @property
    def triangles(self) -> Array:
        """How many."""
        return (self.counts & 0xFF) + 1

    @property
    def index_width(self) -> Array:
        """Bits of an index."""
        return self.counts >> 8 & 15

    @property
    def has_flips(self) -> Array:
        """One or zero."""
        return self.counts >> 12 & 1

    @property
    def vertices(self) -> Array:
        """The bit where they begin."""
        return self.counts >> 13

    @property
    def stride(self) -> Array:
        """Bits of a vertex."""
        return self.places & 127

    @property
    def indices(self) -> Array:
        """The bit where they begin."""
        return self.places >> 7


class _Axis(NamedTuple):
    """How a block's coordinates on an axis are written: () uint32 each."""

    anchor: Array
    mask: Array
    power: Array
    rest: Array

    @property
    def offset(self) -> Array:
        """The first bit in a vertex."""
        return self.rest & 127

    @property
    def mode(self) -> Array:
        """0 to 2."""
        return self.rest >> 7 & 3

    @property
    def exponent(self) -> Array:
        """Of the scaled coordinates, or of the scale in mode 2: int32."""
        return (self.rest >> 9 & 1023).astype(jnp.int32) - BIAS

    @property
    def unit(self) -> Array:
        """Two to its power, where that is normal."""
        return lax.bitcast_convert_type(self.power, jnp.float32)


def _coordinate(vertex: list[Array], axis: _Axis, decode: Decode) -> Array:
    """One scaled coordinate of (8,) vertices, from the words that they begin."""
    place, shift = axis.offset >> 5, axis.offset & 31
    padded = [*vertex, jnp.zeros_like(vertex[0])]
    lower, upper = padded[0], padded[1]
    for k in range(1, min(3, len(vertex))):
        lower, upper = jnp.where(place == k, padded[k], lower), jnp.where(place == k, padded[k + 1], upper)
    number = (lower >> shift | upper << 1 << (31 - shift)) & axis.mask
    whole = (axis.anchor + number).astype(jnp.int32)
    value = whole.astype(jnp.float32)
    if decode.minus_zero:
        value = jnp.where((axis.mode == 1) & (number == axis.mask), np.float32(0), value)
    if decode.tiny:
        value = _scaled(value, axis.exponent)
        return jnp.where(axis.mode == 2, _from_bits(whole, axis.exponent), value)
    if decode.as_bits:
        bits = whole ^ (whole >> 31 & 0x7FFFFFFF)
        value = jnp.where(axis.mode == 2, lax.bitcast_convert_type(bits, jnp.float32), value)
    return value * axis.unit


def _from_bits(whole: Array, scale_exponent: Array) -> Array:
    """Scaled coordinates of mode 2, by their integers: a denormal must not be read as a float."""
    bits = jnp.where(whole < 0, ~whole, whole)
    normal = bits >= 0x800000
    exponent = jnp.where(normal, bits >> 23, 1) - 150 + scale_exponent
    mantissa = jnp.where(normal, bits & 0x7FFFFF | 0x800000, bits).astype(jnp.float32)
    value = _scaled(mantissa, exponent)
    return jnp.where(whole < 0, -value, value)


def _scaled(number: Array, exponent: Array) -> Array:
    """A number times a power of two, in two steps since one may be out of range; zero where denormal."""
    first = jnp.clip(exponent, -126, 127)
    value = number * power_of_two(first) * power_of_two(jnp.clip(exponent - first, -126, 127))
    return jnp.where(jnp.abs(value) < np.finfo(np.float32).tiny, np.float32(0), value)


def first_corner(x: list[Array], y: list[Array], z: list[Array]) -> Array:
    """Which corner is the least by (x, y, z), the first of equals: as `kernels.wide.first_corner` has it."""

    def before(i: int, j: int) -> Array:
        tail = (y[i] < y[j]) | ((y[i] == y[j]) & (z[i] < z[j]))
        return (x[i] < x[j]) | ((x[i] == x[j]) & tail)

    return _first_by(before)


def _first_corner_along(x: Corners, y: Corners, z: Corners, axes: tuple[Array, Array, Array]) -> Array:
    """The same, of coordinates along axes: those along x weigh more than those along y and z together."""
    weights = [jnp.where(axis == 0, 4, jnp.where(axis == 1, 2, 1)).astype(jnp.float32) for axis in axes]

    def before(i: int, j: int) -> Array:
        total = jnp.float32(0)
        for along, weight in zip((x, y, z), weights, strict=True):
            side = jnp.where(along[i] > along[j], weight, np.float32(0))
            total = total + jnp.where(along[i] < along[j], -weight, side)
        return total < 0

    return _first_by(before)


def _first_by(before: Callable[[int, int], Array]) -> Array:
    """Which corner is the first, by what says whether one comes before another."""
    last = jnp.where(before(1, 0), before(2, 1), before(2, 0))
    return jnp.where(last, 2, jnp.where(before(1, 0), 1, 0))


def _leading_zeros(a: Array) -> Array:
    """Of uint32, by way of int32: Triton counts those of no others."""
    return lax.clz(a.astype(jnp.int32)).astype(jnp.uint32)


def power_of_two(exponent: Array) -> Array:
    """2**exponent, exponent (int32) from -126 to 127."""
    return lax.bitcast_convert_type((exponent + 127) << 23, jnp.float32)


def used_bytes(low: Array, high: Array) -> Array:
    """The top bit of each byte but of those where low is 1 and high is 0: four slots that are not empty."""
    other = (low ^ 0x01010101) | high
    return ((other & 0x7F7F7F7F) + 0x7F7F7F7F | other) & np.uint32(0x80808080)


# Notes
#
# Stanford dragon, one thread, a machine with other work; rays a second over those of the expanded walk,
# ratios of processor time: camera in packets 0.68-0.71, one by one 0.66-0.68, occlusion closest 0.69-0.74,
# any hit 0.71-0.73; bunny 0.66, 0.62, 0.62, 0.59. Without a remap 0.02 more. What gave most, in the order it
# was done: words selected from a few loaded scalars instead of gathers, and runs that say where corners are;
# one gather of rows of words (0.03); the remap read for ties alone, hits merged under a cond of their own
# (0.07 to 0.1); the run found before rays part, where its loads overlap (0.02 to 0.04); in packets axes
# chosen before the coordinates are decoded, not after (0.04): a choice of lanes by one number ends as
# scalars. Nodes alone, over expanded leaves, take 0.80-0.83 / 0.86 / 0.87-0.9 (camera, occlusion, any hit).
#
# Where the time goes (camera rays from the picture's middle): the expanded walk takes 255 of 348 ns, 54 % of
# it in the node loop; this one 437 of 564, 39 %. So nodes cost 32 ns more, leaves 150, weights of hits 30.
#
# Ratios of speed to what stands here, on a busy machine. Lost: ten vertices of a strip decoded once, the far
# corners gathered from them, 0.92 (2100 instructions fewer, but through memory), with a concatenation 0.57;
# both rays' leaves at once under vmap 0.82, one after the other without a cond 0.85; near and far planes
# chosen by the direction's signs in the loop 0.92; words selected for each coordinate 1.0; the closest hits
# marked by their sign behind one barrier 0.89 (of the expanded walk too); faces carried along 0.92. No gain:
# the closest hit by the least integer, any lane by a sum of integers, one count of bits in the place of two,
# fewer words of a record read, hits weighed in two passes of 64. Three words a vertex in the place of the
# four that the widest blocks need would give 1.02.
#
# In packets: 0.48-0.50 of expanded packets when they came, the run found once 0.56, the header too 0.585, a
# node's grid read once an axis 0.60, leaves that no ray of the packet meets left unread 0.62 (of the dragon's
# 18 leaves a packet one in five). Bunny 0.49 to 0.54. One by one the run found once is 1.00 to 1.02, the
# header too 0.97: there latency counts, and what is kept goes through memory.
#
# XLA compiles each of the nine coordinates of a leaf on its own, with all that leads to it; LLVM unrolls a
# loop of eight that is short before it makes vectors of it, so that short ones end as scalars and recomputing
# is often the faster. Of what was tried in packets / one by one against the run and header found once, lost:
# corner indices kept by a division by ones 0.97-1.03 / 0.95; their bits shifted into rows of a small array
# 0.86 / 0.78; three corners as 24 lanes 0.90 / 0.70, ten vertices as 16 lanes with far corners gathered 0.92,
# all as one (3, 3, 8) array behind two conds 0.87 / 0.56; coordinates cut straight from the four words 0.98,
# modes blended by masks 0.99. A cache of 64 to 4096 leaves decoded lately, filled in a loop of one turn: 0.55
# to 1.0 in packets (nearly half of the visits miss in 1024 leaves) and 0.90 one by one: looking is as dear as
# decoding.
#
# Found before rays part, lost: the header with the run 0.98 to 1.0, the words of the corners' indices too
# 0.97, a word of the first vertex touched 0.97. In packets the header with the run 1.0, indices 1.0. A leaf's
# box tested again before it is decoded (one by one): 0.96 to 0.98. One by one, axes chosen before decoding:
# 0.96. The chosen lanes blended by masks: 0.94 in packets. Corners put in their order behind a second cond:
# 0.97. Each cond costs: indices behind one, words behind another, coordinates behind a third 0.86.
#
# Leaves sifted, and decoded again where something may be nearer: occlusion closest 1.04 to 1.08, random rays
# 1.03 (dragon) and 0.94 (bunny), a camera's rays one by one 0.87 to 0.9, since every other leaf of theirs is
# hit; any hit 0.97 to 1.0, for which nothing is sifted. The decoded leaf kept for the cond 0.55; only the
# lanes that may be nearer decoded again, one by one, 0.95 of sifting.
#
# Runs and headers worked out beforehand, axes read in a ray's order from rows of four words: a leaf's way
# takes 590 instructions for 670, its finding and leaving 197 for 357, two rays' nodes 374 for 407. Camera in
# packets 1.05 to 1.09, one by one 1.08 to 1.18, occlusion 1.08 to 1.17, any hit 1.0 to 1.05 (bunny, dragon).
# In packets ties told apart without flags that are kept, 1.06 more: a ray that has hit nothing was tied with
# each triangle that it missed, both infinitely far, and LLVM makes single steps of sums of 32 flags and of
# short loops over 32 lanes.
#
# Where the time goes then (dragon, occlusion): nodes 38 %, 12.4 a ray at 30 ns; leaves 39 %, 3.0 a ray at 125
# ns, of which a sixth waits for memory and most is put together lane by lane (96 words, for which XLA uses no
# gather); finding and leaving them 7 %. No gain: words gathered as rows of four 1.0; no barriers 0.95 to
# 1.03; any hit sifted 0.99 to 1.03; words of indices in one slice and products of small numbers 1.0; four
# rays side by side 0.91 to 1.0, one 0.83 to 0.94; LLVM told not to unroll 0.91 to 1.0, not to make branches
# of selects 0.96 to 1.0 (all of `xla_backend_extra_options` with a dash in front).
