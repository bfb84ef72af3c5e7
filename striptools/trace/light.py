"""Light of one bounce: a sun with shadows, and a sky that ambient occlusion lets through.

Occlusion is that of Zhukov, Iones & Kronin, "An Ambient Light Illumination Model" (EGWR 1998): the share of
the sky, weighed by the cosine, that nothing near hides. Rays towards it are spread by Malley's method
(`rays`) from the points of a rank-1 lattice, the same for all places but for a shift of its own (Cranley &
Patterson, "Randomization of Number Theoretic Methods for Multiple Integration", SIAM J. Numer. Anal. 13(6),
1976): what a place gets depends on its number alone, not on tiles, threads or calls.

Cost: an any-hit ray towards the sun and `rays` towards the sky for each place that is seen.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float64, Int64

from striptools.trace.rays import Camera, cosine_rays, to_float32

SUN = np.array([1.0, 0.95, 0.86]) * 0.80
SKY = np.array([0.86, 0.93, 1.0]) * 0.52
GROUND = np.array([0.60, 0.55, 0.50]) * 0.52
"""Light of the sun, and of the sky from above and from below, linear."""

TOWARDS_SUN = (-0.55, 0.75, -0.45)
"""Where the sun is, as right, up and forward parts of the camera: behind its left shoulder."""

REACH = 0.2
"""What hides the sky is near: rays towards it end at this part of the model's diagonal."""

LIFT = 2.0**-17
"""Rays start off the surface by this part of the largest coordinate of eye and model."""

LATTICE = 0.6180339887498949


class Occludes(Protocol):
    """What light needs of a tracer."""

    def any_hit(
        self, origins: np.ndarray, directions: np.ndarray, *, t_max: np.ndarray | float | None = None
    ) -> Bool[np.ndarray, " r"]:
        """Whether each ray hits anything; see `striptools.trace.Tracer`."""
        ...


@dataclass(frozen=True, eq=False)
class Places:
    """Places on a surface that light falls on.

    Attributes:
        number: (k,) int64, a number of each: what its random shift depends on.
        points: (k, 3) float64.
        normals: (k, 3) float64, of unit length, on the side that is seen.
    """

    number: Int64[np.ndarray, " k"]
    points: Float64[np.ndarray, "k 3"]
    normals: Float64[np.ndarray, "k 3"]


def light_at(
    tracer: Occludes,
    camera: Camera,
    places: Places,
    bounds: Float64[np.ndarray, "2 3"],
    *,
    rays: int,
    shadow: bool,
) -> Float64[np.ndarray, "k 3"]:
    """The light that falls on places, linear.

    Args:
        tracer: Of what stands in the way.
        camera: The sun keeps its place beside it.
        places: Where.
        bounds: Of the model.
        rays: Rays towards the sky for each place; 0 for a sky that nothing hides.
        shadow: Whether the model hides the sun.
    """
    sun = np.array(TOWARDS_SUN) @ np.stack([camera.right, camera.up, camera.forward])
    sun /= np.linalg.norm(sun)
    lift = LIFT * max(float(np.abs(bounds).max()), float(np.abs(camera.eye).max()))
    facing = np.maximum(places.normals @ sun, 0)
    if shadow:
        facing[np.flatnonzero(facing)] *= ~_hidden(tracer, places, np.flatnonzero(facing), sun, lift)
    above = (0.5 + 0.5 * (places.normals @ camera.up))[:, None]
    sky = SKY * above + GROUND * (1 - above)
    reach = REACH * float(np.linalg.norm(bounds[1] - bounds[0]))
    return SUN * facing[:, None] + sky * open_sky(tracer, places, rays, lift, reach)[:, None]


def _hidden(
    tracer: Occludes, places: Places, which: np.ndarray, sun: np.ndarray, lift: float
) -> Bool[np.ndarray, " m"]:
    """Whether something hides the sun from some of the places."""
    origins = to_float32(places.points[which] + lift * places.normals[which])
    return tracer.any_hit(origins, np.broadcast_to(sun.astype(np.float32), origins.shape))


def open_sky(
    tracer: Occludes, places: Places, rays: int, lift: float, reach: float
) -> Float64[np.ndarray, " k"]:
    """The share of the sky that nothing within reach hides, of each place."""
    count = len(places.number)
    if rays == 0 or count == 0:
        return np.ones(count)
    uniform = spread_points(places.number, rays).reshape(-1, 2)
    given = {"count": rays, "offset": lift, "uniform": uniform}
    origins, directions = cosine_rays(places.points, places.normals, **given)
    hidden = tracer.any_hit(origins, directions, t_max=reach)
    return 1 - hidden.reshape(count, rays).mean(axis=1)


def spread_points(number: Int64[np.ndarray, " k"], count: int) -> Float64[np.ndarray, "k n 2"]:
    """Points of the unit square for each number, spread evenly, shifted round by its hash."""
    step = np.arange(count)
    lattice = np.stack([(step + 0.5) / count, step * LATTICE % 1.0], axis=1)
    bits = _mixed(number.astype(np.uint64))
    shift = np.stack([bits >> np.uint64(40), bits & np.uint64(0xFFFFFF)], axis=1) / 2.0**24
    return (lattice + shift[:, None]) % 1.0


def _mixed(bits: np.ndarray) -> np.ndarray:
    """Hash of 64 bits: the finaliser of SplitMix64 (Steele, Lea & Flood, OOPSLA 2014)."""
    with np.errstate(over="ignore"):
        bits = bits + np.uint64(0x9E3779B97F4A7C15)
        bits = (bits ^ bits >> np.uint64(30)) * np.uint64(0xBF58476D1CE4E5B9)
        bits = (bits ^ bits >> np.uint64(27)) * np.uint64(0x94D049BB133111EB)
        return bits ^ bits >> np.uint64(31)
