"""Triangle tests other than the default one through shared instances: the bits of the flattened scene."""

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
from test_hoisting import assert_hoisted
from test_instanced_points import crowd as crowd
from test_instances import SCENES, load
from test_shared_instances import (
    KINDS,
    assert_same_at_once,
    mesh_of,
    random_matrices,
    rays_through,
    sphere,
)

from striptools.pipeline import convert
from striptools.trace import Tracer, instanced, walk_instances
from striptools.trace.instanced import instances_program
from striptools.types import TriangleTest

TESTS = [test for test in get_args(TriangleTest) if test != "watertight"]
SOME = [(test, "expanded") for test in TESTS] + [("exact-sign", "compressed")]
"""Each test, and each residency: programs of these tests take seconds to compile."""

COLUMNS = ("t", "face", "u", "v", "triangle", "instance", "geometry", "geometry_face")


def both(scene, test, resident="expanded"):
    return (
        Tracer(scene, device="cpu", threads=1, instances="shared", resident=resident, test=test),
        Tracer(scene, device="cpu", threads=1, instances="flattened", test=test),
    )


def rays_at(scene, count, seed=0, test="exact-sign"):
    """Rays through a scene; half of them at its corners and at the middles of its edges, as float32 has them.

    Beside them where the test is the fast one: it may tell a ray at an edge a t that is before the triangle's
    box, and which of equals it finds then depends on the boxes.
    """
    origins, directions = rays_through(scene, count, seed)
    random, placed = np.random.default_rng(seed), scene.placed()
    corners = placed.positions[placed.faces()[random.integers(0, placed.triangle_count, count)]]
    at_edge = random.random((count, 1)) < 0.5
    targets = np.where(at_edge, corners[:, 0], (corners[:, 0] + corners[:, 1]) / 2)
    if test == "fast":
        targets = targets + (corners[:, 2] - targets) * random.uniform(0.01, 0.1, (count, 1))
    directions[::2] = (targets - origins)[::2]
    return origins, directions


def assert_same(ours, theirs, columns):
    for name in columns:
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes(), name


def check_all(scene, test, resident, rays):
    """Raise where anything that is asked of rays is not what it is of the flattened scene."""
    shared, flat = both(scene, test, resident)
    ours = shared.closest_hit(*rays)
    assert_same(ours, flat.closest_hit(*rays), COLUMNS)
    assert_same(shared.all_hits(*rays, k=4), flat.all_hits(*rays, k=4), (*COLUMNS, "count"))
    np.testing.assert_array_equal(shared.any_hit(*rays), ours.hit)
    np.testing.assert_array_equal(shared.count_hits(*rays), flat.count_hits(*rays))
    np.testing.assert_array_equal(shared.contains(rays[0]), flat.contains(rays[0]))
    near = np.where(ours.hit, ours.t, np.float32(1))
    assert not shared.closest_hit(*rays, t_max=near).hit[ours.hit].any()
    return ours


@pytest.mark.parametrize("resident", KINDS)
@pytest.mark.parametrize("test", TESTS)
def test_all_that_is_asked_of_rays_is_that_of_the_flattened_scene(crowd, test, resident):
    _, scene = crowd
    hits = check_all(scene, test, resident, rays_at(scene, 4000, 0, test))
    assert hits.hit.sum() > 1000
    assert len(np.unique(hits.instance)) > 20


@pytest.mark.parametrize("name", sorted(SCENES))
def test_closest_hits_of_all_kinds_of_scenes(name):
    scene = convert(load(SCENES[name]))
    rays = rays_at(scene, 2000, 1)
    for resident in KINDS:
        shared, flat = both(scene, "exact-sign", resident)
        hits = shared.closest_hit(*rays)
        assert_same(hits, flat.closest_hit(*rays), COLUMNS)
        assert hits.hit.sum() > 300


@pytest.mark.parametrize(("test", "resident"), SOME)
def test_instances_that_their_matrices_bring_back_from_far_away(test, resident):
    check_all(far_away(), test, resident, rays_at(far_away(), 2000, 2, test))


def far_away():
    """Instances whose products are 1000 times what they add up to, and some of a millionth of the scene."""
    random = np.random.default_rng(2)
    far = np.array([1000.0, -2000.0, 500.0])
    matrices = random_matrices(random, 8, 0.5)
    matrices[:6, :, 3] -= np.einsum("kij,j->ki", matrices[:6, :, :3], far)
    matrices[6:, :, :3] *= 1e-5
    return convert(mesh_of([sphere(9, 12, far), sphere()], [0, 0, 0, 0, 0, 0, 1, 1], matrices))


