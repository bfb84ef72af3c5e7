"""A scene with instances laid out for the walk: each geometry once, and a hierarchy over where they stand.

What rays are moved by, and how far that puts them off, is computed here in float64; `walk_instances`
says why. Cost beside the geometries: 80 bytes an instance, about 40 of the nodes over them, and size classes;
150 more from when triangles are first asked for where they stand.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any

import numpy as np
from jax.sharding import Mesh
from jaxtyping import Bool, Float32, Float64, Int32, Int64

from striptools.errors import LimitError, UsageError
from striptools.hierarchies.rebuilt import rebuild
from striptools.hierarchies.wide import EMPTY, WideTree
from striptools.mesh.instances import Instances
from striptools.trace.box import MARGIN, REACH, U
from striptools.trace.counters import Counters
from striptools.trace.launch import GPU_TILES, split_over, stream_through
from striptools.trace.layout import Found, Layout, PacketView, Rays, blocks_of
from striptools.trace.leaves import LeafBlocks, aligned_full, lay_out_wide, scale_for, scale_of, size_class
from striptools.trace.packed import lay_out_packed
from striptools.trace.standing import Places
from striptools.trace.walk import DONE, WIDTH, Decode, Frame, WalkOptions
from striptools.trace.walk_instances import InstancedScene, trace_instances

if TYPE_CHECKING:
    from striptools.reducem.scene import Scene

MOST_SLIP = 0.25
"""The most of gamma_3 k + n for which rays are moved in float32: an instance more sheared is refused."""

UPRIGHT = 1 - 2.0**-12
"""The least l of `walk_points_instances` for which a geometry's boxes are looked at along its own axes."""

OTHER_SLIPS = 4 * U
"""Roundings of an instance's box."""


@dataclass(frozen=True, eq=False)
class InstanceNumbers:
    """How the triangles and faces of all instances are numbered, those of one after those of another.

    Attributes:
        geometry: (k,) int32, of each instance.
        first_triangle: (k,) int64, the first of `Scene.placed` of each.
        first_face: (k,) int64, the first face of the flattened source of each; triangles without a remap.
    """

    geometry: Int32[np.ndarray, " k"]
    first_triangle: Int64[np.ndarray, " k"]
    first_face: Int64[np.ndarray, " k"]

    @classmethod
    def of(cls, scene: "Scene") -> "InstanceNumbers":
        """Those of a scene with instances.

        Raises:
            LimitError: The triangles or faces of all instances are more than int32 can number.
        """
        assert scene.instances is not None
        assert scene.geometries is not None
        geometry = scene.instances.geometry.astype(np.int32)
        counts = np.diff(scene.spans.face_starts).astype(np.int64)[geometry]
        triangle = np.cumsum(counts) - counts
        face = triangle if scene.remap is None else scene.instances.first_face.astype(np.int64)
        last = int(face.max()) + int((counts if scene.remap is None else scene.geometries.face_count).max())
        if max(last, int(counts.sum())) > 2**31 - 1:
            raise LimitError("all instances have more than 2^31 - 1 triangles", remedy="split the scene")
        return cls(geometry, triangle, face)

    def instance_of(self, triangle: Int32[np.ndarray, " r"]) -> Int32[np.ndarray, " r"]:
        """The instance of each triangle; -1 where there is none."""
        found = np.searchsorted(self.first_triangle, triangle, side="right").astype(np.int32) - np.int32(1)
        return np.where(triangle < 0, np.int32(-1), found)


@dataclass(frozen=True, eq=False)
class Moves:
    """How rays are moved into the frames of geometries.

    Attributes:
        matrices: (k, 3, 4) float32, from the scaled scene to the scaled geometry.
        slips: (k,) float64, how far a hit may be from the ray, in units of the largest coordinate of ray
            origin and scene: f of `walk_instances`; infinite where float32 will not do.
        boxes: (k, 6) float64, of the instances, scaled.
        scale: Of the scene, a power of two.
        reach: The largest scaled coordinate of the scene.
    """

    matrices: Float32[np.ndarray, "k 3 4"]
    slips: Float64[np.ndarray, " k"]
    boxes: Float64[np.ndarray, "k 6"]
    scale: np.float32
    reach: float

    @property
    def sound(self) -> Bool[np.ndarray, " k"]:
        """(k,) bool: which instances float32 can be trusted with."""
        return np.isfinite(self.slips)


