"""Cost of keeping failures of an environment, and the bits of their replays beside those of the run.

    python -m benchmarks.failures [--task go2-flat] [--worlds 4096] [--device cuda:0] [--json FILE]

The same task with and without ``keep_failures`` takes turns. ``step``: the graph of a whole step. ``with Python``:
``env.step`` as a learner calls it. ``iteration``: of a training by rsl_rl, where it is installed. Then a number is
planted, a robot is thrown and a policy returns NaN, and each world that has left a file is stepped again alone.
The exit status is 1 where a replay or the course of the other worlds has other bits, or a step waits for the device.
"""

from __future__ import annotations

import contextlib
import io
import itertools
import json
import math
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch

from warp_spo import env as envs
from warp_spo.env.failure_replay import read

from . import command_line
from .env_times import actions_of, stepper, time_of

TURNS, STEPS = 7, 40
PLANTED, THROWN, POLICY = (3017, 137), (2000, 140), 143  # (world, step), and the step of a policy that returns NaN


def compare(plain: Any, keeping: Any) -> bool:
    """Return whether steps have the same bits; with ``keeping``, torch raises an error where one waits for the GPU."""
    sets, same = actions_of(plain), True
    on_gpu = plain.device.type == "cuda"
    for i, actions in enumerate(itertools.islice(itertools.cycle(sets), STEPS)):
        wanted = plain.step(actions)
        if on_gpu and i > 2:  # the graph is there
            torch.cuda.set_sync_debug_mode("error")
        try:
            found = keeping.step(actions)
        finally:
            if on_gpu:
                torch.cuda.set_sync_debug_mode("default")
        same &= torch.equal(wanted[1], found[1]) and torch.equal(plain.q, keeping.q)
    return same


def time_steps(made: dict[str, Any], device: Any) -> dict[str, float]:
    """Return medians of times [us] of turns, by what is timed and by environment."""
    found: dict[str, list[float]] = {}
    for _ in range(TURNS):
        for name, env in made.items():
            found.setdefault(f"step, {name}", []).append(time_of(env.replay, device, STEPS))
            found.setdefault(f"with Python, {name}", []).append(time_of(stepper(env), device, STEPS))
    return {name: statistics.median(times) for name, times in found.items()}


def time_iterations(made: dict[str, Any], task: str, count: int) -> dict[str, float]:
    """Return medians of the times of iterations [ms]; nothing where rsl_rl is missing."""
    try:
        from warp_spo.env.learning import make_runner
        from warp_spo.env.tasks import task as module_of
    except ImportError:
        return {}
    learner, found = module_of(task).LEARNER, {}
    for name, env in [*made.items(), *made.items()]:
        runner = make_runner(env, learner)
        with contextlib.redirect_stdout(io.StringIO()):
            runner.learn(min(count, 2), init_at_random_ep_len=True)
            for _ in range(count):
                _wait(env)
                began = time.perf_counter()
                runner.learn(1)
                _wait(env)
                found.setdefault(f"iteration, {name}", []).append(1e3 * (time.perf_counter() - began))
    return {name: statistics.median(times) for name, times in found.items()}


def fail(env: Any) -> None:
    """Let worlds fail: a number planted, a robot thrown onto the ground, a policy that returns NaN."""
    env.reset(seed=1)
    sets = itertools.cycle(actions_of(env))
    planted, thrown = (min(each, env.num_envs - 1 - i) for i, each in enumerate((PLANTED[0], THROWN[0])))
    for i in range(POLICY + 1):
        actions = next(sets).clone()
        if i == PLANTED[1]:
            env.qd[planted, 6] = math.nan
        if i == THROWN[1]:
            env.qd[thrown, :6] = torch.tensor([0.0, 0.0, -40.0, 10.0, 0.0, 0.0], device=env.device)
        if i == POLICY:
            actions[:] = math.nan
        env.step(actions)


def replay(env: Any) -> list[dict[str, Any]]:
    """Return what the files hold and whether their replays have the same bits."""
    rows = []
    for file in env.failure_files():
        began = time.perf_counter()
        found = env.replay_failure(file)
        held = found.failure
        written = [step for step, _ in found.differences]
        expected = [PLANTED[1]] if "state" in held.cause else [THROWN[1]] if THROWN[1] in written else []
        rows.append({
            "file": file.name, "cause": held.cause, "steps": held.steps, "differences": found.differences,
            "same bits": written == expected and found.cause == held.cause and bool(
                (found.status == held.status).all()), "first": held.find_first(),
            "bytes": file.stat().st_size, "seconds": time.perf_counter() - began,
        })  # fmt: skip
    return rows


def _wait(env: Any) -> None:
    if env.device.type == "cuda":
        torch.cuda.synchronize(env.device)


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("failures", __doc__)
    parser.add_argument("--task", default="go2-flat")
    parser.add_argument("--worlds", type=int, default=4096)
    parser.add_argument("--iterations", type=int, default=12, help="of trainings, timed twice; 0: none")
    options = parser.parse_args(arguments)
    from warp_spo.runtime.arrays import parse_device

    device = parse_device(options.device, "benchmarks.failures").alias
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        made = {
            "off": envs.make(options.task, options.worlds, device),
            "on": envs.make(options.task, options.worlds, device, keep_failures=Path(folder) / "timed"),
        }
        print(f"made in {time.perf_counter() - began:.1f} s; {made['on']._failures.describe()}", flush=True)
        row: dict[str, Any] = {"task": options.task, "worlds": options.worlds, "device": device}
        row["same bits on and off, no wait"] = compare(made["off"], made["on"])
        row |= time_steps(made, device)
        print(json.dumps(row), flush=True)
        row |= time_iterations(made, options.task, options.iterations) if options.iterations else {}
        for what in ("step", "with Python", "iteration"):
            if f"{what}, off" in row:
                row[f"{what}, share"] = row[f"{what}, on"] / row[f"{what}, off"] - 1.0
        files = made["on"].failure_files()
        row["files while it was timed"] = [read(file).cause for file in files]
        del made
        env = envs.make(options.task, options.worlds, device, keep_failures=Path(folder) / "failed")
        fail(env)
        row["bytes"], row["replays"] = env._failures.bytes, replay(env)
    for name, value in row.items():
        if name != "replays":
            print(f"{name:30} {value}")
    for each in row["replays"]:
        print(json.dumps(each))
    causes = {each["cause"] for each in row["replays"]}
    whole = any("state" in each for each in causes) and {"status CONTACT", "not finite/action"} <= causes
    good = whole and row["same bits on and off, no wait"] and all(each["same bits"] for each in row["replays"])
    print("all replays have the bits of the run" if good else f"FAILED: causes {sorted(causes)}")
    if options.json:
        options.json.write_text(json.dumps(row, indent=1) + "\n")
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
