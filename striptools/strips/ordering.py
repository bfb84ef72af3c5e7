"""Strip-RT ordering: triangle sequences for ray tracing, joined in rounds under the guidance of a SAH tree.

Source: Lauterbach, Yoon, Tang, Manocha, "ReduceM: Interactive and Memory Efficient Ray Tracing of Large
Models" (EGSR 2008), step "Ordering". Every triangle starts as a sequence of one, tied to its leaf of the
object tree. In each round every active sequence ranks the joins open to it (a lone triangle has three open
edges, a longer sequence up to four, two at each end) by tree distance and balance; a joined sequence takes
the lowest common ancestor; a sequence without a join left is output.

The paper prints no formula. Ours, with n1 and n2 the lengths, H = 2 n1 n2 / (n1 + n2) their harmonic mean, d
the path length between the two tree nodes and d_max the largest d among this round's candidates of that
sequence:

    score = distance_weight * (1 - d / d_max) + balance_weight * 2 H / (n1 + n2)

so (1 - d / d_max) / 2 + H / (n1 + n2) by the default weights, each term at most 1/2. d / d_max is 0 where
d_max is.

Differences and decisions:
1. Faces are numbered by their place in the tree, a sequence by the least place in it. Each sequence proposes
   its best join: highest score, then the smaller pair of sequence numbers, then the least half-edges.
2. The two sides of a pair may score it differently (each has its own d_max), so "mutual best" may never come:
   proposals are accepted from the best down (score, then the smaller pair, then the smaller proposer), each
   that meets two sequences still free in this round. The best proposal of a round always is, so a round with
   a possible join makes one, and every sequence left over was refused by one that was joined: the number of
   rounds is logarithmic in practice and the algorithm ends.
3. A sequence without a join is dropped for good: open edges only close and lengths only grow.
4. Joins cross only between half-edges of one ring that run in opposite directions, so that a strip never
   reflects a triangle; each half-edge carries one link at most, so a triangle is never left through the edge
   it was entered by.

Cost: O(E) a round for E open edges, the sequences roughly halving; about 110 bytes a triangle of
working memory.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from striptools.errors import UsageError
from striptools.partition.sah import LARGEST_BLOCK, SMALLEST_BLOCK
from striptools.types import Counts, FaceIds, Faces

if TYPE_CHECKING:
    from striptools.kernels.strip_ordering import State
    from striptools.mesh.adjacency import Adjacency
    from striptools.partition.object_split import ObjectTree

LARGEST_LENGTH = 2**30

Method = Literal["strip-rt", "paper", "stripe", "tipsify"]
EffortName = Literal["fast", "normal", "best"]
METHODS: tuple[str, ...] = get_args(Method)
EFFORT_NAMES: tuple[str, ...] = get_args(EffortName)


@dataclass(frozen=True)
class OrderingOptions:
    """How faces are ordered into strips.

    Attributes:
        max_length: The most triangles in a sequence, 1 to 2**30.
        method: `strip-rt` (strips/stripify.py), `paper` (Strip-RT as printed, this module), or one of the
            baselines `stripe` and `tipsify`.
        effort: How long `strip-rt` searches: `fast`, `normal` or `best` (strips/tunnelling.py).
        distance_weight: Weight of nearness in the tree, 0 or more; looked at by `paper`.
        balance_weight: Weight of equal lengths, 0 or more; looked at by `paper`.
        block: Cut the mesh into blocks of at most so many triangles and as many vertices first, 4 to
            65536, and order inside them; looked at by `strip-rt`. None for no blocks.
        flips: Let strips cross edges that both faces run the same way, where that makes the scene smaller;
            looked at by `strip-rt`.
    """

    max_length: int = 128
    method: Method = "strip-rt"
    effort: EffortName = "normal"
    distance_weight: float = 0.5
    balance_weight: float = 0.5
    block: int | None = None
    flips: bool = True

    def __post_init__(self) -> None:
        for name, value, allowed in (("method", self.method, METHODS), ("effort", self.effort, EFFORT_NAMES)):
            if value not in allowed:
                raise UsageError(f"{value!r} is not known", where=name, remedy=f"give {', '.join(allowed)}")
        if self.block is not None and not SMALLEST_BLOCK <= self.block <= LARGEST_BLOCK:
            raise UsageError(
                f"{self.block} is out of range",
                where="block",
                remedy=f"give {SMALLEST_BLOCK} to {LARGEST_BLOCK}",
            )
        if not 1 <= self.max_length <= LARGEST_LENGTH:
            raise UsageError(
                f"{self.max_length} is out of range", where="max_length", remedy=f"give 1 to {LARGEST_LENGTH}"
            )
        for name in ("distance_weight", "balance_weight"):
            weight = getattr(self, name)
            if not 0.0 <= weight < np.inf:
                raise UsageError(f"{weight} is out of range", where=name, remedy="give 0 or more")


@dataclass(frozen=True)
class Sequences:
    """Faces in strip order.

    Each face stands once; neighbours in a sequence share an edge. They run it in opposite directions unless
    the sequence was made with flips.

    Attributes:
        faces: (n,) int32, the faces of all sequences one after another.
        starts: (s+1,) int32, sequence i is faces[starts[i]:starts[i+1]], never empty.
    """

    faces: FaceIds
    starts: Counts

    @property
    def lengths(self) -> Counts:
        """(s,) int32: triangles of each sequence."""
        return np.diff(self.starts)

    def reordered(self, order: Counts) -> "Sequences":
        """The same sequences in another order.

        Args:
            order: (s,) a permutation: new sequence i is the old sequence order[i].
        """
        if not np.array_equal(np.sort(order), np.arange(len(self.starts) - 1)):
            raise UsageError("order is no permutation of the sequences", where="Sequences.reordered")
        lengths = self.lengths[order]
        starts = np.concatenate([[0], np.cumsum(lengths)])
        shift = np.repeat(self.starts[:-1][order] - starts[:-1], lengths)
        faces = self.faces[np.arange(len(self.faces)) + shift]
        return Sequences(faces, starts.astype(np.int32))


def order_strips(
    adjacency: "Adjacency", faces: Faces, tree: "ObjectTree", options: OrderingOptions | None = None
) -> Sequences:
    """Join the faces of a mesh into sequences by Strip-RT.

    Args:
        adjacency: Rings of half-edges of `faces`.
        faces: (n, 3) int32.
        tree: Object tree with one FACE an item.
        options: Cap and weights; the defaults of OrderingOptions when left out.

    Returns:
        Sequences of at most max_length faces, each written from its end that comes first in the tree, in the
        order of those ends; `check_sequences` holds for them.

    Raises:
        UsageError: Arrays that do not belong together.
    """
    from striptools.kernels import strip_ordering as kernels

    options = options or OrderingOptions()
    count = len(faces)
    if len(adjacency.ring) != 3 * count or len(tree.leaf_node) != count:
        raise UsageError("adjacency, faces and tree are not of one mesh", where="order_strips")
    place = np.zeros(count, np.int32)
    place[tree.order] = np.arange(count, dtype=np.int32)
    placed_faces, placed_ring = np.zeros((count, 3), np.int32), np.zeros(3 * count, np.int32)
    kernels.renumber(faces, adjacency.ring, tree.order, place, placed_faces, placed_ring)
    state = _join_in_rounds(placed_faces, placed_ring, tree, options)
    order = np.zeros(count, np.int32)
    starts = np.zeros(count + 1, np.int32)
    sequences = kernels.walk_links(state.mate, state.links, order, starts)
    return Sequences(tree.order[order], starts[: sequences + 1].copy())


def _join_in_rounds(faces: Faces, ring: Counts, tree: "ObjectTree", options: OrderingOptions) -> "State":
    """The links after the last round: propose, match, join until no sequence is active."""
    from striptools.kernels import strip_ordering as kernels

    count = len(faces)
    leaves = tree.leaf_node[tree.order]
    state = kernels.State(
        ends=np.repeat(np.arange(count, dtype=np.int32)[:, None], 2, axis=1),
        length=np.ones(count, np.int32),
        node=leaves,
        level=tree.depth[leaves],
        owner=np.arange(count, dtype=np.int32),
        mate=np.full(3 * count, -1, np.int32),
        links=np.zeros(count, np.uint8),
    )
    wanted = kernels.Proposals(
        partner=np.full(count, -1, np.int32),
        score=np.zeros(count, np.float64),
        leave=np.zeros(count, np.int32),
        enter=np.zeros(count, np.int32),
    )
    scratch = (np.zeros(count, np.bool_), *(np.zeros(count, np.int32) for _ in range(4)))
    limits = (options.max_length, options.distance_weight, options.balance_weight)
    # A sequence has at most 4 open edges, each with the rest of a ring to join.
    room = 4 * kernels.longest_ring(ring)
    active = np.arange(count, dtype=np.int32)
    while len(active):
        kernels.propose(active, ring, faces, state, tree.parent, tree.size, *limits, room, wanted)
        accepted = scratch[-1][: kernels.match(active, wanted, *scratch)]
        kernels.join(accepted, wanted, state, tree.parent, tree.size)
        active = active[: kernels.still_active(active, wanted, state)]
    return state


# Notes. Stanford dragon (871,306 faces), cap 64; vertices per triangle / expected cost over the full SAH
# tree's: the printed score 1.1661 / 1.191; distance alone 1.1589 / 1.173; balance alone 1.1634 / 1.513;
# distance 0.9
# and balance 0.1 1.1597 / 1.176. Cap 16: 1.2228 / 1.098; cap 32: 1.1742 / 1.159; cap 128: 1.1659 / 1.190.
# Bunny at cap 64: 1.1212 / 1.248; distance alone 1.1167 / 1.232. So balance costs a little; the default stays
# what is printed.
