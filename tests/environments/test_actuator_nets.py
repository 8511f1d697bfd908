"""Learned actuators in environments beside torch's evaluation of the same network; their gradients by differences."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch
import warp as wp

import warp_spo as spo
from support.env_scenes import FEET, walker_q, walker_scene
from support.host_lanes import run_network
from warp_spo.dynamics import dynamics
from warp_spo.env import Env, actions, events, observations, rewards
from warp_spo.env.actuator_nets import ActuatorNetwork
from warp_spo.env.compile import actuator_launches, tensor_weights
from warp_spo.execution.device_facts import MEASURED
from warp_spo.kernels import native, tensor_networks
from warp_spo.runtime import launches

JOINTS = 8
SAME = 1e-6  # of the largest torque: float32, sums of 32 terms


def module(sizes=(6, 32, 32, 32, 1), activation=torch.nn.Softsign, seed=0):
    torch.manual_seed(seed)
    layers = []
    for i, (into, out) in enumerate(itertools.pairwise(sizes)):
        layers += [torch.nn.Linear(into, out), *([activation()] if i < len(sizes) - 2 else [])]
    return torch.nn.Sequential(*layers)


def saved(net, path):
    torch.jit.save(torch.jit.script(net), str(path))
    return path


def network_of(*sizes, activation="softsign", **more):
    rng = np.random.default_rng(3)
    weights = [rng.normal(size=(o, i)) / np.sqrt(i) for i, o in itertools.pairwise(sizes)]
    return ActuatorNetwork(weights, [rng.normal(size=len(w)) for w in weights], activation, **more)


def rubbing_scene():
    """A walker in the air whose joints have friction, so that a step has guesses."""
    scene = walker_scene(delay=0)
    hinges = [scene.hinges[0], *(dataclasses.replace(each, friction=0.3) for each in scene.hinges[1:])]
    return spo.Scene(scene.bodies, hinges, actuators=scene.actuators)


def walker(network, worlds=4, device="cpu", scene=None, **changes):
    """Return a walker whose joints have learned actuators and no servos."""
    scene = walker_scene(delay=0) if scene is None else scene
    options = {
        "actions": network and actions.ActuatorNet(network, scale=0.5),
        "observations": {"actor": [observations.joint_position(), observations.joint_velocity()]},
        "rewards": {"effort": (-1e-3, rewards.torque)},
        "default_q": walker_q(),
        "episode_length_s": 0.5,
        "dt": 5e-3,
        "decimation": 4,
        "events": [events.joints((-0.2, 0.2), (-1.0, 1.0))],
    }
    return Env(scene, worlds, device, **(options | changes))


@pytest.mark.parametrize("order", ["pos_vel", "vel_pos"])
def test_torques_are_those_of_torch_through_30_steps(order, tmp_path):
    """120 substeps, an end of episodes: states are those before each substep, histories and torques torch's own."""
    net = module()
    network = ActuatorNetwork.from_torchscript(
        saved(net, tmp_path / "net.pt"), input_idx=(0, 2, 5), input_order=order, pos_scale=2.0, vel_scale=0.1,
        torque_scale=30.0,
    )  # fmt: skip
    env, recorded = walker(network), []
    step = env._step_dynamics

    def record(controls):
        recorded.append([each.clone() for each in (env.q, env.qd, controls["tau"])])
        step(controls)

    env._step_dynamics = record
    past, largest, worst = [], 0.0, 0.0
    generator = torch.Generator().manual_seed(1)
    for _ in range(30):
        given = torch.randn(4, JOINTS, generator=generator)
        recorded.clear()
        done = env.step(given)[2]
        target = env._tensors["net_targets"][:, 7:]
        assert torch.allclose(target, torch.tensor(walker_q()[7:], dtype=torch.float32) + 0.5 * given, atol=1e-6)
        assert len(recorded) == 4
        for q, qd, tau in recorded:
            past = [(target - q[:, 7:], qd[:, 6:]), *past[:5]]
            zero = torch.zeros_like(target)
            seen = [past[lag] if lag < len(past) else (zero, zero) for lag in (0, 2, 5)]
            errors, rates = ([2.0 * each[0] for each in seen], [0.1 * each[1] for each in seen])
            inputs = torch.stack([*errors, *rates] if order == "pos_vel" else [*rates, *errors], dim=-1)
            with torch.no_grad():
                torque = 30.0 * net(inputs)[..., 0]
            worst, largest = (
                max(worst, float((tau[:, 6:] - torque).abs().max())),
                max(largest, float(torque.abs().max())),
            )
        past = [] if bool(done.all()) else past
        assert bool(done.all()) == bool(done.any())  # all episodes are of the same length
    assert largest > 3.0 and worst < SAME * largest, (worst, largest)


