"""The tracer: equal to trying every triangle, watertight, the same whatever the order, threads or walk."""

from dataclasses import replace

import jax
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rays import aimed_rays, axial_rays, edge_targets, rays_at
from scenes import scene_of, scenes, small_scene, with_positions
from shapes import COMMON
from strategies import cube, sphere

from striptools.errors import StriptoolsError, UsageError
from striptools.kernels.rays import ROW, ready_rays
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer, walk
from striptools.trace.launch import _collect, _spread, tiles
from striptools.trace.leaves import aligned_full, lay_out, scale_of, size_class
from striptools.trace.packed import lay_out_packed
from striptools.trace.streams import EVERY_RAY
from striptools.trace.walk import DONE, FLOATS, WalkOptions, prepared_rays, trace_rays

LOWEST = np.finfo(np.float32).min


# ---- Trying every triangle, in the tracer's own float32 arithmetic written out in NumPy.


def flushed(value):
    """XLA takes denormals for zeros, in and out."""
    return np.where(np.abs(value) < np.finfo(np.float32).tiny, value * np.float32(0), value).astype(
        np.float32
    )


def rounded(product):
    return flushed(np.where(product > LOWEST, product, LOWEST))


def named_corners(scene):
    """Corners of each triangle from its smallest, the face reported for it, its turn from the source's."""
    faces = scene.faces()
    corners = flushed(scene.positions[faces] * scale_of(scene))
    order = np.array([min(range(3), key=lambda j: tuple(row[j] + 0.0)) for row in corners])
    turned = np.take_along_axis(corners, ((np.arange(3) + order[:, None]) % 3)[..., None], axis=1)
    if scene.remap is None:
        return turned, np.arange(len(faces)), order % 3
    return turned, scene.remap.face, (order + scene.remap.rotation) % 3


@np.errstate(all="ignore")
def try_every_triangle(scene, origins, directions, t_max=np.inf):
    """Least t, then least face, of every triangle for every ray: (t, face, u, v)."""
    corners, ids, turns = named_corners(scene)
    best = []
    for o, d in zip(flushed(origins) * scale_of(scene), directions, strict=True):
        best.append(_try_one(corners, ids, turns, o, d, np.float32(t_max) * scale_of(scene)))
    t, face, u, v = (np.array(column) for column in zip(*best, strict=True))
    return (t / scale_of(scene)).astype(np.float32), face, u, v


def _try_one(corners, ids, turns, o, d, t_max):
    hits = try_one(corners, ids, turns, o, d, t_max)
    return hits[0] if hits else (np.float32(np.inf), -1, np.float32(0), np.float32(0))


def try_one(corners, ids, turns, o, d, t_max=np.inf, *, all_signs=False):
    """All hits of a ray, by t and then by face: (t, face, u, v); with `all_signs` those far from it too."""
    if not (np.isfinite(o).all() and np.isfinite(d).all() and np.abs(d).max() >= np.finfo(np.float32).tiny):
        return []
    o, d = flushed(o), flushed(d)
    length = np.float32(2.0) ** np.floor(np.log2(np.abs(d).max()))
    d, t_max = flushed(d / length), t_max * length
    z = int(np.argmax(np.abs(d)))
    x, y = (z + 1) % 3, (z + 2) % 3
    sx, sy, sz = d[x] / d[z], d[y] / d[z], np.float32(1) / d[z]
    p = flushed(flushed(corners) - o)
    px, py = (flushed(p[..., k] - rounded(s * p[..., z])) for k, s in ((x, flushed(sx)), (y, flushed(sy))))
    height = rounded(p[..., z] * sz)

    def edge(i, j):
        return flushed(rounded(px[:, i] * py[:, j]) - rounded(py[:, i] * px[:, j]))

    a, b, c = edge(2, 1), edge(0, 2), edge(1, 0)
    inside = ((a >= 0) & (b >= 0) & (c >= 0)) | ((a <= 0) & (b <= 0) & (c <= 0))
    around = np.all([(q.min(axis=1) <= 0) & (q.max(axis=1) >= 0) for q in (px, py)], axis=0)
    whole = flushed(flushed(a + b) + c)
    t = flushed(rounded(a * height[:, 0]) + rounded(b * height[:, 1])) + rounded(c * height[:, 2])
    t = flushed(t)
    t = np.where(whole < 0, -t, t) / np.abs(whole)
    met = inside & around & (whole != 0) & (t > 0) & (t < t_max)
    hit = np.flatnonzero(met & (all_signs | near(corners, o, d, t)))
    found = []
    for k in hit[np.lexsort((ids[hit], t[hit]))]:
        weights = np.array([a[k], b[k], c[k]]) / whole[k]
        by_corner = weights[(np.arange(3) - turns[k]) % 3]
        found.append((t[k] / length, ids[k], by_corner[1], by_corner[2]))
    return found


