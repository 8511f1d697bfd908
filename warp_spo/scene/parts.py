"""Bodies, hinges, loops and couplings: the parts of a scene, with units; their values are checked, never repaired.

Every hinge is one of three kinds of motion from its parent anchor to its child anchor:

* a chain of *screws*, ``exp(s_0 q_0) exp(s_1 q_1) ...``, each about or along an axis through the anchor: fixed (none),
  revolute, prismatic, helical, universal, cylindrical, planar and D6;
* ``ball``: a unit quaternion (xyzw), its velocity the relative angular velocity in the parent anchor's axes;
* ``free``: position and quaternion, its velocity the child's CoM velocity, then angular velocity, both relative to
  the parent anchor and in its axes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any

import numpy as np

from ..errors import UnsupportedError, refuse_masked

IDENTITY_POSE = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)
UNLIMITED = 1e10
SYMMETRY = 1e-6  # relative: what a float32 file or importer leaves of a symmetric inertia, a unit axis or quaternion
ALIASES = {"spherical": "ball", "distance": "free"}

Screw = tuple[Any, float, float]  # axis [3], radians and metres per coordinate

SCREWS, BALL, FREE = 0, 1, 2  # how a hinge's coordinates become a motion
MOTION = {"ball": BALL, "free": FREE}

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


def checked_array(call: str, name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    refuse_masked(call, name, value)
    try:
        array = real(value)
    except (TypeError, ValueError):
        raise ValueError(f"{call}: {name} is {value!r}; expected numbers of shape {shape}") from None
    if array.shape != shape:
        raise ValueError(f"{call}: {name} has shape {array.shape}; expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{call}: {name} is {array.tolist()}; expected finite numbers")
    return read_only(array)


def real(value: Any) -> np.ndarray:
    """Return a copy of an array in float64, which later changes of the caller's array do not affect.

    Raises:
        TypeError: ``value`` is or contains text, None, complex numbers, integers beyond float64, or torch tensors that
            require grad, because no derivative passes through a copy.
    """
    try:
        array = np.asarray(value.cpu() if hasattr(value, "cpu") else value)
        for one in (value, *array.flat) if array.dtype == object else (value,):
            if one is None or isinstance(one, str | bytes) or getattr(one, "requires_grad", False):
                raise TypeError
        if array.dtype.kind not in "biufO":
            raise TypeError
        return array.astype(np.float64)
    except (OverflowError, RuntimeError):  # what torch raises of tensors that NumPy cannot see
        raise TypeError from None


def read_only(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


def checked_unit(call: str, name: str, vector: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(vector, axis=-1, keepdims=True)
    if np.any(np.abs(norm - 1.0) > SYMMETRY):
        raise ValueError(f"{call}: {name} is {vector.tolist()}; expected unit length, got {norm.ravel().tolist()}")
    return vector / norm


def _pose(call: str, name: str, value: Any) -> np.ndarray:
    pose = checked_array(call, name, value, (7,))
    return read_only(np.concatenate([pose[:3], checked_unit(call, f"the quaternion (xyzw) of {name}", pose[3:])]))


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """A rigid body.

    The largest principal moment of inertia may exceed the sum of the others, although no distribution of positive mass
    has such an inertia: it is common in robot files, and the mass matrix stays positive definite. Values that would
    make a kinetic energy negative are refused. ``spo.load`` reads files through Newton, which repairs such inertias,
    and names the bodies.

    Args:
        mass: [kg], not negative.
        com: centre of mass in the body frame [m], shape (3,).
        inertia: about the centre of mass, body axes [kg m^2], shape (3, 3), symmetric, no negative eigenvalue.
        label: name in tables and errors.

    Raises:
        ValueError: a value is invalid; the message names it.
        UnsupportedError: ``modes`` (flexible bodies) is reserved.
    """

    mass: float
    com: Any = (0.0, 0.0, 0.0)
    inertia: Any = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    label: str = ""
    modes: Any = None

    def __post_init__(self) -> None:
        call = f"Body({self.label!r})" if self.label else "Body"
        if self.modes is not None:
            raise UnsupportedError(call, "a flexible body (modes=)", "leave modes out for a rigid body")
        object.__setattr__(self, "mass", float(checked_array(call, "mass [kg]", self.mass, ())))
        object.__setattr__(self, "com", checked_array(call, "com [m]", self.com, (3,)))
        inertia = checked_array(call, "inertia [kg m^2]", self.inertia, (3, 3))
        if self.mass < 0.0:
            raise ValueError(f"{call}: mass is {self.mass} kg; expected zero or more")
        object.__setattr__(self, "inertia", read_only(checked_inertia(call, inertia)))


def checked_inertia(call: str, inertia: np.ndarray) -> np.ndarray:
    """Return ``inertia`` [..., 3, 3] made exactly symmetric; see :class:`Body` for the values that it may have.

    Raises:
        ValueError: the inertia is not symmetric up to rounding, or has a negative eigenvalue.
    """
    scale = np.abs(inertia).max(axis=(-1, -2))
    skew = np.abs(inertia - np.swapaxes(inertia, -1, -2)).max(axis=(-1, -2))
    if np.any(skew > SYMMETRY * scale):
        raise ValueError(f"{call}: inertia is not symmetric, by {skew.max():.3g} kg m^2; expected I = I.T")
    symmetric = 0.5 * (inertia + np.swapaxes(inertia, -1, -2))
    lowest = np.linalg.eigvalsh(symmetric)[..., 0]
    if np.any(lowest < -SYMMETRY * scale):
        raise ValueError(f"{call}: inertia has the eigenvalue {lowest.min():.3g} kg m^2; expected none below zero")
    return symmetric


def _axes(call: str, kind: str, axis: Any, linear: Any, angular: Any, pitch: float) -> list[Screw]:
    """Return the screws of a hinge, inboard first."""

    def rows(name: str, value: Any, counts: Sequence[int]) -> np.ndarray:
        refuse_masked(call, name, value)
        try:
            array = np.atleast_2d(real(() if value is None else value))
        except (TypeError, ValueError):
            raise ValueError(f"{call}: {name} is {value!r}; expected vector(s) of 3 numbers") from None
        if array.size == 0:
            array = array.reshape(0, 3)
        if array.shape[0] not in counts or array.shape[1:] != (3,):
            wanted = " or ".join(str(count) for count in counts)
            raise ValueError(f"{call}: {name} has shape {np.shape(value)}; expected {wanted} vector(s) of 3")
        if array.size and not np.isfinite(array).all():
            raise ValueError(f"{call}: {name} is {array.tolist()}; expected finite numbers")
        return checked_unit(call, name, array) if len(array) else array

    turn = lambda vector: (vector, 1.0, 0.0)  # noqa: E731
    slide = lambda vector: (vector, 0.0, 1.0)  # noqa: E731
    if kind != "d6" and (linear is not None or angular is not None):
        raise ValueError(f"{call}: linear= and angular= belong to a d6; a {kind} hinge has axis=")
    pitch = float(checked_array(call, "pitch [m/rad]", pitch, ()))
    if kind != "helical" and pitch != 0.0:
        raise ValueError(f"{call}: pitch= belongs to a helical hinge")
    if kind in ("fixed", "ball", "free"):
        if axis is not None:
            raise ValueError(f"{call}: a {kind} hinge has no axis; got {axis!r}")
        return []
    if kind == "d6":
        if axis is not None:
            raise ValueError(f"{call}: a d6 has linear= and angular= instead of axis=")
        return [slide(v) for v in rows("linear", linear, range(4))] + [
            turn(v) for v in rows("angular", angular, range(4))
        ]
    if axis is None:
        raise ValueError(f"{call}: a {kind} hinge needs axis=, unit vector(s) in the parent anchor frame")
    if kind == "universal":
        vectors = rows("axis", axis, [2])
        if np.linalg.norm(np.cross(*vectors)) < SYMMETRY:
            raise ValueError(f"{call}: the axes of a universal hinge are parallel; expected two directions")
        return [turn(v) for v in vectors]
    if kind == "planar":
        vectors = rows("axis", axis, [1, 2])
        if len(vectors) == 1:
            vectors = np.concatenate([in_plane(vectors[0])])
        normal = np.cross(vectors[0], vectors[1])
        if abs(vectors[0] @ vectors[1]) > SYMMETRY:
            raise ValueError(f"{call}: the directions of a planar hinge are oblique; expected a right angle")
        return [slide(vectors[0]), slide(vectors[1]), turn(checked_unit(call, "axis[0] x axis[1]", normal))]
    vector = rows("axis", axis, [1])[0]
    return {
        "revolute": [turn(vector)],
        "prismatic": [slide(vector)],
        "helical": [(vector, 1.0, pitch)],
        "cylindrical": [slide(vector), turn(vector)],
    }[kind]


def in_plane(normal: np.ndarray) -> np.ndarray:
    """Return two unit vectors (2, 3) whose cross product is the unit ``normal``; the first is nearest to x or y."""
    seed = np.eye(3)[0] if abs(normal[0]) < 0.9 else np.eye(3)[1]
    first = seed - normal * (seed @ normal)
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


KINDS = (
    "fixed",
    "revolute",
    "prismatic",
    "helical",
    "universal",
    "cylindrical",
    "ball",
    "planar",
    "free",
    "d6",
)


@dataclasses.dataclass(frozen=True, eq=False)
class Hinge:
    """The edge of the tree that carries body ``child`` on body ``parent``.

    The child's pose in the parent is ``parent_pose * X(q) * child_pose^-1``; poses are (x, y, z, qx, qy, qz, qw).

    Args:
        kind: "fixed", "revolute", "prismatic", "helical", "universal", "cylindrical", "ball" (or "spherical"),
            "planar", "free" (or "distance") or "d6".
        parent: body index, -1 = the inertial frame.
        child: body index.
        axis: unit vector in the parent anchor frame; universal: the two axes, inboard first; planar: the normal, or
            the two directions of translation. Cylindrical and planar hinges translate first, then turn.
        linear, angular: up to three axes each of a d6; translations first, then rotations, inboard first.
        pitch: of a helical hinge [m/rad].
        parent_pose, child_pose: the hinge's anchor in the parent body and in the child body [m, unit quaternion].
        armature, damping, friction, stiffness: [kg m^2 or kg], [N m s or N s/m], [N m or N], [N m or N/m], one number
            for all degrees of freedom or one each; so are all that follow but ``rest``.
        target_ke, target_kd: gains of the drive. limit_lower, limit_upper: [rad or m]. limit_ke, limit_kd: stiffness
            and damping of the limits. effort_limit, velocity_limit: bounds of the drive's force and of the velocity.
        rest: coordinates at which the spring is relaxed, one per coordinate.
        label: name in tables and errors.

    Raises:
        ValueError: a value is invalid; the message names it.
        UnsupportedError: ``rotor`` (geared motors) is reserved.
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
    rotor: Any = None
    screws: tuple = dataclasses.field(init=False, repr=False)

    def __post_init__(self) -> None:
        call = f"Hinge({self.label!r})" if self.label else f"Hinge({self.kind!r})"
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        if self.rotor is not None:
            raise UnsupportedError(call, "a rotor (rotor=)", "put its reflected inertia into armature")
        if isinstance(self.kind, str):
            put("kind", ALIASES.get(self.kind, self.kind))
        if self.kind not in KINDS:
            raise ValueError(f"{call}: unknown kind; expected one of {', '.join(KINDS)}")
        put("screws", tuple(_axes(call, self.kind, self.axis, self.linear, self.angular, self.pitch)))
        put("parent_pose", _pose(call, "parent_pose", self.parent_pose))
        put("child_pose", _pose(call, "child_pose", self.child_pose))
        for name, default in DOF_VALUES.items():
            field = name.removeprefix("joint_")
            value = getattr(self, field)
            value = default if value is None else value
            value = checked_array(call, field, value, () if np.ndim(value) == 0 else (self.dof_count,))
            put(field, np.broadcast_to(value, (self.dof_count,)))
        rest = np.zeros(self.coord_count) if self.rest is None else self.rest
        if self.rest is None and self.motion != SCREWS:
            rest[-1] = 1.0  # the identity quaternion
        rest = checked_array(call, "rest", rest, () if np.ndim(rest) == 0 else (self.coord_count,))
        rest = np.broadcast_to(rest, (self.coord_count,))
        if self.motion != SCREWS:
            checked_unit(call, "the quaternion (xyzw) of rest", rest[-4:])
        put("rest", rest)

    @property
    def motion(self) -> int:
        """SCREWS, BALL or FREE."""
        return MOTION.get(self.kind, SCREWS)

    @property
    def dof_count(self) -> int:
        """Entries of ``qd`` that the hinge owns, the paper's r_k."""
        return {BALL: 3, FREE: 6}.get(self.motion, len(self.screws))

    @property
    def coord_count(self) -> int:
        """Entries of ``q`` that the hinge owns."""
        return {BALL: 4, FREE: 7}.get(self.motion, len(self.screws))


@dataclasses.dataclass(frozen=True, eq=False)
class Loop:
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

    def __post_init__(self) -> None:
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
        hinge, reference: indices into the scene's hinges.
        ratio: dimensionless, or [m/rad], [rad/m].
        offset: [rad] or [m].
    """

    hinge: int
    reference: int
    ratio: float = 1.0
    offset: float = 0.0
