"""Choose options by what is wanted of the result: a largest error, a budget of memory, a target.

Everything is decided without JAX: errors by the closed-form bounds of grids (reducem/quantize.py), memory by
counting what a tracer keeps (reducem/resident.py), and what targets ask of speed by a table of measured
trades: that of the package, or the points.json of a `striptools trade` of one's own.

Cost: one conversion, and for a budget that needs a grid up to five more, since the bits are searched by
halving.
"""

import json
import math
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.resources import files
from pathlib import Path
from statistics import median
from typing import IO, Any, Literal, get_args

from striptools.errors import UsageError
from striptools.hierarchies.options import HierarchyOptions
from striptools.mesh.mesh import Mesh
from striptools.options import Options, Report
from striptools.pipeline import convert_with_report
from striptools.reducem.quantize import LEAST_BITS, MOST_BITS, PrecisionOptions
from striptools.reducem.resident import Residency, resident_bytes
from striptools.reducem.scene import Scene
from striptools.stopwatch import Watch

Target = Literal["quality", "balanced", "small", "fast"]
TARGETS: tuple[Target, ...] = get_args(Target)

LARGEST_ERRORS: dict[Target, float] = {"quality": 0.0, "balanced": 1e-5, "small": 1e-4, "fast": 0.0}
"""The largest error that a target allows where none is given, in diagonals; 0 keeps every bit."""

TABLE = "choose_table.json"
BASELINE, TARGET = "default", "target"
"""Factors of a trade that stand for no choice of their own: the default, and what a target chose."""

BOX_PRECISION, TRACED = "box precision", "traced hierarchy"
"""Factors that no conversion chooses: of tracers."""

PAIR = " x "
"""What stands between the factors of a pair."""


@dataclass(frozen=True)
class Row:
    """A point of a table; figures are over those of the default.

    Attributes:
        factor: What differs from the default, as `striptools trade` names it.
        value: By how much.
        memory: Bytes in memory.
        disk: Bytes on disk.
        speed: Rays a second, the geometric mean of primary and secondary ones.
        bound: The declared bound in diagonals.
    """

    factor: str
    value: str
    memory: float
    disk: float
    speed: float
    bound: float


@dataclass(frozen=True)
class Wish:
    """What is wanted of the result.

    Attributes:
        budget: The most bytes that a tracer may keep.
        target: What matters most.
        table: Points to choose targets from; those of the package where it is empty.
    """

    budget: int | None = None
    target: Target | None = None
    table: tuple[Row, ...] = field(default_factory=tuple)

    def __post_init__(self) -> None:
        if self.budget is not None and self.budget < 1:
            raise UsageError(f"{self.budget} is out of range", where="budget", remedy="give 1 byte or more")
        if self.target is not None and self.target not in TARGETS:
            raise UsageError(
                f"{self.target!r} is not known", where="target", remedy=f"give {', '.join(TARGETS)}"
            )


@dataclass(frozen=True)
class Choice:
    """What was chosen.

    Attributes:
        options: Of the conversion.
        resident: How a tracer is to keep the scene.
        resident_bytes: What it then keeps; None where that is not counted.
        why: In one sentence.
    """

    options: Options
    resident: Residency
    resident_bytes: int | None
    why: str

    def to_dict(self) -> dict[str, Any]:
        """What the file says of it."""
        return {"resident": self.resident, "resident_bytes": self.resident_bytes, "why": self.why}


def convert_to_wish(
    source: Mesh | str | Path | IO[bytes],
    options: Options,
    wish: Wish,
    *,
    file_format: str | None = None,
    watch: Watch | None = None,
) -> tuple[Scene, Report, Choice]:
    """Convert by the cheapest options that keep what is wanted, and say in the file's metadata which and why.

    Args:
        source: A mesh, or a file that `load_mesh` reads; a stream is read once for each try.
        options: What else is asked; its precision is the coarsest that may be chosen.
        wish: A budget, a target or both.
        file_format: The format of a file whose name does not tell.
        watch: Called with a stage's name and the fraction done.

    Raises:
        UsageError: The budget cannot be kept.
        StriptoolsError: As for `convert`.
    """
    resident, why = "expanded", []
    if wish.target is not None:
        options, resident, said = for_target(options, wish.target, wish.table)
        why.append(said)
    job = partial(convert_with_report, file_format=file_format, watch=watch)
    if wish.budget is None:
        scene, report = _converted(job, source, options)
    else:
        options, resident, scene, report, said = _within(job, source, options, resident, wish)
        why.append(said)
    kept = resident_bytes(scene, resident)
    choice = Choice(options, resident, kept, "; ".join(why))
    scene = replace(scene, metadata={**scene.metadata, "chosen": choice.to_dict()})
    return scene, report, choice


