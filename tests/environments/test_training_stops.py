"""Trainings that are stopped, killed, or write to a disk that is full: what is kept, and how they go on."""

import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import threading
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")
learning = pytest.importorskip("warp_spo.env.learning")

from support.env_scenes import cart_env  # noqa: E402
from warp_spo import train  # noqa: E402
from warp_spo.env import Env, actions, commands, events, robots, terminations, training_files, training_log  # noqa: E402
from warp_spo.env.tasks import go2_flat, velocity  # noqa: E402

LEARNER = learning.Learner(iterations=5, steps=4, hidden=(8,), epochs=2, batches=2)
SOON = 5.0  # from the end of an iteration to the end of the training [s]
CLOCKS = {"seconds", "collecting", "learning"}  # of a row, which two trainings do not share


def leaves(found, name=""):
    """Return all that a checkpoint holds, by place."""
    if isinstance(found, dict | list | tuple):
        items = found.items() if isinstance(found, dict) else enumerate(found)
        return {place: x for key, value in items for place, x in leaves(value, f"{name}/{key}").items()}
    return {name: found}


def same_bits(one, other):
    """Return the places at which two checkpoints differ."""
    one, other = (leaves(torch.load(file, weights_only=True)) for file in (one, other))
    equal = lambda a, b: torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b  # noqa: E731
    return [name for name in sorted(one.keys() | other.keys()) if not equal(one.get(name), other.get(name))]


def rows_without_clocks(folder):
    rows = training_log.read_rows(folder / "progress.jsonl")
    return [{name: value for name, value in row.items() if name not in CLOCKS} for row in rows]


def check_that_a_stop_leaves_no_trace(make, learner, first, total, tmp_path):
    """A training that stops after ``first`` iterations and goes on ends with the bits of one that does not stop."""
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    learning.train(make(), learner, whole, total, seed=4, save_interval=50)
    learning.train(make(), learner, parts, first, seed=4, save_interval=50)
    learning.train(make(), learner, parts, total, resume="latest", seed=4, save_interval=50)
    assert same_bits(whole / "last.pt", parts / "last.pt") == []
    assert rows_without_clocks(whole) == rows_without_clocks(parts)
    assert len(rows_without_clocks(whole)) == total


def meanwhile(monkeypatch, after, act):
    """Do something while a training learns in its iteration ``after``."""
    update, count = learning.CapturedPPO.update, iter(range(1000))

    def acts(ppo):
        if next(count) == after:
            act(ppo)
        return update(ppo)

    monkeypatch.setattr(learning.CapturedPPO, "update", acts)


def interrupt(monkeypatch, after, number):
    meanwhile(monkeypatch, after, lambda _: os.kill(os.getpid(), number))


def test_a_stopped_training_ends_with_the_bits_of_one_that_was_not(tmp_path):
    check_that_a_stop_leaves_no_trace(lambda: cart_env(seed=3), LEARNER, 2, 5, tmp_path)


@pytest.mark.slow
def test_a_cart_pole_that_stops_after_15_of_40_iterations_has_the_same_bits(tmp_path):
    from warp_spo.env.tasks import cartpole

    make = lambda: cartpole.build(16, "cpu", seed=3)  # noqa: E731
    check_that_a_stop_leaves_no_trace(make, cartpole.LEARNER, 15, 40, tmp_path)


