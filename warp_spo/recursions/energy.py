"""Kinetic energy, and potential energy of gravity and springs."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..trace.emission import Store
from ..trace.spatial import ZERO, Vector, dot
from .kinematics import link_velocities, place_all
from .momentum import composite_inertias
from .step.joint_laws import JointLaws

if TYPE_CHECKING:
    from .model.tracing import Trace


def kinetic_energy(trace: Trace) -> list[Store]:
    """out [] = sum of V* M V / 2 over links, and of armature qd^2 / 2 over dofs"""
    velocities, qd, twice = link_velocities(trace), trace.vector("qd"), 0.0
    for link in trace.links.links:
        trace.label(link, "e")
        if link.inertia is not None:
            w, v = velocities[id(link)]
            n, f = link.inertia.apply(w, v)
            twice = twice + (dot(w, n) + dot(v, f))
        for dof, armature in zip(link.dofs, link.armature, strict=True):
            twice = twice + armature * (qd(dof) * qd(dof))
        for (i, j), x in link.coupling_inertia.items():
            twice = twice + (2.0 * x) * (qd(link.dofs[i]) * qd(link.dofs[j]))
    return [Store("out", (), 0.5 * twice)]


def potential_energy(trace: Trace) -> list[Store]:
    """out [] = -g* (sum of m c over all bodies), and the energy of all springs"""
    origins, bodies = place_all(trace), composite_inertias(trace)
    first = trace.places[id(trace.links.links[0])].pose.l
    moment = moment_of_ground(trace)
    for link in trace.links.links:
        if link.parent is None:
            trace.label(link, "e")
            body, key = bodies[id(link)], id(link)
            moment = moment + trace.axes[key] @ body.moment + (origins[key] + first) * body.mass
    springs, energy = (
        JointLaws(trace.links, 0.0, trace.vector("q"), trace.vector("qd")),
        -dot(trace.links.gravity, moment),
    )
    for link in trace.links.leaders:
        trace.label(link, "s")
        for part in springs.spring_energies(link):
            energy = energy + part
    return [Store("out", (), energy)]


def moment_of_ground(trace: Trace) -> Vector:
    """Return the sum of m c of the bodies that no hinge can move, in the inertial frame."""
    moment: Vector = ZERO
    for body, placement in trace.links.placements.items():
        if placement.link is None:
            rigid, axes, origin = trace.links.nodes[body].rigid, placement.matrix, placement.offset
            if body in trace.links.flexible:  # its other pieces are links
                _, axes, origin, _, rigid = trace.links.flexible[body]
            moment = moment + origin * rigid.mass + axes @ rigid.moment
    return moment
