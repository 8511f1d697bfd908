"""Quasi-velocities nu = sqrt(D) [I + H phi K]* qd, in which the kinetic energy is nu . nu / 2, and how they change.

Their equations of motion have the identity for a mass matrix: nu' + C(q, nu) = eps, with eps = [I - H psi K] applied to
the forces, over sqrt(D). C does no work, nu . C = 0. Jain, Rodriguez 1995, "Diagonalized Lagrangian robot dynamics".
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..trace.differentiation import forward
from ..trace.emission import Store
from ..trace.scalars import Entry, Value, is_constant, ordered, sqrt
from ..trace.spatial import ZERO, Articulated, Twist, Vector, dot, total
from . import articulated, hybrid
from .articulated_sweeps import Factors, eliminate
from .derivatives.tangents import coordinate_directions
from .model import shared_dofs
from .motion import carry_acceleration, link_motion

if TYPE_CHECKING:
    from .model.links import Link, LinkPlacement
    from .model.tracing import Trace


def factor_by_dofs(trace: Trace) -> Factors:
    """Return the factors of every link in the coordinates of qd: Mass = U D U*, U unit upper triangular."""
    done: Factors = {}
    inner: dict[int, Articulated] = {}
    for link, outward in trace.traversal():
        if outward:
            trace.place(link)
        else:
            eliminate(trace, link, done, inner, _factor)
    return done


def _factor(link: Link, place: LinkPlacement, *carried: Any) -> articulated.LinkFactor:
    return hybrid.factor(link, place, [0.0] * len(link.dofs), *carried)


def quasi_velocities(trace: Trace) -> list[Store]:
    """out = sqrt(D) [I + H phi K]* qd"""
    return _stores(_scale(trace, factor_by_dofs(trace), trace.vector("qd")))


def generalized_velocities(trace: Trace) -> list[Store]:
    """out = [I - H psi K]* nu / sqrt(D)"""
    return _stores(_unscale(trace, factor_by_dofs(trace), trace.vector("nu")))


def quasi_velocity_force(trace: Trace) -> list[Store]:
    """out = eps = [I - H psi K] (tau - gravity_force + forces of body_f) / sqrt(D)"""
    return _stores(_accelerate(trace, factor_by_dofs(trace), trace.vector("tau"), trace.base_acceleration))


def quasi_velocity_coriolis(trace: Trace) -> list[Store]:
    """out = C(q, nu) = -nu' where no force acts: nu changes with its factor, and because qd does"""
    done = factor_by_dofs(trace)
    qd = _unscale(trace, done, trace.vector("nu"))
    _set_velocities(trace, qd.__getitem__)
    by_acceleration = _accelerate(trace, done, lambda dof: 0.0, (ZERO, ZERO))
    by_factor = _change(trace, done, qd)
    return _stores({dof: -(rate + by_factor[dof]) for dof, rate in by_acceleration.items()})


def _scale(trace: Trace, done: Factors, qd: Entry) -> dict[int, Value]:
    """Return sqrt(D) [I + H phi K]* qd by dof."""
    velocity: dict[int, Vector] = {}
    nu: dict[int, Value] = {}
    for link in trace.links.links:
        trace.label(link, "v")
        V = _carry(trace, link, velocity)
        if link.shared_dofs is not None:
            for dof, pivot in zip(link.dofs, done[id(link)].pivots[::-1], strict=False):
                nu[dof] = sqrt(pivot.D) * (qd(dof) + pivot.inverse * _apply_to_pivot(trace, link, pivot, velocity, qd))
            velocity[id(link)] = _add_group_rates(done, link, V, qd)
            continue
        for dof, pivot in zip(link.dofs, done[id(link)].pivots[::-1], strict=True):
            eta = qd(dof) + pivot.inverse * dot(pivot.U, V)
            nu[dof] = sqrt(pivot.D) * eta
            V = V + pivot.column * qd(dof)
        velocity[id(link)] = V
    return nu


def _apply_to_pivot(
    trace: Trace, link: Link, pivot: shared_dofs.SharedPivot, velocity: dict[int, Vector], qd: Entry
) -> Value:
    """Return U* V(p) of a group's pivot, and what the rates before it add."""
    above = Vector((*ZERO, *ZERO)) if link.parent is None else velocity[id(link.parent)]
    return dot(pivot.U, above) + total(x * qd(link.dofs[i]) for i, x in enumerate(pivot.row))


def _add_group_rates(done: Factors, link: Link, V: Vector, qd: Entry) -> Vector:
    """Return V and the velocities that the rates of a group give one of its links."""
    for dof, column in zip(link.dofs, done[id(link.shared_dofs.links[0])].columns[id(link)], strict=True):  # type: ignore[union-attr]
        V = V + column * qd(dof)
    return V


