"""A scene under another hierarchy than the default one: what is built, and what then takes whose place.

SLBVH, kd-tree and loose octree stand over triangles, strips or blocks as the file has them, so that blocks
stay and only nodes go. Presorted geometry is its own hierarchy, so that blocks go too. A builder is imported
where it is asked for.
"""

from dataclasses import replace

import numpy as np

from striptools.errors import UsageError
from striptools.hierarchies.options import HierarchyOptions
from striptools.hierarchies.packed import PackedNodes
from striptools.hierarchies.stored import StoredHierarchy
from striptools.mesh.attributes import Domain
from striptools.partition.boxes import range_boxes
from striptools.reducem.attributes import Column
from striptools.reducem.blocks import Blocks
from striptools.reducem.plain_triangles import PlainTriangles, first_use
from striptools.reducem.scene import Remap, Scene
from striptools.types import Counts

__all__ = ["scene_under"]


def scene_under(scene: Scene, options: HierarchyOptions, threads: int) -> Scene:
    """The scene under the hierarchy that is asked for; see `Scene.under`."""
    if (options.name == "reducem" and scene.hierarchy is None) or scene.triangle_count == 0:
        return scene
    _refuse(scene, options)
    scene = replace(scene, metadata={**scene.metadata, "hierarchy": told(options)})
    if options.name == "presorted":
        return _presorted(scene, options, threads)
    none = PackedNodes(np.zeros((0, 16), np.uint32), 0, None, None, 0)
    return replace(scene, packed=none, hierarchy=_built(scene, options, threads))


def told(options: HierarchyOptions) -> str:
    """What was asked for, for the metadata: a reader can see what stands there, but not why."""
    parts = {"slbvh": f", balance {options.balance}", "kdtree": f", metric {options.metric}"}
    parts["presorted"] = f", levels {options.levels}"
    return f"{options.name} over {options.objects}{parts.get(options.name, '')}"


def _refuse(scene: Scene, options: HierarchyOptions) -> None:
    remedy = "convert the model again"
    if options.name == "reducem":
        raise UsageError("the scene has no default hierarchy to go back to", where="hierarchy", remedy=remedy)
    if scene.triangles is not None:
        raise UsageError("presorted geometry has no strips or blocks", where="hierarchy", remedy=remedy)
    if scene.instances is not None:
        remedy = "convert the model again, with its instances flattened"
        raise UsageError(f"{options.name} has no two-level form", where="hierarchy", remedy=remedy)


def _built(scene: Scene, options: HierarchyOptions, threads: int) -> StoredHierarchy:
    boxes = scene.triangle_boxes(threads)
    if options.objects != "triangles":
        boxes = range_boxes(boxes, scene.objects(options.objects))
    match options.name:
        case "slbvh":
            from striptools.hierarchies.slbvh import build_slbvh

            return build_slbvh(boxes, options, threads)
        case "loose-octree":
            from striptools.hierarchies.loose_octree import build_loose_octree

            return build_loose_octree(boxes, options, threads)
        case _:
            from striptools.hierarchies.kdtree import build_kdtree

            corners = scene.positions[scene.faces()] if options.objects == "triangles" else None
            return build_kdtree(boxes, options, threads, corners=corners)


def _presorted(scene: Scene, options: HierarchyOptions, threads: int) -> Scene:
    from striptools.hierarchies.presorted import build_presorted

    order, hierarchy = build_presorted(scene.positions[scene.faces()], options, threads)
    shared = _shared_vertices(scene)
    faces, used = first_use(shared[scene.faces()[order]])
    places: dict[Domain, np.ndarray] = {
        "vertex": used,
        "corner": (3 * order.astype(np.int64)[:, None] + np.arange(3)).reshape(-1),
        "face": order,
    }
    remap = scene.remap
    return replace(
        scene,
        blocks=Blocks(np.zeros((0, 8), np.uint32), np.zeros(0, np.uint32)),
        packed=PackedNodes(np.zeros((0, 16), np.uint32), 0, None, None, 0),
        remap=None if remap is None else Remap(remap.face[order], remap.rotation[order]),
        columns=tuple(_moved(one, places[one.domain]) for one in scene.columns),
        hierarchy=hierarchy,
        triangles=PlainTriangles(np.ascontiguousarray(scene.positions[used]), faces),
    )


def _shared_vertices(scene: Scene) -> Counts:
    """For each vertex of the blocks the first that is the same one: of its position, with its values."""
    values = [one.numbers for one in scene.columns if one.domain == "vertex"]
    if not values:
        return scene.leaders
    keys = np.stack([scene.leaders, *values], axis=1)
    _, first, number = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return first.astype(np.int32)[number.reshape(-1)]


def _moved(column: Column, places: np.ndarray) -> Column:
    """An attribute whose entries come from these places of the one before."""
    numbers, used = first_use(column.numbers[places][:, None])
    return replace(column, rows=column.rows[used], numbers=numbers.reshape(-1))
