"""Loggers of trainings, read by their libraries' own readers."""

import json
import time
import types

import pytest

torch = pytest.importorskip("torch")
learning = pytest.importorskip("warp_spo.env.learning")

from support.env_scenes import cart_env  # noqa: E402
from warp_spo.env import loggers, training_log  # noqa: E402

LEARNER = learning.Learner(iterations=5, steps=4, hidden=(8,), epochs=2, batches=2)
FLOAT32 = 1e-5  # of numbers that TensorBoard keeps in float32, and rows with six digits
TAGS = {"Train/mean_reward": "reward", "Loss/value": "loss/value", "Loss/surrogate": "loss/surrogate",
        "Loss/entropy": "loss/entropy", "Loss/learning_rate": "rate", "Policy/mean_std": "deviation",
        "Perf/collection_time": "collecting", "Perf/learning_time": "learning",
        "Episode_Termination/out": "/termination/out"}  # fmt: skip


def check(series, folder):
    """Numbers of each tag are those of the rows, at their iterations."""
    rows = training_log.read_rows(folder / "progress.jsonl")
    for tag, name in TAGS.items():
        assert series[tag] == {int(row["iteration"]): pytest.approx(row[name], rel=FLOAT32, abs=1e-9) for row in rows
                               if tag != "Train/mean_reward" or row["/episode/finished"]}, tag  # fmt: skip
    last = rows[-1]
    assert series["Episode_Reward/up"][4] == pytest.approx(last["/reward/up"] / 0.4, rel=FLOAT32)
    steps = 8 * LEARNER.steps / (last["collecting"] + last["learning"])
    assert series["Perf/total_fps"][4] == pytest.approx(steps, rel=FLOAT32)
    assert series["Train/mean_episode_length"][4] == pytest.approx(last["/episode/seconds"] / 0.02, rel=FLOAT32)


def train_in_two_parts(folder, name):
    """Train three iterations, and again from the first checkpoint on, whose rows are dropped."""
    make = lambda: cart_env(terminations={"out": lambda w: abs(w.q[0]) > 0.1})  # noqa: E731
    learning.train(make(), LEARNER, folder, 3, loggers=[name], save_interval=2)
    (folder / "last.pt").unlink()
    learning.train(make(), LEARNER, folder, 5, loggers=[name], resume=folder / "model_2.pt")


def test_tensorboard_reads_the_tags(tmp_path):
    accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    train_in_two_parts(tmp_path, "tensorboard")
    read = accumulator.EventAccumulator(str(tmp_path)).Reload()
    names = read.Tags()["scalars"]
    check({tag: {each.step: each.value for each in read.Scalars(tag)} for tag in names}, tmp_path)


def records(data):
    """Return the records of a file of W&B: LevelDB's log format, in blocks of 32 KiB, after seven bytes of its own."""
    at, parts, found = 7, b"", []
    while at + 7 <= len(data):
        left = 32768 - at % 32768
        size, kind = int.from_bytes(data[at + 4 : at + 6], "little"), data[at + 6] if left >= 7 else 0
        if kind == 0:  # padding
            at += left
            continue
        parts = data[at + 7 : at + 7 + size] if kind in (1, 2) else parts + data[at + 7 : at + 7 + size]
        found += [parts] if kind in (1, 4) else []
        at += 7 + size
    return found


@pytest.mark.slow
def test_an_offline_run_of_wandb_holds_the_tags(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    from wandb.proto import wandb_internal_pb2

    for name, value in {"WANDB_MODE": "offline", "WANDB_SILENT": "true"}.items():
        monkeypatch.setenv(name, value)
    train_in_two_parts(tmp_path, "wandb")
    files = sorted(tmp_path.glob("wandb/offline-run-*/*.wandb"), key=lambda file: file.stat().st_mtime)
    series, names, ends = {}, set(), time.monotonic() + 30.0
    for file in files:
        found = []
        while not any(record.HasField("exit") for record in found) and time.monotonic() < ends:  # written behind
            found = [wandb_internal_pb2.Record.FromString(data) for data in records(file.read_bytes())]
        for record in found:
            items = {"/".join(item.nested_key): json.loads(item.value_json) for item in record.history.item}
            names |= {record.run.run_id} if record.run.run_id else set()
            for tag, value in items.items():
                series.setdefault(tag, {})[int(items["_step"])] = value
    assert len(files) == 2 and names == {(tmp_path / "wandb_run.txt").read_text().strip()}
    check(series, tmp_path)


def test_a_logger_that_fails_does_not_end_the_training(tmp_path, monkeypatch):
    """A warning says so, once, and the end names it."""

    class Failing:
        def __init__(self, *_):
            self.close = lambda: None

        def log(self, *_):
            raise RuntimeError("its server is gone")

    monkeypatch.setitem(loggers.KINDS, "tensorboard", Failing)
    runner, left = learning.prepare(cart_env(), LEARNER, tmp_path, 3, loggers=["tensorboard"])
    with pytest.warns(
        UserWarning, match="logger tensorboard has failed .its server is gone.; the training goes on"
    ) as w:
        ending = learning.run(runner, left)
    assert len(w) == 1 and ending.iteration == 2 and ending.status == 1
    assert ending.unwritten == ("tensorboard (from iteration 0 on: its server is gone)",)


def test_levels_are_curricula():
    env = types.SimpleNamespace(
        max_episode_length=10, step_dt=0.1, levels=lambda: {"terrain": torch.tensor([[1.0, 9], [2, 9]])}
    )
    row = {"collecting": 1.0, "learning": 1.0, "rate": 1.0, "deviation": 1.0, "/episode/finished": 0.0,
           "/episode/whole": 0.0, "reward": 0.0, "/not finite/state": 3.0}  # fmt: skip
    found = loggers.tags(row, env, 8)
    assert found["Curriculum/terrain"] == 1.5 and found["Metrics/not_finite_state"] == 3.0
    assert "Train/mean_reward" not in found and found["Perf/total_fps"] == 4.0


def test_a_logger_that_is_not_there_is_named():
    with pytest.raises(ValueError, match="logger 'neptune'; expected some of tensorboard, wandb"):
        learning.prepare(cart_env(), LEARNER, "nowhere", 3, loggers=["neptune"])
