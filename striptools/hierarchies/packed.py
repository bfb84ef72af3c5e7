"""Quantised eight-wide nodes, 64 bytes each, and runs, their leaves: what files hold and tracers walk.

Ylitie, Karras & Laine, "Efficient Incoherent Ray Traversal on GPUs Through Compressed Wide BVHs" (HPG 2017),
section 3: eight children a node, their boxes in 8 bits a plane on a grid of the node's own, inner children
and leaves found by counting. Lauterbach et al., ReduceM (EGSR 2008): strips are what a hierarchy stands over.
The layout is SPEC 4.4 and 4.5. Differences:

1. One grid for the whole scene, its cells a power of two: a node has an integer origin and a shift an axis, 9
   bytes, and a box is an exact number.
2. 64 bytes instead of 80: children need no byte of their own, since a leaf is one run.
3. A run is up to eight consecutive triangles of a strip. Where a strip is cut is chosen by dynamic
   programming: least sum of areas, and a price a run.
4. The collapse to width eight is given a price a node too (`kernels.wide.cheapest_forests`), since half empty
   nodes cost bytes.
5. The tree under the collapse is the exact SAH sweep over the runs of a block, or the object split over
   blocks; no node lies in two blocks.

Boxes are put on the grid outward: the first and last border of cells by exact arithmetic, then whole steps.

Cost: O(n) for blocks of bounded size; 64 bytes of room a triangle of the `JOB` blocks in work.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int32, UInt32

from striptools.errors import UnreadableSceneError, UsageError
from striptools.hierarchies.wide import EMPTY, WIDTH, WideBoxes, WideTree
from striptools.kernels import packed_nodes as kernels
from striptools.kernels.hierarchy import boxes_from_below
from striptools.kernels.object_split import Rows, Tree
from striptools.partition.object_split import split_objects
from striptools.threads import in_chunks
from striptools.types import Boxes, Counts

__all__ = [
    "LONGEST_RUN",
    "BoxGrid",
    "PackedNodes",
    "Roots",
    "box_grid",
    "build_inner",
    "build_top",
    "check_packed",
    "join_tops",
    "slots_of",
    "wide_tree",
]

NodeWords = UInt32[np.ndarray, "m 16"]
SlotChildren = Int32[np.ndarray, "m 8"]
FirstRuns = UInt32[np.ndarray, " b"]
Runs = UInt32[np.ndarray, " r"]

LONGEST_RUN = 8
"""The most triangles of a run: the lanes of a leaf test."""

LEAST_CELL, LARGEST_CELL = -149, 127

RUN_PRICE = 0.05
"""What a run costs beside its area, in half areas of the block."""

NODE_PRICE = 0.2
"""What a node costs beside its visits, in visits of the block's root."""

JOB = 64
"""Blocks that a thread works on at a time."""

ROOM = 256
"""The most triangles, and so the most runs, of a block."""


@dataclass(frozen=True, eq=False)
class BoxGrid:
    """Where the planes of boxes may be: low + k * 2^cell on each axis, for whole k.

    Attributes:
        low: (3,) float32, the least coordinates of the scene.
        cell: (3,) int32, exponents, -149 to 127.
    """

    low: Float32[np.ndarray, "3"]
    cell: Int32[np.ndarray, "3"]

    @property
    def per_unit(self) -> np.ndarray:
        """(3,) float64, cells in a unit of length: powers of two."""
        return np.ldexp(1.0, -self.cell)


@dataclass(frozen=True, eq=False)
class PackedNodes:
    """The nodes of a scene, and the runs where they are complete.

    Attributes:
        nodes: (m, 16) uint32, the 64-byte records of SPEC 4.4: over blocks, then the roots of the blocks,
            then the others; only those over blocks where `runs` is None.
        top_count: How many are over blocks.
        first_run: (b,) uint32, where each block's runs begin; None where nodes are not complete.
        runs: (r,) uint32, the runs of SPEC 4.5; None where nodes are not complete.
        longest_run: The most triangles of a run; 0 where nodes are not complete.
    """

    nodes: NodeWords
    top_count: int
    first_run: FirstRuns | None
    runs: Runs | None
    longest_run: int


@dataclass(frozen=True, eq=False)
class Roots:
    """Which blocks and which nodes over blocks each geometry has, where a scene has several.

    The root of a geometry is its first node over blocks, or that of its only block.

    Attributes:
        blocks: (g+1,) int64, the first block of each geometry, then b.
        tops: (g+1,) int64, its first node over blocks, then how many there are.
    """

    blocks: np.ndarray
    tops: np.ndarray


