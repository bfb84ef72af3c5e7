"""Blocks of packed strips and vertices (SPEC.md, 4.2 and 4.3): the loops that write and read them.

A header is a row of eight words, the 32 bytes of the file. Coordinates are handled as the bits of float32, so
that no number is rounded on the way in; on the way out an integer times a power of two is exact in float64.
"""

from math import ldexp

import numpy as np

from striptools.kernels.compiled import inlined, kernel

SOUND = 0
WRONG_FIRST = 1
WRONG_WORD = 2
WRONG_COUNTS = 3
WRONG_AXIS = 4
RESERVED = 5
STRAY_BITS = 6
WRONG_STARTS = 7
TURNED_FIRST = 8
NO_FLIPS = 9
LONG_FAN = 10
NO_VERTEX = 11
TOO_EARLY = 12
NOT_USED = 13
REPEATED = 14
NO_NUMBER = 15
WRONG_LENGTH = 16
WRONG_TOTAL = 17

MOST_EQUAL = 30
"""Equal turn bits in a row within a strip, its first triangle's left out."""

TABLE = 1024
"""Slots of a block's table of vertices; a block has at most 256 of them, and no more is ever asked of it."""

LOWEST = -149
"""The exponent of the finest bit of any float32."""
HIGHEST = 106
"""The largest exponent that a header can name."""

NEGATIVE_ZERO = 1 << 31


@inlined
def put(words, bit, value, width):
    """Write the `width` bits (0 to 32) of a number at a bit of zeroed words; returns the bit behind them."""
    place = bit >> 5
    shift = bit & 31
    wide = value << shift
    words[place] = np.int64(words[place]) | wide & 0xFFFFFFFF
    if shift + width > 32:
        words[place + 1] = np.int64(words[place + 1]) | wide >> 32
    return bit + width


@inlined
def take(words, bit, width):
    """The number in `width` bits (0 to 32) from a bit on; reads one word more than it has to."""
    place = bit >> 5
    # An unsigned place is not compared with zero.
    wide = np.int64(words[np.uint64(place)]) | np.int64(words[np.uint64(place + 1)]) << 32
    return wide >> (bit & 31) & ((1 << width) - 1)


@kernel
def bit_width(number):
    """The least w with number < 2**w, of a number below 2**53: the exponent of a float."""
    return (np.float64(number).view(np.int64) >> 52) - 1022 if number > 0 else 0


@inlined
def ordered(word):
    """The integer that stands for the bits of a float32 in mode 2: it rises with the number."""
    return word if word < NEGATIVE_ZERO else NEGATIVE_ZERO - 1 - word


@inlined
def split_bits(word):
    """The bits of a finite float32 as (size, exponent): the number is size * 2**exponent, its sign apart."""
    field = word >> 23 & 0xFF
    size = word & 0x7FFFFF
    if field:
        return size | 0x800000, field - 150
    return size, LOWEST


@inlined
def multiple_of(word, exponent):
    """The bits of a float32 as a multiple of 2**exponent, which it is; needs room for it in an int64."""
    size, own = split_bits(word)
    size = size << (own - exponent) if own >= exponent else size >> (exponent - own)
    return -size if word & NEGATIVE_ZERO else size


@inlined
def finest_bit(word, finest):
    """The exponent of the finest set bit of a float32, or `finest` where that is less; 0 has none."""
    size, own = split_bits(word)
    drop = finest - own
    if size == 0 or drop <= 0 or (drop <= 24 and size & ((1 << drop) - 1) == 0):
        return finest
    while size & 1 == 0:
        size >>= 1
        own += 1
    return own


