"""Kernels that sort rays by where they start and which way they go.

Source: Aila & Karras, "Architecture Considerations for Tracing Incoherent Rays" (HPG 2010), section 4.4, who
sort rays by Morton codes of origin and direction; here the direction's octant does, which is the order of
visits.

Cost: linear; two passes of a radix sort, 12 bytes a ray while it runs.
"""

import numpy as np

from striptools.kernels.compiled import helper, inlined, kernel
from striptools.kernels.morton import spread_bits
from striptools.kernels.rays import ray_at

BITS = 5
"""Bits of a cell along each axis."""

CELLS = np.float32(2**BITS)

DIGIT = 9
DIGITS = 2**DIGIT
"""Values of half a key: three times `BITS` bits of the cell, then three of the octant."""

LOOKED = 512
"""Pairs of rays."""

RAY = 32
"""Bits of a ray's number, which lies below its key."""

ZERO = np.float32(0)


@inlined
def cell_at(place, low, finer):
    """The number of a cell along an axis, the nearest to a place outside; 0 for what is not a number."""
    cell = (place - low) * finer
    return np.uint64(min(cell, CELLS - np.float32(1)) if cell > ZERO else ZERO)


@kernel
def start_apart(origins, which, finer):
    """Whether of rays one after the other most start more than a cell apart, by a few that are looked at.

    Args:
        origins: (r, 3) float32.
        which: As of `sort_rays`, and so is what follows.
        finer: Cells in a unit of length.
    """
    pairs = (len(which) if len(which) > 0 else len(origins)) - 1
    looked = max(0, min(LOOKED, pairs))
    apart = 0
    for j in range(looked):
        k = j * pairs // looked
        a, b = ray_at(which, k), ray_at(which, k + 1)
        way = ZERO
        for axis in range(3):
            way = max(way, abs(origins[a, axis] - origins[b, axis]))
        apart += way * finer > np.float32(1)
    return 2 * apart > looked


@helper
def count_keys(origins, directions, which, begin, low, finer, keys, ends):
    """Write keys and numbers of rays, and count how often each half of a key has each value."""
    for k in range(len(keys)):
        r = np.int64(ray_at(which, begin + k))
        cell = np.uint64(0)
        for axis in range(3):
            cell |= spread_bits(cell_at(origins[r, axis], low[axis], finer)) << np.uint64(axis)
        octant = np.int32(directions[r, 0] < ZERO)
        octant |= np.int32(directions[r, 1] < ZERO) << 1 | np.int32(directions[r, 2] < ZERO) << 2
        key = np.int64(cell) << 3 | octant
        keys[k] = key << RAY | r
        ends[0, key & (DIGITS - 1)] += 1
        ends[1, key >> DIGIT] += 1


@kernel
def sort_rays(origins, directions, which, begin, end, low, finer):
    """The rays at places `begin:end`, sorted by cell, these along a Morton curve, and then by octant.

    Args:
        origins: (r, 3) float32.
        directions: (r, 3) float32.
        which: (m,) int32, the rays there are; (0,) for all of them.
        begin: The first place.
        end: Where they end.
        low: (3,) float32, where the cells begin.
        finer: float32, cells in a unit of length.

    Returns:
        (end - begin,) int32; rays of one key stay in their order.
    """
    keys = np.empty(end - begin, np.int64)
    by_low = np.empty(end - begin, np.int64)
    order = np.empty(end - begin, np.int32)
    ends = np.zeros((2, DIGITS), np.int64)
    count_keys(origins, directions, which, begin, low, finer, keys, ends)
    for half in range(2):
        place = 0
        for digit in range(DIGITS):
            place, ends[half, digit] = place + ends[half, digit], place
    for entry in keys:
        digit = entry >> RAY & (DIGITS - 1)
        by_low[ends[0, digit]] = entry
        ends[0, digit] += 1
    for entry in by_low:
        digit = entry >> RAY + DIGIT
        order[ends[1, digit]] = entry & (2**RAY - 1)
        ends[1, digit] += 1
    return order
