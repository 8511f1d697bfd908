"""The ready tasks are what an independent MDP in NumPy says, and what is planted into them is found."""

import pytest

pytest.importorskip("rsl_rl")

from benchmarks.mdp.comparison import Comparison
from benchmarks.mdp.tasks import TASKS
from warp_spo.env.tasks import cartpole


def faults_of(name, worlds, steps):
    compared = Comparison(name, worlds)
    compared.run(steps)
    assert all(compared.counts[what] for what in ("ends", "first observations", "resets"))
    return compared.faults


@pytest.mark.parametrize("name", ["cartpole", "panda-reach"])
def test_a_task_in_short(name):
    assert faults_of(name, 6, 60) == {}


@pytest.mark.slow
@pytest.mark.parametrize("name", TASKS)
def test_a_task(name):
    """500 steps of 32 worlds are the command's, with a committed result."""
    assert faults_of(name, 32, 150) == {}


def test_planted_faults_are_found(monkeypatch):
    """Another rail, another weight of the reward of balance: an end and a reward are named."""
    monkeypatch.setattr(cartpole, "RAIL", 1.5)
    monkeypatch.setattr(cartpole, "effort", lambda w: 1.01 * w.action[0] ** 2)
    found = faults_of("cartpole", 6, 60)
    assert {"reward", "sum of the reward effort", "end of an episode", "end: end of the rail"} <= found.keys()
