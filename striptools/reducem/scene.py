"""A ReduceM scene: the arrays of a scene file, exactly as stored, and the ways into and out of it."""

from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING

import numpy as np

from striptools.hierarchies.strip_bvh import StripHierarchy
from striptools.mesh.mesh import Mesh
from striptools.strips.topology import Strips, decode_strips
from striptools.threads import in_chunks
from striptools.types import Bools, Counts, FaceIds, Faces, Positions, Rotations

if TYPE_CHECKING:
    from striptools.reducem.writer import SectionSizes

__all__ = ["Remap", "Scene", "scene_from_strips"]


@dataclass(frozen=True, eq=False)
class Remap:
    """Where each triangle of a scene comes from.

    Attributes:
        face: (n,) int32 face of the source mesh, each at most once.
        rotation: (n,) uint8: the decoded row is the source's row turned left by it,
            decoded[j] = source[(j + rotation) % 3].
    """

    face: FaceIds
    rotation: Rotations


@dataclass(frozen=True, eq=False)
class Scene:
    """Strips of triangles under a hierarchy; the arrays are those of the file and must not be changed.

    Strip i covers triangles starts[i]:starts[i+1] and strip vertices starts[i]+2i : starts[i+1]+2i+2; how
    they become triangles is told in `strips.topology`. Vertices stand in the order of their first use by the
    strips.

    Attributes:
        positions: (v, 3) float32 in the model's unit, bit for bit those of the cleaned source.
        vertices: (n+2s,) int32 vertex of each strip vertex.
        turns: (n,) bool, the turn of each triangle; False for the first of a strip.
        flips: (n,) bool, whether each triangle runs against its strip; None where none does.
        starts: (s+1,) int32, the first triangle of each strip, then n.
        hierarchy: Over the strips.
        remap: The source's faces, or None where it was left out.
        error_bound: How far a position may be from the source's, in the model's unit; 0.0 where none moved.
        source_face_count: Faces of the source mesh, before cleaning.
    """

    positions: Positions
    vertices: Counts
    turns: Bools
    flips: Bools | None
    starts: Counts
    hierarchy: StripHierarchy
    remap: Remap | None
    error_bound: float
    source_face_count: int

    @property
    def triangle_count(self) -> int:
        """Triangles in all strips."""
        return len(self.turns)

    @property
    def vertex_count(self) -> int:
        """Vertices, each stored once."""
        return len(self.positions)

    @property
    def strip_count(self) -> int:
        """Strips, the leaves of the stored hierarchy."""
        return len(self.starts) - 1

    def faces(self) -> Faces:
        """Decode the strips, once; later calls give the same array.

        Returns:
            (n, 3) int32 triangles in file order, with the source's winding.
        """
        decoded = self.__dict__.get("_faces")
        if decoded is None:
            decoded = decode_strips(self.vertices, self.turns, self.starts, self.flips)
            self.__dict__["_faces"] = decoded
        return decoded

    def to_mesh(self) -> Mesh:
        """Give the mesh back.

        Returns:
            With a remap, the faces in the source's order, each from the source's first corner; without one,
            in file order from the decoded first corner. Vertices stay in file order.
        """
        faces = self.faces()
        if self.remap is not None:
            back = (np.arange(3) - self.remap.rotation[:, None]) % 3
            order = np.argsort(self.remap.face, kind="stable")
            faces = np.ascontiguousarray(np.take_along_axis(faces, back, axis=1)[order])
        return Mesh(self.positions, faces)

    def save(self, target: str | Path | IO[bytes]) -> "SectionSizes":
        """Write a scene file; the same scene gives the same bytes.

        Args:
            target: A path, written whole or not at all, or a binary stream.

        Returns:
            Bytes by part.

        Raises:
            UnreadableSceneError: The scene breaks a rule of the format.
            LimitError: It is larger than the format can hold.
            WriteError: The file could not be written whole.
        """
        from striptools.reducem.writer import write_scene

        return write_scene(self, target)

    def part_bytes(self) -> dict[str, int]:
        """Count the bytes of the scene file by part.

        Returns:
            Bytes of `positions`, `strip_vertices`, `turns`, `flips`, `strip_starts`, `hierarchy`, `remap` and
            `headers` (file header, section table, scene record and padding); their sum is the file's length.
        """
        from striptools.reducem.writer import section_sizes

        return section_sizes(self).parts()

    def bytes_per_triangle(self) -> float:
        """Say what a triangle costs: every byte of the file but the remap's, over the triangles."""
        parts = self.part_bytes()
        return (sum(parts.values()) - parts["remap"]) / self.triangle_count


def scene_from_strips(
    positions: Positions,
    strips: Strips,
    hierarchy: StripHierarchy,
    *,
    source_face: FaceIds | None,
    source_face_count: int,
    error_bound: float = 0.0,
    threads: int = 1,
) -> Scene:
    """Put a scene together, with its vertices in the order of their first use.

    Args:
        positions: (v, 3) float32 positions of the cleaned mesh; those that no strip uses are left out.
        strips: In the order of the hierarchy's leaves.
        hierarchy: Over the strips.
        source_face: (n,) int32, the source's face for each face of the cleaned mesh; None for no remap.
        source_face_count: Faces of the source mesh.
        error_bound: See `Scene`.
        threads: How many threads share the work; the scene is the same for any number.

    Returns:
        The scene.
    """
    from striptools.kernels import scene as kernels

    used, vertices = _by_first_use(strips.vertices, len(positions))
    ordered = np.zeros((len(used), 3), np.float32)
    in_chunks(lambda part: kernels.gather_rows(positions, used, *part, ordered), len(used), threads)
    remap = None
    if source_face is not None:
        face = np.zeros(len(strips.source_face), np.int32)
        order = strips.source_face
        in_chunks(lambda part: kernels.gather_items(source_face, order, *part, face), len(face), threads)
        remap = Remap(face, strips.rotation)
    return Scene(
        positions=ordered,
        vertices=vertices,
        turns=strips.turns,
        flips=strips.flips,
        starts=strips.starts,
        hierarchy=hierarchy,
        remap=remap,
        error_bound=float(error_bound),
        source_face_count=int(source_face_count),
    )


def _by_first_use(vertices: Counts, vertex_count: int) -> tuple[Counts, Counts]:
    """The vertices in the order of their first use, and the strip vertices by that numbering."""
    from striptools.kernels.scene import renumber_by_first_use

    place = np.full(vertex_count, -1, np.int32)
    numbered, used = np.zeros(len(vertices), np.int32), np.zeros(vertex_count, np.int32)
    count = renumber_by_first_use(vertices, place, numbered, used)
    return used[:count], numbered
