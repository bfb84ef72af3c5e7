"""The rules that the arrays of a scene keep (SPEC.md, section 4), asked by the writer and the reader."""

import math

import numpy as np

from striptools.errors import LimitError, UsageError
from striptools.hierarchies import check as hierarchy_check
from striptools.kernels import scene as kernels
from striptools.reducem.issues import unreadable
from striptools.reducem.layout import SOURCE_FACE_LIMIT, TRIANGLE_LIMIT
from striptools.reducem.scene import Scene
from striptools.types import Boxes, FaceIds

__all__ = ["check_limits", "check_scene", "strip_boxes"]

LARGEST_SHARE = 8
"""Source faces per triangle up to which a table of the source's faces is made: a byte each."""

_HIERARCHY_CODES = {
    hierarchy_check.WRONG_SIZE: "RDM114",
    hierarchy_check.EMPTY_CHILD: "RDM401",
    hierarchy_check.NOT_FINITE: "RDM402",
    hierarchy_check.NOT_HELD: "RDM403",
}


def check_limits(scene: Scene) -> None:
    """Make sure that a scene is not larger than the format can hold.

    Raises:
        LimitError: It is.
    """
    if scene.triangle_count > TRIANGLE_LIMIT:
        raise LimitError(
            f"{scene.triangle_count} triangles are more than {TRIANGLE_LIMIT}",
            remedy="split it",
        )
    if scene.source_face_count > SOURCE_FACE_LIMIT:
        raise LimitError(
            f"{scene.source_face_count} source faces are more than {SOURCE_FACE_LIMIT}",
            remedy="split the mesh",
        )


def check_scene(scene: Scene, where: str = "scene") -> None:
    """Make sure that a scene keeps every rule of the format.

    Args:
        scene: The scene in question; its strips are decoded, once.
        where: What the error names as its place.

    Raises:
        UsageError: An array has the wrong dtype.
        UnreadableSceneError: Naming the first rule broken, by its code.
    """
    _check_dtypes(scene)
    _check_counts(scene, where)
    _check_strips(scene, where)
    _check_vertices(scene, where)
    flaw = hierarchy_check.strip_hierarchy_flaw(scene.hierarchy, strip_boxes(scene))
    if flaw is not None:
        raise unreadable(_HIERARCHY_CODES[flaw[0]], f"{where}: HIER: node {flaw[1]}")
    _check_remap(scene, where)


def strip_boxes(scene: Scene) -> Boxes:
    """Box the vertices of each strip.

    Returns:
        (s, 6) float32.
    """
    boxes = np.zeros((scene.strip_count, 6), np.float32)
    positions, vertices = np.ascontiguousarray(scene.positions), np.ascontiguousarray(scene.vertices)
    kernels.strip_boxes(positions, vertices, scene.starts, 0, scene.strip_count, boxes)
    return boxes


def _check_dtypes(scene: Scene) -> None:
    wanted = [
        ("positions", scene.positions, np.float32),
        ("vertices", scene.vertices, np.int32),
        ("turns", scene.turns, np.bool_),
        ("starts", scene.starts, np.int32),
        ("hierarchy.boxes", scene.hierarchy.boxes, np.float32),
        ("hierarchy.left_count", scene.hierarchy.left_count, np.uint32),
    ]
    if scene.flips is not None:
        wanted.append(("flips", scene.flips, np.bool_))
    if scene.remap is not None:
        wanted += [
            ("remap.face", scene.remap.face, np.int32),
            ("remap.rotation", scene.remap.rotation, np.uint8),
        ]
    for name, array, dtype in wanted:
        if array.dtype != dtype:
            raise UsageError(f"{name} has dtype {array.dtype}, not {np.dtype(dtype)}", where="scene")


