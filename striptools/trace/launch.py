"""Programs for a set of devices, and rays streamed through them in tiles of a few fixed sizes."""

import warnings
from collections import deque
from collections.abc import Iterator
from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from striptools.kernels.rays import ROW, ready_rays
from striptools.trace.device import SlowTracingWarning, quiet_jax
from striptools.trace.layout import Layout
from striptools.trace.leaves import Rays, aligned_full
from striptools.trace.walk import WalkOptions, WalkScene, trace_rays, walk_rays

TILES = (2**8, 2**12, 2**16)
"""Rays a CPU device takes at once: few sizes, since each is compiled. A place not filled costs next to
nothing."""

GPU_TILES = (2**12, 2**16, 2**20)
"""Rays a GPU takes at once: with 2**18, which the kernel does as fast, whole calls are slower by a third."""

IN_FLIGHT = 4
"""Tiles that a GPU works on or waits for while results are taken: bounds memory, whatever the number of
rays."""

READY_IN_FLIGHT = 2
"""The same of CPU devices: more only push each other's rays out of the cache."""

_refused: set[WalkOptions] = set()
"""Options with which the kernel could not be compiled in this process."""

_RAYS = PartitionSpec("device")
_EVERYWHERE = PartitionSpec()


def device_mesh(devices: list[jax.Device]) -> Mesh:
    """The devices in a row."""
    return Mesh(np.array(devices), ("device",))


def replicate(scene: WalkScene, mesh: Mesh) -> WalkScene:
    """Put a whole scene on each device."""
    with quiet_jax():
        return jax.device_put(scene, NamedSharding(mesh, _EVERYWHERE))


@lru_cache(maxsize=64)
def program(mesh: Mesh, options: WalkOptions) -> Any:
    """The jitted function from a scene and rays to `Traced`, the rays split over the devices.

    Rays are (origins, directions, t_max) where all are walked at once, else ready ones.
    """
    walk, arrays = _walk_of(options)
    split = jax.shard_map(
        partial(walk, options=options),
        mesh=mesh,
        in_specs=(_EVERYWHERE, *(_RAYS,) * arrays),
        out_specs=_RAYS,
        check_vma=False,
    )
    return jax.jit(split)


def _walk_of(options: WalkOptions) -> tuple[Any, int]:
    """What walks rays, and how many arrays they are."""
    if options.kernel:
        # Here, so that a JAX without Pallas or its Triton does for all else.
        from striptools.trace.pallas.walk import trace_rays as trace_by_kernel

        return trace_by_kernel, 3
    return (trace_rays, 3) if options.batch else (walk_rays, 1)


def _started(scene: WalkScene, rays: list[Any], mesh: Mesh, options: WalkOptions) -> Any:
    """Start a tile; where the kernel cannot be compiled, say so once, and let its twin walk."""
    if options.kernel and options not in _refused:
        try:
            return program(mesh, options)(scene, *rays)
        except Exception as error:
            # Pallas, Triton and XLA raise as they please; of what else is wrong the twin will tell.
            _refused.add(options)
            reason = str(error).strip().partition("\n")[0] or type(error).__name__
            warnings.warn(
                f"the GPU kernel cannot be compiled here; rays are walked many times slower: {reason}",
                SlowTracingWarning,
                stacklevel=2,
            )
    return program(mesh, options._replace(kernel=False))(scene, *rays)


def stream(
    scene: WalkScene, rays: Rays, mesh: Mesh, options: WalkOptions
) -> Iterator[tuple[slice, tuple[np.ndarray, ...]]]:
    """Trace any number of rays by devices that prepare them; yield slices of them and results, in order."""
    split = NamedSharding(mesh, _RAYS)
    waiting: deque[tuple[slice, int, Any]] = deque()
    for part, per_device in tiles(len(rays[0]), mesh.size, GPU_TILES):
        with quiet_jax():
            padded = [_spread(a[part], mesh.size, per_device) for a in rays]
            on_device = jax.device_put(padded, split)
            waiting.append((part, per_device, _started(scene, on_device, mesh, options)))
        if len(waiting) >= IN_FLIGHT:
            yield _collect(*waiting.popleft(), mesh.size)
    while waiting:
        yield _collect(*waiting.popleft(), mesh.size)


