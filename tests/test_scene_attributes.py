"""Attributes, materials, origin and unit of scenes: what comes back, what it costs, what is refused."""

import io
import json
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from attributes import MATERIALS, at_faces, attributed_meshes, with_attributes, words
from hypothesis import assume, given
from hypothesis import strategies as st
from strategies import cube, grid, sphere

from striptools.errors import LimitError, UnreadableMeshError, UnreadableSceneError
from striptools.mesh.attributes import Attribute, Material
from striptools.mesh.clean import CleanOptions, clean
from striptools.mesh.io import load_mesh, save_mesh
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert, convert_with_report
from striptools.reducem import layout
from striptools.reducem.attributes import (
    Column,
    decode_columns,
    encode_columns,
    encode_materials,
    index_width,
)
from striptools.reducem.quantize import PrecisionOptions
from striptools.reducem.reader import read_scene
from striptools.reducem.validate import validate


def saved(scene, **how):
    stream = io.BytesIO()
    scene.save(stream, **how)
    return stream.getvalue()


def again(scene):
    return read_scene(saved(scene))


def assert_same_corners(back, mesh, source_face):
    """Every corner of every face that is left has the attribute values of the source's, bit for bit."""
    for one in mesh.attributes:
        np.testing.assert_array_equal(at_faces(back, one.name), at_faces(mesh, one.name)[source_face])


@given(attributed_meshes(), st.sampled_from([None, 8, 12]), st.booleans())
def test_every_corner_survives_the_file_bit_for_bit(mesh, bits, drop_duplicates):
    options = Options(
        clean=CleanOptions(drop_duplicates=drop_duplicates), precision=PrecisionOptions(bits=bits), threads=1
    )
    try:
        scene = again(convert(mesh, options))
    except UnreadableMeshError:
        return
    assert validate(saved(scene)) == []
    back = scene.to_mesh()
    assert_same_corners(back, mesh, np.sort(scene.remap.face))
    assert back.unit == "mm"
    assert back.materials == (mesh.materials if mesh.attribute("group") is not None else ())
    if bits is None:
        cleaned = clean(mesh, options.clean).mesh
        assert [one.domain for one in back.attributes] == [one.domain for one in cleaned.attributes]


@given(attributed_meshes(hostile=False), st.integers(0, 2**32))
def test_a_scene_gives_the_values_of_its_own_triangles(mesh, seed):
    assume(clean(mesh).mesh.triangle_count)
    scene = convert(mesh, Options(threads=1))
    assert saved(scene) == saved(convert(mesh, Options(threads=2)))
    back = (np.arange(3) - scene.remap.rotation[:, None]) % 3
    for one in scene.attributes:
        here = words(one.at_corners(scene.faces())).reshape(scene.triangle_count, 3, -1)
        turned = np.take_along_axis(here, back[:, :, None], axis=1)
        np.testing.assert_array_equal(turned, at_faces(mesh, one.name)[scene.remap.face])


def test_without_a_remap_attributes_follow_the_decoded_triangles():
    mesh = with_attributes(Mesh(*sphere(2)), 4)
    scene = again(convert(mesh, Options(remap=False)))
    back = scene.to_mesh()
    with_remap = convert(mesh)
    for one in scene.attributes:
        expected = words(one.at_corners(scene.faces())).reshape(scene.triangle_count, 3, -1)
        np.testing.assert_array_equal(at_faces(back, one.name), expected)
        other = next(two for two in with_remap.attributes if two.name == one.name)
        np.testing.assert_array_equal(words(one.values), words(other.values))


def test_plain_scenes_have_no_section_for_what_they_lack():
    scene = convert(Mesh(*sphere(2)))
    data = saved(scene)
    assert b"ATTR" not in data
    assert b"MATL" not in data
    assert scene.part_bytes()["attributes"] == 0
    assert scene.attributes == ()
    assert scene.to_mesh().attributes == ()
    assert scene.origin is None


