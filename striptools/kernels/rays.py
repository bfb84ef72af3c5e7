"""Kernel that readies rays for the walk on a CPU: what `trace.walk_wide` prepares, and the visit to the root.

Rays that miss every child of the root end here, and never reach the device. The arithmetic is that of
`trace.walk_wide.prepared_rays`, bit for bit, denormals read and written as zeros.
"""

import numpy as np
from numba import njit

from striptools.kernels.wide import EMPTY, WIDTH

ROW = 24
"""Words of a ready ray: 17 float32, then 7 int32; see `trace.walk_wide.Ready`."""

ONE = np.float32(1)
ZERO = np.float32(0)
LEAST_NORMAL = np.float32(np.finfo(np.float32).tiny)
FAR_FACTOR = np.float32(1 + 2**-21)
MARGIN = np.float32(2**-21)
TINY = np.float32(2**-60)
SLACK = np.float32(1 + 2**-20)
HIGHEST_BIT = np.array([max(k.bit_length() - 1, 0) for k in range(2**WIDTH)], np.uint8)


@njit(cache=True, nogil=True)
def flushed(value):
    """Zero for a denormal float32; what is not a number stays so."""
    return ZERO if abs(value) < LEAST_NORMAL else value


@njit(cache=True, nogil=True)
def smaller(a, b):
    """The smaller of two, b where they do not compare."""
    return a if a < b else b


@njit(cache=True, nogil=True)
def larger(a, b):
    """The larger of two, b where they do not compare."""
    return a if a > b else b


@njit(cache=True, nogil=True)
def lanes_met(root, low, high, inverse, limit, mirror):
    """The root's lanes that a ray meets, as bits in the order of visits, the nearest highest."""
    lx, ly, lz = low[0], low[1], low[2]
    hx, hy, hz = high[0], high[1], high[2]
    ix, iy, iz = inverse[0], inverse[1], inverse[2]
    lanes = np.int32(0)
    for lane in range(WIDTH):
        ax = root[0, lane] * ix - lx
        ay = root[1, lane] * iy - ly
        az = root[2, lane] * iz - lz
        bx = root[3, lane] * ix - hx
        by = root[4, lane] * iy - hy
        bz = root[5, lane] * iz - hz
        entry = larger(larger(smaller(ax, bx), smaller(ay, by)), larger(smaller(az, bz), ZERO))
        leaving = smaller(larger(ax, bx), smaller(larger(ay, by), larger(az, bz))) * FAR_FACTOR
        bit = np.int32(1) << (np.int32(lane) ^ mirror)
        lanes |= bit if entry <= smaller(limit, leaving) else np.int32(0)
    return lanes


@njit(cache=True, nogil=True, error_model="numpy")
def ready_rays(
    origins, directions, t_max, begin, scale, reach, root, children, visit, rays, words, at, dropped
):
    """Ready rays from `begin` on until the places are full or there are none left.

    Args:
        origins: (r, 3) float32.
        directions: (r, 3) float32.
        t_max: (r,) float32.
        begin: The first ray to take.
        scale: float32 power of two that origins are multiplied by.
        reach: float32, the largest scaled coordinate of the scene.
        root: (7, 8) float32, the boxes of the root's children, NaN in empty lanes; row 6 is not read.
        children: (8,) int32, the root's children.
        visit: Whether to visit the root here; else every valid ray starts at it.
        rays: (k, 24) float32, written, a row for each ray that has something to visit.
        words: The same memory as int32.
        at: (k,) int32, written: which ray each row is.
        dropped: (r,) uint8, written for the rays taken: 0 has a row, 1 missed the root, 2 is no ray.

    Returns:
        The number of rows written, and the first ray not taken.
    """
    room = len(rays)
    count = 0
    o = np.zeros(3, np.float32)
    d = np.zeros(3, np.float32)
    low = np.zeros(3, np.float32)
    high = np.zeros(3, np.float32)
    inverse = np.zeros(3, np.float32)
    for r in range(begin, len(origins)):
        if count == room:
            return count, r

        # Scale the ray by powers of two; refuse what is no ray.
        for k in range(3):
            o[k] = flushed(flushed(origins[r, k]) * scale)
            d[k] = flushed(directions[r, k])
        size_x, size_y, size_z = abs(d[0]), abs(d[1]), abs(d[2])
        longest = larger(larger(size_x, size_y), size_z)
        far = flushed(t_max[r])
        finite = np.isfinite(o[0]) and np.isfinite(o[1]) and np.isfinite(o[2])
        finite = finite and np.isfinite(d[0]) and np.isfinite(d[1]) and np.isfinite(d[2])
        if not (finite and longest >= LEAST_NORMAL and far > ZERO):
            dropped[r] = 2
            continue
        exponent = min(max(np.float32(longest).view(np.int32) >> 23, 1), 253)
        shorten = np.int32((254 - exponent) << 23).view(np.float32)
        length = np.int32(exponent << 23).view(np.float32)
        for k in range(3):
            d[k] = flushed(d[k] * shorten)
        far = flushed(flushed(far * length) * scale)

        # Make the constants of the slab test.
        margin = MARGIN * larger(larger(abs(o[0]), abs(o[1])), larger(abs(o[2]), reach))
        mirror = np.int32(7)
        for k in range(3):
            way = d[k]
            if abs(way) < TINY:
                way = -TINY if d[k] < ZERO else TINY
            if d[k] < ZERO:
                mirror ^= np.int32(1 << k)
            inverse[k] = ONE / way
            low[k] = flushed(flushed(o[k] + margin) * inverse[k])
            high[k] = flushed(flushed(o[k] - margin) * inverse[k])

        # Visit the root: a ray that meets none of its children is done.
        child = np.int32(0)
        lanes = np.int32(0)
        if visit:
            lanes = lanes_met(root, low, high, inverse, far * SLACK, mirror)
            if lanes == 0:
                dropped[r] = 1
                continue
            order = np.int32(HIGHEST_BIT[lanes])
            child = children[order ^ mirror]
            lanes ^= np.int32(1) << order
        dropped[r] = 0

        # Write the row: slab, shear, distances, then axes, mirror and the place to start from.
        size_x, size_y, size_z = abs(d[0]), abs(d[1]), abs(d[2])
        z = 0 if size_x >= size_y and size_x >= size_z else (1 if size_y >= size_z else 2)
        x = 0 if z == 2 else z + 1
        y = 0 if x == 2 else x + 1
        for k in range(3):
            rays[count, k] = low[k]
            rays[count, 3 + k] = high[k]
            rays[count, 6 + k] = inverse[k]
        rays[count, 9] = o[x]
        rays[count, 10] = o[y]
        rays[count, 11] = o[z]
        rays[count, 12] = flushed(d[x] / d[z])
        rays[count, 13] = flushed(d[y] / d[z])
        rays[count, 14] = ONE / d[z]
        rays[count, 15] = far
        rays[count, 16] = flushed(shorten / scale)
        words[count, 17] = x
        words[count, 18] = y
        words[count, 19] = z
        words[count, 20] = mirror
        words[count, 21] = child ^ EMPTY
        words[count, 22] = lanes
        words[count, 23] = 1 if visit else 0
        at[count] = r
        count += 1
    return count, len(origins)
