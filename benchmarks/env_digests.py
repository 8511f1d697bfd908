"""Digests of what the tasks' environments compute on the CPU, so that a change can show that it left them alone.

    python -m benchmarks.env_digests [TASK ...] --json before.json     # at one commit
    python -m benchmarks.env_digests --compare before.json             # at another; exit code 1 where a task differs

Random actions drive 32 worlds for 120 steps, through resets, pushes and randomisation. A digest covers the bits of all
observations, rewards and ends of episodes from the first step on. Where digests are equal, a policy that was trained
before has the same environment now. They depend on the machine and on the versions of Warp and torch, so compare what
one machine computed.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from pathlib import Path

import torch

from warp_spo import env
from warp_spo.env.tasks import TASKS

WORLDS = 32
STEPS = 120
SEED = 5
SHOWN = (1, 5, 20, 60, STEPS)  # steps after which a digest is printed


def digests(task: str) -> list[str]:
    """Return the digests of a task after each of ``SHOWN`` steps."""
    environment = env.make(task, worlds=WORLDS, device="cpu", seed=SEED)
    generator = torch.Generator().manual_seed(SEED)
    bits = hashlib.sha256()
    found = []
    for step in range(1, STEPS + 1):
        actions = 0.7 * torch.randn(WORLDS, environment.num_actions, generator=generator)
        observations, rewards, dones, _ = environment.step(actions)
        for group in sorted(observations.keys()):
            bits.update(observations[group].numpy().tobytes())
        bits.update(rewards.numpy().tobytes())
        bits.update(dones.numpy().tobytes())
        if step in SHOWN:
            found.append(bits.hexdigest()[:16])
    return found


def compare(before: dict[str, list[str]], now: dict[str, list[str]]) -> list[str]:
    """Return a line for each task of both that differs."""
    lines = []
    for task in sorted({*before} & {*now}):
        unequal = (step for step, a, b in zip(SHOWN, before[task], now[task], strict=True) if a != b)
        if (first := next(unequal, None)) is not None:
            lines.append(f"{task} differs within its first {first} steps")
    return lines


def main(argv: list[str] | None = None) -> int:
    p = argparse.ArgumentParser(prog="python -m benchmarks.env_digests", description=__doc__,
                                formatter_class=argparse.RawDescriptionHelpFormatter)  # fmt: skip
    p.add_argument("tasks", nargs="*", metavar="TASK", help=f"some of {', '.join(TASKS)}; left out: all")
    p.add_argument("--json", type=Path, metavar="FILE", help="where the digests go")
    p.add_argument("--compare", type=Path, metavar="FILE", help="digests of another commit")
    options = p.parse_args(argv)
    if unknown := [task for task in options.tasks if task not in TASKS]:
        p.error(f"no task {', '.join(unknown)}; expected some of {', '.join(TASKS)}")
    before = json.loads(options.compare.read_text()) if options.compare else {}
    now = {task: digests(task) for task in options.tasks or before or TASKS}
    if options.json:
        options.json.write_text(json.dumps(now, indent=1) + "\n")
    if not before:
        print(json.dumps(now, indent=1))
        return 0
    lines = compare(before, now)
    print("\n".join(lines) or f"the same bits: {', '.join(task for task in now if task in before)}")
    return 1 if lines else 0


if __name__ == "__main__":
    sys.exit(main())
