"""Kernel that readies rays for the walk on a CPU: what `trace.walk` prepares, and the visit to the root.

Rays that miss every child of the root end here, and never reach the device. The arithmetic is that of
`trace.walk.prepared_rays`, bit for bit, denormals read and written as zeros.

Rays are readied 64 at a time, in rows of one number each, so that the arithmetic runs over whole registers.
Cost: a third of that of one ray after the other.
"""

import numpy as np
from numba import njit

from striptools.kernels.compiled import fetch, inlined, kernel
from striptools.kernels.wide import BROAD, EMPTY

ROW = 24
"""Words of a ready ray: 17 float32, then 7 int32; see `trace.walk`."""

CHUNK = 64
"""Rays that are readied together."""

SLAB, START, SHEAR, REACH, AXES = 0, 9 * CHUNK, 12 * CHUNK, 15 * CHUNK, 17 * CHUNK
OCTANT, CHILD, LANES, VISITED = 20 * CHUNK, 21 * CHUNK, 22 * CHUNK, 23 * CHUNK
"""Where in a chunk the words of ready rays are, a row of 64 each, in the order of `ReadyRay`."""

WAY, STATE = 24 * CHUNK, 27 * CHUNK
"""Three more rows for directions, as given and then along the axes; and one for what is told as `dropped`."""

ROOM = 28 * CHUNK

ONE = np.float32(1)
ZERO = np.float32(0)
LARGEST = np.float32(np.finfo(np.float32).max)
LEAST_NORMAL = np.float32(np.finfo(np.float32).tiny)
FAR_FACTOR = np.float32(1 + 2**-21)
TINY = np.float32(2**-60)
SLACK = np.float32(1 + 2**-20)


@kernel
def room_of(length):
    """(length,) uint8, not written, where zeros would be written for each call that traces."""
    return np.empty(length, np.uint8)


@inlined
def flushed(value):
    """Zero for a denormal float32; what is not a number stays so."""
    return ZERO if abs(value) < LEAST_NORMAL else value


@inlined
def smaller(a, b):
    """The smaller of two, b where they do not compare."""
    return a if a < b else b


@inlined
def larger(a, b):
    """The larger of two, b where they do not compare."""
    return a if a > b else b


@inlined
def picked(x, y, z, axis):
    """The coordinate along an axis."""
    return x if axis == 0 else (y if axis == 1 else z)


@inlined
def longest_of(x, y, z):
    """The largest of three coordinates, in size."""
    return larger(larger(abs(x), abs(y)), abs(z))


@inlined
def longest_axis(x, y, z):
    """The dominant axis of a direction."""
    return 0 if (abs(x) >= abs(y)) & (abs(x) >= abs(z)) else (1 if abs(y) >= abs(z) else 2)


@inlined
def is_ray(ox, oy, oz, dx, dy, dz, far):
    """Whether a scaled origin, a direction and a reach make a ray."""
    finite = (abs(ox) <= LARGEST) & (abs(oy) <= LARGEST) & (abs(oz) <= LARGEST)
    finite &= (abs(dx) <= LARGEST) & (abs(dy) <= LARGEST) & (abs(dz) <= LARGEST)
    return finite & (longest_of(dx, dy, dz) >= LEAST_NORMAL) & (far > ZERO)


@inlined
def steep(way):
    """A direction component, or a tiny one of the same sign for one too small to cross the scene."""
    tiny = -TINY if way < ZERO else TINY
    return tiny if abs(way) < TINY else way


@inlined
def as_word(number):
    """An int32 as the float32 of the same bits."""
    return np.int32(number).view(np.float32)


@inlined
def bits_of(number):
    """The bits of a float32 as int32."""
    return np.float32(number).view(np.int32)


@inlined
def scaled_by(longest):
    """Powers of two that bring a direction's longest component to 1 to 2, and back."""
    exponent = min(max(bits_of(longest) >> 23, 1), 253)
    return np.int32((254 - exponent) << 23).view(np.float32), np.int32(exponent << 23).view(np.float32)


@inlined
def scaled_ray(room, start, way, far, size, i, scale):
    """Scale a ray of a room by powers of two, its rows `size` apart, denormals read and written as zeros.

    Returns:
        Origin, direction, reach, what gives a t back in the caller's units, and whether it is a ray.
    """
    ox = flushed(flushed(room[start + i]) * scale)
    oy = flushed(flushed(room[start + size + i]) * scale)
    oz = flushed(flushed(room[start + 2 * size + i]) * scale)
    dx, dy, dz = flushed(room[way + i]), flushed(room[way + size + i]), flushed(room[way + 2 * size + i])
    reach = flushed(room[far + i])
    valid = is_ray(ox, oy, oz, dx, dy, dz, reach)
    shorten, length = scaled_by(longest_of(dx, dy, dz))
    dx, dy, dz = flushed(dx * shorten), flushed(dy * shorten), flushed(dz * shorten)
    reach = flushed(flushed(reach * length) * scale)
    return ox, oy, oz, dx, dy, dz, reach, flushed(shorten / scale), valid


