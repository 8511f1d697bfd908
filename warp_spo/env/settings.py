"""Settings of a training: ``--set NAME=VALUE``, files of TOML, and the file that says what a training ran with."""

from __future__ import annotations

import ast
import dataclasses
import difflib
import inspect
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from ..errors import as_integer, shown
from .environment import Env
from .training_files import versions, write_bytes

FILE = "settings.toml"  # beside the checkpoints
ABOUT = ("run", "versions")  # tables of it that are no settings
OPTIONS = ("worlds", "device", "seed", "first_world")  # of commands, no settings
CONSTANTS = {"true": True, "false": False, "none": None}


def parse(texts: Iterable[str]) -> dict[str, Any]:
    """Return the tree of settings such as ``learner.entropy=0.01``; a name with dots or spaces may be quoted."""
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        path = [part.strip().strip("\"'") for part in name.split(".")]
        if not equals or not all(path):
            raise ValueError(f"--set {text}: expected NAME=VALUE, such as learner.entropy=0.01")
        part = found
        for each in path[:-1]:
            part = part.setdefault(each, {})
            if not isinstance(part, dict):
                raise ValueError(f"--set {text}: {each} is set as a whole, too; expected one of the two")
        part[path[-1]] = value_of(value)
    return found


def value_of(text: str) -> Any:
    """Return the number, list, truth or text that is meant."""
    text = text.strip()
    if text.lower() in CONSTANTS:
        return CONSTANTS[text.lower()]
    try:
        return ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return text


def read(file: str | Path) -> dict[str, Any]:
    """Return the tree of a file of TOML; ValueError where it is none, OSError where there is no file."""
    try:
        import tomllib
    except ImportError:  # Python 3.10
        import tomli as tomllib  # type: ignore[no-redef]

    try:
        return tomllib.loads(Path(file).read_text())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"settings {str(file)!r}: {error}; expected a file of TOML") from None


def gather(folder: Path | None, task: str, file: Path | None, texts: Sequence[str]) -> tuple[dict, dict[str, Any]]:
    """Return how the training of a folder was run, {} without one, and the settings that now hold.

    Those of the folder come first, if they are of this task; those of a file replace them, ``--set`` both.
    """
    found: dict[str, Any] = {}
    if folder is not None and (folder / FILE).exists():
        found = read(folder / FILE)
    run = found.get("run", {})
    if not isinstance(run, Mapping) or run.get("task") != task:
        run, found = {}, {}
    for name in ("worlds", "processes", "iterations", "seed", "save_interval"):
        if as_integer(run.get(name, 1)) is None:
            raise ValueError(f"{str(folder)!r}: {FILE} has run.{name} = {run[name]!r}; expected an integer")
    own = read(file) if file is not None else {}
    return dict(run), {n: x for n, x in merge(merge(found, own), parse(texts)).items() if n not in ABOUT}


def write(folder: Path, run: Mapping[str, Any], learner: Any, given: Mapping[str, Any]) -> None:
    """Write what a training runs with: the command, versions, all of the learner, and what is set of the task."""
    tree = {name: value for name, value in given.items() if name != "learner"}
    tree |= {"run": dict(run), "versions": versions(), "learner": dataclasses.asdict(learner)}
    text = "# Settings of this training. play and --resume read it, and so does train --settings FILE.\n"
    write_bytes(folder / FILE, (text + text_of(tree)).encode())


def merge(first: Mapping[str, Any], second: Mapping[str, Any]) -> dict[str, Any]:
    """Return a tree of settings in which those of the second replace those of the first."""
    found = dict(first)
    for name, value in second.items():
        held = found.get(name)
        found[name] = merge(held, value) if isinstance(held, Mapping) and isinstance(value, Mapping) else value
    return found


