"""A progress line on a terminal for anything over a second; silence everywhere else."""

import sys
import threading
from types import TracebackType
from typing import Self

_PATIENCE = 1.0
"""Seconds before the line appears."""


class StageProgress:
    """Shows on standard error which stage runs, for how long; only on a terminal, only after a second.

    Use it as a context manager, and its `watch` as the `watch` of a conversion or the `progress` of a check.

    Args:
        quiet: Show nothing at all.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._enabled = not quiet and sys.stderr.isatty()
        self._lock = threading.Lock()
        self._timer = threading.Timer(_PATIENCE, self._show)
        self._timer.daemon = True
        self._closed = False
        self._stage = ""
        self._fraction = 0.0
        self._bar = None
        self._task = None

    def __enter__(self) -> Self:
        if self._enabled:
            self._timer.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._timer.cancel()
        with self._lock:
            self._closed = True
            if self._bar is not None:
                self._bar.stop()

    def watch(self, stage: str, fraction: float) -> None:
        """Say that `fraction` (0 to 1) of `stage` is done."""
        with self._lock:
            self._stage, self._fraction = stage, fraction
            self._update()

    def _show(self) -> None:
        from rich.console import Console
        from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

        with self._lock:
            if self._closed:
                return
            columns = (SpinnerColumn(), TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
            self._bar = Progress(*columns, console=Console(stderr=True), transient=True)
            self._task = self._bar.add_task("", total=None)
            self._update()
            self._bar.start()

    def _update(self) -> None:
        if self._bar is None or self._task is None:
            return
        # A stage that only tells its start and its end has no known length: the bar then pulses.
        known = 0.0 < self._fraction < 1.0
        self._bar.update(
            self._task,
            description=self._stage,
            total=1.0 if known else None,
            completed=self._fraction if known else 0.0,
        )
