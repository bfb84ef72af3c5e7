"""Queries inside a user's programs: the tracer's hits under jit and vmap, derivatives of the true ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scenes import scene_of
from strategies import cube, sphere
from test_hoisting import assert_hoisted
from test_trace import clean

from striptools.errors import UsageError
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer
from striptools.trace.functional import Geometry, all_hits, any_hit, closest_hit, contains, count_hits

POSITIONS, FACES = clean(sphere(2))
STEP = 1e-4


def traced(positions=POSITIONS, **options):
    return Tracer(scene_of(Mesh(positions, FACES)), device="cpu", threads=1, **options)


@pytest.fixture(scope="module", params=["expanded", "compressed"])
def tracer(request):
    return traced(resident=request.param)


@pytest.fixture(scope="module")
def geometry(tracer):
    return Geometry.of(tracer, FACES)


def rays(count, seed=0):
    random = np.random.default_rng(seed)
    origins = random.normal(size=(count, 3)).astype(np.float32) * 2
    return origins, random.normal(size=(count, 3)).astype(np.float32) * np.float32(0.5) - origins


# ---- The same hits.


@pytest.mark.parametrize("count", [301])
def test_hits_under_jit_are_the_tracers(count, tracer, geometry):
    origins, directions = rays(count)
    expected = tracer.closest_hit(origins, directions)
    hits = jax.jit(closest_hit)(geometry, POSITIONS, origins, directions)
    np.testing.assert_array_equal(hits.t, expected.t)
    np.testing.assert_array_equal(hits.face, expected.face)
    np.testing.assert_allclose(hits.u, expected.u, atol=1e-6)
    np.testing.assert_allclose(hits.v, expected.v, atol=1e-6)
    np.testing.assert_array_equal(
        jax.jit(any_hit)(geometry, origins, directions), tracer.any_hit(origins, directions)
    )
    np.testing.assert_array_equal(
        jax.jit(count_hits)(geometry, origins, directions), tracer.count_hits(origins, directions)
    )
    np.testing.assert_array_equal(jax.jit(contains)(geometry, origins / 2), tracer.contains(origins / 2))
    many, ours = (
        tracer.all_hits(origins, directions, k=3),
        all_hits(geometry, POSITIONS, origins, directions, k=3),
    )
    np.testing.assert_array_equal(ours.t, many.t)
    np.testing.assert_array_equal(ours.face, many.face)
    np.testing.assert_allclose(ours.u, many.u, atol=1e-6)


def test_t_max_holds(tracer, geometry):
    origins, directions = rays(100)
    reach = np.linspace(0, 1.5, 100, dtype=np.float32)
    expected = tracer.closest_hit(origins, directions, t_max=reach)
    np.testing.assert_array_equal(closest_hit(geometry, POSITIONS, origins, directions, reach).t, expected.t)
    assert not any_hit(geometry, origins, directions, 0.01).any()


def test_any_shape_and_any_vmap_is_one_batch(tracer, geometry):
    origins, directions = rays(60)
    expected = tracer.closest_hit(origins, directions)
    shaped = closest_hit(geometry, POSITIONS, origins.reshape(3, 4, 5, 3), directions.reshape(3, 4, 5, 3))
    np.testing.assert_array_equal(shaped.t.reshape(-1), expected.t)

    def one(origin, direction):
        return closest_hit(geometry, POSITIONS, origin, direction)

    for mapped in (jax.vmap(one), jax.jit(jax.vmap(one))):
        np.testing.assert_array_equal(mapped(origins, directions).t, expected.t)
    twice = jax.vmap(jax.vmap(one))(origins.reshape(6, 10, 3), directions.reshape(6, 10, 3))
    np.testing.assert_array_equal(twice.face.reshape(-1), expected.face)
    fixed = jax.vmap(one, in_axes=(None, 0))(origins[0], directions)
    np.testing.assert_array_equal(
        fixed.t, tracer.closest_hit(np.repeat(origins[:1], 60, axis=0), directions).t
    )
    single = one(origins[7], directions[7])
    assert (single.t.shape, single.t) == ((), expected.t[7])


def test_the_loop_stays_hoisted_inside_a_program(geometry):
    origins, directions = rays(64)

    def loss(positions, origins, directions):
        hits = closest_hit(geometry, positions, origins, directions)
        return jnp.where(hits.face >= 0, hits.t, 0).sum()

    def one(origin, direction):
        return closest_hit(geometry, POSITIONS, origin, direction).t

    for program in (
        jax.jit(closest_hit).lower(geometry, POSITIONS, origins, directions),
        jax.jit(jax.vmap(one)).lower(origins, directions),
        jax.jit(jax.grad(loss, argnums=(0, 1, 2))).lower(POSITIONS, origins, directions),
    ):
        assert_hoisted(program)


# ---- Derivatives.


def solved(corners, origin, direction):
    """(t, u, v) of a ray and one face in float64."""
    a, b, c = corners
    t, u, v = np.linalg.solve(np.stack([-direction, b - a, c - a], axis=1), origin - a)
    return np.array([t, u, v])


def differences(corners, origin, direction):
    """Central differences of (t, u, v) by corners (3, 9), origin (3, 3) and direction (3, 3), in float64."""
    given = np.concatenate([corners.reshape(-1), origin, direction]).astype(np.float64)
    columns = []
    for k in range(15):
        step = np.zeros(15)
        step[k] = STEP
        ends = [solved(x[:9].reshape(3, 3), x[9:12], x[12:]) for x in (given + step, given - step)]
        columns.append((ends[0] - ends[1]) / (2 * STEP))
    table = np.stack(columns, axis=1)
    return table[:, :9], table[:, 9:12], table[:, 12:]


def clear_rays(tracer, count):
    """Rays that hit away from edges."""
    origins, directions = rays(count, 5)
    hits = tracer.closest_hit(origins, directions)
    clear = hits.hit & (np.minimum(np.minimum(hits.u, hits.v), 1 - hits.u - hits.v) > 0.05)
    assert clear.sum() > 20
    return origins[clear], directions[clear], hits.face[clear]


@pytest.mark.parametrize("of", [jax.jacrev, jax.jacfwd])
def test_derivatives_are_those_of_finite_differences(of):
    tracer = traced()
    geometry = Geometry.of(tracer, FACES)
    origins, directions, faces = clear_rays(tracer, 60)

    def answer(positions, origin, direction):
        return jnp.stack(closest_hit(geometry, positions, origin, direction)[:3])

    table = jax.jit(jax.vmap(of(answer, argnums=(0, 1, 2)), in_axes=(None, 0, 0)))
    by_positions, by_origins, by_directions = map(np.asarray, table(POSITIONS, origins, directions))
    for k, face in enumerate(faces):
        corners = POSITIONS[FACES[face]]
        expected = differences(corners, origins[k], directions[k])
        scale = max(np.abs(e).max() for e in expected)
        np.testing.assert_allclose(
            by_positions[k][:, FACES[face]].reshape(3, 9), expected[0], atol=1e-4 * scale
        )
        np.testing.assert_allclose(by_origins[k], expected[1], atol=1e-4 * scale)
        np.testing.assert_allclose(by_directions[k], expected[2], atol=1e-4 * scale)
        others = np.delete(by_positions[k], FACES[face], axis=1)
        assert (others == 0).all()


def test_derivatives_are_those_of_the_walk_itself():
    """The tracer's own t, of moved rays and of scenes made anew of moved vertices."""
    tracer = traced()
    geometry = Geometry.of(tracer, FACES)
    origins, directions, faces = clear_rays(tracer, 60)
    step = 2.0**-7
    random = np.random.default_rng(1)
    ways = [random.normal(size=a.shape).astype(np.float32) for a in (POSITIONS, origins, directions)]
    given = (POSITIONS, origins, directions)

    def t_of(positions, origins, directions):
        return closest_hit(geometry, positions, origins, directions).t

    for chosen in range(3):
        tangents = [way if k == chosen else np.zeros_like(way) for k, way in enumerate(ways)]
        slope = np.asarray(jax.jvp(t_of, given, tuple(tangents))[1])
        ends = []
        for sign in (1, -1):
            moved = [a + np.float32(sign * step * 0.1) * w for a, w in zip(given, tangents, strict=True)]
            ends.append(traced(moved[0]).closest_hit(moved[1], moved[2]))
        kept = (ends[0].face == faces) & (ends[1].face == faces)
        assert kept.mean() > 0.5
        measured = (ends[0].t - ends[1].t)[kept] / (2 * step * 0.1)
        np.testing.assert_allclose(measured, slope[kept], atol=5e-3 * np.abs(slope).max())


