"""Robots of the tasks against the files that their figures come from."""

import warnings

import numpy as np
import pytest

import warp_spo as spo
from benchmarks.table import robots as released
from warp_spo.env import robots
from warp_spo.newton import shipped
from warp_spo.reference.rotations import rotation, skew

ROUNDED = 2e-9  # share of the largest entry; figures in the files have ten digits


def source(name):
    if name == "ant":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return spo.load(shipped("ant"))
    if not released.is_available(name):
        pytest.skip("needs example-robot-data")
    return released.scene(name)


def compare(ours, theirs):
    """Return the largest difference of mass matrices and gravity forces at random states, without armature."""
    bare = ours.with_values(joint_armature=np.zeros(ours.dof_count))
    theirs = theirs.with_values(joint_armature=np.zeros(theirs.dof_count))
    rng, n = np.random.default_rng(5), bare.dof_count
    q = np.tile(bare.neutral_q, (4, 1))
    floating = len(q[0]) - n
    q[:, 7 * floating :] += rng.uniform(-1.0, 1.0, (4, n - 6 * floating))
    if floating:
        q[:, 3:7] = rng.normal(size=(4, 4))
    found = []
    for scene in (bare, theirs):
        dyn = spo.Dynamics(scene, 4, "cpu", "float64")
        to_origin = np.tile(np.eye(n), (4, 1, 1))  # rates of a floating base: at its frame, not at its centre of mass
        if floating:
            for w, quaternion in enumerate(dyn.body_poses(q)[:, 0, 3:]):
                to_origin[w, :3, 3:6] = -skew(rotation(quaternion) @ scene.values["body_com"][0, 0])
        mass, force = dyn.mass_matrix(q), dyn.gravity_force(q)
        found.append((to_origin.mT @ mass @ to_origin, (to_origin.mT @ force[..., None])[..., 0]))
    return max(np.abs(a - b).max() / np.abs(b).max() for a, b in zip(*found, strict=True))


@pytest.mark.parametrize("name", ["ant", "panda", "go2", "g1"])
def test_inertias_and_joints_are_the_sources(name):
    ours, theirs = robots.load(name).scene, source(name)
    last = lambda labels: [label.split("/")[-1] for label in labels]  # noqa: E731
    joints = [label for label in last(ours.joint_labels) if label in last(theirs.joint_labels) and label != "root"]
    assert len(joints) == len(robots.load(name).ctrl)
    assert [label for label in last(theirs.joint_labels) if label in joints] == joints  # in the same order
    assert compare(ours, theirs) < ROUNDED


def test_a_wrong_mass_is_seen():
    ours = robots.load("go2").scene
    mass = ours.values["body_mass"][0].copy()
    mass[3] *= 1.0 + 1e-6
    assert compare(ours.with_values(body_mass=mass), source("go2")) > ROUNDED


@pytest.mark.parametrize("name", ["panda", "go2", "g1"])
def test_limits_are_the_sources(name):
    ours, theirs = robots.load(name).scene, source(name)
    n = len(robots.load(name).ctrl)
    for value in ("joint_limit_lower", "joint_limit_upper"):
        assert np.allclose(ours.values[value][0, -n:], theirs.values[value][0, -n:], atol=1e-9)
    assert np.allclose(ours.values["joint_effort_limit"][0, -n:], theirs.values["joint_effort_limit"][0, -n:])
    assert np.allclose(ours.values["actuator_force_range"][0, :, 1], theirs.values["joint_effort_limit"][0, -n:])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "steps"), [("ant", 200), ("go2", 200), ("g1", 80)])
def test_they_stand(name, steps):
    """On their feet alone, with the controls of the pose "stand"; a humanoid tips over after a while."""
    robot = robots.load(name)
    dyn = spo.Dynamics(robot.scene, 2, "cpu")
    q, qd, ctrl = (np.tile(x, (2, 1)) for x in (robot.q, np.zeros(robot.scene.dof_count), robot.ctrl))
    force = np.full((2, len(robot.scene.contact_points), 3), np.nan, np.float32)
    for _ in range(steps):
        q, qd = dyn.step(
            q, qd, None, 5e-3, ctrl=None if name == "ant" else ctrl, report=spo.StepReport(contact_f=force)
        )
    feet = robot.points("foot", "sole")
    weight = 9.81 * robot.scene.values["body_mass"].sum()
    share = force[:, feet, 2].sum(axis=1) / weight
    assert q[0, 2] > 0.7 * robot.q[2] and np.allclose(share, 1.0, atol=0.1), (q[0], share)


def test_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match=r"robots.load: 'spot' is unknown; expected one of cartpole, ant"):
        robots.load("spot")
    with pytest.raises(ValueError, match=r"no contact of 'go2' is named like \('wheel',\)"):
        robots.load("go2").points("wheel")
