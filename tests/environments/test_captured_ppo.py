"""The learner against rsl_rl's own: weights after updates, checkpoints, and what learns as in rsl_rl."""

import contextlib
import dataclasses
import hashlib
import inspect
import io
import subprocess
import sys

import pytest

torch = pytest.importorskip("torch")
learning = pytest.importorskip("warp_spo.env.learning")

from rsl_rl.algorithms import PPO  # noqa: E402
from rsl_rl.modules import EmpiricalNormalization  # noqa: E402
from rsl_rl.runners import OnPolicyRunner  # noqa: E402
from rsl_rl.storage import RolloutStorage  # noqa: E402

from support.env_scenes import cart_env  # noqa: E402
from warp_spo import train  # noqa: E402
from warp_spo.env import fused_update  # noqa: E402
from warp_spo.env.captured_ppo import CapturedPPO  # noqa: E402

LEARNER = learning.Learner(iterations=3, steps=6, hidden=(16, 8), epochs=2, batches=2, rate=3e-4)
ROUNDING = 1e-6  # of float32 weights, over the way that they went in a few updates
GRADIENT = 1e-5  # of float32 sums in another order, over the gradient
FUSED = 1e-2  # of weights, over the way: other orders of sums, amplified where Adam divides by small gradients

RESTATED = {
    PPO.act: "930a814dd21dd200",
    PPO.update: "70ae0e38b5fc39e2",
    PPO.compute_returns: "c2781a53c4e9c570",
    PPO.process_env_step: "0454dc3eb3ac6829",
    RolloutStorage.mini_batch_generator: "756bc69b9fc7dcac",
    EmpiricalNormalization.update: "5e6bf387191e7db1",
    OnPolicyRunner.learn: "720da89d7960cd6c",
}
"""Code of rsl_rl that this package restates or relies on; the text is the same in 5.5.0 and 5.5.1."""


class FusedPPO(CapturedPPO):
    fuses = True


def construct(algorithm, env, learner=LEARNER, **options):
    """Return an algorithm of rsl_rl's shape on an environment."""
    settings = learner.settings(env, 1) | {"multi_gpu": None}
    for name, value in options.items():
        if name in ("actor", "critic"):
            settings[name] |= value
        else:
            settings["algorithm"][name] = value
    settings["algorithm"]["class_name"] = algorithm
    torch.manual_seed(1)
    with contextlib.redirect_stdout(io.StringIO()):
        return algorithm.construct_algorithm(env.get_observations(), env, settings, str(env.device))


def collect(alg, env, obs, steps=LEARNER.steps):
    if isinstance(alg, CapturedPPO) and not alg.obstacle:
        return alg.collect(env, obs)
    with torch.inference_mode():
        for _ in range(steps):
            obs, rewards, dones, extras = env.step(alg.act(obs))
            alg.process_env_step(obs, rewards, dones, extras)
        alg.compute_returns(obs)
    return obs


def learn(alg, env, updates=2, first=0):
    """Learn from rollouts that begin as they did for another algorithm; return the losses."""
    env.reset(seed=first)
    obs, losses = env.get_observations(), []
    for i in range(first, first + updates):
        torch.manual_seed(2 * i)
        obs = collect(alg, env, obs)
        torch.manual_seed(2 * i + 1)
        losses.append(alg.update())
    return losses


def state(alg):
    parts = [*alg.actor.state_dict().values(), *alg.critic.state_dict().values()]
    return torch.cat([each.double().flatten() for each in parts])


def far(one, other, before):
    """Return how far two ended from each other, over the way from where they began."""
    return float((one - other).norm() / (one - before).norm())


@pytest.mark.parametrize(("options", "normalize"), [
    ({}, True), ({"schedule": "fixed", "normalize_advantage_per_mini_batch": True}, False),
    ({"use_clipped_value_loss": False, "optimizer": "adamw"}, True),
])  # fmt: skip
def test_updates_equal_those_of_rsl_rl(options, normalize):
    """Of episodes that end by their length and by a fall, so that values at time-outs count."""
    learner = dataclasses.replace(LEARNER, normalize=normalize)
    found = []
    for algorithm in (PPO, CapturedPPO):
        env = cart_env(worlds=8, episode_length_s=0.1, seed=3)
        alg = construct(algorithm, env, learner, **options)
        before = state(alg)
        found.append((learn(alg, env, 3), state(alg), alg.learning_rate, bool(alg.storage.dones.any())))
    (losses, weights, rate, ended), (own_losses, own_weights, own_rate, _) = found
    assert ended and far(weights, own_weights, before) < ROUNDING
    assert own_rate == pytest.approx(rate, rel=1e-12) and (rate != LEARNER.rate or options.get("schedule") == "fixed")
    for theirs, ours in zip(losses, own_losses, strict=True):
        assert ours == pytest.approx(theirs, rel=1e-5)


