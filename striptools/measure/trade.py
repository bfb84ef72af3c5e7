"""What bytes, speed and error are traded for each other, one factor at a time, on any mesh.

Every point is converted, traced and judged by itself, in turn with the default, so that what else the machine
does falls on both alike, and is written down when it is done: an interrupted trade goes on where it was.

What is measured of a point, in diagonals of the model where it is a length:

1. Bytes in memory are the tracer's; bytes on disk those of the file without remap and attributes. Both are
   divided by the triangles of the SOURCE, so that points with fewer triangles can be compared.
2. Position errors: of corners from the source's, in float64, where faces are the source's; of the surfaces
   from each other, both ways, where they were simplified (certified bounds, mesh/surface_distance.py). The
   declared bound is what the file says, or the certified bound of the surfaces.
3. Primary rays come from four views, two from above and two from below: how the children of a few nodes
   near the root stand in their slots is worth 25 % to the rays of one view of a flat model, nothing over all.
4. Errors of t and of normals at the rays that hit in both, against the source's face in float64. A ray is
   wrong where it hits and the source's does not, or the other way, or where its t is `JUMP` diagonals off: it
   then is on another part of the surface. Secondary rays start at the source's surface, so that where a
   point's lies outside of it they hit it at once: that counts, as it would in a renderer with baked origins.
5. Leaks and disagreements are those of `verify`: the scene against the mesh that it was made from, by the
   bound of the triangle test in use. Where that is `fast`, rays leak. Tests other than the default one do
   without packets, which the default one's camera rays go in.
6. Pictures: the default's and the point's by one camera; PSNR, FLIP where it is installed, and how many of a
   million pixels change between hit and miss (the silhouette).
"""

import hashlib
import json
import math
import time
from dataclasses import asdict, dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from striptools.choose import BASELINE
from striptools.errors import MissingExtraError, UsageError
from striptools.measure.bound import frame_rays
from striptools.measure.box_precision import coarsened, lay_out_planes
from striptools.measure.environment import machine, versions
from striptools.measure.oracle import Oracle
from striptools.measure.study import (
    RaySet,
    StudyOptions,
    rate_and_ratio,
    study_rays,
    tell_no_one,
    timed_in_turn,
)
from striptools.measure.trade_pictures import difference_picture, flip, psnr
from striptools.measure.trade_points import Setting, chosen_by_targets, settings
from striptools.measure.verify import VerifyOptions, verify
from striptools.mesh.atomic import write_atomically
from striptools.mesh.clean import clean
from striptools.mesh.mesh import Mesh
from striptools.mesh.simplify import collapsed
from striptools.mesh.surface_distance import Surface, deviation
from striptools.options import Options
from striptools.pipeline import convert_with_report
from striptools.reducem.quantize import PrecisionOptions
from striptools.reducem.scene import Scene
from striptools.stopwatch import Watch
from striptools.trace import Tracer
from striptools.trace.device import DeviceKind
from striptools.trace.rays import THREE_QUARTER, Camera
from striptools.trace.render import RenderOptions, render, save_png

JUMP = 0.01
"""How far off, in diagonals, t says that a ray is on another part of the surface."""

STATE = "trade.json"
"""The file of a folder that the points done are kept in."""

SIDES = ((1, 1, 1), (-1, 1, -1), (-1, -1, 1), (1, -1, -1))
VIEWS = tuple((r * THREE_QUARTER[0], u * THREE_QUARTER[1], f * THREE_QUARTER[2]) for r, u, f in SIDES)
"""Where primary rays come from, as `Camera.framing` says it."""

LEAST_SIDE = 8
"""Pixels across and down that a view has at least."""

CHUNK = 1 << 17
WARMING = 512
"""Faces that are converted before the clock runs."""


@dataclass(frozen=True)
class TradeOptions:
    """How much is measured.

    Attributes:
        options: What all conversions have in common; instances are flattened, attributes left out.
        quick: Few values of each factor.
        side: Pixels across and down, 8 to 4096; a primary ray each, a quarter of them in each of `VIEWS`.
        runs: Runs whose ratios are taken the median of.
        picture: Pixels across and down of pictures.
        verify_rays: Rays of each kind that are tried against every face.
        aimed_rays: Rays aimed at edges and vertices.
        up: The model's axis that points to the picture's top.
        device: Where to trace.
        threads: Threads to trace with; None for every core.
    """

    options: Options = field(default_factory=Options)
    quick: bool = False
    side: int = 512
    runs: int = 5
    picture: int = 256
    verify_rays: int = 64
    aimed_rays: int = 16384
    up: str = "y"
    device: DeviceKind = "auto"
    threads: int | None = None

    def __post_init__(self) -> None:
        self.study()
        if not 8 <= self.picture <= 2048:
            raise UsageError(f"{self.picture} is out of range", where="picture", remedy="give 8 to 2048")

    def study(self) -> StudyOptions:
        """The rays, as a study has them."""
        return StudyOptions(self.options, self.side, self.runs, self.up, self.device, self.threads)