def shipped_table() -> tuple[Row, ...]:
    """The table of the package: medians of trades of several models."""
    text = files("striptools").joinpath(TABLE).read_text(encoding="utf-8")
    return tuple(Row(**row) for row in json.loads(text)["rows"])


def read_table(path: Path) -> tuple[Row, ...]:
    """The table of a points.json that `striptools trade --out` wrote.

    Raises:
        UsageError: It is none.
    """
    try:
        return table_of([json.loads(path.read_text(encoding="utf-8"))["points"]])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(
            "is no table of a trade", where=str(path), remedy="give the points.json that trade --out wrote"
        ) from error


def table_of(trades: list[list[dict[str, Any]]]) -> tuple[Row, ...]:
    """The medians of trades, for points that all of them have; what targets chose is left out.

    Args:
        trades: The `points` of each, as `trade --format json` prints them.
    """
    by_name = [{point["name"]: point for point in points} for points in trades]
    shared = [name for name in by_name[0] if all(name in points for points in by_name)]
    rows = [median_row([(points[name], points[BASELINE]) for points in by_name]) for name in shared]
    return tuple(row for row in rows if row.factor != TARGET)


def median_row(pairs: list[tuple[dict[str, Any], dict[str, Any]]]) -> Row:
    """A row of the medians of one point in several trades, each beside the default of its trade."""

    def over_default(name: str) -> float:
        return median(point[name] / default[name] for point, default in pairs)

    speed = median(math.sqrt(point["primary_ratio"] * point["secondary_ratio"]) for point, _ in pairs)
    bound = median(point["declared_bound"] for point, _ in pairs)
    first = pairs[0][0]
    sizes = (over_default("memory_per_triangle"), over_default("disk_per_triangle"))
    # The default is compared with itself to see the noise; its speed is 1 by definition.
    return Row(first["factor"], first["value"], *sizes, 1.0 if first["factor"] == BASELINE else speed, bound)


def cost_of(row: Row, target: Target) -> float:
    """What a target wants least of."""
    return {
        "quality": row.bound,
        "balanced": row.memory / row.speed,
        "small": row.disk,
        "fast": 1 / row.speed,
    }[target]


def may_choose(factor: str) -> bool:
    """Whether a target may choose points of a factor: an option of convert, every triangle kept, no leaks."""
    of_tracers = BOX_PRECISION in factor or factor == TRACED
    return not of_tracers and "simplification" not in factor and factor not in ("triangle test", TARGET)


NEAR = 0.05
"""Rows as good as the best one but for this part are no better: noise, or not worth an unusual option."""


def best_row(table: tuple[Row, ...], target: Target, largest: float) -> Row:
    """The row that a target asks for, none of a larger bound; the default where nothing is clearly better.

    A pair of factors is chosen only where it is clearly better than each factor by itself.

    Args:
        table: The rows; simplified ones and other triangle tests, which may leak, are never chosen.
        target: What matters most.
        largest: The largest bound allowed, in diagonals.
    """
    allowed = [row for row in table if may_choose(row.factor) and row.bound <= largest]
    best = min(cost_of(row, target) for row in allowed)
    near = [row for row in allowed if cost_of(row, target) <= best * (1 + NEAR)]
    return min(near, key=lambda row: (row.factor != BASELINE, PAIR in row.factor, cost_of(row, target)))


