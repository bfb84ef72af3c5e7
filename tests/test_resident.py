"""Packed blocks traced as they lie: the hits of the expanded walk, bit for bit, wherever rays come from."""

from mmap import mmap

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rays import axial_rays, far_rays, rays_at, rays_from_inside
from shapes import SHAPES, THIN, UNITS, moved_sphere
from strategies import clean_meshes, cube, grid, soup, sphere
from test_trace import assert_equal_hits

import striptools
from striptools.errors import UsageError
from striptools.kernels.rays import ROW
from striptools.mesh.clean import clean
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.reducem.scene import empty_scene
from striptools.strips.ordering import OrderingOptions
from striptools.trace import Tracer
from striptools.trace import walk_packed as walk
from striptools.trace.box import slab_of
from striptools.trace.launch import program
from striptools.trace.packed import lay_out_packed
from striptools.trace.walk import DONE, Decode

ALL_SHAPES = {**SHAPES, "thin": THIN}
FIELDS = ("t", "face", "u", "v", "triangle")


def scene_of(mesh, *, remap=True, max_length=64, block=256):
    ordering = OrderingOptions(max_length=max_length, block=block)
    return striptools.convert(mesh, Options(ordering=ordering, remap=remap, threads=1))


def both(scene, **options):
    kinds = ("expanded", "compressed")
    return [Tracer(scene, device="cpu", threads=1, resident=kind, **options) for kind in kinds]


def assert_same(scene, origins, directions, t_max=None):
    """Every field of every ray is the same, and any hit is the same as whether there is a closest one."""
    expanded, compressed = both(scene)
    one = expanded.closest_hit(origins, directions, t_max=t_max)
    two = compressed.closest_hit(origins, directions, t_max=t_max)
    assert_equal_hits(FIELDS, ((scene, one), (scene, two)), origins, directions)
    np.testing.assert_array_equal(compressed.any_hit(origins, directions, t_max=t_max), two.hit)
    return two


@settings(max_examples=12)
@given(
    clean_meshes(),
    st.integers(0, 2**32 - 1),
    st.booleans(),
    st.sampled_from([1, 3, 64]),
    st.sampled_from([16, 256]),
)
def test_any_mesh_has_the_same_hits(mesh, seed, remap, max_length, block):
    scene = scene_of(mesh, remap=remap, max_length=max_length, block=block)
    assert_same(scene, *rays_at(scene, 60, seed))


@pytest.mark.parametrize(("shape", "remap"), [(name, k % 2 == 0) for k, name in enumerate(ALL_SHAPES)])
def test_shapes_have_the_same_hits(shape, remap):
    mesh = clean(Mesh(*ALL_SHAPES[shape])).mesh
    scene = scene_of(mesh, remap=remap)
    hits = assert_same(scene, *rays_at(scene, 600, 5))
    assert hits.hit.sum() > 50


@pytest.mark.parametrize(("scale", "offset"), UNITS)
def test_units_and_offsets_have_the_same_hits(scale, offset):
    scene = scene_of(clean(Mesh(*moved_sphere(scale, offset))).mesh)
    assert_same(scene, *rays_at(scene, 400, 7))


def test_every_mode_of_coordinates_has_the_same_hits():
    """Coordinates of all magnitudes at once, -0.0 and denormals among them: modes 0, 1 and 2."""
    random = np.random.default_rng(3)
    positions, faces = soup(400, 1, 1000)
    positions = positions / np.float32(1000)
    positions[::3] *= np.float32(10.0) ** random.integers(-42, 1, (len(positions[::3]), 3)).astype(np.float32)
    positions[random.random(positions.shape) < 0.05] = -0.0
    mesh = clean(Mesh(positions, faces)).mesh
    for unit in (1.0, 2.0**-100, 2.0**60):
        scene = scene_of(Mesh(mesh.positions * np.float32(unit), mesh.faces))
        assert lay_out_packed(scene).decode.as_bits
        assert_same(scene, *rays_at(scene, 400, 8))
    lattice = scene_of(Mesh(*clean_lattice()))
    assert lay_out_packed(lattice).decode == Decode(2, True, False, False, False)
    assert_same(lattice, *rays_at(lattice, 400, 9))


def clean_lattice():
    positions, faces = grid(6, 6)
    positions[:, 0] = np.where(positions[:, 0] == 0, -0.0, positions[:, 0])
    mesh = clean(Mesh(positions, faces)).mesh
    return mesh.positions, mesh.faces


def test_flips_are_followed():
    random = np.random.default_rng(4)
    positions, faces = sphere(3)
    faces = np.where((random.random(len(faces)) < 0.4)[:, None], faces[:, ::-1], faces)
    scene = scene_of(Mesh(positions, np.ascontiguousarray(faces)))
    assert lay_out_packed(scene).decode.flips == (scene.flips is not None)
    assert_same(scene, *rays_at(scene, 600, 5))


