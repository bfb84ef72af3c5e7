"""The tracer: rays in, closest hits or any hits out."""

import math
import os
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, Literal, get_args

import jax
import numpy as np
from jaxtyping import Bool, Float32, Int32

from striptools.errors import UsageError
from striptools.kernels.weighing import mark_hits
from striptools.kernels.wide import BROAD, WIDTH
from striptools.threads import in_chunks
from striptools.trace.alternatives import lay_out_alternative
from striptools.trace.closest import closest_points, nothing_closest
from striptools.trace.containment import ContainKind, rays_from, winding_numbers
from striptools.trace.counters import KINDS, counters_of
from striptools.trace.device import DeviceKind, core_count, quiet_jax, trace_devices
from striptools.trace.gathering import all_hits, check_ended, counts
from striptools.trace.hit import AllHits, ClosestPoints, Hits
from striptools.trace.instanced import InstancedLayout, InstanceNumbers, lay_out_instanced
from striptools.trace.launch import device_mesh, replicate, stream, tried
from striptools.trace.layout import Found, Layout, Rays
from striptools.trace.leaves import WideLayout, lay_out, lay_out_rebuilt
from striptools.trace.memory import EXPANDED_BYTES, free_memory
from striptools.trace.packed import lay_out_packed
from striptools.trace.streams import Station, Take, stations_of, trace_ready
from striptools.trace.walk import MISS, WalkOptions
from striptools.trace.walk_gather import GatherKind
from striptools.trace.walk_packed import PackedScene
from striptools.trace.walk_points import PointOptions
from striptools.trace.walk_wide import WideScene
from striptools.trace.weighing import weigh_in_double, weights_inside
from striptools.types import TriangleTest

if TYPE_CHECKING:
    from striptools.reducem.scene import Scene

HierarchyKind = Literal["stored", "rebuilt"]
ResidentKind = Literal["auto", "expanded", "compressed"]
InstancesKind = Literal["auto", "flattened", "shared"]

RAYS_SIDE_BY_SIDE = 2
"""Rays that a CPU walks at once; more gain nothing, since their constants no longer fit the registers."""


