"""Rays from where bugs live."""

import numpy as np


@np.errstate(all="ignore")
def aimed_rays(positions, faces, count, seed):
    """Rays at vertices, edges and insides of triangles, along axes, in planes of boxes, and into nothing."""
    random = np.random.default_rng(seed)
    low, high = positions.min(axis=0).astype(np.float64), positions.max(axis=0).astype(np.float64)
    size = max(float(np.linalg.norm(high - low)), float(np.abs(positions).max()) * 1e-3, 1e-30)
    corners = positions[faces[random.integers(0, len(faces), count)]].astype(np.float64)
    kinds = random.integers(0, 3, count)
    weights = np.where((kinds == 0)[:, None], [[1.0, 0, 0]], random.dirichlet(np.ones(3), count))
    weights = np.where((kinds == 1)[:, None], [[0.5, 0.5, 0]], weights)
    target = (corners * weights[..., None]).sum(axis=1).astype(np.float32)
    origins = (target + size * random.normal(size=(count, 3))).astype(np.float32)
    axial = random.random(count) < 0.4
    axis = random.integers(0, 3, count)
    keep = np.arange(3) == axis[:, None]
    origins[axial] = np.where(keep, origins, target)[axial]
    directions = target - origins
    directions[random.random((count, 3)) < 0.05] *= np.float32(-1)
    directions[axial & (random.random(count) < 0.5)] += np.float32(0)
    zero = (directions == 0) & (random.random((count, 3)) < 0.5)
    directions[zero] = -0.0
    directions *= (np.float32(10.0) ** random.integers(-3, 4, count).astype(np.float32))[:, None]
    return origins, directions
