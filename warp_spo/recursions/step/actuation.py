"""Forces of actuators: of a length l = sum_i gear_i q_i of hinges' coordinates, and of a control value,

    f = strength clip(gain clip(ctrl, ctrl_range) + bias0 + bias1 l + bias2 l', force_range),

within the torque-speed curve where there is one; each hinge receives gear_i f, and of all its actuators together no
more than its effort limit. See :class:`warp_spo.Actuator`.

In a time step these forces are laws of the dofs, see :mod:`.joint_laws`. On one hinge, bias1 and bias2 below zero are a
spring and a damper, which are implicit like those of a drive, between bounds at the rate before the step. All else is
linear in u about the state of the sweep: a motor along its torque-speed curve has the curve's slope for resistance; an
actuator on several hinges has r = |gear_i| sum_j |gear_j| |df / dl'| on hinge i, a diagonal matrix that is not smaller
than its true, full one, so that the step stays stable.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from ...trace.emission import Store
from ...trace.scalars import Value, absolute, is_constant, less, select
from ...trace.spatial import total
from .joint_laws import JointLaws, Law, clip, is_number

if TYPE_CHECKING:
    from ..model.links import Links
    from ..model.tracing import Trace

Entry = Callable[[int], Value]
INFINITY = float("inf")


class Moved(NamedTuple):
    """A hinge that an actuator moves: its dof, its coordinate, and its gear."""

    dof: int
    coordinate: int
    gear: Value


class Push(NamedTuple):
    """The force of an actuator at a state, and its slope -df / dl' there over a step."""

    force: Value
    resistance: Value


class Actuation:
    """The actuators of a scene at one state.

    Args:
        links: of the scene. Values that are variable, or that differ between worlds, are inputs by their name.
        ctrl: entries of the controls.
        q, qd: entries of the state.
    """

    def __init__(self, links: Links, ctrl: Entry, q: Entry, qd: Entry):
        self.links, self.scene, self.ctrl, self.q, self.qd = links, links.scene, ctrl, q, qd
        self.moved: list[list[Moved]] = []
        self.acting: dict[int, list[tuple[int, Moved]]] = {}  # by dof: actuators with their hinge there
        first = 0
        for number, actuator in enumerate(self.scene.actuators):
            starts = [(int(self.scene.qd_start[h]), int(self.scene.q_start[h])) for h in actuator.hinges]
            self.moved.append([Moved(*start, self.value("actuator_gear", first + i)) for i, start in enumerate(starts)])
            first += len(starts)
            for one in self.moved[-1]:
                self.acting.setdefault(one.dof, []).append((number, one))

    # -- values ----------------------------------------------------------------------------------------------------
    def value(self, name: str, entry: int) -> Value:
        """Return a value of the actuators by its flat entry."""
        array = self.scene.values[name]
        column = array.reshape(array.shape[0], -1)[:, entry]
        if name in self.links.variable or (column != column[0]).any():
            return self.links.graph.input(name, entry)
        return float(column[0])

    def bounds(self, name: str, number: int) -> tuple[Value | None, Value | None]:
        """Return the ends of a range; None where there is none in any world."""
        low, high = (self.value(name, 2 * number + end) for end in (0, 1))
        none = lambda x: is_constant(x) and np.isinf(x)  # noqa: E731
        return None if none(low) else low, None if none(high) else high

    def curve(self, number: int, rate: Value) -> tuple[Value | None, Value | None]:
        """Return the bounds of the torque-speed curve at a rate; None where there is no curve."""
        found = self.scene.actuators[number].torque_speed
        if found is None:
            return None, None
        stall, no_load = found
        slip = (stall / no_load) * rate
        low, high = -(stall + slip), stall - slip
        return select(less(low, 0.0), low, 0.0), select(less(0.0, high), high, 0.0)

    def slopes(self, number: int) -> tuple[Value, Value]:
        """Return bias1 and bias2."""
        return self.value("actuator_bias", 3 * number + 1), self.value("actuator_bias", 3 * number + 2)

    def length(self, number: int, coordinate: Callable[[Moved], Value]) -> Value:
        """Return sum_i gear_i x_i."""
        return total(one.gear * coordinate(one) for one in self.moved[number])

    def command(self, number: int) -> Value:
        """Return gain clip(ctrl, ctrl_range) + bias0."""
        control = clip(self.ctrl(number), *self.bounds("actuator_ctrl_range", number))
        return self.value("actuator_gain", number) * control + self.value("actuator_bias", 3 * number)

    # -- forces ----------------------------------------------------------------------------------------------------
    def force(self, number: int) -> Value:
        """Return the force of an actuator before its strength and gear."""
        return self.push(number, lambda one: self.q(one.coordinate), 0.0).force

    def largest_force(self, dof: int) -> float:
        """Return the largest force of a dof's actuators together; infinite unless ranges and factors are constants.

        An effort limit that is no smaller never acts, and is left out.
        """
        most = 0.0
        for number, one in self.acting.get(dof, ()):
            ends = self.bounds("actuator_force_range", number)
            factors = [one.gear, self.value("actuator_strength", number)]
            if not all(isinstance(x, float) for x in (*ends, *factors)):
                return INFINITY
            most += abs(factors[0] * factors[1]) * max(map(abs, ends))  # type: ignore[arg-type, operator]
        return most

    def push(self, number: int, coordinate: Callable[[Moved], Value], h: Value) -> Push:
        """Return the force at the given coordinates, and its slope where the force may be implicit over ``h``."""
        (stiff, damp), rate = self.slopes(number), self.length(number, lambda one: self.qd(one.dof))
        line = self.command(number) + stiff * self.length(number, coordinate) + damp * rate
        low, high = self.bounds("actuator_force_range", number)
        force = clip(line, low, high)
        resistance = -(h * below_zero(stiff) + below_zero(damp))
        resistance = select(outside(line, low, high), 0.0, resistance)
        curve = self.scene.actuators[number].torque_speed
        if curve is not None:
            low, high = self.curve(number, rate)
            past = outside(force, low, high)
            force = clip(force, low, high)
            resistance = select(past, select(absolute(force), curve[0] / curve[1], 0.0), resistance)
        return Push(force, resistance)


