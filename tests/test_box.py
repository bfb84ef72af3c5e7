"""The margin of boxes against exact rational arithmetic: it holds what it must, a smaller one would not."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from striptools.kernels import rays as kernels
from striptools.measure.bound import gamma
from striptools.trace import box, layout, walk_packed
from striptools.trace.triangle import crossing_of, edges_of, shear_of
from striptools.trace.walk import Frame

ULP = 2.0**-23
OLD_MARGIN = np.float32(2.0**-21)
"""What the triangle test alone needs."""


def meets(origin, direction, low, high, beyond, axes=(0, 1, 2)) -> bool:
    """Whether a ray meets a box widened by `beyond` on some axes, in rational numbers."""
    enter, leave = Fraction(0), None
    for axis in range(3):
        o, d = Fraction(float(origin[axis])), Fraction(float(direction[axis]))
        wide = beyond if axis in axes else 0
        near, far = Fraction(float(low[axis])) - wide - o, Fraction(float(high[axis])) + wide - o
        if d == 0:
            if near > 0 or far < 0:
                return False
            continue
        one, two = sorted((near / d, far / d))
        enter, leave = max(enter, one), two if leave is None else min(leave, two)
    return leave is None or enter <= leave


@jax.jit
def met_by_jax(margin, reach, origins, directions, low, high):
    """Whether the slab test of the walks meets each box, at any distance."""

    def one(origin, direction, low, high):
        frame = Frame(np.float32(1), reach, jnp.zeros(3), jnp.ones(3), margin)
        boxes = jnp.broadcast_to(jnp.concatenate([low, high])[:, None], (6, 8))
        return box.lanes_met(boxes, box.slab_of(origin, direction, frame), jnp.float32(jnp.inf))[0]

    return jax.vmap(one)(origins, directions, low, high)


def met_by_kernel(margin, reach, origins, directions, low, high):
    """The same by the kernel that readies rays: a ray that misses its root is dropped."""
    met = []
    for k in range(len(origins)):
        root = np.full((6, 8), np.nan, np.float32)
        root[:, 0] = np.concatenate([low[k], high[k]])
        frame = (np.float32(1), reach, np.zeros(3, np.float32), np.ones(3, np.float32), margin)
        rows, dropped = np.zeros((1, kernels.ROW), np.float32), np.zeros(1, np.uint8)
        given = (np.full(1, np.inf, np.float32), np.zeros(0, np.int32), 0, frame, root)
        places = (rows, rows.view(np.int32), np.zeros(1, np.int32), dropped)
        children = np.zeros(8, np.int32)
        kernels.ready_rays(origins[k : k + 1], directions[k : k + 1], *given, children, True, *places)
        met.append(dropped[0] == 0)
    return np.array(met)


def grazing(count, seed, reach):
    """Rays that pass an edge of a box widened by `REACH`: (k,) of origins, directions, low and high."""
    random = np.random.default_rng(seed)
    largest = float(reach)
    origins = random.uniform(-1, 1, (count, 3)) * largest
    far = random.random((count, 3)) < 0.5
    origins[far] = np.sign(origins[far]) * largest
    origins = origins.astype(np.float32)
    apart = 2.0 ** -random.integers(0, 20, (count, 1)).astype(np.float64)
    place = np.clip(origins + apart * random.uniform(-1, 1, (count, 3)), -largest, largest)
    size = apart * random.choice([0.0, 2.0**-20, 0.1], (count, 3))
    low = place.astype(np.float32)
    high = np.minimum(place + size, largest).astype(np.float32)
    wide = np.float64(box.REACH) * largest
    sides = np.where(random.random((count, 3)) < 0.5, low - wide, high + wide)
    sides = np.where(
        np.arange(3) == random.integers(0, 3, (count, 1)), (low.astype(np.float64) + high) / 2, sides
    )
    directions = (sides - origins).astype(np.float32)
    some = np.abs(directions).max(axis=1) > 2.0**-30
    return origins[some], directions[some], low[some], high[some]


@pytest.fixture(scope="module")
def edges():
    """Grazing rays that do meet the widened box, exactly, and the reach of the scene."""
    reach = np.float32(2 - ULP)
    found = grazing(6000, 3, reach)
    beyond = Fraction(box.REACH) * Fraction(float(reach))
    exact = np.array([meets(*row, beyond) for row in zip(*found, strict=True)])
    assert 1000 < exact.sum() < len(exact) - 1000
    return reach, tuple(a[exact] for a in found)


@pytest.mark.parametrize("met", [met_by_jax, met_by_kernel])
def test_no_box_is_missed_in_which_the_triangle_test_may_hit(edges, met):
    reach, rows = edges
    assert met(box.MARGIN, reach, *rows).all()


@pytest.mark.parametrize("met", [met_by_jax, met_by_kernel])
def test_a_smaller_margin_would_be_seen(edges, met):
    reach, rows = edges
    assert not met(OLD_MARGIN, reach, *rows).all()


def test_the_margins_are_no_smaller_than_what_they_are_made_of():
    """Terms of `box`, How far; of `walk_packed` and `walk_packets`, Boxes."""
    slack = 1 + 2.0**-18
    assert 2 * gamma(4) <= box.REACH
    assert 3 * box.U * (1 + float(box.MARGIN)) <= box.ROUNDINGS
    assert float(box.MARGIN) >= box.REACH + box.ROUNDINGS
    assert float(OLD_MARGIN) < box.REACH + box.ROUNDINGS
    assert float(walk_packed.MARGIN) >= box.REACH + 7 * box.U * slack
    assert float(layout.PACKET_MARGIN) >= box.REACH + 8 * box.U * slack
    relative = (1 + gamma(2)) / ((1 - gamma(2)) * (1 - box.U))
    assert float(box.FAR_FACTOR) >= relative
    assert kernels.FAR_FACTOR == box.FAR_FACTOR


def test_the_errors_of_two_corners_that_make_zero_are_no_more_than_eight():
    """`box`, How far: in units of uL, the ray's origin and both corners anywhere in -1 to 1 times L."""
    random = np.random.default_rng(5)
    most = 0.0
    for _ in range(20):
        one, two, origin = (
            np.where(random.random((2, 100_000)) < 0.5, 1, 2 * random.random((2, 100_000)) - 1)
            * np.where(random.random((2, 100_000)) < 0.5, 1, -1)
            for _ in range(3)
        )
        slope = np.where(random.random(100_000) < 0.6, 1, random.uniform(-1, 1, 100_000))
        x, z = zip(*((corner - origin) * [np.ones(100_000), slope] for corner in (one, two)), strict=True)
        p = np.subtract(x, z)
        errors = np.abs(x) + 3 * np.abs(z) + np.abs(p)
        edge = np.abs(p).sum(axis=0)
        share = np.abs(p[0]) / np.where(edge > 0, edge, 1)
        beyond = 2 * share * (1 - share) * edge * 4 / (edge + 4)
        summed = (1 - share) * errors[0] + share * errors[1] + beyond
        most = max(most, summed[(p[0] * p[1] <= 0) & (edge > 0)].max())
    assert 7.99 < most <= 8


