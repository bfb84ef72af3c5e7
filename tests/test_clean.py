import time
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import cube, grid, line, meshes, sphere, tangle

from striptools.errors import UsageError
from striptools.kernels.degenerate import DOUBTFUL, NON_FINITE, REPEATED_VERTEX, USABLE
from striptools.mesh.clean import (
    CleanOptions,
    _repeated_faces,
    clean,
    has_zero_area,
    judge_faces,
    round_positions,
    weld_vertices,
)
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh

TRIANGLE = np.array([[0, 1, 2]], np.int32)
DROPPED = ("non_finite", "repeated_vertex", "zero_area", "duplicate_faces_dropped")


def bits(array):
    return np.ascontiguousarray(array).view(np.uint32)


def slow_zero_area(a, b, c):
    """In fractions: whether three points lie on one line."""
    one = [Fraction(float(q)) - Fraction(float(p)) for p, q in zip(a, b, strict=True)]
    two = [Fraction(float(q)) - Fraction(float(p)) for p, q in zip(a, c, strict=True)]
    return all(one[i] * two[j] == one[j] * two[i] for i, j in ((0, 1), (1, 2), (2, 0)))


def slow_clean(mesh, *, drop_duplicates):
    """What bitwise cleaning keeps, by dictionaries and fractions: the kept faces, and counts."""
    leaders = {}
    leader = [leaders.setdefault(row.tobytes(), k) for k, row in enumerate(mesh.positions)]
    seen, kept, counts = set(), [], dict.fromkeys((*DROPPED, "duplicate_faces_kept"), 0)
    for face, row in enumerate(mesh.faces.tolist()):
        a, b, c = (leader[corner] for corner in row)
        turned = min((a, b, c), (b, c, a), (c, a, b))
        if not np.isfinite(mesh.positions[row]).all():
            counts["non_finite"] += 1
        elif len({a, b, c}) < 3:
            counts["repeated_vertex"] += 1
        elif slow_zero_area(*mesh.positions[row]):
            counts["zero_area"] += 1
        elif turned in seen and drop_duplicates:
            counts["duplicate_faces_dropped"] += 1
        else:
            counts["duplicate_faces_kept"] += turned in seen
            seen.add(turned)
            kept.append(face)
    return kept, counts


@given(meshes(), st.booleans())
def test_bitwise_cleaning_equals_the_slow_twin(mesh, drop_duplicates):
    cleaned = clean(mesh, CleanOptions(drop_duplicates=drop_duplicates))
    kept, counts = slow_clean(mesh, drop_duplicates=drop_duplicates)
    assert cleaned.source_face.tolist() == kept
    assert {key: cleaned.counts[key] for key in counts} == counts
    # Every kept face has the corners of its source, in the source's order, bit for bit.
    np.testing.assert_array_equal(
        bits(cleaned.mesh.positions[cleaned.mesh.faces]), bits(mesh.positions[mesh.faces[kept]])
    )


@given(meshes(), st.booleans(), st.sampled_from([0.0, 1e-9, 0.01, 1.0, 1e9]))
def test_nothing_vanishes_uncounted(mesh, drop_duplicates, weld):
    cleaned = clean(mesh, CleanOptions(weld, drop_duplicates))
    counts = cleaned.counts
    assert (
        counts["faces_in"] == mesh.triangle_count == counts["faces_out"] + sum(counts[key] for key in DROPPED)
    )
    assert counts["vertices_in"] == mesh.vertex_count
    assert counts["vertices_in"] == sum(
        counts[key] for key in ("vertices_out", "vertices_welded", "vertices_unreferenced")
    )
    assert counts["faces_out"] == cleaned.mesh.triangle_count == len(cleaned.source_face)
    assert counts["vertices_out"] == cleaned.mesh.vertex_count
    assert min(counts.values()) >= 0
    assert (np.diff(cleaned.source_face) > 0).all()
    assert cleaned.source_face.dtype == np.int32


