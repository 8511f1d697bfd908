"""Exported policies: what their files say, and how they act in MuJoCo."""

import inspect
import json

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
    there.metadata |= {"observations": [["step phase", 2, 1.0]], "stride": 0.8}
    there.time, there.commands = 0.2, np.array([[0.02, 0.0, -0.02], [0.0, 0.04, 0.02], [0.0, 0.0, 0.0]])
    least = inspect.signature(velocity.step_phase).parameters["least_command"].default
    assert deployment.LEAST_COMMAND == least and np.allclose(there.observe(), [[0, 0], [1, 0], [0, 0]], atol=1e-6)
