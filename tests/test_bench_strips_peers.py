"""The bench against other stripifiers counts and decodes alike for all of them."""

import sys
from pathlib import Path

import numpy as np
import pytest
from strategies import grid, sphere

from striptools.mesh.mesh import Mesh

sys.path.insert(0, str(Path(__file__).parent / "benches"))
import bench_strips_peers as bench

RESTART = bench.RESTART


def test_an_index_list_is_decoded_by_its_definition() -> None:
    indices = np.array([0, 1, 2, 3, 3, 4, RESTART, 7, 8, 9], np.int32)
    # 2 3 3 and 3 3 4 have a repeated vertex.
    assert bench.decoded(indices).tolist() == [[0, 1, 2], [2, 1, 3], [7, 8, 9]]
    outcome = bench.Outcome("any", indices, 0.0)
    assert (bench.strips(outcome), bench.size(outcome)) == (2, 10)


def test_lists_are_joined_by_restarts() -> None:
    joined = bench.joined(np.arange(7), np.array([0, 3]))
    assert joined.tolist() == [RESTART, 0, 1, 2, RESTART, 3, 4, 5, 6]


def test_faces_are_the_same_when_turned_but_not_when_flipped() -> None:
    _, faces = sphere(1)
    turned = np.roll(faces[::-1], 1, axis=1)
    assert np.array_equal(bench.sorted_faces(faces), bench.sorted_faces(turned))
    assert not np.array_equal(bench.sorted_faces(faces), bench.sorted_faces(faces[:, ::-1]))


@pytest.mark.parametrize("package", ["meshoptimizer", "vtk", "pyffi"])
def test_a_peer_gives_the_mesh_back(package: str) -> None:
    pytest.importorskip(package, reason="the extra peers is not installed")
    tools = {
        "meshoptimizer": bench.meshoptimizer,
        "vtk": bench.vtk_stripper,
        "pyffi": bench.pyffi_strips,
    }
    for shape in (grid(9, 7), sphere(2)):
        mesh = Mesh(*shape)
        for outcome in tools[package](mesh):
            assert np.array_equal(
                bench.sorted_faces(bench.decoded(outcome.indices)), bench.sorted_faces(mesh.faces)
            )


def test_a_peer_that_is_missing_is_left_out_with_a_word(monkeypatch, capsys) -> None:
    monkeypatch.setattr(bench.importlib.util, "find_spec", lambda name: None)
    assert list(bench.peer_tools(Mesh(*grid(2, 2)))) == []
    said = capsys.readouterr().out
    assert all(f"{package} is not installed" in said for package in ("meshoptimizer", "vtk", "pyffi"))


def test_wrong_faces_are_a_failure(monkeypatch, capsys) -> None:
    mesh = Mesh(*grid(3, 3))
    monkeypatch.setattr(bench, "peer_tools", lambda mesh: iter(()))
    rows, right = bench.compare_classic("grid", mesh)
    assert right
    assert len(rows) == 2
    monkeypatch.setattr(bench, "our_tools", lambda mesh: iter([bench.Outcome("us", np.arange(3), 0.0)]))
    assert not bench.compare_classic("grid", mesh)[1]
    assert "WRONG FACES" in capsys.readouterr().out
