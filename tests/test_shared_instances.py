"""Instances that share their geometry, traced: the hits of the flattened scene, and no leak inside any."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_instances import SCENES, load

from striptools.errors import LimitError, UsageError
from striptools.measure.aimed import Surface, aim, judge_fans
from striptools.measure.bound import frame_rays
from striptools.mesh.instances import Geometries, Instances, place
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.pipeline import convert
from striptools.trace import Tracer
from striptools.trace import instanced as laying
from striptools.trace.instanced import (
    InstanceNumbers,
    geometry_boxes,
    instances_program,
    lay_out_instanced,
    moves_of,
)

CHANDELIER = Path(__file__).parents[1] / "samples" / "chandelier.ply"
KINDS = ("expanded", "compressed")


def sphere(rows=9, columns=12, centre=(0.0, 0.0, 0.0)):
    """A closed mesh round a centre: float32 positions and faces, wound outwards."""
    u, v = np.meshgrid(
        np.linspace(0, np.pi, rows)[1:-1], np.arange(columns) * 2 * np.pi / columns, indexing="ij"
    )
    ring = np.stack([np.sin(u) * np.cos(v), np.sin(u) * np.sin(v), np.cos(u)], axis=-1).reshape(-1, 3)
    points = np.concatenate([ring, [[0, 0, 1], [0, 0, -1]]]) + centre
    top, bottom, last = len(ring), len(ring) + 1, (rows - 3) * columns
    faces = []
    for j in range(columns):
        after = (j + 1) % columns
        faces += [[top, j, after], [bottom, last + after, last + j]]
        for i in range(rows - 3):
            a, b = i * columns + j, i * columns + after
            faces += [[a, a + columns, b], [b, a + columns, b + columns]]
    return points.astype(np.float32), np.array(faces, np.int32)


def random_matrices(random, count, spread=3.0):
    """Turned, stretched unevenly, sheared a little, every other one mirrored, (k, 3, 4)."""
    turned = np.linalg.qr(random.normal(size=(count, 3, 3)))[0]
    stretched = 10 ** random.uniform(-1.5, 0.5, (count, 1, 3))
    matrix = turned * stretched @ (np.eye(3) + 0.2 * random.normal(size=(count, 3, 3)))
    wrong = (np.linalg.det(matrix) < 0) != (np.arange(count) % 2 == 1)
    matrix[wrong, :, 0] *= -1
    return np.concatenate([matrix, spread * random.normal(size=(count, 3, 1))], axis=2)


def mesh_of(parts, geometry, matrix):
    """A mesh of geometries `(positions, faces)` and instances."""
    vertices = np.cumsum([0, *(len(positions) for positions, _ in parts)])
    faces = [part + first for (_, part), first in zip(parts, vertices, strict=False)]
    return Mesh(
        np.concatenate([positions for positions, _ in parts]),
        np.concatenate(faces).astype(np.int32),
        geometries=Geometries(np.cumsum([0, *map(len, faces)]).astype(np.int32), vertices.astype(np.int32)),
        instances=Instances(geometry, matrix),
    )


def crowded(seed, count, last):
    """A mesh of instances of three geometries, one of them far from its own zero, and its scene."""
    random = np.random.default_rng(seed)
    parts = [sphere(), sphere(4, 3, (8.0, -5.0, 2.0)), last]
    geometry = np.concatenate([[2, 0, 1], random.integers(0, 3, count - 3)])
    mesh = mesh_of(parts, geometry, random_matrices(random, len(geometry)))
    return mesh, convert(mesh)


@pytest.fixture(scope="module")
def crowd():
    """Forty instances."""
    return crowded(3, 40, sphere(30, 20))


def rays_through(scene, count, seed=0):
    """Rays from all round a scene and from inside it, to places in it; directions of many lengths."""
    random = np.random.default_rng(seed)
    placed = scene.placed()
    low, high = placed.low.astype(np.float64), placed.high.astype(np.float64)
    origins = (low + high) / 2 + random.normal(size=(count, 3)) * np.linalg.norm(high - low)
    origins[::3] = random.uniform(low, high, (len(origins[::3]), 3))
    directions = random.uniform(low, high, (count, 3)) - origins
    directions *= 10 ** random.uniform(-3, 3, (count, 1))
    return origins.astype(np.float32), directions.astype(np.float32)


def bounds_on_t(scene, origins, directions, hits):
    """How far t of a shared instance, and its point, may be from the flattened one's.

    The moved ray is off by at most f times the largest coordinate (`walk_instances`), the flattened hit
    by 8 u of it; both meet the plane of the face, whose normal turns a distance into one along the ray.
    """
    moves = moves_of(scene, geometry_boxes(scene))
    placed = scene.placed()
    a, b, c = placed.positions[placed.faces()[hits.triangle]].astype(np.float64).transpose(1, 0, 2)
    normal = np.cross(b - a, c - a)
    slope = np.abs((normal * directions).sum(axis=1))
    size = np.maximum(np.abs(origins).max(axis=1), moves.reach / float(moves.scale))
    off = (moves.slips[hits.instance] + 8 * laying.U) * size
    # A rounded corner moves the plane by u of its coordinates, and an edge's tilt by as much over its length.
    along = off * np.abs(normal).sum(axis=1) / slope + 8 * laying.U * hits.t
    return along, off, np.stack([b - a, c - a], axis=2)


def agree(scene, tracer, flat, rays):
    """Both find the same, but where hits tie or rays only just meet a face; gives how many did not."""
    ours, theirs = tracer.closest_hit(*rays), flat.closest_hit(*rays)
    both = np.flatnonzero(ours.hit & theirs.hit & (ours.face == theirs.face))
    found = {f: getattr(theirs, f)[both] for f in ("triangle", "instance", "t")}
    limit, off, edges = bounds_on_t(scene, rays[0][both], rays[1][both], replace(theirs, **found))
    assert (np.abs(ours.t[both].astype(np.float64) - theirs.t[both]) <= limit).all()
    for name in ("triangle", "instance", "geometry", "geometry_face"):
        np.testing.assert_array_equal(getattr(ours, name)[both], getattr(theirs, name)[both])
    weights = np.stack([ours.u - theirs.u, ours.v - theirs.v], axis=1)[both]
    apart = np.abs(np.einsum("kij,kj->ki", edges, weights)).max(axis=1)
    assert (apart <= limit * np.abs(rays[1][both]).max(axis=1) + 16 * off).all()
    np.testing.assert_array_equal(tracer.any_hit(*rays), ours.hit)
    return int((ours.face != theirs.face).sum()), int(theirs.hit.sum())


@pytest.mark.parametrize("resident", KINDS)
@pytest.mark.parametrize("name", sorted(SCENES))
def test_hits_are_those_of_the_flattened_scene(name, resident):
    scene = convert(load(SCENES[name]))
    tracer = Tracer(scene, device="cpu", instances="shared", resident=resident)
    flat = Tracer(scene, device="cpu", instances="flattened")
    assert (tracer.instances, flat.instances) == ("shared", "flattened")
    different, hits = agree(scene, tracer, flat, rays_through(scene, 3000))
    assert hits > 200
    assert different == 0


@pytest.mark.parametrize("resident", KINDS)
def test_forty_instances_of_three_geometries(crowd, resident):
    _, scene = crowd
    tracer = Tracer(scene, device="cpu", instances="shared", resident=resident)
    flat = Tracer(scene, device="cpu", instances="flattened")
    different, hits = agree(scene, tracer, flat, rays_through(scene, 20000))
    assert hits > 3000
    # A ray that meets an edge, or a place where instances go through each other, may meet either face.
    assert different <= hits // 1000


def test_both_residencies_find_the_same_bit_for_bit(crowd):
    _, scene = crowd
    rays = rays_through(scene, 20000, 1)
    one, other = (
        Tracer(scene, device="cpu", instances="shared", resident=kind).closest_hit(*rays) for kind in KINDS
    )
    for name in ("t", "face", "u", "v", "triangle", "instance", "geometry", "geometry_face"):
        assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def test_a_hit_says_where_it_is(crowd):
    mesh, scene = crowd
    rays = rays_through(scene, 5000, 2)
    hits = Tracer(scene, device="cpu", instances="shared").closest_hit(*rays)
    hit = np.flatnonzero(hits.hit)
    assert (hits.instance[~hits.hit] == -1).all()
    assert (hits.geometry_face[~hits.hit] == -1).all()
    flat = mesh.flattened()
    np.testing.assert_array_equal(mesh.instances.geometry[hits.instance[hit]], hits.geometry[hit])
    # The face within its geometry, placed by the instance's matrix, is the flattened source's face.
    for k in hit[:200]:
        row = mesh.faces[mesh.geometries.face_starts[hits.geometry[k]] + hits.geometry_face[k]]
        placed = place(mesh.positions[row], mesh.instances.matrix[hits.instance[k]])
        if mesh.instances.mirrored[hits.instance[k]]:
            placed = placed[[0, 2, 1]]
        np.testing.assert_allclose(flat.positions[flat.faces[hits.face[k]]], placed, rtol=1e-6, atol=1e-6)
        weights = np.array([1 - hits.u[k] - hits.v[k], hits.u[k], hits.v[k]])
        point = rays[0][k] + rays[1][k].astype(np.float64) * hits.t[k]
        np.testing.assert_allclose(weights @ placed, point, atol=2e-3)


def inner_targets(mesh, k):
    """Edge midpoints and vertices of instance k, in float64 where they stand."""
    geometry = int(mesh.instances.geometry[k])
    faces = mesh.faces[mesh.geometries.faces(geometry)]
    corners = mesh.positions[faces].astype(np.float64)
    own = np.concatenate([(corners + np.roll(corners, 1, axis=1)).reshape(-1, 3) / 2, corners.reshape(-1, 3)])
    return place(own, mesh.instances.matrix[k])


@pytest.mark.parametrize("resident", KINDS)
def test_no_ray_leaks_at_edges_and_vertices(crowd, resident):
    """From a geometry's middle every edge and vertex of its sphere, stretched and mirrored, is certain."""
    mesh, scene = crowd
    alone = moves_of(scene, geometry_boxes(scene))
    rays = 0
    for geometry in range(3):
        matrices = mesh.instances.matrix[mesh.instances.geometry == geometry]
        part = (
            mesh.positions[mesh.geometries.vertices(geometry)],
            mesh.faces[mesh.geometries.faces(geometry)] - mesh.geometries.vertex_starts[geometry],
        )
        # Apart from each other, so that nothing but the instance itself can be hit.
        matrices[:, :, 3] += np.arange(len(matrices))[:, None] * [40.0, 0, 0]
        one = mesh_of([part], np.zeros(len(matrices)), matrices)
        tracer = Tracer(convert(one), device="cpu", instances="shared", resident=resident)
        middle = part[0].astype(np.float64).mean(axis=0)
        for k in range(len(matrices)):
            targets = inner_targets(one, k)
            origin = place(middle[None], one.instances.matrix[k]).astype(np.float32)
            directions = (targets - origin).astype(np.float32)
            hits = tracer.closest_hit(np.repeat(origin, len(targets), axis=0), directions)
            assert (hits.instance == k).all()
            size = np.linalg.norm(directions, axis=1)
            far = np.abs(one.instances.matrix[k]).sum() * 40
            assert ((hits.t - 1) * size <= far * alone.slips.max() * 8).all()
            rays += len(targets)
    assert rays > 20000


