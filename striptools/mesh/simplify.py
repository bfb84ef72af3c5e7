"""Fewer triangles, only where asked: edge collapses by quadric errors, and how far that strays, both ways.

Source: Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics" (SIGGRAPH 1997), through
the package fast-simplification (extra `simplify`), imported only here. It promises a number of triangles, no
distance; so the distance is measured afterwards from the source to the result and back (surface_distance.py),
and a largest error that is asked for is kept by the certified upper bounds or refused.

The package collapses no edge where a triangle would fold or get an angle under 2.6 degrees at the vertex that
moves, though it had one before. Models made of needles stay far from the share that is asked: a board of CAD
parts, almost half of whose faces have such an angle, at 80 %, by any of its options, in float64, and run
again on what is left. The share that was reached is told, and that it is not the one asked.

Attributes do not survive: a collapse has no rule for them here. Instances are flattened before.
"""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from striptools.errors import MissingExtraError, UsageError
from striptools.mesh.clean import clean
from striptools.mesh.mesh import Mesh
from striptools.mesh.surface_distance import Deviation, Surface, deviation

SEARCH_STEPS = 12
"""Halvings of the range of shares, counted in factors, in the search for the fewest triangles."""

LEAST_TRIANGLES = 4

GENTLE: dict[str, Any] = {"agg": 3, "preserve_border": True}
"""Slow thresholds, and borders left as they are: on the bunny an eighth of the distance at half the faces."""

ROUGH: dict[str, Any] = {"agg": 7, "preserve_border": False}
"""Where that does not get down to the share."""

OVER = 0.05
"""How many more triangles than wanted still count as that share."""


@dataclass(frozen=True)
class SimplifyOptions:
    """How much is simplified; without any of these nothing is.

    Attributes:
        keep: The share of the triangles to keep, above 0 and up to 1; None for as few as the error allows.
        largest_error: The farthest that either surface may be from the other, above 0; None for any.
        relative: `largest_error` counts in diagonals of the mesh, not in its unit.

    Raises:
        UsageError: A number is out of its range.
    """

    keep: float | None = None
    largest_error: float | None = None
    relative: bool = False

    def __post_init__(self) -> None:
        if self.keep is not None and not 0.0 < self.keep <= 1.0:
            raise UsageError(
                f"{self.keep} is out of range", where="simplify", remedy="give above 0 and up to 100%"
            )
        if self.largest_error is not None and not 0.0 < self.largest_error < math.inf:
            raise UsageError(
                f"{self.largest_error} is out of range",
                where="simplify error",
                remedy="give a number above 0",
            )

    @property
    def asked(self) -> bool:
        """Whether anything is to be simplified."""
        return self.keep is not None or self.largest_error is not None


@dataclass(frozen=True, eq=False)
class Simplified:
    """A mesh of fewer triangles, and how far the surfaces are from each other.

    Attributes:
        mesh: The result, plain.
        triangles_before: Of the source, once clean.
        of_source: How far points of the source are from the result.
        of_result: How far points of the result are from the source.
        wanted: Triangles of the share that was asked; None where none was.
    """

    mesh: Mesh
    triangles_before: int
    of_source: Deviation
    of_result: Deviation
    wanted: int | None = None

    @property
    def is_short(self) -> bool:
        """Whether no further edge collapses although more triangles are left than were asked."""
        return self.wanted is not None and not reaches(self.mesh.triangle_count, self.wanted)

    @property
    def error_bound(self) -> float:
        """The Hausdorff distance is at most this, in the model's unit."""
        return max(self.of_source.upper, self.of_result.upper)

    def to_dict(self) -> dict[str, object]:
        """What a file or a report may say of it."""
        return {
            "triangles_before": self.triangles_before,
            "triangles": self.mesh.triangle_count,
            "triangles_wanted": self.wanted,
            "hausdorff_of_source": [self.of_source.lower, self.of_source.upper],
            "hausdorff_of_result": [self.of_result.lower, self.of_result.upper],
            "rms_of_source": self.of_source.rms,
            "rms_of_result": self.of_result.rms,
        }


