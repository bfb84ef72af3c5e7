"""glTF 2.0 and GLB: the arrays through trimesh, their bounds checked and the scene flattened here.

trimesh gets a tree that holds nothing but the buffers, views and accessors of the triangles' positions and
indices, each checked against the bytes that are there (Khronos glTF 2.0 specification, sections 3.6 and
3.7.2). Left to itself it reads sparse and compressed accessors as zeros, drops the mesh of a node that also
has a camera, keeps the winding of mirrored instances, and names instances at random, so that their order is
not the file's. What primitives carry beside is read in gltf_attributes.py.
"""

from __future__ import annotations

import base64
import binascii
import json
import math
import re
from collections import Counter
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import IO, Any
from urllib.parse import unquote

import numpy as np

from striptools.errors import LimitError, UnreadableMeshError
from striptools.mesh.attributes import Attribute
from striptools.mesh.instances import Geometries, Instances, determinant_signs, is_identity, place
from striptools.mesh.mesh import MOST_FACES, first_face_out_of_range
from striptools.mesh.readers.gltf_attributes import (
    material_number,
    notes_on_the_rest,
    primitive_attributes,
    turned,
    with_materials,
)
from striptools.mesh.readers.parsed import EXPORT_AGAIN, Parsed, counted, file_size, flatten, strict_numbers

DEEPEST_JSON = 64
LONGEST_ARRAY = 2**31 - 1
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
INDEX_COMPONENTS = (5121, 5123, 5125)
POINTS_AND_LINES = (0, 1, 2, 3)
TRIANGLES, STRIP = 4, 5
COMPRESSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_meshopt_compression")
IDENTITY = np.eye(4)

Meshes = dict[int, list[Parsed]]
"""The primitives of each mesh that has triangles."""

Nodes = list[tuple[int, np.ndarray]]
"""The mesh of each node that has one, and where it stands, `(4, 4)` float64."""


@dataclass
class Document:
    """A glTF file taken apart.

    Args:
        tree: The JSON.
        blob: The binary chunk of a GLB file, if any.
        folder: Where the files named by it may lie; None where they cannot be looked for.
        notes: What was left out or decided, by and by.
        left: How often which attributes of primitives were left out.
        buffers: The bytes of the buffers read so far.
    """

    tree: dict[str, Any]
    blob: memoryview | None
    folder: Path | None
    notes: list[str] = field(default_factory=list)
    left: Counter[str] = field(default_factory=Counter)
    buffers: dict[int, memoryview] = field(default_factory=dict)

    def buffer(self, index: int) -> memoryview:
        """The bytes of a buffer, read once."""
        if index not in self.buffers:
            self.buffers[index] = _load_buffer(self, index)
        return self.buffers[index]

    def read_accessor(
        self, index: object, user: str, shapes: tuple[str, ...], components: tuple[int, ...]
    ) -> tuple[np.ndarray, bool]:
        """The rows of an accessor of one of some shapes, and whether it is normalised."""
        shape = self.row("accessors", index, user).get("type")
        accessor = _checked_accessor(self, index, user, shape if shape in shapes else shapes[0], components)
        dtype, view = np.dtype("<" + COMPONENTS[accessor["componentType"]]), accessor["view"]
        rows = np.ndarray(
            (accessor["count"], WIDTHS[accessor["type"]]),
            dtype,
            self.buffer(view["buffer"]),
            view["byteOffset"] + accessor["byteOffset"],
            (view["byteStride"], dtype.itemsize),
        )
        return rows, bool(accessor.get("normalized"))

    def table(self, name: str) -> list[dict[str, Any]]:
        """The array of objects of a name; empty where it is not there."""
        rows = self.tree.get(name, [])
        if not isinstance(rows, list) or not all(isinstance(row, dict) for row in rows):
            raise UnreadableMeshError(f"`{name}` is no array of objects", remedy=EXPORT_AGAIN)
        return rows

    def row(self, name: str, index: object, user: str) -> dict[str, Any]:
        """Row `index` of a table, asked for by `user`."""
        rows = self.table(name)
        number = integer(index, f"the reference of {user} to {name}", 0)
        if number >= len(rows):
            raise UnreadableMeshError(
                f"{user} refers to {name}[{number}], of which there are {len(rows)}", remedy=EXPORT_AGAIN
            )
        return rows[number]


