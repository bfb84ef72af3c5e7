"""A scene of packed blocks, as the walk sees it: nodes, headers, bit streams and runs as a scene file has them.

Nodes follow Ylitie, Karras & Laine, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs"
(HPG 2017), leaves Lauterbach et al., ReduceM (EGSR 2008): a leaf is up to eight triangles of a strip, decoded
where they are tested. What the bits mean is SPEC 4.2 to 4.5. Hits are those of `walk_wide`, bit for bit: the
same corners, scaled by the same power of two, in the same test.

Differences:

1. A leaf is named by its node and slot, and its run is counted when it is visited.
2. What no block of the scene needs is not compiled in (`walk.Decode`).
3. Corners are not put in the canonical order; only the sums are made in it (`triangle.crossing_of`).

**Boxes.** With L the grid's low and c its cell on an axis, scaled, a plane K = origin + (q << shift) is at L +
cK exactly. Of a ray at o with (rounded) inverse direction v the distance to it, with margin m, is computed as

    q * (cv << shift) + (origin * cv - ((o + m) - L) * v),   cv exact, c and << shift powers of two.

In units of position, with u = 2^-24 and M the largest of |o| and the scene's coordinates, rounding o + m and
taking L away and multiplying by v moves it by at most u (M + 2 * 2M); the product and the sum with origin by
u (2M + 2M), half of it where they are fused; the product with q by u 2M, none of it where fused. The last sum
is relative to the distance itself, which `box.FAR_FACTOR` allows for. That is 11 uM, and the triangle test
needs 6 uM more (`box`, difference 2): `MARGIN` is 32 uM, a power of two. A cell that would be denormal counts as zero: its planes
move by less than 2^-100.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from striptools.trace.box import Slab, passes
from striptools.trace.numerics import folded, index, larger
from striptools.trace.triangle import Shear, crossing_of, edges_of, pick
from striptools.trace.walk import DONE, WIDTH, Best, Decode, Frame, WalkOptions, closer_of

MARGIN = np.float32(2.0**-19)
"""Widening of a box in units of the largest coordinate of ray origin and scene."""

LANES = 8
BLOCK_BITS = 0xFFFFFF
SLACK_WORDS = 16
"""Words behind the stream that a load may touch."""


class PackedScene(NamedTuple):
    """The sections of a scene file as arrays on a device, padded so that scenes of like size share a program.

    Attributes:
        nodes: (m, 16) uint32, SPEC 4.4, but that bits 24 to 31 of the word `leaves` of a node over blocks say
            which slots are leaves. The last node is none.
        planes: (m, 64) uint8, the same memory.
        headers: (b, 8) uint32, SPEC 4.2.
        words: (w,) uint32, the streams, `SLACK_WORDS` and more behind them.
        first_run: (b,) uint32.
        runs: (r,) uint16.
        faces: (n + 8,) int32, the reported face of each triangle in file order; (0,) where they are their own.
        top_count: () uint32, nodes over blocks.
        scale_exponent: () int32, of the frame's scale.
        frame: How rays are seen: boxes are counted from the grid's low, in its cells.
    """

    nodes: Any
    planes: Any
    headers: Any
    words: Any
    first_run: Any
    runs: Any
    faces: Any
    top_count: Any
    scale_exponent: Any
    frame: Frame

    @property
    def node_count(self) -> int:
        """Nodes and those that fill up the size class."""
        return len(self.nodes)

    @property
    def has_faces(self) -> bool:
        """Whether there is a remap."""
        return len(self.faces) > 0

    def lanes_met(self, node: Array, slab: Slab, limit: Array) -> Array:
        """(8,) bool: the node's children whose boxes the ray meets, from 0 to `limit`."""
        at = index(node)
        planes = lax.dynamic_slice(self.planes, (at, jnp.uint32(16)), (1, 48))[0].reshape(6, LANES)
        planes = planes.astype(jnp.int32).astype(jnp.float32)
        head = lax.dynamic_slice(self.nodes, (at, jnp.uint32(0)), (1, 4))[0]
        origins = head[2] & 0xFFFF, head[2] >> 16, head[3] & 0xFFFF
        shifts = head[0] >> 28, head[3] >> 24 & 15, head[3] >> 28
        low, high = [], []
        for axis in range(3):
            start = _number(origins[axis]) * slab.inverse[axis]
            step = slab.inverse[axis] * _power_of_two(shifts[axis].astype(jnp.int32))
            low.append(planes[axis] * step + (start - slab.low[axis]))
            high.append(planes[axis + 3] * step + (start - slab.high[axis]))
        return passes(low, high, limit) & (planes[0] <= planes[3])

    def child_of(self, node: Array, lane: Array) -> Array:
        """The child in a lane; a leaf is -(8 node + slot + 1)."""
        head = lax.dynamic_slice(self.nodes, (index(node), jnp.uint32(0)), (1, 4))[0]
        bit = jnp.uint32(1) << (lane & 7)
        inner, leaves = head[3] >> 16 & 0xFF, head[1] >> 24
        below = bit - 1
        as_node = (head[0] & 0xFFFFFFF) + lax.population_count(inner & below)
        as_block = self.top_count + (head[1] & BLOCK_BITS) + lax.population_count(leaves & below)
        as_run = ~(index(node) << 3 | (lane & 7))
        child = jnp.where(index(node) < self.top_count, as_block, as_run)
        child = jnp.where((inner & bit) != 0, as_node, child).astype(jnp.int32)
        # The bottom of a stack has a lane that no node has.
        return jnp.where(_at_bottom(node, self.node_count), DONE, child)

    def visit_leaf(self, shear: Shear, child: Array, best: Best, options: WalkOptions) -> Best:
        """Decode the triangles of a run and test them, each lane against its own closest hit."""
        assert options.decode is not None
        block, bits = self._run_of(child)
        header = lax.dynamic_slice(self.headers, (block, jnp.uint32(0)), (1, 8))[0]
        first = bits & 0xFF
        lane = jnp.arange(LANES, dtype=jnp.uint32)
        corners = self._corners(header, first, first + lane, options.decode.flips)
        x, y, z = self._positions(header, corners, options.decode)
        turn = _first_corner(x, y, z)
        along = [tuple(pick(triple, axis) for triple in zip(x, y, z, strict=True)) for axis in shear.axes]
        t = crossing_of(edges_of(*along, shear), turn)
        t = jnp.where(lane <= bits >> 8, t, jnp.float32(0))
        triangle = (header[0] + first + lane).astype(jnp.int32)
        face = triangle
        if self.has_faces:
            face = lax.dynamic_slice(self.faces, (header[0] + first,), (LANES,))
        return closer_of(best, t, face, triangle)

    def _run_of(self, child: Array) -> tuple[Array, Array]:
        """The block of a leaf, and the bits of its run."""
        code = index(~child)
        node, slot = code >> 3, code & 7
        head = lax.dynamic_slice(self.nodes, (node, jnp.uint32(0)), (1, 4))[0]
        low = lax.dynamic_slice(self.planes, (node, jnp.uint32(16)), (1, LANES))[0]
        high = lax.dynamic_slice(self.planes, (node, jnp.uint32(40)), (1, LANES))[0]
        lane = jnp.arange(LANES, dtype=jnp.uint32)
        is_leaf = (low <= high) & ((head[3] >> 16 >> lane & 1) == 0) & (lane < slot)
        rank = folded(jnp.where(is_leaf, jnp.uint32(1), jnp.uint32(0)), jnp.add)
        block = head[1] & BLOCK_BITS
        run = _at(self.first_run, block) + (head[1] >> 24) + rank
        return block, _at(self.runs, run).astype(jnp.uint32)

    def _corners(self, header: Array, first: Array, t: Array, flips: bool) -> tuple[Array, Array, Array]:
        """The indices of corners a, b, c of the triangles t (8,) of a block, all in the strip of `first`."""
        word, counts = header[1], header[2]
        triangles, has_flips = (counts & 0xFF) + 1, counts >> 24 & 1
        strip, strip_first = self._strip_of(word, first)
        before = self._window(word, (triangles + t).astype(jnp.int32) - 31)

        # The far corner is what the last other turn left behind; a strip's first triangle is like a turn of 1.
        is_first = t == strip_first
        turned = (before >> 31 != 0) | is_first
        other = jnp.where(turned, ~before, before)
        last = t.astype(jnp.int32) - lax.clz(other).astype(jnp.int32)
        left = strip_first.astype(jnp.int32)
        start = jnp.where(turned, left, left + 1)
        far = jnp.where((last > left) & ~is_first, last + 1, start).astype(jnp.uint32) + 2 * strip

        width = 32 - lax.clz(counts >> 8 & 0xFF)
        mask = (jnp.uint32(1) << width) - 1
        indices = (2 + has_flips) * triangles
        near = self._window(word, (indices + (t + 2 * strip + 1) * width).astype(jnp.int32))
        distant = self._window(word, (indices + far * width).astype(jnp.int32)) & mask
        swapped = turned
        if flips:
            flipped = self._window(word, (2 * triangles + t).astype(jnp.int32)) & has_flips
            swapped = turned ^ (flipped != 0)
        newest, near = near >> width & mask, near & mask
        return jnp.where(swapped, distant, near), jnp.where(swapped, near, distant), newest

    def _strip_of(self, word: Array, triangle: Array) -> tuple[Array, Array]:
        """Which strip of its block a triangle is in, and the strip's first triangle."""
        starts = lax.dynamic_slice(self.words, (word,), (LANES,))
        first = jnp.arange(LANES, dtype=jnp.uint32) * 32
        kept = triangle + 1 - first
        mask = jnp.where(kept < 32, (jnp.uint32(1) << (kept & 31)) - 1, jnp.uint32(0xFFFFFFFF))
        starts = starts & jnp.where(first <= triangle, mask, 0)
        strip = folded(lax.population_count(starts), jnp.add) - 1
        last = first + 31 - lax.clz(starts)
        return strip, folded(jnp.where(starts != 0, last, 0), larger)

    def _window(self, word: Array, bit: Array) -> Array:
        """(8,) uint32: 32 bits of a stream from each of (8,) int32 bits on."""
        at = word + (bit >> 5).astype(jnp.uint32)
        shift = (bit & 31).astype(jnp.uint32)
        return _at(self.words, at) >> shift | _at(self.words, at + 1) << 1 << (31 - shift)

    def _positions(
        self, header: Array, corners: tuple[Array, Array, Array], decode: Decode
    ) -> list[list[Array]]:
        """Scaled coordinates x, y, z of the corners, (8,) float32 each."""
        counts = header[2]
        triangles, strips, has_flips = (counts & 0xFF) + 1, (counts >> 16 & 0xFF) + 1, counts >> 24 & 1
        index_width = 32 - lax.clz(counts >> 8 & 0xFF)
        vertices = (2 + has_flips) * triangles + (triangles + 2 * strips) * index_width
        axes = _axes(header, self.scale_exponent)
        stride = axes[0].width + axes[1].width + axes[2].width
        found = []
        for corner in corners:
            bit = vertices + corner * stride
            at, shift = header[1] + (bit >> 5), bit & 31
            loaded = [_at(self.words, at + k) for k in range(decode.words)] + [jnp.zeros_like(at)]
            vertex = [
                a >> shift | b << 1 << (31 - shift) for a, b in zip(loaded[:-1], loaded[1:], strict=True)
            ]
            found.append([_coordinate(vertex, axis, decode) for axis in axes])
        return [[vertex[axis] for vertex in found] for axis in range(3)]


