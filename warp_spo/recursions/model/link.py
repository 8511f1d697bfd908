"""A link: one moving frame of a scene, as the recursions see it."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

from ...hinges.hinge_type import HingeType
from ...trace.scalars import Value, is_constant
from ...trace.spatial import ZERO, Matrix, Rigid, Vector


class GravityCompensation(NamedTuple):
    """Mass of a link's bodies whose weight is compensated, the sum of gravcomp mass, and its first moment."""

    mass: Value
    moment: Vector

    def __add__(self, other: tuple) -> GravityCompensation:
        return GravityCompensation(*(a + b for a, b in zip(self, other, strict=True)))


@dataclasses.dataclass(eq=False)
class Link:
    """One moving frame.

    Attributes:
        parent: the link it moves on, or None for the inertial frame.
        hinge: the elementary hinge that moves it.
        matrix, offset: axes and origin of the hinge's frame at rest in the parent link's frame.
        align: the hinge's axes in those of the scene's hinge, whose z axis is the hinge's own axis; None: the same.
        dofs: its entries of qd.
        coordinate: its first entry of q.
        armature: of each dof.
        inertia: of the bodies it carries, in its frame; None where it carries none.
        grouped: the same for sums of forces and composite inertias, where it may be counted elsewhere: what turns about
            its own axis, or does not turn, belongs to the parent as well as to the link. It need not be positive.
        gravity_compensation: the part of its bodies whose weight is compensated, in its frame; None where nothing is.
        node: the body whose hinge it belongs to.
        com: the link's origin from the child anchor, in the link's axes: the body's centre of mass, if the hinge moves
            that.
        children: the links that move on it.
        shared_dofs: the links that share its dofs; None where it has them for itself.
        rest: quaternion of the matrix; None: it follows from the matrix.
    """

    parent: Link | None
    hinge: HingeType
    matrix: Matrix | None
    offset: Vector
    align: Matrix | None
    dofs: tuple[int, ...]
    coordinate: int
    armature: tuple
    node: int
    com: Vector = ZERO
    inertia: Rigid | None = None
    grouped: Rigid | None = None
    gravity_compensation: GravityCompensation | None = None
    children: list = dataclasses.field(default_factory=list)
    shared_dofs: SharedDofs | None = None
    rest: Vector | None = None

    @property
    def title(self) -> str:
        """How comments of generated code name it: by number, so that no name of a file reaches a compiler."""
        return f"body {self.node}"

    @property
    def is_leader(self) -> bool:
        """Whether work that a dof does once is done at this link, not at another one of its group."""
        # of a copy with other armature, too
        return self.shared_dofs is None or self.shared_dofs.links[0].hinge is self.hinge

    @property
    def coupling_inertia(self) -> dict[tuple[int, int], float]:
        """Inertia between two of its dofs that no link accounts for, by place among them; at the leader of a group."""
        return self.shared_dofs.coupling_inertia if self.shared_dofs is not None and self.is_leader else {}

    @property
    def is_last(self) -> bool:
        """Whether the link is the last of its group, at which a sweep inward has all of it."""
        return self.shared_dofs is not None and self.shared_dofs.links[-1] is self

    def add(self, inertia: Rigid) -> None:
        if all(is_constant(x) and x == 0.0 for x in inertia.packed):
            return
        self.inertia = inertia if self.inertia is None else self.inertia + inertia

    def compensate(self, mass: Value, com: Vector) -> None:
        """Compensate the weight of ``mass`` at ``com``, in the link's frame."""
        if not (is_constant(mass) and mass == 0.0):
            gravity_compensation = GravityCompensation(mass, com * mass)
            self.gravity_compensation = (
                gravity_compensation
                if self.gravity_compensation is None
                else self.gravity_compensation + gravity_compensation
            )


@dataclasses.dataclass(eq=False)
class SharedDofs:
    """Links on one parent whose hinges share dofs: pieces of a flexible body, a rotor and the link that it drives.

    Attributes:
        links: the first one leads; armature is its.
        coupling_inertia: inertia between two dofs that no link accounts for, (i, j), i < j, by place among the dofs.
    """

    links: list[Link]
    coupling_inertia: dict[tuple[int, int], float] = dataclasses.field(default_factory=dict)


class BodyPlacement(NamedTuple):
    """The place of a body's node frame: fixed in a link, or in the inertial frame (link None)."""

    link: Link | None
    matrix: Matrix
    offset: Vector


class NodeBody(NamedTuple):
    """A body by itself, in the axes of its node frame.

    Attributes:
        tree: axes and origin of the hinge's parent anchor in the parent's node frame.
        anchor: of the node frame in the body frame.
        com: centre of mass in the node frame. rigid: inertia about its origin.
    """

    tree: tuple[Matrix, Vector]
    anchor: tuple[Matrix, Vector]
    com: Vector
    rigid: Rigid
