"""The loops of the baselines: STRIPE-like greedy strips, Tipsify's order, and cutting an order into strips.

A *join* is a pair of half-edges of two free faces, on one ring and run in opposite directions; the *degree*
of a free face is the number of its joins. A half-edge is 3 * face + slot.
"""

import numpy as np
from numba import njit

from striptools.kernels.compiled import helper, kernel, maker
from striptools.kernels.strip_topology import slots_after

NONE = -1


@njit(cache=True, nogil=True, inline="always")
def _is_join(faces, free, h, g):
    """Whether half-edge g of another, free face runs against half-edge h on the same ring."""
    f = h // 3
    u = g // 3
    return u != f and free[u] and faces[f, h % 3] != faces[u, g % 3]


@helper
def _unlink(face, degree, first, last, before, after):
    """Take a face out of the list of its degree."""
    b = before[face]
    a = after[face]
    if b == NONE:
        first[degree[face]] = a
    else:
        after[b] = a
    if a == NONE:
        last[degree[face]] = b
    else:
        before[a] = b


@helper
def _append(face, degree, first, last, before, after):
    """Put a face at the end of the list of its degree."""
    end = last[degree[face]]
    before[face] = end
    after[face] = NONE
    last[degree[face]] = face
    if end == NONE:
        first[degree[face]] = face
    else:
        after[end] = face


@kernel
def _take(face, ring, faces, free, degree, first, last, before, after):
    """Take a face out of the free ones; each of its joins costs its neighbour a degree."""
    _unlink(face, degree, first, last, before, after)
    free[face] = False
    for h in range(3 * face, 3 * face + 3):
        g = ring[h]
        while g != h:
            if _is_join(faces, free, h, g):
                u = g // 3
                _unlink(u, degree, first, last, before, after)
                degree[u] -= 1
                _append(u, degree, first, last, before, after)
            g = ring[g]