@pytest.mark.slow
def test_a_randomised_go2_with_a_curriculum_has_the_same_bits(tmp_path):
    """Masses, friction and delays that are drawn anew, pushes, encoders' biases, and ranges of commands that grow."""
    robot = robots.load("go2", contacts=("foot", "trunk", "knee"))
    level = commands.Level("alive", share=0.1, step=0.1)

    def make():
        return Env(
            robot.scene, 4, "cpu", default_q=robot.q, episode_length_s=0.3, seed=3,
            actions=actions.Control(scale=0.25, offset="default"),
            commands=commands.Velocity(level=level, seconds=(0.1, 0.3)),
            observations=velocity.observed(go2_flat.FEET),
            rewards=go2_flat.reward_terms(0.08) | {"alive": (1.0, lambda w: 1.0 + 0.0 * w.time)},
            terminations={"fell over": terminations.tilted(np.radians(70.0))},
            events=[*velocity.starts(), *velocity.randomisation("base"), events.delays((0, 3), when=(0.1, 0.2)),
                    events.randomise("body_mass", (0.8, 1.2), when="reset", names=".*calf")],
        )  # fmt: skip

    check_that_a_stop_leaves_no_trace(make, LEARNER, 15, 40, tmp_path)
    (own,) = torch.load(tmp_path / "parts" / "last.pt", weights_only=True)["worlds"]
    assert own["levels"]["command level"].min() > 0.3  # it has grown


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_training_with_a_checkpoint(number, tmp_path, monkeypatch, capsys):
    """After the iteration; the curve is drawn, and the last line is a command that goes on.

    From the signal on it takes ``SOON`` seconds of a core at most, of which a machine that does nothing else gives it
    as many as pass.
    """
    came = []
    meanwhile(monkeypatch, 2, lambda _: (came.append(time.process_time()), os.kill(os.getpid(), number)))
    given = ["cartpole", "--worlds", "4", "--device", "cpu", "--iterations", "9", "--out", str(tmp_path)]
    before = signal.getsignal(number)
    assert train.main(given) == 128 + number and signal.getsignal(number) is before
    assert time.process_time() - came[0] < SOON
    assert torch.load(tmp_path / "last.pt", weights_only=True)["iter"] == 2
    assert {"model_2.pt", "curve.png"} <= {file.name for file in tmp_path.iterdir()}
    last = capsys.readouterr().out.splitlines()[-1]
    name = {signal.SIGINT: "Ctrl-C", signal.SIGTERM: "SIGTERM"}[number]
    assert f"stopped after iteration 2: {name}; go on: python -m warp_spo.train cartpole" in last
    assert last.endswith("--resume latest")
    if number == signal.SIGTERM:
        return
    again = last.split("warp_spo.train ")[1].split()
    assert train.main([*again, "--iterations", "4"]) == 0
    assert [row["iteration"] for row in training_log.read_rows(tmp_path / "progress.jsonl")] == [0, 1, 2, 3]


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_training_of_two_processes_with_a_checkpoint(number, tmp_path):
    """The launcher passes it on; both end after the same iteration, and leave no process behind."""
    given = [
        "cartpole",
        "--worlds",
        "4",
        "--device",
        "cpu",
        "--gpus",
        "2",
        "--iterations",
        "900",
        "--out",
        str(tmp_path),
    ]
    command = [sys.executable, "-m", "warp_spo.train", *given]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    rows, ends = tmp_path / "progress.jsonl", time.monotonic() + 300.0
    while (
        process.poll() is None and time.monotonic() < ends and not (rows.exists() and rows.read_text().count("\n") > 2)
    ):
        time.sleep(0.1)
    process.send_signal(number)
    said, _ = process.communicate(timeout=120.0)
    assert process.returncode == 128 + number, said
    last = int(training_log.read_rows(rows)[-1]["iteration"])
    assert torch.load(tmp_path / "last.pt", weights_only=True)["iter"] == last
    assert f"stopped after iteration {last}: " in said.splitlines()[-1]
    assert said.count("stopped after iteration") == 1


def test_a_signal_reaches_those_who_call_train(tmp_path, monkeypatch):
    interrupt(monkeypatch, 1, signal.SIGINT)
    with pytest.raises(KeyboardInterrupt, match="train: stopped after iteration 1: Ctrl-C"):
        learning.train(cart_env(), LEARNER, tmp_path, 9)
    assert training_files.newest(tmp_path) == tmp_path / "last.pt"


def test_a_second_ctrl_c_ends_at_once(tmp_path, monkeypatch, capsys):
    def twice(_):
        for _ in range(2):
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(1e-3)  # where Python looks for signals

    meanwhile(monkeypatch, 0, twice)
    given = ["cartpole", "--worlds", "4", "--device", "cpu", "--iterations", "9", "--out", str(tmp_path)]
    assert train.main(given) == 130
    assert "stopped at once" in capsys.readouterr().err and not (tmp_path / "last.pt").exists()


def test_a_full_disk_is_a_warning_and_the_training_goes_on(tmp_path):
    """A checkpoint that does not fit is written later; the torn one bears no checkpoint's name."""
    full = tmp_path / "last.pt.part"
    full.symlink_to("/dev/full")
    with pytest.warns(UserWarning, match=r"last.pt' could not be written \(No space left on device\); the training go"):
        learning.train(cart_env(), LEARNER, tmp_path, 3, save_interval=9, every=1)
    assert torch.load(tmp_path / "last.pt", weights_only=True)["iter"] == 2
    assert not full.exists() and not full.is_symlink()


