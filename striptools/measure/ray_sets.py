"""The rays that prove a scene: camera, secondary, aimed at edges and vertices, from inside a closed mesh."""

from dataclasses import dataclass

import numpy as np

from striptools.measure.aimed import Fans, Surface, aim
from striptools.measure.oracle import Oracle, OracleHits
from striptools.trace.rays import Camera, camera_rays, cosine_rays, to_float32
from striptools.types import RayVectors

VIEWS = ((0.55, 0.38, 1.0), (-1.0, 0.25, -0.6), (0.2, -0.9, 0.4))
INSIDE_PLACES = 8
LIFT = 1e-5
"""How far off the surface secondary rays start, in parts of the diagonal: beyond the float32 bound."""


@dataclass(frozen=True)
class RaySet:
    """Rays of one kind.

    Attributes:
        name: What the report calls them.
        origins: (r, 3) float32.
        directions: (r, 3) float32.
        fans: For aimed rays, the faces round each one's target.
        inside: Whether the rays start inside a closed mesh, so that each has to hit.
    """

    name: str
    origins: RayVectors
    directions: RayVectors
    fans: Fans | None = None
    inside: bool = False

    def __len__(self) -> int:
        return len(self.origins)

    def part(self, first: int, last: int, name: str) -> "RaySet":
        """Rays first:last, under a name of their own."""
        rays = slice(first, last)
        fans = None if self.fans is None else self.fans.part(first, last)
        return RaySet(name, self.origins[rays], self.directions[rays], fans, self.inside)


def camera_set(points: np.ndarray, count: int, random: np.random.Generator) -> RaySet:
    """`count` rays through pixels of three cameras that frame `points`, drawn without repetition."""
    resolution = max(8, int(np.ceil(np.sqrt(count / len(VIEWS)))))
    shares = np.diff(np.linspace(0, count, len(VIEWS) + 1).astype(int))
    origins, directions = [], []
    for view, share in zip(VIEWS, shares, strict=True):
        o, d = camera_rays(Camera.framing(points, width=resolution, height=resolution, view=view))
        chosen = np.sort(random.permutation(len(o))[:share])
        origins.append(o[chosen])
        directions.append(d[chosen])
    return RaySet("camera", np.concatenate(origins), np.concatenate(directions))


def secondary_set(oracle: Oracle, camera: RaySet, hits: OracleHits, count: int, seed: int) -> RaySet:
    """`count` cosine-distributed rays from where camera rays hit, on the side they came from."""
    hit = np.flatnonzero(hits.face >= 0)
    if len(hit) == 0 or count == 0:
        return camera.part(0, 0, "secondary")
    chosen = hit[np.random.default_rng(seed).integers(0, len(hit), count)]
    direction = camera.directions[chosen].astype(np.float64)
    points = camera.origins[chosen] + hits.t[chosen, None] * direction
    a, b, c = oracle.positions[oracle.faces[hits.face[chosen]]].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals *= -np.sign((normals * direction).sum(axis=1, keepdims=True))
    offset = LIFT * oracle.diagonal + 2.0**-20 * np.abs(points).max(axis=1)
    return RaySet("secondary", *cosine_rays(points, normals, seed=seed, offset=offset))


def aimed_sets(surface: Surface, bounds: np.ndarray, count: int, random: np.random.Generator) -> list[RaySet]:
    """`count` rays each at midpoints of edges and at vertices, drawn with repetition."""
    if len(surface.edges) == 0 or count == 0:
        return []
    edges = surface.edges[random.integers(0, len(surface.edges), count)]
    at_edges = aim(surface.edge_midpoints(edges), surface.normals_at(edges), bounds, random)
    places = random.integers(0, len(surface.vertices), count)
    targets = surface.positions[surface.vertices[places]].astype(np.float64)
    at_vertices = aim(targets, surface.normals_at(surface.corner_at(places)), bounds, random)
    return [
        RaySet("edges", *at_edges, surface.edge_fans(edges)),
        RaySet("vertices", *at_vertices, surface.vertex_fans(places)),
    ]


def inside_sets(
    oracle: Oracle,
    surface: Surface,
    camera: RaySet,
    hits: OracleHits,
    count: int,
    random: np.random.Generator,
) -> list[RaySet]:
    """`count` rays from inside a closed mesh at midpoints of edges and at vertices; none for an open mesh."""
    if not surface.closed or count < 2:
        return []
    places = find_inside(oracle, camera, hits)
    if len(places) == 0:
        return []
    half = count // 2
    edges = surface.edges[random.integers(0, len(surface.edges), half)]
    vertices = random.integers(0, len(surface.vertices), count - half)
    middles = surface.edge_midpoints(edges)
    corners = surface.positions[surface.vertices[vertices]].astype(np.float64)
    at_edges = places[random.integers(0, len(places), half)]
    at_vertices = places[random.integers(0, len(places), count - half)]
    return [
        RaySet("inside, edges", at_edges, _towards(middles, at_edges), surface.edge_fans(edges), True),
        RaySet(
            "inside, vertices",
            at_vertices,
            _towards(corners, at_vertices),
            surface.vertex_fans(vertices),
            True,
        ),
    ]


def _towards(targets: np.ndarray, origins: np.ndarray) -> np.ndarray:
    return to_float32(targets - origins.astype(np.float64))


def find_inside(oracle: Oracle, camera: RaySet, hits: OracleHits) -> np.ndarray:
    """Up to `INSIDE_PLACES` float32 points, (k, 3), that the surface winds round: between a ray's two hits.

    A place counts where a ray from it crosses the surface only at certain hits, and these face away more
    often than they face the ray, or less often: the winding number is then not 0.
    """
    exact = np.flatnonzero(hits.candidates.pairs.inside)
    ray, t = hits.candidates.ray[exact], hits.candidates.pairs.t[exact]
    first = (
        np.flatnonzero((ray[1:] == ray[:-1]) & np.append(True, ray[1:-1] != ray[:-2]))
        if len(ray) > 1
        else ray[:0]
    )
    gap = t[first + 1] - t[first]
    widest = first[np.argsort(-gap, kind="stable")[:INSIDE_PLACES]]
    chosen, middle = ray[widest], (t[widest] + t[widest + 1]) / 2
    places = to_float32(camera.origins[chosen] + middle[:, None] * camera.directions[chosen])
    found = oracle.closest_hit(places, camera.directions[chosen]).candidates
    winding = np.bincount(found.ray, weights=found.pairs.side, minlength=len(places))
    doubt = np.bincount(found.ray, weights=~found.pairs.certain, minlength=len(places))
    return places[(winding != 0) & (doubt == 0)]
