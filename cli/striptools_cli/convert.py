"""`striptools convert`: a mesh into a scene, or a scene back into a mesh."""

import dataclasses
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Annotated, cast, get_args

import typer

from striptools.choose import TARGETS, Wish, convert_to_wish
from striptools.errors import UnreadableMeshError, UsageError
from striptools.hierarchies.options import (
    MOST_LEVELS,
    BalanceName,
    HierarchyName,
    HierarchyOptions,
    MetricName,
    OverName,
)
from striptools.mesh.clean import RECENTRINGS, CleanOptions, Recentring, clean
from striptools.mesh.io import WRITE_FORMATS, load_mesh, save_mesh, unkept
from striptools.mesh.mesh import Mesh
from striptools.options import Options, Report
from striptools.partition.sah import SMALLEST_BLOCK
from striptools.pipeline import convert_with_report
from striptools.reducem.quantize import LEAST_BITS, MOST_BITS, PrecisionOptions
from striptools.reducem.reader import read_scene
from striptools.reducem.scene import BoxesKind, Scene
from striptools.stopwatch import Stopwatch
from striptools.strips.export import STRIP_FORMATS, export_strips
from striptools.strips.ordering import (
    EFFORT_NAMES,
    LARGEST_STRIP_BLOCK,
    METHODS,
    EffortName,
    Method,
    OrderingOptions,
)
from striptools_cli import log, notice
from striptools_cli.hierarchy import asked_for
from striptools_cli.options import Threads, from_option, quiet_option
from striptools_cli.progress import StageProgress
from striptools_cli.report import human_bytes, human_value, render
from striptools_cli.streams import (
    SCENE_FORMAT,
    STANDARD,
    Source,
    Target,
    input_format,
    output_format,
    refuse_same,
    say,
)
from striptools_cli.wishes import length, said_of, simplify_options, wish_for

_CLEAN = CleanOptions()
_ORDER = OrderingOptions()
_OPTIONS = Options()
_HIERARCHY = HierarchyOptions()

_SAID_OF_COUNTS = {
    "non_finite": "dropped {} with a non-finite vertex|face|faces",
    "repeated_vertex": "dropped {} with a repeated vertex|face|faces",
    "zero_area": "dropped {} of zero area|face|faces",
    "duplicate_faces_dropped": "dropped {}|duplicate face|duplicate faces",
    "duplicate_faces_kept": "kept {} (--drop-duplicates drops them)|duplicate face|duplicate faces",
    "vertices_welded": "welded {}|vertex|vertices",
    "vertices_unreferenced": "left out {} that no face uses|vertex|vertices",
    "vertices_with_seams": "kept several values at {}|vertex|vertices",
}

_SAID_OF_GRIDS = {
    "quantised_vertices_welded": "welded {} that met|vertex|vertices",
    "quantised_repeated_vertex": "dropped {} with a repeated vertex|face|faces",
    "quantised_zero_area": "dropped {} of zero area|face|faces",
    "quantised_flipped": "turned over {}, kept|face|faces",
}


