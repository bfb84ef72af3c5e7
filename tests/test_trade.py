"""A trade: its points and figures on a small mesh, going on after an interruption, plots and report."""

import json
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from striptools.choose import BASELINE
from striptools.measure import trade as module
from striptools.measure.plots_trade import pareto, plot_trade
from striptools.measure.report_html import pictures_of, report_html, sentences, shortfalls
from striptools.measure.study import study_rays
from striptools.measure.trade import STATE, Trade, TradeOptions, peer_distance, trade
from striptools.measure.trade_pictures import difference_picture, flip, psnr
from striptools.measure.trade_points import Setting, settings
from striptools.mesh.clean import clean
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.reducem.quantize import PrecisionOptions
from striptools_cli.trade import printed

CHANDELIER = Path(__file__).parent.parent / "samples" / "chandelier.ply"
SMALL = TradeOptions(quick=True, side=32, runs=1, picture=32, verify_rays=4, aimed_rays=64)
BASE = Options(instances=False, geometry_only=True, remap=True)
"""What a trade makes of the default options."""

NAMES = (
    "default",
    "precision: 8 bits",
    "simplification: 25%",
    "residency: compressed",
    "traced hierarchy: rebuilt",
    "box precision: 8 bits",
    "residency x box precision: compressed, 4 bits",
)


@pytest.fixture(scope="module")
def mesh() -> Mesh:
    whole = load_mesh(CHANDELIER)
    return clean(Mesh(whole.positions, whole.faces[:3000])).mesh


def few(base: Options, *, quick: bool = False) -> tuple[Setting, ...]:
    return tuple(setting for setting in settings(base, quick=quick) if setting.name in NAMES)


@pytest.fixture(scope="module")
def done(mesh: Mesh, tmp_path_factory: pytest.TempPathFactory) -> tuple[Trade, Path]:
    pytest.importorskip("fast_simplification")
    folder = tmp_path_factory.mktemp("trade")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "settings", few)
        return trade(mesh, SMALL, model="part", folder=folder), folder


def test_points_change_one_factor() -> None:
    for quick in (True, False):
        found = settings(Options(), quick=quick)
        assert found[0] == Setting(BASELINE, "lossless", Options())
        assert len({setting.name for setting in found}) == len(found)
        factors = {setting.factor for setting in found}
        assert {"precision", "simplification", "strip cap", "block size", "hierarchy", "boxes"} < factors
        assert {"residency", "precision x simplification", "residency x boxes"} < factors
        assert {"box precision", "residency x box precision", "traced hierarchy"} < factors
        assert (
            sum(setting == replace(found[0], factor=setting.factor, value=setting.value) for setting in found)
            == 1
        )


def test_the_default_is_exact(done: tuple[Trade, Path]) -> None:
    base = done[0].points[0]
    assert (base.name, base.largest_error, base.declared_bound) == (BASELINE, 0.0, 0.0)
    assert (base.wrong_per_million, base.silhouette_per_million, base.leaks, base.disagreements) == (
        0,
        0,
        0,
        0,
    )
    assert base.psnr == 99.0
    assert base.t_largest < 1e-4


def test_a_grid_errs_within_its_bound(done: tuple[Trade, Path]) -> None:
    grid = next(point for point in done[0].points if point.factor == "precision")
    assert 0 < grid.rms_error < grid.largest_error <= grid.declared_bound
    assert grid.t_rms > 0
    assert grid.normal_rms > 0
    assert grid.disk_per_triangle < done[0].points[0].disk_per_triangle
    assert grid.psnr < 60
    assert grid.leaks == grid.disagreements == 0


def test_simplified_surfaces_are_within_certified_bounds(done: tuple[Trade, Path]) -> None:
    fewer = next(point for point in done[0].points if point.factor == "simplification")
    assert fewer.triangles < 0.4 * done[0].triangles
    assert 0 < fewer.largest_error <= fewer.declared_bound
    if fewer.peer_error is not None:
        assert fewer.peer_error <= fewer.declared_bound * (1 + 1e-6)


