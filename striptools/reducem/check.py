"""The rules that a scene keeps (SPEC.md, section 4), asked by the writer and the reader."""

import math
from typing import Any

import numpy as np

from striptools.errors import LimitError, UnreadableSceneError, UsageError
from striptools.hierarchies.kdtree import KdTree
from striptools.hierarchies.packed import check_packed
from striptools.hierarchies.presorted import Presorted
from striptools.kernels import scene as kernels
from striptools.mesh.attributes import Domain
from striptools.reducem import layout
from striptools.reducem.attributes import check_columns
from striptools.reducem.blocks import check_headers, described_runs
from striptools.reducem.check_hierarchy import check_hierarchy
from striptools.reducem.geometries import check_faces, check_geometries, check_instance_rules
from striptools.reducem.issues import unreadable
from striptools.reducem.plain_triangles import check_triangles
from striptools.reducem.scene import Remap, Scene, bounds_of
from striptools.reducem.stored_hierarchy import items_of
from striptools.types import FaceIds

__all__ = ["check_limits", "check_nodes", "check_remap", "check_scene"]

LARGEST_SHARE = 8
"""Source faces per triangle up to which a table of the source's faces is made: a byte each."""

_NODE_CODES = {
    "a wrong number of top nodes": "RDM201",
    "a wrong number of nodes": "RDM201",
    "runs are not there as a whole": "RDM113",
    "a wrong longest run": "RDM207",
    "a slot is neither empty nor has a box": "RDM705",
    "an empty slot is inner": "RDM705",
    "a node without inner children has a base": "RDM706",
    "a node without leaves has leaves": "RDM706",
    "a node has no child": "RDM708",
    "a node over blocks has other leaves than it says": "RDM709",
    "a child is none of the nodes that it may be": "RDM701",
    "a top node has not one parent": "RDM702",
    "a node has not one parent": "RDM702",
    "a block has not one parent": "RDM703",
    "a node names another block than its own": "RDM704",
    "a node has a run of another block": "RDM704",
    "a run has not one parent": "RDM704",
    "the runs of blocks do not follow each other": "RDM801",
    "a run is too long": "RDM802",
    "a run goes on in another strip": "RDM802",
    "the runs do not hold every triangle once": "RDM803",
    "a box does not hold what is below it": "RDM707",
}
"""Of what `check_packed` says."""


def check_limits(scene: Scene) -> None:
    """Make sure that a scene is not larger than the format can hold.

    Raises:
        LimitError: It is.
    """
    sizes = (
        (scene.source_face_count, layout.SOURCE_FACE_LIMIT, "source faces"),
        (scene.block_count, layout.BLOCK_LIMIT, "blocks"),
        (len(scene.packed.nodes), layout.NODE_LIMIT, "nodes"),
    )
    for size, most, name in sizes:
        if size > most:
            raise LimitError(f"{size} {name} are more than {most}", remedy="split the mesh")


def check_scene(scene: Scene, where: str = "scene") -> None:
    """Make sure that a scene keeps every rule of the format.

    Args:
        scene: The scene in question; its blocks are decoded, once.
        where: What the error names as its place.

    Raises:
        LimitError: It is larger than the format can hold.
        UsageError: An array has the wrong dtype.
        UnreadableSceneError: Naming the first rule broken, by its code.
    """
    check_limits(scene)
    _check_dtypes(scene)
    check_record(scene, where)
    check_parts(scene, where)
    if scene.block_count:
        check_headers(scene.blocks, scene.triangle_count, where)
    if scene.triangles is not None:
        check_triangles(scene.triangles, where)
    _check_positions(scene, where)
    check_placing(scene, where)
    check_nodes(scene, where)
    check_remap(scene.remap, scene.triangle_count, scene.source_face_count, where)
    _check_attributes(scene, where)
    check_metadata(scene.metadata, where)


def check_record(scene: Scene, where: str) -> None:
    """Make sure that the numbers of the scene record are in their ranges.

    Raises:
        UnreadableSceneError: They are not.
    """
    place, exponent = f"{where}: SCEN", scene.grid_exponent
    if scene.source_face_count < scene.triangle_count:
        raise unreadable("RDM201", place)
    if not (math.isfinite(scene.error_bound) and scene.error_bound >= 0.0):
        raise unreadable("RDM202", place)
    if scene.origin is not None:
        check_origin(scene.origin.tolist(), True, place)
    if exponent is not None and exponent not in layout.GRID_EXPONENTS:
        raise unreadable("RDM203", place)
    if not (np.isfinite(scene.low).all() and np.isfinite(scene.high).all()):
        raise unreadable("RDM205", place)
    if any(int(cell) not in layout.CELL_EXPONENTS for cell in scene.grid.cell):
        raise unreadable("RDM206", place)
    if scene.triangle_count == 0 and (
        scene.low.any() or scene.high.any() or scene.grid.cell.any() or scene.origin is not None
    ):
        raise unreadable("RDM208", place)


