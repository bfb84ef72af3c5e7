"""The leak table counts what slips through, aims where it says, and knows what is closed."""

import sys
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from strategies import cube, grid, sphere, tetrahedron

import striptools
from striptools.mesh.mesh import Mesh
from striptools.trace import Hits, Tracer
from striptools.trace.pallas import walk as kernel
from striptools.types import TriangleTest

sys.path.insert(0, str(Path(__file__).parent / "benches"))
import bench_leaks as bench
import leak_gpu
import leak_rays
import leak_walks
from leak_rays import RUN, Place, Target
from leak_shapes import closed_shapes, torus

RUNS = 16


@pytest.fixture(scope="module")
def scene() -> striptools.Scene:
    return striptools.convert(torus(24, 12, 0.3))


@pytest.fixture(scope="module")
def target(scene: striptools.Scene) -> Target:
    assert scene.remap is not None
    return Target(torus(24, 12, 0.3), scene.remap.face)


@pytest.fixture(scope="module")
def batches(target: Target) -> list[bench.Batch]:
    return bench.batches_of(target, RUNS, np.random.default_rng(3))


def table_of(
    scene: striptools.Scene, target: Target, batches: list[bench.Batch], tracer: Tracer
) -> bench.Table:
    """The table of one walk beside the reference."""
    table = bench.Table()
    walk = leak_walks.Walk("tried", lambda _: tracer, packets=True)
    bench.trace_all(table, Place(), scene, target, batches, (leak_walks.MAIN[0], walk))
    return table


class Faulty(Tracer):
    """A tracer whose first sure hits go wrong; `sure` says which rays these are."""

    sure: np.ndarray
    t: float

    def closest_hit(self, *rays: np.ndarray, **options: object) -> Hits:  # pyright: ignore[reportIncompatibleMethodOverride]
        hits = super().closest_hit(*rays, **options)  # pyright: ignore[reportArgumentType]
        t = hits.t.copy()
        t[self.sure] = self.t
        return replace(hits, t=t)

    def any_hit(self, *rays: np.ndarray, **options: object) -> np.ndarray:  # pyright: ignore[reportIncompatibleMethodOverride]
        hit = super().any_hit(*rays, **options)  # pyright: ignore[reportArgumentType]
        hit[self.sure] = False
        return hit


def test_nothing_leaks(scene: striptools.Scene, target: Target, batches: list[bench.Batch]) -> None:
    table = table_of(scene, target, batches, Tracer(scene, device="cpu", resident="compressed"))
    assert {(batch.kind, batch.side) for batch in batches} == {
        (kind, side) for kind in bench.KINDS for side in ("outside", "inside")
    }
    for kind in bench.KINDS:
        count = table.counts["tried", kind]
        assert count.rays == 2 * RUNS * RUN * 4
        assert count.sure > count.rays / 3
        assert (count.leaks, count.different, table.counts["expanded", kind].wrong) == (0, 0, 0)
    assert not table.told
    assert bench.packed_share(scene, batches) > 0


@pytest.mark.parametrize("t", [np.inf, 1e4], ids=["a miss", "the back wall"])
def test_what_slips_through_is_counted(
    scene: striptools.Scene, target: Target, batches: list[bench.Batch], t: float
) -> None:
    batch = batches[0]
    tracer = Faulty(scene, device="cpu")
    tracer.sure, tracer.t = np.flatnonzero(batch.verdict.certain)[:3], t
    count = table_of(scene, target, [batch], tracer).counts["tried", "edges"]
    # Closest and any hits, one by one and in packets.
    assert (count.leaks, count.different) == (12, 12)


def aside(name: str) -> leak_walks.Walk:
    return next(walk for walk in leak_walks.ASIDE if walk.name == name)


def test_every_triangle_test_and_what_a_gpu_runs_is_in_the_table() -> None:
    names = [walk.name for walk in leak_walks.OTHERS]
    assert len(set(names)) == len(names)
    tests = [f"test {test}" for test in get_args(TriangleTest) if test != "watertight"]
    for kind in leak_walks.RESIDENT:
        for name in (*tests, "GPU kernel, interpreted", "GPU kernel's twin"):
            assert f"{name}, {kind}" in names


def test_both_residencies_of_a_test_take_the_same_places() -> None:
    # So that their hits are compared.
    half = len(leak_walks.ASIDE) // 2
    assert half % bench.TURNS == 0
    for one, other in zip(leak_walks.ASIDE[:half], leak_walks.ASIDE[half:], strict=True):
        assert one.name.replace("expanded", "compressed") == other.name


