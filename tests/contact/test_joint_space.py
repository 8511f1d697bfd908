"""Bodies that touch, solved in joint space: the passes beside the dense ones, slots, and text that does not grow."""

import functools
import re

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import pair_scenes
from support.pair_scenes import H, box, cube, free, mixed, mixed_states
from warp_spo.dynamics.stepping.joint_space import JointSpaceStep
from warp_spo.errors import UnsupportedError
from warp_spo.examples import grasp
from warp_spo.kernels import joint_space
from warp_spo.reference.body_contact import PairStep

EXACT = 1e-10  # of velocities over the largest one and of forces over the largest one, in float64; 1e-12 measured
FOLLOWED = 1e-9  # of velocities and coordinates after 25 steps; see EXACT, and what steps make of it
FLOAT32 = 1e-4  # the same of velocities in float32, of the whole step with its poses; 2e-5 measured
REFINED = 3e-5  # of the passes alone in float32, from the same masses, poses and points; 1e-5 measured


def without_ground(scene):
    """The pairs of ``mixed``, whose partners bring their own shapes."""
    contacts = [c for c in scene.contacts if c.other is not None]
    own = box(2, 0.06)
    found = []
    for c in contacts:
        given = {name: getattr(c, name) for name in ("stiffness", "damping", "friction", "eps")}
        name = next(
            name for name in ("point", "sphere", "capsule", "box", "hull") if getattr(c, name, None) is not None
        )
        other = own if isinstance(c.other, int) else c.other
        found.append(spo.Contact(c.body, **{name: getattr(c, name)}, other=other, **given))
    return scene.with_contacts(found)


def pinch(worlds=4):
    """A Panda that presses a cube with 40 N; the cube's ground is left out."""
    scene = grasp.scene()
    scene, rng = scene.with_contacts(scene.contacts[1:]), np.random.default_rng(0)
    q = np.tile(scene.neutral_q, (worlds, 1))
    q[:, :7] = [0.0, 0.55, 0.0, -2.13, 0.0, 2.69, 0.785] + 0.1 * rng.normal(size=(worlds, 7))
    q[:, 7:9] = grasp.CUBE - 1e-4
    q[:, 9:16] = spo.Dynamics(scene, worlds, "cpu", "float64").frame_poses(q, [grasp.TIP])[:, 0]
    tau = np.zeros((worlds, scene.dof_count))
    tau[:, 7:9] = -grasp.FORCE
    return scene, np.float64(np.float32(q)), np.float64(np.float32(0.02 * rng.normal(size=tau.shape))), tau


def arms(worlds=4):
    scene, (q, qd) = without_ground(mixed()), mixed_states(0, worlds)
    return scene, q, qd, np.zeros_like(qd)


CASES = {"pinch": pinch, "arms": arms}


@functools.cache
def made(name, worlds, device, dtype, **options):
    scene, *state = CASES[name](worlds)
    dyn = spo.Dynamics(scene, worlds, device, dtype)
    return JointSpaceStep(dyn, near=10, slots=40, margin=0.05, **options), state


def stepped(solver, q, qd, tau, passes=4):
    """Return rates after the step, forces, excess."""
    given = [wp.array(x, dtype=solver.dyn.dtype, device=solver.device) for x in (q, qd, tau)]
    target = np.tile(solver.dyn.scene.neutral_q, (len(q), 1))
    aim = wp.array(target, dtype=solver.dyn.dtype, device=solver.device)
    solver.step(*given, (aim, None), H, passes=passes)
    return solver.qd_out.numpy(), solver.contact_f.numpy(), solver.excess.numpy()


@pytest.mark.parametrize("name", CASES)
def test_passes_are_the_dense_ones(device, name):
    solver, (q, qd, tau) = made(name, 4, str(device), "float64")
    for passes in (1, 3, 4):
        v, forces, excess = stepped(solver, q, qd, tau, passes)
        assert (solver.status.numpy() == 0).all()
        for w in range(len(q)):
            at = PairStep(solver.dyn.scene, q[w], qd[w], H)
            wanted = at.run(tau[w], passes=passes)[1]
            most = np.abs(wanted.f).max()
            assert wanted.on.any() and most > 1.0
            np.testing.assert_allclose(v[w], wanted.v, atol=EXACT * np.abs(wanted.v).max())
            np.testing.assert_allclose(forces[w], at.reports(wanted)[0], atol=EXACT * most)
            np.testing.assert_allclose(excess[w], wanted.excess, atol=EXACT * most)


@pytest.mark.slow
def test_fingers_that_slide_pull_a_cube_as_the_dense_steps_do(device):
    """25 steps in which pads close on a cube, and an arm falls with it."""
    solver, (q, qd, tau) = made("pinch", 4, str(device), "float64")
    scene, dense_q, dense_v = solver.dyn.scene, q[0], qd[0]
    for _ in range(25):
        qd = stepped(solver, q, qd, tau)[0].copy()
        q = solver.dyn.integrate(q, qd, H)
        dense_q, found = PairStep(scene, dense_q, dense_v, H).run(tau[0], passes=4)
        dense_v = found.v
    assert np.abs(dense_v[:7]).max() > 0.5
    np.testing.assert_allclose(qd[0], dense_v, atol=FOLLOWED * np.abs(dense_v).max())
    np.testing.assert_allclose(q[0], dense_q, atol=FOLLOWED)