def test_geometry_only_leaves_the_rest_out_and_says_so():
    mesh = with_attributes(Mesh(*sphere(2)), 4)
    scene, report = convert_with_report(mesh, Options(geometry_only=True))
    assert report.notes == ("left out: normals, texcoords, colors, groups and materials",)
    plain = convert(Mesh(*sphere(2), unit="mm"))
    assert saved(scene) == saved(plain)


def test_bytes_of_attributes_are_a_part_of_their_own():
    mesh = with_attributes(Mesh(*sphere(2)), 4)
    scene, plain = convert(mesh), convert(mesh, Options(geometry_only=True))
    parts = scene.part_bytes()
    assert sum(parts.values()) == len(saved(scene))
    assert parts["attributes"] > 0
    by_name = scene.attribute_bytes()
    assert list(by_name) == ["normal", "texcoord", "color", "group"]
    heads = 8 + 16 * 4 + len(encode_materials(scene.materials))
    assert sum(by_name.values()) + heads == parts["attributes"]
    without = sum(v for k, v in parts.items() if k not in ("remap", "attributes"))
    assert scene.bytes_per_triangle() == without / scene.triangle_count
    # All that attributes add to the geometry's own figure is two rows of the section table and padding.
    assert abs(parts["container"] - plain.part_bytes()["container"]) <= 2 * 40 + 3 * 64


def test_rows_are_stored_once_and_numbers_as_narrow_as_can_be():
    assert [index_width(rows, 12) for rows in (1, 2, 3, 5, 12)] == [0, 1, 2, 3, 0]
    assert index_width(1, 1) == 0
    positions, faces = grid(20, 20)
    one = Attribute("normal", "vertex", np.tile(np.float32([0, 0, 1]), (len(positions), 1)))
    scene = convert(Mesh(positions, faces, attributes=(one,)))
    assert scene.attribute_bytes() == {"normal": 12}


def test_archives_hold_attributes_too():
    pytest.importorskip("zstandard", reason="the extra archive is not installed")
    scene = convert(with_attributes(Mesh(*sphere(3)), 4))
    packed = read_scene(saved(scene, archive=True))
    assert saved(packed) == saved(scene)


# ------------------------------------------------------------------------------------- formats


def test_an_obj_with_seams_comes_back(tmp_path):
    positions, faces = sphere(2)
    seams = with_attributes(
        Mesh(positions, faces), 9, ["normal", "texcoord", "group"], {"normal": "vertex", "texcoord": "corner"}
    )
    for one in seams.attributes:
        if one.name != "group":
            one.values[~np.isfinite(one.values).all(axis=1)] = np.nan
    save_mesh(seams, tmp_path / "in.obj")
    loaded = load_mesh(tmp_path / "in.obj")
    scene = again(convert(tmp_path / "in.obj"))
    assert {one.name: one.domain for one in scene.attributes}["normal"] == "vertex"
    save_mesh(scene.to_mesh(), tmp_path / "back.obj")
    back = load_mesh(tmp_path / "back.obj")
    for name in ("normal", "texcoord"):
        np.testing.assert_array_equal(at_faces(back, name), at_faces(seams, name))
    named = [[one.materials[k] for k in one.attribute("group").values[:, 0]] for one in (loaded, back)]
    assert named[0] == named[1]


@pytest.mark.parametrize("domain", ["vertex", "face"])
def test_ply_colours_come_back(tmp_path, domain):
    mesh = with_attributes(Mesh(*sphere(2)), 11, ["color"], {"color": domain})
    save_mesh(mesh, tmp_path / "in.ply")
    save_mesh(again(convert(tmp_path / "in.ply")).to_mesh(), tmp_path / "back.ply")
    back = load_mesh(tmp_path / "back.ply")
    assert back.attribute("color").domain == domain
    np.testing.assert_array_equal(at_faces(back, "color"), at_faces(mesh, "color"))


