"""The record tables of the scene file: what stands at which byte. formats/reducem/SPEC.md says why.

All numbers are little endian. A test compares these tables with the specification's.
"""

from dataclasses import dataclass

import numpy as np

MAGIC = b"\x89RDM\r\n\x1a\n"
VERSION = (0, 2)
ALIGNMENT = 64
SECTION_LIMIT = 64
TRIANGLE_LIMIT = 2**29
SOURCE_FACE_LIMIT = 2**30
MUST_UNDERSTAND = 1
ROTATION_SHIFT = 30
"""A remap word is the source face in its low 30 bits and the rotation in the two above."""


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
    """A kind of section: its four characters, the part it counts to, and whether it must be understood."""

    kind: bytes
    part: str
    must_understand: bool


HEADER = Record(
    "file header",
    (
        Field(0, 8, "S8", "magic"),
        Field(8, 2, "<u2", "major"),
        Field(10, 2, "<u2", "minor"),
        Field(12, 4, "<u4", "section_count"),
        Field(16, 8, "<u8", "total_length"),
        Field(24, 4, "<u4", "reserved"),
        Field(28, 4, "<u4", "checksum"),
    ),
)
ENTRY = Record(
    "section entry",
    (
        Field(0, 4, "S4", "kind"),
        Field(4, 4, "<u4", "flags"),
        Field(8, 8, "<u8", "offset"),
        Field(16, 8, "<u8", "length"),
        Field(24, 4, "<u4", "checksum"),
        Field(28, 4, "<u4", "reserved"),
    ),
)
SCENE_RECORD = Record(
    "scene record",
    (
        Field(0, 4, "<u4", "triangle_count"),
        Field(4, 4, "<u4", "vertex_count"),
        Field(8, 4, "<u4", "strip_count"),
        Field(12, 4, "<u4", "source_face_count"),
        Field(16, 8, "<f8", "error_bound"),
    ),
)
RECORDS = (HEADER, ENTRY, SCENE_RECORD)

SCENE = Section(b"SCEN", "headers", True)
POSITIONS = Section(b"POSN", "positions", True)
STRIP_VERTICES = Section(b"SVTX", "strip_vertices", True)
TURNS = Section(b"TURN", "turns", True)
FLIPS = Section(b"FLIP", "flips", True)
STRIP_STARTS = Section(b"STRT", "strip_starts", True)
HIERARCHY = Section(b"HIER", "hierarchy", True)
REMAP = Section(b"RMAP", "remap", False)
SECTIONS = (SCENE, POSITIONS, STRIP_VERTICES, TURNS, FLIPS, STRIP_STARTS, HIERARCHY, REMAP)
"""In the order in which the writer puts them."""

PARTS = ("positions", "strip_vertices", "turns", "flips", "strip_starts", "hierarchy", "remap", "headers")


def aligned(length: int) -> int:
    """Round a length up to the alignment of sections."""
    return -(-length // ALIGNMENT) * ALIGNMENT


def section_lengths(
    triangles: int, vertices: int, strips: int, *, flips: bool, remap: bool
) -> dict[bytes, int]:
    """Say how long each section of a scene is; a section of no bytes is left out of the file."""
    return {
        SCENE.kind: SCENE_RECORD.size,
        POSITIONS.kind: 12 * vertices,
        STRIP_VERTICES.kind: 4 * (triangles + 2 * strips),
        TURNS.kind: (triangles + 7) // 8,
        FLIPS.kind: (triangles + 7) // 8 if flips else 0,
        STRIP_STARTS.kind: 4 * (strips + 1),
        HIERARCHY.kind: 28 * (strips - 1),
        REMAP.kind: 4 * triangles if remap else 0,
    }
