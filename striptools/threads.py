"""Threads over nogil kernels: equal chunks, parts by hash, jobs that give rise to more, a crew that stays.

None decides anything: the caller's kernels write to disjoint places or return what is joined in order, so
that results do not depend on the number of threads.
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import pairwise
from typing import TypeVar

SMALLEST_CHUNK = 1 << 14
"""Rows below which another thread is not worth its start."""

CHUNKS_A_THREAD = 4
"""So that a thread that is held up does not hold up the others for long."""

Result = TypeVar("Result")
Thing = TypeVar("Thing")


def every_core() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0))


def in_chunks(
    work: Callable[[tuple[int, int]], Result],
    count: int,
    threads: "int | Crew",
    smallest: int = SMALLEST_CHUNK,
) -> list[Result]:
    """Do `work((begin, end))` for chunks that cover `0 .. count`, and give the results in order.

    With one thread, or fewer than twice `smallest` rows, it is one chunk in the thread of the caller.
    """
    size = threads.size if isinstance(threads, Crew) else threads
    chunks = min(size * CHUNKS_A_THREAD, count // smallest) if size > 1 else 1
    if chunks <= 1:
        return [work((0, count))]
    bounds = pairwise([count * k // chunks for k in range(chunks + 1)])
    if isinstance(threads, Crew):
        return threads.each(work, bounds)
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, bounds))


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


class Crew:
    """Threads that do the same to several things at once; leaving ends them.

    Args:
        size: How many; with one the caller does it all.
    """

    def __init__(self, size: int) -> None:
        self.size = size
        self._pool = ThreadPoolExecutor(size) if size > 1 else None

    def __enter__(self) -> "Crew":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown()

    def each(self, work: Callable[[Thing], Result], things: Iterable[Thing]) -> list[Result]:
        """Do `work(thing)` for each and give the results in order, once all are done.

        An exception of one is raised once all are done: of several that of the first thing.
        """
        things = list(things)
        if self._pool is None or len(things) < 2:
            return [work(thing) for thing in things]
        begun = [self._pool.submit(work, thing) for thing in things]
        wait(begun)
        return [future.result() for future in begun]
