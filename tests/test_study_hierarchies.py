"""The study of all hierarchies: costs are those of plain sums, nothing is wrong, and it prints and draws."""

import io
import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scenes import small_scene

import striptools
from striptools.hierarchies.options import HierarchyOptions
from striptools.hierarchies.presorted import presort
from striptools.measure import study_hierarchies
from striptools.measure.hierarchy_cost import hierarchy_cost, presorted_regions
from striptools.measure.quality import in_strip_tree
from striptools.measure.study import StudyOptions
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.partition.sah import expected_cost
from striptools.reducem.check_hierarchy import cells_of
from striptools_cli.study import printed_tables

pytest.importorskip("jax", reason="the extra trace is not installed")


def ball(count=16):
    """A closed ball of 2 (count - 1) count triangles."""
    up, round_ = np.meshgrid(np.linspace(0, math.pi, count + 1)[1:-1], np.arange(count) * 2 * math.pi / count)
    points = np.stack([np.sin(up) * np.cos(round_), np.sin(up) * np.sin(round_), np.cos(up)], axis=-1)
    points = np.concatenate([points.reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]]).astype(np.float32)
    rows, poles, faces = count - 1, (count * (count - 1), count * (count - 1) + 1), []
    for i in range(count):
        a, b = i * rows, (i + 1) % count * rows
        faces += [[poles[0], a, b], [poles[1], b + rows - 1, a + rows - 1]]
        for j in range(rows - 1):
            faces += [[a + j, a + j + 1, b + j], [b + j, a + j + 1, b + j + 1]]
    return Mesh(points, np.array(faces, np.int32))


def area(box):
    x, y, z = (float(box[i + 3]) - float(box[i]) for i in range(3))
    return x * y + y * z + z * x


def test_the_cost_of_the_trees_in_strips_is_the_one_model_s():
    scene = small_scene()
    boxes = scene.triangle_boxes()
    tree = in_strip_tree(scene, boxes)[1]
    walked = study_hierarchies._binary(scene, 1)
    assert hierarchy_cost(walked) == pytest.approx(expected_cost(tree.boxes, tree.size))
    walked.check()


@pytest.mark.parametrize("over", ["triangles", "strips", "blocks"])
@pytest.mark.parametrize("name", ["slbvh", "loose-octree"])
def test_the_cost_of_boxes_is_a_plain_sum(name, over):
    scene = small_scene(block=4).under(HierarchyOptions(name, over), 1)
    sizes = np.diff(scene.objects(over))
    found, total = scene.hierarchy, 0.0
    order = np.arange(len(sizes)) if found.order is None else found.order
    for row in found.nodes[found.nodes.any(axis=1)]:
        a, b = int(row[6]), int(row[7])
        first, held = (b, a >> 3 if a & 4 else 0) if name == "slbvh" else (a, b)
        price = sizes[order[first : first + held]].sum() if held else 1
        total += price * area(row[:6].view(np.float32))
    root = found.nodes[1 if name == "slbvh" else 0, :6].view(np.float32)
    assert hierarchy_cost(scene) == pytest.approx(total / area(root))


@pytest.mark.parametrize("over", ["triangles", "strips"])
def test_the_cost_of_cells_is_a_plain_sum(over):
    scene = small_scene().under(HierarchyOptions("kdtree", over), 1)
    sizes, found = np.diff(scene.objects(over)), scene.hierarchy
    cells = cells_of(found)
    total = 0.0
    for (a, b), cell in zip(found.nodes.tolist(), cells, strict=True):
        price = sizes[found.references[a : a + (b >> 2)]].sum() if b & 3 == 3 else 1
        total += price * area(cell)
    assert hierarchy_cost(scene) == pytest.approx(total / area(cells[0]))


