"""What a glTF primitive carries beside positions and indices: normals, texture coordinates, colours.

Nothing here refuses a file: what is malformed is left out, and a note counts it with what no mesh of ours
keeps (Khronos glTF 2.0 specification, sections 3.7.2.1 and 3.9.2; KHR_mesh_quantization for small types).
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from striptools.errors import UnreadableMeshError
from striptools.mesh.attributes import (
    WHITE,
    Attribute,
    Material,
    Name,
    as_type,
    number_materials,
    tidy_name,
    turn_normals,
)
from striptools.mesh.readers.parsed import Parsed, counted

BYTE, UNSIGNED_BYTE, SHORT, UNSIGNED_SHORT, FLOAT = 5120, 5121, 5122, 5123, 5126
SEMANTICS: dict[str, tuple[Name, tuple[str, ...], tuple[int, ...]]] = {
    "NORMAL": ("normal", ("VEC3",), (FLOAT, BYTE, SHORT)),
    "TEXCOORD_0": ("texcoord", ("VEC2",), (FLOAT, UNSIGNED_BYTE, UNSIGNED_SHORT, BYTE, SHORT)),
    "COLOR_0": ("color", ("VEC3", "VEC4"), (FLOAT, UNSIGNED_BYTE, UNSIGNED_SHORT)),
}
UNKEPT = ("textures", "animations")

ReadAccessor = Callable[[object, str, tuple[str, ...], tuple[int, ...]], tuple[np.ndarray, bool]]
"""Reads an accessor of some shapes and component types: its rows, and whether integers are fractions."""


def primitive_attributes(
    primitive: dict[str, Any], vertices: int, read: ReadAccessor, left: Counter[str]
) -> tuple[Attribute, ...]:
    """The attributes of a primitive that are kept; `left` counts the others by their names."""
    found = []
    for semantic, index in primitive["attributes"].items():
        if semantic == "POSITION":
            continue
        values = None
        if semantic in SEMANTICS:
            values = _values(semantic, index, vertices, read)
        if values is None:
            left[semantic] += 1
        else:
            found.append(Attribute(SEMANTICS[semantic][0], "vertex", values))
    left["morph targets"] += bool(primitive.get("targets"))
    return tuple(found)


def material_number(primitive: dict[str, Any], tree: dict[str, Any]) -> int:
    """The number of a primitive's material, from 1; 0 where it has none."""
    index, materials = primitive.get("material"), tree.get("materials")
    if isinstance(index, int) and isinstance(materials, list) and 0 <= index < len(materials):
        return index + 1
    return 0


def with_materials(parsed: Parsed, tree: dict[str, Any]) -> Parsed:
    """The mesh with groups numbered by first use, its materials, and the unit that glTF has: the metre."""
    attributes, materials = parsed.attributes, ()
    numbers = next((one.values for one in attributes if one.name == "group"), None)
    if numbers is not None:
        known = [Material(), *(_material(one) for one in tree.get("materials", []))]
        groups, materials = number_materials(known, numbers.reshape(-1))
        kept = tuple(one for one in attributes if one.name != "group")
        attributes = (*kept, Attribute("group", "face", groups))
    return replace(parsed, attributes=attributes, materials=materials, unit="m")


def notes_on_the_rest(left: Counter[str], tree: dict[str, Any]) -> list[str]:
    """What was left out, as notes."""
    names = [
        f"{tidy_name(name)[:40]} of {counted(times, 'primitive', 'primitives')}"
        for name, times in sorted(left.items())
        if times
    ]
    notes = [f"left out: {', '.join(names[:8])}{', ...' if len(names) > 8 else ''}"] if names else []
    for name in UNKEPT:
        rows = tree.get(name)
        if isinstance(rows, list) and rows:
            notes.append(f"{counted(len(rows), name[:-1], name)} left out")
    return notes


def turned(attributes: Sequence[Attribute], matrix: np.ndarray) -> tuple[Attribute, ...]:
    """The attributes of a mesh moved by a matrix, `(4, 4)`: its normals turned along."""
    return tuple(
        Attribute("normal", one.domain, turn_normals(one.values, matrix[:3, :3]))
        if one.name == "normal"
        else one
        for one in attributes
    )


def _values(semantic: str, index: object, vertices: int, read: ReadAccessor) -> np.ndarray | None:
    name, shapes, components = SEMANTICS[semantic]
    try:
        values, normalized = read(index, semantic, shapes, components)
    except UnreadableMeshError:
        return None
    if len(values) != vertices:
        return None
    values = values.astype(values.dtype.newbyteorder("="))
    if values.dtype.kind == "f" or (name == "color" and normalized):
        return values
    if name == "color":
        return None
    return np.maximum(as_type(values, np.dtype(np.float32)), -1) if normalized else values.astype(np.float32)


def _material(row: object) -> Material:
    """Name and base colour of a row of the table of materials, as far as they make sense."""
    if not isinstance(row, dict):
        return Material()
    name, pbr = row.get("name"), row.get("pbrMetallicRoughness")
    factor = pbr.get("baseColorFactor") if isinstance(pbr, dict) else None
    colour = WHITE
    if isinstance(factor, list) and len(factor) == 4:
        numbers = [float(one) for one in factor if isinstance(one, int | float) and math.isfinite(one)]
        if len(numbers) == 4 and all(0.0 <= one <= 1.0 for one in numbers):
            colour = (numbers[0], numbers[1], numbers[2], numbers[3])
    return Material(tidy_name(name) if isinstance(name, str) else "", colour)
