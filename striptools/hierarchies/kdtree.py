"""The kd-tree whose surface area metric is corrected for mail-boxing.

Sources: Hunt, "Corrections to the Surface Area Metric with Respect to Mail-Boxing" (2008): with mail-boxes an
object on both sides of a split is tested once by a ray that goes through both, so the cost of the split is
P(L) C(L) + P(R) C(R) - P(L and R) C(L and R), where C(L and R) counts the objects on both sides. Wald &
Havran, "On building fast kd-Trees for Ray Tracing, and on doing that in O(N log N)" (2006): all sides of all
objects as events, sorted once, swept for the best plane, and kept sorted through every split; triangles
clipped to cells ("perfect splits").

Differences and decisions:
1. P(L and R) = (SA_L + SA_R - SA) / SA: a cell is convex, so a ray is on both sides when it crosses the part
   of the plane within the cell, and that is the area counted twice. Hunt gives no formula.
2. Planes lie strictly inside a cell, so no cell is flat but those of a flat model. An object in the plane
   goes to the side where it costs less.
3. An object that touches the plane from one side is in that side's cell alone; a walk must take cells to be a
   margin larger than they are.
4. Events are words of 64 bits; a clipped part is cut from the triangle afresh, in float64, and rounded
   outward within the part it is cut from, so that no error builds up.
5. A tree has room for a number of leaves and references in proportion to its objects, and a cell shares its
   with the cells below by their objects; one without room for two is a leaf. Soups of large triangles would
   else have thousands of references an object.
6. The cells of a large tree's top are split one after another by any thread that is free, what is below them
   grows as a whole; the tree does not depend on threads.

Cost: O(n log n) time; some 400 bytes an object while it is built (power plant).
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float32

from striptools.errors import LimitError, UnreadableSceneError, UsageError
from striptools.hierarchies.options import HierarchyOptions, OverName
from striptools.kernels import kdtree as kernels
from striptools.partition.object_split import check_boxes
from striptools.partition.sah import KD_STRIP_COST, KdCosts
from striptools.types import Boxes

__all__ = ["MAILBOX", "KdTree", "build_kdtree", "check_kdtree"]

Corners = Float32[np.ndarray, "n 3 3"]

MAILBOX = 8
"""References that a ray remembers where nothing else is asked for."""

ROOM = 128
"""The most leaves and references of a tree, together, for each object."""

MOST_OBJECTS = 2**28
MOST_ROOM = 2**29
"""So that four times a place fits a word."""

SUBTREE = 2**15
"""Cells of at most so many objects are not shared between threads."""

DEEPEST = 60
"""No tree is deeper than this."""


@dataclass(frozen=True, eq=False)
class KdTree:
    """A kd-tree over objects, each a range of triangles in file order.

    Attributes:
        over: What the objects are.
        nodes: (m, 2) uint32 in preorder. Of an inner node the bits of the split (float32), then 4 * (place of
            the child above the split) + axis; the child below follows it. Of a leaf the first of its
            references, then 4 * (how many) + 3.
        references: (k,) uint32, the objects of the leaves; one may be in several.
        low: (3,) float32, the root's cell.
        high: (3,) float32.
        mailbox: How many objects a ray remembers to have tested; 0 for none. Hits are the same.
    """

    over: OverName
    nodes: np.ndarray
    references: np.ndarray
    low: np.ndarray
    high: np.ndarray
    mailbox: int = MAILBOX


class _Tree(NamedTuple):
    """A tree while it is put together: nodes and references as in `KdTree`."""

    nodes: np.ndarray
    references: np.ndarray


def build_kdtree(
    boxes: Boxes,
    options: HierarchyOptions,
    threads: int = 1,
    *,
    corners: Corners | None = None,
    constants: KdCosts | None = None,
) -> KdTree:
    """Build a kd-tree over boxed objects.

    Args:
        boxes: (p, 6) float32, finite, lo <= hi, p >= 1.
        options: What the objects are, and the metric: "corrected" for mail-boxing, or "plain".
        threads: How many threads share the work; the tree is the same for any number.
        corners: (p, 3, 3) float32 where the objects are triangles, which are then clipped to cells; None
            where it is their boxes that are.
        constants: Of the cost model; what suits the objects when left out.

    Returns:
        The tree, for which `check_kdtree` holds.

    Raises:
        UsageError: No object, boxes that are not finite or inverted, or corners of other objects.
        LimitError: More than MOST_OBJECTS objects.
    """
    if constants is None:
        constants = KdCosts(intersection=KD_STRIP_COST) if options.objects == "strips" else KdCosts()
    check_boxes(boxes)
    corners = _checked_corners(boxes, corners)
    if len(boxes) > MOST_OBJECTS:
        raise LimitError(
            f"{len(boxes)} objects", where="kd-tree", remedy="build it over strips, or another hierarchy"
        )
    corrected = options.metric == "corrected"
    costs = kernels.Costs(
        float(constants.traversal), float(constants.intersection), float(constants.empty_bonus), corrected
    )
    root = kernels.root_cell(
        np.ascontiguousarray(boxes, np.float32), float(min(ROOM * len(boxes), MOST_ROOM))
    )
    deepest = min(DEEPEST, constants.deepest(len(boxes)))
    tree = _grow(root, deepest, costs, corners, threads)
    return KdTree(options.objects, *tree, low=root.bounds[:3].copy(), high=root.bounds[3:].copy())


def check_kdtree(tree: KdTree, boxes: Boxes, *, corners: Corners | None = None) -> None:
    """Make sure that a tree's cells tile the root's and that leaves have all objects that are in their cells.

    Args:
        tree: The tree in question.
        boxes: (p, 6) float32 boxes of the objects, p >= 1.
        corners: (p, 3, 3) float32 where the tree was built with them.

    Raises:
        UnreadableSceneError: Naming the first flaw found.
        UsageError: `corners` are not of these objects.
    """
    corners = _checked_corners(boxes, corners)
    _expect_shapes(tree)
    flaw, node = kernels.structure_flaw(tree.nodes, tree.references, tree.low, tree.high, len(boxes), DEEPEST)
    _expect(flaw == kernels.SOUND, _FLAWS[flaw], int(node))
    outside = ~((boxes[:, :3] >= tree.low) & (boxes[:, 3:] <= tree.high)).all(axis=1)
    _expect(not outside.any(), f"does not hold object {int(outside.argmax())}", 0)
    objects = np.ascontiguousarray(boxes, np.float32)
    missed, node = kernels.first_missed(tree.nodes, tree.references, tree.low, tree.high, objects, corners)
    _expect(missed < 0, f"has a leaf without object {missed}, which is in its cell", int(node))


_FLAWS = (
    "",
    "has a split that is not inside its cell",
    "has a child that does not follow its parent in preorder",
    "has a leaf whose references do not follow those of the leaf before",
    "has a leaf whose references do not rise, or are no objects",
    f"is deeper than {DEEPEST}",
    "has nodes or references that are not reached",
)


def _grow(root: kernels.Cell, deepest: int, costs: kernels.Costs, corners: np.ndarray, threads: int) -> _Tree:
    """Split large cells here, generation by generation, grow the rest in a pool, and put all together."""
    generations: list[list[kernels.Plane | None]] = []
    jobs = []
    cells = [root]
    with ThreadPoolExecutor(max(1, threads)) as pool:
        while cells:
            depth = len(generations)
            given = [(cell, depth < deepest, costs, corners) for cell in cells]
            splits = list(pool.map(_split_large, *zip(*given, strict=True)))
            small = [cell for cell, split in zip(cells, splits, strict=True) if split is None]
            jobs.append([pool.submit(_subtree, cell, depth, deepest, costs, corners) for cell in small])
            generations.append([None if split is None else split[0] for split in splits])
            cells = [cell for split in splits if split is not None for cell in split[1:]]
        return _joined(generations, [[job.result() for job in generation] for generation in jobs])


def _split_large(
    cell: kernels.Cell, may_be_split: bool, costs: kernels.Costs, corners: np.ndarray
) -> tuple[kernels.Plane, kernels.Cell, kernels.Cell] | None:
    """The plane that a large cell is split by and the cells on its sides; None where it is not split here."""
    if not may_be_split or len(cell.objects) <= SUBTREE:
        return None
    plane = kernels.best_plane(cell, costs)
    if plane.axis < 0:
        return None
    below, above, fits = kernels.split_cell(cell, plane, corners)
    return (plane, below, above) if fits else None


def _subtree(
    cell: kernels.Cell, depth: int, deepest: int, costs: kernels.Costs, corners: np.ndarray
) -> _Tree:
    return _Tree(*kernels.grow_tree(cell, depth, deepest, costs, corners))


def _joined(generations: list[list[kernels.Plane | None]], grown: list[list[_Tree]]) -> _Tree:
    """The whole tree, from the deepest generation of cells up: two belong to each split in the one above."""
    below: list[_Tree] = []
    for planes, subtrees in zip(reversed(generations), reversed(grown), strict=True):
        pairs = iter(below)
        leaves = iter(subtrees)
        below = [
            next(leaves) if plane is None else _split_tree(plane, next(pairs), next(pairs))
            for plane in planes
        ]
    return below[0]


def _split_tree(plane: kernels.Plane, below: _Tree, above: _Tree) -> _Tree:
    """The tree of a split from those of its sides."""
    head = np.zeros((1, 2), np.uint32)
    head[0, 0] = np.float32(plane.position).view(np.uint32)
    head[0, 1] = 4 * (1 + len(below.nodes)) + plane.axis
    nodes = [
        head,
        _moved(below.nodes, 1, 0),
        _moved(above.nodes, 1 + len(below.nodes), len(below.references)),
    ]
    return _Tree(np.concatenate(nodes), np.concatenate([below.references, above.references]))


def _moved(nodes: np.ndarray, places: int, references: int) -> np.ndarray:
    """Nodes that lie so many places and references further on."""
    leaf = nodes[:, 1] & 3 == kernels.LEAF
    moved = nodes.copy()
    moved[leaf, 0] += np.uint32(references)
    moved[~leaf, 1] += np.uint32(4 * places)
    return moved


def _checked_corners(boxes: Boxes, corners: Corners | None) -> np.ndarray:
    if corners is None:
        return np.zeros((0, 3, 3), np.float32)
    if corners.shape != (len(boxes), 3, 3):
        raise UsageError(
            f"corners have shape {corners.shape}", where="kd-tree", remedy=f"give ({len(boxes)}, 3, 3)"
        )
    return np.ascontiguousarray(corners, np.float32)


def _expect_shapes(tree: KdTree) -> None:
    fits = tree.nodes.ndim == 2 and tree.nodes.shape[1] == 2 and len(tree.nodes) > 0
    fits = fits and tree.references.ndim == 1 and tree.low.shape == tree.high.shape == (3,)
    _expect(fits and bool(np.isfinite([tree.low, tree.high]).all()), "has no nodes, or no finite cell", 0)


def _expect(holds: bool, what: str, node: int) -> None:
    if not holds:
        raise UnreadableSceneError(
            f"the kd-tree {what}", where=f"node {node}", remedy="convert the model again"
        )
