"""Errors of environments, by name, and observations of worlds that are not reset."""

import numpy as np
import pytest
import torch

import warp_spo as spo
from support.env_scenes import cart_env
from warp_spo.env import Observation, TorchTerm, actions, commands, events, gymnasium, learning, recording, validation
from warp_spo.env.observations import Each
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
    (dict(terminations={"x": lambda w: w.q[0]}), "termination 'x' returned a number; expected a comparison"),
    (dict(actions=[]), r"actions is \[\]; expected one of warp_spo.env.actions, or several"),
    (dict(commands=3), "commands is 3; expected None, or one of warp_spo.env.commands"),
    (dict(graph="x"), "graph is 'x'; expected True or False"),
    (dict(terminations={"not finite": lambda w: w.time > 1.0}), "'not finite', which every environment has"),
    (dict(actions=None), "actions holds None; expected those of warp_spo.env.actions"),
    (dict(actions=[actions.Effort("slide"), actions.Effort("slide")]), "two actions set entry 0 of tau"),
    (dict(actions=actions.Effort("(")), r"actions.Effort: '\(' is no regular expression"),
    (dict(actions=actions.Effort("slide", scale=NAN)), "scale is nan; expected finite numbers"),
    (dict(events=events.joints()), r"events is Reset.*expected a list"),
    (dict(events=[events.servo_gains()]), "an event changes actuator_gain, of which the scene has none"),
    (
        dict(observations={"a": [TorchTerm(Q, name="b/c")], "a/b": [TorchTerm(Q, name="c")]}),
        "two terms are counted as observation/a/b/c; expected other names",
    ),
    (dict(events=[events.encoder_bias(0.1, "slide"), events.encoder_bias(0.1, "hinge")]), "two encoder_bias"),
]


@pytest.mark.parametrize(("changes", "words"), ENVIRONMENTS)
def test_an_environment_names_what_is_wrong(changes, words):
    with pytest.raises((ValueError, TypeError), match=words):
        cart_env(**changes)


def returns(value):
    """Return a term that gives a value, or what a function makes of the world."""
    return lambda w: value(w) if callable(value) else value


def assigns(name, value, entry=None):
    """Return an event's function that sets ``w.name``, or an entry of it."""

    def change(w):
        if entry is None:
            setattr(w, name, value)
        else:
            getattr(w, name)[entry] = value

    return change


def keeps(name, size, values):
    def term(w):
        w.memory(name, size)
        w.keep(name, values)
        return 1.0

    return term


class Given(commands.Uniform):
    def draw(self, w, done):
        return self.ranges


class Updated(commands.Uniform):
    given = None

    def update(self, w, command):
        return self.given


UPDATED = [Updated(((-1.0, 1.0),)) for _ in range(2)]
object.__setattr__(UPDATED[1], "given", np.ones(3))


class Setting(actions.Effort):
    def trace(self, w, action):
        return self.scale