@dataclass(frozen=True)
class Point:
    """A point that is measured; lengths in diagonals of the source unless a name says otherwise.

    Attributes:
        name: Its name.
        factor: What differs from the default.
        value: By how much.
        triangles: Of the scene.
        memory_bytes: What the tracer keeps.
        disk_bytes: The file, without remap and attributes.
        memory_per_triangle: Bytes in memory for each triangle of the source.
        disk_per_triangle: Bytes on disk for each.
        build_seconds: From the loaded mesh to the scene, simplifying included.
        layout_seconds: From the scene to a tracer.
        primary_ratio: Rays a second over the default's in the same run.
        secondary_ratio: The same of rays from what the camera sees.
        primary_rate: Primary rays a second in the fastest run, of processor time on a CPU.
        error_kind: `corners` or `surfaces`: what the position errors are of.
        largest_error: The largest position error.
        rms_error: The root of the mean square one.
        declared_bound: What the position error is promised to stay below.
        peer_error: The larger one-sided distance by pymeshlab's samples; None where it is not asked.
        t_largest: The largest error of t at hits, wrong rays apart.
        t_rms: The root of the mean square one.
        normal_largest: The largest angle between normals at hits, wrong rays apart, in degrees.
        normal_rms: The root of the mean square one.
        wrong_per_million: Rays that hit something else, of a million.
        silhouette_per_million: Primary rays that hit where the source's miss or the other way, of a million.
        leaks: Rays of verify that slipped through.
        disagreements: Rays of verify with a wrong answer.
        verified_rays: How many verify traced.
        psnr: Of the picture, in decibels.
        flip: The mean FLIP error of the picture, 0 to 1; None where flip-evaluator is not installed.
    """

    name: str
    factor: str
    value: str
    triangles: int
    memory_bytes: int
    disk_bytes: int
    memory_per_triangle: float
    disk_per_triangle: float
    build_seconds: float
    layout_seconds: float
    primary_ratio: float
    secondary_ratio: float
    primary_rate: float
    error_kind: str
    largest_error: float
    rms_error: float
    declared_bound: float
    peer_error: float | None
    t_largest: float
    t_rms: float
    normal_largest: float
    normal_rms: float
    wrong_per_million: float
    silhouette_per_million: float
    leaks: int
    disagreements: int
    verified_rays: int
    psnr: float
    flip: float | None


