"""The triangle tests: what each decides, how far it errs, and that the bounds it is held to can be broken."""

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import get_args

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import settings as limits
from hypothesis import strategies as st
from rays import aimed_rays
from scenes import scene_of as scene_of_clean
from scenes import small_scene
from strategies import clean_meshes, cube, grid, sphere
from test_hoisting import loops_outside_hoisted_calls
from test_trace import flushed

from striptools.errors import UsageError
from striptools.kernels.rays import ROW, ready_rays
from striptools.measure.bound import frame_rays, judge_pairs
from striptools.measure.exact import exact_pair
from striptools.measure.verify import VerifyOptions, VerifyReport, verify
from striptools.mesh.mesh import Mesh
from striptools.pipeline import convert
from striptools.trace import Tracer, functional, triangle_tests
from striptools.trace.hit import Hits
from striptools.trace.launch import program
from striptools.trace.leaves import aligned_full, scale_of
from striptools.trace.triangle import Shear, shear_of
from striptools.trace.walk import FLOATS, WORDS, WalkOptions, prepared_rays, trace_rays
from striptools.types import TriangleTest

TESTS: tuple[TriangleTest, ...] = ("fast", "exact-sign", "float64")
LEAST_NORMAL = 2.0**-126
FEW = VerifyOptions(rays=32, aimed_rays=256)


def tracer_of(scene, test: TriangleTest, resident="expanded") -> Tracer:
    return Tracer(scene, device="cpu", threads=1, resident=resident, test=test)


def exact_hits(mesh: Mesh, origins, directions) -> list[list[tuple[Fraction, int]]]:
    """Of each ray, what it hits in integers, by t and then by face."""
    positions = mesh.positions.astype(np.float64)
    found = []
    for o, d in zip(origins, directions, strict=True):
        pairs = [exact_pair(o, d, positions[corners]) for corners in mesh.faces]
        found.append(sorted((pair.t, k) for k, pair in enumerate(pairs) if pair.hit and pair.t is not None))
    return found


def joined(*shapes) -> Mesh:
    """One mesh of several: programs are compiled once for all of them."""
    starts = np.cumsum([0, *(len(positions) for positions, _ in shapes)])[:-1]
    faces = [faces + np.int32(start) for (_, faces), start in zip(shapes, starts, strict=True)]
    return Mesh(np.concatenate([positions for positions, _ in shapes]), np.concatenate(faces))


SHAPES = joined(sphere(1), grid(5, 4), cube())
"""A ball, a grid, and a box that lies on it: edges and planes are shared, and many t are equal."""


# ---- What is decided.


def test_exact_signs_hit_what_integers_say_is_hit() -> None:
    # Of expanded scenes; that compressed ones give the same is told below.
    mesh = SHAPES
    tracer = tracer_of(convert(mesh), "exact-sign")
    rays = aimed_rays(mesh.positions, mesh.faces, 200, 5)
    expected = exact_hits(mesh, *rays)
    hits = tracer.closest_hit(*rays)
    assert tracer.count_hits(*rays).tolist() == [len(row) for row in expected]
    assert tracer.any_hit(*rays).tolist() == [bool(row) for row in expected]
    assert hits.hit.tolist() == [bool(row) for row in expected]
    for ray in np.flatnonzero(hits.hit):
        assert int(hits.face[ray]) in {face for _, face in expected[ray]}


def test_float32_signs_are_not_the_exact_ones() -> None:
    # The same comparison finds the fault in the other tests, or it would find none.
    mesh = Mesh(*cube())
    rays = aimed_rays(mesh.positions, mesh.faces, 200, 5)
    expected = [len(row) for row in exact_hits(mesh, *rays)]
    for test in ("watertight", "fast"):
        assert tracer_of(convert(mesh), test).count_hits(*rays).tolist() != expected


