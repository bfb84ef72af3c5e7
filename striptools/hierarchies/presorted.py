"""Presorted geometry: a tree whose bounds are its own triangles, under a few levels of plain nodes."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Presorted:
    """The part of a presorted scene that is not its triangles in their order.

    Attributes:
        nodes: (t, 8) uint32, the plain SAH nodes above, the root first; none where there are no levels.
        starts: (r+1,) int32, the first triangle of each presorted tree below them, then how many triangles
            there are; a scene without levels is one tree.
    """

    nodes: np.ndarray
    starts: np.ndarray
