"""The test of a leaf block: eight triangles as `kernels.wide.fill_leaf_blocks` writes them.

Every walk over expanded triangles tests them here, so that t is the same bit for bit whichever hierarchy led
to them.
"""

import jax.numpy as jnp
from jax import Array, lax

from striptools.trace.triangle import Corners, Shear
from striptools.trace.walk import NO_NAME, WIDTH, Best, Leaf, nearer
from striptools.types import TriangleTest


def test_block(blocks: Array, block: Array, shear: Shear, best: Best, test: TriangleTest) -> Best:
    """Test the triangles of a block, against the closest hit so far.

    Args:
        blocks: (l, 10, 8) float32, rows of x, y and z of corners a, b and c, then the bits of faces.
        block: () uint32, which of them.
        shear: Of the ray.
        best: What was found so far.
        test: Of triangles.
    """
    leaf = leaf_in(blocks, block, shear.axes)
    t = leaf.crossings(shear, test=test, again=lambda: leaf_in(blocks, block, shear.axes))
    return nearer(best, t, leaf.name)


def leaf_in(blocks: Array, block: Array, axes: tuple[Array, Array, Array]) -> Leaf:
    """The triangles of a block, their corners along these axes."""
    return Leaf(*corners_in(blocks, block, axes), None, None, faces_in(blocks, block))


def corners_in(
    blocks: Array, block: Array, axes: tuple[Array, Array, Array]
) -> tuple[Corners, Corners, Corners]:
    """Corners a, b, c along the axes, (8,) float32 each."""

    def corners(axis: Array) -> Corners:
        rows = lax.dynamic_slice(blocks, (block, axis * 3, jnp.uint32(0)), (1, 3, WIDTH))[0]
        return rows[0], rows[1], rows[2]

    return corners(axes[0]), corners(axes[1]), corners(axes[2])


def faces_in(blocks: Array, block: Array) -> Array:
    """(8,) int32: the face in each lane, `NO_NAME` where there is none."""
    bits = lax.dynamic_slice(blocks, (block, jnp.uint32(9), jnp.uint32(0)), (1, 1, WIDTH))[0, 0]
    return lax.bitcast_convert_type(bits, jnp.int32)


def triangles_in(blocks: Array, block: Array) -> Array:
    """() int32: how many triangles a block has."""
    return jnp.where(faces_in(blocks, block) == NO_NAME, 0, 1).sum().astype(jnp.int32)
