"""The table of extremes: each row, and that each of its checks finds its fault."""

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import striptools
from striptools.errors import LimitError, StriptoolsError
from striptools.hierarchies.options import HierarchyOptions
from striptools.measure import arithmetic, extremes, judgement
from striptools.measure.bound import beyond_box, frame_rays, hit_point_bound, judge_pairs
from striptools.measure.exact import exact_pair
from striptools.measure.extreme_rows import ERROR, KEPT, LIMIT, ROWS, Case, Row, aimed_case, ball, fan, moved
from striptools.measure.extremes import MODES, VIOLATED, Mode, make_tracer, rows_of, run_extremes, run_row
from striptools.options import Options
from striptools.pipeline import convert, convert_with_report
from striptools.trace import Tracer
from striptools.trace.hit import Hits

EXPANDED = MODES[0]
LARGEST, LEAST_NORMAL = extremes.LARGEST, extremes.LEAST_NORMAL
OTHER_HIERARCHIES = tuple(
    Mode(name, Options(hierarchy=HierarchyOptions(name)), {})
    for name in ("slbvh", "kdtree", "presorted", "loose-octree")
)
BY_NAME = {row.name: row for row in ROWS}


# Large rows run at a reduced count here; `striptools extremes` without --quick runs them in full.
@pytest.mark.parametrize("row", ROWS, ids=lambda row: row.name)
def test_row(row: Row) -> None:
    result = run_row(row, quick=True)
    found = [(mode.name, one.verdict, one.detail) for mode, one in zip(MODES, result.outcomes, strict=True)]
    assert result.ok, found
    assert max(outcome.ratio for outcome in result.outcomes) <= 1
    assert max(outcome.box_need for outcome in result.outcomes) < 8


@pytest.mark.parametrize("mode", OTHER_HIERARCHIES, ids=lambda mode: mode.name)
@pytest.mark.parametrize("name", ["t below 2^-126", "t beyond float32", "scale 1e-30", "zero directions"])
def test_other_hierarchies_do_the_same(name: str, mode: Mode) -> None:
    result = run_row(BY_NAME[name], (EXPANDED, mode), quick=True)
    assert result.ok, result.outcomes


def test_rows_say_what_they_expect() -> None:
    assert len({row.name for row in ROWS}) == len(ROWS)
    for row in ROWS:
        assert row.why
        assert bool(row.limit) == (LIMIT in (row.expected, row.on_grid)), row.name


def test_bounds_are_met_within_a_factor_of_ten() -> None:
    grazing = run_row(BY_NAME["rays grazing at 1e-7 rad"], MODES[:1]).outcomes[0]
    assert grazing.t_ratio > 0.1
    assert grazing.point_ratio > 0.1
    worst = run_row(BY_NAME["worst case of a grid"], MODES[6:7]).outcomes[0]
    assert 0.9 < worst.t_ratio <= 1
    assert 0.9 < worst.move_ratio <= 1
    assert worst.point_ratio > 0.1


# ---- Faults.


class Faulty:
    """A tracer whose closest hits are changed."""

    def __init__(self, tracer: extremes.Traces, fault: Callable[[Hits], Hits]) -> None:
        self.tracer, self.fault = tracer, fault

    def closest_hit(self, origins: np.ndarray, directions: np.ndarray) -> Hits:
        return self.fault(self.tracer.closest_hit(origins, directions))

    def any_hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        return self.tracer.any_hit(origins, directions)


def a_hit(hits: Hits) -> int:
    return int(np.flatnonzero(hits.hit)[0])


def changed(hits: Hits, ray: int, **values: float) -> Hits:
    columns = {name: getattr(hits, name).copy() for name in values}
    for name, value in values.items():
        columns[name][ray] = value
    return replace(hits, **columns)


def one_missed(hits: Hits) -> Hits:
    return changed(hits, a_hit(hits), t=np.inf, face=-1, u=0, v=0, triangle=-1)


