"""Exact answers: one ray and one face in integers, for where float64 itself is in doubt.

Every float32 is an integer times 2^-149, so every number here is one times `UNIT`. With a, b, c the corners
seen from the origin and d the direction, the volumes U_a = d . (b x c), U_b = d . (c x a), U_c = d . (a x b)
have one sign where the ray's line meets the face, borders included, and t = a . (b x c) / (U_a + U_b + U_c)
(Moeller and Trumbore, "Fast, Minimum Storage Ray-Triangle Intersection", JGT 2(1), 1997, as triple products):
integers until the last division, which is a `Fraction`. Nothing is rounded anywhere. Cost: tens of
microseconds a pair.
"""

import math
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

UNIT_EXPONENT = -300
"""Of what numbers count in: finer than any float32 that was scaled by a power of two of float32's range."""

Vector = tuple[int, int, int]


@dataclass(frozen=True)
class ExactPair:
    """What a ray and a face say.

    Attributes:
        inside: The ray's line meets the face, borders included; never of a face seen edge-on.
        t: Of the face's plane; None where the ray is parallel to it, or the face has no area.
        nearest: The least t at which the plane through a corner, upright to the ray's main axis, is crossed.
        farthest: The greatest.
    """

    inside: bool
    t: Fraction | None
    nearest: Fraction
    farthest: Fraction

    @property
    def hit(self) -> bool:
        """Whether the ray hits the face, at t > 0."""
        return self.inside and self.t is not None and self.t > 0

    @property
    def clamped(self) -> Fraction | None:
        """T of the plane, no nearer and no farther than the corners."""
        return None if self.t is None else min(max(self.t, self.nearest), self.farthest)


def exact_pair(origin: np.ndarray, direction: np.ndarray, corners: np.ndarray) -> ExactPair:
    """Judge a ray, (3,) and (3,), and a face, (3, 3): finite float32 values or those times a power of two."""
    start, d = _integers(origin), _integers(direction)
    a, b, c = (_less(_integers(corner), start) for corner in corners)
    volumes = (_dot(d, _cross(b, c)), _dot(d, _cross(c, a)), _dot(d, _cross(a, b)))
    total = sum(volumes)
    inside = total != 0 and (min(volumes) >= 0 or max(volumes) <= 0)
    t = Fraction(_dot(a, _cross(b, c)), total) if total else None
    z = max(range(3), key=lambda axis: abs(d[axis]))
    heights = [Fraction(corner[z], d[z]) for corner in (a, b, c)]
    return ExactPair(inside, t, min(heights), max(heights))


def _integers(vector: np.ndarray) -> Vector:
    x, y, z = (_integer(float(value)) for value in vector)
    return x, y, z


def _integer(value: float) -> int:
    """A value in units of 2 to `UNIT_EXPONENT`, without a rounding."""
    fraction, exponent = math.frexp(value)
    whole, shift = int(math.ldexp(fraction, 53)), exponent - 53 - UNIT_EXPONENT
    if shift >= 0:
        return whole << shift
    if whole & ((1 << -shift) - 1):
        raise ValueError(f"{value} is no multiple of 2^{UNIT_EXPONENT}")
    return whole >> -shift


def _less(a: Vector, b: Vector) -> Vector:
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


def _dot(a: Vector, b: Vector) -> int:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
