"""The walk of rays through a wide hierarchy: a function of a few rays, compiled to one native loop.

What nodes and leaves look like is the scene's affair (`WalkScene`): `walk_wide` has boxes and corners in
float32, `walk_packed` the compressed blocks of a scene file.

Nodes, octant order and the stack of (node, lanes left) follow Ylitie, Karras & Laine, "Efficient Incoherent
Ray Traversal on GPUs Through Compressed Wide BVHs" (HPG 2017), section 3.

Differences:

1. A few rays go side by side in one instruction stream, so that one's arithmetic fills the other's waits:
   two on a CPU, one on a GPU. Leaves are visited as soon as one of them is at one.
2. Nodes have 8 children, or 16 where a hierarchy is made for a CPU. Leaves are tested eight triangles at
   once; hits are looked at one by one only where there are any.
3. A box is left out only where it is farther than the closest hit by more than `SLACK`, and of two hits at
   the same t the one of the smaller face is kept: the result does not depend on the order of visits.

What the assembly taught: every value that a loop carries, and every one that a `lax.cond` is given from
outside, costs loads and stores in each turn; what is worked out anew inside costs less. A stack inside a
`lax.cond` is copied, and so is one of which something is read that does not lead to what is written. A loop
is hoisted only while nothing in it scatters, sorts or calls back. A branch that goes either way costs more
than a few dozen instructions.

The steps of a walk are bounded: a tree that goes round in a circle ends in `STUCK`, not in a hang.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Int32

from striptools.kernels.wide import WIDTH
from striptools.trace.box import Coordinates, Slab, slab_of
from striptools.trace.counters import Counters
from striptools.trace.numerics import (
    BY_XLA,
    HIGHEST,
    Arithmetic,
    any_lane,
    folded,
    in_range,
    index,
    kept,
    larger,
    power_of_two_below,
    smaller,
)
from striptools.trace.triangle import Corners, Shear, edges_of, may_cross, pick, shear_of
from striptools.trace.triangle_tests import Triangles, crossings_by, wants_way
from striptools.trace.walk_gather import Gathered, GatherKind, gather_leaf, nothing_gathered
from striptools.types import TriangleTest

FLOATS = 17
"""Float32 words at the head of a ready ray; int32 words follow."""

WORDS = 24
"""Words of a ready ray; three float32 of its direction follow, where a triangle test asks for them."""

START = 4
"""Where among the int32 words a ray's first child is."""

DONE = np.int32(-(2**31))
"""The next child of a ray that has nothing left to visit."""

HIT = np.int32(0)
"""The name of whatever any hit finds."""

MISS = np.int32(-1)
STUCK = np.int32(-2)
"""The name of a ray whose walk did not end within the bound."""

NO_NAME = np.int32(2**31 - 1)
SLACK = np.float32(1 + 2**-20)

_A_NODE, _A_LEAF, _A_TRIANGLE = np.eye(3, dtype=np.int32)
"""Nodes, leaves and triangles that a visit counts as."""


class Frame(NamedTuple):
    """How rays are seen from a scene: () float32 where not said otherwise.

    Attributes:
        scale: The power of two that positions were multiplied by.
        reach: The largest scaled coordinate.
        low: (3,) float32, what planes are counted from, scaled.
        unit: (3,) float32, what they are counted in: powers of two.
        margin: Widening of a box in units of the largest coordinate of ray origin and scene.
    """

    scale: Any
    reach: Any
    low: Any
    unit: Any
    margin: Any


class Best(NamedTuple):
    """The closest hit: its t, or t_max, and what the scene calls the triangle, or `MISS`; () each."""

    nearest: Array
    name: Array


Found = Best | Gathered
"""What a ray has found so far: both have a `nearest`, beyond which nothing matters."""


class Leaf(NamedTuple):
    """The triangles of a leaf, a lane each.

    Attributes:
        x, y, z: Corners a, b, c along three axes, (8,) float32 each; NaN in empty lanes if `filled` is None.
        turn: (8,) which corner is the first in the canonical order; None where that is corner a.
        filled: (8,) bool, which lanes hold a triangle; None where empty ones hold NaN.
        name: (8,) int32, what the scene calls the triangles.
    """

    x: Corners
    y: Corners
    z: Corners
    turn: Array | None
    filled: Array | None
    name: Array

    def crossings(
        self,
        shear: Shear,
        arithmetic: Arithmetic = BY_XLA,
        test: TriangleTest = "watertight",
        again: "Callable[[], Leaf] | None" = None,
    ) -> Array:
        """(8,) float32: t at which the ray goes through each triangle; positive and finite only there.

        Args:
            shear: Of the ray.
            arithmetic: Of the compiler at hand.
            test: Of triangles.
            again: Makes the same leaf: for what is rarely computed, so that nothing is kept for it.
        """
        again = again or (lambda: self)
        t = crossings_by(test, self.triangles, shear, arithmetic, lambda: again().triangles)
        return t if self.filled is None else jnp.where(self.filled, t, np.float32(0))

    def may_cross(self, shear: Shear, nearest: Array) -> Array:
        """(8,) bool: where `crossings` by the watertight test may be nearer; see `triangle.may_cross`."""
        may = may_cross(edges_of(self.x, self.y, self.z, shear), nearest, in_order=self.turn is None)
        return may if self.filled is None else may & self.filled

    @property
    def triangles(self) -> Triangles:
        """What a test is told."""
        return Triangles(self.x, self.y, self.z, self.turn, self.filled)


