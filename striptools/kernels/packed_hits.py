"""Kernels of the tracer of packed blocks: what it keeps of the nodes, and where on its face a hit lies."""

import numpy as np

from striptools.kernels.bits import bits_set, highest_bit
from striptools.kernels.blocks import axis_of, block_bits, block_counts, take
from striptools.kernels.compiled import fetch, helper, inlined, kernel
from striptools.kernels.weighing import CHUNK, ROOM, note_hits, take_corners, take_ray, weigh_held
from striptools.kernels.wide import EMPTY, LEAST_NORMAL, WIDTH, precedes

SLOT_IS_LEAF = 1 << 31
"""Set in what is said of a slot that holds a leaf, or nothing."""

BLOCK_WORDS = 16
"""Words that are said of a block."""

HEAD = 12
"""Where among them those begin that are of no axis."""

BIAS = 512
"""What is added to an exponent."""


@kernel
def depth_of(slots):
    """The most nodes on a way from the root down; children come after their parents.

    Args:
        slots: (m, 8) uint32, as from `describe_slots`.
    """
    level = np.zeros(len(slots), np.int32)
    level[0] = 1
    depth = np.int32(1)
    for node in range(len(slots)):
        depth = max(depth, level[node])
        for slot in range(WIDTH):
            if slots[node, slot] < SLOT_IS_LEAF:
                level[slots[node, slot]] = level[node] + 1
    return depth


@kernel
def describe_slots(child, runs, slots):
    """Say of each slot of each node where its child is: a walk has neither to count slots nor to find runs.

    Args:
        child: (m, 8) int32, as from `kernels.packed_nodes.slot_children`.
        runs: (r,) uint32, SPEC 4.5.
        slots: (m, 8) uint32, written. The child, where that is a node, be it a block's root. Of a run bit 31
            and, in bits 0 to 7, its first triangle; 8 to 15 the strip; 16 to 20 bits 27 to 31 of the run;
            from 21 on the turns of its triangles, and a one behind the last. Of nothing a run that is empty.
    """
    for node in range(len(child)):
        for slot in range(WIDTH):
            below = np.int64(child[node, slot])
            said = below
            if below == EMPTY:
                said = np.int64(SLOT_IS_LEAF | 1 << 21)
            elif below < 0:
                run = np.int64(runs[-(below + 1)])
                turns = run >> 19 & 0xFF | 2 << (run >> 8 & 7)
                said = SLOT_IS_LEAF | turns << 21 | (run >> 27) << 16 | (run >> 11 & 0xFF) << 8 | run & 0xFF
            slots[node, slot] = said


@kernel
def describe_blocks(headers, scale_exponent, blocks):
    """Say of each block what its triangles are decoded by: what a header says, worked out.

    Args:
        headers: (b, 8) uint32, SPEC 4.2.
        scale_exponent: Of the power of two that positions are multiplied by.
        blocks: (b, 16) uint32, written. Four words for each axis: the anchor; a mask as wide as its numbers;
            the power of two that they are multiplied by, as float32, where that is normal; and in bits 0 to 6
            where in a vertex they begin, 7 and 8 their mode, 9 to 18 the exponent of the power, plus `BIAS`,
            and from 19 on their width. Then the block's first triangle; its first word; in bits 0 to 7 its
            triangles, less one, 8 to 11 the width of an index, 12 whether there are flips, and from 13 on the
            bit where vertices begin; in bits 0 to 6 the width of a vertex, and from 7 on the bit where
            indices begin.
    """
    for block in range(len(headers)):
        connectivity, size = block_bits(headers, block)
        triangles, vertices, _, has_flips, index_width = block_counts(headers, block)
        begin = np.int64(0)
        for axis in range(3):
            mode, width, _, exponent = axis_of(headers, block, axis)
            exponent = scale_exponent + (0 if mode == 2 else exponent)
            blocks[block, 4 * axis] = headers[block, 3 + axis]
            blocks[block, 4 * axis + 1] = (np.int64(1) << width) - 1
            blocks[block, 4 * axis + 2] = min(max(exponent + 127, 1), 254) << 23
            blocks[block, 4 * axis + 3] = begin | mode << 7 | (exponent + BIAS) << 9 | width << 19
            begin += width
        blocks[block, HEAD] = headers[block, 0]
        blocks[block, HEAD + 1] = headers[block, 1]
        blocks[block, HEAD + 2] = triangles - 1 | index_width << 8 | has_flips << 12 | connectivity << 13
        blocks[block, HEAD + 3] = size // vertices | (2 + has_flips) * triangles << 7


