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
6uM. `MARGIN` is 16uM for expanded scenes.

Cost: about 200 operations a leaf, 45 a triangle and eight rays, or 100 a ray and eight triangles.
"""

from typing import NamedTuple, Protocol

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from striptools.kernels.packets import HEAD, PACKET
from striptools.trace.numerics import folded, index, larger, smaller
from striptools.trace.triangle import Corners, Shear, crossing_of, edges_of
from striptools.trace.walk import (
    DONE,
    MISS,
    NO_NAME,
    SLACK,
    STUCK,
    WIDTH,
    Place,
    Traced,
    WalkOptions,
    WalkScene,
    next_child,
)

FAR = np.float32(3.0e38)

RAY_OVER_TRIANGLE = np.float32(0.5)
"""What a ray against all triangles of a leaf costs, over a triangle against all rays."""


class LeafRows(NamedTuple):
    """The triangles of a leaf, for any axis.

    Attributes:
        axes: Corners a, b, c along the three axes asked for, (8,) float32 each; NaN where there is none.
        name: (8,) int32, what the scene calls them; `NO_NAME` where there is none.
        turn: (8,) int32, which corner is the first in the canonical order; None where that is corner a.
    """

    axes: tuple[Corners, Corners, Corners]
    name: Array
    turn: Array | None


class PacketScene(WalkScene, Protocol):
    """What a walk of packets asks of a scene."""

    def boxes_of(self, node: Array, axes: tuple[Array, Array, Array]) -> list[tuple[Array, Array]]:
        """Low and high sides of a node's boxes along the axes, (8,) float32 scaled; NaN where is none."""
        ...

    def leaf_rows(self, child: Array, axes: tuple[Array, Array, Array]) -> LeafRows:
        """The triangles of a leaf."""
        ...

    def walk_packets(self, ready: Array, options: WalkOptions) -> Traced:
        """Walk packets: `walk_packets` of this module."""
        ...


class _Packet(NamedTuple):
    """A packet: bounds of its rays, () each, and its rays, (32,) each.

    Attributes:
        slopes: Least and largest slope in x, then in y, along z the way the rays go.
        start_x: Least and largest origin, widened.
        start_y: The same.
        start_z: The foremost and the hindmost origin, counted the way the rays go, widened.
        deepest: The largest direction along z.
        margin: Widening of boxes.
        axes: x, y, z, uint32.
        away: Whether rays go down z.
        mirror: As of a ray.
        shear: Of the rays.
        t_max: In t of the walk; -1 in a lane without a ray.
        t_unit: T of the walk in units of the caller's.
    """

    slopes: tuple[Array, Array, Array, Array]
    start_x: tuple[Array, Array]
    start_y: tuple[Array, Array]
    start_z: tuple[Array, Array]
    deepest: Array
    margin: Array
    axes: tuple[Array, Array, Array]
    away: Array
    mirror: Array
    shear: Shear
    t_max: Array
    t_unit: Array


class _Found(NamedTuple):
    """What the rays have found: (32,) each, and the depth beyond which nothing matters."""

    t: Array
    name: Array
    limit: Array


class _Box(NamedTuple):
    """Sides of boxes along x, y and z, (8,) or () each."""

    x: tuple[Array, Array]
    y: tuple[Array, Array]
    z: tuple[Array, Array]


def walk_packets(scene: PacketScene, ready: Array, options: WalkOptions) -> Traced:
    """Walk p packets.

    Args:
        scene: What to trace.
        ready: (p, 272) float32, as from `kernels.packets.ready_packets`; rows of zeros end at once.
        options: What to compile in; rays go side by side as they are, and nothing is counted.

    Returns:
        Of the rays of each packet, (p, 32).
    """
    bottom = jnp.array([scene.node_count - 1, 256], jnp.int32)
    stack = jnp.zeros((options.stack_size, 2), jnp.int32).at[0].set(bottom)

    def walk(stack: Array, row: Array) -> tuple[Array, tuple[Array, Array]]:
        return _walk_packet(scene, _packet_of(row), stack, options)

    t, name = lax.scan(walk, stack, ready)[1]
    return Traced(jnp.zeros(0) if options.any_hit else t, name, jnp.zeros(0, jnp.int32))


def _packet_of(row: Array) -> _Packet:
    """The packet that a row says."""
    ints = lax.bitcast_convert_type(row[12:HEAD], jnp.int32)
    lanes = row[HEAD:].reshape(8, PACKET)
    axes = index(ints[0]), index(ints[1]), index(ints[2] & 3)
    shear = Shear(axes, (lanes[0], lanes[1], lanes[2]), lanes[3], lanes[4], lanes[5])
    bounds = [row[k] for k in range(12)]
    return _Packet(
        (bounds[0], bounds[1], bounds[2], bounds[3]),
        (bounds[4], bounds[5]),
        (bounds[6], bounds[7]),
        (bounds[8], bounds[9]),
        bounds[10],
        bounds[11],
        axes,
        (ints[2] & 4) != 0,
        ints[3],
        shear,
        lanes[6],
        lanes[7],
    )


