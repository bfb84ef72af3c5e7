"""Settings and fixtures that all tests share."""

import ctypes
import gc
import logging
import os
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

ROOT = Path(__file__).resolve().parent.parent
MOST_MEMORY = 2 << 30
"""Bytes of a process beyond which compiled programs are let go."""

SLOW_ON_PURPOSE = (HealthCheck.too_slow, HealthCheck.data_too_large)

# Kernels compile inside the first example, so no example has a deadline.
settings.register_profile("default", max_examples=40, deadline=None, suppress_health_check=SLOW_ON_PURPOSE)
settings.register_profile("quick", max_examples=8, deadline=None, suppress_health_check=SLOW_ON_PURPOSE)
settings.register_profile("thorough", max_examples=1000, deadline=None, suppress_health_check=SLOW_ON_PURPOSE)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))


def meshes_folder() -> Path | None:
    """The folder of real models: named by STRIPTOOLS_MESHES, else shared/meshes beside the repository."""
    folder = Path(os.environ.get("STRIPTOOLS_MESHES", ROOT.parent / "shared" / "meshes"))
    return folder if folder.is_dir() else None


@pytest.fixture(scope="session")
def real_mesh() -> Callable[[str], Path]:
    """`real_mesh("bunny")` or `real_mesh("scenes/x.glb")` is a real model's path, or skips the test."""

    def find(name: str) -> Path:
        folder = meshes_folder()
        if folder is None:
            pytest.skip("the folder of real models is not here (set STRIPTOOLS_MESHES)")
        path = folder / (name if "." in name else f"{name}.ply")
        if not path.exists():
            pytest.skip(f"the real model {name} is not in the folder of models")
        return path

    return find


@pytest.fixture(autouse=True, scope="module")
def programs_let_go() -> Iterator[None]:
    """Forget compiled programs after a file of tests where they take much memory: there are thousands."""
    yield
    held = Path("/proc/self/statm")
    pages = int(held.read_text().split()[1]) if held.exists() else 0
    if "jax" in sys.modules and pages * os.sysconf("SC_PAGE_SIZE") > MOST_MEMORY:
        sys.modules["jax"].clear_caches()
        gc.collect()
        # What is free goes back to the system, where the C library can be told.
        getattr(ctypes.CDLL(None), "malloc_trim", int)(0)


@pytest.fixture
def restored_logging() -> Iterator[None]:
    """Put back what a command sets up: handlers, level and filters of warnings."""
    handlers, level = logging.getLogger().handlers[:], logging.getLogger().level
    with warnings.catch_warnings():
        yield
    logging.captureWarnings(False)
    logging.getLogger().handlers[:] = handlers
    logging.getLogger().setLevel(level)


@pytest.fixture
def run(capsys: pytest.CaptureFixture[str], restored_logging: None) -> Callable[..., tuple[int, str, str]]:
    """Run a command in this process: its exit code, standard output and standard error."""
    from striptools_cli import app

    def call(*arguments: object) -> tuple[int, str, str]:
        code = app.main([str(argument) for argument in arguments])
        out, err = capsys.readouterr()
        return code, out, err

    return call
