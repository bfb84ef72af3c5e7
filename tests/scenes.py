"""Scenes for the tests, made by the real stages."""

from dataclasses import replace

import numpy as np
from hypothesis import strategies as st
from strategies import clean_meshes

from striptools.hierarchies.packed import box_grid, build_top
from striptools.mesh.adjacency import build_adjacency
from striptools.mesh.mesh import Mesh
from striptools.partition.boxes import face_boxes, range_boxes
from striptools.partition.cut import cut_tree
from striptools.partition.object_split import split_objects
from striptools.partition.sah import PartitionOptions
from striptools.reducem.scene import bounds_of, scene_from_strips
from striptools.strips.grouping import group_sequences, reorder_blocks
from striptools.strips.ordering import OrderingOptions, Sequences, order_strips
from striptools.strips.stripify import order_cut
from striptools.strips.topology import encode_strips, split_fans


def scene_of(mesh, *, remap=True, max_length=64, spare_faces=0, flips=False, block=256, boxes="rebuilt"):
    """The scene of a cleaned mesh, as if its source had `spare_faces` more faces, before the others.

    With `flips` strips cross edges that both faces run the same way, wherever that links two more.
    """
    face_box = face_boxes(mesh.positions, mesh.faces)
    tree = split_objects(face_box, PartitionOptions())
    if flips:
        sequences = order_cut(
            mesh.faces, mesh.vertex_count, face_box, tree, cut_tree(tree, 10**6), max_length
        )
    else:
        adjacency = build_adjacency(mesh.faces, mesh.vertex_count)
        sequences = order_strips(adjacency, mesh.faces, tree, OrderingOptions(max_length=max_length))
    sequences, starts = group_sequences(sequences, mesh.faces, mesh.vertex_count, face_box, block)
    block_boxes = range_boxes(face_box, starts, sequences.faces)
    order, top = build_top(block_boxes, np.diff(starts), box_grid(*bounds_of(mesh.positions)))
    sequences, starts = reorder_blocks(sequences, starts, order)
    scene = scene_from_strips(
        mesh.positions,
        split_fans(encode_strips(mesh.faces, sequences), mesh.faces),
        starts,
        top,
        source_face=np.arange(spare_faces, spare_faces + mesh.triangle_count, dtype=np.int32)
        if remap
        else None,
        source_face_count=mesh.triangle_count + spare_faces,
    )
    return scene.storing_boxes() if boxes == "stored" else scene


def with_positions(scene, positions):
    """The same strips over other positions, (q, 3) float32, one a vertex of a block, under new nodes."""
    faces, old = scene.faces(), Sequences(np.arange(scene.triangle_count, dtype=np.int32), scene.starts)
    block_boxes = range_boxes(face_boxes(positions, faces), scene.block_starts)
    order, top = build_top(block_boxes, np.diff(scene.block_starts), box_grid(*bounds_of(positions)))
    sequences, starts = reorder_blocks(old, scene.block_starts, order)
    strips = split_fans(encode_strips(faces, sequences), faces)
    remap = scene.remap
    if remap is not None:
        strips = replace(
            strips, rotation=(remap.rotation[strips.source_face] + strips.rotation) % np.uint8(3)
        )
    return scene_from_strips(
        positions,
        strips,
        starts,
        top,
        source_face=None if remap is None else remap.face,
        source_face_count=scene.source_face_count,
        error_bound=scene.error_bound,
    )


def small_scene(*, remap=True, flips=False, block=256, boxes="rebuilt"):
    """Thirteen triangles in several strips: a bent grid of twelve and one apart; some turns are set.

    With `flips` every third triangle runs the other way, and some flip bits are set.
    """
    x, y = np.meshgrid(np.arange(4), np.arange(3))
    grid = np.stack([x.ravel(), y.ravel(), (x * y).ravel() / 3], axis=1)
    positions = np.concatenate([grid, [[9, 9, 9], [10, 9, 9], [9, 10, 9]]]).astype(np.float32)
    faces = [[12, 13, 14]]
    for corner in (0, 1, 2, 4, 5, 6):
        faces += [[corner, corner + 1, corner + 5], [corner, corner + 5, corner + 4]]
    faces = np.array(faces, np.int32)
    if flips:
        faces[::3] = faces[::3, ::-1]
    options = {"block": block, "boxes": boxes}
    return scene_of(Mesh(positions, faces), **options, remap=remap, max_length=5, spare_faces=2, flips=flips)


@st.composite
def scenes(draw):
    """The scene of any clean mesh, with its source."""
    mesh = draw(clean_meshes())
    options = {
        "remap": draw(st.booleans()),
        "max_length": draw(st.sampled_from([1, 2, 5, 64])),
        "flips": draw(st.booleans()),
        "block": draw(st.sampled_from([4, 16, 256])),
        "boxes": draw(st.sampled_from(["rebuilt", "stored"])),
    }
    return mesh, scene_of(mesh, **options)
