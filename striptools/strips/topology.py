"""Topology of strips: generalised ones with turn and flip bits, classic alternating ones for export.

**Generalised strips** (what the scene stores). A strip of k triangles is a row of k + 2 vertices and k turn
bits. Its first triangle is (a, b, c) = vertices 0, 1, 2. Each further triangle j adds vertex j + 2, w,
behind the edge by which the strip leaves the triangle (a, b, c) before it:

    turn bit 0: by b -> c, the next triangle is (c, b, w)
    turn bit 1: by c -> a, the next triangle is (a, c, w)

Both run the shared edge against the triangle before, so that a strip of faces of one winding has the winding
of its source. The edge a -> b, by which a triangle was entered, is never left by. The turn bit of a strip's
FIRST triangle is unused and is 0. An encoder turns the first triangle so that the bit of the SECOND is 0; a
decoder takes either.

A face that runs the shared edge the same way as the one before is walked over with its first two corners
swapped, and its *flip bit* is set: the walk goes on as above, and where the bit is set the triangle (a, b, c)
stands for the face (b, a, c). The bit tells of the triangle alone, against the walk and not against its
neighbour, so that one triangle can still be read alone. The walk has the winding of the strip's first face,
whose bit is 0. Strips without any flip have no bits at all.

So in triangle j of a strip c is vertex j + 2, and, looking back from j over the bits 1..j, a is the vertex p
+ 1 of the last triangle p with bit 0, b the vertex q + 1 of the last triangle q with bit 1; where there is
none a is vertex 0 and b vertex 1. One triangle can be read alone from its strip's bits by counting trailing
ones and zeros.

Source: Lauterbach et al., ReduceM (EGSR 2008), step "Strip output", which prints index lists with repeated
("swap") vertices. Differences:
1. A turn bit stands for a swap vertex: n + 2 vertices for n triangles, whatever the turns.
2. The rotation of each triangle against its source face is kept, so that source corners can be restored.
3. Where two faces share more than one edge, any crossing that leaves no face by its entry edge is found.
4. A strip may cross an edge that both faces run the same way, for a flip bit.

**Classic strips** (classic_strips) have no flips: strips are cut where the winding changes. Triangle k of a
strip is indices k, k + 1, k + 2, with the first two swapped for odd k. Equal turns in a row cost one repeated
vertex each. Strips are set apart by a restart index or by two repeated vertices; where a strip begins with
the vertex that ended the one before, it follows at once, which saves the restart. Which strip follows, and
from which end each is written, is free and chosen greedily.

Cost: O(n), all of it.
"""

from dataclasses import dataclass

import numpy as np

from striptools.errors import UsageError
from striptools.kernels import classic_strips as classic
from striptools.kernels import strip_topology as kernels
from striptools.kernels.blocks import fan_starts
from striptools.strips.ordering import Sequences
from striptools.threads import SMALLEST_CHUNK, in_chunks
from striptools.types import Bools, Counts, FaceIds, Faces, Rotations

RESTART = -1
"""What sets classic strips apart; no vertex index is negative."""


@dataclass(frozen=True)
class Strips:
    """Generalised strips and where their triangles come from.

    Strip i covers triangles starts[i]:starts[i+1] and vertices starts[i] + 2 i : starts[i+1] + 2 i + 2.

    Attributes:
        vertices: (c,) int32, c = n + 2 s.
        turns: (n,) bool, the turn bit of each triangle, False for the first of each strip.
        starts: (s+1,) int32, in triangles.
        source_face: (n,) int32, the face each triangle was.
        rotation: (n,) uint8, places its corners were turned to the left: decoded[j] = source[(j + rotation)
        % 3].
        flips: (n,) bool, the flip bit of each triangle, False for the first of each strip; None where no
            triangle has one.
    """

    vertices: Counts
    turns: Bools
    starts: Counts
    source_face: FaceIds
    rotation: Rotations
    flips: Bools | None = None


def encode_strips(faces: Faces, sequences: Sequences, threads: int = 1, *, flips: bool = True) -> Strips:
    """Write sequences of faces as generalised strips.

    Args:
        faces: (n, 3) int32.
        sequences: Each face once, neighbours share an edge.
        threads: How many threads share the strips; the result is the same for any number.
        flips: Whether neighbours may run their edge the same way.

    Returns:
        Strips whose decoded triangles are the faces of `sequences.faces`, turned left by `rotation`.

    Raises:
        UsageError: A face in a sequence cannot be reached from the face before it.
    """
    order, starts = sequences.faces, sequences.starts
    vertices = np.zeros(len(order) + 2 * (len(starts) - 1), np.int32)
    turns = np.zeros(len(order), np.bool_)
    rotation = np.zeros(len(order), np.uint8)
    flipped = np.zeros(len(order), np.bool_)
    parts = in_chunks(
        lambda part: kernels.encode(faces, order, starts, *part, flips, vertices, turns, rotation, flipped),
        len(starts) - 1,
        threads,
        _strips_a_chunk(starts),
    )
    _refuse_break(next((place for place, _ in parts if place >= 0), -1), "encode_strips")
    has_flips = any(part_has for _, part_has in parts)
    return Strips(vertices, turns, starts, order, rotation, flipped if has_flips else None)


