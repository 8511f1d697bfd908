"""Inverse kinematics: targets that can be reached are reached, within the limits, and the error says so."""

from importlib import metadata

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from benchmarks import inverse_kinematics as benchmark
from benchmarks.table import arms, robots
from support import laws, zoo
from support.allocations import no_warp_allocation
from support.mechanisms import MECHANISMS
from warp_spo.dynamics.inverse_kinematics import ANGLE_WEIGHT, starts
from warp_spo.reference.dense import Dense, rotation

WORLDS = 32
FILES = {"panda": "panda_description/urdf/panda.urdf", "ur5": "ur_description/urdf/ur5_robot.urdf"}
ROUNDING = {"float32": 2e-6, "float64": 1e-12}  # [m] of poses of arms of 1 m, with angles weighted


def between(scene, worlds, seed=0):
    """Random configurations within the limits, quaternions of any rotation [world, coordinate]."""
    rng, q = np.random.default_rng(seed), zoo.random_state(scene, worlds, seed)[0]
    for hinge, coord, dof in zip(scene.hinges, scene.q_start, scene.qd_start, strict=False):
        if not hinge.quaternions:
            low, high = (scene.values[f"joint_limit_{s}"][:, dof : dof + hinge.dof_count] for s in ("lower", "upper"))
            share = rng.uniform(size=(worlds, hinge.dof_count))
            bounded = low + share * (high - low)
            q[:, coord : coord + hinge.coord_count] = np.where(high - low < 1e3, bounded, 4.0 * share - 2.0)
    return q


def errors(scene, q, targets, frames, weight=ANGLE_WEIGHT):
    """The documented error of each world, by the dense reference."""
    found = []
    for world in range(len(q)):
        poses = Dense(scene, q[world], world=world).frame_poses(frames)
        parts = []
        for pose, target in zip(poses, targets[world], strict=True):
            relative = rotation(target[3:]).T @ rotation(pose[3:])
            sine = 0.5 * np.linalg.norm([relative[2, 1] - relative[1, 2], relative[0, 2] - relative[2, 0],
                                         relative[1, 0] - relative[0, 1]])  # fmt: skip
            angle = np.arctan2(sine, 0.5 * (np.trace(relative) - 1.0))
            parts += [np.linalg.norm(pose[:3] - target[:3]), weight * angle]
        found.append(max(parts))
    return np.array(found)


@pytest.fixture(scope="module", params=["float32", pytest.param("float64", marks=pytest.mark.slow)])
def arm(request, device):
    """UR5 with limits that differ from world to world, its tool, and targets that it can reach."""
    scene = arms.scene("ur5")
    upper = scene.values["joint_limit_upper"] - np.random.default_rng(1).uniform(0.0, 1.0, (WORLDS, 6))
    scene = scene.with_values(joint_limit_upper=upper)
    frames, q = [(5 + 1, arms.tool("ur5")[1])], between(scene, WORLDS)
    dyn = spo.Dynamics(scene, WORLDS, device=device, dtype=request.param)
    targets = np.array([Dense(scene, q[w], world=w).frame_poses(frames) for w in range(WORLDS)])
    return dyn, frames, q, targets


def test_targets_are_reached_within_the_limits(arm):
    """In ``out`` full of NaN, without allocation once prepared, and to the same bits."""
    dyn, frames, _, targets = arm
    dyn.prepare("inverse_kinematics", frames=frames, seeds=16)
    given = wp.array(targets, dtype=dyn.dtype, device=dyn.device)
    out = tuple(wp.full(shape, np.nan, dtype=dyn.dtype, device=dyn.device) for shape in ((WORLDS, 6), (WORLDS,)))
    with no_warp_allocation():
        assert dyn.inverse_kinematics(given, frames, seeds=16, out=out) == out
    q, said = (array.numpy().astype(np.float64) for array in out)
    assert (said < 1e-3).mean() >= 0.95  # of 4096: 99.9 %
    assert (q >= dyn.scene.values["joint_limit_lower"]).all()  # to the last bit; those that differ are rounded
    assert (q <= dyn.scene.values["joint_limit_upper"].astype(wp.dtype_to_numpy(dyn.dtype))).all()
    rounding = ROUNDING[dyn.dtype.__name__]
    np.testing.assert_allclose(said, errors(dyn.scene, q, targets, frames), atol=rounding, rtol=1e-4)
    assert np.median(said) < rounding
    again = dyn.inverse_kinematics(given, frames, seeds=16)
    np.testing.assert_array_equal(again[0].numpy(), out[0].numpy())


