"""The SLBVH: the heap is what a plain recursion builds, and the trail visits what a plain recursion does."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rays import rays_at
from scenes import scene_of, scenes, small_scene
from shapes import SHAPES
from strategies import sphere
from test_trace import assert_equal_hits

import striptools
from striptools.errors import LimitError, StriptoolsError, UnreadableSceneError, UsageError
from striptools.hierarchies.options import HierarchyOptions
from striptools.hierarchies.slbvh import (
    BYTE_LIMIT,
    COUNT_SHIFT,
    LEAF,
    MOST_DEPTH,
    MOST_OBJECTS,
    PRIM_COUNT,
    PRIM_POS,
    build_slbvh,
    check_slbvh,
    heap_bytes,
    heap_depth,
)
from striptools.kernels.morton import morton_codes
from striptools.kernels.rays import ROW
from striptools.mesh.clean import clean
from striptools.mesh.mesh import Mesh
from striptools.partition.boxes import range_boxes
from striptools.partition.sah import half_area
from striptools.trace import Tracer, walk_single
from striptools.trace.box import lanes_met
from striptools.trace.launch import program
from striptools.trace.slbvh import lay_out_slbvh
from striptools.trace.walk import MISS, SLACK, ReadyRay, WalkOptions, nothing_yet, prepared_rays
from striptools.trace.walk_slbvh import Place, SlbvhScene, _State, _visit, step_in, step_out

BALANCES = ("sah", "morton")
OVERS = ("triangles", "strips", "blocks")
HIT_FIELDS = ("t", "face", "u", "v", "triangle")


def options_of(over="triangles", balance="sah"):
    return HierarchyOptions("slbvh", over=over, balance=balance)


def random_boxes(count, seed, lattice=1000):
    random = np.random.default_rng(seed)
    low = random.integers(-lattice, lattice + 1, (count, 3)) / np.float32(8)
    return np.concatenate([low, low + random.integers(0, 3, (count, 3))], axis=1).astype(np.float32)


@st.composite
def any_boxes(draw):
    lattice = draw(st.sampled_from([0, 1, 4, 1000]))
    boxes = random_boxes(draw(st.integers(1, 300)), draw(st.integers(0, 2**32 - 1)), lattice)
    return boxes * np.float32(draw(st.sampled_from([1, 1e-40, 1e30])))


def under(scene, over, balance, **limits):
    """The scene with an SLBVH in the place of its own hierarchy."""
    boxes = range_boxes(scene.triangle_boxes(1), scene.objects(over))
    slbvh = build_slbvh(boxes, options_of(over, balance), **limits)
    check_slbvh(slbvh, boxes)
    return replace(scene, hierarchy=slbvh)


# ---- The heap.


def slow_heap(boxes, balance, largest_leaf):
    """Nodes as a dict by number: (axis, leaf, count, first, box), and the order, by plain recursion."""
    order, nodes, codes = [], {}, None
    depth = heap_depth(len(boxes), largest_leaf)
    wide = boxes.astype(np.float64)
    centre = wide[:, :3] + wide[:, 3:]
    if balance == "morton":
        codes = morton_codes(boxes, boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0))
        lists = [np.argsort(codes, kind="stable")]
    else:
        lists = [np.argsort(centre[:, axis], kind="stable") for axis in range(3)]

    def box_of(items):
        return np.concatenate([boxes[items, :3].min(axis=0), boxes[items, 3:].max(axis=0)])

    def cost(items, middle):
        halves = [items[:middle], items[middle:]]
        return sum(half_area(box_of(half)[None])[0] * len(half) for half in halves)

    def add(node, lists):
        count = len(lists[0])
        box = box_of(lists[0])
        if count <= largest_leaf:
            nodes[node] = (0, True, count, len(order), box)
            order.extend(lists[0])
            return
        middle = (count + 1) // 2
        if codes is not None:
            bits = [f"{codes[item]:064b}" for item in lists[0]]
            ones = [sum(bit == "1" for bit in column) for column in zip(*bits, strict=True)]
            room = largest_leaf << (depth - node.bit_length())
            changes = [count - each for each in ones if 0 < each < count]
            middle = int(np.clip(changes[0], count - room, room)) if changes else middle
        extents = [centre[items[-1], axis] - centre[items[0], axis] for axis, items in enumerate(lists)]
        costs = [(cost(items, middle), -extents[axis], axis) for axis, items in enumerate(lists)]
        chosen = min(costs)[2]
        left = set(lists[chosen][:middle])
        halves = [[i for i in items if i in left] for items in lists]
        others = [[i for i in items if i not in left] for items in lists]
        axis = chosen
        if balance == "morton":
            apart = box_of(others[0]).astype(np.float64) - box_of(halves[0])
            axis = int(np.argmax(apart[:3] + apart[3:]))
        nodes[node] = (axis, False, count, len(order), box)
        add(2 * node, halves)
        add(2 * node + 1, others)

    add(1, [items.tolist() for items in lists])
    return nodes, np.array(order)


@given(any_boxes(), st.sampled_from(BALANCES), st.sampled_from([1, 3, 8]))
def test_the_heap_is_that_of_a_plain_recursion(boxes, balance, largest_leaf):
    slbvh = build_slbvh(boxes, options_of(balance=balance), largest_leaf=largest_leaf)
    check_slbvh(slbvh, boxes)
    nodes, order = slow_heap(boxes, balance, largest_leaf)
    assert (slbvh.order is None) == np.array_equal(order, np.arange(len(boxes)))
    np.testing.assert_array_equal(slbvh.objects(), order)
    assert np.flatnonzero(slbvh.counts).tolist() == sorted(nodes)
    for node, (axis, leaf, count, first, box) in nodes.items():
        prim_count, prim_pos = slbvh.nodes[node, 6:]
        assert prim_count == axis | leaf << 2 | count << 3
        assert prim_pos == first
        np.testing.assert_array_equal(slbvh.boxes[node], box)
    assert not slbvh.nodes[slbvh.counts == 0].any()


def test_a_node_is_thirty_two_bytes_as_published():
    """One box: six float32, then PrimCount = 1 object, leaf flag in bit 2, axis 0; then PrimPos."""
    box = np.array([[-1, 2, 3, 4, 5, 6]], np.float32)
    slbvh = build_slbvh(box, options_of())
    assert slbvh.nodes.tobytes() == bytes(32) + box.tobytes() + bytes([0b1100, 0, 0, 0, 0, 0, 0, 0])
    two = build_slbvh(np.float32([[0, 0, 9, 1, 1, 9], [0, 0, 0, 1, 1, 0]]), options_of(), largest_leaf=1)
    assert two.nodes[1, 6] == 0b10010, "two objects, no leaf, split along z"
    assert two.nodes[2:, 6].tolist() == [0b1100, 0b1100]
    assert two.order is not None
    assert two.order.tolist() == [1, 0]


@pytest.mark.parametrize("balance", BALANCES)
def test_heaps_do_not_depend_on_threads(balance):
    boxes = random_boxes(40_000, 5)
    one, three = (build_slbvh(boxes, options_of(balance=balance), threads) for threads in (1, 3))
    np.testing.assert_array_equal(one.nodes, three.nodes)
    np.testing.assert_array_equal(one.objects(), three.objects())


@pytest.mark.parametrize(("count", "leaf"), [(1, 1), (8, 8), (9, 8), (17, 8), (1000, 1), (1025, 1)])
def test_depths_are_the_least(count, leaf):
    depth = heap_depth(count, leaf)
    assert leaf << depth >= count
    assert depth == 0 or leaf << (depth - 1) < count
    assert build_slbvh(random_boxes(count, 1), options_of(), largest_leaf=leaf).nodes.nbytes == heap_bytes(
        depth
    )


def test_heaps_too_deep_or_too_large_are_refused():
    assert heap_bytes(27) == 2**33
    assert heap_depth(MOST_OBJECTS, 8, 2**40) == 26
    with pytest.raises(
        LimitError, match=f"31 levels deep; a trail of 32 bits tells {MOST_DEPTH}.*over strips"
    ):
        heap_depth(2**31, 1, 2**40)
    with pytest.raises(LimitError, match=f"depth 27 takes {2**33} bytes, more than the {BYTE_LIMIT} allowed"):
        heap_depth(2**27, 1)
    with pytest.raises(LimitError, match="the count of a node tells"):
        heap_depth(MOST_OBJECTS + 1, 8, 2**40)
    with pytest.raises(LimitError, match="a heap of depth 3 takes 512 bytes, more than the 511 allowed"):
        build_slbvh(random_boxes(8, 1), options_of(), largest_leaf=1, byte_limit=511)
    build_slbvh(random_boxes(8, 1), options_of(), largest_leaf=1, byte_limit=512)


def test_what_is_no_box_is_refused():
    with pytest.raises(UsageError, match="box 1 is not finite or inverted"):
        build_slbvh(np.float32([[0, 0, 0, 1, 1, 1], [2, 0, 0, 1, 1, 1]]), options_of())
    with pytest.raises(UsageError, match="0 a leaf"):
        build_slbvh(random_boxes(3, 1), options_of(), largest_leaf=0)


# ---- The check.

INNER, A_LEAF, EMPTY = 3, 15, 16


def flaw(word, change):
    def apply(nodes):
        row, column = word
        nodes[row, column] = change(nodes[row, column])

    return apply


def shrunk(bits):
    return np.nextafter(bits.view(np.float32), np.float32(-np.inf), dtype=np.float32).view(np.uint32)


def grown(bits):
    return np.nextafter(bits.view(np.float32), np.float32(np.inf), dtype=np.float32).view(np.uint32)


FLAWS = {
    "the root has 24 objects from 0 on, not 25": flaw((1, PRIM_COUNT), lambda w: w - (1 << COUNT_SHIFT)),
    "the root has 25 objects from 1 on": flaw((1, PRIM_POS), lambda w: w + 1),
    "node 0: an empty node is not zeros": flaw((0, 2), lambda w: np.uint32(1)),
    "node 3: an inner node has no axis": flaw((INNER, PRIM_COUNT), lambda w: w | 3),
    "node 15: an inner node has no room": flaw((A_LEAF, PRIM_COUNT), lambda w: w & ~np.uint32(LEAF)),
    "node 3: something is below a leaf": flaw((INNER, PRIM_COUNT), lambda w: w | LEAF),
    "node 7: a node does not split its": flaw((A_LEAF, PRIM_COUNT), lambda w: w + (1 << COUNT_SHIFT)),
    "node 7: a node does not split": flaw((A_LEAF, PRIM_POS), lambda w: w + 1),
    "node 1: a node does not split": flaw((INNER, PRIM_POS), lambda w: w - 1),
    "node 15: a box does not hold": flaw((A_LEAF, 3), shrunk),
    "node 15: a box is larger": flaw((A_LEAF, 3), grown),
    "node 7: a box does not hold": flaw((7, 4), shrunk),
    "node 1: a box is larger": flaw((1, 5), grown),
    "node 3: a box does not hold what": flaw((7, 0), lambda w: np.float32(np.nan).view(np.uint32)),
}


@pytest.mark.parametrize("what", FLAWS)
def test_the_check_finds(what):
    boxes = random_boxes(25, 7)
    slbvh = build_slbvh(boxes, options_of(), largest_leaf=4)
    assert slbvh.is_leaf[A_LEAF]
    assert len(slbvh.nodes) == EMPTY
    nodes = slbvh.nodes.copy()
    FLAWS[what](nodes)
    with pytest.raises(UnreadableSceneError, match=what):
        check_slbvh(replace(slbvh, nodes=nodes), boxes)


def test_the_check_finds_what_is_below_an_empty_node_and_orders_and_sizes_that_are_none():
    boxes = random_boxes(9, 7)
    slbvh = build_slbvh(boxes, options_of(), largest_leaf=4)
    assert slbvh.is_leaf[3], "so that 6 and 7 are empty"
    nodes = slbvh.nodes.copy()
    nodes[6] = nodes[3]
    with pytest.raises(UnreadableSceneError, match="node 3: something is below"):
        check_slbvh(replace(slbvh, nodes=nodes), boxes)
    with pytest.raises(UnreadableSceneError, match="no permutation"):
        check_slbvh(replace(slbvh, order=slbvh.objects() * 0), boxes)
    with pytest.raises(UnreadableSceneError, match="no power of two"):
        check_slbvh(replace(slbvh, nodes=slbvh.nodes[:-1]), boxes)
    with pytest.raises(UnreadableSceneError, match="no power of two"):
        check_slbvh(replace(slbvh, nodes=slbvh.nodes.astype(np.int64)), boxes)
    deep = np.lib.stride_tricks.as_strided(slbvh.nodes[:1], (2**32, 8), (0, 4))
    with pytest.raises(UnreadableSceneError, match="31 levels deep"):
        check_slbvh(replace(slbvh, nodes=deep), boxes)


# ---- The trail.


def recorded(enters, near_right, room):
    """The nodes that the trail visits, in order, (room,) uint32, 0 behind the last.

    `enters(node)` says whether a node is an inner one that is met, `near_right(node)` whether its near child
    is the right one.
    """

    def visit(carried):
        place, visited, count = carried
        inside, outside = step_in(place, near_right(place.node)), step_out(place)
        entered = enters(place.node)
        there = Place(*(jnp.where(entered, a, b) for a, b in zip(inside, outside, strict=True)))
        return there, visited.at[count].set(place.node), count + 1

    def goes_on(carried):
        return (carried[0].node != 0) & (carried[2] < room)

    begin = Place(jnp.uint32(1), jnp.uint32(1)), jnp.zeros(room, jnp.uint32), 0
    return jax.lax.while_loop(goes_on, visit, begin)[1]


def recursion(enters, near_right):
    visited, waiting = [], [1]
    while waiting:
        node = waiting.pop()
        visited.append(node)
        if enters(node):
            near = 2 * node + near_right(node)
            waiting += [near ^ 1, near]
    return visited


def test_the_trail_visits_random_trees_as_a_recursion_does():
    trees, nodes = 3000, 2**9
    random = np.random.default_rng(1)
    share = random.random((trees, 1))
    inner = (random.random((trees, nodes)) < share) & (np.arange(nodes) < nodes // 2)
    right = random.integers(0, 2, (trees, nodes)).astype(np.uint32)

    @jax.jit
    @jax.vmap
    def walked(inner, right):
        return recorded(lambda node: inner[node], lambda node: right[node], nodes)

    found = np.asarray(walked(inner, right))
    longest = 0
    for tree in range(trees):
        expected = recursion(lambda n, t=tree: inner[t, n], lambda n, t=tree: int(right[t, n]))
        longest = max(longest, len(expected))
        assert found[tree][: len(expected)].tolist() == expected
        assert not found[tree][len(expected) :].any()
    assert longest > 300


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("near", [0, 1])
def test_the_trail_reaches_depth_30(side, near):
    def enters(node):
        spine = node & (node - 1) if side == "left" else node & (node + 1)
        return (spine == 0) & (node < np.uint32(2**MOST_DEPTH))

    expected = recursion(enters, lambda node: near)
    found = jax.jit(lambda: recorded(enters, lambda node: jnp.uint32(near), 100))()
    assert len(expected) == 2 * MOST_DEPTH + 1
    assert np.asarray(found)[: len(expected) + 1].tolist() == [*expected, 0]


# ---- The walk.

MESHES = {**SHAPES, "far away": (sphere(3)[0] + np.float32(1e4), sphere(3)[1])}


def scene_named(name, block=16):
    return scene_of(clean(Mesh(*MESHES[name])).mesh, max_length=12, block=block)


def assert_same_hits(scene, other, origins, directions, t_max=None):
    one, two = (Tracer(s, device="cpu", threads=1) for s in (scene, other))
    expected, found = (tracer.closest_hit(origins, directions, t_max=t_max) for tracer in (one, two))
    assert_equal_hits(HIT_FIELDS, ((scene, expected), (other, found)), origins, directions)
    np.testing.assert_array_equal(two.any_hit(origins, directions, t_max=t_max), found.hit)
    return expected


@pytest.mark.parametrize("over", OVERS)
@pytest.mark.parametrize("balance", BALANCES)
@pytest.mark.parametrize("name", MESHES)
def test_hits_are_those_of_the_default_walk(name, balance, over):
    scene = scene_named(name)
    origins, directions = rays_at(scene, 400, 3)
    hits = assert_same_hits(scene, under(scene, over, balance), origins, directions)
    assert hits.hit.any()
    t_max = np.where(hits.hit, hits.t, 1) * np.float32(1.0)
    assert_same_hits(scene, under(scene, over, balance), origins, directions, t_max)


@settings(max_examples=15)
@given(scenes(), st.sampled_from(OVERS), st.sampled_from(BALANCES), st.integers(0, 2**32 - 1))
def test_any_mesh_has_the_same_hits(case, over, balance, seed):
    scene = case[1]
    rays = rays_at(scene, 60, seed)
    assert_same_hits(scene, under(scene, over, balance), *rays)


class Twin:
    """The walk of a ray as a plain recursion, near child first, by the box and the leaf tests of the walk."""

    met = staticmethod(jax.jit(lambda nodes, node, slab, limit: lanes_met(nodes[node], slab, limit)))
    tested = staticmethod(jax.jit(walk_single.test_leaf))

    def __init__(self, arrays, ray, far_first=False):
        self.arrays, self.ray, self.far_first = arrays, ray, far_first
        self.words = np.asarray(arrays.nodes).view(np.uint32)
        self.best = nothing_yet(ray)
        self.visited, self.leaves = [], []
        self.visit(1)

    def visit(self, node):
        self.visited.append(node)
        prim_count, prim_pos = self.words[node, 6:]
        if not self.met(self.arrays.nodes, node, self.ray.slab, self.best.nearest * SLACK):
            return
        if prim_count & LEAF:
            self.leaves.append(int(prim_pos))
            self.best = self.tested(self.arrays.leaves, jnp.uint32(prim_pos), self.ray, self.best)
            return
        against = not int(self.ray.octant) >> int(prim_count & 3) & 1
        near = 2 * node + (against != self.far_first)
        self.visit(near)
        self.visit(near ^ 1)


def trail_of(arrays, ray):
    """The nodes that the walk's own steps visit."""
    visit = jax.jit(lambda state, limit: _visit(arrays, ray, state, limit))
    state, best = _State(Place(jnp.uint32(1), jnp.uint32(1)), arrays.no_leaf, jnp.int32(0)), nothing_yet(ray)
    visited = []
    while state.place.node != 0:
        visited.append(int(state.place.node))
        state = visit(state, best.nearest * SLACK)
        best = Twin.tested(arrays.leaves, state.leaf, ray, best)
        state = state._replace(leaf=arrays.no_leaf)
    return visited


