"""Classic alternating strips, for rasterisers: fewest indices, whatever that makes of the strips' shape.

A classic strip of k triangles takes k + 2 indices, one more for each pair of equal turns in a row, one for
the restart that sets it apart, and one more (a misfit) where its first turn costs one from whichever end it
is written. So the price of a cover is 3 a strip, 1 a repeated turn and 1 a misfit, and four steps lower it:

1. **Lines.** A line is a run of faces whose turns alternate: it repeats nothing. The longest line is taken,
   then the longest of what is left (Evans, Skiena, Varshney, "Optimizing Triangle Strips for Fast
   Rendering", Visualization 1996, take longest patches of quads likewise), down to LEAST_LINE faces. On a
   regular grid this is row by row along the longer side.
2. **Links.** Free faces and ends are linked by the links that repeat least first; among those to the face of
   fewest further links (the rule of the SGI stripifier).
3. Both are done with lines and without, and the cheaper cover goes on.
4. **Search.** Chains of up to K rotations from a strip's end, then a link to another end (the tunnelling of
   Stewart, "Tunneling for Triangle Strips in Continuous Level-of-Detail Meshes", Graphics Interface 2001, on
   one more kind of state), carried out where the price falls; with effort "best" also from links cut between
   equal turns.

Differences from the sources: a chain may also end without a link, where it only lessens repeated turns; a
price in indices decides, not the number of strips; edges of several faces are linked as the rings of
mesh/adjacency.py tell, opposite half-edges only, so that no face is ever reflected.

The search runs in parts of whole strips, PART_FACES faces each, and then once over what met another part:
the parts depend on the mesh alone, so the strips are the same for any number of threads.

Such strips are long and thin: tracing rays through them costs 1.5 to 13 times as much as through those of
strips/ordering.py. They are for export only.

Cost: lines O(n log n) in practice, links O(n), the search O(strips * 4^K); 90 bytes a triangle.
"""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from striptools.errors import UsageError
from striptools.strips.ordering import Sequences
from striptools.types import Bools, Counts, Faces

if TYPE_CHECKING:
    from striptools.kernels.alternating_search import Cover
    from striptools.mesh.adjacency import Adjacency

LEAST_LINE = 6
"""Lines of fewer faces are left to the links."""

MOST_REPEATS = 3
"""A link adds at most this many repeated turns: its own, the one before and the one after."""

PART_FACES = 32768

Effort = Literal["fast", "normal", "best"]

_ROTATIONS: dict[Effort, int] = {"fast": 2, "normal": 3, "best": 3}
_CUT_ROTATIONS = 2
_PASSES = 4


@dataclass(frozen=True)
class AlternatingOptions:
    """How hard to look for cheap classic strips.

    Attributes:
        effort: Rotations in a chain: `fast` 2, `normal` 3, `best` 3 and chains from cut strips too.
        strip_price: What a strip costs in indices: 3 with a restart index, 4 where strips are stitched by
            repeated vertices, 2 where each is drawn by a call of its own.
    """

    effort: Effort = "normal"
    strip_price: int = 3

    def __post_init__(self) -> None:
        if self.effort not in get_args(Effort):
            raise UsageError(
                f"{self.effort!r} is unknown", where="effort", remedy=f"one of {get_args(Effort)}"
            )
        if not 1 <= self.strip_price <= 100:
            raise UsageError(
                f"{self.strip_price} is out of range", where="strip_price", remedy="give 1 to 100"
            )


def alternating_strips(
    adjacency: "Adjacency", faces: Faces, options: AlternatingOptions | None = None, threads: int = 1
) -> Sequences:
    """Cover a mesh with strips that take few indices as classic alternating ones.

    Args:
        adjacency: Rings of half-edges of `faces`.
        faces: (n, 3) int32.
        options: Effort and price; the defaults of AlternatingOptions when left out.
        threads: How many threads share the work; the strips are the same for any number.

    Returns:
        Sequences in the order of their least end; `check_sequences` holds for them. Hand them to
        `encode_strips` and that to `classic_strips`.

    Raises:
        UsageError: Arrays that do not belong together.
    """
    from striptools.kernels import strip_ordering

    options = options or AlternatingOptions()
    count = len(faces)
    if len(adjacency.ring) != 3 * count:
        raise UsageError("adjacency and faces are not of one mesh", where="alternating_strips")
    forward = (faces < np.roll(faces, -1, axis=1)).reshape(-1)
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        price = options.strip_price
        seeds = pool.map(lambda lines: _seeded(adjacency.ring, forward, price, lines=lines), (True, False))
        mate = min(seeds, key=lambda seed: seed[0])[1]
        cover = _numbered(adjacency.ring, forward, mate)
        _search(cover, options, pool)
    links = (mate.reshape(-1, 3) >= 0).sum(axis=1).astype(np.uint8)
    order, starts = np.zeros(count, np.int32), np.zeros(count + 1, np.int32)
    strips = strip_ordering.walk_links(mate, links, order, starts)
    return Sequences(order, starts[: strips + 1].copy())


