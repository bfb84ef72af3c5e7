"""Write scene files field by field, right ones and wrong ones: the tool behind the conformance vectors.

It is written from SPEC.md alone, on the standard library, and shares no code with striptools or the reference
reader. It chooses nothing: whatever a field is to hold can be given, so that it writes what no encoder would.

    python make.py           write valid/ and invalid/ beside this file
    python make.py FOLDER    write them there
"""

import json
import math
import struct
import sys
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import NamedTuple

MAGIC = b"\x89RDM\r\n\x1a\n"
MUST_UNDERSTAND = ("SCEN", "BLKH", "BLKD", "NODE", "RUNS", "GEOM", "INST", "HIER", "TRIS")
ORDER = (
    "SCEN",
    "BLKH",
    "BLKD",
    "NODE",
    "RUNS",
    "RMAP",
    "ATTR",
    "MATL",
    "META",
    "GEOM",
    "INST",
    "HIER",
    "TRIS",
)
RECORD = {
    **dict.fromkeys(("triangle_count", "block_count", "node_count", "top_count", "run_count"), "I"),
    **{"source_face_count": "I", "flags": "B", "reserved": "B", "grid_exponent": "h", "reserved_2": "I"},
    **{"error_bound": "d", **dict.fromkeys(("low_x", "low_y", "low_z", "high_x", "high_y", "high_z"), "f")},
    **{"cell_x": "h", "cell_y": "h", "cell_z": "h", "longest_run": "H"},
    **dict.fromkeys(("origin_x", "origin_y", "origin_z"), "d"),
}
ENTRY = {
    **{"kind": "4s", "flags": "H", "codec": "H", "offset": "Q", "stored_length": "Q", "raw_length": "Q"},
    **{"stored_checksum": "I", "raw_checksum": "I"},
}
HEADER = {
    "magic": "8s",
    "major": "H",
    "minor": "H",
    "section_count": "I",
    "total_length": "Q",
    "reserved": "I",
}
BLOCK = {
    **{"first_triangle": "I", "word": "I", "triangles": "B", "vertices": "B", "strips": "B", "flags": "B"},
    **dict.fromkeys(("anchor_x", "anchor_y", "anchor_z"), "i"),
    **dict.fromkeys(("axis_x", "axis_y", "axis_z", "exponent_x", "exponent_y", "exponent_z"), "B"),
    **{"reserved": "H"},
}


def record(fields: dict[str, str], values: dict) -> bytes:
    """The bytes of a record whose fields have these types."""
    return b"".join(struct.pack(f"<{fields[name]}", values[name]) for name in fields)


def f32(bits: int) -> float:
    """The number of a 32-bit pattern."""
    return struct.unpack("<f", struct.pack("<I", bits))[0]


def bits32(value: float) -> int:
    """The 32-bit pattern of a number that a float32 holds."""
    return struct.unpack("<I", struct.pack("<f", value))[0]


# Blocks


class Axis(NamedTuple):
    """How one axis of a block is stored; `exponent` is the byte, e + 149."""

    anchor: int = 0
    width: int = 0
    mode: int = 0
    exponent: int = 149


class Strip(NamedTuple):
    """A strip's vertices, and a letter 0 or 1 for the turn and the flip of each triangle but the first."""

    index: list[int]
    turns: str = ""
    flips: str = ""


@dataclass
class Block:
    """A block: strips over points, and what its header and stream hold instead of what they should.

    `axes` has an `Axis` or None, the narrowest, for each axis. `header` overrides fields of the header,
    `parts` the lists `starts`, `turns`, `flips`, `index` and `numbers` (q rows of three) of the stream, and
    `tail` the unused bits at its end.
    """

    strips: list[Strip]
    points: list[tuple[float, float, float]]
    axes: tuple[Axis | None, Axis | None, Axis | None] = (None, None, None)
    header: dict = field(default_factory=dict)
    parts: dict = field(default_factory=dict)
    tail: int = 0

    @property
    def lengths(self) -> list[int]:
        """The triangles of each strip."""
        return [len(strip.turns) + 1 for strip in self.strips]

    @property
    def count(self) -> int:
        """Triangles."""
        return sum(self.lengths)

    @property
    def has_flips(self) -> bool:
        """Whether any strip gives flips."""
        return any(strip.flips for strip in self.strips)


def narrowest(values: list[float]) -> Axis:
    """The fewest bits that hold these coordinates: mode 0, 1 for -0.0, 2 for numbers that are too long."""
    cells = [int(Fraction(value) * 2**149) for value in values]
    step = math.gcd(*cells) or 1
    exponent = min((step & -step).bit_length() - 1, 255) if any(cells) else 149
    numbers = [cell >> exponent if any(cells) else 0 for cell in cells]
    minus = any(value == 0 and math.copysign(1, value) < 0 for value in values)
    if max(map(abs, numbers)) >= 2**31:
        places = [place(value) for value in values]
        return Axis(min(places), (max(places) - min(places)).bit_length(), 2, 0)
    spread = max(numbers) - min(numbers)
    return Axis(min(numbers), (spread + minus).bit_length(), int(minus), exponent)


