import io
import json
import os
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import book, cube, grid, meshes, sphere

from striptools.errors import LimitError, MissingExtraError, UnreadableMeshError, UsageError, WriteError
from striptools.mesh import io as mesh_io
from striptools.mesh.atomic import write_atomically
from striptools.mesh.io import READ_FORMATS, WRITE_FORMATS, load_mesh, save_mesh
from striptools.mesh.mesh import Mesh
from striptools.mesh.readers import parsed, ply

POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0.5, 2, 0]], np.float32)
SPECIAL = np.array(
    [
        [-0.0, 0.0, 1e-45],
        [-1e-45, 1.1754942e-38, 3.4028235e38],
        [-3.4028235e38, 0.1, 1 / 3],
        [1 + 2**-23, 1e30, -7e-30],
    ],
    np.float32,
)


def bits(array):
    return np.ascontiguousarray(array).view(np.uint32 if array.dtype == np.float32 else np.uint64)


def there_and_back(mesh, file_format):
    stream = io.BytesIO()
    size = save_mesh(mesh, stream, file_format=file_format)
    assert size == len(stream.getvalue())
    stream.seek(0)
    return load_mesh(stream, file_format=file_format)


def read(text, file_format):
    data = text.encode() if isinstance(text, str) else text
    return load_mesh(io.BytesIO(data), file_format=file_format)


@pytest.mark.parametrize("file_format", WRITE_FORMATS)
@given(mesh=meshes())
def test_written_meshes_come_back_bit_for_bit(file_format, mesh):
    back = there_and_back(mesh, file_format)
    found = back.positions.astype(np.float32)
    expected = mesh.positions[mesh.faces]
    real = ~np.isnan(expected)
    np.testing.assert_array_equal(np.isnan(found[back.faces]), ~real)
    np.testing.assert_array_equal(bits(found[back.faces])[real], bits(expected)[real])
    if file_format != "stl":
        np.testing.assert_array_equal(back.faces, mesh.faces)
        assert back.vertex_count == mesh.vertex_count
    if file_format != "obj":
        assert back.positions.dtype == np.float32
    assert back.notes == ()


@pytest.mark.parametrize("file_format", WRITE_FORMATS)
def test_zeros_denormals_and_extremes_come_back_bit_for_bit(file_format):
    mesh = Mesh(SPECIAL, np.array([[0, 1, 2], [1, 3, 2]], np.int32))
    back = there_and_back(mesh, file_format)
    found = back.positions.astype(np.float32)[back.faces]
    np.testing.assert_array_equal(bits(found), bits(SPECIAL[mesh.faces]))


@given(st.lists(st.floats(width=32, allow_nan=False), min_size=9, max_size=9))
def test_obj_digits_bring_back_every_float32(values):
    positions = np.array(values, np.float32).reshape(3, 3)
    back = there_and_back(Mesh(positions, np.array([[0, 1, 2]])), "obj")
    with np.errstate(over="ignore"):
        np.testing.assert_array_equal(bits(back.positions.astype(np.float32)), bits(positions))


@given(st.lists(st.floats(allow_nan=False), min_size=9, max_size=9))
def test_obj_digits_bring_back_every_float64(values):
    positions = np.array(values).reshape(3, 3)
    back = there_and_back(Mesh(positions, np.array([[0, 1, 2]])), "obj")
    np.testing.assert_array_equal(bits(back.positions.astype(np.float64)), bits(positions))


@pytest.mark.parametrize("file_format", WRITE_FORMATS)
def test_the_same_mesh_gives_the_same_bytes(tmp_path, file_format):
    mesh = Mesh(*sphere(1))
    paths = [tmp_path / f"{name}.{file_format}" for name in "ab"]
    sizes = [save_mesh(mesh, path) for path in paths]
    assert paths[0].read_bytes() == paths[1].read_bytes()
    assert sizes == [path.stat().st_size for path in paths]
    assert load_mesh(str(paths[0])).triangle_count == mesh.triangle_count


# ------------------------------------------------------------------------------------- PLY


