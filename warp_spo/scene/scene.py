"""Scenes: a multibody system as plain float64 values, which are checked once and never repaired.

A scene is the topology of one world, and values that may differ between worlds. Node k of the paper is body k. Its
frame is the child anchor of the hinge that carries the body, and the columns of H.T are in the order of ``qd``.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np

from ..errors import quoted, refuse_masked, shown
from .actuators import RANGES, Actuator, Keyframe, actuator_values, check_actuator_value
from .checks import SYMMETRY, refuse_gradient
from .contact_values import CONTACT_VALUES, contact_values
from .contacts import Contact, ContactPoint, check_contacts, contact_points
from .flexible.modes import MASS_VALUES, check_modes, with_modes
from .ground import HEIGHTS, HeightField, Plane, check_field
from .labels import fill_labels
from .pairs import ContactPair, contact_pairs
from .parts import (
    DOF_VALUES,
    Body,
    Coupling,
    Hinge,
    Loop,
    checked_array,
    checked_inertia,
    checked_pose,
    checked_unit,
    read_only,
    real,
)
from .pickling import Stored
from .tree import Tree

HINGE_VALUES = {name.removeprefix("joint_"): value for name, value in DOF_VALUES.items()}
NOT_NEGATIVE = (
    "body_mass",
    "joint_damping",
    "joint_friction",
    "joint_target_ke",
    "joint_target_kd",
    "joint_limit_ke",
    "joint_limit_kd",
    "joint_effort_limit",
    "joint_velocity_limit",
    "actuator_strength",
    "actuator_delay",
    *CONTACT_VALUES,
)


def refuse_negative(call: str, name: str, array: np.ndarray) -> None:
    """Raise ValueError if a value that may not be negative is."""
    if name in NOT_NEGATIVE and (array < 0.0).any():
        raise ValueError(f"{call}: {name} holds {array.min()}; expected zero or more")


def _parts(name: str, value: Any, kind: type) -> tuple:
    """Return a list of parts as a tuple; raise TypeError if one is not of type ``kind``."""
    parts = tuple(value) if isinstance(value, Iterable) else (value,)
    if not isinstance(value, Iterable) or not all(isinstance(part, kind) for part in parts):
        came = ", ".join(sorted({type(part).__name__ for part in parts}))
        raise TypeError(f"Scene: {name} holds {came}; expected a list of {kind.__name__}")
    return parts


class Scene(Stored):
    """A multibody system: a forest of bodies, and the values that kernels read.

    The constructor checks values and never repairs them. Masses and principal moments may be zero and may have any
    ratio, but may not be negative, and no principal moment may exceed the sum of the others unless the body has
    ``any_inertia=True``. Damping, friction, gains and bounds may not be negative, and no lower limit may exceed the
    upper one.

    Args:
        bodies: the bodies; body k is node k.
        hinges: one hinge for each body. Their order is that of ``q``, whatever the numbering of the bodies.
        gravity: acceleration of a falling body [m/s^2], inertial axes, shape (3,).
        loops: hinges that close loops of the tree; ``loops=`` of :class:`Dynamics` says what to do with them.
        couplings: linear relations between two coordinates.
        actuators: forces that control values command.
        sites: named frames, (body index, pose in the body (x, y, z, qx, qy, qz, qw)) by name.
        keyframes: named states.
        contacts: bodies that touch the ground or each other in :meth:`Dynamics.step`; other calls leave them out.
        ground: a :class:`Plane` or a :class:`HeightField`; None: the plane at height 0, where there are contacts.
        initial_q: where a file places its bodies [coordinate]; None: ``neutral_q``.

    Attributes:
        bodies, hinges, loops, couplings, actuators, sites, keyframes, contacts, ground: the arguments;
            :meth:`with_values` changes only ``values``.
        initial_q: the coordinates at which the file or model places its bodies [coordinate]: MuJoCo's qpos0, the
            ``joint_q`` of the first world of a Newton model; ``neutral_q`` where the source says nothing. Free bodies
            of ``neutral_q`` all lie at the origin.
        tree: the :class:`Tree` over the bodies.
        hinge_of: index of the hinge that carries each body [body].
        q_start: first entry of q of each hinge, and the total at the end [hinge + 1].
        qd_start: first entry of qd of each hinge, and the total at the end [hinge + 1].
        values: float64 arrays by Newton's names, [1 or worlds, ...]: body_mass [kg], body_com [m], body_inertia
            [kg m^2], body_gravcomp, joint_X_p, joint_X_c (poses [hinge, 7]), gravity [m/s^2], joint_rest_q
            [coordinate], and per dof joint_armature, joint_damping, joint_friction, joint_stiffness, joint_target_ke,
            joint_target_kd, joint_limit_lower, joint_limit_upper, joint_limit_ke, joint_limit_kd, joint_effort_limit,
            joint_velocity_limit. Of actuators: actuator_gain, actuator_strength, actuator_delay [actuator],
            actuator_bias [actuator, 3], actuator_ctrl_range, actuator_force_range [actuator, 2], and actuator_gear, of
            the hinges of the first actuator, of the second, and so on. Of contacts: contact_friction,
            contact_stiffness [N/m], contact_damping [N s/m] [contact]; contact_torsional_friction,
            contact_rolling_friction [m] [point]; ground_origin [3], where the ground's own origin is [m], zero at
            first; ground_field [1], which field of a set of height fields, the first at first; ground_heights [m], the
            heights of a field, as they are there, shared by all worlds.
        contact_points: the points (``ContactPoint``) of all contacts with the ground, contact after contact.
        contact_pairs: the pairs of bodies (``ContactPair``) that touch each other. Where axes of arrays say "contact",
            there is an entry for each of the points and then one for each of the pairs.
        dof_axis: axis of each dof, in the parent anchor frame [dof, 3].
        dof_angular: radians about the axis per unit of the coordinate [dof].
        dof_linear: metres along the axis per unit of the coordinate [dof].
        q_index: entries of the source model's flat joint_q [worlds, coordinate].
        dof_index: entries of the source model's flat joint_qd [worlds, dof].

    Raises:
        ValueError: the indices do not form a forest, or a value is invalid.
        TypeError: a list holds something else, or an index is not an integer.
        DirectedLoopError: the parents of hinges form a directed loop.
    """

    def __init__(
        self,
        bodies: Sequence[Body],
        hinges: Sequence[Hinge],
        gravity: Any = (0.0, 0.0, -9.81),
        loops: Sequence[Loop] = (),
        couplings: Sequence[Coupling] = (),
        actuators: Sequence[Actuator] = (),
        sites: Mapping[str, tuple[int, Any]] = MappingProxyType({}),
        keyframes: Mapping[str, Keyframe] = MappingProxyType({}),
        contacts: Sequence[Contact] = (),
        ground: Plane | HeightField | None = None,
        initial_q: Any = None,
    ):
        self.bodies, self.hinges = _parts("bodies", bodies, Body), _parts("hinges", hinges, Hinge)
        self.loops, self.couplings = _parts("loops", loops, Loop), _parts("couplings", couplings, Coupling)
        self.actuators = _parts("actuators", actuators, Actuator)
        self._check_indices()
        self._set_contacts(contacts, ground)
        self.hinges = tuple(with_modes(hinge, self.bodies[hinge.child].modes, HINGE_VALUES) for hinge in self.hinges)
        self.hinge_of = np.empty(len(self.bodies), dtype=np.int32)
        for index, hinge in enumerate(self.hinges):
            self.hinge_of[hinge.child] = index
        self.tree = Tree([self.hinges[h].parent for h in self.hinge_of])
        self.q_start = np.cumsum([0] + [hinge.coord_count for hinge in self.hinges])
        self.qd_start = np.cumsum([0] + [hinge.dof_count for hinge in self.hinges])

        values: dict[str, np.ndarray] = {
            "body_mass": np.array([[body.mass for body in self.bodies]]),
            "body_com": np.array([[body.com for body in self.bodies]]),
            "body_inertia": np.array([[body.inertia for body in self.bodies]]),
            "body_gravcomp": np.array([[body.gravcomp for body in self.bodies]]),
            "joint_X_p": np.array([[hinge.parent_pose for hinge in self.hinges]]),
            "joint_X_c": np.array([[hinge.child_pose for hinge in self.hinges]]),
            "joint_rest_q": np.concatenate([hinge.rest for hinge in self.hinges])[None],
            "gravity": checked_array("Scene", "gravity [m/s^2]", gravity, (3,))[None],
        }
        for name in DOF_VALUES:
            field = name.removeprefix("joint_")
            values[name] = np.concatenate([getattr(hinge, field) for hinge in self.hinges])[None]
            refuse_negative("Scene", name, values[name])
        values["joint_armature"] = values["joint_armature"] + np.concatenate([h.reflected_inertia for h in self.hinges])
        self._refuse_impossible_inertias("Scene", values["body_inertia"])
        self._refuse_crossed_limits("Scene", values)
        values |= actuator_values(self.actuators)
        self.values = MappingProxyType(values)
        values |= contact_values(self)
        for array in values.values():
            read_only(array)

        screws = [self._screws_of(hinge) for hinge in self.hinges]
        self.dof_axis = np.concatenate([axis for axis, _, _ in screws]).reshape(-1, 3)
        self.dof_angular = np.concatenate([angular for _, angular, _ in screws])
        self.dof_linear = np.concatenate([linear for _, _, linear in screws])
        self.q_index = np.arange(self.coord_count)[None]
        self.dof_index = np.arange(self.dof_count)[None]
        self.sites = MappingProxyType({name: self._site(name, *site) for name, site in sites.items()})
        self.keyframes = MappingProxyType({name: self._keyframe(name, key) for name, key in keyframes.items()})
        start = self.neutral_q if initial_q is None else initial_q
        self.initial_q = read_only(checked_array("Scene", "initial_q", start, (self.coord_count,)))
        check_modes(self)

    def _site(self, name: str, body: int, pose: Any) -> tuple[int, tuple[float, ...]]:
        """Return the body and the checked pose of a site."""
        call = f"Scene: site {quoted(name)}"
        if not isinstance(body, int | np.integer) or not -1 <= body < len(self.bodies):
            raise ValueError(f"{call} is on body {body!r}; expected 0 to {len(self.bodies) - 1}, or -1")
        return int(body), tuple(checked_pose(call, "its pose", pose).tolist())

    def _keyframe(self, name: str, key: Keyframe) -> Keyframe:
        """Return a keyframe whose arrays are checked."""
        sizes = (self.coord_count, self.dof_count, len(self.actuators))
        return Keyframe(
            *(
                read_only(checked_array(f"Scene: keyframe {quoted(name)}", field, array, (size,)))
                for field, array, size in zip(Keyframe._fields, key, sizes, strict=True)
            )
        )

    @staticmethod
    def _screws_of(hinge: Hinge) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the axes [dof, 3], and radians and metres per unit of each coordinate [dof]."""
        rows = [row for kind, axis in hinge.elements for row in kind.screws(axis)]
        axes, angular, linear = (np.array([row[i] for row in rows], dtype=np.float64) for i in range(3))
        return axes.reshape(-1, 3), angular, linear

    def _check_indices(self) -> None:
        """Raise an error if hinges, loops, couplings and actuators do not name the right bodies and hinges."""
        count = len(self.bodies)
        if count == 0:
            raise ValueError("Scene: no bodies; expected one or more")
        carried: dict[int, str] = {}
        edges: list[Any] = [*self.hinges, *self.loops]
        for index, hinge in enumerate(edges):
            name = f"hinge {index} {quoted(hinge.label)}" if index < len(self.hinges) else f"loop {quoted(hinge.label)}"
            if not all(isinstance(body, int | np.integer) for body in (hinge.parent, hinge.child)):
                raise TypeError(f"Scene: {name} joins body {hinge.parent!r} to body {hinge.child!r}; expected integers")
            if not (-1 <= hinge.parent < count and 0 <= hinge.child < count) or hinge.parent == hinge.child:
                raise ValueError(
                    f"Scene: {name} joins body {hinge.parent} to body {hinge.child}; expected two of "
                    f"{count} bodies, -1 being the inertial frame as parent"
                )
            if isinstance(hinge, Hinge) and carried.setdefault(hinge.child, name) != name:
                raise ValueError(
                    f"Scene: body {hinge.child} is the child of {carried[hinge.child]} and of {name}; "
                    f"expected one hinge a body: make one of them a Loop"
                )
        if len(carried) < count:
            lost = next(body for body in range(count) if body not in carried)
            raise ValueError(
                f"Scene: body {lost} {quoted(self.bodies[lost].label)} is the child of no hinge; expected one "
                f"hinge a body: add Hinge('free', -1, {lost}) to let it float"
            )
        for coupling in self.couplings:
            if coupling.hinge == coupling.reference:
                raise ValueError(f"Scene: a coupling ties hinge {coupling.hinge} to itself; expected two hinges")
            for name in ("ratio", "offset"):
                checked_array("Scene", f"a coupling's {name}", getattr(coupling, name), ())
            for index in (coupling.hinge, coupling.reference):
                if not isinstance(index, int | np.integer):
                    raise TypeError(f"Scene: a coupling names hinge {index!r}; expected an integer")
                if not 0 <= index < len(self.hinges) or not self.hinges[index].driven:
                    raise ValueError(
                        f"Scene: a coupling names hinge {index}; expected one of {len(self.hinges)} "
                        f"hinges with one coordinate"
                    )
        for number, actuator in enumerate(self.actuators):
            for index in actuator.hinges:
                if not 0 <= index < len(self.hinges) or not self.hinges[index].driven:
                    raise ValueError(
                        f"Scene: actuator {number} {quoted(actuator.label)} names hinge {index}; expected one of "
                        f"{len(self.hinges)} hinges with one coordinate"
                    )

    # -- sizes and names -------------------------------------------------------------------------------------------
    @property
    def worlds(self) -> int:
        """The number of worlds of the source model or of the values; a scene of one world serves any number."""
        return max(array.shape[0] for array in (self.q_index, *self.values.values()))

    @property
    def body_count(self) -> int:
        """The number of bodies."""
        return len(self.bodies)

    @property
    def coord_count(self) -> int:
        """The length of one world's q."""
        return int(self.q_start[-1])

    @property
    def dof_count(self) -> int:
        """The length of one world's qd."""
        return int(self.qd_start[-1])

    @property
    def node_sizes(self) -> tuple[int, ...]:
        """The paper's m_k. It is 6, and the body's modes, and 6 for the rotor of its hinge or 1 if that is reduced."""
        rotors = (self.hinges[h].rotor for h in self.hinge_of)
        return tuple(
            6 + getattr(body.modes, "count", 0) + getattr(rotor, "dimensions", 0)
            for body, rotor in zip(self.bodies, rotors, strict=True)
        )

    @property
    def shares_dofs(self) -> bool:
        """Whether bodies have modes, or hinges have rotors that move, so that one dof moves several links."""
        rotors = any(hinge.rotor is not None and hinge.rotor.shares_dof for hinge in self.hinges)
        return rotors or any(body.modes is not None for body in self.bodies)

    @property
    def hinge_sizes(self) -> tuple[int, ...]:
        """The paper's r_k, by node. These are the degrees of freedom of the hinge that carries the node."""
        return tuple(self.hinges[h].dof_count for h in self.hinge_of)

    @property
    def body_labels(self) -> list[str]:
        """The label of every body; body_k where there is none, unless another has it."""
        return fill_labels((body.label for body in self.bodies), "body")

    @property
    def joint_labels(self) -> list[str]:
        """The label of every hinge; joint_k where there is none, unless another has it."""
        return fill_labels((hinge.label for hinge in self.hinges), "joint")

    @property
    def dof_labels(self) -> list[str]:
        """The labels of the entries of qd. They are the hinges' labels, with ``:0``, ``:1``, ... if several.

        Those of a flexible hinge end in ``:motor`` and ``:deflection``; those of a body's modes are the label of its
        hinge with ``/modes:0``, ``/modes:1``, ...
        """
        found = []
        for label, hinge in zip(self.joint_labels, self.hinges, strict=True):
            modes = getattr(self.bodies[hinge.child].modes, "count", 0)
            own = hinge.dof_count - modes
            ends = ("motor", "deflection") if hinge.flexible else range(own)
            found += [label if own == 1 else f"{label}:{end}" for end in ends]
            found += [f"{label}/modes:{i}" for i in range(modes)]
        return found

    @property
    def deflections(self) -> tuple[int, ...]:
        """The dofs that only forces move, those that are the deflection of a flexible hinge or the modes of a body."""
        found: list[int] = []
        for first, end, hinge in zip(self.qd_start, self.qd_start[1:], self.hinges, strict=False):
            modes = getattr(self.bodies[hinge.child].modes, "count", 0)
            found += range(int(first) + 1 if hinge.flexible else int(end) - modes, int(end))
        return tuple(found)

    @property
    def constraint_summary(self) -> str:
        """A list in words of the loop joints and couplings, for messages; empty if there are none."""
        loops = [shown(loop.label) or f"body {loop.parent} to body {loop.child}" for loop in self.loops]
        labels = self.joint_labels
        couplings = [f"{shown(labels[c.hinge])} follows {shown(labels[c.reference])}" for c in self.couplings]
        kinds = ("loop joint(s)", loops), ("coupling(s)", couplings)
        return " and ".join(f"{len(names)} {kind}: {', '.join(names)}" for kind, names in kinds if names)

    @property
    def neutral_q(self) -> np.ndarray:
        """The q at which the anchors of every hinge coincide [coordinate]. It holds zeros and identity quaternions.

        It may lie outside of joint limits, and loops and couplings may not hold there: :meth:`Dynamics.project` closes
        them.
        """
        return np.concatenate([hinge.neutral for hinge in self.hinges])

    @property
    def inertial_parameters(self) -> np.ndarray:
        """The ten numbers m, m c (3), Ixx, Ixy, Iyy, Ixz, Iyz, Izz of each body [worlds, 10 bodies].

        The moments of inertia are about the origin of the body frame, in its axes; c is the centre of mass there
        [kg, kg m, kg m^2]. They are what :meth:`Dynamics.inverse_dynamics_regressor` multiplies.
        """
        mass, com = self.values["body_mass"][..., None], self.values["body_com"]
        squares = np.eye(3) * (com * com).sum(-1)[..., None, None] - com[..., :, None] * com[..., None, :]
        inertia = self.values["body_inertia"] + mass[..., None] * squares
        entries = [inertia[..., i, j, None] for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2))]
        worlds = max(part.shape[0] for part in (mass, com, inertia))
        parts = [np.broadcast_to(x, (worlds, *x.shape[1:])) for x in (mass, mass * com, *entries)]
        return np.concatenate(parts, axis=-1).reshape(worlds, -1)

    def with_contacts(self, contacts: Sequence[Contact], ground: Plane | HeightField | None = None) -> Scene:
        """Return a copy of the scene with these contacts in place of its own; arguments as those of the class."""
        scene = object.__new__(Scene)
        scene.__dict__.update(self.__dict__)
        scene._set_contacts(contacts, ground)
        scene.values = MappingProxyType({**self.values, **contact_values(scene)})
        return scene

    def without_loops(self) -> Scene:
        """Return a copy of the scene without its loop joints and couplings: an open tree with all its joints."""
        scene = object.__new__(Scene)
        scene.__dict__.update(self.__dict__, loops=(), couplings=())
        return scene

    def _set_contacts(self, contacts: Sequence[Contact], ground: Plane | HeightField | None) -> None:
        self.contacts: tuple[Contact, ...] = _parts("contacts", contacts, Contact)
        check_contacts(self.contacts, ground, self.bodies)
        self.ground = Plane() if ground is None and self.contacts else ground
        self.contact_points: tuple[ContactPoint, ...] = contact_points(self.contacts, self.ground)
        self.contact_pairs: tuple[ContactPair, ...] = contact_pairs(self.contacts, self.bodies)

    @property
    def contact_count(self) -> int:
        """Points that touch the ground, and pairs of bodies that touch each other."""
        return len(self.contact_points) + len(self.contact_pairs)

    def with_values(self, **values: Any) -> Scene:
        """Return a copy of the scene with other ``values``, [...] for all worlds or [worlds, ...] for each world.

        Raises:
            ValueError: a name is unknown, a shape is wrong, numbers are not finite, or world counts differ.
            UnsupportedError: mass, centre of mass or inertia of a body with modes would differ between worlds.
        """
        scene = object.__new__(Scene)
        scene.__dict__.update(self.__dict__)
        checked = {name: self.check_value("Scene.with_values", name, value) for name, value in values.items()}
        scene.values = MappingProxyType({**self.values, **checked})
        if HEIGHTS in checked and isinstance(self.ground, HeightField):
            scene.ground = dataclasses.replace(self.ground, heights=checked[HEIGHTS][0])
        scene._refuse_crossed_limits("Scene.with_values", scene.values)
        if not checked.keys().isdisjoint(MASS_VALUES):
            check_modes(scene, "Scene.with_values")
        counts = {array.shape[0] for array in (scene.q_index, *scene.values.values())} - {1}
        if len(counts) > 1:
            raise ValueError(f"Scene.with_values: values for {sorted(counts)} worlds; expected one world count")
        worlds = scene.worlds
        if scene.q_index.shape[0] != worlds:
            scene.q_index = np.arange(worlds * self.coord_count).reshape(worlds, -1)
            scene.dof_index = np.arange(worlds * self.dof_count).reshape(worlds, -1)
        return scene

    def check_value(self, call: str, name: str, value: Any) -> np.ndarray:
        """Return ``value`` as a checked float64 array [1 or worlds, ...] for ``values[name]``; ValueError otherwise."""
        if name not in self.values:
            raise ValueError(f"{call}: unknown value {quoted(name)}; expected one of {', '.join(sorted(self.values))}")
        shape = self.values[name].shape[1:]
        refuse_masked(call, name, value)
        try:
            array = real(value)
        except (TypeError, ValueError):
            refuse_gradient(call, name, value, name)
            raise ValueError(f"{call}: {name} is {value!r}; expected numbers of shape {shape}") from None
        if array.shape == shape:
            array = array[None]
        if array.shape[1:] != shape or array.ndim != len(shape) + 1 or array.shape[0] == 0:
            raise ValueError(
                f"{call}: {name} has shape {np.shape(value)}; expected {shape} or (worlds, "
                f"{', '.join(map(str, shape))})"
            )
        check_actuator_value(call, name, array)
        check_field(call, name, array, self.ground)
        if name not in RANGES and not np.isfinite(array).all():
            raise ValueError(f"{call}: {name} holds NaN or infinity; expected finite numbers")
        if name in ("joint_X_p", "joint_X_c"):
            array[..., 3:] = checked_unit(call, f"the quaternions of {name}", array[..., 3:])
        if name == "body_inertia":
            array = checked_inertia(call, array, [body.any_inertia for body in self.bodies])
            self._refuse_impossible_inertias(call, array)
        refuse_negative(call, name, array)
        return read_only(array)

    def _refuse_impossible_inertias(self, call: str, inertias: np.ndarray) -> None:
        """Raise ValueError if a principal moment of ``inertias`` [worlds, body, 3, 3] exceeds the sum of the others."""
        moments = np.linalg.eigvalsh(inertias)
        excess = moments[..., 2] - moments[..., 1] - moments[..., 0] - SYMMETRY * moments[..., 2]
        refused = (excess > 0.0) & ~np.array([body.any_inertia for body in self.bodies])
        if refused.any():
            world, body = np.argwhere(refused)[0]
            raise ValueError(
                f"{call}: body {body} {quoted(self.bodies[body].label)} has the principal moments of inertia "
                f"{', '.join(f'{moment:.3g}' for moment in moments[world, body])} kg m^2, and the last exceeds the sum "
                "of the others, which no rigid body has; correct its inertia, or accept it with "
                "Body(..., any_inertia=True)"
            )

    def _refuse_crossed_limits(self, call: str, values: Mapping[str, np.ndarray]) -> None:
        """Raise ValueError if a lower limit is above the upper one."""
        lower, upper = np.broadcast_arrays(values["joint_limit_lower"], values["joint_limit_upper"])
        if (lower > upper).any():
            world, dof = np.argwhere(lower > upper)[0]
            raise ValueError(
                f"{call}: joint_limit_lower of dof {dof} {self.dof_labels[dof]!r} is {lower[world, dof]:g}, above "
                f"joint_limit_upper {upper[world, dof]:g}; expected lower <= upper; swap them"
            )

    def __repr__(self) -> str:
        return (
            f"Scene({self.body_count} bodies, {self.dof_count} dof, depth {self.tree.depth}, "
            f"{len(self.loops)} loops, {self.worlds} world(s))"
        )
