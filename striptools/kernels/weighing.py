"""Kernels that say where on its face a hit lies: the watertight test's own edge functions, for faces hit.

Source: Woop, Benthin & Wald, "Watertight Ray/Triangle Intersection" (JCGT 2013). Hits are gathered 64 at a
time, in rows of one number each, so that the arithmetic runs over whole registers.

Cost: a third of the time of weighing hits one by one: 12 ns a hit with leaves at hand, up to 20 more where
they are fetched from memory, while the chunk before is weighed.
"""

import numpy as np
from numba import njit

from striptools.kernels.compiled import fetch, inlined, kernel, maker
from striptools.kernels.wide import flushed

CHUNK = 64
"""Hits that are weighed together."""

WAY, START, CORNERS, WEIGHTS = 0, 3 * CHUNK, 6 * CHUNK, 15 * CHUNK

ROOM = 17 * CHUNK
"""Numbers of a chunk, rows of 64: direction and origin along the hit's x, y, z; x of the corners, y, z; then
the weights of the reported face's second corner and third."""


@inlined
def take_ray(origins, directions, r, room, i):
    """Gather a ray as place i, and return its axes: z the dominant one."""
    # Numbers without a sign are not looked at, whether they count from the end.
    r, i = np.uint64(r), np.uint64(i)
    dx, dy, dz = directions[r, 0], directions[r, 1], directions[r, 2]
    ox, oy, oz = origins[r, 0], origins[r, 1], origins[r, 2]
    size_x, size_y, size_z = abs(flushed(dx)), abs(flushed(dy)), abs(flushed(dz))
    along_x = (size_x >= size_y) & (size_x >= size_z)
    along_y = size_y >= size_z
    room[np.uint64(WAY) + i] = dy if along_x else (dz if along_y else dx)
    room[np.uint64(WAY + CHUNK) + i] = dz if along_x else (dx if along_y else dy)
    room[np.uint64(WAY + 2 * CHUNK) + i] = dx if along_x else (dy if along_y else dz)
    room[np.uint64(START) + i] = oy if along_x else (oz if along_y else ox)
    room[np.uint64(START + CHUNK) + i] = oz if along_x else (ox if along_y else oy)
    room[np.uint64(START + 2 * CHUNK) + i] = ox if along_x else (oy if along_y else oz)
    kx = np.uint64(1) if along_x else (np.uint64(2) if along_y else np.uint64(0))
    ky = np.uint64(2) if along_x else (np.uint64(0) if along_y else np.uint64(1))
    return kx, ky, np.uint64(3) - kx - ky


@njit(cache=True, nogil=True, error_model="numpy")
def weigh_chunk(room, turn_of, scale):
    """Weigh the corners of a whole chunk; places that hold no hit get any weights.

    Args:
        room: (1088,) float32; corners are scaled, hold no denormals, and come in the order of the tests.
        turn_of: (64,) int32: corner j is the reported face's (j + turn) % 3.
        scale: float32, what corners were multiplied by.
    """
    for i in range(CHUNK):
        # Take the ray as the walk does, which reads denormals as zero.
        depth = flushed(room[WAY + 2 * CHUNK + i])
        slope_x = flushed(flushed(room[WAY + i]) / depth)
        slope_y = flushed(flushed(room[WAY + CHUNK + i]) / depth)
        ox = flushed(flushed(room[START + i]) * scale)
        oy = flushed(flushed(room[START + CHUNK + i]) * scale)
        oz = flushed(flushed(room[START + 2 * CHUNK + i]) * scale)

        # Shear the corners so that the ray runs along its dominant axis.
        z0 = flushed(room[CORNERS + 6 * CHUNK + i] - oz)
        z1 = flushed(room[CORNERS + 7 * CHUNK + i] - oz)
        z2 = flushed(room[CORNERS + 8 * CHUNK + i] - oz)
        x0 = flushed(flushed(room[CORNERS + i] - ox) - flushed(slope_x * z0))
        x1 = flushed(flushed(room[CORNERS + CHUNK + i] - ox) - flushed(slope_x * z1))
        x2 = flushed(flushed(room[CORNERS + 2 * CHUNK + i] - ox) - flushed(slope_x * z2))
        y0 = flushed(flushed(room[CORNERS + 3 * CHUNK + i] - oy) - flushed(slope_y * z0))
        y1 = flushed(flushed(room[CORNERS + 4 * CHUNK + i] - oy) - flushed(slope_y * z1))
        y2 = flushed(flushed(room[CORNERS + 5 * CHUNK + i] - oy) - flushed(slope_y * z2))

        # Weigh them.
        a = flushed(flushed(x2 * y1) - flushed(y2 * x1))
        b = flushed(flushed(x0 * y2) - flushed(y0 * x2))
        c = flushed(flushed(x1 * y0) - flushed(y1 * x0))
        whole = a + b + c
        inverse = np.float32(1.0) / whole
        inverse = inverse if whole != np.float32(0.0) else np.float32(0.0)
        turn = turn_of[i]
        room[WEIGHTS + i] = (b if turn == 0 else (a if turn == 1 else c)) * inverse
        room[WEIGHTS + CHUNK + i] = (c if turn == 0 else (b if turn == 1 else a)) * inverse


