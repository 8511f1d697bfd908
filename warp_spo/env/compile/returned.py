"""Checks of what terms, events, commands and actions return and assign; errors name them."""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from ...errors import shown
from ...trace.functions import AbstractScalar, Condition, where
from ...trace.scalars import is_constant
from ..validation import check_whole
from .memory_layout import NET_TARGETS, check_memory_name
from .vectors import Vector, vector

if TYPE_CHECKING:
    from ...scene.scene import Scene
    from ..world import World


def numbers(what: str, values: Any, size: int | None = None) -> Vector:
    """Return numbers, or one, as a vector of abstract scalars and Python floats; a condition becomes 1 or 0.

    Args:
        what: the function, and what it gives, in errors: "reward 'up' returned".
        values: a number, or an array, list or tuple of numbers of any shape. size: how many are expected; None: any.

    Raises:
        TypeError: one of them is no number, or not finite.
        ValueError: there are more or fewer than ``size``.
    """
    found = vector(_number(what, values, x, size) for x in _flat(values))
    if size is not None and len(found) != size:
        raise ValueError(f"Env: {what} {came(values)}; expected {_describe_expectation(size)}")
    return found


def one_number(what: str, value: Any) -> Any:
    """Return one number, or an array of one, as an abstract scalar or a float; errors as :func:`numbers`."""
    return numbers(what, value, 1)[0]


@contextlib.contextmanager
def naming(what: str) -> Iterator[None]:
    """Let errors that a user's function raises begin with ``what``, its name, unless they name it."""
    try:
        yield
    except Exception as error:  # of any type: it stays what it is
        words = error.args[0] if len(error.args) == 1 and isinstance(error.args[0], str) else None
        if words is None:
            error.add_note(f"Env: {what} raised it.")
        elif not words.startswith(f"Env: {what}"):
            error.args = (f"Env: {what}: {words.removeprefix('Env: ')}",)
        raise


def condition(what: str, value: Any) -> Condition:
    """Return a comparison, a bool, or the number of a term in torch, as a condition.

    Raises:
        TypeError: it is something else, such as a number; the message names ``what``.
    """
    x = value.ravel()[0] if isinstance(value, np.ndarray) and value.size == 1 else value
    if isinstance(x, Condition):
        return x
    if isinstance(x, AbstractScalar) and not is_constant(x.value) and x.value.op == "input":
        if x.value.args[0] == "user":  # of a term in torch
            return abs(x) > 0.0
    if isinstance(x, bool | np.bool_):
        return Condition(1.0 if x else 0.0)
    raise TypeError(f"Env: {what} {came(value)}; expected a comparison, such as w.q[1] > 0.3")


def check_event(event: Any, number: int) -> Any:
    """Return an event, ``events[number]``, whose change checks what it assigns: as many numbers as there are.

    Its errors are those of :func:`numbers`, and one for a value that is not among the event's names.
    """
    what = f"events[{number}] sets"

    def change(w: World) -> None:
        state, values = {"q": w.scene.coord_count, "qd": w.scene.dof_count}, {*w.values}
        with naming(f"events[{number}]"):
            event.change(w)
        for name in state.keys() & w.__dict__.keys():
            w.__dict__[name] = numbers(f"{what} w.{name} to", w.__dict__[name], state[name])
        if unknown := sorted({*w.values} - values):
            raise ValueError(
                f"Env: {what} w.values[{unknown[0]!r}]; expected one of its names, {', '.join(sorted(values))}"
            )
        for name in values:
            own = w.scene.values[name][0]
            w.values[name] = numbers(f"{what} w.values[{name!r}] to", w.values[name], own.size).reshape(own.shape)

    checked = copy.copy(event)
    object.__setattr__(checked, "change", change)  # frozen
    return checked


def commands_drawn(commands: Any, w: World, done: Any) -> dict[str, Vector]:
    """Return a new command and what belongs to it, by name; errors as :func:`numbers`."""
    with naming("commands.draw"):
        drawn = commands.draw(w, done)
    if not isinstance(drawn, dict) or "command" not in drawn:
        raise TypeError(f"Env: commands.draw returned {came(drawn)}; expected vectors by name, 'command' among them")
    for name in drawn.keys() - {"command"}:
        check_memory_name("Env: commands.draw", name)
    sizes = {"command": commands.size}
    return {name: numbers(f"commands.draw returned as {name!r}", x, sizes.get(name)) for name, x in drawn.items()}


