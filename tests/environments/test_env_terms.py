"""Ready rewards and terminations beside NumPy, on states in which feet land, slip and lift."""

import numpy as np
import pytest
import torch

import warp_spo as spo
from support.env_scenes import FEET, cart_env, cart_scene, walker_env, walker_q, walker_scene
from warp_spo.env import Env, Observation, actions, commands, events, observations, rewards, terminations

TERMS = {
    "track velocity": rewards.track_velocity(0.4),
    "track turning": rewards.track_turning(0.4),
    "vertical velocity": rewards.vertical_velocity,
    "tilting": rewards.tilting,
    "tilt": rewards.tilt,
    "base height": rewards.base_height(0.3),
    "action rate": rewards.action_rate,
    "action size": rewards.action_size,
    "joint deviation": rewards.joint_deviation(),
    "posture": rewards.posture({"joint_[1357]": 0.2, "joint_[2468]": 0.4}),
    "joint velocity": rewards.joint_velocity(),
    "torque": rewards.torque,
    "power": rewards.power,
    "air time": rewards.air_time(FEET, 0.04),
    "foot slip": rewards.foot_slip(FEET),
    "foot clearance": rewards.foot_clearance(FEET, 0.05),
    "landing force": rewards.landing_force(FEET),
    "touching": rewards.touching(FEET),
    "joint limits": rewards.joint_limits(0.5),
    "last air time": lambda w: w.feet(FEET).last_air_time.sum(),
}
LOW, HIGH = -1.4, 1.0  # limits of all joints


def matrices(quaternions):
    """Return rotation matrices of quaternions, xyzw."""
    x, y, z, w = np.moveaxis(quaternions, -1, 0)
    zero = np.zeros_like(x)
    across = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    return np.eye(3) + 2.0 * w[..., None, None] * across + 2.0 * across @ across


@pytest.mark.slow
def test_ready_rewards():
    limits = {"joint_limit_lower": np.r_[[-1e10] * 6, [LOW] * 8], "joint_limit_upper": np.r_[[1e10] * 6, [HIGH] * 8]}
    env = walker_env(
        8,
        scene=walker_scene(delay=0).with_values(**limits),
        observations={"a": list(TERMS.values()), "frame": [lambda w: w.frame("trunk").velocity]},
        rewards={},
        events=[],
        terminations={},
        commands=commands.Velocity(),
    )
    limited = walker_q()[7:]
    actions = [torch.zeros(8, 8), torch.zeros(8, 8)]
    air, contact, last = np.zeros((8, 4)), np.zeros((8, 4)), np.zeros((8, 4))
    landed = slipped = beyond = 0
    for step in range(60):
        given = 1.5 * torch.sin(torch.arange(64.0).view(8, 8) + 0.35 * step)
        observed, _, _, _ = env.step(given)
        actions = [actions[1], given]
        q, qd = env.q.double().numpy(), env.qd.double().numpy()
        turn = matrices(q[:, 3:7])
        back = lambda v: np.einsum("wji,wj->wi", turn, v)  # noqa: B023, E731
        v, omega, command = back(observed["frame"].double().numpy()), back(qd[:, 3:6]), env.command.double().numpy()
        gravity = back(np.tile([0.0, 0.0, -1.0], (8, 1)))
        force, gap, slip = (env._tensors[f"contact_{name}"].double().numpy()[:, :4] for name in ("f", "gap", "slip"))
        size = np.linalg.norm(force, axis=-1)
        touches = size > 1.0
        lands = touches & (contact == 0.0)
        last = np.where(lands, air, last)
        air, contact = np.where(touches, 0.0, air + 0.02), np.where(touches, contact + 0.02, 0.0)
        moves = np.hypot(command[:, 0], command[:, 1]) + abs(command[:, 2])
        torques = env.dyn.actuator_force(env.q, env.qd, env._controls["ctrl"]).double().numpy()
        away = q[:, 7:] - limited
        wide = np.array([0.2, 0.4] * 4)
        new, old = (each.double().numpy() for each in actions[::-1])
        expected = {
            "track velocity": np.exp(-((command[:, :2] - v[:, :2]) ** 2).sum(1) / 0.16),
            "track turning": np.exp(-((command[:, 2] - omega[:, 2]) ** 2) / 0.16),
            "vertical velocity": v[:, 2] ** 2,
            "tilting": (omega[:, :2] ** 2).sum(1),
            "tilt": (gravity[:, :2] ** 2).sum(1),
            "base height": (q[:, 2] - 0.3) ** 2,
            "action rate": ((new - old) ** 2).sum(1),
            "action size": (new**2).sum(1),
            "joint deviation": (away**2).sum(1),
            "posture": np.exp(-((away / wide) ** 2).mean(1)),
            "joint velocity": (qd[:, 6:] ** 2).sum(1),
            "torque": (torques**2).sum(1),
            "power": abs(torques * qd).sum(1),
            "air time": np.where(moves > 0.1, (lands * (last - 0.04)).sum(1), 0.0),
            "foot slip": (touches * slip**2).sum(1),
            "foot clearance": np.where(moves > 0.05, (abs(gap - 0.05) * slip).sum(1), 0.0),
            "landing force": (lands * size).sum(1),
            "touching": touches.sum(1),
            "joint limits": np.maximum(abs(q[:, 7:] - 0.5 * (LOW + HIGH)) - 0.25 * (HIGH - LOW), 0.0).sum(1),
            "last air time": last.sum(1),
        }
        for i, (name, values) in enumerate(expected.items()):
            found = observed["a"][:, i].double().numpy()
            assert np.allclose(found, values, rtol=1e-4, atol=1e-4 * (1 + abs(values).max())), f"step {step}: {name}"
        landed, slipped = landed + lands.sum(), slipped + (touches & (slip > 0.05)).sum()
        beyond += (expected["joint limits"] > 0).sum()
    assert list(expected) == list(TERMS) and landed > 20 and slipped > 20 and beyond > 20