@pytest.mark.parametrize("name", MESHES)
@pytest.mark.parametrize("balance", BALANCES)
def test_visits_are_those_of_a_recursion_near_child_first(name, balance):
    scene = under(scene_named(name), "triangles", balance, largest_leaf=3)
    origins, directions = rays_at(scene, 12, 8)
    counted = Tracer(scene, device="cpu", threads=1).closest_hit(origins, directions, counters=True).counters
    arrays = jax.tree.map(jnp.asarray, lay_out_slbvh(scene, scene.hierarchy).arrays)
    t_max = np.full(len(origins), np.inf, np.float32)
    first = np.asarray(arrays.leaves.first)
    for k, row in enumerate(prepared_rays(arrays, origins, directions, t_max)):
        ray = ReadyRay(row)
        twin = Twin(arrays, ray)
        assert trail_of(arrays, ray) == twin.visited
        blocks = sum(int(first[leaf + 1] - first[leaf]) for leaf in twin.leaves)
        triangles = sum(
            int(scene.hierarchy.counts[scene.hierarchy.is_leaf & leaf_at(scene, leaf)][0])
            for leaf in twin.leaves
        )
        visits, leaves = len(twin.visited), len(twin.leaves)
        expected = (visits, leaves, visits, triangles, 32 * visits, 320 * blocks + 8 * leaves)
        assert tuple(column[k] for column in counted) == expected


