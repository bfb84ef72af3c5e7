"""`striptools verify`: trace a scene file and prove it against its source mesh."""

from typing import Annotated

import typer

from striptools.errors import EXIT_DONE, EXIT_ISSUES, UsageError
from striptools.measure.judgement import SetResult
from striptools.measure.strays import Strays
from striptools.measure.verify import VerifyOptions, VerifyReport, verify
from striptools.mesh.io import load_mesh
from striptools.reducem.reader import read_scene
from striptools.trace import Tracer
from striptools.types import TriangleTest
from striptools_cli import log, notice
from striptools_cli.options import SceneFile, format_option, from_option, quiet_option
from striptools_cli.options_trace import Device, TraceThreads
from striptools_cli.progress import StageProgress
from striptools_cli.report import Format, human_value, render
from striptools_cli.streams import Source, input_format, say

_DEFAULTS = VerifyOptions()


def run(
    scene: SceneFile,
    against: Annotated[
        str, typer.Option(metavar="MESH", help="The mesh it was made from; - for standard input.")
    ],
    rays: Annotated[
        int, typer.Option(min=0, metavar="N", help="Rays of each kind to try against every face.")
    ] = _DEFAULTS.rays,
    aimed_rays: Annotated[
        int, typer.Option(min=0, metavar="N", help="Rays to aim exactly at edges and vertices.")
    ] = _DEFAULTS.aimed_rays,
    pair_budget: Annotated[
        int,
        typer.Option(min=1, metavar="N", help="Most pairs of a ray and a face; caps --rays on large models."),
    ] = _DEFAULTS.pair_budget,
    seed: Annotated[int, typer.Option(min=0, metavar="N", help="Seed of the random rays.")] = _DEFAULTS.seed,
    device: Device = "auto",
    threads: TraceThreads = None,
    test: Annotated[
        TriangleTest, typer.Option(help="How triangles are tested, each within its own bound; fast leaks.")
    ] = "watertight",
    from_format: Annotated[str | None, from_option("MESH")] = None,
    form: Annotated[Format, format_option("the report")] = "text",
    quiet: Annotated[bool, quiet_option()] = False,
) -> None:
    """Trace a scene file with JAX and prove it against the mesh it was made from.

    The faces are compared one by one. Camera rays, secondary rays and rays aimed exactly at edges and
    vertices are traced and judged by a float64 oracle over the source. A simplified scene is judged by its
    own triangles, and must stray no farther from the mesh, both ways, than it declares. Anything wrong ends
    in exit code 1. With --test fast rays do leak: the report counts them.
    """
    log.set_up(quiet=quiet)
    options = VerifyOptions(rays=rays, aimed_rays=aimed_rays, pair_budget=pair_budget, seed=seed)
    if scene == against:
        raise UsageError(
            "the scene and the mesh are one file", where=scene, remedy="name the mesh after --against"
        )
    scene_file, mesh_file = Source.open(scene), Source.open(against)
    with StageProgress(quiet=quiet) as progress:
        progress.watch("load", 0.0)
        loaded = read_scene(scene_file.file)
        kind = input_format(mesh_file, from_format) or None
        source = load_mesh(mesh_file.file, file_format=kind, instances=loaded.instances is not None)
        notice.before_tracing(quiet=quiet)
        tracer = Tracer(loaded, device=device, threads=threads, instances="flattened", test=test)
        report = verify(loaded, source, options, tracer=tracer, watch=progress.watch, test=test)
    if not quiet:
        facts = in_lines(report) if form == "text" else describe(report)
        say(render(facts, form, f"{scene_file.title} against {mesh_file.title}: {summary(report)}"))
    raise typer.Exit(EXIT_DONE if report.ok else EXIT_ISSUES)


def summary(report: VerifyReport) -> str:
    """The verdict in one line."""
    faults = f"{report.disagreements:,} disagreements, {report.leaks:,} leaks"
    faces = f", {report.structure.errors:,} wrong faces" if report.structure.errors else ""
    if report.strays is not None:
        faces += ", no farther than declared" if report.strays.ok else ", FARTHER than declared"
    verdict = "proved" if report.ok else "NOT proved"
    return f"{verdict}, {human_value(report.rays)} rays, {faults}{faces}"


def describe(report: VerifyReport) -> dict[str, object]:
    """The whole report as a record, with a group for each kind of rays."""
    facts = report.to_dict()
    facts["sets"] = {part.pop("name"): part for part in facts["sets"]}
    return facts


def in_lines(report: VerifyReport) -> dict[str, object]:
    """What a person wants to know of the report: a line for each kind of rays, then the flaws."""
    facts: dict[str, object] = {part.name: _line(part) for part in report.sets}
    structure = report.structure
    facts["faces"] = (
        f"{structure.present:,} of {structure.expected:,} expected; {structure.missing:,} missing, "
        f"{structure.unexpected:,} unexpected, {structure.wrong:,} wrong, {structure.excused:,} excused"
    )
    if report.strays is not None:
        facts["simplified"] = _strays(report.strays)
    facts["surface"] = (
        "closed" if report.closed else f"open, nothing is certain at {report.open_edges:,} edges"
    )
    facts["largest t error"] = f"{report.max_t_error:.4g}, {report.max_t_ratio:.2f} of its bound"
    if report.rays_tried < report.rays_wanted:
        facts["sampled"] = (
            f"{report.rays_tried:,} of {report.rays_wanted:,} rays of each kind were tried against every "
            "face, for the model is large (--pair-budget)"
        )
    return {**facts, **{f"flaw {number}": flaw for number, flaw in enumerate(report.flaws, 1)}}


def _strays(strays: Strays) -> str:
    there, back, allowed, allowed_back = (
        human_value(value)
        for value in (
            strays.of_source,
            strays.of_result,
            strays.allowed_of_source,
            strays.allowed_of_result,
        )
    )
    return (
        f"the source strays at most {there} from the scene, declared {allowed}; the scene at most {back} "
        f"from the source, declared {allowed_back}; rays are judged by the scene's own triangles"
    )


def _line(part: SetResult) -> str:
    return (
        f"{part.rays:>9,} rays, {part.hits:>9,} hit, {part.uncertain:>7,} uncertain, "
        f"{part.disagreements:,} disagreements, {part.leaks:,} leaks"
    )
