"""The layout that the stages of an environment share while they are traced: memory, frames, values, counts."""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np

from ...errors import shown
from ...scene.scene import Scene
from ..validation import check_number, check_whole
from .guard import Guard
from .vectors import find

ROUNDING = 1e-9  # share of a time in float64 that is its rounding
AGE = "actuator net steps"  # name under which a world with learned actuators remembers its steps since the start
TAKEN = "steps taken"  # name under which a world remembers how many steps its episode has had, whatever its age
NET_TARGETS = "net_targets"  # array of the positions that learned actuators are asked for [world, coordinate]
LEFT_OUT: Any = object()
"""In place of a value at a reset: zero, unless somebody says it."""


OWN = re.compile(
    r"action( [12])?|command( held)?|until command|until (event|values) \d+|(history|bias|delay) \d+|episodes|"
    r"last seconds|last end .*|(last |sum )reward .*|(last |sum |steps of |last steps of )metric .*|"
    rf"curriculum steps|curriculum .* above \S+ (below \S+ )?by \S+|{AGE}|{TAKEN}",
    re.DOTALL,
)
"""Names under which an environment itself remembers something."""


def is_own(name: Any) -> bool:
    """Return whether the environment itself remembers something under this name."""
    return isinstance(name, str) and OWN.fullmatch(name) is not None


def check_memory_name(call: str, name: Any) -> None:
    """Raise ValueError if a name of memory is one that the environment itself keeps; ``call`` is in the message."""
    if is_own(name):
        raise ValueError(
            f"{call}: {shown(name)!r} is a name under which the environment itself remembers something; expected "
            "another one"
        )


def as_steps(seconds: float, step: float) -> float:
    """Return a time [s] in steps of so many seconds, a whole number where it is one but for rounding."""
    steps = seconds / step
    return round(steps) if abs(steps - round(steps)) <= ROUNDING * max(1.0, steps) else steps


def count_steps(seconds: float, step: float) -> int:
    """Return how many whole steps a time [s] takes, rounded up, one or more."""
    return max(1, math.ceil(as_steps(seconds, step)))


