"""Instances: glTF scenes keep them, scenes store a repeated mesh once, all agree with the flattened mesh."""

import io
import json
import struct
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from formats import agree, reference
from striptools.errors import LimitError, StriptoolsError, UnreadableSceneError, UsageError
from striptools.hierarchies.packed import check_packed
from striptools.measure.verify import VerifyOptions, verify
from striptools.mesh import instances as placing
from striptools.mesh.attributes import Attribute
from striptools.mesh.instances import Geometries, Instances, determinant_signs, place
from striptools.mesh.io import load_mesh, save_mesh, unkept
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert, convert_with_report
from striptools.reducem.joining import why_not_kept
from striptools.reducem.quantize import PrecisionOptions
from striptools.reducem.reader import read_scene
from striptools.reducem.validate import validate
from striptools.trace import Tracer

MIRROR = {"scale": [-1, 1, 1], "translation": [5, 0, 0]}
STRETCH = {"scale": [0.5, 2, 3], "rotation": [0, 0, 0.6, 0.8], "translation": [0, 7, 0.1]}
FEW = VerifyOptions(rays=64, aimed_rays=512)


def ball(rows=5, columns=7, shift=0.0):
    """A patch of a bent surface: float32 positions and faces."""
    u, v = np.meshgrid(np.linspace(0.1, 3, rows), np.linspace(0, 6, columns), indexing="ij")
    points = np.stack([np.sin(u) * np.cos(v) + shift, np.sin(u) * np.sin(v), np.cos(u)], axis=-1)
    faces = []
    for i in range(rows - 1):
        for j in range(columns - 1):
            a = i * columns + j
            faces += [[a, a + 1, a + columns], [a + 1, a + columns + 1, a + columns]]
    return points.reshape(-1, 3).astype(np.float32), np.array(faces, np.uint16)


def glb(meshes, nodes, roots=None, normals=False, materials=0):
    """A GLB file of meshes `(positions, faces)` under nodes."""
    data, views, accessors, made = b"", [], [], []

    def add(rows, component, kind):
        nonlocal data
        raw = rows.tobytes()
        views.append({"buffer": 0, "byteOffset": len(data), "byteLength": len(raw)})
        data += raw + bytes(-len(raw) % 4)
        accessors.append({"bufferView": len(views) - 1, "componentType": component, "type": kind})
        accessors[-1]["count"] = rows.size if kind == "SCALAR" else len(rows)
        return len(accessors) - 1

    for k, (positions, faces) in enumerate(meshes):
        attributes = {"POSITION": add(positions, 5126, "VEC3")}
        if normals:
            attributes["NORMAL"] = add(positions, 5126, "VEC3")
        primitive = {"attributes": attributes, "indices": add(faces, 5123, "SCALAR")}
        made.append({"primitives": [primitive | ({"material": k % materials} if materials else {})]})
    tree = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": list(range(len(nodes))) if roots is None else roots}],
        "nodes": nodes,
        "meshes": made,
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    if materials:
        tree["materials"] = [{"name": f"m{k}"} for k in range(materials)]
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(data), b"BIN\0") + data
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def load(data, keep=True):
    return load_mesh(io.BytesIO(data), file_format="glb", instances=keep)


def saved(scene):
    stream = io.BytesIO()
    scene.save(stream)
    return stream.getvalue()


SCENES = {
    "repeated": glb([ball()], [{"mesh": 0}, {"mesh": 0, "translation": [3, 0, 0]}]),
    "mirrored": glb([ball()], [{"mesh": 0, **MIRROR}, {"mesh": 0, **STRETCH}], normals=True),
    "twice the same place": glb([ball()], [{"mesh": 0}, {"mesh": 0}]),
    "once used between": glb(
        [ball(), ball(4, 4, 9.0), ball(30, 20, -9.0)],
        [{"mesh": 1}, {"mesh": 0, **STRETCH}, {"mesh": 2, **STRETCH}, {"mesh": 0}, {"mesh": 1, **MIRROR}],
        normals=True,
        materials=2,
    ),
    "nested": glb(
        [ball(20, 30), ball(3, 3)],
        [
            {"children": [1, 2], **STRETCH},
            {"mesh": 0, "children": [3], **MIRROR},
            {"mesh": 1, "translation": [0, 0, 4]},
            {"mesh": 0, "scale": [2, 2, -0.25]},
            {"mesh": 1, "matrix": [1, 0, 0, 0, 0.5, 1, 0, 0, 0, 0, 1, 0, 0.1, 0.2, 0.3, 1]},
        ],
        roots=[0, 4],
    ),
}


