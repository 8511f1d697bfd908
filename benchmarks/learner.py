"""Time of an iteration of training by ways to learn; whether graphs of rollouts and updates compute what calls do.

    python -m benchmarks.learner --json benchmarks/results/training/LEARNER.json [--worlds 4096 16384]
                                 [--variants stock graphs ...] [--kernels]

``collect`` and ``learn`` are medians over iterations in ms of wall time, ``iteration`` the whole with the log's rows,
``busy`` the time in which a kernel was at work, ``kernels`` their number. --kernels lists those of rollouts and of
updates that take longest. A variant that fails has the error in place of times.
"""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import gc
import io
import itertools
import json
import statistics
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from rsl_rl.algorithms import PPO
from rsl_rl.runners import OnPolicyRunner

from warp_spo import env as envs
from warp_spo.env import learning
from warp_spo.env.captured_ppo import CapturedPPO
from warp_spo.env.compile.cuda_graphs import Captured
from warp_spo.env.tasks import task

from . import command_line

WARM, ITERATIONS, PROFILED = 4, 12, 3
LISTED = 25  # kernels
ROUNDED = 1e-4  # of numbers of a rollout, whose returns another kernel sums
NEAR = 1e-3  # of the way that weights went: rounding in TF32 may differ where a library picks other kernels for a graph
CLOSE = 2e-2  # the same, of one update by other kernels: Adam's first steps have the sign of gradients near zero


class Unfused(CapturedPPO):
    """Updates by rsl_rl's networks and torch's Adam."""

    fuses = False


class ActingCaptured(Unfused):
    """rsl_rl's update with acting as a graph."""

    def _adopt(self) -> None:
        pass

    def update(self) -> dict[str, float]:
        places = [model.obs_normalizer._std for model in (self.actor, self.critic)]
        losses = PPO.update(self)
        for model, place in zip((self.actor, self.critic), places, strict=True):
            model.obs_normalizer._std = place.copy_(model.obs_normalizer._std)
        return losses


@dataclasses.dataclass(frozen=True)
class Variant:
    """A way to learn.

    Attributes:
        algorithm: of rsl_rl's shape. precision: of the networks' products. stepwise: whether Python takes each step of
            a rollout. prepare: changes the algorithm before it learns.
    """

    algorithm: type[PPO] = Unfused
    precision: str = "tf32"
    stepwise: bool = False
    prepare: Callable[[Any], None] | None = None


def take_one_stream(alg: Any) -> None:
    alg._side = None


VARIANTS = {
    "stock": Variant(PPO, stepwise=True),
    "acting": Variant(ActingCaptured, stepwise=True),
    "update": Variant(stepwise=True),
    "graphs": Variant(),
    "graphs, float32": Variant(precision="float32"),
    "graphs, bfloat16": Variant(precision="bfloat16"),
    "graphs, one stream": Variant(prepare=take_one_stream),
    "fused": Variant(CapturedPPO),
    "fused, float32": Variant(CapturedPPO, precision="float32"),
    "fused, bfloat16": Variant(CapturedPPO, precision="bfloat16"),
}


class Clock(learning.TrainingLog):
    """The log of a training, which keeps times, too."""

    times: list[tuple[float, float, float]]

    def log(self, it: int, total_it: int, collect_time: float, learn_time: float, **others: Any) -> None:  # type: ignore[override]
        super().log(it, total_it, collect_time, learn_time, **others)
        self.times.append((time.perf_counter(), collect_time, learn_time))


def make_runner(env: Any, variant: Variant, folder: Path) -> Any:
    """Return a runner of a variant whose log is in a folder."""
    learner = dataclasses.replace(task("go2-flat").LEARNER, precision=variant.precision)
    with contextlib.redirect_stdout(io.StringIO()):
        settings = learner.settings(env, 10**9)
        settings["algorithm"]["class_name"] = variant.algorithm
        learning.set_precision(variant.precision)
        torch.manual_seed(0)
        runner = learning.Runner(env, settings, str(env.device))
    if variant.prepare is not None:
        variant.prepare(runner.alg)
    runner.logger = log = Clock(env, folder, 10**9, time.time(), True)
    log.times = []
    return runner