def verdict_with(fault: Callable[[Hits], Hits], row: Row, mode: Mode = EXPANDED) -> extremes.Outcome:
    def faulty(scene: striptools.Scene, mode: Mode) -> Faulty:
        return Faulty(make_tracer(scene, mode), fault)

    return run_row(row, (mode,), quick=True, tracer=faulty).outcomes[0]


ONE_BALL = Row("a ball", "none", lambda quick: [aimed_case(ball())])
FAULTS: dict[str, Callable[[Hits], Hits]] = {
    "not a number": lambda hits: changed(hits, a_hit(hits), t=np.nan),
    "t of zero": lambda hits: changed(hits, a_hit(hits), t=0.0),
    "t of infinity": lambda hits: changed(hits, a_hit(hits), t=np.inf),
    "weights that are none": lambda hits: changed(hits, a_hit(hits), u=np.nan),
    "weights below zero": lambda hits: changed(hits, a_hit(hits), u=-1e-3),
    "half a miss": lambda hits: changed(hits, a_hit(hits), face=-1),
    "a wrong miss": one_missed,
    "another face": lambda hits: changed(hits, a_hit(hits), face=(hits.face[a_hit(hits)] + 5) % 150),
    "the end of the range": lambda hits: changed(hits, a_hit(hits), t=LARGEST),
    "the other end": lambda hits: changed(hits, a_hit(hits), t=LEAST_NORMAL),
}


@pytest.mark.parametrize("fault", FAULTS.values(), ids=FAULTS.keys())
def test_a_fault_is_a_violation(fault: Callable[[Hits], Hits]) -> None:
    assert verdict_with(lambda hits: hits, ONE_BALL).verdict == KEPT
    found = verdict_with(fault, ONE_BALL)
    assert found.verdict == VIOLATED
    assert found.detail


@pytest.mark.parametrize("mode", [MODES[0], MODES[6]], ids=["lossless", "grid"])
@pytest.mark.parametrize("name", ["scale 1e-30", "scale 1e+30", "a ball"])
def test_a_t_off_by_twice_its_bound_is_a_violation(name: str, mode: Mode) -> None:
    case = aimed_case(moved(ball(), {"scale 1e-30": 1e-30, "scale 1e+30": 1e30}.get(name, 1.0)))
    row = Row(name, "none", lambda quick: [case])
    scene, report = convert_with_report(case.mesh, mode.options)
    judge = extremes.CaseJudge(case, scene, report)
    frames = frame_rays(judge.origins, judge.directions)

    def off(hits: Hits) -> Hits:
        ray = a_hit(hits)
        corners = judge.source.positions[judge.source.faces[hits.face[ray]]][None]
        pairs = judge_pairs(frames, np.array([ray]), corners, judge.bound)
        bound = pairs.t_bound[0] * judge.length[ray] / judge.scale
        return changed(hits, ray, t=hits.t[ray] + np.float32(2.1 * bound))

    assert verdict_with(lambda hits: hits, row, mode).verdict == KEPT
    assert verdict_with(off, row, mode).verdict == VIOLATED


def test_a_hit_beyond_a_limit_is_a_violation() -> None:
    def hit(hits: Hits) -> Hits:
        return changed(hits, 0, t=1.0, face=0, triangle=0)

    assert verdict_with(hit, BY_NAME["zero directions"]).verdict == VIOLATED


def test_a_wrong_face_where_the_answer_is_known_is_a_violation() -> None:
    row = BY_NAME["one triangle a million times"]
    assert verdict_with(lambda hits: changed(hits, 0, face=1), row).verdict == VIOLATED
    assert verdict_with(lambda hits: changed(hits, 0, t=hits.t[0] * 1.0001), row).verdict == VIOLATED


