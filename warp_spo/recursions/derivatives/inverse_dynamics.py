"""Derivatives of the dynamics as traces: dense, O(n depth), by the sensitivities of each link.

For a dof j on the way from i to the root: tau(i) changes with j as the force on H(i) that j's sensitivity makes, and
tau(j) with i as the change of the force that i's link transmits. Four quantities of i go up: both changes of the force,
by q and by qd, H*(i) as a row of the composite inertia, and what it makes of an added spin.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from ...trace.emission import Store, merge
from ...trace.scalars import Value
from ...trace.spatial import ZERO, Rigid, Twist, Vector, Wrench, cross, dot
from .. import composite, motion, newton_euler
from ..model import messages
from ..model.links import Link, LinkPlacement
from ..motion import STILL, VelocityTerms
from . import sensitivity
from .sensitivity import CarriedSums, Sensitivity, SensitivityAdjoint

if TYPE_CHECKING:
    from ..model.tracing import Trace

Q, QD, QDD = range(3)  # blocks of the result
LETTERS = "RULf"
"""Messages: sums over all that a link carries and the force that its hinge transmits, in the parent's frame."""


def inverse_dynamics_derivatives(trace: Trace, mass: bool = True) -> list[Store]:
    """out [3, dof, dof] = d tau / d q along the tangent coordinates, d tau / d qd, Mass; [2, ...] without ``mass``"""
    qdd, moves = trace.vector("qdd"), "qd" in trace.inputs
    rates = trace.vector("qd") if moves else None
    alpha: dict[int, Twist] = {}
    own: dict[int, tuple[list[Sensitivity], list[Sensitivity]]] = {}
    letters = messages.select_sent(LETTERS, trace.inputs)
    inner: dict[str, dict[int, list[Value]]] = {letter: {} for letter in letters}  # what links hand to their parents
    drifts: dict[int, Vector] = {}
    shared: dict[int, tuple[SensitivityAdjoint, list]] = {}  # of dofs that links share
    stores: list[Store] = []
    for link, outward in trace.traversal():
        key, over = id(link), link.parent
        parent: VelocityTerms = STILL if over is None else trace.motions[id(over)]
        if outward:
            trace.place(link, moves)
            place = trace.places[key]
            trace.label(link, "a")
            above = trace.base_acceleration if over is None else alpha[id(over)]
            alpha[key] = newton_euler.link_acceleration(link, place, trace.motions[key], above, qdd)
            trace.label(link, "s")
            drifts[key] = sensitivity.drift(link, place, None if over is None else parent, rates)
            own[key] = (
                sensitivity.of_coordinates(link, place, trace.motions[key], parent, above, alpha[key], rates, qdd),
                sensitivity.of_rates(link, place, trace.motions[key], parent, rates),
            )
            continue
        place = trace.places[key]
        trace.label(link, "c")
        all_in = sensitivity.of_body(link.inertia, trace.motions[key])
        n, f = ZERO, ZERO
        if link.inertia is not None:
            force = newton_euler.body_force(link.inertia, trace.motions[key], *alpha[key])
            n, f = Vector(force[:3]), Vector(force[3:])
        for arm, pull, torque in _wrenches(trace, link):
            all_in = all_in + sensitivity.under_load(arm, pull, torque)
            n, f = n - torque - cross(arm, pull), f - pull
        for parts in zip(*(trace.exchange.from_children(link, x, inner[x], list) for x in letters), strict=True):
            values = dict(zip(letters, parts, strict=True))
            all_in = all_in + CarriedSums.unpacked(values)
            n, f = n + Vector(values["f"][:3]), f + Vector(values["f"][3:])
        if over is not None:
            n_over, f_over = place.pose.force_to_parent(n, f)
            values = sensitivity.to_parent(place, drifts[key], all_in).packed | {"f": [*n_over, *f_over]}
            for letter in letters:
                inner[letter][key] = values[letter]
                stores += trace.exchange.send_to_parent(letter, link, values[letter])
        stores += _entries(trace, link, all_in, (n, f), own, drifts, shared)
        for (i, j), x in link.coupling_inertia.items():
            a, b = link.dofs[i], link.dofs[j]
            stores += [Store("out", (QDD, a, b), x), Store("out", (QDD, b, a), x)]
    stores = [item for item in stores if mass or item.array != "out" or item.index[0] != QDD]
    return merge(stores) if trace.links.shares_dofs else stores


