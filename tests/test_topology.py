import itertools
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import KINDS, clean_meshes, fan, grid, mesh_of_kind

from striptools.errors import UsageError
from striptools.mesh.adjacency import build_adjacency
from striptools.partition.boxes import face_boxes
from striptools.partition.object_split import split_objects
from striptools.strips.ordering import OrderingOptions, Sequences, order_strips
from striptools.strips.topology import (
    Strips,
    check_sequences,
    check_strips,
    classic_strips,
    count_classic,
    decode_classic,
    decode_strips,
    encode_strips,
    without_flips,
)


def sequences_of(positions: np.ndarray, faces: np.ndarray, max_length: int = 64) -> Sequences:
    tree = split_objects(face_boxes(positions, faces))
    return order_strips(build_adjacency(faces, len(positions)), faces, tree, OrderingOptions(max_length))


def strips_of(positions: np.ndarray, faces: np.ndarray, max_length: int = 64) -> Strips:
    return encode_strips(faces, sequences_of(positions, faces, max_length))


def decoded(strips: Strips) -> np.ndarray:
    return decode_strips(strips.vertices, strips.turns, strips.starts, strips.flips)


def slow_decode(vertices, turns, starts, flips=None) -> list[tuple[int, int, int]]:
    """Triangle after triangle by the rule in the head of strips/topology.py."""
    rows = []
    for strip in range(len(starts) - 1):
        at = starts[strip] + 2 * strip
        for k in range(starts[strip], starts[strip + 1]):
            w = vertices[at + 2 + k - starts[strip]]
            if k == starts[strip]:
                a, b, c = vertices[at], vertices[at + 1], w
            elif turns[k]:
                a, b, c = a, c, w
            else:
                a, b, c = c, b, w
            first, second = (b, a) if flips is not None and flips[k] else (a, b)
            rows.append((int(first), int(second), int(c)))
    return rows


def least_turned(rows: np.ndarray) -> np.ndarray:
    """Each row turned so that its least entry comes first, which keeps reflections apart."""
    corners = (np.arange(3) + np.argmin(rows, axis=1)[:, None]) % 3
    return np.take_along_axis(rows, corners, axis=1)


def sorted_rows(rows: np.ndarray) -> list[list[int]]:
    return sorted(least_turned(rows).tolist())


@st.composite
def any_strips(draw: st.DrawFn) -> Strips:
    """Strips that no encoder of ours would write: any turns, and a vertex of its own for every place."""
    lengths = draw(st.lists(st.integers(1, 9), min_size=0, max_size=5))
    count = sum(lengths)
    starts = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int32)
    turns = np.array(draw(st.lists(st.booleans(), min_size=count, max_size=count)), np.bool_)
    turns[starts[:-1]] = False
    vertices = np.arange(count + 2 * len(lengths), dtype=np.int32)
    flips = np.array(draw(st.lists(st.booleans(), min_size=count, max_size=count)), np.bool_)
    flips[starts[:-1]] = False
    source = np.arange(count, dtype=np.int32), np.zeros(count, np.uint8)
    return Strips(vertices, turns, starts, *source, flips if flips.any() else None)


@given(clean_meshes(), st.sampled_from([1, 2, 3, 64, 1000]))
def test_decode_gives_back_every_face_turned_and_never_reflected(mesh, max_length: int):
    strips = strips_of(mesh.positions, mesh.faces, max_length)
    check_strips(strips, mesh.faces)
    rows = decoded(strips)
    for row, face, turn in zip(rows, strips.source_face, strips.rotation, strict=True):
        assert row.tolist() == np.roll(mesh.faces[face], -int(turn)).tolist()
    assert sorted_rows(rows) == sorted_rows(mesh.faces)


@pytest.mark.parametrize("kind", sorted(KINDS))
@given(data=st.data())
def test_decode_gives_back_every_kind_of_mesh(kind: str, data: st.DataObject):
    mesh = data.draw(mesh_of_kind(kind, hostile=False))
    strips = strips_of(mesh.positions.astype(np.float32), mesh.faces)
    check_strips(strips, mesh.faces)


@given(clean_meshes())
def test_strips_take_two_vertices_more_than_triangles_and_leave_unused_bits_clear(mesh):
    strips = strips_of(mesh.positions, mesh.faces)
    assert len(strips.vertices) == len(strips.turns) + 2 * (len(strips.starts) - 1)
    assert not strips.turns[strips.starts[:-1]].any()
    seconds = strips.starts[:-1][np.diff(strips.starts) > 1] + 1
    assert not strips.turns[seconds].any()