def test_what_was_not_written_is_said_at_the_end(tmp_path, capsys, monkeypatch):
    def lose(_):
        (tmp_path / "last.pt.part").mkdir()  # in the way, as is a folder of the rows' name
        (tmp_path / "progress.jsonl").unlink()
        (tmp_path / "progress.jsonl").mkdir()

    meanwhile(monkeypatch, 1, lose)
    given = ["cartpole", "--worlds", "4", "--device", "cpu", "--iterations", "3", "--out", str(tmp_path)]
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        assert train.main(given) == 1
    assert sum("could not be written" in str(each.message) for each in said) == 2  # once for each file
    last = capsys.readouterr().out.splitlines()[-1]
    found = r"not written: last.pt \(Is a directory\), progress.jsonl \(Is a directory\), curve.png \(Is a directory\)$"
    assert re.search(found, last), last
    assert torch.load(tmp_path / "model_2.pt", weights_only=True)["iter"] == 2


def test_rows_of_a_full_disk_come_later(tmp_path):
    """A row of which the disk took a part is made whole, and none is left out."""
    log = training_log.TrainingLog(cart_env(2), tmp_path, 10, 0.0, True)
    log.init_logging_writer()
    others = {"action_std": torch.ones(1), "learning_rate": 1e-3}
    log.log(0, 9, 0.1, 0.1, {}, **others)
    whole = (tmp_path / "progress.jsonl").read_bytes()
    (tmp_path / "progress.jsonl").write_bytes(whole + whole[:7])  # as a disk does that fills up meanwhile
    log.file = Path("/dev/full")
    with pytest.warns(UserWarning, match="rows are kept"):
        log.log(1, 9, 0.1, 0.1, {}, **others)
    log.file = tmp_path / "progress.jsonl"
    log.log(2, 9, 0.1, 0.1, {}, **others)
    assert [row["iteration"] for row in training_log.read_rows(log.file)] == [0, 1, 2]
    log.file.unlink()
    log.log(3, 9, 0.1, 0.1, {}, **others)
    assert [row["iteration"] for row in training_log.read_rows(log.file)] == [0, 1, 2, 3]


def test_a_folder_that_is_lost_is_made_anew(tmp_path, monkeypatch):
    """With all rows."""
    meanwhile(monkeypatch, 1, lambda _: shutil.rmtree(tmp_path / "run"))
    with pytest.warns(UserWarning, match="progress.jsonl' could not be written .No such file or directory.; its rows"):
        learning.train(cart_env(), LEARNER, tmp_path / "run", 4, save_interval=2)
    assert [row["iteration"] for row in training_log.read_rows(tmp_path / "run" / "progress.jsonl")] == [0, 1, 2, 3]
    assert training_files.read(tmp_path / "run" / "last.pt")["iter"] == 3


@pytest.fixture(scope="module")
def stopped(tmp_path_factory):
    """A folder with a training of three iterations."""
    folder = tmp_path_factory.mktemp("stopped")
    learning.train(cart_env(), LEARNER, folder, 3, save_interval=1)
    return folder


@pytest.mark.parametrize(
    ("damage", "words"),
    [
        (lambda data: data[: len(data) // 2], r"cannot be read \(it is torn: its end is missing after \d+ bytes\)"),
        (lambda data: b"", r"cannot be read \(it is empty\)"),
        (lambda data: b"\x80\x02}q\x00.", "cannot be read|has no"),
        (lambda data: b"hello", r"cannot be read \(\w+\)"),
    ],
)
def test_a_damaged_checkpoint_is_named_with_its_fault(damage, words, stopped, tmp_path):
    file = tmp_path / "model_7.pt"
    file.write_bytes(damage((stopped / "model_2.pt").read_bytes()))
    with pytest.raises(ValueError, match=rf"checkpoint '.*model_7.pt': {words}.*; expected a model_N.pt"):
        learning.prepare(cart_env(), LEARNER, tmp_path / "new", 9, file)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"format": 7}, r"is of format 7, written by warp_spo .*; this warp_spo reads formats up to 1: update it"),
        ({"format": "new"}, "is of format 'new'"),
        ({"iter": "2"}, "iter is '2', its levels are dict; expected an integer"),
        ({"optimizer_state_dict": {}}, "does not fit the task's networks"),
        ({"actor_state_dict": 3}, "does not fit the task's networks"),
    ],
)
def test_a_foreign_checkpoint_is_named_with_its_fault(change, words, stopped, tmp_path):
    torch.save(torch.load(stopped / "model_2.pt", weights_only=True) | change, tmp_path / "model_7.pt")
    with pytest.raises(ValueError, match=f"checkpoint '.*model_7.pt': {words}"):
        learning.prepare(cart_env(), LEARNER, tmp_path / "new", 9, tmp_path / "model_7.pt")


