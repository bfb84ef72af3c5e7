"""Boxes of fewer bits: they hold what finer ones hold, hits are the same, and more is visited."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from strategies import grid, sphere

from striptools.errors import UsageError
from striptools.hierarchies.packed import check_packed, wide_tree
from striptools.measure.box_precision import coarsened, lay_out_planes, plane_boxes
from striptools.mesh.mesh import Mesh
from striptools.pipeline import convert
from striptools.reducem.scene import Scene
from striptools.trace import Tracer
from striptools.trace.rays import Camera, camera_rays

FIELDS = ("t", "face", "u", "v", "triangle")


@pytest.fixture(scope="module", params=["ball", "flat"])
def scene(request: pytest.FixtureRequest) -> Scene:
    positions, faces = sphere(5) if request.param == "ball" else grid(40, 40)
    # Off the powers of two, so that boxes do not end on the grid.
    return convert(Mesh(positions * np.float32(1.37) + np.float32(0.713), faces))


def slow_boxes(scene: Scene, node: int) -> list[tuple[int, list[Fraction], list[Fraction]]]:
    """The slots of a node that are not empty, low and high, exactly, by SPEC 4.4."""
    words = [int(word) for word in scene.packed.nodes[node]]
    planes = b"".join(word.to_bytes(4, "little") for word in words[4:])
    origin = (words[2] & 0xFFFF, words[2] >> 16, words[3] & 0xFFFF)
    shift = (words[0] >> 28, words[3] >> 24 & 15, words[3] >> 28)
    found = []
    for slot in range(8):
        sides = [
            [
                Fraction(float(scene.grid.low[axis]))
                + (origin[axis] + (planes[24 * side + 8 * axis + slot] << shift[axis]))
                * Fraction(2) ** int(scene.grid.cell[axis])
                for axis in range(3)
            ]
            for side in (0, 1)
        ]
        if planes[slot] <= planes[24 + slot]:
            found.append((slot, *sides))
    return found


def test_boxes_equal_a_plain_reading(scene: Scene) -> None:
    scene = coarsened(scene, 8)
    boxes = plane_boxes(scene.packed.nodes, scene.grid)
    for node in range(0, len(boxes), 7):
        slots = slow_boxes(scene, node)
        there = {slot for slot, *_ in slots}
        assert there == set(np.flatnonzero(np.isfinite(boxes[node, 0])).tolist())
        for slot, low, high in slots:
            for axis in range(3):
                least, most = boxes[node, axis, slot], boxes[node, 3 + axis, slot]
                # The nearest floats outside.
                above, below = (
                    np.nextafter(least, np.float32(np.inf)),
                    np.nextafter(most, np.float32(-np.inf)),
                )
                assert Fraction(float(least)) <= low[axis] < Fraction(float(above))
                assert Fraction(float(most)) >= high[axis] > Fraction(float(below))


def test_fewer_bits_hold_more(scene: Scene) -> None:
    packed, triangles = scene.with_boxes(), scene.triangle_boxes()
    finer = wide_tree(packed, triangles, scene.block_starts).boxes
    there = np.isfinite(finer[:, 0])
    for bits in (8, 6, 4, 1):
        coarse = coarsened(scene, bits)
        check_packed(coarse.packed, scene.grid, triangles, scene.block_starts, scene.starts)
        boxes = plane_boxes(coarse.packed.nodes, scene.grid)
        tree = wide_tree(packed, triangles, scene.block_starts, boxes)
        assert np.array_equal(np.isfinite(tree.boxes[:, 0]), there)
        assert (tree.boxes[:, :3] <= finer[:, :3]).all()
        assert (tree.boxes[:, 3:] >= finer[:, 3:]).all()
        assert not np.array_equal(tree.boxes, finer)
        finer = tree.boxes


def test_hits_are_the_same_and_more_is_visited(scene: Scene) -> None:
    rays = camera_rays(Camera.framing(scene.positions, width=48, height=48))
    expected = Tracer(scene, device="cpu").closest_hit(*rays, counters=True)
    assert expected.counters is not None
    visited = int(expected.counters.nodes.sum())
    for bits in (8, 4, 1):
        coarse = coarsened(scene, bits)
        counted = []
        for tracer in (
            Tracer.of_layout(lay_out_planes(coarse), device="cpu"),
            Tracer(coarse, device="cpu", resident="compressed"),
        ):
            hits = tracer.closest_hit(*rays, counters=True)
            for name in FIELDS:
                np.testing.assert_array_equal(getattr(hits, name), getattr(expected, name))
            assert hits.counters is not None
            counted.append(int(hits.counters.nodes.sum()))
        assert min(counted) >= visited
        visited = min(counted)
    assert visited > int(expected.counters.nodes.sum())


@pytest.mark.parametrize("bits", [0, 9])
def test_bits_out_of_range_are_refused(scene: Scene, bits: int) -> None:
    with pytest.raises(UsageError, match="out of range"):
        coarsened(scene, bits)


def test_a_scene_is_left_as_it_was(scene: Scene) -> None:
    stored = replace(scene, packed=scene.with_boxes())
    before = stored.packed.nodes.tobytes()
    coarsened(stored, 2)
    assert stored.packed.nodes.tobytes() == before
