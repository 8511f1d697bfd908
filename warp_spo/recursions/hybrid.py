"""Hybrid dynamics: dofs that follow a given qdd are not eliminated, P+ = P and z+ = z + P H* qdd; the others are.

Going out, T = H f + Delta qdd is the force that a prescribed dof needs, f = P alpha + z being what its hinge
transmits. Featherstone, Rigid Body Dynamics Algorithms, 9.2; Jain 2011, ch. 9. A mask says which dofs are prescribed:
the constants 0 and 1 fold into the code; a symbol selects between both, whatever the one not wanted is.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

from ..trace.emission import Store
from ..trace.scalars import Value, is_constant, select
from ..trace.spatial import Articulated, Pose, Twist, Vector, dot, total
from . import articulated, newton_euler
from .articulated import LEAST, NO_INERTIA, LinkFactor, Pivot
from .articulated_sweeps import NO_FORCE, Factors, inside, total_inertia
from .model import shared_dofs
from .model.links import Link, LinkPlacement
from .motion import VelocityTerms, carry_acceleration

if TYPE_CHECKING:
    from .model.tracing import Trace


class Given(NamedTuple):
    """The given entries of a link's dofs: qdd where ``mask`` is not 0, tau elsewhere."""

    mask: list[Value]
    tau: list[Value]
    qdd: list[Value]

    @property
    def free(self) -> bool:
        """Whether the mask is constant and prescribes no dof of the link."""
        return all(is_constant(m) and not m for m in self.mask)


def factor(
    link: Link,
    place: LinkPlacement,
    mask: list[Value],
    carried_on: list[Articulated],
    through: list[tuple[Pose, Articulated]],
    epsilon: float,
) -> LinkFactor:
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
    lost_pivot: Value = 0.0
    if link.inertia is None and not link.children:  # it moves no inertia, so nobody would notice a lost pivot
        lost_pivot = total(
            select(m, 0.0, articulated.zero_or_nan(p.D)) for m, p in zip(mask[::-1], pivots, strict=True)
        )
        P = P + Articulated.build(lambda i, j: lost_pivot if i == j else 0.0)
    in_parent = NO_INERTIA if link.parent is None else place.pose.articulated_to_parent(P)
    return LinkFactor(pivots, P, in_parent, whole=False, turned=False, lost_pivot=lost_pivot)


def reduce_link(
    link: Link, place: LinkPlacement, done: LinkFactor, motion: VelocityTerms, force: Vector, given: Given
) -> tuple[list[Value], list[Value], Vector]:
    """Of each pivot D^-1 (tau - H z), or qdd if it is prescribed; H z; and z+ in the parent's frame."""
    rates, forces_at_rest, z = [], [], force
    for pivot, held, tau, qdd in zip(done.pivots, given.mask[::-1], given.tau[::-1], given.qdd[::-1], strict=True):
        forces_at_rest.append(dot(pivot.column, z))
        rates.append(select(held, qdd, (tau - forces_at_rest[-1]) * pivot.inverse))
        z = z + pivot.U * rates[-1]
    return rates, forces_at_rest, articulated.force_on_parent(link, place, done, motion, z)


def expand_link(
    link: Link,
    place: LinkPlacement,
    done: LinkFactor,
    rates: list[Value],
    forces_at_rest: list[Value],
    motion: VelocityTerms,
    acceleration: Twist,
    given: Given,
) -> tuple[list[Value], list[Value], Twist]:
    """qdd and tau of the link's dofs and its acceleration, for the ``acceleration`` of its parent."""
    w, v = carry_acceleration(place, motion, acceleration)
    alpha = Vector((*(w + motion.bias_w), *(v + motion.bias_v)))
    qdd, tau = [], []
    for pivot, rate, force_at_rest, held, b in zip(
        done.pivots[::-1], rates[::-1], forces_at_rest[::-1], given.mask, given.tau, strict=True
    ):
        along = dot(pivot.U, alpha)
        qdd.append(rate - pivot.inverse * along)
        tau.append(select(held, along + pivot.D * qdd[-1] + force_at_rest, b))
        alpha = alpha + pivot.column * qdd[-1]
    return qdd, tau, (Vector(alpha[:3]), Vector(alpha[3:]))


