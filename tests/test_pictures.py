"""Rays of a picture: known by how they come, taken tile by tile, to the same hits."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import scene_of
from strategies import sphere

from striptools.kernels.packets import PACKET
from striptools.kernels.pictures import COLUMNS, ROWS, row_width, tile_order
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer, streams
from striptools.trace.rays import Camera, camera_rays

SIZES = [(16, 4), (17, 5), (64, 64), (100, 7), (333, 40), (1024, 4)]


def picture(width, height):
    """Rays of a camera that frames a ball."""
    return camera_rays(Camera.framing(Mesh(*sphere(2)).positions, width=width, height=height))


def parallel(width, height):
    """Rays of a camera that is infinitely far away."""
    x, y = np.meshgrid(np.linspace(-1, 1, width), np.linspace(-1, 1, height))
    origins = np.stack([x, y, np.full_like(x, 3)], axis=-1).reshape(-1, 3).astype(np.float32)
    return origins, np.repeat(np.float32([[0, 0, -1]]), len(origins), axis=0)


def in_tiles(rays, width, height, side=8):
    """The same, tile by tile, as some cameras give them."""
    shape = (height // side, side, width // side, side, 3)
    return tuple(np.ascontiguousarray(a.reshape(shape).transpose(0, 2, 1, 3, 4).reshape(-1, 3)) for a in rays)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("make", [picture, parallel])
def test_the_width_of_a_picture_is_found(make, size):
    assert row_width(*make(*size)) == size[0]


def test_rays_that_are_jittered_within_their_pixels_are_a_picture_too():
    origins, directions = picture(128, 64)
    pixel = np.abs(directions[1] - directions[0]).max()
    random = np.random.default_rng(1)
    directions = directions + (random.uniform(-0.5, 0.5, (len(directions), 1)) * pixel).astype(np.float32)
    assert row_width(origins, directions) == 128


def test_what_is_no_picture():
    random = np.random.default_rng(2)
    origins, directions = picture(64, 64)
    scattered = random.normal(size=directions.shape).astype(np.float32)
    assert row_width(origins, scattered) == 0
    assert row_width(*in_tiles((origins, directions), 64, 64)) == 0
    shuffled = random.permutation(len(origins))
    assert row_width(origins[shuffled], directions[shuffled]) == 0
    assert row_width(origins[:-1], directions[:-1]) == 0
    assert row_width(origins[: 3 * 64], directions[: 3 * 64]) == 0
    assert row_width(origins * 0, directions * 0 + 1) == 0
    for count in (0, 1, 15, 16, 17):
        assert row_width(origins[:count], directions[:count]) == 0
    for bad in (np.nan, np.inf):
        broken = directions.copy()
        broken[:, 1] = bad
        assert row_width(origins, broken) == 0
    # One row that is out of order, of those that are looked at.
    broken = directions.copy()
    broken[:64] = broken[random.permutation(64)]
    assert row_width(origins, broken) == 0


@given(st.integers(1, 60), st.integers(1, 30))
def test_tiles_are_those_of_a_slow_twin(width, height):
    rows, columns = np.divmod(np.arange(width * height), width)
    expected = np.lexsort((columns, rows, columns // COLUMNS, rows // ROWS))
    np.testing.assert_array_equal(tile_order(width * height, width), expected)


@pytest.mark.parametrize("size", SIZES)
def test_hits_are_the_same_in_any_order(size):
    tracer = Tracer(scene_of(Mesh(*sphere(3))), device="cpu")
    rays = picture(*size)
    one = tracer.closest_hit(*rays, packets=False)
    together = tracer.closest_hit(*rays)
    assert one.hit.any()
    for name in ("t", "face", "u", "v", "triangle"):
        assert getattr(one, name).tobytes() == getattr(together, name).tobytes()
    np.testing.assert_array_equal(tracer.any_hit(*rays), one.hit)


def test_packets_of_a_picture_are_its_tiles(monkeypatch):
    seen = []
    made = streams.ready_packets

    def spy(*given):
        result = made(*given)
        seen.append(given[-3][: result[0]].copy())
        return result

    monkeypatch.setattr(streams, "ready_packets", spy)
    tracer = Tracer(scene_of(Mesh(*sphere(3))), device="cpu", threads=1)
    tracer.closest_hit(*picture(64, 32))
    lanes = np.concatenate(seen)
    assert lanes.shape[0] > 10
    assert lanes.shape[1] == PACKET
    rows, columns = np.divmod(lanes, 64)
    assert (np.ptp(rows, axis=1) == ROWS - 1).all()
    assert (np.ptp(columns, axis=1) == COLUMNS - 1).all()
