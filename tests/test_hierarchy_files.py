"""Hierarchies of other kinds, and plain triangles, in a file: there and back, and every fault refused."""

import io
import json
from dataclasses import replace

import numpy as np
import pytest
from attributes import at_faces, with_attributes
from hypothesis import given
from hypothesis import strategies as st
from scenes import scenes, small_scene

import striptools
from formats import VECTORS, agree, errors_of
from striptools.errors import UnreadableSceneError, UsageError
from striptools.hierarchies.kdtree import KdTree
from striptools.hierarchies.options import OVER, HierarchyOptions
from striptools.hierarchies.packed import PackedNodes
from striptools.hierarchies.presorted import Presorted
from striptools.options import Options
from striptools.pipeline import convert, convert_with_report
from striptools.reducem.check_hierarchy import cells_of, hierarchy_depth
from striptools.reducem.plain_triangles import first_use
from striptools.reducem.reader import open_scene, read_scene
from striptools.reducem.scene import empty_scene
from striptools.reducem.stored_hierarchy import items_of, name_of, over_of
from striptools.reducem.validate import validate

ALL = [HierarchyOptions(name, over) for name, overs in OVER.items() if name != "reducem" for over in overs]
NONE = PackedNodes(np.zeros((0, 16), np.uint32), 0, None, None, 0)


def title(options):
    return f"{options.name} over {options.objects}"


def saved(scene, *, archive=False):
    file = io.BytesIO()
    scene.save(file, archive=archive)
    return file.getvalue()


def corners(mesh):
    return mesh.positions[mesh.faces].view(np.uint32)


def assert_same(one, other):
    """The same hierarchy, bit for bit."""
    assert (name_of(one), over_of(one)) == (name_of(other), over_of(other))
    np.testing.assert_array_equal(one.nodes, other.nodes)
    mine, theirs = items_of(one), items_of(other)
    assert (mine is None) == (theirs is None)
    if mine is not None:
        np.testing.assert_array_equal(mine, theirs)
    if isinstance(one, KdTree):
        np.testing.assert_array_equal(np.concatenate([one.low, one.high]), [*other.low, *other.high])


# There and back


@given(scenes(), st.sampled_from(ALL), st.integers(0, 3))
def test_what_is_written_is_read_again(drawn, options, levels):
    scene = drawn[1].under(replace(options, levels=levels), 1)
    data = saved(scene)
    assert agree(data) == set()
    found = read_scene(data)
    assert_same(found.hierarchy, scene.hierarchy)
    assert saved(found) == data
    assert sum(found.part_bytes().values()) == len(data)
    assert len(found.packed.nodes) == 0
    if drawn[1].remap is not None:
        np.testing.assert_array_equal(corners(found.to_mesh()), corners(drawn[1].to_mesh()))


@pytest.mark.parametrize("options", ALL, ids=title)
def test_archives_hold_the_same(options):
    pytest.importorskip("zstandard")
    scene = small_scene().under(options, 1)
    data = saved(scene, archive=True)
    assert validate(data) == []
    assert saved(read_scene(data)) == saved(scene)


@pytest.mark.parametrize("options", ALL, ids=title)
def test_bytes_do_not_depend_on_threads(options):
    scene = small_scene()
    assert saved(scene.under(options, 1)) == saved(scene.under(options, 3))


@pytest.mark.parametrize("domains", [{}, dict.fromkeys(("normal", "texcoord", "color"), "vertex")])
def test_presorted_triangles_keep_what_is_said_of_them(domains):
    base = convert(with_attributes(small_scene().to_mesh(), 3, domains=domains))
    scene = read_scene(saved(base.under(HierarchyOptions("presorted", levels=2))))
    assert scene.block_count == 0
    assert scene.strip_count == scene.triangle_count
    one, other = base.to_mesh(), scene.to_mesh()
    np.testing.assert_array_equal(corners(one), corners(other))
    names = [each.name for each in one.attributes]
    assert [each.name for each in other.attributes] == names != []
    for name in names:
        np.testing.assert_array_equal(at_faces(one, name), at_faces(other, name))
    assert scene.materials == base.materials


def test_plain_triangles_have_each_vertex_once():
    scene = small_scene(block=4)
    assert scene.vertex_count > 15
    plain = scene.under(HierarchyOptions("presorted"))
    assert plain.vertex_count == 15
    assert plain.part_bytes()["triangles"] == 12 * (13 + 15)


