"""Training beside an environment that costs nothing: env-steps/s of stepping, collecting, training.

    python -m benchmarks.training [--task go2-flat] [--worlds 4096 16384] [--device cuda:0] [--json FILE]

The environment that costs nothing has the same observations, actions and learner; its step returns the same tensors
every time. Both take turns in one process; figures are medians over iterations. On a GPU the learner's bytes are the
largest number that torch held while it trained, less what it held before: networks, optimizer, rollouts, temporaries.
"""

from __future__ import annotations

import gc
import json
import statistics
import sys
import time
from typing import Any

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from warp_spo import env as envs
from warp_spo.env import learning
from warp_spo.env.tasks import task

from . import command_line

WARM, ITERATIONS = 4, 12


class Free(VecEnv):
    """An environment like another one, whose steps cost nothing."""

    def __init__(self, like: Any):
        self.num_envs, self.num_actions, self.device, self.cfg = like.num_envs, like.num_actions, like.device, {}
        self.max_episode_length, self.num_obs, self.step_dt = like.max_episode_length, like.num_obs, like.step_dt
        self.episode_length_buf = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        groups = {name: torch.randn(self.num_envs, size, device=self.device) for name, size in like.num_obs.items()}
        self.observed = TensorDict(groups, batch_size=[self.num_envs], device=self.device)
        self.rewards = torch.randn(self.num_envs, device=self.device)
        self.dones = torch.zeros(self.num_envs, dtype=torch.int32, device=self.device)
        self.extras = {"time_outs": torch.zeros(self.num_envs, device=self.device)}

    def get_observations(self) -> TensorDict:
        return self.observed

    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        return self.observed, self.rewards, self.dones, self.extras

    def log(self) -> dict[str, torch.Tensor]:
        return {"/episode/seconds": torch.zeros((), device=self.device)}


class Times(learning.TrainingLog):
    """The times of collecting and learning, iteration after iteration."""

    def log(self, collect_time: float, learn_time: float, **others: Any) -> None:  # type: ignore[override]
        self.times.append((collect_time, learn_time))

    def init_logging_writer(self) -> None:
        self.writer, self.times = None, []


def measure(env: Any, learner: Any) -> dict[str, float]:
    """Return milliseconds of collecting and learning, env-steps/s of both, and on a GPU the learner's bytes at most."""
    gc.collect()
    on_gpu = torch.device(env.device).type == "cuda"
    if on_gpu:
        torch.cuda.reset_peak_memory_stats(env.device)
    before = torch.cuda.memory_allocated(env.device) if on_gpu else 0
    runner = learning.make_runner(env, learner)
    runner.logger = times = Times(env, None, 1, time.time(), False)  # type: ignore[assignment]
    runner.learn(WARM + ITERATIONS)
    rows = times.times[WARM:]
    collect, learn = (statistics.median(row[i] for row in rows) for i in (0, 1))
    total = statistics.median(sum(row) for row in rows)
    steps = env.num_envs * learner.steps
    found = {"collecting ms": 1e3 * collect, "learning ms": 1e3 * learn, "collecting env-steps/s": steps / collect,
             "training env-steps/s": steps / total}  # fmt: skip
    return found | ({"learner's bytes": torch.cuda.max_memory_allocated(env.device) - before} if on_gpu else {})


def step_rate(env: Any, steps: int = 200) -> float:
    """Return env-steps/s of stepping alone, with the same actions."""
    actions = torch.zeros(env.num_envs, env.num_actions, device=env.device)
    for _ in range(20):
        env.step(actions)
    wait(env.device)
    began = time.time()
    for _ in range(steps):
        env.step(actions)
    wait(env.device)
    return env.num_envs * steps / (time.time() - began)


def wait(device: Any) -> None:
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize(device)


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("training", __doc__)
    parser.add_argument("--task", default="go2-flat")
    parser.add_argument("--worlds", type=int, nargs="+", default=[4096, 16384])
    options = parser.parse_args(arguments)
    device, learner, results = learning.pick_device(options.device), task(options.task).LEARNER, {}
    for worlds in options.worlds:
        env = envs.make(options.task, worlds, device)
        free, ours = measure(Free(env), learner), measure(env, learner)
        found = {"stepping env-steps/s": step_rate(env), "ours": ours, "free": free,
                 "share": ours["training env-steps/s"] / free["training env-steps/s"]}  # fmt: skip
        results[f"{options.task}, {worlds} worlds"] = found
        print(f"{options.task}, {worlds} worlds: {json.dumps(found)}", flush=True)
        if options.json:
            options.json.write_text(json.dumps(results, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
