"""The walk of a scene whose geometries stand in several places: a hierarchy over instances, and theirs below.

Each geometry's nodes and triangles are there once. A leaf of the hierarchy over instances is one instance:
the ray is moved into the geometry's frame, where the walk of one ray goes on from the geometry's root, with a
stack of its own, and the closest hit is carried back.

1. The direction is moved without being made of unit length, so that t stays the parameter of the same ray.
   All scaling is by powers of two.
2. Inside a geometry everything is as without instances: the same boxes, the same watertight test, of the ray
   as it was rounded there. No ray slips through between two triangles of an instance, mirrored or stretched.
3. The moved ray is rounded by separate products and sums (`numerics.rounded`): its bits, and the hits, are
   the same on every platform.
4. Of two hits at the same t that of the first instance is kept: faces of the flattened source are numbered
   in the order of instances.
5. All hits are gathered in each geometry, as many as are asked for, and merged by t, instance and face;
   counts are summed. A mirrored instance counts windings the other way round, which parity does not see.
6. Triangle tests other than the watertight one are of the ray as it is and of triangles where they stand
   (`standing`): hits, t, u and v are the bits of the flattened scene. Only boxes are met by the moved ray. By
   what follows, a place in a geometry that stands for a hit is, once put in the scene, within f s of what the
   moved ray stands for there, and within 16 u s more, since corners are rounded and a test may report what
   is beside the ray. Boxes are widened by that times the largest row sum of |W|.

**Boxes.** In scaled units, with u = 2^-24 and gamma_n = n u / (1 - n u), let A, b place a geometry and W, w
move a ray into it: float32, with AW = I + E and Aw + b = r, both known from float64. Of a ray o + t d the
moved one is off by

    e = gamma_4 (|W||o| + |w|) in the origin,   gamma_3 |W||d| in the direction,

so that the point P that it reaches at t and the place Q of the point that is hit in the geometry differ by

    |P - Q| <= |A| e + gamma_3 |A||W||t d| + |E| (|o| + |t d|) + |r|,   |t d| <= |o| + |Q| + |P - Q|.

Let k be the largest row sum of |A||W|, n that of |E|, h the largest entry of |A||w|, and s the largest of |o|
and of the placed scene. The point hit may lie 8 u M outside the geometry's box, M the largest coordinate
there of origin and geometry (`box.REACH`), which A enlarges to 8 u (k s + h + a), a the largest row
sum of |A| times the geometry's largest coordinate. All in all Q is within f s of the ray, for

    f s = ((gamma_4 k + n) s + 2 (gamma_3 k + n) s + gamma_4 h + |r|) / (1 - gamma_3 k - n)
          + 8 u (k s + h + a)

and an instance whose box, widened by f s, the ray does not meet before the closest hit has nothing to say.
`instanced` computes f, and each lane of a node holds the largest f below it. For turned and evenly scaled
instances it is about 2^-18.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

from striptools.trace.box import Slab, U, lanes_met
from striptools.trace.counters import Counters
from striptools.trace.numerics import in_range, index, larger, power_of_two_below, rounded
from striptools.trace.standing import Places, Standing, standing
from striptools.trace.triangle import Shear
from striptools.trace.walk import (
    FLOATS,
    MISS,
    STUCK,
    WIDTH,
    WORDS,
    Alone,
    Frame,
    ReadyRay,
    Sighted,
    Traced,
    WalkOptions,
    found_alone,
    largest_of,
    names_leaf,
    prepared_ray,
    prepared_rays,
    scaled_ray,
    walk_alone,
)
from striptools.trace.walk_gather import Gathered, bits_of, merged, nothing_gathered

NODE_BYTES = 256
"""What a node over instances reads: eight boxes, children, and factors."""

SLAB = 9
"""Words of a ready ray that are its slab, the first."""

CORNER_SLIPS = np.float32(16 * U)
"""How far a hit may be from the exact place of its triangle, in units of the largest coordinate: corners are
rounded, and the test may report what is `box.REACH` beside the ray."""

INSTANCE_BYTES = 60
"""What an instance reads: its matrix, root, reach and number."""


class InstancedScene(NamedTuple):
    """A scene as arrays on a device.

    Attributes:
        nodes: (w, 8, 8) float32, over instances: six rows of boxes, scaled, NaN in empty lanes; the bits of
            the children, instance i as -(i + 1); and what boxes are widened by, in units of the largest
            coordinate of ray origin and scene. The last node has no children.
        matrices: (k, 3, 4) float32, from the scaled scene to the scaled geometry.
        roots: (k,) int32, the root of each instance's geometry.
        reaches: (k,) float32, the largest scaled coordinate of its geometry.
        frame: How rays are seen from the scene.
        geometries: All geometries, in their own frames.
        places: Where instances stand; None where only moved rays are asked for.
    """

    nodes: Any
    matrices: Any
    roots: Any
    reaches: Any
    frame: Frame
    geometries: Any
    places: Places | None = None

    @property
    def node_count(self) -> int:
        """Nodes over instances."""
        return len(self.nodes)

    @property
    def width(self) -> int:
        """Children of a node."""
        return WIDTH

    def boxes_of(self, node: Array) -> Array:
        """(6, 8) float32: boxes of instances or of several, scaled and not widened; NaN in empty lanes."""
        return self.rows_of(node)[:6]

    def rows_of(self, node: Array) -> Array:
        """(8, 8) float32: a node."""
        at = (index(node), jnp.uint32(0), jnp.uint32(0))
        return lax.dynamic_slice(self.nodes, at, (1, 8, WIDTH))[0]

    def child_of(self, node: Array, lane: Array) -> Array:
        """The child in a lane; instance i is -(i + 1)."""
        bits = lax.dynamic_slice(self.nodes, (index(node), jnp.uint32(6), lane), (1, 1, 1))[0, 0, 0]
        return lax.bitcast_convert_type(bits, jnp.int32)

    def find_leaf(self, child: Array) -> Array:
        """The child."""
        return child

    def faces_of(self, names: Array) -> Array:
        """Names that `trace_in_place` gives are faces."""
        return names

    def root_of(self, instance: Array) -> Array:
        """The root of an instance's geometry."""
        return value_at(self.roots, index(instance))

    def standing(self, instance: Array) -> Standing:
        """An instance where it stands."""
        assert self.places is not None
        return standing(self.geometries, self.places, instance)

    def visited(self, top: Array, below: Array) -> Array:
        """(6,) int32, `Counters` of so many nodes, leaves and triangles over instances and in geometries."""
        nodes, instances, _ = top
        above = Counters(nodes, 0, nodes * 8, 0, nodes * NODE_BYTES, instances * INSTANCE_BYTES)
        inside = self.geometries.counters_of(*below)
        return jnp.stack([jnp.int32(a + b) for a, b in zip(above, inside, strict=True)])


