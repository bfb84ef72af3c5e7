"""Cut the object tree into ranges of its leaf order: chunks for the thread pool, and blocks.

A *cut* takes the largest subtrees within a limit, so that a range is compact, is a slice of the tree's order
and has a tree of its own. Chunks (at most CHUNK triangles) are what a thread works on alone: their borders
depend on the tree and on nothing else, so the number of threads cannot change a result. Blocks are small
ranges that will be stored apart: they are limited in triangles and in different vertices, because local
vertex numbers have a fixed width.

Plain cutting fills blocks to about two thirds, because a node just over the limit is halved. Ask the object
split for aligned splits (`PartitionOptions.block`) to fill them better.

Cost: O(n) for triangles; with a vertex limit of v also O(v) a node tested.
"""

from dataclasses import dataclass

import numpy as np

from striptools.errors import UsageError
from striptools.kernels import cut as kernels
from striptools.partition.object_split import ObjectTree
from striptools.types import Counts, Faces

CHUNK = 32768
"""Triangles of a chunk at most: small enough for a core's cache, large enough that borders cut few strips."""


@dataclass(frozen=True, eq=False)
class Cut:
    """Ranges of a tree's leaf order, each of them all leaves below one node.

    Attributes:
        starts: (k+1,) int32 from 0 to n, rising: range i is the positions starts[i]:starts[i+1].
    """

    starts: Counts

    @property
    def count(self) -> int:
        """How many ranges there are."""
        return len(self.starts) - 1


def cut_tree(
    tree: ObjectTree,
    most_triangles: int,
    *,
    faces: Faces | None = None,
    vertex_count: int = 0,
    most_vertices: int | None = None,
) -> Cut:
    """Cut a tree into the largest subtrees within the limits.

    Args:
        tree: Over n items.
        most_triangles: The most items of a range, 1 or more.
        faces: (n, 3) int32, the items' vertices; needed for `most_vertices`.
        vertex_count: How many vertices there are; needed for `most_vertices`.
        most_vertices: The most different vertices of a range, 3 or more; None for any number.

    Raises:
        UsageError: A limit is too small, or `faces` do not fit the tree.
    """
    if most_triangles < 1:
        raise UsageError(f"{most_triangles} is out of range", where="most_triangles", remedy="give 1 or more")
    if most_vertices is None:
        faces, seen = np.zeros((0, 3), np.int32), np.zeros(0, np.int32)
    elif faces is None or len(faces) != len(tree.order):
        raise UsageError("a limit of vertices needs the faces of the tree", where="cut_tree")
    elif most_vertices < 3:
        raise UsageError(f"{most_vertices} is out of range", where="most_vertices", remedy="give 3 or more")
    else:
        seen = np.full(vertex_count, -1, np.int32)
    starts = np.zeros(len(tree.order) + 1, np.int32)
    count = kernels.cut_ranges(tree.size, tree.order, faces, seen, most_triangles, most_vertices or 0, starts)
    starts[count] = len(tree.order)
    return Cut(starts[: count + 1].copy())


def grouped(cut: Cut, most_triangles: int) -> Counts:
    """Gather neighbouring ranges into jobs of about `most_triangles`: (j+1,) int32 first ranges, then k."""
    job = cut.starts[:-1] // max(1, most_triangles)
    first = np.flatnonzero(np.diff(job, prepend=-1))
    return np.append(first, cut.count).astype(np.int32)


def check_cut(
    cut: Cut,
    tree: ObjectTree,
    most_triangles: int,
    *,
    faces: Faces | None = None,
    most_vertices: int | None = None,
) -> None:
    """Raise unless the ranges cover the order, lie each below one node, and keep the limits.

    Raises:
        UsageError: Naming the first broken range.
    """
    starts, size = cut.starts, tree.size
    whole = len(starts) >= 2 and starts[0] == 0 and starts[-1] == len(tree.order)
    _expect(
        bool(whole) and not (np.diff(starts) < 1).any(), f"starts do not rise from 0 to {len(tree.order)}"
    )
    below: dict[int, set[int]] = {}
    first = np.cumsum(size == 1) - (size == 1)
    for node in np.flatnonzero(np.isin(first, starts)):
        below.setdefault(int(first[node]), set()).add(int(size[node]))
    for begin, end in zip(starts[:-1].tolist(), starts[1:].tolist(), strict=True):
        where = f"range {begin}:{end}"
        _expect(end - begin in below[begin], f"{where} is not all below one node")
        _expect(end - begin <= most_triangles, f"{where} has more than {most_triangles} triangles")
        if faces is not None and most_vertices is not None and end - begin > 1:
            vertices = len(np.unique(faces[tree.order[begin:end]]))
            _expect(vertices <= most_vertices, f"{where} has {vertices} vertices")


def _expect(holds: bool, what: str) -> None:
    if not holds:
        raise UsageError(what, where="cut")
