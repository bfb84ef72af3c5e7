"""Rays that this side makes ready, streamed through CPU devices: a core for each share of them.

A thread for each device takes a run of rays, makes them ready, has them walked, takes what was found, and so
on until no run is left: none waits for another, and one whose core has other work does less. Runs get shorter
towards the end, so that all end together (guided self-scheduling: Polychronopoulos & Kuck 1987). One program
for all devices would be as good a way to share out the walk, but it ends when the last of them does, and work
on this side makes one of them late: two cores were busy 1.6 to 1.7 times as much as one so.
"""

from collections import deque
from collections.abc import Callable, Iterator
from itertools import pairwise
from threading import Event
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh

from striptools.kernels.packets import PACKET, go_together, ready_packets
from striptools.kernels.packets import ROW as PACKET_ROW
from striptools.kernels.pictures import row_width, tile_order
from striptools.kernels.ray_order import CELLS, sort_rays, start_apart
from striptools.kernels.rays import ROW, ready_rays, room_of
from striptools.threads import at_once
from striptools.trace.device import quiet_jax
from striptools.trace.launch import TILES, device_mesh, program
from striptools.trace.layout import Layout, Rays
from striptools.trace.leaves import aligned
from striptools.trace.triangle_tests import wants_way
from striptools.trace.walk import WalkOptions, WalkScene

PACKET_TILES = (2**3, 2**7, 2**12)
"""Packets that a device takes at once."""

MANY = 2**13
"""Rays for each device for which it is worth while to start a thread: fewer go through the first alone."""

SHARES = 2
"""Runs for each device, at least, into which rays that are left are cut; of packets half as many."""

SHORTEST = 8
"""Of a tile, the part that the shortest runs are: a tile not full costs as much beside its walk."""

IN_FLIGHT = 2
"""Tiles that a device works on or waits for: more only push each other's rays out of the cache."""

LEAST_SORTED = 2**25
"""Bytes of a scene for which rays are sorted: one in the caches is read as fast in any order."""

SORTED = 2**19
"""Rays that are sorted together."""

EVERY_RAY = np.zeros(0, np.int32)

Take = Callable[[np.ndarray, tuple[np.ndarray, ...]], None]
"""Takes what was found: which rays, int32, -1 for none, and their results as of `walk.Traced`, to be used at
once. Threads call it side by side, each of rays of its own."""


class Station(NamedTuple):
    """A device, and the scene on it."""

    mesh: Mesh
    scene: WalkScene


def stations_of(scene: WalkScene, mesh: Mesh) -> list[Station]:
    """Each device of a mesh on its own, where the scene is on all of them."""

    def on(device: jax.Device) -> WalkScene:
        def mine(array: jax.Array) -> jax.Array:
            return next(shard.data for shard in array.addressable_shards if shard.device == device)

        return jax.tree.map(mine, scene)

    return [Station(device_mesh([device]), on(device)) for device in mesh.devices.flat]


