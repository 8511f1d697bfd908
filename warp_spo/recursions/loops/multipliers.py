"""Loops by Lagrange multipliers, as traces: Mass qdd + bias_force = tau + Y* lambda, Y qdd + Y' qd = 0.

With qdd(0) the accelerations of the open tree, (Y Mass^-1 Y*) lambda = -(Y qdd(0) + Y' qd); the tree then moves under
tau + Y* lambda. Y touches only what lies between a loop's ends; loops may span the robot and reach the inertial frame.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ...trace.emission import Store
from ...trace.scalars import Entry, Value
from ...trace.spatial import ZERO, Vector, total
from .. import articulated
from ..articulated_sweeps import NO_TERMS, StepTerms, expand, mirror, pivots, reduce, weighted_products
from ..motion import STILL
from .closures import closures, count_open_rows
from .clusters import Columns
from .projection import move_all, place_links

if TYPE_CHECKING:
    from ..model.tracing import Trace


def constraint_rows(trace: Trace) -> list[Columns]:
    """Return Y, each row by dof; after the links are placed."""
    trace.graph.step = "loops|y"
    found = [row for constraint in closures(trace.links) for row in constraint.jacobian(trace.places)]
    return [{dof: x for dof, x in row.items() if not (x.__class__ is float and x == 0.0)} for row in found]


def loop_system(trace: Trace, tau: Entry | None = None, terms: StepTerms = NO_TERMS) -> list[Store]:
    """out [row, row] = Y Mass^-1 Y*; right [row] = Y qdd(0) + Y' qd; size [row]; for ``tau`` or the array"""
    moves = "qd" in trace.inputs
    done, rates, _ = reduce(trace, tau or trace.vector("tau"), moves, loads=True, terms=terms)
    open_ = {item.index[0]: item.value for item in expand(trace, done, rates, trace.base_acceleration)}
    qd = trace.vector("qd") if moves else None
    trace.graph.step = "loops|g"
    right = [a for c in closures(trace.links) for a in c.acceleration(trace.places, qd, open_.__getitem__)]
    columns = {}
    for i, row in enumerate(constraint_rows(trace)):
        trace.graph.step = f"loop row {i}|m"
        columns[i] = _rates_of_loads(trace, done, row)
    stores = mirror(weighted_products(trace, *pivots(done), columns))
    return stores + [Store("right", (i,), value) for i, value in enumerate(right)] + _sizes(trace)


def _sizes(trace: Trace) -> list[Store]:
    """size [row]: the square of what each row is a projection of"""
    sizes = [size for c in closures(trace.links) for size in c.sizes(trace.places)]
    return [Store("size", (i,), value) for i, value in enumerate(sizes)]


def _rates_of_loads(trace: Trace, done: dict[int, articulated.LinkFactor], tau: Columns) -> dict[int, list[Value]]:
    """Return D^-1 [I - H psi K] tau, by link."""
    rates: dict[int, list[Value]] = {}
    forces: dict[int, Vector] = {}
    for link in reversed(trace.links.links):
        below = [forces[id(child)] for child in link.children if id(child) in forces]
        right: list[Any] = [tau.get(dof, 0.0) for dof in link.dofs]
        if not below and not any(dof in tau for dof in link.dofs):
            continue
        force = Vector(total(other[c] for other in below) for c in range(6)) if below else Vector((*ZERO, *ZERO))
        key = id(link)
        rates[key], forces[key] = articulated.reduce_link(link, trace.places[key], done[key], STILL, force, right)
    return rates


def loop_forward_dynamics(trace: Trace) -> list[Store]:
    """out [dof] = Mass^-1 (tau + Y* lambda - bias_force), lambda the array "multipliers"."""
    place_links(trace, "qd" in trace.inputs)
    tau, given = trace.vector("tau"), trace.vector("multipliers")
    loads = combine_rows(trace, given)
    done, rates, _ = reduce(trace, lambda dof: tau(dof) + loads.get(dof, 0.0), "qd" in trace.inputs, loads=True)
    return expand(trace, done, rates, trace.base_acceleration)


def combine_rows(trace: Trace, weights: Any) -> Columns:
    """Return Y* weights, by dof."""
    found: Columns = {}
    for i, row in enumerate(constraint_rows(trace)):
        for dof, x in row.items():
            found[dof] = found.get(dof, 0.0) + x * weights(i)
    return found


def closure_system(trace: Trace, rates: bool = False) -> list[Store]:
    """out [row, row] = Y Y*; right [row] = g, or Y qd; size [row]"""
    place_links(trace)
    rows = constraint_rows(trace)
    if rates:
        qd = trace.vector("qd")
        right = [total(x * qd(dof) for dof, x in row.items()) for row in rows]
    else:
        right = [g for c in closures(trace.links) for g in c.error(trace.places, trace.vector("q"))]
    stores = [Store("right", (i,), value) for i, value in enumerate(right)] + _sizes(trace)
    for i, row in enumerate(rows):
        for j, other in enumerate(rows[: i + 1]):
            value = total(x * other[dof] for dof, x in row.items() if dof in other)
            stores += [Store("out", place, value) for place in {(i, j), (j, i)}]
    return stores


def closure_step(trace: Trace, rates: bool = False) -> list[Store]:
    """out = q moved, or qd changed, by Y* times the array "multipliers"."""
    place_links(trace)
    step = combine_rows(trace, trace.vector("multipliers"))
    if rates:
        qd = trace.vector("qd")
        return [Store("out", (dof,), qd(dof) + step.get(dof, 0.0)) for dof in range(trace.links.scene.dof_count)]
    return move_all(trace, step)


def closures_open(trace: Trace) -> list[Store]:
    """out [1] = how many rows are open"""
    place_links(trace)
    return [
        Store("out", (0,), count_open_rows(closures(trace.links), trace.places, trace.vector("q"), trace.vector("qd")))
    ]
