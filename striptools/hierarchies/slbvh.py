"""The stackless linear BVH: a heap of nodes that a bit trail walks.

Source: Murguia et al., "Bit-Trail Traversal for Stackless LBVH on DirectCompute" (GPU Pro 4, 2013): heap
order, the node of 32 bytes, the trail (`trace/walk_slbvh.py`).

Differences and decisions:
1. A heap has the least depth there is for its leaves. "sah" halves by count, the left half the larger, along
   the axis whose halves cost least by the surface area heuristic (of equal ones that of the widest centres);
   centres in order, equal ones by index. "morton" splits the order of the Morton codes of the box centres
   where their highest bit changes, or as near to there as leaves room in the levels below, and halves equal
   codes.
2. The axis of a "morton" node, by which the near child is found, is the one along which its right child's
   box lies farthest behind its left child's.
3. An inner node's PrimCount and PrimPos tell what lies below it; an empty node is 32 bytes of zeros, as
   node 0 is.
4. A leaf holds at most `LARGEST_LEAF` objects: eight triangles, as many as are tested at once, or one strip
   or block.
5. Depth and bytes are known, and refused, before anything is built.

Cost: "morton" O(p), "sah" O(p log p); 32 bytes a node, and two nodes a leaf at least and four at most.
"""

from dataclasses import dataclass

import numpy as np

from striptools.errors import LimitError, UnreadableSceneError, UsageError
from striptools.hierarchies.options import HierarchyOptions, OverName
from striptools.kernels import slbvh as kernels
from striptools.kernels.morton import morton_codes, radix_order
from striptools.kernels.slbvh import COUNT_SHIFT, LEAF, PRIM_COUNT, PRIM_POS
from striptools.partition.boxes import range_boxes
from striptools.partition.object_split import SMALLEST_JOB, check_boxes
from striptools.threads import run_jobs
from striptools.types import Boxes, Counts

MOST_DEPTH = 30
"""Levels below the root that a trail of 32 bits can tell: at 31 the trail plus one is zero."""

MOST_OBJECTS = 2**29 - 1
"""What the 29 bits of a PrimCount can tell."""

NODE_BYTES = 32

BYTE_LIMIT = 2**32
"""What a heap may take unless another limit is given: depth 26."""

LARGEST_LEAF: dict[OverName, int] = {"triangles": 8, "strips": 1, "blocks": 1}
"""Objects in a leaf, at most."""

AXIS = 3
"""Bits 0 and 1 of PrimCount; 3 is no axis."""


@dataclass(frozen=True, eq=False)
class Slbvh:
    """An SLBVH over objects, each a range of triangles in file order.

    Attributes:
        over: What the objects are.
        nodes: (2**d, 8) uint32, the 32-byte records: the bits of the box's low and high corner (six float32),
            PrimCount and PrimPos. Node 0 is none, 1 the root, 2n and 2n+1 the children of n.
        order: (p,) int32, the objects as leaves name them; None where they lie in that order.
    """

    over: OverName
    nodes: np.ndarray
    order: np.ndarray | None

    @property
    def depth(self) -> int:
        """Levels below the root."""
        return len(self.nodes).bit_length() - 2

    @property
    def boxes(self) -> Boxes:
        """(2**d, 6) float32, of the nodes; zeros where they are empty."""
        return self.nodes.view(np.float32)[:, :6]

    @property
    def counts(self) -> Counts:
        """(2**d,) int32: objects below each node, 0 where it is empty."""
        return (self.nodes[:, PRIM_COUNT] >> COUNT_SHIFT).astype(np.int32)

    @property
    def is_leaf(self) -> np.ndarray:
        """(2**d,) bool."""
        return self.nodes[:, PRIM_COUNT] & LEAF != 0

    def objects(self) -> Counts:
        """(p,) int32: the objects as leaves name them."""
        return np.arange(self.counts[1], dtype=np.int32) if self.order is None else self.order


