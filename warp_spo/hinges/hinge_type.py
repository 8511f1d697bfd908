"""The questions that the recursions ask of an elementary hinge, answered for scalar coordinates whose rates are qd.

A hinge joins a link to its parent. Its frame at rest sits in the parent at the link's ``matrix`` and ``offset``; what
it does from there, its kind says. (omega; v) and (n; f) are in the link's axes, about the link's origin, unless other
axes are named. Entries of q and qd are asked for by index: ``q(i)``, ``rate(dof)``.
"""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any, NamedTuple, Protocol

import numpy as np

from ..trace.scalars import Entry, Value
from ..trace.spatial import ZERO, Matrix, Pose, Rigid, Twist, Vector, cross
from .quaternions import Quaternion, constant_quaternion

SCREWS, BALL, FREE = range(3)  # how work at node granularity places a node
STILL = (ZERO, ZERO)


class Carrier(Protocol):
    """The attributes of a link that its hinge reads; see :class:`warp_spo.recursions.model.links.Link`."""

    parent: Any
    matrix: Matrix | None
    offset: Vector
    dofs: tuple[int, ...]
    coordinate: int
    com: Vector
    rest: Quaternion | None


class LinkPlacement(NamedTuple):
    """A link at a configuration.

    Attributes:
        pose: its frame in the parent link's.
        turned: how a ball or free hinge turned, in the hinge's own axes; None of the other kinds.
        own: what a kind whose columns depend on q keeps for its other answers; None of the others.
    """

    pose: Pose
    turned: Matrix | None
    own: Any = None


class ElementaryHinge(NamedTuple):
    """One elementary hinge of a scene's hinge: its kind, and the axis that it turns about or slides along, if one."""

    kind: HingeType
    axis: np.ndarray | None = None


