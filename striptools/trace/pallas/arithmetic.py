"""What `numerics` says, said to Triton: single instructions of PTX where LLVM would take its own way.

Triton fuses products and sums, and its division is an approximation. An instruction that names its rounding
is left alone. Denormals are flushed as XLA flushes them on a CPU.
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.experimental.pallas import triton as plgpu

from striptools.trace.numerics import Arithmetic

_PRODUCT = "{ .reg .f32 p; mul.rn.ftz.f32 p, $1, $2; max.ftz.f32 $0, p, 0fFF7FFFFF; }"
"""As `numerics.rounded`: what is not a number, and minus infinity, become the lowest finite value."""

_QUOTIENT = "div.rn.ftz.f32 $0, $1, $2;"


_ONES = "popc.b32 $0, $1;"
"""Triton has no such operation of its own."""


def _instruction(assembly: str, kind: Any, constraint: str) -> Callable[..., Array]:
    """A function of arrays, of one kind and of shapes that broadcast."""

    def run(*given: Array) -> Array:
        shape = jnp.broadcast_shapes(*map(jnp.shape, given))
        return plgpu.elementwise_inline_asm(
            assembly,
            args=[jnp.broadcast_to(a, shape) for a in given],
            constraints=",".join([f"={constraint}", *[constraint] * len(given)]),
            pack=1,
            result_shape_dtypes=[jax.ShapeDtypeStruct(shape, kind)],
        )[0]

    return run


BY_TRITON = Arithmetic(
    _instruction(_PRODUCT, np.float32, "f"),
    _instruction(_QUOTIENT, np.float32, "f"),
    lax.min,
    lax.max,
    lambda a: a,
    lambda a: _instruction(_ONES, np.int32, "r")(a).astype(np.uint32),
)
"""Of a number and what is none, the smaller and the larger are the number."""
