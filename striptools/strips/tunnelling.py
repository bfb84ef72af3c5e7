"""Tunnelling: fewer strips, and cheaper ones, by short chains of rotations that end in a merge.

Greedy linking ends when no two open ends touch, which leaves strips of 12 on the Stanford dragon. An end t of
a strip can still go on: into an inner face u of a strip beside it, which is cut in two there. That is a
*rotation*; it keeps the number of strips, and leaves a new end w where the other part begins. A few rotations
on, some new end touches the end of another strip, and the two merge: one strip fewer. Such a chain is a
tunnel of Stewart ("Tunneling for Triangle Strips in Continuous Level-of-Detail Meshes", Graphics Interface
2001) and of Porcu and Scateni ("An Iterative Stripification Algorithm Based on Dual Graph Operations",
Eurographics 2003), who want few strips and nothing else. Differences:

1. A chain is judged by what it does to the boxes. Each strip costs the half areas of the inner nodes of its
   balanced tree, plus TOP_WEIGHT times that of its own box for the hierarchy above; leaves cost the same
   however they are ordered. The change of a chain is the exact difference of the costs of all strips that it
   touches. A chain is worth `price` mean strip costs for the strip it saves, less its change; the one that is
   worth most is done, where that is more than nothing.
2. A chain without a merge is done too where it makes the strips cheaper (a *neutral* move): of the same
   kind, and on meshes of straight rows worth more than all the rest.
3. The sum of all costs, leaves included, may nowhere exceed what it was after linking by more than `rise`.
4. Chains are tried by rising number of rotations; the first number that gives one is taken. Passes go over
   the strips from the shortest to the longest (stable), and over both ends of each.
5. From the second pass on, a strip is searched again only where it, or a strip beside its ends, has changed
   since.
6. Strips longer than LONGEST faces are left as they are, and a search ends after MOST_ROTATIONS: time is
   linear whatever the mesh.
7. On an edge of more than two faces an end may go on through a half-edge that is linked to another, if that
   is the link that is cut.
8. At the end each strip is written in the direction in which its balanced tree (the odd face goes to the
   first half) costs less.

Cost: O(strips * 4^rotations * length) a pass, with each factor but the first bounded.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class Effort:
    """How tunnels are searched.

    Attributes:
        rotations: The most rotations before a merge.
        neutral: The most rotations of a chain without a merge.
        price: What a strip fewer is worth, in mean costs of a strip after linking.
        rise: By which share the expected cost inside a range may become larger than after linking.
        passes: How often all strips are gone over, at most.
    """

    rotations: int
    neutral: int
    price: float
    rise: float
    passes: int

    @property
    def numbers(self) -> tuple[int, int, float, float, int]:
        """What the kernel takes."""
        return self.rotations, self.neutral, self.price, self.rise, self.passes


NO_TUNNELS = None

EFFORTS = {
    "fast": Effort(rotations=2, neutral=1, price=1.5, rise=0.12, passes=1),
    "normal": Effort(rotations=3, neutral=1, price=1.2, rise=0.12, passes=2),
    "best": Effort(rotations=3, neutral=3, price=1.2, rise=0.12, passes=4),
}
"""The efforts by name."""
