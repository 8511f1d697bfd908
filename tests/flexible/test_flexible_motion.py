"""Motion of flexible trees: a fine rigid discretisation, conservation laws, and stiff, heavy and many modes."""

import functools

import numpy as np
import pytest

import warp_spo as spo
from support.flexible_scenes import Traced, about
from support.flexible_twin import Twin, of_quaternion

# of one step, beside the largest entry; float32 measured 2.2e-7 with 20 modes
LAW = {"float64": 5e-12, "float32": 1e-6}

E, DENSITY, SIDE, LENGTHS = 4e8, 1000.0, 0.02, (1.0, 0.8)
"""A planar arm of two soft links under gravity: modulus [Pa], density [kg/m^3], side of the section and lengths [m]."""


def revolute(parent, child, x=0.0, **values):
    return spo.Hinge("revolute", parent, child, axis=(0, 0, 1), parent_pose=(x, 0, 0, 0, 0, 0, 1), **values)


def weld(parent, child, x):
    return spo.Hinge("fixed", parent, child, parent_pose=(x, 0, 0, 0, 0, 0, 1))


def flexible_arm(modes=3, **values):
    """Two links of so many modes each, revolute joints, and a tip without mass."""
    section, material = spo.Section.rectangle(SIDE, SIDE), spo.Material(DENSITY, E)
    links = [spo.beam_modes(length, section, material, "clamped", {"y": modes}, rotary=False) for length in LENGTHS]
    bodies = [*(spo.Body(*link.rigid, modes=link) for link in links), spo.Body(0.0)]
    hinges = [revolute(-1, 0), revolute(0, 1, LENGTHS[0]), weld(1, 2, LENGTHS[1])]
    return spo.Scene(bodies, hinges, **{"gravity": (0, -9.81, 0), **values})


def rigid_arm(pieces):
    """The same with rigid rods, joined by springs EI / h at the middle of what they stand for."""
    bodies, hinges, last = [], [], 0.0
    for length in LENGTHS:
        h = length / pieces
        for i, rod in enumerate([0.5 * h, *[h] * (pieces - 1), 0.5 * h]):
            mass = DENSITY * SIDE**2 * rod
            spring = E * SIDE**4 / 12.0 / h if i else 0.0
            hinges.append(revolute(len(bodies) - 1, len(bodies), last, stiffness=spring))
            bodies.append(spo.Body(mass, (0.5 * rod, 0, 0), np.diag([0.0, 1.0, 1.0]) * mass * rod**2 / 12.0))
            last = rod
    hinges.append(weld(len(bodies) - 1, len(bodies), last))
    return spo.Scene([*bodies, spo.Body(0.0)], hinges, gravity=(0, -9.81, 0))


