"""Slow, obvious twins of what the oracle and the tracer do, and a tracer whose answers are the oracle's."""

import numpy as np

from striptools.measure.oracle import Oracle
from striptools.mesh.mesh import Mesh
from striptools.reducem.scene import Scene
from striptools.trace.counters import Counters
from striptools.trace.hit import Hits


def moller_trumbore(mesh: Mesh, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Closest t and face, (r,), of all pairs in float64, after Moeller and Trumbore (JGT 2(1), 1997)."""
    corners = np.asarray(mesh.positions).astype(np.float32).astype(np.float64)[mesh.faces]
    a, edge_1, edge_2 = corners[:, 0], corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    times, faces = np.full(len(origins), np.inf), np.full(len(origins), -1)
    for ray, (o, d) in enumerate(zip(origins.astype(np.float64), directions.astype(np.float64), strict=True)):
        with np.errstate(all="ignore"):
            p = np.cross(d, edge_2)
            det = (edge_1 * p).sum(axis=1)
            s = o - a
            u = (s * p).sum(axis=1) / det
            q = np.cross(s, edge_1)
            v = (q * d).sum(axis=1) / det
            t = (edge_2 * q).sum(axis=1) / det
            hit = (det != 0) & (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        if hit.any():
            times[ray] = t[hit].min()
            faces[ray] = np.flatnonzero(hit & (t == times[ray]))[0]
    return times, faces


def float32_woop(
    corners: np.ndarray, origin: np.ndarray, direction: np.ndarray, *, reciprocal: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Accepted (k,) bool, and float32 t, u, v of faces (k, 3, 3) float32 by Woop's test, step by step."""
    z = int(np.argmax(np.abs(direction)))
    x, y = (z + 1) % 3, (z + 2) % 3
    one = np.float32(1)
    shear_z = one / direction[z]
    shear_x = direction[x] * shear_z if reciprocal else direction[x] / direction[z]
    shear_y = direction[y] * shear_z if reciprocal else direction[y] / direction[z]
    with np.errstate(all="ignore"):
        a = corners - origin
        px = a[..., x] - shear_x * a[..., z]
        py = a[..., y] - shear_y * a[..., z]
        j, k = [1, 2, 0], [2, 0, 1]
        weight = px[:, j] * py[:, k] - py[:, j] * px[:, k]
        det = weight[:, 0] + weight[:, 1] + weight[:, 2]
        height = a[..., z] * shear_z
        scaled = weight[:, 0] * height[:, 0] + weight[:, 1] * height[:, 1] + weight[:, 2] * height[:, 2]
        inverse = one / det
        t, u, v = (
            part * inverse if reciprocal else part / det for part in (scaled, weight[:, 1], weight[:, 2])
        )
        inside = (weight >= 0).all(axis=1) | (weight <= 0).all(axis=1)
        accepted = inside & (det != 0) & np.isfinite(t) & (t > 0)
    return accepted, t, u, v


class OracleTracer:
    """A tracer that gives the oracle's answers, so that tests of verify and render need no JAX."""

    def __init__(self, scene: Scene, source: Mesh) -> None:
        self.oracle = Oracle(source)
        self.place = np.full(source.triangle_count, -1, np.int32)
        assert scene.remap is not None
        self.place[scene.remap.face] = np.arange(scene.triangle_count, dtype=np.int32)

    def closest_hit(self, origins: np.ndarray, directions: np.ndarray, *, counters: bool = False) -> Hits:
        found = self.oracle.closest_hit(origins, directions)
        triangle = np.where(found.face >= 0, self.place[found.face], -1).astype(np.int32)
        zero = np.zeros(len(origins), np.int32)
        nodes = 1 + np.arange(len(origins), dtype=np.int32) % 7
        counted = Counters(nodes, zero, zero, zero, zero, zero) if counters else None
        t, u, v = (column.astype(np.float32) for column in (found.t, found.u, found.v))
        return Hits(t, found.face.copy(), u, v, triangle, counted)

    def any_hit(
        self, origins: np.ndarray, directions: np.ndarray, *, t_max: np.ndarray | float | None = None
    ) -> np.ndarray:
        return self.oracle.closest_hit(origins, directions).t < (np.inf if t_max is None else t_max)