@pytest.mark.parametrize("first, second", [(PPO, CapturedPPO), (CapturedPPO, PPO), (FusedPPO, PPO), (PPO, FusedPPO)])
def test_checkpoints_are_those_of_rsl_rl(first, second):
    """One writes, the other reads; both go on alike, and the optimizer's numbers and options are rsl_rl's."""
    env = cart_env(worlds=4, seed=3)
    one, other = construct(first, env), construct(second, env)
    learn(one, env)
    saved = one.save()
    before = state(one)
    file = io.BytesIO()
    torch.save(saved, file)
    file.seek(0)
    other.load(torch.load(file, weights_only=True), None, True)
    assert torch.equal(state(other), before) and other.learning_rate == pytest.approx(one.learning_rate, rel=1e-7)
    group = saved["optimizer_state_dict"]["param_groups"][0]
    assert isinstance(group["lr"], float) and not group["capturable"] and group["fused"] is None
    learn(one, env, 1, first=7)
    learn(other, env, 1, first=7)
    fused = FusedPPO in (first, second)
    assert far(state(one), state(other), before) < (FUSED if fused else ROUNDING)


@pytest.mark.parametrize("precision, limit", [("float32", GRADIENT), ("bfloat16", 0.05)])
def test_fused_gradients_are_those_of_torch(precision, limit):
    """Of one minibatch, and the losses; in bfloat16 both round to 8 bits, in other places."""
    env = cart_env(worlds=8, episode_length_s=0.1, seed=3)
    learner, found = dataclasses.replace(LEARNER, epochs=1, batches=1), []
    for algorithm in (CapturedPPO, FusedPPO):
        alg = construct(algorithm, env, learner, use_mixed_precision=precision == "bfloat16", max_grad_norm=1e9)
        losses = learn(alg, env, 1)[0]
        weights = [*alg.actor.parameters(), *alg.critic.parameters()]
        own = [w.grad for w in weights] if alg._fused is None else [alg._fused.gradient_of[w] for w in weights]
        found.append((losses, own, alg.learning_rate, float(alg.deviation)))
    (losses, gradients, rate, deviation), (own_losses, own_gradients, own_rate, own_deviation) = found
    for one, other in zip(gradients, own_gradients, strict=True):
        assert (one - other).norm() < limit * one.norm()
    assert own_losses == pytest.approx(losses, rel=limit, abs=0.1 * limit)
    assert own_rate == pytest.approx(rate, rel=1e-6)
    assert own_deviation == pytest.approx(deviation, rel=1e-2)  # after the step, and before


def test_fused_returns_are_those_of_rsl_rl():
    env = cart_env(worlds=8, episode_length_s=0.1, seed=3)
    alg = construct(FusedPPO, env, dataclasses.replace(LEARNER, steps=12))
    obs = collect(alg, env, env.get_observations())
    held = alg.storage
    assert held.dones.any() and not held.dones.all()
    own = held.returns.clone(), held.advantages.clone()
    with torch.inference_mode():
        PPO.compute_returns(alg, obs)
    for ours, theirs in zip(own, (held.returns, held.advantages), strict=True):
        assert (ours - theirs).abs().max() < GRADIENT * theirs.abs().max()


def test_a_number_that_is_none_reaches_the_guard_of_fused_updates():
    env = cart_env(worlds=4, seed=3)
    for name, term in (("advantages", "surrogate"), ("returns", "value")):
        alg = construct(FusedPPO, env)
        learn(alg, env, 1)
        before = state(alg)
        collect(alg, env, env.get_observations())
        getattr(alg.storage, name)[0, 0] = torch.nan
        with pytest.raises(FloatingPointError, match=term):
            alg.update()
        assert torch.equal(state(alg), before)


