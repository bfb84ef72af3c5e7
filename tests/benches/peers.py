"""Tracers that ours is measured beside: embreex and Open3D, whose tracer is Embree inside, on one thread."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
from typing import Any, Protocol

import numpy as np

FAR = np.float32(1e37)
"""Beyond every hit."""


class Peer(Protocol):
    """A tracer of triangles; rays are origins and directions, (r, 3) float32 each."""

    def faces(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """The face that each ray hits first, -1 for none."""
        ...

    def distances(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """T of the first hit of each ray, infinite for none."""
        ...

    def any(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """Whether each ray hits anything."""
        ...


class Embree:
    """Embreex as it comes, its default scene, through its Python interface.

    Args:
        corners: (n, 3, 3) float32.
    """

    def __init__(self, corners: np.ndarray) -> None:
        rtcore: Any = import_module("embreex.rtcore")
        scenes: Any = import_module("embreex.rtcore_scene")
        meshes: Any = import_module("embreex.mesh_construction")
        self.device = rtcore.EmbreeDevice()
        self.scene = scenes.EmbreeScene(self.device)
        self.mesh = meshes.TriangleMesh(self.scene, corners)
        self.faces(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def faces(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """As of `Peer`."""
        return self.scene.run(origins, directions, dists=np.full(len(origins), FAR), query="INTERSECT")

    def distances(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """As of `Peer`."""
        found = self.scene.run(origins, directions, dists=np.full(len(origins), FAR), output=True)
        return np.where(found["primID"] >= 0, found["tfar"], np.float32(np.inf))

    def any(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """As of `Peer`."""
        return self.scene.run(origins, directions, dists=np.full(len(origins), FAR), query="OCCLUDED") == 0


class Open3D:
    """Open3D's scene for casting rays.

    Args:
        corners: (n, 3, 3) float32.
    """

    def __init__(self, corners: np.ndarray) -> None:
        open3d: Any = import_module("open3d")
        self.tensor = open3d.core.Tensor
        self.scene = open3d.t.geometry.RaycastingScene(nthreads=1)
        indices = np.arange(3 * len(corners), dtype=np.uint32).reshape(-1, 3)
        vertices = np.ascontiguousarray(corners.reshape(-1, 3))
        self.scene.add_triangles(self.tensor(vertices), self.tensor(indices))
        self.faces(np.zeros((1, 3), np.float32), np.ones((1, 3), np.float32))

    def faces(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """As of `Peer`."""
        cast = self.scene.cast_rays(self._rays(origins, directions), nthreads=1)
        return cast["primitive_ids"].numpy().view(np.int32)

    def distances(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """As of `Peer`."""
        return self.scene.cast_rays(self._rays(origins, directions), nthreads=1)["t_hit"].numpy()

    def any(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """As of `Peer`."""
        return self.scene.test_occlusions(self._rays(origins, directions), nthreads=1).numpy()

    def _rays(self, origins: np.ndarray, directions: np.ndarray) -> Any:
        return self.tensor(np.concatenate([origins, directions], axis=1))


PEERS: tuple[tuple[str, Callable[[np.ndarray], Peer]], ...] = (("embreex", Embree), ("open3d", Open3D))
"""What makes each of them; it raises an ImportError where that is not installed."""


def peers(corners: np.ndarray) -> Iterator[tuple[str, Peer]]:
    """Each peer that is installed, with the triangles (n, 3, 3) float32 taken in."""
    for name, make in PEERS:
        with suppress(ImportError):
            yield name, make(corners)