def _meets(packet: _Packet, box: _Box, limit: Array) -> Array:
    """Which boxes the frustum meets; where a side is not a number it says no."""
    low = jnp.where(packet.away, -box.z[1], box.z[0]) - packet.start_z[0]
    high = jnp.where(packet.away, -box.z[0], box.z[1]) - packet.start_z[1]
    near = larger(low, jnp.float32(0))

    def inside(sides: tuple[Array, Array], starts: tuple[Array, Array], least: Array, most: Array) -> Array:
        # The frustum is widest to a side where its slope there makes it so.
        below = jnp.where(least >= 0, near, high) * least
        above = jnp.where(most >= 0, high, near) * most
        return (below <= sides[1] - starts[0]) & (above >= sides[0] - starts[1])

    x = inside(box.x, packet.start_x, packet.slopes[0], packet.slopes[1])
    y = inside(box.y, packet.start_y, packet.slopes[2], packet.slopes[3])
    return (high >= 0) & (low <= limit) & x & y


def _rays_in(packet: _Packet, box: _Box, t: Array) -> Array:
    """Which rays meet one box, nearer than their closest hit: (32,) bool."""
    shear, margin = packet.shear, packet.margin
    near, far = box.z[0] - margin - shear.origin[2], box.z[1] + margin - shear.origin[2]

    def inside(sides: tuple[Array, Array], origin: Array, slope: Array) -> Array:
        one, other = slope * near, slope * far
        return (smaller(one, other) <= sides[1] + margin - origin) & (
            larger(one, other) >= sides[0] - margin - origin
        )

    first, last = near * shear.z, far * shear.z
    along = (larger(first, last) >= 0) & (smaller(first, last) <= t * SLACK)
    return along & inside(box.x, shear.origin[0], shear.x) & inside(box.y, shear.origin[1], shear.y)


def _bits(flags: Array) -> Array:
    """Flags of up to 32 lanes as bits: () uint32."""
    lanes = jnp.uint32(1) << jnp.arange(len(flags), dtype=jnp.uint32)
    return folded(jnp.where(flags, lanes, jnp.uint32(0)), jnp.bitwise_or)


def _next_bit(bits: Array) -> tuple[Array, Array]:
    """The place of the highest bit, uint32, and the bits without it."""
    place = 31 - lax.clz(bits)
    return place, bits & ~(jnp.uint32(1) << place)


class _Leaf(NamedTuple):
    """A leaf at hand: its triangles, and which of them and which rays are left."""

    rows: LeafRows
    triangles: Array
    rays: Array


def _sifted(packet: _Packet, rows: LeafRows, found: _Found) -> _Leaf:
    """The triangles whose boxes the frustum meets, and the rays that meet the box of them all."""
    sides = [
        (smaller(smaller(a, b), c), larger(larger(a, b), c)) for a, b, c in (rows.axes[k] for k in range(3))
    ]
    met = _meets(packet, _Box(*sides), found.limit)
    around = [
        (folded(jnp.where(met, low, FAR), smaller), folded(jnp.where(met, high, -FAR), larger))
        for low, high in sides
    ]
    return _Leaf(rows, _bits(met), _bits(_rays_in(packet, _Box(*around), found.t)))


