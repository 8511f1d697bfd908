"""The log of a training: printed lines, rows of JSON, and a learning curve."""

from __future__ import annotations

import json
import math
import os
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from ..errors import shown
from . import loggers
from .compile.guard import BEYOND, NOT_FINITE
from .training_files import write_bytes

if TYPE_CHECKING:
    from .environment import Env

KINDS_OF_FAULTS = (f"/{NOT_FINITE}/", f"/{BEYOND}/")  # beginnings of names in a log


class TrainingLog:
    """The log of a training, in place of rsl_rl's logger: a printed line and a row of JSON for an iteration.

    Means of rewards and of lengths of episodes come from the environment, which gathers them in its graph; an iteration
    reads them once.
    """

    def __init__(
        self, env: Env, folder: Path | None, every: int, began: float, writes: bool, seconds: float = math.inf,
        after: Callable[[int, int], None] | None = None, others: Sequence[str] = (), frames: int = 0,
        config: Mapping[str, Any] | None = None,
    ):  # fmt: skip
        self.env, self.log_dir, self.every, self.began = env, folder and str(folder), every, began
        self.ends, self.after = began + seconds, after
        self.writes, self.writer = folder is not None and writes, None  # rsl_rl has nothing to write
        self.first = 0  # iteration
        self.faults: dict[str, float] = {}  # what ended worlds so far, as printed
        self.rows: list[dict[str, float]] = []
        self.git_status_repos: list[str] = []
        self.file: Path | None = None
        self.unwritten: dict[str, str] = {}
        self.lost: dict[str, str] = {}  # loggers that have failed, and why
        self._others, self.frames, self._config = list(others), frames, config or {}
        self._open: dict[str, Any] = {}  # loggers
        self._later: tuple[dict[str, float], int, float] | None = None  # what they have not got yet
        self._size, self._waiting = 0, b""  # bytes of the file that are whole, and those that it still lacks

    def init_logging_writer(self) -> None:
        """Continue the rows of the training that is resumed, up to its checkpoint; its seconds count."""
        if not self.writes or self.file is not None:
            return
        file = Path(self.log_dir) / "progress.jsonl"  # type: ignore[arg-type]
        if file.exists():
            self.rows = [row for row in read_rows(file) if row["iteration"] < self.first]
            text = to_json_lines(self.rows)
            write_bytes(file, text)
            self._size = len(text)
        if self.rows:
            self.began -= self.rows[-1]["seconds"]
        self.file = file
        self._open = {name: loggers.start(name, file.parent, self.first, self._config) for name in self._others}

    def process_env_step(self, *_: Any) -> None:
        """Do nothing."""

    def log(
        self, it: int, total_it: int, collect_time: float, learn_time: float, loss_dict: dict, **others: Any
    ) -> None:
        """Write an iteration, and do what comes after it."""
        if self.writes:
            self._write(it, total_it, collect_time, learn_time, loss_dict, others)
        if self.after is not None:
            self.after(it, total_it)

    def _write(
        self, it: int, total_it: int, collect_time: float, learn_time: float, loss_dict: dict, others: dict
    ) -> None:
        found = others.get("env_log")
        if not found:
            held = self.env.log()
            found = dict(zip(held, torch.stack([value.float() for value in held.values()]).tolist(), strict=True))
        row: dict[str, float] = {
            "iteration": it,
            "seconds": time.time() - self.began,
            "collecting": collect_time,
            "learning": learn_time,
            "deviation": float(others["action_std"].detach().mean()),
            "rate": float(others["learning_rate"]),
            **peak_memory(self.env.device),
            **{f"loss/{name}": float(value) for name, value in loss_dict.items()},
            **found,
        }
        row["reward"] = sum(value for name, value in row.items() if name.startswith("/reward/"))
        self.rows.append(row)
        self._append(to_json_lines([row]))
        self.write_elsewhere()
        if self._open:
            self._later = loggers.tags(row, self.env, self.frames), it, time.time()
        if it % self.every == 0 or it + 1 == total_it:
            reward = f"{row['reward']:8.3f}" if row["/episode/finished"] else f"{'-':>8}"
            length = f"{row['/episode/seconds']:5.1f}" if row["/episode/whole"] else f"{'-':>5}"
            print(f"iteration {it:4d} of {total_it}  {row['seconds']:6.1f} s  reward {reward}  "
                  f"episode {length} s  collecting {1e3 * collect_time:4.0f} ms  "
                  f"learning {1e3 * learn_time:4.0f} ms", flush=True)  # fmt: skip
            self._print_faults(row)

    def write_elsewhere(self) -> None:
        """Write the last iteration to TensorBoard and others; one that fails is a warning, and is left from then on.

        A learner calls it while the device works on the next iteration; otherwise the next row does.
        """
        if self._later is None:
            return
        (found, iteration, when), self._later = self._later, None
        for name, logger in list(self._open.items()):
            try:
                logger.log(found, iteration, when)
            except Exception as error:  # of another library: the training goes on
                del self._open[name]
                self.lost[name] = f"from iteration {iteration} on: {error}"
                warnings.warn(f"train: logger {name} has failed ({error}); the training goes on without", stacklevel=2)

    def close(self) -> None:
        """End other loggers."""
        self.write_elsewhere()
        for name, logger in self._open.items():
            try:
                logger.close()
            except Exception as error:  # of another library
                self.lost[name] = f"at the end: {error}"
        self._open = {}

    def _append(self, text: bytes) -> None:
        """Write lines behind those of the file that are whole; what a full disk leaves out is tried again later."""
        self._waiting += text
        try:
            with self.file.open("ab", buffering=0) as out:  # type: ignore[union-attr]
                if out.tell() < self._size:  # another file: that one is lost
                    self._size, self._waiting = 0, to_json_lines(self.rows)
                out.truncate(self._size)
                while self._waiting:
                    done = out.write(self._waiting)
                    self._size, self._waiting = self._size + done, self._waiting[done:]
            self.unwritten = {}
        except OSError as error:
            if not self.unwritten:
                words = f"{str(self.file)!r} could not be written ({error.strerror}); its rows are kept and tried again"
                warnings.warn(f"train: {words} after each iteration", stacklevel=2)
            self.unwritten = {self.file.name: error.strerror or str(error)}  # type: ignore[union-attr]

    def flush(self) -> None:
        """Bring all rows onto the disk."""
        if self.file is None or not self.rows:
            return
        self._append(b"")
        if not self.unwritten:
            with self.file.open("rb") as held:
                os.fsync(held.fileno())

    def _print_faults(self, row: dict[str, float]) -> None:
        """Print what has ended worlds for numbers that are not finite or beyond bounds since the last line."""
        counts = {name: number for name, number in row.items() if name.startswith(KINDS_OF_FAULTS)}
        new = {name: number - self.faults.get(name, 0.0) for name, number in counts.items()}
        self.faults = counts
        own = [name for name, more in new.items() if more > 0 and not any(x.startswith(f"{name}/") for x in counts)]
        if own:
            print("  episodes ended by " + ", ".join(f"{shown(name[1:])}: {new[name]:g}" for name in own), flush=True)

    def save_model(self, *_: Any) -> None:
        """Do nothing: checkpoints stay in the folder."""

    def stop_logging_writer(self) -> None:
        """Do nothing: each row is written when it is known."""


