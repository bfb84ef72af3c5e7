"""Pareto plots of a trade: what bytes cost in error and in speed, and which points nothing beats."""

from typing import TYPE_CHECKING

import numpy as np

from striptools.choose import BASELINE, TARGET
from striptools.measure.plots import LIGHT, png_of, require_plots
from striptools.measure.trade import Point, Trade

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
    TARGET: "#e04f1a",
}
"""A colour for each factor."""

LEAST_ERROR = 1e-8
"""Where points without an error stand on a logarithmic axis, in diagonals."""

MEMORY = "as traced, bytes per source triangle"

FILE_LABELS = {"precision": "left", "simplification": "right"}
MEMORY_LABELS = {"precision": "left", "simplification": "right", "residency": "right"}
SPEED_LABELS = {"simplification": "right", "residency": "right", "triangle test": "left", "hierarchy": "left"}
"""The factors whose points a panel names, and on which side of them."""


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
    _panel(disk, trade, "disk_per_triangle", "file, bytes per source triangle", FILE_LABELS)
    _panel(memory, trade, "memory_per_triangle", MEMORY, MEMORY_LABELS)
    _speed_panel(speed, trade)
    handles, labels = speed.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    figure.suptitle(
        f"{trade.model}: {trade.triangles:,} triangles; lines join what nothing beats", fontsize=11
    )
    return png_of(figure)


def _panel(axes: "Axes", trade: Trade, bytes_name: str, label: str, labels: dict[str, str]) -> None:
    """Bytes against the largest error."""
    points = [(getattr(p, bytes_name), max(p.largest_error, LEAST_ERROR)) for p in trade.points]
    _scatter(axes, trade.points, points, labels)
    _front(axes, np.array(points), np.array(points))
    axes.set_yscale("log")
    places = 10.0 ** np.arange(np.log10(LEAST_ERROR), 0)
    names = [f"$10^{{{round(np.log10(place))}}}$" for place in places]
    axes.set_yticks(places, ["none", *names[1:]])
    axes.set_ylim(LEAST_ERROR / 2, 0.3)
    _bytes_axis(axes, label)
    axes.set_ylabel("largest error, diagonals", fontsize=9)


def _speed_panel(axes: "Axes", trade: Trade) -> None:
    """Bytes as traced against rays a second, secondary rays."""
    points = [(p.memory_per_triangle, p.secondary_ratio) for p in trade.points]
    _scatter(axes, trade.points, points, SPEED_LABELS)
    places = np.array(points)
    _front(axes, places, places * [1, -1])
    axes.axhline(1.0, color=LIGHT, linewidth=0.8, zorder=0)
    _bytes_axis(axes, MEMORY)
    axes.set_ylabel("secondary rays a second, default = 1", fontsize=9)


def _bytes_axis(axes: "Axes", label: str) -> None:
    """A logarithmic axis across, with plain numbers and room for the names of points."""
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    axes.set_xlim(low / 1.1, high * 1.1)
    low, high = low / 1.1, high * 1.1
    steps = (1, 2, 5) if high / low < 100 else (1,)
    ticks = [step * 10.0**power for power in range(-3, 6) for step in steps]
    ticks = [tick for tick in ticks if low <= tick <= high]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel(label, fontsize=9)


def _scatter(
    axes: "Axes", points: tuple[Point, ...], places: list[tuple[float, float]], labels: dict[str, str]
) -> None:
    for factor, ink in INK.items():
        chosen = [k for k, point in enumerate(points) if point.factor == factor]
        if not chosen:
            continue
        x, y = zip(*(places[k] for k in chosen), strict=True)
        base = factor == BASELINE
        look = {"s": 110 if base else 26, "marker": "*" if base else "o", "zorder": 4 if base else 3}
        axes.scatter(x, y, color=ink, label=factor, **look)
        for k in chosen if factor in labels else ():
            text, side = points[k].value.removesuffix(" bits"), labels[factor]
            look = {"fontsize": 7, "color": ink, "ha": "right" if side == "left" else "left", "va": "center"}
            # A little up or down, away from the lines that fall from left to right.
            shift = (-5, -3) if side == "left" else (5, 3)
            axes.annotate(text, places[k], xytext=shift, textcoords="offset points", **look)


def _front(axes: "Axes", places: np.ndarray, costs: np.ndarray) -> None:
    front = places[pareto(costs)]
    front = front[np.argsort(front[:, 0], kind="stable")]
    axes.plot(front[:, 0], front[:, 1], color="#9aa0a8", linewidth=1.0, zorder=1)
