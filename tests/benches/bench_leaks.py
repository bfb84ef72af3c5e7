"""The leak table: rays aimed exactly at edge midpoints and vertices of closed meshes, through every walk.

    python tests/benches/bench_leaks.py [MODEL ...] [--quick | --full] [--record]

MODEL is a mesh or a folder of meshes; those that are not closed are named and left out. Four closed shapes
that need no file come last. Each model stands in fifteen places: scaled by 1e-6 to 1e6, and moved by 0, 1
and 1000 of its diagonals, rounded to float32 and cleaned anew; whether it is closed is looked at in each
place. In each, half of the rays come from outside and half from inside, half go to edges and half to
vertices, and a quarter run along an axis: 2 million at edges and 2 million at vertices for each model. See
`leak_rays`.

Every ray goes through the walks that a user gets (`leak_walks.MAIN`): closest hits one by one and in packets,
any hits the same two ways with t_max just beyond the target. Each other walk takes three of the places with
all their rays, so that every place is met by some (`--full`: all places, twice the time), or, of what a GPU
runs, the first 4096 rays of each batch. Shared instances take an eighth of the rays in every place, turned,
stretched and mirrored besides; there certain is what is so of the ray as it was moved.

A leak is a certain ray that is reported to miss, or to hit farther than the target by more than the bound.
Hits of every walk are compared bit for bit too with those of the first by the same triangle test, and those
of the first judged. For peers 1e-4 diagonals are added to the bound. Fails where one of ours leaks or
differs, but for the test that is not watertight by design (`leak_walks.LEAKY`): its leaks are counted beside,
and its hits of slivers seen edge-on may lie outside of their boxes, which not every walk then visits.
"""

import argparse
import sys
import time
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import jax
import numpy as np
from leak_rays import RUN, Place, Rays, Target, Verdict, from_inside, from_outside, judge
from leak_shapes import closed_shapes
from leak_walks import LEAKY, MAIN, OTHERS, SHARED, Traces, Walk
from peers import peers
from results import Row, append

import striptools
from striptools.errors import StriptoolsError
from striptools.kernels.packets import PACKET, ready_packets
from striptools.kernels.packets import ROW as PACKET_ROW
from striptools.measure.bound import frame_rays, judge_pairs
from striptools.measure.judgement import compare_reported
from striptools.mesh.instances import Geometries, Instances, place
from striptools.mesh.io import load_mesh
from striptools.mesh.mesh import Mesh
from striptools.reducem.scene import Scene
from striptools.trace import Tracer
from striptools.trace.hit import Hits
from striptools.trace.instanced import lay_out_instanced
from striptools.trace.leaves import lay_out
from striptools.trace.streams import EVERY_RAY
from striptools.types import TriangleTest

BENCH = {"takes": "paths", "full": [[]], "quick": []}

SCALES = (1.0, 1e-6, 1e-3, 1e3, 1e6)
OFFSETS = (0.0, 1.0, 1e3)
PLACES = tuple(Place(scale, offset) for offset in OFFSETS for scale in SCALES)
TURNS = 5
"""Of so many places each other walk takes one: at each offset another scale."""

SHARED_PART = 8
KINDS = ("edges", "vertices")
MOST_TOLD = 20
PEER_SLACK = 1e-4


@dataclass(frozen=True)
class Amount:
    """How much is traced: rays at edges, and as many at vertices, a model; and which places."""

    rays: int = 2_016_000
    places: tuple[Place, ...] = PLACES
    every_walk: bool = False


QUICK = Amount(24_000, (Place(), Place(1e-6, 1e3), Place(1e6, 1.0)), every_walk=True)


@dataclass
class Count:
    """What became of the rays at edges or at vertices by one walk, summed over its ways."""

    rays: int = 0
    sure: int = 0
    leaks: int = 0
    different: int = 0
    wrong: int = 0
    ways: set[str] = field(default_factory=set)
    places: set[Place] = field(default_factory=set)


@dataclass(frozen=True)
class Batch:
    """Rays of one kind in one place."""

    kind: str
    side: str
    rays: Rays
    verdict: Verdict

    def part(self, count: int) -> "Batch":
        """The first of its rays."""
        return replace(self, rays=self.rays.part(count), verdict=self.verdict.part(count))


