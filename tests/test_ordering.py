"""Strip-RT against a slow twin that keeps lists of faces, walks the tree by parents and sorts proposals."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import clean_meshes, fan, grid, sphere

from striptools.errors import UsageError
from striptools.mesh.adjacency import Adjacency, build_adjacency
from striptools.partition.boxes import face_boxes
from striptools.partition.object_split import ObjectTree, split_objects
from striptools.strips.ordering import OrderingOptions, Sequences, order_strips
from striptools.strips.topology import check_sequences, encode_strips


@dataclass
class SlowSequence:
    """A list of places in the tree, and the path from the sequence's node up to the root."""

    faces: list[int]
    path: list[int]


class SlowStrips:
    """The algorithm as the head of strips/ordering.py tells it, with nothing kept that can be found again."""

    def __init__(self, adjacency: Adjacency, faces: np.ndarray, tree: ObjectTree, options: OrderingOptions):
        self.options, self.order = options, tree.order.tolist()
        place = {face: k for k, face in enumerate(self.order)}
        self.faces = faces[tree.order].tolist()
        self.ring = {
            3 * k + slot: 3 * place[g // 3] + g % 3
            for k, face in enumerate(self.order)
            for slot in range(3)
            for g in [int(adjacency.ring[3 * face + slot])]
        }
        self.linked: set[int] = set()
        self.sequences = {k: SlowSequence([k], path_up(tree, face)) for k, face in enumerate(self.order)}

    def result(self) -> list[list[int]]:
        while joins := self.accepted():
            for _, low, high, s, h, g in joins:
                self.join(low, high, s, h, g)
        chains = [chain if chain[0] <= chain[-1] else chain[::-1] for chain in self.chains()]
        return [[self.order[k] for k in chain] for chain in sorted(chains)]

    def chains(self) -> list[list[int]]:
        return [sequence.faces for sequence in self.sequences.values()]

    def candidates(self, s: int) -> list[tuple[int, int, int]]:
        """Partner and half-edges of every join open to a sequence."""
        at_end = {end: r for r, other in self.sequences.items() for end in (other.faces[0], other.faces[-1])}
        length = len(self.sequences[s].faces)
        found = []
        for t in {self.sequences[s].faces[0], self.sequences[s].faces[-1]}:
            for h in {3 * t, 3 * t + 1, 3 * t + 2} - self.linked:
                g = self.ring[h]
                while g != h:
                    r = at_end.get(g // 3, s)
                    opposite = self.faces[h // 3][h % 3] != self.faces[g // 3][g % 3]
                    fits = length + len(self.sequences[r].faces) <= self.options.max_length
                    if r != s and opposite and g not in self.linked and fits:
                        found.append((r, h, g))
                    g = self.ring[g]
        return found

    def proposal(self, s: int) -> tuple[float, int, int, int, int, int] | None:
        """The best join of a sequence: minus the score, the pair, who asks and the half-edges."""
        candidates = self.candidates(s)
        distance = {r: self.distance(s, r) for r, _, _ in candidates}
        farthest = max(distance.values(), default=0)
        ranked = []
        for r, h, g in candidates:
            n1, n2 = float(len(self.sequences[s].faces)), float(len(self.sequences[r].faces))
            near = 1 - distance[r] / farthest if farthest else 1
            balance = 4 * n1 * n2 / ((n1 + n2) * (n1 + n2))
            score = self.options.distance_weight * near + self.options.balance_weight * balance
            ranked.append((-score, min(s, r), max(s, r), s, h, g))
        return min(ranked, default=None)

    def distance(self, s: int, r: int) -> int:
        return len(set(self.sequences[s].path) ^ set(self.sequences[r].path))

    def accepted(self) -> list[tuple[float, int, int, int, int, int]]:
        """Proposals from the best down, each that meets two free sequences."""
        taken: set[int] = set()
        joins = []
        for proposal in sorted(filter(None, map(self.proposal, self.sequences))):
            if not taken & set(proposal[1:3]):
                taken |= set(proposal[1:3])
                joins.append(proposal)
        return joins

    def join(self, low: int, high: int, s: int, h: int, g: int) -> None:
        one, other = self.sequences[s], self.sequences[high if s == low else low]
        front = one.faces if one.faces[-1] == h // 3 else one.faces[::-1]
        back = other.faces if other.faces[0] == g // 3 else other.faces[::-1]
        above = set(other.path)
        self.linked |= {h, g}
        del self.sequences[high]
        self.sequences[low] = SlowSequence(front + back, [node for node in one.path if node in above])


def path_up(tree: ObjectTree, face: int) -> list[int]:
    path = [int(tree.leaf_node[face])]
    while path[-1] != 0:
        path.append(int(tree.parent[path[-1]]))
    return path


def prepared(positions: np.ndarray, faces: np.ndarray) -> tuple[Adjacency, np.ndarray, ObjectTree]:
    return build_adjacency(faces, len(positions)), faces, split_objects(face_boxes(positions, faces))


def as_lists(sequences: Sequences) -> list[list[int]]:
    return [part.tolist() for part in np.split(sequences.faces, sequences.starts[1:-1])]


some_options = st.builds(
    OrderingOptions,
    max_length=st.sampled_from([1, 2, 3, 7, 64, 10**6]),
    distance_weight=st.sampled_from([0.5, 0.0, 1.0]),
    balance_weight=st.sampled_from([0.5, 0.0, 2.0]),
)


@given(clean_meshes(), some_options)
def test_ordering_equals_the_slow_twin(mesh, options: OrderingOptions):
    one = prepared(mesh.positions, mesh.faces)
    sequences = order_strips(*one, options)
    assert as_lists(sequences) == SlowStrips(*one, options).result()


@given(clean_meshes(), some_options)
def test_sequences_hold_every_face_once_within_the_cap(mesh, options: OrderingOptions):
    sequences = order_strips(*prepared(mesh.positions, mesh.faces), options)
    check_sequences(sequences, mesh.faces, options.max_length, flips=False)


@pytest.mark.parametrize("max_length", [4, 64])
@pytest.mark.parametrize("mesh", [grid(9, 7), sphere(2), fan(64)])
def test_no_join_is_left_where_two_faces_share_one_edge_at_most(mesh, max_length: int):
    one = prepared(*mesh)
    ends = SlowStrips(*one, OrderingOptions(max_length))
    place = {face: k for k, face in enumerate(ends.order)}
    ordered = order_strips(*one, OrderingOptions(max_length))
    sequences, strips = as_lists(ordered), encode_strips(mesh[1], ordered)
    ends.linked = linked_half_edges(strips, place)
    ends.sequences = {place[s[0]]: SlowSequence([place[face] for face in s], [0]) for s in sequences}
    assert not any(ends.candidates(s) for s in ends.sequences)


def linked_half_edges(strips, place: dict[int, int]) -> set[int]:
    """The half-edges that strips are entered and left by, read from rotations and turns."""
    firsts = set(strips.starts[:-1].tolist())
    linked = set()
    for k, face in enumerate(strips.source_face.tolist()):
        if k not in firsts:
            before = strips.source_face[k - 1]
            leave = (int(strips.rotation[k - 1]) + 1 + int(strips.turns[k])) % 3
            linked |= {3 * place[face] + int(strips.rotation[k]), 3 * place[int(before)] + leave}
    return linked


@given(clean_meshes(), st.randoms(use_true_random=False))
def test_reordered_keeps_the_sequences(mesh, random):
    sequences = order_strips(*prepared(mesh.positions, mesh.faces))
    before = as_lists(sequences)
    order = list(range(len(before)))
    random.shuffle(order)
    assert as_lists(sequences.reordered(np.array(order, np.int32))) == [before[k] for k in order]


def test_reordered_refuses_what_is_no_permutation():
    sequences = order_strips(*prepared(*grid(5, 5)), OrderingOptions(max_length=4))
    with pytest.raises(UsageError, match="permutation"):
        sequences.reordered(np.zeros(len(sequences.lengths), np.int32))


def test_the_score_by_default_weights_is_the_one_that_is_named():
    for n1, n2 in ((130, 10), (70, 70), (1, 1)):
        mean = 2 * n1 * n2 / (n1 + n2)
        assert 0.5 * 4 * n1 * n2 / (n1 + n2) ** 2 == pytest.approx(mean / (n1 + n2))
    assert OrderingOptions() == OrderingOptions(128, "strip-rt", "normal", 0.5, 0.5)


def test_a_fan_of_triangles_is_one_strip_and_never_closes():
    assert order_strips(*prepared(*fan(300)), OrderingOptions(max_length=300)).lengths.tolist() == [300]


def test_faces_that_run_an_edge_the_same_way_are_not_joined():
    positions, faces = grid(1, 1)
    faces[1] = faces[1, ::-1]
    assert order_strips(*prepared(positions, faces)).lengths.tolist() == [1, 1]


def test_a_moebius_band_is_one_strip_that_does_not_cross_its_flip():
    angle = np.arange(12) * np.pi / 12
    sides = (
        np.array([-1.0, 1.0])[None, :, None] * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)[:, None]
    )
    middle = 5 * np.stack([np.cos(2 * angle), np.sin(2 * angle), 0 * angle], 1)[:, None]
    positions = (middle + sides).reshape(-1, 3).astype(np.float32)
    quads = [(2 * k, 2 * k + 1, 2 * k + 2, 2 * k + 3) for k in range(11)] + [(22, 23, 1, 0)]
    faces = np.array([f for a, b, c, d in quads for f in ((a, b, c), (c, b, d))], np.int32)
    one = prepared(positions, faces)
    assert order_strips(*one).lengths.tolist() == [24]
    check_sequences(order_strips(*one), faces)


def test_a_long_band_of_equal_scores_takes_few_rounds():
    # Joined one pair a round, 200,000 faces would take minutes.
    positions, faces = grid(100_000, 1)
    sequences = order_strips(
        *prepared(positions, faces), OrderingOptions(max_length=2**30, distance_weight=0)
    )
    check_sequences(sequences, faces)
    assert len(sequences.lengths) < 100


def test_more_weight_on_distance_or_balance_changes_the_strips():
    one = prepared(*sphere(3))
    parts = [
        as_lists(
            order_strips(*one, OrderingOptions(64, distance_weight=weights[0], balance_weight=weights[1]))
        )
        for weights in ((1, 0), (0, 1), (0.5, 0.5))
    ]
    assert parts[0] != parts[1] != parts[2]


@pytest.mark.parametrize(
    "wrong",
    [
        {"max_length": 0},
        {"max_length": 2**31},
        {"distance_weight": -1},
        {"balance_weight": float("nan")},
        {"method": "strips"},
        {"effort": "better"},
        {"block": 3},
    ],
)
def test_options_out_of_range_are_refused(wrong: dict[str, object]):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        OrderingOptions(**wrong)


def test_arrays_of_two_meshes_are_refused():
    adjacency, faces, tree = prepared(*grid(3, 3))
    with pytest.raises(UsageError, match="one mesh"):
        order_strips(adjacency, faces[:-1], tree)


def test_check_sequences_finds_each_fault():
    adjacency, faces, tree = prepared(*grid(6, 6))
    good = order_strips(adjacency, faces, tree)
    check_sequences(good, faces)
    twice = good.faces.copy()
    twice[0] = twice[1]
    torn = np.concatenate([good.faces[1:], good.faces[:1]])
    faults = {
        "once": replace(good, faces=twice),
        "continue": replace(good, faces=torn),
        "starts": replace(good, starts=good.starts + 1),
        "rise": replace(good, starts=np.insert(good.starts, 1, 0).astype(np.int32)),
    }
    for what, faulty in faults.items():
        with pytest.raises(UsageError, match=what):
            check_sequences(faulty, faces)
    with pytest.raises(UsageError, match="has"):
        check_sequences(good, faces, max_length=int(good.lengths.max()) - 1)


def test_the_bunny_takes_few_vertices_per_triangle(real_mesh):
    import trimesh

    mesh = trimesh.load(real_mesh("bunny"), process=False)
    faces = np.ascontiguousarray(mesh.faces, np.int32)
    lengths = order_strips(*prepared(np.asarray(mesh.vertices, np.float32), faces)).lengths
    assert 1 + 2 * len(lengths) / len(faces) < 1.125
