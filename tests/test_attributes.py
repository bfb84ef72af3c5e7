import base64
import io
import json
import re

import numpy as np
import pytest
from attributes import MATERIALS, at_faces, attributed_meshes, values_of, with_attributes, words
from hypothesis import given
from hypothesis import strategies as st
from strategies import cube, grid, meshes, sphere

from striptools.errors import StriptoolsError, UsageError
from striptools.mesh.attributes import (
    Attribute,
    Material,
    as_words,
    distinct_rows,
    first_equal,
    join_attributes,
    tidy_name,
    turn_normals,
)
from striptools.mesh.clean import CleanOptions, clean
from striptools.mesh.io import load_mesh, save_mesh, unkept
from striptools.mesh.mesh import Mesh
from striptools.mesh.writers.split import split_vertices

TRIANGLE = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


def read(text, file_format):
    data = text.encode() if isinstance(text, str) else text
    return load_mesh(io.BytesIO(data), file_format=file_format)


def there_and_back(mesh, file_format):
    stream = io.BytesIO()
    save_mesh(mesh, stream, file_format=file_format)
    return read(stream.getvalue(), file_format)


# ------------------------------------------------------------------------------------- rows


@given(st.sampled_from(["normal", "texcoord", "color", "group"]), st.integers(0, 2**32), st.integers(0, 60))
def test_equal_rows_are_found_bit_for_bit(name, seed, rows):
    values = values_of(np.random.default_rng(seed), name, rows)
    known = {}
    expected = [known.setdefault(row.tobytes(), k) for k, row in enumerate(values)]
    assert first_equal(values).tolist() == expected
    unique, number = distinct_rows(values)
    np.testing.assert_array_equal(words(unique[number]), words(values))
    assert len(unique) == len(known)
    assert number.tolist() == [sorted(known.values()).index(k) for k in expected]


def test_rows_are_packed_without_loss():
    assert as_words(np.array([[1, 2, 3, 4]], np.uint8)).tolist() == [[0x04030201, 0, 0]]
    assert as_words(np.array([[1, 2, 3]], np.uint16)).tolist() == [[0x00020001, 3, 0]]
    assert as_words(np.array([[0.0, -0.0, 1, 2]], np.float32)).shape == (1, 4)


@pytest.mark.parametrize(
    ("name", "domain", "values", "reason"),
    [
        ("tangent", "vertex", np.zeros((3, 3), np.float32), "an attribute 'tangent'"),
        ("normal", "edge", np.zeros((3, 3), np.float32), "of a 'edge'"),
        ("normal", "vertex", np.zeros((3, 2), np.float32), "shape"),
        ("normal", "vertex", np.zeros((3, 3)), "float64"),
        ("color", "vertex", np.zeros((3, 3), np.int32), "int32"),
        ("group", "vertex", np.zeros((3, 1), np.int32), "one a face"),
        ("group", "face", np.full((1, 1), -1, np.int32), "from 0 on"),
    ],
)
def test_what_is_no_attribute_is_refused(name, domain, values, reason):
    with pytest.raises(UsageError, match=reason):
        Attribute(name, domain, values)


@pytest.mark.parametrize(
    ("attributes", "reason"),
    [
        ([Attribute("normal", "vertex", np.zeros((4, 3), np.float32))], "4 values of normal for 3 vertices"),
        ([Attribute("texcoord", "corner", np.zeros((1, 2), np.float32))], "for 3 corners"),
        ([Attribute("group", "face", np.ones((1, 1), np.int32))], "group 1 has no material"),
        ([Attribute("color", "face", np.ones((1, 3), np.uint8))] * 2, "two attributes of one name"),
    ],
)
def test_attributes_must_fit_their_mesh(attributes, reason):
    with pytest.raises(UsageError, match=reason):
        Mesh(np.eye(3, dtype=np.float32), np.array([[0, 1, 2]]), (), tuple(attributes), (Material(),))


