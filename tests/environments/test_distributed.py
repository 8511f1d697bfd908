"""Training in several processes: worlds are those of one process, gradients are means, and the policy is one."""

import os
import pathlib
import signal
import socket
import subprocess
import sys
import time

import pytest
import torch
import torch.multiprocessing as processes

from warp_spo import train
from warp_spo.env import learning, make, training_log
from warp_spo.env.tasks import task

pytestmark = pytest.mark.slow
WORLDS, ITERATIONS = 16, 2
MEAN = 1e-6  # of float32 gradients, against their largest entry
FUSED = 1e-4  # of weights after two updates, whose sums have another order


def free_port():
    with socket.socket() as one:
        one.bind(("localhost", 0))
        return one.getsockname()[1]


def learn(rank, size, port, folder, fuses=None):
    """Train the cart-pole in process ``rank``; leave starts, gradients before and after averaging, and weights."""
    learning.CapturedPPO.fuses = fuses
    os.environ |= {"RANK": str(rank), "LOCAL_RANK": str(rank), "WORLD_SIZE": str(size)}
    os.environ |= {"MASTER_ADDR": "localhost", "MASTER_PORT": str(port)}
    torch.set_num_threads(1)
    env = make("cartpole", worlds=WORLDS, device="cpu", first_world=rank * WORLDS)
    found = {"starts": torch.cat([env.q, env.qd], dim=1), "own": [], "mean": []}
    reduce = learning.CapturedPPO.reduce_parameters

    def watched(ppo):
        weights = [*ppo.actor.parameters(), *ppo.critic.parameters()]
        flat = lambda: torch.cat([w.grad.ravel() for w in weights])  # noqa: E731
        found["own"].append(flat())
        reduce(ppo)
        found["mean"].append(flat())

    learning.CapturedPPO.reduce_parameters = watched
    runner = learning.train(env, task("cartpole").LEARNER, folder, ITERATIONS, seed=rank)
    found["state"] = {f"{part} {name}": value for part in ("actor", "critic")
                      for name, value in getattr(runner.alg, part).state_dict().items()}  # fmt: skip
    found["rate"] = runner.alg.learning_rate
    torch.save(found, folder / f"found_{rank}.pt")
    learning.leave()


def test_two_processes_learn_one_policy(tmp_path):
    processes.start_processes(learn, (2, free_port(), tmp_path), nprocs=2, start_method="spawn")
    a, b = (torch.load(tmp_path / f"found_{rank}.pt", weights_only=True) for rank in range(2))
    together = make("cartpole", worlds=2 * WORLDS, device="cpu")
    assert torch.cat([a["starts"], b["starts"]]).equal(torch.cat([together.q, together.qd], dim=1))
    assert not a["starts"].equal(b["starts"])
    settings = task("cartpole").LEARNER
    assert len(a["own"]) == ITERATIONS * settings.epochs * settings.batches
    for ours, theirs, mean, other in zip(a["own"], b["own"], a["mean"], b["mean"], strict=True):
        assert mean.equal(other) and not ours.equal(theirs)
        assert (mean - 0.5 * (ours + theirs)).abs().max() <= MEAN * mean.abs().max()
    assert a["rate"] == b["rate"] and a["state"].keys() == b["state"].keys()
    assert all(value.equal(b["state"][name]) for name, value in a["state"].items())  # normalisers, too
    assert sorted(path.name for path in tmp_path.glob("model_*.pt")) == ["model_0.pt", f"model_{ITERATIONS - 1}.pt"]


def test_fused_updates_of_two_processes_are_those_of_torch(tmp_path):
    found = {}
    for fuses in (False, True):
        folder = tmp_path / str(fuses)
        folder.mkdir()
        processes.start_processes(learn, (2, free_port(), folder, fuses), nprocs=2, start_method="spawn")
        found[fuses] = [torch.load(folder / f"found_{rank}.pt", weights_only=True) for rank in range(2)]
    (torch_s, _), (ours, others) = found[False], found[True]
    assert not ours["own"]  # averaged by other code
    assert ours["rate"] == others["rate"] == pytest.approx(torch_s["rate"], rel=1e-6)
    assert all(value.equal(others["state"][name]) for name, value in ours["state"].items())
    expected, own = (torch.cat([x.double().ravel() for x in each["state"].values()]) for each in (torch_s, ours))
    assert (own - expected).norm() < FUSED * expected.norm()


