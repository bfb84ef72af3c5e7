"""The data's way in one screen: load, clean, partition, order, hierarchy, output, scene.

Source: the four steps of Strip-RT (Lauterbach, Yoon, Tang, Manocha, EGSR 2008, section 4) between a loader
that hides nothing and a scene that can be traced as it lies.
"""

import os
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import IO

import numpy as np

from striptools.errors import UnreadableMeshError, UsageError
from striptools.hierarchies.strip_bvh import build_strip_hierarchy
from striptools.mesh.clean import Cleaned, CleanOptions, clean
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.partition.boxes import face_boxes, range_boxes
from striptools.partition.object_split import split_objects
from striptools.partition.sah import PartitionOptions
from striptools.reducem.reader import read_scene
from striptools.reducem.scene import Scene, scene_from_strips
from striptools.stopwatch import Stopwatch, Watch
from striptools.strips.ordering import OrderingOptions
from striptools.strips.stripify import stripify
from striptools.strips.topology import encode_strips
from striptools.types import Faces, Positions

STAGES = ("load", "clean", "partition", "order", "hierarchy", "output")
"""The stages of a conversion, in order; `order` finds the neighbours too, range by range; a command that
writes the scene adds `write`."""


@dataclass(frozen=True)
class Options:
    """What a conversion may be asked for; each stage has its own options.

    Attributes:
        clean: Welding and duplicates.
        partition: The SAH object split.
        ordering: Strips: method, cap, effort, blocks.
        remap: Keep the source face and first corner of every triangle in the scene.
        threads: Threads of the stages that can use several; None for every core. The scene is the same.

    Raises:
        UsageError: `threads` is below 1.
    """

    clean: CleanOptions = field(default_factory=CleanOptions)
    partition: PartitionOptions = field(default_factory=PartitionOptions)
    ordering: OrderingOptions = field(default_factory=OrderingOptions)
    remap: bool = True
    threads: int | None = None

    def __post_init__(self) -> None:
        if self.threads is not None and self.threads < 1:
            raise UsageError(f"not a number of threads: {self.threads}", remedy="give 1 or more")


@dataclass(frozen=True)
class Report:
    """What a conversion did.

    Attributes:
        seconds: Seconds by stage, and `total`.
        peak_bytes: The most memory that the process held during the run, above what it held at its start.
        counts: Faces and vertices in and out, and how many were dropped for which reason.
        largest_rounding: The largest change of a coordinate by rounding to float32, in the model's unit.
        weld_error: The largest distance by which welding moved a vertex, in the model's unit.
        notes: What loading had to say.
    """

    seconds: dict[str, float]
    peak_bytes: int
    counts: dict[str, int]
    largest_rounding: float
    weld_error: float
    notes: tuple[str, ...]


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
    threads = options.threads or len(os.sched_getaffinity(0))
    clock = Stopwatch(watch)
    with clock.stage("load"):
        mesh = source if isinstance(source, Mesh) else load_mesh(source, file_format=file_format)
    with clock.stage("clean"):
        cleaned = clean(mesh, options.clean, threads)
        faces, positions = _remaining(cleaned)
        source_face_count, notes = mesh.triangle_count, mesh.notes
        del mesh, source
    with clock.stage("partition"):
        boxes = face_boxes(positions, faces, threads)
        block = options.ordering.block or options.partition.block
        tree = split_objects(boxes, replace(options.partition, block=block), threads=threads)
    with clock.stage("order"):
        progress = None if watch is None else partial(watch, "order")
        sequences = stripify(faces, len(positions), boxes, tree, options.ordering, threads, progress)
        del tree
    with clock.stage("hierarchy"):
        strip_boxes = range_boxes(boxes, sequences.starts, sequences.faces)
        triangle_counts = np.diff(sequences.starts)
        order, hierarchy = build_strip_hierarchy(
            strip_boxes, triangle_counts, replace(options.partition, block=None), threads=threads
        )
        del boxes, strip_boxes
    with clock.stage("output"):
        strips = encode_strips(faces, sequences.reordered(order), threads)
        scene = scene_from_strips(
            positions,
            strips,
            hierarchy,
            source_face=cleaned.source_face if options.remap else None,
            source_face_count=source_face_count,
            error_bound=cleaned.weld_error,
            threads=threads,
        )
    counts = cleaned.counts | {"strips": scene.strip_count}
    seconds, peak = clock.read()
    return scene, Report(seconds, peak, counts, cleaned.largest_rounding, cleaned.weld_error, notes)


def open(source: str | Path | IO[bytes]) -> Scene:
    """Read a ReduceM scene file.

    Args:
        source: The path of a `.rdm` file, or a binary stream of one.

    Returns:
        The scene.

    Raises:
        UnreadableSceneError: The file is missing, damaged, or no scene file of a version that is read here.
    """
    return read_scene(source)


def _remaining(cleaned: Cleaned) -> tuple[Faces, Positions]:
    if cleaned.mesh.triangle_count == 0:
        reasons = ("non_finite", "repeated_vertex", "zero_area")
        dropped = ", ".join(
            f"{cleaned.counts[r]} {r.replace('_', ' ')}" for r in reasons if cleaned.counts[r]
        )
        raise UnreadableMeshError(
            f"no face is left after cleaning: {dropped or 'there was none'}",
            remedy="a scene needs a triangle with an area",
        )
    return cleaned.mesh.faces, cleaned.mesh.positions
