"""The dense reference against programs that no one here wrote, and against closed forms."""

import newton
import numpy as np
import pytest
import warp as wp

from support import oracles, zoo
from support.reference_cases import (
    ALGEBRA,
    FLOAT32,
    ORACLE,
    PUBLISHED,
    case,
    close,
    every_scene,
    is_floating,
    momentum,
    same_poses,
    trees,
)
from support.robots import of_newtons_importer
from warp_spo.newton import from_newton, load, shipped
from warp_spo.reference.dense import Dense, rotation
from warp_spo.scene.parts import Body, Hinge
from warp_spo.scene.scene import Scene


def agrees(scene, oracle, q, qd, tau, tolerance, world=0):
    d = Dense(scene, q, qd, world)
    same_poses(d.body_poses, oracle.body_poses(q), tolerance)
    close(d.mass_matrix, oracle.mass_matrix(q), tolerance)
    close(d.bias_force(), oracle.bias_force(q, qd), tolerance)
    close(d.gravity_force, oracle.bias_force(q, 0.0 * qd), tolerance)
    close(d.inverse_dynamics(None, tau), oracle.inverse_dynamics(q, qd, tau), tolerance)
    close(d.forward_dynamics(None, tau), oracle.forward_dynamics(q, qd, tau), tolerance)


def built(oracle, scene, world=0):
    try:
        return oracle(scene, world)
    except oracles.UnsupportedHinge as error:
        pytest.skip(str(error))


@every_scene
@pytest.mark.parametrize("armature", [True, False], ids=["armature", "bare"])
@pytest.mark.parametrize("oracle", [oracles.PinocchioModel, oracles.MujocoModel])
def test_oracle(oracle, armature, name):
    scene = zoo.SCENES[name]()
    if not armature:
        scene = scene.with_values(joint_armature=np.zeros(scene.dof_count))
    theirs = built(oracle, scene)
    for q, qd, tau in zip(*zoo.random_state(scene, 2, seed=8), strict=True):
        agrees(scene, theirs, q, qd, tau, ORACLE)


def test_oracle_worlds_differ():
    scene = zoo.varied(zoo.SCENES["tree20"](), 3)
    states = zoo.random_state(scene, 3, seed=9)
    masses = []
    for world, (q, qd, tau) in enumerate(zip(*states, strict=True)):
        agrees(scene, oracles.PinocchioModel(scene, world), q, qd, tau, ORACLE, world)
        masses.append(Dense(scene, states.q[0], world=world).mass_matrix)
    assert np.abs(masses[0] - masses[1]).max() > 0.01


def test_oracle_random_trees():
    for seed in range(6):
        scene = zoo.random_tree(9, seed, roots=1 + seed % 3)
        q, qd, tau = (array[0] for array in zoo.random_state(scene, 1, seed))
        agrees(scene, oracles.PinocchioModel(scene), q, qd, tau, ORACLE)


def test_quaternions_are_normalised_when_read():
    scene, d, tau = case("tree20")
    q = d.q.copy()
    for hinge, start in zip(scene.hinges, scene.q_start, strict=False):
        if hinge.kind in ("ball", "free"):
            q[start + hinge.coord_count - 4 : start + hinge.coord_count] *= -3.0
    close(Dense(scene, q, d.qd).forward_dynamics(None, tau), d.forward_dynamics(None, tau), ORACLE)
    same_poses(Dense(scene, q).body_poses, d.body_poses, ORACLE)


@pytest.mark.parametrize("oracle", [oracles.PinocchioModel, oracles.MujocoModel])
@pytest.mark.parametrize("name", ["ant", "humanoid", "quadruped", "cartpole"])
def test_oracle_robot(name, oracle):
    path = shipped(name)
    scene = of_newtons_importer(path) if path.suffix == ".xml" else load(path)
    theirs = oracle(scene)
    for q, qd, tau in zip(*zoo.random_state(scene, 2, seed=3), strict=True):
        agrees(scene, theirs, q, qd, tau, ORACLE)