def run(
    source: Annotated[str, typer.Argument(metavar="IN", help="Mesh or scene; - for standard input.")],
    target: Annotated[str, typer.Argument(metavar="OUT", help="Scene or mesh; - for standard output.")],
    force: Annotated[bool, typer.Option("--force", help="Replace OUT where it exists.")] = False,
    report: Annotated[
        str | None,
        typer.Option(metavar="FILE.json", help="Write seconds by stage, peak memory, counts; - prints them."),
    ] = None,
    no_remap: Annotated[
        bool, typer.Option("--no-remap", help="Leave out which source face each triangle was.")
    ] = False,
    weld: Annotated[
        float,
        typer.Option(min=0.0, metavar="DIST", help="Merge vertices up to this far apart; 0: equal ones."),
    ] = _CLEAN.weld,
    geometry_only: Annotated[
        bool,
        typer.Option(
            "--geometry-only", help="Leave out normals, texture coordinates, colours, groups, materials."
        ),
    ] = _OPTIONS.geometry_only,
    recentre: Annotated[
        str,
        typer.Option(
            metavar="WHEN",
            help="Give float64 positions an origin of their own where float32 keeps them far better by it: "
            f"{', '.join(RECENTRINGS)}.",
        ),
    ] = _CLEAN.recentre,
    drop_duplicates: Annotated[
        bool, typer.Option("--drop-duplicates", help="Keep one of several faces with the same corners.")
    ] = _CLEAN.drop_duplicates,
    bits: Annotated[
        int | None,
        typer.Option(
            min=LEAST_BITS,
            max=MOST_BITS,
            metavar="B",
            help="Move vertices to a grid of 2^B cells along the longest side.",
            show_default="keep every bit",
        ),
    ] = None,
    max_error: Annotated[
        str | None,
        typer.Option(
            metavar="D",
            help="The coarsest grid that moves no vertex by more than D, or Drel diagonals, like 1e-4rel.",
            show_default="keep every bit",
        ),
    ] = None,
    budget: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE",
            help="The most that a tracer may keep, like 100MB: the finest precision that fits, no coarser "
            "than --max-error.",
            show_default="no limit",
        ),
    ] = None,
    wanted: Annotated[
        str | None,
        typer.Option(
            "--target",
            metavar="NAME",
            help=f"Choose options by what matters most: {', '.join(TARGETS)}; says which and why.",
            show_default="none",
        ),
    ] = None,
    table: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="The points.json of a trade to choose --target from.",
            show_default="the package's",
        ),
    ] = None,
    simplify: Annotated[
        str | None,
        typer.Option(
            metavar="SHARE",
            help="Keep this share of the triangles, like 25% or 0.25; needs the extra simplify.",
            show_default="all",
        ),
    ] = None,
    simplify_error: Annotated[
        str | None,
        typer.Option(
            metavar="D",
            help="As few triangles as keep both surfaces within D of each other, or Drel diagonals; with "
            "--simplify, refuse what strays farther.",
            show_default="any",
        ),
    ] = None,
    hierarchy: Annotated[
        str,
        typer.Option(metavar="NAME", help=f"What rays are to walk: {', '.join(get_args(HierarchyName))}."),
    ] = _HIERARCHY.name,
    over: Annotated[
        str | None,
        typer.Option(
            metavar="KIND",
            help=f"What its leaves hold: {', '.join(get_args(OverName))}; blocks not for kdtree "
            "(slbvh, kdtree, loose-octree).",
            show_default="triangles",
        ),
    ] = None,
    levels: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=MOST_LEVELS,
            metavar="N",
            help="Plain SAH levels above presorted trees (presorted).",
            show_default=str(_HIERARCHY.levels),
        ),
    ] = None,
    balance: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"How its halves are found: {', '.join(get_args(BalanceName))} (slbvh).",
            show_default=_HIERARCHY.balance,
        ),
    ] = None,
    metric: Annotated[
        str | None,
        typer.Option(
            metavar="NAME",
            help=f"Its surface area metric: {', '.join(get_args(MetricName))}, with mail-boxes (kdtree).",
            show_default=_HIERARCHY.metric,
        ),
    ] = None,
    boxes: Annotated[
        BoxesKind,
        typer.Option(help="Rebuild the boxes inside blocks when a scene is traced, or store them."),
    ] = _OPTIONS.boxes,
    archive: Annotated[
        bool, typer.Option("--archive", help="Compress the scene for transport; needs the extra archive.")
    ] = False,
    max_length: Annotated[
        int, typer.Option(min=1, metavar="N", help="Most triangles in a strip.")
    ] = _ORDER.max_length,
    stripifier: Annotated[
        str, typer.Option(metavar="NAME", help=f"How strips are made: {', '.join(METHODS)}.")
    ] = _ORDER.method,
    effort: Annotated[
        str,
        typer.Option(metavar="NAME", help=f"How long strip-rt searches: {', '.join(EFFORT_NAMES)}."),
    ] = _ORDER.effort,
    block: Annotated[
        int,
        typer.Option(
            min=0,
            max=LARGEST_STRIP_BLOCK,
            metavar="N",
            help=f"Most triangles and most vertices of a block, {SMALLEST_BLOCK} or more; 0 orders strips in "
            "chunks, and puts them into blocks of the largest size afterwards (strip-rt).",
        ),
    ] = LARGEST_STRIP_BLOCK,
    flips: Annotated[
        bool,
        typer.Option(
            "--flips/--no-flips",
            help="Let strips cross edges that both faces run the same way, where it pays (strip-rt).",
        ),
    ] = _ORDER.flips,
    distance_weight: Annotated[
        float, typer.Option(min=0.0, metavar="W", help="Weight of nearness when strips join (paper).")
    ] = _ORDER.distance_weight,
    balance_weight: Annotated[
        float, typer.Option(min=0.0, metavar="W", help="Weight of equal lengths when strips join (paper).")
    ] = _ORDER.balance_weight,
    strips: Annotated[
        bool,
        typer.Option(
            "--strips", help="Write classic strips: GLB of triangle strips, else faces in their order."
        ),
    ] = False,
    threads: Threads = None,
    from_format: Annotated[str | None, from_option("IN")] = None,
    to_format: Annotated[
        str | None,
        typer.Option("--to", metavar="FORMAT", help="Format of OUT.", show_default="extension"),
    ] = None,
    instances: Annotated[
        bool,
        typer.Option(
            "--instances/--no-instances",
            help="Store a mesh that a glTF scene has in several places once, or flatten the scene.",
        ),
    ] = _OPTIONS.instances,
    quiet: Annotated[bool, quiet_option()] = False,
    verbose: Annotated[
        bool, typer.Option("-v", "--verbose", help="Add seconds by stage, bytes by part.")
    ] = False,
) -> None:
    """Turn a mesh into a scene file (.rdm), a scene file back into a mesh, or either into classic strips.

    The direction follows from the formats of IN and OUT. Whatever cleaning drops or changes is counted and
    said. Back from a scene, every face that cleaning kept comes out with its winding, in the source's order
    and from the source's first corner unless the scene was made with --no-remap. With --strips a mesh or a
    scene becomes a mesh for rasterisers; --effort, --weld, --drop-duplicates and --threads apply.
    """
    log.set_up(quiet=quiet, verbose=verbose)
    options = Options(
        clean=CleanOptions(weld, drop_duplicates, cast(Recentring, recentre)),
        geometry_only=geometry_only,
        instances=instances,
        ordering=OrderingOptions(
            max_length,
            cast(Method, stripifier),
            cast(EffortName, effort),
            distance_weight,
            balance_weight,
            block or None,
            flips,
        ),
        simplify=simplify_options(simplify, simplify_error),
        precision=_precision(bits, max_error),
        hierarchy=asked_for(hierarchy, over, levels, balance, metric),
        boxes=boxes,
        remap=not no_remap,
        threads=threads,
    )
    wish = wish_for(budget, wanted, table, options)
    write_format = output_format(target, to_format, (SCENE_FORMAT, *WRITE_FORMATS))
    _check_names(source, target, report)
    out = Target.open(target, force=force)
    file = Source.open(source)
    read_format = input_format(file, from_format)
    if archive and (strips or write_format != SCENE_FORMAT):
        raise UsageError("--archive compresses a scene, but OUT is none", remedy="leave it out")
    if wish is not None and (strips or write_format != SCENE_FORMAT):
        raise UsageError("--budget and --target are for scenes, but OUT is none", remedy="leave them out")
    if strips:
        _check_strips(read_format, write_format, options)
        job = _to_strips
    else:
        _check_direction(read_format, write_format, options)
        job = _to_mesh if read_format == SCENE_FORMAT else partial(_to_scene, archive=archive, wish=wish)
    outcome = job(file, out, options, (read_format, write_format), quiet)
    if report:
        Target.open(report, force=True).write(lambda file: _write_text(file, render(outcome.facts, "json")))
    if not quiet:
        lines = [*outcome.lines, *(outcome.details if verbose else ())]
        say("".join(f"{line}\n" for line in lines), error=STANDARD in (target, report))


