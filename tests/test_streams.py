"""Rays that devices take in runs, a thread each, and streamed in tiles: each once, whatever the devices."""

import threading

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scenes import scene_of
from strategies import sphere

from striptools.errors import StriptoolsError
from striptools.kernels.packets import PACKET, ready_packets
from striptools.kernels.packets import ROW as PACKET_ROW
from striptools.kernels.rays import ROW, ready_rays
from striptools.mesh.mesh import Mesh
from striptools.trace import Tracer, launch, streams
from striptools.trace.rays import Camera, camera_rays
from striptools.trace.streams import EVERY_RAY
from striptools.trace.tracer import checked_rays


@given(st.integers(1, 10**7), st.integers(1, 64), st.booleans(), st.booleans())
def test_runs_are_taken_once_and_get_shorter(count, hands, packets, chosen):
    order = np.arange(count, dtype=np.int32)[::-1].copy() if chosen and count < 10**5 else EVERY_RAY
    runs = list(streams._Runs(count, order, hands, packets))
    if hands == 1:
        assert len(runs) == 1
        np.testing.assert_array_equal(runs[0], order)
        return
    taken = np.concatenate(runs) if len(runs) > 1 or len(runs[0]) else np.arange(count)
    np.testing.assert_array_equal(taken, order if len(order) else np.arange(count))
    lengths = [len(run) for run in runs]
    assert all(length % PACKET == 0 for length in lengths[:-1])
    assert lengths == sorted(lengths, reverse=True)
    longest = PACKET * streams.PACKET_TILES[-1] if packets else streams.TILES[-1]
    assert max(lengths) <= longest
    # The last run is no longer than what each of the others has on its way.
    assert lengths[-1] <= max(longest // streams.SHORTEST, count // hands)


def test_threads_take_each_run_once():
    """Where one takes what another is about to take, that one is done."""
    runs, taken = streams._Runs(10**6, EVERY_RAY, 8, packets=False), []
    threads = [threading.Thread(target=lambda: taken.extend(runs)) for _ in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert np.array_equal(np.sort(np.concatenate(taken)), np.arange(10**6))
    assert list(runs) == []


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
    threads = []
    honest = streams.ready_rays

    def noting(*given):
        threads.append(threading.get_ident())
        return honest(*given)

    monkeypatch.setattr(streams, "ready_rays", noting)
    assert all_found(two, rays) == expected
    assert set(threads) == {threading.get_ident()}, "so few rays go through one device"
    monkeypatch.setattr(streams, "MANY", 100)
    monkeypatch.setattr(streams, "SHORTEST", 2**10)
    assert all_found(two, rays) == expected
    assert len(set(threads)) > 2
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
    monkeypatch.setattr(streams, "SHORTEST", 2**10)
    assert all_found(two, few) == expected


@pytest.mark.parametrize("failing", [0, 1])
def test_where_one_device_fails_the_others_stop_and_it_is_told(crowd, monkeypatch, failing):
    scene, (origins, directions) = crowd
    tracer = Tracer(scene, device="cpu", threads=2)
    needs_two(tracer)
    monkeypatch.setattr(streams, "MANY", 100)
    monkeypatch.setattr(streams, "SHORTEST", 2**10)
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


@pytest.mark.parametrize("packets", [False, True])
def test_what_lies_behind_the_last_ray_is_not_walked(crowd, packets):
    """A tile is used again and again: behind its last ray lie those of before."""
    scene, rays = crowd
    tracer = Tracer(scene, device="cpu", threads=1)
    options, station = tracer._options(), tracer._stations[0]
    assert options is not None
    size = PACKET_ROW if packets else ROW
    rows = np.zeros((8, size) if packets else (256, size), np.float32)
    given, which = checked_rays(*rays, None), np.zeros(0, np.int32)
    if packets:
        origins = np.tile(np.float32([0, 0, 9]), (256, 1))
        way = np.random.default_rng(4).normal(0, 0.01, (256, 3)).astype(np.float32) - np.float32([0, 0, 1])
        given, seen = checked_rays(origins, way, None), tracer._layout.seen_by_packets
        places = rows, rows.view(np.int32), np.zeros((8, PACKET), np.int32), np.zeros(512, np.int32)
        dropped = np.zeros(256, np.uint8)
        count = ready_packets(*given, which, 0, seen.frame, seen.box, seen.density, *places, dropped)[0]
    else:
        seen = tuple(tracer._layout.arrays.frame), *tracer._layout.root
        places = rows, rows.view(np.int32), np.zeros(256, np.int32), np.zeros(len(rays[0]), np.uint8)
        count = ready_rays(*given, which, 0, *seen, True, *places)[0]
    assert count == len(rows)
    walk = launch.program(station.mesh, options, packets)
    every, some = (walk(station.scene, rows, np.int32([live])) for live in (count, count // 2))
    for one, other in zip(every[:2], some[:2], strict=True):
        np.testing.assert_array_equal(one[: count // 2], other[: count // 2])
        assert not np.asarray(other[count // 2 :]).any(), "nothing is said of the others"
    assert (np.asarray(every.name[count // 2 :]) >= 0).any()


def test_rays_that_part_are_not_put_into_packets(crowd, monkeypatch):
    scene, rays = crowd
    origins, directions = (a[-901:] for a in rays)
    tracer = Tracer(scene, device="cpu", threads=1)
    asked = []
    honest = streams.ready_packets
    monkeypatch.setattr(streams, "ready_packets", lambda *given: asked.append(1) or honest(*given))
    apart = tracer.closest_hit(origins, directions)
    assert asked == []
    # A quarter of them in rows of 32 is enough.
    together = directions.copy()
    quarter = -(-len(together) // 4 // PACKET) * PACKET
    together[:quarter] = together[0]
    tracer.closest_hit(origins, together)
    assert asked == [1]
    np.testing.assert_array_equal(apart.face, tracer.closest_hit(origins, directions, packets=False).face)
