"""Watertight ray-triangle test.

Woop, Benthin & Wald, "Watertight Ray/Triangle Intersection", JCGT 2(1), 2013: the triangle is moved and
sheared so that the ray runs along one axis from the origin; the signs of three 2-D edge functions tell
whether it goes through. Two triangles that share an edge evaluate the same function of the same two points,
up to its sign, so that no ray slips through between them.

Differences:

1. The paper relies on the compiler not to fuse products and sums. XLA always fuses, so each product is
   rounded by `numerics.rounded`: then P x Q = -(Q x P) bit for bit, and a triangle that is degenerate after
   shearing has det = 0.
2. No recomputation in double precision where an edge function is zero: edges count as inside on both sides,
   so a zero can only make both neighbours be hit, not neither.
3. Two-sided; the sign of the determinant is divided out by bits.
4. The ray's dominant axis is not swapped to keep the winding, which a two-sided test does not need.
5. Every product in t is rounded too: t is the same whichever walk, number of rays at once or platform's
   fusion.
6. A triangle whose sheared corners all lie on one side of the ray, in x or in y, is not hit. The three signs
   of a needle seen along its line, or of a triangle smaller than the rounding of its distance, are noise, and
   without this rays that pass it by far may be taken to hit it. It opens no gap: corners are shared bit for
   bit, and a sign can be wrong only where two products nearly cancel. There the edge's ends lie on both sides
   of the ray in x and in y, or on it, or else the ray lies beyond an end, where another sign rejects.

Corners come in the canonical order of `kernels.wide.fill_leaf_blocks`.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from striptools.trace.box import Coordinates
from striptools.trace.numerics import (
    BY_XLA,
    Arithmetic,
    larger,
    rounded,
    sign_of,
    smaller,
    with_sign_of,
)

Corners = tuple[Array, Array, Array]
"""One coordinate of the three corners a, b, c of a triangle, or (8,) each of a leaf's lanes."""

FARTHER = np.float32(1 + 2**-20)
"""More than a quotient, and two products in its place, are rounded by: six times 2**-24."""

DOUBT = np.float32(2**-20)
"""More than a sum of three changes with their order, by the sum of their sizes: four times 2**-24."""

FLUSHED = np.float32(2.0**-122)
"""More than it changes where a part of it is so small that it becomes zero."""


class Shear(NamedTuple):
    """A ray as the test sees it: axes (z dominant), origin along them, and the shear that sets it upright.

    `way` is its direction along the axes, unrounded, where a test asks for it (`triangle_tests.wants_way`).
    """

    axes: tuple[Array, Array, Array]
    origin: tuple[Array, Array, Array]
    x: Array
    y: Array
    z: Array
    way: tuple[Array, Array, Array] | None = None


class Edges(NamedTuple):
    """Edge functions of a triangle, heights of its corners, and whether the corners lie around the ray.

    Corner weights are a, b, c over their sum; y are the corners' second sheared coordinates.
    """

    a: Array
    b: Array
    c: Array
    heights: Corners
    around: Array
    y: Corners


def shear_of(origin: Coordinates, direction: Coordinates, arithmetic: Arithmetic = BY_XLA) -> Shear:
    """Shear constants of a ray, or of many at once; `direction` must not be zero."""
    size = [abs(way) for way in direction]
    z = jnp.where((size[0] >= size[1]) & (size[0] >= size[2]), 0, jnp.where(size[1] >= size[2], 1, 2))
    x = jnp.where(z == 2, 0, z + 1)
    y = jnp.where(x == 2, 0, x + 1)

    depth = pick(direction, z)
    axes = (x.astype(jnp.uint32), y.astype(jnp.uint32), z.astype(jnp.uint32))
    return Shear(
        axes,
        (pick(origin, x), pick(origin, y), pick(origin, z)),
        arithmetic.quotient(pick(direction, x), depth),
        arithmetic.quotient(pick(direction, y), depth),
        arithmetic.quotient(jnp.ones_like(depth), depth),
    )


def pick(vector: Coordinates, axis: Array) -> Array:
    """The coordinate of a (3,) vector along an axis."""
    return jnp.where(axis == 0, vector[0], jnp.where(axis == 1, vector[1], vector[2]))


def edges_of(x: Corners, y: Corners, z: Corners, shear: Shear, arithmetic: Arithmetic = BY_XLA) -> Edges:
    """Edge functions of one triangle or of a block of them, its coordinates along the axes of the shear."""
    x, y, heights = sheared(x, y, z, shear, arithmetic)
    a, b, c = (arithmetic.product(h, shear.z) for h in heights)
    around = _straddle(*x, arithmetic) & _straddle(*y, arithmetic)
    return Edges(*edge_functions(x, y, arithmetic), (a, b, c), around, y)


def edge_functions(x: Corners, y: Corners, arithmetic: Arithmetic = BY_XLA) -> tuple[Array, Array, Array]:
    """Of the edges across from corners a, b and c, of sheared corners."""
    product = arithmetic.product
    (ax, bx, cx), (ay, by, cy) = x, y
    return (
        product(cx, by) - product(cy, bx),
        product(ax, cy) - product(ay, cx),
        product(bx, ay) - product(by, ax),
    )


