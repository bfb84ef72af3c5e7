"""A ReduceM scene: blocks under a hierarchy as they lie in a scene file, and the ways in and out."""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, Literal

import numpy as np

from striptools.hierarchies.options import HierarchyOptions, OverName
from striptools.hierarchies.packed import BoxGrid, PackedNodes, Roots, box_grid, build_inner
from striptools.hierarchies.stored import StoredHierarchy
from striptools.mesh.attributes import Attribute, Material, follow
from striptools.mesh.clean import weld_vertices
from striptools.mesh.instances import Geometries, Instances
from striptools.mesh.mesh import Mesh
from striptools.mesh.recentre import Origin
from striptools.partition.boxes import face_boxes
from striptools.reducem.attributes import Column, columns_of
from striptools.reducem.blocks import Blocks, Decoded, decode_blocks, described_runs, encode_blocks
from striptools.reducem.geometries import SceneGeometries, SceneInstances, roots_of
from striptools.reducem.layout import LONGEST_RUN
from striptools.reducem.plain_triangles import PlainTriangles
from striptools.reducem.resident import traced_bytes
from striptools.strips.topology import Strips, decode_strips
from striptools.threads import every_core, in_chunks
from striptools.types import Bools, Boxes, Counts, FaceIds, Faces, Positions, Rotations

