"""The extremes as data: for each row what it is, why it is there, what is expected, and the meshes and rays.

What may be expected is written down before anything runs:

- `bound kept`: every answer is right within its bound, every certain hit is found;
- `clear error`: a `StriptoolsError` of one line says what is wrong;
- `documented limit`: some rays (`Case.outside`) or the mesh are beyond a limit that `Row.limit` states; they
  behave as it says, and all others keep the bound.

The triangle test `fast` may do one thing more where the first or the last is expected of it: `leaks`. Rays
slip through between two faces, and every answer is right within its bound but for that.

Shapes are made here and not taken from files, so that a row is the same everywhere.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from striptools.measure.aimed import Surface, aim
from striptools.mesh.clean import clean
from striptools.mesh.mesh import Mesh
from striptools.trace.rays import to_float32

Expected = Literal["bound kept", "clear error", "documented limit", "leaks"]
KEPT: Expected = "bound kept"
ERROR: Expected = "clear error"
LIMIT: Expected = "documented limit"
LEAKS: Expected = "leaks"

RAYS = 96
"""Rays a case, where a row has no rays of its own."""

RANDOM_MESHES = 200
QUICK_RANDOM_MESHES = 10
FEW_TRIANGLES = 1 << 17
"""More are too many for a quick run."""

LARGEST = float(np.finfo(np.float32).max)
DENORMAL = np.float32(1e-40)


@dataclass(frozen=True, eq=False)
class Known:
    """The answer to a case too large for the oracle: the only face that each ray may report, (r,) int32."""

    face: np.ndarray


@dataclass(frozen=True, eq=False)
class Case:
    """A mesh and the rays that are traced through it.

    Attributes:
        mesh: The source, as loaded.
        origins: (r, 3) float32.
        directions: (r, 3) float32.
        outside: (r,) bool, the rays beyond the row's limit; None for none.
        outside_misses: They have to miss; else they may answer anything that is finite.
        known: The answers, where every face cannot be tried for every ray.
        flushed: Some rays have denormal components, and are judged as the row's limit says: zeros for them.
        detail: Where above 0, the finest detail of a source in float64: what is rounded by more is beyond the
            row's limit.
    """

    mesh: Mesh
    origins: np.ndarray
    directions: np.ndarray
    outside: np.ndarray | None = None
    outside_misses: bool = True
    known: Known | None = None
    flushed: bool = False
    detail: float = 0.0


@dataclass(frozen=True)
class Row:
    """A row of the table.

    Attributes:
        name: What it is.
        why: What could go wrong.
        make: Cases; the argument says whether few and small ones will do.
        expected: The verdict where every bit of float32 is kept.
        on_grid: The verdict on a grid; None for the same.
        limit: The limit that is documented, where one is expected.
        large: Left out where only a quick run is asked for.
    """

    name: str
    why: str
    make: Callable[[bool], Iterable[Case]]
    expected: Expected = KEPT
    on_grid: Expected | None = None
    limit: str = ""
    large: bool = False

    def verdict(self, *, grid: bool) -> Expected:
        """What is expected, with or without a grid."""
        return self.on_grid if grid and self.on_grid is not None else self.expected


# ---- Shapes and rays.


def mesh_of(positions: np.ndarray, faces: np.ndarray) -> Mesh:
    """A mesh of float32 positions."""
    return Mesh(to_float32(np.asarray(positions)), np.asarray(faces, np.int32))


def ball(rings: int = 8, sectors: int = 12) -> Mesh:
    """A closed ball of radius 1 without a pole on an axis of symmetry of the rays."""
    polar = np.pi * np.arange(1, rings) / rings
    turn = 2 * np.pi * np.arange(sectors) / sectors
    around = np.stack(
        [
            np.sin(polar)[:, None] * np.cos(turn),
            np.sin(polar)[:, None] * np.sin(turn),
            np.broadcast_to(np.cos(polar)[:, None], (rings - 1, sectors)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    positions = np.concatenate([around, [[0, 0, 1], [0, 0, -1]]])
    north, south = len(around), len(around) + 1
    k = np.arange(sectors)
    nxt = (k + 1) % sectors
    faces = [np.stack([np.full(sectors, north), k, nxt], 1)]
    for ring in range(rings - 2):
        a, b = ring * sectors, (ring + 1) * sectors
        faces += [np.stack([a + k, b + k, b + nxt], 1), np.stack([a + k, b + nxt, a + nxt], 1)]
    last = (rings - 2) * sectors
    faces.append(np.stack([last + k, np.full(sectors, south), last + nxt], 1))
    return mesh_of(positions, np.concatenate(faces))


def moved(mesh: Mesh, scale: float, offset: float = 0.0, *, double: bool = False) -> Mesh:
    """A mesh scaled and then moved along all axes, in float32 or float64."""
    positions = mesh.positions.astype(np.float64) * scale + offset * np.array([1.0, 0.7, -0.4])
    return replace(mesh, positions=positions if double else to_float32(positions))


def soup(triangles: int, seed: int, spread: float = 1.0) -> Mesh:
    """Triangles at random, each smaller than the place they are strewn over by `spread`."""
    random = np.random.default_rng(seed)
    middle = random.normal(size=(triangles, 1, 3)) * spread
    positions = (middle + random.normal(size=(triangles, 3, 3))).reshape(-1, 3)
    return mesh_of(positions, np.arange(3 * triangles).reshape(-1, 3))


def plane_of(columns: int, rows: int) -> Mesh:
    """A flat grid of unit squares at z = 0, two triangles each: square (i, j) has faces 2 (i + columns j)."""
    x, y = np.meshgrid(np.arange(columns + 1, dtype=np.float32), np.arange(rows + 1, dtype=np.float32))
    positions = np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
    corner = (np.arange(rows, dtype=np.int32)[:, None] * (columns + 1) + np.arange(columns)).reshape(-1)
    one = np.stack([corner, corner + 1, corner + columns + 1], axis=1)
    two = np.stack([corner + 1, corner + columns + 2, corner + columns + 1], axis=1)
    return Mesh(positions, np.stack([one, two], axis=1).reshape(-1, 3).astype(np.int32))


def needles(count: int, aspect: float, seed: int, *, cap: bool) -> Mesh:
    """Triangles of length 1 and height 1 / aspect: needles, or caps whose apex is above the long edge."""
    random = np.random.default_rng(seed)
    a = random.normal(size=(count, 3)) * 0.5
    along, aside = random.normal(size=(2, count, 3))
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    apex = a + along * (0.5 if cap else 1.0) + aside / aspect
    positions = np.stack([a, a + along, apex], axis=1).reshape(-1, 3)
    return mesh_of(positions, np.arange(3 * count).reshape(-1, 3))


def slivers_at_zero(count: int, seed: int) -> Mesh:
    """Slivers of aspect 1e9 that float32 can hold: a corner on the zero of an axis, where it is finest."""
    random = np.random.default_rng(seed)
    length, height = random.uniform(0.5, 1, count), random.uniform(0.5, 1, count) * 1e-9
    place, zero = random.uniform(-1, 1, count), np.zeros(count)
    corners = [(zero, zero, place), (length, zero, place), (length * random.random(count), height, place)]
    positions = np.stack([np.stack(corner, axis=1) for corner in corners], axis=1).reshape(-1, 3)
    return mesh_of(positions, np.arange(3 * count).reshape(-1, 3))


def fan(blades: int) -> Mesh:
    """Faces round one vertex, on a cone."""
    turn = 2 * np.pi * np.arange(blades) / blades
    rim = np.stack([np.cos(turn), np.sin(turn), np.full(blades, 0.5)], axis=1)
    k = np.arange(blades)
    return mesh_of(np.concatenate([[[0, 0, 0]], rim]), np.stack([0 * k, 1 + k, 1 + (k + 1) % blades], 1))


def copies_of_one(count: int) -> Mesh:
    """One triangle many times over, on the same vertices."""
    return mesh_of(
        np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.tile(np.array([[0, 1, 2]], np.int32), (count, 1))
    )


def joined(*meshes: Mesh) -> Mesh:
    """Meshes side by side in one."""
    starts = np.cumsum([0, *(mesh.vertex_count for mesh in meshes)])
    faces = [mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([m.positions for m in meshes]), np.concatenate(faces).astype(np.int32))


def aimed_at(mesh: Mesh, count: int = RAYS, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rays at points inside faces, at middles of edges and at vertices of what cleaning keeps, in turn."""
    kept = clean(mesh).mesh
    random = np.random.default_rng(seed)
    if kept.triangle_count == 0:
        return random.normal(size=(2, count, 3)).astype(np.float32)[0], np.ones((count, 3), np.float32)
    surface = Surface(kept.positions, kept.faces)
    share = count // 3
    edges = surface.edges[random.integers(0, len(surface.edges), share)]
    places = random.integers(0, len(surface.vertices), share)
    faces = random.integers(0, kept.triangle_count, count - 2 * share)
    weights = random.dirichlet([1.0, 1.0, 1.0], len(faces))[:, :, None]
    targets = [
        (kept.positions[kept.faces[faces]] * weights).sum(axis=1),
        surface.edge_midpoints(edges),
        surface.positions[surface.vertices[places]].astype(np.float64),
    ]
    normals = surface.normals_at(np.concatenate([3 * faces, edges, surface.corner_at(places)]))
    bounds = np.array([kept.positions.min(axis=0), kept.positions.max(axis=0)], np.float64)
    return aim(np.concatenate(targets), normals, bounds, random)


