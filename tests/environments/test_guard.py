"""The guard between worlds and learner: numbers that are not finite, or beyond their bounds, end one world by name."""

import dataclasses
import math
import re
import types

import numpy as np
import pytest
import torch

import warp_spo as spo
from support.env_scenes import cart_env
from warp_spo import env as environments
from warp_spo.env import Bounds, Env, Observation, TorchTerm, actions, commands, events, observations, robots
from warp_spo.env.bounds import size_of, speeds
from warp_spo.env.training_log import TrainingLog, read_rows

WORLDS, BAD, OTHERS = 4, 2, [0, 1, 3]
VALUES = {"NaN": math.nan, "inf": math.inf, "1e35": 1e35, "1e12": -1e12}


def planted(place, first=False):
    """Return a term of the pole's angle to which a test adds a number, ``env.memory("planted")[world, place]``.

    It does not at the start of an episode, unless ``first``.
    """
    number = lambda w: w.memory("planted", 8, reset=None)[place]  # noqa: E731
    return lambda w: w.q[1] + (number(w) if first else spo.where(w.time > 0.0, number(w), 0.0))


def mean(w):
    """Return a mean over all steps, which resets leave alone."""
    old = w.memory("mean", 1, reset=None)[0]
    w.keep("mean", [0.9 * old + 0.1 * planted(7)(w)])
    return w.memory("mean", 1, reset=None)[0]


def guarded_env(**options):
    """Return carts whose terms of every kind a test can spoil; of the twin, ``env.beside`` is the torch term's."""
    beside, cart = torch.zeros(WORLDS), robots.load("cartpole")
    in_torch = lambda env: env.q[:, 0] + torch.where(env.episode_length_buf > 0, beside, 0.0)  # noqa: E731
    settings = dict(
        dt=0.01, decimation=2, default_q=cart.q, actions=actions.Control(clip=(-1.0, 1.0)),
        observations={
            "actor": [
                planted(0),
                Observation(planted(1), noise=0.1, history=3),
                Observation(planted(2), scale=0.5, delay=2),
                TorchTerm(in_torch, name="in torch"),
                observations.Each(lambda w, row: row[0] * planted(5)(w), np.ones((18, 1))),
            ],
            "critic": [planted(3), Observation(planted(4, first=True), clip=(-2.0, 2.0))],
        },
        rewards={"height": (1.0, lambda w: np.cos(planted(6)(w))), "mean": (1.0, mean), "always": (1.0, lambda w: 1.0)},
        events=[events.joints(position=(-0.3, 0.3))], episode_length_s=10.0,
    )  # fmt: skip
    env = Env(cart.scene, WORLDS, "cpu", **(settings | options))
    env.beside = beside
    return env


def step(env, action=None):
    """Take a step, and check that all that reaches a learner is finite and small."""
    given = torch.zeros(WORLDS, env.num_actions) if action is None else action
    observed, reward, done, extras = env.step(given)
    for found in (observed, extras.get("final_observations", {})):
        assert all(bool((found[group].abs() < 1e4).all()) for group in found.keys())
    assert (reward.abs() < 100.0).all()
    return observed, reward, done.tolist(), extras


def counts(env):
    """Return what ended worlds, by name without the sums over kinds."""
    names = {name: int(x) for name, x in env.log().items() if re.match("/(not finite|beyond bounds)/", name) and x}
    return {name: n for name, n in names.items() if not any(other.startswith(f"{name}/") for other in names)}


@pytest.mark.parametrize("final", [False, True])
@pytest.mark.parametrize("place, name", [
    (0, "actor/term 0"), (1, "actor/term 1"), (2, "actor/term 2"), ("torch", "actor/in torch"), (5, "actor/term 4"),
    (3, "critic/term 0"),
])  # fmt: skip
def test_an_observation_ends_its_world_and_is_never_seen(guarded, place, name, final):
    env, twin = guarded[final]
    for each in (env, twin):
        each.reset(seed=3)
    for kind, value in VALUES.items():
        before = counts(env)
        spoilt = env.beside if place == "torch" else env.memory("planted")[:, place]
        step(env), step(twin)
        spoilt[BAD] = value
        _, reward, done, extras = step(env)
        expected = twin.step(torch.zeros(WORLDS, 1))
        if not final:  # found after the step's ends: zeros, and the world ends in the next step
            assert done == [0] * WORLDS and torch.equal(reward[OTHERS], expected[1][OTHERS])
            spoilt[BAD] = 0.0
            _, reward, done, extras = step(env)
            expected = twin.step(torch.zeros(WORLDS, 1))
        spoilt[BAD] = 0.0
        assert done == [0, 0, 1, 0] and reward[BAD] == 0.0 and extras["time_outs"].tolist() == [0] * WORLDS
        way = "beyond bounds" if kind == "1e12" else "not finite"
        key = f"/{way}/observation/{name}"
        assert counts(env) == before | {key: before.get(key, 0) + 1}
        step(env), step(twin)
        observed, _, done, _ = step(env)
        expected = twin.step(torch.zeros(WORLDS, 1))
        assert done == [0] * WORLDS  # the history and the delay of the new episode hold nothing of the old one
        assert all(torch.equal(observed[group][OTHERS], expected[0][group][OTHERS]) for group in observed.keys())


