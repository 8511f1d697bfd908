"""Policies of strangers: a torn or hostile ONNX file is refused by an error that names it, before it acts."""

import json

import numpy as np
import pytest

from warp_spo.env import robots

onnx = pytest.importorskip("onnx")
deployment = pytest.importorskip("warp_spo.mujoco.deployment")

JOINTS = [f"{leg}_{part}_joint" for leg in ("FL", "FR", "RL", "RR") for part in ("hip", "thigh", "calf")]
METADATA = {
    "task": "walk", "dt": 0.005, "decimation": 4, "stride": None, "default_base": [0, 0, 0.3, 0, 0, 0, 1],
    "joints": JOINTS, "actuators": JOINTS, "observations": [["joint position", 12, 1.0]], "observation_history": [1],
    **dict.fromkeys(("default_position", "action_offset", "stiffness", "damping", "armature"), [0.0] * 12),
    "action_scale": [1.0] * 12, "delay_steps": [0] * 12, "force_limit": [20.0] * 12, "action_kind": ["target_q"] * 12,
}  # fmt: skip


def policy(weight=None, nodes=None, extra=(), **metadata):
    """Return an ONNX model whose actions are twice its 12 observations, with metadata as of an exported policy."""
    kind, make = onnx.TensorProto.FLOAT, onnx.helper
    weight = make.make_tensor("w", kind, [12, 12], (2.0 * np.eye(12)).ravel()) if weight is None else weight
    nodes = [make.make_node("MatMul", ["obs", "w"], ["y"])] if nodes is None else nodes
    ends = [make.make_tensor_value_info(name, kind, [None, 12]) for name in ("obs", "y")]
    graph = make.make_graph(nodes, "policy", ends[:1], ends[1:], [weight, *extra])
    model = make.make_model(graph, opset_imports=[make.make_opsetid("", 17)])
    make.set_model_props(model, {key: json.dumps(value) for key, value in (METADATA | metadata).items()})
    return model


def deploy(folder, data):
    file = folder / "policy.onnx"
    file.write_bytes(data if isinstance(data, bytes) else data.SerializeToString())
    return deployment.Deployment(file, robots.FILES / "go2.xml", 2)


def refused(folder, data, words):
    with pytest.raises(ValueError, match=words) as error:
        deploy(folder, data)
    message = str(error.value)
    assert message.startswith("Deployment: ") and message.isprintable()
    assert "policy.onnx" in message or "the robot has no" in message
    assert len(message) < 2000


def test_the_policy_is_read_whole(tmp_path):
    there = deploy(tmp_path, policy())
    there.step()
    assert there.last.shape == (2, 12) and there.last.any()


@pytest.mark.parametrize("ranges, low, high", [
    ([[-0.5, 0.1], [0.0, 0.0], [-2.0, 2.0]], [-0.5, 0.0, -0.8], [0.1, 0.0, 0.8]),
    (None, [-0.8] * 3, [0.8] * 3),  # of older files
])  # fmt: skip
def test_trials_ask_for_what_was_trained(tmp_path, ranges, low, high):
    """Commands fill the ranges of the policy's training, as far as they are within 0.8 m/s and 0.8 rad/s."""
    there, asked = deploy(tmp_path, policy(command_ranges=ranges)), []
    there.step = lambda: asked.append(there.commands.copy())
    step = there.metadata["dt"] * there.metadata["decimation"]
    deployment.trial(there, seconds=200 * step, period=step, still=0.0)
    found = np.concatenate(asked)
    assert (found >= low).all() and (found <= high).all()
    np.testing.assert_allclose([found.min(axis=0), found.max(axis=0)], [low, high], atol=0.02)


def test_torn_files(tmp_path):
    whole = policy().SerializeToString()
    for size in (0, 1, 30, len(whole) // 3, len(whole) // 2, len(whole) - 1):
        refused(tmp_path, whole[:size], "expected an ONNX file")
    rng = np.random.default_rng(0)
    for _ in range(30):
        data = bytearray(whole)
        for at in rng.integers(0, len(whole), 3):
            data[at] ^= 1 << int(rng.integers(8))
        try:
            deploy(tmp_path, bytes(data))
        except ValueError as error:
            assert str(error).startswith("Deployment: ") and str(error).isprintable()


@pytest.mark.parametrize("place", ["/etc/hostname", "../secret", "policy.onnx/../../secret"])
def test_weights_outside_of_the_folder_are_not_read(tmp_path, place):
    (tmp_path / "secret").write_bytes(bytes(4 * 144))
    (tmp_path / "policies").mkdir()
    weight = onnx.TensorProto(name="w", data_type=onnx.TensorProto.FLOAT, dims=[12, 12])
    weight.data_location = onnx.TensorProto.EXTERNAL
    for key, value in (("location", place), ("length", str(4 * 144))):
        entry = weight.external_data.add()
        entry.key, entry.value = key, value
    refused(tmp_path / "policies", policy(weight), "cannot be read")


def test_operators(tmp_path):
    make, kind = onnx.helper, onnx.TensorProto
    refused(tmp_path, policy(nodes=[make.make_node("Run", ["obs"], ["y"], domain="else")]), "cannot be read.*else")
    huge = make.make_tensor("s", kind.INT64, [1], [10**13])
    nodes = [make.make_node("ConstantOfShape", ["s"], ["big"]), make.make_node("MatMul", ["big", "w"], ["y"])]
    refused(tmp_path, policy(nodes=nodes, extra=[huge]), r"cannot be evaluated \(.*MemoryError")
    narrow = make.make_tensor("w", kind.FLOAT, [12, 3], np.zeros(36))
    refused(tmp_path, policy(narrow), r"gives actions of shape \(2, 3\)")


@pytest.mark.parametrize(
    "metadata, words",
    [
        (dict(joints="FL"), "'joints'"),
        (dict(actuators=[1] * 12), "'actuators'"),
        (dict(actuators=["tail\n"] * 12), r"has no 'tail\\n'"),
        (dict(action_scale=[1.0] * 3), "12 numbers 'action_scale'"),
        (dict(action_offset=[float("nan")] * 12), "'action_offset'"),
        (dict(action_offset=[10**400] * 12), "'action_offset'"),
        (dict(delay_steps=[10**12] * 12), "'delay_steps'"),
        (dict(decimation=0), "'decimation'"),
        (dict(dt=-1.0), "'dt'"),
        (dict(observations=[["joint position"]]), "'observations'"),
        (dict(command_ranges=[[1.0, -1.0]]), "'command_ranges'"),
        (dict(command_ranges=7), "'command_ranges'"),
    ],
)
def test_metadata(tmp_path, metadata, words):
    refused(tmp_path, policy(**metadata), words)


def test_metadata_that_are_no_json(tmp_path):
    for text in ("{", "[" * 100_000, "\x00\u202e"):
        model = policy()
        model.metadata_props[0].value = text
        refused(tmp_path, model, "cannot be read")
