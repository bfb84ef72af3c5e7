"""Rays that this side makes ready, streamed through CPU devices: a core for each share of them.

Every step is done by all cores at once: each makes rays of its own ready, walks them, and weighs hits. The
devices walk one program together, and it ends when the last of them does; so rays are dealt out in small
blocks, turn by turn, that all have like work.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding

from striptools.kernels.packets import PACKET, ready_packets
from striptools.kernels.packets import ROW as PACKET_ROW
from striptools.kernels.pictures import row_width, tile_order
from striptools.kernels.ray_order import CELLS, deal, sort_rays, start_apart
from striptools.kernels.rays import ROW, ready_rays
from striptools.threads import Crew
from striptools.trace.device import quiet_jax
from striptools.trace.launch import RAYS, TILES, program
from striptools.trace.layout import Layout, Rays
from striptools.trace.leaves import aligned_zeros
from striptools.trace.triangle_tests import wants_way
from striptools.trace.walk import WalkOptions, WalkScene

PACKET_TILES = (2**3, 2**7, 2**11)
"""Packets that a device takes at once."""

BLOCKS = (PACKET, 2**10)
"""Rays of a block that is dealt out, at least and at most: whole packets."""

TURNS = 8
"""How often each device is dealt a block, at least, where blocks can be as small."""

IN_FLIGHT = 2
"""Tiles that devices work on or wait for: more only push each other's rays out of the cache."""

LEAST_SORTED = 2**24
"""Bytes of a scene for which rays are sorted: one in a core's own caches is read as fast in any order."""

SORTED = 2**19
"""Rays that are sorted together."""

EVERY_RAY = np.zeros(0, np.int32)

Traced = Iterator[tuple[np.ndarray, tuple[np.ndarray, ...]]]
"""Which rays are done, int32, -1 for none, and their results, as of `walk.Traced`."""


