"""Kernel that finds rays that go the same way and readies them as packets; see `trace.walk_packets`.

Source: the frustum of a packet is that of Reshetov, Soupikov & Hurley, "Multi-Level Ray Tracing Algorithm",
SIGGRAPH 2005; here slopes along the rays' dominant axis bound it, so that no direction component divides.
"""

import numpy as np
from numba import njit

from striptools.kernels.compiled import inlined
from striptools.kernels.rays import LARGEST, LEAST_NORMAL, ONE, ZERO, flushed, larger, picked

PACKET = 32
"""Rays of a packet: the lanes of four AVX registers."""

HEAD = 16
"""Words at the head of a packet: 12 float32, then 4 int32; eight rows of 32 float32 follow, a lane a ray."""

ROW = HEAD + 8 * PACKET
"""Words of a packet."""

WIDER = np.float32(2.0**-21)
"""How much slopes are moved outward: they were rounded, and products with them are."""

FAR = np.float32(3.0e38)


@inlined
def is_ray(ox, oy, oz, dx, dy, dz, far):
    """Whether a scaled origin, a direction and a reach make a ray."""
    finite = (abs(ox) <= LARGEST) & (abs(oy) <= LARGEST) & (abs(oz) <= LARGEST)
    finite &= (abs(dx) <= LARGEST) & (abs(dy) <= LARGEST) & (abs(dz) <= LARGEST)
    return finite & (larger(larger(abs(dx), abs(dy)), abs(dz)) >= LEAST_NORMAL) & (far > ZERO)


@inlined
def longest_axis(dx, dy, dz):
    """The dominant axis of a direction."""
    return 0 if (abs(dx) >= abs(dy)) & (abs(dx) >= abs(dz)) else (1 if abs(dy) >= abs(dz) else 2)


