"""Whatever else pymeshlab reads, where the extra `meshlab` is installed."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path
from typing import IO, Any

from striptools.errors import MissingExtraError
from striptools.mesh.readers.parsed import Parsed, flatten

FORMATS = (
    "3ds",
    "3mf",
    "collada",
    "ctm",
    "dae",
    "e57",
    "fbx",
    "ptx",
    "qobj",
    "tri",
    "v3d",
    "vmi",
    "wrl",
    "x3d",
    "x3dv",
)


def read_through_meshlab(file: IO[bytes], path: Path | None, file_format: str) -> Parsed:
    """Read a file of another format by pymeshlab; all its meshes with their matrices applied.

    Args:
        file: The open file, used where `path` is None.
        path: The file's place: files that it refers to lie beside it.
        file_format: Its format, without the dot.

    Raises:
        MissingExtraError: Where pymeshlab is not installed.
    """
    try:
        import pymeshlab
    except ImportError as error:
        raise MissingExtraError(
            f"files of format {file_format} are read by pymeshlab, which is not installed",
            remedy="pip install 'striptools[meshlab]', or convert the file to PLY, OBJ, STL or GLB",
        ) from error
    if path is not None:
        return _flat(pymeshlab, path)
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / f"input.{file_format}"
        with copy.open("wb") as out:
            shutil.copyfileobj(file, out)
        return _flat(pymeshlab, copy)


def _flat(pymeshlab: Any, path: Path) -> Parsed:
    meshes = pymeshlab.MeshSet()
    meshes.load_new_mesh(str(path))
    parts = []
    for mesh in meshes:
        parts.append(Parsed(mesh.transformed_vertex_matrix(), mesh.face_matrix()))
    whole = flatten(parts)
    notes = (f"{len(parts)} meshes flattened into one",) if len(parts) > 1 else ()
    return Parsed(whole.positions, whole.faces, ("read by pymeshlab, which cuts n-gons itself", *notes))