class Tracer:
    """Traces rays through one scene.

    Rays are given as origins and directions, (r, 3) and convertible to float32; directions need not be of
    unit length, and t counts in lengths of the direction. A hit has 0 < t < t_max. The closest hit is that
    of least t, then of least source face. A ray with a component that is not finite, or with a direction of
    zero, hits nothing.

    Numbers below 2**-126 count as zero, in origins and in directions. A hit whose t, or whose unit of t (the
    size of the scene over that of the direction), is beyond float32's normal range is told at the end of the
    range, 2**-126 or the largest number. Origins beyond 2**40 times the largest coordinate of the scene get
    some finite answer. Everything else is within the bound of `measure.bound`.

    Hits are the same whatever the hierarchy, residency or packets, bit for bit, but where rounding puts a hit
    outside its triangle's own box: on slivers seen obliquely, and on triangles so small, 2**-49 of the scene,
    that products underflow. There another path may miss it (`measure.bound`, term 9).

    Rays are in the frame of the scene's positions. Where the scene has an origin (`origin`, for sources in
    float64 far from zero) that is the frame about it: take the origin from those of the rays, in float64,
    before; t, u and v are the same in both.

    In a scene with instances a hit's face is that of the flattened source (`Mesh.flattened` of the mesh that
    was converted), its triangle one of `scene.placed()`; instance, geometry and the face within it are told
    beside. "shared" keeps each geometry once and moves rays into its frame: inside each instance as
    watertight, and t is that of the moved ray, which float32 puts off a little (`walk_instances`). What is
    asked by another triangle test, and closest points, are the bits of the flattened scene: triangles are
    put where they stand as they are met (`standing`). Where geometries are expanded, `hierarchy` is always
    rebuilt.

    A scene under a hierarchy of its own (SLBVH, kd-tree, presorted, loose octree) is walked through that for
    closest and any hits. All other queries go through wide nodes, rebuilt on the first of them, and so they
    do where "rebuilt" has put large triangles into several leaves, since these are to be counted once: that
    call takes as long as a tracer with `hierarchy` "rebuilt", and `resident_bytes` counts both from then on.

    The first call for a number of rays not met before compiles a program (seconds); it is kept in the
    user's cache folder for the next process.

    Args:
        scene: What to trace.
        device: "auto" takes a GPU where JAX has one. A kernel walks the rays there; where it cannot be
            compiled, a `SlowTracingWarning` says why, and its plain-JAX twin walks them, with the same hits.
        threads: CPU devices to use, at most those JAX has; None for all.
        hierarchy: "stored" walks the hierarchy that the scene holds; "rebuilt" makes a new one over single
            triangles first, which takes longer to build, is faster to walk, most where triangles are of very
            different sizes, and is expanded. Hits are the same.
        resident: "expanded" keeps boxes and corners as float32, 65 bytes a triangle and more; "compressed"
            keeps the blocks as they are, 9 to 11 bytes and 5 of the remap, and decodes triangles where they
            are tested, which is slower. Where the scene holds its boxes ("stored"), a CPU uses nodes, block
            data and remap where the file is mapped and copies none of it; the price is a program of its own
            for each such scene. Hits are the same. "auto" expands what fits in `memory_budget`.
        memory_budget: Bytes that an expanded scene may take with "auto"; None for a quarter of the memory
            that is free on the device, or on this machine where the device does not tell.
        instances: "flattened" expands the triangles of every instance where it stands; "shared" keeps each
            geometry once. "auto" flattens what fits in `memory_budget`, and shares where it does not or where
            `resident` is compressed.
        test: How a ray and a triangle are tested (`trace.triangle_tests`; bounds in `measure.bound`):
            "watertight" lets no ray slip through a closed surface, and counts as hit what is as near to it as
            float32 rounds; "fast" is Moeller and Trumbore's, which leaks; "exact-sign" hits exactly what
            exact arithmetic would, edges and corners included, t as of "watertight"; "float64" tests in
            float64, and rounds t, u and v to float32 last. Tests other than the default one go through
            wide nodes only, without packets and without a kernel, rebuilt where the scene is under a
            hierarchy of its own; `contains` asks the default one.

    Raises:
        UsageError: There is no such device, hierarchy, residency or test, or not both of them together; or
            instances are to be shared of which one is too distorted for float32.
        LimitError: All instances have more triangles than a mesh may have, or, shared, than int32 can number;
            or the scene has no coordinate of 2**-126 or more.
    """

    def __init__(
        self,
        scene: "Scene",
        *,
        device: DeviceKind = "auto",
        threads: int | None = None,
        hierarchy: HierarchyKind = "stored",
        resident: ResidentKind = "auto",
        memory_budget: int | None = None,
        instances: InstancesKind = "auto",
        test: TriangleTest = "watertight",
    ) -> None:
        _check_kinds(hierarchy, resident, instances)
        _check_test(test)
        self._test: TriangleTest = test
        devices = self._choose(device, threads)
        self._origin = np.zeros(3) if scene.origin is None else np.array(scene.origin, np.float64)
        budget = free_memory(devices[0]) // 4 if memory_budget is None else memory_budget
        self._shared = _shares(scene, instances, resident, budget)
        if scene.instances is not None and not self._shared:
            resident, hierarchy = _of_flattened(resident), "rebuilt"
        if scene.hierarchy is not None:
            resident = _of_alternative(resident)
            hierarchy = hierarchy if test == "watertight" else "rebuilt"
        if resident == "auto":
            fits = hierarchy == "rebuilt" or EXPANDED_BYTES * scene.triangle_count <= budget
            resident = "expanded" if fits else "compressed"
        self._resident: ResidentKind = resident
        self._empty = scene.triangle_count == 0
        self._numbers = None if scene.instances is None else InstanceNumbers.of(scene)
        if not self._empty:
            self._take(self._laid_out(scene, hierarchy, self._builders(threads)))
        beside = not self._empty and not self._shared and not self._has_each_once
        self._rebuild = partial(self._with_each_once, scene, device, threads) if beside else None

    @property
    def _has_each_once(self) -> bool:
        """Whether what is walked is wide nodes that have each triangle in one leaf."""
        layout = self._layout
        return isinstance(layout.arrays, PackedScene) or (
            isinstance(layout, WideLayout) and not layout.repeats
        )

    def _with_each_once(self, scene: "Scene", device: DeviceKind, threads: int | None) -> "Tracer":
        """A tracer of wide nodes that have each triangle in one leaf."""
        layout = lay_out_rebuilt(scene.placed(), self._builders(threads), once=True, width=self._width)
        return Tracer.of_layout(layout, device=device, threads=threads, test=self._test)

    @classmethod
    def of_layout(
        cls,
        layout: Layout,
        *,
        device: DeviceKind = "auto",
        threads: int | None = None,
        test: TriangleTest = "watertight",
    ) -> "Tracer":
        """A tracer of what is laid out already, expanded: for studies of hierarchies that no scene holds."""
        tracer = cls.__new__(cls)
        tracer._choose(device, threads)
        tracer._origin = np.zeros(3)
        tracer._resident, tracer._empty = "expanded", False
        tracer._shared, tracer._numbers = False, None
        tracer._test, tracer._rebuild = test, None
        tracer._take(layout)
        return tracer

    _rebuild: Callable[[], "Tracer"] | None
    """Makes the tracer of wide nodes that have each triangle in one leaf; none of a layout alone."""

    def _choose(self, device: DeviceKind, threads: int | None) -> list[Any]:
        """Take the devices to trace on."""
        devices = trace_devices(device, threads)
        self._on_gpu = self._kernel = devices[0].platform != "cpu"
        self._mesh = device_mesh(devices)
        self._weighers = (threads or core_count(os.environ)) if self._on_gpu else 1
        return devices

    def _laid_out(self, scene: "Scene", hierarchy: HierarchyKind, threads: int) -> Layout:
        if scene.hierarchy is not None and hierarchy == "stored":
            return lay_out_alternative(scene, scene.hierarchy, threads)
        if self._shared:
            compressed, in_place = self._resident == "compressed", self._test != "watertight"
            return lay_out_instanced(scene, threads, compressed=compressed, in_place=in_place)
        if self._resident == "compressed":
            return lay_out_packed(scene, threads)
        if hierarchy == "stored":
            return lay_out(scene, threads)
        return lay_out_rebuilt(scene.placed(), threads, width=self._width)

    @property
    def _width(self) -> int:
        """Children of a node of a hierarchy that is made here: 16 on a CPU, 8 for a GPU's kernel."""
        return WIDTH if self._on_gpu else BROAD

    def _builders(self, threads: int | None) -> int:
        """Threads to build with: as many as trace on a CPU; beside a GPU, two unless one was asked for."""
        return min(2, threads or 2) if self._on_gpu else self._mesh.size

    def _take(self, layout: Layout) -> None:
        self._layout: Layout = layout
        self._scene: Any = replicate(layout.arrays, self._mesh)
        for name in ("_standing", "_stations"):
            self.__dict__.pop(name, None)
        self._stack_size = max(16, 2 ** math.ceil(math.log2(layout.depth + 2)))

    @cached_property
    def _standing(self) -> Any:
        """The scene on the devices; of shared instances where they stand, too."""
        if not isinstance(self._layout, InstancedLayout):
            return self._scene
        places: Any = self._layout.places
        return self._scene._replace(places=replicate(places, self._mesh))

    @property
    def devices(self) -> list[Any]:
        """The JAX devices in use."""
        return list(self._mesh.devices.flat)

    @property
    def origin(self) -> np.ndarray:
        """(3,) float64: where the zero of the rays' frame lies in the source's; zeros where they are one."""
        return self._origin.copy()

    @property
    def resident(self) -> ResidentKind:
        """How the scene is kept: "expanded" or "compressed"."""
        return self._resident

    @property
    def instances(self) -> InstancesKind | None:
        """How instances are kept: "flattened" or "shared"; None where the scene has none."""
        return None if self._numbers is None else "shared" if self._shared else "flattened"

    @property
    def resident_bytes(self) -> int:
        """Bytes of all arrays kept for tracing; a GPU keeps the nodes of a compressed scene as bytes too."""
        shared = self._layout.shared_bytes if self._on_gpu and not self._empty else 0
        own = 0 if self._empty else self._layout.nbytes + shared
        beside = self.__dict__.get("_rebuilt")
        return own + (0 if beside is None else beside.resident_bytes)

    def closest_hit(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        *,
        t_max: np.ndarray | float | None = None,
        counters: bool = False,
        packets: bool = True,
        weights: bool = True,
    ) -> Hits:
        """Find what each ray hits first.

        Args:
            origins: (r, 3) in the model's unit.
            directions: (r, 3).
            t_max: (r,) or one for all: only hits nearer than this count; None for any distance.
            counters: Count what each ray visits, tests and reads (a program of its own, somewhat slower).
            packets: Walk rays that go the same way in packets, on a CPU, where they are found side by side, a
                quarter of all or more: those of a camera or towards a light. Hits are the same. Not of other
                tests than the default.
            weights: Tell u and v; without them each is None, and hits are not weighed on this side.

        Raises:
            UsageError: The arrays are not of these shapes, or not numbers.
            StriptoolsError: A walk did not end, since the scene's hierarchy is damaged.
        """
        rays = checked_rays(origins, directions, t_max)
        count = len(rays[0])
        t, (u, v) = np.full(count, np.inf, np.float32), np.zeros((2, count if weights else 0), np.float32)
        face, triangle = np.full(count, MISS), np.full(count, MISS)
        dropped = np.zeros(count, np.uint8)
        visits = np.zeros((count if counters else 0, KINDS), np.int32)
        found = (t, face, u, v, triangle)
        options = self._options(counting=counters)

        def take(at: np.ndarray, traced: tuple[np.ndarray, ...]) -> None:
            check_ended(traced[1])
            if counters:
                visits[at] = traced[2]
            self._weigh(rays, at, traced, found)

        self._trace(rays, dropped, options, take, packets=packets)
        if counters:
            visits[dropped == 1] = self._layout.missed if not self._empty else 0
        counted = counters_of(visits) if counters else None
        told = (t, face, u, v, triangle) if weights else (t, face, None, None, triangle)
        return Hits(*told, counted, *_instances_of(self._numbers, face, triangle))

    def _weigh(self, rays: Rays, at: np.ndarray, traced: tuple[np.ndarray, ...], found: Found) -> None:
        """Fill in what was found of the rays `at`; beside a GPU all cores are free for it."""

        def weigh(part: tuple[int, int]) -> None:
            mine = slice(*part)
            mine_traced = tuple(a[mine] if len(a) == len(at) else a for a in traced)
            self._weighed(rays, at[mine], mine_traced, found)

        in_chunks(weigh, len(at), self._weighers)

    def _weighed(self, rays: Rays, at: np.ndarray, traced: tuple[np.ndarray, ...], found: Found) -> None:
        """Fill in what was found of the rays `at`, weights by the precision of the test."""
        t, face, u, v, triangle = found
        in_double = len(u) > 0 and self._test in ("exact-sign", "float64")
        told = (t, face, u[:0], v[:0], triangle) if in_double else found
        self._layout.weigh(rays, at, traced, told)
        if in_double:
            weigh_in_double(self._layout, rays, at, traced, found)
        elif len(u) > 0 and self._test == "fast":
            weights_inside(at, found)

    def _trace(
        self,
        rays: Rays,
        dropped: np.ndarray,
        options: WalkOptions | None,
        take: Take,
        *,
        packets: bool = False,
    ) -> None:
        """Trace rays, and have what is found taken."""
        if options is None:
            return
        layout = self._layout
        if not options.batch and not isinstance(layout, InstancedLayout):
            plain = not options.counting and options.test == "watertight"
            in_packets = packets and plain and layout.seen_by_packets is not None
            trace_ready(self._stations, layout, rays, dropped, options, in_packets, take)
            return
        streamed = layout.stream if isinstance(layout, InstancedLayout) else stream
        for part, traced in streamed(self._scene, rays, self._mesh, options):
            take(np.arange(part.start, part.stop, dtype=np.int32), traced)

    @cached_property
    def _stations(self) -> list[Station]:
        """Each CPU device on its own."""
        return stations_of(self._scene, self._mesh)

    def any_hit(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        *,
        t_max: np.ndarray | float | None = None,
        packets: bool = True,
    ) -> Bool[np.ndarray, " r"]:
        """Say of each ray whether it hits anything; arguments and errors as for `closest_hit`."""
        rays = checked_rays(origins, directions, t_max)
        hit = np.zeros(len(rays[0]), np.bool_)
        dropped = np.zeros(len(rays[0]), np.uint8)

        def take(at: np.ndarray, traced: tuple[np.ndarray, ...]) -> None:
            check_ended(traced[1])
            mark_hits(at, traced[1], hit)

        self._trace(rays, dropped, self._options(any_hit=True), take, packets=packets)
        return hit

    def all_hits(
        self, origins: np.ndarray, directions: np.ndarray, *, k: int, t_max: np.ndarray | float | None = None
    ) -> AllHits:
        """Find the first k things that each ray hits, by t and then by face.

        The first is the closest hit. Programs are compiled for powers of two.

        Args:
            origins: (r, 3) in the model's unit.
            directions: (r, 3).
            k: 1 to 1024.
            t_max: As for `closest_hit`.

        Raises:
            UsageError: As for `closest_hit`, or k is out of range.
            StriptoolsError: As for `closest_hit`.
        """
        rays, asked = checked_rays(origins, directions, t_max), self._gatherer()
        found = all_hits(asked._gather, asked._weighed, rays, k)
        instance, geometry, own = _instances_of(self._numbers, found.face, found.triangle)
        return replace(found, instance=instance, geometry=geometry, geometry_face=own)

    def count_hits(
        self, origins: np.ndarray, directions: np.ndarray, *, t_max: np.ndarray | float | None = None
    ) -> Int32[np.ndarray, " r"]:
        """Count all faces that each ray hits, every one of those that share an edge or a corner it hits.

        Arguments and errors are those of `closest_hit`.
        """
        return counts(self._gatherer()._gather, checked_rays(origins, directions, t_max), "count")

    def closest_point(self, points: np.ndarray, *, signed: bool = False) -> ClosestPoints:
        """Find the point of the surface closest to each point.

        Where on its triangle it is, and how far, is computed in float64. Which triangle it is was decided in
        float32: none is closer by more than 2**-20 of the largest coordinate of point and scene. Of equal
        ones it is the least face. Through shared instances it is bit for bit that of the flattened scene.

        Args:
            points: (r, 3) in the frame of the scene's positions. A point that is not finite, or 2**60 times
                as far as the scene reaches, has none.
            signed: Make distances negative inside, by `contains` by parity: for closed meshes.

        Raises:
            UsageError: The points are not of this shape.
            StriptoolsError: As for `closest_hit`.
        """
        checked = checked_points(points)
        if self._empty:
            found = nothing_closest(len(checked))
        else:
            wide = self._gatherer()
            options = PointOptions(wide._stack_size, wide._on_gpu, wide._layout.decode)
            found = closest_points(wide._standing, wide._layout, checked, wide._mesh, options)
        if signed:
            inside = self.contains(checked)
            found.distance[inside] *= -1
        return found

    def contains(self, points: np.ndarray, *, method: ContainKind = "parity") -> Bool[np.ndarray, " r"]:
        """Say of each point whether it is inside the mesh, which has to be closed.

        By parity, a ray from the point leaves the mesh an odd number of times: fast; edges and corners in its
        way are counted right, and it does not matter how faces are wound. By winding, the generalised winding
        number is beyond a half: slow, for each point takes each triangle, but it bears holes; faces must be
        wound one way. Of points on the surface, and of meshes with holes by parity, nothing is promised. A
        point that is not finite is outside.

        Args:
            points: (r, 3) in the frame of the scene's positions.
            method: "parity" or "winding".

        Raises:
            UsageError: The points are not of this shape, or there is no such method.
            StriptoolsError: As for `closest_hit`.
        """
        if method == "winding":
            return np.abs(self.winding_numbers(points)) > 0.5
        if method != "parity":
            raise UsageError(f"no such method: {method!r}", remedy="use parity or winding")
        return counts(self._gatherer()._gather, rays_from(checked_points(points)), "windings") % 2 == 1

    def winding_numbers(self, points: np.ndarray) -> Float32[np.ndarray, " r"]:
        """The generalised winding number of the mesh at each point, 0 at points that are not finite.

        1 inside and 0 outside of a closed mesh whose faces are wound counter-clockwise from outside; in
        between where there are holes. Each point takes each triangle, placed or decoded where it is not kept
        so: through shared instances within 1e-5 or so of the flattened scene's, whose sums are others.

        Args:
            points: (r, 3) in the frame of the scene's positions.

        Raises:
            UsageError: The points are not of this shape.
        """
        checked = checked_points(points)
        if self._empty:
            return np.zeros(len(checked), np.float32)
        return winding_numbers(self._gatherer()._layout, checked)

    def program_parts(self) -> tuple[Any, WalkOptions]:
        """The scene on the first device and how a CPU or GPU walks it, for `functional.Geometry`.

        Raises:
            UsageError: There is nothing to trace.
        """
        if self._empty:
            raise UsageError("a scene without triangles", remedy="trace it by the tracer itself")
        wide = self._gatherer()
        options = wide._options()
        assert options is not None
        with quiet_jax():
            layout, arrays = wide._layout, wide._layout.arrays
            if isinstance(layout, InstancedLayout):
                arrays = arrays._replace(places=layout.places)
            arrays = jax.device_put(arrays, self.devices[0])
            return arrays, tried(device_mesh(self.devices[:1]), options, arrays)

    def _gatherer(self) -> "Tracer":
        """The tracer for more than closest and any hits, of nodes that have each triangle in one leaf.

        This one through shared instances and wide nodes, else one of wide nodes beside it.

        Raises:
            UsageError: There is none.
        """
        if self._empty or self._shared or self._has_each_once:
            return self
        if self._rebuild is None:
            raise UsageError(
                "only closest hits and any hits go through this hierarchy",
                where="hierarchy",
                remedy="trace a scene under it",
            )
        return self._rebuilt

    @cached_property
    def _rebuilt(self) -> "Tracer":
        """The same scene under wide nodes that have each triangle in one leaf."""
        assert self._rebuild is not None
        return self._rebuild()

    def _gather(self, rays: Rays, kind: GatherKind, most: int, take: Take) -> None:
        dropped = np.zeros(len(rays[0]), np.uint8)
        self._trace(rays, dropped, self._options(gather=kind, most=most), take)

    def _options(
        self,
        *,
        any_hit: bool = False,
        counting: bool = False,
        gather: GatherKind | None = None,
        most: int = 0,
    ) -> WalkOptions | None:
        """What to compile in; None where there is nothing to trace."""
        if self._empty:
            return None
        side_by_side = 1 if self._on_gpu else RAYS_SIDE_BY_SIDE
        decode = self._layout.decode
        plain = not counting and gather is None and self._test == "watertight"
        kernel = self._kernel and plain and isinstance(self._layout.arrays, WideScene | PackedScene)
        given = (self._stack_size, self._on_gpu, decode, gather, most, self._test, kernel)
        return WalkOptions(side_by_side, any_hit, counting, *given)