@njit(cache=True, nogil=True, error_model="numpy")
def ready_packets(
    origins, directions, t_max, begin, seen, root, density, packets, words, at, single, dropped
):
    """Ready packets from ray `begin` on, 32 rays in a row each, until places are full or there are none left.

    Args:
        origins: (r, 3) float32.
        directions: (r, 3) float32.
        t_max: (r,) float32.
        begin: The first ray to take.
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
        The packets written, the rays that go on their own, and the first ray not taken.
    """
    scale, reach, margin_unit = seen
    room, count, alone = len(packets), 0, 0
    start = np.zeros((3, PACKET), np.float32)
    slope = np.zeros((3, PACKET), np.float32)
    rest = np.zeros((3, PACKET), np.float32)
    lane_of = np.zeros(PACKET, np.int32)
    r = begin
    while r < len(origins):
        if count == room or alone + PACKET > len(single):
            return count, alone, r
        end = min(r + PACKET, len(origins))

        # Take the axis and the side of the middle ray for that of all.
        middle = (r + end) >> 1
        mx = flushed(directions[middle, 0])
        my = flushed(directions[middle, 1])
        mz = flushed(directions[middle, 2])
        z = longest_axis(mx, my, mz)
        x = 0 if z == 2 else z + 1
        y = 0 if x == 2 else x + 1
        away = picked(mx, my, mz, z) < ZERO

        # Scale rays by powers of two; refuse what is no ray; stop at one that goes another way.
        live, same, largest = 0, True, reach
        for k in range(r, end):
            ox = flushed(flushed(origins[k, 0]) * scale)
            oy = flushed(flushed(origins[k, 1]) * scale)
            oz = flushed(flushed(origins[k, 2]) * scale)
            dx, dy, dz = flushed(directions[k, 0]), flushed(directions[k, 1]), flushed(directions[k, 2])
            far = flushed(t_max[k])
            if not is_ray(ox, oy, oz, dx, dy, dz, far):
                dropped[k] = 2
                continue
            dropped[k] = 0
            longest = np.float32(larger(larger(abs(dx), abs(dy)), abs(dz)))
            exponent = min(max(longest.view(np.int32) >> 23, 1), 253)
            shorten = np.int32((254 - exponent) << 23).view(np.float32)
            length = np.int32(exponent << 23).view(np.float32)
            dx, dy, dz = flushed(dx * shorten), flushed(dy * shorten), flushed(dz * shorten)
            depth = picked(dx, dy, dz, z)
            if (longest_axis(dx, dy, dz) != z) | ((depth < ZERO) != away):
                same = False
                break
            start[0, live] = picked(ox, oy, oz, x)
            start[1, live] = picked(ox, oy, oz, y)
            start[2, live] = picked(ox, oy, oz, z)
            slope[0, live] = flushed(picked(dx, dy, dz, x) / depth)
            slope[1, live] = flushed(picked(dx, dy, dz, y) / depth)
            slope[2, live] = ONE / depth
            rest[0, live] = flushed(flushed(far * length) * scale)
            rest[1, live] = flushed(shorten / scale)
            rest[2, live] = abs(depth)
            largest = larger(largest, larger(larger(abs(ox), abs(oy)), abs(oz)))
            lane_of[live] = k
            live += 1

        # Bound origins and slopes; along the axis all is counted the way the rays go.
        s0, s1, u0, u1 = FAR, -FAR, FAR, -FAR
        x0, x1, y0, y1, z0, z1 = FAR, -FAR, FAR, -FAR, FAR, -FAR
        deepest = ZERO
        for k in range(live):
            s0, s1 = min(s0, slope[0, k]), max(s1, slope[0, k])
            u0, u1 = min(u0, slope[1, k]), max(u1, slope[1, k])
            x0, x1 = min(x0, start[0, k]), max(x1, start[0, k])
            y0, y1 = min(y0, start[1, k]), max(y1, start[1, k])
            z0, z1 = min(z0, start[2, k]), max(z1, start[2, k])
            deepest = max(deepest, rest[2, k])
        if away:
            s0, s1, u0, u1, z0, z1 = -s1, -s0, -u1, -u0, -z1, -z0
        low = -root[z + 3] if away else root[z]
        high = -root[z] if away else root[z + 3]

        # Leave rays alone that spread over too much of the scene.
        reached = max(high - z0, ZERO)
        wide = (x1 - x0) + (s1 - s0) * reached
        tall = (y1 - y0) + (u1 - u0) * reached
        across = (root[x + 3] - root[x]) + (root[y + 3] - root[y])
        together = same & (2 * live > end - r) & (wide * tall <= density * across * across)
        if not together and (live > 0 or not same):
            for k in range(r, end):
                single[alone] = k
                alone += 1
            r = end
            continue
        r = end
        if live == 0:
            continue

        # Drop the packet if it misses the scene's box.
        margin = margin_unit * largest
        s0, s1, u0, u1 = s0 - WIDER, s1 + WIDER, u0 - WIDER, u1 + WIDER
        x0, x1, y0, y1, z0, z1 = x0 - margin, x1 + margin, y0 - margin, y1 + margin, z0 - margin, z1 + margin
        entry = max(low - z1, ZERO)
        leave = high - z0
        meets = (leave >= ZERO) & (x0 + s0 * (entry if s0 >= ZERO else leave) <= root[x + 3])
        meets &= x1 + s1 * (leave if s1 >= ZERO else entry) >= root[x]
        meets &= y0 + u0 * (entry if u0 >= ZERO else leave) <= root[y + 3]
        meets &= y1 + u1 * (leave if u1 >= ZERO else entry) >= root[y]
        if not meets:
            for k in range(live):
                dropped[lane_of[k]] = 1
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

        # Write the rays; lanes that have none repeat the first, with nothing to reach.
        for k in range(PACKET):
            used = k < live
            j = k if used else 0
            at[count, k] = lane_of[j] if used else -1
            for axis in range(3):
                row[HEAD + axis * PACKET + k] = start[axis, j]
                row[HEAD + (3 + axis) * PACKET + k] = slope[axis, j]
            row[HEAD + 6 * PACKET + k] = rest[0, j] if used else -ONE
            row[HEAD + 7 * PACKET + k] = rest[1, j]
        count += 1
    return count, alone, len(origins)