@kernel
def number_vertices(vertices, begin, end, table, local, used):
    """Number the vertices[begin:end] of a block by first use.

    Args:
        vertices: (c,) int32 strip vertices.
        begin: The first one of the block.
        end: The first one behind it.
        table: (TABLE, 2) int32, any content.
        local: (768,) int32 to fill with the number of each strip vertex.
        used: (256,) int32 to fill with the vertex of each number.

    Returns:
        How many vertices there are, or -1 where they are more than 256.
    """
    for slot in range(TABLE):
        table[slot, 0] = -1
    count = 0
    for k in range(begin, end):
        # Look the vertex up by its hash, and take the next free slot where it is new.
        vertex = np.int64(vertices[k])
        slot = (vertex * 0x9E3779B1 >> 16) & (TABLE - 1)
        while table[slot, 0] != vertex and table[slot, 0] >= 0:
            slot = slot + 1 & (TABLE - 1)
        if table[slot, 0] < 0:
            if count == used.shape[0]:
                return -1
            table[slot, 0] = vertex
            table[slot, 1] = count
            used[count] = vertex
            count += 1
        local[k - begin] = table[slot, 1]
    return count


@kernel
def choose_axis(bits, used, count, axis):
    """The narrowest way to write a block's coordinates on an axis: (mode, width, anchor, exponent).

    Args:
        bits: (v, 3) uint32, the bits of float32 positions.
        used: (256,) int32, the block's vertices.
        count: How many they are.
        axis: 0 to 2.
    """
    # Find the finest bit and the least and the largest number, minus zero apart.
    finest = 1000
    low = 1 << 32
    high = -(1 << 32)
    has_minus = False
    for k in range(count):
        word = np.int64(bits[used[k], axis])
        if word == NEGATIVE_ZERO:
            has_minus = True
            continue
        finest = finest_bit(word, finest)
        value = ordered(word)
        low = min(low, value)
        high = max(high, value)
    if high < low:
        return 2, 0, -1, 0
    exponent = LOWEST if finest == 1000 else min(finest, HIGHEST)

    # Take the bits themselves where the multiples of the finest one do not fit 31 bits.
    raw_low = min(low, -1) if has_minus else low
    raw_width = bit_width((max(high, -1) if has_minus else high) - raw_low)
    low_word = low if low >= 0 else NEGATIVE_ZERO - 1 - low
    high_word = high if high >= 0 else NEGATIVE_ZERO - 1 - high
    for word in (low_word, high_word):
        size, own = split_bits(word)
        if size and own - exponent + bit_width(size) > 31:
            return 2, raw_width, raw_low, 0

    # Take the narrower one else; minus zero needs the number of all bits for itself.
    anchor = multiple_of(low_word, exponent)
    mode = 1 if has_minus else 0
    width = bit_width(multiple_of(high_word, exponent) - anchor + mode)
    if width > 32 or raw_width < width:
        return 2, raw_width, raw_low, 0
    return mode, width, anchor, exponent


@kernel
def put_vertices(bits, used, count, modes, anchors, exponents, widths, words, bit):
    """Write a block's vertices from a bit on; returns the bit behind them."""
    for k in range(count):
        for axis in range(3):
            word = np.int64(bits[used[k], axis])
            if modes[axis] == 2:
                number = ordered(word) - anchors[axis]
            elif word == NEGATIVE_ZERO:
                number = (1 << widths[axis]) - 1
            else:
                number = multiple_of(word, exponents[axis]) - anchors[axis]
            bit = put(words, bit, number, widths[axis])
    return bit