class Table:
    """Counts by walk and kind of target, and what was seen on the way."""

    def __init__(self) -> None:
        self.counts: dict[tuple[str, str], Count] = defaultdict(Count)
        self.closed = 0
        self.inside = 0
        self.packed = 0.0
        self.told: list[str] = []
        self.leaky: set[str] = set()

    def count(
        self,
        walk: str,
        way: str,
        place: Place,
        batch: Batch,
        leaks: np.ndarray,
        different: np.ndarray | None = None,
    ) -> None:
        """Add what one way of a walk made of a batch."""
        count = self.counts[walk, batch.kind]
        count.rays += len(leaks)
        count.sure += int(batch.verdict.sure.sum())
        count.leaks += int(leaks.sum())
        count.different += 0 if different is None else int(different.sum())
        count.ways.add(way)
        count.places.add(place)

    def tell(self, way: str, place: Place, batch: Batch, wrong: np.ndarray, t: np.ndarray) -> None:
        """Keep the first ray of a batch that is wrong, to the last bit."""
        for ray in np.flatnonzero(wrong)[:1]:
            origin, direction = (a[ray].tolist() for a in (batch.rays.origins, batch.rays.directions))
            self.told.append(
                f"{way}, {place}, {batch.side}, {batch.kind}: origin {origin}, direction {direction}: "
                f"t {t[ray]!r}, farthest {batch.verdict.farthest[ray]!r}"
            )


def main() -> int:
    """Measure each closed model, print its table, and fail where one of ours leaks."""
    parser = argparse.ArgumentParser(description=str(__doc__).split("\n")[0])
    parser.add_argument("models", nargs="*", type=Path)
    parser.add_argument("--quick", action="store_true", help="24,000 rays of each kind in three places")
    parser.add_argument("--full", action="store_true", help="every walk with every ray in every place")
    parser.add_argument("--no-shapes", dest="shapes", action="store_false", help="only the models")
    parser.add_argument("--record", action="store_true")
    arguments = parser.parse_args()
    amount = QUICK if arguments.quick else Amount(every_walk=arguments.full)
    failed = 0
    for name, mesh in closed_models(arguments.models, closed_shapes() if arguments.shapes else {}):
        begun = time.process_time()
        table = measure(mesh, amount)
        rows = rows_of(name, mesh, table, amount)
        failed += has_failed(table)
        say(rows, table, time.process_time() - begun)
        if arguments.record:
            append(rows)
        # Programs are of a model's sizes: those of all models come to 14 GB.
        jax.clear_caches()
    return 1 if failed else 0


def faultless(table: Table) -> list[Count]:
    """What is counted of our own walks that must not leak, nor differ."""
    return [
        count
        for (walk, _), count in table.counts.items()
        if walk not in table.leaky and not walk.startswith("peer ")
    ]


def has_failed(table: Table) -> bool:
    """Whether a hit of ours is not as it has to be, or a ray slips through a test that is watertight."""
    wrong = any(count.wrong for count in table.counts.values())
    return wrong or any(count.leaks or count.different for count in faultless(table))


def closed_models(paths: list[Path], shapes: dict[str, Mesh]) -> Iterator[tuple[str, Mesh]]:
    """Each closed mesh of the paths and folders, as float32, then the shapes."""
    files = [file for path in paths for file in (sorted(path.glob("*.ply")) if path.is_dir() else [path])]
    for file in files:
        mesh = load_mesh(file).flattened()
        mesh = Mesh(np.asarray(mesh.positions, np.float32), mesh.faces)
        if Target(mesh, np.arange(mesh.triangle_count, dtype=np.int32)).closed:
            yield file.stem, mesh
        else:
            sys.stdout.write(f"{file.stem} is not closed\n")
    yield from shapes.items()


