"""Sifting a leaf: whatever the triangle test says is nearer passes the sieve, and little else does."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from striptools.trace import triangle
from striptools.trace.triangle import crossing_of, edges_of, may_cross, shear_of

COUNT = 4096

fast = jax.jit(lambda *given: judge(*given))
"""Compiled once; a test that changes what it is made of compiles its own."""


def judge(share, origins, directions, corners):
    """T, and whether it may be at most that share of t, by sums in the order of the test and in another."""

    def one(origin, direction, corners, turn):
        shear = shear_of(origin, direction)
        x, y, z = (
            [jnp.where(shear.axes[k] == 0, c[0], jnp.where(shear.axes[k] == 1, c[1], c[2])) for c in corners]
            for k in range(3)
        )
        edges = edges_of(tuple(x), tuple(y), tuple(z), shear)
        t, turned = crossing_of(edges), crossing_of(edges, turn)
        return (
            (t, may_cross(edges, nearest(t), in_order=True)),
            (turned, may_cross(edges, nearest(turned), in_order=False)),
        )

    def nearest(t):
        return jnp.where(share == jnp.inf, share, t * share)

    turns = jnp.arange(len(origins)) % 3
    return jax.vmap(one)(origins, directions, corners, turns)


def aimed(seed, exponent, offset):
    """Rays at points of triangles of all shapes, on edges and corners too, and rays that pass them by."""
    random = np.random.default_rng(seed)
    corners = random.normal(size=(COUNT, 3, 3))
    corners[::4, 2] = corners[::4, 0] + (corners[::4, 1] - corners[::4, 0]) * random.random((COUNT // 4, 1))
    corners[1::4] += random.normal(size=(COUNT // 4, 1, 3)) * 10.0 ** random.integers(0, 4)
    weights = random.choice([0.0, 0.0, 1.0, 0.5, 0.3, -0.2], (COUNT, 3)) + 1e-9
    points = (corners * weights[:, :, None]).sum(axis=1) / weights.sum(axis=1)[:, None]
    # Some start on the triangle's plane, or closely beside it.
    directions = random.normal(size=(COUNT, 3))
    back = random.choice([1.0, 1e-3, 1e-7, 0.0, -1.0], (COUNT, 1))
    origins = points - back * directions
    corners, origins = (a * 2.0**exponent + offset for a in (corners, origins))
    return origins.astype(np.float32), directions.astype(np.float32), corners.astype(np.float32)


def sieved(rays, share, compiled=fast):
    """Which triangles are hit, and which pass where the closest hit so far is at a share of t."""
    found = []
    for t, may in compiled(np.float32(share), *rays):
        t, may = np.asarray(t), np.asarray(may)
        hit = (t > 0) & np.isfinite(t)
        assert may[hit].all() or share < 1
        found.append((hit, may))
    return found


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1), st.sampled_from([0, -60, -30, 30, 40]), st.sampled_from([0.0, 1e3, 1e-20]))
def test_all_that_is_nearer_passes(seed, exponent, offset):
    rays = aimed(seed, exponent, offset)
    for share in (1.0, 1.5, np.inf):
        sieved(rays, share)


def test_little_else_passes():
    rays = aimed(3, 0, 0.0)
    for hit, may in sieved(rays, 1.0):
        assert hit.sum() > COUNT / 8
        assert may.sum() < 1.5 * hit.sum()
    # What lies farther than the closest hit does not: no slivers, nor triangles that a ray starts on.
    origins, directions, corners = (a[2::4] for a in rays)
    origins = origins - 3 * directions
    for hit, may in sieved((origins, directions, corners), 0.99):
        assert hit.sum() > COUNT / 32
        assert may[hit].mean() < 0.01


@pytest.mark.parametrize(("name", "less"), [("FARTHER", 1 - 2.0**-20), ("DOUBT", 0.0), ("FLUSHED", 0.0)])
def test_a_sieve_too_fine_would_be_seen(monkeypatch, name, less):
    monkeypatch.setattr(triangle, name, np.float32(less))
    compiled = jax.jit(lambda *given: judge(*given))
    exponent = -30 if name == "FLUSHED" else 0

    def sieve_all():
        for seed in range(200):
            sieved(aimed(seed, exponent, 0.0), 1.0, compiled)

    with pytest.raises(AssertionError):
        sieve_all()
