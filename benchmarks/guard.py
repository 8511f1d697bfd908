"""Trainings in which numbers are spoilt at random: whether the guard of environments keeps them from the learner.

    python -m benchmarks.guard --json benchmarks/results/training/GUARD.json
    python -m benchmarks.guard --trainings 2 --clean 2 --iterations 3 cartpole

At one step in four, an observation, a reward, a state or an action of a random world becomes NaN, inf, 1e12 or 1e30.
Afterwards all weights and normalisers have to be finite, every spoilt number has to be counted under its name, and the
rewards of a step at each iteration, means over trainings, have to lie within the spread of seeds without such numbers.
In trainings without them a termination ends a world instead, as often: more new starts alone change what is learned.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import json
import math
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch

from warp_spo.env import Observation, settings
from warp_spo.env.bounds import term_labels
from warp_spo.env.environment import Env
from warp_spo.env.learning import Learner, make_runner, pick_device
from warp_spo.env.tasks import task

TASKS = ("cartpole", "ant")
VALUES = (math.nan, math.inf, 1e12, 1e30)
SHARE = 0.25  # of steps with a spoilt number
SPREADS = 2.0  # standard deviations between seeds, within which mean curves lie
CONDITIONS = (
    "trainings of a task one after the other in one process; rewards are means over all worlds and steps of an "
    "iteration, the spread is the standard deviation between the seeds of trainings without spoilt numbers"
)


class SpoiltEnv(Env):
    """A task's environment, in which a step may spoil a number of one world."""

    def __init__(self, *args: Any, observations: Any, rewards: Any, terminations: Any = None, **options: Any):
        self.causes = [f"reward/{name}" for name in rewards]
        groups = {}
        for group, terms in observations.items():
            terms = [each if isinstance(each, Observation) else Observation(each) for each in terms]
            self.causes += [f"observation/{group}/{label}" for label in term_labels(terms)]
            groups[group] = terms
        places, size = iter(range(len(self.causes))), len(self.causes) + 1  # the last one ends the world
        ends = dict(terminations or {}) | {"at random": lambda w: w.memory("planted", size, reset=None)[size - 1] > 0.5}
        rewards = {name: (weight, spoil(term, next(places), size)) for name, (weight, term) in rewards.items()}
        groups = {
            group: [dataclasses.replace(each, term=spoil(each.term, next(places), size)) for each in terms]
            for group, terms in groups.items()
        }
        super().__init__(*args, observations=groups, rewards=rewards, terminations=ends, **options)
        self.begin(0, 0, False)

    def begin(self, seed: int, steps: int, spoils: bool) -> None:
        """Start anew; in the next ``steps`` steps, but the last two, spoil numbers, or end worlds if not ``spoils``."""
        self.reset(seed=seed)
        self.random, self.left, self.last, self.spoils = np.random.default_rng(seed), steps, -1, spoils
        self.spoilt: Counter = Counter()
        self.curve: list[float] = []

    def step(self, actions: torch.Tensor) -> Any:
        """Take a step, with a number that is spoilt or without."""
        self.left -= 1
        planted, world = self.memory("planted"), -1
        if self.left > 1 and self.random.random() < SHARE:
            world = int(self.random.choice([i for i in range(self.num_envs) if i != self.last]))
            if self.spoils:
                actions = self._spoil(actions, planted, world)
            else:
                planted[world, -1] = 1.0
        self.last = world
        found = super().step(actions)
        planted.zero_()
        self.curve.append(float(found[1].mean()))
        return found

    def _spoil(self, actions: torch.Tensor, planted: torch.Tensor, world: int) -> torch.Tensor:
        kind, value = self.random.integers(4), float(self.random.choice(VALUES))
        if kind == 0:
            actions = actions.clone()
            actions[world, self.random.integers(self.num_actions)] = value
            self.spoilt["action"] += 1
        elif kind == 1:
            part = self.q if self.random.random() < 0.5 else self.qd
            entries = range(part.shape[1])
            if part is self.q and self.scene.hinges[0].kind == "free":  # a large quaternion is normalised
                entries = [i for i in entries if i not in range(3, 7)]  # type: ignore[assignment]
            part[world, int(self.random.choice(entries))] = value
            self.spoilt["state"] += 1
        else:
            wanted = "reward/" if kind == 2 else "observation/"
            place = int(self.random.choice([i for i, cause in enumerate(self.causes) if cause.startswith(wanted)]))
            planted[world, place] = value
            self.spoilt[self.causes[place]] += 1
        return actions

    def counted(self) -> Counter:
        """Return what ended worlds, by cause; parts of a state are one."""
        found: Counter = Counter()
        for name, number in self.log().items():
            _, kind, *cause = name.split("/", 2)
            if kind in ("not finite", "beyond bounds") and cause[0] in ("action", "state", *self.causes):
                found[cause[0]] += int(number)
        return +found


def spoil(term: Any, place: int, size: int) -> Any:
    """Return a term to whose first number a world adds what is planted at a place."""

    @functools.wraps(term)
    def spoilt(w: Any) -> Any:
        value, more = term(w), w.memory("planted", size, reset=None)[place]
        if not np.ndim(value):
            return value + more
        first, *others = value
        return [first + more, *others]

    return spoilt