class ActuatorLaws:
    """The forces of actuators as laws of the dofs for one step, see :mod:`.joint_laws`.

    Args:
        trace: the evaluation; "ctrl" is among its inputs, "q" and "qd" are the state of its sweep.
        h: length of the step [s].
        qd: entries of the velocities that the step starts from.
        drift: entries of what the step adds to q of the sweep if u = 0.
    """

    def __init__(self, trace: Trace, h: Value, qd: Entry, drift: Entry):
        self.h, self.qd, self.drift, self.at = h, qd, drift, trace.vector("qd")
        self.actuation = Actuation(trace.links, trace.vector("ctrl"), trace.vector("q"), self.at)

    def __call__(self, dof: int) -> list[Law]:
        """Return the laws of a dof, one for each actuator with its hinge there."""
        return [self._law(number, one) for number, one in self.actuation.acting.get(dof, ())]

    def _law(self, number: int, one: Moved) -> Law:
        servo = any(not is_number(below_zero(slope), 0.0) for slope in self.actuation.slopes(number))
        if servo and len(self.actuation.moved[number]) == 1:
            return self._servo_law(number, one)
        return self._linear_law(number, one)

    def _servo_law(self, number: int, one: Moved) -> Law:
        """Return spring and damper on one hinge, in u, between bounds at the rate of the sweep's state."""
        actuation, (dof, coordinate, gear) = self.actuation, one
        (stiff, damp), at = actuation.slopes(number), self.at(dof)
        k, d = below_zero(stiff), below_zero(damp)
        line = actuation.command(number) + gear * (stiff * actuation.q(coordinate) + damp * at)
        line = line + gear * (k * self.drift(dof) + d * (self.qd(dof) - at))
        low, high = actuation.bounds("actuator_force_range", number)
        curve = actuation.curve(number, gear * at)
        if curve[0] is not None:
            low, high = (curve[end] if x is None else clip(x, *curve) for end, x in enumerate((low, high)))
        strong, resistance = actuation.value("actuator_strength", number) * gear, -(self.h * k + d) * gear
        if low is None and high is None:
            return Law(strong * line, strong * resistance)
        if is_constant(gear) and gear > 0.0:
            return Law(line, resistance, low, high, strong)
        ends = -INFINITY if low is None else low, INFINITY if high is None else high
        turned = less(gear, 0.0)  # a law's scale is not negative, so the law itself is turned over
        least, most = select(turned, -ends[1], ends[0]), select(turned, -ends[0], ends[1])
        line, resistance = select(turned, -line, line), select(turned, -resistance, resistance)
        least, most = (None if is_constant(end) and np.isinf(end) else end for end in (least, most))
        return Law(line, resistance, least, most, absolute(strong))

    def _linear_law(self, number: int, one: Moved) -> Law:
        """Return a law that is linear in u, the change of the dof's rate in the step, about u of the sweep's state.

        Coordinates are those that this u leads to at the end of the step, where a spring makes the force implicit.
        """
        actuation = self.actuation

        def rate_change(dof: int) -> Value:
            return self.at(dof) - self.qd(dof)

        def coordinate(other: Moved) -> Value:
            return actuation.q(other.coordinate) + self._implicit_displacement(number, other, rate_change)

        force, slope = actuation.push(number, coordinate, self.h)
        factor = actuation.value("actuator_strength", number) * one.gear
        gear_sum = total(absolute(other.gear) for other in actuation.moved[number])
        resistance = absolute(factor) * gear_sum * slope
        return Law(factor * force + resistance * rate_change(one.dof), resistance)

    def _implicit_displacement(self, number: int, one: Moved, rate_change: Entry) -> Value:
        """Return how far a coordinate moves in the step, where the force may depend on it implicitly; else 0."""
        moved = self.drift(one.dof) + self.h * rate_change(one.dof)
        return select(less(self.actuation.slopes(number)[0], 0.0), moved, 0.0)


