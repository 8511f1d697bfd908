"""Actions in task space: the pose of a frame, brought about by joints: ``DifferentialIK``."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..errors import shown
from ..scene.scene import Scene
from ..trace.functions import clip, where
from .actions import Control, Position, spread
from .compile.vectors import Vector, multiply, vector
from .validation import check_number, check_optional_span
from .world import World

AXES = ("x", "y", "z", "turn x", "turn y", "turn z")
ABSOLUTE = ("x", "y", "z", "qx", "qy", "qz", "qw")


@dataclasses.dataclass(frozen=True, eq=False)
class DifferentialIK:
    """Pose of a frame, inertial axes, for which joints get position targets by damped least squares.

    With the frame's Jacobian J of the joints and its missing pose e the targets are
    q + d + J^T (J J^T + damping^2 I)^-1 (e - J d), where d = rest (default_q - q) moves what the frame leaves free
    (Wampler 1986, "Manipulator inverse kinematic solutions based on vector formulations and damped least-squares
    methods"). They are worked out once in a step of the environment.

    Args:
        frame: name of a site or body, a body, or (body, pose in the body).
        through: how the joints get their targets: ``actions.Control`` for position servos, which gives the
            hinges' coordinates as controls, or ``actions.Position`` for drives. Its scale and offset do not count.
        kind: "position", three numbers, or "pose".
        relative: the numbers are what is missing, times ``scale``: a translation [m], and for a pose a rotation vector
            [rad]. Otherwise they are where the frame shall be, ``offset`` plus ``scale`` times the number: a position,
            and for a pose a quaternion xyzw of any length.
        scale, offset: one number, or one for each action.
        damping: [m, or m and rad].
        rest: share of the way to ``default_q`` that joints go in a step where the frame leaves them free, 0 to 1.
        clip: (lowest, highest) action.

    Raises:
        ValueError: an argument is none; or, when the environment is made, a joint has no servo, or a servo of another
            kind.
    """

    frame: Any
    through: Control | Position = dataclasses.field(default_factory=Control)
    kind: str = "position"
    relative: bool = True
    scale: Any = 0.1
    offset: Any = 0.0
    damping: float = 0.05
    rest: float = 0.0
    clip: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        call = "DifferentialIK"
        object.__setattr__(self, "clip", check_optional_span(call, "clip", self.clip))
        if self.kind not in ("position", "pose"):
            raise ValueError(f"{call}: kind is {self.kind!r}; expected 'position' or 'pose'")
        if not isinstance(self.through, Control | Position) or self.through.array == "tau":
            raise TypeError(f"{call}: through is {self.through!r}; expected actions.Control or actions.Position")
        if check_number(call, "damping", self.damping, 0.0) == 0.0:
            raise ValueError(
                f"{call}: damping is 0, which has no solution where J loses a row; expected more than zero"
            )
        check_number(call, "rest", self.rest, 0.0, 1.0)
        if not isinstance(self.relative, bool):
            raise ValueError(f"{call}: relative is {self.relative!r}; expected True or False")

    @property
    def array(self) -> str:
        """The array that the actions set."""
        return self.through.array

    def labels(self, scene: Scene) -> list[str]:
        """Return the names of the actions."""
        names = AXES if self.relative else ABSOLUTE
        frame = self.frame if isinstance(self.frame, str) else "frame"
        return [f"{frame} {axis}" for axis in (names[:3] if self.kind == "position" else names)]

    def entries(self, scene: Scene) -> list[int]:
        """Return which entries of the array the actions set."""
        return self.through.entries(scene)

    def trace(self, w: World, action: Vector) -> list[tuple[int, Any]]:
        """Return (entry, value) of what the actions set."""
        through, hinges = self.through, self.through.hinges(w.scene)
        self._check(w, hinges)
        q = vector(w.q[int(w.scene.q_start[hinge])] for hinge in hinges)
        found = q + self._joint_steps(w, hinges, q, action)
        values = through.gears(w) * (found - w.encoder_bias(hinges))
        return list(zip(through.entries(w.scene), values, strict=True))

    # -- inside ----------------------------------------------------------------------------------------------------
    def _check(self, w: World, hinges: list[int]) -> None:
        """Raise ValueError unless each hinge has one coordinate, and a servo that takes it for its control."""
        wide = [w.scene.joint_labels[i] for i in hinges if w.scene.hinges[i].coord_count != 1]
        if isinstance(self.through, Control):
            gains, bias = (w.scene.values[f"actuator_{name}"][0] for name in ("gain", "bias"))
            for hinge, entry in zip(hinges, self.through.entries(w.scene), strict=True):
                if not (gains[entry] > 0.0 and np.isclose(bias[entry, 1], -gains[entry])):
                    wide.append(w.scene.joint_labels[hinge])
        if wide:
            raise ValueError(
                f"DifferentialIK: {', '.join(map(shown, wide))} follow no position of one coordinate; expected joints "
                "with position servos (through=actions.Control(...)) or drives (through=actions.Position(...))"
            )

    def _joint_steps(self, w: World, hinges: list[int], q: Vector, action: Vector) -> Vector:
        """Return target - coordinate of each joint; the file's class has the formula."""
        dofs = [int(w.scene.qd_start[hinge]) for hinge in hinges]
        error = self._pose_error(w, action)
        J = w.jacobian(self.frame)[: len(error)][:, dofs]  # a position has the rows of the velocity, which come first
        default = w.default_q[[int(w.scene.q_start[hinge]) for hinge in hinges]]
        null_space_step = self.rest * (default - q) if self.rest else vector(0.0 for _ in q)
        if self.rest:
            error = error - J @ null_space_step
        A = J @ J.T
        for i in range(len(error)):
            A[i, i] = A[i, i] + self.damping**2
        return null_space_step + J.T @ solve_positive(A, error)

    def _pose_error(self, w: World, action: Vector) -> Vector:
        """Return what the frame lacks: a translation [m], then for a pose a rotation vector [rad], inertial axes."""
        labels = self.labels(w.scene)
        scale, offset = (spread("DifferentialIK", name, getattr(self, name), labels) for name in ("scale", "offset"))
        limited = action if self.clip is None else [clip(x, *self.clip) for x in action]
        numbers = vector(float(s) * x for s, x in zip(scale, limited, strict=True))
        if self.relative:
            return numbers
        wanted, frame = numbers + offset, w.frame(self.frame)
        translation = wanted[:3] - frame.position
        if self.kind == "position":
            return translation
        x, y, z, s = frame.quaternion
        turn = multiply(wanted[3:], vector([-x, -y, -z, s]))
        turn = vector(where(turn[3] < 0.0, -each, each) for each in turn)  # the shorter way
        sine = np.sqrt(sum(each * each for each in turn[:3]) + 1e-20)
        angle = 2.0 * np.arctan2(sine, turn[3])
        return np.concatenate([translation, turn[:3] * (angle / sine)])


def solve_positive(A: Any, b: Vector) -> Vector:
    """Return A^-1 b for a symmetric, positive definite A [n, n] of abstract scalars, by Cholesky's factors."""
    n = len(b)
    L = np.empty((n, n), dtype=object)
    y, x = vector(b), vector(b)
    for j in range(n):
        L[j, j] = np.sqrt(A[j, j] - sum((L[j, k] * L[j, k] for k in range(j)), 0.0))
        for i in range(j + 1, n):
            L[i, j] = (A[i, j] - sum((L[i, k] * L[j, k] for k in range(j)), 0.0)) / L[j, j]
        y[j] = (b[j] - sum((L[j, k] * y[k] for k in range(j)), 0.0)) / L[j, j]
    for j in reversed(range(n)):
        x[j] = (y[j] - sum((L[k, j] * x[k] for k in range(j + 1, n)), 0.0)) / L[j, j]
    return x