@pytest.mark.parametrize("data", SCENES.values(), ids=SCENES.keys())
def test_flattened_is_what_loading_gives_without_instances(data):
    kept, flat = load(data), load(data, keep=False)
    assert kept.instances is not None
    assert flat.instances is None
    again = kept.flattened()
    assert again.positions.dtype == flat.positions.dtype
    np.testing.assert_array_equal(again.positions, flat.positions)
    np.testing.assert_array_equal(again.faces, flat.faces)
    assert len(again.attributes) == len(flat.attributes)
    for one, other in zip(again.attributes, flat.attributes, strict=True):
        assert (one.name, one.domain) == (other.name, other.domain)
        assert one.values.tobytes() == other.values.tobytes()
    assert again.materials == flat.materials


@pytest.mark.parametrize("boxes", ["rebuilt", "stored"])
@pytest.mark.parametrize("data", SCENES.values(), ids=SCENES.keys())
def test_a_scene_keeps_instances_bit_for_bit(data, boxes):
    source = load(data)
    written = saved(convert(source, Options(boxes=boxes)))
    assert agree(written) == set()
    scene = read_scene(written)
    assert scene.triangle_count == source.triangle_count
    assert saved(scene) == written
    flat, theirs = scene.flattened(), source.flattened()
    ours = flat.positions[flat.faces]
    assert ours.tobytes() == theirs.positions.astype(np.float32)[theirs.faces].tobytes()
    placed = scene.placed()
    back = (np.arange(3) - placed.remap.rotation[:, None]) % 3
    corners = np.take_along_axis(placed.faces(), back, axis=1)[np.argsort(placed.remap.face)]
    assert placed.positions[corners].tobytes() == ours.tobytes()
    for one, other in zip(flat.attributes, theirs.attributes, strict=True):
        ours, wanted = one.at_corners(flat.faces), other.at_corners(theirs.faces)
        assert ours.tobytes() == wanted.tobytes(), one.name
    check_packed(
        scene.with_boxes(),
        *(scene.grid, scene.triangle_boxes(), scene.block_starts, scene.starts, scene.roots),
    )


@pytest.mark.parametrize("data", SCENES.values(), ids=SCENES.keys())
def test_a_scene_of_instances_is_proved(data):
    source = load(data)
    for options in (
        Options(),
        Options(remap=False),
        Options(precision=PrecisionOptions(bits=10)),
        Options(precision=PrecisionOptions(max_error=0.01)),
    ):
        scene = convert(source, options)
        report = verify(scene, source, FEW)
        assert report.ok, (options, report.flaws, report.structure)
        if options.precision.max_error is not None:
            assert report.error_bound <= 0.01 * 1.001
    assert verify(convert(source), source.flattened(), FEW).ok
    assert verify(convert(source, Options(instances=False)), source, FEW).ok


def test_verify_tells_another_place():
    source = load(SCENES["mirrored"])
    scene = convert(source)
    matrix = scene.instances.matrix.copy()
    matrix[1, 0, 3] += 0.5
    moved = replace(scene, instances=replace(scene.instances, matrix=matrix))
    report = verify(moved, source, FEW)
    assert not report.ok
    assert report.structure.wrong == source.triangle_count
    with pytest.raises(UsageError, match="the scene's had"):
        verify(scene, load(SCENES["nested"]), FEW)


def test_hits_are_told_by_the_flattened_face():
    source = load(SCENES["once used between"])
    scene = convert(source)
    flat = source.flattened()
    tracer, plain = Tracer(scene), Tracer(convert(flat, Options(instances=False)))
    random = np.random.default_rng(3)
    target = flat.positions[flat.faces[random.integers(0, flat.triangle_count, 400)]].mean(axis=1)
    origins = target + random.normal(size=target.shape) * 20
    ours, theirs = tracer.closest_hit(origins, target - origins), plain.closest_hit(origins, target - origins)
    for name in ("t", "face", "u", "v"):
        np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name), err_msg=name)
    placed = scene.placed()
    np.testing.assert_array_equal(placed.remap.face[ours.triangle[ours.hit]], ours.face[ours.hit])
    instance = np.searchsorted(placed.instance_starts, ours.triangle, side="right") - 1
    assert set(instance[ours.hit]) == set(range(len(scene.instances)))
    assert (tracer.any_hit(origins, target - origins) == ours.hit).all()


