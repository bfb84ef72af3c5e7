"""All hits, counts and containment through shared instances: what every triangle in float64 says, merged."""

import numpy as np
import pytest
from test_containment import solid_angles
from test_instances import SCENES, load
from test_shared_instances import KINDS, assert_same_at_once, mesh_of, random_matrices, rays_through, sphere

from striptools.measure.bound import frame_rays, judge_pairs
from striptools.mesh.instances import place
from striptools.pipeline import convert
from striptools.trace import Tracer, instanced, walk_instances
from striptools.trace.instanced import geometry_boxes, moves_of

COLUMNS = ("t", "face", "u", "v", "triangle", "count", "instance", "geometry", "geometry_face")


@pytest.fixture(scope="module")
def few():
    """Ten instances of two closed geometries, turned, stretched, every other one mirrored, and the scene."""
    random = np.random.default_rng(3)
    geometry = np.concatenate([[0, 1], random.integers(0, 2, 8)])
    mesh = mesh_of([sphere(), sphere(5, 7)], geometry, random_matrices(random, len(geometry), 1.0))
    return mesh, convert(mesh)


def placed_corners(mesh):
    """(n, 3, 3) float64: the corners of each face of the flattened source."""
    parts = []
    for geometry, matrix in zip(mesh.instances.geometry, mesh.instances.matrix, strict=True):
        corners = mesh.positions[mesh.faces[mesh.geometries.faces(int(geometry))]].astype(np.float64)
        parts.append(place(corners.reshape(-1, 3), matrix).reshape(-1, 3, 3))
    return np.concatenate(parts)


def tried(mesh, scene, rays):
    """Every ray with every placed triangle: `Pairs` for each ray, as far off as a moved ray may be."""
    moves = moves_of(scene, geometry_boxes(scene))
    size = max(float(np.abs(rays[0]).max()), moves.reach / float(moves.scale))
    corners, frames = placed_corners(mesh), frame_rays(*rays)
    off = float(moves.slips.max()) * size
    return [judge_pairs(frames, np.full(len(corners), ray), corners, off) for ray in range(len(rays[0]))]


def tracers(scene, resident="expanded"):
    return tuple(
        Tracer(
            scene, device="cpu", threads=1, instances=kind, resident=resident if kind == "shared" else "auto"
        )
        for kind in ("shared", "flattened")
    )


def check_hits(mesh, scene, tracer, rays, k=64):
    """Raise where hits are not those of every triangle; gives how many rays leave no doubt of any face."""
    hits, counts = tracer.all_hits(*rays, k=k), tracer.count_hits(*rays)
    np.testing.assert_array_equal(hits.count, counts)
    clear = 0
    for ray, pairs in enumerate(tried(mesh, scene, rays)):
        found = hits.face[ray, : hits.count[ray]]
        certain, possible = np.flatnonzero(pairs.certain), np.flatnonzero(pairs.possible)
        assert len(set(found)) == len(found)
        assert set(certain) <= set(found) <= set(possible)
        assert (np.abs(hits.t[ray, : len(found)] - pairs.t[found]) <= pairs.t_bound[found]).all()
        order = list(zip(hits.t[ray], hits.instance[ray], hits.face[ray], strict=True))[: len(found)]
        assert order == sorted(order)
        clear += len(certain) == len(possible)
    return clear


@pytest.mark.parametrize("resident", KINDS)
def test_hits_are_those_of_every_triangle_in_float64(few, resident):
    mesh, scene = few
    rays = rays_through(scene, 150)
    tracer, _ = tracers(scene, resident)
    clear = check_hits(mesh, scene, tracer, rays)
    assert clear > 75
    assert tracer.count_hits(*rays).max() > 3


@pytest.mark.parametrize("resident", KINDS)
def test_hits_are_those_of_the_flattened_scene(few, resident):
    _, scene = few
    rays = rays_through(scene, 3000, 4)
    shared, flat = tracers(scene, resident)
    ours, theirs = shared.all_hits(*rays, k=32), flat.all_hits(*rays, k=32)
    same = (np.sort(ours.face, axis=1) == np.sort(theirs.face, axis=1)).all(axis=1)
    # The others pass within the rounding of an edge.
    assert same.mean() > 0.99
    np.testing.assert_array_equal(shared.count_hits(*rays)[same], flat.count_hits(*rays)[same])
    assert ours.count.max() > 4


@pytest.mark.parametrize("resident", KINDS)
@pytest.mark.parametrize("k", [1, 3, 16])
def test_matrices_that_round_nothing_give_the_bits_of_the_flattened_scene(resident, k):
    alike = np.stack([np.eye(4)[:3], 4 * np.eye(4)[:3], 0.125 * np.eye(4)[:3]])
    scene = convert(mesh_of([sphere()], np.zeros(3), alike))
    rays = rays_through(scene, 2000)
    shared, flat = tracers(scene, resident)
    ours, theirs = shared.all_hits(*rays, k=k), flat.all_hits(*rays, k=k)
    assert len(np.unique(ours.instance)) >= 3
    for name in COLUMNS:
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes()
    assert shared.count_hits(*rays).tobytes() == flat.count_hits(*rays).tobytes()
    inside = (rays[0] + rays[1] * np.float32(1e-3)).astype(np.float32)
    assert shared.contains(inside).tobytes() == flat.contains(inside).tobytes()


