"""Scenes as a kernel sees them: what a tile of a few rays by eight lanes reads of nodes and leaves.

Every value is a tile (rays, 8): a lane is a child of the ray's node or a triangle of its leaf, and what a ray
has but one of stands in all its lanes. A row of a node or leaf is then read by neighbouring threads.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple, Protocol, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.experimental.pallas import triton as plgpu

from striptools.trace.box import FAR_FACTOR, Slab
from striptools.trace.numerics import Arithmetic
from striptools.trace.walk import WIDTH, Decode, Leaf, WalkScene
from striptools.trace.walk_packed import PackedScene
from striptools.trace.walk_wide import WideScene


class Tile(Protocol):
    """A scene within a kernel: arrays are references to the GPU's memory."""

    def among(self, mask: Array) -> Self:
        """The same, reading nothing but for the rays in the mask."""
        ...

    def lanes_met(self, node: Array, slab: Slab, limit: Array) -> Array:
        """Bool: the nodes' children whose boxes the rays meet, from 0 to `limit`."""
        ...

    def child_of(self, node: Array, lane: Array) -> Array:
        """The child in a lane, as the walk names it."""
        ...

    def find_leaf(self, child: Array) -> Any:
        """Where the triangles of leaves are."""
        ...

    def leaf_of(self, axes: tuple[Array, Array, Array], where: Any, decode: Decode | None) -> Leaf:
        """The triangles of leaves, their corners along these axes."""
        ...

    def faces_of(self, names: Array) -> Array:
        """The faces of hits, negative where there is none."""
        ...


class Source(NamedTuple):
    """How a kernel takes a scene: the arrays it is given, and the tile made of references to them."""

    arrays: list[Any]
    tile: Callable[[list[Any], tuple[int, int], Arithmetic], Any]


def source_of(scene: WalkScene) -> Source:
    """The arrays of a scene that a kernel reads."""
    if isinstance(scene, PackedScene):
        held = [a for a in _packed_arrays(scene) if a.size]
        return Source(held, partial(PackedTile.of, scene))
    assert isinstance(scene, WideScene)
    return Source([scene.nodes, scene.blocks], lambda refs, *rest: WideTile(*refs, *rest))


def lane_numbers(shape: tuple[int, ...], dtype: Any) -> Array:
    """The number of each lane."""
    return lax.broadcasted_iota(dtype, shape, 1)


def passes(low: list[Array], high: list[Array], limit: Array) -> Array:
    """As `box.passes`, where the smaller of a number and of none may be the number."""
    entries, exits = list(map(lax.min, low, high)), list(map(lax.max, low, high))
    entry = lax.max(lax.max(entries[0], entries[1]), lax.max(entries[2], jnp.zeros_like(entries[2])))
    leaving = lax.min(exits[0], lax.min(exits[1], exits[2])) * FAR_FACTOR
    return (entry <= limit) & (entry <= leaving)


class WideTile(NamedTuple):
    """References to a `WideScene`."""

    nodes: Any
    blocks: Any
    shape: tuple[int, int]
    arithmetic: Arithmetic
    mask: Any = None

    def among(self, mask: Array) -> "WideTile":
        """The same, reading nothing but for the rays in the mask."""
        return self._replace(mask=mask)

    def lanes_met(self, node: Array, slab: Slab, limit: Array) -> Array:
        """As `WideScene.lanes_met`."""
        lane = lane_numbers(self.shape, np.int32)
        boxes = [plgpu.load(self.nodes.at[node, row, lane], mask=self.mask) for row in range(6)]
        low = [boxes[axis] * slab.inverse[axis] - slab.low[axis] for axis in range(3)]
        high = [boxes[axis + 3] * slab.inverse[axis] - slab.high[axis] for axis in range(3)]
        return passes(low, high, limit)

    def child_of(self, node: Array, lane: Array) -> Array:
        """As `WideScene.child_of`."""
        return _bits(plgpu.load(self.nodes.at[node, 6, lane], mask=self.mask))

    def find_leaf(self, child: Array) -> Array:
        """As `WideScene.find_leaf`."""
        return ~child

    def leaf_of(self, axes: tuple[Array, Array, Array], where: Array, decode: Decode | None) -> Leaf:
        """As `WideScene.leaf_of`."""
        lane = lane_numbers(self.shape, np.int32)

        def corners(axis: Array) -> tuple[Array, Array, Array]:
            first = axis.astype(np.int32) * 3
            rows = [self.blocks.at[where, first + corner, lane] for corner in range(3)]
            a, b, c = (plgpu.load(row, mask=self.mask) for row in rows)
            return a, b, c

        x, y, z = (corners(axis) for axis in axes)
        return Leaf(x, y, z, None, None, _bits(plgpu.load(self.blocks.at[where, 9, lane], mask=self.mask)))

    def faces_of(self, names: Array) -> Array:
        """Names are faces."""
        return names


def _packed_arrays(scene: PackedScene) -> list[Any]:
    """All but the frame; a single number is an array of one."""
    single = [jnp.reshape(a, 1) for a in (scene.top_count, scene.scale_exponent)]
    return [
        *single,
        scene.nodes,
        scene.planes,
        scene.headers,
        scene.words,
        scene.first_run,
        scene.runs,
        scene.faces,
    ]


class PackedTile(PackedScene):
    """References to a `PackedScene`; what they mean is decoded there."""

    shape: tuple[int, int]
    arithmetic: Arithmetic
    mask: Any

    @classmethod
    def of(
        cls, scene: PackedScene, refs: list[Any], shape: tuple[int, int], arithmetic: Arithmetic
    ) -> "PackedTile":
        """References in the order of `_packed_arrays`."""
        top_count, exponent = (jnp.broadcast_to(refs[k][...], shape) for k in range(2))
        faces = refs[8] if scene.has_faces else scene.faces
        tile = cls(*[*refs[2:8], faces, top_count, exponent, scene.frame])
        tile.shape, tile.arithmetic, tile.mask = shape, arithmetic, None
        return tile

    def among(self, mask: Array) -> "PackedTile":
        """The same, reading nothing but for the rays in the mask."""
        tile = self._replace()
        tile.shape, tile.arithmetic, tile.mask = self.shape, self.arithmetic, mask
        return tile

    def _lanes(self) -> Array:
        return lane_numbers(self.shape, np.uint32)

    def _at(self, values: Any, places: Any) -> Array:
        # Lanes behind the last triangle of a run may read anywhere.
        row = places[0] if isinstance(places, tuple) else places
        return plgpu.load(values.at[places], mask=self.mask & (row < np.uint32(len(values))))

    def _row(self, rows: Any, row: Array, first: int, count: int) -> list[Array]:
        return [plgpu.load(rows.at[row, first + k], mask=self.mask) for k in range(count)]

    def _planes_of(self, node: Array) -> list[Array]:
        lane = self._lanes() + 16
        planes = [plgpu.load(self.planes.at[node, lane + k * WIDTH], mask=self.mask) for k in range(6)]
        return [plane.astype(np.int32) for plane in planes]

    def _words_at(self, places: Array, count: int) -> list[Array]:
        return [self._at(self.words, places + k) for k in range(count)]

    def _once(self, values: Any, place: Any) -> Any:
        return self._at(values, place)

    def _settled(self, values: Any) -> Any:
        return jax.tree.map(self.arithmetic.settled, values)

    def _ones(self, values: Array) -> Array:
        return self.arithmetic.ones(values)

    def _passes(self, low: list[Array], high: list[Array], limit: Array) -> Array:
        return passes(low, high, limit)


def _bits(values: Array) -> Array:
    return lax.bitcast_convert_type(values, np.int32)