class InstancesTraced(NamedTuple):
    """One entry a ray; what was not asked for has none.

    Attributes:
        t: (r,) float32; (0,) of any hit; (r, most) where all hits are gathered.
        name: (r,) int32, what the geometries call the triangle hit; (r, most) where all are.
        counters: (r, 6) int32; (r, 0) where nothing is counted.
        counted: As of `walk.Traced`.
        instance: (r,) int32, -1 on a miss; (r, most) where all are.
    """

    t: Array
    name: Array
    counters: Array
    counted: Array
    instance: Array


class _Nearest(NamedTuple):
    """The closest hit so far, in t of the walk over instances; what was visited in geometries."""

    nearest: Array
    name: Array
    instance: Array
    stuck: Array
    visits: Array

    @property
    def limit(self) -> Array:
        """T up to which a hit counts: once there is one, one just as near may be of an instance before it."""
        return jnp.where(self.instance >= 0, _next_above(self.nearest), self.nearest)

    def after(self, number: Array, seen: Any, end: Alone, options: WalkOptions) -> "_Nearest":
        """The same with what was found in an instance."""
        t, name = found_alone(seen, end, options.any_hit)
        closer = (name >= 0) & ((t < self.nearest) | (t == self.nearest) & (number < self.instance))
        return _Nearest(
            jnp.where(closer, t, self.nearest),
            jnp.where(closer, name, self.name),
            jnp.where(closer, number, self.instance),
            self.stuck | (name == STUCK),
            self.visits + end.visits,
        )


class _Met(NamedTuple):
    """What was gathered so far, in t of the walk over instances; the faces kept are instances."""

    gathered: Gathered
    stuck: Array

    @property
    def nearest(self) -> Array:
        """Beyond this nothing matters any more."""
        return self.gathered.nearest

    @property
    def limit(self) -> Array:
        """T up to which a hit counts: once as many are kept as may be, as of `_Nearest`."""
        return jnp.where(self.gathered.name[-1] >= 0, _next_above(self.nearest), self.nearest)

    def after(self, number: Array, seen: Any, end: Alone, options: WalkOptions) -> "_Met":
        """The same with what was gathered in an instance: its faces are sorted, and stay so."""
        stuck = self.stuck | ~end.ended
        if options.gather != "all":
            counted = self.gathered.counted + end.best.counted
            return _Met(self.gathered._replace(counted=counted), stuck)
        t, name = found_alone(seen, end, options.any_hit)
        rows = jnp.stack([bits_of(t), jnp.broadcast_to(number, name.shape), name], axis=1)
        return _Met(merged(self.gathered, rows), stuck)