def aimed_case(mesh: Mesh, seed: int = 0, count: int = RAYS) -> Case:
    """A mesh and rays at it."""
    return Case(mesh, *aimed_at(mesh, count, seed))


def from_afar(mesh: Mesh, distance: float, seed: int = 0) -> Case:
    """Rays at a mesh from so many diagonals away."""
    random = np.random.default_rng(seed)
    targets = mesh.positions[mesh.faces].mean(axis=1).astype(np.float64)
    targets = targets[random.integers(0, len(targets), RAYS)]
    way = random.normal(size=targets.shape)
    origins = to_float32(targets + way * (distance * mesh_diagonal(mesh)))
    return Case(mesh, origins, to_float32(targets - origins))


def mesh_diagonal(mesh: Mesh) -> float:
    """The length of a mesh's bounding box, in float64."""
    low, high = mesh.bounds.astype(np.float64)
    return float(np.linalg.norm(high - low))


# ---- Rows of one kind each.


def _meshes(*makers: Callable[[], Mesh]) -> Callable[[bool], Iterator[Case]]:
    def make(quick: bool) -> Iterator[Case]:
        yield from (aimed_case(maker()) for maker in makers)

    return make


def _with_directions(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[bool], Iterator[Case]]:
    """A ball and rays whose directions are changed; origins such that rays still go through the targets."""

    def make(quick: bool) -> Iterator[Case]:
        case = aimed_case(ball())
        with np.errstate(over="ignore"):
            yield replace(case, directions=change(case.directions))

    return make