@given(meshes(), st.booleans(), st.sampled_from([0.0, 0.01]))
def test_what_comes_out_is_clean(mesh, drop_duplicates, weld):
    options = CleanOptions(weld, drop_duplicates)
    once = clean(mesh, options)
    assert np.isfinite(once.mesh.positions).all()
    assert len(np.unique(once.mesh.faces)) == once.mesh.vertex_count
    assert (judge_faces(once.mesh.positions, once.mesh.faces) == USABLE).all()
    again = clean(once.mesh, CleanOptions(0.0, drop_duplicates))
    np.testing.assert_array_equal(again.mesh.faces, once.mesh.faces)
    np.testing.assert_array_equal(bits(again.mesh.positions), bits(once.mesh.positions))


@given(meshes(), st.sampled_from([1e-310, 1e-40, 1e-9, 1e-3, 0.5, 3.0, 1e6, 1e300]))
def test_welding_moves_no_vertex_farther_than_it_says(mesh, weld):
    positions = mesh.positions
    leader, error = weld_vertices(positions, weld)
    finite = np.isfinite(positions).all(axis=1)
    np.testing.assert_array_equal(leader[~finite], np.flatnonzero(~finite))
    np.testing.assert_array_equal(leader[leader], leader)
    assert (leader <= np.arange(len(leader))).all()
    apart = (positions[finite].astype(np.float64) - positions[leader[finite]]) ** 2
    moved = np.sqrt(apart[:, 0] + apart[:, 1] + apart[:, 2])
    assert error == moved.max(initial=0.0)
    assert error <= weld


@given(meshes(), st.sampled_from([1e-3, 0.5, 3.0]))
def test_welding_follows_the_nearest_leader(mesh, weld):
    positions = mesh.positions
    leader, _ = weld_vertices(positions, weld)
    wide = positions.astype(np.float64)
    leaders = np.zeros(0, np.int64)
    for k in np.flatnonzero(np.isfinite(positions).all(axis=1)):
        apart = (wide[leaders] - wide[k]) ** 2
        away = np.sqrt(apart[:, 0] + apart[:, 1] + apart[:, 2])
        if (away <= weld).any():
            assert leader[k] == leaders[np.argmin(away)]
        else:
            assert leader[k] == k
            leaders = np.append(leaders, k)


def test_a_chain_of_close_vertices_does_not_collapse():
    positions = np.zeros((5, 3), np.float32)
    positions[:, 0] = np.arange(5) * 0.75
    leader, error = weld_vertices(positions, 1.0)
    assert leader.tolist() == [0, 0, 2, 2, 4]
    assert error == 0.75


@given(st.floats(1e-6, 1e6), st.integers(-(2**20), 2**20))
def test_neighbours_at_the_very_distance_are_found_across_cells(unit, step):
    x = np.array([step * unit, (step + 1) * unit], np.float32)
    distance = abs(float(x[1]) - float(x[0]))
    positions = np.stack([x, 0 * x, 0 * x], axis=1)
    if distance > 0:
        assert weld_vertices(positions, distance)[0].tolist() == [0, 0]
        assert weld_vertices(positions, np.nextafter(distance, 0))[0].tolist() == [0, 1]


@given(meshes(hostile=False))
def test_unwelding_and_welding_gives_the_mesh_back(mesh):
    known = clean(mesh).mesh
    soup = Mesh(known.positions[known.faces].reshape(-1, 3), np.arange(known.faces.size).reshape(-1, 3))
    again = clean(soup).mesh
    np.testing.assert_array_equal(bits(again.positions[again.faces]), bits(known.positions[known.faces]))
    assert again.vertex_count == known.vertex_count


def test_zeros_of_both_signs_stay_apart_without_a_tolerance():
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-0.0, 0, 0], [0, 0, 1]], np.float32)
    mesh = Mesh(positions, np.array([[0, 1, 2], [3, 1, 4]], np.int32))
    cleaned = clean(mesh)
    np.testing.assert_array_equal(bits(cleaned.mesh.positions), bits(positions))
    joined = clean(mesh, CleanOptions(weld=1e-6))
    assert joined.counts["vertices_welded"] == 1
    assert joined.weld_error == 0.0