def split_fans(strips: Strips, faces: Faces, threads: int = 1) -> Strips:
    """The same triangles in the same order, strips cut where more than 30 turn bits in a row are equal.

    The scene file asks for it, so that a triangle's corners follow from 32 turn bits. Only strips round a
    vertex of many faces are that long.

    Args:
        strips: Of `encode_strips`.
        faces: (n, 3) int32, those that they were made of.
        threads: How many threads encode what was cut.
    """
    while True:
        is_first = np.zeros(len(strips.turns), np.bool_)
        if fan_starts(strips.turns, strips.starts, is_first) == len(strips.starts) - 1:
            return strips
        # The second turn bit of a new strip is 0 whatever it was, so the strips are looked at again.
        starts = np.append(np.flatnonzero(is_first), len(is_first)).astype(np.int32)
        strips = encode_strips(faces, Sequences(strips.source_face, starts), threads)


def decode_strips(
    vertices: Counts, turns: Bools, starts: Counts, flips: Bools | None = None, *, threads: int = 1
) -> Faces:
    """The triangles of generalised strips, (n, 3) int32, in file order and with the winding of their sources.

    Args:
        vertices: (n + 2 s,) int32.
        turns: (n,) bool; those of first triangles are not looked at.
        starts: (s+1,) int32, from 0 to n, rising.
        flips: (n,) bool; None where no triangle has a flip.
        threads: How many threads share the strips.

    Raises:
        UsageError: Arrays whose lengths do not belong together.
    """
    count, strip_count = len(turns), len(starts) - 1
    _check_starts(starts, count, "starts")
    if len(vertices) != count + 2 * strip_count:
        raise UsageError(f"{len(vertices)} vertices for {count} triangles", where="decode_strips")
    if flips is not None and len(flips) != count:
        raise UsageError(f"{len(flips)} flip bits for {count} triangles", where="decode_strips")
    faces = np.zeros((count, 3), np.int32)
    in_chunks(
        lambda part: kernels.decode(vertices, turns, starts, *part, faces),
        strip_count,
        threads,
        _strips_a_chunk(starts),
    )
    if flips is not None:
        in_chunks(lambda part: kernels.swap_flipped(flips, *part, faces), count, threads)
    return faces


def without_flips(strips: Strips) -> Strips:
    """The same triangles in the same order, each strip cut where its flip bit changes, and no flips."""
    if strips.flips is None:
        return strips
    faces = decode_strips(strips.vertices, strips.turns, strips.starts, strips.flips)
    changes = np.flatnonzero(strips.flips[1:] != strips.flips[:-1]) + 1
    starts = np.union1d(strips.starts, changes).astype(np.int32)
    cut = encode_strips(faces, Sequences(np.arange(len(faces), dtype=np.int32), starts), flips=False)
    rotation = (strips.rotation + cut.rotation) % 3
    return Strips(cut.vertices, cut.turns, cut.starts, strips.source_face, rotation.astype(np.uint8))


@dataclass(frozen=True)
class ClassicCount:
    """What classic strips take.

    Attributes:
        indices: Length of the index list, all told.
        restarts: Restart indices in it; 0 where strips are stitched.
        joins: Places where a strip follows at once, for it begins with the vertex that ended the one before.
        repeats: Vertices repeated for turns.
    """

    indices: int
    restarts: int
    joins: int
    repeats: int


def classic_strips(strips: Strips, restart: int | None = RESTART) -> Counts:
    """Classic alternating strips as one index list.

    Every triangle keeps its winding: strips are cut where their flip bit changes. Each strip is written from
    the end whose first turn fits its place, and strips are put in an order in which many begin with the
    vertex that ended the one before: these follow at once, and their common vertex stands twice. Other strips
    are set apart by `restart`, or by the last vertex and the next one once more. Repeated vertices make
    triangles of no area that decode_classic and every renderer drop.

    Args:
        strips: Generalised strips of faces with three different vertices.
        restart: The index between strips, which no vertex may have; None to stitch them by repeated vertices.

    Returns:
        (k,) int32.

    Raises:
        UsageError: A vertex has the restart index, or a triangle a repeated vertex.
    """
    strips = without_flips(strips)
    faces = _distinct_corners(strips)
    if restart is not None and (strips.vertices == restart).any():
        raise UsageError(f"vertex {restart} is the restart index", where="restart")
    plan, length, _ = _plan_classic(strips, faces, stitched=restart is None)
    indices = np.zeros(length, np.int32)
    written = classic.write(
        faces, strips.turns, strips.starts, plan, -1 if restart is None else restart, restart is None, indices
    )
    assert written == length
    return indices


def count_classic(strips: Strips, restart: int | None = RESTART) -> ClassicCount:
    """What `classic_strips` takes, without writing it down.

    Args:
        strips: Generalised strips of faces with three different vertices.
        restart: An index for restarts, None for stitches.

    Raises:
        UsageError: A triangle has a repeated vertex.
    """
    strips = without_flips(strips)
    _, length, joins = _plan_classic(strips, _distinct_corners(strips), stitched=restart is None)
    apart = max(len(strips.starts) - 2, 0) - joins
    between = apart if restart is not None else 2 * apart
    repeats = length - len(strips.vertices) - between
    return ClassicCount(length, apart if restart is not None else 0, joins, repeats)


