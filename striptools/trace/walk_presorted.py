"""The walk of rays through presorted geometry: plain nodes above, below them trees that own their bounds.

Source: Eisemann, Bauszat, Guthe, Magnor, "Geometry Presorting for Implicit Object Space Partitioning" (EGSR
2012), and its additional material, section 2. A presorted node has no memory: its slab is that of the two
triangles it owns on its axis, and what a ray has left of the slabs above, an interval of t, is all that it
carries down. The near child is visited first, by the ray's direction on the children's axis.

Two ways to test a node, hits the same:

*direct*, which the paper took on the graphics cards of its day: six coordinates give the slab; where the ray
meets it, both triangles are tested.

*by bandwidth*: where the ray meets the slab, each triangle's own slab on that axis is made of
the coordinates at hand; only where it is met the next axis is loaded, and then the third; only where all six
planes pass the triangle is tested.

Differences:

1. The far child waits on a stack, with the interval that its parent left: parents could be found by
   arithmetic, but the interval could not.
2. Both planes of a slab are tested at once: a branch costs more than a product.
3. Slabs are those of `box`: they are widened by its margin and culled only beyond `SLACK`.
4. A plain node is visited by testing the boxes of both its children, the nearer one first.
5. One box is made when a scene is laid out: a scene without plain nodes has that of all its triangles in the
   place of a root.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from striptools.hierarchies.presorted import NODE_BYTES
from striptools.trace.box import FAR_FACTOR, Slab
from striptools.trace.counters import Counters
from striptools.trace.numerics import index, larger, smaller
from striptools.trace.triangle import crossing_of, edges_of
from striptools.trace.walk import MISS, SLACK, Best, Frame, ReadyRay, Traced, WalkOptions
from striptools.trace.walk_single import Ended, is_live, no_counts, walk_each

AXIS_BYTES = 12
"""One coordinate of the three corners of a triangle."""

TRIANGLE_BYTES = 36
NONE = np.int32(-1)

_A_NODE = np.array([1, 0, 0, 0, 0, 0], np.int32)
_A_LEAF = np.array([0, 1, 0, 0, 0, 0], np.int32)
_A_PLAIN_BOX = np.array([0, 0, 1, 0, NODE_BYTES, 0], np.int32)
_A_SLAB = np.array([0, 0, 1, 0, 0, 0], np.int32)
_A_TEST = np.array([0, 0, 0, 1, 0, 0], np.int32)
_AN_AXIS = np.array([0, 0, 0, 0, 0, AXIS_BYTES], np.int32)
"""What is counted, in the order of `Counters`; bytes of geometry are those of coordinates alone."""


class Interval(NamedTuple):
    """What a ray has left of its way, in t: () float32."""

    entry: Array
    leaving: Array


class Found(NamedTuple):
    """What a ray has found.

    Attributes:
        nearest: () float32, t of the closest hit, or t_max.
        face: () int32, the least face at that t; `MISS` where there is none.
        counts: (6,) int32 in the order of `Counters`; (0,) where nothing is counted.
    """

    nearest: Array
    face: Array
    counts: Array

    def counting(self, what: np.ndarray, times: Array | bool = True) -> "Found":
        """Count something, where anything is counted."""
        if len(self.counts) == 0:
            return self
        return self._replace(counts=self.counts + what * jnp.asarray(times, jnp.int32))


class Tree(NamedTuple):
    """A presorted tree: its first triangle, the one after its last, and where its stack begins; () int32."""

    first: Array
    end: Array
    floor: Array


class Place(NamedTuple):
    """Where a ray is in a tree or above: a node, or `NONE`, and what is left of the ray there.

    Attributes:
        node: () int32: of plain nodes the row; of a tree's the first triangle.
        axis: () int32, of the slab of a tree's node.
        span: What the nodes above have left.
        height: () int32, entries of the stack.
        turns: () int32, nodes visited.
    """

    node: Array
    axis: Array
    span: Interval
    height: Array
    turns: Array


class Walked(NamedTuple):
    """What a loop of the walk carries: where the ray is, the places that wait, and what it has found.

    An entry of the stack is 3 int32: of plain nodes the row, of a tree's 4 times the first triangle + the
    axis; then the bits of entry and leaving.
    """

    place: Place
    stack: Array
    found: Found


class PresortedScene(NamedTuple):
    """A presorted scene whose nodes are tested by bandwidth.

    Attributes:
        corners: (n', 3, 3) float32, scaled: triangle, axis, corner in the canonical order of the tests.
        faces: (n',) int32, the face that a hit on each triangle is reported as.
        nodes: (t', 8) uint32, as `hierarchies.presorted.Presorted` has them but scaled; at least one.
        frame: How rays are seen.
    """

    corners: Any
    faces: Any
    nodes: Any
    frame: Frame

    @property
    def by_bandwidth(self) -> bool:
        """How nodes are tested."""
        return True

    @property
    def most_turns(self) -> int:
        """No ray visits a node twice."""
        return len(self.nodes) + len(self.corners)

    def walk_rays(self, ready: Array, options: WalkOptions, live: Array | None = None) -> Traced:
        """Walk r rays made ready."""
        return walk_each(self, ready, live, options, _walk, jnp.zeros((options.stack_size, 3), jnp.int32))


class DirectScene(PresortedScene):
    """The same, whose triangles are tested wherever a node is hit."""

    @property
    def by_bandwidth(self) -> bool:
        """How nodes are tested."""
        return False


def _walk(scene: PresortedScene, ray: ReadyRay, stack: Array, options: WalkOptions) -> tuple[Array, Ended]:
    """Walk the plain nodes, and at each leaf that is met the tree below it."""
    zero = jnp.int32(0)
    counts = jnp.zeros(len(Counters._fields) if options.counting else 0, jnp.int32)
    found = Found(ray.t_max, MISS + zero, counts).counting(_A_PLAIN_BOX)
    met, span = _box_met(scene, zero, ray, Interval(jnp.float32(0), ray.t_max * SLACK))
    start = Place(jnp.where(is_live(ray) & met, 0, NONE), zero, span, zero, zero)

    def in_reach(place: Place, found: Found) -> Array:
        return _goes_on(scene, place) & (place.span.entry <= found.nearest * SLACK)

    def is_inner(walked: Walked) -> Array:
        return in_reach(walked.place, walked.found) & (_word(scene, walked.place.node, 7) == 0)

    def descend_to_tree(walked: Walked) -> Walked:
        walked = lax.while_loop(is_inner, lambda walked: _visit_plain(scene, ray, walked), walked)
        place, _, found = walked
        first, count = _word(scene, place.node, 6), _word(scene, place.node, 7)
        at_leaf = in_reach(place, found) & (count != 0)
        root = place._replace(node=jnp.where(at_leaf, first, NONE), axis=zero)
        tree = Tree(first, first + count, place.height)
        walked = walked._replace(place=root, found=found.counting(_A_LEAF, at_leaf))
        place, stack, found = _walk_tree(scene, ray, tree, walked, options.any_hit)
        return Walked(_popped(place._replace(height=tree.floor), stack, zero), stack, found)

    def goes_on(walked: Walked) -> Array:
        going = _goes_on(scene, walked.place)
        return going & (walked.found.face < 0) if options.any_hit else going

    place, stack, found = lax.while_loop(goes_on, descend_to_tree, Walked(start, stack, found))
    best = Best(found.nearest, found.face)
    counted = Counters(*found.counts) if options.counting else no_counts()
    return stack, Ended(best, counted, place.turns > scene.most_turns)


def _walk_tree(scene: PresortedScene, ray: ReadyRay, tree: Tree, walked: Walked, any_hit: bool) -> Walked:
    """Walk a presorted tree from its root, or not at all where the place is `NONE`."""

    def goes_on(walked: Walked) -> Array:
        going = _goes_on(scene, walked.place)
        return going & (walked.found.face < 0) if any_hit else going

    return lax.while_loop(goes_on, lambda walked: _visit_presorted(scene, ray, tree, walked), walked)


def _goes_on(scene: PresortedScene, place: Place) -> Array:
    return (place.node >= 0) & (place.turns <= scene.most_turns)


def _visit_plain(scene: PresortedScene, ray: ReadyRay, walked: Walked) -> Walked:
    """Test the boxes of both children, go to the nearer one, and let the other wait."""
    place, stack, found = walked
    limit = found.nearest * SLACK
    one, two = place.node + 1, _word(scene, place.node, 6)
    left = Interval(place.span.entry, smaller(place.span.leaving, limit))
    met_one, span_one = _box_met(scene, one, ray, left)
    met_two, span_two = _box_met(scene, two, ray, left)
    second = met_two & (~met_one | (span_two.entry < span_one.entry))
    near = jnp.where(second, two, one)
    far = jnp.where(second, one, two)
    span = Interval(*(jnp.where(second, b, a) for a, b in zip(span_one, span_two, strict=True)))
    waits = Interval(*(jnp.where(second, a, b) for a, b in zip(span_one, span_two, strict=True)))
    stack = _pushed(stack, place.height, far, waits)
    height = jnp.where(met_one & met_two, place.height + 1, place.height)
    there = Place(near, place.axis, span, height, place.turns + 1)
    found = found.counting(_A_NODE).counting(_A_PLAIN_BOX, jnp.int32(2))
    return Walked(_or_popped(met_one | met_two, there, stack, jnp.int32(0)), stack, found)


def _visit_presorted(scene: PresortedScene, ray: ReadyRay, tree: Tree, walked: Walked) -> Walked:
    """Make a node's slab of the triangles it owns; where it is met, test them and go on to the children."""
    place, stack, found = walked
    at = (index(place.node), index(place.axis), jnp.uint32(0))
    own = lax.dynamic_slice(scene.corners, at, (2, 1, 3))[:, 0]
    has_two = place.node + 1 < tree.end
    low_one, high_one = _extremes(own[0])
    low_two, high_two = _extremes(own[1])
    low = jnp.where(has_two, smaller(low_one, low_two), low_one)
    high = jnp.where(has_two, larger(high_one, high_two), high_one)
    limit = found.nearest * SLACK
    span = _clipped(place.span, low, high, ray.slab, place.axis)
    met = _is_met(span, limit)
    found = found.counting(_A_NODE + _A_SLAB).counting(_AN_AXIS, jnp.where(has_two, 2, 1))

    def test(found: Found) -> Found:
        if not scene.by_bandwidth:
            found = _test(scene, ray, place.node, jnp.bool_(True), found)
            found = _test(scene, ray, place.node + 1, has_two, found)
            return found.counting(2 * _AN_AXIS, jnp.where(has_two, 2, 1))
        for triangle, sides, there in (
            (place.node, (low_one, high_one), jnp.bool_(True)),
            (place.node + 1, (low_two, high_two), has_two),
        ):
            found = _test_by_bandwidth(scene, ray, triangle, there, sides, place.axis, span, found)
        return found

    found = lax.cond(met, test, _same, found)

    # The children, the one that the ray comes to first before the other; the second may be missing.
    axis = _next_axis(place.axis)
    one = 2 * place.node - tree.first + 2
    two = one + 2
    forward = _of_axis(ray.slab.inverse, axis) >= 0
    both = two < tree.end
    near = jnp.where(both & ~forward, two, one)
    far = jnp.where(forward, two, one)
    stack = _pushed(stack, place.height, far * 4 + axis, span)
    height = jnp.where(met & both, place.height + 1, place.height)
    there = Place(near, axis, span, height, place.turns + 1)
    place = _or_popped(met & (one < tree.end), there, stack, tree.floor, packed=True)
    return Walked(place, stack, found)


def _test(scene: PresortedScene, ray: ReadyRay, triangle: Array, there: Array, found: Found) -> Found:
    """Test a triangle, if it is there."""
    shear = ray.shear
    x, y, z = (_axis_of(scene, triangle, axis) for axis in shear.axes)
    t = crossing_of(edges_of(x, y, z, shear))
    face = scene.faces[index(triangle)]
    closer = there & (t > 0) & ((t < found.nearest) | ((t == found.nearest) & (face < found.face)))
    nearest, face = jnp.where(closer, t, found.nearest), jnp.where(closer, face, found.face)
    return Found(nearest, face, found.counts).counting(_A_TEST, there)


def _test_by_bandwidth(
    scene: PresortedScene,
    ray: ReadyRay,
    triangle: Array,
    there: Array,
    sides: tuple[Array, Array],
    axis: Array,
    span: Interval,
    found: Found,
) -> Found:
    """Test a triangle if its own slab is met, made of coordinates at hand, and then those of other axes."""
    span = _clipped(span, *sides, ray.slab, axis)
    met = there & _is_met(span, found.nearest * SLACK)
    found = found.counting(_A_SLAB, there)
    return lax.cond(met, lambda found: _pass_axes(scene, ray, triangle, axis, span, 2, found), _same, found)


def _pass_axes(
    scene: PresortedScene,
    ray: ReadyRay,
    triangle: Array,
    axis: Array,
    span: Interval,
    left: int,
    found: Found,
) -> Found:
    """Load the next axis while there are any left, go on where its slab is met, and test the triangle."""
    if left == 0:
        return _test(scene, ray, triangle, jnp.bool_(True), found)
    axis = _next_axis(axis)
    span = _clipped(span, *_extremes(_axis_of(scene, triangle, index(axis))), ray.slab, axis)
    met = _is_met(span, found.nearest * SLACK)
    found = found.counting(_AN_AXIS + _A_SLAB)
    return lax.cond(
        met, lambda found: _pass_axes(scene, ray, triangle, axis, span, left - 1, found), _same, found
    )


def _same(found: Found) -> Found:
    return found


def _box_met(scene: PresortedScene, node: Array, ray: ReadyRay, span: Interval) -> tuple[Array, Interval]:
    """Whether a ray meets the box of a plain node within a span, and what is left of it there."""
    words = lax.dynamic_slice(scene.nodes, (index(node), jnp.uint32(0)), (1, 6))[0]
    sides = lax.bitcast_convert_type(words, jnp.float32)
    for axis in range(3):
        span = _between(span, sides[axis], sides[axis + 3], *(part[axis] for part in ray.slab))
    return _is_met(span, span.leaving), span


def _clipped(span: Interval, low: Array, high: Array, slab: Slab, axis: Array) -> Interval:
    """What a slab on an axis leaves of a span."""
    return _between(span, low, high, *(_of_axis(part, axis) for part in slab))


def _between(
    span: Interval, low: Array, high: Array, slab_low: Array, slab_high: Array, inverse: Array
) -> Interval:
    """What a slab leaves of a span, conservatively: see `box`."""
    one, two = low * inverse - slab_low, high * inverse - slab_high
    entry = larger(span.entry, smaller(one, two))
    return Interval(entry, smaller(span.leaving, larger(one, two) * FAR_FACTOR))


def _is_met(span: Interval, limit: Array) -> Array:
    return span.entry <= smaller(limit, span.leaving)


def _extremes(values: Array | tuple[Array, Array, Array]) -> tuple[Array, Array]:
    """The least and the greatest of three."""
    a, b, c = values
    return smaller(smaller(a, b), c), larger(larger(a, b), c)


def _of_axis(values: Array, axis: Array) -> Array:
    return lax.dynamic_index_in_dim(values, index(axis), keepdims=False)


def _axis_of(scene: PresortedScene, triangle: Array, axis: Array) -> tuple[Array, Array, Array]:
    """One coordinate of a triangle's corners."""
    row = lax.dynamic_slice(scene.corners, (index(triangle), axis, jnp.uint32(0)), (1, 1, 3))[0, 0]
    return row[0], row[1], row[2]


def _next_axis(axis: Array) -> Array:
    return jnp.where(axis == 2, 0, axis + 1)


def _word(scene: PresortedScene, node: Array, word: int) -> Array:
    """A word of a plain node, () int32."""
    at = (index(jnp.maximum(node, 0)), jnp.uint32(word))
    return lax.dynamic_slice(scene.nodes, at, (1, 1))[0, 0].astype(jnp.int32)


def _pushed(stack: Array, height: Array, node: Array, span: Interval) -> Array:
    """Write an entry on top, which counts only where the height is then made one more."""
    spans = (lax.bitcast_convert_type(part, jnp.int32) for part in span)
    return lax.dynamic_update_slice(stack, jnp.stack([node, *spans])[None], (index(height), jnp.uint32(0)))


def _popped(place: Place, stack: Array, floor: Array, *, packed: bool = False) -> Place:
    """The place on top of the stack; none where nothing is left above the floor."""
    height = place.height - 1
    top = lax.dynamic_slice(stack, (index(jnp.maximum(height, 0)), jnp.uint32(0)), (1, 3))[0]
    span = Interval(*(lax.bitcast_convert_type(top[k], jnp.float32) for k in (1, 2)))
    node, axis = (top[0] >> 2, top[0] & 3) if packed else (top[0], place.axis)
    return Place(jnp.where(height < floor, NONE, node), axis, span, height, place.turns)


def _or_popped(goes: Array, there: Place, stack: Array, floor: Array, *, packed: bool = False) -> Place:
    """A place to go to, or that on top of the stack."""
    back = _popped(there, stack, floor, packed=packed)
    node, axis = jnp.where(goes, there.node, back.node), jnp.where(goes, there.axis, back.axis)
    span = Interval(*(jnp.where(goes, a, b) for a, b in zip(there.span, back.span, strict=True)))
    height = jnp.where(goes, there.height, back.height)
    return Place(node, axis, span, height, there.turns)
