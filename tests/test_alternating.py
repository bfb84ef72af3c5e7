"""Classic alternating strips: valid covers, prices against a slow twin, rows on grids, any thread count."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import KINDS, clean_meshes, fan, grid, mesh_of_kind, sphere

from striptools.errors import UsageError
from striptools.kernels import alternating_search as search
from striptools.mesh.adjacency import Adjacency, build_adjacency
from striptools.mesh.mesh import Mesh
from striptools.strips import alternating
from striptools.strips.alternating import AlternatingOptions, alternating_strips
from striptools.strips.ordering import Sequences
from striptools.strips.topology import (
    check_sequences,
    check_strips,
    classic_strips,
    count_classic,
    decode_classic,
    encode_strips,
)

EFFORTS = ("fast", "normal", "best")


def strips_of(
    mesh: Mesh, effort: alternating.Effort = "normal", price: int = 3, threads: int = 1
) -> Sequences:
    adjacency = build_adjacency(mesh.faces, mesh.vertex_count)
    return alternating_strips(adjacency, mesh.faces, AlternatingOptions(effort, price), threads)


def shuffled(positions: np.ndarray, faces: np.ndarray) -> Mesh:
    return Mesh(positions, faces[np.random.default_rng(7).permutation(len(faces))])


def sorted_rows(rows: np.ndarray) -> list[list[int]]:
    corners = (np.arange(3) + np.argmin(rows, axis=1)[:, None]) % 3
    return sorted(np.take_along_axis(rows, corners, axis=1).tolist())


def slow_strips(mate: list[int]) -> list[list[int]]:
    """The turns of each strip, found by walking lists."""
    links = [[h for h in range(3 * t, 3 * t + 3) if mate[h] >= 0] for t in range(len(mate) // 3)]
    done: set[int] = set()
    strips = []
    for first, linked in enumerate(links):
        if len(linked) == 2 or first in done:
            continue
        turns, face, leave = [], first, linked[0] if linked else -1
        done.add(face)
        while leave >= 0:
            entry = mate[leave]
            face = entry // 3
            done.add(face)
            leave = next((h for h in links[face] if h != entry), -1)
            if leave >= 0:
                turns.append((leave - entry) % 3 - 1)
        strips.append(turns)
    assert len(done) == len(links)
    return strips


def slow_price(mate: np.ndarray, strip_price: int) -> int:
    """3 a strip, 1 a repeated turn, 1 where neither end begins with a turn of 1."""
    price = 0
    for turns in slow_strips(mate.tolist()):
        repeats = sum(one == other for one, other in itertools.pairwise(turns))
        misfit = bool(turns) and turns[0] == 0 and turns[-1] == 1
        price += strip_price + repeats + misfit
    return price


@given(clean_meshes(), st.sampled_from(EFFORTS), st.integers(1, 5))
def test_strips_cover_any_mesh_and_decode_to_it(mesh: Mesh, effort, price: int):
    sequences = strips_of(mesh, effort, price)
    check_sequences(sequences, mesh.faces, flips=False)
    strips = encode_strips(mesh.faces, sequences)
    check_strips(strips, mesh.faces)
    for restart in (-1, None):
        assert sorted_rows(decode_classic(classic_strips(strips, restart))) == sorted_rows(mesh.faces)


@pytest.mark.parametrize("kind", sorted(KINDS))
@given(data=st.data())
def test_strips_cover_every_kind_of_mesh(kind: str, data: st.DataObject):
    mesh = data.draw(mesh_of_kind(kind, hostile=False))
    check_sequences(strips_of(mesh, "best"), mesh.faces)


@given(clean_meshes(), st.integers(0, 3), st.integers(1, 4))
def test_what_the_search_saves_is_what_the_slow_price_falls_by(mesh: Mesh, rotations: int, price: int):
    adjacency = build_adjacency(mesh.faces, mesh.vertex_count)
    forward = (mesh.faces < np.roll(mesh.faces, -1, axis=1)).reshape(-1)
    _, mate = alternating._seeded(adjacency.ring, forward, price, lines=True)
    before = slow_price(mate, price)
    cover = alternating._numbered(adjacency.ring, forward, mate)
    ids = np.arange(len(cover.first), dtype=np.int64)
    saved = search.search_strips(ids, 4, rotations, price, search.ANY_PART, cover)
    assert slow_price(mate, price) == before - saved
    saved += search.search_cuts(rotations, price, True, search.ANY_PART, cover)
    assert slow_price(mate, price) == before - saved
    check_numbers(cover)


def check_numbers(cover: search.Cover) -> None:
    """Each strip that still stands is numbered from its first end on, and knows its misfit."""
    for strip in np.flatnonzero(cover.first >= 0):
        members = np.flatnonzero(cover.owner == strip)
        assert sorted(cover.pos[members].tolist()) == list(range(len(members)))
        assert cover.pos[cover.first[strip]] == 0
        assert cover.pos[cover.last[strip]] == len(members) - 1
        ends = (
            search.begins_badly(cover.first[strip], cover.mate),
            search.begins_badly(cover.last[strip], cover.mate),
        )
        assert cover.misfit[strip] == all(ends)


@given(clean_meshes())
def test_the_price_is_the_count_of_the_encoder_where_no_strips_are_joined(mesh: Mesh):
    sequences = strips_of(mesh)
    apart = [
        count_classic(
            encode_strips(
                mesh.faces[part],
                Sequences(np.arange(len(part), dtype=np.int32), np.array([0, len(part)], np.int32)),
            )
        ).indices
        for part in np.split(sequences.faces, sequences.starts[1:-1])
    ]
    whole = count_classic(encode_strips(mesh.faces, sequences))
    assert whole.indices <= sum(apart) + len(apart) - 1


@pytest.mark.parametrize(("columns", "rows"), [(30, 20), (20, 30), (25, 25)])
def test_a_shuffled_grid_is_taken_row_by_row_along_its_longer_side(columns: int, rows: int):
    mesh = shuffled(*grid(columns, rows))
    lengths = strips_of(mesh).lengths
    assert lengths.tolist() == [2 * max(columns, rows)] * min(columns, rows)
    count = count_classic(encode_strips(mesh.faces, strips_of(mesh)))
    # By the direction of the diagonals all rows are misfits or none is.
    assert count.repeats in (0, min(columns, rows))


@pytest.mark.parametrize("price", [3, 4])
def test_more_effort_is_not_worse_on_a_sphere(price: int):
    mesh = shuffled(*sphere(5))
    counts = [
        count_classic(encode_strips(mesh.faces, strips_of(mesh, effort, price)), -1 if price == 3 else None)
        for effort in EFFORTS
    ]
    assert counts[0].indices >= counts[1].indices >= counts[2].indices
    assert counts[0].indices < 1.16 * mesh.triangle_count


def test_the_strips_are_the_same_for_any_number_of_threads(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(alternating, "PART_FACES", 500)
    mesh = shuffled(*sphere(5))
    one = strips_of(mesh, "normal", threads=1)
    check_sequences(one, mesh.faces)
    for threads in (2, 5):
        other = strips_of(mesh, "normal", threads=threads)
        np.testing.assert_array_equal(one.faces, other.faces)
        np.testing.assert_array_equal(one.starts, other.starts)


def test_parts_cost_little(monkeypatch: pytest.MonkeyPatch):
    mesh = Mesh(*sphere(5))
    whole = count_classic(encode_strips(mesh.faces, strips_of(mesh))).indices
    monkeypatch.setattr(alternating, "PART_FACES", 500)
    parts = count_classic(encode_strips(mesh.faces, strips_of(mesh))).indices
    assert parts < 1.02 * whole


def test_a_fan_a_band_and_lone_triangles():
    assert strips_of(Mesh(*fan(300))).lengths.tolist() == [300]
    assert strips_of(shuffled(*grid(5000, 1))).lengths.tolist() == [10000]
    apart = Mesh(np.eye(9, 3, dtype=np.float32), np.arange(9, dtype=np.int32).reshape(3, 3))
    assert strips_of(apart).lengths.tolist() == [1, 1, 1]


def test_a_long_band_takes_linear_time():
    # Renumbering the band at every link would take hours.
    lengths = strips_of(shuffled(*grid(300_000, 1)), "fast").lengths
    assert lengths.tolist() == [600_000]


def test_no_faces_give_no_strips():
    nothing = alternating_strips(Adjacency(np.zeros(0, np.int32)), np.zeros((0, 3), np.int32))
    assert len(nothing.faces) == 0
    assert nothing.starts.tolist() == [0]


@pytest.mark.parametrize("wrong", [{"effort": "most"}, {"strip_price": 0}, {"strip_price": 101}])
def test_options_out_of_range_are_refused(wrong: dict):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        AlternatingOptions(**wrong)


def test_arrays_of_two_meshes_are_refused():
    positions, faces = grid(3, 3)
    with pytest.raises(UsageError, match="one mesh"):
        alternating_strips(build_adjacency(faces, len(positions)), faces[1:])


@pytest.mark.parametrize(("name", "most"), [("bunny", 1.16), ("dem_jacksboro", 1.005)])
def test_indices_per_triangle_of_real_meshes_with_restarts(real_mesh, name: str, most: float):
    from striptools.mesh.clean import clean
    from striptools.mesh.io import load_mesh

    mesh = clean(load_mesh(real_mesh(name))).mesh
    count = count_classic(encode_strips(mesh.faces, strips_of(mesh)))
    assert count.indices <= most * mesh.triangle_count