@pytest.fixture(scope="module")
def ball():
    return scene_of(Mesh(*sphere(5)))


@pytest.mark.parametrize("distance", [1e2, 1e4, 1e6])
def test_far_origins_have_the_same_hits(ball, distance):
    hits = assert_same(ball, *far_rays(ball, distance))
    assert hits.hit.mean() > 0.3


def test_limits_of_t_are_the_same(ball):
    origins, directions = rays_at(ball, 2000, 6)
    assert_same(ball, origins, directions, t_max=np.float32(1))
    assert_same(ball, origins, directions, t_max=np.linspace(0, 2, len(origins)).astype(np.float32))


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rays_along_axes_in_the_planes_of_boxes(axis):
    scene = scene_of(clean(Mesh(*cube())).mesh)
    for sign in (1.0, -1.0):
        origins, directions, _ = axial_rays(axis, sign)
        assert assert_same(scene, origins, directions).hit.all()


def test_no_ray_leaves_a_closed_sphere(ball):
    assert assert_same(ball, *rays_from_inside(ball)).hit.all()


def test_real_models_have_the_same_hits(real_mesh):
    for name in ("chandelier", "tree_japanesemaple"):
        scene = striptools.convert(real_mesh(name))
        assert_same(scene, *rays_at(scene, 3000, 11))


# ---- Boxes.


def boxes_met(scene, origin, direction):
    """Which slots' boxes the walk enters of all nodes, (m, 8) bool, and the boxes' exact scaled sides."""
    layout = lay_out_packed(scene)
    arrays = layout.arrays
    count = len(scene.with_boxes().nodes)
    slab = slab_of(jnp.asarray(origin), jnp.asarray(direction), arrays.frame)
    scene_on_device = type(arrays)(*(jnp.asarray(a) for a in arrays[:-1]), arrays.frame)
    met = [scene_on_device.lanes_met(jnp.int32(k), slab, jnp.float32(np.inf)) for k in range(count)]
    record = arrays.planes[:count]
    nodes = arrays.nodes[:count].astype(np.int64)
    start = np.stack([nodes[:, 2] & 0xFFFF, nodes[:, 2] >> 16, nodes[:, 3] & 0xFFFF], axis=1)
    shift = np.stack([nodes[:, 0] >> 28, nodes[:, 3] >> 24 & 15, nodes[:, 3] >> 28], axis=1)
    planes = record[:, 2:].reshape(-1, 2, 3, 8).astype(np.int64)
    cells = start[:, None, :, None] + (planes << shift[:, None, :, None])
    frame = arrays.frame
    sides = frame.low.astype(np.float64)[:, None] + cells * frame.unit.astype(np.float64)[:, None]
    return np.array(met), sides, planes[:, 0, 0] > planes[:, 1, 0], float(frame.scale)


@pytest.mark.parametrize("far", [1.0, 300.0, 1e5])
def test_no_box_is_missed_that_the_exact_ray_meets(far):
    scene = scene_of(Mesh(*sphere(2)), block=16)
    random = np.random.default_rng(int(far))
    wrongly = 0
    for _ in range(12):
        target = scene.positions[random.integers(len(scene.positions))]
        origin = (target + far * random.normal(size=3)).astype(np.float32)
        if random.random() < 0.5:
            origin[random.integers(3)] = target[random.integers(3)]
        direction = (target - origin).astype(np.float32)
        direction /= np.float32(2.0) ** np.floor(np.log2(np.abs(direction).max()))
        met, sides, empty, scale = boxes_met(scene, origin, direction)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = (sides - (origin.astype(np.float64) * scale)[:, None]) / direction.astype(np.float64)[:, None]
        inside = ((origin * scale)[:, None] >= sides[:, 0]) & ((origin * scale)[:, None] <= sides[:, 1])
        still = (direction == 0)[:, None]
        low = np.where(still, np.where(inside, -np.inf, np.inf), t.min(axis=1)).max(axis=1)
        high = np.where(still, np.where(inside, np.inf, -np.inf), t.max(axis=1)).min(axis=1)
        exact = (np.maximum(low, 0) <= high) & ~empty
        assert not (exact & ~met).any()
        assert not (met & empty).any()
        wrongly += int((met & ~exact).sum())
    assert wrongly < 3000


# ---- What is asked, and how.


def test_memory_decides_what_auto_is(ball):
    count = ball.triangle_count
    small, large = (Tracer(ball, device="cpu", memory_budget=k * count) for k in (20, 200))
    assert (small.resident, large.resident) == ("compressed", "expanded")
    assert small.resident_bytes < large.resident_bytes / 3
    assert Tracer(ball, device="cpu").resident == "expanded"