def test_a_glb_with_two_materials_comes_back(tmp_path):
    positions, faces = cube()
    groups = np.repeat([[0], [1]], 6, axis=0).astype(np.int32)
    materials = (Material("red", (1.0, 0.0, 0.0, 1.0)), Material("glass", (0.5, 0.5, 1.0, 0.25)))
    mesh = Mesh(positions, faces, (), (Attribute("group", "face", groups),), materials)
    save_mesh(mesh, tmp_path / "in.glb")
    scene = again(convert(tmp_path / "in.glb"))
    assert scene.materials == materials
    assert scene.unit == "m"
    save_mesh(scene.to_mesh(), tmp_path / "back.glb")
    back = load_mesh(tmp_path / "back.glb")
    assert back.materials == materials
    np.testing.assert_array_equal(back.attribute("group").values, groups)


# ------------------------------------------------------------------------------------- origin


def survey():
    positions, faces = grid(12, 12)
    random = np.random.default_rng(1)
    return Mesh(positions * 100.0 + random.random(positions.shape) + (4.5e5, 5.4e6, 300.0), faces)


@pytest.mark.parametrize("bits", [None, 16])
def test_a_survey_comes_back_about_its_origin(bits):
    mesh = survey()
    scene, report = convert_with_report(mesh, Options(precision=PrecisionOptions(bits=bits)))
    np.testing.assert_array_equal(report.origin, scene.origin)
    opened = again(scene)
    np.testing.assert_array_equal(opened.origin, scene.origin)
    assert opened.error_bound == scene.error_bound > 0
    back = opened.to_mesh()
    assert back.positions.dtype == np.float64
    away = back.positions[back.faces] - mesh.positions[mesh.faces]
    assert np.linalg.norm(away, axis=2).max() <= opened.error_bound
    if bits is None:
        assert opened.error_bound < 1e-4


def test_a_tracer_says_in_which_frame_it_works():
    from striptools.trace import Tracer

    mesh = survey()
    scene = again(convert(mesh))
    tracer = Tracer(scene)
    np.testing.assert_array_equal(tracer.origin, scene.origin)
    corners = mesh.positions[mesh.faces[17]]
    above = corners.mean(axis=0) + np.array([0.0, 0.0, 64.0])
    hits = tracer.closest_hit((above - tracer.origin)[None], np.array([[0.0, 0.0, -1.0]]))
    assert hits.face.tolist() == [17]
    assert hits.t[0] == pytest.approx(64.0, abs=1e-3)
    np.testing.assert_array_equal(Tracer(convert(Mesh(*cube()))).origin, np.zeros(3))


def test_a_recentred_scene_is_verified_against_its_source():
    from striptools.measure.verify import VerifyOptions, verify

    mesh = survey()
    report = verify(again(convert(mesh)), mesh, VerifyOptions(rays=64, aimed_rays=512))
    assert report.ok
    assert report.aimed_certain > 0


def test_an_origin_may_be_forbidden():
    scene = convert(survey(), Options(clean=CleanOptions(recentre="never")))
    assert scene.origin is None
    assert scene.to_mesh().positions.dtype == np.float32


@pytest.mark.parametrize("origin", [[0.0, 0.0, 0.0], [1.0, np.nan, 0.0], [np.inf, 0.0, 0.0]])
def test_what_is_no_origin_is_refused(origin):
    scene = replace(convert(Mesh(*cube())), origin=np.array(origin))
    with pytest.raises(UnreadableSceneError, match="RDM209"):
        scene.save(io.BytesIO())


def test_an_origin_without_its_flag_is_refused():
    data = bytearray(saved(convert(Mesh(*cube()))))
    at = struct.unpack_from("<Q", data, 32 + 8)[0]
    struct.pack_into("<d", data, at + 72, -0.0)
    with pytest.raises(UnreadableSceneError, match="RDM209"):
        read_scene(mended(data))


# ------------------------------------------------------------------------------------- what is refused