@given(st.lists(st.tuples(*[st.integers(0, 9)] * 3), min_size=1, max_size=9))
def test_first_use_numbers_as_a_table_does(rows):
    numbers, found = {}, []
    for row in rows:
        found.append([numbers.setdefault(vertex, len(numbers)) for vertex in row])
    faces, used = first_use(np.array(rows, np.int32))
    assert faces.tolist() == found
    assert used.tolist() == list(numbers)


# Faults: each is refused by the writer, with its code


def changed(scene, node, place, value):
    """The scene with one word of a node of its hierarchy changed."""
    nodes = scene.hierarchy.nodes.copy()
    nodes[node, place] = np.float32(value).view(np.uint32) if isinstance(value, float) else value
    return replace(scene, hierarchy=replace(scene.hierarchy, nodes=nodes))


def with_items(scene, items):
    field = {"kdtree": "references", "presorted": "starts"}.get(name_of(scene.hierarchy), "order")
    kind = np.uint32 if field == "references" else np.int32
    return replace(scene, hierarchy=replace(scene.hierarchy, **{field: np.array(items, kind)}))


def heap():
    return small_scene().under(HierarchyOptions("slbvh", "strips"), 1)


def loose():
    return small_scene().under(HierarchyOptions("loose-octree", "strips"), 1)


def tree():
    return small_scene().under(HierarchyOptions("kdtree", "triangles"), 1)


def presorted(levels=2):
    return small_scene().under(HierarchyOptions("presorted", levels=levels), 1)


FAULTS = {
    "heap: a box too small": (lambda: changed(heap(), 1, 3, 1.0), "RDM568"),
    "heap: no number": (lambda: changed(heap(), 1, 0, float("nan")), "RDM568"),
    "heap: root's count": (lambda: changed(heap(), 1, 6, 1 << 3), "RDM566"),
    "heap: node 0": (lambda: changed(heap(), 0, 0, 1), "RDM564"),
    "heap: no axis": (lambda: changed(heap(), 1, 6, heap().hierarchy.nodes[1, 6] | 3), "RDM563"),
    "heap: an order of too few": (lambda: with_items(heap(), [0]), "RDM562"),
    "heap: an object twice": (lambda: with_items(heap(), [0] * heap().strip_count), "RDM567"),
    "loose: a box too small": (lambda: changed(loose(), 0, 3, 1.0), "RDM568"),
    "loose: a child far away": (lambda: changed(loose(), 0, 6, 10**6), "RDM564"),
    "loose: a child that is a leaf": (lambda: changed(loose(), 0, 7, 1), "RDM564"),
    "loose: a place twice": (lambda: first_leaf(loose(), 6, 1), "RDM566"),
    "loose: no place": (lambda: with_items(loose(), [-1] * loose().strip_count), "RDM567"),
    "tree: a plane out of its cell": (lambda: changed(tree(), 0, 0, 99.0), "RDM563"),
    "tree: a child far away": (lambda: changed(tree(), 0, 1, 10**6 << 2), "RDM564"),
    "tree: a reference too few": (lambda: with_items(tree(), tree().hierarchy.references[:-1]), "RDM566"),
    "tree: references that fall": (lambda: with_items(tree(), tree().hierarchy.references * 0 + 1), "RDM567"),
    "tree: a root's cell too small": (
        lambda: replace(tree(), hierarchy=replace(tree().hierarchy, high=tree().hierarchy.low)),
        "RDM568",
    ),
    "presorted: a tree of none": (lambda: with_items(presorted(0), [0, 0, 13]), "RDM562"),
    "presorted: too few": (lambda: with_items(presorted(0), [0, 12]), "RDM567"),
    "presorted: a box too small": (lambda: changed(presorted(), 0, 3, 1.0), "RDM568"),
    "presorted: another leaf": (lambda: first_leaf(presorted(), 7, 2), "RDM566"),
    "presorted: another order": (lambda: turned_over(presorted(0)), "RDM568"),
    "presorted: no triangles": (lambda: replace(heap(), hierarchy=presorted().hierarchy), "RDM113"),
    "triangles of another kind": (lambda: replace(heap(), triangles=presorted().triangles), "RDM117"),
    "blocks beside triangles": (lambda: replace(presorted(), blocks=small_scene().blocks), "RDM201"),
    "nodes beside it": (lambda: replace(heap(), packed=small_scene(block=4).packed), "RDM201"),
    "a hierarchy of nothing": (lambda: replace(empty_scene(), hierarchy=heap().hierarchy), "RDM117"),
    "no vertex": (lambda: with_faces([[0, 1, 99]]), "RDM571"),
    "a late vertex": (lambda: with_faces([[1, 0, 2]]), "RDM572"),
    "a vertex unused": (lambda: with_faces([[0, 1, 2]] * 13), "RDM573"),
    "a vertex twice": (lambda: twice_named(), "RDM574"),
    "no coordinate": (lambda: with_points(np.nan), "RDM575"),
}