@pytest.mark.parametrize("name", ["ReLU", "ELU", "Tanh", "Softplus"])
def test_activations(name, tmp_path):
    """The first torques after a start, for which no history counts but the present."""
    net = module((2, 16, 1), getattr(torch.nn, name))
    network = ActuatorNetwork.from_torchscript(saved(net, tmp_path / "net.pt"), input_idx=[0], torque_scale=5.0)
    env = walker(network, decimation=1)
    error, rate = torch.tensor(walker_q()[7:], dtype=torch.float32) - env.q[:, 7:], env.qd[:, 6:].clone()
    expected = network.torque(error[..., None].double(), rate[..., None].double())
    env.step(torch.zeros(4, JOINTS))
    assert torch.allclose(env._tensors["tau"][:, 6:].double(), expected, atol=SAME * float(expected.abs().max()))
    with torch.no_grad():
        inputs = torch.stack([error, rate], dim=-1)
        assert torch.allclose(5.0 * net(inputs)[..., 0].double(), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("sizes", "activation", "lags", "joints"),
    [
        ((6, 32, 32, 32, 1), "softsign", (0, 2, 4), 3),
        ((10, 20, 64, 1), "tanh", range(5), 2),
        ((2, 16, 1), "tanh", (0,), 1),
    ],
)
def test_products_of_tensor_cores_are_as_accurate_as_float32(sizes, activation, lags, joints, tmp_path):
    """The text of a GPU's kernel, run by 32 threads of the host, beside torch in float64."""
    network = network_of(*sizes, activation=activation, input_idx=lags)
    shape = tensor_weights.shape_of(network)
    given = np.random.default_rng(4).normal(size=(joints, 32, sizes[0])).astype(np.float32)
    staged = np.zeros((joints, shape.rows, tensor_networks.PITCH), np.float32)
    staged[:, : sizes[0], :32] = given.transpose(0, 2, 1)
    definition = tensor_networks.define("network", shape)
    found = run_network(definition, tensor_weights.pack(network, shape), staged, tmp_path)
    expected = network._evaluate(torch.tensor(given).double())[..., 0].numpy()
    assert np.abs(found - expected).max() < SAME * np.abs(expected).max()


def test_what_tensor_cores_do_not_evaluate():
    for network in (
        network_of(2, 16, 1, activation="relu", input_idx=(0,)),  # its outputs have no bound
        network_of(2, 65, 1, input_idx=(0,)),
        network_of(2, 1, input_idx=(0,)),
    ):
        assert tensor_weights.shape_of(network) is None


@pytest.mark.parametrize("rubs", [False, True])
def test_the_kernel_of_the_step_has_the_bits_of_kernels_apart(rubs, monkeypatch, device):
    """Two networks, histories, starts anew, limits, mean forces; other worlds beside change nothing."""
    first, other = network_of(4, 16, 1, input_idx=(0, 2), torque_scale=9.0), network_of(2, 8, 1, input_idx=(3,))
    acts = [actions.ActuatorNet(first, "joint_[1-6]"), actions.ActuatorNet(other, "joint_[78]")]
    seen = [observations.joint_position(), lambda w: w.joint_force]
    more = {"observations": {"actor": seen if rubs else [*seen, lambda w: w.contact_force[:, 2]]}}
    more |= {"scene": rubbing_scene()} if rubs else {}
    found = {}
    for name, kinds, worlds in (("apart", (), 40), ("joined", ("cpu", "cuda"), 40), ("more", ("cpu", "cuda"), 70)):
        monkeypatch.setattr(actuator_launches, "JOINED_ON", kinds)
        env = walker(None, worlds, str(device), actions=acts, granularity="segment", **more)
        assert (env._networks is None) == (name != "apart")
        generator = torch.Generator().manual_seed(1)
        given = [torch.randn(70, JOINTS, generator=generator)[:worlds].to(env.device) for _ in range(30)]
        found[name] = torch.stack([torch.cat([env.step(x)[0]["actor"], env.q, env.qd], dim=1)[:40] for x in given])
    assert torch.equal(found["apart"], found["joined"]) and torch.equal(found["joined"], found["more"])
    assert torch.isfinite(found["apart"]).all() and found["apart"].abs().max() > 1.0


