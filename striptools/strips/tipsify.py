"""Tipsify: an order of triangles for vertex caches, cut into strips; a baseline without a thought for area.

Source: Sander, Nehab, Barczak, "Fast Triangle Reordering for Vertex Locality and Reduced Overdraw" (SIGGRAPH
2007), section 3. All faces round one *fanning vertex* are emitted, and the next fanning vertex is the one of
theirs that has been in the (simulated) cache for longest and will still be there when its own remaining faces
are through; where no vertex of them has faces left, the *dead-end stack* of vertices met so far is unwound,
and then the vertices of the input are taken in turn.

Differences and decisions:
1. The faces round a vertex are emitted in runs of neighbours, counter-clockwise, the first run from the face
   emitted last where that touches the vertex; the source takes them as they are listed. The vertices and
   what they cost the cache are the same, and consecutive faces are neighbours, which strips need.
2. The order is cut into strips wherever a face does not continue the one before it (as `check_sequences`
   has it), or the longest length is reached.
3. Equal ages are decided by the place among the candidates, first met first; the first fanning vertex is the
   first that has a face.

Cost: O(n) time, 46 bytes a triangle of working memory.
"""

import numpy as np

from striptools.errors import UsageError
from striptools.mesh.mesh import first_face_out_of_range
from striptools.strips.ordering import OrderingOptions, Sequences
from striptools.types import FaceIds, Faces

CACHE_SIZE = 16
"""Vertices in the simulated first-in-first-out cache, where nothing else is asked for."""

SMALLEST_CACHE = 3
LARGEST_CACHE = 2**20


def tipsify(
    faces: Faces, vertex_count: int, options: OrderingOptions | None = None, *, cache_size: int = CACHE_SIZE
) -> Sequences:
    """Order the faces of a mesh by Tipsify, and cut that order into sequences of neighbours.

    Args:
        faces: (n, 3) int32.
        vertex_count: How many vertices there are.
        options: Only `max_length` is looked at; the default of OrderingOptions when left out.
        cache_size: Vertices in the simulated cache, 3 to 2**20.

    Returns:
        Sequences of at most max_length faces; one after another they are Tipsify's order, and
        `check_sequences` holds for them.

    Raises:
        UsageError: A face names a vertex that does not exist, or the cache size is out of range.
    """
    from striptools.kernels import strip_baselines as kernels

    options = options or OrderingOptions()
    order = tipsify_order(faces, vertex_count, cache_size)
    starts = np.zeros(len(faces) + 1, np.int32)
    strips = kernels.cut_into_strips(faces, order, options.max_length, starts)
    return Sequences(order, starts[: strips + 1].copy())


def tipsify_order(faces: Faces, vertex_count: int, cache_size: int = CACHE_SIZE) -> FaceIds:
    """The order in which Tipsify emits the faces, (n,) int32; arguments and errors as for `tipsify`."""
    from striptools.kernels import strip_baselines as kernels

    if not SMALLEST_CACHE <= cache_size <= LARGEST_CACHE:
        raise UsageError(
            f"{cache_size} is out of range",
            where="cache_size",
            remedy=f"give {SMALLEST_CACHE} to {LARGEST_CACHE}",
        )
    bad = first_face_out_of_range(faces, vertex_count)
    if bad is not None:
        raise UsageError(f"face {bad} names a vertex that does not exist", where="tipsify")
    order = np.zeros(len(faces), np.int32)
    kernels.tipsify(np.ascontiguousarray(faces, np.int32), vertex_count, cache_size, order)
    return order


# Notes. Misses a face, cache of 16, bunny / dragon: 0.658 / 0.683, as meshoptimizer's implementation of the
# same paper has it (0.657 / 0.684). Vertices per triangle of the strips, bunny / dragon: faces of a fan as
# listed 1.912 / 1.898 (meshoptimizer's order, cut); in runs, always to the left 1.429 / 1.434; on the side
# where the fan goes on from the face before 1.359 / 1.329.