@pytest.mark.slow
def test_ready_observations():
    """Places of frames, and of feet over the ground, beside those of the dynamics."""
    terms = [observations.frame_position("shank1"), observations.feet_height(FEET), observations.feet_force(FEET)]
    terms.append(observations.feet_contact(FEET, 20.0))
    env, touches = walker_env(4, observations={"a": terms}, events=[], rewards={}, terminations={}), []
    for step in range(20):
        observed, _, _, _ = env.step(torch.sin(torch.arange(32.0).view(4, 8) + step))
        found = observed["a"].numpy()
        place = env.dyn.frame_poses(env.q, [env.scene.body_labels.index("shank1")])[:, 0, :3].numpy()
        assert np.allclose(found[:, :3], place, atol=1e-5)
        assert np.allclose(found[:, 3:7], env._tensors["contact_gap"][:, :4].numpy(), atol=1e-6)
        force = env._tensors["contact_f"][:, :4].numpy()
        assert np.allclose(found[:, 7:19], force.reshape(4, 12), atol=1e-4)
        touches.append(found[:, 19:] == 1.0)
        assert np.array_equal(touches[-1], np.linalg.norm(force, axis=-1) > 20.0)
    assert np.ptp(found[:, 3:7]) > 1e-3 and place.std() > 1e-2 and 10 < np.sum(touches) < 310


@pytest.mark.slow
def test_ready_terminations():
    ends = {
        "tilted": terminations.tilted(0.5),
        "below": terminations.below(0.2),
        "touching": terminations.touching("trunk", 1.0),
    }
    env = walker_env(4, terminations=ends, events=[], rewards={}, observations={"a": [observations.projected_gravity]})
    env.q[1, 3:7] = torch.tensor([np.sin(0.3), 0.0, 0.0, np.cos(0.3)])
    env.q[2:, 7:] = torch.tensor([-1.5, 0.0] * 4)  # legs forward: one is in the air, one lies on its belly
    env.q[2:, 2] = torch.tensor([0.15, 0.04])
    _, _, done, extras = env.step(torch.zeros(4, 8))
    assert done.tolist() == [0, 1, 1, 1] and not extras["time_outs"].any()
    told = torch.stack([env.memory(f"last end {name}")[:, 0] for name in ends], dim=1)
    assert told[1:].tolist() == [[1, 0, 0], [0, 1, 0], [0, 1, 1]]


