"""What a scene file holds, byte by byte, and what it costs to make, to open and to complete.

    python tests/benches/bench_format.py MODEL [MODEL ...] [--bits 20 16 12] [--blocks 64 128 256] [--record]

MODEL is a mesh. Every precision gives bytes per triangle (all but the remap), by part, and those that tracing
without unpacking holds. Seconds are the least of five runs on all cores after a first one: encoding the
blocks of a scene whose strips are in order, building the boxes inside blocks, decoding, and opening the file
(header and section table). `--blocks` compares block sizes, lossless. `--record` appends the figures to
`results.csv`.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from results import Row, append

import striptools
from striptools.hierarchies.packed import build_inner
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.partition.sah import PartitionOptions
from striptools.pipeline import convert
from striptools.reducem.blocks import decode_blocks, encode_blocks
from striptools.reducem.quantize import PrecisionOptions
from striptools.reducem.scene import Scene
from striptools.strips.ordering import OrderingOptions
from striptools.strips.topology import Strips
from striptools.threads import every_core

BENCH = {
    "takes": "paths",
    "models": [
        "bunny",
        "dragon",
        "dem_jacksboro",
        "icub",
        "kicad_acepack",
        "chandelier",
        "tree_japanesemaple",
        "dragon_3m5",
        "terrain_1m",
        "powerplant",
    ],
    "full": [["--blocks", "64", "128", "256"]],
    "quick": [["--bits", "16"]],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

RUNS = 5


def main() -> int:
    """Measure each model and print a row for each figure."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", nargs="+", type=Path)
    parser.add_argument("--bits", nargs="*", type=int, default=[20, 16, 12])
    parser.add_argument("--blocks", nargs="*", type=int, default=[])
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    for path in arguments.models:
        mesh = load_mesh(path)
        rows = measure(path.stem, mesh, arguments.bits, arguments.blocks)
        for row in rows:
            sys.stdout.write(f"{row.mesh}: {row.metric} {row.value:.5g} {row.unit} {row.note}\n")
            sys.stdout.flush()
        if arguments.record:
            append(rows)
    return 0


def measure(name: str, mesh: Mesh, bits: list[int], blocks: list[int]) -> list[Row]:
    """Sizes at every precision and block size, and the seconds of the lossless scene."""
    lossless = convert(mesh)
    rows = sizes(name, lossless, "lossless", by_part=True) + seconds(name, lossless)
    for width in bits:
        scene = convert(mesh, Options(precision=PrecisionOptions(bits=width)))
        rows += sizes(name, scene, f"{width} bits")
    for size in blocks:
        options = Options(ordering=OrderingOptions(block=size), partition=PartitionOptions(block=size))
        rows += sizes(name, convert(mesh, options), f"lossless, blocks of {size}")
    return rows


def sizes(name: str, scene: Scene, note: str, *, by_part: bool = False) -> list[Row]:
    """Bytes per triangle of one scene."""
    count, unit = scene.triangle_count, "bytes per triangle"
    note += f", {scene.block_count} blocks, error bound {scene.error_bound:.3g}"
    figures = [
        ("file without remap", scene.bytes_per_triangle()),
        ("resident with boxes", scene.resident_bytes_per_triangle()),
    ]
    if by_part:
        parts = scene.part_bytes() | {
            key: scene.storing_boxes().part_bytes()[key] for key in ("in_block_hierarchy",)
        }
        figures += [(f"part {part}", value / count) for part, value in parts.items()]
    return [Row("format", name, count, metric, value, unit, note=note) for metric, value in figures]


def seconds(name: str, scene: Scene) -> list[Row]:
    """How long the steps of making and using a lossless scene take."""
    threads, count = every_core(), scene.triangle_count
    strips = strips_of(scene)
    block_strips = np.searchsorted(scene.starts, scene.block_starts).astype(np.int32)
    boxes = scene.triangle_boxes()
    top = scene.packed.top_count
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.rdm"
        scene.save(path)
        steps: dict[str, Callable[[], object]] = {
            "encode blocks": lambda: encode_blocks(scene.positions, strips, block_strips, threads),
            "decode blocks": lambda: decode_blocks(scene.blocks, threads, name),
            "build boxes inside blocks": lambda: build_inner(
                boxes, scene.block_starts, scene.starts, scene.grid, top, threads=threads
            ),
            "open": lambda: striptools.open(path),
        }
        least = {step: min(timed(work) for _ in range(RUNS + 1)) for step, work in steps.items()}
    note = f"{threads} threads, least of {RUNS} runs"
    rows = [
        Row("format", name, count, f"seconds to {step}", value, "s", note=note)
        for step, value in least.items()
    ]
    rates = {step: count / value / 1e6 for step, value in least.items() if step != "open"}
    return rows + [
        Row("format", name, count, f"rate: {step}", value, "M triangles/s", note=note)
        for step, value in rates.items()
    ]


def strips_of(scene: Scene) -> Strips:
    """The strips of a scene as the encoder takes them."""
    nothing = np.zeros(scene.triangle_count, np.int32)
    return Strips(
        scene.leaders[scene.vertices],
        scene.turns,
        scene.starts,
        nothing,
        nothing.astype(np.uint8),
        scene.flips,
    )


def timed(work: Callable[[], object]) -> float:
    """Seconds of one run."""
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


if __name__ == "__main__":
    sys.exit(main())