@njit(cache=True, nogil=True, error_model="numpy")
def prepare_chunk(room, frame):
    """Prepare a whole chunk: from origins, directions and t_max in their rows to all words but the root's.

    Args:
        room: (1792,) float32; places that hold no ray have a t_max of zero.
        frame: As of `ready_rays`.
    """
    scale, reach, low, unit, margin_unit = frame
    low_x, low_y, low_z = low[0], low[1], low[2]
    unit_x, unit_y, unit_z = unit[0], unit[1], unit[2]
    for i in range(CHUNK):
        ox, oy, oz, dx, dy, dz, far, back, valid = scaled_ray(room, START, WAY, REACH, CHUNK, i, scale)
        room[STATE + i] = as_word(0 if valid else 2)
        room[REACH + i] = far
        room[REACH + CHUNK + i] = back

        # Make the constants of the slab test.
        margin = margin_unit * larger(longest_of(ox, oy, oz), reach)
        octant = np.int32(7)
        octant ^= np.int32(dx < ZERO) | np.int32(dy < ZERO) << 1 | np.int32(dz < ZERO) << 2
        room[OCTANT + i] = as_word(octant)
        ix, iy, iz = ONE / steep(dx), ONE / steep(dy), ONE / steep(dz)
        room[SLAB + i] = flushed(flushed(flushed(ox + margin) - low_x) * ix)
        room[SLAB + CHUNK + i] = flushed(flushed(flushed(oy + margin) - low_y) * iy)
        room[SLAB + 2 * CHUNK + i] = flushed(flushed(flushed(oz + margin) - low_z) * iz)
        room[SLAB + 3 * CHUNK + i] = flushed(flushed(flushed(ox - margin) - low_x) * ix)
        room[SLAB + 4 * CHUNK + i] = flushed(flushed(flushed(oy - margin) - low_y) * iy)
        room[SLAB + 5 * CHUNK + i] = flushed(flushed(flushed(oz - margin) - low_z) * iz)
        room[SLAB + 6 * CHUNK + i] = flushed(ix * unit_x)
        room[SLAB + 7 * CHUNK + i] = flushed(iy * unit_y)
        room[SLAB + 8 * CHUNK + i] = flushed(iz * unit_z)

        # Make the shear.
        z = longest_axis(dx, dy, dz)
        x = 0 if z == 2 else z + 1
        y = 0 if x == 2 else x + 1
        depth = picked(dx, dy, dz, z)
        room[START + i] = picked(ox, oy, oz, x)
        room[START + CHUNK + i] = picked(ox, oy, oz, y)
        room[START + 2 * CHUNK + i] = picked(ox, oy, oz, z)
        room[SHEAR + i] = flushed(picked(dx, dy, dz, x) / depth)
        room[SHEAR + CHUNK + i] = flushed(picked(dx, dy, dz, y) / depth)
        room[SHEAR + 2 * CHUNK + i] = ONE / depth
        room[AXES + i] = as_word(x)
        room[AXES + CHUNK + i] = as_word(y)
        room[AXES + 2 * CHUNK + i] = as_word(z)
        room[WAY + i] = picked(dx, dy, dz, x)
        room[WAY + CHUNK + i] = picked(dx, dy, dz, y)
        room[WAY + 2 * CHUNK + i] = depth


