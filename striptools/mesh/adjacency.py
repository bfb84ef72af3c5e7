"""Face neighbours across edges, for any input: borders, edges of many faces, mixed winding, duplicates.

A half-edge `h = 3 * face + slot` is the edge of `face` from corner `slot` to corner `(slot + 1) % 3`. All
half-edges of one undirected edge stand on cyclic rings, which is the whole structure: 12 bytes a triangle, as
much as a plain table of neighbours.

The policy for edges that are not shared by exactly two faces:

1. A half-edge that is alone on its edge (a border) is its own ring.
2. All half-edges of an edge are listed with forward ones (from the smaller vertex index to the larger) and
   backward ones in turn, each kind by ascending half-edge, starting with a forward one; when one kind runs
   out the rest of the other follows. So faces that agree in winding come to lie beside each other.
3. That list is cut into rings of at most four; a lone rest joins the ring before it, which then has five. So
   no search round an edge costs more than a constant, whatever the edge has, and a half-edge stands alone
   only on a border.
4. Two faces of one edge are neighbours whatever their windings; `same winding` is a question for the reader
   of the ring.
5. An edge from a vertex to itself has no neighbours.

Two counting sorts over the half-edges find the edges: linear time, no hashing, ties by index.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Int32

from striptools.errors import LimitError, UsageError
from striptools.mesh.mesh import MOST_FACES, first_face_out_of_range
from striptools.types import Faces

if TYPE_CHECKING:
    import networkx

HalfEdges = Int32[np.ndarray, " h"]
"""One value per half-edge: `h` is three times the number of faces."""

LONGEST_RING = 5
"""The most half-edges on one ring."""


@dataclass(frozen=True, eq=False)
class Adjacency:
    """Which faces meet at which edge.

    Args:
        ring: `(3n,)` int32: `ring[h]` is the next half-edge on the ring of `h`, cyclic; `ring[h] == h` on a
            border.
    """

    ring: HalfEdges


def build_adjacency(faces: Faces, vertex_count: int) -> Adjacency:
    """Find the neighbours of every face by the policy in the module's head.

    Args:
        faces: `(n, 3)` int32, indices in `0 .. vertex_count - 1`; rows with repeated vertices are allowed.
        vertex_count: How many vertices there are.

    Raises:
        UsageError: Where an index is out of range.
        LimitError: Where there are too many faces for int32 half-edges.
    """
    from striptools.kernels.adjacency import ring_half_edges

    if len(faces) > MOST_FACES:
        raise LimitError(f"{len(faces)} faces", remedy=f"at most {MOST_FACES} are handled; split the model")
    bad = first_face_out_of_range(faces, vertex_count)
    if bad is not None:
        raise UsageError(f"face {bad} names a vertex that does not exist", where="build_adjacency")
    return Adjacency(ring_half_edges(np.ascontiguousarray(faces, np.int32), vertex_count))


def check_adjacency(adjacency: Adjacency, faces: Faces) -> None:
    """Raise where `adjacency` breaks the policy for `faces`; shares no code with the builder.

    Raises:
        UsageError: Naming the first law that does not hold and a half-edge that shows it.
    """
    ring = adjacency.ring
    half_edges = 3 * len(faces)
    if ring.shape != (half_edges,) or ring.dtype != np.int32:
        raise UsageError(f"the ring is {ring.dtype}{ring.shape}, not int32({half_edges},)", where="adjacency")
    itself = np.arange(half_edges, dtype=np.int32)
    _require((ring >= 0) & (ring < half_edges), "the next half-edge does not exist")
    _require(np.bincount(ring, minlength=half_edges) == 1, "not exactly one half-edge leads here")
    tail = faces.reshape(-1)
    head = np.roll(faces, -1, axis=1).reshape(-1)
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    _require((low[ring] == low) & (high[ring] == high), "the next half-edge lies on another edge")
    _require((tail != head) | (ring == itself), "an edge from a vertex to itself has a neighbour")
    label = _ring_labels(ring)
    _, edge = np.unique(np.stack([low, high], axis=1), axis=0, return_inverse=True)
    _check_cuts(label, edge.reshape(-1), forward=tail < head, loop=tail == head)


def dual_graph(adjacency: Adjacency, faces: Faces) -> networkx.Graph:
    """The dual graph: a node for every face, an edge between any two faces that share a ring.

    Attributes of an edge `(f, g)`: `shared`, a tuple of the vertex pairs `(a, b)`, a < b, across which they
    are neighbours, ascending; and `same_winding`, true where they run every one of these in opposite
    directions, as two faces of a consistently oriented surface do. Faces that share two or three edges
    (duplicates, flaps) have ONE edge here with several pairs in `shared`: this is a simple graph, not a
    multigraph. A face that meets itself (a row like `a b a`) gets no loop. Faces of one mesh edge that lie on
    different rings, which takes six or more faces there, are no neighbours.
    """
    import networkx

    graph = networkx.Graph()
    graph.add_nodes_from(range(len(faces)))
    tail = faces.reshape(-1)
    head = np.roll(faces, -1, axis=1).reshape(-1)
    for half, other in _pairs_on_rings(adjacency.ring):
        one, two = int(half) // 3, int(other) // 3
        if one == two:
            continue
        pair = (int(min(tail[half], head[half])), int(max(tail[half], head[half])))
        opposite = bool(tail[half] != tail[other])
        known = graph.get_edge_data(one, two, {"shared": (), "same_winding": True})
        shared = tuple(sorted({*known["shared"], pair}))
        graph.add_edge(one, two, shared=shared, same_winding=known["same_winding"] and opposite)
    return graph


def _pairs_on_rings(ring: np.ndarray) -> np.ndarray:
    """All pairs `(h, g)`, h < g, of half-edges on one ring, sorted."""
    itself = np.arange(len(ring), dtype=np.int32)
    other = ring
    pairs = []
    for _ in range(LONGEST_RING - 1):
        pairs.append(np.stack([itself, other], axis=1)[itself < other])
        other = ring[other]
    return np.unique(np.concatenate(pairs), axis=0)


def _ring_labels(ring: np.ndarray) -> np.ndarray:
    """The least half-edge of each half-edge's ring; raises where a ring is longer than `LONGEST_RING`."""
    itself = np.arange(len(ring), dtype=np.int32)
    label, at, closed = itself.copy(), ring, ring == itself
    for _ in range(LONGEST_RING - 1):
        label = np.minimum(label, at)
        at = ring[at]
        closed |= at == itself
    _require(closed, f"a ring is longer than {LONGEST_RING}")
    return label