def first_leaf(scene, place, value):
    node = int(np.flatnonzero(scene.hierarchy.nodes[:, 7])[0])
    return changed(scene, node, place, scene.hierarchy.nodes[node, place] + value)


def turned_over(scene):
    faces, used = first_use(scene.triangles.faces[::-1])
    plain = replace(scene.triangles, positions=scene.positions[used], faces=faces)
    return replace(scene, triangles=plain, remap=None)


def with_faces(rows):
    scene = presorted(0)
    faces = scene.triangles.faces.copy()
    faces[: len(rows)] = rows
    return replace(scene, triangles=replace(scene.triangles, faces=faces))


def twice_named():
    """A triangle all of whose vertices others use too names one of them twice."""
    scene = presorted(0)
    faces = scene.triangles.faces.copy()
    times = np.bincount(faces.reshape(-1))
    row = int(np.flatnonzero((times[faces] > 1).all(axis=1) & (faces < faces[0].max()).any(axis=1))[-1])
    faces[row, 2] = faces[row, 0]
    return replace(scene, triangles=replace(scene.triangles, faces=faces))


def with_points(value):
    scene = presorted(0)
    positions = scene.triangles.positions.copy()
    positions[2, 1] = value
    return replace(scene, triangles=replace(scene.triangles, positions=positions))


@pytest.mark.parametrize("fault", FAULTS, ids=lambda name: name)
def test_a_fault_is_refused_by_its_code(fault):
    make, code = FAULTS[fault]
    with pytest.raises(UnreadableSceneError, match=code):
        saved(make())


def test_wrong_types_are_refused():
    scene = heap()
    for broken in (
        replace(scene, hierarchy=replace(scene.hierarchy, nodes=scene.hierarchy.nodes.astype(np.int64))),
        replace(presorted(), hierarchy=Presorted(presorted().hierarchy.nodes, np.array([0, 13]))),
    ):
        with pytest.raises(UsageError, match="dtype"):
            saved(broken)


def test_a_kd_tree_that_lacks_an_object_is_refused():
    scene = tree()
    found = scene.hierarchy
    is_leaf = found.nodes[:, 1] & 3 == 3
    leaf = int(np.flatnonzero(is_leaf & (found.nodes[:, 1] >> 2 > 0))[0])
    first = int(found.nodes[leaf, 0])
    lonely = found.references[first]
    # All leaves lose it, so that no cell that its corners lie in has it.
    kept = found.references != lonely
    nodes = found.nodes.copy()
    at = 0
    for node in np.flatnonzero(is_leaf):
        held = kept[found.nodes[node, 0] : found.nodes[node, 0] + (found.nodes[node, 1] >> 2)].sum()
        nodes[node] = at, int(held) << 2 | 3
        at += int(held)
    broken = replace(found, nodes=nodes, references=found.references[kept])
    with pytest.raises(UnreadableSceneError, match="RDM568"):
        saved(replace(scene, hierarchy=broken))


# Reading what is asked for


def damaged(data, kind):
    """The file with the first byte of a section changed."""
    count = int.from_bytes(data[12:16], "little")
    for at in range(32, 32 + 40 * count, 40):
        if data[at : at + 4] == kind:
            place = int.from_bytes(data[at + 8 : at + 16], "little")
            return data[:place] + bytes([data[place] ^ 255]) + data[place + 1 :]
    raise AssertionError(kind)


