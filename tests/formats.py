"""The format's own programs, loaded from formats/reducem, and what all readers of a file must agree on."""

import importlib.util
import re
import struct
import sys
import zlib
from types import ModuleType

import numpy as np
from conftest import ROOT
from hypothesis import strategies as st

from striptools.errors import MissingExtraError, UnreadableSceneError
from striptools.reducem.reader import read_scene
from striptools.reducem.stored_hierarchy import KINDS, items_of, name_of, over_of
from striptools.reducem.validate import validate

FORMAT = ROOT / "formats" / "reducem"
VECTORS = FORMAT / "vectors"
UNSEEN = {"RDM568", "RDM707"}
"""The issues that the reference reader leaves to validators."""


def load(name: str, folder) -> ModuleType:
    """A program of the format as a module of this name; those beside it can be imported by it."""
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, folder / f"{name}.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    spec.loader.exec_module(module)
    return module


reference = load("reader", FORMAT / "reference")
make = load("make", VECTORS)
cases = load("cases", VECTORS)


def errors_of(data) -> set[str]:
    """The codes of what makes a file invalid."""
    return {finding.issue.code for finding in validate(data) if finding.issue.severity == "error"}


def mended(data: bytes) -> bytes:
    """The bytes with every checksum that can be found made to fit; the raw one of packed sections is left."""
    out = bytearray(data)
    count = struct.unpack_from("<I", out, 12)[0] if len(out) >= 32 else 0
    if not 1 <= count <= 64 or 32 + 40 * count > len(out):
        return bytes(out)
    for at in range(32, 32 + 40 * count, 40):
        codec, offset, length = struct.unpack_from("<HQQ", out, at + 6)
        checksum = zlib.crc32(out[offset : offset + length])
        struct.pack_into("<I", out, at + 32, checksum)
        if codec == 0:
            struct.pack_into("<I", out, at + 36, checksum)
    struct.pack_into("<I", out, 28, zlib.crc32(out[:28] + out[32 : 32 + 40 * count]))
    return bytes(out)


def agree(data: bytes) -> set[str]:
    """Have validator, reference reader and reader look at a file, and assert that they say the same of it.

    Returns:
        The codes of its errors.
    """
    errors = errors_of(data)
    decoded, refusal = outcome(reference.read, data)
    if decoded is None:
        assert errors or "a Zstandard decoder" in refusal, refusal
    else:
        assert errors <= UNSEEN, errors
    scene, refusal = outcome(read_scene, data)
    if scene is None:
        codes = re.findall(r"RDM\d\d\d", refusal)
        assert "pip install" in refusal or codes == ["RDM124"] or known(codes, errors), (refusal, errors)
    else:
        assert not errors, errors
        if decoded is not None:
            assert_same(scene, decoded)
    return errors


def outcome(read, data: bytes) -> tuple[object, str]:
    """What a reader makes of a file, or None and what it says."""
    try:
        return read(data), ""
    except (reference.RefusedError, MissingExtraError, UnreadableSceneError) as refusal:
        return None, str(refusal)


def known(codes: list[str], errors: set[str]) -> bool:
    """Whether a reader gives a code for which the validator has one too."""
    return any(alike(code, error) for code in codes[-1:] for error in errors)


def alike(code: str, other: str) -> bool:
    """Whether readers may give these codes to one flaw: of one part, or of a count and what is counted."""
    pairs = ({"RDM114", "RDM606"}, {"RDM201", "RDM601"}, {"RDM704", "RDM801"})
    return code[:4] == other[:4] or {code, other} in pairs


def assert_same(scene, decoded) -> None:
    """Assert that both readers made the same of a file, bit for bit."""
    vertices = np.array(decoded.vertices, np.uint32).reshape(-1, 3)
    np.testing.assert_array_equal(np.ascontiguousarray(scene.positions).view(np.uint32), vertices)
    np.testing.assert_array_equal(scene.faces(), np.array(decoded.faces, np.int64).reshape(-1, 3))
    assert_same_hierarchy(scene.hierarchy, decoded.hierarchy)
    assert (scene.remap is None) == (decoded.remap is None)
    if scene.remap is not None:
        pairs = list(zip(scene.remap.face.tolist(), scene.remap.rotation.tolist(), strict=True))
        assert pairs == decoded.remap
    assert set(scene.metadata) == set(decoded.metadata)
    origin = np.array([decoded.record[f"origin_{axis}"] for axis in "xyz"])
    np.testing.assert_array_equal(scene.origin if scene.origin is not None else np.zeros(3), origin)
    assert_same_values(scene, decoded)
    assert_same_places(scene, decoded)


def assert_same_hierarchy(hierarchy, decoded) -> None:
    """Assert that both readers made the same of a hierarchy of a section of its own."""
    assert (hierarchy is None) == (decoded is None)
    if hierarchy is None:
        return
    assert KINDS[decoded.kind][0] == name_of(hierarchy)
    assert over_of(hierarchy) == ("triangles", "strips", "blocks")[decoded.over]
    assert hierarchy.nodes.tolist() == [list(node) for node in decoded.nodes]
    items = items_of(hierarchy)
    assert ([] if items is None else items.tolist()) == decoded.items
    if decoded.kind == 2:
        bounds = np.concatenate([hierarchy.low, hierarchy.high])
        assert bounds.view(np.uint32).tolist() == list(decoded.bounds)


