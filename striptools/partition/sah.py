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
