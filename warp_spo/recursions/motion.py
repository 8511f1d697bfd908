"""Velocities and accelerations, outward: omega(k) = omega(p) + H* qd, and the bias of each hinge.

Accelerations are classical, those of a material point: a(k) = a(p) + (omega'~ + omega~ omega~) l. Linear velocities
then enter nowhere, and float32 does not lose what a fast chain's large velocities would cancel (eq. 20 with the
Coriolis terms moved into a).
"""

from __future__ import annotations

from typing import Any, NamedTuple

from ..trace.scalars import Value
from ..trace.spatial import ZERO, Matrix, Pose, Twist, Vector, cross, symmetric
from .model.links import Link, LinkPlacement

NONE = Matrix.of([[0.0] * 3] * 3)


class VelocityTerms(NamedTuple):
    """Velocity terms of a link, in its own axes.

    Attributes:
        spin: omega. whirl: omega~ omega~.
        bias_w, bias_v: acceleration of its frame relative to its parent's that is there at qdd = 0.
        bias_l: the parent's omega~ omega~ l, in the parent's axes.
    """

    spin: Vector
    whirl: Matrix
    bias_w: Vector
    bias_v: Vector
    bias_l: Vector


STILL = VelocityTerms(ZERO, NONE, ZERO, ZERO, ZERO)


def whirl(w: Vector) -> Matrix:
    """omega~ omega~"""
    xx, yy, zz = w[0] * w[0], w[1] * w[1], w[2] * w[2]
    return symmetric(-(yy + zz), -(xx + zz), -(xx + yy), w[0] * w[1], w[0] * w[2], w[1] * w[2])


def hinge_motion(link: Link, place: LinkPlacement, rate: Any) -> Twist:
    """Return H* rate, (omega; v) of the hinge in the link's axes, for ``rate(dof)``."""
    return link.hinge.velocity(place, [rate(dof) for dof in link.dofs])


def hinge_entries(link: Link, place: LinkPlacement, w: Vector, v: Vector) -> list[Value]:
    """Return H (w; v), for (n; f) or (omega'; v') of the link: an entry for each of the link's dofs."""
    return link.hinge.forces(place, w, v)


def own_bias(link: Link, place: LinkPlacement, qd: Any) -> Twist | None:
    """Return (d H* / dt) qd in the link's axes; None where H is constant in the link or in its parent."""
    return link.hinge.own_bias(place, [qd(dof) for dof in link.dofs])


def link_motion(link: Link, place: LinkPlacement, parent: VelocityTerms | None, qd: Any) -> VelocityTerms:
    """Return the motion of ``link`` at rates ``qd(dof)`` on a parent that moves as ``parent``; None is at rest."""
    if qd is None:
        return STILL
    move = compose_motions(place.pose, parent or STILL, *hinge_motion(link, place, qd))
    own = own_bias(link, place, qd)
    return move if own is None else move._replace(bias_w=move.bias_w + own[0], bias_v=move.bias_v + own[1])


def compose_motions(pose: Pose, parent: VelocityTerms, w: Vector, v: Vector) -> VelocityTerms:
    """Return the velocity terms of a frame at ``pose`` that moves with (w; v), in its own axes, on its parent."""
    carried = pose.to_child(parent.spin)
    spin = carried + w
    return VelocityTerms(spin, whirl(spin), cross(carried, w), 2.0 * cross(carried, v), parent.whirl @ pose.l)


def carry_acceleration(place: LinkPlacement, motion: VelocityTerms, acceleration: Twist) -> Twist:
    """Return the link's acceleration from that of its parent, without its own bias and qdd."""
    w, v = acceleration
    return place.pose.to_child(w), place.pose.to_child(v + cross(w, place.pose.l) + motion.bias_l)


def armature_forces(link: Link, rate: Any) -> list[Value]:
    """Return armature times ``rate(dof)``, for each dof of a link."""
    forces = [a * rate(dof) for a, dof in zip(link.armature, link.dofs, strict=True)]
    for (i, j), x in link.coupling_inertia.items():
        forces[i] = forces[i] + x * rate(link.dofs[j])
        forces[j] = forces[j] + x * rate(link.dofs[i])
    return forces
