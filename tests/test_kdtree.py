"""Kd-trees: the slow build, clipping, the check and its faults, hits and counts of walks, Hunt's table."""

from dataclasses import replace
from fractions import Fraction
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rays import rays_at
from scenes import scene_of, scenes, small_scene
from strategies import clean_meshes, cube, grid, line, sphere, stack
from test_trace import far_fetched

from striptools.errors import LimitError, StriptoolsError, UnreadableSceneError, UsageError
from striptools.hierarchies import kdtree as module
from striptools.hierarchies.kdtree import KdTree, build_kdtree, check_kdtree
from striptools.hierarchies.options import HierarchyOptions
from striptools.kernels import kdtree as kernels
from striptools.measure import study_kdtree
from striptools.measure.study import StudyOptions
from striptools.mesh.mesh import Mesh
from striptools.partition.boxes import range_boxes
from striptools.partition.sah import KdCosts
from striptools.trace import Tracer
from striptools.trace.kdtree import MAILBOXES, lay_out_kdtree
from striptools.trace.walk import WalkOptions, trace_rays

METRICS = ("plain", "corrected")
BELOW, ABOVE = 0, 1


def random_boxes(count, seed, lattice=9):
    """Boxes on a lattice: many equal sides, many flat ones."""
    random = np.random.default_rng(seed)
    low = random.integers(-lattice, lattice, (count, 3)).astype(np.float32)
    return np.concatenate([low, low + random.integers(0, 4, (count, 3)).astype(np.float32)], axis=1)


def options_of(metric="corrected", over="triangles"):
    return HierarchyOptions("kdtree", over=over, metric=metric)


def tree_of(scene, metric="corrected", over="triangles", **given):
    """The tree of a scene as a conversion builds it, with what it is checked by."""
    boxes = scene.triangle_boxes(1)
    if over == "triangles":
        corners = scene.positions[scene.faces()]
    else:
        boxes, corners = range_boxes(boxes, scene.objects(over)), None
    return build_kdtree(boxes, options_of(metric, over), corners=corners, **given), boxes, corners


# The build.


def half_area(low, high):
    x, y, z = high.astype(np.float64) - low.astype(np.float64)
    return x * y + y * z + z * x


def cost_of_split(low, high, parts, plane, metric, costs):
    """Hunt's formula or the plain one; the sums are in the build's order, for rounding breaks ties too."""
    axis, position, _ = plane
    wide, whole = high.astype(np.float64) - low, half_area(low, high)
    across, down = wide[(axis + 1) % 3], wide[(axis + 2) % 3]
    both, ring = across * down / whole, (across + down) / whole
    sides = [sides_of(part, *plane) for part in parts]
    below, above = (sum(side in each for each in sides) for side in (BELOW, ABOVE))
    tests = (both + (np.float64(position) - low[axis]) * ring) * below
    tests += (both + (np.float64(high[axis]) - position) * ring) * above
    if metric == "corrected":
        tests -= both * (below + above - len(parts))
    cost = costs.traversal + costs.intersection * tests
    return cost * (1 - costs.empty_bonus) if 0 in (below, above) else cost


def best_slowly(low, high, parts, metric, costs):
    """The plane of least cost of all sides of all parts on every axis; None where a leaf costs no more."""
    least, best = costs.intersection * len(parts), None
    planes = [
        (axis, position, planar_below)
        for axis in range(3)
        for position in sorted({part[side] for part in parts for side in (axis, axis + 3)})
        for planar_below in (True, False)
        if low[axis] < position < high[axis]
    ]
    for plane in planes if half_area(low, high) > 0 else []:
        cost = cost_of_split(low, high, parts, plane, metric, costs)
        if cost < least:
            least, best = cost, plane
    return best


def inside_slowly(things, plane, side):
    """The objects on one side of a plane and their parts."""
    inside = []
    for thing, whole in things:
        sides, part = sides_of(whole, *plane), whole.copy()
        if len(sides) == 2:
            part[plane[0] + (3 if side == BELOW else 0)] = plane[1]
        if side in sides:
            inside.append((thing, part))
    return inside


