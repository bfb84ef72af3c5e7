"""The adapter for users of trimesh: its interface, and every case of its own ray tests, written anew."""

import copy
import pickle

import numpy as np
import pytest
import trimesh

from striptools.errors import UsageError
from striptools.trace.trimesh_rays import RayMeshIntersector


def with_rays(mesh):
    mesh.ray = RayMeshIntersector(mesh, threads=1, device="cpu")
    return mesh


def box(*extents):
    return with_rays(trimesh.creation.box(extents=extents or (2, 2, 2)))


def ball(subdivisions=3):
    return with_rays(trimesh.creation.icosphere(subdivisions=subdivisions))


def lattice(low, high, steps, z):
    x, y = np.meshgrid(np.linspace(low, high, steps), np.linspace(low, high, steps))
    return np.column_stack([x.ravel(), y.ravel(), np.full(x.size, z)])


def upward(count):
    return np.tile([0.0, 0.0, 1.0], (count, 1))


# ---- What comes back, and of what kind.


def test_results_are_arrays_of_trimeshs_shapes_and_dtypes():
    mesh = ball(1)
    for z, some in ((-5.0, True), (5.0, False)):
        origins = lattice(-0.5, 0.5, 10, z)
        places, ray, face = mesh.ray.intersects_location(origins, upward(100))
        assert places.shape == (len(ray), 3)
        assert (places.dtype, ray.dtype, face.dtype) == (np.float64, np.int64, np.int64)
        assert len(ray) == len(face) == (200 if some else 0)
        found = mesh.ray.intersects_id(origins, upward(100))
        assert len(found) == 2
        np.testing.assert_array_equal(found, (face, ray))
        found = mesh.ray.intersects_id(origins, upward(100), return_locations=True)
        np.testing.assert_array_equal(found[2], places)
        first, any_hit = (
            mesh.ray.intersects_first(origins, upward(100)),
            mesh.ray.intersects_any(origins, upward(100)),
        )
        assert (first.shape, first.dtype, any_hit.dtype) == ((100,), np.int64, np.bool_)
        np.testing.assert_array_equal(first >= 0, any_hit)
        assert any_hit.all() == some


def test_no_rays_and_no_faces_are_no_hits():
    none = np.zeros((0, 3))
    assert [a.shape for a in box().ray.intersects_location(none, none)] == [(0, 3), (0,), (0,)]
    assert box().ray.contains_points(none).shape == (0,)
    line = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False)
    for mesh in (with_rays(line), with_rays(trimesh.Trimesh())):
        assert not mesh.ray.intersects_any([[0, 0, -1.0]], [[0, 0, 1.0]]).any()
        assert not mesh.ray.contains_points([[0.0, 0, 0]]).any()
        assert len(mesh.ray.intersects_id([[0, 0, -1.0]], [[0, 0, 1.0]])[0]) == 0


def test_hits_are_sorted_by_ray_and_distance():
    origins = lattice(-0.9, 0.9, 20, -3.0)
    places, ray, _ = ball().ray.intersects_location(origins, upward(400))
    assert (np.diff(ray) >= 0).all()
    assert (np.diff(places[:, 2])[np.diff(ray) == 0] > 0).all()


@pytest.mark.parametrize(
    ("origins", "directions"),
    [(np.zeros((2, 3)), np.zeros((3, 3))), (np.zeros(3), np.zeros(3)), (np.zeros((1, 2)), np.zeros((1, 2)))],
)
def test_shapes_that_do_not_fit_are_told(origins, directions):
    with pytest.raises(ValueError, match="ray"):
        box().ray.intersects_id(origins, directions)
    with pytest.raises(UsageError):
        box().ray.intersects_any(origins, directions)
    with pytest.raises(ValueError, match="points"):
        box().ray.contains_points(np.zeros(3))


def test_lengths_of_directions_do_not_matter():
    origins = lattice(-0.5, 0.5, 4, -5.0)
    one, other = (ball().ray.intersects_location(origins, upward(16) * s)[0] for s in (1, 1e-6))
    np.testing.assert_array_equal(one, other)


def test_a_changed_mesh_is_seen():
    mesh = box()
    assert mesh.ray.intersects_any([[0.9, 0.9, -5]], [[0, 0, 1]])[0]
    mesh.apply_scale(0.5)
    assert not mesh.ray.intersects_any([[0.9, 0.9, -5]], [[0, 0, 1]])[0]
    mesh.apply_translation([1, 1, 0])
    assert mesh.ray.intersects_any([[0.9, 0.9, -5]], [[0, 0, 1]])[0]
    before = mesh.ray.tracer
    assert mesh.ray.tracer is before


