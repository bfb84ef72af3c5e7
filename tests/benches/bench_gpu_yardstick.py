"""A plain CUDA tracer on the rays of `bench_gpu`, and NVIDIA Warp: a measure of what the card can do.

    python tests/benches/bench_gpu_yardstick.py MODEL [MODEL ...] [--rays 20] [--repeats 20] [--record]

One ray a thread through a binary hierarchy (the rebuilt one, cut at leaves of four triangles), both
children's boxes in a node of 64 bytes, nearest child first, the stack in local memory: Aila & Laine,
"Understanding the Efficiency of Ray Traversal on GPUs" (HPG 2009), without persistent threads.
Moeller-Trumbore's test: it leaks, and its division is an approximation, so that hits are counted and not
compared bit for bit. Needs CuPy.

Warp (`warp-lang`) is measured too where it is installed: its queries of a mesh, one ray a thread, by its own
hierarchy and its own triangle test. Where the hierarchy can be chosen (1.6) it is the one by SAH; before, an
LBVH with a triangle a leaf. A query for any hit is there from 1.11 on: with older ones, only closest hits are
measured.
"""

import argparse
import sys
from collections.abc import Callable, Iterator
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from inspect import signature
from pathlib import Path
from typing import Any

import cupy
import jax
import numpy as np
from bench_gpu import Rays, ray_kinds, repeated
from results import Row, append

import striptools
from striptools.hierarchies.in_strip import BinaryTree
from striptools.kernels.hierarchy import boxes_from_below
from striptools.partition.object_split import split_objects
from striptools.reducem.scene import Scene
from striptools.trace import Tracer

