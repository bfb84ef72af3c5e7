"""The walk of `trace.walk` as one GPU kernel: its twin is `walk.walk_rays` with `WalkOptions.batch`.

Order of visits, boxes left out, hits and ties are the twin's, and so are all results, bit for bit.

Differences:

1. A warp walks four rays, eight lanes each (`tiles`): a child's box and a triangle are tested by a thread
   apiece, and a row of a node or a leaf is one read of 32 neighbouring bytes. One ray a thread would read
   scattered memory, wait for the slowest of 32 rays and not for that of four, and keep its stack in memory.
2. The stack lies in registers, an entry a lane: to push is a select, to pop a sum over the lanes.
3. What a ray has to itself stands in each of its lanes; nothing is exchanged but in sums, minima and maxima
   over lanes.

JAX 0.11 calls Pallas' Triton deprecated: where it is gone, `launch` says so and the twin walks.
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

from striptools.trace.box import Slab
from striptools.trace.numerics import BY_XLA, Arithmetic, in_range
from striptools.trace.pallas.arithmetic import BY_TRITON
from striptools.trace.pallas.tiles import Source, Tile, lane_numbers, source_of
from striptools.trace.triangle import Shear
from striptools.trace.walk import (
    DONE,
    FLOATS,
    HIT,
    MISS,
    NO_NAME,
    SLACK,
    STUCK,
    WIDTH,
    Traced,
    WalkOptions,
    WalkScene,
    prepared_rays,
)

RAYS = 4
"""Rays of a program, which is a warp: eight threads each."""

MOST_NODES = 2**23
"""A node and the lanes left of it are one entry of 32 bits, its sign unused."""

BY_INTERPRETER = BY_XLA._replace(quotient=lax.div)


def trace_rays(
    scene: WalkScene, origins: Array, directions: Array, t_max: Array, options: WalkOptions
) -> Traced:
    """Trace rays as `walk.trace_rays` does, walking them by the kernel."""
    return walk_rays(scene, prepared_rays(scene, origins, directions, t_max), options)


def walk_rays(scene: WalkScene, ready: Array, options: WalkOptions, *, interpret: bool = False) -> Traced:
    """Walk r rays, r a multiple of `RAYS`, as `walk.walk_rays` does.

    Args:
        scene: Wide or packed, of fewer than `MOST_NODES` nodes of eight children.
        ready: (r, 24) float32, as from `walk.prepared_rays`.
        options: What to compile in: nothing counted or gathered; `interleave` and `batch` do not matter.
        interpret: Run the kernel by JAX on the platform at hand, slowly.

    Raises:
        NotImplementedError: The scene has other nodes, or more of them.
    """
    if scene.width != WIDTH:
        raise NotImplementedError(f"nodes of {scene.width} children")
    if scene.node_count > MOST_NODES:
        raise NotImplementedError(f"more than {MOST_NODES} nodes")
    count, source = len(ready), source_of(scene)
    results = [jax.ShapeDtypeStruct((count,), kind) for kind in (np.float32, np.int32)]
    arithmetic = BY_INTERPRETER if interpret else BY_TRITON
    t, name = pl.pallas_call(
        partial(_kernel, source=source, scene=scene, options=options, arithmetic=arithmetic),
        grid=(count // RAYS,),
        out_shape=results,
        compiler_params=plgpu.CompilerParams(num_warps=1, num_stages=1),
        interpret=interpret,
        name="walk",
    )(*source.arrays, ready)
    counters, counted = jnp.zeros((count, 0), np.int32), jnp.zeros(0, np.int32)
    return Traced(jnp.zeros(0) if options.any_hit else t, name, counters, counted)


def _kernel(
    *refs: Any, source: Source, scene: WalkScene, options: WalkOptions, arithmetic: Arithmetic
) -> None:
    """Walk the rays of one program and write what they hit."""
    shape = (RAYS, WIDTH)
    given = len(source.arrays)
    ready, results = refs[given], refs[given + 1 :]
    row = pl.program_id(0) * RAYS + lax.broadcasted_iota(np.int32, shape, 0)
    tile = source.tile(list(refs[:given]), shape, arithmetic)
    ray = _ray_at(ready, row)
    walk = _Walk(tile, ray, options, arithmetic, RAYS * scene.node_count, scene.has_faces)
    for ref, values in zip(results, walk.walked(), strict=True):
        # Every lane writes the same.
        plgpu.store(ref.at[row], values)


class _Ray(NamedTuple):
    """What `walk.ReadyRay` holds, a tile apiece."""

    slab: Slab
    shear: Shear
    t_max: Array
    t_unit: Array
    mirror: Array
    child: Array
    lanes: Array


def _ray_at(ready: Any, row: Array) -> _Ray:
    """Read rays, laid out as `walk.ReadyRay` says."""
    words = [plgpu.load(ready.at[row, k]) for k in range(FLOATS + 6)]
    floats, ints = words[:FLOATS], [lax.bitcast_convert_type(word, np.int32) for word in words[FLOATS:]]
    slab = Slab(floats[0:3], floats[3:6], floats[6:9])  # pyright: ignore[reportArgumentType]
    shear = Shear(
        (ints[0], ints[1], ints[2]), (floats[9], floats[10], floats[11]), floats[12], floats[13], floats[14]
    )
    return _Ray(slab, shear, floats[15], floats[16], ints[3], ints[4] ^ DONE, ints[5])


class _State(NamedTuple):
    """Where rays are, as `walk.Place`, their stacks, and their closest hits by lane.

    Attributes:
        stack: Tiles of entries, `node << 8 | lanes`: lane k of tile s holds entry 8s + k.
        turns: () int32, of the loops.
    """

    child: Array
    node: Array
    lanes: Array
    height: Array
    stack: tuple[Array, ...]
    nearest: Array
    t: Array
    name: Array
    turns: Any


def _over_lanes(join: Any, values: Array) -> Array:
    """A reduction over each ray's lanes, in all of them."""
    return jnp.broadcast_to(join(values, axis=1, keepdims=True), values.shape)


