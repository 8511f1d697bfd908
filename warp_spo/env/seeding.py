"""Seeds of an environment's random numbers: one of all worlds, or one of each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from .drawn_values import check_drawn
from .validation import check_whole

if TYPE_CHECKING:
    from .environment import Env

SEED_OF_SEEDS = 0x9E3779B97F4A7C15  # where each world has a seed of its own


def set_seed(self: Env, seed: int | Sequence[int]) -> None:
    """Set the seed of all later random numbers, 64 bits, or one of each world; what was drawn before stays.

    A world's numbers depend on its seed and on its own number alone. :meth:`reset` takes a seed, too, and draws anew
    what was drawn at the start.
    """
    _write(self, *_check_seeds("Env.set_seed", seed, self.num_envs))


def begin(env: Env, seed: Any) -> None:
    """Make all that steps change what it is before the first reset of a new environment; draw what is drawn once."""
    words = _check_seeds("Env.reset", seed, env.num_envs)
    env._store.clear()
    for part in env._actuator_state or ():
        part.zero_()
    env._log.clear()
    env._steps = 0
    _write(env, *words)
    env._launch("start")
    check_drawn(env.scene, env.values)
    env._set_values()


def _write(env: Env, seed: int, ticks: np.ndarray) -> None:
    """Set the key of random numbers and the steps of random numbers that worlds have behind them [world]."""
    env.seed = seed
    words = [seed & 0xFFFFFFFF, seed >> 32 & 0xFFFFFFFF, env.first_world]
    env._tensors["key"].copy_(torch.tensor(np.array(words, dtype=np.uint32).view(np.int32)))
    env._tensors["tick"].copy_(torch.tensor(ticks.view(np.int32)))
    if env._failures is not None:
        env._failures.restart(seed, env._steps)


def _check_seeds(call: str, seed: Any, worlds: int) -> tuple[int, np.ndarray]:
    """Return the seed of all worlds and the steps of random numbers that each has behind it, uint32 [world].

    One seed for all: no steps. One for each world: SEED_OF_SEEDS, and as many steps as a hash of the world's own seed
    says: Steele, Lea and Flood 2014, "Fast splittable pseudorandom number generators", mix64.
    """
    if not isinstance(seed, list | tuple | np.ndarray):
        return check_whole(call, "seed", seed, 0, 2**64 - 1), np.zeros(worlds, dtype=np.uint32)
    if len(seed) != worlds:
        raise ValueError(
            f"{call}: seed has {len(seed)} entries; expected one integer, or one of each of {worlds} worlds"
        )
    each = [check_whole(call, f"seed[{i}]", own, 0, 2**64 - 1) for i, own in enumerate(seed)]
    x = np.array(each, dtype=np.uint64) + np.uint64(SEED_OF_SEEDS)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB)):
        x = (x ^ x >> np.uint64(shift)) * np.uint64(factor)
    return SEED_OF_SEEDS, (x ^ x >> np.uint64(31)).astype(np.uint32)
