"""The conformance vectors are what their maker makes, and every reader makes of them what they say."""

import contextlib
import hashlib
import json

import pytest

import striptools
from formats import VECTORS, agree, cases, errors_of, make, reference
from striptools.errors import StriptoolsError
from striptools.reducem.validate import validate

FILES = cases.all_files()
VALID = sorted(VECTORS.glob("valid/*.rdm"))
INVALID = sorted(VECTORS.glob("invalid/*.rdm"))
MOST_BYTES = 640_000


def expected(path):
    return json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))


def test_the_files_are_what_the_maker_makes():
    found = {str(path.relative_to(VECTORS)): path for path in VECTORS.glob("*valid/*")}
    assert sorted(found) == sorted(FILES)
    for name, path in found.items():
        assert path.read_bytes() == FILES[name], f"{name}: run formats/reducem/vectors/make.py"
    assert sum(map(len, FILES.values())) < MOST_BYTES


@pytest.mark.parametrize("path", VALID, ids=lambda path: path.stem)
def test_a_valid_file_decodes_to_what_it_says(path):
    data, facts = path.read_bytes(), expected(path)
    assert agree(data) == set()
    if facts["packed"]:
        with pytest.raises(reference.RefusedError, match="a Zstandard decoder"):
            reference.read(data)
        return
    scene = reference.read(data)
    found = {
        "vertices": ["".join(f"{bits:08x}" for bits in vertex) for vertex in scene.vertices],
        "faces": scene.faces,
        "remap": scene.remap,
        "blocks": [b - a for a, b in zip(scene.block_starts, scene.block_starts[1:], strict=False)],
        "runs": scene.runs,
        "nodes": [decoded(node) for node in scene.nodes],
        "attributes": {name: [domain, values] for name, (domain, values) in scene.attributes.items()},
        "materials": scene.materials,
        "metadata": scene.metadata,
        "geometries": scene.instances and scene.geometries,
        "instances": scene.instances,
        "hierarchy": scene.hierarchy and hierarchy_of(scene.hierarchy),
        "passed_over": scene.passed_over,
    }
    for name, value in found.items():
        text = json.dumps(value, separators=(",", ":"))
        wanted = facts.get(name, type(value)() if name in ("attributes", "materials") else None)
        if isinstance(wanted, str):
            text = json.dumps(hashlib.sha256(text.encode()).hexdigest())
        assert json.loads(text) == wanted, name
    names = [name for name in make.RECORD if not name.startswith("reserved")]
    assert {name: scene.record[name] for name in names} == dict.fromkeys(names, 0) | facts["record"]


def hierarchy_of(found):
    return [found.kind, found.over, [list(node) for node in found.nodes], found.items]


def decoded(node):
    pairs = zip(node.children, node.boxes, strict=True)
    return [None if box is None else [list(child), [list(axis) for axis in box]] for child, box in pairs]


@pytest.mark.parametrize("path", INVALID, ids=lambda path: path.stem)
def test_an_invalid_file_has_the_issues_it_says(path):
    codes = expected(path)["codes"]
    if "RDM122" in codes:
        pytest.importorskip("zstandard")
    assert sorted(errors_of(path.read_bytes())) == codes
    assert agree(path.read_bytes()) == set(codes)


@pytest.mark.parametrize("path", INVALID, ids=lambda path: path.stem)
def test_an_invalid_file_ends_in_an_error_line_whatever_is_asked_first(path):
    asked = [
        lambda s: s.remap,
        lambda s: s.metadata,
        lambda s: s.packed,
        lambda s: s.faces(),
        lambda s: s.low,
    ]
    for ask in (*asked, lambda scene: scene.check()):
        with contextlib.suppress(StriptoolsError):
            ask(striptools.open(path))
    with pytest.raises(StriptoolsError):
        striptools.open(path).check()


def test_unknown_sections_are_said_and_no_error():
    path = VECTORS / "valid" / "unknown_sections.rdm"
    findings = validate(path)
    assert [finding.issue.code for finding in findings] == ["RDM115", "RDM115"]
    assert not any(letter in str(finding) for finding in findings for letter in "\0\n\xff")


def test_every_issue_but_those_of_no_file_has_a_vector():
    from striptools.reducem.issues import ISSUES

    shown = {code for path in INVALID for code in expected(path)["codes"]}
    errors = {code for code, issue in ISSUES.items() if issue.severity == "error"}
    assert errors - shown == {"RDM001", "RDM124"}


def corners_alone(starts, turns, flips, index, t):
    """The corners of triangle t by the closed form of section 4.3."""
    i = sum(starts[: t + 1]) - 1
    t0 = max(x for x in range(t + 1) if starts[x])
    c = index[t + 2 * i + 2]
    if t == t0:
        a, b = index[t + 2 * i], index[t + 2 * i + 1]
    else:
        others = [u for u in range(t0 + 1, t) if turns[u] != turns[t]]
        a, b = index[t + 2 * i + 1], index[(others[-1] if others else t0) + 2 * i + 1]
        if turns[t]:
            a, b = (index[others[-1] + 2 * i + 1] if others else index[t0 + 2 * i]), a
    return [b, a, c] if flips[t] else [a, b, c]


def test_the_closed_form_gives_the_triangles_of_the_loop():
    for about, plan in cases.valid_plans().values():
        for block in plan.blocks:
            starts = [int(i == 0) for length in block.lengths for i in range(length)]
            turns = [int(x) for strip in block.strips for x in "0" + strip.turns]
            flips = [int(x) for s in block.strips for x in "0" + (s.flips or "0" * len(s.turns))]
            index = [i for strip in block.strips for i in strip.index]
            faces = [face for strip in block.strips for face in make.walk(strip)]
            alone = [corners_alone(starts, turns, flips, index, t) for t in range(len(faces))]
            assert alone == faces, about
