"""What the targets of `convert` choose, beside the best point of a whole trade by the same criterion.

A target chooses by the table of the package, that is by medians of other models. Here its choice, measured,
stands beside the point that the model's own trade finds best: among those that a target may choose, whose
declared bound is within the target's, and none of whose rays was wrong in verify.
"""

import math
from dataclasses import dataclass
from typing import Any, cast

from striptools.choose import BASELINE, LARGEST_ERRORS, TARGET, Target, cost_of, may_choose, median_row


@dataclass(frozen=True)
class Chosen:
    """A target's choice.

    Attributes:
        target: Of which target.
        point: The name of what it chooses.
        best: The name of the best point.
        cost: What the target wants least of, of its choice, over the default's: bytes in memory over rays a
            second (`balanced`), bytes on disk (`small`), one over rays a second (`fast`). For `quality` the
            declared bound in diagonals. Infinite where the choice breaks the target's bound, or verify found
            a wrong ray.
        best_cost: The same of the best point.
    """

    target: Target
    point: str
    best: str
    cost: float
    best_cost: float

    @property
    def ratio(self) -> float:
        """The choice's cost over the best point's: 1 is best, infinite where only the best has none."""
        if self.cost == self.best_cost:
            return 1.0
        return self.cost / self.best_cost if self.best_cost > 0 else math.inf


def chosen_of(trade: dict[str, Any]) -> list[Chosen]:
    """A row for each target whose choice was measured.

    Args:
        trade: As `Trade.to_dict` gives it.
    """
    points = {point["name"]: point for point in trade["points"]}
    rows = {name: median_row([(point, points[BASELINE])]) for name, point in points.items()}
    allowed = [
        name
        for name, point in points.items()
        if (may_choose(point["factor"]) or point["factor"] == TARGET)
        and point["leaks"] == point["disagreements"] == 0
    ]
    found = []
    for name, point in trade["targets"].items():
        if point not in points:
            continue
        target = cast(Target, name)
        within = [one for one in allowed if rows[one].bound <= LARGEST_ERRORS[target]]
        costs = {one: cost_of(rows[one], target) for one in within}
        # Of equals the target's own choice is the best one.
        best = min(costs, key=lambda one: (costs[one], one != point))
        found.append(Chosen(target, point, best, costs.get(point, math.inf), costs[best]))
    return found
