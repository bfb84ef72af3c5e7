"""Pictures: right size, right place, what each shading tells, and PNG files that are whole or not there."""

import io
import sys
from pathlib import Path

import numpy as np
import pytest
from oracles import OracleTracer
from PIL import Image
from strategies import cube, sphere

from striptools.errors import LimitError, MissingExtraError, UsageError, WriteError
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert
from striptools.reducem.scene import Scene
from striptools.trace import Tracer
from striptools.trace.rays import Camera
from striptools.trace.render import SHADINGS, RenderOptions, Shading, render, save_png

WHITE = (1.0, 1.0, 1.0)


@pytest.fixture(scope="module")
def ball() -> tuple[OracleTracer, Scene]:
    mesh = Mesh(*sphere(2))
    scene = convert(mesh, Options(threads=1))
    return OracleTracer(scene, mesh), scene


def camera_of(scene: Scene, width: int = 32, height: int = 24) -> Camera:
    return Camera.framing(scene.positions, width=width, height=height)


def picture_of(
    ball: tuple[OracleTracer, Scene],
    shading: Shading = "normal",
    samples: int = 1,
    background: tuple[float, float, float] | None = WHITE,
) -> np.ndarray:
    tracer, scene = ball
    return render(tracer, scene, camera_of(scene), RenderOptions(shading, samples, background))


class TestPictures:
    @pytest.mark.parametrize("shading", SHADINGS)
    def test_the_model_is_in_the_middle_of_a_background(
        self, ball: tuple[OracleTracer, Scene], shading: Shading
    ) -> None:
        picture = picture_of(ball, shading)
        assert picture.shape == (24, 32, 3)
        assert picture.dtype == np.uint8
        if shading != "steps":
            assert (picture[0, 0] == 255).all()
            white = (picture == 255).all(axis=2)
            assert not white[6:18, 10:22].any()
            assert white.mean() > 0.4

    def test_the_real_tracer_draws_the_same(self, ball: tuple[OracleTracer, Scene]) -> None:
        tracer, scene = ball
        camera = camera_of(scene)
        ours, theirs = render(Tracer(scene), scene, camera), render(tracer, scene, camera)
        assert (ours == theirs).mean() > 0.99

    def test_the_lamp_is_at_the_eye(self, ball: tuple[OracleTracer, Scene]) -> None:
        brightness = picture_of(ball).astype(float).sum(axis=2)
        middle = brightness[12, 16]
        border = np.flatnonzero(brightness[12] < 765)[0]
        assert middle > brightness[12, border]

    def test_near_is_bright_in_depth(self, ball: tuple[OracleTracer, Scene]) -> None:
        depth = picture_of(ball, "depth").astype(float).sum(axis=2)
        row = depth[12][depth[12] < 765]
        assert np.argmax(row) in range(len(row) // 2 - 2, len(row) // 2 + 3)

    def test_a_strip_has_one_colour(self) -> None:
        mesh = Mesh(*cube())
        scene = convert(mesh, Options(threads=1))
        front = Camera.framing(scene.positions, width=24, height=24, view=(0, 0, 1))
        picture = render(OracleTracer(scene, mesh), scene, front, RenderOptions("strip", 1, WHITE))
        colours = np.unique(picture.reshape(-1, 3), axis=0)
        assert 2 <= len(colours) <= 40

    def test_steps_show_every_ray(self, ball: tuple[OracleTracer, Scene]) -> None:
        picture = picture_of(ball, "steps")
        assert len(np.unique(picture.reshape(-1, 3), axis=0)) == 7
        assert picture[0, 6].astype(int).sum() > picture[0, 0].astype(int).sum()

    def test_samples_soften_the_outline(self, ball: tuple[OracleTracer, Scene]) -> None:
        def colours(picture: np.ndarray) -> int:
            return len(np.unique(picture.reshape(-1, 3), axis=0))

        assert colours(picture_of(ball, "depth", 3)) > colours(picture_of(ball, "depth", 1))

    def test_the_default_background_is_light_and_grows_lighter(
        self, ball: tuple[OracleTracer, Scene]
    ) -> None:
        picture = picture_of(ball, background=None).astype(int)
        assert 200 < picture[0, 0].min() < picture[-1, 0].min()

    def test_a_model_out_of_sight_leaves_the_background(self, ball: tuple[OracleTracer, Scene]) -> None:
        tracer, scene = ball
        away = Camera.framing(scene.positions + 1000, width=8, height=8)
        for shading in ("normal", "depth", "strip"):
            assert (render(tracer, scene, away, RenderOptions(shading, 1, WHITE)) == 255).all()

    def test_what_cannot_be_drawn_is_refused(self, ball: tuple[OracleTracer, Scene]) -> None:
        for flaw in ({"shading": "gold"}, {"samples": 0}, {"background": (2, 0, 0)}):
            with pytest.raises(UsageError):
                RenderOptions(**flaw)
        tracer, scene = ball
        with pytest.raises(LimitError):
            render(tracer, scene, camera_of(scene, 20000, 20000))


class TestFiles:
    def test_png_comes_back(self, ball: tuple[OracleTracer, Scene], tmp_path: Path) -> None:
        picture = picture_of(ball)
        target = tmp_path / "ball.png"
        assert save_png(picture, target) == target.stat().st_size
        assert (np.asarray(Image.open(target)) == picture).all()
        stream = io.BytesIO()
        save_png(picture, stream)
        assert stream.getvalue() == target.read_bytes()

    def test_a_folder_that_is_not_there_leaves_nothing(self, tmp_path: Path) -> None:
        with pytest.raises(WriteError):
            save_png(np.zeros((2, 2, 3), np.uint8), tmp_path / "none" / "a.png")
        assert list(tmp_path.iterdir()) == []

    def test_without_pillow_the_remedy_is_named(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setitem(sys.modules, "PIL", None)
        with pytest.raises(MissingExtraError, match="trace"):
            save_png(np.zeros((2, 2, 3), np.uint8), tmp_path / "a.png")