def exactly(corners: np.ndarray, origin: np.ndarray, direction: np.ndarray) -> list[int]:
    """Signs of the volumes opposite to the corners, along axes in the order of the shear, in fractions."""
    start, d = ([Fraction(float(x)) for x in row] for row in (origin, direction))
    at = [[Fraction(float(x)) - o for x, o in zip(row, start, strict=True)] for row in corners]

    def volume(p, q):
        return (
            d[0] * (p[1] * q[2] - p[2] * q[1])
            + d[1] * (p[2] * q[0] - p[0] * q[2])
            + d[2] * (p[0] * q[1] - p[1] * q[0])
        )

    return [int(np.sign(volume(at[j], at[k]))) for j, k in ((1, 2), (2, 0), (0, 1))]


NUMBERS = st.floats(-4, 4, width=32, allow_subnormal=False) | st.sampled_from(
    [0.0, 1.0, 2.0**-100, 1.0 + 2.0**-23, 2.0**30, -(2.0**-60)]
)


@given(st.lists(NUMBERS, min_size=15, max_size=15), st.integers(0, 3))
@limits(max_examples=150, deadline=None)
def test_exact_signs_are_those_of_fractions(numbers: list[float], planar: int) -> None:
    rows = np.array(numbers, np.float32).reshape(5, 3)
    corners, origin, direction = rows[:3], rows[3], rows[4]
    # Some rays go to a corner or to a middle, as exactly as float32 allows.
    if planar:
        target = corners[0] if planar == 1 else (corners[0] + corners[1]) / 2
        direction = flushed((target - origin).astype(np.float32))
    given_to = tuple(tuple(corners[k, axis][None] for k in range(3)) for axis in range(3))
    axes = tuple(np.uint32(k) for k in range(3))
    one = np.float32(1)
    shear = Shear(axes, tuple(origin), one, one, one, tuple(direction))  # pyright: ignore[reportArgumentType]
    found = np.asarray(SIGNS(given_to, shear))[:, 0]
    assert found.tolist() == exactly(corners, origin, direction)


SIGNS = jax.jit(triangle_tests.exact_signs)


def scaled(number: float) -> float:
    """A number as terms may be: a product of three float32 numbers is a multiple of 2^-447."""
    return number if abs(number) >= 2.0**-447 else 0.0


@given(
    st.lists(st.floats(-4, 4).map(scaled) | st.sampled_from([1.0, -1.0, 2.0**-100]), min_size=1, max_size=36)
)
@example([1.0, 2.0**-100, -1.0])
@limits(max_examples=100, deadline=None)
def test_a_sum_has_its_exact_sign(numbers: list[float]) -> None:
    # The example is what float64 alone gets wrong.
    terms = np.zeros((36, 1))
    terms[: len(numbers), 0] = numbers
    with jax.enable_x64(True):
        sign = int(np.asarray(SUM(terms))[0])
    assert sign == int(np.sign(sum(Fraction(float(number)) for number in terms[:, 0])))


SUM = jax.jit(triangle_tests._sign_of_sum)


# ---- Within what bound.


@given(clean_meshes(), st.sampled_from(TESTS))
@limits(max_examples=15, deadline=None)
def test_every_test_keeps_its_bound_on_any_mesh(mesh: Mesh, test: TriangleTest) -> None:
    # Compressed scenes, each with a program of its own, give the same hits: that is told below.
    scene = scene_of_clean(mesh)
    report = verify(scene, mesh, FEW, tracer=tracer_of(scene, test), test=test)
    kept(report, test)


def kept(report: VerifyReport, test: TriangleTest) -> None:
    """Nothing is wrong, but that `fast` leaks."""
    assert report.disagreements == 0, report.flaws
    assert report.max_t_ratio <= 1
    assert report.leaks == 0 or test == "fast", report.flaws


ONE_FAR_CORNER = Mesh(
    np.float32([[2.6417978, 1.5592732, -0.80288386], [-1.02588, -1.73885, -1.08531], [0.17, 3e38, 1.46]]),
    np.array([[2, 1, 0]], np.int32),
)
"""What its coordinates are in parts of the largest one underflows."""