def _distinct_corners(strips: Strips) -> Faces:
    faces = decode_strips(strips.vertices, strips.turns, strips.starts)
    if _repeats(faces).any():
        raise UsageError(
            "a triangle has a repeated vertex", where="classic_strips", remedy="clean the mesh first"
        )
    return faces


def _plan_classic(strips: Strips, faces: Faces, *, stitched: bool) -> tuple[classic.Plan, int, int]:
    ends = classic.describe(faces, strips.turns, strips.starts)
    vertex_count = int(strips.vertices.max(initial=-1)) + 1
    return classic.plan(faces, strips.starts, ends, vertex_count, 2 if stitched else 1, stitched)


def decode_classic(indices: Counts, restart: int = RESTART) -> Faces:
    """The triangles of classic strips, (n, 3) int32, in order; those with a repeated vertex are dropped.

    Args:
        indices: (k,) int32.
        restart: The index that sets strips apart.
    """
    indices = np.asarray(indices, np.int32)
    place = np.arange(len(indices))
    since = place - np.maximum.accumulate(np.where(indices == restart, place, -1)) - 1
    last = np.flatnonzero(since >= 2)
    rows = np.stack([indices[last - 2], indices[last - 1], indices[last]], axis=1)
    odd = since[last] % 2 == 1
    rows[odd, :2] = rows[odd, 1::-1]
    return rows[~_repeats(rows)]


def check_sequences(
    sequences: Sequences, faces: Faces, max_length: int | None = None, *, flips: bool = True
) -> None:
    """Raise unless each face stands once, and each can be reached from the one before it in its sequence.

    Args:
        sequences: In question.
        faces: (n, 3) int32.
        max_length: The most faces that a sequence may have.
        flips: Whether neighbours may run their edge the same way.

    Raises:
        UsageError: Naming what is broken and where.
    """
    order, starts = sequences.faces, sequences.starts
    _expect(np.array_equal(np.sort(order), np.arange(len(faces))), "sequences", "not each face stands once")
    _check_starts(starts, len(order), "sequences")
    longest = int(sequences.lengths.max(initial=0))
    _expect(max_length is None or longest <= max_length, "sequences", f"one has {longest} faces")
    _refuse_break(kernels.first_break(faces, order, starts, flips), "sequences")


def check_strips(strips: Strips, faces: Faces) -> None:
    """Raise unless the strips hold every face once, each turned left by its rotation and never reflected.

    Raises:
        UsageError: Naming what is broken and where.
    """
    count, strip_count = len(strips.turns), len(strips.starts) - 1
    _check_starts(strips.starts, count, "strips")
    _expect(len(strips.vertices) == count + 2 * strip_count, "strips", f"{len(strips.vertices)} vertices")
    _expect(not strips.turns[strips.starts[:-1]].any(), "strips", "an unused turn bit is set")
    if strips.flips is not None:
        _expect(len(strips.flips) == count, "strips", f"{len(strips.flips)} flip bits")
        _expect(bool(strips.flips.any()), "strips", "there are flip bits, but no flip")
        _expect(not strips.flips[strips.starts[:-1]].any(), "strips", "a first triangle is flipped")
    source, rotation = strips.source_face, strips.rotation
    _expect(np.array_equal(np.sort(source), np.arange(len(faces))), "strips", "not each face stands once")
    _expect(len(rotation) == count and not (rotation > 2).any(), "strips", "a rotation is not 0, 1 or 2")
    corners = (np.arange(3) + rotation[:, None]) % 3
    turned = np.take_along_axis(faces[source], corners, axis=1)
    decoded = decode_strips(strips.vertices, strips.turns, strips.starts, strips.flips)
    wrong = np.flatnonzero((decoded != turned).any(axis=1))
    _expect(len(wrong) == 0, "strips", f"triangle {next(iter(wrong), 0)} is not its source face")


def _refuse_break(place: int, where: str) -> None:
    _expect(place < 0, where, f"the face at {place} does not continue the one before it")


def _strips_a_chunk(starts: Counts) -> int:
    """The fewest strips that are worth a thread, by what they hold on average."""
    return max(1, SMALLEST_CHUNK * (len(starts) - 1) // max(1, int(starts[-1])))


def _repeats(rows: Faces) -> Bools:
    return (rows[:, 0] == rows[:, 1]) | (rows[:, 1] == rows[:, 2]) | (rows[:, 2] == rows[:, 0])


def _check_starts(starts: Counts, count: int, where: str) -> None:
    good = len(starts) >= 1 and starts[0] == 0 and starts[-1] == count and not (np.diff(starts) < 1).any()
    _expect(bool(good), where, f"starts do not rise from 0 to {count}")


def _expect(holds: bool, where: str, what: str) -> None:
    if not holds:
        raise UsageError(what, where=where)
