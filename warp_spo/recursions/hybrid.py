"""Hybrid dynamics: dofs that follow a given qdd are not eliminated, P+ = P and z+ = z + P H* qdd; the others are.

Going out, T = H f + Delta qdd is the force that a prescribed dof needs, f = P alpha + z being what its hinge
transmits. Featherstone, Rigid Body Dynamics Algorithms, 9.2; Jain 2011, ch. 9. A mask says which dofs are prescribed:
the constants 0 and 1 fold into the code; a symbol selects between both, whatever the one not wanted is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from ..trace.emission import Store
from ..trace.scalars import Value, is_constant, select
from ..trace.spatial import Articulated, Pose, Vector, dot, total
from . import articulated, groups, newton_euler
from .articulated import LEAST, NO_INERTIA, Factor, Pivot
from .articulated_sweeps import NO_FORCE, Factors, inside, total_inertia
from .links import Link, Placed
from .motion import Motion, carry_acceleration

if TYPE_CHECKING:
    from .tracing import Trace


class Given(NamedTuple):
    """The given entries of a link's dofs: qdd where ``mask`` is not 0, tau elsewhere."""

    mask: list[Value]
    tau: list[Value]
    qdd: list[Value]

    @property
    def free(self) -> bool:
        return all(is_constant(m) and not m for m in self.mask)


def factor(
    link: Link,
    place: Placed,
    mask: list[Value],
    carried_on: list[Articulated],
    through: list[tuple[Pose, Articulated]],
    epsilon: float,
) -> Factor:
    """As :func:`articulated.factor`, dof by dof, in the coordinates of qd; a prescribed dof's pivot has 1 / D = 0."""
    P = NO_INERTIA if link.inertia is None else link.inertia.articulated
    for other in carried_on:
        P = P + other
    hinge = link.hinge
    units: tuple[int | None, ...] = (None,) * hinge.dofs
    if hinge.units is not None and not hinge.rates_in_parent:
        units = hinge.units
    pivots = []
    for column, unit, armature, held in zip(
        articulated.columns(link, place)[::-1], units[::-1], link.armature[::-1], mask[::-1], strict=True
    ):
        if is_constant(held) and held:
            n, f = P.apply(Vector(column[:3]), Vector(column[3:]))
            U = Vector((*n, *f))
            pivots.append(Pivot(unit, column, U, dot(column, U) + armature, 0.0))
            continue
        if unit is not None:
            (size,) = articulated.cancellation_sizes(link, P, [unit], through)
            pivot, rest = articulated.eliminate_unit(P, unit, armature, LEAST * epsilon * size)
        else:
            pivot, rest = articulated.eliminate(P, column, armature, LEAST * epsilon)
        pivots.append(pivot._replace(inverse=select(held, 0.0, pivot.inverse)))
        P = Articulated.build(lambda i, j, P=P, rest=rest, held=held: select(held, P.entry(i, j), rest.entry(i, j)))
    nothing: Value = 0.0
    if link.inertia is None and not link.children:  # it moves no inertia, so nobody would notice a lost pivot
        nothing = total(select(m, 0.0, articulated.zero_or_nan(p.D)) for m, p in zip(mask[::-1], pivots, strict=True))
        P = P + Articulated.build(lambda i, j: nothing if i == j else 0.0)
    in_parent = NO_INERTIA if link.parent is None else place.pose.articulated_to_parent(P)
    return Factor(pivots, P, in_parent, whole=False, turned=False, nothing=nothing)


def reduce_link(
    link: Link, place: Placed, done: Factor, motion: Motion, force: Vector, given: Given
) -> tuple[list[Value], list[Value], Vector]:
    """Of each pivot D^-1 (tau - H z), or qdd if it is prescribed; H z; and z+ in the parent's frame."""
    rates, heads, z = [], [], force
    for pivot, held, tau, qdd in zip(done.pivots, given.mask[::-1], given.tau[::-1], given.qdd[::-1], strict=True):
        heads.append(dot(pivot.column, z))
        rates.append(select(held, qdd, (tau - heads[-1]) * pivot.inverse))
        z = z + pivot.U * rates[-1]
    return rates, heads, articulated.force_on_parent(link, place, done, motion, z)


def expand_link(
    link: Link,
    place: Placed,
    done: Factor,
    rates: list[Value],
    heads: list[Value],
    motion: Motion,
    acceleration: tuple[Vector, Vector],
    given: Given,
) -> tuple[list[Value], list[Value], tuple[Vector, Vector]]:
    """qdd and tau of the link's dofs and its acceleration, for the ``acceleration`` of its parent."""
    w, v = carry_acceleration(place, motion, acceleration)
    alpha = Vector((*(w + motion.bias_w), *(v + motion.bias_v)))
    qdd, tau = [], []
    for pivot, rate, head, held, b in zip(
        done.pivots[::-1], rates[::-1], heads[::-1], given.mask, given.tau, strict=True
    ):
        along = dot(pivot.U, alpha)
        qdd.append(rate - pivot.inverse * along)
        tau.append(select(held, along + pivot.D * qdd[-1] + head, b))
        alpha = alpha + pivot.column * qdd[-1]
    return qdd, tau, (Vector(alpha[:3]), Vector(alpha[3:]))