class HybridSweeps:
    """Both sweeps of hybrid dynamics over a trace, link by link, and what the inward one leaves to the outward one.

    Args:
        trace: what the sweeps write into.
        mask: constant mask by dof; None: the array "prescribed" is the mask.

    Attributes:
        given: prescribed qdd, tau and mask of each link's dofs. All attributes but ``shared`` are by id of the link.
        done: factors.
        rates: D^-1 (tau - H z) of each pivot, or the prescribed qdd.
        forces_at_rest: H z of each pivot: the force on the dof at zero acceleration, velocity terms included.
        inner, forces: P+ and z+ in the parent's frame.
        waiting: z of links that share dofs, until the last of them eliminates these dofs.
        shared: qdd of dofs that links share, by dof.
    """

    def __init__(self, trace: Trace, mask: tuple[bool, ...] | None):
        self.trace = trace
        prescribed = trace.vector("prescribed") if mask is None else lambda dof: float(mask[dof])
        self.entries = prescribed, trace.vector("tau"), trace.vector("qdd")
        self.given: dict[int, Given] = {}
        self.done: Factors = {}
        self.rates: dict[int, list[Value]] = {}
        self.forces_at_rest: dict[int, list[Value]] = {}
        self.inner: dict[int, Articulated] = {}
        self.forces: dict[int, Vector] = {}
        self.waiting: dict[int, Vector] = {}
        self.shared: dict[int, Value] = {}

    def reduce(self, link: Link) -> None:
        """Eliminate the dofs of a link, after those of its children: keep its factor, P+, z+ and the rates.

        If no dof of the link is prescribed, this is the step of the articulated-body algorithm. A prescribed dof leaves
        P as it is and adds P H* qdd to z. Links that share dofs wait until the last of them eliminates these dofs.
        """
        trace, key = self.trace, id(link)
        trace.label(link, "P")
        place, move = trace.places[key], trace.motions[key]
        carried = [self.inner[id(child)] for child in link.children]  # P+ of the children, in the link's frame
        through = [inside(trace, child, self.done) for child in link.children]  # poses and P+ in the children's frames
        self.given[key] = known = Given(*([entry(dof) for dof in link.dofs] for entry in self.entries))
        if link.shared_dofs is not None:
            self._wait(link, total_inertia(link, carried))
            return
        if known.free:
            done = articulated.factor(link, place, carried, through, trace.epsilon)
        else:
            done = factor(link, place, known.mask, carried, through, trace.epsilon)
        self.done[key], self.inner[key] = done, done.in_parent
        z = self._force(link)
        if known.free:
            self.rates[key], self.forces[key] = articulated.reduce_link(link, place, done, move, z, known.tau)
        else:
            self.rates[key], self.forces_at_rest[key], self.forces[key] = reduce_link(link, place, done, move, z, known)

    def _force(self, link: Link) -> Vector:
        """Return z: velocity terms less outer wrenches, and what the children hand on."""
        self.trace.label(link, "z")
        z = articulated.gyroscopic(link.inertia, self.trace.motions[id(link)]) - self.trace.external_wrench(link)
        for child in link.children:
            z = z + self.forces[id(child)]
        return z

    def _wait(self, link: Link, P: Articulated) -> None:
        """Keep P and z of a link that shares dofs; the last of these links eliminates the dofs."""
        trace, key = self.trace, id(link)
        self.inner[key], self.forces[key] = NO_INERTIA, NO_FORCE
        self.done[key] = articulated.LinkFactor([], P, NO_INERTIA, False, False, 0.0)
        self.waiting[key] = self._force(link)
        if not link.is_last:
            return
        assert link.shared_dofs is not None
        leader, known = link.shared_dofs.links[0], self.given[key]
        own = {id(one): self.done[id(one)].P for one in link.shared_dofs.links}
        together = shared_dofs.factor(leader, trace.places, own, trace.epsilon, known.mask)
        self.done[id(leader)], self.inner[key] = together, together.in_parent
        found = shared_dofs.reduce(
            together, trace.places, trace.motions, self.waiting, known.tau, (known.mask, known.qdd)
        )
        self.rates[id(leader)], self.forces_at_rest[id(leader)], self.forces[key] = found

    def expand(self, link: Link, above: Twist) -> tuple[Twist, list[Store]]:
        """Return the acceleration of a link for that of its parent, and the stores of its qdd and tau."""
        trace, key = self.trace, id(link)
        known, place, move = self.given[key], trace.places[key], trace.motions[key]
        if link.shared_dofs is not None:
            stores = self._expand_group(link, above) if link.is_leader else []
            return newton_euler.link_acceleration(link, place, move, above, self.shared.__getitem__), stores
        if known.free:
            qdd, alpha = articulated.expand_link(link, place, self.done[key], self.rates[key], move, above)
            tau = known.tau
        else:
            qdd, tau, alpha = expand_link(
                link, place, self.done[key], self.rates[key], self.forces_at_rest[key], move, above, known
            )
        return alpha, _stores(link, qdd, tau)

    def _expand_group(self, leader: Link, above: Twist) -> list[Store]:
        """Return the stores of a group's qdd and tau."""
        key, known = id(leader), self.given[id(leader)]
        qdd, row_forces = shared_dofs.expand(self.done[key], self.rates[key], above)
        self.shared |= zip(leader.dofs, qdd, strict=True)
        needed = (a + b for a, b in zip(row_forces, self.forces_at_rest[key][::-1], strict=True))
        tau = [select(held, x, b) for held, x, b in zip(known.mask, needed, known.tau, strict=True)]
        return _stores(leader, qdd, tau)


def _stores(link: Link, qdd: list[Value], tau: list[Value]) -> list[Store]:
    return [
        store
        for dof, a, force in zip(link.dofs, qdd, tau, strict=True)
        for store in (Store("out", (dof,), a), Store("tau_out", (dof,), force))
    ]


def hybrid_dynamics(trace: Trace, mask: tuple[bool, ...] | None = None) -> list[Store]:
    """out = qdd, tau_out = tau: dofs under the mask follow qdd, the others tau.

    Args:
        mask: constant mask by dof; None: the array "prescribed" is the mask.
    """
    sweeps, moves = HybridSweeps(trace, mask), "qd" in trace.inputs
    for link, outward in trace.traversal():
        if outward:
            trace.place(link, moves)
        else:
            sweeps.reduce(link)
    alpha: dict[int, Twist] = {}
    stores: list[Store] = []
    for link in trace.links.links:
        trace.label(link, "a")
        above = trace.base_acceleration if link.parent is None else alpha[id(link.parent)]
        alpha[id(link)], more = sweeps.expand(link, above)
        stores += more
    return stores
