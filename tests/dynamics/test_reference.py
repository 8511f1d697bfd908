"""The dense reference against Lagrange's equations, conservation laws, differences, and the paper's identities."""

import numpy as np
import pytest

from support import zoo
from support.quick import slow_unless
from support.reference_cases import (
    ALGEBRA,
    DIFFERENCE,
    ORACLE,
    case,
    close,
    derivative,
    energy,
    every_scene,
    is_floating,
    is_screws,
    momentum,
    moved,
    same_poses,
    trees,
)
from warp_spo.reference.dense import Dense, homogeneous, quaternion, rotation, rotation_about, rotation_vector, skew
from warp_spo.scene.parts import Body, Hinge
from warp_spo.scene.scene import Scene


@pytest.mark.parametrize(
    "name",
    slow_unless(
        ("one_fixed_then_revolute", "chain_helical", "every_d6", "plain"),
        [name for name, screws in is_screws.items() if screws],
    ),
)
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


@pytest.mark.parametrize("name", slow_unless(("chain_free", "fork", "tree10"), is_floating))
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
