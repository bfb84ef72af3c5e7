"""What JAX needs before its backend is up: hoisted loops, a device per core, a cache of compiled programs.

XLA's CPU backend runs every operation of a loop body on its own unless the loop is "small", when it
compiles the whole loop into one native function. A ray's walk is 10 to 40 times faster that way, so the
limit of what is small is raised through XLA_FLAGS. The flags are read once, when the backend starts:
afterwards they are ignored without a word, which is why this module warns.
"""

import logging
import os
import platform
import re
import warnings
from collections.abc import Iterator, MutableMapping
from contextlib import contextmanager
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from striptools.errors import MissingExtraError, UsageError

if TYPE_CHECKING:
    import jax

LOOP_OPTION = "xla_cpu_small_while_loop_byte_threshold"
LOOP_LIMIT = 9_000_000_000_000_000_000
"""Estimated bytes of a loop below which XLA compiles it whole: more than any loop has."""

DeviceKind = Literal["auto", "cpu", "gpu"]

_EXTRA_OPTIONS = re.compile(r"(--xla_backend_extra_options=)(\S*)")


class SlowTracingWarning(UserWarning):
    """Tracing is right, but slow: JAX was running before striptools.trace came, or a GPU kernel fails."""


def with_loop_option(flags: str) -> str:
    """Add the option that hoists loops to a value of XLA_FLAGS, leaving all else in it as it is.

    A value that the user gave the same option wins; other extra options of the user are kept beside it.
    """
    if re.search(rf"\b{LOOP_OPTION}=", flags):
        return flags
    option = f"{LOOP_OPTION}={LOOP_LIMIT}"
    found = list(_EXTRA_OPTIONS.finditer(flags))
    if not found:
        return f"{flags} --xla_backend_extra_options={option}".strip()
    last = found[-1]
    joined = f"{last[1]}{last[2]},{option}" if last[2] else f"{last[1]}{option}"
    return flags[: last.start()] + joined + flags[last.end() :]


def hoist_loops(environ: MutableMapping[str, str]) -> bool:
    """Put the option that hoists loops into XLA_FLAGS; say whether it was there before.

    XLA_FLAGS may also name a file of flags: then its content is taken over.
    """
    flags = environ.get("XLA_FLAGS", "")
    if flags and not flags.lstrip().startswith("-"):
        try:
            flags = " ".join(Path(flags.strip()).read_text().split())
        except OSError as error:
            raise UsageError(
                f"XLA_FLAGS names a file that cannot be read: {error.strerror}",
                where=flags.strip(),
                remedy="unset XLA_FLAGS or correct it",
            ) from error
    wanted = with_loop_option(flags)
    environ["XLA_FLAGS"] = wanted
    return wanted == flags


def core_count(environ: MutableMapping[str, str]) -> int:
    """Cores to trace on: STRIPTOOLS_THREADS where set, else those that this process may use."""
    wanted = environ.get("STRIPTOOLS_THREADS", "").strip()
    if not wanted:
        return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    if not wanted.isdecimal() or int(wanted) < 1:
        raise UsageError(
            f"not a number of threads: {wanted!r}",
            where="STRIPTOOLS_THREADS",
            remedy="set it to 1 or more, or unset it",
        )
    return int(wanted)


def cache_folder(environ: MutableMapping[str, str]) -> Path | None:
    """The user's folder for compiled programs, made if need be; None where there is no such place.

    One folder for each kind of processor: a home folder may be shared by machines of several kinds.
    """
    try:
        base = Path(environ["XDG_CACHE_HOME"]) if environ.get("XDG_CACHE_HOME") else Path.home() / ".cache"
        folder = base / "striptools" / f"jax-{_processor()}"
        folder.mkdir(parents=True, exist_ok=True)
    except (OSError, RuntimeError):
        return None
    return folder if os.access(folder, os.W_OK | os.X_OK) else None


def _processor() -> str:
    """A short name for the kind of processor, by what it can do."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    features = next((line for line in lines if line.startswith(("flags", "Features"))), platform.processor())
    return f"{platform.machine()}-{sha256(features.encode()).hexdigest()[:8]}"


def prepare_jax(environ: MutableMapping[str, str] = os.environ) -> None:
    """Make JAX ready for tracing; called once, when striptools.trace is imported.

    Warns:
        SlowTracingWarning: JAX's backend was up already, without hoisted loops.

    Raises:
        MissingExtraError: JAX is not installed.
        UsageError: STRIPTOOLS_THREADS is not a number of threads, or XLA_FLAGS names a file that cannot be
        read.
    """
    cores = core_count(environ)
    hoisted_before = hoist_loops(environ)
    try:
        import jax
    except ImportError as error:
        raise MissingExtraError(
            "tracing needs JAX, which is not installed", remedy='pip install "striptools[trace]"'
        ) from error
    config: Any = jax.config
    if config.jax_compilation_cache_dir is None and (folder := cache_folder(environ)) is not None:
        config.update("jax_compilation_cache_dir", str(folder))
        config.update("jax_persistent_cache_min_compile_time_secs", 0.2)
    if not set_cpu_devices(cores, environ) and not hoisted_before:
        warnings.warn(
            "JAX was running before striptools.trace was imported, so that tracing on the CPU is many times "
            "slower; import striptools.trace before JAX computes anything",
            SlowTracingWarning,
            stacklevel=2,
        )


def set_cpu_devices(count: int, environ: MutableMapping[str, str]) -> bool:
    """Ask JAX for that many CPU devices, unless the user did; say whether its backend was still down."""
    import jax

    config: Any = jax.config
    wanted = config.jax_num_cpu_devices
    if wanted < 0 and "--xla_force_host_platform_device_count" not in environ.get("XLA_FLAGS", ""):
        wanted = count
    try:
        config.update("jax_num_cpu_devices", wanted)
    except RuntimeError:
        return False
    return True


def trace_devices(kind: DeviceKind, threads: int | None) -> list["jax.Device"]:
    """The devices to trace on: one GPU, or a CPU device for each thread.

    They are this process's own, also where `jax.distributed` runs several: each traces its share of the rays
    on its own devices (`distributed`), and none waits for another while it does.

    Args:
        kind: "auto" takes a GPU where JAX has one.
        threads: CPU devices to use, at most those there are; None for all.

    Raises:
        UsageError: There is no such device, or `threads` is below 1.
    """
    import jax

    if kind not in ("auto", "cpu", "gpu"):
        raise UsageError(f"no such device: {kind!r}", remedy="use auto, cpu or gpu")
    if threads is not None and threads < 1:
        raise UsageError(f"not a number of threads: {threads}", remedy="use 1 or more")
    with quiet_jax():
        if kind != "cpu":
            try:
                return jax.local_devices(backend="gpu")[:1]
            except RuntimeError as error:
                if kind == "gpu":
                    raise UsageError(
                        "JAX finds no GPU",
                        where="device",
                        remedy="install a JAX with GPU support, or use cpu",
                    ) from error
        devices = jax.local_devices(backend="cpu")
    return devices[:threads]


@contextmanager
def quiet_jax() -> Iterator[None]:
    """Keep JAX's own warnings (no GPU found, a cache that cannot be written) from the user's eyes."""
    logger = logging.getLogger("jax")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module=r"jax(\.|$)")
            warnings.filterwarnings("ignore", message=r".*persistent compilation cache.*")
            yield
    finally:
        logger.setLevel(level)