def built_slowly(boxes, metric, costs):
    """Nodes and leaves by the definition: every plane counted from scratch."""
    deepest = min(module.DEEPEST, costs.deepest(len(boxes)))

    def grow(low, high, things, depth):
        plane = None
        if depth < deepest:
            plane = best_slowly(low, high, [part for _, part in things], metric, costs)
        if plane is None:
            return [("leaf", [thing for thing, _ in things])]
        halves = []
        for side in (BELOW, ABOVE):
            cell = low.copy(), high.copy()
            cell[1 - side][plane[0]] = plane[1]
            halves.append(grow(*cell, inside_slowly(things, plane, side), depth + 1))
        return [(*plane[:2], 1 + len(halves[0])), *halves[0], *halves[1]]

    return grow(boxes[:, :3].min(axis=0), boxes[:, 3:].max(axis=0), list(enumerate(boxes)), 0)


def sides_of(part, axis, position, planar_below):
    if part[axis] == part[axis + 3] == position:
        return (BELOW,) if planar_below else (ABOVE,)
    return tuple(
        side for side, on in ((BELOW, part[axis] < position), (ABOVE, part[axis + 3] > position)) if on
    )


def listed(tree):
    """A tree as `built_slowly` gives it."""
    rows = []
    for place, (one, other) in enumerate(tree.nodes):
        kind = int(other & 3)
        if kind == kernels.LEAF:
            rows.append(("leaf", tree.references[one : one + (other >> 2)].tolist()))
        else:
            rows.append((kind, one.view(np.float32), int(other >> 2) - place))
    return rows


@pytest.mark.parametrize("metric", METRICS)
@given(
    seed=st.integers(0, 2**32 - 1), count=st.integers(1, 24), intersection=st.sampled_from([0.5, 2.0, 20.0])
)
def test_the_fast_build_is_the_slow_one(metric, seed, count, intersection):
    boxes, costs = random_boxes(count, seed, 5), KdCosts(intersection=intersection)
    tree = build_kdtree(boxes, options_of(metric), constants=costs)
    assert listed(tree) == built_slowly(boxes, metric, costs)
    check_kdtree(tree, boxes)


@given(mesh=clean_meshes(), metric=st.sampled_from(METRICS), clipped=st.booleans())
def test_trees_of_every_kind_of_mesh_are_whole(mesh, metric, clipped):
    corners = mesh.positions[mesh.faces]
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    given_corners = corners if clipped else None
    tree = build_kdtree(boxes, options_of(metric), corners=given_corners, constants=KdCosts(intersection=4.0))
    check_kdtree(tree, boxes, corners=given_corners)
    assert set(tree.references.tolist()) == set(range(len(boxes)))


@pytest.mark.parametrize("shape", [stack(20), line(9), grid(8, 5), cube()])
def test_flat_and_repeated_shapes(shape):
    positions, faces = shape
    corners = positions[faces]
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    tree = build_kdtree(boxes, options_of(), corners=corners)
    check_kdtree(tree, boxes, corners=corners)


def test_a_point_is_one_leaf():
    boxes = np.tile(np.array([[1, 2, 3, 1, 2, 3]], np.float32), (5, 1))
    tree = build_kdtree(boxes, options_of())
    assert listed(tree) == [("leaf", [0, 1, 2, 3, 4])]
    check_kdtree(tree, boxes)


@pytest.mark.parametrize("clipped", [False, True])
def test_the_tree_does_not_depend_on_threads_nor_on_jobs(monkeypatch, clipped):
    positions, faces = sphere(3)
    corners = positions[faces]
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    trees = []
    for subtree, threads in ((module.SUBTREE, 1), (40, 1), (40, 3), (1, 2)):
        monkeypatch.setattr(module, "SUBTREE", subtree)
        trees.append(build_kdtree(boxes, options_of(), threads, corners=corners if clipped else None))
    for tree in trees[1:]:
        assert np.array_equal(tree.nodes, trees[0].nodes)
        assert np.array_equal(tree.references, trees[0].references)