def assert_same_places(scene, decoded) -> None:
    """Assert that both readers put instances in the same places, bit for bit."""
    assert (scene.instances is None) == (decoded.instances is None)
    if scene.instances is None:
        return
    vertices, faces, numbers = reference.placed(decoded)
    if decoded.remap is not None and max(numbers) >= 2**31 - scene.source_face_count:
        return
    placed = scene.placed()
    ours = np.ascontiguousarray(placed.positions[placed.faces()]).view(np.uint32)
    np.testing.assert_array_equal(ours, np.array(vertices, np.uint32)[np.array(faces)])
    if decoded.remap is not None:
        assert placed.remap.face.tolist() == numbers


NAMES = {"normal": "NORM", "texcoord": "TEXC", "color": "COLR", "group": "GRUP"}


def assert_same_values(scene, decoded) -> None:
    """Assert that both readers made the same of attributes and materials, bit for bit."""
    assert {NAMES[one.name] for one in scene.attributes} == set(decoded.attributes)
    for one in scene.attributes:
        domain, values = decoded.attributes[NAMES[one.name]]
        assert one.domain == ("vertex", "corner", "face")[domain]
        bits = one.values.view(np.uint32) if one.values.dtype == np.float32 else one.values
        np.testing.assert_array_equal(bits, values)
    materials = [(one.name, list(one.base_color), one.group) for one in scene.materials]
    assert materials == [(m["name"], m["base_color"], m.get("group", "")) for m in decoded.materials]


# Files that no encoder chose


@st.composite
def strips(draw, vertices: int, triangles: int):
    """A strip over vertices in the order of their first use; gives it and how many are in use after it."""
    index: list[int] = []
    turns, flips = "", ""
    while len(index) < triangles + 2:
        index.append(draw(st.integers(0, vertices)))
        if len(set(index[-1:]) | set(_edge(index, turns))) < min(len(index), 3):
            index.pop()
            index.append(vertices)
        vertices = max(vertices, index[-1] + 1)
        if 3 <= len(index) < triangles + 2:
            turns += draw(st.sampled_from("01"))
            flips += draw(st.sampled_from("01"))
    return make.Strip(index, turns, flips), vertices


def _edge(index: list[int], turns: str) -> tuple[int, ...]:
    """The vertices that the last one must differ from."""
    if len(index) <= 3:
        return tuple(index[:-1])
    a, b, c = index[:3]
    for w, turn in zip(index[3:-1], turns[:-1], strict=True):
        a, b, c = (a, c, w) if turn == "1" else (c, b, w)
    return (a, c) if turns[-1] == "1" else (c, b)


@st.composite
def blocks(draw):
    """A block of a few strips over any coordinates."""
    made, used = [], 0
    for _ in range(draw(st.integers(1, 3))):
        strip, used = draw(strips(used, draw(st.integers(1, 5))))
        made.append(strip)
    if not any("1" in strip.flips for strip in made):
        made = [strip._replace(flips="") for strip in made]
    columns = [draw(coordinates(used)) for _ in range(3)]
    points = list(zip(*[values for values, _ in columns], strict=True))
    return make.Block(made, points, tuple(axis for _, axis in columns))


@st.composite
def coordinates(draw, count: int):
    """So many coordinates of an axis, and how it is stored: as narrow as can be, or not."""
    if draw(st.booleans()):
        exponent = draw(st.sampled_from([-149, -20, -1, 0, 3, 100]))
        numbers = draw(st.lists(st.integers(-300, 300), min_size=count, max_size=count))
        values = [number * 2.0**exponent for number in numbers]
        anchor = min(numbers) - draw(st.integers(0, 9))
        width = (max(numbers) - anchor).bit_length() + draw(st.integers(0, 9))
        return values, draw(st.sampled_from([None, make.Axis(anchor, width, 0, exponent + 149)]))
    bits = st.integers(0, 0x7F7FFFFF) | st.integers(0x80000000, 0xFF7FFFFF)
    values = [make.f32(x) for x in draw(st.lists(bits, min_size=count, max_size=count))]
    places = [make.place(value) for value in values]
    return values, make.Axis(min(places), (max(places) - min(places)).bit_length(), 2, 0)


@st.composite
def plans(draw):
    """A valid file of a few blocks, with or without a remap and stored boxes."""
    made = draw(st.lists(blocks(), min_size=1, max_size=3))
    count = sum(block.count for block in made)
    faces = draw(st.permutations(range(count + 2)))[:count]
    remap = [(face, draw(st.integers(0, 2))) for face in faces] if draw(st.booleans()) else None
    stored, cells = draw(st.booleans()), make.fitting_cells(made)
    return make.Plan(made, stored, remap=remap, cells=cells, record={"source_face_count": count + 2})
