"""Pictures of what was measured, drawn with matplotlib (extra `plots`), which is imported only here.

Figures are made without matplotlib's global state, so that no window system is asked for and nothing is left
behind. The same figures give the same bytes with the same matplotlib.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import IO, TYPE_CHECKING

import numpy as np

from striptools.errors import MissingExtraError
from striptools.measure.study import PAPER, REFERENCE, Study, StudyRow, paper_range
from striptools.mesh.atomic import write_atomically, write_stream

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = {"strip-rt": "#1b6ca8", "paper": "#7fb2d6", "stripe": "#c8553d", "tipsify": "#e0a030"}
"""A colour for each method."""

LIGHT = "#b9bdc4"
"""A colour for what stands behind."""


def require_plots() -> ModuleType:
    """The figures of matplotlib.

    Raises:
        MissingExtraError: matplotlib is not installed.
    """
    try:
        from matplotlib import figure
    except ImportError as error:
        raise MissingExtraError("plots need matplotlib", remedy='pip install "striptools[plots]"') from error
    return figure


def plot_study(study: Study, target: str | Path | IO[bytes], title: str = "") -> int:
    """Draw a study of stripifiers as a PNG picture: memory, rays a second, Strip-RT's lead, strip lengths.

    Args:
        study: What was found.
        target: A path, written whole or not at all, or a binary stream.
        title: The model's name.

    Returns:
        Bytes written.

    Raises:
        MissingExtraError: matplotlib is not installed.
        WriteError: The file could not be written.
    """
    figure = require_plots().Figure(figsize=(12, 8), dpi=110, layout="constrained")
    memory, rate, lead, lengths = figure.subplots(2, 2).reshape(-1)
    _plot_memory(memory, study)
    _plot_rate(rate, study)
    _plot_lead(lead, study)
    _plot_lengths(lengths, study)
    what = f"{study.triangles:,} triangles, stripifiers under the same representation"
    figure.suptitle(titled(title, what))
    return save_figure(figure, target)


def save_figure(figure: "Figure", target: str | Path | IO[bytes]) -> int:
    """Write a figure as a PNG picture, whole or not at all; gives the bytes written.

    Raises:
        WriteError: The file could not be written.
    """
    data = png_of(figure)
    return write_atomically(target, data) if isinstance(target, str | Path) else write_stream(target, data)


def png_of(figure: "Figure") -> bytes:
    """A figure as a PNG picture, of the same bytes each time."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()


def titled(title: str, what: str) -> str:
    """What something says under a model's name, which may be empty."""
    return f"{title}: {what}" if title else what


def name_rows(axes: "Axes", names: list[str]) -> None:
    """Name bars that lie from the top down at 0, 1, ..."""
    axes.set_yticks(np.arange(len(names)), names)
    axes.set_ylim(len(names) - 0.4, -0.6)


def legend_below(
    axes: "Axes", *, columns: int, drop: float = 0.06, labels: Sequence[str] | None = None
) -> None:
    """Put a legend under a plot, of its labels or of those given, so far down in parts of its height."""
    given = () if labels is None else (labels,)
    axes.legend(
        *given, fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -drop), ncols=columns, frameon=False
    )


def _plot_memory(axes: "Axes", study: Study) -> None:
    rows = study.rows
    swaps = [row.swap_bytes / study.triangles for row in rows]
    here = [row.scene_bytes / study.triangles for row in rows]
    _bars(axes, rows, swaps, LIGHT)
    _bars(axes, rows, here, [INK[row.method] for row in rows])
    for place, (low, high) in enumerate(zip(here, swaps, strict=True)):
        axes.annotate(f" {low:.1f} / {high:.1f}", (max(low, high), place), va="center", fontsize=8)
    axes.set_title("memory, bytes per triangle / with swap vertices, as in the paper", fontsize=10)
    axes.margins(x=0.15)


def _plot_rate(axes: "Axes", study: Study) -> None:
    rows = study.rows
    place = np.arange(len(rows))
    for shift, rates, alpha, label in (
        (-0.2, [row.primary_rate for row in rows], 1.0, f"primary, {study.primary_rays:,} rays"),
        (0.2, [row.secondary_rate for row in rows], 0.5, f"secondary, {study.secondary_rays:,} rays"),
    ):
        values = np.array(rates) / 1e6
        axes.barh(place + shift, values, 0.36, color=[INK[row.method] for row in rows], alpha=alpha)
        for y, value in zip(place + shift, values, strict=True):
            axes.annotate(f" {value:.2f}", (value, y), va="center", fontsize=8)
        axes.barh([0], [0], color="#555555", alpha=alpha, label=label)
    name_rows(axes, [row.variant for row in rows])
    axes.set_title("traced rays, millions a second (fastest run)", fontsize=10)
    legend_below(axes, columns=4)
    axes.margins(x=0.12)


def _plot_lead(axes: "Axes", study: Study) -> None:
    rows = [row for row in study.rows if row.variant != REFERENCE]
    for place, row in enumerate(rows):
        band = paper_range(row.method)
        if band is not None:
            label = f"the paper's {len(PAPER)} models" if "paper's" not in _labels(axes) else None
            axes.barh(place, band[1] - band[0], 0.8, left=band[0], color="#e4e6ea", label=label)
    place = np.arange(len(rows))
    axes.scatter([row.primary_ratio for row in rows], place, color="#222222", label="primary", zorder=3)
    axes.scatter(
        [row.secondary_ratio for row in rows], place, marker="D", facecolors="none", edgecolors="#222222",
        label="secondary", zorder=3,
    )  # fmt: skip
    axes.axvline(1.0, color="#222222", linewidth=0.8)
    name_rows(axes, [row.variant for row in rows])
    axes.set_title("rays a second of strip-rt over those of ...", fontsize=10)
    legend_below(axes, columns=4)


def _plot_lengths(axes: "Axes", study: Study) -> None:
    chosen = [row for row in study.rows if row.variant in (REFERENCE, *INK)]
    for row in chosen:
        lengths = row.quality.lengths
        axes.step(
            [*lengths, 2 * max(lengths)], [*lengths.values(), 0], where="post", color=INK[row.method],
            label=f"{row.variant}: {row.quality.strips:,}",
        )  # fmt: skip
    axes.set_xscale("log", base=2)
    axes.set_yscale("symlog", linthresh=1)
    axes.set_ylim(0, 2 * max(max(row.quality.lengths.values()) for row in chosen))
    axes.set_title("strips by length in triangles (bins k to 2k - 1)", fontsize=10)
    legend_below(axes, columns=4)


def _labels(axes: "Axes") -> str:
    return " ".join(axes.get_legend_handles_labels()[1])


def _bars(axes: "Axes", rows: tuple[StudyRow, ...], values: list[float], colour: object) -> None:
    axes.barh(np.arange(len(rows)), values, 0.7, color=colour)  # pyright: ignore[reportArgumentType]
    name_rows(axes, [row.variant for row in rows])