class Sighted(Protocol):
    """What a triangle is seen along."""

    @property
    def shear(self) -> Shear:
        """The ray as the triangle test sees it."""
        ...


class WalkScene(Protocol):
    """What a walk asks of a scene: a NamedTuple of arrays on a device."""

    @property
    def frame(self) -> Frame:
        """How rays are seen."""
        ...

    @property
    def node_count(self) -> int:
        """Nodes, at least."""
        ...

    @property
    def width(self) -> int:
        """Children of a node: `WIDTH` or `BROAD`."""
        ...

    @property
    def has_faces(self) -> bool:
        """Whether names are triangles in file order, and faces something else."""
        ...

    def faces_of(self, names: Array) -> Array:
        """(8,) int32: the faces of hits, negative where there is none."""
        ...

    def lanes_met(self, node: Array, slab: Slab, limit: Array) -> Array:
        """(width,) bool: the node's children whose boxes the ray meets, from 0 to `limit`."""
        ...

    def boxes_of(self, node: Array) -> Array:
        """(6, width) float32: boxes of a node's children, lo xyz and hi xyz, scaled; NaN in empty lanes."""
        ...

    def child_of(self, node: Array, lane: Array) -> Array:
        """The child in a lane: a node, or a negative number other than `DONE` that names a leaf.

        `DONE` for the last node and a lane that no node has, which are at the bottom of each stack.
        """
        ...

    def find_leaf(self, child: Array) -> Any:
        """Where the triangles of a leaf are; anything where the child is none."""
        ...

    def leaf_of(self, axes: tuple[Array, Array, Array], where: Any, decode: "Decode | None") -> Leaf:
        """The triangles of a leaf that `find_leaf` found, their corners along these axes."""
        ...

    def visit_leaf(self, ray: Sighted, where: Any, best: Best, options: "WalkOptions") -> Best:
        """Test the triangles of a leaf, against the closest hit so far."""
        ...

    def triangles_of(self, where: Any) -> Array:
        """() int32: how many triangles a leaf has; anything where there is none."""
        ...

    def counters_of(self, nodes: Any, leaves: Any, triangles: Any) -> Counters:
        """What visits of so many nodes, leaves and triangles come to."""
        ...

    def walk_rays(self, ready: Array, options: "WalkOptions", live: Array | None = None) -> "Traced":
        """Walk r rays made ready: `walk_rays` of this module."""
        ...


class WalkOptions(NamedTuple):
    """What is compiled in.

    Attributes:
        interleave: Rays that go side by side.
        any_hit: End at the first hit.
        counting: Count visits, tests and bytes: what `Counters` has.
        stack_size: Entries of the stack: the depth of the tree and two more.
        batch: Walk all rays at once by vmap (GPU), not one group after the other (CPU).
        decode: How leaves are decoded, where they are packed.
        gather: What to gather in the place of the closest hit, if anything.
        most: How many hits to gather, where all are.
        test: The test of triangles.
        kernel: Walk by the kernel of `trace.pallas`, whose twin `batch` is; nothing is counted or gathered.
    """

    interleave: int
    any_hit: bool
    counting: bool
    stack_size: int
    batch: bool = False
    decode: "Decode | None" = None
    gather: GatherKind | None = None
    most: int = 0
    test: TriangleTest = "watertight"
    kernel: bool = False


class Decode(NamedTuple):
    """What the blocks of a scene need: what none of them has is not compiled in.

    Attributes:
        words: Words that the bits of one vertex may lie in, 1 to 4.
        minus_zero: Some axis is in mode 1.
        as_bits: Some axis is in mode 2.
        flips: Some block has flip bits.
        tiny: Some scaled coordinate may be denormal, or one that is not may come from one that is.
    """

    words: int
    minus_zero: bool
    as_bits: bool
    flips: bool
    tiny: bool


