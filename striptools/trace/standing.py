"""An instance where it stands: the triangles of its geometry as flattening places them, bit for bit.

`mesh.instances.place` puts a vertex at ((m0 x + m1 y) + m2 z) + m3 in float64, every step rounded, and rounds
that to float32. Here the same is done to the corners of a leaf as it is visited, so that what is measured of
them, by a test of triangles or by a distance, is what it would be of the flattened scene. Scales of the
geometry and of the scene are powers of two, and in the matrix; a corner that flattening would make denormal
counts as zero.

A mirrored instance has its second and third corners exchanged, as flattened faces have.

Cost: 27 products of eight lanes in float64 for each leaf.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax

from striptools.trace.box import Slab
from striptools.trace.numerics import index
from striptools.trace.triangle import Corners, pick
from striptools.trace.triangle_tests import IN_DOUBLE
from striptools.trace.walk import Best, Decode, Leaf, Sighted, WalkOptions, found_in
from striptools.trace.walk_packed import first_corner


class Places(NamedTuple):
    """Where instances stand.

    Attributes:
        matrices: (k, 3, 4, 2) int32, the bits of float64: from the scaled geometry to the scaled scene.
        mirrored: (k,) bool, which exchange the second and third corners of their triangles.
        faces: (k,) int32, what is added to a geometry's face to give that of the flattened source.
        slips: (k,) float32, f of `walk_instances`.
        bounds: (k, 3, 4) float32, three axes V of each geometry and stretches w (`walk_points_instances`).
    """

    matrices: Any
    mirrored: Any
    faces: Any
    slips: Any
    bounds: Any


class Standing(NamedTuple):
    """One instance where it stands: of a `walk.WalkScene` what nodes and leaves are asked for.

    Attributes:
        geometries: All geometries, in their own frames.
        matrix: (3, 4, 2) int32, as of `Places`.
        mirrored: () bool.
        face: () int32.
    """

    geometries: Any
    matrix: Array
    mirrored: Array
    face: Array

    @property
    def width(self) -> int:
        """Children of a node."""
        return self.geometries.width

    @property
    def node_count(self) -> int:
        """Nodes of all geometries."""
        return self.geometries.node_count

    @property
    def has_faces(self) -> bool:
        """Whether names are triangles in file order, and faces something else."""
        return self.geometries.has_faces

    def lanes_met(self, node: Array, slab: Slab, limit: Array) -> Array:
        """(width,) bool: the node's children whose boxes a ray meets, the slab of the ray as it is moved."""
        return self.geometries.lanes_met(node, slab, limit)

    def child_of(self, node: Array, lane: Array) -> Array:
        """The child in a lane."""
        return self.geometries.child_of(node, lane)

    def find_leaf(self, child: Array) -> Any:
        """Where the triangles of a leaf are."""
        return self.geometries.find_leaf(child)

    def triangles_of(self, where: Any) -> Array:
        """() int32: how many triangles a leaf has."""
        return self.geometries.triangles_of(where)

    def faces_of(self, names: Array) -> Array:
        """(8,) int32: the flattened source's faces; some number where there is none."""
        return self.geometries.faces_of(names) + self.face

    def leaf_of(self, axes: tuple[Array, Array, Array], where: Any, decode: Decode | None) -> Leaf:
        """The triangles of a leaf where they stand, their corners along these axes."""
        own = self.geometries.leaf_of(tuple(jnp.uint32(axis) for axis in range(3)), where, decode)
        filled = ~jnp.isnan(own.x[0]) if own.filled is None else own.filled
        x, y, z = lax.optimization_barrier(self._placed((own.x, own.y, own.z)))

        def along(axis: Array) -> Corners:
            a, b, c = (pick(corner, axis) for corner in zip(x, y, z, strict=True))
            return a, b, c

        return Leaf(along(axes[0]), along(axes[1]), along(axes[2]), first_corner(x, y, z), filled, own.name)

    def visit_leaf(self, ray: Sighted, where: Any, best: Best, options: WalkOptions) -> Best:
        """Test the triangles of a leaf where they stand, against the closest hit so far."""

        def placed() -> Leaf:
            return self.leaf_of(ray.shear.axes, where, options.decode)

        return found_in(placed, ray, best, options, self.geometries.faces_of if self.has_faces else None)

    def residual(self, own: Array, point: Array) -> tuple[Array, Array]:
        """By how much a point of the geometry (3,) stands beside one of the scene, computed in float64.

        Returns:
            (3,) float32, and () float32: no less than the largest coordinate of that.
        """
        with jax.enable_x64(True):
            matrix = self._matrix()
            terms = matrix[:, :3] * own.astype(jnp.float64)
            off = terms.sum(axis=1) + matrix[:, 3] - point.astype(jnp.float64)
            rounding = (jnp.abs(terms).sum(axis=1) + jnp.abs(matrix[:, 3])) * 2.0**-48
            most = jnp.max(jnp.abs(off) + rounding) * (1 + 2.0**-22)
            return off.astype(jnp.float32), most.astype(jnp.float32)

    def _placed(self, own: tuple[Corners, Corners, Corners]) -> tuple[Corners, Corners, Corners]:
        """Corners a, b, c along x, y and z, placed."""
        with jax.enable_x64(True):
            seen = [[corner.astype(jnp.float64) for corner in axis] for axis in own]
            x, y, z = (
                tuple(_placed_along(row, [axis[j] for axis in seen]).astype(jnp.float32) for j in range(3))
                for row in self._matrix()
            )
        a, b, c = (tuple(axis[j] for axis in (x, y, z)) for j in range(3))
        b, c = (
            tuple(jnp.where(self.mirrored, p, q) for p, q in zip(*pair, strict=True))
            for pair in ((c, b), (b, c))
        )
        x, y, z = zip(a, b, c, strict=True)
        return x, y, z

    def _matrix(self) -> Array:
        """(3, 4) float64; to be called where x64 is enabled."""
        return lax.bitcast_convert_type(self.matrix, jnp.float64)


def standing(geometries: Any, places: Places, instance: Array) -> Standing:
    """An instance by its number, of the arrays of all."""

    def taken(values: Array) -> Array:
        return lax.dynamic_index_in_dim(values, index(instance), keepdims=False)

    return Standing(geometries, taken(places.matrices), taken(places.mirrored), taken(places.faces))


def _placed_along(row: Array, point: list[Array]) -> Array:
    """A coordinate of placed points, as `mesh.instances.place` computes it: no step is fused with another."""
    x, y, z = (IN_DOUBLE.product(row[axis], point[axis]) for axis in range(3))
    return ((x + y) + z) + row[3]
