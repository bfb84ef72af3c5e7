"""The validator's look into a hierarchy of a section of its own (SPEC.md, section 4.12).

Nothing follows children level by level as the reader does. A tree in preorder is a word of inner nodes and
leaves: with one step up for each inner node and one down for each leaf, the second child of a node stands
where the walk is next as high as it was at the node, and what is below the node ends where it is first lower.
"""

import struct
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from striptools.reducem.inspection import Inspection, Section
from striptools.reducem.validate_blocks import Geometry
from striptools.reducem.validate_nodes import gathered

__all__ = ["inspect_hierarchy"]

_OVER = {1: (0, 1, 2), 2: (0, 1), 3: (0, 1, 2), 4: (0,)}
"""By the kind, what the objects may be: triangles, strips, blocks."""

_BOX_NODE = np.dtype([("low", "<f4", 3), ("high", "<f4", 3), ("a", "<u4"), ("b", "<u4")])
_CELL_NODE = np.dtype([("a", "<u4"), ("b", "<u4")])
_DEEPEST = 128
_AT_ONCE = 1 << 20
"""Triangles of references that are looked at together."""


class _Record(NamedTuple):
    """The record at the beginning of the section."""

    kind: int
    over: int
    flags: int
    reserved: int
    nodes: int
    items: int
    reserved_2: int
    bounds: tuple[float, ...]


@dataclass(frozen=True)
class _Look:
    """A hierarchy under inspection.

    Attributes:
        inspection: Of the file.
        section: HIER.
        record: Its record.
        nodes: Its nodes, of `_BOX_NODE` or `_CELL_NODE`.
        items: Its items, int64.
    """

    inspection: Inspection
    section: Section
    record: _Record
    nodes: np.ndarray
    items: np.ndarray

    def found(self, code: str, wrong: np.ndarray, word: str = "node") -> bool:
        """Note an issue of some nodes or items."""
        size, begin = self.nodes.itemsize, 64
        if word == "item":
            size, begin = 4, 64 + self.nodes.nbytes
        return self.inspection.found_where(
            code, wrong, lambda i: f"HIER: {word} {i}", lambda i: self.section.at(begin + size * i)
        )

    def refuse(self, code: str) -> None:
        """Note an issue of the whole."""
        self.inspection.found(code, "HIER", self.section.offset)


def inspect_hierarchy(inspection: Inspection, geometry: Geometry | None) -> None:
    """Look at the hierarchy of a file; without sound geometry, at its record."""
    section = inspection.sections["HIER"]
    look = _opened(inspection, section)
    if look is None or geometry is None:
        return None
    objects = _objects(look.record.over, geometry)
    order = _order(look, len(objects) - 1)
    if order is None:
        return None
    if look.record.kind == 2:
        return _cells(look, geometry, objects)
    if look.record.kind == 4:
        return _presorted(look, geometry)
    boxes = _ranges(geometry.low, geometry.high, objects)[order]
    return _heap(look, boxes) if look.record.kind == 1 else _loose(look, boxes)


def _opened(inspection: Inspection, section: Section) -> _Look | None:
    """Look at the record; gives what is behind it where it is borne out."""
    data = section.data
    if len(data) < 64:
        inspection.found("RDM562", "HIER", section.offset)
        return None
    record = _Record(*struct.unpack_from("<4B3I", data), struct.unpack_from("<6f", data, 16))
    if record.flags > 1 or record.reserved or record.reserved_2 or any(data[40:64]):
        inspection.found("RDM107", "HIER", section.offset)
    if record.over not in _OVER.get(record.kind, ()) or (record.kind in (2, 4) and record.flags & 1):
        inspection.found("RDM561", "HIER", section.at(0))
        return None
    is_tree = record.kind == 2
    if not np.isfinite(record.bounds).all() if is_tree else any(data[16:40]):
        inspection.found("RDM563", "HIER", section.at(16))
    node = _CELL_NODE if is_tree else _BOX_NODE
    wrong = len(data) != 64 + node.itemsize * record.nodes + 4 * record.items or record.nodes > 2**28
    if wrong or (record.kind in (1, 3) and bool(record.flags & 1) != (record.items > 0)):
        inspection.found("RDM562", "HIER", section.at(4))
        return None
    nodes = np.frombuffer(data, node, record.nodes, 64)
    items = np.frombuffer(data, "<u4", offset=64 + nodes.nbytes).astype(np.int64)
    return _Look(inspection, section, record, nodes, items)


