"""Bodies that touch, solved in joint space: the passes beside the dense ones, slots, and text that does not grow."""

import functools
import itertools
import re

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support import pair_scenes
from support.actuated import everything
from support.hull_scenes import RAMP
from support.pair_motions import momentum
from support.pair_scenes import H, box, cube, cubes_in_a_row, free, hand, hand_states, mixed, mixed_states, shelf
from support.pair_steps import StepAtPoints, points_of
from warp_spo.dynamics.stepping import joint_space as choice
from warp_spo.dynamics.stepping.joint_space import JointSpaceStep
from warp_spo.examples import grasp
from warp_spo.execution.joint_tables import find_obstacle
from warp_spo.kernels import joint_space
from warp_spo.recursions.contact import joint_system

EXACT = 1e-10  # of velocities over the largest one and of forces over the largest one, in float64; 1e-12 measured
FOLLOWED = 1e-9  # of velocities and coordinates after 25 steps; see EXACT, and what steps make of it
FLOAT32 = 1e-4  # the same of velocities in float32, of the whole step with its poses; 2e-5 measured
REFINED = 3e-5  # of the passes alone in float32, from the same masses, poses and points; 1e-5 measured


def pinch(worlds=4):
    """A Panda that presses a cube with 40 N."""
    scene, rng = grasp.scene(), np.random.default_rng(0)
    q = np.tile(scene.neutral_q, (worlds, 1))
    q[:, :7] = [0.0, 0.55, 0.0, -2.13, 0.0, 2.69, 0.785] + 0.1 * rng.normal(size=(worlds, 7))
    q[:, 7:9] = grasp.CUBE - 1e-4
    q[:, 9:16] = spo.Dynamics(scene, worlds, "cpu", "float64").frame_poses(q, [grasp.TIP])[:, 0]
    tau = np.zeros((worlds, scene.dof_count))
    tau[:, 7:9] = -grasp.FORCE
    return scene, np.float64(np.float32(q)), np.float64(np.float32(0.02 * rng.normal(size=tau.shape))), tau


def arms(worlds=4):
    """Every kind of pair, drives with limits, the ground."""
    q, qd = mixed_states(0, worlds)
    return mixed(), q, qd, np.zeros_like(qd)


def fingers(worlds=4):
    q, qd = hand_states(0, worlds)
    return hand(), q, qd, np.zeros_like(qd)


def joints(worlds=4):
    """A chain by hinges of several kinds, one with the rotor of its motor, that meets a cube and the ground."""
    pose = (0.0, 0.0, -0.2, 0.0, 0.0, 0.0, 1.0)
    kinds = [dict(kind="revolute", axis=(0, 1, 0), rotor=spo.Rotor(20.0, 2e-4)),
             dict(kind="universal", axis=((1, 0, 0), (0, 1, 0))), dict(kind="helical", axis=(0, 0, 1), pitch=0.05),
             dict(kind="ball")]  # fmt: skip
    hinges = [spo.Hinge(one.pop("kind"), i - 1, i, parent_pose=pose, armature=0.01, damping=0.2, **one)
              for i, one in enumerate(kinds)]  # fmt: skip
    hinges.append(spo.Hinge("free", -1, 4))
    bodies = [*(spo.Body(1.0, (0, 0, -0.1), 0.004 * np.eye(3)) for _ in range(4)), cube(0.7, 0.08)]
    law, tip = dict(stiffness=1e4, damping=20.0), dict(sphere=((0.0, 0.0, -0.2), 0.05))
    contacts = [spo.Contact(3, **tip), *(spo.Contact(i, **tip, other=box(4, 0.08), **law) for i in (1, 3))]
    scene, rng = spo.Scene(bodies, hinges, contacts=contacts, ground=spo.Plane(height=-1.04)), np.random.default_rng(0)
    q, qd = np.tile(scene.neutral_q, (worlds, 1)), 0.5 * rng.normal(size=(worlds, scene.dof_count))
    q[:, :4] = 0.05 * rng.normal(size=(worlds, 4))
    ends = spo.Dynamics(scene, worlds, "cpu", "float64").frame_poses(q, [(3, pose)])[:, 0, :3]
    q[:, -7:-4] = ends + np.array([0.125, 0.0, 0.0])
    return scene, q, qd, np.zeros_like(qd)