MASS = "body_mass"
SEEN = r"Env: the observation 'unnamed' \(test_env_refusals.py, line \d+\) returned"
RETURNED = [
    (dict(observations={"actor": [Q, returns(None)]}), f"{SEEN} None; expected numbers"),
    (dict(observations={"actor": [Q, returns("x")]}), f"{SEEN} 'x'; expected numbers"),
    (dict(observations={"actor": [Q, returns([1.0, None])]}), f"{SEEN} a list of 2 that holds None; expected numbers"),
    (dict(observations={"actor": [Q, returns(NAN)]}), f"{SEEN} nan; expected finite numbers"),
    (dict(observations={"actor": [Q, returns(torch.ones(2))]}), f"{SEEN} Tensor; .*a term in torch is a TorchTerm"),
    (dict(observations={"actor": [returns([])]}), r"terms of observations\['actor'\] returned no numbers"),
    (
        dict(observations={"actor": [Each(lambda w, row: w.q, [[1.0]] * 20)]}),
        "returned for a row an array",
    ),
    (dict(rewards={"up": (1.0, returns(None))}), "Env: reward 'up' returned None; expected one number"),
    (dict(rewards={"up": (1.0, Q)}), r"reward 'up' returned an array of shape \(2,\); expected one number"),
    (dict(rewards={"up": (1.0, returns(float("inf")))}), "reward 'up' returned inf; expected one finite number"),
    (dict(terminations={"out": returns(None)}), "Env: termination 'out' returned None; expected a comparison"),
    (
        dict(terminations={"out": returns(np.int64(1))}),
        r"termination 'out' returned np.int64\(1\); expected a comparison",
    ),
    (dict(events=[events.Reset(assigns("q", None, 0))]), r"events\[0\] sets w.q to an array .* holds None; expected 2"),
    (dict(events=[events.Interval(assigns("qd", [1.0]))]), r"events\[0\] sets w.qd to a list of 1; expected 2 numbers"),
    (
        dict(events=[events.Values(MASS, assigns("values", {MASS: [1.0]}))]),
        r"sets w.values\['body_mass'\] to a list of 1",
    ),
    (
        dict(events=[events.Values(MASS, assigns("values", 1.0, "body_com"))]),
        r"w.values\['body_com'\]; expected one of",
    ),
    (dict(rewards={"up": (1.0, keeps("m", 1, [1.0, 2.0]))}), r"World.keep\('m'\) was given a list of 2; expected one"),
    (dict(rewards={"up": (1.0, keeps("m", 1, None))}), r"World.keep\('m'\) was given None; expected one number"),
    (dict(rewards={"up": (1.0, keeps("m", 0.5, 1.0))}), r"World.memory\('m'\): size is 0.5; expected an integer"),
    (dict(rewards={"up": (1.0, keeps(3, 1, 1.0))}), "World.memory: name is 3; expected a string"),
    (dict(rewards={"up": (1.0, lambda w: w.memory("m", 1, NAN)[0])}), "reset is nan; expected a finite number"),
    (dict(commands=Given(((1.0, 2.0),))), "commands.draw returned a tuple of 1; expected vectors by name"),
    (dict(commands=UPDATED[0]), "Env: commands.update returned None; expected one number"),
    (dict(commands=UPDATED[1]), r"Env: commands.update returned an array of shape \(3,\); expected one number"),
    (dict(metrics={"m": returns(None)}), "Env: metric 'm' returned None; expected one number"),
    (
        dict(events=[events.Start(keeps("m", 1, None))]),
        r"Env: events\[0\]: World.keep\('m'\) was given None; expected one number",
    ),
    (
        dict(actions=Setting(scale=[(7, 1.0)])),
        "actions.Setting.trace: an entry of tau is 7; expected an integer, 0 to 1",
    ),
    (dict(actions=Setting(scale=[(0, None)])), "actions.Setting sets entry 0 of tau to None; expected one number"),
]


@pytest.mark.parametrize(("changes", "words"), RETURNED)
def test_what_came_of_a_function_is_named(changes, words):
    with pytest.raises((ValueError, TypeError), match=words):
        cart_env(**changes)