@st.composite
def ply_files(draw):
    """A PLY file with lists of several lengths, odd columns, extra elements; what is to be read."""
    order = draw(st.sampled_from(["ascii", "binary_little_endian", "binary_big_endian"]))
    sign = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}[order]
    position_type = draw(st.sampled_from(["float", "double"]))
    count_type, index_type = draw(st.sampled_from([("uchar", "int"), ("int", "uint"), ("ushort", "ushort")]))
    lengths = draw(st.lists(st.sampled_from([3, 3, 3, 4, 5, 2, 0]), min_size=1, max_size=12))
    corners = [[draw(st.integers(0, 4)) for _ in range(length)] for length in lengths]
    colours, extra = draw(st.booleans()), draw(st.booleans())
    head = ["ply", f"format {order} 1.0", "comment end_header", "element vertex 5"]
    head += [f"property {position_type} {axis}" for axis in "xyz"]
    head += ["property uchar red"] * colours
    head += ["element other 2", "property list uchar short values"] * extra
    head += [f"element face {len(lengths)}", "property float weight"] * 1
    head += [f"property list {count_type} {index_type} vertex_indices", "property int tag", "end_header"]

    def put(kind, value):
        return f"{value} ".encode() if sign == "=" else np.array(value, sign + ply.SIZES[kind]).tobytes()

    body, end = b"", b"\n" if sign == "=" else b""
    for row in POINTS.tolist():
        body += (
            b"".join(put(position_type, value) for value in row)
            + (put("uchar", 200) if colours else b"")
            + end
        )
    for values in [[7, -7], []] if extra else []:
        body += put("uchar", len(values)) + b"".join(put("short", value) for value in values) + end
    for row in corners:
        body += put("float", 0.5) + put(count_type, len(row))
        body += b"".join(put(index_type, value) for value in row) + put("int", -1) + end
    return ("\n".join(head) + "\n").encode() + body, position_type, corners


@given(ply_files())
def test_ply_of_every_shape_is_read_in_file_order(file):
    data, position_type, corners = file
    expected = [[row[0], row[k], row[k + 1]] for row in corners for k in range(1, len(row) - 1)]
    if not expected:
        with pytest.raises(UnreadableMeshError, match="no triangle"):
            read(data, "ply")
        return
    mesh = read(data, "ply")
    assert mesh.faces.tolist() == expected
    assert mesh.positions.dtype == (np.float32 if position_type == "float" else np.float64)
    np.testing.assert_array_equal(mesh.positions, POINTS)
    short, cut = sum(len(row) < 3 for row in corners), sum(len(row) > 3 for row in corners)
    assert (short > 0) == any(note.startswith(f"{short} face") for note in mesh.notes)
    assert (cut > 0) == any(note.startswith(f"{cut} n-gon") for note in mesh.notes)


@given(meshes())
def test_ply_through_trimesh_equals_the_walk(mesh):
    stream = io.BytesIO()
    save_mesh(mesh, stream, file_format="ply")
    data = stream.getvalue()
    header = ply.parse_header(data)
    fast = ply._through_trimesh(stream, header)
    slow = ply.walk_tables(data[header.end :], header)
    assert fast is not None
    np.testing.assert_array_equal(fast.faces, slow.faces)
    np.testing.assert_array_equal(bits(np.ascontiguousarray(fast.positions)), bits(slow.positions))
    assert fast.notes == slow.notes == ()


def test_ply_with_one_list_of_another_length_but_the_right_size_is_walked():
    # Lengths 3, 2, 4 take the bytes of 3, 3, 3: trimesh alone would read all three as triangles.
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 5\n" + "".join(
        f"property float {axis}\n" for axis in "xyz"
    )
    head += "element face 3\nproperty list uchar uchar vertex_indices\nend_header\n"
    data = head.encode() + POINTS.tobytes() + bytes([3, 0, 1, 2, 2, 0, 1, 4, 0, 1, 2, 3])
    assert read(data, "ply").faces.tolist() == [[0, 1, 2], [0, 1, 2], [0, 2, 3]]