def near(corners, o, d, t, reach=0.0):
    """Whether the point at t is in a triangle's box, but for half of what the tracer widens boxes by.

    The weights of a triangle no larger than its distance is rounded by, of a sliver seen obliquely, or of one
    whose products underflow are wrong, and so is its t: see `measure.bound`, term 9. Only its box tells.
    """
    margin = 2.0**-22 * max(np.abs(corners).max(), np.abs(o).max(), reach)
    point = o.astype(np.float64) + t[:, None].astype(np.float64) * d
    return ((point >= corners.min(axis=1) - margin) & (point <= corners.max(axis=1) + margin)).all(axis=1)


def beyond_box(scene, hits, origins, directions):
    """Hits whose point is not in their triangle's box: a path that culls the box does not find them."""
    met = np.flatnonzero(hits.hit)
    corners = scene.positions[scene.faces()[hits.triangle[met]]]
    reach = np.abs([scene.low, scene.high]).max()
    rays = zip(corners, origins[met], directions[met], hits.t[met], strict=True)
    flags = np.zeros(len(origins), np.bool_)
    flags[met] = [not near(c[None], o, d, t[None], reach)[0] for c, o, d, t in rays]
    return flags


def excused(scene, hits, other_scene, other_hits, origins, directions):
    """Rays of which two paths may report different hits: the closer of both is `beyond_box`."""
    closer = (hits.t < other_hits.t) | ((hits.t == other_hits.t) & (hits.face < other_hits.face))
    first = beyond_box(scene, hits, origins, directions)
    return np.where(closer, first, beyond_box(other_scene, other_hits, origins, directions))


def assert_equal_hits(fields, paths, origins, directions):
    """Fields of two paths' hits, pairs of scene and hits, are the same for all rays but those `excused`."""
    (scene, hits), (other_scene, other_hits) = paths
    pairs = [(getattr(hits, field), getattr(other_hits, field)) for field in fields]
    differ = np.any([~((a == b) | (a != a) & (b != b)) for a, b in pairs], axis=0)
    if differ.any():
        differ &= ~excused(scene, hits, other_scene, other_hits, origins, directions)
    assert not differ.any(), np.flatnonzero(differ)


def test_hits_that_are_not_excused_must_be_equal():
    scene = scene_of(Mesh(*sphere(3)))
    origins, directions = rays_at(scene, 60, 2)
    hits = Tracer(scene, device="cpu", threads=1).closest_hit(origins, directions)
    assert_equal_hits(("t", "face"), ((scene, hits), (scene, hits)), origins, directions)
    farther = replace(hits, t=np.where(hits.hit, np.nextafter(hits.t, np.float32(np.inf)), hits.t))
    with pytest.raises(AssertionError):
        assert_equal_hits(("t", "face"), ((scene, hits), (scene, farther)), origins, directions)


def far_fetched(scene, hits, origins, directions, expected=None):
    """Hits `beyond_box`, or of `faint` triangles, which the tracer may find or not."""
    faces = [hits.face] if expected is None else [hits.face, expected[1]]
    flags = [faint(scene, face, origins, directions) for face in faces]
    return beyond_box(scene, hits, origins, directions) | np.any(flags, axis=0)


def faint(scene, face, origins, directions):
    """Whether the triangle a ray hits is so thin to it, in the tracer's scale, that its area underflows."""
    corners, ids, _ = named_corners(scene)
    at = np.zeros(scene.source_face_count, np.int64)
    at[ids] = np.arange(len(ids))
    flags = np.zeros(len(origins), np.bool_)
    for k in np.flatnonzero(face >= 0):
        z = int(np.argmax(np.abs(directions[k])))
        x, y = (z + 1) % 3, (z + 2) % 3
        p = corners[at[face[k]]].astype(np.float64) - origins[k].astype(np.float64) * scale_of(scene)
        slope = directions[k].astype(np.float64) / directions[k, z]
        (ax, bx, cx), (ay, by, cy) = (p[:, i] - slope[i] * p[:, z] for i in (x, y))
        flags[k] = abs((bx - ax) * (cy - ay) - (cx - ax) * (by - ay)) < 2.0**-80
    return flags