@kernel
def least_exponent(headers, words):
    """The exponent of the least power of two that is in a coordinate of mode 2; 0 where all are larger."""
    least = np.int64(0)
    for block in range(len(headers)):
        connectivity, size = block_bits(headers, block)
        _, vertices, _, _, _ = block_counts(headers, block)
        stride = size // vertices
        bit = (np.int64(headers[block, 1]) << 5) + connectivity
        for axis in range(3):
            mode, width, anchor, _ = axis_of(headers, block, axis)
            if mode == 2:
                for k in range(vertices):
                    whole = take(words, bit + k * stride, width) + anchor
                    bits = whole if whole >= 0 else -1 - whole
                    if bits > 0:
                        least = min(least, (bits >> 23) - 127 if bits >= 0x800000 else np.int64(-149))
            bit += width
    return least


@kernel
def describe_runs(headers, words, first_run, runs, begin, end, described):
    """Say of each run of the blocks `begin:end` all that its triangles' places are found by: SPEC 4.5.

    In the order of a strip's vertices, newest behind, triangle j of a run whose first vertex is number p has
    vertex p + j + 2 for its newest corner and p + j + 1 for its near one; by its turn the near one is a or b.
    The far one is p + u + 1, u the last triangle of the run up to j of another turn, or what it was for the
    run's first triangle where there is none. A strip's first triangle is like one of turn 1.

    Args:
        headers: (b, 8) uint32.
        words: (w,) uint32.
        first_run: (b+1,) int64.
        runs: (r,) uint32, of which bits 0 to 10 are read.
        begin: The first block.
        end: Where they end.
        described: (r,) uint32, written. Bits 0 to 7: the first triangle; 8 to 10: triangles, less one; 11
            to 18: the strip, counted in the block; 19 to 26: turns; 27 to 31: k, where p + 1 - k is the far
            corner's place for the first triangle.
    """
    strip_of = np.empty(256, np.int64)
    start_of = np.empty(256, np.int64)
    turn_of = np.empty(256, np.int64)
    last_of = np.empty(256, np.int64)
    for block in range(begin, end):
        # Follow the strips: of each triangle its strip, its turn, and the last other turn.
        count = block_counts(headers, block)[0]
        bit = np.int64(headers[block, 1]) << 5
        strip = np.int64(-1)
        start = np.int64(0)
        for t in range(count):
            turn = take(words, bit + count + t, 1)
            if take(words, bit + t, 1):
                strip += 1
                start = t
                turn = np.int64(1)
                last_of[t] = -1
            elif turn != turn_of[t - 1]:
                last_of[t] = t - 1
            else:
                last_of[t] = last_of[t - 1]
            strip_of[t] = strip
            start_of[t] = start
            turn_of[t] = turn

        # Write the runs.
        for run in range(first_run[block], first_run[block + 1]):
            first = np.int64(runs[run]) & 255
            length = np.int64(runs[run]) >> 8 & 7
            turns = np.int64(0)
            for j in range(length + 1):
                turns |= turn_of[first + j] << j
            last = last_of[first]
            back = first - last if last >= 0 else first - start_of[first] + turn_of[first]
            described[run] = first | length << 8 | strip_of[first] << 11 | turns << 19 | back << 27


@inlined
def corner_indices(blocks, words, block, t):
    """The indices of triangle t of a block: SPEC 4.3, alone, and without branches that go either way."""
    word = np.int64(blocks[block, HEAD + 1])
    said = np.int64(blocks[block, HEAD + 2])
    bit, count, width, has_flips = word << 5, (said & 0xFF) + 1, said >> 8 & 15, said >> 12 & 1

    # Count the strips that start up to t: in as many words as the block has, whatever t is.
    strip = np.int64(-1)
    for k in range(count + 31 >> 5):
        ours = (np.int64(1) << min(max(t + 1 - 32 * k, 0), 32)) - 1
        strip += bits_set(np.int64(words[np.uint64(word + k)]) & ours)

    # Find its first triangle, and the last other turn behind it; no more than 30 in a row are equal, so that
    # what is farther back than that does not matter. A one below them stands for none.
    begin = max(t - 31, 0)
    starts = take(words, bit + begin, t + 1 - begin)
    first = begin - 1 + highest_bit(starts << 1 | 1)
    size = t - first
    turns = take(words, bit + count + first + 1, size)
    turn = turns >> max(size - 1, 0)
    other = turns ^ ((1 << size) - 1) * turn
    last = first + highest_bit(other << 1 | 1)

    # Take the corners: without branches, which would go astray every other time.
    begin = bit + (2 + has_flips) * count + 2 * strip * width
    c = take(words, begin + (t + 2) * width, width)
    near = take(words, begin + (t + 1) * width, width)
    at_first = (t == first) | ((turn == 1) & (last == first))
    far = take(words, begin + (first if at_first else last + 1) * width, width)
    near_is_a = (t != first) & (turn == 0)
    a, b = near if near_is_a else far, far if near_is_a else near
    if has_flips and take(words, bit + 2 * count + t, 1):
        a, b = b, a
    return a, b, c