def test_ply_keeps_vertices_whole_where_texture_coordinates_split_them():
    text = "ply\nformat ascii 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    text += "element face 2\nproperty list uchar int vertex_indices\n"
    text += "property list uchar float texcoord\nend_header\n"
    text += "0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 .5 .5 1 0 1 1\n"
    mesh = read(text, "ply")
    assert mesh.vertex_count == 4
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]


def test_ply_bytes_behind_the_last_element_are_noted():
    stream = io.BytesIO()
    save_mesh(Mesh(*cube()), stream, file_format="ply")
    mesh = read(stream.getvalue() + b"more", "ply")
    np.testing.assert_array_equal(mesh.faces, cube()[1])
    assert mesh.notes == ("4 bytes after the last element ignored",)


# ------------------------------------------------------------------------------------- OBJ


def test_obj_objects_groups_and_materials_stay_in_file_order():
    text = "mtllib none.mtl\no a\nv 0 0 0\nv 1 0 0\nv 1 1 0\nusemtl red\nf 1 2 3\no b\nusemtl blue\nv 0 1 0\n"
    text += "f 1 3 4\ng c\nusemtl red\nf 4 3 2\n"
    mesh = read(text, "obj")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [3, 2, 1]]
    assert mesh.vertex_count == 4
    assert mesh.positions.dtype == np.float32


def test_obj_relative_indices_count_from_their_own_line():
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf -3 -2 -1\nv 5 0 0\nv 6 0 0\nv 5 1 0\nf -3 -2 -1\nf 1 -1 2\n"
    assert read(text, "obj").faces.tolist() == [[0, 1, 2], [3, 4, 5], [0, 5, 1]]


def test_obj_corners_of_every_style_are_read():
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nvt 0 0\nvt 1 1\nvn 0 0 1\nf 1/1 2/2 3/1\n"
    text += "f 1//1 2//1 3//1\nf 1/2/1 2/1/1 3/2/1\n"
    mesh = read(text + "  f  3   2/1\t1 # a comment\nfo 1 2 3\nf 1 2 \\\n 3\n", "obj")
    assert mesh.faces.tolist() == [[0, 1, 2]] * 3 + [[2, 1, 0], [0, 1, 2], [0, 1, 2]]
    assert mesh.vertex_count == 3


def test_obj_vertices_with_colours_and_weights_are_read():
    mesh = read("v 0 0 0 1\nv 1 0 0 0.5 0.5 0.5\nv 0 1 0\nf 1 2 3\n", "obj")
    np.testing.assert_array_equal(mesh.positions, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])


def test_obj_polygons_are_cut_in_place_and_noted():
    corners = "".join(f"v {k} {k * k} 0\n" for k in range(6))
    mesh = read(corners + "f 1 2 3\nf 1 2 3 4 5 6\nf 1 2\nf 4 5 6\nf 1 2 3 4\nl 1 2\np 1\n", "obj")
    assert mesh.faces.tolist() == [
        [0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5], [3, 4, 5], [0, 1, 2], [0, 2, 3],
    ]  # fmt: skip
    assert mesh.notes == (
        "2 n-gons cut into 6 triangles",
        "1 face of fewer than 3 corners left out",
        "2 point, line or curve elements left out",
    )


def test_obj_line_ends_and_encodings():
    text = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3"
    for data in (text.replace("\n", "\r\n"), text.replace("\n", "\r"), "﻿" + text):
        assert read(data, "obj").triangle_count == 1
    assert read(text.encode("utf-16"), "obj").triangle_count == 1


def test_text_that_float32_cannot_hold_stays_float64():
    assert read("v 0.1 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3", "obj").positions.dtype == np.float64
    mesh = read("v 1e300 nan inf\nv 1 0 0\nv 0 1 0\nf 1 2 3", "obj")
    np.testing.assert_array_equal(mesh.positions[0], [1e300, np.nan, np.inf])
    assert read("v nan inf -inf\nv 1 0 0\nv 0 1 0\nf 1 2 3", "obj").positions.dtype == np.float32


# ------------------------------------------------------------------------------------- STL, OFF