def leaf_at(scene, leaf):
    """The node that is a leaf's, by its number from left to right."""
    nodes = scene.hierarchy.nodes
    places = np.sort(nodes[scene.hierarchy.is_leaf, PRIM_POS])
    return nodes[:, PRIM_POS] == places[leaf]


def test_a_walk_that_goes_to_the_far_child_first_would_be_seen():
    scene = under(scene_named("closed"), "triangles", "sah")
    arrays = jax.tree.map(jnp.asarray, lay_out_slbvh(scene, scene.hierarchy).arrays)
    rays = rays_at(scene, 4, 8)
    rows = prepared_rays(arrays, *rays, np.full(4, np.inf, np.float32))
    assert any(trail_of(arrays, ReadyRay(row)) != Twin(arrays, ReadyRay(row), True).visited for row in rows)


def test_a_ray_that_misses_the_root_visits_the_root():
    tracer = Tracer(under(small_scene(), "triangles", "sah"), device="cpu")
    counters = tracer.closest_hit([[0, 0, 50]], [[0, 0, 1]], counters=True).counters
    assert [int(count[0]) for count in counters] == [1, 0, 1, 0, 32, 0]


def loop_carries(jaxpr):
    """What the while loops within a jaxpr carry, constants left out: lists of shapes."""
    found = []
    for equation in jaxpr.eqns:
        if equation.primitive.name == "while":
            constants = equation.params["cond_nconsts"] + equation.params["body_nconsts"]
            found.append([v.aval.shape for v in equation.invars[constants:]])
        if equation.primitive.name == "scan":
            first = equation.params["num_consts"]
            found.append(
                [v.aval.shape for v in equation.invars[first : first + equation.params["num_carry"]]]
            )
        for parameter in equation.params.values():
            inner = getattr(parameter, "jaxpr", parameter)
            if hasattr(inner, "eqns"):
                found += loop_carries(inner)
    return found


