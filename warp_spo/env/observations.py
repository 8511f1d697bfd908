"""Observations: ready terms, each a function of a ``World`` that returns numbers; ``Observation``."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import shown
from ..trace.functions import clip, where
from .compile.fused_kernel import ROW_NUMBER
from .compile.returned import naming, numbers, one_number
from .compile.vectors import Vector, rotate, rotate_back, vector
from .validation import check_function, check_number, check_optional_span, check_steps, check_whole
from .world import World

Term = Callable[[World], Any]
PACKAGE = __name__.rpartition(".")[0]
MANY = 16  # rows from which they have threads of their own


class Each:
    """A term of many numbers that are computed alike: a function of a world and of a row of numbers, for each row.

    Equals ``lambda w: [function(w, row) for row in rows]``. With 16 rows or more, an observation of it that asks for
    neither bias, delay nor history has a kernel of its own, in which a thread works on a few rows of a world. The
    observations of its group are then views of rows that begin 32 numbers apart, or a multiple.

    Args:
        function: of a ``World`` and a row (k,), which returns one number. It may not keep anything with ``w.keep``.
        rows: numbers [row, k].
    """

    def __init__(self, function: Callable[[World, Any], Any], rows: Any):
        self.function = check_function("observations.Each", "function", function)
        self.rows = np.asarray(rows, dtype=np.float64)
        if self.rows.ndim != 2 or not len(self.rows):
            raise ValueError(
                f"observations.Each: rows has shape {self.rows.shape}; expected [row, number], one row or more"
            )

    def __call__(self, w: World) -> Vector:
        """Return the numbers of all rows."""
        return vector(
            one_number("observations.Each: the function returned", self.function(w, row)) for row in self.rows
        )

    def of_own_row(self, w: World, number: int) -> Any:
        """Return the number of a row of the thread, in a stage in which a world has threads for its rows."""
        return self.function(w, w.table(f"rows {w.number(self)}", self.rows)(w.read(ROW_NUMBER, number + 1)[number]))


@dataclasses.dataclass(frozen=True, eq=False)
class Observation:
    """A term with what is done to its numbers: bias and noise are added, the sum is scaled and clipped, then it waits.

    Groups that list the same observation see the same numbers.

    Args:
        term: function of a ``World`` that returns a number or an array of numbers.
        scale: factor.
        noise: largest size of a uniform random number, new at each step.
        clip: (lowest, highest).
        bias: largest size of a uniform random number that a world draws once and keeps.
        delay: steps by which the numbers are late, or (fewest, most), of which a world draws one for good. In the first
            steps of an episode they are those of its start.
        history: how many steps are seen, the newest first.
    """

    term: Term
    scale: float = 1.0
    noise: float = 0.0
    clip: tuple[float, float] | None = None
    bias: float = 0.0
    delay: int | tuple[int, int] = 0
    history: int = 1

    def __post_init__(self) -> None:
        call = "Observation"
        check_function(call, "term", self.term)
        check_number(call, "scale", self.scale)
        for name in ("noise", "bias"):
            check_number(call, name, getattr(self, name), 0.0)
        check_optional_span(call, "clip", self.clip)
        check_steps(call, "delay", self.delay)
        check_whole(call, "history", self.history, 1)

    def trace(self, w: World, admit: Callable[[Vector], Vector] = lambda values: values) -> Vector:
        """Return the numbers; ``admit`` returns of what is measured what may be seen and remembered."""
        if self not in w.measured:
            w.measured[self] = self._measure(w)
        values = admit(w.measured[self])
        least, most = check_steps("Observation", "delay", self.delay)
        if self.history + most == 1:
            return values
        seen = self._remember(w, values, self.history + most)
        if most == 0:
            return vector(x for row in seen for x in row)
        late: Any = (
            w.drawn(f"delay {w.number(self)}", 1, lambda s: [s.integer(least, most)])[0] if least < most else most
        )
        chosen = seen[least : least + self.history]
        for delay in range(least + 1, most + 1):
            later = seen[delay : delay + self.history]
            chosen = [
                vector(where(late > delay - 0.5, a, b) for a, b in zip(*rows, strict=True))
                for rows in zip(later, chosen, strict=True)
            ]
        return vector(x for row in chosen for x in row)

    def _measure(self, w: World) -> Vector:
        """Return the numbers with bias and noise, scaled and clipped.

        An observation that stands in several groups is measured once in a step: they see the same noise.
        """
        with naming(f"the observation {place_of(self)}"):
            values = numbers(f"the observation {place_of(self)} returned", self.term(w))
        if self.bias > 0.0:
            values = values + w.drawn(
                f"bias {w.number(self)}", len(values), lambda s: [s.uniform(-self.bias, self.bias) for _ in values]
            )
        return vector(self._measurement(w, x) for x in values)

    def truth(self) -> Observation:
        """Return the observation without noise, bias and delay, as a critic sees it; scale, clip and history stay."""
        return dataclasses.replace(self, noise=0.0, bias=0.0, delay=0)

    @property
    def rows(self) -> int:
        """How many rows of :class:`Each` threads of their own work on; 0: the thread of all terms does."""
        plain = self.bias == 0.0 and self.history == 1 and check_steps("Observation", "delay", self.delay) == (0, 0)
        return len(self.term.rows) if isinstance(self.term, Each) and plain and len(self.term.rows) >= MANY else 0

    def trace_row(self, w: World, number: int) -> Any:
        """Return the number of a row of the thread."""
        if (self, number) in w.measured:
            return w.measured[self, number]
        with naming(f"the observation {place_of(self)}"):
            returned = self.term.of_own_row(w, number)  # type: ignore[attr-defined]
            found = one_number(f"the observation {place_of(self)} returned for a row", returned)
        value = w.measured[self, number] = self._measurement(w, found)
        if w.kept:
            function = self.term.function  # type: ignore[attr-defined]
            kept = ", ".join(map(shown, w.kept))
            raise ValueError(f"observations.Each: {function} keeps {kept}; expected nothing")
        return value

    def _measurement(self, w: World, x: Any) -> Any:
        """Return a number with noise, scaled and clipped."""
        x = x + w.uniform(-self.noise, self.noise) if self.noise > 0.0 else x
        x = self.scale * x
        return x if self.clip is None else clip(x, *self.clip)

    def _remember(self, w: World, values: Vector, count: int) -> list[Vector]:
        """Return the numbers of ``count`` steps, the newest first, and keep them; in several groups, once."""
        size, name = len(values), f"history {w.number(self)}"
        if name in w.measured:
            return w.measured[name]
        old = w.memory(name, (count - 1) * size)
        if w.fresh is not None:
            old = vector(where(w.fresh, values[i % size], x) for i, x in enumerate(old))
            w.keep_own(name, [*values, *old][: (count - 1) * size])
        w.measured[name] = [values, *(old[i : i + size] for i in range(0, len(old), size))]
        return w.measured[name]


class TorchTerm:
    """A term written in torch: a reward, a termination or an observation.

    It runs after the dynamics, an observation after resets, and is captured in the step's graph. If it waits for the
    device, as ``.item()``, ``nonzero`` and branches on tensors do, it runs between graphs, with a warning that names
    it. In a graph, Python runs once: what the function does beside tensors is not repeated.

    Args:
        function: of the ``Env``, which returns a tensor [world] or [world, size] of real numbers, of any dtype. It must
            not change the environment. It is called under ``torch.no_grad``.
        size: how many numbers it returns for each world.
        name: in errors and warnings; None: the function's.
    """

    def __init__(self, function: Callable[[Any], Any], size: int = 1, name: str | None = None):
        self.function = check_function("TorchTerm", "function", function)
        self.size = check_whole("TorchTerm", "size", size, 1)
        self.name = name or getattr(function, "__name__", type(function).__name__)

    def __call__(self, w: World) -> Any:
        """Return its numbers; of one number, as a termination, whether it is not zero."""
        return w.user(self)


def name_of(observation: Observation) -> str:
    """Return the name of a term in words: of its function, or of the one that made it; "unnamed" for a lambda."""
    term: Any = observation.term
    if isinstance(term, TorchTerm):
        return str(term.name)
    function = term.function if isinstance(term, Each) else term
    path = getattr(function, "__qualname__", type(function).__name__).split(".<locals>.")
    module, named = getattr(function, "__module__", ""), path[-1]
    if module == __name__ or (module.startswith(PACKAGE) and named == "term"):
        named = path[0]
    return "unnamed" if named == "<lambda>" else named.split(".")[-1].replace("_", " ")


def place_of(observation: Observation) -> str:
    """Return how errors name an observation: its name, and the file and line of its function if that has them."""
    term: Any = observation.term
    code = getattr(term.function if isinstance(term, Each) else term, "__code__", None)
    at = "" if code is None else f" ({Path(code.co_filename).name}, line {code.co_firstlineno})"
    return f"{shown(name_of(observation))!r}{at}"


def base_velocity(w: World) -> Vector:
    """Return the velocity of the origin of the base's frame, in its axes (3,) [m/s].

    The first three entries of a floating base's ``qd``, and of what :class:`warp_spo.mujoco.Coordinates` returns, are
    the velocity of its centre of mass, in inertial axes.
    """
    return w.base_velocity


def base_angular_velocity(w: World) -> Vector:
    """Return the angular velocity of the base in its axes (3,) [rad/s]."""
    return w.base_angular_velocity


def projected_gravity(w: World) -> Vector:
    """Return the unit vector along gravity in the base's axes (3,)."""
    return w.projected_gravity


