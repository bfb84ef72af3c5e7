import io
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import grid, meshes, sphere, tangle

import striptools
from striptools.errors import UnreadableMeshError, UsageError
from striptools.mesh.clean import clean
from striptools.mesh.io import save_mesh
from striptools.options import STAGES
from striptools.reducem.check import check_scene
from striptools.reducem.validate import validate
from striptools.stopwatch import Stopwatch
from striptools.strips.ordering import EFFORT_NAMES, METHODS

OPTIONS = st.builds(
    striptools.Options,
    clean=st.builds(striptools.CleanOptions, drop_duplicates=st.booleans()),
    ordering=st.builds(
        striptools.OrderingOptions,
        max_length=st.sampled_from([1, 2, 7, 64]),
        method=st.sampled_from(METHODS),
        effort=st.sampled_from(EFFORT_NAMES),
        block=st.sampled_from([None, 16, 256]),
        flips=st.booleans(),
    ),
    boxes=st.sampled_from(["rebuilt", "stored"]),
    remap=st.just(True),
    threads=st.sampled_from([1, 2, 5]),
)


def saved(scene):
    file = io.BytesIO()
    scene.save(file)
    return file.getvalue()


@given(meshes(), OPTIONS)
def test_every_face_that_cleaning_kept_comes_back_in_source_order(mesh, options):
    kept = clean(mesh, options.clean).mesh
    if kept.triangle_count == 0:
        with pytest.raises(UnreadableMeshError, match="no face is left"):
            striptools.convert(mesh, options)
        return
    back = striptools.open(io.BytesIO(saved(striptools.convert(mesh, options)))).to_mesh()
    want = kept.positions[kept.faces].view(np.uint32)
    assert (back.positions[back.faces].view(np.uint32) == want).all()


@given(meshes())
@settings(max_examples=15)
def test_without_a_remap_the_same_faces_come_back_in_another_order(mesh):
    kept = clean(mesh).mesh
    if kept.triangle_count == 0:
        return
    back = striptools.convert(mesh, striptools.Options(remap=False)).to_mesh()
    assert canonical(back) == canonical(kept)


def canonical(mesh):
    corners = mesh.positions[mesh.faces].view(np.uint32).tolist()
    return sorted(min((a, b, c), (b, c, a), (c, a, b)) for a, b, c in corners)


@given(meshes(hostile=False), OPTIONS)
@settings(max_examples=20)
def test_a_scene_holds_what_every_stage_promises(mesh, options):
    if clean(mesh, options.clean).mesh.triangle_count == 0:
        return
    scene = striptools.convert(mesh, options)
    check_scene(scene)
    assert validate(saved(scene)) == []
    assert np.diff(scene.starts).max() <= options.ordering.max_length
    most = options.ordering.block or 256
    assert np.diff(scene.block_starts).max() <= most
    assert np.diff(scene.decoded.vertex_starts).max() <= most
    assert scene.boxes == options.boxes


def test_the_bytes_do_not_depend_on_the_number_of_threads(real_mesh):
    files = [
        saved(striptools.convert(real_mesh("bunny"), striptools.Options(threads=threads)))
        for threads in (1, 2, 5)
    ]
    assert files[0] == files[1] == files[2]


def test_a_path_a_stream_and_a_mesh_give_the_same_scene(tmp_path):
    positions, faces = sphere(2)
    path = tmp_path / "sphere.ply"
    save_mesh(striptools.Mesh(positions, faces), path)
    from_stream, _ = striptools.convert_with_report(io.BytesIO(path.read_bytes()), file_format="ply")
    from_path = striptools.convert(path)
    assert saved(from_path) == saved(striptools.convert(str(path)))
    assert saved(striptools.convert(striptools.Mesh(positions, faces))) == saved(from_stream)
    # A path has a name, and that is all.
    generator = f"striptools {striptools.__version__}"
    assert from_path.metadata == {"generator": generator, "source": "sphere.ply"}
    assert from_stream.metadata == {"generator": generator}
    assert saved(replace(from_path, metadata=from_stream.metadata)) == saved(from_stream)


def test_the_report_accounts_for_every_face_and_every_second():
    positions, faces = tangle(9, 60, 3)
    told = []
    scene, report = striptools.convert_with_report(
        striptools.Mesh(positions, faces), watch=lambda stage, fraction: told.append((stage, fraction))
    )
    assert [*dict.fromkeys(stage for stage, _ in told)] == [*STAGES]
    for stage in STAGES:
        fractions = [fraction for name, fraction in told if name == stage]
        assert (fractions[0], fractions[-1]) == (0.0, 1.0)
        assert fractions == sorted(fractions)
    assert [*report.seconds] == [*STAGES, "total"]
    assert sum(report.seconds[stage] for stage in STAGES) <= report.seconds["total"]
    counts = report.counts
    dropped = counts["non_finite"] + counts["repeated_vertex"] + counts["zero_area"]
    assert counts["faces_in"] == 60 == counts["faces_out"] + dropped
    assert scene.triangle_count == counts["faces_out"]
    assert scene.strip_count == counts["strips"]
    assert scene.source_face_count == 60


def test_double_precision_is_rounded_to_float32_and_the_rounding_is_told():
    positions, faces = grid(3, 3)
    moved = positions.astype(np.float64) + 1 / 3
    scene, report = striptools.convert_with_report(striptools.Mesh(moved, faces))
    expected = np.abs(moved.astype(np.float32) - moved).max()
    assert report.largest_rounding == expected > 0
    assert scene.error_bound == 0.0


def test_welding_by_distance_becomes_the_error_bound_of_the_scene():
    positions, faces = grid(2, 2)
    soup = positions[faces].reshape(-1, 3)
    soup[::2] += np.float32(1e-4)
    mesh = striptools.Mesh(soup, np.arange(len(soup), dtype=np.int32).reshape(-1, 3))
    options = striptools.Options(clean=striptools.CleanOptions(weld=1e-3))
    scene, report = striptools.convert_with_report(mesh, options)
    assert scene.to_mesh().vertex_count == len(positions)
    assert 0 < scene.error_bound == report.weld_error <= 1e-3


@pytest.mark.parametrize("threads", [0, -1])
def test_a_number_of_threads_below_one_is_refused(threads):
    with pytest.raises(UsageError, match="threads"):
        striptools.Options(threads=threads)


def test_a_missing_file_is_one_clear_line(tmp_path):
    with pytest.raises(UnreadableMeshError) as error:
        striptools.convert(tmp_path / "nothing.ply")
    assert "nothing.ply" in str(error.value)
    assert "\n" not in str(error.value)


def test_the_stopwatch_sees_a_peak_that_is_gone_again():
    clock = Stopwatch()
    with clock.stage("work"):
        held = np.ones(40_000_000, np.uint8)
        del held
    seconds, peak = clock.read()
    assert set(seconds) == {"work", "total"}
    assert 35_000_000 < peak < 200_000_000


def test_the_stopwatch_manages_without_proc(monkeypatch):
    monkeypatch.setattr("striptools.stopwatch._STATUS", Path("/nonexistent/status"))
    monkeypatch.setattr("striptools.stopwatch._CLEAR_REFS", Path("/nonexistent/clear_refs"))
    seconds, peak = Stopwatch().read()
    assert set(seconds) == {"total"}
    assert 0 <= peak <= resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