def test_all_hits_have_derivatives_too():
    tracer = traced()
    geometry = Geometry.of(tracer, FACES)
    origins, directions, _ = clear_rays(tracer, 60)

    def first(origins):
        return closest_hit(geometry, POSITIONS, origins, directions).t.sum()

    def first_of_all(origins):
        return all_hits(geometry, POSITIONS, origins, directions, k=4).t[:, 0].sum()

    np.testing.assert_allclose(jax.grad(first_of_all)(origins), jax.grad(first)(origins), rtol=1e-5)


def test_a_miss_and_a_ray_in_the_plane_have_derivatives_of_zero():
    positions, faces = clean(cube())
    geometry = Geometry.of(Tracer(scene_of(Mesh(positions, faces)), device="cpu", threads=1), faces)

    def answer(positions, origin, direction):
        hits = closest_hit(geometry, positions, origin, direction)
        return jnp.where(hits.face >= 0, hits.t, 0.0) + hits.u + hits.v

    away = (jnp.array([5.0, 5, 5]), jnp.array([1.0, 0, 0]))
    for gradient in jax.grad(answer, argnums=(0, 1, 2))(positions, *away):
        assert (np.asarray(gradient) == 0).all()


def test_second_derivatives_are_those_of_a_plane():
    """With direction d and a plane, t = n(a - o) / nd, whose second derivative by d is known."""
    geometry = Geometry.of(traced(), FACES)
    origins, directions, faces = clear_rays(traced(), 60)
    origin, direction, corners = origins[0], directions[0], POSITIONS[FACES[faces[0]]].astype(np.float64)
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    slope = normal @ direction
    height = normal @ (corners[0] - origin)
    expected = 2 * height / slope**3 * np.outer(normal, normal)
    found = jax.hessian(lambda d: closest_hit(geometry, POSITIONS, origin, d).t)(direction)
    np.testing.assert_allclose(found, expected, atol=1e-3 * np.abs(expected).max())


def test_wrong_arguments_are_told(tracer, geometry):
    with pytest.raises(UsageError, match="faces"):
        Geometry.of(tracer, np.zeros((3, 3)))
    with pytest.raises(UsageError, match="origins"):
        closest_hit(geometry, POSITIONS, np.zeros((2, 3)), np.zeros((3, 3)))
    with pytest.raises(UsageError, match="hits a ray"):
        all_hits(geometry, POSITIONS, np.zeros((2, 3)), np.ones((2, 3)), k=0)