def check_origin(origin: list[float], there: bool, place: str) -> None:
    """Make sure that an origin is one, and that there is none where the flag says so.

    Raises:
        UnreadableSceneError: It is not.
    """
    zero = all(value == 0.0 and math.copysign(1.0, value) > 0.0 for value in origin)
    if not all(map(math.isfinite, origin)) or (not any(origin) if there else not zero):
        raise unreadable("RDM209", place)


def check_placing(scene: Scene, where: str) -> None:
    """Make sure that geometries and instances, where they are, keep their rules.

    Raises:
        UnreadableSceneError: They do not.
    """
    geometries, instances = scene.geometries, scene.instances
    if geometries is None or instances is None:
        if geometries is not None or instances is not None:
            raise unreadable("RDM113", f"{where}: {'GEOM' if geometries is None else 'INST'}")
        return
    if scene.block_count == 0 or scene.hierarchy is not None:
        raise unreadable("RDM117", f"{where}: GEOM")
    starts = (geometries, scene.roots, scene.blocks.triangle_starts)
    check_geometries(*starts, scene.source_face_count, where)
    check_instance_rules(instances, geometries, scene.low, scene.high, where)
    if scene.remap is not None:
        check_faces(*starts, scene.remap.face, where)


def check_parts(scene: Scene, where: str) -> None:
    """Make sure that plain triangles stand in the place of blocks where the hierarchy asks for it.

    Raises:
        UnreadableSceneError: They do not.
    """
    is_plain = scene.triangles is not None
    if scene.hierarchy is not None and scene.triangle_count == 0:
        raise unreadable("RDM117", f"{where}: HIER")
    if is_plain != isinstance(scene.hierarchy, Presorted):
        raise unreadable("RDM117" if is_plain else "RDM113", f"{where}: TRIS")
    if is_plain and scene.block_count:
        raise unreadable("RDM201", f"{where}: SCEN")


def check_nodes(scene: Scene, where: str) -> None:
    """Make sure that the hierarchy reaches everything once and that its boxes hold what is below them.

    Raises:
        UnreadableSceneError: It does not.
    """
    if scene.block_count == 0 or scene.hierarchy is not None:
        if len(scene.packed.nodes) or scene.packed.runs is not None:
            raise unreadable("RDM208" if scene.triangle_count == 0 else "RDM201", f"{where}: SCEN")
        # What a file holds was looked at when it was asked for.
        if scene.hierarchy is not None and scene.__dict__.get("_sound") is not scene.hierarchy:
            check_hierarchy(scene, scene.hierarchy, where)
        return
    given = (scene.grid, scene.triangle_boxes(), scene.block_starts, scene.starts, scene.roots)
    try:
        check_packed(scene.packed, *given)
    except UnreadableSceneError as error:
        code = _NODE_CODES.get(error.what)
        if code is None:
            raise
        raise unreadable(code, f"{where}: {'RUNS' if code[3] == '8' else 'NODE'}") from error
    packed = scene.packed
    if packed.runs is not None and packed.first_run is not None:
        wrong = np.flatnonzero(packed.runs != described_runs(scene.blocks, packed.first_run, packed.runs))
        if len(wrong):
            raise unreadable("RDM804", f"{where}: RUNS: run {wrong[0]} of all")


def check_remap(remap: Remap | None, triangle_count: int, source_face_count: int, where: str) -> None:
    """Make sure that a remap names each triangle's face and rotation.

    Raises:
        UnreadableSceneError: It does not.
    """
    if remap is None:
        return
    if len(remap.face) != triangle_count or len(remap.rotation) != triangle_count:
        raise unreadable("RDM114", f"{where}: RMAP")
    wrong = np.flatnonzero(remap.rotation > 2)
    if len(wrong):
        raise unreadable("RDM501", f"{where}: RMAP: triangle {wrong[0]}")
    outside = np.flatnonzero((remap.face < 0) | (remap.face >= source_face_count))
    if len(outside):
        raise unreadable("RDM502", f"{where}: RMAP: triangle {outside[0]}")
    if _has_repeat(remap.face, source_face_count):
        raise unreadable("RDM503", f"{where}: RMAP")


