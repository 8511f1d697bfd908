"""Momentum and centre of mass of all that moves, from composite inertias."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..trace.emission import Store, merge
from ..trace.scalars import Entry, Value, reciprocal
from ..trace.spatial import ZERO, Rigid, Vector, Wrench, cross
from . import articulated, composite, newton_euler
from .kinematics import link_accelerations, link_velocities, place_all, zero
from .model.links import Link

if TYPE_CHECKING:
    from .model.tracing import Trace


def composite_inertias(trace: Trace) -> dict[int, Rigid]:
    """Return R(k) of every placed link: the rigid inertia of all that it carries, in its frame."""
    found: dict[int, Rigid] = {}
    for link in reversed(trace.links.links):
        trace.label(link, "R")
        body = link.inertia or composite.NOTHING
        for child in link.children:
            body = body + trace.places[id(child)].pose.rigid_to_parent(found[id(child)])
        found[id(link)] = body
    return found


def center_of_mass(trace: Trace, bodies: dict[int, Rigid], origins: dict[int, Vector]) -> tuple[Value, Vector]:
    """Return 1 / mass, and the CoM of all moving bodies in inertial axes, from the first root's link."""
    trace.graph.step = "whole|c"
    mass: Value = 0.0
    moment = ZERO
    for link in trace.links.links:
        if link.parent is None:
            body = bodies[id(link)]
            mass = mass + body.mass
            moment = moment + trace.axes[id(link)] @ body.moment + origins[id(link)] * body.mass
    inverse = reciprocal(mass)
    return inverse, moment * inverse


def momenta(trace: Trace, link: Link, body: Rigid) -> list[Wrench]:
    """Return (n; f) = R(k) H* of each dof of a link, inertial axes, about the link's origin."""
    R, found = trace.axes[id(link)], []
    for H in articulated.columns(link, trace.places[id(link)]):
        n, f = body.apply(Vector(H[:3]), Vector(H[3:]))
        found.append((R @ n, R @ f))
    return found


def com(trace: Trace) -> list[Store]:
    """out [3] = centre of mass of all moving bodies in the inertial frame"""
    origins, bodies = place_all(trace), composite_inertias(trace)
    _, c = center_of_mass(trace, bodies, origins)
    first = trace.places[id(trace.links.links[0])].pose.l
    return [Store("out", (i,), value) for i, value in enumerate(c + first)]


def com_velocity(trace: Trace) -> list[Store]:
    """out [3] = linear momentum, added up inward, over the mass"""
    velocities, momenta_of = link_velocities(trace), dict[int, Vector]()
    mass, momentum = 0.0, ZERO
    for link in reversed(trace.links.links):
        trace.label(link, "h")
        key, own = id(link), ZERO
        if link.inertia is not None:
            mass, (_, own) = mass + link.inertia.mass, link.inertia.apply(*velocities[key])
        for child in link.children:
            own = own + trace.places[id(child)].pose.to_parent(momenta_of[id(child)])
        momenta_of[key] = own
        if link.parent is None:
            momentum = momentum + trace.axes[key] @ own
    return [Store("out", (i,), value) for i, value in enumerate(momentum * reciprocal(mass))]


def com_jacobian(trace: Trace) -> list[Store]:
    """out [3, dof] = linear momentum per unit qd over the mass"""
    origins, bodies = place_all(trace), composite_inertias(trace)
    inverse, _ = center_of_mass(trace, bodies, origins)
    stores = []
    for link in trace.links.links:
        trace.label(link, "j")
        for dof, (_, f) in zip(link.dofs, momenta(trace, link, bodies[id(link)]), strict=True):
            stores += [Store("out", (c, dof), value * inverse) for c, value in enumerate(f)]
    return merge(stores) if trace.links.shares_dofs else stores


def centroidal_momentum_matrix(trace: Trace) -> list[Store]:
    """out [6, dof] = linear momentum, angular momentum about the CoM, inertial axes, per unit qd"""
    origins, bodies = place_all(trace), composite_inertias(trace)
    _, c = center_of_mass(trace, bodies, origins)
    stores = []
    for link in trace.links.links:
        trace.label(link, "h")
        arm = origins[id(link)] - c
        for dof, (n, f) in zip(link.dofs, momenta(trace, link, bodies[id(link)]), strict=True):
            stores += [Store("out", (i, dof), value) for i, value in enumerate((*f, *(n + cross(arm, f))))]
    return merge(stores) if trace.links.shares_dofs else stores


def centroidal_momentum_bias(trace: Trace, qdd: Entry = zero) -> list[Store]:
    """out [6] = A qdd + A' qd: the force and the moment about the CoM that the motion takes, without gravity"""
    origins = place_all(trace, moves=True)
    alpha, bodies = link_accelerations(trace, qdd), composite_inertias(trace)
    _, c = center_of_mass(trace, bodies, origins)
    forces: dict[int, Vector] = {}
    n, f = ZERO, ZERO
    for link in reversed(trace.links.links):
        trace.label(link, "f")
        key = id(link)
        force = Vector((*ZERO, *ZERO))
        if link.inertia is not None:
            force = newton_euler.body_force(link.inertia, trace.motions[key], *alpha[key])
        for child in link.children:
            n_c, f_c = Vector(forces[id(child)][:3]), Vector(forces[id(child)][3:])
            n_c, f_c = trace.places[id(child)].pose.force_to_parent(n_c, f_c)
            force = force + Vector((*n_c, *f_c))
        forces[key] = force
        if link.parent is None:
            f_r = trace.axes[key] @ Vector(force[3:])
            n, f = n + trace.axes[key] @ Vector(force[:3]) + cross(origins[key] - c, f_r), f + f_r
    return [Store("out", (i,), value) for i, value in enumerate((*f, *n))]