def assert_same_hits(scene, hits, expected, doubted=False):
    t, face, u, v = (
        np.where(doubted, ours, theirs)
        for ours, theirs in zip((hits.t, hits.face, hits.u, hits.v), expected, strict=True)
    )
    np.testing.assert_array_equal(hits.face, face)
    np.testing.assert_array_equal(hits.t, t)
    np.testing.assert_allclose(hits.u, u, atol=1e-6)
    np.testing.assert_allclose(hits.v, v, atol=1e-6)
    ids = np.arange(scene.triangle_count) if scene.remap is None else scene.remap.face
    np.testing.assert_array_equal(np.where(hits.triangle < 0, -1, ids[hits.triangle]), face)


# ---- Rays from where bugs live.


@settings(max_examples=30)
@given(scenes(), st.integers(0, 2**32 - 1))
def test_equals_trying_every_triangle(drawn, seed):
    _, scene = drawn
    origins, directions = rays_at(scene, 60, seed)
    tracer = Tracer(scene, device="cpu", threads=1)
    hits = tracer.closest_hit(origins, directions)
    expected = try_every_triangle(scene, origins, directions)
    doubted = far_fetched(scene, hits, origins, directions, expected)
    assert_same_hits(scene, hits, expected, doubted)
    np.testing.assert_array_equal(tracer.any_hit(origins, directions), hits.hit)


@pytest.fixture(scope="module")
def ball():
    positions, faces = sphere(3)
    return scene_of(Mesh(positions, faces))


@pytest.mark.parametrize("shape", COMMON.values(), ids=COMMON)
@pytest.mark.parametrize("remap", [True, False])
def test_shapes_equal_trying_every_triangle(shape, remap):
    scene = scene_of(Mesh(*clean(shape)), remap=remap, spare_faces=3)
    origins, directions = rays_at(scene, 300, 5)
    hits = Tracer(scene, device="cpu", threads=1).closest_hit(origins, directions)
    assert_same_hits(scene, hits, try_every_triangle(scene, origins, directions))
    assert hits.hit.sum() > 50


def clean(shape):
    from striptools.mesh.clean import clean as clean_mesh

    mesh = clean_mesh(Mesh(*shape)).mesh
    return mesh.positions, mesh.faces


# ---- Against the truth in float64.


def exact_hits(corners, origins, directions):
    """Moeller-Trumbore in float64 over all triangles: least t, and how far each ray stays from all edges."""
    a, b, c = (corners[:, k].astype(np.float64) for k in range(3))
    t_least, margin = [], []
    for o, d in zip(origins.astype(np.float64), directions.astype(np.float64), strict=True):
        p = np.cross(d, c - a)
        det = np.einsum("ij,ij->i", b - a, p)
        s = o - a
        q = np.cross(s, b - a)
        with np.errstate(all="ignore"):
            u, v, t = np.einsum("ij,ij->i", s, p) / det, q @ d / det, np.einsum("ij,ij->i", c - a, q) / det
        low = np.minimum(np.minimum(u, v), 1 - u - v)
        met = (low >= 0) & (t > 0)
        t_least.append(t[met].min() if met.any() else np.inf)
        margin.append(np.nanmin(np.abs(low[t > 0]), initial=1.0))
    return np.array(t_least), np.array(margin)


def test_agrees_with_float64(ball):
    random = np.random.default_rng(3)
    origins = random.normal(size=(400, 3)).astype(np.float32) * 2
    directions = random.normal(size=(400, 3)).astype(np.float32) * 3 - origins
    hits = Tracer(ball, device="cpu", threads=1).closest_hit(origins, directions)
    t, margin = exact_hits(ball.positions[ball.faces()], origins, directions)
    clear = margin > 1e-4
    assert clear.mean() > 0.5
    np.testing.assert_array_equal(np.isfinite(hits.t)[clear], np.isfinite(t)[clear])
    both = clear & np.isfinite(t)
    np.testing.assert_allclose(hits.t[both], t[both], rtol=2e-5)


