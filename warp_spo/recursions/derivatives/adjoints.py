"""Products with the Jacobians of the dynamics, J* y and J x, as traces.

The reverse of forward dynamics is forward dynamics' own solve and one Newton-Euler recursion in reverse: with
lambda = Mass^-1 y, J* y is lambda for tau and -(d tau / d x)* lambda at the accelerations for every other argument x.
A result is stored in "out" if it is the first of those asked for, and in ``name_bar`` otherwise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import TYPE_CHECKING

import numpy as np

from ...scene.actuators import ACTUATOR_VALUES
from ...scene.contact_values import CONTACT_VALUES
from ...scene.ground import GROUND_VALUES
from ...trace.differentiation import forward, reverse
from ...trace.emission import Store
from ...trace.scalars import Entry, Scalar, Value, ordered
from ...trace.spatial import ZERO, total
from ..articulated_sweeps import NO_TERMS, StepTerms, expand, reduce
from ..composite import mass_matrix
from ..coordinates import difference, integrate, interpolate
from ..energy import kinetic_energy, potential_energy
from ..forward_dynamics import forward_dynamics
from ..kinematics import body_poses, body_velocities, frame_accelerations, frame_poses, frame_velocities, jacobian
from ..model.links import Link
from ..momentum import com, com_velocity
from ..newton_euler import inverse_dynamics
from ..step.actuation import actuator_force, build_joint_laws
from ..step.descendants import states_after
from .power import Gradients, Power
from .tangents import coordinate_directions, tangent_gradient

if TYPE_CHECKING:
    from ..model.tracing import Trace


COORDINATES = ("q", "q_before", "target_q", "q0", "q1", "joint_rest_q")  # arguments and values that are laid out as q


class TreeEquations:
    """The equations that the accelerations of an open tree solve: Mass qdd + bias_force = tau."""

    def __init__(self, trace: Trace):
        self.trace = trace

    def solve(self, right: Entry, terms: StepTerms = NO_TERMS) -> dict[int, Value]:
        """Return Mass^-1 ``right``, by dof; Mass with what a time step adds to it, ``terms``."""
        done, rates, _ = reduce(self.trace, right, moves=False, loads=False, terms=terms)
        return {item.index[0]: item.value for item in expand(self.trace, done, rates, (ZERO, ZERO))}

    def gradient(self, solved: dict[int, Value], qdd: Entry, tau: Entry, right: Entry) -> Gradients:
        """Return the gradient of solved . (tau - Mass qdd - bias_force) by all arguments but tau.

        ``solved`` and tau count as constants.

        Args:
            solved, right: by dof, Mass solved = ``right``.
            qdd, tau: by dof, the accelerations and forces for which the equations hold. An open tree reads neither tau
                nor ``right``; they are for closed loops.
        """
        return Power(self.trace, lambda dof: -solved[dof], qdd).gradients

    def project_state(self, stores: list[Store]) -> list[Store]:
        """Return a state after a step, "q_out" and "out", with its constraints enforced; a tree has none."""
        return stores


def inverse_dynamics_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of inverse dynamics for the arguments ``wrt``"""
    power = Power(trace, trace.vector("cotangent"), trace.vector("qdd"))
    return power.stores + gradient_stores(trace, power.gradients, wrt, wrt)


def forward_dynamics_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of forward dynamics for the arguments ``wrt``

    "qdd" is what it makes, and "solved" Mass^-1 cotangent, where they are given.
    """
    if "qdd" in trace.inputs:
        qdd = trace.vector("qdd")
    else:
        qdd = {item.index[0]: item.value for item in forward_dynamics(trace)}.__getitem__
    solved = (
        trace.vector("solved")
        if "solved" in trace.inputs
        else TreeEquations(trace).solve(trace.vector("cotangent")).__getitem__
    )
    power = Power(trace, lambda dof: -solved(dof), qdd)
    others = tuple(name for name in wrt if name != "tau")
    stores = power.stores + gradient_stores(trace, power.gradients, others, wrt)
    dofs = [dof for link in trace.own_links for dof in link.dofs if link.is_leader] if "tau" in wrt else []
    return stores + [Store(result_name("tau", wrt), (dof,), solved(dof)) for dof in dofs]


def solve_mass_matrix_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of Mass^-1 b, which is "qdd": lambda for b, -(d (Mass qdd) / d x)* lambda for the others"""
    solved = TreeEquations(trace).solve(trace.vector("cotangent"))
    power = Power(trace, lambda dof: -solved[dof], trace.vector("qdd"), base=(ZERO, ZERO))
    stores = gradient_stores(trace, power.gradients, tuple(name for name in wrt if name != "b"), wrt)
    return stores + [Store(result_name("b", wrt), (dof,), solved[dof]) for dof in solved if "b" in wrt]