def test_the_corrected_metric_splits_what_the_plain_one_does_not():
    # Three long objects side by side: every plane across them leaves all on both sides.
    boxes = np.array([[0, y, 0, 8, y + 1, 1] for y in range(3)] + [[0, 3, 0, 4, 4, 1]], np.float32)
    costs = kernels.Costs(0.01, 1.0, 0.0, False)
    cell = kernels.root_cell(boxes, np.inf)
    assert (
        kernels.best_plane(cell, costs).cost >= kernels.best_plane(cell, costs._replace(corrected=True)).cost
    )


def test_depth_is_bounded():
    boxes = random_boxes(300, 1)
    tree = build_kdtree(boxes, options_of(), constants=KdCosts(intersection=1e6, depth=3, depth_growth=0))
    assert kernels.depth_of(tree.nodes) == 3
    deep = build_kdtree(boxes, options_of(), constants=KdCosts(intersection=1e9, depth=64))
    assert kernels.depth_of(deep.nodes) <= module.DEEPEST
    check_kdtree(deep, boxes)


def test_bad_input_is_refused(monkeypatch):
    boxes = random_boxes(9, 0)
    with pytest.raises(UsageError, match="give"):
        build_kdtree(boxes[:0], options_of())
    with pytest.raises(UsageError, match="not finite or inverted"):
        build_kdtree(boxes[:, [3, 1, 2, 0, 4, 5]] + np.float32(np.nan), options_of())
    with pytest.raises(UsageError, match="corners have shape"):
        build_kdtree(boxes, options_of(), corners=np.zeros((8, 3, 3), np.float32))
    for field, value in (("traversal", 0.0), ("intersection", np.inf), ("empty_bonus", 1.0), ("depth", -1.0)):
        with pytest.raises(UsageError, match="out of range"):
            KdCosts(**{field: value})
    monkeypatch.setattr(module, "MOST_OBJECTS", 8)
    with pytest.raises(LimitError, match="9 objects"):
        build_kdtree(boxes, options_of())


@pytest.mark.parametrize("clipped", [False, True])
def test_a_soup_of_large_triangles_takes_no_more_than_its_room(clipped, monkeypatch):
    corners = np.random.default_rng(0).normal(size=(400, 3, 3)).astype(np.float32)
    boxes = np.concatenate([corners.min(axis=1), corners.max(axis=1)], axis=1)
    sizes = []
    for room in (1, 2, 16, 10**6):
        monkeypatch.setattr(module, "ROOM", room)
        given = {"corners": corners if clipped else None, "constants": KdCosts(intersection=2.0)}
        tree = build_kdtree(boxes, options_of(), **given)
        check_kdtree(tree, boxes, corners=given["corners"])
        sizes.append(len(tree.references) + int((tree.nodes[:, 1] & 3 == kernels.LEAF).sum()))
        assert sizes[-1] <= max(room, 2) * len(boxes) + 1
    assert sizes == sorted(sizes)
    assert sizes[2] > sizes[1] > sizes[0]
    assert sizes[3] > 32 * len(boxes)


# Clipping.


def clipped_exactly(corners, bounds):
    """The box of what of a triangle is in a box, in fractions; None where nothing is."""
    polygon = [[Fraction(float(c)) for c in corner] for corner in corners]
    for side in range(6):
        axis, sign, plane = side % 3, 1 if side < 3 else -1, Fraction(float(bounds[side]))
        kept = []
        for k, here in enumerate(polygon):
            there = polygon[(k + 1) % len(polygon)]
            a, b = sign * (here[axis] - plane), sign * (there[axis] - plane)
            if a >= 0:
                kept.append(here)
            if a * b < 0:
                kept.append([h + a / (a - b) * (t - h) for h, t in zip(here, there, strict=True)])
        polygon = kept
    return [f(p[axis] for p in polygon) for f in (min, max) for axis in range(3)] if polygon else None