CASES = {"pinch": pinch, "arms": arms, "fingers": fingers, "joints": joints}


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
        touching = 0
        v, forces, excess = stepped(solver, q, qd, tau, passes)
        assert np.isin(solver.status.numpy(), [spo.Status.OK, spo.Status.CONTACT]).all()
        for w in range(len(q)):
            at = StepAtPoints(points_of(solver, w), solver.dyn.scene, q[w], qd[w], H)
            wanted, points = at.run(tau[w], passes=passes)[1], len(solver.dyn.scene.contact_points)
            most = max(1.0, np.abs(wanted.f).max())
            touching += wanted.on.any()
            np.testing.assert_allclose(v[w], wanted.v, atol=EXACT * np.abs(wanted.v).max())
            np.testing.assert_allclose(forces[w, points:], at.reports(wanted)[0], atol=EXACT * most)
            pushed = [np.sum(wanted.f[: len(at.numbers)][np.equal(at.numbers, i)], axis=0) for i in range(points)]
            np.testing.assert_allclose(forces[w, :points], np.reshape(pushed, (-1, 3)), atol=EXACT * most)
            np.testing.assert_allclose(excess[w], wanted.excess, atol=EXACT * most)
        assert touching >= 3


@pytest.mark.slow
def test_fingers_that_slide_pull_a_cube_as_the_dense_steps_do(device):
    """25 steps in which pads close on a cube, and an arm falls with it."""
    solver, (q, qd, tau) = made("pinch", 4, str(device), "float64")
    scene, dense_q, dense_v = solver.dyn.scene, q[0], qd[0]
    for _ in range(25):
        qd = stepped(solver, q, qd, tau)[0].copy()
        q = solver.dyn.integrate(q, qd, H)
        found = StepAtPoints(points_of(solver, 0), scene, dense_q, dense_v, H)
        dense_q, found = found.run(tau[0], passes=4)
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
    for name in ("mass", "bias", "screws", "touches", "surfaces"):
        setattr(exact, name, wp.array(getattr(solver, name).numpy(), dtype=wp.float64, device=device))
    exact.near = solver.near
    given = [wp.array(x, dtype=wp.float64, device=device) for x in (q, qd, tau)]
    aim = wp.array(np.tile(exact.dyn.scene.neutral_q, (4, 1)), dtype=wp.float64, device=device)
    exact.solve(*given, (aim, None), H)
    assert (np.abs(v - exact.qd_out.numpy()) < REFINED * size).all()
    made.cache_clear()


def test_bits_do_not_depend_on_other_worlds(device):
    """A world alone, by the kernel for few points or the one for many, and, on a GPU, with any number of lanes."""
    solver, (q, qd, tau) = made("pinch", 4, str(device), "float32")
    found = stepped(solver, q, qd, tau)
    alone, _ = made("pinch", 1, str(device), "float32")
    for w in range(4):
        for one, all_of in zip(stepped(alone, q[w : w + 1], qd[w : w + 1], tau[w : w + 1]), found, strict=True):
            np.testing.assert_array_equal(one[0], all_of[w])
    variants = [dict(few=few) for few in (0, 7, 8, 40)]  # worlds have eight points
    variants += [dict(lanes=lanes, few=8) for lanes in (8, 16, 32)] if device.is_cuda else []
    for options in variants:
        other, _ = made("pinch", 4, str(device), "float32", **options)
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
    assert (solver.status.numpy() == spo.Status.SLOTS).all()
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


