"""Rays dealt out to devices, a thread each, and streamed in tiles: each once, whatever the devices."""

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import scene_of
from strategies import sphere

from striptools.errors import StriptoolsError
from striptools.kernels.ray_order import deal
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer, launch, streams
from striptools.trace.rays import Camera, camera_rays
from striptools.trace.streams import EVERY_RAY


@given(st.integers(0, 500), st.integers(1, 5), st.sampled_from([1, 4, 32]), st.booleans())
def test_rays_are_dealt_like_cards(every, hands, block, chosen):
    which = np.random.default_rng(every).permutation(every).astype(np.int32) if chosen else EVERY_RAY
    rays = which.tolist() if len(which) else list(range(every))
    expected = [[] for _ in range(hands)]
    for k in range(0, every, block):
        expected[k // block % hands] += rays[k : k + block]
    assert [deal(which, every, hand, hands, block).tolist() for hand in range(hands)] == expected


def all_found(of, rays):
    """What a tracer finds, as bytes."""
    hits, packed = of.closest_hit(*rays, packets=False, counters=True), of.closest_hit(*rays)
    several = of.all_hits(*rays, k=2)
    arrays = [getattr(h, name) for h in (hits, packed) for name in ("t", "face", "u", "v", "triangle")]
    arrays += [*hits.counters, several.t, several.face, several.u, several.count]
    arrays += [of.any_hit(*rays), of.any_hit(*rays, packets=False), of.count_hits(*rays)]
    return [np.asarray(a).tobytes() for a in arrays]


def needs_two(tracer):
    """Skip a test of several devices where a machine of one core has but one."""
    if len(tracer.devices) < 2:
        pytest.skip("there is one core")


@pytest.fixture(scope="module")
def crowd():
    """A scene, and rays of a picture of it and about it."""
    scene = scene_of(Mesh(*sphere(3)))
    seen = camera_rays(Camera.framing(scene.positions, width=96, height=50))
    random = np.random.default_rng(3)
    about = (random.uniform(-2, 2, (901, 3)), random.normal(size=(901, 3)))
    return scene, tuple(np.concatenate(pair).astype(np.float32) for pair in zip(seen, about, strict=True))


@pytest.mark.parametrize("resident", ["expanded", "compressed"])
def test_any_number_of_devices_and_any_tiles_find_the_same(crowd, monkeypatch, resident):
    scene, rays = crowd
    one, two = (Tracer(scene, device="cpu", threads=k, resident=resident) for k in (1, 2))
    needs_two(two)
    expected = all_found(one, rays)
    hands = []
    honest = streams.deal

    def noting(*given):
        hands.append((threading.get_ident(), given[2]))
        return honest(*given)

    monkeypatch.setattr(streams, "deal", noting)
    assert all_found(two, rays) == expected
    assert hands == [], "so few rays go through one device"
    monkeypatch.setattr(streams, "MANY", 100)
    monkeypatch.setattr(streams, "BLOCK", 64)
    assert all_found(two, rays) == expected
    assert {hand for _, hand in hands} == set(range(len(two.devices)))
    assert len({thread for thread, _ in hands}) > 1
    # Tiles that are full many times over, and last ones that are nearly empty.
    monkeypatch.setattr(streams, "TILES", (2**6, 2**8))
    monkeypatch.setattr(streams, "PACKET_TILES", (2**3, 2**4))
    for found in (all_found(one, rays), all_found(two, rays)):
        assert found == expected


@pytest.mark.parametrize("count", [0, 1, 31, 33, 65])
def test_few_rays(crowd, monkeypatch, count):
    scene, rays = crowd
    few = tuple(a[:count] for a in rays)
    one, two = (Tracer(scene, device="cpu", threads=k) for k in (1, 2))
    expected = all_found(one, few)
    monkeypatch.setattr(streams, "MANY", 1)
    monkeypatch.setattr(streams, "BLOCK", 32)
    assert all_found(two, few) == expected


@pytest.mark.parametrize("failing", [0, 1])
def test_where_one_device_fails_the_others_stop_and_it_is_told(crowd, monkeypatch, failing):
    scene, (origins, directions) = crowd
    tracer = Tracer(scene, device="cpu", threads=2)
    needs_two(tracer)
    monkeypatch.setattr(streams, "MANY", 100)
    monkeypatch.setattr(streams, "BLOCK", 32)
    monkeypatch.setattr(streams, "TILES", (2**6,))
    here, taken = threading.local(), []
    at_once, weigh = streams.at_once, tracer._weigh

    def noting(work, count):
        def noted(hand, stopped):
            here.hand, here.stopped = hand, stopped
            work(hand, stopped)

        at_once(noted, count)

    def weighing(*given):
        if here.hand == failing:
            raise StriptoolsError("a device fails")
        assert here.stopped.wait(60)
        taken.append(len(given[1]))
        return weigh(*given)

    monkeypatch.setattr(streams, "at_once", noting)
    monkeypatch.setattr(tracer, "_weigh", weighing)
    with pytest.raises(StriptoolsError, match="a device fails"):
        tracer.closest_hit(origins, directions, packets=False)
    assert len(taken) <= 1, "the other device went on"


def test_devices_that_make_rays_ready_share_one_sharded_program(crowd, monkeypatch):
    """As several GPUs do."""
    scene, (origins, directions) = crowd
    few = origins[:700], directions[:700], np.full(700, np.inf, np.float32)
    tracer = Tracer(scene, device="cpu", threads=2)
    monkeypatch.setattr(launch, "GPU_TILES", (2**5, 2**7))
    options = tracer._options()
    assert options is not None
    options = options._replace(batch=True, interleave=1)
    found = list(launch.stream(tracer._scene, few, tracer._mesh, options))
    assert [part.stop for part, _ in found] == [256, 512, 700]
    names = np.concatenate([traced[1] for _, traced in found])
    np.testing.assert_array_equal(names, tracer.closest_hit(*few[:2], packets=False).face)


def test_each_device_has_the_scene_where_it_lies(crowd):
    tracer = Tracer(crowd[0], device="cpu", threads=2)
    stations = tracer._stations
    assert [station.mesh.devices.tolist() for station in stations] == [[each] for each in tracer.devices]
    for station, device in zip(stations, tracer.devices, strict=True):
        assert station.scene.nodes.devices() == {device}
        assert station.scene.nodes.unsafe_buffer_pointer() == tracer._layout.arrays.nodes.ctypes.data
