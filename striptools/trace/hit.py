"""What a trace gives back: arrays over the rays, in the order the rays were given."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32

from striptools.trace.counters import Counters


@dataclass(frozen=True, eq=False)
class Hits:
    """The closest hit of each of r rays.

    Attributes:
        t: (r,) float32, the distance along the ray in lengths of its direction; inf on a miss.
        face: (r,) int32, the source's face through the scene's remap, the file's own without one; -1 on a
            miss.
        u: (r,) float32, the weight of the second corner of `face`, counted from its first corner in the
            source (without
            a remap: in the file). The point is (1-u-v) p0 + u p1 + v p2. 0 on a miss. None where weights
            were not asked for.
        v: (r,) float32, the weight of the third corner. 0 on a miss. None where u is.
        triangle: (r,) int32, the triangle in the file's order; -1 on a miss.
        counters: (r,) int32 each, what the walk visited, tested and read; None unless asked for.
        instance: (r,) int32, the instance of the scene; -1 on a miss. None where a scene has no instances:
            then so are the next two.
        geometry: (r,) int32, the geometry that stands there; -1 on a miss.
        geometry_face: (r,) int32, `face` counted within its geometry, the same in all of its instances: face
            number geometry_face of those that the geometry has in the source. -1 on a miss.
    """

    t: Float32[np.ndarray, " r"]
    face: Int32[np.ndarray, " r"]
    u: Float32[np.ndarray, " r"] | Any
    v: Float32[np.ndarray, " r"] | Any
    triangle: Int32[np.ndarray, " r"]
    counters: Counters | None = None
    instance: Int32[np.ndarray, " r"] | None = None
    geometry: Int32[np.ndarray, " r"] | None = None
    geometry_face: Int32[np.ndarray, " r"] | None = None

    @property
    def hit(self) -> np.ndarray:
        """(r,) bool: which rays hit something."""
        return self.face >= 0


@dataclass(frozen=True, eq=False)
class AllHits:
    """The first hits of each of r rays, up to k, by t and then by face.

    Each face that a ray meets is a hit of its own: a ray through an edge meets both faces that share it, one
    through a corner all of them, at the same t or nearly so.

    Attributes:
        t: (r, k) float32, as in `Hits`; inf where there are fewer hits.
        face: (r, k) int32; -1 where there are fewer.
        u: (r, k) float32.
        v: (r, k) float32.
        triangle: (r, k) int32; -1 where there are fewer.
        count: (r,) int32, how many of the k there are.
        instance: (r, k) int32, as in `Hits`, and so are the next two: None where a scene has no instances.
        geometry: (r, k) int32.
        geometry_face: (r, k) int32.
    """

    t: Float32[np.ndarray, "r k"]
    face: Int32[np.ndarray, "r k"]
    u: Float32[np.ndarray, "r k"]
    v: Float32[np.ndarray, "r k"]
    triangle: Int32[np.ndarray, "r k"]
    count: Int32[np.ndarray, " r"]
    instance: Int32[np.ndarray, "r k"] | None = None
    geometry: Int32[np.ndarray, "r k"] | None = None
    geometry_face: Int32[np.ndarray, "r k"] | None = None


@dataclass(frozen=True, eq=False)
class ClosestPoints:
    """The point of the surface that is closest to each of r points.

    Attributes:
        point: (r, 3) float32, in the frame of the scene's positions; NaN where there is none.
        distance: (r,) float32; inf where there is none; negative inside, where signs were asked for.
        face: (r,) int32, as in `Hits`; -1 where there is none.
        u: (r,) float32, the weight of the face's second corner, as in `Hits`.
        v: (r,) float32, the weight of its third corner.
        triangle: (r,) int32, as in `Hits`; -1 where there is none.
    """

    point: Float32[np.ndarray, "r 3"]
    distance: Float32[np.ndarray, " r"]
    face: Int32[np.ndarray, " r"]
    u: Float32[np.ndarray, " r"]
    v: Float32[np.ndarray, " r"]
    triangle: Int32[np.ndarray, " r"]
