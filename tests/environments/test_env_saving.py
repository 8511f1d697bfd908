"""The state of an environment outside of it, levels of curricula in checkpoints, and what cannot be copied."""

import copy
import pickle

import numpy as np
import pytest

torch = pytest.importorskip("torch")
learning = pytest.importorskip("warp_spo.env.learning")

import warp_spo as spo  # noqa: E402
from support.env_scenes import cart_env, walker_env, walker_scene  # noqa: E402
from warp_spo import env as envs  # noqa: E402
from warp_spo.env import commands, events  # noqa: E402

LEARNER = learning.Learner(iterations=2, steps=3, hidden=(8,), epochs=1, batches=1)


def course(first=3.0):
    """An event with a curriculum: worlds remember a stage, which grows by one at each end, and start by it."""

    def change(w):
        (stage,) = w.memory("stage", 1, reset=None)
        if w.before is not None:
            stage = stage + 1.0
        w.keep("stage", [stage])
        w.q[0] = 0.01 * stage

    return events.Reset(change, lambda w: w.keep("stage", [w.integer(0, int(first))]), levels=("stage",))


def roll(env, steps, seed):
    rng = torch.Generator().manual_seed(seed)
    rows = []
    for _ in range(steps):
        observed, reward, done, extras = env.step(torch.randn(env.num_envs, env.num_actions, generator=rng))
        rows += [*(observed[name] for name in env.num_obs), reward, done, extras["time_outs"]]
    return rows


def goes_on(make, tmp_path):
    """Return whether an environment with another seed goes on from a file as the first one does, to the bit."""
    env = make(seed=1)
    roll(env, 16, 0)
    torch.save(env.state_dict(), tmp_path / "state.pt")
    wanted, log = roll(env, 9, 1), env.log()
    other = make(seed=2)
    roll(other, 3, 3)
    other.load_state_dict(torch.load(tmp_path / "state.pt", weights_only=True))
    found = roll(other, 9, 1)
    return all(map(torch.equal, found, wanted)) and all(torch.equal(log[name], other.log()[name]) for name in log)


def test_an_environment_goes_on_from_a_file(tmp_path, device):
    """Episodes end and random numbers are drawn meanwhile; on CUDA the step is a graph."""
    assert goes_on(lambda seed: cart_env(device=str(device), seed=seed), tmp_path)


@pytest.mark.slow
def test_delays_values_and_histories_go_on_from_a_file(tmp_path):
    drawn = [events.randomise("body_mass", (0.5, 2.0), when="reset"), events.joints((-0.1, 0.1)), events.push(0.5)]
    assert goes_on(lambda seed: walker_env(seed=seed, events=drawn, episode_length_s=0.1), tmp_path)


def test_a_state_that_does_not_fit_changes_nothing():
    env = cart_env()
    before = env.state_dict()
    for wrong, words in (
        ({name: x for name, x in before.items() if name != "q"}, "'q' is missing; expected .*8, 2.*float32"),
        (before | {"q": before["q"][:4]}, r"'q' is \(\(4, 2\), torch.float32\); expected \(\(8, 2\), torch.float32\)"),
        (before | {"more": torch.zeros(3)}, "'more' is .*expected none, as env.state_dict"),
        (before | {"qd": before["qd"].double()}, "'qd' is .*float64"),
    ):
        with pytest.raises(ValueError, match=f"Env.load_state_dict: {words}"):
            env.load_state_dict({name: x + 1 if x.is_floating_point() else x for name, x in wrong.items()})
        assert all(torch.equal(x, before[name]) for name, x in env.state_dict().items())
    env.set_seed(5 << 40 | 0xFFFFFFFF)
    other = cart_env(seed=3)
    other.load_state_dict(env.state_dict())
    assert other.seed == env.seed


@pytest.mark.parametrize("way", [pickle.dumps, copy.copy, copy.deepcopy])
def test_what_cannot_be_copied_says_how_to_store_it(way):
    with pytest.raises(TypeError, match=r"Env: it cannot be pickled or copied.*store env.state_dict\(\)"):
        way(cart_env(2))


