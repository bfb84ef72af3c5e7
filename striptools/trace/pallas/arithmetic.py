"""What `numerics` says, said to Triton: single instructions of PTX where LLVM would take its own way.

Triton fuses products and sums, and its division is an approximation. An instruction that names its rounding
is left alone. Denormals are flushed as XLA flushes them on a CPU.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.experimental.pallas import triton as plgpu

from striptools.trace.numerics import Arithmetic

_PRODUCT = "{ .reg .f32 p; mul.rn.ftz.f32 p, $1, $2; max.ftz.f32 $0, p, 0fFF7FFFFF; }"
"""As `numerics.rounded`: what is not a number, and minus infinity, become the lowest finite value."""

_QUOTIENT = "div.rn.ftz.f32 $0, $1, $2;"


def _instruction(assembly: str) -> Callable[[Array, Array], Array]:
    """A function of two float32 arrays of one shape."""

    def run(a: Array, b: Array) -> Array:
        shape = jnp.broadcast_shapes(jnp.shape(a), jnp.shape(b))
        result = jax.ShapeDtypeStruct(shape, np.float32)
        given = [jnp.broadcast_to(a, shape), jnp.broadcast_to(b, shape)]
        return plgpu.elementwise_inline_asm(
            assembly, args=given, constraints="=f,f,f", pack=1, result_shape_dtypes=[result]
        )[0]

    return run


BY_TRITON = Arithmetic(_instruction(_PRODUCT), _instruction(_QUOTIENT), lax.min, lax.max, lambda a: a)
"""Of two numbers; where one is not a number, the smaller and the larger are the other."""
