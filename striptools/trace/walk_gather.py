"""What a walk gathers in the place of the closest hit: all hits up to a number, or counts.

All hits are kept sorted, by t and then by face, in as many lanes as are asked for: a k-buffer (Bavoil et al.,
"Multi-Fragment Effects on the GPU Using the k-Buffer", I3D 2007) filled by insertion, so that nothing sorts
or scatters and the loop stays hoisted. Once it is full, boxes beyond its last hit are left out. Counting
leaves out nothing before t_max. Cost: a step of `most` lanes for each triangle of a leaf in which any is hit.
"""

from typing import TYPE_CHECKING, Literal, NamedTuple

import jax.numpy as jnp
from jax import Array, lax

from striptools.trace.numerics import folded
from striptools.trace.triangle import Shear, edges_of, windings_of

if TYPE_CHECKING:
    from striptools.trace.walk import Leaf, WalkOptions, WalkScene

GatherKind = Literal["all", "count", "windings"]
"""All hits; how many there are; how often more the ray leaves the body than it enters it."""


class Gathered(NamedTuple):
    """What a ray has met: `nearest` is the distance beyond which nothing matters any more.

    T, face and name, (most,), are sorted; places left have t_max and names below zero. Count is () int32.
    """

    nearest: Array
    t: Array
    face: Array
    name: Array
    count: Array


def nothing_gathered(t_max: Array, most: int) -> Gathered:
    """What a ray has met before it starts; t_max comes before any hit at t_max."""
    none = jnp.full(most, -1, jnp.int32)
    return Gathered(t_max, jnp.full(most, t_max), none, none, jnp.int32(0))


def gather_leaf(
    scene: "WalkScene", shear: Shear, t_max: Array, child: Array, so_far: Gathered, options: "WalkOptions"
) -> Gathered:
    """Add the triangles of a leaf."""
    leaf = scene.leaf_of(shear.axes, child, options.decode)
    if options.gather == "windings":
        return so_far._replace(count=so_far.count + _windings(leaf, shear))
    t = leaf.crossings(shear)
    if options.gather == "count":
        met = (t > 0) & (t < t_max)
        return so_far._replace(count=so_far.count + _total(met))
    met = (t > 0) & (t <= so_far.nearest)
    return lax.cond(_total(met) > 0, lambda: _inserted(scene, leaf, t, met, so_far), lambda: so_far)


def _total(flags: Array) -> Array:
    return folded(jnp.where(flags, jnp.int32(1), jnp.int32(0)), jnp.add)


def _windings(leaf: "Leaf", shear: Shear) -> Array:
    windings = windings_of(edges_of(leaf.x, leaf.y, leaf.z, shear), shear)
    if leaf.filled is not None:
        windings = jnp.where(leaf.filled, windings, 0)
    return folded(windings, jnp.add)


def _inserted(scene: "WalkScene", leaf: "Leaf", t: Array, met: Array, so_far: Gathered) -> Gathered:
    """Put the hits of a leaf in their places, one after the other; what falls out at the end is lost."""
    face = scene.faces_of(leaf.name)
    t = jnp.where(met, t, jnp.float32(jnp.inf))
    kept = so_far.t, so_far.face, so_far.name
    for lane in range(len(t)):
        new = t[lane], face[lane], leaf.name[lane]
        stays = (kept[0] < new[0]) | ((kept[0] == new[0]) & (kept[1] < new[1]))
        after = jnp.concatenate([jnp.ones(1, jnp.bool_), stays[:-1]])
        kept = tuple(
            jnp.where(stays, old, jnp.where(after, value, jnp.concatenate([old[:1], old[:-1]])))
            for old, value in zip(kept, new, strict=True)
        )
    return Gathered(kept[0][-1], *kept, so_far.count)