@pytest.fixture(scope="module")
def guarded():
    """Carts and their twins, without and with last observations of episodes."""
    return {final: [guarded_env(final_observations=final) for _ in range(2)] for final in (False, True)}


def test_infinity_that_is_clipped_is_a_number(guarded):
    env, _ = guarded[False]
    env.reset(seed=0)
    env.memory("planted")[BAD, 4] = math.inf
    observed, _, done, _ = step(env)
    assert observed["critic"][BAD, 1] == 2.0 and done == [0] * WORLDS
    env.memory("planted")[BAD, 4] = math.nan
    assert step(env)[0]["critic"][BAD, 1] == 0.0 and step(env)[2] == [0, 0, 1, 0]
    env.memory("planted")[:] = 0.0


def test_rewards_are_counted_by_name_and_leave_no_trace(guarded):
    env, _ = guarded[False]
    env.reset(seed=0)
    for value in VALUES.values():
        step(env)
        held = env.memory("mean").clone()
        env.memory("planted")[BAD, 7] = value
        _, reward, done, _ = step(env)
        env.memory("planted")[:] = 0.0
        assert done == [0, 0, 1, 0] and reward[BAD] == 0.0
        assert env.memory("mean")[BAD] == held[BAD]  # what resets leave alone is as it was before the step
    assert counts(env) == {"/not finite/reward/mean": 3, "/beyond bounds/reward/mean": 1}
    log = env.log()
    assert log["/not finite/reward"] == 3 and log["/termination/beyond bounds"] == 1
    assert all(bool(x.isfinite()) and abs(x) < 1e3 for x in log.values())


@pytest.mark.parametrize("value, name", [
    (math.nan, "not finite"), (math.inf, "not finite"), (1e12, "beyond bounds"), (1e4, "beyond bounds"),
])  # fmt: skip
def test_a_state_ends_its_world(guarded, value, name):
    env, _ = guarded[False]
    env.reset(seed=0)
    for part, coordinate in (("speeds", env.qd), ("coordinates", env.q)):
        if part == "coordinates" and value == 1e4:
            continue  # the cart's place, within bounds; the rail's stops answer
        step(env)
        coordinate[BAD, 0] = value
        _, reward, done, _ = step(env)
        assert done == [0, 0, 1, 0] and reward[BAD] == 0.0
        found = counts(env)
        assert sum(found.values()) == (1 if part == "speeds" else 2) and all("/state/" in key for key in found)
        if part == "speeds" and value == 1e4:
            assert found == {f"/{name}/state/speeds": 1}
    assert env.q.isfinite().all() and env.qd.abs().max() < 100.0


def test_memory_that_no_reset_clears_keeps_no_nan():
    """Terms of all kinds return a sum and then add a root to it, of which one world's is once of a negative number."""

    def late(name):
        def term(w):
            total = w.memory(name, 1, reset=None)[0]
            w.keep(name, [total + np.sqrt(0.7 - w.q[0])])
            return total

        return term

    class Late(actions.Effort):
        def trace(self, w, action):
            late("action's")(w)
            return super().trace(w, action)

    class Held(commands.Uniform):
        def update(self, w, command):
            late("command's")(w)
            return command

    env = cart_env(
        WORLDS, actions=Late("slide"), commands=Held(((0.0, 1.0),)), rewards={"late": (1.0, late("reward"))},
        observations={"actor": [late("observation")], "critic": [Observation(late("history"), history=2)]},
        terminations={"late": lambda w: late("end")(w) > 1e6}, metrics={"late": late("metric")}, episode_length_s=10.0,
    )  # fmt: skip
    names = ["action's", "command's", "reward", "observation", "history", "end", "metric"]
    sums = lambda: torch.cat([env.memory(name) for name in names], dim=1).clone()  # noqa: E731
    step(env)
    before = sums()
    env.q[BAD, 0] = 0.8
    step(env)
    env.q[BAD, 0] = 0.0
    after = sums()
    assert torch.equal(after[BAD], before[BAD]) and (after[OTHERS] > before[OTHERS] + 0.5).all()
    for _ in range(3):
        assert step(env)[2] == [0] * WORLDS
    assert (sums()[BAD] > after[BAD] + 1.5).all() and not counts(env)


