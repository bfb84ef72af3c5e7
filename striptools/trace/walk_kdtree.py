"""The walk of a ray through a kd-tree, front to back, with a mail-box of what it has tested.

Source: Hunt, "Corrections to the Surface Area Metric with Respect to Mail-Boxing" (2008), which asks for
mail-boxes and does not say which. Here they are the ray's own, as in "inverse mail-boxing": the last few
objects that it tested, in as many numbers, the oldest making room for the next. No memory is shared between
rays, and nothing is to be cleared.

Differences from the textbook walk, which all serve that hits are those of every other walk, bit for bit:

1. A cell is entered where the box test of `box.py` meets it, with the same arithmetic: margin, far factor. A
   ray near a plane thus goes to both sides.
2. A leaf does not end the walk. A cell is left out only where it is entered farther away than the closest hit
   by more than `SLACK`; of two hits at the same t the one of the smaller face is kept.
3. Leaves name objects. A triangle is tested as a lane of its own, since what the mail-box knows differs from
   lane to lane; a strip is tested in blocks of eight.

A walk is bounded by the number of nodes: a tree that goes round in a circle ends in `STUCK`, not in a hang.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from striptools.trace.box import FAR_FACTOR
from striptools.trace.counters import Counters
from striptools.trace.numerics import folded, index, larger, smaller
from striptools.trace.triangle import crossing_of, edges_of
from striptools.trace.walk import SLACK, Best, Frame, ReadyRay, Traced, WalkOptions, nothing_yet
from striptools.trace.walk_single import (
    Ended,
    Leaves,
    is_live,
    test_leaf,
    triangles_in_leaf,
    walk_each,
)

LEAF = 3
NODE_BYTES, REFERENCE_BYTES, TRIANGLE_BYTES = 8, 4, 40


class Triangles(NamedTuple):
    """Objects that are triangles.

    Attributes:
        rows: (n, 10) float32, x, then y, then z of corners a, b and c, and the bits of the face.
    """

    rows: Any

    def test(self, ray: ReadyRay, which: Array, best: Best) -> Best:
        """Test a triangle."""

        def corners(axis: Array) -> tuple[Array, Array, Array]:
            row = lax.dynamic_slice(self.rows, (which, axis * 3), (1, 3))[0]
            return row[0], row[1], row[2]

        x, y, z = (corners(axis) for axis in ray.shear.axes)
        t = crossing_of(edges_of(x, y, z, ray.shear))
        row = lax.dynamic_slice(self.rows, (which, jnp.uint32(9)), (1, 1))[0]
        face = lax.bitcast_convert_type(row[0], jnp.int32)
        closer = (t > 0) & ((t < best.nearest) | ((t == best.nearest) & (face < best.name)))
        return Best(jnp.where(closer, t, best.nearest), jnp.where(closer, face, best.name))

    def size(self, which: Array) -> Array:
        """How many triangles an object has."""
        return jnp.ones_like(which, jnp.int32)


class Strips(NamedTuple):
    """Objects that are ranges of triangles.

    Attributes:
        leaves: Their blocks.
    """

    leaves: Leaves

    def test(self, ray: ReadyRay, which: Array, best: Best) -> Best:
        """Test the triangles of a strip."""
        return test_leaf(self.leaves, which, ray, best)

    def size(self, which: Array) -> Array:
        """How many triangles an object has."""
        return triangles_in_leaf(self.leaves, which)


class KdScene(NamedTuple):
    """A kd-tree as it is walked.

    Attributes:
        nodes: (m, 2) int32, as in `hierarchies.kdtree.KdTree`, the splits scaled.
        references: (k,) int32, objects.
        things: The objects.
        mailbox: (b,) int32, all `MISS`: a mail-box before the walk; b is its size, 0 for none.
        cell: (6,) float32, the root's, scaled.
        frame: How rays are seen.
    """

    nodes: Any
    references: Any
    things: Triangles | Strips
    mailbox: Any
    cell: Any
    frame: Frame

    def walk_rays(self, ready: Array, options: WalkOptions, live: Array | None = None) -> Traced:
        """Walk r rays made ready."""
        return walk_each(self, ready, live, options, _walk, jnp.zeros((options.stack_size, 3), jnp.int32))


class _Place(NamedTuple):
    """Where a ray is: a node, where it enters and leaves its cell, entries of the stack; turns made."""

    node: Array
    entry: Array
    leave: Array
    height: Array
    turns: Array


class _Mail(NamedTuple):
    """Objects tested of late, and how many tests there were of objects and of triangles."""

    objects: Array
    tested: Array
    triangles: Array


class _Visits(NamedTuple):
    """Leaves visited, and references in them."""

    leaves: Array
    references: Array


def _walk(scene: KdScene, ray: ReadyRay, stack: Array, options: WalkOptions) -> tuple[Array, Ended]:
    """Walk one ray."""
    zero = jnp.int32(0)
    entry, leave = _through_root(scene, ray)
    live = is_live(ray) & (entry <= smaller(leave, ray.t_max * SLACK))
    place = _Place(zero, entry, leave, jnp.where(live, zero, -1), zero)
    best = nothing_yet(ray)
    mail = _Mail(scene.mailbox, zero, zero)
    visits = _Visits(zero, zero)
    bound = 2 * scene.nodes.shape[0]

    def goes_on(carried: Any) -> Array:
        place = carried[0]
        return (place.height >= 0) & (place.turns <= bound)

    def to_next_leaf(carried: Any) -> Any:
        place, stack, best, mail, visits = carried
        limit = best.nearest * SLACK
        place, stack = lax.while_loop(
            lambda s: (_word(scene.nodes, s[0].node, 1) & 3 != LEAF) & (s[0].turns <= bound),
            lambda s: _step(scene, ray, s[0], s[1], limit),
            (place, stack),
        )
        first, count = _word(scene.nodes, place.node, 0), _word(scene.nodes, place.node, 1) >> 2
        best, mail = _visit_leaf(scene, ray, first, count, best, mail, options)
        if options.counting:
            visits = _Visits(visits.leaves + 1, visits.references + count)
        place = _popped(place, stack, best.nearest * SLACK)
        if options.any_hit:
            place = place._replace(height=jnp.where(best.nearest < ray.t_max, -1, place.height))
        return place, stack, best, mail, visits

    place, stack, best, mail, visits = lax.while_loop(
        goes_on, to_next_leaf, (place, stack, best, mail, visits)
    )
    counters = _counters(place, mail, visits)
    return stack, Ended(best, counters, place.height >= 0)


def _through_root(scene: KdScene, ray: ReadyRay) -> tuple[Array, Array]:
    """Where a ray enters and leaves the root's cell, as `box.passes` has it."""
    slab = ray.slab
    sides = [
        (scene.cell[a] * slab.inverse[a] - slab.low[a], scene.cell[a + 3] * slab.inverse[a] - slab.high[a])
        for a in range(3)
    ]
    entries = [smaller(low, high) for low, high in sides]
    exits = [larger(low, high) for low, high in sides]
    entry = larger(larger(entries[0], entries[1]), larger(entries[2], jnp.float32(0)))
    return entry, smaller(exits[0], smaller(exits[1], exits[2])) * FAR_FACTOR


