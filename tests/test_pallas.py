"""The GPU kernel against its plain-JAX twin, bit for bit, in Pallas' interpreter; and lowered for CUDA."""

import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh
from rays import rays_at
from scenes import scene_of, small_scene

from striptools.hierarchies.options import HierarchyOptions
from striptools.mesh.mesh import Mesh
from striptools.threads import in_chunks
from striptools.trace import SlowTracingWarning, Tracer, launch
from striptools.trace.leaves import lay_out_rebuilt
from striptools.trace.pallas import walk as kernel
from striptools.trace.walk import DONE, STUCK, WalkOptions, prepared_rays, walk_rays

COUNT = 64


def odd_rays(scene, count=COUNT, seed=1):
    """Aimed rays, some with a reach of one, some that are none, and some from very far or far too far."""
    origins, directions = rays_at(scene, count, seed)
    reach = np.full(count, np.inf, np.float32)
    reach[::3] = 1
    reach[1], reach[4] = np.nan, 0
    origins[5], origins[13], origins[14] = np.nan, 1e18, 3e38
    directions[9], directions[10], directions[11] = 0, -0.0, np.inf
    return origins, directions, reach


def walked(walk, tracer, ready, options):
    """Results of a walk, without the optimizations that make the kernel's program slow to compile."""
    quick = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
    program = jax.jit(partial(walk, options=options)).lower(tracer._scene, ready)
    return program.compile(compiler_options=quick)(tracer._scene, ready)


def options_of(tracer, *, any_hit=False):
    return WalkOptions(1, any_hit, False, tracer._stack_size, True, tracer._layout.decode)


def differences(scene, resident, *, any_hit=False):
    """Results of kernel and twin that differ in a bit, and how many rays hit something."""
    tracer = Tracer(scene, device="cpu", threads=1, resident=resident)
    return differences_of(tracer, odd_rays(scene), options_of(tracer, any_hit=any_hit))


def differences_of(tracer, rays, options):
    ready = jax.jit(prepared_rays)(tracer._scene, *rays)
    wanted = walked(walk_rays, tracer, ready, options)
    found = walked(partial(kernel.walk_rays, interpret=True), tracer, ready, options)
    pairs = [
        (np.asarray(a).view(np.int32), np.asarray(b).view(np.int32))
        for a, b in zip(wanted, found, strict=True)
    ]
    return sum(int((a != b).sum()) for a, b in pairs), int((np.asarray(wanted.name) >= 0).sum())


@pytest.mark.parametrize("any_hit", [False, True])
@pytest.mark.parametrize("remap", [False, True])
def test_kernel_equals_twin_over_expanded_leaves(any_hit, remap):
    differ, hits = differences(small_scene(remap=remap), "expanded", any_hit=any_hit)
    assert differ == 0
    assert COUNT // 3 < hits < COUNT


# XLA's fusion of the decoding takes minutes on a CPU; a process of its own leaves it out.
_PACKED = """
from scenes import small_scene
from test_pallas import differences
for remap in (True, False):
    scene = small_scene(remap=remap, flips=remap, boxes="stored")
    differ, hits = differences(scene, "compressed", any_hit={any_hit})
    assert differ == 0, differ
    assert hits > 20
"""


