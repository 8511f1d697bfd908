"""State of an environment outside of it: all that a step reads, and the levels of its curricula."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch

from ..errors import never_copied
from . import arguments
from .commands import LEVEL

if TYPE_CHECKING:
    from .environment import Env

STEPS = "steps"  # of the environment, after which a log comes
CUT = "episode of a written length"  # in the log of the environment


def level_names(events: Sequence[Any], commands: Any, curricula: Iterable[str]) -> list[str]:
    """Return the names under which worlds remember how far they have come: events', commands', ``curricula``."""
    names = [name for event in events for name in getattr(event, "levels", ())]
    return [*names, *([] if getattr(commands, "level", None) is None else [LEVEL]), *curricula]


def write_lengths(self: Env, value: torch.Tensor) -> None:
    """Set steps since the starts of episodes; where they change, the log leaves the length of the episode out."""
    lengths = self._tensors["episode_length"]
    before = lengths.clone()
    lengths.copy_(arguments.check_lengths("Env.episode_length_buf", value, self.num_envs))
    self._log.write_ages(self._tensors["memory"], lengths != before)


def levels(self: Env) -> dict[str, torch.Tensor]:
    """Return how far worlds have come in curricula, tensors [world, number] that may be written.

    "terrain" has rows and columns of tiles, "command level" by how much ranges of commands have grown, "curriculum
    steps" the steps behind ``curricula.ByStep``, other names that begin so the levels of ``curricula.BySuccess``.
    Without a curriculum the dictionary is empty.
    """
    return {name: self.memory(name) for name in self._levels}


@torch.no_grad()
def start_at(self: Env, levels: Mapping[str, torch.Tensor]) -> None:
    """Start all worlds anew at levels that :meth:`levels` returned, of this environment or of one like it.

    World w takes row w of them, counted in the whole run (``first_world``). If there are fewer rows, they are taken
    again from the first.

    Raises:
        ValueError: names or numbers per world are not those of this environment, or a number is not finite.
        TypeError: it is no dictionary.
    """
    _check_tensors("Env.start_at: levels", levels)
    held = self.levels()
    if levels.keys() != held.keys() or any(levels[name].shape[1:] != held[name].shape[1:] for name in held):
        came, expected = ({name: tuple(x.shape) for name, x in each.items()} for each in (levels, held))
        raise ValueError(f"Env.start_at: levels have the shapes {came}; expected {expected}, with any number of worlds")
    for name, given in levels.items():
        if not len(given) or not given.isfinite().all():
            what = f"{name!r} has {len(given)} worlds" if not len(given) else f"{name!r} holds NaN or infinity"
            raise ValueError(f"Env.start_at: levels {what}; expected finite numbers of one world or more")
    for name, own in held.items():
        rows = (self.first_world + torch.arange(self.num_envs)) % len(levels[name])
        own.copy_(levels[name].to(self.device)[rows.to(self.device)])
    self.reset()


def state_dict(self: Env) -> dict[str, torch.Tensor]:
    """Return copies of all tensors that the next steps and logs depend on, by name.

    ``torch.save`` stores them. An environment that is made with the same arguments goes on from them to the bit, on the
    same device: :meth:`load_state_dict`.
    """
    return {name: tensor.clone() for name, tensor in _tensors(self).items()} | {STEPS: torch.tensor(self._steps)}


@torch.no_grad()
def load_state_dict(self: Env, state: Mapping[str, torch.Tensor]) -> None:
    """Continue from what :meth:`state_dict` returned, of an environment that was made with the same arguments.

    Raises:
        ValueError: a tensor is missing, too many, or has another shape or dtype than here; nothing is changed then.
        TypeError: it is no dictionary of tensors.
    """
    _check_tensors("Env.load_state_dict: state", state)
    held = _tensors(self)
    kinds = {name: (tuple(x.shape), x.dtype) for name, x in held.items()} | {STEPS: ((), torch.int64)}
    came = {name: (tuple(x.shape), x.dtype) for name, x in state.items()}
    for name in sorted(kinds.keys() | came.keys()):
        if kinds.get(name) != came.get(name):
            raise ValueError(
                f"Env.load_state_dict: {name!r} is {came.get(name, 'missing')}; expected {kinds.get(name, 'none')}, as "
                "env.state_dict() of an environment that was made with the same arguments has it"
            )
    for name, tensor in held.items():
        tensor.copy_(state[name])
    self._steps = int(state[STEPS])
    low, high = (int(word) & 0xFFFFFFFF for word in state["key"][:2])
    self.seed = low | high << 32
    self._set_values()
    if self._failures is not None:
        self._failures.restart(self.seed, self._steps)


def copy_worlds(env: Env, worlds: torch.Tensor) -> dict[str, torch.Tensor]:
    """Return copies of all that belongs to some worlds, whole numbers, by name; :func:`restore_worlds` takes them."""
    return {name: tensor.index_select(axis, worlds) for name, (tensor, axis) in _by_world(env).items()}


def restore_worlds(env: Env, worlds: torch.Tensor, copies: Mapping[str, torch.Tensor]) -> None:
    """Copy back into ``worlds``, indices, what :func:`copy_worlds` returned.

    What the function of a :class:`TorchTerm` keeps by itself is not among it.
    """
    for name, (tensor, axis) in _by_world(env).items():
        tensor.index_copy_(axis, worlds, copies[name])
    if env._values_later:
        env._set_values()


def _by_world(env: Env) -> dict[str, tuple[torch.Tensor, int]]:
    """Return the tensors of :func:`copy_worlds` and their axes of worlds."""
    delays = {f"actuator state {i}": (part, 0) for i, part in enumerate(env._actuator_state or ())}
    seen = {f"seen {name}": (env._store.part(env._store.out, name), 0) for name in env.num_obs}
    return env._store.worlds_of() | delays | seen | {CUT: (env._log.cut, 0)}


def _check_tensors(what: str, given: Any) -> None:
    """Raise TypeError unless something is a dictionary of tensors."""
    if not isinstance(given, Mapping) or not all(isinstance(each, torch.Tensor) for each in given.values()):
        raise TypeError(f"{what} is {type(given).__name__}; expected a dictionary of tensors")


def _tensors(env: Env) -> dict[str, torch.Tensor]:
    """Return the tensors that :func:`state_dict` copies, by name."""
    delays = env._actuator_state or ()
    named = {f"actuator state {i}": part for i, part in enumerate(delays)}
    return env._store.changing() | named | {CUT: env._log.cut}


reduce = never_copied(
    "Env",
    "kernels, graphs and memory of a device",
    "store env.state_dict(), make an environment with the same arguments, and call its load_state_dict",
)
