"""A ReduceM scene: blocks under a hierarchy as they lie in a scene file, and the ways in and out."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal

import numpy as np

from striptools.hierarchies.packed import BoxGrid, PackedNodes, box_grid, build_inner
from striptools.mesh.clean import weld_vertices
from striptools.mesh.mesh import Mesh
from striptools.partition.boxes import face_boxes
from striptools.reducem.blocks import Blocks, Decoded, decode_blocks, encode_blocks
from striptools.reducem.layout import LONGEST_RUN
from striptools.strips.topology import Strips, decode_strips
from striptools.threads import every_core, in_chunks
from striptools.types import Bools, Boxes, Counts, FaceIds, Faces, Positions, Rotations

__all__ = ["BoxesKind", "Remap", "Scene", "empty_scene", "scene_from_strips"]

BoxesKind = Literal["rebuilt", "stored"]


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
    """Blocks of packed strips under a hierarchy; the arrays are those of the file and must not be changed.

    What the blocks hold is decoded on first use and kept. A vertex that several blocks use stands once for
    each of them. Strip i covers triangles starts[i]:starts[i+1] and strip vertices starts[i]+2i :
    starts[i+1]+2i+2; how they become triangles is told in `strips.topology`.

    Attributes:
        blocks: The geometry.
        packed: The hierarchy: over blocks alone, or complete where boxes are stored.
        grid: Where the planes of its boxes may be.
        low: (3,) float32, the least coordinates of all positions, never -0.0; zeros without a triangle.
        high: (3,) float32, the largest.
        grid_exponent: All coordinates are multiples of 2 to this power; None where nobody asked for a grid.
        error_bound: How far a position may be from the source's, in the model's unit; 0.0 where none moved.
        source_face_count: Faces of the source mesh, before cleaning.
        remap: The source's faces, or None where it was left out.
        metadata: For people and tools: a JSON object.
    """

    blocks: Blocks
    packed: PackedNodes
    grid: BoxGrid
    low: np.ndarray
    high: np.ndarray
    grid_exponent: int | None
    error_bound: float
    source_face_count: int
    remap: Remap | None
    metadata: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def lazily(cls, load: Callable[[str, "Scene"], object], check: Callable[["Scene"], None]) -> "Scene":
        """A scene whose fields are asked of `load(name, scene)` on first use, and kept.

        Args:
            load: Gives a field, checked.
            check: Raises unless every rule of the format is kept.
        """
        scene = object.__new__(cls)
        scene.__dict__.update(_load=load, _check=check)
        return scene

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> object:
            load = self.__dict__.get("_load")
            if load is None or name not in _FIELDS:
                raise AttributeError(f"a scene has no {name!r}")
            return self.__dict__.setdefault(name, load(name, self))

    @property
    def triangle_count(self) -> int:
        """Triangles in all blocks."""
        return self.blocks.triangle_count

    @property
    def block_count(self) -> int:
        """Blocks."""
        return self.blocks.count

    @property
    def vertex_count(self) -> int:
        """Vertices of all blocks: one that several blocks use counts once for each of them."""
        return self._totals["vertices"]

    @property
    def strip_count(self) -> int:
        """Strips in all blocks."""
        return self._totals["strips"]

    @property
    def boxes(self) -> BoxesKind:
        """Whether the boxes inside blocks are stored, or rebuilt when they are needed."""
        return "rebuilt" if self.packed.runs is None else "stored"

    @cached_property
    def _totals(self) -> dict[str, int]:
        return self.blocks.totals()

    @cached_property
    def decoded(self) -> Decoded:
        """What the blocks hold, every rule checked."""
        return decode_blocks(self.blocks, every_core(), self.__dict__.get("_where", "scene"))

    @property
    def positions(self) -> Positions:
        """(q, 3) float32 vertices of all blocks in a row, in the model's unit."""
        return self.decoded.positions

    @property
    def vertices(self) -> Counts:
        """(n+2s,) int32 place in `positions` of each strip vertex."""
        return self.decoded.vertices

    @property
    def turns(self) -> Bools:
        """(n,) bool, the turn of each triangle; False for the first of a strip."""
        return self.decoded.turns

    @property
    def flips(self) -> Bools | None:
        """(n,) bool, the flip of each triangle; None where there is none."""
        return self.decoded.flips

    @property
    def starts(self) -> Counts:
        """(s+1,) int32, the first triangle of each strip, then n."""
        return self.decoded.starts

    @property
    def block_starts(self) -> Counts:
        """(b+1,) int32, the first triangle of each block, then n."""
        return self.decoded.block_starts

    @cached_property
    def _faces(self) -> Faces:
        return decode_strips(self.vertices, self.turns, self.starts, self.flips, threads=every_core())

    def faces(self) -> Faces:
        """Decode the strips, once; later calls give the same array.

        Returns:
            (n, 3) int32 triangles in file order, with the source's winding: places in `positions`.
        """
        return self._faces

    @cached_property
    def leaders(self) -> Counts:
        """(q,) int32, for each vertex the first one that equals it bit for bit."""
        return weld_vertices(self.positions, threads=every_core())[0]

    def triangle_boxes(self, threads: int | None = None) -> Boxes:
        """The exact box of each triangle in file order, (n, 6) float32; computed on each call."""
        return face_boxes(self.positions, self.faces(), threads or every_core())

    def with_boxes(self, threads: int | None = None) -> PackedNodes:
        """The complete hierarchy: as stored, or built and kept where boxes are not stored.

        Args:
            threads: Threads to build with, None for every core; the result is the same.
        """
        if self.packed.runs is not None or self.block_count == 0:
            return self.packed
        if "_complete" not in self.__dict__:
            self.__dict__["_complete"] = _completed(self, threads or every_core())
        return self.__dict__["_complete"]

    def storing_boxes(self, threads: int | None = None) -> "Scene":
        """The same scene with the boxes inside blocks stored."""
        return self if self.block_count == 0 else replace(self, packed=self.with_boxes(threads))

    def check(self) -> None:
        """Make sure that the scene, and the file that it was opened from, keep every rule of the format.

        Raises:
            UnreadableSceneError: Naming the first rule broken, by its code.
            LimitError: It is larger than the format can hold.
        """
        from striptools.reducem.check import check_scene

        self.__dict__.get("_check", check_scene)(self)

    def to_mesh(self) -> Mesh:
        """Give the mesh back.

        Returns:
            Vertices that are equal bit for bit are one again, in the order of their first block. With a
            remap, the faces in the source's order, each from the source's first corner; without one, in
            file order from the decoded first corner.
        """
        faces = self.faces()
        if self.remap is not None:
            back = (np.arange(3) - self.remap.rotation[:, None]) % 3
            order = np.argsort(self.remap.face, kind="stable")
            faces = np.take_along_axis(faces, back, axis=1)[order]
        leader = self.leaders
        is_leader = leader == np.arange(len(leader), dtype=np.int32)
        place = np.cumsum(is_leader, dtype=np.int32) - np.int32(1)
        return Mesh(self.positions[is_leader], np.ascontiguousarray(place[leader[faces]]))

    def save(self, target: str | Path | IO[bytes], *, archive: bool = False) -> int:
        """Write a scene file; the same scene gives the same bytes.

        Args:
            target: A path, written whole or not at all, or a binary stream.
            archive: Compress every section where that makes it smaller; reading it takes the extra `archive`.

        Returns:
            Bytes written.

        Raises:
            UnreadableSceneError: The scene breaks a rule of the format.
            LimitError: It is larger than the format can hold.
            MissingExtraError: An archive is asked for, and its codec is not installed.
            WriteError: The file could not be written whole.
        """
        from striptools.reducem.writer import write_scene

        return write_scene(self, target, archive=archive)

    def part_bytes(self) -> dict[str, int]:
        """Count the bytes of the scene file, not compressed, by part.

        Returns:
            Bytes of `positions`, `connectivity` (start, turn and flip bits, and indices),
            `in_block_hierarchy`, `block_headers`, `top_level`, `remap` and `container` (header, table,
            scene record, metadata, and what fills up words and sections); their sum is the file's length.
        """
        from striptools.reducem.writer import part_sizes

        return part_sizes(self)

    def bytes_per_triangle(self) -> float:
        """Say what a triangle costs: every byte of the file but the remap's, over the triangles."""
        parts = self.part_bytes()
        return (sum(parts.values()) - parts["remap"]) / max(1, self.triangle_count)

    def resident_bytes_per_triangle(self) -> float:
        """Say what tracing without unpacking holds, blocks and complete hierarchy, over the triangles."""
        packed = self.with_boxes()
        held = [self.blocks.headers, self.blocks.words, packed.nodes, packed.first_run, packed.runs]
        return sum(array.nbytes for array in held if array is not None) / max(1, self.triangle_count)