def trace_ready(
    stations: list[Station],
    layout: Layout,
    rays: Rays,
    dropped: np.ndarray,
    options: WalkOptions,
    packets: bool,
    take: Take,
) -> None:
    """Make rays ready on this side, and trace those that meet the scene: in packets, or each on its own.

    Args:
        stations: The CPU devices.
        layout: The scene on this side.
        rays: Origins, directions and t_max.
        dropped: (r,) uint8, written, see `kernels.rays.ready_rays`.
        options: What to compile in.
        packets: Put rays that go the same way into packets, where many do; of a picture, tile by tile.
        take: Takes what was found.
    """
    count = len(rays[0])
    width = row_width(*rays[:2]) if packets else 0
    order = tile_order(count, width) if width else EVERY_RAY
    packets = packets and go_together(rays[1], order)
    cells = _cells_of(layout) if layout.nbytes >= LEAST_SORTED else None
    hands = stations[: max(1, min(len(stations), count // MANY))]

    with quiet_jax():
        if not packets:
            order = _sorted(rays, order, cells, len(hands))
        runs = _Runs(count, order, len(hands), packets)

        def trace(hand: int, stopped: Event) -> None:
            course = _Course(hands[hand], layout, cells, rays, runs, dropped, options)
            for found in course.packets() if packets else course.singles():
                if stopped.is_set():
                    return
                take(*found)

        at_once(trace, len(hands))


class _Cells(NamedTuple):
    """What rays are sorted by: where cells begin, (3,) float32, and how many are in a unit of length."""

    low: np.ndarray
    finer: np.float32


def _cells_of(layout: Layout) -> _Cells:
    """Those of a scene, whose bounds are those of its root."""
    frame, box = layout.arrays.frame, layout.root[0]
    corners = np.stack([np.nanmin(box[:3], axis=1), np.nanmax(box[3:6], axis=1)]).astype(np.float64)
    low, high = (corners * frame.unit + frame.low) / frame.scale
    extent = max((high - low).max(), CELLS * np.finfo(np.float32).tiny)
    return _Cells(low.astype(np.float32), np.float32(CELLS / extent))


def _sorted(rays: Rays, which: np.ndarray, cells: _Cells | None, threads: int) -> np.ndarray:
    """Rays as they come; where most jump about in a large scene, sorted, so that neighbours go alike."""
    if cells is None or not start_apart(rays[0], which, cells.finer):
        return which
    count = len(which) or len(rays[0])
    parts = -(-count // (SORTED * threads)) * threads
    bounds = [count * k // parts for k in range(parts + 1)]
    order = np.zeros(count, np.int32)

    def sort(hand: int, _: Event) -> None:
        for begin, end in list(pairwise(bounds))[hand::threads]:
            order[begin:end] = sort_rays(*rays[:2], which, begin, end, *cells)

    at_once(sort, threads)
    return order


class _Runs:
    """Rays in runs that several threads take from, one after the other; for one thread they are one run.

    Args:
        count: Rays there are.
        order: (count,) int32, the rays; (0,) for all as they come.
        hands: Threads that take.
        packets: Whether runs are for packets.
    """

    def __init__(self, count: int, order: np.ndarray, hands: int, packets: bool) -> None:
        self._order, self._count, shares = order, count, (1 if packets else SHARES) * hands
        longest = PACKET * PACKET_TILES[-1] if packets else TILES[-1]
        shortest = min(longest // SHORTEST, -(-count // hands))
        self._waiting: deque[tuple[int, int]] = deque()
        begin = 0
        while begin < count:
            share = (count - begin) // shares
            end = begin + _whole(max(shortest, min(share, longest))) if hands > 1 else count
            self._waiting.append((begin, min(count, end)))
            begin = end

    def __iter__(self) -> Iterator[np.ndarray]:
        while True:
            # Another thread may take the last at any time: who finds nothing left is done.
            try:
                run = self._waiting.popleft()
            except IndexError:
                return
            yield self._rays(*run)

    def _rays(self, begin: int, end: int) -> np.ndarray:
        if end - begin == self._count:
            return self._order
        return self._order[begin:end] if len(self._order) else np.arange(begin, end, dtype=np.int32)


def _whole(count: int) -> int:
    """So many rays, or a few more: packets are whole."""
    return -(-count // PACKET) * PACKET


Parts = Iterator[tuple[np.ndarray, tuple[np.ndarray, ...]]]
"""What a `Take` takes."""


class _Course(NamedTuple):
    """The way of rays through one device.

    Attributes:
        station: The device.
        layout: The scene on this side.
        cells: By which rays are sorted that go on their own after all; None for a scene for which none are.
        rays: All there are.
        runs: Those that are still to be taken.
        dropped: As of `trace_ready`, and so is what follows.
        options: What to compile in.
    """

    station: Station
    layout: Layout
    cells: _Cells | None
    rays: Rays
    runs: _Runs
    dropped: np.ndarray
    options: WalkOptions

    def singles(self) -> Parts:
        """Trace each ray on its own."""
        pipe = self._single_pipe()
        for which in self.runs:
            yield from self._send_each(pipe, which)
            yield from pipe.flush()
        yield from pipe.drain()

    def packets(self) -> Parts:
        """Trace rays in packets, those that go the same way."""
        single, count = self._single_pipe(), len(self.rays[0])
        shape = (-(-count // PACKET), PACKET_ROW)
        packed = _Pipe(self.station, self.options, PACKET_TILES, shape, (PACKET,))
        alone = np.zeros(min(TILES[-1], count) + PACKET, np.int32)
        seen = self.layout.seen_by_packets
        assert seen is not None
        given = (seen.frame, seen.box, seen.density)
        for which in self.runs:
            begin, end = 0, len(which) or count
            while begin < end:
                rows, at = packed.room()
                places = (rows, rows.view(np.int32), at, alone, self.dropped)
                live, left, begin = ready_packets(*self.rays, which, begin, *given, *places)
                yield from packed.fill(live)
                if left:
                    yield from self._send_each(single, _sorted(self.rays, alone[:left], self.cells, 1))
            yield from packed.flush()
            yield from single.flush(TILES[-1] // SHORTEST)
        yield from packed.drain()
        yield from single.drain()

    def _single_pipe(self) -> "_Pipe":
        words = ROW + 3 * wants_way(self.options.test)
        return _Pipe(self.station, self.options, TILES, (len(self.rays[0]), words), ())

    def _send_each(self, pipe: "_Pipe", which: np.ndarray) -> Parts:
        """Send rays, each on its own."""
        seen = (tuple(self.layout.arrays.frame), *self.layout.root)
        begin, end = 0, len(which) or len(self.rays[0])
        while begin < end:
            rows, at = pipe.room()
            places = (rows, rows.view(np.int32), at, self.dropped)
            live, begin = ready_rays(*self.rays, which, begin, *seen, True, *places)
            yield from pipe.fill(live)


class _Buffers(NamedTuple):
    """Places for ready rows, and for which rays they are."""

    rows: np.ndarray
    at: np.ndarray


class _Pipe:
    """Rows on their way through a device; results come in the order that rows were sent in.

    Args:
        station: The device.
        options: What to compile in.
        sizes: Rows that the device takes at once.
        shape: Rows there are to be sent at the most, and words of a row.
        lanes: Rays of a row: () for one, or (32,).
    """

    def __init__(
        self,
        station: Station,
        options: WalkOptions,
        sizes: tuple[int, ...],
        shape: tuple[int, int],
        lanes: tuple[int, ...],
    ) -> None:
        self._scene, self._sizes, self._lanes = station.scene, sizes, lanes
        self._compiled, self._together = program(station.mesh, options, bool(lanes)), options.interleave
        self._shape = next((size for size in sizes if size >= shape[0]), sizes[-1]), shape[1]
        self._spare: list[_Buffers] = []
        self._filling: _Buffers | None = None
        self._filled = 0
        self._waiting: deque[tuple[int, Any, _Buffers]] = deque()

    def room(self) -> _Buffers:
        """The places that are not filled yet."""
        if self._filling is None:
            self._filling = self._spare.pop() if self._spare else self._new()
        return _Buffers(self._filling.rows[self._filled :], self._filling.at[self._filled :])

    def fill(self, live: int) -> Parts:
        """Take the first `live` of them as filled; send all once they are, and yield what is done."""
        self._filled += live
        if self._filling is not None and self._filled == len(self._filling.rows):
            yield from self._send()

    def flush(self, most: int = 0) -> Parts:
        """Send what is filled where it is more than so many."""
        if self._filled > most:
            yield from self._send()

    def drain(self) -> Parts:
        """Send what is left, and yield all that is on its way."""
        yield from self.flush()
        while self._waiting:
            yield self._collect()

    def _new(self) -> _Buffers:
        # What is not filled is never read.
        rows = aligned(room_of, self._shape, np.float32)
        return _Buffers(rows, np.zeros((len(rows), *self._lanes), np.int32))

    def _send(self) -> Parts:
        buffers, live = self._filling, self._filled
        assert buffers is not None
        self._filling, self._filled = None, 0
        rows = buffers.rows[: next(size for size in self._sizes if size >= live)]
        # The last ray may be walked beside one more: a row of zeros ends at once.
        rows[live : live + self._together] = 0
        # As they are: to put them on the device, where they lie already, takes longer than the call.
        traced = self._compiled(self._scene, rows, np.array([live], np.int32))
        self._waiting.append((live, traced, buffers))
        if len(self._waiting) >= IN_FLIGHT:
            yield self._collect()

    def _collect(self) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        live, traced, buffers = self._waiting.popleft()
        results = tuple(np.asarray(values)[:live] for values in traced)
        # Results are there, so nobody reads these rays any more.
        self._spare.append(buffers)
        if self._lanes:
            results = tuple(values.reshape(-1) for values in results)
        return buffers.at[:live].reshape(-1), results


# Notes
#
# Two cores over one, all that is done beside the walk counted (camera in packets, one by one, occlusion):
# 1.72, 1.74, 1.9. One program for both devices, with a thread beside it that weighs: 1.6, 1.7, 1.8. That
# program over rays dealt out, and all cores at each step in turn (rays made ready, walked, weighed): 1.15
# to 1.45, 1.75. What is left for a camera is memory taken and pictures looked at by one core (1 ms of 35),
# and 5 to 10 % more time of the processor, as the two share a cache. Two threads on one device scale as
# well as two devices, by a program that is compiled once; devices compile theirs side by side in the same
# time. Tiles of 2**14 and 2**15 rays, and three in flight: within 3 %.
#
# Runs taken by who is free, over blocks dealt out turn by turn, two cores that others use too (medians): one
# by one 1.03 to 1.15, occlusion 1.04 to 1.18, random rays 1.0, packets 0.97 to 1.05; where nobody else was
# there 0.98 to 1.03. Three shares a device and six 0.99 to 1.0 of two; of packets two shares 0.95 of one, as
# what XLA fills for a tile costs the same however few are in it.
#
# On one core rays made ready 64 at a time gave 1.15 (occlusion rays), packets over whole registers 1.1,
# hits weighed with leaves touched beforehand 1.05, fetched while others are weighed 1.03 more (a camera's
# 1.05).
#
# Rays sorted, one core, rates of closest / any hits (`bench_order`; machines differ, by 0.2 on another
# hour). Shuffled occlusion rays: dragon 1.2 / 1.2, 3.5 M triangles 1.4 / 1.3, power plant 1.1 / 1.1. Random
# rays: 0.97 / 0.99, 1.03 / 1.01, 1.3 / 1.1. A terrain of 276,000 triangles, 20 MB: shuffled 1.2, random
# 0.95; the bunny, 5 MB: 0.98, 0.85, since rays taken here and there cost 20 to 40 ns. Runs of 2**18 gain
# less, 2**20 no more. Occlusion rays as a camera's tiles give them walk 1.05 / 1.03 times as fast, and lose
# that beside the walk. Cells alone, in place of cells and octants: as good; octants first 1.0; octants and
# dominant axes no better.
#
# Tiles of 2**12 packets: 0.98 (bunny) to 1.05 (3.5 M triangles) times as fast as of 2**11, 2**9 0.87 to
# 0.99, 2**15 0.95 to 1.03. Rows given to the program as they are, not put on the device before, 1.04 to
# 1.08 for a camera. A program in which the rays of a packet start at one point, read once: 1.01 to 1.02,
# not worth a program more.
#
# What one core does beside the walk (a 16-wide root, ns a ray; whole calls on that hour 290, 750, 150 and
# 215): occlusion on the bunny 74, on the dragon 115, a camera on the dragon 52, compressed 70. Of a ray on
# its own 40 to 55 are for making it ready, where the kernel alone takes 30: the rest waits for the rows that
# it writes, 96 bytes each. Tiles of 2**14 rays, which lie in the cache, 0.96 to 0.98 all the same, of 2**13
# 0.95. No gain: a t_max for all kept once, results filled by bytes. Room for rows not zeroed saves 4 to 5.
# Of a packet's loop 4 ns a ray go to buffers that XLA fills before a scan writes them, as `lax.empty` does.
#
# Not worth it (bunny, dragon; a machine with other work). Ready rays in chunks of 64, a row a word, so that
# they are written whole registers at a time: 0.9 to 1.0, as what a row costs is the way through memory, not
# the writing. Rays made ready in the walk's own program, 64 at a time, with no rows at all (a third less code
# on this side; lanes with something to visit are bits of one number): the same hits, 0.98 to 1.03, and a
# second more to compile, as XLA unrolls each of 24 loops of 64. Programs called synchronously (no thread is
# woken) with tiles of 2**13 to 2**15 rays, or of 2**16: 0.92 to 1.0, 1.0. A call takes 30 to 110 us, and one
# with 2**13 rays 2 ms.