@njit(cache=True, nogil=True, error_model="numpy")
def visit_root(room, root):
    """Write what each ray of a chunk finds at the root: its nearest child's lane, and those left.

    Args:
        room: (1792,) float32, of prepared rays; bits of the lanes left are in the order of visits, nearest
            highest.
        root: (>= 6, k) float32, as of `ready_rays`.
    """
    for i in range(CHUNK):
        room[LANES + i] = as_word(0)
    for lane in range(root.shape[1]):
        x0, y0, z0 = root[0, lane], root[1, lane], root[2, lane]
        x1, y1, z1 = root[3, lane], root[4, lane], root[5, lane]
        if np.isnan(x0):
            continue
        bit = np.int32(1 << lane)
        for i in range(CHUNK):
            ix, iy, iz = room[SLAB + 6 * CHUNK + i], room[SLAB + 7 * CHUNK + i], room[SLAB + 8 * CHUNK + i]
            ax = x0 * ix - room[SLAB + i]
            ay = y0 * iy - room[SLAB + CHUNK + i]
            az = z0 * iz - room[SLAB + 2 * CHUNK + i]
            bx = x1 * ix - room[SLAB + 3 * CHUNK + i]
            by = y1 * iy - room[SLAB + 4 * CHUNK + i]
            bz = z1 * iz - room[SLAB + 5 * CHUNK + i]
            limit = room[REACH + i] * SLACK
            entry = larger(larger(smaller(ax, bx), smaller(ay, by)), larger(smaller(az, bz), ZERO))
            leaving = smaller(larger(ax, bx), smaller(larger(ay, by), larger(az, bz))) * FAR_FACTOR
            met = bit if entry <= smaller(limit, leaving) else np.int32(0)
            room[LANES + i] = as_word(bits_of(room[LANES + i]) | met)

    # A shift by other numbers for each ray would be of 64 bits: lanes are put in order by exchanging them.
    broad = root.shape[1] == BROAD
    for i in range(CHUNK):
        mirror = mirror_of(bits_of(room[OCTANT + i]), broad)
        met = bits_of(room[LANES + i])
        met = exchanged(met, mirror & 1, 1, 0x5555)
        met = exchanged(met, mirror & 2, 2, 0x3333)
        met = exchanged(met, mirror & 4, 4, 0x0F0F)
        met = exchanged(met, mirror & 8, 8, 0x00FF)
        # The highest bit is the exponent of the same number as a float.
        exponent = bits_of(np.float32(np.int32(met))) & 0x7F800000
        room[CHILD + i] = as_word((exponent >> 23) - 127 ^ mirror)
        room[LANES + i] = as_word(met - np.int32(as_word(exponent)))
        state = bits_of(room[STATE + i])
        room[STATE + i] = as_word(1 if (state == 0) & (met == 0) else state)
        room[VISITED + i] = as_word(1)


@inlined
def exchanged(bits, swap, distance, low):
    """Bits, those at `low` places exchanged with those at a distance above them where `swap` is not zero."""
    return (bits & low) << distance | bits >> distance & low if swap else bits


@inlined
def mirror_of(octant, broad):
    """As `trace.walk.mirror_of`, which a kernel cannot call."""
    return octant << 1 | octant & 1 if broad else octant


@inlined
def ray_at(which, place):
    """The ray at a place, of all of them or of those that are said: uint64, so that no end is looked for."""
    return np.uint64(which[np.uint64(place)]) if len(which) > 0 else np.uint64(place)


@inlined
def take_rays(origins, directions, t_max, which, begin, held, room, start, way, far, size):
    """Gather `held` rays into a room of `size`, rows as far apart; what is behind reaches nothing."""
    # Of rays here and there the next are fetched while these are made ready.
    end = begin + held
    if end < len(which) and which[end] != which[end - 1] + 1:
        for i in range(end, min(end + size, len(which))):
            fetch(origins, 3 * which[i])
            fetch(directions, 3 * which[i])
            fetch(t_max, which[i])
    for i in range(size):
        r = ray_at(which, begin + min(i, held - 1))
        for axis in range(3):
            room[start + axis * size + i] = origins[r, axis]
            room[way + axis * size + i] = directions[r, axis]
        room[far + i] = t_max[r] if i < held else ZERO


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
        rays: (k, 24) float32, written, a row for each ray that has something to visit; (k, 27) where a
            triangle test asks for the direction along the axes, which then follows.
        words: The same memory as int32.
        at: (k,) int32, written: which ray each row is.
        dropped: (r,) uint8, written for the rays taken: 0 has a row, 1 missed the root, 2 is no ray.

    Returns:
        The number of rows written, and the first of the rays that was not taken.
    """
    room = np.zeros(ROOM, np.float32)
    live = np.zeros(CHUNK, np.int64)
    every = len(which) if len(which) > 0 else len(origins)
    count, place = 0, begin
    while place < every and count < len(rays):
        held = min(CHUNK, every - place, len(rays) - count)
        take_rays(origins, directions, t_max, which, place, held, room, START, WAY, REACH, CHUNK)
        prepare_chunk(room, frame)
        if visit:
            visit_root(room, root)
        else:
            room[CHILD : CHILD + 3 * CHUNK] = ZERO

        # Tell what becomes of each, without a branch: that goes either way.
        alive = 0
        for i in range(held):
            state = bits_of(room[STATE + i])
            dropped[ray_at(which, place + i)] = state
            live[alive] = i
            alive += 1 if state == 0 else 0

        # Write those that have something to visit.
        for k in range(alive):
            i, row = live[k], np.uint64(count + k)
            at[row] = ray_at(which, place + i)
            for word in range(ROW):
                rays[row, word] = room[np.uint64(word * CHUNK + i)]
            child = children[bits_of(room[CHILD + i])] if visit else np.int32(0)
            words[row, CHILD // CHUNK] = child ^ EMPTY
            for word in range(ROW, rays.shape[1]):
                rays[row, word] = room[np.uint64(word * CHUNK + i)]
        count += alive
        place += held
    return count, place