class _Seen(NamedTuple):
    """A scene as one ray sees it: a `walk.WalkScene` whose leaves are instances."""

    scene: InstancedScene
    origin: Array
    direction: Array
    size: Array
    in_place: bool

    @property
    def frame(self) -> Frame:
        """How rays are seen."""
        return self.scene.frame

    @property
    def width(self) -> int:
        """Children of a node."""
        return self.scene.width

    @property
    def node_count(self) -> int:
        """Nodes over instances."""
        return self.scene.node_count

    def lanes_met(self, node: Array, slab: Slab, limit: Array) -> Array:
        """(8,) bool: the node's children whose widened boxes the ray meets, from 0 to `limit`."""
        rows = self.scene.rows_of(node)
        wider = rows[7] * self.size
        return lanes_met(jnp.concatenate([rows[:3] - wider, rows[3:6] + wider]), slab, limit)

    def child_of(self, node: Array, lane: Array) -> Array:
        """The child in a lane; instance i is -(i + 1)."""
        return self.scene.child_of(node, lane)

    def find_leaf(self, child: Array) -> Array:
        """The child."""
        return self.scene.find_leaf(child)

    def triangles_of(self, where: Array) -> Array:
        """Triangles are counted in the geometries."""
        return jnp.int32(0)

    def visit_leaf(self, ray: Sighted, where: Array, best: Any, options: WalkOptions) -> Any:
        """Walk the geometry of an instance."""
        number = -(where + 1)
        # A GPU goes through the motions for rays that are at no leaf.
        there = names_leaf(where)
        limit = jnp.where(there, best.limit, 0)
        if self.in_place:
            seen, row = self._standing_at(index(number), limit, ray.shear)
        else:
            seen, row = self._moved_into(index(number), limit)
        return best.after(number, seen, walk_alone(seen, row, options), options)

    def _moved_into(self, at: Array, limit: Array) -> tuple[Any, Array]:
        """The geometry of an instance, and the ray ready in its frame."""
        origin, direction = moved(row_of(self.scene.matrices, at), self.origin, self.direction)
        geometries = self.scene.geometries
        frame = geometries.frame._replace(scale=jnp.float32(1), reach=value_at(self.scene.reaches, at))
        seen = geometries._replace(frame=frame)
        return seen, prepared_ray(seen, origin, direction, limit, value_at(self.scene.roots, at))

    def _standing_at(self, at: Array, limit: Array, shear: Shear) -> tuple[Any, Array]:
        """An instance where it stands, and the ray: as it is moved for boxes, as it is for triangles."""
        scene, matrix = self.scene, row_of(self.scene.matrices, at)
        origin, direction = moved(matrix, self.origin, self.direction)
        own = scene.geometries.frame
        assert scene.places is not None
        slip = (value_at(scene.places.slips, at) + CORNER_SLIPS) * self.size
        wider = jnp.abs(matrix[:, :3]).sum(axis=1).max() * slip * np.float32(1 + 2.0**-18)
        reach = larger(largest_of(origin), value_at(scene.reaches, at)) + wider / own.margin
        seen = scene.geometries._replace(frame=own._replace(scale=jnp.float32(1), reach=reach))
        row = prepared_ray(seen, origin, direction, limit, value_at(scene.roots, at))
        # Distances of boxes in t of the walk over instances, whose direction is not made shorter here.
        slab = row[:SLAB] * power_of_two_below(largest_of(direction))[0]
        rest = jnp.stack([*shear.origin, shear.x, shear.y, shear.z, limit, jnp.float32(1)])
        axes = lax.bitcast_convert_type(jnp.stack(shear.axes).astype(jnp.int32), jnp.float32)
        row = jnp.concatenate([slab, rest, axes, row[FLOATS + 3 : WORDS]])
        if shear.way is not None:
            row = jnp.concatenate([row, jnp.stack(shear.way)])
        return scene.standing(at), row