@pytest.mark.parametrize("levels", [0, 1, 2, 4])
def test_the_regions_of_presorted_trees_are_those_of_a_plain_walk(levels):
    mesh = ball(6)
    order, found = presort(mesh.positions[mesh.faces], levels)
    corners = mesh.positions[mesh.faces[order]]
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    regions, owned, is_inner = presorted_regions(found, boxes)
    at = 0
    for first, last in zip(found.starts[:-1], found.starts[1:], strict=True):
        nodes = -(-(last - first) // 2)
        made = {}
        for node in range(nodes):
            mine = boxes[first + 2 * node : min(first + 2 * node + 2, last)]
            whole = boxes[first:last]
            box = [*whole[:, :3].min(axis=0), *whole[:, 3:].max(axis=0)]
            box = list(made[(node - 1) // 2]) if node else box
            axis = ((node + 1).bit_length() - 1) % 3
            box[axis] = max(box[axis], mine[:, axis].min())
            box[axis + 3] = min(box[axis + 3], mine[:, axis + 3].max())
            made[node] = box
            assert regions[at].tolist() == box
            assert owned[at] == len(mine)
            assert is_inner[at] == (2 * node + 1 < nodes)
            at += 1
    assert at == len(regions)


def test_wide_nodes_cost_at_least_their_root():
    scene = small_scene(block=4)
    assert hierarchy_cost(scene) > 1.0
    assert hierarchy_cost(replace(scene)) == hierarchy_cost(scene)


@pytest.fixture(scope="module")
def found():
    options = StudyOptions(options=Options(threads=1), side=16, runs=1, threads=1)
    return study_hierarchies.study(ball(), options)


def test_nothing_is_wrong_and_all_hits_are_the_same(found):
    assert [row.name for row in found.rows][:3] == ["reducem", "reducem, compressed", "in strips, binary"]
    assert {row.name.split(",")[0] for row in found.rows} >= {"slbvh", "kdtree", "loose-octree", "presorted"}
    for row in found.rows:
        assert (row.disagreements, row.leaks, row.different) == (0, 0, 0), row.name
        assert row.judged > 0
        assert row.cost > 0.0
        assert all(cost.rate > 0.0 and cost.boxes > 0.0 for cost in row.rays)
    assert [row.file_bytes is None for row in found.rows] == [
        row.name.startswith("in ") for row in found.rows
    ]


def test_a_changed_hit_is_counted():
    scene = small_scene()
    tracer = striptools.trace.Tracer(scene, device="cpu", threads=1)
    ways = scene.positions[scene.faces()].mean(axis=1) - np.float32([20, 21, 22])
    hits = tracer.closest_hit(np.tile(np.float32([[20, 21, 22]]), (len(ways), 1)), ways)
    assert study_hierarchies._different(hits, hits) == 0
    other = replace(hits, t=np.nextafter(hits.t, np.float32(0)))
    assert study_hierarchies._different(hits, other) == int(np.isfinite(hits.t).sum()) > 0


def test_it_is_printed_in_every_shape(found):
    tables = study_hierarchies.tables(found)
    ((title, rows),) = tables
    assert f"{found.triangles:,} triangles" in title
    assert len(rows) == len(found.rows)
    facts = json.loads(printed_tables(tables, "json", "ball"))
    assert [row["hierarchy"] for row in facts["tables"][0]["rows"]] == [row.name for row in found.rows]
    assert printed_tables(tables, "csv", "").count("\n") == len(rows) + 1
    assert printed_tables(tables, "text", "ball").startswith("ball: ")
    assert printed_tables(tables, "md", "ball").count("\n|") == len(rows) + 2


def test_the_verb_prints_it_and_writes_table_and_picture(found, monkeypatch, tmp_path, run):
    pytest.importorskip("matplotlib", reason="the extra plots is not installed")
    monkeypatch.setattr(study_hierarchies, "study", lambda *_, **__: found)
    striptools.save_mesh(ball(4), tmp_path / "ball.ply")
    options = ["--out", tmp_path, "--format", "json", "-q"]
    code, out, err = run("study", "hierarchies", tmp_path / "ball.ply", *options)
    assert (code, err) == (0, "")
    assert len(json.loads(out)["tables"]) == 1
    assert (tmp_path / "ball-hierarchies.png").stat().st_size > 1000
    assert (tmp_path / "ball-hierarchies.csv").read_text().startswith("hierarchy,")


def test_two_tables_stand_apart():
    tables = [("one", [{"a": 1}]), ("two", [{"b": 2, "c": 3}])]
    assert printed_tables(tables, "csv", "") == "a\n1\n\nb,c\n2,3\n"


def test_the_picture_is_the_same_each_time(found):
    pytest.importorskip("matplotlib", reason="the extra plots is not installed")
    one, other = io.BytesIO(), io.BytesIO()
    assert study_hierarchies.plot(found, one, "ball") == len(one.getvalue())
    study_hierarchies.plot(found, other, "ball")
    assert one.getvalue() == other.getvalue()