def test_reasons_are_counted_in_order():
    positions = np.array(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [np.nan, 0, 0], [0, 0, 0], [9, 9, 9]], np.float32
    )
    faces = np.array([[0, 1, 2], [4, 4, 0], [0, 5, 1], [0, 1, 3], [1, 2, 5], [2, 1, 0]], np.int32)
    cleaned = clean(Mesh(positions, faces))
    assert cleaned.counts == {
        "faces_in": 6,
        "non_finite": 1,
        "repeated_vertex": 1,
        "zero_area": 1,
        "duplicate_faces_dropped": 0,
        "duplicate_faces_kept": 1,
        "faces_out": 3,
        "vertices_in": 7,
        "vertices_out": 3,
        "vertices_welded": 1,
        "vertices_unreferenced": 3,
    }
    assert cleaned.source_face.tolist() == [0, 4, 5]
    assert cleaned.mesh.faces.tolist() == [[0, 1, 2], [1, 2, 0], [2, 1, 0]]
    assert clean(Mesh(positions, faces), CleanOptions(drop_duplicates=True)).source_face.tolist() == [0, 5]


def test_vertices_keep_their_order():
    positions, faces = grid(4, 4)
    spare = np.insert(positions, [3, 7, 7], 5.0, axis=0)
    place = np.flatnonzero((spare != 5.0).any(axis=1))
    cleaned = clean(Mesh(spare, place[faces]))
    np.testing.assert_array_equal(cleaned.mesh.positions, positions)
    np.testing.assert_array_equal(cleaned.mesh.faces, faces)


def test_double_precision_is_rounded_first_and_the_largest_rounding_reported():
    positions = np.array([[0.1, 0, 0], [1, 1e-50, 0], [0, 1, 0.25], [0.1 + 1e-12, 0, 0]])
    cleaned = clean(Mesh(positions, np.array([[0, 1, 2], [3, 1, 2]], np.int32)))
    assert cleaned.largest_rounding == abs(float(np.float32(0.1)) - 0.1)
    assert cleaned.counts["vertices_welded"] == 1
    assert cleaned.counts["duplicate_faces_kept"] == 1


def test_overflow_of_float32_is_not_finite():
    positions = np.array([[0, 0, 0], [1e39, 0, 0], [0, 1, 0], [1, 1, 0.1]])
    cleaned = clean(Mesh(positions, np.array([[0, 1, 2], [0, 3, 2]], np.int32)))
    assert cleaned.counts["non_finite"] == 1
    assert cleaned.largest_rounding == abs(float(np.float32(0.1)) - 0.1)
    assert round_positions(np.zeros((0, 3)))[1] == 0.0


@pytest.mark.parametrize("scale", [1.0, 1e-8, 1e8, 1e30, 1e-38, 1e-44])
def test_lines_have_zero_area_at_every_magnitude(scale):
    positions, faces = line(8)
    positions = (positions * np.float32(2.0 ** np.round(np.log2(scale)))).astype(np.float32)
    assert (judge_faces(positions, faces) == DOUBTFUL).all()
    assert (judge_faces(np.tile(positions[:1], (3, 1)), TRIANGLE) == DOUBTFUL).all()


def test_a_denormal_of_area_is_area():
    tiny = np.float32(1e-45)
    positions = np.array([[0, 0, 0], [tiny, 0, 0], [0, tiny, 0]], np.float32)
    assert judge_faces(positions, TRIANGLE).tolist() == [USABLE]
    far = np.array([[3e38, -3e38, 0], [-3e38, 3e38, 0], [0, 0, tiny]], np.float32)
    assert judge_faces(far, TRIANGLE).tolist() == [USABLE]
    far[2, 2] = 0
    assert judge_faces(far, TRIANGLE).tolist() == [DOUBTFUL]


def test_verdicts_on_broken_faces():
    positions = np.array([[0, 0, 0], [1, 0, 0], [np.inf, 0, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 1, 1]], np.int32)
    assert judge_faces(positions, faces).tolist() == [NON_FINITE, REPEATED_VERTEX]


