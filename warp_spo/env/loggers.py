"""Loggers of a training beside its own rows: TensorBoard and Weights & Biases, by these libraries' own writers.

Tags are those of rsl_rl, mjlab and Isaac Lab: ``Train/mean_reward``, ``Train/mean_episode_length`` [steps],
``Loss/NAME``, ``Policy/mean_std``, ``Perf/total_fps``, ``Perf/collection_time`` and ``Perf/learning_time`` [s];
``Episode_Reward/NAME``, the mean sum of an episode over the length of a whole one [1/s]; ``Episode_Termination/NAME``,
the share of episodes that it ended; ``Episode_Metrics/NAME``, the mean of a metric over an episode;
``Curriculum/NAME``, the mean level; ``Metrics/not_finite_NAME``, a count.
"""

from __future__ import annotations

import importlib.util
import os
import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .environment import Env

PREFIXES = {
    "loss/": "Loss/", "/termination/": "Episode_Termination/", "/not finite/": "Metrics/not_finite_",
    "/metric/": "Episode_Metrics/",
}  # fmt: skip


def tags(row: Mapping[str, float], env: Env, frames: int) -> dict[str, float]:
    """Return a row of the log by tags; ``frames``: steps of worlds in an iteration, of all processes."""
    seconds = row["collecting"] + row["learning"]
    found = {"Loss/learning_rate": row["rate"], "Policy/mean_std": row["deviation"],
             "Perf/total_fps": frames / max(seconds, 1e-9), "Perf/collection_time": row["collecting"],
             "Perf/learning_time": row["learning"]}  # fmt: skip
    for name, value in row.items():
        for prefix, tag in PREFIXES.items():
            if name.startswith(prefix):
                found[tag + name.removeprefix(prefix)] = value
    if not row["/episode/finished"]:
        found = {name: value for name, value in found.items() if not name.startswith("Episode_Metrics/")}
    if row["/episode/finished"]:
        found["Train/mean_reward"] = row["reward"]
        whole = env.max_episode_length * env.step_dt
        own = {name.removeprefix("/reward/"): value for name, value in row.items() if name.startswith("/reward/")}
        found |= {f"Episode_Reward/{name}": value / whole for name, value in own.items()}
    if row["/episode/whole"]:
        found["Train/mean_episode_length"] = row["/episode/seconds"] / env.step_dt
    return found | {f"Curriculum/{name}": float(level[:, 0].mean()) for name, level in env.levels().items()}


class TensorBoardLogger:
    """Writes an event file of TensorBoard into a folder, one event an iteration.

    Args:
        folder: of the training. first: iteration that it goes on with; readers forget those from it on.
    """

    def __init__(self, folder: Path, first: int, _: Mapping[str, Any]):
        from tensorboard.compat.proto.event_pb2 import Event, SessionLog
        from tensorboard.compat.proto.summary_pb2 import Summary
        from tensorboard.summary.writer.event_file_writer import EventFileWriter

        self._event, self._summary, self._writer = Event, Summary, EventFileWriter(str(folder), flush_secs=10)
        if first:
            self._writer.add_event(Event(step=first, session_log=SessionLog(status=SessionLog.START)))

    def log(self, found: Mapping[str, float], iteration: int, time: float) -> None:
        """Write the numbers of an iteration."""
        values = [self._summary.Value(tag=tag, simple_value=value) for tag, value in found.items()]
        self._writer.add_event(self._event(wall_time=time, step=iteration, summary=self._summary(value=values)))

    def close(self) -> None:
        """Write what waits."""
        self._writer.close()


class WandbLogger:
    """Logs to a run of Weights & Biases, in the folder's ``wandb``; a training that resumes goes on with its run.

    The library's own variables decide where it goes: ``WANDB_MODE=offline``, ``WANDB_PROJECT``, ``WANDB_ENTITY``.

    Args:
        folder: of the training. config: what it runs with.
    """

    def __init__(self, folder: Path, _: int, config: Mapping[str, Any]):
        import wandb

        held = folder / "wandb_run.txt"
        name = held.read_text().strip() if held.exists() else secrets.token_hex(4)
        held.write_text(name + "\n")
        project = os.environ.get("WANDB_PROJECT", "warp_spo")
        self._run = wandb.init(
            project=project, name=folder.name, dir=str(folder), id=name, resume="allow", config=dict(config)
        )

    def log(self, found: Mapping[str, float], iteration: int, _: float) -> None:
        """Write the numbers of an iteration."""
        self._run.log(dict(found), step=iteration)

    def close(self) -> None:
        """Write what waits."""
        self._run.finish()


KINDS = {"tensorboard": TensorBoardLogger, "wandb": WandbLogger}


def check_loggers(names: Sequence[str] | None) -> list[str]:
    """Return names of loggers; None: TensorBoard where it is installed.

    Raises:
        ValueError: a name is unknown. ImportError: its package is missing.
    """
    if names is None:
        return ["tensorboard"] if importlib.util.find_spec("tensorboard") is not None else []
    for name in names:
        if name not in KINDS:
            raise ValueError(f"train: logger {name!r}; expected some of {', '.join(KINDS)}")
        if importlib.util.find_spec(name) is None:
            raise ImportError(f"train: logger {name!r} needs its package; pip install {name}")
    return list(dict.fromkeys(names))


def start(name: str, folder: Path, first: int, config: Mapping[str, Any]) -> Any:
    """Return a logger of a training; ValueError with the words of its library where it does not start."""
    try:
        return KINDS[name](folder, first, config)
    except Exception as error:  # of another library
        raise ValueError(f"train: logger {name} does not start ({type(error).__name__}: {error})") from error
