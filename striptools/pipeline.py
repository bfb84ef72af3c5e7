"""The data's way in one screen: load, clean, quantise, partition, order, hierarchy, output, scene.

Source: the four steps of Strip-RT (Lauterbach, Yoon, Tang, Manocha, EGSR 2008, section 4) between a loader
that hides nothing and a scene that can be traced as it lies.
"""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import IO, Any, get_args

import numpy as np

from striptools import __version__
from striptools.errors import UnreadableMeshError, UsageError
from striptools.hierarchies.options import HierarchyOptions
from striptools.hierarchies.packed import BoxGrid, box_grid, build_top
from striptools.mesh.clean import Cleaned, CleanOptions, clean
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.mesh.simplify import Simplified, SimplifyOptions, simplify
from striptools.partition.boxes import face_boxes, range_boxes
from striptools.partition.object_split import ObjectTree, split_objects
from striptools.partition.sah import PartitionOptions
from striptools.reducem.attributes import fitting
from striptools.reducem.joining import Built, join_geometries, stored_instances, why_not_kept
from striptools.reducem.quantize import PrecisionOptions, check_bound, quantise, recentred_bound
from striptools.reducem.reader import open_scene
from striptools.reducem.scene import BoxesKind, Scene, bounds_of, scene_from_strips
from striptools.stopwatch import Stopwatch, Watch
from striptools.strips.grouping import reorder_blocks, stripify_in_blocks
from striptools.strips.ordering import OrderingOptions, Sequences
from striptools.strips.topology import encode_strips, split_fans
from striptools.threads import every_core
from striptools.types import Boxes, Counts

STAGES = ("load", "clean", "quantise", "partition", "order", "hierarchy", "output")
"""The stages of a conversion, in order, and `simplify` after `load` where it is asked; `order` finds the
neighbours too, range by range; a command that writes the scene adds `write`."""


@dataclass(frozen=True)
class Options:
    """What a conversion may be asked for; each stage has its own options.

    Attributes:
        clean: Welding and duplicates.
        simplify: Fewer triangles, only where asked; instances are then flattened, attributes left out, and
            the simplified mesh takes the place of the source: remap and `error_bound` are of it.
        precision: Every bit of float32, or a grid.
        partition: The SAH object split.
        ordering: Strips: method, cap, effort, blocks.
        hierarchy: What rays are to walk; another than `reducem` has no instances and no boxes inside blocks.
        boxes: Those inside blocks are `rebuilt` when the scene is traced, or `stored` in the file.
        remap: Keep the source face and first corner of every triangle in the scene.
        geometry_only: Leave out normals, texture coordinates, colours, groups and materials.
        instances: Store a mesh that a glTF scene has in several places once, with a matrix for each. A grid
            is then one for all geometries, in their own frames, as fine as the largest stretch asks for; the
            bound that a scene declares is told in those frames too.
        threads: Threads of the stages that can use several; None for every core. The scene is the same.

    Raises:
        UsageError: `threads` is below 1, `boxes` is neither, or stored under another hierarchy.
    """

    clean: CleanOptions = field(default_factory=CleanOptions)
    simplify: SimplifyOptions = field(default_factory=SimplifyOptions)
    precision: PrecisionOptions = field(default_factory=PrecisionOptions)
    partition: PartitionOptions = field(default_factory=PartitionOptions)
    ordering: OrderingOptions = field(default_factory=OrderingOptions)
    hierarchy: HierarchyOptions = field(default_factory=HierarchyOptions)
    boxes: BoxesKind = "rebuilt"
    remap: bool = True
    geometry_only: bool = False
    instances: bool = True
    threads: int | None = None

    def __post_init__(self) -> None:
        if self.threads is not None and self.threads < 1:
            raise UsageError(f"not a number of threads: {self.threads}", remedy="give 1 or more")
        if self.boxes not in get_args(BoxesKind):
            raise UsageError(f"{self.boxes!r} is not known", where="boxes", remedy="give rebuilt or stored")
        if self.boxes == "stored" and self.hierarchy.name != "reducem":
            raise UsageError(
                f"boxes inside blocks are not of {self.hierarchy.name}", where="boxes", remedy="leave it out"
            )