def cubes():
    """A slider that pushes a cube over the ground."""
    solid = dict(inertia=0.01 * np.eye(3))
    box = lambda body, **more: spo.Contact(body, box=(0.1, 0.1, 0.1), **more)  # noqa: E731
    return spo.Scene(
        [spo.Body(1.0, label="pusher", **solid), spo.Body(2.0, label="cube", **solid)],
        [spo.Hinge("prismatic", -1, 0, axis=(1, 0, 0), parent_pose=(-0.199, 0, 0.1, 0, 0, 0, 1), label="slide"),
         spo.Hinge("free", -1, 1)],
        contacts=[box(1), box(0, other=box(1), stiffness=1e4, damping=50.0)],
    )  # fmt: skip


@pytest.mark.slow
def test_bodies_that_touch_each_other_are_seen_and_changed():
    """Contact arrays have a row for each pair after those of points, four a box; events change their friction, too."""
    options = dict(
        decimation=1, default_q=[0.0, 0.0, 0.0, 0.0995, 0.0, 0.0, 0.0, 1.0],
        actions=actions.Effort("slide", scale=10.0), rewards={"none": (1.0, lambda w: 0.0)},
        observations={"force": [lambda w: w.contact_force.ravel()], "gap": [lambda w: w.contact_gap],
                      "slip": [lambda w: w.contact_slip]},
    )  # fmt: skip
    scene = cubes()
    drawn = events.randomise("contact_friction", (0.1, 0.2), "set")
    env = Env(scene, 3, "cpu", events=[drawn], **options)
    friction = env.values["contact_friction"]
    assert friction.shape == (3, 5) and (friction >= 0.1).all() and (friction <= 0.2).all()
    dyn = spo.Dynamics(scene, 3, "cpu", "float32", variable=("contact_friction",))
    dyn.set(contact_friction=friction.clone())
    q, qd = env.q.clone(), env.qd.clone()
    observed, *_ = env.step(torch.tensor([[-1.0], [0.5], [1.0]]))
    found = dyn.step_report("contact_f", "contact_gap", "contact_slip", like=q)
    tau = torch.zeros(3, 7)
    tau[:, 0] = torch.tensor([-10.0, 5.0, 10.0])
    dyn.step(q, qd, tau, env.dt, report=found)
    for name, array in zip(("force", "gap", "slip"), found.values(), strict=True):
        np.testing.assert_allclose(observed[name].numpy(), array.flatten(1).numpy(), rtol=1e-4, atol=1e-3)
    assert (observed["force"][1:, 12] < -0.1).all()  # on the pusher
    alone = Env(scene, 3, "cpu", events=[events.randomise("contact_friction", (0.1, 0.2), "set", "pusher")], **options)
    friction = alone.values["contact_friction"]
    assert (friction[:, :4] == 0.8).all() and (friction[:, 4] < 0.3).all()
    with pytest.raises(ValueError, match=r"events.randomise: no contact is of a body 'pusher'"):
        bare = scene.with_contacts(scene.contacts[:1])
        Env(bare, 3, "cpu", events=[events.randomise("contact_friction", (0.1, 0.2), "set", "pusher")], **options)


def limited_cart():
    """A cart of 1 kg that a motor and an effort action may push with 2 N, and its pole."""
    scene = cart_scene()
    scene = spo.Scene(scene.bodies, scene.hinges, gravity=(0, 0, 0), actuators=[spo.Actuator(0)])
    return scene.with_values(joint_effort_limit=[2.0, 1e6])


@pytest.mark.parametrize("action", [actions.Effort("slide", scale=50.0), actions.Control(scale=50.0)], ids=str)
def test_actions_obey_the_effort_limit(action):
    """A push of 50 N is one of the limit, also where an event draws it, as MuJoCo's motors have it; small ones stay."""
    drawn = events.randomise("joint_effort_limit", (1.0, 3.0), "set", "slide")
    for change in ([], [drawn]):
        env = Env(
            limited_cart(), 3, "cpu", actions=action, decimation=1, events=change,
            observations={"actor": [lambda w: w.joint_force, lambda w: w.qd]}, rewards={"none": (1.0, lambda w: 0.0)},
        )  # fmt: skip
        limits = env.values["joint_effort_limit"][:, 0].numpy() if change else np.full(3, 2.0)
        observed = env.step(torch.tensor([[1.0], [-1.0], [0.01]]))[0]["actor"].numpy()
        expected = np.clip([50.0, -50.0, 0.5], -limits, limits)
        np.testing.assert_allclose(observed[:, 0], expected, rtol=1e-6)
        M = spo.Dynamics(limited_cart(), 1, "cpu", "float64").mass_matrix(np.zeros((1, 2)))[0]
        np.testing.assert_allclose(observed[:, 2], env.dt * expected * np.linalg.inv(M)[0, 0], rtol=1e-3)