class _Axis(NamedTuple):
    """How a block's coordinates on an axis are written: () each."""

    offset: Array
    width: Array
    mode: Array
    anchor: Array
    exponent: Array
    scale_exponent: Array


def _axes(header: Array, scale_exponent: Array) -> list[_Axis]:
    """The three axes of a block; the exponent is that of the scaled coordinates."""
    described = header[6], header[6] >> 8, header[6] >> 16
    exponents = header[6] >> 24, header[7] & 0xFF, header[7] >> 8 & 0xFF
    axes = []
    offset = jnp.uint32(0)
    for axis in range(3):
        width, mode = described[axis] & 63, described[axis] >> 6 & 3
        exponent = exponents[axis].astype(jnp.int32) - 149 + scale_exponent
        axes.append(_Axis(offset, width, mode, header[3 + axis], exponent, scale_exponent))
        offset = offset + width
    return axes


def _coordinate(vertex: list[Array], axis: _Axis, decode: Decode) -> Array:
    """One scaled coordinate of (8,) vertices, from the words that they begin."""
    place, shift = axis.offset >> 5, axis.offset & 31
    padded = [*vertex, jnp.zeros_like(vertex[0])]
    lower, upper = padded[0], padded[1]
    for k in range(1, min(3, len(vertex))):
        lower, upper = jnp.where(place == k, padded[k], lower), jnp.where(place == k, padded[k + 1], upper)
    mask = jnp.where(axis.width == 0, jnp.uint32(0), jnp.uint32(0xFFFFFFFF) >> (32 - axis.width & 31))
    number = (lower >> shift | upper << 1 << (31 - shift)) & mask
    whole = (axis.anchor + number).astype(jnp.int32)
    value = _scaled(whole.astype(jnp.float32), axis.exponent, decode)
    if decode.minus_zero:
        value = jnp.where((axis.mode == 1) & (number == mask), jnp.float32(0), value)
    if decode.as_bits:
        value = jnp.where(axis.mode == 2, _from_bits(whole, axis.scale_exponent, decode), value)
    return value


