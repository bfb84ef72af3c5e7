"""Programs for a set of devices, and rays streamed through them in tiles of a few fixed sizes."""

import warnings
from collections import deque
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec

from striptools.kernels.packets import PACKET, ready_packets
from striptools.kernels.packets import ROW as PACKET_ROW
from striptools.kernels.pictures import row_width, tile_order
from striptools.kernels.ray_order import CELLS, sort_rays, start_apart
from striptools.kernels.rays import ROW, ready_rays
from striptools.trace.device import SlowTracingWarning, quiet_jax
from striptools.trace.layout import Layout, Rays
from striptools.trace.leaves import aligned_zeros
from striptools.trace.triangle_tests import wants_way
from striptools.trace.walk import Traced, WalkOptions, WalkScene, trace_rays
from striptools.trace.walk_packets import PacketScene

TILES = (2**8, 2**12, 2**16)
"""Rays a CPU device takes at once: few sizes, since each is compiled. A place not filled costs next to
nothing."""

LEAST_SORTED = 2**24
"""Bytes of a scene for which rays are sorted: one in a core's own caches is read as fast in any order."""

SORTED = 2**19
"""Rays that are sorted together."""

PACKET_TILES = (2**3, 2**7, 2**11)
"""Packets that a CPU device takes at once."""

EVERY_RAY = np.zeros(0, np.int32)

GPU_TILES = (2**12, 2**16, 2**20)
"""Rays a GPU takes at once: with 2**18, which the kernel does as fast, whole calls are slower by a third."""

IN_FLIGHT = 4
"""Tiles that a GPU works on or waits for while results are taken: bounds memory, whatever the number of
rays."""

READY_IN_FLIGHT = 2
"""The same of CPU devices: more only push each other's rays out of the cache."""

RAYS = PartitionSpec("device")
"""One share of the rays a device."""

EVERYWHERE = PartitionSpec()
"""The whole on each device."""

_refused: set[WalkOptions] = set()
"""Options with which the kernel could not be compiled in this process."""


def device_mesh(devices: list[jax.Device]) -> Mesh:
    """The devices in a row."""
    return Mesh(np.array(devices), ("device",))


def replicate(scene: WalkScene, mesh: Mesh) -> WalkScene:
    """Put a whole scene on each device."""
    with quiet_jax():
        return jax.device_put(scene, NamedSharding(mesh, EVERYWHERE))


@lru_cache(maxsize=64)
def program(mesh: Mesh, options: WalkOptions, packets: bool = False) -> Any:
    """The jitted function from a scene and rays to `Traced`, the rays split over the devices.

    Rays are (origins, directions, t_max) where all are walked at once, else ready ones or ready packets.
    """
    walk, arrays = _walk_of(options, packets)
    split = jax.shard_map(
        partial(walk, options=options),
        mesh=mesh,
        in_specs=(EVERYWHERE, *(RAYS,) * arrays),
        out_specs=RAYS,
        check_vma=False,
    )
    return jax.jit(split)


def _walk_of(options: WalkOptions, packets: bool) -> tuple[Any, int]:
    """What walks rays, and how many arrays they are."""
    if options.kernel:
        # Here, so that a JAX without Pallas or its Triton does for all else.
        from striptools.trace.pallas.walk import trace_rays as trace_by_kernel

        return trace_by_kernel, 3
    return (trace_rays, 3) if options.batch else (_walk_packets if packets else _walk_ready, 1)


def _walk_ready(scene: WalkScene, ready: jax.Array, options: WalkOptions) -> Traced:
    return scene.walk_rays(ready, options)


def _walk_packets(scene: PacketScene, ready: jax.Array, options: WalkOptions) -> Traced:
    return scene.walk_packets(ready, options)


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


