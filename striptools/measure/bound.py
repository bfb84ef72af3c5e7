"""How far a float32 tracer may stray: what one ray and one face say for certain, and within what bound.

Source: the watertight test of Woop, Benthin and Wald, "Watertight Ray/Triangle Intersection", JCGT 2(1),
2013; gamma_n = n u / (1 - n u), u = 2^-24, after Higham, "Accuracy and Stability of Numerical Algorithms",
chapter 3.

The test. Let a = v - o for a vertex v and the ray's origin o, z the axis on which the direction d is largest,
x and y the others, S = (d_x, d_y) / d_z, so |S_x|, |S_y| <= 1. The vertex is sheared onto p = (a_x - S_x a_z,
a_y - S_y a_z), which makes the ray the point 0 of a plane. Corner i is weighed by U_i = p_j x p_k (j, k the
other two, in turn), det = U_0 + U_1 + U_2. The ray hits where no two U_i differ in sign and det is not 0, at
t = sum U_i (a_z)_i / d_z / det. M is the largest |component of a| over the face's corners.

The bound, term by term. Everything below is a bound for every order of operations that the tracer may choose,
with multiplications by a reciprocal instead of divisions, fused or not.

1. A sheared vertex. a_x has one rounding; S_x a_z has five (reciprocal, product, a_z, product, difference
   counted once for both). So each coordinate of p moves by at most gamma_7 M, the point by

       delta_v = sqrt(2) gamma_7 M + sqrt(3) D + 2^-122,

   where D is the distance by which the scene's vertices may lie off the source's (`error_bound`; the shear
   stretches a displacement by at most sqrt(3)), and the last term covers flushed denormals. A vertex moves by
   the SAME vector in every face that shares it, and U_i changes sign bit for bit when its edge is run the
   other way: so the float32 test is the exact test of a slightly moved, still closed surface, except for the
   rounding of U_i itself:
2. An edge function. Two products and a difference: rho_i = gamma_3 (|p_j| + delta_v)(|p_k| + delta_v) +
   2^-124.
3. A sign that is certain ("clear"): s U_i > delta_v (|p_j| + |p_k|) + delta_v^2 + 3 rho_i. The first two
   terms are the most that two moved vertices can change a cross product; three times rho_i instead of one
   also rules out that wrongly rounded spokes conspire (see `aimed`: a link edge seen under 180 degrees less 2
   gamma would be needed).
4. An orientation that is certain: |det| > delta_v (perimeter) + 3 delta_v^2 + 2 sum rho_i; what remains is
   det_low.
5. What the test may accept. Each computed U_i has the sign of det or is 0, so s U_i >= -(delta_v (|p_j| +
   |p_k|) + delta_v^2 + rho_i) for every edge. Besides, the ray lies within 8 delta_v of the face (of its
   lines and of its box): delta_v for the moved face, less than 7 for the rounding, which moves a line by
   gamma_3 of its edge. Where the orientation is unclear, that is for faces seen edge-on, both signs s are
   tried, and the 8 delta_v are a demand: rounding alone could accept an edge-on face far away.
6. t. The reported z is a convex combination of the z_i, so z lies in [min z_i, max z_i] and

       |z - z_exact| <= min(|grad z| delta_0 + sum rho_i |z_i - z_exact| / det_low + k D, max z_i - min z_i +
       D) + gamma_12 M,

   with delta_0 = delta_v - sqrt(3) D, and grad z the slope of the face's plane over the sheared plane: the
   tangent of the angle of incidence, which is how the error grows like 1/|cos| at grazing rays. z_exact is
   the plane's z at the ray, clamped to the face's range. k D is D over the cosine: the reported point has
   weights whose point of the source's face lies within D, so it is within D of the source's plane, of unit
   normal n, and along m = (S_x, S_y, 1) as far as D / |n m|. From n = (-grad z, 1 + S grad z) / k follows k
   = 1 / |n m| = sqrt(|grad z|^2 + (1 + S grad z)^2), and |d| |t - t_exact| <= D |m| / |n m| = D / |cos|,
   where there is no rounding. The last rounding terms are those of the sum itself (a_z, 1/d_z, three
   products, four sums, reciprocal, product). The bound of t is that over |d_z|, plus 2^-122 / det_low for
   products that underflow, which no convexity bounds: of an orientation that is not certain 2^-122 / |det|,
   since where products underflow no rounding of larger numbers hides det.
7. u and v come from the same weights. Weights of one sign make sum U_i p_i / det a point of the moved face,
   within stray = sum rho_i (|p_i| + delta_v) / det_low of the ray; u and v have four more roundings. So the
   point (1-u-v) v0 + u v1 + v v2 of the source's corners lies within delta_v + min(stray, max |p_i|) +
   gamma_16 M of the ray in the sheared plane, and its z within gamma_16 M + D of t d_z.
8. How they add up. **The hit point, everywhere**: the point of face, u and v on the source lies within
   lateral + sqrt(3) (gamma_16 M + D) of o + t d (7; sqrt(3) for z along the ray), and within D of the traced
   one, whatever the ray: `hit_point_bound`. **t, per ray**: 6, that is D over the cosine and the rounding's
   part. D itself, a scene's `error_bound`, is the sum of what moved a vertex: welding, rounding from doubles
   (sqrt(3) of the largest), half a cell on each axis of a grid (sqrt(3) / 2 cells, `reducem.quantize`);
   none of them knows of the others. (Doubles without an origin of their own are rounded first: then the
   float32 mesh counts as the source, and the rounding is told by the conversion's report.)
9. A box. With the tracer's own order of operations a sheared coordinate near 0 has four roundings (a_x, a_z,
   S, the product), so it moves by at most gamma_4 M, M <= 2 L with L the largest coordinate of ray and scene;
   some point of a face that is accepted lies within gamma_4 2 L of the ray in x and in y, wherever the ray
   goes through it (`trace.box`, How far: 8uL). A certain face
   needs no more than the slab test's own rounding, since the exact ray meets its box; the widening is for
   faces that are accepted by rounding, so that every hierarchy finds the same: `trace.box` and
   `trace.walk_packed` derive theirs. `beyond_box` tells how much a reported hit needed.

   **Where paths may differ.** All that is across the ray. Along it a box is left out that the ray enters
   beyond the best t, so every path finds a hit whose point o + t d is no farther than 2^-22 L from its face's
   own box: half of the widening, which leaves the slab test more than it needs. 6 does not promise that: z is
   between the corners' z, but where weights are off the point on the ray may be beside them in x and y.
   Weights are off by sum rho_i / det_low on slivers seen obliquely, and by 2^-122 / det_low where products
   underflow, on faces of less than about 2^-98 L^2 as the ray sees them. Such a hit, within its bound but
   outside its box, may be found on one path and hidden, by another within its own bound, on the next: of
   836 520 rays at meshes made to be hostile 20 (19 presorted, 1 rebuilt), of millions at models none.

**The other triangle tests** (`trace.triangle_tests`). What terms 1 to 8 say of the watertight one they say of
these with another unit roundoff in the place of u = 2^-24, for the tracer's part and for that of the judge
itself, whose float64 is no longer finer than what it judges: w = 2^-52, twice that of float64.

10. `exact-sign`. Nothing is moved and no sign is wrong, so 3 to 5 hold with w: what is certain, and what may
    be accepted, is so but for the judge's doubt. t is the watertight one where float32 is sure of all three
    signs, else float64's with weights of one sign: 6 holds as it stands. u and v are float64's, so z of their
    point and t d_z may differ by 6, or by the face's range, as well.
11. `float64`. 1 to 7 hold with w. t is rounded to float32 last, which adds gamma_1 of it to 6; u and v are,
    which adds gamma_1 of the face's longest edge to the distance in 7, and gamma_1 of its range and of z
    along it.
12. `fast`. With s = o - a, e and f the edges from corner a and d = (S_x, S_y, 1), det = e . (d x f), U = s .
    (d x f), V = d . (s x e), T = f . (s x e): each a sum of six products of three numbers. A number has one
    rounding, a product and sum of them five more at most (six for V's and T's order), so each is off by
    gamma_8 of the sum of the sizes of its products; T, times 1 / d_z, by gamma_10. D moves s by D and an edge
    by 2 D on each axis: what that adds to the sum of sizes is added too. Accepted are s U >= -err_U, s V >=
    -err_V and s (U + V) <= |det| + err_det + err_U + err_V, the other way round where a sign is certain; all,
    where det may be zero. Then

        |t - t_exact| <= (err_T + |t_exact| err_det) / (|det| - err_det) + gamma_2 |t_exact|,

    of the plane's t; what it is clamped by is added. There is no convex combination: seen edge-on, t may be
    anything. Which corner is a depends on the order in which the tracer has them: the largest of all three
    counts. Single faces alone are certain: between two of them a ray may slip through. u and v are
    watertight ones, those below 0 taken for 0, so their point lies in the face: within 7's distance and twice
    what is taken, in parts of the farthest corner's (what weights are below 0 exactly, and by 3 over det_low
    at most), no farther than that corner; its z within the face's range of t d_z, and by the error of t.

**Tracers scale** positions and rays by powers of two, which is exact: the bound is that of the scaled frame,
where the scene's largest coordinate is 1 to 2 and the direction's too. There the flushed terms are relative
to the scene, and M < 2^40 is a distance in parts of it: `extremes` judges in that frame.

The bound holds while no product overflows: M < 2^40. Beyond that nothing is called certain. Its own
arithmetic is float64, whose rounding is 2^-29 of the terms above; a face that it cannot tell from a line,
since the ray sees it edge-on, has no exact hit.
"""

