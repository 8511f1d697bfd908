"""Sweeps of the articulated-body recursion over a tree: factors and forces inward, accelerations outward."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from ..trace.emission import Store
from ..trace.scalars import Entry, Value, is_constant
from ..trace.spatial import ZERO, Articulated, Pose, Twist, Vector, total
from . import articulated
from .articulated import HERE, NO_INERTIA
from .model import shared_dofs
from .model.links import Link
from .motion import STILL
from .newton_euler import link_acceleration

if TYPE_CHECKING:
    from .model.tracing import Trace
    from .step.phases import PhaseBuilder

Factors = dict[int, Any]
"""The factor of every link by id, of :mod:`.articulated`; at the leader of a group the factor of
:mod:`.shared_dofs`."""
NO_FORCE = Vector((*ZERO, *ZERO))
MANY = 8  # children of a link whose contributions are worth a loop


@dataclasses.dataclass(frozen=True)
class StepTerms:
    """Terms that a time step adds to the equations of motion of links.

    Attributes:
        with_armature: returns a link with what the laws of its joints add to its armature.
        inertia, force: by id of the link: what contacts add to its articulated inertia, and to the forces on it; of a
            segment also for the link that it moves on.
    """

    with_armature: Callable[[Link], Link] = dataclasses.field(default=lambda link: link)
    inertia: dict[int, Articulated] = dataclasses.field(default_factory=dict)
    force: dict[int, Vector] = dataclasses.field(default_factory=dict)


NO_TERMS = StepTerms()


def factor_tree(trace: Trace) -> Factors:
    """Return the factor of every link, by id."""
    return factor(trace)[0]


def factor(trace: Trace) -> tuple[Factors, list[Store]]:
    """Return the factors of every link, by id, and the stores that send them to other segments."""
    done: Factors = {}
    inner: dict[int, Articulated] = {}
    stores: list[Store] = []
    for link, outward in trace.traversal():
        if outward:
            trace.place(link)
            continue
        eliminate(trace, link, done, inner)
        stores += trace.exchange.send_to_parent("P", link, inner[id(link)].packed)
    return done, stores


def eliminate(
    trace: Trace,
    link: Link,
    done: Factors,
    inner: dict[int, Articulated],
    factor: Callable = articulated.factor,
    terms: StepTerms = NO_TERMS,
) -> None:
    """Add the factor of a link to ``done``, and P+ in its parent's frame to ``inner``, after its children's."""
    trace.label(link, "P")
    carried = trace.exchange.from_children(link, "P", inner, Articulated.unpacked)
    if id(link) in terms.inertia:
        carried = [*carried, terms.inertia[id(link)]]
    carried = _add_one_by_one(trace, link, carried, "P")
    if link.shared_dofs is not None:
        P = total_inertia(link, carried)
        done[id(link)] = articulated.LinkFactor([], P, NO_INERTIA, False, False, 0.0)
        inner[id(link)] = NO_INERTIA
        if link.is_last:
            leader = link.shared_dofs.links[0]
            own = {id(one): done[id(one)].P for one in link.shared_dofs.links}
            together = shared_dofs.factor(terms.with_armature(leader), trace.places, own, trace.epsilon)
            done[id(leader)], inner[id(link)] = together, together.in_parent
        return
    through = [inside(trace, child, done) for child in link.children if id(child) in done]
    place = trace.places[id(link)]
    done[id(link)] = found = factor(terms.with_armature(link), place, carried, through, trace.epsilon)
    inner[id(link)] = found.in_parent


def _add_one_by_one(trace: Trace, link: Link, terms: list, letter: str) -> list:
    """Return the sum of what many children send, each added in a step of its own, where equal steps share a text."""
    if not trace.graph.apart or len(terms) < MANY:
        return terms
    found = terms[0]
    for child, term in enumerate(terms[1:], 1):
        trace.graph.step = f"{link.title}, {child}|{letter}"
        found = found + term
    trace.label(link, letter)
    return [found]


def total_inertia(link: Link, carried: list[Articulated]) -> Articulated:
    """Return a link's own inertia and what it carries."""
    P = NO_INERTIA if link.inertia is None else link.inertia.articulated
    for other in carried:
        P = P + other
    return P


def inside(trace: Trace, child: Link, done: dict) -> tuple[Pose, Articulated]:
    """Return what a child adds to its parent's inertia, before its dofs are eliminated in the parent's frame."""
    if child.shared_dofs is None:
        return trace.places[id(child)].pose, done[id(child)].P
    return HERE, done[id(child)].whole if child.is_leader else NO_INERTIA