def measure(mesh: Mesh, amount: Amount) -> Table:
    """Trace one model in all places."""
    table = Table()
    runs = amount.rays // (2 * RUN * len(amount.places))
    for turn, spot in enumerate(amount.places):
        put = spot.put(mesh)
        scene = striptools.convert(put)
        assert scene.remap is not None
        target = Target(put, scene.remap.face)
        table.closed += target.closed
        table.inside += len(target.inside) > 0
        batches = batches_of(target, runs, np.random.default_rng(turn))
        table.packed += packed_share(scene, batches) / len(amount.places)
        walks = [
            walk
            for k, walk in enumerate(OTHERS)
            if amount.every_walk or (k + turn + turn // TURNS) % TURNS == 0
        ]
        trace_all(table, spot, scene, target, batches, (*MAIN, *walks))
        trace_shared(table, spot, mesh, scene.remap.face, runs // SHARED_PART or 1, turn)
        trace_peers(table, spot, target, batches)
    return table


def batches_of(target: Target, runs: int, random: np.random.Generator) -> list[Batch]:
    """Rays from both sides at both kinds of targets; from outside all where no place inside is known."""
    batches = []
    for side in ("outside", "inside"):
        for kind, aim in (("edges", target.edges), ("vertices", target.vertices)):
            aims = aim(runs, random)
            within = side == "inside" and len(target.inside) > 0
            rays = (from_inside if within else from_outside)(target, aims, random)
            batches.append(Batch(kind, side, rays, judge(target.surface, rays)))
    return batches


def trace_all(
    table: Table, spot: Place, scene: Scene, target: Target, batches: list[Batch], walks: tuple[Walk, ...]
) -> None:
    """Trace the batches by our own walks."""
    first: dict[tuple[TriangleTest, int], Hits] = {}
    for walk in walks:
        tracer = walk.tracer(scene)
        table.leaky |= {walk.name} if walk.test in LEAKY else set()
        for k, whole in enumerate(batches):
            batch = whole if walk.most is None else whole.part(walk.most)
            if (walk.test, k) not in first:
                first[walk.test, k] = reference(table, spot, target, batch, walk, tracer)
            for packets in (False, True) if walk.packets else (False,):
                wanted = hits_part(first[walk.test, k], len(batch.rays))
                trace_batch(table, spot, walk.name, tracer, batch, wanted, packets=packets)


def reference(table: Table, spot: Place, target: Target, batch: Batch, walk: Walk, tracer: Traces) -> Hits:
    """The closest hits that others by the same triangle test are compared with; they are judged here."""
    hits = tracer.closest_hit(batch.rays.origins, batch.rays.directions, packets=False)
    wrong = wrong_hits(target, batch.rays, hits, walk.test)
    table.counts[walk.name, batch.kind].wrong += int(wrong.sum())
    table.tell(f"{walk.name}, wrong", spot, batch, wrong, hits.t)
    return hits


def hits_part(hits: Hits, count: int) -> Hits:
    """The first hits."""
    return Hits(hits.t[:count], hits.face[:count], hits.u[:count], hits.v[:count], hits.triangle[:count])


def trace_batch(
    table: Table, spot: Place, walk: str, tracer: Traces, batch: Batch, wanted: Hits, *, packets: bool
) -> None:
    """Trace a batch by one walk, closest hits and any hits."""
    rays, verdict = (batch.rays.origins, batch.rays.directions), batch.verdict
    how = "packets" if packets else "one by one"
    hits = tracer.closest_hit(*rays, packets=packets)
    hit = tracer.any_hit(*rays, t_max=verdict.t_max, packets=packets)
    for way, t, leaks, other in (
        (f"closest hit, {how}", hits.t, verdict.leaks(hits.t), different(hits, wanted)),
        (
            f"any hit, {how}",
            np.where(hit, 0.0, np.inf),
            verdict.sure & ~hit,
            hit != (wanted.t < verdict.t_max),
        ),
    ):
        table.count(walk, way, spot, batch, leaks, other)
        table.tell(f"{walk}, {way}", spot, batch, other if walk in table.leaky else leaks | other, t)


def different(hits: Hits, wanted: Hits) -> np.ndarray:
    """(r,) bool: which hits are not the same bit for bit."""
    found = np.zeros(len(hits.t), np.bool_)
    for name in ("t", "face", "u", "v"):
        found |= getattr(hits, name) != getattr(wanted, name)
    return found


def wrong_hits(target: Target, rays: Rays, hits: Hits, test: TriangleTest = "watertight") -> np.ndarray:
    """(r,) bool: hits of a face that the ray cannot hit, or whose t, u, v are beyond their bounds."""
    frames = frame_rays(rays.origins, rays.directions)
    ray = np.flatnonzero(hits.hit)
    kept = np.zeros(target.mesh.triangle_count, np.bool_)
    kept[target.kept] = True
    corners = target.mesh.positions[target.mesh.faces[hits.face[ray]]].astype(np.float64)
    pairs = judge_pairs(frames, ray, corners, test=test)
    return hits.hit & ~compare_reported(frames, ray, hits, pairs, corners, kept[hits.face[ray]]).valid


def trace_shared(table: Table, spot: Place, mesh: Mesh, order: np.ndarray, runs: int, turn: int) -> None:
    """Aim at a model that is a shared instance in that place, turned or its axes swapped, and mirrored."""
    random = np.random.default_rng(100 + turn)
    matrix = spot.matrix(mesh)
    swapped = np.eye(3)[[1, 2, 0]] * [[-1], [1], [1]]
    turned = swapped if turn % 2 else np.linalg.qr(random.normal(size=(3, 3)))[0]
    matrix[:, :3] = turned * [1.0, 1.37, 0.61] * spot.scale
    ranges = (np.array([0, mesh.triangle_count], np.int32), np.array([0, len(mesh.positions)], np.int32))
    # A second one, since one alone would be flattened; apart, so that it is rarely met before the first.
    apart = matrix.copy()
    apart[:, 3] += (
        4 * spot.scale * float(np.linalg.norm(mesh.bounds[1] - mesh.bounds[0])) * np.eye(3)[turn % 3]
    )
    standing = Instances(np.zeros(2, np.int32), np.stack([matrix, apart]))
    scene = striptools.convert(
        Mesh(mesh.positions, mesh.faces, geometries=Geometries(*ranges), instances=standing)
    )
    if scene.instances is None:
        # Far from zero a scene gets an origin, and is flattened.
        return
    try:
        tracers = {kind: Tracer(scene, device="cpu", instances="shared", resident=kind) for kind in SHARED}
    except StriptoolsError as error:
        table.told.append(f"shared, {spot}: {error}")
        return
    target = Target(mesh, order)
    layout = lay_out_instanced(scene)
    for side in ("outside", "inside"):
        for kind, aim in (("edges", target.edges), ("vertices", target.vertices)):
            aims = aim(runs, random)
            make = from_inside if side == "inside" and len(target.inside) else from_outside
            rays = placed_rays(make(target, aims, random), aims.points, matrix, exact=bool(turn % 2))
            start, way = layout.moved(rays.origins, rays.directions, np.zeros(len(rays), np.int32))
            length = np.ldexp(1.0, np.frexp(np.abs(rays.directions).max(axis=1))[1] - 1)[:, None]
            scale = float(layout.arrays.frame.scale) / float(layout.geometries.arrays.frame.scale)
            moved = Rays(start, (way * (length * scale)).astype(np.float32), rays.fans, rays.enclosed)
            batch = Batch(kind, side, rays, judge(target.surface, moved))
            for resident, tracer in tracers.items():
                name = f"shared instances, {resident}"
                hits = tracer.closest_hit(rays.origins, rays.directions)
                leaks = batch.verdict.leaks(hits.t)
                table.count(name, "closest hit, one by one", spot, batch, leaks)
                table.tell(name, spot, batch, leaks, hits.t)


def placed_rays(rays: Rays, targets: np.ndarray, matrix: np.ndarray, *, exact: bool) -> Rays:
    """Rays in a geometry's frame where an instance stands, at the same targets; `exact`: axes stay axes."""
    origins = place(rays.origins.astype(np.float64), matrix).astype(np.float32)
    there = place(targets, matrix)
    directions = (there - origins.astype(np.float64)).astype(np.float32)
    along = np.flatnonzero((rays.directions != 0).sum(axis=1) == 1) if exact else np.zeros(0, np.intp)
    axis = np.argmax(np.abs(directions[along]), axis=1)
    ahead, begun = directions[along, axis], origins[along, axis]
    origins[along] = there[along].astype(np.float32)
    origins[along, axis] = begun
    directions[along] = 0
    directions[along, axis] = ahead
    return Rays(origins, directions, rays.fans, rays.enclosed)


def trace_peers(table: Table, spot: Place, target: Target, batches: list[Batch]) -> None:
    """Count the leaks of the peers that are installed."""
    corners = target.mesh.positions[target.mesh.faces[target.kept]]
    for name, peer in peers(corners):
        for batch in batches:
            t = peer.distances(batch.rays.origins, batch.rays.directions)
            length = np.linalg.norm(batch.rays.directions.astype(np.float64), axis=1)
            leaks = batch.verdict.leaks(t, PEER_SLACK * target.diagonal / length)
            for where in ("", ", as it lies") if spot == Place() else ("",):
                table.count(f"peer {name}{where}", "closest hit", spot, batch, leaks)


def packed_share(scene: Scene, batches: list[Batch]) -> float:
    """The share of the rays that go in packets."""
    seen, packed, rays = lay_out(scene).seen_by_packets, 0, 0
    assert seen is not None
    for batch in batches:
        count = len(batch.rays)
        rows = np.zeros((-(-count // PACKET), PACKET_ROW), np.float32)
        at, alone = np.full((len(rows), PACKET), -1, np.int32), np.zeros(count + PACKET, np.int32)
        far, dropped = np.full(count, np.inf, np.float32), np.zeros(count, np.uint8)
        given = (batch.rays.origins, batch.rays.directions, far, EVERY_RAY, 0, *seen)
        live, _, _ = ready_packets(*given, rows, rows.view(np.int32), at, alone, dropped)
        packed, rays = packed + int((at[:live] >= 0).sum()), rays + count
    return packed / rays


def rows_of(name: str, mesh: Mesh, table: Table, amount: Amount) -> list[Row]:
    """A row for each walk, for each peer and kind of target, and what else is to be known."""
    row = partial(Row, "leaks", name, mesh.triangle_count)
    rows = []
    for walk in dict.fromkeys(walk for walk, _ in table.counts):
        counts = {kind: table.counts[walk, kind] for kind in KINDS}
        if walk.startswith("peer "):
            peer, _, where = walk.removeprefix("peer ").partition(", ")
            for kind, count in counts.items():
                said = f"{count.rays} rays, {count.sure} certain, {len(count.places)} places"
                metric = f"leaks at {kind}{', ' * bool(where)}{where}, beside {peer}"
                ours = table.counts[MAIN[0].name, kind].leaks
                rows.append(row(metric, ours, "rays", peer, count.leaks, None, said))
            continue
        note = told(counts, leaky=walk in table.leaky)
        rows.append(row(f"leaks, {walk}", sum(c.leaks for c in counts.values()), "rays", note=note))
    every = table.counts.values()
    closed = f"closed in {table.closed} of {len(amount.places)} places, from inside in {table.inside}"
    return [
        *rows,
        row(
            "hits different from the first walk's",
            sum(count.different for count in faultless(table)),
            "rays",
            note="of the same triangle test, where that is watertight",
        ),
        row("hits beyond their bounds, first walk", sum(count.wrong for count in every), "rays", note=closed),
        row("share of the rays that go in packets", table.packed, ""),
    ]


def told(counts: dict[str, Count], *, leaky: bool) -> str:
    """How many rays a walk was given, each way, and what else is to be known of it."""
    ways = counts[KINDS[0]].ways
    parts = [
        f"{c.rays // len(ways)} rays at {kind}, {c.sure // len(ways)} certain" for kind, c in counts.items()
    ]
    kinds = "closest hit" if len(ways) == 1 else "closest and any hit"
    kinds += ", one by one and in packets" * (len(ways) == 4)
    other = sum(c.different for c in counts.values())
    design = "; not watertight by design" * leaky + f"; {other} hits different" * (other > 0)
    return f"{'; '.join(parts)}; {kinds}; {len(counts[KINDS[0]].places)} places{design}"


def say(rows: list[Row], table: Table, seconds: float) -> None:
    """Print a model's table."""
    out = sys.stdout
    out.write(f"{rows[0].mesh}, {rows[0].triangles} triangles, {seconds:.0f} s of processor time\n")
    for row in rows:
        peer = f" to {row.peer_value:.0f}" if row.peer else ""
        note = f" ({row.note})" if row.note else ""
        out.write(f"  {row.metric}: {row.value:.4g}{peer}{note}\n")
    out.writelines(f"  {line}\n" for line in table.told[:MOST_TOLD])
    out.flush()


if __name__ == "__main__":
    sys.exit(main())
