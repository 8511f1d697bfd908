"""Exported policies: what their files say, and how they act in MuJoCo."""

import inspect
import json

import mujoco
import numpy as np
import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("rsl_rl")

import warp_spo as spo  # noqa: E402
from warp_spo import env as envs  # noqa: E402
from warp_spo.env import export, learning, recording, robots  # noqa: E402
from warp_spo.env.tasks import task, velocity  # noqa: E402


def test_exports_act_as_the_policy(tmp_path):
    """ONNX and TorchScript give the actions of the policy, and their metadata the controls of the environment."""
    onnx = pytest.importorskip("onnx")
    from onnx.reference import ReferenceEvaluator

    env = envs.make("cartpole", 16, "cpu")
    runner = learning.make_runner(env, task("cartpole").LEARNER)
    files = export.save(runner, env, "cartpole", tmp_path / "policy")
    observed = torch.randn(16, 5)
    wanted = runner.alg.get_policy().as_jit()(observed).detach()
    model = onnx.load(str(files[0]))
    found = ReferenceEvaluator(model).run(None, {"obs": observed.numpy()})[0]
    extra = {"metadata.json": ""}
    script = torch.jit.load(str(files[1]), _extra_files=extra)
    assert np.allclose(found, wanted, atol=1e-5) and torch.allclose(script(observed), wanted, atol=1e-6)
    metadata = json.loads(extra["metadata.json"])
    assert {each.key: json.loads(each.value) for each in model.metadata_props} == metadata
    assert metadata["joints"] == ["slide", "hinge"] and metadata["actuators"] == ["slide"]
    assert metadata["default_position"] == [0.0, np.pi]
    assert np.allclose([metadata["action_scale"], metadata["action_offset"]], [[1.0], [0.0]], atol=1e-6)
    assert metadata["action_clip"] == [[-1.0, 1.0]]
    assert metadata["observations"] == [["unnamed", 1, 1.0], ["angle", 2, 1.0], ["joint velocity", 2, 0.3]]
    assert metadata["action_kind"] == ["ctrl"] and metadata["default_base"] is None
    assert [name for name, _, _ in env.observation_terms["actor"]] == ["unnamed", "angle", "joint velocity"]


def test_terms_are_named_after_their_functions():
    """Also those that another function made, and those in torch."""
    obs, named = envs.observations, lambda term: envs.observations.name_of(envs.Observation(term))

    def my_own_term(w):
        return w.q

    terms = (obs.base_velocity, obs.joint_position(), obs.height_scan(), my_own_term, task("g1-flat").PHASE)
    assert [named(term) for term in terms] == [
        "base velocity", "joint position", "height scan", "my own term", "step phase",
    ]  # fmt: skip
    assert named(lambda w: w.q) == "unnamed" and named(envs.TorchTerm(lambda env: env.q, 2, "mine")) == "mine"
    assert [named(term) for _, term, *_ in task("g1-flat").ACTOR] == [name for name, *_ in task("g1-flat").ACTOR]


def legged() -> envs.Env:
    """A robot of our own: a trunk on four legs of a hip, whose drives hold it up."""
    bodies = [spo.Body(6.0, inertia=0.1 * np.eye(3), label="trunk")]
    hinges = [spo.Hinge("free", -1, 0, label="base")]
    contacts = []
    for x, y in ((0.3, 0.2), (0.3, -0.2), (-0.3, 0.2), (-0.3, -0.2)):
        body = len(bodies)
        bodies.append(spo.Body(0.5, com=(0, 0, -0.15), inertia=0.005 * np.eye(3), label=f"leg {body}"))
        drive = dict(target_ke=200.0, target_kd=5.0, armature=0.01, effort_limit=100.0)
        place = dict(axis=(0, 1, 0), parent_pose=(x, y, 0, 0, 0, 0, 1), label=f"robot/hip {body}")
        hinges.append(spo.Hinge("revolute", 0, body, **place, **drive))
        contacts.append(spo.Contact(body, sphere=((0, 0, -0.3), 0.03), label=f"foot {body}"))
    obs = envs.observations
    seen = [obs.base_velocity, obs.projected_gravity, obs.joint_position(), obs.last_action, obs.command]
    return envs.Env(
        spo.Scene(bodies, hinges, contacts=contacts), 2, "cpu", 
        default_q=[0, 0, 0.33, 0, 0, 0, 1, 0.1, 0.1, -0.1, -0.1],
        actions=envs.actions.Position(scale=0.5), commands=envs.commands.Velocity(forward=(-1, 1), seconds=(1.0, 2.0)),
        observations={"actor": [*seen[:-1], envs.Observation(seen[-1], scale=2.0, clip=(-1.0, 1.0))]},
        rewards={"still": (1.0, lambda w: -w.qd[0] ** 2)},
    )  # fmt: skip


