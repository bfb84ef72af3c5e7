"""Block data as an archive holds them (SPEC.md, 6.2): the loops that take blocks apart and put them together.

Both loops walk the strips in the same way and keep the same tables, so that what one guesses the other does.
Numbers are the integers u of section 4.3, in the block's own units.
"""

from math import ldexp

import numpy as np

from striptools.kernels.blocks import (
    NEGATIVE_ZERO,
    axis_of,
    block_bits,
    block_counts,
    multiple_of,
    ordered,
    put,
    split_bits,
    take,
)
from striptools.kernels.compiled import inlined, kernel

SOUND = 0
UNSOUND = 1

NEW = 0
BEFORE = 1
AFTER = 2
STEP = 3
"""How a strip names a vertex."""

NO_VALUE = 0x7FC00000
"""What stands for the coordinate of a vertex that has none; nothing can refer to it."""

NONE = 256
"""The row of a block's numbers that stays zero: what its first vertex is guessed from."""


@inlined
def open_edges(after, before, a, b, c):
    """Note the edges of a triangle, but those that close an edge that ran the other way."""
    if after[b] != a:
        after[a] = b
        before[b] = a
    if after[c] != b:
        after[b] = c
        before[c] = b
    if after[a] != c:
        after[c] = a
        before[a] = c


@inlined
def guess(numbers, axis, a, b, o, every):
    """The number opposite to vertex o in the parallelogram over the edge of a and b, in a width's bits."""
    return numbers[a, axis] + numbers[b, axis] - numbers[o, axis] & every


@inlined
def folded(difference, every):
    """A difference in a width's bits as twice its size, less one where it is negative."""
    return difference << 1 if difference <= every >> 1 else (every - difference << 1) + 1


@inlined
def unfolded(number, every):
    """The difference that a number stands for."""
    return every - (number >> 1) if number & 1 else number >> 1


@inlined
def take_axes(headers, block, modes, widths, every, anchors, exponents, scales):
    """Read how the axes of a block are written: (3,) each, `every` the largest number."""
    for axis in range(3):
        mode, width, anchor, exponent = axis_of(headers, block, axis)
        modes[axis] = mode
        widths[axis] = width
        every[axis] = (1 << width) - 1
        anchors[axis] = anchor
        exponents[axis] = exponent
        scales[axis] = ldexp(1.0, exponent)


@kernel
def find(bits, row, firsts, count, table):
    """The place among the distinct vertices of one of equal bits, which is added where there is none.

    Args:
        bits: (q, 3) uint32.
        row: The vertex.
        firsts: (q,) int32, a row of each distinct vertex.
        count: How many of those there are.
        table: (2^i,) int32 with room to spare, -1 in free slots.
    """
    x, y, z = np.int64(bits[row, 0]), np.int64(bits[row, 1]), np.int64(bits[row, 2])
    slot = (x * 0x9E3779B1 ^ y * 0x85EBCA77 ^ z * 0xC2B2AE3D) & 0xFFFFFFFFFFFF
    slot = (slot ^ slot >> 23) & table.shape[0] - 1
    while table[slot] >= 0:
        other = firsts[table[slot]]
        if bits[other, 0] == x and bits[other, 1] == y and bits[other, 2] == z:
            return np.int64(table[slot])
        slot = slot + 1 & table.shape[0] - 1
    table[slot] = count
    firsts[count] = row
    return count


