"""Programs for a set of devices, and rays streamed through those that prepare them, in tiles."""

import warnings
from collections import deque
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from striptools.trace.device import SlowTracingWarning, quiet_jax
from striptools.trace.layout import Rays
from striptools.trace.walk import Traced, WalkOptions, WalkScene, trace_rays
from striptools.trace.walk_packets import PacketScene

TILES = (2**8, 2**12, 2**16)
"""Rays a CPU device takes at once: few sizes, since each is compiled. A place not filled costs next to
nothing."""

GPU_TILES = (2**12, 2**16, 2**20)
"""Rays a GPU takes at once: with 2**18, which the kernel does as fast, whole calls are slower by a third."""

IN_FLIGHT = 4
"""Tiles that a GPU works on or waits for while results are taken: bounds memory, whatever the number of
rays."""

RAYS = PartitionSpec("device")
"""One share of the rays a device."""

EVERYWHERE = PartitionSpec()
"""The whole on each device."""

LEFT_IN_LOOPS = {"xla_disable_hlo_passes": "while-loop-invariant-code-motion"}
"""How programs are compiled for a CPU: what XLA works out before a loop, to save a load or a sum, is one more
value that the loop carries, for which its CPU backend stores a pointer in each turn."""

_refused: set[WalkOptions] = set()
"""Options with which the kernel could not be compiled in this process."""


def device_mesh(devices: list[jax.Device]) -> Mesh:
    """The devices in a row."""
    return Mesh(np.array(devices), ("device",))


def replicate(scene: WalkScene, mesh: Mesh) -> WalkScene:
    """Put a whole scene on each device."""
    with quiet_jax():
        return jax.device_put(scene, NamedSharding(mesh, EVERYWHERE))


@lru_cache(maxsize=512)
def program(mesh: Mesh, options: WalkOptions, packets: bool = False) -> Any:
    """The jitted function from a scene and rays to `Traced`, the rays split over the devices.

    Rays are (origins, directions, t_max) where all are walked at once, else ready ones or ready packets, and
    how many there are on each device, (devices,) int32.
    """
    walk, arrays = _walk_of(options, packets)
    return split_over(mesh, partial(walk, options=options), arrays)


def split_over(mesh: Mesh, walk: Callable[..., Any], arrays: int) -> Any:
    """The jitted function from a scene and so many arrays of rays, or of points, to what a walk says of each.

    The scene is whole on each device; rays are split over the devices, and so is what is said of them.
    """
    split = jax.shard_map(
        walk, mesh=mesh, in_specs=(EVERYWHERE, *(RAYS,) * arrays), out_specs=RAYS, check_vma=False
    )
    on_cpu = mesh.devices.flat[0].platform == "cpu"
    return jax.jit(split, compiler_options=LEFT_IN_LOOPS if on_cpu else None)


def _walk_of(options: WalkOptions, packets: bool) -> tuple[Any, int]:
    """What walks rays, and how many arrays they are."""
    if options.kernel or options.batch:
        return tracing(options), 3
    return _walk_packets if packets else _walk_ready, 2


def tracing(options: WalkOptions) -> Callable[..., Traced]:
    """What traces rays that are not ready yet: the kernel, or its twin."""
    if options.kernel:
        # Here, so that a JAX without Pallas or its Triton does for all else.
        from striptools.trace.pallas.walk import trace_rays as trace_by_kernel

        return trace_by_kernel
    return trace_rays


def _walk_ready(scene: WalkScene, ready: jax.Array, live: jax.Array, options: WalkOptions) -> Traced:
    return scene.walk_rays(ready, options, live[0])


def _walk_packets(scene: PacketScene, ready: jax.Array, live: jax.Array, options: WalkOptions) -> Traced:
    return scene.walk_packets(ready, options, live[0])


def _started(mesh: Mesh, options: WalkOptions, scene: WalkScene, *rays: Any) -> Any:
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


def tried(mesh: Mesh, options: WalkOptions, scene: WalkScene) -> WalkOptions:
    """The same options, without a kernel that cannot be compiled here: it is compiled, and that is said."""
    if options.kernel:
        rays = (np.zeros((TILES[0], 3), np.float32),) * 2
        _started(mesh, options, scene, *rays, np.zeros(TILES[0], np.float32))
    return options._replace(kernel=options.kernel and options not in _refused)


def stream(
    scene: WalkScene, rays: Rays, mesh: Mesh, options: WalkOptions
) -> Iterator[tuple[slice, tuple[np.ndarray, ...]]]:
    """Trace any number of rays by devices that prepare them; yield slices of them and results, in order."""
    yield from stream_through(partial(_started, mesh, options), scene, rays, mesh, GPU_TILES)


def stream_through(
    start: Callable[..., Any],
    scene: WalkScene,
    rays: tuple[np.ndarray, ...],
    mesh: Mesh,
    sizes: tuple[int, ...],
) -> Iterator[tuple[slice, tuple[np.ndarray, ...]]]:
    """The same by whatever starts a scene and arrays; places left over hold zeros."""
    split = NamedSharding(mesh, RAYS)
    waiting: deque[tuple[slice, int, Any]] = deque()
    for part, per_device in tiles(len(rays[0]), mesh.size, sizes):
        with quiet_jax():
            padded = [_spread(a[part], mesh.size, per_device) for a in rays]
            waiting.append((part, per_device, start(scene, *jax.device_put(padded, split))))
        if len(waiting) >= IN_FLIGHT:
            yield _collect(*waiting.popleft(), mesh.size)
    while waiting:
        yield _collect(*waiting.popleft(), mesh.size)


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
