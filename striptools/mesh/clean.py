"""Make a loaded mesh fit for what follows: float32, welded, every face of positive area, every loss counted.

The order of the work, which decides what a face is counted under:

1. Positions are rounded to float32 (to nearest); the largest rounding is reported. A value beyond float32's
   range becomes infinite. float64 positions far from zero, as surveys and CAD have them, are first moved to
   an origin of their own (recentre.py), where that leaves them much closer to what they were; float32
   positions never are.
2. Vertices are welded. By default those whose three words are equal BIT FOR BIT: so -0.0 and +0.0 stay apart,
   because positions have to come back bit-exact, and a seam of mixed zeros stays a seam. With a tolerance
   each vertex, by ascending index, moves to the nearest vertex before it that was not itself moved and lies
   within the tolerance. So welding is not transitive (a chain of close vertices does not collapse into one),
   no vertex moves farther than the tolerance, and the first vertex of a cluster keeps its position; -0.0 and
   +0.0 are then one.
3. Faces are dropped, each counted under the first reason that holds: `non_finite`, a corner is NaN or
   infinite; `repeated_vertex`, two corners are one vertex; `zero_area`, the float32 corners lie on one line
   exactly; `duplicate_faces_dropped`, only where asked, an earlier face has the same vertices in the same
   winding.
4. Vertices that no kept face uses are dropped. What is left keeps its order, faces and vertices alike, and
   each face its first corner.
5. Attributes follow their corners: a welded vertex may carry several normals, which then stand at the corners
   (attributes.py).

Zero area is decided exactly: float64 with an error bound first (kernels/degenerate.py); then, for the
doubtful faces, float64 once more where every difference and product is exact in it; then integers.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from striptools.errors import UsageError
from striptools.mesh.attributes import Attribute, Domain, follow
from striptools.mesh.instances import Geometries
from striptools.mesh.mesh import Mesh
from striptools.mesh.recentre import Origin, recentred
from striptools.threads import in_chunks, in_parts
from striptools.types import FaceIds, Faces, Positions, SourcePositions

CHUNK = 1 << 16
"""Rows handled at a time where temporary arrays would otherwise be as large as the mesh."""


Recentring = Literal["auto", "never"]
RECENTRINGS: tuple[Recentring, ...] = get_args(Recentring)


@dataclass(frozen=True)
class CleanOptions:
    """What cleaning may change.

    Args:
        weld: The farthest a vertex may move to be welded to another, in the model's unit; 0 welds only
            vertices that are equal bit for bit.
        drop_duplicates: Whether a face with the same vertices in the same winding as an earlier one is
            dropped.
        recentre: Whether float64 positions may get an origin of their own: `auto`, where rounding to float32
            loses so much less after it (recentre.py), or `never`.

    Raises:
        UsageError: Where `weld` is negative or not finite, or `recentre` is neither word.
    """

    weld: float = 0.0
    drop_duplicates: bool = False
    recentre: Recentring = "auto"

    def __post_init__(self) -> None:
        if not (math.isfinite(self.weld) and self.weld >= 0):
            raise UsageError(
                f"a weld distance of {self.weld}", remedy="a finite distance of 0 or more is wanted"
            )
        if self.recentre not in RECENTRINGS:
            raise UsageError(f"recentre {self.recentre!r}", remedy=f"one of {', '.join(RECENTRINGS)}")


@dataclass(frozen=True, eq=False)
class Cleaned:
    """A mesh that the later stages can rely on, and the account of how it was made.

    Args:
        mesh: float32 positions, all finite, each used; no face with a repeated vertex or zero area.
        source_face: `(n,)` int32, ascending: the face of the loaded mesh that each face is. Its corners are
            the source's in the source's order.
        counts: `faces_in == faces_out + non_finite + repeated_vertex + zero_area + duplicate_faces_dropped`
            and `vertices_in == vertices_out + vertices_welded + vertices_unreferenced`;
            `duplicate_faces_kept` are the faces among `faces_out` that repeat an earlier one in vertices and
            winding; where there are attributes, `vertices_with_seams` are the vertices whose corners
            differ in one of them.
        largest_rounding: The largest change of a coordinate by moving it to the origin and rounding to
            float32, in the model's unit; values that overflow are counted as non-finite instead.
        weld_error: The farthest a vertex was moved by welding, in the model's unit: at most
            `CleanOptions.weld`.
        origin: `(3,)` float64: what to add to the positions, to be where the source is; None where they stand
            as they are.
    """

    mesh: Mesh
    source_face: FaceIds
    counts: dict[str, int]
    largest_rounding: float
    weld_error: float
    origin: Origin | None = None


DEFAULT_OPTIONS = CleanOptions()


def clean(mesh: Mesh, options: CleanOptions = DEFAULT_OPTIONS, threads: int = 1) -> Cleaned:
    """Round, weld and drop as the module's head says; the mesh may come out empty, and its counts say why.

    The result is the same for any number of threads. What needs no change is not copied: the cleaned mesh may
    share arrays with `mesh`. Geometries are cleaned each by itself, where they do not stand anywhere yet, and
    never recentred; one may come out empty.

    Raises:
        UsageError: Where `options` are out of range.
    """
    from striptools.kernels.degenerate import USABLE

    if mesh.geometries is not None:
        own = replace(options, recentre="never")
        return _joined(mesh, [clean(part, own, threads) for part in mesh.parts()])
    positions, largest_rounding = round_positions(mesh.positions)
    origin = None
    if largest_rounding > 0 and options.recentre == "auto":
        positions, largest_rounding, origin = recentred(mesh.positions, positions, largest_rounding)
    leader, weld_error = weld_vertices(positions, options.weld, threads)
    welded = _followers(leader)
    faces = leader[mesh.faces] if welded else mesh.faces
    del leader
    verdict = judge_faces(positions, faces, threads)
    keep = verdict == USABLE
    counts = {"faces_in": len(faces), **_count_reasons(verdict)}
    repeated = _repeated_faces(faces, keep, len(positions), threads)
    repeats = int(np.count_nonzero(repeated))
    if options.drop_duplicates:
        keep &= ~repeated
    source_face = np.flatnonzero(keep).astype(np.int32)
    kept_faces = faces if len(source_face) == len(faces) else faces[source_face]
    del faces, verdict, keep, repeated
    used, kept_faces = _renumber(kept_faces, len(positions), threads)
    vertices_out = int(np.count_nonzero(used))
    counts |= {
        "duplicate_faces_dropped": repeats if options.drop_duplicates else 0,
        "duplicate_faces_kept": 0 if options.drop_duplicates else repeats,
        "faces_out": len(kept_faces),
        "vertices_in": len(positions),
        "vertices_out": vertices_out,
        "vertices_welded": welded,
        "vertices_unreferenced": len(positions) - welded - vertices_out,
    }
    attributes = ()
    if mesh.attributes:
        attributes, counts["vertices_with_seams"] = follow(
            mesh.attributes, mesh.faces, source_face, kept_faces, np.flatnonzero(used)
        )
    positions = positions if vertices_out == len(positions) else positions[used]
    cleaned = Mesh(positions, kept_faces, mesh.notes, attributes, mesh.materials, mesh.unit)
    return Cleaned(cleaned, source_face, counts, largest_rounding, weld_error, origin)


def _joined(mesh: Mesh, parts: list[Cleaned]) -> Cleaned:
    """The geometries of a mesh, each cleaned, as one mesh again."""
    assert mesh.geometries is not None
    starts = Geometries(
        *(
            np.cumsum([0, *counts], dtype=np.int32)
            for counts in ([len(c.mesh.faces) for c in parts], [len(c.mesh.positions) for c in parts])
        )
    )
    source = [
        part.source_face + first for part, first in zip(parts, mesh.geometries.face_starts, strict=False)
    ]
    joined = replace(
        mesh,
        positions=np.concatenate([part.mesh.positions for part in parts]),
        faces=np.concatenate(
            [part.mesh.faces + first for part, first in zip(parts, starts.vertex_starts, strict=False)]
        ),
        attributes=_joined_attributes([part.mesh for part in parts]),
        geometries=starts,
    )
    counts = sum((Counter(part.counts) for part in parts), Counter())
    return Cleaned(
        joined,
        np.concatenate(source).astype(np.int32),
        {name: counts[name] for name in parts[0].counts},
        max(part.largest_rounding for part in parts),
        max(part.weld_error for part in parts),
    )


def _joined_attributes(parts: list[Mesh]) -> tuple[Attribute, ...]:
    """The attributes of meshes one after another, of corners where some are and others are not."""
    found = []
    for k, first in enumerate(parts[0].attributes):
        own = [(part.attributes[k], part.faces) for part in parts]
        domains: set[Domain] = {one.domain for one, faces in own if len(faces)}
        domain = domains.pop() if len(domains) == 1 else "corner" if domains else first.domain
        rows = [
            one.values if one.domain == domain else one.at_corners(faces)
            for one, faces in own
            if len(faces) or one.domain == domain
        ]
        found.append(Attribute(first.name, domain, np.concatenate(rows)))
    return tuple(found)


def round_positions(positions: SourcePositions) -> tuple[Positions, float]:
    """The positions rounded to float32, and the largest change of a component that stays finite."""
    if positions.dtype == np.float32:
        return positions, 0.0
    largest = 0.0
    rounded = np.zeros(positions.shape, np.float32)
    with np.errstate(over="ignore", invalid="ignore"):
        for begin in range(0, len(positions), CHUNK):
            part = slice(begin, begin + CHUNK)
            rounded[part] = positions[part]
            change = np.abs(rounded[part] - positions[part])
            largest = max(largest, float(np.max(change, initial=0.0, where=np.isfinite(rounded[part]))))
    return rounded, largest


def weld_vertices(positions: Positions, distance: float = 0.0, threads: int = 1) -> tuple[FaceIds, float]:
    """The vertex that stands for each vertex, `(v,)` int32, and the farthest that one moves by it.

    Args:
        positions: `(v, 3)` float32.
        distance: 0 for bit-equal vertices only, else the tolerance, as in `CleanOptions.weld`.
        threads: How many threads share the work where the distance is 0.
    """
    from striptools.kernels.welding import first_equal_rows, nearest_leaders

    if distance == 0.0:
        words, leader = positions.view(np.uint32), np.zeros(len(positions), np.int32)
        in_parts(lambda part, parts: first_equal_rows(words, part, parts, leader), len(words), threads)
        return leader, 0.0
    leader, farthest = nearest_leaders(positions, distance)
    return leader, float(farthest)


def judge_faces(positions: Positions, faces: Faces, threads: int = 1) -> np.ndarray:
    """The verdict on each face, `(n,)` uint8 by the constants of `striptools.kernels.degenerate`.

    A face left `DOUBTFUL` is proved to have zero area.
    """
    from striptools.kernels.degenerate import DOUBTFUL, USABLE, classify_faces

    verdict = np.zeros(len(faces), np.uint8)
    in_chunks(lambda part: classify_faces(positions, faces, *part, verdict), len(faces), threads)
    doubtful = np.flatnonzero(verdict == DOUBTFUL)
    for begin in range(0, len(doubtful), CHUNK):
        part = doubtful[begin : begin + CHUNK]
        verdict[part[~has_zero_area(positions[faces[part]])]] = USABLE
    return verdict


def has_zero_area(corners: np.ndarray) -> np.ndarray:
    """Whether the three points of each row lie on one line exactly, `(n,)` bool.

    Args:
        corners: `(n, 3, 3)` float32, finite: corner by axis.
    """
    edges, exact = _exact_edges(corners)
    one, two = edges[:, 0], edges[:, 1]
    i, j = [1, 2, 0], [2, 0, 1]
    flat = (one[:, i] * two[:, j] == one[:, j] * two[:, i]).all(axis=1)
    for row in np.flatnonzero(~exact):
        flat[row] = _on_one_line(_as_integers(corners[row]))
    return flat


def _exact_edges(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The edges from the first corner, `(n, 2, 3)` float64, and for which rows their products are exact too.

    A product of two numbers that fit float32 is exact in float64. An edge fits float32 where rounding it
    changes nothing and no bit was lost by the subtraction, which its two-sum remainder tells (Knuth, TAOCP 2,
    4.2.2).
    """
    start = corners[:, :1].astype(np.float64)
    end = corners[:, 1:].astype(np.float64)
    edges = end - start
    taken = edges - end
    remainder = (end - (edges - taken)) - (start + taken)
    with np.errstate(over="ignore"):
        fits = (edges.astype(np.float32) == edges) & (remainder == 0)
    return edges, fits.all(axis=(1, 2))