@pytest.mark.parametrize("resident", KINDS)
def test_no_ray_leaks_from_outside_a_real_model(resident):
    """Aimed at edges and vertices of the geometry, placed; certain by the ray as the walk moves it."""
    model = load_mesh(CHANDELIER)
    random = np.random.default_rng(11)
    matrices = random_matrices(random, 6)
    matrices[:, :, 3] *= 100
    part = (np.asarray(model.positions, np.float32), model.faces)
    scene = convert(mesh_of([part], np.zeros(6), matrices))
    tracer, layout = (
        Tracer(scene, device="cpu", instances="shared", resident=resident),
        lay_out_instanced(scene),
    )
    kept = np.zeros(len(model.faces), bool)
    kept[scene.remap.face] = True
    surface = Surface(part[0], model.faces[kept])
    bounds = np.array([part[0].min(axis=0), part[0].max(axis=0)], np.float64)
    certain = 0
    for k in range(len(matrices)):
        edges = random.choice(surface.edges, 3000, replace=False)
        vertices = random.integers(0, len(surface.vertices), 3000)
        at = surface.positions[surface.vertices[vertices]].astype(np.float64)
        for targets, normals, fans in (
            (surface.edge_midpoints(edges), surface.normals_at(edges), surface.edge_fans(edges)),
            (at, surface.normals_at(surface.corner_at(vertices)), surface.vertex_fans(vertices)),
        ):
            starts = aim(targets, normals, bounds, random)[0].astype(np.float64)
            placed = place(starts, matrices[k]), place(targets, matrices[k])
            rays = placed[0].astype(np.float32), (placed[1] - placed[0].astype(np.float32)).astype(np.float32)
            hits = tracer.closest_hit(*rays)
            verdicts = judge_fans(frame_rays(*moved_rays(scene, layout, *rays, k)), surface, fans)
            certain += int(verdicts.certain.sum())
            leaks = verdicts.certain & ~(hits.t <= verdicts.farthest)
            assert not leaks.any(), (k, int(leaks.sum()))
    assert certain > 20000


