import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from strategies import cube, grid, meshes

from striptools.errors import LimitError, UsageError
from striptools.mesh import mesh as mesh_module
from striptools.mesh.mesh import Mesh, first_face_out_of_range

POINTS = np.eye(3, dtype=np.float32)


def test_arrays_are_kept_as_they_are():
    mesh = Mesh(*cube(), notes=("one",))
    assert mesh.triangle_count == 12
    assert mesh.vertex_count == 8
    assert mesh.positions.dtype == np.float32
    assert mesh.faces.dtype == np.int32
    assert mesh.notes == ("one",)
    np.testing.assert_array_equal(mesh.bounds, [[0, 0, 0], [1, 1, 1]])


def test_double_positions_and_wide_indices_are_taken():
    mesh = Mesh(POINTS.astype(np.float64), np.array([[0, 1, 2]], np.int64))
    assert mesh.positions.dtype == np.float64
    assert mesh.faces.dtype == np.int32


def test_views_are_made_contiguous():
    mesh = Mesh(np.zeros((4, 6), np.float32)[:, ::2], np.zeros((6, 2), np.int32).T[:, ::2])
    assert mesh.positions.flags.c_contiguous
    assert mesh.faces.flags.c_contiguous


@pytest.mark.parametrize(
    ("positions", "faces", "words"),
    [
        (np.zeros((3, 2), np.float32), np.zeros((1, 3), np.int32), "positions have shape"),
        (POINTS, np.zeros((1, 4), np.int32), "faces have shape"),
        (np.eye(3, dtype=np.int32), np.zeros((1, 3), np.int32), "positions are int32"),
        (POINTS, np.zeros((1, 3), np.float32), "faces are float32"),
        (POINTS, np.array([[0, 1, 2], [0, 1, 3]], np.int32), "face 1 names a vertex"),
        (POINTS, np.array([[0, 1, -1]], np.int32), "face 0 names a vertex"),
    ],
)
def test_wrong_arrays_are_refused(positions, faces, words):
    with pytest.raises(UsageError, match=words):
        Mesh(positions, faces)


def test_too_many_faces_are_refused(monkeypatch):
    monkeypatch.setattr(mesh_module, "MOST_FACES", 11)
    with pytest.raises(LimitError, match="12 faces"):
        Mesh(*cube())


def test_bounds_ignore_what_is_not_finite():
    positions = np.array([[np.nan, 9, 9], [1, 2, 3], [-1, 5, np.inf], [0, 0, 7]], np.float32)
    np.testing.assert_array_equal(Mesh(positions, np.zeros((0, 3), np.int32)).bounds, [[0, 0, 3], [1, 2, 7]])
    np.testing.assert_array_equal(Mesh(positions[:1], np.zeros((0, 3), np.int32)).bounds, np.zeros((2, 3)))


def test_first_face_out_of_range_reads_unsigned_indices():
    faces = np.array([[0, 1, 2], [2**32 - 1, 0, 1]], np.uint32)
    assert first_face_out_of_range(faces, 3) == 1
    assert first_face_out_of_range(faces[:1], 3) is None


def test_dual_graph_of_a_grid():
    graph = Mesh(*grid(2, 1)).dual_graph()
    assert sorted(graph.edges) == [(0, 1), (1, 2), (2, 3)]
    assert graph.edges[0, 1] == {"shared": ((1, 3),), "same_winding": True}


def test_dual_graph_joins_what_faces_share_in_one_edge():
    faces = np.array([[0, 1, 2], [2, 1, 0], [1, 2, 0], [0, 0, 1]], np.int32)
    graph = Mesh(POINTS, faces).dual_graph()
    assert set(graph.nodes) == {0, 1, 2, 3}
    assert graph.edges[0, 1] == {"shared": ((0, 1), (0, 2), (1, 2)), "same_winding": True}
    assert graph.edges[0, 2] == {"shared": ((0, 1), (0, 2), (1, 2)), "same_winding": False}
    assert not any(one == two for one, two in graph.edges)


@given(meshes())
def test_dual_graph_edges_share_the_vertices_they_name(mesh):
    for one, two, data in mesh.dual_graph().edges(data=True):
        assert data["shared"]
        for pair in data["shared"]:
            assert set(pair) <= set(mesh.faces[one].tolist()) & set(mesh.faces[two].tolist())


def test_mesh_stages_load_neither_jax_nor_trimesh_nor_scipy():
    code = (
        "import sys, striptools.mesh.io, striptools.mesh.clean, striptools.mesh.adjacency;"
        "print([name for name in ('jax', 'trimesh', 'scipy', 'networkx', 'numba') if name in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