def _as_integers(corners: np.ndarray) -> list[list[int]]:
    """The float32 corners as integers in units of 2^-149, read from their bits."""
    bits = corners.view(np.uint32).astype(object)
    return [[_units(int(word)) for word in row] for row in bits]


def _units(word: int) -> int:
    exponent = word >> 23 & 0xFF
    fraction = word & 0x7FFFFF
    size = fraction if exponent == 0 else (fraction | 0x800000) << (exponent - 1)
    return -size if word >> 31 else size


def _on_one_line(corners: list[list[int]]) -> bool:
    start, *ends = corners
    (ax, ay, az), (bx, by, bz) = ([e - s for e, s in zip(end, start, strict=True)] for end in ends)
    return ay * bz == az * by and az * bx == ax * bz and ax * by == ay * bx


def _count_reasons(verdict: np.ndarray) -> dict[str, int]:
    from striptools.kernels.degenerate import DOUBTFUL, NON_FINITE, REPEATED_VERTEX

    codes = {"non_finite": NON_FINITE, "repeated_vertex": REPEATED_VERTEX, "zero_area": DOUBTFUL}
    return {reason: int(np.count_nonzero(verdict == code)) for reason, code in codes.items()}


def _followers(leader: FaceIds) -> int:
    """How many vertices are led by another one."""
    return int(np.count_nonzero(leader != np.arange(len(leader), dtype=np.int32)))


