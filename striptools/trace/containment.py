"""Whether points are inside a closed mesh.

**By parity.** A ray from the point leaves the body an odd number of times more than it enters it. What an
edge or a corner on its way counts is decided by `triangle.windings_of`, so one direction is enough: nothing
is tried again or voted on. Which way faces are wound does not matter. Promised for meshes in which each edge
has an even number of faces, and points farther from the surface than the rounding of the ray's test; where a
mesh has holes, the answer is that of the ray's direction and worth nothing behind them.

**By winding.** The generalised winding number (Jacobson, Kavan & Sorkine-Hornung, "Robust Inside-Outside
Segmentation Using Generalized Winding Numbers", SIGGRAPH 2013): the solid angles of all faces over 4 pi,
after Van Oosterom & Strackee, "The Solid Angle of a Plane Triangle", IEEE Trans. Biomed. Eng. 30(2), 1983. It
is a whole number for closed meshes wound one way, and fades gently where there are holes: inside is more than
a half. Cost: every triangle for every point. Sums are float32, pairwise, of up to 32,768 triangles, and
float64 of those: errors of 1e-5 or so. Triangles come where they stand, as flattening rounds their corners
and winds them, in the order of a hierarchy or of instances, on which the last bits depend.
"""

from functools import lru_cache
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float32

from striptools.trace.layout import Layout, Rays

ContainKind = Literal["parity", "winding"]

WAY = np.array([0.36, 0.21, 1.0], np.float32)
"""Where the rays go: no plane or line of a modelled part is likely to run so."""

POINTS_AT_ONCE = 256
LEAVES_AT_ONCE = 64

BLOCKS_AT_ONCE = 4096
"""Blocks of eight triangles that a program is given, at most: what is placed or decoded for it."""


def rays_from(points: np.ndarray) -> Rays:
    """A ray from each point, without an end."""
    return points, np.tile(WAY, (len(points), 1)), np.full(len(points), np.inf, np.float32)


def winding_numbers(layout: Layout, points: Float32[np.ndarray, "r 3"]) -> Float32[np.ndarray, " r"]:
    """The generalised winding number at each point, by the solid angles of all triangles."""
    numbers = np.zeros(-(-len(points) // POINTS_AT_ONCE) * POINTS_AT_ONCE)
    finite = np.all(np.isfinite(points), axis=1)
    ready = np.zeros((len(numbers), 3), np.float32)
    ready[: len(points)][finite] = points[finite]
    scale = layout.arrays.frame.scale
    for blocks in layout.corner_blocks(BLOCKS_AT_ONCE):
        size = max(LEAVES_AT_ONCE, 1 << (len(blocks) - 1).bit_length())
        padded = np.full((size, *blocks.shape[1:]), np.nan, np.float32)
        padded[: len(blocks)] = blocks
        for first in range(0, len(numbers), POINTS_AT_ONCE):
            part = slice(first, first + POINTS_AT_ONCE)
            numbers[part] += np.asarray(_program()(padded, scale, ready[part]))
    found = numbers[: len(points)].astype(np.float32)
    found[~finite] = 0
    return found


@lru_cache(maxsize=1)
def _program() -> Any:
    return jax.jit(_solid_angles)


def _solid_angles(blocks: Array, scale: Array, points: Array) -> Array:
    """Solid angles of triangles (l, 9, 8), l a multiple of 64, seen from points (r, 3), over 4 pi: (r,)."""
    groups = blocks.reshape(-1, LEAVES_AT_ONCE, 9, blocks.shape[-1])
    groups = groups.transpose(0, 2, 1, 3).reshape(len(groups), 9, -1)
    points = points * scale
    sums = lax.map(lambda group: _solid_angle(group, points).sum(axis=1), groups)
    return sums.sum(axis=0) * np.float32(0.5 / np.pi)


def _solid_angle(corners: Array, points: Array) -> Array:
    """Half the solid angle of each triangle (9, n) seen from each point (r, 3): (r, n), 0 in empty lanes."""
    a, b, c = ([corners[3 * axis + j][None] - points[:, axis, None] for axis in range(3)] for j in range(3))
    la, lb, lc = (jnp.sqrt(_dot(p, p)) for p in (a, b, c))
    volume = _dot(a, _cross(b, c))
    below = la * lb * lc + _dot(a, b) * lc + _dot(b, c) * la + _dot(c, a) * lb
    return jnp.where(jnp.isnan(volume), 0, jnp.arctan2(volume, below))


def _dot(p: list[Array], q: list[Array]) -> Array:
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


def _cross(p: list[Array], q: list[Array]) -> list[Array]:
    return [p[(k + 1) % 3] * q[(k + 2) % 3] - p[(k + 2) % 3] * q[(k + 1) % 3] for k in range(3)]