def place(value: float) -> int:
    """A float32's number in the order of all of them: what mode 2 stores."""
    bits = bits32(value)
    return bits if bits < 2**31 else -1 - (bits - 2**31)


def number(value: float, axis: Axis) -> int:
    """The number `u` that stores a coordinate."""
    if axis.mode == 2:
        return place(value) - axis.anchor
    if axis.mode == 1 and value == 0 and math.copysign(1, value) < 0:
        return 2**axis.width - 1
    cells = Fraction(value) * 2**149 / 2**axis.exponent
    return int(cells) - axis.anchor


def encode_block(block: Block, first_triangle: int, word: int) -> tuple[bytes, bytes]:
    """The header and the words of a block."""
    columns = list(zip(*block.points, strict=True))
    axes = [axis or narrowest(list(c)) for axis, c in zip(block.axes, columns, strict=True)]
    starts = [int(i == 0) for length in block.lengths for i in range(length)]
    turns = [int(bit) for strip in block.strips for bit in "0" + strip.turns]
    flips = [int(bit) for s in block.strips for bit in "0" + (s.flips or "0" * len(s.turns))]
    index = [i for strip in block.strips for i in strip.index]
    numbers = [[number(x, axis) for x, axis in zip(p, axes, strict=True)] for p in block.points]
    parts = {
        "starts": starts,
        "turns": turns,
        "flips": flips,
        "index": index,
        "numbers": numbers,
    } | block.parts
    width = (len(block.points) - 1).bit_length()
    rows = [(bit, 1) for bit in parts["starts"] + parts["turns"]]
    rows += [(bit, 1) for bit in parts["flips"] if block.has_flips]
    rows += [(i, width) for i in parts["index"]]
    rows += [(u, axis.width) for row in parts["numbers"] for u, axis in zip(row, axes, strict=True)]
    header = {
        "first_triangle": first_triangle,
        "word": word,
        "triangles": block.count - 1,
        "vertices": len(block.points) - 1,
        "strips": len(block.strips) - 1,
        "flags": int(block.has_flips),
        "reserved": 0,
    }
    for letter, axis in zip("xyz", axes, strict=True):
        header |= {f"anchor_{letter}": axis.anchor, f"axis_{letter}": axis.width | axis.mode << 6}
        header[f"exponent_{letter}"] = axis.exponent
    return record(BLOCK, header | block.header), stream(rows, block.tail)


