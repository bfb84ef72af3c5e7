"""The record tables of the scene file: what stands at which byte. formats/reducem/SPEC.md says why.

All numbers are little endian. A test compares these tables with the specification's.
"""

from dataclasses import dataclass

import numpy as np

MAGIC = b"\x89RDM\r\n\x1a\n"
VERSION = (0, 4)
ALIGNMENT = 64
SECTION_LIMIT = 64
MUST_UNDERSTAND = 1

CODEC_RAW = 0
CODEC_ZSTD = 1
CODEC_BLOCKS = 2
CODEC_PLANES = 3
LARGEST_WINDOW = 27
"""Two to this many bytes is the largest window of a Zstandard frame."""

BOXES_STORED = 1
ON_GRID = 2
HAS_ORIGIN = 4
"""Bits of the scene record's flags."""

BLOCK_FLIPS = 1
"""The bit of a block header's flags that says that there are flip bits."""

SOURCE_FACE_LIMIT = 2**32 - 1
BLOCK_LIMIT = 2**24
NODE_LIMIT = 2**28
BLOCK_TRIANGLES = 256
BLOCK_VERTICES = 256
LONGEST_RUN = 8
LONGEST_EQUAL_TURNS = 30
"""The most equal turn bits in a row within a strip, its first triangle's left out."""

MOST_BLOCK_BYTES = 3936
MOST_BEHIND_BLOCKS = 128
"""The most bytes of a block's data, and of what is behind those of the last one."""

ZERO_WORDS = 16
"""Words of zero after the last block's data."""

GRID_EXPONENTS = range(-149, 105)
CELL_EXPONENTS = range(-149, 128)
INSTANCE_LIMIT = 2**24
METADATA_LIMIT = 2**20
MATERIALS_LIMIT = 2**22
DEEPEST_HIERARCHY = 128
"""The most nodes on a way down a hierarchy of a section of its own."""

ATTRIBUTES_HEAD = 8
"""Bytes before the records of the attributes: how many there are, and a reserved word."""

METADATA_NAMES = ("generator", "source", "unit")


@dataclass(frozen=True)
class Field:
    """A field of a record: its first byte, its bytes, its NumPy type (little endian) and its name."""

    offset: int
    size: int
    kind: str
    name: str


@dataclass(frozen=True)
class Record:
    """A record of fixed size; its fields leave no byte out."""

    name: str
    fields: tuple[Field, ...]

    @property
    def size(self) -> int:
        """Bytes of the record."""
        return self.fields[-1].offset + self.fields[-1].size

    @property
    def dtype(self) -> np.dtype:
        """The record as a packed NumPy type."""
        return np.dtype([(field.name, field.kind) for field in self.fields])


@dataclass(frozen=True)
class Section:
    """A kind of section: its four characters, and whether it must be understood."""

    kind: bytes
    must_understand: bool


def _record(name: str, *fields: tuple[str, str]) -> Record:
    made, offset = [], 0
    for kind, field in fields:
        size = np.dtype(kind).itemsize
        made.append(Field(offset, size, kind, field))
        offset += size
    return Record(name, tuple(made))


def _box(kind: str) -> list[tuple[str, str]]:
    """The fields of a box of such numbers."""
    return [(kind, f"{end}_{axis}") for end in ("low", "high") for axis in "xyz"]


HEADER = _record(
    "file header",
    ("S8", "magic"),
    ("<u2", "major"),
    ("<u2", "minor"),
    ("<u4", "section_count"),
    ("<u8", "total_length"),
    ("<u4", "reserved"),
    ("<u4", "checksum"),
)
ENTRY = _record(
    "section entry",
    ("S4", "kind"),
    ("<u2", "flags"),
    ("<u2", "codec"),
    ("<u8", "offset"),
    ("<u8", "stored_length"),
    ("<u8", "raw_length"),
    ("<u4", "stored_checksum"),
    ("<u4", "raw_checksum"),
)
SCENE_RECORD = _record(
    "scene record",
    ("<u4", "triangle_count"),
    ("<u4", "block_count"),
    ("<u4", "node_count"),
    ("<u4", "top_count"),
    ("<u4", "run_count"),
    ("<u4", "source_face_count"),
    ("u1", "flags"),
    ("u1", "reserved"),
    ("<i2", "grid_exponent"),
    ("<u4", "reserved_2"),
    ("<f8", "error_bound"),
    *_box("<f4"),
    ("<i2", "cell_x"),
    ("<i2", "cell_y"),
    ("<i2", "cell_z"),
    ("<u2", "longest_run"),
    ("<f8", "origin_x"),
    ("<f8", "origin_y"),
    ("<f8", "origin_z"),
)
BLOCK_HEADER = _record(
    "block header",
    ("<u4", "first_triangle"),
    ("<u4", "word"),
    ("u1", "triangles"),
    ("u1", "vertices"),
    ("u1", "strips"),
    ("u1", "flags"),
    ("<i4", "anchor_x"),
    ("<i4", "anchor_y"),
    ("<i4", "anchor_z"),
    ("u1", "axis_x"),
    ("u1", "axis_y"),
    ("u1", "axis_z"),
    ("u1", "exponent_x"),
    ("u1", "exponent_y"),
    ("u1", "exponent_z"),
    ("<u2", "reserved"),
)
NODE_RECORD = _record(
    "node",
    ("<u4", "base"),
    ("<u4", "leaves"),
    ("<u2", "origin_x"),
    ("<u2", "origin_y"),
    ("<u2", "origin_z"),
    ("u1", "inner"),
    ("u1", "shifts"),
    *_box("8u1"),
)
ATTRIBUTE = _record(
    "attribute record",
    ("S4", "name"),
    ("u1", "domain"),
    ("u1", "components"),
    ("u1", "type"),
    ("u1", "width"),
    ("<u4", "rows"),
    ("<u4", "reserved"),
)
GEOMETRY = _record(
    "geometry",
    ("<u4", "first_block"),
    ("<u4", "first_top"),
    ("<u4", "first_face"),
    ("<u4", "face_count"),
)
INSTANCE = _record(
    "instance",
    ("<u4", "geometry"),
    ("<u4", "first_face"),
    ("12<f8", "matrix"),
)
HIERARCHY_RECORD = _record(
    "hierarchy record",
    ("u1", "kind"),
    ("u1", "over"),
    ("u1", "flags"),
    ("u1", "reserved"),
    ("<u4", "node_count"),
    ("<u4", "item_count"),
    ("<u4", "reserved_2"),
    *_box("<f4"),
    ("24u1", "reserved_3"),
)
BOX_NODE = _record(
    "node with a box",
    *_box("<f4"),
    ("<u4", "a"),
    ("<u4", "b"),
)
CELL_NODE = _record("node with a split", ("<u4", "a"), ("<u4", "b"))
RECORDS = (
    *(HEADER, ENTRY, SCENE_RECORD, BLOCK_HEADER, NODE_RECORD, ATTRIBUTE, GEOMETRY, INSTANCE),
    *(HIERARCHY_RECORD, BOX_NODE, CELL_NODE),
)