def build_joint_laws(trace: Trace, h: Value) -> JointLaws:
    """Return the laws of hinges and actuators at the state of the trace's sweep, over ``h`` seconds.

    The step starts from that state, unless "q_from" and "qd_from" are inputs. Actuators act where "ctrl" is an input.
    """
    given, at = trace.inputs, trace.vector("qd")
    apart = "q_from" in given
    qd = trace.vector("qd_from") if apart else at
    drift = (lambda dof: h * (qd(dof) - at(dof))) if apart else (lambda dof: h * qd(dof))
    return JointLaws(
        trace.links,
        h,
        trace.vector("q"),
        qd,
        drift,
        trace.vector("target_q") if "target_q" in given else None,
        trace.vector("target_qd"),
        ActuatorLaws(trace, h, qd, drift) if "ctrl" in given else None,
    )


def outside(x: Value, low: Value | None, high: Value | None) -> Value:
    """Return non-zero where ``x`` is beyond a bound; None is no bound."""
    return (0.0 if high is None else less(high, x)) + (0.0 if low is None else less(x, low))


def below_zero(x: Value) -> Value:
    """Return ``x`` where it is below zero, else 0."""
    return select(less(x, 0.0), x, 0.0)


def actuator_force(trace: Trace) -> list[Store]:
    """out = the forces tau of all actuators at q, qd and ctrl, within the effort limits"""
    actuation = Actuation(trace.links, trace.vector("ctrl"), trace.vector("q"), trace.vector("qd"))
    joint_laws = JointLaws(trace.links, 0.0, trace.vector("q"), trace.vector("qd"))
    strong = [
        actuation.value("actuator_strength", number) * actuation.force(number) for number in range(len(actuation.moved))
    ]
    stores = []
    for link in trace.links.leaders:
        trace.label(link, "a")
        for dof in link.dofs:
            force = total(one.gear * strong[number] for number, one in actuation.acting.get(dof, ()))
            most = None if joint_laws.is_weak(dof, actuation.largest_force(dof)) else joint_laws.effort_limit(dof)
            stores.append(Store("out", (dof,), force if most is None else clip(force, -most, most)))
    return stores
