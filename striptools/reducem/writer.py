"""Write a scene file: header, section table, sections on 64-byte places, zeros between them.

The layout and its reasons are in formats/reducem/SPEC.md. The same scene gives the same bytes.
"""

import json
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np

from striptools.hierarchies.packed import PackedNodes
from striptools.mesh.atomic import write_atomically, write_stream
from striptools.reducem import layout
from striptools.reducem.archive import packed, packed_blocks
from striptools.reducem.attributes import encode_columns, encode_materials, section_length
from striptools.reducem.check import check_scene
from striptools.reducem.geometries import encode_geometries, encode_instances
from striptools.reducem.issues import unreadable
from striptools.reducem.plain_triangles import encode_triangles
from striptools.reducem.scene import Remap, Scene
from striptools.reducem.stored_hierarchy import encode_hierarchy, hierarchy_length

__all__ = ["part_sizes", "write_scene"]

Payload = bytes | memoryview


@dataclass(frozen=True)
class _Stored:
    """A section as it is written."""

    section: layout.Section
    codec: int
    raw_length: int
    raw_checksum: int
    payload: Payload


def write_scene(scene: Scene, target: str | Path | IO[bytes], *, archive: bool = False) -> int:
    """Write a scene file.

    Args:
        scene: The scene; every rule of the format is checked first.
        target: A path, written whole or not at all, or a binary stream.
        archive: Pack every section but scene record and instances where that makes it smaller.

    Returns:
        Bytes written.

    Raises:
        LimitError: The scene is larger than the format can hold.
        UnreadableSceneError: It breaks a rule of the format.
        MissingExtraError: An archive is asked for, and its codec is not installed.
        WriteError: The file could not be written whole.
    """
    check_scene(scene)
    sections = [
        _stored(scene, section, payload, archive) for section, payload in _payloads(scene) if len(payload)
    ]

    def write(file: IO[bytes]) -> None:
        for chunk in _chunks(sections):
            file.write(chunk)

    if isinstance(target, str | Path):
        return write_atomically(target, write)
    return write_stream(target, write)