SCENE = Section(b"SCEN", True)
BLOCK_HEADERS = Section(b"BLKH", True)
BLOCK_DATA = Section(b"BLKD", True)
NODES = Section(b"NODE", True)
RUNS = Section(b"RUNS", True)
GEOMETRIES = Section(b"GEOM", True)
INSTANCES = Section(b"INST", True)
REMAP = Section(b"RMAP", False)
ATTRIBUTES = Section(b"ATTR", False)
MATERIALS = Section(b"MATL", False)
METADATA = Section(b"META", False)
HIERARCHY = Section(b"HIER", True)
TRIANGLES = Section(b"TRIS", True)
SECTIONS = (
    *(SCENE, BLOCK_HEADERS, BLOCK_DATA, NODES, RUNS, REMAP, ATTRIBUTES, MATERIALS, METADATA),
    *(GEOMETRIES, INSTANCES, HIERARCHY, TRIANGLES),
)
"""In the order in which the writer puts them."""

RAW = (SCENE, INSTANCES)
"""Those that must not be packed: what bounds the length of others, and what no count bounds."""

PLANE_WIDTHS = {
    **{BLOCK_HEADERS.kind: 32, NODES.kind: 64, RUNS.kind: 4, REMAP.kind: 4},
    **{HIERARCHY.kind: 4, TRIANGLES.kind: 4},
}
"""Bytes of a record for the kinds of sections that may have the codec of planes."""


def codecs_of(section: Section) -> tuple[int, ...]:
    """The codecs that a section may have."""
    if section in RAW:
        return (CODEC_RAW,)
    if section is BLOCK_DATA:
        return (CODEC_RAW, CODEC_ZSTD, CODEC_BLOCKS)
    return (CODEC_RAW, CODEC_ZSTD) + ((CODEC_PLANES,) if section.kind in PLANE_WIDTHS else ())


PARTS = (
    "positions",
    "connectivity",
    "in_block_hierarchy",
    "block_headers",
    "top_level",
    "remap",
    "attributes",
    "instances",
    "triangles",
    "hierarchy",
    "container",
)
"""What the bytes of a file are counted by; instances are geometries too; container is header, table, scene
record, metadata and padding."""


def aligned(length: int) -> int:
    """Round a length up to the alignment of sections."""
    return -(-length // ALIGNMENT) * ALIGNMENT


def remap_length(triangles: int) -> int:
    """Bytes of the remap of so many triangles."""
    return 4 * triangles + -(-triangles // 4)


def most_attribute_bytes(triangles: int) -> int:
    """The most bytes of the attributes of so many triangles: four kinds with a row a corner, and more."""
    return 256 * (triangles + 1)


def most_hierarchy_bytes(triangles: int) -> int:
    """The most bytes of the hierarchy over so many triangles."""
    return 1024 * (triangles + 1)


def triangle_lengths(triangles: int) -> tuple[int, int]:
    """The least and the most bytes of so many plain triangles: with three vertices, with three for each."""
    return 12 * (triangles + 3), 48 * triangles


def section_lengths(
    triangles: int, blocks: int, nodes: int, runs: int, *, boxes_stored: bool
) -> dict[bytes, int]:
    """Say how long each section of a scene is, decoded, where its counts alone say so; 0 means left out.

    Block data, attributes, materials, metadata, geometries, instances, and whether there is a remap are not
    the counts' matter.
    """
    return {
        SCENE.kind: SCENE_RECORD.size,
        BLOCK_HEADERS.kind: BLOCK_HEADER.size * blocks,
        NODES.kind: NODE_RECORD.size * nodes,
        RUNS.kind: aligned(4 * blocks) + 4 * runs if boxes_stored else 0,
        REMAP.kind: remap_length(triangles),
    }