def test_u_and_v_give_the_point_from_the_sources_first_corner():
    positions, faces = sphere(2)
    random = np.random.default_rng(1)
    faces = np.take_along_axis(faces, (np.arange(3) + random.integers(0, 3, (len(faces), 1))) % 3, axis=1)
    scene = scene_of(Mesh(positions, faces))
    origins = random.normal(size=(500, 3)).astype(np.float32) * 0.2
    directions = random.normal(size=(500, 3)).astype(np.float32)
    hits = Tracer(scene, device="cpu", threads=1).closest_hit(origins, directions)
    assert hits.hit.all()
    a, b, c = (positions[faces[hits.face, k]] for k in range(3))
    u, v = hits.u[:, None], hits.v[:, None]
    np.testing.assert_allclose(
        (1 - u - v) * a + u * b + v * c, origins + hits.t[:, None] * directions, atol=3e-6
    )


# ---- No ray slips through.


@pytest.mark.parametrize(("scale", "move"), [(1.0, 0.0), (1e-3, 0.0), (1e3, 0.0), (1.0, 100.0)])
def test_no_ray_leaves_a_closed_sphere(scale, move):
    points, faces = sphere(4)
    diagonal = np.linalg.norm(np.ptp(points, axis=0))
    centre = np.array([move, -move, move]) * diagonal * scale
    positions = (points.astype(np.float64) * scale + centre).astype(np.float32)
    tracer = Tracer(scene_of(Mesh(positions, faces)), device="cpu")
    targets = edge_targets(positions, faces)
    random = np.random.default_rng(0)
    for _ in range(3):
        origin = (centre + random.normal(size=3) * 0.2 * scale).astype(np.float32)
        wobble = 1 + 2 * random.random((9, 1, 1))
        directions = ((targets - origin) * wobble).astype(np.float32).reshape(-1, 3)
        assert len(directions) > 33_000
        assert tracer.any_hit(np.broadcast_to(origin, directions.shape), directions).all()
        assert tracer.closest_hit(np.broadcast_to(origin, directions.shape), directions).hit.all()


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rays_along_axes_in_the_planes_of_boxes_hit(axis, sign):
    positions, faces = clean(cube())
    scene = scene_of(Mesh(positions, faces))
    origins, _, inside = axial_rays(axis, sign)
    tracer = Tracer(scene, device="cpu", threads=1)
    for zero in (0.0, -0.0, 1e-30, -1e-30):
        directions = np.full_like(origins, zero)
        directions[:, axis] = sign
        hits = tracer.closest_hit(origins, directions)
        # What leans outward by 1e-30 rightly misses from the rim.
        assert hits.hit[inside | (zero == 0)].all()
        np.testing.assert_array_equal(hits.t[hits.hit], 5.0 if sign > 0 else 4.0)


# ---- The same whatever the way.


def test_order_of_faces_and_remap_change_nothing_but_names(ball):
    random = np.random.default_rng(2)
    positions, faces = sphere(3)
    shuffle = random.permutation(len(faces))
    turned = np.take_along_axis(
        faces[shuffle], (np.arange(3) + random.integers(0, 3, (len(faces), 1))) % 3, axis=1
    )
    origins, directions = aimed_rays(positions, faces, 2000, 1)
    first = Tracer(ball, device="cpu", threads=1).closest_hit(origins, directions)
    for scene in (
        scene_of(Mesh(positions, turned), max_length=3),
        scene_of(Mesh(positions, faces), remap=False),
    ):
        other = Tracer(scene, device="cpu", threads=1).closest_hit(origins, directions)
        np.testing.assert_array_equal(other.t, first.t)


@pytest.mark.parametrize("count", [5001, 200_001])
def test_all_threads_give_what_one_gives(ball, count):
    origins, directions = rays_at(ball, count, 4)
    one = Tracer(ball, device="cpu", threads=1)
    all_cores = Tracer(ball, device="cpu")
    assert len(one.devices) == 1
    first, other = one.closest_hit(origins, directions), all_cores.closest_hit(origins, directions)
    for name in ("t", "face", "u", "v", "triangle"):
        np.testing.assert_array_equal(getattr(first, name), getattr(other, name))
    for tracer in (one, all_cores):
        np.testing.assert_array_equal(tracer.any_hit(origins, directions), first.hit)