def _wrenches(trace: Trace, link: Link) -> list[tuple[Vector, Vector, Vector]]:
    """(arm, force, torque) of the external wrenches on the bodies of a link, in its frame."""
    found = []
    if "body_f" in trace.inputs:
        back = trace.axes[id(link)].T
        for body in trace.bodies.get(id(link), ()):
            entries = [trace.graph.input("body_f", body, c) for c in range(6)]
            _, com = trace.links.center(body)
            found.append((com, back @ Vector(entries[:3]), back @ Vector(entries[3:])))
    return found


def _sum_of_links(
    one: tuple[SensitivityAdjoint, list], row: SensitivityAdjoint, blocks: list
) -> tuple[SensitivityAdjoint, list]:
    """Return the sums of rows and of forces of two links of a group, as their parent feels them."""
    both = zip(one[1], blocks, strict=True)
    return SensitivityAdjoint(*(a + b for a, b in zip(one[0], row, strict=True))), [
        (block, n + n_other, f + f_other) for (block, n, f), (_, n_other, f_other) in both
    ]


def _entries(
    trace: Trace, link: Link, all_in: CarriedSums, force: Wrench, own: dict, drifts: dict[int, Vector], shared: dict
) -> list[Store]:
    """Return the entries of the three blocks for each dof of the link, paired with the dofs of its hinge and ancestors.

    For each dof of the link, the change of force that the dof makes is projected on its own hinge and carried to every
    ancestor: these entries are the column of the dof. ``row`` is the force on the dof as a function of how the link
    moves otherwise. It is carried along and applied to the ancestors' sensitivities: these entries are the row of the
    dof. Mass is symmetric, so its column is stored as its row, too.

    Args:
        all_in: the sums over all that the link carries.
        force: (n; f) that the link's hinge transmits, in the link's frame.
        own: sensitivities to coordinates and to rates of each link's dofs, by id of the link.
        drifts: of the links, see :func:`.sensitivity.drift`, by id.
        shared: of each dof that links share, the sums over the links so far; this function adds to them.
    """
    place, stores = trace.places[id(link)], []
    by_q, by_qd = own[id(link)]
    changes = link.hinge.column_changes(place)
    for at, (dof, s, s_d, (w, v)) in enumerate(
        zip(link.dofs, by_q, by_qd, sensitivity.columns(link, place), strict=True)
    ):
        trace.label(link, f"d{at}_")
        row = all_in.row(w, v)
        n, f = all_in.force(s)
        change = n + cross(s.turn, force[0]), f + cross(s.turn, force[1])
        blocks = [(Q, *change), (QD, *all_in.force(s_d)), (QDD, row.w, row.v)]
        for block, n_own, f_own in blocks:
            tau = motion.hinge_entries(link, place, n_own, f_own)
            if block == Q and changes is not None:  # columns move with the link, so no turn; they change with q
                tau = [
                    a + _power(c, force)
                    for a, c in zip(motion.hinge_entries(link, place, n, f), changes[at], strict=True)
                ]
            for i, value in zip(link.dofs, tau, strict=True):
                extra = link.armature[at] if block == QDD and i == dof else 0.0
                stores.append(Store("out", (block, i, dof), value + extra))
        # the dof shifts the link's origin in the parent, and with it the line of the force
        blocks[0] = Q, change[0] + cross(s.shift, force[1]), change[1]
        outer = link
        while outer.parent is not None:
            pose = trace.places[id(outer)].pose
            row = row.to_parent(trace.places[id(outer)], drifts[id(outer)])
            blocks = [*((block, *pose.force_to_parent(n, f)) for block, n, f in blocks[:2]), (QDD, row.w, row.v)]
            if outer is link and link.shared_dofs is not None:  # links that share dofs: the last carries on their sum
                row, blocks = shared[dof] = _sum_of_links(shared[dof], row, blocks) if dof in shared else (row, blocks)
                if not link.is_last:
                    break
            outer = outer.parent
            place_outer = trace.places[id(outer)]
            for block, n_outer, f_outer in blocks:
                for i, value in zip(
                    outer.dofs, motion.hinge_entries(outer, place_outer, n_outer, f_outer), strict=True
                ):
                    stores.append(Store("out", (block, i, dof), value))
                    if block == QDD:
                        stores.append(Store("out", (block, dof, i), value))
            for block, sensitivities in ((Q, own[id(outer)][0]), (QD, own[id(outer)][1])):
                for j, other in zip(outer.dofs, sensitivities, strict=True):
                    stores.append(Store("out", (block, dof, j), row.at(other)))
    return stores