def test_a_scene_without_instances_has_the_bytes_that_it_had():
    once = glb([ball(), ball(4, 4, 9.0)], [{"mesh": 0, **STRETCH}, {"mesh": 1}], normals=True)
    assert load(once).instances is None
    written = saved(convert(load(once)))
    assert written == saved(convert(load(once, keep=False)))
    assert b"GEOM" not in written
    assert b"INST" not in written
    flat = saved(convert(load(SCENES["nested"]), Options(instances=False)))
    assert flat == saved(convert(load(SCENES["nested"], keep=False)))


def test_a_repeated_mesh_is_stored_once():
    nodes = [{"mesh": 0, "translation": [3.0 * k, 0, 0]} for k in range(50)]
    data = glb([ball(20, 30)], nodes)
    kept, flat = convert(load(data)), convert(load(data, keep=False))
    assert len(saved(kept)) < len(saved(flat)) / 15
    assert (len(kept.geometries), len(kept.instances)) == (1, 50)
    assert kept.placed_count == flat.triangle_count
    parts = kept.part_bytes()
    assert parts["instances"] == 16 + 50 * 104
    assert sum(parts.values()) == len(saved(kept))


def test_a_mesh_and_a_scene_go_round():
    source = load(SCENES["once used between"])
    mesh = convert(source).to_mesh()
    assert len(mesh.geometries) == len(source.geometries)
    np.testing.assert_array_equal(mesh.instances.matrix, source.instances.matrix)
    np.testing.assert_array_equal(mesh.instances.geometry, source.instances.geometry)
    np.testing.assert_array_equal(mesh.geometries.face_starts, source.geometries.face_starts)
    stream = io.BytesIO()
    save_mesh(mesh, stream, file_format="glb")
    again = load(stream.getvalue())
    ours, theirs = again.flattened(), source.flattened()
    one = ours.positions.astype(np.float32)[ours.faces].reshape(-1, 9)
    other = theirs.positions.astype(np.float32)[theirs.faces].reshape(-1, 9)
    np.testing.assert_array_equal(one[np.lexsort(one.T)], other[np.lexsort(other.T)])


def test_other_formats_flatten_and_say_so():
    mesh = load(SCENES["repeated"])
    assert "instances, each written in full" in unkept(mesh, "ply")
    assert not any("instances" in word for word in unkept(mesh, "glb"))
    for name in ("ply", "obj", "stl"):
        stream = io.BytesIO()
        save_mesh(mesh, stream, file_format=name)
        stream.seek(0)
        assert load_mesh(stream, file_format=name).triangle_count == 2 * mesh.triangle_count


# ------------------------------------------------------------------------------ meshes that are no use


def test_what_a_matrix_flattens_is_moved_once():
    shadow = {"mesh": 0, "scale": [1, 1, 0]}
    source = load(glb([ball()], [{"mesh": 0}, shadow, {"mesh": 0, **MIRROR}, shadow]))
    assert [geometry for geometry, _ in source.instances] == [0, 1, 0, 2]
    assert source.triangle_count == 3 * len(ball()[1])
    scene = convert(source)
    assert verify(scene, source, FEW).ok
    assert load(glb([ball()], [{"mesh": 0}, shadow])).instances is None


def test_a_geometry_of_which_nothing_is_left_is_left_out():
    flat = (np.zeros((3, 3), np.float32), np.array([[0, 1, 2]], np.uint16))
    nodes = [{"mesh": 1}, {"mesh": 0}, {"mesh": 1}, {"mesh": 0, **MIRROR}, {"mesh": 1}]
    source = load(glb([ball(), flat], nodes))
    scene = convert(source)
    assert (len(scene.geometries), len(scene.instances)) == (1, 2)
    assert scene.instances.first_face.tolist() == [1, 2 + len(ball()[1])]
    assert scene.geometries.rows.tolist() == [[0, 0, 1, len(ball()[1])]]
    assert verify(scene, source, FEW).ok
    assert agree(saved(scene)) == set()


def test_far_from_zero_instances_are_flattened_with_an_origin():
    far = [{"mesh": 0, "translation": [1e6, 0, k]} for k in (0, 3)]
    source = load(glb([ball()], far))
    assert why_not_kept(source) == "the scene is far from zero"
    scene, report = convert_with_report(source)
    assert scene.instances is None
    assert scene.origin is not None
    assert "instances flattened, for the scene is far from zero" in report.notes
    assert verify(scene, source, FEW).ok


