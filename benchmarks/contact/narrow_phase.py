"""Points of every pair of convex shapes against truths at random shallow poses; their time on a GPU.

    python -m benchmarks.contact.narrow_phase [PAIR ...] [--poses N] [--dtype NAME] [--json FILE]
    python -m benchmarks.contact.narrow_phase --poses 100 --device cuda:0 --time --json FILE      # times, too

A pose is a shape that came along a random line until it was 0.5 to 3 mm deep in the other one; the truths are those
of ``warp_spo.reference.convex_overlap``: all separating axes of polyhedra, and the least overlap over all directions of
round shapes. Then the shapes are put 0.5 to 3 mm apart. A pose is missed if no point is deeper than zero; a ghost is a
point deeper than zero between shapes that are apart. A normal is right within 5 degrees, or where the overlap along it
is the truth's to 1 micrometre: two faces may be as near.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from itertools import combinations_with_replacement
from typing import Any, NamedTuple

import numpy as np

from warp_spo.dynamics.convex_contacts import ConvexContacts, PairShape
from warp_spo.reference.convex_overlap import GrownShape, Overlaps, PosedPair

from .. import command_line

DEPTHS = 0.5e-3, 3e-3  # of poses, and how far apart the others are [m]
ANGLE = 5.0  # degrees
EQUAL = 1e-6  # overlaps that are one [m]
CLOSE = 5e-5  # error of a depth [m]
TRIES, MOVES = 12, 4  # of poses, and along the line to where it is as deep as wanted
ON_BOTH = 1e-3  # how far a point may be outside of one shape in addition to half its depth [m]
MANY = 5  # one of so many poses is tried with a hull of 64 corners, whose truth takes long
WORLDS, LAUNCHES, REPEATS = (4096, 16384), 10, 20  # of times
VARIED = 64  # poses of each pair that is timed
TIMED = (
    ("sphere", "box"), ("capsule", "capsule"), ("capsule", "box"), ("box", "box"), ("box", "cylinder"), ("box", "hull"),
    ("cylinder", "cylinder"), ("ellipsoid", "ellipsoid"), ("hull", "hull"), ("hull64", "hull64"),
)  # fmt: skip
POLYHEDRA = ("box", "hull", "hull64")


def hull(corners: int, half: Sequence[float], seed: int) -> np.ndarray:
    """Return points on an ellipsoid, spread at random but not too close [corner, 3] [m]."""
    rng, found = np.random.default_rng(seed), np.zeros((0, 3))
    while len(found) < corners:
        one = rng.normal(size=3)
        one /= np.linalg.norm(one)
        if not len(found) or np.linalg.norm(found - one, axis=1).min() > 1.2 / np.sqrt(corners):
            found = np.vstack([found, one])
    return found * half


SHAPES: dict[str, tuple[PairShape, PairShape]] = {
    "sphere": (PairShape("sphere", (0.05,)), PairShape("sphere", (0.03,))),
    "capsule": (PairShape("capsule", (0.03, 0.08)), PairShape("capsule", (0.02, 0.05))),
    "box": (PairShape("box", (0.1, 0.06, 0.04)), PairShape("box", (0.05, 0.05, 0.05))),
    "cylinder": (PairShape("cylinder", (0.05, 0.06)), PairShape("cylinder", (0.03, 0.1))),
    "ellipsoid": (PairShape("ellipsoid", (0.06, 0.04, 0.09)), PairShape("ellipsoid", (0.05, 0.07, 0.03))),
    "hull": (
        PairShape("hull", hull(12, (0.06, 0.05, 0.08), 1)),
        PairShape("hull", hull(20, (0.05, 0.06, 0.04), 2)),
    ),
    "hull64": (
        PairShape("hull", hull(64, (0.06, 0.05, 0.08), 3)),
        PairShape("hull", hull(64, (0.05, 0.06, 0.04), 4)),
    ),
}
"""Two shapes of each kind; "hull64" has as many corners as a hull may have."""
PAIRS = tuple(combinations_with_replacement([name for name in SHAPES if name != "hull64"], 2)) + tuple(
    (name, "hull64") for name in SHAPES
)


def solid(shape: PairShape) -> GrownShape:
    """Return a shape as the reference has it."""
    sizes, radius, corners = np.zeros(3), shape.rounding, None
    if shape.kind == "hull":
        corners = np.asarray(shape.sizes, dtype=np.float64)
    elif shape.kind == "sphere":
        radius += shape.sizes[0]
    elif shape.kind == "capsule":
        sizes[2], radius = shape.sizes[1], radius + shape.sizes[0]
    elif shape.kind == "cylinder":
        sizes[:] = shape.sizes[0], shape.sizes[0], shape.sizes[1]
    else:
        sizes[:] = shape.sizes
    return GrownShape(shape.kind, sizes, radius, corners)


class ShallowPoses(NamedTuple):
    """Poses of two shapes with their truths; ``turns``: quaternions xyzw of both [pose, 4]."""

    pair: PosedPair
    turns: tuple[np.ndarray, np.ndarray]
    truth: Overlaps

    def poses(self, place: np.ndarray) -> np.ndarray:
        """Return poses of both shapes for places of the second one [pose, 2, 7]."""
        first = np.concatenate([np.zeros_like(place), self.turns[0]], axis=1)
        return np.stack([first, np.concatenate([place, self.turns[1]], axis=1)], axis=1)


def shallow_poses(first: PairShape, second: PairShape, count: int, seed: int) -> ShallowPoses:
    """Return random poses in which two shapes are 0.5 to 3 mm deep in each other."""
    rng, a, b = np.random.default_rng(seed), solid(first), solid(second)
    size = sum(
        np.linalg.norm(one.size) + one.radius if one.corners is None else np.abs(one.corners).max() for one in (a, b)
    )
    found: list[Any] = []
    for _ in range(TRIES):
        turns = [random_turns(rng, count) for _ in range(2)]
        line = random_turns(rng, count)[:, :3]
        line /= np.linalg.norm(line, axis=1)[:, None]
        aside = rng.normal(size=(count, 3)) * 0.2 * size
        aside -= np.einsum("pr,pr->p", aside, line)[:, None] * line
        wanted = rng.uniform(*DEPTHS, count)
        pair = PosedPair(a, b, *map(matrices, turns), aside - size * line)
        for move in range(MOVES + 1):
            truth = pair.least(improve=move >= MOVES - 1)
            if move < MOVES:
                rate = np.einsum("pr,pr->p", truth.normal, line)
                by = (truth.depth - wanted) / np.where(np.abs(rate) > 0.05, rate, np.inf)
                pair = pair.moved(-by[:, None] * line)
        good = (truth.depth > DEPTHS[0]) & (truth.depth < DEPTHS[1])
        found.append((pair.of(good), [turn[good] for turn in turns], truth.depth[good], truth.normal[good]))
        if sum(len(one[2]) for one in found) >= count:
            break
    if sum(len(one[2]) for one in found) < count:
        raise RuntimeError(f"{first.kind} and {second.kind}: fewer than {count} shallow poses in {TRIES} tries")
    joined = [
        np.concatenate([getattr(one[0], name) for one in found])[:count] for name in ("turn_a", "turn_b", "place")
    ]
    turns = [np.concatenate([one[1][which] for one in found])[:count] for which in range(2)]
    depth, normal = (np.concatenate([one[which] for one in found])[:count] for which in (2, 3))
    return ShallowPoses(PosedPair(a, b, *joined), (turns[0], turns[1]), Overlaps(depth, normal))


def random_turns(rng: np.random.Generator, count: int) -> np.ndarray:
    turns = rng.normal(size=(count, 4))
    return turns / np.linalg.norm(turns, axis=1)[:, None]


def matrices(turns: np.ndarray) -> np.ndarray:
    """Return the rotation matrices of quaternions xyzw [pose, 3, 3]."""
    x, y, z, w = turns.T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


class PairErrors(NamedTuple):
    """Errors of a pair of shapes at shallow poses.

    Attributes:
        missed, ghosts: poses without a point, and poses apart with one. normals: share within ANGLE. worst: largest
            angle of a normal whose overlap is not the truth's [degrees]. depths: share within CLOSE. error: of depths,
            the 95 % quantile [mm]. strays: points that lie outside of a shape. points: on average.
    """

    pair: str
    dtype: str
    poses: int
    missed: int
    ghosts: int
    normals: float
    worst: float
    depths: float
    error: float
    strays: int
    points: float

    @property
    def holds(self) -> bool:
        """Whether the pair keeps what it promises."""
        right = 0.97 if self.pair.partition(" ")[0] in POLYHEDRA and self.pair.split()[-1] in POLYHEDRA else 1.0
        return not (self.missed or self.ghosts or self.strays) and self.normals >= right and self.depths >= 0.95


class PairsAtPoses:
    """Pairs of shapes at shallow poses, each with shapes of its own, so that one kernel finds the points of all.

    Args:
        pairs: names of two kinds each. count: poses of each pair. seed: of their random numbers.
    """

    def __init__(self, pairs: Sequence[tuple[str, str]], count: int, seed: int = 0):
        self.pairs, rng = tuple(pairs), np.random.default_rng(seed)
        self.shapes = [shape for a, b in self.pairs for shape in (SHAPES[a][0], SHAPES[b][1])]
        self.made = [shallow_poses(*self.shapes[2 * i : 2 * i + 2], count, seed) for i in range(len(self.pairs))]
        self.poses = np.concatenate([made.poses(made.pair.place) for made in self.made], axis=1)
        gaps = [made.truth.depth + rng.uniform(*DEPTHS, count) for made in self.made]
        places = [made.pair.place - gap[:, None] * made.truth.normal for made, gap in zip(self.made, gaps, strict=True)]
        self.apart = np.concatenate([made.poses(at) for made, at in zip(self.made, places, strict=True)], axis=1)

    def contacts(self, dtype: str, device: str | None = None) -> ConvexContacts:
        """Return what finds the points."""
        return ConvexContacts(
            self.shapes, [(2 * i, 2 * i + 1) for i in range(len(self.pairs))], dtype=dtype, device=device
        )

    def errors(self, contacts: ConvexContacts, dtype: str) -> list[PairErrors]:
        """Compare the points of every pair with the truths."""
        near, apart = contacts(self.poses), contacts(self.apart)
        found = []
        for i, (names, made) in enumerate(zip(self.pairs, self.made, strict=True)):
            ghosts = there_of(apart.counts[:, i]) & (apart.points[:, i, :, 6] > 0.0)
            found.append(pair_errors(names, dtype, made, near.points[:, i], near.counts[:, i], int(ghosts.sum())))
        return found


def there_of(counts: np.ndarray) -> np.ndarray:
    """Return a mask of the points that are there [pose, 8]."""
    return np.arange(8) < counts[:, None]


def pair_errors(
    names: tuple[str, str], dtype: str, made: ShallowPoses, points: np.ndarray, counts: np.ndarray, ghosts: int
) -> PairErrors:
    """Compare a pair's points with the truths."""
    there = there_of(counts)
    depth = np.where(there, points[..., 6], -np.inf)
    deepest, every = depth.argmax(axis=1), np.arange(len(points))
    normal, touching = points[every, deepest, 3:6].astype(np.float64), depth[every, deepest] > 0.0
    angle = np.degrees(np.arccos(np.clip(np.einsum("pr,pr->p", normal, made.truth.normal), -1.0, 1.0)))
    excess = made.pair.overlap(normal[:, None])[:, 0] - made.truth.depth
    angle = np.where(excess < EQUAL, 0.0, angle)[touching]
    error = np.abs(depth[every, deepest] - made.truth.depth)[touching]
    return PairErrors(
        " ".join(names), dtype, len(points), int((~touching).sum()), ghosts, float((angle <= ANGLE).mean()),
        float(angle.max()), float((error <= CLOSE).mean()), float(np.quantile(error, 0.95) * 1e3),
        count_strays(made.pair, points, there), float(counts.mean()),
    )  # fmt: skip


