"""Only what a scene or a query requires is there: in the file, in device memory, in the compiled program.

Each feature is looked for where it is on, so that looking can find it, and where it is off.
"""

import gc
import io
import re
import struct
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax
import numpy as np
import pytest
from attributes import MATERIALS
from scenes import small_scene
from strategies import grid, sphere
from test_instances import SCENES, load

import striptools
from striptools.hierarchies.options import HierarchyOptions
from striptools.kernels.packets import ROW as PACKET_ROW
from striptools.kernels.rays import ROW
from striptools.mesh.attributes import Attribute
from striptools.mesh.mesh import Mesh
from striptools.options import Options
from striptools.pipeline import convert
from striptools.reducem.quantize import PrecisionOptions
from striptools.reducem.scene import Scene
from striptools.trace import Tracer, functional
from striptools.trace.instanced import instances_program
from striptools.trace.launch import program
from striptools.trace.packed import lay_out_packed

PLAIN = Options(remap=False, threads=1)
GEOMETRY = {"SCEN", "BLKH", "BLKD", "NODE"}
"""The sections of a scene of several blocks and nothing else."""


def sections(scene: Scene) -> dict[str, bytes]:
    """The sections of a scene's file, found by its table alone: SPEC 3.1 and 3.2."""
    stream = io.BytesIO()
    scene.save(stream)
    data = stream.getvalue()
    found = {}
    for k in range(struct.unpack_from("<I", data, 12)[0]):
        kind, _, _, offset, stored = struct.unpack_from("<4sHHQQ", data, 32 + 40 * k)
        found[kind.decode()] = data[offset : offset + stored]
    return found


def bare(mesh: Mesh, options: Options = PLAIN) -> Scene:
    """A scene without metadata."""
    return replace(convert(mesh, options), metadata={})


def ball() -> Mesh:
    return Mesh(*sphere(4))


def with_values(name: str, domain: str, values: np.ndarray, materials: tuple = ()) -> Mesh:
    mesh = ball()
    return Mesh(
        mesh.positions, mesh.faces, attributes=(Attribute(name, domain, values),), materials=materials
    )


def normals(variety: int) -> Mesh:
    mesh = ball()
    values = np.zeros((mesh.vertex_count, 3), np.float32)
    values[:, 2] = np.arange(mesh.vertex_count) % variety
    return with_values("normal", "vertex", values)


def groups() -> Mesh:
    return with_values("group", "face", np.zeros((ball().triangle_count, 1), np.int32), MATERIALS[:1])


def far_away() -> Mesh:
    return Mesh(ball().positions.astype(np.float64) / 3 + 1e7, ball().faces)


def under(name: str) -> Options:
    return replace(PLAIN, hierarchy=HierarchyOptions(name))


FILES = {
    "nothing": (lambda: bare(ball()), set()),
    "one block": (lambda: bare(Mesh(*grid(3, 3))), {"-NODE"}),
    "remap": (lambda: bare(ball(), replace(PLAIN, remap=True)), {"RMAP"}),
    "stored boxes": (lambda: bare(ball(), replace(PLAIN, boxes="stored")), {"RUNS"}),
    "normals": (lambda: bare(normals(9)), {"ATTR"}),
    "normals, not wanted": (lambda: bare(normals(9), replace(PLAIN, geometry_only=True)), set()),
    "groups": (lambda: bare(groups()), {"ATTR", "MATL"}),
    "groups, not wanted": (lambda: bare(groups(), replace(PLAIN, geometry_only=True)), set()),
    "materials that nothing names": (lambda: bare(replace(ball(), materials=MATERIALS)), set()),
    "instances": (lambda: bare(load(SCENES["nested"])), {"GEOM", "INST"}),
    "instances, flattened": (lambda: bare(load(SCENES["nested"]), replace(PLAIN, instances=False)), set()),
    "a mesh that stands once": (lambda: bare(load(SCENES["repeated"], keep=False)), set()),
    "metadata": (lambda: convert(ball(), PLAIN), {"META"}),
    "origin": (lambda: bare(far_away()), set()),
    "grid": (lambda: bare(ball(), replace(PLAIN, precision=PrecisionOptions(12))), set()),
    "heap": (lambda: bare(ball(), under("slbvh")), {"HIER", "-NODE"}),
    "presorted": (lambda: bare(ball(), under("presorted")), {"HIER", "TRIS", "-NODE", "-BLKH", "-BLKD"}),
}


