"""Rays dealt out to devices, made ready by a crew, and streamed in tiles: each once, whatever the devices."""

from functools import partial

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import scene_of
from strategies import sphere

from striptools.kernels.packets import PACKET
from striptools.kernels.ray_order import deal
from striptools.mesh.mesh import Mesh
from striptools.threads import Crew
from striptools.trace import Tracer, streams, tracer
from striptools.trace.rays import Camera, camera_rays
from striptools.trace.streams import EVERY_RAY, kept, moved_together


@given(st.integers(0, 500), st.integers(1, 5), st.sampled_from([1, 4, 32]), st.booleans())
def test_rays_are_dealt_like_cards(every, hands, block, chosen):
    which = np.random.default_rng(every).permutation(every).astype(np.int32) if chosen else EVERY_RAY
    rays = which.tolist() if len(which) else list(range(every))
    expected = [[] for _ in range(hands)]
    for k in range(0, every, block):
        expected[k // block % hands] += rays[k : k + block]
    assert [deal(which, every, hand, hands, block).tolist() for hand in range(hands)] == expected


@given(st.integers(0, 2**18), st.integers(1, 9))
def test_hands_are_even_and_of_whole_packets(count, devices):
    with Crew(1) as crew:
        hands = streams._dealt(EVERY_RAY, count, devices, crew)
    counts = [hand.count for hand in hands]
    assert sum(counts) == count
    assert max(counts) - min(counts) <= max(PACKET, count // (devices * streams.TURNS))
    if devices > 1 and count:
        dealt = np.concatenate([hand.which for hand in hands])
        assert np.array_equal(np.sort(dealt), np.arange(count))
        starts = hands[0].which[: counts[0] // PACKET * PACKET : PACKET]
        assert (starts % PACKET == 0).all()


@given(st.lists(st.integers(0, 6), min_size=1, max_size=5), st.integers(0, 3))
def test_rows_are_moved_together_and_kept(live, spare):
    room, places = 6, max(1, *live) if len(live) > 1 else max(1, live[0])
    places = min(room, places + spare)
    rows = np.arange(room * len(live) * 2, dtype=np.float32).reshape(-1, 2)
    expected = np.concatenate([rows[k * room : k * room + some] for k, some in enumerate(live)])
    moved = moved_together(rows.copy(), live, room, places)
    assert moved.shape == (places * len(live), 2)
    np.testing.assert_array_equal(kept(moved, live, places), expected)
    assert kept(np.zeros(0), live, places).shape == (0,)


def all_found(of, rays):
    """What a tracer finds, as bytes."""
    hits, packed = of.closest_hit(*rays, packets=False, counters=True), of.closest_hit(*rays)
    several = of.all_hits(*rays, k=2)
    arrays = [getattr(h, name) for h in (hits, packed) for name in ("t", "face", "u", "v", "triangle")]
    arrays += [*hits.counters, several.t, several.face, several.u, several.count]
    arrays += [of.any_hit(*rays), of.any_hit(*rays, packets=False), of.count_hits(*rays)]
    return [np.asarray(a).tobytes() for a in arrays]


@pytest.mark.parametrize("resident", ["expanded", "compressed"])
def test_any_number_of_devices_and_any_tiles_find_the_same(monkeypatch, resident):
    scene = scene_of(Mesh(*sphere(3)))
    seen = camera_rays(Camera.framing(scene.positions, width=96, height=50))
    random = np.random.default_rng(3)
    about = (random.uniform(-2, 2, (901, 3)), random.normal(size=(901, 3)))
    rays = tuple(np.concatenate(pair).astype(np.float32) for pair in zip(seen, about, strict=True))
    one, two = (Tracer(scene, device="cpu", threads=k, resident=resident) for k in (1, 2))
    assert len(two.devices) == 2, "two devices are asked for by the tests"
    expected = all_found(one, rays)
    monkeypatch.setattr(tracer, "MANY", 1)
    monkeypatch.setattr(tracer, "in_chunks", partial(tracer.in_chunks, smallest=100))
    assert all_found(two, rays) == expected
    # Tiles that are full many times over, and last ones that are nearly empty.
    monkeypatch.setattr(streams, "TILES", (2**6, 2**8))
    monkeypatch.setattr(streams, "PACKET_TILES", (2**3, 2**4))
    for found in (all_found(one, rays), all_found(two, rays)):
        assert found == expected


@pytest.mark.parametrize("count", [0, 1, 31, 33, 65])
def test_few_rays_over_two_devices(count):
    scene = scene_of(Mesh(*sphere(2)))
    rays = np.zeros((count, 3), np.float32), np.ones((count, 3), np.float32)
    one, two = (Tracer(scene, device="cpu", threads=k) for k in (1, 2))
    assert all_found(one, rays) == all_found(two, rays)
