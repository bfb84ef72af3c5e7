"""Shapes and dtypes of the arrays that travel between the stages: the signature is the documentation.

Axis names: `v` mesh vertices, `f` faces of the loaded mesh, `n` faces that cleaning kept (= triangles of the
scene), `s` strips, `c` strip vertices (a strip of k triangles has k + 2), `r` rays.
"""

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, Int32, UInt8, UInt32

Positions = Float32[np.ndarray, "v 3"]
"""Vertex positions in the model's unit, float32: what the scene stores bit for bit."""

SourcePositions = Float[np.ndarray, "v 3"]
"""Vertex positions as a file gave them: float32 or float64."""

Faces = Int32[np.ndarray, "n 3"]
"""Vertex indices of each triangle; the order of a row is its winding, its first entry its first corner."""

Boxes = Float32[np.ndarray, "n 6"]
"""Axis-aligned bounding boxes, a row `lo_x lo_y lo_z hi_x hi_y hi_z`."""

FaceIds = Int32[np.ndarray, " n"]
"""One face index per triangle."""

Rotations = UInt8[np.ndarray, " n"]
"""0, 1 or 2 per triangle: how many places the corners were turned to the left."""

RayVectors = Float32[np.ndarray, "r 3"]
"""Ray origins or directions; directions need not be of unit length, and t is in units of their length."""

Bools = Bool[np.ndarray, " n"]
Doubles = Float64[np.ndarray, " n"]
Counts = Int32[np.ndarray, " n"]
Words = UInt32[np.ndarray, " n"]

__all__ = [
    "Bools",
    "Boxes",
    "Counts",
    "Doubles",
    "FaceIds",
    "Faces",
    "Positions",
    "RayVectors",
    "Rotations",
    "SourcePositions",
    "Words",
]
