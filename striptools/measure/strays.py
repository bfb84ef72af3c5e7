"""How far a scene of fewer triangles strays from the mesh that it was made from, against what it declares.

A simplified scene has no face of its source, so its faces prove nothing. What it declares, in its metadata,
is the distance of the two surfaces, both ways (`mesh.simplify`); that is measured again here, by certified
bounds, and allowed what the scene declares besides for rounding, welding and its grid. That rays hit this
surface is proved against the scene's own triangles.
"""

import math
from dataclasses import dataclass, replace

import numpy as np

from striptools.errors import UsageError
from striptools.mesh.clean import clean
from striptools.mesh.mesh import Mesh
from striptools.mesh.surface_distance import Surface, deviation
from striptools.reducem.scene import Scene

SIMPLIFIED = "simplified"
"""The name in a scene's metadata."""

SLACK = 1 + 2.0**-20
"""For the same distance measured over triangles in another order."""


@dataclass(frozen=True)
class Strays:
    """How far two surfaces are from each other, in the model's unit: no point is farther away.

    Attributes:
        of_source: Of points of the source from the scene.
        of_result: Of points of the scene from the source.
        allowed_of_source: What the scene declares of that, its error bound included.
        allowed_of_result: Likewise.
    """

    of_source: float
    of_result: float
    allowed_of_source: float
    allowed_of_result: float

    @property
    def ok(self) -> bool:
        """Whether what is declared is kept both ways."""
        return self.of_source <= self.allowed_of_source and self.of_result <= self.allowed_of_result


def is_simplified(scene: Scene, source: Mesh) -> bool:
    """Whether a scene says that it was simplified, and from another mesh than one of its own faces."""
    return SIMPLIFIED in scene.metadata and source.triangle_count != scene.source_face_count


def strays_of(scene: Scene, source: Mesh) -> Strays:
    """Measure how far a simplified scene strays from its source.

    Args:
        scene: The scene.
        source: The mesh that was simplified, as loaded.

    Raises:
        UsageError: The scene does not say how far, or the source has another number of triangles than it
            says.
    """
    before, of_source, of_result = _declared(scene)
    cleaned = clean(source.flattened().geometry())
    whole = cleaned.mesh
    if cleaned.origin is not None:
        whole = replace(whole, positions=whole.positions.astype(np.float64) + cleaned.origin)
    if whole.triangle_count != before:
        raise UsageError(
            f"the source has {whole.triangle_count} faces once clean, the scene's had {before}",
            remedy="give the file that was converted",
        )
    result = scene.to_mesh()
    allowed = [(declared + scene.error_bound) * SLACK for declared in (of_source, of_result)]
    there = deviation(whole, Surface(result), limit=allowed[0])
    back = deviation(result, Surface(whole), limit=allowed[1])
    return Strays(there.upper, back.upper, *allowed)


def _declared(scene: Scene) -> tuple[int, float, float]:
    """Triangles before, and the upper bounds of both distances, by what the metadata say."""
    told = scene.metadata[SIMPLIFIED]
    try:
        of_source, of_result = (float(told[f"hausdorff_of_{which}"][1]) for which in ("source", "result"))
        before = int(told["triangles_before"])
    except (KeyError, IndexError, TypeError, ValueError, OverflowError):
        of_source, of_result, before = math.nan, math.nan, 0
    if not (0.0 <= of_source < math.inf and 0.0 <= of_result < math.inf):
        raise UsageError(
            "the scene says that it was simplified, and not how far it strays",
            where="metadata",
            remedy="convert the mesh again",
        )
    return before, of_source, of_result


def own_source(scene: Scene) -> tuple[Scene, Mesh]:
    """A scene as if its own triangles were its source, and that mesh: each face at its number."""
    alone = replace(scene, error_bound=0.0, origin=None, metadata={})
    mesh = alone.to_mesh().geometry()
    if alone.remap is None:
        return alone, mesh
    faces = np.zeros((alone.source_face_count, 3), np.int32)
    faces[np.sort(alone.remap.face)] = mesh.faces
    return alone, replace(mesh, faces=faces)
