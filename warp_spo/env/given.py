"""What an environment is given, checked: groups of observations, rewards, terminations, events, actions."""

from __future__ import annotations

from typing import Any

import torch

from .checks import check_function, check_mapping, check_number
from .observations import Observation
from .tracing import NOT_FINITE

RESULTS = ("reward", "done", "time_out")


def checked_terms(
    observations: Any, rewards: Any, terminations: Any, events: Any
) -> tuple[dict[str, list[Observation]], dict[str, tuple[float, Any]], dict[str, Any]]:
    """Return observations, rewards and terminations by name; ValueError and TypeError as :class:`Env` says."""
    groups = check_mapping("Env", "observations", observations, "lists of terms")
    if not groups:
        raise ValueError("Env: observations is {}; expected a list of terms for each group")
    for name, terms in groups.items():
        if not isinstance(terms, list | tuple) or not terms:
            raise TypeError(f"Env: observations[{name!r}] is {terms!r}; expected a list of terms for each group")
        if name in RESULTS or name.startswith("final "):
            raise ValueError(
                f"Env: observations has a group {name!r}, which names another result; expected another name"
            )
        groups[name] = [term if isinstance(term, Observation) else Observation(term) for term in terms]
    rewards = check_mapping("Env", "rewards", rewards, "pairs (weight, term)")
    for name, reward in rewards.items():
        if not isinstance(reward, tuple | list) or len(reward) != 2 or not callable(reward[1]):
            raise TypeError(f"Env: rewards[{name!r}] is {reward!r}; expected (weight, term)")
        check_number("Env", f"the weight of rewards[{name!r}]", reward[0])
    terminations = check_mapping("Env", "terminations", terminations, "terms")
    for name, term in terminations.items():
        check_function("Env", f"terminations[{name!r}]", term)
        if name == NOT_FINITE:
            raise ValueError(f"Env: terminations has {name!r}, which every environment has; expected another name")
    if not isinstance(events, list | tuple):
        raise TypeError(f"Env: events is {events!r}; expected a list of those of warp_spo.env.events")
    return groups, rewards, terminations


def checked_actions(call: str, actions: Any, worlds: int, labels: list[str]) -> torch.Tensor:
    """Return actions [world, action] as a tensor; TypeError and ValueError for what is none."""
    try:
        given = torch.as_tensor(actions)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{call}: actions is {type(actions).__name__}; expected a tensor or an array") from None
    if tuple(given.shape) != (worlds, len(labels)) or given.is_complex():
        kind = "complex numbers of " if given.is_complex() else ""
        raise ValueError(
            f"{call}: actions has {kind}shape {tuple(given.shape)}; expected ({worlds}, {len(labels)}) "
            f"[world, action]: {', '.join(labels)}"
        )
    return given


def checked_mask(call: str, mask: Any, worlds: int, device: torch.device) -> torch.Tensor:
    """Return a mask of worlds as a tensor on the device; ValueError for what is none."""
    try:
        found = torch.as_tensor(mask, device=device)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{call}: mask is {mask!r}; expected bool ({worlds},) [world]") from None
    if found.shape != (worlds,) or found.dtype != torch.bool:
        raise ValueError(f"{call}: mask is {found.dtype} {tuple(found.shape)}; expected bool ({worlds},) [world]")
    return found


def checked_lengths(call: str, value: Any, worlds: int) -> torch.Tensor:
    """Return steps since the starts of episodes, one for all worlds or one each; ValueError for what is none."""
    found = torch.as_tensor(value)
    if found.shape not in ((), (worlds,)):
        raise ValueError(f"{call}: got shape {tuple(found.shape)}; expected ({worlds},) [world]")
    return found
