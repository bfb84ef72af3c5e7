"""Walks that follow one ray at a time: what those of the other hierarchies share.

A walk is a function of one ready ray, compiled to a native loop on a CPU (one ray after the other) and
batched by vmap on a GPU. What it may do is told in `walk`: nothing in its loop scatters, sorts or calls back.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from striptools.trace.counters import KINDS, Counters
from striptools.trace.leaf_blocks import test_block, triangles_in
from striptools.trace.numerics import in_range, index
from striptools.trace.walk import DONE, STUCK, WIDTH, Best, ReadyRay, Traced, WalkOptions, scanned


class Leaves(NamedTuple):
    """Leaves of any size: rows of leaf blocks.

    Attributes:
        blocks: (l, 10, 8) float32, see `leaf_blocks`.
        first: (k+1,) int32, the first block of each leaf, then their end; of as many leaves as there are and
            those that fill up the size class, which are empty.
    """

    blocks: Any
    first: Any


class Ended(NamedTuple):
    """How a walk ended.

    Attributes:
        best: The closest hit.
        counters: Of the ray; anything where nothing is counted.
        stuck: () bool, the walk was stopped at its bound.
    """

    best: Best
    counters: Counters
    stuck: Array


Walk = Callable[[Any, ReadyRay, Array, WalkOptions], tuple[Array, Ended]]
"""A walk of a scene, a live ray and a stack to the stack as it is left and how it ended."""


def walk_each(
    scene: Any, ready: Array, live: Array | None, options: WalkOptions, walk: Walk, stack: Array
) -> Traced:
    """Walk r rays by a function of one.

    Args:
        scene: What to trace.
        ready: (r, 24) float32, as from `walk.prepared_rays`; rows of zeros are rays that end at once.
        live: As of `walk.walk_rays`.
        options: What to compile in.
        walk: Of one ray. It is called for rays that are none too, of which it is told by `is_live`, and
            should end at once.
        stack: What a walk is given to write on: of any shape, without entries where it needs none. Ray after
            ray uses the same; what one leaves the next must not need.
    """

    def one(stack: Array, row: Array) -> tuple[Array, tuple[Array, Array, Array]]:
        ray = ReadyRay(row)
        stack, ended = walk(scene, ray, stack, options)
        name = ended.best.name
        t = jnp.where(name < 0, jnp.float32(jnp.inf), in_range(ended.best.nearest * ray.t_unit))
        counted = jnp.stack([jnp.asarray(each, jnp.int32) for each in ended.counters])
        counted = jnp.where(is_live(ray), counted, 0) if options.counting else jnp.zeros(0, jnp.int32)
        return stack, (t, jnp.where(ended.stuck, STUCK, name), counted)

    if options.batch:
        t, name, counted = jax.vmap(lambda row: one(stack, row)[1])(ready)
    else:
        t, name, counted = scanned(one, stack, ready, live)
    return Traced(jnp.zeros(0) if options.any_hit else t, name, counted, jnp.zeros(0, jnp.int32))


def is_live(ray: ReadyRay) -> Array:
    """() bool: whether there is anything to walk."""
    return ray.first != DONE


def no_counts() -> Counters:
    """Zeros."""
    return Counters(*(jnp.int32(0),) * KINDS)


def test_leaf(leaves: Leaves, leaf: Array, ray: ReadyRay, best: Best) -> Best:
    """Test all triangles of a leaf, () uint32, block by block."""
    first = leaves.first[leaf]
    end = leaves.first[leaf + 1]

    def test(carried: tuple[Array, Best]) -> tuple[Array, Best]:
        block, best = carried
        return block + 1, test_block(leaves.blocks, index(block), ray.shear, best, "watertight")

    return lax.while_loop(lambda carried: carried[0] < end, test, (first, best))[1]


def triangles_in_leaf(leaves: Leaves, leaf: Array) -> Array:
    """() int32: the triangles of a leaf; all of its blocks but the last are full."""
    first, end = leaves.first[leaf], leaves.first[leaf + 1]
    last = triangles_in(leaves.blocks, index(jnp.maximum(end - 1, 0)))
    return jnp.where(end > first, (end - first - 1) * WIDTH + last, 0)


BLOCK_BYTES = 320
"""What testing a block reads."""
