"""Environments as Gymnasium's vector environments: autoreset modes, seeds, information, wrappers around them."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import data_equivalence
from gymnasium.utils.performance import benchmark_vector_step
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers import vector as wrappers

import warp_spo.env
from support.env_scenes import cart_env, walker_env
from warp_spo.env import Observation, actions, events

MODES = [mode.value for mode in AutoresetMode]
AGES = [0, 7, 14]  # of the first episodes, so that they end one after the other


def restless_env(worlds, **more):
    """Return carts that leave the rail now and then; masses, centres of mass, starts and noise are random."""
    options = {
        "actions": actions.Effort("slide", scale=40.0),
        "observations": {"actor": [Observation(lambda w: w.q, noise=0.1, history=2)], "critic": [lambda w: w.qd]},
        "events": [
            events.randomise("body_mass", (0.5, 2.0)),
            events.randomise("body_com", (-0.1, 0.1), "add", when="reset"),
            events.joints((-0.1, 0.1), (-0.2, 0.2)),
        ],
        "terminations": {"out": lambda w: abs(w.q[0]) > 0.15},
        "final_observations": True,
        "log_interval": 1,
        "seed": 4,
    }
    env = cart_env(worlds, **(options | more))
    first = more.get("first_world", 0)
    env.episode_length_buf = torch.tensor(AGES[first : first + worlds])
    return env


def forces(step):
    return np.random.default_rng(step).uniform(-1.0, 1.0, (3, 1)).astype(np.float32)


@pytest.mark.parametrize("mode", MODES)
def test_autoreset_modes_are_those_of_gymnasium(mode):
    """All is that of Gymnasium's SyncVectorEnv of three environments of one world each, to the bit."""
    singles = [lambda i=i: warp_spo.env.gymnasium(restless_env(1, first_world=i), single=True) for i in range(3)]
    theirs = SyncVectorEnv(singles, autoreset_mode=mode)
    ours = warp_spo.env.gymnasium(restless_env(3), autoreset_mode=mode)
    assert ours.metadata["autoreset_mode"] is theirs.metadata["autoreset_mode"] is AutoresetMode(mode)
    ended = np.zeros((2, 3), dtype=int)
    for step in range(50):
        (observed, *results, info), (wanted, *truth, expected) = (each.step(forces(step)) for each in (ours, theirs))
        assert data_equivalence(observed, wanted) and observed in ours.observation_space
        for one, other in zip(results, truth, strict=True):
            np.testing.assert_array_equal(one, other)
        done = results[1] | results[2]
        ended += results[1:]
        assert ("final_obs" in info) == ("final_obs" in expected) == (mode == "SameStep" and done.any())
        for world in np.flatnonzero(done) if "final_obs" in info else ():
            assert data_equivalence(info["final_obs"][world], expected["final_obs"][world])
        if mode == "Disabled" and done.any():
            with pytest.raises(
                RuntimeError, match=r"autoreset_mode is 'Disabled' and episodes of worlds \[.*expected res"
            ):
                ours.step(forces(step))
            seen = [each.reset(options={"reset_mask": done.copy()})[0] for each in (ours, theirs)]
            assert data_equivalence(*seen)
    assert (ended.sum(axis=1) > 2).all()  # by leaving, and by length


def test_modes_are_checked():
    with pytest.raises(
        ValueError, match=r"autoreset_mode is 'Never'; expected one of 'NextStep', 'SameStep', 'Disabled'"
    ):
        warp_spo.env.gymnasium(cart_env(2), autoreset_mode="Never")
    with pytest.raises(ValueError, match=r"'NextStep' with final_observations=False; .*final_observations=True"):
        warp_spo.env.gymnasium(cart_env(2), autoreset_mode=AutoresetMode.NEXT_STEP)


@pytest.mark.parametrize("mode", MODES)
def test_a_world_that_nobody_resets_waits(mode):
    """Resets of others, by a mask, show its last observation in the modes in which it waits."""
    worlds = warp_spo.env.gymnasium(restless_env(3), autoreset_mode=mode)
    worlds.env.episode_length_buf = torch.tensor([0, 19, 19])
    observed, _, _, late, _ = worlds.step(forces(0))
    assert late.tolist() == [False, True, True]
    again, _ = worlds.reset(options={"reset_mask": np.array([True, True, False])})
    kept = [(again["actor"][i] == observed["actor"][i]).all() for i in range(3)]
    assert kept == [False, False, True]
    if mode != "Disabled":
        _, rewards, *_ = worlds.step(forces(1))
        assert (rewards == 0.0).tolist() == [False, False, mode == "NextStep"]


