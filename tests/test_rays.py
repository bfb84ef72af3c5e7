"""Camera rays frame the model in pixel order; secondary rays follow the cosine."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st

from striptools.errors import UsageError
from striptools.trace.rays import UP_CHOICES, Camera, camera_rays, cosine_rays

sizes = st.sampled_from([1e-6, 1.0, 1e6])


def in_picture(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Places in parts of half the picture, (k, 2), and depths."""
    seen = (points - camera.eye) @ np.stack([camera.right, camera.up, camera.forward], axis=1)
    half = camera.tangent * np.array([camera.width, camera.height]) / min(camera.width, camera.height)
    return seen[:, :2] / seen[:, 2:] / half, seen[:, 2]


class TestCamera:
    @given(
        st.sampled_from(UP_CHOICES),
        st.tuples(st.integers(1, 200), st.integers(1, 200)),
        st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(0.1, 1)),
        st.floats(5, 120),
        sizes,
        st.integers(0, 99),
    )
    @limits(max_examples=60)
    def test_it_holds_every_point_and_fills_the_picture(
        self,
        up: str,
        size: tuple[int, int],
        view: tuple[float, float, float],
        fov: float,
        unit: float,
        seed: int,
    ) -> None:
        points = (np.random.default_rng(seed).normal(size=(50, 3)) * [1, 2, 3] + 20) * unit
        camera = Camera.framing(points, width=size[0], height=size[1], fov=fov, view=view, up=up)
        place, depth = in_picture(camera, points)
        assert (depth > 0).all()
        assert (np.abs(place) <= 0.88 + 1e-6).all()
        frame = np.stack([camera.right, camera.up, camera.forward])
        assert np.allclose(frame @ frame.T, np.eye(3))
        assert np.linalg.det(frame) == pytest.approx(-1)
        assert place.max(axis=0) == pytest.approx(-place.min(axis=0), abs=1e-6)
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        size = np.abs((points - middle) @ frame.T).max()
        # Unless the eye would come too near, or into the model.
        if depth.min() > 0.0501 * size:
            assert np.abs(place).max() == pytest.approx(0.88, abs=1e-6)

    def test_up_is_up_and_front_is_in_front(self) -> None:
        corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
        for up, axis in (("y", 1), ("z", 2), ("x", 0)):
            camera = Camera.framing(corners, up=up)
            assert camera.up[axis] > 0.8
        assert Camera.framing(corners, up="y").eye[2] > 1
        assert Camera.framing(corners, up="z").eye[1] < 0

    def test_straight_down_has_an_up_too(self) -> None:
        camera = Camera.framing(np.eye(3), view=(0, 1, 0))
        assert camera.forward == pytest.approx([0, -1, 0])
        assert np.isfinite(camera.right).all()

    def test_one_point_or_none_is_framed(self) -> None:
        for points in (np.zeros((1, 3)), np.zeros((0, 3)), np.full((1, 3), np.nan)):
            origins, directions = camera_rays(Camera.framing(points, width=2, height=2))
            assert np.isfinite(origins).all()
            assert np.isfinite(directions).all()

    @pytest.mark.parametrize(
        "flaw", [{"width": 0}, {"fov": 0}, {"fov": 170}, {"up": "w"}, {"view": (0, 0, 0)}, {"margin": 0.5}]
    )
    def test_wrong_arguments_are_refused(self, flaw: dict) -> None:
        with pytest.raises(UsageError):
            Camera.framing(np.eye(3), **flaw)


class TestCameraRays:
    def test_pixel_order_is_row_by_row_from_the_top_left(self) -> None:
        camera = Camera.framing(np.eye(3), width=7, height=5)
        origins, directions = camera_rays(camera)
        assert origins.shape == directions.shape == (35, 3)
        assert origins.dtype == directions.dtype == np.float32
        picture = directions.reshape(5, 7, 3)
        assert (np.diff(picture @ camera.right, axis=1) > 0).all()
        assert (np.diff(picture @ camera.up, axis=0) < 0).all()
        assert picture[2, 3] == pytest.approx(camera.forward, abs=1e-6)

    def test_samples_of_a_pixel_follow_each_other_and_average_to_its_middle(self) -> None:
        camera = Camera.framing(np.eye(3), width=4, height=3)
        _, one = camera_rays(camera)
        _, many = camera_rays(camera, 3)
        ahead = many @ camera.forward
        plane = (many / ahead[:, None]).reshape(12, 9, 3).mean(axis=1)
        assert plane == pytest.approx(one / (one @ camera.forward)[:, None], abs=1e-6)
        with pytest.raises(UsageError):
            camera_rays(camera, 0)

    def test_directions_are_of_unit_length(self) -> None:
        _, directions = camera_rays(Camera.framing(np.eye(3), width=31, height=17, fov=100))
        assert np.linalg.norm(directions, axis=1) == pytest.approx(1, abs=1e-6)


class TestCosineRays:
    @pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.6, -0.8, 0)])
    def test_they_follow_the_cosine(self, normal: tuple[float, float, float]) -> None:
        normals = np.tile(np.array(normal), (50, 1))
        origins, directions = cosine_rays(np.zeros((50, 3)), normals, count=400, seed=1, offset=0.5)
        cosine = directions @ np.array(normal)
        assert (cosine >= 0).all()
        assert cosine.mean() == pytest.approx(2 / 3, abs=0.01)
        assert (cosine**2).mean() == pytest.approx(1 / 2, abs=0.01)
        assert directions.mean(axis=0) == pytest.approx(np.array(normal) * 2 / 3, abs=0.02)
        assert np.linalg.norm(directions, axis=1) == pytest.approx(1, abs=1e-6)
        assert origins == pytest.approx(np.tile(np.array(normal) * 0.5, (20000, 1)))

    def test_a_point_keeps_its_rays_together_and_a_seed_its_numbers(self) -> None:
        points = np.arange(12.0).reshape(4, 3)
        normals = np.tile([0.0, 1.0, 0.0], (4, 1))
        offset = np.array([0.0, 1.0, 2.0, 3.0])
        origins, directions = cosine_rays(points, normals, count=5, seed=3, offset=offset)
        again = cosine_rays(points, normals, count=5, seed=3, offset=offset)[1]
        assert (directions == again).all()
        lifted = points + normals * offset[:, None]
        assert (origins.reshape(4, 5, 3) == lifted[:, None].astype(np.float32)).all()

    def test_no_points(self) -> None:
        assert cosine_rays(np.zeros((0, 3)), np.zeros((0, 3)))[0].shape == (0, 3)


def test_what_float32_cannot_hold_becomes_infinite_and_misses() -> None:
    corners = np.array([[0, 0, 0], [3e38, 3e38, 3e38]])
    origins, directions = camera_rays(Camera.framing(corners, width=2, height=2))
    assert np.isinf(origins).any()
    assert np.isfinite(directions).all()
