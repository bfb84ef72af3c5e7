"""A forest-like scene, the same every time: trees of branches and leaves on the ground.

    python tests/benches/forest.py OUT [--trees 16] [--model FILE ...] [--seed 1]

OUT is a mesh file that trimesh writes (`.ply`). Trees that are grown here stand on a jittered grid in turn
with the models of `--model`, each scaled to the height of a tree, set upright along y and turned. Leaves are
single rhombi that lie every way: whatever plane splits their cell, many are on both sides.
"""

import argparse
from pathlib import Path

import numpy as np

from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh

Arrays = tuple[np.ndarray, np.ndarray]
SIDES = 6


def grown_tree(seed: int, levels: int = 4, leaves: int = 14) -> Arrays:
    """A tree about one unit high on the origin: six-sided tapered branches, and rhombi at the twigs' ends."""
    random = np.random.default_rng(seed)
    parts: list[Arrays] = []
    waiting = [(np.zeros(3), np.array([0.0, 1.0, 0.0]), 0.42, 0.03, 0)]
    while waiting:
        start, way, length, radius, level = waiting.pop()
        end = start + way * length
        parts.append(branch(start, end, radius, 0.6 * radius))
        if level == levels:
            parts += [rhombus(random, end, 0.03) for _ in range(leaves)]
            continue
        for _ in range(3 + (level == 0)):
            bent = way + random.normal(size=3) * (0.6 if level else 0.45)
            bent /= np.linalg.norm(bent)
            fork = start + way * length * random.uniform(0.55, 1.0)
            waiting.append((fork, bent, 0.62 * length, 0.55 * radius, level + 1))
    return joined(parts)


def branch(start: np.ndarray, end: np.ndarray, low: float, high: float) -> Arrays:
    """An open tube from a circle of radius `low` to one of `high`."""
    way = (end - start) / np.linalg.norm(end - start)
    one = np.cross(way, np.eye(3)[np.argmin(np.abs(way))])
    one /= np.linalg.norm(one)
    angle = np.arange(SIDES) * (2 * np.pi / SIDES)
    ring = np.outer(np.cos(angle), one) + np.outer(np.sin(angle), np.cross(way, one))
    here = np.arange(SIDES)
    there = (here + 1) % SIDES
    faces = np.concatenate(
        [np.stack([here, there, here + SIDES], 1), np.stack([there, there + SIDES, here + SIDES], 1)]
    )
    return np.concatenate([start + low * ring, end + high * ring]), faces


def rhombus(random: np.random.Generator, near: np.ndarray, size: float) -> Arrays:
    """A leaf: two triangles that lie any way, near a point."""
    one, other = random.normal(size=(2, 3))
    one /= np.linalg.norm(one)
    other = np.cross(one, other)
    other /= np.linalg.norm(other)
    stem = near + 1.2 * size * random.normal(size=3)
    tip = stem + 2 * size * one
    middle, half = stem + size * one, 0.6 * size * other
    points = np.stack([stem, middle + half, tip, middle - half])
    return points, np.array([[0, 1, 2], [0, 2, 3]])


def joined(parts: list[Arrays]) -> Arrays:
    """All parts in one mesh."""
    offsets = np.cumsum([0, *(len(points) for points, _ in parts)])[:-1]
    faces = [faces + offset for (_, faces), offset in zip(parts, offsets, strict=True)]
    return np.concatenate([points for points, _ in parts]), np.concatenate(faces)


def forest(trees: int, models: list[Arrays], seed: int) -> Mesh:
    """Trees on a jittered grid: a grown one, then each of the models in turn; and the ground."""
    random = np.random.default_rng(seed)
    rows = int(np.ceil(np.sqrt(trees)))
    kinds = [*(grown_tree(seed + k) for k in range(2)), *models]
    parts: list[Arrays] = []
    for k in range(trees):
        points, faces = kinds[k % len(kinds)]
        angle, height = random.uniform(0, 2 * np.pi), random.uniform(0.7, 1.3)
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        place = np.array([k % rows, 0, k // rows]) + 0.3 * random.uniform(-1, 1, 3) * [1, 0, 1]
        parts.append((height * points @ turn.T + place, faces))
    parts.append(ground(rows))
    points, faces = joined(parts)
    return Mesh(points.astype(np.float32), faces.astype(np.int32))


def ground(rows: int) -> Arrays:
    """A square below all trees."""
    low, high = -1.0, float(rows)
    points = np.array([[low, 0, low], [high, 0, low], [high, 0, high], [low, 0, high]])
    return points, np.array([[0, 2, 1], [0, 3, 2]])


def upright(mesh: Mesh) -> Arrays:
    """A model scaled to a height of one, its longest side turned to y, standing on the origin."""
    points = np.asarray(mesh.positions, np.float64)
    axis = int(np.argmax(np.ptp(points, axis=0)))
    points = np.roll(points, 1 - axis, axis=1)
    low, size = points.min(axis=0), np.ptp(points, axis=0)
    foot = np.array([low[0] + size[0] / 2, low[1], low[2] + size[2] / 2])
    return (points - foot) / size[1], mesh.faces


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("out", type=Path)
    parser.add_argument("--trees", type=int, default=16)
    parser.add_argument("--model", type=Path, action="append", default=[])
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    made = forest(given.trees, [upright(load_mesh(file)) for file in given.model], given.seed)

    import trimesh

    trimesh.Trimesh(made.positions, made.faces, process=False).export(given.out)


if __name__ == "__main__":
    main()