def _from_bits(whole: Array, scale_exponent: Array, decode: Decode) -> Array:
    """Scaled coordinates of mode 2."""
    bits = jnp.where(whole < 0, whole ^ 0x7FFFFFFF, whole)
    size = bits & 0x7FFFFFFF
    if not decode.tiny:
        return lax.bitcast_convert_type(bits, jnp.float32) * _power_of_two(scale_exponent)
    # A denormal must not be read as a float: what it is scaled to need not be one.
    normal = size >= 0x800000
    exponent = jnp.where(normal, size >> 23, 1) - 150 + scale_exponent
    mantissa = jnp.where(normal, size & 0x7FFFFF | 0x800000, size).astype(jnp.float32)
    value = _scaled(mantissa, exponent, decode)
    return jnp.where(bits < 0, -value, value)


def _scaled(number: Array, exponent: Array, decode: Decode) -> Array:
    """A number times a power of two, zero where that is denormal."""
    if not decode.tiny:
        return number * _power_of_two(exponent)
    first = jnp.clip(exponent, -126, 127)
    value = number * _power_of_two(first) * _power_of_two(jnp.clip(exponent - first, -126, 127))
    return jnp.where(jnp.abs(value) < np.finfo(np.float32).tiny, jnp.float32(0), value)


def _first_corner(x: list[Array], y: list[Array], z: list[Array]) -> Array:
    """Which corner is the least by (x, y, z), the first of equals, as `kernels.wide.fill_leaf_blocks` has it."""

    def before(i: int, j: int) -> Array:
        tail = (y[i] < y[j]) | ((y[i] == y[j]) & (z[i] < z[j]))
        return (x[i] < x[j]) | ((x[i] == x[j]) & tail)

    last = jnp.where(before(1, 0), before(2, 1), before(2, 0))
    return jnp.where(last, 2, jnp.where(before(1, 0), 1, 0))


def _number(a: Array) -> Array:
    """A small unsigned integer as float32, by way of int32: one instruction."""
    return a.astype(jnp.int32).astype(jnp.float32)


def _power_of_two(exponent: Array) -> Array:
    """2**exponent, exponent (int32) from -126 to 127."""
    return lax.bitcast_convert_type((exponent + 127) << 23, jnp.float32)


def _at(values: Array, places: Array) -> Array:
    """Values at places that are known to be inside."""
    return values.at[places].get(mode="promise_in_bounds")


def _at_bottom(node: Array, count: int) -> Array:
    """Whether a node is the one that lies at the bottom of each stack."""
    return index(node) == count - 1
