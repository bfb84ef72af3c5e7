"""The machine and the versions that a figure was measured with."""

import importlib.metadata
import os
import platform
from pathlib import Path

PACKAGES = (
    "striptools", "numpy", "numba", "trimesh", "jax", "embreex", "meshoptimizer", "vtk", "PyFFI",
    "DracoPy", "zstandard",
)  # fmt: skip
"""Those whose version may change a figure."""


def machine() -> str:
    """The processor and how many cores of it this process may use."""
    model = platform.machine()
    info = Path("/proc/cpuinfo")
    if info.exists():
        lines = [line for line in info.read_text().splitlines() if "model name" in line]
        names = [line.split(":", 1)[1].strip() for line in lines]
        model = names[0] if names else model
    return f"{model}, {len(os.sched_getaffinity(0))} cores"


def versions() -> str:
    """Python and the packages whose version may change a figure, as far as they are installed."""
    found = [f"python {platform.python_version()}"]
    for package in PACKAGES:
        try:
            found.append(f"{package} {importlib.metadata.version(package)}")
        except importlib.metadata.PackageNotFoundError:
            continue
    return "; ".join(found)
