"""The oracle against all pairs; the float32 bound against a float32 tracer; unions at edges and vertices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis import strategies as st
from oracles import float32_woop, moller_trumbore
from strategies import cube, fan, grid, meshes, sphere, stack, tetrahedron

from striptools.measure.aimed import Fans, Surface, aim, judge_fans
from striptools.measure.bound import frame_rays, gamma, judge_pairs
from striptools.measure.oracle import Oracle, OracleHits
from striptools.mesh.mesh import Mesh

CLOSED = [tetrahedron(), cube(), sphere(0), sphere(2)]
seeds = st.integers(0, 2**32 - 1)


def rays_at(mesh: Mesh, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays at corners, edge midpoints and insides of faces, along axes, and at nothing."""
    random = np.random.default_rng(seed)
    positions = np.asarray(mesh.positions, np.float64)
    finite = np.abs(positions[np.isfinite(positions).all(axis=1)])
    size = float(np.abs(finite[finite < 1e12]).max(initial=1e-8)) or 1.0
    corners = np.nan_to_num(
        positions[mesh.faces[random.integers(0, len(mesh.faces), count)]], posinf=0, neginf=0
    )
    weights = np.array([[1, 0, 0], [0.5, 0.5, 0], [0.2, 0.3, 0.5], [1.5, -0.2, -0.3]])[np.arange(count) % 4]
    with np.errstate(over="ignore", invalid="ignore"):
        targets = (weights[:, :, None] * corners).sum(axis=1)
        origins = (targets + random.normal(size=(count, 3)) * size * 2).astype(np.float32)
        directions = (targets - origins).astype(np.float32)
        aims = targets.astype(np.float32)
    along = np.flatnonzero(np.arange(count) % 5 == 0)
    axis = random.integers(0, 3, len(along))
    directions[along] = 0
    directions[along, axis] = np.where(random.random(len(along)) < 0.5, 1, -1)
    origins[along] = aims[along]
    origins[along, axis] -= directions[along, axis] * np.float32(size)
    return origins, directions


def judge_all_pairs(mesh: Mesh, origins: np.ndarray, directions: np.ndarray) -> list[tuple[int, int, float]]:
    """(ray, face, t) of every possible or exact hit, without the vertex codes."""
    oracle = Oracle(mesh)
    frames = frame_rays(origins, directions)
    finite = np.flatnonzero(np.isfinite(oracle.positions[mesh.faces]).all(axis=(1, 2)))
    found = []
    for ray in range(len(origins)):
        pairs = oracle.judge(frames, np.full(len(finite), ray), finite)
        for index in np.flatnonzero(pairs.possible | pairs.inside):
            found.append((ray, int(finite[index]), float(pairs.t[index])))
    return sorted(found, key=lambda row: (row[0], row[2], row[1]))


class TestOracle:
    @given(meshes(), st.integers(1, 40), seeds)
    @limits(max_examples=40)
    def test_the_codes_rule_out_nothing_possible(self, mesh: Mesh, count: int, seed: int) -> None:
        origins, directions = rays_at(mesh, count, seed)
        found = Oracle(mesh).closest_hit(origins, directions).candidates
        fast = list(zip(found.ray.tolist(), found.face.tolist(), found.pairs.t.tolist(), strict=True))
        assert fast == judge_all_pairs(mesh, origins, directions)

    @given(meshes(hostile=False), seeds)
    @limits(max_examples=40)
    def test_it_agrees_with_another_test_of_all_pairs(self, mesh: Mesh, seed: int) -> None:
        origins, directions = rays_at(mesh, 24, seed)
        ours = Oracle(mesh).closest_hit(origins, directions)
        times, _ = moller_trumbore(mesh, origins, directions)
        for ray in np.flatnonzero(~uncertain_rays(ours)):
            assert np.isfinite(ours.t[ray]) == np.isfinite(times[ray])
            assert ours.t[ray] == pytest.approx(times[ray], rel=1e-6)

    def test_equal_faces_tie_to_the_least(self) -> None:
        mesh = Mesh(*stack(9))
        hits = Oracle(mesh).closest_hit(np.array([[0.2, 0.2, 1]]), np.array([[0, 0, -1]]))
        assert hits.face.tolist() == [0]
        assert hits.t[0] == 1
        assert (hits.u[0], hits.v[0]) == pytest.approx((0.2, 0.2))

    def test_rays_without_direction_or_with_nan_miss(self) -> None:
        mesh = Mesh(*cube())
        origins = np.array([[0.5, 0.4, 3], [np.nan, 0, 0], [0.5, 0.4, 3], [0.5, 0.4, 3]], np.float32)
        directions = np.array([[0, 0, 0], [0, 0, -1], [0, np.inf, 0], [0, 0, -1]], np.float32)
        assert (Oracle(mesh).closest_hit(origins, directions).face >= 0).tolist() == [
            False,
            False,
            False,
            True,
        ]

    def test_no_rays_and_no_faces(self) -> None:
        empty = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
        assert Oracle(Mesh(*cube())).closest_hit(np.zeros((0, 3)), np.zeros((0, 3))).t.shape == (0,)
        assert Oracle(empty).closest_hit(np.zeros((2, 3)), np.ones((2, 3))).face.tolist() == [-1, -1]

    def test_progress_adds_up(self) -> None:
        steps: list[int] = []
        origins, directions = rays_at(Mesh(*cube()), 50, 1)
        Oracle(Mesh(*cube())).closest_hit(origins, directions, steps.append)
        assert sum(steps) == 50


