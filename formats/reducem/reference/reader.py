"""Read a ReduceM scene file, format 0.4: the reference reader, written from SPEC.md alone.

It is slow and plain on purpose, needs nothing but the standard library and shares no code with striptools.
Every refusal is a `RefusedError` that names the clause of SPEC.md. It reads raw sections; where an archive
(codecs 1 to 3) needs more it says what. It checks what sections 3 to 6 rule, but not whether the boxes
of nodes, their cells and slabs hold what is below them: it decodes them, and a validator looks.

    python reader.py FILE          print a summary
    python reader.py --obj FILE    print a Wavefront OBJ of the triangles, in the order of the file
"""

import json
import math
import struct
import sys
import zlib
from dataclasses import dataclass, field
from fractions import Fraction
from itertools import pairwise
from pathlib import Path

MAGIC = b"\x89RDM\r\n\x1a\n"
MUST_UNDERSTAND = {"SCEN": 1, "BLKH": 1, "BLKD": 1, "NODE": 1, "RUNS": 1}
MUST_UNDERSTAND |= {"GEOM": 1, "INST": 1, "HIER": 1, "TRIS": 1, "RMAP": 0, "ATTR": 0, "MATL": 0, "META": 0}
MOST_DEEP = 32
"""Levels of arrays and objects in metadata."""


class RefusedError(Exception):
    """The file is not read; `clause` is the section of SPEC.md that says why."""

    def __init__(self, clause, what):
        self.clause = clause
        super().__init__(f"SPEC {clause}: {what}")


@dataclass
class Node:
    """A node: what is in its slots 0 to 7.

    `children` has `("empty",)`, `("node", i)`, `("block", i)` or `("run", block, i)` for each slot; `boxes`
    has None or, for each axis, two integers L and H: the box goes from low + 2^cell * L to low + 2^cell * H.
    """

    children: list
    boxes: list


@dataclass
class Hierarchy:
    """What HIER holds.

    `nodes` has the `u32` words of each node, eight or two of them; `items` are the numbers behind; `bounds`
    are the bit patterns of the root's cell.
    """

    kind: int
    over: int
    flags: int
    nodes: list
    items: list
    bounds: tuple


@dataclass
class Scene:
    """A decoded file.

    Attributes:
        record: The fields of SCEN by their names; floats as floats.
        vertices: The vertices of all blocks, or of TRIS, in a row, each three 32-bit patterns of floats.
        faces: The triangles in the order of the file, each three numbers of `vertices`.
        block_starts: The first triangle of each block, and n.
        begins: For each triangle 1 where a strip begins, else 0.
        turns: For each triangle its turn bit.
        remap: `(face, rotation)` of each triangle, or None.
        nodes: The nodes in their order.
        runs: For each block its runs `(first triangle, triangles)`; None where boxes are not stored.
        attributes: For each name `(domain, values)`: a row for each block vertex, corner or triangle, whose
            f32 are 32-bit patterns.
        materials: The array of MATL; empty where there is none.
        metadata: The object of META; empty where there is none.
        geometries: For each `(first_block, first_top, first_face, face_count)`; one that has all where there
            is no GEOM.
        instances: For each `(geometry, first_face, matrix)`, the matrix twelve floats; None where there are
            none.
        hierarchy: What HIER holds; None where it is not there.
        passed_over: The kinds of sections that this reader does not know.
    """

    record: dict
    vertices: list = field(default_factory=list)
    faces: list = field(default_factory=list)
    block_starts: list = field(default_factory=lambda: [0])
    begins: list = field(default_factory=list)
    turns: list = field(default_factory=list)
    remap: list | None = None
    nodes: list = field(default_factory=list)
    runs: list | None = None
    attributes: dict = field(default_factory=dict)
    materials: list = field(default_factory=list)
    metadata: dict = field(default_factory=dict)
    geometries: list = field(default_factory=list)
    instances: list | None = None
    hierarchy: Hierarchy | None = None
    passed_over: list = field(default_factory=list)


def read(data):
    """Decode a whole file.

    Args:
        data: The bytes of the file.

    Raises:
        RefusedError: The file is not valid, or needs something that is not here.
    """
    sections, passed_over = read_container(bytes(data))
    if "SCEN" not in sections:
        raise RefusedError("4", "there is no section SCEN")
    record = read_record(sections["SCEN"], sections)
    check_lengths(record, sections)
    scene = Scene(record, passed_over=passed_over)
    if "TRIS" in sections:
        read_triangles(scene, sections["TRIS"])
    else:
        read_blocks(scene, sections.get("BLKH", b""), sections.get("BLKD", b""))
    check_bounds(scene)
    scene.geometries = read_geometries(scene, sections.get("GEOM", bytes(12) + struct.pack("<I", 2**32 - 1)))
    if "GEOM" in sections:
        check_geometries(scene)
        scene.instances = read_instances(scene, sections["INST"])
    if record["stored"]:
        scene.runs = read_runs(scene, sections["RUNS"])
    scene.nodes = [read_node(scene, i, sections["NODE"]) for i in range(record["node_count"])]
    check_nodes(scene)
    if "HIER" in sections:
        scene.hierarchy = read_hierarchy(scene, sections["HIER"])
    read_beside(scene, sections)
    return scene


def read_beside(scene, sections):
    """Decode what is not needed to trace."""
    if "RMAP" in sections:
        scene.remap = read_remap(scene.record, sections["RMAP"])
        check_owners(scene)
    if "MATL" in sections:
        scene.materials = read_materials(sections["MATL"])
    if "ATTR" in sections:
        scene.attributes = read_attributes(scene, sections["ATTR"])
    if scene.materials and "GRUP" not in scene.attributes:
        raise RefusedError("4", "MATL is there and not needed")
    if "META" in sections:
        scene.metadata = read_metadata(sections["META"])


# Section 3: the container


def read_container(data):
    """The raw bytes of each known section by its kind, and the kinds of the others."""
    count = read_header(data)
    sections, passed_over = {}, []
    kinds = set()
    end = 32 + 40 * count
    for i in range(count):
        entry = struct.unpack_from("<4sHHQQQII", data, 32 + 40 * i)
        kind = entry[0].decode("latin-1")
        if kind in kinds:
            raise RefusedError("3.2", f"{kind!r} is there twice")
        kinds.add(kind)
        payload = read_section(data, end, kind, *entry[1:])
        end = entry[3] + entry[4]
        if kind in MUST_UNDERSTAND:
            sections[kind] = payload
        else:
            passed_over.append(kind)
    if align(end) != len(data) or any(data[end:]):
        raise RefusedError("3.3", "the file does not end where its last section does, in zero bytes")
    return sections, passed_over