def mended(data):
    """The file with its checksums made to fit again."""
    data = bytearray(data)
    count = struct.unpack_from("<I", data, 12)[0]
    for at in range(32, 32 + 40 * count, 40):
        offset, length = struct.unpack_from("<QQ", data, at + 8)
        struct.pack_into("<II", data, at + 32, *[zlib.crc32(data[offset : offset + length])] * 2)
    struct.pack_into("<I", data, 28, zlib.crc32(data[32 : 32 + 40 * count], zlib.crc32(data[:28])))
    return bytes(data)


def put(scene, kind, payload):
    """The scene's file with other bytes in a section; the section left out where there are none."""
    data = saved(scene)
    count = struct.unpack_from("<I", data, 12)[0]
    sections = []
    for at in range(32, 32 + 40 * count, 40):
        name, flags = data[at : at + 4], struct.unpack_from("<H", data, at + 4)[0]
        offset, length = struct.unpack_from("<QQ", data, at + 8)
        sections.append((name, flags, payload if name == kind else data[offset : offset + length]))
    if kind not in {name for name, _, _ in sections}:
        sections.append((kind, 0, payload))
    sections = [one for one in sections if one[2]]
    table, body, end = b"", b"", layout.aligned(32 + 40 * len(sections))
    for name, flags, bytes_ in sections:
        entry = struct.pack("<4sHHQQQII", name, flags, 0, end, len(bytes_), len(bytes_), 0, 0)
        table, body = table + entry, body + bytes_ + bytes(-len(bytes_) % 64)
        end += layout.aligned(len(bytes_))
    head = data[:12] + struct.pack("<IQII", len(sections), end, 0, 0)
    return mended((head + table).ljust(end - len(body), b"\0") + body)


def section(scene, kind):
    data = saved(scene)
    for at in range(32, 32 + 40 * struct.unpack_from("<I", data, 12)[0], 40):
        if data[at : at + 4] == kind:
            offset, length = struct.unpack_from("<QQ", data, at + 8)
            return bytearray(data[offset : offset + length])
    raise AssertionError(kind)


def coloured(seed=2, names=("color",), domain="face"):
    positions, faces = cube()
    values = np.arange(36, dtype=np.uint8).reshape(12, 3) // 6
    colour = Attribute("color", domain, values)
    group = Attribute("group", "face", np.arange(12, dtype=np.int32)[:, None] % 3)
    found = tuple(one for one in (colour, group) if one.name in names)
    return convert(Mesh(positions, faces, (), found, MATERIALS if "group" in names else ()))


SPOILED = {
    "another name": ("RDM521", 8, b"TANG"),
    "another domain": ("RDM521", 12, b"\3"),
    "too few components": ("RDM521", 13, b"\2"),
    "another type": ("RDM521", 14, b"\3"),
    "no such type": ("RDM521", 14, b"\4"),
    "another width": ("RDM523", 15, b"\7"),
    "no rows": ("RDM523", 16, b"\0"),
    "more rows than faces": ("RDM523", 16, b"\x0d"),
    "a reserved word": ("RDM107", 20, b"\1"),
    "a reserved head": ("RDM107", 4, b"\1"),
    "no attribute": ("RDM521", 0, b"\0"),
    "far too many": ("RDM521", 0, b"\xff\xff\xff\xff"),
}


@pytest.mark.parametrize(("code", "at", "data"), SPOILED.values(), ids=SPOILED.keys())
def test_spoiled_records_are_refused(code, at, data):
    scene = coloured()
    raw = section(scene, b"ATTR")
    raw[at : at + len(data)] = data
    with pytest.raises(UnreadableSceneError, match=code):
        read_scene(put(scene, b"ATTR", bytes(raw)))


