"""Kernel that finds rays that go the same way and readies them as packets; see `trace.walk_packets`.

Source: the frustum of a packet is that of Reshetov, Soupikov & Hurley, "Multi-Level Ray Tracing Algorithm",
SIGGRAPH 2005; here slopes along the rays' dominant axis bound it, so that no direction component divides.

The rays of a packet are readied together, in rows of one number each, so that the arithmetic runs over whole
registers.
"""

import numpy as np
from numba import njit

from striptools.kernels.compiled import inlined, kernel
from striptools.kernels.rays import (
    LEAST_NORMAL,
    ONE,
    ZERO,
    flushed,
    larger,
    longest_axis,
    longest_of,
    picked,
    ray_at,
    scaled_ray,
    smaller,
    take_rays,
)

PACKET = 32
"""Rays of a packet: the lanes of four AVX registers."""

HEAD = 16
"""Words at the head of a packet: 12 float32, then 4 int32; eight rows of 32 float32 follow, a lane a ray."""

ROW = HEAD + 8 * PACKET
"""Words of a packet."""

START, SLOPE, REACH, BACK = 0, 3 * PACKET, 6 * PACKET, 7 * PACKET
"""Where in a room are the rows that a packet has: see `walk_packets`."""

DEPTH, LARGEST_OF, VALID, SAME = 8 * PACKET, 9 * PACKET, 10 * PACKET, 11 * PACKET
"""Size of the direction along the dominant axis, the origin's largest coordinate, whether there is a ray,
and whether it goes the way of the packet."""

ORIGIN, WAY, FAR_OF = 12 * PACKET, 15 * PACKET, 18 * PACKET
"""Rays as they were given."""

FOLD = 19 * PACKET
ROOM = 20 * PACKET

LOOKED = 256
"""Packets that are looked at, whether it is worth while to make any."""

WIDER = np.float32(2.0**-21)
"""How much slopes are moved outward: they were rounded, and products with them are."""

FAR = np.float32(3.0e38)


@njit(cache=True, nogil=True, error_model="numpy")
def prepare(room, scale, x, y, z, away):
    """Fill all other rows of a room, for rays whose dominant axis and side are said."""
    for k in range(PACKET):
        # Scale the ray; mark what is no ray, or goes another way.
        ox, oy, oz, dx, dy, dz, far, back, valid = scaled_ray(room, ORIGIN, WAY, FAR_OF, PACKET, k, scale)
        room[VALID + k] = ONE if valid else ZERO
        depth = picked(dx, dy, dz, z)
        same = (longest_axis(dx, dy, dz) == z) & ((depth < ZERO) == away)
        room[SAME + k] = ONE if same else ZERO
        room[START + k] = picked(ox, oy, oz, x)
        room[START + PACKET + k] = picked(ox, oy, oz, y)
        room[START + 2 * PACKET + k] = picked(ox, oy, oz, z)
        room[SLOPE + k] = flushed(picked(dx, dy, dz, x) / depth)
        room[SLOPE + PACKET + k] = flushed(picked(dx, dy, dz, y) / depth)
        room[SLOPE + 2 * PACKET + k] = ONE / depth
        room[REACH + k] = far
        room[BACK + k] = back
        room[DEPTH + k] = abs(depth)
        room[LARGEST_OF + k] = longest_of(ox, oy, oz)


@inlined
def gather_live(room, lane_of):
    """Move the rays of a room to its front, and repeat the first behind them, with nothing to reach.

    Returns:
        How many rays there are; and whether all go the way of the packet.
    """
    full, along = np.int32(0), np.int32(0)
    for k in range(PACKET):
        full += np.int32(room[VALID + k] != ZERO)
        along += np.int32(room[SAME + k] != ZERO)
        lane_of[k] = k
    if full == PACKET:
        return PACKET, along == PACKET
    live, same = 0, True
    for k in range(PACKET):
        if room[VALID + k] != ZERO:
            same &= room[SAME + k] != ZERO
            for row in range(10):
                room[row * PACKET + live] = room[row * PACKET + k]
            lane_of[live] = k
            live += 1
    for k in range(live, PACKET):
        for row in range(10):
            room[row * PACKET + k] = room[row * PACKET]
        room[REACH + k] = -ONE
    return live, same