def strays(seed, count=200_000):
    """Where the test takes a corner for the ray itself, or for one beyond, exactly (k,) float64 off it.

    A corner near 1, 1 seen from near -1, -1 along a slope of about 1: there roundings are largest.
    """
    random = np.random.default_rng(seed)
    span = 2 ** random.integers(2, 12)

    def near_one(high=span):
        return 1 + ULP * random.integers(0, high, count)

    start = (-near_one()).astype(np.float32)
    deep, foot, depth = (
        (-near_one(64)[0]).astype(np.float32),
        near_one(64)[0].astype(np.float32),
        np.float32(1.37),
    )
    corner = near_one().astype(np.float32)
    exact_slope = (corner.astype(np.float64) - start) / (float(foot) - float(deep))
    way = (exact_slope * float(depth) * (1 + (random.random(count) - 0.5) * 2.0**-21)).astype(np.float32)
    slope, height = way / depth, foot - deep
    seen = (corner - start) - slope * height
    off = (corner.astype(np.float64) - start) - way.astype(np.float64) / float(depth) * (
        float(foot) - float(deep)
    )
    return (start, way, corner, seen, off), (deep, foot, depth)


def edge_on_faces():
    """Faces that are hit by rounding: the ray passes a corner on one side in x, on the other one in y."""
    found = []
    for seed in range(60):
        (start, way, corner, seen, off), (deep, foot, depth) = strays(seed)
        fits = (np.abs(way) <= depth) & (seen == 0)
        if not fits.any():
            continue
        one, two = np.argmax(np.where(fits, off, 0)), np.argmin(np.where(fits, off, 0))
        origin = np.array([start[one], start[two], deep], np.float32)
        direction = np.array([way[one], way[two], depth], np.float32)
        x, y, z = corner[one], corner[two], foot
        # Beside the corner that is taken for the ray, two that lie farther off it, each on its own axis.
        far = np.float32(64 * ULP)
        found.append((origin, direction, np.float32([[x, y, z], [x + far, y, z], [x, y - far, z]])))
    return found


@jax.jit
def is_hit(origin, direction, corners):
    shear = shear_of(origin, direction)
    x, y, z = (tuple(corners[j, axis] for j in range(3)) for axis in range(3))
    t = crossing_of(edges_of(x, y, z, shear))
    return (t > 0) & jnp.isfinite(t)


def test_faces_are_hit_that_the_ray_passes_by_and_no_farther_than_is_said():
    faces = [face for face in edge_on_faces() if is_hit(*face)]
    assert len(faces) > 30
    farthest = [0, 0]
    for origin, direction, corners in faces:
        row = (origin, direction, corners.min(axis=0), corners.max(axis=0))
        largest = Fraction(float(max(np.abs(origin).max(), np.abs(corners).max())))
        assert meets(*row, Fraction(box.REACH) * largest, axes=(0, 1))
        for k, axes in enumerate(((0, 1), (0, 1, 2))):
            missed = [far for far in range(9) if not meets(*row, far * largest * Fraction(box.U), axes)]
            farthest[k] = max(farthest[k], *missed)
        rows = tuple(a[None] for a in row)
        assert met_by_jax(box.MARGIN, np.float32(float(largest)), *rows).all()
    # What is said is not idle: 6u across the ray are not enough, nor 3u on all sides.
    assert farthest == [6, 3]
