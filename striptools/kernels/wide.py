"""Kernels of the collapse of a binary hierarchy to nodes of 8 or 16 children, and of leaf blocks."""

import numpy as np

from striptools.kernels.boxes import area_of
from striptools.kernels.compiled import helper, inlined, kernel

WIDTH = 8
"""Children of a node of a scene file and triangles of a leaf block: the float32 lanes of one AVX register."""

BROAD = 16
"""Children of a node of a hierarchy that is made for a CPU: a quarter fewer steps, which wait for memory."""

LEAST_NORMAL = np.float32(np.finfo(np.float32).tiny)

EMPTY = np.int32(-(2**31))
"""The child of an empty lane."""


@kernel
def cheapest_forests(boxes, size, width, leaf_size, node_cost, leaf_cost, lane_cost, node_price):
    """For each binary node, the cheapest way to stand for it with at most 1 to `width` wide children.

    Args:
        boxes: (2n-1, 6) float32, preorder.
        size: (2n-1,) int32, triangles below each node.
        width: Children of a node, `WIDTH` or `BROAD`.
        leaf_size: The most triangles of a leaf.
        node_cost: The cost of visiting a wide node.
        leaf_cost: The cost of testing a full leaf.
        lane_cost: What a leaf costs more for each triangle that it might have held besides.
        node_price: What a wide node costs beside its visits, in visits of the root: a saving below it is not
            worth another node.

    Returns:
        split: (2n-1, width + 1) int8; `split[p, j]`, j >= 2, says how many of j children the left subtree
            gets, 0 means that fewer than j are as cheap; `split[p, width]` is the split of p as a wide node
            of its own.
        as_leaf: (2n-1,) bool, p standing alone is cheapest as a leaf.
        cost: The expected cost of the whole tree for a ray that meets the root's box, and the prices.
    """
    count = len(size)
    cost = np.empty((count, width), np.float32)
    split = np.zeros((count, width + 1), np.int8)
    as_leaf = np.zeros(count, np.bool_)
    root = area_of(boxes, 0)
    unit = 1.0 / root if root > 0.0 else 1.0
    for p in range(count - 1, -1, -1):
        area = np.float32(area_of(boxes, p) * unit)

        # Let a single triangle be a leaf however many children are on offer.
        leaf = area * (leaf_cost + lane_cost * np.float32(leaf_size - size[p]))
        if size[p] == 1:
            as_leaf[p] = True
            for j in range(1, width):
                cost[p, j] = leaf
            continue

        # Find the cheapest way to give all children to the two subtrees.
        left = p + 1
        right = p + 2 * size[left]
        best = np.float32(np.inf)
        for k in range(1, width):
            c = cost[left, k] + cost[right, width - k]
            if c < best or k == 1:
                best = c
                split[p, width] = k

        # Choose between a wide node and, where the triangles are few enough, a leaf.
        inner = best + area * node_cost + node_price
        if size[p] <= leaf_size and leaf <= inner:
            as_leaf[p] = True
            cost[p, 1] = leaf
        else:
            cost[p, 1] = inner

        # Offer two children and more, unless fewer are as cheap.
        for j in range(2, width):
            best = cost[p, j - 1]
            for k in range(1, j):
                c = cost[left, k] + cost[right, j - k]
                if c < best:
                    best = c
                    split[p, j] = k
            cost[p, j] = best
    return split, as_leaf, cost[0, 1]


@helper
def gather_children(p, size, split, nodes, budget, children):
    """Write the binary nodes that become the children of the wide node at p, in order; return how many."""
    width = split.shape[1] - 1
    nodes[0] = p + 2 * size[p + 1]
    budget[0] = width - split[p, width]
    nodes[1] = p + 1
    budget[1] = split[p, width]
    held = 2
    found = 0
    while held > 0:
        held -= 1
        c = nodes[held]
        j = budget[held]
        while j > 1 and split[c, j] == 0:
            j -= 1
        if j == 1 or size[c] == 1:
            children[found] = c
            found += 1
        else:
            k = split[c, j]
            nodes[held] = c + 2 * size[c + 1]
            budget[held] = j - k
            nodes[held + 1] = c + 1
            budget[held + 1] = k
            held += 2
    return found


