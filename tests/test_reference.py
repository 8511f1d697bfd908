"""The dense reference against programs that no one here wrote, closed forms, Lagrange's equations, and itself."""

import functools

import newton
import numpy as np
import oracles
import pytest
import warp as wp
import zoo

from warp_spo.newton import from_newton, load, shipped
from warp_spo.reference import Dense, homogeneous, quaternion, rotation, rotation_about, rotation_vector, skew
from warp_spo.scene.parts import Body, Hinge
from warp_spo.scene.scene import Scene

# Relative to the largest entry of the expected array unless said otherwise.
ORACLE = 1e-11  # float64 against float64, forward dynamics loses cond(M) eps; measured 4e-13, cond up to 5e3
ALGEBRA = 1e-11  # dense identities with inverses; measured 2e-13
DIFFERENCE = 1e-9  # five-point stencil of step h = STENCIL: h^4 f^(5) / 30 and eps / h; measured 1e-11
PUBLISHED = 1e-9  # digits that are given
FLOAT32 = 1e-5  # Newton's forward kinematics, a chain of 8; measured 5e-7

STENCIL = 3e-4  # of unit time: 1e-3 loses a factor 100 where accelerations reach 1e3, 1e-4 meets eps / h

every_scene = pytest.mark.parametrize("name", zoo.SCENES)
is_screws = {name: all(h.kind not in ("ball", "free") for h in make().hinges) for name, make in zoo.SCENES.items()}
is_floating = [
    name for name, make in zoo.SCENES.items() if any(h.kind == "free" for h in make().hinges if h.parent < 0)
]


@functools.cache
def case(name, world=0):
    """A scene of the zoo, the reference in a random state, and tau."""
    scene = zoo.SCENES[name]()
    q, qd, tau = zoo.random_state(scene, world + 1, seed=7)
    return scene, Dense(scene, q[world], qd[world]), tau[world]


def close(got, expected, tolerance):
    got, expected = np.asarray(got), np.asarray(expected)
    assert got.shape == expected.shape
    error = np.abs(got - expected).max(initial=0.0)
    assert error <= tolerance * max(np.abs(expected).max(initial=0.0), 1e-3), f"relative error {error:.3g}"


def same_poses(got, expected, tolerance):
    close(got[:, :3], expected[:, :3], tolerance)
    close([rotation(q) for q in got[:, 3:]], [rotation(q) for q in expected[:, 3:]], tolerance)


def derivative(function, step=STENCIL):
    """d/dt of an array-valued function at t = 0; exact for cubics and blind to odd errors of order step^3."""
    return (8.0 * (function(step) - function(-step)) - function(2.0 * step) + function(-2.0 * step)) / (12.0 * step)


def moved(dense, qdd, dt):
    """The reference at time dt on a curve through its state with acceleration qdd, but for odd terms of order dt^3."""
    q = dense.integrate(dense.qd + 0.5 * dt * qdd, dt)
    return Dense(dense.scene, q, dense.qd + dt * qdd, dense.world)


def trees(dense):
    """Root -> bodies of its tree."""
    root = {}
    for k in dense.outward:
        root[k] = k if dense.parent[k] < 0 else root[dense.parent[k]]
    return {r: [k for k in root if root[k] == r] for r in root.values()}


def energy(dense):
    """Kinetic and potential energy [J]; the potential -m g . c."""
    weight = dense.value("body_mass")[:, None] * dense.value("gravity")
    return 0.5 * dense.qd @ dense.mass_matrix @ dense.qd - np.sum(weight * dense.com)


def momentum(dense, bodies):
    """Linear, then angular momentum about the world origin, world axes (6,), from classical body velocities."""
    total, velocities = np.zeros(6), dense.body_velocities()
    for k in bodies:
        velocity = velocities[k]
        R = dense.body_matrix[k][:3, :3]
        linear = dense.value("body_mass")[k] * velocity[:3]
        spin = R @ dense.value("body_inertia")[k] @ R.T @ velocity[3:]
        total += np.concatenate([linear, spin + np.cross(dense.com[k], linear)])
    return total