THINNER_THAN_FLOAT64_TELLS = Mesh(
    np.float32(
        [
            *([1e4, 1e4, 1e4], [1e4, 1e4, 10001], [10001, 1e4, 10000.5]),
            *([1e-8, 2e-8, -3e-8], [2e-8, 4e-8, -6e-8], [3e-8, 6e-8, -9e-8]),
        ]
    ),
    np.array([[0, 1, 2], [3, 4, 5]], np.int32),
)
"""The second face is a line but for the rounding of its corners."""


@given(clean_meshes(), st.integers(0, 99))
@example(ONE_FAR_CORNER, 0)
@example(THINNER_THAN_FLOAT64_TELLS, 0)
@limits(max_examples=12, deadline=None)
def test_t_is_within_the_bound_of_integers(mesh: Mesh, seed: int) -> None:
    origins, directions = aimed_rays(mesh.positions, mesh.faces, 24, seed)
    scene = scene_of_clean(mesh)
    # The bound is that of the frame in which the scene and each direction are 1 to 2 in size.
    scale, length = float(scale_of(scene)), lengths_below(directions)
    with np.errstate(all="ignore"):
        ways = (directions / length[:, None]).astype(np.float32)
        frames = frame_rays((origins * scale).astype(np.float32), ways)
    for test in get_args(TriangleTest):
        hits = tracer_of(scene, test).closest_hit(origins, directions)
        ray = np.flatnonzero(hits.hit & (hits.t > LEAST_NORMAL) & (hits.t < 3e38))
        corners = mesh.positions[mesh.faces[hits.face[ray]]].astype(np.float64)
        bound = judge_pairs(frames, ray, corners * scale, 0.0, test).t_bound
        for k, r in enumerate(ray):
            exact = exact_pair(origins[r], directions[r], corners[k]).clamped
            if exact is not None:
                error = abs(float(exact - Fraction(float(hits.t[r]))))
                assert error * scale * length[r] <= bound[k]


def lengths_below(directions: np.ndarray) -> np.ndarray:
    """(r,) float64: the power of two that each direction's largest component is 1 to 2 of; 1 for none."""
    longest = np.abs(directions).max(axis=1).astype(np.float64)
    return 2.0 ** np.floor(np.log2(np.where((longest > 0) & (longest < np.inf), longest, 1.0)))


def test_float64_rounds_t_once() -> None:
    mesh = Mesh(*sphere(3))
    random = np.random.default_rng(0)
    origins = (random.normal(size=(2000, 3)) * 3).astype(np.float32)
    directions = (random.normal(size=(2000, 3)) * 0.3 - origins).astype(np.float32)
    scene, positions = convert(mesh), mesh.positions.astype(np.float64)
    away = {}
    for test in ("watertight", "float64"):
        hits = tracer_of(scene, test).closest_hit(origins, directions)
        away[test] = [
            abs(float(pair.t / Fraction(float(hits.t[ray])) - 1)) * 2**24
            for ray in np.flatnonzero(hits.hit)[:200]
            if (pair := exact_pair(origins[ray], directions[ray], positions[mesh.faces[hits.face[ray]]])).t
        ]
    # Half a unit in the last place is at most u of the number; float64's own part is 2^-29 of that.
    assert max(away["float64"]) < 1.001
    assert max(away["watertight"]) > 1.001


# ---- Faults are found.


