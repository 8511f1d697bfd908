"""Reverse mode of inverse dynamics: the gradient of lambda . tau(q, qd, qdd) by its arguments.

lambda . tau = sum over the links of mu . f + sum over the dofs of lambda Delta qdd, where mu are the velocities
(omega; v) for the rates lambda, and f is the force that accelerates a link, less the external one. The motion of a link
follows from that of its parent, so one outward sweep forms the sum, and one inward sweep its gradient by the motion of
each link; the gradient by mu is the force that the link transmits.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, NamedTuple

from ...trace.differentiation import reverse
from ...trace.emission import Store
from ...trace.scalars import Entry, Value, cut, is_constant, ordered
from ...trace.spatial import ZERO, Matrix, Rigid, Twist, Vector, cross, dot, skew
from ..model.links import Link, LinkPlacement
from ..motion import armature_forces, hinge_motion, own_bias, whirl

if TYPE_CHECKING:
    from ..model.tracing import Trace

Gradients = dict[tuple, Value]
"""Gradient of the sum, by name and index of an input of the trace."""


class Moving(NamedTuple):
    """Motion of a link, in its axes.

    Attributes:
        spin: omega. w, v: acceleration, classical. mu_w, mu_v: the velocities mu.
    """

    spin: Vector
    w: Vector
    v: Vector
    mu_w: Vector
    mu_v: Vector


class Seen(NamedTuple):
    """Quantities of a link that its bodies and children read, each scalar cut from its history.

    Attributes:
        axes: in the inertial frame, if external forces are given. turning: a point's acceleration by its arm.
    """

    moving: Moving
    axes: Matrix
    turning: Matrix

    @classmethod
    def of(cls, moving: Moving, axes: Iterable[Vector]) -> Seen:
        apart = Moving(*_cut(moving))
        return cls(apart, Matrix(axes), Matrix(_cut(turning_of(apart))))

    @property
    def all(self) -> list[Value]:
        return _flat([*self.moving, *self.axes, *self.turning])


class FromParent(NamedTuple):
    """Vectors that a link receives from its parent, in its own axes: motion without its own rates, and axes.

    Attributes:
        raw: as computed. apart: the same, cut from their history.
    """

    raw: list[Vector]
    apart: list[Vector]

    @classmethod
    def of(cls, place: LinkPlacement, parent: Seen, axes: Matrix) -> FromParent:
        pose, (spin, w, v, mu_w, mu_v) = place.pose, parent.moving
        mu = pose.motion_to_child(mu_w, mu_v)
        raw = [pose.to_child(spin), pose.to_child(w), pose.to_child(v + parent.turning @ pose.l), *mu, *axes]
        return cls(raw, _cut(raw))


class Power:
    """The sum for one trace, of a whole scene or of a segment, and its gradient.

    Args:
        multiplier, qdd: lambda and the accelerations, by dof: inputs, or what other recursions make.
        base: acceleration of the inertial frame; gravity unless given. moves: links have velocities.

    Attributes:
        ways: gradient by entries of "q", "qd", "qdd", "body_f" and of the scene's values, by name and index.
        stores: messages to other segments. forces: tau, by dof.
    """

    def __init__(self, trace: Trace, multiplier: Entry, qdd: Entry, base: Twist | None = None, moves: bool = True):
        self.trace, self.gradients, self.stores = trace, Gradients(), list[Store]()
        self.forces: dict[int, Value] = {}
        self.rate: Entry = trace.vector("qd") if moves else lambda dof: 0.0
        self.multiplier, self.qdd = lambda dof: cut(multiplier(dof)), lambda dof: cut(qdd(dof))
        w, v = trace.base_acceleration if base is None else base
        inertial = Moving(ZERO, w, v, ZERO, ZERO)
        seen: dict[int | None, Seen] = {None: Seen(inertial, Matrix(), turning_of(inertial))}
        carried: dict[int, FromParent] = {}
        moved: dict[int, Moving] = {}
        bars: dict[int, list[Value]] = {}
        for link, outward in trace.traversal():
            key, over = id(link), None if link.parent is None else id(link.parent)
            if outward:
                trace.place(link)
                trace.label(link, "m")
                carried[key] = FromParent.of(trace.places[key], seen[over], trace.axes.get(key, Matrix()))
                moved[key] = self._motion_of_link(link, carried[key].apart)
                seen[key] = Seen.of(moved[key], carried[key].apart[5:])
                trace.axes[key] = seen[key].axes
                continue
            trace.label(link, "g")
            others = trace.exchange.from_children(link, "B", bars, list)
            bars[key] = self._pull_to_parent(link, seen[key], moved[key], carried[key], seen[over], others)
            self.stores += trace.exchange.send_to_parent("B", link, bars[key])

    def _motion_of_link(self, link: Link, carried: list[Vector]) -> Moving:
        """Return the motion of a link with its own rates added."""
        place, (spin, w, v, mu_w, mu_v, *_) = self.trace.places[id(link)], carried
        rates = self.rate, self.qdd, self.multiplier
        (w_d, v_d), (w_dd, v_dd), (w_l, v_l) = (hinge_motion(link, place, rate) for rate in rates)
        moved = Moving(
            spin + w_d, w + cross(spin, w_d) + w_dd, v + 2.0 * cross(spin, v_d) + v_dd, mu_w + w_l, mu_v + v_l
        )
        own = own_bias(link, place, rates[0])
        return moved if own is None else moved._replace(w=moved.w + own[0], v=moved.v + own[1])

    def _pull_to_parent(
        self, link: Link, mine: Seen, moved: Moving, carried: FromParent, parent: Seen, others: list[list[Value]]
    ) -> list[Value]:
        """Return the gradient by what the link's parent exposes; ``others``: the same from the link's children."""
        bars = self._back([_power(link.grouped, self.trace.external_wrench(link), mine)], [1.0], mine.all)
        for other in others:
            bars = [a + b for a, b in zip(bars, other, strict=True)]
        own = len(mine.all) - 9
        turning = self._back(_flat(turning_of(mine.moving)), bars[own:], mine.all[:own])
        bars = [a + b for a, b in zip(bars[:own], turning, strict=True)]

        before, dofs = _flat(carried.apart[:5]), link.dofs
        rates, weights = [self.qdd(dof) for dof in dofs], [self.multiplier(dof) for dof in dofs]
        forces = armature_forces(link, self.qdd)
        ends = [*before, *rates, *weights]
        bars, axes = self._back([*_flat(moved), *forces], [*bars[:15], *weights], ends), bars[15:]
        for dof, bar in zip(dofs, bars[15:], strict=False):
            self._add(("qdd", dof), bar)
        for dof, bar, f in zip(dofs, bars[15 + len(dofs) :], forces, strict=True):
            self.forces[dof] = self.forces.get(dof, 0.0) + bar + f
        bars = [*bars[:15], *axes]

        turn = self.trace.places[id(link)].pose.turn or ()
        for at, x in enumerate(carried.apart if turn else ()):  # each turns backwards, about the link's z axis
            self._add(("q", link.coordinate + link.hinge.angle), x[1] * bars[3 * at] - x[0] * bars[3 * at + 1])
        ends = [] if link.parent is None else parent.all
        return self._back(_flat(carried.raw), bars, [*ends, *turn])[: len(ends)]

    def _back(self, outputs: list[Value], bars: list[Value], ends: list[Value]) -> list[Value]:
        """Return the gradient by ``ends``, each scalar counted once; gradients by inputs are added to ``gradients``."""
        stops = list({x.key: x for x in ends if not is_constant(x)}.values())
        leaves = [x for x in ordered(outputs, stops) if x.op == "input"]
        found = reverse(outputs, [*stops, *leaves], bars)
        for x, gradient in zip(leaves, found[len(stops) :], strict=True):
            self._add(x.args, gradient)
        left = dict(zip((x.key for x in stops), found, strict=False))
        return [0.0 if is_constant(x) else left.pop(x.key, 0.0) for x in ends]

    def _add(self, entry: tuple, gradient: Value) -> None:
        self.gradients[entry] = self.gradients.get(entry, 0.0) + gradient


def turning_of(moving: Moving) -> Matrix:
    """Return omega'~ + omega~ omega~: the acceleration of a point per unit of its arm."""
    return skew(moving.w) + whirl(moving.spin)


def _power(inertia: Rigid | None, external: Vector, seen: Seen) -> Value:
    """Return mu . f of the bodies of a link, with ``external`` (n; f) at its origin."""
    (spin, w, v, mu_w, mu_v), n, f = seen.moving, -Vector(external[:3]), -Vector(external[3:])
    if inertia is not None:
        n = n + inertia.inertia @ w + cross(inertia.moment, v) + cross(spin, inertia.inertia @ spin)
        f = f + inertia.mass * v + seen.turning @ inertia.moment
    return dot(mu_w, n) + dot(mu_v, f)


def _cut(rows: Iterable[Vector]) -> list[Vector]:
    return [Vector(map(cut, row)) for row in rows]


def _flat(rows: Iterable[Vector]) -> list[Value]:
    return [x for row in rows for x in row]
