"""The validator's look into nodes and runs: what each slot names, and that its box holds what is below it.

Nothing recurses: parents are followed by doubling, so that a chain of nodes costs little more. Boxes are
compared exactly: a plane less `low` is a float64 without rounding, a position less `low` is the sum of two.
"""

from dataclasses import dataclass

import numpy as np

from striptools.reducem.inspection import Inspection, Section
from striptools.reducem.validate_blocks import Geometry
from striptools.reducem.validate_instances import Parts

__all__ = ["gathered", "inspect_nodes"]

_NODE = np.dtype(
    {
        "names": ["base", "leaves", "origin", "inner", "shifts", "low", "high"],
        "formats": ["<u4", "<u4", ("<u2", 3), "u1", "u1", ("u1", (3, 8)), ("u1", (3, 8))],
        "offsets": [0, 4, 8, 14, 15, 16, 40],
        "itemsize": 64,
    }
)


@dataclass(frozen=True)
class _Runs:
    """The runs: the number of each block's first, and for each its block, first triangle and length.

    `whole` says whether they have each triangle once.
    """

    starts: np.ndarray
    block: np.ndarray
    first: np.ndarray
    count: np.ndarray
    whole: bool


@dataclass(frozen=True)
class _Nodes:
    """The nodes, and for each slot, (m, 8), whether it is inner, a leaf or a sound box, and what it names."""

    section: Section
    rows: np.ndarray
    top: int
    blocks: int
    parts: Parts
    is_inner: np.ndarray
    is_leaf: np.ndarray
    is_box: np.ndarray
    child: np.ndarray
    leaf: np.ndarray

    @property
    def is_top(self) -> np.ndarray:
        return np.arange(len(self.rows)) < self.top

    @property
    def firsts(self) -> np.ndarray:
        """The roots among the nodes over blocks, one for each geometry that has any."""
        return self.parts.tops[:-1][np.diff(self.parts.tops) > 0]


def inspect_nodes(inspection: Inspection, geometry: Geometry | None, parts: Parts) -> None:
    """Look at runs, where boxes are stored, and at nodes; without sound blocks, at what nodes name."""
    record = inspection.sections["SCEN"].data
    blocks, count, top, run_count = (int(x) for x in np.frombuffer(record, "<u4", 4, 4))
    stored = record[24] & 1
    if not (count >= top + blocks if stored else count == top):
        return
    runs = None
    if stored and geometry is not None and "RUNS" in inspection.sections:
        longest = int.from_bytes(record[70:72], "little")
        runs = _runs(inspection, geometry, run_count, longest)
    nodes = _slots(inspection, top, blocks, parts)
    parents = _parents(inspection, nodes)
    sound = _blocks(inspection, nodes)
    if runs is not None and parents is not None:
        sound = _leaves(inspection, nodes, parents, runs) and sound
    whole = not stored or (runs is not None and runs.whole)
    sound = sound and whole and bool((nodes.is_inner | nodes.is_leaf).any(axis=1).all())
    if geometry is not None and parents is not None and sound:
        _boxes(inspection, nodes, parents, geometry, runs)