def _test_leaf(packet: _Packet, leaf: _Leaf, found: _Found, options: WalkOptions) -> _Found:
    """Test a leaf by its rays or by its triangles."""
    triangles, rays = (lax.population_count(bits).astype(jnp.float32) for bits in leaf[1:])
    by_ray = rays * RAY_OVER_TRIANGLE < triangles
    none = jnp.uint32(0)

    def test_ray(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        lane, left = _next_bit(state[0])
        return left, *_one_ray(packet, leaf.rows, lane, state[1], state[2])

    def test_triangle(state: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        lane, left = _next_bit(state[0])
        return left, *_one_triangle(packet, leaf.rows, lane, state[1], state[2])

    state = (jnp.where(by_ray, leaf.rays, none), found.t, found.name)
    state = lax.while_loop(lambda s: s[0] != 0, test_ray, state)
    state = (jnp.where(by_ray | (leaf.rays == 0), none, leaf.triangles), *state[1:])
    _, t, name = lax.while_loop(lambda s: s[0] != 0, test_triangle, state)
    if options.any_hit:
        # A ray that has hit something reaches no farther.
        t = jnp.where(name >= 0, jnp.float32(-1), t)
    return _Found(t, name, _limit(packet, t))


def _one_ray(packet: _Packet, rows: LeafRows, lane: Array, t: Array, name: Array) -> tuple[Array, Array]:
    """Test one ray against eight triangles."""

    def of_ray(values: Array) -> Array:
        return lax.dynamic_slice(values, (lane,), (1,))[0]

    shear = packet.shear
    x, y, z = (of_ray(values) for values in shear.origin)
    one = Shear(shear.axes, (x, y, z), of_ray(shear.x), of_ray(shear.y), of_ray(shear.z))
    crossing = crossing_of(edges_of(*rows.axes, one), rows.turn)
    crossing = jnp.where((crossing > 0) & (rows.name != NO_NAME), crossing, jnp.inf)
    nearest = folded(crossing, smaller)
    least = folded(jnp.where(crossing == nearest, rows.name, NO_NAME), smaller)
    old, old_name = of_ray(t), of_ray(name)
    closer = (nearest < jnp.inf) & ((nearest < old) | ((nearest == old) & (least < old_name)))
    t = lax.dynamic_update_slice(t, jnp.where(closer, nearest, old)[None], (lane,))
    return t, lax.dynamic_update_slice(name, jnp.where(closer, least, old_name)[None], (lane,))


def _one_triangle(packet: _Packet, rows: LeafRows, lane: Array, t: Array, name: Array) -> tuple[Array, Array]:
    """Test one triangle against all rays."""

    def of_triangle(values: Array) -> Array:
        return lax.dynamic_slice(values, (lane,), (1,))[0]

    x, y, z = (tuple(of_triangle(corner) for corner in axis) for axis in rows.axes)
    turn = None if rows.turn is None else of_triangle(rows.turn)
    crossing = crossing_of(edges_of(x, y, z, packet.shear), turn)
    mine = of_triangle(rows.name)
    closer = (crossing > 0) & ((crossing < t) | ((crossing == t) & (mine < name)))
    return jnp.where(closer, crossing, t), jnp.where(closer, mine, name)


def _limit(packet: _Packet, t: Array) -> Array:
    """The depth along z that no ray needs to go beyond."""
    return folded(t, larger) * packet.deepest * SLACK + packet.margin


class _State(NamedTuple):
    place: Place
    stack: Array
    turns: Array


class _Turn(NamedTuple):
    """What `next_child` needs of a ray."""

    mirror: Array


def _walk_packet(
    scene: PacketScene, packet: _Packet, stack: Array, options: WalkOptions
) -> tuple[Array, tuple[Array, Array]]:
    """Walk one packet; its stack serves the next."""
    turn = _Turn(packet.mirror)
    lane_bits = jnp.int32(1) << (jnp.arange(WIDTH, dtype=jnp.int32) ^ packet.mirror)

    def visit_node(state: _State, limit: Array) -> _State:
        place = state.place
        entry = jnp.stack([place.node, place.lanes])[None]
        stack = lax.dynamic_update_slice(state.stack, entry, (index(place.height), jnp.uint32(0)))
        height = jnp.where(place.lanes != 0, place.height + 1, place.height)
        met = _meets(packet, _Box(*scene.boxes_of(place.child, packet.axes)), limit)
        lanes = jnp.sum(jnp.where(met, lane_bits, 0))
        there = next_child(scene, turn, place.child, lanes, height, stack)
        return _State(there, stack, state.turns + 1)

    def leave_leaf(state: _State, found: _Found) -> tuple[Place, _Found]:
        place = state.place
        rows = scene.leaf_rows(place.child, packet.axes)
        found = _test_leaf(packet, _sifted(packet, rows, found), found, options)
        there = next_child(scene, turn, place.node, place.lanes, place.height, state.stack)
        done = found.limit < 0
        return there._replace(child=jnp.where(done, DONE, there.child)), found

    def nodes_then_leaf(carried: tuple[_State, _Found]) -> tuple[_State, _Found]:
        state, found = carried
        state = lax.while_loop(
            lambda s: (s.place.child >= 0) & (s.turns <= scene.node_count),
            lambda s: visit_node(s, found.limit),
            state,
        )
        place, found = lax.cond(
            (state.place.child < 0) & (state.place.child != DONE),
            lambda: leave_leaf(state, found),
            lambda: (state.place, found),
        )
        return state._replace(place=place), found

    zero = jnp.int32(0)
    found = _Found(packet.t_max, jnp.full(PACKET, MISS), _limit(packet, packet.t_max))
    first = jnp.where(folded(packet.t_max, larger) > 0, zero, DONE)
    state = _State(Place(first, zero, zero, jnp.int32(1)), stack, zero)
    state, found = lax.while_loop(
        lambda carried: (carried[0].place.child != DONE) & (carried[0].turns <= scene.node_count),
        nodes_then_leaf,
        (state, found),
    )
    t = jnp.where(found.name < 0, jnp.float32(jnp.inf), found.t * packet.t_unit)
    name = jnp.where(state.place.child != DONE, STUCK, found.name)
    return state.stack, (t, name)