# -- programs that no one here wrote -----------------------------------------------------------------------------------
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
    scene = load(shipped(name))
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


# -- closed forms ------------------------------------------------------------------------------------------------------
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


# -- Lagrange, energy, momentum ----------------------------------------------------------------------------------------
@pytest.mark.parametrize("name", [name for name, screws in is_screws.items() if screws])
def test_bias_force_is_christoffel(name):
    """sum_jk (dM_ij/dq_k - 1/2 dM_jk/dq_i) qd_j qd_k + dU/dq_i, from the paper's mass matrix alone."""
    scene, d, _ = case(name)
    at = lambda i, t: Dense(scene, d.q + t * np.eye(len(d.q))[i])  # noqa: E731
    dM = np.stack([derivative(lambda t, i=i: at(i, t).mass_matrix) for i in range(scene.dof_count)], axis=-1)
    dU = [derivative(lambda t, i=i: energy(at(i, t))) for i in range(scene.dof_count)]
    quadratic = np.einsum("ijk,j,k->i", dM, d.qd, d.qd) - 0.5 * np.einsum("jki,j,k->i", dM, d.qd, d.qd)
    close(d.bias_force(), quadratic + dU, DIFFERENCE)
    close(d.gravity_force, dU, DIFFERENCE)


@every_scene
def test_power_is_energy_rate(name):
    """The gyroscopic term cannot fail this one; it can fail test_momentum_is_conserved and the oracles."""
    _, d, tau = case(name)
    qdd = d.forward_dynamics(None, tau)
    rate = derivative(lambda t: energy(moved(d, qdd, t)))
    assert abs(rate - tau @ d.qd) <= DIFFERENCE * (np.abs(tau * d.qd).sum() + abs(energy(d)))


@pytest.mark.parametrize("name", is_floating)
def test_momentum_is_conserved(name):
    """O9 as a rate: without armature, gravity and root force a tree's momentum about the world origin stands still."""
    scene, d, tau = case(name)
    scene = scene.with_values(joint_armature=np.zeros(scene.dof_count), gravity=np.zeros(3))
    floating = {root: bodies for root, bodies in trees(d).items() if d.hinge[root].kind == "free"}
    tau = tau.copy()
    for root in floating:
        tau[d.dofs[root]] = 0.0
    d = Dense(scene, d.q, d.qd)
    qdd = d.forward_dynamics(None, tau)
    for bodies in floating.values():
        rate = derivative(lambda t, bodies=bodies: momentum(moved(d, qdd, t), bodies))
        coasting = derivative(lambda t, bodies=bodies: momentum(moved(d, 0.0 * qdd, t), bodies))
        assert np.abs(rate).max() <= DIFFERENCE * max(np.abs(coasting).max(), np.abs(momentum(d, bodies)).max())


@every_scene
def test_body_f_is_virtual_power(name):
    scene, d, tau = case(name)
    body_f = np.random.default_rng(1).normal(size=(scene.body_count, 6))
    power = np.sum(body_f * d.body_velocities())
    moved_by = d.bias_force() - d.bias_force(None, body_f)
    assert abs(moved_by @ d.qd - power) <= ALGEBRA * np.abs(body_f * d.body_velocities()).sum()
    frames = [(k, (*d.value("body_com")[k], 0, 0, 0, 1)) for k in range(scene.body_count)]
    close(moved_by, np.einsum("kij,ki->j", d.jacobian(frames), body_f), ALGEBRA)
    qdd = d.forward_dynamics(None, tau, body_f)
    close(d.inverse_dynamics(None, qdd, body_f), tau, ALGEBRA)


