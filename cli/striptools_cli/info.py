"""`striptools info`: what is in a scene file, and where its bytes go."""

from typing import Annotated

import numpy as np

from striptools.reducem.check_hierarchy import hierarchy_depth
from striptools.reducem.layout import VERSION
from striptools.reducem.reader import read_scene
from striptools.reducem.scene import Scene
from striptools.reducem.stored_hierarchy import name_of, over_of
from striptools_cli import log
from striptools_cli.options import SceneFile, format_option
from striptools_cli.report import Format, render
from striptools_cli.streams import Source, say


def run(
    source: SceneFile,
    form: Annotated[Format, format_option("it")] = "text",
) -> None:
    """Say what is in a scene file, and how many bytes each part takes.

    `vertices` counts those of all blocks, so that one that several blocks share counts for each of them
    (`vertex_duplication`: how often on the average), `vertices_per_triangle` the entries of the strips: n + 2
    for a strip of n triangles, `flips` the triangles that run against their strip. `bytes_per_triangle` is
    what tracing needs, so every part but the remap and attributes, before compression;
    `resident_bytes_per_triangle` what a tracer holds that traces the blocks as they are, boxes and all.
    `hierarchy` is what rays walk; of another one than reducem `depth` counts the nodes on its longest way.
    Where a scene has instances all of that is of the geometries, stored once; `placed_triangles` are those
    of all instances.
    """
    log.set_up()
    file = Source.open(source)
    say(render(describe(read_scene(file.file)), form, file.title))


def describe(scene: Scene) -> dict[str, object]:
    """The facts of a scene, by the names that other programs rely on."""
    triangles, strips, blocks = scene.triangle_count, scene.strip_count, scene.block_count
    parts = scene.part_bytes()
    different = len(np.unique(scene.leaders))
    return {
        "triangles": triangles,
        "vertices": scene.vertex_count,
        "vertex_duplication": _share(scene.vertex_count, different),
        "strips": strips,
        "flips": 0 if scene.flips is None else int(scene.flips.sum()),
        "triangles_per_strip": _share(triangles, strips),
        "strip_vertices": len(scene.vertices),
        "vertices_per_triangle": _share(len(scene.vertices), triangles),
        "blocks": blocks,
        "triangles_per_block": _share(triangles, blocks),
        **_hierarchy(scene),
        "bytes_per_triangle": scene.bytes_per_triangle(),
        **_resident(scene),
        "bytes": {**parts, "total": sum(parts.values())},
        "bytes_per_triangle_by_part": {part: _share(size, triangles) for part, size in parts.items()},
        **_carried(scene),
        "precision": _precision(scene),
        **({} if scene.triangles is not None else {"axes": _axes(scene)}),
        "format_version": f"{VERSION[0]}.{VERSION[1]}",
        "remap": scene.remap is not None,
        "source_faces": scene.source_face_count,
        "bounds": {"lowest": scene.low.tolist(), "highest": scene.high.tolist()},
        "metadata": {_printable(name): _printable(str(value)) for name, value in scene.metadata.items()},
    }


def _hierarchy(scene: Scene) -> dict[str, object]:
    """What rays walk: the default hierarchy, or what stands in its place."""
    parts, found = scene.part_bytes(), scene.hierarchy
    if found is None:
        size = parts["top_level"] + parts["in_block_hierarchy"]
        facts: dict[str, object] = {"name": "reducem", "nodes": len(scene.packed.nodes)}
        kind: dict[str, object] = {"boxes": scene.boxes}
    else:
        size, over = parts["hierarchy"], over_of(found)
        facts = {"name": name_of(found), "over": over, "objects": len(scene.objects(over)) - 1}
        facts |= {"nodes": len(found.nodes), "depth": hierarchy_depth(found)}
        kind = {}
    facts |= {"bytes": size, "bytes_per_triangle": _share(size, scene.triangle_count)}
    return {**kind, "hierarchy": facts}


def _resident(scene: Scene) -> dict[str, object]:
    """What a tracer holds that traces the blocks as they are; other hierarchies are traced expanded alone."""
    if scene.hierarchy is not None:
        return {}
    return {"resident_bytes_per_triangle": scene.resident_bytes_per_triangle()}


def _carried(scene: Scene) -> dict[str, object]:
    """What a scene has beside geometry, each only where it is there."""
    sizes = scene.attribute_bytes()
    found: dict[str, object] = {}
    if scene.columns:
        found["attributes"] = {
            one.name: {"of": one.domain, "distinct": len(one.rows), "bytes": sizes[one.name]}
            for one in scene.columns
        }
    if scene.materials:
        found["materials"] = len(scene.materials)
    if scene.instances is not None and scene.geometries is not None:
        found["instances"] = {
            "geometries": len(scene.geometries),
            "instances": len(scene.instances),
            "placed_triangles": scene.placed_count,
            "bytes": scene.part_bytes()["instances"],
            "bytes_per_placed_triangle": _share(sum(scene.part_bytes().values()), scene.placed_count),
        }
    if scene.origin is not None:
        found["origin"] = scene.origin.tolist()
    return found


def _precision(scene: Scene) -> dict[str, object]:
    exponent = scene.grid_exponent
    if exponent is None:
        kind = "welded" if scene.error_bound else "lossless"
        kind = kind if scene.origin is None else "recentred"
        return {"kind": kind, "bits": 32, "error_bound": scene.error_bound}
    longest = float((scene.high.astype(np.float64) - scene.low).max(initial=0.0))
    cells = round(longest / 2.0**exponent)
    return {
        "kind": "grid",
        "bits": cells.bit_length(),
        "cell": 2.0**exponent,
        "error_bound": scene.error_bound,
    }


def _axes(scene: Scene) -> dict[str, object]:
    """How many axes of blocks are written in which mode (SPEC.md, 4.3), and the bits of a vertex."""
    modes, widths = scene.blocks.axes()
    counts = np.bincount(modes.reshape(-1), minlength=3).tolist()
    bits = scene.blocks.totals()["position_bits"]
    return {
        "multiples": counts[0],
        "multiples_and_minus_zero": counts[1],
        "float_bits": counts[2],
        "widest": int(widths.max(initial=0)),
        "bits_per_vertex": _share(bits, scene.vertex_count),
    }


def _printable(text: str) -> str:
    """Text of strangers without anything that a terminal would obey."""
    return "".join(sign if sign.isprintable() else ascii(sign)[1:-1] for sign in text)


def _share(part: int, whole: int) -> float:
    return part / whole if whole else 0.0