def part_sizes(scene: Scene) -> dict[str, int]:
    """Count the bytes of a scene's file by part, uncompressed, without writing it."""
    totals, packed, lengths = scene.blocks.totals(), scene.packed, _lengths(scene)
    parts: dict[str, int] = dict.fromkeys(layout.PARTS, 0)
    parts["positions"] = -(-totals["position_bits"] // 8)
    parts["connectivity"] = totals["connectivity_bits"] // 8
    parts["block_headers"] = lengths[layout.BLOCK_HEADERS.kind]
    parts["top_level"] = layout.NODE_RECORD.size * packed.top_count
    parts["in_block_hierarchy"] = lengths[layout.NODES.kind] - parts["top_level"] + lengths[layout.RUNS.kind]
    parts["remap"] = lengths[layout.REMAP.kind]
    parts["attributes"] = lengths[layout.ATTRIBUTES.kind] + lengths[layout.MATERIALS.kind]
    parts["instances"] = lengths[layout.GEOMETRIES.kind] + lengths[layout.INSTANCES.kind]
    parts["triangles"] = lengths[layout.TRIANGLES.kind]
    parts["hierarchy"] = lengths[layout.HIERARCHY.kind]
    present = [length for length in lengths.values() if length]
    total = _table_end(len(present)) + sum(map(layout.aligned, present))
    parts["container"] = total - sum(parts.values())
    return parts


def _lengths(scene: Scene) -> dict[bytes, int]:
    packed = scene.packed
    runs = 0 if packed.runs is None else len(packed.runs)
    lengths = layout.section_lengths(
        scene.triangle_count,
        scene.block_count,
        len(packed.nodes),
        runs,
        boxes_stored=packed.runs is not None,
    )
    lengths[layout.BLOCK_DATA.kind] = scene.blocks.words.nbytes
    lengths[layout.ATTRIBUTES.kind] = section_length(scene.columns)
    lengths[layout.MATERIALS.kind] = len(encode_materials(scene.materials))
    lengths[layout.METADATA.kind] = len(_metadata(scene.metadata))
    for section, items in ((layout.GEOMETRIES, scene.geometries), (layout.INSTANCES, scene.instances)):
        record = layout.GEOMETRY if section is layout.GEOMETRIES else layout.INSTANCE
        lengths[section.kind] = 0 if items is None else record.size * len(items)
    lengths[layout.HIERARCHY.kind] = hierarchy_length(scene.hierarchy)
    lengths[layout.TRIANGLES.kind] = 0 if scene.triangles is None else scene.triangles.nbytes
    if scene.remap is None:
        lengths[layout.REMAP.kind] = 0
    return lengths


def _table_end(sections: int) -> int:
    return layout.aligned(layout.HEADER.size + sections * layout.ENTRY.size)


def _chunks(sections: list[_Stored]) -> Iterator[Payload]:
    head = _head(sections)
    yield head + bytes(layout.aligned(len(head)) - len(head))
    for stored in sections:
        yield stored.payload
        yield bytes(layout.aligned(len(stored.payload)) - len(stored.payload))


def _payloads(scene: Scene) -> list[tuple[layout.Section, Payload]]:
    packed = scene.packed
    return [
        (layout.SCENE, _scene_record(scene)),
        (layout.BLOCK_HEADERS, _view(scene.blocks.headers, "<u4")),
        (layout.BLOCK_DATA, _view(scene.blocks.words, "<u4")),
        (layout.NODES, _view(packed.nodes, "<u4")),
        (layout.RUNS, _runs(packed)),
        (layout.REMAP, _remap(scene.remap)),
        (layout.ATTRIBUTES, encode_columns(scene.columns)),
        (layout.MATERIALS, encode_materials(scene.materials)),
        (layout.METADATA, _metadata(scene.metadata)),
        (layout.GEOMETRIES, encode_geometries(scene.geometries)),
        (layout.INSTANCES, encode_instances(scene.instances)),
        (layout.HIERARCHY, encode_hierarchy(scene.hierarchy)),
        (layout.TRIANGLES, encode_triangles(scene.triangles)),
    ]


def _runs(packed: PackedNodes) -> Payload:
    if packed.runs is None:
        return b""
    first_run = _view(packed.first_run, "<u4").tobytes()
    return first_run + bytes(-len(first_run) % layout.ALIGNMENT) + _view(packed.runs, "<u4").tobytes()


def _stored(scene: Scene, section: layout.Section, payload: Payload, archive: bool) -> _Stored:
    checksum = zlib.crc32(payload)
    plain = _Stored(section, layout.CODEC_RAW, len(payload), checksum, payload)
    if not archive or section in layout.RAW:
        return plain
    if section is layout.BLOCK_DATA:
        codec, stored = packed_blocks(scene.blocks, scene.decoded)
    else:
        codec, stored = packed(payload, section.kind)
    if len(stored) >= len(payload):
        return plain
    return _Stored(section, codec, len(payload), checksum, stored)


def _view(array: Any, kind: str) -> memoryview:
    """The bytes of an array, without a copy where it is little endian already."""
    return np.ascontiguousarray(array, kind).reshape(-1).view(np.uint8).data


def _scene_record(scene: Scene) -> bytes:
    packed = scene.packed
    record = np.zeros(1, layout.SCENE_RECORD.dtype)
    record["triangle_count"] = scene.triangle_count
    record["block_count"] = scene.block_count
    record["node_count"] = len(packed.nodes)
    record["top_count"] = packed.top_count
    record["run_count"] = 0 if packed.runs is None else len(packed.runs)
    record["source_face_count"] = scene.source_face_count
    flags = (
        (packed.runs is not None, layout.BOXES_STORED),
        (scene.grid_exponent is not None, layout.ON_GRID),
        (scene.origin is not None, layout.HAS_ORIGIN),
    )
    record["flags"] = sum(bit for there, bit in flags if there)
    record["grid_exponent"] = scene.grid_exponent or 0
    record["error_bound"] = scene.error_bound
    for axis, name in enumerate("xyz"):
        record[f"low_{name}"] = scene.low[axis]
        record[f"high_{name}"] = scene.high[axis]
        record[f"cell_{name}"] = scene.grid.cell[axis]
        record[f"origin_{name}"] = 0.0 if scene.origin is None else scene.origin[axis]
    record["longest_run"] = packed.longest_run
    return record.tobytes()


def _remap(remap: Remap | None) -> bytes:
    if remap is None:
        return b""
    rotation = np.zeros((-(-len(remap.rotation) // 4), 4), np.uint8)
    rotation.reshape(-1)[: len(remap.rotation)] = remap.rotation
    packed = rotation[:, 0] | rotation[:, 1] << 2 | rotation[:, 2] << 4 | rotation[:, 3] << 6
    return _view(remap.face, "<i4").tobytes() + packed.tobytes()


def _metadata(metadata: dict[str, Any]) -> bytes:
    if not metadata:
        return b""
    text = json.dumps(metadata, ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode()
    if len(text) > layout.METADATA_LIMIT:
        raise unreadable("RDM902", "META")
    return text


def _head(sections: list[_Stored]) -> bytes:
    table = np.zeros(len(sections), layout.ENTRY.dtype)
    offset = _table_end(len(sections))
    for entry, stored in zip(table, sections, strict=True):
        entry["kind"] = stored.section.kind
        entry["flags"] = layout.MUST_UNDERSTAND if stored.section.must_understand else 0
        entry["codec"] = stored.codec
        entry["offset"] = offset
        entry["stored_length"] = len(stored.payload)
        entry["raw_length"] = stored.raw_length
        entry["raw_checksum"] = stored.raw_checksum
        entry["stored_checksum"] = zlib.crc32(stored.payload) if stored.codec else stored.raw_checksum
        offset += layout.aligned(len(stored.payload))
    header = np.zeros(1, layout.HEADER.dtype)
    header["magic"] = layout.MAGIC
    header["major"], header["minor"] = layout.VERSION
    header["section_count"] = len(sections)
    header["total_length"] = offset
    before = header.tobytes()[:-4]
    header["checksum"] = zlib.crc32(table.tobytes(), zlib.crc32(before))
    return header.tobytes() + table.tobytes()
