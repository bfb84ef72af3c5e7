"""What a conversion may be asked for, what it does in which order, and what it says that it did."""

from dataclasses import dataclass, field
from typing import get_args

import numpy as np

from striptools.errors import UsageError
from striptools.hierarchies.options import HierarchyOptions
from striptools.mesh.clean import CleanOptions
from striptools.mesh.simplify import Simplified, SimplifyOptions
from striptools.partition.sah import PartitionOptions
from striptools.reducem.quantize import PrecisionOptions
from striptools.reducem.scene import BoxesKind
from striptools.strips.ordering import OrderingOptions

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
