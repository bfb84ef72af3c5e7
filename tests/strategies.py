"""Hypothesis strategies for meshes, drawn from where bugs live.

`meshes()` draws anything a file may hold: NaN, repeated vertices, zero area, duplicates, unused vertices.
`clean_meshes()` draws what `striptools.mesh.clean` hands on; `mesh_of_kind(name)` draws one kind of the list
`KINDS`. All are small (`MOST_TRIANGLES`), and every shape comes with flipped, repeated and shuffled faces and
moved far away.
"""

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st

from striptools.mesh.clean import CleanOptions, clean
from striptools.mesh.mesh import Mesh

MOST_TRIANGLES = 400

Arrays = tuple[np.ndarray, np.ndarray]


def grid(columns: int, rows: int) -> Arrays:
    """A lattice of unit squares in two triangles each: equal centroids on both axes, flat boxes."""
    x, y = np.meshgrid(np.arange(columns + 1), np.arange(rows + 1))
    positions = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
    corner = (np.arange(rows)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
    one = np.stack([corner, corner + 1, corner + columns + 1], axis=1)
    two = np.stack([corner + 1, corner + columns + 2, corner + columns + 1], axis=1)
    return positions, np.stack([one, two], axis=1).reshape(-1, 3).astype(np.int32)


def fan(blades: int) -> Arrays:
    """Triangles round one vertex, closed."""
    angle = np.arange(blades) * (2 * np.pi / blades)
    rim = np.stack([np.cos(angle), np.sin(angle), np.zeros(blades)], axis=1)
    positions = np.concatenate([[[0, 0, 0]], rim]).astype(np.float32)
    k = np.arange(blades)
    return positions, np.stack([0 * k, 1 + k, 1 + (k + 1) % blades], axis=1).astype(np.int32)


def book(pages: int) -> Arrays:
    """Triangles that all share one edge, every other one run the other way."""
    angle = np.arange(pages) * (2 * np.pi / pages)
    outer = np.stack([np.cos(angle), np.sin(angle), np.full(pages, 0.5)], axis=1)
    positions = np.concatenate([[[0, 0, 0], [0, 0, 1]], outer]).astype(np.float32)
    faces = np.stack([np.zeros(pages), np.ones(pages), 2 + np.arange(pages)], axis=1).astype(np.int32)
    faces[1::2, :2] = faces[1::2, 1::-1]
    return positions, faces


def tetrahedron() -> Arrays:
    """The smallest closed mesh."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    return positions, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def cube() -> Arrays:
    """A closed cube with axis-parallel faces through the origin's planes."""
    positions = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    squares = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = [triangle for a, b, c, d in squares for triangle in ((a, b, c), (a, c, d))]
    return positions, np.array(faces, np.int32)


def sphere(divisions: int) -> Arrays:
    """An octahedron subdivided `divisions` times and pushed out to the unit sphere: closed, 8 * 4^d faces."""
    points = [(1.0, 0, 0), (-1.0, 0, 0), (0, 1.0, 0), (0, -1.0, 0), (0, 0, 1.0), (0, 0, -1.0)]
    # Parity of the three signs decides the outward winding of each octant.
    faces = [(a, b, c) if (a + b + c) % 2 == 0 else (a, c, b) for a in (0, 1) for b in (2, 3) for c in (4, 5)]
    for _ in range(divisions):
        middle: dict[tuple[int, int], int] = {}

        def between(a: int, b: int, middle: dict[tuple[int, int], int] = middle) -> int:
            key = (min(a, b), max(a, b))
            if key not in middle:
                middle[key] = len(points)
                point = np.add(points[a], points[b])
                points.append(tuple(point / np.linalg.norm(point)))
            return middle[key]

        faces = [
            triangle
            for a, b, c in faces
            for ab, bc, ca in [(between(a, b), between(b, c), between(c, a))]
            for triangle in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))
        ]
    return np.array(points, np.float32), np.array(faces, np.int32)


def soup(triangles: int, seed: int, lattice: int) -> Arrays:
    """Triangles that share no vertex, on a small lattice: coincident and degenerate by chance."""
    random = np.random.default_rng(seed)
    positions = random.integers(-lattice, lattice + 1, (3 * triangles, 3)).astype(np.float32)
    return positions, np.arange(3 * triangles, dtype=np.int32).reshape(-1, 3)


def tangle(vertices: int, triangles: int, seed: int) -> Arrays:
    """Random triples of few vertices: every edge non-manifold, duplicates, rows with repeated vertices."""
    random = np.random.default_rng(seed)
    positions = random.normal(size=(vertices, 3)).astype(np.float32)
    return positions, random.integers(0, vertices, (triangles, 3)).astype(np.int32)


def line(triangles: int) -> Arrays:
    """Triangles of exactly zero area, on one line that no axis is parallel to."""
    k = np.arange(triangles + 2)
    positions = np.stack([k, 2 * k, -3 * k], axis=1).astype(np.float32)
    return positions, np.stack([k[:-2], k[1:-1], k[2:]], axis=1).astype(np.int32)


def stack(copies: int) -> Arrays:
    """One triangle many times over, on vertices of its own each time: all centroids equal."""
    positions = np.tile(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32), (copies, 1))
    return positions, np.arange(3 * copies, dtype=np.int32).reshape(-1, 3)


