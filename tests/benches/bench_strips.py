"""What each departure from Strip-RT as printed buys: vertices per triangle, expected cost, seconds.

    python tests/benches/bench_strips.py FOLDER [MESH ...] [--record]

FOLDER holds `MESH.ply` files. Costs are over that of a full SAH tree of the same triangles; in blocks the
hierarchy over strips is that of the whole mesh. Seconds are those of ordering alone (neighbours included) on
all cores, the least of three runs; `--record` appends the figures to `results.csv`.
"""

import argparse
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from results import Row, append

from striptools.hierarchies.in_strip import expand_hierarchy
from striptools.hierarchies.strip_bvh import build_strip_hierarchy
from striptools.mesh.adjacency import build_adjacency
from striptools.mesh.clean import clean
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.partition.boxes import face_boxes, node_boxes, range_boxes
from striptools.partition.cut import CHUNK, cut_tree
from striptools.partition.object_split import ObjectTree, split_objects
from striptools.partition.sah import PartitionOptions, expected_cost
from striptools.strips.linking import link_faces
from striptools.strips.ordering import OrderingOptions, Sequences, order_strips
from striptools.strips.stripify import cut_for, order_cut
from striptools.strips.tunnelling import EFFORTS, Effort

BENCH = {
    "takes": "folder",
    "models": [
        "tree_japanesemaple",
        "chandelier",
        "icub",
        "ugly_bunny_holes",
        "bunny",
        "dragon",
        "dem_jacksboro",
        "kicad_acepack",
    ],
    "full": [[]],
    "quick": [[]],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

MESHES = (
    "bunny", "dragon", "dem_jacksboro", "icub", "kicad_acepack", "chandelier", "tree_japanesemaple",
    "ugly_bunny_holes",
)  # fmt: skip
CAP = 128
BLOCK = 256
RUNS = 3
THREADS = len(os.sched_getaffinity(0))


def main() -> int:
    """Measure each model and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("meshes", nargs="*", default=MESHES)
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    for name in arguments.meshes:
        rows = departures(name, clean(load_mesh(arguments.folder / f"{name}.ply")).mesh)
        if arguments.record:
            append(rows)
    return 0


def departures(name: str, mesh: Mesh) -> list[Row]:
    """Order one mesh in every way, from the paper's to ours, and print a row for each."""
    boxes = face_boxes(mesh.positions, mesh.faces)
    tree = split_objects(boxes, threads=THREADS)
    aligned = split_objects(boxes, PartitionOptions(block=BLOCK), threads=THREADS)
    full = expected_cost(node_boxes(tree, boxes), tree.size)
    rows = []
    for step, order in steps(mesh, boxes, tree, aligned).items():
        seconds, sequences = least_time(order)
        figures = {
            "vertices per triangle": 1 + 2 * len(sequences.lengths) / len(mesh.faces),
            "relative expected cost": relative_cost(boxes, sequences, full),
            "seconds": seconds,
        }
        line = "  ".join(f"{key} {value:.4f}" for key, value in figures.items())
        sys.stdout.write(f"{name:20}{step:34}{line}\n")
        sys.stdout.flush()
        rows += [
            Row("strips", name, len(mesh.faces), metric, value, "", note=step)
            for metric, value in figures.items()
        ]
    return rows


def steps(
    mesh: Mesh, boxes: np.ndarray, tree: ObjectTree, aligned: ObjectTree
) -> dict[str, Callable[[], Sequences]]:
    """The departures, each on top of the one before."""
    faces, vertices = mesh.faces, mesh.vertex_count
    one = (faces, vertices, boxes, tree)
    chunks = cut_tree(tree, CHUNK)
    blocks = cut_for(aligned, faces, vertices, OrderingOptions(block=BLOCK))

    def tunnels(rotations: int, neutral: int, passes: int = 2) -> Callable[[], Sequences]:
        normal = EFFORTS["normal"]
        effort = Effort(rotations, neutral, normal.price, normal.rise, passes)
        return lambda: order_cut(*one, chunks, CAP, effort, THREADS)

    return {
        "paper": lambda: order_strips(
            build_adjacency(faces, vertices), faces, tree, OrderingOptions(CAP, "paper")
        ),
        "linking": lambda: link_faces(build_adjacency(faces, vertices), faces, tree, OrderingOptions(CAP)),
        "linking in chunks": lambda: order_cut(*one, chunks, CAP, None, THREADS),
        "tunnels of 1 rotation": tunnels(1, 0),
        "tunnels of 2 rotations": tunnels(2, 0),
        "tunnels of 3 rotations": tunnels(3, 0),
        "neutral moves of 1 (normal)": tunnels(3, 1),
        "neutral moves of 3, 4 passes (best)": tunnels(3, 3, 4),
        f"normal in blocks of {BLOCK}": lambda: order_cut(
            faces, vertices, boxes, aligned, blocks, CAP, EFFORTS["normal"], THREADS
        ),
    }


def least_time(order: Callable[[], Sequences]) -> tuple[float, Sequences]:
    """The least seconds of a few runs after one that compiles, and the result."""
    sequences = order()
    runs = []
    for _ in range(RUNS):
        start = time.perf_counter()
        sequences = order()
        runs.append(time.perf_counter() - start)
    return min(runs), sequences


def relative_cost(boxes: np.ndarray, sequences: Sequences, full: float) -> float:
    """Expected cost of the hierarchy over strips and the balanced ones inside, over the full tree's."""
    strip_boxes = range_boxes(boxes, sequences.starts, sequences.faces)
    order, hierarchy = build_strip_hierarchy(
        strip_boxes, sequences.lengths.astype(np.int32), PartitionOptions(), threads=THREADS
    )
    placed = sequences.reordered(order)
    tree = expand_hierarchy(hierarchy, placed.starts, np.ascontiguousarray(boxes[placed.faces]))
    return expected_cost(tree.boxes, tree.size) / full


if __name__ == "__main__":
    sys.exit(main())
