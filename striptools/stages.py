"""The stages of a conversion, made of what the folders have for each; `pipeline` puts them in order."""

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import IO, Any, NamedTuple

import numpy as np

from striptools.errors import UnreadableMeshError
from striptools.hierarchies.packed import BoxGrid, NodeWords, Roots, box_grid, build_top
from striptools.mesh.clean import Cleaned, clean
from striptools.mesh.instances import Geometries
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.mesh.simplify import Simplified
from striptools.options import Options, Report
from striptools.partition.boxes import face_boxes, range_boxes
from striptools.partition.object_split import ObjectTree, split_objects
from striptools.reducem.attributes import fitting
from striptools.reducem.joining import Built, join_geometries, stored_instances, why_not_kept
from striptools.reducem.quantize import check_bound, quantise, recentred_bound
from striptools.reducem.scene import Scene, bounds_of, scene_from_strips
from striptools.stopwatch import Stopwatch, Watch
from striptools.strips.grouping import reorder_blocks, stripify_in_blocks
from striptools.strips.ordering import Sequences
from striptools.strips.topology import encode_strips, split_fans
from striptools.types import Boxes, Counts


class Told(NamedTuple):
    """What is known of a source once it is read.

    Attributes:
        notes: What loading had to say.
        face_count: Faces in the source.
        geometries: Of the source, if it has several.
        metadata: What the scene file is to say of it.
    """

    notes: tuple[str, ...]
    face_count: int
    geometries: Geometries | None
    metadata: dict[str, Any]


class Placed(NamedTuple):
    """A mesh whose positions are final.

    Attributes:
        cleaned: The mesh.
        exponent: Of the grid that its positions are on; None where every bit is kept.
        bound: What the scene declares.
        largest_error: The largest distance of a vertex from the loaded one where there is a grid, else None.
    """

    cleaned: Cleaned
    exponent: int | None
    bound: float
    largest_error: float | None


class Part(NamedTuple):
    """A geometry on its way: its mesh and the box of each face."""

    mesh: Mesh
    boxes: Boxes


class Joined(NamedTuple):
    """Of all geometries: strips over the faces of all, blocks, the nodes over them, and whose they are."""

    sequences: Sequences
    starts: Counts
    top: NodeWords
    roots: Roots


def load(source: Mesh | str | Path | IO[bytes], file_format: str | None, options: Options) -> Mesh:
    """The mesh, with instances where they are asked for and can be kept."""
    keep = options.instances and not options.simplify.asked
    mesh = source if isinstance(source, Mesh) else load_mesh(source, file_format=file_format, instances=keep)
    mesh = mesh.geometry() if options.geometry_only else fitting(mesh)
    if keep and mesh.instances is not None:
        reason = why_not_kept(mesh, options.hierarchy.name)
        if reason is None:
            return mesh
        mesh = replace(mesh, notes=(*mesh.notes, f"instances flattened, for {reason}"))
    return mesh.flattened()


def told_of(
    source: Mesh | str | Path | IO[bytes], mesh: Mesh, simplified: Simplified | None, version: str
) -> Told:
    """What is known of a source, of what simplifying made of it, and of what turns it into a scene."""
    metadata: dict[str, Any] = {"generator": f"striptools {version}"}
    if isinstance(source, str | Path):
        metadata["source"] = Path(source).name
    if mesh.unit:
        metadata["unit"] = mesh.unit
    if simplified is not None:
        metadata["simplified"] = simplified.to_dict()
    return Told(mesh.notes, mesh.triangle_count, mesh.geometries, metadata)


def clean_mesh(mesh: Mesh, options: Options, threads: int) -> Cleaned:
    """Clean a mesh; refuse one of which nothing is left."""
    cleaned = clean(mesh, options.clean, threads)
    _refuse_nothing(cleaned)
    return cleaned


def place(mesh: Mesh, cleaned: Cleaned, options: Options, threads: int) -> Placed:
    """Put a mesh on its grid, where one is asked for."""
    if options.precision.is_lossless:
        bound = cleaned.weld_error if cleaned.origin is None else recentred_bound(cleaned)
        return Placed(cleaned, None, bound, None)
    drop = options.clean.drop_duplicates
    moved = quantise(cleaned, options.precision, drop_duplicates=drop, threads=threads)
    _refuse_nothing(moved.cleaned, "quantised_")
    given = (moved.cleaned.mesh, moved.cleaned.source_face, moved.error_bound, moved.cleaned.origin)
    return Placed(moved.cleaned, moved.grid_exponent, moved.error_bound, check_bound(mesh, *given))


