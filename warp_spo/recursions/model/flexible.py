"""Flexible bodies as links: rigid pieces on the body's frame that share its modal coordinates.

The pieces are the mass points of the modes; a piece with the rest of the inertia, which moves as M_rr^-1 L eta, the
body's mean motion in the modes; and a port without mass for each child and frame. The kinetic energy of the body in its
undeformed shape, (V; eta')* [M_rr, L; L*, M_ee] (V; eta') / 2, is that of the pieces and of an armature matrix
M_ee - L* M_rr^-1 L. In any other shape it is that of rigid bodies that move so, and all laws of rigid bodies hold.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...hinges.deflection import Deflection
from ...scene.flexible.modes import MASS_VALUES, mean_motion, slopes_of_child, slopes_of_frame
from ...trace.scalars import is_constant
from ...trace.spatial import IDENTITY, ZERO, Matrix, Pose, Rigid, Vector, symmetric
from .link import BodyPlacement, Link, SharedDofs
from .rotations import still

if TYPE_CHECKING:
    from .links import Links

NO_MOMENTS = symmetric(0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
NOTHING = Rigid(0.0, ZERO, NO_MOMENTS)
GONE = 1e-10  # share of a body's inertia below which what its points leave of it is rounding


class Flexible(NamedTuple):
    """A body with modes.

    Attributes:
        link: the link that its frame sits on, or None. axes, origin: the body frame at rest in that link.
        leader: the piece at which the modal coordinates are accounted for; it moves as the body's centre of mass.
        rest: the inertia that moves with the body frame, about its origin.
    """

    link: Link | None
    axes: Matrix
    origin: Vector
    leader: Link
    rest: Rigid


def deform(links: Links, node: int, dof: int, coordinate: int, armature: tuple) -> None:
    """Add the pieces of a body whose modal coordinates start at entry ``dof`` of qd and ``coordinate`` of q.

    The leader moves as the body's centre of mass does in the modes, and has their armature. The rest is the inertia
    that mass points leave; without them it is the whole body's. Where the modes move the rest, it is the leader's
    without mass points, and else that of a further piece. Where they do not, it belongs to the link of the body frame.
    """
    scene, placement = links.scene, links.placements[node]
    modes = scene.bodies[node].modes
    assert modes is not None
    R, p = links.nodes[node].anchor
    axes = placement.matrix @ R.T
    origin = placement.offset - axes @ p
    values = (scene.values[name][0, node] for name in MASS_VALUES)
    mean = mean_motion(scene.body_labels[node], modes, *values)
    dofs = tuple(range(dof, dof + modes.count))
    kind = Deflection(mean.slopes)
    at = origin + axes @ Vector(mean.center.tolist())
    leader = Link(placement.link, kind, still(axes), at, None, dofs, coordinate, armature, node)
    leader.armature = tuple(a + b for a, b in zip(armature, np.diag(mean.armature).tolist(), strict=True))
    pairs = zip(*np.nonzero(np.triu(mean.armature, 1)), strict=True)
    leader.shared_dofs = SharedDofs([leader], {(int(i), int(j)): float(mean.armature[i, j]) for i, j in pairs})
    whole = links.rigid(node, np.eye(3), links.values["body_com"][node])
    rest = whole if modes.points is None else _less(whole, modes.points.inertia[:6, :6])
    rest_moves = mean.rest_slopes.any()
    own = links.flexible[node] = Flexible(placement.link, axes, origin, leader, NOTHING if rest_moves else rest)
    links.append(leader)

    if placement.link is not None:
        placement.link.add(Pose(None, axes, origin).rigid_to_parent(own.rest))
    if rest_moves:
        center = Vector(mean.rest_center.tolist())
        rest_piece = leader if modes.points is None else add_piece(links, own, Deflection(mean.rest_slopes), center)
        rest_piece.add(Pose(None, None, -center).rigid_to_parent(rest))
    leader.compensate(links.values["body_gravcomp"].tolist()[node] * whole.mass, ZERO)
    if modes.points is not None:
        shapes, bends = modes.points.shapes, modes.points.stiffening
        for s, mass in enumerate(modes.points.mass.tolist()):
            kind = Deflection(
                np.concatenate([np.zeros_like(shapes[s]), shapes[s]]), None if bends is None else bends[s]
            )
            point = add_piece(links, own, kind, Vector(modes.points.position[s].tolist()))
            point.add(Rigid(mass, ZERO, NO_MOMENTS))
    for child in scene.tree.children[node]:
        hinge = scene.hinge_of[child]
        found = slopes_of_child(scene, int(child))
        anchor = Vector(links.poses["joint_X_p"][hinge][1].tolist())
        links.ports[int(child)] = BodyPlacement(add_piece(links, own, Deflection(*found), anchor), IDENTITY, ZERO)


def attach(links: Links, frames: Iterable[tuple[int, Any]]) -> None:
    """Add ports for frames (body, position in the body frame [m]) that sit on flexible bodies, off their origins."""
    for body, position in frames:
        place = tuple(float(x) for x in position)
        if body in links.flexible and any(place) and (body, place) not in links.ports:
            own = links.flexible[body]
            found = slopes_of_frame(links.scene, body, place)
            links.ports[body, place] = BodyPlacement(
                add_piece(links, own, Deflection(*found), Vector(place)), IDENTITY, ZERO
            )


def add_piece(links: Links, own: Flexible, kind: Deflection, position: Vector) -> Link:
    """Return a new piece of a flexible body, at rest at ``position`` in the body frame."""
    leader = own.leader
    at, no_armature = own.origin + own.axes @ position, (0.0,) * len(leader.dofs)
    piece = dataclasses.replace(
        leader,
        hinge=kind,
        offset=at,
        matrix=still(own.axes),
        armature=no_armature,
        inertia=None,
        grouped=None,
        gravity_compensation=None,
        children=[],
    )
    leader.shared_dofs.links.append(piece)  # type: ignore[union-attr]
    links.append(piece)
    return piece


def _less(whole: Rigid, points: np.ndarray) -> Rigid:
    """Return a body's inertia less that of its points; constants that rounding leaves become zero."""
    mass, moment = points[3, 3], (points[2, 4], points[0, 5], points[1, 3])
    J = points[:3, :3]
    products = (J[0, 0], J[1, 1], J[2, 2], J[0, 1], J[0, 2], J[1, 2])
    own = [*map(float, (mass, *moment, *products))]
    sizes = [mass] + [max(mass, *map(abs, moment))] * 3 + [max(J.diagonal())] * 6
    left = [a - b for a, b in zip(whole.packed, own, strict=True)]
    gone = lambda x, size: is_constant(x) and abs(x) <= GONE * size  # noqa: E731
    return Rigid.unpacked([0.0 if gone(x, size) else x for x, size in zip(left, sizes, strict=True)])