class Traced(NamedTuple):
    """One entry a ray; what was not asked for has none.

    Attributes:
        t: (r,) float32; (0,) of any hit; (r, most), by t and then by face, where all hits are gathered.
        name: (r,) int32, what the scene calls the triangle hit; (r, most) where all hits are gathered.
        counters: (r, 6) int32, in the order of `Counters`; (r, 0) where nothing is counted.
        counted: (r,) int32, how many hits there are, or windings, where those are gathered; else (0,).
    """

    t: Array
    name: Array
    counters: Array
    counted: Array


@partial(jax.tree_util.register_dataclass, data_fields=["rows"], meta_fields=["number", "count"])
@dataclass(frozen=True)
class ReadyRay:
    """What stays the same all along a walk, cut where it is used from one array: a loop pays for each.

    Attributes:
        rows: (24 n,) float32, of n rays that are walked side by side: of each 17 numbers that the properties
            name, then the bits of seven integers; (27 n,) where the directions follow.
        number: Which of the rays it is.
        count: How many there are.
    """

    rows: Array
    number: int = 0
    count: int = 1

    @property
    def words(self) -> Array:
        """(24,) float32, or (27,)."""
        size = len(self.rows) // self.count
        return self.rows[self.number * size : (self.number + 1) * size]

    @property
    def floats(self) -> Array:
        """(17,) float32."""
        return self.words[:FLOATS]

    def integer(self, place: int) -> Array:
        """Of (7,) int32: axes of the shear, octant, and where the walk starts.

        That is exclusive-or of `DONE` and the child to visit first (zeros are a ray that is done), the root's
        lanes left, nodes visited.
        """
        return lax.bitcast_convert_type(self.words[FLOATS + place], jnp.int32)

    @property
    def slab(self) -> Slab:
        """The ray as the box tests see it."""
        return Slab(self.floats[0:3], self.floats[3:6], self.floats[6:9])

    @property
    def shear(self) -> Shear:
        """The ray as the triangle test sees it."""
        x, y, z = (index(self.integer(k)) for k in range(3))
        origin = (self.floats[9], self.floats[10], self.floats[11])
        way = None
        if len(self.words) > WORDS:
            way = (self.words[WORDS], self.words[WORDS + 1], self.words[WORDS + 2])
        return Shear((x, y, z), origin, self.floats[12], self.floats[13], self.floats[14], way)

    @property
    def t_max(self) -> Array:
        """Only hits nearer than this count, in t of the walk."""
        return self.floats[15]

    @property
    def t_unit(self) -> Array:
        """T of the walk in units of the caller's t."""
        return self.floats[16]

    @property
    def octant(self) -> Array:
        """See `mirror_of`."""
        return self.integer(3)

    @property
    def first(self) -> Array:
        """The child to visit first, or `DONE`."""
        return self.integer(START) ^ DONE

    @property
    def rest(self) -> Array:
        """Lanes of the root that are left after it."""
        return self.integer(5)

    @property
    def visited(self) -> Array:
        """Nodes visited before the walk starts."""
        return self.integer(6)


def mirror_of(octant: Any, width: int) -> Any:
    """Exclusive-or of a lane and its place in the order of visits, the nearest highest.

    Args:
        octant: Seven, less a bit for each axis along which the ray goes down, x lowest.
        width: Children of a node; of sixteen lanes the lowest bit says a side along x again.
    """
    return octant if width == WIDTH else octant << 1 | octant & 1


def lane_bits_of(octant: Array, width: int) -> Array:
    """(width,) int32: the bit that stands for each lane, the nearest highest: a row of a constant table."""
    octants, lanes = np.arange(8, dtype=np.int32)[:, None], np.arange(width, dtype=np.int32)
    table = jnp.asarray(np.int32(1) << (lanes ^ mirror_of(octants, width)))
    return lax.dynamic_slice(table, (index(octant & 7), jnp.uint32(0)), (1, width))[0]


def names_leaf(child: Array) -> Array:
    """Whether a child is a leaf: negative, but not `DONE`."""
    return index(child) > np.uint32(2**31)


class Place(NamedTuple):
    """Where a ray is: the child to visit next, and the place of the topmost entry of its stack.

    An entry is a node and the lanes of it that are left, at least one: it goes with its last. Only at the
    bottom there may be none, of the last node, which has no children: whatever is taken from it is `DONE`.
    """

    child: Array
    height: Array


def trace_rays(
    scene: WalkScene, origins: Array, directions: Array, t_max: Array, options: WalkOptions
) -> Traced:
    """Trace r rays, r a multiple of `options.interleave`.

    Args:
        scene: What to trace.
        origins: (r, 3) float32.
        directions: (r, 3) float32.
        t_max: (r,) float32.
        options: What to compile in.
    """
    return scene.walk_rays(prepared_rays(scene, origins, directions, t_max, options.test), options)


