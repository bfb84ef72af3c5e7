"""Conservative ray-box test of the eight lanes of a wide node.

Ize, "Robust BVH Ray Traversal", JCGT 2(2), 2013: the slab test misses boxes that the ray does meet, by
rounding; making the far distance larger by 2 gamma_3 (gamma_n = n u / (1 - n u), u = 2**-24) mends it.

Differences:

1. The triangle test rounds too: it may report a triangle that the exact ray passes by. Each box is therefore
   widened on all sides, see below.
2. A direction component that is zero, or too small to cross the scene, is replaced by a tiny one of the
   same sign: with the margin, a ray that runs exactly in a box's side meets the box, and there is no 0 *
   inf.
3. minimum and maximum are comparisons and selects. Empty lanes hold NaN and are never met.
4. (side - origin) * inverse is side * inverse - origin * inverse, one fused step a side, or two.

**How far.** In scaled coordinates let L be the largest coordinate of the ray's origin o and of the scene, and
a = v - o for a corner v of a triangle, so that no component of a is above 2L. With S the slope of the ray, at
most 1, the test computes p = fl(fl(a_x) - fl(fl(S) fl(a_z))), off by at most

    u |a_x| + gamma_3 |S a_z| + u |p|.

It accepts only where 0 is in the hull of the three p, or beyond one of its edges because the two products of
an edge function were rounded. That edge then has its ends on both sides of 0 in x and in y (`triangle`,
difference 6: where they are on one side in both, a wrong sign leaves 0 inside by the two others), so on each
axis it passes 0 within 2 u r (1 - r) E F / (E + F), with E and F its extents in x and y, at most 4L, and r
the share of it at which it passes. So some point of the triangle lies off the ray by the errors of its
corners, weighed by what makes 0 of their p, and by that distance. Near a corner p is small, a_x is S a_z, and
the errors are u + 3u times 2L. In the middle of a large edge they are less, because no origin has both ends
of it 2L away, and leave room for the rest. The largest sum is 8uL to first order, and gamma_4 2L in all:
`REACH`.

The slab test itself: rounding o +- margin moves a side by uL, rounding its product with the inverse by uL,
and rounding side * inverse, where that is not fused, by uL: `ROUNDINGS`. What is left is relative to the
distance, the inverse and the last difference, for each of the two distances that are compared, and the
product by `FAR_FACTOR`: five roundings for which it has eight. Both together are 11uL, and `MARGIN` is 16uL,
a power of two. The most that was found to be needed is 6.99uL across the ray, and 3.9uL on all sides.

This is about the ray's line: it meets the box of a triangle that is accepted. Of one seen so exactly edge-on
that its t is noise it does not say where on the line that t is.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from striptools.trace.numerics import larger, smaller

Coordinates = Array | tuple[Array, Array, Array]
"""Of a point or direction along three axes."""

FAR_FACTOR = np.float32(1 + 2**-21)
"""At least 1 + 2 gamma_3."""

U = 2.0**-24

REACH = 8 * U * (1 + 2.0**-18)
"""How far from a box a ray may hit a triangle in it, in units of the largest coordinate of both."""

ROUNDINGS = 3 * U * (1 + 2.0**-18)
"""How far the slab test moves a side, in the same units."""

MARGIN = np.float32(2**-20)
"""Widening of a box in the same units: no less than `REACH` and `ROUNDINGS`."""

TINY = np.float32(2**-60)
"""The smallest direction component, for a direction whose largest is 1 to 2."""


class Slab(NamedTuple):
    """Origin times inverse direction, for low and for high sides, and the inverse direction.

    Three each; counted from the frame's `low` and in its `unit`.
    """

    low: Any
    high: Any
    inverse: Any


def slab_of(origin: Coordinates, direction: Coordinates, frame: Any) -> Slab:
    """Slab constants of a ray, or of many at once.

    Args:
        origin: Three float32.
        direction: Three float32, the largest 1 to 2 in size.
        frame: A `walk.Frame`.
    """
    largest = larger(larger(abs(origin[0]), abs(origin[1])), larger(abs(origin[2]), frame.reach))
    margin = frame.margin * largest
    low, high, inverse = [], [], []
    for at, way, start, unit in zip(origin, direction, frame.low, frame.unit, strict=True):
        tiny = jnp.where(way < 0, -TINY, TINY)
        turned = 1 / jnp.where(abs(way) < TINY, tiny, way)
        low.append((at + margin - start) * turned)
        high.append((at - margin - start) * turned)
        inverse.append(turned * unit)
    return Slab(low, high, inverse)


def lanes_met(boxes: Array, slab: Slab, nearest: Array) -> Array:
    """Which of the boxes the ray meets at a distance of 0 to `nearest`.

    Args:
        boxes: (6, 8) float32, lo xyz and hi xyz by lane.
        slab: Of the ray.
        nearest: The distance beyond which a box does not matter.
    """
    low = [boxes[axis] * slab.inverse[axis] - slab.low[axis] for axis in range(3)]
    high = [boxes[axis + 3] * slab.inverse[axis] - slab.high[axis] for axis in range(3)]
    return passes(low, high, nearest)


def passes(low: list[Array], high: list[Array], nearest: Array) -> Array:
    """Whether a ray is inside on all axes at once: distances of low and of high sides, by axis."""
    return entries_of(low, high, nearest)[1]


def entries_of(low: list[Array], high: list[Array], nearest: Array) -> tuple[Array, Array]:
    """Where a ray enters, and whether it `passes`: distances of low and of high sides, by axis."""
    entries = [smaller(a, b) for a, b in zip(low, high, strict=True)]
    exits = [larger(a, b) for a, b in zip(low, high, strict=True)]
    entry = larger(larger(entries[0], entries[1]), larger(entries[2], jnp.float32(0)))
    leaving = smaller(exits[0], smaller(exits[1], exits[2])) * FAR_FACTOR
    return entry, (entry <= nearest) & (entry <= leaving)