from dataclasses import dataclass

import numpy as np

from striptools.types import TriangleTest

UNIT_ROUNDOFF = 2.0**-24
DOUBLE_ROUNDOFF = 2.0**-52
"""Twice that of float64: the tracer's part, and that of the judge."""

LARGEST_COORDINATE = 2.0**40
FLUSHED = 2.0**-122
EDGE_ON = 2.0**-50
"""A face whose doubled area is a smaller part of the products it is made of has none: float64 rounding."""

BISECTIONS = 90
"""Thirds taken off an interval until float64 has no more to say."""

BEYOND_FACE = 8.0
"""How many delta_v from the ray a face may lie and still be reported (term 5 of the head)."""


def gamma(n: int, unit: float = UNIT_ROUNDOFF) -> float:
    """The relative error of n roundings in a row, those of float32 by default: gamma_n = n u / (1 - n u)."""
    return n * unit / (1 - n * unit)


@dataclass(frozen=True)
class RayFrames:
    """Rays taken from float32 to float64, each with the axes and shear that make it the origin of a plane.

    Attributes:
        origins: (r, 3) float64.
        directions: (r, 3) float64, as given: t is in units of their length.
        axes: (r, 3) intp, the axes x, y and z of the shear; z is the one on which the direction is largest.
        shear: (r, 2) float64, d_x / d_z and d_y / d_z.
        depth: (r,) float64, d_z.
        valid: (r,) bool; False for a ray with a non-finite component or a zero direction, which hits nothing.
    """

    origins: np.ndarray
    directions: np.ndarray
    axes: np.ndarray
    shear: np.ndarray
    depth: np.ndarray
    valid: np.ndarray