@pytest.mark.parametrize("resident", KINDS)
def test_the_first_of_all_hits_is_the_closest_and_more_only_go_on(few, resident):
    _, scene = few
    rays = rays_through(scene, 1000, 2)
    tracer, _ = tracers(scene, resident)
    closest, many = tracer.closest_hit(*rays), tracer.all_hits(*rays, k=16)
    for name in ("t", "face", "u", "v", "triangle", "instance", "geometry", "geometry_face"):
        np.testing.assert_array_equal(getattr(many, name)[:, 0], getattr(closest, name))
    for k in (1, 2, 5):
        few_hits = tracer.all_hits(*rays, k=k)
        for name in COLUMNS[:5] + COLUMNS[6:]:
            np.testing.assert_array_equal(getattr(few_hits, name), getattr(many, name)[:, :k])


def equals(tracer, rays, k):
    """How many rays list a second instance at the same t, in the order of instances; raise if it is not."""
    hits = tracer.all_hits(*rays, k=k)
    later = (hits.t[:, 1:] == hits.t[:, :-1]) & (hits.face[:, 1:] >= 0)
    assert (hits.instance[:, 1:] >= hits.instance[:, :-1])[later].all()
    return int((later & (hits.instance[:, 1:] > hits.instance[:, :-1])).sum())


def test_hits_of_instances_in_the_same_place_are_all_told():
    scene = convert(load(SCENES["twice the same place"]))
    tracer, flat = tracers(scene)
    rays = rays_through(scene, 1000)
    assert equals(tracer, rays, 8) > 100
    np.testing.assert_array_equal(tracer.count_hits(*rays), flat.count_hits(*rays))
    # Where only one of the two is kept it is that of the first.
    assert set(np.unique(tracer.all_hits(*rays, k=1).instance)) == {-1, 0}
    near = tracer.closest_hit(*rays)
    assert not tracer.count_hits(*rays, t_max=near.t)[near.hit].any()
    beyond = np.nextafter(near.t, np.float32(np.inf))
    assert (tracer.count_hits(*rays, t_max=beyond)[near.hit] >= 2).all()
    assert (tracer.all_hits(*rays, k=8, t_max=beyond).count[near.hit] >= 2).all()


@pytest.mark.parametrize("resident", KINDS)
def test_containment_is_that_of_solid_angles(few, resident):
    mesh, scene = few
    corners = placed_corners(mesh)
    random = np.random.default_rng(7)
    low, high = corners.min(axis=(0, 1)), corners.max(axis=(0, 1))
    points = random.uniform(low, high, (600, 3)).astype(np.float32)
    tracer, _ = tracers(scene, resident)
    parity, clear = np.zeros(len(points), np.int64), np.ones(len(points), np.bool_)
    ends = np.cumsum(np.diff(mesh.geometries.face_starts)[mesh.instances.geometry])
    for own in np.split(corners, ends[:-1]):
        number = np.abs(solid_angles(own.reshape(-1, 3), np.arange(3 * len(own)).reshape(-1, 3), points))
        parity += number > 0.5
        clear &= np.abs(number - 0.5) > 0.4
    assert clear.mean() > 0.9
    assert (parity[clear] % 2 == 1).any()
    assert (parity > 1).any()
    np.testing.assert_array_equal(tracer.contains(points)[clear], parity[clear] % 2 == 1)


@pytest.mark.parametrize(("gather", "most"), [("all", 4), ("count", 1), ("windings", 1)])
def test_all_rays_at_once_find_the_same(few, gather, most):
    """As a GPU walks them."""
    _, scene = few
    tracer, _ = tracers(scene)
    rays = (*rays_through(scene, 128, 4), np.full(128, np.inf, np.float32))
    assert_same_at_once(tracer, rays, tracer._options(gather=gather, most=most))


def test_rays_that_are_none_meet_nothing(few):
    tracer, _ = tracers(few[1])
    origins, directions = np.full((3, 3), np.nan), np.zeros((3, 3))
    assert not tracer.count_hits(origins, directions).any()
    hits = tracer.all_hits(origins, directions, k=3)
    assert not hits.count.any()
    assert (hits.instance == -1).all()
    assert tracer.all_hits(np.zeros((0, 3)), np.zeros((0, 3)), k=3).instance.shape == (0, 3)


def without_programs(monkeypatch, name, value):
    """Replace a part of the walk, and forget what was compiled of it."""
    monkeypatch.setattr(walk_instances, name, value)
    instanced.instances_program.cache_clear()


def test_an_instance_that_takes_the_place_of_another_would_be_seen(few, monkeypatch):
    mesh, scene = few
    rays = rays_through(scene, 100)
    without_programs(monkeypatch, "merged", lambda so_far, rows: so_far._replace(kept=rows))
    with pytest.raises(AssertionError):
        check_hits(mesh, scene, tracers(scene)[0], rays)
    instanced.instances_program.cache_clear()


def test_a_hit_as_near_that_is_left_out_would_be_seen(monkeypatch):
    scene = convert(load(SCENES["twice the same place"]))
    rays = rays_through(scene, 1000)
    right = tracers(scene)[0].all_hits(*rays, k=1)
    without_programs(monkeypatch, "_next_above", lambda value: value * np.float32(0.5))
    wrong = tracers(scene)[0].all_hits(*rays, k=1)
    instanced.instances_program.cache_clear()
    assert (wrong.instance != right.instance).any() or (wrong.t != right.t).any()
