"""Bodies that touch, solved in joint space: crowds, flight, fast impacts, and bodies that pass beside each other."""

import numpy as np
import pytest
import warp as wp

import warp_spo as spo
from support.pair_scenes import H, cube, free
from warp_spo.dynamics.stepping.joint_space import JointSpaceStep

EXACT = 1e-13  # of coordinates and rates of size 10 in float64, of the same step by other code; 1e-15 measured
FAST = 1e-4  # of rates in float32 over the speed of an impact; 7e-6 measured

SLOWED, SKIPS = 0.005, 0.05
"""Share of its speed, and speed along z [m/s], that a body takes at a seam; 0.0015 and 0.013 measured, 0.25 to 10 m/s.
Without a test of whether bodies pass they are up to 1.4 and 1.5, and a box stops."""


def test_the_nearest_pairs_stay_where_the_list_is_too_short(device):
    """Balls in a table by so many millimetres; the last one is above it, and fast enough to be near in this step."""
    depths, room = 1e-3 * np.array([[1.0, 2.0, 2.0, 3.0, 2.0, -20.0], [3.0, 1.0, -1.0, 1.0, 0.5, -20.0]]), 3
    kept = [[1, 2, 3], [0, 1, 3]]  # the deepest; of equal ones the first
    table = spo.Contact(-1, box=((2.0, 2.0, 0.5), (0.0, 0.0, -0.5, 0.0, 0.0, 0.0, 1.0)))
    balls = [spo.Contact(i, sphere=0.05, other=table, stiffness=1e4, damping=0.0) for i in range(6)]
    scene = free([cube(1.0, 0.05)] * 6, balls)
    q, qd = np.tile(scene.neutral_q, (2, 1)), np.zeros((2, scene.dof_count))
    q[:, ::7], q[:, 2::7], qd[:, 32] = 0.2 * np.arange(6), 0.05 - depths, -20.0
    for dtype in ("float32", "float64"):
        dyn = spo.Dynamics(scene, 2, device, dtype)
        dyn._joint_space = JointSpaceStep(dyn, near=room, slots=6)
        status, force = np.zeros(2, np.int32), dyn.step_report("contact_f", like=q)
        dyn.step(q, qd, None, H, status=status, report=force)
        lists = dyn._joint_space.near.numpy().reshape(2, -1)
        assert lists[:, 0].tolist() == [6, 6] and lists[:, 1 : 1 + room].tolist() == kept
        assert (status == spo.Status.SLOTS).all()
        assert [np.flatnonzero(each).tolist() for each in force.contact_f[:, :, 2]] == kept


def test_bodies_that_touch_nothing_move_as_without_contacts(device):
    """One that tumbles about a CoM beside its frame, one about a ball joint, an arm, and one that flies off the arm."""
    slim, worlds, rng = np.diag([0.001, 0.01, 0.01]), 4, np.random.default_rng(0)
    bodies = [spo.Body(2.0, com=(0.02, 0.01, 0.0), inertia=slim), *(spo.Body(1.0, inertia=slim) for _ in range(3))]
    bodies.append(spo.Body(1.0, inertia=np.diag([0.002, 0.01, 0.011])))
    hinges = [spo.Hinge("free", -1, 0), spo.Hinge("ball", -1, 1), spo.Hinge("revolute", -1, 2, axis=(0, 1, 0)),
              spo.Hinge("revolute", 2, 3, axis=(1, 0, 0)), spo.Hinge("free", 2, 4)]  # fmt: skip
    apart = spo.Contact(0, sphere=0.03, other=spo.Contact(1, sphere=0.03))
    alone, scene = (spo.Scene(bodies, hinges, contacts=contacts) for contacts in ([], [apart]))
    q, qd = np.tile(scene.neutral_q, (worlds, 1)), 4.0 * rng.normal(size=(worlds, scene.dof_count))
    turn = rng.normal(size=(worlds, 4))
    q[:, 0], q[:, 3:7] = 50.0, turn / np.linalg.norm(turn, axis=1)[:, None]
    found = []
    for each in (alone, scene):
        dyn = spo.Dynamics(each, worlds, device, "float64")
        if each is scene:
            dyn._joint_space = JointSpaceStep(dyn)
        report = dyn.step_report("qdd", like=q)
        found.append((*dyn.step(q, qd, None, H, report=report), H * report.qdd))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, atol=EXACT)
    given = [wp.array(x, dtype=wp.float64, device=device) for x in (q, qd)]
    dyn.step(*given, None, H, out=tuple(given))
    for one, other in zip(given, found[1], strict=False):
        np.testing.assert_array_equal(one.numpy(), other)


def test_fast_impacts_are_finite_in_float32(device):
    """A box of 1 kg flies square against one of 8 kg, whose friction then resists millions of times their masses."""
    bodies, half = [cube(1.0, 0.05), cube(8.0, 0.1)], ((0.05,) * 3, (0.1,) * 3)
    scene = free(bodies, [spo.Contact(0, box=half[0], other=spo.Contact(1, box=half[1]))])
    speed, rng = np.repeat([10.0, 20.0, 40.0], 12), np.random.default_rng(0)
    q, qd = np.tile(scene.neutral_q, (len(speed), 1)), np.zeros((len(speed), 12))
    q[:, 0], qd[:, 0] = -0.151 - 0.01 * speed * rng.uniform(0.0, 1.0, len(speed)), speed
    qd[::2] += 0.01 * rng.normal(size=qd[::2].shape)
    q, qd, found = *(np.float64(np.float32(x)) for x in (q, qd)), {}
    for dtype in ("float32", "float64"):
        dyn = spo.Dynamics(scene, len(speed), device, dtype)
        dyn._joint_space, state = JointSpaceStep(dyn), (q, qd)
        for _ in range(3):
            status = np.zeros(len(speed), np.int32)
            state = dyn.step(*state, None, 0.01, status=status)
            assert not np.isin(status, [spo.Status.PIVOT, spo.Status.NOT_FINITE]).any()
        found[dtype] = state[1]
    error = np.abs(found["float32"] - found["float64"]).max(axis=1) / speed
    assert (error < FAST).all()