def test_coordinates_are_newtons():
    """Newton's own eval_fk: what q and qd mean, free hinges inside the tree and turned anchors included."""
    rng = np.random.default_rng(0)
    builder = newton.ModelBuilder()
    pose = lambda: wp.transform(*np.split(zoo.random_pose(rng), [3]))  # noqa: E731
    body = lambda: builder.add_link(mass=1.0, com=rng.uniform(-0.2, 0.2, 3), inertia=wp.mat33(np.eye(3)))  # noqa: E731
    axes = lambda n: [newton.ModelBuilder.JointDofConfig(axis=wp.vec3(v)) for v in zoo.unit(rng, n, 3)]  # noqa: E731

    def square(n):
        basis = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        return [newton.ModelBuilder.JointDofConfig(axis=wp.vec3(v)) for v in basis[:n]]

    add = [
        builder.add_joint_free,
        builder.add_joint_ball,
        builder.add_joint_revolute,
        builder.add_joint_free,
        builder.add_joint_prismatic,
        builder.add_joint_d6,
        builder.add_joint_fixed,
        builder.add_joint_d6,
    ]
    joints, parent = [], -1
    for joint in add:
        child, extra = body(), {}
        if joint in (builder.add_joint_revolute, builder.add_joint_prismatic):
            extra["axis"] = axes(1)[0].axis
        elif joint == builder.add_joint_d6:
            # Newton turns two oblique angular axes into others (quat_from_matrix of no rotation), so they are square
            extra = dict(linear_axes=axes(2), angular_axes=square(2 + (parent > 5)))
        joints.append(joint(parent=parent, child=child, parent_xform=pose(), child_xform=pose(), **extra))
        parent = child
    builder.add_articulation(joints)
    model = builder.finalize(device="cpu")
    scene, state = from_newton(model), model.state()
    q, qd = (array[0] for array in zoo.random_state(scene, 1, 4)[:2])
    as_floats = lambda array: wp.array(array, dtype=wp.float32, device="cpu")  # noqa: E731
    newton.eval_fk(model, as_floats(q), as_floats(qd), state)
    d = Dense(scene, q, qd)
    same_poses(d.body_poses, state.body_q.numpy(), FLOAT32)
    close(d.body_velocities(), state.body_qd.numpy(), FLOAT32)


def test_double_pendulum():
    m, l, g, q, qd = 1.3, 0.7, 9.81, np.array([0.4, 1.1]), np.array([0.3, -0.8])
    d = Dense(zoo.double_pendulum(m, l), q, qd)
    c, s = np.cos(q[1]), np.sin(q[1])
    close(d.mass_matrix, m * l**2 * np.array([[5 / 3 + c, 1 / 3 + c / 2], [1 / 3 + c / 2, 1 / 3]]), ORACLE)
    close(np.diag(d.D), m * l**2 * np.array([4 / 3 - 3 / 4 * c**2, 1 / 3]), ORACLE)
    h, c1, c12 = m * l**2 * s / 2, np.cos(q[0]), np.cos(q.sum())
    bias = [
        -h * (2 * qd[0] * qd[1] + qd[1] ** 2) + m * g * l * (1.5 * c1 + 0.5 * c12),
        h * qd[0] ** 2 + 0.5 * m * g * l * c12,
    ]
    close(d.bias_force(), bias, ORACLE)
    close(d.bias_force(), [12.60392851, 0.3412855], 1e-7)
    close(np.diag(d.D), [0.751036537717704, 0.212333333333333], PUBLISHED)
    close(d.log_det, -1.835898888392072, PUBLISHED)


