"""Rays made on the host: a pinhole camera that frames the model, and cosine-distributed secondary rays.

All arithmetic is float64 NumPy; what comes out is float32, the rays as every tracer takes them. The same
arguments give the same rays.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from striptools.errors import UsageError
from striptools.types import RayVectors

AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
BANDS = 64
"""Bands of height, and parts of a turn, that a turntable is framed by."""

CENTRING_STEPS = 12
UP_CHOICES = ("x", "y", "z", "-x", "-y", "-z")
THREE_QUARTER = (0.55, 0.38, 1.0)
"""The default place of the eye, as right, up and front parts: the front, a little to the right and above."""


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with square pixels.

    Attributes:
        eye: (3,) float64, the model's unit.
        right: (3,) float64, unit vector to the picture's right.
        up: (3,) float64, unit vector to the picture's top.
        forward: (3,) float64, unit vector into the picture.
        tangent: The tangent of half the angle of view, across the shorter side of the picture.
        width: Pixels across.
        height: Pixels down.
    """

    eye: Float64[np.ndarray, " 3"]
    right: Float64[np.ndarray, " 3"]
    up: Float64[np.ndarray, " 3"]
    forward: Float64[np.ndarray, " 3"]
    tangent: float
    width: int
    height: int

    @classmethod
    def framing(
        cls,
        points: np.ndarray,
        *,
        width: int = 800,
        height: int = 600,
        fov: float = 35.0,
        view: tuple[float, float, float] = THREE_QUARTER,
        up: str = "y",
        margin: float = 0.06,
    ) -> "Camera":
        """A camera that holds every point as large as the picture allows, and in its middle.

        Args:
            points: (k, 3), vertices or corners of a box; non-finite ones are left out.
            width: Pixels across.
            height: Pixels down.
            fov: Angle of view across the shorter side, in degrees, above 0 and below 170.
            view: Where the eye is, seen from the model: right, up and front parts, of any length.
            up: The model's axis that points to the picture's top, one of `UP_CHOICES`.
            margin: The part of the picture left free at each side, 0 to below 0.5.

        Raises:
            UsageError: An argument is out of range.
        """
        if width < 1 or height < 1 or not 0 < fov < 170 or not 0 <= margin < 0.5:
            raise UsageError(f"no camera of {width} x {height} pixels, {fov} degrees and margin {margin}")
        right, top, forward = _turned_axes(view, up)
        points = np.asarray(points, np.float64).reshape(-1, 3)
        points = points[np.isfinite(points).all(axis=1)]
        if len(points) == 0:
            points = np.zeros((1, 3))
        tangent = float(np.tan(np.radians(fov) / 2))
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        seen = (points - middle) @ np.stack([right, top, forward], axis=1)
        spread = tangent * np.array([width, height]) / min(width, height) * (1 - 2 * margin)
        place = _eye_before(seen, spread)
        eye = middle + place[0] * right + place[1] * top + place[2] * forward
        return cls(eye, right, top, forward, tangent, int(width), int(height))


def turntable(
    points: np.ndarray,
    frames: int,
    *,
    width: int = 800,
    height: int = 600,
    fov: float = 35.0,
    view: tuple[float, float, float] = THREE_QUARTER,
    up: str = "y",
) -> list[Camera]:
    """Cameras round a model that turns once: all at one distance, at which it is held whole from all sides.

    The first is at `view`; from one to the next the model turns to its left, the eye to its right.

    Args:
        points: (k, 3), as of `Camera.framing`, and so is what follows.
        frames: How many, 1 or more.
        width: Pixels across.
        height: Pixels down.
        fov: Angle of view across the shorter side, in degrees.
        view: Where the first eye is.
        up: The axis that the model turns round, as it points to the picture's top.

    Raises:
        UsageError: As of `Camera.framing`, or there are no frames.
    """
    if frames < 1:
        raise UsageError(f"{frames} frames of a turntable", remedy="at least 1 is wanted")
    _turned_axes(view, up)
    axis = np.array(AXES[up[-1]]) * (-1.0 if up.startswith("-") else 1.0)
    middle, rings = _swept(np.asarray(points, np.float64).reshape(-1, 3), axis)
    first = Camera.framing(rings, width=width, height=height, fov=fov, view=view, up=up)
    cameras = []
    for angle in 2 * np.pi * np.arange(frames) / frames:
        turn = _turn_about(axis, angle)
        axes = (turn @ first.right, turn @ first.up, turn @ first.forward)
        eye = middle + turn @ (first.eye - middle)
        cameras.append(Camera(eye, *axes, first.tangent, first.width, first.height))
    return cameras