def _step(scene: KdScene, ray: ReadyRay, place: _Place, stack: Array, limit: Array) -> tuple[_Place, Array]:
    """Go down to the side that a ray is in first, and put the other on the stack if it comes there too."""
    split = lax.bitcast_convert_type(_word(scene.nodes, place.node, 0), jnp.float32)
    word = _word(scene.nodes, place.node, 1)
    axis = index(word & 3)
    low, high, inverse = ray.floats[axis], ray.floats[axis + 3], ray.floats[axis + 6]
    below_leaves = split * inverse - high
    above_enters = split * inverse - low
    forward = inverse > 0
    near_leave = smaller(place.leave, larger(below_leaves, above_enters) * FAR_FACTOR)
    far_entry = larger(place.entry, smaller(below_leaves, above_enters))
    below, above = place.node + 1, word >> 2
    near, far = jnp.where(forward, below, above), jnp.where(forward, above, below)

    # One of the sides is always met, since their slabs overlap.
    meets_near = place.entry <= near_leave
    meets_far = far_entry <= smaller(place.leave, limit)
    entry = jnp.stack([far, _bits(far_entry), _bits(place.leave)])[None]
    stack = lax.dynamic_update_slice(stack, entry, (index(place.height), jnp.uint32(0)))
    place = _Place(
        jnp.where(meets_near, near, far),
        jnp.where(meets_near, place.entry, far_entry),
        jnp.where(meets_near, near_leave, place.leave),
        jnp.where(meets_near & meets_far, place.height + 1, place.height),
        place.turns + 1,
    )
    return place, stack