def read_header(data):
    """The number of sections of a file whose header and table are whole."""
    if data[:8] != MAGIC[: len(data)]:
        raise RefusedError("3.1", "the first bytes are not those of a scene file")
    if len(data) < 32:
        raise RefusedError("3.1", "the file ends inside its header")
    major, minor, count, total, reserved, checksum = struct.unpack_from("<HHIQII", data, 8)
    if (major, minor) != (0, 4):
        raise RefusedError("7", f"version {major}.{minor} is not 0.4")
    if total != len(data) or total % 64:
        raise RefusedError("3.1", f"the file has {len(data)} bytes, not the {total} of its header")
    if not 1 <= count <= 64 or 32 + 40 * count > len(data):
        raise RefusedError("3.1", f"{count} sections")
    if zlib.crc32(data[:28] + data[32 : 32 + 40 * count]) != checksum:
        raise RefusedError("3.1", "the checksum of header and table does not fit")
    if reserved:
        raise RefusedError("3.1", "the reserved field is not zero")
    return count


def read_section(data, end, kind, flags, codec, offset, stored_length, raw_length, stored_sum, raw_sum):
    """The bytes of one section, which begins after byte `end`."""
    if flags > 1:
        raise RefusedError("3.2", f"{kind!r}: a reserved flag is set")
    if flags != MUST_UNDERSTAND.get(kind, 0):
        raise RefusedError("3.2", f"{kind!r}: must be understood and is not known, or has the wrong flag")
    if stored_length < 1 or raw_length < 1:
        raise RefusedError("3.2", f"{kind!r}: a section of no bytes")
    if offset != align(end) or offset + stored_length > len(data):
        raise RefusedError("3.3", f"{kind!r}: out of its place")
    if any(data[end:offset]):
        raise RefusedError("3.3", f"{kind!r}: the padding before it is not zero")
    stored = data[offset : offset + stored_length]
    if zlib.crc32(stored) != stored_sum:
        raise RefusedError("3.2", f"{kind!r}: the checksum does not fit")
    if codec == 0 and (raw_length, raw_sum) != (stored_length, stored_sum):
        raise RefusedError("3.2", f"{kind!r}: raw, but with two lengths or checksums")
    if codec and kind in MUST_UNDERSTAND:
        needs = {1: "a Zstandard decoder", 2: "a Zstandard decoder and section 6.2"}
        need = (needs | {3: "a Zstandard decoder and section 6.1"}).get(codec, "a newer reader")
        raise RefusedError("6", f"{kind!r}: has codec {codec} and needs {need}; this reads raw sections only")
    return stored


def align(x):
    """The least multiple of 64 that is not below x."""
    return (x + 63) // 64 * 64


# Section 4.1: the scene record

RECORD = struct.Struct("<6IBBhId6f3hH3d")
FIELDS = (
    *("triangle_count", "block_count", "node_count", "top_count", "run_count", "source_face_count"),
    *("flags", "reserved", "grid_exponent", "reserved_2", "error_bound"),
    *("low_x", "low_y", "low_z", "high_x", "high_y", "high_z", "cell_x", "cell_y", "cell_z"),
    *("longest_run", "origin_x", "origin_y", "origin_z"),
)


def read_record(payload, sections):
    """The fields of SCEN by name, with `stored` and `grid` for the two flags, and `low`, `high`, `cell`."""
    if len(payload) != RECORD.size:
        raise RefusedError("4.1", f"SCEN has {len(payload)} bytes")
    record = dict(zip(FIELDS, RECORD.unpack(payload), strict=True))
    record["stored"], record["grid"] = record["flags"] & 1, record["flags"] >> 1 & 1
    record["low"] = [record[f"low_{axis}"] for axis in "xyz"]
    record["high"] = [record[f"high_{axis}"] for axis in "xyz"]
    record["cell"] = [record[f"cell_{axis}"] for axis in "xyz"]
    if record["flags"] > 7 or record["reserved"] or record["reserved_2"]:
        raise RefusedError("4.1", "a reserved field is not zero")
    origin = [record[f"origin_{axis}"] for axis in "xyz"]
    if not all(map(math.isfinite, origin)):
        raise RefusedError("4.1", "the origin is not finite")
    if not any(origin) if record["flags"] & 4 else any(payload[72:]):
        raise RefusedError("4.1", "the origin is zero, or there without its flag")
    if not (math.isfinite(record["error_bound"]) and record["error_bound"] >= 0):
        raise RefusedError("4.1", "the error bound is negative or not finite")
    if not (-149 <= record["grid_exponent"] <= 104 if record["grid"] else record["grid_exponent"] == 0):
        raise RefusedError("4.1", "the grid exponent is out of its range")
    if not all(-149 <= cell <= 127 for cell in record["cell"]):
        raise RefusedError("4.1", "a cell exponent is out of its range")
    check_counts(record, sections)
    if record["triangle_count"] == 0:
        check_empty(record, payload)
    return record


def check_counts(record, sections):
    """Refuse counts that no scene of these sections can have."""
    several, other, plain = ("GEOM" in sections), ("HIER" in sections), ("TRIS" in sections)
    n, b, m = record["triangle_count"], record["block_count"], record["node_count"]
    top, r, longest = record["top_count"], record["run_count"], record["longest_run"]
    wrong = b > 2**24 or m > 2**28 or (b == 0) != (n == 0 or plain) or not b <= n
    wrong = wrong or (n > 256 * b and not plain) or (other and record["stored"])
    wrong = wrong or record["source_face_count"] < n
    wrong = wrong or (top > 0 if b < 2 or other else top == 0 and not several)
    if record["stored"]:
        wrong = wrong or m < top + b or not b <= r <= n or not 1 <= longest <= 8
    else:
        wrong = wrong or m != top or r != 0 or longest != 0
    if wrong:
        raise RefusedError("4.1", "the counts do not agree with each other")