def test_a_graph_repeats_it_for_other_targets(arm):
    dyn, frames, _, targets = arm
    wanted = dyn.inverse_kinematics(targets[::-1].copy(), frames, seeds=3)
    given = wp.array(targets, dtype=dyn.dtype, device=dyn.device)
    out = tuple(wp.empty(shape, dtype=dyn.dtype, device=dyn.device) for shape in ((WORLDS, 6), (WORLDS,)))
    with wp.ScopedCapture(dyn.device) as capture:
        dyn.inverse_kinematics(given, frames, seeds=3, out=out)
    given.assign(targets[::-1].astype(wp.dtype_to_numpy(dyn.dtype)))
    wp.capture_launch(capture.graph)
    for got, right in zip(out, wanted, strict=True):
        np.testing.assert_array_equal(got.numpy(), right)


def test_more_seeds_and_iterations_never_do_worse(arm):
    dyn, frames, _, targets = arm
    few = dyn.inverse_kinematics(targets, frames, seeds=2, iterations=3)[1]
    for more in (dict(seeds=2, iterations=6), dict(seeds=5, iterations=3)):
        assert (dyn.inverse_kinematics(targets, frames, **more)[1] <= few).all()


def test_the_first_seed_starts_where_it_is_told(arm):
    """At the solution nothing moves; out of the limits it is brought inside; without steps it stays."""
    dyn, frames, q, targets = arm
    found, error = dyn.inverse_kinematics(targets, frames, q=q)
    assert error.max() < ROUNDING[dyn.dtype.__name__] and np.abs(found - q).max() < 1e-3
    far, _ = dyn.inverse_kinematics(targets, frames, q=q + 50.0, iterations=0)
    wanted = np.broadcast_to(dyn.scene.values["joint_limit_upper"], q.shape)
    np.testing.assert_allclose(far, wanted, rtol=1e-6)
    start, error = dyn.inverse_kinematics(targets, frames, iterations=0)
    low, high = dyn.scene.values["joint_limit_lower"], dyn.scene.values["joint_limit_upper"]
    np.testing.assert_allclose(start, low + starts(dyn.scene, 1) * (high - low), atol=1e-6)
    np.testing.assert_allclose(error, errors(dyn.scene, start, targets, frames), rtol=1e-4)


def test_a_world_without_a_target_is_lost_alone(arm):
    dyn, frames, _, targets = arm
    clean = dyn.inverse_kinematics(targets, frames, seeds=3)
    broken = targets.copy()
    broken[1, 0, 2] = np.nan
    found = dyn.inverse_kinematics(broken, frames, seeds=3)
    others = np.arange(WORLDS) != 1
    assert np.isnan(found[1][1])
    for got, wanted in zip(found, clean, strict=True):
        np.testing.assert_array_equal(got[others], wanted[others])


def test_floating_bases_balls_and_several_frames(device):
    """Two frames of a floating tree: every kind of hinge moves, and what moves no frame stays."""
    scene = zoo.from_parents([-1, 0, 1, 0, 0], ["free", "ball", "revolute", "prismatic", "revolute"], 21)
    worlds, pose = 8, (0.1, -0.2, 0.3, 0.0, 0.6, 0.0, 0.8)
    frames, q = [(2, pose), 3], between(scene, worlds)
    dyn = spo.Dynamics(scene, worlds, device=device, dtype="float64")
    targets = dyn.frame_poses(q, frames)
    found, error = dyn.inverse_kinematics(targets, frames, seeds=8, iterations=40)
    assert (error < 1e-3).mean() >= 0.75 and np.median(error) < 1e-9
    np.testing.assert_allclose(error, errors(scene, found, targets, frames), atol=1e-12, rtol=1e-9)
    last = int(scene.q_start[scene.hinge_of[4]])
    assert (found[:, last] == scene.neutral_q[last]).all()
    q[:, last] = np.linspace(-1.0, 1.0, worlds)
    q[:, 3:7] *= 1.7
    start, _ = dyn.inverse_kinematics(targets, frames, q=q, iterations=0)
    np.testing.assert_allclose(np.linalg.norm(start[:, 3:7], axis=1), 1.0, atol=1e-15)
    found, error = dyn.inverse_kinematics(targets, frames, q=q, seeds=2)
    np.testing.assert_array_equal(found[:, last], q[:, last])
    assert error.max() < 1e-9


