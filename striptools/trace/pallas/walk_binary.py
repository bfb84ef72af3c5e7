"""The walk of one ray a thread through a binary hierarchy, as a GPU kernel: hits are those of `trace.walk`.

Aila & Laine, "Understanding the Efficiency of Ray Traversal on GPUs" (HPG 2009): both children's boxes in one
node, the nearer child first, inner nodes until every ray of the warp has a leaf, then leaves.

Differences:

1. The stack lies in the GPU's memory, an entry of all rays in a row: Triton has no arrays of a thread's own.
2. Boxes are left out and ties resolved as in `trace.walk`, so that the hits are the same, bit for bit.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.experimental import pallas as pl
from jax.experimental.pallas import triton as plgpu

from striptools.trace.box import FAR_FACTOR, Slab
from striptools.trace.numerics import Arithmetic
from striptools.trace.pallas.arithmetic import BY_TRITON
from striptools.trace.pallas.layout import BinaryScene
from striptools.trace.pallas.walk import BY_INTERPRETER, Ray, any_of, ray_at
from striptools.trace.triangle import crossing_of, edges_of, pick
from striptools.trace.walk import DONE, MISS, NO_NAME, SLACK, STUCK, Traced, WalkOptions

RAYS = 32
"""Rays of a program, which is a warp: a thread each."""

LEVELS = 3
"""Binary nodes, at most, on the way through a wide one: what the stack has to hold of it."""


def walk_rays(scene: BinaryScene, ready: Array, options: WalkOptions, *, interpret: bool = False) -> Traced:
    """Walk r rays, r a multiple of `RAYS`, as `walk.walk_rays` does; steps are those in binary nodes."""
    count = len(ready)
    depth = LEVELS * options.stack_size
    kinds = [np.float32, np.int32, *[np.int32] * options.count_steps]
    results = [jax.ShapeDtypeStruct((count,), kind) for kind in kinds]
    traced = pl.pallas_call(
        partial(_kernel, options=options, arithmetic=BY_INTERPRETER if interpret else BY_TRITON),
        grid=(count // RAYS,),
        out_shape=[jax.ShapeDtypeStruct((depth, count), np.int32), *results],
        compiler_params=plgpu.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="walk_binary",
    )(scene.nodes, scene.triangles, ready)
    _, t, name = traced[:3]
    steps = traced[3] if options.count_steps else jnp.zeros(0)
    return Traced(jnp.zeros(0) if options.any_hit else t, name, steps)


def _kernel(
    nodes: Any,
    triangles: Any,
    ready: Any,
    stack: Any,
    *results: Any,
    options: WalkOptions,
    arithmetic: Arithmetic,
) -> None:
    row = pl.program_id(0) * RAYS + lax.iota(np.int32, RAYS)
    walk = _Walk(nodes, triangles, stack, row, ray_at(ready, row), options, arithmetic)
    for ref, values in zip(results, walk.walked(), strict=True):
        plgpu.store(ref.at[row], values)


class _State(NamedTuple):
    """Where rays are: the child to visit next, entries on the stack, closest hits."""

    child: Array
    height: Array
    t: Array
    name: Array
    turns: Any
    steps: tuple[Array, ...]


@dataclass(frozen=True)
class _Walk:
    """The steps of the walk of one program's rays."""

    nodes: Any
    triangles: Any
    stack: Any
    row: Array
    ray: Ray
    options: WalkOptions
    arithmetic: Arithmetic

    def walked(self) -> list[Array]:
        """T, name and, where they are counted, steps."""
        ray = self.ray
        zeros = jnp.zeros_like(ray.child)
        steps = (ray.visited,) if self.options.count_steps else ()
        start = jnp.where(ray.child == DONE, DONE, 0)
        state = _State(start, zeros, ray.t_max, jnp.full_like(zeros, NO_NAME), np.int32(0), steps)
        state = lax.while_loop(lambda s: self.goes_on(s, s.child != DONE), self.nodes_then_leaves, state)
        name = jnp.where(state.name == NO_NAME, MISS, state.name)
        t = jnp.where(name < 0, np.float32(np.inf), self.arithmetic.product(state.t, ray.t_unit))
        return [t, jnp.where(state.child != DONE, STUCK, name), *state.steps]

    def goes_on(self, state: _State, there: Array) -> Array:
        """Whether any ray is there, and the walk within its bound."""
        return any_of(there) & (state.turns <= RAYS * len(self.nodes))

    def nodes_then_leaves(self, state: _State) -> _State:
        state = lax.while_loop(lambda s: self.goes_on(s, s.child >= 0), self.visit_nodes, state)
        return self.visit_leaves(state)

    def visit_nodes(self, state: _State) -> _State:
        """Each ray that is at an inner node tests its children's boxes."""
        at_node = state.child >= 0
        words = [w for k in range(4) for w in self.four(self.nodes, state.child, 4 * k, at_node)]
        limit = state.t * SLACK
        near0, met0 = self.meets(words[0:6], limit)
        near1, met1 = self.meets(words[6:12], limit)
        met0, met1 = met0 & at_node, met1 & at_node
        first, second = (lax.bitcast_convert_type(w, np.int32) for w in words[12:14])

        # The farther of two waits on the stack.
        both, swap = met0 & met1, near1 < near0
        plgpu.store(self.stack.at[state.height, self.row], jnp.where(swap, first, second), mask=both)
        height = jnp.where(both, state.height + 1, state.height)
        child = jnp.where(met0 & ~(both & swap), first, second)
        steps = tuple(jnp.where(at_node, step + 1, step) for step in state.steps)
        state = state._replace(turns=state.turns + 1, height=height, steps=steps)
        state = state._replace(child=jnp.where(met0 | met1, child, state.child))
        return self.popped(state, at_node & ~met0 & ~met1)

    def visit_leaves(self, state: _State) -> _State:
        """Each ray that is at a leaf tests its triangles, one after the other."""
        at_leaf = (state.child < 0) & (state.child != DONE)
        code = jnp.where(at_leaf, ~state.child, 0)
        last = jnp.where(at_leaf, (code >> 3) + (code & 7), -1)

        def test(carried: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
            k, t, name = carried
            here = k <= last
            t, name = self.closer(k, here, t, name)
            return k + 1, t, name

        carried = (code >> 3, state.t, state.name)
        _, t, name = lax.while_loop(lambda c: any_of(c[0] <= last), test, carried)
        steps = tuple(jnp.where(at_leaf, step + 1, step) for step in state.steps)
        state = self.popped(state._replace(t=t, name=name, steps=steps), at_leaf)
        if self.options.any_hit:
            state = state._replace(child=jnp.where(t < self.ray.t_max, DONE, state.child))
        return state

    def closer(self, k: Array, here: Array, t: Array, name: Array) -> tuple[Array, Array]:
        """The closest hits with those on triangles k."""
        words = [w for j in range(3) for w in self.four(self.triangles, k, 4 * j, here)]
        x, y, z = words[0:3], words[3:6], words[6:9]
        shear = self.ray.shear
        along = [tuple(pick(corner, axis) for corner in zip(x, y, z, strict=True)) for axis in shear.axes]
        edges = edges_of(along[0], along[1], along[2], shear, self.arithmetic)  # pyright: ignore[reportArgumentType]
        found = crossing_of(edges, None, self.arithmetic)
        face = lax.bitcast_convert_type(words[9], np.int32)
        won = here & (found > 0) & ((found < t) | ((found == t) & (face < name) & (name != NO_NAME)))
        return jnp.where(won, found, t), jnp.where(won, face, name)

    def popped(self, state: _State, pop: Array) -> _State:
        """Take the next child off the stack."""
        some = pop & (state.height > 0)
        top = plgpu.load(self.stack.at[jnp.where(some, state.height - 1, 0), self.row], mask=some)
        child = jnp.where(some, top, jnp.where(pop, DONE, state.child))
        return state._replace(child=child, height=jnp.where(some, state.height - 1, state.height))

    def four(self, rows: Any, row: Array, first: int, mask: Array) -> list[Array]:
        """Four numbers of a row, by one read a thread."""
        shape = (RAYS, 4)
        at = lax.broadcast_in_dim(row, shape, (0,))
        column = lax.broadcasted_iota(np.int32, shape, 1) + first
        read = plgpu.load(rows.at[at, column], mask=lax.broadcast_in_dim(mask, shape, (0,)))
        return [part.reshape(RAYS) for part in lax.split(read, (1, 1, 1, 1), 1)]

    def meets(self, box: list[Array], limit: Array) -> tuple[Array, Array]:
        """Where rays enter boxes, and whether they meet them from 0 to `limit`, as `tiles.passes`."""
        slab: Slab = self.ray.slab
        low = [box[axis] * slab.inverse[axis] - slab.low[axis] for axis in range(3)]
        high = [box[axis + 3] * slab.inverse[axis] - slab.high[axis] for axis in range(3)]
        near, far = list(map(lax.min, low, high)), list(map(lax.max, low, high))
        entry = lax.max(lax.max(near[0], near[1]), lax.max(near[2], jnp.zeros_like(near[2])))
        leaving = lax.min(far[0], lax.min(far[1], far[2])) * FAR_FACTOR
        return entry, (entry <= limit) & (entry <= leaving)
