import numpy as np
import pytest

from striptools.errors import UsageError
from striptools.partition.sah import NODE_COST, TRIANGLE_COST, PartitionOptions, expected_cost, half_area


def test_half_area_of_a_box_is_half_its_surface():
    boxes = np.array([[0, 0, 0, 1, 2, 3], [5, 5, 5, 5, 5, 5]], np.float32)
    assert half_area(boxes).tolist() == [2 + 6 + 3, 0]


def test_half_area_does_not_overflow_for_the_largest_float32():
    most = np.finfo(np.float32).max
    area = half_area(np.array([[-most, -most, -most, most, most, most]], np.float32))
    assert area[0] == 3 * (2 * float(most)) ** 2


def test_an_inverted_box_has_no_area():
    assert half_area(np.array([[1, 1, 1, 0, 0, 0]], np.float32))[0] == 0


def test_expected_cost_weighs_nodes_and_triangles_by_area():
    root, half, quarter = [0, 0, 0, 1, 1, 0], [0, 0, 0, 0.5, 1, 0], [0, 0, 0, 0.5, 0.5, 0]
    boxes = np.array([root, half, half, quarter, quarter], np.float32)
    size = np.array([3, 1, 2, 1, 1], np.int32)
    assert expected_cost(boxes, size) == NODE_COST * (1 + 0.5) + TRIANGLE_COST * (0.5 + 0.25 + 0.25)


def test_a_root_without_area_counts_everything_in_full():
    boxes = np.zeros((3, 6), np.float32)
    assert expected_cost(boxes, np.array([2, 1, 1], np.int32)) == NODE_COST + 2 * TRIANGLE_COST


@pytest.mark.parametrize("wrong", [{"bins": 1}, {"bins": 65}, {"sweep_below": 1}, {"sweep_below": 65}])
def test_options_out_of_range_are_refused(wrong: dict[str, int]):
    with pytest.raises(UsageError, match=next(iter(wrong))):
        PartitionOptions(**wrong)
