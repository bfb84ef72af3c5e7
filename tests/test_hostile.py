"""Whatever a file holds, loading it ends in a mesh or in one error line, soon and in little memory."""

import json
import subprocess
import sys
from io import BytesIO

import numpy as np
import pytest
from conftest import meshes_folder
from hypothesis import given
from hypothesis import strategies as st

from striptools.errors import EXIT_UNREADABLE, StriptoolsError, UnreadableMeshError
from striptools.mesh.io import READ_FORMATS, WRITE_FORMATS, load_mesh, save_mesh
from striptools.mesh.mesh import Mesh

MOST_SECONDS = 10
MOST_BYTES = 10**9
TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)

# Loads every file named on standard input and prints a line of JSON for each; what else it prints is a fault.
CHILD = """
import json, resource, sys, time, warnings
from pathlib import Path
from striptools.errors import StriptoolsError
from striptools.mesh.io import load_mesh
resource.setrlimit(resource.RLIMIT_CPU, (600, 600))
for path in sys.stdin.read().splitlines():
    start = time.perf_counter()
    try:
        mesh = load_mesh(path)
        verdict = {"faces": mesh.triangle_count, "notes": mesh.notes}
    except StriptoolsError as error:
        verdict = {"error": str(error), "exit_code": error.exit_code}
    verdict["seconds"] = time.perf_counter() - start
    # Not ru_maxrss: that starts with what the process which started this one held.
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    verdict["peak"] = 1024 * int(status["VmHWM"].split()[0])
    print(json.dumps(verdict), flush=True)
"""

HEADER = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
FACES = "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
POINTS = "0 0 0\n1 0 0\n0 1 0\n"
BINARY = HEADER.replace("ascii", "binary_little_endian")
CORNERS = TRIANGLE.astype("<f4").tobytes()


def _stl(count: int, data: bytes) -> bytes:
    return bytes(80) + count.to_bytes(4, "little") + data


def _glb(tree: object, blob: bytes = b"", **lengths: int) -> bytes:
    text = tree if isinstance(tree, bytes) else json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    chunks = lengths.get("json", len(text)).to_bytes(4, "little") + b"JSON" + text
    chunks += lengths.get("bin", len(blob)).to_bytes(4, "little") + b"BIN\0" + blob
    whole = lengths.get("file", 12 + len(chunks))
    return b"glTF" + (2).to_bytes(4, "little") + whole.to_bytes(4, "little") + chunks


def _tree(**changes: object) -> dict[str, object]:
    tree: dict[str, object] = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36}],
    }
    return tree | changes


