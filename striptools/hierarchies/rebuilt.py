"""The hierarchy that is made for tracing alone: over single triangles, whatever a file's strips are.

SAH object split in alignment with leaves, then reinsertion where it pays, then the wide tree of least cost.
Where a triangle may stand in several leaves, those that are large in their boxes are cut first: on a power
plant of 2.6 million triangles that halves the expected cost, and scanned models have none.
"""

from striptools.hierarchies.in_strip import BinaryTree
from striptools.hierarchies.pieces import boxes_of_pieces
from striptools.hierarchies.reinsertion import reinsert
from striptools.hierarchies.wide import WIDTH, WideTree, cheapest, emit
from striptools.kernels.hierarchy import boxes_from_below
from striptools.partition.object_split import split_objects
from striptools.partition.sah import SMALLEST_BLOCK, PartitionOptions
from striptools.types import Boxes, Counts, FaceIds, Faces, Positions


def rebuild(
    boxes: Boxes, threads: int = 1, *, leaf_size: int = WIDTH, width: int = WIDTH
) -> tuple[WideTree, Counts]:
    """A new wide hierarchy over boxed items.

    Args:
        boxes: (n, 6) float32, n >= 1.
        threads: How many share the work; the tree is the same for any number.
        leaf_size: The most items of a leaf, 1 to 8.
        width: Children of a node, 8 or 16.

    Returns:
        The tree, and the item at each place of its leaves, (n,) int32.
    """
    aligned = PartitionOptions(block=leaf_size) if leaf_size >= SMALLEST_BLOCK else None
    split = split_objects(boxes, aligned, threads=threads)
    tree, order = BinaryTree(boxes_from_below(split.size, boxes[split.order]), split.size), split.order
    # What becomes a leaf of the wide tree stays one.
    forests = cheapest(tree, leaf_size, width)
    moved, order = reinsert(tree, order, forests.as_leaf)
    return emit(moved, forests if moved is tree else cheapest(moved, leaf_size, width)), order


def rebuild_pieces(
    positions: Positions, faces: Faces, threads: int = 1, *, width: int = WIDTH
) -> tuple[WideTree, FaceIds]:
    """A new wide hierarchy over triangles, of which one may stand in several leaves.

    Args:
        positions: (v, 3) float32, finite.
        faces: (n, 3) int32, n >= 1.
        threads: As for `rebuild`.
        width: As for `rebuild`.

    Returns:
        The tree, and the triangle at each place of its leaves, (p,) int32, p from n to 4/3 n.
    """
    boxes, triangle = boxes_of_pieces(positions, faces, threads)
    tree, order = rebuild(boxes, threads, width=width)
    return tree, triangle[order]


# Notes
#
# A power plant, 2.6 million triangles, rates of rays over those through the object split alone (camera in
# packets, one by one, occlusion, any hit, random): cut 3.2, 3.5, 1.8, 1.5, 1.4; cut and reinserted 2.3, 3.6,
# 2.3, 2.0, 1.8, in 5.8 s for 2.4; with all nodes reinserted instead of the largest fifth 3.8, 4.7, 2.4, 2.1,
# 1.9, in 15 s; cut twice as often 3.6, 5.0, 2.5, 2.2, 1.9, but scans are cut then, and lose 1 to 3 %. A board
# (kicad_acepack): camera 1.3 to 1.6, random 1.1, occlusion 0.98; a maple 1.05 to 1.18; scans nothing, and
# reinserted by force a camera's rays lose 4 % for an expected gain of 2 %.
#
# Splits in alignment with leaves of eight, and a price for empty lanes: 7.1 triangles a leaf for 4.7
# (dragon), so that leaves and nodes take 0.67 of the bytes and are built in 0.8 of the time, for the same
# expected cost but the price. Rates (bunny, dragon, 3.5 M triangles), best of 11 to 25: camera 1.04, 1.02,
# 1.15, occlusion 1.05, 1.0 to 1.07, 1.07, any hit 1.02, 1.09, 1.08, random rays 1.03, 1.03, 1.02. Alignment
# alone 1.02, 1.01, 1.09 of a camera. A price of 0.03 does less, of 0.2 as much but for occlusion (1.01 at
# 3.5 M triangles); leaf costs of 0.7 and 1.4 node costs 1.0.
#
# Left out: the same for the nodes over a file's blocks. Their area falls by 23 % on the power plant and the
# board; rates 0.7 (camera) and 1.1 (occlusion) on the one, 1.4 to 1.7 and 0.98 on the other.
