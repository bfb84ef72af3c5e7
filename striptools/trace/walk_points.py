"""The walk from a point to the closest triangle: branch and bound through the same eight-wide hierarchy.

Roussopoulos, Kelley & Vincent, "Nearest Neighbor Queries", SIGMOD 1995: children are visited by the distance
of their boxes, and left out where that is beyond the closest triangle found.

Differences:

1. The stack holds nodes and the lanes not yet visited. Whenever a node is on top the distances of its boxes
   are computed again, so that the nearest lane is taken by what is known now; nothing is sorted or kept.
2. Distance to a triangle is the least of those to its three edges and, where the point's foot is inside, to
   its foot (after Ericson, "Real-Time Collision Detection", 2005, section 5.1.5): each is the distance of a
   point of the triangle, so that noise in a sliver's signs can only make it look farther than it is.
3. Products are rounded one by one: the triangle found is the same in each residency.

Cost: a turn a visit to a node or leaf, and one to leave a node. Distances are float32 in the scene's scale:
that of the triangle found is at most 2**-20 of the largest coordinate of point and scene beyond the least,
which the tests hold against float64.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from striptools.trace.numerics import folded, index, larger, rounded, smaller
from striptools.trace.triangle import pick
from striptools.trace.walk import DONE, MISS, NO_NAME, STUCK, Decode, Frame, Leaf, WalkScene, names_leaf

FARTHEST = np.float32(2.0**60)
"""The largest scaled coordinate of a point that can be looked from: squares stay finite."""

LANE_BITS = np.int32(15)
"""The bits of a square that say a lane when the nearest is chosen: the order of visits needs no more."""

Vector = tuple[Array, Array, Array]


class Nearest(NamedTuple):
    """The closest triangle so far: the square of its distance, its name and its face."""

    square: Array
    name: Array
    face: Array


class Searched(NamedTuple):
    """Where a search is, or where it ended: without one step too many only at a height of 0."""

    stack: Array
    height: Array
    turns: Array
    nearest: Any


@dataclass(frozen=True)
class Search:
    """What a search from a point goes through: nodes, and leaves of triangles or of something else.

    Attributes:
        scene: Whose nodes they are: of `WalkScene` `width`, `node_count`, `child_of` and `find_leaf`.
        squares_of: From a node, the squares of the distances of its children, (width,) float32, at most the
            true ones; not a number in empty lanes.
        visit: From what `find_leaf` says of a leaf and the closest so far, which has a `square`, the closest
            after it.
    """

    scene: Any
    squares_of: Callable[[Array], Array]
    visit: Callable[[Any, Any], Any]


class PointOptions(NamedTuple):
    """What is compiled in, as in `walk.WalkOptions`."""

    stack_size: int
    batch: bool
    decode: Decode | None


class Closest(NamedTuple):
    """One entry a point: what the scene calls the triangle, `walk.MISS` or `walk.STUCK`."""

    name: Array


def closest_triangles(scene: Any, points: Array, options: PointOptions, walk_one: Any = None) -> Any:
    """Walk from r points: a `Closest`, or what another walk finds.

    Args:
        scene: What to search, a `WalkScene`.
        points: (r, 4) float32, scaled coordinates, and 1; a row of zeros ends at once.
        options: What to compile in.
        walk_one: From scene, point, stack and options the stack and what is found; None for `walk_point`.
    """
    floor = jnp.zeros((options.stack_size, 2), jnp.int32)
    walk_one = walk_one or walk_point

    def walk(stack: Array, point: Array) -> tuple[Array, Any]:
        return walk_one(scene, point, stack, options)

    if options.batch:
        return jax.vmap(lambda point: walk(floor, point)[1])(points)
    return lax.scan(walk, floor, points)[1]


def walk_point(scene: WalkScene, point: Array, stack: Array, options: PointOptions) -> tuple[Array, Closest]:
    """Walk from one point; the stack may hold anything, and serves the next."""
    at = (point[0], point[1], point[2])
    search = search_of(scene, at, margin_of(scene.frame, at), options.decode)
    end = searched(search, jnp.int32(0), point[3] > 0, stack, nothing_near())
    name = jnp.where(end.height > 0, STUCK, end.nearest.name)
    return end.stack, Closest(name)


def margin_of(frame: Frame, at: Vector) -> Array:
    """What boxes are widened by, for a point."""
    size = larger(larger(jnp.abs(at[0]), jnp.abs(at[1])), larger(jnp.abs(at[2]), frame.reach))
    return frame.margin * size


def nothing_near() -> Nearest:
    """What is closest before anything is looked at."""
    return Nearest(*(jnp.asarray(value) for value in (np.float32(np.inf), MISS, NO_NAME)))


def search_of(scene: WalkScene, at: Vector, margin: Array, decode: Decode | None) -> Search:
    """The search for the closest triangle of a scene."""

    def squares_of(node: Array) -> Array:
        return box_squares(scene.boxes_of(node), at, (margin, margin, margin))

    return Search(scene, squares_of, visits_of(scene, at, decode))


def visits_of(scene: Any, at: Vector, decode: Decode | None) -> Callable[[Any, Nearest], Nearest]:
    """The `visit` of a search for the closest triangle, in a scene that has leaves as a `WalkScene` has."""

    def visit(where: Any, nearest: Nearest) -> Nearest:
        return _visit_leaf(scene, at, where, nearest, decode)

    return visit


def searched(search: Search, root: Array, there: Array, stack: Array, nearest: Any) -> Searched:
    """Search from a node on, where there is anything to search; `stack` may hold anything."""
    width = search.scene.width
    first = jnp.stack([root, jnp.int32(2**width - 1)])
    stack = lax.dynamic_update_slice(stack, first[None], (jnp.uint32(0), jnp.uint32(0)))
    height = jnp.where(there, jnp.int32(1), jnp.int32(0))

    def goes_on(state: Searched) -> Array:
        # A node is visited once for each child, and left.
        return (state.height > 0) & (state.turns <= (1 + width) * search.scene.node_count)

    return lax.while_loop(
        goes_on, lambda state: _turn(search, state), Searched(stack, height, jnp.int32(0), nearest)
    )


def _turn(search: Search, state: Searched) -> Searched:
    """Visit the nearest lane left of the node on top, or leave the node."""
    scene = search.scene
    top = index(state.height - 1)
    node, lanes = lax.dynamic_slice(state.stack, (top, jnp.uint32(0)), (1, 2))[0]
    # Behind a cond, whose result is there once: a lane that is computed anew for each of its uses, fused in
    # another way, may be another one, and a child be left out. It is always so, which XLA does not know.
    chosen = lax.cond(
        node >= 0,
        lambda: _nearest_lane(search, node, lanes, state.nearest.square),
        lambda: jnp.int32(NO_NAME),
    )
    some = chosen != NO_NAME
    lane = jnp.where(some, chosen & LANE_BITS, 0)
    child = jnp.where(some, scene.child_of(node, index(lane)), DONE)
    rest = jnp.stack([node, lanes ^ jnp.where(some, jnp.int32(1) << lane, 0)])
    stack = lax.dynamic_update_slice(state.stack, rest[None], (top, jnp.uint32(0)))
    below = jnp.stack([child, jnp.int32(2**scene.width - 1)])
    height = state.height + jnp.where(some, jnp.where(child >= 0, 1, 0), -1)
    # Where there is no child that is a node this writes above the stack's top, where nothing is.
    above = index(jnp.where(child >= 0, state.height, len(stack) - 1))
    stack = lax.dynamic_update_slice(stack, below[None], (above, jnp.uint32(0)))
    at_leaf = names_leaf(child)
    where = scene.find_leaf(child)
    nearest = lax.cond(at_leaf, lambda: search.visit(where, state.nearest), lambda: state.nearest)
    return Searched(stack, height, state.turns + 1, nearest)


def _nearest_lane(search: Search, node: Array, lanes: Array, nearest: Array) -> Array:
    """() int32: of the lanes left the nearest, below bits of its square's; `NO_NAME` where none is near."""
    squares = lax.optimization_barrier(search.squares_of(node))
    order = jnp.arange(search.scene.width, dtype=jnp.int32)
    left = (lanes >> order & 1 != 0) & (squares <= nearest)
    bits = lax.bitcast_convert_type(squares, jnp.int32) & ~LANE_BITS | order
    return folded(jnp.where(left, bits, NO_NAME), smaller)


