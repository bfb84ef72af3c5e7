"""The hierarchy made for tracing alone: triangles cut into pieces, subtrees reinserted, hits as before."""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from rays import rays_at
from scenes import scene_of
from strategies import clean_meshes, sphere
from test_trace import clean
from test_wide import random_tree, wide_cost

from striptools.hierarchies import pieces
from striptools.hierarchies.in_strip import BinaryTree
from striptools.hierarchies.pieces import boxes_of_pieces
from striptools.hierarchies.rebuilt import rebuild, rebuild_pieces
from striptools.hierarchies.reinsertion import reinsert
from striptools.hierarchies.wide import cheapest, check_wide_tree
from striptools.kernels import reinsertion as kernels
from striptools.kernels.hierarchy import boxes_from_below
from striptools.mesh.mesh import Mesh
from striptools.partition.boxes import face_boxes
from striptools.partition.sah import half_area
from striptools.trace import Tracer, functional


def pipes(count=60, seed=3, divisions=3):
    """A small sphere among long thin triangles that lie askew: what a plant's pipes do to boxes."""
    random = np.random.default_rng(seed)
    middle = random.uniform(-1, 1, (count, 3))
    way = random.normal(size=(count, 3))
    way *= 6 / np.linalg.norm(way, axis=1, keepdims=True)
    wide = 0.02 * random.normal(size=(count, 3))
    corners = np.stack([middle - way, middle + way, middle + way + wide], axis=1).reshape(-1, 3)
    positions, faces = sphere(divisions)
    thin = len(positions) + np.arange(3 * count).reshape(-1, 3)
    return clean(
        (
            np.concatenate([positions, corners]).astype(np.float32),
            np.concatenate([faces, thin]).astype(np.int32),
        )
    )


def uncovered(positions, faces, boxes, triangle, count=12, seed=0):
    """How many of random points of each triangle, exact fractions, are in none of its boxes."""
    random = np.random.default_rng(seed)
    found = 0
    for face in range(len(faces)):
        mine = [[Fraction(float(side)) for side in box] for box in boxes[triangle == face]]
        corners = [[Fraction(float(x)) for x in positions[v]] for v in faces[face]]
        for _ in range(count):
            cuts = sorted(Fraction(int(k), 4096) for k in random.integers(0, 4097, 2))
            weights = cuts[0], cuts[1] - cuts[0], 1 - cuts[1]
            point = [sum(w * c[k] for w, c in zip(weights, corners, strict=True)) for k in range(3)]
            held = any(all(box[k] <= point[k] <= box[3 + k] for k in range(3)) for box in mine)
            found += not held
    return found


def test_pieces_cover_their_triangles_exactly():
    positions, faces = pipes()
    boxes, triangle = boxes_of_pieces(positions, faces)
    assert len(faces) < len(boxes) <= len(faces) * (1 + 1 / pieces.CUT_ABOVE)
    assert (np.diff(triangle) >= 0).all()
    assert np.array_equal(np.unique(triangle), np.arange(len(faces)))
    assert uncovered(positions, faces, boxes, triangle) == 0
    # They lie within the triangle's own box, and are smaller in all.
    own = face_boxes(positions, faces)
    assert (boxes[:, :3] >= own[triangle, :3]).all()
    assert (boxes[:, 3:] <= own[triangle, 3:]).all()
    cut = np.bincount(triangle) > 1
    areas = np.bincount(triangle, half_area(boxes))
    assert (areas[cut] < 0.7 * half_area(own)[cut]).all()
    np.testing.assert_array_equal(boxes[~cut[triangle]], own[~cut])


def test_a_piece_too_small_is_noticed():
    positions, faces = pipes()
    boxes, triangle = boxes_of_pieces(positions, faces)
    spoilt = boxes.copy()
    spoilt[:, 3] -= np.float32(1e-2) * (boxes[:, 3] - boxes[:, 0])
    assert uncovered(positions, faces, spoilt, triangle) > 0


@given(clean_meshes())
def test_pieces_of_any_mesh(mesh):
    boxes, triangle = boxes_of_pieces(mesh.positions, mesh.faces)
    assert uncovered(mesh.positions, mesh.faces, boxes, triangle, count=2) == 0
    assert len(mesh.faces) <= len(boxes) <= len(mesh.faces) * (1 + 1 / pieces.CUT_ABOVE)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_pieces_at_the_ends_of_float32(scale):
    positions, faces = pipes(20)
    far = (positions.astype(np.float64) * scale).astype(np.float32)
    boxes, triangle = boxes_of_pieces(far, faces)
    assert len(boxes) > len(faces)
    assert uncovered(far, faces, boxes, triangle, count=4) == 0


def test_triangles_of_one_size_stay_whole():
    positions, faces = clean(sphere(4))
    boxes, triangle = boxes_of_pieces(positions, faces)
    np.testing.assert_array_equal(boxes, face_boxes(positions, faces))
    np.testing.assert_array_equal(triangle, np.arange(len(faces)))