def reduce(
    trace: Trace,
    tau: Entry,
    moves: bool,
    loads: bool,
    letters: str = "Pz",
    phases: PhaseBuilder | None = None,
    terms: StepTerms = NO_TERMS,
) -> tuple[dict, dict, list[Store]]:
    """Sweep inward: return the factors, D^-1 [I - H psi K] (tau - velocity terms - loads), and the stores that send.

    Args:
        tau: force of a dof. moves: links have velocities. loads: subtract the external wrenches.
        letters: of the messages to other segments; "P" among them sends the articulated inertias.
        phases: receives what does not change from pass to pass, where passes repeat the sweep.
        terms: what a time step adds to the links.
    """
    done: Factors = {}
    rates: dict[int, list[Value]] = {}
    inner: dict[int, Articulated] = {}
    forces: dict[int, Vector] = {}
    waiting: dict[int, Vector] = {}  # z of the links of groups
    stores: list[Store] = []
    for link, outward in trace.traversal():
        key = id(link)
        if outward:
            trace.place(link, moves)
            continue
        eliminate(trace, link, done, inner, terms=terms)
        place, move, factor = trace.places[key], trace.motions[key], done[key]
        trace.label(link, "z")
        z = articulated.gyroscopic(link.inertia, move)
        if loads:
            z = z - trace.external_wrench(link)
        if phases is not None:
            bias = *move.bias_w, *move.bias_v, *move.bias_l
            phases.add_invariants([*(place.pose.turn or ()), *bias, *z])
        if key in terms.force:
            z = z - terms.force[key]
        for force in _add_one_by_one(trace, link, trace.exchange.from_children(link, letters[-1], forces, Vector), "z"):
            z = z + force
        if link.shared_dofs is None:
            right = [tau(dof) for dof in link.dofs]
            rates[key], forces[key] = articulated.reduce_link(link, place, factor, move, z, right)
        else:
            waiting[key], rates[key], forces[key] = z, [], NO_FORCE
            if link.is_last:
                leader, right = id(link.shared_dofs.links[0]), [tau(dof) for dof in link.dofs]
                rates[leader], _, forces[key] = shared_dofs.reduce(
                    done[leader], trace.places, trace.motions, waiting, right
                )
        carried, force = trace.exchange.add_contacts(link, inner[key], forces[key], terms.inertia, terms.force)
        stores += trace.exchange.send_to_parent("P", link, carried.packed) if "P" in letters else []
        stores += trace.exchange.send_to_parent(letters[-1], link, force)
    return done, rates, stores


def expand(
    trace: Trace,
    done: Factors,
    rates: dict,
    base: Twist,
    letter: str = "a",
    name: str = "out",
    alpha: dict[int, Twist] | None = None,
) -> list[Store]:
    """Sweep outward: return stores of qdd in the array ``name``, for ``rates`` of :func:`reduce`.

    ``alpha`` receives the acceleration of every link, by id, and of the link that a segment moves on.
    """
    alpha = {} if alpha is None else alpha
    shared: dict[int, Value] = {}  # qdd of groups
    stores = []
    for link in trace.own_links:
        trace.label(link, "a")
        key = id(link)
        if link.parent is None:
            above = base
        elif trace.exchange.own(link.parent):
            above = alpha[id(link.parent)]
        else:
            assert trace.exchange.parent is not None
            received = trace.exchange.receive(letter, trace.exchange.parent)
            above = alpha[id(link.parent)] = Vector(received[:3]), Vector(received[3:])
        place, move = trace.places[key], trace.motions[key]
        if link.shared_dofs is None:
            qdd, alpha[key] = articulated.expand_link(link, place, done[key], rates[key], move, above)
        else:
            qdd = shared_dofs.expand(done[key], rates[key], above)[0] if link.is_leader else []
            shared |= zip(link.dofs, qdd, strict=False)
            alpha[key] = link_acceleration(link, place, move, above, shared.__getitem__)
            if not link.is_leader:
                continue
        stores += [Store(name, (dof,), value) for dof, value in zip(link.dofs, qdd, strict=True)]
        stores += trace.exchange.send_to_children(letter, link, (*alpha[key][0], *alpha[key][1]))
    return stores


def propagate_inward(
    trace: Trace, done: Factors, link: Link, force: Vector, right: list[Value]
) -> dict[int, list[Value]]:
    """Return D^-1 [I - H psi K] of ``right`` at a link's dofs and a ``force`` on it, by link on the way to the root."""
    rates, over = {}, link
    while True:
        key = id(over)
        if over.shared_dofs is None:
            rates[key], force = articulated.reduce_link(over, trace.places[key], done[key], STILL, force, right)
        else:
            leader = id(over.shared_dofs.links[0])
            rates[leader], _, force = shared_dofs.reduce(done[leader], trace.places, {}, {key: force}, right)
        if over.parent is None:
            return rates
        over = over.parent
        right = [0.0] * len(over.dofs)


def weighted_products(trace: Trace, D: dict, lost_pivot: Value, columns: dict) -> dict[tuple[int, int], Value]:
    """Return the upper triangle of Y* D Y + lost_pivot for columns of Y by link.

    Entries of two columns without a common link are absent, unless a pivot may be lost.
    """
    entries: dict[tuple[int, int], Value] = {}
    names = list(columns)
    for at, i in enumerate(names):
        trace.graph.step = f"column {i}|m"
        weighted = {key: [rate * d for rate, d in zip(rates, D[key], strict=True)] for key, rates in columns[i].items()}
        for j in names[: at + 1]:
            both = [key for key in columns[j] if key in weighted]
            pairs = (pair for key in both for pair in zip(weighted[key], columns[j][key], strict=True))
            entry = total(a * b for a, b in pairs) + lost_pivot
            if both or not is_constant(lost_pivot) or lost_pivot != 0.0:
                entries[j, i] = entry
    return entries


def mirror(entries: dict[tuple[int, int], Value]) -> list[Store]:
    """Return stores of both triangles of a symmetric matrix for the entries of one."""
    return [
        Store("out", place, value)
        for (i, j), value in entries.items()
        for place in ([(i, j)] if i == j else [(i, j), (j, i)])
    ]


def pack(stores: list[Store]) -> list[Store]:
    """Return stores of a lower triangle as a row of entries, row after row."""
    entries = {item.index: item.value for item in stores if item.index[0] >= item.index[1]}
    return [Store("out", (i,), entries[index]) for i, index in enumerate(sorted(entries))]


def pivots(done: Factors) -> tuple[dict[int, list[Value]], Value]:
    """Return D by link; and NaN, or zero, for lost pivots that no other result would show."""
    return {key: [pivot.D for pivot in factor.pivots] for key, factor in done.items()}, total(
        factor.lost_pivot for factor in done.values()
    )