def test_words_are_those_of_the_package():
    words = {"CROWDED": spo.Status.SLOTS} | {name: spo.Status[name] for name in ("PIVOT", "NOT_FINITE", "CONTACT")}
    assert words == joint_space.WORDS and joint_system.SURFACE == joint_space.SURFACE


def row(count=7):
    """Cubes side by side on a table, between two that fly towards each other; each may touch each."""
    scene, q, qd = cubes_in_a_row(count)
    half, law = 0.05, dict(stiffness=1e5, damping=50.0)
    table = spo.Contact(-1, box=((4.0, 4.0, 0.1), (0, 0, -0.15, 0, 0, 0, 1)))
    contacts = [box(i, half, other=box(j, half), **law) for i, j in itertools.combinations(range(count), 2)]
    contacts += [box(i, half, other=table, friction=0.4) for i in range(count)]
    heavy = spo.Scene(scene.bodies, scene.hinges, contacts=contacts, gravity=(0.0, 0.0, -9.81))
    return heavy, q - 1e-4 * (np.arange(7 * count) % 7 == 2), qd


@functools.cache
def row_step(device, dtype, **options):
    scene, q, qd = row()
    dyn = spo.Dynamics(scene, 2, device, dtype, **options)
    return dyn, q, qd


def test_users_get_it_where_many_links_are_tied(device):
    """A step of a scene with many pairs, with all reports, beside the dense one at the same points."""
    dyn, q, qd = row_step(str(device), "float64")
    found, dense = pair_scenes.stepped(dyn, q, qd), []
    for w in range(2):
        at = StepAtPoints(points_of(dyn._joint_space, w), dyn.scene, q[w], qd[w], H)
        after, wanted = at.run(passes=4)
        f, gap, slip = at.reports(wanted)
        np.testing.assert_allclose(found["q"][w], after, atol=EXACT)
        np.testing.assert_allclose(found["qd"][w], wanted.v, atol=EXACT)
        np.testing.assert_allclose(found["contact_f"][w], f, atol=EXACT * np.abs(wanted.f).max())
        np.testing.assert_allclose(found["contact_gap"][w], gap, atol=EXACT)
        np.testing.assert_allclose(found["contact_slip"][w], slip, atol=EXACT)
        np.testing.assert_allclose(found["contact_excess"][w], wanted.excess, atol=EXACT * np.abs(wanted.f).max())
        dense.append(wanted.on.sum())
    assert min(dense) >= 28 and (found["status"] == spo.Status.OK).all()
    line = next(line for line in dyn.explain().splitlines() if line.startswith("contacts"))
    assert "28 of 28 pairs may be near each other in a world, and 64 points of them have slots" in line


def test_small_scenes_keep_generated_code():
    dyn = spo.Dynamics(mixed(), 2, "cpu")
    assert dyn._joint_space is None
    assert "pairs of bodies by generated code: few links are tied" in dyn.explain()