WRONG = [
    (lambda w: w.q[5], "index 5 is out of bounds"),
    (lambda w: w.q[0] % 1.0, "%, // or divmod does not take an abstract scalar; expected"),
    (lambda w: 7 // w.q[0], "%, // or divmod does not take"),
    (lambda w: round(w.q[0]), "round, math.floor, ceil or trunc does not take"),
    (lambda w: w.phase(0), "World.phase: period is 0; expected a finite number above zero"),
    (lambda w: w.phase(-1.0), "World.phase: period is -1.0; expected"),
    (lambda w: w.phase(NAN), "World.phase: period is nan; expected"),
    (lambda w: w.contact_gap, "a term reads contacts, and the scene has none"),
]


@pytest.mark.parametrize(("term", "words"), WRONG)
def test_errors_inside_of_terms_name_the_term(term, words):
    groups = {"actor": [lambda w: w.q, term]}
    changes = dict(
        observations=(groups, r"the observation 'unnamed' \(test_env_refusals.py, line \d+\)"),
        rewards=({"up": (1.0, term)}, "reward 'up'"),
        terminations=({"out": term}, "termination 'out'"),
        metrics=({"m": term}, "metric 'm'"),
        events=([events.Start(lambda w: w.keep("m", [term(w)]))], r"events\[0\]"),
    )
    for name, (given, place) in changes.items():
        with pytest.raises((IndexError, TypeError, ValueError), match=f"^Env: {place}: {words}"):
            cart_env(**{name: given})


def test_comparisons_and_integers_are_numbers_in_observations_and_rewards():
    """A comparison is 1 or 0; NumPy's integers, nested lists and arrays of one number count as numbers."""
    seen = [lambda w: w.q[0] > 0.0, lambda w: [w.q[1] > 0.0, np.int64(3)], lambda w: [w.qd, [w.q[0]]]]
    earned = {"right": (1.0, lambda w: [w.q[0] > 0.0]), "three": (2.0, lambda w: np.int32(3))}
    env = cart_env(observations={"actor": seen}, rewards=earned, events=[events.joints((-0.1, 0.1))])
    observed, reward, *_ = env.step(torch.zeros(8, 1))
    right, three = (env.q > 0.0).float().T, torch.full((8,), 3.0)
    assert observed["actor"].equal(torch.stack([*right, three, *env.qd.T, env.q[:, 0]], dim=1))
    assert torch.allclose(reward, env.step_dt * (right[0] + 6.0)) and 0 < right[0].sum() < 8


LEARNERS = [
    (dict(steps=0), "Learner: steps is 0; expected an integer, 1 or more"),
    (dict(batches=0), "batches is 0"),
    (dict(epochs=0), "epochs is 0"),
    (dict(iterations=-1), "iterations is -1"),
    (dict(worlds=2.5), "worlds is 2.5"),
    (dict(steps="24"), "steps is '24'"),
    (dict(hidden=()), r"hidden is \(\); expected widths of one layer or more"),
    (dict(hidden=64), "hidden is 64; expected widths"),
    (dict(hidden=(64, 0)), r"hidden\[1\] is 0; expected an integer, 1 or more"),
    (dict(rate=0.0), "rate is 0.0; expected a finite number above zero"),
    (dict(target=NAN), "target is nan; expected a finite number above zero"),
    (dict(deviation=0.0), "deviation is 0.0; expected a finite number, 0.05 to 2"),
    (dict(discount=1.1), "discount is 1.1; expected a finite number, 0 to 1"),
    (dict(trace=-0.1), "trace is -0.1; expected a finite number, 0 to 1"),
    (dict(entropy="x"), "entropy is 'x'; expected a finite number, 0 or more"),
    (dict(normalize=1), "normalize is 1; expected True or False"),
]


@pytest.mark.parametrize(("changes", "words"), LEARNERS)
def test_a_learner_names_what_is_wrong(changes, words):
    with pytest.raises(ValueError, match=words):
        learning.Learner(**changes)


def test_a_training_names_what_is_wrong(tmp_path):
    env, short = cart_env(2), learning.Learner(steps=1, batches=4)
    with pytest.raises(ValueError, match=r"Learner: 2 world\(s\) take steps=1 .* 2 in all, for batches=4; expected"):
        learning.train(env, short, tmp_path / "few")
    for given, words in (
        (dict(save_interval=0), "train: save_interval is 0; expected an integer, 1 or more"),
        (dict(every=0), "train: every is 0; expected an integer, 1 or more"),
        (dict(iterations=0), "train: iterations is 0"),
        (dict(seconds=NAN), "train: seconds is nan; expected a number above zero"),
        (dict(seed="x"), "train: seed is 'x'"),
    ):
        with pytest.raises(ValueError, match=words):
            learning.train(env, learning.Learner(), tmp_path / "none", **given)
    assert not list(tmp_path.iterdir())
    with pytest.raises(ValueError, match=r"recording.record: seconds is 0.0; expected a finite number, 0.02 or more"):
        recording.record(env, None, 0.0)
    with pytest.raises(ValueError, match=r"recording.film: every is 0; expected an integer, 1 or more"):
        recording.film(None, None, every=0)


def test_an_environment_made_in_inference_mode_works_outside():
    """And inside: the course is the same to the bit."""
    drive = lambda env: [env.step(torch.full((8, 1), 0.1))[0]["actor"] for _ in range(3)][-1]  # noqa: E731
    with torch.inference_mode():
        env, ages = cart_env(final_observations=True), torch.arange(8)
        env.episode_length_buf = ages  # its log remembers whose
        inside = drive(env)
        worlds = gymnasium(env, autoreset_mode="NextStep")
        worlds.step(worlds.action_space.sample())
    env.reset(seed=0)
    env.episode_length_buf = ages
    assert drive(env).equal(inside)
    worlds.reset(seed=3)
    worlds.step(worlds.action_space.sample())
    worlds.reset(options={"reset_mask": np.ones(8, bool)})
    env.q[0] = 0.1
    env.load_state_dict(env.state_dict())


def test_tensors_that_are_written_require_no_grad():
    """The refusal names where they were written; the environment goes on with the numbers of its own tensors."""
    drawn = events.randomise("joint_damping", (1.0, 1.0), how="set")
    remembers = {"actor": [lambda w: w.memory("own", 1, reset=None)], "critic": [lambda w: w.value("joint_damping")[0]]}
    env = cart_env(3, events=[drawn], observations=remembers, commands=commands.Uniform(ranges=((0.0, 0.0),)))
    asks = lambda *shape: torch.full(shape, 2.0, requires_grad=True)  # noqa: E731
    damping = env.values["joint_damping"]
    refused = "x requires grad; .*x.detach"
    with pytest.raises(ValueError, match=rf"env.values\['joint_damping'\] = x: {refused}"):
        env.values["joint_damping"] = asks(3, 2)
    with pytest.raises(ValueError, match=f"env.command = x: {refused}"):
        env.command = asks(3, 1)
    with pytest.raises(ValueError, match=f"env.command: {refused}"):
        env.command[1:].copy_(asks(2, 1))
    assert (damping == 1.0).all() and not env.command.any()
    for write, name in [
        (lambda: damping[1:, 0].copy_(asks(2)), r"env.values\['joint_damping'\]"),
        (lambda: env.q.__setitem__(0, 0.01 * asks(2)), "env.q"),
        (lambda: env.qd.mul_(asks(3, 2)), "env.qd"),
        (lambda: env.memory("own")[:].add_(asks(3, 1)), r"env.memory\(...\)"),
    ]:
        write()
        with pytest.raises(ValueError, match=f"Env: x requires grad, .* into {name}; expected x.detach"):
            env.step(torch.zeros(3, 1))
        observed, reward, _, _ = env.step(torch.zeros(3, 1))
        assert not reward.requires_grad and not env.state_dict()["memory"].requires_grad
    assert observed["critic"][2].item() == 2.0 and observed["actor"].tolist() == [[2.0]] * 3
    env.load_state_dict({name: x.requires_grad_(x.is_floating_point()) for name, x in env.state_dict().items()})
    with torch.no_grad():
        env.q[:] = 0.01 * asks(3, 2)
    env.values["joint_damping"] = asks(3, 2).detach()
    assert env.step(torch.zeros(3, 1))[0]["critic"].tolist() == [[2.0]] * 3


@pytest.mark.parametrize(
    ("bounds", "expected"),
    [
        ({}, ""),
        (dict(least=0.5), ", 0.5 or more"),
        (dict(most=2.0), ", 2 or less"),
        (dict(least=0.5, most=2.0), ", 0.5 to 2"),
    ],
)
def test_a_number_out_of_bounds_is_told_all_of_them(bounds, expected):
    with pytest.raises(ValueError, match=f"^Call: x is nan; expected a finite number{expected}$"):
        validation.check_number("Call", "x", NAN, **bounds)


def test_values_that_are_written_are_numbers():
    env = cart_env(3, events=[events.randomise("joint_damping", (1.0, 1.0), how="set")])
    for x, words in [
        (np.ones((2, 2)), r"x is torch.float64 \(2, 2\); expected real numbers \(3, 2\)"),
        (np.ones((1, 3, 2)), r"x is torch.float64 \(1, 3, 2\); expected"),
        ("a", "x is 'a'; expected real numbers"),
        (None, "x is None; expected real numbers"),
        ([[1, 2], [3]], "expected real numbers"),
        (torch.ones(3, 2, dtype=torch.complex64), "x is torch.complex64"),
        (torch.ones(3, 2).to_sparse(), "x is of layout"),
        (torch.ones(3, 2, device="meta"), "x is on the device meta"),
    ]:
        with pytest.raises((ValueError, TypeError), match=rf"env.values\['joint_damping'\] = x: .*{words}"):
            env.values["joint_damping"] = x
    with pytest.raises(KeyError, match=r"no event changes 'body_mass'; expected one of \[joint_damping\].*randomise"):
        env.values["body_mass"] = 1.0
    assert (env.values["joint_damping"] == 1.0).all() and "body_mass" not in env.values
    env.values["joint_damping"] = [2.0, 3.0]
    assert env.values["joint_damping"].tolist() == [[2.0, 3.0]] * 3


PARTS = [
    (lambda: Observation(Q, noise=-1.0), "Observation: noise is -1.0; expected a finite number, 0 or more"),
    (lambda: Observation(Q, clip=(1.0, -1.0)), r"clip is \(1.0, -1.0\); expected a range \(lowest, highest\)"),
    (lambda: Observation(Q, delay=(3, 2)), r"delay is \(3, 2\); expected steps, 0 or more, or a pair"),
    (lambda: Observation(Q, history=0), "history is 0; expected an integer, 1 or more"),
    (lambda: Each(3, [[1.0]]), "observations.Each: function is 3; expected a function"),
    (lambda: Each(Q, np.zeros((0, 1))), r"observations.Each: rows has shape \(0, 1\); expected .* one row or more"),
    (lambda: events.Reset(None), "events.Reset: change is None; expected a function"),
    (lambda: events.Interval(3), "events.Interval: change is 3; expected a function"),
    (lambda: events.Values(MASS, None), "events.Values: change is None; expected a function"),
    (lambda: events.Values(3, Q), "events.Values: names is 3; expected names"),
    (lambda: events.Start(None), "events.Start: change is None; expected a function"),
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
        (torch.zeros(8, 1, device="meta"), "on the device meta, without numbers; expected a dense tensor"),
        (torch.zeros(8, 1).to_sparse(), "of layout torch.sparse_coo; expected a dense tensor"),
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
