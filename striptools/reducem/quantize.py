"""Quantising: one power-of-two grid for the whole mesh, so that its vertices take few bits and no seam opens.

Source: formats/reducem/SPEC.md, section 5. Every coordinate moves to the nearest multiple of a power of
two, of two equally near ones to the even one, before the mesh is partitioned. A vertex that several blocks
share stays one point, because the grid is one. Snapping twice changes nothing. -0.0 becomes 0.0.

The bound: no coordinate moves by more than half a cell, no position by more than sqrt(3) / 2 cells. What
rounding from doubles and welding moved it before comes on top. `check_bound` compares every corner of every
face with the loaded mesh's, in float64.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from striptools.errors import StriptoolsError, UsageError
from striptools.mesh.clean import Cleaned, CleanOptions, clean
from striptools.mesh.instances import placed_bounds
from striptools.mesh.mesh import Mesh
from striptools.mesh.recentre import Origin, displacement
from striptools.reducem.layout import GRID_EXPONENTS
from striptools.types import FaceIds, Positions

__all__ = [
    "PrecisionOptions",
    "Quantised",
    "check_bound",
    "exponent_for_error",
    "grid_bound",
    "grid_exponent_for",
    "quantise",
    "snap",
]

LEAST_BITS, MOST_BITS = 8, 24

CHUNK = 1 << 16
"""Rows handled at a time, so that temporary arrays stay small."""

SLACK = 1 + 2.0**-50
"""What float64 may add to a bound or a distance of a few operations."""

STRETCH_SLACK = 2.0**-18
"""In powers of two, by how much cells may be larger than asked for: `Instances.stretch` is that inexact."""


@dataclass(frozen=True)
class PrecisionOptions:
    """How exactly positions are kept; without any of these every bit of float32.

    Attributes:
        bits: A grid of at most 2**bits cells along the longest side, 8 to 24.
        max_error: The coarsest such grid whose declared bound is at most this, above 0.
        relative: `max_error` counts in diagonals of the mesh, not in its unit.
    """

    bits: int | None = None
    max_error: float | None = None
    relative: bool = False

    def __post_init__(self) -> None:
        if self.bits is not None and self.max_error is not None:
            raise UsageError("bits and a largest error are both given", remedy="leave one out")
        if self.bits is not None and not LEAST_BITS <= self.bits <= MOST_BITS:
            raise UsageError(
                f"{self.bits} is out of range", where="bits", remedy=f"give {LEAST_BITS} to {MOST_BITS}"
            )
        if self.max_error is not None and not 0.0 < self.max_error < math.inf:
            raise UsageError(
                f"{self.max_error} is out of range", where="max_error", remedy="give a number above 0"
            )

    @property
    def is_lossless(self) -> bool:
        """Whether no grid is asked for."""
        return self.bits is None and self.max_error is None


@dataclass(frozen=True, eq=False)
class Quantised:
    """A mesh on a grid, clean again.

    Attributes:
        cleaned: The mesh, and the loaded mesh's face that each face is; counts of cleaning and, under names
            that begin with `quantised_`, of what the grid did: `repeated_vertex` and `zero_area` faces
            dropped, `vertices_welded`, and faces `flipped`, kept though their normal turned over.
        grid_exponent: All coordinates are multiples of 2 to this power.
        error_bound: How far a position may be from the loaded one, in the model's unit.
    """

    cleaned: Cleaned
    grid_exponent: int
    error_bound: float


def grid_bound(exponent: int) -> float:
    """The farthest that a position moves on a grid: half a cell on each axis."""
    return math.sqrt(0.75) * math.ldexp(1.0, exponent) * SLACK


def declared_bound(exponent: int, already: float = 0.0) -> float:
    """The bound of a grid, and of what moved positions before."""
    return (grid_bound(exponent) + already) * SLACK if already else grid_bound(exponent)


def grid_exponent_for(bounds: np.ndarray, bits: int) -> int:
    """The finest grid on which the longest side of a box has fewer than 2**bits steps.

    Args:
        bounds: (2, 3), the least and the largest coordinates, finite.
        bits: 8 to 24.

    Returns:
        The exponent of its cells, -149 to 104; there even the largest float32 is a multiple already.
    """
    low, high = np.asarray(bounds, np.float64)
    longest = float((high - low).max())
    least, most = GRID_EXPONENTS.start, GRID_EXPONENTS.stop - 1
    exponent = min(max(math.frexp(longest)[1] - bits - 1, least), most) if longest else least
    while exponent < most:
        steps = np.rint(np.ldexp(high, -exponent)) - np.rint(np.ldexp(low, -exponent))
        if steps.max() < 2**bits:
            break
        exponent += 1
    return exponent


def exponent_for_error(bounds: np.ndarray, largest: float, already: float = 0.0, stretch: float = 1.0) -> int:
    """The coarsest grid of 8 to 24 bits whose bound is at most `largest`.

    Args:
        bounds: (2, 3), the least and the largest coordinates, finite.
        largest: In the model's unit.
        already: How far positions may have moved before.
        stretch: How much longer a distance may become where instances stand.

    Raises:
        UsageError: 24 bits are not enough.
    """
    for bits in range(LEAST_BITS, MOST_BITS + 1):
        exponent = _finer(grid_exponent_for(bounds, bits), stretch)
        placed = declared_bound(exponent, already) * (stretch * SLACK if stretch != 1.0 else 1.0)
        if placed <= largest:
            return exponent
    raise UsageError(
        f"an error of at most {largest:.3g} takes more than {MOST_BITS} bits",
        where="max_error",
        remedy="leave it out to keep every bit",
    )


def snap(positions: Positions, exponent: int) -> Positions:
    """Move every coordinate to the nearest multiple of 2**exponent, (v, 3) float32; 0.0 for every zero."""
    snapped = np.zeros_like(positions)
    for begin in range(0, len(positions), CHUNK):
        part = slice(begin, begin + CHUNK)
        cells = np.rint(np.ldexp(positions[part].astype(np.float64), -exponent))
        snapped[part] = np.ldexp(cells, exponent) + 0.0
    return snapped


def quantise(
    cleaned: Cleaned, precision: PrecisionOptions, *, drop_duplicates: bool = False, threads: int = 1
) -> Quantised:
    """Put a clean mesh on a grid, and clean it again: vertices that met are welded, flat faces dropped.

    Args:
        cleaned: The mesh.
        precision: Bits or a largest error.
        drop_duplicates: Drop faces that have become equal.
        threads: How many threads share the work.

    Raises:
        UsageError: The error asked for takes more than 24 bits.
    """
    mesh = cleaned.mesh
    already = cleaned.weld_error + math.sqrt(3.0) * cleaned.largest_rounding * SLACK
    exponent = _exponent(mesh, precision, already)
    moved = replace(mesh, positions=snap(mesh.positions, exponent))  # pyright: ignore[reportArgumentType]
    again = clean(moved, CleanOptions(drop_duplicates=drop_duplicates), threads)
    counts = cleaned.counts | {
        "quantised_repeated_vertex": again.counts["repeated_vertex"],
        "quantised_zero_area": again.counts["zero_area"],
        "quantised_vertices_welded": again.counts["vertices_welded"],
        "quantised_flipped": _count_flipped(mesh, again),
        "duplicate_faces_dropped": cleaned.counts["duplicate_faces_dropped"]
        + again.counts["duplicate_faces_dropped"],
        "duplicate_faces_kept": again.counts["duplicate_faces_kept"],
        "faces_out": again.counts["faces_out"],
        "vertices_out": again.counts["vertices_out"],
    }
    source_face = cleaned.source_face[again.source_face]
    result = replace(cleaned, mesh=again.mesh, source_face=source_face, counts=counts)
    return Quantised(result, exponent, declared_bound(exponent, already))


def check_bound(
    source: Mesh, mesh: Mesh, source_face: FaceIds, bound: float, origin: Origin | None = None
) -> float:
    """Make sure that every corner of every face is as near to the loaded one as a bound declares.

    Args:
        source: As loaded.
        mesh: As it is stored.
        source_face: (n,) int32, the loaded face that each face is, from the same first corner.
        bound: In the model's unit.
        origin: What to add to the stored positions, if anything.

    Returns:
        The largest distance found, in float64.

    Raises:
        StriptoolsError: A corner is farther away: a flaw of this program.
    """
    farthest = 0.0
    for begin in range(0, len(source_face), CHUNK):
        part = slice(begin, begin + CHUNK)
        theirs = source.positions[source.faces[source_face[part]]].astype(np.float64)
        ours = mesh.positions[mesh.faces[part]].astype(np.float64)
        away = ours - theirs if origin is None else displacement(theirs, origin, ours)
        farthest = max(farthest, float(np.linalg.norm(away, axis=2).max(initial=0.0)))
    if not farthest <= bound * SLACK:
        raise StriptoolsError(
            f"a vertex moved by {farthest}, more than the declared {bound}",
            where="quantise",
            remedy="report it",
        )
    return farthest


def recentred_bound(cleaned: Cleaned) -> float:
    """How far positions about an origin may be from the loaded ones: by welding, moving and rounding."""
    return (cleaned.weld_error + math.sqrt(3.0) * cleaned.largest_rounding) * SLACK


def _exponent(mesh: Mesh, precision: PrecisionOptions, already: float) -> int:
    """The grid that is asked for, finer by the largest stretch of instances, to hold where they stand."""
    bounds, stretch = mesh.bounds, 1.0
    if mesh.geometries is not None and mesh.instances is not None:
        bounds = placed_bounds(mesh.positions, mesh.geometries, mesh.instances)
        stretch = mesh.instances.stretch
    if precision.bits is not None:
        return _finer(grid_exponent_for(bounds, precision.bits), stretch)
    assert precision.max_error is not None
    scale = float(np.linalg.norm(bounds[1] - bounds[0])) if precision.relative else 1.0
    return exponent_for_error(bounds, precision.max_error * scale, already, stretch)


def _finer(exponent: int, stretch: float) -> int:
    """The grid whose cells are no larger than another's where instances stretch them.

    A stretch has a little on top for rounding, which is no reason for a bit more.
    """
    finer = exponent - math.ceil(math.log2(stretch) - STRETCH_SLACK)
    return min(max(finer, GRID_EXPONENTS.start), GRID_EXPONENTS.stop - 1)


def _count_flipped(mesh: Mesh, again: Cleaned) -> int:
    """Faces that are kept and whose normals before and after point to different sides."""
    flipped = 0
    for begin in range(0, len(again.source_face), CHUNK):
        part = slice(begin, begin + CHUNK)
        before = _normals(mesh.positions, mesh.faces[again.source_face[part]])
        after = _normals(again.mesh.positions, again.mesh.faces[part])
        flipped += int((np.einsum("ij,ij->i", before, after) < 0.0).sum())
    return flipped


def _normals(positions: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = positions[faces].astype(np.float64).transpose(1, 0, 2)
    return np.cross(b - a, c - a)
