"""A trade as one HTML file that opens anywhere: sentences, plots, the table, and pictures of differences.

Nothing is loaded from elsewhere: pictures are in it as data, and there is no script.
"""

import base64
import html
import re
from pathlib import Path

from striptools.choose import BASELINE
from striptools.measure.trade import Point, Trade, picture_name
from striptools.measure.trade_targets import chosen_of
from striptools.mesh.simplify import reaches, wanted_of

COLUMNS = {
    "name": "point",
    "triangles": "triangles",
    "memory_per_triangle": "B/tri in memory",
    "disk_per_triangle": "B/tri on disk",
    "build_seconds": "build s",
    "primary_ratio": "primary rays/s",
    "secondary_ratio": "secondary rays/s",
    "largest_error": "largest error",
    "rms_error": "rms error",
    "declared_bound": "declared bound",
    "t_largest": "t error, largest",
    "t_rms": "t error, rms",
    "normal_largest": "normal, largest (deg)",
    "normal_rms": "normal, rms (deg)",
    "wrong_per_million": "wrong per million rays",
    "silhouette_per_million": "silhouette, pixels per million",
    "leaks": "leaks",
    "disagreements": "disagreements",
    "psnr": "PSNR dB",
    "flip": "FLIP",
}
"""The table's columns: fields of a point, and their headings."""