@inlined
def weigh_held(room, held, scale, ray_of, turn_of, u, v):
    """Write u and v of the first `held` places of a chunk, of these rays and turns."""
    weigh_chunk(room, turn_of, scale)
    for k in range(held):
        i = np.uint64(k)
        r = np.uint64(ray_of[i])
        u[r] = room[np.uint64(WEIGHTS) + i]
        v[r] = room[np.uint64(WEIGHTS + CHUNK) + i]


@inlined
def find_slots(place, names, begin, end, slots, numbers, shape):
    """Find where the triangles hit lie, and have their lines fetched: two rows of a block are one."""
    for k in range(begin, end):
        i = np.uint64(k)
        slot = place[np.uint64(names[i])]
        slots[i] = slot
        first = (slot >> 5) * shape[0] * shape[1]
        for row in range(0, 10, 2):
            fetch(numbers, first + row * shape[1])


@inlined
def take_corners(numbers, first, across, axes, room, i):
    """Gather corners as place i along these axes: from `first` on, in nine rows that are `across` apart."""
    for axis in range(3):
        row = first + axes[axis] * np.uint64(3) * across
        for j in range(3):
            room[np.uint64(CORNERS + (3 * axis + j) * CHUNK) + i] = numbers[row + np.uint64(j) * across]


@inlined
def gather_from_blocks(origins, directions, numbers, shape, rays, slots, begin, end, room, turn_of):
    """Gather rays and corners of hits."""
    size, across = np.uint64(shape[0] * shape[1]), np.uint64(shape[1])
    for k in range(begin, end):
        i = np.uint64(k - begin)
        axes = take_ray(origins, directions, rays[np.uint64(k)], room, i)
        slot = np.uint64(slots[np.uint64(k)])
        first = (slot >> np.uint64(5)) * size + (slot >> np.uint64(2) & np.uint64(7))
        take_corners(numbers, first, across, axes, room, i)
        turn_of[i] = slot & np.uint64(3)


@maker
def note_hits(at, found_t, found, t):
    """Write t of rays that hit something; return these rays and the names of what they hit, (h,) int32."""
    rays, names = np.empty(len(at), np.int32), np.empty(len(at), np.int32)
    held = 0
    for k in range(len(at)):
        # Without a branch, which would go astray: whether a ray hits anything is hard to foresee.
        rays[np.uint64(held)] = k
        held += np.int64((at[k] >= 0) & (found[k] >= 0))
    for j in range(held):
        i = np.uint64(j)
        k = np.uint64(rays[i])
        rays[i], names[i] = at[k], found[k]
        t[np.uint64(at[k])] = found_t[k]
    return rays[:held], names[:held]


@kernel
def weigh_hits(
    origins, directions, at, found_t, found_face, place, blocks, scale, triangle_of, t, face, u, v, triangle
):
    """Where on its face each hit lies, from the leaf blocks. Nothing is written of rays that hit nothing.

    Args:
        origins: (r, 3) float32.
        directions: (r, 3) float32, not zero where there is a hit.
        at: (k,) int32, the rays that results are for, negative for none.
        found_t: (k,) float32, t of each.
        found_face: (k,) int32, the reported face; negative on a miss.
        place: (f,) int32, see `fill_leaf_blocks`.
        blocks: (l, 10, 8) float32, see `fill_leaf_blocks`; or without the last row, or of one lane.
        scale: float32, what positions in `blocks` were multiplied by.
        triangle_of: (f,) int32, the triangle in file order of each face; (0,) where faces are triangles.
        t: (r,) float32, written.
        face: (r,) int32, written.
        u: (r,) float32, written: the weight of the face's second corner; (0,) where no weights are wanted.
        v: (r,) float32, written: the weight of its third corner; or (0,).
        triangle: (r,) int32, written.
    """
    rays, names = note_hits(at, found_t, found_face, t)
    for k in range(len(rays)):
        i = np.uint64(k)
        r, name = np.uint64(rays[i]), np.uint64(names[i])
        face[r] = name
        triangle[r] = triangle_of[name] if len(triangle_of) > 0 else name
    if len(u) == 0:
        return
    room = np.zeros(ROOM, np.float32)
    turn_of = np.zeros(CHUNK, np.int32)
    slots = np.empty(len(rays), np.int32)
    numbers, shape = blocks.reshape(blocks.size), blocks.shape[1:]
    for begin in range(-CHUNK, len(rays), CHUNK):
        # The lines that the next chunk needs are fetched while this one is weighed.
        end = min(begin + CHUNK, len(rays))
        find_slots(place, names, end, min(end + CHUNK, len(rays)), slots, numbers, shape)
        if begin >= 0:
            gather_from_blocks(origins, directions, numbers, shape, rays, slots, begin, end, room, turn_of)
            weigh_held(room, end - begin, scale, rays[begin:end], turn_of, u, v)


@kernel
def mark_hits(at, found, hit):
    """Whether each ray hits anything.

    Args:
        at: (k,) int32, the rays that results are for, negative for none; others are left alone.
        found: (k,) int32, negative on a miss.
        hit: (r,) bool, written.
    """
    for k in range(len(at)):
        if at[k] >= 0:
            hit[at[k]] = found[k] >= 0
