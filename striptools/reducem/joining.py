"""Geometries, each ordered by itself, put together into one scene; and which instances a scene can keep."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from striptools.hierarchies.options import HierarchyName
from striptools.hierarchies.packed import NodeWords, Roots, join_tops
from striptools.mesh.instances import FARTHEST, Geometries, placed_bounds, reach
from striptools.mesh.mesh import Mesh
from striptools.mesh.recentre import LEAST_GAIN
from striptools.reducem.geometries import SceneGeometries, SceneInstances
from striptools.reducem.layout import INSTANCE_LIMIT, SOURCE_FACE_LIMIT
from striptools.strips.ordering import Sequences
from striptools.types import Counts

__all__ = ["Built", "join_geometries", "stored_instances", "why_not_kept"]


class Built(NamedTuple):
    """A geometry in its order.

    Attributes:
        sequences: Its strips, those of a block together.
        starts: (b+1,) int32, the place of the first face of each block, then n.
        top: (t, 16) uint32, the nodes over its blocks.
    """

    sequences: Sequences
    starts: Counts
    top: NodeWords


def join_geometries(built: Sequence[Built]) -> tuple[Sequences, Counts, NodeWords, Roots]:
    """Put geometries one after another.

    Returns:
        The strips of all over the faces of all; the blocks of all; the nodes over blocks; and which of both
        each geometry has.
    """
    counts = {
        "faces": [len(one.sequences.faces) for one in built],
        "blocks": [len(one.starts) - 1 for one in built],
        "tops": [len(one.top) for one in built],
    }
    first = {name: np.cumsum([0, *numbers]) for name, numbers in counts.items()}
    roots = Roots(first["blocks"], first["tops"])
    if len(built) == 1:
        return built[0].sequences, built[0].starts, built[0].top, roots
    at = first["faces"][:-1].astype(np.int32)
    faces = np.concatenate([one.sequences.faces + k for one, k in zip(built, at, strict=True)])
    strips, starts = (
        np.append(
            np.concatenate([one[:-1] + k for one, k in zip(rows, at, strict=True)]), np.int32(len(faces))
        )
        for rows in ([one.sequences.starts for one in built], [one.starts for one in built])
    )
    return Sequences(faces, strips), starts, join_tops([one.top for one in built], roots), roots


def stored_instances(
    mesh: Mesh, roots: Roots, source: Geometries | None
) -> tuple[SceneGeometries | None, SceneInstances | None]:
    """The geometries and instances of a scene; those of which cleaning left nothing are left out.

    Args:
        mesh: As it is stored, its geometries some perhaps without a face.
        roots: Of the geometries that have faces.
        source: The geometries of the source.
    """
    if mesh.geometries is None or mesh.instances is None or source is None:
        return None, None
    there = np.diff(mesh.geometries.face_starts) > 0
    first, count = source.face_starts[:-1], np.diff(source.face_starts)
    rows = np.stack([roots.blocks[:-1], roots.tops[:-1], first[there], count[there]], axis=1)
    placed = count.astype(np.int64)[mesh.instances.geometry]
    kept = there[mesh.instances.geometry]
    number = np.cumsum(there) - 1
    return SceneGeometries(rows.astype(np.uint32)), SceneInstances(
        number[mesh.instances.geometry][kept].astype(np.uint32),
        (np.cumsum(placed) - placed)[kept].astype(np.uint32),
        mesh.instances.matrix[kept],
    )


def why_not_kept(mesh: Mesh, hierarchy: HierarchyName = "reducem") -> str | None:
    """Why a scene cannot keep the instances of a mesh, in words, or None where it can.

    Far from zero, measured by its size, a flattened mesh is given an origin, which instances would not have.
    """
    if hierarchy != "reducem":
        return f"{hierarchy} has no two-level form"
    assert mesh.geometries is not None
    assert mesh.instances is not None
    matrix, bounds = mesh.instances.matrix, mesh.bounds
    placed = np.diff(mesh.geometries.face_starts).astype(np.int64)[mesh.instances.geometry]
    if len(mesh.instances) > INSTANCE_LIMIT or placed.sum() > SOURCE_FACE_LIMIT:
        return "they are too many"
    if not reach(matrix, *np.abs(bounds)).max() <= FARTHEST / 2:
        return "they reach too far for float32"
    low, high = placed_bounds(mesh.positions, mesh.geometries, mesh.instances)
    far = np.maximum(np.abs(low), np.abs(high)).max() >= LEAST_GAIN * (high - low).max() / 2
    return "the scene is far from zero" if far else None
