"""Common parts of the tasks of velocity tracking: observations, rewards and events as in mjlab's velocity task."""

from __future__ import annotations

from typing import Any

import numpy as np

from ...trace.functions import where
from .. import Observation, World, events, rewards
from .. import observations as obs

ACTOR = (
    ("base velocity", obs.base_velocity, 1.0, 0.2),
    ("base angular velocity", obs.base_angular_velocity, 1.0, 0.2),
    ("projected gravity", obs.projected_gravity, 1.0, 0.05),
    ("joint position", obs.joint_position(), 1.0, 0.01),
    ("joint velocity", obs.joint_velocity(), 0.1, 1.0),
    ("last action", obs.last_action, 1.0, 0.0),
    ("command", obs.command, 1.0, 0.0),
)
"""Observations of the actor: name, term, scale, and the size of the noise before scaling."""


def observed(feet: Any, *more: Any) -> dict[str, list]:
    """Return what the actor sees, with noise, and what the critic sees: the truth, the base's height and the feet.

    ``more``: further terms that both see, the critic without the noise, bias and delay of an ``Observation``.
    """
    truth = [
        Observation(obs.joint_position(biased=False) if name == "joint position" else term, scale)
        for name, term, scale, _ in ACTOR
    ]
    noisy = [Observation(term, scale, noise) for _, term, scale, noise in ACTOR]
    true = [term.truth() if isinstance(term, Observation) else term for term in more]
    return {"actor": [*noisy, *more], "critic": [*truth, *true, base_height, feet_state(feet)]}


def base_height(w: World) -> Any:
    """Return the height of the base's origin over the ground [m]."""
    return w.base_height


def feet_state(bodies: Any) -> Any:
    """Return the term of the feet's gaps [m], air times [s], contacts and vertical forces [100 N]."""

    def term(w: World) -> list:
        feet = w.feet(bodies)
        contacts = [where(touches, 1.0, 0.0) for touches in feet.touches]
        return [*feet.gap, *feet.air_time, *contacts, *(0.01 * force[2] for force in feet.force)]

    return term


def upright(w: World) -> Any:
    """Return 1 with the base level; exp(-sin(tilt)^2 / 0.2)."""
    return np.exp(rewards.tilt(w) * (-1.0 / 0.2))


def pose(standing: Any, walking: Any, least_command: float = 0.05) -> Any:
    """Return exp(-mean of (q - default)^2 / deviation^2), with other deviations while standing than on the move."""
    still, moves = rewards.posture(standing), rewards.posture(walking)
    return lambda w: where(rewards.moving(w, least_command), moves(w), still(w))


def swing_height(bodies: Any, height: float, least_command: float = 0.05) -> Any:
    """Return the sum over feet that land of (highest gap of the swing / height - 1)^2, while the command moves."""

    def update(w: World, name: str) -> None:
        feet = w.feet(bodies)
        count = len(feet.gap)
        before = w.memory(name, 2 * count)[:count]
        highest = [where(gap > top, gap, top) for gap, top in zip(feet.gap, before, strict=True)]
        swinging = [where(touches, 0.0, top) for touches, top in zip(feet.touches, highest, strict=True)]
        w.keep(name, [*swinging, *highest])

    def term(w: World) -> Any:
        feet, name = w.feet(bodies), f"highest {bodies!r}"
        count = len(feet.gap)
        highest = w.sensor(name, 2 * count, lambda world: update(world, name))[count:]
        missed = sum(
            where(lands, (top * (1.0 / height) - 1.0) ** 2, 0.0) for lands, top in zip(feet.lands, highest, strict=True)
        )
        return where(rewards.moving(w, least_command), missed, 0.0)

    return term


def trot(bodies: Any, diagonals: Any = ((0, 3), (1, 2)), least_command: float | None = 0.05) -> Any:
    """Return the share of a trot's four rules that hold, while the command moves if ``least_command`` is given.

    Feet of a diagonal touch the ground together or are both in the air; the first feet of the two diagonals are not
    alike, nor are the second. ``diagonals`` are numbers of feet, in the order of the bodies; as it is set, these are
    front left, front right, hind left, hind right.
    """

    def term(w: World) -> Any:
        contact = [where(touches, 1.0, 0.0) for touches in w.feet(bodies).touches]
        (a, b), (c, d) = ([contact[foot] for foot in pair] for pair in diagonals)
        share = 0.25 * sum([1.0 - abs(a - b), 1.0 - abs(c - d), abs(a - c), abs(b - d)])
        return share if least_command is None else where(rewards.moving(w, least_command), share, 0.0)

    return term


def step_phase(stride: float, least_command: float = 0.05) -> Any:
    """Return the term of sine and cosine of 2 pi time / ``stride`` [s], a clock of steps; zeros while it stands."""

    def term(w: World) -> list:
        angle = 2.0 * np.pi * w.phase(stride)
        moves = rewards.moving(w, least_command)
        return [where(moves, np.sin(angle), 0.0), where(moves, np.cos(angle), 0.0)]

    return term


def in_step(bodies: Any, stride: float, stance: float = 0.6, least_command: float = 0.05) -> Any:
    """Return the share of two feet, left and right, that do what a walk's clock says: touch the ground, or swing.

    Each foot touches for ``stance`` of a stride [s], the right one half a stride after the left; the middle of the
    left one's stance is where the cosine of :func:`step_phase` is 1. While the command stands, both touch.
    """

    def term(w: World) -> Any:
        middle = np.cos(2.0 * np.pi * w.phase(stride))
        still = ~rewards.moving(w, least_command)
        share: Any = 0.0
        for touches, at in zip(w.feet(bodies).touches, (middle, -middle), strict=True):
            wanted = (at > float(np.cos(np.pi * stance))) | still
            share = share + where((touches & wanted) | ~(touches | wanted), 0.5, 0.0)
        return share

    return term


def starts() -> list:
    """Return where episodes start: anywhere within half a metre, in any direction, a little above the ground."""
    turned = (-np.pi, np.pi)
    return [events.base(x=(-0.5, 0.5), y=(-0.5, 0.5), z=(0.01, 0.05), yaw=turned), events.joints(position=(-0.1, 0.1))]


def randomisation(trunk: str) -> list:
    """Return what differs between worlds, in mjlab's ranges, and pushes of 0.5 m/s every 1 to 3 s.

    Friction 0.3 to 1.2, the same at all points; the centre of mass of the trunk within 2.5 cm (3 cm along z); what the
    encoders read within 0.015 rad; and the trunk's mass within 10 %.
    """
    return [
        events.randomise("contact_friction", (0.3, 1.2), "set", alike=True),
        events.randomise("body_com", ((-0.025, 0.025), (-0.025, 0.025), (-0.03, 0.03)), "add", names=trunk),
        events.randomise("body_mass", (0.9, 1.1), "scale", names=trunk),
        events.encoder_bias(0.015),
        events.push(velocity=0.5, vertical=0.4, angular_velocity=0.5, seconds=(1.0, 3.0)),
    ]