def linked(tree):
    """A tree linked both ways, and room for searches."""
    nodes = len(tree.size)
    links = kernels.Links(
        np.zeros(nodes, np.int32), np.zeros((nodes, 2), np.int32), np.zeros((nodes, 6), np.float32)
    )
    kernels.link(tree.size, tree.boxes, np.zeros(nodes, bool), links)
    return links, kernels.Search(np.zeros(4096, np.int32), np.zeros(4096), np.zeros((1, 6), np.float32))


def area_with(links, x, place):
    """The area of all inner nodes with subtree x beside `place`: the tree is taken apart and put together."""
    children = {p: list(map(int, pair)) for p, pair in enumerate(links.children) if pair[0] >= 0}
    parent = int(links.parent[x])
    there = children[parent][1 - children[parent].index(x)]
    above = int(links.parent[parent])
    children[above][children[above].index(parent)] = there
    for pair in children.values():
        if place in pair:
            pair[pair.index(place)] = parent
            break
    children[parent] = [place, x]

    def boxed(p):
        if p not in children:
            return links.boxes[p], 0.0
        (left, a), (right, b) = boxed(children[p][0]), boxed(children[p][1])
        box = np.concatenate([np.minimum(left[:3], right[:3]), np.maximum(left[3:], right[3:])])
        return box, a + b + half_area(box[None])[0]

    return boxed(0)[1]


@pytest.mark.parametrize("seed", range(4))
def test_a_subtree_goes_where_trying_every_place_says(seed):
    tree, _ = random_tree(40, seed)
    links, search = linked(tree)
    before, saving = kernels.inner_area(links), 0
    for x in range(1, len(tree.size)):
        parent = int(links.parent[x])
        if parent == 0:
            continue
        there = int(links.children[parent].sum()) - x
        below = set(range(x, x + 2 * int(tree.size[x]) - 1))
        places = set(range(1, len(tree.size))) - below - {parent, there}
        best = max(before - area_with(links, x, p) for p in places)
        changed, _ = linked(tree)
        moved, saved = kernels.move_each(changed, np.array([x], np.int32), 0.0, 10**6, search)
        assert bool(moved) == (best > 1e-9)
        assert saved == pytest.approx(max(best, 0), abs=1e-6 * before)
        assert kernels.inner_area(changed) == pytest.approx(before - saved, abs=1e-6 * before)
        saving += moved
    assert saving


@pytest.mark.parametrize("count", [1, 2, 3, 40, 600])
def test_reinserted_trees_are_whole_and_no_dearer(count):
    tree, boxes = random_tree(count, seed=count)
    order = np.random.default_rng(count).permutation(count).astype(np.int32)
    old = np.zeros_like(boxes)
    old[order] = boxes
    kept = cheapest(tree).as_leaf
    moved, items = reinsert(tree, order, kept)
    assert np.array_equal(np.sort(items), np.arange(count))
    np.testing.assert_array_equal(moved.boxes, boxes_from_below(moved.size, old[items]))
    assert half_area(moved.boxes).sum() <= half_area(tree.boxes).sum() * (1 + 1e-6)
    # What became a leaf of the wide tree is as it was.
    leaves = {tuple(sorted(order[p.start : p.stop])) for p in kept_runs(tree, kept)}
    assert leaves <= {tuple(sorted(items[k : k + n])) for k, n in runs(moved)}


