"""The study of SLBVHs: a row a balance and kind of objects, facts of the heaps, counts of the walks."""

from dataclasses import replace

import numpy as np
import pytest
from strategies import sphere

import striptools
from striptools.hierarchies.options import HierarchyOptions
from striptools.hierarchies.slbvh import build_slbvh
from striptools.measure.study import RAY_KINDS, StudyOptions, study_rays
from striptools.measure.study_slbvh import study, tables
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.partition.boxes import range_boxes
from striptools.trace import Tracer

OPTIONS = StudyOptions(Options(threads=1), side=24, runs=1, device="cpu", threads=1)


@pytest.fixture(scope="module")
def found():
    return study(Mesh(*sphere(4)), OPTIONS)


def test_there_is_a_row_for_each_balance_and_kind_of_objects(found):
    assert [row.balance for row in found.rows] == [None] + ["sah"] * 3 + ["morton"] * 3
    assert [row.over for row in found.rows] == ["triangles"] + ["triangles", "strips", "blocks"] * 2
    assert found.triangles == 2048
    assert found.ray_counts[0] == 24 * 24
    assert found.ray_counts[2] == 24 * 24 // 4
    assert all(len(row.rays) == len(RAY_KINDS) for row in found.rows)
    assert all(cost.rate > 0 for row in found.rows for cost in row.rays)


def test_rows_tell_what_the_heaps_are_and_what_walks_count(found):
    scene = striptools.convert(Mesh(*sphere(4)), OPTIONS.options)
    rays = study_rays(scene, Tracer(scene, device="cpu", threads=1), OPTIONS)
    for row in found.rows[1:]:
        boxes = range_boxes(scene.triangle_boxes(1), scene.objects(row.over))
        slbvh = build_slbvh(boxes, HierarchyOptions("slbvh", over=row.over, balance=row.balance))
        assert (row.depth, row.node_bytes, row.objects) == (slbvh.depth, slbvh.nodes.nbytes, len(boxes))
        assert row.empty == pytest.approx(np.mean(slbvh.counts[1:] == 0))
        tracer = Tracer(replace(scene, hierarchy=slbvh), device="cpu", threads=1)
        counters = tracer.closest_hit(rays[1].origins, rays[1].directions, counters=True).counters
        assert row.rays[1].boxes == pytest.approx(counters.nodes.mean())
        assert row.rays[1].triangles == pytest.approx(counters.triangles.mean())


def test_tables_have_a_line_a_row(found):
    parts = tables(found)
    assert len(parts) == 1 + len(RAY_KINDS)
    assert all(len(rows) == len(found.rows) for _, rows in parts)
    assert parts[0][1][0] | {"build_s": None} == parts[0][1][0], "the wide walk has no build of its own"
    assert parts[1][1][0]["ratio"] == 1
    assert parts[0][1][1]["B/triangle"] == found.rows[1].node_bytes / 2048