def test_any_hits_and_modes_that_differ_are_violations() -> None:
    class Blind(Faulty):
        def any_hit(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
            return np.zeros(len(origins), bool)

    def blind(scene: striptools.Scene, mode: Mode) -> Blind:
        return Blind(make_tracer(scene, mode), lambda hits: hits)

    def later(hits: Hits) -> Hits:
        # Within the bound, but not the same bits.
        return changed(hits, a_hit(hits), t=np.nextafter(hits.t[a_hit(hits)], np.float32(np.inf)))

    def late(scene: striptools.Scene, mode: Mode) -> Faulty:
        return Faulty(make_tracer(scene, mode), later if mode is MODES[2] else lambda hits: hits)

    assert "any hits" in run_row(ONE_BALL, MODES[:1], tracer=blind).outcomes[0].detail
    outcomes = run_row(ONE_BALL, MODES[:3], tracer=late).outcomes
    assert [outcome.verdict for outcome in outcomes] == [KEPT, KEPT, VIOLATED]


@pytest.mark.parametrize(
    ("error", "verdict"),
    [
        (StriptoolsError("one clear line", remedy="do this"), ERROR),
        (StriptoolsError("long " * 200), VIOLATED),
        (ZeroDivisionError("a crash"), VIOLATED),
    ],
)
def test_only_one_line_is_a_clear_error(error: Exception, verdict: str) -> None:
    def refuse(scene: striptools.Scene, mode: Mode) -> extremes.Traces:
        raise error

    assert run_row(ONE_BALL, MODES[:1], tracer=refuse).outcomes[0].verdict == verdict


def test_a_vertex_that_moved_farther_than_declared_is_a_violation() -> None:
    case = aimed_case(ball())
    scene, report = convert_with_report(case.mesh, MODES[6].options)
    hits = Tracer(scene).closest_hit(case.origins, case.directions)
    assert extremes.CaseJudge(case, scene, report).outcome(hits).verdict == KEPT
    strict = replace(scene, error_bound=scene.error_bound / 4)
    found = extremes.CaseJudge(case, strict, report).outcome(hits)
    assert found.verdict == VIOLATED
    assert "moved by" in found.detail


def test_integers_contradict_a_bound_that_is_too_small(monkeypatch: pytest.MonkeyPatch) -> None:
    honest = judgement.judge_pairs

    def certain(*arguments: Any) -> object:
        pairs = honest(*arguments)
        everywhere = np.ones_like(pairs.clear)
        return replace(pairs, clear=everywhere, side=np.ones_like(pairs.side), ahead=everywhere[:, 0])

    monkeypatch.setattr("striptools.measure.oracle.judge_pairs", certain)
    monkeypatch.setattr(extremes.Judge, "judge", lambda *_: NOTHING_WRONG)
    found = run_row(BY_NAME["needles of aspect 1e6"], MODES[:1], quick=True).outcomes[0]
    assert found.verdict == VIOLATED
    assert "float64 calls certain" in found.detail


NOTHING_WRONG = judgement.SetResult("", 0, True, 0, 0, 0, 0, 0, 0, 0.0, 0.0, 0.0, 0.0, ())


def test_an_unexpected_verdict_makes_the_table_fail() -> None:
    assert run_extremes([ONE_BALL], MODES[:1]).ok
    assert not run_extremes([replace(ONE_BALL, expected=ERROR)], MODES[:1]).ok
    assert not run_extremes([Row("none", "no case", lambda quick: [])], MODES[:1]).ok


# ---- What the bound is made of.


numbers = st.floats(-1e6, 1e6, width=32)
triples = st.tuples(numbers, numbers, numbers)


@given(triples, triples, st.tuples(triples, triples, triples))
def test_exact_pairs_are_those_of_fractions(origin: tuple, direction: tuple, corners: tuple) -> None:
    if not any(direction):
        return
    pair = exact_pair(np.array(origin), np.array(direction), np.array(corners))
    found = by_fractions(origin, direction, corners)
    if found is None:
        assert not pair.hit
        assert pair.t is None
    else:
        t, u, v = found
        assert pair.t == t
        assert pair.hit == (u >= 0 and v >= 0 and u + v <= 1 and t > 0)


def by_fractions(origin: tuple, direction: tuple, corners: tuple) -> tuple[Fraction, ...] | None:
    """Cramer's rule: t, u, v of the plane; None where the ray is parallel to it."""
    o, d, (a, b, c) = ([Fraction(x) for x in origin], [Fraction(x) for x in direction], corners)
    e, f, s = (
        [Fraction(x) - Fraction(y) for x, y in zip(*pair, strict=True)] for pair in ((b, a), (c, a), (o, a))
    )

    def det(x: list, y: list, z: list) -> Fraction:
        return (
            x[0] * (y[1] * z[2] - y[2] * z[1])
            - x[1] * (y[0] * z[2] - y[2] * z[0])
            + x[2] * (y[0] * z[1] - y[1] * z[0])
        )

    minus = [-x for x in d]
    whole = det(minus, e, f)
    return None if whole == 0 else (det(s, e, f) / whole, det(minus, s, f) / whole, det(minus, e, s) / whole)


def test_what_no_float32_can_be_is_refused() -> None:
    with pytest.raises(ValueError, match="no multiple"):
        exact_pair(np.array([2.0**-400, 0, 0]), np.ones(3), np.eye(3))


def test_a_face_moved_along_its_normal_errs_by_the_move_over_the_cosine() -> None:
    corners = np.array([[-1, -1, 0], [1, -1, 0], [0, 1, 0]], np.float64)
    for slant in (0.0, 0.3, 1.0, 5.0, 50.0):
        direction = np.array([[slant, 0.2, -1]])
        frames = frame_rays(-direction, direction)
        d = frames.directions[0]
        cosine = abs(d[2]) / np.linalg.norm(d)
        pairs = judge_pairs(frames, np.zeros(1, int), corners[None], 1e-3)
        own = judge_pairs(frames, np.zeros(1, int), corners[None]).t_bound[0]
        over_cosine = 1e-3 / cosine / np.linalg.norm(d)
        assert over_cosine <= pairs.t_bound[0] <= (over_cosine + own) * 1.05
        raised = judge_pairs(frames, np.zeros(1, int), corners[None] + [0, 0, 1e-3])
        assert abs(raised.t - pairs.t)[0] == pytest.approx(over_cosine, rel=1e-6)


def test_the_hit_point_bound_adds_up() -> None:
    case = aimed_case(ball())
    frames = frame_rays(case.origins, case.directions)
    hits = Tracer(convert(case.mesh)).closest_hit(case.origins, case.directions)
    ray = np.flatnonzero(hits.hit)
    corners = case.mesh.positions.astype(np.float64)[case.mesh.faces[hits.face[ray]]]
    pairs = judge_pairs(frames, ray, corners)
    u, v = hits.u[ray].astype(np.float64), hits.v[ray].astype(np.float64)
    points = (np.stack([1 - u - v, u, v], axis=1)[:, :, None] * corners).sum(axis=1)
    along = frames.origins[ray] + hits.t[ray, None].astype(np.float64) * frames.directions[ray]
    assert (np.linalg.norm(points - along, axis=1) <= hit_point_bound(pairs)).all()


def test_how_far_a_ray_is_from_a_box() -> None:
    corners = np.array([[[0, 0, 1], [1, 0, 2], [0, 1, 2]]], np.float64)
    origins = np.array([[0.5, 0.5, 0], [1.25, 0.5, 0], [-0.5, -0.25, 0], [0.5, 0.5, 9]], np.float32)
    frames = frame_rays(origins, np.tile([[0, 0, 1]], (4, 1)))
    need = beyond_box(frames, np.arange(4), np.repeat(corners, 4, axis=0))
    np.testing.assert_allclose(need, [0, 0.25, 0.5, 0], atol=1e-12)


def test_a_hub_is_judged_once_a_ray(monkeypatch: pytest.MonkeyPatch) -> None:
    judged = []
    honest = judgement.judge_fans

    def counting(frames: Any, surface: Any, fans: Any, bound: float) -> object:
        judged.append(len(fans.face))
        return honest(frames, surface, fans, bound)

    monkeypatch.setattr(judgement, "judge_fans", counting)
    origin = np.array([[0.1, 0.2, 3]], np.float32)
    row = Row("a hub", "none", lambda quick: [Case(fan(500), origin, -origin)])
    assert run_row(row, MODES[:1]).ok
    assert 0 < sum(judged) <= 2 * 500 + 4


# ---- The tracer's limits.


def test_a_scene_of_nothing_but_denormals_is_refused() -> None:
    scene = convert(moved(ball(), 1e-40))
    with pytest.raises(LimitError, match="counts as zero"):
        Tracer(scene)


@pytest.mark.parametrize("asked", [mode.tracer for mode in MODES[:3]], ids=[m.name for m in MODES[:3]])
def test_t_ends_where_float32_does(asked: dict) -> None:
    tracer = Tracer(convert(ball()), **asked)
    near, far = np.array([[0.1, 0.05, 2]], np.float32), np.array([[0.1, 0.05, 100]], np.float32)
    long, short = (np.array([[0, 0, -length]], np.float32) for length in (2e38, 2e-38))
    assert tracer.closest_hit(near, long).t[0] == LEAST_NORMAL
    assert tracer.closest_hit(far, short).t[0] == LARGEST
    assert tracer.all_hits(near, long, k=2).t[0, 0] == LEAST_NORMAL
    many = np.tile(near, (64, 1)), np.tile(long, (64, 1))
    assert (tracer.closest_hit(*many).t == LEAST_NORMAL).all()


# ---- What XLA does.


def test_what_xla_does_to_arithmetic_is_noticed() -> None:
    probes = {probe.name: probe for probe in arithmetic.probe_arithmetic()}
    assert all(probe.guarded for probe in probes.values())
    assert probes["contraction"].taken
    assert probes["flushing of denormals"].taken
    assert not probes["reassociation"].taken


def test_a_guard_that_does_not_hold_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(arithmetic, "rounded", lambda product: product)
    assert not arithmetic._contraction().guarded
    monkeypatch.setattr(arithmetic, "quotient", lambda a, b: a * (1 / b))
    assert not arithmetic._division().guarded
    assert not run_extremes([ONE_BALL], MODES[:1]).ok


def test_a_reassociated_sum_is_noticed() -> None:
    a, b = (np.array([x], np.float32) for x in (1.0, 1e-4))
    assert arithmetic.differs(lambda a, b: b + (a - a), (a + b) - a, a, b)
    assert not arithmetic.differs(lambda a, b: (a + b) - a, (a + b) - a, a, b)


# ---- The command.

Run = Callable[..., tuple[int, str, str]]


@pytest.fixture
def run(run: Run) -> Run:
    return partial(run, "extremes", "--quick")


def test_the_command_prints_the_table(run: Run) -> None:
    code, out, _ = run("--only", "zero dir", "--only", "empty mesh")
    assert code == 0
    assert "2 rows, all as expected" in out
    assert "zero directions" in out
    assert "t over its bound" in out
    code, out, _ = run("--only", "empty mesh", "--format", "csv")
    assert code == 0
    assert out.splitlines()[0].startswith("row,expected,ok,expanded,")
    assert "empty mesh,clear error,true,clear error" in out


def test_the_command_fails_where_a_verdict_is_another(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = (replace(BY_NAME["empty mesh"], expected=KEPT),)
    monkeypatch.setattr("striptools_cli.extremes.ROWS", rows)
    code, out, _ = run()
    assert code == 1
    assert "1 NOT as expected" in out
    assert "empty mesh: expanded: no face is left" in out


def test_the_command_takes_a_folder_of_meshes(run: Run, tmp_path: Path) -> None:
    striptools.save_mesh(ball(), tmp_path / "ball.ply")
    (tmp_path / "notes.txt").write_text("no mesh")
    assert [row.name for row in rows_of(tmp_path)] == ["ball.ply"]
    assert run("--meshes", tmp_path, "--only", "ball.ply", "-q")[:2] == (0, "")
    assert run("--meshes", tmp_path / "none")[0] == 2
    assert run("--only", "no such row")[0] == 2


def test_real_meshes_keep_the_bound(real_mesh: Callable[[str], Path]) -> None:
    path = real_mesh("cad_frame")
    row = next(row for row in rows_of(path.parent) if row.name == path.name)
    result = run_row(row)
    assert result.ok, result.outcomes