def test_positions_alone(device):
    scene = arms.scene("panda")
    dyn, frame = spo.Dynamics(scene, 8, device=device, dtype="float64"), [arms.tool("panda")]
    targets = dyn.frame_poses(between(scene, 8), frame)
    targets[..., 3:] = [0.5, 0.5, 0.5, 0.5]
    found, error = dyn.inverse_kinematics(targets, frame, seeds=4, angle_weight=0.0)
    for nothing in (0.0, np.nan):  # in place of quaternions
        targets[..., 3:] = nothing
        again = dyn.inverse_kinematics(targets, frame, seeds=4, angle_weight=0.0)
        np.testing.assert_array_equal(again[0], found)
        np.testing.assert_array_equal(again[1], error)
    assert error.max() < 1e-9
    np.testing.assert_allclose(dyn.frame_poses(found, frame)[..., :3], targets[..., :3], atol=1e-9)


def test_bad_input_is_named(device):
    scene = zoo.single_body("ball")
    dyn, targets = spo.Dynamics(scene, 1, device=device), np.zeros((1, 1, 7), dtype=np.float32)
    for wrong in (dict(seeds=0), dict(iterations=1.5), dict(angle_weight=-1.0), dict(angle_weight="much")):
        with pytest.raises(ValueError, match=f"Dynamics.inverse_kinematics: {next(iter(wrong))} is .*expected"):
            dyn.inverse_kinematics(targets, [0], **wrong)
    with pytest.raises(ValueError, match=r"targets is .*expected \(1, 2, 7\) \[world, frame, 7\]"):
        dyn.inverse_kinematics(targets, [0, 0])
    limited = spo.Dynamics(scene.with_values(joint_limit_upper=np.ones(3)), 1, device=device)
    with pytest.raises(spo.UnsupportedError, match=r"limits of the ball hinge"):
        limited.inverse_kinematics(targets, [0])
    closed = spo.Dynamics(MECHANISMS["gripper"](), 1, device=device, loops="embed")
    with pytest.raises(spo.UnsupportedError, match=r"loops='cut'"):
        closed.inverse_kinematics(targets, [0])


def test_starts_cover_the_rotations():
    scene = zoo.single_body("free")
    found = starts(scene, 64)
    np.testing.assert_array_equal(found[:5], starts(scene, 5))
    np.testing.assert_allclose(np.linalg.norm(found[:, 3:], axis=1), 1.0)
    np.testing.assert_allclose(found[:, 3:].T @ found[:, 3:] / 64, np.eye(4) / 4, atol=0.05)
    assert found[:, :3].min() < 0.05 and found[:, :3].max() > 0.95


@pytest.mark.parametrize(("name", "link"), [("panda", "panda_hand_tcp"), ("ur5", "tool0")])
def test_arms_are_those_of_the_files(name, link):
    """Pinocchio reads the released file; the table in the benchmarks gives the same poses and limits."""
    pin = pytest.importorskip("pinocchio")
    try:
        file = metadata.distribution(robots.PACKAGE).locate_file(f"{robots.INSTALLED}/{FILES[name]}")
    except metadata.PackageNotFoundError:
        pytest.skip("needs example-robot-data")
    model = pin.buildModelFromUrdf(str(file))
    scene = arms.scene(name)
    count = scene.dof_count
    data, low, high = model.createData(), model.lowerPositionLimit[:count], model.upperPositionLimit[:count]
    np.testing.assert_allclose([scene.values["joint_limit_lower"][0], scene.values["joint_limit_upper"][0]],
                               [low, high], rtol=1e-6)  # fmt: skip
    q = between(scene, 1)[0]
    pin.framesForwardKinematics(model, data, np.concatenate([q, pin.neutral(model)[count:]]))
    place = pin.SE3ToXYZQUAT(data.oMf[model.getFrameId(link)])
    body, pose = arms.tool(name)
    got = Dense(scene, q).frame_poses([(count, pose)])[0]
    assert body == f"link{count}"
    assert laws.error(laws.same_quaternion_sign("body_poses", scene, got[None], place[None]), place[None]) < 1e-6


@pytest.mark.parametrize("others", [pytest.param([], marks=pytest.mark.slow), ["--without-newton"]])
def test_the_benchmark_in_small(others, device, tmp_path, capsys):
    file = tmp_path / "run.json"
    call = ["--arms", "ur5", "--targets", "16", "--seeds", "16", "--device", str(device), "--json", str(file)]
    assert benchmark.main([*call, *others]) == 0
    printed = capsys.readouterr().out
    assert "ur5    warp_spo           20" in printed and file.is_file()
    assert ("newton.ik" in printed) == (not others)