def test_stl_text_with_several_solids_and_misleading_names():
    facet = "facet normal 0 0 1\n outer loop\n  vertex 0 0 0\n  vertex 1 0 0\n  vertex 0 {} 0\n"
    facet += " endloop\nendfacet\n"
    text = "solid vertex facet\n" + facet.format(1) + facet.format(2) + "endsolid vertex facet\n"
    mesh = read(text + "solid empty\nendsolid empty\nsolid\n" + facet.format(3) + "endsolid\n", "stl")
    assert mesh.triangle_count == 3
    assert mesh.positions[[2, 5, 8], 1].tolist() == [1, 2, 3]
    assert mesh.notes == ("2 solids flattened into one mesh",)


def test_binary_stl_that_begins_with_solid_or_has_bytes_to_spare():
    stream = io.BytesIO()
    save_mesh(Mesh(*cube()), stream, file_format="stl")
    data = stream.getvalue()
    mesh = read(b"solid" + data[5:] + b"!!", "stl")
    assert mesh.notes == ("2 bytes after the last triangle ignored",)
    np.testing.assert_array_equal(mesh.positions[mesh.faces], cube()[0][cube()[1]])


def test_off_polygons_stay_in_file_order():
    text = "# a comment\nCOFF 5 4 0 # counts\n\n" + "".join(
        f"{x} {y} {z} 1 1 1\n" for x, y, z in POINTS.tolist()
    )
    mesh = read(text + "4 0 1 2 3 255 0 0\n3 0 1 2\n2 0 1\n5 0 1 2 3 4\n", "off")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2], [0, 1, 2], [0, 2, 3], [0, 3, 4]]
    assert mesh.notes == (
        "2 n-gons cut into 5 triangles",
        "1 face of fewer than 3 corners left out",
        "the colours of 1 face left out",
    )
    np.testing.assert_array_equal(mesh.positions, POINTS)


# ------------------------------------------------------------------------------------- glTF


def gltf_tree(**changes):
    """Two meshes, a triangle with indices and a strip of four corners, in one buffer."""
    positions = POINTS.astype("<f4").tobytes()
    indices = np.array([2, 1, 0], "<u2").tobytes()
    tree = {
        "asset": {"version": "2.0"},
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]},
            {
                "primitives": [
                    {"attributes": {"POSITION": 2}, "mode": 5},
                    {"attributes": {"POSITION": 0}, "mode": 1},
                ]
            },
        ],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 5, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
            {"bufferView": 0, "componentType": 5126, "count": 4, "type": "VEC3", "byteOffset": 12},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 60}, {"buffer": 0, "byteOffset": 60, "byteLength": 6}],
        "buffers": [{"byteLength": 66, "uri": "data.bin"}],
    }
    return tree | changes, positions + indices


def load_gltf(tmp_path, **changes):
    tree, data = gltf_tree(**changes)
    (tmp_path / "data.bin").write_bytes(data)
    (tmp_path / "model.gltf").write_text(json.dumps(tree))
    return load_mesh(tmp_path / "model.gltf")


def test_gltf_instances_are_flattened_in_node_order(tmp_path):
    nodes = [
        {"children": [2, 1], "translation": [10, 0, 0]},
        {"mesh": 0, "camera": 0},
        {"mesh": 1, "matrix": [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 1, 1]},
        {"mesh": 0, "scale": [-1, 1, 1], "rotation": [0, 0, 2**-0.5, 2**-0.5]},
    ]
    mesh = load_gltf(tmp_path, nodes=nodes, scenes=[{"nodes": []}, {"nodes": [3, 0]}], scene=1)
    turned = np.stack([-POINTS[:, 1], -POINTS[:, 0], POINTS[:, 2]], axis=1)
    np.testing.assert_allclose(mesh.positions[:5], turned, atol=1e-15)
    np.testing.assert_array_equal(mesh.positions[5:9], POINTS[1:] * 2.0 + [10, 0, 1])
    np.testing.assert_array_equal(mesh.positions[9:], np.add(POINTS, [10, 0, 0]))
    # The mirrored instance has its winding turned; the strip alternates.
    assert mesh.faces.tolist() == [[2, 0, 1], [5, 6, 7], [8, 7, 6], [11, 10, 9]]
    assert mesh.positions.dtype == np.float64
    assert mesh.notes == (
        "2 meshes in 3 instances flattened into one, transforms applied",
        "1 primitive of points or lines left out",
        "winding turned in 1 mirrored instance",
    )


