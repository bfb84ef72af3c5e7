"""The walk through binary hierarchies: the same hits as the default one, whoever built the hierarchy."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rays import rays_at
from scenes import scene_of, scenes, small_scene
from shapes import COMMON
from strategies import cube, grid, line, sphere, tangle
from test_hoisting import assert_hoisted
from test_trace import clean, far_fetched

from striptools.errors import StriptoolsError
from striptools.hierarchies.loose_octree import build_linear_bvh, build_loose_octree, build_sah_bvh
from striptools.hierarchies.options import HierarchyOptions
from striptools.kernels.rays import ROW
from striptools.mesh.mesh import Mesh
from striptools.partition.boxes import range_boxes
from striptools.trace import Tracer
from striptools.trace.binary import lay_out_binary
from striptools.trace.launch import program
from striptools.trace.walk import WalkOptions, trace_rays

OVER = ("triangles", "strips", "blocks")
BUILDERS = (build_loose_octree, build_linear_bvh, build_sah_bvh)


def under(scene, over="triangles", build=build_loose_octree, leaf_size=None):
    """The scene with a binary hierarchy of its own."""
    boxes = range_boxes(scene.triangle_boxes(), scene.objects(over))
    built = build(boxes, HierarchyOptions("loose-octree", over=over), leaf_size=leaf_size)
    return replace(scene, hierarchy=built)


def assert_same(scene, other, origins, directions, t_max=np.inf):
    """Hits of both scenes are equal bit for bit, but those that `far_fetched` explains."""
    ours, theirs = (Tracer(one, device="cpu", threads=1) for one in (other, scene))
    first, second = (one.closest_hit(origins, directions, t_max=t_max) for one in (ours, theirs))
    doubted = far_fetched(scene, first, origins, directions) | far_fetched(scene, second, origins, directions)
    for name in ("t", "face", "u", "v", "triangle"):
        np.testing.assert_array_equal(getattr(first, name)[~doubted], getattr(second, name)[~doubted])
    np.testing.assert_array_equal(ours.any_hit(origins, directions, t_max=t_max), first.hit)
    return second.hit & ~doubted


@settings(max_examples=20)
@given(scenes(), st.sampled_from(OVER), st.sampled_from(BUILDERS), st.integers(0, 2**32 - 1))
def test_hits_are_those_of_the_default_walk(drawn, over, build, seed):
    _, scene = drawn
    origins, directions = rays_at(scene, 64, seed)
    assert_same(scene, under(scene, over, build), origins, directions)


@pytest.mark.parametrize("shape", [*COMMON.values(), tangle(12, 80, 4)])
@pytest.mark.parametrize("over", OVER)
def test_hits_of_every_shape(shape, over):
    scene = scene_of(Mesh(*clean(shape)), spare_faces=3, block=16)
    origins, directions = rays_at(scene, 300, 5)
    assert assert_same(scene, under(scene, over), origins, directions).sum() > 50


def test_hits_nearer_than_a_limit():
    scene = scene_of(Mesh(*sphere(2)))
    origins, directions = rays_at(scene, 300, 6)
    reach = np.random.default_rng(1).exponential(1.0, 300).astype(np.float32)
    hit = assert_same(scene, under(scene), origins, directions, t_max=reach)
    assert 0 < hit.sum() < 300


def test_a_scene_of_one_leaf_or_one_triangle():
    for shape in (cube(), (sphere(0)[0][:3], np.array([[0, 1, 2]], np.int32)), line(1)):
        mesh = Mesh(shape[0], shape[1][:8])
        scene = scene_of(mesh)
        origins, directions = rays_at(scene, 64, 7)
        for over in ("triangles", "blocks"):
            assert_same(scene, under(scene, over), origins, directions)


@pytest.fixture(scope="module")
def ball():
    return scene_of(Mesh(*sphere(3)), max_length=16, block=64)


def test_counters_say_what_was_done(ball):
    origins, directions = rays_at(ball, 200, 8)
    for over in OVER:
        hits = Tracer(under(ball, over), device="cpu", threads=1).closest_hit(
            origins, directions, counters=True
        )
        counted = hits.counters
        np.testing.assert_array_equal(counted.boxes, 2 * counted.nodes + 1)
        np.testing.assert_array_equal(counted.node_bytes, 64 * counted.nodes)
        assert (counted.leaves[hits.hit] >= 1).all()
        assert (counted.triangles >= counted.leaves).all()
        assert (counted.geometry_bytes % 320 == 0).all()
        assert (counted.geometry_bytes >= 320 * counted.leaves).all()
        assert counted.nodes.max() > 4


def test_a_ray_that_misses_the_root_tests_its_box(ball):
    counted = (
        Tracer(under(ball), device="cpu", threads=1)
        .closest_hit(np.array([[9.0, 9, 9]]), np.array([[0.0, 0, 1]]), counters=True)
        .counters
    )
    assert [int(column[0]) for column in counted] == [0, 0, 1, 0, 0, 0]


def test_what_waits_is_left_out_once_it_is_too_far():
    # Many parallel squares: the nearest one ends the walk.
    squares = [grid(4, 4)[0] + np.float32([0, 0, k]) for k in range(64)]
    faces = np.concatenate([grid(4, 4)[1] + 25 * k for k in range(64)]).astype(np.int32)
    scene = under(scene_of(Mesh(np.concatenate(squares), faces)), leaf_size=1)
    tracer = Tracer(scene, device="cpu", threads=1)
    hits = tracer.closest_hit(np.array([[1.3, 1.6, -5]]), np.array([[0.0, 0, 1]]), counters=True)
    assert hits.t[0] == 5
    assert hits.counters.leaves[0] <= 4
    assert hits.counters.nodes[0] <= 24


def test_walking_all_rays_at_once_gives_the_same(ball):
    scene = under(ball)
    origins, directions = rays_at(ball, 200, 6)
    tracer = Tracer(scene, device="cpu", threads=1)
    expected = tracer.closest_hit(origins, directions, counters=True)
    options = WalkOptions(1, any_hit=False, counting=True, stack_size=16, batch=True)
    reach = np.full(len(origins), np.inf, np.float32)
    layout = lay_out_binary(scene, scene.hierarchy.nodes, scene.hierarchy.order, "triangles")
    traced = jax.jit(trace_rays, static_argnames="options")(
        layout.arrays, origins, directions, reach, options=options
    )
    np.testing.assert_array_equal(traced.t, expected.t)
    np.testing.assert_array_equal(traced.name, expected.face)
    started = expected.counters.nodes > 0
    np.testing.assert_array_equal(
        np.asarray(traced.counters)[started, 3], expected.counters.triangles[started]
    )


@pytest.mark.parametrize(("any_hit", "counting"), [(False, False), (True, False), (False, True)])
def test_the_walk_is_hoisted(any_hit, counting):
    tracer = Tracer(under(small_scene(), leaf_size=1), device="cpu")
    options = tracer._options(any_hit=any_hit, counting=counting)
    rays = np.zeros((256 * len(tracer.devices), ROW), np.float32)
    live = np.full(len(tracer.devices), 256, np.int32)
    assert_hoisted(program(tracer._mesh, options).lower(tracer._scene, rays, live))


def test_a_walk_in_circles_ends(ball):
    scene = under(ball)
    nodes, order = scene.hierarchy.nodes, scene.hierarchy.order
    tracer = Tracer(scene, device="cpu", threads=1)
    layout = lay_out_binary(scene, nodes, order, "triangles")
    layout.arrays.nodes[:, 12:14].view(np.int32)[:] = 0
    tracer._take(layout)
    with pytest.raises(StriptoolsError, match="did not end"):
        tracer.closest_hit(np.array([[0.0, 0, 5]]), np.array([[0.0, 0, -1]]))
