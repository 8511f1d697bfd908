"""Forces of springs, dampers, drives, limits and friction at a state, by themselves."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..trace.emission import Store
from ..trace.spatial import total
from .impedance import Impedance

if TYPE_CHECKING:
    from .tracing import Trace


def hinge_force(trace: Trace) -> list[Store]:
    """out = the forces of all laws at q, qd: springs, dampers, drives, limits and friction"""
    impedance = Impedance(
        trace.links,
        0.0,
        trace.vector("q"),
        trace.vector("qd"),
        None,
        trace.vector("target_q") if "target_q" in trace.inputs else None,
        trace.vector("target_qd"),
    )
    stores = []
    for link in trace.links.links:
        trace.label(link, "f")
        for dof, laws in zip(link.dofs, impedance.laws(link), strict=True):
            stores.append(Store("out", (dof,), total(law.at(0.0) for law in laws)))
    return stores


def passive_force(trace: Trace) -> list[Store]:
    """out = -damping qd - stiffness (q - rest)"""
    impedance = Impedance(trace.links, 0.0, trace.vector("q"), trace.vector("qd"))
    stores = []
    for link in trace.links.links:
        trace.label(link, "f")
        stores += [Store("out", (dof,), law.force) for dof, law in zip(link.dofs, impedance.passive(link), strict=True)]
    return stores
