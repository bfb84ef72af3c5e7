"""What the targets of `convert` choose on real models, beside the best point of each one's whole trade.

    striptools trade MESH ... --out REPORTS
    python tests/benches/bench_trade.py [REPORTS] [--keep] [--record]

The first takes 3 to 15 minutes a model, and goes on where it was interrupted. The second reads its
points.json, or what is kept of them where no REPORTS are given, prints a line for each model and target, and
fails where a choice is more than a tenth worse than the best point by the target's own criterion. With
`--keep` it writes the small set of reports, a table, a plot and the figures of a model, to samples/reports,
and the table that targets choose by, medians of the trades that have every point, into the package.
"""

import argparse
import json
import sys
from pathlib import Path
from typing import Any

from results import Row, append

from striptools.choose import TABLE, table_of
from striptools.measure.plots_trade import plot_trade
from striptools.measure.trade import Trade
from striptools.measure.trade_targets import chosen_of
from striptools_cli.trade import printed

BENCH = {"takes": "nothing", "full": [[]], "quick": [[]]}

HERE = Path(__file__).resolve().parents[2]
KEPT, SHIPPED = HERE / "samples" / "reports", HERE / "striptools" / TABLE

WORSE = 1.1
"""How much worse than the best point a choice may be."""

DIGITS = 6
"""What is kept of a figure."""


def main() -> int:
    """Judge the targets of each trade, and keep what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("reports", type=Path, nargs="?")
    parser.add_argument("--keep", action="store_true")
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    reports = arguments.reports
    paths = sorted(reports.rglob("points.json") if reports else KEPT.glob("trade-*.json"))
    trades = [json.loads(path.read_text(encoding="utf-8")) for path in paths]
    failed = sum([not _judged(trade) for trade in trades])
    if arguments.record:
        append([row for trade in trades for row in _rows(trade)])
    if arguments.keep:
        for trade in trades:
            keep(trade)
        SHIPPED.write_text(json.dumps(shipped(trades), indent=1) + "\n", encoding="utf-8")
    return 1 if failed or not trades else 0


def _judged(trade: dict[str, Any]) -> bool:
    """Whether each target's choice is near the best point; prints a line each."""
    found = chosen_of(trade)
    for one in found:
        sys.stdout.write(
            f"{trade['model']:16s}{one.target:10s}{one.point:34s}{one.cost:10.4g}  best {one.best:34s}"
            f"{one.best_cost:10.4g}  ratio {one.ratio:.3f}\n"
        )
    return all(one.ratio <= WORSE for one in found)


def _rows(trade: dict[str, Any]) -> list[Row]:
    """What each target costs beside the best point, by the target's own criterion."""
    given = "trade", trade["model"], trade["triangles"]
    return [
        Row(*given, f"target {one.target}", one.cost, "cost", "best", one.best_cost, one.ratio, one.point)
        for one in chosen_of(trade)
    ]


def keep(trade: dict[str, Any]) -> None:
    """Write a trade's figures, table and plot."""
    name = f"trade-{trade['model']}"
    trade = {**trade, "points": [rounded(point) for point in trade["points"]]}
    whole = Trade.from_dict(trade)
    # A line a point, so that a change of one is a change of one line.
    rows = ",\n".join(json.dumps(point) for point in trade["points"])
    facts = json.dumps({**trade, "points": []}).removesuffix("]}")
    (KEPT / f"{name}.json").write_text(f"{facts}\n{rows}\n]}}\n", encoding="utf-8")
    (KEPT / f"{name}.md").write_text(printed(whole, "md"), encoding="utf-8")
    (KEPT / f"{name}.png").write_bytes(plot_trade(whole))


def rounded(point: dict[str, Any]) -> dict[str, Any]:
    """A point's figures, to a few digits."""
    return {
        key: float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
        for key, value in point.items()
    }


def shipped(trades: list[dict[str, Any]]) -> dict[str, Any]:
    """The table of the package: medians of the trades that have every point."""
    most = max(len(trade["points"]) for trade in trades)
    whole = [trade for trade in trades if len(trade["points"]) == most]
    rows = [vars(row) for row in table_of([trade["points"] for trade in whole])]
    models = [trade["model"] for trade in whole]
    return {
        "models": models,
        "machine": whole[0]["machine"],
        "versions": whole[0]["versions"],
        "rows": [rounded(row) for row in rows],
    }


if __name__ == "__main__":
    sys.exit(main())
