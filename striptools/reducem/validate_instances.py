"""What a validation looks at in geometries and instances (SPEC.md, sections 4.10 and 4.11)."""

from fractions import Fraction
from typing import NamedTuple

import numpy as np

from striptools.reducem.inspection import Inspection, Section

__all__ = ["Parts", "inspect_geometries", "inspect_instances", "inspect_owners"]

_INSTANCE = np.dtype([("geometry", "<u4"), ("first_face", "<u4"), ("matrix", "<f8", (3, 4))])


class Parts(NamedTuple):
    """The geometries of a file: (g+1,) first blocks and first nodes over blocks, then how many there are."""

    blocks: np.ndarray
    tops: np.ndarray


def inspect_geometries(inspection: Inspection) -> Parts | None:
    """Look at the geometries.

    Returns:
        Which blocks and nodes over blocks each has, one having all where there is no GEOM; None where it is
        there and does not tell.
    """
    blocks, top = (int(x) for x in np.frombuffer(inspection.sections["SCEN"].data, "<u4")[[1, 3]])
    there = [kind in inspection.sections or kind in inspection.undecoded for kind in ("GEOM", "INST")]
    if any(there) and not all(there):
        inspection.found("RDM113", "INST" if there[0] else "GEOM", 32)
    if not there[0]:
        return Parts(np.array([0, blocks]), np.array([0, top]))
    if "GEOM" not in inspection.sections:
        return None
    section = inspection.sections["GEOM"]
    if len(section.data) % 16:
        inspection.found("RDM114", "GEOM", section.offset)
        return None
    rows = np.frombuffer(section.data, "<u4").reshape(-1, 4).astype(np.int64)
    parts = Parts(np.append(rows[:, 0], blocks), np.append(rows[:, 1], top))
    has_blocks, has_tops = np.diff(parts.blocks), np.diff(parts.tops)
    wrong = (has_blocks < 1) | (has_tops < 0) | ((has_tops > 0) != (has_blocks > 1))
    wrong[0] |= rows[0, 0] != 0 or rows[0, 1] != 0
    unsound = _found(inspection, "RDM541", wrong, section, 16)
    _source_faces(inspection, section, rows, None if unsound else parts)
    return None if unsound else parts


def _source_faces(inspection: Inspection, section: Section, rows: np.ndarray, parts: Parts | None) -> None:
    """Look at the source faces of geometries."""
    source_faces = int(np.frombuffer(inspection.sections["SCEN"].data, "<u4")[5])
    wrong = rows[:, 2] + rows[:, 3] > np.append(rows[1:, 2], source_faces)
    counts = _block_triangles(inspection)
    if parts is not None and counts is not None:
        wrong |= rows[:, 3] < np.add.reduceat(counts, parts.blocks[:-1])
    _found(inspection, "RDM542", wrong, section, 16)


def inspect_owners(inspection: Inspection, parts: Parts | None) -> None:
    """Look whether triangles come from source faces of their own geometries."""
    counts = _block_triangles(inspection)
    if parts is None or counts is None or "GEOM" not in inspection.sections:
        return
    rows = np.frombuffer(inspection.sections["GEOM"].data, "<u4").reshape(-1, 4).astype(np.int64)
    section = inspection.sections["RMAP"]
    triangles = int(np.frombuffer(inspection.sections["SCEN"].data, "<u4")[0])
    owner = np.repeat(np.repeat(np.arange(len(rows)), np.diff(parts.blocks)), counts)
    if len(owner) != triangles:
        return
    face = np.frombuffer(section.data, "<u4", triangles).astype(np.int64) - rows[owner, 2]
    inspection.found_where(
        "RDM543",
        (face < 0) | (face >= rows[owner, 3]),
        lambda t: f"RMAP: triangle {t}",
        lambda t: section.at(4 * t),
    )


def inspect_instances(inspection: Inspection) -> None:
    """Look at the instances."""
    section = inspection.sections["INST"]
    if len(section.data) % _INSTANCE.itemsize:
        return inspection.found("RDM114", "INST", section.offset)
    rows = np.frombuffer(section.data, _INSTANCE)
    _matrices(inspection, section, rows["matrix"])
    if "GEOM" not in inspection.sections or len(inspection.sections["GEOM"].data) % 16:
        return None
    geometries = np.frombuffer(inspection.sections["GEOM"].data, "<u4").reshape(-1, 4).astype(np.int64)
    outside = rows["geometry"] >= len(geometries)
    if _found(inspection, "RDM551", outside, section, 104):
        return None
    if len(set(rows["geometry"].tolist())) < len(geometries):
        inspection.found("RDM551", "INST: a geometry without one", section.offset)
    first = rows["first_face"].astype(np.int64)
    ends = first + geometries[rows["geometry"], 3]
    _found(inspection, "RDM554", ends > np.append(first[1:], 2**32 - 1), section, 104)
    return None


def _matrices(inspection: Inspection, section: Section, matrices: np.ndarray) -> None:
    """Look at the matrices: finite, with a determinant that is not zero, and within reach."""
    flat = np.array(~np.isfinite(matrices).all(axis=(1, 2)))
    for i in np.flatnonzero(~flat):
        flat[i] = _is_flat(matrices[i].tolist())
    _found(inspection, "RDM552", flat, section, 104)
    bounds = np.frombuffer(inspection.sections["SCEN"].data, "<f4", 6, 40).astype(np.float64)
    with np.errstate(all="ignore"):
        x, y, z = np.abs(bounds).reshape(2, 3).max(axis=0)
        m = np.abs(matrices)
        far = ((m[:, :, 0] * x + m[:, :, 1] * y) + m[:, :, 2] * z) + m[:, :, 3]
        beyond = ~(far <= 2.0**127).all(axis=1)
    _found(inspection, "RDM553", beyond & ~flat, section, 104)


def _is_flat(rows: list[list[float]]) -> bool:
    """Whether the determinant of the first three columns is zero, in real numbers."""
    (a, b, c), (d, e, f), (g, h, i) = ([float(x) for x in row[:3]] for row in rows)
    if b == c == d == f == g == h == 0.0:
        return a == 0.0 or e == 0.0 or i == 0.0
    exact = [[Fraction(x) for x in row] for row in ((a, b, c), (d, e, f), (g, h, i))]
    # Take the first column out of the other rows; what is left is a determinant of two.
    exact.sort(key=lambda row: row[0] == 0)
    top = exact[0]
    if top[0] == 0:
        return True
    two = [[row[j] - row[0] / top[0] * top[j] for j in (1, 2)] for row in exact[1:]]
    return two[0][0] * two[1][1] == two[0][1] * two[1][0]


def _block_triangles(inspection: Inspection) -> np.ndarray | None:
    """(b,) int64, the triangles of each block."""
    if "BLKH" not in inspection.sections:
        return None
    headers = np.frombuffer(inspection.sections["BLKH"].data, np.uint8).reshape(-1, 32)
    return headers[:, 8].astype(np.int64) + 1


def _found(inspection: Inspection, code: str, wrong: np.ndarray, section: Section, size: int) -> bool:
    word = "geometry" if section.kind == "GEOM" else "instance"
    return inspection.found_where(
        code, wrong, lambda i: f"{section.kind}: {word} {i}", lambda i: section.at(size * i)
    )