def test_actions_beyond_bounds():
    env = guarded_env(actions=actions.Control(scale=0.01), bounds=Bounds(action=1e3))
    for value, name in ((math.nan, "not finite"), (1e12, "beyond bounds"), (-1001.0, "beyond bounds")):
        before = counts(env)
        given = torch.zeros(WORLDS, 1)
        given[BAD] = value
        _, reward, done, _ = step(env, given)
        assert done == [0, 0, 1, 0] and reward[BAD] == 0.0
        assert counts(env)[f"/{name}/action"] == before.get(f"/{name}/action", 0) + 1
    assert step(env, torch.full((WORLDS, 1), 999.0))[2] == [0] * WORLDS


def test_a_first_observation_ends_the_episode_that_it_begins(guarded):
    env, _ = guarded[False]
    env.reset(seed=0)
    step(env)
    env.memory("planted")[:, 4] = math.nan
    mask = torch.tensor([False, False, True, False])
    observed, _ = env.reset(mask)
    env.memory("planted")[:, 4] = 0.0
    assert observed["critic"].isfinite().all() and observed["critic"][BAD, 1] == 0.0
    assert step(env)[2] == [0, 0, 1, 0]  # others were looked at, too, and nobody saw it
    assert counts(env) == {"/not finite/observation/critic/term 1": 1}


def test_an_episode_that_ends_late_and_spoilt_is_no_time_out(guarded):
    env, _ = guarded[True]
    env.reset(seed=0)
    env.episode_length_buf = torch.full((WORLDS,), env.max_episode_length - 1)
    env.memory("planted")[BAD, 3] = math.inf
    _, reward, done, extras = step(env)
    env.memory("planted")[:] = 0.0
    assert done == [1] * WORLDS and extras["time_outs"].tolist() == [1, 1, 0, 1] and reward[BAD] == 0.0


def test_resets_see_no_bad_state():
    """A start that goes on where the world ended, and a level that it keeps for good."""

    def change(w):
        if w.before is not None:
            w.q[0] = 0.5 * w.before.q[0]
            w.keep("level", [w.memory("level", 1, reset=None)[0] + w.before.qd[0]])
            w.keep("odd", [w.memory("odd", 1, reset=None)[0] + np.log(w.before.action[0] - 1.0)])  # NaN always
        else:
            w.keep("level", w.memory("level", 1, reset=None))
            w.keep("odd", w.memory("odd", 1, reset=None))

    for value in (math.nan, 1e12):
        env = guarded_env(events=[events.Reset(change)])
        env.qd[BAD, 0] = value
        assert step(env)[2] == [0, 0, 1, 0]
        assert env.q.isfinite().all() and env.memory("level").abs().max() < 1.0 and env.memory("odd")[BAD] == 0.0
        assert step(env)[2] == [0] * WORLDS


def test_default_bounds_follow_from_the_robot():
    go2 = robots.load("go2").scene
    found = speeds(go2, 0.005, 20.0)
    assert 0.6 < size_of(go2) < 1.5  # [m]; from the middle of the trunk to a foot
    assert np.allclose(found[3:], math.pi / 0.005)
    assert np.allclose(found[:3], size_of(go2) / 0.005 + 9.81 * 20.0)
    arm = spo.Hinge("revolute", -1, 0, (0, 0, 1), velocity_limit=3000.0)
    rail = spo.Hinge("prismatic", 0, 1, (0, 0, 1), parent_pose=(0.5, 0, 0, 0, 0, 0, 1), velocity_limit=2.0)
    bodies = [spo.Body(1.0, (0.0, 0.0, 0.1), 0.01 * np.eye(3))] * 2
    scene = spo.Scene(bodies, [arm, rail], gravity=(0.0, 0.0, 0.0))
    size = 0.5 + 0.1 + math.sqrt(0.03)
    assert size_of(scene) == pytest.approx(size)
    assert np.allclose(speeds(scene, 0.01, 5.0), [30000.0, size / 0.01])


def test_hard_random_actions_stay_within_bounds():
    env = environments.make("go2-flat", worlds=16, device="cpu")
    generator = torch.Generator().manual_seed(0)
    for _ in range(40):
        env.step(5.0 * torch.randn(16, env.num_actions, generator=generator))
    assert counts(env) == {} and env.qd.abs().max() > 1.0


