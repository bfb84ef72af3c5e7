"""The walks that the leak table is of."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, get_args

import numpy as np
from leak_gpu import GpuWalk

from striptools.hierarchies.loose_octree import build_sah_bvh
from striptools.hierarchies.options import OVER, HierarchyOptions
from striptools.partition.boxes import range_boxes
from striptools.reducem.scene import Scene
from striptools.trace import Hits, Tracer
from striptools.trace.tracer import ResidentKind
from striptools.types import TriangleTest


class Traces(Protocol):
    """What a walk is asked."""

    def closest_hit(self, origins: np.ndarray, directions: np.ndarray, *, packets: bool = True) -> Hits:
        """As of `Tracer`."""
        ...

    def any_hit(
        self, origins: np.ndarray, directions: np.ndarray, *, t_max: np.ndarray, packets: bool = True
    ) -> np.ndarray:
        """As of `Tracer`."""
        ...


class Gathering:
    """The walk that gathers all hits: the first of them is the closest, and where some are counted is one."""

    def __init__(self, tracer: Tracer) -> None:
        self.tracer = tracer

    def closest_hit(self, origins: np.ndarray, directions: np.ndarray, *, packets: bool = False) -> Hits:
        """The first of all hits."""
        found = self.tracer.all_hits(origins, directions, k=1)
        return Hits(found.t[:, 0], found.face[:, 0], found.u[:, 0], found.v[:, 0], found.triangle[:, 0])

    def any_hit(
        self, origins: np.ndarray, directions: np.ndarray, *, t_max: np.ndarray, packets: bool = False
    ) -> np.ndarray:
        """Whether hits are counted."""
        return self.tracer.count_hits(origins, directions, t_max=t_max) > 0


@dataclass(frozen=True)
class Walk:
    """A way to keep a scene.

    Attributes:
        name: What the table calls it.
        tracer: From a scene of the default hierarchy.
        packets: Whether rays go in packets there too.
        test: The triangle test: hits are the same, bit for bit, as of the first walk of that test.
        most: Rays of a batch that it takes, where it is too slow for all.
    """

    name: str
    tracer: Callable[[Scene], Traces]
    packets: bool = False
    test: TriangleTest = "watertight"
    most: int | None = None


MAIN = (
    Walk("expanded", lambda scene: Tracer(scene, device="cpu", resident="expanded"), packets=True),
    Walk("compressed", lambda scene: Tracer(scene, device="cpu", resident="compressed"), packets=True),
    Walk("rebuilt", lambda scene: Tracer(scene, device="cpu", hierarchy="rebuilt"), packets=True),
)
"""What users get without asking for a hierarchy: every ray goes through these. The first is the reference."""


def _under(options: HierarchyOptions) -> Callable[[Scene], Tracer]:
    return lambda scene: Tracer(scene.under(options), device="cpu")


def _binary(scene: Scene) -> Tracer:
    boxes = range_boxes(scene.triangle_boxes(), scene.objects("triangles"))
    built = build_sah_bvh(boxes, HierarchyOptions("loose-octree", over="triangles"))
    return Tracer(replace(scene, hierarchy=built), device="cpu")


RESIDENT: tuple[ResidentKind, ...] = ("expanded", "compressed")

LEAKY: tuple[TriangleTest, ...] = ("fast",)
"""Tests that are not watertight by design: what slips through is counted, and no fault."""

GPU_RAYS = 4096
"""Rays of a batch that go the ways of a GPU: on a CPU these are slow."""


def _accurate(test: TriangleTest, resident: ResidentKind) -> Walk:
    def tracer(scene: Scene) -> Tracer:
        return Tracer(scene, device="cpu", resident=resident, test=test)

    return Walk(f"test {test}, {resident}", tracer, test=test)


def _as_on_gpu(name: str, resident: ResidentKind, *, by_kernel: bool) -> Walk:
    make = partial(GpuWalk, resident=resident, by_kernel=by_kernel)
    return Walk(f"{name}, {resident}", make, most=GPU_RAYS)


ASIDE = tuple(
    walk
    for resident in RESIDENT
    for walk in (
        *(_accurate(test, resident) for test in get_args(TriangleTest) if test != "watertight"),
        _as_on_gpu("GPU kernel, interpreted", resident, by_kernel=True),
        _as_on_gpu("GPU kernel's twin", resident, by_kernel=False),
    )
)
"""The other triangle tests, and what a GPU runs: five a residency, so that both take the same places."""

OTHERS = (
    Walk("binary SAH", _binary),
    *(Walk(f"slbvh over {over}", _under(HierarchyOptions("slbvh", over))) for over in OVER["slbvh"]),
    Walk("slbvh, morton", _under(HierarchyOptions("slbvh", balance="morton"))),
    *(Walk(f"kdtree over {over}", _under(HierarchyOptions("kdtree", over))) for over in OVER["kdtree"]),
    *(
        Walk(f"loose octree over {over}", _under(HierarchyOptions("loose-octree", over)))
        for over in OVER["loose-octree"]
    ),
    Walk("presorted, no nodes", _under(HierarchyOptions("presorted", levels=0))),
    Walk("presorted, 10 levels", _under(HierarchyOptions("presorted", levels=10))),
    Walk("all hits, expanded", lambda scene: Gathering(Tracer(scene, device="cpu", resident="expanded"))),
    Walk("all hits, compressed", lambda scene: Gathering(Tracer(scene, device="cpu", resident="compressed"))),
    *ASIDE,
)

SHARED = RESIDENT
"""How instances are shared."""