def check_empty(record, payload):
    """Refuse an empty scene with anything in it."""
    if record["flags"] & 5 or any(payload[40:70]):
        raise RefusedError("4.1", "an empty scene with stored boxes, bounds, cells or an origin")


def check_lengths(record, sections):
    """Refuse sections that are missing, not needed, or of another length than the counts give."""
    n, b, m, r = (record[name] for name in ("triangle_count", "block_count", "node_count", "run_count"))
    lengths = {
        "SCEN": 96,
        "BLKH": 32 * b,
        "NODE": 64 * m,
        "RUNS": align(4 * b) + 4 * r if record["stored"] else 0,
    }
    if "RMAP" in sections:
        lengths["RMAP"] = 4 * n + -(-n // 4)
    for kind, length in lengths.items():
        if len(sections.get(kind, b"")) != length:
            raise RefusedError("4.1", f"{kind} has another length than the counts give it")
        if kind in sections and not length:
            raise RefusedError("4", f"{kind} is there and not needed")
    check_alternatives(n, sections)
    if ("BLKD" in sections) != (b > 0):
        raise RefusedError("4", "BLKD is missing, or there and not needed")
    if ("GEOM" in sections) != ("INST" in sections) or (n == 0 and "GEOM" in sections):
        raise RefusedError("4", "of GEOM and INST one is missing, or they are there and not needed")


def check_alternatives(n, sections):
    """Refuse sections that are not there together, HIER and TRIS of another length than they may have."""
    if "HIER" in sections and ("GEOM" in sections or not n):
        raise RefusedError("4", "HIER is there with GEOM, or in an empty scene")
    if ("TRIS" in sections) != ("HIER" in sections and sections["HIER"][0] == 4):
        raise RefusedError("4", "TRIS is missing, or there and not needed")
    if len(sections.get("HIER", b"")) > 1024 * (n + 1):
        raise RefusedError("4", "HIER has more bytes than there may be")
    length = len(sections.get("TRIS", bytes(12 * n + 36)))
    if length % 12 or not 12 * n + 36 <= length <= max(48 * n, 36):
        raise RefusedError("4.13", "TRIS has another length than the triangles give it")


# Sections 4.2 and 4.3: blocks


def read_blocks(scene, headers, data):
    """Decode all blocks into `scene.vertices` and `scene.faces`."""
    word = 0
    for i in range(scene.record["block_count"]):
        header = struct.unpack_from("<IIBBBB3i3B3BH", headers, 32 * i)
        if header[0] != len(scene.faces) or header[1] != word:
            raise RefusedError("4.2", f"block {i} begins at another triangle or word")
        try:
            word = read_block(scene, header, data, word)
        except RefusedError as refusal:
            raise RefusedError(refusal.clause, f"block {i}: {refusal}") from None
        scene.block_starts.append(len(scene.faces))
    if len(scene.faces) != scene.record["triangle_count"]:
        raise RefusedError("4.1", "the blocks have more or fewer triangles than the scene")
    if data and (len(data) != align(4 * (word + 16)) or any(data[4 * word :])):
        raise RefusedError("4.2", "the block data do not end in 16 words of zero and none too many")


def read_block(scene, header, data, word):
    """Decode one block; gives the word after its end."""
    k, q, s, flags = header[2] + 1, header[3] + 1, header[4] + 1, header[5]
    axes = list(zip(header[6:9], header[9:12], header[12:15], strict=True))
    c = k + 2 * s
    if q < 3 or s > k or q > c or flags > 1 or header[15]:
        raise RefusedError("4.2", "a count is out of its range, or a reserved field is not zero")
    check_axes(axes)
    w = (q - 1).bit_length()
    bits = (2 + flags) * k + c * w + q * sum(axis & 63 for _, axis, _ in axes)
    end = word + -(-bits // 32)
    if 4 * end > len(data):
        raise RefusedError("4.2", "the data end inside the block")
    stream = int.from_bytes(data[4 * word : 4 * end], "little")
    if stream >> bits:
        raise RefusedError("4.2", "the last word is not filled up with zero bits")
    starts, turns = ([stream >> p + t & 1 for t in range(k)] for p in (0, k))
    flips = [stream >> 2 * k + t & 1 for t in range(k)] if flags else [0] * k
    check_strips(s, starts, turns, flips, flags)
    p = (2 + flags) * k
    index = [stream >> p + i * w & (1 << w) - 1 for i in range(c)]
    check_indices(index, q)
    scene.begins += starts
    scene.turns += turns
    first = len(scene.vertices)
    scene.vertices += read_vertices(stream >> p + c * w, q, axes)
    scene.faces += [[first + corner for corner in face] for face in read_faces(starts, turns, flips, index)]
    return end


def check_axes(axes):
    """Refuse widths, modes and exponents that are out of their range."""
    for _, axis, exponent in axes:
        width, mode = axis & 63, axis >> 6
        if width > 32 or mode > 2 or (mode == 1 and width == 0) or (mode == 2 and exponent):
            raise RefusedError("4.2", "a width, mode or exponent is out of its range")


def check_strips(s, starts, turns, flips, flags):
    """Refuse start, turn and flip bits that make no strips."""
    if not starts[0] or sum(starts) != s:
        raise RefusedError("4.3", "the start bits do not begin as many strips as the header says")
    if any(start and (turn or flip) for start, turn, flip in zip(starts, turns, flips, strict=True)):
        raise RefusedError("4.3", "the first triangle of a strip turns or is flipped")
    if flags and not any(flips):
        raise RefusedError("4.3", "there are flip bits and none is set")
    equal = 0
    for t in range(1, len(starts)):
        goes_on = not starts[t] and not starts[t - 1] and turns[t] == turns[t - 1]
        equal = equal + 1 if goes_on else 1
        if equal > 30 and not starts[t]:
            raise RefusedError("4.3", "more than 30 turn bits in a row are equal")


def check_indices(index, q):
    """Refuse indices that are not in the order of their first use, or leave a vertex out."""
    used = 0
    for i in index:
        if i > used or i >= q:
            raise RefusedError("4.3", "the indices are not in the order of their first use, or too large")
        used = max(used, i + 1)
    if used != q:
        raise RefusedError("4.3", "a vertex is not used")


def read_faces(starts, turns, flips, index):
    """The triangles of a block, by the loop of section 4.3."""
    faces = []
    i = -1
    a = b = c = 0
    for t, start in enumerate(starts):
        if start:
            i += 1
            a, b, c = index[t + 2 * i : t + 2 * i + 3]
        else:
            w = index[t + 2 * i + 2]
            a, b, c = (a, c, w) if turns[t] else (c, b, w)
        if a in (b, c) or b == c:
            raise RefusedError("4.3", f"triangle {t} names one vertex twice")
        faces.append((b, a, c) if flips[t] else (a, b, c))
    return faces


def read_vertices(stream, q, axes):
    """The vertices of a block from the stream of their numbers: q rows of three bit patterns."""
    vertices = []
    for _ in range(q):
        vertex = []
        for anchor, axis, exponent in axes:
            width, mode = axis & 63, axis >> 6
            u = stream & (1 << width) - 1
            stream >>= width
            vertex.append(coordinate(anchor, u, width, mode, exponent - 149))
        vertices.append(tuple(vertex))
    return vertices


def coordinate(anchor, u, width, mode, e):
    """The bit pattern of one coordinate."""
    i = anchor + u
    if mode == 2:
        bits = i if i >= 0 else 0x80000000 + (-1 - i)
        if (i if i >= 0 else -1 - i) >= 0x7F800000:
            raise RefusedError("4.3", "a coordinate is not finite")
        return bits
    if mode == 1 and u == (1 << width) - 1:
        return 0x80000000
    value = math.ldexp(i, e)
    try:
        bits = struct.pack("<f", value)
    except OverflowError:
        raise RefusedError("4.3", "a coordinate is not finite") from None
    if not -(2**31) < i < 2**31 or struct.unpack("<f", bits)[0] != value:
        raise RefusedError("4.3", "a coordinate is out of its range or no float32")
    return int.from_bytes(bits, "little")


def as_float(bits):
    """The number that a 32-bit pattern stands for."""
    return struct.unpack("<f", bits.to_bytes(4, "little"))[0]


def check_bounds(scene):
    """Refuse low and high that are not the positions' own, and coordinates that are not on the grid."""
    record = scene.record
    for axis in range(3 if scene.vertices else 0):
        values = [as_float(vertex[axis]) for vertex in scene.vertices]
        # Adding 0.0 turns -0.0 into 0.0.
        wanted = struct.pack("<ff", min(values) + 0.0, max(values) + 0.0)
        if struct.pack("<ff", record["low"][axis], record["high"][axis]) != wanted:
            raise RefusedError("4.1", "low and high are not the bounds of the positions")
        if record["grid"] and any(math.ldexp(x, -record["grid_exponent"]) % 1 for x in values):
            raise RefusedError("4.1", "a coordinate is not on the grid")


# Sections 4.4 and 4.5: nodes and runs


def read_runs(scene, payload):
    """For each block its runs `(first triangle, triangles)`."""
    b, r = scene.record["block_count"], scene.record["run_count"]
    starts = [*struct.unpack_from(f"<{b}I", payload), r]
    words = struct.unpack_from(f"<{r}I", payload, align(4 * b))
    if any(payload[4 * b : align(4 * b)]):
        raise RefusedError("4.5", "unused bytes between the numbers of runs and the runs are not zero")
    if starts[0] != 0 or any(starts[i] > starts[i + 1] for i in range(b)):
        raise RefusedError("4.5", "the runs of the blocks are not in their order")
    runs = []
    for i in range(b):
        here = words[starts[i] : starts[i + 1]]
        runs.append([(word & 255, (word >> 8 & 7) + 1) for word in here])
        check_runs(scene, i, runs[-1])
        if any(word != run_word(scene, i, *run) for word, run in zip(here, runs[-1], strict=True)):
            raise RefusedError("4.5", f"block {i}: a run does not say where its corners are")
    return runs


def check_runs(scene, block, runs):
    """Refuse runs that are too long, in two strips, or do not have each triangle of the block once."""
    triangles = [t for first, count in runs for t in range(first, first + count)]
    if sorted(triangles) != list(range(scene.block_starts[block + 1] - scene.block_starts[block])):
        raise RefusedError("4.5", f"block {block}: not every triangle is in exactly one run")
    if any(count > scene.record["longest_run"] for _, count in runs):
        raise RefusedError("4.5", f"block {block}: a run is longer than the longest")
    at = scene.block_starts[block]
    if any(any(scene.begins[at + first + 1 : at + first + count]) for first, count in runs):
        raise RefusedError("4.5", f"block {block}: a run is in two strips")


def run_word(scene, block, first, count):
    """What RUNS must have of a run that lies in its strip; a strip's first triangle has turn 1."""
    at = scene.block_starts[block] + first
    turns = [turn | begin for turn, begin in zip(scene.turns, scene.begins, strict=True)]
    equal = 0
    while not scene.begins[at - equal] and turns[at - equal - 1] == turns[at]:
        equal += 1
    word = first | count - 1 << 8 | sum(scene.begins[at - first : at + 1]) - 1 << 11 | equal + 1 << 27
    return word | sum(turns[at + j] << 19 + j for j in range(count))


def read_node(scene, number, payload):
    """Node `number`: what its slots name, and their boxes."""
    base, leaves, *origin, inner, shifts = struct.unpack_from("<II3HBB", payload, 64 * number)
    planes = struct.unpack_from("<48B", payload, 64 * number + 16)
    shift = (base >> 28, shifts & 15, shifts >> 4)
    base &= 2**28 - 1
    is_top = number < scene.record["top_count"]
    marks = leaves >> 24
    leaves = leaves & 2**24 - 1 if is_top else leaves
    node = Node([], [])
    inners = leaf = 0
    for slot in range(8):
        low, high = planes[slot:24:8], planes[24 + slot :: 8]
        is_inner = inner >> slot & 1
        if is_inner:
            node.children.append(("node", base + inners))
            inners += 1
        elif (low, high) == ((1, 1, 1), (0, 0, 0)):
            node.children.append(("empty",))
            node.boxes.append(None)
            continue
        else:
            child = ("block", leaves + leaf) if is_top else ("run", leaves & 2**24 - 1, (leaves >> 24) + leaf)
            node.children.append(child)
            leaf += 1
        if any(low[axis] > high[axis] for axis in range(3)):
            raise RefusedError("4.4", f"node {number}: slot {slot} has a box inside out")
        node.boxes.append(
            [(origin[x] + (low[x] << shift[x]), origin[x] + (high[x] << shift[x])) for x in range(3)]
        )
    wanted = sum((child[0] == "block") << i for i, child in enumerate(node.children))
    if is_top and marks != wanted:
        raise RefusedError("4.4", f"node {number}: says other leaves than it has")
    if (base and not inners) or (leaves and not leaf) or inners + leaf == 0:
        raise RefusedError("4.4", f"node {number}: base or leaves without such a child, or no child at all")
    return node


def check_nodes(scene):
    """Refuse nodes that do not reach each node, block and run once."""
    top, b = scene.record["top_count"], scene.record["block_count"]
    parents, owners, several = {}, *top_owners(scene)
    home = {top + i: i for i in range(b)}
    for number, node in enumerate(scene.nodes):
        for child in node.children:
            if child[0] == "empty":
                continue
            if child in parents:
                raise RefusedError("4.4", f"node {number}: {child} has two parents")
            parents[child] = number
            if number < top and owners.get(child) != owners[("node", number)]:
                raise RefusedError("4.10", f"node {number}: has a child of another geometry")
            if child[0] == "node" and not number < child[1] < (top if number < top else len(scene.nodes)):
                raise RefusedError("4.4", f"node {number}: an inner child is not where it must be")
            if child[0] == "node" and number >= top:
                home[child[1]] = home.get(number)
            if child[0] == "run" and child[1] != home.get(number):
                raise RefusedError("4.4", f"node {number}: is not a node of block {child[1]}")
    wanted = {("node", i) for i in range(top + b, len(scene.nodes))} | several
    wanted |= {("run", i, j) for i, runs in enumerate(scene.runs or []) for j in range(len(runs))}
    if set(parents) != wanted:
        raise RefusedError("4.4", "a node, block or run has no parent, or should have none")


def top_owners(scene):
    """The geometry of each node over blocks and of each block, and those of them that must have a parent."""
    owners, several = {}, set()
    ends = [row[:2] for row in scene.geometries[1:]]
    ends.append((scene.record["block_count"], scene.record["top_count"]))
    for i, ((block, top, *_), (next_block, next_top)) in enumerate(zip(scene.geometries, ends, strict=True)):
        owners |= {("node", j): i for j in range(top, next_top)}
        owners |= {("block", j): i for j in range(block, next_block)}
        several |= {("node", j) for j in range(top + 1, next_top)}
        several |= {("block", j) for j in range(block, next_block if next_top > top else block)}
    return owners, several


# Section 4.6: the remap


def read_remap(record, payload):
    """`(face, rotation)` of each triangle."""
    n = record["triangle_count"]
    faces = struct.unpack_from(f"<{n}I", payload)
    rotations = [payload[4 * n + t // 4] >> 2 * (t % 4) & 3 for t in range(len(payload[4 * n :]) * 4)]
    if any(face >= record["source_face_count"] for face in faces) or len(set(faces)) < n:
        raise RefusedError("4.6", "a face is not in the source, or is there twice")
    if any(r > 2 for r in rotations[:n]) or any(rotations[n:]):
        raise RefusedError("4.6", "a rotation is not 0, 1 or 2, or an unused bit is set")
    return list(zip(faces, rotations[:n], strict=True))


# Sections 4.7 and 4.8: attributes and materials

ATTRIBUTES = {
    "NORM": ((3,), (0,), (0, 1, 2)),
    "TEXC": ((2,), (0,), (0, 1, 2)),
    "COLR": ((3, 4), (0, 1, 2), (0, 1, 2)),
    "GRUP": ((1,), (3,), (2,)),
}
"""The components, types and domains that an attribute may have."""
LETTERS = "IBHI"
"""What `struct` calls the types; the bits of an f32 stay bits."""


def read_attributes(scene, payload):
    """For each name its domain and the value of each entry."""
    if len(payload) > 256 * (scene.record["triangle_count"] + 1) or len(payload) < 8:
        raise RefusedError("4.7", "more bytes than there may be, or too few")
    count, reserved = struct.unpack_from("<II", payload)
    if not 1 <= count <= 4 or reserved or 8 + 16 * count > len(payload):
        raise RefusedError("4.7", "not 1 to 4 attributes, or a reserved word is set")
    at, found = 8 + 16 * count, {}
    for i in range(count):
        name, *fields = struct.unpack_from("<4sBBBBII", payload, 8 + 16 * i)
        name = name.decode("latin-1")
        if name in found:
            raise RefusedError("4.7", f"{name} is there twice")
        found[name], at = read_attribute(scene, payload, at, name, *fields)
    if at != len(payload):
        raise RefusedError("4.7", "bytes behind the last attribute")
    return found


def read_attribute(scene, payload, at, name, domain, components, kind, width, rows, reserved):
    """The domain and values of one attribute, whose data begin at a byte, and where they end."""
    allowed = ATTRIBUTES.get(name)
    if allowed is None or components not in allowed[0] or kind not in allowed[1] or domain not in allowed[2]:
        raise RefusedError("4.7", f"{name!r}: no such attribute")
    triangles = scene.record["triangle_count"]
    entries = (len(scene.vertices), 3 * triangles, triangles)[domain]
    wanted = 0 if rows == entries else (rows - 1).bit_length()
    if reserved or not 1 <= rows <= entries or width != wanted:
        raise RefusedError("4.7", f"{name}: a reserved word, no or too many rows, or another width")
    layout = struct.Struct(f"<{components}{LETTERS[kind]}")
    middle = at + rows * layout.size
    begin = middle + -middle % 4
    end = begin + 4 * ((width * entries + 31) // 32)
    if end > len(payload):
        raise RefusedError("4.7", f"{name}: the data end too early")
    stream = int.from_bytes(payload[begin:end], "little")
    if any(payload[middle:begin]) or stream >> width * entries:
        raise RefusedError("4.7", f"{name}: an unused bit is set")
    table = list(layout.iter_unpack(payload[at:middle]))
    index = [stream >> width * j & (1 << width) - 1 for j in range(entries)]
    index = list(range(entries)) if rows == entries else index
    check_rows(scene, name, table, index)
    return (domain, [table[i] for i in index]), end


def check_rows(scene, name, table, index):
    """Refuse rows that are not used in the order of their numbers, are there twice, or name no material."""
    largest = -1
    for i in index:
        if i > largest + 1:
            raise RefusedError("4.7", f"{name}: rows are not in the order of their first use")
        largest = max(largest, i)
    if largest != len(table) - 1 or len(set(table)) < len(table):
        raise RefusedError("4.7", f"{name}: an index without a row, a row without an index, or a row twice")
    if name == "GRUP" and any(row[0] >= len(scene.materials) for row in table):
        raise RefusedError("4.7", "a group has no material")


def read_materials(payload):
    """The array of MATL."""
    if len(payload) > 2**22:
        raise RefusedError("4.8", "more than 2^22 bytes")
    materials = read_json("4.8", payload)
    if not isinstance(materials, list) or not 1 <= len(materials) <= 65536:
        raise RefusedError("4.8", "no array of 1 to 65,536 materials")
    for material in materials:
        if not isinstance(material, dict) or not set(material) <= {"name", "base_color", "group"}:
            raise RefusedError("4.8", "no material")
        colour = material.get("base_color")
        names = (material.get("name"), material.get("group", ""))
        if not all(type(name) is str for name in names) or not isinstance(colour, list) or len(colour) != 4:
            raise RefusedError("4.8", "a material without a name or colour, or of another type")
        if not all(type(x) is Number and 0 <= float(x) <= 1 for x in colour):
            raise RefusedError("4.8", "a colour that is not 0 to 1")
        material["base_color"] = [float(x) for x in colour]
    return materials


# Sections 4.10 and 4.11: geometries and instances


def read_geometries(scene, payload):
    """The records of GEOM."""
    if len(payload) % 16 or not len(payload) <= 16 * max(1, scene.record["block_count"]):
        raise RefusedError("4.10", "no whole number of geometries, or more than blocks")
    return list(struct.iter_unpack("<4I", payload))


def check_geometries(scene):
    """Refuse geometries that do not share out blocks, nodes over blocks and source faces."""
    rows, record = scene.geometries, scene.record
    ends = [*rows[1:], (record["block_count"], record["top_count"], record["source_face_count"], 0)]
    if rows[0][:2] != (0, 0):
        raise RefusedError("4.10", "the first geometry does not begin at block 0 and node 0")
    for i, (row, end) in enumerate(zip(rows, ends, strict=True)):
        blocks, tops = end[0] - row[0], end[1] - row[1]
        if blocks < 1 or end[0] > ends[-1][0] or tops < 0 or (tops > 0) != (blocks > 1):
            raise RefusedError("4.10", f"geometry {i} has {blocks} blocks and {tops} nodes over them")
        triangles = scene.block_starts[end[0]] - scene.block_starts[row[0]]
        if row[2] + row[3] > end[2] or row[3] < triangles:
            raise RefusedError("4.10", f"geometry {i}: its source faces are too few or not there")


def check_owners(scene):
    """Refuse triangles that come from source faces of another geometry."""
    first_blocks = [row[0] for row in scene.geometries[1:]] + [scene.record["block_count"]]
    begin = 0
    for (_, _, first, count), end in zip(scene.geometries, first_blocks, strict=True):
        faces = [face for face, _ in scene.remap[begin : scene.block_starts[end]]]
        if any(not first <= face < first + count for face in faces):
            raise RefusedError("4.10", "a triangle comes from a face of another geometry")
        begin = scene.block_starts[end]


def read_instances(scene, payload):
    """For each instance its geometry, its first face and its matrix."""
    if len(payload) % 104 or len(payload) > 104 * 2**24:
        raise RefusedError("4.11", "no whole number of instances, or too many")
    rows = [(row[0], row[1], row[2:]) for row in struct.iter_unpack("<2I12d", payload)]
    if {geometry for geometry, _, _ in rows} != set(range(len(scene.geometries))):
        raise RefusedError("4.11", "an instance without a geometry, or a geometry without an instance")
    least = 0
    for i, (geometry, first_face, matrix) in enumerate(rows):
        check_matrix(scene, i, matrix)
        if first_face < least:
            raise RefusedError("4.11", f"instance {i}: its faces are not behind those before")
        least = first_face + scene.geometries[geometry][3]
    if least > 2**32 - 1:
        raise RefusedError("4.11", "the instances have too many faces")
    return rows


def check_matrix(scene, number, matrix):
    """Refuse a matrix that is not finite, flattens, or reaches too far."""
    if not all(map(math.isfinite, matrix)):
        raise RefusedError("4.11", f"instance {number}: its matrix is not finite")
    if determinant(matrix) == 0:
        raise RefusedError("4.11", f"instance {number}: the determinant of its matrix is zero")
    low, high = scene.record["low"], scene.record["high"]
    x, y, z = (max(abs(low[axis]), abs(high[axis])) for axis in range(3))
    for row in (matrix[:4], matrix[4:8], matrix[8:]):
        a, b, c, d = map(abs, row)
        if not ((a * x + b * y) + c * z) + d <= 2.0**127:
            raise RefusedError("4.11", f"instance {number}: reaches too far")


def determinant(matrix):
    """The determinant of the first three columns, exactly."""
    a, b, c, _, d, e, f, _, g, h, i, _ = map(Fraction, matrix)
    return a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)


def is_identity(matrix):
    """Whether a matrix leaves everything as it is."""
    return tuple(matrix) == (1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0)


def place(vertex, matrix):
    """Where a vertex, three 32-bit patterns, stands by a matrix: three of them again."""
    if is_identity(matrix):
        return vertex
    x, y, z = map(as_float, vertex)
    rows = (matrix[:4], matrix[4:8], matrix[8:])
    moved = [((a * x + b * y) + c * z) + d for a, b, c, d in rows]
    return tuple(int.from_bytes(struct.pack("<f", value), "little") for value in moved)


def placed(scene):
    """The vertices and faces of all instances one after another, and the number of each face."""
    vertices, faces, numbers = [], [], []
    ends = [row[0] for row in scene.geometries[1:]] + [scene.record["block_count"]]
    for geometry, first_face, matrix in scene.instances:
        first_block, _, first, _ = scene.geometries[geometry]
        begin, end = scene.block_starts[first_block], scene.block_starts[ends[geometry]]
        used = sorted({corner for face in scene.faces[begin:end] for corner in face})
        number = {corner: len(vertices) + i for i, corner in enumerate(used)}
        vertices += [place(scene.vertices[corner], matrix) for corner in used]
        for t in range(begin, end):
            a, b, c = (number[corner] for corner in scene.faces[t])
            faces.append([a, c, b] if determinant(matrix) < 0 else [a, b, c])
            numbers.append(first_face + scene.remap[t][0] - first if scene.remap else None)
    return vertices, faces, numbers


# Sections 4.12 and 4.13: a hierarchy of another kind, and plain triangles


def read_triangles(scene, payload):
    """Decode plain triangles into `scene.vertices` and `scene.faces`."""
    n = scene.record["triangle_count"]
    rows = list(struct.iter_unpack("<3I", payload))
    scene.vertices, faces = rows[:-n], rows[-n:]
    scene.faces = [list(face) for face in faces]
    scene.begins = [1] * n
    try:
        check_indices([i for face in faces for i in face], len(scene.vertices))
    except RefusedError as refusal:
        raise RefusedError("4.13", str(refusal)) from None
    if any(len(set(face)) < 3 for face in faces):
        raise RefusedError("4.13", "a triangle names one vertex twice")
    if any(bits >> 23 & 255 == 255 for vertex in scene.vertices for bits in vertex):
        raise RefusedError("4.13", "a coordinate is not finite")


OVER = {1: (0, 1, 2), 2: (0, 1), 3: (0, 1, 2), 4: (0,)}
"""What the objects of each kind may be."""


def read_hierarchy(scene, payload):
    """The hierarchy of HIER."""
    if len(payload) < 64:
        raise RefusedError("4.12", "no whole record")
    kind, over, flags, reserved, count, items, reserved_2 = struct.unpack_from("<4B3I", payload)
    if reserved or reserved_2 or flags > 1 or any(payload[40:64]):
        raise RefusedError("4.12", "a reserved field is not zero")
    if over not in OVER.get(kind, ()) or (flags and kind in (2, 4)):
        raise RefusedError("4.12", "no such kind, or over what it cannot be over")
    bounds = struct.unpack_from("<6I", payload, 16)
    if any(bits >> 23 & 255 == 255 for bits in bounds) if kind == 2 else any(bounds):
        raise RefusedError("4.12", "the cell of the root is not finite, or there and not needed")
    words = 2 if kind == 2 else 8
    if len(payload) != 64 + 4 * words * count + 4 * items or count > 2**28:
        raise RefusedError("4.12", "another length than the counts give it")
    table = struct.unpack_from(f"<{words * count}I", payload, 64)
    nodes = [table[i : i + words] for i in range(0, len(table), words)]
    rest = list(struct.unpack_from(f"<{items}I", payload, 64 + 4 * len(table)))
    found = Hierarchy(kind, over, flags, nodes, rest, bounds)
    starts = object_starts(scene, over)
    if kind in (1, 3):
        wanted = sorted(rest) == list(range(len(starts) - 1)) if flags else not rest
        if not wanted:
            raise RefusedError("4.12", "the order does not name every object once")
    check = {1: check_heap, 2: check_cells, 3: check_places, 4: check_trees}[kind]
    check(found, len(starts) - 1)
    return found


def object_starts(scene, over):
    """The first triangle of each object, and n."""
    n = scene.record["triangle_count"]
    if over == 0:
        return list(range(n + 1))
    return [t for t in range(n) if scene.begins[t]] + [n] if over == 1 else scene.block_starts


def check_heap(found, count):
    """Refuse an SLBVH that does not have each place in one leaf."""
    nodes, size = found.nodes, len(found.nodes)
    if size < 2 or size & (size - 1):
        raise RefusedError("4.12", f"{size} nodes are no heap")
    waiting, reached = [(1, 0, count)], set()
    while waiting:
        number, first, held = waiting.pop()
        a, b = nodes[number][6:]
        reached.add(number)
        if (a >> 3, b) != (held, first) or held == 0:
            raise RefusedError("4.12", f"node {number} does not hold the places that are left to it")
        if a & 3 > (0 if a & 4 else 2):
            raise RefusedError("4.12", f"node {number} has no such axis")
        if not a & 4:
            if 2 * number + 1 >= size:
                raise RefusedError("4.12", f"node {number} has no room for children")
            left = nodes[2 * number][6] >> 3
            waiting += [(2 * number, first, left), (2 * number + 1, first + left, held - left)]
    if any(any(node) for number, node in enumerate(nodes) if number not in reached):
        raise RefusedError("4.12", "a node that is not reached is not zero")


def walk_preorder(nodes, second_of):
    """For each node its number and the numbers of the nodes above it, while they are where they must be."""
    if not nodes:
        raise RefusedError("4.12", "there is no node")
    waiting, above = [(len(nodes), ())], ()
    for number, node in enumerate(nodes):
        if len(above) >= 128 or not waiting:
            raise RefusedError("4.12", f"node {number} is too deep, or below none")
        yield number, above
        second = second_of(node)
        if second is None:
            end, above = waiting.pop()
            if end != number + 1:
                raise RefusedError("4.12", f"node {number} is followed by another than its parent says")
        else:
            above = (*above, number)
            waiting.append((second, above))
    if waiting:
        raise RefusedError("4.12", "a node has no second child")


def second_of_boxes(node):
    """The second child of an inner node with a box, None of a leaf."""
    return None if node[7] else node[6]


def second_of_cells(node):
    """The second child of an inner node of a kd-tree, None of a leaf."""
    return None if node[1] & 3 == 3 else node[1] >> 2


def check_places(found, count):
    """Refuse a BVH that does not have each place in one leaf."""
    numbers = [number for number, _ in walk_preorder(found.nodes, second_of_boxes)]
    leaves = sorted(found.nodes[number][6:] for number in numbers if found.nodes[number][7])
    at = 0
    for first, held in leaves:
        if first != at:
            raise RefusedError("4.12", f"place {min(first, at)} is not in one leaf")
        at += held
    if at != count:
        raise RefusedError("4.12", "not all places are in leaves")


def check_trees(found, count):
    """Refuse trees of presorted triangles that are not those of the leaves."""
    starts = found.items
    if len(starts) < 2 or (len(starts) > 2 and not found.nodes):
        raise RefusedError("4.12", "no tree, or several without a node")
    if starts[0] or starts[-1] != count or any(a >= b for a, b in pairwise(starts)):
        raise RefusedError("4.12", "the trees do not begin one behind the other")
    if found.nodes:
        numbers = [number for number, _ in walk_preorder(found.nodes, second_of_boxes)]
        leaves = [found.nodes[number][6:] for number in numbers if found.nodes[number][7]]
        if leaves != [(a, b - a) for a, b in pairwise(starts)]:
            raise RefusedError("4.12", "the leaves do not have the trees in turn")


def check_cells(found, count):
    """Refuse a kd-tree with planes out of their cells, or leaves that do not have the references in turn."""
    cells, at = {}, 0
    for number, above in walk_preorder(found.nodes, second_of_cells):
        parent = above[-1] if above else None
        cells[number] = cell_of(found, cells.get(parent), parent, number)
        a, b = found.nodes[number]
        axis = b & 3
        if axis < 3 and not cells[number][axis] <= as_float(a) <= cells[number][axis + 3]:
            raise RefusedError("4.12", f"node {number}: its plane is not in its cell")
        if axis == 3:
            references = found.items[at : at + (b >> 2)]
            if a != at or len(references) < b >> 2:
                raise RefusedError("4.12", f"node {number} does not have the references in turn")
            if any(x >= y for x, y in pairwise(references)):
                raise RefusedError("4.12", f"node {number}: its references do not rise")
            at += b >> 2
    if at != len(found.items) or any(item >= count for item in found.items):
        raise RefusedError("4.12", "a reference without a leaf, or to no object")


def cell_of(found, cell, parent, number):
    """The six bounds of a node's cell, which is its parent's, cut."""
    if parent is None:
        return [as_float(bits) for bits in found.bounds]
    a, b = found.nodes[parent]
    cell = list(cell)
    cell[(b & 3) + (3 if number == parent + 1 else 0)] = as_float(a)
    return cell


# Section 4.9: metadata


def read_metadata(payload):
    """The object of META."""
    if len(payload) > 2**20:
        raise RefusedError("4.9", "more than 2^20 bytes")
    metadata = read_json("4.9", payload)
    if not isinstance(metadata, dict):
        raise RefusedError("4.9", "no JSON object")
    if not all(type(metadata.get(name, "")) is str for name in ("generator", "source", "unit")):
        raise RefusedError("4.9", "generator, source or unit is no string")
    return metadata


def read_json(clause, payload):
    """What a section of JSON holds, its numbers as they are written."""
    try:
        text = payload.decode("utf-8")
        check_depth(clause, text)
        return json.loads(text, parse_int=Number, parse_float=Number, parse_constant=refuse_constant)
    except ValueError as error:
        raise RefusedError(clause, f"no JSON in UTF-8: {error}") from None


class Number(str):
    """A number of metadata as it is written: JSON has no limit to its digits."""

    __slots__ = ()


def check_depth(clause, text):
    """Refuse arrays and objects nested too deep, before anything follows them down."""
    depth, in_string, escaped = 0, False, False
    for letter in text:
        if in_string:
            in_string = escaped or letter != '"'
            escaped = letter == "\\" and not escaped
        elif letter == '"':
            in_string = True
        elif letter in "[{":
            depth += 1
        elif letter in "]}":
            depth -= 1
        if depth > MOST_DEEP:
            raise RefusedError(clause, f"nested deeper than {MOST_DEEP}")


def refuse_constant(name):
    """Refuse what Python takes for JSON and JSON does not."""
    raise ValueError(f"{name} is no JSON")


# The command line


def summary(scene):
    """A few lines of what is in the scene."""
    record = scene.record
    kinds = [child[0] for node in scene.nodes for child in node.children]
    facts = {
        "triangles": record["triangle_count"],
        "block vertices": len(scene.vertices),
        "blocks": record["block_count"],
        "nodes": f"{record['node_count']}, {record['top_count']} of them over blocks",
        "boxes": f"stored, {kinds.count('run')} runs" if record["stored"] else "rebuilt by the reader",
        "source faces": record["source_face_count"],
        "low": record["low"],
        "high": record["high"],
        "error bound": record["error_bound"],
        "grid": f"2^{record['grid_exponent']}" if record["grid"] else "none",
        "origin": [record[f"origin_{axis}"] for axis in "xyz"] if record["flags"] & 4 else "none",
        "remap": "yes" if scene.remap else "no",
        "hierarchy": "as section 4.4 has it" if scene.hierarchy is None else f"kind {scene.hierarchy.kind}",
        "geometries": len(scene.geometries),
        "instances": "none" if scene.instances is None else len(scene.instances),
        "attributes": ", ".join(scene.attributes) or "none",
        "materials": ascii(scene.materials),
        "metadata": ascii(scene.metadata),
        "passed over": ascii(scene.passed_over),
    }
    return "".join(f"{name}: {value}\n" for name, value in facts.items())


def wavefront(scene):
    """The text of a Wavefront OBJ, instances where they stand; nine digits give a float32 back."""
    vertices, faces = (scene.vertices, scene.faces) if scene.instances is None else placed(scene)[:2]
    lines = ["v " + " ".join(f"{as_float(bits):.9g}" for bits in vertex) for vertex in vertices]
    lines += ["f " + " ".join(str(corner + 1) for corner in face) for face in faces]
    return "".join(f"{line}\n" for line in lines)


def main(arguments):
    """Run the command line; gives the exit code: 0, 1 for a file that is refused, 2 for a wrong call."""
    options, paths = [a for a in arguments if a == "--obj"], [a for a in arguments if a != "--obj"]
    if len(paths) != 1:
        sys.stderr.write("usage: python reader.py [--obj] FILE\n")
        return 2
    try:
        scene = read(Path(paths[0]).read_bytes())
    except (RefusedError, OSError) as error:
        sys.stderr.write(f"{error}\n")
        return 1
    sys.stdout.write(wavefront(scene) if options else summary(scene))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