# -- kinematics --------------------------------------------------------------------------------------------------------
@every_scene
def test_velocities_are_pose_rates(name):
    """body_velocities, jacobian and H against poses moved by integrate."""
    scene, d, _ = case(name)
    frames = [(k, zoo.random_pose(np.random.default_rng(k))) for k in range(scene.body_count)]
    offset = [homogeneous(pose) for _, pose in frames]
    path = lambda t: Dense(scene, d.integrate(None, t))  # noqa: E731
    twist = np.einsum("kij,j->ki", d.jacobian(frames), d.qd)
    rates = derivative(lambda t: np.array([T @ X for T, X in zip(path(t).body_matrix, offset, strict=True)]))
    close(twist[:, :3], rates[:, :3, 3], DIFFERENCE)
    for k in range(scene.body_count):
        spin = rates[k][:3, :3] @ (d.body_matrix[k] @ offset[k])[:3, :3].T
        close(skew(twist[k, 3:]), spin, DIFFERENCE)
    close(d.body_velocities()[:, :3], derivative(lambda t: path(t).com), DIFFERENCE)
    close(d.body_velocities()[:, 3:], twist[:, 3:], ALGEBRA)


@every_scene
def test_jacobian_is_phi_T_H_T(name):
    """Eq. 20-22, V = phi* H* qd, against the classical velocities."""
    _, d, _ = case(name)
    V = (d.phi.T @ d.H.T).reshape(-1, 6, d.dof_count)
    J = d.jacobian([(k, homogeneous_pose) for k, homogeneous_pose in enumerate(d.value("joint_X_c")[d.scene.hinge_of])])
    for k, T in enumerate(d.node_matrix):
        close(V[k, :3], T[:3, :3].T @ J[k, 3:], ALGEBRA)
        close(V[k, 3:], T[:3, :3].T @ J[k, :3], ALGEBRA)


@every_scene
def test_integrate(name):
    scene, d, _ = case(name)
    far = d.integrate(None, 0.4)
    half = Dense(scene, d.integrate(None, 0.2), d.qd).integrate(None, 0.2)
    close(half, far, ORACLE)  # constant qd is a one-parameter motion
    close(Dense(scene, far).integrate(-d.qd, 0.4), d.q, ORACLE)
    for hinge, start in zip(scene.hinges, scene.q_start, strict=False):
        if hinge.kind in ("ball", "free"):
            end = start + hinge.coord_count
            assert abs(np.linalg.norm(far[end - 4 : end]) - 1.0) < ORACLE


def test_rotations():
    rng = np.random.default_rng(0)
    for vector in [*rng.normal(size=(20, 3)), np.zeros(3), [1e-9, 0, 0], [0, np.pi - 1e-6, 0], [1e-160, 0, 0]]:
        angle = np.linalg.norm(vector)
        R = rotation_about(np.asarray(vector) / angle if angle else (1.0, 0.0, 0.0), angle)
        close(R @ R.T, np.eye(3), ORACLE)
        close(rotation(quaternion(R)), R, ORACLE)
        wrapped = np.asarray(vector) * (1 - 2 * np.pi / np.linalg.norm(vector) if np.linalg.norm(vector) > np.pi else 1)
        close(rotation_vector(R), wrapped, ORACLE)


def test_planar_slides_then_turns():
    scene = Scene([Body(1.0)], [Hinge("planar", -1, 0, axis=(0, 0, 1))])
    d = Dense(scene, [0.5, -0.3, np.pi / 2])
    same_poses(d.body_poses, np.array([[0.5, -0.3, 0, 0, 0, np.sqrt(0.5), np.sqrt(0.5)]]), ORACLE)


@every_scene
def test_passive_force_is_minus_gradient(name):
    """The springs' potential energy falls as fast as they work: screws, and rotations of equal stiffness all round."""
    scene, d, _ = case(name)
    stiffness = d.value("joint_stiffness").copy()
    rest = zoo.random_state(scene, 1, 5).q[0]
    for hinge, start in zip(scene.hinges, scene.qd_start, strict=False):
        if hinge.kind in ("ball", "free"):
            stiffness[start : start + hinge.dof_count - 3] = 0.0
            stiffness[start + hinge.dof_count - 3 : start + hinge.dof_count] = 2.5
    scene = scene.with_values(joint_stiffness=stiffness, joint_rest_q=rest)
    d = Dense(scene, d.q, d.qd)

    def potential(t):
        q, total = d.integrate(None, t), 0.0
        for h, hinge in enumerate(scene.hinges):
            now, then = (a[scene.q_start[h] : scene.q_start[h + 1]] for a in (q, rest))
            k = stiffness[scene.qd_start[h] : scene.qd_start[h + 1]]
            if hinge.kind in ("ball", "free"):
                angle = 2.0 * np.arccos(abs(now[-4:] @ then[-4:]))
                total += 0.5 * 2.5 * angle**2
            else:
                total += 0.5 * k @ (now - then) ** 2
        return total

    spring = d.passive_force(np.zeros(d.dof_count))
    assert abs(spring @ d.qd + derivative(potential)) <= DIFFERENCE * (np.abs(spring * d.qd).sum() + potential(0.0))
    close(d.passive_force() - spring, -d.value("joint_damping") * d.qd, ORACLE)


