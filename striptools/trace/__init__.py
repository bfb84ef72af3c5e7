"""Ray tracing with JAX.

Import this before JAX computes anything: it switches on what makes JAX's CPU backend fast.
"""

from striptools.trace.device import SlowTracingWarning, prepare_jax

prepare_jax()

from striptools.trace.hit import AllHits, ClosestPoints, Hits  # noqa: E402
from striptools.trace.tracer import Tracer  # noqa: E402

__all__ = ["AllHits", "ClosestPoints", "Hits", "SlowTracingWarning", "Tracer"]
