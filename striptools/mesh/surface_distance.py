"""How far one surface strays from another: the one-sided Hausdorff distance, between certified bounds.

Source: branch and bound over triangles, as in Tang, Lee and Kim, "Interactive Hausdorff Distance Computation
for General Polygonal Models" (SIGGRAPH 2009). Differences:

1. A piece of a triangle is bounded from above by the largest distance of its three corners to one triangle of
   the other surface: that distance is convex, so no point of the piece is farther away. The triangles tried
   are those closest to the corners.
2. Pieces that may still hold the farthest point are cut in four at their edges' midpoints, all at once, a
   round after another, first bounded by the triangles of the whole and then by those closest to their own
   corners, until the bounds meet to a tolerance, or a limit is decided, or pieces run out; both
   bounds hold whenever it ends.
3. Closest triangles are found through an implicit tree over triangles in Morton order (kernels).

Everything is float64; the bounds are widened by what rounding may do. Cost: a closest point a vertex,
O(log n) each, and a few rounds of few pieces.
"""

import math
from dataclasses import dataclass

import numpy as np

from striptools.kernels import surface_distance as kernels
from striptools.kernels.morton import morton_codes, radix_order
from striptools.mesh.mesh import Mesh
from striptools.threads import every_core, in_chunks

MOST_PIECES = 1 << 22
"""Pieces of a round beyond which no more are cut."""

MOST_ROUNDS = 24
TOLERANCE = 0.1
"""How far the upper bound may stay above the lower one, in parts of it."""

ROUNDING = 2.0**-44
"""What rounding may do to a distance, in parts of the largest coordinate."""


@dataclass(frozen=True)
class Deviation:
    """How far a surface strays from another, in the model's unit.

    Attributes:
        lower: Some point is at least this far away.
        upper: No point is farther away.
        rms: The root of the mean square distance over the area, by a rule of degree two on each triangle.
    """

    lower: float
    upper: float
    rms: float


class Surface:
    """A surface to measure distances to.

    Args:
        mesh: Finite vertices, at least one face.
        threads: Threads to search with; None for every core.
    """

    def __init__(self, mesh: Mesh, threads: int | None = None) -> None:
        corners = mesh.positions.astype(np.float64)[mesh.faces]
        low, high = mesh.bounds
        order = radix_order(morton_codes(corners.mean(axis=1), low, high))
        self.face = order
        self._corners = np.ascontiguousarray(corners[order])
        self._boxes = _boxes_over(self._corners)
        self._threads = threads or every_core()

    def closest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances of (q, 3) float64 points, (q,) float64, and the closest triangle's place, (q,) int32."""
        square, item = np.zeros(len(points)), np.zeros(len(points), np.int32)
        points = np.ascontiguousarray(points, np.float64)
        given = (points, self._corners, self._boxes)
        in_chunks(
            lambda part: kernels.closest_triangles(*given, *part, square, item), len(points), self._threads
        )
        return np.sqrt(square), item

    def farthest_of(self, pieces: np.ndarray, items: np.ndarray) -> np.ndarray:
        """(k,) float64: no point of a piece, (k, 3, 3), is farther away; by the triangles `items`, (k, j)."""
        square = np.zeros(len(pieces))
        given = (np.ascontiguousarray(pieces), self._corners, np.ascontiguousarray(items))
        in_chunks(lambda part: kernels.farthest_corner(*given, *part, square), len(pieces), self._threads)
        return np.sqrt(square)