@kernel
def encode(bits, vertices, turns, flips, starts, block_strips, first, last, headers, words):
    """Write the blocks first:last from word 0 of `words` on.

    Args:
        bits: (v, 3) uint32, the bits of float32 positions.
        vertices: (n + 2s,) int32 strip vertices.
        turns: (n,) bool.
        flips: (n,) bool, or (0,) where no triangle has one.
        starts: (s+1,) int32 in triangles.
        block_strips: (b+1,) int32, the first strip of each block.
        first: The first block to write.
        last: The first one not to write.
        headers: (b, 8) uint32 to fill, `word` counted from the first block of these.
        words: (w,) uint32, zero, to write to.

    Returns:
        Words written, or -1 - block for a block that is out of the limits.
    """
    table = np.empty((TABLE, 2), np.int32)
    local = np.empty(768, np.int32)
    used = np.empty(256, np.int32)
    modes = np.empty(3, np.int64)
    anchors = np.empty(3, np.int64)
    exponents = np.empty(3, np.int64)
    widths = np.empty(3, np.int64)
    word = 0
    for block in range(first, last):
        # Number the vertices.
        strip = np.int64(block_strips[block])
        strips = np.int64(block_strips[block + 1]) - strip
        begin = np.int64(starts[strip])
        count = np.int64(starts[strip + strips]) - begin
        corners = count + 2 * strips
        if strips < 1 or count < strips or count > 256:
            return -1 - block
        place = begin + 2 * strip
        vertex_count = number_vertices(vertices, place, place + corners, table, local, used)
        if vertex_count < 0:
            return -1 - block

        # Choose how each axis is written.
        for axis in range(3):
            modes[axis], widths[axis], anchors[axis], exponents[axis] = choose_axis(
                bits, used, vertex_count, axis
            )
        has_flips = 0
        for t in range(begin, begin + count if flips.shape[0] else begin):
            if flips[t]:
                has_flips = 1

        # Write the start, turn and flip bits.
        bit = word << 5
        for s in range(strip, strip + strips):
            put(words, bit + np.int64(starts[s]) - begin, 1, 1)
        bit += count
        for t in range(begin, begin + count):
            bit = put(words, bit, 1 if turns[t] else 0, 1)
        if has_flips:
            for t in range(begin, begin + count):
                bit = put(words, bit, 1 if flips[t] else 0, 1)

        # Write the indices and the vertices.
        index_width = bit_width(vertex_count - 1)
        for k in range(corners):
            bit = put(words, bit, np.int64(local[k]), index_width)
        bit = put_vertices(bits, used, vertex_count, modes, anchors, exponents, widths, words, bit)

        # Write the header.
        headers[block, 0] = begin
        headers[block, 1] = word
        headers[block, 2] = count - 1 | vertex_count - 1 << 8 | strips - 1 << 16 | has_flips << 24
        packed = 0
        for axis in range(3):
            headers[block, 3 + axis] = anchors[axis] & 0xFFFFFFFF
            packed |= (widths[axis] | modes[axis] << 6) << 8 * axis
            if modes[axis] != 2:
                packed |= exponents[axis] - LOWEST << 24 + 8 * axis
        headers[block, 6] = packed & 0xFFFFFFFF
        headers[block, 7] = packed >> 32
        word = bit + 31 >> 5
    return word


@inlined
def block_counts(headers, block):
    """Triangles, vertices and strips of a block, whether it has flip bits, and the width of its indices."""
    packed = np.int64(headers[block, 2])
    count = (packed & 0xFF) + 1
    vertex_count = (packed >> 8 & 0xFF) + 1
    strips = (packed >> 16 & 0xFF) + 1
    return count, vertex_count, strips, packed >> 24 & 1, bit_width(vertex_count - 1)


@inlined
def axis_of(headers, block, axis):
    """Mode, width, anchor and exponent of a block's axis."""
    packed = np.int64(headers[block, 6]) | np.int64(headers[block, 7]) << 32
    described = packed >> 8 * axis & 0xFF
    anchor = np.int64(headers[block, 3 + axis])
    if anchor >= 1 << 31:
        anchor -= 1 << 32
    return described >> 6, described & 63, anchor, (packed >> 24 + 8 * axis & 0xFF) + LOWEST


@kernel
def block_bits(headers, block):
    """The bits of a block's data: start, turn and flip bits, indices, vertices."""
    count, vertex_count, strips, has_flips, index_width = block_counts(headers, block)
    connectivity = (2 + has_flips) * count + (count + 2 * strips) * index_width
    width = 0
    for axis in range(3):
        width += axis_of(headers, block, axis)[1]
    return connectivity, vertex_count * width