def _objects(over: int, geometry: Geometry) -> np.ndarray:
    """The first triangle of each object, and n."""
    n = len(geometry.begins)
    if over == 0:
        return np.arange(n + 1)
    return np.append(np.flatnonzero(geometry.begins), n) if over == 1 else geometry.starts


def _order(look: _Look, count: int) -> np.ndarray | None:
    """The object at each place, None where the order is none; of kinds without places anything."""
    if look.record.kind in (2, 4) or not look.record.items:
        return np.arange(count)
    if len(look.items) != count:
        look.refuse("RDM562")
        return None
    wrong = look.items >= count
    times = np.bincount(look.items[~wrong], minlength=count)
    wrong[~wrong] = times[look.items[~wrong]] > 1
    return None if look.found("RDM567", wrong, "item") else look.items


def _ranges(low: np.ndarray, high: np.ndarray, starts: np.ndarray) -> np.ndarray:
    """The boxes, (p, 6), around ranges that leave nothing out."""
    return np.concatenate(
        [np.minimum.reduceat(low, starts[:-1]), np.maximum.reduceat(high, starts[:-1])], axis=1
    )


def _held(look: _Look, below: np.ndarray, reached: np.ndarray) -> None:
    """Look whether the boxes of nodes that are reached hold what is below them, (m, 6)."""
    inside = (look.nodes["low"] <= below[:, :3]) & (look.nodes["high"] >= below[:, 3:])
    look.found("RDM568", np.array(~inside.all(axis=1) & reached))


