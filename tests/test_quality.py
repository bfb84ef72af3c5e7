"""The figures of strips against plain counting, and on scenes whose figures are known."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import scene_of, scenes
from strategies import grid, sphere

from striptools.hierarchies.check import check_binary_tree
from striptools.measure.quality import (
    count_swaps,
    full_tree_cost,
    length_histogram,
    quality_tree,
    strip_quality,
    traversal_steps,
)
from striptools.mesh.mesh import Mesh
from striptools.partition.boxes import face_boxes
from striptools.partition.sah import NODE_COST, TRIANGLE_COST, half_area
from striptools.strips.ordering import Sequences
from striptools.strips.topology import RESTART, classic_strips, encode_strips
from striptools.trace import Tracer


def box_of(boxes: np.ndarray) -> np.ndarray:
    return np.concatenate([boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0)])[None]


def area_of(boxes: np.ndarray) -> float:
    return float(half_area(box_of(boxes))[0])


@given(scenes())
def test_quality_equals_plain_counting(pair) -> None:
    _, scene = pair
    quality = strip_quality(scene)
    boxes = face_boxes(scene.positions, scene.faces())
    parts = np.split(boxes, scene.starts[1:-1])
    root = area_of(boxes) or 1.0
    whole = [part for part in parts if len(part) > 1]
    halves = [half for part in whole for half in np.split(part, [(len(part) + 1) // 2])]
    assert quality.triangles == sum(map(len, parts))
    assert quality.strips == len(parts)
    assert quality.singletons == len(parts) - len(whole)
    assert quality.longest == max(map(len, parts))
    assert sum(quality.lengths.values()) == len(parts)
    assert quality.vertices_per_triangle == pytest.approx(1 + 2 * len(parts) / len(boxes))
    assert quality.strip_area == pytest.approx(sum(map(area_of, parts)) / root, rel=1e-9)
    assert quality.half_strip_area == pytest.approx(sum(map(area_of, halves)) / root, rel=1e-9)
    split = sum(map(area_of, whole))
    assert quality.half_share == pytest.approx(sum(map(area_of, halves)) / split if split else 1.0, rel=1e-9)
    assert 0 < quality.half_share <= 2 + 1e-9


@given(scenes())
def test_swaps_are_equal_turns_in_a_row(pair) -> None:
    _, scene = pair
    parts = [turns[1:].tolist() for turns in np.split(scene.turns, scene.starts[1:-1])]
    swaps = sum(one == other for turns in parts for one, other in pairwise(turns))
    assert strip_quality(scene).swaps == count_swaps(scene.turns, scene.starts) == swaps


@given(scenes())
def test_indices_are_those_of_the_common_encoder(pair) -> None:
    _, scene = pair
    quality = strip_quality(scene)
    sequences = Sequences(np.arange(scene.triangle_count, dtype=np.int32), scene.starts)
    welded = scene.leaders[scene.faces()]
    indices = classic_strips(encode_strips(welded, sequences))
    restarts = (indices == RESTART).sum()
    assert quality.classic_indices == len(indices) / scene.triangle_count
    assert quality.classic_indices_without_restarts == (len(indices) - restarts) / scene.triangle_count


@given(scenes())
def test_costs_are_sums_over_the_two_trees(pair) -> None:
    _, scene = pair
    boxes = face_boxes(scene.positions, scene.faces())
    tree = quality_tree(scene, boxes)
    leaves = tree.boxes[tree.size == 1]
    check_binary_tree(tree, leaves)
    assert sorted(leaves.tolist()) == sorted(boxes.tolist())
    area = half_area(tree.boxes)
    share = area / area[0] if area[0] else np.ones_like(area)
    by_hand = (NODE_COST * share[tree.size > 1]).sum() + (TRIANGLE_COST * share[tree.size == 1]).sum()
    quality = strip_quality(scene)
    assert quality.cost == pytest.approx(by_hand, rel=1e-12)
    assert quality.full_cost == full_tree_cost(boxes)
    assert quality.relative_cost == quality.cost / quality.full_cost
    assert strip_quality(scene, full_cost=2.0).full_cost == 2.0


@given(st.lists(st.integers(1, 2**30), max_size=50))
def test_the_histogram_counts_by_doubling_lengths(lengths: list[int]) -> None:
    found = length_histogram(np.array(lengths, np.int32))
    for k, count in found.items():
        assert count == sum(k <= length < 2 * k for length in lengths)
    assert sum(found.values()) == len(lengths)


def test_a_band_is_known_in_every_figure() -> None:
    scene = scene_of(Mesh(*grid(32, 1)))
    quality = strip_quality(scene)
    assert (quality.strips, quality.singletons, quality.longest) == (1, 0, 64)
    assert quality.lengths == {1: 0, 2: 0, 4: 0, 8: 0, 16: 0, 32: 0, 64: 1}
    assert quality.vertices_per_triangle == 66 / 64
    # One where the band begins with the turn that its first triangle does not take.
    assert quality.swaps <= 1
    assert quality.strip_area == 1.0
    assert quality.half_share == pytest.approx(1.0, abs=1e-6)
    # Along a straight band nothing beats halving.
    assert 1.0 <= quality.relative_cost < 1.05


def test_single_triangles_swap_nothing_and_lie_under_the_full_tree() -> None:
    scene = scene_of(Mesh(*sphere(2)), max_length=1)
    quality = strip_quality(scene)
    assert quality.singletons == quality.strips == quality.triangles
    assert (quality.half_strip_area, quality.half_share, quality.swaps) == (0.0, 1.0, 0)
    assert quality.classic_indices <= 4 - 1 / quality.triangles
    assert quality.relative_cost == pytest.approx(1.0, rel=1e-6)


def test_longer_strips_cost_rays_more_steps() -> None:
    mesh = Mesh(*sphere(4))
    random = np.random.default_rng(3)
    directions = random.normal(size=(300, 3)).astype(np.float32)
    origins = -3 * directions / np.linalg.norm(directions, axis=1, keepdims=True).astype(np.float32)
    origins += random.normal(scale=0.3, size=origins.shape).astype(np.float32)
    found = [
        traversal_steps(Tracer(scene_of(mesh, max_length=length)), origins, directions)
        for length in (4, 10**6)
    ]
    assert 1 <= found[0] < found[1]
    assert traversal_steps(Tracer(scene_of(mesh)), origins[:0], directions[:0]) == 0.0