def test_a_hierarchy_is_looked_at_when_it_is_asked_for():
    scene = open_scene(damaged(saved(heap()), b"HIER"))
    assert scene.triangle_count == 13
    assert len(scene.faces()) == 13
    with pytest.raises(UnreadableSceneError, match="RDM110"):
        _ = scene.hierarchy
    scene = open_scene(damaged(saved(presorted()), b"TRIS"))
    assert len(scene.remap.face) == 13
    with pytest.raises(UnreadableSceneError, match="RDM110"):
        scene.faces()


def test_depths_and_cells_are_those_of_a_plain_walk():
    for name in ("heap_strips", "loose_deepest", "cells_triangles"):
        found = read_scene((VECTORS / "valid" / f"{name}.rdm").read_bytes()).hierarchy
        assert hierarchy_depth(found) == plain_depth(found)
    assert hierarchy_depth(presorted(0).hierarchy) == 3
    found = tree().hierarchy
    cells = cells_of(found)
    waiting = [(0, [*found.low, *found.high])]
    while waiting:
        node, cell = waiting.pop()
        assert cells[node].tolist() == cell
        axis = int(found.nodes[node, 1] & 3)
        if axis < 3:
            plane = found.nodes[node, 0].view(np.float32)
            waiting.append((node + 1, [*cell[: axis + 3], plane, *cell[axis + 4 :]]))
            waiting.append((int(found.nodes[node, 1] >> 2), [*cell[:axis], plane, *cell[axis + 1 :]]))


def plain_depth(found):
    kind = name_of(found)
    waiting, deepest = [(1 if kind == "slbvh" else 0, 1)], 0
    while waiting:
        node, depth = waiting.pop()
        deepest = max(deepest, depth)
        row = found.nodes[node].tolist()
        if kind == "slbvh" and not row[6] & 4:
            waiting += [(2 * node, depth + 1), (2 * node + 1, depth + 1)]
        if kind == "kdtree" and row[1] & 3 < 3:
            waiting += [(node + 1, depth + 1), (row[1] >> 2, depth + 1)]
        if kind == "loose-octree" and row[7] == 0:
            waiting += [(node + 1, depth + 1), (row[6], depth + 1)]
    return deepest


# What may be asked for


def test_a_scene_under_the_default_is_itself():
    scene = small_scene()
    assert scene.under(HierarchyOptions()) is scene
    assert empty_scene().under(HierarchyOptions("slbvh")).hierarchy is None


def test_what_cannot_be_built_is_refused():
    with pytest.raises(UsageError, match="no default hierarchy"):
        heap().under(HierarchyOptions())
    with pytest.raises(UsageError, match="no strips or blocks"):
        presorted().under(HierarchyOptions("slbvh"))
    scene = read_scene((VECTORS / "valid" / "instances.rdm").read_bytes())
    with pytest.raises(UsageError, match="no two-level form"):
        scene.under(HierarchyOptions("kdtree"))
    with pytest.raises(UsageError, match="not of slbvh"):
        Options(hierarchy=HierarchyOptions("slbvh"), boxes="stored")
    assert heap().under(HierarchyOptions("kdtree", "strips")).hierarchy.over == "strips"


def test_another_hierarchy_has_no_default_one_beside_it():
    scene = read_scene(saved(heap()))
    assert len(scene.with_boxes().nodes) == 0
    assert scene.resident_bytes_per_triangle() == 0.0
    assert scene.metadata["hierarchy"] == "slbvh over strips, balance sah"


# The pipeline and the command line


@pytest.fixture(scope="module")
def chairs(tmp_path_factory):
    """A glTF scene with one mesh in two places."""
    instances, geometries = striptools_instances()
    mesh = small_scene().to_mesh()
    path = tmp_path_factory.mktemp("chairs") / "chairs.glb"
    striptools.save_mesh(replace(mesh, instances=instances, geometries=geometries(mesh)), path)
    return path


def striptools_instances():
    from striptools.mesh.instances import Geometries, Instances

    matrices = np.tile(np.eye(4)[:3], (2, 1, 1))
    matrices[1, 0, 3] = 20.0
    return Instances(np.zeros(2, np.int32), matrices), lambda mesh: Geometries(
        np.array([0, mesh.triangle_count], np.int32), np.array([0, mesh.vertex_count], np.int32)
    )