def simplify(mesh: Mesh, options: SimplifyOptions, *, threads: int | None = None) -> Simplified:
    """Simplify a mesh, and measure what that did.

    Args:
        mesh: As loaded; it is cleaned first.
        options: The share to keep, the largest error, or both.
        threads: Threads to measure with; the result is the same.

    Returns:
        The fewest triangles found that keep the error where no share is given.

    Raises:
        UsageError: Nothing is asked, cleaning leaves no face, or the error cannot be kept.
        MissingExtraError: fast-simplification is not installed.
    """
    if not options.asked:
        raise UsageError("neither a share nor an error", where="simplify", remedy="give one")
    source = clean(mesh.flattened().geometry(), threads=threads or 1)
    whole = source.mesh
    if source.origin is not None:
        whole = replace(whole, positions=whole.positions.astype(np.float64) + source.origin)
    if whole.triangle_count == 0:
        raise UsageError("no face is left after cleaning", where="simplify")
    surface = Surface(whole, threads)
    largest = options.largest_error
    if largest is not None and options.relative:
        largest *= float(np.linalg.norm(whole.bounds[1] - whole.bounds[0]))
    if options.keep is not None:
        result = _measured(whole, surface, collapsed(whole, options.keep), None, threads)
        result = replace(result, wanted=wanted_of(whole.triangle_count, options.keep))
        if largest is not None and result.error_bound > largest:
            raise UsageError(
                f"{result.mesh.triangle_count:,} triangles stray by up to {result.error_bound:.4g}, "
                f"more than {largest:.4g}",
                where="simplify",
                remedy="keep more, or leave the share out to keep as few as the error allows",
            )
        return result
    assert largest is not None
    return _fewest(whole, surface, largest, threads)


def _fewest(whole: Mesh, surface: Surface, largest: float, threads: int | None) -> Simplified:
    """Halve the range of shares: none that is kept strays farther; nothing simplified always does it."""
    best = whole
    low, high = math.log(min(1.0, LEAST_TRIANGLES / whole.triangle_count)), 0.0
    for _ in range(SEARCH_STEPS):
        middle = (low + high) / 2
        tried = collapsed(whole, math.exp(middle))
        if tried is not None and _keeps(whole, surface, tried, largest, threads):
            best, high = tried, middle
        else:
            low = middle
    return _measured(whole, surface, best, largest, threads)


def _keeps(whole: Mesh, surface: Surface, tried: Mesh, largest: float, threads: int | None) -> bool:
    if deviation(tried, surface, limit=largest).upper > largest:
        return False
    return deviation(whole, Surface(tried, threads), limit=largest).upper <= largest


def _measured(
    whole: Mesh, surface: Surface, result: Mesh | None, largest: float | None, threads: int | None
) -> Simplified:
    if result is None:
        raise UsageError("no triangle is left", where="simplify", remedy="keep more")
    if result is whole:
        nothing = Deviation(0.0, 0.0, 0.0)
        return Simplified(whole, whole.triangle_count, nothing, nothing)
    there = deviation(whole, Surface(result, threads), limit=largest)
    return Simplified(result, whole.triangle_count, there, deviation(result, surface, limit=largest))


def collapsed(whole: Mesh, keep: float) -> Mesh | None:
    """Collapse edges of a clean mesh, and clean again, without measuring what that did.

    Args:
        whole: Clean and plain.
        keep: The share of its triangles to keep, above 0.

    Returns:
        About that share, or the least that can be reached; None where none is left.

    Raises:
        MissingExtraError: fast-simplification is not installed.
    """
    if keep >= 1.0:
        return whole
    try:
        from fast_simplification import simplify as collapse
    except ImportError as error:
        raise MissingExtraError(
            "simplifying needs fast-simplification", remedy='pip install "striptools[simplify]"'
        ) from error
    wanted = wanted_of(whole.triangle_count, keep)
    if wanted >= whole.triangle_count:
        return whole
    best = None
    for ways in (GENTLE, ROUGH):
        positions, faces = collapse(whole.positions, whole.faces, target_count=wanted, **ways)[:2]
        positions = np.asarray(positions, whole.positions.dtype)
        result = clean(replace(whole, positions=positions, faces=np.asarray(faces, np.int32))).mesh
        if result.triangle_count and (best is None or result.triangle_count < best.triangle_count):
            best = result
        if best is not None and reaches(best.triangle_count, wanted):
            return best
    return best


def wanted_of(triangles: int, keep: float) -> int:
    """How many of the triangles a share of them is, at least so many as simplifying leaves."""
    return max(LEAST_TRIANGLES, round(keep * triangles))


def reaches(triangles: int, wanted: float) -> bool:
    """Whether so many triangles count as the share that was asked."""
    return triangles <= (1 + OVER) * wanted