_seeds = st.integers(0, 2**32 - 1)

KINDS: dict[str, st.SearchStrategy[Arrays]] = {
    "grid": st.builds(grid, st.integers(1, 12), st.integers(1, 12)),
    "fan": st.builds(fan, st.sampled_from([3, 4, 7, 64, 300])),
    "book": st.builds(book, st.integers(1, 26)),
    "tetrahedron": st.builds(tetrahedron),
    "cube": st.builds(cube),
    "sphere": st.builds(sphere, st.integers(0, 2)),
    "soup": st.builds(soup, st.integers(1, 40), _seeds, st.sampled_from([1, 3, 1000])),
    "tangle": st.builds(tangle, st.integers(3, 12), st.integers(1, 80), _seeds),
    "line": st.builds(line, st.integers(1, 10)),
    "stack": st.builds(stack, st.integers(1, 20)),
}
"""The shapes, before faces are flipped, repeated and shuffled and vertices moved."""


@st.composite
def mesh_of_kind(draw: st.DrawFn, kind: str, *, hostile: bool = True) -> Mesh:
    """A mesh of one of `KINDS`, disturbed; with `hostile` also with values and rows that cleaning drops."""
    positions, faces = draw(KINDS[kind])
    random = np.random.default_rng(draw(_seeds))
    faces = _disturb_faces(draw, random, faces)
    positions, faces = _renumber(draw, random, positions, faces)
    positions = _move(draw, random, positions)
    if hostile:
        positions, faces = _break(draw, random, positions, faces)
    return Mesh(positions, faces)


@st.composite
def meshes(draw: st.DrawFn, *, hostile: bool = True) -> Mesh:
    """Any mesh a file may hold, at least one face, at most `MOST_TRIANGLES` or a few more."""
    kinds = [draw(st.sampled_from(sorted(KINDS))) for _ in range(draw(st.integers(1, 2)))]
    parts = [draw(mesh_of_kind(kind, hostile=hostile)) for kind in kinds]
    offsets = np.cumsum([0, *(part.vertex_count for part in parts)])[:-1]
    faces = [part.faces + np.int32(offset) for part, offset in zip(parts, offsets, strict=True)]
    return Mesh(np.concatenate([part.positions for part in parts]), np.concatenate(faces)[:MOST_TRIANGLES])


@st.composite
def clean_meshes(draw: st.DrawFn) -> Mesh:
    """A mesh as cleaning hands it on: welded float32, every vertex used, no zero area, at least one face."""
    options = CleanOptions(drop_duplicates=draw(st.booleans()))
    cleaned = clean(draw(meshes(hostile=draw(st.booleans()))), options).mesh
    assume(cleaned.triangle_count > 0)
    return cleaned


def _disturb_faces(draw: st.DrawFn, random: np.random.Generator, faces: np.ndarray) -> np.ndarray:
    if draw(st.booleans()):
        flipped = random.random(len(faces)) < 0.3
        faces = np.where(flipped[:, None], faces[:, ::-1], faces)
    if draw(st.booleans()):
        again = faces[random.integers(0, len(faces), 1 + len(faces) // 4)]
        faces = np.concatenate([faces, np.roll(again, 1, axis=1)])
    if draw(st.booleans()):
        faces = faces[random.permutation(len(faces))]
    if draw(st.booleans()):
        turns = random.integers(0, 3, len(faces))[:, None]
        faces = np.take_along_axis(faces, (np.arange(3) + turns) % 3, axis=1)
    return faces


def _renumber(
    draw: st.DrawFn, random: np.random.Generator, positions: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    if not draw(st.booleans()):
        return positions, faces
    place = random.permutation(len(positions)).astype(np.int32)
    moved = np.zeros_like(positions)
    moved[place] = positions
    return moved, place[faces]


def _move(draw: st.DrawFn, random: np.random.Generator, positions: np.ndarray) -> np.ndarray:
    scale = draw(st.sampled_from([1.0, 1.0, 1e-8, 1e8, 0.1]))
    offset = draw(st.sampled_from([0.0, 0.0, 100.0, 1e4])) * scale
    positions = (positions.astype(np.float64) * scale + offset).astype(np.float32)
    if draw(st.booleans()):
        positions[(positions == 0) & (random.random(positions.shape) < 0.5)] = -0.0
    return positions


def _break(
    draw: st.DrawFn, random: np.random.Generator, positions: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    if draw(st.booleans()):
        bad = draw(st.sampled_from([np.nan, np.inf, -np.inf, 1e-45, 3e38]))
        positions = positions.copy()
        positions[random.integers(0, len(positions)), random.integers(0, 3)] = bad
    if draw(st.booleans()):
        faces = faces.copy()
        faces[random.integers(0, len(faces)), 0] = faces[random.integers(0, len(faces)), 1]
    if draw(st.booleans()):
        spare = positions[random.integers(0, len(positions), 3)]
        positions = np.concatenate([positions, spare])
    if draw(st.booleans()):
        # The same mesh unwelded, as an STL file would hold it.
        positions, faces = positions[faces.reshape(-1)], np.arange(faces.size, dtype=np.int32).reshape(-1, 3)
    return positions, faces
