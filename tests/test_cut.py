"""Cuts of the object tree against a recursive twin, and splits aligned with blocks."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import clean_meshes, grid, sphere

from striptools.errors import UsageError
from striptools.partition.boxes import face_boxes
from striptools.partition.cut import Cut, check_cut, cut_tree, grouped
from striptools.partition.object_split import ObjectTree, check_object_tree, split_objects
from striptools.partition.sah import PartitionOptions
from striptools.strips.ordering import OrderingOptions
from striptools.strips.stripify import cut_for


def tree_of(positions: np.ndarray, faces: np.ndarray, block: int | None = None) -> ObjectTree:
    return split_objects(face_boxes(positions, faces), PartitionOptions(block=block))


def slow_cut(tree: ObjectTree, faces: np.ndarray, triangles: int, vertices: int) -> list[int]:
    """The largest subtrees within both limits, from the root down."""
    starts, waiting = [], [(0, 0)]
    while waiting:
        node, begin = waiting.pop()
        size = int(tree.size[node])
        used = np.unique(faces[tree.order[begin : begin + size]])
        if size == 1 or (size <= triangles and len(used) <= vertices):
            starts.append(begin)
            continue
        left = int(tree.size[node + 1])
        waiting += [(node + 2 * left, begin + left), (node + 1, begin)]
    return [*starts, len(tree.order)]


@given(clean_meshes(), st.sampled_from([1, 2, 7, 64, 10**6]), st.sampled_from([3, 4, 9, 10**6]))
def test_a_cut_equals_the_slow_twin(mesh, triangles: int, vertices: int):
    tree = tree_of(mesh.positions, mesh.faces)
    limits = {"faces": mesh.faces, "vertex_count": mesh.vertex_count, "most_vertices": vertices}
    cut = cut_tree(tree, triangles, **limits)
    assert cut.starts.tolist() == slow_cut(tree, mesh.faces, triangles, vertices)
    check_cut(cut, tree, triangles, faces=mesh.faces, most_vertices=vertices)
    assert cut_tree(tree, triangles).starts.tolist() == slow_cut(tree, mesh.faces, triangles, 10**9)


@given(clean_meshes(), st.integers(1, 100))
def test_jobs_hold_every_range_once(mesh, triangles: int):
    cut = cut_tree(tree_of(mesh.positions, mesh.faces), 4)
    jobs = grouped(cut, triangles)
    assert (jobs[0], jobs[-1]) == (0, cut.count)
    assert (np.diff(jobs) > 0).all()


@pytest.mark.parametrize("mesh", [grid(40, 30), sphere(3)])
@pytest.mark.parametrize("block", [16, 64])
def test_aligned_splits_ask_for_no_block_more(mesh, block: int):
    tree = tree_of(*mesh, block)
    check_object_tree(tree)
    nodes = np.flatnonzero((tree.size > block) & (tree.size <= 4 * block))
    left = tree.size[nodes + 1]
    right = tree.size[nodes] - left
    assert (-(-left // block) + -(-right // block) == -(-tree.size[nodes] // block)).all()
    assert cut_tree(tree, block).count <= cut_tree(tree_of(*mesh), block).count


def test_blocks_keep_both_limits():
    positions, faces = grid(50, 20)
    soup = positions[faces].reshape(-1, 3)
    loose = np.arange(len(soup), dtype=np.int32).reshape(-1, 3)
    tree = tree_of(soup, loose, 64)
    cut = cut_for(tree, loose, len(soup), OrderingOptions(block=64))
    check_cut(cut, tree, 64, faces=loose, most_vertices=64)
    assert np.diff(cut.starts).max() <= 64 // 3


def test_check_cut_finds_each_fault():
    positions, faces = grid(9, 9)
    tree = tree_of(positions, faces)
    good = cut_tree(tree, 20)
    check_cut(good, tree, 20)
    faults = {
        "rise": replace(good, starts=good.starts + 1),
        "below one node": Cut(np.array([0, 1, len(faces)], np.int32)),
        "more than": cut_tree(tree, 60),
    }
    for what, faulty in faults.items():
        with pytest.raises(UsageError, match=what):
            check_cut(faulty, tree, 20)
    with pytest.raises(UsageError, match="vertices"):
        check_cut(good, tree, 20, faces=faces, most_vertices=3)


@pytest.mark.parametrize(
    ("triangles", "limits", "what"),
    [
        (0, {}, "most_triangles"),
        (9, {"most_vertices": 9}, "needs the faces"),
        (9, {"most_vertices": 2, "faces": grid(2, 2)[1], "vertex_count": 9}, "most_vertices"),
    ],
)
def test_limits_that_cannot_be_kept_are_refused(triangles: int, limits: dict, what: str):
    with pytest.raises(UsageError, match=what):
        cut_tree(tree_of(*grid(2, 2)), triangles, **limits)


@pytest.mark.parametrize("block", [3, 65537])
def test_a_block_out_of_range_is_refused(block: int):
    with pytest.raises(UsageError, match="block"):
        PartitionOptions(block=block)