MJCF = """
<mujoco><worldbody><body name="trunk"><inertial pos="0 0 0" mass="6" diaginertia=".1 .1 .1"/>
{legs}</body></worldbody></mujoco>
"""
LEG = """
<body pos="{x} {y} 0"><joint name="hip {n}" axis="0 1 0"/>
<inertial pos="0 0 -.15" mass=".5" diaginertia=".005 .005 .005"/>
<geom type="sphere" size=".03" pos="0 0 -.3" contype="0" conaffinity="1"/></body>
"""


@pytest.mark.slow
def test_a_robot_of_ones_own_moves_in_mujoco_as_here(tmp_path):
    """From a file without free joint, servos, armature and keyframe, which the metadata add."""
    from warp_spo.mujoco import deployment

    env = legged()
    runner = learning.make_runner(env, learning.Learner(steps=8, hidden=(8,)))
    file, _ = export.save(runner, env, "own", tmp_path / "policy")
    places = [(0.3, 0.2), (0.3, -0.2), (-0.3, 0.2), (-0.3, -0.2)]
    legs = "".join(LEG.format(x=x, y=y, n=n) for n, (x, y) in enumerate(places, 1))
    there = deployment.Deployment(file, mujoco.MjSpec.from_string(MJCF.format(legs=legs)), 1)
    assert there.model.nq == 11 and there.model.nu == 4 and there.model.dof_armature[6] == 0.01
    assert there.metadata["observations"][3:] == [["last action", 4, 1.0], ["command", 3, 2.0]]
    there.commands[:] = [[0.9, 0.1, -0.2]]
    assert np.allclose(there.observe()[0, -3:], [1.0, 0.2, -0.4])  # scaled, then clipped
    pushes = [0.3, -0.2, 0.1, -0.3]
    there.network = lambda observed: np.array([pushes], np.float32)
    there.data[0].qpos[there.joint_q], there.data[0].qpos[2] = env.default_q[7:], 0.33  # not at random
    for _ in range(100):
        there.step()
    ours = recording.record(env, lambda observed: torch.tensor([pushes, pushes]), 2.0)
    assert np.allclose(there.data[0].qpos[there.joint_q], ours.q[-1, 7:], atol=0.02)  # rad; contacts differ
    assert abs(there.data[0].qpos[2] - ours.q[-1, 2]) < 0.01 and not there.fallen.any()
    with pytest.raises(ValueError, match="the robot has no 'robot/hip 1'; it has"):
        deployment.Deployment(file, mujoco.MjSpec.from_string(MJCF.format(legs="")), 1)


@pytest.mark.slow
def test_a_film_of_a_robot_of_ones_own(tmp_path):
    """Bones and feet are in the picture, of a robot that no task knows."""
    from PIL import Image

    still, path = (lambda observed: torch.zeros(2, 4)), tmp_path / "walk"
    files = recording.play(legged(), still, path, 1.0, (0, 0, 0))
    assert [file.name for file in files] == ["walk.gif", "walk.png"]
    with Image.open(files[0]) as film, Image.open(files[1]) as strip:
        assert film.n_frames == 25 and strip.size[0] == 5 * 480
        shown = np.asarray(strip.convert("RGB")).astype(int)
    blue = (shown[..., 2] > shown[..., 0] + 50).mean()
    assert 1e-4 < blue < 0.1  # feet
    with pytest.raises(ValueError, match=r"recording.play: command has 1 number\(s\); expected 3"):
        recording.play(legged(), None, tmp_path / "walk", 1.0, (0,))


