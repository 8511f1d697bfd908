"""Episodes in a Minari data set, read back by Minari, beside what the environment returned."""

import numpy as np
import pytest
import torch

from support.env_scenes import cart_env
from warp_spo.env import datasets

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")


def policy(observed):
    """Push where the pole falls, so that some episodes end by the termination and others by their length."""
    return 0.6 * torch.sign(observed["actor"][:, 2:3] + observed["actor"][:, :1] * 3.0)


@pytest.mark.parametrize("several", [False, True])
def test_episodes_are_read_back(several, tmp_path, monkeypatch):
    """Observations, actions, rewards and ends of worlds in turn, as an environment of the same seed returns them."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    terms = {"actor": [lambda w: w.q, lambda w: w.qd], "critic": [lambda w: w.qd]}
    options = {"final_observations": True, "observations": terms if several else {"actor": terms["actor"]}}
    made = datasets.record(cart_env(3, **options), policy, "cart/pushed-v0", 5, algorithm_name="signs", author="us",
                           code_permalink="none", author_email="none")  # fmt: skip
    read = minari.load_dataset("cart/pushed-v0")
    assert read.total_episodes == made.total_episodes == 5
    env = cart_env(3, **options)
    observed, _ = env.reset()
    episodes = [[] for _ in range(3)]
    rows = [[] for _ in range(3)]
    before = {name: observed[name].numpy().copy() for name in env.num_obs}
    while min(map(len, episodes)) < 2:
        actions = policy(observed)
        observed, reward, done, extras = env.step(actions)
        after = {name: extras["final_observations"][name].numpy().copy() for name in env.num_obs}
        for world in range(3):
            late = bool(extras["time_outs"][world])
            ends = bool(done[world]) and not late, late
            seen = [{name: x[world] for name, x in each.items()} for each in (before, after)]
            rows[world].append([*seen, actions[world].numpy(), float(reward[world]), *ends])
            if done[world]:
                episodes[world].append(rows[world])
                rows[world] = []
        before = {name: observed[name].numpy().copy() for name in env.num_obs}
    for number, episode in enumerate(read.iterate_episodes()):
        expected = episodes[number % 3][number // 3]
        assert len(episode) == len(expected) == len(episode.actions)
        for name in env.num_obs:
            seen = episode.observations[name] if several else episode.observations
            assert len(seen) == len(expected) + 1
            assert np.array_equal(seen[:-1], [row[0][name] for row in expected])
            assert np.array_equal(seen[1:], [row[1][name] for row in expected])
        assert np.array_equal(episode.actions, [row[2] for row in expected])
        assert np.allclose(episode.rewards, [row[3] for row in expected], rtol=1e-6)
        assert episode.terminations.tolist() == [row[4] for row in expected]
        assert episode.truncations.tolist() == [row[5] for row in expected]
        assert episode.terminations[-1] != episode.truncations[-1]
    assert read.observation_space.contains(_first(read, several))
    with pytest.raises(ValueError, match="final_observations=True"):
        datasets.record(cart_env(1), policy, "cart/none-v0", 1)


def test_a_name_is_refused_before_an_episode_is_played(tmp_path, monkeypatch):
    """One that Minari's own parser refuses, and one of a data set that is there."""
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    env = cart_env(1, final_observations=True)

    def never(observed):
        raise AssertionError("an episode was played")

    for name in ("bad_name", "cart/x-v", "", None):
        with pytest.raises(ValueError, match="which Minari refuses; expected NAME-vNUMBER"):
            datasets.record(env, never, name, 1)
    datasets.record(env, policy, "cart/there-v0", 1)
    with pytest.raises(ValueError, match="has a data set 'cart/there-v0' already"):
        datasets.record(env, never, "cart/there-v0", 1)


def _first(read, several):
    episode = next(iter(read.iterate_episodes()))
    return {name: x[0] for name, x in episode.observations.items()} if several else episode.observations[0]
