"""The kd-tree whose surface area metric is corrected for mail-boxing."""

from dataclasses import dataclass

import numpy as np

from striptools.hierarchies.options import OverName


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
    """

    over: OverName
    nodes: np.ndarray
    references: np.ndarray
    low: np.ndarray
    high: np.ndarray
