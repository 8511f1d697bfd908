"""Environments in the forms that other libraries expect: Gymnasium's and skrl's."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ..errors import shown
from . import arguments, checkpoint
from .environment import Env


def spaces_of(env: Env) -> tuple[Any, Any]:
    """Return Gymnasium's spaces of one world: observations, actions."""
    from gymnasium import spaces

    box = lambda size: spaces.Box(-np.inf, np.inf, (size,), np.float32)  # noqa: E731
    groups: dict[str, spaces.Space] = {name: box(size) for name, size in env.num_obs.items()}
    observed = spaces.Dict(groups) if len(groups) > 1 else next(iter(groups.values()))
    return observed, spaces.Box(-1.0, 1.0, (env.num_actions,), np.float32)


def _plain(env: Env, observed: Any, tensors: bool) -> Any:
    """Return observations as a dictionary by group, or as those of the only group."""
    groups = {name: observed[name] if tensors else observed[name].cpu().numpy() for name in env.num_obs}
    return groups if len(groups) > 1 else next(iter(groups.values()))


def make_vector(env: Env, tensors: bool = False, autoreset_mode: Any = "SameStep") -> Any:
    """Return a ``gymnasium.vector.VectorEnv``; see :func:`warp_spo.env.gymnasium`."""
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space

    try:
        mode = AutoresetMode(autoreset_mode)
    except ValueError:
        names = ", ".join(repr(each.value) for each in AutoresetMode)
        raise ValueError(f"env.gymnasium: autoreset_mode is {autoreset_mode!r}; expected one of {names}") from None
    if mode is not AutoresetMode.SAME_STEP and not env.final:
        raise ValueError(
            f"env.gymnasium: autoreset_mode={mode.value!r} with final_observations=False; the step that ends an "
            "episode returns its last observation: expected Env(..., final_observations=True)"
        )

    nobody = torch.zeros(0, dtype=torch.int64)

    class VectorWorlds(VectorEnv):
        """All worlds of an ``Env``, whose episodes are the same to the bit in all autoreset modes.

        The ``Env`` starts a world anew in the step that ends its episode. In other modes than SAME_STEP its last
        observation is shown until Gymnasium's time of the reset: a world that waits is set back to its start after
        steps of the others.
        """

        metadata = {"autoreset_mode": mode, "render_modes": []}  # noqa: RUF012

        def __init__(self) -> None:
            self.env, self.num_envs = env, env.num_envs
            self.single_observation_space, self.single_action_space = spaces_of(env)
            self.observation_space = batch_space(self.single_observation_space, env.num_envs)
            self.action_space = batch_space(self.single_action_space, env.num_envs)
            self._waiting = torch.zeros(env.num_envs, dtype=torch.bool, device=env.device)  # none in SAME_STEP
            self._last: Any = None  # observations of the step before, of which those of worlds that wait are shown

        def reset(self, *, seed: Any = None, options: dict | None = None) -> tuple[Any, dict]:
            """Start all worlds anew, or those of ``options["reset_mask"]``; a seed makes a new environment of all.

            Args:
                seed: None, or a seed as ``Env.reset`` takes it: of all worlds, or a list with one of each.
                options: None, or a dictionary, of which "reset_mask", bool [world], is read.
            """
            mask = None if options is None else options.get("reset_mask")
            if seed is not None or mask is None:
                env.reset(mask, seed)
                self._waiting = torch.zeros_like(self._waiting)
            else:
                mask = arguments.check_mask("reset: options['reset_mask']", mask, env.num_envs, env.device)
                env.reset(mask & ~self._waiting)  # those that wait have started anew
                self._waiting = self._waiting & ~mask
            if not isinstance(seed, list | tuple | np.ndarray):
                super().reset(seed=None if seed is None else int(seed))
            return _plain(env, self._choose_observations(env.get_observations()), tensors), {}

        def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict]:
            """Take a step; "log" and, in the mode SAME_STEP, "final_obs" are in the information, [world]."""
            given = torch.as_tensor(np.asarray(actions, dtype=np.float32) if not tensors else actions)
            waiting = self._waiting.nonzero()[:, 0] if mode is not AutoresetMode.SAME_STEP else nobody
            if len(waiting) and mode is AutoresetMode.DISABLED:
                raise RuntimeError(
                    f"step: autoreset_mode is 'Disabled' and episodes of worlds {waiting.tolist()} have ended; "
                    "expected reset(options={'reset_mask': terminated | truncated}) before the next step"
                )
            copies, given = checkpoint.copy_worlds(env, waiting) if len(waiting) else {}, given.to(env.device)
            if len(waiting) and given.shape == (env.num_envs, env.num_actions):
                given = given.clone()
                given[waiting] = 0.0  # taken back; other actions might fail, and leave files of failures
            observed, rewards, done, extras = env.step(given)
            ends, late = done.bool(), extras["time_outs"].bool()
            log = extras.get("log", {})
            if len(waiting):
                checkpoint.restore_worlds(env, waiting, copies)
                observed, log = env.get_observations(), env.log() if log else {}
                ends[waiting], late[waiting], rewards[waiting] = False, False, 0.0
            info = {"log": _by_world(log, env.num_envs, tensors)} if log else {}
            if mode is not AutoresetMode.SAME_STEP:
                self._waiting, self._last = ends, extras["final_observations"]
            elif env.final:
                info |= _final(env, extras["final_observations"], ends, tensors)
            parts = (rewards, ends & ~late, late)
            plain = parts if tensors else tuple(part.cpu().numpy() for part in parts)
            return _plain(env, self._choose_observations(observed), tensors), *plain, info

        def _choose_observations(self, observed: Any) -> Any:
            """Return observations, the last ones of their episode in worlds that wait."""
            if self._last is None:
                return observed
            waits = self._waiting[:, None]
            return {name: torch.where(waits, self._last[name], observed[name]) for name in env.num_obs}

    return VectorWorlds()