def step_text(monkeypatch, **changes):
    """Return the text of the kernel of a step with a network as for a GPU; nothing is compiled or launched."""
    choose, kernel, texts = dynamics.plans.choose, native.kernel, []

    def record(name, text, *more, **options):
        texts.append(text)
        return kernel(name, text, *more, **options)

    monkeypatch.setattr(
        dynamics.plans, "choose", lambda scene, worlds, _, *more: choose(scene, worlds, MEASURED, *more)
    )
    monkeypatch.setattr(native, "kernel", record)
    monkeypatch.setattr(actuator_launches, "JOINED_ON", ("cpu",))
    monkeypatch.setattr(actuator_launches, "_has_tensor_cores", lambda _: True)
    for module in (wp, launches):
        monkeypatch.setattr(module, "launch", lambda *_, **__: None)
    walker(network_of(6, 16, 1, torque_scale=9.0), graph=False, **changes).step(torch.zeros(4, JOINTS))
    (found,) = [text for text in texts if "network_0::tiles" in text and "substeps_row" in text]
    return found.partition("const long long world = thread;")[0]  # what follows is for a CPU


def test_limbs_wait_for_torques_once_before_they_read_them(monkeypatch):
    """Where helpers compute torques beside them: in the first pass of a substep, in each text of limbs."""
    text = step_text(monkeypatch)
    assert "helpers = 4" in text and "__syncthreads_or" not in text
    parts = text.split('if (turn == 0) asm volatile("bar.sync 2, 256;" ::: "memory");')
    before, *others = (part.split("tau_row = ", 1)[-1].count("= tau_row[") for part in parts)
    assert before == 0 and len(others) == 1 and others[0] == 2 + 6  # of a limb that all four share, and of the base
    assert text.count("bar.arrive 2, 256;") == 1


def test_no_warps_help_where_all_of_a_block_vote(monkeypatch):
    """Guesses about friction are right when no thread of the block says otherwise."""
    text = step_text(monkeypatch, scene=rubbing_scene())
    assert "__syncthreads_or" in text and "helpers = 0" in text and "bar.sync 2" not in text


def test_limits_and_means_of_contact_forces():
    """Torques stay within limits of each world; contact forces of a step are means over its substeps, as without."""
    weights, biases = [np.array([[100.0, 0.0]])], [np.array([0.0])]
    network = ActuatorNetwork(weights, biases, "identity", input_idx=(0,))
    lower = events.randomise("joint_effort_limit", (1.0, 3.0), "set", names="joint_.*", alike=True)
    seen = {"actor": [lambda w: w.contact_force[:, 2], lambda w: w.feet(FEET).air_time]}
    env = walker(network, events=[lower], observations=seen, rewards={}, bounds=None, episode_length_s=5.0)
    dyn = spo.Dynamics(env.scene, 4, "cpu", "float32", variable=("joint_effort_limit",))
    dyn.set(joint_effort_limit=env.values["joint_effort_limit"])
    limits = env.values["joint_effort_limit"][:, 6:]
    target = torch.tensor(walker_q()[7:], dtype=torch.float32)
    report = dyn.step_report("contact_f", like=env.q)
    bound = 0
    for _ in range(12):
        q, qd, forces = env.q.clone(), env.qd.clone(), []
        for _ in range(4):
            torque = (100.0 * (target + 0.5 - q[:, 7:])).clamp(-limits, limits)
            q, qd = dyn.step(q, qd, torch.cat([torch.zeros(4, 6), torque], dim=1), dt=5e-3, report=report)
            forces.append(report.contact_f[..., 2].clone())
        observed = env.step(torch.ones(4, JOINTS))[0]["actor"]
        bound += int((torque.abs() == limits).sum())
        assert torch.allclose(observed[:, :5], torch.stack(forces).mean(dim=0), rtol=1e-5, atol=1e-3)
    assert bound > 10