def _heap(look: _Look, boxes: np.ndarray) -> None:
    """Look at an SLBVH, a level of its heap at a time; `boxes` are those of its places."""
    count, nodes = len(look.nodes), look.nodes
    if count < 2 or count & (count - 1):
        return look.refuse("RDM562")
    held, first = nodes["a"].astype(np.int64) >> 3, nodes["b"].astype(np.int64)
    there = np.frombuffer(nodes.tobytes(), "<u4").reshape(-1, 8).any(axis=1)
    inner = there & (nodes["a"] & 4 == 0)
    wanted = np.zeros(count, np.bool_)
    wanted[1] = True
    for begin in 2 ** np.arange(1, count.bit_length() - 1):
        above = slice(begin // 2, begin)
        wanted[begin : 2 * begin] = np.repeat(wanted[above] & inner[above], 2)
    lost = there != wanted
    lost[count // 2 :] |= inner[count // 2 :]
    if look.found("RDM564", lost):
        return None
    look.found("RDM563", there & (nodes["a"] & 3 > np.where(inner, 2, 0)))
    child = 2 * np.flatnonzero(inner)
    wrong = there & ~inner & (held == 0)
    wrong[1] |= first[1] != 0 or held[1] != len(boxes)
    split = (first[child] == first[inner]) & (first[child + 1] == first[inner] + held[child])
    wrong[inner] |= ~(split & (held[child] + held[child + 1] == held[inner]))
    if look.found("RDM566", wrong):
        return None
    below = np.zeros((count, 6), np.float32)
    leaves = np.flatnonzero(there & ~inner)
    leaves = leaves[np.argsort(first[leaves])]
    below[leaves] = _ranges(boxes[:, :3], boxes[:, 3:], np.append(first[leaves], len(boxes)))
    for begin in 2 ** np.arange(count.bit_length() - 3, -1, -1):
        at = begin + np.flatnonzero(inner[begin : 2 * begin])
        below[at, :3] = np.minimum(below[2 * at, :3], below[2 * at + 1, :3])
        below[at, 3:] = np.maximum(below[2 * at, 3:], below[2 * at + 1, 3:])
    return _held(look, below, np.array(there))


@dataclass(frozen=True)
class _Word:
    """A tree in preorder.

    Attributes:
        second: (i,) of each inner node its second child.
        parents: (m,) the parent of each node; 0 for the root.
        depth: (m,) nodes above each.
    """

    second: np.ndarray
    parents: np.ndarray
    depth: np.ndarray


def _word(look: _Look, is_inner: np.ndarray, second: np.ndarray) -> _Word | None:
    """The tree of nodes of which some are inner, where it is one and has the second children it says."""
    count = len(is_inner)
    if count == 0:
        return look.refuse("RDM562")
    steps = np.where(is_inner, 1, -1)
    height = np.cumsum(steps) - steps
    if height[-1] + steps[-1] != -1 or (height < 0).any():
        look.refuse("RDM564")
        return None
    inner = np.flatnonzero(is_inner)
    # Sorted by height and then by place: the next one as high follows, and where it is lower is a search.
    keys = height * (count + 1) + np.arange(count)
    order = np.argsort(keys)
    keys = keys[order]
    place = np.zeros(count, np.int64)
    place[order] = np.arange(count)
    wanted = order[np.minimum(place[inner] + 1, count - 1)]
    if look.found("RDM564", _marked(count, inner[wanted != second[inner]])):
        return None
    lower = np.searchsorted(keys, (height - 1) * (count + 1) + np.arange(count))
    ends = np.where(height == 0, count, order[np.minimum(lower, count - 1)])
    changes = np.zeros(count + 1, np.int64)
    np.add.at(changes, np.arange(count) + 1, 1)
    np.add.at(changes, ends, -1)
    depth = np.cumsum(changes[:count])
    if look.found("RDM565", depth >= _DEEPEST):
        return None
    parents = np.zeros(count, np.int64)
    parents[inner + 1] = parents[wanted] = inner
    return _Word(wanted, parents, depth)


def _marked(count: int, places: np.ndarray) -> np.ndarray:
    marks = np.zeros(count, np.bool_)
    marks[places] = True
    return marks


def _below(word: _Word, leaves: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """The bounds of all below each node, (m, 6), given those of leaves."""
    own = np.concatenate(
        [np.full((len(word.parents), 3), np.inf), np.full((len(word.parents), 3), -np.inf)], 1
    )
    own[leaves] = boxes
    low = gathered(np.minimum, own[:, :3], word.parents)
    return np.concatenate([low, gathered(np.maximum, own[:, 3:], word.parents)], axis=1)


def _loose(look: _Look, boxes: np.ndarray) -> None:
    """Look at a BVH in preorder; `boxes` are those of its places."""
    is_inner = look.nodes["b"] == 0
    word = _word(look, is_inner, look.nodes["a"].astype(np.int64))
    if word is None:
        return None
    leaves = np.flatnonzero(~is_inner)
    first, held = look.nodes["a"][leaves].astype(np.int64), look.nodes["b"][leaves].astype(np.int64)
    leaves, first, held = (column[np.argsort(first, kind="stable")] for column in (leaves, first, held))
    ends = np.cumsum(held)
    wrong = first != ends - held
    if ends[-1] != len(boxes) or wrong.any():
        return look.refuse("RDM566")
    found = _ranges(boxes[:, :3], boxes[:, 3:], np.append(first, len(boxes)))
    return _held(look, _below(word, leaves, found), np.ones(len(look.nodes), np.bool_))


def _presorted(look: _Look, geometry: Geometry) -> None:
    """Look at the trees of presorted triangles and at the nodes above."""
    starts, n = look.items, len(geometry.begins)
    if len(starts) < 2 or (len(look.nodes) == 0 and len(starts) > 2):
        return look.refuse("RDM562")
    wrong = np.append(np.diff(starts) < 1, starts[-1] != n)
    wrong[0] |= starts[0] != 0
    if look.found("RDM567", wrong, "item"):
        return None
    _slabs(look, geometry)
    if len(look.nodes) == 0:
        return None
    is_inner = look.nodes["b"] == 0
    word = _word(look, is_inner, look.nodes["a"].astype(np.int64))
    if word is None:
        return None
    leaves = np.flatnonzero(~is_inner)
    told = np.stack([look.nodes["a"][leaves], look.nodes["b"][leaves]], axis=1).astype(np.int64)
    if len(leaves) != len(starts) - 1 or (told != np.stack([starts[:-1], np.diff(starts)], axis=1)).any():
        return look.refuse("RDM566")
    boxes = _ranges(geometry.low, geometry.high, starts)
    return _held(look, _below(word, leaves, boxes), np.ones(len(look.nodes), np.bool_))


def _slabs(look: _Look, geometry: Geometry) -> None:
    """Look whether each triangle lies in the slabs of all nodes above it."""
    starts, n = look.items, len(geometry.begins)
    tree = np.repeat(np.arange(len(starts) - 1), np.diff(starts))
    begin, last = starts[tree], starts[tree + 1] - 1
    node = (np.arange(n) - begin) // 2
    depth = np.frexp(node + 1.0)[1] - 1
    wrong = np.zeros(n, np.bool_)
    rows = np.arange(n)
    while len(rows):
        axis = depth[rows] % 3
        one = begin[rows] + 2 * node[rows]
        other = np.minimum(one + 1, last[rows])
        low = np.minimum(geometry.low[one, axis], geometry.low[other, axis])
        high = np.maximum(geometry.high[one, axis], geometry.high[other, axis])
        wrong[rows] |= (geometry.low[rows, axis] < low) | (geometry.high[rows, axis] > high)
        rows = rows[node[rows] > 0]
        node[rows] = (node[rows] - 1) // 2
        depth[rows] -= 1
    look.inspection.found_where(
        "RDM568", wrong, lambda t: f"HIER: triangle {t}", lambda t: look.section.offset
    )


def _cells(look: _Look, geometry: Geometry, objects: np.ndarray) -> None:
    """Look at a kd-tree over objects that are ranges of triangles."""
    axis, value = look.nodes["b"] & 3, look.nodes["b"].astype(np.int64) >> 2
    is_inner = axis != 3
    word = _word(look, is_inner, value)
    if word is None:
        return None
    leaves = np.flatnonzero(~is_inner)
    held, references = value[leaves], look.items
    if (look.nodes["a"][leaves] != np.cumsum(held) - held).any() or held.sum() != len(references):
        return look.refuse("RDM566")
    leaf = np.repeat(leaves, held)
    wrong = references >= len(objects) - 1
    wrong[1:] |= (leaf[1:] == leaf[:-1]) & (references[1:] <= references[:-1])
    root = np.array(look.record.bounds, np.float32)
    low, high = geometry.low.min(axis=0), geometry.high.max(axis=0)
    outside = not ((root[:3] <= low).all() and (root[3:] >= high).all())
    if outside:
        look.inspection.found("RDM568", "HIER: the root's cell", look.section.at(16))
    if look.found("RDM567", wrong, "item") or outside:
        return None
    cells = _cut(look, word, axis.astype(np.int64), root)
    return None if cells is None else _corners(look, geometry, objects, cells[leaf])


def _cut(look: _Look, word: _Word, axis: np.ndarray, root: np.ndarray) -> np.ndarray | None:
    """The cell of each node, where every plane is in its own."""
    cells = np.tile(root, (len(look.nodes), 1))
    planes = np.ascontiguousarray(look.nodes["a"]).view("<f4")
    by_depth = np.argsort(word.depth, kind="stable")
    is_second = _marked(len(cells), word.second)
    wrong = np.zeros(len(cells), np.bool_)
    for level in np.split(by_depth, np.cumsum(np.bincount(word.depth)))[1:-1]:
        above = word.parents[level]
        cells[level] = cells[above]
        side = np.where(is_second[level], 0, 3) + axis[above]
        cells[level, side] = planes[above]
    inner = axis != 3
    rows = np.flatnonzero(inner)
    inside = (planes[rows] >= cells[rows, axis[rows]]) & (planes[rows] <= cells[rows, axis[rows] + 3])
    wrong[rows] = ~inside
    return None if look.found("RDM563", wrong) else cells


def _corners(look: _Look, geometry: Geometry, objects: np.ndarray, cells: np.ndarray) -> None:
    """Look whether each corner lies in the cell of a leaf that refers to its triangle's object.

    `cells` are those of the leaf of each reference.
    """
    sizes = np.diff(objects)[look.items]
    held = np.zeros((len(geometry.begins), 3), np.bool_)
    parts = np.cumsum(sizes) // _AT_ONCE
    for rows in np.split(np.arange(len(sizes)), np.flatnonzero(np.diff(parts)) + 1):
        row = np.repeat(rows, sizes[rows])
        within = np.arange(len(row)) - np.repeat(np.cumsum(sizes[rows]) - sizes[rows], sizes[rows])
        triangle = objects[look.items[row]] + within
        low, high = cells[row, None, :3], cells[row, None, 3:]
        inside = ((geometry.corners[triangle] >= low) & (geometry.corners[triangle] <= high)).all(axis=2)
        np.logical_or.at(held, triangle, inside)
    look.inspection.found_where(
        "RDM568", np.array(~held.all(axis=1)), lambda t: f"HIER: triangle {t}", lambda t: look.section.offset
    )