def command(w: World) -> Vector:
    """Return the commands."""
    return w.command


def last_action(w: World) -> Vector:
    """Return the actions of the step that has just passed."""
    return w.action


def joint_position(names: Any = None, biased: bool = True) -> Term:
    """Return the term of joints' coordinates less the default [rad or m]; as encoders read them if ``biased``."""
    return lambda w: (w.encoder_q(names) if biased else w.joint_q(names)) - w.joint_default(names)


def joint_velocity(names: Any = None) -> Term:
    """Return the term of joints' velocities [rad/s or m/s]."""
    return lambda w: w.joint_qd(names)


def frame_position(frame: Any) -> Term:
    """Return the term of a frame's position, inertial axes (3,) [m]."""
    return lambda w: w.frame(frame).position


def feet_air_time(bodies: Any) -> Term:
    """Return the term of the bodies' air times [s]."""
    return lambda w: w.feet(bodies).air_time


def feet_contact(bodies: Any, force: float = 1.0) -> Term:
    """Return the term that is 1 for each of the bodies that touches the ground with more than ``force`` [N], else 0."""
    return lambda w: vector(where(touches, 1.0, 0.0) for touches in w.feet(bodies, force).touches)


def feet_force(bodies: Any) -> Term:
    """Return the term of the ground's forces on the bodies, inertial axes (3 each) [N]."""
    return lambda w: [x for force in w.feet(bodies).force for x in force]


