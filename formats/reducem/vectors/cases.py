"""The conformance vectors: what each file is to show, and what it decodes to or which issues it has."""

import hashlib
import json
import struct
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise, product

from make import (
    WIDTHS,
    Axis,
    Block,
    Box,
    Hierarchy,
    Node,
    Plain,
    Plan,
    Slot,
    Strip,
    Values,
    around,
    bits32,
    cell_tree,
    content,
    corners_of,
    decoding,
    encode,
    f32,
    fold,
    heap_tree,
    loose_tree,
    object_boxes,
    place,
    plain_nodes,
    plain_of,
    planes,
    presort,
    streams,
)

LONGEST_LINE = 800
BIG = f32(0x7F7FFFFF)
TINY = f32(1)
FLAT = Axis()


def zigzag(count: int, first: int = 0) -> Strip:
    """A strip of so many triangles to and fro, over new vertices from `first` on."""
    return Strip(list(range(first, first + count + 2)), "01" * ((count - 1) // 2) + "0" * ((count - 1) % 2))


def points(count: int, shift: int = 0) -> list[tuple[float, float, float]]:
    """Points of small whole coordinates along a zigzag."""
    return [(float(shift + i // 2), float(i % 2), float(i * i % 7)) for i in range(count)]


def triangle(xs: tuple[float, float, float], axis: Axis | None = None) -> Block:
    """One triangle with these x, stored as `axis` says."""
    ys, zs = (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
    return Block([Strip([0, 1, 2])], list(zip(xs, ys, zs, strict=True)), (axis, None, None))


def blocks_of(count: int, each: int = 2) -> list[Block]:
    """Blocks of one strip each, side by side."""
    return [Block([zigzag(each)], points(each + 2, shift=3 * i)) for i in range(count)]


def limited(count: int) -> list[Block]:
    """Blocks of two strips and as many vertices as there may be, 256 triangles each but the last."""
    whole = [Block([zigzag(128), zigzag(128, 126)], points(256)) for _ in range(count // 256)]
    rest = count % 256
    if rest > 128:
        whole.append(Block([zigzag(128), zigzag(rest - 128, 256 - (rest - 126))], points(256)))
    elif rest:
        whole.append(Block([zigzag(rest)], points(rest + 2)))
    return whole


def lonely(count: int) -> Block:
    """A block in which every triangle is a strip of its own, over vertices used again at the end."""
    rows = [[i, i + 1, i + 2] for i in range(min(count, 254))] + [
        [i + 2, i + 1, i] for i in range(count - 254)
    ]
    return Block([Strip(row) for row in rows], points(min(count + 2, 256)))


def fan(turns: str) -> Block:
    """A strip with these turns over points that do not matter."""
    return Block([Strip(list(range(len(turns) + 3)), turns)], points(len(turns) + 3))


def frame(data: bytes, *, kind: int = 0, descriptor: int = 0xE0, tail: bytes = b"") -> bytes:
    """A Zstandard frame of one block: 0 as it is, 1 the first byte repeated."""
    size = struct.pack("<Q", len(data)) if descriptor >= 0xC0 else b""
    head = struct.pack("<I", 0xFD2FB528) + bytes([descriptor]) + size
    block = (1 | kind << 1 | len(data) << 3).to_bytes(3, "little")
    return head + block + (data[:1] if kind else data) + tail


def _with_dictionary_0(data: bytes) -> bytes:
    """A frame of one block whose header names dictionary 0 in four bytes."""
    plain = frame(data)
    return plain[:4] + bytes([0xE3]) + bytes(4) + plain[5:]


# Valid ones

TRIANGLE = Block([Strip([0, 1, 2])], [(0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 3.0, 1.0)])
TURNS = {count: ["".join(bits) for bits in product("01", repeat=count - 1)] for count in (2, 3, 4)}
FLIPPED = [Strip([0, 1, 2, 3, 4], "01", "01"), Strip([4, 3, 5, 6], "1", "1"), Strip([6, 5, 7])]
GRID = [(float(x), float(y), float(x * y % 5)) for y in range(4) for x in range(4)]
ROWS = [Strip([0, 1, 2, 3, 4, 5, 6], "0101"), Strip([1, 7, 3, 8, 9], "01"), Strip([8, 10, 9, 2, 0], "10")]
SHARED = [
    Block(ROWS, GRID[:11]),
    Block([Strip([0, 1, 2, 3, 1], "10"), Strip([3, 4, 0])], [GRID[i] for i in (3, 12, 9, 0, 15)]),
    Block([zigzag(3)], GRID[4:9]),
]
WITH_FLIPS = [Block(FLIPPED, GRID[:8])]
MODES = [
    Block([Strip([0, 1, 2])], [(1.0, 0.0, 2.0), (-0.0, 1.0, 2.0), (3.0, 1.0, 0.0)]),
    Block(
        [Strip([0, 1, 2])],
        [(3.0, 1.0, 0.0), (2.0, 2.0, -0.0), (1.0, 0.0, 2.0)],
        (Axis(place(1.0), 24, 2, 0), None, None),
    ),
    Block(
        [Strip([0, 1, 2])],
        [(2.0, 2.0, -0.0), (-0.0, 1.0, 2.0), (0.0, 0.0, 0.0)],
        (Axis(-1, 31, 2, 0), None, None),
    ),
]
DEEP = '{"a": ' + "[" * 31 + '"[[["' + "]" * 31 + "}"


def valid_plans() -> dict[str, tuple[str, Plan]]:
    """The valid files by name, with what each is to show."""
    made = {
        "empty": ("a scene without a triangle", Plan([])),
        "empty_metadata": ("an empty scene with metadata", Plan([], metadata={"unit": "m"})),
        "triangle": ("one triangle", Plan([TRIANGLE])),
        "two_blocks": ("two blocks, boxes rebuilt", Plan(blocks_of(2))),
        "worked_example": ("the example of SPEC.md, section 9", worked_example()),
        "error_bound": ("a bound, and all the source faces there may be", _bound()),
    }
    for group in (_turns(), _limits(), _widths(), _exponents(), _floats(), _boxes(), _containers(), _sides()):
        made |= group
    for group in (_attributes(), _origins(), _instances(), _hierarchies()):
        made |= group
    return made


def worked_example() -> Plan:
    """The scene whose bytes stand in the specification."""
    first = [(0.0, 0.0, 1.0), (0.5, 0.0, 1.0), (0.0, 2.0, 1.0), (1.5, 2.0, 1.0), (0.5, 4.0, 1.0)]
    second = [(2.5, -0.0, 1.0), (3.5, 0.0, 1.0), (2.5, 2.0, 1.0), (3.5, 2.0, 1.25)]
    blocks = [Block([Strip([0, 1, 2, 3, 4], "10")], first), Block([Strip([0, 1, 2, 3], "0", "1")], second)]
    left, right = Slot(False, (0, 0, 0), (6, 8, 0)), Slot(False, (10, 0, 0), (14, 8, 1))
    nodes = [
        Node([left, right]),
        Node([left]),
        Node([Slot(False, (0, 0, 0), (4, 8, 1))], leaves=1, origin=(10, 0, 0)),
    ]
    fields = {"source_face_count": 6, "longest_run": 3, "cell_x": -2, "cell_y": -1, "cell_z": -2}
    remap = [(0, 0), (2, 1), (1, 0), (4, 2), (5, 0)]
    return Plan(blocks, stored=True, nodes=nodes, remap=remap, record=fields)


def _bound() -> Plan:
    return Plan([TRIANGLE], record={"error_bound": 0.1, "source_face_count": 2**32 - 1})


def _turns() -> dict[str, tuple[str, Plan]]:
    made = {}
    for count, patterns in TURNS.items():
        strips = [Strip([i * (count + 2) + j for j in range(count + 2)], t) for i, t in enumerate(patterns)]
        block = Block(strips, points(len(strips) * (count + 2)))
        made[f"turns_{count}"] = (f"strips of {count} triangles, every pattern of turns", Plan([block]))
    made["flips"] = ("flipped triangles in two strips of three", Plan([Block(FLIPPED, points(8))]))
    mixed = [Block(FLIPPED, points(8)), *blocks_of(1)]
    made["flips_in_one_block"] = ("flips in the first of two blocks", Plan(mixed))
    for name, turns in (
        ("equal_29", "0" * 29),
        ("equal_30", "1" * 30),
        ("equal_30_and_30", "0" * 30 + "1" * 30),
    ):
        made[f"turns_{name}"] = ("as many equal turn bits in a row as its name says", Plan([fan(turns)]))
    again = [Strip(list(range(33)), "0" * 30), Strip(list(range(32, 65)), "0" * 30)]
    made["turns_equal_over_strips"] = (
        "30 equal turns, a new strip, 30 more",
        Plan([Block(again, points(65))]),
    )
    return made


def _limits() -> dict[str, tuple[str, Plan]]:
    made = {}
    for count in (255, 256, 257, 512):
        made[f"triangles_{count}"] = ("triangles about the limit of a block", Plan(limited(count)))
    for count in (3, 4, 5, 8, 9, 16, 17, 32, 33, 64, 65, 127, 128, 129, 254, 255, 256):
        block = Block([zigzag(count - 2)], points(count))
        made[f"vertices_{count}"] = ("vertices about the widths of an index", Plan([block]))
    for count in (2, 255, 256):
        made[f"strips_{count}"] = ("strips about the limit of a block", Plan([lonely(count)]))
    return made


def _widths() -> dict[str, tuple[str, Plan]]:
    made = {}
    for width in (0, 1, 2, 7, 8, 23, 24, 25, 31, 32):
        low = -(2 ** max(width - 1, 0))
        top = 2**width - 1
        # A float32 holds 24 bits of a number, so the largest of more bits ends in zeros.
        high = low + (top >> max(width - 24, 0) << max(width - 24, 0))
        if width == 32:
            low, high = -(2**31) + 128, 2**31 - 128
        block = triangle((float(low), float(high), 0.0 if width > 1 else float(low)), Axis(low, width))
        made[f"width_{width}"] = ("numbers of as many bits, from nothing to all set", Plan([block]))
    wide = Axis(-1000, 24, 0, 140)
    block = Block(TRIANGLE.strips, TRIANGLE.points, (wide, wide, Axis(-(2**31), 32)))
    made["width_too_large"] = ("more bits, a lower anchor, a finer exponent than needed", Plan([block]))
    block = triangle((0.0, 1.0, 2.0), Axis(7, 3, 0, 148))
    block.points = [(3.5, 0.0, 0.0), (5.0, 1.0, 0.0), (4.5, 0.0, 1.0)]
    made["anchor"] = ("an anchor that no vertex has as its coordinate, in halves", Plan([block]))
    return made


def _exponents() -> dict[str, tuple[str, Plan]]:
    least = triangle((TINY, 3 * TINY, -2 * TINY), Axis(-2, 3, 0, 0))
    finer = triangle((2 * TINY, 0.0, -2 * TINY), Axis(-1, 2, 0, 1))
    most = (2.0**22 - 1) * 2.0**106
    largest = triangle((most, -most, 0.0), Axis(-(2**22) + 1, 23, 0, 255))
    greatest = triangle((BIG, -BIG, 2.0**104), Axis(-(2**24) + 1, 25, 0, 253))
    edge = triangle((float(2**31 - 128), 128.0 - 2**31, 0.0), Axis(-(2**31), 32))
    return {
        "exponent_0": ("the smallest denormals", Plan([least])),
        "exponent_1": ("twice the smallest denormal", Plan([finer])),
        "exponent_255": ("the largest exponent", Plan([largest])),
        "largest_float": ("the largest floats, in mode 0", Plan([greatest])),
        "number_at_its_limit": ("A + u next to its limits, from the least anchor", Plan([edge])),
    }


def _floats() -> dict[str, tuple[str, Plan]]:
    narrow = triangle((-0.0, 0.0, 0.0), Axis(0, 1, 1))
    wide = triangle((-0.0, 5.0, -5.0), Axis(-5, 32, 1))
    only = triangle((-0.0, -0.0, -0.0), Axis(2**31 - 1, 1, 1))
    codes = triangle((-0.0, TINY, -TINY), Axis(-2, 2, 2, 0))
    ends = triangle((BIG, -BIG, -0.0), Axis(-0x7F800000, 32, 2, 0))
    same = triangle((-0.0, -0.0, -0.0), Axis(-1, 0, 2, 0))
    mixed = triangle((f32(0x00800000), f32(0x007FFFFF), f32(0x3F800001)), Axis(0x007FFFFF, 30, 2, 0))
    shared = Block(
        [Strip([0, 1, 2]), Strip([3, 4, 5])], [(0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)] * 2
    )
    flat = Block([Strip([0, 1, 2])], [(1.0, 1.0, 1.0)] * 3)
    grid = triangle((0.0625, -0.0, 3.0), Axis(0, 6, 1, 145))
    coarse = Block([Strip([0, 1, 2])], [(0.0, 0.0, 0.0), (2.0**104, 0.0, 0.0), (0.0, -(2.0**127), 2.0**105)])
    return {
        "mode_1_narrow": ("-0.0 among 0.0, in one bit", Plan([narrow])),
        "mode_1_wide": ("-0.0 as 32 set bits", Plan([wide])),
        "mode_1_only": ("-0.0 alone, under an anchor that is no float32", Plan([only])),
        "mode_2_about_zero": ("-0.0 and the smallest denormals by their bits", Plan([codes])),
        "mode_2_ends": ("the largest floats by their bits", Plan([ends])),
        "mode_2_same": ("-0.0 by its bits, in none", Plan([same])),
        "mode_2_denormal": ("the border of the denormals by their bits", Plan([mixed])),
        "vertices_alike": ("two vertices of one block with the same bits", Plan([shared])),
        "point": ("a triangle in one point, its bounds too", Plan([flat])),
        "grid": (
            "positions on a grid, -0.0 among them",
            Plan([grid], grid=-4, record={"error_bound": 0.03125}),
        ),
        "grid_finest": ("the finest grid", Plan([triangle((TINY, 0.0, 1.0))], grid=-149)),
        "grid_coarsest": ("the coarsest grid", Plan([coarse], grid=104)),
    }


def _boxes() -> dict[str, tuple[str, Plan]]:
    eight = Block([zigzag(8), zigzag(1, 10)], points(13))
    many = Block([zigzag(3, 5 * i) for i in range(20)], points(100))
    mixed = [Block(FLIPPED, points(8)), *blocks_of(2), eight]
    shuffled = [[(2, 1), (0, 2)], [(0, 1), (1, 1)]]
    blocks = [Block([zigzag(3)], points(5)), *blocks_of(1)]
    short = Plan(blocks, stored=True, runs=shuffled, record={"longest_run": 2})
    return {
        "boxes_triangle": ("stored boxes of one block: no nodes over blocks", Plan([TRIANGLE], stored=True)),
        "boxes_two_blocks": ("stored boxes of two blocks", Plan(blocks_of(2), stored=True)),
        "boxes_four_blocks": ("stored boxes of unlike blocks", Plan(mixed, stored=True)),
        "boxes_eight": ("a run of eight and one of one", Plan([eight], stored=True)),
        "boxes_many_runs": ("twenty runs, under inner nodes", Plan([many], stored=True)),
        "boxes_many_blocks": (
            "twelve blocks, under inner nodes over blocks",
            Plan(blocks_of(12), stored=True),
        ),
        "boxes_rebuilt_many_blocks": ("twelve blocks, nodes over blocks only", Plan(blocks_of(12))),
        "boxes_runs_in_any_order": ("runs of up to two, the last first", short),
        "boxes_no_long_run": ("a longest run that no run has", Plan([TRIANGLE], stored=True)),
        "boxes_limit": ("as many runs and triangles as a block may have", Plan([lonely(256)], stored=True)),
        "boxes_chain": ("a chain of nodes, one inner child each", _chain()),
        "boxes_gaps": ("empty slots between inner children and leaves", _gaps()),
        "boxes_far": ("the largest origins and shifts, boxes wider than need be", _far()),
        "boxes_finest_cell": ("cells of 2^-149", _finest()),
        "boxes_coarsest_cell": ("cells of 2^127, planes beyond any float", _coarsest()),
        "boxes_exact": ("a plane that holds by less than a float64 can tell", _exact(1.0)),
    }


def _chain() -> Plan:
    whole = ((0, 0, 0), (255, 255, 255))
    nodes = [Node([Slot(True, *whole)], base=i + 1) for i in range(11)]
    return Plan([TRIANGLE], stored=True, nodes=[*nodes, Node([Slot(False, *whole)])])


def _gaps() -> Plan:
    whole = ((0, 0, 0), (255, 255, 255))
    inner, leaf = Slot(True, *whole), Slot(False, *whole)
    nodes = [
        Node([None, leaf, None, inner, leaf, None, inner, leaf], base=1),
        Node([None, None, None, None, None, None, None, leaf], leaves=3 << 24),
        Node([leaf, None, leaf], leaves=4 << 24),
    ]
    return Plan([Block([zigzag(1, 3 * i) for i in range(6)], points(18))], stored=True, nodes=nodes)


def _far() -> Plan:
    far = Block([Strip([0, 1, 2])], [(100.0, 100.0, 100.0), (101.0, 100.0, 100.0), (100.0, 101.0, 100.0)])
    low, high = Slot(False, (0, 0, 0), (255, 255, 255)), Slot(False, (1, 1, 1), (2, 2, 2))
    nodes = [
        Node([low, low], shifts=(15, 14, 13)),
        Node([low], shifts=(15, 15, 15)),
        Node([high], leaves=1, origin=(65535, 65535, 65535), shifts=(15, 15, 15)),
    ]
    return Plan(
        [TRIANGLE, far], stored=True, nodes=nodes, record=dict.fromkeys(("cell_x", "cell_y", "cell_z"), -10)
    )


def _finest() -> Plan:
    block = Block([Strip([0, 1, 2])], [(TINY, 3 * TINY, 0.0), (255 * TINY, 0.0, TINY), (2 * TINY, TINY, 0.0)])
    nodes = [Node([Slot(False, (0, 0, 0), (254, 3, 1))])]
    return Plan([block], stored=True, nodes=nodes, record=dict.fromkeys(("cell_x", "cell_y", "cell_z"), -149))


def _coarsest() -> Plan:
    block = Block([Strip([0, 1, 2])], [(-BIG, -BIG, 0.0), (BIG, 0.0, 1.0), (0.0, BIG, 0.0)])
    nodes = [Node([Slot(False, (0, 0, 0), (255, 4, 1))], shifts=(15, 0, 0))]
    return Plan([block], stored=True, nodes=nodes, record=dict.fromkeys(("cell_x", "cell_y", "cell_z"), 127))


def _exact(low: float) -> Plan:
    """Positions from `low` to 2^127 in a box that ends 2^127 above `low`: too early where low is negative."""
    block = triangle((low, 2.0**127, 2.0))
    nodes = [Node([Slot(False, (0, 0, 0), (1, 1, 1))])]
    return Plan([block], stored=True, nodes=nodes, record={"cell_x": 127})


def _containers() -> dict[str, tuple[str, Plan]]:
    unknown = [("XTRA", 0, 0, b"anything"), ("\xff\0\n|", 0, 7, b"\0")]
    back = ("META", "RUNS", "RMAP", "NODE", "BLKD", "BLKH", "SCEN")
    odd = Plan(blocks_of(2), stored=True, remap=[(3, 0), (2, 1), (1, 2), (0, 0)], metadata={}, order=back)
    packed = dict.fromkeys(("BLKH", "BLKD", "NODE", "RUNS", "RMAP", "META"), frame)
    archive = Plan(blocks_of(2), stored=True, remap=odd.remap, metadata={"unit": "in"}, packed=packed)
    planed = dict.fromkeys(WIDTHS, 3)
    records = Plan(
        [*blocks_of(2), *limited(10)],
        stored=True,
        remap=[(13 - t, t % 3) for t in range(14)],
        packed={kind: lambda data, width=WIDTHS[kind]: frame(planes(data, width)) for kind in planed},
        codecs=planed,
    )
    full = Plan([TRIANGLE], extra=[(f"X{i:03}", 0, 0, b"x") for i in range(61)])
    return {
        "unknown_sections": ("sections that nobody knows and nobody needs", Plan([TRIANGLE], extra=unknown)),
        "sections_64": ("as many sections as there may be", full),
        "sections_backwards": ("the sections in another order", odd),
        "archive": ("sections of codec 1, their frames without compression", archive),
        "archive_windowed": ("a frame with a window and no length", _windowed()),
        "archive_planes": ("codec 3 where it may be", records),
        "archive_blocks": ("codec 2, with vertices that blocks share, named in each way", in_streams(SHARED)),
        "archive_blocks_flips": (
            "codec 2, one block of three with flip bits",
            in_streams(SHARED[:2] + WITH_FLIPS),
        ),
        "archive_blocks_modes": ("codec 2, vertices that blocks share in several modes", in_streams(MODES)),
        "archive_blocks_large": ("codec 2, 256 vertices and triangles", in_streams(limited(300))),
        "archive_blocks_first": ("codec 2, block data before block headers", _data_first()),
        "archive_blocks_told_twice": ("codec 2, a known vertex told as a new one", _told_twice()),
    }


UP, EAST = tuple(map(bits32, (0.0, 0.0, 1.0))), tuple(map(bits32, (1.0, 0.0, -0.0)))
NAN = 0x7FC00001
RED = {"name": "red", "base_color": [1, 0.0, 0, 1]}
GLASS = {"name": "", "base_color": [0.5, 0.5, 1e-3, 0], "group": "gl\u00e4s\u0001"}
PAIR = Plan(blocks_of(2))
"""Four triangles, eight block vertices."""
COLOURS = Values("COLR", 2, 1, [(1, 2, 3), (255, 0, 0), (9, 9, 9)], [0, 1, 1, 2])
GROUPS = Values("GRUP", 2, 3, [(1,), (0,)], [0, 0, 1, 0])


def _attributes() -> dict[str, tuple[str, Plan]]:
    shorts = [(i, 65535, 7 * i, 1) for i in range(4)]
    corners = [tuple(map(bits32, (i / 4, -i))) for i in range(12)]
    every = [
        Values("TEXC", 1, 0, [(NAN, 0x80000000), (0, 1), (NAN, 0)], [0, 1, 2, 1] * 3),
        Values("NORM", 0, 0, [UP, EAST], [0, 1] * 4),
        GROUPS,
        Values("COLR", 2, 2, shorts, None),
    ]
    packed = {"ATTR": frame, "MATL": frame}
    plans = {
        "of_vertices": Plan(
            PAIR.blocks, attributes=[Values("NORM", 0, 0, [UP, EAST], [0, 0, 1] * 2 + [0, 1])]
        ),
        "of_corners": Plan(PAIR.blocks, attributes=[Values("TEXC", 1, 0, corners, None)]),
        "of_triangles": Plan(PAIR.blocks, attributes=[COLOURS]),
        "of_one_row": Plan(PAIR.blocks, attributes=[Values("COLR", 0, 0, [UP], [0] * 8)]),
        "of_one_entry": Plan([TRIANGLE], attributes=[Values("COLR", 2, 1, [(1, 2, 3, 4)], None)]),
        "of_every_name": Plan(PAIR.blocks, attributes=every, materials=[RED, GLASS]),
        "packed": Plan(PAIR.blocks, attributes=every, materials=[RED, GLASS], packed=packed),
        "turned": Plan(
            [Block(FLIPPED, points(8))],
            attributes=[Values("TEXC", 1, 0, [(bits32(i), 0) for i in range(18)], None)],
            remap=[(i, i % 3) for i in range(6)],
        ),
    }
    return {f"attributes_{name}": ("values of its name", plan) for name, plan in plans.items()}


def _origins() -> dict[str, tuple[str, Plan]]:
    origin = {"flags": 4, "origin_x": 4.5e5, "origin_y": -5.5e6, "error_bound": 2.0**-20}
    tiny = {"flags": 4, "origin_z": -5e-324}
    return {
        "origin": ("positions about an origin", Plan([TRIANGLE], record=origin)),
        "origin_tiny": ("the smallest origin", Plan([TRIANGLE], record=tiny)),
    }


def in_streams(blocks: list[Block], change: Callable[[dict], object] = dict, **fields) -> Plan:
    """A plan whose block data have codec 2, its streams changed in place."""

    def pack(_: bytes) -> bytes:
        made = streams(blocks)
        change(made)
        return frame(content(made))

    return Plan(blocks, packed={"BLKD": pack}, codecs={"BLKD": 2}, **fields)


def _data_first() -> Plan:
    return in_streams(SHARED, order=("SCEN", "BLKD", "BLKH", "NODE"))


def _told_twice() -> Plan:
    block = triangle((0.0, 1.0, 2.0))

    def tell(made: dict) -> None:
        made["known"], made["places"] = [0] * 6, []
        for name in "xyz":
            made[name] *= 2

    return in_streams([block, block], tell)


def _windowed() -> Plan:
    def pack(data: bytes) -> bytes:
        return frame(data, descriptor=0, tail=b"")[:5] + bytes([0x88]) + frame(data, descriptor=0)[5:]

    return Plan([TRIANGLE], packed={"BLKD": pack})


def _sides() -> dict[str, tuple[str, Plan]]:
    made = {}
    for count in (1, 3, 4, 5):
        remap = [(2 * (count - t), (t + 2) % 3) for t in range(count)]
        plan = Plan(
            [Block([zigzag(count)], points(count + 2))], remap=remap, record={"source_face_count": 11}
        )
        made[f"remap_{count}"] = ("source faces and rotations", plan)
    made["remap_flips"] = (
        "rotations of flipped triangles",
        Plan([Block(FLIPPED, points(8))], remap=[(i, i % 3) for i in range(6)]),
    )
    texts = {
        "metadata": '{"generator": "by hand", "source": "\u00e4\U0001f600.ply", "unit": "mm", "x": [1]}',
        "metadata_empty": "{}",
        "metadata_deep": DEEP,
        "metadata_numbers": f'{{"huge": 1e999, "long": {"7" * 5000}, "minus": -0}}',
        "metadata_brackets": '{"' + "[" * 40 + '": "\\"{{{{{{{{{{{{{{{{{{{{{{{{{{{{{{{{{{\\\\"}',
    }
    about = "text, names and numbers that JSON allows"
    return made | {name: (about, Plan([TRIANGLE], metadata=text.encode())) for name, text in texts.items()}


# Invalid ones


IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
MIRROR = (-1.0, 0.0, 0.0, 9.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)
SHEAR = (2.0, 0.5, 0.0, 0.1, 0.0, 0.25, 0.0, -7.0, 0.0, 1.0, 3.0, 1e-300)


def _placed(**changes) -> Plan:
    """Two geometries, of two blocks and of one, in three instances."""
    blocks = blocks_of(3)
    given = {
        "nodes": plain_nodes(blocks[:2], None),
        "top": 1,
        "remap": [(0, 0), (1, 1), (3, 2), (2, 0), (5, 0), (6, 1)],
        "geometries": [(0, 0, 0, 4), (2, 1, 5, 2)],
        "instances": [(1, 0, IDENTITY), (0, 2, MIRROR), (1, 7, SHEAR)],
        "record": {"source_face_count": 8},
    }
    return Plan(blocks, **(given | changes))


def _instances() -> dict[str, tuple[str, Plan]]:
    blocks = blocks_of(4)
    low, high = Slot(False, (0, 0, 0), (255, 255, 255)), Slot(False, (0, 0, 0), (40, 9, 9))
    roots = [Node([high], leaves=i) for i in range(4)]
    stored = Plan(
        blocks,
        stored=True,
        nodes=[Node([low, high]), Node([low, high], leaves=2), *roots],
        top=2,
        geometries=[(0, 0, 0, 4), (2, 1, 4, 4)],
        instances=[(0, 0, MIRROR), (1, 100, SHEAR), (0, 104, IDENTITY), (0, 2**32 - 5, MIRROR)],
    )
    least = (5e-324, 0.0, 0.0, 0.0, 0.0, 5e-324, 0.0, 0.0, 0.0, 0.0, 5e-324, 0.0)
    far = (*IDENTITY[:3], 2.0**126, 2.0**124, *IDENTITY[5:])
    singles = Plan(
        blocks_of(2),
        nodes=[],
        top=0,
        geometries=[(0, 0, 0, 2), (1, 0, 2, 2)],
        instances=[(0, 0, IDENTITY), (1, 2, least), (0, 4, far)],
    )
    one = Plan([TRIANGLE], geometries=[(0, 0, 0, 1)], instances=[(0, 0, IDENTITY)])
    return {
        "instances": (
            "two geometries in three instances, a mirror, a shear, source faces left out",
            _placed(),
        ),
        "instances_stored": ("two trees over blocks and stored boxes", stored),
        "instances_of_blocks": ("geometries of one block, the least and the farthest matrix", singles),
        "instances_one": ("one geometry that stands where it is, no remap", one),
    }


def invalid_files() -> dict[str, tuple[str, list[str], bytes]]:
    """The invalid files by name, with what is wrong and the codes of the issues that a validator finds."""
    made: dict[str, tuple[str, list[str], bytes]] = {}
    for group in (_cut(), _headers(), _entries(), _needs(), _records(), _block_headers(), _block_data()):
        made |= group
    for group in (
        _coordinates(),
        _nodes(),
        _runs(),
        _remaps(),
        _metadata(),
        _packed(),
        _values(),
        _materials(),
        _geometries(),
        _other_hierarchies(),
        _trees_of_cells(),
        _presorted(),
        _plain(),
        _matrices(),
        _streams(),
    ):
        made |= group
    return made


def wrong(about: str, codes: str, plan: Plan, **changes) -> tuple[str, list[str], bytes]:
    """A row of `invalid_files`: a plan with changes."""
    return about, codes.split(), encode(replace(plan, **changes))


def flipped(bit: int) -> Callable[[bytes], bytes]:
    """A change of one bit."""
    return lambda data: patched(bit // 8, "B", data[bit // 8] ^ 1 << bit % 8)(data)


def patched(at: int, fmt: str, *values: int) -> Callable[[bytes], bytes]:
    """A change of the bytes from `at` on; a negative place counts from the end."""

    def change(data: bytes) -> bytes:
        start = at if at >= 0 else len(data) + at
        new = struct.pack(f"<{fmt}", *values)
        return data[:start] + new + data[start + len(new) :]

    return change


BASE = Plan(blocks_of(2), stored=True, remap=[(0, 0), (1, 1), (2, 2), (3, 0)], metadata={"unit": "m"})
ONE = Plan([TRIANGLE])
BOX = Plan([TRIANGLE], stored=True)


def _cut() -> dict[str, tuple[str, list[str], bytes]]:
    data = encode(BASE)
    ends = {0: "RDM101", 5: "RDM101", 8: "RDM101", 31: "RDM101"}
    made = {f"cut_{n}": ("cut inside the header", [code], data[:n]) for n, code in ends.items()}
    made["cut_in_table"] = ("cut inside the section table", ["RDM104", "RDM105"], data[:100])
    made["cut_after_table"] = ("cut behind the section table", ["RDM104", "RDM109"], data[:312])
    made["cut_in_section"] = ("cut inside a section", ["RDM104", "RDM109"], data[: len(data) // 2])
    made["cut_by_one"] = ("the last byte is missing", ["RDM104"], data[:-1])
    made["cut_by_64"] = ("the last 64 bytes are missing", ["RDM104", "RDM109"], data[:-64])
    made["longer_by_one"] = ("a byte more", ["RDM104"], data + b"\0")
    made["longer_by_64"] = ("64 zero bytes more", ["RDM104"], data + bytes(64))
    made["longer_by_junk"] = ("64 other bytes more", ["RDM104", "RDM108"], data + b"x" * 64)
    made["twice"] = ("the file twice", ["RDM104", "RDM108"], data + data)
    return made


def _headers() -> dict[str, tuple[str, list[str], bytes]]:
    text = encode(ONE).replace(b"\r\n", b"\n")
    return {
        "magic": wrong("another magic", "RDM102", ONE, header={"magic": b"\x89RDN\r\n\x1a\n"}),
        "magic_text_mode": ("line ends changed on the way", ["RDM102"], text),
        "other_file": ("a file of another kind", ["RDM102"], b"ply\nformat ascii 1.0\nend_header\n"),
        "major_1": wrong("a version to come", "RDM103", ONE, header={"major": 1}),
        "minor_5": wrong("a version to come", "RDM103", ONE, header={"minor": 5}),
        "minor_3": wrong("the version before", "RDM103", ONE, header={"minor": 3}),
        "minor_2": wrong("a version gone", "RDM103", ONE, header={"minor": 2}),
        "no_sections": wrong("no sections", "RDM105", ONE, header={"section_count": 0}),
        "sections_65": wrong(
            "one section too many", "RDM105", ONE, extra=[(f"X{i:03}", 0, 0, b"x") for i in range(62)]
        ),
        "sections_many": wrong(
            "a table longer than the file", "RDM105", ONE, header={"section_count": 2**32 - 1}
        ),
        "total_length": wrong(
            "a length that is not the file's", "RDM104", ONE, header={"total_length": 2**63}
        ),
        "header_reserved": wrong("the header's reserved field is set", "RDM107", ONE, header={"reserved": 1}),
        "header_checksum": wrong("another checksum", "RDM106", ONE, header={"checksum": 0}),
        "table_bit": wrong(
            "a checksum of the table changed", "RDM106 RDM118", ONE, edit=patched(32 + 36, "I", 0)
        ),
    }


def _entries() -> dict[str, tuple[str, list[str], bytes]]:
    def entry(about: str, codes: str, kind: str, plan: Plan = BASE, **fields) -> tuple[str, list[str], bytes]:
        return wrong(about, codes, plan, entries={kind: fields})

    raw = entry("a raw section of two lengths", "RDM118 RDM902", "META", raw_length=2**40)
    return {
        "flag_reserved": entry("a reserved flag", "RDM107", "META", flags=2),
        "flag_missing": entry(
            "a section that must be understood says that it need not", "RDM116", "BLKH", flags=0
        ),
        "flag_too_many": entry(
            "a section that need not be understood says that it must", "RDM116", "RMAP", flags=1
        ),
        "raw_lengths": (raw[0], ["RDM118", "RDM902"], raw[2]),
        "raw_checksums": entry("a raw section of two checksums", "RDM118", "META", raw_checksum=0),
        "stored_checksum": entry("a checksum that does not fit", "RDM110 RDM118", "BLKD", stored_checksum=0),
        "section_bit": wrong("a bit of a section flipped", "RDM110", BASE, edit=_flip_metadata),
        "no_length": entry("a section of no bytes", "RDM109", "META", stored_length=0),
        "no_raw_length": entry("a section of no decoded bytes", "RDM109", "META", raw_length=0),
        "offset_early": entry("a section over the table", "RDM109", "SCEN", offset=0),
        "offset_late": entry("a hole between sections", "RDM109", "BLKH", offset=512 + 64),
        "offset_huge": entry("an offset near 2^64", "RDM109", "BLKH", offset=2**64 - 64),
        "length_huge": entry("a length near 2^64", "RDM109", "META", stored_length=2**64 - 1),
        "overlap": entry("a section within another one", "RDM109", "RMAP", stored_length=200, raw_length=200),
        "padding": wrong("padding is not zero", "RDM108", ONE, padding=1),
        "kind_twice": wrong("one kind twice", "RDM112", ONE, extra=[("META", 0, 0, b"{}")] * 2),
        "kind_unknown_twice": wrong(
            "one unknown kind twice", "RDM112", ONE, extra=[("XTRA", 0, 0, b"x")] * 2
        ),
        "unknown_needed": wrong(
            "an unknown section must be understood", "RDM111", ONE, extra=[("XTRA", 1, 0, b"x")]
        ),
        "unknown_checksum": wrong(
            "an unknown section is damaged",
            "RDM110 RDM118",
            ONE,
            extra=[("XTRA", 0, 0, b"x")],
            entries={"XTRA": {"stored_checksum": 1}},
        ),
        "unknown_reserved": wrong(
            "a reserved flag of an unknown section", "RDM107", ONE, extra=[("XTRA", 4, 0, b"x")]
        ),
    }


def _flip_metadata(data: bytes) -> bytes:
    at = data.rindex(b"unit")
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


def _needs() -> dict[str, tuple[str, list[str], bytes]]:
    made = {
        f"no_{kind.lower()}": wrong(f"{kind} is missing", "RDM113", BASE, drop=(kind,))
        for kind in ("SCEN", "BLKH", "BLKD", "NODE", "RUNS")
    }
    for kind, extra in (("SCEN", 1), ("BLKH", 32), ("NODE", 64), ("RUNS", 2), ("RMAP", 1)):
        longer = {kind: lambda data, extra=extra: data + bytes(extra)}
        made[f"long_{kind.lower()}"] = wrong(f"{kind} is too long", "RDM114", BASE, payloads=longer)
    more = {"BLKD": lambda data: data + bytes(64)}
    made["long_blkd"] = wrong("BLKD has more zero bytes than it may", "RDM606", BASE, payloads=more)
    less = {"BLKD": lambda data: data[:-64]}
    made["short_blkd"] = wrong(
        "BLKD has fewer zero bytes than it must", "RDM606", limited(512) and LONG, payloads=less
    )
    cut = {"BLKD": lambda data: data[:64]}
    made["cut_blkd"] = wrong("BLKD ends inside a block", "RDM606", LONG, payloads=cut)
    odd = {"BLKD": lambda data: data[:-1]}
    made["odd_blkd"] = wrong("BLKD is no whole words long", "RDM606", ONE, payloads=odd)
    runs = {"RUNS": lambda _: bytes(6)}
    made["runs_not_needed"] = wrong("runs where boxes are not stored", "RDM117", ONE, payloads=runs)
    nodes = {"NODE": lambda _: bytes(64)}
    made["nodes_not_needed"] = wrong("a node that the counts do not have", "RDM117", ONE, payloads=nodes)
    blocks = {"BLKH": lambda _: bytes(32)}
    made["empty_with_blocks"] = wrong("an empty scene with a block", "RDM117", Plan([]), payloads=blocks)
    remap = {"RMAP": lambda _: b"\0"}
    made["empty_with_remap"] = wrong("an empty scene with a remap", "RDM117", Plan([]), payloads=remap)
    return made


LONG = Plan(limited(256))


def _records() -> dict[str, tuple[str, list[str], bytes]]:
    def field(about: str, codes: str, plan: Plan = BASE, **fields) -> tuple[str, list[str], bytes]:
        return wrong(about, codes, plan, record=fields)

    nan = float("nan")
    return {
        "triangle_count": field(
            "more triangles than the blocks have", "RDM201", ONE, triangle_count=2, source_face_count=9
        ),
        "triangles_none": field("no triangles, and blocks", "RDM201 RDM208", ONE, triangle_count=0),
        "triangles_huge": field(
            "2^32 - 1 triangles", "RDM201", ONE, triangle_count=2**32 - 1, source_face_count=2**32 - 1
        ),
        "block_count": field(
            "more blocks than there are", "RDM114 RDM201", ONE, block_count=2, triangle_count=2
        ),
        "blocks_huge": field("2^32 - 1 blocks", "RDM114 RDM201", ONE, block_count=2**32 - 1),
        "node_count": field("fewer nodes than blocks need", "RDM114 RDM201", node_count=2),
        "nodes_huge": field("2^32 - 1 nodes", "RDM113 RDM201", ONE, node_count=2**32 - 1),
        "top_none": field("two blocks and no node over them", "RDM201", Plan(blocks_of(2)), top_count=0),
        "top_of_one": field("one block and a node over it", "RDM201", BOX, top_count=1),
        "top_too_many": field("more nodes over blocks than nodes", "RDM201", top_count=9),
        "run_count": field("fewer runs than blocks", "RDM114 RDM201", run_count=1),
        "runs_without_boxes": field("runs and no stored boxes", "RDM201", ONE, run_count=1),
        "source_faces": field("fewer source faces than triangles", "RDM201", ONE, source_face_count=0),
        "flags": field("a reserved flag", "RDM107", ONE, flags=8),
        "reserved": field("a reserved byte", "RDM107", ONE, reserved=1),
        "reserved_2": field("a reserved word", "RDM107", ONE, reserved_2=1 << 31),
        "origin_without": field("an origin and no flag", "RDM209", ONE, origin_x=1.0),
        "origin_minus_zero": field("-0.0 where there is no origin", "RDM209", ONE, origin_z=-0.0),
        "origin_zero": field("an origin of zero", "RDM209", ONE, flags=4, origin_y=-0.0),
        "origin_nan": field("an origin that is no number", "RDM209", ONE, flags=4, origin_y=nan),
        "origin_infinite": field("an origin far away", "RDM209", ONE, flags=4, origin_x=float("inf")),
        "grid_without": field("a grid exponent and no grid", "RDM203", ONE, grid_exponent=1),
        "grid_low": field("a grid finer than any", "RDM203", Plan([TRIANGLE], grid=0), grid_exponent=-150),
        "grid_high": field("a grid coarser than any", "RDM203", Plan([TRIANGLE], grid=0), grid_exponent=105),
        "grid_off": field(
            "a coordinate between the cells", "RDM204", Plan([triangle((0.0, 1.0, 0.5))], grid=0)
        ),
        "error_negative": field("a negative bound", "RDM202", ONE, error_bound=-1.0),
        "error_nan": field("a bound that is no number", "RDM202", ONE, error_bound=nan),
        "error_infinite": field("a bound without end", "RDM202", ONE, error_bound=float("inf")),
        "low": field("low is not the least coordinate", "RDM205", ONE, low_x=-1.0),
        "low_minus_zero": field("low is written as -0.0", "RDM205", ONE, low_y=-0.0),
        "high": field("high is not the largest coordinate", "RDM205", ONE, high_z=0.5),
        "high_nan": field("high is no number", "RDM205", ONE, high_z=nan),
        "low_signalling_nan": wrong(
            "low is a signalling NaN", "RDM205", BOX, payloads={"SCEN": patched(44, "I", 0x7F800001)}
        ),
        "cell_low": field("cells finer than any", "RDM206", ONE, cell_x=-150),
        "cell_high": field("cells coarser than any", "RDM206", ONE, cell_z=128),
        "longest_none": field("stored boxes and no longest run", "RDM207 RDM802", BOX, longest_run=0),
        "longest_nine": field("a longest run of nine", "RDM207", BOX, longest_run=9),
        "longest_without": field("a longest run and no stored boxes", "RDM207", ONE, longest_run=8),
        "empty_stored": field("an empty scene with stored boxes", "RDM208", Plan([]), flags=1, longest_run=1),
        "empty_origin": field("an empty scene with an origin", "RDM208", Plan([]), flags=4, origin_x=1.0),
        "empty_bounds": field("an empty scene with bounds", "RDM208", Plan([]), high_z=-0.0),
        "empty_cell": field("an empty scene with cells", "RDM208", Plan([]), cell_y=1),
        "empty_nodes": field("an empty scene with nodes", "RDM113 RDM201", Plan([]), node_count=1),
    }


def _block_headers() -> dict[str, tuple[str, list[str], bytes]]:
    def header(about: str, codes: str, **fields) -> tuple[str, list[str], bytes]:
        blocks = [replace(TRIANGLE, header=fields), *blocks_of(1)]
        return wrong(about, codes, Plan(blocks))

    wide = Block([Strip([0, 1, 2])], TRIANGLE.points, (Axis(0, 33), None, None))
    minus = Block([Strip([0, 1, 2])], [(0.0, 0.0, 0.0)] * 3, (Axis(0, 0, 1), None, None))
    later = [TRIANGLE, replace(blocks_of(1)[0], header={"first_triangle": 2})]
    gap = [TRIANGLE, replace(blocks_of(1)[0], header={"word": 0})]
    beyond = [TRIANGLE, replace(blocks_of(1)[0], header={"word": 2**32 - 1})]
    many = header(
        "vertices without bits, more than indices", "RDM613", vertices=255, axis_x=0, axis_y=0, axis_z=0
    )
    return {
        "first_triangle": header("the first block begins at triangle 1", "RDM601", first_triangle=1),
        "first_triangle_later": wrong("a block begins one triangle late", "RDM601", Plan(later)),
        "word": header("the first block begins at word 1", "RDM602", word=1),
        "word_again": wrong("a block begins where another one does", "RDM602", Plan(gap)),
        "word_beyond": wrong("a block begins behind the data", "RDM602", Plan(beyond)),
        "block_triangles": header(
            "a block says that it has one triangle more", "RDM201 RDM601 RDM612 RDM614", triangles=1
        ),
        "block_vertices_two": header("a block of two vertices", "RDM603 RDM605", vertices=1),
        "block_strips": header("more strips than triangles", "RDM603", strips=1),
        "block_vertices_many": many,
        "block_flags": header("a reserved flag of a block", "RDM107", flags=2),
        "block_reserved": header("a reserved field of a block", "RDM107", reserved=0x8000),
        # Found by the fuzzer, likewise.
        "word_and_length": wrong(
            "a block begins where another one does, and zero words are missing",
            "RDM602 RDM606",
            Plan(gap),
            payloads={"BLKD": lambda data: data[:-64]},
        ),
        "axis_width": wrong("a width of 33 bits", "RDM604", Plan([wide])),
        "axis_mode": header("mode 3", "RDM604", axis_y=2 | 3 << 6),
        "axis_mode_1": wrong("mode 1 without a bit", "RDM604", Plan([minus])),
        "axis_exponent": header("an exponent in mode 2", "RDM604", axis_x=2 | 2 << 6, exponent_x=1),
    }


def _block_data() -> dict[str, tuple[str, list[str], bytes]]:
    two = Strip([0, 1, 2, 3], "1")

    def part(
        about: str, codes: str, strips: list[Strip], count: int = 4, **parts
    ) -> tuple[str, list[str], bytes]:
        return wrong(about, codes, Plan([Block(strips, points(count), parts=parts)]))

    flip = [Strip([0, 1, 2, 3], "1", "0")]
    long = [Strip(list(range(34)), "0" * 31)]
    late = [Strip(list(range(36)), "10" + "1" * 31)]
    return {
        "no_start": part(
            "no strip begins at the first triangle", "RDM607", [Strip([0, 1, 2, 3], "0")], starts=[0, 1]
        ),
        "starts_too_many": part(
            "more start bits than strips", "RDM607", [Strip([0, 1, 2, 3], "0")], starts=[1, 1]
        ),
        "starts_too_few": part(
            "fewer start bits than strips", "RDM607", [Strip([0, 1, 2]), Strip([2, 1, 3])], starts=[1, 0]
        ),
        "first_turn": part("the first triangle of a strip turns", "RDM608", [two], turns=[1, 0]),
        "first_flip": part("the first triangle of a strip is flipped", "RDM608", flip, flips=[1, 0]),
        "no_flip": part("flip bits, and none is set", "RDM609", flip),
        "turns_equal_31": part("31 equal turn bits in a row", "RDM610", long, 34),
        "turns_equal_31_late": part("31 equal turn bits after others", "RDM610", late, 36),
        "index_too_large": part(
            "an index that names no vertex", "RDM611 RDM612 RDM613", [zigzag(4)], 6, index=[0, 1, 2, 3, 4, 6]
        ),
        "index_order": part("indices out of order", "RDM612", [two], index=[0, 2, 1, 3]),
        "index_first": part("the first index is not 0", "RDM612", [two], index=[1, 0, 2, 3]),
        "index_unused": part("a vertex that is not used", "RDM613", [two], index=[0, 1, 2, 1]),
        "triangle_twice": part("a triangle names one vertex twice", "RDM614", [Strip([0, 1, 2, 2], "0")], 3),
        "triangle_first_twice": part(
            "a strip's first triangle names one vertex twice",
            "RDM614",
            [Strip([0, 1, 1]), Strip([1, 0, 2])],
            3,
        ),
        "unused_bit": wrong("an unused bit of a block", "RDM605", Plan([replace(TRIANGLE, tail=1)])),
        "unused_word": wrong(
            "a word behind the last block", "RDM605", ONE, payloads={"BLKD": patched(-1, "B", 128)}
        ),
        "unused_first_word": wrong(
            "the first word behind the last block", "RDM605", ONE, payloads={"BLKD": patched(4, "I", 1)}
        ),
    }


def _coordinates() -> dict[str, tuple[str, list[str], bytes]]:
    def bad(about: str, axis: Axis, *numbers: int) -> tuple[str, list[str], bytes]:
        rows = [[u, 0, 0] for u in numbers]
        points = [(0.0, 0.0, 0.0)] * 3
        return wrong(
            about,
            "RDM615",
            Plan([Block([Strip([0, 1, 2])], points, (axis, FLAT, FLAT), parts={"numbers": rows})]),
        )

    return {
        "number_2_31": bad("A + u is 2^31", Axis(1, 31), 0, 1, 2**31 - 1),
        "number_minus_2_31": bad("A + u is -2^31", Axis(-(2**31), 8), 0, 128, 128),
        "number_25_bits": bad("25 bits that a float32 does not hold", Axis(0, 25), 0, 1, 2**24 + 1),
        "number_infinite": bad("a product of 2^128", Axis(0, 23, 0, 255), 0, 1, 2**22),
        "number_minus_infinite": bad("a product of -2^128", Axis(-(2**24), 1, 0, 253), 1, 1, 0),
        "mode_2_infinite": bad("the bits of infinity", Axis(0x7F7FFFFF, 1, 2, 0), 0, 0, 1),
        "mode_2_minus_infinite": bad("the bits of minus infinity", Axis(-0x7F800001, 1, 2, 0), 1, 1, 0),
        "mode_2_nan": bad("the bits of no number", Axis(0x7FFFFFFF, 32, 2, 0), 0, 2**32 - 1, 0),
        "mode_1_number": bad("mode 1 with a number that no float32 is", Axis(2**24, 2, 1), 0, 1, 3),
    }


def _nodes() -> dict[str, tuple[str, list[str], bytes]]:
    whole = ((0, 0, 0), (255, 255, 255))
    inner, leaf = Slot(True, *whole), Slot(False, *whole)
    three = Plan([Block([zigzag(1, 3 * i) for i in range(3)], points(9))], stored=True)
    pair = Plan(blocks_of(2), stored=True)

    def of(
        about: str, codes: str, plan: Plan, *nodes: Node, top: int | None = None
    ) -> tuple[str, list[str], bytes]:
        return wrong(about, codes, plan, nodes=list(nodes), top=plan.top if top is None else top)

    good = Node([leaf] * 3)
    roots = (Node([leaf]), Node([leaf], leaves=1))
    made = {
        "child_beyond": of(
            "an inner child behind the last node", "RDM701", three, Node([leaf, leaf, leaf, inner], base=9)
        ),
        "child_itself": of("a node that is its own child", "RDM701", three, Node([leaf, leaf, leaf, inner])),
        "child_before": of(
            "a child before its parent",
            "RDM701",
            three,
            Node([inner, leaf], base=1),
            Node([inner, leaf, leaf], leaves=1 << 24),
        ),
        "child_twice": of(
            "one child of two slots",
            "RDM702",
            three,
            Node([inner, inner], base=1),
            Node([inner, leaf], base=2),
            Node([leaf, leaf], leaves=1 << 24),
        ),
        "child_lost": of("a node that no slot names", "RDM702", three, good, Node([leaf])),
        "top_child": of(
            "a node over blocks with a child that is none",
            "RDM701",
            pair,
            Node([leaf, leaf, inner], base=1),
            *roots,
        ),
        "root_child": of(
            "a block's root with another root as its child",
            "RDM701",
            pair,
            Node([leaf, leaf]),
            Node([leaf, inner], base=2),
            roots[1],
        ),
        "block_beyond": of("a leaf that is no block", "RDM703", pair, Node([leaf, leaf, leaf]), *roots),
        "block_twice": of(
            "one block of two slots",
            "RDM703",
            pair,
            Node([leaf, leaf, inner], base=1),
            Node([leaf]),
            *roots,
            top=2,
        ),
        "block_lost": of("a block that no slot names", "RDM703", pair, Node([leaf]), *roots),
        "run_beyond": of("a leaf that is no run", "RDM704", three, Node([leaf] * 4)),
        "run_twice": of(
            "one run of two slots", "RDM704", three, Node([leaf, leaf, leaf, inner], base=1), Node([leaf])
        ),
        "run_lost": of("a run that no slot names", "RDM704", three, Node([leaf, leaf])),
        "run_of_another_block": of(
            "a leaf in another block", "RDM704", pair, Node([leaf, leaf]), roots[0], roots[0]
        ),
        "run_of_no_block": of("a leaf in no block", "RDM704", three, Node([leaf] * 3, leaves=7)),
        "box_inverted": of(
            "a box inside out", "RDM705", three, Node([Slot(False, (9, 0, 0), (8, 255, 255)), leaf, leaf])
        ),
        "box_half_empty": of(
            "a slot that is empty on two axes",
            "RDM704 RDM705",
            three,
            Node([leaf] * 3 + [Slot(False, (1, 1, 0), (0, 0, 0))]),
        ),
        "box_inner_empty": of(
            "an inner child with the box of an empty slot",
            "RDM705",
            three,
            Node([leaf, leaf, Slot(True, (1, 1, 1), (0, 0, 0))], base=1),
            Node([leaf], leaves=2 << 24),
        ),
        "base_without": of("a first child and no child", "RDM706", three, good._replace(base=1)),
        "leaves_without": of(
            "a first leaf and no leaf", "RDM706", three, Node([inner], base=1, leaves=1 << 24), good
        ),
        "node_without": of(
            "a node without a child", "RDM708", three, Node([leaf, leaf, leaf, inner], base=1), Node([])
        ),
        "top_marks": wrong(
            "a node over blocks that says too few leaves",
            "RDM709",
            pair,
            payloads={"NODE": patched(7, "B", 1)},
        ),
        "top_marks_too_many": wrong(
            "a node over blocks that says too many leaves",
            "RDM709",
            pair,
            payloads={"NODE": patched(7, "B", 7)},
        ),
        "box_exact": ("a plane that leaks by less than a float64 can tell", ["RDM707"], encode(_exact(-1.0))),
    }
    return made | _leaks(pair)


def _leaks(plan: Plan) -> dict[str, tuple[str, list[str], bytes]]:
    """Each plane of a box moved in by one cell, in a leaf, over a block, and over an inner node."""
    made = {}
    nodes = plan.nodes or []
    for side, axis in product(range(2), range(3)):
        slot = nodes[1].slots[0]
        planes = [list(slot.low), list(slot.high)]
        planes[side][axis] += 1 - 2 * side
        tight = nodes[1]._replace(slots=[Slot(False, tuple(planes[0]), tuple(planes[1]))])
        name = f"leak_{('low', 'high')[side]}_{'xyz'[axis]}"
        about = "a box that leaks by one cell"
        made[name] = wrong(about, "RDM707", plan, nodes=[nodes[0], tight, nodes[2]])
    over = nodes[0]._replace(slots=[nodes[0].slots[0], nodes[0].slots[1]._replace(high=(3, 1, 4))])
    made["leak_over_block"] = wrong("a box over a block that leaks", "RDM707", plan, nodes=[over, *nodes[1:]])
    chain = _chain()
    slots = [Slot(True, (0, 0, 0), (2, 2, 1))]
    links = [chain.nodes[0]._replace(slots=slots), *chain.nodes[1:]]
    made["leak_over_chain"] = wrong("a box over a chain of nodes that leaks", "RDM707", chain, nodes=links)
    return made


def _runs() -> dict[str, tuple[str, list[str], bytes]]:
    pair = Plan([Block([zigzag(2), zigzag(2, 4)], points(8)), *blocks_of(1)], stored=True)
    plain = [list(here) for here in pair.runs or []]

    def of(about: str, codes: str, *first: tuple[int, int], **changes) -> tuple[str, list[str], bytes]:
        return wrong(about, codes, pair, runs=[list(first), plain[1]], nodes=pair.nodes, **changes)

    falling = {"RUNS": patched(0, "2I", 0, 9)}
    return {
        "runs_start": of(
            "the runs of the first block begin at 1",
            "RDM801",
            *plain[0],
            payloads={"RUNS": patched(0, "I", 1)},
        ),
        "runs_beyond": of("the runs of a block begin behind the last", "RDM801", *plain[0], payloads=falling),
        "runs_padding": of(
            "a byte between the numbers of runs and the runs",
            "RDM108",
            *plain[0],
            payloads={"RUNS": patched(63, "B", 1)},
        ),
        **{
            name: of(about, "RDM804", *plain[0], payloads={"RUNS": flipped(8 * 64 + bit)})
            for name, bit, about in (
                ("run_strip", 11, "a run in another strip than it says"),
                ("run_turn", 20, "a run with another turn than it says"),
                ("run_turn_beyond", 26, "a run with the turn of a triangle that it does not have"),
                ("run_before", 27, "a run with other triangles of its turn before it than it says"),
            )
        },
        "run_over_strips": of("a run over two strips", "RDM707 RDM802", (0, 3), (3, 1)),
        "run_over_blocks": of("a run that ends behind its block", "RDM802", (0, 2), (2, 3)),
        "run_too_long": of("a run longer than the longest", "RDM802", *plain[0], record={"longest_run": 1}),
        "run_overlap": of("a triangle in two runs", "RDM803", (0, 2), (1, 1)),
        # Found by the fuzzer: a validator that stops at the runs does not see what the nodes make of them.
        "run_gap_and_lost": wrong(
            "a triangle in no run, and a run that no slot names",
            "RDM704 RDM803",
            pair,
            runs=[[(0, 2), (2, 1)], plain[1]],
            nodes=[pair.nodes[0], pair.nodes[1]._replace(slots=pair.nodes[1].slots[:1]), pair.nodes[2]],
        ),
        "run_gap": of("a triangle in no run", "RDM803", (0, 2), (2, 1)),
    }


def _remaps() -> dict[str, tuple[str, list[str], bytes]]:
    strip = Plan([Block([zigzag(5)], points(7))])
    plain = [(i, 0) for i in range(5)]
    return {
        "rotation": wrong("a rotation of 3", "RDM501", strip, remap=[*plain[:4], (4, 3)]),
        "remap_beyond": wrong(
            "a face that the source does not have", "RDM502", strip, remap=[*plain[:4], (5, 0)]
        ),
        "remap_twice": wrong("a face twice", "RDM503", strip, remap=[*plain[:4], (3, 0)]),
        "remap_unused": wrong(
            "an unused bit", "RDM504", strip, remap=plain, payloads={"RMAP": patched(-1, "B", 4)}
        ),
        "remap_short": wrong(
            "a remap without rotations", "RDM114", strip, remap=plain, payloads={"RMAP": lambda d: d[:20]}
        ),
    }


def _metadata() -> dict[str, tuple[str, list[str], bytes]]:
    texts = {
        "bytes": (b'{"a": "\xff"}', "RDM901"),
        "mark": (b"\xef\xbb\xbf{}", "RDM901"),
        "array": (b"[]", "RDM901"),
        "words": (b"hello", "RDM901"),
        "nan": (b'{"a": NaN}', "RDM901"),
        "cut": (b'{"a": "b', "RDM901"),
        "twice": (b"{}{}", "RDM901"),
        "unit": (b'{"unit": 1}', "RDM903"),
        "names": (b'{"generator": null, "source": []}', "RDM903"),
        "deep": (DEEP.replace("a", "b").replace(": ", ": [").replace("}", "]}").encode(), "RDM904"),
        "very_deep": (b"[" * 2000, "RDM904"),
    }
    about = "metadata that are not what they must be"
    return {
        f"metadata_{name}": wrong(about, codes, ONE, metadata=text) for name, (text, codes) in texts.items()
    }


def _values() -> dict[str, tuple[str, list[str], bytes]]:
    def of(about: str, codes: str, *values: Values, **changes) -> tuple[str, list[str], bytes]:
        return wrong(about, codes, PAIR, attributes=list(values), **changes)

    def spoiled(about: str, codes: str, **fields) -> tuple[str, list[str], bytes]:
        return of(about, codes, COLOURS._replace(record=fields))

    def changed(about: str, codes: str, change: Callable[[bytes], bytes]) -> tuple[str, list[str], bytes]:
        return of(about, codes, COLOURS, payloads={"ATTR": change})

    two = {"materials": [RED, GLASS]}
    many = Plan(blocks_of(1), attributes=[COLOURS._replace(index=[0, 1])])
    return {
        "values_name": spoiled("an unknown name", "RDM521", name=b"TANG"),
        "values_twice": of("a name twice", "RDM521", COLOURS, COLOURS),
        "values_domain": spoiled("an unknown domain", "RDM521", domain=3),
        "values_type": spoiled("a type that it cannot have", "RDM521", type=3),
        "values_type_unknown": spoiled("an unknown type", "RDM521", type=4),
        "values_components": spoiled("too few components", "RDM521", components=2),
        "values_group_domain": of(
            "groups of corners", "RDM521", GROUPS._replace(record={"domain": 1}), **two
        ),
        "values_reserved": spoiled("a reserved word", "RDM107", reserved=1),
        "values_head": changed("a reserved word before the records", "RDM107", patched(4, "I", 1)),
        "values_none": changed("no attribute", "RDM521", patched(0, "I", 0)),
        "values_five": changed("more attributes than there are names", "RDM521", patched(0, "I", 5)),
        "values_four": changed(
            "records behind the end", "RDM522", lambda data: struct.pack("<I", 4) + data[4:24]
        ),
        "values_short_head": changed("the end before the records", "RDM522", lambda data: data[:7]),
        "values_short": changed("four bytes too few", "RDM522", lambda data: data[:-4]),
        "values_long": changed("four bytes too many", "RDM522", lambda data: data + bytes(4)),
        "values_too_long": changed(
            "more bytes than there may be", "RDM114", lambda data: data.ljust(1281, b"\0")
        ),
        "values_width": spoiled("wider than it needs to be", "RDM523", width=3),
        "values_width_none": spoiled("no width and several rows", "RDM523", width=0),
        "values_rows_none": spoiled("no rows", "RDM523", rows=0),
        "values_rows_many": spoiled("more rows than entries", "RDM523", rows=2**32 - 1),
        "values_beyond": of(
            "an index without a row",
            "RDM524",
            COLOURS._replace(index=[0, 1, 2, 3])._replace(rows=COLOURS.rows, record={"width": 2}),
        ),
        "values_order": of("rows out of order", "RDM525", COLOURS._replace(index=[0, 2, 1, 1])),
        "values_first": of("not the first row first", "RDM525", COLOURS._replace(index=[1, 0, 1, 2])),
        "values_unused": of("a row that nothing has", "RDM525", COLOURS._replace(index=[0, 1, 1, 0])),
        "values_equal": of("a row twice", "RDM526", COLOURS._replace(rows=[(1, 2, 3), (0, 0, 0), (1, 2, 3)])),
        "values_filler": of("an unused byte behind the rows", "RDM527", COLOURS._replace(filler=1)),
        "values_of_a_huge_count": of(
            "a row for four thousand million triangles that are not there",
            "RDM201",
            Values("COLR", 2, 1, [(1, 2, 3)], [0] * 4),
            record={"triangle_count": 2**32 - 65536, "source_face_count": 2**32 - 1},
        ),
        "values_tail": of("an unused bit behind the indices", "RDM527", COLOURS._replace(tail=1 << 23)),
        "values_empty": wrong(
            "an empty scene with values", "RDM117", Plan([]), payloads={"ATTR": lambda _: b"x"}
        ),
        "values_packed": wrong("a frame cut short", "RDM121", many, packed={"ATTR": lambda d: frame(d)[:-1]}),
        "groups_beyond": of("a group without a material", "RDM528", GROUPS, materials=[RED]),
        "groups_huge": of("a group of 2^31", "RDM528", GROUPS._replace(rows=[(1,), (2**31,)]), **two),
        "groups_alone": of("groups and no materials", "RDM113", GROUPS),
    }


def _geometries() -> dict[str, tuple[str, list[str], bytes]]:
    def of(about: str, codes: str, *rows: tuple[int, int, int, int]) -> tuple[str, list[str], bytes]:
        return about, codes.split(), encode(_placed(geometries=list(rows)))

    first, second = (0, 0, 0, 4), (2, 1, 5, 2)
    empty = {"GEOM": lambda _: bytes(16), "INST": lambda _: bytes(104)}
    foreign = [(0, 0), (1, 1), (5, 2), (2, 0), (3, 0), (6, 1)]
    twins = Plan(
        blocks_of(4),
        nodes=[Node([Slot(False, (0, 0, 0), (40, 9, 9))] * 2, leaves=i) for i in (0, 1)],
        top=2,
        geometries=[(0, 0, 0, 4), (2, 1, 4, 4)],
        instances=[(0, 0, IDENTITY), (1, 4, IDENTITY)],
    )
    inner = Slot(True, (0, 0, 0), (40, 9, 9))
    across = [Node([Slot(False, (0, 0, 0), (40, 9, 9)), inner], base=1), Node(twins.nodes[1].slots, leaves=2)]
    return {
        "geometry_first_block": of("the first does not begin at block 0", "RDM541", (1, 0, 0, 4), second),
        "geometry_first_top": of("the first does not begin at node 0", "RDM541", (0, 1, 0, 4), second),
        "geometry_order": of("blocks out of their order", "RDM541", (0, 0, 0, 4), (0, 1, 5, 2)),
        "geometry_beyond": of("blocks behind the last", "RDM541", first, (3, 1, 5, 2)),
        "geometry_tops": of(
            "a geometry of two blocks without a node over them", "RDM541", first, (2, 0, 5, 2)
        ),
        "geometry_tops_many": of("more nodes over blocks than there are", "RDM541", first, (2, 2, 5, 2)),
        "geometry_faces_few": of("fewer source faces than triangles", "RDM542 RDM543", (0, 0, 0, 3), second),
        "geometry_faces_shared": of("source faces of two geometries", "RDM542 RDM554", (0, 0, 0, 6), second),
        "geometry_faces_beyond": of("source faces that are not there", "RDM542 RDM554", first, (2, 1, 5, 4)),
        "geometry_foreign": wrong("a triangle of another's faces", "RDM543", _placed(), remap=foreign),
        "geometry_cut": wrong("half a record", "RDM114", _placed(), payloads={"GEOM": lambda d: d[:-8]}),
        "geometry_alone": wrong("no instances", "RDM113", _placed(), drop=("INST",)),
        "geometry_none": wrong("no geometries", "RDM113 RDM703", _placed(), drop=("GEOM",)),
        "geometry_many": wrong(
            "more geometries than blocks", "RDM114", _placed(), payloads={"GEOM": lambda d: d + bytes(32)}
        ),
        "geometry_empty": wrong("of an empty scene", "RDM117", Plan([]), payloads=empty),
        "geometry_flag": wrong("need not be understood", "RDM116", _placed(), entries={"GEOM": {"flags": 0}}),
        "geometry_child": wrong(
            "a node of another geometry as a child", "RDM701 RDM703", twins, nodes=across
        ),
        "geometry_block": wrong("a block of another geometry", "RDM703", twins),
    }


def _matrices() -> dict[str, tuple[str, list[str], bytes]]:
    def of(about: str, codes: str, *rows: tuple[int, int, tuple]) -> tuple[str, list[str], bytes]:
        return about, codes.split(), encode(_placed(instances=list(rows)))

    def by(about: str, codes: str, matrix: tuple[float, ...]) -> tuple[str, list[str], bytes]:
        return of(about, codes, (1, 0, IDENTITY), (0, 2, matrix))

    inf, nan, huge = float("inf"), float("nan"), 1.5 * 2.0**126
    flat = (0.1, 0.2, 0.3, 0.0, 0.2, 0.4, 0.6, 0.0, 0.0, 0.0, 1.0, 0.0)
    packed = {"INST": frame}
    return {
        "instance_geometry": of("a geometry that is not there", "RDM551", (1, 0, IDENTITY), (2, 2, IDENTITY)),
        "instance_none": of("a geometry without an instance", "RDM551", (1, 0, IDENTITY), (1, 2, MIRROR)),
        "instance_nan": by("a matrix that is no number", "RDM552", (nan, *IDENTITY[1:])),
        "instance_infinite": by("a place infinitely far", "RDM552", (*IDENTITY[:3], inf, *IDENTITY[4:])),
        "instance_zero": by("a matrix of zeros", "RDM552", (0.0,) * 12),
        "instance_flat": by("a matrix that flattens, by no power of two", "RDM552", flat),
        "instance_far": by("too far a place", "RDM553", (*IDENTITY[:3], 1.01 * 2.0**127, *IDENTITY[4:])),
        "instance_stretched": by("too much stretched", "RDM553", (huge, *IDENTITY[1:])),
        "instance_order": of("faces that begin too early", "RDM554", (1, 0, IDENTITY), (0, 1, MIRROR)),
        "instance_faces": of("too many faces", "RDM554", (1, 0, IDENTITY), (0, 2**32 - 4, MIRROR)),
        "instance_cut": wrong("half a record", "RDM114", _placed(), payloads={"INST": lambda d: d[:-4]}),
        "instance_packed": wrong("instances that are not raw", "RDM125", _placed(), packed=packed),
    }


def _materials() -> dict[str, tuple[str, list[str], bytes]]:
    def of(codes: str, materials: list | bytes) -> tuple[str, list[str], bytes]:
        about = "materials that are not what they must be"
        return wrong(about, codes, PAIR, attributes=[GROUPS], materials=materials)

    texts = {
        "object": b"{}",
        "bytes": b'[{"name": "\xff", "base_color": [0, 0, 0, 0]}]',
        "cut": b'[{"name": "a"',
        "nan": b'[{"name": "", "base_color": [NaN, 0, 0, 0]}]',
        "deep": b"[" * 33 + b"]" * 33,
    }
    arrays = {
        "numbers": [1, 2],
        "nameless": [RED, {"base_color": [0, 0, 0, 0]}],
        "name": [{**RED, "name": 1}, RED],
        "colourless": [{"name": "a"}, RED],
        "short": [{**RED, "base_color": [0, 0, 0]}, RED],
        "bright": [{**RED, "base_color": [0, 0, 0, 1.5]}, RED],
        "negative": [{**RED, "base_color": [0, 0, -1, 1]}, RED],
        "truth": [{**RED, "base_color": [0, 0, True, 1]}, RED],
        "words": [{**RED, "base_color": ["0", 0, 0, 1]}, RED],
        "group": [{**RED, "group": None}, RED],
        "more": [{**RED, "roughness": 1}, RED],
    }
    made = {f"materials_{name}": of("RDM531", text) for name, text in texts.items()}
    made |= {f"materials_{name}": of("RDM531", rows) for name, rows in arrays.items()}
    many = Plan(PAIR.blocks, attributes=[GROUPS], materials=[RED, GLASS])
    return made | {
        "materials_long": wrong(
            "materials of 2^22 + 1 bytes",
            "RDM532",
            many,
            payloads={"MATL": lambda _: bytes(2**22 + 1)},
            packed={"MATL": lambda data: frame(data[:100], kind=1)},
        ),
        "materials_alone": wrong("materials and no groups", "RDM117", PAIR, materials=[RED]),
        "materials_without_groups": wrong(
            "materials and other values", "RDM117", PAIR, attributes=[COLOURS], materials=[RED]
        ),
        "materials_empty": wrong("an empty scene with materials", "RDM117", Plan([]), materials=[RED]),
    }


def _packed() -> dict[str, tuple[str, list[str], bytes]]:
    def pack(about: str, codes: str, how: Callable[[bytes], bytes], kind: str = "BLKD", **changes) -> tuple:
        return wrong(about, codes, ONE, packed={kind: how}, **changes)

    large = Plan([TRIANGLE], metadata=b"{}")
    return {
        "packed_scene": pack("a packed scene record", "RDM120", frame, "SCEN"),
        "packed_unknown": wrong("an unknown codec", "RDM119", ONE, entries={"BLKD": {"codec": 4}}),
        "packed_unknown_remap": wrong("an unknown codec", "RDM119", BASE, entries={"RMAP": {"codec": 65535}}),
        "packed_raw": pack("codec 1 and no frame", "RDM121", bytes),
        "packed_cut": pack("a frame cut short", "RDM121", lambda data: frame(data)[:-1]),
        "packed_longer": pack("a byte behind the frame", "RDM121", lambda data: frame(data, tail=b"\0")),
        "packed_twice": pack("two frames", "RDM121", lambda data: frame(data) * 2),
        "packed_other_length": pack("a frame of another length", "RDM121", lambda data: frame(data[:-1])),
        "packed_dictionary": pack(
            "a frame with a dictionary", "RDM121", lambda data: frame(data, descriptor=0xE1)
        ),
        "packed_dictionary_0": pack(
            "a frame with the field of a dictionary, which is none", "RDM121", _with_dictionary_0
        ),
        "packed_window": pack("a window of 2^28 bytes", "RDM121", lambda data: _window(data, 0x90)),
        "packed_checksum": pack(
            "a checksum of other bytes", "RDM122", frame, entries={"BLKD": {"raw_checksum": 1}}
        ),
        "packed_headers": pack(
            "block headers longer than the counts say",
            "RDM114",
            frame,
            "BLKH",
            payloads={"BLKH": lambda d: d * 2},
        ),
        "packed_bomb": wrong(
            "a frame that says it holds 2^60 bytes",
            "RDM114",
            ONE,
            packed={"BLKD": lambda data: frame(data)[:5] + struct.pack("<Q", 2**60) + frame(data)[13:]},
            entries={"BLKD": {"raw_length": 2**60}},
        ),
        "packed_metadata": wrong(
            "metadata of 2^20 + 1 bytes",
            "RDM902",
            large,
            payloads={"META": lambda _: bytes(2**20 + 1)},
            packed={"META": lambda data: frame(data[:100], kind=1)},
        ),
    }


def _streams() -> dict[str, tuple[str, list[str], bytes]]:
    def other(kind: str, codec: int, plan: Plan) -> tuple:
        return wrong("a codec of another kind", "RDM125", plan, packed={kind: frame}, codecs={kind: codec})

    def off(about: str, change: Callable[[dict], object], blocks: list[Block] = SHARED, **fields) -> tuple:
        return about, ["RDM126"], encode(in_streams(blocks, change, **fields))

    def put(name: str, at: int, value: int) -> Callable[[dict], None]:
        return lambda made: made[name].__setitem__(at, value)

    one = Strip([0, 1, 2])
    fine = Block([one], [(0.5, 0.0, 1.0), (0.0, 0.5, 1.0), (1.0, 1.0, 1.0)])
    coarse = Block([one], [(1.0, 1.0, 1.0), (4.0, 0.0, 1.0), (0.0, 4.0, 1.0)])
    huge = f32(0xFF7FFFFF)
    bits = triangle((0.0, 1.0, 2.0), Axis(place(huge), 32, 2, 0))
    no_value = fold(0x7F800000 - place(huge), 32)
    cases = {
        "ends_early": off("a byte too few", lambda made: made["z"].pop()),
        "ends_late": off("a number too many", lambda made: made["z"].append(0)),
        "unused": off("an unused bit of the turns", lambda made: made["turns"].append(1)),
        "unused_ways": off("an unused bit of the ways", lambda made: made["ways"].append(2)),
        "no_start": off("a block without a start bit", put("starts", 0, 0)),
        "too_many_starts": off("more starts than strips", put("starts", 1, 1)),
        "too_few_starts": off("fewer starts than strips", put("starts", 5, 0)),
        "no_edge": off("a first vertex beside an edge", put("ways", 0, 1)),
        "no_before": off("a vertex before none", put("ways", 1, 1)),
        "no_after": off("a vertex after none", put("ways", 1, 2)),
        "step_too_far": off("a step before the first vertex", put("steps", 0, 7)),
        "too_many": off("more new vertices than the block has", lambda made: _renamed(made, 7)),
        "no_place": off("a known vertex that has not come", put("places", 0, fold(11, 32))),
        "negative_place": off("a known vertex before the first", put("places", 0, fold(-1, 32))),
        "no_number": off("a known vertex off the block's multiples", put("places", 0, 0), [fine, coarse]),
        "rest_too_wide": off("a rest of more bits than the width", put("x", 0, 4)),
        "no_value": off("a known vertex that is no number", put("x", 0, no_value), [bits, bits]),
    }
    many = [("BLKD", 3, ONE), ("META", 3, BASE), ("NODE", 2, BASE), ("RMAP", 2, BASE), ("META", 2, BASE)]
    made = {f"codec_{codec}_of_{kind.lower()}": other(kind, codec, plan) for kind, codec, plan in many}
    made |= {f"streams_{name}": case for name, case in cases.items()}
    plan = in_streams(SHARED)
    shifted = [replace(SHARED[0], header={"first_triangle": 1}), *SHARED[1:]]
    made["streams_headers"] = wrong("codec 2 and a header that is wrong", "RDM601", plan, blocks=shifted)
    made["streams_too_long"] = wrong(
        "a frame of more bytes than the headers allow",
        "RDM121",
        plan,
        packed={"BLKD": lambda _: frame(bytes(999))},
    )
    made["streams_odd_length"] = wrong(
        "codec 2 and block data of no whole words", "RDM606", plan, entries={"BLKD": {"raw_length": 130}}
    )
    made["streams_other_bits"] = wrong(
        "a checksum of other bytes", "RDM122", plan, entries={"BLKD": {"raw_checksum": 1}}
    )
    made["planes_other_length"] = wrong(
        "planes of another length", "RDM121", ONE, packed={"BLKH": lambda d: frame(d[1:])}, codecs={"BLKH": 3}
    )
    return made


def _renamed(made: dict, at: int) -> None:
    """Name a vertex that is not new as if it were."""
    made["ways"][at] = 0
    made["steps"].pop(0)


def _window(data: bytes, byte: int) -> bytes:
    plain = frame(data, descriptor=0)
    return plain[:5] + bytes([byte]) + plain[5:]


# Hierarchies of other kinds

NINE = blocks_of(3, 3)
"""Nine triangles, three strips in three blocks."""
LOOSE, HEAP, CELLS, PRESORTED = 3, 1, 2, 4


def bvh(
    kind: int, blocks: list[Block], over: int = 0, order: list[int] | None = None, leaf: int = 1
) -> Hierarchy:
    """A BVH of kind 1 or 3 over objects in an order."""
    boxes = object_boxes(blocks, over)
    placed = [boxes[i] for i in order or range(len(boxes))]
    nodes = heap_tree(placed) if kind == HEAP else loose_tree(placed, leaf)
    return Hierarchy(kind, over, nodes, order or [], int(order is not None))


def cells_over(blocks: list[Block], over: int, depth: int) -> Hierarchy:
    """A kd-tree over objects."""
    nodes, references, root = cell_tree(object_boxes(blocks, over), depth)
    return Hierarchy(CELLS, over, nodes, references, bounds=root)


def presorted(blocks: list[Block], sizes: list[int] | None = None, **fields) -> Plan:
    """Presorted triangles: one tree without nodes, or trees of these sizes under a BVH."""
    corners = corners_of(blocks)
    boxes = object_boxes(blocks, 0)
    starts = [sum((sizes or [len(boxes)])[:i]) for i in range(len(sizes or [0]) + 1)]
    parts = [range(a, b) for a, b in pairwise(starts)]
    trees = [around([boxes[i] for i in part]) for part in parts]
    orders = [presort([boxes[i] for i in part]) for part in parts]
    order = [part[i] for part, row in zip(parts, orders, strict=True) for i in row]
    nodes = loose_tree(trees) if sizes else []
    nodes = [node if node[7] == 0 else (*node[:6], starts[node[6]], len(parts[node[6]])) for node in nodes]
    hierarchy = Hierarchy(PRESORTED, 0, nodes, starts)
    return Plan([], hierarchy=hierarchy, plain=plain_of([corners[i] for i in order]), **fields)


def chain(boxes: list[Box]) -> list[tuple]:
    """A BVH in preorder whose every first child is a leaf."""
    nodes = []
    for i in range(len(boxes) - 1):
        nodes += [(*around(boxes[i:]), 2 * i + 2, 0), (*boxes[i], i, 1)]
    return [*nodes, (*boxes[-1], len(boxes) - 1, 1)]


def _hierarchies() -> dict[str, tuple[str, Plan]]:
    back = [2, 0, 1]
    made = {
        "heap_one": ("an SLBVH of one leaf", Plan([TRIANGLE], hierarchy=bvh(HEAP, [TRIANGLE]))),
        "heap_triangles": ("an SLBVH over triangles", Plan(NINE, hierarchy=bvh(HEAP, NINE))),
        "heap_strips": ("an SLBVH over strips in an order", Plan(NINE, hierarchy=bvh(HEAP, NINE, 1, back))),
        "heap_blocks": ("an SLBVH over blocks", Plan(NINE, hierarchy=bvh(HEAP, NINE, 2))),
        "loose_one": ("a loose octree's BVH of one leaf", Plan([TRIANGLE], hierarchy=bvh(LOOSE, [TRIANGLE]))),
        "loose_triangles": ("leaves of two", Plan(NINE, hierarchy=bvh(LOOSE, NINE, leaf=2))),
        "loose_strips": ("strips in an order", Plan(NINE, hierarchy=bvh(LOOSE, NINE, 1, back))),
        "loose_blocks": ("blocks in an order", Plan(NINE, hierarchy=bvh(LOOSE, NINE, 2, back))),
        "cells_one": ("a kd-tree of one leaf", Plan([TRIANGLE], hierarchy=cells_over([TRIANGLE], 0, 0))),
        "cells_triangles": ("a kd-tree over triangles", Plan(NINE, hierarchy=cells_over(NINE, 0, 3))),
        "cells_strips": ("a kd-tree over strips", Plan(NINE, hierarchy=cells_over(NINE, 1, 4))),
        "presorted": ("presorted triangles, one tree", presorted(NINE)),
        "presorted_one": ("one presorted triangle", presorted([TRIANGLE])),
        "presorted_trees": ("three presorted trees under nodes", presorted(NINE, [4, 2, 3])),
        "presorted_one_tree": ("one presorted tree under a node", presorted(NINE, [9])),
    }
    many = [Block([zigzag(128)], points(130))]
    made["loose_deepest"] = (
        "a chain of 128 nodes",
        Plan(many, hierarchy=Hierarchy(3, 0, chain(object_boxes(many, 0)))),
    )
    grown = bvh(LOOSE, NINE, leaf=3)
    wide = [(*(x - 1.0 for x in node[:3]), *(x + 1.0 for x in node[3:6]), *node[6:]) for node in grown.nodes]
    made["loose_wide"] = ("boxes larger than need be", Plan(NINE, hierarchy=grown._replace(nodes=wide)))
    sided = presorted(NINE, remap=[(i, i % 3) for i in range(9)], metadata={"unit": "mm"}, grid=0)
    colours = Values("COLR", 2, 1, [(1, 2, 3), (4, 5, 6)], [0, 1, 1, 0, 0, 1, 0, 0, 1])
    vertices = Values(
        "NORM", 0, 0, [UP, EAST], [0, 1] + [0] * (len(sided.plain.points if sided.plain else []) - 2)
    )
    made["presorted_sides"] = ("with remap, values, grid", replace(sided, attributes=[vertices, colours]))
    for kind in ("HIER", "TRIS"):
        made[f"planes_{kind.lower()}"] = (
            f"{kind} in planes",
            replace(sided, packed={kind: lambda data: frame(planes(data, 4))}, codecs={kind: 3}),
        )
        made[f"zstd_{kind.lower()}"] = (f"{kind} packed", replace(sided, packed={kind: frame}))
    return made


def _changed(plan: Plan, node: int, place: int, value: float) -> Plan:
    """A plan with one number of a node of its hierarchy changed."""
    assert plan.hierarchy
    nodes = [list(row) for row in plan.hierarchy.nodes]
    nodes[node][place] = value
    return replace(plan, hierarchy=plan.hierarchy._replace(nodes=[tuple(row) for row in nodes]))


def _with_items(plan: Plan, items: list[int]) -> Plan:
    assert plan.hierarchy
    return replace(plan, hierarchy=plan.hierarchy._replace(items=items))


def _with_record(plan: Plan, tail: bytes = b"", **record) -> Plan:
    assert plan.hierarchy
    return replace(plan, hierarchy=plan.hierarchy._replace(record=record, tail=tail))


def _other_hierarchies() -> dict[str, tuple[str, list[str], bytes]]:
    heap = Plan(NINE, hierarchy=bvh(HEAP, NINE, 1, [2, 0, 1]))
    loose = Plan(NINE, hierarchy=bvh(LOOSE, NINE, 1, [2, 0, 1]))
    two = Plan(NINE, hierarchy=bvh(LOOSE, NINE, leaf=2))
    tree = Plan(NINE, hierarchy=cells_over(NINE, 0, 2))
    many = [Block([zigzag(129)], points(131))]
    deep = Plan(many, hierarchy=Hierarchy(3, 0, chain(object_boxes(many, 0))))
    placed = Plan(NINE, hierarchy=bvh(HEAP, NINE), geometries=[(0, 0, 0, 9)], instances=[(0, 0, IDENTITY)])
    made = {
        "unknown": ("RDM561", _with_record(heap, kind=5), "a kind that is not known"),
        "none": ("RDM561", _with_record(heap, kind=0), "no kind"),
        "over": ("RDM561", _with_record(heap, over=3), "objects that are not known"),
        "cells_over_blocks": ("RDM561", _with_record(tree, over=2), "a kd-tree over blocks"),
        "cells_ordered": ("RDM561", _with_record(tree, flags=1), "a kd-tree with an order"),
        "reserved": ("RDM107", _with_record(heap, reserved=1), "a reserved byte"),
        "reserved_2": ("RDM107", _with_record(loose, reserved_2=1), "a reserved word"),
        "reserved_3": ("RDM107", _with_record(loose, reserved_3=b"\1"), "reserved bytes"),
        "flags": ("RDM107", _with_record(loose, flags=3), "a reserved flag"),
        "bounds": ("RDM563", _with_record(loose, high_z=1.0), "a cell that is not needed"),
        "more_nodes": ("RDM562", _with_record(loose, node_count=6), "a node that is not there"),
        "huge": ("RDM562", _with_record(loose, node_count=2**32 - 1), "as many nodes as can be told"),
        "longer": ("RDM562", _with_record(loose, bytes(4)), "a word behind the items"),
        "no_order": ("RDM562", _with_record(heap, flags=0), "items without an order"),
        "order_missing": ("RDM562", _with_items(heap, []), "an order without items"),
        "order_short": ("RDM562", _with_items(heap, [1, 0]), "an order of too few"),
        "order_twice": ("RDM567", _with_items(heap, [1, 0, 1]), "an object twice"),
        "order_outside": ("RDM567", _with_items(loose, [3, 0, 1]), "an object that is not there"),
        "order_far": ("RDM567", _with_items(loose, [2**32 - 1, 0, 1]), "an object far beyond"),
        "heap_child": ("RDM564", _changed(heap, 4, 6, 1 << 3), "an inner node without room for children"),
        "heap_lost": ("RDM564", _changed(heap, 7, 6, 1 << 3 | 4), "a node below a leaf"),
        "heap_first": ("RDM564", _changed(heap, 0, 7, 1), "a node 0"),
        "heap_axis": ("RDM563", _changed(heap, 1, 6, 3 << 3 | 3), "no axis"),
        "heap_leaf_axis": ("RDM563", _changed(heap, 3, 6, 1 << 3 | 5), "a leaf with an axis"),
        "heap_count": ("RDM566", _changed(heap, 1, 6, 4 << 3), "a root that holds too many"),
        "heap_place": ("RDM566", _changed(heap, 3, 7, 1), "a leaf that holds another place"),
        "heap_box": ("RDM568", _changed(heap, 1, 3, 5.0), "a box that is too small"),
        "heap_nan": ("RDM568", _changed(heap, 2, 0, float("nan")), "a box that is none"),
        "loose_second": ("RDM564", _changed(loose, 0, 6, 4), "a second child that is another's"),
        "loose_far": ("RDM564", _changed(loose, 0, 6, 99), "a second child that is not there"),
        "loose_open": ("RDM564", _changed(loose, 1, 7, 0), "a leaf that is no leaf"),
        "loose_closed": ("RDM564", _changed(loose, 0, 7, 3), "nodes behind the last"),
        "loose_deep": ("RDM565", deep, "a chain of 129 nodes"),
        "loose_place": ("RDM566", _changed(loose, 1, 6, 1), "a place twice"),
        "loose_outside": ("RDM566", _changed(loose, 4, 6, 7), "a place that is not there"),
        "loose_few": ("RDM566", _changed(two, 2, 7, 1), "a place in no leaf"),
        "loose_box": ("RDM568", _changed(loose, 1, 0, 9.0), "a box that is too small"),
        "of_no_nodes": ("RDM562", replace(loose, hierarchy=Hierarchy(3, 2, [])), "no node"),
        "heap_odd": (
            "RDM562",
            replace(heap, hierarchy=bvh(LOOSE, NINE)._replace(kind=1)),
            "a heap of 17 nodes",
        ),
        "stored": ("RDM201", replace(heap, record={"flags": 1}), "boxes inside blocks beside it"),
        "nodes_beside": ("RDM201", replace(heap, nodes=plain_nodes(NINE, None), top=1), "nodes beside it"),
        "with_instances": ("RDM117", placed, "instances beside it"),
        "empty": ("RDM117", Plan([], hierarchy=Hierarchy(3, 0, [])), "a hierarchy of an empty scene"),
    }
    files = {f"hierarchy_{name}": wrong(about, codes, plan) for name, (codes, plan, about) in made.items()}
    files["hierarchy_stored"][1].append("RDM207")
    files["hierarchy_stored"][1].append("RDM113")
    files["hierarchy_short"] = wrong("63 bytes", "RDM562", heap, payloads={"HIER": lambda data: data[:63]})
    files["hierarchy_long"] = wrong(
        "too many bytes", "RDM114", heap, payloads={"HIER": lambda d: d + bytes(2**14)}
    )
    files["hierarchy_passed_over"] = wrong(
        "not to be understood", "RDM116", heap, entries={"HIER": {"flags": 0}}
    )
    return files


IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0)


def _trees_of_cells() -> dict[str, tuple[str, list[str], bytes]]:
    tree = Plan(NINE, hierarchy=cells_over(NINE, 0, 2))
    assert tree.hierarchy
    root, items, count = tree.hierarchy.bounds, tree.hierarchy.items, len(tree.hierarchy.nodes)
    held = tree.hierarchy.nodes[2][1] >> 2
    small = tree.hierarchy._replace(bounds=(*root[:3], root[3] - 1.0, *root[4:]))
    far = tree.hierarchy._replace(bounds=(*root[:5], float("inf")))
    swapped = [items[1], items[0], *items[2:]]
    lacking = [8 if i == 0 else item for i, item in enumerate(items)]
    made = {
        "plane": ("RDM563", _changed(tree, 0, 0, bits32(root[3] + 1.0)), "a plane out of its cell"),
        "nan": ("RDM563", _changed(tree, 1, 0, 0x7FC00000), "a plane that is none"),
        "second": ("RDM564", _changed(tree, 0, 1, 5 << 2), "a child that is another's"),
        "axis": ("RDM564", _changed(tree, 0, 1, 3), "an inner node that is a leaf"),
        "far": ("RDM564", _changed(tree, 0, 1, 2**32 - 4), "a child that is not there"),
        "count": ("RDM566", _changed(tree, 2, 1, held + 1 << 2 | 3), "a leaf that has a reference too many"),
        "first": ("RDM566", _changed(tree, 2, 0, 1), "a leaf that has another's"),
        "left": ("RDM566", _with_items(tree, [*items, 8]), "a reference too many"),
        "falling": ("RDM567", _with_items(tree, swapped), "references that fall"),
        "outside": ("RDM567", _with_items(tree, [*items[:-1], 9]), "an object that is not there"),
        "root": ("RDM568", replace(tree, hierarchy=small), "a root's cell that is too small"),
        "infinite": ("RDM563", replace(tree, hierarchy=far), "a root's cell without an end"),
    }
    files = {f"cells_{name}": wrong(about, codes, plan) for name, (codes, plan, about) in made.items()}
    one = cells_over([TRIANGLE], 0, 0)
    files["cells_empty"] = wrong(
        "a triangle in no leaf", "RDM568", ONE, hierarchy=one._replace(nodes=[(0, 3)], items=[])
    )
    files["cells_none"] = wrong("no node", "RDM562", ONE, hierarchy=one._replace(nodes=[], items=[]))
    assert count == 7
    assert lacking != items
    return files


def _presorted() -> dict[str, tuple[str, list[str], bytes]]:
    one, trees = presorted(NINE), presorted(NINE, [4, 2, 3])
    assert one.plain
    faces = one.plain.faces
    turned = plain_of([[one.plain.points[i] for i in face] for face in reversed(faces)])
    made = {
        "starts_late": ("RDM567", _with_items(one, [1, 9]), "a first tree that begins late"),
        "starts_short": ("RDM567", _with_items(one, [0, 8]), "a last tree that ends early"),
        "starts_twice": ("RDM567", _with_items(trees, [0, 4, 4, 9]), "a tree without a triangle"),
        "no_tree": ("RDM562", _with_items(one, [0]), "no tree"),
        "several": ("RDM562", _with_items(one, [0, 4, 9]), "two trees without a node"),
        "leaf": ("RDM566", _changed(trees, 1, 7, 3), "a leaf with another tree"),
        "leaf_first": ("RDM566", _changed(trees, 1, 6, 1), "a leaf with another beginning"),
        "child": ("RDM564", _changed(trees, 0, 6, 1), "a second child that is the first"),
        "box": ("RDM568", _changed(trees, 0, 3, 1.0), "a box that is too small"),
        "slab": ("RDM568", replace(one, plain=turned), "triangles in another order"),
        "over": ("RDM561", _with_record(one, over=1), "presorted strips"),
        "no_triangles": ("RDM113", replace(one, drop=("TRIS",)), "no plain triangles"),
    }
    files = {f"presorted_{name}": wrong(about, codes, plan) for name, (codes, plan, about) in made.items()}
    # Without the triangles nothing says that there may be no block.
    files["presorted_no_triangles"][1].append("RDM201")
    fields = {"triangle_count": 9, "source_face_count": 9}
    beside = replace(Plan(NINE, hierarchy=one.hierarchy), plain=one.plain, record=fields)
    files["presorted_beside_blocks"] = wrong("blocks beside plain triangles", "RDM201 RDM568", beside)
    return files


def _plain() -> dict[str, tuple[str, list[str], bytes]]:
    one = presorted([TRIANGLE])
    nine = presorted(NINE)
    assert nine.plain
    assert one.plain
    points, faces = nine.plain
    alone = Plan([TRIANGLE], plain=one.plain, record={"triangle_count": 1})
    made = {
        "outside": ("RDM571", Plain(points, [*faces[:-1], [0, 1, len(points)]])),
        "late": ("RDM572", Plain(points, [[faces[0][1], faces[0][0], faces[0][2]], *faces[1:]])),
        "unused": ("RDM573", Plain([*points, (1.0, 1.0, 1.0)], faces)),
    }
    files = {f"plain_{name}": wrong(name, codes, nine, plain=plain) for name, (codes, plain) in made.items()}
    twice = presorted([Block([Strip([0, 1, 2]), Strip([2, 1, 0])], TRIANGLE.points)])
    assert twice.plain
    again = [twice.plain.faces[0], [0, 1, 0]]
    files["plain_repeated"] = wrong(
        "a vertex twice", "RDM574", twice, plain=twice.plain._replace(faces=again)
    )
    endless = Plain([*points[:-1], (float("inf"), 1.0, 1.0)], faces)
    files["plain_infinite"] = wrong(
        "a point without an end", "RDM575", nine, plain=endless, record={"high_x": nine.bounds[3]}
    )
    files["plain_off_grid"] = wrong("no multiple of 8", "RDM204", nine, grid=3)
    files["plain_bounds"] = wrong("other bounds", "RDM205", nine, record={"high_x": 99.0})
    files["plain_odd"] = wrong("a byte more", "RDM114", nine, payloads={"TRIS": lambda data: data + b"\0"})
    files["plain_few"] = wrong("too few vertices", "RDM114", one, payloads={"TRIS": lambda data: data[12:]})
    files["plain_alone"] = wrong("no hierarchy", "RDM117", alone)
    files["plain_alone"][1].append("RDM201")
    return files


def all_files() -> dict[str, bytes]:
    """Every file of both folders, by its path in this one."""
    files: dict[str, bytes] = {}
    for name, (about, plan) in valid_plans().items():
        files[f"valid/{name}.rdm"] = encode(plan)
        files[f"valid/{name}.json"] = _lines({"about": about, **decoding(plan)})
    for name, (about, codes, data) in invalid_files().items():
        files[f"invalid/{name}.rdm"] = data
        files[f"invalid/{name}.json"] = _lines({"about": about, "codes": sorted(codes)})
    return files


def _lines(facts: dict) -> bytes:
    """JSON with a line for each name; a long list only has the SHA-256 of its JSON, in 64 letters."""
    rows = []
    for name, value in facts.items():
        text = json.dumps(value, separators=(",", ":"))
        if len(text) > LONGEST_LINE:
            text = json.dumps(hashlib.sha256(text.encode()).hexdigest())
        rows.append(f"{json.dumps(name)}: {text}")
    return ("{\n" + ",\n".join(rows) + "\n}\n").encode()