def test_compressed_has_the_same_hits_in_less_memory(done: tuple[Trade, Path]) -> None:
    base, packed = done[0].points[0], done[0].points[3]
    assert packed.memory_bytes < base.memory_bytes
    assert (packed.t_largest, packed.t_rms, packed.psnr) == (base.t_largest, base.t_rms, 99.0)


def test_boxes_of_any_precision_have_the_same_hits(done: tuple[Trade, Path]) -> None:
    base, compressed, rebuilt, planes, pair = (done[0].points[k] for k in (0, 3, 4, 5, 6))
    for point in (rebuilt, planes, pair):
        assert (point.t_largest, point.t_rms, point.psnr) == (base.t_largest, base.t_rms, 99.0)
        assert point.leaks == point.disagreements == 0
    # The same floats wider, the same bytes wider: nothing is won but what a size class is.
    assert planes.memory_bytes == base.memory_bytes
    assert pair.memory_bytes <= compressed.memory_bytes


def test_each_way_of_tracing_is_traced(mesh: Mesh) -> None:
    bench = module._Bench(mesh, SMALL, Options())
    stored = bench.tracer._layout.arrays.nodes
    of = {setting.name: setting for setting in settings(Options())}
    for name in ("traced hierarchy: rebuilt", "box precision: 4 bits"):
        nodes = bench._tracer(bench.scene, of[name])._layout.arrays.nodes
        assert nodes.shape[1] == stored.shape[1]
        assert not np.array_equal(nodes, stored, equal_nan=True)


def test_wrong_rays_are_counted(mesh: Mesh) -> None:
    """A fault: half of the faces are missing."""
    bench = module._Bench(mesh, SMALL, Options())
    half = module.convert_with_report(Mesh(mesh.positions, mesh.faces[::2]), Options())[0]
    found = bench._hits(half, module.Tracer(half))
    assert found["wrong_per_million"] > 1000
    assert found["silhouette_per_million"] > 1000