def carries_of(scene, any_hit=False, count=False):
    tracer = Tracer(scene, device="cpu", threads=1)
    options = tracer._options(any_hit=any_hit, counting=count)
    rows, live = np.zeros((256, ROW), np.float32), np.full(1, 256, np.int32)
    traced = program(tracer._mesh, options).trace(tracer._scene, rows, live)
    return loop_carries(traced.jaxpr.jaxpr)


@pytest.mark.parametrize("count", [False, True])
@pytest.mark.parametrize("any_hit", [False, True])
def test_no_loop_carries_a_stack(any_hit, count):
    """A place, a leaf, a count of turns and what was found: no array."""
    over_rays, *carries = carries_of(under(small_scene(), "triangles", "sah"), any_hit, count)
    assert {shape[0] for shape in over_rays if shape} == {256}, "what is told of all rays, and no stack"
    assert len(carries) >= 3
    assert {shape for shapes in carries for shape in shapes} == {()}
    assert max(sum(int(np.prod(shape)) for shape in shapes) for shapes in carries) < 16


def test_a_stack_would_be_seen():
    carries = carries_of(small_scene())
    assert (16, 2) in {shape for shapes in carries for shape in shapes}


@pytest.mark.parametrize("name", ["soup", "closed"])
def test_all_rays_at_once_have_the_same_hits_and_visits(name):
    """As a GPU walks them: by vmap."""
    scene = under(scene_named(name), "triangles", "sah")
    arrays = jax.tree.map(jnp.asarray, lay_out_slbvh(scene, scene.hierarchy).arrays)
    rays = rays_at(scene, 64, 5)
    ready = prepared_rays(arrays, *rays, np.full(64, np.inf, np.float32)).at[7].set(0)
    one_by_one, at_once = (
        jax.jit(SlbvhScene.walk_rays, static_argnums=2)(
            arrays, ready, WalkOptions(1, False, True, 16, batch=batch)
        )
        for batch in (False, True)
    )
    for one, other in zip(one_by_one, at_once, strict=True):
        np.testing.assert_array_equal(one, other)
    assert one_by_one.name[7] == MISS
    assert (one_by_one.name >= 0).any()


def test_a_heap_without_end_is_stuck_and_no_hang():
    scene = under(small_scene(), "triangles", "sah")
    tracer = Tracer(scene, device="cpu")
    layout = lay_out_slbvh(scene, scene.hierarchy)
    layout.arrays.nodes[:] = layout.arrays.nodes[1]
    layout.arrays.nodes.view(np.uint32)[:, PRIM_COUNT] &= ~np.uint32(LEAF)
    tracer._take(layout)
    with pytest.raises(StriptoolsError, match="did not end"):
        tracer.closest_hit([[0.5, 0.5, 9]], [[0.01, 0.01, -1]])


@pytest.mark.parametrize("name", ["bunny", "cad_frame"])
def test_real_meshes_have_the_same_hits(name, real_mesh):
    scene = striptools.convert(real_mesh(name))
    rays = rays_at(scene, 3000, 1)
    for balance in BALANCES:
        assert_same_hits(scene, under(scene, "triangles", balance), *rays)