def box_grid(low: np.ndarray, high: np.ndarray) -> BoxGrid:
    """The finest grid on which the scene is below 2^16 cells long on each axis: an origin fits 16 bits.

    Args:
        low: (3,) float32, the least coordinates; finite.
        high: (3,) float32, the largest.
    """
    low = np.asarray(low, np.float32) + np.float32(0)
    size = np.asarray(high, np.float32).astype(np.float64) - low
    # The difference is rounded, but a size below a power of two is never taken for one above it.
    cell = np.frexp(np.maximum(size, 2.0**LEAST_CELL))[1] - 16
    return BoxGrid(low, np.clip(cell, LEAST_CELL, LARGEST_CELL).astype(np.int32))


def build_top(
    block_boxes: Boxes, weights: Counts, grid: BoxGrid, threads: int = 1
) -> tuple[Counts, NodeWords]:
    """Build the nodes over blocks.

    Args:
        block_boxes: (b, 6) float32, b >= 1.
        weights: (b,) int32 >= 1, what a block costs to visit (its triangles).
        grid: The scene's.
        threads: Threads of the object split; the result does not depend on it.

    Returns:
        `order` (b,) int32, the block that goes to each place, and (t, 16) uint32 nodes over the blocks in
        that order; none over a single block.
    """
    blocks = len(block_boxes)
    tree = split_objects(block_boxes, weights=np.asarray(weights, np.int32), threads=threads)
    if blocks == 1:
        return tree.order, np.zeros((0, 16), np.uint32)
    boxes = boxes_from_below(tree.size, np.ascontiguousarray(block_boxes[tree.order]))
    words, order = np.zeros((blocks, 16), np.uint32), np.zeros(blocks, np.int32)
    count = kernels.build_top(
        boxes, tree.size, tree.order, grid.low, grid.per_unit, words, words.view(np.uint8), order
    )
    return order, words[:count].copy()


def join_tops(tops: Sequence[NodeWords], roots: Roots) -> NodeWords:
    """Put the nodes over the blocks of geometries one after another, each of `build_top`, (t, 16) uint32."""
    joined = []
    for top, block, node in zip(tops, roots.blocks.tolist(), roots.tops.tolist(), strict=False):
        moved, slots = top.copy(), slots_of(top)
        moved[:, 0] += np.where(slots.inner.any(axis=1), node, 0).astype(np.uint32)
        moved[:, 1] += np.where(slots.leaf.any(axis=1), block, 0).astype(np.uint32)
        joined.append(moved)
    return np.concatenate(joined)


