"""What `numerics` says, said to Triton: single instructions of PTX where LLVM would take its own way.

Whether Triton fuses products and sums depends on who calls it (XLA does not let it), and its division is an
approximation. An instruction that names its rounding is left alone. Denormals are flushed as XLA flushes them
on a CPU.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jax.experimental.pallas import triton as plgpu

from striptools.trace.numerics import BY_XLA, Arithmetic

_PLAIN_PRODUCT = "mul.rn.ftz.f32 $0, $1, $2;"

_PRODUCT = "{ .reg .f32 p; mul.rn.ftz.f32 p, $1, $2; max.ftz.f32 $0, p, 0fFF7FFFFF; }"
"""As `numerics.rounded`: what is not a number, and minus infinity, become the lowest finite value."""

_QUOTIENT = "div.rn.ftz.f32 $0, $1, $2;"

_LEAST = "min.NaN.ftz.f32 $0, $1, $2;"
"""Triton's is the number where the other is none."""

_FUSED = "fma.rn.ftz.f32 $0, $1, $2, $3;"

_ONE_AND_BYTE = "prmt.b32 $0, $1, 0x3F800000, $2;"


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


def _one_and_byte(word: Array, byte: Array) -> Array:
    # Of the eight bytes of the word and of one the numbers 4, k, 6 and 7, from below.
    picked = _instruction(_ONE_AND_BYTE, np.int32, "r")(word.astype(np.int32), 0x7604 | byte << 4)
    return lax.bitcast_convert_type(picked, np.float32)


def _one_and_byte_plainly(word: Array, byte: Array) -> Array:
    bits = 0x3F800000 | (word >> (8 * byte).astype(np.uint32) & 0xFF) << 8
    return lax.bitcast_convert_type(bits, np.float32)


class KernelArithmetic(NamedTuple):
    """What a kernel computes with.

    Attributes:
        exact: As the twin does.
        sifting: The same where what is not a number may stay so.
        least: The smaller of two; not a number where one is none.
        fused: The product of two and the sum with a third, rounded once or twice.
        one_and_byte: Of a uint32 and an int32 k, 1 + b / 2**15, b its k-th byte from below, float32.
    """

    exact: Arithmetic
    sifting: Arithmetic
    least: Callable[[Array, Array], Array]
    fused: Callable[[Array, Array, Array], Array]
    one_and_byte: Callable[[Array, Array], Array]


_EXACT = Arithmetic(
    _instruction(_PRODUCT, np.float32, "f"),
    _instruction(_QUOTIENT, np.float32, "f"),
    lax.min,
    lax.max,
    lambda a: a,
)
"""Of a number and what is none, the smaller and the larger are the number."""

BY_TRITON = KernelArithmetic(
    _EXACT,
    _EXACT._replace(product=_instruction(_PLAIN_PRODUCT, np.float32, "f")),
    _instruction(_LEAST, np.float32, "f"),
    _instruction(_FUSED, np.float32, "f"),
    _one_and_byte,
)

_INTERPRETED = BY_XLA._replace(quotient=lax.div)

BY_INTERPRETER = KernelArithmetic(
    _INTERPRETED, _INTERPRETED, lax.min, lambda a, b, c: a * b + c, _one_and_byte_plainly
)