def stream_ready(
    scene: WalkScene,
    layout: Layout,
    rays: Rays,
    dropped: np.ndarray,
    mesh: Mesh,
    options: WalkOptions,
    packets: bool,
    crew: Crew,
) -> Traced:
    """Make rays ready on this side, and trace those that meet the scene: in packets, or each on its own.

    Args:
        scene: On the devices.
        layout: The same on this side.
        rays: Origins, directions and t_max.
        dropped: (r,) uint8, written, see `kernels.rays.ready_rays`.
        mesh: The CPU devices.
        options: What to compile in.
        packets: Put rays that go the same way into packets: of those of a picture, tile by tile.
        crew: Who makes rays ready.

    Yields:
        Which rays these are, int32, -1 for none, and their results: to be used before the next.
    """
    count = len(rays[0])
    words = ROW + 3 * wants_way(options.test)
    single = _Pipe(scene, mesh, options, TILES, (count, words), ())
    if not packets:
        yield from _send_each(single, layout, rays, EVERY_RAY, dropped, crew)
        yield from single.drain()
        return
    packed = _Pipe(scene, mesh, options, PACKET_TILES, (-(-count // PACKET), PACKET_ROW), (PACKET,))
    for alone in _send_packets(packed, layout, rays, dropped, crew):
        yield from packed.results()
        if len(alone):
            yield from _send_each(single, layout, rays, alone, dropped, crew)
    yield from packed.drain()
    yield from single.drain()


def _send_packets(
    pipe: "_Pipe", layout: Layout, rays: Rays, dropped: np.ndarray, crew: Crew
) -> Iterator[np.ndarray]:
    """Send packets; yield now and then the rays, int32, that are to go each on its own."""
    seen = layout.seen_by_packets
    assert seen is not None
    count, devices = len(rays[0]), pipe.devices
    width = row_width(*rays[:2])
    hands = _dealt(tile_order(count, width) if width else EVERY_RAY, count, devices, crew)
    # A packet more than is ever full.
    room = min(TILES[-1], max(hand.count for hand in hands)) + PACKET
    single = np.zeros((devices, room), np.int32)

    def fill(device: int) -> int:
        hand, (rows, at) = hands[device], rooms[device]
        given = (*rays, hand.which, hand.begin, seen.frame, seen.box, seen.density)
        places = (rows, rows.view(np.int32), at, single[device], dropped)
        live[device], left, hand.begin = ready_packets(*given, *places)
        return left

    while waiting := [device for device in range(devices) if hands[device].left]:
        rooms, live = pipe.rooms(), [0] * devices
        left = crew.each(fill, waiting)
        pipe.fill(live)
        yield np.concatenate([single[device, :some] for device, some in zip(waiting, left, strict=True)])


def _send_each(
    pipe: "_Pipe", layout: Layout, rays: Rays, which: np.ndarray, dropped: np.ndarray, crew: Crew
) -> Traced:
    """Send rays, each on its own."""
    seen = (tuple(layout.arrays.frame), *layout.root)

    def fill(device: int) -> None:
        hand, (rows, at) = hands[device], rooms[device]
        given = (*rays, hand.which, hand.begin, *seen, True, rows, rows.view(np.int32), at, dropped)
        live[device], hand.begin = ready_rays(*given)

    for part in _in_order(layout, rays, which):
        hands = _dealt(part, len(part) or len(rays[0]), pipe.devices, crew)
        while waiting := [device for device, hand in enumerate(hands) if hand.left]:
            rooms, live = pipe.rooms(), [0] * pipe.devices
            crew.each(fill, waiting)
            pipe.fill(live)
            yield from pipe.results()


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


@dataclass
class _Hand:
    """The rays that a device is dealt: int32, (0,) for all there are; how many; and the first not taken."""

    which: np.ndarray
    count: int
    begin: int = 0

    @property
    def left(self) -> bool:
        """Whether there are any that were not taken."""
        return self.begin < self.count


def _dealt(which: np.ndarray, count: int, devices: int, crew: Crew) -> list[_Hand]:
    """Deal rays out, in blocks, turn by turn."""
    if devices == 1:
        return [_Hand(which, count)]
    block = BLOCKS[0]
    while block < BLOCKS[1] and 2 * block * devices * TURNS <= count:
        block *= 2
    dealt = crew.each(lambda device: deal(which, count, device, devices, block), range(devices))
    return [_Hand(hand, len(hand)) for hand in dealt]


class _Buffers(NamedTuple):
    """Places for ready rows, and for which rays they are."""

    rows: np.ndarray
    at: np.ndarray


class _Tile(NamedTuple):
    """A tile on its way: how many rows each device has, of how many places, in which buffers; and results."""

    live: list[int]
    places: int
    buffers: _Buffers
    traced: Any


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
        self.devices = mesh.size
        self._scene, self._sizes, self._lanes = scene, sizes, lanes
        self._compiled = program(mesh, options, bool(lanes))
        self._split = NamedSharding(mesh, RAYS)
        most = -(-shape[0] // mesh.size) + (BLOCKS[1] if mesh.size > 1 else 0)
        self._room = next((size for size in sizes if size >= most), sizes[-1])
        self._words = shape[1]
        self._spare: list[_Buffers] = []
        self._filling: _Buffers | None = None
        self._filled = [0] * mesh.size
        self._waiting: deque[_Tile] = deque()

    def rooms(self) -> list[_Buffers]:
        """Of each device the places that are not filled yet."""
        if self._filling is None:
            self._filling = self._spare.pop() if self._spare else self._new()
        buffers, ends = self._filling, range(self._room, (self.devices + 1) * self._room, self._room)
        places = [slice(end - self._room + full, end) for end, full in zip(ends, self._filled, strict=True)]
        return [_Buffers(buffers.rows[place], buffers.at[place]) for place in places]

    def fill(self, live: list[int]) -> None:
        """Take the first so many places of each device as filled; send all once those of one are full."""
        self._filled = [before + more for before, more in zip(self._filled, live, strict=True)]
        if max(self._filled) == self._room:
            self._send()

    def results(self) -> Traced:
        """Yield what more tiles than may be on their way have found."""
        while len(self._waiting) >= IN_FLIGHT:
            yield self._collect()

    def drain(self) -> Traced:
        """Send what is left, and yield all that is on its way."""
        if any(self._filled):
            self._send()
        while self._waiting:
            yield self._collect()

    def _new(self) -> _Buffers:
        rows = aligned_zeros((self.devices * self._room, self._words), np.float32)
        return _Buffers(rows, np.zeros((len(rows), *self._lanes), np.int32))

    def _send(self) -> None:
        buffers, live = self._filling, self._filled
        assert buffers is not None
        self._filling, self._filled = None, [0] * self.devices
        places = next(size for size in self._sizes if size >= max(live))
        rows = moved_together(buffers.rows, live, self._room, places)
        moved_together(buffers.at, live, self._room, places)
        for device, some in enumerate(live):
            # Rows of zeros end at once.
            rows[device * places + some : (device + 1) * places] = 0
        with quiet_jax():
            traced = self._compiled(self._scene, jax.device_put(rows, self._split))
        self._waiting.append(_Tile(live, places, buffers, traced))

    def _collect(self) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        live, places, buffers, traced = self._waiting.popleft()
        results = tuple(kept(np.asarray(values), live, places) for values in traced)
        at = kept(buffers.at[: places * self.devices], live, places).reshape(-1)
        # Results are there, so nobody reads these rays any more.
        self._spare.append(buffers)
        return at, tuple(values.reshape(-1) for values in results) if self._lanes else results


def kept(values: np.ndarray, live: list[int], places: int) -> np.ndarray:
    """What there is of the rows of each device, which are `places` apart; of nothing nothing."""
    if len(values) == 0 or min(live) == places:
        return values
    parts = [values[k * places : k * places + some] for k, some in enumerate(live)]
    return parts[0] if len(parts) == 1 else np.concatenate(parts)


def moved_together(rows: np.ndarray, live: list[int], room: int, places: int) -> np.ndarray:
    """Rows of all devices, each device's `room` apart, moved where they lie to be `places` apart."""
    if places < room:
        for device, some in enumerate(live):
            rows[device * places : device * places + some] = rows[device * room : device * room + some]
    return rows[: len(live) * places]


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
