"""Kernels that tell whether rays come as a picture does, row by row, and take them tile by tile.

A packet of 8 by 4 pixels meets fewer leaves than one of 32 by 1, and more of its rays meet each.
"""

import numpy as np

from striptools.kernels.compiled import inlined, kernel

COLUMNS = 8
"""Of a tile; times `ROWS` they make the 32 rays of a packet."""

ROWS = 4

LEAST_WIDTH = 16
MOST_WIDTH = 2**16
"""Rays of a row."""

LEAP = np.float32(8)
"""From a row to the next, rays leap by more than so many times the longest step within it."""

STRAIGHT = np.float32(1 / 3)
"""How far a row's last ray is from its first, at least, of the length of all its steps."""

CHECKED = 8
"""Rows that are looked at, spread over the picture: order changes no hit, so a few do."""


@inlined
def way_between(origins, directions, a, b):
    """How far one ray is from another."""
    way = np.float32(0)
    for axis in range(3):
        way += abs(origins[a, axis] - origins[b, axis]) + abs(directions[a, axis] - directions[b, axis])
    return way


@inlined
def is_row(origins, directions, begin, end):
    """Whether rays go straight on, one after the other, and then leap."""
    longest, length = np.float32(0), np.float32(0)
    for k in range(begin + 1, end):
        step = way_between(origins, directions, k, k - 1)
        longest = max(longest, step)
        length += step
    straight = way_between(origins, directions, begin, end - 1) > STRAIGHT * length
    return straight and way_between(origins, directions, end, end - 1) > LEAP / 2 * longest


@kernel
def row_width(origins, directions):
    """How many rays a row of a picture has, or 0 where rays do not come as one.

    Along a row rays go straight on by small steps, and from its end they leap to where the next one begins.

    Args:
        origins: (r, 3) float32.
        directions: (r, 3) float32.
    """
    count = len(origins)
    longest = np.float32(0)
    width = 1
    while width < count:
        step = way_between(origins, directions, width, width - 1)
        if width >= LEAST_WIDTH and step > LEAP * longest:
            break
        longest = max(longest, step)
        width += 1
        if width > MOST_WIDTH:
            return 0
    rows = count // width
    if count != rows * width or rows < ROWS:
        return 0
    checked = min(CHECKED, rows - 1)
    for j in range(checked):
        begin = j * (rows - 1) // checked * width
        if not is_row(origins, directions, begin, begin + width):
            return 0
    return width


@kernel
def tile_order(count, width):
    """The rays of a picture in the order of its tiles, which are smaller at its right and lower sides.

    Args:
        count: A multiple of the width.
        width: Rays of a row.

    Returns:
        (count,) int32.
    """
    order = np.empty(count, np.int32)
    place = 0
    height = count // width
    for top in range(0, height, ROWS):
        for left in range(0, width, COLUMNS):
            for row in range(top, min(top + ROWS, height)):
                for column in range(left, min(left + COLUMNS, width)):
                    order[place] = row * width + column
                    place += 1
    return order