def build_inner(
    triangle_boxes: Boxes,
    block_starts: Counts,
    strip_starts: Counts,
    grid: BoxGrid,
    top_count: int,
    longest_run: int = LONGEST_RUN,
    threads: int = 1,
) -> tuple[NodeWords, FirstRuns, Runs]:
    """Cut the strips of each block into runs and build the nodes over them.

    Args:
        triangle_boxes: (n, 6) float32, in file order.
        block_starts: (b+1,) int32, the first triangle of each block, of 1 to 256 triangles, then n.
        strip_starts: (s+1,) int32, the first triangle of each strip, then n; no strip lies in two blocks.
        grid: The scene's.
        top_count: Nodes over blocks, which will stand before these.
        longest_run: The most triangles of a run, 1 to 8.
        threads: How many threads share the blocks; the result is the same for any number.

    Returns:
        (k, 16) uint32 nodes: the roots of all blocks, then the others; (b,) uint32, where each block's runs
        begin; and (r,) uint32 runs, of which bits 0 to 10 are there: `kernels.packed_hits.describe_runs`
        writes the rest, which strips say.

    Raises:
        UsageError: `longest_run` is out of range.
    """
    if not 1 <= longest_run <= LONGEST_RUN:
        raise UsageError(f"{longest_run} is out of range", where="longest_run", remedy="give 1 to 8")
    blocks = len(block_starts) - 1
    counts = np.zeros(blocks, np.uint32)
    given = (np.ascontiguousarray(triangle_boxes), block_starts, strip_starts)
    limits = (longest_run, RUN_PRICE, NODE_PRICE, grid.low, grid.per_unit)

    def build(begin: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        end = min(begin + JOB, blocks)
        triangles = int(block_starts[end] - block_starts[begin])
        words, runs = np.zeros((triangles + end - begin, 16), np.uint32), np.zeros(triangles, np.uint32)
        inner, found = kernels.build_blocks(
            *given, begin, end, *limits, *_room(), words, words.view(np.uint8), counts, runs
        )
        roots = end - begin
        return words[:roots].copy(), words[roots : roots + inner].copy(), runs[:found].copy()

    def build_jobs(part: tuple[int, int]) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        return [build(job * JOB) for job in range(*part)]

    parts = in_chunks(build_jobs, -(-blocks // JOB), threads, smallest=1)
    roots, inner, runs = zip(*(job for part in parts for job in part), strict=True)
    behind = top_count + blocks
    for top, rest in zip(roots, inner, strict=True):
        # `base` counts from a job's first node behind its roots; other bits of the word stay.
        for nodes in (top, rest):
            nodes[:, 0] += np.where(_inner_bits(nodes) != 0, behind, 0).astype(np.uint32)
        behind += len(rest)
    first_run = (np.cumsum(counts) - counts).astype(np.uint32)
    return np.concatenate([*roots, *inner]), first_run, np.concatenate(runs)


def _room() -> tuple[Rows, Tree]:
    """Room for the split of a block's runs."""
    words = np.zeros((ROOM, 4), np.uint64)
    tree = Tree(
        np.zeros(ROOM, np.int32),
        np.zeros(ROOM, np.int32),
        np.zeros(2 * ROOM - 1, np.int32),
        np.zeros(2 * ROOM - 1, np.int32),
    )
    return Rows(words.view(np.float32), words.view(np.int32), words), tree


def _inner_bits(nodes: NodeWords) -> np.ndarray:
    return nodes[:, 3] >> 16 & 255


def run_ranges(packed: PackedNodes, block_starts: Counts) -> tuple[Counts, Counts]:
    """The first triangle of each run, in file order, and its triangles: two (r,) int32."""
    assert packed.runs is not None
    assert packed.first_run is not None
    runs = packed.runs.astype(np.int32)
    block = np.repeat(
        np.arange(len(packed.first_run)),
        np.diff(np.append(packed.first_run, len(runs)).astype(np.int64)),
    )
    first = block_starts[block] + (runs & 255)
    return first.astype(np.int32), (runs >> 8 & 7) + 1


def wide_tree(
    packed: PackedNodes, triangle_boxes: Boxes, block_starts: Counts, boxes: WideBoxes | None = None
) -> WideTree:
    """The same hierarchy with exact boxes, a run a leaf.

    Args:
        packed: Complete nodes, for which `check_packed` holds.
        triangle_boxes: (n, 6) float32, in file order.
        block_starts: (b+1,) int32, in triangles.
        boxes: (m, 6, 8) float32 of the nodes' slots, to stand in place of the exact ones.
    """
    assert packed.first_run is not None
    first, count = run_ranges(packed, block_starts)
    child = np.full((len(packed.nodes), WIDTH), EMPTY, np.int32)
    kernels.slot_children(packed.nodes, packed.top_count, packed.first_run, child)
    held = boxes
    if held is None:
        held = kernels.exact_boxes(child, first, count, np.ascontiguousarray(triangle_boxes))
    child, placed, depth = kernels.in_visiting_order(child, held)
    return WideTree(placed, child, first, count, int(depth))


def check_packed(
    packed: PackedNodes,
    grid: BoxGrid,
    triangle_boxes: Boxes,
    block_starts: Counts,
    strip_starts: Counts,
    roots: Roots | None = None,
) -> None:
    """Make sure that nodes reach each block and each run once, and that every box holds what is below it.

    Nothing here is shared with what builds or reads nodes, but for the boxes' union.

    Args:
        packed: What to check, complete or only over blocks.
        grid: The scene's.
        triangle_boxes: (n, 6) float32, in file order.
        block_starts: (b+1,) int32, in triangles.
        strip_starts: (s+1,) int32, in triangles.
        roots: Of several geometries; None for one.

    Raises:
        UnreadableSceneError: Naming the first flaw found.
    """
    blocks = len(block_starts) - 1
    roots = roots or Roots(np.array([0, blocks]), np.array([0, packed.top_count]))
    _check_counts(packed, blocks, roots)
    slots = slots_of(packed.nodes)
    _check_slots(packed.nodes, slots)
    _check_marks(packed.nodes[: packed.top_count], slots.leaf[: packed.top_count])
    child = _check_links(packed, slots, blocks, roots)
    if packed.runs is None:
        first, count = block_starts[:-1].astype(np.int32), np.diff(block_starts).astype(np.int32)
    else:
        _check_runs(packed, block_starts, strip_starts)
        first, count = run_ranges(packed, block_starts)
    held = kernels.exact_boxes(child, first, count, np.ascontiguousarray(triangle_boxes))
    _check_boxes(slots, held, grid)


@dataclass(frozen=True, eq=False)
class Slots:
    """Nodes taken apart, by NumPy alone: (m, 8) bool, planes in cells of the grid (m, 3, 8) int64."""

    inner: np.ndarray
    empty: np.ndarray
    low: np.ndarray
    high: np.ndarray

    @property
    def leaf(self) -> np.ndarray:
        """Slots that are neither inner nor empty."""
        return ~(self.inner | self.empty)


def slots_of(nodes: NodeWords) -> Slots:
    """Take (m, 16) uint32 nodes apart."""
    record = np.ascontiguousarray(nodes).view(np.uint8)
    planes = record[:, 16:].reshape(-1, 6, WIDTH).astype(np.int64)
    origin = record[:, 8:14].copy().view(np.uint16).astype(np.int64)
    shift = np.stack([nodes[:, 0] >> 28, record[:, 15] & 15, record[:, 15] >> 4], axis=1).astype(np.int64)
    inner = np.unpackbits(record[:, 14:15], axis=1, bitorder="little").astype(np.bool_)
    empty = ((planes[:, :3] == 1) & (planes[:, 3:] == 0)).all(axis=1)
    sides = origin[:, None, :, None] + (planes.reshape(-1, 2, 3, WIDTH) << shift[:, None, :, None])
    return Slots(inner, empty, sides[:, 0], sides[:, 1])


def _check_counts(packed: PackedNodes, blocks: int, roots: Roots) -> None:
    """Nodes, blocks and runs are of one scene."""
    complete = packed.runs is not None
    _require(complete == (packed.first_run is not None), "runs are not there as a whole")
    several, tops = np.diff(roots.blocks) > 1, np.diff(roots.tops)
    _require(bool(((tops >= 1) == several).all()) and tops.min() >= 0, "a wrong number of top nodes")
    least = packed.top_count + (blocks if complete else 0)
    enough = len(packed.nodes) >= least if complete else len(packed.nodes) == least
    _require(enough, "a wrong number of nodes")
    _require((1 if complete else 0) <= packed.longest_run <= WIDTH * complete, "a wrong longest run")


def _check_slots(nodes: NodeWords, slots: Slots) -> None:
    """Each slot is empty or has a box, and words that say nothing are zero."""
    upright = (slots.low <= slots.high).all(axis=1)
    _require(bool((upright ^ slots.empty).all()), "a slot is neither empty nor has a box")
    _require(not (slots.empty & slots.inner).any(), "an empty slot is inner")
    unused = ~slots.inner.any(axis=1) & (nodes[:, 0] & 0xFFFFFFF != 0)
    _require(not unused.any(), "a node without inner children has a base")
    _require(not (~slots.leaf.any(axis=1) & (nodes[:, 1] != 0)).any(), "a node without leaves has leaves")
    _require(not slots.empty.all(axis=1).any(), "a node has no child")


def _check_marks(tops: NodeWords, leaf: np.ndarray) -> None:
    """Each node over blocks says which of its slots are leaves."""
    marks = np.packbits(leaf, axis=1, bitorder="little")[:, 0]
    _require(np.array_equal(tops[:, 1] >> 24, marks), "a node over blocks has other leaves than it says")


def _check_links(packed: PackedNodes, slots: Slots, blocks: int, roots: Roots) -> SlotChildren:
    """Each node, block and run is reached once, from where it may be; gives the children of all slots."""
    top, nodes = packed.top_count, packed.nodes.astype(np.int64)
    complete = packed.runs is not None
    node = np.broadcast_to(np.arange(len(nodes))[:, None], slots.inner.shape)
    target = (nodes[:, :1] & 0xFFFFFFF) + np.cumsum(slots.inner, axis=1) - 1
    ranks = np.cumsum(slots.leaf, axis=1) - 1
    is_top = node < top
    least = np.where(is_top, node, np.maximum(node, top - 1 + blocks * complete))
    end = np.append(np.repeat(roots.tops[1:], np.diff(roots.tops)), np.full(len(nodes) - top, len(nodes)))
    allowed = (target > least) & (target < end[:, None])
    _require(bool(allowed[slots.inner].all()), "a child is none of the nodes that it may be")
    of_top, of_rest = target[slots.inner & is_top], target[slots.inner & ~is_top]
    below = np.setdiff1d(np.arange(top), roots.tops[:-1])
    _require(np.array_equal(np.sort(of_top), below), "a top node has not one parent")
    first = top + blocks if complete else top
    _require(np.array_equal(np.sort(of_rest), np.arange(first, len(nodes))), "a node has not one parent")
    _check_blocks((nodes[:top, 1:2] & 0xFFFFFF) + ranks[:top], slots.leaf[:top], roots)
    child = np.where(slots.inner, target, EMPTY)
    if not complete:
        return np.where(slots.leaf, -((nodes[:, 1:2] & 0xFFFFFF) + ranks + 1), child).astype(np.int32)
    child = np.where(slots.leaf & is_top, top + (nodes[:, 1:2] & 0xFFFFFF) + ranks, child)
    run = _linked_runs(packed, slots, child, blocks)
    return np.where(slots.leaf & ~is_top, -(run + 1), child).astype(np.int32)


def _check_blocks(block: np.ndarray, is_leaf: np.ndarray, roots: Roots) -> None:
    """Each block of a geometry of several is the leaf of one slot of that geometry's nodes."""
    several = np.diff(roots.blocks) > 1
    wanted = np.flatnonzero(np.repeat(several, np.diff(roots.blocks)))
    _require(np.array_equal(np.sort(block[is_leaf]), wanted), "a block has not one parent")
    geometry = np.repeat(np.arange(len(several)), np.diff(roots.tops))[:, None]
    own = (block >= roots.blocks[geometry]) & (block < roots.blocks[geometry + 1])
    _require(bool(own[is_leaf].all()), "a block has not one parent")


def _linked_runs(packed: PackedNodes, slots: Slots, child: np.ndarray, blocks: int) -> np.ndarray:
    """(m, 8) int64, the run of each slot that is one; each is reached once, from its own block."""
    assert packed.runs is not None
    assert packed.first_run is not None
    top, word = packed.top_count, packed.nodes[:, 1].astype(np.int64)
    leaf = slots.leaf.copy()
    leaf[:top] = False
    owner = np.full(len(word), -1)
    owner[top : top + blocks] = np.arange(blocks)
    level = np.arange(top, top + blocks)
    while len(level):
        below = np.where(slots.inner[level], child[level], -1)
        owner[below[below >= 0]] = np.broadcast_to(owner[level][:, None], below.shape)[below >= 0]
        level = below[below >= 0]
    holds = leaf.any(axis=1)
    _require(
        np.array_equal((word & 0xFFFFFF)[holds], owner[holds]), "a node names another block than its own"
    )
    starts = packed.first_run.astype(np.int64)
    runs = np.append(starts, len(packed.runs))
    _require(runs[0] == 0 and bool((np.diff(runs) > 0).all()), "the runs of blocks do not follow each other")
    block = np.maximum(owner, 0)
    run = (starts[block] + (word >> 24))[:, None] + np.cumsum(slots.leaf, axis=1) - 1
    own = (run >= starts[block][:, None]) & (run < runs[block + 1][:, None])
    _require(bool(own[leaf].all()), "a node has a run of another block")
    _require(np.array_equal(np.sort(run[leaf]), np.arange(len(packed.runs))), "a run has not one parent")
    return run


def _check_runs(packed: PackedNodes, block_starts: Counts, strip_starts: Counts) -> None:
    """The runs of a block hold its triangles once each, and none goes on in another strip."""
    assert packed.runs is not None
    assert packed.first_run is not None
    first, count = run_ranges(packed, block_starts)
    _require(int(count.max(initial=0)) <= packed.longest_run, "a run is too long")
    strip = np.searchsorted(strip_starts[:-1], first, side="right") - 1
    owner = np.searchsorted(packed.first_run, np.arange(len(first)), side="right") - 1
    end = np.minimum(strip_starts[strip + 1], block_starts[owner + 1])
    _require(bool((first + count <= end).all()), "a run goes on in another strip")
    order = np.argsort(first, kind="stable")
    ends = np.cumsum(count[order])
    whole = np.array_equal(first[order], ends - count[order]) and int(ends[-1]) == int(block_starts[-1])
    _require(whole, "the runs do not hold every triangle once")


def _check_boxes(slots: Slots, held: np.ndarray, grid: BoxGrid) -> None:
    """Each slot's box holds its exact one: cells compared with a difference and with its rounding error."""
    low = grid.low.astype(np.float64)[:, None]
    sides = (slots.low, held[:, :3], 1.0), (slots.high, held[:, 3:], -1.0)
    for cells, exact, sign in sides:
        exact = np.where(slots.empty[:, None], grid.low[:, None], exact).astype(np.float64)
        difference = exact - low
        virtual = exact - difference
        error = (exact - (difference + virtual)) + (virtual - low)
        gap = sign * (difference * grid.per_unit[:, None] - cells)
        fits = (gap > 0) | ((gap == 0) & (sign * error >= 0)) | slots.empty[:, None]
        _require(bool(fits.all()), "a box does not hold what is below it")


def _require(holds: bool, flaw: str) -> None:
    if not holds:
        raise UnreadableSceneError(flaw, where="packed nodes", remedy="convert the model again")