def test_walking_all_rays_at_once_gives_the_same(ball):
    origins, directions = rays_at(ball, 200, 6)
    expected = Tracer(ball, device="cpu", threads=1).closest_hit(origins, directions)
    options = WalkOptions(1, any_hit=False, counting=True, stack_size=16, batch=True)
    reach = np.full(len(origins), np.inf, np.float32)
    traced = jax.jit(trace_rays, static_argnames="options")(
        lay_out(ball).arrays, origins, directions, reach, options=options
    )
    np.testing.assert_array_equal(traced.t, expected.t)
    np.testing.assert_array_equal(traced.name, expected.face)
    assert np.asarray(traced.counters)[:, 0].min() >= 1


def assert_rebuilt_gives_the_same(scene, origins, directions):
    stored = Tracer(scene, device="cpu", threads=1)
    rebuilt = Tracer(scene, device="cpu", threads=1, hierarchy="rebuilt")
    first, other = stored.closest_hit(origins, directions), rebuilt.closest_hit(origins, directions)
    doubted = excused(scene, first, scene, other, origins, directions)
    for name in ("t", "face", "u", "v", "triangle"):
        np.testing.assert_array_equal(getattr(first, name)[~doubted], getattr(other, name)[~doubted])
    some = stored.any_hit(origins, directions) == rebuilt.any_hit(origins, directions)
    assert (some | doubted).all()
    return doubted


@settings(max_examples=20)
@given(scenes(), st.integers(0, 2**32 - 1))
def test_a_rebuilt_hierarchy_changes_nothing(drawn, seed):
    _, scene = drawn
    origins, directions = rays_at(scene, 64, seed)
    assert_rebuilt_gives_the_same(scene, origins, directions)


@pytest.mark.parametrize("remap", [True, False])
def test_a_rebuilt_hierarchy_changes_nothing_of_a_ball(remap):
    scene = scene_of(Mesh(*sphere(4)), remap=remap)
    origins, directions = rays_at(scene, 3000, 11)
    assert not assert_rebuilt_gives_the_same(scene, origins, directions).any()


def test_there_is_no_third_hierarchy(ball):
    with pytest.raises(UsageError, match="no such hierarchy"):
        Tracer(ball, device="cpu", threads=1, hierarchy="best")


@pytest.mark.parametrize("unit", [2.0**-100, 1e-3, 1.0, 2.0**100])
@pytest.mark.parametrize("lay", [lay_out, lay_out_packed])
def test_rays_are_made_ready_alike_here_and_on_a_device(ball, unit, lay):
    scene = with_positions(ball, (ball.positions * np.float32(unit)).astype(np.float32))
    layout = lay(scene)
    arrays = layout.arrays
    origins, directions = rays_at(scene, 2000, 12)
    random = np.random.default_rng(13)
    odd = np.array([0, -0.0, 1e-45, -1e-39, 1e-20, -1e-25, 1, -3, 1e30, 3e38, np.inf, -np.inf, np.nan], "f4")
    origins[:400] = np.where(random.random((400, 3)) < 0.3, random.choice(odd, (400, 3)), origins[:400])
    directions[:800] = np.where(random.random((800, 3)) < 0.3, random.choice(odd, (800, 3)), directions[:800])
    reach = random.choice(np.array([np.inf, 1, 1e-40, 0, -1, np.nan, 1e38, 1e-30], "f4"), 2000)
    device = np.asarray(jax.jit(prepared_rays)(arrays, origins, directions, reach))
    rows, at = aligned_full((2000, ROW), 0.0), np.zeros(2000, np.int32)
    dropped = np.zeros(2000, np.uint8)
    root = (tuple(arrays.frame), *layout.root)
    count, end = ready_rays(
        origins, directions, reach, EVERY_RAY, 0, *root, False, rows, rows.view(np.int32), at, dropped
    )
    assert end == 2000
    assert 1 <= count < 2000
    none = device.view(np.int32)[:, FLOATS + 4] == 0
    np.testing.assert_array_equal(none, dropped == 2)
    np.testing.assert_array_equal(at[:count], np.flatnonzero(~none))
    np.testing.assert_array_equal(rows[:count, :FLOATS], device[~none, :FLOATS])
    words = rows.view(np.int32)[:count, FLOATS:]
    np.testing.assert_array_equal(words, device.view(np.int32)[~none, FLOATS:])


