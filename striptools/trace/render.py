"""Pictures of a scene, by the tracer that `verify` proves: one colour a pixel, averaged in linear light.

Five shadings tell different things: `normal` the shape, `depth` the distance, `strip` how triangles lie in
strips, `steps` what a ray costs, `light` how it looks in the sun (`light`). Cost: one closest hit a sample,
and the rays of `light`; the rest is NumPy over the samples. All but `depth` and `steps`, whose colours span
what the whole picture has, are drawn tile by tile: the same picture, in the memory of a tile.
"""

import io
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal, Protocol, get_args

import numpy as np

from striptools.errors import LimitError, MissingExtraError, UsageError
from striptools.mesh.atomic import write_atomically, write_stream
from striptools.reducem.scene import Scene
from striptools.trace.hit import Hits
from striptools.trace.light import Occludes, Places, light_at
from striptools.trace.rays import Camera, Tile, camera_rays, picture_tiles, whole_picture
from striptools.trace.surface import Surface

Shading = Literal["normal", "depth", "strip", "steps", "light"]
SHADINGS: tuple[str, ...] = get_args(Shading)
BY_TILES = ("normal", "strip", "light")
TILE = 128
"""Pixels of a side of a tile: a few samples for each ray that a device takes at once."""

MOST_AO = 4096
MOST_SAMPLES = 1 << 27
GOLDEN_PART = 0.6180339887498949
SKY_TOP, SKY_BOTTOM = (0.86, 0.89, 0.93), (0.99, 0.99, 0.985)
NEAR_TO_FAR = (
    (1.0, 0.96, 0.86),
    (0.93, 0.72, 0.47),
    (0.62, 0.44, 0.49),
    (0.27, 0.27, 0.44),
    (0.08, 0.11, 0.24),
)
COLD_TO_HOT = (
    (0.01, 0.01, 0.06),
    (0.20, 0.05, 0.36),
    (0.53, 0.12, 0.42),
    (0.85, 0.28, 0.25),
    (0.98, 0.60, 0.10),
    (0.99, 0.97, 0.65),
)
"""Colour ramps in sRGB, dark where the value is far or low; steps of equal size between their colours."""


@dataclass(frozen=True)
class RenderOptions:
    """How a picture is drawn.

    Args:
        shading: "normal", "depth", "strip", "steps" or "light".
        samples: n for n x n rays a pixel.
        background: sRGB of a miss, three numbers of 0 to 1; None for a light gradient. Steps show every ray's
            cost.
        ao: Of "light", rays a pixel towards the sky, shared out among its samples, rounded up; 0 for a sky
            that nothing hides.
        shadow: Of "light", whether the model hides the sun.

    Raises:
        UsageError: An option is out of range.
    """

    shading: Shading = "normal"
    samples: int = 2
    background: tuple[float, float, float] | None = None
    ao: int = 16
    shadow: bool = True

    def __post_init__(self) -> None:
        if self.shading not in SHADINGS:
            raise UsageError(f"shading {self.shading!r}", remedy=f"one of {', '.join(SHADINGS)} is wanted")
        if not 1 <= self.samples <= 8:
            raise UsageError(f"{self.samples} samples a pixel side", remedy="1 to 8 are wanted")
        if self.background is not None and not all(0 <= part <= 1 for part in self.background):
            raise UsageError(f"background {self.background}", remedy="three numbers of 0 to 1 are wanted")
        if not 0 <= self.ao <= MOST_AO:
            raise UsageError(f"{self.ao} rays towards the sky", remedy=f"0 to {MOST_AO} are wanted")


DEFAULT_OPTIONS = RenderOptions()


class Traces(Occludes, Protocol):
    """What render needs of a tracer."""

    def closest_hit(self, origins: np.ndarray, directions: np.ndarray, *, counters: bool = False) -> Hits:
        """The closest hits of rays; see `striptools.trace.Tracer`."""
        ...


Watch = Callable[[float, np.ndarray], None]
"""Told after each tile which part of the picture is done, and the picture so far."""


