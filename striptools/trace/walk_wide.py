"""A scene of float32 boxes and corners, as the walk sees it: expanded, the fastest and the largest."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from striptools.trace.box import Slab, lanes_met
from striptools.trace.counters import Counters
from striptools.trace.leaf_blocks import leaf_in, triangles_in
from striptools.trace.numerics import index
from striptools.trace.walk import (
    Best,
    Decode,
    Frame,
    Leaf,
    Sighted,
    Traced,
    WalkOptions,
    sifted,
    walk_rays,
)
from striptools.trace.walk_packets import walk_packets


class WideScene(NamedTuple):
    """A scene as arrays on a device; sizes are padded so that scenes of like size share a compiled program.

    Attributes:
        nodes: (w, 7, k) float32, k 8 or 16, six rows of boxes, NaN in empty lanes, then the bits of the
            children (int32, as in `WideTree`, `DONE` in empty lanes). The last node has no children.
        blocks: (l, 10, 8) float32, of each leaf's triangles by lane: x of corners a, b, c, then y, then z,
            NaN in empty lanes; then the bits of their faces (int32). A leaf is 320 bytes in a row.
        frame: How rays are seen: boxes are counted from zero, in ones.
    """

    nodes: Any
    blocks: Any
    frame: Frame

    @property
    def node_count(self) -> int:
        """Nodes and those that fill up the size class."""
        return len(self.nodes)

    @property
    def width(self) -> int:
        """Children of a node."""
        return self.nodes.shape[-1]

    @property
    def has_faces(self) -> bool:
        """The way from a face to its triangle is on the host."""
        return False

    def faces_of(self, names: Array) -> Array:
        """Names are faces."""
        return names

    def lanes_met(self, node: Array, slab: Slab, limit: Array) -> Array:
        """(k,) bool: the node's children whose boxes the ray meets, from 0 to `limit`."""
        return lanes_met(self.boxes_of(node), slab, limit)

    def boxes_of(self, node: Array) -> Array:
        """(6, k) float32: the boxes of a node's children, scaled; NaN in empty lanes."""
        at = (index(node), jnp.uint32(0), jnp.uint32(0))
        return lax.dynamic_slice(self.nodes, at, (1, 6, self.width))[0]

    def child_of(self, node: Array, lane: Array) -> Array:
        """The child in a lane; leaf q is -(q + 1)."""
        # What is known to be a lane is not compared with the number of lanes.
        at = index(node), jnp.uint32(6), lane & (self.width - 1)
        bits = lax.dynamic_slice(self.nodes, at, (1, 1, 1))[0, 0, 0]
        return lax.bitcast_convert_type(bits, jnp.int32)

    def find_leaf(self, child: Array) -> Array:
        """The block of a leaf."""
        return index(-(child + 1))

    def visit_leaf(self, ray: Sighted, where: Array, best: Best, options: WalkOptions) -> Best:
        """Test the triangles of a leaf, against the closest hit so far."""

        def at_hand() -> Leaf:
            return leaf_in(self.blocks, where, ray.shear.axes)

        return sifted(at_hand, ray, best, options)

    def leaf_of(self, axes: tuple[Array, Array, Array], where: Array, decode: Decode | None) -> Leaf:
        """The triangles of a leaf, their corners along these axes."""
        return leaf_in(self.blocks, where, axes)

    def leaf_for_packets(
        self, axes: tuple[Array, Array, Array], where: Array, decode: Decode | None
    ) -> Callable[[], Leaf]:
        """The same, read wherever it is used: nothing is decoded, and a copy costs as much as a test."""
        return lambda: self.leaf_of(axes, where, decode)

    def sides_of(self, node: Array, rows: tuple[Array, ...]) -> list[Array]:
        """Sides of a node's boxes."""
        at = index(node)
        sides = [lax.dynamic_slice(self.nodes, (at, row, jnp.uint32(0)), (1, 1, self.width)) for row in rows]
        return [side[0, 0] for side in sides]

    def sides_in(self, node: Array, rows: tuple[Array, ...], lane: Array) -> list[Array]:
        """Sides of the box in one lane."""
        return [lax.dynamic_slice(self.nodes, (index(node), row, lane), (1, 1, 1))[0, 0, 0] for row in rows]

    def walk_packets(self, ready: Array, options: WalkOptions, live: Array | None = None) -> Traced:
        """Walk packets made ready."""
        return walk_packets(self, ready, options, live)

    def triangles_of(self, where: Array) -> Array:
        """() int32: how many triangles a leaf has."""
        return triangles_in(self.blocks, where)

    def counters_of(self, nodes: Any, leaves: Any, triangles: Any) -> Counters:
        """A box is 28 bytes with its child, a leaf 320."""
        boxes = nodes * self.width
        return Counters(nodes, leaves, boxes, triangles, boxes * 28, leaves * 320)

    def walk_rays(self, ready: Array, options: WalkOptions, live: Array | None = None) -> Traced:
        """Walk r rays made ready."""
        return walk_rays(self, ready, options, live)