def read_gltf(file: IO[bytes], folder: Path | None, instances: bool = False) -> Parsed:
    """Read a .gltf file, its buffers in data URIs or in files of `folder` or below.

    Meshes that several nodes have are kept as geometries where `instances` are asked for.
    """
    file_size(file)
    return _read_scene(Document(_parse_json(file.read()), None, folder), instances)


def read_glb(file: IO[bytes], folder: Path | None, instances: bool = False) -> Parsed:
    """Read a .glb file as `read_gltf` does; buffers may also lie in files of `folder` or below."""
    size = file_size(file)
    data = memoryview(file.read())
    if size < 20 or data[:4] != b"glTF":
        raise UnreadableMeshError("not a GLB file: it does not begin with glTF")
    version, length = (int.from_bytes(data[k : k + 4], "little") for k in (4, 8))
    if version != 2:
        raise UnreadableMeshError(f"GLB version {version}", remedy="only version 2 is read")
    if length > size:
        raise UnreadableMeshError(
            f"the GLB header announces {length} bytes, the file has {size}", remedy="the file is cut short"
        )
    chunks = _split_chunks(data[:length])
    if not chunks or chunks[0][0] != b"JSON":
        raise UnreadableMeshError("the GLB file does not begin with a JSON chunk", remedy=EXPORT_AGAIN)
    blob = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == b"BIN\0" else None
    return _read_scene(Document(_parse_json(bytes(chunks[0][1])), blob, folder), instances)


def integer(value: object, name: str, least: int, most: int = 2**53) -> int:
    """`value` where it is an integer in range, else an error that names it."""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if not isinstance(value, int) or isinstance(value, bool) or not least <= value <= most:
        raise UnreadableMeshError(
            f"{name} is {str(value)[:40]!r}, not an integer in range", remedy=EXPORT_AGAIN
        )
    return value


def _split_chunks(data: memoryview) -> list[tuple[bytes, memoryview]]:
    chunks, place = [], 12
    while place + 8 <= len(data):
        length = int.from_bytes(data[place : place + 4], "little")
        if length > len(data) - place - 8:
            raise UnreadableMeshError("a GLB chunk is longer than the file", remedy="the file is cut short")
        chunks.append((bytes(data[place + 4 : place + 8]), data[place + 8 : place + 8 + length]))
        place += 8 + length
    return chunks


def _parse_json(data: bytes) -> dict[str, Any]:
    # Python's own limit on nesting is an exception deep inside; measured here it is an error line.
    brackets = np.frombuffer(re.sub(rb'"(?:[^"\\]|\\.)*"', b"", data), np.uint8)
    opened = np.isin(brackets, np.frombuffer(b"[{", np.uint8)).astype(np.int32)
    closed = np.isin(brackets, np.frombuffer(b"]}", np.uint8)).astype(np.int32)
    if len(brackets) and np.cumsum(opened - closed).max() > DEEPEST_JSON:
        raise UnreadableMeshError(
            f"the JSON is nested deeper than {DEEPEST_JSON} levels", remedy=EXPORT_AGAIN
        )
    try:
        tree = json.loads(data.decode("utf-8-sig"))
    except ValueError as error:
        raise UnreadableMeshError(f"the glTF JSON is malformed: {error}", remedy=EXPORT_AGAIN) from error
    if not isinstance(tree, dict) or not isinstance(tree.get("asset"), dict):
        raise UnreadableMeshError("the JSON is no glTF: it has no `asset`")
    version = str(tree["asset"].get("version", ""))
    if not version.startswith("2."):
        raise UnreadableMeshError(f"glTF version {version[:20]!r}", remedy="only version 2 is read")
    return tree


# ---------------------------------------------------------------------------------------------- arrays


