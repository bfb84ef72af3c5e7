"""Rays made ready, many at once: the same as each alone, and the root's lanes those of a slow twin."""

import numpy as np
import pytest
from rays import rays_at
from scenes import scene_of
from strategies import sphere

from striptools.kernels import rays as kernels
from striptools.kernels.wide import EMPTY
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer
from striptools.trace.leaves import aligned_full
from striptools.trace.walk import FLOATS, SLACK, mirror_of

F = np.float32
ODD = np.array([0, -0.0, 1e-45, -1e-39, 1e-20, 1, -3, 1e30, 3e38, np.inf, -np.inf, np.nan], F)


@pytest.fixture(scope="module", params=["stored", "rebuilt"])
def layout(request):
    """Of nodes of eight children, and of sixteen."""
    return Tracer(scene_of(Mesh(*sphere(3))), device="cpu", hierarchy=request.param)._layout


def some_rays(count, seed):
    """Most meet the scene, some miss it, and some are none."""
    scene = scene_of(Mesh(*sphere(3)))
    origins, directions = rays_at(scene, count, seed)
    random = np.random.default_rng(seed)
    origins[::5] += random.normal(size=(len(origins[::5]), 3)).astype(F) * 3
    origins[::7] = np.where(random.random((len(origins[::7]), 3)) < 0.3, random.choice(ODD, 3), origins[::7])
    directions[::3] = np.where(
        random.random((len(directions[::3]), 3)) < 0.3,
        random.choice(ODD, (len(directions[::3]), 3)),
        directions[::3],
    )
    return origins, directions, random.choice(np.array([np.inf, 2, 0.5, 0, np.nan], F), count)


def ready(layout, rays, which=(), begin=0, room=None, visit=True):
    """Rows, which rays they are, what became of each ray, and where it ended."""
    room = len(rays[0]) if room is None else room
    rows, at = aligned_full((room, kernels.ROW), -7.0), np.zeros(room, np.int32)
    dropped = np.full(len(rays[0]), 9, np.uint8)
    seen = (tuple(layout.arrays.frame), *layout.root)
    places = (rows, rows.view(np.int32), at, dropped)
    live, end = kernels.ready_rays(*rays, np.array(which, np.int32), begin, *seen, visit, *places)
    return rows[:live], at[:live], dropped, end


@pytest.mark.parametrize("count", [1, 63, 64, 65, 500])
def test_many_at_once_are_as_each_alone(layout, count):
    rays = some_rays(count, count)
    rows, at, dropped, end = ready(layout, rays)
    assert end == count
    alone = [ready(layout, tuple(a[k : k + 1] for a in rays)) for k in range(count)]
    np.testing.assert_array_equal(dropped, np.concatenate([each[2] for each in alone]))
    np.testing.assert_array_equal(at, np.flatnonzero(dropped == 0))
    assert rows.tobytes() == np.concatenate([each[0] for each in alone]).tobytes()
    if count == 500:
        assert set(dropped) == {0, 1, 2}


def test_some_of_the_rays_in_any_order(layout):
    rays = some_rays(300, 1)
    which = np.random.default_rng(2).permutation(300)[:200].astype(np.int32)
    rows, at, dropped, end = ready(layout, rays, which)
    assert end == 200
    every, at_all, _, _ = ready(layout, rays)
    where = {int(r): k for k, r in enumerate(at_all)}
    assert rows.tobytes() == every[[where[int(r)] for r in at]].tobytes()
    np.testing.assert_array_equal(at, [r for r in which if dropped[r] == 0])
    assert (dropped[np.setdiff1d(np.arange(300), which)] == 9).all()


@pytest.mark.parametrize("room", [1, 50, 64, 100])
def test_it_ends_where_places_do_and_goes_on_from_there(layout, room):
    rays = some_rays(400, 3)
    every, at_all, _, _ = ready(layout, rays)
    found, begin = [], 0
    while begin < 400:
        rows, at, _, end = ready(layout, rays, begin=begin, room=room)
        assert end > begin
        assert len(rows) == room or end == 400
        found.append((rows.copy(), at.copy()))
        begin = end
    assert np.concatenate([each[0] for each in found]).tobytes() == every.tobytes()
    np.testing.assert_array_equal(np.concatenate([each[1] for each in found]), at_all)


@np.errstate(all="ignore")
def slow_lanes(root, row, width):
    """The root's lanes that a ready ray meets, box by box, as bits in the order of visits."""
    low, high, inverse, reach = row[0:3], row[3:6], row[6:9], row[15]
    lanes = 0
    for lane in range(width):
        near, far = root[:3, lane] * inverse - low, root[3:6, lane] * inverse - high
        if np.isnan(root[0, lane]):
            continue
        entry = max(F(0), *(min(a, b) for a, b in zip(near, far, strict=True)))
        leaving = min(max(a, b) for a, b in zip(near, far, strict=True)) * kernels.FAR_FACTOR
        octant = int(row.view(np.int32)[FLOATS + 3])
        if entry <= min(reach * SLACK, leaving):
            lanes |= 1 << (lane ^ mirror_of(octant, width))
    return lanes


def test_lanes_of_the_root_are_those_of_a_slow_twin(layout):
    rays = some_rays(400, 4)
    rows, at, dropped, _ = ready(layout, rays)
    unvisited, at_all, _, _ = ready(layout, rays, visit=False)
    root, children = layout.root
    width, places = len(children), {int(r): k for k, r in enumerate(at)}
    for row, r in zip(unvisited, at_all, strict=True):
        lanes = slow_lanes(root, row, width)
        assert (lanes == 0) == (dropped[r] == 1)
        if lanes:
            order = lanes.bit_length() - 1
            mine = rows[places[int(r)]]
            assert mine[:21].tobytes() == row[:21].tobytes()
            octant = int(mine.view(np.int32)[FLOATS + 3])
            child = children[order ^ mirror_of(octant, width)]
            np.testing.assert_array_equal(mine.view(np.int32)[21:], [child ^ EMPTY, lanes ^ (1 << order), 1])