def test_spoiled_values_are_refused():
    scene = coloured()
    (column,) = scene.columns
    assert (len(column.rows), column.width) == (6, 3)
    cases = [
        ("RDM524", replace(column, numbers=np.r_[column.numbers[:-1], [7]].astype(np.int32))),
        ("RDM525", replace(column, numbers=column.numbers[::-1].copy())),
        ("RDM525", replace(column, numbers=np.minimum(column.numbers, 4))),
        ("RDM526", replace(column, rows=np.r_[column.rows[:-1], column.rows[:1]])),
    ]
    for code, spoiled in cases:
        with pytest.raises(UnreadableSceneError, match=code):
            read_scene(put(scene, b"ATTR", encode_columns([spoiled])))
        with pytest.raises(UnreadableSceneError, match=code):
            replace(scene, columns=(spoiled,)).save(io.BytesIO())
    twice = encode_columns([column, column])
    with pytest.raises(UnreadableSceneError, match="RDM521"):
        read_scene(put(scene, b"ATTR", twice))


@pytest.mark.parametrize(("at", "code"), [(-1, "RDM527"), (24 + 19, "RDM527")])
def test_unused_bits_are_refused(at, code):
    scene = coloured()
    raw = section(scene, b"ATTR")
    # 6 rows of 3 bytes are filled up by two, 12 numbers of 3 bits by 28 bits.
    raw[at] |= 0x80
    with pytest.raises(UnreadableSceneError, match=code):
        read_scene(put(scene, b"ATTR", bytes(raw)))


@pytest.mark.parametrize("change", [b"", b"\0\0\0\0"])
def test_another_length_is_refused(change):
    scene = coloured()
    raw = section(scene, b"ATTR")
    with pytest.raises(UnreadableSceneError, match="RDM522"):
        read_scene(put(scene, b"ATTR", bytes(raw + change) if change else bytes(raw[:-4])))
    with pytest.raises(UnreadableSceneError, match="RDM114"):
        read_scene(put(scene, b"ATTR", bytes(256 * 13 + 1)))


def test_groups_and_materials_need_each_other():
    scene = coloured(names=("color", "group"))
    with pytest.raises(UnreadableSceneError, match="RDM113"):
        read_scene(put(scene, b"MATL", b""))
    with pytest.raises(UnreadableSceneError, match="RDM528"):
        read_scene(put(scene, b"MATL", encode_materials(MATERIALS[:2])))
    for lone in (coloured(), convert(Mesh(*cube()))):
        with pytest.raises(UnreadableSceneError, match="RDM117"):
            read_scene(put(lone, b"MATL", encode_materials(MATERIALS)))


MALFORMED = [
    b"{}",
    b"[]",
    b"[1]",
    b"\xff",
    b'[{"name": "a"}]',
    b'[{"name": 1, "base_color": [0, 0, 0, 1]}]',
    b'[{"name": "a", "base_color": [0, 0, 0]}]',
    b'[{"name": "a", "base_color": [0, 0, 0, 2]}]',
    b'[{"name": "a", "base_color": [0, 0, 0, true]}]',
    b'[{"name": "a", "base_color": [0, 0, 0, NaN]}]',
    b'[{"name": "a", "base_color": [0, 0, 0, 1], "group": 1}]',
    b'[{"name": "a", "base_color": [0, 0, 0, 1], "more": 1}]',
    b"[" * 100 + b"]" * 100,
]


@pytest.mark.parametrize("text", MALFORMED)
def test_malformed_materials_are_refused(text):
    scene = coloured(names=("group",))
    with pytest.raises(UnreadableSceneError, match="RDM531"):
        read_scene(put(scene, b"MATL", text))


def test_materials_beyond_the_limit_are_refused():
    scene = coloured(names=("group",))
    with pytest.raises(UnreadableSceneError, match="RDM532"):
        read_scene(put(scene, b"MATL", b" " * (2**22 + 1)))
    with pytest.raises(LimitError, match="are too many"):
        encode_materials((Material("x" * 100),) * 50_000)
    assert json.loads(encode_materials(MATERIALS))[0] == {
        "name": "red", "base_color": [1.0, 0.0, 0.0, 1.0], "group": "body",
    }  # fmt: skip


def test_more_groups_than_a_scene_holds_are_left_out_with_a_word():
    positions, faces = cube()
    groups = Attribute("group", "face", np.arange(12, dtype=np.int32)[:, None])
    materials = tuple(Material(f"{k}" * 100) for k in range(12)) + (Material("x" * 110),) * 40_000
    scene, report = convert_with_report(Mesh(positions, faces, (), (groups,), materials))
    assert scene.attributes == ()
    assert report.notes == ("groups left out: 40012 materials are too many",)


