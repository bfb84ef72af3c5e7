"""The stackless linear BVH: a heap of nodes that a bit trail walks."""

from dataclasses import dataclass

import numpy as np

from striptools.hierarchies.options import OverName


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