def count_strays(pair: PosedPair, points: np.ndarray, there: np.ndarray) -> int:
    """Return how many points lie farther outside of a shape than half their depth and ON_BOTH allow."""
    n, outside = pair.sample_directions(400), np.zeros(points.shape[:2], dtype=bool)
    for shape, turn, at in ((pair.a, pair.turn_a, 0.0 * pair.place), (pair.b, pair.turn_b, pair.place)):
        reach = shape.reach(n @ turn)
        local = points[..., :3] - at[:, None]
        beyond = (np.einsum("pkr,pdr->pkd", local, n) - reach[:, None]).max(axis=2)
        outside |= beyond > ON_BOTH + np.maximum(0.0, -points[..., 6])
    return int((outside & there).sum())


# -- time --------------------------------------------------------------------------------------------------------------
def timed(device: str, near: int = 24) -> Iterator[dict[str, Any]]:
    """Yield times of near pairs, all of the same two kinds, or of several as on a hand, at shallow poses."""
    import warp as wp

    from warp_spo.runtime.launches import launch

    hand = [("capsule", "box")] * 10 + [("box", "box")] * 8 + [("capsule", "capsule")] * 4 + [("box", "hull")] * 2
    lists = {" ".join(pair): [pair] * near for pair in TIMED} | {"hand": hand, "hand, apart": hand}
    for name, pairs in lists.items():
        kinds = sorted(set(pairs))
        every = PairsAtPoses(kinds, VARIED)
        given = every.apart if "apart" in name else every.poses
        shapes = [shape for pair in pairs for shape in (SHAPES[pair[0]][0], SHAPES[pair[1]][1])]
        contacts = ConvexContacts(shapes, [(2 * i, 2 * i + 1) for i in range(len(pairs))], device=device)
        for worlds in WORLDS:
            poses = np.zeros((worlds, len(shapes), 7))
            for i, pair in enumerate(pairs):
                at = 2 * kinds.index(pair)
                poses[:, 2 * i : 2 * i + 2] = given[(np.arange(worlds) * 7 + 5 * i) % VARIED, at : at + 2]
            inputs, outputs, threads = contacts.prepare(poses)

            def call(threads: int = threads, inputs: Any = inputs, outputs: Any = outputs) -> None:
                launch(contacts.kernel, threads, inputs, outputs, device=device, block_dim=128)  # noqa: B023

            call()
            wp.synchronize_device(device)
            with wp.ScopedCapture(device) as capture:
                for _ in range(LAUNCHES):
                    call()
            took = []
            for _ in range(REPEATS):
                begin, end = (wp.Event(device, enable_timing=True) for _ in range(2))
                wp.get_stream(device).record_event(begin)
                wp.capture_launch(capture.graph)
                wp.get_stream(device).record_event(end)
                took.append(wp.get_event_elapsed_time(begin, end) * 1e3 / LAUNCHES)
            yield {
                "pair": name, "near": len(pairs), "worlds": worlds, "us": round(float(np.median(took)), 1),
                "points": float(outputs[1].numpy().mean()), "device": str(wp.get_device(device).name),
            }  # fmt: skip


