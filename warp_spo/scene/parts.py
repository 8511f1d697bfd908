"""Bodies, hinges, loops and couplings: the parts of a scene, with units; their values are checked, never repaired.

Every hinge is a sequence of elementary hinges (:mod:`warp_spo.hinges`) from its parent anchor to its child anchor:

* a chain of *screws*, ``exp(s_0 q_0) exp(s_1 q_1) ...``, each about or along an axis through the anchor: fixed (none),
  revolute, prismatic, helical, universal, cylindrical, planar and D6;
* ``ball``: a unit quaternion (xyzw), its velocity the relative angular velocity in the parent anchor's axes;
* ``free``: position and quaternion, its velocity the child's CoM velocity, then angular velocity, both relative to
  the parent anchor and in its axes;
* ``custom``: scalar coordinates, and a function of the user's that places the child anchor in the parent anchor.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np

from ..errors import UnsupportedError, as_integer, quoted
from ..hinges.custom import MOST, Custom, check_custom_pose
from ..hinges.elementary import BY_NAME, elements
from ..hinges.hinge_type import FREE as FREE
from ..hinges.hinge_type import SCREWS as SCREWS
from ..hinges.hinge_type import ElementaryHinge
from .axes import in_plane as in_plane
from .axes import screws_of
from .checks import checked_array, checked_unit, read_only
from .checks import checked_inertia as checked_inertia
from .checks import real as real
from .flexible.modes import Modes
from .gears import Rotor, checked_flexible, motor_and_deflection, resolve_rotor
from .pickling import StoredPart, check_function

IDENTITY_POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
UNLIMITED = 1e10
ALIASES = {"spherical": "ball", "distance": "free"}

# Per degree of freedom, with the value that a hinge has when nothing is said. Names and units are Newton's.
DOF_VALUES = {
    "joint_armature": 0.0,
    "joint_damping": 0.0,
    "joint_friction": 0.0,
    "joint_stiffness": 0.0,
    "joint_target_ke": 0.0,
    "joint_target_kd": 0.0,
    "joint_limit_lower": -UNLIMITED,
    "joint_limit_upper": UNLIMITED,
    "joint_limit_ke": 1e4,
    "joint_limit_kd": 10.0,
    "joint_effort_limit": 1e6,
    "joint_velocity_limit": 1e6,
}


def checked_pose(call: str, name: str, value: Any) -> np.ndarray:
    """Return a checked pose (x, y, z, qx, qy, qz, qw), its quaternion normalised; ValueError if it is none."""
    pose = checked_array(call, name, value, (7,))
    return read_only(np.concatenate([pose[:3], checked_unit(call, f"the quaternion (xyzw) of {name}", pose[3:])]))


@dataclasses.dataclass(frozen=True, eq=False)
class Body(StoredPart):
    """A body, rigid unless it has ``modes``.

    No distribution of positive mass has a largest principal moment that exceeds the sum of the others, or a negative
    one. Robot files have both. ``any_inertia=True`` accepts them; results can be trusted as long as the mass matrix is
    positive definite, and ``status=`` says where it is not.

    Args:
        mass: [kg], not negative.
        com: centre of mass in the body frame [m], shape (3,).
        inertia: about the centre of mass, body axes [kg m^2], shape (3, 3), symmetric, no negative eigenvalue, none
            that exceeds the sum of the others; the last is checked by :class:`Scene`.
        label: name in tables and errors.
        gravcomp: share of the body's weight that a force at its centre of mass holds up, -gravcomp mass gravity, as
            MuJoCo's attribute of that name. The force belongs to :meth:`Dynamics.passive_force` and to
            :meth:`Dynamics.step`; other calls leave it out.
        any_inertia: whether to accept every symmetric inertia.
        modes: elastic deformation; None: the body is rigid.

    Raises:
        ValueError: a value is invalid; the message names it.
    """

    mass: float
    com: Any = (0.0, 0.0, 0.0)
    inertia: Any = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    label: str = ""
    modes: Modes | None = None
    gravcomp: float = 0.0
    any_inertia: bool = False

    def __post_init__(self) -> None:
        call = f"Body({quoted(self.label)})" if self.label else "Body"
        if self.modes is not None and not isinstance(self.modes, Modes):
            raise TypeError(f"{call}: modes is {self.modes!r}; expected spo.Modes")
        object.__setattr__(self, "mass", float(checked_array(call, "mass [kg]", self.mass, ())))
        object.__setattr__(self, "gravcomp", float(checked_array(call, "gravcomp", self.gravcomp, ())))
        object.__setattr__(self, "com", checked_array(call, "com [m]", self.com, (3,)))
        inertia = checked_array(call, "inertia [kg m^2]", self.inertia, (3, 3))
        if self.mass < 0.0:
            raise ValueError(f"{call}: mass is {self.mass} kg; expected zero or more")
        object.__setattr__(self, "inertia", read_only(checked_inertia(call, inertia, self.any_inertia)))


CLOSING = ("fixed", "revolute", "prismatic", "helical", "universal", "cylindrical", "ball", "planar", "free", "d6")
"""Kinds of hinges that a loop can close with."""
KINDS = (*CLOSING, *(name for name in BY_NAME if name not in CLOSING))
"""Kinds of hinges beside "custom", which :meth:`Hinge.custom` makes."""


@dataclasses.dataclass(frozen=True, eq=False)
class Hinge(StoredPart):
    """The edge of the tree that carries body ``child`` on body ``parent``.

    The child's pose in the parent is ``parent_pose * X(q) * child_pose^-1``; poses are (x, y, z, qx, qy, qz, qw).

    Args:
        kind: "fixed", "revolute", "prismatic", "helical", "universal", "cylindrical", "ball" (or "spherical"),
            "planar", "free" (or "distance") or "d6".
        parent: body index, -1 = the inertial frame.
        child: body index.
        axis: unit vector in the parent anchor frame; universal: the two axes, inboard first; planar: the normal, or
            the two directions of translation. Cylindrical and planar hinges translate first, then turn.
        linear: up to three axes of translation of a d6, inboard first; they come before the rotations.
        angular: up to three axes of rotation of a d6, inboard first.
        pitch: of a helical hinge [m/rad].
        parent_pose: the hinge's anchor in the parent body [m, unit quaternion].
        child_pose: the hinge's anchor in the child body [m, unit quaternion].
        armature: inertia added to the diagonal [kg m^2 or kg]. It is one number for all degrees of freedom or one each;
            so are all arguments below but ``rest``.
        damping: [N m s or N s/m].
        friction: bound of dry friction [N m or N].
        stiffness: of the spring that pulls to ``rest`` [N m or N/m].
        target_ke: stiffness of the drive [N m or N/m].
        target_kd: damping of the drive [N m s or N s/m].
        limit_lower: lower position limit [rad or m].
        limit_upper: upper position limit [rad or m].
        limit_ke: stiffness of the position limits [N m or N/m].
        limit_kd: damping of the position limits [N m s or N s/m].
        effort_limit: bound of the force of drive and actuators together [N m or N]; 1e6 and more is none. It does not
            bound tau.
        velocity_limit: bound of the velocity [rad/s or m/s].
        rest: coordinates at which the spring is relaxed, one per coordinate.
        rotor: a :class:`Rotor` that turns with the hinge through a gear; one degree of freedom, or flexible.
        flexible: (stiffness [N m/rad or N/m], damping [N m s or N s/m]) of a gear or shaft between the motor and the
            child, of a hinge with one degree of freedom. The hinge then has two coordinates, the motor's and the
            deflection, whose sum places the child. Armature, damping, friction, drive, limits, ``rest``, actuators and
            couplings are those of the motor, unless two numbers are given. Spring and damper of the deflection are its
            entries of joint_stiffness and joint_damping: steps and :meth:`Dynamics.passive_force` know them, forward
            dynamics does not. Without armature or a rotor the motor has no inertia, and forward dynamics is NaN.
        coordinates, pose: of a "custom" hinge, see :meth:`custom`.
        label: name in tables and errors.

    Raises:
        ValueError: a value is invalid; the message names it.
        UnsupportedError: ``flexible`` of a custom hinge.
    """

    kind: str
    parent: int
    child: int
    axis: Any = None
    linear: Any = None
    angular: Any = None
    pitch: float = 0.0
    parent_pose: Any = IDENTITY_POSE
    child_pose: Any = IDENTITY_POSE
    armature: Any = None
    damping: Any = None
    friction: Any = None
    stiffness: Any = None
    target_ke: Any = None
    target_kd: Any = None
    limit_lower: Any = None
    limit_upper: Any = None
    limit_ke: Any = None
    limit_kd: Any = None
    effort_limit: Any = None
    velocity_limit: Any = None
    rest: Any = None
    label: str = ""
    rotor: Rotor | None = None
    flexible: Any = None
    coordinates: int | None = None
    pose: Callable[[list], Any] | None = None
    screws: tuple = dataclasses.field(init=False, repr=False)
    elements: tuple = dataclasses.field(
        init=False, repr=False
    )  # of warp_spo.hinges.hinge_type.ElementaryHinge, inboard first

    def __post_init__(self) -> None:
        call = f"Hinge({quoted(self.label)})" if self.label else f"Hinge({self.kind!r})"
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        if isinstance(self.kind, str):
            put("kind", ALIASES.get(self.kind, self.kind))
        if self.kind not in (*KINDS, "custom"):
            raise ValueError(f"{call}: unknown kind; expected one of {', '.join(KINDS)}, or Hinge.custom")
        screws = tuple(screws_of(call, self.kind, self.axis, self.linear, self.angular, self.pitch))
        put("flexible", checked_flexible(call, self.kind, len(screws), self.flexible))
        put("screws", screws if self.flexible is None else screws * 2)  # the motor's, then the deflection's
        if self.kind == "custom":
            put("elements", (ElementaryHinge(self._custom(call)),))
        elif self.pose is not None or self.coordinates is not None:
            raise ValueError(f"{call}: pose= and coordinates= belong to a custom hinge")
        else:
            put("elements", elements(self.kind, self.screws))
        put("rotor", resolve_rotor(call, self.rotor, self.kind, self.driven, self.screws))
        put("parent_pose", checked_pose(call, "parent_pose", self.parent_pose))
        put("child_pose", checked_pose(call, "child_pose", self.child_pose))
        for name, default in DOF_VALUES.items():
            field = name.removeprefix("joint_")
            value = getattr(self, field)
            value = default if value is None else value
            value = checked_array(call, field, value, () if np.ndim(value) == 0 else (self.dof_count,))
            if self.flexible is not None:
                value = motor_and_deflection(call, field, value, default, self.flexible)
            put(field, np.broadcast_to(value, (self.dof_count,)))
        rest = self.neutral if self.rest is None else self.rest
        rest = checked_array(call, "rest", rest, () if np.ndim(rest) == 0 else (self.coord_count,))
        if self.flexible is not None:
            rest = motor_and_deflection(call, "rest", rest, 0.0, self.flexible)
        rest = np.broadcast_to(rest, (self.coord_count,))
        for first in self.quaternions:
            checked_unit(call, "the quaternion (xyzw) of rest", rest[first : first + 4])
        put("rest", rest)

    def _custom(self, call: str) -> Custom:
        if as_integer(self.coordinates) is None or not 1 <= self.coordinates <= MOST:  # type: ignore[operator]
            raise ValueError(f"{call}: coordinates is {self.coordinates!r}; expected 1 to {MOST}")
        count = int(self.coordinates)  # type: ignore[arg-type]
        ends = []
        for name, default in (("limit_lower", -UNLIMITED), ("limit_upper", UNLIMITED)):
            value = default if getattr(self, name) is None else getattr(self, name)
            value = checked_array(call, name, value, () if np.ndim(value) == 0 else (count,))
            ends.append(np.where(np.abs(value) < UNLIMITED, np.broadcast_to(value, (count,)), np.nan))
        return check_custom_pose(call, self.pose, count, *ends)

    @classmethod
    def custom(cls, parent: int, child: int, *, coordinates: int, pose: Callable[[list], Any], **values: Any) -> Hinge:
        """Return a hinge whose pose is a function of 1 to 6 scalar coordinates, whose rates are its entries of qd.

        Args:
            parent, child: body index, as in :class:`Hinge`.
            coordinates: how many, n.
            pose: takes a list of n scalars [rad or m, as the function means them] and returns the position (3,) [m] and
                the rotation matrix (3, 3) of the child anchor in the parent anchor. It is called with abstract scalars
                and with numbers, and may use ``+ - * / **``, abs, NumPy's sin, cos, tan, exp, log, sqrt, arctan2 and
                hypot, ``spo.where`` in place of branches, ``spo.clip`` and ``spo.spline``. It must be twice
                differentiable. To pickle the hinge, define the function at the top level of a module.
            values: other arguments of :class:`Hinge`: anchors, armature, springs, limits and so on, per coordinate.

        Raises:
            ValueError: not 1 to 6 coordinates, or a rotation that is not orthonormal at one of 64 samples between the
                limits, or of -1 to 1 where a coordinate has none.
            TypeError: ``pose`` does something else with a scalar, a branch included.

        Where the columns of its Jacobian lose rank, accelerations are NaN and ``status`` is ``spo.Status.PIVOT``;
        armature of its coordinates keeps them finite.
        """
        return cls("custom", parent, child, coordinates=coordinates, pose=pose, **values)

    def __getstate__(self) -> dict[str, Any]:
        if self.pose is not None:
            check_function(f"Hinge({quoted(self.label)})" if self.label else "Hinge.custom", "pose", self.pose)
        return super().__getstate__()

    @property
    def motion(self) -> int:
        """SCREWS, BALL or FREE: which coordinates the hinge has; SCREWS of all that are scalars."""
        code = self.elements[0].kind.node_code if self.elements else None
        return SCREWS if code is None else code

    @property
    def dof_count(self) -> int:
        """Entries of ``qd`` that the hinge owns, the paper's r_k."""
        return sum(element.kind.dofs for element in self.elements)

    @property
    def coord_count(self) -> int:
        """Entries of ``q`` that the hinge owns."""
        return sum(element.kind.coordinates for element in self.elements)

    @property
    def reflected_inertia(self) -> np.ndarray:
        """The armature that a reflected rotor adds to each dof [kg m^2 or kg]; zeros without one."""
        found = np.zeros(self.dof_count)
        if self.rotor is not None and self.rotor.model == "reflected":
            found[0] = self.rotor.ratio**2 * self.rotor.spin_inertia
        return found

    @property
    def driven(self) -> bool:
        """Whether the hinge has one coordinate that a motor turns: all it has, or the first of a flexible hinge."""
        return self.coord_count == 1 or self.flexible is not None

    @property
    def neutral(self) -> np.ndarray:
        """Coordinates at which the anchors coincide."""
        return np.array([x for element in self.elements for x in element.kind.neutral], dtype=np.float64)

    @property
    def quaternions(self) -> list[int]:
        """The first entry of each quaternion among the hinge's coordinates."""
        found, first = [], 0
        for kind, _ in self.elements:
            if kind.quaternion is not None:
                found.append(first + kind.quaternion)
            first += kind.coordinates
        return found

    @property
    def unconstrained(self) -> bool:
        """Whether the child moves in all six directions, with the rates of a free hinge."""
        return any(kind.unconstrained for kind, _ in self.elements)

    @property
    def depth(self) -> int:
        """Dofs as which the hinge counts where errors grow along a chain."""
        return sum(kind.depth for kind, _ in self.elements)