@pytest.mark.parametrize("any_hit", [False, True])
def test_kernel_equals_twin_over_compressed_leaves(any_hit):
    done = subprocess.run(
        [sys.executable, "-c", _PACKED.format(any_hit=any_hit)],
        cwd=Path(__file__).parent,
        env={**os.environ, "XLA_FLAGS": "--xla_disable_hlo_passes=fusion"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr


def tree_as_deep_as_can_be():
    """Triangles across the x axis, each twice as far out as the last, which alone is larger by nine: at each
    node all but a few are in one child."""
    x = 2.0 ** np.arange(-55, 55)
    square = np.array([[-1, -1], [1, -1], [0, 1]])
    size = np.where(x == x[-1], 9 * x, x)
    positions = np.stack([np.repeat(x, 3), *(np.outer(size, square[:, k]).ravel() for k in (0, 1))], axis=1)
    return scene_of(Mesh(positions.astype(np.float32), np.arange(330, dtype=np.int32).reshape(-1, 3)))


def test_a_deep_stack_is_kept():
    scene = tree_as_deep_as_can_be()
    tracer = Tracer.of_layout(lay_out_rebuilt(scene), device="cpu", threads=1)
    # From beyond the last, past it: every node's other children wait on the stack until the first was seen.
    origins = np.zeros((COUNT, 3), np.float32)
    directions = np.tile(np.array([[1, 0, 0]], np.float32), (COUNT, 1))
    origins[1::2, 0], directions[1::2] = 2.0**60, [-1, 0, 0]
    directions[::2, 1] = np.linspace(0, 0.2, COUNT // 2)
    directions[::2, 2] = np.linspace(-0.5, 0.5, COUNT // 2)
    # Past a corner of all triangles but the last, within the boxes of all.
    directions[::4, 1:] = 0.9
    rays = origins, directions, np.full(COUNT, np.inf, np.float32)
    options = options_of(tracer)
    assert differences_of(tracer, rays, options) == (0, COUNT)
    # Entries beyond one tile's eight were in use.
    ready = jax.jit(prepared_rays)(tracer._scene, *rays)
    full, short = (
        walked(partial(kernel.walk_rays, interpret=True), tracer, ready, options._replace(stack_size=size))
        for size in (options.stack_size, 8)
    )
    assert (np.asarray(full.name) != np.asarray(short.name)).any()


def test_nodes_of_sixteen_children_are_refused():
    scene = small_scene()
    tracer = Tracer(scene, device="cpu", threads=1, hierarchy="rebuilt")
    ready = jax.jit(prepared_rays)(tracer._scene, *odd_rays(scene))
    with pytest.raises(NotImplementedError, match="nodes of 16 children"):
        walked(partial(kernel.walk_rays, interpret=True), tracer, ready, options_of(tracer))


def test_a_fault_in_the_kernel_would_be_seen(monkeypatch):
    inexact = kernel.BY_INTERPRETER._replace(quotient=lambda a, b: a * (1 / b))
    monkeypatch.setattr(kernel, "BY_INTERPRETER", inexact)
    differ, _ = differences(small_scene(), "expanded")
    assert differ > 0


def test_a_walk_in_a_circle_ends():
    tracer = Tracer(small_scene(), device="cpu", threads=1)
    layout = tracer._layout
    nodes = np.array(layout.arrays.nodes)
    children = nodes[0, 6].view(np.int32)
    children[children != DONE] = 0
    scene = layout.arrays._replace(nodes=nodes)
    ready = jax.jit(prepared_rays)(scene, *odd_rays(small_scene()))
    traced = jax.jit(partial(kernel.walk_rays, options=options_of(tracer), interpret=True))(scene, ready)
    assert (np.asarray(traced.name) == STUCK).any()


def test_more_nodes_than_an_entry_can_say_are_refused(monkeypatch):
    tracer = Tracer(small_scene(), device="cpu", threads=1)
    monkeypatch.setattr(kernel, "MOST_NODES", 8)
    with pytest.raises(NotImplementedError, match="8 nodes"):
        kernel.walk_rays(tracer._scene, jax.numpy.zeros((4, 24)), options_of(tracer), interpret=True)


def lowered_for_cuda(tracer, options):
    """The program that a GPU would be given, made without one."""
    ready = jax.ShapeDtypeStruct((4096, 24), np.float32)
    device = AbstractDevice(device_kind="NVIDIA H100", num_cores=132, platform="gpu")
    with use_abstract_mesh(AbstractMesh((), (), abstract_device=device)):
        traced = jax.jit(partial(kernel.walk_rays, options=options)).trace(tracer._scene, ready)
        return traced.lower(lowering_platforms=("cuda",)).as_text()


@pytest.mark.parametrize("resident", ["expanded", "compressed"])
@pytest.mark.parametrize("any_hit", [False, True])
def test_kernel_is_lowered_for_cuda(resident, any_hit):
    tracer = Tracer(small_scene(), device="cpu", threads=1, resident=resident)
    assert "__gpu$xla.gpu.triton" in lowered_for_cuda(tracer, options_of(tracer, any_hit=any_hit))


def test_what_triton_cannot_do_is_not_lowered(monkeypatch):
    tracer = Tracer(small_scene(), device="cpu", threads=1)
    monkeypatch.setattr(kernel, "_over_lanes", lambda join, values: jax.numpy.sort(values, axis=1))
    with pytest.raises(Exception, match="sort"):
        lowered_for_cuda(tracer, options_of(tracer))


def test_where_the_kernel_cannot_be_compiled_its_twin_walks():
    scene = small_scene()
    origins, directions, _ = odd_rays(scene)
    tracer = Tracer(scene, device="cpu", threads=1)
    wanted = tracer.closest_hit(origins, directions)
    tracer._on_gpu = tracer._kernel = True
    launch._refused.clear()
    with pytest.warns(SlowTracingWarning, match="kernel cannot be compiled here") as told:
        found = tracer.closest_hit(origins, directions)
    assert len(told) == 1
    np.testing.assert_array_equal(found.t, wanted.t)
    np.testing.assert_array_equal(found.face, wanted.face)
    # It is said once.
    tracer.closest_hit(origins, directions)


def test_the_kernel_only_walks_what_it_can():
    scene = small_scene()
    tracer = Tracer(scene, device="cpu", threads=1)
    other = Tracer(scene.under(HierarchyOptions("slbvh")), device="cpu", threads=1)
    tracer._kernel = other._kernel = True

    def by_kernel(tracer, **asked):
        options = tracer._options(**asked)
        assert options is not None
        return options.kernel

    assert by_kernel(tracer)
    assert by_kernel(tracer, any_hit=True)
    assert not by_kernel(tracer, counting=True)
    assert not by_kernel(tracer, gather="count")
    assert not by_kernel(other)


def test_hits_are_weighed_by_many_threads_alike(monkeypatch):
    scene = small_scene()
    origins, directions = rays_at(scene, 1000, 3)
    tracer = Tracer(scene, device="cpu", threads=1)
    wanted = tracer.closest_hit(origins, directions)
    tracer._weighers = 3
    monkeypatch.setattr("striptools.trace.tracer.in_chunks", partial(in_chunks, smallest=10))
    found = tracer.closest_hit(origins, directions)
    for name in ("t", "face", "u", "v", "triangle"):
        np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))
