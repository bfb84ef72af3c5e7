"""Kernels of the tracer of packed blocks: what it keeps of the nodes, and where on its face a hit lies."""

from math import ldexp

import numpy as np
from numba import njit

from striptools.kernels.blocks import axis_of, block_counts, take
from striptools.kernels.packed_nodes import LOW
from striptools.kernels.wide import LEAST_NORMAL, WIDTH, first_corner, weigh_corners


@njit(cache=True, nogil=True)
def mark_leaves(words, records, top_count):
    """Write to bits 24 to 31 of the word `leaves` of the nodes over blocks which of their slots are leaves."""
    for node in range(top_count):
        leaves = np.int64(0)
        for slot in range(WIDTH):
            used = records[node, LOW + slot] <= records[node, LOW + 3 * WIDTH + slot]
            if used and (records[node, 14] >> slot) & 1 == 0:
                leaves |= np.int64(1) << slot
        words[node, 1] |= leaves << 24


@njit(cache=True, nogil=True)
def depth_of(words, records, top_count):
    """The most nodes on a way from the root down; children come after their parents."""
    count = len(words)
    level = np.zeros(count, np.int32)
    level[0] = 1
    depth = np.int32(1)
    for node in range(count):
        below = np.int32(level[node] + 1)
        base = np.int64(words[node, 0]) & 0xFFFFFFF
        block = top_count + (np.int64(words[node, 1]) & 0xFFFFFF)
        depth = max(depth, level[node])
        for slot in range(WIDTH):
            if (records[node, 14] >> slot) & 1:
                level[base] = below
                base += 1
            elif node < top_count and records[node, LOW + slot] <= records[node, LOW + 3 * WIDTH + slot]:
                level[block] = below
                block += 1
    return depth


@njit(cache=True, nogil=True)
def block_of(headers, triangle):
    """The block that a triangle in file order is in."""
    low = np.int64(0)
    high = np.int64(len(headers))
    while high - low > 1:
        middle = (low + high) >> 1
        if np.int64(headers[middle, 0]) <= triangle:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
def corner_indices(headers, words, block, t):
    """The indices of triangle t of a block: SPEC 4.3, alone."""
    count, _, _, has_flips, width = block_counts(headers, block)
    bit = np.int64(headers[block, 1]) << 5

    # Find the strip.
    strip = np.int64(-1)
    first = np.int64(0)
    for k in range(t + 1):
        if take(words, bit + k, 1):
            strip += 1
            first = k

    # Find the last other turn.
    turn = take(words, bit + count + t, 1)
    last = t
    while last > first and take(words, bit + count + last, 1) == turn:
        last -= 1
    begin = bit + (2 + has_flips) * count + 2 * strip * width
    c = take(words, begin + (t + 2) * width, width)
    near = take(words, begin + (t + 1) * width, width)
    if t == first:
        a, b = take(words, begin + t * width, width), near
    elif turn == 0:
        a, b = near, take(words, begin + (last + 1) * width, width)
    else:
        a, b = take(words, begin + (first if last == first else last + 1) * width, width), near
    if has_flips and take(words, bit + 2 * count + t, 1):
        a, b = b, a
    return a, b, c


@njit(cache=True, nogil=True)
def scaled_vertex(headers, words, block, vertex, scale_exponent, corner):
    """Fill corner (3,) float32 with a block's vertex times 2**scale_exponent; zero for denormals."""
    count, _, strips, has_flips, index_width = block_counts(headers, block)
    bit = (np.int64(headers[block, 1]) << 5) + (2 + has_flips) * count + (count + 2 * strips) * index_width
    stride = np.int64(0)
    for axis in range(3):
        stride += axis_of(headers, block, axis)[1]
    bit += vertex * stride
    for axis in range(3):
        mode, width, anchor, exponent = axis_of(headers, block, axis)
        number = take(words, bit, width)
        bit += width
        whole = number + anchor
        size = abs(whole)
        if mode == 2:
            # Take the bits of the float apart.
            bits = whole if whole >= 0 else -1 - whole
            field = bits >> 23
            size = bits & 0x7FFFFF | (0x800000 if field > 0 else 0)
            exponent = max(field, 1) - 150
        elif mode == 1 and number == (1 << width) - 1:
            size = np.int64(0)
        exact = np.float64(size) * ldexp(1.0, exponent + scale_exponent)
        value = np.float32(exact) if exact >= np.float64(LEAST_NORMAL) else np.float32(0.0)
        corner[axis] = -value if whole < 0 else value


@njit(cache=True, nogil=True)
def weigh_packed_hits(
    origins,
    directions,
    at,
    found_t,
    found_face,
    found_triangle,
    headers,
    words,
    rotations,
    scale,
    scale_exponent,
    t,
    face,
    u,
    v,
    triangle,
):
    """Where on its face each hit lies: only the triangles hit are decoded.

    Args:
        origins: (r, 3) float32.
        directions: (r, 3) float32, not zero where there is a hit.
        at: (k,) int32, the rays that results are for; others are left alone.
        found_t: (k,) float32, t of each.
        found_face: (k,) int32, the reported face; negative on a miss.
        found_triangle: (k,) int32, the triangle in file order.
        headers: (b, 8) uint32.
        words: (w,) uint32.
        rotations: (n,) uint8, places that the reported face's corners were turned to the left; or (0,).
        scale: float32, what positions are multiplied by.
        scale_exponent: Its exponent.
        t: (r,) float32, written.
        face: (r,) int32, written.
        u: (r,) float32, written: the weight of the face's second corner.
        v: (r,) float32, written: the weight of its third corner.
        triangle: (r,) int32, written; -1 on a miss.
    """
    weights = np.zeros(3, np.float32)
    decoded = np.zeros((3, 3), np.float32)
    corners = np.zeros((3, 3), np.float32)
    for k in range(len(at)):
        r = at[k]
        t[r] = found_t[k]
        face[r] = found_face[k]
        if face[r] < 0:
            u[r] = 0.0
            v[r] = 0.0
            triangle[r] = -1
            continue

        # Decode the triangle, and turn it as the tests do.
        triangle[r] = found_triangle[k]
        block = block_of(headers, triangle[r])
        indices = corner_indices(headers, words, block, np.int64(triangle[r]) - np.int64(headers[block, 0]))
        for j in range(3):
            scaled_vertex(headers, words, block, indices[j], scale_exponent, decoded[j])
        turn = first_corner(decoded)
        for j in range(3):
            for axis in range(3):
                corners[j, axis] = decoded[(j + turn) % 3, axis]

        # Weigh its corners, named as the reported face does.
        if len(rotations) > 0:
            turn = (turn + rotations[triangle[r]]) % 3
        weigh_corners(origins, directions, r, scale, corners, turn, weights)
        u[r] = weights[1]
        v[r] = weights[2]
