"""What a command line asks of a hierarchy: which options each has a use for, and what they mean together."""

from typing import cast

from striptools.errors import UsageError
from striptools.hierarchies.options import (
    OVER,
    BalanceName,
    HierarchyName,
    HierarchyOptions,
    MetricName,
    OverName,
)

USES: dict[str, tuple[HierarchyName, ...]] = {
    "over": ("slbvh", "kdtree", "loose-octree"),
    "levels": ("presorted",),
    "balance": ("slbvh",),
    "metric": ("kdtree",),
}
"""Which hierarchies an option is for."""


def asked_for(
    name: str, over: str | None, levels: int | None, balance: str | None, metric: str | None
) -> HierarchyOptions:
    """The options of a hierarchy; those that are None keep their defaults.

    Raises:
        UsageError: There is no such thing, or one is given that the hierarchy has no use for.
    """
    given = {"over": over, "levels": levels, "balance": balance, "metric": metric}
    kept = {key: value for key, value in given.items() if value is not None}
    if name in OVER:
        for key in kept:
            if name not in USES[key]:
                raise UsageError(
                    f"{name} has no use for it",
                    where=f"--{key}",
                    remedy=f"leave it out, or give --hierarchy {' or '.join(USES[key])}",
                )
    return HierarchyOptions(
        cast(HierarchyName, name),
        cast(OverName | None, over),
        HierarchyOptions.levels if levels is None else levels,
        HierarchyOptions.balance if balance is None else cast(BalanceName, balance),
        HierarchyOptions.metric if metric is None else cast(MetricName, metric),
    )
