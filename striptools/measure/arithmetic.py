"""What XLA does to float32 arithmetic here, and whether the tracer's guards hold: it contracts and flushes.

Each probe runs one small program twice: as it stands, and guarded as the tracer guards it
(`trace.numerics`), and compares both with float32 NumPy, where every operation is rounded once and denormals
are kept. A backend that stops, or begins, to contract, flush or reassociate is noticed, and one on which a
guard no longer holds is a violation.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np

from striptools.trace.device import quiet_jax
from striptools.trace.numerics import quotient, rounded

PROBES = 4096


@dataclass(frozen=True)
class Probe:
    """What was found of one liberty that a compiler may take.

    Attributes:
        name: The liberty.
        taken: Whether XLA takes it where nothing guards against it.
        guarded: Whether what the tracer relies on holds.
    """

    name: str
    taken: bool
    guarded: bool


def probe_arithmetic() -> tuple[Probe, ...]:
    """Try contraction, reassociation, flushing and division on the default device."""
    with quiet_jax():
        return (_contraction(), _reassociation(), _division(), _flushing())


def differs(program: Callable[..., jax.Array], expected: np.ndarray, *arguments: np.ndarray) -> bool:
    """Whether a compiled program gives other bits than expected; zeros of both signs are one."""
    found = np.asarray(jax.jit(program)(*arguments)) + np.float32(0)
    return bool((found.view(np.int32) != (expected + np.float32(0)).view(np.int32)).any())


def _numbers(count: int) -> list[np.ndarray]:
    random = np.random.default_rng(0)
    return [random.uniform(0.5, 2, PROBES).astype(np.float32) for _ in range(count)]


def _contraction() -> Probe:
    """Contracted, a b - b a is what is left of a rounding, and not zero; a product that is rounded is not."""
    a, b = _numbers(2)
    zero = np.zeros(PROBES, np.float32)
    taken = differs(lambda a, b: a * b - b * a, zero, a, b) or differs(
        lambda a, b, c: a * b - c, a * b - a, a, b, a
    )
    c, d = b[::-1].copy(), a[::-1].copy()
    held = not differs(lambda a, b, c, d: rounded(a * b) - rounded(c * d), a * b - c * d, a, b, c, d)
    held &= not differs(lambda a, b: rounded(a * b) - rounded(b * a), zero, a, b)
    return Probe("contraction", taken, held)


def _reassociation() -> Probe:
    """(a + b) - a is not b, and a + b + c is summed from the left: `triangle` sums in a canonical order."""
    a, b, c = _numbers(3)
    b *= np.float32(1e-4)
    taken = differs(lambda a, b: (a + b) - a, (a + b) - a, a, b)
    taken |= differs(lambda a, b, c: a + b + c, a + b + c, a, b, c)
    return Probe("reassociation", taken, not taken)


def _division() -> Probe:
    """Divided by a loop's invariant, a may be multiplied by its reciprocal; by `quotient` it is not."""
    a, b = _numbers(2)

    def by_invariant(divide: Callable[[jax.Array, jax.Array], jax.Array]) -> Callable[..., jax.Array]:
        return lambda a, b: jax.lax.map(lambda x: divide(x, b[0]), a)

    expected = a / b[0]
    taken = differs(by_invariant(lambda x, y: x / y), expected, a, b)
    held = not differs(by_invariant(quotient), expected, a, b) and not differs(quotient, a / b, a, b)
    return Probe("division by a reciprocal", taken, held)


def _flushing() -> Probe:
    """A denormal product is zero; scaled to 1 to 2, as the tracer scales, none of the inputs is denormal."""
    a, _ = _numbers(2)
    tiny, scale = a * np.float32(2.0**-130), np.float32(2.0**120)
    taken = differs(lambda a: a * np.float32(0.5), tiny * np.float32(0.5), tiny)
    small = a * np.float32(2.0**-120)
    return Probe("flushing of denormals", taken, not differs(lambda a: a * scale, small * scale, small))