float32s = st.floats(width=32, allow_nan=False, allow_infinity=False)
near = st.integers(-3, 3).map(lambda ulps: ulps * 2.0**-23)


@st.composite
def nearly_straight(draw):
    """Three points on a line in real numbers, rounded to float32: of zero area or not, by the last bit."""
    start = np.array([draw(float32s) for _ in range(3)])
    way = np.array([draw(float32s) for _ in range(3)])
    steps = [draw(st.sampled_from([0.0, 1.0, 2.0, -1.0, 0.5, 3.0, 1 / 3])) + draw(near) for _ in range(2)]
    with np.errstate(all="ignore"):
        corners = np.stack([start, start + steps[0] * way, start + steps[1] * way]).astype(np.float32)
    return np.nan_to_num(corners, nan=1.0, posinf=3e38, neginf=-3e38)


@given(st.lists(nearly_straight(), min_size=1, max_size=8))
def test_zero_area_is_exact(triangles):
    corners = np.stack(triangles).astype(np.float32)
    expected = [slow_zero_area(*triangle) for triangle in corners]
    assert has_zero_area(corners).tolist() == expected
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    assert (judge_faces(corners.reshape(-1, 3), faces) == DOUBTFUL).tolist() == expected


@pytest.mark.parametrize("weld", [-1.0, np.nan, np.inf])
def test_a_weld_distance_out_of_range_is_refused(weld):
    with pytest.raises(UsageError, match="weld distance"):
        CleanOptions(weld=weld)


def test_an_empty_mesh_stays_empty():
    cleaned = clean(Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32)), CleanOptions(weld=1.0))
    assert cleaned.mesh.triangle_count == 0
    assert set(cleaned.counts.values()) == {0}


@pytest.mark.parametrize("shape", [cube(), sphere(2), tangle(9, 60, 1)])
def test_the_input_is_left_alone(shape):
    mesh = Mesh(*shape, notes=("kept",))
    before = mesh.positions.copy(), mesh.faces.copy()
    assert clean(mesh, CleanOptions(drop_duplicates=True)).mesh.notes == ("kept",)
    np.testing.assert_array_equal(mesh.positions, before[0])
    np.testing.assert_array_equal(mesh.faces, before[1])


@pytest.mark.parametrize("threads", [1, 3])
def test_faces_crowded_on_few_least_vertices_are_compared_in_linear_time(threads):
    # Ten faces and more for each of the first vertices and none for the others, as in a subdivided mesh.
    def crowd(count):
        random = np.random.default_rng(count)
        far = random.integers(count // 10, count, (count, 2))
        faces = np.column_stack([random.integers(0, count // 10, count), far[:, 0], far[:, 1]])
        faces[:100] = np.roll(faces[-100:], 1, axis=1)
        return faces.astype(np.int32)

    def compare(faces):
        keep = faces[:, 1] != faces[:, 2]
        begin = time.process_time()
        repeated = _repeated_faces(faces, keep, len(faces), threads)
        return repeated, time.process_time() - begin

    # Both fit into a cache: beyond it a face costs several times as much.
    few, many = crowd(25_000), crowd(200_000)
    repeated, _ = compare(few)
    turned = np.take_along_axis(few, (np.argmin(few, axis=1)[:, None] + np.arange(3)) % 3, axis=1)
    _, first = np.unique(turned, axis=0, return_index=True)
    expected = np.ones(len(few), bool)
    expected[first] = False
    expected[few[:, 1] == few[:, 2]] = False
    np.testing.assert_array_equal(repeated, expected)
    quick = min(compare(few)[1] for _ in range(5))
    # In quadratic time it would be 64.
    assert min(compare(many)[1] for _ in range(5)) < 32 * quick


def test_the_dragon_loses_its_degenerate_faces_and_soup_its_copies(real_mesh):
    dragon = clean(load_mesh(real_mesh("dragon")))
    assert dragon.counts["faces_in"] - dragon.counts["faces_out"] == 108
    soup = clean(load_mesh(real_mesh("soup_bunny")))
    bunny = clean(load_mesh(real_mesh("bunny")))
    assert soup.mesh.vertex_count == bunny.mesh.vertex_count
