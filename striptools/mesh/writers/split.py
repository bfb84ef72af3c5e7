"""What formats need that know attributes of vertices only: corners that differ get vertices of their own."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from striptools.mesh.attributes import Attribute, Name, distinct_rows
from striptools.mesh.mesh import Mesh


def split_vertices(mesh: Mesh, names: Sequence[Name]) -> Mesh:
    """The mesh with the attributes of some names at its vertices, of which there may be more.

    Faces keep their order and first corner, vertices their order, copies behind their original; vertices that
    no face uses are dropped where any vertex is split.
    """
    moving = [one for one in mesh.attributes if one.name in names and one.domain != "vertex"]
    if not moving:
        return mesh
    flat = mesh.faces.reshape(-1)
    keys = flat
    for one in moving:
        _, rows = distinct_rows(one.at_corners(mesh.faces))
        _, keys = distinct_rows(np.stack([keys, rows, np.zeros_like(rows)], axis=1))
    first = np.full(int(keys.max(initial=-1)) + 1, -1, np.int64)
    first[keys[::-1]] = np.arange(len(keys))[::-1]
    order = np.argsort(flat[first], kind="stable")
    place = np.zeros(len(order), np.int32)
    place[order] = np.arange(len(order), dtype=np.int32)
    corner = first[order]
    attributes = []
    for one in mesh.attributes:
        if one in moving:
            one = Attribute(one.name, "vertex", one.at_corners(mesh.faces)[corner])
        elif one.domain == "vertex":
            one = Attribute(one.name, "vertex", one.values[flat[corner]])
        attributes.append(one)
    return Mesh(
        mesh.positions[flat[corner]],
        place[keys].reshape(-1, 3),
        mesh.notes,
        tuple(attributes),
        mesh.materials,
        mesh.unit,
    )