def heap_depth(count: int, largest_leaf: int, byte_limit: int = BYTE_LIMIT) -> int:
    """The levels below the root of a heap over so many objects.

    Raises:
        LimitError: More than a trail can tell, or more bytes than are allowed.
        UsageError: There is no object, or none in a leaf.
    """
    if count < 1 or largest_leaf < 1:
        raise UsageError(f"{count} objects, {largest_leaf} a leaf", where="slbvh", remedy="give 1 or more")
    depth = (-(-count // largest_leaf) - 1).bit_length()
    flaw = None
    if depth > MOST_DEPTH:
        flaw = f"{count} objects make a heap {depth} levels deep; a trail of 32 bits tells {MOST_DEPTH}"
    elif heap_bytes(depth) > byte_limit:
        flaw = f"a heap of depth {depth} takes {heap_bytes(depth)} bytes, more than the {byte_limit} allowed"
    elif count > MOST_OBJECTS:
        flaw = f"{count} objects; the count of a node tells {MOST_OBJECTS}"
    if flaw is not None:
        raise LimitError(flaw, where="slbvh", remedy="build it over strips or blocks")
    return depth


def heap_bytes(depth: int) -> int:
    """Bytes of a heap of so many levels below the root."""
    return NODE_BYTES << (depth + 1)


def build_slbvh(
    boxes: Boxes,
    options: HierarchyOptions,
    threads: int = 1,
    *,
    largest_leaf: int | None = None,
    byte_limit: int = BYTE_LIMIT,
) -> Slbvh:
    """Build an SLBVH over any boxes.

    Args:
        boxes: (p, 6) float32, of the objects, finite, lo <= hi, p >= 1.
        options: What the objects are, and the balance.
        threads: Threads to build with; the heap is the same for any number.
        largest_leaf: Objects in a leaf, at most; None for what `LARGEST_LEAF` says.
        byte_limit: Bytes that the heap may take.

    Returns:
        A heap that `check_slbvh` accepts.

    Raises:
        LimitError: The heap is deeper than a trail can tell, or takes more than the limit.
        UsageError: No box, one that is not finite or inverted, or no object in a leaf.
    """
    check_boxes(boxes)
    boxes = np.ascontiguousarray(boxes, np.float32)
    leaf = LARGEST_LEAF[options.objects] if largest_leaf is None else largest_leaf
    depth = heap_depth(len(boxes), leaf, byte_limit)
    nodes = np.zeros((2 << depth, 8), np.uint32)
    if options.balance == "sah":
        kernels.fill_ranges(len(boxes), np.zeros(0, np.uint64), leaf, nodes)
        order = _halved_by_sah(boxes, nodes, threads)
    else:
        codes = morton_codes(boxes, boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0))
        order = radix_order(codes)
        kernels.fill_ranges(len(boxes), codes[order], leaf, nodes)
    kernels.box_nodes(boxes, order, nodes, nodes.view(np.float32))
    if options.balance == "morton":
        kernels.axes_from_boxes(nodes, nodes.view(np.float32))
    in_order = np.array_equal(order, np.arange(len(order)))
    return Slbvh(options.objects, nodes, None if in_order else order)


def _halved_by_sah(boxes: Boxes, nodes: np.ndarray, threads: int) -> Counts:
    """The objects as halves along the best axes put them; the axes are written to the nodes."""
    items = np.stack([radix_order(_rising(boxes, axis)) for axis in range(3)])
    lists = kernels.Lists(items, np.zeros(len(boxes), np.int32), np.zeros(len(boxes), np.uint8))
    largest = max(SMALLEST_JOB, len(boxes) // (16 * threads)) if threads > 1 else len(boxes)

    def halve(node: int) -> list[tuple[int]]:
        # A large range is halved once, and its halves come back as jobs, for any thread that is free.
        once = bool(nodes[node, PRIM_COUNT] >> COUNT_SHIFT > largest)
        kernels.halve_by_sah(boxes, lists, nodes, node, once)
        return [(2 * node,), (2 * node + 1,)] if once else []

    run_jobs(halve, (1,), threads)
    return items[0]


def _rising(boxes: Boxes, axis: int) -> np.ndarray:
    """(p,) uint64 that rise as centres do along an axis; the sum of two float32 cannot overflow float64."""
    # The sum with zero is never -0.0. The bits of negative numbers rise the other way round.
    centres = boxes[:, axis].astype(np.float64) + boxes[:, 3 + axis] + 0.0
    bits = centres.view(np.int64)
    return (bits ^ (bits >> 63 & np.int64(2**63 - 1))).view(np.uint64) ^ np.uint64(2**63)


def check_slbvh(slbvh: Slbvh, boxes: Boxes) -> None:
    """Make sure that a heap reaches each object once and that its boxes are exactly those of what is below.

    Each inner node splits its places into those of its two children, which are not empty; the root has all
    of them; nothing hangs below a leaf or an empty node: so each place is in one leaf, reached from the root
    once. Leaves have the boxes of their objects and inner nodes those of their children: by induction, of
    all that is below.

    Args:
        slbvh: The heap in question.
        boxes: (p, 6) float32, of the objects, p >= 1.

    Raises:
        UnreadableSceneError: Naming the first flaw found.
    """
    nodes = slbvh.nodes
    size = len(nodes)
    if nodes.shape != (size, 8) or nodes.dtype != np.uint32 or size < 2 or size & (size - 1):
        raise _flaw(f"the heap is no power of two of 32-byte nodes but {nodes.shape} {nodes.dtype}", 0)
    if slbvh.depth > MOST_DEPTH:
        raise _flaw(f"the heap is {slbvh.depth} levels deep, more than {MOST_DEPTH}", 0)
    _check_order(slbvh, len(boxes))
    _check_ranges(slbvh, len(boxes))
    _check_node_boxes(slbvh, boxes)


def _check_order(slbvh: Slbvh, count: int) -> None:
    if slbvh.order is None:
        return
    if len(slbvh.order) != count or not np.array_equal(np.sort(slbvh.order), np.arange(count)):
        raise _flaw("the order is no permutation of the objects", 0)


def _check_ranges(slbvh: Slbvh, count: int) -> None:
    """Raise unless each object is in one leaf, and nothing is below leaves and empty nodes."""
    nodes, leaf, half = slbvh.nodes, slbvh.is_leaf, len(slbvh.nodes) // 2
    counts, first = slbvh.counts.astype(np.int64), nodes[:, PRIM_POS].astype(np.int64)
    empty = counts == 0
    inner = ~empty & ~leaf
    if counts[1] != count or first[1] != 0:
        raise _flaw(f"the root has {counts[1]} objects from {first[1]} on, not {count} from 0 on", 1)
    _raise_at(empty & nodes.any(axis=1), "an empty node is not zeros")
    _raise_at((nodes[:, PRIM_COUNT] & AXIS == AXIS) & inner, "an inner node has no axis")
    _raise_at(inner & (np.arange(2 * half) >= half), "an inner node has no room for children")
    left, right = np.arange(half) * 2, np.arange(half) * 2 + 1
    above = inner[:half]
    hanging = ~above & ~(empty[left] & empty[right])
    # Node 1, which is not empty, is what node 0 would have as a child on the right.
    hanging[0] = False
    _raise_at(hanging, "something is below a leaf or an empty node")
    splits = ~empty[left] & ~empty[right] & (counts[left] + counts[right] == counts[:half])
    splits &= (first[left] == first[:half]) & (first[right] == first[:half] + counts[left])
    _raise_at(above & ~splits, "a node does not split its objects in two")


def _check_node_boxes(slbvh: Slbvh, boxes: Boxes) -> None:
    """Raise unless boxes are exactly those of what is below."""
    leaves = np.flatnonzero(slbvh.is_leaf)
    leaves = leaves[np.argsort(slbvh.nodes[leaves, PRIM_POS])]
    starts = np.append(slbvh.nodes[leaves, PRIM_POS], len(boxes)).astype(np.int32)
    inner = np.flatnonzero((slbvh.counts > 0) & ~slbvh.is_leaf)
    held = slbvh.boxes
    left, right = held[2 * inner], held[2 * inner + 1]
    below = np.concatenate([np.minimum(left, right)[:, :3], np.maximum(left, right)[:, 3:]], axis=1)
    _check_exact(held[leaves], range_boxes(boxes, starts, slbvh.objects()), leaves)
    _check_exact(held[inner], below, inner)


def _check_exact(held: Boxes, below: Boxes, node: np.ndarray) -> None:
    # Written so that a comparison with NaN says no.
    holds = np.concatenate([held[:, :3] <= below[:, :3], held[:, 3:] >= below[:, 3:]], axis=1)
    _raise_at(~np.logical_and.reduce(holds, axis=1), "a box does not hold what is below it", node)
    larger = np.logical_or.reduce(held != below, axis=1)
    _raise_at(larger, "a box is larger than what is below it", node)


def _raise_at(flaws: np.ndarray, what: str, nodes: np.ndarray | None = None) -> None:
    if flaws.any():
        place = int(np.argmax(flaws))
        raise _flaw(what, place if nodes is None else int(nodes[place]))


def _flaw(what: str, node: int) -> UnreadableSceneError:
    return UnreadableSceneError(what, where=f"slbvh node {node}", remedy="convert the model again")


# Notes. Visits, tests of triangles and bytes of nodes a triangle, dragon, camera / random rays, leaves of 8:
#
#     sah, halves                    26.7 / 36.1    5.6 /  7.0    9.6
#     morton, halves                 84.6 / 130.6  21.2 / 33.6    9.6
#     morton, where a bit changes    68.0 / 103.2  21.6 / 33.6    9.6
#     the same, a level more         45.1 / 63.0   16.3 / 22.7   19.3
#     the same, two levels more      35.5 / 48.4   11.4 / 15.5   38.5
#
# A heap of fixed depth has little room for splits that are not halves, and each level of room doubles it: the
# balanced SAH build is better and smaller than any of these. Codes in a cube in place of the bounds are a bit
# better or a bit worse. Leaves of 4 cost twice the bytes and more visits.
