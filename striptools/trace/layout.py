"""What a tracer needs of a scene laid out for a walk, expanded or packed."""

from collections.abc import Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np

from striptools.trace.counters import Counters
from striptools.trace.walk import WIDTH, Decode, Frame

Rays = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Origins (r, 3), directions (r, 3) and t_max (r,), float32."""

Found = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""T, face, u, v and triangle of all rays, to be filled; u and v are (0,) where they are not wanted."""

PACKET_MARGIN = np.float32(2**-19)
"""Widening of a box in units of the largest coordinate: `walk_packets`, Boxes."""

MOST_TRIANGLES = 800
"""Triangles that a packet is expected to meet, if they lie evenly, beyond which its rays go on their own."""


class PacketView(NamedTuple):
    """What `kernels.packets.ready_packets` must know of a scene.

    Attributes:
        frame: Scale, reach and the margin of boxes.
        box: (6,) float32, the scaled box of the scene.
        density: The share of the scene's area that a packet may cover.
    """

    frame: tuple[np.float32, np.float32, np.float32]
    box: np.ndarray
    density: np.float32


def packet_view(frame: Frame, box: np.ndarray, triangles: int) -> PacketView:
    """What packets are readied by in a scene of so many triangles."""
    density = np.float32(MOST_TRIANGLES / (4 * max(1, triangles)))
    return PacketView((frame.scale, frame.reach, PACKET_MARGIN), box, density)


class Layout(Protocol):
    """A scene laid out."""

    @property
    def arrays(self) -> Any:
        """For the device, as NumPy arrays: a `walk.WalkScene`."""
        ...

    @property
    def depth(self) -> int:
        """The most nodes on a way from the root down."""
        ...

    @property
    def decode(self) -> Decode | None:
        """How leaves are decoded, where they are packed."""
        ...

    @property
    def root(self) -> tuple[np.ndarray, np.ndarray]:
        """(>= 6, 8) float32 boxes of the root's children, NaN where is none, and (8,) int32 children."""
        ...

    @property
    def seen_by_packets(self) -> PacketView | None:
        """What packets are readied by; None where rays are not walked in packets."""
        ...

    @property
    def missed(self) -> Counters:
        """What a ray that meets none of the root's children counts."""
        ...

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays, once where two share them."""
        ...

    @property
    def shared_bytes(self) -> int:
        """Bytes that two arrays share here, which a GPU keeps twice."""
        ...

    def weigh(self, rays: Rays, at: np.ndarray, traced: tuple[np.ndarray, ...], found: Found) -> None:
        """Fill in what was found of the rays `at`."""
        ...

    def corners_of(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Corners of what a walk names, (k, 3, 3) float32, scaled, in the order of the tests; and turns.

        A row an axis, a column a corner; corner j is the reported face's (j + turn) % 3.
        """
        ...

    def named(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Faces and triangles (k,) of what a walk names, and turns: corner j is the face's (j + turn) % 3."""
        ...

    def names(self) -> np.ndarray:
        """(n,) int32: what a walk names each triangle in file order."""
        ...

    def corner_blocks(self, most: int) -> Iterator[np.ndarray]:
        """All triangles where they stand, in blocks of eight, `most` at a time: (l, 9, 8) float32, scaled.

        X of corners a, b and c, then y, then z; not a number in empty lanes.
        """
        ...


def blocks_of(corners: np.ndarray) -> np.ndarray:
    """Corners (k, 3, 3), a row an axis, in blocks of eight lanes: (l, 9, 8), not a number in those left."""
    count = -(-len(corners) // WIDTH)
    lanes = np.full((count * WIDTH, 9), np.nan, np.float32)
    lanes[: len(corners)] = corners.reshape(-1, 9)
    return np.ascontiguousarray(lanes.reshape(count, WIDTH, 9).transpose(0, 2, 1))