def test_gradients_of_a_motion_by_networks():
    """Through three substeps of Dynamics.step: targets and start beside differences."""
    network = ActuatorNetwork(
        [each.weight.detach().numpy() for each in module() if hasattr(each, "weight")],
        [each.bias.detach().numpy() for each in module() if hasattr(each, "bias")],
        torque_scale=20.0,
    )  # fmt: skip
    links = [spo.Body(1.0, com=(0, 0, -0.2), inertia=0.02 * np.eye(3)) for _ in range(2)]
    hinges = [spo.Hinge("revolute", i - 1, i, axis=(0, 1, 0), parent_pose=(0, 0, -0.4 * i, 0, 0, 0, 1)) for i in (0, 1)]
    dyn = spo.Dynamics(spo.Scene(links, hinges), 2, "cpu", "float64")

    def motion(q, qd, target):
        past = []
        for _ in range(3):
            past = [(target - q, qd), *past]
            seen = [past[lag] if lag < len(past) else tuple(map(torch.zeros_like, past[0])) for lag in (0, 1, 2)]
            errors, rates = (torch.stack([each[i] for each in seen], dim=-1) for i in (0, 1))
            q, qd = dyn.step(q, qd, network.torque(errors, rates), dt=0.01)
        return q, qd

    torch.manual_seed(2)
    given = [torch.randn(2, 2, dtype=torch.float64, requires_grad=True) for _ in range(3)]
    assert torch.autograd.gradcheck(motion, given, eps=1e-6, atol=1e-6, rtol=1e-5)


def test_histories_are_part_of_the_state(tmp_path):
    network = ActuatorNetwork.from_torchscript(
        saved(module(), tmp_path / "net.pt"), input_idx=(0, 3, 6), torque_scale=20.0
    )
    first, second = walker(network), walker(network)
    torch.manual_seed(0)
    for _ in range(3):
        first.step(torch.randn(4, JOINTS))
    second.load_state_dict(first.state_dict())
    given = torch.randn(4, JOINTS)
    assert torch.equal(first.step(given)[0]["actor"], second.step(given)[0]["actor"])


def test_what_is_refused(tmp_path):
    one = [np.ones((1, 6))], [np.zeros(1)]
    for make, words in (
        (lambda: ActuatorNetwork(*one, input_idx=(0,)), r"expected \(1, 2\) \[out, in\]"),
        (lambda: ActuatorNetwork(*one, "selu"), "expected one of identity, relu"),
        (lambda: ActuatorNetwork([np.full((1, 6), np.nan)], one[1]), "NaN"),
        (lambda: ActuatorNetwork.from_torchscript(__file__), "is no TorchScript file"),
        (lambda: ActuatorNetwork.from_torchscript(saved(torch.nn.GRU(2, 1), tmp_path / "gru.pt")), "expected Linear"),
        (lambda: ActuatorNetwork.from_torchscript(saved(Doubled(), tmp_path / "d.pt")), "computes something else"),
        (lambda: walker(None, actions=actions.ActuatorNet(ActuatorNetwork(*one), "nobody")),
         "matches no joint"),
        (lambda: walker(None, actions=[actions.Effort("joint_[12]"), actions.ActuatorNet(ActuatorNetwork(*one))]),
         "actions.Effort and actions.ActuatorNet both set the force of joint 'joint_1'"),
        (lambda: walker(None, actions=[actions.ActuatorNet(ActuatorNetwork(*one), "joint_2"), actions.Effort()]),
         "actions.ActuatorNet and actions.Effort both set the force of joint 'joint_2'"),
    ):  # fmt: skip
        with pytest.raises((ValueError, TypeError), match=words):
            make()


class Doubled(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = torch.nn.Linear(6, 1)

    def forward(self, x):
        return 2.0 * self.layer(x)
