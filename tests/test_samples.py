"""The samples run, the README's Python example runs, and the model has its notice."""

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import striptools

ROOT = Path(__file__).resolve().parent.parent
SAMPLES = ROOT / "samples"


def run_script(*arguments: object, folder: Path) -> str:
    command = [sys.executable, *(str(argument) for argument in arguments)]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False, timeout=300)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_main_job_runs(tmp_path: Path) -> None:
    from PIL import Image

    said = run_script(SAMPLES / "first_scene.py", folder=tmp_path)
    assert "133,112 triangles" in said
    assert "0 disagreements, 0 leaks" in said
    (picture,) = tmp_path.rglob("*.png")
    pixels = np.asarray(Image.open(picture))
    assert len(np.unique(pixels.reshape(-1, 3), axis=0)) > 100
    (scene,) = tmp_path.rglob("*.rdm")
    assert striptools.open(scene).triangle_count > 130_000


def test_the_sample_of_queries_runs(tmp_path: Path) -> None:
    said = run_script(SAMPLES / "queries.py", folder=tmp_path)
    assert "hits of a ray: 2 to 2;" in said
    assert "go 1.000 farther" in said
    assert float(re.search(r"signed distances within (\S+)", said)[1]) < 0.01


def test_the_ray_sample_runs(tmp_path: Path) -> None:
    said = run_script(SAMPLES / "trace_rays.py", folder=tmp_path)
    assert "rays hit" in said
    assert float(re.search(r"hit points: (\S+)", said)[1]) < 1e-3


def test_the_readme_example_runs(tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    (tmp_path / "samples").symlink_to(SAMPLES)
    (tmp_path / "example.py").write_text(code)
    said = run_script("example.py", folder=tmp_path)
    assert (tmp_path / "chandelier.rdm").is_file()
    assert "True" in said


@pytest.mark.parametrize("script", sorted(SAMPLES.glob("*.py")), ids=lambda path: path.name)
def test_samples_use_public_names_only(script: Path) -> None:
    assert not re.findall(r"striptools[\w.]*\._|\bimport _|\._[a-z]", script.read_text())


def test_every_model_has_its_notice() -> None:
    notice = (SAMPLES / "README.md").read_text()
    for model in SAMPLES.iterdir():
        if model.suffix not in (".py", ".md", ".txt"):
            assert f"`{model.name}`" in notice
    assert "Scopia Visual Interfaces Systems" in notice
    assert "Creative Commons" in (SAMPLES / "CC-BY-3.0.txt").read_text()
