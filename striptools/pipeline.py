"""The data's way in one screen: load, clean, quantise, partition, order, hierarchy, output, scene.

Source: the four steps of Strip-RT (Lauterbach, Yoon, Tang, Manocha, EGSR 2008, section 4) between a loader
that hides nothing and a scene that can be traced as it lies.
"""

from pathlib import Path
from typing import IO

from striptools import __version__, stages
from striptools.mesh.mesh import Mesh
from striptools.mesh.simplify import simplify
from striptools.options import Options, Report
from striptools.reducem.reader import open_scene
from striptools.reducem.scene import Scene
from striptools.stopwatch import Stopwatch, Watch
from striptools.threads import every_core


def convert(
    source: Mesh | str | Path | IO[bytes], options: Options | None = None, *, watch: Watch | None = None
) -> Scene:
    """Turn a mesh into a ReduceM scene.

    Args:
        source: A `Mesh`, or a mesh file that `load_mesh` reads.
        options: What to ask of each stage; None for the defaults.
        watch: Called with a stage's name and the fraction done, as each stage starts and ends.

    Returns:
        The scene; save it with `scene.save(path)`.

    Raises:
        UnreadableMeshError: The file is no mesh, or cleaning leaves no face.
        UsageError: An option is out of its range.
        LimitError: The mesh is larger than a scene can hold.
    """
    return convert_with_report(source, options, watch=watch)[0]


def convert_with_report(
    source: Mesh | str | Path | IO[bytes],
    options: Options | None = None,
    *,
    file_format: str | None = None,
    watch: Watch | None = None,
) -> tuple[Scene, Report]:
    """Turn a mesh into a ReduceM scene, and say what was done; see `convert`.

    Args:
        source: A `Mesh`, or a mesh file that `load_mesh` reads.
        options: What to ask of each stage; None for the defaults.
        file_format: The format of a file whose name does not tell.
        watch: Called with a stage's name and the fraction done, as each stage starts and ends.

    Returns:
        The scene and the report.

    Raises:
        UnreadableMeshError: The file is no mesh, or cleaning leaves no face.
        UsageError: An option is out of its range.
        LimitError: The mesh is larger than a scene can hold.
    """
    options = options or Options()
    threads = options.threads or every_core()
    clock = Stopwatch(watch)
    with clock.stage("load"):
        mesh, simplified = stages.load(source, file_format, options), None
    if options.simplify.asked:
        with clock.stage("simplify"):
            simplified = simplify(mesh, options.simplify, threads=threads)
            mesh = simplified.mesh
    with clock.stage("clean"):
        cleaned = stages.clean_mesh(mesh, options, threads)
    with clock.stage("quantise"):
        placed = stages.place(mesh, cleaned, options, threads)
        told = stages.told_of(source, mesh, simplified, __version__)
        del mesh, source, cleaned
    with clock.stage("partition"):
        parts, trees = stages.partition(placed.cleaned.mesh, options, threads)
    with clock.stage("order"):
        ordered = stages.order(parts, trees, options, threads, watch)
        del trees
    with clock.stage("hierarchy"):
        joined = stages.build_hierarchy(placed.cleaned.mesh, parts, ordered, threads)
        del parts, ordered
    with clock.stage("output"):
        scene = stages.write_scene(placed, joined, told, options, threads)
    if options.hierarchy.name != "reducem":
        with clock.stage("hierarchy"):
            scene = scene.under(options.hierarchy, threads)
    return scene, stages.report_of(scene, placed, joined, told, simplified, clock)


def open(source: str | Path | IO[bytes]) -> Scene:
    """Open a ReduceM scene file: map it, and look at its header and section table.

    What else the file holds is read and checked when it is first asked for; `scene.check()` checks all of it.

    Args:
        source: The path of a `.rdm` file, which must not be changed in place while the scene is used, or a
            binary stream of one, which is read whole.

    Returns:
        The scene; its fields and methods raise UnreadableSceneError where the file breaks a rule.

    Raises:
        UnreadableSceneError: The file is missing, damaged, or no scene file of a version that is read here.
    """
    return open_scene(source)