def test_the_latest_checkpoint_is_the_newest_whole_one(stopped, tmp_path):
    """Torn ones are named and passed over; in an empty folder a training begins."""
    folder = tmp_path / "copy"
    folder.mkdir()
    for file in stopped.iterdir():
        (folder / file.name).write_bytes(file.read_bytes())
    assert training_files.newest(folder) == folder / "last.pt"
    (folder / "last.pt").write_bytes((stopped / "last.pt").read_bytes()[:99])
    with pytest.warns(UserWarning, match="last.pt.: cannot be read .it is torn"):
        assert training_files.newest(folder) == folder / "model_2.pt"
    (folder / "model_2.pt").write_bytes(b"")
    (folder / "model_x.pt").write_bytes(b"of somebody else")
    (folder / "last.pt").unlink()
    with pytest.warns(UserWarning, match="model_2.pt.: cannot be read .it is empty"):
        assert training_files.newest(folder) == folder / "model_1.pt"
    assert training_files.newest(tmp_path / "nowhere") is None
    assert learning.prepare(cart_env(), LEARNER, tmp_path / "begins", 2, "latest")[1] == 2


def test_worlds_that_do_not_fit_start_anew(stopped, tmp_path):
    with pytest.warns(UserWarning, match=r"last.pt': its worlds are left \(Env.load_state_dict: .*; others start anew"):
        runner, left = learning.prepare(cart_env(4), LEARNER, tmp_path, 9, stopped / "last.pt")
    assert left == 6 and not runner.resumed


def test_a_torn_last_row_is_dropped(stopped, tmp_path):
    file = tmp_path / "progress.jsonl"
    text = (stopped / "progress.jsonl").read_text()
    file.write_text(text[: text.rindex("reward")])
    assert [row["iteration"] for row in training_log.read_rows(file)] == [0, 1]
    lines = text.splitlines(keepends=True)
    for wrong in ("{'iteration': 1\n", "[3]\n", '{"iteration": 1}\n'):
        file.write_text(lines[0] + wrong + lines[2])
        with pytest.raises(ValueError, match=r"progress.jsonl': line 2 is no row of a training \(.*remove the line"):
            training_log.read_rows(file)


def test_a_resumed_training_draws_other_random_numbers(stopped, tmp_path):
    """From a checkpoint without worlds: starts, lengths of episodes and exploration are not those of iteration 0."""
    numbers = []
    for resume in (None, stopped / "model_0.pt", stopped / "model_1.pt"):
        runner, _ = learning.prepare(cart_env(seed=0), LEARNER, tmp_path, 9, resume)
        numbers.append(torch.cat([runner.env.q.ravel(), torch.randn(8)]))
        again, _ = learning.prepare(cart_env(seed=0), LEARNER, tmp_path, 9, resume)
        assert torch.equal(numbers[-1], torch.cat([again.env.q.ravel(), torch.randn(8)]))
    assert all((a != b).all() for a, b in zip(numbers, (*numbers[1:], numbers[0]), strict=True))