@dataclass(frozen=True)
class _Walk:
    """The steps of the walk of one program's rays."""

    tile: Tile
    ray: _Ray
    options: WalkOptions
    arithmetic: Arithmetic
    bound: int
    has_faces: bool

    def walked(self) -> list[Array]:
        """T and name."""
        state = lax.while_loop(lambda s: self.goes_on(s, int(DONE) + 1), self.nodes_then_leaves, self.start())
        name = self.closest_name(state)
        t = in_range(self.arithmetic.product(state.nearest, self.ray.t_unit))
        t = jnp.where(name < 0, np.float32(np.inf), t)
        return [t, jnp.where(state.child != DONE, STUCK, name)]

    def start(self) -> _State:
        ray = self.ray
        zeros = jnp.zeros_like(ray.child)
        tiles = -(-self.options.stack_size // WIDTH)
        missed = jnp.full_like(zeros, MISS)
        rest = (zeros, ray.lanes, zeros, (zeros,) * tiles, ray.t_max, ray.t_max, missed, np.int32(0))
        return _State(ray.child, *rest)

    def goes_on(self, state: _State, least: int) -> Array:
        """Whether any ray's next child is at least that, and the walk within its bound."""
        return (jnp.max(state.child.reshape(-1)) >= np.int32(least)) & (state.turns <= self.bound)

    def nodes_then_leaves(self, state: _State) -> _State:
        state = lax.while_loop(lambda s: self.goes_on(s, 0), self.visit_nodes, state)
        return self.visit_leaves(state)

    def visit_nodes(self, state: _State) -> _State:
        """Each ray that is at an inner node visits it."""
        at_node = state.child >= 0
        tile = self.tile.among(at_node)
        met = tile.lanes_met(state.child, self.ray.slab, state.nearest * SLACK)
        lane = lane_numbers(met.shape, np.int32)
        lane_bits = jnp.int32(1) << (lane ^ self.ray.mirror)
        lanes = _over_lanes(jnp.sum, jnp.where(met & at_node, lane_bits, 0))
        top = self.top_of(state)

        # Put what is left of the last node on the stack where this one has lanes.
        into = lanes != 0
        put = into & (state.lanes != 0)
        entry = state.node << WIDTH | state.lanes
        place = jnp.where(put, state.height - lane, -1)
        stack = tuple(jnp.where(place == WIDTH * k, entry, tile) for k, tile in enumerate(state.stack))
        state = state._replace(
            node=jnp.where(into, state.child, state.node),
            lanes=jnp.where(into, lanes, state.lanes),
            height=jnp.where(put, state.height + 1, state.height),
            stack=stack,
            turns=state.turns + 1,
        )
        return self.next_child(state, at_node, top)

    def visit_leaves(self, state: _State) -> _State:
        """Each ray that is at a leaf tests its triangles."""
        at_leaf = (state.child < 0) & (state.child != DONE)
        tile = self.tile.among(at_leaf)
        leaf = tile.leaf_of(self.ray.shear.axes, tile.find_leaf(state.child), self.options.decode)
        t, name = leaf.crossings(self.ray.shear, self.arithmetic), leaf.name
        there = at_leaf & (t > 0)
        closer = there & ((t < state.t) | self.wins_ties(there & (t == state.t), name, state.name))
        t = jnp.where(closer, t, state.t)
        nearest = _over_lanes(jnp.min, t)
        top = self.top_of(state)
        state = state._replace(nearest=nearest, t=t, name=jnp.where(closer, name, state.name))
        state = self.next_child(state, at_leaf, top)
        if self.options.any_hit:
            state = state._replace(child=jnp.where(nearest < self.ray.t_max, DONE, state.child))
        return state

    def wins_ties(self, tied: Array, name: Array, other: Array) -> Array:
        """Where t is the same: whether the face is less."""
        if self.options.any_hit:
            return jnp.zeros_like(tied)
        if not self.has_faces:
            return tied & (name < other)

        def by_face() -> Array:
            tile = self.tile.among(tied)
            return tied & (tile.faces_of(name) < tile.faces_of(other))

        return lax.cond(_any(tied), by_face, lambda: tied)

    def top_of(self, state: _State) -> Array:
        """The entry on top of the stack; 0, which is no lane, where there is none."""
        place = state.height - 1 - lane_numbers(state.child.shape, np.int32)
        found = jnp.zeros_like(state.child)
        for k, tile in enumerate(state.stack):
            found = jnp.where(place == WIDTH * k, tile, found)
        return _over_lanes(jnp.sum, found)

    def next_child(self, state: _State, active: Array, top: Array) -> _State:
        """Take the nearest lane left, of the node at hand or of the one on top of the stack."""
        pop = active & (state.lanes == 0)
        node = jnp.where(pop, top >> WIDTH, state.node)
        lanes = jnp.where(pop, top & 255, state.lanes)
        some = lanes != 0
        order = (31 - lax.clz(lanes)) & 7
        found = self.tile.among(active & some).child_of(node, order ^ self.ray.mirror)
        child = jnp.where(active, jnp.where(some, found, DONE), state.child)
        left = jnp.where(active & some, lanes ^ (jnp.int32(1) << order), lanes)
        return state._replace(
            child=child, node=node, lanes=left, height=jnp.where(pop & some, state.height - 1, state.height)
        )

    def closest_name(self, state: _State) -> Array:
        """Of the lanes that hold the closest hit, the name of the least face; `MISS` where there is none.

        Of any hit `HIT`.
        """
        if self.options.any_hit:
            return jnp.where(state.nearest < self.ray.t_max, HIT, MISS)
        held = (state.t == state.nearest) & (state.name >= 0)
        names = jnp.where(held, state.name, NO_NAME)
        if self.has_faces:
            faces = jnp.where(held, self.tile.among(held).faces_of(state.name), NO_NAME)
            names = jnp.where(faces == _over_lanes(jnp.min, faces), names, NO_NAME)
        least = _over_lanes(jnp.min, names)
        return jnp.where(least == NO_NAME, MISS, least)


def _any(flags: Array) -> Array:
    """() bool: whether any is set."""
    return jnp.max(jnp.where(flags, np.int32(1), np.int32(0)).reshape(-1)) > 0


# Notes
#
# NVIDIA H100, 2**20 rays in its memory, Mray/s of closest hits, camera / occlusion / random, Stanford dragon:
# expanded 1253 / 562 / 839, compressed 711 / 297 / 462; the twin does 1 to 6. Plain CUDA, one ray a thread
# through a rebuilt binary hierarchy, with a test that leaks (`bench_gpu_yardstick`), does 4142 / 1294 / 2859.
# A step at nodes takes 115 instructions, one at expanded leaves 215, of four rays. Compiled by Triton 3.6, no
# value moves through shared memory, nothing is spilled, and 64 registers let 32 warps be at work.
#
# Tried and lost (speed over what stands here): one ray a thread through a binary hierarchy made of the wide
# one's lanes, a node in four reads of 16 bytes, the stack in memory: 0.98 / 0.80 / 0.83; eight rays a warp
# 0.82 / 0.72 / 0.69; nodes read without a mask, by waiting rays too, 0.98 / 0.79 / 0.96; on to the leaves as
# soon as more rays wait there than are at nodes 0.94 / 0.91 / 0.94, or twice as many 0.90 / 0.98 / 0.95; a
# node, then a leaf, in turns 0.98 / 0.84 / 0.97.
#
# Not tried: addresses take three instructions a read, since Triton's offsets are 32 bits wide and may wrap; a
# vote would do for a sum over lanes, but Triton has none, and assembly must not know which thread has a lane.