@pytest.mark.slow
def test_an_action_that_moves_a_follower_is_exported_as_its_own_joint():
    """Offset, scale and gains are those of the joint that the action is named after."""

    class Gripper(envs.actions.Position):
        def trace(self, w, action):
            ((entry, target),) = super().trace(w, action)
            return [(0, -2.0 * target), (entry, target)]

    body, axis = spo.Body(1.0, inertia=0.01 * np.eye(3)), (1, 0, 0)
    names = enumerate(("right", "left"))
    hinges = [spo.Hinge("prismatic", -1, k, axis=axis, label=name, target_ke=k + 1.0) for k, name in names]
    env = envs.Env(
        spo.Scene([body, body], hinges), 2, "cpu", actions=Gripper("left", scale=0.5, offset=0.1), rewards={},
        observations={"actor": [lambda w: w.q]},
    )  # fmt: skip
    found = export.describe(env, "gripper")
    assert np.allclose([found["action_scale"], found["action_offset"], found["stiffness"]], [[0.5], [0.1], [2.0]])


def test_shapes_are_where_joints_and_contacts_are():
    """A capsule's ends are the joints, whichever way it points; a box is about the corners."""
    from warp_spo.reference.rotations import rotation
    from warp_spo.viewing import shapes

    for end in np.vstack([np.eye(3), -np.eye(3), np.random.default_rng(0).normal(size=(4, 3))]):
        start = np.array([0.1, -0.2, 0.3])
        _, _, (_, half), pose, _ = shapes.capsule(0, start, end, 0.02, shapes.BODY)
        axis = rotation(np.array(pose[3:])) @ [0, 0, half]
        assert np.allclose([pose[:3] - axis, pose[:3] + axis], [start, end])
    scene = spo.Scene(
        [spo.Body(1.0, inertia=np.eye(3))], [spo.Hinge("free", -1, 0)],
        contacts=[spo.Contact(0, box=((0.1, 0.2, 0.3), (0.5, 0, 0, 0, 0, 0, 1)))],
    )  # fmt: skip
    box, bone = shapes.primitives(scene, scene.neutral_q)
    assert bone.kind == "capsule"
    assert box.kind == "box" and np.allclose(box.size, (0.1, 0.2, 0.3)) and np.allclose(box.pose[:3], (0.5, 0, 0))


@pytest.mark.slow
def test_go2_stands_in_mujoco(tmp_path):
    """A policy of zeros holds the default pose there: controls, joint order and metadata agree."""
    from warp_spo.mujoco import deployment

    env = envs.make("go2-flat", 2, "cpu")
    runner = learning.make_runner(env, task("go2-flat").LEARNER)
    with torch.no_grad():
        for parameter in runner.alg.get_policy().mlp[-1].parameters():
            parameter.zero_()
    file, _ = export.save(runner, env, "go2-flat", tmp_path / "go2")
    robots_there = deployment.Deployment(file, robots.FILES / "go2.xml", 4)
    found = deployment.trial(robots_there, seconds=2.0, period=10.0)
    assert found["standing"] == 4
    for data in robots_there.data:
        assert data.qpos[2] > 0.25 and np.abs(data.qpos[robots_there.joint_q] - env.default_q[7:]).max() < 0.3
    bare = deployment.mujoco.MjSpec.from_file(str(robots.FILES / "go2.xml"))
    for each in list(bare.keys) + list(bare.actuators):  # a keyframe has controls
        bare.delete(each)
    with pytest.raises(ValueError, match="the robot has no actuator 'FL_hip', which the policy controls; it has none"):
        deployment.Deployment(file, bare, 1)
    ours = recording.record(env, lambda observed: torch.zeros(2, 12), 2.0)
    assert np.allclose(ours.q[-1, 7:], robots_there.data[0].qpos[7:], atol=0.1)


