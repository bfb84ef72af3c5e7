"""Queries as functions of arrays, for programs of your own: under jit, under vmap, differentiated.

    geometry = Geometry.of(Tracer(striptools.convert(mesh)), mesh.faces)

    @jax.jit
    def depth(positions, origins, directions):
        return closest_hit(geometry, positions, origins, directions).t.sum()

    jax.grad(depth)(positions, origins, directions)

The walk is the tracer's, so hits are. It is not differentiated: which face is hit is taken as given, and t, u
and v solve origin + t direction = (1-u-v) a + u b + v c for that face, by whose linear system their
derivatives with respect to origin, direction and corners follow (the implicit function theorem, as in Loubet,
Holzschuch & Jakob, "Reparameterizing Discontinuous Integrands for Differentiable Rendering", SIGGRAPH Asia
2019, section 3, without what silhouettes contribute). Derivatives of a miss are zero; on edges they are those
of the face reported. Any order, forwards and backwards.

Values come from the scene; `positions` only say where the corners are whose derivative is asked for, so they
have to be those that the scene was made of: after a step that moves vertices, make a new tracer.

Where a scene has instances, faces and positions are those of the flattened mesh, and all values are the bits
of the flattened scene: a tracer that shares geometries does so here too, but rays meet triangles where they
stand (`walk_instances`, difference 6).

Under vmap the rays of all elements are walked as one batch: the loop stays one native function, which it
would not where vmap turned the loop itself into one over batches. Inside a program of yours a walk runs on
one device; the tracer itself uses all.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, custom_batching, lax

from striptools.errors import UsageError
from striptools.trace.containment import WAY
from striptools.trace.gathering import MOST_HITS
from striptools.trace.launch import tracing
from striptools.trace.numerics import power_of_two_below
from striptools.trace.tracer import Tracer
from striptools.trace.triangle import Corners, edges_of, pick, shear_of
from striptools.trace.walk import MISS, STUCK, Traced, WalkOptions, WalkScene
from striptools.trace.walk_instances import InstancedScene, trace_in_place


@partial(jax.tree_util.register_dataclass, data_fields=("scene", "faces"), meta_fields=("options",))
@dataclass(frozen=True)
class Geometry:
    """A scene on a device and the faces of its source: a pytree, to be passed into jitted functions.

    Attributes:
        scene: What is walked.
        faces: (f, 3) int32, the source's.
        options: How it is walked; a constant of the program.
    """

    scene: Any
    faces: Any
    options: WalkOptions

    @classmethod
    def of(cls, tracer: Tracer, faces: Any) -> "Geometry":
        """Take over a tracer's scene.

        Args:
            tracer: Of a scene that was made of a mesh with these faces.
            faces: (f, 3) of that mesh, as its hits number them: without a remap those of the scene. Of a mesh
                with instances those of `Mesh.flattened`, whether the tracer shares or flattens them.

        Raises:
            UsageError: The faces are not of this shape, or the scene has no triangle.
        """
        given = np.asarray(faces)
        if given.ndim != 2 or given.shape[1] != 3 or given.dtype.kind not in "iu":
            raise UsageError(
                f"of shape {given.shape} and {given.dtype}", where="faces", remedy="give integers (faces, 3)"
            )
        scene, options = tracer.program_parts()
        return cls(scene, jax.device_put(given.astype(np.int32), tracer.devices[0]), options)

    def walking(self, **options: Any) -> "_Walker":
        """The scene, walked in another way."""
        return _Walker(self.scene, self.options._replace(**options))


@partial(jax.tree_util.register_dataclass, data_fields=("scene",), meta_fields=("options",))
@dataclass(frozen=True)
class _Walker:
    scene: WalkScene
    options: WalkOptions


class RayHits(NamedTuple):
    """Hits of rays of shape (...): closest ones (...), or all (..., k), with misses at the end.

    Attributes:
        t: float32, infinite on a miss.
        u: float32, the weight of the face's second corner; 0 on a miss.
        v: float32, the weight of its third corner; 0 on a miss.
        face: int32, the source's; -1 on a miss, -2 where the walk did not end since the scene is damaged.
    """

    t: Array
    u: Array
    v: Array
    face: Array


def closest_hit(
    geometry: Geometry, positions: Any, origins: Any, directions: Any, t_max: Any = np.inf
) -> RayHits:
    """Find what each ray hits first, as `Tracer.closest_hit`.

    Args:
        geometry: What to trace.
        positions: (v, 3) of the mesh that `geometry.faces` index.
        origins: (..., 3).
        directions: (..., 3), of the same shape.
        t_max: (...) or one for all.
    """
    origins, directions, reach = _as_rays(origins, directions, t_max)
    traced = _walked(geometry.walking(), origins, directions, reach)
    return _hits_of(geometry, positions, origins, directions, traced.t, traced.name)


def all_hits(
    geometry: Geometry, positions: Any, origins: Any, directions: Any, t_max: Any = np.inf, *, k: int
) -> RayHits:
    """Find the first k hits of each ray, as `Tracer.all_hits`: (..., k); arguments as of `closest_hit`.

    Raises:
        UsageError: K is out of range.
    """
    if not 1 <= k <= MOST_HITS:
        raise UsageError(f"{k} hits a ray", where="k", remedy=f"ask for 1 to {MOST_HITS}")
    origins, directions, reach = _as_rays(origins, directions, t_max)
    traced = _walked(geometry.walking(gather="all", most=k), origins, directions, reach)
    origins, directions = (
        jnp.broadcast_to(a[..., None, :], (*traced.t.shape, 3)) for a in (origins, directions)
    )
    return _hits_of(geometry, positions, origins, directions, traced.t, traced.name)


def any_hit(geometry: Geometry, origins: Any, directions: Any, t_max: Any = np.inf) -> Array:
    """Say of each ray whether it hits anything, (...) bool; arguments as of `closest_hit`."""
    return _walked(geometry.walking(any_hit=True), *_as_rays(origins, directions, t_max)).name >= 0


def count_hits(geometry: Geometry, origins: Any, directions: Any, t_max: Any = np.inf) -> Array:
    """Count all faces that each ray hits, (...) int32; arguments as of `closest_hit`."""
    rays = _as_rays(origins, directions, t_max)
    return _walked(geometry.walking(gather="count", most=1), *rays).counted


def contains(geometry: Geometry, points: Any) -> Array:
    """Say of each point (..., 3) whether it is inside a closed mesh, by parity, as `Tracer.contains`."""
    points = jnp.asarray(points, jnp.float32)
    rays = _as_rays(points, jnp.broadcast_to(jnp.asarray(WAY), points.shape), np.inf)
    return _walked(geometry.walking(gather="windings", most=1), *rays).counted % 2 == 1


def _as_rays(origins: Any, directions: Any, t_max: Any) -> tuple[Array, Array, Array]:
    origins, directions = jnp.asarray(origins, jnp.float32), jnp.asarray(directions, jnp.float32)
    if origins.shape != directions.shape or origins.shape[-1:] != (3,):
        raise UsageError(
            f"origins {origins.shape} for directions {directions.shape}", remedy="give both as (..., 3)"
        )
    return origins, directions, jnp.broadcast_to(jnp.asarray(t_max, jnp.float32), origins.shape[:-1])


def _walked(walker: _Walker, origins: Array, directions: Array, reach: Array) -> Traced:
    """Walk rays (..., 3), as constants; results (..., of a ray)."""
    shape = reach.shape
    rays = origins.reshape(-1, 3), directions.reshape(-1, 3), reach.reshape(-1)
    traced = _walk(walker, *(lax.stop_gradient(a) for a in rays))
    return Traced(*(a.reshape(*shape, *a.shape[1:]) if a.size else a for a in traced))


def _traced(scene: Any, origins: Array, directions: Array, reach: Array, options: WalkOptions) -> Traced:
    if isinstance(scene, InstancedScene):
        return trace_in_place(scene, origins, directions, reach, options)
    # The kernel gathers nothing.
    options = options._replace(kernel=options.kernel and options.gather is None)
    return tracing(options)(scene, origins, directions, reach, options)


# Outside of a program of the user's, one that is compiled once.
_trace = jax.jit(_traced, static_argnames="options")


@custom_batching.custom_vmap
def _walk(walker: _Walker, origins: Array, directions: Array, reach: Array) -> Traced:
    count = len(reach)
    rest = -count % walker.options.interleave
    padded = (jnp.pad(a, ((0, rest),) + ((0, 0),) * (a.ndim - 1)) for a in (origins, directions, reach))
    traced = _trace(walker.scene, *padded, options=walker.options)
    return Traced(*(a[:count] for a in traced))


@_walk.def_vmap
def _walk_batch(
    size: int, batched: Any, walker: _Walker, origins: Array, directions: Array, reach: Array
) -> tuple[Traced, Any]:
    """Walk the rays of all elements as one batch."""
    if any(jax.tree.leaves(batched[0])):
        raise UsageError("scenes cannot be batched", remedy="map over rays, not over geometries")
    rays = [
        a if is_batched else jnp.broadcast_to(a, (size, *a.shape))
        for a, is_batched in zip((origins, directions, reach), batched[1:], strict=True)
    ]
    shape = rays[2].shape
    traced = _walk(walker, *(a.reshape(-1, *a.shape[2:]) for a in rays))
    results = Traced(*(a.reshape(*shape, *a.shape[1:]) if a.size else a for a in traced))
    return results, jax.tree.map(lambda a: a.size > 0, traced)


def _hits_of(
    geometry: Geometry, positions: Any, origins: Array, directions: Array, t: Array, name: Array
) -> RayHits:
    """Where on their faces hits lie, and how that depends on rays and positions."""
    face = geometry.scene.faces_of(name)
    hit = name >= 0
    corners = jnp.asarray(positions, jnp.float32)[geometry.faces[jnp.where(hit, face, 0)]]
    u, v = _weights(geometry.scene.frame.scale, *map(lax.stop_gradient, (corners, origins, directions)))
    u, v = jnp.where(hit, u, 0), jnp.where(hit, v, 0)
    attached = _attached(hit, t, u, v, corners, origins, directions)
    return RayHits(*attached, jnp.where(hit, face, jnp.where(name == STUCK, STUCK, MISS)))


def _weights(scale: Array, corners: Array, origins: Array, directions: Array) -> tuple[Array, Array]:
    """The weights of second and third corners, by the edge functions of the test itself."""
    if corners.ndim > 2:
        return jax.vmap(partial(_weights, scale))(corners, origins, directions)
    size = jnp.abs(directions)
    shorten, _ = power_of_two_below(size.max())
    shear = shear_of(origins * scale, directions * shorten)
    scaled = corners * scale
    x, y, z = (_along(scaled, axis) for axis in shear.axes)
    edges = edges_of(x, y, z, shear)
    whole = edges.a + edges.b + edges.c
    inverse = jnp.where(whole == 0, 0, 1 / jnp.where(whole == 0, 1, whole))
    return edges.b * inverse, edges.c * inverse


def _along(corners: Array, axis: Array) -> Corners:
    return pick(corners[0], axis), pick(corners[1], axis), pick(corners[2], axis)


@jax.custom_jvp
def _attached(
    hit: Array, t: Array, u: Array, v: Array, corners: Array, origins: Array, directions: Array
) -> tuple[Array, Array, Array]:
    """T, u and v, which are given, as functions of corners (..., 3, 3), origins and directions (..., 3)."""
    return t, u, v


@_attached.defjvp
def _attached_jvp(primals: Any, tangents: Any) -> tuple[Corners, Corners]:
    """Differentiate origin + t direction = (1-u-v) a + u b + v c and solve for what t, u and v do."""
    hit, _, _, _, corners, _, directions = primals
    _, _, _, _, d_corners, d_origins, d_directions = tangents
    t, u, v = _attached(*primals)
    a, b, c = (corners[..., j, :] for j in range(3))
    da, db, dc = (d_corners[..., j, :] for j in range(3))
    near = jnp.where(hit, t, 0)[..., None]
    moved = da + u[..., None] * (db - da) + v[..., None] * (dc - da)
    gap = d_origins + near * d_directions - moved
    ab, ac = b - a, c - a
    normal = jnp.cross(ab, ac)
    slope = _dot(normal, directions)
    some = hit & (slope != 0)
    inverse = jnp.where(some, 1 / jnp.where(some, slope, 1), 0)
    dt = -_dot(normal, gap) * inverse
    du = _dot(jnp.cross(ac, directions), gap) * inverse
    dv = _dot(jnp.cross(directions, ab), gap) * inverse
    return (t, u, v), (dt, du, dv)


def _dot(p: Array, q: Array) -> Array:
    return (p * q).sum(axis=-1)


__all__ = [
    "Geometry",
    "RayHits",
    "all_hits",
    "any_hit",
    "closest_hit",
    "contains",
    "count_hits",
]
