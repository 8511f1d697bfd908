"""The regressor of inverse dynamics: tau - Delta qdd = Y parameters, linear in ten numbers of each body.

A body's ten are m, m c (3), Ixx, Ixy, Iyy, Ixz, Iyz, Izz about the origin of its body frame, in its axes. With the body
frame's angular velocity omega, accelerations (alpha; a), gravity included, and the velocities (mu_w; mu_v) that rates
lambda give it, lambda . tau of the body is mu_v . f + mu_w . n,

    f = m a + (alpha~ + omega~ omega~) h,  n = h x a + I alpha + omega x I omega,  h = m c.

Atkeson, An, Hollerbach 1986.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, NamedTuple

from ..trace.emission import Store
from ..trace.scalars import Entry, Value
from ..trace.spatial import IDENTITY, ZERO, Matrix, Pose, Rigid, Twist, Vector, cross, dot, skew, symmetric
from .kinematics import carried_velocity
from .model.links import Link
from .motion import VelocityTerms, hinge_motion, whirl
from .newton_euler import body_force, hinge_entries, link_acceleration

if TYPE_CHECKING:
    from .model.tracing import Trace

COUNT = 10  # parameters of a body
PRODUCTS = ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))  # entries of I, in the order of the parameters


class BodyMotion(NamedTuple):
    """Motion of a body frame, in its axes: omega, and the classical accelerations (alpha; a)."""

    spin: Vector
    alpha: Vector
    a: Vector


def inverse_dynamics_regressor(trace: Trace) -> list[Store]:
    """out [dof, 10 bodies] = Y: each dof's column of H*, carried outward, against each body"""
    stores = []
    columns: dict[int, dict[int, Twist]] = {}
    for link, body, place, motion in bodies_in_motion(trace):
        if id(link) not in columns:
            columns[id(link)] = carried_columns(trace, link, columns)
        for dof, column in columns[id(link)].items():
            trace.label(link, "y")
            values = coefficients(motion, place.motion_to_child(*column))
            stores += [Store("out", (dof, COUNT * body + i), value) for i, value in enumerate(values)]
    return stores


def inverse_dynamics_regressor_transposed_product(trace: Trace) -> list[Store]:
    """out [10 bodies] = Y* tau: the velocities that the rates tau would give, against each body"""
    velocities: dict[int, Twist] = {}
    stores = []
    for link, body, place, motion in bodies_in_motion(trace):
        key = id(link)
        if key not in velocities:
            velocities[key] = carried_rates(trace, link, velocities, trace.vector("tau"))
        trace.label(link, "y")
        values = coefficients(motion, place.motion_to_child(*velocities[key]))
        stores += [Store("out", (COUNT * body + i,), value) for i, value in enumerate(values)]
    return stores


def inverse_dynamics_regressor_product(trace: Trace) -> list[Store]:
    """out [dof] = Y parameters, by the Newton-Euler recursion with the bodies' parameters as inputs"""
    forces: dict[int, Vector] = {}
    for link, body, place, motion in bodies_in_motion(trace):
        m, *rest = (trace.vector("parameters")(COUNT * body + i) for i in range(COUNT))
        xx, xy, yy, xz, yz, zz = rest[3:]
        inertia = Rigid(m, Vector(rest[:3]), symmetric(xx, yy, zz, xy, xz, yz))
        moving = VelocityTerms(motion.spin, whirl(motion.spin), ZERO, ZERO, ZERO)
        own = body_force(inertia, moving, motion.alpha, motion.a)
        n, f = place.force_to_parent(Vector(own[:3]), Vector(own[3:]))
        force = Vector((*n, *f))
        forces[id(link)] = forces[id(link)] + force if id(link) in forces else force
    stores = []
    for link in reversed(trace.links.links):
        trace.label(link, "f")
        here, force = trace.places[id(link)], forces.get(id(link), Vector((*ZERO, *ZERO)))
        n, f = Vector(force[:3]), Vector(force[3:])
        stores += [Store("out", (d,), x) for d, x in zip(link.dofs, hinge_entries(link, here, n, f), strict=True)]
        if link.parent is not None:
            n, f = here.pose.force_to_parent(n, f)
            above, handed = id(link.parent), Vector((*n, *f))
            forces[above] = forces[above] + handed if above in forces else handed
    return stores


def bodies_in_motion(trace: Trace) -> Iterator[tuple[Link, int, Pose, BodyMotion]]:
    """Yield each body that moves, parents first: its link, the body, its frame's pose in the link, and its motion."""
    alpha: dict[int, Twist] = {}
    for link in trace.links.links:
        trace.place(link, "qd" in trace.inputs)
        trace.label(link, "a")
        key, above = id(link), trace.base_acceleration if link.parent is None else alpha[id(link.parent)]
        move = trace.motions[key]
        alpha[key] = link_acceleration(link, trace.places[key], move, above, trace.vector("qdd"))
        for body in trace.bodies.get(key, ()):
            trace.label(link, "b")
            place, (w, v) = body_frame(trace, body), alpha[key]
            acceleration = v + cross(w, place.l) + move.whirl @ place.l
            yield link, body, place, BodyMotion(*(place.to_child(x) for x in (move.spin, w, acceleration)))


def body_frame(trace: Trace, body: int) -> Pose:
    """Return the pose of a body frame in the frame of its link."""
    placement, (R, p) = trace.links.placements[body], trace.links.nodes[body].anchor
    axes = placement.matrix @ R.T
    return Pose(None, None if axes == IDENTITY else axes, placement.offset - axes @ p)


def carried_columns(trace: Trace, link: Link, columns: dict[int, dict[int, Twist]]) -> dict[int, Twist]:
    """Return (omega; v) of a link's frame per unit rate of each dof that moves it, by dof."""
    trace.label(link, "u")
    place, found = trace.places[id(link)], dict[int, Twist]()
    if link.parent is not None:
        if id(link.parent) not in columns:  # it carries no body
            columns[id(link.parent)] = carried_columns(trace, link.parent, columns)
        found = {dof: place.pose.motion_to_child(*one) for dof, one in columns[id(link.parent)].items()}
    return found | dict(zip(link.dofs, link.hinge.columns(place), strict=True))


def carried_rates(trace: Trace, link: Link, velocities: dict[int, Twist], rate: Entry) -> Twist:
    """Return (omega; v) of a link's frame at the rates ``rate(dof)``."""
    above = (ZERO, ZERO)
    if link.parent is not None:
        if id(link.parent) not in velocities:
            velocities[id(link.parent)] = carried_rates(trace, link.parent, velocities, rate)
        above = velocities[id(link.parent)]
    trace.label(link, "u")
    place = trace.places[id(link)]
    return carried_velocity(place, above, hinge_motion(link, place, rate))


def coefficients(motion: BodyMotion, velocity: Twist) -> list[Value]:
    """Return what mu_v . f + mu_w . n has of each of a body's ten parameters."""
    (spin, alpha, a), (w, v) = motion, velocity
    turning: Matrix = skew(alpha) + whirl(spin)
    first = turning.T @ v + cross(a, w)
    gyration = cross(w, spin)
    found = [dot(v, a), *first]
    for i, j in PRODUCTS:
        terms = w[i] * alpha[j] + gyration[i] * spin[j]
        found.append(terms if i == j else terms + (w[j] * alpha[i] + gyration[j] * spin[i]))
    return found