def frame_rays(origins: np.ndarray, directions: np.ndarray) -> RayFrames:
    """Take float32 rays, (r, 3) origins and directions, into float64 exactly and choose their axes."""
    o = np.asarray(origins, np.float32).astype(np.float64).reshape(-1, 3)
    d = np.asarray(directions, np.float32).astype(np.float64).reshape(-1, 3)
    valid = np.isfinite(o).all(axis=1) & np.isfinite(d).all(axis=1) & (d != 0).any(axis=1)
    o = np.where(valid[:, None], o, 0.0)
    d = np.where(valid[:, None], d, np.array([0.0, 0.0, 1.0]))
    z = np.argmax(np.abs(d), axis=1)
    axes = np.stack([(z + 1) % 3, (z + 2) % 3, z], axis=1)
    turned = np.take_along_axis(d, axes, axis=1)
    return RayFrames(o, d, axes, turned[:, :2] / turned[:, 2:], turned[:, 2].copy(), valid)


@dataclass(frozen=True)
class Pairs:
    """What pairs of one ray and one face say, in the order of the pairs; the module's head derives each.

    Attributes:
        t: (k,) float64, t of the face's plane at the ray, clamped to the face's own range; 0 at a face
            without area.
        t_bound: (k,) float64, by how much a float32 tracer's t of this face may differ from it.
        u: (k,) float64, the weight of the second corner, unclamped.
        v: (k,) float64, the weight of the third corner, unclamped.
        inside: (k,) bool, the exact answer: the ray meets the face, its border included, at t > 0.
        possible: (k,) bool, a float32 tracer may report this face.
        side: (k,) int8, +1 where the ray certainly sees the corners counter-clockwise, -1 clockwise, 0
            unclear. (In the sheared plane of `RayFrames.axes` a negative `depth` mirrors; `side` is what is
            seen.)
        clear: (k, 3) bool, the ray certainly lies on the inner side of the edge opposite each corner.
        ahead: (k,) bool, t is certainly positive.
        lateral: (k,) float64, the bound on the distance between the ray and a reported hit, in the sheared
            plane.
        depth_error: (k,) float64, the bound on the difference of z between t d and the point of u and v.
    """

    t: np.ndarray
    t_bound: np.ndarray
    u: np.ndarray
    v: np.ndarray
    inside: np.ndarray
    possible: np.ndarray
    side: np.ndarray
    clear: np.ndarray
    ahead: np.ndarray
    lateral: np.ndarray
    depth_error: np.ndarray

    @property
    def certain(self) -> np.ndarray:
        """(k,) bool: every float32 tracer within the bound accepts this face for this ray."""
        return (self.side != 0) & self.clear.all(axis=1) & self.ahead

    @property
    def farthest(self) -> np.ndarray:
        """(k,) float64: the largest t that a tracer may report for this face."""
        return self.t + self.t_bound