@pytest.mark.slow
def test_exported_offsets_have_no_bias_of_an_encoder():
    """Nor does a clip change scales, also one without zero: the numbers are those that the actions were given."""
    bodies = [spo.Body(1.0, inertia=0.01 * np.eye(3)) for _ in range(2)]
    drive = dict(target_ke=10.0, target_kd=1.0, axis=(0, 1, 0))
    hinges = [spo.Hinge("prismatic", -1, 0, label="slide", **drive), spo.Hinge("revolute", 0, 1, label="arm", **drive)]
    for clip in (None, (-0.1, 0.1), (0.6, 1.0)):
        env = envs.Env(
            spo.Scene(bodies, hinges), 2, "cpu", default_q=[0.3, -0.4], events=[envs.events.encoder_bias(0.1)],
            actions=[envs.actions.Position("slide", scale=2.0, clip=clip), envs.actions.Position("arm", scale=0.5)],
            observations={"actor": [lambda w: w.encoder_q()]}, rewards={"still": (1.0, lambda w: -w.qd[0] ** 2)},
        )  # fmt: skip
        bias = env.memory("encoder bias").clone()
        found = export.describe(env, "two")
        assert np.allclose(found["action_scale"], [2.0, 0.5], rtol=1e-6)
        assert np.allclose(found["action_offset"], [0.3, -0.4], atol=1e-6)
        assert found["action_clip"] == [clip, None]
        assert torch.equal(env.memory("encoder bias"), bias) and bias.abs().min() > 1e-3


@pytest.mark.slow
def test_controls_in_mujoco_are_as_late_as_the_file_says(monkeypatch, tmp_path):
    """By more steps than a policy's step has, too; and clipped."""
    onnx = pytest.importorskip("onnx")
    from warp_spo.mujoco import deployment

    env = envs.make("go2-flat", 2, "cpu")
    file, _ = export.save(learning.make_runner(env, task("go2-flat").LEARNER), env, "go2-flat", tmp_path / "go2")
    model, delays = onnx.load(str(file)), [0, 3, 4, 9] * 3
    props = {each.key: each.value for each in model.metadata_props}
    props |= {"delay_steps": json.dumps(delays), "action_clip": json.dumps([[-1.0, 2.5], None, None, None] * 3)}
    onnx.helper.set_model_props(model, props)
    onnx.save(model, str(file))
    there, seen = deployment.Deployment(file, robots.FILES / "go2.xml", 1), []
    monkeypatch.setattr(deployment.mujoco, "mj_step", lambda _, data: seen.append(data.ctrl[there.actuators].copy()))
    scale, offset = there.numbers["action_scale"], there.numbers["action_offset"]
    for step in range(1, 7):
        there.network = lambda observed, step=step: np.full((1, 12), step, np.float32)
        there.step()
    for substep, found in enumerate(seen):
        acts = np.array([max(0, 1 + (substep - late) // env.decimation) for late in delays])  # the step's number
        acts = np.where(np.arange(12) % 4 == 0, np.minimum(acts, 2.5), acts)
        assert np.allclose(found, offset + scale * acts), substep


@pytest.mark.slow
def test_the_clock_of_steps_stands_in_mujoco_while_the_command_does(tmp_path):
    """From the same command on as in the tasks."""
    from warp_spo.mujoco import deployment

    env = envs.make("go2-flat", 2, "cpu")
    file, _ = export.save(learning.make_runner(env, task("go2-flat").LEARNER), env, "go2-flat", tmp_path / "go2")
    there = deployment.Deployment(file, robots.FILES / "go2.xml", 3)
    there.metadata |= {"observations": [["step phase", 2, 1.0]], "observation_clip": [None], "stride": 0.8}
    there.time, there.commands = 0.2, np.array([[0.02, 0.0, -0.02], [0.0, 0.04, 0.02], [0.0, 0.0, 0.0]])
    least = inspect.signature(velocity.step_phase).parameters["least_command"].default
    assert deployment.LEAST_COMMAND == least and np.allclose(there.observe(), [[0, 0], [1, 0], [0, 0]], atol=1e-6)