class HingeType:
    """An elementary hinge.

    Attributes:
        name: in messages. shape: equal for hinges whose generated code is equal but for constants.
        dofs, coordinates: entries of qd and of q.
        quaternion: the first of the four coordinates that are a quaternion, or None.
        angle: which coordinate is the angle of the pose's ``turn``, if the pose has one.
        units: the entry of (omega; v) that each dof moves, if each column of H* is a unit vector; else None.
        rates_in_parent: rates are in the axes of the parent anchor, where the columns are constant; the link's own
            axes, to which :meth:`in_link_axes` takes them, have unit columns.
        cancels: what an eliminated pivot of the hinge takes away may cancel in its later ones.
        unconstrained: it has all six dofs, so that the parent feels nothing of what the hinge does not transmit.
        at_com: the link's frame sits at its body's centre of mass.
        columns_vary: the columns of H* depend on q, in the link's axes and in its parent's.
        depth: dofs as which it counts where errors grow along a chain.
        node_code: how work at node granularity places its node; None: by code that is generated for the scene.
    """

    name = ""
    dofs = 1
    coordinates = 1
    quaternion: int | None = None
    angle = 0
    units: tuple[int, ...] | None = None
    rates_in_parent = False
    cancels = False
    unconstrained = False
    at_com = False
    columns_vary = False
    node_code: int | None = None

    @property
    def shape(self) -> Hashable:
        return self.name

    @property
    def depth(self) -> int:
        return self.dofs

    @property
    def neutral(self) -> tuple[float, ...]:
        """Coordinates at which the anchors coincide."""
        return (0.0,) * self.coordinates

    def screws(self, axis: np.ndarray | None) -> list[tuple[Any, float, float]]:
        """Return (axis, radians, metres per unit of the coordinate) of each dof, for work at node granularity.

        Without a ``node_code``, none that moves anything.
        """
        return [(np.zeros(3), 0.0, 0.0)] * self.dofs

    # -- position --------------------------------------------------------------------------------------------------
    def transform(self, link: Carrier, q: Entry) -> LinkPlacement:
        """Return the link where the coordinates put it."""
        raise NotImplementedError

    def relative_quaternion(self, link: Carrier, q: Entry) -> Quaternion:
        """Return the quaternion of the link's axes in its parent's."""
        raise NotImplementedError

    @staticmethod
    def quaternion_at_rest(link: Carrier) -> Quaternion:
        """Return the quaternion of the hinge's axes at rest in the parent link's."""
        if link.rest is not None:
            return link.rest
        return Vector((0.0, 0.0, 0.0, 1.0)) if link.matrix is None else constant_quaternion(link.matrix)

    # -- velocity, force, acceleration -----------------------------------------------------------------------------
    def velocity(self, place: LinkPlacement, rates: list[Value]) -> Twist:
        """Return H* rates: (omega; v) of the link relative to its parent, in the link's axes."""
        raise NotImplementedError

    def forces(self, place: LinkPlacement, w: Vector, v: Vector) -> list[Value]:
        """Return H (w; v), an entry for each dof."""
        raise NotImplementedError

    def inertial_columns(
        self, link: Carrier, place: LinkPlacement, parent: Matrix, axes: Matrix, arm: Vector
    ) -> list[Twist]:
        """Return (omega; v), in inertial axes, of a point at ``arm`` from the link's origin, per unit of each rate.

        ``axes`` are the link's, ``parent`` its parent's, both in the inertial frame; ``arm`` is in the link's axes.
        """
        return [(axes @ w, axes @ (v + cross(w, arm))) for w, v in self.columns(place)]

    def columns(self, place: LinkPlacement) -> list[Twist]:
        """Return (omega; v) of H* for each dof."""
        units = [[1.0 if j == i else 0.0 for j in range(self.dofs)] for i in range(self.dofs)]
        return [self.velocity(place, unit) for unit in units]

    def in_link_axes(self, place: LinkPlacement, triple: list[Value]) -> Vector:
        """Return three entries by dof, of one sort and in the axes of the rates, in the link's axes."""
        return Vector(triple)

    # -- columns that depend on the coordinates; None where they are constant in the link or in its parent ----------
    def own_bias(self, place: LinkPlacement, rates: list[Value]) -> Twist | None:
        """Return the acceleration relative to a parent at rest, in the link's axes, at constant rates."""
        return None

    def column_changes(self, place: LinkPlacement) -> list[list[Twist]] | None:
        """Return d H*_j / dq_i in the link's axes, by i, then j."""
        return None

    def own_changes(
        self, place: LinkPlacement, rates: list[Value], accelerations: list[Value]
    ) -> list[tuple[Twist, Twist]] | None:
        """Return how H* qd and H* qdd + :meth:`own_bias` change with each coordinate, in the link's axes."""
        return None

    def own_bias_changes(self, place: LinkPlacement, rates: list[Value]) -> list[Twist] | None:
        """Return how :meth:`own_bias` changes with each rate."""
        return None

    # -- motion of the coordinates ---------------------------------------------------------------------------------
    def integrate(self, link: Carrier, q: Entry, rates: list[Value], h: Value) -> list[Value]:
        """Return the coordinates after ``rates`` have been constant for ``h`` [s]; quaternions come out normalised."""
        return [q(link.coordinate + i) + h * rate for i, rate in enumerate(rates)]

    def difference(self, link: Carrier, before: Entry, after: Entry) -> list[Value]:
        """Return the rates that take the coordinates from ``before`` to ``after`` in 1 s: :meth:`integrate`, inverted.

        A rotation goes the short way round. The entries are asked for by index, as those of q.
        """
        return [after(link.coordinate + i) - before(link.coordinate + i) for i in range(self.coordinates)]

    def perturb(self, link: Carrier, place: LinkPlacement, q: Entry, step: list[Value]) -> list[Value]:
        """Return the coordinates after a small step of the dofs, exact to first order."""
        return [q(link.coordinate + i) + x for i, x in enumerate(step)]

    def coordinate_rates(self, link: Carrier, q: Entry, rates: list[Value]) -> list[Value]:
        """Return the time derivatives of the coordinates; of a quaternion, of the unit one."""
        return rates

    def to_tangent(self, link: Carrier, place: LinkPlacement, q: Entry, gradient: list[Value]) -> list[Value]:
        """Return a gradient by the coordinates along the tangent coordinates, an entry for each dof."""
        return gradient

    def from_tangent(self, link: Carrier, place: LinkPlacement, q: Entry, rates: list[Value]) -> list[Value]:
        """Return how the coordinates change along tangent coordinates: the transpose of :meth:`to_tangent`."""
        return rates

    def displacement(self, i: int, q: Entry, rest: Entry) -> Value:
        """Return how far dof ``i`` is from rest; ``q`` and ``rest`` give the hinge's own coordinates, from 0 on."""
        return q(i) - rest(i)

    # -- inertia ---------------------------------------------------------------------------------------------------
    def split_inertia(self, own: Rigid) -> tuple[Rigid, Rigid] | None:
        """Return an inertia in two parts: one that the parent may carry as well, and the rest; None if there is none.

        The first part must be the same in the parent wherever the hinge is.
        """
        return None