@pytest.mark.parametrize("spoilt", ["value", "surrogate"])
def test_a_policy_that_turns_not_finite_stops_the_training(spoilt, tmp_path, monkeypatch):
    """The message names iteration and term; the checkpoint is the policy before, with its optimizer."""
    before = {}

    def spoil(ppo):
        before.update(actor=[x.clone() for x in ppo.actor.state_dict().values()], rate=ppo.learning_rate)
        name = {"value": "returns", "surrogate": "advantages"}[spoilt]
        spoilt_numbers = getattr(ppo.storage, name).clone()
        spoilt_numbers[0, 0] = torch.nan
        setattr(ppo.storage, name, spoilt_numbers)

    meanwhile(monkeypatch, 2, spoil)
    with pytest.raises(FloatingPointError, match=f"train: stopped by iteration 2: loss {spoilt} not finite$"):
        learning.train(cart_env(), LEARNER, tmp_path, 9)
    assert sorted(file.name for file in tmp_path.glob("*.pt")) == ["last.pt", "model_0.pt", "model_1.pt"]
    kept = torch.load(tmp_path / "model_1.pt", weights_only=True)
    assert all(map(torch.equal, kept["actor_state_dict"].values(), before["actor"]))
    groups = kept["optimizer_state_dict"]
    assert groups["param_groups"][0]["lr"] == before["rate"]
    assert {int(each["step"]) for each in groups["state"].values()} == {2 * LEARNER.epochs * LEARNER.batches}
    assert training_files.newest(tmp_path) == tmp_path / "model_1.pt"


def test_a_policy_that_is_not_finite_at_once_leaves_no_checkpoint(tmp_path, monkeypatch):
    monkeypatch.setattr(learning.CapturedPPO, "compute_returns", lambda ppo, obs: ppo.storage.returns.fill_(torch.inf))
    with pytest.raises(FloatingPointError, match=r"stopped by iteration 0: loss (surrogate, )?value not finite"):
        learning.train(cart_env(), LEARNER, tmp_path, 9)
    assert not list(tmp_path.glob("*.pt"))


def command(*given):
    own = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *sys.path])}
    return subprocess.Popen([sys.executable, "-m", "warp_spo.train", "cartpole", "--device", "cpu", "--worlds", "8",
                             *given], env=own, stdout=subprocess.PIPE, text=True)  # fmt: skip


def wait_for_line(process, words, seconds=120.0):
    """Read the output of a process up to a line that holds some words."""
    watch = threading.Timer(seconds, process.kill)
    watch.start()
    for line in process.stdout:
        if words in line:
            watch.cancel()
            return
    raise AssertionError(f"no line with {words!r}")


def seconds_of(process):
    """Return the seconds that a process and its children have had of a core."""
    found = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True).stdout.split()
    stats = [Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split() for pid in (process.pid, *found)]
    return sum(int(ticks) for stat in stats for ticks in stat[11:13]) / os.sysconf("SC_CLK_TCK")


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_two_processes_end_by_a_signal(number, tmp_path):
    """Both, soon, with the signal's status, and none is left behind; one of the two is enough to stop by the clock."""
    ended = sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2])
    process = command("--gpus", "2", "--iterations", "9999", "--out", str(tmp_path))
    wait_for_line(process, "iteration    0")
    before = seconds_of(process)
    process.send_signal(number)
    out = process.communicate(timeout=60)[0]
    assert process.returncode == 128 + number, out
    assert sum(resource.getrusage(resource.RUSAGE_CHILDREN)[:2]) - ended - before < 2 * SOON  # of both
    assert "go on: python -m warp_spo.train cartpole" in out.splitlines()[-1]
    assert len(torch.load(tmp_path / "last.pt", weights_only=True)["worlds"]) == 2
    again = command(
        "--gpus", "2", "--iterations", "9999", "--out", str(tmp_path), "--resume", "latest", "--seconds", "1"
    )
    assert again.wait(timeout=120) == 0
    assert subprocess.run(["pgrep", "-f", str(tmp_path)], capture_output=True).returncode == 1


@pytest.mark.slow
def test_a_process_that_is_killed_ends_the_other(tmp_path):
    process = command("--gpus", "2", "--iterations", "9999", "--out", str(tmp_path))
    wait_for_line(process, "iteration    0")
    found = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True).stdout.split()
    assert len(found) == 2
    os.kill(int(found[1]), signal.SIGKILL)
    process.communicate(timeout=60)
    assert process.returncode in (128 + signal.SIGKILL, 1)  # the other may have noticed first
    assert subprocess.run(["pgrep", "-f", str(tmp_path)], capture_output=True).returncode == 1


@pytest.mark.slow
def test_a_training_that_is_killed_goes_on(tmp_path):
    from benchmarks import killed_trainings

    found = killed_trainings.run(tmp_path, kills=3, seed=1)
    assert found["kills"] == 3 and found["faults"] == []
