"""Morton codes of points and boxes, and the order that a radix sort puts keys in."""

import numpy as np

from striptools.kernels.compiled import inlined, kernel, maker

MOST_BITS = 21
"""Bits an axis: three times as many fit a key."""

DIGIT_BITS = 8
DIGITS = 1 << DIGIT_BITS
PASSES = 64 // DIGIT_BITS


@inlined
def spread_bits(value):
    """The 21 low bits of a uint64, each three places from the next."""
    value = (value | (value << np.uint64(32))) & np.uint64(0x001F00000000FFFF)
    value = (value | (value << np.uint64(16))) & np.uint64(0x001F0000FF0000FF)
    value = (value | (value << np.uint64(8))) & np.uint64(0x100F00F00F00F00F)
    value = (value | (value << np.uint64(4))) & np.uint64(0x10C30C30C30C30C3)
    return (value | (value << np.uint64(2))) & np.uint64(0x1249249249249249)


@inlined
def cell_of(place, low, high, cells):
    """Which of so many cells between low and high a place is in; places outside are in the nearest."""
    if not high > low or not place > low:
        return np.uint64(0)
    cell = (place - low) / (high - low) * cells
    return np.uint64(cell) if cell < cells else np.uint64(cells - 1)


@kernel
def morton_codes(items, low, high, bits=MOST_BITS):
    """Morton codes of points, or of the centres of boxes, in a grid of 2**bits cells an axis.

    Args:
        items: (p, 3) float32 points or (p, 6) float32 boxes, finite.
        low: (3,) low corner of the grid.
        high: (3,) its high corner; an axis without extent has the one cell 0.
        bits: Bits an axis, 1 to 21.

    Returns:
        (p,) uint64: bit 3k+2 is bit k of the cell's x, 3k+1 of y, 3k of z.
    """
    codes = np.empty(items.shape[0], np.uint64)
    cells = np.int64(1) << bits
    boxed = items.shape[1] == 6
    for item in range(items.shape[0]):
        code = np.uint64(0)
        for axis in range(3):
            # Centres in float64: half the sum of two float32, without overflow.
            place = np.float64(items[item, axis])
            if boxed:
                place = (place + np.float64(items[item, 3 + axis])) * 0.5
            cell = cell_of(place, np.float64(low[axis]), np.float64(high[axis]), cells)
            code |= spread_bits(cell) << np.uint64(2 - axis)
        codes[item] = code
    return codes


@maker
def sort_by_digit(keys, order, other_keys, other_order, shift, counts):
    """Move keys and what they stand for to the other arrays, by one digit, keeping the order of equals."""
    # Turn the counts of the digits into first places.
    place = np.int64(0)
    for digit in range(DIGITS):
        count = counts[digit]
        counts[digit] = place
        place += count

    # Put every key in its place.
    for k in range(keys.shape[0]):
        digit = (keys[k] >> shift) & np.uint64(DIGITS - 1)
        at = np.uint64(counts[digit])
        other_keys[at] = keys[k]
        other_order[at] = order[k]
        counts[digit] += 1


@kernel
def radix_order(keys):
    """The order that sorts keys, equal ones by index.

    Digits of 8 bits: with 11, which take fewer passes, the places written to no longer fit the nearest cache
    and the pages known to the processor, and sorting a million keys takes 1.4 to 1.9 times as long.

    Args:
        keys: (p,) uint64, fewer than 2**31.

    Returns:
        (p,) int32.
    """
    count = keys.shape[0]
    order = np.arange(count).astype(np.int32)
    other_order = np.empty(count, np.int32)
    keys = keys.copy()
    other_keys = np.empty(count, np.uint64)

    # Count all digits, and find the bits in which keys differ: the other digits need no pass.
    counts = np.zeros((PASSES, DIGITS), np.int64)
    varying = np.uint64(0)
    for k in range(count):
        key = keys[k]
        varying |= key ^ keys[0]
        for digit in range(PASSES):
            counts[digit, (key >> np.uint64(digit * DIGIT_BITS)) & np.uint64(DIGITS - 1)] += 1

    # Sort digit by digit, the lowest first.
    for digit in range(PASSES):
        shift = np.uint64(digit * DIGIT_BITS)
        if (varying >> shift) & np.uint64(DIGITS - 1) != 0:
            sort_by_digit(keys, order, other_keys, other_order, shift, counts[digit])
            keys, other_keys = other_keys, keys
            order, other_order = other_order, order
    return order