def mass_matrix_derivative(trace: Trace) -> list[Store]:
    """out [dof, dof, dof] = d Mass / d q along the tangent coordinates, the last index the coordinate.

    Moving link k turns all that it carries against what is above it. So Mass changes where columns from above, as
    the link sees them, meet its composite inertia, or the momenta that dofs below it hand on.
    """
    heads: dict[int, dict[int, Twist]] = {}  # H* of the dofs above a link and of its own
    tails: dict[int, dict[int, Twist]] = {}  # R H* of the dofs below it
    bodies: dict[int, Rigid] = {}
    stores: list[Store] = []
    for link, outward in trace.traversal():
        key = id(link)
        if outward:
            trace.place(link)
            trace.label(link, "h")
            pose = trace.places[key].pose
            above = {} if link.parent is None else heads[id(link.parent)]
            heads[key] = {dof: pose.motion_to_child(w, v) for dof, (w, v) in above.items()}
            heads[key] |= zip(link.dofs, sensitivity.columns(link, trace.places[key]), strict=True)
            continue
        trace.label(link, "t")
        body, below = link.inertia or composite.NOTHING, dict[int, Twist]()
        for child in link.children:
            pose = trace.places[id(child)].pose
            body = body + pose.rigid_to_parent(bodies[id(child)])
            for dof, tail in tails[id(child)].items():
                n, f = pose.force_to_parent(*tail)
                below[dof] = (below[dof][0] + n, below[dof][1] + f) if dof in below else (n, f)
        bodies[key] = body
        momenta = {dof: body.apply(w, v) for dof, (w, v) in heads[key].items()}
        tails[key] = below | {dof: momenta[dof] for dof in link.dofs}
        for dof in link.dofs:
            trace.label(link, f"m{dof}_")
            changes = _column_changes(link, trace.places[key], heads[key], dof)
            met = {**below, **momenta}
            for i, change in changes.items():
                for j, momentum in met.items():
                    value = _power(change, momentum)
                    if j in changes:
                        if j < i:
                            continue
                        value = value + _power(changes[j], momenta[i])
                    stores += [Store("out", (*at, dof), value) for at in {(i, j), (j, i)}]
    return merge(stores) if trace.links.shares_dofs else stores


def _column_changes(link: Link, place: LinkPlacement, heads: dict, dof: int) -> dict[int, Twist]:
    """Changes of the columns H*, in the link's axes, when the link moves by one of its own dofs."""
    theta, d = heads[dof]
    changes = link.hinge.column_changes(place)
    found = {} if changes is None else dict(zip(link.dofs, changes[link.dofs.index(dof)], strict=True))
    for i, (w, v) in heads.items():
        if i not in link.dofs:
            found[i] = cross(w, theta), cross(w, d) + cross(v, theta)
        elif link.hinge.rates_in_parent:  # they stay with the parent, and a free hinge's meet at the CoM
            found[i] = cross(w, theta), cross(v, theta)
    return found


def _power(velocity: Twist, momentum: Wrench) -> Value:
    return dot(velocity[0], momentum[0]) + dot(velocity[1], momentum[1])
