"""One line before the first slow compilation on a machine, so that nobody waits without a word."""

import sys
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import striptools.kernels
from striptools_cli.streams import say

_PYTHON = f"py{sys.version_info.major}{sys.version_info.minor}"


def before_kernels(*, quiet: bool = False) -> None:
    """Say that the kernels are compiled now, where no earlier run has left them compiled."""
    if not quiet and not any(files for _, files in kernel_caches().values()):
        say(
            "striptools: compiling the kernels for this machine, once; later runs start at once\n", error=True
        )


def before_tracing(*, quiet: bool = False) -> None:
    """Say that the tracer is compiled now, where no earlier run has left it compiled."""
    folder = tracer_cache()
    if not quiet and (folder is None or not folder.is_dir() or not any(folder.iterdir())):
        say("striptools: compiling the tracer, this takes some seconds\n", error=True)


def kernel_caches() -> dict[str, tuple[Path, int]]:
    """Where each kernel module keeps its compiled code, and how many files lie there for this Python.

    Numba falls back to a folder of the user where the package's own cannot be written, so it is asked itself.
    """
    found = {}
    for module in iter_modules(striptools.kernels.__path__, "striptools.kernels."):
        folder = _cache_folder(module.name)
        if folder is not None:
            pattern = (
                f"{module.name.rpartition('.')[2]}.*py{sys.version_info.major}{sys.version_info.minor}*.nbi"
            )
            found[module.name] = (folder, sum(1 for _ in folder.glob(pattern)))
    return found


def tracer_cache() -> Path | None:
    """The folder in which JAX keeps compiled tracers, or None where it keeps none."""
    jax = sys.modules.get("jax")
    folder = getattr(getattr(jax, "config", None), "jax_compilation_cache_dir", None)
    return Path(folder) if folder else None


def _cache_folder(module: str) -> Path | None:
    for kernel in vars(import_module(module)).values():
        folder = getattr(getattr(kernel, "stats", None), "cache_path", None)
        if folder and getattr(kernel, "__module__", None) == module:
            return Path(folder)
    return None
