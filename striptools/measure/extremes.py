"""The table of extremes: every row of `extreme_rows` through every mode of tracing, against the exact answer.

How a case is judged. It is converted once for each precision and traced by each mode. Source, rays and hits
are taken into the frame in which the scene's largest coordinate and each direction's are 1 to 2, by powers of
two, where the bound is what `bound` derives. There the float64 oracle judges as `verify` does. Where float64
is in doubt integers decide (`exact`): of each reported hit t is compared with the exact one, and of the faces
near a ray none is certain that the exact ray misses, none impossible that it hits. Modes of one precision and
one triangle test have to agree bit for bit, closest hits and any hits. What comes out for finite rays is
finite. What `exact-sign` hits, integers say is hit; `fast` may leak.

Error over bound is the largest of: t over its bound, the hit point over its bound, and the move of a vertex
over the scene's declared bound. 1 would be a bound that is met; above it is a violation.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from striptools.errors import StriptoolsError
from striptools.measure.aimed import Surface
from striptools.measure.arithmetic import Probe, probe_arithmetic
from striptools.measure.bound import RayFrames, beyond_box, frame_rays, judge_pairs, shear_points
from striptools.measure.exact import exact_pair
from striptools.measure.extreme_rows import ERROR, KEPT, LARGEST, LEAKS, LIMIT, ROWS, Case, Row, aimed_case
from striptools.measure.judgement import Judge, compare_reported
from striptools.measure.oracle import Oracle
from striptools.measure.ray_sets import RaySet
from striptools.mesh.io import READ_FORMATS, load_mesh
from striptools.options import Options, Report
from striptools.pipeline import convert_with_report
from striptools.reducem.quantize import PrecisionOptions
from striptools.reducem.scene import Remap, Scene
from striptools.trace import Tracer
from striptools.trace.hit import Hits
from striptools.types import TriangleTest

CHUNK = 1 << 18
"""Faces handled at a time where a mesh may be large."""

EXACT_PAIRS = 400
"""Pairs of a ray and a face that integers decide, a case and precision: tens of microseconds each."""

LEAST_NORMAL = float(np.finfo(np.float32).tiny)
LONGEST_ERROR = 400
VIOLATED = "VIOLATED"
FILE_RAYS = 192


class Traces(Protocol):
    """What the table asks of a tracer."""

    def closest_hit(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        """See `striptools.trace.Tracer`."""
        ...

    def any_hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """See `striptools.trace.Tracer`."""
        ...


@dataclass(frozen=True)
class Mode:
    """A way to trace a mesh.

    Attributes:
        name: What the table calls it.
        options: Of the conversion.
        tracer: What `Tracer` is asked for.
    """

    name: str
    options: Options
    tracer: dict[str, Any]

    @property
    def on_grid(self) -> bool:
        """Whether positions are quantised."""
        return not self.options.precision.is_lossless

    @property
    def test(self) -> TriangleTest:
        """What triangles are tested by."""
        return self.tracer.get("test", "watertight")

    def expects(self, row: Row, verdict: str) -> bool:
        """Whether a verdict is one that a row expects of this mode."""
        wanted = row.verdict(grid=self.on_grid)
        leaks = self.test == "fast" and verdict == LEAKS and wanted in (KEPT, LIMIT)
        return verdict == wanted or leaks


WALKS: dict[str, dict[str, Any]] = {
    "expanded": {"resident": "expanded"},
    "rebuilt": {"hierarchy": "rebuilt", "resident": "expanded"},
    "compressed": {"resident": "compressed"},
}
TESTS: tuple[TriangleTest, ...] = ("fast", "exact-sign", "float64")
LOSSLESS, SIXTEEN_BITS = Options(), Options(precision=PrecisionOptions(bits=16))
MODES: tuple[Mode, ...] = (
    *(Mode(name, LOSSLESS, asked) for name, asked in WALKS.items()),
    *(Mode(test, LOSSLESS, {"resident": "expanded", "test": test}) for test in TESTS),
    *(Mode(f"{name}, 16 bits", SIXTEEN_BITS, asked) for name, asked in WALKS.items()),
)
"""Modes of equal options stand together and share a scene; hits of one triangle test must be the same."""


@dataclass(frozen=True)
class Outcome:
    """What became of one row, or one case of it, in one mode.

    Attributes:
        verdict: One of `extreme_rows.Expected`, or `VIOLATED`.
        t_ratio: The largest error of t over its bound.
        point_ratio: The largest error of a hit point over its bound.
        move_ratio: The largest move of a vertex over the scene's bound; 0 where none is declared.
        box_need: By how much a box had to be widened at most, in units of 2^-24 of the largest coordinate.
        detail: What is wrong, or what the error says.
    """

    verdict: str
    t_ratio: float = 0.0
    point_ratio: float = 0.0
    move_ratio: float = 0.0
    box_need: float = 0.0
    detail: str = ""

    @property
    def ratio(self) -> float:
        """The largest error over bound of all."""
        return max(self.t_ratio, self.point_ratio, self.move_ratio)

    def joined(self, other: "Outcome") -> "Outcome":
        """Both as one: what is wrong outweighs a limit, an error, and what is right."""
        order = (KEPT, ERROR, LIMIT, LEAKS, VIOLATED)
        worse = max(self, other, key=lambda one: order.index(one.verdict))
        names = ("t_ratio", "point_ratio", "move_ratio", "box_need")
        most = {name: max(getattr(self, name), getattr(other, name)) for name in names}
        return replace(worse, **most)


@dataclass(frozen=True)
class RowResult:
    """A row of the table.

    Attributes:
        row: What was expected.
        outcomes: By mode, in their order.
        modes: The modes.
    """

    row: Row
    modes: tuple[Mode, ...]
    outcomes: tuple[Outcome, ...]

    @property
    def ok(self) -> bool:
        """Whether every mode did what was expected."""
        pairs = zip(self.modes, self.outcomes, strict=True)
        return all(mode.expects(self.row, outcome.verdict) for mode, outcome in pairs)


@dataclass(frozen=True)
class ExtremesReport:
    """The table, and what XLA was found to do: `ok` where all is as expected."""

    rows: tuple[RowResult, ...]
    probes: tuple[Probe, ...] = field(default=())

    @property
    def ok(self) -> bool:
        """Whether every row is as expected, and every guard holds."""
        return all(row.ok for row in self.rows) and all(probe.guarded for probe in self.probes)

    @property
    def tightest(self) -> float:
        """The largest error over bound of all rows."""
        return max((one.ratio for row in self.rows for one in row.outcomes), default=0.0)


MakeTracer = Callable[[Scene, Mode], Traces]


def make_tracer(scene: Scene, mode: Mode) -> Traces:
    """The tracer of a mode."""
    return Tracer(scene, **mode.tracer)


def run_extremes(
    rows: Iterable[Row] = ROWS,
    modes: Sequence[Mode] = MODES,
    *,
    quick: bool = False,
    tracer: MakeTracer = make_tracer,
    tell: Callable[[str], None] = lambda name: None,
) -> ExtremesReport:
    """Run rows through modes.

    Args:
        rows: What to run; of all rows, those that are large are left out where `quick`.
        modes: Those that share options have to follow each other.
        quick: Few and small cases.
        tracer: What traces a scene; tests put faults in.
        tell: Called with the name of each row as it begins.
    """
    results = []
    for row in rows:
        if not (quick and row.large):
            tell(row.name)
            results.append(run_row(row, modes, quick=quick, tracer=tracer))
    return ExtremesReport(tuple(results), probe_arithmetic())


def rows_of(folder: Path) -> list[Row]:
    """A row for every mesh file in a folder, by name."""
    files = sorted(p for p in folder.iterdir() if p.is_file() and p.suffix[1:].lower() in READ_FORMATS)
    return [Row(path.name, "a mesh as it is", _of_file(path)) for path in files]


def _of_file(path: Path) -> Callable[[bool], Iterable[Case]]:
    return lambda quick: [aimed_case(load_mesh(path), count=FILE_RAYS)]


def run_row(
    row: Row, modes: Sequence[Mode] = MODES, *, quick: bool = False, tracer: MakeTracer = make_tracer
) -> RowResult:
    """Run one row through modes; see `run_extremes`."""
    outcomes: list[Outcome | None] = [None] * len(modes)
    for case in row.make(quick):
        at = 0
        while at < len(modes):
            shared = [mode for mode in modes[at:] if mode.options == modes[at].options]
            for k, outcome in enumerate(_run_case(case, shared, tracer), at):
                before = outcomes[k]
                outcomes[k] = outcome if before is None else before.joined(outcome)
            at += len(shared)
    return RowResult(row, tuple(modes), tuple(one or Outcome(VIOLATED, detail="no case") for one in outcomes))


def _run_case(case: Case, modes: Sequence[Mode], tracer: MakeTracer) -> list[Outcome]:
    """The outcomes of modes that share a scene."""
    try:
        scene, report = convert_with_report(case.mesh, modes[0].options)
    except Exception as error:  # a crash is what the table is there to find
        return [_refused(error)] * len(modes)
    outcomes: list[Outcome] = []
    done: dict[TriangleTest, tuple[Mode, Hits, Outcome]] = {}
    for mode in modes:
        try:
            traced = tracer(scene, mode)
            hits = traced.closest_hit(case.origins, case.directions)
            hit = traced.any_hit(case.origins, case.directions)
        except Exception as error:  # a crash is what the table is there to find
            outcomes.append(_refused(error))
            continue
        first = done.get(mode.test)
        if first is not None and _equal(first[1], hits):
            outcome = first[2]
        else:
            outcome = CaseJudge(case, scene, report, mode.test).outcome(hits)
        if first is None:
            done[mode.test] = mode, hits, outcome
        elif not _equal(first[1], hits):
            outcome = replace(outcome, verdict=VIOLATED, detail=f"other hits than {first[0].name}")
        if (hit != hits.hit).any():
            outcome = replace(outcome, verdict=VIOLATED, detail="any hits are not closest hits")
        outcomes.append(outcome)
        del traced  # not beside the next one, which may be as large
    return outcomes


def _refused(error: Exception) -> Outcome:
    line = str(error)
    clear = isinstance(error, StriptoolsError) and "\n" not in line and 0 < len(line) < LONGEST_ERROR
    detail = line if isinstance(error, StriptoolsError) else f"{type(error).__name__}: {line}"
    return Outcome(ERROR if clear else VIOLATED, detail=detail[:LONGEST_ERROR])


def _equal(one: Hits, other: Hits) -> bool:
    names = ("t", "face", "u", "v", "triangle")
    return all(np.array_equal(getattr(one, name), getattr(other, name)) for name in names)


class CaseJudge:
    """Judges hits of one case and scene, in the frame in which the scene is 1 to 2 large.

    Args:
        case: The source and the rays.
        scene: What was traced.
        report: Of its conversion.
        test: What triangles were tested by.
    """

    def __init__(self, case: Case, scene: Scene, report: Report, test: TriangleTest = "watertight") -> None:
        self.case, self.scene, self.report = case, scene, report
        self.test: TriangleTest = test
        self.scale = _power_below(np.abs([scene.low, scene.high]).max())
        positions = np.asarray(case.mesh.positions, np.float64)
        positions = positions if scene.origin is None else positions - scene.origin
        with np.errstate(over="ignore"):
            rounded = positions.astype(np.float32).astype(np.float64)
        self.source = replace(case.mesh, positions=rounded * self.scale)
        self.bound = scene.error_bound * self.scale
        outside = np.zeros(len(case.origins), bool) if case.outside is None else case.outside
        self.judged = np.flatnonzero(~outside)
        self.outside = np.flatnonzero(outside)
        with np.errstate(all="ignore"):
            directions = self._flushed(case.directions[self.judged])
            self.length = _power_below(np.abs(directions).max(axis=1))
            self.origins = (self._flushed(case.origins[self.judged]) * self.scale).astype(np.float32)
            self.directions = (directions * self.length[:, None]).astype(np.float32)
        self._judge: Judge | None = None

    def _flushed(self, values: np.ndarray) -> np.ndarray:
        """In float64; with zeros for denormals, where the case says that it has them."""
        flush = self.case.flushed & (np.abs(values) < LEAST_NORMAL)
        return np.where(flush, 0.0, values.astype(np.float64))

    def outcome(self, hits: Hits) -> Outcome:
        """What these hits come to."""
        flaw = _untidy(self.case, hits) or self._beyond_limit(hits)
        move, moved = self._moves()
        if flaw or moved:
            return Outcome(VIOLATED, move_ratio=move, detail=flaw or moved)
        judged, at_the_end = self._judged_hits(hits)
        found = self._judge_known(judged) if self.case.known is not None else self._judge_all(judged)
        limit = len(self.outside) > 0 or self.case.flushed or at_the_end
        limit |= 0 < self.case.detail < self.report.largest_rounding
        if found.verdict == KEPT and limit:
            found = replace(found, verdict=LIMIT)
        return replace(found, move_ratio=move)

    def _judged_hits(self, hits: Hits) -> tuple[Hits, bool]:
        """The hits of rays within the limits, in the frame, t in float64; and whether a t is at its end.

        Where it is, rightly, the t of the point that u and v say stands for it.
        """
        at = self.judged
        with np.errstate(invalid="ignore"):
            t = hits.t[at].astype(np.float64) * (self.scale / self.length)
        t = np.where(hits.hit[at], t, np.inf)
        ended = np.flatnonzero(hits.hit[at] & ((hits.t[at] <= LEAST_NORMAL) | (hits.t[at] >= LARGEST)))
        if len(ended):
            t[ended] = self._within_range(hits, ended, t[ended])
        judged = Hits(t, hits.face[at], hits.u[at], hits.v[at], hits.triangle[at])  # pyright: ignore[reportArgumentType]
        return judged, len(ended) > 0

    def _within_range(self, hits: Hits, ended: np.ndarray, t: np.ndarray) -> np.ndarray:
        """What t at the ends of float32's range stand for, in the frame; wrong ones stay as they are."""
        frames, at = frame_rays(self.origins, self.directions), self.judged[ended]
        weights = np.stack([1.0 - hits.u[at] - hits.v[at], hits.u[at], hits.v[at]], axis=1)
        points = (weights[:, :, None] * self.source.positions[self.source.faces[hits.face[at]]]).sum(axis=1)
        meant = shear_points(frames, ended, points[:, None])[:, 0, 2] / frames.depth[ended]
        if self.test == "float64":
            # Its t is closer than u and v, rounded to float32, can say.
            corners = self.source.positions[self.source.faces[hits.face[at]]]
            pairs = judge_pairs(frames, ended, corners, self.bound, self.test)
            near = np.abs(meant - pairs.t) * np.abs(frames.depth[ended]) <= pairs.lateral + pairs.depth_error
            meant = np.where(near, pairs.t, meant)
        unit = self.length[ended] / self.scale
        above = (hits.t[at] >= LARGEST) & ((meant >= t * (1 - 1e-6)) | (unit >= 2.0**128))
        below = (hits.t[at] <= LEAST_NORMAL) & ((meant <= t * (1 + 1e-6)) | (unit < LEAST_NORMAL))
        return np.where(above | below, meant, t)

    def _beyond_limit(self, hits: Hits) -> str:
        if self.case.outside_misses and hits.hit[self.outside].any():
            return "a ray beyond the limit hits"
        return ""

    def _moves(self) -> tuple[float, str]:
        """How far corners are from the source's, over the bound that is declared, and what is wrong."""
        remap = self.scene.remap
        assert remap is not None
        declared = self.scene.error_bound
        if self.scene.origin is None and declared == 0.0:
            declared = np.sqrt(3.0) * self.report.largest_rounding
        declared *= self.scale
        away = self._farthest_move(remap) * self.scale
        if not away <= declared * (1 + 2.0**-40):
            return 0.0, f"a vertex moved by {away / self.scale:.4g}, declared are {declared / self.scale:.4g}"
        return float(away / declared) if declared else 0.0, ""

    def _farthest_move(self, remap: Remap) -> float:
        """The farthest that a corner of a traced face is from the loaded one, in the model's unit."""
        source, faces = self.case.mesh, self.scene.faces()
        origin = 0.0 if self.scene.origin is None else self.scene.origin
        farthest = 0.0
        for begin in range(0, len(faces), CHUNK):
            part = slice(begin, begin + CHUNK)
            theirs = source.positions[source.faces[remap.face[part]]].astype(np.float64) - origin
            turned = (np.arange(3) + remap.rotation[part, None].astype(np.int64)) % 3
            theirs = np.take_along_axis(theirs, turned[:, :, None], axis=1)
            away = self.scene.positions[faces[part]].astype(np.float64) - theirs
            farthest = max(farthest, float(np.linalg.norm(away * self.scale, axis=2).max()))
        return farthest / self.scale

    def _judge_all(self, hits: Hits) -> Outcome:
        """Judge by every face of the source, in float64 and then in integers."""
        if self._judge is None:
            self._judge = self._make_judge()
            self._exact = self._judge.oracle.closest_hit(self.origins, self.directions)
        result = self._judge.judge(RaySet("rays", self.origins, self.directions), hits, self._exact)
        frames = frame_rays(self.origins, self.directions)
        ray = np.flatnonzero(hits.hit)
        pairs = self._judge.oracle.judge(frames, ray, hits.face[ray])
        corners = self._judge.oracle.positions[self.source.faces[hits.face[ray]]]
        exactly, flaw = _compare_exactly(frames, ray, corners, hits, pairs.t_bound)
        flaw = flaw or self._contradiction(frames) or self._denied(frames, ray, corners, hits)
        leaks = self.test == "fast" and result.leaks > 0 and not result.disagreements
        if (result.disagreements or result.leaks or result.flaws) and not leaks:
            flaw = result.flaws[0] if result.flaws else "a disagreement"
        return Outcome(
            VIOLATED if flaw else LEAKS if leaks else KEPT,
            max(result.max_t_ratio, exactly),
            result.max_uv_ratio,
            box_need=self._box_need(frames, ray, hits),
            detail=flaw,
        )

    def _make_judge(self) -> Judge:
        remap = self.scene.remap
        assert remap is not None
        there = np.unique(remap.face)
        surface = Surface(self.source.positions.astype(np.float32), self.source.faces[there])
        return Judge(Oracle(self.source, self.bound, self.test), surface, there.astype(np.int32), self.scene)

    def _contradiction(self, frames: RayFrames) -> str:
        """Where integers contradict what float64 calls certain or impossible of the faces near rays."""
        assert self._judge is not None
        found, oracle = self._exact.candidates, self._judge.oracle
        step = max(1, len(found.ray) // EXACT_PAIRS)
        for k in range(0, len(found.ray), step):
            corners = oracle.positions[oracle.faces[found.face[k]]]
            exact = exact_pair(frames.origins[found.ray[k]], frames.directions[found.ray[k]], corners)
            if found.pairs.certain[k] and not exact.hit:
                return f"ray {found.ray[k]} misses face {found.face[k]} exactly, which float64 calls certain"
            if exact.hit and not found.pairs.possible[k]:
                return f"ray {found.ray[k]} hits face {found.face[k]} exactly, which float64 calls impossible"
        return ""

    def _denied(self, frames: RayFrames, ray: np.ndarray, corners: np.ndarray, hits: Hits) -> str:
        """Where integers deny a hit of the test whose signs are exact, denormals apart, which are flushed."""
        if self.test != "exact-sign":
            return ""
        given = self.case.origins[self.judged], self.case.directions[self.judged]
        flushed = np.any([_denormal(a) for a in (*given, frames.origins, frames.directions)], axis=0)[ray]
        flushed |= _denormal(corners.reshape(-1, 9))
        for k in np.flatnonzero(~flushed)[:EXACT_PAIRS]:
            if not exact_pair(frames.origins[ray[k]], frames.directions[ray[k]], corners[k]).inside:
                return f"ray {ray[k]} hits face {hits.face[ray[k]]}, which integers say it misses"
        return ""

    def _box_need(self, frames: RayFrames, ray: np.ndarray, hits: Hits) -> float:
        """The most that a traced box had to be wider, in 2^-24 of the largest coordinate of ray and scene."""
        if len(ray) == 0:
            return 0.0
        corners = self.scene.positions[self.scene.faces()[hits.triangle[ray]]] * self.scale
        largest = np.maximum(np.abs(frames.origins[ray]).max(axis=1), 1.0)
        return float((beyond_box(frames, ray, corners) / largest).max() * 2.0**24)

    def _judge_known(self, hits: Hits) -> Outcome:
        """Judge by the one face that each ray may report."""
        assert self.case.known is not None
        face = self.case.known.face[self.judged]
        wrong = np.flatnonzero(hits.face != face)
        if len(wrong) and self.test == "fast":
            return Outcome(LEAKS)
        if len(wrong):
            k = wrong[0]
            return Outcome(VIOLATED, detail=f"ray {k}: face {hits.face[k]} and not {face[k]}")
        frames = frame_rays(self.origins, self.directions)
        ray = np.flatnonzero(face >= 0)
        corners = np.asarray(self.source.positions, np.float64)[self.source.faces[face[ray]]]
        pairs = judge_pairs(frames, ray, corners, self.bound, self.test)
        reported = compare_reported(frames, ray, hits, pairs, corners, np.ones(len(ray), bool))
        exactly, flaw = _compare_exactly(frames, ray, corners, hits, pairs.t_bound)
        flaw = flaw or self._denied(frames, ray, corners, hits)
        if not reported.valid[ray].all():
            flaw = "a hit beyond its bound"
        _, t_ratio, _, uv_ratio = reported.extremes(np.isin(np.arange(len(face)), ray))
        need = self._box_need(frames, ray, hits)
        return Outcome(VIOLATED if flaw else KEPT, max(t_ratio, exactly), uv_ratio, 0.0, need, flaw)


def _power_below(value: Any) -> Any:
    """The power of two that brings a positive number, or each of an array, to 1 to 2; 1 for others."""
    value = np.asarray(value, np.float64)
    usable = np.isfinite(value) & (value > 0)
    exponent = np.frexp(np.where(usable, value, 1.0))[1] - 1
    return np.ldexp(1.0, -exponent)


def _denormal(rows: np.ndarray) -> np.ndarray:
    """Which rows have a number that counts as zero and is not."""
    return ((rows != 0) & (np.abs(rows) < LEAST_NORMAL)).any(axis=1)


def _untidy(case: Case, hits: Hits) -> str:
    """What no ray, of whatever numbers, may get: something that is not a number, or half a hit."""
    hit = hits.hit
    weights = np.isfinite(hits.u) & np.isfinite(hits.v) & (hits.u >= 0) & (hits.v >= 0)
    told = np.where(hit, np.isfinite(hits.t) & (hits.t > 0), np.isposinf(hits.t) & (hits.face == -1))
    for k in np.flatnonzero(~(weights & told))[:1]:
        return (
            f"ray {k} {case.origins[k]} {case.directions[k]}: face {hits.face[k]} at t {hits.t[k]:.9g}, "
            f"u {hits.u[k]:.9g}, v {hits.v[k]:.9g}"
        )
    return ""


def _compare_exactly(
    frames: RayFrames, ray: np.ndarray, corners: np.ndarray, hits: Hits, t_bound: np.ndarray
) -> tuple[float, str]:
    """The largest error of t against integers over its bound, and the first that is beyond it."""
    largest = 0.0
    for k in range(min(len(ray), EXACT_PAIRS)):
        r = ray[k]
        exact = exact_pair(frames.origins[r], frames.directions[r], corners[k]).clamped
        if exact is None:
            continue
        error = abs(float(exact - Fraction(float(hits.t[r]))))
        if error > t_bound[k]:
            return np.inf, f"ray {r}: t errs by {error:.4g}, its bound is {t_bound[k]:.4g}"
        largest = max(largest, error / t_bound[k])
    return largest, ""


def _fraction(value: float) -> Any:
    from fractions import Fraction

    return Fraction(float(value))