def test_instances_are_flattened_with_a_word(chairs):
    options = Options(hierarchy=HierarchyOptions("slbvh"), threads=1)
    scene, report = convert_with_report(chairs, options)
    assert scene.instances is None
    assert scene.triangle_count == 26
    assert "instances flattened, for slbvh has no two-level form" in report.notes
    assert convert(chairs, Options(threads=1)).instances is not None


@pytest.fixture(scope="module")
def bowl(tmp_path_factory):
    path = tmp_path_factory.mktemp("bowl") / "bowl.ply"
    striptools.save_mesh(small_scene().to_mesh(), path)
    return path


@pytest.mark.parametrize("options", ALL, ids=title)
def test_each_goes_through_the_command_line(options, bowl, tmp_path, run):
    file, back = tmp_path / "a.rdm", tmp_path / "back.ply"
    over = [] if options.name == "presorted" else ["--over", options.objects]
    assert run("convert", bowl, file, "--hierarchy", options.name, *over, "-q")[0] == 0
    assert run("validate", file)[0] == 0
    code, out, _ = run("info", file, "--format", "json")
    assert code == 0
    facts = json.loads(out)
    found = facts["hierarchy"]
    assert (found["name"], found["over"]) == (options.name, options.objects)
    assert found["bytes"] == facts["bytes"]["hierarchy"]
    assert found["bytes_per_triangle"] == pytest.approx(found["bytes"] / 13)
    assert sum(facts["bytes"].values()) == 2 * file.stat().st_size
    assert (facts["bytes"]["triangles"] > 0) == (options.name == "presorted")
    assert run("convert", file, back, "-q")[0] == 0
    np.testing.assert_array_equal(corners(striptools.load_mesh(back)), corners(striptools.load_mesh(bowl)))


@pytest.mark.parametrize("name", [name for name in OVER if name != "reducem"])
def test_each_is_traced_proved_and_drawn(name, bowl, tmp_path, run):
    pytest.importorskip("jax")
    file = tmp_path / "a.rdm"
    assert run("convert", bowl, file, "--hierarchy", name, "-q")[0] == 0
    few = ["--rays", 32, "--aimed-rays", 64, "--threads", 1]
    code, out, _ = run("verify", file, "--against", bowl, *few)
    assert (code, ": proved," in out) == (0, True)
    picture = ["--width", 16, "--height", 16, "--shading", "strip", "--threads", 1, "-q"]
    assert run("render", file, tmp_path / "a.png", *picture)[0] == 0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--over", "triangles"], "--over: reducem has no use for it"),
        (["--hierarchy", "presorted", "--over", "triangles"], "--over: presorted has no use for it"),
        (["--hierarchy", "kdtree", "--over", "blocks"], "not built over 'blocks'"),
        (["--hierarchy", "slbvh", "--levels", "3"], "--hierarchy presorted"),
        (["--hierarchy", "loose-octree", "--balance", "sah"], "--hierarchy slbvh"),
        (["--hierarchy", "slbvh", "--metric", "plain"], "--hierarchy kdtree"),
        (["--hierarchy", "slbvh", "--balance", "best"], "not known"),
        (["--hierarchy", "bih"], "not known"),
        (["--hierarchy", "slbvh", "--boxes", "stored"], "boxes"),
        (["--hierarchy", "presorted", "--levels", "21"], "levels"),
    ],
)
def test_what_a_hierarchy_has_no_use_for_is_a_usage_error(arguments, said, bowl, tmp_path, run):
    code, _, err = run("convert", bowl, tmp_path / "a.rdm", *arguments)
    assert (code, said in err) == (2, True), err
    assert not (tmp_path / "a.rdm").exists()


def test_a_default_scene_says_its_hierarchy_too(bowl, tmp_path, run):
    assert run("convert", bowl, tmp_path / "a.rdm", "-q")[0] == 0
    facts = json.loads(run("info", tmp_path / "a.rdm", "--format", "json")[1])
    assert facts["hierarchy"]["name"] == "reducem"
    assert facts["boxes"] == "rebuilt"
    assert facts["bytes"]["hierarchy"] == 0


def test_no_vector_of_a_hierarchy_is_valid_by_chance():
    for path in VECTORS.glob("invalid/hierarchy_*.rdm"):
        assert errors_of(path.read_bytes())
