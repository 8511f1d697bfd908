"""Frames, centre of mass, energies and the regressor against Pinocchio and MuJoCo."""

import functools

import mujoco
import numpy as np
import pinocchio as pin
import pytest

from support import laws, symbolic, zoo
from support.oracles import MujocoModel, PinocchioModel, se3
from support.robots import ROBOTS
from warp_spo.scene.frames import check_frames, origins

TOLERANCE = 1e-12  # both sides in float64, a dozen links deep
SCENES = {"arm": ROBOTS["arm"], "tree10": zoo.SCENES["tree10"], "forest": zoo.SCENES["forest"]}
PAIRS = [(0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)]  # entries of an inertia, in the order of the parameters


@functools.cache
def case(name):
    scene = SCENES[name]()
    return scene, laws.states(scene, 2)


def traced(scene, operation, a, *given, shape, **options):
    found = symbolic.run(scene, operation, a, given, {"out": shape}, **options)["out"]
    return np.nan_to_num(found) if "regressor" in operation else found  # what is not stored is zero


def pinocchio_at(scene, a, world):
    """The oracle with its kinematics computed: velocities and accelerations are its own."""
    oracle = PinocchioModel(scene)
    q, qd, qdd = (a[name][world] for name in ("q", "qd", "qdd"))
    T, rate = oracle._maps(q, qd)
    state = oracle.q_of(q), T @ qd, T @ qdd + rate
    pin.forwardKinematics(oracle.model, oracle.data, *state)
    return oracle, state, T


@pytest.mark.parametrize("name", SCENES)
def test_frames(name):
    scene, a = case(name)
    frames = check_frames(scene, "test", laws.frames_of(scene))
    poses = traced(scene, "frame_poses", a, "q", shape=(2, 7), frames=frames)
    rates = traced(scene, "frame_velocities", a, "q", "qd", shape=(2, 6), frames=origins(frames))
    gains = traced(scene, "frame_accelerations", a, "q", "qd", "qdd", shape=(2, 6), frames=origins(frames))
    for world in range(2):
        oracle, _, _ = pinocchio_at(scene, a, world)
        for index, (body, pose) in enumerate(frames):
            joint, place = oracle.joint[body], oracle.in_joint[body] * se3(np.array(pose))
            wanted = pin.SE3ToXYZQUAT(oracle.data.oMi[joint] * place)
            got = poses[world, index]
            got[3:] *= np.sign(got[3:] @ wanted[3:])
            assert laws.error(got, wanted) <= TOLERANCE
            velocity, acceleration = (
                pin.SE3(oracle.data.oMi[joint].rotation @ place.rotation, np.zeros(3)).act(place.actInv(motion))
                for motion in (oracle.data.v[joint], oracle.data.a[joint])
            )
            linear = acceleration.linear + np.cross(velocity.angular, velocity.linear)
            assert laws.error(rates[world, index], velocity.vector) <= TOLERANCE
            assert laws.error(gains[world, index], np.array([*linear, *acceleration.angular])) <= TOLERANCE


@pytest.mark.parametrize("name", SCENES)
def test_centre_of_mass_and_energies(name):
    """Without springs and armature, which Pinocchio's energies do not have."""
    scene, a = case(name)
    plain = {"joint_stiffness": np.zeros(scene.dof_count), "joint_armature": np.zeros(scene.dof_count)}
    scene = scene.with_values(**plain)
    com, velocity = (traced(scene, n, a, "q", "qd", shape=(3,)) for n in ("com", "com_velocity"))
    kinetic, potential = (traced(scene, f"{n}_energy", a, "q", "qd", shape=()) for n in ("kinetic", "potential"))
    for world in range(2):
        oracle, (q, v, _), _ = pinocchio_at(scene, a, world)
        model, data = oracle.model, oracle.data
        pin.centerOfMass(model, data, q, v)
        assert laws.error(com[world], data.com[0]) <= TOLERANCE
        assert laws.error(velocity[world], data.vcom[0]) <= TOLERANCE
        assert laws.error(kinetic[world], pin.computeKineticEnergy(model, data, q, v)) <= TOLERANCE
        ground = model.inertias[0]  # bodies that do not move, which Pinocchio leaves out of the energy
        ground = -ground.mass * ground.lever @ model.gravity.linear
        assert laws.error(potential[world], pin.computePotentialEnergy(model, data, q) + ground) <= TOLERANCE


def test_potential_energy_of_mujoco():
    """With bodies that do not move, and springs of slides, turns and balls away from rest."""
    kinds = ["fixed", "revolute", "prismatic", "ball", "revolute"]
    scene = zoo.from_parents([-1, 0, 1, 2, 3], kinds, 11)
    stiffness = np.repeat([3.0, 5.0, 2.0, 4.0], [1, 1, 3, 1])
    scene = scene.with_values(joint_stiffness=stiffness)
    a = laws.states(scene, 2)
    got = traced(scene, "potential_energy", a, "q", shape=())
    oracle = MujocoModel(scene)
    for dof, place in enumerate(oracle.v_of):
        oracle.model.jnt_stiffness[oracle.model.dof_jntid[place]] = stiffness[dof]
    for world in range(2):
        oracle._set(oracle.q_of(a["q"][world]), 0.0)
        mujoco.mj_fwdPosition(oracle.model, oracle.data)
        mujoco.mj_energyPos(oracle.model, oracle.data)
        assert laws.error(got[world], oracle.data.energy[0]) <= TOLERANCE


def moved(pose):
    """The ten parameters of a body in another frame [10, 10], by the pseudo-inertia: P' = T P T*."""
    T, columns = pose.homogeneous, []
    for unit in np.eye(10):
        I = np.zeros((3, 3))
        for (i, j), x in zip(PAIRS, unit[4:], strict=True):
            I[i, j] = I[j, i] = x
        P = np.zeros((4, 4))
        P[:3, :3], P[:3, 3], P[3, :3], P[3, 3] = 0.5 * np.trace(I) * np.eye(3) - I, unit[1:4], unit[1:4], unit[0]
        P = T @ P @ T.T
        I = np.trace(P[:3, :3]) * np.eye(3) - P[:3, :3]
        columns.append([P[3, 3], *P[:3, 3], *(I[i, j] for i, j in PAIRS)])
    return np.array(columns).T


@pytest.mark.parametrize("name", ["arm", "forest", pytest.param("tree10", marks=pytest.mark.slow)])
def test_regressor_of_pinocchio(name):
    """Its columns are parameters in joint frames, its rows are dual to its own velocities."""
    scene, a = case(name)
    shape = (scene.dof_count, 10 * scene.body_count)
    got = traced(scene, "inverse_dynamics_regressor", a, "q", "qd", "qdd", shape=shape)
    for world in range(2):
        oracle, state, T = pinocchio_at(scene, a, world)
        of_joints = T.T @ pin.computeJointTorqueRegressor(oracle.model, oracle.data, *state)
        wanted = np.zeros(shape)
        for body in range(scene.body_count):
            joint = oracle.joint[body]
            if joint > 0:
                columns = slice(10 * (joint - 1), 10 * joint)
                wanted[:, 10 * body : 10 * body + 10] = of_joints[:, columns] @ moved(oracle.in_joint[body])
        assert laws.error(got[world], wanted) <= TOLERANCE


def test_parameters_of_pinocchio():
    scene, _ = case("tree10")
    for body, ten in enumerate(scene.inertial_parameters.reshape(-1, 10)):
        values = (scene.values[name][0, body] for name in ("body_mass", "body_com", "body_inertia"))
        assert laws.error(ten, pin.Inertia(*values).toDynamicParameters()) <= 1e-15