def moved_rays(scene, layout, origins, directions, k):
    """Rays in the frame of instance k, float32, as the walk moves them; t is the caller's."""
    start, way = layout.moved(origins, directions, np.full(len(origins), k))
    length = np.ldexp(1.0, np.frexp(np.abs(directions).max(axis=1))[1] - 1)[:, None]
    scale = float(layout.arrays.frame.scale) / float(layout.geometries.arrays.frame.scale)
    return start, way * (length * scale).astype(np.float32)


def test_matrices_that_round_nothing_give_the_bits_of_the_flattened_scene():
    alike = np.stack([np.eye(4)[:3], 4 * np.eye(4)[:3], 0.125 * np.eye(4)[:3]])
    scene = convert(mesh_of([sphere()], np.zeros(3), alike))
    rays = rays_through(scene, 4000)
    ours, theirs = (
        Tracer(scene, device="cpu", instances=kind).closest_hit(*rays) for kind in ("shared", "flattened")
    )
    assert len(np.unique(ours.instance)) == 3
    for name in ("t", "face", "u", "v", "triangle", "instance", "geometry_face"):
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes()


def test_t_max_and_the_first_of_equals():
    twice = load(SCENES["twice the same place"])
    scene = convert(twice)
    tracer = Tracer(scene, device="cpu", instances="shared")
    rays = rays_through(scene, 2000)
    hits = tracer.closest_hit(*rays)
    assert (hits.instance[hits.hit] == 0).all()
    assert hits.hit.any()
    assert not tracer.closest_hit(*rays, t_max=hits.t).hit.any()
    beyond = np.nextafter(hits.t, np.float32(np.inf))
    again = tracer.closest_hit(*rays, t_max=beyond)
    assert again.t.tobytes() == hits.t.tobytes()
    assert again.face.tobytes() == hits.face.tobytes()
    assert (tracer.any_hit(*rays, t_max=beyond) == hits.hit).all()


