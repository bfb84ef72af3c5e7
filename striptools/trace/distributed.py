"""Rays shared out over several processes, on one machine or many, by `jax.distributed`.

Every process keeps the whole scene and has its own tracer on its own devices; nothing is exchanged while rays
are walked. What is exchanged is rays in, by each process being given them all or making its own, and hits
out, 20 bytes a ray. So hits are those of one process, bit for bit. Each process does

    import jax, striptools
    from striptools.trace import Tracer, distributed

    jax.distributed.initialize("localhost:12345", num_processes=2, process_id=0)
    tracer = Tracer(striptools.open("bunny.rdm"))
    hits = distributed.closest_hit(tracer, origins, directions)

with a process_id of its own. `striptools.trace` is imported before, and JAX computes nothing before. On one
machine threads of one process do as well for less memory; where processes are wanted nevertheless, set
STRIPTOOLS_THREADS so that they do not take each other's cores.

Cost: two exchanges, of the number of rays and of their hits. Gathering goes through
`jax.experimental.multihost_utils`, on CPUs by gloo, which JAX brings and which has to be able to resolve the
machine's own name.
"""

from dataclasses import fields
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from jaxtyping import Bool

from striptools.errors import UsageError
from striptools.trace.counters import counters_of
from striptools.trace.hit import Hits

if TYPE_CHECKING:
    from striptools.trace.tracer import Tracer


def share_of(count: int, process: int | None = None, processes: int | None = None) -> slice:
    """The rays, of so many, that a process traces: one run each, as even as can be.

    Args:
        count: Rays in all.
        process: Which process, from 0; None for this one.
        processes: How many there are; None for JAX's number of them.

    Raises:
        UsageError: There are no such rays or processes.
    """
    mine = jax.process_index() if process is None else process
    every = jax.process_count() if processes is None else processes
    if count < 0 or not 0 <= mine < every:
        raise UsageError(f"process {mine} of {every} for {count} rays", remedy="count processes from 0")
    return slice(count * mine // every, count * (mine + 1) // every)


def closest_hit(tracer: "Tracer", origins: np.ndarray, directions: np.ndarray, **given: Any) -> Hits:
    """Find what each ray hits first, each process for its share; all processes get all hits.

    Args:
        tracer: This process's, of the same scene in each.
        origins: (r, 3), the same in each process.
        directions: (r, 3), the same in each process.
        given: As for `Tracer.closest_hit`; t_max may be one for each ray.

    Raises:
        UsageError: As for `Tracer.closest_hit`; in that process alone, so that the others wait in vain unless
            it ends.
    """
    mine, given = _share(origins, given)
    return gather_hits(tracer.closest_hit(origins[mine], directions[mine], **given))


def any_hit(
    tracer: "Tracer", origins: np.ndarray, directions: np.ndarray, **given: Any
) -> Bool[np.ndarray, " r"]:
    """Say of each ray whether it hits anything; arguments and errors as for `closest_hit`."""
    mine, given = _share(origins, given)
    hit = tracer.any_hit(origins[mine], directions[mine], **given)
    return _gathered(hit.astype(np.int32)[:, None])[:, 0].astype(np.bool_)


def _share(origins: np.ndarray, given: dict[str, Any]) -> tuple[slice, dict[str, Any]]:
    mine = share_of(len(origins))
    t_max = np.asarray(given.get("t_max"))
    return mine, given | {"t_max": t_max[mine]} if t_max.ndim else given


def gather_hits(hits: Hits) -> Hits:
    """The hits of all processes one after another, in each of them, whoever made the rays.

    Every process has to call this, with hits of one kind: with counters in all or in none.
    """
    values = {one.name: getattr(hits, one.name) for one in fields(hits)}
    counters = values.pop("counters")
    columns = {name: value for name, value in values.items() if value is not None}
    counted = [] if counters is None else list(counters)
    # Bits, since what is gathered may be flushed or rounded where it is numbers.
    rows = np.stack([column.view(np.int32) for column in (*columns.values(), *counted)], axis=1)
    every = _gathered(rows)
    found: dict[str, Any] = {
        name: np.ascontiguousarray(every[:, k]).view(column.dtype)
        for k, (name, column) in enumerate(columns.items())
    }
    if counters is not None:
        found["counters"] = counters_of(every[:, len(columns) :])
    return Hits(**found)


def _gathered(rows: np.ndarray) -> np.ndarray:
    """The rows, (r, k) int32, of all processes, one after another; r may differ."""
    if jax.process_count() == 1:
        return rows
    from jax.experimental.multihost_utils import process_allgather

    counts = np.asarray(process_allgather(np.array([len(rows)], np.int32))).reshape(-1)
    padded = np.zeros((int(counts.max()), rows.shape[1]), np.int32)
    padded[: len(rows)] = rows
    every = np.asarray(process_allgather(padded)).reshape(len(counts), *padded.shape)
    return np.concatenate([part[:count] for part, count in zip(every, counts, strict=True)])