def test_too_far_for_float32_instances_are_flattened():
    source = load(glb([ball()], [{"mesh": 0}, {"mesh": 0, "scale": [1e38, 1, 1]}]))
    assert why_not_kept(source) == "they reach too far for float32"
    assert convert(source).instances is None


@pytest.mark.parametrize(
    ("matrix", "match"),
    [
        (np.full((1, 3, 4), np.nan), "not finite"),
        (np.zeros((1, 3, 4)), "determinant of 0"),
        (np.array([[[0.1, 0.2, 0.3, 0], [0.2, 0.4, 0.6, 0], [0, 0, 1, 0]]]), "determinant of 0"),
        (np.zeros((1, 4, 4)), "shape"),
        (np.zeros((0, 3, 4)), "shape"),
    ],
)
def test_hostile_matrices_are_refused(matrix, match):
    with pytest.raises(UsageError, match=match):
        Instances(np.zeros(len(matrix), np.int32), matrix)


def test_instances_that_do_not_fit_a_mesh_are_refused():
    positions, faces = ball()
    whole = Geometries(np.array([0, len(faces)], np.int32), np.array([0, len(positions)], np.int32))
    one = Instances(np.zeros(1, np.int32), np.eye(4)[None, :3])
    assert Mesh(positions, faces, geometries=whole, instances=one).flattened().triangle_count == len(faces)
    halves = Geometries(np.array([0, 24, len(faces)], np.int32), np.array([0, 21, len(positions)], np.int32))
    for geometries, instances, match in (
        (whole, None, "without instances"),
        (replace(whole, face_starts=np.array([0, 5], np.int32)), one, "do not hold all"),
        (replace(whole, face_starts=np.array([0, 24, len(faces)], np.int32)), one, "do not hold all"),
        (replace(halves, face_starts=np.array([0, 99, len(faces)], np.int32)), one, "one after another"),
        (halves, one, "of another geometry"),
        (whole, replace(one, geometry=np.ones(1, np.int32)), "does not exist"),
    ):
        with pytest.raises(UsageError, match=match):
            Mesh(positions, faces, geometries=geometries, instances=instances)


def test_more_triangles_than_a_mesh_may_have_are_refused(monkeypatch):
    from striptools.mesh import mesh as module

    scene = convert(load(SCENES["repeated"]))
    monkeypatch.setattr(module, "MOST_FACES", 60)
    with pytest.raises(LimitError, match="with all instances"):
        scene.flattened()


# ------------------------------------------------------------------------------ the arithmetic


@example([0.0, 444.0, 8.403963192855887e-289, 8.403963192855887e-289, 0.0, 0.0, 0.0, 0.0, 0.0], 325)
@given(st.lists(st.floats(-1e3, 1e3), min_size=9, max_size=9), st.integers(-1000, 1000))
def test_the_sign_of_a_determinant_is_exact(values, exponent):
    from fractions import Fraction

    matrix = np.ldexp(np.array(values).reshape(1, 3, 3), exponent)
    a, b, c = ([Fraction(x) for x in row] for row in matrix[0].tolist())
    exact = (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        - a[1] * (b[0] * c[2] - b[2] * c[0])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )
    assert determinant_signs(matrix)[0] == (exact > 0) - (exact < 0)
    twin = matrix.copy()
    twin[0, 2] = twin[0, 0]
    assert determinant_signs(twin)[0] == 0


@given(
    st.lists(st.floats(-1e6, 1e6, width=32), min_size=3, max_size=3),
    st.lists(st.floats(-1e6, 1e6), min_size=12, max_size=12),
)
def test_a_place_is_what_the_reference_reader_says(point, values):
    bits = tuple(np.array(point, np.float32).view(np.uint32).tolist())
    matrix = np.array(values).reshape(3, 4)
    ours = place(np.array([point], np.float32), matrix).astype(np.float32)
    if not placing.is_identity(matrix):
        assert tuple(ours.view(np.uint32)[0].tolist()) == reference.place(bits, tuple(values))


# ------------------------------------------------------------------------------ faults


def spoil_geometry(row, column, value):
    def spoil(scene):
        rows = scene.geometries.rows.copy()
        rows[row, column] = value
        return replace(scene, geometries=replace(scene.geometries, rows=rows))

    return spoil


def spoil_instance(name, row, value):
    def spoil(scene):
        array = getattr(scene.instances, name).copy()
        array[row] = value
        return replace(scene, instances=replace(scene.instances, **{name: array}))

    return spoil


