"""Closed shapes for the leak table that need no file."""

import numpy as np

from striptools.mesh.mesh import Mesh


def closed_shapes() -> dict[str, Mesh]:
    """By name."""
    return {
        "torus": torus(200, 100, 0.0),
        "rough torus": torus(200, 100, 0.5),
        "cube": cube(40),
        "hubs": hubs(2000),
    }


def torus(rows: int, columns: int, roughness: float) -> Mesh:
    """Two triangles a cell; roughness moves each vertex along its normal by a random part of the tube."""
    u, v = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    tube = 0.4 * (1 + roughness * np.random.default_rng(2).uniform(-1, 1, u.shape))
    a, b = u * (2 * np.pi / rows), v * (2 * np.pi / columns)
    out = 1 + tube * np.cos(b)
    positions = np.stack([out * np.cos(a), out * np.sin(a), tube * np.sin(b)], axis=-1).reshape(-1, 3)
    right, up = (u + 1) % rows, (v + 1) % columns
    corners = (u * columns + v, right * columns + v, right * columns + up, u * columns + up)
    one, two = np.stack([corners[k] for k in (0, 1, 2)], -1), np.stack([corners[k] for k in (0, 2, 3)], -1)
    return Mesh(positions.astype(np.float32), np.concatenate([one, two]).reshape(-1, 3).astype(np.int32))


def cube(cells: int) -> Mesh:
    """Its faces cut into a lattice: axis-parallel rays run in planes of boxes, and along edges."""
    x, y = np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    square = np.stack([np.stack([x + i, y + j], -1) for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))], 2)
    square = square.reshape(-1, 4, 2)
    corners = []
    for axis in range(3):
        for side in (0, cells):
            points = np.insert(square, 0, side, axis=2)
            points = np.roll(points, axis, axis=2)
            corners.append(points if side else points[:, ::-1])
    points, index = np.unique(np.concatenate(corners).reshape(-1, 3), axis=0, return_inverse=True)
    index = index.reshape(-1, 4)
    faces = np.concatenate([index[:, [0, 1, 2]], index[:, [0, 2, 3]]])
    # A lattice of tenths, so that nothing is exact in float32.
    return Mesh((points * 0.1 - 1.7).astype(np.float32), faces.astype(np.int32))


def hubs(blades: int) -> Mesh:
    """Two vertices of so many faces each: slivers."""
    angle = np.arange(blades) * (2 * np.pi / blades)
    rim = np.stack([np.cos(angle), np.sin(angle), 0.1 * np.sin(40 * angle)], axis=1)
    positions = np.concatenate([rim, [[0.1, 0.2, 0.7], [-0.1, 0, -0.6]]]).astype(np.float32)
    k = np.arange(blades)
    after, top, bottom = (k + 1) % blades, np.full(blades, blades), np.full(blades, blades + 1)
    faces = np.concatenate([np.stack([k, after, top], axis=1), np.stack([after, k, bottom], axis=1)])
    return Mesh(positions, faces.astype(np.int32))
