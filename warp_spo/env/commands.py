"""Commands: what the policy is asked to do, drawn anew from time to time."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from ..errors import shown
from ..trace.functions import Condition, clip, where
from .compile.vectors import Vector, vector
from .curricula import Curriculum
from .validation import Range, check_interval, check_number, check_optional_span, check_span
from .world import World

COMMAND, HELD = "command", "command held"  # names under which a world remembers its command, and 1 where it is held
LEVEL = "command level"  # name under which a world remembers by how much its share has grown


@dataclasses.dataclass(frozen=True, eq=False)
class Level:
    """A curriculum: a world's share of the commands' ranges, which grows with a reward.

    Args:
        reward: name of the reward. share: of its largest sum, above which the level grows at the end of an episode.
        first: level at the start. step: by which it grows, to 1.
    """

    reward: str
    share: float = 0.8
    first: float = 0.3
    step: float = 0.05

    def __post_init__(self) -> None:
        for name in ("share", "first", "step"):
            check_number("commands.Level", name, getattr(self, name), 0.0)

    def update(self, w: World, done: Condition | None) -> Any:
        """Return the level, after an episode if ``done``."""
        if LEVEL in w.kept:
            return self.first + w.kept[LEVEL][0]
        if self.reward not in w.weights:
            raise ValueError(
                f"commands.Level: no reward {self.reward!r}; expected one of {', '.join(map(shown, w.weights))}"
            )
        if isinstance(w.weights[self.reward], Curriculum):
            raise ValueError(
                f"commands.Level: the weight of reward {self.reward!r} is a curriculum; expected a reward with a "
                "number for its weight"
            )
        level = self.first + w.memory(LEVEL, 1, reset=None)[0]
        if done is None:
            return level
        most = abs(w.weights[self.reward]) * w.steps_taken * w.dt
        up = done & (w.memory(f"sum reward {self.reward}", 1)[0] > self.share * most)
        grown = level + where(up, self.step, 0.0)
        grown = where(grown < 1.0, grown, 1.0)
        w.keep(LEVEL, [grown - self.first])
        return grown


@dataclasses.dataclass(frozen=True, eq=False)
class Velocity:
    """Velocity of the base in its own axes: forward, to the left [m/s], and rate of turning [rad/s].

    Args:
        forward, left, turn: ranges of uniform numbers, or curricula of them.
        heading: None, or the range of a direction [rad] that replaces ``turn``: the rate of turning is then
            ``gain`` times what is missing, within the range ``turn``.
        gain: [1/s].
        standing: share of commands that are zero.
        still: commands slower than this are zero [m/s].
        seconds: range of the time until the next command.
        level: None, or a curriculum over the ranges; ``env.memory("command level")`` [world, 1] says by how much shares
            have grown.
    """

    forward: Range = (-1.0, 1.0)
    left: Range = (-1.0, 1.0)
    turn: Range = (-1.0, 1.0)
    heading: Range | None = None
    gain: float = 0.5
    standing: float = 0.0
    still: float = 0.0
    seconds: Range = (10.0, 10.0)
    level: Level | None = None

    def __post_init__(self) -> None:
        call = "commands.Velocity"
        for name in ("forward", "left", "turn"):
            check_span(call, name, getattr(self, name))
        check_optional_span(call, "heading", self.heading)
        for name in ("gain", "standing", "still"):
            check_number(call, name, getattr(self, name), 0.0)
        check_interval(call, self.seconds)

    @property
    def size(self) -> int:
        """How many numbers a command has."""
        return 3

    @property
    def ranges_by_name(self) -> dict[str, Range]:
        """The range of each number, by name with its unit."""
        return {"forward [m/s]": self.forward, "left [m/s]": self.left, "turn [rad/s]": self.turn}

    def draw(self, w: World, done: Condition | None) -> dict[str, Vector]:
        """Return a new command, and what belongs to it, by the name of the memory.

        ``done`` says whether an episode has just ended; None: none has.
        """
        stands = w.uniform() < self.standing
        values = [w.uniform(*self.forward), w.uniform(*self.left), w.uniform(*self.turn)]
        if self.level is not None:
            values = [self.level.update(w, done) * x for x in values]
        if self.still > 0.0:
            slow = np.hypot(values[0], values[1]) < self.still
            values[:2] = [where(slow, 0.0, x) for x in values[:2]]
        found = {COMMAND: vector(where(stands, 0.0, x) for x in values)}
        if self.heading is not None:
            found["command heading"] = vector([w.uniform(*self.heading), where(stands, 0.0, 1.0)])
        return found

    def update(self, w: World, command: Vector) -> Vector:
        """Return the command of this step."""
        if self.heading is None:
            return command
        heading, moves = w.memory("command heading", 2, reset=None)
        missing = heading - w.heading
        missing = np.arctan2(np.sin(missing), np.cos(missing))
        return vector([command[0], command[1], moves * clip(self.gain * missing, *map(w.at_level, self.turn))])


@dataclasses.dataclass(frozen=True, eq=False)
class Uniform:
    """Numbers, each uniform in its range, such as the place that a hand is to reach.

    Args:
        ranges: one for each number; curricula of ranges, too.
        seconds: range of the time until the next command.
    """

    ranges: tuple[Range, ...]
    seconds: Range = (4.0, 4.0)

    def __post_init__(self) -> None:
        for i, each in enumerate(self.ranges):
            check_span("commands.Uniform", f"ranges[{i}]", each)
        check_interval("commands.Uniform", self.seconds)

    @property
    def size(self) -> int:
        """How many numbers a command has."""
        return len(self.ranges)

    @property
    def ranges_by_name(self) -> dict[str, Range]:
        """The range of each number, by its place."""
        return {f"command {i}": each for i, each in enumerate(self.ranges)}

    def draw(self, w: World, done: Condition | None) -> dict[str, Vector]:
        """Return a new command, by the name of the memory."""
        return {COMMAND: vector(w.uniform(*each) for each in self.ranges)}

    def update(self, w: World, command: Vector) -> Vector:
        """Return the command of this step."""
        return command
