"""The stages of an environment's step, traced: start, act, judge, observe; reset and final on request.

start: what is drawn once. act: actions -> controls. judge: the state after the step -> rewards, ends of episodes, new
starts, commands, events. observe: the state that the next actions see -> observations. reset: new starts of chosen
worlds alone. final: observations of the state after the step, before new starts.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...trace.functions import AbstractScalar, Condition, where
from ...trace.scalars import Value, absolute, branch, less
from ..events import EncoderBias, Interval, Reset, Start, Values
from ..observations import Observation, name_of
from ..world import World
from .fused_kernel import FusedKernel
from .memory_layout import MemoryLayout
from .returned import checked_event, commands_drawn, condition, controls, one_number
from .vectors import Vector, as_value, vector

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
        stages: by name; those of rows have the name of the one that they belong to. group_sizes: how many numbers each
            group of observations has. ends: names of terminations. apart: names of observations that several kernels
            write.
    """

    def __init__(
        self,
        layout: MemoryLayout,
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
                if layout.biased:
                    raise ValueError(
                        "Env: events has two encoder_bias; expected one, whose names= are several expressions"
                    )
                layout.biased = World(layout, FusedKernel("none", 0)).joints(event.names)
        self.events = [checked_event(event, i) for i, event in enumerate(events)]
        self.ends = [*terminations, NOT_FINITE]
        names = ("act", "judge", "observe", "reset", "start", "final")
        self.stages = {name: FusedKernel(name, stream) for stream, name in enumerate(names)}
        self.group_sizes: dict[str, int] = {}
        self.term_sizes: dict[str, list[int]] = {}  # of each group's terms, in their order
        self.apart: set[str] = set()

    @property
    def arrays(self) -> set[str]:
        """Names of the arrays that the stages read."""
        return set().union(*(stage.read_arrays() for stage in self.stages.values()))

    @property
    def observation_terms(self) -> dict[str, list[tuple[str, int, Observation]]]:
        """Name, size and Observation of each term of each group."""
        return {
            group: list(zip(map(name_of, terms), self.term_sizes[group], terms, strict=True))
            for group, terms in self.groups.items()
        }

    @property
    def tables(self) -> set[str]:
        """Names of the tables that the stages read."""
        return set().union(*(stage.read_tables() for stage in self.stages.values()))

    @property
    def in_turn(self) -> set[str]:
        """Names of stages whose kernels run one after the other, because one overwrites what another one reads."""
        pairs = ((stage, self.stages[stage.name]) for stage in self.stages.values() if stage.rows)
        return {of_rows.name for of_rows, main in pairs if main.overwrites(of_rows)}

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
            for entry, value in controls(part, w, action[at : at + size], self.layout.control_sizes):
                if any(item.array == part.array and item.index == (entry,) for item in stage.stores):
                    raise ValueError(f"Env: two actions set entry {entry} of {part.array}; expected one")
                stage.store(part.array, entry, as_value(value))
            at += size

    # -- judge -----------------------------------------------------------------------------------------------------
    def _judge(self, steps: int) -> None:
        stage = self.stages["judge"]
        stage.ticks = "1u"  # before observations, whose kernels run side by side
        w = self.judge = World(self.layout, stage)
        length = w.read("episode_length", 1)[0] + 1.0
        w.__dict__["time"] = length * self.layout.step_dt
        spoilt = w.memory("spoilt", 1)[0] > 0.5
        sane = is_finite([*w.q, *w.qd])
        total: Any = 0.0
        for name, (weight, term) in self.rewards.items():
            value = weight * self.layout.step_dt * one_number(f"reward {name!r} returned", term(w))
            total = total + value
            earned = where(is_finite([value]), value, 0.0)
            w.keep(f"sum reward {name}", w.memory(f"sum reward {name}", 1) + earned)
        fine = is_finite([total])
        bad = ~sane | spoilt | ~fine
        self._count(w, "state", ~sane & ~spoilt)
        self._count(w, "reward", sane & ~fine)
        ends = {
            name: condition(f"termination {name!r} returned", term(w)) for name, term in self.terminations.items()
        } | {NOT_FINITE: bad}
        terminated = ends[NOT_FINITE]
        for name in self.terminations:
            terminated = terminated | ends[name]
        late = length >= float(steps)
        self.done = done = terminated | late
        stage.store(self.layout.output("reward"), 0, as_value(where(bad, 0.0, total)))
        stage.store(self.layout.output("done"), 0, as_value(where(done, 1.0, 0.0)))
        stage.store(self.layout.output("time_out"), 0, as_value(where(late & ~terminated, 1.0, 0.0)))
        stage.store("chosen", 0, as_value(where(done, 1.0, 0.0)))
        stage.store("episode_length", 0, as_value(where(done, 0.0, length)))
        found = {"seconds": w.time, **{f"reward {name}": w.kept[f"sum reward {name}"][0] for name in self.rewards}}
        found |= {f"end {name}": where(ends[name], 1.0, 0.0) for name in self.ends}
        finished = [(f"last {name}", value) for name, value in found.items()]
        finished.append(("episodes", w.memory("episodes", 1, reset=None)[0] + 1.0))
        olds = [w.memory(name, 1, reset=None)[0] for name, _ in finished]
        news = choose(done, [value for _, value in finished], olds, "end")
        for (name, _), value in zip(finished, news, strict=True):
            w.keep(name, [value])
        self._start(w, done, intervals=True)

    def _count(self, w: World, cause: str, holds: Condition) -> None:
        old = w.memory(f"bad {cause}", 1, reset=None)
        w.keep(f"bad {cause}", choose(holds, old + 1.0, old, f"bad {cause}"))

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
            name, due = f"until event {number}", done
            left = w.memory(name, 1, reset=None)[0]
            if intervals:
                left = left - self.layout.step_dt
                changed = World(self.layout, stage)
                changed.__dict__.update(q=q.copy(), qd=qd.copy())
                event.change(changed)
                q, qd = self._merge(w, q, qd, changed, left <= 0.0, f"event {number}")
                due = done | (left <= 0.0)
            w.keep(name, choose(due, [w.uniform(*event.seconds)], [left], name))
        q, qd = self._merge(w, q, qd, fresh, done, "start")
        for name, values in (("q", q), ("qd", qd)):
            for i, value in enumerate(values):
                stage.store(name, i, as_value(value))
        self._draw_values(w, done, intervals)
        if self.commands is not None:
            self._command(w, done, q, qd, intervals)

    def _merge(
        self, w: World, q: Vector, qd: Vector, changed: World, due: Condition, name: str
    ) -> tuple[Vector, Vector]:
        """Return the state after an event, which is that of ``changed`` where ``due`` holds, and keep what it kept."""
        olds = [w.kept.get(each, w.stored_memory(each)) for each in changed.kept]
        news = np.concatenate([changed.q, changed.qd, *changed.kept.values()])
        found = choose(due, news, np.concatenate([q, qd, *olds]), name)
        sizes = [len(q), len(qd), *map(len, olds)]
        q, qd, *kept = np.split(found, np.cumsum(sizes)[:-1])
        for each, values in zip(changed.kept, kept, strict=True):
            w.keep(each, values)
        return q, qd

    def _command(self, w: World, done: Condition, q: Vector, qd: Vector, intervals: bool) -> None:
        left = w.memory("until command", 1, reset=None)[0]
        due = done | (left <= self.layout.step_dt) if intervals else done
        passed = self.layout.step_dt if intervals else 0.0
        drawn = commands_drawn(self.commands, w, done if intervals else None)
        olds = [w.memory(name, len(values), reset=None) for name, values in drawn.items()]
        news: list[Any] = [*drawn.values(), [w.uniform(*self.commands.seconds)]]
        found = choose(due, np.concatenate(news), np.concatenate([*olds, [left - passed]]), "command")
        for name, values in zip(drawn, np.split(found, np.cumsum([*map(len, olds)])), strict=False):
            w.keep(name, values)
        w.keep("until command", found[-1:])
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
                new = w.uniform(*event.when)
                w.keep(f"until values {number}", choose(due, [new], [left], f"until values {number}"))

    def _store_values(self, w: World, event: Values, due: Condition | None) -> None:
        """Store what an event makes of values where ``due`` holds; None: everywhere."""
        drawn = World(self.layout, w._stage)
        drawn.values = {name: w.scene.values[name][0].astype(object) for name in event.names}
        event.change(drawn)
        entries: list[tuple[str, int]] = []
        news: Any = []
        for name in event.names:
            own = w.scene.values[name][0].ravel()
            for i, value in enumerate(drawn.values[name].ravel()):
                if isinstance(value, AbstractScalar) or value != own[i]:
                    if any(item.array == f"value_{name}" and item.index == (i,) for item in w._stage.stores):
                        raise ValueError(f"Env: two events change entry {i} of {name}; expected one")
                    entries.append((f"value_{name}", i))
                    news.append(value)
        if due is not None:
            news = choose(due, news, [w._scalar(*entry) for entry in entries], f"values {id(event)}")
        for entry, value in zip(entries, news, strict=True):
            w._stage.store(*entry, as_value(value))

    def _first(self) -> None:
        """Draw what is drawn once: values of the scene, and memory."""
        stage = self.stages["start"]
        stage.ticks = "1u"
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

        def begin(one: FusedKernel) -> World:
            one.late = f"advance.data[0] > 0 || {CHOSEN_WORLD} ? 1u : 0u"
            return World(self.layout, one, fresh=Condition(one.graph.input("chosen", 0)))

        self.observed = begin(stage)
        self._observe_groups(self.observed, begin, "")

    def _final(self) -> None:
        """Observe the state in which an episode ends, before worlds start anew."""

        def begin(stage: FusedKernel) -> World:
            w = World(self.layout, stage)
            w.__dict__["time"] = (w.read("episode_length", 1)[0] + 1.0) * self.layout.step_dt
            return w

        self._observe_groups(begin(self.stages["final"]), begin, "final ")

    def _observe_groups(self, w: World, begin: Callable[[FusedKernel], World], kind: str) -> None:
        """Store the observations of all groups: of ``w``, or of the rows of a world that ``begin`` makes of a stage."""
        of_rows: dict[int, World] = {}
        for group, terms in self.groups.items():
            name, at, starts = self.layout.output(kind + group), 0, [0]
            for term in terms:
                rows = term.rows
                if rows:
                    self.apart.add(kind + group)
                    if rows not in of_rows:
                        stage = FusedKernel(w._stage.name, len(self.stages), rows)
                        self.stages[f"{w._stage.name}, {rows} rows"] = stage
                        of_rows[rows] = begin(stage)
                    one, stage = of_rows[rows], of_rows[rows]._stage
                    for number in range(stage.at_once):
                        stage.store_row(name, at, number, as_value(term.trace_row(one, number)))
                    at += rows
                else:
                    for value in term.trace(w):
                        w._stage.store(name, at, as_value(value))
                        at += 1
                starts.append(at)
            if not at:
                raise ValueError(f"Env: the terms of observations[{group!r}] returned no numbers; expected one or more")
            self.group_sizes[group], self.term_sizes[group] = at, np.diff(starts).tolist()

    # -- memory ----------------------------------------------------------------------------------------------------
    def _close(self) -> None:
        """Store what each stage keeps; what a reset clears is cleared by the stage that resets."""
        for name, values in self.act.kept.items():
            self._keep(self.act, name, values)
        if self.observed.kept:  # a look at worlds that go on, after a reset of others, is not a step of theirs
            goes = (self.observed.read("advance", 1)[0] > 0.5) | self.observed.fresh
            for name, values in self.observed.kept.items():
                old = self.observed.stored_memory(name)
                self._keep(self.observed, name, vector(where(goes, a, b) for a, b in zip(values, old, strict=True)))
        for name, (_, _, update) in self.layout.sensors.items():
            if name not in self.judge.kept:
                update(self.judge)
        self._clear(self.judge, self.done)

    def _clear(self, w: World, done: Condition) -> None:
        """Store the memory that a stage keeps; where ``done`` holds, memory with a reset value takes that value."""
        every = list(self.layout.memory.items())
        names = [name for name, (_, _, reset) in every if reset is not None]
        olds = [w.memory(name, size, reset) for name, (_, size, reset) in every if reset is not None]
        resets = [reset for _, size, reset in self.layout.memory.values() if reset is not None for _ in range(size)]
        found = choose(done, resets, [x for values in olds for x in values], "cleared")
        kept = w.kept | dict(zip(names, np.split(found, np.cumsum([*map(len, olds)])), strict=False))
        for name, _ in every:
            if name in kept:
                self._keep(w, name, kept[name])

    def _keep(self, w: World, name: str, values: Vector) -> None:
        start = self.layout.memory[name][0]
        for i, value in enumerate(values):
            w._stage.store("memory", start + i, as_value(value))

    # -- reset on request ------------------------------------------------------------------------------------------
    def _reset(self) -> None:
        """Trace the stage "reset": the chosen worlds start anew, with episode length 0 and memory as after a reset."""
        stage = self.stages["reset"]
        chosen = Condition(stage.graph.input("chosen", 0))
        # Two steps of random numbers: one for this stage, one for the observations that follow and count none.
        stage.ticks = f"{CHOSEN_WORLD} ? 2u : 0u"
        w = World(self.layout, stage)
        self._start(w, chosen, intervals=False)
        stage.store("episode_length", 0, as_value(where(chosen, 0.0, w.read("episode_length", 1)[0])))
        self._clear(w, chosen)


def choose(due: Condition, news: Any, olds: Any, name: str) -> Vector:
    """Return new values where ``due`` holds, else old ones; what only new ones need is computed only there.

    ``name`` tells the choices of one condition from each other.
    """
    pairs = [(as_value(a), as_value(b)) for a, b in zip(news, olds, strict=True)]
    return vector(AbstractScalar(branch(due.value, a, b, name)) for a, b in pairs)