def test_copies_and_pickles_go_on():
    rays = box().ray
    assert rays.intersects_any([[0, 0, -5]], [[0, 0, 1]])[0]
    for other in (copy.copy(rays), copy.deepcopy(rays), pickle.loads(pickle.dumps(rays))):
        assert other.intersects_any([[0, 0, -5]], [[0, 0, 1]])[0]
        assert other._options == rays._options
    assert copy.deepcopy(box().ray.mesh).contains([[0, 0, 0]])[0]


# ---- Which hits, and where.


def test_places_of_a_box_lie_on_the_rays_and_on_its_sides():
    mesh = box(1, 1, 1)
    origins = lattice(-0.52, 0.52, 100, -100.0)
    places, ray, _ = mesh.ray.intersects_location(origins, upward(len(origins)))
    np.testing.assert_allclose(places[:, :2], origins[ray][:, :2], atol=1e-12)
    np.testing.assert_allclose(np.abs(places[:, 2]), 0.5, atol=1e-12)
    inside = (np.abs(origins[:, :2]) < 0.5).all(axis=1)
    np.testing.assert_array_equal(np.bincount(ray, minlength=len(origins))[inside], 2)


def test_two_meshes_of_one_shape_are_hit_alike():
    one = ball(2)
    other = with_rays(trimesh.Trimesh(*trimesh.remesh.subdivide(one.vertices, one.faces)))
    random = np.random.default_rng(1)
    origins, targets = random.normal(size=(500, 3)) * 3, random.normal(size=(500, 3)) * 0.7
    hits = [mesh.ray.intersects_any(origins, targets - origins) for mesh in (one, other)]
    np.testing.assert_array_equal(*hits)
    assert 0.1 < hits[0].mean() < 0.9


def test_the_first_hit_alone_or_all_of_them():
    x, y = np.meshgrid(np.arange(-128, 128, 4.0), np.arange(-128, 128, 4.0))
    directions = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, 1000.0)])
    origins = np.tile([0, 0, -15.0], (len(directions), 1))
    mesh = box()
    first, _ = mesh.ray.intersects_id(origins, directions, multiple_hits=False)
    assert len(np.unique(first)) == 2
    assert len(np.unique(mesh.ray.intersects_id(origins, directions, multiple_hits=True)[0])) > 2
    np.testing.assert_allclose(mesh.face_normals[first], [[0, 0, -1]] * len(first), atol=1e-12)


@pytest.mark.parametrize("most", [0, 1, 3, 7, 100])
def test_no_more_hits_than_asked_for(most):
    sheets = trimesh.util.concatenate([trimesh.creation.box((4, 4, 0.1)) for _ in range(6)])
    sheets.vertices[:, 2] += np.repeat(np.arange(6), 8)
    face, ray = with_rays(sheets).ray.intersects_id([[0.3, 0.2, -9], [9, 9, -9]], upward(2), max_hits=most)
    assert len(face) == min(most, 12)
    assert (ray == 0).all()


@pytest.mark.parametrize("extents", [(40, 40, 40), (2, 3, 5)])
def test_rays_from_inside_through_corners_and_edges_meet_the_mesh_once(extents):
    inner = with_rays(trimesh.creation.box(extents=extents).subdivide_to_size(max(extents) / 2))
    outer = trimesh.creation.box(extents=np.array(extents) * 1.5).subdivide_to_size(max(extents) * 0.75)
    for targets in (inner.vertices, inner.vertices[inner.edges_unique].mean(axis=1), outer.vertices):
        origins = np.zeros_like(targets)
        any_hit = inner.ray.intersects_any(origins, targets)
        _, ray = inner.ray.intersects_id(origins, targets, multiple_hits=False)
        assert any_hit.all()
        np.testing.assert_array_equal(ray, np.arange(len(targets)))
        _, ray, _ = inner.ray.intersects_location(origins, targets)
        np.testing.assert_array_equal(np.bincount(ray), 1)


def test_rays_along_the_edges_of_a_box_hit_it():
    edges = np.array([[x, y, -5.0] for x in (-1, 0, 1) for y in (-1, 0, 1)])
    assert box().ray.intersects_any(edges, upward(9)).all()


def test_rays_along_an_axis_leave_no_holes():
    for steps in (2, 3, 40):
        origins = lattice(-0.9, 0.9, steps, -5.0)
        assert box().ray.intersects_any(origins, upward(len(origins))).all()