def test_joining_fills_in_what_a_part_lacks():
    normals = Attribute("normal", "vertex", np.ones((2, 3), np.float32))
    bytes_ = Attribute("color", "vertex", np.full((2, 3), 51, np.uint8))
    floats = Attribute("color", "vertex", np.zeros((1, 4), np.float32))
    joined, notes = join_attributes([(2, 1, [normals, bytes_]), (1, 1, [floats])])
    assert np.isnan(joined[0].values[2]).all()
    np.testing.assert_array_equal(joined[1].values, np.float32([[0.2, 0.2, 0.2, 1]] * 2 + [[0, 0, 0, 0]]))
    assert notes == ("1 of 2 parts have no normal",)


def test_names_are_tidied():
    assert tidy_name(" a\x1b[31m\nb ") == "a [31m b"
    assert len(tidy_name("x" * 1000)) == 120


def test_normals_turn_by_the_inverse_transpose():
    normals = np.array([[0, 0, 1], [1, 1, 0], [np.nan] * 3], np.float32)
    turned = turn_normals(normals, np.diag([2.0, 1.0, 1.0]))
    np.testing.assert_allclose(turned[:2], [[0, 0, 1], [1 / np.sqrt(5), 2 / np.sqrt(5), 0]], rtol=1e-7)
    assert np.isnan(turned[2]).all()
    np.testing.assert_array_equal(turn_normals(normals[:1], np.diag([1.0, 1.0, -1.0])), [[0, 0, -1]])
    assert turn_normals(normals[:2], np.diag([1.0, 1.0, 0.0]))[0].tolist() == [0, 0, 1]


# ------------------------------------------------------------------------------------- cleaning


@given(attributed_meshes(), st.booleans(), st.sampled_from([0.0, 0.01, 1e9]))
def test_every_kept_corner_keeps_its_values(mesh, drop_duplicates, weld):
    cleaned = clean(mesh, CleanOptions(weld, drop_duplicates))
    assert [one.name for one in cleaned.mesh.attributes] == [one.name for one in mesh.attributes]
    for one in mesh.attributes:
        kept = at_faces(mesh, one.name)[cleaned.source_face]
        np.testing.assert_array_equal(at_faces(cleaned.mesh, one.name), kept)
    assert cleaned.mesh.materials == mesh.materials
    assert cleaned.mesh.unit == "mm"
    plain = clean(Mesh(mesh.positions, mesh.faces), CleanOptions(weld, drop_duplicates))
    np.testing.assert_array_equal(plain.mesh.faces, cleaned.mesh.faces)
    assert plain.counts == {k: v for k, v in cleaned.counts.items() if k != "vertices_with_seams"}


@given(meshes(hostile=False), st.integers(0, 2**32))
def test_soup_finds_the_domain_of_its_vertices_again(mesh, seed):
    known = clean(mesh).mesh
    known = with_attributes(known, seed, ["normal"], {"normal": "vertex"})
    normals = known.attribute("normal").values
    normals[:] = np.random.default_rng(seed).normal(size=normals.shape)
    soup = Mesh(
        known.positions[known.faces].reshape(-1, 3),
        np.arange(known.faces.size).reshape(-1, 3),
        attributes=(Attribute("normal", "vertex", normals[known.faces.reshape(-1)]),),
    )
    cleaned = clean(soup)
    assert cleaned.mesh.attribute("normal").domain == "vertex"
    assert cleaned.counts["vertices_with_seams"] == 0


def test_welding_vertices_of_differing_normals_keeps_both():
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0], [0, 0, 0], [0, 0, 1]], np.float32)
    normals = np.array([[0, 0, 1]] * 3 + [[0, 1, 0]] * 3, np.float32)
    uv = np.zeros((6, 2), np.float32)
    mesh = Mesh(
        positions,
        np.array([[0, 1, 2], [3, 4, 5]]),
        attributes=(Attribute("normal", "vertex", normals), Attribute("texcoord", "vertex", uv)),
    )
    cleaned = clean(mesh)
    # The normals differ at a seam, but are one a face, which takes fewer rows than one a corner.
    normal = cleaned.mesh.attribute("normal")
    assert (normal.domain, normal.values.tolist()) == ("face", [[0, 0, 1], [0, 1, 0]])
    assert cleaned.mesh.attribute("texcoord").domain == "vertex"
    assert cleaned.counts["vertices_with_seams"] == 2