def _unscale(trace: Trace, done: Factors, nu: Entry) -> dict[int, Value]:
    """Return qd = [I - H psi K]* nu / sqrt(D) by dof."""
    velocity: dict[int, Vector] = {}
    qd: dict[int, Value] = {}
    for link in trace.links.links:
        trace.label(link, "v")
        V = _carry(trace, link, velocity)
        if link.shared_dofs is not None:
            for dof, pivot in zip(link.dofs, done[id(link)].pivots[::-1], strict=False):
                known = _apply_to_pivot(trace, link, pivot, velocity, qd.__getitem__)
                qd[dof] = pivot.inverse * (sqrt(pivot.D) * nu(dof) - known)
            velocity[id(link)] = _add_group_rates(done, link, V, qd.__getitem__)
            continue
        for dof, pivot in zip(link.dofs, done[id(link)].pivots[::-1], strict=True):
            qd[dof] = pivot.inverse * (sqrt(pivot.D) * nu(dof) - dot(pivot.U, V))
            V = V + pivot.column * qd[dof]
        velocity[id(link)] = V
    return qd


def _carry(trace: Trace, link: Link, velocity: dict[int, Vector]) -> Vector:
    """Return phi*(p, k) V(p), the velocity (omega; v) of a link whose own hinge stands still."""
    if link.parent is None:
        return Vector((*ZERO, *ZERO))
    above = velocity[id(link.parent)]
    w, v = trace.places[id(link)].pose.motion_to_child(Vector(above[:3]), Vector(above[3:]))
    return Vector((*w, *v))


def _set_velocities(trace: Trace, qd: Entry) -> None:
    """Set the velocity terms of all links, ``trace.motions``, to those at the rates ``qd``."""
    for link in trace.links.links:
        trace.label(link, "w")
        parent = None if link.parent is None else trace.motions[id(link.parent)]
        trace.motions[id(link)] = link_motion(link, trace.places[id(link)], parent, qd)


def _accelerate(trace: Trace, done: Factors, tau: Entry, base: Twist) -> dict[int, Value]:
    """Return sqrt(D) [I + H phi K]* qdd by dof, for the motions and external wrenches of the trace.

    As in forward dynamics, loads and velocity terms enter by bodies and not as forces of the hinges, which would lose
    digits; ``base`` is the acceleration that stands for gravity.
    """
    rates: dict[int, list[Value]] = {}
    forces: dict[int, Vector] = {}
    waiting: dict[int, Vector] = {}  # z of the links of groups
    for link in reversed(trace.links.links):
        trace.label(link, "z")
        key, move = id(link), trace.motions[id(link)]
        z = articulated.gyroscopic(link.inertia, move) - trace.external_wrench(link)
        for child in link.children:
            z = z + forces[id(child)]
        rates[key] = []
        if link.shared_dofs is not None:
            waiting[key], forces[key] = z, Vector((*ZERO, *ZERO))
            if link.is_leader:  # which comes last
                right = [tau(dof) for dof in link.dofs]
                rates[key], _, forces[key] = shared_dofs.reduce(done[key], trace.places, trace.motions, waiting, right)
            continue
        for pivot, dof in zip(done[key].pivots, link.dofs[::-1], strict=True):
            rate, z = articulated.reduce_pivot(pivot, z, tau(dof))
            rates[key].append(rate)
        forces[key] = articulated.force_on_parent(link, trace.places[key], done[key], move, z)
    alpha: dict[int, Twist] = {}  # accelerations at qdd = 0
    found: dict[int, Value] = {}
    for link in trace.links.links:
        trace.label(link, "a")
        key, move = id(link), trace.motions[id(link)]
        above = base if link.parent is None else alpha[id(link.parent)]
        w, v = carry_acceleration(trace.places[key], move, above)
        alpha[key] = w, v = w + move.bias_w, v + move.bias_v
        if link.shared_dofs is not None:
            for dof, pivot, rate in zip(link.dofs, done[key].pivots[::-1], rates[key][::-1], strict=False):
                found[dof] = sqrt(pivot.D) * (rate - pivot.inverse * dot(pivot.U, (*above[0], *above[1])))
            continue
        for dof, pivot, rate in zip(link.dofs, done[key].pivots[::-1], rates[key][::-1], strict=True):
            found[dof] = sqrt(pivot.D) * (rate - pivot.share(dot(pivot.U, (*w, *v))))
    return found


def _change(trace: Trace, done: Factors, qd: dict[int, Value]) -> dict[int, Value]:
    """Return how fast sqrt(D) [I + H phi K]* qd changes while q moves along qd and qd itself stays as it is."""
    still = [x for x in qd.values() if not is_constant(x)]
    nu = _scale(trace, done, qd.__getitem__)
    inputs = [x for x in ordered(nu.values(), still) if x.op == "input" and x not in still]
    along = coordinate_directions(trace, qd.__getitem__)
    seeds = [along[x.args[1]] if x.args[0] == "q" else 0.0 for x in inputs]
    return dict(zip(nu, forward(nu.values(), [*inputs, *still], [*seeds, *[0.0] * len(still)]), strict=True))


def _stores(values: dict[int, Value]) -> list[Store]:
    return [Store("out", (dof,), value) for dof, value in values.items()]
