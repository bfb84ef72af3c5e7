"""Strips against the stripifiers that people use, in one run, restarts counted for all alike.

    python tests/benches/bench_strips_peers.py FOLDER [FOLDER ...] [--mesh NAME ...] [--record] [--traced]

A FOLDER holds `NAME.ply` files. Every tool gets the same cleaned triangles and its strips are decoded and
compared with them, winding included; a tool that loses windings (vtkStripper, where neighbours disagree in
theirs) is marked, and still counts as a peer to beat. An index list of s strips counts its s - 1 restarts,
whoever wrote it; a triangle that a tool leaves alone is a strip of three indices. A tool that is not
installed (extra `peers`) is left out with a word, as is one written in Python alone on more triangles than it
can do.

`--traced` adds traced rays a second of Strip-RT over the baselines (`striptools study strips`). `--record`
appends the figures to `results.csv`.
"""

import argparse
import ctypes
import importlib.util
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from results import Row, append

from striptools.measure.quality import strip_quality
from striptools.mesh.adjacency import build_adjacency
from striptools.mesh.clean import clean
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert
from striptools.strips.alternating import AlternatingOptions, alternating_strips
from striptools.strips.ordering import OrderingOptions
from striptools.strips.topology import classic_strips, encode_strips

BENCH = {
    "takes": "named",
    "models": [
        "bunny",
        "chandelier",
        "kicad_acepack",
        "dem_jacksboro",
        "icub",
        "tree_japanesemaple",
        "ugly_bunny_holes",
        "dragon",
        "dragon_3m5",
        "powerplant",
    ],
    "full": [["--traced"]],
    "quick": [[]],
    "peers": ["meshoptimizer", "vtk", "pyffi"],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

MESHES = (
    "bunny", "dragon", "dem_jacksboro", "icub", "kicad_acepack", "chandelier", "tree_japanesemaple",
    "ugly_bunny_holes", "dragon_3m5", "powerplant",
)  # fmt: skip
RESTART = -1
MOST_IN_PYTHON = 100_000
"""Triangles above which a stripifier in pure Python is left out."""

RUNS = 3


@dataclass(frozen=True)
class Outcome:
    """What a tool made of a mesh.

    Attributes:
        tool: Its name and settings.
        indices: One list, with `RESTART` between strips.
        seconds: The fastest run.
        same: Whether the list holds the faces of the mesh, windings included.
    """

    tool: str
    indices: np.ndarray
    seconds: float
    same: bool = True


def main() -> int:
    """Measure each model, print its tables, and say how many were lost to a peer or came out wrong."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folders", type=Path, nargs="+")
    parser.add_argument("--mesh", action="append")
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--traced", action="store_true")
    arguments = parser.parse_args()
    failed = 0
    for name in arguments.mesh or MESHES:
        path = next((f / f"{name}.ply" for f in arguments.folders if (f / f"{name}.ply").exists()), None)
        if path is None:
            say(f"{name}: not in the folders, left out")
            continue
        mesh = clean(load_mesh(path)).mesh
        rows, won = compare_classic(name, mesh)
        rows += generalised(name, mesh)
        rows += traced(name, mesh) if arguments.traced else []
        failed += not won
        if arguments.record:
            append(rows)
    return 1 if failed else 0


def compare_classic(name: str, mesh: Mesh) -> tuple[list[Row], bool]:
    """Indices per triangle of everyone; whether ours is right and at least as good as the best peer."""
    say(f"\n{name}: {mesh.triangle_count:,} triangles; classic strips, restarts counted")
    wanted = sorted_faces(mesh.faces)
    ours, peers, right = [], [], True
    for group, tools in ((ours, our_tools(mesh)), (peers, peer_tools(mesh))):
        for outcome in tools:
            same = np.array_equal(sorted_faces(decoded(outcome.indices)), wanted)
            group.append(replace(outcome, same=same))
            right &= same or group is peers
            figures = f"{per_triangle(outcome, mesh):8.4f} indices per triangle, {strips(outcome):9,} strips"
            say(f"  {outcome.tool:38} {figures} {outcome.seconds:9.3f} s{'' if same else '  WRONG FACES'}")
    best_ours, best_peer = min(ours, key=size), min(peers, key=size, default=None)
    rows = [classic_row(name, mesh, one, best_peer) for one in ours]
    rows += [classic_row(name, mesh, one, None) for one in peers]
    won = best_peer is None or size(best_ours) <= size(best_peer)
    if best_peer is not None:
        say(f"  ours over the best peer, {best_peer.tool}: {size(best_ours) / size(best_peer):.4f}")
    return rows, right and won


def classic_row(name: str, mesh: Mesh, one: Outcome, peer: Outcome | None) -> Row:
    """Indices per triangle as a row of the results, beside a peer's."""
    return Row(
        "strips_peers",
        name,
        mesh.triangle_count,
        f"classic indices, {one.tool}",
        per_triangle(one, mesh),
        "per triangle",
        peer.tool if peer else "",
        per_triangle(peer, mesh) if peer else None,
        size(one) / size(peer) if peer else None,
        f"restarts counted; {one.seconds:.3f} s{'' if one.same else '; not the same faces'}",
    )


def generalised(name: str, mesh: Mesh) -> list[Row]:
    """Vertices per triangle and relative cost of the strips that a scene stores.

    They are ordered in chunks and grouped into blocks afterwards, or ordered inside blocks, as by default.
    """
    rows = []
    cases = {
        "in chunks, normal": OrderingOptions(block=None),
        "in chunks, best": OrderingOptions(block=None, effort="best"),
        "in blocks of 256": OrderingOptions(),
        "as the paper has it": OrderingOptions(method="paper"),
    }
    for case, ordering in cases.items():
        quality = strip_quality(convert(mesh, Options(ordering=ordering)))
        say(
            f"  strip-rt, {case:20} {quality.vertices_per_triangle:.4f} vertices per triangle, "
            f"{quality.relative_cost:.4f} of a full SAH tree's cost, {quality.singletons:,} singletons"
        )
        for metric, value in (
            ("vertices per triangle", quality.vertices_per_triangle),
            ("relative expected cost", quality.relative_cost),
        ):
            rows.append(Row("strips_peers", name, mesh.triangle_count, f"{metric}, {case}", value, ""))
    return rows


def traced(name: str, mesh: Mesh) -> list[Row]:
    """Traced rays a second of Strip-RT over the baselines, by the study."""
    from striptools.measure.study import StudyOptions, study_strips

    study = study_strips(mesh, StudyOptions(runs=7, up="z" if name.startswith(("dem", "terrain")) else "y"))
    rows = []
    reference = study.rows[0]
    for row in study.rows:
        say(
            f"  strip-rt over {row.variant:14} primary {row.primary_ratio:.3f}, secondary "
            f"{row.secondary_ratio:.3f}; steps {row.primary_steps:.2f}, {row.secondary_steps:.2f}; "
            f"{row.scene_bytes / study.triangles:.2f} bytes per triangle, "
            f"cost {row.quality.relative_cost:.3f}"
        )
        for kind in ("primary", "secondary"):
            own = getattr(reference, f"{kind}_rate")
            rows.append(
                Row(
                    "strips_peers", name, study.triangles, f"{kind} rays a second of strip-rt", own, "rays/s",
                    row.variant, getattr(row, f"{kind}_rate"), getattr(row, f"{kind}_ratio"),
                    f"steps {getattr(reference, f'{kind}_steps'):.2f} against "
                    f"{getattr(row, f'{kind}_steps'):.2f}",
                )
            )  # fmt: skip
    return rows


def our_tools(mesh: Mesh) -> Iterator[Outcome]:
    """Classic strips by turn search."""
    for effort in ("normal", "best"):
        yield timed(f"striptools alternating, {effort}", lambda effort=effort: alternating(mesh, effort))


def alternating(mesh: Mesh, effort: str) -> np.ndarray:
    """Strips for rasterisers as one index list."""
    adjacency = build_adjacency(mesh.faces, mesh.vertex_count)
    options = AlternatingOptions(effort=effort)  # pyright: ignore[reportArgumentType]
    return classic_strips(encode_strips(mesh.faces, alternating_strips(adjacency, mesh.faces, options)))


def peer_tools(mesh: Mesh) -> Iterator[Outcome]:
    """Everything installed that makes classic strips."""
    for package, tools in (("meshoptimizer", meshoptimizer), ("vtk", vtk_stripper), ("pyffi", pyffi_strips)):
        if importlib.util.find_spec(package) is None:
            say(f"  {package} is not installed, left out")
            continue
        yield from tools(mesh)


def meshoptimizer(mesh: Mesh) -> Iterator[Outcome]:
    """meshopt_stripify, on the given order and on the orders that the library makes for caches and strips.

    The Python layer of the package does not export it, so the functions are called in its shared library.
    """
    spec = importlib.util.find_spec("meshoptimizer")
    folder = Path(next(iter(spec.submodule_search_locations or [])) if spec else "")
    library = ctypes.CDLL(str(next(folder.glob("_meshoptimizer*.so"))))
    library.meshopt_stripify.restype = library.meshopt_stripifyBound.restype = ctypes.c_size_t
    flat = np.ascontiguousarray(mesh.faces, np.uint32).reshape(-1)
    count, vertices = ctypes.c_size_t(len(flat)), ctypes.c_size_t(mesh.vertex_count)

    def ordered(how: str | None) -> np.ndarray:
        if how is None:
            return flat
        out = np.zeros_like(flat)
        getattr(library, how)(pointer(out), pointer(flat), count, vertices)
        return out

    def stripped(how: str | None) -> np.ndarray:
        order = ordered(how)
        out = np.zeros(library.meshopt_stripifyBound(count), np.uint32)
        used = library.meshopt_stripify(
            pointer(out), pointer(order), count, vertices, ctypes.c_uint(0xFFFFFFFF)
        )
        return out[:used].view(np.int32)

    for title, how in (
        ("input order", None),
        ("cache order", "meshopt_optimizeVertexCache"),
        ("cache order for strips", "meshopt_optimizeVertexCacheStrip"),
    ):
        yield timed(f"meshoptimizer, {title}", lambda how=how: stripped(how))


def pointer(values: np.ndarray) -> ctypes.c_void_p:
    """Where an array lies."""
    return ctypes.c_void_p(values.ctypes.data)


def vtk_stripper(mesh: Mesh) -> Iterator[Outcome]:
    """vtkStripper without a limit on the length."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray, vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData
    from vtkmodules.vtkFiltersCore import vtkStripper

    points, cells, data = vtkPoints(), vtkCellArray(), vtkPolyData()
    positions, flat = np.ascontiguousarray(mesh.positions), mesh.faces.astype(np.int64).reshape(-1)
    offsets = np.arange(0, len(flat) + 1, 3)
    points.SetData(numpy_to_vtk(positions))
    cells.SetData(numpy_to_vtkIdTypeArray(offsets, deep=1), numpy_to_vtkIdTypeArray(flat, deep=1))
    data.SetPoints(points)
    data.SetPolys(cells)

    def stripped() -> np.ndarray:
        stripper = vtkStripper()
        stripper.SetInputData(data)
        stripper.SetMaximumLength(2**30)
        stripper.Update()
        found = stripper.GetOutput()
        parts = []
        for group in (found.GetStrips(), found.GetPolys()):
            if group.GetNumberOfCells():
                begins = vtk_to_numpy(group.GetOffsetsArray())[:-1]
                parts.append(joined(vtk_to_numpy(group.GetConnectivityArray()), begins))
        return np.concatenate(parts)[1:]

    yield timed("vtkStripper", stripped)


def pyffi_strips(mesh: Mesh) -> Iterator[Outcome]:
    """The stripifier of pyffi, NvTriStrip in Python."""
    if mesh.triangle_count > MOST_IN_PYTHON:
        say(f"  pyffi is left out above {MOST_IN_PYTHON:,} triangles, for it is pure Python")
        return
    from pyffi.utils import tristrip

    def stripped() -> np.ndarray:
        parts = [
            np.array(part, np.int32) for part in tristrip.stripify(mesh.faces.tolist(), stitchstrips=False)
        ]
        begins = np.cumsum([0, *map(len, parts)])[:-1]
        return joined(np.concatenate(parts), begins)[1:]

    yield timed("pyffi tristrip", stripped, runs=1)


def joined(indices: np.ndarray, begins: np.ndarray) -> np.ndarray:
    """Index lists one after another, a restart before each."""
    return np.insert(indices.astype(np.int32), begins, RESTART)


def timed(tool: str, work: Callable[[], np.ndarray], runs: int = RUNS) -> Outcome:
    """Run a tool some times and keep the fastest."""
    best, indices = np.inf, np.zeros(0, np.int32)
    for _ in range(runs):
        start = time.perf_counter()
        indices = work()
        best = min(best, time.perf_counter() - start)
    return Outcome(tool, indices, best)


def decoded(indices: np.ndarray) -> np.ndarray:
    """The triangles of classic strips, by their definition; this shares no code with the library."""
    place = np.arange(len(indices))
    restart = indices == RESTART
    last_restart = np.maximum.accumulate(np.where(restart, place, -1))
    k = place - last_restart - 1
    at = np.flatnonzero((k >= 2) & ~restart)
    rows = np.stack([indices[at - 2], indices[at - 1], indices[at]], axis=1)
    odd = k[at] % 2 == 1
    rows[odd] = rows[odd][:, [1, 0, 2]]
    a, b, c = rows.T
    return rows[(a != b) & (b != c) & (c != a)]


def sorted_faces(faces: np.ndarray) -> np.ndarray:
    """Faces turned to begin with their least vertex, winding kept, and sorted."""
    turn = faces.argmin(axis=1)[:, None]
    rows = np.take_along_axis(faces, (np.arange(3) + turn) % 3, axis=1)
    return rows[np.lexsort(rows.T)]


def strips(outcome: Outcome) -> int:
    """How many strips there are."""
    return int((outcome.indices == RESTART).sum()) + 1


def size(outcome: Outcome) -> int:
    """Indices and restarts."""
    return len(outcome.indices)


def per_triangle(outcome: Outcome, mesh: Mesh) -> float:
    """Indices per triangle, restarts counted."""
    return len(outcome.indices) / mesh.triangle_count


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{line}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
