"""Quasi-velocities nu = sqrt(D) [I + H phi K]* qd, in which the kinetic energy is nu . nu / 2."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..trace.emission import Store
from ..trace.scalars import sqrt
from ..trace.spatial import ZERO, Vector, dot
from . import articulated, hybrid

if TYPE_CHECKING:
    from .tracing import Trace


def factor_by_dofs(trace: Trace) -> dict[int, articulated.Factor]:
    """Return the factors of every link in the coordinates of qd: Mass = U D U*, U unit upper triangular."""
    done: dict[int, articulated.Factor] = {}
    for link, outward in trace.traversal():
        if outward:
            trace.place(link)
            continue
        trace.label(link, "P")
        carried = [done[id(child)].in_parent for child in link.children]
        through = [(trace.places[id(child)].pose, done[id(child)].P) for child in link.children]
        free = [0.0] * len(link.dofs)
        done[id(link)] = hybrid.factor(link, trace.places[id(link)], free, carried, through, trace.epsilon)
    return done


def quasi_velocities(trace: Trace) -> list[Store]:
    """out = sqrt(D) [I + H phi K]* qd"""
    qd, done = trace.vector("qd"), factor_by_dofs(trace)
    velocity: dict[int, Vector] = {}
    stores = []
    for link in trace.links.links:
        trace.label(link, "v")
        key, V = id(link), Vector((*ZERO, *ZERO))
        if link.parent is not None:
            above = velocity[id(link.parent)]
            w, v = trace.places[key].pose.motion_to_child(Vector(above[:3]), Vector(above[3:]))
            V = Vector((*w, *v))
        for dof, pivot in zip(link.dofs, done[key].pivots[::-1], strict=True):
            eta = qd(dof) + pivot.inverse * dot(pivot.U, V)
            stores.append(Store("out", (dof,), sqrt(pivot.D) * eta))
            V = V + pivot.column * qd(dof)
        velocity[key] = V
    return stores