_FIELDS = frozenset(f.name for f in fields(Scene))


def scene_from_strips(
    positions: Positions,
    strips: Strips,
    block_starts: Counts,
    top: np.ndarray,
    *,
    source_face: FaceIds | None,
    source_face_count: int,
    grid_exponent: int | None = None,
    error_bound: float = 0.0,
    metadata: dict[str, Any] | None = None,
    threads: int = 1,
) -> Scene:
    """Put a scene together from strips in blocks; the boxes inside blocks are to be rebuilt.

    Args:
        positions: (v, 3) float32 positions of the cleaned mesh; those that no strip uses are left out.
        strips: Those of a block one after another, blocks in the order of the hierarchy's leaves.
        block_starts: (b+1,) int32, the first triangle of each block, then n.
        top: (t, 16) uint32, the nodes over blocks.
        source_face: (n,) int32, the source's face for each face of the cleaned mesh; None for no remap.
        source_face_count: Faces of the source mesh.
        grid_exponent: See `Scene`.
        error_bound: See `Scene`.
        metadata: See `Scene`.
        threads: How many threads share the work; the scene is the same for any number.

    Raises:
        UsageError: A block of more than 256 triangles or vertices.
    """
    block_strips = np.searchsorted(strips.starts, block_starts).astype(np.int32)
    blocks = encode_blocks(positions, strips, block_strips, threads)
    low, high = bounds_of(positions)
    return Scene(
        blocks=blocks,
        packed=PackedNodes(top, len(top), None, None, 0),
        grid=box_grid(low, high),
        low=low,
        high=high,
        grid_exponent=grid_exponent,
        error_bound=float(error_bound),
        source_face_count=int(source_face_count),
        remap=None if source_face is None else _remap(source_face, strips, threads),
        metadata=dict(metadata or {}),
    )


