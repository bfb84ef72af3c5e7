"""Triangles without strips: a table of vertices and three of them a triangle, for what orders them itself.

The layout and its reasons are in formats/reducem/SPEC.md, section 4.13.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from striptools.reducem import layout
from striptools.reducem.blocks import Decoded
from striptools.reducem.issues import unreadable
from striptools.types import Counts, Faces, Positions

__all__ = ["PlainTriangles", "check_triangles", "decode_triangles", "encode_triangles", "first_use"]


@dataclass(frozen=True, eq=False)
class PlainTriangles:
    """The section TRIS.

    Attributes:
        positions: (v, 3) float32, the vertices in the order of their first use.
        faces: (n, 3) int32, places in `positions`.
    """

    positions: Positions
    faces: Faces

    @property
    def count(self) -> int:
        """How many triangles there are."""
        return len(self.faces)

    @property
    def nbytes(self) -> int:
        """Bytes in the file."""
        return self.positions.nbytes + self.faces.nbytes

    @property
    def decoded(self) -> Decoded:
        """The same as strips of one triangle, all of them in one block."""
        n = self.count
        return Decoded(
            positions=self.positions,
            vertex_starts=np.array([0, len(self.positions)], np.int32),
            vertices=self.faces.reshape(-1),
            turns=np.zeros(n, np.bool_),
            flips=None,
            starts=np.arange(n + 1, dtype=np.int32),
            block_starts=np.array([0, n], np.int32),
        )


def first_use(faces: Faces) -> tuple[Faces, Counts]:
    """Number vertices in the order of their first use.

    Args:
        faces: (n, 3) int32.

    Returns:
        The faces by their new numbers, and the old number of each vertex that is used.
    """
    flat = faces.reshape(-1)
    first = np.full(int(flat.max(initial=-1)) + 1, len(flat), np.int64)
    np.minimum.at(first, flat, np.arange(len(flat)))
    used = np.argsort(first, kind="stable")[: int((first < len(flat)).sum())].astype(np.int32)
    number = np.zeros(len(first), np.int32)
    number[used] = np.arange(len(used), dtype=np.int32)
    return number[faces], used


def encode_triangles(triangles: PlainTriangles | None) -> bytes:
    """The section of plain triangles; no bytes where there are none."""
    if triangles is None:
        return b""
    return triangles.positions.astype("<f4").tobytes() + triangles.faces.astype("<u4").tobytes()


def decode_triangles(raw: np.ndarray, count: int, where: str) -> PlainTriangles:
    """The triangles of a section.

    Args:
        raw: The bytes of the section, uint8.
        count: How many triangles the scene has; the section is long enough for them.
        where: What an error names as its place.

    Raises:
        UnreadableSceneError: The section breaks a rule.
    """
    if len(raw) % 12:
        raise unreadable("RDM114", f"{where}: TRIS")
    middle = len(raw) - 12 * count
    positions = raw[:middle].view("<f4").astype(np.float32, copy=False).reshape(-1, 3)
    faces = raw[middle:].view("<u4").astype(np.uint32, copy=False).view(np.int32).reshape(-1, 3)
    triangles = PlainTriangles(positions, faces)
    check_triangles(triangles, where)
    return triangles


def check_triangles(triangles: PlainTriangles, where: str) -> None:
    """Make sure that plain triangles keep the rules of the format.

    Raises:
        UnreadableSceneError: They do not.
    """
    place, faces, vertices = f"{where}: TRIS", triangles.faces, len(triangles.positions)
    least, most = layout.triangle_lengths(len(faces))
    if not least <= 12 * (vertices + len(faces)) <= most:
        raise unreadable("RDM114", place)
    outside = ((faces < 0) | (faces >= vertices)).any(axis=1)
    if outside.any():
        raise unreadable("RDM571", f"{place}: triangle {np.flatnonzero(outside)[0]}")
    flat = faces.reshape(-1)
    before = np.append(np.int32(-1), np.maximum.accumulate(flat)[:-1])
    early = np.flatnonzero(flat > before + 1)
    if len(early):
        raise unreadable("RDM572", f"{place}: triangle {early[0] // 3}")
    if int(flat.max(initial=-1)) + 1 != vertices:
        raise unreadable("RDM573", place)
    twice = (faces == np.roll(faces, 1, axis=1)).any(axis=1)
    if twice.any():
        raise unreadable("RDM574", f"{place}: triangle {np.flatnonzero(twice)[0]}")
    infinite = ~np.isfinite(triangles.positions).all(axis=1)
    if infinite.any():
        raise unreadable("RDM575", f"{place}: vertex {np.flatnonzero(infinite)[0]}")
