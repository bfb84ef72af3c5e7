"""Boxes around parts of triangles, for hierarchies in which one triangle may stand in several leaves.

Source: Karras & Aila, "Fast Parallel Construction of High-Quality Bounding Volume Hierarchies" (HPG 2013),
section 4: before a hierarchy is built, triangles whose boxes are mostly empty are cut along the faces of an
octree over the scene, those first that gain most; Ernst & Greiner, "Early Split Clipping for Bounding Volume
Hierarchies" (RT 2007), had the idea.

Differences and decisions:
1. The priority of a triangle is the cube root of what its box's area has to spare alone, and it is cut as
   often as that is `CUT_ABOVE` times the mean: a scene of triangles of one size is not cut at all, and none
   grows by more than a `1 / CUT_ABOVE`th part.
2. A triangle's box is cut from its parts in float64, rounded outwards, by more than rounding is off by.

Cost: O(n) time and 8 bytes a triangle beside the boxes.
"""

import numpy as np

from striptools.kernels.pieces import piece_boxes, spare_areas
from striptools.partition.boxes import face_boxes
from striptools.threads import in_chunks
from striptools.types import Boxes, FaceIds, Faces, Positions

CUT_ABOVE = 3.0
"""A triangle is cut where its priority is so many times the mean, and once more for each time again."""

MOST_CUTS = 255
"""No triangle is cut more often."""


def boxes_of_pieces(positions: Positions, faces: Faces, threads: int = 1) -> tuple[Boxes, FaceIds]:
    """Cut the triangles that are much larger in their boxes than most, and box all parts.

    Args:
        positions: (v, 3) float32, finite.
        faces: (n, 3) int32, n >= 1.
        threads: How many share the work; the result is the same for any number.

    Returns:
        Boxes, (p, 6) float32, n <= p <= n + n / CUT_ABOVE; the triangle in each, (p,) int32, rising. What of
        a triangle is in none of its boxes is nothing; the box of one that is whole is its own.
    """
    low, high = positions.min(axis=0).astype(np.float64), positions.max(axis=0).astype(np.float64)
    extent = float((high - low).max())
    cuts = _cuts(positions, faces, threads)
    if extent == 0 or not cuts.any():
        return face_boxes(positions, faces, threads), np.arange(len(faces), dtype=np.int32)
    room = len(faces) + int(cuts.sum())
    boxes, triangle = np.zeros((room, 6), np.float32), np.zeros(room, np.int32)
    parts = piece_boxes(positions, faces, cuts, low, extent, boxes, triangle)
    return boxes[:parts], triangle[:parts]


def _cuts(positions: Positions, faces: Faces, threads: int) -> np.ndarray:
    """How often each triangle may be cut, (n,) int64."""
    spare = np.zeros(len(faces))
    in_chunks(lambda part: spare_areas(positions, faces, *part, spare), len(faces), threads)
    priority = np.cbrt(spare, out=spare)
    mean = priority.mean()
    if mean == 0:
        return np.zeros(len(faces), np.int64)
    return np.minimum(priority / (CUT_ABOVE * mean), MOST_CUTS).astype(np.int64)