def box_squares(boxes: Array, at: Vector, margins: Vector) -> Array:
    """(k,) float32: squares of the distances from a point to boxes (6, k), at most the true ones.

    Args:
        boxes: Lo xyz and hi xyz; not a number where there is none.
        at: The point.
        margins: By how much boxes are widened along x, y and z.
    """
    total = jnp.zeros(boxes.shape[1:], jnp.float32)
    for axis in range(3):
        outside = larger(boxes[axis] - at[axis], at[axis] - boxes[axis + 3]) - margins[axis]
        # Not smaller or larger: NaN, of an empty lane, must stay.
        outside = jnp.where(outside < 0, jnp.float32(0), outside)
        total = total + outside * outside
    return jnp.where(jnp.isnan(boxes[0]), jnp.float32(jnp.nan), total * np.float32(1 - 2.0**-21))


def _leaf(scene: Any, where: Any, decode: Decode | None) -> Leaf:
    axes = (jnp.uint32(0), jnp.uint32(1), jnp.uint32(2))
    return scene.leaf_of(axes, where, decode)


def _corners_from(leaf: Leaf, at: Vector) -> tuple[Vector, Vector, Vector]:
    """The corners as seen from a point, in the canonical order, each coordinate (8,)."""
    seen = [
        [corner - origin for corner in axis]
        for axis, origin in zip((leaf.x, leaf.y, leaf.z), at, strict=True)
    ]
    if leaf.turn is not None:
        seen = [[pick((x[j], x[(j + 1) % 3], x[(j + 2) % 3]), leaf.turn) for j in range(3)] for x in seen]
    a, b, c = ((seen[0][j], seen[1][j], seen[2][j]) for j in range(3))
    return a, b, c