def uncertain_rays(hits: OracleHits) -> np.ndarray:
    doubt = ~hits.candidates.pairs.certain
    return np.bincount(hits.candidates.ray[doubt], minlength=len(hits.t)) > 0


class TestBound:
    @given(meshes(hostile=False), seeds, st.booleans())
    @limits(max_examples=60)
    def test_no_float32_test_strays_beyond_it(self, mesh: Mesh, seed: int, reciprocal: bool) -> None:
        origins, directions = rays_at(mesh, 24, seed)
        corners = np.asarray(mesh.positions, np.float32)[mesh.faces]
        frames = frame_rays(origins, directions)
        for ray in np.flatnonzero(frames.valid):
            pairs = judge_pairs(frames, np.full(len(corners), ray), corners.astype(np.float64))
            accepted, t, u, v = float32_woop(corners, origins[ray], directions[ray], reciprocal=reciprocal)
            assert not (pairs.certain & ~accepted).any()
            clear = accepted & (pairs.side != 0)
            assert pairs.possible[clear].all()
            assert (np.abs(t - pairs.t)[clear] <= pairs.t_bound[clear]).all()
            assert (u[clear] >= 0).all()
            assert (v[clear] >= 0).all()

    def test_it_is_not_loose(self) -> None:
        positions, faces = sphere(2)
        origins, directions = rays_at(Mesh(positions, faces), 400, 3)
        frames = frame_rays(origins, directions)
        ratios = []
        for ray in range(len(origins)):
            pairs = judge_pairs(frames, np.full(len(faces), ray), positions[faces].astype(np.float64))
            accepted, t, _, _ = float32_woop(positions[faces], origins[ray], directions[ray], reciprocal=True)
            ratios += (np.abs(t - pairs.t) / pairs.t_bound)[accepted & pairs.certain].tolist()
        assert 0.05 < max(ratios) < 1

    def test_it_grows_as_the_ray_grazes(self) -> None:
        corners = np.array([[[-1, -1, 0], [1, -1, 0], [0, 1, 0]]], np.float64)
        bounds = []
        for slant in (0.0, 10.0, 1000.0):
            direction = np.array([[slant, 0, -1]], np.float32)
            origin = -direction
            bounds.append(judge_pairs(frame_rays(origin, direction), np.zeros(1, int), corners).t_bound[0])
        assert bounds[0] < bounds[1] < bounds[2]

    def test_a_bound_on_positions_widens_it(self) -> None:
        corners = np.array([[[0, 0, 0], [1, 0, 0], [0, 1, 0]]], np.float64)
        frames = frame_rays(np.array([[0.3, -0.001, 1]]), np.array([[0, 0, -1]]))
        exact = judge_pairs(frames, np.zeros(1, int), corners)
        moved = judge_pairs(frames, np.zeros(1, int), corners, 0.01)
        assert not exact.possible[0]
        assert moved.possible[0]
        assert moved.t_bound[0] >= 0.01

    def test_nothing_is_certain_where_float32_overflows(self) -> None:
        corners = np.array([[[0, 0, 0], [1e20, 0, 0], [0, 1e20, 0]]], np.float64)
        frames = frame_rays(np.array([[1e19, 1e19, 1e19]]), np.array([[0, 0, -1]]))
        pairs = judge_pairs(frames, np.zeros(1, int), corners)
        assert not pairs.certain[0]
        assert pairs.possible[0]

    def test_gamma(self) -> None:
        assert gamma(7) == pytest.approx(7 * 2.0**-24, rel=1e-6)


def closest_float32(surface: Surface, origin: np.ndarray, direction: np.ndarray) -> float:
    accepted, t, _, _ = float32_woop(surface.corners.astype(np.float32), origin, direction, reciprocal=False)
    return float(t[accepted].min(initial=np.inf))


