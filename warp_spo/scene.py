"""Scenes: bodies, hinges, loops and couplings as plain float64 values with units, checked once and never repaired.

A scene is one world's topology and the values that may differ between worlds. Node k of the paper is body k here, its
frame is the child anchor of the hinge that carries it, and the columns of H.T come in the order of ``qd``.

Every hinge is one of three kinds of motion from its parent anchor to its child anchor:

* a chain of *screws*, ``exp(s_0 q_0) exp(s_1 q_1) ...``, each about or along an axis through the anchor: fixed (none),
  revolute, prismatic, helical, universal, cylindrical, planar and D6;
* ``ball``: a unit quaternion (xyzw), its velocity the relative angular velocity in the parent anchor's axes;
* ``free``: position and quaternion, its velocity the child's CoM velocity, then angular velocity, both relative to
  the parent anchor and in its axes.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from .errors import UnsupportedError
from .tree import Tree

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


def _array(call: str, name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    try:
        array = np.array(value, dtype=np.float64)  # a copy: what the caller does to his later changes nothing here
    except (TypeError, ValueError):
        raise ValueError(f"{call}: {name} is {value!r}; expected numbers of shape {shape}") from None
    if array.shape != shape:
        raise ValueError(f"{call}: {name} has shape {array.shape}; expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{call}: {name} is {array.tolist()}; expected finite numbers")
    return _read_only(array)


def _read_only(array: np.ndarray) -> np.ndarray:
    array.flags.writeable = False
    return array


def _unit(call: str, name: str, vector: np.ndarray) -> np.ndarray:
    norm = np.linalg.norm(vector, axis=-1, keepdims=True)
    if np.any(np.abs(norm - 1.0) > SYMMETRY):
        raise ValueError(f"{call}: {name} is {vector.tolist()}; expected unit length, got {norm.ravel().tolist()}")
    return vector / norm


def _pose(call: str, name: str, value: Any) -> np.ndarray:
    pose = _array(call, name, value, (7,))
    return _read_only(np.concatenate([pose[:3], _unit(call, f"the quaternion (xyzw) of {name}", pose[3:])]))


@dataclasses.dataclass(frozen=True, eq=False)
class Body:
    """A rigid body.

    Args:
        mass: [kg], not negative.
        com: centre of mass in the body frame [m], shape (3,).
        inertia: about the centre of mass, body axes [kg m^2], shape (3, 3), symmetric, no negative eigenvalue.
        label: name in tables and errors.

    Raises:
        ValueError: a value that no rigid body has.
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
        object.__setattr__(self, "mass", float(_array(call, "mass [kg]", self.mass, ())))
        object.__setattr__(self, "com", _array(call, "com [m]", self.com, (3,)))
        inertia = _array(call, "inertia [kg m^2]", self.inertia, (3, 3))
        if self.mass < 0.0:
            raise ValueError(f"{call}: mass is {self.mass} kg; expected zero or more")
        object.__setattr__(self, "inertia", _read_only(checked_inertia(call, inertia)))


