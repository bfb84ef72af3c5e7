"""The command line: exit codes, one line an error, nothing half-written, reports that parse, pipes."""

import contextlib
import csv
import io
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import striptools
from striptools.reducem.reader import read_scene
from striptools_cli import app, notice
from striptools_cli.progress import StageProgress

COMMAND = [str(Path(sys.executable).parent / "striptools")]
FULL_DISK = Path("/dev/full")


pytestmark = pytest.mark.usefixtures("restored_logging")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A torus as `torus.ply` and `torus.rdm`, not to be changed by a test."""
    folder = tmp_path_factory.mktemp("models")
    torus = trimesh.creation.torus(1.0, 0.4, major_sections=24, minor_sections=12)
    positions, faces = np.asarray(torus.vertices, np.float32), np.asarray(torus.faces, np.int32)
    mesh = striptools.Mesh(positions, faces)
    striptools.save_mesh(mesh, folder / "torus.ply")
    striptools.convert(mesh).save(folder / "torus.rdm")
    return folder


def run_process(
    *arguments: object, stdin: bytes | None = None, **options: object
) -> subprocess.CompletedProcess[bytes]:
    command = COMMAND + [str(argument) for argument in arguments]
    return subprocess.run(command, input=stdin, capture_output=True, check=False, timeout=120, **options)  # pyright: ignore[reportArgumentType, reportCallIssue]


def without_metadata(file: Path | bytes) -> bytes:
    """The bytes of a scene file as they would be without metadata, which name the source."""
    scene = read_scene(file)
    out = io.BytesIO()
    replace(scene, metadata={}).save(out)
    return out.getvalue()


def assert_one_error_line(err: str, *parts: str) -> None:
    assert err.startswith("striptools: error: ")
    assert err.count("\n") == 1
    for part in parts:
        assert part in err


def faces_by_corners(mesh: striptools.Mesh) -> list[bytes]:
    return [mesh.positions[face].astype(np.float32).tobytes() for face in mesh.faces]


# The way there and back


def test_convert_says_one_line(run, folder: Path, tmp_path: Path) -> None:
    code, out, err = run("convert", folder / "torus.ply", tmp_path / "torus.rdm")
    assert (code, err) == (0, "")
    assert out.count("\n") == 1
    assert out.startswith("torus.ply (")
    assert "-> torus.rdm (" in out
    assert "576 triangles" in out
    assert "vertices per triangle" in out
    assert without_metadata(tmp_path / "torus.rdm") == without_metadata(folder / "torus.rdm")


@pytest.mark.parametrize("form", ["ply", "obj", "stl", "glb"])
def test_convert_back_gives_every_face_as_it_was(run, folder: Path, tmp_path: Path, form: str) -> None:
    code, out, err = run("convert", folder / "torus.rdm", tmp_path / f"back.{form}")
    assert (code, err) == (0, "")
    assert "in the source's order" in out
    back = striptools.load_mesh(tmp_path / f"back.{form}")
    assert faces_by_corners(back) == faces_by_corners(striptools.load_mesh(folder / "torus.ply"))


def test_without_a_remap_the_order_is_the_files(run, folder: Path, tmp_path: Path) -> None:
    assert run("convert", folder / "torus.ply", tmp_path / "a.rdm", "--no-remap")[0] == 0
    code, out, _ = run("convert", tmp_path / "a.rdm", tmp_path / "a.ply")
    assert code == 0
    assert "the scene has no remap" in out
    assert striptools.load_mesh(tmp_path / "a.ply").triangle_count == 576


def test_quiet_says_nothing(run, folder: Path, tmp_path: Path) -> None:
    assert run("convert", folder / "torus.ply", tmp_path / "a.rdm", "--quiet") == (0, "", "")


def test_verbose_says_stages_and_parts(run, folder: Path, tmp_path: Path) -> None:
    _, out, _ = run("convert", folder / "torus.ply", tmp_path / "a.rdm", "-v")
    for word in ("load", "clean", "partition", "order", "write", "total", "positions", "remap", "container"):
        assert f"\n  {word} " in out


def test_what_cleaning_drops_is_said(run, tmp_path: Path) -> None:
    vertices = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 2 0 0\nv 0 0 0\nv nan 0 0\n"
    (tmp_path / "odd.obj").write_text(vertices + "f 1 2 3\nf 1 2 4\nf 1 5 3\nf 1 2 6\nf 1 2 3\n")
    code, out, _ = run("convert", tmp_path / "odd.obj", tmp_path / "odd.rdm", "--report", tmp_path / "r.json")
    assert code == 0
    assert "dropped 1 face of zero area" in out
    assert "dropped 1 face with a repeated vertex" in out
    assert "dropped 1 face with a non-finite vertex" in out
    assert "kept 1 duplicate face" in out
    counts = json.loads((tmp_path / "r.json").read_text())["counts"]
    dropped = ("non_finite", "repeated_vertex", "zero_area", "duplicate_faces_dropped")
    assert counts["faces_in"] == counts["faces_out"] + sum(counts[reason] for reason in dropped) == 5
    assert (
        run("convert", tmp_path / "odd.obj", tmp_path / "b.rdm", "--drop-duplicates")[1].count("duplicate")
        == 1
    )


def test_report_holds_seconds_peak_and_counts(run, folder: Path, tmp_path: Path) -> None:
    run("convert", folder / "torus.ply", tmp_path / "a.rdm", "--report", tmp_path / "r.json")
    report = json.loads((tmp_path / "r.json").read_text())
    assert next(iter(report["seconds"])) == "load"
    assert list(report["seconds"])[-2:] == ["write", "total"]
    stages = [seconds for stage, seconds in report["seconds"].items() if stage != "total"]
    assert sum(stages) <= report["seconds"]["total"] + 1e-6
    assert report["peak_bytes"] >= 0
    assert report["counts"]["triangles"] == 576


def test_report_on_standard_output_is_nothing_but_json(run, folder: Path, tmp_path: Path) -> None:
    _, out, err = run("convert", folder / "torus.ply", tmp_path / "a.rdm", "--report", "-")
    assert json.loads(out)["counts"]["triangles"] == 576
    assert err.startswith("torus.ply (")


def test_options_reach_the_stages(run, folder: Path, tmp_path: Path) -> None:
    run("convert", folder / "torus.ply", tmp_path / "a.rdm", "--max-length", 5, "--threads", 1)
    lengths = np.diff(striptools.open(tmp_path / "a.rdm").starts)
    assert lengths.max() == 5
    run("convert", folder / "torus.ply", tmp_path / "b.rdm", "--weld", 0.2, "--report", tmp_path / "r.json")
    report = json.loads((tmp_path / "r.json").read_text())
    assert report["counts"]["vertices_welded"] > 0
    assert 0.0 < report["weld_error"] <= 0.2


def test_a_grid_is_said_and_declared(run, folder: Path, tmp_path: Path) -> None:
    _, out, _ = run("convert", folder / "torus.ply", tmp_path / "a.rdm", "--bits", 8)
    assert "\n  quantised: to a grid of " in out
    scene = striptools.open(tmp_path / "a.rdm")
    assert scene.grid_exponent is not None
    facts = json.loads(run("info", tmp_path / "a.rdm", "--format", "json")[1])
    assert facts["precision"]["kind"] == "grid"
    assert facts["precision"]["bits"] <= 8
    assert facts["precision"]["error_bound"] == scene.error_bound > 0
    assert run("verify", tmp_path / "a.rdm", "--against", folder / "torus.ply", "--rays", 500)[0] == 0
    for error in (scene.error_bound, f"{scene.error_bound / diagonal(scene) * 1.01}rel"):
        assert (
            run("convert", folder / "torus.ply", tmp_path / "b.rdm", "--force", "--max-error", error)[0] == 0
        )
        assert striptools.open(tmp_path / "b.rdm").grid_exponent == scene.grid_exponent


def diagonal(scene: striptools.Scene) -> float:
    return float(np.linalg.norm(scene.high.astype(np.float64) - scene.low))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--bits", 8, "--max-error", 1), "leave one out"),
        (("--max-error", "much"), "1e-4rel"),
        (("--max-error", -1), "above 0"),
        (("--max-error", "1e-30"), "more than 24 bits"),
    ],
)
def test_a_precision_that_cannot_be_is_refused(run, folder: Path, tmp_path: Path, options, said) -> None:
    code, _, err = run("convert", folder / "torus.ply", tmp_path / "a.rdm", *options)
    assert code == 2
    assert_one_error_line(err, said)
    assert not (tmp_path / "a.rdm").exists()


def test_stored_boxes_and_archives_hold_the_same_scene(run, folder: Path, tmp_path: Path) -> None:
    plain = (folder / "torus.ply", tmp_path / "plain.rdm")
    assert run("convert", *plain, "--boxes", "stored")[0] == 0
    assert (
        run("convert", folder / "torus.ply", tmp_path / "packed.rdm", "--boxes", "stored", "--archive")[0]
        == 0
    )
    scene, packed = read_scene(tmp_path / "plain.rdm"), tmp_path / "packed.rdm"
    assert scene.boxes == "stored"
    assert packed.stat().st_size < (tmp_path / "plain.rdm").stat().st_size
    assert without_metadata(packed) == without_metadata(tmp_path / "plain.rdm")
    code, _, err = run("convert", folder / "torus.rdm", tmp_path / "back.ply", "--archive")
    assert code == 2
    assert_one_error_line(err, "--archive")


# Refusals


def test_an_existing_output_is_refused_without_force(run, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.rdm"
    out.write_bytes(b"mine")
    code, _, err = run("convert", folder / "torus.ply", out)
    assert code == 2
    assert_one_error_line(err, "exists already", "--force")
    assert out.read_bytes() == b"mine"
    assert run("convert", folder / "torus.ply", out, "--force")[0] == 0
    assert without_metadata(out) == without_metadata(folder / "torus.rdm")


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        (("convert", "torus.ply"), ["OUT"]),
        (("convert", "torus.ply", "x.rdm", "--unknown"), ["--unknown"]),
        (("convert", "torus.ply", "x.rdm", "--max-length", "0"), ["--max-length"]),
        (("convert", "torus.ply", "x.rdm", "--max-length", "many"), ["--max-length"]),
        (("convert", "torus.ply", "x.rdm", "--threads", "0"), ["--threads"]),
        (("convert", "torus.ply", "x.rdm", "--weld", "-1"), ["--weld"]),
        (("convert", "torus.ply", "x.rdm", "--weld", "nan"), ["weld"]),
        (("convert", "torus.ply", "x.doc"), ["doc", "--to", "rdm"]),
        (("convert", "torus.ply", "x.obj"), ["neither", "rdm"]),
        (("convert", "torus.rdm", "x.rdm"), ["both", "rdm"]),
        (("convert", "torus.rdm", "x.ply", "--no-remap"), ["scene already"]),
        (("convert", "torus.ply", "torus.ply", "--to", "rdm", "--force"), ["read and written"]),
        (("convert", "torus.ply", "x.rdm", "--report", "x.rdm"), ["read and written"]),
        (("convert", "torus.ply", "."), ["--to"]),
        (("convert", "torus.ply", "-"), ["standard output", "--to"]),
        (("info", "torus.rdm", "--format", "xml"), ["--format"]),
        (("verify", "torus.rdm"), ["--against"]),
        (("verify", "-", "--against", "-"), ["one file", "--against"]),
        (("render", "torus.rdm", "x.jpg"), ["x.jpg", ".png"]),
        (("render", "torus.rdm", "x.png", "--view", "1,2"), ["--view", "three numbers"]),
        (("render", "torus.rdm", "x.png", "--view", "0,0,0"), ["view"]),
        (("render", "torus.rdm", "x.png", "--shading", "oil"), ["--shading"]),
        (("render", "torus.rdm", "x.png", "--ao", "-1"), ["--ao"]),
        (("render", "torus.rdm"), ["turntable", "OUT.png"]),
        (("render", "torus.rdm", "--turntable", "3"), ["--out"]),
        (("render", "torus.rdm", "x.png", "--out", "x"), ["--turntable"]),
        (("render", "torus.rdm", "-", "--progressive"), ["--progressive", "name a file"]),
        (("dance",), ["dance"]),
        (("--dance",), ["--dance"]),
    ],
)
def test_bad_usage_is_one_line_and_exit_2(
    run, folder: Path, monkeypatch, arguments, parts: list[str]
) -> None:
    monkeypatch.chdir(folder)
    before = sorted(folder.iterdir())
    code, out, err = run(*arguments)
    assert (code, out) == (2, "")
    assert_one_error_line(err, *parts)
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("absent.ply", None),
        ("empty.ply", b""),
        ("text.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n"),
        ("noise.stl", bytes(range(256))),
        ("nameless", b"what is this"),
        ("other.docx", b"PK"),
        ("flat.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"),
        ("noise.rdm", bytes(range(256))),
        ("absent.rdm", None),
        ("empty.rdm", b""),
    ],
)
def test_an_unreadable_input_is_one_line_and_exit_3(
    run, tmp_path: Path, name: str, content: bytes | None
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    out = tmp_path / ("out.ply" if name.endswith(".rdm") else "out.rdm")
    code, said, err = run("convert", tmp_path / name, out)
    assert (code, said) == (3, "")
    assert_one_error_line(err.rpartition("striptools: compiling")[2].partition("\n")[2] or err)
    assert not out.exists()


def test_a_damaged_scene_is_refused(run, folder: Path, tmp_path: Path) -> None:
    data = bytearray((folder / "torus.rdm").read_bytes())
    data[len(data) // 2] ^= 1
    (tmp_path / "bad.rdm").write_bytes(data)
    code, out, err = run("info", tmp_path / "bad.rdm")
    assert (code, out) == (3, "")
    assert_one_error_line(err, "bad.rdm")


@pytest.mark.skipif(not FULL_DISK.exists(), reason="no device that is always full")
def test_a_full_disk_is_one_line_and_exit_3(run, folder: Path) -> None:
    code, _, err = run("convert", folder / "torus.ply", FULL_DISK, "--to", "rdm")
    assert code == 3
    assert_one_error_line(err, "/dev/full", "space")
    assert not FULL_DISK.is_file()
    with FULL_DISK.open("wb") as full:
        command = [*COMMAND, "convert", str(folder / "torus.ply"), "-", "--to", "rdm"]
        done = subprocess.run(command, stdout=full, stderr=subprocess.PIPE, check=False, timeout=120)
        assert done.returncode == 3
        assert_one_error_line(done.stderr.decode(), "standard output", "space")


@pytest.mark.parametrize("place", ["absent", "/proc"])
def test_a_folder_that_takes_no_file_is_exit_3(run, folder: Path, tmp_path: Path, place: str) -> None:
    # Root may write into a read-only folder, but not even root makes a file in /proc.
    code, _, err = run("convert", folder / "torus.ply", tmp_path / place / "a.rdm")
    assert code == 3
    assert_one_error_line(err, "a.rdm")


# Ends that nobody planned


@pytest.mark.parametrize(
    ("error", "code", "part"),
    [
        (KeyboardInterrupt(), 130, "interrupted"),
        (MemoryError(), 3, "not enough memory"),
        (OSError(5, "Input/output error", "disk"), 3, "disk: Input/output error"),
        (RuntimeError("two\nlines"), 3, "internal error: RuntimeError: two lines"),
    ],
)
def test_every_end_is_one_line(
    run, folder: Path, monkeypatch, error: BaseException, code: int, part: str
) -> None:
    from striptools_cli import info

    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(info, "read_scene", fail)
    monkeypatch.delenv("STRIPTOOLS_TRACEBACK", raising=False)
    found, out, err = run("info", folder / "torus.rdm")
    assert (found, out) == (code, "")
    assert_one_error_line(err, part)
    monkeypatch.setenv("STRIPTOOLS_TRACEBACK", "1")
    assert ("Traceback" in run("info", folder / "torus.rdm")[2]) == (code != 130)


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_signal_ends_in_order(tmp_path: Path, sent: signal.Signals, code: int) -> None:
    command = [*COMMAND, "convert", "-", str(tmp_path / "a.rdm"), "--from", "ply"]
    # A shell ignores SIGINT for what it runs in the background, and a child would inherit that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as process:
        assert process.stdin
        # More than a pipe holds: once this returns, the command is reading.
        process.stdin.write(bytes(1 << 20))
        process.stdin.flush()
        time.sleep(0.5)
        process.send_signal(sent)
        # Not communicate(): that would close the input, and race the signal.
        process.wait(timeout=120)
        assert process.stderr
        err = process.stderr.read().decode()
    assert process.returncode == code
    assert err == ("striptools: error: interrupted\n" if code == 130 else "")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("form", ["rdm", "ply"])
def test_an_interrupted_write_leaves_nothing_behind(
    run, folder: Path, tmp_path: Path, monkeypatch, form: str
) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "replace", interrupt)
    source = folder / ("torus.ply" if form == "rdm" else "torus.rdm")
    code, out, err = run("convert", source, tmp_path / f"a.{form}")
    assert (code, out) == (130, "")
    assert_one_error_line(err, "interrupted")
    assert not list(tmp_path.iterdir())


def test_a_closed_pipe_is_no_traceback(folder: Path) -> None:
    reading, writing = os.pipe()
    os.close(reading)
    with os.fdopen(writing, "wb") as pipe:
        command = [*COMMAND, "info", str(folder / "torus.rdm")]
        done = subprocess.run(
            command, stdout=pipe, stderr=subprocess.PIPE, text=True, check=False, timeout=120
        )
    assert done.returncode == 3
    assert_one_error_line(done.stderr, "standard output", "closed")


# Pipes


def test_pipes_carry_meshes_and_scenes(folder: Path) -> None:
    there = run_process(
        "convert", "-", "-", "--from", "ply", "--to", "rdm", stdin=(folder / "torus.ply").read_bytes()
    )
    assert there.returncode == 0
    assert without_metadata(there.stdout) == without_metadata(folder / "torus.rdm")
    assert b"standard input (" in there.stderr
    back = run_process("convert", "-", "-", "--from", "rdm", "--to", "ply", "--quiet", stdin=there.stdout)
    assert (back.returncode, back.stderr) == (0, b"")
    mesh = striptools.load_mesh(io.BytesIO(back.stdout), file_format="ply")
    assert faces_by_corners(mesh) == faces_by_corners(striptools.load_mesh(folder / "torus.ply"))
    told = run_process("info", "-", "--format", "json", stdin=there.stdout)
    assert json.loads(told.stdout)["triangles"] == 576


def test_no_colour_and_no_progress_in_pipes(folder: Path, tmp_path: Path) -> None:
    environment = {**os.environ, "TERM": "xterm-256color"}
    for arguments in (
        ("convert", folder / "torus.ply", tmp_path / "a.rdm", "-v"),
        ("--help",),
        ("convert", "--help"),
    ):
        done = run_process(*arguments, env=environment)
        assert done.returncode == 0
        assert b"\x1b" not in done.stdout + done.stderr


def test_block_0_orders_in_chunks_and_groups_the_strips_afterwards(run, folder: Path, tmp_path: Path) -> None:
    figures = {}
    for block in (0, 64):
        assert run("convert", folder / "torus.ply", tmp_path / f"{block}.rdm", "--block", block)[0] == 0
        facts = json.loads(run("info", tmp_path / f"{block}.rdm", "--format", "json")[1])
        figures[block] = facts["vertices_per_triangle"]
    assert figures[0] < figures[64]
    code, _, err = run("convert", folder / "torus.ply", tmp_path / "one.rdm", "--block", 1)
    assert code == 2
    assert "block" in err


# Reports


def test_info_has_the_names_that_programs_rely_on(run, folder: Path) -> None:
    code, out, _ = run("info", folder / "torus.rdm", "--format", "json")
    facts = json.loads(out)
    scene = striptools.open(folder / "torus.rdm")
    assert code == 0
    assert facts["triangles"] == 576
    assert facts["vertices"] == scene.vertex_count
    assert facts["vertex_duplication"] == pytest.approx(scene.vertex_count / 288)
    assert facts["blocks"] == scene.block_count
    assert facts["boxes"] == "rebuilt"
    assert facts["resident_bytes_per_triangle"] == scene.resident_bytes_per_triangle()
    assert sum(facts["axes"][name] for name in ("multiples", "multiples_and_minus_zero", "float_bits")) == (
        3 * scene.block_count
    )
    assert facts["metadata"]["generator"] == f"striptools {striptools.__version__}"
    assert facts["strips"] == scene.strip_count
    assert facts["vertices_per_triangle"] == pytest.approx(1 + 2 * scene.strip_count / 576)
    assert facts["format_version"] == "0.4"
    assert facts["flips"] == 0
    assert facts["precision"] == {"kind": "lossless", "bits": 32, "error_bound": 0.0}
    parts = facts["bytes"]
    total = parts.pop("total")
    assert total == sum(parts.values()) == (folder / "torus.rdm").stat().st_size
    assert facts["bytes_per_triangle"] == pytest.approx((total - parts["remap"]) / 576)


def test_info_in_the_other_formats(run, folder: Path) -> None:
    rows = dict(csv.reader(io.StringIO(run("info", folder / "torus.rdm", "--format", "csv")[1])))
    assert rows["triangles"] == "576"
    positions = striptools.open(folder / "torus.rdm").part_bytes()["positions"]
    assert rows["bytes.positions"] == str(positions)
    assert "| triangles | 576 |\n" in run("info", folder / "torus.rdm", "--format", "md")[1]
    assert run("info", folder / "torus.rdm")[1].startswith("torus.rdm\n  triangles ")


def test_verify_proves_a_scene(run, folder: Path) -> None:
    scene, mesh = folder / "torus.rdm", folder / "torus.ply"
    code, out, _ = run("verify", scene, "--against", mesh, "--rays", 2000, "--format", "json")
    facts = json.loads(out)
    assert code == 0
    assert facts["rays"] > 0
    assert (facts["disagreements"], facts["leaks"]) == (0, 0)
    assert facts["max_t_error"] >= 0.0


def test_verify_in_the_other_formats(run, folder: Path) -> None:
    few = (
        "verify",
        folder / "torus.rdm",
        "--against",
        folder / "torus.ply",
        "--rays",
        30,
        "--aimed-rays",
        100,
    )
    rows = dict(csv.reader(io.StringIO(run(*few, "--format", "csv")[1])))
    assert (rows["ok"], rows["disagreements"], rows["sets.camera.rays"]) == ("true", "0", "30")
    assert "| leaks | 0 |\n" in run(*few, "--format", "md")[1]
    assert run(*few)[1].startswith("torus.rdm against torus.ply: proved, ")
    assert run(*few, "--quiet") == (0, "", "")


def test_verify_exits_1_on_another_model(run, folder: Path, tmp_path: Path) -> None:
    mesh = striptools.load_mesh(folder / "torus.ply")
    other = striptools.Mesh(np.ascontiguousarray(mesh.positions * np.float32(1.01)), mesh.faces)
    striptools.save_mesh(other, tmp_path / "other.ply")
    code, out, _ = run("verify", folder / "torus.rdm", "--against", tmp_path / "other.ply", "--rays", 500)
    assert code == 1
    assert "disagreements" in out


@pytest.mark.parametrize("shading", ["normal", "depth", "strip", "steps", "light"])
def test_render_draws_a_picture(run, folder: Path, tmp_path: Path, shading: str) -> None:
    from PIL import Image

    picture = tmp_path / "torus.png"
    size = ("--width", 48, "--height", 32)
    assert run("render", folder / "torus.rdm", picture, "--shading", shading, *size)[0] == 0
    pixels = np.asarray(Image.open(picture))
    assert pixels.shape == (32, 48, 3)
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 3
    assert run("render", folder / "torus.rdm", picture, *size)[0] == 2


def test_render_draws_a_turntable(run, folder: Path, tmp_path: Path) -> None:
    from PIL import Image

    out = tmp_path / "turn"
    order = ("render", folder / "torus.rdm", "--turntable", 3, "--out", out, "--shading", "light")
    order = (*order, "--width", 40, "--height", 24, "--samples", 1, "--ao", 4, "--no-shadow")
    code, said, _ = run(*order)
    assert code == 0
    assert "3 frames" in said
    names = sorted(file.name for file in out.iterdir())
    assert names == ["frame_0000.png", "frame_0001.png", "frame_0002.png", "turntable.gif"]
    frames = [np.asarray(Image.open(out / name)) for name in names[:3]]
    assert all(frame.shape == (24, 40, 3) for frame in frames)
    assert (frames[0] != frames[1]).any()
    with Image.open(out / "turntable.gif") as film:
        assert film.n_frames == 3
    assert run(*order)[0] == 2
    (tmp_path / "file").write_text("")
    assert run("render", folder / "torus.rdm", "--turntable", 1, "--out", tmp_path / "file")[0] == 3


def test_a_picture_on_its_way_is_whole(run, folder: Path, tmp_path: Path, monkeypatch) -> None:
    from striptools_cli import render as verb

    written = []
    save = verb.save_png
    monkeypatch.setattr(verb, "SHOW_SECONDS", 0.0)
    monkeypatch.setattr(verb, "save_png", lambda picture, place: written.append(1) or save(picture, place))
    size = ("--width", 300, "--height", 20, "--samples", 1)
    once, now = tmp_path / "once.png", tmp_path / "now.png"
    assert run("render", folder / "torus.rdm", once, *size)[0] == 0
    assert len(written) == 1
    assert run("render", folder / "torus.rdm", now, *size, "--progressive")[0] == 0
    assert len(written) == 1 + 3
    assert once.read_bytes() == now.read_bytes()


def test_doctor_tells_the_environment(run) -> None:
    code, out, _ = run("doctor", "--format", "json")
    facts = json.loads(out)
    assert code == 0
    assert facts["striptools"] == striptools.__version__
    assert facts["packages"]["numpy"] == np.__version__
    assert facts["kernel_cache"]["folders"]
    assert facts["tracing"]["available"]
    assert facts["tracing"]["loops_hoisted"]


# Help, progress and notices


@pytest.mark.parametrize("verb", app.VERBS)
def test_help_names_the_verb_and_its_options(run, verb: str) -> None:
    code, out, err = run(verb, "--help")
    assert (code, err) == (0, "")
    assert f"striptools {verb}" in out


def test_help_shows_defaults_and_ranges(run) -> None:
    out = " ".join(run("convert", "--help")[1].split())
    assert "default: 128; x>=1" in out
    assert "default: (every core)" in out
    assert "default: (extension)" in out


def test_no_arguments_and_version(run) -> None:
    assert run("--version") == (0, f"striptools {striptools.__version__}\n", "")
    assert run() == run("--help")


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_progress_shows_only_on_a_terminal_and_only_after_a_second(monkeypatch) -> None:
    shown = []
    for stream, quiet, seconds in (
        (_Terminal(), False, 60.0),
        (_Terminal(), True, 1.2),
        (_Terminal(), False, 0.0),
    ):
        end = time.monotonic() + seconds
        with contextlib.redirect_stderr(stream), StageProgress(quiet=quiet) as progress:
            progress.watch("partition", 0.0)
            # A busy machine may take its time to import what draws the line.
            while time.monotonic() < end and not stream.getvalue():
                time.sleep(0.05)
            progress.watch("partition", 0.5)
        shown.append(stream.getvalue())
    assert "partition" in shown[0]
    assert shown[1:] == ["", ""]


def test_a_notice_comes_before_the_first_compilation(monkeypatch, capsys) -> None:
    caches = {"striptools.kernels.a": (Path(), 0), "striptools.kernels.b": (Path(), 3)}
    monkeypatch.setattr(notice, "kernel_caches", lambda: caches)
    notice.before_kernels("a", quiet=True)
    notice.before_kernels("b")
    assert capsys.readouterr().err == ""
    notice.before_kernels("a")
    assert "compiling the kernels" in capsys.readouterr().err


def test_compiled_code_older_than_its_source_does_not_count(tmp_path: Path) -> None:
    source, code = (
        tmp_path / "kernel.py",
        tmp_path / f"kernel.f-1.py{sys.version_info[0]}{sys.version_info[1]}.nbi",
    )
    source.touch()
    code.touch()
    assert notice._fresh_files(tmp_path, source) == 1
    os.utime(code, (0, 0))
    assert notice._fresh_files(tmp_path, source) == 0


def test_the_kernel_caches_are_found(folder: Path) -> None:
    caches = notice.kernel_caches()
    assert "striptools.kernels.object_split" in caches
    assert all(path.is_dir() for path, files in caches.values() if files)
    assert sum(files for _, files in caches.values()) > 0


@pytest.mark.parametrize(("verb", "code"), [("info", 0), ("doctor", 0), ("verify", 2), ("render", 2)])
def test_without_jax_only_tracing_is_missing(folder: Path, tmp_path: Path, verb: str, code: int) -> None:
    rest = {
        "info": ["torus.rdm"],
        "doctor": [],
        "verify": ["torus.rdm", "--against", "torus.ply"],
        "render": ["torus.rdm", str(tmp_path / "x.png")],
    }
    script = "import sys; sys.modules['jax'] = None; from striptools_cli.app import main; sys.exit(main())"
    command = [sys.executable, "-c", script, verb, *rest[verb]]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == code
    if code:
        assert_one_error_line(done.stderr, "JAX", "striptools[trace]")