def _axis_rays(quick: bool) -> Iterator[Case]:
    for mesh in (ball(), plane_of(6, 5)):
        for axis in range(3):
            for sign in (1.0, -1.0):
                for zero in (0.0, -0.0, float(DENORMAL), -float(DENORMAL)):
                    yield _along_axis(mesh, axis, sign, zero)


def _along_axis(mesh: Mesh, axis: int, sign: float, zero: float) -> Case:
    """Rays along an axis through vertices and between them, with a zero of each kind on the others."""
    targets = mesh.positions[::3].astype(np.float32)
    between = mesh.positions[mesh.faces].mean(axis=1).astype(np.float32)[::5]
    origins = np.concatenate([targets, between])
    origins[:, axis] = -3.0 * sign
    directions = np.full_like(origins, zero)
    directions[:, axis] = sign
    return Case(mesh, origins, directions)


def _planet(quick: bool) -> Iterator[Case]:
    mesh = moved(ball(24, 48), 6.371e6, double=True)
    mesh.positions[:] += np.random.default_rng(0).uniform(-1e-3, 1e-3, mesh.positions.shape)
    yield replace(aimed_case(mesh), detail=1e-3)


def _survey(quick: bool) -> Iterator[Case]:
    """A patch of terrain of 100 m with detail of a millimetre, on the surface of a planet."""
    random = np.random.default_rng(1)
    plane = plane_of(20, 20)
    positions = plane.positions * 5.0 + random.uniform(-1e-3, 1e-3, plane.positions.shape)
    positions = positions + np.array([3.1e6, 4.2e6, 3.6e6])
    mesh = Mesh(positions, plane.faces)
    about = clean(mesh)
    yield replace(Case(mesh, *aimed_at(about.mesh)), detail=1e-3)


def _far_double(quick: bool) -> Iterator[Case]:
    for power in (4, 8):
        mesh = moved(ball(), 1.0, 3.5 * 10.0**power, double=True)
        yield Case(mesh, *aimed_at(clean(mesh).mesh))


