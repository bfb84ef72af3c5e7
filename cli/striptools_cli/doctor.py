"""`striptools doctor`: the environment, for bug reports."""

import importlib.metadata
import os
import platform
import sys
from typing import Annotated

from striptools import __version__
from striptools.errors import StriptoolsError
from striptools.reducem.layout import VERSION
from striptools_cli import log, notice
from striptools_cli.options import format_option
from striptools_cli.report import Format, render
from striptools_cli.streams import say

_REQUIRED = ("numpy", "numba", "llvmlite", "scipy", "networkx", "trimesh", "jaxtyping", "typer", "rich")
_EXTRAS = {
    "trace": ("jax", "jaxlib", "pillow"),
    "meshlab": ("pymeshlab",),
    "plots": ("matplotlib",),
    "simplify": ("fast-simplification",),
    "flip": ("flip-evaluator",),
    "peers": ("embreex", "meshoptimizer", "vtk", "PyFFI"),
}


def run(
    form: Annotated[Format, format_option("it")] = "text",
) -> None:
    """Print the environment, for bug reports: versions, cores, devices, caches, extras."""
    log.set_up()
    say(render(describe(), form, "striptools doctor"))


def describe() -> dict[str, object]:
    """The environment as a record."""
    return {
        "striptools": __version__,
        "format_version": f"{VERSION[0]}.{VERSION[1]}",
        "python": f"{platform.python_version()} ({sys.executable})",
        "platform": platform.platform(),
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "cores_usable": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "packages": {name: _version(name) for name in _REQUIRED},
        "extras": {extra: {name: _version(name) for name in names} for extra, names in _EXTRAS.items()},
        # Before tracing: that sets XLA_FLAGS, and the report is to show the user's.
        "environment": {
            name: value
            for name, value in sorted(os.environ.items())
            if name.startswith(("JAX_", "XLA_", "NUMBA_", "STRIPTOOLS_", "CUDA_VISIBLE"))
        },
        "kernel_cache": _kernel_cache(),
        "tracing": _tracing(),
    }


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _kernel_cache() -> dict[str, object]:
    caches = notice.kernel_caches()
    folders = sorted({str(folder) for folder, _ in caches.values()})
    return {
        "folders": folders,
        "writable": all(os.access(folder, os.W_OK) for folder in folders),
        "compiled_functions": sum(count for _, count in caches.values()),
    }


def _tracing() -> dict[str, object]:
    try:
        # Not at the top: the rest of the report must come out without JAX, too.
        from striptools.trace.device import LOOP_OPTION, trace_devices

        devices = [str(device) for device in trace_devices("auto", None)]
    except StriptoolsError as error:
        return {"available": False, "reason": str(error)}
    cache = notice.tracer_cache()
    return {
        "available": True,
        "devices": devices,
        "loops_hoisted": LOOP_OPTION in os.environ.get("XLA_FLAGS", ""),
        "cache_folder": cache and str(cache),
        "compiled_programs": sum(1 for _ in cache.glob("*-cache")) if cache and cache.is_dir() else 0,
    }
