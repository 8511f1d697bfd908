"""Files of a training: checkpoints that are whole or not there, and which of a folder is the newest."""

from __future__ import annotations

import contextlib
import io
import os
import re
import warnings
import zipfile
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any

import torch

from ..errors import as_integer

FORMAT = 1  # of checkpoints; those without a number are older, and hold no worlds
LAST = "last.pt"  # networks and worlds of the newest checkpoint
LATEST = "latest"  # in place of a checkpoint's name: the newest whole one of the folder
NETWORKS = {"actor_state_dict", "critic_state_dict", "optimizer_state_dict", "iter"}


def write(file: Path, contents: Mapping[str, Any]) -> None:
    """Write a checkpoint, as :func:`write_bytes` does."""
    held = io.BytesIO()
    torch.save(dict(contents), held)
    write_bytes(file, held.getbuffer())


def write_bytes(file: Path, data: Any) -> None:
    """Write a file beside its name, flush it to the disk and rename it: the name is always that of a whole file.

    The folder is made anew where only it is missing.

    Raises:
        OSError: the disk is full, or gone; what bore the name before is still there.
    """
    beside = file.with_name(f"{file.name}.part")
    file.parent.mkdir(exist_ok=True)
    try:
        with beside.open("wb") as out:
            out.write(data)
            out.flush()
            os.fsync(out.fileno())
        os.replace(beside, file)
    except OSError:
        with contextlib.suppress(OSError):
            beside.unlink()  # it takes the room that others need
        raise
    with contextlib.suppress(OSError):  # not every system opens folders
        folder = os.open(file.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


def read(file: str | Path, device: Any = "cpu") -> dict[str, Any]:
    """Return what a checkpoint holds, tensors and numbers only.

    Raises:
        OSError: there is no such file. ValueError: it is torn, no checkpoint, or one of a later version.
    """
    name = f"checkpoint {str(file)!r}"
    data = Path(file).read_bytes()
    try:
        found = torch.load(io.BytesIO(data), weights_only=True, map_location=device)
    except Exception as error:  # whatever a foreign file makes torch raise
        why = type(error).__name__
        if not data:
            why = "it is empty"
        elif data[:2] == b"PK" and not zipfile.is_zipfile(io.BytesIO(data)):
            why = f"it is torn: its end is missing after {len(data)} bytes"
        raise ValueError(f"{name}: cannot be read ({why}); expected a model_N.pt of a training") from None
    if not isinstance(found, dict):
        raise ValueError(f"{name}: holds {type(found).__name__}; expected a model_N.pt of a training")
    kind = found.get("format", 0)
    if as_integer(kind) is None or not 0 <= kind <= FORMAT:
        by = found.get("versions")
        by = f", written by warp_spo {by['warp_spo']}" if isinstance(by, dict) and "warp_spo" in by else ""
        raise ValueError(f"{name}: is of format {kind!r}{by}; this warp_spo reads formats up to {FORMAT}: update it")
    missing = NETWORKS - set(found)
    if missing:
        raise ValueError(f"{name}: has no {', '.join(sorted(missing))}; expected a model_N.pt of a training")
    levels = (found.get("infos") or {}).get("levels", {})
    if as_integer(found["iter"]) is None or not isinstance(levels, Mapping):
        raise ValueError(
            f"{name}: iter is {found['iter']!r}, its levels are {type(levels).__name__}; expected an integer, and a "
            "dictionary: a model_N.pt of a training"
        )
    return found


def newest(folder: str | Path) -> Path | None:
    """Return the whole checkpoint of a folder with most iterations, None without one; a warning names those torn.

    Of two with the same iteration it is ``last.pt``, which holds the worlds.
    """
    folder = Path(folder)
    numbers = {file: re.fullmatch(r"model_(\d+)\.pt", file.name) for file in folder.glob("model_*.pt")}
    models = sorted((int(found[1]), file) for file, found in numbers.items() if found)
    best, most = None, -1
    for number, file in [(-1, folder / LAST), *reversed(models)]:
        if 0 <= number <= most:
            break
        try:
            iteration = int(read(file)["iter"])
        except FileNotFoundError:
            continue
        except (ValueError, OSError) as error:
            warnings.warn(f"train: {error}; {LATEST!r} takes the newest of the others", stacklevel=2)
            continue
        if iteration > most:
            best, most = file, iteration
        if number >= 0:
            break
    return best


def checkpoint_names(folder: str | Path) -> list[str]:
    """Return the names of a folder's checkpoints, fewest iterations first; ``last.pt`` only where there is no other."""
    numbers = {file.name: re.fullmatch(r"model_(\d+)\.pt", file.name) for file in Path(folder).glob("model_*.pt")}
    models = sorted((int(found[1]), name) for name, found in numbers.items() if found)
    return [name for _, name in models] or [LAST] * (Path(folder) / LAST).is_file()


def versions() -> dict[str, str]:
    """Return the versions of this package and of those that learn; "source" where it is not installed."""
    found = {}
    for name in ("warp_spo", "warp-lang", "torch", "rsl-rl-lib"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "source"
    return found
