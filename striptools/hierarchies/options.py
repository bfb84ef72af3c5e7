"""What a hierarchy other than the default one is asked for."""

from dataclasses import dataclass
from typing import Literal, get_args

from striptools.errors import UsageError

HierarchyName = Literal["reducem", "presorted", "slbvh", "kdtree", "loose-octree"]
OverName = Literal["triangles", "strips", "blocks"]
MetricName = Literal["corrected", "plain"]
BalanceName = Literal["sah", "morton"]

MOST_LEVELS = 20

OVER: dict[HierarchyName, tuple[OverName, ...]] = {
    "reducem": ("triangles",),
    "presorted": ("triangles",),
    "slbvh": ("triangles", "strips", "blocks"),
    "kdtree": ("triangles", "strips"),
    "loose-octree": ("triangles", "strips", "blocks"),
}
"""What each may be built over; the first is its default."""


@dataclass(frozen=True)
class HierarchyOptions:
    """Which hierarchy a scene gets.

    Attributes:
        name: "reducem" is the default one: strips, implicit trees inside them, wide nodes.
        over: What its leaves hold; None for the name's default, see `OVER`.
        levels: Uncompressed SAH levels above a presorted scene, 0 to 20.
        balance: How an SLBVH is built: "sah", halves by count on the axis that SAH likes best, or "morton".
        metric: The surface area metric of a kd-tree: "corrected" for mail-boxing, or "plain".

    Raises:
        UsageError: There is no such thing, or not over that.
    """

    name: HierarchyName = "reducem"
    over: OverName | None = None
    levels: int = 10
    balance: BalanceName = "sah"
    metric: MetricName = "corrected"

    def __post_init__(self) -> None:
        for field, value, known in (
            ("hierarchy", self.name, get_args(HierarchyName)),
            ("balance", self.balance, get_args(BalanceName)),
            ("metric", self.metric, get_args(MetricName)),
        ):
            if value not in known:
                raise UsageError(f"{value!r} is not known", where=field, remedy=f"give {', '.join(known)}")
        if self.over is not None and self.over not in OVER[self.name]:
            known = ", ".join(OVER[self.name])
            raise UsageError(
                f"{self.name} is not built over {self.over!r}", where="over", remedy=f"give {known}"
            )
        if not 0 <= self.levels <= MOST_LEVELS:
            raise UsageError(
                f"{self.levels} is out of range", where="levels", remedy=f"give 0 to {MOST_LEVELS}"
            )

    @property
    def objects(self) -> OverName:
        """What it is built over."""
        return self.over or OVER[self.name][0]