def test_rays_that_are_none_miss():
    scene = convert(load(SCENES["mirrored"]))
    tracer = Tracer(scene, device="cpu", instances="shared")
    rows = np.array([[0, 0, 0], [np.nan, 0, 1], [np.inf, 0, 0], [1, 0, 0]], np.float32)
    assert not tracer.closest_hit(np.roll(rows, 1, axis=0)[:3], rows[:3]).hit.any()
    assert not tracer.any_hit(np.zeros((3, 3)), rows[:3]).any()


def test_all_rays_at_once_find_the_same(crowd):
    """As a GPU walks them: every loop over all rays, whichever branch they take."""
    _, scene = crowd
    tracer = Tracer(scene, device="cpu", threads=1, instances="shared")
    rays = (*rays_through(scene, 256, 4), np.full(256, np.inf, np.float32))
    assert_same_at_once(tracer, rays, tracer._options())


def assert_same_at_once(tracer, rays, options):
    """Rays that are walked one by one and all at once find the same."""
    one, other = (
        instances_program(tracer._mesh, options._replace(batch=batch))(tracer._scene, *rays)
        for batch in (False, True)
    )
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(np.asarray(a), np.asarray(b))


def test_counters_count_both_levels(crowd):
    _, scene = crowd
    tracer = Tracer(scene, device="cpu", instances="shared")
    rays = rays_through(scene, 500)
    hits = tracer.closest_hit(*rays, counters=True)
    assert hits.t.tobytes() == tracer.closest_hit(*rays).t.tobytes()
    assert (hits.counters.nodes >= 1).all()
    assert (hits.counters.triangles[hits.hit] >= 1).all()


