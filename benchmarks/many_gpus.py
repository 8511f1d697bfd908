"""Environments on several GPUs: env-steps/s at constant worlds a GPU, and whether a course depends on the place.

    python -m benchmarks.many_gpus [--task go2-flat] [--devices cuda:0 cuda:1] [--worlds 4096] [--json FILE]

One process a device, as training has it. Actions are a function of the number of the world in the whole run and of the
step. First the first device runs alone, then all at once; then one device runs the worlds of all.
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import torch
import torch.multiprocessing as processes
import warp as wp

from . import command_line

CHECKED, TIMED, WARM = 50, 400, 50  # steps whose states are compared; steps that are timed; steps before
PATIENCE = 300.0  # s


def act(step: int, numbers: torch.Tensor, actions: int) -> torch.Tensor:
    """Return actions [world, action] in a step for worlds by their numbers in the whole run."""
    phase = 0.37 * numbers[:, None] + 0.11 * step + torch.arange(actions, device=numbers.device)
    return torch.sin(phase.remainder(6.2831853)).float()


def run(place: int, task: str, device: str, first: int, worlds: int, barrier: Any, found: Any) -> None:
    """Put into ``found``: place, the state after CHECKED steps, and env-steps/s."""
    from warp_spo.env import make

    wp.config.log_level = wp.LOG_WARNING
    env = make(task, worlds=worlds, device=device, first_world=first)
    numbers = torch.arange(first, first + worlds, device=device)

    def wait() -> None:
        if env.device.type == "cuda":
            torch.cuda.synchronize(env.device)

    for step in range(CHECKED):
        observed = env.step(act(step, numbers, env.num_actions))[0]
    state = torch.cat([observed[name] for name in sorted(observed.keys())], 1).cpu().numpy()
    actions = [act(step, numbers, env.num_actions) for step in range(4)]
    timed = TIMED if env.device.type == "cuda" else 20
    for step in range(min(WARM, timed)):
        env.step(actions[step % 4])
    wait()
    barrier.wait(PATIENCE)
    begin = time.perf_counter()
    for step in range(timed):
        env.step(actions[step % 4])
    wait()
    found.put((place, state, timed * worlds / (time.perf_counter() - begin)))


def together(task: str, devices: list[str], worlds: int) -> list[tuple]:
    """Run each device in a process of its own, at once; return what they found, by place."""
    context = processes.get_context("spawn")
    barrier, found = context.Barrier(len(devices)), context.Queue()
    started = [
        context.Process(target=run, args=(k, task, device, k * worlds, worlds, barrier, found))
        for k, device in enumerate(devices)
    ]
    for process in started:
        process.start()
    results = sorted((found.get(timeout=PATIENCE) for _ in started), key=lambda result: result[0])
    for process in started:
        process.join()
    return results


def main(arguments: list[str] | None = None) -> int:
    parser = command_line.parser("many_gpus", __doc__, device=False)
    parser.add_argument("--task", default="go2-flat")
    parser.add_argument("--devices", nargs="+", default=["cuda:0", "cuda:1"])
    parser.add_argument("--worlds", type=int, default=4096, help="of each device")
    options = parser.parse_args(arguments)
    devices, worlds = options.devices, options.worlds
    (alone,) = together(options.task, devices[:1], worlds)
    shared = together(options.task, devices, worlds)
    (whole,) = together(options.task, devices[:1], worlds * len(devices))
    same = [bool((state == whole[1][k * worlds : (k + 1) * worlds]).all()) for k, state, _ in shared]
    rates = [rate for _, _, rate in shared]
    row = dict(
        task=options.task, devices=len(devices), worlds=worlds, alone=alone[2], together=rates,
        factor=sum(rates) / alone[2], same=same,
    )  # fmt: skip
    print(json.dumps(row), flush=True)
    if options.json:
        options.json.write_text(json.dumps(row, indent=1))
    return 0 if all(same) else 1


if __name__ == "__main__":
    sys.exit(main())
