"""The triangle tests that a tracer can be asked for, one trade of speed for exactness each.

`watertight`, the default, is `triangle`. The others take the corners in the canonical order, so that what a
test says of a ray and a triangle does not depend on how the triangle is stored:

1. `fast`: Moeller & Trumbore, "Fast, Minimum Storage Ray-Triangle Intersection", JGT 2(1), 1997, in float32,
   each product rounded. The ray's direction is (S_x, S_y, 1), whose t is the ray's times d_z: three products
   fewer. Not watertight: the two triangles of an edge round differently. On a CPU it is not faster either,
   and stands here to be measured.
2. `float64`: the watertight test in float64, of the direction as it was given. t is rounded to float32 last.
3. `exact-sign`: the watertight test, but whether a ray goes through a triangle is decided as exact arithmetic
   would: by the signs of the volumes U_a = d . (b x c), U_b = d . (c x a), U_c = d . (a x b) of the ray as it
   was given and of corners seen from its origin, nothing rounded. Edges and corners belong to all triangles
   that share them; a triangle seen edge-on is not hit. t is the watertight one.

How a sign is made exact, in three steps, each for the triangles that the one before leaves in doubt:

- float32: |U| of the sheared corners beyond `doubt_of` (derived there) has the sign of the volume;
- float64: with B = b - o rounded, |U| beyond 2^-50 of the sum of the sizes of its six products has (seven
  roundings each; Shewchuk, "Adaptive Precision Floating-Point Arithmetic and Fast Robust Geometric
  Predicates", Discrete & Computational Geometry 18, 1997, section 4.3);
- exactly: U = d . (b x c) + d . (o x b) + d . (c x o) is a sum of 18 products of three float32 numbers. A
  product of two has 48 bits, float64 holds it; it is cut into two numbers of 24 bits by a mask, and their
  products with the third are held again. So U is a sum of 36 float64 numbers, none rounded, which is added up
  to an expansion (Shewchuk, Theorem 10, Grow-Expansion by TwoSum); its largest part has the sign.

Every product in the last two steps is exact, or allowed for: a compiler that fuses it with a sum changes no
bit of the one, and makes the other no worse. TwoSum has no product. XLA does not reassociate sums, which
`measure.arithmetic` probes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from striptools.trace import numerics
from striptools.trace.numerics import (
    BY_XLA,
    Arithmetic,
    any_lane,
    ends_of,
    quotient,
    rounded,
    sign_of,
    with_sign_of,
)
from striptools.trace.triangle import Corners, Edges, Shear, crossing_of, edges_of, sheared
from striptools.types import TriangleTest

Points = tuple[Corners, Corners, Corners]
"""Coordinates x, y, z of corners a, b, c, along the axes of a shear."""


class Triangles(NamedTuple):
    """What a test is told of triangles.

    Attributes:
        x, y, z: Of corners a, b, c, along the axes of a shear.
        turn: Which corner is the first in the canonical order; None where that is corner a.
        filled: Which of them there are; None where the others are not a number. Of those anything is told.
    """

    x: Corners
    y: Corners
    z: Corners
    turn: Array | None
    filled: Array | None

    def in_order(self) -> Points:
        """Corners in the canonical order."""
        return _turned(self.x, self.turn), _turned(self.y, self.turn), _turned(self.z, self.turn)


LOWEST_DOUBLE = np.finfo(np.float64).min

FLUSHED = np.float32(2.0**-120)
"""What flushed denormals may change of a float32 edge function, and much more."""

IN_DOUBT = numerics.LOWEST
"""In the place of a t: not minus infinity, which stands for some misses."""

HIGH_HALF = np.int64(-(2**29))
"""The bits of a float64 that a float32 has too."""

TERMS = 36
"""Numbers that the exact volume is the sum of."""


def wants_way(test: TriangleTest) -> bool:
    """Whether a test asks for the direction as it was given."""
    return test in ("exact-sign", "float64")


def crossings_by(
    test: TriangleTest,
    triangles: Triangles,
    shear: Shear,
    arithmetic: Arithmetic = BY_XLA,
    again: Callable[[], Triangles] | None = None,
) -> Array:
    """Where a ray goes through triangles, float32: positive and finite only where it does.

    Args:
        test: By which test.
        triangles: Which ones.
        shear: Of the ray.
        arithmetic: Of the compiler at hand; the default for tests other than the default one.
        again: Makes the same triangles, where they have to be told once more.
    """
    if test == "watertight":
        x, y, z, turn, _ = triangles
        return crossing_of(edges_of(x, y, z, shear, arithmetic), turn, arithmetic)
    if test == "exact-sign":
        return _exact_sign(triangles, shear, again or (lambda: triangles))
    crossing = _fast if test == "fast" else _float64
    return lax.optimization_barrier(crossing(triangles.in_order(), shear))


def _turned(corners: Corners, turn: Array | None) -> Corners:
    """Corners in the canonical order."""
    if turn is None:
        return corners
    a, b, c = corners
    first, second, third = (
        jnp.where(turn == 0, one, jnp.where(turn == 1, two, three))
        for one, two, three in ((a, b, c), (b, c, a), (c, a, b))
    )
    return first, second, third


def _fast(corners: Points, shear: Shear) -> Array:
    """Moeller and Trumbore."""
    (ax, bx, cx), (ay, by, cy), (az, bz, cz) = corners
    one, two = (bx - ax, by - ay, bz - az), (cx - ax, cy - ay, cz - az)
    start = shear.origin[0] - ax, shear.origin[1] - ay, shear.origin[2] - az
    tilted_x, tilted_y = rounded(shear.x * two[2]), rounded(shear.y * two[2])
    twist = rounded(shear.x * two[1]) - rounded(shear.y * two[0])
    p = tilted_y - two[1], two[0] - tilted_x, twist
    q = _cross(start, one)
    determinant = _dot(one, p)
    sign = sign_of(determinant)
    size = with_sign_of(determinant, sign)
    u = with_sign_of(_dot(start, p), sign)
    v = with_sign_of(rounded(shear.x * q[0]) + rounded(shear.y * q[1]) + q[2], sign)
    along = with_sign_of(rounded(_dot(two, q) * shear.z), sign)
    inside = (u >= 0) & (v >= 0) & (u + v <= size)
    return quotient(jnp.where(inside, along, jnp.inf), size)


def _dot(a: Corners, b: Corners) -> Array:
    return rounded(a[0] * b[0]) + rounded(a[1] * b[1]) + rounded(a[2] * b[2])


def _cross(a: Corners, b: Corners) -> Corners:
    x, y, z = (rounded(a[j] * b[k]) - rounded(a[k] * b[j]) for j, k in ((1, 2), (2, 0), (0, 1)))
    return x, y, z


class _Double(NamedTuple):
    """A ray and triangles in float64: corners seen from the origin, which are rounded, and the direction."""

    x: Corners
    y: Corners
    z: Corners
    way: tuple[Array, Array, Array]


def _in_double(corners: Points, shear: Shear) -> _Double:
    """Take a ray and triangles to float64; to be called where x64 is enabled."""
    assert shear.way is not None
    x, y, z = (
        (a.astype(jnp.float64) - start, b.astype(jnp.float64) - start, c.astype(jnp.float64) - start)
        for (a, b, c), start in zip(corners, [o.astype(jnp.float64) for o in shear.origin], strict=True)
    )
    dx, dy, dz = (each.astype(jnp.float64) for each in shear.way)
    return _Double(x, y, z, (dx, dy, dz))


def _rounded_double(a: Array, b: Array) -> Array:
    """A product that is rounded before it is used; see `numerics.rounded`."""
    product = a * b
    return jnp.where(product > LOWEST_DOUBLE, product, LOWEST_DOUBLE)


IN_DOUBLE = BY_XLA._replace(product=_rounded_double)
"""Arithmetic of float64, as far as `edges_of` asks."""


def _float64(corners: Points, shear: Shear) -> Array:
    """The watertight test in float64."""
    with jax.enable_x64(True):
        x, y, z, way = _in_double(corners, shear)
        zero = jnp.zeros_like(way[0])
        upright = Shear(shear.axes, (zero, zero, zero), way[0] / way[2], way[1] / way[2], 1 / way[2])
        edges = edges_of(x, y, z, upright, IN_DOUBLE)
        return _crossing_in_double(edges)


def _crossing_in_double(edges: Edges) -> Array:
    """As `triangle.crossing_of`, rounded to float32 at the end."""
    a, b, c, heights, around, _ = edges
    inside = ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
    scaled_t = a * heights[0] + b * heights[1] + c * heights[2]
    t = jnp.where(inside & around, scaled_t, jnp.inf) / (a + b + c)
    return t.astype(jnp.float32)


def _exact_sign(triangles: Triangles, shear: Shear, again: Callable[[], Triangles]) -> Array:
    """The watertight test where float32 is sure of its signs, and exact ones elsewhere.

    Doubt is told in the place of t, and triangles in doubt are made again: two uses of a packed leaf would
    have it decoded twice, and a branch that takes its corners would have them kept.
    """
    corners = triangles.in_order()
    edges = edges_of(*corners, shear)
    doubt = doubt_of(corners, shear)
    least, most = ends_of((edges.a, edges.b, edges.c))
    # Not a sure miss, of two sure signs that differ; nor a sure hit; and not an empty lane, all of it NaN.
    doubtful = ((most <= doubt) | (least >= -doubt)) & (least <= doubt) & (most >= -doubt)
    if triangles.filled is not None:
        # Lanes that hold no triangle hold points that are one, of which nothing is ever sure.
        doubtful = doubtful & triangles.filled
    t = crossing_of(edges, arithmetic=UNSETTLED)
    t = lax.optimization_barrier(jnp.where(doubtful, IN_DOUBT, t))
    doubtful = t == IN_DOUBT

    def decided() -> Array:
        return jnp.where(doubtful, _decided(again().in_order(), shear, doubtful), t)

    return lax.cond(any_lane(doubtful), decided, lambda: t)


UNSETTLED = BY_XLA._replace(settled=lambda value: value)
"""Arithmetic of a value that is settled later."""


def doubt_of(corners: Points, shear: Shear) -> Array:
    """Beyond which size a watertight edge function surely has the sign of the volume it stands for.

    With u = 2^-24, S the largest sheared coordinate of the corners and H their largest height, M = S + H is
    no less than any coordinate seen from the origin. A sheared coordinate is off by d = 6 u M at most (a_x
    once, a_z, slope and product once each of S a_z <= M, the difference once of 2 M), so two products of two
    by 4 S d + 6 d^2, and their rounding adds 4 u S^2. With S' = S + 8 u M that is below 69 u S' M; 128 u S' M
    is what is taken.
    """
    x, y, z = sheared(*corners, shear)
    across = numerics.larger(_largest(x), _largest(y))
    reach = across + _largest(z)
    wider = across + reach * np.float32(2.0**-21)
    return rounded(wider * reach) * np.float32(2.0**-17) + FLUSHED


def _largest(corners: Corners) -> Array:
    """The largest of three, in size."""
    a, b, c = (jnp.abs(each) for each in corners)
    return numerics.larger(numerics.larger(a, b), c)


def _decided(corners: Points, shear: Shear, doubtful: Array) -> Array:
    """Where a ray goes through triangles, by exact signs; t in float64 of weights of those signs."""
    with jax.enable_x64(True):
        seen = _in_double(corners, shear)
        volumes, sizes = zip(*(_volume(seen, *edge) for edge in EDGES), strict=True)
        signs = jnp.stack([jnp.sign(volume).astype(jnp.int32) for volume in volumes])
        unsure = [
            ~(jnp.abs(u) > size * 2.0**-50) & (size != 0) for u, size in zip(volumes, sizes, strict=True)
        ]
        unsure = doubtful & (unsure[0] | unsure[1] | unsure[2])
        signs = lax.cond(any_lane(unsure), lambda: exact_signs(corners, shear), lambda: signs)
        least, most = ends_of((signs[0], signs[1], signs[2]))
        inside = ((least >= 0) & (most > 0)) | ((most <= 0) & (least < 0))

        weights = [jnp.where(signs[k] != 0, jnp.abs(volumes[k]), 0.0) for k in range(3)]
        none = weights[0] + weights[1] + weights[2] == 0
        a, b, c = (jnp.where(none, jnp.abs(signs[k]).astype(jnp.float64), weights[k]) for k in range(3))
        along = (a * seen.z[0] + b * seen.z[1] + c * seen.z[2]) / ((a + b + c) * seen.way[2])
        return jnp.where(inside, along, jnp.inf).astype(jnp.float32)


EDGES = ((1, 2), (2, 0), (0, 1))
"""The corners that the edge opposite to each runs between."""


def _volume(seen: _Double, j: int, k: int) -> tuple[Array, Array]:
    """The volume d . (b x c) of corners j and k in float64, and the sum of the sizes of what is added up."""
    x, y, z, way = seen
    terms = [
        (way[0] * (y[j] * z[k]), way[0] * (z[j] * y[k])),
        (way[1] * (z[j] * x[k]), way[1] * (x[j] * z[k])),
        (way[2] * (x[j] * y[k]), way[2] * (y[j] * x[k])),
    ]
    volume = (terms[0][0] - terms[0][1]) + (terms[1][0] - terms[1][1]) + (terms[2][0] - terms[2][1])
    sizes = [jnp.abs(one) + jnp.abs(two) for one, two in terms]
    return volume, sizes[0] + sizes[1] + sizes[2]


def exact_signs(corners: Points, shear: Shear) -> Array:
    """(3, ...) int32, -1, 0 or 1: the signs of the volumes of the edges opposite to corners a, b and c."""
    with jax.enable_x64(True):
        x, y, z = ([at.astype(jnp.float64) for at in axis] for axis in corners)
        assert shear.way is not None
        way = tuple(each.astype(jnp.float64) for each in shear.way)
        start = tuple(o.astype(jnp.float64) for o in shear.origin)
        at = [(x[k], y[k], z[k]) for k in range(3)]
        sums = [
            _terms(way, at[j], at[k]) + _terms(way, start, at[j]) + _terms(way, at[k], start)
            for j, k in EDGES
        ]
        shape = x[0].shape
        terms = jnp.stack(
            [jnp.stack([jnp.broadcast_to(edge[term], shape) for edge in sums]) for term in range(TERMS)]
        )
        return _sign_of_sum(terms)


def _terms(way: Any, p: Any, q: Any) -> list[Array]:
    """Twelve float64 numbers whose sum is d . (p x q), of three times three float32 ones: none is rounded."""
    found = []
    for axis in range(3):
        j, k = (axis + 1) % 3, (axis + 2) % 3
        for product, along in ((p[j] * q[k], way[axis]), (p[k] * q[j], -way[axis])):
            bits = lax.bitcast_convert_type(product, jnp.int64) & HIGH_HALF
            high = lax.bitcast_convert_type(bits, jnp.float64)
            found += [along * high, along * (product - high)]
    return found


def _sign_of_sum(terms: Array) -> Array:
    """The sign, int32, of sums of float64 numbers, (n, ...), by an expansion that nothing is lost from.

    None may be so small that a rounding error is denormal, which XLA flushes: terms are multiples of 2^-447.
    """
    count = len(terms)

    def grow(k: Array, expansion: Array) -> Array:
        def add(i: Array, carried: tuple[Array, Array]) -> tuple[Array, Array]:
            rest, expansion = carried
            part = _row(expansion, i)
            whole = rest + part
            virtual = whole - rest
            error = (rest - (whole - virtual)) + (part - virtual)
            return whole, lax.dynamic_update_index_in_dim(expansion, error, i, 0)

        rest, expansion = lax.fori_loop(jnp.int32(0), k, add, (_row(terms, k), expansion))
        return lax.dynamic_update_index_in_dim(expansion, rest, k, 0)

    def look(k: Array, sign: Array) -> Array:
        part = _row(expansion, k)
        return jnp.where(part > 0, jnp.int32(1), jnp.where(part < 0, jnp.int32(-1), sign))

    end = jnp.int32(count)
    expansion = lax.fori_loop(jnp.int32(0), end, grow, jnp.zeros_like(terms))
    return lax.fori_loop(jnp.int32(0), end, look, jnp.zeros(terms.shape[1:], jnp.int32))


def _row(values: Array, k: Array) -> Array:
    return lax.dynamic_index_in_dim(values, k, 0, keepdims=False)