def test_dropped_faces_take_their_values_along():
    positions, faces = grid(2, 2)
    faces = np.concatenate([faces[:3], [[0, 0, 1]], faces[3:]])
    values = np.arange(len(faces), dtype=np.uint8)[:, None].repeat(3, axis=1)
    cleaned = clean(Mesh(positions, faces, attributes=(Attribute("color", "face", values),)))
    assert cleaned.mesh.attribute("color").values[:, 0].tolist() == [0, 1, 2, 4, 5, 6, 7, 8]


# ------------------------------------------------------------------------------------- PLY, OFF, STL

PLY = """ply
format ascii 1.0
comment TextureFile a.png
element vertex 4
property float x
property float y
property float z
property float nx
property float ny
property double nz
property uchar red
property uchar green
property uchar blue
property uchar alpha
property float quality
element face 2
property list uchar int vertex_indices
property list uchar float texcoord
property int flags
end_header
0 0 0 0 0 1 255 0 0 255 0.5
1 0 0 0 0 1 0 255 0 255 0.5
1 1 0 0 0 1 0 0 255 255 0.5
0 1 0 0 0 1 9 9 9 0 0.5
4 0 1 2 3 8 0 0 1 0 1 1 0 1 7
3 0 2 3 6 .5 .5 1 0 1 1 8
"""


def test_ply_columns_are_kept_and_corners_carried_through_polygons():
    mesh = read(PLY, "ply")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 2, 3]]
    assert mesh.attribute("normal").values.tolist() == [[0, 0, 1]] * 4
    colour = mesh.attribute("color")
    assert (colour.domain, colour.values.dtype, colour.values[3].tolist()) == (
        "vertex",
        np.uint8,
        [9, 9, 9, 0],
    )
    texcoord = mesh.attribute("texcoord")
    assert texcoord.domain == "corner"
    assert texcoord.values.reshape(-1, 6).tolist() == [
        [0, 0, 1, 0, 1, 1], [0, 0, 1, 1, 0, 1], [0.5, 0.5, 1, 0, 1, 1],
    ]  # fmt: skip
    assert mesh.notes[1:] == (
        "2 properties left out: vertex quality, face flags",
        "1 texture left out: a.png",
    )


def test_ply_colours_of_faces_give_way_to_those_of_vertices():
    text = PLY.replace("property int flags", "property uchar red\nproperty uchar green\nproperty uchar blue")
    text = text.replace(" 7\n", " 1 2 3\n").replace(" 8\n", " 4 5 6\n")
    assert "3 of" not in "".join(read(text, "ply").notes)
    assert "face red, face green, face blue" in read(text, "ply").notes[1]
    faces = read(text.replace("uchar alpha", "int alpha").replace("vertex", "vertex", 1), "ply")
    assert faces.attribute("color").values.shape[1] == 3
    lone = text.replace("property uchar red\n", "property uchar rot\n", 1)
    colour = read(lone, "ply").attribute("color")
    assert (colour.domain, colour.values.tolist()) == ("face", [[1, 2, 3], [1, 2, 3], [4, 5, 6]])


def test_ply_columns_that_make_no_sense_are_named():
    text = PLY.replace("float nx", "int nx").replace("255 0.5", "999 0.5", 1)
    mesh = read(text, "ply")
    assert mesh.attribute("normal") is None
    assert mesh.attribute("color") is None
    assert "9 properties left out: vertex nx, vertex ny" in mesh.notes[1]
    text = PLY.replace("8 0 0 1 0 1 1 0 1 7", "2 0 0 7")
    assert read(text, "ply").attribute("texcoord") is None


