"""Rotors as links: each rides on the parent of the link that its hinge moves, and shares the hinge's dof.

Model "full": a link with all of the rotor's inertia, which together with the link that the hinge moves is a node of 12
dimensions. Model "reduced": the locked rotor is part of the parent's inertia but for its moment J about the axis u, and
what is left is a link with J alone, so that D = H P H* + ratio^2 J and U = phi P H* + ratio phi (J u; 0) have 6
dimensions. Both are exact. A. Jain, Robot and Multibody Dynamics, 2011, on geared links.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np

from ...hinges.rotor_axis import RotorAxis
from ...scene.gears import Rotor
from ...trace.spatial import ZERO, Matrix, Pose, Rigid, Vector, symmetric
from .link import Link, SharedDofs
from .rotations import rotation_to_axis, still

if TYPE_CHECKING:
    from .links import Links


def add(links: Links, driven: Link, rotor: Rotor, axes: Matrix, origin: Vector) -> None:
    """Add the rotor of the hinge that moves ``driven``, whose parent anchor sits at ``origin`` in ``axes``."""
    link = dataclasses.replace(
        driven,
        hinge=RotorAxis(rotor.ratio),
        matrix=still(axes @ rotation_to_axis(rotor.axis)),
        offset=origin + axes @ Vector(rotor.com.tolist()),
        align=None,
        armature=(0.0,),
        com=ZERO,
        inertia=None,
        grouped=None,
        gravity_compensation=None,
        children=[],
    )
    link.add(Rigid(0.0, ZERO, symmetric(0.0, 0.0, rotor.spin_inertia, 0.0, 0.0, 0.0)))
    if driven.parent is not None:  # what does not spin matters only where it moves
        if rotor.model == "full":
            link.add(across_axis(rotor))
        else:
            driven.parent.add(locked_inertia(rotor, axes, origin))
    driven.shared_dofs = link.shared_dofs = SharedDofs([driven, link])
    links.append(link)


def across_axis(rotor: Rotor) -> Rigid:
    """Return a rotor's inertia in axes whose z axis is its own, without the moment about it."""
    across = 0.5 * (np.trace(rotor.matrix) - rotor.spin_inertia)
    return Rigid(rotor.mass, ZERO, symmetric(across, across, 0.0, 0.0, 0.0, 0.0))


def locked_inertia(rotor: Rotor, axes: Matrix, origin: Vector) -> Rigid:
    """Return :func:`across_axis` in the frame that has the hinge's parent anchor at ``origin`` in ``axes``."""
    at = origin + axes @ Vector(rotor.com.tolist())
    return Pose(None, axes @ rotation_to_axis(rotor.axis), at).rigid_to_parent(across_axis(rotor))


def rotor_link(links: Links, node: int) -> Link | None:
    """Return the link of the rotor of a body's hinge, if it has one."""
    return next((link for link in links.links if link.node == node and isinstance(link.hinge, RotorAxis)), None)