def _refuse_nothing(cleaned: Cleaned, prefix: str = "") -> None:
    if cleaned.mesh.triangle_count == 0:
        reasons = ("non_finite", "repeated_vertex", "zero_area")
        counts = {reason: cleaned.counts.get(prefix + reason, 0) for reason in reasons}
        dropped = ", ".join(
            f"{count} {reason.replace('_', ' ')}" for reason, count in counts.items() if count
        )
        raise UnreadableMeshError(
            f"no face is left after {'quantising' if prefix else 'cleaning'}: {dropped or 'there was none'}",
            remedy="give more bits" if prefix else "a scene needs a triangle with an area",
        )


def partition(mesh: Mesh, options: Options, threads: int) -> tuple[list[Part], list[ObjectTree]]:
    """The geometries that have faces, and an SAH object split of each."""
    there = (part for part in mesh.parts() if part.triangle_count)
    parts = [Part(part, face_boxes(part.positions, part.faces, threads)) for part in there]
    block = options.ordering.block if options.ordering.method == "strip-rt" else None
    asked = replace(options.partition, block=block or options.partition.block)
    return parts, [split_objects(part.boxes, asked, threads=threads) for part in parts]


def order(
    parts: list[Part], trees: list[ObjectTree], options: Options, threads: int, watch: Watch | None
) -> list[tuple[Sequences, Counts]]:
    """The strips of each geometry, and where its blocks start."""
    told = [None if watch is None else partial(_tell, watch, k, len(parts)) for k in range(len(parts))]
    return [
        stripify_in_blocks(
            part.mesh.faces,
            part.mesh.vertex_count,
            *(part.boxes, tree, options.ordering, options.partition, threads, tell),
        )
        for part, tree, tell in zip(parts, trees, told, strict=True)
    ]


def _tell(watch: Watch, part: int, parts: int, fraction: float) -> None:
    watch("order", (part + fraction) / parts)


def build_hierarchy(
    mesh: Mesh, parts: list[Part], ordered: list[tuple[Sequences, Counts]], threads: int
) -> Joined:
    """Build the nodes over the blocks of each geometry, put its blocks in their order, and join all."""
    grid = box_grid(*bounds_of(mesh.positions))
    built = [_built(*one, part.boxes, grid, threads) for one, part in zip(ordered, parts, strict=True)]
    return Joined(*join_geometries(built))


def _built(sequences: Sequences, starts: Counts, boxes: Boxes, grid: BoxGrid, threads: int) -> Built:
    """The nodes over the blocks of a geometry, and its blocks in their order."""
    block_boxes = range_boxes(boxes, starts, sequences.faces)
    order, top = build_top(block_boxes, np.diff(starts), grid, threads)
    return Built(*reorder_blocks(sequences, starts, order), top)


def write_scene(placed: Placed, joined: Joined, told: Told, options: Options, threads: int) -> Scene:
    """Encode the strips into blocks, with all that the scene is asked to keep."""
    cleaned = placed.cleaned
    faces = cleaned.mesh.faces
    strips = split_fans(encode_strips(faces, joined.sequences, threads), faces, threads)
    geometries, instances = stored_instances(cleaned.mesh, joined.roots, told.geometries)
    scene = scene_from_strips(
        cleaned.mesh.positions,
        strips,
        joined.starts,
        joined.top,
        source_face=cleaned.source_face if options.remap else None,
        source_face_count=told.face_count,
        grid_exponent=placed.exponent,
        error_bound=placed.bound,
        metadata=told.metadata,
        origin=cleaned.origin,
        geometries=geometries,
        instances=instances,
        threads=threads,
    ).with_attributes(cleaned.mesh, strips)
    return scene.storing_boxes(threads) if options.boxes == "stored" else scene


def report_of(
    scene: Scene, placed: Placed, joined: Joined, told: Told, simplified: Simplified | None, clock: Stopwatch
) -> Report:
    """What was done."""
    cleaned = placed.cleaned
    counts = cleaned.counts | {"strips": scene.strip_count, "blocks": scene.block_count}
    if scene.instances is not None:
        counts |= {"geometries": len(joined.roots.blocks) - 1, "instances": len(scene.instances)}
    seconds, peak = clock.read()
    moved = (cleaned.largest_rounding, cleaned.weld_error, placed.exponent, placed.largest_error)
    return Report(seconds, peak, counts, *moved, told.notes, cleaned.origin, simplified)