@pytest.fixture(scope="module")
def few(target: Target) -> list[bench.Batch]:
    return bench.batches_of(target, 4, np.random.default_rng(5))


@pytest.mark.parametrize(
    "name", [walk.name for walk in leak_walks.ASIDE if walk.test not in leak_walks.LEAKY]
)
def test_what_stands_aside_does_not_leak(
    scene: striptools.Scene, target: Target, few: list[bench.Batch], name: str
) -> None:
    table = bench.Table()
    walk = replace(aside(name), most=64)
    bench.trace_all(table, Place(), scene, target, few, (leak_walks.MAIN[0], walk))
    assert not bench.has_failed(table)
    for kind in bench.KINDS:
        # Closest and any hits, from outside and inside.
        assert table.counts[name, kind].rays == 4 * 64
        assert table.counts[name, kind].sure > 0
    assert not table.told


def test_the_fast_test_leaks_and_that_is_no_fault(
    scene: striptools.Scene, target: Target, batches: list[bench.Batch]
) -> None:
    walks = [aside(f"test fast, {kind}") for kind in leak_walks.RESIDENT]
    table = bench.Table()
    bench.trace_all(table, Place(), scene, target, batches, tuple(walks))
    leaks = [[table.counts[walk.name, kind].leaks for kind in bench.KINDS] for walk in walks]
    assert sum(leaks[0]) > 0
    assert leaks[0] == leaks[1]
    assert not bench.has_failed(table)
    note = bench.rows_of("torus", target.mesh, table, bench.Amount())[0].note
    assert note.endswith("not watertight by design")


def test_an_exact_test_that_is_not_one_is_seen(
    scene: striptools.Scene, target: Target, batches: list[bench.Batch]
) -> None:
    exact, fast = (aside(f"test {test}, expanded") for test in ("exact-sign", "fast"))
    table = bench.Table()
    bench.trace_all(table, Place(), scene, target, batches, (replace(exact, tracer=fast.tracer),))
    assert sum(table.counts[exact.name, kind].leaks for kind in bench.KINDS) > 0
    assert bench.has_failed(table)


@pytest.mark.parametrize("name", ["GPU kernel, interpreted, expanded", "GPU kernel's twin, expanded"])
def test_a_fault_in_what_a_gpu_runs_is_seen(
    scene: striptools.Scene,
    target: Target,
    few: list[bench.Batch],
    monkeypatch: pytest.MonkeyPatch,
    name: str,
) -> None:
    def blind(trace):
        """The walk of nodes whose first child's box is none."""
        return lambda scene, *given, **options: trace(
            scene._replace(nodes=scene.nodes.at[:, :6, 0].set(np.nan)), *given, **options
        )

    for module in (kernel, leak_gpu):
        monkeypatch.setattr(module, "trace_rays", blind(module.trace_rays))
    leak_gpu._program.cache_clear()
    table = bench.Table()
    bench.trace_all(table, Place(), scene, target, few, (leak_walks.MAIN[0], replace(aside(name), most=64)))
    leak_gpu._program.cache_clear()
    counts = [table.counts[name, kind] for kind in bench.KINDS]
    assert sum(count.leaks for count in counts) > 0
    assert sum(count.different for count in counts) > 0
    assert bench.has_failed(table)


def test_a_hit_that_no_ray_has_is_wrong(target: Target, batches: list[bench.Batch]) -> None:
    rays = batches[0].rays
    tracer = Tracer(striptools.convert(target.mesh), device="cpu")
    hits = tracer.closest_hit(rays.origins, rays.directions)
    assert not bench.wrong_hits(target, rays, hits).any()
    hit = np.flatnonzero(hits.hit)[:5]
    face = hits.face.copy()
    face[hit] = (face[hit] + 200) % target.mesh.triangle_count
    wrong = bench.wrong_hits(target, rays, replace(hits, face=face))
    assert np.array_equal(np.flatnonzero(wrong), hit)


def test_from_inside_every_ray_has_to_hit(batches: list[bench.Batch]) -> None:
    inside = next(batch for batch in batches if batch.side == "inside")
    assert inside.verdict.enclosed.mean() == 0.75
    uncertain = inside.verdict.enclosed & ~inside.verdict.certain
    assert uncertain.any()
    leaks = inside.verdict.leaks(np.full(len(inside.rays), np.inf, np.float32))
    assert np.array_equal(leaks, inside.verdict.sure)
    leaks = inside.verdict.leaks(np.full(len(inside.rays), 1e6, np.float32))
    assert np.array_equal(leaks, inside.verdict.certain)


