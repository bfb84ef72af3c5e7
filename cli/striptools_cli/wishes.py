"""What a command line wishes for: lengths, shares, sizes, targets."""

from pathlib import Path
from typing import cast

from striptools.choose import Target, Wish, read_table
from striptools.errors import UsageError
from striptools.mesh.simplify import Simplified, SimplifyOptions
from striptools.options import Options
from striptools_cli.report import human_value

_SIZES = {"kB": 10**3, "MB": 10**6, "GB": 10**9, "KiB": 2**10, "MiB": 2**20, "GiB": 2**30, "B": 1, "": 1}


def length(text: str, where: str) -> tuple[float, bool]:
    """A length, and whether it counts in diagonals: `0.01` or `1e-4rel`.

    Raises:
        UsageError: It is none.
    """
    relative = text.endswith("rel")
    try:
        return float(text.removesuffix("rel")), relative
    except ValueError:
        raise UsageError(
            f"{text!r} is no error", where=where, remedy="give a number, or one like 1e-4rel"
        ) from None


def simplify_options(share: str | None, error: str | None) -> SimplifyOptions:
    """The share of triangles to keep, `25%` or `0.25`, and the largest error.

    Raises:
        UsageError: They are none.
    """
    keep = None
    if share is not None:
        try:
            keep = float(share.removesuffix("%")) / (100 if share.endswith("%") else 1)
        except ValueError:
            raise UsageError(
                f"{share!r} is no share", where="--simplify", remedy="give one like 25% or 0.25"
            ) from None
    largest, relative = (None, False) if error is None else length(error, "--simplify-error")
    return SimplifyOptions(keep, largest, relative)


def wish_for(budget: str | None, target: str | None, table: str | None, options: Options) -> Wish | None:
    """The budget and the target, or None where there is neither.

    Raises:
        UsageError: They are none, or what they choose is given as well.
    """
    if budget is None and target is None:
        if table is not None:
            raise UsageError("there is no --target to choose by it", where="--table", remedy="leave it out")
        return None
    if options.precision.bits is not None:
        raise UsageError("--bits is what is to be chosen", remedy="leave it out, or give --max-error")
    default = Options()
    chosen = (options.ordering.max_length, options.ordering.block, options.hierarchy, options.boxes)
    usual = (default.ordering.max_length, default.ordering.block, default.hierarchy, default.boxes)
    if target is not None and chosen != usual:
        raise UsageError(
            "strip length, block, hierarchy and boxes are what is to be chosen",
            where="--target",
            remedy="leave them out, or the target",
        )
    rows = () if table is None else read_table(Path(table))
    return Wish(None if budget is None else _size(budget), cast(Target | None, target), rows)


def said_of(simplified: Simplified) -> str:
    """One line on what simplifying did."""
    after, before = simplified.mesh.triangle_count, simplified.triangles_before
    there, back = (human_value(one.upper) for one in (simplified.of_source, simplified.of_result))
    return (
        f"  simplified: {after:,} of {before:,} triangles; the source strays at most {there} from the "
        f"result, the result at most {back} from the source"
    ) + _shortfall(simplified)


def _shortfall(simplified: Simplified) -> str:
    """That fewer triangles were asked, where they were."""
    if not simplified.is_short:
        return ""
    return f"; {simplified.wanted:,} were asked, but no further edge collapses"


def _size(text: str) -> int:
    unit = next(unit for unit in _SIZES if text.endswith(unit))
    try:
        return int(float(text.removesuffix(unit)) * _SIZES[unit])
    except (ValueError, OverflowError):
        raise UsageError(f"{text!r} is no size", where="--budget", remedy="give one like 100MB") from None
