"""What a validation looks at in plain triangles (SPEC.md, section 4.13)."""

import numpy as np

from striptools.reducem.inspection import Inspection
from striptools.reducem.validate_blocks import Geometry, grid_of, inspect_bounds, off_grid

__all__ = ["inspect_triangles"]


def inspect_triangles(inspection: Inspection) -> Geometry | None:
    """Look at the plain triangles of a file; gives their geometry where they are sound."""
    section = inspection.sections["TRIS"]
    n = int.from_bytes(inspection.sections["SCEN"].data[:4], "little")
    if len(section.data) % 12:
        inspection.found("RDM114", "TRIS", section.offset)
        return None
    numbers = np.frombuffer(section.data, "<u4").reshape(-1, 3)
    vertices = len(numbers) - n
    positions, faces = numbers[:vertices].view("<f4"), numbers[vertices:].astype(np.int64)

    def check(code: str, wrong: np.ndarray, word: str, at: int) -> bool:
        return inspection.found_where(
            code,
            np.array(wrong.any(axis=1)),
            lambda i: f"TRIS: {word} {i}",
            lambda i: section.at(at + 12 * i),
        )

    endless = check("RDM575", ~np.isfinite(positions), "vertex", 0)
    if not endless:
        check("RDM204", off_grid(positions.reshape(-1), grid_of(inspection)).reshape(-1, 3), "vertex", 0)
        inspect_bounds(inspection, positions.min(axis=0)[None], positions.max(axis=0)[None])
    outside = check("RDM571", faces >= vertices, "triangle", 12 * vertices)
    # In the order of first use, the first places of all numbers rise with the numbers.
    used, first = np.unique(faces, return_index=True)
    if len(used) < vertices and not outside:
        inspection.found("RDM573", "TRIS", section.offset)
    elif (np.diff(first) < 0).any():
        inspection.found("RDM572", f"TRIS: triangle {first[:-1][np.diff(first) < 0][0] // 3}", section.offset)
    twice = np.stack([faces[:, i] == faces[:, i - 1] for i in range(3)], axis=1)
    check("RDM574", twice, "triangle", 12 * vertices)
    if endless or outside:
        return None
    corners = positions[faces].astype(np.float32)
    ends, begins = np.array([0, n]), np.ones(n, np.bool_)
    return Geometry(ends, begins, ~begins, corners.min(axis=1), corners.max(axis=1), corners)
