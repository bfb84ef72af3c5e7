"""Which kernel walks which scene."""

from typing import Any

from jax import Array

from striptools.trace.pallas import walk, walk_binary
from striptools.trace.pallas.layout import BinaryScene, binary_scene
from striptools.trace.walk import Traced, WalkOptions, prepared_rays
from striptools.trace.walk_wide import WideScene


def kernel_scene(arrays: Any) -> Any:
    """A scene as its kernel takes it, of NumPy arrays: an expanded one as a binary hierarchy."""
    return binary_scene(arrays) if isinstance(arrays, WideScene) else arrays


def trace_rays(scene: Any, origins: Array, directions: Array, t_max: Array, options: WalkOptions) -> Traced:
    """Trace rays as `walk.trace_rays` does, walking them by a kernel.

    Args:
        scene: From `kernel_scene`, on a device.
        origins: (r, 3) float32, r a multiple of 32.
        directions: (r, 3) float32.
        t_max: (r,) float32.
        options: What to compile in.
    """
    ready = prepared_rays(scene, origins, directions, t_max)
    by_thread = isinstance(scene, BinaryScene)
    return (walk_binary if by_thread else walk).walk_rays(scene, ready, options)