def render(
    tracer: Traces,
    scene: Scene,
    camera: Camera,
    options: RenderOptions = DEFAULT_OPTIONS,
    watch: Watch | None = None,
) -> np.ndarray:
    """Draw a scene.

    Args:
        tracer: A `striptools.trace.Tracer` of the scene.
        scene: The scene, for its normals, strips and materials.
        camera: Where from; `Camera.framing(Surface(scene).points)` shows it whole.
        options: Shading and samples.
        watch: Called after each tile; what is not drawn yet is background. The array is drawn on.

    Returns:
        (height, width, 3) uint8, sRGB, row by row from the top.

    Raises:
        LimitError: The picture has more than 2^27 samples.
    """
    count = camera.width * camera.height * options.samples**2
    if count > MOST_SAMPLES:
        raise LimitError(f"a picture of {count} samples", remedy=f"at most {MOST_SAMPLES} are drawn")
    surface = Surface(scene)
    picture = np.repeat(_to_bytes(_background(camera, options))[:, None], camera.width, axis=1)
    tiles = picture_tiles(camera, TILE) if options.shading in BY_TILES else [whole_picture(camera)]
    for done, tile in enumerate(tiles, 1):
        picture[tile.pixels] = _drawn(tracer, surface, camera, options, tile)
        if watch is not None:
            watch(done / len(tiles), picture)
    return picture


def _drawn(
    tracer: Traces, surface: Surface, camera: Camera, options: RenderOptions, tile: Tile
) -> np.ndarray:
    """(rows, columns, 3) uint8, the pixels of a tile."""
    rays = camera_rays(camera, options.samples, tile)
    hits = tracer.closest_hit(*rays, counters=options.shading == "steps")
    each = options.samples**2
    if options.shading == "steps":
        colours = _steps_colours(hits)
    else:
        rows = _background(camera, options)[tile.pixels[0]]
        colours = np.repeat(rows, tile.shape[1] * each, axis=0)
        hit = np.flatnonzero(hits.triangle >= 0)
        if options.shading == "light":
            colours[hit] = _lit_colours(tracer, surface, camera, options, tile, rays, hits, hit)
        else:
            colours[hit] = _surface_colours(surface, camera, options.shading, rays[1][hit], hits, hit)
    return _to_bytes(colours.reshape(*tile.shape, each, 3).mean(axis=2))


