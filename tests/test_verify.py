"""Right answers pass, every kind of wrong answer is caught, and the scene's faces are the source's."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import settings as limits
from hypothesis.strategies import booleans
from oracles import OracleTracer
from scenes import with_positions
from strategies import cube, grid, meshes, sphere, stack

from striptools.errors import UsageError
from striptools.measure.structure import compare_structure
from striptools.measure.verify import VerifyOptions, VerifyReport, verify
from striptools.mesh.clean import CleanOptions, clean
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert
from striptools.reducem.scene import Remap, Scene
from striptools.trace import Tracer
from striptools.trace.hit import Hits

FEW = VerifyOptions(rays=48, aimed_rays=400)


class FaultyTracer:
    """The oracle's answers, changed by a fault."""

    def __init__(self, scene: Scene, source: Mesh, fault: Callable[[Hits], Hits]) -> None:
        self.right = OracleTracer(scene, source)
        self.fault = fault

    def closest_hit(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        return self.fault(self.right.closest_hit(origins, directions))


def scene_of(mesh: Mesh, **options: object) -> Scene:
    return convert(mesh, Options(threads=1, **options))  # pyright: ignore[reportArgumentType]


@pytest.fixture(scope="module")
def ball() -> tuple[Scene, Mesh]:
    mesh = Mesh(*sphere(2))
    return scene_of(mesh), mesh


def one_hit(hits: Hits) -> int:
    return int(np.flatnonzero(hits.hit)[len(np.flatnonzero(hits.hit)) // 2]) if hits.hit.any() else -1


def changed(hits: Hits, ray: int, **values: float) -> Hits:
    columns = {name: getattr(hits, name).copy() for name in ("t", "face", "u", "v", "triangle")}
    for name, value in values.items():
        columns[name][ray] = value
    return Hits(**columns)


def fault_of_one(**values: float) -> Callable[[Hits], Hits]:
    return lambda hits: changed(hits, one_hit(hits), **values) if hits.hit.any() else hits


def later(hits: Hits) -> Hits:
    ray = one_hit(hits)
    return changed(hits, ray, t=hits.t[ray] * (1 + 1e-5)) if ray >= 0 else hits


def other_face(hits: Hits) -> Hits:
    ray = one_hit(hits)
    return changed(hits, ray, face=(hits.face[ray] + 64) % 128) if ray >= 0 else hits


def swapped(hits: Hits) -> Hits:
    return replace(hits, u=hits.v, v=hits.u)


def phantom(hits: Hits) -> Hits:
    missed = np.flatnonzero(~hits.hit)
    return changed(hits, int(missed[0]), t=1, face=5, triangle=5, u=0.3, v=0.3) if len(missed) else hits


def run(ball: tuple[Scene, Mesh], fault: Callable[[Hits], Hits]) -> VerifyReport:
    scene, mesh = ball
    return verify(scene, mesh, FEW, tracer=FaultyTracer(scene, mesh, fault))


class TestRightAnswers:
    def test_the_oracle_agrees_with_itself(self, ball: tuple[Scene, Mesh]) -> None:
        told: list[tuple[str, float]] = []
        scene, mesh = ball
        tracer = OracleTracer(scene, mesh)
        report = verify(scene, mesh, FEW, tracer=tracer, watch=lambda stage, part: told.append((stage, part)))
        assert report.ok
        assert report.closed
        assert report.rays == 48 * 2 + 400 + 100
        assert report.aimed_rays == 500
        assert report.aimed_certain > 300
        assert 0 < report.max_t_error < 1e-6
        assert report.max_t_ratio < 1
        assert [part for stage, part in told if stage == "rays"][-1] == 1
        assert all(0 <= part <= 1 for _, part in told)

    def test_the_real_tracer_agrees(self, ball: tuple[Scene, Mesh]) -> None:
        report = verify(*ball, FEW)
        assert (report.disagreements, report.leaks, report.structure.errors) == (0, 0, 0)
        assert report.ok

    @pytest.mark.parametrize("remap", [True, False])
    @pytest.mark.parametrize("shape", [cube(), grid(5, 4), stack(5), sphere(1)])
    def test_with_and_without_a_remap(self, shape: tuple[np.ndarray, np.ndarray], remap: bool) -> None:
        mesh = Mesh(*shape)
        report = verify(scene_of(mesh, remap=remap), mesh, FEW)
        assert report.ok, report.to_dict()

    def test_moved_and_scaled(self) -> None:
        positions, faces = sphere(2)
        for scale, shift in ((1e-3, 0.0), (1e3, 0.0), (1.0, 200.0)):
            mesh = Mesh((positions * scale + shift).astype(np.float32), faces)
            assert verify(scene_of(mesh), mesh, FEW).ok

    def test_double_precision_is_rounded_and_a_weld_is_allowed_for(self) -> None:
        random = np.random.default_rng(0)
        positions, faces = sphere(2)
        apart = positions[faces.reshape(-1)] + random.uniform(-1e-4, 1e-4, (faces.size, 3))
        mesh = Mesh(apart, np.arange(faces.size, dtype=np.int32).reshape(-1, 3))
        for remap in (True, False):
            scene = scene_of(mesh, clean=CleanOptions(weld=1e-3), remap=remap)
            assert scene.error_bound > 0
            report = verify(scene, mesh, FEW)
            assert report.ok, report.to_dict()

    def test_the_report_says_what_other_programs_read(self, ball: tuple[Scene, Mesh]) -> None:
        found = verify(*ball, FEW, tracer=OracleTracer(*ball)).to_dict()
        assert {"rays", "disagreements", "leaks", "max_t_error"} <= set(found)
        assert [part["name"] for part in found["sets"]][:2] == ["camera", "secondary"]
        assert sum(part["rays"] for part in found["sets"]) == found["rays"]

    def test_a_large_model_is_sampled(self, ball: tuple[Scene, Mesh]) -> None:
        options = VerifyOptions(rays=100, aimed_rays=200, pair_budget=128 * 4 * 7)
        report = verify(*ball, options, tracer=OracleTracer(*ball))
        assert (report.rays_wanted, report.rays_tried) == (100, 7)
        assert report.ok


class TestFaultsAreCaught:
    def test_a_wrong_t(self, ball: tuple[Scene, Mesh]) -> None:
        assert run(ball, later).disagreements + run(ball, later).leaks >= 4

    def test_a_wrong_face(self, ball: tuple[Scene, Mesh]) -> None:
        assert run(ball, other_face).disagreements >= 4

    def test_a_face_that_does_not_exist(self, ball: tuple[Scene, Mesh]) -> None:
        assert run(ball, fault_of_one(face=10**6)).disagreements >= 4

    def test_swapped_weights(self, ball: tuple[Scene, Mesh]) -> None:
        assert run(ball, swapped).disagreements >= 30

    def test_weights_outside_the_face(self, ball: tuple[Scene, Mesh]) -> None:
        assert run(ball, fault_of_one(u=-0.2)).disagreements >= 4

    def test_not_a_number(self, ball: tuple[Scene, Mesh]) -> None:
        assert run(ball, fault_of_one(t=np.nan)).disagreements >= 4

    def test_a_dropped_hit(self, ball: tuple[Scene, Mesh]) -> None:
        report = run(ball, fault_of_one(t=np.inf, face=-1, triangle=-1))
        by_name = {part.name: part for part in report.sets}
        assert by_name["camera"].disagreements == 1
        assert "a miss" in report.flaws[0]
        assert by_name["inside, edges"].leaks == 1
        assert not report.ok

    def test_a_phantom_hit(self, ball: tuple[Scene, Mesh]) -> None:
        assert {part.name: part for part in run(ball, phantom).sets}["camera"].disagreements == 1

    def test_rays_that_slip_through_edges_and_vertices(self, ball: tuple[Scene, Mesh]) -> None:
        def drop_all(hits: Hits) -> Hits:
            gone = np.full(len(hits.t), -1, np.int32)
            return replace(hits, t=np.full(len(hits.t), np.inf, np.float32), face=gone, triangle=gone)

        report = run(ball, drop_all)
        for part in report.sets:
            if part.name.startswith(("edges", "vertices")):
                assert part.leaks == part.certain
            if part.name.startswith("inside"):
                assert part.leaks == part.rays

    def test_a_ray_that_slips_through_to_the_back_wall(self, ball: tuple[Scene, Mesh]) -> None:
        scene, mesh = ball

        class Through(OracleTracer):
            def closest_hit(
                self, origins: np.ndarray, directions: np.ndarray, *, steps: bool = False
            ) -> Hits:
                start = super().closest_hit(origins, directions)
                t = np.where(start.hit, start.t * np.float32(1.01), 0)[:, None]
                beyond = super().closest_hit((origins + t * directions).astype(np.float32), directions)
                return replace(beyond, t=(beyond.t + t[:, 0]).astype(np.float32))

        report = verify(scene, mesh, FEW, tracer=Through(scene, mesh))
        assert report.leaks > 100

    def test_a_tie_that_goes_to_the_greater_face(self) -> None:
        mesh = Mesh(*stack(4))
        scene = scene_of(mesh)

        def greatest(hits: Hits) -> Hits:
            return replace(hits, face=np.where(hits.hit, 3, hits.face).astype(np.int32))

        assert verify(scene, mesh, FEW, tracer=FaultyTracer(scene, mesh, lambda hits: hits)).ok
        assert verify(scene, mesh, FEW, tracer=FaultyTracer(scene, mesh, greatest)).disagreements > 0

    def test_a_normal_that_is_not_the_sources(self) -> None:
        mesh = Mesh(*cube())
        scene = scene_of(mesh, remap=False)
        mirrored = scene.positions * np.array([1, 1, -1], np.float32) + np.array([0, 0, 1], np.float32)
        assert verify(with_positions(scene, mirrored), mesh, FEW).disagreements > 0


class TestStructure:
    @given(meshes())
    @limits(max_examples=25)
    def test_what_convert_makes_is_what_was_kept(self, mesh: Mesh) -> None:
        kept = len(clean(mesh).source_face)
        if kept == 0:
            return
        for remap in (True, False):
            found = compare_structure(scene_of(mesh, remap=remap), mesh)
            assert (found.errors, found.excused) == (0, 0)
            assert found.present == found.expected == kept

    def test_dropped_duplicates_are_excused(self) -> None:
        positions, faces = cube()
        mesh = Mesh(positions, np.concatenate([faces, np.roll(faces[:3], 1, axis=1)]))
        for remap in (True, False):
            found = compare_structure(
                scene_of(mesh, clean=CleanOptions(drop_duplicates=True), remap=remap), mesh
            )
            assert (found.errors, found.excused) == (0, 3)

    @pytest.mark.parametrize("remap", [True, False])
    def test_a_missing_face(self, remap: bool) -> None:
        mesh = Mesh(*cube())
        less = scene_of(Mesh(mesh.positions, mesh.faces[:-1]), remap=remap)
        found = compare_structure(less, mesh)
        assert (found.missing, found.unexpected) == (1, 0)

    @pytest.mark.parametrize("remap", [True, False])
    def test_a_flipped_face(self, remap: bool) -> None:
        positions, faces = cube()
        other = faces.copy()
        other[4] = other[4, ::-1]
        found = compare_structure(scene_of(Mesh(positions, faces), remap=remap), Mesh(positions, other))
        assert found.errors >= 1

    @pytest.mark.parametrize("remap", [True, False])
    def test_a_moved_vertex(self, remap: bool, ball: tuple[Scene, Mesh]) -> None:
        _, mesh = ball
        scene = scene_of(mesh, remap=remap)
        moved = scene.positions.copy()
        moved[7, 1] = np.nextafter(moved[7, 1], np.float32(9))
        assert compare_structure(with_positions(scene, moved), mesh).errors > 0

    def test_a_face_that_is_there_twice(self, ball: tuple[Scene, Mesh]) -> None:
        scene, mesh = ball
        assert scene.remap is not None
        twice = scene.remap.face.copy()
        twice[3] = twice[4]
        found = compare_structure(replace(scene, remap=Remap(twice, scene.remap.rotation)), mesh)
        assert (found.missing, found.unexpected) == (1, 1)

    def test_a_wrong_rotation(self, ball: tuple[Scene, Mesh]) -> None:
        scene, mesh = ball
        assert scene.remap is not None
        turned = ((scene.remap.rotation + 1) % 3).astype(np.uint8)
        found = compare_structure(replace(scene, remap=Remap(scene.remap.face, turned)), mesh)
        assert found.wrong == found.present

    def test_a_vertex_beyond_the_error_bound(self, ball: tuple[Scene, Mesh]) -> None:
        _, mesh = ball
        for remap in (True, False):
            scene = replace(scene_of(mesh, remap=remap), error_bound=1e-3)
            assert compare_structure(scene, mesh).errors == 0
            larger = with_positions(scene, scene.positions * np.float32(1.01))
            assert compare_structure(larger, mesh).wrong > 0

    def test_another_source_is_refused(self, ball: tuple[Scene, Mesh]) -> None:
        with pytest.raises(UsageError, match="12 faces"):
            verify(ball[0], Mesh(*cube()), FEW)

    def test_wrong_options_are_refused(self) -> None:
        for options in ({"rays": -1}, {"aimed_rays": -1}, {"pair_budget": 0}, {"seed": -1}):
            with pytest.raises(UsageError):
                VerifyOptions(**options)


def test_bunny(real_mesh: Callable[[str], object]) -> None:
    from striptools.mesh.io import load_mesh

    mesh = load_mesh(str(real_mesh("bunny")))
    scene = convert(mesh)
    report = verify(scene, mesh, VerifyOptions(rays=128, aimed_rays=20000), tracer=Tracer(scene))
    assert report.ok, report.to_dict()
    assert report.aimed_certain > 18000


@given(meshes(), booleans())
@limits(max_examples=30)
def test_the_real_tracer_is_proved_on_any_mesh(mesh: Mesh, remap: bool) -> None:
    if clean(mesh).mesh.triangle_count == 0:
        return
    report = verify(scene_of(mesh, remap=remap), mesh, FEW)
    assert report.ok, report.flaws


def test_a_needle_seen_along_its_line_is_no_phantom() -> None:
    # Every sign of its edge functions is rounding noise, for rays that pass far from it too.
    along = np.arange(7)[:, None] * np.array([1e-8, 2e-8, -3e-8])
    faces = [[0, 1, 2], [1, 2, 3], [2, 3, 4], [3, 4, 5], [1, 5, 6]]
    mesh = Mesh(along.astype(np.float32), np.array(faces, np.int32))
    report = verify(scene_of(mesh), mesh, VerifyOptions(rays=64, aimed_rays=512))
    assert report.ok, report.flaws
