"""Light: what hides sun and sky, and that a place's light depends on nothing but the place."""

import numpy as np
import pytest
from oracles import OracleTracer
from strategies import cube, sphere
from test_shared_instances import mesh_of

from striptools.mesh.attributes import Attribute, Material
from striptools.mesh.instances import Geometries
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert
from striptools.trace import Tracer
from striptools.trace.light import Places, open_sky, spread_points
from striptools.trace.rays import (
    Camera,
    Tile,
    camera_rays,
    cosine_rays,
    picture_tiles,
    turntable,
    whole_picture,
)
from striptools.trace.render import RenderOptions, render
from striptools.trace.surface import PLAIN, Surface

WHITE = (1.0, 1.0, 1.0)


class Half:
    """Hides what goes to +x, within a distance of 1."""

    def any_hit(self, origins, directions, *, t_max=None):
        return (directions[:, 0] > 0) & ((np.inf if t_max is None else t_max) >= 1)


def roofed():
    """A floor, and above half of it a roof: positions, faces."""
    square = np.array([[0, 0, 0], [4, 0, 0], [4, 0, 4], [0, 0, 4]], np.float32)
    roof = square * [0.5, 1, 1] + [0, 1, 0]
    faces = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    return Mesh(np.concatenate([square, roof]).astype(np.float32), np.concatenate([faces, faces + 4]))


def places(points, normal=(0.0, 1.0, 0.0)):
    points = np.array(points, np.float64)
    return Places(np.arange(len(points)), points, np.broadcast_to(np.array(normal), points.shape))


class TestSky:
    def test_half_a_sky_is_half_open(self):
        sky = open_sky(Half(), places(np.zeros((50, 3))), 64, 0.0, 2.0)
        np.testing.assert_allclose(sky, 0.5, atol=0.05)
        assert (open_sky(Half(), places(np.zeros((5, 3))), 64, 0.0, 0.5) == 1).all()
        assert (open_sky(Half(), places(np.zeros((5, 3))), 0, 0.0, 2.0) == 1).all()
        assert len(open_sky(Half(), places(np.zeros((0, 3))), 8, 0.0, 2.0)) == 0

    def test_a_roof_hides_it_as_the_integral_says(self):
        """Under the middle of a far larger disk at height h of radius r: hidden is r^2 / (r^2 + h^2)."""
        angle = np.arange(64) * 2 * np.pi / 64
        rim = np.stack([2 * np.cos(angle), np.ones(64), 2 * np.sin(angle)], axis=1)
        positions = np.concatenate([[[0, 1, 0]], rim]).astype(np.float32)
        fan = [[0, 1 + k, 1 + (k + 1) % 64] for k in range(64)]
        tracer = Tracer(convert(Mesh(positions, np.array(fan, np.int32))), device="cpu")
        found = open_sky(tracer, places(np.zeros((40, 3))), 256, 1e-6, 100.0)
        np.testing.assert_allclose(found.mean(), 1 - 4 / 5, atol=0.005)

    def test_points_are_spread_evenly_and_by_their_number_alone(self):
        number = np.arange(1000) * 7919
        spread = spread_points(number, 16)
        assert spread.shape == (1000, 16, 2)
        assert ((spread >= 0) & (spread < 1)).all()
        # Each row of a lattice has one point in each sixteenth; the shifts of all are even.
        cells = np.sort(np.floor((spread[:, :, 0] - spread[:, :1, 0]) % 1 * 16 + 1e-6), axis=1)
        assert (cells == np.arange(16)).all()
        assert np.abs(spread.mean(axis=(0, 1)) - 0.5).max() < 0.01
        assert spread_points(number[500:501], 16).tobytes() == spread[500:501].tobytes()
        assert len(np.unique(spread[:, 0, 0])) > 990

    def test_directions_are_those_of_the_points_given(self):
        uniform = np.array([[0.0, 0.0], [1.0, 0.25]])
        _, way = cosine_rays(np.zeros((1, 3)), [[0.0, 0.0, 1.0]], count=2, uniform=uniform)
        np.testing.assert_allclose(way, [[0, 0, 1], [0, 1, 0]], atol=1e-6)


