"""Move float64 positions to an origin of their own, so that float32 loses least.

A survey's coordinates are metres from a point hundreds of kilometres away, of which float32 keeps half a
metre. Near their own middle it keeps millionths. The origin is the middle of the bounds, rounded to a
multiple of a power of two near the model's half extent, so that taking it away is exact in float64 wherever
the coordinate's last bit is not finer than the difference can hold; what is not exact is measured like the
rounding to float32 that follows.

A model gets an origin only where that makes its largest rounding `LEAST_GAIN` times smaller: every frame of
its own is one more thing that its users must know of, and a model around zero, whose decimals are rounded
anyway, is not worth one.
"""

from __future__ import annotations

import math

import numpy as np
from jaxtyping import Float64

from striptools.types import Positions

CHUNK = 1 << 16
LEAST_GAIN = 8.0

Origin = Float64[np.ndarray, "3"]
"""What is added to positions to be where the source is."""


def recentred(
    source: np.ndarray, rounded: Positions, largest_rounding: float
) -> tuple[Positions, float, Origin | None]:
    """Positions about an origin, or those given where none pays.

    Args:
        source: `(v, 3)` float64, as loaded.
        rounded: `(v, 3)` float32, the same rounded where they stand.
        largest_rounding: The largest change of a coordinate by that.

    Returns:
        float32 positions; the largest change of a coordinate, `origin + position` in exact arithmetic against
        the source; and the origin, None where there is none. Which vertices are finite is the same as before.
    """
    origin = choose_origin(source, rounded)
    if origin is None:
        return rounded, largest_rounding, None
    moved = np.zeros(source.shape, np.float32)
    largest = 0.0
    for begin in range(0, len(source), CHUNK):
        part = slice(begin, begin + CHUNK)
        moved[part], change = _moved(source[part], origin)
        finite = np.isfinite(rounded[part])
        moved[part][~finite] = rounded[part][~finite]
        largest = max(largest, float(np.max(change, initial=0.0, where=finite)))
    if not largest * LEAST_GAIN <= largest_rounding:
        return rounded, largest_rounding, None
    return moved, largest, origin


def choose_origin(source: np.ndarray, rounded: Positions) -> Origin | None:
    """The origin for positions, from those that float32 can hold; None where it would be zero."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for begin in range(0, len(source), CHUNK):
        part = slice(begin, begin + CHUNK)
        finite = np.isfinite(rounded[part]).all(axis=1)
        low = np.minimum(low, source[part][finite].min(axis=0, initial=np.inf))
        high = np.maximum(high, source[part][finite].max(axis=0, initial=-np.inf))
    if not (low <= high).all():
        return None
    origin = np.array([_rounded_middle(a, b) for a, b in zip(low.tolist(), high.tolist(), strict=True)])
    return origin if origin.any() else None


def _rounded_middle(low: float, high: float) -> float:
    """The middle of an interval, rounded to a multiple of a power of two near half its length."""
    middle, half = (low + high) / 2, (high - low) / 2
    if half == 0:
        return middle
    unit = math.ldexp(1.0, max(math.frexp(half)[1] - 1, -1000))
    return round(middle / unit) * unit


def displacement(source: np.ndarray, origin: Origin, positions: np.ndarray) -> np.ndarray:
    """How far `origin + positions` is from the source, all of one shape, the origin's last axis x, y, z.

    The error of taking the origin away is its two-sum remainder (Knuth, TAOCP 2, 4.2.2); what is left is one
    subtraction's rounding.
    """
    difference = source - origin
    taken = difference - source
    lost = (source - (difference - taken)) - (origin + taken)
    return (positions - difference) - lost


def _moved(source: np.ndarray, origin: Origin) -> tuple[Positions, np.ndarray]:
    """Positions less the origin in float32, and how far each coordinate then is from its source."""
    with np.errstate(all="ignore"):
        moved = (source - origin).astype(np.float32)
        return moved, np.abs(displacement(source, origin, moved)) * (1 + 2.0**-50)