def command_updated(commands: Any, w: World, command: Vector) -> Vector:
    """Return the command after an update; errors as :func:`numbers`."""
    with naming("commands.update"):
        return numbers("commands.update returned", commands.update(w, command), commands.size)


def controls(part: Any, w: World, action: Vector, sizes: dict[str, int]) -> list[tuple[int, Any]]:
    """Return (entry, number) of what a part of the actions sets in its array, which has so many entries.

    Raises:
        TypeError, ValueError: it sets no numbers, or an entry that is not there; the message names it.
    """
    what, size = f"actions.{type(part).__name__}", sizes[part.array]
    with naming(what):
        found = part.trace(w, action)
    if not isinstance(found, list | tuple) or not all(isinstance(each, tuple) and len(each) == 2 for each in found):
        raise TypeError(f"Env: {what}.trace returned {came(found)}; expected a list of (entry, number)")
    for entry, _ in found:
        check_whole(f"Env: {what}.trace", f"an entry of {part.array}", entry, 0, size - 1)
    return [(int(entry), one_number(f"{what} sets entry {entry} of {part.array} to", x)) for entry, x in found]


def check_force(part: Any, entry: int, scene: Scene, forces: dict[int, Any]) -> None:
    """Raise ValueError if a learned actuator, whose network sets the force of a joint, and another action both set it.

    Args:
        part: of the actions. entry: that it sets in its array. forces: what sets the force of each dof, added to.
    """
    if part.array not in ("tau", NET_TARGETS):
        return
    starts = scene.q_start if part.array == NET_TARGETS else scene.qd_start
    hinge = int(np.searchsorted(starts, entry, side="right")) - 1
    dof = int(scene.qd_start[hinge]) if part.array == NET_TARGETS else entry
    other = forces.setdefault(dof, part)
    if other.array != part.array:
        first, second = (f"actions.{type(each).__name__}" for each in (other, part))
        raise ValueError(
            f"Env: {first} and {second} both set the force of joint {shown(scene.joint_labels[hinge])!r}; expected one "
            "of them; name the joints of each with joints="
        )


def came(value: Any) -> str:
    """Return what came, in words: the shape of an array, the length of a list, a plain value, or its kind."""
    if isinstance(value, np.ndarray):
        return f"an array of shape {value.shape}"
    if isinstance(value, list | tuple):
        return f"a {type(value).__name__} of {len(value)}"
    if isinstance(value, AbstractScalar):
        return "a number"
    if value is None or isinstance(value, bool | int | float | complex | str | np.generic):
        return shown(repr(value))
    return type(value).__name__


def _flat(values: Any) -> list[Any]:
    """Return the entries of arrays, lists and tuples in their order, however deep; anything else as the only entry."""
    if isinstance(values, np.ndarray | list | tuple):
        return [x for part in (values.ravel() if isinstance(values, np.ndarray) else values) for x in _flat(part)]
    return [values]


def _describe_expectation(size: int | None, kind: str = "") -> str:
    """Return what was expected in words, such as "2 finite numbers"."""
    return {None: f"{kind}numbers", 1: f"one {kind}number"}.get(size, f"{size} {kind}numbers")


def _number(what: str, values: Any, x: Any, size: int | None) -> Any:
    """Return an entry of ``values`` as an abstract scalar or a float; TypeError for what is none."""
    if isinstance(x, Condition):
        return where(x, 1.0, 0.0)
    if isinstance(x, AbstractScalar):
        return x
    plain = isinstance(x, bool | int | float | np.bool_ | np.integer | np.floating)
    if plain and math.isfinite(x):
        return float(x)
    held = came(x) if x is values else f"{came(values)} that holds {came(x)}"
    way_out = "; a term in torch is a TorchTerm" if hasattr(x, "detach") else ""
    raise TypeError(f"Env: {what} {held}; expected {_describe_expectation(size, 'finite ' if plain else '')}{way_out}")
