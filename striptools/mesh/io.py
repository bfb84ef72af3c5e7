"""Read and write mesh files.

Reading goes through trimesh where trimesh can be kept from working over what it reads, one module a format in
`striptools.mesh.readers`; each says what it has to keep from it. What holds after: every face and vertex of
the file is there, in the file's order and winding, positions bit for bit; faces that are no triangles are cut
or left out, and a note says how many. Every header is checked against the bytes that are there before
anything is allocated.

Writing plain geometry goes through trimesh too, but for OBJ, of which it writes 8 decimal places where
float32 needs 9 digits. What carries more is written by `striptools.mesh.writers`.
"""

from __future__ import annotations

from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import IO

import numpy as np

from striptools.errors import StriptoolsError, UnreadableMeshError, UsageError
from striptools.mesh.atomic import write_atomically, write_stream
from striptools.mesh.attributes import Attribute
from striptools.mesh.mesh import MOST_FACES, Mesh, first_face_out_of_range
from striptools.mesh.readers.meshlab import FORMATS as MESHLAB_FORMATS
from striptools.mesh.readers.parsed import EXPORT_AGAIN, Parsed, counted

READ_FORMATS = ("ply", "obj", "stl", "off", "glb", "gltf")
"""The formats read with what is always installed; `MESHLAB_FORMATS` need the extra `meshlab`."""

WRITE_FORMATS = ("ply", "obj", "stl", "glb")

MAGIC = {b"ply": "ply", b"glTF": "glb", b"OFF": "off", b"COFF": "off", b"solid": "stl", b"{": "gltf"}


def load_mesh(
    source: str | Path | IO[bytes], *, file_format: str | None = None, instances: bool = False
) -> Mesh:
    """Read a mesh file.

    Scenes of several meshes or instances are flattened into one mesh with their transforms applied, and a
    note says so, unless `instances` are to be kept. Positions are float32 where the file holds float32 (or
    text that float32 holds exactly), else float64.

    Args:
        source: A path, or an open binary file such as `sys.stdin.buffer`.
        file_format: One of `READ_FORMATS` (or of `MESHLAB_FORMATS`) where the name or the first bytes do not
            tell.
        instances: Keep meshes that a glTF scene has in several places as geometries with instances;
            `Mesh.flattened` gives what is given without.

    Raises:
        UnreadableMeshError: Where it cannot be read, is malformed, or holds no triangle.
        MissingExtraError: Where only pymeshlab could read it, which is not installed.
        LimitError: Where it has more triangles than int32 half-edges can number.
    """
    path = Path(source) if isinstance(source, str | Path) else None
    where = str(path) if path else str(getattr(source, "name", "the input stream"))
    try:
        if path is None:
            return _load_stream(source, where, file_format, instances)  # pyright: ignore[reportArgumentType]
        with path.open("rb") as file:
            return _load_file(file, path, file_format, instances)
    except StriptoolsError as error:
        raise type(error)(error.what, where=error.where or where, remedy=error.remedy) from error
    except MemoryError as error:
        raise UnreadableMeshError("needs more memory than there is", where=where) from error
    except OSError as error:
        raise UnreadableMeshError(
            f"cannot be read: {error.strerror or error}",
            where=where,
            remedy="check the path and its permissions",
        ) from error
    except Exception as error:
        # A reader's slip or trimesh's, at a file that nobody thought of: an error line all the same.
        reason = f"{type(error).__name__} {error}"[:200]
        raise UnreadableMeshError(f"malformed: {reason}", where=where, remedy=EXPORT_AGAIN) from error


def save_mesh(mesh: Mesh, target: str | Path | IO[bytes], *, file_format: str | None = None) -> int:
    """Write a mesh file, whole or not at all: PLY (binary, little endian), OBJ, STL (binary) or GLB.

    Positions are written as float32, bit for bit where they are float32; PLY and OBJ hold float64 too where
    they are that. STL has no shared vertices. Attributes are written where the format can hold them, vertices
    split where it must be: `unkept` says what it cannot. GLB keeps instances, other formats are written
    flattened. An OBJ file with materials gets a file of its name and .mtl beside it, where `target` is a
    path.

    Args:
        mesh: What to write.
        target: A path, replaced if it exists, or an open binary stream.
        file_format: One of `WRITE_FORMATS`; by default the path's suffix.

    Returns:
        How many bytes were written.

    Raises:
        UsageError: For an unknown format.
        WriteError: Where the file system refuses.
    """
    is_path = isinstance(target, str | Path)
    name = (file_format or (Path(target).suffix if is_path else "")).lower().removeprefix(".")
    if name not in WRITE_FORMATS:
        raise UsageError(
            f"no mesh format to write: {name or 'none given'}", remedy=f"one of {', '.join(WRITE_FORMATS)}"
        )
    library = _write_library(mesh, Path(target)) if is_path and name == "obj" else ""  # pyright: ignore[reportArgumentType]
    data = _encode(mesh if name == "glb" else mesh.flattened(), name, library)
    return write_atomically(target, data) if is_path else write_stream(target, data)


def unkept(mesh: Mesh, file_format: str) -> tuple[str, ...]:
    """What `save_mesh` leaves out of a file of a format, in words for people; empty where it is nothing."""
    words = [one.plural for one in mesh.attributes if not _is_kept(one, file_format)]
    if mesh.instances is not None and file_format != "glb":
        words.insert(0, "instances, each written in full")
    if file_format == "glb" and any(one.group for one in mesh.materials):
        words.append("names of groups")
    if file_format in ("stl", "glb") and (mesh.positions.astype(np.float32) != mesh.positions).any():
        words.append("what float32 cannot hold of the positions")
    return tuple(words)


