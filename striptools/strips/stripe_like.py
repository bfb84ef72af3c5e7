"""A STRIPE-like greedy: strips as rasterisers wanted them, a baseline that knows nothing of surface area.

Source: Evans, Skiena, Varshney, "Optimizing Triangle Strips for Fast Rendering" (Visualization 1996), its
local algorithm, which refines the one of Silicon Graphics (Akeley, Haeberli, Burns, `tomesh.c`, 1990): start
at the triangle with the fewest free neighbours, go on to the neighbour that itself has the fewest, so that no
triangle is left behind alone; break ties by looking one level ahead.

Differences and decisions (written from the description, not from the program STRIPE):
1. The global step, which looks for rectangular patches of quadrilaterals first, is left out: the models here
   are triangles.
2. Free neighbours are counted by joins: pairs of half-edges on one ring that run in opposite directions.
   Where three and more faces meet at an edge a face may have more than three.
3. A strip starts at the face that has had its number of free neighbours for longest (ties by index), as in
   one list of faces for each number; it grows at one end until it is stuck, then at the other.
4. Ties that looking ahead leaves are broken by the least half-edge, then by the ring's order.
5. A strip may be given a longest length; the source has none.

Cost: O(n) time, 16 bytes a triangle of working memory.
"""

from typing import TYPE_CHECKING

import numpy as np

from striptools.errors import UsageError
from striptools.strips.ordering import OrderingOptions, Sequences
from striptools.types import Faces

if TYPE_CHECKING:
    from striptools.mesh.adjacency import Adjacency


def stripe_like(adjacency: "Adjacency", faces: Faces, options: OrderingOptions | None = None) -> Sequences:
    """Join the faces of a mesh into sequences, greedily, fewest free neighbours first.

    Args:
        adjacency: Rings of half-edges of `faces`.
        faces: (n, 3) int32.
        options: Only `max_length` is looked at; the default of OrderingOptions when left out.

    Returns:
        Sequences of at most max_length faces, in the order in which they were found; `check_sequences` holds
        for them.

    Raises:
        UsageError: Arrays that do not belong together.
    """
    from striptools.kernels import strip_baselines as kernels

    options = options or OrderingOptions()
    count = len(faces)
    if len(adjacency.ring) != 3 * count:
        raise UsageError("adjacency and faces are not of one mesh", where="stripe_like")
    order, starts = np.zeros(count, np.int32), np.zeros(count + 1, np.int32)
    strips = kernels.stripe_like(adjacency.ring, faces, options.max_length, order, starts)
    return Sequences(order, starts[: strips + 1].copy())


# Notes. Vertices per triangle, bunny / dragon / chandelier: 1.018 / 1.039 / 1.041 without a longest length,
# with 64 1.041 / 1.054 / 1.062, fewer than any other method here, at 2.6 / 1.6 / 1.5 times a full SAH tree's
# cost.