def prepared_rays(
    scene: WalkScene, origins: Array, directions: Array, t_max: Array, test: TriangleTest = "watertight"
) -> Array:
    """Ready rays for the walk: (r, 24) float32, the floats and the bits of the ints of `ReadyRay`.

    (r, 27) for a test that asks for the direction along the axes of the shear.
    """
    floats, ints = jax.vmap(lambda *ray: _prepare(scene, *ray))(origins, directions, t_max)
    rows = [floats, lax.bitcast_convert_type(ints, jnp.float32)]
    if wants_way(test):
        rows.append(jax.vmap(_way_of)(directions, ints))
    return jnp.concatenate(rows, axis=1)


def _way_of(direction: Array, ints: Array) -> Array:
    """(3,) float32: a direction scaled, along the axes of its shear."""
    scaled = direction * power_of_two_below(largest_of(direction))[0]
    return jnp.stack([pick(scaled, ints[axis]) for axis in range(3)])


def walk_rays(scene: WalkScene, ready: Array, options: WalkOptions, live: Array | None = None) -> Traced:
    """Walk r rays, r a multiple of `options.interleave`, made ready here or by `kernels.rays`.

    Args:
        scene: What to trace.
        ready: (r, 24) or (r, 27) float32, as from `prepared_rays`; rows of zeros are rays that end at once.
        options: What to compile in.
        live: () int32, how many there are on a CPU, where rows behind them are not looked at but those that
            fill up the last group, and nothing is said of them; None for all.
    """
    rows = ready.reshape(len(ready) // options.interleave, -1)
    stacks = (empty_stack(scene, options),) * options.interleave

    def walk(stacks: tuple[Array, ...], group: Array) -> tuple[tuple[Array, ...], _Walked]:
        return _walk_group(scene, group, stacks, options)

    if options.batch:
        walked = jax.vmap(lambda group: walk(stacks, group)[1])(rows)
    else:
        # One group's stacks serve the next: only their bottom is read before it is written.
        groups = None if live is None else (live + (options.interleave - 1)) // options.interleave
        walked = scanned(walk, stacks, rows, groups)
    t, name, counters, counted = (a.reshape(a.shape[0] * a.shape[1], *a.shape[2:]) for a in walked)
    if options.any_hit:
        t = jnp.zeros(0)
    return Traced(t, name, counters, counted.reshape(-1))


def scanned(
    step: Callable[[Any, Array], tuple[Any, Any]], carried: Any, rows: Array, count: Array | None
) -> Any:
    """What a step says of each row, as by `lax.scan`; of the first `count` rows if that is not None.

    A step is given what the one before leaves, and a row; it returns what it leaves, and what is said.
    """
    if count is None:
        return lax.scan(step, carried, rows)[1]
    told = jax.eval_shape(step, carried, rows[0])[1]
    room = jax.tree.map(lambda each: jnp.zeros((len(rows), *each.shape), each.dtype), told)

    def turn(state: tuple[Array, Any, Any]) -> tuple[Array, Any, Any]:
        place, carried, said = state
        carried, one = step(carried, lax.dynamic_index_in_dim(rows, index(place), keepdims=False))
        said = jax.tree.map(partial(_put, place), said, one)
        return place + 1, carried, said

    return lax.while_loop(lambda state: state[0] < count, turn, (jnp.int32(0), carried, room))[2]


def _put(place: Array, values: Array, value: Array) -> Array:
    """Values with one in a place."""
    return lax.dynamic_update_index_in_dim(values, value, index(place), 0)


def empty_stack(scene: Any, options: WalkOptions) -> Array:
    """The stack of a ray that has nothing left to visit: at its bottom is the last node, with no lanes."""
    # A power of two, for the mask of `_entry`.
    size = 1 << (options.stack_size - 1).bit_length()
    return jnp.zeros((size, 2), jnp.int32).at[0, 0].set(scene.node_count - 1)


def prepared_ray(scene: Any, origin: Array, direction: Array, t_max: Array, root: Array) -> Array:
    """One ready ray that starts at any node: (24,) float32."""
    floats, ints = _prepare(scene, origin, direction, t_max)
    start = (jnp.arange(len(ints)) == START) & (ints != 0)
    ints = jnp.where(start, ints ^ root, ints)
    return jnp.concatenate([floats, lax.bitcast_convert_type(ints, jnp.float32)])


def _prepare(scene: WalkScene, origin: Array, direction: Array, t_max: Array) -> tuple[Array, Array]:
    """Floats and ints of a `ReadyRay`."""
    floats, ints = ready_words(scene.frame, origin, direction, t_max)
    zero = jnp.int32(0)
    return jnp.stack(floats), jnp.stack([*ints, zero, zero])


def ready_words(
    frame: Frame,
    origin: Coordinates,
    direction: Coordinates,
    t_max: Array,
    arithmetic: Arithmetic = BY_XLA,
) -> tuple[list[Array], list[Array]]:
    """The 17 floats of a `ReadyRay`, or of many at once, and its first five integers.

    A ray is scaled by powers of two: neither the model's unit nor the direction's length matters after that.

    Args:
        frame: Of the scene.
        origin: Three float32.
        direction: Three float32.
        t_max: Float32.
        arithmetic: Of the compiler at hand.
    """
    longest = largest_of(direction)
    shorten, length = power_of_two_below(longest)
    origin, direction, finite = scaled_ray(frame, origin, direction)
    valid = finite & (longest >= np.finfo(np.float32).tiny) & (t_max > 0)
    octant = jnp.full_like(valid, 7, jnp.int32)
    for bit, way in zip((1, 2, 4), direction, strict=True):
        octant = octant ^ jnp.where(way < 0, jnp.int32(bit), jnp.int32(0))
    slab = slab_of(origin, direction, frame)
    shear = shear_of(origin, direction, arithmetic)
    limit = t_max * length * frame.scale
    unit = arithmetic.quotient(shorten, jnp.broadcast_to(frame.scale, shorten.shape))
    floats = [*slab.low, *slab.high, *slab.inverse, *shear.origin, shear.x, shear.y, shear.z, limit, unit]
    axes = (axis.astype(jnp.int32) for axis in shear.axes)
    return floats, [*axes, octant, jnp.where(valid, DONE, jnp.int32(0))]


def largest_of(vector: Coordinates) -> Array:
    """The largest of three coordinates, in size."""
    return larger(larger(abs(vector[0]), abs(vector[1])), abs(vector[2]))


def scaled_ray(
    frame: Frame, origin: Coordinates, direction: Coordinates
) -> tuple[Coordinates, Coordinates, Array]:
    """A ray scaled by powers of two, the direction's largest component to 1 to 2; whether it is finite."""
    shorten = power_of_two_below(largest_of(direction))[0]
    ox, oy, oz = (at * frame.scale for at in origin)
    finite = jnp.ones_like(shorten, bool)
    for at in (ox, oy, oz, *direction):
        finite = finite & (abs(at) <= HIGHEST)
    x, y, z = (way * shorten for way in direction)
    return (ox, oy, oz), (x, y, z), finite


def entry_at(stack: Array, height: Array) -> tuple[Array, Array]:
    """The node and its lanes left of an entry of a stack."""
    entry = lax.dynamic_slice(stack, (_entry(stack, height), jnp.uint32(0)), (1, 2))[0]
    return entry[0], entry[1]


def with_entry(stack: Array, height: Array, node: Array, lanes: Array) -> Array:
    """A stack with an entry in a place."""
    entry = jnp.stack([node, lanes])[None]
    return lax.dynamic_update_slice(stack, entry, (_entry(stack, height), jnp.uint32(0)))


def _entry(stack: Array, height: Array) -> Array:
    """The place of an entry in a stack of 2**k: the mask tells the compiler that it is inside."""
    return index(height & (len(stack) - 1))


def take_child(scene: WalkScene, octant: Array, node: Array, lanes: Array) -> tuple[Array, Array, Array]:
    """The child in the nearest lane left, that lane, and the lanes without it."""
    zeros = lax.clz(lanes)
    # 31 less the zeros is the place of the bit.
    lane = index(zeros ^ 31 ^ mirror_of(octant, scene.width))
    left = lanes ^ lax.shift_right_logical(jnp.int32(-(2**31)), zeros & 31)
    return scene.child_of(node, lane), lane, left


def lowered(height: Array, empty: Array) -> Array:
    """The height of a stack, one less where its topmost entry is empty, but not below the bottom."""
    lower = height - empty.astype(jnp.int32)
    return jnp.where(lower < 0, 0, lower)


def step_down(
    scene: WalkScene, octant: Array, node: Array, lanes: Array, height: Array, stack: Array
) -> tuple[Place, Array, Array, Array]:
    """Go on from a node at its nearest lane met, or at the topmost entry of the stack where none was met.

    Without a branch: which it is cannot be guessed.

    Args:
        scene: What is walked.
        octant: Of the ray.
        node: The one visited.
        lanes: Those met, as bits in the order of visits.
        height: Of the topmost entry.
        stack: (2**k, 2) int32.

    Returns:
        The place, the node and the lane that its child is in, and the stack.
    """
    below = entry_at(stack, height)
    # Shifted by one, or the compiler makes a branch of each choice: no lane has the highest bit.
    none = (lanes << 1) == 0
    node = kept(jnp.where(none, below[0], node))
    height = kept(jnp.where(none, height, height + 1))
    child, lane, left = take_child(scene, octant, node, kept(jnp.where(none, below[1], lanes)))
    stack = with_entry(stack, height, node, left)
    return Place(child, lowered(height, left == 0)), node, lane, stack


def leave_leaf(
    scene: WalkScene, octant: Array, place: Place, stack: Array
) -> tuple[Place, Array, Array, Array]:
    """Go on from a leaf at the topmost entry of the stack; from anywhere else stay.

    Not in a cond, where the stack would be copied. Returns what `step_down` does.
    """
    node, lanes = map(kept, entry_at(stack, place.height))
    child, lane, left = take_child(scene, octant, node, lanes)
    there = names_leaf(place.child)
    stack = with_entry(stack, place.height, node, jnp.where(there, left, lanes))
    height = lowered(place.height, there & (left == 0))
    return Place(jnp.where(there, child, place.child), height), node, lane, stack


def _visit_node(
    scene: WalkScene, ray: ReadyRay, place: Place, limit: Array, stack: Array
) -> tuple[Place, Array]:
    """Test the boxes of a node's children, and choose the next child."""
    # No ray is at a leaf, but one may be done: it goes through the motions, and no box is near enough.
    limit = jnp.where(place.child >= 0, limit, np.float32(-1))
    met = scene.lanes_met(place.child, ray.slab, limit)
    lanes = jnp.sum(jnp.where(met, lane_bits_of(ray.octant, scene.width), 0))
    there, _, _, stack = step_down(scene, ray.octant, place.child, lanes, place.height, stack)
    return there, stack


def nearer(best: Best, t: Array, name: Array, faces_of: Callable[[Array], Array] | None = None) -> Best:
    """The closest hit, with those on eight triangles; of hits at the same t that of the least face.

    Args:
        best: So far.
        t: (8,) float32, positive and finite only where there is a hit.
        name: (8,) int32.
        faces_of: Where names are not faces, the faces of (8,) names.
    """
    hit = (t > 0) & (t <= best.nearest)
    found = _least(best, t, name, hit)
    if faces_of is None:
        return found
    tied = hit & (t == found.nearest)
    alone = jnp.where(found.nearest < best.nearest, np.int32(1), np.int32(0))
    several = jnp.sum(jnp.where(tied, np.int32(1), np.int32(0))) > alone
    # As long as nothing is found, what is infinitely far may count as a hit.
    several = several & (found.nearest <= HIGHEST)
    first = partial(_first_by_face, faces_of, best, found, tied, name)
    return found._replace(name=lax.cond(several, first, lambda: found.name))


def _least(best: Best, t: Array, name: Array, hit: Array) -> Best:
    """By one number for both: of a t that is not negative the bits are ordered as it is."""
    with jax.enable_x64(True):

        def number(t: Array, name: Array) -> Array:
            bits = lax.bitcast_convert_type(t, jnp.int32).astype(jnp.int64)
            return bits << 32 | (name + np.int32(1)).astype(jnp.uint32).astype(jnp.int64)

        none = np.int64(2**63 - 1)
        least = lax.reduce(jnp.where(hit, number(t, name), none), none, lax.min, (0,))
        least = lax.min(least, number(best.nearest, best.name))
        nearest = lax.bitcast_convert_type((least >> 32).astype(jnp.int32), jnp.float32)
        return Best(nearest, least.astype(jnp.int32) - np.int32(1))


def _first_by_face(
    faces_of: Callable[[Array], Array], best: Best, found: Best, tied: Array, name: Array
) -> Array:
    """Of hits at the same t, `tied` ones and maybe the best so far, the name of that of the least face."""
    faces = jnp.where(tied, faces_of(jnp.where(tied, name, 0)), NO_NAME)
    face = folded(faces, smaller)
    first = folded(jnp.where(faces == face, name, NO_NAME), smaller)
    before = faces_of(jnp.full(WIDTH, best.name))[0]
    return jnp.where((found.nearest < best.nearest) | (face < before), first, best.name)


def found_in(
    at_hand: Callable[[], Leaf],
    ray: Sighted,
    best: Best,
    options: "WalkOptions",
    faces_of: Callable[[Array], Array] | None = None,
) -> Best:
    """What is found with the triangles of a leaf, against the closest hit so far.

    Args:
        at_hand: Makes the leaf.
        ray: Which has a shear; it is asked for where it is used, or a cond keeps each number for itself.
        best: So far.
        options: By which test, and whether any hit will do.
        faces_of: As of `nearer`.
    """
    leaf = at_hand()
    t = leaf.crossings(ray.shear, test=options.test, again=at_hand)
    return found_any(best, t) if options.any_hit else nearer(best, t, leaf.name, faces_of)


def sifted(
    at_hand: Callable[[], Leaf],
    ray: Sighted,
    best: Best,
    options: "WalkOptions",
    faces_of: Callable[[Array], Array] | None = None,
) -> Best:
    """What is `found_in` a leaf, or `best` where none of its triangles can be nearer.

    For rays one by one and the default test: else it is `found_in` alone. The leaf is made twice, as what is
    kept for a cond goes through memory.
    """

    def found() -> Best:
        return found_in(at_hand, ray, best, options, faces_of)

    if options.batch or options.test != "watertight":
        return found()
    return lax.cond(any_lane(at_hand().may_cross(ray.shear, best.nearest)), found, lambda: best)


def found_any(best: Best, t: Array) -> Best:
    """What any hit has found, with t of eight triangles: once it is something, `nearest` is zero."""
    hit = (t > 0) & (t < best.nearest)
    return best._replace(nearest=jnp.where(any_lane(hit), np.float32(0), best.nearest))


class _Walked(NamedTuple):
    """One entry for each ray of a group, as in `Traced`."""

    t: Array
    name: Array
    counters: Array
    counted: Array


class _State(NamedTuple):
    """Where the rays of a group are: what an inner loop carries. It counts its turns, and of a ray visits."""

    places: tuple[Place, ...]
    stacks: tuple[Array, ...]
    turns: Array
    visits: tuple[Array, ...]


@dataclass(frozen=True)
class _Walk:
    """The steps of the walk of one group of rays."""

    scene: WalkScene
    group: Array
    options: WalkOptions

    @property
    def rays(self) -> tuple[ReadyRay, ...]:
        """They are cut from the group where they are used."""
        count = self.options.interleave
        return tuple(ReadyRay(self.group, k, count) for k in range(count))

    def goes_on(self, state: _State, at: Callable[[Place], Array]) -> Array:
        """Whether any ray is `at` a place, and the walk within its bound: each ray at each node once."""
        found = jnp.bool_(False)
        for place in state.places:
            found = found | at(place)
        return found & (state.turns <= len(self.rays) * self.scene.node_count)

    def is_among_nodes(self, state: _State) -> Array:
        """Whether some ray is at an inner node and none at a leaf: one that is there is not kept waiting."""
        none_at_leaf = jnp.bool_(True)
        for place in state.places:
            none_at_leaf = none_at_leaf & ~names_leaf(place.child)
        return none_at_leaf & self.goes_on(state, lambda place: place.child >= 0)

    def visit_nodes(self, state: _State, bests: tuple[Found, ...]) -> _State:
        """Each ray that is at an inner node visits it."""
        visits = [
            _visit_node(self.scene, *each)
            for each in zip(
                self.rays, state.places, [best.nearest * SLACK for best in bests], state.stacks, strict=True
            )
        ]
        places, stacks = tuple(v[0] for v in visits), tuple(v[1] for v in visits)
        at_node = [place.child >= 0 for place in state.places]
        return _State(places, stacks, state.turns + 1, self.count(state.visits, at_node, _A_NODE))

    def visit_leaves(self, state: _State, bests: tuple[Found, ...]) -> tuple[_State, tuple[Found, ...]]:
        """Each ray that is at a leaf tests it and goes on."""
        at_leaf = [names_leaf(place.child) for place in state.places]
        # Found for all rays at once: one's loads go on while another's are waited for.
        where = [self.scene.find_leaf(place.child) for place in state.places]
        bests = tuple(
            lax.cond(at_leaf[k], partial(self.test_leaf, k, bests[k], where[k]), partial(self.stay, bests[k]))
            for k in range(len(bests))
        )
        after = [
            self.leave_leaf(*each) for each in zip(self.rays, state.places, state.stacks, bests, strict=True)
        ]
        visits = self.count(state.visits, at_leaf, _A_LEAF)
        if visits:
            tested = [
                jnp.where(there, self.scene.triangles_of(leaf), 0)
                for there, leaf in zip(at_leaf, where, strict=True)
            ]
            visits = tuple(each + _A_TRIANGLE * count for each, count in zip(visits, tested, strict=True))
        return _State(tuple(a[0] for a in after), tuple(a[1] for a in after), state.turns, visits), bests

    def test_leaf(self, k: int, best: Found, where: Any) -> Found:
        """Ray k tests its leaf."""
        ray = self.rays[k]
        if isinstance(best, Gathered):
            return gather_leaf(self.scene, ray.shear, ray.t_max, where, best, self.options)
        return self.scene.visit_leaf(ray, where, best, self.options)

    def stay(self, best: Found) -> Found:
        """A ray that is at no leaf finds nothing."""
        return best

    def leave_leaf(self, ray: ReadyRay, place: Place, stack: Array, best: Found) -> tuple[Place, Array]:
        """A ray that is at a leaf takes the next child, one that has found what will do none."""
        (child, height), _, _, stack = leave_leaf(self.scene, ray.octant, place, stack)
        if self.options.any_hit:
            found = best.nearest < ray.t_max
            child, height = jnp.where(found, DONE, child), jnp.where(found, 0, height)
        return Place(child, height), stack

    def count(
        self, visits: tuple[Array, ...], there: list[Array], one: Int32[np.ndarray, " 3"]
    ) -> tuple[Array, ...]:
        """Add a visit to each ray that made one, where visits are counted."""
        if not visits:
            return ()
        return tuple(each + one * moved for each, moved in zip(visits, there, strict=True))


def _walk_group(
    scene: WalkScene, group: Array, stacks: tuple[Array, ...], options: WalkOptions
) -> tuple[tuple[Array, ...], _Walked]:
    """Walk `options.interleave` rays side by side."""
    walk = _Walk(scene, group, options)
    rays = walk.rays
    state, bests = _walked(walk, stacks, tuple(_nothing_found(ray, options) for ray in rays))
    results = [_result(scene, *each, options.any_hit) for each in zip(rays, state.places, bests, strict=True)]
    t, name, count = (jnp.stack([r[k] for r in results]) for k in range(3))
    counters = jnp.zeros((len(rays), 0), jnp.int32)
    if state.visits:
        counters = jnp.stack([jnp.stack(scene.counters_of(*each)) for each in state.visits])
    return state.stacks, _Walked(t, name, counters, count)


def _walked(walk: _Walk, stacks: tuple[Array, ...], bests: tuple[Any, ...]) -> tuple[_State, tuple[Any, ...]]:
    """Walk until no ray has anything left to visit."""
    stacks = tuple(
        with_entry(stack, jnp.int32(1), jnp.int32(0), ray.rest)
        for stack, ray in zip(stacks, walk.rays, strict=True)
    )
    places = tuple(Place(ray.first, (ray.rest != 0).astype(jnp.int32)) for ray in walk.rays)
    visits = tuple(ray.visited * _A_NODE for ray in walk.rays) if walk.options.counting else ()

    def nodes_then_leaves(carried: tuple[_State, tuple[Any, ...]]) -> tuple[_State, tuple[Any, ...]]:
        state, bests = carried
        state = lax.while_loop(walk.is_among_nodes, lambda s: walk.visit_nodes(s, bests), state)
        return walk.visit_leaves(state, bests)

    return lax.while_loop(
        lambda carried: walk.goes_on(carried[0], lambda place: place.child != DONE),
        nodes_then_leaves,
        (_State(places, stacks, jnp.int32(0), visits), bests),
    )


class Alone(NamedTuple):
    """The end of the walk of one ray, from any node on: `ended` within the bound, what was visited, (3,)."""

    ray: ReadyRay
    ended: Array
    best: Any
    visits: Array


def walk_alone(
    scene: Any, row: Array, options: WalkOptions, nothing: Callable[[ReadyRay], Any] | None = None
) -> Alone:
    """Walk one ray.

    Args:
        scene: What to trace: of `WalkScene` what the walk asks.
        row: (24,) float32, as from `prepared_ray`.
        options: What to compile in.
        nothing: What the ray has found before; None for no triangle.
    """
    ray = ReadyRay(row)
    best = _nothing_found(ray, options) if nothing is None else nothing(ray)
    state, bests = _walked(
        _Walk(scene, row, options._replace(interleave=1)), (empty_stack(scene, options),), (best,)
    )
    visits = state.visits[0] if state.visits else jnp.zeros(3, jnp.int32)
    return Alone(ray, state.places[0].child == DONE, bests[0], visits)


def found_alone(scene: Any, end: Alone, any_hit: bool) -> tuple[Array, Array]:
    """What is reported of the walk of one ray: t in the caller's units, and the name of the triangle."""
    child = jnp.where(end.ended, DONE, 0)
    place = Place(child, child)
    return _result(scene, end.ray, place, end.best, any_hit)[:2]


def nothing_yet(ray: ReadyRay) -> Best:
    """What a ray has found before its walk."""
    return Best(ray.t_max, jnp.int32(MISS))


def _nothing_found(ray: ReadyRay, options: WalkOptions) -> Found:
    """What a walk has found before it starts."""
    if options.gather is not None:
        return nothing_gathered(ray.t_max, options.most)
    return nothing_yet(ray)


def _result(
    scene: WalkScene, ray: ReadyRay, place: Place, best: Found, any_hit: bool
) -> tuple[Array, Array, Array]:
    """What is reported of a ray: t in the caller's units, the name of the triangle, what was counted."""
    if isinstance(best, Gathered):
        t, name, count = best.t, best.name, best.counted
    elif any_hit:
        t, name = best.nearest, jnp.where(best.nearest < ray.t_max, HIT, MISS)
        count = jnp.zeros(0, jnp.int32)
    else:
        t, name, count = best.nearest, best.name, jnp.zeros(0, jnp.int32)
    t = jnp.where(name < 0, jnp.float32(jnp.inf), in_range(t * ray.t_unit))
    return t, jnp.where(place.child != DONE, STUCK, name), count