@dataclass(frozen=True)
class _Outcome:
    lines: list[str]
    details: list[str]
    facts: dict[str, object]


def _check_direction(read_format: str, write_format: str, options: Options) -> None:
    from_scene, to_scene = read_format == SCENE_FORMAT, write_format == SCENE_FORMAT
    if from_scene == to_scene:
        raise UsageError(
            "IN and OUT are both scenes" if from_scene else "neither IN nor OUT is a scene",
            remedy=f"one of them must be .{SCENE_FORMAT}, by its name or by --from or --to"
            + ("" if from_scene else "; --strips turns a mesh into a mesh of strips"),
        )
    if from_scene and dataclasses.replace(options, threads=None) != Options():
        raise UsageError("an option that shapes a scene, but IN is a scene already", remedy="leave it out")


def _check_strips(read_format: str, write_format: str, options: Options) -> None:
    if write_format == SCENE_FORMAT:
        raise UsageError(
            "--strips writes a mesh, but OUT is a scene, which has strips of its own",
            remedy=f"leave it out, or name one of {', '.join(STRIP_FORMATS)}",
        )
    used = Options(
        clean=options.clean, ordering=OrderingOptions(effort=options.ordering.effort), threads=options.threads
    )
    if options != used:
        raise UsageError("an option that shapes a scene, but --strips writes a mesh", remedy="leave it out")
    if read_format == SCENE_FORMAT and options.clean != _CLEAN:
        raise UsageError("an option of cleaning, but IN is a scene, clean already", remedy="leave it out")


