"""Seconds that each function takes to be compiled, in a process with an empty cache and in the next one.

    python tests/benches/bench_compile.py [--runs 2] [--record]

Every function is called in a pair of processes of its own, with few rays of a small scene. What JAX says of
tracing, lowering and XLA's compiling is summed over all programs of the call; the program that XLA takes
longest for is told apart, and in processor time too, which other programs on the machine leave alone. Least
of the runs. A call in packets needs two programs: rays that find no company walk alone. What Numba compiles
is kept in its own cache and is not counted. Ends with 1 where XLA takes more than `LIMIT` seconds of the
processor for one program, or where a second process compiles what the first one kept.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from results import Row, append

BENCH = {"takes": "nothing", "full": [[]], "quick": []}

LIMIT = 5.0
SMALLEST_KEPT = 0.2
"""Seconds of compilation below which a program is not kept: `device.prepare_jax`."""

CHILD = """
import json, sys
sys.path.insert(0, sys.argv[1])
import jax
import bench_compile
sys.stdout.write(json.dumps(bench_compile.measure(sys.argv[2])))
"""
STAGES = {
    "/jax/core/compile/jaxpr_trace_duration": "trace",
    "/jax/core/compile/jaxpr_to_mlir_module_duration": "lower",
    "/jax/core/compile/backend_compile_duration": "compile",
}
LOWERED, COMPILED = list(STAGES)[1:]


def calls() -> dict[str, Callable[[], object]]:
    """What is measured, by name: functions that make a tracer and call it."""
    import jax
    import numpy as np
    from leak_shapes import torus
    from leak_walks import OTHERS

    import striptools
    from striptools.mesh.instances import Geometries, Instances
    from striptools.mesh.mesh import Mesh
    from striptools.trace import Tracer, functional
    from striptools.trace.rays import Camera, camera_rays

    mesh = torus(40, 20, 0.2)
    scene = striptools.convert(mesh)
    few = tuple(a[:100] for a in camera_rays(Camera.framing(scene.positions, width=10, height=10)))
    # Enough to go in packets.
    many = camera_rays(Camera.framing(scene.positions, width=64, height=64))

    inside = np.random.default_rng(0).uniform(scene.low, scene.high, (100, 3))

    def of(resident: str) -> Tracer:
        return Tracer(scene, device="cpu", resident=resident)  # pyright: ignore[reportArgumentType]

    def shared(resident: str) -> Tracer:
        ranges = (np.array([0, mesh.triangle_count], np.int32), np.array([0, len(mesh.positions)], np.int32))
        matrix = np.stack([np.eye(4)[:3], np.eye(4)[:3]])
        matrix[1, 0, 3] = 5
        standing = {"geometries": Geometries(*ranges), "instances": Instances(np.zeros(2, np.int32), matrix)}
        crowd = striptools.convert(Mesh(mesh.positions, mesh.faces, **standing))
        return Tracer(crowd, device="cpu", instances="shared", resident=resident)  # pyright: ignore[reportArgumentType]

    found = {}
    for resident in ("expanded", "compressed"):
        found |= {
            f"closest hit, {resident}": lambda r=resident: of(r).closest_hit(*few, packets=False),
            f"any hit, {resident}": lambda r=resident: of(r).any_hit(*few, packets=False),
            f"closest hit in packets, {resident}": lambda r=resident: of(r).closest_hit(*many),
            f"any hit in packets, {resident}": lambda r=resident: of(r).any_hit(*many),
            f"closest hit with counters, {resident}": lambda r=resident: of(r).closest_hit(
                *few, counters=True
            ),
            f"all hits, 8, {resident}": lambda r=resident: of(r).all_hits(*few, k=8),
            f"count hits, {resident}": lambda r=resident: of(r).count_hits(*few),
            f"contains, {resident}": lambda r=resident: of(r).contains(inside),
            f"closest point, {resident}": lambda r=resident: of(r).closest_point(few[0]),
            f"closest hit, shared instances, {resident}": lambda r=resident: shared(r).closest_hit(*few),
            f"any hit, shared instances, {resident}": lambda r=resident: shared(r).any_hit(*few),
        }
    found["winding numbers"] = lambda: of("expanded").winding_numbers(few[0])
    names = (
        "binary SAH",
        "slbvh over triangles",
        "kdtree over triangles",
        "presorted, no nodes",
        "presorted, 10 levels",
    )
    for walk in OTHERS:
        if walk.name in names:
            found[f"closest hit, {walk.name}"] = lambda w=walk: w.tracer(scene).closest_hit(*few)
            found[f"any hit, {walk.name}"] = lambda w=walk: w.tracer(scene).any_hit(*few)

    def depth(geometry, positions, origins, directions):
        return functional.closest_hit(geometry, positions, origins, directions).t.sum()

    def differentiated(function: Callable[..., object]) -> object:
        geometry = functional.Geometry.of(of("expanded"), mesh.faces)
        return jax.jit(function)(geometry, mesh.positions, *few)

    found["functional closest hit, jit"] = lambda: differentiated(depth)
    found["functional closest hit, gradient"] = lambda: differentiated(jax.grad(depth, argnums=1))
    return found


def measure(name: str) -> dict[str, float]:
    """Call one and say what JAX spent on it."""
    import jax
    from jax import monitoring

    import striptools.trace  # noqa: F401

    call = calls()[name]
    seconds = dict.fromkeys((*STAGES.values(), "longest", "processor", "kept"), 0.0)
    begun = [0.0]

    def listen(event: str, duration_secs: float, **_: object) -> None:
        if event in STAGES:
            seconds[STAGES[event]] += duration_secs
        if event == LOWERED:
            # What follows is its compilation.
            begun[0] = time.process_time()
        if event == COMPILED:
            seconds["longest"] = max(seconds["longest"], duration_secs)
            seconds["processor"] = max(seconds["processor"], time.process_time() - begun[0])

    def count(event: str, **_: object) -> None:
        seconds["kept"] += event == "/jax/compilation_cache/cache_hits"

    jax.devices()
    monitoring.register_event_duration_secs_listener(listen)
    monitoring.register_event_listener(count)
    call()
    return seconds


def main() -> int:
    """Measure each function twice and print a row."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--only", default="", help="functions whose name has this in it")
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    rows, failed = [], False
    for name in calls():
        if arguments.only in name:
            firsts, seconds = zip(*(pair(name) for _ in range(arguments.runs)), strict=True)
            first, again = least(firsts), least(seconds)
            kept = int(again["kept"])
            failed |= first["processor"] > LIMIT
            failed |= first["longest"] > SMALLEST_KEPT and (
                kept == 0 or again["longest"] > first["longest"] / 2
            )
            said = (
                f"longest program {first['longest']:.2f} s of XLA ({first['processor']:.2f} of the processor)"
            )
            said += f", all {first['compile']:.2f}"
            later = f"{again['compile']:.2f} s of it XLA, {kept} programs from the cache"
            sys.stdout.write(f"{name}: {first['all']:.2f} s, {said}; then {again['all']:.2f} s, {later}\n")
            sys.stdout.flush()
            said += f", least of {arguments.runs}"
            rows.append(Row("compile", "torus", 1600, name, first["all"], "s", note=said))
            rows.append(
                Row("compile", "torus", 1600, f"{name}, second process", again["all"], "s", note=later)
            )
    if arguments.record:
        append(rows)
    return int(failed)


def least(runs: tuple[dict[str, float], ...]) -> dict[str, float]:
    """The least of each figure, and of the sum of all stages."""
    found = {key: min(run[key] for run in runs) for key in runs[0]}
    return found | {"all": min(sum(run[stage] for stage in STAGES.values()) for run in runs)}


def pair(name: str) -> tuple[dict[str, float], dict[str, float]]:
    """A first process with an empty cache and a second one."""
    with tempfile.TemporaryDirectory() as folder:
        environment = os.environ | {"XDG_CACHE_HOME": folder}
        command = [sys.executable, "-c", CHILD, str(Path(__file__).parent), name]
        found = []
        for _ in range(2):
            done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
            found.append(json.loads(done.stdout.splitlines()[-1]))
    return found[0], found[1]


if __name__ == "__main__":
    sys.exit(main())
