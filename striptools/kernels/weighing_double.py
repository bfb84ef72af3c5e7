"""Kernels that say where on its face a hit lies in float64, for the triangle tests that ask for it."""

import numpy as np

from striptools.kernels.compiled import kernel
from striptools.kernels.packed_hits import HEAD, decode_corners, find_corners
from striptools.kernels.rays import longest_axis
from striptools.kernels.weighing import CHUNK
from striptools.kernels.wide import flushed


@kernel
def block_corners(names, place, blocks, corners, turns):
    """Gather triangles of leaf blocks: `blocks` and `place` as `kernels.wide.fill_leaf_blocks` writes them.

    Args:
        names: (k,) int32, faces.
        place: (f,) int32.
        blocks: (l, 10, 8) float32.
        corners: (k, 3, 3) float32, written: a row an axis, a column a corner, in the order of the tests.
        turns: (k,) int32, written: corner j is the reported face's (j + turn) % 3.
    """
    for k in range(len(names)):
        slot = np.int64(place[names[k]])
        turns[k] = slot & 3
        for axis in range(3):
            for j in range(3):
                corners[k, axis, j] = blocks[slot >> 5, 3 * axis + j, (slot >> 2) & 7]


@kernel
def packed_corners(names, blocks, words, rotations, corners, turns):
    """Decode triangles of packed blocks.

    Args:
        names: (k,) int32, 256 times the block plus the number there.
        blocks: (b, 16) uint32, as `kernels.packed_hits.describe_blocks` writes them.
        words: (w,) uint32.
        rotations: (n,) uint8, places that the reported face's corners were turned to the left; or (0,).
        corners: (k, 3, 3) float32, written: a row an axis, a column a corner, in the order of the tests.
        turns: (k,) int32, written: corner j is the reported face's (j + turn) % 3.
    """
    decoded = np.zeros((9, CHUNK), np.float32)
    places = np.zeros((3, CHUNK), np.int64)
    turned = np.zeros(CHUNK, np.int32)
    for begin in range(0, len(names), CHUNK):
        wanted = names[begin : begin + CHUNK]
        find_corners(blocks, words, wanted, places)
        decode_corners(blocks, words, wanted, places, decoded, turned)
        for i in range(len(wanted)):
            for row in range(9):
                corners[begin + i, row // 3, row % 3] = decoded[row, i]
            number = np.int64(blocks[wanted[i] >> 8, HEAD]) + (wanted[i] & 255)
            rotation = rotations[number] if len(rotations) > 0 else 0
            turns[begin + i] = (turned[i] + rotation) % 3


@kernel
def weigh_corners(origins, directions, rays, corners, turns, scale, u, v):
    """Weigh the corners of faces that are hit, each weight 0 at the least, and round u and v last.

    Args:
        origins: (r, 3) float32.
        directions: (r, 3) float32, not zero where there is a hit.
        rays: (k,) int32, the rays that hit.
        corners: (k, 3, 3) float32, as from `packed_corners`.
        turns: (k,) int32.
        scale: float32, what corners are multiplied by.
        u: (r,) float32, written for these rays: the weight of the face's second corner.
        v: (r,) float32, written: the weight of its third corner.
    """
    weights = np.zeros(3, np.float64)
    x, y = np.zeros(3, np.float64), np.zeros(3, np.float64)
    for k in range(len(rays)):
        # Choose the axes as the walk does.
        r = rays[k]
        dx, dy, dz = flushed(directions[r, 0]), flushed(directions[r, 1]), flushed(directions[r, 2])
        kz = longest_axis(dx, dy, dz)
        kx = (kz + 1) % 3
        ky = (kz + 2) % 3

        # Shear the corners so that the ray runs along its dominant axis.
        depth = np.float64(directions[r, kz])
        slope_x = np.float64(flushed(directions[r, kx])) / depth
        slope_y = np.float64(flushed(directions[r, ky])) / depth
        ox = np.float64(flushed(flushed(origins[r, kx]) * scale))
        oy = np.float64(flushed(flushed(origins[r, ky]) * scale))
        oz = np.float64(flushed(flushed(origins[r, kz]) * scale))
        for j in range(3):
            height = np.float64(corners[k, kz, j]) - oz
            x[j] = np.float64(corners[k, kx, j]) - ox - slope_x * height
            y[j] = np.float64(corners[k, ky, j]) - oy - slope_y * height

        # Weigh them; where the ray is beyond an edge by rounding, its corner has no weight.
        weights[0] = x[2] * y[1] - y[2] * x[1]
        weights[1] = x[0] * y[2] - y[0] * x[2]
        weights[2] = x[1] * y[0] - y[1] * x[0]
        sign = 1.0 if weights[0] + weights[1] + weights[2] >= 0 else -1.0
        whole = 0.0
        for j in range(3):
            weights[j] = max(sign * weights[j], 0.0)
            whole += weights[j]
        inverse = 1.0 / whole if whole > 0 else 0.0
        turn = turns[k]
        u[r] = np.float32(weights[(1 - turn) % 3] * inverse)
        v[r] = np.float32(weights[(2 - turn) % 3] * inverse)