def empty_scene(source_face_count: int = 0, metadata: dict[str, Any] | None = None) -> Scene:
    """The scene without a triangle."""
    nothing = np.zeros(3, np.float32)
    return Scene(
        blocks=Blocks(np.zeros((0, 8), np.uint32), np.zeros(0, np.uint32)),
        packed=PackedNodes(np.zeros((0, 16), np.uint32), 0, None, None, 0),
        grid=BoxGrid(nothing, np.zeros(3, np.int32)),
        low=nothing,
        high=nothing,
        grid_exponent=None,
        error_bound=0.0,
        source_face_count=source_face_count,
        remap=None,
        metadata=dict(metadata or {}),
    )


def bounds_of(positions: Positions) -> tuple[np.ndarray, np.ndarray]:
    """The least and the largest coordinates, (3,) float32 each, -0.0 as 0.0; zeros where there is none."""
    if len(positions) == 0:
        return np.zeros(3, np.float32), np.zeros(3, np.float32)
    zero = np.float32(0)
    return positions.min(axis=0) + zero, positions.max(axis=0) + zero


def _remap(source_face: FaceIds, strips: Strips, threads: int) -> Remap:
    from striptools.kernels.scene import gather_items

    face, order = np.zeros(len(strips.source_face), np.int32), strips.source_face
    in_chunks(lambda part: gather_items(source_face, order, *part, face), len(face), threads)
    return Remap(face, strips.rotation)


def _completed(scene: Scene, threads: int) -> PackedNodes:
    given = (scene.triangle_boxes(threads), scene.block_starts, scene.starts, scene.grid)
    top = scene.packed.top_count
    nodes, first_run, runs = build_inner(*given, top, LONGEST_RUN, threads)
    return PackedNodes(np.concatenate([scene.packed.nodes, nodes]), top, first_run, runs, LONGEST_RUN)