def peak_memory(device: Any) -> dict[str, float]:
    """Return the largest number of bytes that torch has held so far on a GPU, by the name "torch bytes"; {} on a CPU.

    These are networks, optimizer, rollouts, temporaries and the environment's tensors; Warp's arrays, such as the
    dynamics' values of each world, are beside them.
    """
    return (
        {"torch bytes": float(torch.cuda.max_memory_allocated(device))} if torch.device(device).type == "cuda" else {}
    )


def to_json_lines(rows: list[dict[str, float]]) -> bytes:
    """Return rows as the lines of a ``progress.jsonl``.

    A row counts by term the worlds that ended because a number was not finite or beyond its bounds; terms that count
    zero are left out, the totals stay.
    """

    def is_logged(name: str, value: float) -> bool:
        return value != 0.0 or name.count("/") < 3 or not name.startswith(KINDS_OF_FAULTS)

    kept = ({name: float(f"{x:.6g}") for name, x in row.items() if is_logged(name, x)} for row in rows)
    return "".join(json.dumps(row) + "\n" for row in kept).encode()


def read_rows(file: Path) -> list[dict[str, float]]:
    """Return the rows of a ``progress.jsonl``; a last line that was torn while it was written is left out.

    Raises:
        ValueError: another line is no row; the message names it.
    """
    lines = file.read_bytes().decode(errors="replace").split("\n")
    rows = []
    for number, line in enumerate(lines, 1):
        if number == len(lines):  # empty, or without its end
            break
        try:
            row = json.loads(line)
            if not isinstance(row["iteration"], int | float) or not isinstance(row["seconds"], int | float):
                raise KeyError
        except (ValueError, TypeError, KeyError):
            raise ValueError(
                f"{str(file)!r}: line {number} is no row of a training ({line[:40]!r}); remove the line, or move the "
                "file away"
            ) from None
        rows.append(row)
    return rows


def draw_curve(folder: str | Path, name: str) -> Path:
    """Draw the learning curve of a folder's ``progress.jsonl`` as ``curve.png``, and return its path.

    Without matplotlib the path returned is that of the rows.
    """
    folder = Path(folder)
    rows = read_rows(folder / "progress.jsonl")
    try:
        from ..viewing.charts import OURS, load_pyplot, style

        pyplot = load_pyplot("train")
    except ImportError:
        return folder / "progress.jsonl"
    with style():
        figure, panels = pyplot.subplots(1, 2, figsize=(9.0, 3.2), layout="constrained")
        seconds = [row["seconds"] for row in rows]
        terms = sorted((key for key in rows[-1] if key.startswith("/reward/")), key=lambda key: -abs(rows[-1][key]))
        panels[0].plot(seconds, [row["reward"] for row in rows], color=OURS)
        panels[0].set(title=f"{name}: reward of an episode", xlabel="seconds since the start of the process")
        for key in terms[:6]:
            panels[1].plot(seconds, [row.get(key, 0.0) for row in rows], label=key.removeprefix("/reward/"), lw=1.2)
        panels[1].set(title="its largest terms", xlabel="seconds")
        panels[1].legend(fontsize=8)
        for panel in panels:
            panel.grid(True)
        figure.savefig(folder / "curve.png", dpi=110)
        pyplot.close(figure)
    return folder / "curve.png"


class LiveRows:
    """Rows of a ``progress.jsonl`` that is being written; calling it returns those that are whole.

    Args:
        file: which need not be there yet.
    """

    def __init__(self, file: Path):
        self.file, self._rows, self._read = file, list[dict[str, float]](), 0

    def __call__(self) -> list[dict[str, float]]:
        """Return all rows so far; a file that has become shorter is read anew."""
        try:
            size = self.file.stat().st_size
        except OSError:
            return self._rows
        if size < self._read:
            self._rows, self._read = [], 0
        if size > self._read:
            with self.file.open("rb") as file:
                file.seek(self._read)
                text = file.read(size - self._read)
            whole = text[: text.rfind(b"\n") + 1]
            self._read += len(whole)
            self._rows += [json.loads(line) for line in whole.splitlines() if line.strip()]
        return self._rows