def test_passive_force_of_a_free_hinge():
    scene = Scene([Body(1.0, (0.3, 0, 0))], [Hinge("free", -1, 0, stiffness=[1, 2, 3, 4, 5, 6], damping=0.5)])
    turn = [0.0, 0.0, np.sin(0.2), np.cos(0.2)]
    force = Dense(scene, [1.0, 2.0, 3.0, *turn]).passive_force(np.ones(6))
    close(force, [-1.5, -4.5, -9.5, -0.5, -0.5, -0.5 - 6 * 0.4], ORACLE)


# -- the paper's identities --------------------------------------------------------------------------------------------
@every_scene
def test_mass_matrix_is_inverse_dynamics_columns(name):
    """Two independent roads: H phi M phi* H* + Delta, and Newton and Euler in the world."""
    _, d, _ = case(name)
    columns = [d.inverse_dynamics(None, unit) - d.bias_force() for unit in np.eye(d.dof_count)]
    close(np.transpose(columns), d.mass_matrix, ALGEBRA)


@every_scene
def test_equation_1(name):
    _, d, _ = case(name)
    one = np.eye(d.dof_count)
    left = one + d.H @ d.phi @ d.K
    inverse = one - d.H @ d.psi @ d.K
    close(left @ d.D @ left.T, d.mass_matrix, ALGEBRA)  # 1b
    close(left @ inverse, one, ALGEBRA)  # 1c
    close(inverse.T @ np.linalg.solve(d.D, inverse), np.linalg.inv(d.mass_matrix), ALGEBRA)  # 1d
    close(d.log_det, np.linalg.slogdet(d.D)[1], ALGEBRA)


@every_scene
def test_resolvent_and_weights(name):
    """Eq. 6-9, 13-14, 34 and 35."""
    scene, d, _ = case(name)
    one, strict = np.eye(len(d.phi)), d.phi - np.eye(len(d.phi))
    close(strict, d.E_phi @ d.phi, ALGEBRA)
    close(strict, d.phi @ d.E_phi, ALGEBRA)
    assert not np.linalg.matrix_power(d.E_phi, scene.tree.depth + 1).any()  # Lemma 2, sharp
    for k in range(scene.body_count):  # Lemma 5: a block is the transform between the two frames, or zero
        above, node = set(), k
        while node >= 0:
            above.add(node)
            node = d.parent[node]
        for i in range(scene.body_count):
            relative = np.linalg.inv(d.node_matrix[i]) @ d.node_matrix[k]
            R = relative[:3, :3]
            rigid = np.block([[R, skew(relative[:3, 3]) @ R], [np.zeros((3, 3)), R]]) * (i in above)
            assert np.abs(d.phi[np.ix_(d.rows[i], d.rows[k])] - rigid).max() < ALGEBRA
    inverse = np.eye(d.dof_count) - d.H @ d.psi @ d.K
    close(d.E_psi, d.E_phi @ (one - d.G @ d.H), ALGEBRA)
    close(d.H @ d.psi, inverse @ d.H @ d.phi, ALGEBRA)
    close(d.psi, d.phi - d.psi @ d.K @ d.H @ d.phi, ALGEBRA)
    close(d.phi @ d.M @ d.psi.T, d.P + strict @ d.P + d.P @ (d.psi - one).T, ALGEBRA)