def _swept(points: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The middle of points, and rings about the axis through it that hold all places they turn through."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        points = np.zeros((1, 3))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    height = (points - middle) @ axis
    radius = np.linalg.norm(points - middle - height[:, None] * axis, axis=1)
    low, high = float(height.min()), float(height.max())
    band = np.minimum((height - low) / max(high - low, 1e-300) * BANDS, BANDS - 1).astype(np.intp)
    widest = np.zeros(BANDS)
    np.maximum.at(widest, band, radius)
    edges = low + (high - low) * np.arange(BANDS + 1) / BANDS
    # The corners of a polygon that a circle fits in.
    corner = widest / np.cos(np.pi / BANDS)
    around = _turn_about(axis, 0.0)[:, np.argsort(np.abs(axis), kind="stable")[:2]].T
    angles = 2 * np.pi * np.arange(BANDS) / BANDS
    circle = np.cos(angles)[:, None] * around[0] + np.sin(angles)[:, None] * around[1]
    rings = [
        middle + h * axis + corner[:, None, None] * circle
        for h in (edges[:-1, None, None], edges[1:, None, None])
    ]
    return middle, np.concatenate(rings).reshape(-1, 3)


def _turn_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """(3, 3), the turn about a unit axis: Rodrigues."""
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * (cross @ cross)


def _turned_axes(view: tuple[float, float, float], up: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Right, up and forward of a camera that looks from `view` at the middle, in the model's axes."""
    if up not in UP_CHOICES:
        raise UsageError(f"up is {up!r}", remedy=f"one of {', '.join(UP_CHOICES)} is wanted")
    top = np.array(AXES[up[-1]]) * (-1.0 if up.startswith("-") else 1.0)
    front = np.array(AXES["y"]) * -1.0 if up[-1] != "y" else np.array(AXES["z"])
    aside = np.cross(top, front)
    place = np.asarray(view, np.float64) @ np.stack([aside, top, front])
    length = np.linalg.norm(place)
    if not np.isfinite(length) or length == 0:
        raise UsageError(f"view is {view}", remedy="a direction other than zero is wanted")
    forward = -place / length
    right = np.cross(forward, top)
    if np.linalg.norm(right) < 1e-9:
        right = np.cross(forward, -front)
    right /= np.linalg.norm(right)
    return right, np.cross(right, forward), forward


def _eye_before(seen: np.ndarray, spread: np.ndarray) -> np.ndarray:
    """The eye nearest to points in camera axes that holds them all within `spread` (tangents across and up).

    A point is held across where |x - x_eye| <= s (z - z_eye): the largest of x - s z and the smallest of x +
    s z are all that matters. The axis that needs more room sets the distance; on each the picture is
    centred.
    """
    side = seen[:, :2]
    reach = spread * seen[:, 2:]
    greatest = (side - reach).max(axis=0)
    least = (side + reach).min(axis=0)
    depth = float(((least - greatest) / (2 * spread)).min())
    nearest = float(seen[:, 2].min())
    size = float(np.abs(seen).max())
    depth = min(depth, nearest - max(0.05 * size, 1e-30))
    return np.array([*(_centred(side[:, axis], seen[:, 2] - depth) for axis in range(2)), depth])


def _centred(side: np.ndarray, ahead: np.ndarray) -> float:
    """The eye's place across from which points at depths `ahead` reach as far to one side as to the other.

    Exchange: solve for the two outermost points, look which are outermost then, until they stay.
    """
    eye = 0.0
    for _ in range(CENTRING_STEPS):
        seen = (side - eye) / ahead
        low, high = int(np.argmin(seen)), int(np.argmax(seen))
        better = (side[low] * ahead[high] + side[high] * ahead[low]) / (ahead[low] + ahead[high])
        if better == eye:
            break
        eye = float(better)
    return eye


@dataclass(frozen=True)
class Tile:
    """A part of a picture: pixels across from `left` to below `right`, down from `top` to below `bottom`."""

    left: int
    top: int
    right: int
    bottom: int

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.bottom - self.top, self.right - self.left

    @property
    def pixels(self) -> tuple[slice, slice]:
        """The rows and columns of a picture that these are."""
        return slice(self.top, self.bottom), slice(self.left, self.right)


def whole_picture(camera: Camera) -> Tile:
    """All of it."""
    return Tile(0, 0, camera.width, camera.height)


def picture_tiles(camera: Camera, side: int) -> list[Tile]:
    """A picture cut into squares of so many pixels a side, from the middle outwards."""
    tiles = [
        Tile(left, top, min(left + side, camera.width), min(top + side, camera.height))
        for top in range(0, camera.height, side)
        for left in range(0, camera.width, side)
    ]

    def off_centre(tile: Tile) -> int:
        across, down = tile.left + tile.right - camera.width, tile.top + tile.bottom - camera.height
        return across**2 + down**2

    return sorted(tiles, key=off_centre)


def camera_rays(camera: Camera, samples: int = 1, tile: Tile | None = None) -> tuple[RayVectors, RayVectors]:
    """Rays of a camera, of unit length, in pixel order: row by row from the top left.

    Args:
        camera: The camera.
        samples: n for n x n rays a pixel, one in the middle of each part; a pixel's rays follow each other.
        tile: The part of the picture to make rays for; None for all of it.

    Returns:
        Origins and directions, (rows * columns * samples^2, 3) float32.

    Raises:
        UsageError: `samples` is less than 1.
    """
    if samples < 1:
        raise UsageError(f"{samples} samples a pixel", remedy="at least 1 is wanted")
    part = (np.arange(samples) + 0.5) / samples
    shorter = min(camera.width, camera.height)
    tile = tile or whole_picture(camera)
    columns, rows = np.arange(tile.left, tile.right), np.arange(tile.top, tile.bottom)
    x = (2 * (columns[:, None] + part) - camera.width) / shorter * camera.tangent
    y = (camera.height - 2 * (rows[:, None] + part)) / shorter * camera.tangent
    across = x[None, :, None, :, None] * camera.right
    upward = y[:, None, :, None, None] * camera.up
    directions = (camera.forward + across + upward).reshape(-1, 3)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(to_float32(camera.eye), directions.shape)
    return np.ascontiguousarray(origins), directions.astype(np.float32)


def cosine_rays(
    points: np.ndarray,
    normals: np.ndarray,
    *,
    count: int = 1,
    seed: int = 0,
    offset: float | np.ndarray = 0.0,
    uniform: np.ndarray | None = None,
) -> tuple[RayVectors, RayVectors]:
    """Secondary rays of unit length, distributed by the cosine about the normals, as in ambient occlusion.

    Malley's method: a point of the unit disk, lifted to the hemisphere (Pharr, Jakob and Humphreys,
    "Physically Based Rendering", 4th edition, A.5.3). The tangent frame is that of Duff et al., "Building an
    Orthonormal Basis, Revisited", JCGT 6(1), 2017.

    Args:
        points: (k, 3) points on the surface.
        normals: (k, 3) unit normals on the side that the rays leave to.
        count: Rays a point; a point's rays follow each other.
        seed: Of the random numbers.
        offset: By how much an origin is lifted off the surface along the normal, in the model's unit; one
            number or one a point.
        uniform: (k * count, 2), points of the unit square to make directions of; None for random ones.

    Returns:
        Origins and directions, (k * count, 3) float32.
    """
    points = np.repeat(np.asarray(points, np.float64), count, axis=0)
    normals = np.repeat(np.asarray(normals, np.float64), count, axis=0)
    lift = np.repeat(np.broadcast_to(np.asarray(offset, np.float64), len(points) // max(count, 1)), count)
    if uniform is None:
        uniform = np.random.default_rng(seed).random((len(points), 2))
    radius, angle = np.sqrt(uniform[:, 0]), 2 * np.pi * uniform[:, 1]
    height = np.sqrt(np.maximum(0.0, 1 - uniform[:, 0]))
    tangent, bitangent = _tangent_frame(normals)
    directions = (
        tangent * (radius * np.cos(angle))[:, None]
        + bitangent * (radius * np.sin(angle))[:, None]
        + normals * height[:, None]
    )
    return to_float32(points + normals * lift[:, None]), directions.astype(np.float32)


def to_float32(values: np.ndarray) -> np.ndarray:
    """Round to float32; what is too large becomes infinite, and its ray a miss."""
    with np.errstate(over="ignore"):
        return values.astype(np.float32)


def _tangent_frame(normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x, y, z = normals.T
    sign = np.copysign(1.0, z)
    a = -1 / (sign + z)
    b = x * y * a
    return np.stack([1 + sign * x * x * a, sign * b, -sign * x], axis=1), np.stack(
        [b, sign + y * y * a, -y], axis=1
    )
