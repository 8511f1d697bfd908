"""Shapes on the ground against truths: spheres on fields beside dense sampling of the surface; what rolls.

    python -m benchmarks.contact.shapes [NAME ...] [--json FILE]

Float64 on the CPU. Places on fields are random, and the shape's true depth there is 0.5 to 3 mm: a point of the surface
and its normal give the sphere, and the surface around is sampled anew to find how deep the sphere is. Wheels and balls
start without slip, on slopes at rest, with the values of contacts that a scene chooses.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import warp_spo as spo
from warp_spo.reference.field_spheres import nearest_points

from .. import command_line
from .motions import Line

RADII = (0.02, 0.05, 0.1)  # of spheres on fields [m]
CELL = 0.05  # of these fields [m]
SAMPLES, ROUNDS, CLOSER = (
    61,
    6,
    0.1,
)  # of the surface along x and y, rounds of samples, each about the nearest of before
MASS = 1.0  # of what rolls [kg]


# -- spheres on fields -------------------------------------------------------------------------------------------------
def fields(cell: float = CELL) -> dict[str, tuple[spo.HeightField, float]]:
    """Return fields by name, and half the width of the square in which shapes are put on each [m]."""
    places = np.arange(-40, 41) * cell
    slope = np.repeat(places[:, None], len(places), axis=1)
    corner = (places[0], places[0])
    made = {
        "slope of 30 degrees": (np.tan(np.radians(30.0)) * slope, 1.0),
        "V of 40 degrees": (np.tan(np.radians(40.0)) * np.abs(slope), 0.15),
        "roof of 40 degrees": (-np.tan(np.radians(40.0)) * np.abs(slope), 0.15),
    }
    found = {name: (spo.HeightField(heights, cell, corner), width) for name, (heights, width) in made.items()}
    found["rough, 5 cm"] = spo.terrain.rough((4.0, 4.0), cell, amplitude=0.05), 1.0
    found["stairs of 10 cm"] = spo.terrain.stairs((4.0, 4.0), cell, riser=0.1, tread=0.3), 1.5
    outer = 0.1 * (slope <= 0.0) * (slope.T <= 0.0)
    found["outer corner of 10 cm"] = spo.HeightField(outer, cell, corner), 0.15
    return found


def height(field: spo.HeightField, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the bilinear height of a field [m]."""
    h, (cell_x, cell_y) = field.heights, field.cells
    x = np.clip((x - field.origin[0]) / cell_x, 0.0, h.shape[0] - 1.0)
    y = np.clip((y - field.origin[1]) / cell_y, 0.0, h.shape[1] - 1.0)
    i, j = np.minimum(x.astype(int), h.shape[0] - 2), np.minimum(y.astype(int), h.shape[1] - 2)
    s, t = x - i, y - j
    low = h[i, j] + s * (h[i + 1, j] - h[i, j])
    return low + t * (h[i, j + 1] + s * (h[i + 1, j + 1] - h[i, j + 1]) - low) + field.origin[2]


def nearest_sample(field: spo.HeightField, centre: np.ndarray, reach: float) -> np.ndarray:
    """Return the point of the surface nearest to a centre [m], from samples that become denser about the nearest."""
    place, width = centre[:2], reach
    for _ in range(ROUNDS):
        along = np.linspace(-width, width, SAMPLES)
        x, y = (axis.ravel() for axis in np.meshgrid(place[0] + along, place[1] + along))
        points = np.stack([x, y, height(field, x, y)], axis=1)
        nearest = points[((points - centre) ** 2).sum(axis=1).argmin()]
        place, width = nearest[:2], CLOSER * width
    return nearest