@pytest.mark.parametrize("sections", [3, 32])
def test_each_ray_along_a_cylinder_has_two_hits(sections):
    mesh = with_rays(trimesh.creation.cylinder(radius=1.0, height=4.0, sections=sections))
    origins = lattice(-0.3, 0.3, 16, -5.0)
    _, ray = mesh.ray.intersects_id(origins, upward(256))
    np.testing.assert_array_equal(np.bincount(ray, minlength=256), 2)


@pytest.mark.parametrize("scale", [1e-4, 0.1, 1.0, 10, 1e4, 1e8])
def test_an_origin_on_the_surface_counts_and_no_hit_comes_twice(scale):
    mesh = trimesh.creation.box().subdivide().subdivide()
    mesh.apply_scale(scale)
    face, _ = with_rays(mesh).ray.intersects_id([[0, 0, scale / 2]], [[0, 0, -1.0]])
    assert len(face) == 2
    _, _, place = mesh.ray.intersects_id([[0, 0, scale / 2]], [[0, 0, 1.0]], return_locations=True)
    np.testing.assert_allclose(place, [[0, 0, scale / 2]])


def test_a_small_mesh_far_from_the_origin_of_rays_has_two_hits():
    mesh = box(1e-3, 1e-3, 1e-3)
    places, _, _ = mesh.ray.intersects_location([[1e-5, 2e-5, 1e4]], [[0, 0, -1.0]])
    np.testing.assert_allclose(places, [[1e-5, 2e-5, 5e-4], [1e-5, 2e-5, -5e-4]], atol=1e-12)


def test_a_scaled_box_is_hit_at_its_corner():
    mesh = trimesh.creation.box(extents=[64, 64, 64])
    mesh.apply_scale(1 / 64)
    places, ray, _ = with_rays(mesh).ray.intersects_location(
        [[0.5, 0.5, -2]], [[0, 0, 1]], multiple_hits=False
    )
    assert ray.tolist() == [0]
    np.testing.assert_allclose(places[0], [0.5, 0.5, -0.5])


@pytest.mark.parametrize("count", [1, 1023, 1024, 1025, 5000])
def test_many_rays_are_the_same_as_one(count):
    mesh = ball()
    directions = trimesh.unitize(np.random.default_rng(count).random((count, 3)) - [0.5, 0.5, -0.2])
    origins = np.tile([0, 0, -5.0], (count, 1))
    places, ray, face = mesh.ray.intersects_location(origins, directions, multiple_hits=False)
    assert len(places) == len(ray) == len(face)
    for k in (0, count // 2, count - 1):
        one = mesh.ray.intersects_location(origins[k : k + 1], directions[k : k + 1], multiple_hits=False)
        np.testing.assert_array_equal(places[ray == k], one[0])
        np.testing.assert_array_equal(face[ray == k], one[2])
    # The cross products of places and directions.
    off = np.cross(places - origins[ray], directions[ray])
    np.testing.assert_allclose(off, 0, atol=1e-12)


def test_rays_back_to_the_vertices_they_come_from_hit():
    mesh = ball()
    origins = mesh.vertices + mesh.vertex_normals * 0.01
    assert mesh.ray.intersects_any(origins, -mesh.vertex_normals).all()
    places, ray, _ = mesh.ray.intersects_location(origins, -mesh.vertex_normals, multiple_hits=False)
    np.testing.assert_allclose(places, mesh.vertices[ray], atol=1e-6)


def test_rays_that_start_just_outside_do_not_hit_behind_them():
    mesh = box(1, 1, 1)
    points, face = trimesh.sample.sample_surface(mesh, 64, seed=0)
    outward = mesh.face_normals[face]
    for nudge in (1e-6, 1e-8):
        assert not mesh.ray.intersects_any(points + outward * nudge, outward).any()
        assert mesh.ray.intersects_any(points - outward * nudge, outward).all()


def test_far_from_zero_a_hundredth_still_counts():
    corners = [[528980.85, 183526.1, z] for z in (0, 3)] + [[528982.3, 183523.55, z] for z in (0, 3)]
    wall = with_rays(trimesh.Trimesh(corners, [[1, 0, 2], [1, 2, 3]], process=False))
    normal = wall.face_normals[0]
    origin = np.mean(wall.vertices[[0, 2]], axis=0) + [0, 0, 1] + 0.01 * normal
    assert not wall.ray.intersects_any([origin], [normal])[0]
    assert wall.ray.intersects_any([origin], [-normal])[0]


def test_a_ray_in_the_plane_of_a_sheet_hits_nothing():
    sheet = with_rays(
        trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.1, 0.3, 0], [0, 0.3, 0]], [[0, 1, 2], [0, 2, 3]])
    )
    for many in (True, False):
        places, ray, face = sheet.ray.intersects_location([[-0.5, 0.1, 0]], [[1, 0, 0]], multiple_hits=many)
        assert places.shape == (0, 3)
        assert len(ray) == len(face) == 0


