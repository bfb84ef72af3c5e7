"""Pareto plots of a trade: what bytes cost in error and in speed, and which points nothing beats."""

from typing import TYPE_CHECKING

import numpy as np

from striptools.measure.plots import LIGHT, png_of, require_plots
from striptools.measure.trade import Point, Trade
from striptools.measure.trade_points import BASELINE

if TYPE_CHECKING:
    from matplotlib.axes import Axes

INK = {
    BASELINE: "#111111",
    "precision": "#1b6ca8",
    "simplification": "#c8553d",
    "strip cap": "#7a9e3c",
    "block size": "#3c9e8d",
    "hierarchy": "#8a5ab5",
    "boxes": "#e0a030",
    "residency": "#d1478c",
    "triangle test": "#6b6f76",
    "precision x simplification": "#7fb2d6",
    "residency x boxes": "#eaa9c9",
}
"""A colour for each factor."""

LEAST_ERROR = 1e-8
"""Where points without an error stand on a logarithmic axis, in diagonals."""


def pareto(costs: np.ndarray) -> np.ndarray:
    """(p,) bool: which rows of (p, k) costs none beats, being at most as dear in all and less in one."""
    kept = np.ones(len(costs), np.bool_)
    for row, cost in enumerate(costs):
        kept[row] = not ((costs <= cost).all(axis=1) & (costs < cost).any(axis=1)).any()
    return kept


def plot_trade(trade: Trade) -> bytes:
    """Three Pareto plots as a PNG picture; small values are good on every axis but speed's.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    figure = require_plots().Figure(figsize=(13.5, 4.6), dpi=90, layout="constrained")
    disk, memory, speed = figure.subplots(1, 3)
    _panel(disk, trade, "disk_per_triangle", "file, bytes per source triangle")
    _panel(memory, trade, "memory_per_triangle", "as traced, bytes per source triangle")
    _speed_panel(speed, trade)
    handles, labels = speed.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    figure.suptitle(
        f"{trade.model}: {trade.triangles:,} triangles; lines join what nothing beats", fontsize=11
    )
    return png_of(figure)


def _panel(axes: "Axes", trade: Trade, bytes_name: str, label: str) -> None:
    """Bytes against the largest error."""
    points = [(getattr(p, bytes_name), max(p.largest_error, LEAST_ERROR)) for p in trade.points]
    _scatter(axes, trade.points, points)
    _front(axes, np.array(points), np.array(points))
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_xlabel(label, fontsize=9)
    axes.set_ylabel(f"largest error, diagonals (none: {LEAST_ERROR:g})", fontsize=9)


def _speed_panel(axes: "Axes", trade: Trade) -> None:
    """Bytes as traced against rays a second, secondary rays."""
    points = [(p.memory_per_triangle, p.secondary_ratio) for p in trade.points]
    _scatter(axes, trade.points, points)
    places = np.array(points)
    _front(axes, places, places * [1, -1])
    axes.axhline(1.0, color=LIGHT, linewidth=0.8, zorder=0)
    axes.set_xscale("log")
    axes.set_xlabel("as traced, bytes per source triangle", fontsize=9)
    axes.set_ylabel("secondary rays a second, default = 1", fontsize=9)


def _scatter(axes: "Axes", points: tuple[Point, ...], places: list[tuple[float, float]]) -> None:
    for factor, ink in INK.items():
        chosen = [k for k, point in enumerate(points) if point.factor == factor]
        if not chosen:
            continue
        x, y = zip(*(places[k] for k in chosen), strict=True)
        base = factor == BASELINE
        look = {"s": 110 if base else 26, "marker": "*" if base else "o", "zorder": 4 if base else 3}
        axes.scatter(x, y, color=ink, label=factor, **look)
        if factor in ("precision", "simplification", "residency"):
            for k in chosen:
                text = points[k].value.removesuffix(" bits")
                axes.annotate(
                    text, places[k], xytext=(3, 3), textcoords="offset points", fontsize=7, color=ink
                )


def _front(axes: "Axes", places: np.ndarray, costs: np.ndarray) -> None:
    front = places[pareto(costs)]
    front = front[np.argsort(front[:, 0], kind="stable")]
    axes.plot(front[:, 0], front[:, 1], color="#9aa0a8", linewidth=1.0, zorder=1)
