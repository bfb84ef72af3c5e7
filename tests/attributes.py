"""Meshes that carry attributes, for tests: drawn at random, with values from where bugs live."""

import numpy as np
from hypothesis import strategies as st
from strategies import meshes

from striptools.mesh.attributes import Attribute, Material
from striptools.mesh.mesh import Mesh

SPECIAL = np.array([0.0, -0.0, 1.0, -1.0, 0.5, np.nan, np.inf, 1e-45, 3.4e38], np.float32)
MATERIALS = (
    Material("red", (1.0, 0.0, 0.0, 1.0), "body"),
    Material("red", (1.0, 0.0, 0.0, 1.0), "wheels"),
    Material("", (0.25, 0.5, 0.75, 0.5)),
)


def values_of(random, name, rows, *, variety=6):
    """`rows` values of an attribute, of few or many different ones."""
    if name == "group":
        return random.integers(0, len(MATERIALS), (rows, 1)).astype(np.int32)
    width = {"normal": 3, "texcoord": 2}.get(name) or int(random.integers(3, 5))
    if name == "color" and random.random() < 0.7:
        dtype = [np.uint8, np.uint16][random.integers(0, 2)]
        palette = random.integers(0, np.iinfo(dtype).max + 1, (variety, width)).astype(dtype)
    else:
        palette = random.choice(SPECIAL, (variety, width))
        palette[::2] = random.normal(size=palette[::2].shape)
    return palette[random.integers(0, variety, rows)]


def with_attributes(mesh, seed, names=("normal", "texcoord", "color", "group"), domains=None):
    """The mesh with attributes of some names, in domains drawn from a seed unless given."""
    random = np.random.default_rng(seed)
    rows = {"vertex": mesh.vertex_count, "corner": 3 * mesh.triangle_count, "face": mesh.triangle_count}
    found = []
    for name in names:
        domain = "face" if name == "group" else (domains or {}).get(name)
        domain = domain or ("vertex", "corner", "face")[random.integers(0, 3)]
        values = values_of(random, name, rows[domain], variety=[1, 3, 300][random.integers(0, 3)])
        found.append(Attribute(name, domain, values))
    materials = MATERIALS if "group" in names else ()
    return Mesh(mesh.positions, mesh.faces, mesh.notes, tuple(found), materials, "mm")


@st.composite
def attributed_meshes(draw, *, hostile=True):
    """Any mesh that `meshes` draws, with some attributes."""
    names = draw(st.lists(st.sampled_from(["normal", "texcoord", "color", "group"]), unique=True, min_size=1))
    return with_attributes(draw(meshes(hostile=hostile)), draw(st.integers(0, 2**32)), names)


def words(values):
    """Values as bytes, a row each, so that they compare bit for bit."""
    return np.ascontiguousarray(values).view(np.uint8).reshape(len(values), values.shape[1] * values.itemsize)


def at_faces(mesh, name):
    """`(f, 3, bytes)`: an attribute at the corners of each face, bit for bit."""
    values = mesh.attribute(name).at_corners(mesh.faces)
    return words(values).reshape(mesh.triangle_count, 3, values.shape[1] * values.itemsize)