@pytest.mark.parametrize("domains", [{}, {"color": "face"}, {"color": "vertex"}, {"texcoord": "vertex"}])
@given(mesh=meshes(hostile=False), seed=st.integers(0, 2**32))
def test_ply_brings_back_what_corners_carry(domains, mesh, seed):
    mesh = with_attributes(mesh, seed, ("normal", "texcoord", "color"), domains)
    back = there_and_back(mesh, "ply")
    np.testing.assert_array_equal(back.positions[back.faces], mesh.positions[mesh.faces])
    for name in ("normal", "texcoord", "color"):
        np.testing.assert_array_equal(at_faces(back, name), at_faces(mesh, name))


def test_ply_through_trimesh_equals_the_walk_with_columns():
    mesh = with_attributes(Mesh(*sphere(1)), 7, ("normal", "texcoord", "color"), {"texcoord": "corner"})
    stream = io.BytesIO()
    save_mesh(mesh, stream, file_format="ply")
    from striptools.mesh.readers import ply

    header = ply.parse_header(stream.getvalue())
    fast = ply._through_trimesh(stream, header)
    slow = ply.walk_tables(stream.getvalue()[header.end :], header)
    assert fast.notes == slow.notes == ()
    assert len(fast.attributes) == 3
    for one, two in zip(fast.attributes, slow.attributes, strict=True):
        assert (one.name, one.domain) == (two.name, two.domain)
        np.testing.assert_array_equal(words(one.values), words(two.values))


def test_ply_holds_doubles_where_positions_are_that():
    positions = np.array([[0.1, 0, 0], [1e7 + 0.1, 0, 0], [0, 1, 0]])
    back = there_and_back(Mesh(positions, np.array([[0, 1, 2]])), "ply")
    assert back.positions.tolist() == positions.tolist()