# Notes
#
# Tried on the dragon's strip hierarchy, one thread, Zen 4, and lost (time against what stands here): leaf
# test without lax.cond 1.09; four rays side by side 1.05 to 1.2, one 1.1; the node and its lanes always
# read back from the stack, to have no branch on "is anything left" 1.1 to 1.2 (the branch lets the
# processor guess the next node); u and v inside the walk 1.3; rays as (o, d) prepared inside the walk 1.05;
# boxes and leaves in huge pages 1.0. The in-strip hierarchy split by SAH instead of halved lowers the
# expected cost by 3 %, a new SAH hierarchy over the leaves by 10 %: neither is what the scene file holds. A
# new hierarchy over single triangles ("rebuilt") is walked in 0.91 to 0.95 of the time.
#
# Of a dragon's camera rays 44 % meet no child of the root. They are dropped where rays are made ready, in
# 28 ns; as a walk of their own they took 70 to 90. A first form of that kernel with arrays of three in the
# place of scalars took 43.
#
# Tried on rebuilt hierarchies and lost, or no gain: a leaf cost of 0.6, 1.5 and 2.5 node costs 1.0; splits
# by 32 bins and sweeps below 64 triangles 1.02 (camera) and 0.94 (occlusion), within the noise; occlusion
# rays sorted by octant in runs of 1024 or 65536 1.08, by octant and longest axis 1.1; runs of 4096 1.0;
# tiles of 2**14 to 2**18 rays 1.0.
#
# Where the time of occlusion rays goes (rebuilt, dragon; sampled): nodes 45 %, leaves 40 %, of which half
# waits for a leaf's first cache line. Leaf lines touched before the other ray's leaf is tested: 1.01 / 1.03
# / 1.015 (camera, occlusion closest, any hit), too little for what it looks like; touched in the node loop
# 0.96; the next node touched before the leaf 1.0. Rays that take the next one's place as soon as they end,
# two to four in one loop over all rays: 0.87 to 0.99, though two by two a fifth of all steps is waiting.
# Nodes visited until all rays are at leaves, in the place of until one is: 0.95 to 1.0 on a camera's rays,
# 0.98 to 1.02 on others. Four rays side by side with that 0.89 to 0.99. One number and one name for the
# closest hit, in the place of eight lanes: 244 instructions a leaf for 437, and the same time.
#
# Sixteen children in the place of eight (rebuilt; dragon, dragon_3m5, power plant): 0.73 to 0.75 of the
# nodes, and rates of 1.03 to 1.09 (camera, one by one), 1.07 to 1.12 (occlusion), 1.09 to 1.11 (any hit),
# 1.08 to 1.10 (random rays), 1.0 (packets). Lane bits have to come from a table: shifted by an octant they
# compile to sixteen scalar shifts a ray, 3 %. No gain over that: the fourth bit along y, z, (1, 1, 1), or
# four diagonals for four axes; children exchanged after the greedy choice of lanes; a node cost of 1.4;
# registers of 512 bits. With one ray 0.87 to 1.0 of two, with four 0.96.
#
# Not worth a stack that holds distances, counted: children left out when they are farther than a hit found
# since save 5 % of the nodes of occlusion rays, 13 % of a camera's one by one; children sorted by distance
# 10 % and 20 %, and any hit then visits 4 % more.
#
# Any hit that visits what is far first: occlusion rays of scans meet 3 to 5 % fewer nodes and 7 to 10 %
# fewer leaves (bunny, dragon), chords as many, and are traced 0.94 to 1.02 times as fast: what is near lies
# in the cache. The longest way through a box first would save 3 % more of both.
#
# Sifting leaves before hits are weighed (`walk.sifted`; rebuilt; bunny, dragon): occlusion closest 1.18,
# 1.13, any hit 1.05, 1.02, a camera's rays one by one 1.0, 1.02. With the division left to the cond, but
# its two numbers kept for it, 1.10; with edge functions alone 0.95; with the straddling of corners too
# 1.02. The hit of a single lane told without a branch, by sums over lanes, 0.83 to 0.9. The next child
# found beside the leaf's cond, not in it: 0.97. One array for a ray's place 0.93, for both rays' 0.91; all
# words of a ray and its lane bits as integers 0.93. With one ray side by side now 0.83 to 1.0, with four
# 0.89.
#
# Without branches (rebuilt; bunny, dragon, 3.5 M; Emerald Rapids): occlusion closest 1.10 to 1.15, any hit
# 1.11 to 1.16, a camera's rays one by one 1.07 to 1.16 of what stood before. A turn of the node loop, two
# rays, had 372 instructions, of which 136 were arithmetic and 84 loads and stores of pointers; it has 320.
# The same ray again and again, which the processor guesses and finds in its caches, took 213 ns where its
# neighbours took 350. What gave it, one after the other: values left in the loop 1.04, both rays' words in
# one array 1.01, children taken without a branch 1.03, a bottom of the stack that is not looked for 1.02, a
# shear that is asked for where it is used 1.02, the nearest t and its face found as one number of 64 bits
# 1.01, and 1.05 for a camera.
#
# Lost on the way: one leaf test for whichever ray is there, chosen by its number, 0.93; both stacks in one
# array 0.98; the child below taken ahead 0.95 (the stack is copied); a node written to the stack before it
# is known whether it stays, twenty instructions fewer, 0.99; faces read in the cond of a hit 1.0. A choice
# between a loaded number and another is made a branch by LLVM, unless something is done to the number in
# between. Three rays side by side 0.95 to 1.05, four 0.95; registers of 512 bits 1.0.
#
# Rays read where all lie, not copied two at a time: 0.94, though it is 1.03 for packets.
# Rays that wait at leaves until all are there 0.98, a leaf's lines touched as soon as a ray comes to it 0.92.
#
# A turn of the node loop is a chain of some 90 cycles, counted in the assembly: the child's number through
# memory, its box rows, their products and bounds, a sum over lanes, the bit's place, the child's number. Two
# rays have 321 instructions, about as many cycles' worth: one more fills no gap. Huge pages on Emerald
# Rapids: 0.99 to 1.03 (dragon, 3.5 M).
