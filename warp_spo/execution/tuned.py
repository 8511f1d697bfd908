"""Choices that were measured, and the files that keep them beside Warp's cache.

A file holds one choice as JSON, and the key under which it was measured. Its name is a hash of the key, so that the
choice of another scene, device, driver or version is another file. Files are replaced as a whole: a process that reads
one while another process writes it sees the old one or the new one.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import math
import os
import tempfile
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import warp as wp

FOLDER = "warp_spo_plans"  # in Warp's cache, which Warp's clear_kernel_cache leaves alone
NOISE = 1.03  # times that differ by less do not displace the first guess


@dataclasses.dataclass(frozen=True)
class Tuned:
    """A choice that was measured.

    Attributes:
        granularity: the choice.
        us: time of one call of all worlds by granularity [us]; empty where there was nothing to choose.
        device: name of the device that was measured.
        date: day of the measurement.
        file: where the choice is kept; None: it could not be written, and holds for one object.
        measured: it was measured by this call, not read from the file.
    """

    granularity: str
    us: Mapping[str, float] = dataclasses.field(default_factory=dict)
    device: str = ""
    date: str = ""
    file: Path | None = None
    measured: bool = False

    def __str__(self) -> str:
        if not self.us:
            return f"{self.granularity}, the only one"
        times = sorted(self.us.items(), key=lambda item: (item[0] != self.granularity, item[1]))
        return f"{', '.join(f'{name} {us:.3g} us' for name, us in times)}, on {self.device}, {self.date}"


def choice_of(us: Mapping[str, float], first_guess: str) -> str:
    """Return the granularity with the shortest time, or the first guess if it takes hardly longer."""
    best = min(us, key=lambda name: us[name])
    return first_guess if us[first_guess] <= NOISE * us[best] else best


def file_of(key: Mapping[str, Any]) -> Path:
    """Return the file of a choice."""
    digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:32]
    return Path(str(wp.config.kernel_cache_dir)) / FOLDER / f"{key['routine']}-{digest}.json"


def read(key: Mapping[str, Any], candidates: Sequence[str], warn: bool = True) -> Tuned | None:
    """Return the choice that is kept under a key, or None; a file that is damaged is named in a warning."""
    file, warn_damaged = file_of(key), _warn_damaged if warn else lambda *_: None
    try:
        text = file.read_text()
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (OSError, UnicodeDecodeError) as error:
        warn_damaged(file, f"{type(error).__name__}: {error}")
        return None
    try:
        found = json.loads(text)
        if found["key"] != json.loads(json.dumps(key)):
            raise ValueError("it was written under another key")
        us = {str(name): float(time) for name, time in found["us"].items()}
        if sorted(us) != sorted(candidates) or found["granularity"] not in us:
            raise ValueError(f"it chooses {found['granularity']!r} among {', '.join(us)}")
        if not all(math.isfinite(time) and time > 0.0 for time in us.values()):
            raise ValueError("a time is not a positive number")
        return Tuned(found["granularity"], us, str(found["device"]), str(found["date"]), file)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        warn_damaged(file, f"{type(error).__name__}: {error}")
        return None


def write(key: Mapping[str, Any], tuned: Tuned) -> Tuned:
    """Keep a choice under its key; return it with its file, which is None if it could not be written."""
    file, own = file_of(key), None
    content = {"granularity": tuned.granularity, "us": dict(tuned.us), "device": tuned.device, "date": tuned.date}
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        handle, own = tempfile.mkstemp(dir=file.parent, prefix=file.stem, suffix=".tmp")
        with os.fdopen(handle, "w") as out:
            json.dump({**content, "key": key}, out, indent=1)
        os.replace(own, file)
    except OSError as error:
        if own is not None:
            with contextlib.suppress(OSError):
                os.unlink(own)
        warnings.warn(
            f"Dynamics.tune: the choice cannot be kept in {file} ({error}); it holds for this object, and the next "
            f"one measures anew; let the environment variable WARP_CACHE_PATH name a folder that can be written, or "
            f"pass granularity={tuned.granularity!r}",
            stacklevel=5,
        )
        return dataclasses.replace(tuned, file=None)
    return dataclasses.replace(tuned, file=file)


def _warn_damaged(file: Path, why: str) -> None:
    warnings.warn(
        f"Dynamics.tune: {file} cannot be used ({why}); the choice is measured anew and the file is replaced; delete "
        f"it if this warning comes again",
        stacklevel=6,
    )