def _check_counts(scene: Scene, where: str) -> None:
    triangles, strips, vertices = scene.triangle_count, scene.strip_count, scene.vertex_count
    corners = triangles + 2 * strips
    in_range = 1 <= strips <= triangles <= TRIANGLE_LIMIT and 3 <= vertices <= corners
    if not (in_range and triangles <= scene.source_face_count <= SOURCE_FACE_LIMIT):
        raise unreadable("RDM201", f"{where}: SCEN")
    if not (math.isfinite(scene.error_bound) and scene.error_bound >= 0.0):
        raise unreadable("RDM202", f"{where}: SCEN")
    if len(scene.vertices) != corners or scene.positions.shape != (vertices, 3):
        raise unreadable("RDM114", f"{where}: SVTX")
    if scene.flips is not None and len(scene.flips) != triangles:
        raise unreadable("RDM114", f"{where}: FLIP")


def _check_strips(scene: Scene, where: str) -> None:
    starts = scene.starts
    rising = (starts[1:] > starts[:-1]).all()
    if not (rising and starts[0] == 0 and starts[-1] == scene.triangle_count):
        raise unreadable("RDM302", f"{where}: STRT")
    turned = np.flatnonzero(scene.turns[starts[:-1]])
    if len(turned):
        raise unreadable("RDM303", f"{where}: TURN: strip {turned[0]}")
    if scene.flips is not None:
        flipped = np.flatnonzero(scene.flips[starts[:-1]])
        if len(flipped):
            raise unreadable("RDM310", f"{where}: FLIP: strip {flipped[0]}")
        if not scene.flips.any():
            raise unreadable("RDM311", f"{where}: FLIP")


def _check_vertices(scene: Scene, where: str) -> None:
    stray = kernels.first_row_not_finite(scene.positions, 0, scene.vertex_count)
    if stray >= 0:
        raise unreadable("RDM301", f"{where}: POSN: position {stray}")
    flaw, entry, largest = kernels.first_vertex_flaw(scene.vertices, scene.vertex_count)
    if flaw:
        code = "RDM305" if flaw == kernels.OUTSIDE else "RDM306"
        raise unreadable(code, f"{where}: SVTX: entry {entry}")
    if largest != scene.vertex_count - 1:
        raise unreadable("RDM307", f"{where}: POSN: position {largest + 1}")
    repeated = kernels.first_repeated_corner(scene.faces(), 0, scene.triangle_count)
    if repeated >= 0:
        raise unreadable("RDM308", f"{where}: SVTX: triangle {repeated}")


def _check_remap(scene: Scene, where: str) -> None:
    if scene.remap is None:
        return
    face, rotation = scene.remap.face, scene.remap.rotation
    if len(face) != scene.triangle_count or len(rotation) != scene.triangle_count:
        raise unreadable("RDM114", f"{where}: RMAP")
    wrong = np.flatnonzero(rotation > 2)
    if len(wrong):
        raise unreadable("RDM501", f"{where}: RMAP: triangle {wrong[0]}")
    outside = np.flatnonzero((face < 0) | (face >= scene.source_face_count))
    if len(outside):
        raise unreadable("RDM502", f"{where}: RMAP: triangle {outside[0]}")
    if _has_repeat(face, scene.source_face_count):
        raise unreadable("RDM503", f"{where}: RMAP")


def _has_repeat(face: FaceIds, source_face_count: int) -> bool:
    # A table's size is the file's word, not its length: where that is far more, faces are sorted instead.
    if source_face_count <= LARGEST_SHARE * len(face):
        return bool(kernels.has_repeat(face, np.zeros(source_face_count, np.bool_)))
    ordered = np.sort(face)
    return bool((ordered[1:] == ordered[:-1]).any())


# Notes. Stanford dragon (871,306 triangles), milliseconds of processor time, one thread, before and after:
# encode 73 / 25, scene 32 / 10, file written with every check 95 / 20. Of the 20: checks 11 (hierarchy 5,
# decoding 2, vertices 2, boxes of strips 1, remap 1), checksums 3 to 5, the file the rest. Nothing is left
# out for a scene that this program made: every rule is asked before the first byte is written. What had cost
# most was sorting the remap (35), and gathering corners in NumPy (20 to 35 each for decoding, boxes, first
# uses).
