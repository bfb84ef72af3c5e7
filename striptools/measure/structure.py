"""Are the faces of a scene the faces of its source: each kept one present once, same winding, same corners.

What a scene should hold is what `mesh.clean` keeps of the source. The scene does not say how it was cleaned,
so:

- Where `error_bound` is 0 nothing was moved: positions are compared bit for bit (after rounding to float32),
  and every face that default cleaning keeps has to be there. One that is missing is excused only where an
  equal face (same corners, same winding) is present: duplicates may have been dropped on request.
- Where `error_bound` is D > 0, vertices were welded (or quantised) within D: corners are compared within D,
  and a missing face is excused where it may have collapsed, that is where moving its corners by D can take
  its area: its least altitude is at most 2 D.
- Without a remap the faces are compared as sets with multiplicity. With D > 0 as well there is nothing to
  match them by but their places: then only their number, and each vertex's distance from the source's, are
  checked.
"""

from dataclasses import dataclass

import numpy as np

from striptools.mesh.clean import clean, weld_vertices
from striptools.mesh.mesh import Mesh
from striptools.reducem.placed import Placed
from striptools.reducem.scene import Remap, Scene

SLACK = 1 + 2.0**-20
"""Rounding of the distances compared with D."""


@dataclass(frozen=True)
class Structure:
    """How a scene's faces differ from its source's.

    Attributes:
        expected: Faces that cleaning keeps of the source.
        present: Faces of the scene.
        missing: Expected faces that are not there, less the excused ones.
        unexpected: Faces that are no face of the source, or there twice.
        wrong: Faces whose corners are not their source face's, in the same order.
        excused: Missing faces that an equal face stands for, or that welding may have collapsed.
    """

    expected: int
    present: int
    missing: int
    unexpected: int
    wrong: int
    excused: int

    @property
    def errors(self) -> int:
        """Faces missing, unexpected or wrong."""
        return self.missing + self.unexpected + self.wrong


def compare_structure(scene: Scene | Placed, source: Mesh, kept: np.ndarray | None = None) -> Structure:
    """Compare a scene with the mesh it was made from; the module's head says how.

    Args:
        scene: The scene, or its triangles where its instances stand.
        source: What it was made from, instances in their places too.
        kept: (k,) int32, the faces of the source that cleaning keeps; None to clean it for them.
    """
    kept = clean(source).source_face if kept is None else kept
    if scene.remap is not None:
        return _compare_by_remap(scene, scene.remap, source, kept)
    if scene.error_bound == 0:
        return _compare_as_sets(scene, source, kept)
    return _compare_places(scene, source, kept)


def rounded_positions(source: Mesh) -> np.ndarray:
    """(v, 3) float32 positions, as cleaning rounds them."""
    with np.errstate(over="ignore"):
        return np.asarray(source.positions).astype(np.float32)


def corner_distance(ours: np.ndarray, theirs: np.ndarray) -> np.ndarray:
    """(n,) float64: the largest distance between corresponding corners of (n, 3, 3) faces."""
    return np.linalg.norm(ours.astype(np.float64) - theirs, axis=2).max(axis=1, initial=0)


def _compare_by_remap(scene: Scene | Placed, remap: Remap, source: Mesh, kept: np.ndarray) -> Structure:
    known = (remap.face >= 0) & (remap.face < source.triangle_count)
    face = np.where(known, remap.face, 0)
    seen = np.bincount(face[known], minlength=source.triangle_count)
    positions = rounded_positions(source)
    wrong = 0
    if source.triangle_count:
        turned = (np.arange(3) + remap.rotation[:, None]) % 3
        rows = np.take_along_axis(source.faces[face], turned, axis=1)
        wrong = int(
            (known & _differ(scene.positions[scene.faces()], positions[rows], scene.error_bound)).sum()
        )
    is_kept = np.zeros(source.triangle_count, bool)
    is_kept[kept] = True
    stray = 0 if scene.error_bound > 0 else int(((seen > 0) & ~is_kept).sum())
    missing = kept[seen[kept] == 0]
    excused = _excused(source, positions, missing, np.flatnonzero(seen), scene.error_bound)
    unexpected = int((~known).sum() + np.maximum(seen - 1, 0).sum()) + stray
    return Structure(len(kept), len(face), len(missing) - excused, unexpected, wrong, excused)