def _lit_colours(
    tracer: Traces,
    surface: Surface,
    camera: Camera,
    options: RenderOptions,
    tile: Tile,
    rays: tuple[np.ndarray, np.ndarray],
    hits: Hits,
    hit: np.ndarray,
) -> np.ndarray:
    """(k, 3) linear colours of the rays that hit: the light there, times the base colour."""
    each = options.samples**2
    row, across = np.divmod(hit, tile.shape[1] * each)
    number = ((tile.top + row) * camera.width + tile.left) * each + across
    directions, triangle = rays[1][hit].astype(np.float64), hits.triangle[hit]
    points = rays[0][hit] + directions * hits.t[hit].astype(np.float64)[:, None]
    places = Places(number, points, _facing_normals(surface, triangle, directions))
    given = {"rays": -(-options.ao // each), "shadow": options.shadow}
    return surface.colours(triangle) * light_at(tracer, camera, places, surface.bounds, **given)


def save_png(picture: np.ndarray, target: str | Path | IO[bytes]) -> int:
    """Write a (h, w, 3) uint8 picture as PNG, a file whole or not at all; gives the bytes written.

    Raises:
        MissingExtraError: Pillow is not installed.
        WriteError: The file could not be written.
    """
    return _save([picture], target, format="PNG")


def save_gif(pictures: list[np.ndarray], target: str | Path | IO[bytes], *, seconds: float) -> int:
    """Write (h, w, 3) uint8 pictures as a GIF that runs round and round; gives the bytes written.

    Args:
        pictures: One or more, of one size.
        target: The file, whole or not at all, or an open one.
        seconds: Of a round.

    Raises:
        MissingExtraError: Pillow is not installed.
        WriteError: The file could not be written.
    """
    each = max(20, round(1000 * seconds / len(pictures)))
    return _save(pictures, target, format="GIF", save_all=True, duration=each, loop=0)


def _save(pictures: list[np.ndarray], target: str | Path | IO[bytes], **how: Any) -> int:
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingExtraError("pictures need Pillow", remedy='pip install "striptools[trace]"') from error
    buffer = io.BytesIO()
    first, *others = (Image.fromarray(picture) for picture in pictures)
    if others:
        how["append_images"] = others
    first.save(buffer, **how)
    data = buffer.getvalue()
    return write_atomically(target, data) if isinstance(target, str | Path) else write_stream(target, data)


def _background(camera: Camera, options: RenderOptions) -> np.ndarray:
    """(height, 3) linear colours of rays that miss, row by row."""
    if options.background is not None:
        return np.tile(_to_linear(np.array(options.background)), (camera.height, 1))
    return _ramp((SKY_TOP, SKY_BOTTOM), np.linspace(0, 1, camera.height))


def _surface_colours(
    surface: Surface,
    camera: Camera,
    shading: Shading,
    directions: np.ndarray,
    hits: Hits,
    hit: np.ndarray,
) -> np.ndarray:
    """(k, 3) linear colours of the rays that hit."""
    if shading == "depth":
        ahead = hits.t[hit] * (directions @ camera.forward)
        return _ramp(NEAR_TO_FAR, _spread_evenly(ahead))
    triangle = hits.triangle[hit]
    normals = _facing_normals(surface, triangle, directions)
    light = _head_light(normals, directions, camera)
    if shading == "strip":
        return _strip_colours(surface.strips(triangle)) * light
    seen = normals @ np.stack([camera.right, camera.up, -camera.forward], axis=1)
    return _to_linear(0.52 + 0.30 * seen + 0.12) * light


def _facing_normals(surface: Surface, triangle: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Unit normals of triangles, on the side that the rays come from."""
    normals = surface.normals(triangle)
    return np.where((normals * directions).sum(axis=1, keepdims=True) > 0, -normals, normals)


def _head_light(normals: np.ndarray, directions: np.ndarray, camera: Camera) -> np.ndarray:
    """(k, 1) brightness: a lamp at the eye, a softer one from above, and something all round."""
    front = np.clip(-(normals * directions).sum(axis=1), 0, 1)
    above = 0.5 + 0.5 * (normals @ camera.up)
    return (0.16 + 0.62 * front + 0.32 * above**2)[:, None]


def _strip_colours(strip: np.ndarray) -> np.ndarray:
    """(k, 3) linear colours, far apart for strips that follow each other, of about equal brightness."""
    turn = strip * GOLDEN_PART % 1.0
    pale = 0.5 + 0.5 * (strip * GOLDEN_PART**2 * 7 % 1.0)
    phase = 2 * np.pi * (turn[:, None] + np.array([0.0, 1 / 3, 2 / 3]))
    return _to_linear(np.clip(0.66 + 0.34 * pale[:, None] * np.cos(phase), 0, 1))


def _steps_colours(hits: Hits) -> np.ndarray:
    """(samples, 3) linear colours: the hottest is what one ray in a thousand takes."""
    steps = np.zeros(len(hits.t)) if hits.counters is None else hits.counters.steps.astype(np.float64)
    most = max(1.0, float(np.quantile(steps, 0.999))) if len(steps) else 1.0
    return _ramp(COLD_TO_HOT, np.minimum(steps / most, 1.0))


def _spread_evenly(values: np.ndarray) -> np.ndarray:
    """Values from 0 at the least to 1 at the greatest."""
    if len(values) == 0:
        return values
    low, high = float(values.min()), float(values.max())
    return (values - low) / (high - low) if high > low else np.zeros_like(values)


def _ramp(colours: tuple[tuple[float, ...], ...], place: np.ndarray) -> np.ndarray:
    """(k, 3) linear colours at places 0 to 1 of a ramp of sRGB colours."""
    stops = np.linspace(0, 1, len(colours))
    columns = [np.interp(place, stops, column) for column in np.array(colours).T]
    return _to_linear(np.stack(columns, axis=1))


def _to_linear(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((np.maximum(srgb, 0) + 0.055) / 1.055) ** 2.4)


def _to_srgb(linear: np.ndarray) -> np.ndarray:
    linear = np.clip(linear, 0, 1)
    return np.where(linear <= 0.0031308, linear * 12.92, 1.055 * linear ** (1 / 2.4) - 0.055)


def _to_bytes(linear: np.ndarray) -> np.ndarray:
    return np.rint(_to_srgb(linear) * 255).astype(np.uint8)
