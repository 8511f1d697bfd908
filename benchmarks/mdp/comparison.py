"""An environment beside its task in NumPy: both see the same actions, and what they say is compared in each step."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from warp_spo import env as envs
from warp_spo.env.compile.cuda_graphs import Part
from warp_spo.scene.ground import HeightField

from .formulas import Robot, State
from .rules import Rules
from .tasks import TASKS

REWARD, OBSERVED = 1e-6, 1e-5  # largest errors of a reward, and of an observation
LARGE = 10.0  # above it an observation's error is 1e-6 of its size: eight roundings of float32, as of rates of 25 rad/s
SUMS = 1e-5  # of a reward's sum over an episode, over its size or 1
LOUDEST = 3.0  # deviation of the actions of the last world; the first one's are zero
RESETS, CHOSEN = 47, 0.1  # steps from one reset of random worlds to the next, and the share of worlds
FIVE_SIGMA = 5.0  # of a mean of noise
GAPS = 10  # steps from one comparison of a report's gaps with those of the state to the next
SPOILT = 50  # step in which the last world's action is NaN


class Comparison:
    """An environment of a ready task on the CPU, and the same task in NumPy.

    Args:
        name: of the task. worlds: how many. seed: of the environment, and of actions and resets.

    Attributes:
        errors: largest error by name. faults: names of what is wrong -> (how often, what was seen first).
        late: largest difference of a report's gaps and those of the state after the step, on a plane [m]; a report has
            them where the last step of the dynamics begins.
        counts: of ends, time-outs, resets, first observations and pushes.
    """

    def __init__(self, name: str, worlds: int, seed: int = 0):
        self.env = env = envs.make(name, worlds, "cpu", seed=seed, final_observations=True)
        self.random, self.generator = np.random.default_rng(seed), torch.Generator().manual_seed(seed)
        scene = env.scene
        labels = [scene.contacts[point.contact].label for point in scene.contact_points]
        field = scene.ground if isinstance(scene.ground, HeightField) else None
        self.robot = Robot(TASKS[name].__dict__.get("ROBOT", name.split("-")[0]), labels, field)
        self.task = TASKS[name](self.robot, worlds, env.step_dt)
        self.rules = Rules(env, self.task)
        self.errors: dict[str, float] = {}
        self.faults: dict[str, list[Any]] = {}
        self.counts = dict.fromkeys(("ends", "time-outs", "first observations", "resets", "pushes"), 0)
        self.noise: dict[str, list[np.ndarray]] = {}
        self.late = 0.0
        self.length, self.taken = np.zeros((2, worlds))
        self.action, self.before = np.zeros((2, worlds, env.num_actions))
        self.sums: dict[str, np.ndarray] = {}
        self._watch()
        if env.max_episode_length != self.task.steps:
            self._fault("length of an episode", f"{env.max_episode_length} steps, not {self.task.steps}")

    def run(self, steps: int) -> None:
        """Take steps with random actions, with resets of random worlds among them."""
        env, worlds = self.env, self.env.num_envs
        observed, _ = env.reset()
        self._begin(np.ones(worlds, bool), observed)
        self.length = self.random.integers(0, self.task.steps, worlds).astype(float)  # as a training starts
        env.episode_length_buf = torch.tensor(self.length, dtype=torch.int64)
        loud = torch.linspace(0.0, LOUDEST, worlds)[:, None]
        for step in range(1, steps + 1):
            actions = loud * torch.randn(worlds, env.num_actions, generator=self.generator)
            if step == SPOILT:
                actions[-1, 0] = math.nan
            self._step(actions)
            if step % RESETS == 0:
                chosen = self.random.random(worlds) < CHOSEN
                observed, _ = env.reset(torch.tensor(chosen))
                self.counts["resets"] += int(chosen.sum())
                self._begin(chosen, observed)
        self._check_noise()
        self.counts["pushes"] = self.rules.pushed

    # -- a step ----------------------------------------------------------------------------------------------------
    def _watch(self) -> None:
        """Keep the state and the contact report of each step, after the dynamics and before ends."""
        env = self.env
        parts = env.replay._parts
        at = next(i for i, part in enumerate(parts) if part.run == env._physics)

        def run() -> None:
            env._physics()
            self.seen = self._read(env._report)

        parts[at] = Part(run)

    def _read(self, report: Any) -> dict[str, Any]:
        env = self.env
        own = {"q": env.q, "qd": env.qd, "command": env.command if env.has_commands else None}
        own |= {name: getattr(report, f"contact_{end}", None) for name, end in
                (("force", "f"), ("gap", "gap"), ("slip", "slip"))}  # fmt: skip
        return {name: None if x is None else x.double().numpy() for name, x in own.items()}

    def _state(self, seen: dict[str, Any], time: np.ndarray, fresh: np.ndarray) -> State:
        return State(time=time, taken=self.taken.copy(), action=self.action, last_action=self.before, fresh=fresh,
                     com=self.rules.com(), bias=self.rules.bias(), **seen)  # fmt: skip

    def _step(self, actions: torch.Tensor) -> None:
        env, dt, task = self.env, self.env.step_dt, self.task
        spoilt = ~torch.isfinite(actions).all(dim=1).numpy()
        self.before, self.action = self.action, np.where(spoilt[:, None], 0.0, actions.double().numpy())
        observed, reward, done, extras = env.step(actions)
        self.taken += 1.0
        s = self._state(self.seen, (self.length + 1.0) * dt, np.zeros(env.num_envs, bool))
        if s.gap is not None and self.robot.field is None and env._steps % GAPS == 0:
            self.late = max(self.late, float(np.abs(s.gap - self.robot.gaps(s.q)).max()))
        task.step(s)
        self._near("controls", task.controls(s), env._controls["ctrl"], OBSERVED)
        terms = {name: weight * dt * term for name, (weight, term) in task.rewards(s).items()}
        for name, (change, most) in task.ties(s).items():
            unit = task.rewards(s)[name][0] * dt * change
            times = np.round((reward.double().numpy() - sum(terms.values())) / unit)
            terms[name] = terms[name] + unit * np.where((np.abs(times) <= most) & ~spoilt, times, 0.0)
        total = np.where(spoilt, 0.0, sum(terms.values()))
        ends = task.ends(s)
        terminated = np.any([spoilt, *ends.values()], axis=0)
        self.length += 1.0
        late = self.length >= task.steps
        over = terminated | late
        self._near("reward", total, reward, REWARD)
        self._same("end of an episode", over, done)
        self._same("time-out", late & ~terminated, extras["time_outs"])
        self._observed("last observation: ", s, extras["final_observations"], np.ones(env.num_envs, bool))
        self._sums(terms, ends | {"not finite": spoilt}, done.bool().numpy())
        self.counts["ends"] += int(terminated.sum())
        self.counts["time-outs"] += int((late & ~terminated).sum())
        over = done.bool().numpy()  # so that one wrong end is one fault
        self._begin(over, observed, s)

    def _begin(self, new: np.ndarray, observed: Any, judged: State | None = None) -> None:
        """Let worlds start anew; compare what all observe. ``judged``: the state before; None: in a reset."""
        env = self.env
        self.task.start(new)
        for each in (self.length, self.taken, self.action, self.before):
            each[new] = 0.0
        for each in self.sums.values():
            each[new] = 0.0
        seen = self._read(env._report) if judged is None else {
            **self.seen, "q": env.q.double().numpy(), "qd": env.qd.double().numpy()}  # fmt: skip
        if env.has_commands:
            seen["command"] = env.command.double().numpy()
        if seen["gap"] is not None and new.any():
            seen["gap"][new] = self.robot.gaps(seen["q"][new])
        for name in ("force", "slip"):  # no step has led to a new start; no task observes slips
            if seen[name] is not None:
                seen[name][new] = 0.0
        s = self._state(seen, self.length * env.step_dt, new)
        for name, what in self.rules.check(s, new, judged):
            self._fault(name, what)
        self.counts["first observations"] += int(new.sum())
        self._observed("first observation: ", s, observed, new)
        if judged is not None:
            self._observed("observation: ", s, observed, ~new)

    # -- comparing -------------------------------------------------------------------------------------------------
    def _observed(self, kind: str, s: State, observed: Any, worlds: np.ndarray) -> None:
        """Compare the observations of some worlds; remember noise as shares of the largest."""
        for group, terms in self.task.observations(s).items():
            at, given = 0, observed[group].double().numpy()
            for name, numbers, noise in terms:
                own = given[:, at : at + numbers.shape[1]][worlds]
                at += numbers.shape[1]
                off, what = own - numbers[worlds], f"{kind}{group}, {name}"
                if noise > 0.0:
                    self.noise.setdefault(f"{group}, {name}", []).append((off / noise).ravel())
                    off = np.sign(off) * np.maximum(np.abs(off) - noise, 0.0)
                self._near(what, off / np.maximum(1.0, np.abs(numbers[worlds]) / LARGE), 0.0, OBSERVED)
            if at != given.shape[1]:
                self._fault(f"{group}: size", f"{given.shape[1]} numbers, not {at}")

    def _check_noise(self) -> None:
        """Compare mean and mean square of the noise with those of uniform numbers between -1 and 1, 0 and 1/3."""
        for name, parts in self.noise.items():
            x = np.concatenate(parts)
            for what, value, deviation in (("mean", x.mean(), 1 / 3), ("mean square", (x**2).mean() - 1 / 3, 4 / 45)):
                if not abs(value) < FIVE_SIGMA * math.sqrt(deviation / len(x)):
                    self._fault(f"noise of {name}", f"its {what} is off by {value:.2g}, of {len(x)} numbers")

    def _sums(self, terms: dict[str, np.ndarray], ends: dict[str, np.ndarray], done: np.ndarray) -> None:
        """Compare the sums of each reward, and which ends a finished episode had."""
        env, spoilt = self.env, ends["not finite"]
        for name, term in terms.items():
            own = self.sums.setdefault(name, np.zeros(env.num_envs))
            own += np.where(spoilt, 0.0, term)  # a step that the guard ends earns nothing
            held = (env.memory(f"{kind} reward {name}")[:, 0].numpy() for kind in ("last", "sum"))
            most = SUMS * max(1.0, np.abs(own).max())
            self._near(f"sum of the reward {name}", own, np.where(done, *held), most)
        for name, holds in ends.items():
            self._same(f"end: {name}", holds[done], env.memory(f"last end {name}")[:, 0].numpy()[done])

    def _near(self, name: str, wanted: Any, came: Any, most: float) -> None:
        off = np.abs(np.asarray(came, dtype=float) - wanted)
        if off.size:
            worst = float(np.nan_to_num(off, nan=np.inf).max())
            self.errors[name] = max(self.errors.get(name, 0.0), worst)
            if not worst <= most:
                self._fault(name, f"off by {worst:.2g}", int((~(off <= most)).sum()))

    def _same(self, name: str, wanted: np.ndarray, came: Any) -> None:
        off = np.asarray(came).astype(bool) != wanted
        if off.any():
            self._fault(name, f"differs in {int(off.sum())} world(s)", int(off.sum()))

    def _fault(self, name: str, what: str, times: int = 1) -> None:
        known = self.faults.setdefault(name, [0, what])
        known[0] += times