@kernel
def pack(headers, words, bits, vertex_starts, vertices, turns, starts, table, ways, known, steps, back, rest):
    """Take the blocks apart.

    Args:
        headers: (b, 8) uint32, sound.
        words: (w,) uint32, sound.
        bits: (q, 3) uint32, the bits of the positions of all block vertices.
        vertex_starts: (b+1,) int32, the first vertex of each block.
        vertices: (n + 2s,) int32 strip vertices, rows of bits.
        turns: (n,) bool.
        starts: (s+1,) int32 in triangles.
        table: (2^i,) int32, all -1, more than q.
        ways: (n + 2s,) uint8 to fill with how each strip vertex is named.
        known: (q,) bool, all False, to fill with whether a vertex stands in an earlier block.
        steps: (n + 2s,) uint8 to fill with how far a vertex named by its step is behind the newest.
        back: (q,) uint32 to fill with the folded differences between the places of known vertices.
        rest: (3, q) uint32 to fill with the folded differences between numbers and guesses.

    Returns:
        How many there are of steps, of known vertices, and of the others.
    """
    after = np.empty(256, np.int64)
    before = np.empty(256, np.int64)
    widths = np.empty(3, np.int64)
    numbers = np.zeros((257, 3), np.int64)
    firsts = np.empty(bits.shape[0], np.int32)
    step_count = known_count = distinct = strip = 0
    last_place = 0
    a = b = c = 0
    for block in range(headers.shape[0]):
        # Read the numbers of the vertices.
        base = np.int64(vertex_starts[block])
        connectivity, _ = block_bits(headers, block)
        bit = (np.int64(headers[block, 1]) << 5) + connectivity
        for axis in range(3):
            widths[axis] = axis_of(headers, block, axis)[1]
        for k in range(np.int64(vertex_starts[block + 1]) - base):
            for axis in range(3):
                numbers[k, axis] = take(words, bit, widths[axis])
                bit += widths[axis]
        # Forget the edges of the block before.
        after[:] = -1
        before[:] = -1
        largest = -1
        begin = np.int64(headers[block, 0])
        for t in range(begin, begin + block_counts(headers, block)[0]):
            # Enter the triangle over an edge of the one before it, or begin a strip.
            corner = 2
            if starts[strip] == t:
                strip += 1
                corner = 0
            elif turns[t]:
                a, b, c = a, c, b
            else:
                a, b, c = c, b, a
            o = c
            place = t + 2 * (strip - 1)
            is_first = corner == 0
            while corner < 3:
                # Name the vertex.
                w = np.int64(vertices[place + corner]) - base
                near = a if corner == 1 else b
                if w > largest:
                    ways[place + corner] = NEW
                elif corner and before[near] == w:
                    ways[place + corner] = BEFORE
                elif corner and after[a] == w:
                    ways[place + corner] = AFTER
                else:
                    ways[place + corner] = STEP
                    steps[step_count] = largest - w
                    step_count += 1
                if w > largest:
                    # Refer to it where an earlier block has it.
                    row = base + w
                    found = find(bits, row, firsts, distinct, table)
                    if found < distinct:
                        known[row] = True
                        difference = found - last_place & 0xFFFFFFFF
                        back[known_count] = folded(difference, 0xFFFFFFFF)
                        known_count += 1
                        last_place = found
                    else:
                        # Guess it from the triangle before, or from the vertex before.
                        i, j, h = a, b, o
                        if is_first:
                            i = largest if corner == 0 and largest >= 0 else NONE
                            i = a if corner == 1 else b if corner == 2 else i
                            j = h = i
                        for axis in range(3):
                            every = (1 << widths[axis]) - 1
                            difference = numbers[w, axis] - guess(numbers, axis, i, j, h, every) & every
                            rest[axis, distinct] = folded(difference, every)
                        distinct += 1
                    largest = w
                # Make it a corner of the triangle.
                if corner == 0:
                    a = w
                elif corner == 1:
                    b = w
                else:
                    c = w
                corner += 1
            open_edges(after, before, a, b, c)
    return step_count, known_count, distinct


@kernel
def number_of(word, mode, every, anchor, exponent):
    """The number u that stands for the bits of a float32 on an axis, or -1 where there is none."""
    if word & 0x7F800000 == 0x7F800000:
        return -1
    if mode == 2:
        number = ordered(word) - anchor
    elif word == NEGATIVE_ZERO:
        return every if mode == 1 else -1
    else:
        # Look at how far the bits are to be shifted, and whether one is lost.
        size, own = split_bits(word)
        drop = exponent - own
        if size and (drop < -31 or drop > 23 or (drop > 0 and size & ((1 << drop) - 1))):
            return -1
        number = (multiple_of(word, exponent) if size else 0) - anchor
        if mode == 1 and number == every:
            return -1
    return number if 0 <= number <= every else -1


@inlined
def put_value(number, mode, every, anchor, scale, real, bits, row, axis):
    """Write the float32 that a number u stands for on an axis, or what is none."""
    bits[row, axis] = NO_VALUE
    if mode == 1 and number == every:
        bits[row, axis] = NEGATIVE_ZERO
        return
    number += anchor
    if mode == 2:
        if -0x7F800000 <= number < 0x7F800000:
            bits[row, axis] = number if number >= 0 else NEGATIVE_ZERO - 1 - number
        return
    exact = number * scale
    value = np.float32(exact)
    if abs(number) <= 0x7FFFFFFF and np.isfinite(value) and np.float64(value) == exact:
        real[row, axis] = value


