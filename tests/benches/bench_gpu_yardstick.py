"""A plain CUDA tracer on the rays of `bench_gpu`, as a measure of what the card can do.

    python tests/benches/bench_gpu_yardstick.py MODEL [MODEL ...] [--rays 20] [--repeats 20] [--record]

One ray a thread through a binary hierarchy (the rebuilt one, cut at leaves of four triangles), both
children's boxes in a node of 64 bytes, nearest child first, the stack in local memory: Aila & Laine,
"Understanding the Efficiency of Ray Traversal on GPUs" (HPG 2009), without persistent threads.
Moeller-Trumbore's test: it leaks, and its division is an approximation, so that hits are counted and not
compared bit for bit. Needs CuPy.
"""

import argparse
import sys
from pathlib import Path

import cupy
import jax
import numpy as np
from bench_gpu import ray_kinds
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
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

LEAF = 4
THREADS = 128

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
    kernel = cupy.RawKernel(SOURCE, "trace", options=("--use_fast_math",))
    arrays = [cupy.asarray(a) for a in binary_layout(scene)]
    cpu = Tracer(scene, device="cpu", resident="expanded")
    device = cupy.cuda.runtime.getDeviceProperties(0)["name"].decode()
    rows = []
    for kind, rays in ray_kinds(scene, cpu, 2**arguments.rays):
        count = len(rays[0])
        on_device = [cupy.asarray(a) for a in rays]
        t, face = cupy.zeros(count, cupy.float32), cupy.zeros(count, cupy.int32)
        wanted = cpu.closest_hit(*rays)
        for any_hit, what in ((0, "closest hit"), (1, "any hit")):
            given = (*arrays, *on_device, np.int32(count), np.int32(any_hit), t, face)
            seconds = median_seconds(
                lambda given=given, count=count: kernel((-(-count // THREADS),), (THREADS,), given),
                arguments.repeats,
            )
            found = cupy.asnumpy(face) >= 0
            otherwise = int((found != wanted.hit).sum())
            note = f"{device}, {count} rays on the device, {otherwise} hit or miss otherwise"
            metric = f"{kind} rays, {what}, plain CUDA"
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


def median_seconds(call: object, repeats: int) -> float:
    """By the device's own clock, after two calls that do not count."""
    seconds = []
    for k in range(repeats + 2):
        start, end = cupy.cuda.Event(), cupy.cuda.Event()
        start.record()
        call()  # pyright: ignore[reportCallIssue]
        end.record()
        end.synchronize()
        if k >= 2:
            seconds.append(cupy.cuda.get_elapsed_time(start, end) / 1e3)
    return float(np.median(seconds))


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