def test_a_device_for_each_process_is_refused(capsys):
    with pytest.raises(SystemExit):
        train.main(["cartpole", "--gpus", "2", "--device", "cuda:0"])
    assert "--gpus 2 with --device cuda:0; expected no --device, or cpu" in capsys.readouterr().err


def torchrun(folder, port, *given):
    """Start torchrun for a training of the cart-pole on the CPU, with eight worlds a process."""
    command = [sys.executable, "-m", "torch.distributed.run", "--rdzv-backend", "c10d", "--rdzv-id", "1"]
    command += ["--rdzv-endpoint", f"localhost:{port}", "--local-addr", "localhost", *given[:4], "-m", "warp_spo.train"]
    command += ["cartpole", "--device", "cpu", "--worlds", "8", "--out", str(folder), *given[4:]]
    own = {**os.environ, "PYTHONPATH": os.pathsep.join([str(pathlib.Path(__file__).parents[2]), *sys.path])}
    return subprocess.Popen(command, env=own, stdout=subprocess.DEVNULL)


def test_two_nodes_have_the_bits_of_one_with_two_processes(tmp_path):
    last, port = {}, free_port()
    given = ("--nnodes", "2", "--nproc-per-node", "1", "--iterations", "3")
    nodes = [torchrun(tmp_path / "two", port, *given) for _ in range(2)]
    assert [each.wait(timeout=300) for each in nodes] == [0, 0]
    assert train.main(["cartpole", "--device", "cpu", "--worlds", "8", "--gpus", "2", "--iterations", "3", "--out",
                       str(tmp_path / "one")]) == 0  # fmt: skip
    for name in ("two", "one"):
        last[name] = torch.load(tmp_path / name / "last.pt", weights_only=True)
    for part in ("actor_state_dict", "critic_state_dict"):
        assert all(x.equal(last["one"][part][name]) for name, x in last["two"][part].items())
    for one, two in zip(last["one"]["worlds"], last["two"]["worlds"], strict=True):
        assert all(x.equal(two["env"][name]) for name, x in one["env"].items())
        assert one["random"]["cpu"].equal(two["random"]["cpu"])


def test_torchrun_goes_on_after_a_killed_process(tmp_path):
    """With one restart, from the newest checkpoint, without --resume on the command line."""
    given = ("--max-restarts", "1", "--nproc-per-node", "2", "--iterations", "12", "--save-interval", "1")
    process = torchrun(tmp_path, free_port(), *given)
    began = time.monotonic()
    while not (tmp_path / "model_3.pt").exists() and time.monotonic() < began + 120.0:
        time.sleep(0.05)
    workers = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True).stdout.split()
    os.kill(int(workers[-1]), signal.SIGKILL)
    assert process.wait(timeout=300) == 0
    rows = training_log.read_rows(tmp_path / "progress.jsonl")
    assert [row["iteration"] for row in rows] == list(range(12))
    assert torch.load(tmp_path / "last.pt", weights_only=True)["iter"] == 11


def test_two_processes_reach_the_return_of_one(tmp_path):
    """The command with two processes, and with one and twice the worlds: 0.2 at first, about 25 in the end."""
    folders, command = (tmp_path / "two", tmp_path / "one"), [sys.executable, "-m", "warp_spo.train", "cartpole"]
    command += ["--device", "cpu", "--iterations", "100", "--seed", "1"]
    own = {**os.environ, "PYTHONPATH": os.pathsep.join([str(pathlib.Path(__file__).parents[2]), *sys.path])}
    for folder, more in zip(folders, (["--gpus", "2", "--worlds", "64"], ["--worlds", "128"]), strict=True):
        subprocess.run([*command, *more, "--out", str(folder)], check=True, env=own, stdout=subprocess.DEVNULL)
    two, one = (training_log.read_rows(folder / "progress.jsonl") for folder in folders)
    assert len(two) == len(one) == 100
    assert max(two[0]["reward"], one[0]["reward"]) < 1.0
    last = [sum(row["reward"] for row in rows[-10:]) / 10.0 for rows in (two, one)]
    assert min(last) > 7.0 and max(last) < 2.0 * min(last)
