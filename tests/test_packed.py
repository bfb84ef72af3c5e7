"""Quantised nodes and runs: exact, whole, the same for any threads, and the checks that say so."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from blocks import blocks_of
from hypothesis import given, settings
from hypothesis import strategies as st
from numba import njit
from strategies import clean_meshes, grid, soup, sphere

from striptools.errors import UnreadableSceneError, UsageError
from striptools.hierarchies.packed import BoxGrid, box_grid, build_inner, build_top, check_packed, wide_tree
from striptools.hierarchies.wide import check_wide_tree
from striptools.kernels import packed_nodes as kernels
from striptools.mesh.clean import clean
from striptools.mesh.mesh import Mesh

DENORMAL = np.float32(1e-45)
LARGEST = np.finfo(np.float32).max
floats = st.floats(width=32, allow_nan=False, allow_infinity=False)


def check(blocks, packed=None):
    check_packed(packed or blocks.packed, blocks.grid, blocks.boxes, blocks.block_starts, blocks.strip_starts)


def clean_mesh(positions, faces):
    return clean(Mesh(positions, faces)).mesh


@pytest.fixture(scope="module")
def ball():
    blocks = blocks_of(clean_mesh(*sphere(4)), block=64)
    check(blocks)
    return blocks


# ---- The grid.


@settings(max_examples=300)
@given(floats, floats)
def test_a_scene_is_below_65536_cells_long_on_the_finest_such_grid(a, b):
    low, high = sorted(np.float32([a, b]))
    made = box_grid(np.full(3, low), np.full(3, high))
    cell = int(made.cell[0])
    size = Fraction(float(high)) - Fraction(float(low))
    assert -149 <= cell <= 127
    assert size < 65536 * Fraction(2) ** cell
    # A size that rounds to a power of two may get the next cell.
    assert cell == -149 or size * (1 + Fraction(2) ** -52) >= 65536 * Fraction(2) ** (cell - 1)


def test_grids_of_single_points_and_of_everything():
    assert (box_grid(np.float32([5, -0.0, 0]), np.float32([5, 0, DENORMAL])).cell == -149).all()
    assert (box_grid(np.full(3, -LARGEST), np.full(3, LARGEST)).cell == 113).all()
    assert not np.signbit(box_grid(np.full(3, -0.0, np.float32), np.zeros(3)).low).any()


@njit
def cells_down(value, low, per_unit):
    """The kernel's helper, which Python cannot call."""
    return kernels.cells_down(value, low, per_unit)


@njit
def cells_up(value, low, per_unit):
    return kernels.cells_up(value, low, per_unit)


@settings(max_examples=500)
@given(floats, floats, st.integers(-149, 113))
def test_borders_of_cells_are_exact(a, b, cell):
    low, value = sorted(np.float32([a, b]))
    exact = (Fraction(float(value)) - Fraction(float(low))) / Fraction(2) ** cell
    if exact >= 2**62:
        return
    down = cells_down(value, low, 2.0**-cell)
    up = cells_up(value, low, 2.0**-cell)
    if exact < 2**52:
        assert down <= exact < down + 1
        assert up - 1 < exact <= up
    assert up - down in (0, 1)


def test_a_border_just_above_a_value_is_not_taken_for_it():
    low, value = np.float32(-1), np.float32(1) - np.float32(2.0**-24)
    assert cells_down(value, low, 1.0) == 1
    assert cells_up(np.float32(2.0**-100), low, 1.0) == 2
    assert cells_down(np.float32(-(2.0**-100)), low, 1.0) == 0


# ---- Nodes.


@given(clean_meshes(), st.sampled_from([4, 16, 256]), st.sampled_from([1, 3, 8]), st.sampled_from([1, 4, 64]))
def test_nodes_hold_what_is_below_and_reach_all(mesh, block, longest_run, max_length):
    blocks = blocks_of(mesh, block=block, longest_run=longest_run, max_length=max_length)
    check(blocks)
    wide = wide_tree(blocks.packed, blocks.boxes, blocks.block_starts)
    check_wide_tree(wide, blocks.boxes)
    assert len(wide.boxes) == len(blocks.packed.nodes)


