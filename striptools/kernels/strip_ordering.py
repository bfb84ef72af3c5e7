"""Strip-RT joins in rounds: the loops behind strips/ordering.py.

Faces are numbered by their place in the tree here (`renumber`), so that neighbours lie near each other in
memory. A *sequence* is named by the least of the sequences it was joined from, and those of one face by that
face. A *half-edge* is 3 * face + slot; a sequence is left through `h` and the next entered through `g`. A
*proposal* is named by the sequence that makes it.

The helpers of the inner loops are inlined and take plain arrays: passing many arrays, or reaching for them
inside a tuple, made the whole ordering take 1.4 times as long.
"""

from collections import namedtuple

import numpy as np
from numba import njit

from striptools.kernels.compiled import helper, kernel

State = namedtuple("State", "ends length node level owner mate links")
"""ends (n, 2) the end faces of each sequence; length (n,) its faces, 0 once joined to another; node (n,) its
tree node and level (n,) the depth of that; owner (n,) the sequence of a face, right at ends only; mate (3n,)
the half-edge linked to this one or -1; links (n,) uint8 the links of a face."""

Proposals = namedtuple("Proposals", "partner score leave enter")
"""By sequence: whom it wants to join (-1 no one), how much, and through which two half-edges."""


@kernel
def renumber(faces, ring, order, place, new_faces, new_ring):
    """Number faces and half-edges by place: face order[i] becomes face i, order[place[f]] = f."""
    for i in range(order.shape[0]):
        face = order[i]
        for slot in range(3):
            new_faces[i, slot] = faces[face, slot]
            g = ring[3 * face + slot]
            new_ring[3 * i + slot] = 3 * place[g // 3] + g % 3


@njit(cache=True, nogil=True, inline="always")
def steps_to_common(a, b, parent, size):
    """How many steps up from node a lies the lowest node that holds node b too."""
    steps = 0
    while not a <= b < a + 2 * size[a] - 1:
        a = parent[a]
        steps += 1
    return steps


@njit(cache=True, nogil=True, inline="always")
def may_join(s, h, g, faces, length, owner, mate, links, most):
    """Whether sequence s may go on through its open half-edge h into the half-edge g of another sequence."""
    u = g // 3
    # Refuse faces inside a sequence and edges both faces run the same way.
    if links[u] > 1 or mate[g] >= 0 or faces[h // 3, h % 3] == faces[u, g % 3]:
        return False
    # Refuse closed rings and sequences that would grow too long.
    r = owner[u]
    return r != s and length[r] + length[s] <= most


@helper
def comes_before(score, s, r, best_score, best_s, best_r):
    """Whether a pair is better than the best so far: higher score, then smaller pair of indices."""
    if score != best_score:
        return score > best_score
    low = min(s, r)
    best_low = min(best_s, best_r)
    if low != best_low:
        return low < best_low
    return max(s, r) < max(best_s, best_r)


@njit(cache=True, nogil=True, inline="always")
def gather(
    s,
    ring,
    faces,
    ends,
    length,
    node,
    level,
    owner,
    mate,
    links,
    parent,
    size,
    most,
    leave,
    enter,
    partner,
    distance,
):
    """List the joins open to a sequence: half-edges, sequence, tree path length; returns how many."""
    count = 0
    for end in range(2):
        t = ends[s, end]
        # A lone face has one end with three open edges.
        if end == 1 and t == ends[s, 0]:
            break
        for slot in range(3):
            h = 3 * t + slot
            if mate[h] >= 0:
                continue
            g = ring[h]
            while g != h:
                if may_join(s, h, g, faces, length, owner, mate, links, most):
                    r = owner[g // 3]
                    up = steps_to_common(node[s], node[r], parent, size)
                    leave[count] = h
                    enter[count] = g
                    partner[count] = r
                    distance[count] = level[r] - level[s] + 2 * up
                    count += 1
                g = ring[g]
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def propose(active, ring, faces, state, parent, size, most, distance_weight, balance_weight, room, wanted):
    """Let each active sequence choose its best join by the score of strips/ordering.py."""
    ends, length, node, level, owner, mate, links = state
    leave = np.empty(room, np.int32)
    enter = np.empty(room, np.int32)
    partner = np.empty(room, np.int32)
    distance = np.empty(room, np.int64)
    for s in active:
        count = gather(
            s,
            ring,
            faces,
            ends,
            length,
            node,
            level,
            owner,
            mate,
            links,
            parent,
            size,
            most,
            leave,
            enter,
            partner,
            distance,
        )
        # Find the farthest of this sequence's candidates.
        farthest = 1
        for k in range(count):
            farthest = max(farthest, distance[k])
        # Keep the best candidate; for one partner the least half-edges.
        best = -1
        best_r = -1
        best_score = 0.0
        n1 = np.float64(length[s])
        for k in range(count):
            r = partner[k]
            n2 = np.float64(length[r])
            near = 1.0 - distance[k] / farthest
            balance = 4.0 * n1 * n2 / ((n1 + n2) * (n1 + n2))
            score = distance_weight * near + balance_weight * balance
            if r == best_r:
                better = leave[k] < leave[best] or (leave[k] == leave[best] and enter[k] < enter[best])
            else:
                better = best < 0 or comes_before(score, s, r, best_score, s, best_r)
            if better:
                best = k
                best_r = r
                best_score = score
        # Write the proposal down.
        wanted.partner[s] = best_r
        if best >= 0:
            wanted.score[s] = best_score
            wanted.leave[s] = leave[best]
            wanted.enter[s] = enter[best]


@njit(cache=True, nogil=True, inline="always")
def best_proposal(x, partner, score, taken, first_suitor, next_suitor):
    """The best proposal between sequence x and one not yet taken, made by either; -1 if there is none."""
    best = -1
    # Start from the one that x makes.
    if partner[x] >= 0 and not taken[partner[x]]:
        best = x
    # Compare those made to x; of two equal ones between the same pair the smaller proposer's stands.
    s = first_suitor[x]
    while s >= 0:
        if not taken[s]:
            if best < 0 or comes_before(
                score[s], s, x, score[best], best, partner[best]
            ):  # fmt: skip
                best = s
            elif score[s] == score[best] and partner[best] == s and partner[s] == best:
                best = min(best, s)
        s = next_suitor[s]
    return best


@kernel
def match(active, wanted, taken, first_suitor, next_suitor, path, accepted):
    """Accept proposals from the best down, each that meets two free sequences; returns how many.

    No sorting: a proposal that is the best of both its sequences is accepted at any time, and following the
    best proposal from sequence to sequence climbs to such a one, because the order of proposals is total.
    """
    partner = wanted.partner
    score = wanted.score
    # List the suitors of each sequence.
    for s in active:
        first_suitor[s] = -1
        taken[s] = False
    for s in active:
        r = partner[s]
        if r >= 0:
            next_suitor[s] = first_suitor[r]
            first_suitor[r] = s
    # Climb from each free sequence, and back down the path as pairs are taken.
    count = 0
    for start in active:
        if taken[start]:
            continue
        path[0] = start
        steps = 1
        while steps > 0:
            x = path[steps - 1]
            p = -1 if taken[x] else best_proposal(x, partner, score, taken, first_suitor, next_suitor)
            if p < 0:
                steps -= 1
                continue
            y = partner[p] if p == x else p
            if best_proposal(y, partner, score, taken, first_suitor, next_suitor) == p:
                taken[x] = True
                taken[y] = True
                accepted[count] = p
                count += 1
                steps -= 1
            else:
                path[steps] = y
                steps += 1
    return count


@kernel
def join(accepted, wanted, state, parent, size):
    """Join the two sequences of each accepted proposal under the smaller name."""
    for p in accepted:
        r = wanted.partner[p]
        h = wanted.leave[p]
        g = wanted.enter[p]
        # Link the two half-edges.
        state.mate[h] = g
        state.mate[g] = h
        state.links[h // 3] += 1
        state.links[g // 3] += 1
        # Find the two ends that stay open.
        one = state.ends[p, 1] if state.ends[p, 0] == h // 3 else state.ends[p, 0]
        other = state.ends[r, 1] if state.ends[r, 0] == g // 3 else state.ends[r, 0]
        # Merge under the smaller name, at the lowest common ancestor.
        low = min(p, r)
        high = max(p, r)
        up = steps_to_common(state.node[p], state.node[r], parent, size)
        state.level[low] = state.level[p] - up
        node = state.node[p]
        for _ in range(up):
            node = parent[node]
        state.node[low] = node
        state.length[low] += state.length[high]
        state.length[high] = 0
        state.ends[low, 0] = one
        state.ends[low, 1] = other
        state.owner[one] = low
        state.owner[other] = low


@kernel
def still_active(active, wanted, state):
    """Keep, in place, the sequences that found a join this round and still stand; returns how many."""
    count = 0
    for s in active:
        if wanted.partner[s] >= 0 and state.length[s] > 0:
            active[count] = s
            count += 1
    return count


@kernel
def longest_ring(ring):
    """The most half-edges on one ring."""
    longest = 1
    for h in range(ring.shape[0]):
        count = 1
        g = ring[h]
        # Count each ring once, from its least half-edge.
        while g > h:
            count += 1
            g = ring[g]
        longest = max(longest, count)
    return longest


@kernel
def walk_links(mate, links, order, starts):
    """Write the faces of each sequence in a row, from its end of smaller index; returns how many."""
    done = np.zeros(links.shape[0], np.bool_)
    sequences = 0
    position = 0
    for first in range(links.shape[0]):
        if done[first] or links[first] == 2:
            continue
        starts[sequences] = position
        sequences += 1
        # Follow the links from face to face, never back through the one that led here.
        face = first
        came = -1
        while face >= 0:
            order[position] = face
            position += 1
            done[face] = True
            leave = -1
            for slot in range(3):
                if mate[3 * face + slot] >= 0 and 3 * face + slot != came:
                    leave = 3 * face + slot
            came = mate[leave] if leave >= 0 else -1
            face = came // 3 if leave >= 0 else -1
    starts[sequences] = position
    return sequences
