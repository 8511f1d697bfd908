"""Environments on a GPU: terms that a graph cannot hold, and bad input; ``pytest --device cuda:0``."""

import warnings

import pytest
import torch

from support.env_scenes import cart_env
from warp_spo.env import Observation, TorchTerm, observations


@pytest.fixture(autouse=True)
def gpu(device):
    if not device.is_cuda:
        pytest.skip("graphs are of CUDA")
    return str(device)


def item(env):
    return env.q[:, 1] * env.q[:, 0].abs().max().item()


def branch(env):
    return env.q[:, 1] if env.q[:, 0].mean() > 0.0 else -env.q[:, 1]


def mask(env):
    found = env.q[:, 1].clone()
    found[env.q[:, 0] > 0.0] = 1.0
    return found * len(torch.nonzero(env.q[:, 0] > 0.0))


def host(env):
    return torch.tensor(env.q[:, 1].cpu().numpy(), device=env.device)


def waits(env):
    """The first step does not notice this one; the capture does."""
    torch.cuda.synchronize(env.device)
    return env.q[:, 1] ** 2


def allocates(env):
    """Memory that a graph keeps."""
    return torch.cat([torch.empty(1 << 16, device=env.device), env.q[:, 1]])[1 << 16 :] * 2.0


def energy(env):
    return env.dyn.kinetic_energy(env.q, env.qd)


@pytest.mark.parametrize(
    ("term", "graphs"), [(item, 2), (branch, 2), (mask, 2), (host, 2), (waits, 2), (allocates, 1), (energy, 1)]
)
def test_a_term_that_waits_runs_between_graphs_and_is_named(gpu, term, graphs):
    """Rewards are those of an environment without graphs, to the bit."""
    make = lambda **more: cart_env(64, gpu, rewards={"own": (1.0, TorchTerm(term))}, **more)  # noqa: E731
    own, plain = make(), make(graph=False)
    generator = torch.Generator(device=gpu).manual_seed(0)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        for _ in range(25):
            given = torch.randn(64, 1, generator=generator, device=gpu)
            (observed, reward, done, _), expected = own.step(given), plain.step(given)
            assert (
                reward.equal(expected[1]) and observed["actor"].equal(expected[0]["actor"]) and done.equal(expected[2])
            )
    told = [str(each.message) for each in seen if "CUDA graph" in str(each.message)]
    assert own.replay.captured == graphs and plain.replay.captured == 0
    assert len(told) == graphs - 1 and all(
        f"the term {term.__name__} cannot be part of a CUDA graph" in x for x in told
    )


def test_bad_actions_stay_in_their_world(gpu):
    """NaN and infinite actions end the episodes of two worlds; all others go on, to the bit. Shapes are refused."""
    bad, good = cart_env(64, gpu), cart_env(64, gpu)
    others = torch.ones(64, dtype=torch.bool, device=gpu)
    others[[5, 40]] = False
    for step in range(6):
        given = torch.full((64, 1), 0.1, device=gpu)
        expected = good.step(given)
        if step == 3:
            given[5], given[40] = float("nan"), float("inf")
        observed, reward, done, _ = bad.step(given)
        assert observed["actor"][others].equal(expected[0]["actor"][others]) and reward[others].equal(
            expected[1][others]
        )
        assert torch.isfinite(observed["actor"]).all() and torch.isfinite(reward).all()
        assert done.bool().equal(~others if step == 3 else torch.zeros_like(others))
    assert bad.log()["/not finite/action"] == 2 and good.log()["/not finite/action"] == 0
    with pytest.raises(ValueError, match=r"actions has shape \(64, 2\); expected \(64, 1\)"):
        bad.step(torch.zeros(64, 2, device=gpu))
    for wrong in (torch.ones(63, dtype=torch.bool, device=gpu), torch.ones(64, device=gpu)):
        with pytest.raises(ValueError, match=r"Env.reset: mask is .*; expected bool \(64,\)"):
            bad.reset(wrong)
    state = bad.q.clone()
    bad.reset(~others)  # chosen worlds alone
    assert bad.q[others].equal(state[others]) and not bad.q[~others].equal(state[~others])


def test_kernels_of_an_observation_run_side_by_side(gpu):
    """In a graph they have the same bits as in turn, with noise, new starts, and looks after resets of some worlds.

    Rows that a block writes together are those of a list that each thread writes.
    """
    each = observations.Each(lambda w, row: row[0] * w.q[1] + row[1] * w.time, torch.rand(50, 2).numpy())
    noisy = [Observation(each, noise=0.1), Observation(lambda w: w.q, noise=0.1, history=3)]
    terms = {"a": noisy, "b": [each, lambda w: w.q, each], "list": [lambda w: each(w)]}
    own, plain = (cart_env(1001, gpu, observations=terms, graph=graph) for graph in (True, False))
    generator = torch.Generator(device=gpu).manual_seed(0)
    for step in range(30):
        given = torch.randn(1001, 1, generator=generator, device=gpu)
        seen, expected = own.step(given)[0], plain.step(given)[0]
        assert all(seen[name].equal(expected[name]) for name in terms)
        for rows in (seen["b"][:, :50], seen["b"][:, -50:]):
            assert torch.allclose(rows, seen["list"], atol=1e-6)
        assert ((seen["a"][:, :50] - seen["list"]).abs() <= 0.1 + 1e-6).all()
        if step % 10 == 5:
            chosen = torch.rand(1001, generator=generator, device=gpu) < 0.3
            seen, expected = own.reset(chosen)[0], plain.reset(chosen)[0]
            assert all(seen[name].equal(expected[name]) for name in terms)
    assert own.replay.captured == 1 and own._tensors["tick"].equal(plain._tensors["tick"])