@given(any_strips())
def test_decode_equals_the_slow_twin_for_any_turns(strips: Strips):
    assert [tuple(row) for row in decoded(strips).tolist()] == slow_decode(
        strips.vertices, strips.turns, strips.starts, strips.flips
    )


def decode_triangle(strips: Strips, triangle: int) -> tuple[int, int, int]:
    """One triangle alone, read from its strip's own vertices and turn bits and its flip bit."""
    vertices, turns, starts, flips = strips.vertices, strips.turns, strips.starts, strips.flips
    strip = int(np.searchsorted(starts, triangle, side="right")) - 1
    begin = int(starts[strip])
    first = begin + 2 * strip
    bits = turns[begin + 1 : triangle + 1][::-1]
    places = []
    for corner, bit in ((0, False), (1, True)):
        back = np.flatnonzero(bits == bit)[:1]
        places.append(first + (triangle - begin - int(back[0]) + 1 if len(back) else corner))
    if flips is not None and flips[triangle]:
        places.reverse()
    last = first + triangle - begin + 2
    return int(vertices[places[0]]), int(vertices[places[1]]), int(vertices[last])


@given(any_strips())
def test_each_triangle_can_be_read_alone(strips: Strips):
    for triangle, row in enumerate(decoded(strips).tolist()):
        assert decode_triangle(strips, triangle) == tuple(row)


@given(any_strips())
def test_what_is_decoded_is_encoded_alike(strips: Strips):
    faces = decoded(strips)
    again = encode_strips(faces, Sequences(strips.source_face, strips.starts))
    check_strips(again, faces)
    # The first triangle may be turned anew, and no other differs from its face.
    assert np.array_equal(decoded(again)[again.rotation == 0], faces[again.rotation == 0])
    assert flips_of(again).tolist() == flips_of(strips).tolist()


def flips_of(strips: Strips) -> np.ndarray:
    return np.zeros(len(strips.turns), np.bool_) if strips.flips is None else strips.flips


@given(any_strips())
def test_strips_without_flips_are_the_same_triangles_cut_where_the_winding_changes(strips: Strips):
    faces = decoded(strips)
    cut = without_flips(strips)
    assert cut.flips is None
    check_strips(cut, faces)
    assert cut.source_face.tolist() == strips.source_face.tolist()
    changes = np.flatnonzero(np.diff(flips_of(strips).astype(int))) + 1
    assert cut.starts.tolist() == sorted({*strips.starts.tolist(), *changes.tolist()})


@given(clean_meshes(), st.integers(0, 2**32 - 1), st.sampled_from([1, 2, 3, 64]))
def test_faces_may_be_turned_over_at_will_and_stay_in_their_strips(mesh, seed: int, max_length: int):
    sequences = sequences_of(mesh.positions, mesh.faces, max_length)
    straight = encode_strips(mesh.faces, sequences)
    assert straight.flips is None
    over = np.random.default_rng(seed).random(len(mesh.faces)) < 0.5
    faces = np.where(over[:, None], mesh.faces[:, ::-1], mesh.faces)
    check_sequences(sequences, faces)
    strips = encode_strips(faces, sequences)
    check_strips(strips, faces)
    # A face is flipped where it is turned over against the first of its strip.
    turned = over[sequences.faces]
    firsts = np.repeat(turned[sequences.starts[:-1]], sequences.lengths)
    assert flips_of(strips).tolist() == (turned != firsts).tolist()
    for triangle, row in enumerate(decoded(strips).tolist()):
        assert decode_triangle(strips, triangle) == tuple(row)


@given(clean_meshes(), st.integers(0, 2**32 - 1))
def test_flips_are_refused_where_they_are_forbidden(mesh, seed: int):
    sequences = sequences_of(mesh.positions, mesh.faces)
    over = np.random.default_rng(seed).random(len(mesh.faces)) < 0.5
    faces = np.where(over[:, None], mesh.faces[:, ::-1], mesh.faces)
    if encode_strips(faces, sequences).flips is None:
        check_sequences(sequences, faces, flips=False)
        return
    with pytest.raises(UsageError, match="does not continue"):
        encode_strips(faces, sequences, flips=False)
    with pytest.raises(UsageError, match="does not continue"):
        check_sequences(sequences, faces, flips=False)


