"""The GPU kernel against its plain-JAX twin, bit for bit, in Pallas' interpreter; and lowered for CUDA."""

import os
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import jax
import numpy as np
import pytest
from jax.sharding import AbstractDevice, AbstractMesh, use_abstract_mesh
from rays import rays_at
from scenes import scene_of, small_scene

from striptools.hierarchies.options import HierarchyOptions
from striptools.hierarchies.rebuilt import rebuild
from striptools.mesh.mesh import Mesh
from striptools.threads import in_chunks
from striptools.trace import SlowTracingWarning, Tracer, functional, launch
from striptools.trace.leaves import lay_out_wide
from striptools.trace.pallas import tiles
from striptools.trace.pallas import walk as kernel
from striptools.trace.pallas.arithmetic import BY_INTERPRETER
from striptools.trace.triangle import Edges, crossing_of, edge_functions
from striptools.trace.walk import DONE, STUCK, WalkOptions, trace_rays

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


def walked(trace, tracer, rays, options):
    """Results of a walk, without the optimizations that make the kernel's program slow to compile."""
    quick = {"xla_backend_optimization_level": 0, "xla_llvm_disable_expensive_passes": True}
    program = jax.jit(partial(trace, options=options)).lower(tracer._scene, *rays)
    return program.compile(compiler_options=quick)(tracer._scene, *rays)


interpreted = partial(kernel.trace_rays, interpret=True)


def options_of(tracer, *, any_hit=False):
    return WalkOptions(1, any_hit, False, tracer._stack_size, True, tracer._layout.decode)


def differences(scene, resident, *, any_hit=False):
    """Results of kernel and twin that differ in a bit, and how many rays hit something."""
    tracer = Tracer(scene, device="cpu", threads=1, resident=resident)
    return differences_of(tracer, odd_rays(scene), options_of(tracer, any_hit=any_hit))


def differences_of(tracer, rays, options):
    wanted, found = (walked(trace, tracer, rays, options) for trace in (trace_rays, interpreted))
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
    # A triangle a leaf: with more of them in one the tree is not as deep.
    layout = lay_out_wide(scene, *rebuild(scene.triangle_boxes(), leaf_size=1))
    tracer = Tracer.of_layout(layout, device="cpu", threads=1)
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
    # Entries beyond those in registers were in use: where there is room for one more, it serves all.
    cut = options._replace(stack_size=kernel.SHORT + 1)
    full, short = (walked(interpreted, tracer, rays, each) for each in (options, cut))
    assert (np.asarray(full.name) != np.asarray(short.name)).any()


@pytest.mark.parametrize("entries", [1, 3, 64])
def test_how_many_entries_lie_in_registers_does_not_matter(monkeypatch, entries):
    monkeypatch.setattr(kernel, "SHORT", entries)
    differ, hits = differences(small_scene(), "expanded")
    assert differ == 0
    assert hits > 0


@pytest.mark.parametrize("count", [0, 1, 31, 33, 500])
def test_rays_come_in_as_others_are_done(count):
    scene = small_scene()
    tracer = Tracer(scene, device="cpu", threads=1)
    rays = *(a[:count] for a in rays_at(scene, 500, 5)), np.full(count, np.inf, np.float32)
    found = walked(interpreted, tracer, rays, options_of(tracer))
    wanted = tracer.closest_hit(*rays[:2])
    np.testing.assert_array_equal(found.name, wanted.face)
    np.testing.assert_array_equal(found.t, wanted.t)


def test_more_rays_than_are_counted_are_walked_in_parts(monkeypatch):
    scene = small_scene()
    tracer = Tracer(scene, device="cpu", threads=1)
    monkeypatch.setattr(kernel, "MOST_RAYS", 48)
    for any_hit in (False, True):
        assert differences_of(tracer, odd_rays(scene, 100), options_of(tracer, any_hit=any_hit))[0] == 0


def test_what_is_sifted_out_is_not_hit():
    """Edge functions of both signs, or of none: what the kernel leaves out, the exact test rejects."""
    draw = np.random.default_rng(3)
    corners = draw.normal(size=(3, 2, 20000)).astype(np.float32)
    corners[:, :, :4000] = np.round(corners[:, :, :4000])
    corners[:, :, 4000:5000] *= np.float32(3e19)
    corners[0, 0, 5000:5100] = np.nan
    x, y = (tuple(jax.numpy.asarray(corners[:, axis])) for axis in (0, 1))
    flags = tiles.may_be_inside(*zip(x, y, strict=True), BY_INTERPRETER)
    # As the GPU has it: products that are not a number stay so, and minima are of what is one.
    gpus = {"product": lambda a, b: a * b, "smaller": jax.numpy.fmin, "larger": jax.numpy.fmax}
    plain = BY_INTERPRETER._replace(sifting=BY_INTERPRETER.sifting._replace(**gpus))
    sifted = np.asarray(tiles.may_be_inside(*zip(x, y, strict=True), plain))
    heights = tuple(map(jax.numpy.ones_like, x))
    t = np.asarray(crossing_of(Edges(*edge_functions(x, y), heights, np.bool_(True), y)))
    hit = (t > 0) & np.isfinite(t)
    assert (np.asarray(flags) | ~hit).all()
    assert (sifted | ~hit).all()
    assert 1000 < hit.sum() < sifted.sum() < 10000