def _check_names(source: str, target: str, report: str | None) -> None:
    refuse_same(source, target)
    if report:
        refuse_same(source, report)
        refuse_same(target, report)
        if report == target == STANDARD:
            raise UsageError("--report and OUT cannot both be standard output", remedy="name a file for one")


def _precision(bits: int | None, max_error: str | None) -> PrecisionOptions:
    if max_error is None:
        return PrecisionOptions(bits)
    return PrecisionOptions(bits, *length(max_error, "--max-error"))


def _to_scene(
    source: Source,
    target: Target,
    options: Options,
    formats: tuple[str, str],
    quiet: bool,
    *,
    archive: bool,
    wish: Wish | None,
) -> _Outcome:
    notice.before_kernels("strip_chunks", quiet=quiet)
    clock = Stopwatch()
    with StageProgress(quiet=quiet) as progress:
        given = {"file_format": formats[0] or None, "watch": progress.watch}
        choice = None
        if wish is None:
            scene, report = convert_with_report(source.file, options, **given)
        else:
            scene, report, choice = convert_to_wish(source.file, options, wish, **given)
        progress.watch("write", 0.0)
        with clock.stage("write"):
            target.write(partial(scene.save, archive=archive))
    written, peak = clock.read()
    total = report.seconds["total"] + written["write"]
    seconds = _ordered({**report.seconds, "write": written["write"], "total": total})
    lines = [f"{_arrow(source, target)}, {_density(scene)}", *_changes(report)]
    if choice is not None:
        lines.append(f"  chosen: {choice.why}")
    facts: dict[str, object] = {
        "chosen": None if choice is None else choice.to_dict(),
        "simplified": None if report.simplified is None else report.simplified.to_dict(),
        "seconds": seconds,
        "peak_bytes": max(peak, report.peak_bytes),
        "counts": {**report.counts, "triangles": scene.triangle_count, "vertices": scene.vertex_count},
        "largest_rounding": report.largest_rounding,
        "weld_error": report.weld_error,
        "error_bound": scene.error_bound,
        "largest_error": report.largest_error,
        "origin": None if report.origin is None else report.origin.tolist(),
        "notes": list(report.notes),
    }
    return _Outcome(lines, list(_details(seconds, scene)), facts)


def _to_mesh(
    source: Source, target: Target, _options: Options, formats: tuple[str, str], quiet: bool
) -> _Outcome:
    with StageProgress(quiet=quiet) as progress:
        clock = Stopwatch(progress.watch)
        with clock.stage("load"):
            scene = read_scene(source.file)
        with clock.stage("decode"):
            stored = scene.to_mesh()
            mesh = stored if formats[1] == "glb" else stored.flattened()
        with clock.stage("write"):
            target.write(lambda file: save_mesh(mesh, file, file_format=formats[1]))
    seconds, peak = clock.read()
    order = "in the source's order" if scene.remap else "in file order, for the scene has no remap"
    line = f"{_arrow(source, target)}, {mesh.triangle_count:,} triangles {order}"
    counts = {"triangles": mesh.triangle_count, "vertices": mesh.vertex_count, "strips": scene.strip_count}
    left_out = unkept(stored, formats[1])
    facts = {"seconds": seconds, "peak_bytes": peak, "counts": counts, "left_out": list(left_out)}
    lines = [line, *([f"  left out: {', '.join(left_out)}"] if left_out else [])]
    return _Outcome(lines, list(_details(seconds, scene)), facts)