def test_gltf_without_transforms_stays_float32(tmp_path):
    mesh = load_gltf(tmp_path, nodes=[{"mesh": 0}], scenes=[{"nodes": [0]}])
    np.testing.assert_array_equal(bits(mesh.positions), bits(POINTS))
    assert "1 mesh outside the scene left out" in mesh.notes


@pytest.mark.parametrize(
    ("nodes", "note"), [([{"mesh": 0}, {"mesh": 1}], "all nodes taken"), ([], "every mesh taken")]
)
def test_gltf_without_a_scene_is_taken_whole(tmp_path, nodes, note):
    mesh = load_gltf(tmp_path, nodes=nodes)
    assert mesh.triangle_count == 3
    assert any(note in one for one in mesh.notes)


def test_gltf_strides_and_normalised_integers(tmp_path):
    rows = np.zeros((3, 4), "<i2")
    rows[:, :3] = [[-32768, 0, 32767], [0, 32767, 0], [1, 2, 3]]
    (tmp_path / "data.bin").write_bytes(rows.tobytes())
    tree, _ = gltf_tree(
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}],
        bufferViews=[{"buffer": 0, "byteLength": 24, "byteStride": 8}],
        buffers=[{"byteLength": 24, "uri": "data.bin"}],
    )
    for normalized, unit in ((True, 32767.0), (False, 1.0)):
        tree["accessors"] = [
            {"bufferView": 0, "componentType": 5122, "count": 3, "type": "VEC3", "normalized": normalized}
        ]
        (tmp_path / "model.gltf").write_text(json.dumps(tree))
        expected = np.maximum(rows[:, :3] / unit, -1.0 if normalized else -np.inf)
        np.testing.assert_array_equal(load_mesh(tmp_path / "model.gltf").positions, expected)


def test_too_many_triangles_after_flattening_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("striptools.mesh.readers.gltf.MOST_FACES", 3)
    with pytest.raises(LimitError, match="4 triangles"):
        load_gltf(tmp_path, nodes=[{"mesh": 1}, {"mesh": 1}], scenes=[{"nodes": [0, 1]}])


def test_flattening_counts_before_it_copies(monkeypatch):
    monkeypatch.setattr(parsed, "MOST_FACES", 3)
    part = parsed.Parsed(POINTS, np.zeros((2, 3), np.int32))
    with pytest.raises(LimitError, match="4 triangles"):
        parsed.flatten([part, part])


# ------------------------------------------------------------------------------------- names and streams


@pytest.mark.parametrize("file_format", ["ply", "stl", "glb", "off", "obj"])
def test_a_stream_without_a_name_shows_its_format(tmp_path, file_format):
    if file_format == "off":
        data = b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    else:
        stream = io.BytesIO()
        save_mesh(Mesh(*book(3)), stream, file_format=file_format)
        data = stream.getvalue()
    if file_format in ("stl", "obj"):
        with pytest.raises(UnreadableMeshError, match="neither name nor content"):
            load_mesh(io.BytesIO(data))
    else:
        assert load_mesh(io.BytesIO(data)).triangle_count in (1, 3)
    path = tmp_path / "model.data"
    path.write_bytes(data)
    assert load_mesh(path, file_format=file_format.upper()).triangle_count in (1, 3)


def test_a_pipe_is_read(tmp_path):
    path = tmp_path / "model.ply"
    save_mesh(Mesh(*grid(3, 3)), path)
    reading, writing = os.pipe()
    with open(writing, "wb") as out:
        out.write(path.read_bytes())
    with open(reading, "rb") as pipe:
        assert load_mesh(pipe).triangle_count == 18


def test_a_missing_file_is_an_error_line(tmp_path):
    with pytest.raises(UnreadableMeshError, match=r"nothing\.ply: cannot be read: No such file") as caught:
        load_mesh(tmp_path / "nothing.ply")
    assert caught.value.exit_code == 3
    with pytest.raises(UnreadableMeshError, match="cannot be read"):
        load_mesh(tmp_path)