def _accessor(**changes: object) -> list[object]:
    return [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"} | changes]


def _primitive(**changes: object) -> list[object]:
    return [{"primitives": [{"attributes": {"POSITION": 0}} | changes]}]


REFUSED = {
    "nothing": ("ply", b"", "empty"),
    "blanks": ("obj", b" \n\n ", "empty"),
    "ply of another kind": ("ply", b"plyx\n", "not a PLY"),
    "ply without end of header": ("ply", HEADER.encode(), "never ends"),
    "ply of no format": ("ply", b"ply\nelement face 0\nend_header\n", "no known format"),
    "ply with a property first": (
        "ply",
        b"ply\nformat ascii 1.0\nproperty int x\nend_header\n",
        "before any element",
    ),
    "ply of an odd type": (
        "ply",
        (HEADER + "property half w\n" + FACES.format(1)).encode(),
        "makes no sense",
    ),
    "ply counting in floats": (
        "ply",
        (HEADER + FACES.format(1).replace("uchar", "float")).encode(),
        "floating point",
    ),
    "ply of minus one vertex": (
        "ply",
        HEADER.replace("vertex 3", "vertex -1").encode() + b"end_header\n",
        "no sense",
    ),
    "ply of 4 billion faces": (
        "ply",
        (HEADER + FACES.format(2**32 - 1) + POINTS).encode(),
        "announces 4294967295",
    ),
    "ply of many empty rows": (
        "ply",
        b"ply\nformat ascii 1.0\nelement a 999999999\nend_header\n",
        "no properties",
    ),
    "ply cut short": (
        "ply",
        (HEADER + FACES.format(2) + POINTS + "3 0 1 2\n3 0").encode(),
        "row 1 of `face`",
    ),
    "ply with a long list": (
        "ply",
        (HEADER + FACES.format(1) + POINTS + "99 0 1 2\n").encode(),
        "row 0 of `face`",
    ),
    "ply with a negative list": (
        "ply",
        (HEADER + FACES.format(1) + POINTS + "-3 0 1 2\n").encode(),
        "row 0 of `face`",
    ),
    "ply with half an index": (
        "ply",
        (HEADER + FACES.format(1) + POINTS + "3 0 1 1.5\n").encode(),
        "no number that",
    ),
    "ply with an index of nan": (
        "ply",
        (HEADER + FACES.format(1) + POINTS + "3 0 1 nan\n").encode(),
        "no number that",
    ),
    "ply with words": (
        "ply",
        (HEADER + FACES.format(1) + POINTS + "3 0 one 2\n").encode(),
        "text where a number",
    ),
    "ply with a far index": (
        "ply",
        (HEADER + FACES.format(1) + POINTS + "3 0 1 3\n").encode(),
        r"face 0 names .*3",
    ),
    "ply without z": (
        "ply",
        (HEADER.replace("float z", "float w") + FACES.format(1) + POINTS + "3 0 1 2\n").encode(),
        "no plain x",
    ),
    "ply of points": ("ply", (HEADER + "end_header\n" + POINTS).encode(), "no triangle"),
    "binary ply cut short": (
        "ply",
        (BINARY + FACES.format(2)).encode() + CORNERS + b"\3" + bytes(12),
        "row 1 of",
    ),
    "binary ply, vertices cut": ("ply", (BINARY + FACES.format(1)).encode() + CORNERS[:20], "only 20 bytes"),
    "binary ply, long list": (
        "ply",
        (BINARY + FACES.format(1)).encode() + CORNERS + b"\xff" + bytes(12),
        "row 0 of",
    ),
    "obj with a far index": (
        "obj",
        b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n",
        r"face 0 names vertices \[0, 1, 3\]",
    ),
    "obj with index 0": ("obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n", "index 0"),
    "obj counting too far back": ("obj", b"v 0 0 0\nv 1 0 0\nf -1 -2 -3\nv 0 0 0\n", "face 0 names"),
    "obj with an index of 70 bits": ("obj", b"v 0 0 0\nf 1 1 999999999999999999999\n", "face 0 names"),
    "obj with a short vertex": ("obj", b"v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "vertex 2 has fewer"),
    "obj with a word": ("obj", b"v 0 0 0\nv 1 zero 0\nv 0 1 0\nf 1 2 3\n", "text where a number"),
    "obj with a face of words": ("obj", b"v 0 0 0\nf a b c\n", "text where a number"),
    "obj with a hole in a face": ("obj", b"v 0 0 0\nf 1 /1 1\n", "without a vertex index"),
    "obj with a sign astray": (
        "obj",
        b"v 0 0 0\nv 3.1-e2 0 0\nf 1 2 1\n",
        "vertex 2 has a number with a sign",
    ),
    "obj with NUL bytes": ("obj", b"v 0 0 0\0\n", "NUL bytes"),
    "obj of lines": ("obj", b"v 0 0 0\nv 1 0 0\nl 1 2\n", "no triangle in it .2 vertices; 1 point, line"),
    "stl of 4 billion": ("stl", _stl(2**32 - 1, bytes(50)), "do not hold the 4294967295"),
    "stl cut short": ("stl", _stl(2, bytes(99)), "do not hold the 2"),
    "stl of 79 bytes": ("stl", bytes(79), "too few"),
    "stl of no facet": ("stl", _stl(0, b""), "no triangle"),
    "stl text without end": ("stl", b"solid a\nfacet\n", "without an end"),
    "stl with a quadrangle": (
        "stl",
        b"solid\nfacet normal 0 0 1\nouter loop\n" + b"vertex 0 0 0\n" * 4 + b"endloop\nendfacet\nendsolid\n",
        "facet 0 of the STL file is no triangle",
    ),
    "stl with two coordinates": (
        "stl",
        b"solid\nfacet normal 0 0 1\nouter loop\n" + b"vertex 0 0\n" * 3 + b"endloop\nendfacet\nendsolid\n",
        "facet 0 of the STL file is no triangle",
    ),
    "off of another kind": ("off", b"ON\n3 1 0\n", "not an ASCII OFF"),
    "off without counts": ("off", b"OFF\n", "no line with its counts"),
    "off of many": ("off", b"OFF\n999999999 999999999 0\n0 0 0\n", "only 1 lines follow"),
    "off with a short face": ("off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1\n", "another length"),
    "off with a far index": ("off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 3\n", "face 0 names"),
    "off with a short vertex": ("off", b"OFF\n3 1 0\n0 0\n1 0 0\n0 1 0\n3 0 1 2\n", "fewer than 3"),
    "glb of another kind": ("glb", b"glTG" + bytes(40), "not a GLB"),
    "glb of version 1": ("glb", b"glTF" + bytes([1, 0, 0, 0]) + bytes(40), "version 1"),
    "glb longer than its file": ("glb", _glb(_tree(), CORNERS, file=10**9), "announces 1000000000 bytes"),
    "glb with a long chunk": ("glb", _glb(_tree(), CORNERS, json=2**32 - 1), "longer than the file"),
    "glb without data": ("glb", _glb(_tree()), "announces 36 bytes and has 0"),
    "gltf nested deep": ("gltf", b'{"asset":' + b"[" * 100_000, "nested deeper"),
    "gltf of words": ("gltf", b'{"asset": yes}', "malformed"),
    "gltf of a list": ("gltf", b"[1, 2]", "no glTF"),
    "gltf 1": ("gltf", b'{"asset": {"version": "1.0"}}', "version '1.0'"),
    "gltf with meshes of numbers": ("glb", _glb(_tree(meshes=[1]), CORNERS), "no array of objects"),
    "gltf with no primitives": ("glb", _glb(_tree(meshes=[{}]), CORNERS), "no array of primitives"),
    "gltf with a far mesh": ("glb", _glb(_tree(nodes=[{"mesh": 7}]), CORNERS), r"meshes\[7\]"),
    "gltf with a mesh of text": ("glb", _glb(_tree(nodes=[{"mesh": "0"}]), CORNERS), "not an integer"),
    "gltf with a cycle": ("glb", _glb(_tree(nodes=[{"mesh": 0, "children": [0]}]), CORNERS), "no tree"),
    "gltf with a short matrix": (
        "glb",
        _glb(_tree(nodes=[{"mesh": 0, "matrix": [1]}]), CORNERS),
        "16 finite numbers",
    ),
    "gltf with a far scene": ("glb", _glb(_tree(scene=3), CORNERS), r"scenes\[3\]"),
    "gltf with fans": ("glb", _glb(_tree(meshes=_primitive(mode=6)), CORNERS), "mode 6"),
    "gltf with half a triangle": (
        "glb",
        _glb(_tree(accessors=_accessor(count=2)), CORNERS),
        "make no triangles",
    ),
    "gltf past its view": (
        "glb",
        _glb(_tree(accessors=_accessor(count=6)), CORNERS),
        "past the end of their view",
    ),
    "gltf of 2^60 vertices": (
        "glb",
        _glb(_tree(accessors=_accessor(count=2**60)), CORNERS),
        "not an integer in range",
    ),
    "gltf past its buffer": (
        "glb",
        _glb(_tree(bufferViews=[{"buffer": 0, "byteOffset": 2**32 - 4, "byteLength": 36}]), CORNERS),
        "past the end of its buffer",
    ),
    "gltf with a step of nothing": (
        "glb",
        _glb(_tree(bufferViews=[{"buffer": 0, "byteStride": 0, "byteLength": 36}]), CORNERS),
        "the stride",
    ),
    "gltf stored sparsely": ("glb", _glb(_tree(accessors=_accessor(sparse={})), CORNERS), "sparsely"),
    "gltf of no data at all": (
        "glb",
        _glb(_tree(accessors=[{"componentType": 5126, "count": 10**9, "type": "VEC3"}]), CORNERS),
        "sparsely or not at all",
    ),
    "gltf compressed": (
        "glb",
        _glb(_tree(meshes=_primitive(extensions={"KHR_draco_mesh_compression": {}})), CORNERS),
        "KHR_draco",
    ),
    "gltf with points only": (
        "glb",
        _glb(_tree(meshes=_primitive(mode=0)), CORNERS),
        "no triangle.*points or lines",
    ),
    "gltf from a stream with files": (
        "gltf",
        json.dumps(_tree(buffers=[{"byteLength": 36, "uri": "a.bin"}])).encode(),
        "cannot be looked for",
    ),
    "gltf with a broken data uri": (
        "gltf",
        json.dumps(_tree(buffers=[{"byteLength": 36, "uri": "data:;base64,@@@"}])).encode(),
        "data uri of buffers.0. is malformed",
    ),
    "an unknown format": ("xyzzy", b"something", "unknown mesh format 'xyzzy'"),
}


@pytest.mark.parametrize(("file_format", "data", "words"), REFUSED.values(), ids=REFUSED.keys())
def test_a_hostile_file_ends_in_one_line(file_format, data, words):
    with pytest.raises(UnreadableMeshError, match=words) as caught:
        load_mesh(BytesIO(data), file_format=file_format)
    assert caught.value.exit_code == EXIT_UNREADABLE
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


@pytest.mark.parametrize(
    "uri", ["../secret.bin", "/etc/hostname", "file:///etc/hostname", "https://a.test/b", "a\0b"]
)
def test_a_gltf_reads_nothing_outside_its_folder(tmp_path, uri):
    (tmp_path / "secret.bin").write_bytes(CORNERS)
    folder = tmp_path / "model"
    folder.mkdir()
    path = folder / "model.gltf"
    path.write_text(json.dumps(_tree(buffers=[{"byteLength": 36, "uri": uri}])))
    with pytest.raises(UnreadableMeshError, match=r"outside the model's folder|cannot be read"):
        load_mesh(path)


def test_a_link_does_not_lead_a_gltf_out_of_its_folder(tmp_path):
    (tmp_path / "secret.bin").write_bytes(CORNERS)
    folder = tmp_path / "model"
    folder.mkdir()
    (folder / "a.bin").symlink_to(tmp_path / "secret.bin")
    path = folder / "model.gltf"
    path.write_text(json.dumps(_tree(buffers=[{"byteLength": 36, "uri": "a.bin"}])))
    with pytest.raises(UnreadableMeshError, match="outside the model's folder"):
        load_mesh(path)


def _saved(file_format: str) -> bytes:
    stream = BytesIO()
    save_mesh(Mesh(TRIANGLE, np.array([[0, 1, 2]])), stream, file_format=file_format)
    return stream.getvalue()


VALID = {name: _saved(name) for name in WRITE_FORMATS}
VALID["off"] = b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
VALID["gltf"] = json.dumps(_tree(buffers=[{"byteLength": 36, "uri": "data:;base64,AAAA"}])).encode()


@pytest.mark.parametrize("file_format", READ_FORMATS)
def test_every_prefix_ends_in_a_mesh_or_an_error_line(file_format):
    data = VALID[file_format]
    for length in range(0, len(data), max(1, len(data) // 150)):
        _load_or_refuse(file_format, data[:length])


@given(st.sampled_from(READ_FORMATS), st.data())
def test_damage_ends_in_a_mesh_or_an_error_line(file_format, data):
    damaged = bytearray(VALID[file_format])
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    _load_or_refuse(file_format, bytes(damaged))


@given(st.sampled_from(READ_FORMATS), st.binary(max_size=200))
def test_noise_ends_in_a_mesh_or_an_error_line(file_format, data):
    _load_or_refuse(file_format, data)
    _load_or_refuse(file_format, VALID[file_format][:40] + data)


def _load_or_refuse(file_format: str, data: bytes) -> None:
    refusal = None
    try:
        mesh = load_mesh(BytesIO(data), file_format=file_format)
    except StriptoolsError as error:
        refusal = error
    if refusal is not None:
        assert refusal.exit_code == EXIT_UNREADABLE
        assert "\n" not in str(refusal)
    else:
        assert mesh.triangle_count > 0
        assert 0 <= mesh.faces.min() <= mesh.faces.max() < mesh.vertex_count


def test_running_out_of_memory_is_an_error_line(monkeypatch):
    def refuse(*_):
        raise MemoryError

    monkeypatch.setattr("striptools.mesh.io._read", refuse)
    with pytest.raises(UnreadableMeshError, match="more memory"):
        load_mesh(BytesIO(VALID["ply"]))


def test_an_interrupt_goes_through(monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("striptools.mesh.io._read", interrupt)
    with pytest.raises(KeyboardInterrupt):
        load_mesh(BytesIO(VALID["ply"]))


def test_a_slip_of_a_reader_is_an_error_line(monkeypatch):
    def slip(*_):
        raise ZeroDivisionError("of a reader\nwith two lines")

    monkeypatch.setattr("striptools.mesh.io._read", slip)
    with pytest.raises(UnreadableMeshError, match="malformed: ZeroDivisionError of a reader with two lines"):
        load_mesh(BytesIO(VALID["ply"]))


def test_the_hostile_folder_ends_in_meshes_and_error_lines():
    folder = meshes_folder()
    if folder is None or not (folder / "hostile" / "INDEX.json").exists():
        pytest.skip("the folder of hostile models is not here (set STRIPTOOLS_MESHES)")
    index = json.loads((folder / "hostile" / "INDEX.json").read_text())
    paths = [str(folder / "hostile" / entry["file"]) for entry in index]
    # One process for all: a peak of one file can only raise those after it, so the bound holds for each.
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", CHILD],
        input="\n".join(paths),
        capture_output=True,
        text=True,
        timeout=MOST_SECONDS * 20,
    )
    assert done.stderr == ""
    assert done.returncode == 0
    verdicts = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(verdicts) == len(paths)
    for path, verdict in zip(paths, verdicts, strict=True):
        assert verdict["seconds"] < MOST_SECONDS, path
        assert verdict["peak"] < MOST_BYTES, path
        assert verdict.get("exit_code", EXIT_UNREADABLE) == EXIT_UNREADABLE, path
        assert "\n" not in verdict.get("error", ""), path
        assert "malformed: " not in verdict.get("error", ""), (path, "an exception that no reader foresaw")
