"""The stages of an environment's step, traced: start, act, judge, observe; reset and final on request.

start: what is drawn once. act: actions -> controls. judge: the state after the step -> rewards, ends of episodes, new
starts, commands, events. observe: the state that the next actions see -> observations. reset: new starts of chosen
worlds alone. final: observations of the state after the step, before new starts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ..hinges.functions import AbstractScalar, Condition, where
from ..trace.scalars import Value, absolute, less
from .events import EncoderBias, Interval, Reset, Start, Values
from .layout import Layout
from .observations import Observation
from .stage import Stage, output_name
from .vectors import Vector, as_condition, as_value, vector
from .world import World

LARGEST = 1e30  # numbers beyond it count as not finite
CAUSES = ("action", "state", "reward")  # of ends for numbers that are not finite, the first first
NOT_FINITE = "not finite"
CHOSEN_WORLD = "chosen.data[world]"  # C++: the world has just started anew


def is_finite(values: Any) -> Condition:
    """Return whether all numbers are finite, and their sizes add up to less than 1e30."""
    total: Value = 0.0
    for x in values:
        total = total + absolute(x.value if isinstance(x, AbstractScalar) else float(x))
    return Condition(less(total, LARGEST))


class Tracing:
    """The traced stages.

    Attributes:
        stages: by name. group_sizes: the values of each group of observations. ends: names of terminations.
    """

    def __init__(
        self,
        layout: Layout,
        actions: list,
        groups: dict[str, list[Observation]],
        rewards: dict[str, tuple[float, Any]],
        terminations: dict[str, Any],
        commands: Any,
        events: list,
    ):
        self.layout, self.actions, self.groups = layout, actions, groups
        layout.weights = {name: weight for name, (weight, _) in rewards.items()}
        self.rewards, self.terminations, self.commands, self.events = rewards, terminations, commands, events
        for event in events:
            if not isinstance(event, Reset | Interval | Values | Start):
                raise TypeError(f"Env: events holds {event!r}; expected those of warp_spo.env.events")
            if isinstance(event, EncoderBias):
                layout.biased = World(layout, Stage("none", 0)).joints(event.names)
        self.ends = [*terminations, NOT_FINITE]
        names = ("act", "judge", "observe", "reset", "start", "final")
        self.stages = {name: Stage(name, stream) for stream, name in enumerate(names)}
        self.group_sizes: dict[str, list] = {}

    @property
    def arrays(self) -> set[str]:
        """Names of the arrays that the stages read."""
        return set().union(*(stage.read_arrays() for stage in self.stages.values()))

    def run(self, steps: int, final: bool) -> None:
        """Trace all stages; ``steps`` are those of an episode; ``final`` asks for the stage of that name."""
        self._act()
        self._judge(steps)
        self._observe()
        if final:
            self._final()
        self._close()
        self._reset()
        self._first()

    # -- act -------------------------------------------------------------------------------------------------------
    def _act(self) -> None:
        stage = self.stages["act"]
        w = self.act = World(self.layout, stage)
        count = self.layout.action_count
        given = w.read("actions", count)
        finite = is_finite(given)
        action = vector(where(finite, x, 0.0) for x in given)
        w.keep("action 2", w.memory("action 1", count))
        w.keep("action 1", w.memory("action", count))
        w.keep("action", action)
        bad = w.memory("bad action", 1, reset=None)[0]
        w.keep("bad action", [bad + where(finite, 0.0, 1.0)])
        w.memory("spoilt", 1)
        w.keep("spoilt", [where(finite, 0.0, 1.0)])
        at = 0
        for part in self.actions:
            size = len(part.labels(w.scene))
            for entry, value in part.trace(w, action[at : at + size]):
                stage.store(part.array, entry, as_value(value))
            at += size

    # -- judge -----------------------------------------------------------------------------------------------------
    def _judge(self, steps: int) -> None:
        stage = self.stages["judge"]
        w = self.judge = World(self.layout, stage)
        length = w.read("episode_length", 1)[0] + 1.0
        w.__dict__["time"] = length * self.layout.step_dt
        spoilt = w.memory("spoilt", 1)[0] > 0.5
        sane = is_finite([*w.q, *w.qd])
        total: Any = 0.0
        for name, (weight, term) in self.rewards.items():
            value = weight * self.layout.step_dt * scalar(f"reward {name!r}", term(w))
            total = total + value
            earned = where(is_finite([value]), value, 0.0)
            w.keep(f"sum reward {name}", w.memory(f"sum reward {name}", 1) + earned)
        fine = is_finite([total])
        bad = ~sane | spoilt | ~fine
        self._count(w, "state", ~sane & ~spoilt)
        self._count(w, "reward", sane & ~fine)
        ends = {name: as_condition(term(w)) for name, term in self.terminations.items()} | {NOT_FINITE: bad}
        terminated = ends[NOT_FINITE]
        for name in self.terminations:
            terminated = terminated | ends[name]
        late = length >= float(steps)
        self.done = done = terminated | late
        stage.store(output_name("reward"), 0, as_value(where(bad, 0.0, total)))
        stage.store(output_name("done"), 0, as_value(where(done, 1.0, 0.0)))
        stage.store(output_name("time_out"), 0, as_value(where(late & ~terminated, 1.0, 0.0)))
        stage.store("chosen", 0, as_value(where(done, 1.0, 0.0)))
        stage.store("episode_length", 0, as_value(where(done, 0.0, length)))
        w.keep("episodes", w.memory("episodes", 1, reset=None) + where(done, 1.0, 0.0))
        self._remember_last(w, done, "seconds", w.time)
        for name in self.rewards:
            self._remember_last(w, done, f"reward {name}", w.kept[f"sum reward {name}"][0])
        for name in self.ends:
            self._remember_last(w, done, f"end {name}", where(ends[name], 1.0, 0.0))
        self._start(w, done, intervals=True)

    def _count(self, w: World, cause: str, holds: Condition) -> None:
        w.keep(f"bad {cause}", w.memory(f"bad {cause}", 1, reset=None) + where(holds, 1.0, 0.0))

    def _remember_last(self, w: World, done: Condition, name: str, value: Any) -> None:
        w.keep(f"last {name}", [where(done, value, w.memory(f"last {name}", 1, reset=None)[0])])

    def _start(self, w: World, done: Condition, intervals: bool) -> None:
        """Start worlds anew where ``done`` holds; let events happen and draw commands in the others."""
        stage = w._stage
        fresh = World(self.layout, stage)
        fresh.before = w if intervals else None
        fresh.__dict__["q"] = vector(float(x) for x in self.layout.default_q)
        fresh.__dict__["qd"] = vector(0.0 for _ in range(w.scene.dof_count))
        for event in self.events:
            if isinstance(event, Reset):
                event.change(fresh)
        q, qd = w.q.copy(), w.qd.copy()
        for number, event in enumerate(each for each in self.events if isinstance(each, Interval)):
            left = w.memory(f"until event {number}", 1, reset=None)[0] - self.layout.step_dt
            if intervals:
                changed = World(self.layout, stage)
                changed.__dict__.update(q=q.copy(), qd=qd.copy())
                event.change(changed)
                due = left <= 0.0
                q = vector(where(due, a, b) for a, b in zip(changed.q, q, strict=True))
                qd = vector(where(due, a, b) for a, b in zip(changed.qd, qd, strict=True))
                self._merge(w, changed, due)
                left = where(due | done, w.uniform(*event.seconds), left)
            else:
                left = where(done, w.uniform(*event.seconds), left + self.layout.step_dt)
            w.keep(f"until event {number}", [left])
        q = vector(where(done, a, b) for a, b in zip(fresh.q, q, strict=True))
        qd = vector(where(done, a, b) for a, b in zip(fresh.qd, qd, strict=True))
        for name, values in (("q", q), ("qd", qd)):
            for i, value in enumerate(values):
                stage.store(name, i, as_value(value))
        self._merge(w, fresh, done)
        self._draw_values(w, done, intervals)
        if self.commands is not None:
            self._command(w, done, q, qd, intervals)

    def _merge(self, w: World, changed: World, due: Condition) -> None:
        """Keep what an event kept in ``changed``, where ``due`` holds."""
        for name, values in changed.kept.items():
            old = w.kept.get(name, w.remembered(name))
            w.keep(name, [where(due, a, b) for a, b in zip(values, old, strict=True)])

    def _command(self, w: World, done: Condition, q: Vector, qd: Vector, intervals: bool) -> None:
        left = w.memory("until command", 1, reset=None)[0]
        due = done | (left <= self.layout.step_dt) if intervals else done
        passed = self.layout.step_dt if intervals else 0.0
        for name, values in self.commands.draw(w, done if intervals else None).items():
            old = w.memory(name, len(values), reset=None)
            w.keep(name, [where(due, a, b) for a, b in zip(values, old, strict=True)])
        w.keep("until command", [where(due, w.uniform(*self.commands.seconds), left - passed)])
        later = World(self.layout, w._stage)
        later.__dict__.update(q=q, qd=qd)
        later.kept = w.kept
        given, updated = w.kept["command"], self.commands.update(later, w.kept["command"])
        w.keep("command", updated if intervals else [where(done, a, b) for a, b in zip(updated, given, strict=True)])

    # -- values ----------------------------------------------------------------------------------------------------
    def _draw_values(self, w: World, done: Condition, intervals: bool) -> None:
        """Draw values of the scene anew, at resets and from time to time."""
        for number, event in enumerate(each for each in self.events if isinstance(each, Values)):
            if event.when == "reset":
                self._store_values(w, event, done)
            elif not isinstance(event.when, str) and intervals:
                left = w.memory(f"until values {number}", 1, reset=None)[0] - self.layout.step_dt
                due = left <= 0.0
                self._store_values(w, event, due)
                w.keep(f"until values {number}", [where(due, w.uniform(*event.when), left)])

    def _store_values(self, w: World, event: Values, due: Condition | None) -> None:
        """Store what an event makes of values where ``due`` holds; None: everywhere."""
        drawn = World(self.layout, w._stage)
        drawn.values = {name: w.scene.values[name][0].astype(object) for name in event.names}
        event.change(drawn)
        for name in event.names:
            own = w.scene.values[name][0].ravel()
            for i, value in enumerate(drawn.values[name].ravel()):
                if isinstance(value, AbstractScalar) or value != own[i]:
                    array = f"value_{name}"
                    if any(item.array == array and item.index == (i,) for item in w._stage.stores):
                        raise ValueError(f"Env: two events change entry {i} of {name}; expected one")
                    old = w._scalar(array, i) if due is not None else 0.0
                    w._stage.store(array, i, as_value(value if due is None else where(due, value, old)))

    def _first(self) -> None:
        """Draw what is drawn once: values of the scene, and memory."""
        stage = self.stages["start"]
        stage.ticks = "true"
        w = World(self.layout, stage)
        for event in self.events:
            if isinstance(event, Values):
                self._store_values(w, event, None)
            if isinstance(event, Start):
                event.change(w)
            if isinstance(event, Reset) and event.first is not None:
                event.first(w)
        for name, draw in self.layout.drawn.items():
            w.keep(name, draw(w))
        for name, values in w.kept.items():
            self._keep(w, name, values)

    # -- observe ---------------------------------------------------------------------------------------------------
    def _observe(self) -> None:
        stage = self.stages["observe"]
        stage.ticks = f"advance.data[0] > 0 || {CHOSEN_WORLD}"
        chosen = Condition(stage.graph.input("chosen", 0))
        w = self.observed = World(self.layout, stage, fresh=chosen)
        for group, terms in self.groups.items():
            values = [x for term in terms for x in term.trace(w)]
            self.group_sizes[group] = values
            for i, value in enumerate(values):
                stage.store(output_name(group), i, as_value(value))

    def _final(self) -> None:
        """Observe the state in which an episode ends, before worlds start anew."""
        w = World(self.layout, self.stages["final"])
        w.__dict__["time"] = (w.read("episode_length", 1)[0] + 1.0) * self.layout.step_dt
        for group, terms in self.groups.items():
            for i, value in enumerate(x for term in terms for x in term.trace(w)):
                w._stage.store(output_name(f"final {group}"), i, as_value(value))

    # -- memory ----------------------------------------------------------------------------------------------------
    def _close(self) -> None:
        """Store what each stage keeps; what a reset clears is cleared by the stage that resets."""
        for name, values in self.act.kept.items():
            self._keep(self.act, name, values)
        if self.observed.kept:  # a look at worlds that go on, after a reset of others, is not a step of theirs
            goes = (self.observed.read("advance", 1)[0] > 0.5) | self.observed.fresh
            for name, values in self.observed.kept.items():
                old = self.observed.remembered(name)
                self._keep(self.observed, name, vector(where(goes, a, b) for a, b in zip(values, old, strict=True)))
        for name, (_, _, update) in self.layout.sensors.items():
            if name not in self.judge.kept:
                update(self.judge)
        for name, (_, size, reset) in list(self.layout.memory.items()):
            values = self.judge.memory(name, size, reset)
            if reset is not None:
                values = vector(where(self.done, reset, x) for x in values)
            if reset is not None or name in self.judge.kept:
                self._keep(self.judge, name, values)

    def _keep(self, w: World, name: str, values: Vector) -> None:
        start = self.layout.memory[name][0]
        for i, value in enumerate(values):
            w._stage.store("memory", start + i, as_value(value))

    # -- reset on request ------------------------------------------------------------------------------------------
    def _reset(self) -> None:
        stage = self.stages["reset"]
        chosen = Condition(stage.graph.input("chosen", 0))
        stage.ticks = CHOSEN_WORLD
        w = World(self.layout, stage)
        self._start(w, chosen, intervals=False)
        stage.store("episode_length", 0, as_value(where(chosen, 0.0, w.read("episode_length", 1)[0])))
        for name, (_, size, reset) in self.layout.memory.items():
            if name in w.kept or reset is not None:
                values = w.memory(name, size, reset)
                if reset is not None:
                    values = vector(where(chosen, reset, x) for x in values)
                self._keep(w, name, values)


def scalar(what: str, x: Any) -> Any:
    """Return what a term returned, if it is one number."""
    if isinstance(x, np.ndarray) and x.size == 1:
        x = x.ravel()[0]
    if isinstance(x, Condition):
        return where(x, 1.0, 0.0)
    if not isinstance(x, AbstractScalar | int | float | np.floating):
        raise TypeError(f"Env: {what} returned {type(x).__name__}; expected one number")
    return x