def placed_spheres(
    field: spo.HeightField, width: float, radius: float, count: int, seed: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return centres of spheres, their true depths, 0.5 to 3 mm, and the true normals there."""
    rng, found = np.random.default_rng(seed), []
    small = 1e-6
    while len(found) < count:
        x, y = rng.uniform(-width, width, 2)
        at = np.array([x, y, height(field, np.array([x]), np.array([y]))[0]])
        slope = [
            (height(field, np.array([x + a]), np.array([y + b]))[0] - at[2]) / small
            for a, b in ((small, 0), (0, small))
        ]
        normal = np.array([-slope[0], -slope[1], 1.0]) / np.sqrt(1.0 + slope[0] ** 2 + slope[1] ** 2)
        centre = at + (radius - rng.uniform(0.5e-3, 3e-3)) * normal
        away = centre - nearest_sample(field, centre, 1.2 * radius)
        distance = np.linalg.norm(away)
        if 0.5e-3 <= radius - distance <= 3e-3:
            found.append((centre, radius - distance, away / distance))
    centres, depths, normals = zip(*found, strict=True)
    return np.array(centres), np.array(depths), np.array(normals)


def spheres_on(name: str, radius: float, count: int, seed: int = 0) -> Iterator[Line]:
    """Yield how many of the spheres are missed, and how many have wrong normals and depths."""
    field, width = fields()[name]
    missed, turned, wrong = 0, 0, 0
    for centre, depth, normal in zip(*placed_spheres(field, width, radius, count, seed), strict=True):
        found_normal, found_depth = nearest_points(field, centre, radius)[0]
        missed += found_depth <= 0.0
        turned += found_normal @ normal < np.cos(np.radians(5.0))
        wrong += abs(found_depth - depth) > 0.2e-3
    motion = f"sphere of {1e3 * radius:g} mm, {name}"
    yield Line(motion, "missed", None, missed / count, 0.0)
    yield Line(motion, "normals off by more than 5 degrees", None, turned / count, 0.03)
    yield Line(motion, "depths off by more than 0.2 mm", None, wrong / count, 0.05)


# -- what rolls --------------------------------------------------------------------------------------------------------
def rolled(scene: spo.Scene, q: Any, qd: Any, dt: float, seconds: float, dtype: str = "float64") -> np.ndarray:
    """Return the states [time, coordinate and dof] of a body that starts so."""
    dyn = spo.Dynamics(scene, worlds=1, dtype=dtype, device="cpu")
    q, qd, found = np.array([q], dtype), np.array([qd], dtype), []
    for _ in range(round(seconds / dt)):
        q, qd = dyn.step(q, qd, None, dt=dt)
        found.append(np.concatenate([q[0], qd[0]]))
    return np.array(found)


def inclined(degrees: float, cell: float = 0.1) -> spo.HeightField:
    """Return a field that falls along x."""
    places = np.arange(-40, 41) * cell
    return spo.HeightField(-np.tan(np.radians(degrees)) * places[:, None] * np.ones(9), cell, (places[0], -4.0 * cell))


def ball_on(ground: Any, radius: float, **contact: Any) -> spo.Scene:
    ball = spo.Body(MASS, inertia=0.4 * MASS * radius**2 * np.eye(3), label="ball")
    touching = spo.Contact(0, sphere=radius, **contact)
    return spo.Scene([ball], [spo.Hinge("free", -1, 0)], contacts=[touching], ground=ground)


def ball_on_slope(degrees: float, dt: float, friction: float = 0.8, dtype: str = "float64") -> np.ndarray:
    """Return speed, rate and energy after each step of a second [time, 3] of a ball of 100 mm that starts at rest."""
    radius, angle = 0.1, np.radians(degrees)
    scene = ball_on(inclined(degrees), radius, friction=friction)
    depth = MASS * 9.81 * np.cos(angle) / scene.values["contact_stiffness"][0, 0]
    start = [*((radius - depth) * np.array([np.sin(angle), 0.0, np.cos(angle)])), 0.0, 0.0, 0.0, 1.0]
    states = rolled(scene, start, np.zeros(6), dt, 1.0, dtype)
    speed, rate = (np.linalg.norm(states[:, 7 + at : 10 + at], axis=1) for at in (0, 3))
    return np.stack([speed, rate, MASS * (0.5 * speed**2 + 0.2 * (radius * rate) ** 2 + 9.81 * states[:, 2])], axis=1)


def balls() -> Iterator[Line]:
    for degrees in (5.0, 10.0, 20.0):
        truth = 5.0 / 7.0 * 9.81 * np.sin(np.radians(degrees))
        for dt in (1e-3, 2e-3, 5e-3, 1e-2):
            rolls, slides = ball_on_slope(degrees, dt), ball_on_slope(degrees, dt, friction=0.0)
            motion = f"ball on a field of {degrees:g} degrees"
            yield Line(motion, "speed after 1 s, off by", dt, abs(rolls[-1, 0] / truth - 1.0), 0.02)
            yield Line(motion, "rate without friction [rad/s]", dt, slides[:, 1].max(), 1e-6)
            yield Line(motion, "energy that a step gains [J]", dt, max(np.diff(rolls[:, 2]).max(), 0.0), 1e-6)


def rolled_wheel(dt: float, dtype: str = "float64") -> np.ndarray:
    """Return the states [time, 13] of a wheel of 100 mm that rolls at 1 m/s on a plane for a second."""
    radius, half = 0.1, 0.03
    across = MASS * (3.0 * radius**2 + (2.0 * half) ** 2) / 12.0
    body = spo.Body(MASS, inertia=np.diag([across, 0.5 * MASS * radius**2, across]), label="wheel")
    wheel = spo.Contact(0, cylinder=((0.0, -half, 0.0), (0.0, half, 0.0), radius))
    scene = spo.Scene([body], [spo.Hinge("free", -1, 0)], contacts=[wheel], ground=spo.Plane())
    depth = MASS * 9.81 / (2.0 * scene.values["contact_stiffness"][0, 0])  # on both rims
    start = [0.0, 0.0, radius - depth, 0.0, 0.0, 0.0, 1.0]
    return rolled(scene, start, [1.0, 0.0, 0.0, 0.0, 1.0 / radius, 0.0], dt, 1.0, dtype)


def wheels() -> Iterator[Line]:
    for dtype in ("float64", "float32"):
        for dt in (1e-3, 2e-3, 5e-3, 1e-2):
            speed = rolled_wheel(dt, dtype)[-1, 7]
            yield Line(f"wheel of 100 mm on a plane, {dtype}", "speed that 1 m/s loses in 1 s", dt, 1.0 - speed, 0.02)


MOTIONS: dict[str, Callable[[], Iterator[Line]]] = {
    "spheres": lambda: (line for name in fields() for radius in RADII for line in spheres_on(name, radius, 500)),
    "balls": balls,
    "wheels": wheels,
}


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("contact.shapes", __doc__)
    parser.add_argument("names", nargs="*", help=f"some of {', '.join(MOTIONS)}")
    options = parser.parse_args(arguments)
    rows = []
    for name in options.names or MOTIONS:
        for row in MOTIONS[name]():
            print(row, flush=True)
            rows.append(row)
            if options.json:
                found = [row._asdict() | {"holds": row.holds} for row in rows]
                options.json.write_text(json.dumps(found, indent=1, default=float) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