def test_bounds_are_widened_and_tightened():
    wide = Bounds(speed={"slide": math.inf}, reward=math.inf, observation={"in torch": 100.0})
    env = guarded_env(bounds=wide)
    limits = env._layout.guard.limits
    assert limits["state/speeds"][0] == math.inf and limits["state/speeds"][1] == pytest.approx(100.0 * math.pi)
    assert limits["observation/actor/in torch"] == 100.0 and limits["observation/actor/term 0"] == 1e5
    env.qd[BAD, 0] = 300.0  # above the default, which the cart's size and gravity give
    assert env.step(torch.zeros(WORLDS, 1))[2].tolist() == [0] * WORLDS
    env.reset()
    env.beside[1] = 200.0
    assert env.step(torch.zeros(WORLDS, 1))[2].tolist() == [0] * WORLDS
    assert env.step(torch.zeros(WORLDS, 1))[2].tolist() == [0, 1, 0, 0]
    assert counts(env) == {"/beyond bounds/observation/actor/in torch": 1}


def test_bounds_are_explained(guarded):
    (line,) = (line for line in guarded[False][0].explain().splitlines() if line.startswith("bounds"))
    words = "action 1e+05, coordinates 1e+05, speeds 189 to 314, reward 1e+04, observation 1e+05"
    assert line.split(maxsplit=1)[1] == words


def test_a_training_prints_what_ended_worlds(tmp_path, capsys):
    """Ends that are new since the last line; rows hold sums of kinds, and of names those that have been counted."""
    names = ("/not finite/reward", "/not finite/reward/up", "/not finite/reward/far", "/beyond bounds/action")
    counts = [torch.zeros(4), torch.tensor([3.0, 3.0, 0.0, 1.0]), torch.tensor([5.0, 3.0, 2.0, 1.0])]
    always = dict.fromkeys(("/episode/finished", "/episode/whole", "/episode/seconds"), torch.tensor(1.0))
    env = types.SimpleNamespace(device="cpu", log=lambda: dict(zip(names, counts.pop(0), strict=True)) | always)
    log = TrainingLog(env, tmp_path, 1, 0.0, True)
    log.init_logging_writer()
    said = []
    for i in range(3):
        log.log(i, 3, 0.1, 0.1, {}, action_std=torch.ones(1), learning_rate=1e-3)
        said.append([line.strip() for line in capsys.readouterr().out.splitlines()[1:]])
    begins = "episodes ended by "
    assert said == [
        [], [f"{begins}not finite/reward/up: 3, beyond bounds/action: 1"], [f"{begins}not finite/reward/far: 2"]
    ]  # fmt: skip
    assert [[name in row for name in names] for row in read_rows(tmp_path / "progress.jsonl")] == [
        [True, False, False, True], [True, True, False, True], [True, True, True, True]
    ]  # fmt: skip


def test_accelerations_are_bounded_on_request():
    env = guarded_env(bounds=Bounds(acceleration={"slide": 50.0}))
    assert step(env)[2] == [0] * WORLDS
    env.qd[BAD, 0] = 100.0  # the stops of the rail brake it
    for _ in range(4):
        done = env.step(torch.zeros(WORLDS, 1))[2].tolist()
        if done != [0] * WORLDS:
            break
    assert done == [0, 0, 1, 0] and counts(env) == {"/beyond bounds/state/accelerations": 1}


@pytest.mark.parametrize("field, value, words", [
    ("speed", -1.0, r"Bounds: speed is -1.0; expected None, or a number above zero \(math.inf: none\), or such"),
    ("reward", {"height": "much"}, "Bounds: reward is"),
    ("observation", math.nan, "Bounds: observation is nan"),
    ("action", {"slide": 1.0}, r"Bounds: action is .*\(math.inf: none\)$"),
    ("coordinate", True, "Bounds: coordinate is True"),
])  # fmt: skip
def test_bounds_that_are_none(field, value, words):
    with pytest.raises(ValueError, match=words):
        Bounds(**{field: value})


def test_bounds_of_what_is_not_there():
    for bounds, words in (
        (Bounds(speed={"tail": 1.0}), "Bounds: speed: 'tail' matches no joint; expected one of slide, hinge"),
        (
            Bounds(reward={"speed": 1.0}),
            "Bounds: reward: 'speed' matches no reward; expected one of height, mean, always",
        ),
        (Bounds(observation={"heights": 1.0}), "Bounds: observation: 'heights' matches no term"),
    ):
        with pytest.raises(ValueError, match=words):
            guarded_env(bounds=bounds)
    with pytest.raises(TypeError, match=r"Env: bounds is 3; expected warp_spo\.env\.Bounds, or None"):
        guarded_env(bounds=3)
    assert dataclasses.replace(Bounds(), action=2.0).action == 2.0