def test_off_columns_are_kept():
    rows = "".join(f"{x} {y} 0 0 0 1 {c} 0 0 255 .5 .25\n" for x, y, c in ((0, 0, 1), (1, 0, 2), (0, 1, 255)))
    mesh = read(f"STCNOFF\n3 1 0\n{rows}3 0 1 2\n", "off")
    assert mesh.attribute("normal").values.tolist() == [[0, 0, 1]] * 3
    assert mesh.attribute("texcoord").values.tolist() == [[0.5, 0.25]] * 3
    assert mesh.attribute("color").values.tolist() == [[1, 0, 0, 255], [2, 0, 0, 255], [255, 0, 0, 255]]
    mesh = read("OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n1 1 0\n4 0 1 2 3 0.5 0 0\n3 0 1 2 0 1 0\n", "off")
    assert mesh.attribute("color").values.tolist() == [[0.5, 0, 0], [0.5, 0, 0], [0, 1, 0]]
    mesh = read("COFF\n3 1 0\n0 0 0 300 0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "off")
    assert mesh.notes == ("the color of 3 vertices left out: not one for each",)


def test_stl_attribute_bytes_are_noted():
    stream = io.BytesIO()
    save_mesh(Mesh(*cube()), stream, file_format="stl")
    data = bytearray(stream.getvalue())
    data[84 + 48] = 1
    assert read(bytes(data), "stl").notes == ("the attribute bytes of 1 facet left out",)


# ------------------------------------------------------------------------------------- OBJ


def test_obj_corners_carry_their_values():
    text = TRIANGLE + "v 1 1 0\nvt 0 0\nvt 1 1 9\nvt .5\nvn 0 0 1\nvn 0 1 0\n"
    text += "f 1/1/1 2/2/1 4/-1/-1 3/1\nf 1//2 2 3/1/\n"
    mesh = read(text, "obj")
    nan = [np.nan] * 3
    np.testing.assert_array_equal(
        mesh.attribute("normal").values,
        [[0, 0, 1], [0, 0, 1], [0, 1, 0], [0, 0, 1], [0, 1, 0], nan, [0, 1, 0], nan, nan],
    )
    np.testing.assert_array_equal(
        mesh.attribute("texcoord").values,
        [[0, 0], [1, 1], [0.5, 0], [0, 0], [0.5, 0], [0, 0], nan[:2], nan[:2], [0, 0]],
    )
    assert mesh.notes == ("1 n-gon cut into 2 triangles", "further numbers of 1 texcoord left out")


@pytest.mark.parametrize(
    ("lines", "note"),
    [
        ("vn 0 0 1\nf 1//9 2//1 3//1\n", "1 corner names a normal that does not exist"),
        ("vn 0 0 1\nf 1//-9 2//-1 3//-1\n", "1 corner names a normal that does not exist"),
        ("vn 0 zero 1\nf 1//1 2//1 3//1\n", "1 normal left out: one makes no sense"),
        ("vn 0 1\nf 1//1 2//1 3//1\n", "1 normal left out: one makes no sense"),
        ("vn 0 0 1\nf 1//a 2//1 3//1\n", "the faces name them in no known way"),
        ("v 0 0 1 .5 .5 .5\nf 1 2 3\n", "the colours of 1 vertex left out"),
        ("mtllib none.mtl\nusemtl a\nf 1 2 3\n", "1 material file left out: none.mtl"),
    ],
)
def test_obj_values_that_make_no_sense_are_noted(lines, note):
    mesh = read(TRIANGLE + lines, "obj")
    assert mesh.triangle_count == 1
    assert note in "; ".join(mesh.notes)


def test_obj_groups_and_materials(tmp_path):
    (tmp_path / "a.mtl").write_text(
        "newmtl red\nKd 1 0 0\nd 0.5\nmap_Kd a.png\nnewmtl odd\nKd 7 x\nTr 0.25\nnewmtl grey\nKd .5\n"
    )
    text = (
        TRIANGLE
        + "mtllib a.mtl\nf 1 2 3\no car\nusemtl red\nf 1 2 3\ng wheel\nf 1 3 2\nusemtl odd\nf 2 1 3\n"
    )
    (tmp_path / "a.obj").write_text(text + "o car\nusemtl red\nf 3 2 1\nusemtl grey\nf 3 2 1\n")
    mesh = load_mesh(tmp_path / "a.obj")
    assert mesh.attribute("group").values[:, 0].tolist() == [0, 1, 2, 3, 1, 4]
    assert mesh.materials == (
        Material(),
        Material("red", (1.0, 0.0, 0.0, 0.5), "car"),
        Material("red", (1.0, 0.0, 0.0, 0.5), "car/wheel"),
        Material("odd", (1.0, 1.0, 1.0, 0.75), "car/wheel"),
        Material("grey", (0.5, 0.5, 0.5, 1.0), "car"),
    )
    assert mesh.notes == ("1 texture of materials left out",)


def test_an_obj_reads_no_materials_outside_its_folder(tmp_path):
    (tmp_path / "a.mtl").write_text("newmtl a\nKd 1 0 0\n")
    (tmp_path / "in").mkdir()
    path = tmp_path / "in" / "a.obj"
    path.write_text(TRIANGLE + "mtllib ../a.mtl\nusemtl a\nf 1 2 3\n")
    mesh = load_mesh(path)
    assert mesh.materials == (Material("a"),)
    assert mesh.notes == ("1 material file left out: ../a.mtl",)


@given(mesh=meshes(hostile=False), seed=st.integers(0, 2**32))
def test_obj_brings_back_what_corners_carry(mesh, seed):
    mesh = with_attributes(mesh, seed)
    for one in mesh.attributes:
        if one.name in ("normal", "texcoord"):
            one.values[~np.isfinite(one.values).all(axis=1)] = np.nan
    back = there_and_back(mesh, "obj")
    np.testing.assert_array_equal(back.faces, mesh.faces)
    for name in ("normal", "texcoord"):
        expected = at_faces(mesh, name)
        if back.attribute(name) is None:
            assert np.isnan(mesh.attribute(name).values).all()
        else:
            np.testing.assert_array_equal(at_faces(back, name), expected)
    groups = [back.materials[k] for k in back.attribute("group").values[:, 0]]
    want = [mesh.materials[k] for k in mesh.attribute("group").values[:, 0]]
    assert [(one.name, one.group) for one in groups] == [
        (one.name or "default", one.group or "default") for one in want
    ]


def test_obj_materials_lie_beside_it(tmp_path):
    mesh = with_attributes(Mesh(*cube()), 3, ["group"])
    save_mesh(mesh, tmp_path / "a.obj")
    back = load_mesh(tmp_path / "a.obj")
    assert {one.name: one.base_color for one in back.materials}["red"] == (1, 0, 0, 1)


def test_obj_colours_of_vertices():
    values = np.array([[0, 51, 255]] * 8, np.uint8)
    mesh = Mesh(*cube(), attributes=(Attribute("color", "vertex", values),))
    back = there_and_back(mesh, "obj").attribute("color")
    np.testing.assert_array_equal(back.values, np.float32([[0, 0.2, 1]] * 8))


# ------------------------------------------------------------------------------------- glTF


@given(mesh=meshes(hostile=False), seed=st.integers(0, 2**32))
def test_glb_brings_back_what_corners_carry(mesh, seed):
    mesh = with_attributes(mesh, seed)
    for one in mesh.attributes:
        if one.values.dtype.kind == "f":
            one.values[~np.isfinite(one.values)] = 0
    back = there_and_back(mesh, "glb")
    groups = mesh.attribute("group").values[:, 0]
    order = np.argsort(groups, kind="stable")
    np.testing.assert_array_equal(back.positions[back.faces], mesh.positions[mesh.faces][order])
    for name in ("normal", "texcoord", "color"):
        np.testing.assert_array_equal(at_faces(back, name), at_faces(mesh, name)[order])
    found = [back.materials[k] for k in back.attribute("group").values[:, 0]]
    assert found == [Material(MATERIALS[k].name, MATERIALS[k].base_color) for k in groups[order]]
    assert back.unit == "m"


def glb_tree(**changes):
    """A triangle with a normal, a colour of bytes, a small texture coordinate and a tangent."""
    arrays = [
        np.eye(3, dtype="<f4"),
        np.tile(np.float32([0, 0, 1]), (3, 1)),
        np.array([[255, 0, 51, 255]] * 3, np.uint8),
        np.array([[65535, 0]] * 3, "<u2"),
    ]
    kinds = [(5126, "VEC3"), (5126, "VEC3"), (5121, "VEC4"), (5123, "VEC2")]
    data, views, accessors = b"", [], []
    for k, (array, (component, shape)) in enumerate(zip(arrays, kinds, strict=True)):
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": array.nbytes})
        more = {"normalized": True} if component != 5126 else {}
        accessors.append({"bufferView": k, "componentType": component, "count": 3, "type": shape, **more})
        data += array.tobytes()
    attributes = {"POSITION": 0, "NORMAL": 1, "COLOR_0": 2, "TEXCOORD_0": 3, "TANGENT": 1, "TEXCOORD_1": 3}
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0, 1]}],
        "nodes": [{"mesh": 0}, {"mesh": 0, "scale": [1, 1, -2]}],
        "meshes": [{"primitives": [{"attributes": attributes, "material": 1}]}],
        "materials": [{"name": "unused"}, {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 0.5]}}],
        "textures": [{}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data), "uri": "a.bin"}],
    }
    return tree | changes, data