def measure(env: Any, variant: Variant) -> dict[str, Any]:
    """Return times of an iteration [ms] and the kernels that take longest."""
    gc.collect()
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(env.device)
    before = torch.cuda.memory_allocated(env.device)
    env.reset(seed=0)
    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        runner = make_runner(env, variant, Path(folder))
        learn = OnPolicyRunner.learn if variant.stepwise else type(runner).learn
        began = time.perf_counter()
        learn(runner, WARM)
        warm = time.perf_counter() - began
        runner.logger.times.clear()
        learn(runner, ITERATIONS + 1)
        rows = runner.logger.times
        found: dict[str, Any] = {
            "collect": 1e3 * statistics.median(row[1] for row in rows[1:]),
            "learn": 1e3 * statistics.median(row[2] for row in rows[1:]),
            "iteration": 1e3 * statistics.median(b[0] - a[0] for a, b in itertools.pairwise(rows)),
            f"first {WARM} iterations": 1e3 * warm,
            "bytes": torch.cuda.max_memory_allocated(env.device) - before,
        }
        found |= profile(lambda: learn(runner, PROFILED))
        if not variant.stepwise:
            alg, repeat = runner.alg, range(PROFILED)
            found["rollout"] = profile(lambda: [alg.collect(env, alg._seen) for _ in repeat])
            found["update"] = profile(lambda: [alg.update() for _ in repeat])
    steps = env.num_envs * runner.cfg["num_steps_per_env"]
    return found | {"env-steps/s": 1e3 * steps / found["iteration"]}


def profile(work: Callable[[], Any]) -> dict[str, Any]:
    """Return ms in which kernels were at work, and their number, a call of an iteration; and the longest of them."""
    activities = [torch.profiler.ProfilerActivity.CUDA]
    with torch.profiler.profile(activities=activities) as profiler:
        work()
        torch.cuda.synchronize()
    spans, sums = [], collections.Counter[str]()
    counts = collections.Counter[str]()
    for event in profiler.events():
        if event.device_type == torch.autograd.DeviceType.CUDA:
            spans.append((event.time_range.start, event.time_range.end))
            sums[event.name] += event.time_range.end - event.time_range.start
            counts[event.name] += 1
    busy, end = 0.0, -1.0
    for first, last in sorted(spans):
        busy += max(0.0, last - max(first, end))
        end = max(end, last)
    longest = {name[:110]: [us / 1e3 / PROFILED, counts[name] / PROFILED] for name, us in sums.most_common(LISTED)}
    return {"busy": busy / 1e3 / PROFILED, "kernels": len(spans) / PROFILED, "longest [ms, number]": longest}


def compare(env: Any, variant: Variant, other: type[PPO] | None = None, updates: int = 3) -> dict[str, Any]:
    """Return how rollouts and updates differ from another algorithm's; without one, graphs from calls.

    Rollouts of both start from the same worlds and have the same policy; both update by the last of them.
    """
    start, found, graphs = env.state_dict(), [], []
    for algorithm in (variant.algorithm, other or type("Called", (variant.algorithm,), {"captures": False})):
        with tempfile.TemporaryDirectory() as folder:
            runner = make_runner(env, dataclasses.replace(variant, algorithm=algorithm), Path(folder))
        alg: Any = runner.alg
        alg.train_mode()
        env.load_state_dict(start)
        obs, rollouts, losses = env.get_observations(), [], []
        for i in range(3):
            torch.manual_seed(i)
            obs = alg.collect(env, obs)
            held = alg.storage
            parts = [*held.observations.values(), held.actions, held.rewards, held.dones, held.values, held.returns]
            rollouts.append(torch.cat([each.float().flatten() for each in [*parts, held.advantages]]))
        before = weights_of(alg)
        for i in range(updates):
            torch.manual_seed(i)
            losses.append(alg.update())
        found.append((torch.stack(rollouts), before, weights_of(alg), losses, alg.learning_rate))
        graphs.append([alg._collecting.is_graph, alg._learning.is_graph])
    (rollout, before, weights, losses, rate), (other_rollout, _, others, other_losses, other_rate) = found
    far = float((weights - others).norm() / (weights - before).norm())
    same = bool(rollout.equal(other_rollout))
    near = same or (other is not None and bool((rollout - other_rollout).abs().max() < ROUNDED))
    expected = [[True, True], [False, False]] if other is None else graphs
    return {
        "passed": near and far < (NEAR if other is None else CLOSE) and graphs == expected,
        "rollouts equal to the bit": same,
        "rollouts: largest difference": float((rollout - other_rollout).abs().max()),
        "updates equal to the bit": bool(weights.equal(others)),
        "weights: norm of the difference over that of the way they went": far,
        "losses": [losses[-1], other_losses[-1]], "rates": [rate, other_rate], "graphs of rollout and update": graphs,
    }  # fmt: skip