def moved(matrix: Array, origin: Array, direction: Array) -> tuple[Array, Array]:
    """A ray in the frame of a geometry: ((m0 x + m1 y) + m2 z) + m3, every step rounded.

    Args:
        matrix: (3, 4) float32.
        origin: (3,) float32.
        direction: (3,) float32.
    """

    def turned(vector: Array) -> Array:
        x, y, z = (rounded(matrix[:, axis] * vector[axis]) for axis in range(3))
        return (x + y) + z

    return turned(origin) + matrix[:, 3], turned(direction)


def trace_in_place(
    scene: InstancedScene, origins: Array, directions: Array, t_max: Array, options: WalkOptions
) -> Traced:
    """Trace r rays as through the flattened scene (difference 6): names are faces, of any hits `walk.HIT`."""
    found = trace_instances(scene, origins, directions, t_max, options, in_place=True)
    if options.any_hit:
        return Traced(found.t, found.name, found.counters, found.counted)
    hit = found.name >= 0
    assert scene.places is not None
    own = scene.geometries.faces_of(jnp.where(hit, found.name, 0))
    face = own + scene.places.faces[jnp.where(hit, found.instance, 0)]
    return Traced(found.t, jnp.where(hit, face, found.name), found.counters, found.counted)


def trace_instances(
    scene: InstancedScene,
    origins: Array,
    directions: Array,
    t_max: Array,
    options: WalkOptions,
    in_place: bool = False,
) -> InstancesTraced:
    """Trace r rays, one by one or all at once.

    Args:
        scene: What to trace.
        origins: (r, 3) float32.
        directions: (r, 3) float32.
        t_max: (r,) float32.
        options: What to compile in.
        in_place: Let rays meet triangles where they stand, as tests other than the watertight one have it.
    """
    options = options._replace(interleave=1)
    in_place = in_place or options.test != "watertight"

    def walk(*ray: Array) -> InstancesTraced:
        return _walk_ray(scene, ray, options, in_place)

    rays = (origins, directions, t_max)
    if options.batch:
        found = jax.vmap(walk)(*rays)
    else:
        found = lax.scan(lambda nothing, ray: (nothing, walk(*ray)), None, rays)[1]
    found = found._replace(counted=found.counted.reshape(-1))
    return found._replace(t=jnp.zeros(0)) if options.any_hit else found


def _walk_ray(
    scene: InstancedScene, ray: tuple[Array, ...], options: WalkOptions, in_place: bool
) -> InstancesTraced:
    """Walk one ray over the instances."""
    origin, direction = map(jnp.stack, scaled_ray(scene.frame, *ray[:2])[:2])
    # Of a `WalkScene` it has what the walk of one ray asks.
    seen: Any = _Seen(scene, origin, direction, larger(largest_of(origin), scene.frame.reach), in_place)
    row = prepared_rays(seen, ray[0][None], ray[1][None], ray[2][None], options.test)[0]
    none = jnp.int32(MISS)

    def nothing(ready: ReadyRay) -> Any:
        if options.gather is not None:
            return _Met(nothing_gathered(ready.t_max, options.most), jnp.bool_(False))
        return _Nearest(ready.t_max, none, none, jnp.bool_(False), jnp.zeros(3, jnp.int32))

    ready, ended, best, visits = walk_alone(seen, row, options, nothing)
    counters, counted = jnp.zeros((2, 0), jnp.int32)
    if isinstance(best, _Met):
        near, name, instance = best.gathered.t, best.gathered.name, best.gathered.kept[:, 1]
        counted = best.gathered.counted
    else:
        near, name, instance = best.nearest, best.name, best.instance
        counters = scene.visited(visits, best.visits) if options.counting else counters
    t = jnp.where(instance >= 0, in_range(near * ready.t_unit), jnp.float32(jnp.inf))
    name = jnp.where(ended & ~best.stuck, name, STUCK)
    return InstancesTraced(t, name, counters, counted, instance)


def value_at(values: Array, place: Array) -> Array:
    """One of (k,) values."""
    return lax.dynamic_slice(values, (place,), (1,))[0]


def row_of(rows: Array, place: Array) -> Array:
    """One of k rows."""
    return lax.dynamic_index_in_dim(rows, place, keepdims=False)


def _next_above(value: Array) -> Array:
    """The float32 after a positive one; infinity stays."""
    bits = lax.bitcast_convert_type(value, jnp.int32)
    after = lax.bitcast_convert_type(bits + 1, jnp.float32)
    return jnp.where(jnp.isfinite(value), after, value)