def test_actions_of_worlds_that_wait_leave_no_failure(tmp_path):
    """Gymnasium drops them, so one that is not finite is neither counted nor kept; of a world that plays it is both."""
    env = restless_env(3, keep_failures=tmp_path)
    worlds = warp_spo.env.gymnasium(env, autoreset_mode="NextStep")
    env.episode_length_buf = torch.tensor([0, 19, 19])
    assert worlds.step(forces(0))[3].tolist() == [False, True, True]
    spoilt = np.asarray(forces(1)).copy()
    spoilt[1] = np.nan
    worlds.step(spoilt)
    assert not env.failure_files() and env.log()["/not finite/action"] == 0
    worlds.step(spoilt)
    assert [file.name for file in env.failure_files()] == ["world_00001_step_000002.pt"]


def wrapped(mode, **more):
    return warp_spo.env.gymnasium(restless_env(3, **more), autoreset_mode=mode)


@pytest.mark.parametrize("mode", ["NextStep", "Disabled"])  # Gymnasium's wrappers of observations refuse the third
def test_wrappers_of_observations(mode):
    """Each gives what NumPy makes of the same steps; Gymnasium allows NormalizeObservation in one mode alone."""
    one_group = {"observations": {"actor": [lambda w: w.q, lambda w: w.qd]}}
    plain, flat, single = wrapped(mode), wrappers.FlattenObservation(wrapped(mode)), wrapped(mode, **one_group)
    doubled = wrappers.VectorizeTransformObservation(
        wrapped(mode, **one_group),
        gymnasium.wrappers.TransformObservation,
        func=lambda x: np.stack([x, 2 * x]),
        observation_space=gymnasium.spaces.Box(-np.inf, np.inf, (2, 4), np.float32),
    )
    moved = wrappers.TransformObservation(wrapped(mode, **one_group), lambda x: x + 1.0)
    every = [plain, flat, single, doubled, moved]
    if mode == "NextStep":
        every.append(wrappers.NormalizeObservation(wrapped(mode, **one_group)))
    seen = [each.reset(seed=2) for each in every]
    past, ended = [], 0
    for step in range(25):
        groups, row, one, two, more, *normal = (each[0] for each in seen)
        np.testing.assert_array_equal(row, np.concatenate([groups["actor"], groups["critic"]], axis=1))
        np.testing.assert_array_equal(two, np.stack([one, 2 * one], axis=1))
        np.testing.assert_array_equal(more, one + 1.0)
        past.append(one)
        if normal and step > 5:
            mean, deviation = np.concatenate(past).mean(axis=0), np.concatenate(past).std(axis=0)
            np.testing.assert_allclose(normal[0], (one - mean) / deviation, atol=1e-2)  # its count starts at 1e-4
        seen = [each.step(forces(step)) for each in every]
        done = seen[0][2] | seen[0][3]
        ended += done.sum()
        if mode == "Disabled" and done.any():
            seen = [each.reset(options={"reset_mask": done.copy()}) for each in every]
    assert ended > 2


@pytest.mark.parametrize("mode", MODES)
def test_information_is_by_world(mode):
    """Lists of dictionaries, statistics of episodes and Gymnasium's measurement take what the environment gives."""
    listed = wrappers.DictInfoToList(wrappers.RecordEpisodeStatistics(wrapped(mode)))
    assert listed.reset(seed=1)[1] == [{}, {}, {}]
    lengths: list = []
    for step in range(45):
        *_, ended, late, info = listed.step(forces(step))
        done = ended | late
        assert [set(each["log"]) for each in info] == [set(listed.env.env.env.log())] * 3
        assert all(isinstance(x, np.floating) for each in info for x in each["log"].values())
        assert [("final_obs" in each) for each in info] == [mode == "SameStep" and one for one in done]
        lengths += [info[i]["episode"]["l"] for i in np.flatnonzero(done)]
        if mode == "Disabled" and done.any():
            listed.reset(options={"reset_mask": done.copy()})
    assert len(lengths) >= 6 and max(lengths) == 20  # steps of an episode
    assert benchmark_vector_step(wrapped(mode), target_duration=0.05, seed=3) > 0.0