def for_target(
    options: Options, target: Target, table: tuple[Row, ...] = ()
) -> tuple[Options, Residency, str]:
    """The options and the residency that a target asks for, and why.

    Args:
        options: What is asked for besides; its precision stands where it is not lossless.
        target: What matters most.
        table: Points to choose from; those of the package where it is empty.
    """
    asked, table = options.precision, table or shipped_table()
    if asked.is_lossless and LARGEST_ERRORS[target] > 0:
        asked = PrecisionOptions(max_error=LARGEST_ERRORS[target], relative=True)
    # Precision is decided by its closed form; the table decides the rest.
    row = best_row(tuple(one for one in table if one.factor != "precision"), target, 0.0)
    chosen = replace(options, precision=asked)
    if row.factor == "strip cap":
        chosen = replace(chosen, ordering=replace(chosen.ordering, max_length=int(row.value)))
    elif row.factor == "block size":
        chosen = replace(chosen, ordering=replace(chosen.ordering, block=int(row.value)))
    elif row.factor == "hierarchy":
        chosen = replace(chosen, hierarchy=HierarchyOptions(row.value))  # pyright: ignore[reportArgumentType]
    if "boxes" in row.factor:
        chosen = replace(chosen, boxes="stored")
    resident: Residency = "compressed" if "residency" in row.factor else "expanded"
    name = row.factor if row.factor == BASELINE else f"{row.factor} {row.value}"
    grid = "every bit kept" if asked.is_lossless else f"the coarsest grid within {_bound(asked)}"
    why = (
        f"target {target}: {name}, {row.memory:.2f} of the default's memory, {row.disk:.2f} of its file, "
        f"{row.speed:.2f} of its rays a second by the table; {grid}"
    )
    return chosen, resident, why


def _bound(precision: PrecisionOptions) -> str:
    if precision.bits is not None:
        return f"{precision.bits} bits"
    return f"{precision.max_error:g}{' diagonals' if precision.relative else ''}"


def _converted(job: Any, source: Mesh | str | Path | IO[bytes], options: Options) -> tuple[Scene, Report]:
    if not isinstance(source, Mesh | str | Path):
        source.seek(0)
    return job(source, options)


def _within(
    job: Any, source: Mesh | str | Path | IO[bytes], options: Options, resident: Residency, wish: Wish
) -> tuple[Options, Residency, Scene, Report, str]:
    """The finest precision that fits a budget, expanded where that fits, and why."""
    assert wish.budget is not None
    # A target has chosen its precision; without one the finest that fits is wanted.
    finest = options if wish.target is not None else replace(options, precision=PrecisionOptions())
    scene, report = _converted(job, source, finest)
    ways: tuple[Residency, ...] = ("expanded", "compressed") if resident == "expanded" else ("compressed",)
    for way in ways:
        kept = _counted(scene, way)
        if kept <= wish.budget:
            return finest, way, scene, report, f"budget {wish.budget:,} bytes: {way} takes {kept:,}"
    tried = _finest_grid(job, source, options, wish.budget) if wish.target is None else None
    if tried is None:
        grid = "8 bits" if options.precision.is_lossless else _bound(options.precision)
        raise UsageError(
            f"{wish.budget:,} bytes cannot be kept: compressed takes {_counted(scene, 'compressed'):,}"
            + ("" if wish.target is not None else f", and a grid of {grid} still too many"),
            where="--budget",
            remedy="give more, or fewer triangles by --simplify",
        )
    bits, chosen, scene, report = tried
    kept = _counted(scene, "compressed")
    why = f"budget {wish.budget:,} bytes: {bits} bits is the finest that fits, compressed, {kept:,} bytes"
    return chosen, "compressed", scene, report, why


def _counted(scene: Scene, resident: Residency) -> int:
    kept = resident_bytes(scene, resident)
    if kept is None:
        raise UsageError(
            "bytes are counted for the default hierarchy without instances alone",
            where="--budget",
            remedy="leave --hierarchy out, and give --no-instances",
        )
    return kept


def _finest_grid(
    job: Any, source: Mesh | str | Path | IO[bytes], options: Options, budget: int
) -> tuple[int, Options, Scene, Report] | None:
    """The most bits whose scene fits, by halving; None where the coarsest that is allowed does not."""
    best, low, high = None, LEAST_BITS, MOST_BITS
    if not options.precision.is_lossless:
        scene, report = _converted(job, source, options)
        if _counted(scene, "compressed") > budget:
            return None
        low = _bits_of(scene) + 1
        best = (low - 1, options, scene, report)
    while low <= high:
        bits = (low + high) // 2
        chosen = replace(options, precision=PrecisionOptions(bits))
        scene, report = _converted(job, source, chosen)
        if _counted(scene, "compressed") <= budget:
            best, low = (bits, chosen, scene, report), bits + 1
        else:
            high = bits - 1
    return best


def _bits_of(scene: Scene) -> int:
    """The bits of the grid that a scene is on, along its longest side."""
    assert scene.grid_exponent is not None
    side = float((scene.high.astype(float) - scene.low.astype(float)).max())
    cells = math.ldexp(side, -scene.grid_exponent)
    return min(MOST_BITS, max(LEAST_BITS, math.ceil(math.log2(cells + 1))))
