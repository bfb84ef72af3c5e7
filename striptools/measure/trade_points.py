"""The points of a trade: the default, one factor at a time around it, a few named pairs, what targets choose.

Boxes are float32 in the default, which is expanded, and 8 bits a plane in a compressed scene (SPEC 4.4). Box
precision is varied in both: the expanded hierarchy under the file's 8 bits and fewer, and, as a pair with
residency, the compressed one under fewer (measure/box_precision.py). Whether boxes inside blocks are stored
or rebuilt is a factor of the file, with a pair of its own. The traced hierarchy is what an expanded tracer
can make anew, over single triangles in float32, instead of the stored one.
"""

from dataclasses import dataclass, replace
from typing import get_args

from striptools.choose import BASELINE, BOX_PRECISION, PAIR, TARGET, TARGETS, TRACED, for_target
from striptools.hierarchies.options import HierarchyName, HierarchyOptions
from striptools.options import Options
from striptools.reducem.quantize import PrecisionOptions
from striptools.reducem.resident import Residency
from striptools.trace.tracer import HierarchyKind
from striptools.types import TriangleTest

BITS = (24, 22, 20, 18, 16, 14, 12, 10, 8)
SHARES = (0.5, 0.25, 0.1, 0.05, 0.02, 0.01)
LENGTHS = (4, 8, 16, 32, 64)
BLOCKS = (32, 64, 128)

QUICK_BITS = (20, 16, 12, 8)
QUICK_SHARES = (0.25, 0.05)
QUICK_LENGTHS = (8, 32)
QUICK_BLOCKS = (64,)

TESTS: tuple[TriangleTest, ...] = ("fast", "exact-sign", "float64")

BOX_BITS, QUICK_BOX_BITS = (8, 6, 4), (8,)
PAIR_BOX_BITS, QUICK_PAIR_BOX_BITS = (6, 4), (4,)
"""Of a compressed scene, which has 8 without a pair."""

PAIR_BITS, PAIR_SHARES = (16, 12), (0.25, 0.05)


@dataclass(frozen=True)
class Setting:
    """One point, before it is measured.

    Attributes:
        factor: What differs from the default: `default` itself, a factor, or a pair.
        value: By how much, in words.
        options: Of the conversion.
        keep: The share of the triangles that simplification keeps.
        resident: How the tracer keeps the scene.
        test: The tracer's triangle test.
        hierarchy: Which hierarchy the tracer walks.
        box_bits: Bits of the planes of boxes; None for what the tracer has: 8 compressed, float32 expanded.
    """

    factor: str
    value: str
    options: Options
    keep: float = 1.0
    resident: Residency = "expanded"
    test: TriangleTest = "watertight"
    hierarchy: HierarchyKind = "stored"
    box_bits: int | None = None

    @property
    def name(self) -> str:
        """Factor and value."""
        return self.factor if self.factor == BASELINE else f"{self.factor}: {self.value}"


def settings(base: Options, *, quick: bool = False) -> tuple[Setting, ...]:
    """The points to measure, the default first.

    Args:
        base: What all have in common; its precision, hierarchy and boxes are those of the default.
        quick: Few values of each factor.
    """
    bits = QUICK_BITS if quick else BITS
    shares = QUICK_SHARES if quick else SHARES
    found = [Setting(BASELINE, "lossless", base)]
    found += [Setting("precision", f"{b} bits", _on_grid(base, b)) for b in bits]
    found += [Setting("simplification", f"{share:.0%}", base, keep=share) for share in shares]
    found += [
        Setting("strip cap", str(length), _ordered(base, max_length=length))
        for length in (QUICK_LENGTHS if quick else LENGTHS)
        if length != base.ordering.max_length
    ]
    found += [
        Setting("block size", str(block), _ordered(base, block=block))
        for block in (QUICK_BLOCKS if quick else BLOCKS)
    ]
    found += [
        Setting("hierarchy", name, replace(base, hierarchy=HierarchyOptions(name), boxes="rebuilt"))
        for name in get_args(HierarchyName)
        if name != base.hierarchy.name
    ]
    stored = replace(base, boxes="stored")
    found += [
        Setting("boxes", "stored", stored),
        Setting("residency", "compressed", base, resident="compressed"),
        Setting(TRACED, "rebuilt", base, hierarchy="rebuilt"),
    ]
    found += [
        Setting(BOX_PRECISION, f"{b} bits", base, box_bits=b) for b in (QUICK_BOX_BITS if quick else BOX_BITS)
    ]
    found += [Setting("triangle test", test, base, test=test) for test in TESTS]
    found += [
        Setting("precision x simplification", f"{b} bits, {share:.0%}", _on_grid(base, b), keep=share)
        for b in PAIR_BITS
        for share in PAIR_SHARES
        if not quick or (b, share) == (PAIR_BITS[0], PAIR_SHARES[0])
    ]
    found.append(Setting("residency x boxes", "compressed, stored", stored, resident="compressed"))
    found += [
        Setting(
            f"residency{PAIR}{BOX_PRECISION}",
            f"compressed, {b} bits",
            stored,
            resident="compressed",
            box_bits=b,
        )
        for b in (QUICK_PAIR_BOX_BITS if quick else PAIR_BOX_BITS)
    ]
    chosen = [one for one in _of_targets(base) if not any(_is_the_same(one, other) for other in found)]
    return tuple(found + chosen)


def chosen_by_targets(base: Options, points: tuple[Setting, ...]) -> dict[str, str]:
    """The name of the point that each target chooses, among these."""
    same = ((one.value, [p for p in points if _is_the_same(one, p)]) for one in _of_targets(base))
    return {target: found[0].name for target, found in same if found}


def _of_targets(base: Options) -> list[Setting]:
    """What each target chooses by the table of the package."""
    chosen = ((target, *for_target(base, target)) for target in TARGETS)
    return [Setting(TARGET, target, options, resident=way) for target, options, way, _ in chosen]


def _is_the_same(one: Setting, other: Setting) -> bool:
    return replace(one, factor=other.factor, value=other.value) == other


def _on_grid(base: Options, bits: int) -> Options:
    return replace(base, precision=PrecisionOptions(bits))


def _ordered(base: Options, **changes: int) -> Options:
    return replace(base, ordering=replace(base.ordering, **changes))
