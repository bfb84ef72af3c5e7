"""Scenes under hierarchies of their own answer every query, through wide nodes made on the first of them."""

import numpy as np
import pytest
from rays import rays_at
from scenes import scene_of
from strategies import sphere
from test_trace import clean

from striptools.errors import UsageError
from striptools.hierarchies.options import HierarchyOptions
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer, functional

KINDS = ("slbvh", "kdtree", "presorted", "loose-octree")


@pytest.fixture(scope="module")
def ball():
    return scene_of(Mesh(*clean(sphere(2))))


@pytest.fixture(scope="module")
def plain(ball):
    return Tracer(ball, device="cpu", threads=1)


def under(scene, kind, **options):
    return Tracer(scene.under(HierarchyOptions(kind)), device="cpu", threads=1, **options)


def points_near(scene):
    random = np.random.default_rng(2)
    return random.uniform(1.3 * scene.low, 1.3 * scene.high, (200, 3)).astype(np.float32)


@pytest.mark.parametrize("kind", KINDS)
def test_queries_are_those_of_the_default_hierarchy_bit_for_bit(ball, plain, kind):
    tracer, rays, points = under(ball, kind), rays_at(ball, 300, 3), points_near(ball)
    ours, theirs = tracer.all_hits(*rays, k=4), plain.all_hits(*rays, k=4)
    for name in ("t", "face", "u", "v", "count"):
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes()
    assert ours.count.max() > 1
    # Triangles are numbered in an order of the hierarchy's own, so they are looked up in its scene.
    triangles = tracer.all_hits(*rays, k=1).triangle[:, 0]
    np.testing.assert_array_equal(triangles, tracer.closest_hit(*rays).triangle)
    assert tracer.count_hits(*rays).tobytes() == plain.count_hits(*rays).tobytes()
    for method in ("parity", "winding"):
        inside = tracer.contains(points, method=method)
        assert inside.tobytes() == plain.contains(points, method=method).tobytes()
        assert 0 < inside.mean() < 1
    ours, theirs = (one.closest_point(points, signed=True) for one in (tracer, plain))
    for name in ("point", "distance", "face", "u", "v"):
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("test", ["fast", "exact-sign", "float64"])
def test_triangle_tests_are_those_of_the_default_hierarchy(ball, kind, test):
    rays = rays_at(ball, 300, 3)
    plain = Tracer(ball, device="cpu", threads=1, test=test)
    ours, theirs = under(ball, kind, test=test).closest_hit(*rays), plain.closest_hit(*rays)
    for name in ("t", "face", "u", "v"):
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes()


@pytest.mark.parametrize("kind", KINDS)
def test_functions_of_arrays_gather_too(ball, plain, kind):
    rays = rays_at(ball, 100, 3)
    faces = np.zeros((ball.source_face_count, 3), np.int32)
    ours, theirs = (functional.Geometry.of(one, faces) for one in (under(ball, kind), plain))
    np.testing.assert_array_equal(functional.count_hits(ours, *rays), functional.count_hits(theirs, *rays))


def test_hits_stay_the_hierarchys_own_and_memory_is_told(ball, plain, monkeypatch):
    made = []
    of_layout = Tracer.of_layout

    def noting(layout, **options):
        made.append(layout)
        return of_layout(layout, **options)

    monkeypatch.setattr(Tracer, "of_layout", noting)
    tracer, rays = under(ball, "slbvh"), rays_at(ball, 300, 3)
    own, before = tracer.resident_bytes, tracer.closest_hit(*rays, counters=True).counters
    assert not made
    tracer.count_hits(*rays)
    tracer.closest_point(rays[0])
    # One tracer beside it, whatever is asked.
    assert len(made) == 1
    beside = Tracer(ball, device="cpu", threads=1, hierarchy="rebuilt").resident_bytes
    assert tracer.resident_bytes == own + beside
    after = tracer.closest_hit(*rays, counters=True).counters
    np.testing.assert_array_equal(before.nodes, after.nodes)
    assert (before.nodes != plain.closest_hit(*rays, counters=True).counters.nodes).any()


def test_a_layout_without_a_scene_is_refused(ball):
    tracer = Tracer.of_layout(under(ball, "slbvh")._layout, device="cpu", threads=1)
    rays = rays_at(ball, 4, 3)
    for call in (
        lambda: tracer.all_hits(*rays, k=2),
        lambda: tracer.count_hits(*rays),
        lambda: tracer.contains(rays[0]),
        lambda: tracer.closest_point(rays[0]),
        lambda: tracer.winding_numbers(rays[0]),
    ):
        with pytest.raises(UsageError, match="go through this hierarchy"):
            call()
