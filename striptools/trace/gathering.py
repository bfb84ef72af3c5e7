"""All hits of rays, and how many there are: rays in, arrays out."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Int32

from striptools.errors import StriptoolsError, UsageError
from striptools.trace.hit import AllHits
from striptools.trace.layout import Found, Rays
from striptools.trace.streams import Take
from striptools.trace.walk import MISS, STUCK
from striptools.trace.walk_gather import GatherKind

MOST_HITS = 1024
"""The most hits of a ray that can be asked for: each triangle takes a step of as many lanes."""

Gather = Callable[[Rays, GatherKind, int, Take], None]
"""Traces rays and gathers: the kind, how many hits of each at most, and what takes them."""

Weigh = Callable[[Rays, np.ndarray, tuple[np.ndarray, ...], Found], None]
"""Fills in what was found of some rays: `Layout.weigh`."""


def all_hits(trace: Gather, weigh: Weigh, rays: Rays, k: int) -> AllHits:
    """The first k hits of each ray.

    Raises:
        UsageError: K is no number of hits.
        StriptoolsError: A walk did not end.
    """
    if not 1 <= k <= MOST_HITS:
        raise UsageError(f"{k} hits a ray", where="k", remedy=f"ask for 1 to {MOST_HITS}")
    rows = (k, len(rays[0]))
    t, u, v = np.full(rows, np.inf, np.float32), np.zeros(rows, np.float32), np.zeros(rows, np.float32)
    face, triangle = np.full(rows, MISS), np.full(rows, MISS)

    def take(at: np.ndarray, traced: tuple[np.ndarray, ...]) -> None:
        check_ended(traced[1])
        for j in range(k):
            nth = tuple(np.ascontiguousarray(a[:, j]) if a.ndim == 2 and a.size else a for a in traced)
            if not (nth[1] >= 0).any():
                break
            weigh(rays, at, nth, (t[j], face[j], u[j], v[j], triangle[j]))

    # A program is compiled for a power of two, of which a ray's first k hits are the first k.
    trace(rays, "all", 1 << (k - 1).bit_length(), take)
    t, face, u, v, triangle = (np.ascontiguousarray(a.T) for a in (t, face, u, v, triangle))
    return AllHits(t, face, u, v, triangle, (face >= 0).sum(axis=1, dtype=np.int32))


def counts(trace: Gather, rays: Rays, kind: GatherKind) -> Int32[np.ndarray, " r"]:
    """What is counted of each ray.

    Raises:
        StriptoolsError: A walk did not end.
    """
    count = np.zeros(len(rays[0]), np.int32)

    def take(at: np.ndarray, traced: tuple[np.ndarray, ...]) -> None:
        check_ended(traced[1])
        count[at] = traced[3]

    trace(rays, kind, 1, take)
    return count


def check_ended(name: np.ndarray) -> None:
    """Raise a StriptoolsError where a walk did not end."""
    # The least tells, in one pass, what is hardly ever so.
    if name.size > 0 and name.min() <= STUCK:
        stuck = int((name <= STUCK).sum())
        raise StriptoolsError(
            f"the walk of {stuck} rays did not end", where="scene hierarchy", remedy="convert the model again"
        )