def train(env: SpoiltEnv, learner: Learner, seed: int, iterations: int, spoils: bool) -> dict[str, Any]:
    """Return the rewards of a step at each iteration, and what the guard let through or did not count."""
    torch.manual_seed(seed)
    env.begin(seed, iterations * learner.steps, spoils)
    runner = make_runner(env, learner)
    runner.learn(iterations, init_at_random_ep_len=True)
    tensors = [x for model in (runner.alg.actor, runner.alg.critic) for x in model.state_dict().values()]
    counted = env.counted()
    return {
        "curve": np.reshape(env.curve, (iterations, -1)).mean(axis=1),
        "lost": sum(not bool(x.isfinite().all()) for x in tensors),
        "spoilt": sum(env.spoilt.values()),
        "miscounted": {name: counted[name] - env.spoilt[name] for name in counted.keys() | env.spoilt.keys()
                       if counted[name] != env.spoilt[name]},
    }  # fmt: skip


def measure(name: str, worlds: int, trainings: int, clean: int, iterations: int) -> dict[str, Any]:
    """Return the figures of a task."""
    chosen, began = task(name), time.time()
    with mock.patch.object(settings, "Env", SpoiltEnv):
        env = chosen.build(worlds, "cpu")
    learner = dataclasses.replace(chosen.LEARNER, worlds=worlds, hidden=(64, 64), batches=1)
    runs = []
    for i in range(clean + trainings):
        runs.append(train(env, learner, i, iterations, i >= clean))
        print(
            f"{name}: training {i + 1} of {clean + trainings}, {time.time() - began:.0f} s", file=sys.stderr, flush=True
        )
    without, spoilt = runs[:clean], runs[clean:]
    means, others = (np.mean([each["curve"] for each in some], axis=0) for some in (spoilt, without))
    spread = np.std([each["curve"] for each in without], axis=0, ddof=1) if clean > 1 else np.full(iterations, np.nan)
    away = np.abs(means - others) / spread
    last = slice(-5, None)
    late = {kind: [float(each["curve"][last].mean()) for each in some]
            for kind, some in (("spoilt", spoilt), ("without", without))}  # fmt: skip
    wrong: Counter = Counter()
    for each in spoilt + without:
        wrong.update({key: abs(count) for key, count in each["miscounted"].items()})
    return {
        "task": name, "worlds": worlds, "trainings": trainings, "without": clean, "iterations": iterations,
        "spoilt numbers": sum(each["spoilt"] for each in spoilt),
        "counted wrongly": dict(wrong),
        "tensors not finite": sum(each["lost"] for each in spoilt + without),
        "reward of a step, spoilt": [float(f"{x:.4g}") for x in means],
        "reward of a step, without": [float(f"{x:.4g}") for x in others],
        "spread of seeds": [float(f"{x:.3g}") for x in spread],
        "farthest curve [spreads]": float(f"{away.max():.3g}"),
        "last 5, spoilt": [float(f"{np.mean(late['spoilt']):.4g}"), float(f"{np.std(late['spoilt']):.3g}")],
        "last 5, without": [float(f"{np.mean(late['without']):.4g}"), float(f"{np.std(late['without']):.3g}")],
        "seconds": round(time.time() - began),
    }  # fmt: skip


def failures(found: dict[str, Any]) -> list[str]:
    """Return what is wrong with a task's figures, in words."""
    lines = []
    if found["tensors not finite"]:
        lines.append(f"{found['tensors not finite']} tensors of weights and normalisers are not finite")
    if found["counted wrongly"]:
        lines.append(f"counts of {found['counted wrongly']} differ from what was spoilt")
    if not found["farthest curve [spreads]"] <= SPREADS:
        lines.append(f"the mean curve is {found['farthest curve [spreads]']} spreads of seeds away")
    return [f"{found['task']}: {line}" for line in lines]


def main(argv: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="python -m benchmarks.guard", description=__doc__,
                                formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    p.add_argument("tasks", nargs="*", metavar="TASK", help=f"some of {', '.join(TASKS)}; left out: all")
    p.add_argument("--trainings", type=int, default=50, metavar="N", help="with spoilt numbers, of each task")
    p.add_argument("--clean", type=int, default=20, metavar="N", help="without")
    p.add_argument("--iterations", type=int, default=30, metavar="N")
    p.add_argument("--worlds", type=int, default=32, metavar="N")
    p.add_argument("--json", type=Path, metavar="FILE")
    options = p.parse_args(argv)
    if unknown := [name for name in options.tasks if name not in TASKS]:
        p.error(f"no task {', '.join(unknown)}; expected some of {', '.join(TASKS)}")
    pick_device("cpu")
    rows = []
    for name in options.tasks or TASKS:
        rows.append(measure(name, options.worlds, options.trainings, options.clean, options.iterations))
        print(json.dumps(rows[-1]), flush=True)
    if options.json:
        head = {"date": time.strftime("%Y-%m-%d"), "device": "CPU", "conditions": CONDITIONS}
        options.json.write_text(json.dumps(head | {"rows": rows}, indent=1) + "\n")
    lines = [line for row in rows for line in failures(row)]
    print("\n".join(lines) or "all numbers that were spoilt ended their worlds, counted by name", flush=True)
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