def test_float32_is_refined(device):
    """A pinch ties an arm to a cube by dampers a thousand times their masses, which cancel in the matrix."""
    solver, (q, qd, tau) = made("pinch", 4, str(device), "float32")
    v = stepped(solver, q, qd, tau)[0]
    exact, _ = made("pinch", 4, str(device), "float64")
    wanted = stepped(exact, q, qd, tau)[0]
    size = np.abs(wanted).max(axis=1, keepdims=True)
    assert (np.abs(v - wanted) < FLOAT32 * size).all()
    for name in ("mass", "bias", "poses", "touches"):
        setattr(exact, name, wp.array(getattr(solver, name).numpy(), dtype=wp.float64, device=device))
    exact.near = solver.near
    given = [wp.array(x, dtype=wp.float64, device=device) for x in (q, qd, tau)]
    aim = wp.array(np.tile(exact.dyn.scene.neutral_q, (4, 1)), dtype=wp.float64, device=device)
    exact.solve(*given, (aim, None), H)
    assert (np.abs(v - exact.qd_out.numpy()) < REFINED * size).all()
    made.cache_clear()


def test_bits_do_not_depend_on_other_worlds(device):
    """A world alone, and, on a GPU, with any number of lanes."""
    solver, (q, qd, tau) = made("pinch", 4, str(device), "float32")
    found = stepped(solver, q, qd, tau)
    alone, _ = made("pinch", 1, str(device), "float32")
    for w in range(4):
        for one, all_of in zip(stepped(alone, q[w : w + 1], qd[w : w + 1], tau[w : w + 1]), found, strict=True):
            np.testing.assert_array_equal(one[0], all_of[w])
    for lanes in (8, 16, 32) if device.is_cuda else ():
        other, _ = made("pinch", 4, str(device), "float32", lanes=lanes)
        for one, all_of in zip(stepped(other, q, qd, tau), found, strict=True):
            np.testing.assert_array_equal(one, all_of)


def test_the_deepest_points_stay(device):
    """A cube lies tilted on another one with four points, for which there are two slots."""
    scene = free([cube(1.0, 0.05), cube(1.0, 0.05)], [box(1, 0.05, other=box(0, 0.05), stiffness=1e4, damping=10.0)])
    q = np.zeros((2, 14))
    q[:, 6] = q[:, 13] = 1.0
    q[:, 9] = 0.0995
    q[1, 10:14] = [0.0, np.sin(1e-3), 0.0, np.cos(1e-3)]
    solver = JointSpaceStep(spo.Dynamics(scene, 2, device, "float64"), near=1, slots=2)
    given = [wp.array(x, dtype=wp.float64, device=device) for x in (q, np.zeros((2, 12)), np.zeros((2, 12)))]
    solver.step(*given, (given[0], None), H, passes=1)
    assert (solver.status.numpy() == spo.Status.SLOTS).all() and joint_space.SLOTS == spo.Status.SLOTS
    depth = solver.touches.numpy().reshape(2, 8, 7)[:, :4, 6]
    kept = np.sort(depth, axis=1)[:, 2:]
    # one pass, no velocity: both points together lift the cube by k p / 4 each, less what the dampers take
    assert (kept >= depth.min(axis=1, keepdims=True)).all()
    assert (solver.qd_out.numpy()[:, 8] > 0.0).all()
    turned = solver.qd_out.numpy()[1, 10]  # the deepest two lie on one side, and turn it back
    assert abs(turned) > 1e-3 and turned < 0.0


def test_the_text_does_not_grow_with_pairs(monkeypatch):
    """Kernels of 2 and of 400 pairs differ in numbers alone."""
    texts = []
    monkeypatch.setattr(joint_space.native, "kernel", lambda name, text, *args, **more: texts.append(text))
    for pairs in (2, 400):
        sizes = joint_space.Sizes(22, 11, 61, pairs, pairs, 5, 16, 24)
        joint_space.solver.__wrapped__(sizes, wp.float32)
    assert re.sub(r"\d+", "0", texts[0]) == re.sub(r"\d+", "0", texts[1])


def test_hinges_without_an_axis_are_refused():
    scene = grasp.scene()
    hinges = [*scene.hinges[:-1], spo.Hinge("universal", -1, scene.hinge_of[-1], axis=((1, 0, 0), (0, 1, 0)))]
    other = spo.Scene(scene.bodies, hinges, contacts=scene.contacts[1:])
    with pytest.raises(UnsupportedError, match="universal hinges where bodies touch in joint space"):
        JointSpaceStep(spo.Dynamics(other, 1, "cpu"))


def test_a_step_of_dynamics_reports_the_same(device):
    """The step with all reports, of a Dynamics that solves its pairs in joint space."""
    solver, (q, qd, _) = made("arms", 4, str(device), "float64")
    dyn = solver.dyn
    try:
        dyn._joint_space = solver
        found = pair_scenes.stepped(dyn, q, qd)
    finally:
        dyn._joint_space = None
    for w in range(4):
        at = PairStep(dyn.scene, q[w], qd[w], H)
        after, wanted = at.run(passes=4)
        f, gap, slip = at.reports(wanted)
        near = found["contact_gap"][w] < joint_space.AWAY
        assert near.sum() >= 2 and (gap[~near] > 0.0).all()
        np.testing.assert_allclose(found["q"][w], after, atol=EXACT)
        np.testing.assert_allclose(found["contact_f"][w], f, atol=EXACT * np.abs(wanted.f).max())
        np.testing.assert_allclose(found["contact_gap"][w, near], gap[near], atol=EXACT)
        np.testing.assert_allclose(found["contact_slip"][w, near], slip[near], atol=EXACT)
        assert found["status"][w] == spo.Status.OK
