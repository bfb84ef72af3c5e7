"""The walk of rays through an eight-wide hierarchy: a function of a few rays, compiled to one native loop.

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

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from striptools.trace.box import Slab, lanes_met, slab_of
from striptools.trace.numerics import index, larger, power_of_two_below, smaller
from striptools.trace.triangle import Shear, crossing_of, edges_of, shear_of

WIDTH = 8
DONE = np.int32(-(2**31))
"""The next child of a ray that has nothing left to visit."""

MISS = np.int32(-1)
STUCK = np.int32(-2)
"""The face of a ray whose walk did not end within the bound."""

NO_FACE = np.int32(2**31 - 1)
SLACK = np.float32(1 + 2**-20)


class WideScene(NamedTuple):
    """A scene as arrays on a device; sizes are padded so that scenes of like size share a compiled program.

    Attributes:
        boxes: (w, 6, 8) float32, NaN in empty lanes.
        child: (8 w + 16,) int32, as in `WideTree`, then `DONE`.
        blocks: (l, 9, 8) float32, corners of each leaf's triangles by lane, NaN in empty lanes.
        ids: (l, 8) int32, the face of each.
        place: (f,) int32, of each face: (leaf * 8 + lane) * 4 + turn, see `kernels.wide.fill_leaf_blocks`.
        scale: () float32, the power of two that positions were multiplied by.
        reach: () float32, the largest scaled coordinate.
    """

    boxes: Any
    child: Any
    blocks: Any
    ids: Any
    place: Any
    scale: Any
    reach: Any


class WalkOptions(NamedTuple):
    """What is compiled in.

    Attributes:
        interleave: Rays that go side by side.
        any_hit: End at the first hit.
        count_steps: Count nodes and leaves visited.
        stack_size: Entries of the stack: the depth of the tree and two more.
        batch: Walk all rays at once by vmap (GPU), not one group after the other (CPU).
    """

    interleave: int
    any_hit: bool
    count_steps: bool
    stack_size: int
    batch: bool = False


class Traced(NamedTuple):
    """One entry a ray; what was not asked for has no entries."""

    t: Array
    face: Array
    u: Array
    v: Array
    steps: Array


class _Ray(NamedTuple):
    """What stays the same all along a walk."""

    slab: Slab
    shear: Shear
    mirror: Array  # exclusive-or of a lane and its place in the order of visits
    lane_bits: Array
    t_max: Array
    t_unit: Array  # t of the walk in units of the caller's t
    valid: Array


class _Place(NamedTuple):
    """Where a ray is: the child to visit next, and the lanes left of the node it came from."""

    child: Array
    node: Array
    lanes: Array
    height: Array


class _Best(NamedTuple):
    """The closest hit in each lane, and the distance beyond which boxes do not matter."""

    limit: Array
    t: Array
    face: Array


def trace_rays(
    scene: WideScene, origins: Array, directions: Array, t_max: Array, options: WalkOptions
) -> Traced:
    """Trace r rays, r a multiple of `options.interleave`.

    Args:
        scene: What to trace.
        origins: (r, 3) float32.
        directions: (r, 3) float32.
        t_max: (r,) float32.
        options: What to compile in.
    """
    groups = len(origins) // options.interleave
    rays = (
        origins.reshape(groups, options.interleave, 3),
        directions.reshape(groups, options.interleave, 3),
        t_max.reshape(groups, options.interleave),
    )

    def walk(group: tuple[Array, Array, Array]) -> Traced:
        return _walk_group(scene, *group, options)

    traced = jax.vmap(walk)(rays) if options.batch else lax.map(walk, rays)
    return Traced(*(a.reshape(-1) for a in traced))


def _prepare(scene: WideScene, origin: Array, direction: Array, t_max: Array) -> _Ray:
    """Scale a ray by powers of two, so that neither the model's unit nor the direction's length matters."""
    size = jnp.abs(direction)
    longest = larger(larger(size[0], size[1]), size[2])
    shorten, length = power_of_two_below(longest)
    origin = origin * scene.scale
    finite = jnp.isfinite(origin).all() & jnp.isfinite(direction).all()
    valid = finite & (longest >= np.finfo(np.float32).tiny) & (t_max > 0)
    direction = direction * shorten
    octant = jnp.where(direction < 0, jnp.array([1, 2, 4], jnp.int32), 0).sum()
    mirror = 7 ^ octant
    lanes = jnp.arange(WIDTH, dtype=jnp.int32)
    return _Ray(
        slab_of(origin, direction, scene.reach),
        shear_of(origin, direction),
        mirror,
        jnp.int32(1) << (lanes ^ mirror),
        t_max * length * scene.scale,
        shorten / scene.scale,
        valid,
    )


def _next_child(
    scene: WideScene, ray: _Ray, node: Array, lanes: Array, height: Array, stack: Array
) -> _Place:
    """Take the nearest lane left, of the node at hand or of the one on top of the stack."""
    empty = lanes == 0
    height = jnp.where(empty, height - 1, height)
    top = lax.dynamic_slice(stack, (index(height), jnp.uint32(0)), (1, 2))[0]
    node = jnp.where(empty, top[0], node)
    lanes = jnp.where(empty, top[1], lanes)
    order = 31 - lax.clz(lanes)
    child = lax.dynamic_slice(scene.child, (index(node * WIDTH + (order ^ ray.mirror)),), (1,))[0]
    return _Place(child, node, lanes ^ (jnp.int32(1) << order), height)


def _visit_node(
    scene: WideScene, ray: _Ray, place: _Place, limit: Array, stack: Array
) -> tuple[_Place, Array]:
    """Put what is left of the last node on the stack, test this one's boxes, and choose the next child."""
    entry = jnp.stack([place.node, place.lanes])[None]
    stack = lax.dynamic_update_slice(stack, entry, (index(place.height), jnp.uint32(0)))
    height = jnp.where(place.lanes != 0, place.height + 1, place.height)
    boxes = lax.dynamic_slice(scene.boxes, (index(place.child), jnp.uint32(0), jnp.uint32(0)), (1, 6, WIDTH))[
        0
    ]
    lanes = jnp.sum(jnp.where(lanes_met(boxes, ray.slab, limit), ray.lane_bits, 0))
    there = _next_child(scene, ray, place.child, lanes, height, stack)
    # A ray that waits at a leaf, or is done, goes through the motions and stays where it is.
    active = place.child >= 0
    return _Place(*(jnp.where(active, new, old) for new, old in zip(there, place, strict=True))), stack


