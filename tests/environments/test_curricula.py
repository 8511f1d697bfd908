"""Curricula of weights, ranges and events by steps and by success, and metrics, beside NumPy."""

import numpy as np
import pytest
import torch

from support.env_scenes import cart_env
from warp_spo.env import commands, events, loggers, observations
from warp_spo.env.curricula import ByStep, BySuccess, Curriculum


def quiet(worlds=4, **changes):
    """Return a cart-pole that starts at rest in its neutral pose, with episodes of five steps."""
    return cart_env(worlds, **({"events": [], "terminations": {}, "episode_length_s": 0.1} | changes))


def weighted(weight):
    return quiet(rewards={"a": (weight, lambda w: 1.0)})


def zeros(env):
    return torch.zeros(env.num_envs, env.num_actions)


def test_a_weight_by_steps():
    """Linear from 2 to 6 between steps 3 and 7, and at once at step 4; the reward is weight times term times step."""
    for level, expected in (
        (ByStep(3, 7), [2, 2, 2, 2, 3, 4, 5, 6, 6, 6]),
        (ByStep(4), [2, 2, 2, 2, 6, 6, 6, 6, 6, 6]),
    ):
        env = quiet(rewards={"one": (Curriculum(2.0, 6.0, level), lambda w: 1.0)})
        for weight in expected:
            _, reward, _, _ = env.step(zeros(env))
            assert torch.allclose(reward, torch.tensor(weight * env.step_dt))
        assert (env.levels()["curriculum steps"] == 10).all()
        env.reset(seed=3)
        assert torch.allclose(env.step(zeros(env))[1], torch.tensor(2.0 * env.step_dt))


def test_success_raises_and_lowers_the_level_of_its_world():
    """The metric is the command, which the caller writes: what each world asks for says whether it succeeds."""
    term = lambda w: w.command[0]  # noqa: E731
    level = BySuccess("asked", above=0.6, below=0.2, step=0.5)
    weight = Curriculum(0.0, 10.0, level)
    env = quiet(
        3, rewards={"one": (weight, lambda w: 1.0)}, metrics={"asked": term},
        commands=commands.Uniform(((0.0, 1.0),), seconds=(9.0, 9.0)),
    )  # fmt: skip
    env.command = torch.tensor([[1.0], [0.4], [0.0]])
    found = []
    for step in range(20):
        if step == 15:
            env.command = torch.tensor([[0.0], [0.4], [1.0]])
        found.append(env.step(zeros(env))[1] / env.step_dt)
    found = torch.stack(found)[::5].numpy()
    assert np.allclose(found, [[0, 0, 0], [5, 0, 0], [10, 0, 0], [10, 0, 0]])
    assert np.allclose(env.levels()[level.name][:, 0], [0.5, 0.0, 0.5])


def test_success_of_a_reward_counts_before_its_weight():
    env = quiet(
        2, rewards={"up": (-3.0, lambda w: w.command[0]), "b": (Curriculum(0.0, 1.0, BySuccess("up", 0.5, step=1.0)),
        lambda w: 1.0)}, commands=commands.Uniform(((0.0, 1.0),), seconds=(9.0, 9.0)),
    )  # fmt: skip
    env.command = torch.tensor([[0.6], [0.4]])
    for _ in range(5):
        env.step(zeros(env))
    assert np.allclose(env.levels()["curriculum up above 0.5 by 1"][:, 0], [1.0, 0.0])


