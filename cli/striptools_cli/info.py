"""`striptools info`: what is in a scene file, and where its bytes go."""

from typing import Annotated

import typer

from striptools.reducem.layout import VERSION
from striptools.reducem.reader import read_scene
from striptools.reducem.scene import Scene
from striptools_cli import log
from striptools_cli.report import Format, render
from striptools_cli.streams import Source, say


def run(
    source: Annotated[str, typer.Argument(metavar="FILE.rdm", help="Scene file; - for standard input.")],
    form: Annotated[Format, typer.Option("--format", help="How to print it.")] = "text",
) -> None:
    """Say what is in a scene file, and how many bytes each part takes.

    `vertices` counts stored positions, `vertices_per_triangle` the entries of the strips: n + 2 for
    a strip of n triangles, `flips` the triangles that run against their strip. `bytes_per_triangle` is
    what tracing needs, so every part but the remap.
    """
    log.set_up()
    file = Source.open(source)
    say(render(describe(read_scene(file.file)), form, file.title))


def describe(scene: Scene) -> dict[str, object]:
    """The facts of a scene, by the names that other programs rely on."""
    triangles = scene.triangle_count
    bounds = [[float(corner) for corner in row] for row in (scene.positions.min(0), scene.positions.max(0))]
    return {
        "triangles": triangles,
        "vertices": scene.vertex_count,
        "strips": scene.strip_count,
        "flips": 0 if scene.flips is None else int(scene.flips.sum()),
        "triangles_per_strip": triangles / scene.strip_count,
        "strip_vertices": len(scene.vertices),
        "vertices_per_triangle": len(scene.vertices) / triangles,
        "bytes_per_triangle": scene.bytes_per_triangle(),
        "bytes": {**scene.part_bytes(), "total": sum(scene.part_bytes().values())},
        "precision": {
            "kind": "lossless" if scene.error_bound == 0.0 else "welded",
            "bits": 32,
            "error_bound": scene.error_bound,
        },
        "format_version": f"{VERSION[0]}.{VERSION[1]}",
        "remap": scene.remap is not None,
        "source_faces": scene.source_face_count,
        "bounds": {"lowest": bounds[0], "highest": bounds[1]},
    }
