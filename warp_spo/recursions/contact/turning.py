"""Friction of a contact point against turning: moments against spinning about the normal, and rolling across it.

Both are secants, as sliding friction is: dampers that give their bound, a coefficient [m] times the normal force, at
the rate of the pass before. They add to the inertia of turning, J, of the point's link alone. A coefficient that is
zero in all worlds, and not variable, generates no code.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

from ...scene.contact_values import TURNING_VALUES
from ...scene.scene import Scene
from ...trace.scalars import Value, absolute, inverse_root, less, reciprocal, select
from ...trace.spatial import Vector, dot
from ..model import effective_mass
from ..model.scene_cache import cached_by_scene

if TYPE_CHECKING:
    from .points import TracedContactPoint

SLIP = 0.6  # share of an inverse weight by which a moment beyond its bound predicts how much faster a body turns
LENGTH, LEAST_LENGTH = 0.1, 3e-5  # of a body that cannot turn, or whose point cannot move; what is too short to be one
TINY = 1e-24  # square of a rate of rolling [rad^2/s^2] that is nothing; its derivative is still a number in float32


class TurningScale(NamedTuple):
    """Constants of a contact point that torsional and rolling friction need.

    Attributes:
        length: with which the point's body turns as easily as the point moves, in the neutral pose [m].
        weight: share of the inverse weight of turning that predicts how much faster it turns [1/(kg m^2)].
    """

    length: float
    weight: float


class TurningFriction(NamedTuple):
    """Torsional and rolling friction of a point.

    Attributes:
        bounds: largest moments about the normal and across it, over the normal force [m]; None: no such friction.
        slow: rate below which they are dampers [rad/s]. length, weight: as of :class:`TurningScale`.
    """

    bounds: tuple[Value | None, Value | None]
    slow: Value
    length: Value
    weight: Value


def turning_names(scene: Scene, variable: Collection[str], number: int) -> tuple[str, ...]:
    """Return which of TURNING_VALUES a contact point has in some world."""
    return tuple(name for name in TURNING_VALUES if name in variable or scene.values[name][:, number].any())


@cached_by_scene
def turning_scales(scene: Scene) -> list[TurningScale]:
    """Return the constants of each contact point."""
    frames = tuple((point.body, tuple(point.place((0.0, 0.0, 1.0)))) for point in scene.contact_points)
    found = []
    weights = (effective_mass.inverse_weights(scene, frames, turning) for turning in (False, True))
    for moves, turns in zip(*weights, strict=True):
        both = min(moves, turns) > 0.0 and moves > LEAST_LENGTH**2 * turns
        found.append(TurningScale(math.sqrt(moves / turns) if both else LENGTH, SLIP / 3.0 * float(turns)))
    return found


def rates(point: TracedContactPoint, w: Vector) -> list[Value]:
    """Return the sizes of what a link that turns with ``w`` spins about the normal and rolls across it, if asked."""
    assert point.turning is not None
    spin = dot(point.normal, w)
    found: list[Value] = []
    spins, rolls = (bound is not None for bound in point.turning.bounds)
    if spins:
        found.append(absolute(spin))
    if rolls:
        rest = w - point.normal * spin
        square = dot(rest, rest)
        found.append(square * inverse_root(square + TINY))
    return found


def turning_dampers(point: TracedContactPoint, fn: Value, turned: Iterable[Value]) -> tuple[Value, ...]:
    """Return the dampers that give the bounds at the rates ``turned``."""
    if point.turning is None:
        return ()
    own, slow = [bound for bound in point.turning.bounds if bound is not None], point.turning.slow
    return tuple(bound * fn * inverse_root(w * w + slow * slow) for bound, w in zip(own, turned, strict=True))


def split(point: TracedContactPoint, dampers: Sequence[Value]) -> tuple[Value, Value]:
    """Return the dampers about the normal and across it, zero for those that a point does not have."""
    if point.turning is None:
        return 0.0, 0.0
    left = iter(dampers)
    about, across = (0.0 if bound is None else next(left) for bound in point.turning.bounds)
    return about, across


def moment_at(point: TracedContactPoint, dampers: tuple[Value, ...], w: Vector) -> Vector:
    """Return the moment on a link that turns with ``w``."""
    about, across = split(point, dampers)
    return point.normal * ((across - about) * dot(point.normal, w)) - w * across


def finish_turning(
    point: TracedContactPoint, dampers: tuple[Value, ...], w: Vector, fn: Value, h: Value
) -> tuple[Vector, Value, tuple[Value, ...]]:
    """Return the moment of a pass, its largest excess over a bound [N], and the dampers of the next pass.

    An excess counts over the point's length. ``w``: how the link turns after the pass. ``fn``: the normal force.
    """
    turning = point.turning
    assert turning is not None
    turned, worst = rates(point, w), 0.0
    own = [bound for bound in turning.bounds if bound is not None]
    predicted: list[Value] = []
    for rate, damper, bound in zip(turned, dampers, own, strict=True):
        beyond = damper * rate - bound * fn
        over = select(less(0.0, beyond), beyond, 0.0)
        predicted.append(rate + (h * turning.weight) * over)
        worst = over if isinstance(worst, float) else select(less(worst, over), over, worst)
    found = turning_dampers(point, fn, predicted)
    return moment_at(point, dampers, w), worst * reciprocal(turning.length), found