def _load_primitives(document: Document) -> Meshes:
    """The triangles of each mesh, in the order of its primitives."""
    accessors: list[dict[str, Any]] = []
    wanted: list[tuple[int, dict[str, Any]]] = []
    sources: list[dict[str, Any]] = []
    skipped = 0
    for index, mesh in enumerate(document.table("meshes")):
        primitives = mesh.get("primitives")
        if not isinstance(primitives, list) or not all(isinstance(one, dict) for one in primitives):
            raise UnreadableMeshError(f"meshes[{index}] has no array of primitives", remedy=EXPORT_AGAIN)
        for primitive in primitives:
            if primitive.get("mode", TRIANGLES) in POINTS_AND_LINES:
                skipped += 1
            else:
                wanted.append((index, _checked_primitive(document, primitive, f"meshes[{index}]", accessors)))
                sources.append(primitive)
    if skipped:
        document.notes.append(f"{counted(skipped, 'primitive', 'primitives')} of points or lines left out")
    parts: Meshes = {}
    for mesh, source, (positions, faces) in zip(
        [mesh for mesh, _ in wanted], sources, _through_trimesh(document, accessors, wanted), strict=True
    ):
        attributes = primitive_attributes(source, len(positions), document.read_accessor, document.left)
        if document.tree.get("materials"):
            numbers = np.full((len(faces), 1), material_number(source, document.tree), np.int32)
            attributes = (*attributes, Attribute("group", "face", numbers))
        parts.setdefault(mesh, []).append(Parsed(positions, faces, attributes=attributes))
    return parts


def _checked_primitive(
    document: Document, primitive: dict[str, Any], where: str, accessors: list[dict[str, Any]]
) -> dict[str, Any]:
    """The primitive reduced to positions, indices and mode, its accessors checked and put on the list."""
    mode = primitive.get("mode", TRIANGLES)
    extensions = primitive.get("extensions", {})
    compressed = [one for one in COMPRESSIONS if isinstance(extensions, dict) and one in extensions]
    if compressed:
        raise UnreadableMeshError(
            f"{where} is compressed by {compressed[0]}", remedy="export it uncompressed"
        )
    if mode not in (TRIANGLES, STRIP):
        raise UnreadableMeshError(
            f"{where} has primitives of mode {str(mode)[:20]}", remedy="export triangles"
        )
    attributes = primitive.get("attributes")
    if not isinstance(attributes, dict) or "POSITION" not in attributes:
        raise UnreadableMeshError(f"{where} has a primitive without positions", remedy=EXPORT_AGAIN)
    position = _checked_accessor(
        document, attributes["POSITION"], f"POSITION of {where}", "VEC3", tuple(COMPONENTS)
    )
    corners = position["count"]
    reduced: dict[str, Any] = {"attributes": {"POSITION": len(accessors)}, "mode": mode}
    accessors.append(position)
    if "indices" in primitive:
        indices = _checked_accessor(
            document, primitive["indices"], f"indices of {where}", "SCALAR", INDEX_COMPONENTS
        )
        corners = indices["count"]
        reduced["indices"] = len(accessors)
        accessors.append(indices)
    if corners < 3 or (mode == TRIANGLES and corners % 3):
        raise UnreadableMeshError(
            f"{where} has {corners} corners, which make no triangles", remedy=EXPORT_AGAIN
        )
    return reduced


def _checked_accessor(
    document: Document, index: object, user: str, shape: str, components: tuple[int, ...]
) -> dict[str, Any]:
    """The accessor with all its numbers checked against the bytes it stands on."""
    accessor = document.row("accessors", index, user)
    if "sparse" in accessor or "bufferView" not in accessor:
        raise UnreadableMeshError(f"{user} are stored sparsely or not at all", remedy="export them in full")
    component = integer(accessor.get("componentType"), f"the component type of {user}", 0)
    if component not in components or accessor.get("type") != shape:
        raise UnreadableMeshError(f"{user} have the wrong type", remedy=EXPORT_AGAIN)
    count = integer(accessor.get("count"), f"the count of {user}", 1, LONGEST_ARRAY)
    offset = integer(accessor.get("byteOffset", 0), f"the offset of {user}", 0)
    view = document.row("bufferViews", accessor["bufferView"], user)
    if any(one in view.get("extensions", {}) for one in COMPRESSIONS):
        raise UnreadableMeshError(f"{user} are compressed", remedy="export them uncompressed")
    length = integer(view.get("byteLength"), f"the length of the view of {user}", 0)
    row = int(COMPONENTS[component][1]) * WIDTHS[shape]
    stride = integer(view.get("byteStride", row), f"the stride of {user}", row)
    if offset + (count - 1) * stride + row > length:
        raise UnreadableMeshError(f"{user} reach past the end of their view", remedy=EXPORT_AGAIN)
    buffer = document.row("buffers", view.get("buffer"), user)
    start = integer(view.get("byteOffset", 0), f"the offset of the view of {user}", 0)
    if start + length > integer(buffer.get("byteLength"), f"the length of the buffer of {user}", 0):
        raise UnreadableMeshError(
            f"the view of {user} reaches past the end of its buffer", remedy=EXPORT_AGAIN
        )
    place = {"buffer": int(view["buffer"]), "byteOffset": start, "byteLength": length, "byteStride": stride}
    return {**accessor, "count": count, "byteOffset": offset, "componentType": component, "view": place}