def test_ranges_of_commands_and_events_follow_the_level():
    """Draws lie within the range of the level, and fill it: a uniform draw's share of the range is seen at its ends."""
    wide = Curriculum((0.0, 0.1), (10.0, 11.0), ByStep(5, 15))
    env = quiet(
        256, commands=commands.Uniform((wide,), seconds=(0.02, 0.02)),
        events=[
            events.joints(position=wide, names="hinge"),
            events.randomise("body_mass", Curriculum((1.0, 1.0), (2.0, 3.0), ByStep(8)), when="reset", alike=True),
        ],
    )  # fmt: skip
    assert env.command_ranges == {"command 0": (0.0, 11.0)}
    for step in range(1, 21):
        env.step(zeros(env))
        share = np.clip((step - 5) / 10, 0.0, 1.0)
        low, high = 10.0 * share, 0.1 + 10.9 * share
        drawn = env.command[:, 0]
        assert low - 1e-5 <= drawn.min() < low + 0.1 * (high - low) and high - 0.1 * (high - low) < drawn.max()
        assert drawn.max() <= high + 1e-5
        if step % 5 == 0:
            assert low - 1e-4 <= env.q[:, 1].min() and env.q[:, 1].max() <= high + 1e-4
            mass = env.values["body_mass"][:, 0]
            assert (mass == 1.0).all() if step < 8 else (mass >= 2.0 - 1e-6).all() and (mass.max() > 2.9)


def test_levels_go_on_in_another_environment():
    make = lambda: quiet(4, rewards={"one": (Curriculum(0.0, 8.0, ByStep(0, 8)), lambda w: 1.0)})  # noqa: E731
    first, second = make(), make()
    for _ in range(3):
        first.step(zeros(first))
    second.start_at(first.levels())
    assert torch.equal(second.step(zeros(second))[1], first.step(zeros(first))[1])


def test_metrics_are_means_over_episodes_and_change_nothing():
    """Means beside NumPy over the recorded steps; steps that are not finite are left out; all else keeps its bits."""
    metrics = {"speed": lambda w: abs(w.qd[0]), "odd": lambda w: np.log(w.q[0])}
    env, plain = (cart_env(4, terminations={}, metrics=each) for each in (metrics, None))
    speeds, odd = [], []
    given = torch.linspace(-1, 1, 4)[:, None]
    for step in range(20):
        results = [each.step(given * (1 if step < 10 else -1)) for each in (env, plain)]
        assert torch.equal(results[0][0]["actor"], results[1][0]["actor"]) and torch.equal(results[0][1], results[1][1])
        if step < 19:  # the last one is of the new episode
            speeds.append(env.qd[:, 0].abs().numpy().copy()), odd.append(env.q[:, 0].numpy().copy())
    end = env.memory("last metric speed")[:, 0].numpy()
    mean = np.mean(speeds, axis=0)
    last = 20 * end - 19 * mean  # the speed of the last step, which no tensor has any more
    assert (abs(last - speeds[-1]) < 0.3).all() and np.isclose(env.log()["/metric/speed"], end.mean())
    positive = np.array(odd) > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        logs = np.where(positive, np.log(np.array(odd)), 0.0)
    held = env.memory("last metric odd")[:, 0].numpy()
    count = np.maximum(positive.sum(axis=0), 1)
    assert np.isfinite(held).all() and (abs(held - logs.sum(axis=0) / count) < 0.5).all()
    row = {"collecting": 1.0, "learning": 1.0, "rate": 1e-3, "deviation": 1.0, "reward": 0.0, "/episode/finished": 4.0,
           "/episode/whole": 4.0, "/episode/seconds": 0.4, "/metric/speed": 0.25}  # fmt: skip
    assert loggers.tags(row, env, 1)["Episode_Metrics/speed"] == 0.25
    assert "Episode_Metrics/speed" not in loggers.tags(row | {"/episode/finished": 0.0, "/episode/whole": 0.0}, env, 1)


def test_a_metric_that_was_never_finite_gives_no_verdict_and_no_mean():
    """World 0 has a metric of -2; that of world 1 is NaN in all steps: its level stays, and the mean is -2."""
    level = BySuccess("m", above=-0.5, below=-1.0, step=0.5)
    env = quiet(
        2, rewards={"one": (Curriculum(0.0, 1.0, level), lambda w: 1.0)},
        metrics={"m": lambda w: np.log(w.command[0]) - 2.0},
        commands=commands.Uniform(((0.5, 1.0),), seconds=(9.0, 9.0)),
    )  # fmt: skip
    for before in (1.0, 0.0):  # at the higher level it must not fall, at the lower one it must not rise
        env.start_at({level.name: torch.full((2, 1), before)})
        env.command = torch.tensor([[1.0], [-1.0]])
        for _ in range(5):
            env.step(zeros(env))
        assert env.levels()[level.name][:, 0].tolist() == [max(before - 0.5, 0.0), before]
        assert env.log()["/metric/m"] == -2.0