def fall(scene, seconds, dt, **options):
    """Places of the last body every tenth of the time, from rest along x: [10, 2] [m]."""
    dyn = spo.Dynamics(scene, 1, "cpu", "float64", **options)
    q, qd, steps, places = scene.neutral_q[None].copy(), np.zeros((1, scene.dof_count)), round(seconds / dt), []
    for step in range(1, steps + 1):
        q, qd = dyn.step(q, qd, None, dt, options=spo.StepOptions(integrator="midpoint"))
        if step % (steps // 10) == 0:
            places.append(dyn.body_poses(q)[0, -1, :2])
    return np.array(places)


@pytest.mark.slow
def test_a_flexible_arm_falls_as_a_fine_rigid_discretisation_does():
    """The tip travels 3.5 m in a second; the links bend by 14 mm. Rigid pieces are of second order in their length."""
    soft, fine = fall(flexible_arm(), 1.0, 1e-3), fall(rigid_arm(20), 1.0, 1e-3, granularity="node")
    stiff = fall(flexible_arm(1), 1.0, 1e-3)
    assert np.abs(soft - fine).max() < 5e-4  # measured: 1.8e-4
    assert np.abs(stiff - fine).max() > 1e-3  # one mode a link is not enough: the test sees the shapes


def test_a_flexible_arm_accelerates_as_the_second_implementation_says():
    """Large motions, bent links; emitted code, too."""
    scene, rng = flexible_arm(2), np.random.default_rng(0)
    dyn, traced, twin = spo.Dynamics(scene, 3, "cpu", "float64"), Traced(scene), Twin(scene)
    q, qd = rng.normal(size=(2, 3, scene.dof_count)) * [1.0, 0.1, 0.1, 1.0, 0.1, 0.1]
    tau = rng.normal(size=q.shape)
    found = dyn.forward_dynamics(q, qd, tau)
    np.testing.assert_allclose(traced("forward_dynamics", q=q, qd=qd, tau=tau), found, rtol=1e-10)
    for world in range(3):
        np.testing.assert_allclose(found[world], twin.forward_dynamics(q[world], qd[world], tau[world]), rtol=1e-10)


def test_frames_anywhere_on_a_beam_move_as_massless_bodies_there():
    """On the axis, beside it, and beyond the tip; beside the second implementation's Jacobians."""
    scene, rng = flexible_arm(2), np.random.default_rng(5)
    places = [(0, (0.35, 0.0, 0.0)), (1, (0.5, 0.04, -0.03)), (1, (0.9, 0.02, 0.01))]
    frames = [(body, (*place, *about((0.6, 0.0, 0.8), 0.7))) for body, place in places]
    welds = [spo.Hinge("fixed", body, 3 + i, parent_pose=pose) for i, (body, pose) in enumerate(frames)]
    twin = Twin(spo.Scene([*scene.bodies, *[spo.Body(0.0)] * 3], [*scene.hinges, *welds]))
    dyn = spo.Dynamics(scene, 1, "cpu", "float64")
    q, qd = rng.normal(size=(2, 1, scene.dof_count)) * [1.0, 0.1, 0.1, 1.0, 0.1, 0.1]
    poses, J = dyn.frame_poses(q, frames)[0], dyn.jacobian(q, frames)[0]
    velocities = dyn.frame_velocities(q, qd, frames)[0]
    for i in range(3):
        R, x = twin.poses(q[0])[3 + i]
        np.testing.assert_allclose(poses[i, :3], x, atol=1e-13)
        np.testing.assert_allclose(of_quaternion(*poses[i, 3:]), R, atol=1e-13)
        np.testing.assert_allclose(J[i], twin.jacobian(q[0], 3 + i), atol=1e-12)
        np.testing.assert_allclose(velocities[i], J[i] @ qd[0], atol=1e-12)


@functools.cache
def floating_tree():
    """A free beam that carries another one on a hinge; nothing acts from outside, nothing is damped."""
    trunk = spo.beam_modes(1.0, spo.Section.rectangle(0.03, 0.02), spo.Material(1e3, 2e7), "free", {"y": 2, "z": 1})
    branch = spo.beam_modes(0.8, spo.Section.rectangle(0.02, 0.02), spo.Material(1e3, 2e7), "clamped", 1)
    hinge = spo.Hinge("revolute", 0, 1, axis=(0, 1, 0), parent_pose=(1.0, 0, 0, 0, 0, 0, 1))
    bodies = [spo.Body(*beam.rigid, modes=beam) for beam in (trunk, branch)]
    return spo.Scene(bodies, [spo.Hinge("free", -1, 0), hinge], gravity=(0, 0, 0))


@pytest.mark.slow
def test_a_floating_tree_keeps_energy_and_momentum():
    """For 10 s of midpoint steps of 1 ms: energy 1e-6, momentum by the order of the rule."""
    scene = floating_tree()
    dyn, traced, twin = spo.Dynamics(scene, 1, "cpu", "float64"), Traced(scene), Twin(scene)
    rates = 0.1 * np.random.default_rng(0).normal(size=(1, scene.dof_count))
    rates[0, [6, 7, 8, 10, 11]] *= 0.1  # of the modes
    q, qd = scene.neutral_q[None].copy(), rates
    energy = lambda: (traced("kinetic_energy", q=q, qd=qd) + traced("potential_energy", q=q))[0]  # noqa: E731
    first, momentum, worst = energy(), twin.momentum(q[0], qd[0]), 0.0
    for step in range(10_000):
        q, qd = dyn.step(q, qd, None, 1e-3, options=spo.StepOptions(integrator="midpoint"))
        if step % 100 == 0:
            worst = max(worst, abs(energy() / first - 1.0))
    assert worst < 1e-6  # measured 8.5e-7, of modes of 59 rad/s
    assert np.abs(q[0, 7:10]).max() > 1e-4
    np.testing.assert_allclose(twin.momentum(q[0], qd[0]), momentum, atol=1e-5 * np.abs(momentum).max())


def many_modes(count, lowest=1.0, highest=1e8, tip=0.5):
    """A body on a revolute joint whose modes have stiffnesses from lowest to highest, and a body on its end."""
    rng = np.random.default_rng(count)
    modes = None
    if count:
        moves = 0.1 * rng.normal(size=(6, count))  # of the body, on average
        coupling = np.concatenate([0.5 * moves[:3], 2.0 * moves[3:]])
        modes = spo.Modes(
            moves.T @ coupling + np.eye(count),
            np.geomspace(lowest, highest, count),
            np.geomspace(1e-3 * lowest, 1e-6 * highest, count),
            coupling,
            {1: 0.3 * rng.normal(size=(6, count))},
        )
    body = spo.Body(2.0, (0, 0, 0), 0.5 * np.eye(3), modes=modes)
    carried = spo.Body(tip, (0.1, 0.2, 0.0), 0.1 * tip * np.eye(3))
    return spo.Scene([body, carried], [revolute(-1, 0), revolute(0, 1, 1.0)])


@pytest.mark.parametrize("count", [0, 1, *(pytest.param(count, marks=pytest.mark.slow) for count in (6, 20))])
@pytest.mark.parametrize("dtype", ["float64", pytest.param("float32", marks=pytest.mark.slow)])
def test_stiff_modes_are_implicit_in_the_step(count, dtype):
    """Modal stiffness 1 to 1e8 at steps of 1 ms: each step solves (M + h D + h^2 K) qdd = forces at q + h qd."""
    scene, h, worlds = many_modes(count), 1e-3, 2
    rng = np.random.default_rng(1)
    K, D = scene.values["joint_stiffness"][0], scene.values["joint_damping"][0]
    state = rng.normal(size=(2, worlds, scene.dof_count)) / np.sqrt(1.0 + K)
    q, qd = state.astype(dtype).astype(np.float64)
    dyn, twin = spo.Dynamics(scene, worlds, "cpu", dtype), Twin(scene)
    q_next, qd_next = dyn.step(q, qd, None, h)
    for world in range(worlds):
        M = twin.mass_matrix(q[world]) + np.diag(h * D + h**2 * K)
        forces = -K * (q[world] + h * qd[world]) - D * qd[world] - twin.bias_force(q[world], qd[world])
        expected = qd[world] + h * np.linalg.solve(M, forces)
        np.testing.assert_allclose(qd_next[world], expected, atol=LAW[dtype] * np.abs(expected).max())
    for _ in range(200):
        q_next, qd_next = dyn.step(q_next, qd_next, None, h)
    assert np.isfinite(q_next).all() and np.abs(qd_next).max() < 50.0


@pytest.mark.parametrize("tip", [1e-6, 1e6])
@pytest.mark.parametrize("stiffness", [1e-6, 1e12])
def test_extreme_ratios_of_mass_and_stiffness(tip, stiffness):
    """Accelerations, put back into inverse dynamics, give the forces: a small backward error at any condition."""
    scene = many_modes(4, stiffness, 10 * stiffness, tip)
    traced, rng = Traced(scene), np.random.default_rng(2)
    q, qd, tau = 0.3 * rng.normal(size=(3, 4, scene.dof_count))
    tau = tau + traced("passive_force", q=q, qd=qd)
    qdd = traced("forward_dynamics", q=q, qd=qd, tau=tau)
    sizes = np.einsum("wij,wj->wi", np.abs(traced("mass_matrix", q=q)), np.abs(qdd)) + np.abs(tau)
    back = traced("inverse_dynamics", q=q, qd=qd, qdd=qdd)
    assert np.isfinite(qdd).all() and (np.abs(back - tau) <= 1e-10 * sizes.max(axis=1, keepdims=True)).all()


@pytest.mark.slow
def test_bodies_of_no_few_and_twenty_modes_in_one_tree():
    """Sizes of nodes from 6 to 26; the second implementation agrees in every entry."""
    rng, section, material = np.random.default_rng(4), spo.Section.rectangle(0.02, 0.03), spo.Material(1e3, 1e7)
    counts = (0, 20, 1, 6, 0, 3)
    bodies, hinges = [], []
    for k, count in enumerate(counts):
        spread = {"y": (count + 1) // 2, "z": count // 2}
        beam = None if count == 0 else spo.beam_modes(0.6, section, material, "clamped", spread, points=8)
        bodies.append(
            spo.Body(0.3, (0.1, 0, 0), 0.01 * np.eye(3)) if beam is None else spo.Body(*beam.rigid, modes=beam)
        )
        axis = rng.normal(size=3)
        place = (0.4 if k else 0.0, 0, 0, 0, 0, 0, 1)
        hinges.append(
            spo.Hinge("revolute", (k - 1) // 2 if k else -1, k, axis=axis / np.linalg.norm(axis), parent_pose=place)
        )
    scene = spo.Scene(bodies, hinges)
    assert scene.node_sizes == tuple(6 + count for count in counts)
    traced, twin = Traced(scene), Twin(scene)
    q, qd = rng.normal(size=(2, scene.dof_count)) * np.where(scene.values["joint_stiffness"][0] > 0.0, 0.01, 1.0)
    mass, bias = twin.mass_matrix(q), twin.bias_force(q, qd)
    np.testing.assert_allclose(traced("mass_matrix", q=q[None])[0], mass, atol=1e-12 * np.abs(mass).max())
    found = traced("bias_force", q=q[None], qd=qd[None])[0]
    np.testing.assert_allclose(found, bias, atol=1e-11 * np.abs(bias).max())
    qdd = traced("forward_dynamics", q=q[None], qd=qd[None])[0]
    np.testing.assert_allclose(mass @ qdd, -bias, atol=1e-9 * np.abs(bias).max())
