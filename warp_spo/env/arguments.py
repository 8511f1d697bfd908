"""Checks of an environment's arguments: its scene, actions, terms, events, and where episodes start."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from ..errors import UnsupportedError, is_bool, quoted, shown
from ..scene.scene import Scene
from .bounds import Bounds
from .compile.guard import BEYOND, NOT_FINITE
from .compile.memory_layout import count_steps
from .curricula import ends_of
from .observations import Observation, TorchTerm
from .validation import check_function, check_mapping, check_number, check_whole

INTEGERS = (torch.int64, torch.int32, torch.int16, torch.int8, torch.uint8)
RESULTS = ("reward", "done", "time_out")


def check_terms(
    observations: Any, rewards: Any, terminations: Any, metrics: Any, events: Any
) -> tuple[dict[str, list[Observation]], dict[str, tuple[Any, Any]], dict[str, Any], dict[str, Any]]:
    """Return observations, rewards, terminations and metrics by name; ValueError and TypeError as :class:`Env` says."""
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
        for weight in ends_of(reward[0]):
            check_number("Env", f"the weight of rewards[{name!r}]", weight)
    terminations = check_mapping("Env", "terminations", terminations, "terms")
    for name, term in terminations.items():
        check_function("Env", f"terminations[{name!r}]", term)
        if name in (NOT_FINITE, BEYOND):
            raise ValueError(f"Env: terminations has {name!r}, which every environment has; expected another name")
    metrics = check_mapping("Env", "metrics", metrics, "terms")
    for name, term in metrics.items():
        check_function("Env", f"metrics[{name!r}]", term)
    if not isinstance(events, list | tuple):
        raise TypeError(f"Env: events is {events!r}; expected a list of those of warp_spo.env.events")
    return groups, rewards, terminations, metrics


def check_scene(scene: Any) -> Scene:
    """Return a scene; TypeError for anything else, UnsupportedError for one with closed loops or couplings."""
    if not isinstance(scene, Scene):
        raise TypeError(f"Env: scene is {type(scene).__name__}; expected spo.Scene")
    if scene.constraint_summary:
        way_out = (
            "pass scene.without_loops(), and hold followers by drives, as the page on closed loops says; "
            "spo.Dynamics(scene, loops=...) closes them outside of environments"
        )
        raise UnsupportedError("Env", f"a scene with {scene.constraint_summary}", way_out)
    return scene


def check_times(dt: Any, decimation: Any, episode_length_s: Any) -> tuple[float, int, int]:
    """Return the length of a step of the dynamics [s], their number in a step, and the steps of an episode."""
    steps = check_whole("Env", "decimation", decimation, 1)
    for name, value in (("dt", dt), ("episode_length_s", episode_length_s)):
        if check_number("Env", name, value) <= 0.0:
            raise ValueError(f"Env: {name} is {value!r} s; expected more than zero")
    return float(dt), steps, count_steps(episode_length_s, float(dt) * steps)


def check_default(scene: Scene, default_q: Any) -> np.ndarray:
    """Return the coordinates that episodes start from [coordinate]; the scene's initial ones for None."""
    default = np.asarray(scene.initial_q if default_q is None else default_q, dtype=np.float64)
    if default.shape != (scene.coord_count,):
        raise ValueError(f"Env: default_q has shape {default.shape}; expected ({scene.coord_count},) [coordinate]")
    if not np.isfinite(default).all():
        raise ValueError(f"Env: default_q is {default.tolist()}; expected finite numbers")
    return default


def check_passes(scene: Scene, passes: Any) -> int | None:
    """Return the passes of a step, None as given; ValueError for no whole number, or for a scene without contacts."""
    if passes is not None and not scene.contacts:
        raise ValueError(f"Env: passes is {passes!r}, and the scene has no contacts; expected None")
    return None if passes is None else check_whole("Env", "passes", passes, 1)


def check_bool(name: str, value: Any) -> bool:
    """Return True or False; ValueError for anything else."""
    if not is_bool(value):
        raise ValueError(f"Env: {name} is {value!r}; expected True or False")
    return bool(value)


def check_bounds(bounds: Any) -> Bounds:
    """Return bounds, those of defaults for None; TypeError for anything else."""
    if not isinstance(bounds, Bounds | None):
        raise TypeError(f"Env: bounds is {bounds!r}; expected warp_spo.env.Bounds, or None")
    return bounds or Bounds()


def check_parts(actions: Any) -> list[Any]:
    """Return one of ``warp_spo.env.actions``, or several, as a list; TypeError for anything else."""
    parts = list(actions) if isinstance(actions, list | tuple) else [actions]
    for part in parts:
        if not hasattr(part, "labels"):
            raise TypeError(f"Env: actions holds {part!r}; expected those of warp_spo.env.actions")
    if not parts:
        raise ValueError(f"Env: actions is {actions!r}; expected one of warp_spo.env.actions, or several")
    return parts


def check_commands(commands: Any) -> Any:
    """Return None, or one of ``warp_spo.env.commands``; TypeError for anything else."""
    if commands is not None and not all(hasattr(commands, name) for name in ("draw", "update", "size", "seconds")):
        raise TypeError(f"Env: commands is {commands!r}; expected None, or one of warp_spo.env.commands")
    return commands


