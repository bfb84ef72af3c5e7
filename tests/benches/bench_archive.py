"""Archives: bytes per triangle on disk by part, seconds to write and to expand, and peers in the same run.

    python tests/benches/bench_archive.py MODEL [MODEL ...] [--record]

A MODEL is a mesh file. It is converted without a remap, lossless and on a grid of 16 bits, and saved raw
and as an archive; what the archive expands to is compared with the raw file, byte for byte. The peers get
the same faces in the source's order: meshoptimizer orders them by its vertex cache for strips, which
packs best, and applies its index and vertex codecs at their best level, then Zstandard; Draco has the
same number of bits, and 24, which loses some, beside lossless ones. Both hold geometry alone: a hierarchy
has to be built anew from what they give back. A peer that is not installed (extra `peers`) is left out
with a word.

Seconds are the least of three runs in one process, kernels compiled. Ours include every check that a writer
and a reader make; expanding ends with a scene whose blocks and hierarchy are checked. `--record` appends the
figures to `results.csv`.
"""

import argparse
import ctypes
import io
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from results import Row, append

from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert
from striptools.reducem.layout import ENTRY, HEADER
from striptools.reducem.quantize import PrecisionOptions
from striptools.reducem.reader import open_scene
from striptools.reducem.scene import Scene

BENCH = {
    "takes": "paths",
    "models": ["bunny", "dragon", "dem_jacksboro", "icub", "kicad_acepack"],
    "full": [[]],
    "quick": [[]],
    "needs": ["zstandard"],
    "peers": ["meshoptimizer", "zstandard", "DracoPy"],
}
"""How `striptools bench` calls this: see `measure.bench_scripts`."""

RUNS = 3
BITS = (None, 16)
ZSTD_LEVELS = (12, 19)
"""Ours, and the one that is often quoted for meshoptimizer."""

DRACO_BITS = 24
"""Of Draco beside lossless ones."""


@dataclass(frozen=True)
class Outcome:
    """What a tool made of a mesh: its name, bytes, and the seconds there and back."""

    tool: str
    size: int
    write: float
    read: float


def main() -> int:
    """Measure each model and print its tables."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("models", type=Path, nargs="+")
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    for path in arguments.models:
        for bits in BITS:
            rows = measure(path, bits)
            if arguments.record:
                append(rows)
    return 0


def measure(path: Path, bits: int | None) -> list[Row]:
    """One model at one precision: ours by part, and the peers."""
    precision = PrecisionOptions() if bits is None else PrecisionOptions(bits=bits)
    scene = convert(path, Options(precision=precision))
    # With a remap the faces come back in the source's order.
    mesh, scene = scene.to_mesh(), replace(scene, remap=None)
    count = scene.triangle_count
    name = "lossless" if bits is None else f"{bits} bits"
    say(f"\n{path.stem}: {count:,} triangles, {name}; bytes per triangle, seconds to write and to expand")
    raw, archive, parts = ours(scene)
    say_one(raw, count)
    say_one(archive, count)
    say("    " + ", ".join(f"{kind} {size / count:.3f}" for kind, size in parts.items()))
    peers = list(peer_outcomes(scene, mesh, bits))
    for peer in peers:
        say_one(peer, count)
    alike = [peer for peer in peers if bits or "Draco" not in peer.tool]
    best = min(alike, key=lambda peer: peer.size, default=None)

    def row(metric: str, value: float, unit: str, peer: Outcome | None, of_peer: float | None) -> Row:
        ratio = value / of_peer if of_peer else None
        return Row(
            "archive", path.stem, count, metric, value, unit, peer.tool if peer else "", of_peer, ratio
        )

    beside = best.size / count if best else None
    rows = [row(f"archive, {name}", archive.size / count, "bytes per triangle", best, beside)]
    rows.append(row(f"raw file, {name}", raw.size / count, "bytes per triangle", None, None))
    for kind, size in parts.items():
        rows.append(row(f"archive, {name}: {kind}", size / count, "bytes per triangle", None, None))
    rows.append(row(f"write archive, {name}", archive.write, "s", best, best.write if best else None))
    rows.append(row(f"expand archive, {name}", archive.read, "s", best, best.read if best else None))
    for peer in peers:
        rows.append(row(f"{peer.tool}, {name}", peer.size / count, "bytes per triangle", None, None))
    return rows


def ours(scene: Scene) -> tuple[Outcome, Outcome, dict[str, int]]:
    """The raw file, the archive, and the archive's sections by their stored bytes."""
    outcomes, files = [], []
    for archive in (False, True):
        write, data = timed(lambda archive=archive: saved(scene, archive=archive))
        read, _ = timed(lambda data=data: expanded(data))
        outcomes.append(Outcome("striptools, " + ("archive" if archive else "raw"), len(data), write, read))
        files.append(data)
    assert saved(open_scene(files[1])) == files[0], "the archive does not expand to the raw file"
    count = int(np.frombuffer(files[1], HEADER.dtype, 1)["section_count"][0])
    table = np.frombuffer(files[1], ENTRY.dtype, count, HEADER.size)
    parts = {row["kind"].decode(): int(row["stored_length"]) for row in table}
    return outcomes[0], outcomes[1], parts | {"container": len(files[1]) - sum(parts.values())}


def saved(scene: Scene, *, archive: bool = False) -> bytes:
    """The bytes of a scene file."""
    file = io.BytesIO()
    scene.save(file, archive=archive)
    return file.getvalue()