@dataclass(frozen=True)
class Trade:
    """What a trade found.

    Attributes:
        model: The model's name.
        triangles: Of the source, once clean.
        diagonal: Of its box, in the model's unit.
        rays: Primary and secondary rays in a run.
        machine: Where it was measured.
        versions: With what.
        left_out: Points that could not be measured, and why.
        targets: The name of the point that each target of `convert` chooses.
        points: The default first.
    """

    model: str
    triangles: int
    diagonal: float
    rays: tuple[int, int]
    machine: str
    versions: str
    left_out: dict[str, str]
    targets: dict[str, str]
    points: tuple[Point, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return asdict(self)

    @classmethod
    def from_dict(cls, facts: dict[str, Any]) -> "Trade":
        """The trade that `to_dict` gave.

        Raises:
            TypeError: It is of another version.
        """
        points, rays = tuple(Point(**row) for row in facts["points"]), tuple(facts["rays"])
        return cls(**{**facts, "points": points, "rays": rays})


def trade(
    mesh: Mesh,
    options: TradeOptions | None = None,
    *,
    model: str = "",
    folder: Path | None = None,
    watch: Watch | None = None,
) -> Trade:
    """Measure the points of a trade on a mesh.

    Args:
        mesh: As loaded.
        options: How much.
        model: A name for reports.
        folder: Where points are kept as they are done, with a picture each; None keeps nothing.
        watch: Called with a point's name and the fraction done of all.

    Returns:
        The points, those done by an earlier, interrupted run of the same on this machine among them.

    Raises:
        UnreadableMeshError: Cleaning leaves no face.
        UsageError: An option is out of its range.
        WriteError: The folder cannot be written to.
    """
    options = options or TradeOptions()
    tell = watch or tell_no_one
    mesh = mesh.flattened().geometry()
    base = replace(options.options, instances=False, geometry_only=True, remap=True)
    wanted = settings(base, quick=options.quick)
    state = _State.opened(folder, _key(mesh, options), wanted)
    tell(BASELINE, 0.0)
    bench = _Bench(mesh, options, base)
    for done, setting in enumerate(wanted):
        tell(setting.name, done / len(wanted))
        if setting.name in state.points or setting.name in state.left_out:
            continue
        try:
            point, picture = bench.measured(setting)
        except MissingExtraError as error:
            state.left_out[setting.name] = str(error)
            continue
        state.points[setting.name] = point
        state.save(picture)
    tell(wanted[-1].name, 1.0)
    found = [state.points[setting.name] for setting in wanted if setting.name in state.points]
    rays = (len(bench.rays[0].origins), len(bench.rays[1].origins))
    facts = (bench.scene.triangle_count, bench.diagonal, rays, machine(), versions(), state.left_out)
    targets = chosen_by_targets(base, wanted)
    return Trade(model, *facts, targets, tuple(found))


def _key(mesh: Mesh, options: TradeOptions) -> str:
    """What has to be the same for points of an earlier run to count."""
    hashed = hashlib.sha256(mesh.positions.tobytes())
    hashed.update(mesh.faces.tobytes())
    hashed.update(repr((options, machine(), versions())).encode())
    return hashed.hexdigest()


@dataclass
class _State:
    """The points done so far, in a folder or in memory alone."""

    folder: Path | None
    key: str
    settings: dict[str, str]
    points: dict[str, Point] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)

    @classmethod
    def opened(cls, folder: Path | None, key: str, wanted: tuple[Setting, ...]) -> "_State":
        state = cls(folder, key, {setting.name: repr(setting) for setting in wanted})
        if folder is None or not (folder / STATE).is_file():
            return state
        try:
            facts = json.loads((folder / STATE).read_text(encoding="utf-8"))
            same = [name for name, by in facts["settings"].items() if state.settings.get(name) == by]
            rows = facts["points"] if facts["key"] == key else []
            kept = {row["name"]: Point(**row) for row in rows if row["name"] in same}
        except (OSError, ValueError, KeyError, TypeError):
            # Of another version, or damaged: everything is measured again.
            return state
        state.points.update(kept)
        return state

    def save(self, picture: np.ndarray) -> None:
        if self.folder is None:
            return
        last = list(self.points.values())[-1]
        save_png(picture, self.folder / picture_name(last.name))
        facts = {
            "key": self.key,
            "settings": self.settings,
            "points": [asdict(point) for point in self.points.values()],
        }
        write_atomically(self.folder / STATE, json.dumps(facts, indent=1).encode())


def picture_name(name: str) -> str:
    """The file of a point's picture."""
    return "".join(letter if letter.isalnum() else "-" for letter in name).replace("--", "-") + ".png"