def _check_kinds(hierarchy: str, resident: str, instances: str) -> None:
    if instances not in ("auto", "flattened", "shared"):
        raise UsageError(f"no such instances: {instances!r}", remedy="use auto, flattened or shared")
    if hierarchy not in ("stored", "rebuilt"):
        raise UsageError(f"no such hierarchy: {hierarchy!r}", remedy="use stored or rebuilt")
    if resident not in ("auto", "expanded", "compressed"):
        raise UsageError(f"no such residency: {resident!r}", remedy="use auto, expanded or compressed")
    if hierarchy == "rebuilt" and resident == "compressed":
        raise UsageError(
            "a rebuilt hierarchy is expanded", where="resident", remedy="use the stored hierarchy"
        )


def _check_test(test: str) -> None:
    if test not in get_args(TriangleTest):
        raise UsageError(
            f"no such triangle test: {test!r}", remedy=f"use {', '.join(get_args(TriangleTest))}"
        )


def _of_alternative(resident: ResidentKind) -> ResidentKind:
    """How a scene with a hierarchy of its own is kept."""
    if resident == "compressed":
        raise UsageError(
            "only the default hierarchy is traced compressed",
            where="resident",
            remedy="use expanded, or convert it with --hierarchy reducem",
        )
    return "expanded"


