"""Greedy linking and tunnels against slow twins, strips in ranges, hostile meshes and how time grows."""

import time
from collections.abc import Callable
from dataclasses import replace
from math import frexp, log2

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import book, clean_meshes, fan, grid, soup, sphere, stack, tangle

from striptools.errors import UsageError
from striptools.kernels import strip_chunks, strip_tunnels
from striptools.mesh.adjacency import build_adjacency
from striptools.partition.boxes import face_boxes, node_boxes
from striptools.partition.cut import cut_tree
from striptools.partition.object_split import ObjectTree, split_objects
from striptools.partition.sah import half_area
from striptools.strips.linking import link_faces
from striptools.strips.ordering import METHODS, OrderingOptions, Sequences
from striptools.strips.stripify import TRIANGLES_A_STRIP, cut_for, order_cut, stripify
from striptools.strips.topology import check_sequences, check_strips, encode_strips
from striptools.strips.tunnelling import EFFORTS, Effort

Arrays = tuple[np.ndarray, np.ndarray]

efforts = st.builds(
    Effort,
    rotations=st.integers(0, 3),
    neutral=st.integers(0, 2),
    price=st.sampled_from([0.0, 1.0, 9.0]),
    rise=st.sampled_from([0.0, 0.05, 1.0]),
    passes=st.integers(1, 3),
)
caps = st.sampled_from([1, 2, 3, 7, 64, 10**6])


def prepared(positions: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, int, np.ndarray, ObjectTree]:
    boxes = face_boxes(positions, faces)
    return faces, len(positions), boxes, split_objects(boxes)


def as_lists(sequences: Sequences) -> list[list[int]]:
    return [part.tolist() for part in np.split(sequences.faces, sequences.starts[1:-1])]