@every_scene
def test_riccati_equation(name):
    """P = M + E_phi (I - G H) P E_phi*; without Delta the remainder has nothing along a hinge and H G = I."""
    scene, d, _ = case(name)
    one = np.eye(len(d.phi))
    close(d.P, d.M + d.E_phi @ (one - d.G @ d.H) @ d.P @ d.E_phi.T * (d.P != 0), ALGEBRA)
    close(d.D, d.H @ d.P @ d.H.T + d.Delta, ALGEBRA)
    close(d.P, d.P.T, ALGEBRA)
    bare = Dense(scene.with_values(joint_armature=np.zeros(scene.dof_count)), d.q)
    close(bare.H @ bare.G, np.eye(d.dof_count), ALGEBRA)
    remainder = (one - bare.G @ bare.H) @ bare.P
    close(remainder @ bare.H.T + np.abs(bare.P).max(), np.full_like(bare.H.T, np.abs(bare.P).max()), ALGEBRA)


@every_scene
def test_operational_inertia_inverse(name):
    """J M^-1 J* of frames on bodies, from psi* H* D^-1 H psi at the nodes."""
    scene, d, _ = case(name)
    rng = np.random.default_rng(2)
    frames = [(int(k), zoo.random_pose(rng)) for k in rng.integers(0, scene.body_count, 3)]
    Omega = d.psi.T @ d.H.T @ np.linalg.solve(d.D, d.H @ d.psi)
    pick = []  # node twist -> velocity and angular velocity of the frame, world axes
    for k, pose in frames:
        node = d.node_matrix[k]
        point = np.linalg.inv(node) @ (d.body_matrix[k] @ homogeneous(pose))[:, 3]
        R, B = node[:3, :3], np.zeros((6, len(d.phi)))
        B[:, d.rows[k]] = np.block([[-R @ skew(point[:3]), R], [R, np.zeros((3, 3))]])
        pick.append(B)
    B = np.concatenate(pick)
    close(d.operational_inertia_inverse(frames), B @ Omega @ B.T, ALGEBRA)


@every_scene
def test_renumbering(name):
    scene, d, tau = case(name)
    other = zoo.permuted(scene, seed=4)
    e = Dense(other.scene, d.q[other.q], d.qd[other.qd])
    close(e.mass_matrix, d.mass_matrix[np.ix_(other.qd, other.qd)], ORACLE)
    close(e.D, d.D[np.ix_(other.qd, other.qd)], ORACLE)
    close(e.forward_dynamics(None, tau[other.qd]), d.forward_dynamics(None, tau)[other.qd], ORACLE)
    same_poses(e.body_poses, d.body_poses[other.body], ORACLE)
    same_poses(e.frames, d.frames[other.body], ORACLE)
    close(e.integrate(None, 0.1), d.integrate(None, 0.1)[other.q], ORACLE)
    close(e.passive_force(), d.passive_force()[other.qd], ORACLE)


def test_two_robots_are_two_models():
    """Trees of a forest do not meet."""
    _, d, _ = case("forest")
    one, other = (np.concatenate([d.dofs[k] for k in bodies]) for bodies in trees(d).values())
    assert len(one) and len(other) and len(one) + len(other) == d.dof_count
    assert not d.mass_matrix[np.ix_(one, other)].any()


def test_no_degrees_of_freedom():
    d = Dense(zoo.single_body("fixed"), [])
    assert d.mass_matrix.shape == d.D.shape == (0, 0)
    assert d.forward_dynamics().shape == d.integrate(None, 0.1).shape == (0,)
    close(d.operational_inertia_inverse([0]), np.zeros((6, 6)), ORACLE)
    close(d.psi, np.eye(6), ORACLE)
    assert d.log_det == 0.0


def test_wrong_length_is_named():
    scene, d, _ = case("fork")
    with pytest.raises(ValueError, match=r"q has shape \(3,\); expected \(12,\)"):
        Dense(scene, np.zeros(3))
    with pytest.raises(ValueError, match=r"qdd has shape"):
        d.inverse_dynamics(None, np.zeros(3))
