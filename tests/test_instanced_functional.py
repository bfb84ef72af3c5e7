"""Functions of arrays over shared instances: the bits of those over the flattened scene, derivatives too."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_hoisting import assert_hoisted
from test_instanced_points import crowd as crowd
from test_instanced_tests import rays_at, rays_from_near, specks
from test_shared_instances import KINDS

from striptools.trace import Tracer
from striptools.trace.functional import Geometry, all_hits, any_hit, closest_hit, contains, count_hits


@pytest.fixture(scope="module", params=KINDS)
def both(crowd, request):
    """Positions of the flattened mesh, and its geometry over shared and over flattened instances."""
    mesh, scene = crowd
    flat = mesh.flattened()
    given = {"device": "cpu", "threads": 1}
    shared = Tracer(scene, instances="shared", resident=request.param, **given)
    flattened = Tracer(scene, instances="flattened", **given)
    return flat.positions, Geometry.of(shared, flat.faces), Geometry.of(flattened, flat.faces), flattened


def assert_same(ours, theirs):
    for one, other in zip(ours, theirs, strict=True):
        assert np.asarray(one).tobytes() == np.asarray(other).tobytes()


def test_all_queries_are_those_over_the_flattened_scene(crowd, both):
    positions, shared, flattened, tracer = both
    rays = rays_at(crowd[1], 1500)
    hits = jax.jit(closest_hit)(shared, positions, *rays)
    assert_same(hits, closest_hit(flattened, positions, *rays))
    np.testing.assert_array_equal(hits.t, tracer.closest_hit(*rays).t)
    assert (hits.face >= 0).sum() > 500
    assert_same(all_hits(shared, positions, *rays, k=3), all_hits(flattened, positions, *rays, k=3))
    assert_same([any_hit(shared, *rays)], [any_hit(flattened, *rays)])
    assert_same([count_hits(shared, *rays)], [count_hits(flattened, *rays)])
    assert_same([contains(shared, rays[0])], [contains(flattened, rays[0])])
    assert not any_hit(shared, *rays, np.float32(1e-4)).all()


def test_derivatives_are_those_over_the_flattened_scene(crowd, both):
    positions, shared, flattened, _ = both
    rays = rays_at(crowd[1], 200, 1)

    def depth(geometry, positions, origins, directions):
        hits = closest_hit(geometry, positions, origins, directions)
        return jnp.where(hits.face >= 0, hits.t + hits.u * hits.v, 0).sum()

    ours, theirs = (
        jax.grad(depth, argnums=(1, 2, 3))(geometry, positions, *rays) for geometry in (shared, flattened)
    )
    assert_same(ours, theirs)
    assert np.abs(ours[0]).max() > 0


def test_any_vmap_is_one_batch(crowd, both):
    positions, shared, _, _ = both
    origins, directions = rays_at(crowd[1], 60, 2)
    whole = closest_hit(shared, positions, origins, directions)
    mapped = jax.vmap(closest_hit, in_axes=(None, None, 0, 0))(
        shared, positions, origins.reshape(3, 20, 3), directions.reshape(3, 20, 3)
    )
    assert_same([each.reshape(60) for each in mapped], whole)


def test_the_loop_stays_hoisted_inside_a_program(crowd, both):
    positions, shared, _, _ = both
    rays = rays_at(crowd[1], 64, 3)
    assert_hoisted(jax.jit(lambda *r: closest_hit(shared, positions, *r).t * 2).lower(*rays), loops=5)


def test_specks_are_hit_by_rays_from_next_to_them():
    scene = specks()
    placed = scene.placed()
    rays = rays_from_near(scene, 2000)
    faces = np.zeros((scene.placed_count, 3), np.int32)
    faces[placed.remap.face] = placed.faces()
    shared, flattened = (
        Geometry.of(Tracer(scene, device="cpu", threads=1, instances=kind), faces)
        for kind in ("shared", "flattened")
    )
    assert_same(*(closest_hit(each, placed.positions, *rays) for each in (shared, flattened)))
