"""The BVH that is read off the keys of a loose octree."""

from dataclasses import dataclass

import numpy as np

from striptools.hierarchies.options import OverName


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