@kernel
def sum_parts(headers):
    """Of all blocks: vertices, strips, bits of connectivity, bits of vertices, words."""
    vertices = strips = connectivity = positions = words = 0
    for block in range(headers.shape[0]):
        _, vertex_count, strip_count, _, _ = block_counts(headers, block)
        one, two = block_bits(headers, block)
        vertices += vertex_count
        strips += strip_count
        connectivity += one
        positions += two
        words += one + two + 31 >> 5
    return vertices, strips, connectivity, positions, words


@kernel
def header_flaw(headers, words, triangle_count):
    """The first rule of 4.2 that headers break, and the block: all that safe decoding rests on."""
    word = triangle = 0
    for block in range(headers.shape[0]):
        # Look at the counts and the places.
        count, vertex_count, strips, _, _ = block_counts(headers, block)
        if np.int64(headers[block, 0]) != triangle:
            return WRONG_FIRST, block
        if np.int64(headers[block, 1]) != word:
            return WRONG_WORD, block
        if vertex_count < 3 or strips > count:
            return WRONG_COUNTS, block
        if np.int64(headers[block, 2]) >> 25 or np.int64(headers[block, 7]) >> 16:
            return RESERVED, block
        # Look at the axes.
        for axis in range(3):
            mode, width, _, exponent = axis_of(headers, block, axis)
            if width > 32 or mode == 3 or (mode == 1 and width == 0) or (mode == 2 and exponent != LOWEST):
                return WRONG_AXIS, block
        connectivity, positions = block_bits(headers, block)
        word += connectivity + positions + 31 >> 5
        triangle += count
    # Look at what comes after the last block.
    blocks = headers.shape[0]
    if triangle != triangle_count:
        return WRONG_TOTAL, blocks
    if words.shape[0] != (word + 31 >> 4) << 4:
        return WRONG_LENGTH, blocks
    for k in range(word, words.shape[0]):
        if words[k]:
            return STRAY_BITS, blocks
    return SOUND, 0


@kernel
def take_strips(headers, words, block, base, strip, vertices, turns, flips, starts):
    """Decode the strips of a block; arguments as in `decode`.

    Args:
        headers: The headers.
        words: The data.
        block: Which block.
        base: Its first vertex.
        strip: Its first strip.
        vertices: To fill.
        turns: To fill.
        flips: To fill.
        starts: To fill.

    Returns:
        The rule that it breaks, or SOUND.
    """
    count, vertex_count, strips, has_flips, index_width = block_counts(headers, block)
    begin = np.int64(headers[block, 0])
    bit = np.int64(headers[block, 1]) << 5
    index_bit = bit + (2 + has_flips) * count
    place = begin + 2 * strip
    strip_end = strip + strips
    # Make sure that there are as many starts as strips, and no more vertices than indices.
    for t in range(count):
        strips -= take(words, bit + t, 1)
    if strips or not take(words, bit, 1):
        return WRONG_STARTS
    if vertex_count > count + 2 * (strip_end - strip):
        return NOT_USED
    largest = -1
    last_turn = run = flip_count = 0
    a = b = c = -1
    for t in range(count):
        # Read the bits of the triangle.
        turn = take(words, bit + count + t, 1)
        flip = take(words, bit + 2 * count + t, 1) & has_flips
        is_first = take(words, bit + t, 1)
        if is_first and (turn or flip):
            return TURNED_FIRST
        turns[begin + t] = turn
        flip_count += flip
        if has_flips:
            flips[begin + t] = flip
        # Count equal turns, and follow the strip.
        news = 1
        if is_first:
            starts[strip] = begin + t
            strip += 1
            run = 0
            news = 3
        else:
            run = run + 1 if run and turn == last_turn else 1
            last_turn = turn
            if run > MOST_EQUAL:
                return LONG_FAN
            if turn:
                b = c
            else:
                a, b = c, b
        # Read the vertices that the triangle adds, and number them by first use.
        for _ in range(news):
            index = take(words, index_bit, index_width)
            index_bit += index_width
            if index >= vertex_count:
                return NO_VERTEX
            if index > largest + 1:
                return TOO_EARLY
            largest = max(largest, index)
            vertices[place] = base + index
            place += 1
            if news == 3:
                a, b = b, c
            c = index
        if a == b or b == c or c == a:
            return REPEATED
    if has_flips and flip_count == 0:
        return NO_FLIPS
    return SOUND if largest == vertex_count - 1 else NOT_USED