@inlined
def fit_of(x, y, z, lane, width):
    """How well a child so far from its node's centre lies in a lane.

    The bits of a lane say on which side of the centre it lies, x lowest. Of sixteen lanes one bit below those
    says on which side of the half; along which axis makes no difference.
    """
    if width == BROAD:
        x = x * (1.5 if (lane ^ lane >> 1) & 1 == 0 else 0.5)
        lane >>= 1
    return (x if lane & 1 else -x) + (y if lane & 2 else -y) + (z if lane & 4 else -z)


@helper
def assign_lanes(boxes, p, children, found, lane_of):
    """Give each child of p one of the lanes, of which `lane_of` has as many; best fits first."""
    width = len(lane_of)
    taken = 0
    for i in range(found):
        lane_of[i] = -1
    for _ in range(found):
        best = -np.inf
        best_child = -1
        best_lane = -1
        for i in range(found):
            if lane_of[i] >= 0:
                continue
            c = children[i]
            x = np.float64(boxes[c, 0]) + boxes[c, 3] - boxes[p, 0] - boxes[p, 3]
            y = np.float64(boxes[c, 1]) + boxes[c, 4] - boxes[p, 1] - boxes[p, 4]
            z = np.float64(boxes[c, 2]) + boxes[c, 5] - boxes[p, 2] - boxes[p, 5]
            for lane in range(width):
                if (taken >> lane) & 1:
                    continue
                fit = fit_of(x, y, z, lane, width)
                if fit > best or best_child < 0:
                    best = fit
                    best_child = i
                    best_lane = lane
        lane_of[best_child] = best_lane
        taken |= 1 << best_lane


