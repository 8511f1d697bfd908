"""Products with the Jacobians of what a step in joint space reads of a state, and of what follows its passes."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...trace.differentiation import reverse
from ...trace.emission import Store
from ...trace.scalars import ordered
from ..contact import joint_system as system
from .adjoints import gradient_stores
from .power import Power

if TYPE_CHECKING:
    from ..model.tracing import Trace

POSES = "poses"


def joint_system_vjp(
    trace: Trace, wrt: tuple[str, ...], surfaces: bool, pairs: tuple[int, ...], motors: tuple[int, ...]
) -> list[Store]:
    """J* cotangent of SCREWS, SURFACES, OF_MOTORS and the poses of the bodies, for the arguments ``wrt``

    Their cotangents are "screws_bar" and so on. Options are those of :func:`..contact.joint_system.joint_system`.
    """
    results = [item for item in system.joint_system(trace, surfaces, pairs, motors) if item.array != "out"]
    states = [item for item in system.joint_states(trace) if item.array != system.VELOCITIES]
    results += [item._replace(array=POSES) if item.array == "out" else item for item in states]
    return _pull_back(trace, results, {item.array: f"{item.array}_bar" for item in results}, wrt)


def joint_state_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* (q_cotangent; qd_cotangent) of the state after the passes, for the arguments ``wrt``, the rates among them"""
    return _pull_back(trace, system.state_after(trace), {"out": "qd_cotangent", "q_out": "q_cotangent"}, wrt)


def joint_power_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of Mass qdd + bias_force, with gravity compensation, for the arguments ``wrt``"""
    trace.compensate_gravity()
    power = Power(trace, trace.vector("cotangent"), trace.vector("qdd"))
    return power.stores + gradient_stores(trace, power.gradients, wrt, wrt)


def _pull_back(trace: Trace, results: list[Store], cotangents: dict[str, str], wrt: tuple[str, ...]) -> list[Store]:
    """Return the stores of the gradients; ``cotangents``: the array that holds those of the results of an array."""
    seeds = [trace.graph.input(cotangents[item.array], *item.index) for item in results]
    outputs = [item.value for item in results]
    inputs = [x for x in ordered(outputs) if x.op == "input"]
    gradients = dict(zip((x.args for x in inputs), reverse(outputs, inputs, seeds, True), strict=True))
    return gradient_stores(trace, gradients, wrt, wrt)
