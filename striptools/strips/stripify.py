"""From faces to strips: chooses the method, cuts the tree, and shares the ranges out among threads.

Strip-RT as it is used here (`method="strip-rt"`) cuts the object tree into chunks, or into blocks where asked
to (partition/cut.py), and in each range finds neighbours (mesh/adjacency.py), links greedily
(strips/linking.py) and tunnels (strips/tunnelling.py). No strip crosses a range. The other methods order the
mesh as a whole: `paper` is Strip-RT as it is printed (strips/ordering.py), `stripe` and `tipsify` are
baselines to compare with (strips/stripe_like.py, strips/tipsify.py).

The ranges depend on the tree alone and each is ordered by one thread, so the strips are the same for any
number of threads.

Cost: O(n) after the tree for bounded caps; about 150 bytes a face of a chunk and thread, 5 bytes a face of
the mesh and 4 bytes a vertex and thread.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from striptools.errors import UsageError
from striptools.mesh.adjacency import build_adjacency
from striptools.partition.cut import CHUNK, Cut, cut_tree, grouped
from striptools.strips.ordering import OrderingOptions, Sequences, order_strips
from striptools.strips.tunnelling import EFFORTS, NO_TUNNELS, Effort
from striptools.types import Bools, Boxes, Counts, FaceIds, Faces

if TYPE_CHECKING:
    from striptools.partition.object_split import ObjectTree

Progress = Callable[[float], None]
"""Called with the fraction done, above 0 and below 1."""

TRIANGLES_A_STRIP = 320
"""How many flip bits cost as much as a strip: 40 bytes, two vertices, a start and a node of the hierarchy."""


def stripify(
    faces: Faces,
    vertex_count: int,
    boxes: Boxes,
    tree: ObjectTree,
    options: OrderingOptions | None = None,
    threads: int = 1,
    watch: Progress | None = None,
) -> Sequences:
    """Order faces into strips by the method asked for.

    Args:
        faces: (n, 3) int32, indices below `vertex_count`.
        vertex_count: How many vertices there are.
        boxes: (n, 6) float32, the faces' boxes.
        tree: Object tree with one face an item.
        options: Method, cap, effort and blocks; the defaults of OrderingOptions when left out.
        threads: How many threads share the work; the strips are the same for any number.
        watch: Told how far the work is.

    Returns:
        Sequences of at most max_length faces, for which `check_sequences` holds.

    Raises:
        UsageError: Arrays that do not belong together.
    """
    options = options or OrderingOptions()
    if not len(faces) == len(boxes) == len(tree.order):
        raise UsageError("faces, boxes and tree are not of one mesh", where="stripify")
    if options.method == "strip-rt":
        cut = cut_for(tree, faces, vertex_count, options)
        effort = EFFORTS[options.effort]
        order = partial(order_cut, faces, vertex_count, boxes, tree, cut, options.max_length, effort)
        return order(threads, watch, flips=options.flips)
    if options.method == "tipsify":
        from striptools.strips.tipsify import tipsify

        return tipsify(faces, vertex_count, options)
    adjacency = build_adjacency(faces, vertex_count)
    if options.method == "stripe":
        from striptools.strips.stripe_like import stripe_like

        return stripe_like(adjacency, faces, options)
    return order_strips(adjacency, faces, tree, options)


def cut_for(tree: ObjectTree, faces: Faces, vertex_count: int, options: OrderingOptions) -> Cut:
    """The ranges in which Strip-RT orders: blocks of at most `block` triangles and vertices, or chunks."""
    if options.block is None:
        return cut_tree(tree, CHUNK)
    return cut_tree(tree, options.block, faces=faces, vertex_count=vertex_count, most_vertices=options.block)


def order_cut(
    faces: Faces,
    vertex_count: int,
    boxes: Boxes,
    tree: ObjectTree,
    cut: Cut,
    max_length: int,
    effort: Effort | None = NO_TUNNELS,
    threads: int = 1,
    watch: Progress | None = None,
    *,
    flips: bool = True,
) -> Sequences:
    """Order the faces inside each range of a cut: link, then tunnel with an effort, or only link for None.

    All ranges are ordered without flips first. Where enough half-edges are left without a partner of their
    winding, the ranges that have some are ordered again with flips, and that is kept where it saves more than
    flip bits cost.

    Args:
        faces: (n, 3) int32.
        vertex_count: How many vertices there are.
        boxes: (n, 6) float32.
        tree: Object tree with one face an item.
        cut: Ranges of its order.
        max_length: The most faces of a strip.
        effort: How tunnels are searched, or None for none.
        threads: How many threads share the ranges.
        watch: Told how far the work is, flips left out.
        flips: Whether strips may cross edges that both faces run the same way.
    """
    from striptools.kernels.strip_chunks import order_ranges

    count = len(faces)
    given = (faces, boxes, tree.order, tree.leaf_node, tree.parent, tree.size, cut.starts)
    numbers = effort.numbers if effort else (-1, 0, 0.0, 0.0, 0)
    own = threading.local()

    def order_job(job: tuple[int, int], placed: FaceIds, is_first: Bools, *, flip: bool) -> int:
        if not hasattr(own, "number"):
            own.number = np.full(vertex_count, -1, np.int32)
        return order_ranges(*given, *job, max_length, numbers, flip, own.number, placed, is_first)[2]

    plain = np.zeros(count, np.int32), np.zeros(count, np.bool_)
    jobs, stranded = _jobs(cut), []
    for done, half_edges in enumerate(
        _in_order(lambda job: order_job(job, *plain, flip=False), jobs, threads)
    ):
        stranded.append(half_edges)
        if watch and done:
            watch(done / len(jobs))
    placed, is_first = plain
    if flips and _pays(sum(stranded) // 2, count):
        flipped = placed.copy(), is_first.copy()
        again = [job for job, half_edges in zip(jobs, stranded, strict=True) if half_edges]
        list(_in_order(lambda job: order_job(job, *flipped, flip=True), again, threads))
        if _pays(int(is_first.sum()) - int(flipped[1].sum()), count):
            placed, is_first = flipped
    return Sequences(placed, np.append(np.flatnonzero(is_first), count).astype(np.int32))


def _pays(strips: int, triangles: int) -> bool:
    """Whether so many strips fewer are worth a flip bit a triangle."""
    return strips * TRIANGLES_A_STRIP > triangles


def _in_order(
    work: Callable[[tuple[int, int]], int], jobs: list[tuple[int, int]], threads: int
) -> Iterator[int]:
    """Do the jobs, in this thread where one is all, and yield what each gives, in their order."""
    if threads <= 1:
        yield from map(work, jobs)
        return
    with ThreadPoolExecutor(threads) as pool:
        yield from pool.map(work, jobs)


def _jobs(cut: Cut) -> list[tuple[int, int]]:
    borders: Counts = grouped(cut, CHUNK)
    return list(zip(borders[:-1].tolist(), borders[1:].tolist(), strict=True))


# Notes. Where the time goes, Stanford dragon (871,306 faces), effort normal, one thread, seconds of processor
# time on a machine with other work: gather faces .03, rings .11, link .09, gather boxes .03, tunnels 1.05.
#
# What the departures buy, cap 128: vertices per triangle / expected cost over a full SAH tree's
# (tests/benches/bench_strips.py prints it):
#
#   each on top of the one before       bunny         dragon        dem_jacksboro  kicad_acepack
#   paper                               1.118/1.276   1.166/1.190   1.101/1.655    1.071/1.207
#   linking                             1.115/1.245   1.161/1.167   1.097/1.648    1.071/1.203
#   linking in chunks                   1.117/1.231   1.164/1.141   1.101/1.538    1.072/1.170
#   tunnels of 1 rotation               1.061/1.256   1.081/1.162   1.071/1.514    1.061/1.159
#   tunnels of 2 rotations              1.046/1.248   1.067/1.158   1.050/1.490    1.056/1.158
#   tunnels of 3 rotations              1.041/1.249   1.061/1.154   1.039/1.455    1.055/1.177
#   neutral moves of 1: normal          1.038/1.204   1.049/1.144   1.043/1.313    1.055/1.116
#   neutral moves of 3: best            1.033/1.184   1.043/1.124   1.036/1.277    1.054/1.097
#   normal, in blocks of 256            1.077/1.113   1.086/1.092   1.099/1.150    1.073/1.093
#
# Blocks come first because a strip that knows its block is compact in it; chunks alone take 1 to 7 %
# off the cost of linking. Neutral moves pay twice: what they save is room under `rise` for more merges.
# On the dragon,
# price 1.0 gives 1.052/1.135, 1.15 1.049/1.143, 1.3 1.047/1.149. Splits aligned with blocks of 256, dragon,
# by the most blocks of an aligned range: none fills 68 % of a block, duplicates 1.245 vertices a vertex and
# costs 1.081; 4: 85 %, 1.224, 1.086; 8: 91 %, 1.220, 1.089; 12: 94 %, 1.2196, 1.093.
#
# Edges of more than two faces: tree_japanesemaple has 23,500 edges of four faces and 7,500 of three. Each on
# top of the one before, effort normal, without flips / with them, vertices per triangle / expected cost:
#
#   flips alone                                 1.213/1.048   1.197/1.067
#   an end may leave by the edge of its cut                   1.193/1.067
#   edges of two faces first in linking                       1.128/1.073
#   a link of a ring may be cut for another     1.129/1.056   1.103/1.079
#   effort best                                 1.127/1.051   1.101/1.071
#
# So most of what looked like winding was pairs of equal faces linked by the one edge that others needed. A
# higher price would not have helped (9 and 6 passes in the first row: 1.191). 5,256 components bound it at
# 1.053. Flips save 0.4 of 13.6 bytes a triangle there, and double the time of ordering; icub, chandelier and
# ugly_bunny_holes have too few edges of one winding to pay for the bits and stay without. The rest of the
# table took them from 1.0444 to 1.0439, 1.0580 to 1.0525 and 1.0516 to 1.0514. Meshes of two faces an edge
# have the strips that they had.