def _on_the_surface(quick: bool) -> Iterator[Case]:
    """Origins exactly on faces (of coordinates that float32 holds), on edges and on vertices."""
    random = np.random.default_rng(2)
    for mesh in (plane_of(4, 4), ball(), joined(plane_of(4, 4), moved(plane_of(4, 4), 1.0, 1.0))):
        corners = mesh.positions[mesh.faces].astype(np.float64)
        pick = random.integers(0, len(corners), RAYS)
        weights = np.array([[0.25, 0.25, 0.5], [0.5, 0.5, 0.0], [1.0, 0.0, 0.0]])[np.arange(RAYS) % 3]
        origins = to_float32((corners[pick] * weights[:, :, None]).sum(axis=1))
        directions = random.normal(size=(RAYS, 3)).astype(np.float32)
        directions[::4] *= np.array([1, 1, 0], np.float32)  # along the surface
        yield Case(mesh, origins, directions)


def _flat_boxes(quick: bool) -> Iterator[Case]:
    """Rays from inside boxes of no thickness, and along their planes."""
    for axis in range(3):
        mesh = plane_of(5, 5)
        mesh = replace(mesh, positions=np.ascontiguousarray(np.roll(mesh.positions, axis, axis=1)))
        case = aimed_case(mesh)
        origins = case.origins.copy()
        origins[:, (2 + axis) % 3] = 0.0
        yield Case(mesh, origins, case.directions)
        level = case.directions.copy()
        level[:, (2 + axis) % 3] = 0.0
        level[~level.any(axis=1), axis] = 1.0
        yield Case(mesh, origins, level)


def _grazing(quick: bool) -> Iterator[Case]:
    """Rays that meet a plane at 1e-7 rad, at places that float32 holds."""
    random = np.random.default_rng(4)
    plane = plane_of(8, 8)
    turn = random.uniform(0, 2 * np.pi, RAYS)
    height = random.uniform(0.5, 1, RAYS) * 4e-7
    targets = random.uniform(1, 7, (RAYS, 2))
    origins = np.stack([targets[:, 0] - 4 * np.cos(turn), targets[:, 1] - 4 * np.sin(turn), height], axis=1)
    directions = np.stack([np.cos(turn), np.sin(turn), -height / 4], axis=1)
    yield Case(plane, to_float32(origins), to_float32(directions))
    yield Case(moved(ball(16, 24), 1.0), *_tangents(ball(16, 24), random))


