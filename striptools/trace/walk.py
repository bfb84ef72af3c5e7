"""The walk of rays through an eight-wide hierarchy: a function of a few rays, compiled to one native loop.

What nodes and leaves look like is the scene's affair (`WalkScene`): `walk_wide` has boxes and corners in
float32, `walk_packed` the compressed blocks of a scene file.

Nodes, octant order and the stack of (node, lanes left) follow Ylitie, Karras & Laine, "Efficient Incoherent
Ray Traversal on GPUs Through Compressed Wide BVHs" (HPG 2017), section 3.

Differences:

1. A few rays go side by side in one instruction stream, so that one's arithmetic fills the other's waits:
   two on a CPU, one on a GPU. A ray that has reached a leaf, or its end, waits while another is at inner
   nodes.
2. Leaves are tested eight triangles at once, each lane keeping its own closest hit until the walk ends.
3. A box is left out only where it is farther than the closest hit by more than `SLACK`, and of two hits at
   the same t the one of the smaller face is kept: the result does not depend on the order of visits.

What the assembly taught: every value that a loop carries costs loads and stores in each turn; a stack
inside a `lax.cond` is copied; a loop is hoisted only while nothing in it scatters, sorts or calls back.

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

from striptools.trace.box import Slab, slab_of
from striptools.trace.numerics import folded, index, larger, power_of_two_below, quotient, smaller
from striptools.trace.triangle import Shear, shear_of

WIDTH = 8
FLOATS = 17
"""Float32 words at the head of a ready ray; int32 words follow."""

DONE = np.int32(-(2**31))
"""The next child of a ray that has nothing left to visit."""

MISS = np.int32(-1)
STUCK = np.int32(-2)
"""The name of a ray whose walk did not end within the bound."""

NO_NAME = np.int32(2**31 - 1)
SLACK = np.float32(1 + 2**-20)


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
    """The closest hit of all, or t_max, and that in each lane, (8,): `name` is what the scene calls it."""

    nearest: Array
    t: Array
    name: Array


class WalkScene(Protocol):
    """What a walk asks of a scene: a NamedTuple of arrays on a device."""

    @property
    def frame(self) -> Frame:
        """How rays are seen."""
        ...

    @property
    def node_count(self) -> int:
        """Nodes; the last one is none."""
        ...

    @property
    def has_faces(self) -> bool:
        """Whether names are triangles in file order, and faces something else."""
        ...

    def faces_of(self, names: Array) -> Array:
        """(8,) int32: the faces of hits, negative where there is none."""
        ...

    def lanes_met(self, node: Array, slab: Slab, limit: Array) -> Array:
        """(8,) bool: the node's children whose boxes the ray meets, from 0 to `limit`."""
        ...

    def child_of(self, node: Array, lane: Array) -> Array:
        """The child in a lane: a node, or a negative number other than `DONE` that names a leaf."""
        ...

    def visit_leaf(self, shear: Shear, child: Array, best: Best, options: "WalkOptions") -> Best:
        """Test the triangles of a leaf, each lane against its own closest hit."""
        ...


class WalkOptions(NamedTuple):
    """What is compiled in.

    Attributes:
        interleave: Rays that go side by side.
        any_hit: End at the first hit.
        count_steps: Count nodes and leaves visited.
        stack_size: Entries of the stack: the depth of the tree and two more.
        batch: Walk all rays at once by vmap (GPU), not one group after the other (CPU).
        decode: How leaves are decoded, where they are packed.
        kernel: Walk by the GPU kernel of `trace.pallas`, whose twin `batch` is.
    """

    interleave: int
    any_hit: bool
    count_steps: bool
    stack_size: int
    batch: bool = False
    decode: "Decode | None" = None
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
    """One entry a ray; what was not asked for has none. `name` is what the scene calls the triangle hit."""

    t: Array
    name: Array
    steps: Array


