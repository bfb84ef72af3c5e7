"""One line before the first slow compilation on a machine, so that nobody waits without a word."""

import sys
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

import striptools.kernels
from striptools_cli.streams import say

_PYTHON = f"py{sys.version_info.major}{sys.version_info.minor}"


def before_kernels(module: str, *, quiet: bool = False) -> None:
    """Say that kernels are compiled now, where no earlier run has left those of `module` compiled."""
    if not quiet and not _is_compiled(module):
        say(
            "striptools: compiling the kernels, once; this takes a while, later runs start at once\n",
            error=True,
        )


def before_tracing(*, quiet: bool = False) -> None:
    """Say that the tracer is compiled now, where no earlier run has left it compiled."""
    folder = tracer_cache()
    kept = folder is not None and folder.is_dir() and any(folder.iterdir())
    if not quiet and not (kept and _is_compiled("wide")):
        say("striptools: compiling the tracer; this takes a while\n", error=True)


def kernel_caches() -> dict[str, tuple[Path, int]]:
    """Where each kernel module keeps its compiled code, and how many of its functions lie there up to date.

    Numba falls back to a folder of the user where the package's own cannot be written, so it is asked itself.
    """
    found = {}
    for module in iter_modules(striptools.kernels.__path__, "striptools.kernels."):
        folder = _cache_folder(module.name)
        if folder is not None:
            source = Path(str(import_module(module.name).__file__))
            found[module.name] = (folder, _fresh_files(folder, source))
    return found


def tracer_cache() -> Path | None:
    """The folder in which JAX keeps compiled tracers, or None where it keeps none."""
    jax = sys.modules.get("jax")
    folder = getattr(getattr(jax, "config", None), "jax_compilation_cache_dir", None)
    return Path(folder) if folder else None


def _is_compiled(module: str) -> bool:
    found = kernel_caches().get(f"striptools.kernels.{module}")
    return found is not None and found[1] > 0


def _fresh_files(folder: Path, source: Path) -> int:
    changed = source.stat().st_mtime
    files = folder.glob(f"{source.stem}.*{_PYTHON}*.nbi")
    return sum(1 for file in files if file.stat().st_mtime >= changed)


def _cache_folder(module: str) -> Path | None:
    for kernel in vars(import_module(module)).values():
        folder = getattr(getattr(kernel, "stats", None), "cache_path", None)
        if folder and getattr(kernel, "__module__", None) == module:
            return Path(folder)
    return None
