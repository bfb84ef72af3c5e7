"""The BVH that is read off the keys of a loose octree.

Source: Gu, Jendersie, Grosch, "Fast and Dynamic Construction of Bounding Volume Hierarchies based on Loose
Octrees", VMV 2018, and its supplement, which derives the key and proves that theta may stand for eta. An
object goes to the finest cell of the octree that holds it once the cell is doubled about its centre: its
extent counts, not only where its centre lies, so that a large object does not spoil the box of small ones
beside it. All objects are sorted by one key, the depth-first order of the equivalent binary tree, and the
hierarchy is built over them from below.

With l the binary level of an object's cell, m its Morton code, L' the deepest level in use and
m' = m << (L' - l), the key is l - popc(m') + 2 m'. A finished range i .. j-1 goes together with what is
behind it where theta(i, j) >= theta(i, i-1), else with what is before it, where theta(i, j) is the lesser of
l_j and the length of the prefix that m'_i and m'_j share. At a tie i and j descend from i-1, and j not from
i: the object of the cell above stays out until both sides of that cell are one.

Differences:

1. Levels are the binary ones, three to one of the octree: x, y and z are halved in turn, and each only as
   often as the object's extent on that axis allows.
2. Objects of one cell are sorted further, by the next 15 bits of the Morton codes of their centres, and made
   one subtree first, by the prefixes they share there, then by place. The theorems need distinct keys; and
   objects of like size are many in a cell.
3. A level is at most 48, so that this fits a key of 64 bits; the whole Morton code of 63 bits counts where
   objects are that small.
4. Threads and atomic counters give way to one sweep from the last object to the first, with a stack. It
   writes each node once, at its place in preorder.
5. A leaf over triangles takes up to eight where the surface area heuristic finds that no dearer.
6. The root's cell is the least cube at the low corner of the bounds that holds them.

Cost: O(n) time: a pass for the cells, one for the keys, one radix sort of 64-bit keys and the sweep; 40 bytes
an object for words, keys and the sort, and up to 64 for the nodes.
"""

from dataclasses import dataclass

import numpy as np

from striptools.errors import LimitError
from striptools.hierarchies.binary import LEAF_COST, check_binary_nodes, most_in_leaf, nodes_of_tree
from striptools.hierarchies.options import HierarchyOptions, OverName
from striptools.kernels import loose_octree as kernels
from striptools.kernels.binary_nodes import to_front
from striptools.kernels.morton import radix_order
from striptools.partition.object_split import LARGEST_ITEMS, check_boxes, split_objects
from striptools.partition.sah import NODE_COST
from striptools.threads import in_chunks
from striptools.types import Boxes, Counts

__all__ = ["LooseBvh", "build_linear_bvh", "build_loose_octree", "build_sah_bvh", "check_loose"]


@dataclass(frozen=True, eq=False)
class LooseBvh:
    """A binary BVH over objects, each a range of triangles in file order.

    Attributes:
        over: What the objects are.
        nodes: (m, 8) uint32 in preorder, the root first: the bits of the box's low and high corner (six
            float32), then of an inner node the place of its second child (the first follows it) and 0, of a
            leaf its first object in `order` and how many there are.
        order: (p,) int32, the objects as leaves name them; None where they lie in that order.
    """

    over: OverName
    nodes: np.ndarray
    order: np.ndarray | None


def build_loose_octree(
    boxes: Boxes, options: HierarchyOptions | None = None, threads: int = 1, leaf_size: int | None = None
) -> LooseBvh:
    """Build a BVH over objects by the loose octree.

    Args:
        boxes: (p, 6) float32, finite, lo <= hi, p >= 1.
        options: What the objects are; triangles when left out.
        threads: Threads of the passes over objects; the result does not depend on it.
        leaf_size: The most objects of a leaf; None for 8 triangles, or one strip or block.

    Returns:
        A hierarchy for which `check_loose` holds.

    Raises:
        UsageError: No object, or boxes that are not finite or inverted.
        LimitError: More than 2**30 objects.
    """
    return _build(boxes, options or HierarchyOptions("loose-octree"), threads, leaf_size, by_extent=True)


def build_linear_bvh(
    boxes: Boxes, options: HierarchyOptions | None = None, threads: int = 1, leaf_size: int | None = None
) -> LooseBvh:
    """Build a BVH by the Morton codes of centres alone, all objects at the deepest level: an LBVH.

    Karras, "Maximizing Parallelism in the Construction of BVHs, Octrees, and k-d Trees" (HPG 2012), has the
    same tree. Arguments and errors are those of `build_loose_octree`, which it is there to be compared with.
    """
    return _build(boxes, options or HierarchyOptions("loose-octree"), threads, leaf_size, by_extent=False)


