"""Geared motors: rotors, and the spring between a motor and the body that it moves in a flexible hinge."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..errors import UnsupportedError
from .checks import SYMMETRY, checked_array, checked_inertia, checked_unit, read_only
from .pickling import StoredPart

MODELS = ("full", "reduced", "reflected")


@dataclasses.dataclass(frozen=True, eq=False)
class Rotor(StoredPart):
    """The rotor of a motor that drives a hinge through a gear.

    It rides on the hinge's parent body and turns against it by ``ratio`` times the hinge's coordinate, about a line
    through its own centre of mass. Its mass is symmetric about that line. Properties that are not given belong to the
    parent body: the rotor's mass sits there, too, unless ``inertia`` is a Body.

    Args:
        inertia: the rotor's moment of inertia about its axis [kg m^2]; or its inertia about its centre of mass in the
            axes of the hinge's parent anchor [kg m^2], shape (3, 3); or a :class:`Body` with mass, centre of mass and
            inertia in the frame of that anchor.
        ratio: turns of the rotor for each turn of the hinge; [rad/m] on a prismatic hinge. Negative if it turns the
            other way.
        axis: unit vector in the parent anchor's frame; None: the hinge's axis.
        model: how much of the rotor's motion counts.

            * "full", "reduced": all of it, exactly, and with the same results: the rotor is a link that shares the
              hinge's first degree of freedom. They differ in what a node is. "full" has the link and the whole rotor in
              it: in :meth:`Dynamics.operators` its vectors have 12 entries, the rotor's velocity before the body's.
              "reduced" puts the locked rotor into the parent's inertia, and keeps the moment about the axis alone:
              7 entries, the rotor's turn rate before the body's velocity; it takes less work, and needs no more than
              the usual 6 dimensions on the way from body to body. Scenes with such rotors run at tree granularity, and
              regressors and :meth:`Dynamics.body_reactions` refuse them.
            * "reflected": ``ratio**2`` J, J being the moment about the axis, is added to joint_armature, at every
              granularity. The rest of the rotor's motion is left out: nothing where the parent is the ground. Where the
              parent turns about the rotor's axis, or turns that axis, accelerations are wrong by a share of the largest
              of them: by about ``ratio`` J / D under forces at other hinges, and ``ratio`` J / A under a force at its
              own. D is the inertia that the hinge moves, ``ratio**2`` J included, A that of the parent and all it
              carries about the rotor's axis. An arm of two rods of 0.5 kg and 0.8 m, with parallel axes and J of 1e-4
              kg m^2, is wrong by 1.0 to 2.2 times ``ratio`` J / D, at most 1.8 %, under a force at the first hinge;
              under one at the geared hinge by 1 to 3 % for a ratio of 100, and by 12 to 25 % for 1000.

            Where no hinge moves the parent, only J counts; a given mass then is no part of the centre of mass.

    Raises:
        ValueError: a value is invalid; the message names it.
    """

    inertia: Any
    ratio: float
    axis: Any = None
    model: str = "full"

    def __post_init__(self) -> None:
        put = lambda name, value: object.__setattr__(self, name, value)  # noqa: E731
        if self.model not in MODELS:
            raise ValueError(f"Rotor: model is {self.model!r}; expected one of {', '.join(MODELS)}")
        put("ratio", float(checked_array("Rotor", "ratio", self.ratio, ())))
        if self.axis is not None:
            axis = checked_array("Rotor", "axis", self.axis, (3,))
            put("axis", read_only(checked_unit("Rotor", "axis", axis)))
        if hasattr(self.inertia, "com"):
            if self.inertia.modes is not None or self.inertia.gravcomp:
                raise ValueError("Rotor: inertia is a Body with modes or gravcomp; expected a rigid one without")
        else:
            name, shape = "inertia [kg m^2]", () if np.ndim(self.inertia) == 0 else (3, 3)
            inertia = checked_array("Rotor", name, self.inertia, shape)
            if shape:
                inertia = read_only(checked_inertia("Rotor", inertia))
            elif inertia < 0.0:
                raise ValueError(f"Rotor: inertia is {inertia} kg m^2; expected zero or more")
            put("inertia", inertia if shape else float(inertia))
        if self.model == "reflected" and not isinstance(self.inertia, float):
            raise ValueError(
                "Rotor: model='reflected' knows the moment of inertia about the axis alone; expected that number as "
                "inertia; add the rotor's mass and other moments to the parent body"
            )

    @property
    def shares_dof(self) -> bool:
        """Whether the rotor moves as a link of its own, by the hinge's first degree of freedom."""
        return self.model != "reflected"

    @property
    def dimensions(self) -> int:
        """Entries of a node's vector that are the rotor's: its whole velocity, its turn rate, or none."""
        return {"full": 6, "reduced": 1, "reflected": 0}[self.model]

    @property
    def mass(self) -> float:
        """Mass that is not part of the parent body [kg]."""
        return float(getattr(self.inertia, "mass", 0.0))

    @property
    def com(self) -> np.ndarray:
        """Centre of mass in the frame of the hinge's parent anchor [m], shape (3,); the origin unless given."""
        return np.asarray(getattr(self.inertia, "com", np.zeros(3)))

    @property
    def matrix(self) -> np.ndarray:
        """Inertia about the centre of mass, in the axes of the parent anchor [kg m^2], shape (3, 3)."""
        if isinstance(self.inertia, float):
            return self.inertia * np.outer(self.axis, self.axis)
        return np.asarray(getattr(self.inertia, "inertia", self.inertia))

    @property
    def spin_inertia(self) -> float:
        """Moment of inertia about the axis [kg m^2]."""
        return float(self.axis @ self.matrix @ self.axis)