@dataclass(frozen=True)
class Report:
    """What a conversion did.

    Attributes:
        seconds: Seconds by stage, and `total`.
        peak_bytes: The most memory that the process held during the run, above what it held at its start.
        counts: Faces and vertices in and out, and how many were dropped for which reason.
        largest_rounding: The largest change of a coordinate by rounding to float32, in the model's unit.
        weld_error: The largest distance by which welding moved a vertex, in the model's unit.
        grid_exponent: Positions were moved to multiples of 2 to this power; None where every bit is kept.
        largest_error: The largest distance of a vertex from the loaded one where there is a grid, else None.
        notes: What loading had to say, and what was left out.
        origin: The origin that float64 positions were given, (3,) float64, or None.
        simplified: What simplifying did, where it was asked.
    """

    seconds: dict[str, float]
    peak_bytes: int
    counts: dict[str, int]
    largest_rounding: float
    weld_error: float
    grid_exponent: int | None
    largest_error: float | None
    notes: tuple[str, ...]
    origin: np.ndarray | None = None
    simplified: Simplified | None = None


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
        mesh = _loaded(source, file_format, options)
        metadata, simplified = _metadata(source, mesh), None
    if options.simplify.asked:
        with clock.stage("simplify"):
            simplified = simplify(mesh, options.simplify, threads=threads)
            mesh, metadata["simplified"] = simplified.mesh, simplified.to_dict()
    with clock.stage("clean"):
        cleaned = clean(mesh, options.clean, threads)
        _refuse_nothing(cleaned)
        source_face_count, notes, numbers = mesh.triangle_count, mesh.notes, mesh.geometries
    with clock.stage("quantise"):
        cleaned, exponent, bound, largest_error = _quantised(mesh, cleaned, options, threads)
        faces, positions = cleaned.mesh.faces, cleaned.mesh.positions
        del mesh, source
    with clock.stage("partition"):
        parts = [part for part in cleaned.mesh.parts() if part.triangle_count]
        boxes = [face_boxes(part.positions, part.faces, threads) for part in parts]
        trees = [_partitioned(box, options, threads) for box in boxes]
    with clock.stage("order"):
        told = [None if watch is None else partial(_tell, watch, k, len(parts)) for k in range(len(parts))]
        ordered = [
            stripify_in_blocks(
                part.faces,
                part.vertex_count,
                *(box, tree, options.ordering, options.partition, threads, tell),
            )
            for part, box, tree, tell in zip(parts, boxes, trees, told, strict=True)
        ]
        del trees
    with clock.stage("hierarchy"):
        grid = box_grid(*bounds_of(positions))
        built = [_built(*one, box, grid, threads) for one, box in zip(ordered, boxes, strict=True)]
        sequences, starts, top, roots = join_geometries(built)
        del boxes, ordered, built
    with clock.stage("output"):
        strips = split_fans(encode_strips(faces, sequences, threads), faces, threads)
        geometries, instances = stored_instances(cleaned.mesh, roots, numbers)
        scene = scene_from_strips(
            positions,
            strips,
            starts,
            top,
            source_face=cleaned.source_face if options.remap else None,
            source_face_count=source_face_count,
            grid_exponent=exponent,
            error_bound=bound,
            metadata=metadata,
            origin=cleaned.origin,
            geometries=geometries,
            instances=instances,
            threads=threads,
        ).with_attributes(cleaned.mesh, strips)
        if options.boxes == "stored":
            scene = scene.storing_boxes(threads)
    if options.hierarchy.name != "reducem":
        with clock.stage("hierarchy"):
            scene = scene.under(options.hierarchy, threads)
    counts = cleaned.counts | {"strips": scene.strip_count, "blocks": scene.block_count}
    if scene.instances is not None:
        counts |= {"geometries": len(roots.blocks) - 1, "instances": len(scene.instances)}
    seconds, peak = clock.read()
    moved = (cleaned.largest_rounding, cleaned.weld_error, exponent, largest_error)
    return scene, Report(seconds, peak, counts, *moved, notes, cleaned.origin, simplified)


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


def _loaded(source: Mesh | str | Path | IO[bytes], file_format: str | None, options: Options) -> Mesh:
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


def _partitioned(boxes: Boxes, options: Options, threads: int) -> ObjectTree:
    block = options.ordering.block if options.ordering.method == "strip-rt" else None
    partition = replace(options.partition, block=block or options.partition.block)
    return split_objects(boxes, partition, threads=threads)


def _tell(watch: Watch, part: int, parts: int, fraction: float) -> None:
    watch("order", (part + fraction) / parts)


def _built(sequences: Sequences, starts: Counts, boxes: Boxes, grid: BoxGrid, threads: int) -> Built:
    """The nodes over the blocks of a geometry, and its blocks in their order."""
    block_boxes = range_boxes(boxes, starts, sequences.faces)
    order, top = build_top(block_boxes, np.diff(starts), grid, threads)
    return Built(*reorder_blocks(sequences, starts, order), top)


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


def _quantised(
    mesh: Mesh, cleaned: Cleaned, options: Options, threads: int
) -> tuple[Cleaned, int | None, float, float | None]:
    """The mesh on its grid where one is asked for, the grid's exponent, the bound and the largest error."""
    if options.precision.is_lossless:
        bound = cleaned.weld_error if cleaned.origin is None else recentred_bound(cleaned)
        return cleaned, None, bound, None
    drop = options.clean.drop_duplicates
    moved = quantise(cleaned, options.precision, drop_duplicates=drop, threads=threads)
    _refuse_nothing(moved.cleaned, "quantised_")
    given = (moved.cleaned.mesh, moved.cleaned.source_face, moved.error_bound, moved.cleaned.origin)
    largest = check_bound(mesh, *given)
    return moved.cleaned, moved.grid_exponent, moved.error_bound, largest


def _metadata(source: Mesh | str | Path | IO[bytes], mesh: Mesh) -> dict[str, Any]:
    metadata = {"generator": f"striptools {__version__}"}
    if isinstance(source, str | Path):
        metadata["source"] = Path(source).name
    if mesh.unit:
        metadata["unit"] = mesh.unit
    return metadata