def _through_trimesh(
    document: Document, accessors: list[dict[str, Any]], wanted: list[tuple[int, dict[str, Any]]]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """The positions and faces of all wanted primitives, the indices checked."""
    from trimesh.exchange.gltf import load_gltf

    if not wanted:
        return []
    used = {one["view"]["buffer"] for one in accessors}
    files = {str(index): document.buffer(index) if index in used else b"" for index in range(max(used) + 1)}
    tree = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": name} for name in files],
        "bufferViews": [one["view"] for one in accessors],
        "accessors": [
            {key: one[key] for key in ("byteOffset", "componentType", "count", "type")} | {"bufferView": k}
            for k, one in enumerate(accessors)
        ],
        "meshes": [{"name": str(k), "primitives": [primitive]} for k, (_, primitive) in enumerate(wanted)],
    }
    with strict_numbers():
        loaded = load_gltf(BytesIO(json.dumps(tree).encode()), resolver=files, skip_materials=True)[
            "geometry"
        ]
    parts: list[tuple[np.ndarray, np.ndarray]] = []
    for k, (mesh, primitive) in enumerate(wanted):
        positions = _scaled(loaded[str(k)]["vertices"], accessors[primitive["attributes"]["POSITION"]])
        faces = loaded[str(k)]["faces"]
        bad = first_face_out_of_range(faces, len(positions))
        if bad is not None:
            raise UnreadableMeshError(
                f"face {bad} of meshes[{mesh}] names vertices {faces[bad].tolist()}, of {len(positions)}",
                remedy=EXPORT_AGAIN,
            )
        parts.append((positions, faces))
    return parts


def _scaled(positions: np.ndarray, accessor: dict[str, Any]) -> np.ndarray:
    """Integer positions as numbers: of [-1, 1] where normalised (KHR_mesh_quantization)."""
    if positions.dtype.kind == "f":
        return positions
    if not accessor.get("normalized"):
        return positions.astype(np.float64)
    return np.maximum(positions / float(np.iinfo(positions.dtype).max), -1.0)


def _load_buffer(document: Document, index: int) -> memoryview:
    """The bytes of a buffer, at least as many as it announces."""
    buffer = document.row("buffers", index, "a view")
    name = f"buffers[{index}]"
    length = integer(buffer.get("byteLength"), f"the length of {name}", 0)
    if "uri" not in buffer:
        if index != 0 or document.blob is None:
            raise UnreadableMeshError(f"{name} has no data", remedy=EXPORT_AGAIN)
        data = document.blob
    else:
        data = memoryview(_load_uri(document, buffer["uri"], name))
    if len(data) < length:
        raise UnreadableMeshError(
            f"{name} announces {length} bytes and has {len(data)}", remedy="the file is cut short"
        )
    return data[:length]


def _load_uri(document: Document, uri: object, name: str) -> bytes:
    if not isinstance(uri, str):
        raise UnreadableMeshError(f"the uri of {name} is no text", remedy=EXPORT_AGAIN)
    if uri.startswith("data:"):
        head, _, body = uri.partition(",")
        try:
            return (
                base64.b64decode(body, validate=True)
                if head.endswith(";base64")
                else unquote(body).encode("latin-1")
            )
        except (binascii.Error, UnicodeEncodeError) as error:
            raise UnreadableMeshError(f"the data uri of {name} is malformed", remedy=EXPORT_AGAIN) from error
    shown = f"{uri[:60]!r}, the file of {name},"
    if document.folder is None:
        raise UnreadableMeshError(
            f"{shown} cannot be looked for", remedy="give the model by its path, or as GLB"
        )
    folder = document.folder.resolve()
    try:
        path = (folder / unquote(uri)).resolve()
        if re.match(r"[A-Za-z][A-Za-z0-9+.-]+:", uri) or not path.is_relative_to(folder):
            raise UnreadableMeshError(
                f"{shown} lies outside the model's folder", remedy="put it beside the model"
            )
        return path.read_bytes()
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or "not a file name"
        raise UnreadableMeshError(
            f"{shown} cannot be read: {reason}", remedy="put it beside the model"
        ) from error