def test_flips_do_not_depend_on_the_number_of_threads():
    positions, faces = grid(150, 150)
    sequences = sequences_of(positions, faces)
    faces = np.where(np.random.default_rng(3).random(len(faces))[:, None] < 0.5, faces[:, ::-1], faces)
    one, two = (encode_strips(faces, sequences, threads) for threads in (1, 2))
    for name in ("vertices", "turns", "rotation", "flips"):
        assert np.array_equal(getattr(one, name), getattr(two, name))
    whole = decode_strips(one.vertices, one.turns, one.starts, one.flips, threads=2)
    assert np.array_equal(whole, decoded(one))


def test_a_worked_example_of_flips():
    # The squares of the example below, the second triangle turned over.
    faces = np.array([[0, 1, 3], [3, 4, 1], [1, 2, 4], [2, 5, 4]], np.int32)
    strips = encode_strips(faces, Sequences(np.arange(4, dtype=np.int32), np.array([0, 4], np.int32)))
    assert strips.vertices.tolist() == [0, 1, 3, 4, 2, 5]
    assert strips.turns.tolist() == [False, False, False, True]
    assert strips.flips is not None
    assert strips.flips.tolist() == [False, True, False, False]
    assert decoded(strips).tolist() == [[0, 1, 3], [1, 3, 4], [4, 1, 2], [4, 2, 5]]
    assert strips.rotation.tolist() == [0, 2, 2, 2]


@given(any_strips(), st.sampled_from([-1, 10**6]))
def test_classic_strips_of_any_turns_decode_to_the_same_triangles(strips: Strips, restart: int):
    for rows in (
        decode_classic(classic_strips(strips, restart), restart),
        decode_classic(classic_strips(strips, None)),
    ):
        assert sorted_rows(rows) == sorted_rows(decoded(strips))
    for index in (restart, None):
        assert count_classic(strips, index).indices == len(classic_strips(strips, index))


@given(clean_meshes())
def test_classic_strips_of_any_mesh_decode_to_the_same_triangles(mesh):
    strips = strips_of(mesh.positions, mesh.faces)
    for restart in (-1, None):
        indices = classic_strips(strips, restart)
        assert sorted_rows(decode_classic(indices)) == sorted_rows(mesh.faces)
        assert count_classic(strips, restart).restarts == np.count_nonzero(indices == -1)


def slow_repeats(turns: list[bool]) -> tuple[int, int]:
    """Pairs of equal turns inside a strip, and 1 where its first turn costs an index from either end."""
    inner = turns[2:]
    misfit = bool(inner) and not inner[0] and inner[-1]
    return sum(one == other for one, other in itertools.pairwise(inner)), int(misfit)


@given(any_strips(), st.sampled_from([-1, None]))
def test_the_count_of_classic_strips_is_exact_and_no_more_than_the_slow_twins(strips: Strips, restart):
    strips = replace(strips, flips=None)
    count = count_classic(strips, restart)
    assert count.indices == len(classic_strips(strips, restart))
    between = count.restarts if restart is not None else 2 * (max(len(strips.starts) - 2, 0) - count.joins)
    assert count.indices == len(strips.vertices) + count.repeats + between
    # Vertices differ in all of these strips, so none are joined but those of no strip at all.
    assert count.joins == 0
    slow = [slow_repeats(turns.tolist()) for turns in np.split(strips.turns, strips.starts[1:-1])]
    if restart is not None:
        assert count.repeats == sum(repeats + misfit for repeats, misfit in slow)
        assert count.restarts == max(len(strips.starts) - 2, 0)


def test_strips_that_share_an_end_vertex_follow_at_once():
    # Two fans of two triangles that meet in vertex 3 alone.
    faces = np.array([[0, 1, 2], [2, 1, 3], [3, 4, 5], [5, 4, 6]], np.int32)
    strips = encode_strips(faces, Sequences(np.arange(4, dtype=np.int32), np.array([0, 2, 4], np.int32)))
    indices = classic_strips(strips)
    assert count_classic(strips).joins == 1
    assert indices.tolist() == [0, 1, 2, 3, 3, 4, 5, 6]
    assert sorted_rows(decode_classic(indices)) == sorted_rows(faces)