def _visit_leaf(
    scene: KdScene,
    ray: ReadyRay,
    first: Array,
    count: Array,
    best: Best,
    mail: _Mail,
    options: WalkOptions,
) -> tuple[Best, _Mail]:
    """Test the objects of a leaf that the mail-box does not know."""
    end = first + count

    def test(carried: tuple[Array, Best, _Mail]) -> tuple[Array, Best, _Mail]:
        place, best, mail = carried
        which = lax.dynamic_slice(scene.references, (index(place),), (1,))[0]
        if scene.mailbox.shape[0] == 0:
            return place + 1, *_test_object(scene, ray, which, best, mail, options)
        known = _knows(mail.objects, which)
        best, mail = lax.cond(
            known,
            lambda: (best, mail),
            lambda: _test_object(scene, ray, which, best, mail, options),
        )
        return place + 1, best, mail

    return lax.while_loop(lambda carried: carried[0] < end, test, (first, best, mail))[1:]


def _knows(mailbox: Array, which: Array) -> Array:
    """Whether an object is in a mail-box."""
    return folded((mailbox == which).astype(jnp.int32), jnp.bitwise_or) != 0


def _test_object(
    scene: KdScene, ray: ReadyRay, which: Array, best: Best, mail: _Mail, options: WalkOptions
) -> tuple[Best, _Mail]:
    """Test an object and put it into the mail-box, in the place of the one that is longest there."""
    best = scene.things.test(ray, index(which), best)
    size = scene.mailbox.shape[0]
    if size > 0:
        oldest = mail.tested & (size - 1)
        objects = jnp.where(jnp.arange(size, dtype=jnp.int32) == oldest, which, mail.objects)
        mail = mail._replace(objects=objects, tested=mail.tested + 1)
    if options.counting:
        mail = mail._replace(triangles=mail.triangles + scene.things.size(index(which)))
    return best, mail


def _popped(place: _Place, stack: Array, limit: Array) -> _Place:
    """Take the topmost cell of the stack that is not too far away; height -1 where there is none."""

    def top(height: Array) -> Array:
        return lax.dynamic_slice(stack, (index(jnp.maximum(height, 0)), jnp.uint32(0)), (1, 3))[0]

    height = lax.while_loop(
        lambda height: (height >= 0) & (_float(top(height)[1]) > limit),
        lambda height: height - 1,
        place.height - 1,
    )
    entry = top(height)
    return _Place(entry[0], _float(entry[1]), _float(entry[2]), height, place.turns + 1)


def _counters(place: _Place, mail: _Mail, visits: _Visits) -> Counters:
    nodes = place.turns - visits.leaves
    return Counters(
        nodes=nodes,
        leaves=visits.leaves,
        boxes=nodes + 1,
        triangles=mail.triangles,
        node_bytes=NODE_BYTES * place.turns,
        geometry_bytes=REFERENCE_BYTES * visits.references + TRIANGLE_BYTES * mail.triangles,
    )


def _word(nodes: Array, node: Array, which: int) -> Array:
    return lax.dynamic_slice(nodes, (index(node), jnp.uint32(which)), (1, 1))[0, 0]


def _bits(value: Array) -> Array:
    return lax.bitcast_convert_type(value, jnp.int32)


def _float(bits: Array) -> Array:
    return lax.bitcast_convert_type(bits, jnp.float32)


# Notes. bunny, 256 x 256 camera rays and one more from each hit, thousands of rays a second of one thread:
# default walk 3,960 / 2,340, this one 2,070 / 990 without a mail-box, 2,060 / 965 with one of 8. A ray takes
# 25 / 44 steps of 15 to 20 ns here where the default one takes 6.5 / 9.7; a step waits for its node.
# Tried and nothing gained: the stack as three arrays of one column, the axis of the slab by selects, a node
# read at once. A mail-box costs 0 to 6 % of the time over triangles, where few tests are saved, and gives up
# to 17 % over strips (bunny); 4 entries do as well as 8.
