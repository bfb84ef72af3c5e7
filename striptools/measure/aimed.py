"""Rays aimed exactly at edges and vertices, and when such a ray must hit: the leak test.

What is certain. A ray that passes an edge or a vertex within the float32 bound is certain for none of the
faces there, but may be certain for all of them together. Let every edge at the target have exactly two faces,
run in opposite directions. Then the ray must hit one of the target's faces where

- every face there certainly turns the same side to the ray (`Pairs.side`), and lies ahead, and
- the ray is certainly on the inner side of every other edge of these faces (`Pairs.clear`): the two far edges
  of each of an edge's faces, the edge of each of a vertex's faces that lies opposite to it.

Why: the faces see the ray through vertices that moved by the same vector in each (`bound`), and the two edge
functions of a shared edge differ only in sign. For an edge: the far signs agree, and of u and -u one is not
negative. For a vertex P with the link Q_0, Q_1, ...: the link winds round the ray, no step of it by 180
degrees or more, so the exact signs of P x Q_i are not all alike, and somewhere they pass from not negative to
not positive: that face accepts. Rounding could make all signs alike only where a link edge is seen under more
than 180 degrees less 2 gamma, which `clear` excludes by its three rho. Nothing here looks at any other face,
so it costs the same on every mesh; faces in front of the target only bring the hit nearer.

From inside a closed mesh every ray must hit something, silhouettes included: a miss is a leak.
"""

from dataclasses import dataclass

import numpy as np

from striptools.measure.bound import RayFrames, judge_pairs
from striptools.mesh.clean import weld_vertices
from striptools.trace.rays import to_float32

PAIRS_A_CHUNK = 1 << 18


@dataclass(frozen=True)
class Fans:
    """The faces round the target of each ray, grouped by ray.

    Attributes:
        starts: (r + 1,) intp: ray i has the pairs starts[i]:starts[i+1]; none where the target is open.
        face: (k,) int32 rows of `Surface.corners`.
        exempt: (k,) int8: the corners, one bit each, whose opposite edge runs through the target.
    """

    starts: np.ndarray
    face: np.ndarray
    exempt: np.ndarray

    def part(self, first: int, last: int) -> "Fans":
        """The fans of rays first:last."""
        begin, end = self.starts[first], self.starts[last]
        return Fans(self.starts[first : last + 1] - begin, self.face[begin:end], self.exempt[begin:end])


