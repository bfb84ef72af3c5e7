"""The scene: what goes in comes out, in the source's order where there is a remap."""

import io
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import scene_of, scenes, small_scene
from strategies import clean_meshes

from striptools.errors import LimitError, StriptoolsError, UnreadableSceneError, UsageError
from striptools.hierarchies.packed import check_packed
from striptools.reducem.blocks import Blocks
from striptools.reducem.check import check_limits, check_scene
from striptools.reducem.reader import read_scene
from striptools.reducem.scene import Remap, empty_scene
from striptools.reducem.validate import validate


def corners(positions, faces):
    """The bits of each triangle's corners: equal only where positions are, down to the sign of zero."""
    return positions[faces].view(np.uint32)


def turned_to_least_corner(rows):
    """The triangles without order or rotation: each turned so that its least corner is first, all sorted."""
    turned = [min(tuple(map(tuple, np.roll(row, -k, axis=0))) for k in range(3)) for row in rows]
    return sorted(turned)


@given(
    clean_meshes(),
    st.sampled_from([1, 3, 64]),
    st.integers(0, 3),
    st.booleans(),
    st.sampled_from([4, 40, 256]),
)
def test_with_a_remap_the_source_comes_back_face_by_face(mesh, max_length, spare, flips, block):
    scene = scene_of(mesh, max_length=max_length, spare_faces=spare, flips=flips, block=block)
    back = scene.to_mesh()
    np.testing.assert_array_equal(
        corners(back.positions, back.faces), corners(mesh.positions, mesh.faces), strict=True
    )
    assert back.vertex_count == mesh.vertex_count
    assert np.diff(scene.block_starts).max() <= block


@given(clean_meshes(), st.booleans())
def test_without_one_every_face_comes_back_once_and_none_reflected(mesh, flips):
    back = scene_of(mesh, remap=False, flips=flips).to_mesh()
    assert turned_to_least_corner(corners(back.positions, back.faces)) == turned_to_least_corner(
        corners(mesh.positions, mesh.faces)
    )


@given(scenes())
def test_a_scene_keeps_every_rule_and_its_hierarchy_can_be_trusted(case):
    _, scene = case
    check_scene(scene)
    scene.check()
    given_ = (scene.grid, scene.triangle_boxes(), scene.block_starts, scene.starts)
    check_packed(scene.packed, *given_)
    check_packed(scene.with_boxes(), *given_)
    assert scene.with_boxes() is scene.with_boxes()


@given(scenes())
def test_the_parts_add_up_to_the_file(case):
    _, scene = case
    file = io.BytesIO()
    size = scene.save(file)
    parts = scene.part_bytes()
    assert sum(parts.values()) == size == len(file.getvalue())
    assert min(parts.values()) >= 0
    assert (parts["remap"] > 0) == (scene.remap is not None)
    assert (parts["in_block_hierarchy"] > 0) == (scene.boxes == "stored")
    assert scene.bytes_per_triangle() == pytest.approx((size - parts["remap"]) / scene.triangle_count)


@given(scenes())
def test_stored_boxes_are_those_that_are_rebuilt(case):
    _, scene = case
    rebuilt = replace(scene, packed=replace(scene.packed, nodes=scene.packed.nodes[: scene.packed.top_count]))
    rebuilt = replace(rebuilt, packed=replace(rebuilt.packed, first_run=None, runs=None, longest_run=0))
    again = rebuilt.with_boxes()
    for name in ("nodes", "first_run", "runs"):
        np.testing.assert_array_equal(getattr(again, name), getattr(scene.with_boxes(), name))
    assert rebuilt.resident_bytes_per_triangle() == scene.resident_bytes_per_triangle()


def test_positions_and_faces_are_decoded_once():
    scene = small_scene()
    assert scene.faces() is scene.faces()
    assert scene.positions is scene.positions


def test_the_empty_scene_is_a_valid_scene():
    scene = empty_scene(3, {"generator": "a test"})
    file = io.BytesIO()
    scene.save(file)
    assert validate(file.getvalue()) == []
    back = read_scene(file.getvalue())
    for one in (scene, back):
        assert (one.triangle_count, one.vertex_count, one.strip_count, one.block_count) == (0, 0, 0, 0)
        assert one.faces().shape == one.to_mesh().positions.shape == (0, 3)
        assert one.bytes_per_triangle() == len(file.getvalue())
        assert one.with_boxes() is one.packed
    assert (back.source_face_count, back.metadata) == (3, {"generator": "a test"})


def test_a_scene_over_a_limit_is_refused_before_it_is_written():
    with pytest.raises(LimitError, match="source faces"):
        check_limits(replace(small_scene(), source_face_count=2**32))