if TYPE_CHECKING:
    from striptools.reducem.placed import Placed

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
        columns: The attributes as they are stored; `attributes` gives their values.
        materials: What the numbers of the attribute `group` stand for.
        origin: (3,) float64: what to add to positions, bounds and boxes to be where the source is; None where
            they stand as they are. It is there for float64 sources alone that float32 would not hold well.
            Where there are instances it is that of the frame that they stand in.
        geometries: Where geometries stand in several places: which blocks, nodes over blocks and source
            faces each is. Positions, bounds, boxes and `error_bound` are then in the geometries' own frames,
            before any matrix, and so are `faces`, `triangle_count` and all else here that is not placed.
        instances: Where they stand; there where `geometries` are.
        hierarchy: What stands in the place of the default one, or None. `packed` then has no node.
        triangles: Where the hierarchy is presorted, the geometry: there is then no block, and each triangle
            counts as a strip.
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
    columns: tuple[Column, ...] = field(default_factory=tuple)
    materials: tuple[Material, ...] = field(default_factory=tuple)
    origin: Origin | None = field(default_factory=lambda: None)
    geometries: SceneGeometries | None = field(default_factory=lambda: None)
    instances: SceneInstances | None = field(default_factory=lambda: None)
    hierarchy: StoredHierarchy | None = field(default_factory=lambda: None)
    triangles: PlainTriangles | None = field(default_factory=lambda: None)

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
        """Triangles in all blocks, or plain ones."""
        return self.blocks.triangle_count if self.triangles is None else self.triangles.count

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

    @property
    def attributes(self) -> tuple[Attribute, ...]:
        """The attributes: of `positions` (`vertex`), of the corners of `faces()`, or of its rows (`face`)."""
        return tuple(one.attribute for one in self.columns)

    @property
    def unit(self) -> str | None:
        """The length that 1 stands for, where the metadata say so."""
        return self.metadata.get("unit")

    @cached_property
    def _totals(self) -> dict[str, int]:
        if self.triangles is None:
            return self.blocks.totals()
        return {"vertices": len(self.triangles.positions), "strips": self.triangles.count}

    @cached_property
    def decoded(self) -> Decoded:
        """What the blocks hold, or plain triangles as strips of one, every rule checked."""
        if self.triangles is not None:
            return self.triangles.decoded
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
        """(b+1,) int32, the first triangle of each block, then n; plain triangles are as in one block."""
        return self.decoded.block_starts

    @cached_property
    def _faces(self) -> Faces:
        if self.triangles is not None:
            return self.triangles.faces
        return decode_strips(self.vertices, self.turns, self.starts, self.flips, threads=every_core())

    def faces(self) -> Faces:
        """Decode the strips, once; later calls give the same array.

        Returns:
            (n, 3) int32 triangles in file order, with the source's winding: places in `positions`.
        """
        return self._faces

    @cached_property
    def leaders(self) -> Counts:
        """(q,) int32, for each vertex the first one of its geometry that equals it bit for bit."""
        leaders = [
            weld_vertices(self.positions[first:end], threads=every_core())[0] + first
            for first, end in pairwise(self.spans.vertex_starts)
        ]
        return np.concatenate(leaders) if len(leaders) > 1 else leaders[0]

    @property
    def roots(self) -> Roots:
        """Which blocks and nodes over blocks each geometry has; a scene without them is one."""
        return roots_of(self.geometries, self.block_count, self.packed.top_count)

    @cached_property
    def spans(self) -> Geometries:
        """Which triangles, in file order, and which of `positions` each geometry has."""
        if self.triangles is not None:
            return Geometries(self.block_starts, self.decoded.vertex_starts)
        blocks = self.roots.blocks
        return Geometries(self.block_starts[blocks], self.decoded.vertex_starts[blocks].astype(np.int32))

    @property
    def placed_count(self) -> int:
        """Triangles of all instances."""
        if self.instances is None:
            return self.triangle_count
        return int(np.diff(self.spans.face_starts).astype(np.int64)[self.instances.geometry].sum())

    def placed(self) -> "Scene | Placed":
        """The triangles with every instance where it stands, computed on each call; the scene if plain.

        Raises:
            LimitError: Where they are more than a mesh may have.
        """
        from striptools.reducem.placed import place_scene

        return self if self.instances is None else place_scene(self)

    def triangle_boxes(self, threads: int | None = None) -> Boxes:
        """The exact box of each triangle in file order, (n, 6) float32; computed on each call."""
        return face_boxes(self.positions, self.faces(), threads or every_core())

    def objects(self, over: OverName) -> Counts:
        """(p+1,) int32: the first triangle, in file order, of each object a hierarchy is over, then n."""
        if over == "triangles":
            return np.arange(self.triangle_count + 1, dtype=np.int32)
        return self.starts if over == "strips" else self.block_starts

    def with_boxes(self, threads: int | None = None) -> PackedNodes:
        """The complete default hierarchy: as stored, or built and kept where boxes are not stored.

        A scene with another hierarchy has none.

        Args:
            threads: Threads to build with, None for every core; the result is the same.
        """
        if self.packed.runs is not None or self.block_count == 0 or self.hierarchy is not None:
            return self.packed
        if "_complete" not in self.__dict__:
            self.__dict__["_complete"] = _completed(self, threads or every_core())
        return self.__dict__["_complete"]

    def storing_boxes(self, threads: int | None = None) -> "Scene":
        """The same scene with the boxes inside blocks stored."""
        return self if self.block_count == 0 else replace(self, packed=self.with_boxes(threads))

    def under(self, options: HierarchyOptions, threads: int | None = None) -> "Scene":
        """The same scene under the hierarchy that is asked for.

        Args:
            options: Which one, and over what.
            threads: Threads to build with, None for every core; the scene is the same.

        Raises:
            UsageError: The scene has instances, plain triangles, or no default hierarchy to go back to.
        """
        from striptools.reducem.hierarchy import scene_under

        return scene_under(self, options, threads or every_core())

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
            file order from the decoded first corner. Attributes, materials and unit as they were. Positions
            are float64, where the source is, where there is an origin, else float32. Geometries and instances
            as they were, but for those of which cleaning left nothing.
        """
        faces, attributes = self.faces(), self.attributes
        order = np.arange(len(faces), dtype=np.int32)
        if self.remap is not None:
            back = (np.arange(3) - self.remap.rotation[:, None]) % 3
            order = np.argsort(self.remap.face, kind="stable").astype(np.int32)
            faces = np.take_along_axis(faces, back, axis=1)
            attributes = tuple(_turned(one, back) for one in attributes)
        leader = self.leaders
        is_leader = leader == np.arange(len(leader), dtype=np.int32)
        place = np.cumsum(is_leader, dtype=np.int32) - np.int32(1)
        welded = np.ascontiguousarray(place[leader[faces[order]]])
        attributes, _ = follow(attributes, faces, order, welded, np.flatnonzero(is_leader))
        positions, geometries, instances = self.positions[is_leader], None, None
        if self.instances is not None:
            vertices = np.append(np.int32(0), np.cumsum(is_leader, dtype=np.int32))[self.spans.vertex_starts]
            geometries, instances = Geometries(self.spans.face_starts, vertices), self._at_origin()
        elif self.origin is not None:
            positions = positions.astype(np.float64) + self.origin
        given = (attributes, self.materials, self.unit, geometries, instances)
        return Mesh(positions, welded, (), *given)

    def _at_origin(self) -> Instances:
        """The instances where the source is."""
        assert self.instances is not None
        matrix = self.instances.matrix.copy()
        if self.origin is not None:
            matrix[:, :, 3] += self.origin
        return Instances(self.instances.geometry.astype(np.int32), matrix)

    def flattened(self) -> Mesh:
        """Give the mesh back with every instance where it stands.

        Returns:
            `to_mesh().flattened()`, but that positions are float32 where there is no origin: of a lossless
            scene those of its source, flattened and rounded.

        Raises:
            LimitError: Where that has more faces than a mesh may have.
        """
        mesh = self.to_mesh().flattened()
        if self.origin is not None:
            return mesh
        return replace(mesh, positions=mesh.positions.astype(np.float32))

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
            `in_block_hierarchy`, `block_headers`, `top_level`, `remap`, `attributes` (materials too),
            `instances` (geometries too), `triangles` (plain ones), `hierarchy` (one that is not the default)
            and `container` (header, table, scene record, metadata, and what fills up words and sections);
            their sum is the file's length.
        """
        from striptools.reducem.writer import part_sizes

        return part_sizes(self)

    def bytes_per_triangle(self) -> float:
        """Say what a triangle costs: every byte of the file but the remap's and attributes', over them."""
        parts = self.part_bytes()
        beside = parts["remap"] + parts["attributes"]
        return (sum(parts.values()) - beside) / max(1, self.triangle_count)

    def attribute_bytes(self) -> dict[str, int]:
        """Count the bytes of each attribute in the file, by its name."""
        return {one.name: one.byte_count for one in self.columns}

    def with_attributes(self, mesh: Mesh, strips: Strips) -> "Scene":
        """The same scene with the attributes and materials of the mesh whose strips it holds."""
        if not mesh.attributes:
            return self
        columns = columns_of(mesh, strips, self.faces(), self.vertex_count)
        materials = mesh.materials if mesh.attribute("group") is not None else ()
        return replace(self, columns=columns, materials=materials)

    def resident_bytes_per_triangle(self) -> float:
        """Say what tracing without unpacking holds, over the triangles; 0 under another hierarchy.

        That is block data and nodes as a file with boxes stored has them, and what is worked out of headers
        and runs; neither the remap nor the few per cent by which arrays are rounded up that no file holds.
        """
        if self.hierarchy is not None:
            return 0.0
        return traced_bytes(self.blocks, self.with_boxes()) / max(1, self.triangle_count)


_FIELDS = frozenset(f.name for f in fields(Scene))


def _turned(one: Attribute, back: np.ndarray) -> Attribute:
    """An attribute with the corners of each triangle in another order."""
    if one.domain != "corner":
        return one
    corners = one.values.reshape(len(back), 3, one.values.shape[1])
    values = np.take_along_axis(corners, back[:, :, None], axis=1)
    return Attribute(one.name, "corner", values.reshape(one.values.shape))


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
    origin: Origin | None = None,
    geometries: SceneGeometries | None = None,
    instances: SceneInstances | None = None,
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
        origin: See `Scene`.
        geometries: See `Scene`.
        instances: See `Scene`.
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
        origin=origin,
        geometries=geometries,
        instances=instances,
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
    runs = described_runs(scene.blocks, first_run, runs, threads)
    return PackedNodes(np.concatenate([scene.packed.nodes, nodes]), top, first_run, runs, LONGEST_RUN)