def halved(count):
    """Sizes of a tree that halves its items as they come."""
    return [count, *halved((count + 1) // 2), *halved(count // 2)] if count > 1 else [1]


def test_reinsertion_makes_a_tree_over_shuffled_triangles_cheaper():
    boxes = np.random.default_rng(1).permutation(face_boxes(*pipes()))
    size = np.array(halved(len(boxes)), np.int32)
    tree = BinaryTree(boxes_from_below(size, boxes), size)
    nothing_kept = np.zeros(len(size), bool)
    moved, items = reinsert(tree, np.arange(len(boxes), dtype=np.int32), nothing_kept)
    np.testing.assert_array_equal(moved.boxes, boxes_from_below(moved.size, boxes[items]))
    assert half_area(moved.boxes).sum() < 0.7 * half_area(tree.boxes).sum()
    assert cheapest(moved).cost < 0.7 * cheapest(tree).cost


def runs(tree):
    """The first leaf of each node and how many it has."""
    first = np.zeros(len(tree.size), int)
    for p in range(len(tree.size)):
        if tree.size[p] > 1:
            first[p + 1], first[p + 2 * tree.size[p + 1]] = first[p], first[p] + tree.size[p + 1]
    return list(zip(first.tolist(), tree.size.tolist(), strict=True))


def kept_runs(tree, kept):
    """The leaves of each highest node that is kept."""
    found, all_runs, p = [], runs(tree), 0
    while p < len(tree.size):
        if kept[p] or tree.size[p] == 1:
            first, count = all_runs[p]
            found.append(range(first, first + count))
            p += 2 * int(tree.size[p]) - 1
        else:
            p += 1
    return found


def test_a_heap_of_equal_boxes_ends():
    boxes = np.tile(np.array([[0, 0, 0, 1, 1, 1]], np.float32), (5000, 1))
    wide, order = rebuild(boxes)
    check_wide_tree(wide, boxes[order])


@given(clean_meshes(), st.integers(1, 8))
def test_rebuilt_trees_are_whole(mesh, leaf_size):
    boxes = face_boxes(mesh.positions, mesh.faces)
    wide, order = rebuild(boxes, leaf_size=leaf_size)
    check_wide_tree(wide, boxes[order])
    assert np.array_equal(np.sort(order), np.arange(len(boxes)))
    assert wide.leaf_count.max() <= leaf_size


def test_pieces_make_the_tree_cheaper_and_threads_do_not_matter():
    positions, faces = pipes(divisions=5)
    whole, _ = rebuild(face_boxes(positions, faces))
    wide, triangle = rebuild_pieces(positions, faces)
    assert len(triangle) > len(faces)
    assert wide_cost(wide) < 0.8 * wide_cost(whole)
    again, other = rebuild_pieces(positions, faces, threads=3)
    assert wide.boxes.tobytes() == again.boxes.tobytes()
    assert triangle.tobytes() == other.tobytes()


@pytest.fixture(scope="module")
def plant():
    return scene_of(Mesh(*pipes()))


@pytest.fixture(scope="module")
def rebuilt(plant):
    return Tracer(plant, device="cpu", threads=1, hierarchy="rebuilt")


def test_hits_are_those_of_the_stored_hierarchy(plant, rebuilt):
    assert rebuilt._layout.repeats
    rays = rays_at(plant, 3000, 5)
    stored = Tracer(plant, device="cpu", threads=1)
    ours, theirs = rebuilt.closest_hit(*rays), stored.closest_hit(*rays)
    for name in ("t", "face", "u", "v", "triangle"):
        assert getattr(ours, name).tobytes() == getattr(theirs, name).tobytes()
    assert rebuilt.any_hit(*rays).tobytes() == stored.any_hit(*rays).tobytes()
    assert ours.hit.mean() > 0.5


def test_what_counts_triangles_counts_each_once(plant, rebuilt):
    rays = rays_at(plant, 1000, 6)
    tracer = Tracer(plant, device="cpu", threads=1, hierarchy="rebuilt")
    before = tracer.resident_bytes
    counts = tracer.count_hits(*rays)
    assert tracer.resident_bytes > before
    stored = Tracer(plant, device="cpu", threads=1)
    assert counts.tobytes() == stored.count_hits(*rays).tobytes()
    ours, theirs = tracer.all_hits(*rays, k=8), stored.all_hits(*rays, k=8)
    assert ours.face.tobytes() == theirs.face.tobytes()
    assert ours.t.tobytes() == theirs.t.tobytes()
    points = rays[0][:100]
    assert tracer.closest_point(points).face.tobytes() == stored.closest_point(points).face.tobytes()
    np.testing.assert_allclose(tracer.winding_numbers(points), stored.winding_numbers(points), atol=1e-5)
    faces = np.zeros((plant.source_face_count, 3), np.int32)
    geometry = functional.Geometry.of(tracer, faces)
    np.testing.assert_array_equal(functional.count_hits(geometry, *rays), counts)


def test_counting_through_pieces_would_be_wrong(plant, rebuilt):
    """What the tracer beside it is for."""
    rays = rays_at(plant, 1000, 6)
    spoilt = Tracer(plant, device="cpu", threads=1, hierarchy="rebuilt")
    spoilt._layout = replace(spoilt._layout, repeats=False)
    assert (spoilt.count_hits(*rays) > Tracer(plant, device="cpu", threads=1).count_hits(*rays)).any()


@pytest.mark.parametrize("test", ["exact-sign", "float64", "fast"])
def test_triangle_tests_count_each_once_too(plant, test):
    rays = rays_at(plant, 500, 7)
    ours = Tracer(plant, device="cpu", threads=1, hierarchy="rebuilt", test=test)
    theirs = Tracer(plant, device="cpu", threads=1, test=test)
    assert ours.closest_hit(*rays).t.tobytes() == theirs.closest_hit(*rays).t.tobytes()
    assert ours.count_hits(*rays).tobytes() == theirs.count_hits(*rays).tobytes()


def test_a_scene_of_one_size_keeps_one_tracer():
    ball = scene_of(Mesh(*clean(sphere(3))))
    tracer = Tracer(ball, device="cpu", threads=1, hierarchy="rebuilt")
    before = tracer.resident_bytes
    tracer.count_hits(*rays_at(ball, 10, 0))
    assert tracer.resident_bytes == before