def expanded(data: bytes) -> Scene:
    """The scene of a file, its blocks and hierarchy read and checked."""
    scene = open_scene(data)
    assert scene.blocks.count >= 0
    assert scene.packed is not None
    return scene


def peer_outcomes(scene: Scene, mesh: Mesh, bits: int | None) -> Iterator[Outcome]:
    """What each peer makes of the mesh of a scene, checked against it."""
    positions, faces = mesh.positions, mesh.faces.astype(np.uint32)
    cells = on_grid(scene, positions)
    try:
        import meshoptimizer
        import zstandard
    except ImportError as error:
        say(f"  {error.name} is not installed, meshoptimizer is left out")
    else:
        for level in ZSTD_LEVELS:
            yield by_meshoptimizer(
                meshoptimizer, zstandard, positions if cells is None else cells, faces, level
            )
    try:
        import DracoPy
    except ImportError as error:
        say(f"  {error.name} is not installed, Draco is left out")
    else:
        yield by_draco(DracoPy, positions, faces, bits or DRACO_BITS)


def on_grid(scene: Scene, positions: np.ndarray) -> np.ndarray | None:
    """The vertices of a scene on a grid as (v, 4) uint16 with a column of zeros; None without a grid."""
    if scene.grid_exponent is None:
        return None
    cells = np.ldexp(positions.astype(np.float64), -scene.grid_exponent).astype(np.int64)
    cells -= cells.min(axis=0)
    assert cells.max() < 1 << 16
    return np.pad(cells, ((0, 0), (0, 1))).astype(np.uint16)


def by_meshoptimizer(library, zstandard, vertices: np.ndarray, faces: np.ndarray, level: int) -> Outcome:
    """Order by vertex cache for strips, vertices by first use; index codec, vertex codec, Zstandard."""
    count, indices = len(vertices), faces.size

    def encode() -> tuple[bytes, int, int]:
        order = np.zeros(indices, np.uint32)
        library.optimize_vertex_cache_strip(order, faces.reshape(-1), indices, count)
        place = np.zeros(count, np.uint32)
        library.optimize_vertex_fetch_remap(place, order, indices, count)
        moved = np.zeros_like(vertices)
        moved[place] = vertices
        index = library.encode_index_buffer(place[order], indices, count)
        vertex = encoded_vertices(library, moved)
        return zstandard.compress(index + vertex, level), len(index), len(vertex)

    write, (stored, index_size, _) = timed(encode)

    def decode() -> tuple[np.ndarray, np.ndarray]:
        plain = zstandard.decompress(stored)
        index = library.decode_index_buffer(indices, 4, plain[:index_size])
        size = vertices.itemsize * vertices.shape[1]
        return index, library.decode_vertex_buffer(count, size, plain[index_size:])

    read, (_, back) = timed(decode)
    got = np.ascontiguousarray(back).view(vertices.dtype).reshape(count, -1)
    assert sorted_rows(got) == sorted_rows(vertices), "meshoptimizer lost a vertex"
    return Outcome(f"meshoptimizer + zstd -{level}", len(stored), write, read)


def encoded_vertices(library, vertices: np.ndarray) -> bytes:
    """By the newest vertex codec and its best level, which the package does not offer itself."""
    native = library.encoder.lib
    size = vertices.itemsize * vertices.shape[1]
    native.meshopt_encodeVertexBufferBound.restype = ctypes.c_size_t
    bound = native.meshopt_encodeVertexBufferBound(ctypes.c_size_t(len(vertices)), ctypes.c_size_t(size))
    out = np.zeros(bound, np.uint8)
    encode = native.meshopt_encodeVertexBufferLevel
    encode.restype = ctypes.c_size_t
    encode.argtypes = [
        *(ctypes.c_void_p, ctypes.c_size_t, ctypes.c_void_p, ctypes.c_size_t, ctypes.c_size_t),
        *(ctypes.c_int, ctypes.c_int),
    ]
    used = encode(out.ctypes.data, bound, vertices.ctypes.data, len(vertices), size, 3, 1)
    return out[:used].tobytes()


def by_draco(library, positions: np.ndarray, faces: np.ndarray, bits: int) -> Outcome:
    """Edgebreaker, the slowest level."""
    write, stored = timed(
        lambda: library.encode(positions, faces, quantization_bits=bits, compression_level=10)
    )
    read, back = timed(lambda: library.decode(stored))
    assert len(back.faces) <= len(faces)
    return Outcome(f"Draco -cl 10, {bits} bits", len(stored), write, read)


def sorted_rows(rows: np.ndarray) -> bytes:
    """The rows of an array in an order of their bits."""
    bits = np.ascontiguousarray(rows).view(np.uint16).reshape(len(rows), -1)
    return bits[np.lexsort(bits.T)].tobytes()


def timed(run: Callable[[], Any]) -> tuple[float, Any]:
    """The least seconds of some runs, and what the last one gave."""
    seconds = []
    for _ in range(RUNS):
        start = time.perf_counter()
        result = run()
        seconds.append(time.perf_counter() - start)
    return min(seconds), result


def say_one(one: Outcome, count: int) -> None:
    """Print a line of the table."""
    say(f"  {one.tool:34} {one.size / count:8.3f} {one.write:9.3f} s {one.read:9.3f} s")


def say(line: str) -> None:
    """Print a line at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