def weights_of(alg: Any) -> torch.Tensor:
    """Return all weights of actor and critic."""
    return torch.cat([w.detach().flatten() for model in (alg.actor, alg.critic) for w in model.parameters()])


def recover(device: str) -> dict[str, Any]:
    """Return whether a function that cannot be captured is called instead, and random numbers can be drawn after it."""
    numbers = torch.zeros(1, device=device)

    def wait() -> None:
        numbers.add_(torch.randn(1, device=device))
        numbers.item()

    work = Captured(wait, device, "a function that waits", plain=0)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        work()
        work()
    torch.randn(1, device=device)
    return {"passed": not work.is_graph and float(numbers) != 0.0}


def attempt(work: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return what work finds, or its error."""
    try:
        return work()
    except Exception as error:
        traceback.print_exc()
        return {"error": f"{type(error).__name__}: {error}"[:2000]}


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("learner", __doc__)
    parser.add_argument("--worlds", type=int, nargs="+", default=[4096, 16384])
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    parser.add_argument("--kernels", action="store_true", help="print the kernels that take longest")
    options = parser.parse_args(arguments)
    device = learning.pick_device(options.device)
    results: dict[str, Any] = {"device": torch.cuda.get_device_name(device), "torch": torch.__version__}
    env = envs.make("go2-flat", 256, device)
    for name, variant in VARIANTS.items():
        if name in options.variants and not variant.stepwise and not variant.prepare:
            results[f"{name}, check"] = found = attempt(lambda: compare(env, variant))  # noqa: B023
            print(f"{name}, check: {json.dumps(found)}", flush=True)
    if any(VARIANTS[name].algorithm is CapturedPPO for name in options.variants):
        results["fused against torch, float32, check"] = found = attempt(
            lambda: compare(env, VARIANTS["fused, float32"], Unfused, 1)
        )
        print(f"fused against torch, float32, check: {json.dumps(found)}", flush=True)
    print(
        f"{'':32}{'collect':>9}{'learn':>9}{'iteration':>11}{'busy':>9}{'kernels':>9}{'GB':>7}{'first':>9}", flush=True
    )
    for worlds in options.worlds:
        env = envs.make("go2-flat", worlds, device)
        for name in options.variants:
            found = attempt(lambda: measure(env, VARIANTS[name]))  # noqa: B023
            results[f"{name}, {worlds} worlds"] = found
            if "error" in found:
                print(f"{name + f', {worlds}':32}  {found['error'][:200]}", flush=True)
                continue
            print(f"{name + f', {worlds}':32}{found['collect']:9.2f}{found['learn']:9.2f}{found['iteration']:11.2f}"
                  f"{found['busy']:9.2f}{found['kernels']:9.0f}{found['bytes'] / 1e9:7.2f}"
                  f"{found[f'first {WARM} iterations']:9.0f}", flush=True)  # fmt: skip
            for part in ("rollout", "update") if options.kernels and "rollout" in found else ():
                print(f"  {part}: busy {found[part]['busy']:.2f} ms, {found[part]['kernels']:.0f} kernels")
                for kernel, (ms, count) in found[part]["longest [ms, number]"].items():
                    print(f"    {ms:8.3f} ms {count:7.0f}  {kernel}")
            if options.json:
                options.json.write_text(json.dumps(results, indent=1))
    results["a failed capture, check"] = found = attempt(lambda: recover(device))
    print(f"a failed capture, check: {json.dumps(found)}", flush=True)
    if options.json:
        options.json.write_text(json.dumps(results, indent=1))
    rows = [row for row in results.values() if isinstance(row, dict)]
    return 0 if all(row.get("passed", True) and "error" not in row for row in rows) else 1


if __name__ == "__main__":
    sys.exit(main())