@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1.0, 1e-8, 1e8]), lattice=st.booleans())
def test_a_clipped_part_holds_the_exact_one_and_no_more(seed, scale, lattice):
    random = np.random.default_rng(seed)
    corners = random.normal(size=(3, 3)) * scale
    bounds = np.sort(random.normal(size=(2, 3)) * scale, axis=0)
    if lattice:
        corners, bounds = np.round(4 * corners / scale), np.round(2 * bounds / scale)
    corners, bounds = corners.astype(np.float32), bounds.reshape(-1).astype(np.float32)
    whole = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
    exact = clipped_exactly(corners, bounds)
    if exact is None:
        return
    part = whole.copy()
    kernels.clip_part(corners, bounds, part, np.zeros((2, 12, 3)))
    reach = float(np.abs(whole).max())
    low, high = np.array([float(x) for x in exact[:3]]), np.array([float(x) for x in exact[3:]])
    error = reach * 2.0**-22
    assert (part[:3] <= low + reach * 2.0**-50).all()
    assert (part[3:] >= high - reach * 2.0**-50).all()
    assert (part[:3] >= low - error).all()
    assert (part[3:] <= high + error).all()
    inside = (part[:3] >= np.maximum(whole[:3], bounds[:3])) & (part[3:] <= np.minimum(whole[3:], bounds[3:]))
    assert inside.all()
    assert (part[:3] <= part[3:]).all()


# The check.


@pytest.fixture(scope="module")
def ball():
    return scene_of(Mesh(*sphere(2)))


def spoiled(tree, **changes):
    return replace(tree, **{name: np.array(value) for name, value in changes.items()})


def test_faults_are_found(ball):
    tree, boxes, corners = tree_of(ball)
    check_kdtree(tree, boxes, corners=corners)
    nodes, references = tree.nodes, tree.references
    leaf = int(np.flatnonzero((nodes[:, 1] & 3 == 3) & (nodes[:, 1] >> 2 > 1))[0])
    inner = int(np.flatnonzero(nodes[:, 1] & 3 != 3)[1])
    first = int(nodes[leaf, 0])

    def with_node(place, column, value):
        changed = nodes.copy()
        changed[place, column] = value
        return {"nodes": changed}

    def with_reference(place, value):
        changed = references.copy()
        changed[place] = value
        return {"references": changed}

    faults = {
        "a split that is not inside": with_node(inner, 0, np.float32(7).view(np.uint32)),
        "not follow its parent": with_node(inner, 1, nodes[inner, 1] + 4),
        "do not follow those of the leaf before": with_node(leaf, 0, first + 1),
        "do not rise": with_reference(first, references[first + 1]),
        "are no objects": with_reference(first + int(nodes[leaf, 1] >> 2) - 1, len(boxes)),
        "not reached": {"references": np.append(references, np.uint32(0))},
        "no nodes": {"nodes": nodes[:0]},
        "no finite cell": {"low": np.full(3, np.nan, np.float32)},
        "does not hold object": {"high": tree.high * np.float32(0.99)},
    }
    for message, changes in faults.items():
        with pytest.raises(UnreadableSceneError, match=message):
            check_kdtree(spoiled(tree, **changes), boxes, corners=corners)
    with pytest.raises(UnreadableSceneError, match="not follow its parent"):
        check_kdtree(spoiled(tree, nodes=nodes[:-1]), boxes, corners=corners)


