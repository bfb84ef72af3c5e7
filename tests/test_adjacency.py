import time
from collections import defaultdict

import numpy as np
import pytest
from hypothesis import given
from strategies import book, cube, fan, meshes, sphere

from striptools.errors import UsageError
from striptools.mesh.adjacency import LONGEST_RING, Adjacency, build_adjacency, check_adjacency
from striptools.mesh.io import load_mesh


def slow_rings(faces):
    """The policy once more, with a dictionary of edges and lists."""
    edges = defaultdict(lambda: ([], []))
    for face, row in enumerate(faces.tolist()):
        for slot in range(3):
            a, b = row[slot], row[(slot + 1) % 3]
            if a != b:
                edges[min(a, b), max(a, b)][a > b].append(3 * face + slot)
    ring = list(range(3 * len(faces)))
    for forward, backward in edges.values():
        turns = []
        for k in range(max(len(forward), len(backward))):
            turns += forward[k : k + 1] + backward[k : k + 1]
        groups = [turns[k : k + 4] for k in range(0, len(turns), 4)]
        if len(groups) > 1 and len(groups[-1]) == 1:
            groups[-2:] = [groups[-2] + groups[-1]]
        for group in groups:
            for here, there in zip(group, group[1:] + group[:1], strict=True):
                ring[here] = there
    return np.array(ring, np.int32)


def of(mesh):
    return build_adjacency(mesh.faces, mesh.vertex_count)


@given(meshes())
def test_equals_the_slow_twin_and_passes_the_check(mesh):
    adjacency = of(mesh)
    np.testing.assert_array_equal(adjacency.ring, slow_rings(mesh.faces))
    check_adjacency(adjacency, mesh.faces)


@pytest.mark.parametrize("pages", range(1, 27))
def test_an_edge_of_many_faces_is_cut_into_rings_of_four(pages):
    positions, faces = book(pages)
    adjacency = build_adjacency(faces, len(positions))
    check_adjacency(adjacency, faces)
    lengths = []
    left = set(np.flatnonzero((faces[:, :2] <= 1).all(axis=1)) * 3)
    while left:
        half = min(left)
        length = 0
        while half in left:
            left.remove(half)
            half = int(adjacency.ring[half])
            length += 1
        lengths.append(length)
    assert sum(lengths) == pages
    assert all(length <= LONGEST_RING for length in lengths)
    assert pages == 1 or min(lengths) >= 2


def test_closed_surface_has_two_half_edges_on_every_ring():
    positions, faces = sphere(2)
    ring = build_adjacency(faces, len(positions)).ring
    half = np.arange(len(ring))
    assert (ring != half).all()
    np.testing.assert_array_equal(ring[ring], half)


def test_no_faces_and_no_vertices():
    faces = np.zeros((0, 3), np.int32)
    adjacency = build_adjacency(faces, 0)
    assert adjacency.ring.shape == (0,)
    check_adjacency(adjacency, faces)


def test_an_index_out_of_range_is_refused():
    with pytest.raises(UsageError, match="face 1"):
        build_adjacency(np.array([[0, 1, 2], [0, 1, 7]], np.int32), 3)


def test_the_input_is_left_alone():
    positions, faces = cube()
    before = faces.copy()
    build_adjacency(faces, len(positions))
    np.testing.assert_array_equal(faces, before)


@pytest.mark.parametrize("shape", [fan, book])
def test_a_hundred_thousand_faces_at_one_place_stay_linear(shape):
    build_adjacency(shape(4)[1], 6)
    seconds = []
    for count in (20_000, 100_000):
        _, faces = shape(count)
        vertex_count = int(faces.max()) + 1
        runs = []
        for _ in range(3):
            start = time.perf_counter()
            build_adjacency(faces, vertex_count)
            runs.append(time.perf_counter() - start)
        seconds.append(min(runs))
    # Quadratic time would be 25 times as much, and minutes of it.
    assert seconds[1] < 15 * seconds[0] + 0.05


def _with(ring, *changes):
    changed = ring.copy()
    for half, value in changes:
        changed[half] = value
    return changed


def _faults():
    _, faces = cube()
    ring = build_adjacency(faces, 8).ring
    pair, other = (0, int(ring[0])), (1, int(ring[1]))
    yield "is not there", faces, ring[:-1], "the ring is int32"
    yield "wide", faces, ring.astype(np.int64), "the ring is int64"
    yield "out of range", faces, _with(ring, (5, len(ring))), "does not exist"
    yield "not a permutation", faces, _with(ring, (5, 0)), "not exactly one"
    yield "crossed", faces, _with(ring, (pair[0], other[1]), (other[0], pair[1])), "on another edge"
    yield "torn", faces, _with(ring, (pair[0], pair[0]), (pair[1], pair[1])), "wrong number of rings"
    loop = np.array([[0, 0, 1], [0, 0, 1]], np.int32)
    ring = build_adjacency(loop, 2).ring
    yield "loop", loop, _with(ring, (0, 3), (3, 0)), "from a vertex to itself"
    _, pages = book(8)
    ring = build_adjacency(pages, 10).ring
    uncut = _with(ring, *zip(range(0, 24, 3), [*range(3, 24, 3), 0], strict=True))
    yield "uncut", pages, uncut, "longer than"
    unmixed = _with(ring, (0, 6), (6, 12), (12, 18), (18, 0), (3, 9), (9, 15), (15, 21), (21, 3))
    yield "windings apart", pages, unmixed, "do not alternate"


@pytest.mark.parametrize(
    ("faces", "ring", "words"), [fault[1:] for fault in _faults()], ids=[f[0] for f in _faults()]
)
def test_check_finds_an_injected_fault(faces, ring, words):
    with pytest.raises(UsageError, match=words):
        check_adjacency(Adjacency(ring), faces)


@pytest.mark.parametrize("name", ["bunny", "icub", "tree_japanesemaple"])
def test_real_models_pass_the_check(real_mesh, name):
    mesh = load_mesh(real_mesh(name))
    adjacency = of(mesh)
    check_adjacency(adjacency, mesh.faces)
    np.testing.assert_array_equal(adjacency.ring, of(mesh).ring)