def body_poses_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of body_poses"""
    return pull_back(trace, body_poses(trace), wrt)


def body_velocities_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of body_velocities"""
    return pull_back(trace, body_velocities(trace), wrt)


def com_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of com"""
    return pull_back(trace, com(trace), wrt)


def com_velocity_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of com_velocity"""
    return pull_back(trace, com_velocity(trace), wrt)


def kinetic_energy_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of kinetic_energy"""
    return pull_back(trace, kinetic_energy(trace), wrt)


def potential_energy_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of potential_energy"""
    return pull_back(trace, potential_energy(trace), wrt)


def difference_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of difference"""
    return pull_back(trace, difference(trace), wrt)


def interpolate_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of interpolate"""
    return pull_back(trace, interpolate(trace), wrt)


def mass_matrix_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of mass_matrix, both triangles"""
    return pull_back(trace, mass_matrix(trace), wrt)


def frame_poses_vjp(trace: Trace, frames: tuple, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of frame_poses"""
    return pull_back(trace, frame_poses(trace, frames), wrt)


def frame_velocities_vjp(trace: Trace, frames: tuple, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of frame_velocities"""
    return pull_back(trace, frame_velocities(trace, frames), wrt)


def frame_accelerations_vjp(trace: Trace, frames: tuple, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of frame_accelerations"""
    return pull_back(trace, frame_accelerations(trace, frames), wrt)


def jacobian_vjp(trace: Trace, frames: tuple, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of jacobian"""
    return pull_back(trace, jacobian(trace, frames), wrt)


def integrate_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of integrate"""
    return pull_back(trace, integrate(trace), wrt)


def actuator_force_vjp(trace: Trace, wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of actuator_force; a control or a force beyond its range has derivative zero"""
    return pull_back(trace, actuator_force(trace), wrt)


def step_vjp(trace: Trace, wrt: tuple[str, ...], equations: TreeEquations | None = None) -> list[Store]:
    """J* (q_cotangent; qd_cotangent) of a step whose accelerations are "qdd".

    qd' = qd + dt qdd, and q' moves along qd'. qdd solves Mass qdd + bias_force = tau + f(dt qdd), f the forces of
    the hinges; so its cotangent goes through (Mass + dt R)^-1, R the slope of f in the pieces that held, and then
    through the equation, in which qdd stays.

    Args:
        equations: what the accelerations solve; those of the open tree unless given.
    """
    equations = equations or TreeEquations(trace)
    trace.compensate_gravity()
    qdd, qd, h = trace.vector("qdd"), trace.vector("qd"), trace.graph.input("dt", 0)
    pushed = trace.vector("q_cotangent"), trace.vector("qd_cotangent")
    links = trace.links.leaders
    dofs = [dof for link in links for dof in link.dofs]
    after = {dof: qd(dof) + h * qdd(dof) for dof in dofs}
    moved = [*states_after(trace, links, trace.vector("q"), qd, after, h)]
    state = [Store("out", (dof,), x) for link, _, rates in moved for dof, x in zip(link.dofs, rates, strict=True)]
    state += [Store("q_out", (link.coordinate + c,), x) for link, values, _ in moved for c, x in enumerate(values)]
    state = equations.project_state(state)
    seeds = [pushed[item.array == "out"](item.index[0]) for item in state]
    results = [item.value for item in state]
    ends = [x for x in ordered(results, after.values()) if x.op == "input" and x.args[0] != "dt"]
    back = reverse(results, [*after.values(), *ends], seeds)
    found = dict(zip((x.args for x in ends), back[len(dofs) :], strict=True))
    rates = dict(zip(dofs, back, strict=False))
    joint_laws = build_joint_laws(trace, h)
    forces: dict[int, Value] = {}
    stiff: dict[int, Value] = {}

    def stiffened(link: Link) -> Link:
        for dof, laws in zip(link.dofs, joint_laws.laws(link), strict=True):
            u = h * qdd(dof)
            forces[dof] = total(law.at(u) for law in laws)
            stiff[dof] = h * total(law.piece(u).resistance for law in laws)
        armature = (a + stiff[dof] for a, dof in zip(link.armature, link.dofs, strict=True))
        return dataclasses.replace(link, armature=tuple(armature))

    solved, tau = equations.solve(lambda dof: h * rates[dof], StepTerms(stiffened)), trace.vector("tau")
    right = {dof: h * rates[dof] - stiff[dof] * solved[dof] for dof in dofs}
    gradients = equations.gradient(solved, qdd, lambda dof: tau(dof) + forces[dof], right.__getitem__)
    inputs = [x for x in ordered(forces.values()) if x.op == "input"]
    back = reverse(forces.values(), inputs, [solved[dof] for dof in forces])
    for entry, gradient in [*gradients.items(), *zip((x.args for x in inputs), back, strict=True)]:
        found[entry] = found.get(entry, 0.0) + gradient
    for dof in dofs:
        found["qd", dof] = found.get(("qd", dof), 0.0) + rates[dof]
        found["tau", dof] = solved[dof]
    return [Store(result_name(name, wrt), index, value) for name in wrt for index, value in entries(trace, name, found)]


def inverse_dynamics_jvp(trace: Trace) -> list[Store]:
    """out = J x of inverse dynamics, x in the arrays "q_dot" (tangent), "qd_dot", "qdd_dot", "body_f_dot\""""
    return [Store("out", (dof,), value) for dof, value in inverse_dynamics_rates(trace).items()]


def forward_dynamics_jvp(trace: Trace) -> list[Store]:
    """out = J x of forward dynamics at the accelerations "qdd", x with "tau_dot" for "qdd_dot\""""
    rates, tau = inverse_dynamics_rates(trace), trace.vector("tau_dot")
    solved = TreeEquations(trace).solve(lambda dof: tau(dof) - rates[dof])
    return [Store("out", (dof,), value) for dof, value in solved.items()]


def rates_along(trace: Trace, outputs: list[Value], still: Iterable[Scalar] = ()) -> list[Value]:
    """Return the rates of ``outputs`` along the arrays "q_dot", "qd_dot" ...; ``still`` scalars have none."""
    still = list(still)
    inputs = [x for x in ordered(outputs, still) if x.op == "input"]
    raw = coordinate_directions(trace, trace.vector("q_dot"))
    seeds = [raw.get(x.args[1], 0.0) if x.args[0] == "q" else _direction(trace, x) for x in inputs]
    return forward(outputs, [*inputs, *still], [*seeds, *[0.0] * len(still)])


def gradient_stores(
    trace: Trace, found: dict[tuple, Value], wrt: tuple[str, ...], names: tuple[str, ...]
) -> list[Store]:
    """Return the stores of gradients ``found`` by entry of an input, for the arguments ``wrt`` among all ``names``."""
    stores = []
    for name in wrt:
        gradient = tangent_gradient(trace, found) if name == "tangent" else entries(trace, name, found)
        stores += [Store(result_name(name, names), index, value) for index, value in gradient]
    return stores


def entries(trace: Trace, name: str, found: dict[tuple, Value]) -> Iterable[tuple[tuple[int, ...], Value]]:
    """Return (index, gradient) of every entry of an argument, or of "value"; zero for entries that do not enter."""
    if name == "body_f":
        places: list[tuple] = [(body, c) for body in range(trace.links.scene.body_count) for c in range(6)]
    elif name == "value":
        places = [(i,) for i in range(len(trace.links.tables["value"]))]
    elif name == "ctrl":
        places = [(number,) for number in range(len(trace.links.scene.actuators))]
    elif name in (*ACTUATOR_VALUES, *CONTACT_VALUES, *GROUND_VALUES):
        return _value_entries(trace, name, found)
    elif name in COORDINATES:
        places = [
            (link.coordinate + c,) for link in trace.own_links for c in range(link.hinge.coordinates) if link.is_leader
        ]
    else:
        places = [(dof,) for link in trace.own_links for dof in link.dofs if link.is_leader]
    return [(place, found.get((name, *place), 0.0)) for place in places]


def _value_entries(trace: Trace, name: str, found: dict[tuple, Value]) -> list[tuple[tuple[int, ...], Value]]:
    """Return (index, gradient) of every entry of a value that is read by its flat index."""
    places = np.ndindex(trace.links.scene.values[name].shape[1:])
    return [(place, found.get((name, flat), 0.0)) for flat, place in enumerate(places)]


def pull_back(trace: Trace, results: list[Store], wrt: tuple[str, ...]) -> list[Store]:
    """J* cotangent of what ``results`` store, for the arguments ``wrt``, by the reverse of their whole graph"""
    seeds = [trace.graph.input("cotangent", *(item.index or (0,))) for item in results]
    outputs = [item.value for item in results]
    inputs = [x for x in ordered(outputs) if x.op == "input"]
    gradients = dict(zip((x.args for x in inputs), reverse(outputs, inputs, seeds), strict=True))
    return gradient_stores(trace, gradients, wrt, wrt)


def inverse_dynamics_rates(trace: Trace) -> dict[int, Value]:
    """Return J x of inverse dynamics, by dof."""
    tau = inverse_dynamics(trace)
    outputs = [item.value for item in tau]
    return {item.index[0]: rate for item, rate in zip(tau, rates_along(trace, outputs), strict=True)}


def _direction(trace: Trace, x: Scalar) -> Value:
    name, *index = x.args
    return trace.graph.input(f"{name}_dot", *index) if f"{name}_dot" in trace.inputs else 0.0


def result_name(name: str, wrt: tuple[str, ...]) -> str:
    """Return the array that a gradient is stored in."""
    return "out" if name == wrt[0] else f"{name}_bar"
