"""Shapes from where bugs live, by name: what every walk is tried on."""

import numpy as np
from strategies import book, cube, fan, grid, soup, sphere, stack, tangle

COMMON = {
    "planar": grid(20, 20),
    "fan": fan(300),
    "pages on an edge": book(26),
    "soup": soup(600, 1, 1000),
    "coincident soup": soup(300, 2, 3),
    "copies": stack(40),
    "cube": cube(),
    "closed": sphere(3),
}
"""Small ones of many hits, for comparisons with every triangle."""

SHAPES = {
    "one triangle": (np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.int32([[0, 1, 2]])),
    **COMMON,
    "closed": sphere(4),
    "tangle": tangle(12, 80, 3),
}
"""For comparisons of walks."""

THIN = (sphere(3)[0] * np.float32([1, 1e-6, 1]), sphere(3)[1])

UNITS = [(2.0**-126, 0), (2.0**-120, 1), (1e-8, 0), (1, 1e4), (2.0**120, 0), (2.0**100, 1e4)]
"""Scales and offsets, in units before scaling, from denormals to near the largest float."""


def moved_sphere(scale, offset):
    """A sphere in such a unit, so far off."""
    positions, faces = sphere(3)
    return ((positions.astype(np.float64) + offset) * scale).astype(np.float32), faces
