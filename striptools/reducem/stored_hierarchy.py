"""The section of a hierarchy other than the default one: its record, its nodes and its items.

The layout and its reasons are in formats/reducem/SPEC.md, section 4.12; `check_hierarchy` looks whether what
stands there is a hierarchy of the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, get_args

import numpy as np

from striptools.hierarchies.kdtree import KdTree
from striptools.hierarchies.loose_octree import LooseBvh
from striptools.hierarchies.options import OVER, HierarchyName, OverName
from striptools.hierarchies.presorted import Presorted
from striptools.hierarchies.slbvh import Slbvh
from striptools.hierarchies.stored import StoredHierarchy
from striptools.reducem import layout
from striptools.reducem.issues import unreadable

__all__ = ["decode_hierarchy", "encode_hierarchy", "hierarchy_length", "items_of", "name_of", "over_of"]

KINDS: dict[int, tuple[HierarchyName, type]] = {
    1: ("slbvh", Slbvh),
    2: ("kdtree", KdTree),
    3: ("loose-octree", LooseBvh),
    4: ("presorted", Presorted),
}
"""By the record's `kind`: the name and what holds it."""

OBJECTS: tuple[OverName, ...] = get_args(OverName)
"""By the record's `over`."""

HAS_ORDER = 1
"""The bit of the record's flags that says that there is an order."""


def name_of(hierarchy: StoredHierarchy) -> HierarchyName:
    """What a user calls it."""
    return next(name for name, kind in KINDS.values() if isinstance(hierarchy, kind))


def over_of(hierarchy: StoredHierarchy) -> OverName:
    """What its objects are."""
    return "triangles" if isinstance(hierarchy, Presorted) else hierarchy.over


def items_of(hierarchy: StoredHierarchy) -> np.ndarray | None:
    """The numbers behind its nodes; None for an order that is not there."""
    if isinstance(hierarchy, KdTree):
        return hierarchy.references
    return hierarchy.starts if isinstance(hierarchy, Presorted) else hierarchy.order


def hierarchy_length(hierarchy: StoredHierarchy | None) -> int:
    """Bytes of the section; 0 where there is none."""
    if hierarchy is None:
        return 0
    items = items_of(hierarchy)
    return layout.HIERARCHY_RECORD.size + hierarchy.nodes.nbytes + (0 if items is None else items.nbytes)


def encode_hierarchy(hierarchy: StoredHierarchy | None) -> bytes:
    """The section of a hierarchy; no bytes where there is none."""
    if hierarchy is None:
        return b""
    items = items_of(hierarchy)
    record = np.zeros(1, layout.HIERARCHY_RECORD.dtype)
    record["kind"] = next(code for code, (_, kind) in KINDS.items() if isinstance(hierarchy, kind))
    record["over"] = OBJECTS.index(over_of(hierarchy))
    record["node_count"] = len(hierarchy.nodes)
    record["item_count"] = 0 if items is None else len(items)
    if isinstance(hierarchy, KdTree):
        for name, corner in (("low", hierarchy.low), ("high", hierarchy.high)):
            for axis, value in zip("xyz", corner, strict=True):
                record[f"{name}_{axis}"] = value
    elif not isinstance(hierarchy, Presorted) and items is not None:
        record["flags"] = HAS_ORDER
    rest = b"" if items is None else items.astype("<u4").tobytes()
    return record.tobytes() + hierarchy.nodes.astype("<u4").tobytes() + rest


def decode_hierarchy(raw: np.ndarray, where: str) -> StoredHierarchy:
    """The hierarchy of a section, nothing of it believed but its record.

    Args:
        raw: The bytes of the section, uint8.
        where: What an error names as its place.

    Raises:
        UnreadableSceneError: The record breaks a rule, or is not borne out by the length.
    """
    place, size = f"{where}: HIER", layout.HIERARCHY_RECORD.size
    if len(raw) < size:
        raise unreadable("RDM562", place)
    row = np.frombuffer(raw[:size].tobytes(), layout.HIERARCHY_RECORD.dtype)[0]
    record = {field.name: row[field.name].tolist() for field in layout.HIERARCHY_RECORD.fields}
    if record["flags"] > HAS_ORDER or record["reserved"] or record["reserved_2"] or any(record["reserved_3"]):
        raise unreadable("RDM107", place)
    over = _over(record, place)
    corners = [record[f"{name}_{axis}"] for name in ("low", "high") for axis in "xyz"]
    is_tree = record["kind"] == 2
    if not np.isfinite(corners).all() if is_tree else raw[16:40].any():
        raise unreadable("RDM563", place)
    nodes, items, width = record["node_count"], record["item_count"], 2 if is_tree else 8
    if nodes > layout.NODE_LIMIT or len(raw) != size + 4 * (width * nodes + items):
        raise unreadable("RDM562", place)
    words = raw[size:].view("<u4").astype(np.uint32, copy=False)
    table, rest = words[: width * nodes].reshape(-1, width), words[width * nodes :]
    return _made(record, over, table, rest, corners)


def _over(record: dict[str, Any], place: str) -> OverName:
    """What the objects are, where the kind can have such."""
    known = KINDS.get(record["kind"])
    if known is None or record["over"] >= len(OBJECTS) or OBJECTS[record["over"]] not in OVER[known[0]]:
        raise unreadable("RDM561", place)
    if record["flags"] and record["kind"] in (2, 4):
        raise unreadable("RDM561", place)
    if record["kind"] in (1, 3) and bool(record["flags"]) != bool(record["item_count"]):
        raise unreadable("RDM562", place)
    return OBJECTS[record["over"]]


def _made(
    record: dict[str, Any], over: OverName, nodes: np.ndarray, items: np.ndarray, corners: Sequence[float]
) -> StoredHierarchy:
    if record["kind"] == 2:
        low, high = np.array(corners, np.float32).reshape(2, 3)
        return KdTree(over, nodes, items, low, high)
    # What is too large for int32 comes out negative, and names nothing.
    numbers = items.view(np.int32)
    if record["kind"] == 4:
        return Presorted(nodes, numbers)
    made = Slbvh if record["kind"] == 1 else LooseBvh
    return made(over, nodes, numbers if record["flags"] else None)
