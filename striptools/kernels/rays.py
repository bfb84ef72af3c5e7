"""Kernel that readies rays for the walk on a CPU: what `trace.walk` prepares, and the visit to the root.

Rays that miss every child of the root end here, and never reach the device. The arithmetic is that of
`trace.walk.prepared_rays`, bit for bit, denormals read and written as zeros.
"""

import numpy as np
from numba import njit

from striptools.kernels.compiled import helper, kernel
from striptools.kernels.wide import BROAD, EMPTY

ROW = 24
"""Words of a ready ray: 17 float32, then 7 int32; see `trace.walk`."""

ONE = np.float32(1)
ZERO = np.float32(0)
LARGEST = np.float32(np.finfo(np.float32).max)
LEAST_NORMAL = np.float32(np.finfo(np.float32).tiny)
FAR_FACTOR = np.float32(1 + 2**-21)
TINY = np.float32(2**-60)
SLACK = np.float32(1 + 2**-20)
HIGHEST_BIT = np.array([max(k.bit_length() - 1, 0) for k in range(2**BROAD)], np.uint8)


@kernel
def flushed(value):
    """Zero for a denormal float32; what is not a number stays so."""
    return ZERO if abs(value) < LEAST_NORMAL else value


@kernel
def smaller(a, b):
    """The smaller of two, b where they do not compare."""
    return a if a < b else b


@kernel
def larger(a, b):
    """The larger of two, b where they do not compare."""
    return a if a > b else b


@helper
def picked(x, y, z, axis):
    """The coordinate along an axis."""
    return x if axis == 0 else (y if axis == 1 else z)


@helper
def steep(way):
    """A direction component, or a tiny one of the same sign for one too small to cross the scene."""
    tiny = -TINY if way < ZERO else TINY
    return tiny if abs(way) < TINY else way


