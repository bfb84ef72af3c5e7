"""The tracer: rays in, closest hits or any hits out."""

import math
import os
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from jaxtyping import Bool, Float32

from striptools.errors import StriptoolsError, UsageError
from striptools.threads import in_chunks
from striptools.trace.device import DeviceKind, core_count, trace_devices
from striptools.trace.hit import Hits
from striptools.trace.launch import device_mesh, replicate, stream, stream_ready
from striptools.trace.layout import Layout
from striptools.trace.leaves import Found, Rays, lay_out, lay_out_rebuilt
from striptools.trace.memory import EXPANDED_BYTES, free_memory
from striptools.trace.packed import lay_out_packed
from striptools.trace.walk import MISS, STUCK, WalkOptions

if TYPE_CHECKING:
    from striptools.reducem.scene import Scene

HierarchyKind = Literal["stored", "rebuilt"]
ResidentKind = Literal["auto", "expanded", "compressed"]

RAYS_SIDE_BY_SIDE = 2
"""Rays that a CPU walks at once; more gain nothing, since their constants no longer fit the registers."""


class Tracer:
    """Traces rays through one scene.

    Rays are given as origins and directions, (r, 3) and convertible to float32; directions need not be of
    unit length, and t counts in lengths of the direction. A hit has 0 < t < t_max. The closest hit is that
    of least t, then of least source face. A ray with a component that is not finite, or with a direction of
    zero, hits nothing.

    Rays are in the frame of the scene's positions. Where the scene has an origin (`origin`, for sources in
    float64 far from zero) that is the frame about it: take the origin from those of the rays, in float64,
    before; t, u and v are the same in both.

    Instances are traced where they stand, every one expanded: a scene with instances takes the memory of its
    flattened triangles, and `hierarchy` is then always rebuilt. A hit's face is that of the flattened source
    (`Mesh.flattened` of the mesh that was converted), its triangle one of `scene.placed()`.

    The first call for a number of rays not met before compiles a program (seconds); it is kept in the
    user's cache folder for the next process.

    Args:
        scene: What to trace.
        device: "auto" takes a GPU where JAX has one. A kernel walks the rays there; where it cannot be
            compiled, a `SlowTracingWarning` says why, and its plain-JAX twin walks them, with the same hits.
        threads: CPU devices to use, at most those JAX has; None for all.
        hierarchy: "stored" walks the hierarchy that the scene holds; "rebuilt" makes a new one over single
            triangles first, which takes longer to build, is faster to walk, and is expanded. Hits are the
            same.
        resident: "expanded" keeps boxes and corners as float32, 65 bytes a triangle and more; "compressed"
            keeps the blocks as they are, 9 bytes and 5 of the remap, and decodes triangles where they are
            tested, which is slower. Hits are the same. "auto" expands what fits in `memory_budget`.
        memory_budget: Bytes that an expanded scene may take with "auto"; None for a quarter of the memory
            that is free on the device, or on this machine where the device does not tell.

    Raises:
        UsageError: There is no such device, hierarchy or residency, or not both of them together, or the
            scene has instances, which are not traced compressed yet.
        LimitError: All instances have more triangles than a mesh may have.
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
    ) -> None:
        _check_kinds(hierarchy, resident)
        devices = trace_devices(device, threads)
        self._origin = np.zeros(3) if scene.origin is None else np.array(scene.origin, np.float64)
        self._on_gpu = self._kernel = devices[0].platform != "cpu"
        self._mesh = device_mesh(devices)
        self._weighers = (threads or core_count(os.environ)) if self._on_gpu else 1
        if scene.instances is not None:
            resident, hierarchy = _of_instances(resident), "rebuilt"
        if resident == "auto":
            budget = free_memory(devices[0]) // 4 if memory_budget is None else memory_budget
            fits = hierarchy == "rebuilt" or EXPANDED_BYTES * scene.triangle_count <= budget
            resident = "expanded" if fits else "compressed"
        self._resident: ResidentKind = resident
        self._empty = scene.triangle_count == 0
        if not self._empty:
            self._take(self._laid_out(scene, hierarchy, self._builders(threads)))

    def _laid_out(self, scene: "Scene", hierarchy: HierarchyKind, threads: int) -> Layout:
        if self._resident == "compressed":
            return lay_out_packed(scene, threads)
        if hierarchy == "stored":
            return lay_out(scene, threads)
        return lay_out_rebuilt(scene.placed(), threads)

    def _builders(self, threads: int | None) -> int:
        """Threads to build with: as many as trace on a CPU; beside a GPU, two unless one was asked for."""
        return min(2, threads or 2) if self._on_gpu else self._mesh.size

    def _take(self, layout: Layout) -> None:
        self._layout: Layout = layout
        self._scene = replicate(layout.arrays, self._mesh)
        self._stack_size = max(16, 2 ** math.ceil(math.log2(layout.depth + 2)))

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
    def resident_bytes(self) -> int:
        """Bytes of all arrays kept for tracing."""
        return 0 if self._empty else self._layout.nbytes

    def closest_hit(
        self,
        origins: np.ndarray,
        directions: np.ndarray,
        *,
        t_max: np.ndarray | float | None = None,
        steps: bool = False,
    ) -> Hits:
        """Find what each ray hits first.

        Args:
            origins: (r, 3) in the model's unit.
            directions: (r, 3).
            t_max: (r,) or one for all: only hits nearer than this count; None for any distance.
            steps: Count the nodes and leaves that each ray visits (a program of its own, somewhat slower).

        Raises:
            UsageError: The arrays are not of these shapes, or not numbers.
            StriptoolsError: A walk did not end, since the scene's hierarchy is damaged.
        """
        rays = checked_rays(origins, directions, t_max)
        count = len(rays[0])
        t, u, v = np.full(count, np.inf, np.float32), np.zeros(count, np.float32), np.zeros(count, np.float32)
        face, triangle = np.full(count, MISS), np.full(count, MISS)
        dropped = np.zeros(count, np.uint8)
        counted = np.zeros(count if steps else 0, np.int32)
        found = (t, face, u, v, triangle)
        for at, traced in self._stream(rays, dropped, any_hit=False, steps=steps):
            if steps:
                counted[at] = traced[2]
            _check_ended(traced[1])
            # On this side, while the devices are at the next rays.
            self._weigh(rays, at, traced, found)
        if steps:
            counted[dropped == 1] = 1
        return Hits(t, face, u, v, triangle, counted if steps else None)

    def _weigh(self, rays: Rays, at: np.ndarray, traced: tuple[np.ndarray, ...], found: Found) -> None:
        """Fill in what was found of the rays `at`; beside a GPU all cores are free for it."""

        def weigh(part: tuple[int, int]) -> None:
            mine = slice(*part)
            self._layout.weigh(rays, at[mine], tuple(a[mine] for a in traced[:2]), found)

        in_chunks(weigh, len(at), self._weighers)

    def _stream(
        self, rays: Rays, dropped: np.ndarray, *, any_hit: bool, steps: bool
    ) -> Iterator[tuple[np.ndarray, tuple[np.ndarray, ...]]]:
        """Trace rays; yield which ones are done, int32, and their results."""
        if self._empty:
            return
        options = self._options(any_hit=any_hit, steps=steps)
        if not options.batch:
            yield from stream_ready(self._scene, self._layout, rays, dropped, self._mesh, options)
            return
        for part, traced in stream(self._scene, rays, self._mesh, options):
            yield np.arange(part.start, part.stop, dtype=np.int32), traced

    def any_hit(
        self, origins: np.ndarray, directions: np.ndarray, *, t_max: np.ndarray | float | None = None
    ) -> Bool[np.ndarray, " r"]:
        """Say of each ray whether it hits anything; arguments and errors as for `closest_hit`."""
        rays = checked_rays(origins, directions, t_max)
        hit = np.zeros(len(rays[0]), np.bool_)
        dropped = np.zeros(len(rays[0]), np.uint8)
        for at, traced in self._stream(rays, dropped, any_hit=True, steps=False):
            _check_ended(traced[1])
            hit[at] = traced[1] >= 0
        return hit

    def _options(self, *, any_hit: bool, steps: bool) -> WalkOptions:
        side_by_side = 1 if self._on_gpu else RAYS_SIDE_BY_SIDE
        decode = self._layout.decode
        gpu, kernel = self._on_gpu, self._on_gpu and self._kernel
        return WalkOptions(side_by_side, any_hit, steps, self._stack_size, gpu, decode, kernel)


def _check_kinds(hierarchy: str, resident: str) -> None:
    if hierarchy not in ("stored", "rebuilt"):
        raise UsageError(f"no such hierarchy: {hierarchy!r}", remedy="use stored or rebuilt")
    if resident not in ("auto", "expanded", "compressed"):
        raise UsageError(f"no such residency: {resident!r}", remedy="use auto, expanded or compressed")
    if hierarchy == "rebuilt" and resident == "compressed":
        raise UsageError(
            "a rebuilt hierarchy is expanded", where="resident", remedy="use the stored hierarchy"
        )


def _of_instances(resident: ResidentKind) -> ResidentKind:
    """How a scene with instances is kept."""
    if resident == "compressed":
        raise UsageError(
            "a scene with instances is not traced compressed yet",
            where="resident",
            remedy="use expanded, or convert it with its instances flattened",
        )
    return "expanded"


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


def _check_ended(face: np.ndarray) -> None:
    stuck = int((face == STUCK).sum())
    if stuck:
        raise StriptoolsError(
            f"the walk of {stuck} rays did not end", where="scene hierarchy", remedy="convert the model again"
        )