def stream(rows: list[tuple[int, int]], tail: int = 0) -> bytes:
    """Whole words of numbers of some bits each, lowest first."""
    total = at = 0
    for value, width in rows:
        total |= (value & (1 << width) - 1) << at
        at += width
    words = -(-at // 32)
    return (total | tail << at).to_bytes(4 * words, "little")


def walk(strip: Strip) -> list[list[int]]:
    """The triangles of a strip by the loop of section 4.3."""
    a, b, c = strip.index[:3]
    faces = [[a, b, c]]
    flips = strip.flips or "0" * len(strip.turns)
    for w, turn, flip in zip(strip.index[3:], strip.turns, flips, strict=True):
        a, b, c = (a, c, w) if turn == "1" else (c, b, w)
        faces.append([b, a, c] if flip == "1" else [a, b, c])
    return faces


# Codecs

WIDTHS = {"BLKH": 32, "NODE": 64, "RUNS": 4, "RMAP": 4, "HIER": 4, "TRIS": 4}


def planes(data: bytes, width: int) -> bytes:
    """First all first bytes of the records, then all second ones, and then what is left."""
    rows = len(data) // width
    return b"".join(data[k : rows * width : width] for k in range(width)) + data[rows * width :]


class Named(NamedTuple):
    """How a strip vertex is named: its way, its step where that is 3, a, b, o of its guess where new."""

    way: int
    step: int = 0
    guess: tuple[int, int, int] = (-1, -1, -1)


def name_vertices(block: Block) -> list[Named]:
    """The strip vertices of a block as section 6.2 names them; -1 in a guess stands for zero."""
    named, after, before, largest = [], {}, {}, -1
    for strip in block.strips:
        a = b = c = o = -1
        for t in range(len(strip.turns) + 1):
            if t:
                a, b, o = (a, c, b) if strip.turns[t - 1] == "1" else (c, b, a)
            for corner in range(2 if t else 0, 3):
                w = strip.index[t + corner]
                if w > largest:
                    last = strip.index[corner - 1] if corner else largest
                    named.append(Named(0, 0, (a, b, o) if t else (last, last, last)))
                elif corner and before.get(a if corner == 1 else b) == w:
                    named.append(Named(1))
                elif corner and after.get(a) == w:
                    named.append(Named(2))
                else:
                    named.append(Named(3, largest - w))
                largest = max(largest, w)
                a, b, c = (w if i == corner else x for i, x in enumerate((a, b, c)))
            for x, y in ((a, b), (b, c), (c, a)):
                if after.get(y) != x:
                    after[x], before[y] = y, x
    return named


def fold(difference: int, width: int) -> int:
    """A difference of numbers of some bits as twice its size, less one where it is negative."""
    difference %= 2**width
    return 2 * difference if 2 * difference < 2**width else 2 * (2**width - 1 - difference) + 1


def streams(blocks: list[Block]) -> dict[str, list[int]]:
    """The numbers in the streams of codec 2; each vertex that can be is told as a known one."""
    names = ("starts", "turns", "flips", "ways", "steps", "known", "places", "x", "y", "z")
    made: dict[str, list[int]] = {name: [] for name in names}
    distinct: dict[tuple[int, ...], int] = {}
    last = 0
    for block in blocks:
        made["starts"] += [int(i == 0) for length in block.lengths for i in range(length)]
        made["turns"] += [int(bit) for strip in block.strips for bit in "0" + strip.turns]
        if block.has_flips:
            made["flips"] += [int(x) for s in block.strips for x in "0" + (s.flips or "0" * len(s.turns))]
        named = name_vertices(block)
        made["ways"] += [one.way for one in named]
        made["steps"] += [one.step for one in named if one.way == 3]
        columns = list(zip(*block.points, strict=True))
        axes = [axis or narrowest(list(c)) for axis, c in zip(block.axes, columns, strict=True)]
        numbers = [[number(x, axis) for x, axis in zip(p, axes, strict=True)] for p in block.points]
        guesses = [one.guess for one in named if one.way == 0]
        for point, row, guess in zip(block.points, numbers, guesses, strict=True):
            key = tuple(bits32(x) for x in point)
            made["known"].append(int(key in distinct))
            if key in distinct:
                made["places"].append(fold(distinct[key] - last, 32))
                last = distinct[key]
                continue
            distinct[key] = len(distinct)
            a, b, o = (numbers[i] if i >= 0 else (0, 0, 0) for i in guess)
            for i, name in enumerate("xyz"):
                made[name].append(fold(row[i] - (a[i] + b[i] - o[i]), axes[i].width))
    return made


def content(made: dict[str, list[int]]) -> bytes:
    """The bytes in the frame of codec 2 that hold these streams."""
    widths = {"starts": 1, "turns": 1, "flips": 1, "ways": 2, "steps": 8, "known": 1}
    parts = []
    for name, values in made.items():
        if name in widths:
            bits = stream([(value, widths[name]) for value in values])
            parts.append(bits[: -(-len(values) * widths[name] // 8)])
        else:
            parts.append(planes(struct.pack(f"<{len(values)}I", *values), 4))
    return b"".join(parts)


# Nodes


class Slot(NamedTuple):
    """A slot of a node that is not empty: inner or leaf, and the bytes of its box."""

    is_inner: bool
    low: tuple[int, int, int]
    high: tuple[int, int, int]


class Node(NamedTuple):
    """A node as it is written; `slots` has None for an empty slot and may be shorter than eight."""

    slots: list[Slot | None]
    base: int = 0
    leaves: int = 0
    origin: tuple[int, int, int] = (0, 0, 0)
    shifts: tuple[int, int, int] = (0, 0, 0)


def encode_node(node: Node, is_top: bool) -> bytes:
    """The 64 bytes of a node; one over blocks says which slots are leaves."""
    slots = [*node.slots, *[None] * (8 - len(node.slots))]
    inner = sum((slot is not None and slot.is_inner) << i for i, slot in enumerate(slots))
    marks = sum((slot is not None and not slot.is_inner) << i for i, slot in enumerate(slots)) * is_top
    x, y, z = node.shifts
    head = struct.pack(
        "<II3HBB", node.base | x << 28, node.leaves | marks << 24, *node.origin, inner, y | z << 4
    )
    low = [slot.low[axis] if slot else 1 for axis in range(3) for slot in slots]
    high = [slot.high[axis] if slot else 0 for axis in range(3) for slot in slots]
    return head + bytes(low) + bytes(high)


def decoded_node(node: Node, is_top: bool) -> list:
    """What each slot names and the integers of its planes, as a reader gives them."""
    inner = leaf = 0
    slots = []
    for slot in [*node.slots, *[None] * (8 - len(node.slots))]:
        if slot is None:
            slots.append(None)
            continue
        if slot.is_inner:
            child, inner = ["node", node.base + inner], inner + 1
        elif is_top:
            child, leaf = ["block", node.leaves + leaf], leaf + 1
        else:
            child, leaf = ["run", node.leaves % 2**24, (node.leaves >> 24) + leaf], leaf + 1
        planes = [
            [node.origin[axis] + (side[axis] << node.shifts[axis]) for side in (slot.low, slot.high)]
            for axis in range(3)
        ]
        slots.append([child, planes])
    return slots


def cut_runs(blocks: list[Block], longest: int = 8) -> list[list[tuple[int, int]]]:
    """The runs of each block: its strips from their first triangle on, cut at the longest."""
    runs = []
    for block in blocks:
        here, first = [], 0
        for length in block.lengths:
            here += [(first + i, min(longest, length - i)) for i in range(0, length, longest)]
            first += length
        runs.append(here)
    return runs


def run_word(block: Block, first: int, count: int) -> int:
    """What RUNS has of a run; a strip's first triangle is like one of turn 1."""
    turns = [(i, int(turn)) for i, strip in enumerate(block.strips) for turn in "1" + strip.turns]
    strip, turn = turns[first]
    equal = 0
    while first > equal and turns[first - equal - 1] == (strip, turn):
        equal += 1
    word = first | count - 1 << 8 | strip << 11 | equal + 1 << 27
    return word | sum(turn << 19 + j for j, (_, turn) in enumerate(turns[first : first + count]))


def plain_nodes(
    blocks: list[Block], runs: list[list[tuple[int, int]]] | None, cells: tuple[int, int, int] = (0, 0, 0)
) -> list[Node]:
    """Nodes of up to eight neighbours, for coordinates that spread over no more than 255 cells."""
    low = scene_bounds(blocks)[:3]
    block_boxes = [cell_box(block.points, low, cells) for block in blocks]
    top = [Node([])] if len(blocks) > 1 else []
    if top:
        grow(top, 0, 0, block_boxes, None)
    if runs is None:
        return top
    nodes = top + [Node([]) for _ in blocks]
    for i, (block, here) in enumerate(zip(blocks, runs, strict=True)):
        faces = [face for strip in block.strips for face in walk(strip)]
        corners = [{v for face in faces[first : first + count] for v in face} for first, count in here]
        boxes = [cell_box([block.points[v] for v in run], low, cells) for run in corners]
        grow(nodes, len(top) + i, 0, boxes, i)
    return nodes


def grow(nodes: list[Node], at: int, first: int, boxes: list, block: int | None) -> None:
    """Fill node `at` with leaves from `first` on, blocks or runs of one, under inner nodes where many."""
    if len(boxes) <= 8:
        leaves = first if block is None else first << 24 | block
        nodes[at] = Node([Slot(False, *box) for box in boxes], leaves=leaves)
        return
    size = -(-len(boxes) // 8)
    parts = [boxes[i : i + size] for i in range(0, len(boxes), size)]
    base = len(nodes)
    nodes += [Node([]) for _ in parts]
    nodes[at] = Node([Slot(True, *union(part)) for part in parts], base=base)
    for i, part in enumerate(parts):
        grow(nodes, base + i, first + i * size, part, block)


def cell_box(points: list, low: list[float], cells: tuple[int, int, int]) -> tuple[tuple, tuple]:
    """The bytes of the box of points, in whole cells around them."""
    sides = [
        [(Fraction(p[axis]) - Fraction(low[axis])) / Fraction(2) ** cells[axis] for p in points]
        for axis in range(3)
    ]
    return tuple(math.floor(min(side)) for side in sides), tuple(math.ceil(max(side)) for side in sides)


def fitting_cells(blocks: list[Block]) -> tuple[int, int, int]:
    """The finest cells of which the scene is no more than 255 wide."""
    bounds = [Fraction(bound) for bound in scene_bounds(blocks)]
    spreads = [(high - low) * 2**149 for low, high in zip(bounds[:3], bounds[3:], strict=True)]
    x, y, z = (max(0, int(spread / 255).bit_length()) - 149 for spread in spreads)
    return x, y, z


def union(boxes: list) -> tuple[tuple, tuple]:
    """The box around boxes."""
    return (
        tuple(min(box[0][axis] for box in boxes) for axis in range(3)),
        tuple(max(box[1][axis] for box in boxes) for axis in range(3)),
    )


def scene_bounds(blocks: list[Block]) -> list[float]:
    """The six bounds of all points, -0.0 as 0.0."""
    columns = list(zip(*[point for block in blocks for point in block.points], strict=True))
    return [min(c) + 0.0 for c in columns] + [max(c) + 0.0 for c in columns]


# Attributes


class Values(NamedTuple):
    """An attribute: distinct rows, the row of each entry, and fields of its record that hold something else.

    `index` is None where each entry has a row of its own; numbers of type 0 are bits of floats. `filler` are
    the unused bits behind the rows, `tail` those behind the indices.
    """

    name: str
    domain: int
    type: int
    rows: list[tuple[int, ...]]
    index: list[int] | None = None
    record: dict = {}  # noqa: RUF012
    filler: int = 0
    tail: int = 0


ATTRIBUTE = {
    **{"name": "4s", "domain": "B", "components": "B", "type": "B", "width": "B"},
    **{"rows": "I", "reserved": "I"},
}


def encode_attributes(attributes: list[Values]) -> bytes:
    """The bytes of ATTR."""
    head, data = struct.pack("<2I", len(attributes), 0), b""
    for one in attributes:
        width = (
            0 if one.index is None or len(one.rows) == len(one.index) else (len(one.rows) - 1).bit_length()
        )
        fields = {"name": one.name.encode("latin-1"), "domain": one.domain, "components": len(one.rows[0])}
        fields |= {"type": one.type, "width": width, "rows": len(one.rows), "reserved": 0}
        head += record(ATTRIBUTE, fields | one.record)
        rows = b"".join(struct.pack(f"<{len(row)}{'IBHI'[one.type]}", *row) for row in one.rows)
        rows += one.filler.to_bytes(-len(rows) % 4, "little")
        width = one.record.get("width", width)
        data += rows + stream([(i, width) for i in one.index or []], one.tail)
    return head + data


def decoded_attributes(attributes: list[Values]) -> dict:
    """The domain and the values of each attribute, as a reader gives them."""
    return {
        one.name: [one.domain, [list(one.rows[i]) for i in one.index or range(len(one.rows))]]
        for one in attributes
    }


# Hierarchies of other kinds


class Hierarchy(NamedTuple):
    """What HIER is to hold; a node is `(*low, *high, a, b)`, or `(a, b)` in a kd-tree.

    `record` has fields of its record that hold something else, `tail` bytes behind the items.
    """

    kind: int
    over: int
    nodes: list[tuple]
    items: list[int] = []  # noqa: RUF012
    flags: int = 0
    bounds: tuple[float, ...] = (0.0,) * 6
    record: dict = {}  # noqa: RUF012
    tail: bytes = b""


class Plain(NamedTuple):
    """What TRIS is to hold: points, and triangles of three numbers of points."""

    points: list[tuple[float, float, float]]
    faces: list[list[int]]


BOUNDS = ("low_x", "low_y", "low_z", "high_x", "high_y", "high_z")
HIERARCHY = {
    **{"kind": "B", "over": "B", "flags": "B", "reserved": "B"},
    **{"node_count": "I", "item_count": "I", "reserved_2": "I"},
    **dict.fromkeys(BOUNDS, "f"),
    **{"reserved_3": "24s"},
}


def encode_hierarchy(hierarchy: Hierarchy) -> bytes:
    """The bytes of HIER."""
    fields = {"kind": hierarchy.kind, "over": hierarchy.over, "flags": hierarchy.flags, "reserved": 0}
    fields |= {"node_count": len(hierarchy.nodes), "item_count": len(hierarchy.items), "reserved_2": 0}
    fields |= dict(
        zip(("low_x", "low_y", "low_z", "high_x", "high_y", "high_z"), hierarchy.bounds, strict=True)
    )
    head = record(HIERARCHY, fields | {"reserved_3": b""} | hierarchy.record)
    return head + b"".join(map(pack_node, hierarchy.nodes)) + pack_items(hierarchy.items) + hierarchy.tail


def pack_node(node: tuple) -> bytes:
    """The bytes of a node: floats but for the last two."""
    return struct.pack(f"<{len(node) - 2}f2I", *node)


def pack_items(items: list[int]) -> bytes:
    """The bytes of items."""
    return struct.pack(f"<{len(items)}I", *items)


def encode_plain(plain: Plain) -> bytes:
    """The bytes of TRIS."""
    points = b"".join(struct.pack("<3f", *point) for point in plain.points)
    return points + b"".join(struct.pack("<3I", *face) for face in plain.faces)


def decoded_hierarchy(hierarchy: Hierarchy) -> list:
    """Kind, objects, nodes as words and items, as a reader gives them."""
    nodes = [list(struct.unpack(f"<{len(node)}I", pack_node(node))) for node in hierarchy.nodes]
    return [hierarchy.kind, hierarchy.over, nodes, hierarchy.items]


Box = tuple[float, ...]


def corners_of(blocks: list[Block]) -> list[list[tuple[float, float, float]]]:
    """The corners of each triangle."""
    return [
        [block.points[v] for v in face] for block in blocks for strip in block.strips for face in walk(strip)
    ]


def box_of(points: list[tuple[float, float, float]]) -> Box:
    """The box around points."""
    columns = list(zip(*points, strict=True))
    return (*(min(c) for c in columns), *(max(c) for c in columns))


def object_boxes(blocks: list[Block], over: int) -> list[Box]:
    """The boxes of triangles, strips or blocks."""
    if over == 2:
        return [box_of(block.points) for block in blocks]
    if over == 1:
        return [box_of([block.points[v] for v in strip.index]) for block in blocks for strip in block.strips]
    return [box_of(corners) for corners in corners_of(blocks)]


def around(boxes: list[Box]) -> Box:
    """The box around boxes."""
    return box_of([corner for box in boxes for corner in (box[:3], box[3:])])


def loose_tree(boxes: list[Box], leaf: int = 1) -> list[tuple]:
    """A BVH in preorder over places with these boxes, halved until leaves are small."""
    nodes: list[tuple] = []

    def grow(first: int, count: int) -> None:
        at, box = len(nodes), around(boxes[first : first + count])
        nodes.append((*box, first, count))
        if count > leaf:
            grow(first, count // 2)
            nodes[at] = (*box, len(nodes), 0)
            grow(first + count // 2, count - count // 2)

    grow(0, len(boxes))
    return nodes


def heap_tree(boxes: list[Box]) -> list[tuple]:
    """An SLBVH over places with these boxes, one a leaf."""
    nodes: list[tuple] = [(0.0,) * 6 + (0, 0)] * (2 << (len(boxes) - 1).bit_length())

    def grow(at: int, first: int, count: int) -> None:
        box = around(boxes[first : first + count])
        nodes[at] = (*box, count << 3 | (4 if count == 1 else first % 3), first)
        if count > 1:
            grow(2 * at, first, count - count // 2)
            grow(2 * at + 1, first + count - count // 2, count // 2)

    grow(1, 0, len(boxes))
    return nodes


def cell_tree(boxes: list[Box], depth: int) -> tuple[list[tuple], list[int], Box]:
    """A kd-tree over objects with these boxes: nodes, references, the root's cell."""
    nodes: list[tuple] = []
    references: list[int] = []

    def grow(cell: Box, objects: list[int], left: int) -> None:
        at = len(nodes)
        if left == 0:
            nodes.append((len(references), len(objects) << 2 | 3))
            references.extend(objects)
            return
        axis = (depth - left) % 3
        plane = f32(bits32((cell[axis] + cell[axis + 3]) / 2))
        nodes.append(())
        below = (*cell[: axis + 3], plane, *cell[axis + 4 :])
        grow(below, [i for i in objects if boxes[i][axis] <= plane], left - 1)
        nodes[at] = (bits32(plane), len(nodes) << 2 | axis)
        above = (*cell[:axis], plane, *cell[axis + 1 :])
        grow(above, [i for i in objects if boxes[i][axis + 3] >= plane], left - 1)

    root = around(boxes)
    grow(root, list(range(len(boxes))), depth)
    return nodes, references, root


def presort(boxes: list[Box]) -> list[int]:
    """The order in which triangles with these boxes are one presorted tree."""
    count, order = -(-len(boxes) // 2), [-1] * len(boxes)

    def held(node: int) -> int:
        own = max(0, min(2, len(boxes) - 2 * node))
        return own + held(2 * node + 1) + held(2 * node + 2) if node < count else 0

    def place(node: int, items: list[int], axis: int) -> None:
        if not items:
            return
        first = min(items, key=lambda i: (boxes[i][axis], -boxes[i][axis + 3], i))
        rest = [i for i in items if i != first]
        order[2 * node] = first
        if rest:
            order[2 * node + 1] = max(rest, key=lambda i: (boxes[i][axis + 3], -i))
            rest.remove(order[2 * node + 1])
        middle = held(2 * node + 1)
        place(2 * node + 1, rest[:middle], (axis + 1) % 3)
        place(2 * node + 2, rest[middle:], (axis + 1) % 3)

    place(0, list(range(len(boxes))), 0)
    return order


def plain_of(corners: list[list[tuple[float, float, float]]]) -> Plain:
    """Triangles with vertices in the order of their first use."""
    number: dict[tuple, int] = {}
    faces = [[number.setdefault(tuple(map(bits32, point)), len(number)) for point in row] for row in corners]
    return Plain([tuple(f32(bits) for bits in point) for point in number], faces)


# Files


@dataclass
class Plan:
    """A scene file to write; what is None is left out, or is what it should be.

    Attributes:
        blocks: The blocks.
        stored: Whether boxes are stored.
        nodes: The nodes; None for plain ones.
        top: How many of them are over blocks; None for as many as plain ones have.
        runs: `(first, count)` for each run of each block; None for strips cut at the longest.
        remap: `(face, rotation)` of each triangle.
        attributes: The attributes, if any.
        materials: An array, or the bytes of MATL.
        geometries: `(first_block, first_top, first_face, face_count)` of each, if any; nodes are to be given
            with them.
        instances: `(geometry, first_face, matrix)` of each, the matrix twelve numbers, if any.
        hierarchy: What HIER is to hold, if it is there; nodes are then none.
        plain: What TRIS is to hold, if it is there.
        metadata: An object, or the bytes of META.
        grid: The grid exponent.
        cells: The exponents of the cells of plain nodes.
        record: Fields of SCEN that hold something else.
        payloads: For a kind, what is done to the bytes of the section before it is written.
        packed: For a kind, what makes its stored bytes.
        codecs: For a packed kind its codec; None for 1.
        entries: For a kind, fields of its row in the section table that hold something else.
        extra: Further sections `(kind, flags, codec, bytes)`.
        drop: Kinds to leave out.
        order: The order of kinds; None for the writer's, further ones last.
        header: Fields of the file header that hold something else.
        padding: The byte that fills up.
        edit: What is done to the bytes of the whole file, its checksums left as they are.
    """

    blocks: list[Block]
    stored: bool = False
    nodes: list[Node] | None = None
    top: int | None = None
    runs: list[list[tuple[int, int]]] | None = None
    remap: list[tuple[int, int]] | None = None
    attributes: list[Values] = field(default_factory=list)
    materials: list | bytes | None = None
    geometries: list[tuple[int, int, int, int]] = field(default_factory=list)
    instances: list[tuple[int, int, tuple[float, ...]]] = field(default_factory=list)
    hierarchy: Hierarchy | None = None
    plain: Plain | None = None
    metadata: dict | bytes | None = None
    grid: int | None = None
    cells: tuple[int, int, int] = (0, 0, 0)
    record: dict = field(default_factory=dict)
    payloads: dict[str, Callable[[bytes], bytes]] = field(default_factory=dict)
    packed: dict[str, Callable[[bytes], bytes]] = field(default_factory=dict)
    codecs: dict[str, int] = field(default_factory=dict)
    entries: dict[str, dict] = field(default_factory=dict)
    extra: list[tuple[str, int, int, bytes]] = field(default_factory=list)
    drop: tuple[str, ...] = ()
    order: tuple[str, ...] | None = None
    header: dict = field(default_factory=dict)
    padding: int = 0
    edit: Callable[[bytes], bytes] = bytes

    def __post_init__(self) -> None:
        """Fill in plain runs and nodes."""
        if self.stored and self.runs is None:
            self.runs = cut_runs(self.blocks)
        if self.nodes is None:
            wanted = self.stored or (len(self.blocks) > 1 and self.hierarchy is None)
            self.nodes = plain_nodes(self.blocks, self.runs, self.cells) if wanted else []
        if self.top is None:
            plain = len(plain_nodes(self.blocks, None, self.cells)) if len(self.blocks) > 1 else 0
            self.top = min(plain, len(self.nodes))

    @property
    def count(self) -> int:
        """Triangles."""
        return sum(block.count for block in self.blocks) + len(self.plain.faces if self.plain else [])

    @property
    def bounds(self) -> list[float]:
        """The six bounds of all points."""
        if self.plain:
            return [side + 0.0 for side in box_of(self.plain.points)]
        return scene_bounds(self.blocks) if self.blocks else [0.0] * 6


def encode(plan: Plan) -> bytes:
    """The bytes of a scene file."""
    payloads = {kind: data for kind, data in sections(plan).items() if data and kind not in plan.drop}
    for kind, change in plan.payloads.items():
        payloads[kind] = change(payloads.get(kind, b""))
    rows = [(kind, int(kind in MUST_UNDERSTAND), 0, data, data) for kind, data in payloads.items()]
    rows += [(kind, flags, codec, data, data) for kind, flags, codec, data in plan.extra]
    rows = [
        (kind, flags, plan.codecs.get(kind, 1), plan.packed[kind](raw), raw)
        if kind in plan.packed
        else (kind, flags, codec, data, raw)
        for kind, flags, codec, data, raw in rows
    ]
    if plan.order:
        rows.sort(key=lambda row: plan.order.index(row[0]))
    return plan.edit(container(plan, rows))


def container(plan: Plan, rows: list[tuple[str, int, int, bytes, bytes]]) -> bytes:
    """Header, table and sections one behind the other."""
    table, body = b"", b""
    start = 32 + 40 * len(rows)
    for kind, flags, codec, stored, raw in rows:
        body += bytes([plan.padding]) * (-(start + len(body)) % 64)
        entry = {
            "kind": kind.encode("latin-1"),
            "flags": flags,
            "codec": codec,
            "offset": start + len(body),
            "stored_length": len(stored),
            "raw_length": len(raw),
            "stored_checksum": zlib.crc32(stored),
            "raw_checksum": zlib.crc32(raw),
        }
        table += record(ENTRY, entry | plan.entries.get(kind, {}))
        body += stored
    body += bytes([plan.padding]) * (-(start + len(body)) % 64)
    header = {"magic": MAGIC, "major": 0, "minor": 4, "section_count": len(rows), "reserved": 0}
    header["total_length"] = start + len(body)
    head = record(HEADER, header | plan.header)
    checksum = plan.header.get("checksum", zlib.crc32(head + table))
    return head + struct.pack("<I", checksum) + table + body


def sections(plan: Plan) -> dict[str, bytes]:
    """The raw bytes of the sections of a plan; empty ones are to be left out."""
    headers, data, first = b"", b"", 0
    for block in plan.blocks:
        header, words = encode_block(block, first, len(data) // 4)
        headers, data, first = headers + header, data + words, first + block.count
    if data:
        data += bytes(64)
        data += bytes(-len(data) % 64)
    runs = b""
    if plan.runs is not None:
        at = [sum(map(len, plan.runs[:i])) for i in range(len(plan.runs))]
        words = [
            run_word(block, *run) for block, here in zip(plan.blocks, plan.runs, strict=True) for run in here
        ]
        runs = struct.pack(f"<{len(at)}I", *at)
        runs += bytes(-len(runs) % 64) + struct.pack(f"<{len(words)}I", *words)
    remap = b""
    if plan.remap is not None:
        remap = struct.pack(f"<{len(plan.remap)}I", *[face for face, _ in plan.remap])
        packed = stream([(rotation, 2) for _, rotation in plan.remap])
        remap += packed[: -(-len(plan.remap) // 4)]
    attributes = encode_attributes(plan.attributes) if plan.attributes else b""
    materials, metadata = plan.materials or b"", plan.metadata or b""
    if isinstance(materials, list):
        materials = json.dumps(materials, ensure_ascii=False).encode()
    if isinstance(metadata, dict):
        metadata = json.dumps(metadata, ensure_ascii=False).encode()
    nodes = b"".join(encode_node(node, i < plan.top) for i, node in enumerate(plan.nodes or []))
    made = (record(RECORD, scene_record(plan)), headers, data, nodes, runs, remap)
    geometries = b"".join(struct.pack("<4I", *row) for row in plan.geometries)
    instances = b"".join(struct.pack("<2I12d", *row[:2], *row[2]) for row in plan.instances)
    made += (attributes, materials, metadata, geometries, instances)
    made += (encode_hierarchy(plan.hierarchy) if plan.hierarchy else b"",)
    made += (encode_plain(plan.plain) if plan.plain else b"",)
    return dict(zip(ORDER, made, strict=True))


def scene_record(plan: Plan) -> dict:
    """The fields of SCEN."""
    names = ("low_x", "low_y", "low_z", "high_x", "high_y", "high_z")
    return {
        "triangle_count": plan.count,
        "block_count": len(plan.blocks),
        "node_count": len(plan.nodes or []),
        "top_count": plan.top,
        "run_count": sum(map(len, plan.runs or [])),
        "source_face_count": plan.count,
        "flags": int(plan.stored) | (plan.grid is not None) << 1,
        "reserved": 0,
        "grid_exponent": plan.grid or 0,
        "reserved_2": 0,
        "error_bound": 0.0,
        **dict(zip(names, plan.bounds, strict=True)),
        **dict(zip(("cell_x", "cell_y", "cell_z"), plan.cells, strict=True)),
        "longest_run": 8 if plan.stored else 0,
        "origin_x": 0.0,
        "origin_y": 0.0,
        "origin_z": 0.0,
    } | plan.record


def decoding(plan: Plan) -> dict:
    """What a reader makes of a valid plan: floats as the hexadecimal of their bits, x, y and z in a row.

    Fields of the record that are not there are zero; attributes, materials and instances are left out where
    there are none.
    """
    first, faces, vertices = 0, [], []
    for block in plan.blocks:
        faces += [[first + v for v in face] for strip in block.strips for face in walk(strip)]
        vertices += ["".join(f"{bits32(x):08x}" for x in point) for point in block.points]
        first += len(block.points)
    if plan.plain:
        faces = plan.plain.faces
        vertices = ["".join(f"{bits32(x):08x}" for x in point) for point in plan.plain.points]
    fields = scene_record(plan)
    skipped = [kind for kind, *_ in plan.extra]
    metadata = plan.metadata or {}
    if isinstance(metadata, bytes):
        metadata = json.loads(metadata, parse_int=str, parse_float=str)
    return {
        "record": {name: value for name, value in fields.items() if value},
        "blocks": [block.count for block in plan.blocks],
        "vertices": vertices,
        "faces": faces,
        "remap": plan.remap,
        "runs": plan.runs,
        "nodes": [decoded_node(node, i < (plan.top or 0)) for i, node in enumerate(plan.nodes or [])],
        "metadata": metadata,
        "passed_over": skipped,
        "packed": sorted(plan.packed),
        **({"attributes": decoded_attributes(plan.attributes)} if plan.attributes else {}),
        **({"materials": plan.materials} if plan.materials else {}),
        **({"hierarchy": decoded_hierarchy(plan.hierarchy)} if plan.hierarchy else {}),
        **({"geometries": plan.geometries, "instances": plan.instances} if plan.instances else {}),
    }


def write(folder: Path) -> None:
    """Write all vectors below a folder, and nothing else."""
    from cases import all_files

    for name, data in all_files().items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)


if __name__ == "__main__":
    write(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent)