@pytest.mark.parametrize("name", FILES)
def test_a_file_has_the_sections_that_its_scene_needs(name):
    make, other = FILES[name]
    scene = make()
    lost = {kind[1:] for kind in other if kind[0] == "-"}
    lost |= {"NODE"} if scene.block_count == 1 else set()
    assert set(sections(scene)) == GEOMETRY - lost | {kind for kind in other if kind[0] != "-"}


@pytest.mark.parametrize("name", ["remap", "normals", "groups", "metadata"])
def test_what_is_beside_the_geometry_changes_no_byte_of_it(name):
    plain, other = sections(bare(ball())), sections(FILES[name][0]())
    same = set(plain) - ({"SCEN"} if name == "remap" else set())
    assert {kind: other[kind] for kind in same} == {kind: plain[kind] for kind in same}


def test_stored_boxes_change_nodes_alone():
    plain, stored = sections(bare(ball())), sections(FILES["stored boxes"][0]())
    assert plain["BLKD"] == stored["BLKD"]
    assert stored["NODE"].startswith(plain["NODE"])
    assert len(stored["NODE"]) > 10 * len(plain["NODE"])


@pytest.mark.parametrize(("name", "bit"), [("stored boxes", 0), ("grid", 1), ("origin", 2)])
def test_flags_and_fields_are_set_where_they_are_needed(name, bit):
    """SPEC 4.1: flags at 24, the grid's exponent at 26, the origin at 72."""
    on, off = sections(FILES[name][0]())["SCEN"], sections(bare(ball()))["SCEN"]
    assert on[24] == 1 << bit
    assert off[24] == 0
    assert any(off[26:28]) is any(off[72:]) is False
    assert any(on[26:28]) is (name == "grid")
    assert any(on[72:]) is (name == "origin")


@pytest.mark.parametrize("unit", [None, "mm"])
def test_metadata_say_a_unit_where_there_is_one(unit):
    text = sections(convert(replace(ball(), unit=unit), PLAIN))["META"]
    assert (b"unit" in text) is (unit is not None)
    assert b"source" not in text


def test_a_source_is_named_where_there_is_one(tmp_path):
    path = tmp_path / "ball.off"
    mesh = ball()
    lines = [f"OFF\n{mesh.vertex_count} {mesh.triangle_count} 0"]
    lines += [" ".join(map(str, row)) for row in mesh.positions]
    lines += [f"3 {a} {b} {c}" for a, b, c in mesh.faces]
    path.write_text("\n".join(lines))
    assert b'"source":"ball.off"' in sections(convert(path, PLAIN))["META"]


