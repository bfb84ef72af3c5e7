"""What a tracer needs of a scene laid out for a walk, expanded or packed."""

from typing import Any, Protocol

import numpy as np

from striptools.trace.leaves import Found, Rays
from striptools.trace.walk import Decode


class Layout(Protocol):
    """A scene laid out."""

    @property
    def arrays(self) -> Any:
        """For the device, as NumPy arrays: a `walk.WalkScene`."""
        ...

    @property
    def depth(self) -> int:
        """The most nodes on a way from the root down."""
        ...

    @property
    def decode(self) -> Decode | None:
        """How leaves are decoded, where they are packed."""
        ...

    @property
    def root(self) -> tuple[np.ndarray, np.ndarray]:
        """(>= 6, 8) float32 boxes of the root's children, NaN where is none, and (8,) int32 children."""
        ...

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        ...

    def weigh(self, rays: Rays, at: np.ndarray, traced: tuple[np.ndarray, ...], found: Found) -> None:
        """Fill in what was found of the rays `at`."""
        ...

    def named(self, names: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Faces and triangles (k,) of what a walk names, and turns: corner j is the face's (j + turn) % 3."""
        ...
