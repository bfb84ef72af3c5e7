"""The walk through an SLBVH: a node and a trail of 32 bits are all that it knows.

Source: Murguia et al., "Bit-Trail Traversal for Stackless LBVH on DirectCompute" (GPU Pro 4, 2013). Each bit
of the trail stands for a level, the lowest for that of the node at hand: 0 where the node's sibling is still
to be visited, 1 where it has been. A step out of a node climbs over all levels that are done, and turns to
the sibling there.

Differences:
1. Node 0, which is none, is where a walk is when it has ended.
2. A box is left out only where it is farther than the closest hit by more than `SLACK`, and tested when it
   is visited: what was found in the near child counts when it is the far one's turn.
3. Visits are bounded by the number of nodes: a heap that is none ends in `STUCK`, not in a hang.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from striptools.hierarchies.slbvh import AXIS, LEAF, NODE_BYTES, PRIM_COUNT, PRIM_POS
from striptools.trace.box import passes
from striptools.trace.counters import Counters
from striptools.trace.walk import SLACK, Best, Frame, ReadyRay, Traced, WalkOptions, nothing_yet
from striptools.trace.walk_single import (
    BLOCK_BYTES,
    Ended,
    Leaves,
    is_live,
    no_counts,
    test_leaf,
    triangles_in_leaf,
    walk_each,
)

__all__ = ["NODE_BYTES", "Place", "SlbvhScene", "step_in", "step_out"]

REFERENCE_BYTES = 8
"""Where the blocks of a leaf begin and end."""


class Place(NamedTuple):
    """Where a ray is: () uint32 each, node 0 when it is done."""

    node: Array
    trail: Array


class _State(NamedTuple):
    """What a loop carries: the place, the leaf to test (for none the last, it is empty), and the visits."""

    place: Place
    leaf: Array
    turns: Array


class SlbvhScene(NamedTuple):
    """A scene as arrays on a device.

    Attributes:
        nodes: (2**d, 8) float32: boxes, scaled, then the bits of PrimCount and PrimPos; the latter is the
            number of a leaf.
        leaves: The last one is empty.
        frame: How rays are seen: boxes are counted from zero, in ones.
    """

    nodes: Any
    leaves: Leaves
    frame: Frame

    @property
    def no_leaf(self) -> Array:
        """() uint32: a leaf without triangles."""
        return jnp.uint32(len(self.leaves.first) - 2)

    def walk_rays(self, ready: Array, options: WalkOptions, live: Array | None = None) -> Traced:
        """Walk r rays made ready. There is no stack."""
        return walk_each(self, ready, live, options, _walk, jnp.zeros(0))


def step_in(place: Place, right: Array) -> Place:
    """Go from an inner node to one of its children: the right one where `right` is 1, else the left one."""
    return Place(place.node * 2 + right, place.trail << 1)


def step_out(place: Place) -> Place:
    """Go from a node that is done to the next one that is not."""
    done = place.trail + 1
    levels = lax.population_count(~done & (done - 1))
    trail = (place.trail >> levels) + 1
    return Place(jnp.where(trail <= 1, jnp.uint32(0), (place.node >> levels) ^ 1), trail)


def _walk(scene: SlbvhScene, ray: ReadyRay, stack: Array, options: WalkOptions) -> tuple[Array, Ended]:
    """Walk one ray: nodes until there is a leaf, then the leaf."""
    root = jnp.where(is_live(ray), jnp.uint32(1), jnp.uint32(0))
    begin = _State(Place(root, jnp.uint32(1)), scene.no_leaf, jnp.int32(0))
    counts = no_counts() if options.counting else ()

    def goes_on(state: _State) -> Array:
        return (state.place.node != 0) & (state.turns < len(scene.nodes))

    def nodes_then_leaf(carried: tuple[_State, Best, Any]) -> tuple[_State, Best, Any]:
        state, best, counts = carried
        limit = best.nearest * SLACK
        state = lax.while_loop(
            lambda s: goes_on(s) & (s.leaf == scene.no_leaf), lambda s: _visit(scene, ray, s, limit), state
        )
        best = test_leaf(scene.leaves, state.leaf, ray, best)
        place = state.place
        if options.any_hit:
            found = best.nearest < ray.t_max
            place = Place(jnp.where(found, jnp.uint32(0), place.node), jnp.where(found, 1, place.trail))
        if options.counting:
            counts = _counted(scene, state.leaf, counts)
        return _State(place, scene.no_leaf, state.turns), best, counts

    state, best, counts = lax.while_loop(
        lambda carried: goes_on(carried[0]), nodes_then_leaf, (begin, nothing_yet(ray), counts)
    )
    if options.counting:
        turns = state.turns
        counts = counts._replace(nodes=turns, boxes=turns, node_bytes=turns * NODE_BYTES)
    # A trail whose levels went beyond its bits is not left at 1.
    stuck = (state.place.node != 0) | (state.place.trail != 1)
    return stack, Ended(best, counts or no_counts(), stuck)


def _visit(scene: SlbvhScene, ray: ReadyRay, state: _State, limit: Array) -> _State:
    """Test the node's box, and go on: in, or out with the leaf in hand if it is one that is met."""
    place, slab = state.place, ray.slab

    def word(k: int) -> Array:
        return lax.dynamic_slice(scene.nodes, (place.node, jnp.uint32(k)), (1, 1))[0, 0]

    low = [word(axis) * slab.inverse[axis] - slab.low[axis] for axis in range(3)]
    high = [word(axis + 3) * slab.inverse[axis] - slab.high[axis] for axis in range(3)]
    met = passes(low, high, limit)
    prim_count = lax.bitcast_convert_type(word(PRIM_COUNT), jnp.uint32)
    leaf = prim_count & LEAF != 0

    def near() -> Place:
        # The left child where the ray runs along the axis, the right one where against.
        along = ray.octant.astype(jnp.uint32) >> (prim_count & AXIS)
        return step_in(place, ~along & 1)

    there = lax.cond(met & ~leaf, near, lambda: step_out(place))
    found = lax.cond(
        met & leaf,
        lambda: lax.bitcast_convert_type(word(PRIM_POS), jnp.uint32),
        lambda: scene.no_leaf,
    )
    return _State(there, found, state.turns + 1)


def _counted(scene: SlbvhScene, leaf: Array, counts: Counters) -> Counters:
    """Count a leaf, or none."""
    one = jnp.where(leaf == scene.no_leaf, 0, 1)
    blocks = scene.leaves.first[leaf + 1] - scene.leaves.first[leaf]
    return counts._replace(
        leaves=counts.leaves + one,
        triangles=counts.triangles + triangles_in_leaf(scene.leaves, leaf),
        geometry_bytes=counts.geometry_bytes + blocks * BLOCK_BYTES + one * REFERENCE_BYTES,
    )


# Notes. Tried on the dragon, one thread, Zen 4: rate over that of the eight-wide walk, camera / random rays.
# What stands here 0.73 / 0.66; a node as one row of eight words, and selects in the place of the branches
# 0.69 / 0.59 (a branch lets the processor guess the next node); three branches, with the step out of a leaf
# after its test 0.69 / 0.60; boxes as vectors of three, or words one by one, with selects 0.67 / 0.57. Leaves
# of one block each, without a loop, and no bound of the visits: no difference beyond the noise.
