"""Morton codes against bits picked one by one, and the radix sort against NumPy's stable sort."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from striptools.kernels.morton import DIGIT_BITS, morton_codes, radix_order


def slow_codes(points, low, high, bits):
    codes = []
    for point in points.astype(np.float64):
        code = 0
        for axis in range(3):
            extent = float(high[axis]) - float(low[axis])
            cell = int((point[axis] - low[axis]) / extent * 2**bits) if extent > 0 else 0
            cell = min(max(cell, 0), 2**bits - 1)
            for bit in range(bits):
                code |= (cell >> bit & 1) << (3 * bit + 2 - axis)
        codes.append(code)
    return np.array(codes, np.uint64)


@pytest.mark.parametrize("bits", [1, 10, 21])
def test_codes_are_those_of_the_slow_twin(bits):
    random = np.random.default_rng(bits)
    points = random.normal(size=(500, 3)).astype(np.float32)
    low, high = points.min(axis=0), points.max(axis=0)
    assert np.array_equal(morton_codes(points, low, high, bits), slow_codes(points, low, high, bits))
    shrunk = high / 2
    assert np.array_equal(morton_codes(points, low, shrunk, bits), slow_codes(points, low, shrunk, bits))


def test_corners_have_the_first_and_the_last_code():
    corners = np.array([[0, 0, 0], [1, 1, 1], [1, 0, 0], [0, 0, 1]], np.float32)
    codes = morton_codes(corners, corners[0], corners[1])
    assert codes.tolist() == [0, 2**63 - 1, 0x4924924924924924, 0x1249249249249249]


def test_boxes_stand_at_their_centres():
    random = np.random.default_rng(3)
    low, high = np.sort(random.integers(-(2**20), 2**20, (2, 100, 3)), axis=0).astype(np.float32)
    reach = np.full(3, 2.0**20, np.float32)
    boxes = np.concatenate([low, high], axis=1)
    assert np.array_equal(morton_codes(boxes, -reach, reach), morton_codes((low + high) / 2, -reach, reach))


@pytest.mark.parametrize("size", [1e38, 1e-42])
def test_huge_and_tiny_grids_lose_nothing(size):
    points = (np.array([[-1, -1, -1], [1, 1, 1], [-1, 1, -1]]) * size).astype(np.float32)
    codes = morton_codes(np.concatenate([points, points], axis=1), points[0], points[1])
    assert codes.tolist() == [0, 2**63 - 1, 0x2492492492492492]


def test_an_axis_without_extent_has_one_cell():
    points = np.array([[0, 5, 5], [1, 5, 5]], np.float32)
    assert morton_codes(points, points[0], points[1]).tolist() == [0, 0x4924924924924924]


@given(st.lists(st.integers(0, 2**64 - 1)), st.sampled_from([1, 2**DIGIT_BITS - 1, 2**64 - 1]))
def test_the_radix_sort_is_stable(keys, mask):
    keys = np.array(keys, np.uint64) & np.uint64(mask)
    before = keys.copy()
    order = radix_order(keys)
    assert order.dtype == np.int32
    assert np.array_equal(order, np.argsort(keys, kind="stable"))
    assert np.array_equal(keys, before)


def test_many_keys_are_sorted():
    random = np.random.default_rng(0)
    keys = random.integers(0, 2**63, 100_000).astype(np.uint64)
    keys[::3] = keys[0]
    assert np.array_equal(radix_order(keys), np.argsort(keys, kind="stable"))
