"""Logs of an environment: means over finished episodes, counts of bad numbers, and the parts of a step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from ..errors import shown
from .compile.fused_kernel import Launch
from .compile.memory_layout import MemoryLayout

if TYPE_CHECKING:
    from .environment import Env


class Log:
    """Reads the worlds' memory, without waiting for the device.

    Means are over the worlds' last finished episodes, zero where there are none. "/episode/finished" is the number of
    worlds that have finished one, "/episode/whole" of those whose length counts: not where ``episode_length_buf`` was
    written. "/metric/NAME" is the mean over an episode's steps in which it was finite, of worlds where there was one.
    "/not finite/" and "/beyond bounds/" count what ended worlds, by kind (action, state, reward, observation) and by
    name, such as "/not finite/reward/alive".

    Args:
        layout: where the memory is. rewards, ends: names. device: of the memory. worlds: their number.

    Attributes:
        cut: number of the episode of each world whose age was written, 0 where none was [world].
    """

    def __init__(self, layout: MemoryLayout, rewards: list[str], ends: list[str], device: torch.device, worlds: int):
        means = {f"/reward/{name}": f"last reward {name}" for name in rewards}
        means |= {f"/termination/{name}": f"last end {name}" for name in ends}
        means |= {f"/metric/{name}": f"last metric {name}" for name in layout.metrics}
        means["/episode/seconds"] = "last seconds"
        steps = [f"last steps of metric {name}" for name in layout.metrics]
        causes = [f"/{name}" for name in layout.guard.names]
        kinds = list(dict.fromkeys("/".join(name.split("/")[:3]) for name in causes))
        sums = [*kinds, *(name for name in causes if name not in kinds)]
        self._names = [*means, *sums, "/episode/finished", "/episode/whole"]
        self._means, self._episodes, self._steps = (
            torch.tensor([layout.memory[name][0] for name in names], dtype=torch.int64, device=device)
            for names in (means.values(), ["episodes"], steps)
        )
        belongs = [
            [float(cause == name or (name in kinds and cause.startswith(f"{name}/"))) for cause in causes]
            for name in sums
        ]
        self._belongs = torch.tensor(belongs, device=device)  # [count, cause]
        self.cut = torch.zeros(worlds, device=device)  # number of a world's episode whose age was written; 0: none

    def clear(self) -> None:
        """Let the current episodes of all worlds count in the report, also those whose ages were written."""
        self.cut.zero_()

    def write_ages(self, memory: torch.Tensor, written: torch.Tensor) -> None:
        """Leave the lengths of the episodes that now go on where ``written`` [world] holds out of the report."""
        self.cut.copy_(torch.where(written, memory[self._episodes][0] + 1.0, self.cut))

    def __call__(self, memory: torch.Tensor, faults: torch.Tensor) -> dict[str, torch.Tensor]:
        """Return the report for the memory [number, world] and what ended worlds [cause, world]."""
        episodes = memory[self._episodes][0]
        finished = (episodes > 0).float()
        whole = finished * (episodes != self.cut)
        rows, count = memory[self._means], len(self._steps)  # the last one is of lengths, those before of metrics
        means = [*(rows[: -1 - count] @ share(finished)).unbind()]
        for metric, steps in zip(rows[-1 - count : -1], memory[self._steps], strict=True):
            means.append(metric @ share(finished * (steps > 0.5)))
        means.append(rows[-1] @ share(whole))
        found = [*means, *(self._belongs @ faults.sum(dim=1)).unbind(), finished.sum(), whole.sum()]
        return dict(zip(self._names, found, strict=True))


def share(counted: torch.Tensor) -> torch.Tensor:
    """Return the weight of each world in a mean over those that count [world]; zeros where none does."""
    return counted / counted.sum().clamp(min=1.0)


def describe(env: Env) -> str:
    """Return the size of an environment in a line."""
    groups = ", ".join(f"{shown(name)} {size}" for name, size in env.num_obs.items())
    return f"Env({env.num_envs} worlds on {env.warp_device}, {env.num_actions} actions, observations: {groups})"


def bounds_in_words(limits: dict[str, Any]) -> list[str]:
    """Return bounds by cause in words: of all rewards one range, likewise of all observations."""
    found: dict[str, list[float]] = {}
    for cause, most in limits.items():
        kind, *rest = cause.split("/")
        found.setdefault(rest[0] if kind == "state" else kind, []).extend(np.ravel(most).tolist())
    ranges = ((kind, min(each), max(each)) for kind, each in found.items())
    return [f"{kind} {low:.3g}" + (f" to {high:.3g}" if high > low else "") for kind, low, high in ranges]


def explain(env: Env, stages: dict[str, list[Launch]], users: dict[Any, tuple[str, int]]) -> str:
    """Return what a step consists of, and what it takes in memory.

    Args:
        env: the environment. stages: its kernels, by stage. users: terms in torch, with the stage that reads them.
    """
    lines = [
        f"{env.num_envs} worlds on {env.warp_device}, {env.decimation} steps of {env.dt:g} s a step, "
        f"{env.max_episode_length} steps an episode",
        f"actions      {env.num_actions}: {', '.join(map(shown, env.action_labels))}",
        f"observations {', '.join(f'{shown(name)} {size}' for name, size in env.num_obs.items())}",
        f"rewards      {', '.join(map(shown, env.reward_names))}",
        *([f"metrics      {', '.join(map(shown, env._layout.metrics))}"] if env._layout.metrics else []),
        f"ends         {', '.join(map(shown, env.termination_names))}, after {env.max_episode_length} steps",
        f"bounds       {', '.join(bounds_in_words(env._layout.guard.limits))}",
        f"variable     {', '.join(env.values) or 'nothing'}",
        f"memory       {env.bytes_per_world} bytes a world",
    ]
    if env._failures is not None:
        lines.append(f"failures     {env._failures.describe()}")
    kernels = [(name, kernel) for name, some in stages.items() for kernel in some]
    parts = [f"{each.threads} threads a world, each" if each.threads else "a world," for _, each in kernels]
    lines += [f"{name:12} {part} {one.operations} operations" for (name, one), part in zip(kernels, parts, strict=True)]
    lines += [f"in torch     {shown(term.name)}, before {place}" for term, (place, _) in users.items()]
    return "\n".join(lines)