def test_wrong_kinds_are_told(ball):
    with pytest.raises(UsageError, match="no such residency"):
        Tracer(ball, device="cpu", resident="packed")
    with pytest.raises(UsageError, match="rebuilt hierarchy is expanded"):
        Tracer(ball, device="cpu", resident="compressed", hierarchy="rebuilt")


def test_nothing_is_hit_in_an_empty_scene():
    for tracer in both(empty_scene()):
        hits = tracer.closest_hit(np.zeros((3, 3)), np.ones((3, 3)))
        assert not hits.hit.any()
        assert not tracer.any_hit(np.zeros((3, 3)), np.ones((3, 3))).any()


def test_steps_are_counted_alike(ball):
    origins, directions = rays_at(ball, 500, 12)
    counted = [tracer.closest_hit(origins, directions, counters=True).counters for tracer in both(ball)]
    one, two = (each.steps for each in counted)
    assert (two[two > 0] >= 1).all()
    assert abs(int(two.sum()) - int(one.sum())) < 0.2 * one.sum()


def test_all_rays_at_once_have_the_same_hits(ball):
    """The GPU's way of walking, on a CPU."""
    origins, directions = rays_at(ball, 200, 13)
    tracer = both(ball)[1]
    plain = tracer.closest_hit(origins, directions)
    tracer._on_gpu = True
    np.testing.assert_array_equal(tracer.closest_hit(origins, directions).t, plain.t)


def test_a_tree_that_goes_round_ends(ball):
    tracer = both(ball)[1]
    layout = tracer._layout
    slots = layout.arrays.slots
    slots[slots < 1 << 31] = 0
    tracer._take(layout)
    with pytest.raises(striptools.errors.StriptoolsError, match="did not end"):
        tracer.closest_hit(*rays_at(ball, 50, 0))


@pytest.mark.parametrize(("any_hit", "steps"), [(False, False), (True, False), (False, True)])
@pytest.mark.parametrize("remap", [True, False])
def test_walks_are_hoisted(any_hit, steps, remap):
    from test_hoisting import assert_hoisted

    tracer = both(scene_of(Mesh(*sphere(3)), remap=remap))[1]
    options = tracer._options(any_hit=any_hit, counting=steps)
    rows, live = np.zeros((256, ROW), np.float32), np.full(1, 256, np.int32)
    lowered = program(tracer._mesh, options).lower(tracer._scene, rows, live)
    assert_hoisted(lowered, loops=3)


def mapping_below(array):
    """What an array's memory is in the end."""
    while isinstance(array, np.ndarray) and array.base is not None:
        array = array.base
    return array.obj if isinstance(array, memoryview) else array


@pytest.mark.parametrize("remap", [True, False])
def test_stored_boxes_are_traced_where_the_file_is_mapped(tmp_path, remap):
    path = tmp_path / "ball.rdm"
    kept = scene_of(Mesh(*sphere(5)), remap=remap)
    kept.storing_boxes().save(path)
    scene = striptools.open(path)
    sections = scene.packed.nodes, scene.blocks.words
    for threads in (1, None):
        tracer = Tracer(scene, device="cpu", threads=threads, resident="compressed")
        on_device = tracer._scene
        for section, array in zip(sections, (on_device.nodes, on_device.words), strict=True):
            assert isinstance(mapping_below(section), mmap)
            places = [shard.data.unsafe_buffer_pointer() for shard in array.addressable_shards]
            assert places == [section.ctypes.data] * len(tracer.devices)
        places = [shard.data.unsafe_buffer_pointer() for shard in on_device.planes.addressable_shards]
        assert places == [scene.packed.nodes.ctypes.data] * len(tracer.devices)
    rays = rays_at(kept, 500, 5)
    expected = both(kept)[0].closest_hit(*rays)
    for field in FIELDS:
        np.testing.assert_array_equal(getattr(tracer.closest_hit(*rays), field), getattr(expected, field))
    beside = tracer.resident_bytes - sum(section.nbytes for section in sections)
    worked_out = 32 * len(scene.packed.nodes) + 64 * scene.block_count
    assert 0 <= beside - worked_out <= 5 * scene.triangle_count


def test_boxes_that_no_file_holds_are_copied_to_size_classes(ball):
    one, two = (lay_out_packed(scene_of(Mesh(*sphere(3)), max_length=length)).arrays for length in (63, 64))
    assert len(one.blocks) == len(two.blocks) == 64
    assert one.nodes.ctypes.data % 64 == 0


def test_the_bottom_of_a_stack_is_done(ball):
    arrays = lay_out_packed(ball).arrays
    end = jnp.int32(arrays.node_count - 1)
    on_device = type(arrays)(*(jnp.asarray(a) for a in arrays[:-1]), arrays.frame)
    assert int(on_device.child_of(end, jnp.uint32(8))) == DONE
    assert walk.MARGIN == 2.0**-19
