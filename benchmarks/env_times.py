"""Time of one step of an environment and of its parts; whether the graph, other world counts and the CPU agree.

    python -m benchmarks.env_times [--tasks go2-flat go2-rough g1-flat] [--worlds 4096 16384 65536] [--device cuda:0]
                                   [--json FILE]

Actions are random. ``step``: the graph of a whole step, replayed; tasks of one world count take turns, and the median
of their turns counts. ``dynamics``: actions and dynamics alone, as a graph of their own. ``with Python``: ``env.step``
as a learner calls it, steps in a row. Without a GPU all three are times of calls.
"""

from __future__ import annotations

import itertools
import json
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

import torch

from warp_spo import env as envs
from warp_spo.env import learning
from warp_spo.env.tasks import TASKS

from . import command_line

TURNS, REPLAYS, DRIVEN = 5, 40, 40
AGREED = 3  # steps after which a CPU and a GPU are compared; later they part, as falls differ


def actions_of(env: Any, count: int = 4) -> list[torch.Tensor]:
    """Return sets of random actions, the same on every device."""
    generator = torch.Generator().manual_seed(0)
    sets = [0.5 * torch.randn(env.num_envs, env.num_actions, generator=generator) for _ in range(count)]
    return [each.to(env.device) for each in sets]


def drive(env: Any, steps: int) -> bool:
    """Take steps with random actions; return whether the last observations are finite."""
    for actions in itertools.islice(itertools.cycle(actions_of(env)), steps):
        observed = env.step(actions)[0]
    return all(bool(torch.isfinite(each).all()) for each in observed.values())


def stepper(env: Any) -> Callable[[], None]:
    """Return a function that takes one step as a learner does, with the sets of random actions in turn."""
    sets = itertools.cycle(actions_of(env))

    def step() -> None:
        env.step(next(sets))

    return step


def time_of(work: Callable[[], Any], device: Any, count: int = REPLAYS) -> float:
    """Return the time of ``work`` [us], of calls in a row."""
    on_gpu = torch.device(device).type == "cuda"
    work()
    if on_gpu:
        torch.cuda.synchronize(device)
    began = time.perf_counter()
    for _ in range(count):
        work()
    if on_gpu:
        torch.cuda.synchronize(device)
    return 1e6 * (time.perf_counter() - began) / count


def as_graph(work: Callable[[], Any], device: Any) -> Callable[[], Any]:
    """Return the replay of ``work`` captured as a graph; on a CPU ``work``."""
    if torch.device(device).type != "cuda":
        return work
    work()
    torch.cuda.synchronize(device)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        work()
    return graph.replay


def measure(tasks: list[str], worlds: int, device: Any) -> dict[str, dict[str, Any]]:
    """Return times of each task [us], env-steps/s, the share that is not dynamics, and bytes a world."""
    made = {task: envs.make(task, worlds, device) for task in tasks}
    finite = {task: drive(env, DRIVEN) for task, env in made.items()}
    turns = [{task: time_of(env.replay, device) for task, env in made.items()} for _ in range(TURNS)]
    found = {}
    for task, env in made.items():
        step = statistics.median(turn[task] for turn in turns)
        dynamics = as_graph(env._physics, device)
        alone = statistics.median(time_of(dynamics, device) for _ in range(TURNS))
        called = statistics.median(time_of(stepper(env), device) for _ in range(TURNS))
        found[f"{task}, {worlds} worlds"] = {
            "step": step, "dynamics": alone, "with Python": called, "env-steps/s": 1e6 * worlds / step,
            "share that is not dynamics": 1.0 - alone / step, "bytes a world": env.bytes_per_world,
            "finite": finite[task], "turns": [turn[task] for turn in turns],
        }  # fmt: skip
    return found


def compare(task: str, device: Any, worlds: int = 256) -> dict[str, Any]:
    """Return whether steps in a graph, without one and of fewer worlds have the same bits, and how far a CPU is off."""

    def after(count: int, device: Any, steps: int, **options: Any) -> dict[str, torch.Tensor]:
        env, generator = envs.make(task, count, device, **options), torch.Generator().manual_seed(1)
        for _ in range(steps):
            actions = torch.randn(worlds, env.num_actions, generator=generator)[:count]
            observed, rewards, ended, _ = env.step(actions.to(env.device))
        return {**{name: observed[name] for name in env.num_obs}, "reward": rewards, "ended": ended}

    graph, eager, fewer = after(worlds, device, 60), after(worlds, device, 60, graph=False), after(100, device, 60)
    found: dict[str, Any] = {
        "graph equals eager": all(bool(graph[name].equal(eager[name])) for name in graph),
        "100 worlds equal the first of 256": all(bool(graph[name][:100].equal(fewer[name])) for name in graph),
    }
    if torch.device(device).type == "cuda":
        here, there = after(worlds, device, AGREED), after(worlds, "cpu", AGREED)
        far = {name: float((here[name].cpu() - there[name]).abs().max()) for name in here if name != "ended"}
        found[f"farthest from a CPU after {AGREED} steps"] = max(far.values())
    return found


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("env_times", __doc__)
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=["go2-flat", "go2-rough", "g1-flat"])
    parser.add_argument("--worlds", type=int, nargs="+", default=[4096, 16384, 65536])
    options = parser.parse_args(arguments)
    device, results = learning.pick_device(options.device), {}
    for worlds in options.worlds:
        found = measure(options.tasks, worlds, device)
        results |= found
        steps = {task: found[f"{task}, {worlds} worlds"]["step"] for task in options.tasks}
        if {"go2-flat", "go2-rough"} <= set(steps):
            results[f"rough over flat, {worlds} worlds"] = steps["go2-flat"] / steps["go2-rough"]
    for task in options.tasks:
        results[f"{task}, bits"] = compare(task, device)
    for name, row in results.items():
        print(f"{name}: {json.dumps(row)}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