class TestPictures:
    def test_tiles_are_the_whole(self):
        mesh = Mesh(*sphere(2))
        scene = convert(mesh, Options(threads=1))
        tracer, camera = OracleTracer(scene, mesh), Camera.framing(mesh.positions, width=300, height=140)
        parts, shown = [], []

        def watch(part, picture):
            parts.append(part)
            shown.append(picture.copy())

        options = RenderOptions("light", 1, WHITE, ao=4)
        picture = render(tracer, scene, camera, options, watch)
        assert parts == [(k + 1) / 6 for k in range(6)]
        assert (shown[-1] == picture).all()
        assert (shown[0] == 255).all(axis=2).mean() > (picture == 255).all(axis=2).mean()
        from striptools.trace import render as module

        whole = pytest.MonkeyPatch()
        with whole.context() as patch:
            patch.setattr(module, "TILE", 1000)
            assert (render(tracer, scene, camera, options) == picture).all()
            patch.setattr(module, "TILE", 37)
            assert (render(tracer, scene, camera, options) == picture).all()

    def test_tiles_hold_each_pixel_once_from_the_middle_on(self):
        camera = Camera.framing(np.eye(3), width=70, height=45)
        count = np.zeros((45, 70), int)
        for tile in picture_tiles(camera, 16):
            count[tile.pixels] += 1
            _, directions = camera_rays(camera, 2, tile)
            assert len(directions) == tile.shape[0] * tile.shape[1] * 4
        assert (count == 1).all()
        first = picture_tiles(camera, 16)[0]
        assert first.left < 35 < first.right
        assert first.top < 23 < first.bottom
        whole = camera_rays(camera, 2)[1].reshape(45, 70, 4, 3)
        tile = Tile(3, 5, 20, 9)
        part = camera_rays(camera, 2, tile)[1].reshape(4, 17, 4, 3)
        assert part.tobytes() == np.ascontiguousarray(whole[tile.pixels]).tobytes()
        assert whole_picture(camera) == Tile(0, 0, 70, 45)

    def test_shadow_and_occlusion_darken_what_is_under_the_roof(self):
        mesh = roofed()
        scene = convert(mesh, Options(threads=1))
        tracer = Tracer(scene, device="cpu")
        camera = Camera.framing(mesh.positions, width=64, height=64, view=(0.1, 0.35, 1.0))
        pictures = {
            (ao, shadow): render(tracer, scene, camera, RenderOptions("light", 1, WHITE, ao, shadow)).astype(
                int
            )
            for ao, shadow in ((0, False), (0, True), (32, False), (32, True))
        }
        plain = pictures[0, False]
        floor = (camera_hits(tracer, camera, scene) == 0).reshape(64, 64)
        for key in ((0, True), (32, False)):
            assert (pictures[key] <= plain + 1).all()
            assert (pictures[key][floor].sum(axis=1) < plain[floor].sum(axis=1) - 20).mean() > 0.2
        assert pictures[32, True][floor].sum() < pictures[0, True][floor].sum()
        assert len(np.unique(pictures[0, False][floor], axis=0)) == 1
        again = render(tracer, scene, camera, RenderOptions("light", 1, WHITE, 32, True))
        assert (again == pictures[32, True]).all()

    def test_materials_give_the_colour(self):
        positions, faces = cube()
        group = Attribute("group", "face", (np.arange(len(faces)) % 2).astype(np.int32)[:, None])
        materials = (Material("red", (1.0, 0.0, 0.0, 1.0)), Material("blue", (0.0, 0.0, 1.0, 1.0)))
        scene = convert(Mesh(positions, faces, attributes=(group,), materials=materials), Options(threads=1))
        tracer = Tracer(scene, device="cpu")
        camera = Camera.framing(positions, width=32, height=32)
        picture = render(tracer, scene, camera, RenderOptions("light", 1, WHITE))
        seen = (picture != 255).any(axis=2)
        assert (picture[seen][:, 1] == 0).all()
        assert (picture[seen][:, 0] > 0).any()
        assert (picture[seen][:, 2] > 0).any()
        bare = Surface(convert(Mesh(positions, faces))).colours(np.zeros(3, np.int32))
        assert (bare == PLAIN).all()


