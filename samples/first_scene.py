"""The main job on a real model: convert it, verify the scene against it, draw its picture, print a summary.

    python samples/first_scene.py [MODEL] [FOLDER]

Without arguments the model is the chandelier beside this script, and the scene and the picture go to
`first_scene/` in the folder that the script is started from.
"""

import sys
import time
from itertools import pairwise
from pathlib import Path

import striptools

HERE = Path(__file__).parent


def main(model: Path = HERE / "chandelier.ply", folder: Path = Path("first_scene")) -> int:
    """Do the main job; give the exit code, 1 where the scene is not proved."""
    folder.mkdir(parents=True, exist_ok=True)
    scene_file, picture_file = folder / f"{model.stem}.rdm", folder / f"{model.stem}.png"
    print("On a machine's first run kernels and tracer are compiled, in up to a minute; then they are kept.")
    times = [time.perf_counter()]

    mesh = striptools.load_mesh(model)
    times.append(time.perf_counter())
    scene, report = striptools.convert_with_report(mesh)
    scene.save(scene_file)
    times.append(time.perf_counter())

    # JAX is loaded only now: converting does without it.
    from striptools.measure.verify import VerifyOptions, verify
    from striptools.trace import Tracer
    from striptools.trace.rays import Camera
    from striptools.trace.render import render, save_png

    scene = striptools.open(scene_file)
    tracer = Tracer(scene)
    # Few rays more than 512, for on two cores all kinds of rays then run in one compiled program.
    proof = verify(scene, mesh, VerifyOptions(rays=600, aimed_rays=16384), tracer=tracer)
    times.append(time.perf_counter())
    camera = Camera.framing(scene.positions, width=480, height=480)
    save_png(render(tracer, scene, camera), picture_file)
    times.append(time.perf_counter())

    dropped = report.counts["faces_in"] - report.counts["faces_out"]
    load, convert, check, draw = (end - start for start, end in pairwise(times))
    print(f"converted  {model.name} -> {scene_file}")
    print(
        f"           {scene.triangle_count:,} triangles in {scene.strip_count:,} strips, {dropped:,} dropped"
    )
    print(f"           {len(scene.vertices) / scene.triangle_count:.2f} vertices per triangle,", end=" ")
    print(f"{scene.bytes_per_triangle():.1f} bytes per triangle")
    print(
        f"verified   {proof.rays:,} rays: {proof.disagreements:,} disagreements, {proof.leaks:,} leaks;",
        end=" ",
    )
    print(f"{proof.structure.errors:,} wrong faces")
    print(f"drawn      {picture_file}")
    print(f"seconds    load {load:.2f}, convert {convert:.2f}, verify {check:.2f}, draw {draw:.2f},", end=" ")
    print(f"total {times[-1] - times[0]:.2f}")
    return 0 if proof.ok else 1


if __name__ == "__main__":
    sys.exit(main(*(Path(argument) for argument in sys.argv[1:3])))
