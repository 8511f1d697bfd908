"""Measures of a policy: what the tasks ask for, over whole episodes of many worlds."""

from __future__ import annotations

import contextlib
import math
from collections.abc import Callable, Iterator
from typing import Any

import torch

from .commands import HELD
from .compile.guard import BEYOND, NOT_FINITE
from .compile.memory_layout import count_steps
from .environment import Env

Policy = Callable[[Any], torch.Tensor]
Read = Callable[[Env], torch.Tensor]


@contextlib.contextmanager
def hold(env: Env, command: Any) -> Iterator[None]:
    """Hold a command in all worlds, as long as the context lasts; for None do nothing."""
    if command is None:
        yield
        return
    held, before = env.memory(HELD).clone(), env.command.clone()
    env.command = torch.tensor(command, dtype=torch.float32, device=env.device)
    try:
        yield
    finally:
        env.command = torch.where(held > 0.5, before, env.command)
        env.memory(HELD).copy_(held)


def roll(env: Env, policy: Policy, steps: int, read: dict[str, Read], command: Any = None) -> dict[str, torch.Tensor]:
    """Start all worlds anew, and return what ``read`` returns after each step, [step, world, ...] by name.

    ``valid`` [step, world]: whether the world's first episode still goes on; ``ended`` [world]: whether it has ended by
    a termination, not by its length. Values read after the step that ends an episode belong to the next one.
    ``command``: held in all observations; None: the environment's own.
    """
    found: dict[str, list[torch.Tensor]] = {name: [] for name in ("valid", *read)}
    with hold(env, command):
        observed, _ = env.reset()
        env.episode_length_buf = torch.zeros_like(env.episode_length_buf)
        alive = torch.ones(env.num_envs, dtype=torch.bool, device=env.device)
        ended = torch.zeros_like(alive)
        for _ in range(steps):
            observed, _, done, extras = env.step(policy(observed))
            over = done > 0
            ended |= alive & over & (extras["time_outs"] < 0.5)
            alive &= ~over
            found["valid"].append(alive.clone())
            for name, function in read.items():
                found[name].append(function(env).clone())
    return {name: torch.stack(values) for name, values in found.items()} | {"ended": ended}


def mean(values: torch.Tensor, valid: torch.Tensor) -> float:
    """Return the mean of the values that are valid."""
    return float((values * valid).sum() / valid.sum().clamp(min=1))


def episodes(env: Env, policy: Policy) -> dict[str, float]:
    """Return the means of rewards, ends and lengths [s] over an episode of each world, as the log of a training has.

    Of what is not finite or beyond bounds, those terms that had any.
    """
    observed, _ = env.reset(seed=env.seed)
    for _ in range(env.max_episode_length):
        observed, *_ = env.step(policy(observed))
    found = {name.lstrip("/"): float(value) for name, value in env.log().items()}
    counted = lambda name: name.split("/")[0] in (NOT_FINITE, BEYOND)  # noqa: E731
    return {"worlds": env.num_envs} | {name: x for name, x in found.items() if x or not counted(name)}


def balance(env: Env, policy: Policy) -> dict[str, float]:
    """Return how many worlds hold the pole within 0.1 rad for 90 % of an episode's last 5 s, and the least share."""
    steps = env.max_episode_length - 1
    found = roll(env, policy, steps, {"angle": lambda env: env.q[:, 1]})
    last = count_steps(5.0, env.step_dt)
    angle = torch.remainder(found["angle"][-last:] + torch.pi, 2 * torch.pi) - torch.pi
    share = ((angle.abs() < 0.1) & found["valid"][-last:]).float().mean(dim=0)
    return {"worlds": env.num_envs, "upright": int((share >= 0.9).sum()), "least share": float(share.min())}


