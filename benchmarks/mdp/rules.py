"""Ranges and times of what is random in the ready tasks: new starts, pushes, commands, values of worlds, tiles."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from warp_spo import terrain
from warp_spo.env.tasks import go2_rough

from .formulas import State, heading
from .tasks import Task

ROUNDING = 2e-6  # of float32 in a range of about 1
FRICTION, MASS, COM, BIAS = (0.3, 1.2), (0.9, 1.1), (0.025, 0.025, 0.03), 0.015  # of go2 and g1
PUSHES = (1.0, 3.0)  # range of the time between them [s]
TILE = 8.0  # length of a tile of go2-rough [m]
GAIN = 0.5  # of the turning rate towards a heading [1/s]
Found = Iterator[tuple[str, str]]


class Rules:
    """The rules of an environment's random numbers.

    Args:
        env: the environment. task: in NumPy.

    Attributes:
        pushed: how many pushes there were.
    """

    def __init__(self, env: Any, task: Task):
        self.env, self.task, self.pushed = env, task, 0
        worlds, dt = env.num_envs, env.step_dt
        self.since_push, self.since_command = np.zeros((2, worlds))
        self.command: Any = None
        self.spans = [[round(end / dt) for end in span] for span in (PUSHES, task.seconds or PUSHES)]
        self.levels = env.levels().get("terrain")
        self.tile = None if self.levels is None else self.levels.numpy().copy()
        self.values = {name: x.double().numpy() for name, x in env.values.items()}
        if self.tile is not None:
            self.origins = terrain.tiles(10, 10, go2_rough.SIZE, kinds=go2_rough.KINDS, seed=1).origins

    def com(self) -> Any:
        """Return the centre of mass of each world's base in its frame [world, 3] [m]."""
        model = self.task.robot.model
        if "body_com" in self.env.values:
            return self.env.values["body_com"][:, 0].double().numpy()
        return np.tile(model.body_ipos[1], (self.env.num_envs, 1))

    def bias(self) -> np.ndarray:
        """Return what encoders read beyond the truth [world, joint]."""
        if self.task.pushes is None:
            return np.zeros((self.env.num_envs, len(self.task.robot.joints)))
        return self.env.memory("encoder bias").double().numpy()

    def check(self, s: State, new: np.ndarray, judged: State | None) -> Found:
        """Return names of rules that do not hold, with what was seen; ``judged``: before new starts and pushes."""
        if new.any():
            yield from self._starts(s, new, judged)
        if self.task.pushes is not None:
            yield from self._values(s)
        if judged is not None:
            yield from self._pushes(s, new, judged)
        if s.command is not None:
            yield from self._commands(s, new, judged is not None)
        self.since_push[new] = 0.0

    def _starts(self, s: State, new: np.ndarray, judged: State | None) -> Found:
        q = s.q[new]
        if self.tile is not None:
            yield from self._tiles(new, judged)
            row, column = self.tile[new].astype(int).T
            q = q.copy()
            q[:, :3] -= self.origins[row, column]
        yield from _outside("start", self.task.starts(q, s.qd[new]))

    def _tiles(self, new: np.ndarray, judged: State | None) -> Found:
        """Check that rows of tiles follow success, and keep the new ones."""
        now = self.levels.numpy().copy()
        if judged is not None:
            row, column = self.tile[new].astype(int).T
            way = np.linalg.norm(judged.q[new, :2] - self.origins[row, column, :2], axis=1)
            up = way > 0.5 * TILE
            asked = 0.5 * np.hypot(*judged.command[new, :2].T) * judged.taken[new] * self.env.step_dt
            wanted = row + up - (~up & (way < asked))
            wanted = np.where(wanted < 0, 0, wanted)
            last = wanted >= len(self.origins)  # then it is drawn anew
            if (wanted != now[new, 0])[~last].any():
                yield "row of tiles", f"{now[new, 0][~last]}, not {wanted[~last]}"
        if (now[:, 1] != self.tile[:, 1]).any():
            yield "column of tiles", "changed"
        self.tile = now

    def _values(self, s: State) -> Found:
        """Check the ranges of values of worlds, and that they stay."""
        values, env = {name: x.double().numpy() for name, x in self.env.values.items()}, self.env
        for name, x in values.items():
            if not np.array_equal(x, self.values[name]):
                yield f"value {name}", "changed after the start"
        (trunk,) = (i for i, label in enumerate(env.scene.body_labels) if label == self.task.TRUNK)
        own = {name: np.array(x[0], dtype=float) for name, x in env.scene.values.items() if name in values}
        friction, mass = values["contact_friction"], values["body_mass"][:, trunk] / own["body_mass"][trunk]
        if np.ptp(friction, axis=1).any():
            yield "value contact_friction", "points of a world differ"
        shift = values["body_com"][:, trunk] - own["body_com"][trunk]
        ranges = {"friction": (friction, *FRICTION), "mass": (mass, *MASS), "bias": (s.bias, -BIAS, BIAS)}
        ranges |= {f"centre of mass, {'xyz'[i]}": (shift[:, i], -most, most) for i, most in enumerate(COM)}
        yield from _outside("value", ranges)

    def _pushes(self, s: State, new: np.ndarray, judged: State) -> Found:
        """Check that nothing but pushes changes the state of worlds that go on, how far, and how often."""
        going = ~new
        if (s.q != judged.q)[going].any():
            yield "state", "q of a world that goes on has changed after the dynamics"
        change = s.qd - judged.qd
        push = going & (change != 0.0).any(axis=1)
        if push.any() and self.task.pushes is None:
            yield "state", "qd of a world that goes on has changed after the dynamics"
        elif push.any():
            most = np.zeros(change.shape[1])
            most[:6] = self.task.pushes
            if (np.abs(change) > most + 1e-5 * (1.0 + np.abs(judged.qd)))[push].any():
                yield "push", "a velocity changes by more than it may"
        self.pushed += int(push.sum())
        self.since_push += 1.0
        least, longest = self.spans[0]
        if self.task.pushes is not None:
            if (self.since_push[push] < least).any() or (self.since_push[going] > longest).any():
                yield "time between pushes", f"{self.since_push[going].max():.0f} steps, or fewer than {least}"
            self.since_push[push] = 0.0

    def _commands(self, s: State, new: np.ndarray, stepped: bool) -> Found:
        """Check ranges and times of commands; one with a heading has its rate of turning from the heading."""
        drawn, steers = s.command.copy(), "command heading" in self.env._layout.memory
        standing = (np.abs(drawn) < 1e-12).all(axis=1)
        if steers:
            towards, moves = self.env.memory("command heading").double().numpy().T
            missing = (towards - heading(s) + np.pi) % (2.0 * np.pi) - np.pi
            turn = moves * np.clip(GAIN * missing, *self.task.WISHED[2])
            edge = np.abs(np.abs(missing) - np.pi) < 1e-5
            if stepped and (np.abs(turn - drawn[:, 2]) > 1e-5)[~edge].any():
                yield "command", f"turning off by {np.abs(turn - drawn[:, 2]).max():.2g}"
            drawn[:, 2] = towards
            standing = moves == 0.0
        shown = s.command[~standing]
        yield from _outside("command", self.task.commands(shown))
        fresh = new if self.command is None else new | (drawn != self.command).any(axis=1)
        if self.command is not None and (drawn == self.command).all(axis=1)[new & ~standing].any():
            yield "command", "a new start has the old one"
        self.since_command += 1.0 if stepped else 0.0
        least, longest = self.spans[1]
        again = fresh & ~new
        if (self.since_command[again] < least).any() or (self.since_command[~new] > longest).any():
            times = self.since_command[~new & ((self.since_command > longest) | again)]
            yield (
                "time between commands",
                f"{times.min():.0f} to {times.max():.0f} steps; asked for {least} to {longest}",
            )
        self.since_command[fresh] = 0.0
        self.command = drawn


def _outside(what: str, numbers: dict[str, tuple[np.ndarray, float, float]]) -> Found:
    """Return what lies outside of its range."""
    for name, (x, low, high) in numbers.items():
        if x.size and not (x.min() >= low - ROUNDING and x.max() <= high + ROUNDING):
            yield f"{what}: {name}", f"{x.min():.4g} to {x.max():.4g}; asked for {low:g} to {high:g}"