def split(tree: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the settings of the learner, and those of the task."""
    learner = tree.get("learner", {})
    if not isinstance(learner, Mapping):
        raise ValueError(f"settings: learner is {learner!r}; expected names, such as learner.entropy=0.01")
    return dict(learner), {name: value for name, value in tree.items() if name not in ("learner", *ABOUT)}


def apply(held: Any, given: Any, place: str) -> Any:
    """Return ``held`` with the settings ``given`` in its place or in its parts.

    Parts are the entries of dictionaries, the fields of dataclasses, and the entries of lists by number; of a reward,
    which is (weight, term), the weight, which may have parts itself.

    Raises:
        ValueError: a name is unknown, the message has the nearest; or a value is of another kind than the one before.
    """
    if isinstance(given, Mapping):
        parts = _parts(held)
        if not parts and _is_reward(held):
            return apply(held[0], given, place), held[1]  # its weight is a curriculum
        if not parts:
            raise ValueError(f"settings: {place} is {_short(held)}, which has no {', '.join(map(str, given))}")
        new = {}
        for name, value in given.items():
            key = _find_name(str(name), parts, place)
            new[key] = apply(parts[key], value, f"{place}.{key}")
        return _with_parts(held, new, place)
    if _is_reward(held) and dataclasses.is_dataclass(held[0]):
        return _alike(given, 1.0, place), held[1]
    if _is_reward(held):
        return _alike(given, held[0], place), held[1]
    if callable(held) or dataclasses.is_dataclass(held) or isinstance(held, Mapping):
        names = ", ".join(map(str, _parts(held))) or "none"
        raise ValueError(
            f"settings: {place} is {given!r}; it is made by the task's file and has to be changed there; its parts "
            f"that can be set: {names}"
        )
    return _alike(given, held, place)


def make_env(scene: Any, worlds: int, device: Any, options: Mapping[str, Any], **own: Any) -> Env:
    """Return an environment of a task: ``own`` arguments of ``Env``, in which ``options`` are put in place.

    An option replaces a number of ``own``, or parts of what is there: ``rewards={"velocity": 3.0}`` is another weight,
    ``commands={"forward": (-2.0, 2.0)}`` another range. Arguments that ``own`` has not go to ``Env``.

    Raises:
        ValueError: a name is unknown, or a value of another kind.
    """
    known = list(inspect.signature(Env.__init__).parameters)[2:]
    found = dict(own)
    for name, value in options.items():
        name = _find_name(name, dict.fromkeys([*own, *known]), "")
        found[name] = apply(own[name], value, name) if name in own else value
    env = Env(scene, worlds, device, **found)
    env.options = dict(options)
    return env


def arguments(chosen: Any, given: Mapping[str, Any]) -> dict[str, Any]:
    """Return settings of a task as keyword arguments of its ``build``; those with defaults are of their kind."""
    taken = {n: p for n, p in inspect.signature(chosen.build).parameters.items() if n not in ("worlds", "device")}
    kinds = [each.kind for each in taken.values()]
    own = {n: p.default for n, p in taken.items() if p.kind not in (p.VAR_KEYWORD, p.VAR_POSITIONAL) and n != "seed"}
    found = {}
    for name, value in given.items():
        if name in OPTIONS:
            raise ValueError(
                f"settings: {name} is {value!r}; expected it as an option, such as --seed, or learner.{name}"
            )
        if name not in own and inspect.Parameter.VAR_KEYWORD not in kinds:
            name = _find_name(name, own, "")
        default = own.get(name)
        found[name] = value if default is None or name not in own else apply(default, value, name)
    return found


def text_of(tree: Mapping[str, Any]) -> str:
    """Return a tree as TOML; what is None is left out."""
    lines = [f"{_key(name)} = {_toml(x)}" for name, x in tree.items() if not isinstance(x, Mapping) and x is not None]

    def tables(part: Mapping[str, Any], path: str) -> None:
        for name, value in part.items():
            if isinstance(value, Mapping):
                lines.extend(["", f"[{path}{_key(name)}]"])
                lines.extend(f"{_key(n)} = {_toml(x)}" for n, x in value.items() if not isinstance(x, Mapping | None))
                tables(value, f"{path}{_key(name)}.")

    tables(tree, "")
    return "\n".join(lines).strip() + "\n"


# -- inside --------------------------------------------------------------------------------------------------------
def _is_reward(held: Any) -> bool:
    """Return whether it is a reward: (weight, term)."""
    return isinstance(held, tuple) and len(held) == 2 and callable(held[1])


def _parts(held: Any) -> dict[Any, Any]:
    if isinstance(held, Mapping):
        return dict(held)
    if dataclasses.is_dataclass(held) and not isinstance(held, type):
        return {field.name: getattr(held, field.name) for field in dataclasses.fields(held)}
    if isinstance(held, list):
        return {str(i): each for i, each in enumerate(held)}
    return {}


def _with_parts(held: Any, new: Mapping[Any, Any], place: str) -> Any:
    if isinstance(held, Mapping):
        return {**held, **new}
    if isinstance(held, list):
        return [new.get(str(i), each) for i, each in enumerate(held)]
    try:
        return dataclasses.replace(held, **new)
    except (ValueError, TypeError) as error:
        raise ValueError(f"settings: {place}: {error}") from None


def _find_name(name: str, known: Mapping[str, Any], place: str) -> str:
    """Return a name as it is known, where "_" may stand for a space."""
    spaced = {str(each).replace(" ", "_"): each for each in known}
    if name in known or name.replace(" ", "_") in spaced:
        return name if name in known else spaced[name.replace(" ", "_")]
    near = difflib.get_close_matches(name, list(known), 1, 0.4)
    meant = f" (did you mean {shown(near[0])}?)" if near else ""
    raise ValueError(
        f"settings: unknown name {(place + '.' if place else '') + name!r}{meant}; expected one of "
        f"{', '.join(map(shown, known))}"
    )


def _alike(given: Any, held: Any, place: str) -> Any:
    """Return a value of the kind of the one that it replaces."""
    wrong, kind = False, ""
    if isinstance(held, bool):
        wrong, kind = not isinstance(given, bool), "true or false"
    elif as_integer(held) is not None:
        whole = as_integer(given)
        wrong, kind, given = whole is None, "an integer", whole if whole is not None else given
    elif isinstance(held, float):
        wrong, kind = isinstance(given, bool) or not isinstance(given, int | float) or math.isnan(given), "a number"
        given = given if wrong else float(given)
    elif isinstance(held, str):
        wrong, kind = not isinstance(given, str), "a text"
    elif isinstance(held, tuple) and held:
        wrong, kind = not isinstance(given, list | tuple), f"a list, such as {list(held)}"
        if not wrong:
            return tuple(_alike(x, held[min(i, len(held) - 1)], f"{place}[{i}]") for i, x in enumerate(given))
    if wrong:
        raise ValueError(f"settings: {place} is {given!r}; expected {kind}, as {_short(held)} is")
    return given


def _short(held: Any) -> str:
    text = repr(held)
    return text if len(text) < 60 else type(held).__name__


def _key(name: Any) -> str:
    text = str(name)
    return text if text.isascii() and text.replace("_", "").replace("-", "").isalnum() else json.dumps(text)


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, Sequence) and not isinstance(value, str):
        return f"[{', '.join(map(_toml, value))}]"
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=True)
