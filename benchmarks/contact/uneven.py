"""Shapes on height fields against truths: dense sampling of both surfaces; a foot on a stair; a ridge.

    python -m benchmarks.contact.uneven [NAME ...] [--count 500] [--json FILE]

Float64 on the CPU. Places are random, and so is the turn of a shape, by up to LEAN or by any angle. A shape is lowered
until its true depth is 0.5 to 3 mm: the largest distance that a point of one surface is inside of the other, from
samples that become denser about the deepest.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np

import warp_spo as spo
from warp_spo.reference.rotations import rotation

from .. import command_line
from .motions import Line
from .shapes import fields, height, nearest_sample

LEAN = 0.3  # of shapes that lean little [rad]
SPACING, ROUNDS, CLOSER = 0.004, 4, 0.2  # of samples of a field [m]; rounds about the deepest, each so much closer
STARTS, WORST = 6, 4  # samples that are refined; samples of a shape's surface whose distance from a field is taken
SHALLOW, DEEP, LOWERED = 0.5e-3, 3e-3, 5e-3  # true depths that count; how far a shape is lowered beyond touch [m]
SEEN, CLOSE = 1e-3, 1e-3  # true depth from which a miss counts, and error of a depth that counts [m]
STEPS = (1e-3, 2e-3, 5e-3, 1e-2)  # [s]
HALF = (0.1, 0.05, 0.02)  # of a box foot [m]


class Sampled(NamedTuple):
    """A shape and samples of its surface.

    Attributes:
        contact: its argument of a Contact. cloud: samples [point, 3]. inside: returns how far inside points are.
    """

    contact: dict[str, Any]
    cloud: np.ndarray
    inside: Callable[[np.ndarray], np.ndarray]


def box(half: tuple[float, ...] = HALF) -> Sampled:
    """Return a box; its edges are sampled, because inside of a face the field's own points are deepest."""
    along, edges = np.linspace(-1.0, 1.0, 201), []
    for k in range(3):
        for a, b in ((a, b) for a in (-1.0, 1.0) for b in (-1.0, 1.0)):
            edge = np.empty((len(along), 3))
            edge[:, k], edge[:, (k + 1) % 3], edge[:, (k + 2) % 3] = along, a, b
            edges.append(edge * half)
    return Sampled(dict(box=half), np.concatenate(edges), lambda q: (np.array(half) - np.abs(q)).min(axis=-1))


def capsule(radius: float = 0.04, half: float = 0.12) -> Sampled:
    """Return a capsule along x."""
    turn = np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    ring = np.stack([np.zeros(72), np.cos(turn), np.sin(turn)], axis=1)
    rings = [radius * ring + (x, 0.0, 0.0) for x in np.linspace(-half, half, 81)]
    for angle in np.linspace(0.0, np.pi / 2.0, 13)[1:]:
        rings += [
            radius * np.cos(angle) * ring + (side * (half + radius * np.sin(angle)), 0.0, 0.0) for side in (-1, 1)
        ]

    def inside(q: np.ndarray) -> np.ndarray:
        return radius - np.linalg.norm(q - np.clip(q, -half, half) * (1.0, 0.0, 0.0), axis=-1)

    return Sampled(dict(capsule=((-half, 0, 0), (half, 0, 0), radius)), np.concatenate(rings), inside)


def cylinder(radius: float, half: float) -> Sampled:
    """Return a cylinder along z; its side is sampled along lines, its faces at their rims alone."""
    turn = np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False)
    ring = radius * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    cloud = [np.column_stack([ring, np.full(360, z)]) for z in np.linspace(-half, half, 5)]

    def inside(q: np.ndarray) -> np.ndarray:
        return np.minimum(radius - np.linalg.norm(q[..., :2], axis=-1), half - np.abs(q[..., 2]))

    return Sampled(dict(cylinder=((0, 0, -half), (0, 0, half), radius)), np.concatenate(cloud), inside)


def roller(radius: float = 0.04, half: float = 0.12) -> Sampled:
    """Return a cylinder along x."""
    upright = cylinder(radius, half)
    contact = dict(cylinder=((-half, 0, 0), (half, 0, 0), radius))
    return Sampled(contact, upright.cloud[:, [2, 0, 1]], lambda q: upright.inside(q[..., [1, 2, 0]]))


def hull(half: tuple[float, ...] = HALF) -> Sampled:
    """Return a prism of twelve corners, with an oblong hexagon above another."""
    turn = np.pi / 3.0 * np.arange(6)
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1) * half[:2]
    corners = np.array([[*at, z] for z in (-half[2], half[2]) for at in ring])
    ends = [(a, (a + 1) % 6) for a in range(6)]
    edges = [*ends, *((a + 6, b + 6) for a, b in ends), *((a, a + 6) for a in range(6))]
    along = np.linspace(0.0, 1.0, 101)[:, None]
    cloud = np.concatenate([corners[a] + along * (corners[b] - corners[a]) for a, b in edges])
    across = np.array([(ring[b] - ring[a])[::-1] * (1.0, -1.0) for a, b in ends])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    offsets = (across * ring).sum(axis=1)

    def inside(q: np.ndarray) -> np.ndarray:
        sides = (offsets - q[..., :2] @ across.T).min(axis=-1)
        return np.minimum(sides, half[2] - np.abs(q[..., 2]))

    return Sampled(dict(hull=corners), cloud, inside)