def test_an_interrupted_trade_goes_on(
    mesh: Mesh, done: tuple[Trade, Path], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    state = json.loads((done[1] / STATE).read_text())
    kept = {**state, "points": state["points"][:3]}
    (tmp_path / STATE).write_text(json.dumps(kept))
    monkeypatch.setattr(module, "settings", few)
    measured = []
    original = module._Bench.measured
    monkeypatch.setattr(
        module._Bench, "measured", lambda self, one: (measured.append(one.name), original(self, one))[1]
    )
    again = trade(mesh, SMALL, model="part", folder=tmp_path)
    assert measured == list(NAMES[3:])
    assert again.points[:3] == done[0].points[:3]
    # Other options, or a damaged file: everything again.
    for text in (json.dumps({**kept, "key": "other"}), "{"):
        (tmp_path / STATE).write_text(text)
        assert not module._State.opened(tmp_path, state["key"], few(BASE)).points


def test_a_point_whose_setting_changed_is_measured_again(done: tuple[Trade, Path]) -> None:
    state = json.loads((done[1] / STATE).read_text())
    wanted = few(BASE)
    changed = (*wanted[:3], replace(wanted[3], resident="expanded"), *wanted[4:])
    assert set(module._State.opened(done[1], state["key"], wanted).points) == set(NAMES)
    kept = set(NAMES) - {NAMES[3]}
    assert set(module._State.opened(done[1], state["key"], changed).points) == kept


def test_rays_come_from_four_views(mesh: Mesh) -> None:
    bench = module._Bench(mesh, SMALL, Options())
    primary, secondary = bench.rays
    assert len(primary.origins) == SMALL.side**2
    assert len(np.unique(primary.origins, axis=0)) == len(module.VIEWS) == 4
    # The first quarter are those of a study, by its one camera.
    alone = study_rays(bench.scene, bench.tracer, replace(SMALL.study(), side=SMALL.side // 2))
    assert np.array_equal(primary.directions[: len(alone[0].directions)], alone[0].directions)
    assert np.array_equal(secondary.origins[: len(alone[1].origins)], alone[1].origins)


def test_a_share_is_simplified_once(mesh: Mesh) -> None:
    pytest.importorskip("fast_simplification")
    bench = module._Bench(mesh, SMALL, Options())
    first, second = bench._source(0.25), bench._source(0.25)
    assert first[0] is second[0]
    assert first[1] == second[1] > 0
    assert bench._source(0.5)[0].triangle_count > first[0].triangle_count
    assert bench._source(1.0) == (mesh, 0.0)


def test_json_and_back(done: tuple[Trade, Path]) -> None:
    facts = json.loads(json.dumps(done[0].to_dict()))
    assert Trade.from_dict(facts) == done[0]


def test_a_report_stands_alone(done: tuple[Trade, Path]) -> None:
    pytest.importorskip("matplotlib")
    found, folder = done
    plot = plot_trade(found)
    assert plot.startswith(b"\x89PNG")
    pictures = pictures_of(found, folder)
    assert set(pictures) == {point.name for point in found.points}
    text = report_html(replace(found, model="<b>&"), plot, pictures)
    seen: list[tuple[str, dict[str, str | None]]] = []

    class Reader(HTMLParser):
        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            seen.append((tag, dict(attrs)))

    Reader().feed(text)
    links = [value for _, attributes in seen for name in ("src", "href") if (value := attributes.get(name))]
    # The default's picture is that of compressed too, and in it once.
    assert pictures["residency: compressed"] == pictures[BASELINE]
    assert len(links) == 1 + len(set(pictures.values())) < 1 + len(pictures)
    assert all(link.startswith("data:image/png;base64,") for link in links)
    assert not any(tag == "script" for tag, _ in seen)
    assert "&lt;b&gt;&amp;" in text
    assert len(sentences(found)) == 3
    assert all(sentence in text for sentence in sentences(found))


def test_a_share_that_is_not_reached_is_told(done: tuple[Trade, Path]) -> None:
    """A fault: simplifying stayed at four fifths."""
    assert shortfalls(done[0]) == []
    base, fewer = done[0].points[0], next(p for p in done[0].points if p.factor == "simplification")
    stuck = replace(fewer, triangles=round(0.8 * done[0].triangles))
    other = replace(stuck, name="simplification: 5%", value="5%")
    pair = replace(stuck, factor="precision x simplification", value="16 bits, 25%")
    found = replace(done[0], points=(base, stuck, other, pair))
    left = "80% of the triangles are left, no further edge collapses"
    lines = [
        f"not reached: simplification: 25%; 5%: {left}",
        f"not reached: precision x simplification: 16 bits, 25%: {left}",
    ]
    assert shortfalls(found) == lines
    assert all(line in report_html(found, None, {}) for line in lines)
    assert all(line in printed(found, "md") for line in lines)


def test_pareto_equals_a_search_over_pairs() -> None:
    costs = np.random.default_rng(3).integers(0, 6, (40, 2)).astype(float)
    slow = [not any((other <= cost).all() and (other < cost).any() for other in costs) for cost in costs]
    assert pareto(costs).tolist() == slow


def test_pictures_differ_by_what_is_known() -> None:
    grey = np.full((16, 16, 3), 100, np.uint8)
    other = grey.copy()
    other[4, 5] = 110
    assert psnr(grey, grey) == 99.0
    assert psnr(grey, other) == pytest.approx(10 * np.log10(255**2 / (100 / 256)))
    picture = difference_picture(grey, other)
    assert picture.shape == (16, 32, 3)
    assert (picture[4, 21] != picture[0, 16]).any()
    error = flip(grey, grey)
    if error is not None:
        assert error[0] == 0.0
        worse = flip(grey, other)
        assert worse is not None
        assert worse[0] > 0


def test_the_peer_agrees_on_two_planes() -> None:
    flat = Mesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32), np.array([[0, 1, 2]], np.int32))
    found = peer_distance(flat, replace(flat, positions=flat.positions + np.float32(0.5)), 1000)
    if found is None:
        pytest.skip("pymeshlab is not installed")
    assert 0.5 <= found <= 0.9


def test_options_out_of_range() -> None:
    for wrong in ({"side": 4}, {"runs": 0}, {"picture": 4}, {"up": "w"}):
        with pytest.raises(module.UsageError):
            TradeOptions(**wrong)


def test_a_grid_setting_is_a_grid() -> None:
    found = [setting for setting in settings(Options()) if setting.factor == "precision"]
    assert found[0].options.precision == PrecisionOptions(24)
