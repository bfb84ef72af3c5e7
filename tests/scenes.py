"""Scenes for the tests, made by the real stages."""

import struct
import zlib

import numpy as np
from hypothesis import strategies as st
from strategies import clean_meshes

from striptools.hierarchies.strip_bvh import build_strip_hierarchy
from striptools.mesh.adjacency import build_adjacency
from striptools.mesh.mesh import Mesh
from striptools.partition.boxes import face_boxes, range_boxes
from striptools.partition.cut import cut_tree
from striptools.partition.object_split import split_objects
from striptools.partition.sah import PartitionOptions
from striptools.reducem.scene import scene_from_strips
from striptools.strips.ordering import OrderingOptions, order_strips
from striptools.strips.stripify import order_cut
from striptools.strips.topology import encode_strips


def scene_of(mesh, *, remap=True, max_length=64, spare_faces=0, flips=False):
    """The scene of a cleaned mesh, as if its source had `spare_faces` more faces, before the others.

    With `flips` strips cross edges that both faces run the same way, wherever that links two more.
    """
    boxes = face_boxes(mesh.positions, mesh.faces)
    tree = split_objects(boxes, PartitionOptions())
    adjacency = build_adjacency(mesh.faces, mesh.vertex_count)
    sequences = order_strips(adjacency, mesh.faces, tree, OrderingOptions(max_length=max_length))
    if flips:
        sequences = order_cut(mesh.faces, mesh.vertex_count, boxes, tree, cut_tree(tree, 10**6), max_length)
    strip_boxes = range_boxes(np.ascontiguousarray(boxes[sequences.faces]), sequences.starts)
    lengths = np.diff(sequences.starts).astype(np.int32)
    order, hierarchy = build_strip_hierarchy(strip_boxes, lengths, PartitionOptions())
    strips = encode_strips(mesh.faces, sequences.reordered(order))
    source_face = np.arange(spare_faces, spare_faces + mesh.triangle_count, dtype=np.int32)
    return scene_from_strips(
        mesh.positions,
        strips,
        hierarchy,
        source_face=source_face if remap else None,
        source_face_count=mesh.triangle_count + spare_faces,
    )


def small_scene(*, remap=True, flips=False):
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
    return scene_of(Mesh(positions, faces), remap=remap, max_length=5, spare_faces=2, flips=flips)


@st.composite
def scenes(draw):
    """The scene of any clean mesh, with its source."""
    mesh = draw(clean_meshes())
    most = draw(st.sampled_from([1, 2, 5, 64]))
    return mesh, scene_of(mesh, remap=draw(st.booleans()), max_length=most, flips=draw(st.booleans()))


def table_of(data):
    """The section table as lists `[kind, flags, offset, length, checksum, reserved]`."""
    count = struct.unpack_from("<I", data, 12)[0]
    return [list(row) for row in struct.iter_unpack("<4sIQQII", bytes(data[32 : 32 + 32 * count]))]


def with_checksums(data):
    """The same bytes with every checksum that can be found made to fit."""
    data = bytearray(data)
    rows = table_of(data)
    for at, (_, _, offset, length, _, _) in enumerate(rows):
        if offset + length <= len(data):
            struct.pack_into("<I", data, 32 + 32 * at + 24, zlib.crc32(data[offset : offset + length]))
    table_end = 32 + 32 * len(rows)
    struct.pack_into("<I", data, 28, zlib.crc32(data[:28] + data[32:table_end]))
    return bytes(data)
