"""The compiled walks are hoisted: each loop is one native function, not a thunk per operation."""

import re
from dataclasses import replace

import jax
import numpy as np
import pytest
from scenes import small_scene
from test_instances import SCENES, load

from striptools.hierarchies.kdtree import build_kdtree
from striptools.hierarchies.options import HierarchyOptions
from striptools.hierarchies.slbvh import build_slbvh
from striptools.kernels.packets import ROW as PACKET_ROW
from striptools.kernels.rays import ROW
from striptools.partition.boxes import range_boxes
from striptools.pipeline import convert
from striptools.trace import Tracer
from striptools.trace.instanced import instances_program
from striptools.trace.launch import program
from striptools.trace.walk import WalkOptions


def loops_outside_hoisted_calls(text):
    """While instructions of a compiled program that do not stand in the computation of a hoisted loop."""
    outside = []
    for computation in re.split(r"\n(?=(?:ENTRY )?%)", text):
        loops = re.findall(r"= [^\n]* while\(", computation)
        if loops and not re.match(r"%?while[\w.\-]*_computation", computation.strip()):
            outside += loops
    return outside


def assert_hoisted(lowered, loops=0):
    """A lowered program has at least so many loops, and each is a call of its own."""
    text = lowered.compile().as_text()
    assert 'xla_cpu_small_call="true"' in text
    assert len(re.findall(r"= [^\n]* while\(", text)) >= loops
    assert loops_outside_hoisted_calls(text) == []


def scene_under(hierarchy):
    scene = small_scene()
    if hierarchy == "slbvh":
        slbvh = build_slbvh(scene.triangle_boxes(1), HierarchyOptions("slbvh"))
        return replace(scene, hierarchy=slbvh)
    if hierarchy.startswith("kdtree"):
        over = "strips" if "strips" in hierarchy else "triangles"
        boxes = range_boxes(scene.triangle_boxes(1), scene.objects(over))
        tree = build_kdtree(boxes, HierarchyOptions("kdtree", over=over))
        return replace(scene, hierarchy=tree if "mailbox" in hierarchy else replace(tree, mailbox=0))
    return scene


def lowered_walk(hierarchy="reducem", resident="auto", **asked):
    tracer = Tracer(scene_under(hierarchy), device="cpu", resident=resident)
    options = tracer._options(**asked)
    rays = np.zeros((256 * len(tracer.devices), ROW), np.float32)
    live = np.full(len(tracer.devices), 256, np.int32)
    return program(tracer._mesh, options).lower(tracer._scene, rays, live)


GATHERING = [
    {"gather": gather, "most": most, "resident": resident}
    for gather, most in (("all", 1), ("all", 16), ("all", 128), ("count", 1), ("windings", 1))
    for resident in ("expanded", "compressed")
]

OTHERS = [
    {"hierarchy": hierarchy, **asked}
    for hierarchy in ("slbvh", "kdtree", "kdtree, mailbox", "kdtree, strips, mailbox")
    for asked in ({}, {"any_hit": True}, {"counting": True})
]


@pytest.mark.parametrize("asked", [{}, {"any_hit": True}, {"counting": True}, *GATHERING, *OTHERS])
def test_walks_are_hoisted(asked):
    assert_hoisted(lowered_walk(**asked), loops=3)


@pytest.mark.parametrize("resident", ["expanded", "compressed"])
@pytest.mark.parametrize(
    "asked",
    [
        {},
        {"any_hit": True},
        {"counting": True},
        {"gather": "all", "most": 16},
        {"gather": "count", "most": 1},
        {"gather": "windings", "most": 1},
    ],
)
def test_the_walk_over_instances_is_hoisted(asked, resident):
    scene = convert(load(SCENES["nested"]))
    tracer = Tracer(scene, device="cpu", instances="shared", resident=resident)
    options = tracer._options(**asked)
    rays = np.zeros((256 * len(tracer.devices), 3), np.float32)
    lowered = instances_program(tracer._mesh, options).lower(tracer._scene, rays, rays, rays[:, 0])
    assert_hoisted(lowered, loops=5)


def test_a_loop_that_is_not_hoisted_would_be_seen():
    def scatters(values):
        return jax.lax.fori_loop(0, 1000, lambda i, s: s.at[(values + i) % 64].set(i), np.zeros(64, np.int32))

    text = jax.jit(scatters).lower(np.arange(8)).compile().as_text()
    assert text is not None
    assert loops_outside_hoisted_calls(text)


def copied_in_loops(text, shape):
    """Copies of an array of this shape that a compiled program makes in loops, not before them."""
    copies = re.findall(rf"= {re.escape(shape)}\S* copy\([^\n]*", text)
    return [line for line in copies if "/while" in line]


@pytest.mark.parametrize(
    ("resident", "any_hit", "packets"),
    [("expanded", False, False), ("compressed", True, False), ("expanded", False, True)],
)
def test_stacks_are_not_copied_at_each_step(resident, any_hit, packets):
    """What is read of a stack leads to what is written next, or XLA writes to a copy of it."""
    tracer = Tracer(scene_under("reducem"), device="cpu", threads=1, resident=resident)
    rays = np.zeros((128, PACKET_ROW) if packets else (256, ROW), np.float32)
    live = np.full(1, len(rays), np.int32)
    lowered = program(tracer._mesh, tracer._options(any_hit=any_hit), packets).lower(
        tracer._scene, rays, live
    )
    assert copied_in_loops(lowered.compile().as_text(), f"s32[{tracer._stack_size},2]") == []


def test_a_stack_that_is_copied_would_be_seen():
    def walk(stack):
        def step(carried):
            height, seen, stack = carried
            entry = jax.numpy.stack([height, seen])[None]
            written = jax.lax.dynamic_update_slice(stack, entry, (height % 16, 0))
            below = jax.lax.dynamic_slice(stack, (seen % 16, 0), (1, 2))[0, 0]
            return height + 1, below + written.sum(), written

        return jax.lax.while_loop(lambda carried: carried[0] < 99, step, (0, 1, stack))[2]

    text = jax.jit(walk).lower(np.zeros((16, 2), np.int32)).compile().as_text()
    assert copied_in_loops(text, "s32[16,2]")


def test_options_tell_programs_apart():
    assert WalkOptions(2, False, False, 16) != WalkOptions(2, True, False, 16)
