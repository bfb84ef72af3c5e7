"""The walk from a point to the closest triangle of a scene whose geometries stand in several places.

The walk of `walk_points` goes through the hierarchy over instances, whose leaves are instances; in each it
goes on from the geometry's root, with a stack of its own and with the closest triangle so far. Distances are
those to triangles where they stand (`standing`), in the flattened scene's order of corners and of faces: the
triangle found is the one that is found in the flattened scene.

**Boxes.** The boxes of a geometry's nodes are looked at from the point as it is moved into its frame. With A
and b what places the geometry, p the point and P the one it is moved to, r = A P + b - p is computed in
float64. A place q in a box stands at A q + b, which is A y - r away from p, y = q - P: at least |A y| - |r|.
Let B be A in other coordinates y' = V y of the geometry, A = B V, and d_k, at most |y'_k|, be how far P is
outside the box along the k-th of them. Then |A y|^2 = |B y'|^2 is at least the sum of (w_k d_k)^2 where B^T B
- W^2, W of diagonal w, has no negative eigenvalue: with n_k the length of column k of B, and l the least
eigenvalue of N^-1 B^T B N^-1, w_k = n_k root(l) is such.

V are the geometry's own axes where l is not small for them: it is 1 where columns are at right angles, that
is where a geometry is stretched along its axes and then turned, and then a box is as far as this says.
Elsewhere V are the right singular vectors of A, and boxes are put into larger ones along these.

Distances are shortened by what is rounded: by twice the largest of r, no less than its length; by twice the
margin of boxes that nothing rounds, 16 u s with u = 2^-24 and s the largest scaled coordinate of point and
scene, for boxes over instances and for corners, u s each, and for distances to triangles; and by twice that
margin of the geometry's own coordinates for turning boxes and point.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from striptools.trace.numerics import index, larger
from striptools.trace.standing import Standing
from striptools.trace.walk import MISS, STUCK, largest_of, names_leaf
from striptools.trace.walk_instances import InstancedScene, moved, row_of, value_at
from striptools.trace.walk_points import (
    Nearest,
    PointOptions,
    Search,
    box_squares,
    nothing_near,
    searched,
    visits_of,
)

WIDER = np.float32(2)
"""How many times the margin of boxes in a scene that does not round them."""


class ClosestInstance(NamedTuple):
    """One entry a point: see `walk_points.Closest`; and the instance, any where there is none."""

    name: Array
    instance: Array


class _Nearest(NamedTuple):
    """The closest triangle so far, its instance, and whether a walk in an instance did not end."""

    near: Nearest
    instance: Array
    stuck: Array

    @property
    def square(self) -> Array:
        """The square of its distance."""
        return self.near.square


def walk_point(
    scene: InstancedScene, point: Array, stack: Array, options: PointOptions
) -> tuple[Array, ClosestInstance]:
    """Walk from one point: a `walk_points.closest_triangles` of instances walks so."""
    at = (point[0], point[1], point[2])
    size = larger(largest_of(point[:3]), scene.frame.reach)
    margin = scene.frame.margin * size * WIDER
    floor = jnp.zeros_like(stack)

    def squares_of(node: Array) -> Array:
        return box_squares(scene.boxes_of(node), at, (margin, margin, margin))

    def visit(where: Array, nearest: _Nearest) -> _Nearest:
        there = names_leaf(where)
        number = jnp.where(there, -(where + 1), 0)
        inside = _search_inside(scene, number, point, margin, options)
        end = searched(inside, scene.root_of(number), there, floor, nearest.near)
        # Faces are numbered through all instances.
        closer = end.nearest.face != nearest.near.face
        instance = jnp.where(closer, number, nearest.instance)
        return _Nearest(end.nearest, instance, nearest.stuck | (end.height > 0))

    nothing = _Nearest(nothing_near(), jnp.int32(MISS), jnp.bool_(False))
    end = searched(Search(scene, squares_of, visit), jnp.int32(0), point[3] > 0, stack, nothing)
    near, instance, stuck = end.nearest
    name = jnp.where((end.height > 0) | stuck, STUCK, near.name)
    return end.stack, ClosestInstance(name, instance)


def _search_inside(
    scene: InstancedScene, number: Array, point: Array, margin: Array, options: PointOptions
) -> Search:
    """The search in one instance: boxes as its geometry has them, stretched, triangles where they stand."""
    at, geometries = index(number), scene.geometries
    assert scene.places is not None
    stands, bounds = scene.standing(number), row_of(scene.places.bounds, at)
    seen, off = _moved(stands, row_of(scene.matrices, at), point[:3])
    axes, stretch = bounds[:, :3], bounds[:, 3]
    size = _turned(jnp.abs(axes), larger(jnp.abs(seen), value_at(scene.reaches, at)))
    margins = stretch * (WIDER * geometries.frame.margin) * size + (margin + off)
    place = stretch * _turned(axes, seen)
    # A point too far for the geometry's frame sees all of it.
    far = ~jnp.isfinite(place + margins).all()
    place, margins = jnp.where(far, 0, place), jnp.where(far, jnp.inf, margins)

    def squares_of(node: Array) -> Array:
        boxes = geometries.boxes_of(node)
        middle, half = (boxes[3:] + boxes[:3]) / 2, (boxes[3:] - boxes[:3]) / 2
        middle, half = (stretch[:, None] * _turned(*pair) for pair in ((axes, middle), (jnp.abs(axes), half)))
        sides = jnp.concatenate([middle - half, middle + half])
        return box_squares(sides, (place[0], place[1], place[2]), (margins[0], margins[1], margins[2]))

    return Search(stands, squares_of, visits_of(stands, (point[0], point[1], point[2]), options.decode))


def _moved(stands: Standing, matrix: Array, point: Array) -> tuple[Array, Array]:
    """A point (3,) in the frame of a geometry, and no less than how far that is off where it stands.

    Args:
        stands: The instance.
        matrix: (3, 4) float32, from the scene to the geometry.
        point: (3,) float32.
    """
    seen = moved(matrix, point, point)[0]
    # Once more, since the matrix is rounded.
    seen = seen - _turned(matrix, stands.residual(seen, point)[0])
    return seen, WIDER * stands.residual(seen, point)[1]


def _turned(rows: Array, vectors: Array) -> Array:
    """(3, ...) vectors by the first three columns of rows."""
    x, y, z = (rows[:, axis].reshape(3, *(1,) * (vectors.ndim - 1)) * vectors[axis] for axis in range(3))
    return x + y + z


# Notes
#
# 40 chandeliers, 10,000 points all over the scene and as many near a surface, one thread; time over that of
# the flattened scene: turned and evenly scaled 2.2 and 2.0, compressed 2.3 and 1.9; sheared, and stretched
# unevenly by up to 100, 1.3 and 1.8, compressed 1.7 and 2.2. Lost, in time over what stands here: boxes
# along the axes of the scene round each turned box, 2 to 3, by visits. Any factor by which far boxes are
# taken to be nearer than they are has a small instance searched whole, so own axes are for matrices that
# are upright to 2^-12: with own axes up to l of 1/4, 30 times as long on the sheared ones.
