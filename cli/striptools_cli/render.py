"""`striptools render`: a picture of a scene file, or a turntable, drawn by the tracer that verify proves."""

import inspect
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from striptools.errors import UsageError, WriteError
from striptools.mesh.atomic import refusals_named
from striptools.reducem.reader import read_scene
from striptools.reducem.scene import Scene
from striptools.trace import Tracer
from striptools.trace.rays import Camera, turntable
from striptools.trace.render import MOST_AO, RenderOptions, Shading, render, save_gif, save_png
from striptools.trace.surface import Surface
from striptools_cli import log, notice
from striptools_cli.options import SceneFile, quiet_option
from striptools_cli.options_trace import Device, TraceThreads, Up
from striptools_cli.progress import StageProgress
from striptools_cli.report import human_bytes
from striptools_cli.streams import STANDARD, Source, Target, refuse_same, say

_DEFAULTS = RenderOptions()
_FRAMING = {name: option.default for name, option in inspect.signature(Camera.framing).parameters.items()}
_VIEW = ",".join(str(part) for part in _FRAMING["view"])

ROUND_SECONDS = 4.0
"""Of a turntable's GIF."""

SHOW_SECONDS = 1.0
"""Between two states of a picture on its way."""


def run(
    scene: SceneFile,
    target: Annotated[
        str | None, typer.Argument(metavar="[OUT.png]", help="Picture; - for standard output.")
    ] = None,
    shading: Annotated[Shading, typer.Option(help="What the colours say.")] = _DEFAULTS.shading,
    width: Annotated[int, typer.Option(min=1, max=16384, metavar="N", help="Pixels across.")] = _FRAMING[
        "width"
    ],
    height: Annotated[int, typer.Option(min=1, max=16384, metavar="N", help="Pixels down.")] = _FRAMING[
        "height"
    ],
    samples: Annotated[
        int, typer.Option(min=1, max=8, metavar="N", help="N x N rays a pixel.")
    ] = _DEFAULTS.samples,
    ao: Annotated[
        int,
        typer.Option(
            min=0, max=MOST_AO, metavar="N", help="light: rays a pixel for ambient occlusion, 0 for none."
        ),
    ] = _DEFAULTS.ao,
    shadow: Annotated[
        bool, typer.Option("--shadow/--no-shadow", help="light: whether the model hides the sun.")
    ] = _DEFAULTS.shadow,
    fov: Annotated[
        float, typer.Option(min=0.1, max=169.0, metavar="DEGREES", help="Angle across the shorter side.")
    ] = _FRAMING["fov"],
    view: Annotated[
        str, typer.Option(metavar="R,U,F", help="Where the eye is: right, up and front parts.")
    ] = _VIEW,
    up: Up = _FRAMING["up"],
    frames: Annotated[
        int | None,
        typer.Option(
            "--turntable", min=1, max=3600, metavar="N", help="N pictures while the model turns once."
        ),
    ] = None,
    out: Annotated[
        str | None,
        typer.Option(
            "--out", metavar="DIR", help="Folder for --turntable: frame_0000.png ..., turntable.gif."
        ),
    ] = None,
    progressive: Annotated[
        bool, typer.Option("--progressive", help="Write OUT.png every second while it is drawn.")
    ] = False,
    force: Annotated[bool, typer.Option("--force", help="Replace pictures that exist.")] = False,
    device: Device = "auto",
    threads: TraceThreads = None,
    quiet: Annotated[bool, quiet_option()] = False,
) -> None:
    """Draw a picture of a scene file, with the whole model in view, or of a model that turns.

    Shadings: `normal` shows the shape, `depth` the distance, `strip` a colour a strip, `steps` what each ray
    costs, `light` a sun and a sky, in the base colours of materials. A view that begins with a minus sign is
    written --view=-1,0,0.
    """
    log.set_up(quiet=quiet)
    place = _parsed_view(view)
    if (frames is None) != (out is None) or (frames is None) == (target is None):
        raise UsageError(
            "neither one picture nor a turntable", remedy="give OUT.png, or --turntable N --out DIR"
        )
    options = RenderOptions(shading=shading, samples=samples, ao=ao, shadow=shadow)
    file, pictures = _outputs(scene, target, out, frames or 1, force=force, progressive=progressive)
    start = time.perf_counter()
    with StageProgress(quiet=quiet) as progress:
        progress.watch("load", 0.0)
        loaded = read_scene(file.file)
        framed = {"width": width, "height": height, "fov": fov, "view": place, "up": up}
        points = Surface(loaded).points
        cameras = (
            [Camera.framing(points, **framed)] if frames is None else turntable(points, frames, **framed)
        )
        notice.before_tracing(quiet=quiet)
        progress.watch("trace", 0.0)
        tracer = Tracer(loaded, device=device, threads=threads)
        pictures.draw(tracer, loaded, cameras, options, progress)
    if not quiet:
        line = (
            f"{file.title} ({human_bytes(file.size)}) -> {pictures.title} ({human_bytes(pictures.size)}), "
            f"{width} x {height} pixels by {shading}, {time.perf_counter() - start:.1f} s\n"
        )
        say(line, error=pictures.is_standard)