@inlined
def power_of_two(exponent):
    """2**exponent as float64, exponent from -1022 to 1023."""
    return np.int64((exponent + 1023) << 52).view(np.float64)


@inlined
def coordinate(number, mode, mask, anchor, exponent):
    """A scaled coordinate of any mode from its number: zero where that is not normal.

    Args:
        number: What is written of it.
        mode: 0 to 2.
        mask: All bits that may be.
        anchor: Of the block.
        exponent: Of the power of two that it is multiplied by.
    """
    whole = number + anchor
    size = abs(whole)
    unit = power_of_two(exponent)
    if mode == 2:
        # Take the bits of the float apart.
        bits = whole if whole >= 0 else -1 - whole
        field = bits >> 23
        size = bits & 0x7FFFFF | (0x800000 if field > 0 else 0)
        unit = power_of_two(max(field, 1) - 150 + exponent)
    elif mode == 1 and number == mask:
        size = np.int64(0)
    exact = np.float64(size) * unit
    value = np.float32(exact) if exact >= np.float64(LEAST_NORMAL) else np.float32(0.0)
    return -value if whole < 0 else value


@helper
def find_corners(blocks, words, names, places):
    """Find where the corners of up to 64 triangles are, and have their lines fetched.

    Args:
        blocks: (b, 16) uint32, as from `describe_blocks`.
        words: (w,) uint32.
        names: (k,) int32, 256 times a triangle's block plus its number there.
        places: (3, 64) int64, written: the bits where corners a, b and c begin.
    """
    for i in range(len(names)):
        block = np.uint64(names[i] >> 8)
        a, b, c = corner_indices(blocks, words, block, np.int64(names[i] & 255))
        begin = (np.int64(blocks[block, HEAD + 1]) << 5) + (np.int64(blocks[block, HEAD + 2]) >> 13)
        stride = np.int64(blocks[block, HEAD + 3]) & 127
        places[0, i], places[1, i], places[2, i] = begin + a * stride, begin + b * stride, begin + c * stride
        for j in range(3):
            fetch(words, places[j, i] >> 5)


@helper
def decode_corners(blocks, words, names, places, corners, turns):
    """Decode up to 64 triangles, step by step, so that one waits for memory while others do.

    Corners are scaled, what is not a normal number then is zero, as the walks have it.

    Args:
        blocks: (b, 16) uint32, as from `describe_blocks`.
        words: (w,) uint32.
        names: (k,) int32, as of `find_corners`.
        places: (3, 64) int64, as from `find_corners`.
        corners: (9, 64) float32, written: x of corners a, b and c, in the order of the tests, then y, then z.
        turns: (64,) int32, written: the strip's corner that is the first in the order of the tests.
    """
    # Take them.
    for i in range(len(names)):
        block = np.uint64(names[i] >> 8)
        for axis in range(3):
            anchor = np.int64(np.int32(blocks[block, 4 * axis]))
            said = np.int64(blocks[block, 4 * axis + 3])
            begin, mode, width = said & 127, said >> 7 & 3, said >> 19
            exponent = (said >> 9 & 1023) - BIAS
            if mode == 0 and exponent >= -126:
                # Integers of at most 24 bits and a normal power of two: float32 is exact.
                power = np.int32(blocks[block, 4 * axis + 2]).view(np.float32)
                for j in range(3):
                    whole = take(words, places[j, i] + begin, width) + anchor
                    corners[3 * axis + j, i] = np.float32(whole) * power
            else:
                mask = np.int64(blocks[block, 4 * axis + 1])
                for j in range(3):
                    number = take(words, places[j, i] + begin, width)
                    corners[3 * axis + j, i] = coordinate(number, mode, mask, anchor, exponent)

    # Turn them.
    for i in range(len(turns)):
        x0, x1, x2 = corners[0, i], corners[1, i], corners[2, i]
        y0, y1, y2 = corners[3, i], corners[4, i], corners[5, i]
        z0, z1, z2 = corners[6, i], corners[7, i], corners[8, i]
        second = precedes(x1, y1, z1, x0, y0, z0)
        third = precedes(x2, y2, z2, x1, y1, z1) if second else precedes(x2, y2, z2, x0, y0, z0)
        corners[0, i], corners[1, i], corners[2, i] = turned(x0, x1, x2, second, third)
        corners[3, i], corners[4, i], corners[5, i] = turned(y0, y1, y2, second, third)
        corners[6, i], corners[7, i], corners[8, i] = turned(z0, z1, z2, second, third)
        turns[i] = np.int32(2) if third else (np.int32(1) if second else np.int32(0))