def test_a_broken_attribute_leaves_the_geometry_readable():
    from striptools.pipeline import open as open_scene

    scene = coloured()
    raw = section(scene, b"ATTR")
    raw[8] = 0
    opened = open_scene(io.BytesIO(put(scene, b"ATTR", bytes(raw))))
    np.testing.assert_array_equal(opened.faces(), scene.faces())
    with pytest.raises(UnreadableSceneError, match="RDM521"):
        opened.check()


@given(st.integers(1, 70_000), st.integers(1, 40_000), st.integers(0, 2**32))
def test_numbers_of_every_width_come_back(count, rows, seed):
    rows = min(rows, count)
    random = np.random.default_rng(seed)
    numbers = np.sort(np.r_[np.arange(rows), random.integers(0, rows, count - rows)]).astype(np.int32)
    table = np.arange(rows, dtype=np.int32)[:, None]
    column = Column("group", "face", table, numbers)
    raw = np.frombuffer(encode_columns([column]), np.uint8)
    (back,) = decode_columns(raw, {"vertex": 0, "corner": 0, "face": count}, "here")
    np.testing.assert_array_equal(back.numbers, numbers)
    np.testing.assert_array_equal(back.rows, table)
    assert len(raw) == 8 + 16 + column.byte_count


# ------------------------------------------------------------------------------------- the command line


@pytest.fixture
def told(run):
    """Run a command that succeeds: all that it writes."""

    def call(*arguments):
        code, out, err = run(*arguments)
        assert code == 0, err
        return out + err

    return call


def test_the_command_line_keeps_attributes_or_says_what_it_leaves_out(tmp_path, told):
    mesh = with_attributes(Mesh(*sphere(1)), 3, domains={"color": "vertex"})
    save_mesh(mesh, tmp_path / "a.ply")
    said = told("convert", tmp_path / "a.ply", tmp_path / "a.rdm", "-v")
    assert "  attributes " in said
    facts = json.loads(told("info", tmp_path / "a.rdm", "--format", "json"))
    assert set(facts["attributes"]) == {"normal", "texcoord", "color"}
    assert facts["bytes"]["attributes"] > sum(one["bytes"] for one in facts["attributes"].values())
    assert "left out" not in told("convert", tmp_path / "a.rdm", tmp_path / "b.ply")
    said = told("convert", tmp_path / "a.rdm", tmp_path / "b.stl")
    assert "left out: normals, texcoords, colors" in said
    said = told("convert", tmp_path / "a.ply", tmp_path / "g.rdm", "--geometry-only")
    assert "left out: normals, texcoords, colors" in said
    facts = json.loads(told("info", tmp_path / "g.rdm", "--format", "json"))
    assert "attributes" not in facts
    said = told("convert", tmp_path / "a.rdm", tmp_path / "s.glb", "--strips")
    assert "left out: normals, texcoords, colors" in said


def test_the_command_line_says_where_an_origin_is(tmp_path, told):
    save_mesh(survey(), tmp_path / "a.ply")
    said = told("convert", tmp_path / "a.ply", tmp_path / "a.rdm")
    assert "moved to an origin at (450560, 5400576, 300.5), in whose frame rays are traced" in said
    facts = json.loads(told("info", tmp_path / "a.rdm", "--format", "json"))
    assert facts["origin"] == [450560, 5400576, 300.5]
    assert facts["precision"]["kind"] == "recentred"
    said = told("convert", tmp_path / "a.ply", tmp_path / "b.rdm", "--recentre", "never")
    assert "origin" not in said
    told("convert", tmp_path / "a.ply", tmp_path / "s.ply", "--strips")
    np.testing.assert_allclose(load_mesh(tmp_path / "s.ply").bounds, survey().bounds, atol=1.0)