def load_tree(tmp_path, tree, data):
    (tmp_path / "a.bin").write_bytes(data)
    (tmp_path / "a.gltf").write_text(json.dumps(tree))
    return load_mesh(tmp_path / "a.gltf")


def test_gltf_attributes_are_placed_with_their_instances(tmp_path):
    mesh = load_tree(tmp_path, *glb_tree())
    assert mesh.attribute("normal").values.tolist() == [[0, 0, 1]] * 3 + [[0, 0, -1]] * 3
    assert mesh.attribute("color").values.tolist() == [[255, 0, 51, 255]] * 6
    assert mesh.attribute("texcoord").values.tolist() == [[1, 0]] * 6
    assert mesh.materials == (Material("", (1.0, 0.0, 0.0, 0.5)),)
    assert mesh.notes[-2:] == (
        "left out: TANGENT of 1 primitive, TEXCOORD_1 of 1 primitive",
        "1 texture left out",
    )


@pytest.mark.parametrize(
    "change",
    [
        {"count": 2},
        {"componentType": 5125},
        {"type": "MAT4"},
        {"bufferView": 99},
        {"byteOffset": 10**9},
        {"sparse": {}},
    ],
)
def test_gltf_attributes_that_are_malformed_are_left_out(tmp_path, change):
    tree, data = glb_tree()
    tree["accessors"][1] |= change
    mesh = load_tree(tmp_path, tree, data)
    assert mesh.attribute("normal") is None
    assert "left out: NORMAL of 1 primitive, TANGENT" in mesh.notes[-2]


