"""Seconds by stage and the peak of memory of a run."""

import resource
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

Watch = Callable[[str, float], None]
"""Called with a stage's name and the fraction of it that is done, 0 at its start and 1 at its end."""

_STATUS = Path("/proc/self/status")
_CLEAR_REFS = Path("/proc/self/clear_refs")
_RESET_PEAK = "5"


class Stopwatch:
    """Times stages one after the other, and watches the peak of resident memory from its making on.

    Args:
        watch: Told when a stage starts and ends, or None.
    """

    def __init__(self, watch: Watch | None = None) -> None:
        self._watch = watch
        self._seconds: dict[str, float] = {}
        self._start = time.perf_counter()
        self._resident = _reset_peak()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time of the `with` block under `name`; several blocks of one name add up."""
        start = time.perf_counter()
        self._tell(name, 0.0)
        yield
        self._seconds[name] = self._seconds.get(name, 0.0) + time.perf_counter() - start
        self._tell(name, 1.0)

    def read(self) -> tuple[dict[str, float], int]:
        """The seconds by stage with `total`, and the peak in bytes above the memory held at the start."""
        total = time.perf_counter() - self._start
        return {**self._seconds, "total": total}, max(0, _peak() - self._resident)

    def _tell(self, name: str, fraction: float) -> None:
        if self._watch:
            self._watch(name, fraction)


def _reset_peak() -> int:
    # Linux forgets the peak on request; elsewhere the peak since the process began has to serve.
    try:
        _CLEAR_REFS.write_text(_RESET_PEAK)
        return _status_bytes("VmRSS")
    except OSError:
        return _peak()


def _peak() -> int:
    try:
        return _status_bytes("VmHWM")
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def _status_bytes(key: str) -> int:
    for line in _STATUS.read_text().splitlines():
        if line.startswith(key + ":"):
            return int(line.split()[1]) * 1024
    raise OSError(f"{_STATUS} has no {key}")