def _tangents(mesh: Mesh, random: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    corners = mesh.positions[mesh.faces[random.integers(0, mesh.triangle_count, RAYS)]].astype(np.float64)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    along = corners[:, 1] - corners[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    middle = corners.mean(axis=1)
    return to_float32(middle - along + normals * 1e-7), to_float32(along - normals * 1e-7)


def _large_t(quick: bool) -> Iterator[Case]:
    """Hits at t up to 1e38."""
    case = aimed_case(moved(ball(), 1e15))
    longest = np.abs(case.directions).max(axis=1, keepdims=True)
    yield replace(case, directions=(case.directions / longest * np.float32(1e-22)).astype(np.float32))


def _denormal_components(quick: bool) -> Iterator[Case]:
    """Directions of length 1e-36, with denormals among their components, and origins of which some are."""
    case = aimed_case(ball())
    yield replace(case, directions=(case.directions * np.float32(1e-36)).astype(np.float32), flushed=True)
    yield replace(aimed_case(moved(ball(), 1e-37)), flushed=True)


def _t_underflows(quick: bool) -> Iterator[Case]:
    case = aimed_case(ball())
    largest = np.abs(case.directions).max(axis=1, keepdims=True)
    yield replace(case, directions=(case.directions / largest * np.float32(3e38)).astype(np.float32))


def _t_overflows(quick: bool) -> Iterator[Case]:
    """Hits at t beyond float32: 1e4 units away along directions of length 1e-37."""
    mesh = moved(ball(), 1e3)
    case = from_afar(mesh, 10.0)
    longest = np.abs(case.directions).max(axis=1, keepdims=True)
    yield replace(
        case, directions=(case.directions / longest * np.float32(2e-38)).astype(np.float32), flushed=True
    )


def _no_rays(quick: bool) -> Iterator[Case]:
    """Every third ray is none."""
    case = aimed_case(ball())
    bad = np.arange(RAYS) % 3 == 0
    values = np.array([np.nan, np.inf, -np.inf], np.float32)[np.arange(RAYS) // 3 % 3]
    for column in range(6):
        rays = np.concatenate([case.origins, case.directions], axis=1)
        rays[bad, column] = values[bad]
        yield replace(
            case,
            origins=np.ascontiguousarray(rays[:, :3]),
            directions=np.ascontiguousarray(rays[:, 3:]),
            outside=bad,
        )


def _zero_directions(quick: bool) -> Iterator[Case]:
    case = aimed_case(ball())
    bad = np.arange(RAYS) % 3 == 0
    for value in (0.0, -0.0):
        directions = case.directions.copy()
        directions[bad] = value
        yield replace(case, directions=directions, outside=bad)


def _denormal_directions(quick: bool) -> Iterator[Case]:
    case = aimed_case(ball())
    bad = np.arange(RAYS) % 3 == 0
    directions = case.directions.copy()
    directions[bad] *= DENORMAL
    yield replace(case, directions=directions, outside=bad)


def _far_beyond(quick: bool) -> Iterator[Case]:
    """Origins so far away that float32's products overflow."""
    case = from_afar(ball(), 1.0)
    for distance in (1e14, 1e25, 1e37):
        way = case.origins / np.linalg.norm(case.origins, axis=1, keepdims=True)
        origins = to_float32(way * distance)
        outside = np.ones(RAYS, bool)
        yield Case(case.mesh, origins, -way, outside=outside, outside_misses=False)


def _bad_vertices(quick: bool) -> Iterator[Case]:
    for value in (np.nan, np.inf, -np.inf):
        mesh = ball()
        mesh.positions[np.arange(0, mesh.vertex_count, 7), 1] = value
        yield aimed_case(mesh)


def _all_bad(quick: bool) -> Iterator[Case]:
    mesh = ball()
    mesh.positions[:] = np.nan
    yield aimed_case(mesh)


def _random(quick: bool) -> Iterator[Case]:
    for seed in range(QUICK_RANDOM_MESHES if quick else RANDOM_MESHES):
        yield aimed_case(random_mesh(seed), seed)


def random_mesh(seed: int) -> Mesh:
    """One of many kinds of mesh, somewhere between 1e-6 and 1e6 in size, up to 100 diagonals off."""
    random = np.random.default_rng(seed)
    kinds: tuple[Callable[[], Mesh], ...] = (
        lambda: ball(int(random.integers(3, 14)), int(random.integers(3, 20))),
        lambda: soup(int(random.integers(1, 200)), seed, float(random.choice([0.0, 1.0, 10.0]))),
        lambda: plane_of(int(random.integers(1, 12)), int(random.integers(1, 12))),
        lambda: needles(int(random.integers(1, 60)), 10.0 ** random.uniform(1, 5), seed, cap=seed % 2 == 0),
        lambda: fan(int(random.integers(3, 200))),
        lambda: joined(ball(), moved(ball(), 0.5), soup(20, seed)),
    )
    shape = kinds[seed % len(kinds)]()
    scale = 10.0 ** random.uniform(-6, 6)
    return moved(shape, scale, scale * float(random.choice([0.0, 0.0, 1.0, 100.0])))


def _coincident(quick: bool) -> Iterator[Case]:
    one = ball()
    yield aimed_case(Mesh(one.positions, np.concatenate([one.faces, one.faces, one.faces[:, ::-1]])))
    yield aimed_case(Mesh(one.positions, np.concatenate([one.faces, np.roll(one.faces, 1, axis=1)])))
    shifted = moved(plane_of(4, 4), 1.0)
    shifted.positions[:, :2] += np.float32(0.5)
    yield aimed_case(joined(plane_of(4, 4), shifted))


def _fan(quick: bool) -> Iterator[Case]:
    """A hub of very many faces: rays through it, and some beside it."""
    mesh = fan(2_000 if quick else 100_000)
    case = aimed_case(mesh, count=24)
    hub = np.array([[0, 0, 0]] * 4, np.float32)
    origins = np.array([[0.1, 0.2, 3], [0, 0, 2], [0, 0, -2], [-0.3, 0.1, -1]], np.float32)
    yield Case(
        mesh, np.concatenate([origins, case.origins]), np.concatenate([hub - origins, case.directions])
    )


def _one_triangle(quick: bool) -> Iterator[Case]:
    yield aimed_case(copies_of_one(1))
    for seed in range(4):
        yield aimed_case(soup(1, seed), seed)


def _copies(quick: bool) -> Iterator[Case]:
    """One triangle a million times: the least face of all that tie."""
    mesh = copies_of_one(3_000 if quick else 1_000_000)
    origins = np.array([[0.25, 0.25, 1], [0.25, 0.5, -2], [2, 2, 1], [0.1, 0.1, 5]], np.float32)
    directions = np.array([[0, 0, -1], [0, 0, 1], [0, 0, -1], [0.01, 0, -1]], np.float32)
    yield Case(mesh, origins, directions, known=Known(np.array([0, 0, -1, 0], np.int32)))


def _counts(count: int, *more: int) -> Callable[[bool], Iterator[Case]]:
    """Planes of a number of triangles, and of some more or fewer."""

    def make(quick: bool) -> Iterator[Case]:
        size = count >> 8 if quick and count > FEW_TRIANGLES else count
        yield from (plane_case(size + one) for one in more)

    return make


def plane_case(triangles: int) -> Case:
    """A plane of exactly so many triangles, with rays at its middle and its last ones, the answers known."""
    columns = 1 << (max(triangles, 4).bit_length() // 2 - 1)
    mesh = plane_of(columns, -(-triangles // (2 * columns)))
    mesh = Mesh(mesh.positions, mesh.faces[:triangles])
    random = np.random.default_rng(triangles)
    face = np.concatenate([random.integers(0, triangles, 28), [0, 1, triangles - 2, triangles - 1]])
    middle = mesh.positions[mesh.faces[face]].astype(np.float64).mean(axis=1)
    origins = to_float32(middle + np.array([0.0, 0.0, 4.0]))
    directions = np.tile(np.array([[0, 0, -1]], np.float32), (len(face), 1))
    return Case(mesh, origins, directions, known=Known(face.astype(np.int32)))


def _worst_of_a_grid(quick: bool) -> Iterator[Case]:
    """A face that a grid moves by nearly all it may, along its normal: t errs by D over the cosine."""
    unit = np.array([1.0, 1.0, 1.0]) * (0.5 - 2.0**-8)
    steps = np.array([[30000, 100, 0], [100, 30000, 0], [100, 100, 29900]], np.float64)
    frame = np.array([[0, 0, 0], [65535, 0, 0], [0, 65535, 0], [0, 0, 65535]], np.float64)
    faces = [[0, 1, 2], [3, 4, 5], [3, 5, 6], [3, 4, 6]]
    mesh = mesh_of(np.concatenate([steps + unit, frame]), np.array(faces))
    middle = steps.mean(axis=0) + unit
    ways = np.random.default_rng(5).normal(size=(RAYS, 3)) * 0.2 + 1.0
    yield Case(mesh, to_float32(middle + ways * 1000), to_float32(-ways))


def _scaled(power: int) -> Row:
    return Row(
        f"scale 1e{power:+d}",
        "units: products of coordinates overflow or underflow",
        _meshes(lambda: moved(ball(), 10.0**power), lambda: moved(soup(40, 3), 10.0**power)),
    )


def _off(power: int) -> Row:
    return Row(
        f"offset 1e{power} diagonals, float32",
        "coordinates cancel: few bits are left of the shape",
        _meshes(lambda: moved(ball(), 1.0, 3.5 * 10.0**power)),
    )


FLUSHED = "components below 2^-126 count as zero"
END_OF_RANGE = "a t, or unit of t, beyond float32's normal range is told at the end of the range"
TOO_SHORT = "a direction whose components are all below 2^-126 counts as zero, and hits nothing"
NO_RAY = "a ray with a component that is not finite, or with a direction of zero, hits nothing"

ROWS: tuple[Row, ...] = (
    *(_scaled(power) for power in (-30, -20, -10, -5, 5, 10, 20, 30)),
    Row(
        "scale 1e-37, and short directions",
        "some components are denormal",
        _denormal_components,
        expected=LIMIT,
        limit=FLUSHED,
    ),
    Row("scale 3e38", "extents overflow", _meshes(lambda: moved(ball(), 3e38))),
    *(_off(power) for power in (2, 4, 6)),
    Row(
        "offset 1e8 diagonals, float32",
        "float32 holds nothing of the shape",
        _meshes(lambda: moved(ball(), 1.0, 3.5e8)),
        expected=ERROR,
    ),
    Row("offset 1e4 and 1e8 diagonals, float64", "positions get an origin of their own", _far_double),
    Row(
        "planet with millimetres",
        "float64 detail finer than float32 has at that size",
        _planet,
        expected=LIMIT,
        limit="positions are float32; what rounding changes is told by Report.largest_rounding",
    ),
    Row("survey on a planet", "float64 detail far from zero", _survey),
    Row(
        "denormal coordinates", "XLA flushes denormals", _meshes(lambda: moved(ball(), 1e-40)), expected=ERROR
    ),
    Row(
        "some denormal coordinates",
        "a coordinate that is flushed beside ones that are not",
        _meshes(lambda: joined(ball(), moved(ball(), 1e-40))),
    ),
    Row(
        "slivers of aspect 1e9",
        "areas of nothing but rounding",
        _meshes(lambda: slivers_at_zero(60, 0)),
        on_grid=ERROR,
    ),
    Row(
        "needles of aspect 1e6",
        "signs of noise",
        _meshes(lambda: needles(80, 1e6, 1, cap=False)),
        on_grid=ERROR,
    ),
    Row("caps of aspect 1e6", "signs of noise", _meshes(lambda: needles(80, 1e6, 2, cap=True))),
    Row("needles of aspect 1e3", "thin, and certain", _meshes(lambda: needles(80, 1e3, 3, cap=False))),
    Row("coincident, coplanar and duplicate faces", "ties: the least face", _coincident),
    Row("fan of 1e5 faces at a vertex", "a hub's rays have as many candidates", _fan),
    Row("axis rays, -0.0 and denormals", "0 * inf, and the sides of boxes", _axis_rays),
    Row("huge directions", "lengths overflow", _with_directions(lambda d: d * np.float32(1e35))),
    Row("t below 2^-126", "t underflows", _t_underflows, expected=LIMIT, limit=END_OF_RANGE),
    Row("short directions", "lengths underflow", _with_directions(lambda d: d * np.float32(1e-30))),
    Row("zero directions", "0 / 0", _zero_directions, expected=LIMIT, limit=NO_RAY),
    Row("denormal directions", "flushed to zero", _denormal_directions, expected=LIMIT, limit=TOO_SHORT),
    Row("origins on faces, edges, vertices", "t = 0, and signs of zero", _on_the_surface),
    Row("origins in flat boxes", "slabs of no thickness", _flat_boxes),
    Row("rays grazing at 1e-7 rad", "1 / cos", _grazing),
    Row("t up to 1e38", "t near overflow", _large_t),
    Row(
        "t beyond float32",
        "t overflows",
        _t_overflows,
        expected=LIMIT,
        limit=END_OF_RANGE,
    ),
    *(
        Row(f"origins 1e{power} diagonals away", "the bound grows with the distance", make)
        for power, make in (
            (4, lambda quick: [from_afar(ball(), 1e4)]),
            (7, lambda q: [from_afar(ball(), 1e7)]),
        )
    ),
    Row(
        "origins 1e14 to 1e37 away",
        "products overflow",
        _far_beyond,
        expected=LIMIT,
        limit="beyond 2^40 times the scene's reach nothing is certain; answers are finite",
    ),
    Row("NaN and Inf in rays", "they spread", _no_rays, expected=LIMIT, limit=NO_RAY),
    Row("NaN and Inf in vertices", "faces with them are dropped and counted", _bad_vertices),
    Row("nothing but NaN", "no face is left", _all_bad, expected=ERROR),
    Row(
        "empty mesh",
        "no face at all",
        lambda quick: [
            Case(Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)), *aimed_at(ball()))
        ],
        expected=ERROR,
    ),
    Row("one triangle", "the least tree", _one_triangle),
    Row("one triangle a million times", "all boxes equal, all hits tie", _copies),
    Row("255 to 257 triangles", "the end of a block", _counts(256, -1, 0, 1)),
    Row("2^16 triangles, and one more or fewer", "16-bit counts", _counts(1 << 16, -1, 0, 1)),
    Row(
        "2^24 triangles, and one more",
        "24-bit counts, and float32's integers",
        _counts(1 << 24, 0, 1),
        large=True,
    ),
    Row("worst case of a grid", "every corner moves along the normal by the bound", _worst_of_a_grid),
    Row("random meshes", "everything else", _random),
)
