"""The one cost model: what a ray is expected to pay for a hierarchy, by surface area.

Every builder, report and test that speaks of cost takes its constants and its formula from here.

Source: the surface area heuristic of Goldsmith and Salmon (1987) and MacDonald and Booth (1990). A random ray
that hits the root's box hits a box inside it with probability area / root area, so

    expected cost = sum over inner nodes of NODE_COST * area / root area
                  + sum over triangle tests of TRIANGLE_COST * area / root area

Half areas are used throughout: only ratios count. Unit of cost: one visit of an inner node.
"""

from dataclasses import dataclass

import numpy as np

from striptools.errors import UsageError
from striptools.types import Boxes, Counts, Doubles

NODE_COST = 1.0
"""Visiting one inner node (testing the ray against the boxes of its children), in node visits."""

TRIANGLE_COST = 1.0
"""Testing the ray against one triangle, in node visits."""

KD_TRIANGLE_COST = 0.5
"""Testing one triangle of a kd-tree's leaf, in steps: what trees are fastest with, not what a test takes."""

KD_STRIP_COST = 2.0
"""Testing one strip of a kd-tree's leaf, in steps."""

LARGEST_BINS = 64
LARGEST_SWEEP = 64
SMALLEST_BLOCK = 4
LARGEST_BLOCK = 65536


@dataclass(frozen=True)
class PartitionOptions:
    """How ranges are split.

    Attributes:
        bins: Bins an axis in the binned search of large ranges, 2 to 64.
        sweep_below: Ranges of fewer items than this are swept exactly, 2 to 64 (2 sweeps none).
        block: Split ranges of a few times so many items such that blocks of at most that many, cut from the
            tree, are well filled; 4 to 65536. None for no blocks.
    """

    bins: int = 16
    sweep_below: int = 13
    block: int | None = None

    def __post_init__(self) -> None:
        _require(2 <= self.bins <= LARGEST_BINS, "bins", self.bins, f"2 to {LARGEST_BINS}")
        _require(
            2 <= self.sweep_below <= LARGEST_SWEEP, "sweep_below", self.sweep_below, f"2 to {LARGEST_SWEEP}"
        )
        if self.block is not None:
            _require(
                SMALLEST_BLOCK <= self.block <= LARGEST_BLOCK,
                "block",
                self.block,
                f"{SMALLEST_BLOCK} to {LARGEST_BLOCK}",
            )


@dataclass(frozen=True)
class KdCosts:
    """What a kd-tree's splits are weighed by: its part of the cost model.

    A split costs

        traversal + intersection * (P(L) C(L) + P(R) C(R) - P(L and R) C(L and R))

    where C counts objects and P is the probability that a ray that meets the cell meets that side, by area;
    the last term, for a metric corrected for mail-boxing, is Hunt's (2008): P(L and R) = (SA_L + SA_R - SA) /
    SA. It is `1 - empty_bonus` of that where one side has no object; a leaf costs intersection * C.

    Attributes:
        traversal: One step through a node, > 0: the unit.
        intersection: Testing one object, > 0.
        empty_bonus: What is taken off where a side is empty, 0 to below 1.
        depth: Depth at which no cell is split, for one object; >= 0.
        depth_growth: How much deeper with each doubling of the objects, >= 0.

    Raises:
        UsageError: A value is out of its range.
    """

    traversal: float = 1.0
    intersection: float = KD_TRIANGLE_COST
    empty_bonus: float = 0.2
    depth: float = 8.0
    depth_growth: float = 1.3

    def __post_init__(self) -> None:
        _require(0.0 < self.traversal < np.inf, "traversal", self.traversal, "a number above 0")
        _require(0.0 < self.intersection < np.inf, "intersection", self.intersection, "a number above 0")
        _require(0.0 <= self.empty_bonus < 1.0, "empty_bonus", self.empty_bonus, "0 to below 1")
        _require(0.0 <= self.depth <= 64.0, "depth", self.depth, "0 to 64")
        _require(0.0 <= self.depth_growth <= 64.0, "depth_growth", self.depth_growth, "0 to 64")

    def deepest(self, objects: int) -> int:
        """The depth at which no cell of a tree over so many objects is split."""
        return int(self.depth + self.depth_growth * np.log2(max(objects, 1)))


def half_area(boxes: Boxes) -> Doubles:
    """Half the surface area of each box, float64, in square model units; cannot overflow for finite boxes.

    An inverted box (no point inside) has no area.
    """
    x, y, z = np.maximum(boxes[:, 3:].astype(np.float64) - boxes[:, :3], 0.0).T
    return x * y + y * z + z * x


def expected_cost(node_boxes: Boxes, size: Counts) -> float:
    """Expected cost of a ray through a binary hierarchy with one triangle a leaf, in node visits.

    Args:
        node_boxes: (m, 6) the boxes of all nodes, the root first; the order of the others is free.
        size: (m,) triangles below each node: 1 is a leaf, that is one triangle test.

    Returns:
        The sum over inner nodes and triangle tests, each weighted by its area over the root's. Under a root
        without area each of them counts in full.
    """
    area = half_area(node_boxes)
    share = area / area[0] if area[0] > 0.0 else np.ones_like(area)
    return float((share * np.where(size > 1, NODE_COST, TRIANGLE_COST)).sum())


def _require(holds: bool, name: str, value: object, allowed: str) -> None:
    if not holds:
        raise UsageError(f"{value} is out of range", where=name, remedy=f"give {allowed}")
