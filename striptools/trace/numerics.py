"""Float32 arithmetic that means the same wherever XLA compiles it.

XLA's CPU backend contracts a product and a sum to one fused multiply-add whenever it can, flushes
denormals, and has slow minimum and maximum operations. The functions here say what is meant.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

LOWEST = np.float32(np.finfo(np.float32).min)
HIGHEST = np.float32(np.finfo(np.float32).max)
LEAST_NORMAL = np.float32(np.finfo(np.float32).tiny)
SIGN = np.int32(-(2**31))


def smaller(a: Array, b: Array) -> Array:
    """The smaller of two, `b` where they do not compare: one instruction, where jnp.minimum takes four."""
    return jnp.where(a < b, a, b)


def larger(a: Array, b: Array) -> Array:
    """The larger of two, `b` where they do not compare."""
    return jnp.where(a > b, a, b)


def ends_of(values: Sequence[Array]) -> tuple[Array, Array]:
    """The least and the greatest of three; not a number where the last of them is none."""
    a, b, c = values
    return smaller(smaller(a, b), c), larger(larger(a, b), c)


def any_lane(flags: Array) -> Array:
    """Whether any lane's flag is set: quicker than jnp.any, which compares booleans one by one."""
    return jnp.sum(jnp.where(flags, np.int32(1), np.int32(0))) != 0


def in_range(t: Array) -> Array:
    """A positive t, no less than the least normal float32 and no more than the largest: a hit stays one."""
    t = jnp.where(t < HIGHEST, t, HIGHEST)
    return jnp.where(t > LEAST_NORMAL, t, LEAST_NORMAL)


def rounded(product: Array) -> Array:
    """A product, rounded to float32 before it is used: no fused multiply-add reaches through.

    Not a number, and minus infinity, become the lowest finite value.
    """
    return jnp.where(product > LOWEST, product, LOWEST)


def quotient(a: Array, b: Array) -> Array:
    """Divide a by b, rounded correctly on every platform: the same bits.

    A CPU divides so. A GPU's own division may be a unit or two off in the last place. There float64
    divides, and its result, first rounded to 51 bits, is rounded to float32: still right, because 51 bits
    are more than twice 24. Without the step between, LLVM would make a float32 division of it again.
    """
    return lax.platform_dependent(a, b, cpu=lax.div, default=_divided_in_double)


def _divided_in_double(a: Array, b: Array) -> Array:
    with jax.enable_x64(True):
        exact = a.astype(jnp.float64) / b.astype(jnp.float64)
        return lax.reduce_precision(exact, exponent_bits=11, mantissa_bits=50).astype(jnp.float32)


class Arithmetic(NamedTuple):
    """Operations that each compiler has its own way with, said so that all mean the same.

    Attributes:
        product: Of two, rounded as by `rounded`.
        quotient: Of two, rounded correctly.
        smaller: Of two that compare.
        larger: Of two that compare.
        settled: A value that is not computed again for each use.
    """

    product: Callable[[Array, Array], Array]
    quotient: Callable[[Array, Array], Array]
    smaller: Callable[[Array, Array], Array]
    larger: Callable[[Array, Array], Array]
    settled: Callable[[Array], Array]


BY_XLA = Arithmetic(
    lambda a, b: rounded(a * b),
    quotient,
    smaller,
    larger,
    lax.optimization_barrier,
)


def sign_of(a: Array) -> Array:
    """Int32: the top bit where a number is negative, or -0.0, else zero."""
    return lax.bitcast_convert_type(a, jnp.int32) & SIGN


def with_sign_of(a: Array, sign_bit: Array) -> Array:
    """Flip the sign of `a` where `sign_bit` (int32, the top bit or zero) is set."""
    return lax.bitcast_convert_type(lax.bitcast_convert_type(a, jnp.int32) ^ sign_bit, jnp.float32)


def power_of_two_below(a: Array) -> tuple[Array, Array]:
    """1/p and p for the power of two p <= a < 2p of a normal positive float32; both stay normal."""
    exponent = lax.bitcast_convert_type(a, jnp.int32) >> 23
    exponent = jnp.where(exponent > 253, 253, jnp.where(exponent < 1, 1, exponent))
    inverse = lax.bitcast_convert_type((254 - exponent) << 23, jnp.float32)
    return inverse, lax.bitcast_convert_type(exponent << 23, jnp.float32)


def kept(number: Array) -> Array:
    """A whole number () that is worked out once: XLA works out one that is no sum anew for each use."""
    return jnp.sum(jnp.where(jnp.arange(2) == 0, number, 0))


def index(a: Array) -> Array:
    """An index that is known not to be negative: unsigned, so that XLA adds no case for negative ones."""
    return a.astype(jnp.uint32)


def folded(values: Array, join: Callable[[Array, Array], Array]) -> Array:
    """The lanes joined pairwise, a power of two of them: XLA makes a chain of a reduction."""
    while len(values) > 1:
        half = len(values) // 2
        values = join(values[:half], values[half:])
    return values[0]