def changed(array, at, value):
    array = array.copy()
    array[at] = value
    return array


def with_blocks(scene, *, headers=None, words=None):
    blocks = scene.blocks
    return replace(
        scene,
        blocks=Blocks(
            blocks.headers if headers is None else headers, blocks.words if words is None else words
        ),
    )


def with_remap(scene, **fields):
    return replace(scene, remap=replace(scene.remap, **fields))


def with_nodes(scene, at, value):
    return replace(scene, packed=replace(scene.packed, nodes=changed(scene.packed.nodes, at, value)))


def with_runs(scene, **fields):
    return replace(scene, packed=replace(scene.packed, **fields))


FAULTS = {
    "RDM201": lambda s: replace(s, source_face_count=s.triangle_count - 1),
    "RDM202": lambda s: replace(s, error_bound=float("nan")),
    "RDM203": lambda s: replace(s, grid_exponent=105),
    "RDM204": lambda s: replace(s, grid_exponent=0),
    "RDM205": lambda s: replace(s, low=s.low - np.float32(1)),
    "RDM206": lambda s: replace(s, grid=replace(s.grid, cell=changed(s.grid.cell, 1, 128))),
    "RDM207": lambda s: with_runs(s, longest_run=9),
    "RDM501": lambda s: with_remap(s, rotation=changed(s.remap.rotation, 2, 3)),
    "RDM502": lambda s: with_remap(s, face=changed(s.remap.face, 2, s.source_face_count)),
    "RDM503": lambda s: with_remap(s, face=changed(s.remap.face, 2, s.remap.face[3])),
    "RDM601": lambda s: with_blocks(s, headers=changed(s.blocks.headers, (1, 0), 0)),
    "RDM602": lambda s: with_blocks(s, headers=changed(s.blocks.headers, (1, 1), 0)),
    "RDM606": lambda s: with_blocks(s, words=s.blocks.words[:-16]),
    "RDM701": lambda s: with_nodes(s, (0, 1), s.packed.nodes[0, 1] + np.uint32(1)),
    "RDM705": lambda s: with_nodes(s, (0, 4), 0xFFFFFFFF),
    "RDM707": lambda s: with_nodes(s, (0, 2), 1),
    "RDM709": lambda s: with_nodes(s, (0, 1), s.packed.nodes[0, 1] ^ np.uint32(1 << 31)),
    "RDM801": lambda s: with_runs(s, first_run=changed(s.packed.first_run, 0, 1)),
    "RDM802": lambda s: with_runs(s, longest_run=1),
    "RDM803": lambda s: with_runs(s, runs=changed(s.packed.runs, 0, s.packed.runs[1])),
    "RDM804": lambda s: with_runs(s, runs=s.packed.runs ^ np.uint32(1 << 27)),
    "RDM901": lambda s: replace(s, metadata=[]),
    "RDM903": lambda s: replace(s, metadata={"unit": 3}),
}
NEIGHBOURS = {"RDM701": {"RDM703"}}
"""A wrong link shows at whichever end is looked at first."""


@pytest.mark.parametrize("code", FAULTS)
def test_every_injected_fault_is_found_and_never_written(code):
    broken = FAULTS[code](small_scene(block=6, boxes="stored"))
    file = io.BytesIO()
    with pytest.raises(UnreadableSceneError) as caught:
        broken.save(file)
    assert caught.value.what.split()[0] in {code} | NEIGHBOURS.get(code, set())
    assert file.getvalue() == b""


def test_a_wrong_dtype_is_named():
    scene = small_scene()
    with pytest.raises(UsageError, match="rotation has dtype int64"):
        check_scene(with_remap(scene, rotation=scene.remap.rotation.astype(np.int64)))


def test_a_remap_of_another_length_is_found():
    scene = small_scene()
    with pytest.raises(StriptoolsError, match="RDM114"):
        check_scene(replace(scene, remap=Remap(scene.remap.face[:-1], scene.remap.rotation[:-1])))


def test_a_name_that_a_scene_does_not_have_is_an_attribute_error():
    with pytest.raises(AttributeError, match="colour"):
        _ = small_scene().colour


def test_a_real_model_comes_back(real_mesh, tmp_path):
    from striptools.mesh.clean import clean
    from striptools.mesh.io import load_mesh

    mesh = clean(load_mesh(real_mesh("bunny"))).mesh
    scene = scene_of(mesh)
    scene.save(tmp_path / "bunny.rdm")
    back = read_scene(tmp_path / "bunny.rdm").to_mesh()
    np.testing.assert_array_equal(
        corners(back.positions, back.faces), corners(mesh.positions, mesh.faces), strict=True
    )
    assert scene.bytes_per_triangle() <= 8