def main(arguments: Sequence[str] | None = None) -> int:
    parser = command_line.parser("benchmarks.contact.narrow_phase", __doc__)
    parser.add_argument("names", nargs="*", metavar="PAIR", help="such as 'box hull'; all if none is given")
    parser.add_argument("--poses", type=int, default=1000, help="of each pair")
    parser.add_argument("--dtype", action="append", choices=("float32", "float64"), help="both if none is given")
    parser.add_argument("--time", action="store_true", help="time 24 near pairs at 4,096 and 16,384 worlds, too; a GPU")
    options = parser.parse_args(arguments)
    pairs = [pair for pair in PAIRS if not options.names or " ".join(pair) in options.names]
    rows, times = list[PairErrors](), list[dict[str, Any]]()
    for pair in pairs:
        count = options.poses if "hull64" not in pair else max(1, options.poses // MANY)
        made = PairsAtPoses([pair], count)
        for dtype in options.dtype or ("float32", "float64"):
            rows += made.errors(made.contacts(dtype, options.device), dtype)
            print(rows[-1], "holds" if rows[-1].holds else "MISSES", flush=True)
    for row in timed(options.device) if options.time else ():
        times.append(row)
        print(row, flush=True)
    if options.json:
        found = {"errors": [row._asdict() | {"holds": row.holds} for row in rows], "times": times}
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    return 0 if all(row.holds for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