def test_each_world_has_values_of_its_own(device):
    """Friction, stiffness, masses, gravity, drives and limits, and targets, loads and wrenches."""
    scene, worlds = mixed(), 3
    names = ("contact_friction", "contact_stiffness", "gravity", "joint_target_ke", "joint_limit_lower",
             "joint_effort_limit", "joint_velocity_limit", "joint_damping")  # fmt: skip
    dyn, rng = spo.Dynamics(scene, worlds, device, "float64", variable=names), np.random.default_rng(1)
    dyn._joint_space = choice.JointSpaceStep(dyn)
    values = {
        name: scene.values[name] * rng.uniform(0.5, 1.5, (worlds, *scene.values[name].shape[1:])) for name in names
    }
    values["joint_limit_lower"][:, 0], values["joint_velocity_limit"][:, 1] = 0.3, 0.1
    dyn.set(**values)
    q, qd = mixed_states(0, worlds)
    shapes = dict(tau=qd.shape[1:], body_f=(6, 6), target_q=q.shape[1:], target_qd=qd.shape[1:])
    given = {name: 3.0 * rng.normal(size=(worlds, *shape)) for name, shape in shapes.items()}
    report = spo.StepReport(qdd=np.zeros_like(qd))
    after, rates = dyn.step(q, qd, dt=H, report=report, **given)
    for w in range(worlds):
        own = scene.with_values(**{name: value[w] for name, value in values.items()})
        at = StepAtPoints(
            points_of(dyn._joint_space, w), own, q[w], qd[w], H, given["target_q"][w], given["target_qd"][w]
        )
        at.neutral = StepAtPoints({}, scene, q[w], qd[w], H).neutral
        wanted_q, wanted = at.run(given["tau"][w], given["body_f"][w], passes=4)
        np.testing.assert_allclose(rates[w], wanted.v, atol=EXACT * np.abs(wanted.v).max())
        np.testing.assert_allclose(after[w], wanted_q, atol=EXACT)
        np.testing.assert_allclose(report.qdd[w], (wanted.v - qd[w]) / H, atol=1e3 * EXACT * np.abs(wanted.v).max())


def pushed(spring):
    """An arm with every kind of actuator and drives within effort limits, whose links touch balls that fly."""
    arm = everything(
        joint_effort_limit=np.array([6.0, 3.0, 1e6]), joint_target_ke=np.full(3, 20.0), joint_target_kd=np.full(3, 0.5)
    )
    count, ball = len(arm.bodies), dict(sphere=0.1)
    hinges = [*arm.hinges, *(spo.Hinge("free", -1, count + i) for i in range(2)), spo.Hinge("ball", count, count + 2)]
    bodies = [*arm.bodies, cube(1.0, 0.1), cube(2.0, 0.1), cube(0.5, 0.1)]
    pairs = [(1, count), (2, count + 1), (count, count + 1), (count + 2, count + 1)]
    law = dict(stiffness=1e4, damping=10.0)
    contacts = [spo.Contact(a, **ball, other=spo.Contact(b, **ball), **law) for a, b in pairs]
    scene = spo.Scene(bodies, hinges, contacts=contacts, actuators=arm.actuators)
    stiff = scene.values["joint_stiffness"].copy()
    stiff[:, -3:] = spring
    values = {name: np.concatenate([arm.values[name], scene.values[name][:, arm.dof_count :]], axis=1)
              for name in ("joint_effort_limit", "joint_target_ke", "joint_target_kd")}  # fmt: skip
    return scene.with_values(**values, joint_stiffness=stiff)


def test_motors_are_those_of_generated_code(device):
    """Actuators with their ranges and curves, drives, their common limit, springs of a ball joint; spheres touch."""
    scene, worlds, rng = pushed(30.0), 20, np.random.default_rng(2)
    q, qd = np.tile(scene.neutral_q, (worlds, 1)), rng.normal(size=(worlds, scene.dof_count))
    q[:, :3] = rng.normal(size=(worlds, 3))
    one = spo.Dynamics(scene, worlds, device, "float64")
    places = one.body_poses(q)
    for free_body, near in ((len(scene.bodies) - 3, 1), (len(scene.bodies) - 2, 2)):
        at = scene.q_start[scene.hinge_of[free_body]]
        way = rng.normal(size=(worlds, 3))
        q[:, at : at + 3] = places[:, near, :3] + 0.195 * way / np.linalg.norm(way, axis=1)[:, None]
    ctrl, target = 4.0 * rng.normal(size=(worlds, len(scene.actuators))), q + 0.5 * rng.normal(size=q.shape)
    target[:, -4:] = q[:, -4:]
    other = spo.Dynamics(scene, worlds, device, "float64")
    other._joint_space = choice.JointSpaceStep(other)
    for given in ({}, dict(ctrl=ctrl), dict(ctrl=ctrl, target_q=target, target_qd=0.5 * qd)):
        found = [pair_scenes.stepped(dyn, q, qd, **given) for dyn in (one, other)]
        assert found[0]["contact_f"].any(axis=2).sum() >= worlds
        scale = np.abs(found[0]["qd"]).max()
        np.testing.assert_allclose(found[1]["qd"], found[0]["qd"], atol=EXACT * scale)
        np.testing.assert_allclose(found[1]["contact_excess"], found[0]["contact_excess"], atol=EXACT * 1e3)
        np.testing.assert_array_equal(found[1]["status"], found[0]["status"])