class _Bench:
    """The default, its rays and its answers, and what every point is compared with."""

    def __init__(self, mesh: Mesh, options: TradeOptions, base: Options) -> None:
        self.mesh, self.options = mesh, options
        self.scene = convert_with_report(mesh, base)[0]
        cleaned = clean(mesh, base.clean)
        self.origin = np.zeros(3) if cleaned.origin is None else cleaned.origin
        self.whole = cleaned.mesh
        self.diagonal = float(np.linalg.norm(self.whole.bounds[1] - self.whole.bounds[0]))
        self.tracer = Tracer(self.scene, device=options.device, threads=options.threads)
        self.rays = _rays_of_views(self.scene, self.tracer, options.study())
        self._surface: Surface | None = None
        self._fewer: dict[float, tuple[Mesh, float]] = {}
        self.camera = Camera.framing(
            self.scene.positions, width=options.picture, height=options.picture, up=options.up
        )
        self.picture = self._drawn(self.tracer, self.scene)
        self.truth = [self._truth(part) for part in self.rays]

    def measured(self, setting: Setting) -> tuple[Point, np.ndarray]:
        """Convert, trace and judge one point."""
        # A few faces first, so that no compilation falls into the seconds of the point.
        few = replace(self.whole, faces=self.whole.faces[:WARMING])
        convert_with_report(few, replace(setting.options, precision=PrecisionOptions()))
        source, simplifying = self._source(setting.keep)
        start = time.perf_counter()
        scene, _ = convert_with_report(source, setting.options)
        built = time.perf_counter() - start + simplifying
        threads = self.options.threads or 1
        traced = scene if setting.box_bits is None else coarsened(scene, setting.box_bits, threads)
        start = time.perf_counter()
        tracer = self._tracer(traced, setting)
        laid_out = time.perf_counter() - start
        parts = scene.part_bytes()
        disk = sum(parts.values()) - parts["remap"] - parts["attributes"]
        picture = self._drawn(tracer, scene)
        found = flip(self.picture, picture)
        report = verify(scene, source, self._verify_options(), tracer=tracer, test=setting.test)
        facts = {
            **self._errors(scene, source, setting),
            **self._hits(scene, tracer),
            **self._rates(tracer),
        }
        count = self.scene.triangle_count
        point = Point(
            name=setting.name,
            factor=setting.factor,
            value=setting.value,
            triangles=scene.triangle_count,
            memory_bytes=tracer.resident_bytes,
            disk_bytes=disk,
            memory_per_triangle=tracer.resident_bytes / count,
            disk_per_triangle=disk / count,
            build_seconds=built,
            layout_seconds=laid_out,
            leaks=report.leaks,
            disagreements=report.disagreements,
            verified_rays=report.rays,
            psnr=psnr(self.picture, picture),
            flip=None if found is None else found[0],
            **facts,
        )
        return point, difference_picture(self.picture, picture)

    def _source(self, keep: float) -> tuple[Mesh, float]:
        """The mesh to convert, and the seconds that simplifying took, once for every point of a share."""
        if keep >= 1:
            return self.mesh, 0.0
        if keep not in self._fewer:
            start = time.perf_counter()
            fewer = collapsed(self.whole, keep) or self.whole
            self._fewer[keep] = fewer, time.perf_counter() - start
        return self._fewer[keep]

    def _tracer(self, scene: Scene, setting: Setting) -> Tracer:
        given = {"device": self.options.device, "threads": self.options.threads}
        if setting.box_bits is not None and setting.resident == "expanded":
            return Tracer.of_layout(lay_out_planes(scene, self.options.threads or 1), **given)
        return Tracer(
            scene, **given, resident=setting.resident, test=setting.test, hierarchy=setting.hierarchy
        )

    def _verify_options(self) -> VerifyOptions:
        return VerifyOptions(rays=self.options.verify_rays, aimed_rays=self.options.aimed_rays)

    def _drawn(self, tracer: Tracer, scene: Scene) -> np.ndarray:
        return render(tracer, scene, self.camera, RenderOptions())

    def _truth(self, rays: RaySet) -> dict[str, np.ndarray]:
        """Of each ray t in float64, infinite on a miss, and unit normals by the source's face that is hit."""
        hits = self.tracer.closest_hit(rays.origins, rays.directions)
        t, normals = np.full(len(hits.t), np.inf), np.zeros((len(hits.t), 3))
        oracle = Oracle(replace(self.mesh, positions=self.mesh.positions - self.origin), 0.0)
        for first in range(0, len(t), CHUNK):
            rows = first + np.flatnonzero(hits.face[first : first + CHUNK] >= 0)
            face = hits.face[rows]
            frames = frame_rays(rays.origins[rows], rays.directions[rows])
            t[rows] = oracle.judge(frames, np.arange(len(rows)), face).t
            normals[rows] = _normals(oracle.positions[oracle.faces[face]])
        return {"t": t, "normals": normals}

    def _hits(self, scene: Scene, tracer: Tracer) -> dict[str, float]:
        """Errors of what rays hit; see the head of this module."""
        away, angle, wrong, changed = [], [], 0, 0
        for kind, (rays, truth) in enumerate(zip(self.rays, self.truth, strict=True)):
            hits = tracer.closest_hit(rays.origins, rays.directions)
            there = np.isfinite(truth["t"])
            hit = hits.triangle >= 0
            both = np.flatnonzero(there & hit)
            error = np.abs(hits.t[both] - truth["t"][both]) / self.diagonal
            near = error <= JUMP
            wrong += int((there != hit).sum() + (~near).sum())
            changed += int((there != hit).sum()) if kind == 0 else 0
            away.append(error[near])
            normals = _normals(scene.positions.astype(np.float64)[scene.faces()[hits.triangle[both[near]]]])
            cosine = np.abs((normals * truth["normals"][both[near]]).sum(axis=1))
            angle.append(np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0))))
        t, turned = np.concatenate(away), np.concatenate(angle)
        count = sum(len(rays.origins) for rays in self.rays)
        return {
            "t_largest": float(t.max(initial=0.0)),
            "t_rms": _rms(t),
            "normal_largest": float(turned.max(initial=0.0)),
            "normal_rms": _rms(turned),
            "wrong_per_million": 1e6 * wrong / max(1, count),
            "silhouette_per_million": 1e6 * changed / len(self.rays[0].origins),
        }

    def _rates(self, tracer: Tracer) -> dict[str, float]:
        both = {BASELINE: self.tracer, "point": tracer}
        # On a CPU by the time of this process, which what else the machine does bears on least.
        on_cpu = self.tracer.devices[0].platform == "cpu"
        clock = time.process_time if on_cpu else time.perf_counter
        times = timed_in_turn(both, self.rays, self.options.runs, tell_no_one, clock)
        rates = [
            rate_and_ratio(len(part.origins), times["point"][:, kind], times[BASELINE][:, kind])
            for kind, part in enumerate(self.rays)
        ]
        # The study's ratio is the reference's rate over the row's.
        return {
            "primary_rate": rates[0][0],
            "primary_ratio": 1 / rates[0][1],
            "secondary_ratio": 1 / rates[1][1],
        }

    def _errors(self, scene: Scene, source: Mesh, setting: Setting) -> dict[str, Any]:
        """Position errors and the bound that is declared."""
        if setting.keep >= 1:
            largest, rms = _corner_errors(scene, source)
            found = ("corners", largest, rms, scene.error_bound, None)
        else:
            self._surface = self._surface or Surface(self.whole, self.options.threads)
            result = replace(scene.to_mesh(), attributes=(), materials=())
            there = deviation(self.whole, Surface(result, self.options.threads))
            back = deviation(result, self._surface)
            rms = max(there.rms, back.rms)
            peer = peer_distance(self.whole, result)
            found = ("surfaces", max(there.lower, back.lower), rms, max(there.upper, back.upper), peer)
        lengths = [None if one is None else one / self.diagonal for one in found[1:]]
        names = ("largest_error", "rms_error", "declared_bound", "peer_error")
        return {"error_kind": found[0], **dict(zip(names, lengths, strict=True))}


