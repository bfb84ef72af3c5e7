"""All hits and their number: equal to trying every triangle, sorted, the same whatever the residency."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rays import rays_at
from scenes import scene_of, scenes, small_scene
from shapes import COMMON
from strategies import grid, sphere
from test_trace import clean, far_fetched, flushed, named_corners, try_one

from striptools.errors import UsageError
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer
from striptools.trace.gathering import MOST_HITS
from striptools.trace.leaves import scale_of

COLUMNS = ("t", "face", "u", "v", "triangle", "count")


@np.errstate(all="ignore")
def try_all(scene, origins, directions, **options):
    """All hits of each ray by trying every triangle: a list for each, of (t, face, u, v)."""
    corners, ids, turns = named_corners(scene)
    scale = scale_of(scene)
    rays = zip(flushed(origins) * scale, directions, strict=True)
    found = [try_one(corners, ids, turns, o, d, **options) for o, d in rays]
    return [[(np.float32(t / scale), face, u, v) for t, face, u, v in hits] for hits in found]


def doubted(scene, origins, directions):
    """Rays that the signs of some triangle seen edge-on take for hitting it far away, see `near`."""
    near, anywhere = (try_all(scene, origins, directions, all_signs=flag) for flag in (False, True))
    return np.array([len(a) != len(b) for a, b in zip(near, anywhere, strict=True)])


def padded(expected, k):
    """The first k hits of each ray as arrays (r, k): t, face, u, v."""
    miss = (np.inf, -1, 0, 0)
    rows = [(hits + [miss] * k)[:k] for hits in expected]
    columns = np.array(rows, np.float64).reshape(-1, k, 4)
    return tuple(columns[..., j] for j in range(4))


@pytest.fixture(scope="module")
def ball():
    return scene_of(Mesh(*sphere(3)))


@pytest.mark.parametrize("shape", COMMON.values(), ids=COMMON)
@pytest.mark.parametrize("resident", ["expanded", "compressed"])
@pytest.mark.parametrize("remap", [True, False])
def test_all_hits_equal_trying_every_triangle(shape, resident, remap):
    scene = scene_of(Mesh(*clean(shape)), remap=remap, spare_faces=3 if remap else 0)
    origins, directions = rays_at(scene, 150, 5)
    tracer = Tracer(scene, device="cpu", threads=1, resident=resident)
    sure = ~doubted(scene, origins, directions)
    assert sure.mean() > 0.8
    origins, directions = origins[sure], directions[sure]
    expected = try_all(scene, origins, directions)
    np.testing.assert_array_equal(tracer.count_hits(origins, directions), [len(hits) for hits in expected])
    k = 7
    hits = tracer.all_hits(origins, directions, k=k)
    t, face, u, v = padded(expected, k)
    np.testing.assert_array_equal(hits.t, t.astype(np.float32))
    np.testing.assert_array_equal(hits.face, face)
    np.testing.assert_allclose(hits.u, u, atol=1e-6)
    np.testing.assert_allclose(hits.v, v, atol=1e-6)
    np.testing.assert_array_equal(hits.count, [min(k, len(found)) for found in expected])
    ids = np.arange(scene.triangle_count) if scene.remap is None else scene.remap.face
    np.testing.assert_array_equal(np.where(hits.triangle < 0, -1, ids[hits.triangle]), hits.face)
    assert max(map(len, expected)) > 1 or len(shape[1]) == 800


@settings(max_examples=10)
@given(scenes(), st.integers(0, 2**32 - 1), st.sampled_from([1, 3, 16]))
def test_any_scene_in_both_residencies(drawn, seed, k):
    _, scene = drawn
    origins, directions = rays_at(scene, 40, seed)
    expanded = Tracer(scene, device="cpu", threads=1, resident="expanded")
    compressed = Tracer(scene, device="cpu", threads=1, resident="compressed")
    closest = expanded.closest_hit(origins, directions)
    first = expanded.all_hits(origins, directions, k=k)
    for name in ("t", "face", "u", "v", "triangle"):
        np.testing.assert_array_equal(getattr(first, name)[:, 0], getattr(closest, name))
    assert (first.count <= expanded.count_hits(origins, directions)).all()
    later = compressed.all_hits(origins, directions, k=k)
    sure = ~far_fetched(scene, closest, origins, directions) & ~doubted(scene, origins, directions)
    for name in COLUMNS:
        np.testing.assert_array_equal(getattr(first, name)[sure], getattr(later, name)[sure])


@pytest.mark.parametrize("k", [1, 2, 3, 40])
def test_more_hits_asked_for_only_go_on(k, ball):
    origins, directions = rays_at(ball, 500, 1)
    tracer = Tracer(ball, device="cpu", threads=1)
    few, many = tracer.all_hits(origins, directions, k=k), tracer.all_hits(origins, directions, k=64)
    for name in COLUMNS[:-1]:
        np.testing.assert_array_equal(getattr(few, name), getattr(many, name)[:, :k])
    assert few.t.shape == (500, k)
    assert (many.t[:, 1:] >= many.t[:, :-1]).all()


def test_a_ray_through_an_edge_meets_both_faces_and_through_a_corner_all():
    scene = scene_of(Mesh(*clean(grid(4, 4))))
    origins = np.array([[1.5, 1.0, 3.0], [1.25, 1.5, 3.0], [2.0, 2.0, 3.0]], np.float32)
    tracer = Tracer(scene, device="cpu", threads=1)
    down = np.tile(np.float32([0, 0, -1]), (3, 1))
    np.testing.assert_array_equal(tracer.count_hits(origins, down), [2, 1, 6])
    hits = tracer.all_hits(origins, down, k=8)
    np.testing.assert_array_equal(hits.count, [2, 1, 6])
    assert (hits.t[2, :6] == 3).all()
    assert (np.diff(hits.face[2, :6]) > 0).all()


def test_only_hits_before_t_max_are_listed_and_counted(ball):
    origins = np.full((3, 3), [0.01, 0.02, -5], np.float32)
    directions = np.tile(np.float32([0, 0, 1]), (3, 1))
    tracer = Tracer(ball, device="cpu", threads=1)
    near, far = tracer.all_hits(origins[:1], directions[:1], k=2).t[0]
    reach = np.array([near, np.nextafter(near, np.float32(9)), np.nextafter(far, np.float32(9))], np.float32)
    np.testing.assert_array_equal(tracer.count_hits(origins, directions, t_max=reach), [0, 1, 2])
    np.testing.assert_array_equal(tracer.all_hits(origins, directions, k=5, t_max=reach).count, [0, 1, 2])
    assert tracer.all_hits(origins, directions, k=5, t_max=float(far)).t[0, 0] == near


def test_all_threads_and_the_rebuilt_hierarchy_give_the_same(ball):
    origins, directions = rays_at(ball, 3001, 4)
    expected = Tracer(ball, device="cpu", threads=1).all_hits(origins, directions, k=5)
    for options in ({}, {"hierarchy": "rebuilt"}, {"resident": "compressed"}):
        other = Tracer(ball, device="cpu", **options).all_hits(origins, directions, k=5)
        for name in COLUMNS:
            np.testing.assert_array_equal(getattr(other, name), getattr(expected, name))


@pytest.mark.parametrize("k", [0, -1, MOST_HITS + 1])
def test_a_number_of_hits_out_of_range_is_told(k):
    with pytest.raises(UsageError, match="hits a ray"):
        Tracer(small_scene(), device="cpu", threads=1).all_hits(np.zeros((1, 3)), np.ones((1, 3)), k=k)


def test_rays_that_are_none_meet_nothing(ball):
    tracer = Tracer(ball, device="cpu", threads=1)
    origins, directions = np.full((3, 3), np.nan), np.zeros((3, 3))
    assert not tracer.count_hits(origins, directions).any()
    assert not tracer.all_hits(origins, directions, k=3).count.any()
    assert tracer.all_hits(np.zeros((0, 3)), np.zeros((0, 3)), k=3).t.shape == (0, 3)
