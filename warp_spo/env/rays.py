"""Rays: distances from a point along a direction to the ground, and to spheres, capsules and boxes that stand still."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..scene.ground import HeightField, Plane
from ..trace.functions import where
from .compile.vectors import as_scalar, rotate, rotate_back, vector
from .observations import Each
from .world import World

SMALLEST = 1e-9  # of a denominator
Pose = tuple[float, float, float, float, float, float, float]


def dot(a: Any, b: Any) -> Any:
    """Return the scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@dataclasses.dataclass(frozen=True)
class Sphere:
    """A sphere, inertial axes.

    Args:
        center: (x, y, z) [m]. radius: [m].
    """

    center: tuple[float, float, float]
    radius: float

    def distance(self, origin: Any, direction: Any, most: float) -> Any:
        """Return the distance along a ray of unit direction, ``most`` where it misses; 0 from inside."""
        from_center = vector(origin) - np.array(self.center)
        return _to_sphere(from_center, direction, self.radius, most)


@dataclasses.dataclass(frozen=True)
class Capsule:
    """A capsule, inertial axes.

    Args:
        start, end: of its axis (x, y, z) [m]. radius: [m].
    """

    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float

    def distance(self, origin: Any, direction: Any, most: float) -> Any:
        """Return the distance along a ray of unit direction, ``most`` where it misses; 0 from inside."""
        a, b = np.array(self.start, dtype=float), np.array(self.end, dtype=float)
        length = float(np.linalg.norm(b - a))
        u = (b - a) / length
        to = vector(origin) - a
        along, rate = dot(to, u), dot(direction, u)
        across, turn = to - along * u, vector(direction) - rate * u  # normal to the axis
        A, B, C = dot(turn, turn), dot(across, turn), dot(across, across) - self.radius**2
        A = where(A > SMALLEST, A, SMALLEST)
        square = B * B - A * C
        t = (-B - np.sqrt(where(square > 0.0, square, 0.0))) / A
        place = along + rate * t
        hit = (square > 0.0) & (t > 0.0) & (place > 0.0) & (place < length)
        best = where(hit, t, most)
        inside = (C < 0.0) & (along > 0.0) & (along < length)
        for end in (a, b):
            best = _least(best, _to_sphere(vector(origin) - end, direction, self.radius, most))
        return where(inside, 0.0, best)


@dataclasses.dataclass(frozen=True)
class Box:
    """A box.

    Args:
        half: half its sizes (x, y, z) [m]. pose: of its middle, (x, y, z, qx, qy, qz, qw), inertial axes.
    """

    half: tuple[float, float, float]
    pose: Pose = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)

    def distance(self, origin: Any, direction: Any, most: float) -> Any:
        """Return the distance along a ray of unit direction, ``most`` where it misses; 0 from inside."""
        pose = np.array(self.pose, dtype=float)
        at, along = (rotate_back(pose[3:], v) for v in (vector(origin) - pose[:3], vector(direction)))
        enter: Any = 0.0
        leave: Any = most
        for x, d, half in zip(at, along, self.half, strict=True):
            safe = where(abs(d) > SMALLEST, d, SMALLEST)
            first, second = (-half - x) / safe, (half - x) / safe
            enter = _most(enter, _least(first, second))
            leave = _least(leave, _most(first, second))
        return where(enter < leave, enter, most)


def cast(w: World, origin: Any, direction: Any, most: float, obstacles: Sequence[Any] = (), steps: int = 24) -> Any:
    """Return the distance from a point along a unit vector to the ground or the nearest obstacle [m], at most ``most``.

    The ground is the scene's. Over a height field the ray is sampled at ``steps`` points, and the crossing is
    interpolated between two of them: the ray may miss what is thinner than most / steps along it. From below the ground
    the distance is 0; but from below a plane it is ``most`` if the ray does not point downwards.

    Args:
        w: the world. origin: (3,) [m], direction: (3,), inertial axes. most: [m]. obstacles: of this module.
        steps: number of points on a ray over a height field.
    """
    best: Any = most
    ground = w.scene.ground
    if isinstance(ground, Plane):
        normal = np.array(ground.normal)
        moved = w.value("ground_origin")
        place = vector(x - as_scalar(o) for x, o in zip(origin, moved, strict=True)) if len(moved) else origin
        gap, closing = dot(place, normal) - ground.height, -dot(direction, normal)
        t = gap / where(closing > SMALLEST, closing, SMALLEST)
        best = where((closing > SMALLEST) & (t < most), where(t > 0.0, t, 0.0), most)
    elif isinstance(ground, HeightField):
        best = _to_field(w, origin, direction, most, steps)
    for obstacle in obstacles:
        best = _least(best, obstacle.distance(origin, direction, most))
    return best


def _to_field(w: World, origin: Any, direction: Any, most: float, steps: int) -> Any:
    """Return the distance to the scene's height field."""
    part, best = most / steps, most
    over = origin[2] - w.ground_height(origin[0], origin[1])
    best = where(over > 0.0, most, 0.0)
    open_ = over > 0.0
    for step in range(1, steps + 1):
        t = step * part
        x, y, z = (origin[i] + t * direction[i] for i in range(3))
        now = z - w.ground_height(x, y)
        crosses = open_ & (now < 0.0)
        fall = where(over - now > SMALLEST, over - now, SMALLEST)
        best = where(crosses, t - part + part * (over / fall), best)
        open_, over = open_ & ~crosses, now
    return best


def ring(count: int) -> np.ndarray:
    """Return unit vectors in the horizontal plane, ``count`` of them, from forward on to the left (count, 3)."""
    angles = np.arange(count) * 2.0 * np.pi / count
    return np.stack([np.cos(angles), np.sin(angles), np.zeros(count)], axis=1)


def lidar(
    directions: Any, most: float = 10.0, position: Any = (0.0, 0.0, 0.0), obstacles: Sequence[Any] = (), steps: int = 24
) -> Any:
    """Return the term of distances that rays from the base measure, see :func:`cast` [m].

    Args:
        directions: unit vectors in the base's axes (ray, 3), such as those of :func:`ring`.
        most: [m]. position: where they start, in the base's axes [m]. obstacles, steps: as :func:`cast`.
    """

    def distance(w: World, direction: Any) -> Any:
        origin = w.base_position + rotate(w.base_quaternion, position)
        return cast(w, origin, rotate(w.base_quaternion, direction), most, obstacles, steps)

    return Each(distance, directions)


def _to_sphere(from_center: Any, direction: Any, radius: float, most: float) -> Any:
    """Return the distance along a ray of unit direction to a sphere, ``most`` where it misses; 0 from inside.

    ``from_center``: where the ray starts, from the centre of the sphere [m].
    """
    B, C = dot(from_center, direction), dot(from_center, from_center) - radius * radius
    square = B * B - C
    t = -B - np.sqrt(where(square > 0.0, square, 0.0))
    return where(C < 0.0, 0.0, where((square > 0.0) & (t > 0.0) & (t < most), t, most))


def _least(a: Any, b: Any) -> Any:
    return where(a < b, a, b)


def _most(a: Any, b: Any) -> Any:
    return where(a > b, a, b)