def check_metadata(metadata: Any, where: str) -> None:
    """Make sure that metadata are an object and that its known names are strings.

    Raises:
        UnreadableSceneError: They are not.
    """
    if not isinstance(metadata, dict):
        raise unreadable("RDM901", f"{where}: META")
    for name in layout.METADATA_NAMES:
        if not isinstance(metadata.get(name, ""), str):
            raise unreadable("RDM903", f"{where}: META: {name}")


def _check_dtypes(scene: Scene) -> None:
    wanted = [
        ("blocks.headers", scene.blocks.headers, np.uint32),
        ("blocks.words", scene.blocks.words, np.uint32),
        ("packed.nodes", scene.packed.nodes, np.uint32),
        ("packed.first_run", scene.packed.first_run, np.uint32),
        ("packed.runs", scene.packed.runs, np.uint32),
        ("low", scene.low, np.float32),
        ("high", scene.high, np.float32),
        ("origin", scene.origin, np.float64),
    ]
    if scene.geometries is not None:
        wanted.append(("geometries.rows", scene.geometries.rows, np.uint32))
    if scene.instances is not None:
        names = (("geometry", np.uint32), ("first_face", np.uint32), ("matrix", np.float64))
        wanted += [(f"instances.{name}", getattr(scene.instances, name), kind) for name, kind in names]
    wanted += _alternative_dtypes(scene)
    if scene.remap is not None:
        wanted += [
            ("remap.face", scene.remap.face, np.int32),
            ("remap.rotation", scene.remap.rotation, np.uint8),
        ]
    for name, array, dtype in wanted:
        if array is not None and array.dtype != dtype:
            raise UsageError(f"{name} has dtype {array.dtype}, not {np.dtype(dtype)}", where="scene")


def _alternative_dtypes(scene: Scene) -> list[tuple[str, np.ndarray | None, type]]:
    """What the arrays of another hierarchy and of plain triangles must be."""
    wanted: list[tuple[str, np.ndarray | None, type]] = []
    if scene.triangles is not None:
        wanted.append(("triangles.positions", scene.triangles.positions, np.float32))
        wanted.append(("triangles.faces", scene.triangles.faces, np.int32))
    if scene.hierarchy is not None:
        is_tree = isinstance(scene.hierarchy, KdTree)
        wanted.append(("hierarchy.nodes", scene.hierarchy.nodes, np.uint32))
        wanted.append(("hierarchy's items", items_of(scene.hierarchy), np.uint32 if is_tree else np.int32))
    return wanted


def _check_attributes(scene: Scene, where: str) -> None:
    count = scene.triangle_count
    if count == 0 and (scene.columns or scene.materials):
        raise unreadable("RDM117", f"{where}: {'ATTR' if scene.columns else 'MATL'}")
    if count:
        entries: dict[Domain, int] = {"vertex": scene.vertex_count, "corner": 3 * count, "face": count}
        check_columns(scene.columns, entries, scene.materials, where)


def _check_positions(scene: Scene, where: str) -> None:
    low, high = bounds_of(scene.positions)
    same = np.array_equal(low.view(np.uint32), scene.low.view(np.uint32)) and np.array_equal(
        high.view(np.uint32), scene.high.view(np.uint32)
    )
    if not same or not np.array_equal(low.view(np.uint32), scene.grid.low.view(np.uint32)):
        raise unreadable("RDM205", f"{where}: SCEN")
    if scene.grid_exponent is None:
        return
    row = kernels.first_row_off_grid(scene.positions, math.ldexp(1.0, -scene.grid_exponent))
    if row >= 0:
        raise unreadable("RDM204", f"{where}: {'BLKD' if scene.block_count else 'TRIS'}: vertex {row}")


def _has_repeat(face: FaceIds, source_face_count: int) -> bool:
    # A table's size is the file's word, not its length: where that is far more, faces are sorted instead.
    if source_face_count <= LARGEST_SHARE * len(face):
        return bool(kernels.has_repeat(face, np.zeros(source_face_count, np.bool_)))
    ordered = np.sort(face)
    return bool((ordered[1:] == ordered[:-1]).any())