FAULTS = {
    "RDM541": [spoil_geometry(0, 0, 1), spoil_geometry(1, 0, 0), spoil_geometry(1, 1, 99)],
    "RDM542": [spoil_geometry(0, 3, 1), spoil_geometry(1, 2, 1), spoil_geometry(1, 3, 10**6)],
    "RDM543": [lambda s: replace(s, remap=replace(s.remap, face=s.remap.face[::-1].copy()))],
    "RDM551": [spoil_instance("geometry", 0, 9), spoil_instance("geometry", slice(None), 0)],
    "RDM552": [spoil_instance("matrix", 1, 0.0), spoil_instance("matrix", 1, np.nan)],
    "RDM553": [spoil_instance("matrix", (0, 0, 3), 1e39), spoil_instance("matrix", (0, 2, 2), 1e300)],
    "RDM554": [spoil_instance("first_face", 1, 0), spoil_instance("first_face", -1, 2**32 - 2)],
    "RDM113": [lambda s: replace(s, instances=None), lambda s: replace(s, geometries=None)],
}


@pytest.mark.parametrize(
    ("code", "spoil"), [(code, spoil) for code, faults in FAULTS.items() for spoil in faults]
)
def test_each_rule_finds_its_fault(code, spoil):
    scene = convert(load(SCENES["nested"]))
    with pytest.raises(UnreadableSceneError, match=code):
        spoil(scene).check()


def test_nodes_of_another_geometry_are_found():
    big = glb([ball(40, 40), ball(40, 30, 5.0)], [{"mesh": k} for k in (0, 1, 0, 1)])
    scene = convert(load(big))
    assert (np.diff(scene.roots.tops) > 0).all()
    rows = scene.geometries.rows.copy()
    rows[1, 0] += 1
    with pytest.raises(UnreadableSceneError, match=r"RDM703|RDM542|RDM543"):
        replace(scene, geometries=replace(scene.geometries, rows=rows)).check()
    nodes = scene.packed.nodes.copy()
    nodes[int(scene.roots.tops[1]), 1] &= 0xFF000000
    with pytest.raises(UnreadableSceneError, match="RDM703"):
        replace(scene, packed=replace(scene.packed, nodes=nodes)).check()


def test_every_flipped_bit_of_the_sections_is_found_or_harmless():
    scene = convert(load(SCENES["mirrored"]), Options(geometry_only=True))
    data = saved(scene)
    from formats import mended

    end = len(data)
    for at in range(end - 384, end):
        for bit in (0, 3, 7):
            spoiled = bytearray(data)
            spoiled[at] ^= 1 << bit
            assert any(finding.issue.severity == "error" for finding in validate(bytes(spoiled)))
            agree(mended(bytes(spoiled)))


def test_an_origin_is_that_of_the_frame_of_instances():
    scene = convert(load(SCENES["mirrored"]))
    origin = np.array([1e6, 0.0, -3.0])
    moved = read_scene(saved(replace(scene, origin=origin)))
    flat = moved.flattened()
    assert flat.positions.dtype == np.float64
    near = scene.to_mesh().flattened().positions + origin
    np.testing.assert_allclose(flat.positions, near, atol=1e-6)


def test_attributes_of_geometries_that_are_not_alike_go_together():
    positions, faces = ball()
    seam = np.arange(3 * len(faces), dtype=np.float32).reshape(-1, 1) * np.ones((1, 2), np.float32)
    vertices = np.concatenate([positions, positions + 3])
    whole = np.concatenate([faces, faces + len(positions)])
    same = np.concatenate([seam, np.ones_like(seam)])
    mesh = Mesh(
        vertices,
        whole,
        attributes=(Attribute("texcoord", "corner", same),),
        geometries=Geometries(
            np.array([0, len(faces), 2 * len(faces)], np.int32),
            np.array([0, len(positions), 2 * len(positions)], np.int32),
        ),
        instances=Instances(np.array([0, 1, 0]), np.stack([np.eye(4)[:3]] * 3) + [[[0, 0, 0, 1]]] * 3),
    )
    back = read_scene(saved(convert(mesh))).flattened()
    ours = back.attribute("texcoord").at_corners(back.faces)
    flat = mesh.flattened()
    assert ours.tobytes() == flat.attribute("texcoord").at_corners(flat.faces).tobytes()


def test_errors_are_one_line():
    for data in (SCENES["repeated"],):
        scene = convert(load(data))
        with pytest.raises(StriptoolsError) as caught:
            spoil_instance("matrix", 0, 0.0)(scene).save(io.BytesIO())
        assert "\n" not in str(caught.value)