class Wrong:
    """A tracer whose hits are changed."""

    def __init__(self, tracer: Tracer, fault: Callable[[Hits], Hits]) -> None:
        self.tracer, self.fault = tracer, fault

    def closest_hit(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        return self.fault(self.tracer.closest_hit(origins, directions))


@pytest.fixture(scope="module")
def ball():
    mesh = Mesh(*sphere(2))
    return mesh, convert(mesh)


def later(ulps: float) -> Callable[[Hits], Hits]:
    return lambda hits: replace(hits, t=(hits.t * np.float32(1 + ulps * 2.0**-23)).astype(np.float32))


def test_a_t_two_units_off_is_beyond_the_bound_of_float64_alone(ball) -> None:
    mesh, scene = ball
    for test, ulps in (("float64", 2), ("exact-sign", 64), ("fast", 256)):
        tracer = tracer_of(scene, test)
        right = verify(scene, mesh, FEW, tracer=tracer, test=test)
        kept(right, test)
        found = verify(scene, mesh, FEW, tracer=Wrong(tracer, later(ulps)), test=test)
        assert found.disagreements > right.disagreements, test


def test_other_tests_are_not_within_the_bound_of_float64(ball) -> None:
    mesh, scene = ball
    for test in ("watertight", "fast"):
        report = verify(scene, mesh, FEW, tracer=tracer_of(scene, test), test="float64")
        assert report.disagreements > 0


def test_fast_leaks_and_the_others_do_not(ball) -> None:
    mesh, scene = ball
    many = VerifyOptions(rays=16, aimed_rays=4096)
    for test in get_args(TriangleTest):
        report = verify(scene, mesh, many, tracer=tracer_of(scene, test), test=test)
        assert (report.leaks > 0) == (test == "fast")
        assert report.disagreements == 0


def test_a_hit_that_integers_deny_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    # Without doubt no sign is decided anew, and some hits are others.
    mesh, scene = SHAPES, convert(SHAPES)
    rays = aimed_rays(mesh.positions, mesh.faces, 200, 5)
    expected = [len(row) for row in exact_hits(mesh, *rays)]
    assert tracer_of(scene, "exact-sign").count_hits(*rays).tolist() == expected
    monkeypatch.setattr(triangle_tests, "doubt_of", lambda corners, shear: jnp.float32(-1))
    program.cache_clear()
    try:
        assert tracer_of(scene, "exact-sign").count_hits(*rays).tolist() != expected
    finally:
        program.cache_clear()


# ---- What is the same, and what is not.


@pytest.mark.parametrize("test", TESTS)
def test_hits_do_not_depend_on_residency_or_hierarchy(test: TriangleTest) -> None:
    mesh = SHAPES
    scene = convert(mesh)
    rays = aimed_rays(mesh.positions, mesh.faces, 500, 8)
    one = tracer_of(scene, test)
    others = [
        tracer_of(scene, test, "compressed"),
        Tracer(scene, device="cpu", threads=1, hierarchy="rebuilt", test=test),
    ]
    found = one.closest_hit(*rays)
    for other in others:
        same = other.closest_hit(*rays)
        for name in ("t", "face", "u", "v", "triangle"):
            np.testing.assert_array_equal(getattr(same, name), getattr(found, name))
        np.testing.assert_array_equal(other.any_hit(*rays), found.hit)
    if test == "exact-sign":
        # Of it `count_hits` is compared with integers above.
        return
    first = one.all_hits(*rays, k=2)
    np.testing.assert_array_equal(first.t[:, 0], found.t)
    np.testing.assert_array_equal(first.u[:, 0], found.u)


@pytest.mark.parametrize("test", TESTS)
def test_rays_walked_at_once_or_in_a_program_of_ones_own_hit_the_same(ball, test: TriangleTest) -> None:
    mesh, scene = ball
    tracer = tracer_of(scene, test)
    origins, directions = aimed_rays(mesh.positions, mesh.faces, 64, 3)
    found = tracer.closest_hit(origins, directions)
    geometry = functional.Geometry.of(tracer, mesh.faces)
    mine = functional.closest_hit(geometry, mesh.positions, origins, directions)
    np.testing.assert_array_equal(np.asarray(mine.face), found.face)
    np.testing.assert_array_equal(np.asarray(mine.t), found.t)
    options = tracer._options()
    assert options is not None
    reach = np.full(64, np.inf, np.float32)
    at_once = jax.jit(trace_rays, static_argnums=4)(
        tracer._scene, origins, directions, reach, options._replace(interleave=1, batch=True)
    )
    np.testing.assert_array_equal(np.asarray(at_once.t), found.t)


def test_a_reach_ends_a_ray(ball) -> None:
    mesh, scene = ball
    origins, directions = aimed_rays(mesh.positions, mesh.faces, 64, 4)
    for test in TESTS:
        tracer = tracer_of(scene, test)
        t = tracer.closest_hit(origins, directions).t
        assert (
            not tracer.closest_hit(origins, directions, t_max=t).hit[np.isfinite(t)].any()
            or (tracer.closest_hit(origins, directions, t_max=t).t < t)[np.isfinite(t)].any()
        )


def test_rows_of_the_host_are_those_of_the_device(ball) -> None:
    mesh, scene = ball
    tracer = tracer_of(scene, "float64")
    origins, directions = aimed_rays(mesh.positions, mesh.faces, 500, 6)
    directions[::7] *= np.float32(1e-38)
    directions[::5, 0] = np.float32(1e-40)
    reach = np.full(500, np.inf, np.float32)
    device = np.asarray(
        jax.jit(prepared_rays, static_argnums=4)(tracer._scene, origins, directions, reach, "float64")
    )
    rows, at = aligned_full((500, WORDS + 3), 0.0), np.zeros(500, np.int32)
    seen = (tuple(tracer._layout.arrays.frame), *tracer._layout.root)
    given_to = (
        np.zeros(0, np.int32),
        0,
        *seen,
        False,
        rows,
        rows.view(np.int32),
        at,
        np.zeros(500, np.uint8),
    )
    live, _ = ready_rays(origins, directions, reach, *given_to)
    np.testing.assert_array_equal(rows[:live, WORDS:], device[at[:live], WORDS:])
    np.testing.assert_array_equal(rows[:live, :FLOATS], device[at[:live], :FLOATS])


def test_the_way_is_the_direction_along_the_axes() -> None:
    direction = np.array([0.25, -3, 1], np.float32)
    shear = shear_of(np.zeros(3, np.float32), direction)
    assert [int(axis) for axis in shear.axes] == [2, 0, 1]
    assert shear.way is None


# ---- Programs and refusals.


def lowered(test: TriangleTest, resident: str, **asked):
    tracer = tracer_of(small_scene(), test, resident)
    options = tracer._options(**asked)
    assert options is not None
    words = ROW + 3 * triangle_tests.wants_way(test)
    rows, live = np.zeros((256, words), np.float32), np.full(1, 256, np.int32)
    return program(tracer._mesh, options).lower(tracer._scene, rows, live)


@pytest.mark.parametrize("resident", ["expanded", "compressed"])
def test_the_default_program_knows_nothing_of_the_others(resident: str) -> None:
    text = lowered("watertight", resident).as_text()
    assert "f64" not in text
    assert "x24xf32" in text
    for test in ("exact-sign", "float64"):
        assert "f64" in lowered(test, resident).as_text()
    assert "f64" not in lowered("fast", resident).as_text()


@pytest.mark.parametrize(
    ("test", "resident", "asked"),
    [
        *((test, resident, {}) for test in TESTS for resident in ("expanded", "compressed")),
        ("exact-sign", "expanded", {"any_hit": True}),
        ("exact-sign", "expanded", {"gather": "count", "most": 1}),
    ],
)
def test_walks_are_hoisted(test: TriangleTest, resident: str, asked: dict) -> None:
    text = lowered(test, resident, **asked).compile().as_text()
    assert text is not None
    assert 'xla_cpu_small_call="true"' in text
    assert loops_outside_hoisted_calls(text) == []


def test_neither_packets_nor_kernels_walk_by_other_tests(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    honest = program

    def noting(mesh, options: WalkOptions, packets: bool = False):
        asked.append((options.test, packets))
        return honest(mesh, options, packets)

    for module in ("launch", "streams"):
        monkeypatch.setattr(f"striptools.trace.{module}.program", noting)
    origins = np.zeros((256, 3), np.float32)
    directions = np.tile(np.array([1, 1, 1], np.float32), (256, 1))
    for test in get_args(TriangleTest):
        tracer = tracer_of(small_scene(), test)
        tracer.closest_hit(origins, directions, packets=True)
        tracer._kernel = True
        options = tracer._options()
        assert options is not None
        assert options.kernel == (test == "watertight")
    assert {packets for test, packets in asked if test != "watertight"} == {False}
    assert ("watertight", True) in asked


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(UsageError, match="no such triangle test"):
        Tracer(small_scene(), test="slow")  # pyright: ignore[reportArgumentType]