def speed(env: Env, policy: Policy) -> dict[str, float]:
    """Return the mean velocity along x [m/s] over episodes, and the share that ends early."""
    found = roll(env, policy, env.max_episode_length - 1, {"speed": lambda env: env.qd[:, 0]})
    return {"worlds": env.num_envs, "speed": mean(found["speed"], found["valid"]),
            "early ends": float(found["ended"].float().mean())}  # fmt: skip


def reach(env: Env, policy: Policy, frame: str) -> dict[str, float]:
    """Return the share of places that a frame has reached within 1 cm when the next is named, and errors [m].

    Places of the first episode of each world are counted, but the last, which no other follows.
    """
    pose = lambda env: env.dyn.frame_poses(env.q, [frame])[:, 0, :3]  # noqa: E731
    read = {"error": lambda env: (pose(env) - env.command).norm(dim=1), "command": lambda env: env.command}
    found = roll(env, policy, env.max_episode_length - 1, read)
    changes = (found["command"][1:] != found["command"][:-1]).any(dim=2) & found["valid"][1:]
    if not changes.any():
        return {"places": 0, "within 1 cm": math.nan, "median error": math.nan, "95 % error": math.nan}
    last = found["error"][:-1][changes]
    return {"places": int(changes.sum()), "within 1 cm": float((last < 0.01).float().mean()),
            "median error": float(last.median()), "95 % error": float(last.quantile(0.95))}  # fmt: skip


def tracking(env: Env, policy: Policy, seconds: float = 20.0, command: Any = None) -> dict[str, float]:
    """Return how well the base follows the velocities of the command, over the first episode of each world.

    Args:
        seconds: length of the rollout [s].
        command: the velocities forward and to the left [m/s], and the rate of turning [rad/s]; None: the environment's.

    Returns:
        Means over steps and worlds: the error of the horizontal velocity [m/s], that of the rate of turning [rad/s],
        the velocity forward [m/s] and the height of the base [m]. "falls" is the share of worlds that any termination
        ended.
    """
    wanted = lambda env: env.command.clone()  # noqa: E731
    read = {"rates": base_rates, "wanted": wanted, "height": lambda env: env.q[:, 2]}
    found = roll(env, policy, count_steps(seconds, env.step_dt) - 1, read, command)
    error, valid = found["rates"] - found["wanted"], found["valid"]
    return {
        "worlds": env.num_envs,
        "velocity error": mean(error[..., :2].norm(dim=2), valid),
        "turning error": mean(error[..., 2].abs(), valid),
        "forward": mean(found["rates"][..., 0], valid),
        "falls": float(found["ended"].float().mean()),
        "height": mean(found["height"], valid),
    }


def climb(env: Env, policy: Policy, seconds: float = 15.0, way: float = 3.2) -> dict[str, float]:
    """Return the share of worlds whose base comes ``way`` [m] away from its start, higher up, on its feet."""
    start: list[torch.Tensor] = []

    def place(env: Env) -> torch.Tensor:
        start.append(env.q[:, :3].clone())
        return (env.q[:, :3] - start[0])[:, :3]

    found = roll(env, policy, count_steps(seconds, env.step_dt), {"place": place})
    far = (found["place"][..., :2].norm(dim=2) > way) & (found["place"][..., 2] > 0.2) & found["valid"]
    return {"worlds": env.num_envs, "climbed": float(far.any(dim=0).float().mean())}


def base_rates(env: Env) -> torch.Tensor:
    """Return the base's velocity forward and to the left [m/s], and its rate of turning [rad/s], its axes [world, 3].

    The velocity is that of the base's centre of mass.
    """
    q, qd = env.q, env.qd
    u, w = q[:, 3:6], q[:, 6:7]
    back = lambda v: v - 2.0 * w * torch.linalg.cross(u, v) + 2.0 * torch.linalg.cross(u, torch.linalg.cross(u, v))  # noqa: E731
    return torch.cat([back(qd[:, :3])[:, :2], back(qd[:, 3:6])[:, 2:]], dim=1)