def test_straight_chain_is_sqrt3():
    """S5: D from tip to base runs through convergents of 1/3 + 1/sqrt 12."""
    tip_first = [1 / 3, 7 / 12, 13 / 21, 97 / 156, 181 / 291, 1351 / 2172]
    d = Dense(zoo.planar_chain(40), np.zeros(40))
    close(np.diag(d.D)[::-1][:6], tip_first, ALGEBRA)
    close(np.diag(d.D)[0], 1 / 3 + 1 / np.sqrt(12), ALGEBRA)
    close(d.log_det, -19.685210072689486, PUBLISHED)
    close(np.log(np.diag(d.D)).sum(), -19.685210072689486, PUBLISHED)
    m, l = 1.3, 0.7
    close(np.linalg.det(Dense(zoo.planar_chain(3, m, l), np.zeros(3)).mass_matrix), 13 / 108 * m**3 * l**6, ALGEBRA)


def test_planar_chain():
    n, m, l = 7, 1.3, 0.7
    q = np.random.default_rng(0).uniform(-3, 3, n)
    theta, i = np.cumsum(q), np.arange(1, n + 1)
    A = m * l**2 * (n - np.maximum.outer(i, i) + 0.5) * np.cos(np.subtract.outer(theta, theta))
    A[np.diag_indices(n)] = m * l**2 * (n - i + 1 / 3)
    L = np.tril(np.ones((n, n)))
    close(Dense(zoo.planar_chain(n, m, l), q).mass_matrix, L.T @ A @ L, ORACLE)


def test_cart_pole():
    M, m, l, angle = 2.0, 0.5, 0.8, 0.6
    d = Dense(zoo.cart_pole(M, m, l), [0.3, angle], [0.2, -0.7])
    close(d.mass_matrix, [[M + m, m * l * np.cos(angle)], [m * l * np.cos(angle), m * l**2]], ORACLE)
    close(d.D[0, 0], M + m * np.sin(angle) ** 2, ORACLE)
    close(d.D[0, 0], 2.1594105613808314, PUBLISHED)
    close(d.bias_force(), [-m * l * np.sin(angle) * 0.49, m * 9.81 * l * np.sin(angle)], ORACLE)


def test_free_body():
    """O5: D is the body's inertia at its CoM and the operational compliance its inverse; a free fall falls."""
    body = Body(1.7, (0.1, -0.2, 0.3), np.diag([0.2, 0.3, 0.4]))
    scene = Scene([body], [Hinge("free", -1, 0)])
    q = zoo.random_state(scene, 1, 3).q[0]
    d = Dense(scene, q, [0.3, -0.2, 0.5, 1.0, 2.0, -1.5])
    R, com = rotation(q[3:]), (*body.com, 0, 0, 0, 1)
    inertia = np.block([[1.7 * np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), R @ body.inertia @ R.T]])
    close(d.mass_matrix, inertia, ORACLE)
    close(d.D, inertia, ORACLE)
    close(d.operational_inertia_inverse([(0, com)]), np.linalg.inv(inertia), ALGEBRA)
    w = d.qd[3:]
    spin = -np.linalg.solve(inertia[3:, 3:], np.cross(w, inertia[3:, 3:] @ w))  # Euler's equation
    close(d.forward_dynamics(), np.concatenate([[0.0, 0.0, -9.81], spin]), ALGEBRA)
    close(d.body_velocities(), d.qd[None], ORACLE)


@pytest.mark.parametrize("name", is_floating)
def test_floating_rows_are_momentum(name):
    """O6: a free root's rows of M qd are its tree's momentum: linear, and angular about the root's CoM."""
    scene, d, _ = case(name)
    for root, bodies in trees(d).items():
        if d.hinge[root].kind == "free":
            anchor = rotation(d.value("joint_X_p")[scene.hinge_of[root]][3:])
            p = momentum(d, bodies)
            expected = np.concatenate([anchor.T @ p[:3], anchor.T @ (p[3:] - np.cross(d.com[root], p[:3]))])
            close(((d.mass_matrix - d.Delta) @ d.qd)[d.dofs[root]], expected, ALGEBRA)