def attribute_widths(scene: Scene) -> list[tuple[int, int, int]]:
    """Index width, rows and domain of each attribute, and the section is no longer than they say."""
    data = sections(scene)["ATTR"]
    count = struct.unpack_from("<I", data)[0]
    found, at = [], 8 + 16 * count
    for k in range(count):
        _, domain, components, kind, width, rows, _ = struct.unpack_from("<4s4BII", data, 8 + 16 * k)
        entries = (len(scene.positions), 3 * scene.triangle_count, scene.triangle_count)[domain]
        at += -(-rows * components * (4, 1, 2, 4)[kind] // 4) * 4 + -(-entries * width // 32) * 4
        found.append((width, rows, domain))
    assert at == len(data)
    return found


@pytest.mark.parametrize(("variety", "width"), [(1, 0), (2, 1), (3, 2), (9, 4), (1000, 10)])
def test_attributes_have_indices_as_wide_as_their_rows_need(variety, width):
    assert attribute_widths(bare(normals(variety))) == [(width, variety, 0)]


def test_values_that_are_all_different_have_no_indices():
    mesh = ball()
    values = np.zeros((mesh.triangle_count, 3), np.float32)
    values[:, 2] = np.arange(mesh.triangle_count)
    scene = bare(with_values("normal", "face", values))
    assert attribute_widths(scene) == [(0, mesh.triangle_count, 2)]


def test_a_domain_is_no_finer_than_its_values():
    mesh = ball()
    smooth = np.repeat(np.zeros((1, 3), np.float32), 3 * mesh.triangle_count, axis=0)
    smooth[:, 0] = mesh.faces.reshape(-1)
    assert attribute_widths(bare(with_values("normal", "corner", smooth)))[0][2] == 0
    seam = smooth.copy()
    seam[0] = -1
    assert attribute_widths(bare(with_values("normal", "corner", seam)))[0][2] == 1


def blocks(scene: Scene) -> list[dict[str, int]]:
    """What each block's header says, SPEC 4.2, and that its data are exactly as many words as that takes."""
    found = sections(scene)
    headers = [found["BLKH"][at : at + 32] for at in range(0, len(found["BLKH"]), 32)]
    told = []
    for data in headers:
        _, word, triangles, vertices, strips, flags = struct.unpack_from("<IIBBBB", data)
        axes = [byte & 63 for byte in data[24:27]]
        index = vertices.bit_length()
        count = triangles + 1 + 2 * (strips + 1)
        bits = (2 + flags) * (triangles + 1) + count * index + (vertices + 1) * sum(axes)
        told.append({"word": word, "words": -(-bits // 32), "flips": flags, "index": index})
        told[-1] |= {"vertices": vertices + 1} | dict(zip("xyz", axes, strict=True))
    ends = [block["word"] for block in told[1:]]
    assert ends == [block["word"] + block["words"] for block in told[:-1]]
    end = told[-1]["word"] + told[-1]["words"] + 16
    assert len(found["BLKD"]) == -(-end // 16) * 64
    return told


def small_and_large() -> Mesh:
    """A flat grid of many blocks, and far beside it two triangles, one of them off the plane."""
    positions, faces = grid(40, 40)
    more = np.float32([[1e3, 0, 0], [1e3 + 1, 0, 0], [1e3, 1, 0], [1e3 + 1, 1, 0.5]])
    more_faces = np.int32([[0, 1, 2], [2, 1, 3]]) + len(positions)
    return Mesh(
        np.concatenate([positions * np.float32([1, 1, 0]), more]), np.concatenate([faces, more_faces])
    )


def test_each_block_is_as_wide_as_itself_needs():
    told = blocks(bare(small_and_large()))
    small = [block for block in told if block["vertices"] == 4]
    large = [block for block in told if block["vertices"] > 128]
    assert [block["index"] for block in small] == [2]
    assert {block["index"] for block in large} == {8}
    assert [block["z"] for block in small] == [1]
    assert {block["z"] for block in large} == {0}
    assert all(block["x"] > small[0]["x"] for block in large)


@pytest.mark.parametrize("flips", [False, True])
def test_flip_bits_are_in_blocks_that_flip(flips):
    told = [block["flips"] for block in blocks(small_scene(flips=flips, block=4))]
    assert set(told) == ({0, 1} if flips else {0})


def held(scene: Scene, **options) -> dict[int, jax.Array]:
    """All arrays on devices that making a tracer leaves behind, by where they lie."""
    gc.collect()
    before = {id(array) for array in jax.live_arrays()}
    tracer = Tracer(scene, device="cpu", threads=1, **options)
    gc.collect()
    arrays = [array for array in jax.live_arrays() if id(array) not in before]
    known = {id(array) for array in jax.tree.leaves(tracer._scene)}
    assert {id(array) for array in arrays} == known
    return {array.addressable_data(0).unsafe_buffer_pointer(): array for array in arrays if array.size}


def shapes(scene: Scene, **options) -> list[tuple[str, tuple[int, ...]]]:
    """Types and shapes of all of them that are no single numbers or triples."""
    arrays = held(scene, **options).values()
    return sorted((str(array.dtype), array.shape) for array in arrays if array.size > 3)


def test_an_expanded_scene_is_nodes_and_leaves():
    assert [(kind, shape[1:]) for kind, shape in shapes(bare(ball()), resident="expanded")] == [
        ("float32", (7, 8)),
        ("float32", (10, 8)),
    ]


@pytest.mark.parametrize("remap", [False, True])
def test_a_compressed_scene_is_its_sections(remap, tmp_path):
    bare(ball(), replace(PLAIN, remap=remap, boxes="stored")).save(tmp_path / "ball.rdm")
    scene = striptools.open(tmp_path / "ball.rdm")
    packed, blocks = scene.packed, scene.blocks
    # What is worked out of headers and runs is 16 words a block and 8 a node.
    sizes = blocks.words.shape, (blocks.count, 16), (len(packed.nodes), 8)
    kinds = [("uint32", shape) for shape in sizes]
    kinds += [("int32", (scene.triangle_count,))] if remap else []
    found = shapes(scene, resident="compressed")
    # Nodes are read as words and as bytes: of the same memory one is listed.
    nodes = [one for one in found if one[1] in ((len(packed.nodes), 16), (len(packed.nodes), 8, 8))]
    assert len(nodes) == 1
    assert sorted(found) == sorted(kinds + nodes)


def unaligned(values: np.ndarray) -> np.ndarray:
    """A copy that starts four bytes behind a cache line, where JAX has to copy it."""
    memory = np.zeros(values.nbytes + 128, np.uint8)
    first = -memory.ctypes.data % 64 + 4
    copy = memory[first : first + values.nbytes].view(values.dtype).reshape(values.shape)
    copy[:] = values
    return copy


def in_memory(boxes: str) -> Scene:
    """A scene that no file holds, whose arrays lie where JAX copies them."""
    scene = bare(ball(), replace(PLAIN, boxes=boxes))
    packed, blocks = scene.packed, scene.blocks
    assert (packed.runs is not None) is (boxes == "stored")
    moved = {
        name: None if values is None else unaligned(values)
        for name, values in (
            ("nodes", packed.nodes),
            ("first_run", packed.first_run),
            ("runs", packed.runs),
        )
    }
    blocks = replace(blocks, headers=unaligned(blocks.headers), words=unaligned(blocks.words))
    return replace(scene, packed=replace(packed, **moved), blocks=blocks)


@pytest.mark.parametrize("boxes", ["stored", "rebuilt"])
def test_nodes_and_planes_are_one_memory_on_a_cpu(boxes, monkeypatch):
    tracer = Tracer(in_memory(boxes), device="cpu", resident="compressed")
    arrays, kept = tracer._scene, tracer._layout.arrays
    for k in range(len(tracer.devices)):
        places = [a.addressable_data(k).unsafe_buffer_pointer() for a in (arrays.nodes, arrays.planes)]
        assert places == [kept.nodes.ctypes.data] * 2
    counted = tracer.resident_bytes
    # A GPU has them twice.
    monkeypatch.setattr(tracer, "_on_gpu", True)
    assert tracer.resident_bytes == counted + kept.nodes.nbytes


def test_what_starts_at_a_cache_line_is_not_copied():
    first = lay_out_packed(in_memory("stored"))
    scene = bare(ball(), replace(PLAIN, boxes="stored"))
    aligned = replace(scene, packed=replace(scene.packed, nodes=first.arrays.nodes))
    assert lay_out_packed(aligned).arrays.nodes is first.arrays.nodes
    assert first.arrays.nodes.tobytes() == scene.packed.nodes.tobytes()


@pytest.mark.parametrize("name", ["normals", "groups", "metadata", "origin", "remap"])
@pytest.mark.parametrize("resident", ["expanded", "compressed"])
def test_what_no_ray_asks_for_is_on_no_device(name, resident):
    scenes = bare(ball()), FILES[name][0]()
    plain, other = (sum(one.nbytes for one in held(scene, resident=resident).values()) for scene in scenes)
    if name == "remap" and resident == "compressed":
        assert other > plain
    elif name != "origin":
        assert other == plain
    else:
        # The same blocks but for the bits of their vertices.
        assert len(held(bare(ball()), resident=resident)) == len(held(FILES[name][0](), resident=resident))


@pytest.mark.parametrize(("instances", "there"), [("shared", True), ("flattened", False)])
def test_matrices_are_there_where_instances_are_shared(instances, there):
    found = shapes(bare(load(SCENES["nested"])), instances=instances)
    assert any(shape[1:] == (3, 4) for _, shape in found) is there
    assert len(found) == (6 if there else 2)


def text_of(
    scene: Scene, packets: bool = False, resident: str = "expanded", instances: str = "auto", **asked: Any
) -> str:
    """The compiled program of a query."""
    tracer = Tracer(scene, device="cpu", threads=1, resident=resident, instances=instances)
    options = tracer._options(**asked)
    if tracer._shared:
        rays = np.zeros((256, 3), np.float32)
        return compiled(instances_program(tracer._mesh, options), tracer._scene, rays, rays, rays[:, 0])
    rows = np.zeros((8, PACKET_ROW) if packets else (256, ROW), np.float32)
    live = np.full(1, len(rows), np.int32)
    return compiled(program(tracer._mesh, options, packets), tracer._scene, rows, live)


def code(text: str) -> set[tuple[str, str]]:
    """Whose code the instructions of a program are: files and functions, by the program's own tables."""
    head, _, body = text.partition("\nStackFrames\n")
    table, body = body.split("\n\n", 1)
    names = [
        dict(re.findall(r'^(\d+) "(.*)"$', head.split(f"\n{kind}\n")[1].split("\n\n")[0], re.MULTILINE))
        for kind in ("FileNames", "FunctionNames")
    ]
    places = dict(re.findall(r"^(\d+) \{(file_name_id=\d+ function_name_id=\d+)", head, re.MULTILINE))
    frames = dict(re.findall(r"^(\d+) \{file_location_id=(\d+)", table, re.MULTILINE))
    found = set()
    for frame in set(re.findall(r"stack_frame_id=(\d+)", body)) & set(frames):
        file, function = (
            name[k] for name, k in zip(names, re.findall(r"\d+", places[frames[frame]]), strict=True)
        )
        found.add((Path(file).stem, function.partition(".<locals>")[0]))
    return found


def files(text: str) -> set[str]:
    """The files whose code is in a program."""
    return {file for file, _ in code(text)}


def functions(text: str) -> set[str]:
    """The functions whose code is in a program."""
    return {function for _, function in code(text)}


def compiled(jitted: Any, *given: Any) -> str:
    """A program, traced anew: what JAX keeps of small functions says where they were used first."""
    jax.clear_caches()
    return jitted.lower(*given).compile().as_text()


def signature(text: str) -> tuple[list[str], list[str]]:
    """Types and shapes of what goes into a program and of what comes out."""
    line = text.splitlines()[0]
    taken, given = re.search(r"entry_computation_layout=\{\((.*)\)->(.*?)\}, allow", line).groups()
    return re.findall(r"\w+\[[\d,]*\]", taken), re.findall(r"\w+\[[\d,]*\]", given)


COMMON = {"walk", "launch", "numerics", "box", "triangle"}
PROGRAMS = {
    "expanded": ({}, {"walk_wide", "leaf_blocks"}),
    "compressed": ({"resident": "compressed"}, {"walk_packed"}),
    "any hit": ({"any_hit": True}, {"walk_wide", "leaf_blocks"}),
    "counting": ({"counting": True}, {"walk_wide", "leaf_blocks"}),
    "all hits": ({"gather": "all", "most": 4}, {"walk_wide", "leaf_blocks", "walk_gather"}),
    "packets": ({"packets": True}, {"walk_wide", "leaf_blocks", "walk_packets"}),
    "compressed packets": ({"packets": True, "resident": "compressed"}, {"walk_packed", "walk_packets"}),
}


@pytest.mark.parametrize("name", PROGRAMS)
def test_a_program_has_the_code_that_its_query_needs(name):
    asked, needed = PROGRAMS[name]
    found = files(text_of(small_scene(), **asked))
    assert found - COMMON == needed


@pytest.mark.parametrize("name", ["slbvh", "kdtree", "loose-octree", "presorted"])
def test_each_hierarchy_has_its_own_walk(name):
    found = files(text_of(bare(ball(), under(name))))
    walks = {file for file in found if file.startswith("walk_")}
    own = {"loose-octree": "walk_binary"}.get(name, f"walk_{name}")
    assert own in walks
    assert walks <= {own, "walk_single"}


@pytest.mark.parametrize(("instances", "there"), [("shared", True), ("flattened", False)])
def test_code_for_instances_is_there_where_they_are_shared(instances, there):
    found = files(text_of(bare(load(SCENES["nested"])), instances=instances))
    assert ("walk_instances" in found) is there


OUTPUTS = {
    "closest hit": ({}, ["f32[256]", "s32[256]", "s32[256,0]", "s32[0]"]),
    "any hit": ({"any_hit": True}, ["f32[0]", "s32[256]", "s32[256,0]", "s32[0]"]),
    "counting": ({"counting": True}, ["f32[256]", "s32[256]", "s32[256,6]", "s32[0]"]),
    "all hits": ({"gather": "all", "most": 4}, ["f32[256,4]", "s32[256,4]", "s32[256,0]", "s32[256]"]),
}


@pytest.mark.parametrize("name", OUTPUTS)
@pytest.mark.parametrize("resident", ["expanded", "compressed"])
def test_a_program_gives_what_is_asked(name, resident):
    asked, outputs = OUTPUTS[name]
    text = text_of(small_scene(), resident=resident, **asked)
    assert signature(text)[1] == outputs
    assert ("in_range" in functions(text)) is (name != "any hit")


@pytest.mark.parametrize("any_hit", [True, False])
def test_names_are_read_where_they_are_told(any_hit):
    expanded = functions(text_of(small_scene(), any_hit=any_hit))
    assert ("faces_in" in expanded) is not any_hit
    for found in (expanded, functions(text_of(small_scene(), resident="compressed", any_hit=any_hit))):
        assert ("nearer" in found) is not any_hit


@pytest.mark.parametrize(
    ("remap", "any_hit", "there"), [(True, False, True), (True, True, False), (False, False, False)]
)
def test_a_remap_is_read_where_two_faces_may_tie(remap, any_hit, there):
    scene = small_scene(remap=remap)
    text = text_of(scene, resident="compressed", any_hit=any_hit)
    assert ("PackedScene.faces_of" in functions(text)) is there
    # One number says how many rays there are.
    numbers = [one for one in signature(text)[0] if one.startswith("s32[") and one not in ("s32[]", "s32[1]")]
    assert (numbers != []) is there


def instructions(text: str) -> int:
    return len(re.findall(r"^ +(?:ROOT )?%?[\w.\-]+ = ", text, re.MULTILINE))


@pytest.mark.parametrize("need", ["flips", "minus_zero", "as_bits", "tiny", "words"])
def test_what_no_block_needs_is_not_decoded(need):
    scene = small_scene()
    tracer = Tracer(scene, device="cpu", threads=1, resident="compressed")
    options = tracer._options()
    assert options.decode == (3, False, False, False, False)
    more = options._replace(decode=options.decode._replace(**{need: 4 if need == "words" else True}))
    rows = np.zeros((256, ROW), np.float32)
    given = tracer._scene, rows, np.full(1, 256, np.int32)
    off, on = (compiled(program(tracer._mesh, one), *given) for one in (options, more))
    assert instructions(off) < instructions(on)
    assert ("_from_bits" in functions(off)) is False
    assert ("_from_bits" in functions(on)) is (need == "tiny")


@pytest.mark.parametrize("flips", [False, True])
def test_flips_are_decoded_where_a_block_has_them(flips):
    tracer = Tracer(small_scene(flips=flips), device="cpu", threads=1, resident="compressed")
    assert tracer._options().decode.flips is flips


ASKED = {
    "t, u and v": (lambda g, *rays: functional.closest_hit(g, *rays), True),
    "u alone": (lambda g, *rays: functional.closest_hit(g, *rays).u, True),
    "t and face": (lambda g, *rays: functional.closest_hit(g, *rays)[::3], False),
    "any hit": (lambda g, *rays: functional.any_hit(g, *rays[1:]), False),
    "count": (lambda g, *rays: functional.count_hits(g, *rays[1:]), False),
}


@pytest.mark.parametrize("name", ASKED)
def test_a_program_of_the_users_weighs_what_it_uses(name):
    query, weighed = ASKED[name]
    mesh = ball()
    geometry = functional.Geometry.of(Tracer(bare(mesh), device="cpu", threads=1), mesh.faces)
    rays = np.zeros((256, 3), np.float32)
    text = compiled(jax.jit(query), geometry, mesh.positions, rays, rays)
    assert ("_weights" in functions(text)) is weighed


def test_what_is_not_compiled_is_not_imported():
    """No kernel for GPUs, no pictures and no peer, for a scene traced on a CPU."""
    code = """
import sys
import numpy as np
import striptools
from striptools.trace import Tracer
mesh = striptools.Mesh(np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.int32([[0, 1, 2]]))
tracer = Tracer(striptools.convert(mesh), device="cpu", threads=1)
assert tracer.closest_hit([[0.2, 0.2, 1]], [[0, 0, -1]]).hit.all()
names = ("jax.experimental.pallas", "matplotlib", "PIL", "embreex", "trimesh", "pymeshlab")
print([name for name in names if name in sys.modules])
import striptools.trace.pallas.walk
assert "jax.experimental.pallas" in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[0] == "[]"


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"resident": "compressed"},
        {"instances": "shared"},
        {"counters": 1},
        {"test": "fast"},
        {"test": "float64"},
    ],
)
def test_hits_without_weights_are_the_same_hits(options, monkeypatch):
    options = dict(options)
    counters = bool(options.pop("counters", 0))
    scene = convert(load(SCENES["nested"]) if "instances" in options else ball())
    tracer = Tracer(scene, device="cpu", threads=1, **options)
    random = np.random.default_rng(3)
    targets = scene.placed().positions[random.integers(0, scene.placed().positions.shape[0], 3000)]
    origins = (targets + random.normal(size=targets.shape) * 3).astype(np.float32)
    directions = targets - origins
    whole = tracer.closest_hit(origins, directions, counters=counters)
    parts = tracer.closest_hit(origins, directions, counters=counters, weights=False)
    assert whole.hit.sum() > 100
    assert parts.u is None
    assert parts.v is None
    for name in ("t", "face", "triangle", "instance", "geometry", "geometry_face"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(parts, name), err_msg=name)
    given = []
    monkeypatch.setattr(tracer, "_weigh", lambda _rays, _at, _traced, found: given.append(found))
    tracer.closest_hit(origins, directions)
    tracer.closest_hit(origins, directions, weights=False)
    assert [len(found[2]) + len(found[3]) for found in given[:: len(given) - 1]] == [6000, 0]
