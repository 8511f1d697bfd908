"""Environments in the forms that other libraries expect: Gymnasium's and skrl's."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from .environment import Env


def _spaces(env: Env) -> tuple[Any, Any]:
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


def make_vector(env: Env, tensors: bool = False) -> Any:
    """Return a ``gymnasium.vector.VectorEnv``; see :func:`warp_spo.env.gymnasium`."""
    from gymnasium.vector import AutoresetMode, VectorEnv
    from gymnasium.vector.utils import batch_space

    class VectorWorlds(VectorEnv):
        """All worlds of an ``Env``; a world whose episode ends starts anew in the same step."""

        metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

        def __init__(self) -> None:
            self.env, self.num_envs = env, env.num_envs
            self.single_observation_space, self.single_action_space = _spaces(env)
            self.observation_space = batch_space(self.single_observation_space, env.num_envs)
            self.action_space = batch_space(self.single_action_space, env.num_envs)

        def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
            """Start all worlds anew, or those of ``options["reset_mask"]``, with a new seed if one is given."""
            super().reset(seed=seed)
            mask = None if options is None else options.get("reset_mask")
            if seed is not None:
                env.set_seed(seed)
            observed, info = env.reset(None if mask is None else torch.as_tensor(mask))
            return _plain(env, observed, tensors), info

        def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict]:
            """Take a step; in the information, "log" and, where the environment has them, "final_obs"."""
            given = torch.as_tensor(np.asarray(actions, dtype=np.float32) if not tensors else actions)
            observed, rewards, done, extras = env.step(given.to(env.device))
            late = extras["time_outs"].bool()
            ended = done.bool() & ~late
            info: dict[str, Any] = {key: value for key, value in extras.items() if key == "log"}
            if "final_observations" in extras:
                info["final_obs"] = _plain(env, extras["final_observations"], tensors)
                info["_final_obs"] = done.bool() if tensors else done.bool().cpu().numpy()
            parts = (rewards, ended, late)
            plain = parts if tensors else tuple(part.cpu().numpy() for part in parts)
            return _plain(env, observed, tensors), *plain, info

    return VectorWorlds()


def make_single(env: Env) -> Any:
    """Return a ``gymnasium.Env`` of the one world of ``env``; see :func:`warp_spo.env.gymnasium`."""
    import gymnasium

    if env.num_envs != 1 or not env.final:
        raise ValueError(
            f"env.gymnasium: single=True with {env.num_envs} worlds and final_observations={env.final}; expected "
            f"Env(scene, worlds=1, final_observations=True, ...)"
        )

    class SingleWorldEnv(gymnasium.Env):
        """One world; it stays where its episode ended until it is reset."""

        metadata = {"render_modes": []}  # noqa: RUF012

        def __init__(self) -> None:
            self.env = env
            self.observation_space, self.action_space = _spaces(env)

        def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[Any, dict]:
            """Start anew."""
            super().reset(seed=seed)
            if seed is not None:
                env.set_seed(seed)
            return self._first(env.reset()[0]), {}

        def step(self, action: Any) -> tuple[Any, float, bool, bool, dict]:
            """Take a step."""
            given = torch.as_tensor(np.asarray(action, dtype=np.float32))[None].to(env.device)
            _, rewards, done, extras = env.step(given)
            late = bool(extras["time_outs"][0])
            observed = self._first(extras["final_observations"])
            return observed, float(rewards[0]), bool(done[0]) and not late, late, {}

        @staticmethod
        def _first(observed: Any) -> Any:
            found = _plain(env, observed, False)
            return {name: x[0] for name, x in found.items()} if isinstance(found, dict) else found[0]

    return SingleWorldEnv()


def make_skrl(env: Env, observations: str | None = None, states: str | None = None) -> Any:
    """Return a wrapper of skrl; see :func:`warp_spo.env.skrl`."""
    from skrl.envs.wrappers.torch import Wrapper

    groups = list(env.num_obs)
    own = observations or groups[0]
    whole = states or (groups[1] if len(groups) > 1 and observations is None else None)
    for name in (own, whole):
        if name is not None and name not in groups:
            raise ValueError(f"env.skrl: unknown group {name!r}; expected one of {', '.join(groups)}")
    box = _spaces(env)[1]

    class SkrlWorlds(Wrapper):
        """All worlds of an ``Env``."""

        def __init__(self) -> None:
            super().__init__(env)
            self._seen = env.get_observations()

        @property
        def observation_space(self) -> Any:
            return self._space(own)

        @property
        def state_space(self) -> Any:
            return self._space(whole)

        @property
        def action_space(self) -> Any:
            return box

        @staticmethod
        def _space(group: str | None) -> Any:
            return None if group is None else type(box)(-np.inf, np.inf, (env.num_obs[group],), np.float32)

        def reset(self) -> tuple[Any, dict]:
            """Return the present observations; worlds start anew by themselves."""
            return self._seen[own], {}

        def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Any]:
            """Take a step."""
            self._seen, rewards, done, extras = env.step(actions)
            late = extras["time_outs"].bool()
            ends = (done.bool() & ~late, late)
            return self._seen[own], rewards.view(-1, 1), *(each.view(-1, 1) for each in ends), extras

        def state(self) -> Any:
            """Return the observations of the group ``states``; None without one."""
            return None if whole is None else self._seen[whole]

        def render(self, *_: Any, **__: Any) -> Any:
            """Do nothing."""

        def close(self) -> None:
            """Do nothing."""

    return SkrlWorlds()
