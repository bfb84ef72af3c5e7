"""A scene laid out for a walk of one ray at a time: leaves as rows of leaf blocks, and a root's box."""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float32

from striptools.trace.box import MARGIN
from striptools.trace.counters import Counters
from striptools.trace.leaves import (
    ExpandedLayout,
    LeafBlocks,
    aligned_zeros,
    fill_blocks,
    reach_of,
    size_class,
)
from striptools.trace.walk import DONE, WIDTH, Frame
from striptools.trace.walk_single import Leaves
from striptools.types import Counts

if TYPE_CHECKING:
    from striptools.reducem.placed import Placed
    from striptools.reducem.scene import Scene


@dataclass(frozen=True, eq=False)
class SingleLayout(ExpandedLayout):
    """What a tracer keeps of a scene whose walk follows one ray at a time.

    Attributes:
        root_box: (6,) float32, scaled: a ray that misses it is not walked.
    """

    root_box: Float32[np.ndarray, " 6"]

    @property
    def root(self) -> tuple[np.ndarray, np.ndarray]:
        """The root's box in the first lane, and child 0, which a walk starts at."""
        boxes = np.full((6, WIDTH), np.nan, np.float32)
        boxes[:, 0] = self.root_box
        return boxes, np.array([0, *[DONE] * (WIDTH - 1)], np.int32)

    @property
    def missed(self) -> Counters:
        """A ray that misses the root's box tests that."""
        return Counters(0, 0, 1, 0, 0, 0)


def lay_out_leaves(
    scene: "Scene | Placed", order: Counts, starts: Counts
) -> tuple[Leaves, LeafBlocks, Frame]:
    """Lay out leaves of any size.

    Args:
        scene: Whose triangles they are.
        order: (k,) int32, triangles in file order, leaf after leaf; one may be in several leaves.
        starts: (l+1,) int32, the first of each leaf in `order`, then k; empty leaves are allowed.

    Returns:
        The leaves for a walk, the blocks for a layout, and how rays are seen: in coordinates times
        `frame.scale`.
    """
    sizes = np.diff(starts)
    rows = -(-sizes // WIDTH)
    first = aligned_zeros((size_class(len(starts)) + 1,), np.int32)
    np.cumsum(rows, out=first[1 : len(starts)])
    first[len(starts) :] = first[len(starts) - 1]
    leaf = np.repeat(np.arange(len(sizes)), rows)
    place = np.arange(len(leaf)) - first[leaf]
    begin = (starts[leaf] + place * WIDTH).astype(np.int32)
    count = np.minimum(starts[leaf + 1] - begin, WIDTH).astype(np.int32)
    held = fill_blocks(scene, begin, count, order)
    zero, one = np.zeros(3, np.float32), np.ones(3, np.float32)
    frame = Frame(held.scale, reach_of(scene, held.scale), zero, one, MARGIN)
    return Leaves(held.blocks, first), held, frame


def triangles_of_objects(starts: Counts, objects: Counts) -> tuple[Counts, Counts]:
    """The triangles of objects that are ranges in file order, object after object.

    Args:
        starts: (p+1,) int32, the first triangle of each object, then their number.
        objects: (k,) int32, which ones.

    Returns:
        (m,) int32, the triangles, and (k+1,) int32, where those of each object begin, then m.
    """
    sizes = np.diff(starts)[objects]
    begin = np.zeros(len(objects) + 1, np.int32)
    np.cumsum(sizes, out=begin[1:])
    return np.arange(begin[-1], dtype=np.int32) + np.repeat(starts[objects] - begin[:-1], sizes), begin


def padded(values: np.ndarray, filling: Any = 0) -> np.ndarray:
    """A copy from a cache line on, filled up to a size class, so that scenes of like size share a program."""
    room = aligned_zeros((size_class(len(values) + 1), *values.shape[1:]), values.dtype.type)
    if filling != 0:
        room.fill(filling)
    room[: len(values)] = values
    return room
