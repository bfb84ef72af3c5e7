"""Pareto plots of a trade: what bytes cost in error and in speed, and which points nothing beats."""

from typing import TYPE_CHECKING

import numpy as np

from striptools.choose import BASELINE, BOX_PRECISION, PAIR, TARGET, TRACED
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
    TRACED: "#5a2d82",
    BOX_PRECISION: "#8c4a1b",
    "triangle test": "#6b6f76",
    "precision x simplification": "#7fb2d6",
    "residency x boxes": "#eaa9c9",
    f"residency{PAIR}{BOX_PRECISION}": "#d9a37f",
    TARGET: "#111111",
}
"""A colour for each factor."""

MARKERS = {BASELINE: (110, "*"), TARGET: (34, "D")}
"""Sizes and shapes of factors whose points are no dots."""

LEAST_ERROR = 1e-8
"""Where points without an error stand on a logarithmic axis, in diagonals."""

MEMORY = "as traced, bytes per source triangle"

Sides = dict[str, str]
"""The factors whose points a panel names, and on which side of them."""

FILE_SIDES: Sides = {"precision": "left", "simplification": "right", TARGET: "right"}
MEMORY_SIDES: Sides = {"precision": "left", "simplification": "right", "residency": "right", TARGET: "right"}
SPEED_SIDES: Sides = {
    "simplification": "right",
    "residency": "below",
    "triangle test": "right",
    "hierarchy": "left",
    TRACED: "right",
}

SHIFTS = {"left": ((-5, -3), "right"), "right": ((5, 3), "left"), "below": ((5, -5), "left")}
"""How far a name stands from its point; to a side, a little off the lines that fall from left to right."""

COVERED = (0.12, 0.035)
"""Within which parts of a panel, across and down, one name would cover another."""


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
    figure = require_plots().Figure(figsize=(13.5, 4.6), dpi=80, layout="constrained")
    disk, memory, speed = figure.subplots(1, 3)
    _panel(disk, trade, "disk_per_triangle", "file, bytes per source triangle", FILE_SIDES)
    _panel(memory, trade, "memory_per_triangle", MEMORY, MEMORY_SIDES)
    _speed_panel(speed, trade)
    handles, labels = speed.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    figure.suptitle(
        f"{trade.model}: {trade.triangles:,} triangles; lines join what nothing beats", fontsize=11
    )
    return png_of(figure)


def _panel(axes: "Axes", trade: Trade, bytes_name: str, label: str, sides: Sides) -> None:
    """Bytes against the largest error."""
    points = [(getattr(p, bytes_name), max(p.largest_error, LEAST_ERROR)) for p in trade.points]
    _scatter(axes, trade.points, points)
    _front(axes, np.array(points), np.array(points))
    axes.set_yscale("log")
    places = 10.0 ** np.arange(np.log10(LEAST_ERROR), 0)
    names = [f"$10^{{{round(np.log10(place))}}}$" for place in places]
    axes.set_yticks(places, ["none", *names[1:]])
    axes.set_ylim(LEAST_ERROR / 2, 0.3)
    _bytes_axis(axes, label)
    axes.set_ylabel("largest error, diagonals", fontsize=9)
    _name(axes, trade.points, points, sides)


def _speed_panel(axes: "Axes", trade: Trade) -> None:
    """Bytes as traced against rays a second, secondary rays."""
    points = [(p.memory_per_triangle, p.secondary_ratio) for p in trade.points]
    _scatter(axes, trade.points, points)
    places = np.array(points)
    _front(axes, places, places * [1, -1])
    axes.axhline(1.0, color=LIGHT, linewidth=0.8, zorder=0)
    _bytes_axis(axes, MEMORY)
    axes.set_ylabel("secondary rays a second, default = 1", fontsize=9)
    _name(axes, trade.points, points, SPEED_SIDES)


def _bytes_axis(axes: "Axes", label: str) -> None:
    """A logarithmic axis across, with plain numbers and room for the names of points."""
    axes.set_xscale("log")
    low, high = axes.get_xlim()
    low, high = low / 1.1, high * 1.4
    axes.set_xlim(low, high)
    steps = (1, 2, 5) if high / low < 100 else (1,)
    ticks = [step * 10.0**power for power in range(-3, 6) for step in steps]
    ticks = [tick for tick in ticks if low <= tick <= high]
    axes.set_xticks(ticks, [f"{tick:g}" for tick in ticks])
    axes.set_xticks([], minor=True)
    axes.set_xlabel(label, fontsize=9)


def _scatter(axes: "Axes", points: tuple[Point, ...], places: list[tuple[float, float]]) -> None:
    for factor, ink in INK.items():
        chosen = [k for k, point in enumerate(points) if point.factor == factor]
        if not chosen:
            continue
        x, y = zip(*(places[k] for k in chosen), strict=True)
        size, marker = MARKERS.get(factor, (26, "o"))
        axes.scatter(x, y, color=ink, label=factor, s=size, marker=marker, zorder=3 + (factor in MARKERS))


def _name(axes: "Axes", points: tuple[Point, ...], places: list[tuple[float, float]], sides: Sides) -> None:
    """Write the values of points beside them, those that would cover each other as one."""
    where = (axes.transScale + axes.transLimits).transform(places)
    for factor, side in sides.items():
        chosen = [k for k, point in enumerate(points) if point.factor == factor]
        while chosen:
            near = (np.abs(where[chosen] - where[chosen[0]]) < COVERED).all(axis=1)
            together = [k for k, is_near in zip(chosen, near, strict=True) if is_near]
            chosen = [k for k in chosen if k not in together]
            names = [points[k].value.removesuffix(" bits") for k in together]
            text = ", ".join(names) if len(names) < 3 else f"{names[0]} to {names[-1]}"
            look = {"fontsize": 7, "color": INK[factor], "va": "center"}
            shift, ha = SHIFTS[side]
            axes.annotate(text, places[together[0]], xytext=shift, textcoords="offset points", ha=ha, **look)


def _front(axes: "Axes", places: np.ndarray, costs: np.ndarray) -> None:
    front = places[pareto(costs)]
    front = front[np.argsort(front[:, 0], kind="stable")]
    axes.plot(front[:, 0], front[:, 1], color="#9aa0a8", linewidth=1.0, zorder=1)