@pytest.mark.parametrize(
    ("scale", "offset"),
    [(1.0, 0.0), (2.0**-140, 0.0), (2.0**118, 0.0), (1e-3, 1e4), (1e-30, 1.0), ((1.0, 0.0, 2.0**-149), 0.0)],
)
def test_hostile_extents(scale, offset):
    positions, faces = sphere(3)
    positions = (positions.astype(np.float64) * scale + offset).astype(np.float32)
    blocks = blocks_of(Mesh(positions, faces), block=16)
    check(blocks)


@pytest.mark.parametrize(
    "shape", [grid(1, 1), grid(60, 60), soup(1, 1, 1000), soup(3000, 1, 1000), sphere(5)]
)
def test_shapes(shape):
    check(blocks_of(clean_mesh(*shape)))


def test_one_block_has_no_top():
    blocks = blocks_of(clean_mesh(*grid(2, 2)))
    assert blocks.packed.top_count == 0
    order, top = build_top(blocks.boxes[:1], np.ones(1, np.int32), blocks.grid)
    assert order.tolist() == [0]
    assert top.shape == (0, 16)


def test_the_same_for_any_threads():
    mesh = clean_mesh(*sphere(6))
    one, three = blocks_of(mesh, block=16), blocks_of(mesh, block=16, threads=3)
    assert len(one.block_starts) > 1024
    for name in ("nodes", "first_run", "runs"):
        np.testing.assert_array_equal(getattr(one.packed, name), getattr(three.packed, name))


def test_nodes_and_runs_are_full():
    blocks = blocks_of(clean_mesh(*sphere(6)))
    children = (wide_tree(blocks.packed, blocks.boxes, blocks.block_starts).child >= -(2**30)).sum()
    assert children / len(blocks.packed.nodes) > 6
    assert len(blocks.boxes) / len(blocks.packed.runs) > 6.5


def test_top_nodes_alone_are_checked(ball):
    top = replace(
        ball.packed,
        nodes=ball.packed.nodes[: ball.packed.top_count],
        first_run=None,
        runs=None,
        longest_run=0,
    )
    check(ball, top)
    with pytest.raises(UnreadableSceneError, match="number of nodes"):
        check(ball, replace(top, nodes=ball.packed.nodes))


@pytest.mark.parametrize("longest_run", [0, 9])
def test_lengths_of_runs_that_cannot_be(ball, longest_run):
    with pytest.raises(UsageError, match="longest_run"):
        build_inner(ball.boxes, ball.block_starts, ball.strip_starts, ball.grid, 0, longest_run)


# ---- What the check finds.


def node_with(ball, wanted):
    """The first node behind the root that is as wanted, by its inner bits and leaf slots."""
    nodes = ball.packed.nodes
    inner = nodes[:, 3] >> 16 & 255
    planes = np.ascontiguousarray(nodes).view(np.uint8)[:, 16:].reshape(-1, 6, 8)
    used = planes[:, 0] <= planes[:, 3]
    leaves = used.sum(axis=1) - np.bitwise_count(inner)
    return next(k for k in range(1, len(nodes)) if wanted(k, inner[k], leaves[k], used[k]))


def first_inner(ball):
    return node_with(ball, lambda k, inner, leaves, used: k >= ball.packed.top_count and inner)


def first_bottom(ball):
    return node_with(ball, lambda k, inner, leaves, used: k >= ball.packed.top_count and not inner)


def first_gap(ball):
    return node_with(ball, lambda k, inner, leaves, used: not used.all())


def broken(ball, change):
    """The nodes and runs of a ball after a change of their copies."""
    nodes = ball.packed.nodes.copy()
    runs, first_run = ball.packed.runs.copy(), ball.packed.first_run.copy()
    change(ball, nodes, nodes.view(np.uint8), runs, first_run)
    return replace(ball.packed, nodes=nodes, runs=runs, first_run=first_run)


def gap_slot(ball):
    planes = ball.packed.nodes.view(np.uint8)[first_gap(ball), 16:].reshape(6, 8)
    return int((planes[0] > planes[3]).argmax())