@helper
def _look_ahead(u, entry, ring, faces, free, degree, nothing):
    """The least degree among the joins that face u has left when entered by a half-edge."""
    least = nothing
    for h in range(3 * u, 3 * u + 3):
        g = ring[h]
        while g != h:
            if h != entry and _is_join(faces, free, h, g):
                least = min(least, degree[g // 3])
            g = ring[g]
    return least


@helper
def _best_step(face, entry, ring, faces, free, degree, nothing):
    """The half-edges by which a strip leaves a face and enters the next one, (-1, -1) where it ends."""
    leave = NONE
    enter = NONE
    least = nothing
    least_ahead = NONE
    for h in range(3 * face, 3 * face + 3):
        g = ring[h]
        while g != h:
            if h != entry and _is_join(faces, free, h, g):
                here = degree[g // 3]
                if here < least:
                    leave, enter, least, least_ahead = h, g, here, NONE
                elif here == least:
                    # Break the tie one level ahead, and look there only once for the best so far.
                    if least_ahead == NONE:
                        least_ahead = _look_ahead(enter // 3, enter, ring, faces, free, degree, nothing)
                    ahead = _look_ahead(g // 3, g, ring, faces, free, degree, nothing)
                    if ahead < least_ahead:
                        leave, enter, least_ahead = h, g, ahead
            g = ring[g]
    return leave, enter


@kernel
def stripe_like(ring, faces, most, order, starts):
    """Write the faces strip after strip into order (n,) and starts (n+1,); returns the number of strips."""
    count = faces.shape[0]
    free = np.ones(count, np.bool_)
    degree = np.zeros(count, np.int32)
    before = np.full(count, NONE, np.int32)
    after = np.full(count, NONE, np.int32)
    # Count the joins of every face.
    highest = 0
    for face in range(count):
        for h in range(3 * face, 3 * face + 3):
            g = ring[h]
            while g != h:
                if _is_join(faces, free, h, g):
                    degree[face] += 1
                g = ring[g]
        highest = max(highest, degree[face])
    # List the faces by degree, ascending in each list.
    first = np.full(highest + 1, NONE, np.int32)
    last = np.full(highest + 1, NONE, np.int32)
    for face in range(count):
        _append(face, degree, first, last, before, after)
    strips = 0
    position = 0
    while position < count:
        # Start at the face that has had the least degree for longest.
        lowest = 0
        while first[lowest] == NONE:
            lowest += 1
        seed = first[lowest]
        begin = position
        starts[strips] = begin
        strips += 1
        order[position] = seed
        position += 1
        _take(seed, ring, faces, free, degree, first, last, before, after)
        # Grow one end until it is stuck, then turn the strip over and grow the other.
        entry = NONE
        used = NONE
        for _ in range(2):
            face = order[position - 1]
            while position - begin < most:
                leave, enter = _best_step(face, entry, ring, faces, free, degree, highest + 1)
                if leave == NONE:
                    break
                if used == NONE and face == seed:
                    used = leave
                entry = enter
                face = enter // 3
                order[position] = face
                position += 1
                _take(face, ring, faces, free, degree, first, last, before, after)
            order[begin:position] = order[begin:position][::-1].copy()
            entry = used
    starts[strips] = position
    return strips


@maker
def corners_of_vertices(faces, vertex_count):
    """Where the corners of each vertex stand: first (v+1,), corner (3n,) = 3 * face + slot, ascending."""
    first = np.zeros(vertex_count + 1, np.int32)
    # Count the corners of each vertex.
    for face in range(faces.shape[0]):
        for slot in range(3):
            first[faces[face, slot] + 1] += 1
    for v in range(vertex_count):
        first[v + 1] += first[v]
    # Deal the corners out.
    corner = np.empty(3 * faces.shape[0], np.int32)
    free = first[:vertex_count].copy()
    for face in range(faces.shape[0]):
        for slot in range(3):
            v = faces[face, slot]
            corner[free[v]] = 3 * face + slot
            free[v] += 1
    return first, corner


@helper
def _beside(c, side, faces):
    """The vertex of the face of corner c that comes right after (side 0) or right before (1) that corner."""
    return faces[c // 3, (c % 3 + 1 + side) % 3]


@helper
def _way_on(v, begin, end, corner, faces, emitted, before):
    """How a fan round v goes on from the face `before`: its corner there and the side, (-1, 0) for nohow."""
    here = NONE
    for c in range(3 * before, 3 * before + 3):
        if faces[before, c % 3] == v:
            here = c
            break
    if here == NONE:
        return NONE, 0
    # A neighbour to the left starts where this face ends; one to the right ends where this face starts.
    for side in range(2):
        for k in range(begin, end):
            c = corner[k]
            if not emitted[c // 3] and _beside(c, side, faces) == _beside(here, 1 - side, faces):
                return here, side
    return NONE, 0


@helper
def _turn_round(c, side, faces, emitted, head, link, order, position):
    """Emit the face of corner c, then its neighbours on one side round that vertex; returns the place."""
    while c != NONE:
        face = c // 3
        if not emitted[face]:
            emitted[face] = True
            order[position] = face
            position += 1
        x = _beside(c, 1 - side, faces)
        c = head[x]
        while c != NONE and emitted[c // 3]:
            c = link[c]
        head[x] = c
    return position


@helper
def _fan(v, faces, first, corner, emitted, head, pending, link, order, position):
    """Emit every face round vertex v that is not yet emitted, in runs of neighbours; returns the place.

    head (v,) and pending (v,) come all -1 and 0, and are left so.
    """
    begin = first[v]
    end = first[v + 1]
    on = NONE
    side = 0
    if position > 0:
        on, side = _way_on(v, begin, end, corner, faces, emitted, order[position - 1])
    # List the corners by the vertex their face is entered at, and count them by the one it is left at.
    for k in range(end - 1, begin - 1, -1):
        c = corner[k]
        if not emitted[c // 3]:
            a = _beside(c, side, faces)
            link[c] = head[a]
            head[a] = c
            pending[_beside(c, 1 - side, faces)] += 1
    # Go on from the face before, where that leads into this fan.
    position = _turn_round(on, side, faces, emitted, head, link, order, position)
    # Start at the beginning of each run, then anywhere in what goes all the way round.
    for closed in range(2):
        for k in range(begin, end):
            c = corner[k]
            if not emitted[c // 3] and (closed or pending[_beside(c, side, faces)] == 0):
                position = _turn_round(c, side, faces, emitted, head, link, order, position)
    # Clear the marks.
    for k in range(begin, end):
        c = corner[k]
        head[_beside(c, side, faces)] = NONE
        pending[_beside(c, 1 - side, faces)] = 0
    return position


@helper
def _next_vertex(begin, end, stack, live, stamp, time, cache_size):
    """The best fanning vertex among stack[begin:end]: the oldest that stays cached while it is fanned."""
    best = NONE
    best_age = NONE
    for k in range(begin, end):
        v = stack[k]
        if live[v] == 0:
            continue
        age = 0
        if time - stamp[v] + 2 * live[v] <= cache_size:
            age = time - stamp[v]
        if age > best_age:
            best = v
            best_age = age
    return best


@kernel
def tipsify(faces, vertex_count, cache_size, order):
    """Write the faces into order (n,) as Tipsify emits them."""
    count = faces.shape[0]
    first, corner = corners_of_vertices(faces, vertex_count)
    live = first[1:] - first[:-1]
    stamp = np.zeros(vertex_count, np.int64)
    emitted = np.zeros(count, np.bool_)
    head = np.full(vertex_count, NONE, np.int32)
    pending = np.zeros(vertex_count, np.int32)
    link = np.full(3 * count, NONE, np.int32)
    stack = np.empty(3 * count, np.int32)
    time = cache_size + 1
    height = 0
    cursor = 0
    position = 0
    v = NONE
    while position < count:
        # Out of candidates: unwind the dead-end stack, then take vertices in the order of the input.
        while v == NONE and height > 0:
            height -= 1
            if live[stack[height]] > 0:
                v = stack[height]
        while v == NONE:
            if live[cursor] > 0:
                v = cursor
            cursor += 1
        # Emit the fan.
        begin = height
        emitted_before = position
        position = _fan(v, faces, first, corner, emitted, head, pending, link, order, position)
        # Play the cache: each corner of each face is a candidate and may enter it anew.
        for k in range(emitted_before, position):
            for slot in range(3):
                w = faces[order[k], slot]
                stack[height] = w
                height += 1
                live[w] -= 1
                if time - stamp[w] > cache_size:
                    stamp[w] = time
                    time += 1
        v = _next_vertex(begin, height, stack, live, stamp, time, cache_size)


@kernel
def cut_into_strips(faces, order, most, starts):
    """Cut an order of faces wherever one cannot follow the one before, or a strip is full.

    Fills starts (n+1,) and returns the number of strips.
    """
    strips = 0
    begin = 0
    entered = 0
    for k in range(order.shape[0]):
        # Follow the sets of slots by which each face can be entered.
        follows = k > 0 and k - begin < most
        entered = slots_after(faces, order[k - 1], entered, order[k]) if follows else 0
        if entered == 0:
            begin = k
            starts[strips] = k
            strips += 1
    starts[strips] = order.shape[0]
    return strips