def test_a_shared_effort_limit_leaves_no_force_of_each():
    """The step bounds the sum of a drive and an actuator, so that the force of each alone is refused."""
    scene = limited_cart().with_values(joint_target_ke=[10.0, 0.0])
    with pytest.raises(ValueError, match=r"World.joint_force: joint 'slide' has a drive and an actuator that share"):
        cart_env(
            2, actions=[actions.Position("slide"), actions.Control()], scene=scene,
            observations={"actor": [lambda w: w.joint_force]},
        )  # fmt: skip


def test_exported_scales_are_those_below_the_effort_limit():
    """Scale and offset are measured; a push of half an action is beyond the limit."""
    export = pytest.importorskip("warp_spo.env.export")
    env = cart_env(2, actions=actions.Effort("slide", scale=5000.0, offset=0.5), scene=limited_cart())
    scale, offset, gains = export.controls_of(env)
    np.testing.assert_allclose([*scale, *offset], [5000.0, 0.5], rtol=1e-3)
    assert gains["force_limit"] == [2.0]
    scale, offset, gains = export.controls_of(cart_env(2, actions=actions.Control(), scene=limited_cart()))
    assert (scale, offset, gains["force_limit"]) == (1.0, 0.0, [2.0])


@pytest.mark.parametrize("when", ["start", "reset"])
def test_values_that_are_written_count_for_terms_and_dynamics(when):
    """Written by an index or whole, they act in the next step, as in dynamics of a scene that has them."""
    env = cart_env(
        3, scene=cart_scene(), rewards={}, terminations={}, observations={"a": [lambda w: w.value("joint_damping")[0]]},
        events=[events.randomise("joint_damping", (1.0, 1.0), how="set", names="slide", when=when),
                events.joints(velocity=(1.0, 1.0))],
    )  # fmt: skip
    for step, damping in enumerate((1.0, 8.0, 30.0)):
        both = np.array([damping, 0.0 if step < 2 else damping])
        if step == 1:
            env.values["joint_damping"][1:, 0] = damping
        elif step == 2:
            env.values["joint_damping"] = torch.full((3, 2), damping)
        twin = spo.Dynamics(env.scene.with_values(joint_damping=both), 3, "cpu", "float64")
        q, qd = env.q.double().numpy().copy(), env.qd.double().numpy().copy()
        twin.step(q, qd, dt=env.dt, options=spo.StepOptions(substeps=env.decimation), out=(q, qd))
        observed, *_ = env.step(torch.zeros(3, env.num_actions))
        assert observed["a"][2, 0] == damping
        np.testing.assert_allclose(env.qd[2].numpy(), qd[2], rtol=1e-5)
    env.reset()
    assert env.values["joint_damping"][2, 0] == (1.0 if when == "reset" else 30.0)


def test_constants_beyond_float32_are_infinite():
    """As NumPy's float32 has them; a number that reaches a learner ends its world, counted by the term's name."""
    terms = [
        Observation(lambda w: spo.where(w.q[0] > 0.0, 1e40, -w.q[0]), clip=(-2.0, 2.0)),
        Observation(lambda w: np.arctan2(1.0, -1e40 * w.q[1]), clip=(-9.0, 9.0)),
        lambda w: 1.0 / (spo.where(w.q[1] > 0.0, -3.5e38, 1e300)),
    ]
    env = cart_env(16, observations={"a": terms}, rewards={"huge": (1.0, lambda w: 3.5e38)}, terminations={})
    q = env.q.numpy()
    with np.errstate(over="ignore"):
        huge = np.float32(1e40)
        wanted = [np.clip(np.where(q[:, 0] > 0.0, huge, -q[:, 0]), -2, 2), np.arctan2(np.float32(1), -huge * q[:, 1])]
    observed = env.get_observations()["a"].numpy()
    np.testing.assert_allclose(observed.T, [*wanted, np.zeros(16)], rtol=1e-6)
    assert env.step(torch.zeros(16, 1))[2].all()
    (name,) = (name for name, count in env.log().items() if "reward/huge" in name and float(count))
    assert "not finite" in name or "beyond" in name