@kernel
def emit_wide(boxes, size, split, as_leaf):
    """Lay out the wide nodes that `cheapest_forests` chose.

    Returns:
        wide_boxes: (w, 6, width) float32, lo xyz and hi xyz by lane, inverted (inf, -inf) in empty lanes.
        child: (w, width) int32, a node, -(leaf + 1), or EMPTY; a node comes after its parent.
        leaf_first, leaf_count: (l,) int32, the run of triangles of each leaf.
        depth: The most nodes on a way from the root to a leaf.
    """
    width = split.shape[1] - 1
    limit = max(1, len(size) // 2)
    wide_boxes = np.empty((limit, 6, width), np.float32)
    child = np.full((limit, width), EMPTY, np.int32)
    source = np.empty(limit, np.int32)
    level = np.empty(limit, np.int32)
    start = np.empty(limit, np.int32)
    leaf_first = np.empty(len(size) // 2 + 1, np.int32)
    leaf_count = np.empty(len(size) // 2 + 1, np.int32)
    pending = np.empty(limit + width, np.int32)
    nodes = np.empty(4 * width, np.int64)
    budget = np.empty(4 * width, np.int64)
    children = np.empty(width, np.int64)
    lane_of = np.empty(width, np.int64)
    source[0] = 0
    level[0] = 1
    start[0] = 0
    pending[0] = 0
    waiting = 1
    wide = 1
    leaves = 0
    depth = 1
    while waiting > 0:
        waiting -= 1
        w = pending[waiting]
        p = source[w]
        depth = max(depth, level[w])

        # Choose the children; a root of one triangle is its own only child.
        if size[p] == 1:
            children[0] = p
            found = 1
        else:
            found = gather_children(p, size, split, nodes, budget, children)
        assign_lanes(boxes, p, children, found, lane_of)
        wide_boxes[w, :3, :] = np.inf
        wide_boxes[w, 3:, :] = -np.inf

        # Write each child in its lane: a leaf at once, a node to be filled later.
        first = start[w]
        for i in range(found):
            c = children[i]
            lane = lane_of[i]
            for k in range(6):
                wide_boxes[w, k, lane] = boxes[c, k]
            if as_leaf[c]:
                leaf_first[leaves] = first
                leaf_count[leaves] = size[c]
                child[w, lane] = -(leaves + 1)
                leaves += 1
            else:
                source[wide] = c
                start[wide] = first
                level[wide] = level[w] + 1
                child[w, lane] = wide
                wide += 1
            first += size[c]

        # Go on with the first child: nodes that are visited together lie together.
        for i in range(found - 1, -1, -1):
            c = child[w, lane_of[i]]
            if c >= 0:
                pending[waiting] = c
                waiting += 1
    return (
        wide_boxes[:wide].copy(),
        child[:wide].copy(),
        leaf_first[:leaves].copy(),
        leaf_count[:leaves].copy(),
        depth,
    )


@kernel
def flushed(value):
    """Zero for a denormal float32, as XLA has it."""
    return value if abs(value) >= LEAST_NORMAL else np.float32(0.0)


@inlined
def scaled(value, scale):
    """A float32 times a power of two as the walks have it: zero where that is no normal number."""
    exact = np.float64(value) * np.float64(scale)
    return np.float32(exact) if abs(exact) >= np.float64(LEAST_NORMAL) else np.float32(0.0)


@inlined
def precedes(x, y, z, other_x, other_y, other_z):
    """Whether one corner is smaller than another by x, then y, then z: without branches."""
    below = (y < other_y) | ((y == other_y) & (z < other_z))
    return (x < other_x) | ((x == other_x) & below)


@inlined
def comes_before(corners, a, b):
    """Whether corner a of a triangle, (3, 3), precedes corner b."""
    return precedes(corners[a, 0], corners[a, 1], corners[a, 2], corners[b, 0], corners[b, 1], corners[b, 2])


@inlined
def first_corner(corners):
    """The corner that comes first in the one order that all tests use: the smallest, the first of equals."""
    turn = 0
    for j in range(1, 3):
        if comes_before(corners, j, turn):
            turn = j
    return turn


@kernel
def fill_leaf_blocks(
    positions, faces, ids, rotations, scale, leaf_first, leaf_count, blocks, block_bits, place
):
    """Write the triangles of each leaf, lane by lane, in the one corner order that all tests use.

    A triangle is turned, its winding kept, until its smallest scaled corner by (x, y, z) comes first:
    whatever strip, file order or remap it came by, its arithmetic is the same.

    Args:
        positions: (v, 3) float32.
        faces: (n, 3) int32 in file order.
        ids: (n,) int32, the face that a hit on each triangle is reported as.
        rotations: (n,) uint8, places that the reported face's corners were turned to the left in `faces`.
        scale: float32 power of two that positions are multiplied by.
        leaf_first: (l,) int32.
        leaf_count: (l,) int32.
        blocks: (>= l, 10, 8) float32, written: x of corners a, b, c, then y, then z; other lanes untouched.
        block_bits: The same memory as int32; row 9 is written: the reported faces.
        place: (>= max(ids) + 1,) int32, written: `(leaf * 8 + lane) * 4 + turn` of each face, where
            canonical corner j is the reported face's corner (j + turn) % 3.
    """
    corners = np.empty((3, 3), np.float32)
    for q in range(len(leaf_first)):
        for lane in range(leaf_count[q]):
            t = leaf_first[q] + lane
            for j in range(3):
                for axis in range(3):
                    corners[j, axis] = scaled(positions[faces[t, j], axis], scale)
            turn = first_corner(corners)
            for j in range(3):
                for axis in range(3):
                    blocks[q, 3 * axis + j, lane] = corners[(j + turn) % 3, axis]
            block_bits[q, 9, lane] = ids[t]
            place[ids[t]] = (q * WIDTH + lane) * 4 + (turn + rotations[t]) % 3