def check_actions(call: str, actions: Any, worlds: int, labels: list[str]) -> torch.Tensor:
    """Return actions [world, action] as a tensor; TypeError or ValueError if they are none, or require grad."""
    try:
        tensor = torch.as_tensor(actions)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{call}: actions is {type(actions).__name__}; expected a tensor or an array") from None
    refuse_without_numbers(call, "actions", tensor)
    if tuple(tensor.shape) != (worlds, len(labels)) or tensor.is_complex():
        kind = "complex numbers of " if tensor.is_complex() else ""
        raise ValueError(
            f"{call}: actions has {kind}shape {tuple(tensor.shape)}; expected ({worlds}, {len(labels)}) "
            f"[world, action]: {', '.join(map(shown, labels))}"
        )
    refuse_gradient(call, "actions", tensor)
    return tensor


def refuse_without_numbers(call: str, name: str, tensor: torch.Tensor) -> None:
    """Raise ValueError for a tensor of the device "meta", or one that is not dense."""
    kind = "on the device meta, without numbers" if tensor.is_meta else f"of layout {tensor.layout}"
    if tensor.is_meta or tensor.layout != torch.strided:
        raise ValueError(f"{call}: {name} is {kind}; expected a dense tensor or an array")


def refuse_gradient(call: str, name: str, tensor: torch.Tensor) -> None:
    """Raise ValueError for a tensor that requires grad where torch records: a step would lose the gradient."""
    if tensor.requires_grad and torch.is_grad_enabled():
        raise ValueError(
            f"{call}: {name} requires grad; expected a tensor without, because a step of an environment has no "
            f"gradient; use torch.no_grad(), or {name}.detach(); Dynamics.step has gradients"
        )


def refuse_written_gradients(env: Any) -> None:
    """Raise ValueError if a caller has written a tensor that requires grad into one of the environment's.

    Their numbers stay, and the environment goes on without a gradient.
    """
    held = {"env.q": env.q, "env.qd": env.qd, "env.actions": env.actions, "env.memory(...)": env._tensors["memory"]}
    held |= {f"env.values[{name!r}]": tensor for name, tensor in env.values.items()}
    names = [name for name, tensor in held.items() if tensor.requires_grad]
    for name in names:
        held[name].detach_()
    if names and torch.is_grad_enabled():
        raise ValueError(
            f"Env: x requires grad, which was written into {', '.join(names)}; expected x.detach(), because a step of "
            "an environment has no gradient; Dynamics.step has gradients"
        )


def check_written(target: str, x: Any, held: torch.Tensor) -> torch.Tensor:
    """Return numbers x that may be written into ``held``, whose name for callers is ``target``, as a tensor.

    Raises:
        TypeError: they are no numbers.
        ValueError: they have another shape, are complex, sparse or on the device meta, or require grad.
    """
    call, expected = f"{target} = x", f"expected real numbers {tuple(held.shape)}"
    try:
        tensor = torch.as_tensor(x)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{call}: x is {quoted(x)}; {expected}") from None
    refuse_without_numbers(call, "x", tensor)
    refuse_gradient(call, "x", tensor)
    try:
        shape = torch.broadcast_shapes(tensor.shape, held.shape)
    except RuntimeError:
        shape = None
    if shape != held.shape or tensor.is_complex():
        raise ValueError(f"{call}: x is {tensor.dtype} {tuple(tensor.shape)}; {expected}")
    return tensor.to(held)


def check_mask(call: str, mask: Any, worlds: int, device: torch.device) -> torch.Tensor:
    """Return a mask of worlds as a bool tensor [world] on the device.

    Raises:
        TypeError: the mask cannot become a tensor.
        ValueError: it has another shape or dtype.
    """
    try:
        found = torch.as_tensor(mask, device=device)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{call}: mask is {mask!r}; expected bool ({worlds},) [world]") from None
    if found.shape != (worlds,) or found.dtype != torch.bool:
        raise ValueError(f"{call}: mask is {found.dtype} {tuple(found.shape)}; expected bool ({worlds},) [world]")
    return found


def check_lengths(call: str, value: Any, worlds: int) -> torch.Tensor:
    """Return steps since the starts of episodes, one for all worlds or one each; ValueError for what is none."""
    try:
        found = torch.as_tensor(value)
    except (TypeError, ValueError, RuntimeError):
        raise TypeError(f"{call}: got {value!r}; expected integers ({worlds},) [world]") from None
    if found.shape not in ((), (worlds,)) or found.dtype not in INTEGERS:
        raise ValueError(f"{call}: got {found.dtype} {tuple(found.shape)}; expected integers ({worlds},) [world]")
    return found


@torch.no_grad()
def numbers_of(term: TorchTerm, env: Any) -> torch.Tensor:
    """Return what a user's term in torch returns as [world, number]; ValueError for another shape, or complex ones."""
    found, worlds = term.function(env), env.num_envs
    expected = (worlds,) if term.size == 1 else (worlds, term.size)
    if not isinstance(found, torch.Tensor) or tuple(found.shape) not in (expected, (worlds, term.size)):
        came = tuple(found.shape) if isinstance(found, torch.Tensor) else type(found).__name__
        raise ValueError(f"Env: the term {term.name} returned {came}; expected a tensor {expected}")
    if found.is_complex():
        raise ValueError(f"Env: the term {term.name} returned {found.dtype}; expected real numbers")
    return found.reshape(worlds, term.size)
