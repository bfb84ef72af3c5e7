"""Rays shared out over processes: two real ones give the hits of one, bit for bit."""

import os
import socket
import subprocess
import sys
from itertools import pairwise
from pathlib import Path

import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jax.experimental import multihost_utils
from strategies import sphere

import striptools
from striptools.errors import UsageError
from striptools.mesh.mesh import Mesh
from striptools.trace import Hits, Tracer, distributed
from striptools.trace.rays import Camera, camera_rays

NAMES = ("t", "face", "u", "v", "triangle")
TRIES = 3
SECONDS = 240
CHILD = """
import sys
from pathlib import Path
import jax
import numpy as np
import striptools
from striptools.trace import Tracer, distributed

address, process, folder = sys.argv[1], int(sys.argv[2]), Path(sys.argv[3])
jax.distributed.initialize(address, num_processes=2, process_id=process, initialization_timeout=120)
assert (jax.process_count(), len(jax.devices()), len(jax.local_devices())) == (2, 2, 1)
tracer = Tracer(striptools.open(folder / "scene.rdm"), device="cpu")
rays = np.load(folder / "rays.npz")
given = rays["origins"], rays["directions"]
hits = distributed.closest_hit(tracer, *given, t_max=rays["t_max"], counters=True)
hit = distributed.any_hit(tracer, *given, t_max=rays["t_max"])
np.savez(
    folder / f"hits{process}.npz", any=hit, steps=hits.counters.steps,
    **{name: getattr(hits, name) for name in ("t", "face", "u", "v", "triangle")},
)
"""


def name_of_host_resolves() -> bool:
    """Whether gloo, by which JAX gathers on CPUs, can find this machine."""
    try:
        return bool(socket.getaddrinfo(socket.gethostname(), None))
    except OSError:
        return False


@pytest.fixture(scope="module")
def scene() -> striptools.Scene:
    return striptools.convert(Mesh(*sphere(3)))


@pytest.fixture(scope="module")
def rays(scene: striptools.Scene) -> dict[str, np.ndarray]:
    """An odd number of rays, each with a reach of its own that ends some before their hit."""
    origins, directions = camera_rays(Camera.framing(scene.positions, width=61, height=43))
    t_max = np.random.default_rng(0).uniform(0, 6, len(origins)).astype(np.float32)
    return {"origins": origins, "directions": directions, "t_max": t_max}


def two_processes(folder: Path) -> None:
    """Run the child twice; once more where another program took the port in between."""
    environment = os.environ | {"STRIPTOOLS_THREADS": "1", "JAX_PLATFORMS": "cpu"}
    # The children's devices are counted, so nobody else may ask for some.
    environment.pop("XLA_FLAGS", None)
    said: list[str] = []
    for _ in range(TRIES):
        with socket.socket() as free:
            free.bind(("localhost", 0))
            address = f"localhost:{free.getsockname()[1]}"
        children = [
            subprocess.Popen(
                [sys.executable, "-c", CHILD, address, str(process), str(folder)],
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
            )
            for process in range(2)
        ]
        try:
            said = [child.communicate(timeout=SECONDS)[1] for child in children]
        finally:
            for child in children:
                child.kill()
                child.wait()
        if all(child.returncode == 0 for child in children):
            return
        if not any("in use" in text for text in said):
            break
    pytest.fail("\n".join(said))


@pytest.mark.skipif(not name_of_host_resolves(), reason="this machine cannot resolve its own name")
def test_two_processes_find_the_hits_of_one(
    scene: striptools.Scene, rays: dict[str, np.ndarray], tmp_path: Path
) -> None:
    scene.save(tmp_path / "scene.rdm")
    np.savez(tmp_path / "rays.npz", **rays)  # pyright: ignore[reportArgumentType]
    two_processes(tmp_path)
    tracer = Tracer(scene, device="cpu")
    wanted = tracer.closest_hit(rays["origins"], rays["directions"], t_max=rays["t_max"], counters=True)
    assert wanted.counters is not None
    assert 500 < wanted.hit.sum() < len(wanted.t) - 500
    for process in range(2):
        found = np.load(tmp_path / f"hits{process}.npz")
        for name in NAMES:
            assert found[name].tobytes() == getattr(wanted, name).tobytes(), name
        assert np.array_equal(found["any"], wanted.hit)
        assert np.array_equal(found["steps"], wanted.counters.steps)


@given(st.integers(0, 10**9), st.integers(1, 1000))
def test_shares_are_even_and_leave_nothing_out(count: int, processes: int) -> None:
    ends = [distributed.share_of(count, process, processes) for process in range(processes)]
    assert [ends[0].start, ends[-1].stop] == [0, count]
    assert all(one.stop == other.start for one, other in pairwise(ends))
    sizes = [end.stop - end.start for end in ends]
    assert max(sizes) - min(sizes) <= 1


@pytest.mark.parametrize("wrong", [(5, 2, 2), (5, -1, 2), (-1, 0, 2), (5, 0, 0)])
def test_shares_that_are_none_are_refused(wrong: tuple[int, int, int]) -> None:
    with pytest.raises(UsageError, match="process"):
        distributed.share_of(*wrong)


def hits_of(random: np.random.Generator, count: int) -> Hits:
    """Any bits, denormals and NaN among them, which a gathering that computes would change."""
    columns = [random.integers(-(2**31), 2**31, count).astype(np.int32) for _ in range(8)]
    t, u, v = (column.view(np.float32) for column in columns[:3])
    return Hits(t, columns[3], u, v, columns[4], None, *columns[5:8])


def test_what_processes_found_is_joined_in_their_order(monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(4)
    parts = [hits_of(random, count) for count in (3, 0, 5)]
    sent: list[list[np.ndarray]] = []

    def remember(rows: np.ndarray) -> np.ndarray:
        """The first pass: note what each process sends, in the room of the largest."""
        sent[-1].append(rows)
        return np.full((3, 1), 5, np.int32) if rows.ndim == 1 else np.zeros((3, *rows.shape), np.int32)

    monkeypatch.setattr(jax, "process_count", lambda: 3)
    monkeypatch.setattr(multihost_utils, "process_allgather", remember)
    for part in parts:
        sent.append([])
        distributed.gather_hits(part)
    answers = iter([np.stack([rows[k] for rows in sent]) for k in range(2)])
    monkeypatch.setattr(multihost_utils, "process_allgather", lambda _: next(answers))
    found = distributed.gather_hits(parts[0])
    for name in (*NAMES, "instance", "geometry", "geometry_face"):
        wanted = np.concatenate([getattr(part, name) for part in parts])
        assert getattr(found, name).tobytes() == wanted.tobytes(), name


def test_one_process_alone_has_all_hits(scene: striptools.Scene, rays: dict[str, np.ndarray]) -> None:
    tracer = Tracer(scene, device="cpu")
    alone = tracer.closest_hit(rays["origins"], rays["directions"], counters=True)
    shared = distributed.closest_hit(tracer, rays["origins"], rays["directions"], counters=True)
    for name in NAMES:
        assert getattr(alone, name).tobytes() == getattr(shared, name).tobytes()
    assert alone.counters is not None
    assert shared.counters is not None
    assert np.array_equal(np.stack(alone.counters), np.stack(shared.counters))
    hit = distributed.any_hit(tracer, rays["origins"], rays["directions"], t_max=2.0)
    assert np.array_equal(hit, tracer.any_hit(rays["origins"], rays["directions"], t_max=2.0))
