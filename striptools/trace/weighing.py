"""Weights of hits found by triangle tests other than the default one, whose weights may be beyond a face."""

import numpy as np

from striptools.kernels.weighing_double import weigh_corners
from striptools.trace.layout import Found, Layout, Rays


def weights_inside(at: np.ndarray, found: Found) -> None:
    """Take float32 weights, of hits that another test found, to the face where they are beyond it."""
    _, _, u, v, _ = found
    rays = at[at >= 0]
    one, two = np.clip(u[rays], 0, 1), np.maximum(v[rays], 0)
    u[rays], v[rays] = one, np.minimum(two, 1 - one)


def weigh_in_double(
    layout: Layout, rays: Rays, at: np.ndarray, traced: tuple[np.ndarray, ...], found: Found
) -> None:
    """Write u and v anew, in float64, rounded to float32 last.

    Args:
        layout: Of the scene.
        rays: All of them.
        at: (k,) int32, the rays that results are for, negative for none.
        traced: What the walk told of each: (k,) int32 names of the triangles hit, negative on a miss, are the
            second, and behind the fourth comes what a layout needs besides.
        found: What was found, of which u and v are written.
    """
    hit = np.flatnonzero((at >= 0) & (traced[1] >= 0))
    if len(hit) == 0:
        return
    corners, turns = layout.corners_of(*(column[hit] for column in (traced[1], *traced[4:])))
    scale = layout.arrays.frame.scale
    weigh_corners(rays[0], rays[1], at[hit], corners, turns, scale, found[2], found[3])