def deviation(
    mesh: Mesh, surface: Surface, *, tolerance: float = TOLERANCE, limit: float | None = None
) -> Deviation:
    """Measure how far the points of a mesh are from a surface, at most.

    Args:
        mesh: Finite vertices, at least one face; what no face uses does not count.
        surface: Of the other mesh.
        tolerance: How close the bounds have to come, in parts of the lower one.
        limit: Stop as soon as it is known on which side of this the largest distance lies.

    Returns:
        Bounds that hold; they are farther apart than asked where pieces ran out.
    """
    positions = mesh.positions.astype(np.float64)
    pieces = positions[mesh.faces]
    away, item = surface.closest(positions)
    slack = ROUNDING * float(np.abs(mesh.bounds).max())
    lower = float(away[mesh.faces].max())
    rms = _root_mean_square(pieces, away[mesh.faces], surface)
    items, upper, remaining = item[mesh.faces], 0.0, math.inf
    for _ in range(MOST_ROUNDS):
        bound = surface.farthest_of(pieces, items)
        enough = lower * (1 + tolerance) + 4 * slack
        if limit is not None:
            enough = max(enough, limit - slack) if lower <= limit else math.inf
        open_ones = np.flatnonzero(bound > enough)
        upper = max(upper, float(np.delete(bound, open_ones).max(initial=0.0)))
        if len(open_ones) == 0 or 4 * len(open_ones) > MOST_PIECES:
            upper = max(upper, float(bound[open_ones].max(initial=0.0)))
            break
        remaining = float(bound[open_ones].max())
        pieces, items = pieces[open_ones], items[open_ones]
        middles = (pieces + np.roll(pieces, -1, axis=1)) / 2
        parts = _cut(pieces, middles)
        # Most parts are near enough to a triangle that was tried for the whole: those need no search.
        bound = surface.farthest_of(parts, np.tile(items, (4, 1)))
        far = bound > enough
        upper = max(upper, float(bound[~far].max(initial=0.0)))
        wanted = _middles_of(far)
        away, found = surface.closest(middles[wanted])
        lower = max(lower, float(away.max(initial=0.0)))
        at_middles = np.zeros(items.shape, np.int32)
        at_middles[wanted] = found
        pieces, items = parts[far], _cut(items, at_middles)[far]
    else:
        upper = max(upper, remaining)
    return Deviation(max(0.0, lower - slack), max(lower, upper) + slack, rms)


def _root_mean_square(pieces: np.ndarray, at_corners: np.ndarray, surface: Surface) -> float:
    at_middle, _ = surface.closest(pieces.mean(axis=1))
    a, b, c = pieces.transpose(1, 0, 2)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    square = (at_corners**2).sum(axis=1) / 12 + 0.75 * at_middle**2
    total = float(area.sum())
    return math.sqrt(float((area * square).sum()) / total) if total > 0 else float(at_corners.max())


def _cut(pieces: np.ndarray, middles: np.ndarray) -> np.ndarray:
    """What four triangles for each have at their corners, (4k, 3, ...); middles are of ab, bc and ca."""
    (a, b, c), (ab, bc, ca) = (np.moveaxis(corners, 1, 0) for corners in (pieces, middles))
    parts = ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
    return np.concatenate([np.stack(part, axis=1) for part in parts])


def _middles_of(parts: np.ndarray) -> np.ndarray:
    """(k, 3) bool: the middles of k pieces that are corners of these parts, (4k,) bool in `_cut`'s order."""
    first, second, third, inner = parts.reshape(4, -1)
    return np.stack([first | second, second | third, third | first], axis=1) | inner[:, None]


def _boxes_over(corners: np.ndarray) -> np.ndarray:
    """(2p, 6) float64 boxes of the implicit tree; empty ones are infinitely far from everything."""
    starts = np.arange(0, len(corners), kernels.LEAF)
    leaves = 1 << max(0, math.ceil(math.log2(len(starts))))
    boxes = np.full((2 * leaves, 6), np.inf)
    rows = slice(leaves, leaves + len(starts))
    boxes[rows, :3] = np.minimum.reduceat(corners.min(axis=1), starts)
    boxes[rows, 3:] = np.maximum.reduceat(corners.max(axis=1), starts)
    # An empty box has both its corners at infinity; beside a full one, only the least counts as it should.
    boxes[leaves + len(starts) :, 3:] = -np.inf
    while leaves > 1:
        below = boxes[leaves : 2 * leaves].reshape(-1, 2, 6)
        leaves //= 2
        boxes[leaves : 2 * leaves, :3] = below[:, :, :3].min(axis=1)
        boxes[leaves : 2 * leaves, 3:] = below[:, :, 3:].max(axis=1)
    return boxes
