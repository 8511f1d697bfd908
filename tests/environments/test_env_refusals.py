"""Errors of environments, by name, and observations of worlds that are not reset."""

import pytest
import torch

import warp_spo as spo
from support.env_scenes import cart_env
from warp_spo.env import Observation, TorchTerm, actions, commands, events
from warp_spo.examples import fourbar

NAN = float("nan")
Q = lambda w: w.q  # noqa: E731

ENVIRONMENTS = [
    (dict(seed=-1), "Env: seed is -1; expected an integer, 0 to 18446744073709551615"),
    (dict(seed=1.5), "seed is 1.5"),
    (dict(first_world=2**33), "first_world is 8589934592"),
    (dict(dt="x"), "dt is 'x'; expected a finite number"),
    (dict(passes=3), "Env: passes is 3, and the scene has no contacts; expected None"),
    (dict(final_observations="maybe"), "Env: final_observations is 'maybe'; expected True or False"),
    (dict(log_interval=0), "log_interval is 0; expected an integer, 1 or more"),
    (dict(default_q=[0.0, NAN]), "default_q is .*nan.*; expected finite numbers"),
    (dict(rewards=[Q]), r"rewards is \[.*expected pairs \(weight, term\) by name"),
    (dict(rewards={"x": ("1", Q)}), r"the weight of rewards\['x'\] is '1'; expected a finite number"),
    (dict(rewards={"x": (NAN, Q)}), "expected a finite number"),
    (dict(observations=[Q]), r"observations is \[.*expected lists of terms by name"),
    (dict(observations={"actor": Q}), r"observations\['actor'\] is .*expected a list of terms"),
    (dict(observations={"reward": [Q]}), "a group 'reward', which names another result"),
    (dict(observations={"actor": ["q"]}), "Observation: term is 'q'; expected a function"),
    (dict(terminations=[Q]), "terminations is .*expected terms by name"),
    (dict(terminations={"x": None}), r"terminations\['x'\] is None; expected a function"),
    (dict(terminations={"x": lambda w: w.q[0]}), "a termination returned AbstractScalar; expected a comparison"),
    (dict(terminations={"not finite": lambda w: w.time > 1.0}), "'not finite', which every environment has"),
    (dict(actions=None), "actions holds None; expected those of warp_spo.env.actions"),
    (dict(actions=[actions.Effort("slide"), actions.Effort("slide")]), "two actions set entry 0 of tau"),
    (dict(actions=actions.Effort("(")), r"actions.Effort: '\(' is no regular expression"),
    (dict(actions=actions.Effort("slide", scale=NAN)), "scale is nan; expected finite numbers"),
    (dict(events=events.joints()), r"events is Reset.*expected a list"),
    (dict(events=[events.servo_gains()]), "an event changes actuator_gain, of which the scene has none"),
    (dict(events=[events.encoder_bias(0.1, "slide"), events.encoder_bias(0.1, "hinge")]), "two encoder_bias"),
]


@pytest.mark.parametrize(("changes", "words"), ENVIRONMENTS)
def test_an_environment_names_what_is_wrong(changes, words):
    with pytest.raises((ValueError, TypeError), match=words):
        cart_env(**changes)


PARTS = [
    (lambda: Observation(Q, noise=-1.0), "Observation: noise is -1.0; expected a finite number, 0 or more"),
    (lambda: Observation(Q, clip=(1.0, -1.0)), r"clip is \(1.0, -1.0\); expected a range \(lowest, highest\)"),
    (lambda: Observation(Q, delay=(3, 2)), r"delay is \(3, 2\); expected steps, 0 or more, or a pair"),
    (lambda: Observation(Q, history=0), "history is 0; expected an integer, 1 or more"),
    (lambda: TorchTerm(3), "TorchTerm: function is 3; expected a function"),
    (lambda: TorchTerm(Q, size=0), "TorchTerm: size is 0"),
    (lambda: actions.Position(clip=(1.0, NAN)), r"actions.Position: clip is \(1.0, nan\)"),
    (lambda: commands.Velocity(forward=1.0), "commands.Velocity: forward is 1.0; expected a range"),
    (lambda: commands.Velocity(seconds=(0.0, 0.0)), "the range of seconds is .*a highest above zero"),
    (lambda: commands.Uniform(ranges=((0.0, 1.0), (1.0, 0.0))), r"ranges\[1\] is \(1.0, 0.0\)"),
    (lambda: commands.Level("up", share=NAN), "commands.Level: share is nan"),
    (lambda: events.joints(position=0.1), "events.joints: position is 0.1; expected a range"),
    (lambda: events.base(yaw=(1.0, -1.0)), "events.base: yaw is"),
    (lambda: events.push(velocity=(-0.5, 0.5)), "events.push: velocity is .*expected a finite number, 0 or more"),
    (lambda: events.randomise("body_mass", (1.2, 0.8)), "events.randomise: span of body_mass is"),
    (lambda: events.randomise("body_mass", (0.8, 1.2), alike="yes"), "alike is 'yes'; expected True or False"),
    (lambda: events.randomise("body_mass", (0.8, 1.2), when=(3, 1)), r"events.Values: when: the range of seconds is"),
    (lambda: events.pseudo_inertia(size=(0.8, 1.2)), "events.pseudo_inertia: size is"),
    (lambda: events.servo_gains(stiffness=1.0), "events.servo_gains: stiffness is"),
    (lambda: events.delays((0, 1.5)), "events.delays: steps is"),
    (lambda: events.encoder_bias(-0.1), "events.encoder_bias: size is"),
]