class Surface:
    """Which faces lie round the edges and vertices of a mesh, vertices of equal position taken for one.

    Half-edge 3 f + k runs from corner k of face f to corner k + 1.

    Args:
        positions: (v, 3) float32, finite where used.
        faces: (n, 3) int32: those that are traced.

    Attributes:
        corners: (n, 3, 3) float64 positions of the faces' corners.
        faces: (n, 3) int32 vertices; those of equal position have one index.
        twin: (3n,) int32, the half-edge that runs back; -1 where the edge has not exactly two opposite
            half-edges.
        edges: (e,) int32, one half-edge of each edge.
        vertices: (w,) int32, the vertices that faces use.
    """

    def __init__(self, positions: np.ndarray, faces: np.ndarray) -> None:
        # Adding +0.0 makes -0.0 the same place; the arithmetic of a test cannot tell them apart.
        leader, _ = weld_vertices(positions + np.float32(0.0))
        self.faces = leader[faces].astype(np.int32).reshape(-1, 3)
        self.positions = positions
        self.twin, self.edges = _pair_half_edges(self.faces)
        order = np.argsort(self.faces.reshape(-1), kind="stable").astype(np.int32)
        self.vertices, first = np.unique(self.faces.reshape(-1)[order], return_index=True)
        self._corner = order
        self._corner_start = np.append(first, len(order))
        closed = (self.twin >= 0).reshape(-1, 3)
        corner_closed = closed & np.roll(closed, 1, axis=1)
        open_corners = np.add.reduceat(~corner_closed.reshape(-1)[order], first) if len(first) else first
        self._vertex_closed = open_corners == 0

    @property
    def corners(self) -> np.ndarray:
        """(n, 3, 3) float64."""
        return self.positions[self.faces].astype(np.float64)

    @property
    def closed(self) -> bool:
        """Whether every edge has exactly two faces, run in opposite directions."""
        return len(self.twin) > 0 and bool((self.twin >= 0).all())

    @property
    def open_edges(self) -> int:
        """How many edges have not exactly two faces in opposite directions."""
        return int((self.twin[self.edges] < 0).sum())

    def edge_midpoints(self, edges: np.ndarray) -> np.ndarray:
        """(k, 3) float64 middles of half-edges."""
        a = self.faces.reshape(-1)[edges]
        b = self.faces.reshape(-1)[edges // 3 * 3 + (edges + 1) % 3]
        return (self.positions[a].astype(np.float64) + self.positions[b]) / 2

    def edge_fans(self, edges: np.ndarray) -> Fans:
        """The two faces of each half-edge given; none for an open one."""
        twin = self.twin[edges]
        both = np.stack([edges, twin], axis=1)[twin >= 0].reshape(-1)
        starts = np.concatenate([[0], np.cumsum(2 * (twin >= 0))])
        return Fans(starts, both // 3, (1 << (both + 2) % 3).astype(np.int8))

    def vertex_fans(self, vertices: np.ndarray) -> Fans:
        """All faces of each place in `self.vertices`; none where one of their edges there is open."""
        first = self._corner_start[vertices]
        count = np.where(self._vertex_closed[vertices], self._corner_start[vertices + 1] - first, 0)
        starts = np.concatenate([[0], np.cumsum(count)])
        corner = self._corner[np.arange(starts[-1]) + np.repeat(first - starts[:-1], count)]
        return Fans(starts, corner // 3, (7 ^ (1 << corner % 3)).astype(np.int8))

    def normals_at(self, half_edges: np.ndarray) -> np.ndarray:
        """(k, 3) float64 unit normals of the half-edges' faces."""
        a, b, c = self.positions[self.faces[half_edges // 3]].astype(np.float64).transpose(1, 0, 2)
        return _unit(np.cross(b - a, c - a))

    def corner_at(self, vertices: np.ndarray) -> np.ndarray:
        """One half-edge that starts at each place in `self.vertices`."""
        return self._corner[self._corner_start[vertices]]


def _pair_half_edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Twins of half-edges, and the first half-edge of each edge."""
    start = faces.reshape(-1).astype(np.int64)
    end = np.roll(faces, -1, axis=1).reshape(-1).astype(np.int64)
    key = np.minimum(start, end) * (int(faces.max(initial=0)) + 1) + np.maximum(start, end)
    order = np.argsort(key, kind="stable").astype(np.int32)
    key = key[order]
    begins = np.flatnonzero(np.append(True, key[1:] != key[:-1])[: len(key)])
    length = np.diff(np.append(begins, len(key)))
    pairs = begins[length == 2]
    one, two = order[pairs], order[pairs + 1]
    opposite = start[one] == end[two]
    opposite &= start[one] != end[one]
    twin = np.full(len(order), -1, np.int32)
    twin[one[opposite]], twin[two[opposite]] = two[opposite], one[opposite]
    return twin, order[begins]


@dataclass(frozen=True)
class Verdicts:
    """What the fans say of each ray: (r,) bool `certain`, (r,) float64 `farthest`, the largest t allowed."""

    certain: np.ndarray
    farthest: np.ndarray


def judge_fans(frames: RayFrames, surface: Surface, fans: Fans, error_bound: float = 0.0) -> Verdicts:
    """Say which rays must hit a face of their fan, and how far at most; the module's head says why."""
    count = len(fans.starts) - 1
    certain, farthest = np.zeros(count, bool), np.full(count, np.inf)
    first = 0
    while first < count:
        last = int(np.searchsorted(fans.starts, fans.starts[first] + PAIRS_A_CHUNK, side="right")) - 1
        last = min(max(last, first + 1), count)
        part = slice(first, last)
        certain[part], farthest[part] = _judge_chunk(
            frames, first, surface, fans.part(first, last), error_bound
        )
        first = last
    return Verdicts(certain, farthest)


def _judge_chunk(
    frames: RayFrames, first: int, surface: Surface, fans: Fans, error_bound: float
) -> tuple[np.ndarray, np.ndarray]:
    size = np.diff(fans.starts)
    full = np.flatnonzero(size)
    certain, farthest = np.zeros(len(size), bool), np.full(len(size), np.inf)
    if len(full) == 0:
        return certain, farthest
    ray = first + np.repeat(np.arange(len(size)), size)
    corners = surface.positions[surface.faces[fans.face]].astype(np.float64)
    pairs = judge_pairs(frames, ray, corners, error_bound)
    exempt = (fans.exempt[:, None] >> np.arange(3) & 1).astype(bool)
    fine = pairs.ahead & (pairs.clear | exempt).all(axis=1)
    begins = fans.starts[:-1][full]
    turned = np.add.reduceat(pairs.side.astype(np.int64), begins)
    certain[full] = np.logical_and.reduceat(fine, begins) & (np.abs(turned) == size[full])
    farthest[full] = np.maximum.reduceat(pairs.farthest, begins)
    farthest[~certain] = np.inf
    return certain, farthest


def aim(
    targets: np.ndarray, normals: np.ndarray, bounds: np.ndarray, random: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Rays through targets, as exactly as float32 allows, a quarter of each kind in turn.

    From a place round the model, as a camera's; from just before the target, within 70 degrees of the normal;
    from just behind it (for a closed mesh mostly inside); along an axis, where a vertex is met exactly.

    Args:
        targets: (k, 3) float64.
        normals: (k, 3) float64 unit normals near the targets.
        bounds: (2, 3) float64 of the model.
        random: Where the places come from.

    Returns:
        Origins and directions, (k, 3) float32; directions not of unit length, which would cost exactness.
    """
    count = len(targets)
    diagonal = float(np.linalg.norm(bounds[1] - bounds[0])) or 1.0
    kind = np.arange(count) % 4
    around = bounds.mean(axis=0) + diagonal * _unit(random.normal(size=(64, 3))) * random.uniform(
        0.8, 3, (64, 1)
    )
    slanted = _unit(normals + _unit(random.normal(size=(count, 3))) * 0.94)
    reach = diagonal * 10 ** random.uniform(-2, 0, (count, 1))
    side = np.where(kind == 1, 1.0, -1.0)[:, None]
    origins = np.where(
        (kind == 0)[:, None], around[random.integers(0, 64, count)], targets + side * slanted * reach
    )
    origins, aims = to_float32(origins), to_float32(targets)
    axis = random.integers(0, 3, count)
    rows = np.flatnonzero(kind == 3)
    origins[rows] = aims[rows]
    outwards = np.where(normals[rows, axis[rows]] < 0, -1, 1) * 1.5 * diagonal
    origins[rows, axis[rows]] = to_float32(targets[rows, axis[rows]] + outwards)
    directions = to_float32(targets - origins.astype(np.float64))
    straight = np.zeros((len(rows), 3), np.float32)
    straight[np.arange(len(rows)), axis[rows]] = -np.sign(outwards)
    directions[rows] = straight
    return origins, directions


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(length > 0, length, 1.0)
