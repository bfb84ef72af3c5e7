"""Threads over nogil kernels: equal chunks, parts by hash, jobs that give rise to more, and work on the side.

None decides anything: the caller's kernels write to disjoint places or return what is joined in order, so
that results do not depend on the number of threads.
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import pairwise
from typing import Any, TypeVar

SMALLEST_CHUNK = 1 << 14
"""Rows below which another thread is not worth its start."""

CHUNKS_A_THREAD = 4
"""So that a thread that is held up does not hold up the others for long."""

Result = TypeVar("Result")


def every_core() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


def in_chunks(
    work: Callable[[tuple[int, int]], Result], count: int, threads: int, smallest: int = SMALLEST_CHUNK
) -> list[Result]:
    """Do `work((begin, end))` for chunks that cover `0 .. count`, and give the results in order.

    With one thread, or fewer than twice `smallest` rows, it is one chunk in the thread of the caller.
    """
    chunks = min(threads * CHUNKS_A_THREAD, count // smallest) if threads > 1 else 1
    if chunks <= 1:
        return [work((0, count))]
    bounds = [count * k // chunks for k in range(chunks + 1)]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, pairwise(bounds)))


def in_parts(work: Callable[[int, int], Result], count: int, threads: int) -> list[Result]:
    """Do `work(part, parts)` for a part a thread, and give the results in order; one part for few rows."""
    parts = max(1, min(threads, count // SMALLEST_CHUNK))
    if parts == 1:
        return [work(0, 1)]
    with ThreadPoolExecutor(parts) as pool:
        return list(pool.map(work, range(parts), [parts] * parts))


def run_jobs(work: Callable[..., Iterable[Iterable[int]]], first: tuple[int, ...], threads: int) -> None:
    """Do `work(*job)` for a first job and for every job that any job returns.

    An exception of a job is raised here, after the jobs that had begun.
    """
    if threads <= 1:
        waiting = [first]
        while waiting:
            waiting.extend(tuple(job) for job in work(*waiting.pop()))
        return
    with ThreadPoolExecutor(threads) as pool:
        pending: set[Future[Iterable[Iterable[int]]]] = {pool.submit(work, *first)}
        while pending:
            done, pending = wait(pending, return_when=FIRST_COMPLETED)
            pending |= {pool.submit(work, *job) for future in done for job in future.result()}


class Beside:
    """A thread beside the caller's that does one piece of work after the other; leaving waits for the last.

    An exception of a piece is raised by the next call, or on leaving.

    Args:
        threaded: Without it the caller does each piece at once.
    """

    def __init__(self, *, threaded: bool) -> None:
        self._pool = ThreadPoolExecutor(1) if threaded else None
        self._begun: Future[None] | None = None

    def __enter__(self) -> "Beside":
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()
            if kind is None:
                self._finish()

    def do(self, work: Callable[..., None], *given: Any) -> None:
        """Begin a piece, once the one before is done."""
        if self._pool is None:
            work(*given)
            return
        self._finish()
        self._begun = self._pool.submit(work, *given)

    def _finish(self) -> None:
        if self._begun is not None:
            self._begun.result()
            self._begun = None