def build_sah_bvh(
    boxes: Boxes,
    options: HierarchyOptions | None = None,
    threads: int = 1,
    leaf_size: int | None = None,
    weights: Counts | None = None,
) -> LooseBvh:
    """Build a BVH by the object split of `partition`, for comparison.

    Args:
        boxes: As for `build_loose_octree`, and so are the other arguments and errors.
        options: What the objects are.
        threads: Threads of the split.
        leaf_size: The most objects of a leaf.
        weights: (p,) int32, what each object costs to test.
    """
    options = options or HierarchyOptions("loose-octree")
    boxes = np.ascontiguousarray(boxes, np.float32)
    tree = split_objects(boxes, weights=weights, threads=threads)
    nodes = nodes_of_tree(tree, boxes, leaf_size or most_in_leaf(options.objects))
    return LooseBvh(options.objects, nodes, _unless_identity(tree.order))


def check_loose(hierarchy: LooseBvh, boxes: Boxes) -> None:
    """Make sure that each object is reached once and that all boxes hold what is below them.

    Args:
        hierarchy: The hierarchy in question.
        boxes: (p, 6) float32, of the objects, p >= 1.

    Raises:
        UnreadableSceneError: Naming the first flaw found.
    """
    check_binary_nodes(hierarchy.nodes, hierarchy.order, boxes)


def _build(
    boxes: Boxes, options: HierarchyOptions, threads: int, leaf_size: int | None, *, by_extent: bool
) -> LooseBvh:
    boxes = np.ascontiguousarray(boxes, np.float32)
    low, side = _root_cell(boxes, threads)
    words, keys = _words_and_keys(boxes, low, side, threads, by_extent=by_extent)
    order = radix_order(keys)
    most = leaf_size or most_in_leaf(options.objects)
    nodes, first = kernels.join_by_keys(order, words, boxes, most, NODE_COST, LEAF_COST)
    nodes = nodes if first == 0 else to_front(nodes, first)
    return LooseBvh(options.objects, nodes, _unless_identity(order))


def _root_cell(boxes: Boxes, threads: int) -> tuple[np.ndarray, float]:
    """The low corner and the side of a cube that holds all boxes.

    Raises:
        UsageError: A box is not finite or inverted, or there is none.
        LimitError: There are too many.
    """
    if boxes.ndim != 2 or boxes.shape[1] != 6 or len(boxes) == 0:
        check_boxes(boxes)
    if len(boxes) > LARGEST_ITEMS:
        raise LimitError(f"{len(boxes)} objects", where="boxes", remedy=f"give at most {LARGEST_ITEMS}")
    parts = in_chunks(lambda part: kernels.bounds_of_boxes(boxes, *part), len(boxes), threads)
    low = np.min([part[:3] for part in parts], axis=0).astype(np.float64)
    high = np.max([part[3:] for part in parts], axis=0).astype(np.float64)
    if np.isnan(low).any():
        check_boxes(boxes)
    side = float((high - low).max())
    # Objects that are all one point lie in any cube.
    return low, side if side > 0.0 else 1.0


def _words_and_keys(
    boxes: Boxes, low: np.ndarray, side: float, threads: int, *, by_extent: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Where each object belongs, and its key: (p,) uint64 each, see `kernels.loose_octree`."""
    words, keys = np.zeros(len(boxes), np.uint64), np.zeros(len(boxes), np.uint64)
    given = (low, side, by_extent, words)
    seen = in_chunks(lambda part: kernels.place_words(boxes, *part, *given), len(boxes), threads)
    cells = int(np.bitwise_or.reduce(np.array(seen, np.uint64)))
    # The lowest bit that is set marks the deepest level in use.
    spare = (cells & -cells).bit_length() - 1
    deepest = kernels.LEVELS - spare
    in_chunks(lambda part: kernels.depth_first_keys(words, *part, spare, deepest, keys), len(boxes), threads)
    return words, keys


def _unless_identity(order: Counts) -> Counts | None:
    return None if np.array_equal(order, np.arange(len(order))) else order


# Notes. Expected cost of one triangle a leaf over that of a full binned SAH tree: by centres alone (LBVH),
# with levels that are whole ones of the octree, and with binary ones as here; triangles in the order of a SAH
# tree.
#
#     powerplant 1.212, 1.019, 0.929    cocoa_temple 1.392, 1.027, 1.038    kicad_acepack 1.192, 1.156, 1.126
#     fzk_haus   1.195, 1.119, 1.098    icub         1.224, 1.255, 1.238    chandelier    1.344, 1.355, 1.353
#
# Where triangles are of about one size (dragon, icub) extent says nothing that the centre does not, and cells
# full of equals cost 1 %. Cells three binary levels finer, so loosened to four times their side: 0.949,
# 1.065, 1.118, 1.087, 1.212, 1.344 in the order above; never worse than an LBVH, no better on the whole.
#
# Objects of one cell halved by place, without the finer bits of their centres: 1.172 on the powerplant in the
# order of a SAH tree and 7.1 at random, where it is 0.958 with them; whole octree levels 1.40 and 14. A pipe
# is as long as its triangles, so that thousands of them share a cell.
#
# The first form of the search for a cell, a loop that halves, took 45 ns an object; the exponent takes 15.
# Reading the stack's boxes entry by entry between writes took 45 ns an object in the sweep; whole rows 36.