def _by_world(log: dict[str, torch.Tensor], worlds: int, tensors: bool) -> dict[str, Any]:
    """Return a log, one number for all worlds, as Gymnasium's information: arrays [world] of equal numbers."""
    if tensors:
        return {name: value.repeat(worlds) for name, value in log.items()}
    values = torch.stack([*log.values()]).cpu().numpy()
    return {name: np.full(worlds, value) for name, value in zip(log, values, strict=True)}


def _final(env: Env, observed: Any, ends: torch.Tensor, tensors: bool) -> dict[str, Any]:
    """Return the information on last observations: arrays of all worlds as tensors, else Gymnasium's array of objects.

    That one has the observation of a world where its episode ended and None elsewhere; it is left out if none ended.
    """
    found = _plain(env, observed, tensors)
    if tensors:
        return {"final_obs": found, "_final_obs": ends}
    held, own = ends.cpu().numpy(), np.full(env.num_envs, None, dtype=object)
    for world in np.flatnonzero(held):
        own[world] = _of_world(found, world)
    return {"final_obs": own, "_final_obs": held} if held.any() else {}


def _of_world(found: Any, world: Any) -> Any:
    """Return one world's observation of those of all, by group or of the only one."""
    return {name: x[world] for name, x in found.items()} if isinstance(found, dict) else found[world]


def make_single(env: Env, tensors: bool = False, autoreset_mode: Any = "SameStep") -> Any:
    """Return a ``gymnasium.Env`` of the one world of ``env``; see :func:`warp_spo.env.gymnasium`."""
    import gymnasium

    if tensors or getattr(autoreset_mode, "value", autoreset_mode) != "SameStep":
        raise ValueError(
            f"env.gymnasium: single=True with tensors={tensors!r} and autoreset_mode={autoreset_mode!r}; expected "
            "neither: one world has NumPy arrays, and waits for reset()"
        )
    if env.num_envs != 1 or not env.final:
        raise ValueError(
            f"env.gymnasium: single=True with {env.num_envs} worlds and final_observations={env.final}; expected "
            f"Env(scene, worlds=1, final_observations=True, ...)"
        )

    class SingleWorldEnv(gymnasium.Env):
        """One world; after the end of its episode it waits for ``reset``."""

        metadata = {"render_modes": []}  # noqa: RUF012

        def __init__(self) -> None:
            self.env, self._ended = env, False
            self.observation_space, self.action_space = spaces_of(env)

        def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
            """Start anew; with a seed as a new environment of that seed."""
            super().reset(seed=seed)
            if seed is not None or not self._ended:  # otherwise the world has started anew
                env.reset(seed=seed)
            self._ended = False
            return _of_world(_plain(env, env.get_observations(), False), 0), {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
            """Take a step; "log" is in the information now and then.

            Raises:
                RuntimeError: the episode has ended, and the world waits for :meth:`reset`.
            """
            if self._ended:
                raise RuntimeError("step: the episode has ended; expected reset() before the next step")
            given = torch.as_tensor(np.asarray(action, dtype=np.float32))[None].to(env.device)
            observed, rewards, done, extras = env.step(given)
            late, self._ended = bool(extras["time_outs"][0]), bool(done[0])
            seen = _of_world(_plain(env, extras["final_observations"] if self._ended else observed, False), 0)
            log = {name: float(value) for name, value in extras.get("log", {}).items()}
            return seen, float(rewards[0]), self._ended and not late, late, {"log": log} if log else {}

    return SingleWorldEnv()


def make_skrl(env: Env, observations: str | None = None, states: str | None = None) -> Any:
    """Return a wrapper of skrl; see :func:`warp_spo.env.skrl`."""
    from skrl.envs.wrappers.torch import Wrapper

    groups = list(env.num_obs)
    policy_group = observations or groups[0]
    critic_group = states or (groups[1] if len(groups) > 1 and observations is None else None)
    for name in (policy_group, critic_group):
        if name is not None and name not in groups:
            raise ValueError(f"env.skrl: unknown group {name!r}; expected one of {', '.join(map(shown, groups))}")
    box = spaces_of(env)[1]

    class SkrlWorlds(Wrapper):
        """All worlds of an ``Env``."""

        def __init__(self) -> None:
            super().__init__(env)
            self._seen = env.get_observations()

        @property
        def observation_space(self) -> Any:
            return self._space(policy_group)

        @property
        def state_space(self) -> Any:
            return self._space(critic_group)

        @property
        def action_space(self) -> Any:
            return box

        @staticmethod
        def _space(group: str | None) -> Any:
            return None if group is None else type(box)(-np.inf, np.inf, (env.num_obs[group],), np.float32)

        def reset(self) -> tuple[Any, dict]:
            """Return the present observations; worlds start anew by themselves."""
            return self._seen[policy_group], {}

        def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Any]:
            """Take a step."""
            self._seen, rewards, done, extras = env.step(actions)
            timed_out = extras["time_outs"].bool()
            ends = (done.bool() & ~timed_out, timed_out)
            return self._seen[policy_group], rewards.view(-1, 1), *(each.view(-1, 1) for each in ends), extras

        def state(self) -> Any:
            """Return the observations of the group ``states``; None without one."""
            return None if critic_group is None else self._seen[critic_group]

        def render(self, *_: Any, **__: Any) -> Any:
            """Do nothing."""

        def close(self) -> None:
            """Do nothing."""

    return SkrlWorlds()