SHAPES = {
    "box": box(),
    "capsule": capsule(),
    "disc": cylinder(radius=0.1, half=0.02),
    "roller": roller(),
    "hull": hull(),
}


def turned(rng: np.random.Generator, most: float) -> np.ndarray:
    """Return a quaternion xyzw: a random yaw, then a lean in a random direction, by up to ``most``."""
    yaw, way, lean = rng.uniform(-np.pi, np.pi), rng.uniform(-np.pi, np.pi), 0.5 * rng.uniform(0.0, most)
    (x, y, w), (z, v) = (
        (np.sin(lean) * np.cos(way), np.sin(lean) * np.sin(way), np.cos(lean)),
        np.array([np.sin(0.5 * yaw), np.cos(0.5 * yaw)]),
    )
    return np.array([x * v + y * z, y * v - x * z, w * z, w * v])


def samples(shape: Sampled, R: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return places over a field under a shape [sample, 2]."""
    reach = np.abs(shape.cloud @ R.T)[:, :2].max(axis=0) + SPACING
    x, y = (np.arange(c - r, c + r, SPACING) for c, r in zip(centre, reach, strict=False))
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def true_depth(field: spo.HeightField, shape: Sampled, R: np.ndarray, centre: np.ndarray) -> float:
    """Return how deep two surfaces are in each other, zero where they are apart [m]."""

    def inside(at: np.ndarray) -> np.ndarray:
        points = np.column_stack([at, height(field, *at.T)])
        return shape.inside((points - centre) @ R)

    found, places = [0.0], samples(shape, R, centre)
    depths = inside(places)
    for start in np.argsort(depths)[-STARTS:]:
        place, width = places[start], SPACING
        for _ in range(ROUNDS if depths[start] > -SPACING else 0):
            along = np.linspace(-width, width, 17)
            near = place + np.stack(np.meshgrid(along, along), axis=-1).reshape(-1, 2)
            values = inside(near)
            place, width = near[values.argmax()], CLOSER * width
            found.append(float(values.max()))
    cloud = shape.cloud @ R.T + centre
    below = height(field, *cloud[:, :2].T) - cloud[:, 2]
    for at in np.argsort(below)[-WORST:]:
        if below[at] > max(found):
            away = cloud[at] - nearest_sample(field, cloud[at], max(0.01, 2.0 * below[at]))
            found.append(float(np.linalg.norm(away)))
    return max(found)


def lowered(field: spo.HeightField, shape: Sampled, R: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """Return the middle of a shape that comes down until a sample touches, by halving."""
    places = samples(shape, R, centre)
    points = np.column_stack([places, height(field, *places.T)])
    surface = height(field, *(shape.cloud @ R.T + centre)[:, :2].T) - (shape.cloud @ R.T)[:, 2]
    low, high = float(points[:, 2].min()) - 1.0, float(points[:, 2].max()) + 1.0
    low = max(low, float(surface.max()) - 1e-9)  # samples of the shape touch above
    for _ in range(40):
        middle = 0.5 * (low + high)
        touches = shape.inside((points - (*centre[:2], middle)) @ R).max() > 0.0
        low, high = (middle, high) if touches else (low, middle)
    return np.array([*centre[:2], high])


def placed(
    field: spo.HeightField, width: float, shape: Sampled, lean: float, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return poses of a shape [count, 7] and their true depths, 0.5 to 3 mm."""
    rng, poses, depths = np.random.default_rng(seed), [], []
    while len(poses) < count:
        turn = turned(rng, lean)
        R = rotation(turn)
        centre = lowered(field, shape, R, np.array([*rng.uniform(-width, width, 2), 0.0]))
        centre[2] -= rng.uniform(SHALLOW, LOWERED)
        depth = true_depth(field, shape, R, centre)
        if SHALLOW <= depth <= DEEP:
            poses.append([*centre, *turn])
            depths.append(depth)
    return np.array(poses), np.array(depths)


def found_depths(field: spo.HeightField, shape: Sampled, poses: np.ndarray) -> np.ndarray:
    """Return the largest depth that a step's contacts have at each pose [m]."""
    body = spo.Body(1.0, inertia=0.01 * np.eye(3))
    scene = spo.Scene([body], [spo.Hinge("free", -1, 0)], contacts=[spo.Contact(0, **shape.contact)], ground=field)
    dyn = spo.Dynamics(scene, worlds=len(poses), dtype="float64", device="cpu")
    report = dyn.step_report("contact_gap", like=poses)
    dyn.step(poses, np.zeros((len(poses), 6)), dt=1e-3, report=report)
    return -report.contact_gap.min(axis=1)


def depths_on(name: str, kind: str, lean: float, count: int, seed: int = 0) -> Iterator[Line]:
    """Yield how many of a shape's poses on a field are missed, and how many have wrong depths."""
    field, width = fields()[name]
    poses, depths = placed(field, width, SHAPES[kind], lean, count, seed)
    found = found_depths(field, SHAPES[kind], poses)
    motion = f"{kind} leaning by up to {np.degrees(lean):.0f} degrees, {name}, {count} places"
    yield Line(motion, "missed, of 1 mm and deeper", None, float(((depths >= SEEN) & (found <= 0.0)).mean()), 0.0)
    yield Line(motion, "depths off by more than 1 mm", None, float((abs(found - depths) > CLOSE).mean()), 0.05)


# -- what rests --------------------------------------------------------------------------------------------------------
def ridge(top: float = 0.1, cell: float = 0.05) -> spo.HeightField:
    """Return a ridge along y, two cells wide, whose sides are steeper than 45 degrees."""
    places = np.arange(-20, 21) * cell
    heights = np.clip(top - np.abs(places) * top / cell, 0.0, None)
    return spo.HeightField(heights[:, None] * np.ones(41), cell, (places[0], places[0]))


def stair(cell: float = 0.05, drop: float = 0.1) -> spo.HeightField:
    """Return a tread at height zero that ends at x = 0."""
    places = np.arange(-20, 21) * cell
    return spo.HeightField(np.where(places <= 1e-9, 0.0, -drop)[:, None] * np.ones(21), cell, (places[0], -10.0 * cell))


def resting(field: spo.HeightField, start: Any, dt: float, dtype: str, seconds: float = 1.5, **contact: Any) -> Any:
    """Return the pose of a body of 3 kg at the end [7]; its inertia is that of a box foot."""
    x, y, z = np.square(HALF)
    body = spo.Body(3.0, inertia=np.diag([y + z, x + z, x + y]))
    scene = spo.Scene([body], [spo.Hinge("free", -1, 0)], contacts=[spo.Contact(0, **contact)], ground=field)
    dyn = spo.Dynamics(scene, worlds=1, dtype=dtype, device="cpu")
    q, qd = np.array([start], dtype), np.zeros((1, 6), dtype)
    for _ in range(round(seconds / dt)):
        q, qd = dyn.step(q, qd, dt=dt)
    return q[0].astype(np.float64)


def pitch(pose: np.ndarray) -> float:
    """Return by how much a body's z leans [deg]."""
    return float(np.degrees(np.arccos(np.clip(rotation(pose[3:])[2, 2], -1.0, 1.0))))


def feet() -> Iterator[Line]:
    for dtype in ("float64", "float32"):
        for dt in STEPS:
            for share in (0.75, 0.8, 0.85):
                start = [2.0 * HALF[0] * (1.0 - share) - HALF[0], 0.013, HALF[2], 0.0, 0.0, 0.0, 1.0]
                pose = resting(stair(), start, dt, dtype, box=HALF)
                motion = f"box foot of 200 mm, {share:.0%} of it on a stair's tread, {dtype}"
                yield Line(motion, "pitch [deg]", dt, pitch(pose), 1.0)


def ridges() -> Iterator[Line]:
    for dtype in ("float64", "float32"):
        for dt in STEPS:
            for kind, contact in (("box", dict(box=(0.2, 0.05, 0.03))), ("capsule", SHAPES["capsule"].contact)):
                low = 0.03 if kind == "box" else 0.04
                for yaw in (0.0, 0.3, 0.7):
                    start = [0.0, 0.011, 0.1 + low, 0.0, 0.0, np.sin(0.5 * yaw), np.cos(0.5 * yaw)]
                    pose = resting(ridge(), start, dt, dtype, 1.0, **contact)
                    motion = f"{kind} across a ridge of 100 mm, yaw {yaw:g} rad, {dtype}"
                    yield Line(motion, "sinks into it [mm]", dt, 1e3 * (0.1 + low - pose[2]), 5.0)


def depths(count: int) -> Iterator[Line]:
    for kind in SHAPES:
        for lean in (LEAN, np.pi):
            for name in fields():
                yield from depths_on(name, kind, lean, count)


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("contact.uneven", __doc__)
    motions = {"feet": feet, "ridges": ridges, "depths": lambda: depths(options.count)}
    parser.add_argument("names", nargs="*", help=f"some of {', '.join(motions)}")
    parser.add_argument("--count", type=int, default=500, help="places of a shape on a field")
    options = parser.parse_args(arguments)
    rows = []
    for name in options.names or motions:
        for row in motions[name]():
            print(row, flush=True)
            rows.append(row)
            if options.json:
                found = [one._asdict() | {"holds": one.holds} for one in rows]
                options.json.write_text(json.dumps(found, indent=1, default=float) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