@kernel
def take_axis(headers, words, block, axis, base, bit, stride, positions, bits):
    """Decode the coordinates of a block on one axis; returns the rule that they break, or SOUND."""
    count = block_counts(headers, block)[1]
    mode, width, anchor, exponent = axis_of(headers, block, axis)
    scale = ldexp(1.0, exponent)
    every = (1 << width) - 1
    for k in range(base, base + count):
        number = take(words, bit, width)
        bit += stride
        if mode == 1 and number == every:
            bits[k, axis] = NEGATIVE_ZERO
            continue
        number += anchor
        if mode == 2:
            # Refuse what is not finite, in either half of the integers.
            if number >= 0x7F800000 or number < -0x7F800000:
                return NO_NUMBER
            bits[k, axis] = number if number >= 0 else NEGATIVE_ZERO - 1 - number
            continue
        if abs(number) > 0x7FFFFFFF:
            return NO_NUMBER
        exact = number * scale
        value = np.float32(exact)
        if not np.isfinite(value) or np.float64(value) != exact:
            return NO_NUMBER
        positions[k, axis] = value
    return SOUND


@kernel
def decode(
    headers, words, vertex_starts, strip_starts, first, last, positions, bits, vertices, turns, flips, starts
):
    """Decode the blocks first:last, whose headers keep the rules of `header_flaw`.

    Args:
        headers: (b, 8) uint32.
        words: (w,) uint32.
        vertex_starts: (b+1,) int32, the first vertex of each block.
        strip_starts: (b+1,) int32, the first strip of each block.
        first: The first block to decode.
        last: The first one not to.
        positions: (q, 3) float32 to fill.
        bits: (q, 3) uint32, the same memory.
        vertices: (n + 2s,) int32 to fill with places in positions.
        turns: (n,) bool to fill.
        flips: (n,) bool, all False, to fill; (0,) where no block has flip bits.
        starts: (s+1,) int32 to fill but for its end.

    Returns:
        The first rule of 4.3 broken, and the block; (SOUND, 0) where none is.
    """
    for block in range(first, last):
        base = np.int64(vertex_starts[block])
        strip = np.int64(strip_starts[block])
        flaw = take_strips(headers, words, block, base, strip, vertices, turns, flips, starts)
        if flaw:
            return flaw, block
        # Read the vertices axis by axis.
        connectivity, size = block_bits(headers, block)
        bit = (np.int64(headers[block, 1]) << 5) + connectivity
        end = bit + size
        stride = size // (vertex_starts[block + 1] - base)
        for axis in range(3):
            flaw = take_axis(headers, words, block, axis, base, bit, stride, positions, bits)
            if flaw:
                return flaw, block
            bit += axis_of(headers, block, axis)[1]
        if take(words, end, -end & 31):
            return STRAY_BITS, block
    return SOUND, 0


@kernel
def fan_starts(turns, starts, is_first):
    """Mark where strips must be cut so that no more than MOST_EQUAL turn bits in a row are equal.

    Args:
        turns: (n,) bool.
        starts: (s+1,) int32.
        is_first: (n,) bool, False, to fill with whether a strip starts there.

    Returns:
        How many strips there are then.
    """
    count = starts.shape[0] - 1
    for strip in range(starts.shape[0] - 1):
        is_first[starts[strip]] = True
        run = 0
        for t in range(np.int64(starts[strip]) + 1, np.int64(starts[strip + 1])):
            run = run + 1 if run and turns[t] == turns[t - 1] else 1
            if run > MOST_EQUAL:
                is_first[t] = True
                count += 1
                run = 0
    return count
