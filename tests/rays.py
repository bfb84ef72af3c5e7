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


def rays_at(scene, count, seed):
    """Aimed rays at a scene."""
    return aimed_rays(scene.positions, scene.faces(), count, seed)


def far_rays(scene, distance):
    """Three thousand rays at vertices of a scene from so far off its origin."""
    random = np.random.default_rng(5)
    towards = random.normal(size=(3000, 3))
    origins = (towards / np.linalg.norm(towards, axis=1, keepdims=True) * distance).astype(np.float32)
    targets = scene.positions[random.integers(0, len(scene.positions), len(origins))]
    return origins, (targets - origins).astype(np.float32)


def axial_rays(axis, sign):
    """Rays along an axis through the unit cube, in planes of boxes too; and which of them miss its rim."""
    lattice = np.array([[i, j] for i in (0, 0.25, 0.5, 1) for j in (0, 0.25, 0.5, 1)], np.float32)
    origins = np.full((len(lattice), 3), -5.0 * sign, np.float32)
    origins[:, [k for k in range(3) if k != axis]] = lattice
    directions = np.zeros_like(origins)
    directions[:, axis] = sign
    return origins, directions, ((lattice > 0) & (lattice < 1)).all(axis=1)


def edge_targets(positions, faces):
    """The middles of all edges, once each, and all vertices: where rays slip through."""
    edges = np.unique(np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1), axis=0)
    return np.concatenate([positions[edges].astype(np.float64).mean(axis=1), positions])


def rays_from_inside(scene):
    """Rays from within a sphere at every edge and vertex."""
    origin = np.float32([0.1, -0.2, 0.15])
    directions = (edge_targets(scene.positions, scene.faces()) - origin).astype(np.float32)
    return np.broadcast_to(origin, directions.shape), directions
