"""Programs for a set of devices, and rays streamed through them in tiles of a few fixed sizes."""

from collections import deque
from collections.abc import Iterator
from functools import lru_cache, partial
from typing import Any

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from striptools.trace.device import quiet_jax
from striptools.trace.walk_wide import WalkOptions, WideScene, trace_rays

TILES = (2**8, 2**12, 2**16)
"""Rays a CPU device takes at once: few sizes, since each is compiled. A place not filled costs next to
nothing."""

GPU_TILES = (2**12, 2**16, 2**20)

IN_FLIGHT = 4
"""Tiles that devices work on or wait for while results are taken: bounds memory, whatever the number of
rays."""

_RAYS = PartitionSpec("device")
_EVERYWHERE = PartitionSpec()


def device_mesh(devices: list[jax.Device]) -> Mesh:
    """The devices in a row."""
    return Mesh(np.array(devices), ("device",))


def replicate(scene: WideScene, mesh: Mesh) -> WideScene:
    """Put a whole scene on each device."""
    with quiet_jax():
        return jax.device_put(scene, NamedSharding(mesh, _EVERYWHERE))


@lru_cache(maxsize=64)
def program(mesh: Mesh, options: WalkOptions) -> Any:
    """The jitted function (scene, origins, directions, t_max) -> Traced, its rays split over the devices."""
    split = jax.shard_map(
        partial(trace_rays, options=options),
        mesh=mesh,
        in_specs=(_EVERYWHERE, _RAYS, _RAYS, _RAYS),
        out_specs=_RAYS,
        check_vma=False,
    )
    return jax.jit(split)


def stream(
    scene: WideScene,
    rays: tuple[np.ndarray, np.ndarray, np.ndarray],
    mesh: Mesh,
    options: WalkOptions,
) -> Iterator[tuple[slice, tuple[np.ndarray, ...]]]:
    """Trace any number of rays; yield the slice of them that is done and its results, in order."""
    compiled = program(mesh, options)
    split = NamedSharding(mesh, _RAYS)
    waiting: deque[tuple[slice, int, Any]] = deque()
    for part, per_device in tiles(len(rays[0]), mesh.size, GPU_TILES if options.batch else TILES):
        with quiet_jax():
            padded = [_spread(a[part], mesh.size, per_device) for a in rays]
            waiting.append((part, per_device, compiled(scene, *jax.device_put(padded, split))))
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