def test_a_quarter_of_the_rays_runs_along_axes(batches: list[bench.Batch]) -> None:
    for batch in batches:
        along = (batch.rays.directions != 0).sum(axis=1) == 1
        assert along.mean() == pytest.approx(0.25, abs=0.01)


def test_runs_come_from_one_place_and_lie_side_by_side(batches: list[bench.Batch]) -> None:
    rays = batches[0].rays
    runs = rays.origins.reshape(-1, RUN, 3)
    one_place = (runs == runs[:, :1]).all(axis=(1, 2))
    assert one_place.mean() == 0.5
    ends = (rays.origins + rays.directions).reshape(-1, RUN, 3)[one_place]
    assert np.median(np.ptp(ends, axis=1).max(axis=1)) < 0.5 * np.ptp(ends.reshape(-1, 3), axis=0).max()


@pytest.mark.parametrize(
    ("shape", "closed"), [(tetrahedron(), True), (cube(), True), (sphere(1), True), (grid(3, 3), False)]
)
def test_what_is_closed(shape: tuple[np.ndarray, np.ndarray], closed: bool) -> None:
    faces = shape[1]
    assert leak_rays.is_closed(faces) == closed
    assert not leak_rays.is_closed(faces[1:])
    flipped = faces.copy()
    flipped[0] = flipped[0, ::-1]
    assert not leak_rays.is_closed(flipped)
    # Two sheets that share all edges: four faces each, as often one way as the other.
    assert leak_rays.is_closed(np.concatenate([faces, faces[:, ::-1]]))


@pytest.mark.parametrize("name", list(closed_shapes()))
def test_shapes_are_closed_and_cleaning_keeps_them(name: str) -> None:
    mesh = closed_shapes()[name]
    target = Target(mesh, np.arange(mesh.triangle_count, dtype=np.int32))
    assert target.closed
    assert len(target.kept) == mesh.triangle_count
    assert len(target.inside)


def test_a_model_moved_far_is_rounded_and_closedness_looked_at_again() -> None:
    mesh = torus(60, 40, 0.5)
    far = Place(1e-3, 3e5).put(mesh)
    target = Target(far, np.arange(mesh.triangle_count, dtype=np.int32))
    assert len(target.kept) < mesh.triangle_count
    assert len(target.inside) == 0 or target.closed


@pytest.mark.parametrize("turn", [0, 1])
def test_shared_instances_do_not_leak(turn: int) -> None:
    mesh, table = torus(24, 12, 0.3), bench.Table()
    order = np.arange(mesh.triangle_count, dtype=np.int32)
    bench.trace_shared(table, Place(1e3, 1.0), mesh, order, 8, turn)
    for resident in leak_walks.SHARED:
        for kind in bench.KINDS:
            count = table.counts[f"shared instances, {resident}", kind]
            assert count.sure > count.rays / 4 > 0
            assert count.leaks == 0
    assert not table.told


def test_the_rows_say_what_was_traced(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh, others = Mesh(*sphere(2)), leak_walks.OTHERS[:2]
    monkeypatch.setattr(bench, "OTHERS", others)
    amount = bench.Amount(RUNS * RUN * 2, (Place(),), every_walk=True)
    table = bench.measure(mesh, amount)
    rows = bench.rows_of("ball", mesh, table, amount)
    walks = [row for row in rows if row.metric.startswith("leaks, ")]
    assert len(walks) == len(leak_walks.MAIN) + len(others) + len(leak_walks.SHARED)
    assert all(row.value == 0 for row in rows if not row.peer and row.unit == "rays")
    assert f"{2 * RUNS * RUN} rays at edges" in walks[0].note
    bench.say(rows, table, 1.0)
    assert "leaks, compressed: 0" in capsys.readouterr().out


def test_each_other_walk_meets_every_offset_at_another_scale(monkeypatch: pytest.MonkeyPatch) -> None:
    met: dict[str, list[Place]] = {}

    def note(_: object, spot: Place, *given: object) -> None:
        for walk in given[-1]:  # pyright: ignore[reportGeneralTypeIssues]
            met.setdefault(walk.name, []).append(spot)

    monkeypatch.setattr(bench, "trace_all", note)
    monkeypatch.setattr(bench, "trace_shared", lambda *_: None)
    monkeypatch.setattr(bench, "trace_peers", lambda *_: None)
    bench.measure(Mesh(*tetrahedron()), bench.Amount(2 * RUN * 15))
    for walk in leak_walks.OTHERS:
        assert {spot.offset for spot in met[walk.name]} == set(bench.OFFSETS)
        assert len({spot.scale for spot in met[walk.name]}) == 3
    assert all(len(met[walk.name]) == 15 for walk in leak_walks.MAIN)