class TestAimed:
    @pytest.mark.parametrize("index", range(len(CLOSED)))
    def test_a_certain_ray_hits_in_float32(self, index: int) -> None:
        positions, faces = CLOSED[index]
        for scale, shift in ((1.0, 0.0), (1e-3, 0.1), (1e3, 1e5)):
            moved = (positions * scale + shift).astype(np.float32)
            surface = Surface(moved, faces)
            bounds = np.stack([moved.min(axis=0), moved.max(axis=0)]).astype(np.float64)
            for rays, fans in aimed(surface, bounds, 300, seed=index):
                verdicts = judge_fans(frame_rays(*rays), surface, fans)
                for ray in np.flatnonzero(verdicts.certain):
                    assert closest_float32(surface, rays[0][ray], rays[1][ray]) <= verdicts.farthest[ray]

    def test_most_rays_at_a_sphere_are_certain(self) -> None:
        surface = Surface(*sphere(2))
        for rays, fans in aimed(surface, np.array([[-1.0] * 3, [1.0] * 3]), 400, seed=7):
            assert judge_fans(frame_rays(*rays), surface, fans).certain.mean() > 0.7

    def test_nothing_is_certain_at_a_border(self) -> None:
        positions, faces = grid(3, 3)
        surface = Surface(positions, faces)
        assert not surface.closed
        border = surface.edges[surface.twin[surface.edges] < 0]
        assert len(border) == surface.open_edges == 12
        fans = surface.edge_fans(border)
        assert fans.starts[-1] == 0
        targets = surface.edge_midpoints(border)
        origins, directions = aim(targets, surface.normals_at(border), surface_bounds(positions), rng(0))
        assert not judge_fans(frame_rays(origins, directions), surface, fans).certain.any()

    def test_a_fan_of_many_blades_is_certain_at_its_hub(self) -> None:
        positions, faces = fan(300)
        positions[0, 2] = 0.5
        surface = Surface(positions, faces)
        hub = np.searchsorted(surface.vertices, 0)
        fans = surface.vertex_fans(np.array([hub]))
        assert len(fans.face) == 300
        frames = frame_rays(np.array([[0, 0, 5]]), np.array([[0, 0, -1]]))
        verdicts = judge_fans(frames, surface, fans)
        assert verdicts.certain[0]
        assert verdicts.farthest[0] == pytest.approx(4.5, rel=1e-5)

    @pytest.mark.parametrize(
        ("origin", "sure"), [((3, 3, 0.5), True), ((3, 0.5, 0.5), False), ((0.5, 0.4, 0.5), True)]
    )
    def test_a_silhouette_is_not_certain(self, origin: tuple[float, float, float], sure: bool) -> None:
        surface = Surface(*cube())
        middles = surface.edge_midpoints(surface.edges)
        ridge = surface.edges[(middles == [1, 1, 0.5]).all(axis=1)]
        start = np.array([origin], np.float32)
        verdicts = judge_fans(
            frame_rays(start, np.array([[1, 1, 0.5]]) - start), surface, surface.edge_fans(ridge)
        )
        assert verdicts.certain.tolist() == [sure]

    def test_equal_positions_are_one_vertex_whatever_the_sign_of_zero(self) -> None:
        positions, faces = cube()
        apart = positions[faces.reshape(-1)].copy()
        apart[::2][apart[::2] == 0] = -0.0
        surface = Surface(apart, np.arange(len(apart), dtype=np.int32).reshape(-1, 3))
        assert surface.closed
        assert len(surface.vertices) == 8

    def test_axis_rays_meet_vertices_exactly(self) -> None:
        positions, _ = sphere(1)
        targets = positions.astype(np.float64)
        origins, directions = aim(targets, targets, surface_bounds(positions), rng(5))
        straight = np.flatnonzero((directions != 0).sum(axis=1) == 1)
        assert len(straight) >= len(targets) // 4
        for ray in straight:
            across = directions[ray] == 0
            assert (origins[ray][across] == positions[ray][across]).all()


def rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def surface_bounds(positions: np.ndarray) -> np.ndarray:
    return np.stack([positions.min(axis=0), positions.max(axis=0)]).astype(np.float64)


def aimed(
    surface: Surface, bounds: np.ndarray, count: int, seed: int
) -> list[tuple[tuple[np.ndarray, np.ndarray], Fans]]:
    random = rng(seed)
    edges = surface.edges[random.integers(0, len(surface.edges), count)]
    places = random.integers(0, len(surface.vertices), count)
    corners = surface.positions[surface.vertices[places]].astype(np.float64)
    at_edges = aim(surface.edge_midpoints(edges), surface.normals_at(edges), bounds, random)
    at_vertices = aim(corners, surface.normals_at(surface.corner_at(places)), bounds, random)
    return [(at_edges, surface.edge_fans(edges)), (at_vertices, surface.vertex_fans(places))]