# ---------------------------------------------------------------------------------------------- scene


def _read_scene(document: Document, keep: bool) -> Parsed:
    """The meshes of the default scene in the order of its nodes, as geometries where some are to be kept."""
    meshes = _load_primitives(document)
    nodes = _find_instances(document)
    placed = [(mesh, matrix) for mesh, matrix in nodes if mesh in meshes]
    repeated = _repeated(placed) if keep else set()
    total = sum(len(part.faces) for mesh, _ in placed for part in meshes[mesh])
    if total > MOST_FACES and not repeated:
        raise LimitError(f"{total} triangles with all instances", remedy=f"at most {MOST_FACES} are handled")
    whole = _kept_apart(meshes, placed, repeated) if repeated else _flattened(meshes, placed)
    _note_instances(document, nodes, meshes, repeated)
    document.notes += [*whole.notes, *notes_on_the_rest(document.left, document.tree)]
    return with_materials(replace(whole, notes=tuple(document.notes)), document.tree)


def _flattened(meshes: Meshes, nodes: Nodes) -> Parsed:
    """One mesh of the meshes of all nodes."""
    return flatten([_placed(part, matrix) for mesh, matrix in nodes for part in meshes[mesh]])


def _repeated(nodes: Nodes) -> set[int]:
    """The meshes that stand in several places by matrices that can be kept.

    A matrix that flattens its mesh cannot, for what is flat may still be seen: its mesh is moved once.
    """
    times = Counter(mesh for mesh, matrix in nodes if _is_regular(matrix))
    return {mesh for mesh, count in times.items() if count > 1}


def _kept_apart(meshes: Meshes, nodes: Nodes, repeated: set[int]) -> Parsed:
    """Geometries and instances: repeated meshes as they are, and what stands between them moved at once."""
    order: list[tuple[int, list[Parsed], np.ndarray]] = []
    for mesh, matrix in nodes:
        if mesh in repeated and _is_regular(matrix):
            order.append((mesh, meshes[mesh], matrix))
            continue
        if not order or order[-1][0] in repeated:
            order.append((-1 - len(order), [], IDENTITY))
        order[-1][1].extend(_placed(part, matrix) for part in meshes[mesh])
    geometries = {key: parts for key, parts, _ in order}
    number = {key: k for k, key in enumerate(geometries)}
    starts = [
        np.cumsum([0, *(sum(len(rows(part)) for part in parts) for parts in geometries.values())])
        for rows in (lambda part: part.faces, lambda part: part.positions)
    ]
    whole = flatten([part for parts in geometries.values() for part in parts])
    return replace(
        whole,
        geometries=Geometries(*(one.astype(np.int32) for one in starts)),
        instances=Instances(
            np.array([number[key] for key, _, _ in order], np.int32),
            np.array([matrix[:3] for _, _, matrix in order]),
        ),
    )


def _note_instances(document: Document, nodes: Nodes, meshes: Meshes, repeated: set[int]) -> None:
    """Say what became of meshes, instances and mirrors."""
    placed = [mesh for mesh, _ in nodes if mesh in meshes]
    what = f"{counted(len(set(placed)), 'mesh', 'meshes')} in {counted(len(nodes), 'instance', 'instances')}"
    if repeated:
        kept = counted(len(repeated), "repeated mesh", "repeated meshes")
        document.notes.insert(0, f"{what}, {kept} stored once, other transforms applied")
    elif sum(len(meshes[mesh]) for mesh in placed) > 1:
        document.notes.insert(0, f"{what} flattened into one, transforms applied")
    elif any(not is_identity(matrix) for _, matrix in nodes):
        document.notes.append("the transform of the one instance applied")
    unplaced = len(meshes) - len(set(placed))
    if unplaced:
        document.notes.append(f"{counted(unplaced, 'mesh', 'meshes')} outside the scene left out")
    mirrored = sum(_mirrors(matrix) for mesh, matrix in nodes if mesh not in repeated)
    if mirrored:
        document.notes.append(
            f"winding turned in {counted(mirrored, 'mirrored instance', 'mirrored instances')}"
        )


def _is_regular(matrix: np.ndarray) -> bool:
    return bool(np.isfinite(matrix).all()) and determinant_signs(matrix[None])[0] != 0