def stream_ready(
    scene: WalkScene,
    layout: Layout,
    rays: Rays,
    dropped: np.ndarray,
    mesh: Mesh,
    options: WalkOptions,
    packets: bool,
) -> Iterator[tuple[np.ndarray, tuple[np.ndarray, ...]]]:
    """Make rays ready on this side, and trace those that meet the scene: in packets, or each on its own.

    Args:
        scene: On the devices.
        layout: The same on this side.
        rays: Origins, directions and t_max.
        dropped: (r,) uint8, written, see `kernels.rays.ready_rays`.
        mesh: The CPU devices.
        options: What to compile in.
        packets: Put rays that go the same way into packets: of those of a picture, tile by tile.

    Yields:
        Which rays these are, int32, -1 for none, and their results.
    """
    count = len(rays[0])
    words = ROW + 3 * wants_way(options.test)
    single = _Pipe(scene, mesh, options, TILES, (count, words), ())
    if not packets:
        yield from _send_each(single, layout, rays, EVERY_RAY, dropped)
        yield from single.drain()
        return
    packed = _Pipe(scene, mesh, options, PACKET_TILES, (-(-count // PACKET), PACKET_ROW), (PACKET,))
    alone = np.zeros(min(TILES[-1], count) + PACKET, np.int32)
    seen = layout.seen_by_packets
    assert seen is not None
    width, begin = row_width(*rays[:2]), 0
    order = tile_order(count, width) if width else EVERY_RAY
    while begin < count:
        rows, at = packed.room()
        places = (rows, rows.view(np.int32), at, alone, dropped)
        live, left, begin = ready_packets(*rays, order, begin, seen.frame, seen.box, seen.density, *places)
        yield from packed.fill(live)
        if left:
            yield from _send_each(single, layout, rays, alone[:left], dropped)
    yield from packed.drain()
    yield from single.drain()


def _send_each(
    pipe: "_Pipe", layout: Layout, rays: Rays, which: np.ndarray, dropped: np.ndarray
) -> Iterator[tuple[np.ndarray, tuple[np.ndarray, ...]]]:
    """Send rays, each on its own."""
    seen = (tuple(layout.arrays.frame), *layout.root)
    for part in _in_order(layout, rays, which):
        begin, count = 0, len(part) or len(rays[0])
        while begin < count:
            rows, at = pipe.room()
            live, begin = ready_rays(*rays, part, begin, *seen, True, rows, rows.view(np.int32), at, dropped)
            yield from pipe.fill(live)


def _in_order(layout: Layout, rays: Rays, which: np.ndarray) -> Iterator[np.ndarray]:
    """Rays as they come; or where most jump about in a large scene, sorted, so that neighbours go alike."""
    low, finer = _cells_of(layout)
    if layout.nbytes < LEAST_SORTED or not start_apart(rays[0], which, finer):
        yield which
        return
    count = len(which) or len(rays[0])
    for first in range(0, count, SORTED):
        yield sort_rays(*rays[:2], which, first, min(first + SORTED, count), low, finer)


def _cells_of(layout: Layout) -> tuple[np.ndarray, np.float32]:
    """Where the cells begin that rays are sorted by, and how many there are in a unit of length."""
    frame, box = layout.arrays.frame, layout.root[0]
    corners = np.stack([np.nanmin(box[:3], axis=1), np.nanmax(box[3:6], axis=1)]).astype(np.float64)
    low, high = (corners * frame.unit + frame.low) / frame.scale
    extent = max((high - low).max(), CELLS * np.finfo(np.float32).tiny)
    return low.astype(np.float32), np.float32(CELLS / extent)


class _Buffers(NamedTuple):
    """Places for ready rows, and for which rays they are."""

    rows: np.ndarray
    at: np.ndarray


class _Pipe:
    """Rows on their way through the devices; results come in the order that rows were sent in.

    Args:
        scene: On the devices.
        mesh: The devices.
        options: What to compile in.
        sizes: Rows that a device takes at once.
        shape: Rows there are to be sent at the most, and words of a row.
        lanes: Rays of a row: () for one, or (32,).
    """

    def __init__(
        self,
        scene: WalkScene,
        mesh: Mesh,
        options: WalkOptions,
        sizes: tuple[int, ...],
        shape: tuple[int, int],
        lanes: tuple[int, ...],
    ) -> None:
        self._scene, self._mesh, self._sizes, self._lanes = scene, mesh, sizes, lanes
        self._compiled = program(mesh, options, bool(lanes))
        self._split = NamedSharding(mesh, RAYS)
        room = next((size for size in sizes if size * mesh.size >= shape[0]), sizes[-1])
        self._shape = room * mesh.size, shape[1]
        self._spare: list[_Buffers] = []
        self._filling: _Buffers | None = None
        self._filled = 0
        self._waiting: deque[tuple[int, int, Any, _Buffers]] = deque()

    def room(self) -> _Buffers:
        """The places that are not filled yet."""
        if self._filling is None:
            self._filling = self._spare.pop() if self._spare else self._new()
        return _Buffers(self._filling.rows[self._filled :], self._filling.at[self._filled :])

    def fill(self, live: int) -> Iterator[tuple[np.ndarray, tuple[np.ndarray, ...]]]:
        """Take the first `live` of them as filled; send all once they are, and yield what is done."""
        self._filled += live
        if self._filling is not None and self._filled == len(self._filling.rows):
            yield from self._send()

    def drain(self) -> Iterator[tuple[np.ndarray, tuple[np.ndarray, ...]]]:
        """Send what is left, and yield all that is on its way."""
        if self._filled:
            yield from self._send()
        while self._waiting:
            yield self._collect()

    def _new(self) -> _Buffers:
        rows = aligned_zeros(self._shape, np.float32)
        return _Buffers(rows, np.zeros((len(rows), *self._lanes), np.int32))

    def _send(self) -> Iterator[tuple[np.ndarray, tuple[np.ndarray, ...]]]:
        buffers, live = self._filling, self._filled
        assert buffers is not None
        self._filling, self._filled = None, 0
        _, per_device = next(tiles(live, self._mesh.size, self._sizes))
        with quiet_jax():
            shared = _shared_out(buffers.rows, live, self._mesh.size, per_device)
            traced = self._compiled(self._scene, jax.device_put(shared, self._split))
        self._waiting.append((live, per_device, traced, buffers))
        if len(self._waiting) >= READY_IN_FLIGHT:
            yield self._collect()

    def _collect(self) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        live, per_device, traced, buffers = self._waiting.popleft()
        results = _collect(slice(0, live), per_device, traced, self._mesh.size)[1]
        # Results are there, so nobody reads these rays any more.
        self._spare.append(buffers)
        if self._lanes:
            results = tuple(values.reshape(-1) for values in results)
        return buffers.at[:live].reshape(-1), results


def tiles(count: int, devices: int, sizes: tuple[int, ...]) -> Iterator[tuple[slice, int]]:
    """Cut `count` rays into runs, each with the rays a device has room for in the program it takes."""
    start = 0
    while start < count:
        share = -(-(count - start) // devices)
        room = next((size for size in sizes if size >= share), sizes[-1])
        stop = min(count, start + room * devices)
        yield slice(start, stop), room
        start = stop


def _shared_out(rows: np.ndarray, live: int, devices: int, room: int) -> np.ndarray:
    """What `_spread` gives of the first `live` rows, moved where they lie, which needs no new memory."""
    share = -(-live // devices)
    if live < devices * room:
        for k in reversed(range(devices)):
            mine = max(0, min(share, live - k * share))
            rows[k * room : k * room + mine] = rows[k * share : k * share + mine]
            rows[k * room + mine : (k + 1) * room] = 0
    return rows[: devices * room]


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


# Notes
#
# Two cores make 1.5 (a camera's packets) to 1.9 of one, both with all that is done beside the walk. Weighing
# hits in a thread of its own gave 1.1. Tried for more, and no gain: tiles of 2**13 to 2**15 rays or fewer
# packets, two to four of them in flight. On one core rays made ready 64 at a time gave 1.15 (occlusion rays),
# packets over whole registers 1.1, hits weighed with leaves touched beforehand 1.05, fetched while others are
# weighed 1.03 more (a camera's 1.05).
#
# Rays sorted, one core, rates of closest / any hits. Shuffled occlusion rays: terrain of 276,000 triangles
# 1.3 / 1.3, dragon 1.3 / 1.3, 3.5 M triangles 1.6 / 1.7. Random rays: 1.02 / 1.14, 1.05 / 1.0, 1.1 / 1.1; a
# power plant 1.3 / 1.1. Bunny (5 MB) 0.7 / 0.75, since rays taken here and there cost 20 to 40 ns. Runs of
# 2**18 gain less, 2**20 no more. Occlusion rays as a camera's tiles give them walk 1.05 / 1.03 times as fast,
# and lose that beside the walk. Cells alone, in place of cells and octants: as good; octants first 1.0;
# octants and dominant axes no better.
#
# Tried for packets and lost: tiles of 2**9 to 2**13 of them 0.99 to 1.0. A program in which the rays of a
# packet start at one point, read once: 1.01 to 1.02, not worth a program more.