@pytest.mark.parametrize("lay", [lay_out, lay_out_packed])
def test_a_ray_that_is_done_stays_so(ball, lay):
    """Beside one that is not it visits the last node again and again, even one whose boxes it meets."""
    scene = lay(ball).arrays
    if hasattr(scene, "planes"):
        scene = scene._replace(**{n: with_last(getattr(scene, n)) for n in ("nodes", "planes")})
    else:
        scene.nodes[-1, :6] = scene.nodes[0, :6]
    origins, directions = rays_at(ball, 64, 3)
    ready = np.asarray(jax.jit(prepared_rays)(scene, origins, directions, np.full(64, np.inf, "f4")))
    options = WalkOptions(interleave=1, any_hit=False, counting=False, stack_size=32)

    @jax.jit
    def visited(scene, row, child):
        steps, found = walk._Walk(scene, row, options), (walk.nothing_yet(walk.ReadyRay(row)),)
        place = walk.Place(child, np.int32(0))
        state = walk._State((place,), (walk.empty_stack(scene, options),), np.int32(0), ())
        heights = []
        for _ in range(3):
            state = steps.visit_nodes(state, found)
            heights.append(state.places[0].height)
        return state.places[0].child, sum(heights)

    done = np.array([visited(scene, row, DONE) for row in ready])
    assert (done[:, 0] == DONE).all()
    assert not done[:, 1].any()
    assert (np.array([visited(scene, row, np.int32(0)) for row in ready])[:, 1] > 0).any()


def with_last(nodes):
    """The first node once more, last."""
    return np.concatenate([nodes, nodes[:1]])


@pytest.mark.parametrize("hierarchy", ["stored", "rebuilt"])
def test_the_last_wide_node_has_no_children(ball, hierarchy):
    """Whatever a ray that is done takes from the bottom of its stack is `DONE`."""
    last = np.asarray(Tracer(ball, device="cpu", threads=1, hierarchy=hierarchy)._scene.nodes)[-1]
    assert np.isnan(last[:6]).all()
    assert (last[6].view(np.int32) == DONE).all()


def test_power_of_two_units_change_nothing(ball):
    origins, directions = rays_at(ball, 500, 8)
    expected = Tracer(ball, device="cpu", threads=1).closest_hit(origins, directions)
    for unit in (np.float32(2.0**-40), np.float32(2.0**40)):
        scene = with_positions(ball, ball.positions * unit)
        tracer = Tracer(scene, device="cpu", threads=1)
        hits = tracer.closest_hit(origins * unit, directions * unit * np.float32(2.0**20))
        np.testing.assert_array_equal(hits.t * np.float32(2.0**20), expected.t)
        np.testing.assert_array_equal(hits.face, expected.face)


# ---- What is asked, and how.


def test_steps_are_counted_only_when_asked(ball):
    origins, directions = rays_at(ball, 100, 9)
    tracer = Tracer(ball, device="cpu", threads=1)
    plain, counted = (
        tracer.closest_hit(origins, directions),
        tracer.closest_hit(origins, directions, counters=True),
    )
    assert plain.counters is None
    assert counted.counters is not None
    np.testing.assert_array_equal(plain.t, counted.t)
    assert counted.counters.steps[counted.hit].min() >= 2
    assert (counted.counters.steps[~counted.hit] >= 1).all()


def test_hits_beyond_t_max_do_not_count(ball):
    origins = np.zeros((4, 3), np.float32)
    directions = np.tile(np.float32([[0.3, 0.2, 0.7]]), (4, 1))
    tracer = Tracer(ball, device="cpu", threads=1)
    t = tracer.closest_hit(origins, directions).t[0]
    limits = np.array([t, np.nextafter(t, np.float32(9)), 0, np.nan], np.float32)
    np.testing.assert_array_equal(
        tracer.closest_hit(origins, directions, t_max=limits).hit, [False, True, False, False]
    )
    np.testing.assert_array_equal(
        tracer.any_hit(origins, directions, t_max=limits), [False, True, False, False]
    )
    assert not tracer.any_hit(origins, directions, t_max=float(t)).any()
    assert tracer.any_hit(origins, directions, t_max=float(t) * 2).all()