def test_gltf_materials_that_are_malformed_are_white(tmp_path):
    factors = [[2, 0, 0, 1], ["a", 0, 0, 1], [1], {}]
    tree, data = glb_tree(
        materials=[{"pbrMetallicRoughness": {"baseColorFactor": one}} for one in factors] + [7]
    )
    primitive = tree["meshes"][0]["primitives"][0]
    tree["meshes"][0]["primitives"] = [primitive | {"material": k} for k in (0, 1, 2, 3, 4, 5, "x", -1)]
    assert load_tree(tmp_path, tree, data).materials == (Material(),)


# ------------------------------------------------------------------------------------- writing


def test_splitting_leaves_whole_what_needs_no_split():
    mesh = with_attributes(Mesh(*sphere(1)), 5, ["normal", "color"], {"normal": "vertex", "color": "face"})
    assert split_vertices(mesh, ["normal"]) is mesh
    one = Attribute("color", "face", np.zeros((mesh.triangle_count, 3), np.uint8))
    same = Mesh(mesh.positions, mesh.faces, (), (one,))
    np.testing.assert_array_equal(split_vertices(same, ["color"]).faces, mesh.faces)


def test_what_a_format_cannot_hold_is_said():
    mesh = with_attributes(Mesh(*cube()), 5, domains={"color": "corner"})
    assert unkept(mesh, "ply") == ("groups and materials",)
    assert unkept(mesh, "obj") == ("colors",)
    assert unkept(mesh, "glb") == ("names of groups",)
    assert unkept(mesh, "stl") == ("normals", "texcoords", "colors", "groups and materials")
    assert unkept(Mesh(np.eye(3) * 0.1, np.array([[0, 1, 2]])), "stl") == (
        "what float32 cannot hold of the positions",
    )


# ------------------------------------------------------------------------------------- damage


def attributed(file_format):
    """A small file of a format with every attribute that it can hold."""
    if file_format == "gltf":
        tree, data = glb_tree()
        uri = "data:;base64," + base64.b64encode(data).decode()
        return json.dumps(tree | {"buffers": [{"byteLength": len(data), "uri": uri}]}).encode()
    if file_format == "off":
        rows = "".join(f"{x} {y} 0 0 0 1 {x} 0 0 255 .5 .25\n" for x, y in ((0, 0), (1, 0), (0, 1)))
        return f"STCNOFF\n3 1 0\n{rows}3 0 1 2 1 2 3\n".encode()
    mesh = with_attributes(Mesh(*cube()), 5, domains={"color": "vertex", "texcoord": "corner"})
    stream = io.BytesIO()
    save_mesh(mesh, stream, file_format=file_format)
    return stream.getvalue()


KINDS = {name: attributed(name) for name in ("ply", "obj", "glb", "gltf", "off")} | {"ascii": PLY.encode()}


@given(st.sampled_from(sorted(KINDS)), st.data())
def test_damage_ends_in_a_mesh_or_an_error_line(kind, data):
    damaged = bytearray(KINDS[kind])
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    if data.draw(st.booleans()):
        del damaged[data.draw(st.integers(0, len(damaged) - 1)) :]
    try:
        mesh = read(bytes(damaged), {"ascii": "ply"}.get(kind, kind))
    except StriptoolsError as refusal:
        error = str(refusal)
    else:
        assert clean(mesh).counts["faces_in"] > 0
        return
    assert "\n" not in error
    assert not re.search(r"malformed: \w+(Error|Exception) ", error), "an exception that no reader foresaw"