@kernel
def unpack(headers, is_start, turns, flips, ways, known, steps, back, rest, real, bits, words):
    """Put the blocks together.

    Args:
        headers: (b, 8) uint32 that keep the rules of `header_flaw` with these words.
        is_start: (n,) uint8, 1 where a strip begins.
        turns: (n,) uint8, 0 or 1.
        flips: (f,) uint8, 0 or 1, for the triangles of the blocks with flip bits.
        ways: (n + 2s,) uint8, how each strip vertex is named, 0 to 3.
        known: (q,) uint8, 1 where a vertex stands in an earlier block.
        steps: (e,) uint8, as many as ways that need one.
        back: (r,) uint32, as many as known vertices.
        rest: (3, q - r) uint32.
        real: (q - r, 3) float32 to fill with the distinct vertices.
        bits: (q - r, 3) uint32, the same memory.
        words: (w,) uint32, zero, to fill.

    Returns:
        SOUND or UNSOUND, and the block.
    """
    after = np.empty(256, np.int64)
    before = np.empty(256, np.int64)
    modes = np.empty(3, np.int64)
    widths = np.empty(3, np.int64)
    every = np.empty(3, np.int64)
    anchors = np.empty(3, np.int64)
    exponents = np.empty(3, np.int64)
    scales = np.empty(3, np.float64)
    numbers = np.zeros((257, 3), np.int64)
    step_count = known_count = distinct = vertex = flip = place = 0
    last_place = 0
    a = b = c = 0
    for block in range(headers.shape[0]):
        count, vertex_count, strips, has_flips, index_width = block_counts(headers, block)
        take_axes(headers, block, modes, widths, every, anchors, exponents, scales)
        begin = np.int64(headers[block, 0])
        bit = np.int64(headers[block, 1]) << 5
        index_bit = bit + (2 + has_flips) * count
        after[:] = -1
        before[:] = -1
        largest = -1
        place_end = place + count + 2 * strips
        for t in range(begin, begin + count):
            # Write the bits of the triangle.
            put(words, bit + t - begin, np.int64(is_start[t]), 1)
            put(words, bit + count + t - begin, np.int64(turns[t]), 1)
            if has_flips:
                put(words, bit + 2 * count + t - begin, np.int64(flips[flip]), 1)
                flip += 1
            # Enter it over an edge of the one before it, or begin a strip.
            corner = 2
            if is_start[t]:
                corner = 0
            elif t == begin:
                return UNSOUND, block
            elif turns[t]:
                a, b, c = a, c, b
            else:
                a, b, c = c, b, a
            o = c
            is_first = corner == 0
            if place + 3 - corner > place_end:
                return UNSOUND, block
            while corner < 3:
                # Find the vertex.
                way = ways[place]
                place += 1
                w = largest + 1
                if way == BEFORE:
                    w = before[a if corner == 1 else b]
                elif way == AFTER:
                    w = after[a]
                elif way == STEP:
                    w = largest - np.int64(steps[step_count])
                    step_count += 1
                if w < 0 or w >= vertex_count or (corner == 0 and way in (BEFORE, AFTER)):
                    return UNSOUND, block
                index_bit = put(words, index_bit, w, index_width)
                if way == NEW:
                    # Take the value of a known one from where it stood first.
                    is_known = known[vertex]
                    vertex += 1
                    source = distinct
                    if is_known:
                        difference = unfolded(np.int64(back[known_count]), 0xFFFFFFFF)
                        known_count += 1
                        source = last_place + difference & 0xFFFFFFFF
                        last_place = source
                        if source >= distinct:
                            return UNSOUND, block
                    # Guess another one from the triangle before, or from the vertex before.
                    i, j, h = a, b, o
                    if is_first:
                        i = largest if corner == 0 and largest >= 0 else NONE
                        i = a if corner == 1 else b if corner == 2 else i
                        j = h = i
                    for axis in range(3):
                        mode, most, anchor = modes[axis], every[axis], anchors[axis]
                        if is_known:
                            number = number_of(
                                np.int64(bits[source, axis]), mode, most, anchor, exponents[axis]
                            )
                            if number < 0:
                                return UNSOUND, block
                        else:
                            number = np.int64(rest[axis, distinct])
                            if number > most:
                                return UNSOUND, block
                            number = unfolded(number, most) + guess(numbers, axis, i, j, h, most) & most
                            put_value(number, mode, most, anchor, scales[axis], real, bits, distinct, axis)
                        numbers[w, axis] = number
                    if not is_known:
                        distinct += 1
                    largest = w
                # Make it a corner of the triangle.
                if corner == 0:
                    a = w
                elif corner == 1:
                    b = w
                else:
                    c = w
                corner += 1
            open_edges(after, before, a, b, c)
        if place != place_end or largest != vertex_count - 1:
            return UNSOUND, block
        # Write the numbers of the vertices.
        for k in range(vertex_count):
            for axis in range(3):
                index_bit = put(words, index_bit, numbers[k, axis], widths[axis])
    return SOUND, 0
