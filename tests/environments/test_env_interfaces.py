"""Environments in the hands of rsl_rl, Gymnasium and skrl."""

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, VectorEnv

import warp_spo.env
from support.env_scenes import cart_env, walker_env


def small(**more):
    return {"class_name": "MLPModel", "hidden_dims": [16], "activation": "elu", **more}


def test_rsl_rl_runs():
    """Stock PPO learns the cart's mean reward upward from a start near the top in a few iterations."""
    from rsl_rl.env import VecEnv
    from rsl_rl.runners import OnPolicyRunner

    groups = {"actor": [lambda w: w.q, lambda w: w.qd], "critic": [lambda w: w.q, lambda w: w.qd, lambda w: w.time]}
    env = cart_env(64, observations=groups)
    assert isinstance(env, VecEnv)
    normal = {"class_name": "GaussianDistribution", "init_std": 1.0, "std_type": "scalar"}
    settings = {
        "seed": 1,
        "num_steps_per_env": 8,
        "save_interval": 100,
        "obs_groups": {"actor": ["actor"], "critic": ["critic"]},
        "algorithm": {"class_name": "PPO", "num_learning_epochs": 2, "num_mini_batches": 2, "learning_rate": 1e-3},
        "actor": small(distribution_cfg=normal),
        "critic": small(),
    }
    runner = OnPolicyRunner(env, settings, log_dir=None, device="cpu")
    runner.learn(4, init_at_random_ep_len=True)
    assert runner.current_learning_iteration == 3 and float(env.memory("episodes").sum()) > 64
    assert all(torch.isfinite(x).all() for x in runner.alg.actor.parameters())


def test_gymnasium_vector():
    env = walker_env(4, final_observations=True)
    worlds = warp_spo.env.gymnasium(env)
    assert isinstance(worlds, VectorEnv) and worlds.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    first, _ = worlds.reset(seed=5)
    again, _ = worlds.reset(seed=5)
    other, _ = worlds.reset(seed=6)
    assert all(np.array_equal(first[name], again[name]) for name in first)
    assert not np.array_equal(first["actor"], other["actor"])
    assert worlds.observation_space.contains(first)
    env.episode_length_buf = torch.tensor([98, 0, 0, 99])
    for late in ([False, False, False, True], [True, False, False, False]):
        observed, rewards, ended, truncated, info = worlds.step(worlds.action_space.sample())
        assert worlds.observation_space.contains(observed) and rewards.shape == (4,)
        assert truncated.tolist() == late and info["_final_obs"].tolist() == late and not ended.any()
        for world, last in enumerate(info["final_obs"]):
            assert (last in worlds.single_observation_space) == late[world]
            assert not late[world] or (last["critic"] != observed["critic"][world]).any()


def test_gymnasium_checks_one_world():
    env = cart_env(1, final_observations=True)
    world = warp_spo.env.gymnasium(env, single=True)
    assert isinstance(world, gymnasium.Env)
    check_env(world, skip_render_check=True)
    with pytest.raises(ValueError, match="single=True with 4 worlds"):
        warp_spo.env.gymnasium(cart_env(4), single=True)
    for given in (dict(tensors=True), dict(autoreset_mode="NextStep")):
        with pytest.raises(ValueError, match=r"single=True with tensors=.*; expected neither"):
            warp_spo.env.gymnasium(env, single=True, **given)


def test_one_world_waits_for_its_reset():
    """The step after the end of an episode is an error; logs have plain numbers."""
    world = warp_spo.env.gymnasium(cart_env(1, final_observations=True, log_interval=5), single=True)
    world.reset(seed=1)
    steps = [world.step(world.action_space.sample() * 0.0) for _ in range(20)]
    assert [late for *_, late, _ in steps] == [False] * 19 + [True] and steps[4][4]["log"]["/not finite/action"] == 0.0
    with pytest.raises(RuntimeError, match=r"step: the episode has ended; expected reset\(\) before the next step"):
        world.step(world.action_space.sample())
    started, _ = world.reset()
    assert not np.array_equal(started["actor"] if isinstance(started, dict) else started, steps[-1][0])
    world.step(world.action_space.sample())


def test_skrl_trains():
    from skrl.agents.torch.ppo import PPO, PPO_CFG
    from skrl.memories.torch import RandomMemory
    from skrl.models.torch import DeterministicMixin, GaussianMixin, Model
    from skrl.trainers.torch import SequentialTrainer, SequentialTrainerCfg

    class Policy(GaussianMixin, Model):
        def __init__(self, env):
            Model.__init__(
                self, observation_space=env.observation_space, action_space=env.action_space, device=env.device
            )
            GaussianMixin.__init__(self)
            self.net = torch.nn.Linear(self.num_observations, self.num_actions)
            self.size = torch.nn.Parameter(torch.zeros(self.num_actions))

        def compute(self, inputs, role):
            return self.net(inputs["observations"]), {"log_std": self.size}

    class Value(DeterministicMixin, Model):
        def __init__(self, env):
            Model.__init__(self, state_space=env.state_space, action_space=env.action_space, device=env.device)
            DeterministicMixin.__init__(self)
            self.net = torch.nn.Linear(self.num_states, 1)

        def compute(self, inputs, role):
            return self.net(inputs["states"]), {}

    env = warp_spo.env.skrl(
        cart_env(16, observations={"actor": [lambda w: w.q], "critic": [lambda w: w.q, lambda w: w.qd]})
    )
    models = {"policy": Policy(env), "value": Value(env)}
    before = models["policy"].net.weight.clone()
    settings = PPO_CFG(rollouts=8)
    settings.experiment.write_interval = settings.experiment.checkpoint_interval = 0
    agent = PPO(
        models=models,
        memory=RandomMemory(memory_size=8, num_envs=16, device=env.device),
        observation_space=env.observation_space,
        state_space=env.state_space,
        action_space=env.action_space,
        device=env.device,
        cfg=settings,
    )
    run = SequentialTrainerCfg(timesteps=24, headless=True, close_environment_at_exit=False)
    trainer = SequentialTrainer(env=env, agents=agent, cfg=run)
    trainer.train()
    after = models["policy"].net.weight
    assert torch.isfinite(after).all() and not torch.equal(before, after)
    assert env.state_space.shape == (4,) and env.observation_space.shape == (2,)
