"""The walk of one ray at a time through a binary hierarchy, near child first, with a stack.

A node of the walk is a cache line: the boxes of two children and what they are. Both are tested at once; the
farther one met waits on the stack with the distance at which the ray enters it, and is left out when its turn
comes where that has become farther than the closest hit. Boxes are seen and left out as in `walk`, so hits do
not depend on the order of visits, nor on the hierarchy.

The steps of a walk are bounded: a tree that goes round in a circle ends in `STUCK`, not in a hang.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from striptools.trace.box import entries_of
from striptools.trace.counters import Counters
from striptools.trace.numerics import index
from striptools.trace.walk import DONE, SLACK, Best, Frame, ReadyRay, Traced, WalkOptions, nothing_yet
from striptools.trace.walk_single import (
    BLOCK_BYTES,
    Ended,
    Leaves,
    no_counts,
    test_leaf,
    triangles_in_leaf,
    walk_each,
)

NODE_BYTES = 64


class _Place(NamedTuple):
    """Where a ray is.

    Attributes:
        child: The node or leaf to visit, `DONE` where the next one waits on the stack.
        height: Entries of the stack.
        stack: (k, 2) float32: the bits of what waits, and where the ray enters it.
        turns: Nodes visited.
    """

    child: Array
    height: Array
    stack: Array
    turns: Array


class BinaryScene(NamedTuple):
    """A scene under a binary hierarchy.

    Attributes:
        nodes: (m, 16) float32: low x, y, z and high x, y, z of the two children, first and second side by
            side, NaN where there is none; then the bits of what they are, int32: a node, or a leaf q as
            -(q + 1); then nothing. The root is node 0.
        leaves: The leaves; the last one is empty.
        frame: How rays are seen.
    """

    nodes: Any
    leaves: Leaves
    frame: Frame

    def walk_rays(self, ready: Array, options: WalkOptions, live: Array | None = None) -> Traced:
        """Walk r rays made ready."""
        return walk_each(self, ready, live, options, _walk, jnp.zeros((options.stack_size, 2), jnp.float32))


def _walk(scene: BinaryScene, ray: ReadyRay, stack: Array, options: WalkOptions) -> tuple[Array, Ended]:
    """Walk one ray."""
    bound = scene.nodes.shape[0]
    none = jnp.int32(-scene.leaves.first.shape[0] + 1)

    def goes_down(place: _Place) -> Array:
        return (place.child >= 0) & (place.turns <= bound)

    def down_then_leaf(carried: tuple[_Place, Best, Counters]) -> tuple[_Place, Best, Counters]:
        place, best, counted = carried
        limit = best.nearest * SLACK
        place = lax.while_loop(goes_down, lambda at: _visit(scene, ray, at, limit), place)

        # A ray that met nothing tests the leaf that is empty: no branch.
        leaf = index(-(jnp.where(place.child < 0, jnp.maximum(place.child, none), none) + 1))
        best = test_leaf(scene.leaves, leaf, ray, best)
        if options.counting:
            counted = _count_leaf(scene, leaf, counted)
        place = _pop(place, best.nearest * SLACK)
        if options.any_hit:
            place = place._replace(child=jnp.where(best.nearest < ray.t_max, DONE, place.child))
        return place, best, counted

    def goes_on(carried: tuple[_Place, Best, Counters]) -> Array:
        return (carried[0].child != DONE) & (carried[0].turns <= bound)

    start = _Place(ray.first, jnp.int32(0), stack, jnp.int32(0))
    place, best, counted = lax.while_loop(goes_on, down_then_leaf, (start, nothing_yet(ray), no_counts()))
    turns = place.turns
    counted = counted._replace(nodes=turns, boxes=2 * turns + 1, node_bytes=NODE_BYTES * turns)
    return place.stack, Ended(best, counted, place.child != DONE)


def _visit(scene: BinaryScene, ray: ReadyRay, place: _Place, limit: Array) -> _Place:
    """Test the boxes of both children; go to the nearer one met, and let the other wait."""
    node = lax.dynamic_slice(scene.nodes, (index(place.child), jnp.uint32(0)), (1, 16))[0]
    slab = ray.slab
    low = [node[2 * k : 2 * k + 2] * slab.inverse[k] - slab.low[k] for k in range(3)]
    high = [node[2 * k + 6 : 2 * k + 8] * slab.inverse[k] - slab.high[k] for k in range(3)]
    entry, met = entries_of(low, high, limit)
    child = lax.bitcast_convert_type(node[12:14], jnp.int32)
    second_first = met[1] & (~met[0] | (entry[1] < entry[0]))
    near, far = (jnp.where(second_first, child[k], child[1 - k]) for k in (1, 0))
    behind = jnp.where(second_first, entry[0], entry[1])

    # The farther child is written in any case, and counts where both are met.
    waits = jnp.stack([lax.bitcast_convert_type(far, jnp.float32), behind])
    stack = lax.dynamic_update_slice(place.stack, waits[None], (index(place.height), jnp.uint32(0)))
    height = place.height + (met[0] & met[1]).astype(jnp.int32)
    return _Place(jnp.where(met[0] | met[1], near, DONE), height, stack, place.turns + 1)


def _pop(place: _Place, limit: Array) -> _Place:
    """Take the entry that has waited least of those that are not too far, or `DONE`."""

    def entry(height: Array) -> Array:
        return lax.dynamic_slice(place.stack, (index(height - 1), jnp.uint32(0)), (1, 2))[0]

    height = lax.while_loop(
        lambda height: (height > 0) & ~(entry(jnp.maximum(height, 1))[1] <= limit),
        lambda height: height - 1,
        place.height,
    )
    child = lax.bitcast_convert_type(entry(jnp.maximum(height, 1))[0], jnp.int32)
    taken = height > 0
    return place._replace(child=jnp.where(taken, child, DONE), height=height - taken.astype(jnp.int32))


def _count_leaf(scene: BinaryScene, leaf: Array, counted: Counters) -> Counters:
    blocks = scene.leaves.first[leaf + 1] - scene.leaves.first[leaf]
    return counted._replace(
        leaves=counted.leaves + (blocks > 0),
        triangles=counted.triangles + triangles_in_leaf(scene.leaves, leaf),
        geometry_bytes=counted.geometry_bytes + BLOCK_BYTES * blocks,
    )