def _check_cuts(label: np.ndarray, edge: np.ndarray, *, forward: np.ndarray, loop: np.ndarray) -> None:
    """Raise unless each edge has the fewest rings and no pair of opposite half-edges is torn apart."""
    edges = int(edge.max()) + 1 if len(edge) else 0
    size = np.bincount(edge, minlength=edges)
    rings = np.bincount(edge[label == np.arange(len(label))], minlength=edges)
    wanted = np.where(size <= LONGEST_RING, 1, size // 4 + (size % 4 > 1))
    _require((rings == wanted)[edge] | loop, "the edge is cut into the wrong number of rings")
    members = np.bincount(label, minlength=len(label))
    ahead = np.bincount(label, weights=forward, minlength=len(label)).astype(np.int64)
    matched = np.minimum(ahead, members - ahead)
    of_edge = (
        np.bincount(edge, weights=matched[label] / members[label], minlength=edges).round().astype(np.int64)
    )
    ahead_of_edge = np.bincount(edge, weights=forward, minlength=edges).astype(np.int64)
    best = np.minimum(ahead_of_edge, size - ahead_of_edge)
    _require((of_edge == best)[edge] | loop, "windings do not alternate along the rings")


def _require(holds: np.ndarray, complaint: str) -> None:
    if not holds.all():
        first = int(np.flatnonzero(~holds)[0])
        raise UsageError(f"{complaint} (half-edge {first}, face {first // 3})", where="adjacency")