@dataclass(frozen=True, eq=False)
class InstancedLayout:
    """What a tracer keeps of a scene with instances.

    Attributes:
        arrays: For the device, as NumPy arrays.
        geometries: All geometries, each in its own frame.
        depth: The most nodes on a way from a root down, of instances or of a geometry.
        numbers: What hits are called.
        first_triangle: (g+1,) int64, the first triangle in file order of each geometry, then all.
        first_face: (g,) int64, its first source face; triangle without a remap.
        instances: As the scene has them.
        slips: (k,) float32, f of `walk_instances`.
        in_place: Whether rays meet triangles where they stand, and are not moved for them.
    """

    arrays: InstancedScene
    geometries: Layout
    depth: int
    numbers: InstanceNumbers
    first_triangle: np.ndarray
    first_face: np.ndarray
    instances: Instances
    slips: np.ndarray
    in_place: bool = False

    @cached_property
    def mirrored(self) -> Bool[np.ndarray, " k"]:
        """(k,) bool, which instances turn the winding of faces."""
        return self.instances.mirrored

    @cached_property
    def places(self) -> Places:
        """What triangles are placed by where they are asked for where they stand; counted from then on."""
        if self.arrays.places is not None:
            return self.arrays.places
        size, numbers, scale = len(self.arrays.roots), self.numbers, float(self.arrays.frame.scale)
        matrix = self.instances.matrix * scale
        matrix[:, :, :3] /= float(self.geometries.arrays.frame.scale)
        return Places(
            _padded(matrix.view(np.int32).reshape(-1, 3, 4, 2), size),
            _padded(self.mirrored, size),
            _padded((numbers.first_face - self.first_face[numbers.geometry]).astype(np.int32), size),
            _padded(self.slips, size),
            _padded(stretch_bounds(matrix), size),
        )

    @property
    def decode(self) -> Decode | None:
        """How leaves are decoded, where they are packed."""
        return self.geometries.decode

    @property
    def root(self) -> tuple[np.ndarray, np.ndarray]:
        """The boxes of the root's children, which are not widened yet, and the children."""
        node = self.arrays.nodes[0]
        return node[:6], node[6].view(np.int32)

    @property
    def seen_by_packets(self) -> PacketView | None:
        """Packets are not walked here."""
        return None

    @property
    def missed(self) -> Counters:
        """No ray is dropped before its walk."""
        return Counters(0, 0, 0, 0, 0, 0)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        arrays = self.arrays
        above = (arrays.nodes, arrays.matrices, arrays.roots, arrays.reaches, self.numbers.geometry)
        above = (*above, self.numbers.first_triangle, self.numbers.first_face, self.slips)
        above = (*above, *(arrays.places or self.__dict__.get("places") or ()))
        return sum(a.nbytes for a in above) + self.geometries.nbytes

    @property
    def shared_bytes(self) -> int:
        """Those of the geometries."""
        return self.geometries.shared_bytes

    def named(
        self, names: np.ndarray, instance: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Faces and triangles of the flattened scene, and turns of corners where they stand."""
        assert instance is not None
        own_face, own_triangle, turns = self.geometries.named(names)
        turns = np.where(self.mirrored[instance], (3 - turns) % 3, turns)
        return *self._flattened(own_face, own_triangle, instance), turns

    def _flattened(
        self, own_face: np.ndarray, own_triangle: np.ndarray, instance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Faces and triangles of the flattened scene from those of geometries."""
        geometry, numbers = self.numbers.geometry[instance], self.numbers
        face = own_face + (numbers.first_face[instance] - self.first_face[geometry])
        triangle = own_triangle + (numbers.first_triangle[instance] - self.first_triangle[geometry])
        return face.astype(np.int32), triangle.astype(np.int32)

    def stream(
        self, scene: Any, rays: Rays, mesh: Mesh, options: WalkOptions
    ) -> Iterator[tuple[slice, tuple[np.ndarray, ...]]]:
        """Trace any number of rays; yield slices of them and results, in order."""
        yield from stream_through(instances_program(mesh, options), scene, rays, mesh, GPU_TILES)

    def corners_of(
        self, names: np.ndarray, instance: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """See `layout.Layout`; corners where they stand, as `standing` places them."""
        assert instance is not None
        own, turns = self.geometries.corners_of(names)
        matrix = self.places.matrices.view(np.float64)[instance, :, :, 0, None]
        x, y, z = (own[:, None, axis].astype(np.float64) for axis in range(3))
        placed = ((matrix[:, :, 0] * x + matrix[:, :, 1] * y) + matrix[:, :, 2] * z) + matrix[:, :, 3]
        corners = placed.astype(np.float32)
        corners[np.abs(corners) < np.finfo(np.float32).tiny] = 0
        mirrored = self.mirrored[instance]
        corners[mirrored] = corners[mirrored][:, :, [0, 2, 1]]
        turns = np.where(mirrored, (3 - turns) % 3, turns)
        first = _first_corners(corners)
        order = (np.arange(3) + first[:, None]) % 3
        return np.take_along_axis(corners, order[:, None], axis=2), ((turns + first) % 3).astype(np.int32)

    def names(self) -> np.ndarray:
        """See `layout.Layout`: of the triangles of geometries, which stand in several places."""
        return self.geometries.names()

    def corner_blocks(self, most: int) -> Iterator[np.ndarray]:
        """See `layout.Layout`: placed, instance by instance."""
        names, numbers = self.names(), self.numbers
        end = int(numbers.first_triangle[-1] + np.diff(self.first_triangle)[numbers.geometry[-1]])
        for first in range(0, end, most * WIDTH):
            triangle = np.arange(first, min(end, first + most * WIDTH))
            instance = numbers.instance_of(triangle)
            own = (
                triangle - numbers.first_triangle[instance] + self.first_triangle[numbers.geometry[instance]]
            )
            yield blocks_of(self.corners_of(names[own], instance)[0])

    def weigh(self, rays: Rays, at: np.ndarray, traced: tuple[np.ndarray, ...], found: Found) -> None:
        """Fill in what was found of the rays `at`: t, face, u, v and triangle of the flattened scene."""
        t, face, u, v, triangle = found
        hit = np.flatnonzero(traced[4] >= 0)
        t[at] = traced[0]
        rows, names, instance = at[hit], traced[1][hit], traced[4][hit]
        face[rows], triangle[rows], _ = self.named(names, instance)
        if len(u):
            weights = self._weights_in_place if self.in_place else self._weights_moved
            u[rows], v[rows] = weights((rays[0][rows], rays[1][rows], rays[2][rows]), names, instance)

    def _weights_moved(
        self, rays: Rays, names: np.ndarray, instance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """U and v of rays that hit these triangles, as they are moved into their geometries."""
        u, v = _weights_by(self.geometries, (*self.moved(rays[0], rays[1], instance), rays[2]), names)
        turned = self.mirrored[instance]
        return np.where(turned, v, u), np.where(turned, u, v)

    def _weights_in_place(
        self, rays: Rays, names: np.ndarray, instance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """The same of rays that are not moved, and of triangles where they stand."""
        corners, turns = self.corners_of(names, instance)
        count = len(names)
        place = np.arange(count, dtype=np.int32) * 4 + turns
        held = LeafBlocks(blocks_of(corners), place, np.zeros(0, np.int32), self.arrays.frame.scale)
        return _weights_by(held, rays, np.arange(count, dtype=np.int32))

    def moved(
        self, origins: np.ndarray, directions: np.ndarray, instance: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Rays in the frames of the geometries that they hit, as the walk moves them, and not scaled."""
        matrix = self.arrays.matrices[instance]
        with np.errstate(all="ignore"):
            _, exponent = np.frexp(np.abs(directions).max(axis=1, initial=0))
            shortened = np.ldexp(directions, 1 - exponent[:, None])
            origin = _turned(matrix, origins * self.arrays.frame.scale) + matrix[:, :, 3]
            scale = self.geometries.arrays.frame.scale
            return origin / scale, _turned(matrix, shortened)


def _weights_by(layout: Layout | LeafBlocks, rays: Rays, names: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """U and v of rays that hit what is so named in a layout."""
    count = len(names)
    t, u, v = np.zeros((3, count), np.float32)
    face, triangle = np.zeros((2, count), np.int32)
    layout.weigh(rays, np.arange(count, dtype=np.int32), (t, names), (t, face, u, v, triangle))
    return u, v


def _first_corners(corners: np.ndarray) -> np.ndarray:
    """(k,): which corner of (k, 3, 3), a row an axis, is the least by (x, y, z), the first of equals."""
    rows, first = np.arange(len(corners)), np.zeros(len(corners), np.int64)
    for j in (1, 2):
        here, there = corners[rows, :, first], corners[:, :, j]
        axis = (here != there).argmax(axis=1)
        first = np.where(there[rows, axis] < here[rows, axis], j, first)
    return first


def _turned(matrix: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """As `walk_instances.moved` does it."""
    x, y, z = (matrix[:, :, axis] * vectors[:, axis : axis + 1] for axis in range(3))
    return (x + y) + z


@lru_cache(maxsize=16)
def instances_program(mesh: Mesh, options: WalkOptions) -> Any:
    """The jitted function from a scene and rays to `InstancesTraced`, the rays split over the devices."""
    return split_over(mesh, partial(trace_instances, options=options), 3)


def lay_out_instanced(
    scene: "Scene", threads: int = 1, *, compressed: bool = False, in_place: bool = False
) -> InstancedLayout:
    """Lay a scene with instances out, each geometry once.

    Args:
        scene: A scene with instances.
        threads: Threads to build with.
        compressed: Keep the blocks as they lie, under the hierarchy of the file; else geometries are
            expanded, under new hierarchies.
        in_place: See `InstancedLayout`.

    Raises:
        UsageError: An instance is so sheared, so small or so far from its geometry's origin that float32
            does not tell where a ray is in it.
        LimitError: As of `InstanceNumbers.of`.
    """
    assert scene.instances is not None
    assert scene.geometries is not None
    numbers, boxes = InstanceNumbers.of(scene), geometry_boxes(scene)
    moves = moves_of(scene, boxes)
    wrong = np.flatnonzero(~moves.sound)
    if len(wrong):
        raise UsageError(
            f"instance {wrong[0]} is too distorted for its geometry to be shared",
            where="instances",
            remedy="use instances flattened",
        )
    geometries, roots = (_packed if compressed else _expanded)(scene, threads)
    wide, nodes = _nodes(moves, threads)
    scale = float(geometries.arrays.frame.scale)
    reaches = np.abs(boxes).max(axis=1) * scale
    if compressed:
        # Planes of packed boxes are counted from the scene's low, whatever the geometry.
        reaches[:] = float(geometries.arrays.frame.reach)
    geometry, size = numbers.geometry, size_class(len(scene.instances))
    starts = scene.spans.face_starts.astype(np.int64)
    first_face = starts[:-1] if scene.remap is None else scene.geometries.first_face
    zero, one = np.zeros(3, np.float32), np.ones(3, np.float32)
    arrays = InstancedScene(
        nodes,
        _padded(moves.matrices, size),
        _padded(roots[geometry].astype(np.int32), size),
        _padded(reaches[geometry].astype(np.float32), size),
        Frame(moves.scale, np.float32(moves.reach), zero, one, MARGIN),
        geometries.arrays,
    )
    layout = InstancedLayout(
        arrays,
        geometries,
        max(wide.depth, geometries.depth),
        numbers,
        starts,
        first_face,
        scene.instances.placed,
        (moves.slips * (1 + 2 * U)).astype(np.float32),
        in_place,
    )
    return replace(layout, arrays=arrays._replace(places=layout.places)) if in_place else layout


def geometry_boxes(scene: "Scene") -> Float64[np.ndarray, "g 6"]:
    """The box of each geometry, in its own frame."""
    spans, positions = scene.spans, scene.positions
    parts = [positions[spans.vertices(g)].astype(np.float64) for g in range(len(spans))]
    return np.array([np.concatenate([part.min(axis=0), part.max(axis=0)]) for part in parts])


def moves_of(scene: "Scene", geometry_boxes: Float64[np.ndarray, "g 6"]) -> Moves:
    """How rays are moved into the geometries of a scene; names are those of `walk_instances`, Boxes."""
    assert scene.instances is not None
    geometry, matrix = scene.instances.geometry, scene.instances.matrix
    inner = float(scale_of(scene))
    low, high = geometry_boxes[geometry, :3], geometry_boxes[geometry, 3:]
    middle = np.einsum("kij,kj->ki", matrix[:, :, :3], (low + high) / 2) + matrix[:, :, 3]
    half = np.einsum("kij,kj->ki", np.abs(matrix[:, :, :3]), (high - low) / 2)
    boxes = np.concatenate([middle - half, middle + half], axis=1)
    scale = scale_for(float(np.abs(boxes).max()))
    boxes, reach = boxes * float(scale), float(np.abs(boxes).max() * float(scale))
    with np.errstate(all="ignore"):
        a, b = matrix[:, :, :3] * (float(scale) / inner), matrix[:, :, 3] * float(scale)
        inverse = _inverted(a)
        w3, w = inverse.astype(np.float32), -np.einsum("kij,kj->ki", inverse, b)
        matrices = np.concatenate([w3, w.astype(np.float32)[:, :, None]], axis=2)
        extent = np.abs(geometry_boxes).max(axis=1)[geometry] * inner
        slips = _slips(a, b, matrices.astype(np.float64), extent, reach)
    slips[~np.isfinite(matrices).all(axis=(1, 2))] = np.inf
    return Moves(matrices, slips, boxes, scale, reach)


def _inverted(a: np.ndarray) -> np.ndarray:
    """The inverse of each matrix; infinite where float64 finds none."""
    try:
        return np.linalg.inv(a)
    except np.linalg.LinAlgError:
        flat = np.linalg.det(a) == 0
        found = np.full_like(a, np.inf)
        found[~flat] = np.linalg.inv(a[~flat])
        return found


def _slips(
    a: np.ndarray, b: np.ndarray, matrices: np.ndarray, extent: np.ndarray, reach: float
) -> np.ndarray:
    """(k,) f of each instance, infinite where it is no bound; `extent`: the largest coordinate of each's."""

    def row_sum(m: np.ndarray) -> np.ndarray:
        return m.sum(axis=2).max(axis=1)

    w3, w = matrices[:, :, :3], matrices[:, :, 3]
    size = np.abs(a) @ np.abs(w3)
    k, n = row_sum(size), row_sum(np.abs(a @ w3 - np.eye(3)) + size * 2.0**-50)
    h = np.einsum("kij,kj->ki", np.abs(a), np.abs(w)).max(axis=1) / reach
    r = np.abs(np.einsum("kij,kj->ki", a, w) + b).max(axis=1) / reach + h * 2.0**-50
    gamma_3, gamma_4 = 3 * U / (1 - 3 * U), 4 * U / (1 - 4 * U)
    slip = gamma_3 * k + n
    off = (gamma_4 * k + n + 2 * slip + gamma_4 * h + r) / (1 - slip)
    test = REACH * (k + h + row_sum(np.abs(a)) * extent / reach)
    return np.where(slip < MOST_SLIP, (off + test + OTHER_SLIPS) * (1 + 2.0**-10), np.inf)


def stretch_bounds(places: Float64[np.ndarray, "k 3 4"]) -> Float32[np.ndarray, "k 3 4"]:
    """Axes of each geometry, and how much each is stretched along them at least (`walk_points_instances`).

    In three rows for each: an axis v, and w. Of any vector y of the geometry what it becomes is no shorter
    than that of the lengths w (v . y).
    """
    matrix = places[:, :, :3]
    axes = np.tile(np.eye(3, dtype=np.float32), (len(matrix), 1, 1))
    least, length = _stretches(matrix)
    sheared = np.flatnonzero(least < UPRIGHT)
    if len(sheared):
        axes[sheared] = np.linalg.svd(matrix[sheared])[2].astype(np.float32)
        least[sheared], length[sheared] = _stretches(
            matrix[sheared] @ np.linalg.inv(axes[sheared].astype(np.float64))
        )
    stretch = np.sqrt(np.maximum(least, 0))[:, None] * length * (1 - 2.0**-20)
    return np.concatenate([axes, stretch[:, :, None].astype(np.float32)], axis=2)


def _stretches(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Of the columns of matrices (k, 3, 3): l of `walk_points_instances`, no more than it is, and lengths."""
    length = np.linalg.norm(matrix, axis=1)
    upright = matrix / length[:, None, :]
    return np.linalg.eigvalsh(np.swapaxes(upright, 1, 2) @ upright)[:, 0] - 2.0**-40, length


def _expanded(scene: "Scene", threads: int) -> tuple[Layout, np.ndarray]:
    """All geometries expanded, each under a new hierarchy, and the root of each."""
    boxes, spans = scene.triangle_boxes(threads), scene.spans
    trees, orders = [], []
    for g in range(len(spans)):
        part = spans.faces(g)
        tree, order = rebuild(boxes[part], threads)
        trees.append(tree)
        orders.append(order + np.int32(part.start))
    wide, roots = joined_trees(trees)
    return lay_out_wide(scene, wide, np.concatenate(orders)), roots


def joined_trees(trees: list[WideTree]) -> tuple[WideTree, np.ndarray]:
    """Hierarchies one after another, over places one after another, and the root of each."""
    nodes = np.cumsum([0, *(len(tree.child) for tree in trees)])
    leaves = np.cumsum([0, *(len(tree.leaf_first) for tree in trees)])
    places = np.cumsum([0, *(int(tree.leaf_count.sum()) for tree in trees)])
    child = [
        np.where(tree.child == EMPTY, EMPTY, tree.child + np.where(tree.child >= 0, node, -leaf))
        for tree, node, leaf in zip(trees, nodes, leaves, strict=False)
    ]
    first = [tree.leaf_first + place for tree, place in zip(trees, places, strict=False)]
    wide = WideTree(
        np.concatenate([tree.boxes for tree in trees]),
        np.concatenate(child).astype(np.int32),
        np.concatenate(first).astype(np.int32),
        np.concatenate([tree.leaf_count for tree in trees]),
        max(tree.depth for tree in trees),
    )
    return wide, nodes[:-1]


def _packed(scene: "Scene", threads: int) -> tuple[Layout, np.ndarray]:
    """All geometries as they lie in their file, and the root of each."""
    layout, roots = lay_out_packed(scene, threads), scene.roots
    over = np.diff(roots.tops) > 0
    root = np.where(over, roots.tops[:-1], scene.packed.top_count + roots.blocks[:-1])
    # Only the first root's depth was counted as one.
    return replace(layout, depth=layout.depth + 1), root


def _nodes(moves: Moves, threads: int) -> tuple[WideTree, np.ndarray]:
    """The hierarchy over instances, and its nodes as the walk reads them."""
    boxes = moves.boxes.astype(np.float32)
    wide, order = rebuild(boxes, threads, leaf_size=1)
    instance = order[wide.leaf_first]
    leaf = (wide.child < 0) & (wide.child != EMPTY)
    child = wide.child.copy()
    child[leaf] = -(instance[-(wide.child[leaf] + 1)] + 1)
    count = len(child)
    nodes = aligned_full((size_class(count + 1), 8, WIDTH), np.nan)
    np.copyto(nodes[:count, :6], wide.boxes, where=(child != EMPTY)[:, None])
    children = nodes[:, 6].view(np.int32)
    children[:] = DONE
    children[:count] = np.where(child == EMPTY, DONE, child)
    nodes[:, 7] = 0
    nodes[:count, 7][leaf] = moves.slips[-(child[leaf] + 1)] * (1 + 2 * U)
    for node in np.flatnonzero((child >= 0).any(axis=1))[::-1]:
        inner = child[node] >= 0
        nodes[node, 7, inner] = nodes[child[node, inner], 7].max(axis=1)
    return wide, nodes


def _padded(values: np.ndarray, size: int) -> np.ndarray:
    """The values with zeros behind them."""
    padded = np.zeros((size, *values.shape[1:]), values.dtype)
    padded[: len(values)] = values
    return padded