def _seeded(ring: Counts, forward: Bools, strip_price: int, *, lines: bool) -> tuple[int, Counts]:
    """The price and the links of a cover before the search."""
    from striptools.kernels import alternating_lines as kernels

    mate = np.full(len(ring), -1, np.int32)
    links = np.zeros(len(ring) // 3, np.uint8)
    owner = np.zeros(len(ring) // 3, np.int32)
    if lines:
        kernels.take_longest_lines(ring, forward, LEAST_LINE, mate, links)
    kernels.name_strips(mate, owner)
    for most in range(MOST_REPEATS + 1):
        while kernels.link_faces(most, ring, forward, mate, links, owner):
            pass
    return kernels.price_of(mate, strip_price), mate


def _numbered(ring: Counts, forward: Bools, mate: Counts) -> "Cover":
    """The cover with its strips numbered and dealt out to parts."""
    from striptools.kernels import alternating_search as kernels

    count = len(ring) // 3
    cover = kernels.Cover(
        ring,
        forward,
        mate,
        owner=np.zeros(count, np.int32),
        pos=np.zeros(count, np.int32),
        first=np.zeros(count, np.int32),
        last=np.zeros(count, np.int32),
        misfit=np.zeros(count, np.uint8),
        part=np.zeros(count, np.int32),
        stale=np.zeros(count, np.uint8),
    )
    strips = kernels.number_strips(cover)
    short = {name: getattr(cover, name)[:strips] for name in ("first", "last", "misfit", "stale")}
    cover = cover._replace(**short)
    # Strips are numbered by their least end, so that neighbours in the file share a part.
    lengths = cover.pos[cover.last] + 1
    part_of_strip = (np.cumsum(lengths, dtype=np.int64) - lengths) // PART_FACES
    cover.part[:] = part_of_strip[cover.owner]
    cover.stale[:] = kernels.STALE
    return cover


def _search(cover: "Cover", options: AlternatingOptions, pool: ThreadPoolExecutor) -> None:
    """Search part by part in the pool, then all that met another part; last from cuts where asked."""
    from striptools.kernels import alternating_search as kernels

    deepest, price = _ROTATIONS[options.effort], options.strip_price
    strips = np.arange(len(cover.first), dtype=np.int64)
    parts = cover.part[cover.first[strips]]
    bounds = np.searchsorted(parts, np.arange(parts[-1] + 2)) if len(parts) else np.zeros(1, np.int64)
    jobs = [(part, strips[bounds[part] : bounds[part + 1]]) for part in range(len(bounds) - 1)]
    list(pool.map(lambda job: kernels.search_strips(job[1], _PASSES, deepest, price, job[0], cover), jobs))
    cover.part[:] = 0
    cover.stale[:] = np.where((cover.stale & kernels.MET) != 0, kernels.STALE, 0)
    kernels.search_strips(strips, _PASSES, deepest, price, kernels.ANY_PART, cover)
    if options.effort == "best" and kernels.search_cuts(_CUT_ROTATIONS, price, True, kernels.ANY_PART, cover):
        kernels.search_strips(strips, 1, deepest, price, kernels.ANY_PART, cover)


# Notes. Indices per triangle with restarts counted, cleaned meshes:
#   start alone, links only / lines of >= 8 first: bunny 1.229 / 1.173, dragon 1.350 / 1.342, kicad_acepack
#     1.247 / 1.181, chandelier 1.391 / 1.453; so both are tried. Taking misfits apart, after chains of two
#     rotations: bunny 1.174 / 1.143, dragon 1.289 / 1.286, kicad 1.192 / 1.152.
#   shortest line 4, 5, 6, 8: dragon 1.2919, 1.2919, 1.2920, 1.2923; kicad 1.1571, 1.1574, 1.1570, 1.1600.
#   rotations 1, 2, 3: dragon 1.305, 1.292, 1.286; bunny 1.155, 1.148, 1.144.
#   misfits left out of the price: dragon 1.295 instead of 1.293.
#   first pass free to stop without a link: dragon 1.2933 instead of 1.2923, icub 1.254 before, 1.238 after.
#   price 4 instead of 3, restarts counted: bunny 1.145, icub 1.239, dragon 1.300, with half the strips: right
#     for stitched strips, where it saves 1.5 to 3 %.
#   cuts between equal turns: dragon -0.001, bunny -0.001, japanese maple -0.01 to -0.018.
#   joins at a common vertex save a restart in 1 to 3 % of the strips; ends are not sought for their vertex.
