"""Conservative ray-box test of the eight lanes of a wide node.

Ize, "Robust BVH Ray Traversal", JCGT 2(2), 2013: the slab test misses boxes that the ray does meet, by
rounding; making the far distance larger by 2 gamma_3 (gamma_n = n u / (1 - n u), u = 2**-24) mends it.

Differences:

1. The triangle test rounds too, by up to a few units in the last place of the coordinates seen from the
   ray: it may report a triangle that the exact ray passes by. Each box is therefore widened on all sides by
   `margin_of` the ray.
2. A direction component that is zero, or too small to cross the scene, is replaced by a tiny one of the
   same sign: with the margin, a ray that runs exactly in a box's side meets the box, and there is no 0 *
   inf.
4. (side - origin) * inverse is side * inverse - origin * inverse, one fused step a side. Rounding the second
   product moves a side by at most u times the origin's coordinate, an eighth of the margin (where nothing is
   fused, as much again for the first); the roundings of the rest are relative to the distance.
3. minimum and maximum are comparisons and selects. Empty lanes hold NaN and are never met.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from striptools.trace.numerics import larger, smaller

FAR_FACTOR = np.float32(1 + 2**-21)
"""At least 1 + 2 gamma_3."""

MARGIN = np.float32(2**-21)
"""Widening of a box in units of the largest coordinate of ray origin and scene."""

TINY = np.float32(2**-60)
"""The smallest direction component, for a direction whose largest is 1 to 2."""


class Slab(NamedTuple):
    """Origin times inverse direction, for low and for high sides, and the inverse direction.

    (3,) each; counted from the frame's `low` and in its `unit`.
    """

    low: Array
    high: Array
    inverse: Array


def slab_of(origin: Array, direction: Array, frame: Any) -> Slab:
    """Slab constants of a ray.

    Args:
        origin: (3,) float32.
        direction: (3,) float32, its largest component 1 to 2 in size.
        frame: A `walk.Frame`.
    """
    size = jnp.abs(origin)
    margin = frame.margin * larger(larger(size[0], size[1]), larger(size[2], frame.reach))
    tiny = jnp.where(direction < 0, -TINY, TINY)
    inverse = 1 / jnp.where(jnp.abs(direction) < TINY, tiny, direction)
    low, high = origin + margin - frame.low, origin - margin - frame.low
    return Slab(low * inverse, high * inverse, inverse * frame.unit)


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
    return entry, entry <= smaller(nearest, leaving)