def test_episodes_whose_age_was_written_count_by_the_steps_that_they_took():
    """Ages of 3 of 5 steps: after two steps the mean of a reward of 1 is 1, not 2 of 5."""
    level = BySuccess("a", above=0.9, step=0.5)
    env = quiet(
        2, rewards={"a": (2.0, lambda w: 1.0), "b": (Curriculum(0.0, 1.0, level), lambda w: 1.0)},
        commands=commands.Velocity(level=commands.Level("a", share=0.9, first=0.25, step=0.5)),
    )  # fmt: skip
    env.episode_length_buf = torch.tensor([3, 0])
    for step in range(5):
        env.step(zeros(env))
        expected = [0.5 * (step >= 1), 0.5 * (step >= 4)]
        for name in (level.name, "command level"):
            assert env.levels()[name][:, 0].tolist() == expected


def test_levels_that_differ_in_one_digit_are_two():
    assert BySuccess("m", above=1000000).name != BySuccess("m", above=1000001).name
    assert BySuccess("m", above=0.5, step=1).name == "curriculum m above 0.5 by 1"


def test_pushes_grow():
    """A free cart is pushed in each step from step 8 on: nobody moves it before, and by 2 m/s at most then."""
    import warp_spo as spo
    from warp_spo.env import actions

    scene = spo.Scene(
        [spo.Body(1.0, inertia=0.01 * np.eye(3)), spo.Body(1.0, inertia=0.01 * np.eye(3))],
        [spo.Hinge("free", -1, 0), spo.Hinge("revolute", 0, 1, axis=(0, 1, 0))],
    ).with_values(gravity=np.zeros(3))
    push = events.push(Curriculum(0.0, 2.0, ByStep(8)), seconds=(0.02, 0.02))
    env = quiet(64, scene=scene, actions=actions.Effort(scale=0.0), rewards={}, events=[push], episode_length_s=9.0)
    largest = []
    for _ in range(10):
        before = env.qd.clone()
        env.step(zeros(env))
        largest.append(float((env.qd - before)[:, :2].abs().max()))
    assert max(largest[:7]) == 0.0 and 1.8 < largest[-1] <= 2.0 + 1e-6


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Curriculum(1.0, (0.0, 1.0), ByStep()), "expected two numbers, or two ranges"),
        (lambda: ByStep(5, 3), "expected integers, 0 or more, in order"),
        (lambda: BySuccess("x", above=0.2, below=0.5), "below <= above"),
        (lambda: weighted(Curriculum(0.0, 1.0, BySuccess("nothing"))), "no metric or reward"),
        (lambda: weighted(Curriculum(0.0, 1.0, BySuccess("a"))), "a number for its weight"),
        (lambda: weighted(Curriculum(0.0, float("nan"), ByStep())), "finite number"),
        (lambda: events.randomise("body_mass", Curriculum((1, 1), (1, 2), ByStep())), "when='reset'"),
        (lambda: quiet(events=[events.randomise("body_mass", Curriculum((1, 1), (-1, 2), ByStep()), when="reset")]),
         "masses above zero"),
        (lambda: quiet(metrics={"a": lambda w: w.q}), "metric 'a' returned"),
    ],
)  # fmt: skip
def test_what_is_refused(make, words):
    with pytest.raises(ValueError if "metric 'a'" not in words else (TypeError, ValueError), match=words):
        make()


def test_weights_of_curricula_can_be_set_by_name():
    from warp_spo.env import settings

    held = (Curriculum(1.0, 2.0, ByStep(0, 8)), observations.command)
    assert settings.apply(held, {"last": 5.0}, "rewards.x")[0].last == 5.0
    assert settings.apply(held, 3, "rewards.x")[0] == 3.0