def _mirrors(matrix: np.ndarray) -> bool:
    return bool(np.isfinite(matrix).all()) and determinant_signs(matrix[None])[0] < 0


def _placed(part: Parsed, matrix: np.ndarray) -> Parsed:
    """The part moved by a matrix, in float64; untouched where the matrix is the identity.

    A mirror turns the winding (glTF 2.0, section 3.7.4): the second and third corner change places.
    """
    if is_identity(matrix):
        return part
    faces = part.faces[:, [0, 2, 1]] if _mirrors(matrix) else part.faces
    return Parsed(place(part.positions, matrix), faces, attributes=turned(part.attributes, matrix))


def _find_instances(document: Document) -> Nodes:
    """Mesh and matrix of each node of the scene that has a mesh, parents first, children in order."""
    nodes, meshes = document.table("nodes"), document.table("meshes")
    roots = _find_roots(document, nodes)
    if not nodes and roots is None:
        document.notes.append("no scene: every mesh taken once")
        return [(index, IDENTITY) for index in range(len(meshes))]
    open_nodes = [(index, IDENTITY) for index in reversed(roots or [])]
    seen: set[int] = set()
    found = []
    ignored = {"EXT_mesh_gpu_instancing": 0, "skin": 0}
    while open_nodes:
        index, above = open_nodes.pop()
        if index in seen:
            raise UnreadableMeshError(
                f"the nodes are no tree: node {index} is met twice", remedy=EXPORT_AGAIN
            )
        seen.add(index)
        node = document.row("nodes", index, "a node or scene")
        matrix = above @ _local_matrix(node, index)
        if "mesh" in node:
            document.row("meshes", node["mesh"], f"nodes[{index}]")
            found.append((int(node["mesh"]), matrix))
            ignored["EXT_mesh_gpu_instancing"] += "EXT_mesh_gpu_instancing" in node.get("extensions", {})
            ignored["skin"] += "skin" in node
        children = _indices(node.get("children", []), f"the children of node {index}")
        open_nodes.extend((child, matrix) for child in reversed(children))
    for what, times in ignored.items():
        if times:
            document.notes.append(f"{what} of {counted(times, 'node', 'nodes')} not applied")
    return found


def _find_roots(document: Document, nodes: list[dict[str, Any]]) -> list[int] | None:
    """The roots of the default scene; without scenes all nodes that are no child; None without nodes."""
    scenes = document.table("scenes")
    if scenes:
        scene = document.row("scenes", document.tree.get("scene", 0), "the file")
        return _indices(scene.get("nodes", []), "the nodes of the scene")
    if not nodes:
        return None
    children = {
        child for node in nodes for child in _indices(node.get("children", []), "the children of a node")
    }
    document.notes.append("no scene: all nodes taken")
    return [index for index in range(len(nodes)) if index not in children]


def _indices(values: object, name: str) -> list[int]:
    if not isinstance(values, list):
        raise UnreadableMeshError(f"{name} are no array", remedy=EXPORT_AGAIN)
    return [integer(value, f"an entry of {name}", 0) for value in values]


def _local_matrix(node: dict[str, Any], index: int) -> np.ndarray:
    """The node's own transform: its matrix, or translation times rotation times scale (glTF 2.0, 3.5.3)."""
    if "matrix" in node:
        return _vector(node["matrix"], 16, f"the matrix of node {index}").reshape(4, 4).T
    if not {"translation", "rotation", "scale"} & node.keys():
        return IDENTITY
    matrix = np.eye(4)
    x, y, z, w = _vector(node.get("rotation", [0, 0, 0, 1]), 4, f"the rotation of node {index}")
    rotation = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix[:3, :3] = rotation * _vector(node.get("scale", [1, 1, 1]), 3, f"the scale of node {index}")
    matrix[:3, 3] = _vector(node.get("translation", [0, 0, 0]), 3, f"the translation of node {index}")
    return matrix


def _vector(values: object, length: int, name: str) -> np.ndarray:
    numbers = values if isinstance(values, list) else []
    if len(numbers) != length or not all(
        isinstance(one, int | float) and math.isfinite(one) for one in numbers
    ):
        raise UnreadableMeshError(f"{name} is not {length} finite numbers", remedy=EXPORT_AGAIN)
    return np.array(numbers, np.float64)