class MemoryLayout:
    """The arrangement of an environment's arrays.

    Attributes:
        memory: (start, size, value at a reset) of what worlds remember, by name. frames: that terms ask for.
        jacobians: frames whose Jacobians they ask for.
        action_arrays: that actions set: "ctrl", "target_q", "tau", "net_targets". networks: joints of each learned
            actuator, and how many substeps it looks back. biased: hinges whose encoders have a bias.
        sensors: (size, value at a reset, function that keeps it) of memory that each step brings up to date, by name.
        users: (stage, start) of the numbers of each user's term in torch.
        drawn: functions that return memory that is drawn once, by name. observations: a number for each of those that
            remember something.
        tables: numbers that all worlds share, by their names in kernels. table_names: names that terms give them.
        weights: of rewards. metrics: terms by name.
        levels: of curricula, by the names of what they follow. judged: the world of the stage "judge", and whether its
            episode ended with numbers that count; None before it is known.
        values: names of the scene's values that events change. unequal: of those that stages read, and that differ
            between worlds of the scene itself.
        guard: what ends worlds whose numbers are out of bounds.
        keeps_failures: whether "judge" leaves what has ended a world in the array "fault".
        outputs: names under which kernels write results ("reward", a group of observations, ...), by result.
    """

    def __init__(
        self,
        scene: Scene,
        default_q: np.ndarray,
        step_dt: float,
        dt: float,
        commands: Any,
        values: tuple[str, ...],
        guard: Guard,
    ):
        self.scene, self.default_q, self.step_dt, self.dt = scene, default_q, step_dt, dt
        self.commands, self.values = commands, values
        self.guard = guard
        self.action_count = 0
        self.action_arrays: set[str] = set()
        self.networks: list[tuple[int, int]] = []
        self.biased: list[int] = []
        self.memory: dict[str, tuple[int, int, float | None]] = {}
        self.memory_size = 0
        self.unsaid: set[str] = set()  # names whose value at a reset nobody has said
        self.unequal: set[str] = set()
        self.frames: list[Any] = []
        self.jacobians: list[Any] = []
        self.drawn: dict[str, Any] = {}
        self.observations: dict[Any, int] = {}
        self.tables: dict[str, np.ndarray] = {}
        self.table_names: list[str] = []
        self.weights: dict[str, Any] = {}
        self.metrics: dict[str, Any] = {}
        self.levels: dict[str, Any] = {}
        self.judged: tuple[Any, Any] | None = None
        self.users: dict[Any, tuple[str, int]] = {}
        self.user_size = 0
        self.sensors: dict[str, tuple[int, float | None, Any]] = {}
        self.keeps_failures = False
        self.outputs: dict[str, str] = {}

    def remember(self, name: str, size: int, reset: Any = LEFT_OUT) -> int:
        """Return where ``size`` numbers of this name are in the memory.

        Stages that set what a reset changes are finished when all terms have said what they want.
        """
        if name not in self.memory:
            if not isinstance(name, str):
                raise TypeError(f"World.memory: name is {name!r}; expected a string")
            check_whole(f"World.memory({name!r})", "size", size, 0)
            self.memory[name] = self.memory_size, size, 0.0
            self.memory_size += size
            self.unsaid.add(name)
        start, count, value = self.memory[name]
        if reset is not LEFT_OUT and name in self.unsaid:
            if reset is not None:
                check_number(f"World.memory({name!r})", "reset", reset)
            self.unsaid.remove(name)
            self.memory[name] = start, count, value = start, count, reset
        if size != count or (reset is not LEFT_OUT and reset != value):
            asked = "" if reset is LEFT_OUT else f", set to {reset}"
            raise ValueError(
                f"World.memory: {name!r} has {count} numbers, which a reset sets to {value}; a term asks for "
                f"{size}{asked}; expected the same in all terms"
            )
        return start

    def whole_steps(self, seconds: float) -> float:
        """Return a time in steps of the environment, a whole number where it is one but for rounding."""
        return as_steps(seconds, self.step_dt)

    def update_level(self, name: str) -> Any:
        """Return what a world remembers of a level after the step that "judge" looks at, which keeps it."""
        w, ended = self.judged  # type: ignore[misc]
        if name not in w.kept:
            w.keep_own(name, [self.levels[name].update(w, w.memory(name, 1, reset=None)[0], ended)])
        return w.kept[name][0]

    def output(self, result: str) -> str:
        """Return the name under which kernels write a result: its number, so that no user's name reaches a compiler."""
        return self.outputs.setdefault(result, f"out_{len(self.outputs)}")

    def table(self, name: str, numbers: np.ndarray) -> str:
        """Return the name under which kernels read a table."""
        numbers = np.asarray(numbers, dtype=np.float64)
        held = next((f"table_{i}" for i, known in enumerate(self.table_names) if known == name), "")
        if not held:
            self.table_names.append(name)
            held = f"table_{len(self.table_names) - 1}"
        if not np.array_equal(self.tables.setdefault(held, numbers), numbers):
            raise ValueError(
                f"World.table: {name!r} is the name of two tables with different numbers; expected another"
            )
        return held

    def user(self, term: Any, stage: str) -> int:
        """Return where the numbers of a user's term in torch are that a stage reads."""
        place, start = self.users.setdefault(term, (stage, self.user_size))
        if place != stage:
            raise ValueError(
                f"Env: the term {term.name} is read by {place} and {stage}; expected two TorchTerm objects"
            )
        if start == self.user_size:
            self.user_size += term.size
        return start

    def frame(self, name: Any) -> int:
        """Return the number of a frame among those that terms ask for."""
        if isinstance(name, str) and name not in self.scene.sites:
            (name,) = find("Env", "site or body", self.scene.body_labels, name)[:1]
        if name not in self.frames:
            self.frames.append(name)
        return self.frames.index(name)

    def jacobian(self, name: Any) -> int:
        """Return the number of a frame among those whose Jacobians terms ask for."""
        frame = self.frames[self.frame(name)]
        if frame not in self.jacobians:
            self.jacobians.append(frame)
        return self.jacobians.index(frame)

    @property
    def control_sizes(self) -> dict[str, int]:
        """How many entries each array has that actions may set."""
        scene = self.scene
        targets = dict.fromkeys(("target_q", NET_TARGETS), scene.coord_count)
        return {"ctrl": len(scene.actuators), "tau": scene.dof_count, **targets}