def test_nodes_of_sixteen_children_are_refused():
    scene = small_scene()
    tracer = Tracer(scene, device="cpu", threads=1, hierarchy="rebuilt")
    with pytest.raises(NotImplementedError, match="nodes of 16 children"):
        walked(interpreted, tracer, odd_rays(scene), options_of(tracer))


def test_a_fault_in_the_kernel_would_be_seen(monkeypatch):
    exact = kernel.BY_INTERPRETER.exact._replace(quotient=lambda a, b: a * (1 / b))
    inexact = kernel.BY_INTERPRETER._replace(exact=exact)
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
    traced = jax.jit(partial(interpreted, options=options_of(tracer)))(scene, *odd_rays(small_scene()))
    assert (np.asarray(traced.name) == STUCK).any()


def test_more_nodes_than_an_entry_can_say_are_refused(monkeypatch):
    tracer = Tracer(small_scene(), device="cpu", threads=1)
    monkeypatch.setattr(kernel, "MOST_NODES", 8)
    with pytest.raises(NotImplementedError, match="8 nodes"):
        interpreted(tracer._scene, *odd_rays(small_scene()), options_of(tracer))


def test_functions_of_arrays_go_by_the_kernel(monkeypatch):
    scene = small_scene()
    tracer = Tracer(scene, device="cpu", threads=1)
    asked = []

    def by_kernel(*given):
        asked.append(given[-1])
        return interpreted(*given)

    monkeypatch.setattr(kernel, "trace_rays", by_kernel)
    geometry = functional.Geometry.of(tracer, scene.faces())
    geometry = replace(geometry, options=geometry.options._replace(kernel=True))
    origins, directions = rays_at(scene, 40, 2)
    wanted = tracer.closest_hit(origins, directions)
    hits = jax.jit(functional.closest_hit)(geometry, scene.positions, origins, directions)
    np.testing.assert_array_equal(hits.t, wanted.t)
    np.testing.assert_array_equal(hits.face, wanted.face)
    by_pairs = [a.reshape(20, 2, 3) for a in (origins, directions)]
    found = jax.vmap(functional.any_hit, (None, 0, 0))(geometry, *by_pairs)
    np.testing.assert_array_equal(found.ravel(), wanted.hit)
    assert {options.any_hit for options in asked} == {False, True}
    before = len(asked)
    # What is gathered, the twin walks.
    counts = functional.count_hits(geometry, origins, directions)
    np.testing.assert_array_equal(counts, tracer.count_hits(origins, directions))
    assert len(asked) == before


def test_functions_of_arrays_do_without_a_kernel_that_cannot_be_compiled():
    scene = small_scene()
    tracer = Tracer(scene, device="cpu", threads=1)
    tracer._on_gpu = tracer._kernel = True
    launch._refused.clear()
    with pytest.warns(SlowTracingWarning, match="kernel cannot be compiled here"):
        geometry = functional.Geometry.of(tracer, scene.faces())
    assert geometry.options.batch
    assert not geometry.options.kernel
    launch._refused.clear()


def lowered_for_cuda(tracer, options):
    """The program that a GPU would be given, made without one."""
    rays = [jax.ShapeDtypeStruct(shape, np.float32) for shape in ((4096, 3), (4096, 3), (4096,))]
    device = AbstractDevice(device_kind="NVIDIA H100", num_cores=132, platform="gpu")
    with use_abstract_mesh(AbstractMesh((), (), abstract_device=device)):
        traced = jax.jit(partial(kernel.trace_rays, options=options)).trace(tracer._scene, *rays)
        return traced.lower(lowering_platforms=("cuda",)).as_text()


@pytest.mark.parametrize("resident", ["expanded", "compressed"])
@pytest.mark.parametrize("any_hit", [False, True])
def test_kernel_is_lowered_for_cuda(resident, any_hit):
    tracer = Tracer(small_scene(), device="cpu", threads=1, resident=resident)
    assert "__gpu$xla.gpu.triton" in lowered_for_cuda(tracer, options_of(tracer, any_hit=any_hit))


def test_what_triton_cannot_do_is_not_lowered(monkeypatch):
    tracer = Tracer(small_scene(), device="cpu", threads=1)
    monkeypatch.setattr(kernel, "bits_in", lambda flags, bits: jax.numpy.sort(bits, axis=1)[:, 0])
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