def test_substeps_are_calls(device):
    """To the bit, with the mean force and the worst status."""
    dyn, q, qd = row_step(str(device), "float64")
    force = dyn.step_report("contact_f", like=q)
    state, mean = (q, qd), 0.0
    for _ in range(3):
        state = dyn.step(*state, None, H, report=force)
        mean = mean + force.contact_f / 3.0
    status = np.zeros(2, np.int32)
    found = dyn.step(q, qd, None, H, options=spo.StepOptions(substeps=3), report=force, status=status)
    for one, other in zip(found, state, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(force.contact_f, mean, rtol=1e-12, atol=1e-12)
    for _ in range(3):  # recorded, and in place
        again = dyn.step(q, qd, None, H, options=spo.StepOptions(substeps=3))
    np.testing.assert_array_equal(again[1], found[1])


def test_nan_stays_in_its_world(device):
    dyn, q, qd = row_step(str(device), "float64")
    clean, bad = pair_scenes.stepped(dyn, q, qd), q.copy()
    bad[0, 4] = np.nan
    found = pair_scenes.stepped(dyn, bad, qd)
    assert found["status"].tolist() == [spo.Status.NOT_FINITE, spo.Status.OK]
    for name in ("q", "qd", "contact_f", "contact_gap"):
        np.testing.assert_array_equal(found[name][1], clean[name][1])


def test_near_pairs_are_chosen_by_boxes(device):
    """A table reaches far beyond each cube; those on it are in the list with it, and those above it are not."""
    dyn, q, qd = row_step(str(device), "float64")
    lifted = q.copy()
    lifted[1, 2::7] += 0.1
    dyn.step(lifted, qd, None, H)
    solver, cubes = dyn._joint_space, 7
    found = solver.near.numpy().reshape(2, -1)[:, 0]
    assert found.tolist() == [cubes - 1 + cubes, cubes - 1]


@pytest.mark.parametrize("shape", [dict(box=(0.1, 0.1, 0.1)), dict(hull=RAMP / 8.0)], ids=["boxes", "hulls"])
def test_bodies_that_are_thrown_at_each_other_gain_nothing(device, shape):
    """Two that spin meet anyhow, without gravity: by edges, corners and faces; momenta stay.

    With points from common parts of faces alone, some of these gain half of their energy.
    """
    rng, worlds, law = np.random.default_rng(1), 100, dict(stiffness=1e5, friction=0.5)
    scene = free([cube(1.0, 0.1), cube(1.5, 0.1)], [spo.Contact(0, **shape, other=spo.Contact(1, **shape), **law)])
    q, qd = np.zeros((worlds, 14)), 0.5 * rng.normal(size=(worlds, 12))
    q[:, 3:7], q[:, 10:] = rng.normal(size=(worlds, 4)), rng.normal(size=(worlds, 4))
    for turn in (q[:, 3:7], q[:, 10:]):
        turn /= np.linalg.norm(turn, axis=1)[:, None]
    way = rng.normal(size=(worlds, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    q[:, 7:10], qd[:, 6:9] = 0.45 * way, -2.0 * way
    dyn = spo.Dynamics(scene, worlds, device, "float64")
    dyn._joint_space = choice.JointSpaceStep(dyn)
    before, first, most, met = momentum(scene, q, qd), dyn.kinetic_energy(q, qd), 0.0, np.zeros(worlds, bool)
    force = dyn.step_report("contact_f", like=q)
    for _ in range(80):
        q, qd = dyn.step(q, qd, None, H, report=force)
        most, met = max(most, (dyn.kinetic_energy(q, qd) / first).max()), met | force.contact_f.any(axis=(1, 2))
    assert met.sum() >= 80 and most < 1.0 + 1e-12
    np.testing.assert_allclose(momentum(scene, q, qd), before, atol=1e-11)


@pytest.mark.parametrize("speed", [2.0, 40.0, 400.0])
def test_a_fast_ball_is_not_missed(device, speed):
    """The ball is in the wall's reach in the step that would carry it into the wall, however fast it comes."""
    wall = spo.Contact(-1, box=((0.02, 1.0, 1.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)))
    scene = free([cube(1.0, 0.05)], [spo.Contact(0, sphere=0.05, other=wall, stiffness=1e5, damping=0.0)])
    dyn = spo.Dynamics(scene, 1, device, "float64")
    solver = choice.JointSpaceStep(dyn)
    q, qd = np.zeros((1, 7)), np.zeros((1, 6))
    q[:, 6], qd[:, 0] = 1.0, -speed
    q[:, 0] = 0.07 + 0.9 * speed * H
    given = [wp.array(x, dtype=wp.float64, device=device) for x in (q, qd)]
    v = solver.step(*given, None, (None, None), H).numpy()[0, 0]
    k, depth = 1e5, -0.9 * speed * H  # m v' = m v + h k (depth - h v')
    assert v == pytest.approx((-speed + H * k * depth) / (1.0 + H * H * k), rel=1e-12)
    assert abs(v) < speed


def crowd(*more, masses=(1.0,) * 7):
    """Seven balls each of which may touch each, too many for generated code, and ``more`` contacts."""
    balls = [spo.Contact(j, sphere=0.1, other=spo.Contact(i, sphere=0.1)) for j in range(7) for i in range(j)]
    bodies = [spo.Body(mass, inertia=0.01 * mass * np.eye(3)) for mass in masses]
    return free(bodies, [*more, *balls])


REFUSED = {
    "torsional friction": (
        lambda: crowd(spo.Contact(0, sphere=0.1, torsional_friction=0.1)), "set contact_torsional_friction to zero"),
    "dofs without inertia": (lambda: crowd(masses=(1.0,) * 6 + (0.0,)), "give their bodies mass"),
    "boxes without thickness": (
        lambda: crowd(spo.Contact(0, box=(0.1, 0.1, 0.0), other=box(1, 0.1))), "give boxes half sizes above zero"),
}  # fmt: skip


@pytest.mark.parametrize("obstacle", REFUSED)
def test_pairs_that_no_step_takes_are_refused_with_a_way_out(obstacle):
    make, way = REFUSED[obstacle]
    scene = make()
    dyn, q = spo.Dynamics(scene, 2, "cpu"), np.tile(scene.neutral_q, (2, 1))
    assert f"no step takes pairs of bodies beside {obstacle}" in dyn.explain()
    with pytest.raises(
        spo.UnsupportedError, match=f"contact between bodies in a scene with {obstacle} .*; {way}.*; or list few"
    ):
        dyn.step(q, np.zeros((2, scene.dof_count)), dt=H)


def test_what_it_does_not_take_has_words():
    """And such scenes keep generated code."""
    scene = grasp.scene()
    assert find_obstacle(scene, ("joint_X_p", "contact_friction")) == ""
    flat = scene.with_contacts([spo.Contact(0, box=(0.1, 0.1, 0.0), other=box(1, 0.1))])
    assert find_obstacle(flat, ()) == "boxes without thickness"
    turns = scene.with_contacts([spo.Contact(0, sphere=0.1, torsional_friction=0.1), *scene.contacts[1:]])
    assert find_obstacle(turns, ()) == "torsional friction" and find_obstacle(shelf(-1), ()) == ""
