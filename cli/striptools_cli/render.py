"""`striptools render`: a picture of a scene file, drawn by the tracer that verify proves."""

import inspect
import time
from pathlib import Path
from typing import Annotated, Literal

import typer

from striptools.errors import UsageError
from striptools.reducem.reader import read_scene
from striptools.trace import Tracer
from striptools.trace.device import DeviceKind
from striptools.trace.rays import Camera
from striptools.trace.render import RenderOptions, Shading, render, save_png
from striptools_cli import log, notice
from striptools_cli.progress import StageProgress
from striptools_cli.report import human_bytes
from striptools_cli.streams import STANDARD, Source, Target, refuse_same, say

_DEFAULTS = RenderOptions()
_FRAMING = {name: option.default for name, option in inspect.signature(Camera.framing).parameters.items()}
_VIEW = ",".join(str(part) for part in _FRAMING["view"])

Up = Literal["x", "y", "z", "-x", "-y", "-z"]


def run(
    scene: Annotated[str, typer.Argument(metavar="FILE.rdm", help="Scene file; - for standard input.")],
    target: Annotated[str, typer.Argument(metavar="OUT.png", help="Picture; - for standard output.")],
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
    fov: Annotated[
        float, typer.Option(min=0.1, max=169.0, metavar="DEGREES", help="Angle across the shorter side.")
    ] = _FRAMING["fov"],
    view: Annotated[
        str, typer.Option(metavar="R,U,F", help="Where the eye is: right, up and front parts.")
    ] = _VIEW,
    up: Annotated[Up, typer.Option(help="The model's axis that points up.")] = _FRAMING["up"],
    force: Annotated[bool, typer.Option("--force", help="Replace OUT.png where it exists.")] = False,
    device: Annotated[
        DeviceKind, typer.Option(help="Where to trace; auto takes a GPU if there is one.")
    ] = "auto",
    threads: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Threads to trace with.", show_default="every core")
    ] = None,
    quiet: Annotated[bool, typer.Option("--quiet", "-q", help="Say nothing but errors.")] = False,
) -> None:
    """Draw a picture of a scene file, with the whole model in view.

    Shadings: `normal` shows the shape, `depth` the distance, `strip` a colour a strip, `steps` what each ray
    costs. A view that begins with a minus sign is written --view=-1,0,0.
    """
    log.set_up(quiet=quiet)
    if target != STANDARD and Path(target).suffix.lower() != ".png":
        raise UsageError("no name of a PNG picture", where=target, remedy="end it in .png")
    refuse_same(scene, target)
    place = _parsed_view(view)
    out, file = Target.open(target, force=force), Source.open(scene)
    start = time.perf_counter()
    with StageProgress(quiet=quiet) as progress:
        progress.watch("load", 0.0)
        loaded = read_scene(file.file)
        shown = loaded.placed().positions
        camera = Camera.framing(shown, width=width, height=height, fov=fov, view=place, up=up)
        notice.before_tracing(quiet=quiet)
        progress.watch("trace", 0.0)
        tracer = Tracer(loaded, device=device, threads=threads)
        picture = render(tracer, loaded, camera, RenderOptions(shading=shading, samples=samples))
        progress.watch("write", 0.0)
        out.write(lambda place: save_png(picture, place))
    if not quiet:
        line = (
            f"{file.title} ({human_bytes(file.size)}) -> {out.title} ({human_bytes(out.size)}), "
            f"{width} x {height} pixels by {shading}, {time.perf_counter() - start:.1f} s\n"
        )
        say(line, error=out.is_standard)


def _parsed_view(text: str) -> tuple[float, float, float]:
    try:
        right, up, front = (float(part) for part in text.split(","))
    except ValueError:
        raise UsageError(
            f"{text!r} is no view", where="--view", remedy=f"three numbers, like {_VIEW}"
        ) from None
    return right, up, front