@inlined
def folded(room, row, join):
    """The numbers of a row joined pairwise, which are `smaller` or `larger`."""
    for k in range(16):
        room[FOLD + k] = join(room[row + k], room[row + 16 + k])
    for k in range(8):
        room[FOLD + k] = join(room[FOLD + k], room[FOLD + 8 + k])
    for k in range(4):
        room[FOLD + k] = join(room[FOLD + k], room[FOLD + 4 + k])
    return join(join(room[FOLD], room[FOLD + 1]), join(room[FOLD + 2], room[FOLD + 3]))


@inlined
def way_of(directions, r):
    """The dominant axis of a ray's direction and its side, as one number; -1 where it has none."""
    dx, dy, dz = flushed(directions[r, 0]), flushed(directions[r, 1]), flushed(directions[r, 2])
    if not (longest_of(dx, dy, dz) >= LEAST_NORMAL):
        return -1
    z = longest_axis(dx, dy, dz)
    return 2 * z + (1 if picked(dx, dy, dz, z) < ZERO else 0)


@inlined
def part_ways(directions, which, begin, end):
    """Whether a few of the rays show that they do not all go the same way."""
    way = way_of(directions, ray_at(which, (begin + end) >> 1))
    apart = False
    for k in (begin, (3 * begin + end) >> 2, (begin + 3 * end) >> 2, end - 1):
        other = way_of(directions, ray_at(which, k))
        apart |= (way >= 0) & (other >= 0) & (other != way)
    return apart


@kernel
def go_together(directions, which):
    """Whether a quarter or more of 32 rays in a row go the same way, by some that are looked at.

    Args:
        directions: (r, 3) float32.
        which: As of `ready_packets`.
    """
    every = len(which) if len(which) > 0 else len(directions)
    packets = (every + PACKET - 1) // PACKET
    looked, together = min(packets, LOOKED), 0
    for k in range(looked):
        begin = k * packets // looked * PACKET
        together += not part_ways(directions, which, begin, min(begin + PACKET, every))
    return 4 * together >= looked


@inlined
def send_alone(which, begin, end, single, alone):
    """Write rays down as going on their own; return how many do."""
    for k in range(begin, end):
        single[alone + k - begin] = ray_at(which, k)
    return alone + end - begin