def resolve_rotor(call: str, rotor: Any, kind: str, driven: bool, screws: tuple) -> Rotor | None:
    """Return a hinge's rotor with its axis, the hinge's unless it has one of its own; None if there is no rotor.

    Args:
        driven: the hinge has one coordinate that a motor can turn.

    Raises:
        TypeError: ``rotor`` is something else.
        ValueError: the hinge has several degrees of freedom, or none, or the rotor is not symmetric about its axis.
    """
    if rotor is None:
        return None
    if not isinstance(rotor, Rotor):
        raise TypeError(f"{call}: rotor is of type {type(rotor).__name__}; expected a Rotor")
    if not driven:
        raise ValueError(
            f"{call}: rotor= belongs to a hinge of one degree of freedom; a {kind} hinge here has another number; "
            "leave rotor out, or make it a chain of hinges"
        )
    if rotor.axis is None:
        if not screws:
            raise ValueError(f"{call}: the rotor has no axis, nor has a {kind} hinge; expected Rotor(axis=)")
        rotor = dataclasses.replace(rotor, axis=screws[0][0])
    inertia = rotor.matrix
    round_one = 0.5 * (np.trace(inertia) - rotor.spin_inertia) * (np.eye(3) - np.outer(rotor.axis, rotor.axis))
    lopsided = inertia - round_one - rotor.spin_inertia * np.outer(rotor.axis, rotor.axis)
    if np.abs(lopsided).max() > SYMMETRY * np.abs(inertia).max():
        raise ValueError(
            f"{call}: the rotor's inertia {inertia.tolist()} is not symmetric about its axis {rotor.axis.tolist()}; "
            "expected equal moments about all lines across the axis, and no products with it"
        )
    return rotor


def checked_flexible(call: str, kind: str, screws: int, flexible: Any) -> tuple[float, float] | None:
    """Return stiffness and damping between motor and body as floats; None of a hinge that is not flexible.

    Args:
        screws: degrees of freedom of the hinge without its deflection.

    Raises:
        ValueError: not two numbers, or one is negative, or the hinge has not one degree of freedom.
        UnsupportedError: the hinge is custom.
    """
    if flexible is None:
        return None
    if kind == "custom":
        way = "give its function two coordinates, the motor's and the deflection, of which it takes the sum"
        raise UnsupportedError(call, "a flexible custom hinge (flexible=)", way)
    if screws != 1:
        have = f"{screws} axes" if screws else "no axis"
        raise ValueError(
            f"{call}: flexible= belongs to a hinge of one degree of freedom about or along an axis; a {kind} hinge "
            f"here has {have}; leave flexible out, or make it a chain of hinges"
        )
    stiffness, damping = checked_array(call, "flexible (stiffness, damping)", flexible, (2,)).tolist()
    if min(stiffness, damping) < 0.0:
        raise ValueError(
            f"{call}: flexible is {(stiffness, damping)}; expected a stiffness and a damping of zero or more"
        )
    return stiffness, damping


def motor_and_deflection(
    call: str, name: str, value: np.ndarray, none: float, flexible: tuple[float, float]
) -> np.ndarray:
    """Return a value of a flexible hinge's two dofs; a single number is the motor's, ``none`` then the deflection's.

    Raises:
        ValueError: two numbers are given, and the second contradicts ``flexible``.
    """
    law = {"stiffness": flexible[0], "damping": flexible[1]}
    if value.ndim == 0:
        return np.array([value, law.get(name, none)])
    if name in law and value[1] != law[name]:
        raise ValueError(
            f"{call}: {name} is {value.tolist()}, and flexible= says {law[name]} for the deflection; expected one "
            "number, the motor's"
        )
    return value