def _visit_leaf(scene: WideScene, ray: _Ray, child: Array, best: _Best, any_hit: bool) -> _Best:
    """Test the triangles of a leaf, each lane against its own closest hit."""
    leaf = index(-(child + 1))

    def corner(k: int, axis: Array) -> Array:
        return lax.dynamic_slice(
            scene.blocks, (leaf, axis + jnp.uint32(3 * k), jnp.uint32(0)), (1, 1, WIDTH)
        )[0, 0]

    inside, t = crossing_of(edges_of(corner, ray.shear))
    face = lax.dynamic_slice(scene.ids, (leaf, jnp.uint32(0)), (1, WIDTH))[0]
    closer = inside & (t > 0) & ((t < best.t) | ((t == best.t) & (face < best.face)))
    t = jnp.where(closer, t, best.t)
    face = jnp.where(closer, face, best.face)
    if any_hit:
        limit = jnp.where(jnp.sum(closer.astype(jnp.int32)) != 0, jnp.float32(-1), best.limit)
        return _Best(limit, t, face)
    nearest = t
    while len(nearest) > 1:
        half = len(nearest) // 2
        nearest = smaller(nearest[:half], nearest[half:])
    return _Best(nearest[0] * SLACK, t, face)


def _closest_lane(best: _Best) -> tuple[Array, Array]:
    """Least t, then least face, over the lanes."""
    t, face = best.t, jnp.where(best.face < 0, NO_FACE, best.face)
    while len(t) > 1:
        half = len(t) // 2
        first = (t[:half] < t[half:]) | ((t[:half] == t[half:]) & (face[:half] < face[half:]))
        t = jnp.where(first, t[:half], t[half:])
        face = jnp.where(first, face[:half], face[half:])
    return t[0], jnp.where(face[0] == NO_FACE, MISS, face[0])


def _weights(scene: WideScene, ray: _Ray, face: Array) -> tuple[Array, Array]:
    """The weights u and v of a hit, by the corners of the face that is reported."""
    place = lax.dynamic_slice(scene.place, (index(larger(face, jnp.int32(0))),), (1,))[0]
    leaf, lane, turn = place >> 5, (place >> 2) & 7, place & 3

    def corner(k: int, axis: Array) -> Array:
        return lax.dynamic_slice(
            scene.blocks, (index(leaf), axis + jnp.uint32(3 * k), index(lane)), (1, 1, 1)
        )[0, 0, 0]

    a, b, c, _ = edges_of(corner, ray.shear)
    whole = a + b + c
    whole = jnp.where((face < 0) | (whole == 0), jnp.float32(1), whole)
    a, b, c = a / whole, b / whole, c / whole
    u = jnp.where(turn == 0, b, jnp.where(turn == 1, a, c))
    v = jnp.where(turn == 0, c, jnp.where(turn == 1, b, a))
    return jnp.where(face < 0, 0, u), jnp.where(face < 0, 0, v)