def test_an_object_missing_from_any_one_leaf_is_found(ball):
    tree, boxes, corners = tree_of(ball)
    leaves = np.flatnonzero(tree.nodes[:, 1] & 3 == 3)
    full = leaves[tree.nodes[leaves, 1] >> 2 > 0]
    for leaf in full[:: max(1, len(full) // 40)]:
        nodes = tree.nodes.copy()
        place = int(nodes[leaf, 0]) + int(nodes[leaf, 1] >> 2) - 1
        nodes[leaf, 1] -= 4
        nodes[leaves[leaves > leaf], 0] -= 1
        less = spoiled(tree, nodes=nodes, references=np.delete(tree.references, place))
        with pytest.raises(UnreadableSceneError, match=rf"without object {tree.references[place]},"):
            check_kdtree(less, boxes, corners=corners)


def test_an_object_in_a_plane_may_be_on_either_side_but_not_on_none():
    boxes = np.array([[0, 0, 0, 1, 1, 1], [1, 0, 0, 1, 1, 1], [1, 0, 0, 2, 1, 1]], np.float32)
    split = np.float32(1).view(np.uint32)

    def two_leaves(below, above):
        nodes = [[split, 8], [0, 4 * len(below) + 3], [len(below), 4 * len(above) + 3]]
        return KdTree(
            "triangles",
            np.array(nodes, np.uint32),
            np.array(below + above, np.uint32),
            boxes[0, :3],
            boxes[2, 3:],
        )

    for sound in (two_leaves([0, 1], [2]), two_leaves([0], [1, 2]), two_leaves([0, 1], [1, 2])):
        check_kdtree(sound, boxes)
    with pytest.raises(UnreadableSceneError, match="without object 1"):
        check_kdtree(two_leaves([0], [2]), boxes)


def test_a_tree_too_deep_is_found():
    depth = module.DEEPEST + 1
    nodes = np.zeros((2 * depth + 1, 2), np.uint32)
    nodes[:depth, 0] = np.linspace(1, 0.5, depth + 1, dtype=np.float32)[1:].view(np.uint32)
    nodes[:depth, 1] = 4 * (2 * depth - np.arange(depth))
    nodes[depth:, 1] = 3
    boxes = np.array([[0, 0, 0, 1, 1, 1]], np.float32)
    tree = KdTree("triangles", nodes, np.zeros(0, np.uint32), boxes[0, :3], boxes[0, 3:])
    with pytest.raises(UnreadableSceneError, match="deeper"):
        check_kdtree(tree, boxes)


# The walk.


def traced(scene, tree, origins, directions, **given):
    tracer = Tracer(replace(scene, hierarchy=tree), device="cpu", threads=1)
    return tracer.closest_hit(origins, directions, counters=True, **given)


def assert_same_hits(hits, expected, where=slice(None)):
    for name in ("t", "face", "u", "v", "triangle"):
        assert np.array_equal(getattr(hits, name)[where], getattr(expected, name)[where]), name


def sure_of(scene, origins, directions, *hits):
    """Rays whose hits are not noise of triangles smaller than the rounding of their distance."""
    return ~np.any([far_fetched(scene, each, origins, directions) for each in hits], axis=0)


@settings(max_examples=12)
@given(
    scenes(),
    st.integers(0, 2**32 - 1),
    st.sampled_from(["triangles", "strips"]),
    st.sampled_from(METRICS),
    st.sampled_from([0, 4, 8]),
)
def test_hits_are_those_of_the_default_walk(drawn, seed, over, metric, mailbox):
    _, scene = drawn
    origins, directions = rays_at(scene, 400, seed)
    tree, _, _ = tree_of(scene, metric, over, constants=KdCosts(intersection=2.0))
    expected = Tracer(scene, device="cpu", threads=1).closest_hit(origins, directions)
    hits = traced(scene, replace(tree, mailbox=mailbox), origins, directions)
    assert_same_hits(hits, expected, sure_of(scene, origins, directions, hits, expected))


@pytest.mark.parametrize("over", ["triangles", "strips"])
def test_every_mailbox_gives_the_same_hits_and_larger_ones_test_less(over):
    scene = scene_of(Mesh(*sphere(3)), max_length=6)
    origins, directions = rays_at(scene, 3000, 1)
    tree, _, _ = tree_of(scene, over=over)
    expected = Tracer(scene, device="cpu", threads=1)
    hits = [traced(scene, replace(tree, mailbox=size), origins, directions) for size in MAILBOXES]
    for each in hits:
        assert_same_hits(each, expected.closest_hit(origins, directions))
        assert np.array_equal(each.counters.steps, hits[0].counters.steps)
    tests = [int(each.counters.triangles.sum()) for each in hits]
    assert tests == sorted(tests, reverse=True)
    assert tests[0] > tests[3] >= tests[-1] > 0
    tracer = Tracer(replace(scene, hierarchy=tree), device="cpu", threads=1)
    assert np.array_equal(tracer.any_hit(origins, directions), hits[0].hit)


def walked_slowly(scene, tree, origin, direction, t_max):
    """Nodes, leaves and tests of one ray, by recursion over cells and the definition of a mail-box.

    `t_max` is the ray's closest t, so that what is left out for being too far away needs no triangle test.
    """
    frame = lay_out_kdtree(scene, tree).arrays.frame
    origin = origin.astype(np.float64) * float(frame.scale)
    margin = float(frame.margin) * max(np.abs(origin).max(), float(frame.reach))
    way = direction.astype(np.float64)
    counted = SimpleNamespace(nodes=0, leaves=0, triangles=0)
    tested: list[int] = []

    def through(low, high):
        near, far = sorted_times(low, high)
        return max(0.0, near.max()), far.min()

    def sorted_times(low, high):
        one, other = (low - margin - origin) / way, (high + margin - origin) / way
        return np.minimum(one, other), np.maximum(one, other)

    def visit(node, low, high):
        entry, leave = through(low, high)
        if entry > leave or entry > t_max * float(frame.scale):
            return
        word, axis = int(tree.nodes[node, 1]) >> 2, int(tree.nodes[node, 1]) & 3
        if axis == kernels.LEAF:
            counted.leaves += 1
            first = int(tree.nodes[node, 0])
            for thing in tree.references[first : first + word].tolist():
                if tree.mailbox == 0 or thing not in tested[-tree.mailbox :]:
                    tested.append(thing)
                    counted.triangles += 1
            return
        counted.nodes += 1
        split = float(tree.nodes[node, 0].view(np.float32)) * float(frame.scale)
        cells = [(node + 1, low, np.where(np.arange(3) == axis, split, high))]
        cells.append((word, np.where(np.arange(3) == axis, split, low), high))
        for cell in cells if way[axis] > 0 else reversed(cells):
            visit(*cell)

    visit(
        0, tree.low.astype(np.float64) * float(frame.scale), tree.high.astype(np.float64) * float(frame.scale)
    )
    return counted


@pytest.mark.parametrize("mailbox", [0, 2, 8])
def test_counts_are_those_of_a_slow_walk(mailbox):
    scene = scene_of(Mesh(*sphere(2)))
    tree = replace(tree_of(scene)[0], mailbox=mailbox)
    random = np.random.default_rng(5)
    origins = (random.normal(size=(60, 3)) * 2).astype(np.float32)
    directions = (random.normal(size=(60, 3)) * 0.3 - origins).astype(np.float32)
    # Where a ray misses, no cell is left out for a hit.
    misses = np.flatnonzero(~traced(scene, tree, origins, directions).hit)
    directions[misses[:5]] *= -1
    hits = traced(scene, tree, origins, directions)
    counters = hits.counters
    boxes = counters.boxes
    assert np.array_equal(boxes, counters.nodes + 1)
    assert np.array_equal(counters.node_bytes, 8 * counters.steps)
    for ray in np.flatnonzero(~hits.hit):
        slow = walked_slowly(scene, tree, origins[ray], directions[ray], np.inf)
        fast = [int(column[ray]) for column in (counters.nodes, counters.leaves, counters.triangles)]
        assert fast == [slow.nodes, slow.leaves, slow.triangles]
    for ray in np.flatnonzero(hits.hit):
        everything = walked_slowly(scene, tree, origins[ray], directions[ray], np.inf)
        least = walked_slowly(scene, tree, origins[ray], directions[ray], hits.t[ray] * (1 - 1e-4))
        assert least.nodes <= counters.nodes[ray] <= everything.nodes
        assert least.leaves <= counters.leaves[ray] <= everything.leaves


def test_walking_all_rays_at_once_gives_the_same():
    scene = small_scene()
    tree, _, _ = tree_of(scene)
    layout = lay_out_kdtree(scene, tree)
    origins, directions = rays_at(scene, 64, 3)
    t_max = np.full(64, np.inf, np.float32)
    options = WalkOptions(1, any_hit=False, counting=True, stack_size=16)
    one = trace_rays(layout.arrays, origins, directions, t_max, options)
    other = trace_rays(layout.arrays, origins, directions, t_max, options._replace(batch=True))
    for name in ("t", "name", "counters"):
        assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_a_ray_is_not_walked_where_it_misses_the_root(ball):
    tree, _, _ = tree_of(ball)
    hits = traced(ball, tree, np.array([[0, 9, 9]]), np.array([[1.0, 0, 0]]))
    assert [int(column[0]) for column in hits.counters] == [0, 0, 1, 0, 0, 0]


def test_a_hit_beyond_t_max_does_not_count(ball):
    tree, _, _ = tree_of(ball)
    for t_max in (1.5, 4.0):
        given = (ball, np.array([[0.01, 0.02, 3.0]]), np.array([[0, 0, -1.0]]))
        hits = traced(given[0], tree, *given[1:], t_max=t_max)
        assert bool(hits.hit[0]) == (t_max > 2.1)


def test_a_tree_that_goes_round_is_stopped(ball):
    tree, _, _ = tree_of(ball)
    layout = lay_out_kdtree(ball, tree)
    tracer = Tracer(replace(ball, hierarchy=tree), device="cpu", threads=1)
    round_and_round = np.zeros_like(layout.arrays.nodes)
    round_and_round[:] = [np.float32(0).view(np.int32), 0]
    layout = replace(layout, arrays=layout.arrays._replace(nodes=round_and_round))
    tracer._take(layout)
    with pytest.raises(StriptoolsError, match="did not end"):
        tracer.closest_hit(np.array([[3.0, 0.1, 0.2]]), np.array([[-1.0, 0, 0]]))


def test_a_mailbox_has_one_of_a_few_sizes(ball):
    tree, _, _ = tree_of(ball)
    with pytest.raises(UsageError, match="no size of a mail-box"):
        lay_out_kdtree(ball, tree, mailbox=3)


# Hunt's table.


@pytest.fixture(scope="module")
def hunt():
    from benches.forest import forest

    return study_kdtree.study(forest(4, [], 1), StudyOptions(side=64, runs=1, device="cpu", threads=1))


def test_the_correction_does_on_a_forest_what_the_paper_says(hunt):
    boxed = [
        (plain, corrected)
        for plain, corrected in study_kdtree.pairs(hunt)
        if plain.over == "triangles" and plain.mailbox == 8
    ]
    for plain, corrected in boxed:
        for kind in ("primary", "secondary"):
            before, after = getattr(plain, kind), getattr(corrected, kind)
            assert study_kdtree.change(before.tests, after.tests) <= -0.2
            assert study_kdtree.change(before.steps, after.steps) <= 0.06


def test_the_study_is_printed_and_drawn(hunt, tmp_path):
    titles = [title for title, _ in study_kdtree.tables(hunt)]
    assert [len(rows) for _, rows in study_kdtree.tables(hunt)] == [7, 7, 4]
    assert "primary rays on" in titles[0]
    rows = study_kdtree.tables(hunt)[0][1]
    assert round(rows[-1]["tests_%"], 1) == -26.6
    assert round(rows[-1]["steps_%"], 2) == 3.58
    assert study_kdtree.plot(hunt, tmp_path / "hunt.png", "forest") > 10_000


def test_mailboxes_help_and_change_no_step(hunt):
    by = {(t.over, t.metric, t.mailbox): t for t in hunt.trials}
    for over in ("triangles", "strips"):
        for metric in METRICS:
            none, some = by[over, metric, 0], by[over, metric, 8]
            assert none.primary.steps == some.primary.steps
            assert some.primary.tests < none.primary.tests