def seam(step=0.0):
    """A box, a ball and a roller on the first of two tables, of which the second one is higher by ``step`` [m].

    They lie as deep as their weight presses them, below the other table's top. Returns the scene and a row of q.
    """
    tops = {-8.0: -0.5, 8.0: -0.5 + step}
    tables = [spo.Contact(-1, box=((8.0, 2.0, 0.5), (x, 0.0, z, 0.0, 0.0, 0.0, 1.0))) for x, z in tops.items()]
    shapes = [dict(box=(0.05,) * 3), dict(sphere=0.05), dict(capsule=((0.0, -0.1, 0.0), (0.0, 0.1, 0.0), 0.05))]
    contacts = [spo.Contact(i, **shapes[i], other=table, friction=0.0) for i in range(3) for table in tables]
    scene = free([cube(1.0, 0.05)] * 3, contacts).with_values(gravity=np.array([0.0, 0.0, -9.81]))
    q = scene.neutral_q.copy()
    q[1::7], q[2::7] = [-1.0, 0.0, 1.0], 0.05 - 9.81 / scene.values["contact_stiffness"][0, ::2]
    return scene, q


def slide(dyn, q, qd):
    """Return the least speed along x, and the largest along z, of each body in 60 steps [world, body]."""
    least, most = np.full((len(q), 3), np.inf), np.zeros((len(q), 3))
    for _ in range(60):
        q, qd = dyn.step(q, qd, None, H)
        least, most = np.minimum(least, qd[:, ::6]), np.maximum(most, np.abs(qd[:, 2::6]))
    return least, most


def test_bodies_pass_over_seams_and_edges(device):
    """A box, a ball and a roller slide over the seam of two tables, and fly 1 cm over the edge of one.

    Nothing should happen.
    """
    scene, row = seam()
    speed = np.array([1.0, 3.0, 5.0, 3.0, 10.0])
    q, qd = np.tile(row, (5, 1)), np.zeros((5, 18))
    q[:, ::7], qd[:, ::6] = -0.1 - 0.3 * H * speed[:, None], speed[:, None]
    q[0, ::7] = -0.1  # comes to the seam at the end of a step
    q[3:, ::7], q[3:, 2::7] = q[3:, ::7] - 16.0, 0.06
    dyn = spo.Dynamics(scene, 5, device, "float64", variable=("gravity",))
    dyn._joint_space = JointSpaceStep(dyn)
    dyn.set(gravity=scene.values["gravity"] * (np.arange(5) < 3)[:, None])
    least, most = slide(dyn, q, qd)
    assert (least[3:] == speed[3:, None]).all() and (most[3:] == 0.0).all()
    assert (least > (1.0 - SLOWED) * speed[:, None]).all() and (most < SKIPS).all()


@pytest.mark.parametrize("step", [0.0, 1e-6, -1e-6])
def test_where_a_step_ends_before_a_seam_does_not_matter(step, device):
    """Steps end from 1e-17 to 5e-3 m before and behind the places where faces and centres meet the seam.

    A point of a side is one that may push where it lies up to g h^2 / 2, here 0.12 mm, beyond what its speed reaches.
    """
    scene, row = seam(step)
    ways = [1e-17, 3e-17, 1e-16, 1e-15, 1e-12, 1e-9, 1e-7, 1e-6, 1e-5, 1e-4, 3e-4, 6e-4, 1e-3, 2e-3, 3e-3, 4e-3, 5e-3]
    ways = np.array([0.0, *ways, *(-x for x in ways)])
    speed = np.concatenate([np.ones(len(ways)), np.geomspace(0.25, 10.0, 80), [1.5227607013933415]])
    q, qd = np.tile(row, (len(speed), 1)), np.zeros((len(speed), 18))
    q[:, ::7], qd[:, ::6] = -0.1, speed[:, None]
    q[: len(ways), ::7] += ways[:, None]
    dyn = spo.Dynamics(scene, len(speed), device, "float64")
    dyn._joint_space = JointSpaceStep(dyn)
    least, most = slide(dyn, q, qd)
    assert (least > (1.0 - SLOWED) * speed[:, None]).all() and (most < SKIPS).all()


@pytest.mark.parametrize(
    ("step", "slowed"), [(0.002, [1.0, 0.05, 0.03]), (0.005, [1.0, 0.1, 0.1]), (0.02, [1.0, 0.5, 0.3])]
)
def test_a_step_is_no_seam(step, slowed, device):
    """A box does not get over a step at 1 m/s; a ball and a roller are slowed by it. Nine places where steps end."""
    scene, row = seam(step)
    q, qd = np.tile(row, (9, 1)), np.zeros((9, 18))
    q[:, ::7], qd[:, ::6] = -0.1 - np.linspace(0.0, H, 9)[:, None], 1.0
    dyn = spo.Dynamics(scene, 9, device, "float64")
    dyn._joint_space = JointSpaceStep(dyn)
    least, _ = slide(dyn, q, qd)
    assert (least < 1.0 - np.array(slowed)).all()