def checked_inertia(call: str, inertia: np.ndarray) -> np.ndarray:
    """``inertia`` [..., 3, 3] less the rounding that its two triangles differ by.

    Raises:
        ValueError: it is not symmetric, or has a negative eigenvalue.
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
    """The screws of a hinge, inboard first."""

    def rows(name: str, value: Any, counts: Sequence[int]) -> np.ndarray:
        try:
            array = np.atleast_2d(np.array(() if value is None else value, dtype=np.float64))
        except (TypeError, ValueError):
            raise ValueError(f"{call}: {name} is {value!r}; expected vector(s) of 3 numbers") from None
        if array.size == 0:
            array = array.reshape(0, 3)
        if array.shape[0] not in counts or array.shape[1:] != (3,):
            wanted = " or ".join(str(count) for count in counts)
            raise ValueError(f"{call}: {name} has shape {np.shape(value)}; expected {wanted} vector(s) of 3")
        if array.size and not np.isfinite(array).all():
            raise ValueError(f"{call}: {name} is {array.tolist()}; expected finite numbers")
        return _unit(call, name, array) if len(array) else array

    turn = lambda vector: (vector, 1.0, 0.0)  # noqa: E731
    slide = lambda vector: (vector, 0.0, 1.0)  # noqa: E731
    if kind != "d6" and (linear is not None or angular is not None):
        raise ValueError(f"{call}: linear= and angular= belong to a d6; a {kind} hinge has axis=")
    pitch = float(_array(call, "pitch [m/rad]", pitch, ()))
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
        return [slide(vectors[0]), slide(vectors[1]), turn(_unit(call, "axis[0] x axis[1]", normal))]
    vector = rows("axis", axis, [1])[0]
    return {
        "revolute": [turn(vector)],
        "prismatic": [slide(vector)],
        "helical": [(vector, 1.0, pitch)],
        "cylindrical": [slide(vector), turn(vector)],
    }[kind]


def in_plane(normal: np.ndarray) -> np.ndarray:
    """Two unit vectors (2, 3) whose cross product is the unit ``normal``; the first lies nearest to x or y."""
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
        armature [kg m^2 or kg], damping [N m s or N s/m], friction [N m or N], stiffness [N m or N/m], target_ke,
            target_kd, limit_lower, limit_upper [rad or m], limit_ke, limit_kd, effort_limit, velocity_limit: one
            number for all degrees of freedom or one each.
        rest: coordinates at which the spring is relaxed, one per coordinate.
        label: name in tables and errors.

    Raises:
        ValueError: a value that no hinge has, named.
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
            value = _array(call, field, value, () if np.ndim(value) == 0 else (self.dof_count,))
            put(field, np.broadcast_to(value, (self.dof_count,)))
        rest = np.zeros(self.coord_count) if self.rest is None else self.rest
        if self.rest is None and self.motion != SCREWS:
            rest[-1] = 1.0  # the identity quaternion
        rest = _array(call, "rest", rest, () if np.ndim(rest) == 0 else (self.coord_count,))
        rest = np.broadcast_to(rest, (self.coord_count,))
        if self.motion != SCREWS:
            _unit(call, "the quaternion (xyzw) of rest", rest[-4:])
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

    Args: as those of :class:`Hinge`; ``parent`` may be -1, the inertial frame.
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
        hinge = Hinge(self.kind, self.parent, self.child, self.axis, self.linear, self.angular, self.pitch,
                      parent_pose=self.parent_pose, child_pose=self.child_pose, label=self.label)
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


def _parts(name: str, given: Any, kind: type) -> tuple:
    parts = tuple(given) if isinstance(given, Iterable) else (given,)
    if not isinstance(given, Iterable) or not all(isinstance(part, kind) for part in parts):
        came = ", ".join(sorted({type(part).__name__ for part in parts}))
        raise TypeError(f"Scene: {name} holds {came}; expected a list of {kind.__name__}")
    return parts


class Scene:
    """A multibody system: a forest of bodies, and the values that kernels read.

    Args:
        bodies: body k is node k.
        hinges: one for each body, in the order of ``q``; any order, any numbering of the bodies.
        gravity: acceleration of a falling body [m/s^2], inertial axes, shape (3,).
        loops: hinges beyond the tree; :class:`Dynamics` asks what to do with them.
        couplings: mimics.

    Attributes:
        bodies, hinges, loops, couplings: as given; :meth:`with_values` changes ``values`` alone.
        tree: the :class:`Tree` over the bodies.
        hinge_of: index of the hinge that carries each body [body].
        q_start, qd_start: first entry of q and qd of each hinge, and the total at the end [hinge + 1].
        values: float64 arrays by Newton's names, [1 or worlds, ...]: body_mass [kg], body_com [m], body_inertia
            [kg m^2], joint_X_p, joint_X_c (poses [hinge, 7]), gravity [m/s^2], joint_rest_q [coordinate], and per dof
            joint_armature, joint_damping, joint_friction, joint_stiffness, joint_target_ke, joint_target_kd,
            joint_limit_lower, joint_limit_upper, joint_limit_ke, joint_limit_kd, joint_effort_limit,
            joint_velocity_limit.
        dof_axis [dof, 3], dof_angular [dof], dof_linear [dof]: the screws, in the parent anchor frame.
        q_index, dof_index: entries [worlds, n] of the source model's flat joint_q and joint_qd.

    Raises:
        ValueError: indices that make no forest, or values that no scene has.
        DirectedLoopError: hinges whose parents form a directed loop.
    """

    def __init__(self, bodies: Sequence[Body], hinges: Sequence[Hinge], gravity: Any = (0.0, 0.0, -9.81),
                 loops: Sequence[Loop] = (), couplings: Sequence[Coupling] = ()):
        self.bodies, self.hinges = _parts("bodies", bodies, Body), _parts("hinges", hinges, Hinge)
        self.loops, self.couplings = _parts("loops", loops, Loop), _parts("couplings", couplings, Coupling)
        self._check_indices()
        self.hinge_of = np.empty(len(self.bodies), dtype=np.int32)
        for index, hinge in enumerate(self.hinges):
            self.hinge_of[hinge.child] = index
        self.tree = Tree([self.hinges[h].parent for h in self.hinge_of])
        self.q_start = np.cumsum([0] + [hinge.coord_count for hinge in self.hinges])
        self.qd_start = np.cumsum([0] + [hinge.dof_count for hinge in self.hinges])

        self.values: dict[str, np.ndarray] = {
            "body_mass": np.array([[body.mass for body in self.bodies]]),
            "body_com": np.array([[body.com for body in self.bodies]]),
            "body_inertia": np.array([[body.inertia for body in self.bodies]]),
            "joint_X_p": np.array([[hinge.parent_pose for hinge in self.hinges]]),
            "joint_X_c": np.array([[hinge.child_pose for hinge in self.hinges]]),
            "joint_rest_q": np.concatenate([hinge.rest for hinge in self.hinges])[None],
            "gravity": _array("Scene", "gravity [m/s^2]", gravity, (3,))[None],
        }
        for name in DOF_VALUES:
            field = name.removeprefix("joint_")
            self.values[name] = np.concatenate([getattr(hinge, field) for hinge in self.hinges])[None]
        for array in self.values.values():
            _read_only(array)

        screws = [self._screws_of(hinge) for hinge in self.hinges]
        self.dof_axis = np.concatenate([axis for axis, _, _ in screws]).reshape(-1, 3)
        self.dof_angular = np.concatenate([angular for _, angular, _ in screws])
        self.dof_linear = np.concatenate([linear for _, _, linear in screws])
        self.q_index = np.arange(self.coord_count)[None]
        self.dof_index = np.arange(self.dof_count)[None]

    @staticmethod
    def _screws_of(hinge: Hinge) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        if hinge.motion == SCREWS:
            axes, angular, linear = (np.array([screw[i] for screw in hinge.screws]) for i in range(3))
            return axes.reshape(-1, 3), angular, linear
        axes = np.tile(np.eye(3), (hinge.dof_count // 3, 1))  # free: CoM velocity, then angular velocity
        angular = np.repeat([0.0, 1.0] if hinge.motion == FREE else [1.0], 3)
        return axes, angular, 1.0 - angular

    def _check_indices(self) -> None:
        count = len(self.bodies)
        if count == 0:
            raise ValueError("Scene: no bodies; expected one or more")
        carried: dict[int, str] = {}
        edges: list[Any] = [*self.hinges, *self.loops]
        for index, hinge in enumerate(edges):
            name = f"hinge {index} {hinge.label!r}" if index < len(self.hinges) else f"loop {hinge.label!r}"
            if not all(isinstance(body, int | np.integer) for body in (hinge.parent, hinge.child)):
                raise TypeError(f"Scene: {name} joins body {hinge.parent!r} to body {hinge.child!r}; expected integers")
            if not (-1 <= hinge.parent < count and 0 <= hinge.child < count) or hinge.parent == hinge.child:
                raise ValueError(f"Scene: {name} joins body {hinge.parent} to body {hinge.child}; expected two of "
                                 f"{count} bodies, -1 being the inertial frame as parent")
            if isinstance(hinge, Hinge) and carried.setdefault(hinge.child, name) != name:
                raise ValueError(f"Scene: body {hinge.child} is the child of {carried[hinge.child]} and of {name}; "
                                 f"expected one hinge a body: make one of them a Loop")
        if len(carried) < count:
            lost = next(body for body in range(count) if body not in carried)
            raise ValueError(f"Scene: body {lost} {self.bodies[lost].label!r} is the child of no hinge; expected one "
                             f"hinge a body: add Hinge('free', -1, {lost}) to let it float")
        for coupling in self.couplings:
            for index in (coupling.hinge, coupling.reference):
                if not 0 <= index < len(self.hinges) or self.hinges[index].coord_count != 1:
                    raise ValueError(f"Scene: a coupling names hinge {index}; expected one of {len(self.hinges)} "
                                     f"hinges with one coordinate")

    # -- sizes and names -------------------------------------------------------------------------------------------
    @property
    def worlds(self) -> int:
        """Worlds of the source model, or whose values the scene holds; a scene of one world serves any number."""
        return max(array.shape[0] for array in (self.q_index, *self.values.values()))

    @property
    def body_count(self) -> int:
        return len(self.bodies)

    @property
    def coord_count(self) -> int:
        """Length of one world's q."""
        return int(self.q_start[-1])

    @property
    def dof_count(self) -> int:
        """Length of one world's qd."""
        return int(self.qd_start[-1])

    @property
    def node_sizes(self) -> tuple[int, ...]:
        """The paper's m_k: 6 for a rigid body."""
        return (6,) * self.body_count

    @property
    def hinge_sizes(self) -> tuple[int, ...]:
        """The paper's r_k, by node: degrees of freedom of the hinge that carries it."""
        return tuple(self.hinges[h].dof_count for h in self.hinge_of)

    @property
    def body_labels(self) -> list[str]:
        return [body.label or f"body_{k}" for k, body in enumerate(self.bodies)]

    @property
    def joint_labels(self) -> list[str]:
        return [hinge.label or f"joint_{k}" for k, hinge in enumerate(self.hinges)]

    @property
    def dof_labels(self) -> list[str]:
        return [label if hinge.dof_count == 1 else f"{label}:{i}"
                for label, hinge in zip(self.joint_labels, self.hinges, strict=True) for i in range(hinge.dof_count)]

    @property
    def neutral_q(self) -> np.ndarray:
        """Coordinates at which every hinge's anchors coincide [coordinate]: zeros and identity quaternions."""
        q = np.zeros(self.coord_count)
        for hinge, start in zip(self.hinges, self.q_start, strict=False):
            if hinge.motion != SCREWS:
                q[start + hinge.coord_count - 1] = 1.0
        return q

    def with_values(self, **values: Any) -> Scene:
        """A copy with some of ``values`` replaced, [...] for all worlds or [worlds, ...] for each.

        Raises:
            ValueError: an unknown name, a wrong shape, numbers that are not finite, or unequal world counts.
        """
        scene = object.__new__(Scene)
        scene.__dict__.update(self.__dict__)
        scene.values = dict(self.values)
        for name, value in values.items():
            scene.values[name] = self.check_value("Scene.with_values", name, value)
        counts = {array.shape[0] for array in (scene.q_index, *scene.values.values())} - {1}
        if len(counts) > 1:
            raise ValueError(f"Scene.with_values: values for {sorted(counts)} worlds; expected one world count")
        worlds = scene.worlds
        if scene.q_index.shape[0] != worlds:
            scene.q_index = np.arange(worlds * self.coord_count).reshape(worlds, -1)
            scene.dof_index = np.arange(worlds * self.dof_count).reshape(worlds, -1)
        return scene

    def check_value(self, call: str, name: str, value: Any) -> np.ndarray:
        """``value`` as a float64 array [1 or worlds, ...], if it is one that ``values[name]`` can be."""
        if name not in self.values:
            raise ValueError(f"{call}: unknown value {name!r}; expected one of {', '.join(sorted(self.values))}")
        shape = self.values[name].shape[1:]
        try:
            array = np.array(value, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(f"{call}: {name} is {value!r}; expected numbers of shape {shape}") from None
        if array.shape == shape:
            array = array[None]
        if array.shape[1:] != shape or array.ndim != len(shape) + 1 or array.shape[0] == 0:
            raise ValueError(f"{call}: {name} has shape {np.shape(value)}; expected {shape} or (worlds, "
                             f"{', '.join(map(str, shape))})")
        if not np.isfinite(array).all():
            raise ValueError(f"{call}: {name} holds NaN or infinity; expected finite numbers")
        if name in ("joint_X_p", "joint_X_c"):
            array[..., 3:] = _unit(call, f"the quaternions of {name}", array[..., 3:])
        if name == "body_inertia":
            array = checked_inertia(call, array)
        if name == "body_mass" and array.min() < 0.0:
            raise ValueError(f"{call}: body_mass has {array.min()} kg; expected zero or more")
        return _read_only(array)

    def __repr__(self) -> str:
        return (f"Scene({self.body_count} bodies, {self.dof_count} dof, depth {self.tree.depth}, "
                f"{len(self.loops)} loops, {self.worlds} world(s))")