def test_a_first_update_that_fails_leaves_adam_where_it_is():
    """A graph is captured after the first update; it would start Adam anew at each replay if Adam had no numbers."""
    env = cart_env(worlds=4, seed=3)
    alg, fresh = construct(CapturedPPO, env), construct(CapturedPPO, env)
    collect(alg, env, env.get_observations())
    alg.storage.returns[0, 0] = torch.nan
    with pytest.raises(FloatingPointError, match="value"):
        alg.update()
    numbers = [x for each in alg.optimizer.state.values() for x in each.values()]
    assert len(numbers) == 3 * len(list(alg.actor.parameters()) + list(alg.critic.parameters()))
    assert not any(x.any() for x in numbers)
    learn(alg, env)
    learn(fresh, env)
    assert torch.equal(state(alg), state(fresh)) and alg.learning_rate == fresh.learning_rate
    after = [x for each in alg.optimizer.state.values() for x in each.values()]
    assert all(x is y for x, y in zip(numbers, after, strict=True))


@pytest.mark.parametrize(
    "options, why",
    [
        ({"optimizer": "sgd"}, "the optimizer is SGD, neither Adam nor AdamW"),
        ({"actor": {"class_name": "RNNModel", "rnn_type": "gru", "rnn_hidden_dim": 8}}, "the actor is recurrent"),
        ({"symmetry_cfg": None, "optimizer": "rmsprop"}, "the optimizer is RMSprop"),
    ],
)
def test_what_has_no_graph_learns_as_in_rsl_rl(options, why):
    env = cart_env(worlds=4, seed=3)
    if "actor" in options:
        options["critic"] = options["actor"]
    alg = construct(CapturedPPO, env, **options)
    assert why in alg.obstacle
    before = state(alg)
    losses = learn(alg, env, 1)
    assert set(losses[0]) == {"value", "surrogate", "entropy"} and not torch.equal(state(alg), before)


def test_what_rsl_rl_does_is_what_was_read():
    """A release that changes this code must be read, and CapturedPPO, FusedUpdate or Runner.learn follow it."""
    import importlib.metadata

    version = importlib.metadata.version("rsl-rl-lib")
    for function, known in RESTATED.items():
        digest = hashlib.sha256(inspect.getsource(function).encode()).hexdigest()[:16]
        assert digest == known, f"rsl_rl {version}: {function.__qualname__} has changed ({digest}): read it"


def test_products_in_bfloat16_need_a_gpu(tmp_path, capsys):
    with pytest.raises(SystemExit):
        train.main(["cartpole", "--device", "cpu", "--worlds", "4", "--precision", "bfloat16", "--out", str(tmp_path)])
    assert "precision is 'bfloat16' on cpu, a CPU; expected a GPU of compute capability 8.0" in capsys.readouterr().err
    with pytest.raises(ValueError, match="Learner: precision is 'half'; expected one of float32, tf32, bfloat16"):
        learning.Learner(precision="half")


@pytest.mark.slow
def test_a_training_starts_without_the_compiler_of_torch(tmp_path):
    """Whose import takes seconds; the parts of the start are printed with the first iteration."""
    script = "import sys; from warp_spo import train; train.main(sys.argv[1:]); print('torch._dynamo' in sys.modules)"
    given = ["cartpole", "--device", "cpu", "--worlds", "4", "--iterations", "1", "--profile-start", "--logger", "none"]
    done = subprocess.run(
        [sys.executable, "-c", script, *given, "--out", str(tmp_path)], capture_output=True, text=True, check=True
    )
    assert done.stdout.strip().endswith("False")
    parts = ("import torch", "import rsl_rl", "the environment", "the first iteration", "from the start")
    assert all(f" s  {part}\n" in done.stdout for part in parts), done.stdout


def test_obstacles_of_fused_updates_are_named():
    env = cart_env(worlds=4, seed=3)
    alg = construct(FusedPPO, env, normalize_advantage_per_mini_batch=True)
    assert alg._fused is None and "advantages" in fused_update.find_obstacle(alg)
    alg = construct(FusedPPO, env, actor={"activation": "tanh"})
    assert alg._fused is None and "other layers" in fused_update.find_obstacle(alg)