def sheared(
    x: Corners, y: Corners, z: Corners, shear: Shear, arithmetic: Arithmetic = BY_XLA
) -> tuple[Corners, Corners, Corners]:
    """Corners as a ray sees them that is upright in 0, and how far along its axis they are."""
    product = arithmetic.product
    heights = [at - shear.origin[2] for at in z]
    ax, bx, cx = (at - shear.origin[0] - product(shear.x, h) for at, h in zip(x, heights, strict=True))
    ay, by, cy = (at - shear.origin[1] - product(shear.y, h) for at, h in zip(y, heights, strict=True))
    return (ax, bx, cx), (ay, by, cy), (heights[0], heights[1], heights[2])


def _straddle(a: Array, b: Array, c: Array, arithmetic: Arithmetic) -> Array:
    """Whether three coordinates lie on both sides of zero, or on it."""
    smaller, larger = arithmetic.smaller, arithmetic.larger
    return (smaller(smaller(a, b), c) <= 0) & (larger(larger(a, b), c) >= 0)


def crossing_of(edges: Edges, turn: Array | None = None, arithmetic: Arithmetic = BY_XLA) -> Array:
    """Where along a ray its line goes through each triangle: positive and finite only where it does.

    The division comes last on purpose: XLA computes a division once, all that is cheap again for each use.

    Args:
        edges: Of the triangles.
        turn: Which corner is the first in the canonical order; None where that is corner a.
        arithmetic: Of the compiler at hand.
    """
    a, b, c, heights, around, _ = edges
    product = arithmetic.product
    inside = ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
    determinant = _summed(a, b, c, turn)
    scaled_t = _summed(product(a, heights[0]), product(b, heights[1]), product(c, heights[2]), turn)
    sign = sign_of(determinant)
    scaled_t = with_sign_of(jnp.where(inside & around, scaled_t, jnp.inf), sign)
    return arithmetic.settled(arithmetic.quotient(scaled_t, with_sign_of(determinant, sign)))


def may_cross(edges: Edges, nearest: Array, *, in_order: bool) -> Array:
    """Whether `crossing_of` may be positive and at most `nearest`: where it is, this is true.

    Cheaper, as nothing divides and no corners are compared: rays miss all triangles of most leaves. What is
    divided there is compared here, up to roundings.

    Args:
        edges: Of the triangles.
        nearest: Of the closest hit so far.
        in_order: Whether corner a is the first in the canonical order, so that sums are those of
            `crossing_of`. Else three numbers of any sign may add up to another sign than there.
    """
    a, b, c, heights, _, _ = edges
    inside = ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
    determinant = a + b + c
    first, second, third = (rounded(edge * at) for edge, at in zip((a, b, c), heights, strict=True))
    scaled_t = first + second + third
    sign = sign_of(determinant)
    scaled_t = with_sign_of(scaled_t, sign)
    reach = with_sign_of(determinant, sign) * (nearest * FARTHER)
    if in_order:
        return inside & (scaled_t > 0) & (scaled_t <= reach)
    doubt = (jnp.abs(first) + jnp.abs(second) + jnp.abs(third)) * DOUBT + FLUSHED
    return inside & (scaled_t >= -doubt) & (scaled_t - doubt <= reach)


def windings_of(edges: Edges, shear: Shear) -> Array:
    """Whether the ray leaves a body through each triangle ahead, int32: 1 leaves, -1 enters, 0 neither.

    The point 0 of the sheared plane is in a triangle where the half-line to its right is crossed once, by an
    edge that goes up or by one that goes down (Hormann & Agathos, "The Point in Polygon Problem for Arbitrary
    Polygons", Computational Geometry 20(3), 2001, section 2). An edge goes up from y <= 0 to y > 0, and is
    crossed where its edge function tells: the face on its other side sees the same crossing with the other
    sign, bit for bit, zeros included. So a ray through an edge or a corner of a closed mesh is counted as if
    it passed beside it, and never twice.

    """
    a, b, c, heights, _, y = edges
    up = [at > 0 for at in y]
    down = [at <= 0 for at in y]

    def crossed(area: Array, first: int, second: int) -> Array:
        # `area` is twice that of the triangle of 0, the edge's second end and its first.
        rises = down[first] & up[second] & (area < 0)
        falls = up[first] & down[second] & (area > 0)
        return jnp.where(rises, jnp.int32(1), jnp.int32(0)) - jnp.where(falls, jnp.int32(1), jnp.int32(0))

    turns = crossed(c, 0, 1) + crossed(a, 1, 2) + crossed(b, 2, 0)
    scaled_t = rounded(a * heights[0]) + rounded(b * heights[1]) + rounded(c * heights[2])
    # Where all corners are on one side no weight, which may be noise, has a say.
    nearest, farthest = smaller(smaller(*heights[:2]), heights[2]), larger(larger(*heights[:2]), heights[2])
    ahead = (nearest > 0) | ((farthest > 0) & (jnp.where(turns > 0, -scaled_t, scaled_t) > 0))
    outward = jnp.where(shear.z < 0, -turns, turns)
    return jnp.where(ahead, outward, 0)


def _summed(a: Array, b: Array, c: Array, turn: Array | None) -> Array:
    """The sum in the canonical order: all that turning a triangle's corners changes; edges turn with them.

    Edges a, b, c of corners (a, b, c) are edges c, a, b of (b, c, a), bit for bit.
    """
    if turn is None:
        return a + b + c
    last = jnp.where(turn == 0, c, jnp.where(turn == 1, a, b))
    return jnp.where(turn == 0, a, c) + jnp.where(turn == 2, a, b) + last
