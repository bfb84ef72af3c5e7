"""The walk of packets: 32 rays that go the same way, through the same hierarchy, to the same hits.

Source: Wald, Slusallek, Benthin & Wagner, "Interactive Rendering with Coherent Ray Tracing" (EG 2001) for
rays in packets; Reshetov, Soupikov & Hurley (SIGGRAPH 2005) for the frustum that stands for them. Nodes,
leaves, order of visits and stack are those of `walk`; the test of a triangle is that of `triangle`, so that
every t and face is the same bit for bit.

Differences:

1. Boxes are tested eight at a time against the frustum of the packet, never against its rays. The frustum is
   bounded by slopes along the rays' dominant axis, which are at most 1: nothing divides.
2. A leaf's triangles are first sifted by their own boxes; then either each one left is tested against all
   rays, or each ray that meets the box of what is left against all triangles, whichever is less work. Where
   triangles are smaller than the gaps between rays the second is several times faster.
3. A box is left out only where the frustum misses it by more than `MARGIN`.

**Boxes.** With u = 2^-24 and M the largest of origins and scene, distances along the axis are off by at most
2uM, a slope (at most 1, widened by 8u) times one by 3uM more, sums by 2uM: 7uM, and the triangle test needs
8uM (`box.REACH`); sides of packed boxes are rounded too, by uM. The margin is 32uM (`layout.PACKET_MARGIN`).

Cost: about 200 operations a leaf, 45 a triangle and eight rays, or 100 a ray and eight triangles.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from striptools.kernels.packets import HEAD, PACKET
from striptools.trace.numerics import ends_of, folded, in_range, index, larger, smaller
from striptools.trace.triangle import Shear, crossing_of, edges_of
from striptools.trace.walk import (
    DONE,
    MISS,
    SLACK,
    STUCK,
    Best,
    Decode,
    Leaf,
    Place,
    Traced,
    WalkOptions,
    WalkScene,
    empty_stack,
    lane_bits_of,
    leave_leaf,
    names_leaf,
    scanned,
    sifted,
    step_down,
)

FAR = np.float32(3.0e38)

RAY_OVER_TRIANGLE = np.float32(0.7)
"""What a ray against all triangles of a leaf costs, over a triangle against all rays."""


class PacketScene(WalkScene, Protocol):
    """What a walk of packets asks of a scene."""

    def sides_of(self, node: Array, rows: tuple[Array, ...]) -> list[Array]:
        """Sides of a node's boxes, (8,) float32 scaled each; NaN where there is none.

        Args:
            node: The node.
            rows: Which sides: 0 to 2 are the low ones along x, y, z, 3 to 5 the high ones.
        """
        ...

    def sides_in(self, node: Array, rows: tuple[Array, ...], lane: Array) -> list[Array]:
        """Sides of the box in one lane, () float32 each, as of `sides_of`."""
        ...

    def leaf_for_packets(
        self, axes: tuple[Array, Array, Array], where: Any, decode: Decode | None
    ) -> Callable[[], Leaf]:
        """What makes `leaf_of` for one leaf and many rays, again and again for nothing."""
        ...

    def walk_packets(self, ready: Array, options: WalkOptions, live: Array | None = None) -> Traced:
        """Walk packets: `walk_packets` of this module."""
        ...


class _Packet(NamedTuple):
    """A packet, in as few arrays as can be: a loop pays for each.

    Attributes:
        bounds: (13,) float32, what the properties name.
        ints: (10,) int32: axes, octant, and the rows of a node's boxes.
        ready: (p, 272) float32, all packets: rays are read where they lie, as a row is copied one by one.
        row: () int32, which of them this is.
    """

    bounds: Array
    ints: Array
    ready: Array
    row: Array

    @property
    def slopes(self) -> Array:
        """Least and largest slope in x, then in y, along z the way the rays go."""
        return self.bounds[0:4]

    @property
    def starts(self) -> Array:
        """Least and largest origin in x, then in y, then the foremost and the hindmost, widened."""
        return self.bounds[4:10]

    @property
    def deepest(self) -> Array:
        """The largest direction along z."""
        return self.bounds[10]

    @property
    def margin(self) -> Array:
        """Widening of boxes."""
        return self.bounds[11]

    @property
    def sign(self) -> Array:
        """1, or -1 where rays go down z."""
        return self.bounds[12]

    @property
    def axes(self) -> tuple[Array, Array, Array]:
        """x, y and z."""
        return index(self.ints[0]), index(self.ints[1]), index(self.ints[2])

    @property
    def octant(self) -> Array:
        """Of the rays, see `walk.mirror_of`."""
        return self.ints[3]

    @property
    def rows(self) -> tuple[Array, ...]:
        """Of boxes: low and high along x, low and high along y, near and far along z."""
        return tuple(index(self.ints[k]) for k in range(4, 10))

    @property
    def shear(self) -> Shear:
        """Of the rays, (32,) each."""
        rays = [self.of_rays(k) for k in range(6)]
        return Shear(self.axes, (rays[0], rays[1], rays[2]), rays[3], rays[4], rays[5])

    def of_rays(self, k: int) -> Array:
        """(32,) float32 each: origin along the axes, shear, t_max in t of the walk, t in the caller's units.

        A lane without a ray has a t_max of -1.
        """
        at = index(self.row), jnp.uint32(HEAD + k * PACKET)
        return lax.dynamic_slice(self.ready, at, (1, PACKET))[0]

    def shear_of(self, lane: Array) -> Shear:
        """Of one ray."""
        places = [(index(self.row), HEAD + k * PACKET + (lane & (PACKET - 1))) for k in range(6)]
        ray = [lax.dynamic_slice(self.ready, at, (1, 1))[0, 0] for at in places]
        return Shear(self.axes, (ray[0], ray[1], ray[2]), ray[3], ray[4], ray[5])


class _Ray(NamedTuple):
    """One ray of a packet."""

    packet: _Packet
    lane: Array

    @property
    def shear(self) -> Shear:
        """As of `walk.ReadyRay`."""
        return self.packet.shear_of(self.lane)


class _Found(NamedTuple):
    """What the rays have found: (32,) each, and the depth beyond which nothing matters."""

    t: Array
    name: Array
    limit: Array


class _Box(NamedTuple):
    """Low and high sides of boxes along x, y and z, (8,) or () each; z is counted the way the rays go."""

    x: tuple[Array, Array]
    y: tuple[Array, Array]
    z: tuple[Array, Array]


def walk_packets(scene: PacketScene, ready: Array, options: WalkOptions, live: Array | None = None) -> Traced:
    """Walk p packets.

    Args:
        scene: What to trace.
        ready: (p, 272) float32, as from `kernels.packets.ready_packets`; rows of zeros end at once.
        options: What to compile in; rays go side by side as they are, and nothing is counted.
        live: () int32, how many packets there are; None for all.

    Returns:
        Of the rays of each packet, (p, 32).
    """

    def walk(stack: Array, row: Array) -> tuple[Array, tuple[Array, Array]]:
        return _walk_packet(scene, _packet_of(ready, row), stack, options)

    rows = jnp.arange(len(ready), dtype=jnp.int32)
    t, name = scanned(walk, empty_stack(scene, options), rows, live)
    return Traced(
        jnp.zeros(0) if options.any_hit else t, name, jnp.zeros(0, jnp.int32), jnp.zeros(0, jnp.int32)
    )


def _packet_of(ready: Array, row: Array) -> _Packet:
    """The packet in a row."""
    head = lax.dynamic_slice(ready, (index(row), jnp.uint32(0)), (1, HEAD))[0]
    ints = lax.bitcast_convert_type(head[12:], jnp.int32)
    x, y, z, away = ints[0], ints[1], ints[2] & 3, ints[2] >> 2
    near, far = z + 3 * away, z + 3 * (1 - away)
    sign = (1 - 2 * away).astype(jnp.float32)
    rows = jnp.stack([x, y, z, ints[3], x, x + 3, y, y + 3, near, far])
    return _Packet(jnp.append(head[:12], sign), rows, ready, row)


def _meets(packet: _Packet, box: _Box, limit: Array) -> Array:
    """Which boxes the frustum meets; where a side is not a number it says no."""
    low, high = box.z[0] - packet.starts[4], box.z[1] - packet.starts[5]
    near = larger(low, jnp.float32(0))

    def inside(sides: tuple[Array, Array], axis: int) -> Array:
        least, most = packet.slopes[2 * axis], packet.slopes[2 * axis + 1]
        below = smaller(near * least, high * least)
        above = larger(near * most, high * most)
        starts = packet.starts[2 * axis : 2 * axis + 2]
        return (below <= sides[1] - starts[0]) & (above >= sides[0] - starts[1])

    x, y = inside(box.x, 0), inside(box.y, 1)
    return (high >= 0) & (low <= limit) & x & y


def _rays_in(packet: _Packet, box: _Box, t: Array) -> Array:
    """Which rays meet one box, or would behind their origins, nearer than their closest hit: (32,) bool."""
    shear, margin = packet.shear, packet.margin
    near = (box.z[0] - margin) * packet.sign - shear.origin[2]
    far = (box.z[1] + margin) * packet.sign - shear.origin[2]

    def inside(sides: tuple[Array, Array], origin: Array, slope: Array) -> Array:
        one, other = origin + slope * near, origin + slope * far
        return (smaller(one, other) <= sides[1] + margin) & (larger(one, other) >= sides[0] - margin)

    along = near * shear.z <= t * SLACK
    return along & inside(box.x, shear.origin[0], shear.x) & inside(box.y, shear.origin[1], shear.y)


def _bits(flags: Array) -> Array:
    """Flags of up to 32 lanes as bits: () uint32."""
    lanes = jnp.uint32(1) << jnp.arange(len(flags), dtype=jnp.uint32)
    return jnp.sum(jnp.where(flags, lanes, jnp.uint32(0)), dtype=jnp.uint32)


def _next_bit(bits: Array) -> tuple[Array, Array]:
    """The place of the highest bit, uint32, and the bits without it."""
    place = 31 - lax.clz(bits)
    return place, bits & ~(jnp.uint32(1) << place)


def _triangles_in(packet: _Packet, leaf: Leaf, limit: Array) -> Array:
    """The triangles of a leaf whose boxes the frustum meets, as bits."""
    ahead = [corner * packet.sign for corner in leaf.z]
    met = _meets(packet, _Box(ends_of(leaf.x), ends_of(leaf.y), ends_of(ahead)), limit)
    return _bits(met if leaf.filled is None else met & leaf.filled)


def _test_leaf(
    scene: PacketScene, packet: _Packet, where: Any, rays: Array, found: _Found, options: WalkOptions
) -> _Found:
    """Test a leaf, that the `rays` (bits) may meet, by these rays or by its triangles."""
    at_hand = scene.leaf_for_packets(packet.axes, where, options.decode)
    triangles = _triangles_in(packet, at_hand(), found.limit)
    ray_count, count = (lax.population_count(bits).astype(jnp.float32) for bits in (rays, triangles))
    by_ray = ray_count * RAY_OVER_TRIANGLE < count
    none = jnp.uint32(0)

    def test_ray(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        lane, left = _next_bit(state[0])
        return left, *_one_ray(scene, packet, at_hand, lane, state[1], state[2], options)

    def test_triangle(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        lane, left = _next_bit(state[0])
        return left, *_one_triangle(scene, packet, at_hand(), lane, state[1], state[2])

    state = (jnp.where(by_ray, rays, none), found.t, found.name)
    state = lax.while_loop(lambda s: s[0] != 0, test_ray, state)
    state = (jnp.where(by_ray, none, triangles), *state[1:])
    _, t, name = lax.while_loop(lambda s: s[0] != 0, test_triangle, state)
    if options.any_hit:
        # A ray that has hit something reaches no farther.
        t = jnp.where(name >= 0, jnp.float32(-1), t)
    return _Found(t, name, _limit(packet, t))


def _one_ray(
    scene: PacketScene,
    packet: _Packet,
    at_hand: Callable[[], Leaf],
    lane: Array,
    t: Array,
    name: Array,
    options: WalkOptions,
) -> tuple[Array, Array]:
    """Test one ray against eight triangles."""
    before = Best(*(lax.dynamic_slice(a, (lane,), (1,))[0] for a in (t, name)))
    faces_of = scene.faces_of if scene.has_faces else None
    best = sifted(at_hand, _Ray(packet, lane), before, options._replace(any_hit=False), faces_of)
    return (
        lax.dynamic_update_slice(t, best.nearest[None], (lane,)),
        lax.dynamic_update_slice(name, best.name[None], (lane,)),
    )


def _one_triangle(
    scene: PacketScene, packet: _Packet, leaf: Leaf, lane: Array, t: Array, name: Array
) -> tuple[Array, Array]:
    """Test one triangle against all rays."""

    def of_triangle(values: Array) -> Array:
        return lax.dynamic_slice(values, (lane,), (1,))[0]

    x, y, z = ((of_triangle(a), of_triangle(b), of_triangle(c)) for a, b, c in (leaf.x, leaf.y, leaf.z))
    turn = None if leaf.turn is None else of_triangle(leaf.turn)
    crossing = crossing_of(edges_of(x, y, z, packet.shear), turn)
    mine = of_triangle(leaf.name)
    first = jnp.where(mine < name, np.int32(1), np.int32(0))
    if scene.has_faces:
        # Numbers, as flags go through memory one by one.
        def by_face() -> Array:
            return jnp.where(scene.faces_of(mine[None])[0] < scene.faces_of(name), np.int32(1), np.int32(0))

        tied = _bits((crossing - t == 0) & (crossing + t > 0) & (name >= 0)) != 0
        first = lax.cond(tied, by_face, lambda: jnp.zeros_like(name))
    closer = (crossing > 0) & ((crossing < t) | (crossing == t) & (first != 0))
    return jnp.where(closer, crossing, t), jnp.where(closer, mine, name)


def _limit(packet: _Packet, t: Array) -> Array:
    """The depth along z that no ray needs to go beyond."""
    return folded(t, larger) * packet.deepest * SLACK + packet.margin


def _box_of(scene: PacketScene, packet: _Packet, state: "_State") -> _Box:
    """The box of the leaf at hand, as its node has it."""
    x0, x1, y0, y1, z0, z1 = scene.sides_in(state.node, packet.rows, state.lane)
    return _Box((x0, x1), (y0, y1), (z0 * packet.sign, z1 * packet.sign))


class _State(NamedTuple):
    """Where a packet is; the node that it came from has the child at hand in this lane."""

    place: Place
    node: Array
    lane: Array
    stack: Array
    turns: Array


def _walk_packet(
    scene: PacketScene, packet: _Packet, stack: Array, options: WalkOptions
) -> tuple[Array, tuple[Array, Array]]:
    """Walk one packet; its stack serves the next."""
    lane_bits = lane_bits_of(packet.octant, scene.width)

    def visit_node(state: _State, limit: Array) -> _State:
        place = state.place
        x0, x1, y0, y1, z0, z1 = scene.sides_of(place.child, packet.rows)
        box = _Box((x0, x1), (y0, y1), (z0 * packet.sign, z1 * packet.sign))
        met = _meets(packet, box, limit)
        lanes = jnp.sum(jnp.where(met, lane_bits, 0))
        there = step_down(scene, packet.octant, place.child, lanes, place.height, state.stack)
        return _State(*there, state.turns + 1)

    def test_leaf(state: _State, found: _Found) -> _Found:
        # Before rays are tested, which goes on while its loads are waited for.
        where = scene.find_leaf(state.place.child)
        # Between the rays of a packet there may be room for a leaf: then it is not even read.
        rays = _bits(_rays_in(packet, _box_of(scene, packet, state), found.t))
        return lax.cond(
            rays != 0,
            lambda: _test_leaf(scene, packet, where, rays, found, options),
            lambda: found,
        )

    def leave(state: _State, found: _Found) -> _State:
        place, node, lane, stack = leave_leaf(scene, packet.octant, state.place, state.stack)
        done = found.limit < 0
        place = place._replace(child=jnp.where(done, DONE, place.child))
        return _State(place, node, lane, stack, state.turns)

    def nodes_then_leaf(carried: tuple[_State, _Found]) -> tuple[_State, _Found]:
        state, found = carried
        state = lax.while_loop(
            lambda s: (s.place.child >= 0) & (s.turns <= scene.node_count),
            lambda s: visit_node(s, found.limit),
            state,
        )
        found = lax.cond(names_leaf(state.place.child), lambda: test_leaf(state, found), lambda: found)
        return leave(state, found), found

    zero = jnp.int32(0)
    t_max = packet.of_rays(6)
    found = _Found(t_max, jnp.full(PACKET, MISS), _limit(packet, t_max))
    first = jnp.where(folded(t_max, larger) > 0, zero, DONE)
    state = _State(Place(first, zero), zero, jnp.uint32(0), stack, zero)
    state, found = lax.while_loop(
        lambda carried: (carried[0].place.child != DONE) & (carried[0].turns <= scene.node_count),
        nodes_then_leaf,
        (state, found),
    )
    t = jnp.where(found.name < 0, jnp.float32(jnp.inf), in_range(found.t * packet.of_rays(7)))
    name = jnp.where(state.place.child != DONE, STUCK, found.name)
    return state.stack, (t, name)


# Notes
#
# Where the time goes (camera, dragon of 3.5 M triangles): nodes 17 %, rays against a leaf's box 12 %,
# waiting for leaves 20 %, triangles against all rays 26 %, a ray against all triangles 7 %.
#
# Ratios of speed to what stands here (dragon, 3.5 M; 72 and 140 ns a ray). Lost or no gain: triangles
# sifted before all rays are weighed 0.93, 1.0; a leaf's lines touched before its box is tested 0.94, 0.87;
# triangles not sifted by the frustum where few rays meet the leaf 0.96, 0.98; a leaf's rows read one by one
# 0.94, 0.95; RAY_OVER_TRIANGLE of 0.3 and 1.2 0.94, 1.0 and 1.0, 0.98; registers of 512 bits 0.97, 1.01. A
# leaf read where it is tested, in place of a copy of it, gave 1.08, 1.06.
#
# Triangles tested against those eight rays alone that may meet them, or eight rays at a time each in its
# own way: 0.63 to 0.8, a turn of a loop costs more than 24 lanes. Triangles not sifted where up to four
# rays meet a leaf 1.0 to 1.01, a ray tested without sifting 0.98. Where the time goes now (camera, 3.5 M
# triangles): nodes 13 %, rays against a leaf's box 15 %, its triangles against the frustum 23 %, of which
# half waits for them, a ray against its triangles 28 %, triangles against all rays 5 %; and of all time a
# quarter is beside the walk.
#
# Rays read where all packets lie gave 1.03 (bunny, dragon): a row is copied number by number. No gain: hits
# and misses written in one pass, not misses beforehand, 0.92 to 1.0; the limit by a largest integer, which
# LLVM finds step by step too, 1.0.
#
# Weights of hits worked out where triangles are tested, and carried along, so that the host need not read
# leaves again (a tenth of a camera's time): 0.74 to 0.81 expanded, 0.94 to 0.99 compressed.