def _walk_group(
    scene: WideScene, origins: Array, directions: Array, t_max: Array, options: WalkOptions
) -> Traced:
    """Walk `options.interleave` rays side by side."""
    count = options.interleave
    rays = [_prepare(scene, origins[k], directions[k], t_max[k]) for k in range(count)]
    end = len(scene.child) // WIDTH - 2
    bound = jnp.int32(count * len(scene.boxes) + 1)

    # The bottom of the stack is a node whose every child is DONE.
    floor = jnp.zeros((options.stack_size, 2), jnp.int32).at[0].set(jnp.array([end, 256], jnp.int32))
    places = tuple(
        _Place(jnp.where(ray.valid, jnp.int32(0), DONE), jnp.int32(0), jnp.int32(0), jnp.int32(1))
        for ray in rays
    )
    bests = tuple(
        _Best(ray.t_max * SLACK, jnp.full(WIDTH, ray.t_max, jnp.float32), jnp.full(WIDTH, MISS, jnp.int32))
        for ray in rays
    )
    steps = tuple(jnp.int32(0) for _ in rays) if options.count_steps else ()

    def any_at_node(state: tuple) -> Array:
        at_node = jnp.bool_(False)
        for place in state[0]:
            at_node = at_node | (place.child >= 0)
        return at_node & (state[2] < bound)

    def unfinished(state: tuple) -> Array:
        left = jnp.bool_(False)
        for place in state[0]:
            left = left | (place.child != DONE)
        return left & (state[2] < bound)

    def all_visit_nodes(bests: tuple[_Best, ...], state: tuple) -> tuple:
        places, stacks, turns, steps = state
        visits = [_visit_node(scene, rays[k], places[k], bests[k].limit, stacks[k]) for k in range(count)]
        steps = tuple(step + (places[k].child >= 0) for k, step in enumerate(steps))
        return tuple(v[0] for v in visits), tuple(v[1] for v in visits), turns + 1, steps

    def leave_leaf(k: int, place: _Place, stack: Array, best: _Best) -> tuple[_Place, _Best]:
        best = _visit_leaf(scene, rays[k], place.child, best, options.any_hit)
        there = _next_child(scene, rays[k], place.node, place.lanes, place.height, stack)
        if options.any_hit:
            there = there._replace(child=jnp.where(best.limit < 0, DONE, there.child))
        return there, best

    def nodes_then_leaves(state: tuple) -> tuple:
        places, stacks, turns, steps, bests = state
        places, stacks, turns, steps = lax.while_loop(
            any_at_node, lambda s: all_visit_nodes(bests, s), (places, stacks, turns, steps)
        )
        after = []
        for k in range(count):
            at_leaf = (places[k].child < 0) & (places[k].child != DONE)
            after.append(
                lax.cond(
                    at_leaf,
                    lambda k=k: leave_leaf(k, places[k], stacks[k], bests[k]),
                    lambda k=k: (places[k], bests[k]),
                )
            )
            if steps:
                steps = (*steps[:k], steps[k] + at_leaf, *steps[k + 1 :])
        return tuple(a[0] for a in after), stacks, turns, steps, tuple(a[1] for a in after)

    places, _, _, steps, bests = lax.while_loop(
        unfinished, nodes_then_leaves, (places, tuple(floor for _ in rays), jnp.int32(0), steps, bests)
    )
    results = [_result(scene, *each, options) for each in zip(rays, places, bests, strict=True)]
    t, face, u, v = (jnp.stack([r[k] for r in results]) for k in range(4))
    nothing = jnp.zeros((count, 0))
    if options.any_hit:
        return Traced(nothing, face, nothing, nothing, nothing)
    return Traced(t, face, u, v, jnp.stack(steps) if steps else nothing)


def _result(
    scene: WideScene, ray: _Ray, place: _Place, best: _Best, options: WalkOptions
) -> tuple[Array, Array, Array, Array]:
    """What is reported of a ray: t in the caller's units, face, u and v."""
    t, face = _closest_lane(best)
    u, v = (jnp.float32(0), jnp.float32(0)) if options.any_hit else _weights(scene, ray, face)
    t = jnp.where(face < 0, jnp.float32(jnp.inf), t * ray.t_unit)
    return t, jnp.where(place.child != DONE, STUCK, face), u, v
