"""The stages of an environment's step, traced: start, act, judge, observe; reset and final on request.

start: what is drawn once. act: actions -> controls. judge: the state after the step -> rewards, ends of episodes, new
starts, commands, events. observe: the state that the next actions see -> observations. reset: new starts of chosen
worlds alone. final: observations of the state after the step, before new starts.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np

from ...errors import shown
from ...trace.functions import AbstractScalar, Condition, where
from ...trace.scalars import branch, floor, ordered
from ..bounds import term_causes
from ..commands import COMMAND, HELD
from ..curricula import metric_mean
from ..events import EncoderBias, Interval, Reset, Start, Values
from ..observations import Observation, name_of
from ..world import World
from . import starts
from .buffers import FAULT
from .fused_kernel import FusedKernel
from .guard import BEYOND, LARGEST, NOT_FINITE, Check, first, within
from .memory_layout import MemoryLayout, is_own
from .returned import (
    check_event,
    check_force,
    command_updated,
    commands_drawn,
    condition,
    controls,
    naming,
    one_number,
)
from .vectors import Vector, as_value, vector

CHOSEN_WORLD = "chosen.data[world]"  # C++: the world has just started anew


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
        metrics: dict[str, Any],
        commands: Any,
        events: list,
    ):
        self.layout, self.actions, self.groups, self.guard = layout, actions, groups, layout.guard
        layout.weights, layout.metrics = {name: weight for name, (weight, _) in rewards.items()}, metrics
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
        self.events = [check_event(event, i) for i, event in enumerate(events)]
        self.ends = [*terminations, NOT_FINITE, BEYOND]
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
        self.final = final
        self.guard.apart = [
            cause
            for group, terms in self.groups.items()
            for cause, term in zip(term_causes(group, terms), terms, strict=True)
            if term.rows
        ]
        self._act()
        self._judge(steps)
        self._observe()
        if final:
            self._final()
        for name, (_, _, update) in [*self.layout.sensors.items()]:
            if name not in self.judge.kept:
                update(self.judge)
                self.guard.hold(self.judge, [name], self.bad)
        self._first()
        for name in self.layout.levels:
            self.layout.update_level(name)
        self._close()
        self._reset()

    # -- act -------------------------------------------------------------------------------------------------------
    def _act(self) -> None:
        stage = self.stages["act"]
        w = self.act = World(self.layout, stage)
        count = self.layout.action_count
        given = w.read("actions", count)
        checks: list[Check] = []
        action = self.guard.admit("action", given, checks)
        w.keep_own("action 2", w.memory("action 1", count))
        w.keep_own("action 1", w.memory("action", count))
        w.keep_own("action", action)
        self.guard.leave(w, "actions", checks)
        at = 0
        forces: dict[int, Any] = {}  # what sets the force of each dof
        for part in self.actions:
            size = len(part.labels(w.scene))
            for entry, value in controls(part, w, action[at : at + size], self.layout.control_sizes):
                if any(item.array == part.array and item.index == (entry,) for item in stage.stores):
                    raise ValueError(f"Env: two actions set entry {entry} of {part.array}; expected one")
                check_force(part, entry, w.scene, forces)
                stage.store(part.array, entry, as_value(value))
            at += size

    # -- judge -----------------------------------------------------------------------------------------------------
    def _judge(self, steps: int) -> None:
        stage = self.stages["judge"]
        stage.ticks = "1u"  # before observations, whose kernels run side by side
        w = self.judge = World(self.layout, stage)
        length = w.read("episode_length", 1)[0] + 1.0
        w.__dict__["steps"] = length
        state = self.guard.check_state(w)
        checks = [*self.guard.read_observations(w, ""), self.guard.read(w, "actions"), *state]
        total: Any = 0.0
        earned = {}
        for name, (weight, term) in self.rewards.items():
            with naming(f"reward {name!r}"):
                earning = one_number(f"reward {name!r} returned", term(w))
            value = w.at_level(weight) * self.layout.step_dt * earning
            total = total + value
            checks.append(self.guard.check(f"reward/{name}", [value]))
            earned[name] = value
        fault = first([*checks, *(self.guard.read_observations(w, "final ") if self.final else ())], "fault")
        bad = fault > 0.5
        stage.store("faults", 0, as_value(fault))
        if self.layout.keeps_failures:
            stage.store(FAULT, 0, as_value(fault))
        for name, value in earned.items():
            w.keep_own(f"sum reward {name}", w.memory(f"sum reward {name}", 1) + where(bad, 0.0, value))
        ends = {}
        for name, term in self.terminations.items():
            with naming(f"termination {name!r}"):
                ends[name] = condition(f"termination {name!r} returned", term(w))
        ends |= self.guard.ends(fault)
        self.bad, self.ended = bad, self.guard.finite_end(w, state)
        measured = self._measure(w, bad)
        self.guard.hold(w, list(w.kept), bad)
        terminated = bad
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
        found |= measured
        finished = [(f"last {name}", value) for name, value in found.items()]
        finished.append(("episodes", w.memory("episodes", 1, reset=None)[0] + 1.0))
        olds = [w.memory(name, 1, reset=None)[0] for name, _ in finished]
        news = choose(done, [value for _, value in finished], olds, "end")
        for (name, _), value in zip(finished, news, strict=True):
            w.keep_own(name, [value])
        self.layout.judged = w, done & ~bad
        self.after = self._start(w, done, intervals=True)

    def _measure(self, w: World, bad: Condition) -> dict[str, Any]:
        """Add up the metrics of a step, and return their means over the episode and the steps behind them by name.

        Steps in which a metric is not finite do not count for it.
        """
        for name, term in self.layout.metrics.items():
            with naming(f"metric {name!r}"):
                value = one_number(f"metric {name!r} returned", term(w))
            counts = within([value], LARGEST) & ~bad
            for memory, more in ((f"sum metric {name}", value), (f"steps of metric {name}", 1.0)):
                w.keep_own(memory, w.memory(memory, 1) + where(counts, more, 0.0))
        found = {}
        for name in self.layout.metrics:
            found[f"metric {name}"], _ = metric_mean(w, name)
            found[f"steps of metric {name}"] = w.kept[f"steps of metric {name}"][0]
        return found

    def _start(self, w: World, done: Condition, intervals: bool) -> World:
        """Start worlds anew where ``done`` holds; let events happen and draw commands in the others.

        Returns:
            The world after the stage: its state, its values, and what it keeps.
        """
        stage = w._stage
        later = starts.StartWorld(self.layout, stage)
        later.kept = w.kept
        self._draw_values(w, done, later, at_reset=True)
        fresh = starts.StartWorld(self.layout, stage)
        fresh.before, fresh.lasting = self.ended if intervals else None, True
        fresh.present = dict(later.present)
        fresh.__dict__["steps"] = 0.0
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
                left = left - 1.0
                changed = World(self.layout, stage)
                changed.__dict__.update(q=q.copy(), qd=qd.copy(), steps=w.steps)
                event.change(changed)
                q, qd = self._merge(w, q, qd, changed, left < 0.5, f"event {number}")
                due = done | (left < 0.5)
            w.keep_own(name, choose(due, [self._wait(w, event.seconds)], [left], name))
        q, qd = self._merge(w, q, qd, fresh, done, "start")
        for name, values in (("q", q), ("qd", qd)):
            for i, value in enumerate(values):
                stage.store(name, i, as_value(value))
        if intervals:
            self._draw_values(w, done, later, at_reset=False)
        later.__dict__.update(q=q, qd=qd)
        if self.commands is not None:
            self._command(w, done, later, intervals)
        return later

    def _wait(self, w: World, seconds: Any) -> Any:
        """Return in how many steps something is due that comes after a time drawn in a range [s]: whole, 1 or more."""
        low, high = (max(1.0, self.layout.whole_steps(end)) for end in seconds)
        drawn = w.uniform(low, high)
        return -AbstractScalar(floor(as_value(-drawn)))

    def _merge(
        self, w: World, q: Vector, qd: Vector, changed: World, due: Condition, name: str
    ) -> tuple[Vector, Vector]:
        """Return the state after an event, which is that of ``changed`` where ``due`` holds, and keep what it kept."""
        olds = [w.kept.get(each, w.stored_memory(each)) for each in changed.kept]
        finite = [
            [where(within(values, LARGEST), a, b) for a, b in zip(values, old, strict=True)]
            for values, old in zip(changed.kept.values(), olds, strict=True)
        ]
        news = np.concatenate([changed.q, changed.qd, *finite])
        found = choose(due, news, np.concatenate([q, qd, *olds]), name)
        sizes = [len(q), len(qd), *map(len, olds)]
        q, qd, *kept = np.split(found, np.cumsum(sizes)[:-1])
        for each, values in zip(changed.kept, kept, strict=True):
            w.keep_own(each, values)
        return q, qd

    def _command(self, w: World, done: Condition, later: World, intervals: bool) -> None:
        left = w.memory("until command", 1, reset=None)[0]
        due = done | (left < 1.5) if intervals else done
        passed = 1.0 if intervals else 0.0
        later.starts = done, w
        drawn = commands_drawn(self.commands, later, done if intervals else None)
        olds = [w.memory(name, len(values), reset=None) for name, values in drawn.items()]
        news: list[Any] = [*drawn.values(), [self._wait(w, self.commands.seconds)]]
        found = choose(due, np.concatenate(news), np.concatenate([*olds, [left - passed]]), "command")
        for name, values in zip(drawn, np.split(found, np.cumsum([*map(len, olds)])), strict=False):
            w.keep_own(name, values)
        w.keep_own("until command", found[-1:])
        later.forgets = True
        given, updated = w.kept[COMMAND], command_updated(self.commands, later, w.kept[COMMAND])
        later.starts = None
        news = list(updated) if intervals else [where(done, a, b) for a, b in zip(updated, given, strict=True)]
        held, before = w.memory(HELD, len(given), reset=None), w.stored_memory(COMMAND)
        w.keep_own(COMMAND, [where(mark > 0.5, old, new) for mark, old, new in zip(held, before, news, strict=True)])

    # -- values ----------------------------------------------------------------------------------------------------
    def _draw_values(self, w: World, done: Condition, later: World, at_reset: bool) -> None:
        """Draw values of the scene anew, at resets or from time to time; ``later`` has them."""
        for number, event in enumerate(each for each in self.events if isinstance(each, Values)):
            if event.when == "reset" and at_reset:
                self._store_values(w, event, done, later)
            elif not isinstance(event.when, str) and not at_reset:
                name = f"until values {number}"
                left = w.memory(name, 1, reset=None)[0] - 1.0
                due = left < 0.5
                self._store_values(w, event, due, later)
                w.keep_own(name, choose(due, [self._wait(w, event.when)], [left], name))

    def _store_values(self, w: World, event: Values, due: Condition | None, later: World | None = None) -> None:
        """Store what an event makes of values where ``due`` holds; None: everywhere. ``later`` has what is stored."""
        drawn = World(self.layout, w._stage)
        drawn.values = {name: w.scene.values[name][0].astype(object) for name in event.names}
        event.change(drawn)
        if drawn.kept:
            raise ValueError(
                f"events.Values: {event.change} keeps {', '.join(map(shown, drawn.kept))}; expected changes of values "
                "alone; events.Start and events.Reset may keep numbers"
            )
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
        for (array, i), value in zip(entries, news, strict=True):
            w._stage.store(array, i, as_value(value))
            if later is not None:
                name = array.removeprefix("value_")
                later.present.setdefault(name, later.value(name).astype(object)).reshape(-1)[i] = value

    def _first(self) -> None:
        """Draw what is drawn once: values of the scene, and memory."""
        stage = self.stages["start"]
        stage.ticks = "1u"
        w = World(self.layout, stage)
        for event in self.events:
            if isinstance(event, Values):
                self._store_values(w, event, None)
            w.lasting = True
            if isinstance(event, Start):
                event.change(w)
            if isinstance(event, Reset) and event.first is not None:
                event.first(w)
            w.lasting = False
        for name, draw in self.layout.drawn.items():
            w.keep_own(name, draw(w))
        for number, event in enumerate(each for each in self.events if isinstance(each, Values)):
            if not isinstance(event.when, str):
                w.keep_own(f"until values {number}", [self._wait(w, event.when)])
        for name, values in w.kept.items():
            self._keep(w, name, values)

    # -- observe ---------------------------------------------------------------------------------------------------
    def _observe(self) -> None:
        stage = self.stages["observe"]

        def begin(one: FusedKernel) -> World:
            one.late = f"advance.data[0] > 0 || {CHOSEN_WORLD} ? 1u : 0u"
            return World(self.layout, one, fresh=Condition(one.graph.input("chosen", 0)))

        self.observed = begin(stage)
        self.found = self._observe_groups(self.observed, begin, "")

    def _final(self) -> None:
        """Observe the state in which an episode ends, before worlds start anew."""

        def begin(stage: FusedKernel) -> World:
            w = World(self.layout, stage)
            w.__dict__["steps"] = w.read("episode_length", 1)[0] + 1.0
            return w

        self._observe_groups(begin(self.stages["final"]), begin, "final ")

    def _observe_groups(self, w: World, begin: Callable[[FusedKernel], World], kind: str) -> Any:
        """Store the observations of all groups: of ``w``, or of the rows of a world that ``begin`` makes of a stage.

        Returns what the guard found in those of ``w``.
        """
        of_rows: dict[int, World] = {}
        checks: list[Check] = []
        for group, terms in self.groups.items():
            name, at, starts = self.layout.output(kind + group), 0, [0]
            for cause, term in zip(term_causes(group, terms), terms, strict=True):
                rows = term.rows
                if rows:
                    self.apart.add(kind + group)
                    if rows not in of_rows:
                        stage = FusedKernel(w._stage.name, len(self.stages), rows)
                        self.stages[f"{w._stage.name}, {rows} rows"] = stage
                        of_rows[rows] = begin(stage)
                    one, stage = of_rows[rows], of_rows[rows]._stage
                    goes = steps_on(one) if kind == "" else None
                    for number in range(stage.at_once):
                        found: list[Check] = []
                        (value,) = self.guard.admit(cause, [term.trace_row(one, number)], found)
                        stage.store_row(name, at, number, as_value(value))
                        self.guard.leave_row(one, kind, cause, found[0], number, goes)
                    at += rows
                else:
                    for value in term.trace(w, lambda values: self.guard.admit(cause, values, checks)):  # noqa: B023
                        w._stage.store(name, at, as_value(value))
                        at += 1
                starts.append(at)
            if not at:
                raise ValueError(f"Env: the terms of observations[{group!r}] returned no numbers; expected one or more")
            self.group_sizes[group], self.term_sizes[group] = at, np.diff(starts).tolist()
        return self.guard.leave(w, f"{kind}observations", checks, steps_on(w) if kind == "" else None)

    # -- memory ----------------------------------------------------------------------------------------------------
    def _close(self) -> None:
        """Store what each stage keeps; what a reset clears is cleared by the stage that resets."""
        for name, values in self.act.kept.items():
            self._keep(self.act, name, values)
        goes = steps_on(self.observed)
        for name, values in self.observed.kept.items():
            old = self.observed.stored_memory(name)
            due = goes & (self.found < 0.5) if self.layout.memory[name][2] is None else goes
            self._keep(self.observed, name, vector(where(due, a, b) for a, b in zip(values, old, strict=True)))
        self._store_reports(self.judge, self.done, self.after)
        self._clear(self.judge, self.done)
        self.guard.clear(self.judge, self.done)

    def _store_reports(self, w: World, done: Condition, later: World) -> None:
        """Store what observations read of a step, as it is in the state in which worlds start where ``done`` holds."""
        start = starts.StartWorld(self.layout, w._stage)
        start.__dict__.update(q=later.q, qd=later.qd, steps=0.0)
        start.present, start.kept = later.present, dict(w.kept)
        for name, (_, size, reset) in self.layout.memory.items():
            if reset is not None:
                start.kept[name] = vector([reset] * size)
        wanted = self.observed_entries
        if any(array == "frame_acceleration" for array, _ in wanted):  # of a step with these controls
            sizes = self.layout.control_sizes
            acted = [name for name in starts.CONTROLS if name in self.layout.action_arrays]
            wanted = wanted | {(name, entry) for name in acted for entry in range(sizes[name])}
        found = starts.reports(start, self.actions, wanted)
        olds = [w._scalar(*key) for key in found]
        for key, value in zip(
            found, choose(done, [*map(AbstractScalar, found.values())], olds, "reports"), strict=True
        ):
            w._stage.store(*key, as_value(value))

    @functools.cached_property
    def observed_entries(self) -> set[tuple[str, int]]:
        """Entries of arrays that observations read, (array, entry)."""
        stores = [item.value for stage in self.stages.values() if stage.name == "observe" for item in stage.stores]
        return {scalar.args for scalar in ordered(stores) if scalar.op == "input"}

    def _clear(self, w: World, done: Condition) -> None:
        """Store the memory that a stage keeps; where ``done`` holds, memory with a reset value takes that value."""
        every = list(self.layout.memory.items())
        names = [name for name, (_, _, reset) in every if reset is not None]
        olds = [w.kept.get(name, w.stored_memory(name)) for name in names]
        resets = [reset for _, size, reset in self.layout.memory.values() if reset is not None for _ in range(size)]
        found = choose(done, resets, [x for values in olds for x in values], "cleared")
        kept = w.kept | dict(zip(names, np.split(found, np.cumsum([*map(len, olds)])), strict=False))
        for name, _ in every:
            if name in kept:
                self._keep(w, name, kept[name])

    def _keep(self, w: World, name: str, values: Vector) -> None:
        """Store numbers of memory; not those of a term that no reset would clear, if they are not finite.

        The world would end in each step from then on. The memory kept at the start is stored, so that it is seen.
        """
        start, _, reset = self.layout.memory[name]
        if reset is None and w._stage.name != "start" and not is_own(name):
            fine = within(values, LARGEST)
            values = vector(where(fine, new, old) for new, old in zip(values, w.stored_memory(name), strict=True))
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
        later = self._start(w, chosen, intervals=False)
        self._store_reports(w, chosen, later)
        stage.store("episode_length", 0, as_value(where(chosen, 0.0, w.read("episode_length", 1)[0])))
        self._clear(w, chosen)
        self.guard.clear(w, chosen)


def steps_on(w: World) -> Condition:
    """Return whether a look at a world is a step of its own; one after a reset of others is not."""
    return (w.read("advance", 1)[0] > 0.5) | w.fresh


def choose(due: Condition, news: Any, olds: Any, name: str) -> Vector:
    """Return new values where ``due`` holds, else old ones; what only new ones need is computed only there.

    ``name`` tells the choices of one condition from each other.
    """
    pairs = [(as_value(a), as_value(b)) for a, b in zip(news, olds, strict=True)]
    return vector(AbstractScalar(branch(due.value, a, b, name)) for a, b in pairs)