def shear_points(frames: RayFrames, ray: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Points (k, ..., 3) as rays number `ray`, (k,), see them: sheared x and y, and z along the main axis."""
    shape = (len(ray),) + (1,) * (points.ndim - 2)
    a = points - frames.origins[ray].reshape(*shape, 3)
    a = np.take_along_axis(a, np.broadcast_to(frames.axes[ray].reshape(*shape, 3), a.shape), axis=-1)
    a[..., :2] -= frames.shear[ray].reshape(*shape, 2) * a[..., 2:]
    return a


def lateral_slack(largest: np.ndarray, error_bound: float, unit: float = UNIT_ROUNDOFF) -> np.ndarray:
    """delta_v for corners that lie within `largest` of the ray's origin on every axis."""
    slack = np.sqrt(2.0) * gamma(7, unit) * largest + np.sqrt(3.0) * error_bound + FLUSHED
    return np.where(largest < LARGEST_COORDINATE, slack, np.inf)


def judge_pairs(
    frames: RayFrames,
    ray: np.ndarray,
    corners: np.ndarray,
    error_bound: float = 0.0,
    test: TriangleTest = "watertight",
) -> Pairs:
    """Judge pairs of a ray and a face.

    Args:
        frames: The rays.
        ray: (k,) index of each pair's ray.
        corners: (k, 3, 3) float64, the face's corners, whose components are float32 values.
        error_bound: D, how far the traced vertices may lie off these, in the model's unit.
        test: What the tracer tests triangles by.
    """
    largest = np.abs(corners - frames.origins[ray][:, None]).max(axis=(1, 2)) + error_bound
    sheared = shear_points(frames, ray, corners)
    alive = frames.valid[ray] & np.isfinite(sheared).all(axis=(1, 2))
    seen = _Seen(sheared, frames.shear[ray].T, frames.depth[ray], largest, error_bound, alive)
    with np.errstate(all="ignore"):
        if test == "fast":
            return _judge_fast(seen)
        signs = _PlaneView.of(seen, UNIT_ROUNDOFF if test == "watertight" else DOUBLE_ROUNDOFF)
        weights = signs if test != "exact-sign" else _PlaneView.of(seen, UNIT_ROUNDOFF)
        return _judge_signed(seen, signs, weights, last=gamma(1) if test == "float64" else 0.0)


@dataclass(frozen=True)
class _Seen:
    """Pairs of a ray and a face: corners (k, 3, 3) as the ray sees them, its shear (2, k), depth, and M."""

    sheared: np.ndarray
    shear: np.ndarray
    depth: np.ndarray
    largest: np.ndarray
    error_bound: float
    alive: np.ndarray


def _judge_signed(seen: _Seen, signs: "_PlaneView", weights: "_PlaneView", last: float) -> Pairs:
    """Terms 3 to 7, 10 and 11: signs as one view has them, t and weights as another, all rounded last."""
    rounding = gamma(12, weights.unit) * seen.largest
    z_hit, z_bound = weights.depth_and_bound(rounding, seen.shear, seen.error_bound)
    depth = np.abs(seen.depth)
    t_bound = z_bound / depth + weights.underflow()
    t = z_hit / seen.depth
    t_bound = t_bound + last * (np.abs(t) + t_bound)
    t_bound = np.where(np.isnan(t_bound), np.inf, t_bound)
    side = np.where(signs.det_low > 0, np.sign(signs.det) * np.sign(seen.depth), 0.0)
    rest = gamma(16, weights.unit) * seen.largest
    # U and v of signs that are surer than t have weights of their own.
    apart = 0.0 if signs is weights else np.minimum(t_bound * depth, np.ptp(weights.z, axis=0))
    return Pairs(
        **_exact_numbers(seen, signs, t),
        t_bound=t_bound,
        possible=seen.alive & signs.acceptable() & (t + t_bound > 0),
        side=np.where(seen.alive, side, 0).astype(np.int8),
        clear=signs.clear_edges() & seen.alive[:, None],
        ahead=t - t_bound > 0,
        lateral=weights.stray() + rest + last * weights.edge.max(axis=0),
        depth_error=rest + seen.error_bound + apart + last * (np.abs(z_hit) + 2 * np.ptp(weights.z, axis=0)),
    )


def _exact_numbers(seen: _Seen, plane: "_PlaneView", t: np.ndarray) -> dict[str, np.ndarray]:
    """What a face says of its ray exactly, whatever traces it."""
    inside = seen.alive & plane.inside() & (t > 0)
    return {"t": t, "u": plane.weight(1), "v": plane.weight(2), "inside": inside}


def _judge_fast(seen: _Seen) -> Pairs:
    """Term 12, whichever corner the tracer counts from."""
    plane = _PlaneView.of(seen, UNIT_ROUNDOFF)
    turns = [_FastNumbers(seen, turn) for turn in range(3)]
    low = np.min([turn.low for turn in turns], axis=0)
    t = plane.depth_and_bound(seen.largest, seen.shear, seen.error_bound)[0] / seen.depth
    t_bound = np.max([turn.t_bound + np.abs(t - turn.t) for turn in turns], axis=0)
    # Corners seen in float64 are rounded too: a face thinner than that has no plane whose t could be told.
    told = np.abs(plane.det) > EDGE_ON * seen.largest * plane.edge.max(axis=0)
    t_bound = np.where((low > 0) & told, t_bound, np.inf)
    accepted = np.any([turn.accepted for turn in turns], axis=0) | ~(low > 0)
    outside = np.sum([np.maximum(-plane.weight(corner), 0.0) for corner in range(3)], axis=0)
    outside += (plane.swing + plane.rho).sum(axis=0) / plane.det_low
    farthest = plane.r.max(axis=0) + plane.delta_v
    stray = np.minimum(plane.stray() + 2 * outside * farthest, farthest)
    stray = np.where(plane.det_low > 0, stray, farthest)
    return Pairs(
        **_exact_numbers(seen, plane, t),
        t_bound=t_bound,
        possible=seen.alive & accepted & (t + t_bound > 0),
        side=np.where(seen.alive & (low > 0), np.sign(plane.det * seen.depth), 0).astype(np.int8),
        clear=np.all([turn.clear for turn in turns], axis=0).T & seen.alive[:, None],
        ahead=t - t_bound > 0,
        lateral=stray + gamma(16) * seen.largest + np.sqrt(3.0) * seen.error_bound,
        depth_error=np.ptp(plane.z, axis=0)
        + seen.error_bound
        + gamma(16) * seen.largest
        + t_bound * np.abs(seen.depth),
    )


class _FastNumbers:
    """What Moeller and Trumbore compute of pairs, counting from corner `turn`, and by how much it may be off.

    Attributes:
        low: (k,), what the determinant's size is at the least.
        t: (k,) of the plane.
        t_bound: (k,).
        accepted: (k,) bool, the edges' signs may be those of a hit.
        clear: (3, k) bool, as in `Pairs`.
    """

    def __init__(self, seen: _Seen, turn: int) -> None:
        corners = np.roll(seen.sheared, -turn, axis=1)
        # Back from the sheared plane: the axes of the shear, seen from the origin.
        corners[..., :2] += seen.shear.T[:, None] * corners[..., 2:]
        a, b, c = corners.transpose(1, 0, 2)
        way = np.concatenate([seen.shear.T, np.ones((len(a), 1))], axis=1), 0.0
        start, one, two = (-a, seen.error_bound), (b - a, 2 * seen.error_bound), (c - a, 2 * seen.error_bound)
        det, det_error = _volume(one, way, two, 8)
        u, u_error = _volume(start, way, two, 8)
        v, v_error = _volume(way, start, one, 8)
        over, over_error = _volume(two, start, one, 10)

        sign = np.where(det < 0, -1.0, 1.0)
        edges = sign * np.stack([det - u - v, u, v])
        errors = np.stack([det_error + u_error + v_error, u_error, v_error])
        self.accepted = (edges >= -errors).all(axis=0)
        self.clear = np.roll(edges > errors, turn, axis=0)
        self.low = np.abs(det) - det_error
        along = over / np.where(det != 0, det, 1.0)
        error = (over_error + np.abs(along) * det_error) / self.low + gamma(2) * np.abs(along)
        self.t = along / seen.depth
        self.t_bound = error / np.abs(seen.depth) + FLUSHED / self.low


def _volume(
    a: tuple[np.ndarray, float], b: tuple[np.ndarray, float], c: tuple[np.ndarray, float], roundings: int
) -> tuple[np.ndarray, np.ndarray]:
    """The volume a . (b x c) of vectors (k, 3), each moved on each axis by so much, and how far it is off."""

    def sizes(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
        one, two = (
            np.roll(b, -1, axis=1) * np.roll(c, -2, axis=1),
            np.roll(b, -2, axis=1) * np.roll(c, -1, axis=1),
        )
        return (a * (one + two)).sum(axis=1)

    exact = (a[0] * np.cross(b[0], c[0])).sum(axis=1)
    still = sizes(*(np.abs(vector) for vector, _ in (a, b, c)))
    moved = sizes(*(np.abs(vector) + by for vector, by in (a, b, c)))
    return exact, gamma(roundings) * moved + (moved - still) + FLUSHED


class _PlaneView:
    """Faces in the plane in which their ray is the point 0: rows of `x`, `y`, `z`, `r`, `U` are corners."""

    @classmethod
    def of(cls, seen: _Seen, unit: float) -> "_PlaneView":
        x, y, z = (seen.sheared[..., axis].T for axis in range(3))
        return cls(x, y, z, lateral_slack(seen.largest, seen.error_bound, unit), unit)

    def __init__(self, x: np.ndarray, y: np.ndarray, z: np.ndarray, delta_v: np.ndarray, unit: float) -> None:
        self.x, self.y, self.z, self.delta_v, self.unit = x, y, z, delta_v, unit
        j, k = [1, 2, 0], [2, 0, 1]
        self.cross = x[j] * y[k] - y[j] * x[k]
        self.edge = np.hypot(x[k] - x[j], y[k] - y[j])
        self.r = np.hypot(x, y)
        self.rho = gamma(3, unit) * (self.r[j] + delta_v) * (self.r[k] + delta_v) + FLUSHED / 4
        self.swing = delta_v * (self.r[j] + self.r[k] + delta_v)
        self.det = self.cross.sum(axis=0)
        det_error = delta_v * self.edge.sum(axis=0) + 3 * delta_v**2 + 2 * self.rho.sum(axis=0)
        self.det_low = np.abs(self.det) - det_error

    def inside(self) -> np.ndarray:
        """The exact answer, but for faces so nearly edge-on that float64 cannot tell them from a line."""
        one_sign = (self.cross >= 0).all(axis=0) | (self.cross <= 0).all(axis=0)
        noise = (self.r * np.roll(self.r, 1, axis=0)).sum(axis=0) * EDGE_ON
        return one_sign & (np.abs(self.det) > noise)

    def weight(self, corner: int) -> np.ndarray:
        return np.where(self.det != 0, self.cross[corner] / np.where(self.det != 0, self.det, 1.0), 0.0)

    def clear_edges(self) -> np.ndarray:
        return (np.sign(self.det) * self.cross > self.swing + 3 * self.rho).T

    def stray(self) -> np.ndarray:
        """How far from the ray the point meant by computed weights may lie."""
        rounding = (self.rho * (self.r + self.delta_v)).sum(axis=0) / self.det_low
        farthest = self.r.max(axis=0)
        return self.delta_v + np.where(self.det_low > 0, np.minimum(rounding, farthest), farthest)

    def underflow(self) -> np.ndarray:
        """What products that underflow may add to an error of t."""
        det = np.where(self.det_low > 0, self.det_low, np.abs(self.det))
        return np.where(det > 0, FLUSHED / det, 0.0)

    def acceptable(self) -> np.ndarray:
        reach = BEYOND_FACE * self.delta_v
        slack = np.minimum(self.swing + self.rho, reach * self.edge)
        counter_clockwise = (self.cross >= -slack).all(axis=0)
        clockwise = (self.cross <= slack).all(axis=0)
        either = np.where(self.det > 0, counter_clockwise, clockwise)
        either |= (self.det_low <= 0) & (counter_clockwise | clockwise)
        boxed = (self.x.min(axis=0) <= reach) & (self.x.max(axis=0) >= -reach)
        boxed &= (self.y.min(axis=0) <= reach) & (self.y.max(axis=0) >= -reach)
        return either & boxed | np.isinf(reach)

    def depth_and_bound(
        self, rounding: np.ndarray, shear: np.ndarray, error_bound: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Depth of the face's plane at the ray, clamped to the face's range, and the bound of its error."""
        x, y, z = self.x, self.y, self.z
        low, high = z.min(axis=0), z.max(axis=0)
        det = np.where(self.det != 0, self.det, 1.0)
        depth = np.where(self.det != 0, (self.cross * (z - z[0])).sum(axis=0) / det + z[0], z[0])
        depth = np.clip(depth, low, high)
        rise_1, rise_2 = z[1] - z[0], z[2] - z[0]
        slope_x = (rise_1 * (y[2] - y[0]) - rise_2 * (y[1] - y[0])) / det
        slope_y = (rise_2 * (x[1] - x[0]) - rise_1 * (x[2] - x[0])) / det
        slope = np.hypot(slope_x, slope_y)
        over_cosine = error_bound * np.hypot(slope, 1 + shear[0] * slope_x + shear[1] * slope_y)
        stray = slope * (self.delta_v - np.sqrt(3.0) * error_bound) + over_cosine
        stray += (self.rho * np.abs(z - depth)).sum(axis=0) / self.det_low
        stray = np.where(self.det_low > 0, stray, np.inf)
        return depth, np.minimum(stray, high - low + error_bound) + rounding


def hit_point_bound(pairs: Pairs) -> np.ndarray:
    """(k,) float64: how far the point of face, u and v may lie from o + t d (term 8 of the head)."""
    return pairs.lateral + np.sqrt(3.0) * pairs.depth_error


def beyond_box(frames: RayFrames, ray: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """By how much the boxes of faces must be widened for their rays to meet them (term 9 of the head).

    Args:
        frames: The rays.
        ray: (k,) index of each pair's ray.
        corners: (k, 3, 3) float64.

    Returns:
        (k,) float64, 0 where the ray meets the box as it is.
    """
    low, high = corners.min(axis=1) - frames.origins[ray], corners.max(axis=1) - frames.origins[ray]
    way = frames.directions[ray]

    def outside(t: np.ndarray) -> np.ndarray:
        at = t[:, None] * way
        return np.maximum(np.maximum(low - at, at - high), 0.0).max(axis=1)

    # The distance is convex in t, and least between the places where the main axis enters and leaves.
    z = frames.axes[ray, 2:]
    ends = np.take_along_axis(np.stack([low, high]), z[None], axis=2)[..., 0] / frames.depth[ray]
    begin, end = ends.min(axis=0), ends.max(axis=0)
    for _ in range(BISECTIONS):
        one, two = begin + (end - begin) / 3, end - (end - begin) / 3
        nearer = outside(one) < outside(two)
        begin, end = np.where(nearer, begin, one), np.where(nearer, two, end)
    return outside((begin + end) / 2)
