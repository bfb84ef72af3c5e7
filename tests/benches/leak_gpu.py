"""The walks of a GPU, on a CPU: the plain-JAX twin of the kernel, and the kernel by Pallas' interpreter."""

from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np

from striptools.reducem.scene import Scene
from striptools.trace import Tracer
from striptools.trace.launch import stream_through
from striptools.trace.layout import Rays
from striptools.trace.pallas import walk as kernel
from striptools.trace.streams import Take
from striptools.trace.tracer import ResidentKind
from striptools.trace.walk import WalkOptions, trace_rays

RAYS_AT_ONCE = (2**8, 2**12)

QUICK = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
"""How programs are compiled, to take seconds."""

UNFUSED = {"xla_disable_hlo_passes": "fusion"}
"""And the kernel's over packed leaves: fusing the decoding takes minutes."""


class GpuWalk(Tracer):
    """A tracer on the CPU that walks as on a GPU; what is done before and after is the tracer's.

    Args:
        scene: What to trace.
        resident: "expanded" or "compressed".
        by_kernel: Interpret the kernel; else its twin walks.
    """

    def __init__(self, scene: Scene, resident: ResidentKind, *, by_kernel: bool) -> None:
        super().__init__(scene, device="cpu", threads=1, resident=resident)
        self._by_kernel = by_kernel

    def _trace(
        self, rays: Rays, dropped: np.ndarray, options: WalkOptions | None, take: Take, **_: bool
    ) -> None:
        assert options is not None
        walk = _program(self._by_kernel, options._replace(interleave=1, batch=True))
        for part, traced in stream_through(walk, self._scene, rays, self._mesh, RAYS_AT_ONCE):
            take(np.arange(part.start, part.stop, dtype=np.int32), traced)


@lru_cache(maxsize=16)
def _program(by_kernel: bool, options: WalkOptions) -> Any:
    """The jitted function from a scene and rays to `Traced`."""
    unfused = UNFUSED if by_kernel and options.decode is not None else {}
    trace = partial(kernel.trace_rays, interpret=True) if by_kernel else trace_rays
    return jax.jit(partial(trace, options=options), compiler_options={**QUICK, **unfused})
