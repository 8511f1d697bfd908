"""Forces of springs, dampers, drives, limits, friction and gravity compensation at a state, by themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...trace.emission import Store
from ...trace.scalars import Value
from ...trace.spatial import Vector, total
from ..motion import hinge_entries
from .actuation import build_joint_laws
from .joint_laws import JointLaws

if TYPE_CHECKING:
    from ..model.tracing import Trace


def hinge_force(trace: Trace) -> list[Store]:
    """out = the forces of all laws at q, qd: springs, dampers, drives, limits, friction, actuators under "ctrl"

    Gravity compensation is a part of it.
    """
    joint_laws = build_joint_laws(trace, 0.0)
    stores = []
    held = compensation(trace)
    for link in trace.links.leaders:
        trace.label(link, "f")
        for dof, laws in zip(link.dofs, joint_laws.laws(link), strict=True):
            stores.append(Store("out", (dof,), total(law.at(0.0) for law in laws) + held.get(dof, 0.0)))
    return stores


def passive_force(trace: Trace) -> list[Store]:
    """out = -damping qd - stiffness (q - rest) + the forces that hold up the bodies' gravcomp"""
    joint_laws = JointLaws(trace.links, 0.0, trace.vector("q"), trace.vector("qd"))
    stores = []
    held = compensation(trace)
    for link in trace.links.leaders:
        trace.label(link, "f")
        for dof, law in zip(link.dofs, joint_laws.passive(link), strict=True):
            stores.append(Store("out", (dof,), law.force + held.get(dof, 0.0)))
    return stores


def compensation(trace: Trace) -> dict[int, Value]:
    """Return the generalized forces of gravity compensation, by dof; empty if no body has ``gravcomp``.

    On each body, a force -gravcomp mass gravity acts at its CoM. The result is the sum over the bodies of J* force,
    with the Jacobian J of the CoM. An inward sweep collects it: each link adds its children's wrenches to its own.
    """
    found: dict[int, Value] = {}
    if not trace.compensate_gravity():
        return found
    forces: dict[int, Vector] = {}
    for link, outward in trace.traversal():
        if outward:
            trace.place(link)
            continue
        trace.label(link, "g")
        place, wrench = trace.places[id(link)], trace.external_wrench(link)
        for child in link.children:
            wrench = wrench + forces[id(child)]
        n, f = Vector(wrench[:3]), Vector(wrench[3:])
        for dof, force in zip(link.dofs, hinge_entries(link, place, n, f), strict=True):
            found[dof] = found.get(dof, 0.0) + force  # several links may share a dof
        n, f = place.pose.force_to_parent(n, f)
        forces[id(link)] = Vector((*n, *f))
    return found