def _repeated_faces(faces: Faces, keep: np.ndarray, vertex_count: int, threads: int) -> np.ndarray:
    """Which kept faces repeat an earlier kept one up to rotation, `(n,)` bool."""
    from striptools.kernels.welding import mark_repeated_faces

    repeated = np.zeros(len(faces), np.bool_)
    in_parts(
        lambda part, parts: mark_repeated_faces(faces, keep, vertex_count, part, parts, repeated),
        len(faces),
        threads,
    )
    return repeated


def _renumber(faces: Faces, vertex_count: int, threads: int) -> tuple[np.ndarray, Faces]:
    """Which vertices `faces` use, and `faces` in the numbering of those alone."""
    from striptools.kernels.welding import mark_used, renumber_faces

    used = np.zeros(vertex_count, np.bool_)
    in_chunks(lambda part: mark_used(faces, *part, used), len(faces), threads)
    if used.all():
        return used, faces
    place = np.cumsum(used, dtype=np.int32)
    place -= 1
    faces = faces.copy()
    in_chunks(lambda part: renumber_faces(faces, place, *part), len(faces), threads)
    return used, faces


# Notes. Stanford dragon (871,414 faces, 437,645 vertices), milliseconds of processor time, one thread,
# before and after: weld 23 / 13, zero area 10 / 9, repeated faces 114 / 20, the whole 120 / 50. The table of
# faces is laid out by least vertex, so that it is walked as the mesh is; slots by hash alone miss the cache.
# Threads share the tables by hash or by least vertex: each scans all rows and keeps its own, which takes 0.6
# of the time on two threads for faces and 0.8 for vertices. Terrain of 16 M faces: 1.6 s on one thread, 0.9
# of it welding, whose table no longer fits a cache.