def _rays_of_views(scene: Scene, tracer: Tracer, options: StudyOptions) -> tuple[RaySet, RaySet]:
    """Primary rays of each view, and a secondary one from each of their hits."""
    each = replace(options, side=max(LEAST_SIDE, options.side // 2))
    kinds = zip(*(study_rays(scene, tracer, each, view) for view in VIEWS), strict=True)
    primary, secondary = (_together(parts) for parts in kinds)
    return primary, secondary


def _together(parts: tuple[RaySet, ...]) -> RaySet:
    origins = np.concatenate([part.origins for part in parts])
    return RaySet(origins, np.concatenate([part.directions for part in parts]))


def peer_distance(one: Mesh, other: Mesh, samples: int = 100_000) -> float | None:
    """The Hausdorff distance by pymeshlab's samples, both ways; None where pymeshlab is not installed."""
    try:
        pymeshlab: Any = import_module("pymeshlab")
    except ImportError:
        return None
    meshes = pymeshlab.MeshSet()
    for mesh in (one, other):
        meshes.add_mesh(pymeshlab.Mesh(mesh.positions.astype(np.float64), mesh.faces))
    found = [
        meshes.get_hausdorff_distance(
            sampledmesh=first,
            targetmesh=1 - first,
            samplenum=samples,
            samplevert=True,
            sampleface=True,
            maxdist=pymeshlab.PercentageValue(100),
        )["max"]
        for first in (0, 1)
    ]
    return float(max(found))


def _corner_errors(scene: Scene, source: Mesh) -> tuple[float, float]:
    """The largest and the root mean square distance of corners from the source's, in float64."""
    assert scene.remap is not None
    largest, square = 0.0, 0.0
    faces, positions = scene.faces(), scene.positions.astype(np.float64)
    if scene.origin is not None:
        positions = positions + scene.origin
    for first in range(0, len(faces), CHUNK):
        rows = slice(first, first + CHUNK)
        turned = (np.arange(3) + scene.remap.rotation[rows, None]) % 3
        theirs = np.take_along_axis(source.faces[scene.remap.face[rows]], turned, axis=1)
        away = ((positions[faces[rows]] - source.positions[theirs].astype(np.float64)) ** 2).sum(axis=2)
        largest, square = max(largest, float(away.max())), square + float(away.sum())
    return math.sqrt(largest), math.sqrt(square / (3 * len(faces)))


def _normals(corners: np.ndarray) -> np.ndarray:
    a, b, c = corners.transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0, length, 1.0)


def _rms(values: np.ndarray) -> float:
    return math.sqrt(float(np.mean(values**2))) if len(values) else 0.0