def _to_strips(
    source: Source, target: Target, options: Options, formats: tuple[str, str], quiet: bool
) -> _Outcome:
    notice.before_kernels("alternating_search", quiet=quiet)
    threads = options.threads or len(os.sched_getaffinity(0))
    with StageProgress(quiet=quiet) as progress:
        clock = Stopwatch(progress.watch)
        with clock.stage("load"):
            mesh, changes, counts = _loaded_clean(source, options, formats[0])
        with clock.stage("order"):
            export = export_strips(mesh, formats[1], options.ordering.effort, threads)
        with clock.stage("write"):
            target.write(export.save)
    seconds, peak = clock.read()
    count, strips = export.count, len(export.strips.starts) - 1
    between = (
        "stitched by repeated vertices" if formats[1] == "glb" else f"{count.restarts:,} restarts counted"
    )
    line = (
        f"{_arrow(source, target)}, {mesh.triangle_count:,} triangles in {strips:,} strips, "
        f"{export.indices_per_triangle:.3f} indices per triangle, {between}"
    )
    facts = {
        "seconds": seconds,
        "peak_bytes": peak,
        "counts": {
            **counts,
            "triangles": mesh.triangle_count,
            "vertices": mesh.vertex_count,
            "strips": strips,
        }
        | dataclasses.asdict(count),
        "indices_per_triangle": export.indices_per_triangle,
    }
    return _Outcome([line, *changes], list(_stages(seconds)), facts)


def _loaded_clean(
    source: Source, options: Options, read_format: str
) -> tuple[Mesh, list[str], dict[str, int]]:
    """A mesh fit for strips, what loading and cleaning have to say, and cleaning's counts."""
    if read_format == SCENE_FORMAT:
        mesh = read_scene(source.file).flattened().geometry()
        return mesh, [f"  {note}" for note in mesh.notes], {}
    mesh = load_mesh(source.file, file_format=read_format or None).geometry()
    # A mesh has no place for an origin.
    cleaned = clean(mesh, dataclasses.replace(options.clean, recentre="never"), options.threads or 1)
    if cleaned.mesh.triangle_count == 0:
        raise UnreadableMeshError("no face is left after cleaning", where=source.title)
    report = Report(
        {}, 0, cleaned.counts, cleaned.largest_rounding, cleaned.weld_error, None, None, mesh.notes
    )
    return cleaned.mesh, list(_changes(report)), cleaned.counts


def _arrow(source: Source, target: Target) -> str:
    return f"{source.title} ({human_bytes(source.size)}) -> {target.title} ({human_bytes(target.size)})"


def _density(scene: Scene) -> str:
    placed = (
        "" if scene.instances is None else f", {scene.placed_count:,} in {len(scene.instances):,} instances"
    )
    return (
        f"{scene.triangle_count:,} triangles{placed}, "
        f"{len(scene.vertices) / scene.triangle_count:.2f} vertices per triangle, "
        f"{scene.bytes_per_triangle():.1f} bytes per triangle"
    )


def _changes(report: Report) -> Iterator[str]:
    for note in report.notes:
        yield f"  loaded: {note}"
    if report.simplified is not None:
        yield said_of(report.simplified)
    yield from _said(report, "cleaned", _SAID_OF_COUNTS)
    if report.origin is not None:
        origin = ", ".join(f"{value:.12g}" for value in report.origin.tolist())
        yield f"  cleaned: moved to an origin at ({origin}), in whose frame rays are traced"
    if report.largest_rounding > 0.0:
        yield f"  cleaned: rounded to float32, by at most {human_value(report.largest_rounding)}"
    if report.weld_error > 0.0:
        yield f"  cleaned: welding moved vertices, by at most {human_value(report.weld_error)}"
    if report.grid_exponent is not None and report.largest_error is not None:
        cell, most = human_value(2.0**report.grid_exponent), human_value(report.largest_error)
        yield f"  quantised: to a grid of {cell}, vertices moved by at most {most}"
        yield from _said(report, "quantised", _SAID_OF_GRIDS)


def _said(report: Report, stage: str, patterns: dict[str, str]) -> Iterator[str]:
    for key, pattern in patterns.items():
        count = report.counts.get(key, 0)
        if count:
            sentence, one, many = pattern.split("|")
            yield f"  {stage}: {sentence.format(f'{count:,} {one if count == 1 else many}')}"


def _details(seconds: dict[str, float], scene: Scene) -> Iterator[str]:
    yield from _stages(seconds)
    for part, size in scene.part_bytes().items():
        share = size / scene.triangle_count
        yield f"  {part.replace('_', ' '):<20}{size:12,} bytes  {share:8.3f} per triangle"


def _stages(seconds: dict[str, float]) -> Iterator[str]:
    for stage, duration in seconds.items():
        yield f"  {stage:<20}{duration:12.3f} s"


def _ordered(seconds: dict[str, float]) -> dict[str, float]:
    return {**{stage: time for stage, time in seconds.items() if stage != "total"}, "total": seconds["total"]}


def _write_text(file: Path | IO[bytes], text: str) -> None:
    if isinstance(file, Path):
        file.write_text(text, encoding="utf-8")
    else:
        file.write(text.encode())