def _is_kept(one: Attribute, file_format: str) -> bool:
    if file_format == "obj":
        return one.name != "color" or (one.domain == "vertex" and one.values.shape[1] == 3)
    return file_format == "glb" or (file_format == "ply" and one.name != "group")


def _write_library(mesh: Mesh, target: Path) -> str:
    """Write the material file of an OBJ file, where it has materials; its name."""
    from striptools.mesh.writers.obj import encode_library

    if mesh.attribute("group") is None or not any(one.name for one in mesh.materials):
        return ""
    beside = target.with_suffix(".mtl")
    write_atomically(beside, encode_library(mesh.materials))
    return beside.name


def _encode(mesh: Mesh, name: str, library: str) -> bytes:
    from striptools.mesh.writers.glb import encode_glb
    from striptools.mesh.writers.obj import encode_obj
    from striptools.mesh.writers.ply import encode_ply

    if name == "obj":
        return encode_obj(mesh, library)
    if name == "ply" and (mesh.attributes or mesh.positions.dtype == np.float64):
        return encode_ply(mesh)
    if name == "glb" and (mesh.attributes or mesh.instances is not None):
        return encode_glb(mesh)
    return _encode_through_trimesh(mesh, name)


def _load_stream(stream: IO[bytes], where: str, file_format: str | None, instances: bool) -> Mesh:
    data = stream.read()
    name = _choose_format(data[:512], "", file_format)
    return _finish(_read(BytesIO(data), Path(where), None, name, instances))


def _load_file(file: IO[bytes], path: Path, file_format: str | None, instances: bool) -> Mesh:
    start = file.read(512)
    if not file.seekable():
        return _load_stream(BytesIO(start + file.read()), str(path), file_format, instances)
    file.seek(0)
    name = _choose_format(start, path.suffix, file_format)
    return _finish(_read(file, path, path.parent, name, instances))


def _choose_format(start: bytes, suffix: str, asked: str | None) -> str:
    """The format asked for, or that of the suffix, or that which the first bytes show."""
    if not start.strip():
        raise UnreadableMeshError("the file is empty")
    known = READ_FORMATS + MESHLAB_FORMATS
    name = (asked or suffix).lower().removeprefix(".")
    if name in known:
        return name
    shown = next((kind for magic, kind in MAGIC.items() if start.lstrip().startswith(magic)), None)
    if shown is None or asked:
        raise UnreadableMeshError(
            f"unknown mesh format {name!r}" if name else "neither name nor content shows a mesh format",
            remedy=f"name one of {', '.join(READ_FORMATS)}, or convert the file to one of these",
        )
    return shown


def _read(file: IO[bytes], path: Path, folder: Path | None, name: str, instances: bool) -> Parsed:
    from striptools.mesh.readers import gltf, meshlab, obj, off, ply, stl

    readers: dict[str, Callable[[], Parsed]] = {
        "ply": lambda: ply.read_ply(file),
        "obj": lambda: obj.read_obj(file, folder),
        "stl": lambda: stl.read_stl(file),
        "off": lambda: off.read_off(file),
        "glb": lambda: gltf.read_glb(file, folder, instances),
        "gltf": lambda: gltf.read_gltf(file, folder, instances),
    }
    if name in readers:
        return readers[name]()
    return meshlab.read_through_meshlab(file, path if folder else None, name)


def _finish(parsed: Parsed) -> Mesh:
    """The mesh, its indices checked."""
    if len(parsed.faces) == 0:
        found = counted(len(parsed.positions), "vertex", "vertices")
        left_out = f"; {'; '.join(parsed.notes)}" if parsed.notes else ""
        raise UnreadableMeshError(
            f"no triangle in it ({found}{left_out})", remedy="a triangle mesh is wanted"
        )
    bad = first_face_out_of_range(parsed.faces, len(parsed.positions))
    if bad is not None:
        raise UnreadableMeshError(
            f"face {bad} names vertices {parsed.faces[bad].tolist()}, but there are {len(parsed.positions)}",
            remedy=EXPORT_AGAIN,
        )
    if len(parsed.faces) > MOST_FACES:
        raise UnreadableMeshError(
            f"{len(parsed.faces)} triangles", remedy=f"at most {MOST_FACES} are handled"
        )
    return Mesh(
        _native(parsed.positions),
        parsed.faces.astype(np.int32),
        parsed.notes,
        parsed.attributes,
        parsed.materials,
        parsed.unit,
        parsed.geometries,
        parsed.instances,
    )


def _native(positions: np.ndarray) -> np.ndarray:
    """Positions in the machine's byte order, as float32 or float64."""
    if positions.dtype.kind == "f" and positions.dtype.itemsize <= 4:
        return np.ascontiguousarray(positions, np.float32)
    return np.ascontiguousarray(positions, np.float64)


def _encode_through_trimesh(mesh: Mesh, name: str) -> bytes:
    import trimesh

    with np.errstate(all="ignore"):
        positions = mesh.positions.astype(np.float32)
        data = trimesh.Trimesh(positions, mesh.faces, process=False).export(file_type=name)
    assert isinstance(data, bytes)
    return data
