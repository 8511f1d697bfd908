"""Curricula: numbers and ranges that change by the steps of a training, or as worlds succeed: ``Curriculum``.

They stand where a number or a range stands: as the weight of a reward, as a range of commands, and in events that draw
in each episode or from time to time.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import as_integer, shown
from ..trace.functions import Condition, clip, where

if TYPE_CHECKING:
    from .world import World

STEPS = "curriculum steps"  # name under which a world remembers its steps since the environment was made


@dataclasses.dataclass(frozen=True)
class ByStep:
    """A level that goes from 0 to 1 with the steps of the environment, in all worlds alike.

    Args:
        begin: steps at which it begins to grow. end: at which it is 1; None: at once, when it begins.
    """

    begin: int = 0
    end: int | None = None

    def __post_init__(self) -> None:
        begin, end = as_integer(self.begin), as_integer(self.begin if self.end is None else self.end)
        if begin is None or end is None or not 0 <= begin <= end:
            raise ValueError(
                f"curricula.ByStep: begin is {self.begin!r} and end {self.end!r}; expected integers, 0 or more, in "
                "order"
            )

    @property
    def name(self) -> str:
        """The name of the memory that it follows."""
        return STEPS

    def value(self, remembered: Any) -> Any:
        """Return the level for what a world remembers."""
        if self.end is None or self.end == self.begin:
            return where(remembered > self.begin - 0.5, 1.0, 0.0)
        return clip((remembered - float(self.begin)) * (1.0 / (self.end - self.begin)), 0.0, 1.0)

    def update(self, w: World, remembered: Any, ended: Condition) -> Any:
        """Return what a world remembers after a step."""
        return remembered + 1.0


@dataclasses.dataclass(frozen=True)
class BySuccess:
    """A level of each world that goes from 0 to 1 as its episodes succeed.

    At the end of an episode the mean of a term over the steps that it took counts, before the weight of a reward.
    Episodes that end for numbers that are not finite, or beyond bounds, do not count, nor do those in which a metric
    was finite in no step.

    Args:
        term: name of a metric, or of a reward whose weight is a number.
        above: mean above which the level grows. below: mean below which it falls; None: it does not fall.
        step: by which it grows and falls.
    """

    term: str
    above: float = 0.8
    below: float | None = None
    step: float = 0.05

    def __post_init__(self) -> None:
        from .validation import check_number  # which knows curricula

        below = self.above if self.below is None else self.below
        for name, value in (("above", self.above), ("below", below), ("step", self.step)):
            check_number("curricula.BySuccess", name, value)
        if below > self.above or not 0.0 < self.step <= 1.0:
            raise ValueError(
                f"curricula.BySuccess: below is {self.below!r}, above {self.above!r} and step {self.step!r}; expected "
                "below <= above, and a step above 0, 1 or less"
            )

    @property
    def name(self) -> str:
        """The name of the memory that it follows."""
        falls = "" if self.below is None else f" below {_digits(self.below)}"
        return f"curriculum {self.term} above {_digits(self.above)}{falls} by {_digits(self.step)}"

    def value(self, remembered: Any) -> Any:
        """Return the level for what a world remembers."""
        return remembered

    def update(self, w: World, remembered: Any, ended: Condition) -> Any:
        """Return what a world remembers after a step that may have ``ended`` an episode."""
        mean, known = w.episode_mean("curricula.BySuccess", self.term)
        ended = ended & known
        level = remembered + where(ended & (mean > self.above), self.step, 0.0)
        if self.below is not None:
            level = level - where(ended & (mean < self.below), self.step, 0.0)
        return clip(level, 0.0, 1.0)


@dataclasses.dataclass(frozen=True)
class Curriculum:
    """A number, or a range, that goes from ``first`` to ``last`` as a level goes from 0 to 1.

    Args:
        first, last: two numbers, or two ranges (lowest, highest).
        level: :class:`ByStep` or :class:`BySuccess`.
    """

    first: Any
    last: Any
    level: ByStep | BySuccess

    def __post_init__(self) -> None:
        if not isinstance(self.level, ByStep | BySuccess):
            raise TypeError(f"curricula.Curriculum: level is {self.level!r}; expected curricula.ByStep or BySuccess")
        shapes = {np.shape(self.first), np.shape(self.last)}
        if len(shapes) != 1 or not shapes < {(), (2,)}:
            raise ValueError(
                f"curricula.Curriculum: first is {self.first!r} and last {self.last!r}; expected two numbers, or two "
                "ranges (lowest, highest)"
            )

    def __iter__(self) -> Iterator[Curriculum]:
        """Return the two ends of a range, each a curriculum of a number."""
        return (Curriculum(*ends, self.level) for ends in zip(self.first, self.last, strict=True))

    def __neg__(self) -> Curriculum:
        """Return the curriculum of the number with the other sign."""
        return Curriculum(-self.first, -self.last, self.level)

    def value(self, level: Any) -> Any:
        """Return the number at a level."""
        return float(self.first) * (1.0 - level) + float(self.last) * level


def ends_of(value: Any) -> tuple[Any, ...]:
    """Return what a number, or a range, may be: first and last of a curriculum, itself otherwise."""
    return (value.first, value.last) if isinstance(value, Curriculum) else (value,)


def remembered_mean(call: str, w: World, term: str) -> tuple[Any, Condition]:
    """Return the mean of a metric or a reward, before its weight, over the steps of the episode so far.

    The second value says whether there is one: a metric that was finite in no step has none.
    """
    metric, reward = term in w._layout.metrics, term in w.weights
    if metric == reward:
        known = ", ".join(map(shown, [*w._layout.metrics, *w.weights])) or "none"
        kind = "a metric and a reward are named" if metric else "no metric or reward is named"
        raise ValueError(f"{call}: {kind} {term!r}; expected the name of one of them: {known}")
    if metric:
        return metric_mean(w, term)
    weight = w.weights[term]
    if isinstance(weight, Curriculum) or weight == 0.0:
        raise ValueError(
            f"{call}: the weight of reward {term!r} is {weight!r}; expected a reward with a number for its weight, not "
            "zero, or a metric"
        )
    taken = w.steps_taken
    seconds = where(taken > 0.5, taken, 1.0) * w.dt
    return w.memory(f"sum reward {term}", 1)[0] / (weight * seconds), taken > 0.5


def metric_mean(w: World, metric: str) -> tuple[Any, Condition]:
    """Return the mean of a metric over the steps of the episode in which it was finite, and whether there is one."""
    total, count = w.memory(f"sum metric {metric}", 1)[0], w.memory(f"steps of metric {metric}", 1)[0]
    return total / where(count > 0.5, count, 1.0), count > 0.5


def _digits(x: float) -> str:
    """Return a number in as few digits as tell it from others."""
    short = f"{x:g}"
    return short if float(short) == float(x) else repr(float(x))