def test_unknown_formats_to_write_are_refused(tmp_path):
    with pytest.raises(UsageError, match="no mesh format to write: 3ds"):
        save_mesh(Mesh(*cube()), tmp_path / "a.3ds")
    with pytest.raises(UsageError, match="none given"):
        save_mesh(Mesh(*cube()), io.BytesIO())
    assert set(WRITE_FORMATS) < set(READ_FORMATS)


def test_other_formats_name_the_extra_that_reads_them(monkeypatch):
    monkeypatch.setitem(sys.modules, "pymeshlab", None)
    with pytest.raises(MissingExtraError, match=r"striptools\[meshlab\]"):
        read(b"something", "3ds")


@pytest.mark.parametrize("suffix", ["3ds", "ctm", "dae", "wrl", "x3d"])
def test_other_formats_go_through_pymeshlab(tmp_path, suffix):
    pymeshlab = pytest.importorskip("pymeshlab", reason="the extra meshlab is not installed")
    positions, faces = cube()
    path = tmp_path / f"cube.{suffix}"
    meshes = pymeshlab.MeshSet()
    meshes.add_mesh(pymeshlab.Mesh(positions.astype(np.float64), faces))
    meshes.save_current_mesh(str(path))
    want = sorted(map(sorted, positions[faces].tolist()))
    for mesh in (load_mesh(path), read(path.read_bytes(), suffix)):
        assert sorted(map(sorted, mesh.positions[mesh.faces].tolist())) == want
        assert any("pymeshlab" in note for note in mesh.notes)


def test_what_pymeshlab_cannot_read_is_one_line():
    pytest.importorskip("pymeshlab", reason="the extra meshlab is not installed")
    with pytest.raises(UnreadableMeshError, match="malformed") as error:
        read(b"no model at all", "3ds")
    assert "\n" not in str(error.value)


# ------------------------------------------------------------------------------------- atomic writing


def test_a_failed_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "model.bin"
    path.write_bytes(b"old")

    def interrupted(file):
        file.write(b"half")
        raise KeyboardInterrupt

    def full(file):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    with pytest.raises(KeyboardInterrupt):
        write_atomically(path, interrupted)
    with pytest.raises(WriteError, match=r"model\.bin: could not be written: No space left"):
        write_atomically(path, full)
    assert path.read_bytes() == b"old"
    assert os.listdir(tmp_path) == ["model.bin"]


def test_a_write_replaces_follows_links_and_counts(tmp_path):
    path = tmp_path / "model.bin"
    assert write_atomically(path, b"first") == 5
    link = tmp_path / "link"
    link.symlink_to(path)
    assert write_atomically(link, lambda file: file.write(b"second")) == 6
    assert link.is_symlink()
    assert path.read_bytes() == b"second"
    assert sorted(os.listdir(tmp_path)) == ["link", "model.bin"]


def test_what_cannot_be_written_is_an_error_line(tmp_path):
    for path in (tmp_path, tmp_path / "missing" / "a.ply"):
        with pytest.raises(WriteError) as caught:
            write_atomically(path, b"")
        assert caught.value.exit_code == 3
    assert os.listdir(tmp_path) == []
    assert write_atomically(os.devnull, b"gone") == 4


def test_a_closed_pipe_is_an_error_line():
    reading, writing = os.pipe()
    os.close(reading)
    with pytest.raises(WriteError, match="Broken pipe"), open(writing, "wb", buffering=0) as out:
        save_mesh(Mesh(*cube()), out, file_format="ply")


@pytest.mark.parametrize("name", ["milktruck", "spheres_instanced"])
def test_real_scenes_are_flattened(real_mesh, name):
    mesh = load_mesh(real_mesh(f"scenes/{name}.glb"))
    assert "flattened into one" in mesh.notes[0]
    assert np.isfinite(mesh.positions).all()


def test_readers_are_named_for_every_format():
    assert set(mesh_io.MAGIC.values()) < set(READ_FORMATS)