@njit(cache=True, nogil=True, error_model="numpy")
def ready_packets(
    origins, directions, t_max, which, begin, seen, root, density, packets, words, at, single, dropped
):
    """Ready packets of 32 rays in a row, from the `begin`th on, until places are full or none are left.

    Args:
        origins: (r, 3) float32.
        directions: (r, 3) float32.
        t_max: (r,) float32.
        which: (m,) int32, the rays to take, in this order; (0,) for all of them as they come.
        begin: The first of them to take.
        seen: Scale, reach, and the margin of a box: float32.
        root: (6,) float32, the scaled box of the scene.
        density: Packets that may meet more triangles than this share of the scene's silhouette are left to
            the walk of single rays; float32, a part of the area.
        packets: (k, 272) float32, written, a row for each packet.
        words: The same memory as int32.
        at: (k, 32) int32, written: which ray each lane is; -1 for none.
        single: (m,) int32, written: the rays that go on their own; m >= 32 places more than are full.
        dropped: (r,) uint8, written for the rays of packets: 0 has a row, 1 missed the scene, 2 is no ray.

    Returns:
        The packets written, the rays that go on their own, and the first of the rays that was not taken.
    """
    scale, reach, margin_unit = seen
    count, alone = 0, 0
    room = np.zeros(ROOM, np.float32)
    lane_of = np.zeros(PACKET, np.int32)
    every = len(which) if len(which) > 0 else len(origins)
    place = begin
    while place < every:
        if count == len(packets) or alone + PACKET > len(single):
            return count, alone, place
        begin, end = place, min(place + PACKET, every)
        place = end
        if part_ways(directions, which, begin, end):
            alone = send_alone(which, begin, end, single, alone)
            continue

        # Take the axis and the side of the middle ray for that of all.
        middle = ray_at(which, (begin + end) >> 1)
        mx = flushed(directions[middle, 0])
        my = flushed(directions[middle, 1])
        mz = flushed(directions[middle, 2])
        z = longest_axis(mx, my, mz)
        x = 0 if z == 2 else z + 1
        y = 0 if x == 2 else x + 1
        away = picked(mx, my, mz, z) < ZERO
        take_rays(origins, directions, t_max, which, begin, end - begin, room, ORIGIN, WAY, FAR_OF, PACKET)
        prepare(room, scale, x, y, z, away)
        live, same = gather_live(room, lane_of)
        if not same:
            alone = send_alone(which, begin, end, single, alone)
            continue
        if live < end - begin:
            for k in range(begin, end):
                dropped[ray_at(which, k)] = 2
        for k in range(live):
            dropped[ray_at(which, begin + lane_of[np.uint64(k)])] = 0
        if live == 0:
            continue

        # Bound origins and slopes; along the axis all is counted the way the rays go.
        s0, s1 = folded(room, SLOPE, smaller), folded(room, SLOPE, larger)
        u0, u1 = folded(room, SLOPE + PACKET, smaller), folded(room, SLOPE + PACKET, larger)
        x0, x1 = folded(room, START, smaller), folded(room, START, larger)
        y0, y1 = folded(room, START + PACKET, smaller), folded(room, START + PACKET, larger)
        z0, z1 = folded(room, START + 2 * PACKET, smaller), folded(room, START + 2 * PACKET, larger)
        deepest, largest = folded(room, DEPTH, larger), larger(reach, folded(room, LARGEST_OF, larger))
        if away:
            s0, s1, u0, u1, z0, z1 = -s1, -s0, -u1, -u0, -z1, -z0
        low = -root[z + 3] if away else root[z]
        high = -root[z] if away else root[z + 3]

        # Leave rays alone that spread over too much of the scene.
        reached = larger(high - z0, ZERO)
        wide = (x1 - x0) + (s1 - s0) * reached
        tall = (y1 - y0) + (u1 - u0) * reached
        across = (root[x + 3] - root[x]) + (root[y + 3] - root[y])
        if not ((2 * live > end - begin) & (wide * tall <= density * across * across)):
            alone = send_alone(which, begin, end, single, alone)
            continue

        # Drop the packet if it misses the scene's box.
        margin = margin_unit * largest
        s0, s1, u0, u1 = s0 - WIDER, s1 + WIDER, u0 - WIDER, u1 + WIDER
        x0, x1, y0, y1, z0, z1 = x0 - margin, x1 + margin, y0 - margin, y1 + margin, z0 - margin, z1 + margin
        entry = larger(low - z1, ZERO)
        leave = high - z0
        meets = (leave >= ZERO) & (x0 + s0 * (entry if s0 >= ZERO else leave) <= root[x + 3])
        meets &= x1 + s1 * (leave if s1 >= ZERO else entry) >= root[x]
        meets &= y0 + u0 * (entry if u0 >= ZERO else leave) <= root[y + 3]
        meets &= y1 + u1 * (leave if u1 >= ZERO else entry) >= root[y]
        if not meets:
            for k in range(live):
                dropped[ray_at(which, begin + lane_of[k])] = 1
            continue

        # Write the head: bounds, depth and margin, then axes and the order of visits.
        row = packets[count]
        row[0], row[1], row[2], row[3] = s0, s1, u0, u1
        row[4], row[5], row[6], row[7] = x0, x1, y0, y1
        row[8], row[9], row[10], row[11] = z1, z0, deepest, margin
        octant = np.int32(7) ^ (np.int32(mx < ZERO) | np.int32(my < ZERO) << 1 | np.int32(mz < ZERO) << 2)
        words[count, 12] = x
        words[count, 13] = y
        words[count, 14] = z | (4 if away else 0)
        words[count, 15] = octant

        # Write the rays.
        rays_of = at[count]
        for k in range(PACKET):
            rays_of[k] = np.int32(ray_at(which, begin + lane_of[k])) if k < live else np.int32(-1)
        for k in range(8 * PACKET):
            row[HEAD + k] = room[k]
        count += 1
    return count, alone, every