BENCH = {
    "takes": "paths",
    "models": ["dragon", "bunny", "powerplant"],
    "full": [[]],
    "quick": [["--rays", "16", "--repeats", "2"]],
    "needs": ["gpu", "cupy"],
    "peers": ["warp"],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

LEAF = 4
THREADS = 128

Query = tuple[str, Callable[[], object], Callable[[], np.ndarray]]
"""What is asked, a call that starts the kernel, and one that gives the faces hit, -1 for none."""

SOURCE = r"""
__device__ __forceinline__ float3 operator-(float3 a, float3 b)
{
    return make_float3(a.x - b.x, a.y - b.y, a.z - b.z);
}

__device__ __forceinline__ float dot(float3 a, float3 b)
{
    return a.x * b.x + a.y * b.y + a.z * b.z;
}

__device__ __forceinline__ float3 cross(float3 a, float3 b)
{
    return make_float3(a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x);
}

__device__ __forceinline__ float inverse(float a)
{
    return 1.f / (fabsf(a) < 1e-20f ? copysignf(1e-20f, a) : a);
}

__device__ __forceinline__ bool meets(float3 lo, float3 hi, float3 inv, float3 oi, float t, float &entry)
{
    float ax = lo.x * inv.x - oi.x, bx = hi.x * inv.x - oi.x;
    float ay = lo.y * inv.y - oi.y, by = hi.y * inv.y - oi.y;
    float az = lo.z * inv.z - oi.z, bz = hi.z * inv.z - oi.z;
    entry = fmaxf(fmaxf(fminf(ax, bx), fminf(ay, by)), fmaxf(fminf(az, bz), 0.f));
    return entry <= fminf(fminf(fmaxf(ax, bx), fmaxf(ay, by)), fminf(fmaxf(az, bz), t)) * 1.0000005f;
}

#define END 0x7fffffff

extern "C" __global__ void trace(const float4 *nodes, const float4 *corners, const float *origins,
                                 const float *directions, int count, int any, float *t_out, int *face_out)
{
    int ray = blockIdx.x * blockDim.x + threadIdx.x;
    if (ray >= count) return;
    const float3 o = make_float3(origins[3 * ray], origins[3 * ray + 1], origins[3 * ray + 2]);
    const float3 d = make_float3(directions[3 * ray], directions[3 * ray + 1], directions[3 * ray + 2]);
    const float3 inv = make_float3(inverse(d.x), inverse(d.y), inverse(d.z));
    const float3 oi = make_float3(o.x * inv.x, o.y * inv.y, o.z * inv.z);
    int stack[64], height = 0, node = 0, best = -1;
    float t = __int_as_float(0x7f800000);
    stack[height++] = END;
    while (node != END) {
        while (node >= 0 && node != END) {
            const float4 a = __ldg(nodes + 4 * node), b = __ldg(nodes + 4 * node + 1);
            const float4 c = __ldg(nodes + 4 * node + 2), e = __ldg(nodes + 4 * node + 3);
            const float3 lo0 = make_float3(a.x, a.y, a.z), hi0 = make_float3(a.w, b.x, b.y);
            const float3 lo1 = make_float3(b.z, b.w, c.x), hi1 = make_float3(c.y, c.z, c.w);
            float near0, near1;
            const bool hit0 = meets(lo0, hi0, inv, oi, t, near0), hit1 = meets(lo1, hi1, inv, oi, t, near1);
            int child0 = __float_as_int(e.x), child1 = __float_as_int(e.y);
            if (hit0 && hit1) {
                const bool swap = near1 < near0;
                stack[height++] = swap ? child0 : child1;
                node = swap ? child1 : child0;
            } else if (hit0) node = child0;
            else if (hit1) node = child1;
            else node = stack[--height];
        }
        if (node < 0) {
            const int first = (~node) >> 3, last = first + ((~node) & 7);
            for (int k = first; k <= last; k++) {
                const float4 p = __ldg(corners + 3 * k);
                const float4 q = __ldg(corners + 3 * k + 1), r = __ldg(corners + 3 * k + 2);
                const float3 e1 = make_float3(q.x, q.y, q.z), e2 = make_float3(r.x, r.y, r.z);
                const float3 s = o - make_float3(p.x, p.y, p.z), h = cross(d, e2), g = cross(s, e1);
                const float f = __fdividef(1.f, dot(e1, h));
                const float u = f * dot(s, h), v = f * dot(d, g), w = f * dot(e2, g);
                if (u >= 0.f && v >= 0.f && u + v <= 1.f && w > 0.f && w < t) {
                    t = w;
                    best = __float_as_int(p.w);
                }
            }
            node = any && best >= 0 ? END : stack[--height];
        }
    }
    t_out[ray] = t;
    face_out[ray] = best;
}
"""


class PlainCuda:
    """The kernel here, started by CuPy."""

    name = "plain CUDA"

    def __init__(self, scene: Scene) -> None:
        self.kernel = cupy.RawKernel(SOURCE, "trace", options=("--use_fast_math",))
        self.arrays = [cupy.asarray(a) for a in binary_layout(scene)]

    def queries(self, rays: Rays) -> Iterator[Query]:
        """Closest and any hits of rays that are in the device's memory."""
        count = len(rays[0])
        on_device = [cupy.asarray(a) for a in rays]
        t, face = cupy.zeros(count, cupy.float32), cupy.zeros(count, cupy.int32)
        for any_hit, what in ((0, "closest hit"), (1, "any hit")):
            given = (*self.arrays, *on_device, np.int32(count), np.int32(any_hit), t, face)
            yield what, lambda given=given: self.kernel((-(-count // THREADS),), (THREADS,), given), face.get

    def seconds(self, call: Callable[[], object]) -> float:
        """Of one call, by the device's own clock."""
        start, end = cupy.cuda.Event(), cupy.cuda.Event()
        start.record()
        call()
        end.record()
        end.synchronize()
        return cupy.cuda.get_elapsed_time(start, end) / 1e3


class Warp:
    """The peer: the queries of a mesh that NVIDIA Warp has, on a device that it knows by a name.

    Directions need not be of length 1: t is in units of them. Some versions widen boxes by 1e-3, whatever the
    model's size: scene and rays are scaled by a power of two, so that the longest side is 512 to 1024. That
    changes no bit of t.
    """

    def __init__(self, scene: Scene, device: str = "cuda") -> None:
        self.wp: Any = import_module("warp")
        wp, self.device = self.wp, device
        if hasattr(wp.config, "quiet"):
            wp.config.quiet = True
        else:
            wp.config.log_level = wp.LOG_WARNING
        self.name = f"warp {wp.config.version}"
        size = np.ptp(scene.positions, axis=0).max()
        self.scale = np.float32(2.0 ** (10 - np.frexp(size)[1]))
        positions = wp.array(self.scale * scene.positions, dtype=wp.vec3, device=device)
        faces = wp.array(scene.faces().astype(np.int32).ravel(), dtype=wp.int32, device=device)
        can_choose = "bvh_constructor" in signature(wp.Mesh.__init__).parameters
        chosen = {"bvh_constructor": "sah"} if can_choose else {}
        self.mesh = wp.Mesh(positions, faces, **chosen)

    def queries(self, rays: Rays) -> Iterator[Query]:
        """Closest hits, and any where there is a query for it, of rays that are in the device's memory."""
        wp, count = self.wp, len(rays[0])
        on_device = [wp.array(self.scale * a, dtype=wp.vec3, device=self.device) for a in rays]
        t = wp.zeros(count, dtype=wp.float32, device=self.device)
        face = wp.zeros(count, dtype=wp.int32, device=self.device)
        for what, kernel in warp_kernels().items():
            given = [self.mesh.id, *on_device, t, face]
            launch = wp.launch(kernel, dim=count, inputs=given, device=self.device, record_cmd=True)
            yield what, launch.launch, face.numpy

    def seconds(self, call: Callable[[], object]) -> float:
        """Of one call, by the device's own clock."""
        stream = self.wp.get_stream(self.device)
        start, end = (self.wp.Event(self.device, enable_timing=True) for _ in range(2))
        stream.record_event(start)
        call()
        stream.record_event(end)
        return self.wp.get_event_elapsed_time(start, end) / 1e3


@cache
def warp_kernels() -> dict[str, Any]:
    """Warp's kernel of each query that it has; all take the same arguments."""
    wp: Any = import_module("warp")

    @wp.kernel(enable_backward=False)
    def closest_hit(
        mesh: wp.uint64,
        origins: wp.array(dtype=wp.vec3),
        directions: wp.array(dtype=wp.vec3),
        t: wp.array(dtype=wp.float32),
        face: wp.array(dtype=wp.int32),
    ):
        ray = wp.tid()
        query = wp.mesh_query_ray(mesh, origins[ray], directions[ray], wp.inf)
        if query.result:
            t[ray] = query.t
            face[ray] = query.face
        else:
            t[ray] = wp.inf
            face[ray] = -1

    if tuple(int(part) for part in wp.config.version.split(".")[:2]) < (1, 11):
        return {"closest hit": closest_hit}

    @wp.kernel(enable_backward=False)
    def any_hit(
        mesh: wp.uint64,
        origins: wp.array(dtype=wp.vec3),
        directions: wp.array(dtype=wp.vec3),
        t: wp.array(dtype=wp.float32),
        face: wp.array(dtype=wp.int32),
    ):
        ray = wp.tid()
        if wp.mesh_query_ray_anyhit(mesh, origins[ray], directions[ray], wp.inf):
            face[ray] = 0
        else:
            face[ray] = -1

    return {"closest hit": closest_hit, "any hit": any_hit}


def main() -> int:
    """Measure each model; 2 where there is no GPU."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--rays", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    if jax.default_backend() != "gpu":
        sys.stderr.write("JAX finds no GPU here\n")
        return 2
    for path in arguments.models:
        scene = striptools.open(path) if path.suffix == ".rdm" else striptools.convert(path)
        rows = measure(path.stem, scene, arguments)
        for row in rows:
            sys.stdout.write(f"{row.mesh}: {row.metric} {row.value:.6g} {row.unit} ({row.note})\n")
        sys.stdout.flush()
        if arguments.record:
            append(rows)
    return 0


def measure(name: str, scene: Scene, arguments: argparse.Namespace) -> list[Row]:
    """Trace every kind of ray, rays and results on the device."""
    tracers = [PlainCuda(scene), *([] if find_spec("warp") is None else [Warp(scene)])]
    cpu = Tracer(scene, device="cpu", resident="expanded")
    device = cupy.cuda.runtime.getDeviceProperties(0)["name"].decode()
    rows = []
    count = 2**arguments.rays
    for kind, rays in ray_kinds(scene, cpu, count):
        # As in `bench_gpu`, occlusion rays are repeated.
        many = repeated(rays, count)
        wanted = np.resize(cpu.closest_hit(*rays).hit, count)
        for tracer in tracers:
            for what, call, faces in tracer.queries(many):
                seconds = median_seconds(tracer, call, arguments.repeats)
                otherwise = int(((faces() >= 0) != wanted).sum())
                note = f"{device}, {count} rays on the device, {otherwise} hit or miss otherwise"
                metric = f"{kind} rays, {what}, {tracer.name}"
                rows.append(
                    Row(
                        "gpu_yardstick",
                        name,
                        scene.triangle_count,
                        metric,
                        count / seconds / 1e6,
                        "Mray/s",
                        note=note,
                    )
                )
    return rows


def median_seconds(tracer: PlainCuda | Warp, call: Callable[[], object], repeats: int) -> float:
    """Of a call, after two that do not count."""
    return float(np.median([tracer.seconds(call) for _ in range(repeats + 2)][2:]))


def binary_layout(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """(m, 16) float32 nodes and (n, 12) float32 triangles: corner, face, two edges."""
    boxes = scene.triangle_boxes()
    split = split_objects(boxes)
    tree = BinaryTree(boxes_from_below(split.size, boxes[split.order]), split.size)
    size = tree.size
    inner = np.flatnonzero(size > LEAF)
    place = np.zeros(len(size), np.int32)
    place[inner] = np.arange(len(inner))
    # In preorder, a node's first triangle is the number of leaves before it.
    first = np.concatenate([[0], np.cumsum(size == 1)[:-1]]).astype(np.int32)
    code = np.where(size > LEAF, place, ~(first << 3 | (size - 1))).astype(np.int32)
    left = inner + 1
    right = inner + 2 * size[left]
    nodes = np.zeros((max(1, len(inner)), 16), np.float32)
    for k, child in enumerate((left, right)):
        nodes[: len(inner), 6 * k : 6 * k + 6] = tree.boxes[child]
        nodes[: len(inner), 12 + k] = code[child].view(np.float32)
    corners = scene.positions[scene.faces()[split.order]]
    faces = split.order.astype(np.int32) if scene.remap is None else scene.remap.face[split.order]
    triangles = np.zeros((len(corners), 12), np.float32)
    triangles[:, :3], triangles[:, 3] = corners[:, 0], faces.view(np.float32)
    triangles[:, 4:7], triangles[:, 8:11] = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return nodes, triangles


if __name__ == "__main__":
    sys.exit(main())