def _runs(inspection: Inspection, geometry: Geometry, count: int, longest: int) -> _Runs | None:
    """Look at the runs; gives them where those of each block follow those of the one before."""
    section = inspection.sections["RUNS"]
    b = len(geometry.starts) - 1
    starts = np.append(np.frombuffer(section.data, "<u4", b).astype(np.int64), count)
    begin = -(-b // 16) * 64
    words = np.frombuffer(section.data, "<u4", count, begin).astype(np.int64)
    if any(section.data[4 * b : begin]):
        inspection.found("RDM108", "RUNS", section.at(4 * b))
    falls = np.diff(starts) < 0
    falls[0] |= starts[0] != 0
    if inspection.found_where("RDM801", falls, lambda i: f"RUNS: block {i}", lambda i: section.at(4 * i)):
        return None
    block = np.repeat(np.arange(b), np.diff(starts))
    local, length = words & 255, (words >> 8 & 7) + 1
    first = geometry.starts[block] + local

    def check(code: str, wrong: np.ndarray) -> bool:
        return inspection.found_where(
            code,
            wrong,
            lambda i: f"RUNS: block {block[i]}, run {i - starts[block[i]]}",
            lambda i: section.at(begin + 4 * i),
        )

    outside = first + length > geometry.starts[block + 1]
    # A strip begins inside the run if more of them have begun by its last triangle than by its first.
    begun = np.cumsum(geometry.begins)
    last = np.minimum(first + length, geometry.starts[block + 1]) - 1
    over = begun[last] != begun[np.minimum(first, len(begun) - 1)]
    check("RDM802", outside | over | (length > longest))
    inside = np.flatnonzero(~outside)
    described = np.zeros(count, np.int64)
    described[inside] = _described(geometry, block[inside], first[inside], length[inside])
    check("RDM804", ~outside & (words >> 11 != described))
    if outside.any():
        return _Runs(starts, block, first, length, whole=False)
    triangles = np.repeat(first - np.cumsum(length) + length, length) + np.arange(length.sum())
    times = np.bincount(triangles, minlength=len(begun))
    wrong = inspection.found_where(
        "RDM803", times != 1, lambda t: f"RUNS: triangle {t}", lambda t: section.at(begin)
    )
    return _Runs(starts, block, first, length, whole=not wrong)


def _described(geometry: Geometry, block: np.ndarray, first: np.ndarray, length: np.ndarray) -> np.ndarray:
    """What runs must say beside their triangles: their strips, turns and equal triangles before them."""
    turns = geometry.turns | geometry.begins
    number = np.arange(len(turns))
    changed = geometry.begins | (turns != np.roll(turns, 1))
    equal = number - np.maximum.accumulate(np.where(changed, number, 0))
    begun = np.cumsum(geometry.begins)
    described = begun[first] - begun[geometry.starts[block]] | equal[first] + 1 << 16
    for j in range(8):
        described |= (turns[np.minimum(first + j, len(turns) - 1)] & (j < length)).astype(np.int64) << 8 + j
    return described


def _slots(inspection: Inspection, top: int, blocks: int, parts: Parts) -> _Nodes:
    """Look at each node by itself."""
    section = inspection.sections["NODE"]
    rows = np.frombuffer(section.data, _NODE)
    is_inner = (rows["inner"][:, None] >> np.arange(8, dtype=np.uint8) & 1) == 1
    is_empty = ((rows["low"] == 1) & (rows["high"] == 0)).all(axis=1) & ~is_inner
    is_leaf = ~is_inner & ~is_empty
    inverted = ~is_empty & (rows["low"] > rows["high"]).any(axis=1)

    def check(code: str, wrong: np.ndarray, at: int) -> None:
        inspection.found_where(code, wrong, lambda i: f"NODE: node {i}", lambda i: section.at(64 * i + at))

    check("RDM705", inverted.any(axis=1), 16)
    base, leaves = rows["base"].astype(np.int64) & 2**28 - 1, rows["leaves"].astype(np.int64)
    check("RDM706", (base > 0) & ~is_inner.any(axis=1), 0)
    check("RDM706", (leaves > 0) & ~is_leaf.any(axis=1), 4)
    check("RDM708", is_empty.all(axis=1), 14)
    is_top = np.arange(len(rows)) < top
    marks = is_leaf @ (1 << np.arange(8))
    check("RDM709", is_top & is_leaf.any(axis=1) & (leaves >> 24 != marks), 7)
    child = base[:, None] + np.cumsum(is_inner, axis=1) - 1
    first = np.where(is_top, leaves & 2**24 - 1, leaves >> 24)
    leaf = first[:, None] + np.cumsum(is_leaf, axis=1) - 1
    return _Nodes(section, rows, top, blocks, parts, is_inner, is_leaf, ~is_empty & ~inverted, child, leaf)


def _parents(inspection: Inspection, nodes: _Nodes) -> np.ndarray | None:
    """Look at the inner children; gives each node's parent, itself for a root, where they make trees."""
    m, roots = len(nodes.rows), np.arange(nodes.top, min(nodes.top + nodes.blocks, len(nodes.rows)))
    number = np.arange(m)[:, None]
    least = np.where(nodes.is_top[:, None], number + 1, np.maximum(number + 1, nodes.top + nodes.blocks))
    ends = np.repeat(nodes.parts.tops[1:], np.diff(nodes.parts.tops))
    most = np.append(ends, np.full(m - nodes.top, m))[:, None]
    outside = nodes.is_inner & ((nodes.child < least) | (nodes.child >= most))
    at = nodes.section.at
    wrong = inspection.found_where(
        "RDM701", np.any(outside, axis=1), lambda i: f"NODE: node {i}", lambda i: at(64 * i)
    )
    parent, slot = np.nonzero(nodes.is_inner & ~outside)
    child = nodes.child[parent, slot]
    wanted = np.ones(m, np.int64)
    wanted[nodes.firsts] = 0
    wanted[roots] = 0
    times = np.bincount(child, minlength=m)
    wrong |= inspection.found_where(
        "RDM702", times != wanted, lambda i: f"NODE: node {i}", lambda i: at(64 * i)
    )
    if wrong:
        return None
    parents = np.arange(m)
    parents[child] = parent
    return parents


def _blocks(inspection: Inspection, nodes: _Nodes) -> bool:
    """Look whether each block is the leaf of one slot of the nodes over blocks of its geometry."""
    if nodes.top == 0:
        return True
    node, slot = np.nonzero(nodes.is_leaf & nodes.is_top[:, None])
    block = nodes.leaf[node, slot]
    blocks, tops = nodes.parts
    owner = np.repeat(np.arange(len(tops) - 1), np.diff(tops))[node]
    outside = (block < blocks[owner]) | (block >= blocks[owner + 1])
    at = nodes.section.at
    if inspection.found_where(
        "RDM703", outside, lambda i: f"NODE: node {node[i]}", lambda i: at(64 * node[i] + 4)
    ):
        return False
    wanted = np.repeat(np.diff(tops) > 0, np.diff(blocks))
    times = np.bincount(block, minlength=nodes.blocks)
    return not inspection.found_where(
        "RDM703", times != wanted, lambda i: f"NODE: block {i}", lambda i: nodes.section.offset
    )


def _leaves(inspection: Inspection, nodes: _Nodes, parents: np.ndarray, runs: _Runs) -> bool:
    """Look whether each run is the leaf of one slot of its own block's nodes."""
    roots = parents
    while (roots[roots] != roots).any():
        roots = roots[roots]
    node, slot = np.nonzero(nodes.is_leaf & ~nodes.is_top[:, None])
    block = nodes.rows["leaves"][node].astype(np.int64) & 2**24 - 1
    run = nodes.leaf[node, slot]
    count = np.diff(runs.starts)
    outside = (block != roots[node] - nodes.top) | (run >= count[np.minimum(block, len(count) - 1)])
    at = nodes.section.at
    if inspection.found_where(
        "RDM704", outside, lambda i: f"NODE: node {node[i]}", lambda i: at(64 * node[i] + 4)
    ):
        return False
    times = np.bincount(runs.starts[block] + run, minlength=len(runs.block))
    return not inspection.found_where(
        "RDM704",
        times != 1,
        lambda i: f"NODE: block {runs.block[i]}, run {i - runs.starts[runs.block[i]]}",
        lambda i: nodes.section.offset,
    )


def _boxes(
    inspection: Inspection, nodes: _Nodes, parents: np.ndarray, geometry: Geometry, runs: _Runs | None
) -> None:
    """Look whether the box of each slot holds all positions below it, in exact arithmetic."""
    record = inspection.sections["SCEN"].data
    scene_low = np.frombuffer(record, "<f4", 3, 40).astype(np.float64)
    cell = np.frombuffer(record, "<i2", 3, 64).astype(np.int64)
    if not np.isfinite(scene_low).all() or (cell < -149).any() or (cell > 127).any():
        return
    low, high = _content(nodes, parents, geometry, runs)
    shift = np.stack([nodes.rows["base"] >> 28, nodes.rows["shifts"] & 15, nodes.rows["shifts"] >> 4], axis=1)
    leaking = np.zeros(nodes.is_box.shape, np.bool_)
    for axis in range(3):
        origin, scale = nodes.rows["origin"][:, axis].astype(np.int64), shift[:, axis].astype(np.int64)
        planes = (
            np.ldexp((origin[:, None] + (side[:, axis].astype(np.int64) << scale[:, None])), cell[axis])
            for side in (nodes.rows["low"], nodes.rows["high"])
        )
        below, above = (
            _compare(side[:, :, axis], scene_low[axis], plane)
            for side, plane in zip((low, high), planes, strict=True)
        )
        leaking |= (below < 0) | (above > 0)
    inspection.found_where(
        "RDM707",
        (leaking & nodes.is_box).ravel(),
        lambda i: f"NODE: node {i // 8}, slot {i % 8}",
        lambda i: nodes.section.at(64 * (i // 8) + 16 + i % 8),
    )


def _compare(position: np.ndarray, low: np.float64, plane: np.ndarray) -> np.ndarray:
    """The sign of (position - low) - plane, exactly: the difference is taken as a float64 and its error."""
    rounded = position - low
    back = rounded - position
    error = (position - (rounded - back)) + (-low - back)
    return np.where(rounded != plane, np.sign(rounded - plane), np.sign(error))


def _content(
    nodes: _Nodes, parents: np.ndarray, geometry: Geometry, runs: _Runs | None
) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of all positions below each slot, two (m, 8, 3) float64; empty slots have anything."""
    low = np.full((len(nodes.rows), 8, 3), np.inf)
    high = np.full((len(nodes.rows), 8, 3), -np.inf)
    node, slot = np.nonzero(nodes.is_leaf & nodes.is_top[:, None])
    block = nodes.leaf[node, slot]
    low[node, slot] = np.minimum.reduceat(geometry.low, geometry.starts[:-1])[block]
    high[node, slot] = np.maximum.reduceat(geometry.high, geometry.starts[:-1])[block]
    if runs is not None:
        node, slot = np.nonzero(nodes.is_leaf & ~nodes.is_top[:, None])
        run = runs.starts[nodes.rows["leaves"][node].astype(np.int64) & 2**24 - 1] + nodes.leaf[node, slot]
        ends = np.stack([runs.first[run], runs.first[run] + runs.count[run]], axis=1)
        low[node, slot], high[node, slot] = _ranges(geometry, ends)
    node, slot = np.nonzero(nodes.is_inner)
    child = nodes.child[node, slot]
    low[node, slot] = gathered(np.minimum, low.min(axis=1), parents)[child]
    high[node, slot] = gathered(np.maximum, high.max(axis=1), parents)[child]
    empty = ~(nodes.is_inner | nodes.is_leaf)
    low[empty] = high[empty] = 0.0
    return low, high


def gathered(least: np.ufunc, own: np.ndarray, parents: np.ndarray) -> np.ndarray:
    """The least of each node and all nodes below it, (m, 3), whatever the depth.

    Each round takes what is below from twice as far; that some is taken twice does not matter to a least.
    """
    columns = [np.ascontiguousarray(column) for column in own.T]
    ancestors = parents
    while True:
        for column in columns:
            least.at(column, ancestors, column.copy())
        further = ancestors[ancestors]
        if (further == ancestors).all():
            return np.stack(columns, axis=1)
        ancestors = further


def _ranges(geometry: Geometry, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The bounds of ranges of triangles that have each triangle once, in the order of the ranges."""
    order = np.argsort(ends[:, 0], kind="stable")
    low, high = np.zeros((len(ends), 3)), np.zeros((len(ends), 3))
    low[order] = np.minimum.reduceat(geometry.low, ends[order, 0])
    high[order] = np.maximum.reduceat(geometry.high, ends[order, 0])
    return low, high