def _differ(ours: np.ndarray, theirs: np.ndarray, error_bound: float) -> np.ndarray:
    if error_bound == 0:
        return (np.ascontiguousarray(ours).view(np.uint32) != theirs.view(np.uint32)).any(axis=(1, 2))
    return ~(corner_distance(ours, theirs) <= error_bound * SLACK)


def _excused(
    source: Mesh, positions: np.ndarray, missing: np.ndarray, present: np.ndarray, error_bound: float
) -> int:
    if len(missing) == 0:
        return 0
    leader, _ = weld_vertices(positions)
    rows = least_first(leader[source.faces])
    equal = np.isin(_row_keys(rows[missing]), _row_keys(rows[present]))
    corners = positions[source.faces[missing]].astype(np.float64)
    return int((equal | (_least_altitude(corners) <= 2 * error_bound * SLACK)).sum())


def _least_altitude(corners: np.ndarray) -> np.ndarray:
    a, b, c = corners.transpose(1, 0, 2)
    longest = np.max(
        [np.linalg.norm(b - a, axis=1), np.linalg.norm(c - b, axis=1), np.linalg.norm(a - c, axis=1)], axis=0
    )
    doubled_area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return doubled_area / np.where(longest > 0, longest, 1.0)


def least_first(faces: np.ndarray) -> np.ndarray:
    """Each row turned so that its least vertex comes first: equal rows are then the same face."""
    turn = (np.argmin(faces, axis=1)[:, None] + np.arange(3)) % 3
    return np.ascontiguousarray(np.take_along_axis(faces, turn, axis=1))


def _row_keys(rows: np.ndarray) -> np.ndarray:
    """One comparable item a row."""
    return np.ascontiguousarray(rows.astype(np.int32)).view("V12").reshape(-1)


def _compare_as_sets(scene: Scene | Placed, source: Mesh, kept: np.ndarray) -> Structure:
    leader, _ = weld_vertices(np.concatenate([rounded_positions(source), scene.positions]))
    theirs = least_first(leader[source.faces[kept]])
    ours = least_first(leader[scene.faces() + source.vertex_count])
    rows = np.concatenate([theirs, ours])
    balance = np.where(np.arange(len(rows)) < len(theirs), 1, -1)
    if len(rows) == 0:
        return Structure(0, 0, 0, 0, 0, 0)
    order = np.lexsort(rows.T)
    rows, balance = rows[order], balance[order]
    begins = np.flatnonzero(np.append(True, (rows[1:] != rows[:-1]).any(axis=1)))
    excess = np.add.reduceat(balance, begins)
    present = np.add.reduceat(balance < 0, begins) > 0
    excused = int(excess[(excess > 0) & present].sum())
    missing = int(excess[excess > 0].sum())
    return Structure(len(kept), len(ours), missing - excused, int(-excess[excess < 0].sum()), 0, excused)


def _compare_places(scene: Scene | Placed, source: Mesh, kept: np.ndarray) -> Structure:
    from scipy.spatial import KDTree

    used = np.unique(source.faces[kept])
    if len(used) == 0 or scene.triangle_count == 0:
        return Structure(len(kept), scene.triangle_count, len(kept), scene.triangle_count, 0, 0)
    distance, _ = KDTree(rounded_positions(source)[used].astype(np.float64)).query(scene.positions)
    strayed = distance > scene.error_bound * SLACK
    wrong = int(strayed[scene.faces()].any(axis=1).sum())
    more = max(0, scene.triangle_count - len(kept))
    return Structure(
        len(kept), scene.triangle_count, 0, more, wrong, max(0, len(kept) - scene.triangle_count)
    )