def test_agrees_with_embree():
    embree = pytest.importorskip("trimesh.ray.ray_pyembree")
    mesh = ball(2)
    random = np.random.default_rng(0)
    origins = (random.random((2000, 3)) - 0.5) * 5
    directions = trimesh.unitize(random.random((2000, 3)) - 0.5)
    peer = embree.RayMeshIntersector(mesh)
    np.testing.assert_array_equal(
        mesh.ray.intersects_any(origins, directions), peer.intersects_any(origins, directions)
    )
    np.testing.assert_array_equal(
        mesh.ray.intersects_first(origins, directions), peer.intersects_first(origins, directions)
    )
    ours, theirs = (
        sorted(zip(*rays.intersects_id(origins, directions)[::-1], strict=True)) for rays in (mesh.ray, peer)
    )
    assert ours == theirs


# ---- Containment.


def test_a_box_contains_what_is_inside():
    mesh = box(1, 1, 1)
    assert mesh.contains(mesh.vertices / 1.5).all()
    assert not mesh.contains(mesh.vertices * 1.5).any()
    assert not mesh.contains(np.random.default_rng(0).random((30, 3)) * 100 + 1 + mesh.bounds[1]).any()
    assert mesh.contains([mesh.center_mass]).all()
    assert mesh.contains(mesh.vertices).shape == (8,)


def test_a_cavity_is_outside():
    outer, inner = trimesh.creation.box((1, 1, 1)), trimesh.creation.box((0.1, 0.1, 0.1))
    inner.invert()
    mesh = with_rays(trimesh.util.concatenate([outer, inner]))
    np.testing.assert_array_equal(mesh.contains([[0, 0, 0], [0.2, 0, 0], [0, 0.04, 0]]), [False, True, False])


def test_points_whose_rays_meet_edges_are_told_right():
    profile = [[0, 0], [9, 0], [9, 4], [4, 4], [4, 9], [0, 9]]
    faces = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    bottom = np.column_stack([profile, np.zeros(6)])
    top = np.column_stack([profile, np.full(6, 9.0)])
    sides = [[[i, (i + 1) % 6, (i + 1) % 6 + 6], [i, (i + 1) % 6 + 6, i + 6]] for i in range(6)]
    mesh = with_rays(
        trimesh.Trimesh(
            np.concatenate([bottom, top]),
            np.concatenate([np.array(faces)[:, ::-1], np.array(faces) + 6, np.reshape(sides, (-1, 3))]),
        )
    )
    assert mesh.is_watertight
    points = [[4.5, 4.5, 3], [4.5, 3.5, 3], [4.0 - 1e-4, 8, 0.1], [1, 1, 8.9], [4.5, 0.5, 9.1], [-0.1, 0, 0]]
    np.testing.assert_array_equal(mesh.contains(points), [False, True, True, True, False, False])
    by_locations = trimesh.ray.ray_util.contains_points(mesh.ray, points)
    np.testing.assert_array_equal(by_locations, mesh.contains(points))


@pytest.mark.parametrize("shape", [trimesh.creation.icosphere(4), trimesh.creation.uv_sphere(count=[32, 32])])
def test_a_sphere_contains_what_is_clearly_inside_always(shape):
    mesh = with_rays(shape)
    points = np.random.default_rng(3).random((2000, 3)) * 2 - 1
    radius = np.linalg.norm(points, axis=1)
    first = mesh.contains(points)
    assert first[radius < np.linalg.norm(mesh.triangles_center, axis=1).min() * 0.995].all()
    assert not first[radius > 1.005].any()
    for _ in range(5):
        np.testing.assert_array_equal(mesh.contains(points), first)


def test_a_mesh_with_holes_gets_an_answer_for_each_point():
    mesh = ball(2)
    mesh.update_faces(np.arange(len(mesh.faces)) > 20)
    points = lattice(-1, 1, 10, 0.0)
    assert mesh.ray.contains_points(points).shape == (100,)
    for corner in mesh.bounding_box.vertices:
        assert mesh.ray.contains_points([corner]).shape == (1,)
