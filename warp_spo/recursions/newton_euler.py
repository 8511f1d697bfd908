"""Newton-Euler: tau = H phi (M alpha + b) + Delta qdd; the force relation dual to eq. 20."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from ..trace.emission import Store
from ..trace.scalars import Entry, Value
from ..trace.spatial import IDENTITY, ZERO, Matrix, Rigid, Twist, Vector, Wrench, cross, skew
from .model.links import Link, LinkPlacement
from .motion import VelocityTerms, armature_forces, carry_acceleration, hinge_entries, hinge_motion

if TYPE_CHECKING:
    from .model.tracing import Trace


def link_acceleration(link: Link, place: LinkPlacement, motion: VelocityTerms, acceleration: Twist, qdd: Any) -> Twist:
    """Return the acceleration of the link for that of its parent and ``qdd(dof)``."""
    if link.hinge.unconstrained and link.parent is None:
        back = place.turned.T  # type: ignore[union-attr]
        w, v = root_acceleration(link, acceleration, qdd)
        return back @ w, back @ v
    w, v = carry_acceleration(place, motion, acceleration)
    w_j, v_j = hinge_motion(link, place, qdd)
    return w + motion.bias_w + w_j, v + motion.bias_v + v_j


def root_acceleration(link: Link, base: Twist, qdd: Any) -> Twist:
    """Return the acceleration of a free root link in the axes of its rates; ``base`` is that of the inertial frame."""
    back = (link.matrix or IDENTITY).T
    rates = [qdd(dof) for dof in link.dofs]
    return back @ base[0] + Vector(rates[3:]), back @ base[1] + Vector(rates[:3])


def body_force(inertia: Rigid, motion: VelocityTerms, w: Vector, v: Vector) -> Vector:
    """Return the (n; f) that gives a body the classical acceleration (w; v) at its frame's origin."""
    rotation: Matrix = skew(w) + motion.whirl
    n = inertia.inertia @ w + cross(inertia.moment, v) + cross(motion.spin, inertia.inertia @ motion.spin)
    return Vector((*n, *(inertia.mass * v + rotation @ inertia.moment)))


SEVERAL = 3  # wrenches on one link from which it takes fewer operations to add them up in inertial axes


def wrench(axes: Matrix, com: Vector, force: Vector, torque: Vector) -> Wrench:
    """Return (n; f) about the frame's origin, in its ``axes``, for a force at ``com`` and a torque in inertial axes."""
    f, n = axes.T @ force, axes.T @ torque
    return n + cross(com, f), f


def add_wrenches(axes: Matrix, acting: list[tuple[Vector, Vector, Vector]]) -> Wrench:
    """Return the sum of :func:`wrench` for several (com, force, torque).

    Of several bodies, the products com_i force_j in mixed axes are added up before they are turned: sum of com x R* f =
    the skew part of (sum of com f*) R.
    """
    if len(acting) < SEVERAL:
        n, f = ZERO, ZERO
        for com, force, torque in acting:
            n_body, f_body = wrench(axes, com, force, torque)
            n, f = n + n_body, f + f_body
        return n, f
    force, torque, products = ZERO, ZERO, Matrix.of([ZERO] * 3)
    for com, own_force, own_torque in acting:
        force, torque = force + own_force, torque + own_torque
        products = products + Matrix.of([x * own_force for x in com])
    turned = products @ axes
    moment = Vector(turned[i][j] - turned[j][i] for i, j in ((1, 2), (2, 0), (0, 1)))
    return axes.T @ torque + moment, axes.T @ force


def hinge_force(link: Link, place: LinkPlacement, n: Vector, f: Vector, qdd: Any) -> list[Value]:
    """Return tau of the link's dofs for the force (n; f) that its hinge transmits."""
    forces = hinge_entries(link, place, n, f)
    return [force + own for force, own in zip(forces, armature_forces(link, qdd), strict=True)]


def root_force(
    link: Link, place: LinkPlacement, n: Vector, f: Vector, mass: float, v: Vector, base: Twist, qdd: Any
) -> list[Value]:
    """The same for a free link on the inertial frame that carries ``mass``, itself included, and accelerates with v.

    The force that gives all of the mass one acceleration is most of f. It never enters the link's axes: a rotation in
    float32 is off by 1e-7 from its inverse, and f would be so too.
    """
    forces = hinge_force(link, place, n, f - v * mass, qdd)
    return [*(Vector(forces[:3]) + root_acceleration(link, base, qdd)[1] * mass), *forces[3:]]


def inverse_dynamics(
    trace: Trace, gravity: bool = True, qdd: Entry | None = None, letter: str = "z", moves: bool = True
) -> list[Store]:
    """out = Mass qdd + bias_force, for ``qdd`` or the array of that name; without velocity terms if not ``moves``"""
    base = trace.base_acceleration if gravity else (ZERO, ZERO)
    qdd, moves = qdd or trace.vector("qdd"), moves and "qd" in trace.inputs
    alpha: dict[int, Twist] = {}
    forces: dict[int, Vector] = {}
    shared: dict[int, Value] = {}  # of dofs that several links share
    stores = []
    for link, outward in trace.traversal():
        key = id(link)
        if outward:
            trace.place(link, moves)
            trace.label(link, "a")
            above = base if link.parent is None else alpha[id(link.parent)]
            alpha[key] = link_acceleration(link, trace.places[key], trace.motions[key], above, qdd)
            continue
        trace.label(link, "f")
        f = -trace.external_wrench(link)
        if link.grouped is not None:
            f = f + body_force(link.grouped, trace.motions[key], *alpha[key])
        for other in trace.exchange.from_children(link, letter, forces, Vector):
            f = f + other
        n, f = Vector(f[:3]), Vector(f[3:])
        mass = trace.links.carried_mass(link)
        if mass is None:
            tau = hinge_force(link, trace.places[key], n, f, qdd)
        else:
            tau = root_force(link, trace.places[key], n, f, mass, alpha[key][1], base, qdd)
        if link.shared_dofs is None:
            stores += [Store("out", (dof,), value) for dof, value in zip(link.dofs, tau, strict=True)]
        else:
            for dof, value in zip(link.dofs, tau, strict=True):
                shared[dof] = shared.get(dof, 0.0) + value
            stores += [Store("out", (dof,), shared[dof]) for dof in link.dofs if link.is_last]
        if link.parent is not None:
            n, f = trace.places[key].pose.force_to_parent(n, f)
            forces[key] = Vector((*n, *f))
            stores += trace.exchange.send_to_parent(letter, link, forces[key])
    return stores
