"""The walk of `trace.walk` as one GPU kernel: its twin is `walk.walk_rays` with `WalkOptions.batch`.

Aila & Laine, "Understanding the Efficiency of Ray Traversal on GPUs" (HPG 2009): a ray a thread, and rays
that are done are replaced. Nodes and the order of visits are the twin's; boxes are left out later or sooner
than there, which changes no result: hits and ties are, bit for bit.

Differences:

1. Rays at inner nodes go on until as many wait at leaves; new ones come in once most of a warp's are done.
2. Which warp walks a ray depends on who was quick; what a ray hits does not.
3. A leaf's triangles are sifted by the signs of their edge functions, exact but for what the twin does with
   numbers that are none. What is left, one triangle of a ray at a time, is tested as the twin does.
4. The stack's upper entries lie in registers and move as a whole; the rest, which few trees need, in memory.

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

from striptools.trace.numerics import in_range
from striptools.trace.pallas.arithmetic import BY_INTERPRETER, BY_TRITON, KernelArithmetic
from striptools.trace.pallas.tiles import (
    RAYS,
    Sides,
    Source,
    Tile,
    bits_in,
    each,
    frame_at,
    frame_words,
    lane_numbers,
    source_of,
    three,
)
from striptools.trace.triangle import Shear
from striptools.trace.walk import (
    DONE,
    HIT,
    MISS,
    SLACK,
    STUCK,
    WIDTH,
    Frame,
    Traced,
    WalkOptions,
    WalkScene,
    names_leaf,
    ready_words,
)

PROGRAMS = 4096
"""Programs, at most: as many as a GPU can have at work, or more."""

REPLACED = 24
"""Rays that are done before others take their places."""

SHORT = 8
"""Entries of the stack in registers."""

MOST_RAYS = 2**23
"""Rays are counted in float32."""

MOST_NODES = 2**23
"""A node and the lanes left of it are one entry of 32 bits, its sign unused."""


def trace_rays(
    scene: WalkScene,
    origins: Array,
    directions: Array,
    t_max: Array,
    options: WalkOptions,
    *,
    interpret: bool = False,
) -> Traced:
    """Trace rays as `walk.trace_rays` does, by the kernel.

    Args:
        scene: Wide or packed, of fewer than `MOST_NODES` nodes of eight children.
        origins: (r, 3) float32.
        directions: (r, 3) float32.
        t_max: (r,) float32.
        options: What to compile in: nothing counted or gathered; `interleave` and `batch` do not matter.
        interpret: Run the kernel by JAX on the platform at hand, slowly.

    Raises:
        NotImplementedError: The scene has other nodes, or more of them.
    """
    if scene.width != WIDTH:
        raise NotImplementedError(f"nodes of {scene.width} children")
    if scene.node_count > MOST_NODES:
        raise NotImplementedError(f"more than {MOST_NODES} nodes")
    ranges = [slice(k, k + MOST_RAYS) for k in range(0, max(1, len(t_max)), MOST_RAYS)]
    parts = [
        _traced(scene, origins[part], directions[part], t_max[part], options, interpret=interpret)
        for part in ranges
    ]
    return Traced(*map(jnp.concatenate, zip(*parts, strict=True))) if len(parts) > 1 else parts[0]


def _traced(
    scene: WalkScene,
    origins: Array,
    directions: Array,
    t_max: Array,
    options: WalkOptions,
    *,
    interpret: bool,
) -> Traced:
    """The same for rays that one kernel takes."""
    count, source = len(t_max), source_of(scene)
    if count == 0:
        return _results(jnp.zeros(0, np.int32), t_max)
    programs = min(PROGRAMS, -(-count // RAYS))
    taken = jnp.zeros(RAYS, np.float32)
    given = [*source.arrays, frame_words(scene.frame), origins, directions, t_max, taken]
    results = [jax.ShapeDtypeStruct((RAYS,), np.float32), jax.ShapeDtypeStruct((count,), np.int32)]
    if not options.any_hit:
        results.append(jax.ShapeDtypeStruct((count,), np.float32))
    if options.stack_size > SHORT:
        results.append(jax.ShapeDtypeStruct((programs, options.stack_size - SHORT, RAYS), np.int32))
    _, name, *rest = pl.pallas_call(
        partial(_kernel, source=source, scene=scene, options=options, interpret=interpret),
        grid=(programs,),
        out_shape=results,
        compiler_params=plgpu.CompilerParams(num_warps=1, num_stages=1),
        input_output_aliases={len(given) - 1: 0},
        interpret=interpret,
        name="walk",
    )(*given)
    return _results(name, None if options.any_hit else rest[0])


def _results(name: Array, t: Array | None) -> Traced:
    nothing = jnp.zeros(0)
    counters = jnp.zeros((len(name), 0), np.int32)
    return Traced(nothing if t is None else t, name, counters, nothing.astype(np.int32))


def _kernel(*refs: Any, source: Source, scene: WalkScene, options: WalkOptions, interpret: bool) -> None:
    """Walk rays as long as there are any and write what they hit."""
    arithmetic = BY_INTERPRETER if interpret else BY_TRITON
    given = len(source.arrays)
    frame, origins, directions, t_max, _, taken, name, *results = refs[given:]
    spilled = results[-1] if options.stack_size > SHORT else None
    tile = source.tile(list(refs[:given]), arithmetic)
    t = None if options.any_hit else results[0]
    memory = _Memory(frame_at(frame), origins, directions, t_max, taken, name, t)
    rest = options, arithmetic, scene.node_count, scene.has_faces
    _Walk(tile, memory, spilled, pl.program_id(0), *rest).walk_all()


class _Memory(NamedTuple):
    """Where rays come from and results go: references."""

    frame: Frame
    origins: Any
    directions: Any
    t_max: Any
    taken: Any
    name: Any
    t: Any = None


class _Ray(NamedTuple):
    """What `walk.ReadyRay` holds, an array (rays,) each."""

    sides: Sides
    shear: Shear
    t_unit: Array
    mirror: Array


class _State(NamedTuple):
    """Where rays are, (rays,) each but the last two, () int32.

    Attributes:
        row: Which rays they are; `_Walk.nowhere` where there is none.
        ray: What stays the same along a walk.
        child: The next to visit, as of `walk.Place`; it is of `node`, which has `lanes` left.
        visits: Nodes visited.
        height: Entries of the stack, where some may lie in memory.
        stack: Its upper `SHORT` entries, the top first: `node << 8 | lanes`, 0 where there is none.
        nearest: The closest hit's t.
        name: Its name.
        fresh: A ray that some program took, and with it all before.
        census: How many rays are at an inner node, and 2**16 times how many at a leaf.
    """

    row: Array
    ray: _Ray
    child: Array
    node: Array
    lanes: Array
    visits: Array
    height: Array | None
    stack: tuple[Array, ...]
    nearest: Array
    name: Array
    fresh: Any
    census: Any


@dataclass(frozen=True)
class _Walk:
    """The steps of the walk of one program's rays."""

    tile: Tile
    memory: _Memory
    spilled: Any
    program: Any
    options: WalkOptions
    arithmetic: KernelArithmetic
    node_count: int
    has_faces: bool

    @property
    def nowhere(self) -> int:
        """Behind the last ray: not negative, which to JAX is a place from the end."""
        return self.memory.name.shape[0]

    def walk_all(self) -> None:
        """Walk until there is no ray left."""
        state = lax.while_loop(self.goes_on, self.step, self.start())
        self.write_down(state, state.row < self.nowhere)

    def start(self) -> _State:
        """No ray yet."""
        zeros, zero = jnp.zeros(RAYS, np.int32), jnp.zeros(RAYS, np.float32)
        nowhere, none = three([zero] * 3), three([zeros] * 3)
        sides = Sides(nowhere, nowhere, nowhere, none, none)
        ray = _Ray(sides, Shear(none, nowhere, zero, zero, zero), zero, zeros)
        entries = min(SHORT, self.options.stack_size)
        height = None if self.spilled is None else zeros
        rest = (zeros, zeros, zeros, height, (zeros,) * entries, zero, jnp.full_like(zeros, MISS))
        row, child = jnp.full_like(zeros, self.nowhere), jnp.full_like(zeros, DONE)
        return _State(row, ray, child, *rest, np.int32(0), np.int32(0))

    def goes_on(self, state: _State) -> Array:
        """Whether a ray is on its way or to come."""
        return (state.census != 0) | (state.fresh < self.nowhere)

    def step(self, state: _State) -> _State:
        """New rays come in; those at nodes go on; those at leaves test them."""
        state = lax.cond(self.takes(state), self.take, lambda s: s, state)
        state = lax.while_loop(self.is_among_nodes, self.visit_nodes, state)
        return lax.cond(_at_leaves(state) >= _at_nodes(state), self.visit_leaves, lambda s: s, state)

    def takes(self, state: _State) -> Array:
        """Whether new rays come in."""
        done = RAYS - _at_nodes(state) - _at_leaves(state)
        return (state.fresh < self.nowhere) & ((done >= REPLACED) | (state.census == 0))

    def is_among_nodes(self, state: _State) -> Array:
        """Whether more rays are at nodes than at leaves, and none are to come in."""
        return (_at_nodes(state) > _at_leaves(state)) & ~self.takes(state)

    # Rays come and go.

    def take(self, state: _State) -> _State:
        """Write down what rays that are done have found, and let new ones take their places."""
        done = state.child == DONE
        self.write_down(state, done & (state.row < self.nowhere))
        count = jnp.where(done, np.int32(1), np.int32(0))
        first = self.taken(jnp.sum(count))
        row = first - 1 + lax.cumsum(count)
        new = done & (row < self.nowhere)
        ray, limit, child = self.ray_at(row, new)
        # A ray that is none is done at once, and what the one before it found is written down no more.
        merged = jax.tree.map(lambda a, b: jnp.where(done, a, b), ray, state.ray)
        zeros = jnp.zeros_like(row)
        return self.counted(
            state._replace(
                row=jnp.where(done, jnp.where(new, row, self.nowhere), state.row),
                ray=merged,
                child=jnp.where(done, jnp.where(new, child, DONE), state.child),
                lanes=jnp.where(done, zeros, state.lanes),
                visits=jnp.where(done, zeros, state.visits),
                height=None if state.height is None else jnp.where(done, zeros, state.height),
                stack=tuple(jnp.where(done, zeros, entry) for entry in state.stack),
                nearest=jnp.where(done, limit, state.nearest),
                name=jnp.where(done, MISS, state.name),
                fresh=first + jnp.sum(count),
            )
        )

    def taken(self, count: Array) -> Array:
        """The first of so many rays, () int32, that no other program takes."""
        # An atomic operation of a thread alone would make the GPU set memory aside that its cache lacks then.
        lane = lax.broadcasted_iota(np.int32, (RAYS,), 0)
        # Of float32, since JAX adds whole numbers of many threads as if they were such.
        several = jnp.broadcast_to(count, lane.shape).astype(np.float32)
        before = plgpu.atomic_add(self.memory.taken, (lane,), several).astype(np.int32)
        return jnp.sum(jnp.where(lane == 0, before, np.int32(0)))

    def ray_at(self, row: Array, mask: Array) -> tuple[_Ray, Array, Array]:
        """Rays made ready, how far they reach, and the child that each visits first: the root, or `DONE`."""
        origin, direction = (
            three(plgpu.load(ref.at[row, np.int32(k)], mask=mask) for k in range(3))
            for ref in (self.memory.origins, self.memory.directions)
        )
        t_max = plgpu.load(self.memory.t_max.at[row], mask=mask)
        floats, ints = ready_words(self.memory.frame, origin, direction, t_max, self.arithmetic.exact)
        low, high, inverse = floats[0:3], floats[3:6], floats[6:9]
        up = [(ints[3] >> axis & 1) != 0 for axis in range(3)]
        sides = Sides(
            three(-jnp.where(*each) for each in zip(up, low, high, strict=True)),
            three(-jnp.where(*each) for each in zip(up, high, low, strict=True)),
            three(inverse),
            three(jnp.where(up[axis], np.int32(axis), np.int32(axis + 3)) for axis in range(3)),
            three(jnp.where(up[axis], np.int32(axis + 3), np.int32(axis)) for axis in range(3)),
        )
        shear = Shear(three(ints[0:3]), three(floats[9:12]), floats[12], floats[13], floats[14])
        return _Ray(sides, shear, floats[16], ints[3]), floats[15], ints[4] ^ DONE

    def write_down(self, state: _State, mask: Array) -> None:
        """Write what rays have found."""
        stuck = state.visits > self.node_count
        plgpu.store(self.memory.name.at[state.row], jnp.where(stuck, STUCK, state.name), mask=mask)
        if self.memory.t is not None:
            t = in_range(self.arithmetic.exact.product(state.nearest, state.ray.t_unit))
            t = jnp.where(state.name < 0, np.float32(np.inf), t)
            plgpu.store(self.memory.t.at[state.row], t, mask=mask)

    def counted(self, state: _State) -> _State:
        """The same, the census taken."""
        at_leaf = jnp.where(_is_at_leaf(state), np.int32(1 << 16), np.int32(0))
        share = jnp.where(state.child >= 0, np.int32(1), at_leaf)
        return state._replace(census=jnp.sum(share))

    # Nodes.

    def visit_nodes(self, state: _State) -> _State:
        """Each ray that is at an inner node visits it."""
        at_node = state.child >= 0
        # Rays that are at none read the root.
        node = lax.max(state.child, np.int32(0))
        met = jnp.zeros_like(node)
        for half, there in enumerate(self.tile.lanes_met(node, state.ray.sides, state.nearest * SLACK)):
            met = met | bits_in(there, np.int32(1) << (lane_numbers(half) ^ each(state.ray.mirror)))
        # A walk in a circle ends: a ray visits each node once.
        visits = jnp.where(at_node, state.visits + 1, state.visits)
        met = jnp.where(at_node & (visits <= self.node_count), met, 0)
        into = met != 0
        state = self.pushed(state, into & (state.lanes != 0), state.node << WIDTH | state.lanes)
        state = state._replace(
            node=jnp.where(into, state.child, state.node),
            lanes=jnp.where(into, met, state.lanes),
            visits=visits,
        )
        return self.counted(self.next_child(state, at_node))

    def next_child(self, state: _State, active: Array) -> _State:
        """Take the nearest lane left, of the node at hand or of the one on top of the stack."""
        pop = active & (state.lanes == 0)
        state, top = self.popped(state, pop)
        node = jnp.where(pop, top >> WIDTH, state.node)
        lanes = jnp.where(pop, top & 255, state.lanes)
        some = active & (lanes != 0)
        order = (31 - lax.clz(lanes)) & 7
        found = self.tile.among(some).child_of(node, order ^ state.ray.mirror)
        return state._replace(
            child=jnp.where(active, jnp.where(some, found, DONE), state.child),
            node=node,
            lanes=jnp.where(some, lanes ^ (np.int32(1) << order), lanes),
        )

    def pushed(self, state: _State, mask: Array, entry: Array) -> _State:
        """Put an entry on the stacks of some rays."""
        stack = state.stack
        if state.height is not None:
            # Nothing is written behind the stack, whatever a damaged scene makes of it.
            room = self.options.stack_size
            full = mask & (state.height >= SHORT) & (state.height < room)
            lax.cond(_any(full), partial(self.spill, state, full), lambda: None)
            height = lax.min(state.height + 1, np.int32(room))
            state = state._replace(height=jnp.where(mask, height, state.height))
        moved = (entry, *stack[:-1])
        return state._replace(stack=tuple(jnp.where(mask, a, b) for a, b in zip(moved, stack, strict=True)))

    def popped(self, state: _State, mask: Array) -> tuple[_State, Array]:
        """Take the top entry off the stacks of some rays; 0, which has no lane, where there is none."""
        stack = state.stack
        last = jnp.zeros_like(stack[0])
        if state.height is not None:
            deep = mask & (state.height > SHORT)
            last = lax.cond(_any(deep), partial(self.unspill, state, deep), lambda: last)
            state = state._replace(
                height=jnp.where(mask & (state.height > 0), state.height - 1, state.height)
            )
        moved = (*stack[1:], last)
        after = tuple(jnp.where(mask, a, b) for a, b in zip(moved, stack, strict=True))
        return state._replace(stack=after), stack[0]

    def spill(self, state: _State, mask: Array) -> None:
        """Write the lowest entry in registers to memory."""
        assert state.height is not None
        plgpu.store(self._spilled_at(state.height - SHORT), state.stack[-1], mask=mask)

    def unspill(self, state: _State, mask: Array) -> Array:
        """Read the uppermost entry in memory."""
        assert state.height is not None
        return plgpu.load(self._spilled_at(state.height - SHORT - 1), mask=mask, other=0)

    def _spilled_at(self, place: Array) -> Any:
        return self.spilled.at[self.program, place, lax.broadcasted_iota(np.int32, (RAYS,), 0)]

    # Leaves.

    def visit_leaves(self, state: _State) -> _State:
        """Each ray that is at a leaf tests its triangles and goes on."""
        at_leaf = _is_at_leaf(state)
        tile = self.tile.among(at_leaf)
        where = tile.find_leaf(jnp.where(at_leaf, state.child, -1))
        crossed = tile.lanes_crossed(state.ray.shear, where, self.options.decode)
        crossed = jnp.where(at_leaf, crossed, 0)
        test = partial(self.test_triangle, where)
        state, _ = lax.while_loop(lambda carried: _any(carried[1] != 0), test, (state, crossed))
        state = self.next_child(state, at_leaf)
        if self.options.any_hit:
            found = at_leaf & (state.name >= 0)
            state = state._replace(child=jnp.where(found, DONE, state.child))
        return self.counted(state)

    def test_triangle(self, where: Any, carried: tuple[_State, Array]) -> tuple[_State, Array]:
        """Each ray that has a triangle left to test tests one."""
        state, crossed = carried
        some = crossed != 0
        lane = (31 - lax.clz(crossed)) & 7
        leaf = self.tile.among(some).triangle_of(state.ray.shear.axes, where, lane, self.options.decode)
        t = leaf.crossings(state.ray.shear, self.arithmetic.exact)
        there = some & (t > 0)
        closer = there & (t < state.nearest)
        if not self.options.any_hit:
            closer = closer | self.wins_tie(there & (t == state.nearest), leaf.name, state.name)
        name = jnp.full_like(leaf.name, HIT) if self.options.any_hit else leaf.name
        state = state._replace(
            nearest=jnp.where(closer, t, state.nearest), name=jnp.where(closer, name, state.name)
        )
        return state, jnp.where(some, crossed ^ (np.int32(1) << lane), 0)

    def wins_tie(self, tied: Array, name: Array, other: Array) -> Array:
        """Where t is the same: whether the face is less."""
        if not self.has_faces:
            return tied & (name < other)

        def by_face() -> Array:
            tile = self.tile.among(tied)
            return tied & (tile.faces_of(name) < tile.faces_of(other))

        return lax.cond(_any(tied), by_face, lambda: tied)