def slow_linking(positions: np.ndarray, faces: np.ndarray, most: int) -> list[list[int]]:
    """Sort all pairs of half-edges by the class of their common node, then link what may be linked."""
    _, _, _, tree = prepared(positions, faces)
    ring = build_adjacency(faces, len(positions)).ring
    place = {int(face): k for k, face in enumerate(tree.order)}
    pairs = []
    for h in range(3 * len(faces)):
        g = int(ring[h])
        while g != h:
            t, u = h // 3, g // 3
            one, other = 3 * place[t] + h % 3, 3 * place[u] + g % 3
            if one < other and t != u and faces[t, h % 3] != faces[u, g % 3]:
                pairs.append((size_class(tree, t, u), one, other))
            g = int(ring[g])
    strips = [[k] for k in range(len(faces))]
    used: set[int] = set()
    for _, h, g in sorted(pairs, key=lambda pair: pair[:2]):
        one = next(s for s in strips if h // 3 in s)
        other = next(s for s in strips if g // 3 in s)
        ends = h // 3 in (one[0], one[-1]) and g // 3 in (other[0], other[-1])
        if one is not other and ends and not used & {h, g} and len(one) + len(other) <= most:
            used |= {h, g}
            front = one if one[-1] == h // 3 else one[::-1]
            back = other if other[0] == g // 3 else other[::-1]
            strips = [s for s in strips if s is not one and s is not other] + [front + back]
    turned = [s if s[0] <= s[-1] else s[::-1] for s in strips]
    return [[int(tree.order[k]) for k in s] for s in sorted(turned)]


def size_class(tree: ObjectTree, t: int, u: int) -> int:
    a, b = int(tree.leaf_node[t]), int(tree.leaf_node[u])
    while not a <= b < a + 2 * int(tree.size[a]) - 1:
        a = int(tree.parent[a])
    size = int(tree.size[a])
    octave = int(log2(size))
    return 2 * octave + (2 * size >= 3 * 2**octave)


@given(clean_meshes(), caps)
@settings(max_examples=25)
def test_linking_equals_the_slow_twin(mesh, most: int):
    faces, vertices, _, tree = prepared(mesh.positions, mesh.faces)
    adjacency = build_adjacency(faces, vertices)
    linked = link_faces(adjacency, faces, tree, OrderingOptions(most))
    # Rings that hold more than one pair are walked in another order by face numbers than by places.
    if all(ring_is_pair(adjacency.ring, h) for h in range(3 * len(faces))):
        assert as_lists(linked) == slow_linking(mesh.positions, mesh.faces, most)
    check_sequences(linked, faces, most, flips=False)


def ring_is_pair(ring: np.ndarray, h: int) -> bool:
    return ring[ring[h]] == h


@pytest.mark.parametrize("mesh", [grid(9, 7), sphere(2), fan(64)])
@pytest.mark.parametrize("most", [5, 1000])
def test_linking_whole_meshes_equals_the_slow_twin(mesh: Arrays, most: int):
    faces, vertices, _, tree = prepared(*mesh)
    linked = link_faces(build_adjacency(faces, vertices), faces, tree, OrderingOptions(most))
    assert as_lists(linked) == slow_linking(*mesh, most)


def slow_cost(boxes: np.ndarray) -> float:
    """Areas of the inner nodes of the balanced tree over a strip, and the weight of its own box."""

    def inner(part: np.ndarray) -> float:
        if len(part) == 1:
            return 0.0
        half = (len(part) + 1) // 2
        return area(part) + inner(part[:half]) + inner(part[half:])

    def area(part: np.ndarray) -> float:
        hull = np.concatenate([part[:, :3].min(axis=0), part[:, 3:].max(axis=0)])[None]
        return float(half_area(hull)[0])

    return inner(boxes) + strip_tunnels.TOP_WEIGHT * area(boxes)


@given(clean_meshes(), caps, efforts, st.booleans())
def test_the_costs_that_tunnels_keep_are_those_of_the_strips_they_leave(
    mesh, most: int, effort: Effort, flips: bool
):
    faces, vertices, boxes, tree = prepared(mesh.positions, mesh.faces)
    order, first = np.zeros(len(faces), np.int32), np.zeros(len(faces), np.bool_)
    given_tree = (tree.order, tree.leaf_node, tree.parent, tree.size, cut_tree(tree, 10**6).starts)
    number = np.full(vertices, -1, np.int32)
    before, after, _ = strip_chunks.order_ranges(
        faces, boxes, *given_tree, 0, 1, most, effort.numbers, flips, number, order, first
    )
    assert (number == -1).all()
    starts = np.append(np.flatnonzero(first), len(faces)).astype(np.int32)
    check_sequences(Sequences(order, starts), faces, most, flips=flips)
    scale = 2.0 ** -frexp(float(np.abs(boxes).max()))[1]
    parts = np.split(boxes[order].astype(np.float64) * scale, starts[1:-1])
    leaves = half_area(boxes.astype(np.float64) * scale).sum()
    if max(map(len, parts)) <= strip_tunnels.LONGEST:
        assert after == pytest.approx(leaves + sum(map(slow_cost, parts)), rel=1e-5, abs=1e-20)
    assert after <= before * (1 + effort.rise) * (1 + 1e-9)


@given(clean_meshes(), caps, efforts)
@settings(max_examples=25)
def test_tunnels_never_make_more_strips(mesh, most: int, effort: Effort):
    one = prepared(mesh.positions, mesh.faces)
    cut = cut_tree(one[3], 10**6)
    linked, tunnelled = order_cut(*one, cut, most), order_cut(*one, cut, most, effort)
    assert len(tunnelled.starts) <= len(linked.starts)
    check_strips(encode_strips(one[0], tunnelled), one[0])


@given(clean_meshes(), st.sampled_from(METHODS), caps, st.sampled_from([None, 4, 16, 64]))
def test_every_method_gives_sequences_within_the_cap(mesh, method, most: int, block: int | None):
    one = prepared(mesh.positions, mesh.faces)
    options = OrderingOptions(most, method, block=block)
    flips = method == "strip-rt"
    check_sequences(stripify(*one, options, threads=2), mesh.faces, most, flips=flips)
    without = stripify(*one, replace(options, flips=False))
    check_sequences(without, mesh.faces, most, flips=False)
    assert len(stripify(*one, options).starts) <= len(without.starts)


@given(clean_meshes(), st.sampled_from([4, 16, 64]))
@settings(max_examples=20)
def test_no_strip_crosses_a_block(mesh, block: int):
    one = prepared(mesh.positions, mesh.faces)
    options = OrderingOptions(block=block)
    sequences, cut = stripify(*one, options), cut_for(one[3], one[0], one[1], options)
    assert np.isin(cut.starts, sequences.starts).all()
    for begin, end in zip(cut.starts[:-1], cut.starts[1:], strict=True):
        assert set(sequences.faces[begin:end]) == set(one[3].order[begin:end])


def test_strips_do_not_depend_on_the_number_of_threads():
    one = prepared(*grid(150, 150))
    cut = cut_tree(one[3], 2000)
    runs = [order_cut(*one, cut, 64, EFFORTS["normal"], threads) for threads in (1, 2, 5)]
    for run in runs[1:]:
        assert np.array_equal(run.faces, runs[0].faces)
        assert np.array_equal(run.starts, runs[0].starts)


@given(clean_meshes(), caps, efforts, st.sampled_from([8, 10**6]))
def test_flips_never_cost_more_than_they_save(mesh, most: int, effort: Effort, chunk: int):
    one = prepared(mesh.positions, mesh.faces)
    cut = cut_tree(one[3], chunk)
    plain, flipped = (order_cut(*one, cut, most, effort, flips=flips) for flips in (False, True))
    strips = encode_strips(one[0], flipped)
    check_strips(strips, one[0])
    if strips.flips is None:
        assert as_lists(flipped) == as_lists(plain)
    else:
        assert (len(plain.starts) - len(flipped.starts)) * TRIANGLES_A_STRIP > len(one[0])


@given(st.integers(3, 8), st.integers(1, 60), st.integers(0, 2**32 - 1))
def test_rows_with_repeated_vertices_are_never_flipped_in_two_ways(vertices: int, count: int, seed: int):
    positions, faces = tangle(vertices, count, seed)
    one = prepared(positions, faces)
    for effort in (None, EFFORTS["best"]):
        strips = encode_strips(faces, order_cut(*one, cut_tree(one[3], 10**6), 64, effort))
        check_strips(strips, faces)


def moebius(quads: int) -> Arrays:
    """A band of one winding with a half twist: no orientation fits all the way round."""
    angle = np.arange(quads) * (2 * np.pi / quads)
    half = np.stack([np.cos(angle / 2), np.sin(angle / 2)], axis=1) * 0.4
    rim = [
        np.stack(
            [(1 + s * half[:, 0]) * np.cos(angle), (1 + s * half[:, 0]) * np.sin(angle), s * half[:, 1]],
            axis=1,
        )
        for s in (-1, 1)
    ]
    k = np.arange(quads)
    low, high = k, k + quads
    next_low, next_high = np.append(low[1:], quads), np.append(high[1:], 0)
    one = np.stack([low, next_low, high], axis=1)
    two = np.stack([next_low, next_high, high], axis=1)
    return np.concatenate(rim).astype(np.float32), np.stack([one, two], 1).reshape(-1, 3).astype(np.int32)


def fewest_strips(mesh: Arrays) -> tuple[int, int]:
    """How many strips a mesh takes with flips and without."""
    one = prepared(*mesh)
    counts = []
    for flips in (True, False):
        sequences = stripify(*one, OrderingOptions(max_length=2**30, flips=flips))
        check_strips(encode_strips(one[0], sequences, flips=flips), one[0])
        counts.append(len(sequences.lengths))
    return counts[0], counts[1]


@pytest.mark.parametrize(("copies", "rings"), [(1, 1), (2, 1), (5, 1), (25, 6)])
def test_faces_on_one_another_run_the_same_way_are_a_strip_a_ring(copies: int, rings: int):
    positions, faces = np.eye(3, dtype=np.float32), np.tile(np.array([[0, 1, 2]], np.int32), (copies, 1))
    assert fewest_strips((positions, faces)) == (rings, copies)


@pytest.mark.parametrize("pages", [2, 3, 5, 26])
def test_pages_run_the_same_way_pair_up(pages: int):
    positions, faces = book(pages)
    faces[1::2, :2] = faces[1::2, 1::-1]
    assert fewest_strips((positions, faces)) == ((pages + 1) // 2, pages)


def test_a_moebius_band_is_a_strip_with_and_without_flips():
    assert fewest_strips(moebius(20)) == (1, 1)


def test_a_grid_of_random_windings_is_as_good_as_a_grid():
    positions, faces = flipped(2000)
    with_flips, without = fewest_strips((positions, faces))
    straight, _ = fewest_strips(grid(int(1000**0.5), int(1000**0.5)))
    assert without > 10 * with_flips
    assert with_flips <= straight + 5


def test_strips_with_flips_do_not_depend_on_the_number_of_threads():
    positions, faces = flipped(45_000)
    one = prepared(positions, faces)
    cut = cut_tree(one[3], 2000)
    runs = [order_cut(*one, cut, 64, EFFORTS["normal"], threads) for threads in (1, 2)]
    assert encode_strips(faces, runs[0]).flips is not None
    assert as_lists(runs[0]) == as_lists(runs[1])


def test_progress_rises_between_zero_and_one():
    one, told = prepared(*grid(300, 200)), []
    stripify(*one, OrderingOptions(block=16), 2, told.append)
    assert told == sorted(told)
    assert all(0 < fraction < 1 for fraction in told)
    assert told


def test_more_effort_gives_fewer_vertices():
    one = prepared(*sphere(5))
    strips = [
        len(stripify(*one, OrderingOptions(effort=effort)).lengths) for effort in ("fast", "normal", "best")
    ]
    assert strips[0] > strips[1] >= strips[2]


def test_arrays_of_two_meshes_are_refused():
    faces, vertices, boxes, tree = prepared(*grid(3, 3))
    with pytest.raises(UsageError, match="one mesh"):
        stripify(faces[:-1], vertices, boxes, tree)
    with pytest.raises(UsageError, match="one mesh"):
        link_faces(build_adjacency(faces, vertices), faces[:-1], tree)


def apart(count: int) -> Arrays:
    """Triangles that share no vertex, side by side."""
    positions, faces = soup(count, 1, 1000)
    positions[:, 2] += np.repeat(np.arange(count) % 4096, 3)
    return positions, faces


def flipped(count: int) -> Arrays:
    positions, faces = grid(int((count / 2) ** 0.5), int((count / 2) ** 0.5))
    turn = np.random.default_rng(5).random(len(faces)) < 0.5
    return positions, np.where(turn[:, None], faces[:, ::-1], faces)


def thick_books(count: int) -> Arrays:
    """Books of 26 pages side by side."""
    positions, faces = book(26)
    copies = count // 26
    moved = positions[None] + np.arange(copies)[:, None, None] * np.float32(3)
    shifted = faces[None] + (np.arange(copies) * len(positions))[:, None, None]
    return moved.reshape(-1, 3).astype(np.float32), shifted.reshape(-1, 3).astype(np.int32)


def layers(count: int) -> Arrays:
    """A grid with every face sixteen times, every other one turned over."""
    positions, faces = grid(int((count / 32) ** 0.5), int((count / 32) ** 0.5))
    both = np.concatenate([faces, faces[:, ::-1]])
    return positions, np.ascontiguousarray(np.tile(both, (8, 1)))


HOSTILE: dict[str, Callable[[int], Arrays]] = {
    "fan": fan,
    "apart": apart,
    "band": lambda count: grid(count // 2, 1),
    "flipped": flipped,
    "books": thick_books,
    "layers": layers,
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_time_grows_nearly_linearly_on_hostile_meshes(kind: str):
    small, large = (prepared(*HOSTILE[kind](count)) for count in (20_000, 80_000))
    seconds = []
    for one in (small, large):
        runs = []
        for _ in range(3):
            start = time.thread_time()
            sequences = stripify(*one, OrderingOptions(max_length=2**30))
            runs.append(time.thread_time() - start)
        check_sequences(sequences, one[0])
        seconds.append(min(runs))
    growth = len(large[0]) / len(small[0])
    # With one thread all work is done in this one; its own time does not count what others use.
    assert seconds[1] < 2.5 * growth * max(seconds[0], 0.02)


def test_a_band_of_a_million_triangles_is_one_strip_a_chunk():
    one = prepared(*grid(500_000, 1))
    sequences = stripify(*one, OrderingOptions(max_length=2**30, block=None))
    check_sequences(sequences, one[0])
    assert len(sequences.lengths) == cut_tree(one[3], 32768).count


def test_equal_faces_on_one_another_are_strips():
    one = prepared(*stack(20))
    check_sequences(stripify(*one), one[0])


def test_the_bunny_in_strips_and_in_blocks(real_mesh):
    from striptools.mesh.clean import clean
    from striptools.mesh.io import load_mesh

    mesh = clean(load_mesh(real_mesh("bunny"))).mesh
    one = prepared(mesh.positions, mesh.faces)
    cut = stripify(*one, OrderingOptions(block=256))
    whole = stripify(*one, OrderingOptions(block=None))
    per_triangle = [1 + 2 * len(sequences.lengths) / len(mesh.faces) for sequences in (whole, cut)]
    assert per_triangle[0] < 1.045
    assert per_triangle[1] < 1.1
    assert node_boxes(one[3], one[2]).shape == (2 * len(mesh.faces) - 1, 6)