def camera_hits(tracer, camera, scene):
    """Of each pixel's ray: 0 where it hits the floor, 1 the roof, -1 neither."""
    hits = tracer.closest_hit(*camera_rays(camera))
    height = Surface(scene).corners(np.maximum(hits.triangle, 0))[:, 0, 1]
    return np.where(hits.hit, np.rint(height), -1)


class TestSurface:
    def test_instances_look_as_their_flattened_scene(self):
        matrices = np.stack([np.eye(4)[:3], np.diag([-1.0, 2, 0.5, 1])[:3]])
        matrices[1, :, 3] = [5, 1, 0]
        (a, fa), (b, fb) = sphere(1), cube()
        mesh = mesh_of([(a, fa), (b, fb)], [1, 0, 1], matrices[[0, 1, 1]] + [[[0, 0, 0, 1]]])
        kinds = np.repeat([0, 1], [len(fa), len(fb)]).astype(np.int32)[:, None]
        materials = (Material("a", (0.1, 0.2, 0.3, 1.0)), Material("b", (0.4, 0.5, 0.6, 1.0)))
        mesh = Mesh(
            mesh.positions,
            mesh.faces,
            attributes=(Attribute("group", "face", kinds),),
            materials=materials,
            geometries=mesh.geometries,
            instances=mesh.instances,
        )
        scene = convert(mesh)
        surface, placed = Surface(scene), scene.placed()
        every = np.arange(placed.triangle_count, dtype=np.int32)
        corners = placed.positions[placed.faces()]
        mirrored = np.repeat(mesh.instances.mirrored, np.diff(placed.instance_starts))
        turned = np.where(
            mirrored[:, None, None], surface.corners(every)[:, [0, 2, 1]], surface.corners(every)
        )
        np.testing.assert_allclose(turned, corners, rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(surface.bounds, [placed.low, placed.high], atol=1e-6)
        owner = mesh.instances.geometry[np.repeat([0, 1, 2], np.diff(placed.instance_starts))]
        np.testing.assert_array_equal(surface.colours(every)[:, 0], np.where(owner == 0, 0.1, 0.4))
        strips = np.searchsorted(placed.starts, every, side="right")
        same = strips[1:] == strips[:-1]
        np.testing.assert_array_equal(np.diff(surface.strips(every)) == 0, same)
        assert isinstance(mesh.geometries, Geometries)

    def test_very_many_vertices_are_framed_by_boxes(self, monkeypatch):
        from striptools.trace import surface as module

        mesh = mesh_of([sphere(2)], np.zeros(3), np.stack([np.eye(4)[:3]] * 3))
        scene = convert(mesh)
        exact = Surface(scene).bounds
        monkeypatch.setattr(module, "MOST_POINTS", 10)
        boxed = Surface(scene)
        assert len(boxed.points) == 24
        np.testing.assert_allclose(boxed.bounds, exact, atol=1e-6)


class TestTurntable:
    @pytest.mark.parametrize("up", ["x", "y", "-z"])
    def test_every_camera_holds_the_model_from_one_distance(self, up):
        random = np.random.default_rng(0)
        points = random.normal(size=(500, 3)) * [3, 1, 2] + [10, -4, 7]
        cameras = turntable(points, 8, width=60, height=40, up=up)
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        distances = [np.linalg.norm(camera.eye - middle) for camera in cameras]
        np.testing.assert_allclose(distances, distances[0])
        for camera in cameras:
            seen = (points - camera.eye) @ np.stack([camera.right, camera.up, camera.forward], axis=1)
            assert (seen[:, 2] > 0).all()
            size = np.array([60, 40]) / 40 * camera.tangent
            assert (np.abs(seen[:, :2]) <= seen[:, 2:] * size).all()
            axes = np.stack([camera.right, camera.up, camera.forward])
            np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        np.testing.assert_allclose(cameras[1].right @ (cameras[1].eye - cameras[0].eye) > 0, True)

    def test_a_round_comes_back(self):
        points = np.array([[0.0, 0, 0], [1, 1, 1]])
        four, eight = turntable(points, 4), turntable(points, 8)
        np.testing.assert_allclose([c.eye for c in four], [c.eye for c in eight[::2]], atol=1e-12)