def stream_ready(
    scene: WalkScene, layout: Layout, rays: Rays, dropped: np.ndarray, mesh: Mesh, options: WalkOptions
) -> Iterator[tuple[np.ndarray, tuple[np.ndarray, ...]]]:
    """Make rays ready on this side, trace those that meet a child of the root, and yield them in order.

    Args:
        scene: On the devices.
        layout: The same on this side.
        rays: Origins, directions and t_max.
        dropped: (r,) uint8, written, see `kernels.rays.ready_rays`.
        mesh: The CPU devices.
        options: What to compile in.

    Yields:
        Which rays these are, int32, and their results.
    """
    compiled = program(mesh, options)
    split = NamedSharding(mesh, _RAYS)
    count = len(rays[0])
    room = next((size for size in TILES if size * mesh.size >= count), TILES[-1])
    spare: list[tuple[np.ndarray, np.ndarray]] = []
    waiting: deque[tuple[int, int, Any, tuple[np.ndarray, np.ndarray]]] = deque()

    def collect() -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        live, per_device, traced, buffers = waiting.popleft()
        results = _collect(slice(0, live), per_device, traced, mesh.size)[1]
        # Results are there, so nobody reads these rays any more.
        spare.append(buffers)
        return buffers[1][:live], results

    seen = (tuple(layout.arrays.frame), *layout.root)
    begin = 0
    while begin < count:
        buffers = spare.pop() if spare else _ready_buffers(room * mesh.size)
        places = (buffers[0], buffers[0].view(np.int32), buffers[1])
        live, begin = ready_rays(*rays, begin, *seen, True, *places, dropped)
        if live:
            _, per_device = next(tiles(live, mesh.size, TILES))
            with quiet_jax():
                padded = _spread(buffers[0][:live], mesh.size, per_device)
                waiting.append((live, per_device, compiled(scene, jax.device_put(padded, split)), buffers))
        if len(waiting) >= READY_IN_FLIGHT:
            yield collect()
    while waiting:
        yield collect()


def _ready_buffers(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Places for ready rays, and for which ones they are."""
    return aligned_full((count, ROW), 0.0), np.zeros(count, np.int32)


def tiles(count: int, devices: int, sizes: tuple[int, ...]) -> Iterator[tuple[slice, int]]:
    """Cut `count` rays into runs, each with the rays a device has room for in the program it takes."""
    start = 0
    while start < count:
        share = -(-(count - start) // devices)
        room = next((size for size in sizes if size >= share), sizes[-1])
        stop = min(count, start + room * devices)
        yield slice(start, stop), room
        start = stop


def _spread(rays: np.ndarray, devices: int, room: int) -> np.ndarray:
    """Give each device its share; places left over hold rays of no direction, which end at once."""
    share = -(-len(rays) // devices)
    if share == room and len(rays) == devices * room:
        return rays
    padded = np.zeros((devices * room, *rays.shape[1:]), np.float32)
    for k in range(devices):
        mine = rays[k * share : (k + 1) * share]
        padded[k * room : k * room + len(mine)] = mine
    return padded


def _collect(part: slice, room: int, traced: Any, devices: int) -> tuple[slice, tuple[np.ndarray, ...]]:
    """Wait for a tile and take the padding out of its results."""
    count = part.stop - part.start
    share = -(-count // devices)
    results = []
    for a in traced:
        values = np.asarray(a)
        if len(values) and not (share == room and count == len(values)):
            kept = [
                values[k * room : k * room + min(share, max(0, count - k * share))] for k in range(devices)
            ]
            values = np.concatenate(kept)
        results.append(values)
    return part, tuple(results)