FAULTS = {
    "neither empty": lambda b, n, r, runs, first: r.__setitem__((first_gap(b), 16 + gap_slot(b)), 0),
    "empty slot is inner": lambda b, n, r, runs, first: r.__setitem__(
        (first_gap(b), 14), r[first_gap(b), 14] | 1 << gap_slot(b)
    ),
    "has a base": lambda b, n, r, runs, first: n.__setitem__(
        (first_bottom(b), 0), n[first_bottom(b), 0] + np.uint32(1)
    ),
    "none of the nodes that it may be": lambda b, n, r, runs, first: n.__setitem__((0, 0), n[0, 0] + 1),
    "a node has not one parent": lambda b, n, r, runs, first: n.__setitem__(
        (first_inner(b), 0), n[first_inner(b), 0] + 1
    ),
    "a block has not one parent": lambda b, n, r, runs, first: swap(n, b),
    "another block": lambda b, n, r, runs, first: n.__setitem__(
        (first_bottom(b), 1), n[first_bottom(b), 1] ^ 1
    ),
    "a run": lambda b, n, r, runs, first: n.__setitem__(
        (first_bottom(b), 1), n[first_bottom(b), 1] + np.uint32(1 << 24)
    ),
    "runs of blocks": lambda b, n, r, runs, first: first.__setitem__(0, 1),
    "other leaves than it says": lambda b, n, r, runs, first: r.__setitem__(
        (first_top(b), 7), r[first_top(b), 7] ^ 0x80
    ),
    "every triangle once": lambda b, n, r, runs, first: runs.__setitem__(0, runs[0] ^ 1),
}


def first_top(ball):
    return node_with(ball, lambda k, inner, leaves, used: k < ball.packed.top_count and leaves)


def swap(nodes, ball):
    nodes[first_top(ball), 1] += 1


@pytest.mark.parametrize("flaw", FAULTS)
def test_faults_of_structure_are_found(ball, flaw):
    with pytest.raises(UnreadableSceneError, match=flaw):
        check(ball, broken(ball, FAULTS[flaw]))


def test_counts_that_do_not_fit_are_found(ball):
    for change, flaw in [
        ({"top_count": 0}, "number of top nodes"),
        ({"longest_run": 0}, "longest run"),
        ({"longest_run": 3}, "too long"),
        ({"runs": None}, "as a whole"),
        ({"nodes": ball.packed.nodes[:-1]}, "that it may be"),
    ]:
        with pytest.raises(UnreadableSceneError, match=flaw):
            check(ball, replace(ball.packed, **change))


def test_a_run_over_a_strips_end_is_found(ball):
    starts = np.sort(np.append(ball.strip_starts, 1)).astype(np.int32)
    with pytest.raises(UnreadableSceneError, match="another strip"):
        check_packed(ball.packed, ball.grid, ball.boxes, ball.block_starts, starts)


@pytest.mark.parametrize("side", range(6))
def test_every_plane_that_is_a_step_short_is_found(ball, side):
    record = ball.packed.nodes.view(np.uint8)
    planes = record[:, 16:].reshape(-1, 6, 8)
    used = planes[:, 0] <= planes[:, 3]
    random = np.random.default_rng(side)
    short = 0
    for node, slot in random.permutation(np.argwhere(used))[:60]:
        nodes = ball.packed.nodes.copy()
        place = nodes.view(np.uint8)[node, 16 + 8 * side + slot : 17 + 8 * side + slot]
        for _ in range(2):
            place += np.uint8(1 if side < 3 else 255)
        if (place[0] < planes[node, side, slot]) == (side < 3):
            continue
        with pytest.raises(UnreadableSceneError, match=r"does not hold|neither empty"):
            check(ball, replace(ball.packed, nodes=nodes))
        short += 1
    assert short > 20


def test_a_box_short_by_less_than_rounding_is_found(ball):
    low = ball.grid.low.copy()
    exact = ball.boxes[:, :3].min(axis=0)
    np.testing.assert_array_equal(low, exact)
    raised = BoxGrid(np.nextafter(low, np.float32(np.inf)), ball.grid.cell)
    with pytest.raises(UnreadableSceneError, match="does not hold"):
        check_packed(ball.packed, raised, ball.boxes, ball.block_starts, ball.strip_starts)