def _is_at_leaf(state: _State) -> Array:
    return names_leaf(state.child)


def _at_nodes(state: _State) -> Array:
    return state.census & 0xFFFF


def _at_leaves(state: _State) -> Array:
    return state.census >> 16


def _any(flags: Array) -> Array:
    """() bool: whether any is set."""
    return jnp.max(jnp.where(flags, np.int32(1), np.int32(0))) > 0


# Notes
#
# NVIDIA H100, rays in its memory, millions of closest hits a second, camera / occlusion / random rays, stored
# hierarchy of the Stanford dragon, 2**20 rays a call. Before: a warp took four rays, eight lanes each, and
# what a ray has one of stood in eight threads: 1253 / 562 / 839 expanded, 711 / 297 / 462 compressed, held up
# by issuing. Now 2755 / 1238 / 1625 and 1589 / 784 / 1274; under the rebuilt hierarchy 2956 / 1304 / 1746.
# Plain CUDA with a test that leaks (`bench_gpu_yardstick`): 4049 / 1752 / 2914, and where triangles are long
# and thin (powerplant) 346 / 251 / 154 for 1685 / 1128 / 1014 here. All with other processes on the host, and
# 16 rays replaced at a time: 8 give 2501 / 1047 / 1561, 24 give 2986 / 1272 / 1826 and are taken now. Entries
# in registers: 4 and 16 give 2808 / 1243 / 1714 and 2811 / 1267 / 1769.
#
# Compiled by Triton 3.6 a step at nodes takes 249 instructions of 32 rays, a leaf 2 * 197, a triangle tested
# exactly 180, coming in some 450; packed 381, 330 and 109 a triangle, 472. Nothing is spilled, 124 registers
# let 16 warps be at work. Of the camera's rays every other issue slot is empty: warps wait for memory (42 %
# of samples), where each sector that is read is read twice and hardly ever again.
#
# What gave how much, camera rays: a ray a thread 1253 to 1963, with rays taken by chunks of 128; by chunks of
# 32, 2554; the rest as many as there is room for, sides fused, nodes read without masks, leaves sifted by
# three minima. An atomic operation of one thread alone takes four bytes of shared memory, and the driver then
# leaves the cache 23 KB.
#
# Next: packed nodes over expanded leaves, 64 bytes in the place of 224; warps of one multiprocessor near each
# other in the picture; fewer registers.