@pytest.mark.parametrize(("call", "words"), PARTS)
def test_parts_name_what_is_wrong(call, words):
    with pytest.raises((ValueError, TypeError), match=words):
        call()


def test_calls_name_what_is_wrong():
    env = cart_env()
    for actions_, words in (
        (None, "NoneType; expected a tensor"),
        (torch.zeros(8, 1) * 1j, "complex numbers of shape"),
    ):
        with pytest.raises((ValueError, TypeError), match=f"Env.step: actions .*{words}"):
            env.step(actions_)
    with pytest.raises(ValueError, match=r"Env.controls: actions has shape \(1, 1\); expected \(8, 1\)"):
        env.controls(torch.zeros(1, 1))
    asks = torch.zeros(8, 1, requires_grad=True)
    with pytest.raises(ValueError, match=r"Env.step: actions requires grad; .*actions.detach\(\)"):
        env.step(2.0 * asks)
    with torch.no_grad():
        env.step(asks)
    for wrong, words in (
        (torch.zeros(3, dtype=torch.int64), r"int64 \(3,\)"),
        (torch.full((8,), NAN), "float32"),
        (None, ""),
    ):
        with pytest.raises((ValueError, TypeError), match=rf"episode_length_buf: got .*{words}.*integers \(8,\)"):
            env.episode_length_buf = wrong
    with pytest.raises(ValueError, match=r"Env.command: this environment gives no commands"):
        _ = env.command
    for call in (env.start_at, env.load_state_dict):
        with pytest.raises(TypeError, match=rf"Env.{call.__name__}: .* is int; expected a dictionary of tensors"):
            call(3)
    with pytest.raises(ValueError, match=r"Env.set_seed: seed is 'x'"):
        env.set_seed("x")
    with pytest.raises(TypeError, match=r"Env: scene is NoneType; expected spo.Scene"):
        type(env)(None, 8, "cpu", actions=None, observations={}, rewards={})
    linkage = fourbar.scene()
    with pytest.raises(spo.UnsupportedError, match=r"Env: a scene with 1 loop joint.*scene.without_loops\(\)"):
        type(env)(linkage, 8, "cpu", actions=actions.Effort(), observations={"a": [Q]}, rewards={})
    turned = TorchTerm(lambda env: env.q.t(), size=2, name="turned")
    with pytest.raises(ValueError, match=r"the term turned returned \(2, 8\); expected a tensor \(8, 2\)"):
        cart_env(observations={"actor": [turned]})


@pytest.mark.slow
def test_terms_in_torch_leave_no_graph_behind():
    """A network in a term keeps nothing of a step for a backward pass."""
    net = torch.nn.Linear(2, 1)
    scored = TorchTerm(lambda env: net(env.q)[:, 0], name="scored")
    env = cart_env(observations={"actor": [scored]})
    observed, *_ = env.step(torch.zeros(8, 1))
    assert not observed["actor"].requires_grad and not any(x.requires_grad for x in env._tensors.values())
    assert torch.allclose(observed["actor"], net(env.q).detach(), atol=1e-6)
    with pytest.raises(ValueError, match=r"the term turning returned torch.complex64; expected real numbers"):
        cart_env(observations={"actor": [TorchTerm(lambda env: 1j * env.q[:, 0], name="turning")]})


@pytest.mark.slow
def test_groups_share_the_history_of_an_observation():
    """An observation in two groups is one measurement, with its noise, of each step; resets of others change none."""
    seen = Observation(lambda w: w.q[1], noise=0.1, history=3)
    late = Observation(Q, noise=0.1, history=2, delay=(0, 2))
    env = cart_env(observations={"actor": [seen, late], "critic": [seen, lambda w: w.q[1]]}, episode_length_s=9.0)
    rows = [env.step(torch.zeros(8, 1))[0] for _ in range(5)]
    for now, before in zip(rows[1:], rows, strict=False):
        assert now["actor"][:, :3].equal(now["critic"][:, :3])
        assert now["actor"][:, 1:3].equal(before["actor"][:, :2])
        assert ((now["actor"][:, 0] - now["critic"][:, 3]).abs() <= 0.1).all()
        assert not now["actor"][:, 0].equal(before["actor"][:, 0])
    mask = torch.arange(8) < 3
    again, observed = env.reset(mask)[0], rows[-1]
    for group in ("actor", "critic"):
        assert again[group][~mask].equal(observed[group][~mask])
        assert not (again[group][mask] == observed[group][mask]).any()
    assert env.get_observations()["actor"].equal(again["actor"])
