"""Feet: contact force, air time and contact time of bodies that touch the ground."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

from ..trace.functions import Condition, where

if TYPE_CHECKING:
    from .compile.vectors import Vector
    from .world import World


class Feet(NamedTuple):
    """Bodies that touch the ground, one entry each.

    Attributes:
        force: of the ground, inertial axes, mean over the step [N], list of (3,).
        touches: whether the force is above the threshold; conditions.
        air_time: time since the foot last touched, zero where it touches [s]. contact_time: since it last did not [s].
        last_air_time: air time that ended with the last landing [s].
        lands: whether it touches for the first time in this step; conditions.
        gap: distance of its lowest point from the ground [m]. slip: largest speed of its points along the ground [m/s].
    """

    force: list[Vector]
    touches: list[Condition]
    air_time: Vector
    contact_time: Vector
    last_air_time: Vector
    lands: list[Condition]
    gap: list[Any]
    slip: list[Any]


def least(values: list[Any]) -> Any:
    """Return the smallest of some scalars."""
    found = values[0]
    for x in values[1:]:
        found = where(x < found, x, found)
    return found


def most(values: list[Any]) -> Any:
    """Return the largest of some scalars."""
    return -least([-x for x in values])


class FootTimes:
    """The memory of ``Feet``: air, contact and last air time of each body, in steps, brought up to date in each."""

    def __init__(self, points: list[list[int]], threshold: float):
        self.points, self.threshold = points, threshold

    def touches(self, w: World) -> list[Condition]:
        """Return whether each body touches the ground."""
        forces = [sum(w.contact_force[i] for i in points) for points in self.points]
        return [f[0] * f[0] + f[1] * f[1] + f[2] * f[2] > self.threshold**2 for f in forces]

    def update(self, w: World, name: str) -> None:
        """Keep the times after a step."""
        count = len(self.points)
        before = w.memory(name, 3 * count)
        kept: list[Any] = []
        for i, touches in enumerate(self.touches(w)):
            air, contact, last = before[i], before[count + i], before[2 * count + i]
            lands = touches & (contact < 0.5)
            kept.append((where(touches, 0.0, air + 1.0), where(touches, contact + 1.0, 0.0), where(lands, air, last)))
        w.keep(name, [times[k] for k in range(3) for times in kept])


def feet(w: World, bodies: Any, threshold: float) -> Feet:
    """Return the feet of a world, see :meth:`World.feet`."""
    points = w.points(bodies)
    if not all(points):
        raise ValueError(f"World.feet: some of the bodies {bodies!r} have no contact points; expected bodies that do")
    name, count = f"feet {bodies!r} {threshold!r}", len(points)
    times = FootTimes(points, threshold)
    kept = w.sensor(name, 3 * count, lambda world: times.update(world, name))
    air, contact, last = (kept[k * count : (k + 1) * count] for k in range(3))
    return Feet(
        [sum(w.contact_force[i] for i in each) for each in points],
        times.touches(w),
        air * w.dt,
        contact * w.dt,
        last * w.dt,
        [(steps > 0.5) & (steps < 1.5) for steps in contact],
        [least([w.contact_gap[i] for i in each]) for each in points],
        [most([w.contact_slip[i] for i in each]) for each in points],
    )