@inlined
def turned(a, b, c, second, third):
    """Three corners from the second or from the third one on."""
    return (
        c if third else (b if second else a),
        a if third else (c if second else b),
        b if third else (a if second else c),
    )


@kernel
def weigh_packed_hits(
    origins,
    directions,
    at,
    found_t,
    found,
    blocks,
    words,
    faces,
    rotations,
    scale,
    t,
    face,
    u,
    v,
    triangle,
):
    """Where on its face each hit lies: only the triangles hit are decoded. Nothing is written of other rays.

    Args:
        origins: (r, 3) float32.
        directions: (r, 3) float32, not zero where there is a hit.
        at: (k,) int32, the rays that results are for, negative for none; others are left alone.
        found_t: (k,) float32, t of each.
        found: (k,) int32, 256 times its block plus its number there; negative on a miss.
        blocks: (b, 16) uint32, as from `describe_blocks`.
        words: (w,) uint32.
        faces: (>= n,) int32, the reported face of each triangle; (0,) where triangles are faces.
        rotations: (n,) uint8, places that the reported face's corners were turned to the left; or (0,).
        scale: float32, what positions are multiplied by.
        t: (r,) float32, written.
        face: (r,) int32, written.
        u: (r,) float32, written: the weight of the face's second corner; (0,) where no weights are wanted.
        v: (r,) float32, written: the weight of its third corner; or (0,).
        triangle: (r,) int32, written.
    """
    rays, names = note_hits(at, found_t, found, t)
    for i in range(len(rays)):
        r, name = rays[i], names[i]
        number = np.int64(blocks[name >> 8, HEAD]) + (name & 255)
        triangle[r] = number
        face[r] = faces[number] if len(faces) > 0 else number
    if len(u) == 0 or len(rays) == 0:
        return

    # A triangle that was hit just before is decoded once.
    slots = np.empty(len(rays), np.int32)
    slots[0] = 0
    for i in range(1, len(rays)):
        slots[i] = slots[i - 1] + (names[i] != names[i - 1])
    for i in range(len(rays)):
        names[slots[i]] = names[i]
    names = names[: slots[-1] + 1]

    # Decode a chunk of triangles while the next one's lines are fetched; a chunk of hits needs two at most.
    room = np.zeros(ROOM, np.float32)
    corners = np.zeros((2, 9, CHUNK), np.float32)
    places = np.zeros((2, 3, CHUNK), np.int64)
    turns = np.zeros((2, CHUNK), np.int32)
    turn_of = np.zeros(CHUNK, np.int32)
    decoded = 0
    flat = corners.reshape(corners.size)
    find_corners(blocks, words, names[:CHUNK], places[0])
    for begin in range(0, len(rays), CHUNK):
        end = min(begin + CHUNK, len(rays))
        while decoded <= slots[end - 1]:
            behind = decoded + CHUNK
            here, there = decoded // CHUNK & 1, behind // CHUNK & 1
            find_corners(blocks, words, names[behind : behind + CHUNK], places[there])
            wanted = names[decoded:behind]
            decode_corners(blocks, words, wanted, places[here], corners[here], turns[here])
            decoded = behind
        for i in range(end - begin):
            r, slot = rays[begin + i], slots[begin + i]
            half, column = slot // CHUNK & 1, slot % CHUNK
            axes = take_ray(origins, directions, r, room, i)
            first = np.uint64(half * 9 * CHUNK + column)
            take_corners(flat, first, np.uint64(CHUNK), axes, room, np.uint64(i))
            # Name its corners as the reported face does.
            rotation = rotations[triangle[r]] if len(rotations) > 0 else 0
            turn_of[i] = (turns[half, column] + rotation) % 3
        weigh_held(room, end - begin, scale, rays[begin:end], turn_of, u, v)
