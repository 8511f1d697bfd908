"""Episodes of a policy as a Minari data set: ``record``. It needs ``pip install "minari[hdf5]"``."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from .environment import Env
from .evaluation import Policy, hold
from .interfaces import spaces_of
from .validation import check_whole

ROWS = ("observations", "actions", "rewards", "terminations", "truncations")


def record(env: Env, policy: Policy, dataset_id: str, episodes: int, command: Any = None, **about: Any) -> Any:
    """Record whole episodes, and write them by Minari's own writer.

    All worlds start anew, and the first episodes of each world count, so that short ones are not more frequent than the
    policy makes them. An observation is an array, or a dictionary of arrays by group where there are several; that of
    an episode's end is the last one before the new start. ``env.final_observations`` makes it known.

    Args:
        env: the environment, made with ``final_observations=True``. policy: function from observations to actions.
        dataset_id: such as "go2/walk-v0", as ``minari.load_dataset`` takes it; its folder is Minari's.
        episodes: how many.
        command: held in all observations; None: the environment's own.
        about: ``algorithm_name``, ``author``, ``description``, ``data_format`` and others of
            ``minari.create_dataset_from_buffers``.

    Returns:
        The ``MinariDataset``, its episodes in order of each world's first ones, then the second ones.

    Raises:
        ValueError: the environment has no final observations, Minari refuses the name, or a data set of this name is
            there already; no episode is played then.
        ImportError: Minari is not installed.
    """
    try:
        import minari
        from minari.data_collector import EpisodeBuffer
        from minari.dataset.minari_dataset import parse_dataset_id
        from minari.storage.datasets_root_dir import get_dataset_path
    except ImportError:
        raise ImportError('datasets.record: minari is missing; pip install "minari[hdf5]"') from None

    check_whole("datasets.record", "episodes", episodes, 1)
    if not env.final:
        raise ValueError(
            "datasets.record: the environment has no final observations; expected Env(final_observations=True), "
            "without which the last observation of an episode is not known"
        )
    try:
        parse_dataset_id(dataset_id)
    except (ValueError, TypeError):  # TypeError: no text, or one without a version
        raise ValueError(
            f"datasets.record: dataset_id is {dataset_id!r}, which Minari refuses; expected NAME-vNUMBER, or "
            "NAMESPACE/NAME-vNUMBER, such as 'go2/walk-v0'"
        ) from None
    if get_dataset_path(dataset_id).exists():
        raise ValueError(
            f"datasets.record: Minari has a data set {dataset_id!r} already; expected another name, or the next version"
        )
    quota = -(-episodes // env.num_envs)  # of each world
    found: list[list[dict[str, Any]]] = [[] for _ in range(env.num_envs)]
    with hold(env, command):
        observed, _ = env.reset()
        env.episode_length_buf = torch.zeros_like(env.episode_length_buf)
        first = _rows(env, observed)
        open_ones = [_begin(first, world) for world in range(env.num_envs)]
        while any(len(done) < quota for done in found):
            actions = policy(observed)
            observed, rewards, done, extras = env.step(actions)
            last, seen = _rows(env, extras["final_observations"]), _rows(env, observed)
            columns = (actions, rewards, done > 0, extras["time_outs"] > 0.5)
            acted, earned, over, late = (x.detach().cpu().numpy() for x in columns)
            for world in range(env.num_envs):
                if len(found[world]) == quota:
                    continue
                rows = open_ones[world]
                for group, values in last.items():
                    rows["observations"][group].append(values[world].copy())
                ends = bool(over[world]), bool(late[world])
                for name, value in zip(ROWS[1:], (acted[world].copy(), float(earned[world]), ends[0] and not ends[1],
                                                  ends[1]), strict=True):  # fmt: skip
                    rows[name].append(value)
                if ends[0]:
                    found[world].append(rows)
                    open_ones[world] = _begin(seen, world)
    chosen = [found[world][number] for number in range(quota) for world in range(env.num_envs)][:episodes]
    buffers = [EpisodeBuffer(id=i, **{name: _stack(rows[name]) for name in ROWS}) for i, rows in enumerate(chosen)]
    observation_space, _ = spaces_of(env)
    return minari.create_dataset_from_buffers(
        dataset_id, buffers, observation_space=observation_space, action_space=_action_space(env), **about
    )


# -- inside --------------------------------------------------------------------------------------------------------
def _rows(env: Env, observed: Any) -> dict[str, np.ndarray]:
    """Return observations by group as arrays [world, number]."""
    return {name: observed[name].cpu().numpy() for name in env.num_obs}


def _begin(seen: dict[str, np.ndarray], world: int) -> dict[str, Any]:
    """Return the rows of an episode that begins with an observation."""
    rows: dict[str, Any] = {name: [] for name in ROWS}
    rows["observations"] = {group: [values[world].copy()] for group, values in seen.items()}
    return rows


def _stack(rows: Any) -> Any:
    """Return rows as an array; those of several groups as a dictionary of them, of one group as that."""
    if isinstance(rows, dict):
        groups = {name: np.array(values, dtype=np.float32) for name, values in rows.items()}
        return groups if len(groups) > 1 else next(iter(groups.values()))
    return np.array(rows, dtype=np.float32) if isinstance(rows[0], np.ndarray) else np.array(rows)


def _action_space(env: Env) -> Any:
    """Return the space of actions, which are unbounded, as a policy's numbers are; clips come later."""
    from gymnasium import spaces

    return spaces.Box(-np.inf, np.inf, (env.num_actions,), np.float32)
