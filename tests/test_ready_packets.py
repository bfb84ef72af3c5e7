"""Packets as they are readied: bit for bit those of a slow twin; and their hits from far away."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import scene_of
from strategies import sphere

from striptools.kernels.packets import FAR, HEAD, PACKET, ROW, ready_packets
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer
from striptools.trace.streams import EVERY_RAY

KINDS = ("camera", "parallel", "light", "surface", "aimed", "broken", "scattered")


def ball():
    return scene_of(Mesh(*sphere(3)))


@np.errstate(all="ignore")
def coherent_rays(scene, kind, count, seed):
    """Rays in a row that go the same way (but for "scattered"): (origins, directions, t_max)."""
    random = np.random.default_rng(seed)
    positions = scene.positions.astype(np.float64)
    low, high = positions.min(axis=0), positions.max(axis=0)
    size = max(np.linalg.norm(high - low), np.abs(positions).max() * 1e-3, 1e-37)
    corners = positions[scene.faces()]
    picked = corners[random.integers(0, len(corners))]
    t_max = np.full(count, np.inf)
    eye = (low + high) / 2 + random.normal(size=3) * size
    middle = picked.mean(axis=0)
    across = size * 10.0 ** -random.integers(0, 4)
    points = middle + across * random.uniform(-0.5, 0.5, (count, 3))
    origins, directions = np.repeat(eye[None], count, axis=0), points - eye
    if kind == "parallel":
        way = np.eye(3)[random.integers(0, 3)] * random.choice([-1, 1]) if seed % 2 else middle - eye
        origins, directions = points - 2 * way, np.repeat(way[None], count, axis=0)
    elif kind == "light":
        origins, directions, t_max = points, eye - points, np.ones(count)
    elif kind == "surface":
        origins = np.repeat(middle[None], count, axis=0)
        directions = (eye - middle) / size + 0.2 * random.normal(size=(count, 3))
    elif kind == "aimed":
        weights = random.choice([0.0, 0.5, 1.0], (count, 2))
        points = picked[0] + weights[:, :1] * (picked[1] - picked[0])
        points = points + weights[:, 1:] * (1 - weights[:, :1]) * (picked[2] - points)
        directions = points - eye
    elif kind == "broken":
        bad = random.random(count) < 0.3
        directions[bad] = random.choice([np.nan, np.inf, 0.0, 1e-41], (count, 3))[bad]
        origins[random.random(count) < 0.05, 1] = np.nan
        t_max = random.choice([np.inf, 1.0, 0.0, -1.0, np.nan, 1e-40], count)
    elif kind == "scattered":
        directions = random.normal(size=(count, 3))
    lengths = 10.0 ** random.integers(-3, 4, (count, 1))
    return (
        origins.astype(np.float32),
        (directions * lengths).astype(np.float32),
        (t_max / (lengths[:, 0] if kind == "light" else 1.0)).astype(np.float32),
    )


def assert_same(tracer, origins, directions, t_max):
    one = tracer.closest_hit(origins, directions, t_max=t_max, packets=False)
    together = tracer.closest_hit(origins, directions, t_max=t_max)
    for name in ("t", "u", "v"):
        bits = [getattr(hits, name).view(np.int32) for hits in (one, together)]
        np.testing.assert_array_equal(*bits, err_msg=name)
    np.testing.assert_array_equal(one.face, together.face)
    np.testing.assert_array_equal(one.triangle, together.triangle)
    np.testing.assert_array_equal(tracer.any_hit(origins, directions, t_max=t_max), one.hit)
    return one


@pytest.mark.parametrize("away", [1e2, 1e4, 1e7])
def test_packets_from_far_away(away):
    scene = ball()
    tracer = Tracer(scene, device="cpu")
    for axis in range(3):
        for side in (-1, 1):
            eye = np.full(3, 0.1, np.float32)
            eye[axis] = side * away
            random = np.random.default_rng(axis)
            origins = np.repeat(eye[None], 256, axis=0)
            points = random.uniform(-0.6, 0.6, (256, 3)).astype(np.float32)
            hits = assert_same(tracer, origins, points - origins, None)
            assert hits.hit.mean() > 0.2


# ---- Readying packets, ray by ray in NumPy.


def ready(layout, origins, directions, t_max, room=64):
    rows, at = np.zeros((room, ROW), np.float32), np.zeros((room, PACKET), np.int32)
    alone, dropped = np.full(len(origins) + PACKET, -7, np.int32), np.full(len(origins), 9, np.uint8)
    places = (rows, rows.view(np.int32), at, alone, dropped)
    live, left, begin = ready_packets(
        origins, directions, t_max, EVERY_RAY, 0, *layout.seen_by_packets, *places
    )
    return live, rows[:live], at[:live], alone[:left], dropped, begin


def flushed(values):
    values = np.asarray(values, np.float32)
    return np.where(np.abs(values) < np.finfo(np.float32).tiny, np.float32(0), values)


@np.errstate(all="ignore")
def slow_rays(frame, origins, directions, t_max):
    """Which are rays, dominant axis and side, origins, scaled directions, reach, inverse of length."""
    o, d, far = flushed(flushed(origins) * frame[0]), flushed(directions), flushed(t_max)
    is_ray = np.isfinite(o).all(axis=1) & np.isfinite(d).all(axis=1) & (d != 0).any(axis=1) & (far > 0)
    longest = np.abs(d).max(axis=1)
    length = np.exp2(np.minimum(np.floor(np.log2(np.where(is_ray, longest, 1))), 126)).astype(np.float32)
    d = flushed(d / length[:, None])
    axis = np.argmax(np.abs(d), axis=1)
    away = np.take_along_axis(d, axis[:, None], axis=1)[:, 0] < 0
    reach = flushed(flushed(far * length) * frame[0])
    return is_ray, axis, away, o, d, reach, flushed(flushed(1 / length) / frame[0])


@settings(max_examples=40)
@given(st.sampled_from(KINDS), st.integers(1, 200), st.integers(0, 2**32 - 1))
def test_packets_hold_the_rays_they_say(kind, count, seed):
    scene = ball()
    layout = Tracer(scene, device="cpu")._layout
    view = layout.seen_by_packets
    rays = coherent_rays(scene, kind, count, seed)
    live, rows, at, alone, dropped, begin = ready(layout, *rays)
    is_ray, axis, away, o, d, reach, back = slow_rays(view.frame, *rays)
    assert begin == count

    # Each ray is in a packet, goes alone, missed, or is none.
    inside = at[at >= 0]
    counts = np.bincount(np.concatenate([inside, alone]), minlength=count)
    others = np.setdiff1d(np.arange(count), alone)
    assert counts.max(initial=0) <= 1
    np.testing.assert_array_equal(np.sort(inside), others[dropped[others] == 0])
    np.testing.assert_array_equal(~is_ray[others], dropped[others] == 2)

    for p in range(live):
        lanes = np.flatnonzero(at[p] >= 0)
        members = at[p, lanes]
        x, y, z = (int(word) & 3 for word in rows[p, 12:15].view(np.int32))
        assert (axis[members] == z).all()
        assert len(set(away[members])) == 1
        sheet = rows[p, HEAD:].reshape(8, PACKET)
        depth = d[members, z]
        expected = [*o[members][:, [x, y, z]].T, *flushed(d[members][:, [x, y]] / depth[:, None]).T]
        expected += [np.float32(1) / depth, reach[members], back[members]]
        np.testing.assert_array_equal(sheet[:, lanes], np.array(expected, np.float32))
        assert (sheet[6, at[p] < 0] == -1).all()
        assert (np.abs(rows[p, :12]) <= FAR).all()

        # The frustum holds every ray, counted the way the rays go along z.
        sign = np.float32(-1 if away[members[0]] else 1)
        slopes = sheet[3:5, lanes] * sign
        assert (rows[p, [0, 2]] < slopes.min(axis=1)).all()
        assert (rows[p, [1, 3]] > slopes.max(axis=1)).all()
        assert (rows[p, [4, 6]] <= sheet[:2, lanes].min(axis=1)).all()
        assert (rows[p, [5, 7]] >= sheet[:2, lanes].max(axis=1)).all()
        assert rows[p, 8] >= (sheet[2, lanes] * sign).max()
        assert rows[p, 9] <= (sheet[2, lanes] * sign).min()
        assert rows[p, 10] == np.abs(depth).max()


def test_packets_stop_where_places_end():
    layout = Tracer(ball(), device="cpu")._layout
    eye = np.float32([0.1, 0.2, 5])
    random = np.random.default_rng(3)
    points = random.uniform(-0.05, 0.05, (320, 3)).astype(np.float32)
    rays = np.repeat(eye[None], 320, axis=0), points - eye, np.full(320, np.inf, np.float32)
    live, _, at, alone, _, begin = ready(layout, *rays, room=3)
    assert (live, begin) == (3, 96)
    assert len(alone) == 0
    np.testing.assert_array_equal(at.ravel(), np.arange(96))