def test_rays_that_are_none_miss(ball):
    bad = [np.nan, np.inf, -np.inf]
    origins = np.zeros((13, 3), np.float32)
    directions = np.ones((13, 3), np.float32)
    for k, value in enumerate(bad):
        origins[k, k] = value
        directions[3 + k, k] = value
    directions[6] = 0
    directions[7] = -0.0
    directions[8] = 1e-45
    origins[9] = 3e38
    tracer = Tracer(ball, device="cpu", threads=1)
    hits = tracer.closest_hit(origins, directions)
    np.testing.assert_array_equal(hits.hit, [False] * 10 + [True] * 3)
    np.testing.assert_array_equal(tracer.any_hit(origins, directions), hits.hit)
    assert np.isinf(hits.t[:10]).all()
    assert (hits.u[:10] == 0).all()
    assert (hits.triangle[:10] == -1).all()


@pytest.mark.parametrize("count", [0, 1, 2, 255, 257, 600])
def test_any_number_of_rays(ball, count):
    origins, directions = np.zeros((count, 3)), np.ones((count, 3))
    tracer = Tracer(ball, device="cpu")
    hits = tracer.closest_hit(origins, directions)
    assert hits.hit.shape == (count,)
    assert hits.hit.all()
    assert tracer.any_hit(origins, directions).shape == (count,)


@given(st.integers(0, 10**7), st.integers(1, 70))
def test_tiles_take_each_ray_once(count, devices):
    sizes = (4, 64, 1024)
    at = 0
    for part, room in tiles(count, devices, sizes):
        assert part.start == at
        assert 0 < part.stop - part.start <= room * devices
        assert room in sizes
        at = part.stop
        if at > 10**6:
            return
    assert at == count


@given(st.integers(1, 64), st.sampled_from([1, 2, 3, 5]))
def test_spreading_and_collecting_give_the_rays_back(count, devices):
    rays = np.arange(count, dtype=np.float32) + 1
    room = 16 * 64
    spread = _spread(rays, devices, room)
    _, (back,) = _collect(slice(10, 10 + count), room, [spread], devices)
    np.testing.assert_array_equal(back, rays)


@pytest.mark.parametrize(
    ("origins", "directions", "t_max"),
    [
        (np.zeros((2, 3)), np.zeros((3, 3)), None),
        (np.zeros(3), np.zeros(3), None),
        (np.zeros((2, 2)), np.zeros((2, 2)), None),
        ([["a", "b", "c"]], np.zeros((1, 3)), None),
        (np.zeros((1, 3), complex), np.zeros((1, 3)), None),
        (np.zeros((2, 3)), np.ones((2, 3)), np.ones(3)),
        (np.zeros((2, 3)), np.ones((2, 3)), "far"),
        ([[1, 2, 3], [4]], np.ones((2, 3)), None),
    ],
)
def test_wrong_arguments_are_told(ball, origins, directions, t_max):
    with pytest.raises(UsageError):
        Tracer(ball, device="cpu", threads=1).closest_hit(origins, directions, t_max=t_max)


def test_doubles_and_lists_are_taken(ball):
    hits = Tracer(ball, device="cpu", threads=1).closest_hit([[0.0, 0, 0]], [[0, 0, 1e300]])
    assert not hits.hit.any()
    hits = Tracer(ball, device="cpu", threads=1).closest_hit([[0, 0, 0]], [[0, 0, 1]])
    assert hits.t[0] == pytest.approx(1.0)


def going_round():
    """The tracer of a tree whose nodes have the root for a child."""
    tracer = Tracer(small_scene(), device="cpu", threads=1)
    layout = tracer._layout
    nodes = layout.arrays.nodes.copy()
    children = nodes[0, 6].view(np.int32)
    children[children != DONE] = 0
    tracer._take(replace(layout, arrays=layout.arrays._replace(nodes=nodes)))
    return tracer


def test_a_tree_that_goes_round_ends_and_is_told():
    tracer = going_round()
    origins, directions = rays_at(small_scene(), 50, 0)
    with pytest.raises(StriptoolsError, match="did not end"):
        tracer.closest_hit(origins, directions)
    with pytest.raises(StriptoolsError, match="did not end"):
        tracer.any_hit(origins, directions)


def test_scenes_of_like_size_share_a_program():
    assert size_class(1) == size_class(1024) == 1024
    sizes = [size_class(k) for k in range(1, 10**5, 997)]
    assert all(size >= k for size, k in zip(sizes, range(1, 10**5, 997), strict=True))
    assert len(set(sizes)) < 30