_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 1250px; padding: 0 1rem; }
table { border-collapse: collapse; font-size: 12px; } th, td { padding: 2px 7px; text-align: right; }
th { border-bottom: 2px solid #999; vertical-align: bottom; }
td:first-child { text-align: left; white-space: nowrap; }
tr:nth-child(even) { background: #f4f5f7; } .wide { overflow-x: auto; } img { max-width: 100%; }
figure { display: inline-block; margin: 6px; width: 390px; vertical-align: top; }
figcaption { font-size: 12px; }
.bad { color: #b00020; font-weight: bold; } footer { color: #666; font-size: 12px; margin-top: 2rem; }
"""


def report_html(trade: Trade, plot: bytes | None, pictures: dict[str, bytes]) -> str:
    """The report.

    Args:
        trade: What was found.
        plot: The Pareto plots, a PNG; None where matplotlib is not installed.
        pictures: A PNG for each point that has one, by its name.
    """
    title = html.escape(f"What is traded on {trade.model}")
    parts = [
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>',
        f"<style>{_STYLE}</style></head><body><h1>{title}</h1>",
        f"<p>{html.escape(_intro(trade))}</p>",
        *(f"<p>{html.escape(line)}</p>" for line in sentences(trade) + shortfalls(trade)),
        "" if plot is None else f'<p><img alt="Pareto plots" src="{_inline(plot)}"></p>',
        "<h2>Targets</h2>",
        *(f"<p>{html.escape(line)}</p>" for line in target_lines(trade)),
        f'<h2>Every point</h2><div class="wide">{_table(trade)}</div>',
        "<h2>Pictures</h2><p>Points by one camera, and beside each where it differs from the default.</p>",
        *(_figure(alike, picture) for picture, alike in _by_picture(trade, pictures).items()),
        *(f"<p>Left out: {html.escape(f'{name}: {why}')}</p>" for name, why in trade.left_out.items()),
        f"<footer>{html.escape(trade.machine)}; {html.escape(trade.versions)}</footer></body></html>\n",
    ]
    return "\n".join(part for part in parts if part)


def sentences(trade: Trade) -> list[str]:
    """What the trade is, in three sentences with its figures."""
    of = {point.name: point for point in trade.points}
    base, grids = of[BASELINE], [point for point in trade.points if point.factor == "precision"]
    found = []
    if grids:
        safe = [p for p in grids if p.wrong_per_million <= 10] or grids[:1]
        least = min(safe, key=lambda p: p.disk_per_triangle)
        found.append(
            f"Precision buys bytes on disk and costs error, not speed: {least.value} take "
            f"{least.disk_per_triangle:.2f} bytes per triangle instead of {base.disk_per_triangle:.2f}, move "
            f"no vertex by more than {least.declared_bound:.1e} diagonals, and send at most ten rays of a "
            "million to another part of the surface."
        )
    packed = of.get("residency: compressed")
    if packed:
        found.append(
            f"Residency buys memory and costs speed, not error: compressed takes "
            f"{packed.memory_per_triangle:.1f} bytes per triangle instead of {base.memory_per_triangle:.1f}, "
            f"at {packed.primary_ratio:.2f} of the primary and {packed.secondary_ratio:.2f} of the secondary "
            "rays a second, with the same hits."
        )
    fewer = [point for point in trade.points if point.factor == "simplification"]
    if fewer:
        one = min(fewer, key=lambda p: abs(p.triangles / trade.triangles - 0.25))
        kept = one.triangles / trade.triangles
        found.append(
            f"Simplification buys everything but error: {kept:.0%} of the triangles take "
            f"{one.memory_per_triangle:.1f} bytes per source triangle in memory, but the surface strays by "
            f"up to {one.declared_bound:.1e} diagonals and, secondary rays starting at the source surface, "
            f"{one.wrong_per_million:,.0f} rays of a million end on another part of it."
        )
    return found


def shortfalls(trade: Trade) -> list[str]:
    """Which shares of the triangles simplifying did not get down to, and where it stayed, a line each."""
    asked: dict[tuple[str, int], list[str]] = {}
    for point in trade.points:
        share = re.search(r"([\d.]+)%$", point.value)
        if share and not reaches(point.triangles, wanted_of(trade.triangles, float(share[1]) / 100)):
            asked.setdefault((point.factor, point.triangles), []).append(point.value)
    return [
        f"not reached: {factor}: {'; '.join(values)}: {left / trade.triangles:.0%} of the triangles are "
        "left, no further edge collapses"
        for (factor, left), values in asked.items()
    ]


def target_lines(trade: Trade) -> list[str]:
    """What each target of `convert` chooses, beside the best point that was found here, a line each."""
    wanted = {
        "quality": "the declared bound",
        "balanced": "bytes in memory over rays a second",
        "small": "bytes on disk",
        "fast": "time a ray",
    }
    lines = []
    for one in chosen_of(trade.to_dict()):
        away = (
            "the best point" if one.best == one.point else f"{one.ratio:.2f} of that of the best, {one.best}"
        )
        lines.append(f"target {one.target} ({wanted[one.target]}) chooses {one.point}: {away}")
    return lines


def pictures_of(trade: Trade, folder: Path) -> dict[str, bytes]:
    """The pictures that a trade left in its folder, by the points' names."""
    paths = {point.name: folder / picture_name(point.name) for point in trade.points}
    return {name: path.read_bytes() for name, path in paths.items() if path.is_file()}


def _intro(trade: Trade) -> str:
    return (
        f"{trade.triangles:,} triangles, {trade.rays[0]:,} primary and {trade.rays[1]:,} secondary rays of "
        "four views. One factor at a time differs from the default. Lengths are in diagonals of the model, "
        f"{trade.diagonal:.6g} units; bytes are divided by the triangles of the source; rays a second are "
        "those of the point over those of the default, traced in turn in the same run."
    )


def _table(trade: Trade) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in COLUMNS.values())
    rows = ["".join(_cell(point, name) for name in COLUMNS) for point in trade.points]
    return f"<table><tr>{head}</tr>" + "".join(f"<tr>{row}</tr>" for row in rows) + "</table>"


def _cell(point: Point, name: str) -> str:
    value = getattr(point, name)
    bad = ' class="bad"' if name in ("leaks", "disagreements") and value else ""
    if value is None:
        text = "-"
    elif isinstance(value, int):
        text = f"{value:,}"
    elif isinstance(value, float):
        text = f"{value:.3g}" if abs(value) < 1000 else f"{value:,.0f}"
    else:
        text = html.escape(str(value))
    return f"<td{bad}>{text}</td>"


def _by_picture(trade: Trade, pictures: dict[str, bytes]) -> dict[bytes, list[Point]]:
    """The points of each picture: most of those without an error share the default's."""
    found: dict[bytes, list[Point]] = {}
    for point in trade.points:
        if point.name in pictures:
            found.setdefault(pictures[point.name], []).append(point)
    return found


def _figure(points: list[Point], picture: bytes) -> str:
    first, *others = points
    caption = f"{first.name}: {first.psnr:.1f} dB" + (
        "" if first.flip is None else f", FLIP {first.flip:.4f}"
    )
    caption += f"; the same: {', '.join(point.name for point in others)}" if others else ""
    name = html.escape(caption)
    return f'<figure><img alt="{name}" src="{_inline(picture)}"><figcaption>{name}</figcaption></figure>'


def _inline(png: bytes) -> str:
    return f"data:image/png;base64,{base64.b64encode(png).decode()}"
