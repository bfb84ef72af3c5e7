"""`striptools convert --strips`: what it writes, what it says, what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from strategies import sphere

import striptools


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sphere as `ball.ply` and `ball.rdm`, not to be changed by a test."""
    folder = tmp_path_factory.mktemp("models")
    mesh = striptools.Mesh(*sphere(3))
    striptools.save_mesh(mesh, folder / "ball.ply")
    striptools.convert(mesh).save(folder / "ball.rdm")
    return folder


def corners(positions: np.ndarray, faces: np.ndarray) -> list[list[list[float]]]:
    rows = []
    for face in faces.tolist():
        if len(set(face)) == 3:
            points = [np.asarray(positions[v], np.float32).tolist() for v in face]
            least = points.index(min(points))
            rows.append(points[least:] + points[:least])
    return sorted(rows)


@pytest.mark.parametrize("source", ["ball.ply", "ball.rdm"])
@pytest.mark.parametrize("form", ["glb", "ply", "obj", "stl"])
def test_strips_are_read_back_by_trimesh(run, folder: Path, tmp_path: Path, source: str, form: str) -> None:
    code, out, err = run("convert", folder / source, tmp_path / f"out.{form}", "--strips")
    assert code == 0
    assert "error" not in err
    assert "indices per triangle" in out
    assert ("stitched by repeated vertices" if form == "glb" else "restarts counted") in out
    scene = trimesh.load(tmp_path / f"out.{form}", process=False)
    back = scene if isinstance(scene, trimesh.Trimesh) else next(iter(scene.geometry.values()))
    assert corners(back.vertices, back.faces) == corners(*sphere(3))


def test_the_report_holds_the_count(run, folder: Path, tmp_path: Path) -> None:
    arguments = ("convert", folder / "ball.ply", tmp_path / "out.glb", "--strips", "--effort", "best")
    assert run(*arguments, "--report", tmp_path / "r.json")[0] == 0
    report = json.loads((tmp_path / "r.json").read_text())
    assert list(report["seconds"]) == ["load", "order", "write", "total"]
    counts = report["counts"]
    assert counts["triangles"] == 512
    assert counts["restarts"] == 0
    assert report["indices_per_triangle"] == counts["indices"] / 512


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("ball.ply", "out.rdm", "--strips"), "strips of its own"),
        (("ball.ply", "out.ply"), "--strips turns a mesh into a mesh of strips"),
        (("ball.ply", "out.glb", "--strips", "--max-length", "16"), "shapes a scene"),
        (("ball.ply", "out.glb", "--strips", "--no-remap"), "shapes a scene"),
        (("ball.rdm", "out.glb", "--strips", "--weld", "0.1"), "clean already"),
        (("ball.ply", "out.xyz", "--strips"), "unknown format"),
    ],
)
def test_what_cannot_be_done_is_refused_in_one_line(
    run, folder: Path, tmp_path: Path, arguments: tuple[str, ...], complaint: str
) -> None:
    source, target, *rest = arguments
    code, out, err = run("convert", folder / source, tmp_path / target, *rest)
    assert (code, out) == (2, "")
    assert err.count("\n") == 1
    assert complaint in err
    assert not (tmp_path / target).exists()


def test_a_mesh_with_no_face_left_is_refused(run, tmp_path: Path) -> None:
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    code, _, err = run("convert", tmp_path / "flat.obj", tmp_path / "out.glb", "--strips")
    assert code == 3
    assert "no face is left" in err