class _Ray(NamedTuple):
    """What stays the same all along a walk, in as few arrays as can be: a loop pays for each.

    Attributes:
        floats: (17,) float32: what the properties name.
        ints: (7,) int32: axes of the shear, mirror, and where the walk starts: exclusive-or of `DONE` and
            the child to visit first (zeros are a ray that is done), the root's lanes left, nodes visited.
        lane_bits: (8,) int32, the bit that stands for each lane, the nearest highest.
    """

    floats: Array
    ints: Array
    lane_bits: Array

    @property
    def slab(self) -> Slab:
        return Slab(self.floats[0:3], self.floats[3:6], self.floats[6:9])

    @property
    def shear(self) -> Shear:
        x, y, z = (index(self.ints[k]) for k in range(3))
        origin = (self.floats[9], self.floats[10], self.floats[11])
        return Shear((x, y, z), origin, self.floats[12], self.floats[13], self.floats[14])

    @property
    def t_max(self) -> Array:
        return self.floats[15]

    @property
    def t_unit(self) -> Array:
        """T of the walk in units of the caller's t."""
        return self.floats[16]

    @property
    def mirror(self) -> Array:
        """Exclusive-or of a lane and its place in the order of visits, nearest 7."""
        return self.ints[3]

    @property
    def start(self) -> "_Place":
        return _Place(self.ints[4] ^ DONE, jnp.int32(0), self.ints[5], jnp.int32(1))

    @property
    def visited(self) -> Array:
        """Nodes visited before the walk starts."""
        return self.ints[6]


class _Place(NamedTuple):
    """Where a ray is: the child to visit next, and the lanes left of the node it came from."""

    child: Array
    node: Array
    lanes: Array
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
    return walk_rays(scene, prepared_rays(scene, origins, directions, t_max), options)


def prepared_rays(scene: WalkScene, origins: Array, directions: Array, t_max: Array) -> Array:
    """Ready rays for the walk: (r, 24) float32, the floats and the bits of the ints of `_Ray`."""
    floats, ints = jax.vmap(lambda *ray: _prepare(scene, *ray))(origins, directions, t_max)
    return jnp.concatenate([floats, lax.bitcast_convert_type(ints, jnp.float32)], axis=1)