def test_a_worked_example():
    # Two unit squares side by side, vertices 0 1 2 below and 3 4 5 above.
    faces = np.array([[0, 1, 3], [1, 4, 3], [1, 2, 4], [2, 5, 4]], np.int32)
    strips = encode_strips(faces, Sequences(np.arange(4, dtype=np.int32), np.array([0, 4], np.int32)))
    assert strips.vertices.tolist() == [0, 1, 3, 4, 2, 5]
    assert strips.turns.tolist() == [False, False, False, True]
    assert strips.rotation.tolist() == [0, 2, 2, 2]
    assert decoded(strips).tolist() == [[0, 1, 3], [3, 1, 4], [4, 1, 2], [4, 2, 5]]
    assert classic_strips(strips).tolist() == [0, 1, 3, 1, 4, 2, 5]
    assert count_classic(strips).repeats == 1


def test_faces_that_share_all_edges_leave_a_choice_that_is_taken_right():
    # Face 1 is face 0 reflected and shares all its edges; face 2 shares one, which must stay free.
    faces = np.array([[2, 1, 0], [0, 1, 2], [1, 0, 3]], np.int32)
    for order in ([0, 1, 2], [2, 1, 0]):
        sequences = Sequences(np.array(order, np.int32), np.array([0, 3], np.int32))
        check_sequences(sequences, faces)
        check_strips(encode_strips(faces, sequences), faces)


def test_a_face_is_never_left_by_the_edge_it_was_entered_by():
    faces = np.array([[0, 1, 2], [1, 0, 3], [0, 1, 4]], np.int32)
    with pytest.raises(UsageError, match="at 2"):
        encode_strips(faces, Sequences(np.array([0, 1, 2], np.int32), np.array([0, 3], np.int32)))


def test_a_closed_ring_of_faces_is_cut_once():
    strips = strips_of(*fan(12))
    assert len(strips.starts) == 2
    assert len(strips.vertices) == 14


def test_no_strips_decode_to_no_triangles():
    nothing = np.zeros(0, np.int32)
    assert decode_strips(nothing, np.zeros(0, np.bool_), np.zeros(1, np.int32)).shape == (0, 3)
    assert decode_classic(nothing).shape == (0, 3)


def test_decode_refuses_arrays_that_do_not_belong_together():
    strips = strips_of(*grid(4, 4))
    with pytest.raises(UsageError, match="vertices"):
        decode_strips(strips.vertices[1:], strips.turns, strips.starts)
    for starts in (strips.starts[:-1], strips.starts[::-1], strips.starts[:0], np.repeat(strips.starts, 2)):
        with pytest.raises(UsageError, match="starts"):
            decode_strips(strips.vertices, strips.turns, starts)
    with pytest.raises(UsageError, match="flip bits"):
        decode_strips(strips.vertices, strips.turns, strips.starts, strips.turns[1:])


def test_classic_strips_refuse_what_they_cannot_hold():
    strips = strips_of(*grid(4, 4))
    with pytest.raises(UsageError, match="restart"):
        classic_strips(strips, restart=3)
    with pytest.raises(UsageError, match="repeated vertex"):
        classic_strips(replace(strips, vertices=np.zeros_like(strips.vertices)))


def test_check_strips_finds_each_fault():
    positions, faces = grid(6, 6)
    good = strips_of(positions, faces, max_length=10)
    check_strips(good, faces)

    def changed(name: str, place: int, value: int) -> Strips:
        array = getattr(good, name).copy()
        array[place] = value
        return replace(good, **{name: array})

    faults = {
        "unused turn bit": changed("turns", good.starts[1], 1),
        "not its source": changed("turns", 2, not good.turns[2]),
        "is not its": changed("vertices", 4, good.vertices[4] + 1),
        "source face": changed("rotation", 3, (good.rotation[3] + 1) % 3),
        "0, 1 or 2": changed("rotation", 3, 3),
        "once": changed("source_face", 3, good.source_face[4]),
        "starts": changed("starts", 1, 0),
        "vertices": replace(good, vertices=good.vertices[:-1]),
        "flip bits": replace(good, flips=good.turns[:-1]),
        "but no flip": replace(good, flips=np.zeros_like(good.turns)),
        "first triangle is flipped": replace(good, flips=np.ones_like(good.turns)),
        "1 is not its source face": replace(good, flips=np.arange(len(good.turns)) == 1),
    }
    for what, faulty in faults.items():
        with pytest.raises(UsageError, match=what):
            check_strips(faulty, faces)


def test_check_strips_finds_a_reflection():
    faces = np.array([[0, 1, 2]], np.int32)
    strips = strips_of(np.eye(3, dtype=np.float32), faces)
    with pytest.raises(UsageError, match="source face"):
        check_strips(strips, faces[:, ::-1])
