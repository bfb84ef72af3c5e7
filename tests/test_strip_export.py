"""Strips for rasterisers: structure of the GLB by its own bytes, and every format read back by trimesh."""

import io
import json
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from strategies import clean_meshes, grid, sphere

from striptools.errors import UsageError
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.mesh.strip_glb import encode_strip_glb
from striptools.strips.export import STRIP_FORMATS, StripExport, export_strips
from striptools.strips.topology import classic_strips, decode_classic


def written(export: StripExport) -> bytes:
    stream = io.BytesIO()
    assert export.save(stream) == len(stream.getvalue())
    return stream.getvalue()


def corners(positions: np.ndarray, faces: np.ndarray) -> list[bytes]:
    """The triangles by their positions, turned so that the least corner comes first; no repeated vertices."""
    rows = []
    for face in faces.tolist():
        if len(set(face)) == 3:
            points = [np.asarray(positions[v], np.float32).tobytes() for v in face]
            least = points.index(min(points))
            rows.append(b"".join(points[least:] + points[:least]))
    return sorted(rows)


def taken_apart(data: bytes) -> tuple[dict, bytes]:
    magic, version, length, json_length, json_kind = struct.unpack_from("<4sIIII", data)
    assert (magic, version, length, json_kind) == (b"glTF", 2, len(data), 0x4E4F534A)
    assert json_length % 4 == 0
    binary_length, binary_kind = struct.unpack_from("<II", data, 20 + json_length)
    assert binary_kind == 0x004E4942
    assert binary_length % 4 == 0
    assert 28 + json_length + binary_length == len(data)
    return json.loads(data[20 : 20 + json_length]), data[28 + json_length :]


@pytest.mark.parametrize("file_format", STRIP_FORMATS)
@given(mesh=clean_meshes())
def test_the_library_reads_back_every_triangle_with_its_winding(file_format: str, mesh: Mesh):
    export = export_strips(mesh, file_format)
    back = load_mesh(io.BytesIO(written(export)), file_format=file_format)
    assert corners(back.positions, back.faces) == corners(mesh.positions, mesh.faces)


@pytest.mark.parametrize("file_format", STRIP_FORMATS)
@pytest.mark.parametrize("shape", [grid(7, 5), sphere(3)])
def test_trimesh_reads_back_every_triangle_with_its_winding(file_format: str, shape):
    mesh = Mesh(*shape)
    data = written(export_strips(mesh, file_format))
    scene = trimesh.load(io.BytesIO(data), file_type=file_format, process=False)
    back = scene if isinstance(scene, trimesh.Trimesh) else next(iter(scene.geometry.values()))
    assert corners(back.vertices, back.faces) == corners(mesh.positions, mesh.faces)


@given(clean_meshes(), st.booleans())
def test_the_glb_is_as_the_specification_wants_it(mesh: Mesh, wide: bool):
    if wide:
        padding = np.repeat(mesh.positions[:1], 70_000, axis=0)
        mesh = Mesh(np.concatenate([mesh.positions, padding]), mesh.faces)
    export = export_strips(mesh, "glb")
    tree, binary = taken_apart(written(export))
    primitive = tree["meshes"][0]["primitives"]
    assert primitive == [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 5}]
    views, (place, order) = tree["bufferViews"], tree["accessors"]
    assert [view["target"] for view in views] == [34962, 34963]
    assert tree["buffers"] == [{"byteLength": sum(view["byteLength"] for view in views)}]
    size, kind = (4, "<u4") if wide else (2, "<u2")
    assert order["componentType"] == (5125 if wide else 5123)
    assert views[1]["byteOffset"] % size == 0
    positions = np.frombuffer(binary, "<f4", 3 * place["count"], views[0]["byteOffset"]).reshape(-1, 3)
    indices = np.frombuffer(binary, kind, order["count"], views[1]["byteOffset"])
    assert (place["min"], place["max"]) == (positions.min(axis=0).tolist(), positions.max(axis=0).tolist())
    assert views[0]["byteLength"] == 12 * place["count"]
    assert views[1]["byteLength"] == size * order["count"]
    assert indices.max() < len(positions)
    assert indices.max() < np.iinfo(indices.dtype).max
    assert export.count.indices == order["count"]
    assert corners(positions, decode_classic(indices.astype(np.int32))) == corners(mesh.positions, mesh.faces)


def test_plain_formats_hold_the_faces_in_strip_order_from_their_own_first_corner():
    mesh = Mesh(*sphere(3))
    export = export_strips(mesh, "ply")
    back = load_mesh(io.BytesIO(written(export)), file_format="ply")
    np.testing.assert_array_equal(back.faces, mesh.faces[export.strips.source_face])
    assert export.indices_per_triangle == len(classic_strips(export.strips)) / mesh.triangle_count


def test_a_stitched_export_has_no_restarts_and_asks_for_fewer_strips():
    mesh = Mesh(*sphere(4))
    stitched, apart = export_strips(mesh, "glb"), export_strips(mesh, "ply")
    assert stitched.count.restarts == 0
    assert len(stitched.strips.starts) <= len(apart.strips.starts)
    assert stitched.count.indices == len(classic_strips(stitched.strips, None))


def test_the_same_mesh_gives_the_same_bytes():
    mesh = Mesh(*sphere(4))
    assert written(export_strips(mesh, "glb", threads=1)) == written(export_strips(mesh, "glb", threads=2))


def test_formats_without_strips_are_refused():
    with pytest.raises(UsageError, match="cannot hold strips"):
        export_strips(Mesh(*grid(2, 2)), "off")


def test_the_glb_encoder_refuses_what_is_no_strip():
    positions = np.eye(3, dtype=np.float32)
    for indices in ([0, 1], [0, 1, 3], [0, -1, 2]):
        with pytest.raises(UsageError, match="no strip"):
            encode_strip_glb(positions, np.array(indices, np.int32))
    with pytest.raises(UsageError, match="finite"):
        encode_strip_glb(np.full((3, 3), np.nan, np.float32), np.array([0, 1, 2], np.int32))