@dataclasses.dataclass(frozen=True, eq=False)
class Loop(StoredPart):
    """A hinge that closes a loop: it constrains two bodies and owns no entry of ``q`` and ``qd``.

    The arguments are those of :class:`Hinge`; ``parent`` may be -1, the inertial frame.
    """

    kind: str
    parent: int
    child: int
    axis: Any = None
    linear: Any = None
    angular: Any = None
    pitch: float = 0.0
    parent_pose: Any = IDENTITY_POSE
    child_pose: Any = IDENTITY_POSE
    label: str = ""
    screws: tuple = dataclasses.field(init=False, repr=False)

    @property
    def ends(self) -> list[tuple[int, Any]]:
        """The two bodies, each with the pose of the joint's anchor in it."""
        return [(self.parent, self.parent_pose), (self.child, self.child_pose)]

    def __post_init__(self) -> None:
        if self.kind in ("custom", *KINDS[len(CLOSING) :]):
            way_out = "make it a hinge of the tree and close the loop at another joint"
            raise UnsupportedError("Loop", f"a {self.kind} hinge that closes a loop", way_out)
        hinge = Hinge(
            self.kind,
            self.parent,
            self.child,
            self.axis,
            self.linear,
            self.angular,
            self.pitch,
            parent_pose=self.parent_pose,
            child_pose=self.child_pose,
            label=self.label,
        )
        for name in ("kind", "screws", "parent_pose", "child_pose"):
            object.__setattr__(self, name, getattr(hinge, name))


@dataclasses.dataclass(frozen=True)
class Coupling:
    """A mimic: ``q[hinge] = offset + ratio * q[reference]``, between hinges of one coordinate.

    Args:
        hinge, reference: index into the scene's hinges.
        ratio: dimensionless, or [m/rad], [rad/m].
        offset: [rad] or [m].
    """

    hinge: int
    reference: int
    ratio: float = 1.0
    offset: float = 0.0