@kernel
def lanes_met(root, lx, ly, lz, hx, hy, hz, ix, iy, iz, limit, mirror):
    """The root's lanes that a ray meets, as bits in the order of visits, the nearest highest."""
    lanes = np.int32(0)
    for lane in range(root.shape[1]):
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
    origins, directions, t_max, which, begin, frame, root, children, visit, rays, words, at, dropped
):
    """Ready rays from `begin` on until the places are full or there are none left.

    Args:
        origins: (r, 3) float32.
        directions: (r, 3) float32.
        t_max: (r,) float32.
        which: (m,) int32, the rays to take; (0,) for all of them.
        begin: The first of them to take.
        frame: `trace.walk.Frame` as float32 and arrays of three: scale, reach, low, unit, margin.
        root: (>= 6, k) float32, k 8 or 16, the boxes of the root's children, counted from low and in units;
            NaN in empty lanes; other rows are not read.
        children: (k,) int32, the root's children.
        visit: Whether to visit the root here; else every valid ray starts at it.
        rays: (k, 24) float32, written, a row for each ray that has something to visit.
        words: The same memory as int32.
        at: (k,) int32, written: which ray each row is.
        dropped: (r,) uint8, written for the rays taken: 0 has a row, 1 missed the root, 2 is no ray.

    Returns:
        The number of rows written, and the first of the rays that was not taken.
    """
    scale, reach, low, unit, margin_unit = frame
    room = len(rays)
    count = 0
    chosen = len(which) > 0
    every = len(which) if chosen else len(origins)
    for place in range(begin, every):
        if count == room:
            return count, place
        r = np.int64(which[place]) if chosen else place

        # Scale the ray by powers of two; refuse what is no ray.
        ox = flushed(flushed(origins[r, 0]) * scale)
        oy = flushed(flushed(origins[r, 1]) * scale)
        oz = flushed(flushed(origins[r, 2]) * scale)
        dx = flushed(directions[r, 0])
        dy = flushed(directions[r, 1])
        dz = flushed(directions[r, 2])
        largest = larger(larger(abs(ox), abs(oy)), abs(oz))
        longest = larger(larger(abs(dx), abs(dy)), abs(dz))
        far = flushed(t_max[r])
        finite = (abs(ox) <= LARGEST) & (abs(oy) <= LARGEST) & (abs(oz) <= LARGEST)
        finite &= (abs(dx) <= LARGEST) & (abs(dy) <= LARGEST) & (abs(dz) <= LARGEST)
        if not (finite & (longest >= LEAST_NORMAL) & (far > ZERO)):
            dropped[r] = 2
            continue
        exponent = min(max(np.float32(longest).view(np.int32) >> 23, 1), 253)
        shorten = np.int32((254 - exponent) << 23).view(np.float32)
        length = np.int32(exponent << 23).view(np.float32)
        dx = flushed(dx * shorten)
        dy = flushed(dy * shorten)
        dz = flushed(dz * shorten)
        far = flushed(flushed(far * length) * scale)

        # Make the constants of the slab test.
        margin = margin_unit * larger(largest, reach)
        octant = np.int32(7)
        octant ^= np.int32(dx < ZERO) | np.int32(dy < ZERO) << 1 | np.int32(dz < ZERO) << 2
        ix, iy, iz = ONE / steep(dx), ONE / steep(dy), ONE / steep(dz)
        lx = flushed(flushed(flushed(ox + margin) - low[0]) * ix)
        ly = flushed(flushed(flushed(oy + margin) - low[1]) * iy)
        lz = flushed(flushed(flushed(oz + margin) - low[2]) * iz)
        hx = flushed(flushed(flushed(ox - margin) - low[0]) * ix)
        hy = flushed(flushed(flushed(oy - margin) - low[1]) * iy)
        hz = flushed(flushed(flushed(oz - margin) - low[2]) * iz)
        ix, iy, iz = flushed(ix * unit[0]), flushed(iy * unit[1]), flushed(iz * unit[2])

        # Visit the root: a ray that meets none of its children is done.
        child = np.int32(0)
        lanes = np.int32(0)
        if visit:
            mirror = octant << 1 | octant & 1 if len(children) == BROAD else octant
            lanes = lanes_met(root, lx, ly, lz, hx, hy, hz, ix, iy, iz, far * SLACK, mirror)
            if lanes == 0:
                dropped[r] = 1
                continue
            order = np.int32(HIGHEST_BIT[lanes])
            child = children[order ^ mirror]
            lanes ^= np.int32(1) << order
        dropped[r] = 0

        # Write the row: slab, shear, distances, then axes, octant and the place to start from.
        z = 0 if (abs(dx) >= abs(dy)) & (abs(dx) >= abs(dz)) else (1 if abs(dy) >= abs(dz) else 2)
        x = 0 if z == 2 else z + 1
        y = 0 if x == 2 else x + 1
        depth = picked(dx, dy, dz, z)
        rays[count, 0] = lx
        rays[count, 1] = ly
        rays[count, 2] = lz
        rays[count, 3] = hx
        rays[count, 4] = hy
        rays[count, 5] = hz
        rays[count, 6] = ix
        rays[count, 7] = iy
        rays[count, 8] = iz
        rays[count, 9] = picked(ox, oy, oz, x)
        rays[count, 10] = picked(ox, oy, oz, y)
        rays[count, 11] = picked(ox, oy, oz, z)
        rays[count, 12] = flushed(picked(dx, dy, dz, x) / depth)
        rays[count, 13] = flushed(picked(dx, dy, dz, y) / depth)
        rays[count, 14] = ONE / depth
        rays[count, 15] = far
        rays[count, 16] = flushed(shorten / scale)
        words[count, 17] = x
        words[count, 18] = y
        words[count, 19] = z
        words[count, 20] = octant
        words[count, 21] = child ^ EMPTY
        words[count, 22] = lanes
        words[count, 23] = 1 if visit else 0
        at[count] = r
        count += 1
    return count, every


@kernel
def add_ways(directions, at, rays, words):
    """Write the directions behind ready rays, scaled, along the axes of their shears: see `trace.walk`.

    Args:
        directions: (r, 3) float32.
        at: (k,) int32, which ray each row is.
        rays: (k, 27) float32; columns 24 to 26 are written.
        words: The same memory as int32.
    """
    for row in range(len(at)):
        r = at[row]
        dx, dy, dz = flushed(directions[r, 0]), flushed(directions[r, 1]), flushed(directions[r, 2])
        longest = larger(larger(abs(dx), abs(dy)), abs(dz))
        exponent = min(max(np.float32(longest).view(np.int32) >> 23, 1), 253)
        shorten = np.int32((254 - exponent) << 23).view(np.float32)
        dx, dy, dz = flushed(dx * shorten), flushed(dy * shorten), flushed(dz * shorten)
        for axis in range(3):
            rays[row, ROW + axis] = picked(dx, dy, dz, words[row, 17 + axis])
