"""Custom: a pose that is the user's own function of one to six scalar coordinates, whose rates are qd.

With the pose (p, R) of the child anchor in the parent anchor, the columns of H*, in the link's axes, are

    omega_i = vee(R* dR/dq_i),  v_i = R* dp/dq_i,

and the acceleration at qdd = 0 relative to a parent at rest is (d omega_i/dt qd_i; R* d2p/dt2). All of it comes from
the trace of the function, differentiated; so do the derivatives of the dynamics.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import Any, NamedTuple

import numpy as np

from ..trace.differentiation import forward
from ..trace.functions import AbstractScalar
from ..trace.scalars import Entry, Graph, Value, cut, is_constant
from ..trace.spatial import ZERO, Matrix, Pose, Twist, Vector, dot
from .hinge_type import Carrier, HingeType, LinkPlacement
from .quaternions import Quaternion, matrix_quaternion, multiply

MOST = 6
SAMPLES = 64  # configurations at which a rotation is checked
ORTHONORMAL = 1e-9  # largest entry of R* R - 1 that rounding and the user's constants may leave
RANGE = (-1.0, 1.0)  # where a coordinate without limits is sampled


class CustomPose(NamedTuple):
    """A custom hinge at a configuration.

    Attributes:
        x: its coordinates. rotation: R. slopes: dp/dq_i. columns: (omega_i; v_i).
    """

    x: list[Value]
    rotation: Matrix
    slopes: list[Vector]
    columns: list[Twist]


class Custom(HingeType):
    """A hinge whose pose is ``pose(q)``, for ``coordinates`` abstract scalars."""

    name = "custom"
    columns_vary = True

    def __init__(self, call: str, pose: Callable[[list], Any], coordinates: int):
        self.call, self.pose = call, pose
        self.dofs = self.coordinates = coordinates

    @property
    def shape(self) -> Hashable:
        return self.name, self.pose

    # -- position --------------------------------------------------------------------------------------------------
    def evaluate(self, x: list[Any]) -> tuple[Vector, Matrix]:
        """Return p and R for coordinates that are numbers or traced.

        Raises:
            ValueError: the pose is none.
            TypeError: the function does what an abstract scalar cannot do.
        """
        try:
            found = self.pose([AbstractScalar(value) if not is_constant(value) else value for value in x])
        except Exception as error:
            kind = TypeError if isinstance(error, TypeError | AttributeError) else ValueError
            raise kind(f"{self.call}: pose raised {type(error).__name__}: {error}") from error
        wrong = f"{self.call}: pose returned {found!r}; expected (position (3,), rotation (3, 3))"
        try:
            position, rotation = found
            entries = [_numbers(position), *(_numbers(row) for row in rotation)]
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"{self.call}: pose returned {found!r}; expected (position (3,), rotation (3, 3))"
            ) from error
        if len(entries) != 4 or any(len(row) != 3 for row in entries):
            raise ValueError(wrong)
        return entries[0], Matrix(entries[1:])

    def _shape(self, x: list[Value]) -> tuple[Vector, CustomPose]:
        position, R = self.evaluate(x)
        slopes, columns = [], []
        for i in range(self.dofs):
            changes = forward([*position, *(entry for row in R for entry in row)], x, _unit(i, self.dofs))
            slope, turned = Vector(changes[:3]), Matrix.of([changes[3:6], changes[6:9], changes[9:]])
            a, b = R.T, turned.T
            slopes.append(slope)
            columns.append((Vector((dot(a[2], b[1]), dot(a[0], b[2]), dot(a[1], b[0]))), a @ slope))
        return position, CustomPose(x, R, slopes, columns)

    def transform(self, link: Carrier, q: Entry) -> LinkPlacement:
        x = [cut(q(link.coordinate + i)) for i in range(self.coordinates)]
        position, shape = self._shape(x)
        if link.matrix is None:
            return LinkPlacement(Pose(None, shape.rotation, link.offset + position), None, shape)
        pose = Pose(None, link.matrix @ shape.rotation, link.offset + link.matrix @ position)
        return LinkPlacement(pose, None, shape)

    def relative_quaternion(self, link: Carrier, q: Entry) -> Quaternion:
        place = self.transform(link, q)
        return multiply(self.quaternion_at_rest(link), matrix_quaternion(place.own.rotation))

    # -- velocity, force, acceleration -----------------------------------------------------------------------------
    def velocity(self, place: LinkPlacement, rates: list[Value]) -> Twist:
        return _along(place.own.columns, rates)

    def forces(self, place: LinkPlacement, w: Vector, v: Vector) -> list[Value]:
        return [dot(w_i, w) + dot(v_i, v) for w_i, v_i in place.own.columns]

    def own_bias(self, place: LinkPlacement, rates: list[Value]) -> Twist:
        own: CustomPose = place.own
        spin, _ = _along(own.columns, rates)
        velocity = sum((slope * rate for slope, rate in zip(own.slopes, rates, strict=True)), ZERO)
        moving = [rate for rate in rates if not is_constant(rate)]
        changes = forward([*spin, *velocity], [*own.x, *moving], [*rates, *[0.0] * len(moving)])
        return Vector(changes[:3]), own.rotation.T @ Vector(changes[3:])

    def own_changes(
        self, place: LinkPlacement, rates: list[Value], accelerations: list[Value]
    ) -> list[tuple[Twist, Twist]]:
        own: CustomPose = place.own
        bias = self.own_bias(place, rates)
        velocity, acceleration = _along(own.columns, rates), _along(own.columns, accelerations)
        outputs = [*velocity[0], *velocity[1], *(acceleration[0] + bias[0]), *(acceleration[1] + bias[1])]
        still = [x for x in (*rates, *accelerations) if not is_constant(x)]
        found = []
        for i in range(self.dofs):
            changes = forward(outputs, [*own.x, *still], [*_unit(i, self.dofs), *[0.0] * len(still)])
            parts = [Vector(changes[at : at + 3]) for at in range(0, 12, 3)]
            found.append(((parts[0], parts[1]), (parts[2], parts[3])))
        return found

    def own_bias_changes(self, place: LinkPlacement, rates: list[Value]) -> list[Twist]:
        bias, found = [x for part in self.own_bias(place, rates) for x in part], []
        for rate in rates:
            changes = [0.0] * 6 if is_constant(rate) else forward(bias, [rate], [1.0])
            found.append((Vector(changes[:3]), Vector(changes[3:])))
        return found

    def column_changes(self, place: LinkPlacement) -> list[list[Twist]]:
        own: CustomPose = place.own
        outputs = [x for w, v in own.columns for x in (*w, *v)]
        found = []
        for i in range(self.dofs):
            changes = forward(outputs, own.x, _unit(i, self.dofs))
            found.append(
                [(Vector(changes[at : at + 3]), Vector(changes[at + 3 : at + 6])) for at in range(0, len(changes), 6)]
            )
        return found


def check_custom_pose(call: str, pose: Any, coordinates: Any, low: np.ndarray, high: np.ndarray) -> Custom:
    """Return the hinge, after tracing its pose once and looking at its rotation at some configurations.

    Args:
        low, high: limits of each coordinate; where they are not finite or do not rise, RANGE is looked at.

    Raises:
        ValueError: no function, not 1 to 6 coordinates, or a rotation that is not orthonormal and proper.
        TypeError: the function does what an abstract scalar cannot do.
    """
    if not callable(pose):
        raise ValueError(f"{call}: pose is {pose!r}; expected a function of q that returns (position, rotation)")
    kind, graph = Custom(call, pose, coordinates), Graph()
    kind._shape([graph.input("q", i) for i in range(coordinates)])
    bounded = np.isfinite(low) & np.isfinite(high) & (low < high)
    low, high = np.where(bounded, low, RANGE[0]), np.where(bounded, high, RANGE[1])
    for q in np.random.default_rng(0).uniform(low, high, (SAMPLES, coordinates)):
        with np.errstate(all="ignore"):
            position, rotation = (np.array(x, dtype=np.float64) for x in kind.evaluate(list(q)))
        error = np.abs(rotation.T @ rotation - np.eye(3)).max()
        if not (np.isfinite(position).all() and error < ORTHONORMAL and np.linalg.det(rotation) > 0.0):
            raise ValueError(
                f"{call}: at q = {q.tolist()} the pose is {position.tolist()}, {rotation.tolist()}; expected finite "
                f"numbers and a rotation, R.T R = 1 within {ORTHONORMAL:.0e} and det R = 1; limit_lower= and "
                f"limit_upper= say where the coordinates go, which is otherwise {RANGE[0]:g} to {RANGE[1]:g}"
            )
    return kind


def _numbers(row: Any) -> Vector:
    return Vector(x.value if isinstance(x, AbstractScalar) else float(x) for x in row)


def _unit(i: int, count: int) -> list[Value]:
    return [1.0 if j == i else 0.0 for j in range(count)]


def _along(columns: list[Twist], rates: list[Value]) -> Twist:
    w, v = ZERO, ZERO
    for (w_i, v_i), rate in zip(columns, rates, strict=True):
        w, v = w + w_i * rate, v + v_i * rate
    return w, v