def triangle_squares(a: Vector, b: Vector, c: Vector) -> Array:
    """(8,) float32: squares of the distances from zero to triangles (difference 2); NaN in empty lanes."""
    ab, bc, ca = _minus(b, a), _minus(c, b), _minus(a, c)
    sides = [_side_square(a, ab), _side_square(b, bc), _side_square(c, ca)]
    normal = _cross(ab, ca)
    weights = [_dot(_cross(p, q), normal) for p, q in ((c, b), (a, c), (b, a))]
    whole = weights[0] + weights[1] + weights[2]
    inside = (weights[0] >= 0) & (weights[1] >= 0) & (weights[2] >= 0) & (whole > 0)
    shares = [weight / jnp.where(inside, whole, 1) for weight in weights]
    foot = [
        rounded(shares[0] * x) + rounded(shares[1] * y) + rounded(shares[2] * z)
        for x, y, z in zip(a, b, c, strict=True)
    ]
    over = jnp.where(
        inside, rounded(foot[0] * foot[0]) + rounded(foot[1] * foot[1]) + rounded(foot[2] * foot[2]), jnp.inf
    )
    return smaller(over, smaller(sides[0], smaller(sides[1], sides[2])))


def _side_square(start: Vector, way: Vector) -> Array:
    """The square of the distance from zero to the line from `start` by `way`."""
    length = _dot(way, way)
    share = -_dot(start, way) / jnp.where(length > 0, length, 1)
    share = jnp.where(share > 0, jnp.where(share < 1, share, 1), 0)
    x, y, z = (p + rounded(share * q) for p, q in zip(start, way, strict=True))
    # Nothing that is not a number is lost: empty lanes show.
    return rounded(x * x) + rounded(y * y) + rounded(z * z) + (start[0] - start[0])


def _minus(p: Vector, q: Vector) -> Vector:
    return p[0] - q[0], p[1] - q[1], p[2] - q[2]


def _dot(p: Vector, q: Vector) -> Array:
    return rounded(p[0] * q[0]) + rounded(p[1] * q[1]) + rounded(p[2] * q[2])


def _cross(p: Vector, q: Vector) -> Vector:
    return (
        rounded(p[1] * q[2]) - rounded(p[2] * q[1]),
        rounded(p[2] * q[0]) - rounded(p[0] * q[2]),
        rounded(p[0] * q[1]) - rounded(p[1] * q[0]),
    )


def _visit_leaf(scene: Any, at: Vector, where: Any, nearest: Nearest, decode: Decode | None) -> Nearest:
    """The closest triangle with those of a leaf; of equals, that of the least face."""
    leaf = _leaf(scene, where, decode)
    a, b, c = _corners_from(leaf, at)
    squares = triangle_squares(a, b, c)
    if leaf.filled is not None:
        squares = jnp.where(leaf.filled, squares, jnp.float32(jnp.nan))
    squares = lax.optimization_barrier(squares)
    within = squares <= nearest.square
    squares = jnp.where(within, squares, jnp.float32(jnp.inf))
    faces = jnp.where(within, scene.faces_of(leaf.name), NO_NAME)
    new = _first_of(squares, leaf.name, faces)
    closer = (new.square < nearest.square) | ((new.square == nearest.square) & (new.face < nearest.face))
    return Nearest(*(jnp.where(closer, mine, old) for mine, old in zip(new, nearest, strict=True)))


def _first_of(squares: Array, names: Array, faces: Array) -> Nearest:
    """The closest of eight triangles, of equals that of the least face: pairwise, all three numbers at once.

    No lane is looked for by a comparison with the least square, of which the square computed anew may differ.
    """
    while len(squares) > 1:
        half = len(squares) // 2
        before = (squares[:half] < squares[half:]) | (
            (squares[:half] == squares[half:]) & (faces[:half] < faces[half:])
        )
        squares, names, faces = (
            jnp.where(before, values[:half], values[half:]) for values in (squares, names, faces)
        )
    return Nearest(squares[0], names[0], faces[0])


# Notes
#
# The nearest lane is chosen behind a cond, and comes out of it as one number. Before, a lane was looked for
# by a comparison with the least square: where squares had more to be fused, those of packed boxes among
# instances, 5 % of the points ended at another triangle than the closest, compiled, and none uncompiled or
# under vmap. It is also 0.45 of the time, expanded.
