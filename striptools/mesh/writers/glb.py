"""GLB with normals, texture coordinates, colours, materials and instances: a primitive a group.

What holds of the file (Khronos glTF 2.0 specification): chunks and accessors begin at multiples of four, rows
of vertex attributes are multiples of four long (3.6.2.4), POSITION has its exact float32 bounds (3.7.2.1).
Values that are not there (NaN) are written as zeros.
"""

from __future__ import annotations

import json
import struct
from typing import Any

import numpy as np

from striptools.mesh.attributes import Attribute, Material
from striptools.mesh.instances import is_identity
from striptools.mesh.mesh import Mesh
from striptools.mesh.writers.split import split_vertices

UNSIGNED_BYTE, UNSIGNED_SHORT, UNSIGNED_INT, FLOAT = 5121, 5123, 5125, 5126
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
COMPONENTS = {"float32": FLOAT, "uint8": UNSIGNED_BYTE, "uint16": UNSIGNED_SHORT}
SEMANTICS = {"normal": "NORMAL", "texcoord": "TEXCOORD_0", "color": "COLOR_0"}


class _Buffer:
    """The binary chunk as it grows, with its views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def add(self, rows: np.ndarray, component: int, target: int, **more: object) -> int:
        """Add an array as an accessor of its own; returns the accessor's number."""
        width = rows.shape[1]
        padded = np.zeros((len(rows), -(-width * rows.itemsize // 4) * 4 // rows.itemsize), rows.dtype)
        padded = padded if target == ARRAY_BUFFER else np.zeros_like(rows)
        padded[:, :width] = rows
        view: dict[str, Any] = {"buffer": 0, "byteOffset": len(self.data), "byteLength": padded.nbytes}
        stride = {"byteStride": padded.shape[1] * rows.itemsize} if target == ARRAY_BUFFER else {}
        self.views.append({**view, **stride, "target": target})
        self.data += padded.astype(padded.dtype.newbyteorder("<")).tobytes()
        self.data += bytes(-len(self.data) % 4)
        self.accessors.append(
            {
                "bufferView": len(self.views) - 1,
                "componentType": component,
                "count": len(rows),
                "type": "SCALAR" if width == 1 else f"VEC{width}",
                **more,
            }
        )
        return len(self.accessors) - 1


def encode_glb(mesh: Mesh) -> bytes:
    """The mesh as a GLB file; its faces are put in the order of their groups, stable within one.

    Geometries become meshes, and instances nodes with matrices.
    """
    buffer = _Buffer()
    nodes: list[dict[str, Any]] = [{"mesh": 0}]
    if mesh.instances is not None:
        nodes = [_node(geometry, matrix) for geometry, matrix in mesh.instances]
    tree: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "striptools"},
        "scene": 0,
        "scenes": [{"nodes": list(range(len(nodes)))}],
        "nodes": nodes,
        "meshes": [{"primitives": _primitives(part, buffer)} for part in mesh.parts()],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    if mesh.attribute("group") is not None:
        tree["materials"] = [_material(one) for one in mesh.materials]
    return _chunks(json.dumps(tree, separators=(",", ":")).encode(), bytes(buffer.data))


def _node(geometry: int, matrix: np.ndarray) -> dict[str, Any]:
    """A node of a mesh where a `(3, 4)` matrix puts it; matrices go by columns."""
    if is_identity(matrix):
        return {"mesh": geometry}
    return {"mesh": geometry, "matrix": np.vstack([matrix, [0, 0, 0, 1]]).T.reshape(-1).tolist()}


def _primitives(mesh: Mesh, buffer: _Buffer) -> list[dict[str, Any]]:
    """The primitives of a plain mesh, a group each."""
    mesh = split_vertices(mesh, ("normal", "texcoord", "color"))
    with np.errstate(all="ignore"):
        positions = mesh.positions.astype(np.float32)
    bounds = {"min": positions.min(axis=0).tolist(), "max": positions.max(axis=0).tolist()}
    accessors = {"POSITION": buffer.add(positions, FLOAT, ARRAY_BUFFER, **bounds)}
    for one in mesh.attributes:
        if one.name in SEMANTICS:
            accessors[SEMANTICS[one.name]] = _add_attribute(buffer, one)
    return [
        {"attributes": accessors, "indices": indices, **({} if group is None else {"material": group})}
        for group, indices in _groups(mesh, buffer)
    ]


def _add_attribute(buffer: _Buffer, one: Attribute) -> int:
    values = np.nan_to_num(one.values) if one.values.dtype.kind == "f" else one.values
    whole = {"normalized": True} if values.dtype.kind == "u" else {}
    return buffer.add(values, COMPONENTS[values.dtype.name], ARRAY_BUFFER, **whole)


def _groups(mesh: Mesh, buffer: _Buffer) -> list[tuple[int | None, int]]:
    """The groups that have faces, each with the accessor of its indices."""
    group = mesh.attribute("group")
    dtype, component = (np.uint16, UNSIGNED_SHORT) if mesh.vertex_count < 2**16 else (np.uint32, UNSIGNED_INT)
    indices = mesh.faces.astype(dtype)
    if group is None:
        return [(None, buffer.add(indices.reshape(-1, 1), component, ELEMENT_ARRAY_BUFFER))]
    numbers = group.values[:, 0]
    order = np.argsort(numbers, kind="stable")
    found, begins = np.unique(numbers[order], return_index=True)
    parts = np.split(order, begins[1:])
    return [
        (int(number), buffer.add(indices[part].reshape(-1, 1), component, ELEMENT_ARRAY_BUFFER))
        for number, part in zip(found, parts, strict=True)
    ]


def _material(one: Material) -> dict[str, Any]:
    colour = {"pbrMetallicRoughness": {"baseColorFactor": list(one.base_color)}}
    return {"name": one.name, **colour} if one.name else colour


def _chunks(text: bytes, data: bytes) -> bytes:
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks
