"""Write a scene file: header, section table, sections on 64-byte places, zeros between them.

The layout and its reasons are in formats/reducem/SPEC.md. The same scene gives the same bytes.
"""

import zlib
from collections.abc import Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import IO

import numpy as np

from striptools.mesh.atomic import write_atomically, write_stream
from striptools.reducem import layout
from striptools.reducem.check import check_limits, check_scene
from striptools.reducem.scene import Scene

__all__ = ["SectionSizes", "section_sizes", "write_scene"]


@dataclass(frozen=True)
class SectionSizes:
    """Bytes of a scene file by part; `headers` is everything that is in no other, padding included."""

    positions: int
    strip_vertices: int
    turns: int
    flips: int
    strip_starts: int
    hierarchy: int
    remap: int
    headers: int

    @property
    def total(self) -> int:
        """Bytes of the file."""
        return sum(self.parts().values())

    def parts(self) -> dict[str, int]:
        """Bytes by part name."""
        return {field.name: getattr(self, field.name) for field in fields(self)}


def write_scene(scene: Scene, target: str | Path | IO[bytes]) -> SectionSizes:
    """Write a scene file.

    Args:
        scene: The scene; every rule of the format is checked first.
        target: A path, written whole or not at all, or a binary stream.

    Returns:
        Bytes by part.

    Raises:
        LimitError: The scene is larger than the format can hold.
        UnreadableSceneError: It breaks a rule of the format.
        WriteError: The file could not be written whole.
    """
    check_limits(scene)
    check_scene(scene)

    def write(file: IO[bytes]) -> None:
        for chunk in _chunks(scene):
            file.write(chunk)

    if isinstance(target, str | Path):
        write_atomically(target, write)
    else:
        write_stream(target, write)
    return section_sizes(scene)


def section_sizes(scene: Scene) -> SectionSizes:
    """Count the bytes of a scene's file by part, without writing it."""
    lengths = _lengths(scene)
    parts: dict[str, int] = dict.fromkeys(layout.PARTS, 0)
    for section in layout.SECTIONS:
        if section is not layout.SCENE:
            parts[section.part] += lengths.get(section.kind, 0)
    total = _table_end(len(lengths)) + sum(layout.aligned(length) for length in lengths.values())
    parts["headers"] = total - sum(parts.values())
    return SectionSizes(**parts)


def _lengths(scene: Scene) -> dict[bytes, int]:
    lengths = layout.section_lengths(
        scene.triangle_count,
        scene.vertex_count,
        scene.strip_count,
        flips=scene.flips is not None,
        remap=scene.remap is not None,
    )
    return {kind: length for kind, length in lengths.items() if length}


def _table_end(sections: int) -> int:
    return layout.aligned(layout.HEADER.size + sections * layout.ENTRY.size)


def _chunks(scene: Scene) -> Iterator[bytes | memoryview]:
    payloads = {kind: payload for kind, payload in _payloads(scene).items() if payload}
    head = _head(payloads)
    yield head + bytes(_table_end(len(payloads)) - len(head))
    for payload in payloads.values():
        yield payload
        yield bytes(layout.aligned(len(payload)) - len(payload))


def _payloads(scene: Scene) -> dict[bytes, bytes | memoryview]:
    return {
        layout.SCENE.kind: _scene_record(scene),
        layout.POSITIONS.kind: _view(scene.positions, "<f4"),
        layout.STRIP_VERTICES.kind: _view(scene.vertices, "<i4"),
        layout.TURNS.kind: np.packbits(scene.turns, bitorder="little").tobytes(),
        layout.FLIPS.kind: b""
        if scene.flips is None
        else np.packbits(scene.flips, bitorder="little").tobytes(),
        layout.STRIP_STARTS.kind: _view(scene.starts, "<i4"),
        layout.HIERARCHY.kind: scene.hierarchy.boxes.astype("<f4", copy=False).tobytes()
        + scene.hierarchy.left_count.astype("<u4", copy=False).tobytes(),
        layout.REMAP.kind: _remap_words(scene),
    }


def _view(array: np.ndarray, kind: str) -> memoryview:
    """The bytes of an array without a copy; no number in it is negative, so the sign bit is one more bit."""
    return np.ascontiguousarray(array, kind).reshape(-1).view(np.uint8).data


def _scene_record(scene: Scene) -> bytes:
    record = np.zeros(1, layout.SCENE_RECORD.dtype)
    record["triangle_count"] = scene.triangle_count
    record["vertex_count"] = scene.vertex_count
    record["strip_count"] = scene.strip_count
    record["source_face_count"] = scene.source_face_count
    record["error_bound"] = scene.error_bound
    return record.tobytes()


def _remap_words(scene: Scene) -> bytes | memoryview:
    if scene.remap is None:
        return b""
    words = scene.remap.rotation.astype("<u4")
    words <<= layout.ROTATION_SHIFT
    words |= scene.remap.face.view("<u4")
    return _view(words, "<u4")


def _head(payloads: dict[bytes, bytes | memoryview]) -> bytes:
    table = np.zeros(len(payloads), layout.ENTRY.dtype)
    must_understand = {section.kind: section.must_understand for section in layout.SECTIONS}
    offset = _table_end(len(payloads))
    for entry, (kind, payload) in zip(table, payloads.items(), strict=True):
        entry["kind"] = kind
        entry["flags"] = layout.MUST_UNDERSTAND if must_understand[kind] else 0
        entry["offset"] = offset
        entry["length"] = len(payload)
        entry["checksum"] = zlib.crc32(payload)
        offset += layout.aligned(len(payload))
    header = np.zeros(1, layout.HEADER.dtype)
    header["magic"] = layout.MAGIC
    header["major"], header["minor"] = layout.VERSION
    header["section_count"] = len(payloads)
    header["total_length"] = offset
    before = header.tobytes()[:-4]
    header["checksum"] = zlib.crc32(table.tobytes(), zlib.crc32(before))
    return header.tobytes() + table.tobytes()
