"""Write a GLB file whose one mesh is one primitive of mode TRIANGLE_STRIP.

Written here and not through trimesh, which writes triangles only and would merge vertices. What holds of the
file (Khronos glTF 2.0 specification): the JSON chunk is padded with blanks, the binary one with zeros, to
multiples of four (4.4.3); every accessor begins at a multiple of its component (3.6.2.4); POSITION has its
exact float32 min and max (3.7.2.1); no index is the largest of its type, which would restart the strip
(3.7.2.1); the views say what they are for (3.6.2.3).
"""

import json
import struct

import numpy as np

from striptools.errors import UsageError
from striptools.types import Counts, Positions

UNSIGNED_SHORT, UNSIGNED_INT, FLOAT = 5123, 5125, 5126
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
TRIANGLE_STRIP = 5

_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942


def encode_strip_glb(positions: Positions, indices: Counts) -> bytes:
    """A GLB file of one triangle strip.

    Args:
        positions: (v, 3) float32, finite.
        indices: (k,) int32, k >= 3, of one strip; restarts do not exist in glTF 2.0.

    Raises:
        UsageError: No triangle, an index out of range, or a position that is not finite.
    """
    if len(indices) < 3 or indices.min() < 0 or indices.max() >= len(positions):
        raise UsageError("no strip of these positions", where="encode_strip_glb")
    if not np.isfinite(positions).all():
        raise UsageError("a position is not finite", where="encode_strip_glb", remedy="clean the mesh first")
    short = len(positions) <= 0xFFFF
    index_bytes = indices.astype("<u2" if short else "<u4").tobytes()
    position_bytes = positions.astype("<f4").tobytes()
    tree = _tree(positions, len(indices), len(index_bytes), short=short)
    chunks = _chunk(_JSON_CHUNK, json.dumps(tree, separators=(",", ":")).encode(), b" ")
    chunks += _chunk(_BINARY_CHUNK, position_bytes + index_bytes, b"\0")
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def _tree(positions: Positions, count: int, index_bytes: int, *, short: bool) -> dict[str, object]:
    size = 12 * len(positions)
    return {
        "asset": {"version": "2.0", "generator": "striptools"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": TRIANGLE_STRIP}]}],
        "accessors": [
            {
                "bufferView": 0,
                "componentType": FLOAT,
                "count": len(positions),
                "type": "VEC3",
                "min": positions.min(axis=0).tolist(),
                "max": positions.max(axis=0).tolist(),
            },
            {
                "bufferView": 1,
                "componentType": UNSIGNED_SHORT if short else UNSIGNED_INT,
                "count": count,
                "type": "SCALAR",
            },
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": size, "target": ARRAY_BUFFER},
            {"buffer": 0, "byteOffset": size, "byteLength": index_bytes, "target": ELEMENT_ARRAY_BUFFER},
        ],
        "buffers": [{"byteLength": size + index_bytes}],
    }


def _chunk(kind: int, data: bytes, padding: bytes) -> bytes:
    data += padding * (-len(data) % 4)
    return struct.pack("<II", len(data), kind) + data
