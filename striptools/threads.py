"""Threads over nogil kernels: equal chunks, parts by hash, jobs that give rise to more, or all at once.

None decides anything: the caller's kernels write to disjoint places or return what is joined in order, so
that results do not depend on the number of threads.
"""

import os
from collections.abc import Callable, Iterable
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from itertools import pairwise
from threading import Event
from typing import TypeVar

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


def at_once(work: Callable[[int, Event], None], count: int) -> None:
    """Do `work(k, stopped)` for each k below `count`, each in a thread of its own; one alone in the caller's.

    `stopped` is set once one has failed or the caller is interrupted: then the others are to end soon. What
    was raised is raised here once all have ended: of several exceptions that of the least k.
    """
    stopped = Event()

    def stopping(k: int) -> None:
        try:
            work(k, stopped)
        except BaseException:
            stopped.set()
            raise

    if count == 1:
        work(0, stopped)
        return
    with ThreadPoolExecutor(max(1, count)) as pool:
        begun = [pool.submit(stopping, k) for k in range(count)]
        try:
            wait(begun)
        finally:
            stopped.set()
        for future in begun:
            future.result()