def walk_rays(scene: WalkScene, ready: Array, options: WalkOptions) -> Traced:
    """Walk r rays, r a multiple of `options.interleave`, made ready here or by `kernels.rays`.

    Args:
        scene: What to trace.
        ready: (r, 24) float32, as from `prepared_rays`; rows of zeros are rays that end at once.
        options: What to compile in.
    """
    rows = ready.reshape(len(ready) // options.interleave, options.interleave, -1)
    end = scene.node_count - 1

    # The bottom of a stack is a node whose every child is DONE.
    floor = jnp.zeros((options.stack_size, 2), jnp.int32).at[0].set(jnp.array([end, 256], jnp.int32))
    stacks = (floor,) * options.interleave

    def walk(stacks: tuple[Array, ...], group: Array) -> tuple[tuple[Array, ...], _Walked]:
        return _walk_group(scene, group, stacks, options)

    if options.batch:
        walked = jax.vmap(lambda group: walk(stacks, group)[1])(rows)
    else:
        # One group's stacks serve the next: only their bottom is read before it is written.
        walked = lax.scan(walk, stacks, rows)[1]
    t, name, steps = (a.reshape(-1) for a in walked)
    if options.any_hit:
        t = jnp.zeros(0)
    return Traced(t, name, steps)


def _prepare(scene: WalkScene, origin: Array, direction: Array, t_max: Array) -> tuple[Array, Array]:
    """Floats and ints of a `_Ray`.

    A ray is scaled by powers of two: neither the model's unit nor the direction's length matters after that.
    """
    size = jnp.abs(direction)
    longest = larger(larger(size[0], size[1]), size[2])
    shorten, length = power_of_two_below(longest)
    frame = scene.frame
    origin = origin * frame.scale
    finite = jnp.isfinite(origin).all() & jnp.isfinite(direction).all()
    valid = finite & (longest >= np.finfo(np.float32).tiny) & (t_max > 0)
    direction = direction * shorten
    mirror = 7 ^ jnp.where(direction < 0, jnp.array([1, 2, 4], jnp.int32), 0).sum()
    slab = slab_of(origin, direction, frame)
    shear = shear_of(origin, direction)
    rest = [
        *shear.origin,
        shear.x,
        shear.y,
        shear.z,
        t_max * length * frame.scale,
        quotient(shorten, frame.scale),
    ]
    floats = jnp.concatenate([slab.low, slab.high, slab.inverse, jnp.stack(rest)])
    start = jnp.where(valid, DONE, 0)
    zero = jnp.int32(0)
    axes = (axis.astype(jnp.int32) for axis in shear.axes)
    return floats, jnp.stack([*axes, mirror, start, zero, zero])


def _next_child(
    scene: WalkScene, ray: _Ray, node: Array, lanes: Array, height: Array, stack: Array
) -> _Place:
    """Take the nearest lane left, of the node at hand or of the one on top of the stack."""
    empty = lanes == 0
    height = jnp.where(empty, height - 1, height)
    top = lax.dynamic_slice(stack, (index(height), jnp.uint32(0)), (1, 2))[0]
    node = jnp.where(empty, top[0], node)
    lanes = jnp.where(empty, top[1], lanes)
    order = 31 - lax.clz(lanes)
    child = scene.child_of(node, index(order ^ ray.mirror))
    return _Place(child, node, lanes ^ (jnp.int32(1) << order), height)


def _visit_node(
    scene: WalkScene, ray: _Ray, place: _Place, limit: Array, stack: Array
) -> tuple[_Place, Array]:
    """Put what is left of the last node on the stack, test this one's boxes, and choose the next child."""
    entry = jnp.stack([place.node, place.lanes])[None]
    stack = lax.dynamic_update_slice(stack, entry, (index(place.height), jnp.uint32(0)))
    height = jnp.where(place.lanes != 0, place.height + 1, place.height)
    met = scene.lanes_met(place.child, ray.slab, limit)
    lanes = jnp.sum(jnp.where(met, ray.lane_bits, 0))
    there = _next_child(scene, ray, place.child, lanes, height, stack)
    # A ray that waits at a leaf, or is done, goes through the motions and stays where it is.
    active = place.child >= 0
    return _Place(*(jnp.where(active, new, old) for new, old in zip(there, place, strict=True))), stack


def replaced(best: Best, closer: Array, t: Array, name: Array) -> Best:
    """The closest hits where `closer` says in which lanes new ones take their place."""
    t = jnp.where(closer, t, best.t)
    return Best(folded(t, smaller), t, jnp.where(closer, name, best.name))


def _closest_name(scene: WalkScene, best: Best, any_hit: bool) -> Array:
    """Of the lanes that hold the closest hit, the name of the least face; `MISS` where there is none."""
    held = (best.t == best.nearest) & (best.name >= 0)
    names = jnp.where(held, best.name, NO_NAME)
    least = folded(names, smaller)
    if scene.has_faces and not any_hit:
        several = folded(jnp.where(held, jnp.int32(1), jnp.int32(0)), jnp.add) > 1
        least = lax.cond(several, lambda: _name_of_least(scene, names), lambda: least)
    return jnp.where(least == NO_NAME, MISS, least)


def _name_of_least(scene: WalkScene, names: Array) -> Array:
    faces = jnp.where(names == NO_NAME, NO_NAME, scene.faces_of(names))
    return folded(jnp.where(faces == folded(faces, smaller), names, NO_NAME), smaller)


class _Walked(NamedTuple):
    """One entry for each ray of a group, as in `Traced`."""

    t: Array
    name: Array
    steps: Array


class _State(NamedTuple):
    """Where the rays of a group are: what an inner loop carries. It counts its turns, and steps of a ray."""

    places: tuple[_Place, ...]
    stacks: tuple[Array, ...]
    turns: Array
    steps: tuple[Array, ...]


@dataclass(frozen=True)
class _Walk:
    """The steps of the walk of one group of rays."""

    scene: WalkScene
    rays: tuple[_Ray, ...]
    options: WalkOptions

    def goes_on(self, state: _State, at: Callable[[_Place], Array]) -> Array:
        """Whether any ray is `at` a place, and the walk within its bound: each ray at each node once."""
        found = jnp.bool_(False)
        for place in state.places:
            found = found | at(place)
        return found & (state.turns <= len(self.rays) * self.scene.node_count)

    def visit_nodes(self, state: _State, bests: tuple[Best, ...]) -> _State:
        """Each ray that is at an inner node visits it."""
        visits = [
            _visit_node(self.scene, *each)
            for each in zip(
                self.rays, state.places, [best.nearest * SLACK for best in bests], state.stacks, strict=True
            )
        ]
        places, stacks = tuple(v[0] for v in visits), tuple(v[1] for v in visits)
        at_node = [place.child >= 0 for place in state.places]
        return _State(places, stacks, state.turns + 1, self.count(state.steps, at_node))

    def visit_leaves(self, state: _State, bests: tuple[Best, ...]) -> tuple[_State, tuple[Best, ...]]:
        """Each ray that is at a leaf tests it and goes on."""
        at_leaf = [(place.child < 0) & (place.child != DONE) for place in state.places]
        after = [
            lax.cond(
                at_leaf[k],
                partial(self.leave_leaf, k, state, bests[k]),
                partial(self.stay, k, state, bests[k]),
            )
            for k in range(len(self.rays))
        ]
        steps = self.count(state.steps, at_leaf)
        return state._replace(places=tuple(a[0] for a in after), steps=steps), tuple(a[1] for a in after)

    def leave_leaf(self, k: int, state: _State, best: Best) -> tuple[_Place, Best]:
        """Ray k tests its leaf and takes the next child. The stack is read here, never returned: no copy."""
        ray, place = self.rays[k], state.places[k]
        best = self.scene.visit_leaf(ray.shear, place.child, best, self.options)
        there = _next_child(self.scene, ray, place.node, place.lanes, place.height, state.stacks[k])
        if self.options.any_hit:
            there = there._replace(child=jnp.where(best.nearest < ray.t_max, DONE, there.child))
        return there, best

    def stay(self, k: int, state: _State, best: Best) -> tuple[_Place, Best]:
        """Ray k is at no leaf."""
        return state.places[k], best

    def count(self, steps: tuple[Array, ...], there: list[Array]) -> tuple[Array, ...]:
        """Add a step to each ray that took one, where steps are counted."""
        return tuple(step + moved for step, moved in zip(steps, there, strict=True)) if steps else ()


def _walk_group(
    scene: WalkScene, group: Array, stacks: tuple[Array, ...], options: WalkOptions
) -> tuple[tuple[Array, ...], _Walked]:
    """Walk `options.interleave` rays side by side."""
    lanes = jnp.arange(WIDTH, dtype=jnp.int32)
    floats = [row[:FLOATS] for row in group]
    words = [lax.bitcast_convert_type(row[FLOATS:], jnp.int32) for row in group]
    rays = tuple(
        _Ray(real, ints, jnp.int32(1) << (lanes ^ ints[3])) for real, ints in zip(floats, words, strict=True)
    )
    walk = _Walk(scene, rays, options)
    zero = jnp.int32(0)
    places = tuple(ray.start for ray in rays)
    bests = tuple(
        Best(ray.t_max, jnp.full(WIDTH, ray.t_max), jnp.full(WIDTH, MISS, jnp.int32)) for ray in rays
    )
    steps = tuple(ray.visited for ray in rays) if options.count_steps else ()

    def nodes_then_leaves(carried: tuple[_State, tuple[Best, ...]]) -> tuple[_State, tuple[Best, ...]]:
        state, bests = carried
        state = lax.while_loop(
            lambda s: walk.goes_on(s, lambda place: place.child >= 0),
            lambda s: walk.visit_nodes(s, bests),
            state,
        )
        return walk.visit_leaves(state, bests)

    state, bests = lax.while_loop(
        lambda carried: walk.goes_on(carried[0], lambda place: place.child != DONE),
        nodes_then_leaves,
        (_State(places, stacks, zero, steps), bests),
    )
    results = [_result(scene, *each, options.any_hit) for each in zip(rays, state.places, bests, strict=True)]
    t, name = (jnp.stack([r[k] for r in results]) for k in range(2))
    counted = jnp.stack(state.steps) if steps else jnp.zeros((len(rays), 0))
    return state.stacks, _Walked(t, name, counted)


def _result(scene: WalkScene, ray: _Ray, place: _Place, best: Best, any_hit: bool) -> tuple[Array, Array]:
    """What is reported of a ray: t in the caller's units, and the name of the triangle."""
    name = _closest_name(scene, best, any_hit)
    t = jnp.where(name < 0, jnp.float32(jnp.inf), best.nearest * ray.t_unit)
    return t, jnp.where(place.child != DONE, STUCK, name)