def hybrid_dynamics(trace: Trace, mask: tuple[bool, ...] | None = None) -> list[Store]:
    """out = qdd, tau_out = tau: dofs under the mask follow qdd, the others tau.

    Args:
        mask: constant mask by dof; None: the array "prescribed" is the mask.
    """
    prescribed = trace.vector("prescribed") if mask is None else lambda dof: float(mask[dof])
    tau, qdd, moves = trace.vector("tau"), trace.vector("qdd"), "qd" in trace.inputs
    given: dict[int, Given] = {}
    done: Factors = {}
    rates: dict[int, list[Value]] = {}
    heads: dict[int, list[Value]] = {}
    inner: dict[int, Articulated] = {}
    forces: dict[int, Vector] = {}
    waiting: dict[int, Vector] = {}  # z of the links of groups
    shared: dict[int, Value] = {}  # qdd of groups
    for link, outward in trace.traversal():
        key = id(link)
        if outward:
            trace.place(link, moves)
            continue
        trace.label(link, "P")
        place, move = trace.places[key], trace.motions[key]
        carried = [inner[id(child)] for child in link.children]
        through = [inside(trace, child, done) for child in link.children]
        given[key] = known = Given(*([entry(dof) for dof in link.dofs] for entry in (prescribed, tau, qdd)))
        if link.group is not None:
            P, inner[key], forces[key] = total_inertia(link, carried), NO_INERTIA, NO_FORCE
            done[key] = articulated.Factor([], P, NO_INERTIA, False, False, 0.0)
            trace.label(link, "z")
            waiting[key] = articulated.gyroscopic(link.inertia, move) - trace.external_wrench(link)
            for child in link.children:
                waiting[key] = waiting[key] + forces[id(child)]
            if link.closes:
                leader = link.group.links[0]
                own = {id(one): done[id(one)].P for one in link.group.links}
                together = groups.factor(leader, trace.places, own, trace.epsilon, known.mask)
                done[id(leader)], inner[key] = together, together.in_parent
                found = groups.reduce(
                    together, trace.places, trace.motions, waiting, known.tau, (known.mask, known.qdd)
                )
                rates[id(leader)], heads[id(leader)], forces[key] = found
            continue
        if known.free:
            done[key] = articulated.factor(link, place, carried, through, trace.epsilon)
        else:
            done[key] = factor(link, place, known.mask, carried, through, trace.epsilon)
        inner[key] = done[key].in_parent
        trace.label(link, "z")
        z = articulated.gyroscopic(link.inertia, move) - trace.external_wrench(link)
        for child in link.children:
            z = z + forces[id(child)]
        if known.free:
            rates[key], forces[key] = articulated.reduce_link(link, place, done[key], move, z, known.tau)
        else:
            rates[key], heads[key], forces[key] = reduce_link(link, place, done[key], move, z, known)
    alpha: dict[int, tuple[Vector, Vector]] = {}
    stores: list[Store] = []
    for link in trace.links.links:
        trace.label(link, "a")
        key = id(link)
        above = trace.base_acceleration if link.parent is None else alpha[id(link.parent)]
        known, place, move = given[key], trace.places[key], trace.motions[key]
        if link.group is not None:
            if link.leads:
                forward, felt = groups.expand(done[key], rates[key], above)
                shared |= zip(link.dofs, forward, strict=True)
                needed = (a + b for a, b in zip(felt, heads[key][::-1], strict=True))
                inverse = [select(held, x, b) for held, x, b in zip(known.mask, needed, known.tau, strict=True)]
                for dof, a, force in zip(link.dofs, forward, inverse, strict=True):
                    stores += [Store("out", (dof,), a), Store("tau_out", (dof,), force)]
            alpha[key] = newton_euler.link_acceleration(link, place, move, above, shared.__getitem__)
            continue
        if known.free:
            forward, alpha[key] = articulated.expand_link(link, place, done[key], rates[key], move, above)
            inverse = known.tau
        else:
            forward, inverse, alpha[key] = expand_link(
                link, place, done[key], rates[key], heads[key], move, above, known
            )
        for dof, a, force in zip(link.dofs, forward, inverse, strict=True):
            stores += [Store("out", (dof,), a), Store("tau_out", (dof,), force)]
    return stores