def _shares(scene: "Scene", instances: InstancesKind, resident: ResidentKind, budget: int) -> bool:
    """Whether each geometry is kept once."""
    if scene.instances is None or instances == "flattened":
        return False
    fits = EXPANDED_BYTES * scene.placed_count <= budget
    return instances == "shared" or resident == "compressed" or not fits


def _of_flattened(resident: ResidentKind) -> ResidentKind:
    """How flattened instances are kept."""
    if resident == "compressed":
        raise UsageError("flattened instances are expanded", where="resident", remedy="use instances shared")
    return "expanded"


def _instances_of(
    numbers: InstanceNumbers | None, face: np.ndarray, triangle: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray] | tuple[None, None, None]:
    """Instance, geometry and the face within it of each hit; nothing where a scene has no instances."""
    if numbers is None:
        return None, None, None
    instance = numbers.instance_of(triangle)
    hit = instance >= 0
    geometry = np.where(hit, numbers.geometry[instance], np.int32(-1))
    own = np.where(hit, face - numbers.first_face[instance], -1).astype(np.int32)
    return instance, geometry, own


def checked_rays(
    origins: np.ndarray, directions: np.ndarray, t_max: np.ndarray | float | None
) -> tuple[Float32[np.ndarray, "r 3"], Float32[np.ndarray, "r 3"], Float32[np.ndarray, " r"]]:
    """Rays as float32 arrays of matching shapes.

    Raises:
        UsageError: They are not.
    """
    start = _as_float32(origins, "origins")
    way = _as_float32(directions, "directions")
    for name, rays in (("origins", start), ("directions", way)):
        if rays.ndim != 2 or rays.shape[1] != 3:
            raise UsageError(f"of shape {rays.shape}", where=name, remedy="give an array of shape (rays, 3)")
    if len(start) != len(way):
        raise UsageError(f"{len(start)} origins for {len(way)} directions", remedy="give one of each per ray")
    reach = _as_float32(np.inf if t_max is None else t_max, "t_max")
    if reach.shape not in ((), (len(start),)):
        raise UsageError(f"of shape {reach.shape}", where="t_max", remedy=f"give one number or {len(start)}")
    return start, way, np.ascontiguousarray(np.broadcast_to(reach, len(start)))


def checked_points(points: np.ndarray) -> Float32[np.ndarray, "r 3"]:
    """Points as float32, (r, 3).

    Raises:
        UsageError: They are not.
    """
    given = _as_float32(points, "points")
    if given.ndim != 2 or given.shape[1] != 3:
        raise UsageError(
            f"of shape {given.shape}", where="points", remedy="give an array of shape (points, 3)"
        )
    return given


def _as_float32(values: Any, name: str) -> Float32[np.ndarray, "..."]:
    """Round to float32; what is too large for it becomes infinite, so that its ray is a miss."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            given = np.asarray(values)
            if given.dtype.kind not in "fiub":
                raise TypeError(f"{given.dtype} is no real number")
            return np.ascontiguousarray(given, np.float32).reshape(given.shape)
    except (TypeError, ValueError) as error:
        raise UsageError(
            f"not an array of numbers: {error}", where=name, remedy="give float32 values"
        ) from error
