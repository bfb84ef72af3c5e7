"""The study of the loose octree: a row a build and kind of objects, costs by definition, counts of walks."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from strategies import sphere

import striptools
from striptools.hierarchies.loose_octree import build_loose_octree
from striptools.hierarchies.options import HierarchyOptions
from striptools.measure.study import RAY_KINDS, StudyOptions, study_rays
from striptools.measure.study_loose import BUILDS, study, tables
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.partition.boxes import range_boxes
from striptools.partition.sah import half_area
from striptools.trace import Tracer

OPTIONS = StudyOptions(Options(threads=1), side=24, runs=1, device="cpu", threads=1)


@pytest.fixture(scope="module")
def found():
    return study(Mesh(*sphere(4)), OPTIONS)


def test_there_is_a_row_for_each_build_and_kind_of_objects(found):
    assert [row.build for row in found.rows] == [*BUILDS, *BUILDS]
    assert [row.over for row in found.rows] == ["triangles"] * 3 + ["strips"] * 3
    assert (found.triangles, found.ray_counts[0], found.ray_counts[2]) == (2048, 24 * 24, 24 * 24 // 4)
    assert all(row.seconds > 0 and row.shuffled_seconds > 0 for row in found.rows)
    assert all(cost.rate > 0 for row in found.rows for cost in row.rays)


def cost_slowly(hierarchy, starts, boxes):
    """Areas of all nodes and of the balanced halves in each object, over the root's."""
    area = half_area(hierarchy.nodes[:, :6].view(np.float32)).tolist()

    def halves(first, end):
        box = np.concatenate([boxes[first:end, :3].min(axis=0), boxes[first:end, 3:].max(axis=0)])
        area.append(half_area(box[None])[0])
        if end - first > 1:
            middle = first + (end - first + 1) // 2
            halves(first, middle)
            halves(middle, end)

    for first, end in pairwise(starts.tolist()):
        if end - first > 1:
            middle = first + (end - first + 1) // 2
            halves(first, middle)
            halves(middle, end)
    return sum(area) / area[0]


def test_rows_tell_what_the_hierarchies_are_and_what_walks_count(found):
    scene = striptools.convert(Mesh(*sphere(4)), OPTIONS.options)
    boxes = scene.triangle_boxes(1)
    sah = found.rows[2]
    assert sah.relative_cost == pytest.approx(1.0)
    assert sah.lead == 1
    rays = study_rays(scene, Tracer(scene, device="cpu", threads=1), OPTIONS)
    costs = []
    for row in (found.rows[0], found.rows[3]):
        options, starts = HierarchyOptions("loose-octree", over=row.over), scene.objects(row.over)
        built = build_loose_octree(range_boxes(boxes, starts), options)
        assert (row.objects, row.node_bytes) == (len(starts) - 1, built.nodes.nbytes)
        single = build_loose_octree(range_boxes(boxes, starts), options, leaf_size=1)
        costs.append(cost_slowly(single, starts, boxes) / row.relative_cost)
        tracer = Tracer(replace(scene, hierarchy=built), device="cpu", threads=1)
        counters = tracer.closest_hit(rays[1].origins, rays[1].directions, counters=True).counters
        assert row.rays[1].triangles == pytest.approx(counters.triangles.mean())
        assert row.rays[1].tests == pytest.approx(counters.boxes.mean() + counters.triangles.mean())
    assert costs[0] == pytest.approx(costs[1])


def test_tables_have_a_line_a_row(found):
    parts = tables(found)
    assert len(parts) == 1 + len(RAY_KINDS)
    assert all(len(rows) == len(found.rows) for _, rows in parts)
    assert parts[1][1][2]["ratio"] == 1
    assert parts[0][1][0]["B/triangle"] == found.rows[0].node_bytes / 2048
