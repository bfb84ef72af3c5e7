"""Rays sorted by where they start and which way they go, where they jump about: to the same hits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import scene_of
from strategies import sphere

from striptools.kernels.ray_order import BITS, CELLS, sort_rays, start_apart
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer, streams
from striptools.trace.rays import Camera, camera_rays

LOW = np.float32([-1, -2, -3])
FINER = np.float32(8)


def slow_order(origins, directions, which):
    """The same by a key of Python's numbers."""

    def key(r):
        with np.errstate(all="ignore"):
            place = (origins[r] - LOW) * FINER
        cell = [int(min(c, np.float32(CELLS - 1))) if c > 0 else 0 for c in place]
        curve = sum((cell[axis] >> b & 1) << 3 * b + axis for b in range(BITS) for axis in range(3))
        return curve, sum(int(directions[r, axis] < 0) << axis for axis in range(3))

    return sorted(which, key=key)


def scattered(count, seed=0):
    """Rays from all over and beyond the cells, every which way."""
    random = np.random.default_rng(seed)
    origins = (LOW + random.uniform(-1, 5, (count, 3))).astype(np.float32)
    return origins, random.normal(size=(count, 3)).astype(np.float32)


@given(st.integers(0, 300), st.integers(0, 2**20), st.booleans())
def test_the_order_is_the_slow_one(count, seed, chosen):
    origins, directions = scattered(count, seed)
    random = np.random.default_rng(seed)
    odd = np.float32([np.nan, np.inf, -np.inf, -0.0, 3e38, 1e-45])
    for a in (origins, directions):
        hit = random.random(a.shape) < 0.1
        a[hit] = random.choice(odd, hit.sum())
    which = random.permutation(count)[: count // 2].astype(np.int32) if chosen else np.zeros(0, np.int32)
    every = which if len(which) else np.arange(count, dtype=np.int32)
    begin, end = len(every) // 5, len(every) - len(every) // 7
    made = sort_rays(origins, directions, which, begin, end, LOW, FINER)
    assert made.tolist() == slow_order(origins, directions, every[begin:end].tolist())


def test_rays_that_jump_about_are_told_from_those_that_do_not():
    every = np.zeros(0, np.int32)
    origins, _ = scattered(5000)
    assert start_apart(origins, every, FINER)
    in_order = origins[np.lexsort(np.floor(origins.T * 8))]
    assert not start_apart(np.repeat(in_order, 4, axis=0), every, FINER)
    assert not start_apart(np.zeros_like(origins), every, FINER)
    walk = np.cumsum(np.full((5000, 3), 1 / 8, np.float32), axis=0)
    assert not start_apart(walk, every, FINER * np.float32(0.99))
    # Of rays that are said, what counts is how these follow each other.
    shuffled = np.random.default_rng(1).permutation(5000).astype(np.int32)
    assert start_apart(walk, shuffled, FINER)
    assert not start_apart(walk[np.argsort(shuffled)], shuffled, np.float32(1))
    for few in (0, 1):
        assert not start_apart(origins[:few], every, FINER)


@pytest.fixture(scope="module")
def ball():
    return scene_of(Mesh(*sphere(3)))


def rays_at(scene, count=3000):
    """Rays at a scene and past it, in no order; some are no rays, some reach nothing."""
    random = np.random.default_rng(5)
    size = scene.high - scene.low
    origins = (scene.low + random.uniform(-0.5, 1.5, (count, 3)) * size).astype(np.float32)
    directions = random.normal(size=(count, 3)).astype(np.float32)
    directions[::97] = np.nan
    origins[5::101] = np.inf
    reach = np.full(count, np.inf, np.float32)
    reach[3::89] = 0
    return origins, directions, reach


def spied(monkeypatch, run):
    """Have rays sorted in small runs, whatever the scene; return how long the runs were."""
    lengths = []

    def spy(*given):
        order = sort_rays(*given)
        lengths.append(len(order))
        return order

    monkeypatch.setattr(streams, "sort_rays", spy)
    monkeypatch.setattr(streams, "LEAST_SORTED", 0)
    monkeypatch.setattr(streams, "SORTED", run)
    return lengths


@pytest.mark.parametrize("resident", ["expanded", "compressed"])
def test_hits_are_the_same(ball, monkeypatch, resident):
    origins, directions, reach = rays_at(ball)
    tracer = Tracer(ball, device="cpu", resident=resident)

    def found():
        given, kwargs = (origins, directions), {"t_max": reach}
        hits, several = tracer.closest_hit(*given, **kwargs), tracer.all_hits(*given, k=3, **kwargs)
        single = [getattr(hits, name) for name in ("t", "face", "u", "v", "triangle")]
        lists = [getattr(several, name) for name in ("t", "face", "u", "v", "count")]
        return [*single, *lists, tracer.any_hit(*given, **kwargs), tracer.count_hits(*given, **kwargs)]

    plain = found()
    lengths = spied(monkeypatch, 700)
    for a, b in zip(plain, found(), strict=True):
        np.testing.assert_array_equal(a, b)
    assert lengths == [600] * 5 * 4


def test_counters_and_packets_that_part_are_the_same(ball, monkeypatch):
    origins, directions, _ = rays_at(ball)
    seen = camera_rays(Camera.framing(ball.positions, width=64, height=32))
    origins, directions = (np.concatenate(pair) for pair in zip(seen, (origins, directions), strict=True))
    tracer = Tracer(ball, device="cpu")
    plain = tracer.closest_hit(origins, directions, counters=True), tracer.closest_hit(origins, directions)
    lengths = spied(monkeypatch, 10**6)
    counted, packed = (
        tracer.closest_hit(origins, directions, counters=True),
        tracer.closest_hit(origins, directions),
    )
    for one, other in zip(plain, (counted, packed), strict=True):
        for name in ("t", "face", "u", "v"):
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    for a, b in zip(plain[0].counters, counted.counters, strict=True):
        np.testing.assert_array_equal(a, b)
    assert len(lengths) == 2
    assert lengths[0] == len(origins)


def test_small_scenes_are_traced_in_the_order_given(ball, monkeypatch):
    origins, directions, _ = rays_at(ball)
    monkeypatch.setattr(streams, "sort_rays", None)
    Tracer(ball, device="cpu").closest_hit(origins, directions)