def feet_height(bodies: Any) -> Term:
    """Return the term of the distances of the bodies' lowest points from the ground [m]."""
    return lambda w: vector(w.feet(bodies).gap)


def height_scan(size: tuple[float, float] = (1.6, 1.0), cell: float = 0.1, offset: float = 0.0) -> Term:
    """Return the term of the base's height over the ground less ``offset`` [m], on a grid that turns with its heading.

    Args:
        size: of the grid along the heading and across [m]; its middle is under the base. cell: between points [m].
    """
    along, across = (np.linspace(-0.5 * each, 0.5 * each, round(each / cell) + 1) for each in size)

    def height(w: World, point: Any) -> Any:
        x, y, z = w.base_position
        forward = rotate(w.base_quaternion, np.array([1.0, 0.0, 0.0]))
        norm = 1.0 / np.sqrt(forward[0] ** 2 + forward[1] ** 2)
        c, s = forward[0] * norm, forward[1] * norm
        a, b = point
        return z - offset - w.ground_height(x + c * a - s * b, y + s * a + c * b)

    return Each(height, [(a, b) for a in along for b in across])


def accelerometer(frame: Any) -> Term:
    """Return the term of the acceleration that a sensor in a frame feels, in its axes (3,) [m/s^2]; 9.81 up at rest."""
    return lambda w: w.imu(frame).acceleration


def gyro(frame: Any) -> Term:
    """Return the term of a frame's angular velocity in its axes (3,) [rad/s]."""
    return lambda w: rotate_back(w.frame(frame).quaternion, w.frame(frame).angular_velocity)