def test_a_box_that_is_not_widened_would_lose_hits(crowd, monkeypatch):
    """The fault that the factors are for: boxes that stop short of what is in them."""
    _, scene = crowd
    rays = rays_through(scene, 5000)
    right = Tracer(scene, device="cpu", instances="shared").closest_hit(*rays)
    monkeypatch.setattr(laying, "_slips", lambda a, *_: np.full(len(a), -0.02))
    wrong = Tracer(scene, device="cpu", instances="shared").closest_hit(*rays)
    assert (right.face != wrong.face).any()


def test_the_slip_holds_for_the_moved_ray(crowd):
    """In float64, where the moved ray gets to in each instance is within f of where the ray does."""
    _, scene = crowd
    layout = lay_out_instanced(scene)
    moves, random = moves_of(scene, geometry_boxes(scene)), np.random.default_rng(5)
    matrix = scene.instances.matrix
    worst = 0.0
    for k in range(len(matrix)):
        origins = (random.normal(size=(500, 3)) * 10 ** random.uniform(0, 3, (500, 1))).astype(np.float32)
        targets = place(scene.positions[scene.spans.vertices(int(scene.instances.geometry[k]))], matrix[k])
        directions = (targets[random.integers(0, len(targets), 500)] - origins).astype(np.float32)
        start, way = moved_rays(scene, layout, origins, directions, k)
        reached = start.astype(np.float64) + way
        off = np.abs(place_exactly(reached, matrix[k]) - (origins.astype(np.float64) + directions)).max(
            axis=1
        )
        size = np.maximum(np.abs(origins).max(axis=1), moves.reach / float(moves.scale))
        worst = max(worst, float((off / size / moves.slips[k]).max()))
    assert 0.02 < worst <= 1


def place_exactly(points, matrix):
    """Float64 points where a matrix puts them."""
    return points @ matrix[:, :3].T + matrix[:, 3]


def test_what_float32_cannot_move_is_refused():
    sheared = np.array([np.eye(4)[:3], [[1, 1, 0, 0], [1, 1 + 1e-9, 0, 0], [0, 0, 1, 0]]])
    scene = convert(mesh_of([sphere()], np.zeros(2), sheared))
    with pytest.raises(UsageError, match="instance 1 is too distorted"):
        Tracer(scene, device="cpu", instances="shared")
    assert Tracer(scene, device="cpu").instances == "flattened"


def test_what_cannot_be_done_is_refused(crowd):
    _, scene = crowd
    with pytest.raises(UsageError, match="no such instances"):
        Tracer(scene, instances="gold")
    with pytest.raises(UsageError, match="flattened instances are expanded"):
        Tracer(scene, instances="flattened", resident="compressed")


def test_what_does_not_fit_is_shared(crowd):
    _, scene = crowd
    assert Tracer(scene, device="cpu", memory_budget=2**30).instances == "flattened"
    small = Tracer(scene, device="cpu", memory_budget=90 * scene.triangle_count)
    assert (small.instances, small.resident) == ("shared", "expanded")
    least = Tracer(scene, device="cpu", memory_budget=10)
    assert (least.instances, least.resident) == ("shared", "compressed")


def test_more_faces_than_int32_numbers_are_refused(crowd):
    _, scene = crowd
    first = scene.instances.first_face.copy()
    first[-1] = 2**31
    late = replace(scene, instances=replace(scene.instances, first_face=first))
    with pytest.raises(LimitError, match="2\\^31"):
        InstanceNumbers.of(late)


def test_a_scene_without_instances_says_nothing_of_them():
    positions, faces = sphere()
    hits = Tracer(convert(Mesh(positions, faces)), device="cpu").closest_hit(
        np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32)
    )
    assert hits.hit.all()
    assert hits.instance is None
    assert hits.geometry is None
    assert hits.geometry_face is None


def test_many_instances_take_little_more_than_their_geometry():
    random = np.random.default_rng(0)
    matrices = random_matrices(random, 300, 6.0)
    scene = convert(mesh_of([sphere(48, 72)], np.zeros(300), matrices))
    shared = Tracer(scene, device="cpu", instances="shared")
    flat = Tracer(scene, device="cpu", instances="flattened")
    assert shared.resident_bytes * 100 < flat.resident_bytes
    different, hits = agree(scene, shared, flat, rays_through(scene, 5000))
    assert hits > 500
    assert different <= hits // 1000
