"""Meshes for rasterisers: faces in the order of classic strips, and glTF of real triangle strips.

PLY, OBJ and STL hold plain triangles, in strip order: whoever draws them so finds the last vertices in the
cache. GLB holds ONE primitive of mode TRIANGLE_STRIP, its strips stitched by repeated vertices: glTF 2.0
forbids the restart index, and a primitive for each strip would cost about 130 bytes of JSON each where a
stitch costs two indices, 4 or 8 bytes. Strips are sought at the price that their format asks for them.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from striptools.errors import UsageError
from striptools.mesh.adjacency import build_adjacency
from striptools.mesh.atomic import write_atomically, write_stream
from striptools.mesh.io import save_mesh
from striptools.mesh.mesh import Mesh
from striptools.mesh.strip_glb import encode_strip_glb
from striptools.strips.alternating import AlternatingOptions, Effort, alternating_strips
from striptools.strips.topology import (
    RESTART,
    ClassicCount,
    Strips,
    classic_strips,
    count_classic,
    encode_strips,
)

STRIP_FORMATS = ("glb", "ply", "obj", "stl")

_RESTART_PRICE, _STITCH_PRICE = 3, 4


@dataclass(frozen=True, eq=False)
class StripExport:
    """A mesh in classic strips, ready to be written.

    Attributes:
        mesh: The faces in the order of the strips, each from its source's first corner.
        strips: The strips.
        count: What they take as an index list: stitched for GLB, with restarts for other formats.
        file_format: One of STRIP_FORMATS.
    """

    mesh: Mesh
    strips: Strips
    count: ClassicCount
    file_format: str

    @property
    def indices_per_triangle(self) -> float:
        """Indices of the strips, all told, over triangles; three without strips."""
        return self.count.indices / self.mesh.triangle_count

    def save(self, target: str | Path | IO[bytes]) -> int:
        """Write the file, whole or not at all, and count its bytes.

        Raises:
            WriteError: Where the file system refuses.
        """
        if self.file_format != "glb":
            return save_mesh(self.mesh, target, file_format=self.file_format)
        data = encode_strip_glb(self.mesh.positions.astype(np.float32), classic_strips(self.strips, None))
        is_path = isinstance(target, str | Path)
        return write_atomically(target, data) if is_path else write_stream(target, data)


def export_strips(mesh: Mesh, file_format: str, effort: Effort = "normal", threads: int = 1) -> StripExport:
    """Find classic strips for a mesh.

    Args:
        mesh: Clean: finite positions, no face with a repeated vertex, equal vertices welded.
        file_format: One of STRIP_FORMATS.
        effort: See AlternatingOptions.
        threads: How many threads share the work; the strips are the same for any number.

    Raises:
        UsageError: An unknown format, or a face with a repeated vertex.
    """
    if file_format not in STRIP_FORMATS:
        raise UsageError(
            f"{file_format or 'no format'} cannot hold strips", remedy=f"one of {', '.join(STRIP_FORMATS)}"
        )
    stitched = file_format == "glb"
    adjacency = build_adjacency(mesh.faces, mesh.vertex_count)
    options = AlternatingOptions(effort, _STITCH_PRICE if stitched else _RESTART_PRICE)
    sequences = alternating_strips(adjacency, mesh.faces, options, threads)
    strips = encode_strips(mesh.faces, sequences, flips=False)
    count = count_classic(strips, None if stitched else RESTART)
    return StripExport(Mesh(mesh.positions, mesh.faces[sequences.faces]), strips, count, file_format)
