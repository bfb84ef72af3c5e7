"""Rays in packets: the hits of rays on their own, bit for bit, and the kernel that puts them together."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rays import rays_at
from strategies import book, clean_meshes, cube, fan, grid, soup, sphere, stack, tangle
from test_hoisting import assert_hoisted
from test_trace import assert_equal_hits

import striptools
from striptools.errors import StriptoolsError
from striptools.kernels.packets import HEAD, PACKET, ROW, ready_packets
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.trace import Tracer
from striptools.trace import walk_packets as walk
from striptools.trace.launch import program
from striptools.trace.rays import Camera, camera_rays
from striptools.trace.streams import EVERY_RAY

FIELDS = ("t", "face", "u", "v", "triangle")
RESIDENT = ("expanded", "compressed")
SIDE = 64
"""Pixels across: two packets, since where rays change their dominant axis they go alone."""

SHAPES = {
    "book": lambda: book(5),
    "cube": cube,
    "fan": lambda: fan(30),
    "grid": lambda: grid(6, 6),
    "soup": lambda: soup(50, 1, 16),
    "sphere": lambda: sphere(3),
    "stack": lambda: stack(20),
    "tangle": lambda: tangle(20, 60, 1),
}


def scene_of(mesh):
    return striptools.convert(mesh, Options(threads=1))


def pictures(scene, seed):
    """Rays of a camera in tiles and line by line, of an orthographic one, and towards a point of light."""
    random = np.random.default_rng(seed)
    camera = Camera.framing(scene.positions, width=SIDE, height=SIDE, up=str(random.choice(["x", "y", "z"])))
    origins, directions = camera_rays(camera)
    yield origins, directions, None
    low, high = scene.low.astype(np.float64), scene.high.astype(np.float64)
    size = max(float(np.linalg.norm(high - low)), float(np.abs(scene.positions).max()) * 1e-3, 1e-30)
    axis = int(random.integers(3))
    plane = low + (high - low) * random.random((SIDE * SIDE, 3))
    plane = plane[np.lexsort(plane.T)].astype(np.float32)
    plane[:, axis] = np.float32(low[axis] - size)
    along = np.zeros_like(plane)
    along[:, axis] = 1
    yield plane, along, None
    light = (low + (high - low) * random.random(3) + size * random.normal(size=3)).astype(np.float32)
    yield plane, light - plane, np.float32(1)


def aimed_packets(scene, seed):
    """Packets from one eye each, aimed exactly at corners and midpoints of edges near each other."""
    random = np.random.default_rng(seed)
    faces = scene.faces()
    corners = scene.positions[faces[np.sort(random.integers(0, len(faces), 320))]].astype(np.float64)
    target = corners[:, 0].copy()
    target[::2] = 0.5 * (corners[::2, 0] + corners[::2, 1])
    size = max(float(np.linalg.norm(np.ptp(scene.positions.astype(np.float64), axis=0))), 1e-30)
    eyes = target[::PACKET] + 2 * size * random.normal(size=(10, 3))
    origins = np.repeat(eyes, PACKET, axis=0).astype(np.float32)
    return origins, (target - origins).astype(np.float32), None


def assert_same(scene, rays, resident):
    origins, directions, t_max = rays
    tracer = Tracer(scene, device="cpu", threads=1, resident=resident)
    alone = tracer.closest_hit(origins, directions, t_max=t_max, packets=False)
    together = tracer.closest_hit(origins, directions, t_max=t_max)
    assert_equal_hits(FIELDS, ((scene, alone), (scene, together)), origins, directions)
    np.testing.assert_array_equal(tracer.any_hit(origins, directions, t_max=t_max), together.hit)
    return alone


@pytest.mark.parametrize(
    ("shape", "resident"),
    [*((shape, "expanded") for shape in SHAPES), ("sphere", "compressed"), ("tangle", "compressed")],
)
def test_pictures_are_the_same(shape, resident):
    scene = scene_of(Mesh(*SHAPES[shape]()))
    hits = [assert_same(scene, rays, resident).hit.sum() for rays in pictures(scene, 1)]
    assert sum(hits) > 0


@settings(max_examples=12)
@given(clean_meshes(), st.integers(0, 2**32 - 1))
def test_any_mesh_has_the_same_hits(mesh, seed):
    scene = scene_of(mesh)
    with np.errstate(all="ignore"):
        for rays in (*pictures(scene, seed), aimed_packets(scene, seed)):
            assert_same(scene, rays, "expanded")


@settings(max_examples=3)
@given(clean_meshes(), st.integers(0, 2**32 - 1))
def test_any_packed_mesh_has_the_same_hits(mesh, seed):
    scene = scene_of(mesh)
    with np.errstate(all="ignore"):
        for rays in (*pictures(scene, seed), aimed_packets(scene, seed)):
            assert_same(scene, rays, "compressed")


@pytest.mark.parametrize("unit", [1e-30, 1e-6, 1.0, 1e6, 1e30])
@pytest.mark.parametrize("offset", [0.0, 1e3])
def test_units_and_places_make_no_difference(unit, offset):
    positions, faces = sphere(3)
    scene = scene_of(Mesh(((positions + offset) * unit).astype(np.float32), faces))
    with np.errstate(all="ignore"):
        hits = [
            assert_same(scene, rays, "expanded").hit
            for rays in (*pictures(scene, 2), aimed_packets(scene, 3))
        ]
    assert np.concatenate(hits).any()


def test_edges_and_corners_of_a_closed_mesh_let_nothing_through():
    scene = scene_of(Mesh(*sphere(4)))
    centre = 0.5 * (scene.low + scene.high)
    random = np.random.default_rng(4)
    faces = scene.faces()
    corners = scene.positions[faces].astype(np.float64)
    target = np.concatenate([corners[:, 0], 0.5 * (corners[:, 0] + corners[:, 1])])
    target = target[np.lexsort(np.round(target, 1).T)]
    inside = centre + 0.2 * random.normal(size=3)
    origins = np.broadcast_to(inside, target.shape).astype(np.float32)
    hits = Tracer(scene, device="cpu", threads=1).closest_hit(origins, (target - origins).astype(np.float32))
    assert hits.hit.all()


@pytest.mark.parametrize("count", [1, 31, 32, 33, 257])
def test_any_number_of_rays(count):
    scene = scene_of(Mesh(*sphere(3)))
    origins, directions, _ = next(pictures(scene, 5))
    assert_same(scene, (origins[:count], directions[:count], None), "expanded")


def test_rays_that_are_none_and_rays_that_go_elsewhere():
    scene = scene_of(Mesh(*sphere(3)))
    origins, directions, _ = next(pictures(scene, 6))
    random = np.random.default_rng(7)
    odd = np.array([0, np.nan, np.inf, -np.inf, 1e-45, 3e38], np.float32)
    some = random.random(len(origins)) < 0.1
    directions[some] = random.choice(odd, (int(some.sum()), 3))
    other = random.random(len(origins)) < 0.01
    directions[other] *= -1
    reach = np.where(random.random(len(origins)) < 0.1, np.float32(-1), np.float32(np.inf)).astype(np.float32)
    assert_same(scene, (origins, directions, reach), "expanded")


def test_incoherent_rays_go_alone():
    scene = scene_of(Mesh(*sphere(3)))
    rays = rays_at(scene, 3000, 8)
    assert_same(scene, (*rays, None), "expanded")
    assert packets_of(scene, *rays)[0] < 10


def test_all_devices_take_their_share():
    scene = scene_of(Mesh(*sphere(3)))
    origins, directions, _ = next(pictures(scene, 9))
    one, many = (Tracer(scene, device="cpu", threads=n).closest_hit(origins, directions) for n in (1, None))
    np.testing.assert_array_equal(one.t, many.t)
    np.testing.assert_array_equal(one.face, many.face)


def packets_of(scene, origins, directions, t_max=np.inf):
    """How many packets rays make, which rays go alone, rows, the ray of each lane, and what was dropped."""
    seen = Tracer(scene, device="cpu", threads=1)._layout.seen_by_packets
    count = len(origins)
    rows, at = np.zeros((count, ROW), np.float32), np.zeros((count, PACKET), np.int32)
    alone, dropped = np.zeros(count + PACKET, np.int32), np.zeros(count, np.uint8)
    reach = np.full(count, t_max, np.float32)
    places = (rows, rows.view(np.int32), at, alone, dropped)
    made, left, end = ready_packets(origins, directions, reach, EVERY_RAY, 0, *seen, *places)
    assert end == count
    return made, alone[:left], rows[:made], at[:made], dropped


def test_packets_bound_their_rays():
    scene = scene_of(Mesh(*sphere(3)))
    origins, directions, _ = next(pictures(scene, 10))
    made, _, rows, at, dropped = packets_of(scene, origins, directions)
    assert made > 5
    words = rows.view(np.int32)
    for row, word, lanes in zip(rows, words, at, strict=True):
        live = lanes >= 0
        x, y, z, away = word[12], word[13], word[14] & 3, word[14] >> 2
        sign = -1.0 if away else 1.0
        o, d = origins[lanes[live]].astype(np.float64), directions[lanes[live]].astype(np.float64)
        assert (np.abs(d[:, z]) >= np.abs(d).max(axis=1)).all()
        assert (d[:, z] * sign > 0).all()
        # The least and the largest slope and origin, with room to both sides.
        for axis, slopes, starts in ((x, row[0:2], row[4:6]), (y, row[2:4], row[6:8])):
            slope, start = d[:, axis] / np.abs(d[:, z]), o[:, axis]
            assert slopes[0] < slope.min() <= slope.max() < slopes[1]
            assert starts[0] < start.min() <= start.max() < starts[1]
        ahead = o[:, z] * sign
        assert row[9] < ahead.min() <= ahead.max() < row[8]
        rays = row[HEAD:].reshape(8, PACKET)
        np.testing.assert_array_equal(rays[2, live], origins[lanes[live], z])
        assert (rays[6, ~live] == -1).all()
    kept = np.sort(at[at >= 0])
    assert len(np.unique(kept)) == len(kept)
    assert (dropped[kept] == 0).all()


def test_dropped_packets_miss_the_scene():
    scene = scene_of(Mesh(*sphere(3)))
    origins, directions, _ = next(pictures(scene, 11))
    aside = np.cross(directions.mean(axis=0), [0.3, 0.5, 0.8])
    origins += (5 * aside / np.linalg.norm(aside)).astype(np.float32)
    made, alone, *_, dropped = packets_of(scene, origins, directions)
    assert made == 0
    assert (np.delete(dropped, alone) == 1).all()
    assert len(alone) < 0.6 * len(dropped)


@pytest.mark.parametrize("resident", RESIDENT)
@pytest.mark.parametrize("any_hit", [False, True])
def test_the_walk_is_hoisted(resident, any_hit):
    tracer = Tracer(scene_of(Mesh(*sphere(3))), device="cpu", threads=1, resident=resident)
    lowered = program(tracer._mesh, tracer._options(any_hit=any_hit), True).lower(
        tracer._scene, np.zeros((8, ROW), np.float32), np.full(1, 8, np.int32)
    )
    assert_hoisted(lowered)


def test_a_tree_without_end_is_stuck_and_no_hang():
    scene = scene_of(Mesh(*sphere(3)))
    tracer = Tracer(scene, device="cpu", threads=1, resident="expanded")
    nodes = tracer._layout.arrays.nodes
    children = nodes[0, 6].view(np.int32)
    children[children >= 0] = 0
    children[:] = 0
    nodes[0, :3], nodes[0, 3:6] = -1e3, 1e3
    tracer._take(replace(tracer._layout, arrays=tracer._layout.arrays._replace(nodes=nodes)))
    origins, directions, _ = next(pictures(scene, 12))
    with pytest.raises(StriptoolsError, match="did not end"):
        tracer.closest_hit(origins, directions)


def test_a_frustum_that_is_too_narrow_would_be_seen(monkeypatch):
    scene = scene_of(Mesh(*sphere(4)))
    meets = walk._meets

    def narrow(packet, box, limit):
        middle = 0.5 * (packet.bounds[0] + packet.bounds[1])
        return meets(packet._replace(bounds=packet.bounds.at[1].set(middle)), box, limit)

    monkeypatch.setattr(walk, "_meets", narrow)
    program.cache_clear()
    try:
        with pytest.raises(AssertionError):
            assert_same(scene, next(pictures(scene, 13)), "expanded")
    finally:
        program.cache_clear()
