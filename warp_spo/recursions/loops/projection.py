"""Projection onto the closures of embedded loops: small steps of q and qd, and the closures' errors and Jacobian."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...trace.emission import Store
from ...trace.scalars import Value
from ...trace.spatial import total
from ..model.links import Link
from .closures import closures
from .clusters import Columns
from .embedded import ClosedLoops, Embedding

if TYPE_CHECKING:
    from ..model.tracing import Trace


def place_links(trace: Trace, moves: bool = False) -> None:
    """Place every link; with ``moves`` compute velocity terms too."""
    for link in trace.links.links:
        trace.place(link, moves)


def closure_error(trace: Trace) -> list[Store]:
    """out [row] = g"""
    place_links(trace)
    constraints = closures(trace.links)
    values = [value for c in constraints for value in c.error(trace.places, trace.vector("q"))]
    return [Store("out", (i,), value) for i, value in enumerate(values)]


def closure_jacobian(trace: Trace) -> list[Store]:
    """out [row, dof] = Y"""
    place_links(trace)
    constraints = closures(trace.links)
    rows = [row for c in constraints for row in c.jacobian(trace.places)]
    return [Store("out", (i, dof), value) for i, row in enumerate(rows) for dof, value in row.items()]


def project_position(trace: Trace, embedding: Embedding, fixed: tuple[int, ...] = ()) -> list[Store]:
    """out [coordinate] = q after the shortest step of the dofs not ``fixed`` that makes g zero to first order"""
    q, loops = trace.vector("q"), ClosedLoops(trace, embedding)
    place_links(trace)
    step: Columns = {}
    for cluster in loops.clusters:
        constrained = loops.constrain(cluster, fixed)
        step |= constrained.space.particular([-g for g in constrained.errors(trace.places, q)])
    return move_all(trace, step)


def move_all(trace: Trace, step: Columns) -> list[Store]:
    """out [coordinate] = q after a small step by dof; dofs that ``step`` leaves out do not move

    The links have to be placed before, see :func:`place_links`.
    """
    stores = []
    for link in trace.links.leaders:
        trace.label(link, "q")
        coordinates = move(trace, link, [step.get(dof, 0.0) for dof in link.dofs])
        stores += [Store("out", (link.coordinate + i,), value) for i, value in enumerate(coordinates)]
    return stores


def move(trace: Trace, link: Link, step: list[Value]) -> list[Value]:
    """Return the coordinates of a link after a small step of its dofs."""
    return link.hinge.perturb(link, trace.places[id(link)], trace.vector("q"), step)


def project_velocity(trace: Trace, embedding: Embedding, fixed: tuple[int, ...] = ()) -> list[Store]:
    """out [dof] = qd after the shortest change of the dofs not ``fixed`` that makes Y qd zero"""
    qd, loops = trace.vector("qd"), ClosedLoops(trace, embedding)
    place_links(trace)
    step: Columns = {}
    for cluster in loops.clusters:
        constrained = loops.constrain(cluster, fixed)
        step |= constrained.space.particular([-total(x * qd(i) for i, x in row.items()) for row in constrained.rows])
    return [Store("out", (dof,), qd(dof) + step.get(dof, 0.0)) for dof in range(trace.links.scene.dof_count)]