@dataclass
class _Pictures:
    """Where pictures go: one file, or the frames in a folder and a GIF of them."""

    targets: list[Target]
    folder: Path | None
    progressive: bool
    shown: float = field(default=0.0, init=False)

    @property
    def title(self) -> str:
        """What the last line calls them."""
        return (
            self.targets[0].title
            if self.folder is None
            else f"{len(self.targets) - 1} frames in {self.folder}"
        )

    @property
    def size(self) -> int:
        """Bytes written."""
        return sum(target.size for target in self.targets)

    @property
    def is_standard(self) -> bool:
        """Whether the bytes go to standard output."""
        return self.targets[0].is_standard

    def draw(
        self,
        tracer: Tracer,
        scene: Scene,
        cameras: list[Camera],
        options: RenderOptions,
        progress: StageProgress,
    ) -> None:
        """Draw and write them all."""
        drawn = []
        for k, (camera, target) in enumerate(zip(cameras, self.targets, strict=False)):

            def watch(part: float, picture: np.ndarray, k: int = k, target: Target = target) -> None:
                progress.watch("trace", (k + part) / len(cameras))
                self._show(part, picture, target)

            self.shown = time.perf_counter()
            picture = render(tracer, scene, camera, options, watch)
            target.write(lambda place, picture=picture: save_png(picture, place))
            drawn.append(picture)
        if self.folder is not None:
            progress.watch("write", 0.0)
            self.targets[-1].write(lambda place: save_gif(drawn, place, seconds=ROUND_SECONDS))

    def _show(self, part: float, picture: np.ndarray, target: Target) -> None:
        """Write a picture that is on its way, now and then."""
        now = time.perf_counter()
        if self.progressive and part < 1 and now - self.shown >= SHOW_SECONDS:
            target.write(lambda place: save_png(picture, place))
            self.shown = time.perf_counter()


def _outputs(
    scene: str, target: str | None, out: str | None, frames: int, *, force: bool, progressive: bool
) -> tuple[Source, _Pictures]:
    """The input, and the places of the pictures, none of which exists unless by `force`."""
    if target is None or out is not None:
        assert out is not None
        folder = Path(out)
        names = [folder / f"frame_{k:04d}.png" for k in range(frames)] + [folder / "turntable.gif"]
        targets = [Target.open(str(name), force=force) for name in names]
        file = Source.open(scene)
        _make_folder(folder)
        return file, _Pictures(targets, folder, progressive)
    if target != STANDARD and Path(target).suffix.lower() != ".png":
        raise UsageError("no name of a PNG picture", where=target, remedy="end it in .png")
    if progressive and target == STANDARD:
        raise UsageError("standard output takes a picture once", where="--progressive", remedy="name a file")
    refuse_same(scene, target)
    opened = Target.open(target, force=force)
    return Source.open(scene), _Pictures([opened], None, progressive)


def _make_folder(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise WriteError("is a file", where=str(folder), remedy="name a folder")
    with refusals_named(folder):
        folder.mkdir(parents=True, exist_ok=True)


def _parsed_view(text: str) -> tuple[float, float, float]:
    try:
        right, up, front = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(
            f"{text!r} is no view", where="--view", remedy=f"three numbers, like {_VIEW}"
        ) from None
    return right, up, front