def test_a_training_resumes_at_the_levels_of_its_checkpoint(tmp_path):
    """Worlds stand where their stage puts them; a run with more worlds takes the stages again from the first."""
    make = lambda worlds, seed, **more: cart_env(worlds, seed=seed, events=[course()], terminations={}, **more)  # noqa: E731
    env = make(4, 1, episode_length_s=0.04)
    learning.train(env, LEARNER, tmp_path / "first")
    reached = torch.load(tmp_path / "first" / "model_1.pt", weights_only=True)["infos"]["levels"]
    assert torch.equal(reached["stage"], env.memory("stage")) and reached["stage"].max() > 3.0
    again = make(6, 2, first_world=1)
    learning.prepare(again, LEARNER, tmp_path / "again", 3, tmp_path / "first" / "model_1.pt")
    wanted = reached["stage"][[1, 2, 3, 0, 1, 2]]
    assert torch.equal(again.levels()["stage"], wanted) and torch.allclose(again.q[:, :1], 0.01 * wanted)
    plain = cart_env(4)
    assert plain.levels() == {}
    with pytest.warns(UserWarning, match="has levels of stage, the task's curricula are none"):
        learning.prepare(plain, LEARNER, tmp_path / "plain", 3, tmp_path / "first" / "model_1.pt")
    with pytest.raises(ValueError, match=r"Env.start_at: levels have the shapes {}; expected {'stage': \(6, 1\)}"):
        again.start_at({})


@pytest.mark.slow
def test_terrain_and_commands_have_levels():
    tiles = spo.terrain.tiles(4, 3, (6.0, 6.0), 0.1, seed=2)
    scene = walker_scene()
    level = commands.Level("track", first=0.2)
    env = walker_env(
        5,
        scene=scene.with_contacts(scene.contacts, tiles.field),
        events=[events.terrain(tiles, rows=1)],
        commands=commands.Velocity(forward=(1.0, 1.0), left=(0.0, 0.0), turn=(0.0, 0.0), level=level),
    )
    assert (env.levels()["terrain"][:, 0] == 0.0).all()
    wanted = {"terrain": torch.tensor([[3.0, 2.0], [1.0, 0.0]]), "command level": torch.tensor([[0.5], [0.1]])}
    env.start_at(wanted)
    order = [0, 1, 0, 1, 0]
    assert all(torch.equal(env.levels()[name], x[order]) for name, x in wanted.items())
    starts = tiles.origins[[3, 1, 3, 1, 3], [2, 0, 2, 0, 2]]
    np.testing.assert_allclose(env.q[:, :2].numpy(), starts[:, :2], atol=1e-5)
    np.testing.assert_allclose(env.command[:, 0].numpy(), np.array([0.7, 0.3])[order], atol=1e-6)
    with pytest.raises(ValueError, match=r"Env.start_at: levels 'terrain' holds NaN"):
        env.start_at(wanted | {"terrain": torch.tensor([[0.0, torch.nan]])})
    given = torch.tensor([[9.0, 1.0], [-2.0, 1.0], [1.0, 1e9], [torch.nan, 0.0], [0.0, torch.nan]])
    env.levels()["terrain"].copy_(given)  # beyond the tiles: of a training on more of them, or not finite
    env.reset()
    starts = tiles.origins[[3, 0, 1, 0, 0], [1, 1, 2, 0, 0]]
    np.testing.assert_allclose(env.q[:, :2].numpy(), starts[:, :2], atol=1e-5)


def test_objects_say_what_they_are():
    assert repr(cart_env()) == "Env(8 worlds on cpu, 1 actions, observations: actor 4)"
    dyn = spo.Dynamics(spo.Scene([spo.Body(1.0)], [spo.Hinge("free", -1, 0)]), 3, "cpu", "float64")
    assert repr(dyn) == "Dynamics(1 bodies, 6 dof, 3 worlds on cpu, float64)"


def test_an_argument_that_a_task_sets_is_refused():
    words = r"make: 'cartpole' takes no dt, hop; expected some of seed, first_world, .*copy its file, .*cartpole.py"
    with pytest.raises(TypeError, match=words):
        envs.make("cartpole", 2, "cpu", dt=0.01, hop=3)
    with pytest.raises(TypeError, match="takes no commands; expected some of seed, trial, first_world"):
        envs.make("go2-rough", 2, "cpu", commands=None)


def test_lengths_of_episodes_of_written_ages_do_not_count():
    """Rewards of such an episode do; the length of the next one does."""
    env = cart_env(4, terminations={})
    most = env.max_episode_length
    env.episode_length_buf = torch.tensor([most - 1, most - 2, 0, 0])
    for step, (finished, whole) in enumerate([(1, 0), (2, 0), (2, 0)]):
        env.step(torch.zeros(4, 1))
        log = env.log()
        assert (log["/episode/finished"], log["/episode/whole"]) == (finished, whole), step
        assert log["/episode/seconds"] == 0.0
    for _ in range(most - 2):
        env.step(torch.zeros(4, 1))
    log = env.log()
    assert (log["/episode/finished"], log["/episode/whole"]) == (4, 3)  # worlds 0, 2 and 3
    assert torch.isclose(log["/episode/seconds"], torch.tensor(most * env.step_dt))