def test_a_log_is_of_the_steps_that_count():
    """Episodes that Gymnasium's mode holds back do not go on: the log counts as that of the plain environment."""
    counts = []
    for mode in ("SameStep", "NextStep"):
        env = wrapped(mode, terminations={"always": lambda w: w.time > 0.0})
        for step in range(10):
            *_, info = env.step(forces(step))
        counts.append(env.env.memory("episodes").ravel().tolist())
        assert info["log"]["/episode/finished"].tolist() == [3.0] * 3
    assert counts == [[10.0] * 3, [5.0] * 3]


def test_tensors():
    worlds = warp_spo.env.gymnasium(restless_env(3), tensors=True, autoreset_mode="NextStep")
    worlds.env.episode_length_buf = torch.tensor([19, 0, 0])
    _, _, _, late, info = worlds.step(torch.ones(3, 1))
    assert late.tolist() == [True, False, False] and all(x.shape == (3,) for x in info["log"].values())
    assert worlds.step(torch.ones(3, 1))[1].eq(0.0).tolist() == [True, False, False]
    same = warp_spo.env.gymnasium(restless_env(3), tensors=True)
    assert same.step(torch.ones(3, 1))[4]["final_obs"]["actor"].shape == (3, 4)


def wandering_env(seed):
    """Return walkers whose masses, biases of sensors and encoders and delays are drawn at the start."""
    drawn = [
        events.randomise("body_mass", (0.5, 2.0)),
        events.randomise("contact_friction", (0.5, 1.0), when=(0.02, 0.05)),
        events.delays((0, 3)),
        events.encoder_bias(0.1),
        events.push(0.5, seconds=(0.02, 0.1)),
    ]
    biased = {"actor": [Observation(lambda w: w.encoder_q(), bias=0.2, delay=(0, 2), noise=0.1)]}
    return walker_env(3, seed=seed, events=drawn, observations=biased, episode_length_s=0.1)


@pytest.mark.parametrize("seed", [5, [7, 2**63, 7]])
def test_a_seed_gives_equal_worlds(seed):
    """Whatever environments did before, the seed gives the worlds of a new environment, to the bit, and goes on so."""
    envs = [wandering_env(1), wandering_env(2)]
    for _ in range(8):
        envs[0].step(torch.randn(3, 8))
    envs[0].episode_length_buf = torch.tensor([1, 2, 0])
    envs[1].values["body_mass"].mul_(1.5)
    kept = envs[0].values["body_mass"].clone()
    if seed == 5:
        envs.append(wandering_env(5))
    for each in envs[:2]:
        warp_spo.env.gymnasium(each).reset(seed=seed)
    assert not torch.equal(kept, envs[0].values["body_mass"])
    for step in range(8):
        states = [each.state_dict() for each in envs]
        for other in states[1:]:
            assert states[0].keys() == other.keys()
            assert [name for name, x in states[0].items() if not torch.equal(x, other[name])] == []
        assert all(each.log().keys() == envs[0].log().keys() for each in envs)
        logs = [torch.stack([*each.log().values()]) for each in envs]
        assert all(torch.equal(logs[0], each) for each in logs[1:])
        for each in envs:
            each.step(torch.full((3, 8), 0.1 * step))


def test_seeds_of_worlds():
    """A world depends on its own seed and number alone; other lists are refused before anything changes."""
    worlds = warp_spo.env.gymnasium(restless_env(3))
    first, again, other = (
        worlds.reset(seed=seeds)[0]["actor"] for seeds in ([1, 2, 3], np.array([1, 2, 3]), [1, 5, 3])
    )
    np.testing.assert_array_equal(first, again)
    assert (first == other).all(axis=1).tolist() == [True, False, True]
    before = worlds.env.state_dict()
    for seed, words in (
        ([1, 2], "seed has 2 entries; expected one int"),
        ([1, None, 3], r"seed\[1\] is None"),
        (-1, "-1"),
    ):
        with pytest.raises((ValueError, gymnasium.error.Error), match=words):
            worlds.reset(seed=seed)
    with pytest.raises(ValueError, match="got mask and seed; expected one of them"):
        worlds.reset(seed=3, options={"reset_mask": np.array([True, False, False])})
    assert all(torch.equal(x, before[name]) for name, x in worlds.env.state_dict().items())