def test_hits_are_those_of_every_triangle_in_float64(crowd):
    """A slow twin: the edge functions of all triangles, corners as the flattened scene rounds them."""
    _, scene = crowd
    placed = scene.placed()
    corners = placed.positions[placed.faces()].astype(np.float64)
    rays = rays_through(scene, 400, 3)
    clear = 0
    tracers = [both(scene, test)[0].closest_hit(*rays) for test in TESTS]
    for k, (origin, way) in enumerate(zip(*(each.astype(np.float64) for each in rays), strict=True)):
        a, b, c = (corners[:, j] - origin for j in range(3))
        volumes = np.stack([np.cross(b, c) @ way, np.cross(c, a) @ way, np.cross(a, b) @ way], axis=1)
        whole = volumes.sum(axis=1)
        weights = volumes / np.where(whole == 0, 1, whole)[:, None]
        t = (np.einsum("nj,njx->nx", weights, np.stack([a, b, c], axis=1)) @ way) / (way @ way)
        ahead = (weights.min(axis=1) >= 0) & (t > 0)
        if (np.abs(weights[t > 0]).min(axis=1) < 1e-3).any() or np.abs(np.diff(np.sort(t[ahead]))).min(
            initial=1
        ) < 1e-4 * t[ahead].max(initial=0):
            continue
        clear += 1
        first = np.where(ahead, t, np.inf).argmin() if ahead.any() else -1
        for hits in tracers:
            assert hits.triangle[k] == first
            assert first < 0 or abs(hits.t[k] - t[first]) <= 1e-4 * t[first]
    assert clear > 100


def test_all_rays_at_once_find_the_same(crowd):
    """As a GPU walks them."""
    _, scene = crowd
    tracer = both(scene, "exact-sign")[0]
    rays = (*rays_at(scene, 128, 4), np.full(128, np.inf, np.float32))
    assert_same_at_once(tracer, rays, tracer._options())


@pytest.mark.parametrize(("test", "resident"), SOME)
def test_the_walk_is_hoisted(test, resident):
    tracer = both(convert(load(SCENES["mirrored"])), test, resident)[0]
    rays = np.zeros((256, 3), np.float32)
    program = instances_program(tracer._mesh, tracer._options())
    assert_hoisted(program.lower(tracer._scene, rays, rays, rays[:, 0]), loops=5)


def test_threads_change_nothing_and_counters_count_both_levels(crowd):
    _, scene = crowd
    rays = rays_at(scene, 2000, 5)
    one = both(scene, "exact-sign")[0].closest_hit(*rays, counters=True)
    many = Tracer(scene, device="cpu", instances="shared", test="exact-sign").closest_hit(*rays)
    assert_same(one, many, COLUMNS)
    assert (one.counters.triangles[one.hit] >= 1).all()


def specks():
    """Instances of a ten-thousandth of the scene: moved rays are off by much of what these are wide."""
    matrices = random_matrices(np.random.default_rng(1), 20, 1.0)
    matrices[:, :, :3] *= 1e-4
    return convert(mesh_of([sphere()], np.zeros(20), matrices))


def rays_from_near(scene, count):
    """Rays at corners, from as near as instances are wide."""
    random, placed = np.random.default_rng(6), scene.placed()
    targets = placed.positions[placed.faces()[random.integers(0, placed.triangle_count, count), 0]]
    origins = (targets + random.normal(size=(count, 3)) * 3e-4).astype(np.float32)
    return origins, targets - origins


@pytest.mark.parametrize("resident", KINDS)
def test_specks_are_hit_by_rays_from_next_to_them(resident):
    hits = check_all(specks(), "exact-sign", resident, rays_from_near(specks(), 5000))
    assert hits.hit.all()


def test_boxes_that_are_not_widened_would_lose_hits():
    scene = specks()
    rays = rays_from_near(scene, 5000)
    tracer, flat = both(scene, "exact-sign")
    arrays = tracer._layout.arrays
    none = arrays.places._replace(slips=np.full_like(arrays.places.slips, -walk_instances.CORNER_SLIPS))
    tracer._take(replace(tracer._layout, arrays=arrays._replace(places=none)))
    assert (tracer.closest_hit(*rays).face != flat.closest_hit(*rays).face).sum() > 100


def test_weights_of_another_order_of_corners_would_be_seen(crowd, monkeypatch):
    _, scene = crowd
    rays = rays_at(scene, 4000, 7, "fast")
    right = both(scene, "fast")[1].closest_hit(*rays)
    monkeypatch.setattr(instanced, "_first_corners", lambda corners: np.zeros(len(corners), np.int64))
    wrong = both(scene, "fast")[0].closest_hit(*rays)
    assert right.face.tobytes() == wrong.face.tobytes()
    assert right.u.tobytes() != wrong.u.tobytes()
