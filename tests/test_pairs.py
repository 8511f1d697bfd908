"""Bodies that touch each other: their points, the coupled step against the dense one, and what it conserves."""

import functools
import inspect
import re
import textwrap

import numpy as np
import pytest
import warp as wp
import warp_machine
from pair_scenes import (
    box,
    cube,
    free,
    hand,
    hand_states,
    mixed,
    mixed_states,
    palm,
    ring,
    ring_states,
    shelf,
    shelf_states,
    stack,
    stacked,
    thrown,
)
from pair_touches import find_touches

import warp_spo as spo
from warp_spo import reference_pairs
from warp_spo.dynamics.integrators import CONTACT_STEP, PAIRED_STEP
from warp_spo.examples import grasp
from warp_spo.execution import plan
from warp_spo.execution.device_facts import MEASURED
from warp_spo.kernels import couples, coupling, coupling_blocks, coupling_points, coupling_shared, straight, touches
from warp_spo.recursions.contact import aggregates, coupled, pair_pieces
from warp_spo.reference_pairs import PairStep
from warp_spo.reference_rotations import homogeneous

H, WORLDS = 5e-3, 9
TOLERANCE = {"float64": (1e-10, 1e-9), "float32": (1e-4, 1e-3)}
"""Of velocities, over the largest one, and of forces, over the largest one; 4e-13 and 3e-12, 2e-5 and 2e-4 measured."""


def placed(rng, kind):
    """A random shape of a body, its row in the kernel's table."""
    turn = rng.normal(size=4)
    size = rng.uniform(0.05, 0.2, 3) if kind else np.array([0.0, 0.0, 0.1])
    return np.concatenate([0.05 * rng.normal(size=3), turn / np.linalg.norm(turn), size, [0.0 if kind else 0.08]])


@pytest.mark.parametrize("kinds", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_points_are_those_of_the_reference(device, kinds):
    """Segments, spheres, boxes; half of the boxes nearly aligned."""
    worlds, rng = 100, np.random.default_rng(sum(kinds))
    shapes = np.array([placed(rng, kind) for kind in kinds])
    for row, kind in enumerate(kinds):
        shapes[row, 9] = shapes[row, 9] if kind or kinds == (0, 0) else 0.0
    poses = np.concatenate([0.15 * rng.normal(size=(worlds, 2, 3)), rng.normal(size=(worlds, 2, 4))], axis=2)
    poses[::2, :, 3:] = np.array([0.0, 0.0, 0.02, 1.0])
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=2)[..., None]
    if kinds == (1, 1):
        shapes[:, 3:7] = np.array([0.0, 0.0, 0.0, 1.0])
    size = touches.HEADER + 8 * touches.POINT
    out = wp.full((size, worlds), np.nan, dtype=wp.float64, device=device)
    given = [wp.array(poses, dtype=wp.float64, device=device), wp.array([[0, 1, *kinds, 0]], dtype=int, device=device)]
    given.append(wp.array(shapes, dtype=wp.float64, device=device))
    wp.launch(find_touches(wp.float64), (1, worlds), given, [out], device=device)
    found, counts = out.numpy(), set()
    for w in range(worlds):
        both = [(kind, homogeneous(pose) @ homogeneous(row[:7]), row[7:10], row[10])
                for kind, pose, row in zip(kinds, poses[w], shapes, strict=True)]  # fmt: skip
        wanted = reference_pairs.touches(*both)
        rows = found[touches.HEADER :, w].reshape(-1, touches.POINT)[: 8 if sum(kinds) == 2 else 1]
        rows = rows[rows[:, 6] > touches.AWAY]
        assert len(rows) == len(wanted)
        counts.add(len(wanted))
        found_rows = np.c_[rows[:, :3] + poses[w, 0, :3], rows[:, 3:]]
        for row in np.array([[*point, *normal, depth] for point, normal, depth in wanted]):  # in any order
            nearest = np.abs(found_rows - row).max(axis=1).argmin()
            np.testing.assert_allclose(found_rows[nearest], row, atol=1e-12)
            found_rows = np.delete(found_rows, nearest, axis=0)
    assert counts >= ({4, 5, 6, 7} if sum(kinds) == 2 else {1})


def stepped(dyn, q, qd, **more):
    """One step with all reports, which begin as NaN."""
    count, dtype, worlds = dyn.scene.contact_count, dyn.dtype.__name__, len(q)
    found = {"contact_f": np.full((worlds, count, 3), np.nan, dtype)}
    found |= {name: np.full((worlds, count), np.nan, dtype) for name in ("contact_gap", "contact_slip")}
    found |= {"contact_excess": np.full((worlds, 3), np.nan, dtype), "status": np.full(worlds, -1, np.int32)}
    found["q"], found["qd"] = dyn.step(q.astype(dtype), qd.astype(dtype), None, H, **found, **more)
    return found


def assert_is_dense(dyn, q, qd, passes=None, least=1, **values):
    """A step is the dense one in every world, with ``values`` of the scene; return what it finds."""
    scene = dyn.scene.with_values(**values)
    found, (velocity, force) = stepped(dyn, q, qd, passes=passes), TOLERANCE[dyn.dtype.__name__]
    touching, points = 0, len(dyn.scene.contact_points)
    for w in range(len(q)):
        at = PairStep(scene, q[w], qd[w], H, world=w)
        after, wanted = at.run(passes=passes or 4)
        f, gap, slip = at.reports(wanted)
        most = max(1.0, np.abs(wanted.f).max())
        touching += (np.abs(f).max(axis=1) > 0.0).sum()
        np.testing.assert_allclose(found["qd"][w], wanted.v, atol=velocity * np.abs(wanted.v).max())
        np.testing.assert_allclose(found["q"][w], after, atol=velocity)
        np.testing.assert_allclose(found["contact_f"][w, points:], f, atol=force * most)
        np.testing.assert_allclose(found["contact_gap"][w, points:], gap, atol=1e-6)
        np.testing.assert_allclose(found["contact_slip"][w, points:], slip, atol=velocity * np.abs(wanted.v).max())
        np.testing.assert_allclose(found["contact_excess"][w], wanted.excess, atol=force * most)
    assert touching >= least
    return found


@functools.cache
def mixed_dynamics(device, dtype):
    return spo.Dynamics(mixed(), WORLDS, device=device, dtype=dtype, variable=("contact_friction",))


def test_a_step_is_the_dense_one(device):
    """Every kind of pair, drives with limits, the ground; another friction in each world."""
    dyn, (q, qd) = mixed_dynamics(str(device), "float64"), mixed_states(0, WORLDS)
    friction = np.linspace(0.2, 1.0, WORLDS)[:, None] * np.ones((1, dyn.scene.contact_count))
    dyn.set(contact_friction=friction)
    for passes in (None, 1, 3):
        assert_is_dense(dyn, q, qd, passes, least=WORLDS, contact_friction=friction)


def test_a_hand_is_the_dense_one(device, granularity=None):
    """Limbs on a base, four pairs of which are of the same two bodies, and a world in which nothing touches."""
    q, qd = hand_states(0, 6)
    dyn = spo.Dynamics(hand(), 6, device=device, dtype="float64", granularity=granularity)
    assert_is_dense(dyn, q, qd, least=12)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hand", "mixed"])
def test_limbs_do_what_one_thread_does(device, name):
    """And a world does the same alone as among others, whose bodies may touch where its own do not."""
    scene, states = {"hand": (hand, hand_states), "mixed": (mixed, mixed_states)}[name]
    (q, qd), found = states(1, 6), {}
    for granularity in ("tree", "segment"):
        dyn = spo.Dynamics(scene(), 6, device=device, dtype="float64", granularity=granularity)
        found[granularity] = assert_is_dense(dyn, q, qd)
        alone = spo.Dynamics(scene(), 1, device=device, dtype="float64", granularity=granularity)
        one = stepped(alone, q[-1:], qd[-1:])
        for key in ("q", "qd", "contact_f"):
            np.testing.assert_array_equal(one[key][0], found[granularity][key][-1])
    np.testing.assert_allclose(found["segment"]["qd"], found["tree"]["qd"], atol=1e-11 * np.abs(qd).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hand", "mixed"])
def test_the_response_of_whole_trees_does_the_same(monkeypatch, device, name):
    """Scenes take it whose links share dofs, or whose aggregates would be too long, and whose limbs cannot share."""
    for each in ("suits", "by_limbs"):
        monkeypatch.setattr(pair_pieces, each, lambda scene: False)
    monkeypatch.setattr(coupled, "suits", lambda links: False)
    scene, states = {"hand": (hand, hand_states), "mixed": (mixed, mixed_states)}[name]
    assert_is_dense(spo.Dynamics(scene(), 6, device=device, dtype="float64"), *states(1, 6))


@pytest.mark.slow
def test_a_ring_of_bodies_between_arms(device):
    """Bodies that fly are carried by others, couples close a ring, and two trees meet."""
    assert_is_dense(spo.Dynamics(ring(), 6, device=device, dtype="float64"), *ring_states(0, 6), least=12)


@pytest.mark.slow
@pytest.mark.parametrize("granularity", ["tree", "segment"])
def test_shapes_that_stand_still(device, granularity):
    """Of the inertial frame, as of a body that is fixed there."""
    (q, qd), found = shelf_states(0, 5), {}
    for body in (-1, 2):
        dyn = spo.Dynamics(shelf(body), 5, device=device, dtype="float64", granularity=granularity)
        found[body] = assert_is_dense(dyn, q, qd, least=5)
    assert found[-1]["contact_f"][:, 8:].any(axis=(0, 2)).tolist() == [True, True, False, True]
    for name in ("q", "qd", "contact_f", "contact_slip"):
        np.testing.assert_allclose(found[-1][name], found[2][name], atol=1e-9)
    np.testing.assert_array_equal(shelf(-1).values["contact_stiffness"], shelf(2).values["contact_stiffness"])


@pytest.mark.slow
def test_a_pair_of_the_base_itself(device):
    q, qd = hand_states(2, 4)
    dyn = spo.Dynamics(palm(), 4, device=device, dtype="float64")
    assert_is_dense(dyn, q, qd, least=8)
    assert "a thread computes a whole world" in dyn.explain()


@pytest.mark.slow
def test_a_step_in_float32_is_the_dense_one(device):
    dyn, (q, qd) = mixed_dynamics(str(device), "float32"), mixed_states(0, WORLDS)
    friction = np.full((WORLDS, dyn.scene.contact_count), 0.8)
    dyn.set(contact_friction=friction.astype(np.float32))
    assert_is_dense(dyn, q, qd, least=WORLDS, contact_friction=friction)


def test_nan_stays_in_its_world(device):
    dyn, (q, qd) = mixed_dynamics(str(device), "float64"), mixed_states(0, WORLDS)
    friction = np.full((WORLDS, dyn.scene.contact_count), 0.5)
    dyn.set(contact_friction=friction)
    clean = stepped(dyn, q, qd)
    friction[1, -3], q[2, 4] = np.nan, np.nan
    dyn.set(contact_friction=friction)
    found = stepped(dyn, q, qd)
    assert found["status"].tolist()[1:3] == [spo.Status.NOT_FINITE] * 2 and np.isnan(found["qd"][1:3]).any(axis=1).all()
    for name in ("q", "qd", "contact_f", "status"):
        np.testing.assert_array_equal(np.delete(found[name], [1, 2], axis=0), np.delete(clean[name], [1, 2], axis=0))


def momentum(scene, q, qd):
    """Linear and angular momentum about the origin of free bodies, [world, 6]."""
    total = np.zeros((len(q), 6))
    for b in range(len(scene.bodies)):
        m, inertia = scene.values["body_mass"][0, b], scene.values["body_inertia"][0, b, 0, 0]  # of cubes and balls
        p = m * qd[:, 6 * b : 6 * b + 3]
        total[:, :3] += p
        total[:, 3:] += np.cross(q[:, 7 * b : 7 * b + 3], p) + inertia * qd[:, 6 * b + 3 : 6 * b + 6]
    return total


def head_on(dtype, device, count=60, granularity=None):
    """Two balls that meet off centre, spinning; return the scene and momenta before and after."""
    scene = free([cube(1.0, 0.05), cube(3.0, 0.05)],
                 [spo.Contact(0, sphere=0.05, other=spo.Contact(1, sphere=0.05), stiffness=1e5)])  # fmt: skip
    q = np.zeros((2, 14), dtype)
    q[:, [6, 13]], q[:, 7], q[:, 8] = 1.0, 0.15, [0.0, 0.03]
    qd = np.zeros((2, 12), dtype)
    qd[:, 0], qd[:, 6], qd[:, 3:6] = 1.0, -0.5, 2.0
    before, met = momentum(scene, q, qd), 0.0
    dyn = spo.Dynamics(scene, 2, device=device, dtype=dtype, granularity=granularity)
    force = np.zeros((2, 1, 3), dtype)
    for _ in range(count):
        q, qd = dyn.step(q, qd, None, H, contact_f=force)
        met = max(met, np.abs(force).max())
    assert met > 10.0
    return before, momentum(scene, q, qd), np.linalg.norm(q[:, 7:10] - q[:, :3], axis=1)


def test_a_collision_keeps_momentum(device):
    """The impulses are equal and opposite at one point."""
    before, after, apart = head_on("float64", device)
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=1e-12 * np.abs(before).max())
    np.testing.assert_allclose(after[0, 3:], before[0, 3:], atol=1e-12)
    assert (apart > 0.09).all()  # they have not passed through each other


def test_every_array_of_a_thread_has_entries(device, monkeypatch):
    """Also where no hinge has a law with bounds; compilers for CUDA refuse an array without entries."""
    texts, assemble = [], straight.assemble
    monkeypatch.setattr(straight, "assemble", lambda *given: texts.append(assemble(*given)) or texts[-1])
    head_on("float64", device, granularity="tree")
    assert any("couples::judge" in text for text in texts) and not any("[0] = {}" in text for text in texts)


@pytest.mark.slow
def test_a_collision_keeps_momentum_in_float32(device):
    before, after, _ = head_on("float32", device)
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=1e-6 * np.abs(before).max())


WALLS = (
    [((x, 0, 0), 0) for x in (-0.2, 0.2)]
    + [((0, y, 0), 1) for y in (-0.2, 0.2)]
    + [((0, 0, z), 2) for z in (-0.2, 0.2)]
)


def cage(dtype, device, count):
    """A ball in a free cage of six boxes; return momenta before and after, and how often it met a wall."""
    walls = []
    for place, axis in WALLS:
        half = [0.2, 0.2, 0.2]
        half[axis] = 0.02
        walls.append(dict(box=(half, (*place, 0, 0, 0, 1))))
    contacts = [
        spo.Contact(1, sphere=0.05, other=spo.Contact(0, **wall), stiffness=1e5, damping=10.0) for wall in walls
    ]
    scene = free([cube(2.0, 0.2), cube(1.0, 0.05)], contacts)
    q, qd = np.zeros((1, 14), dtype), np.zeros((1, 12), dtype)
    q[:, [6, 13]], qd[0, 6:9] = 1.0, [2.0, 1.3, 0.7]
    before, dyn, met = momentum(scene, q, qd), spo.Dynamics(scene, 1, device=device, dtype=dtype), 0
    force = np.zeros((1, 6, 3), dtype)
    for _ in range(count):
        q, qd = dyn.step(q, qd, None, H, contact_f=force)
        met += np.abs(force).max() > 0.0
    return before, momentum(scene, q, qd), met


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "bound"), [("float64", 1e-12), ("float32", 1e-6)])
def test_a_ball_in_a_free_cage(device, dtype, bound):
    before, after, met = cage(dtype, device, 400)
    assert met > 5
    np.testing.assert_allclose(after[:, :3], before[:, :3], atol=bound * np.abs(before).max())


def stand(scene, q, settle, seconds, device, dtype="float64"):
    """Let bodies come to rest; return largest speed and drift [m] after ``settle`` seconds, q and the last forces."""
    dyn, q = spo.Dynamics(scene, 1, device=device, dtype=dtype), np.array(q, dtype)[None]
    qd, force, fastest, drift = (
        np.zeros((1, scene.dof_count), dtype),
        np.zeros((1, scene.contact_count, 3), dtype),
        0,
        0,
    )
    for i in range(round((settle + seconds) / H)):
        q, qd = dyn.step(q, qd, None, H, contact_f=force)
        if i == round(settle / H):
            first = q
        if i > settle / H:
            place = (q - first).reshape(-1, 7)[:, :3]
            fastest, drift = max(fastest, np.abs(qd).max()), max(drift, np.abs(place).max())
    return fastest, drift, q[0], force[0]


@pytest.mark.slow
def test_a_stack_stands(device):
    """Five cubes, offset and turned: 10 s."""
    scene = stack()
    fastest, drift, _, force = stand(scene, stacked(5), 5.0, 10.0, device)
    assert fastest < 1e-5 and drift < 1e-4
    carried = 9.81 * 5.0 * np.arange(5, 0, -1)
    np.testing.assert_allclose(np.append(force[:8, 2].sum(), force[8:, 2]), carried, rtol=1e-4)


@pytest.mark.slow
def test_a_heavy_cube_on_light_ones(device):
    """100 kg on four of 1 kg, as deep as springs say."""
    masses = (1.0, 1.0, 1.0, 1.0, 100.0)
    scene = stack(masses, ground=1e6, stiffness=1e6, damping=4e3)
    fastest, _, q, force = stand(scene, stacked(5, offset=0.0), 3.0, 0.5, device)
    carried = 9.81 * np.cumsum(masses[::-1])[::-1]
    np.testing.assert_allclose(force[8:, 2], carried[1:], rtol=1e-4)
    sunk = carried[0] / 8e6 * 2.0 + (carried[1:] / 1e6).sum()  # four corners carry the lowest
    assert fastest < 1e-4
    np.testing.assert_allclose(0.9 - q[30], sunk, rtol=0.02)


def row(count):
    """Cubes side by side in a row between two that fly towards each other: ``count`` - 1 pairs touch."""
    half = 0.05
    contacts = [box(i, half, other=box(i - 1, half), stiffness=1e5, damping=50.0) for i in range(1, count)]
    scene = free([cube(1.0, half) for _ in range(count)], contacts)
    q, qd = np.zeros((2, 7 * count)), np.zeros((2, 6 * count))
    q[:, ::7] = 2.0 * half * np.arange(count) - 1e-5 * np.arange(count)
    q[:, 6::7] = 1.0
    qd[:, 0], qd[:, -6], qd[1, 1::6] = 0.5, -0.5, 0.02 * np.arange(count)
    return scene, q, qd


@pytest.mark.slow
@pytest.mark.parametrize("together", [True, False])
def test_more_pairs_than_are_solved_together(monkeypatch, device, together):
    """Aggregates solve all; otherwise eight are exact, ten as near as the residual says. Momentum is kept."""
    for module in (coupled, pair_pieces):
        monkeypatch.setattr(module, "suits", lambda links: together)
    for count, pairs in ((9, 8), (11, 10)):
        scene, q, qd = row(count)
        dyn, residual = spo.Dynamics(scene, 2, device=device, dtype="float64"), np.full(2, np.nan)
        found = stepped(dyn, q, qd, contact_residual=residual)
        for w in range(2):
            _, wanted = PairStep(scene, q[w], qd[w], H).run(passes=4)
            most, error = np.abs(wanted.f).max(), np.abs(found["qd"][w] - wanted.v).max()
            if together or pairs <= coupling.EXACT:
                assert residual[w] == 0.0 and error < 1e-10
            else:
                assert 0.0 < residual[w] < 1e-5 * most and error < 1e-5  # 8e-6 N and 2e-6 m/s
        before, after = momentum(scene, q, qd), momentum(scene, found["q"], found["qd"])
        np.testing.assert_allclose(after[:, :3], before[:, :3], atol=1e-12)


def legs(contacts=True):
    """A free trunk and two legs of two links, without gravity; their links touch each other."""
    bodies, hinges = [cube(7.0, 0.15)], [spo.Hinge("free", -1, 0)]
    for y in (0.1, -0.1):
        thigh = len(bodies)
        bodies += [spo.Body(1.0, (0, 0, -0.1), 4.3e-3 * np.eye(3)), spo.Body(0.5, (0, 0, -0.1), 1.6e-3 * np.eye(3))]
        hinges += [spo.Hinge("ball", 0, thigh, parent_pose=(0, y, -0.1, 0, 0, 0, 1)),
                   spo.Hinge("revolute", thigh, thigh + 1, axis=(0, 1, 0),
                             parent_pose=(0, 0, -0.2, 0, 0, 0, 1))]  # fmt: skip
    link = dict(capsule=((0, 0, 0), (0, 0, -0.2), 0.04))
    pairs = [spo.Contact(i, **link, other=spo.Contact(j, **link), stiffness=1e5, friction=0.5)
             for i in (1, 2) for j in (3, 4)]  # fmt: skip
    away = [spo.Contact(0, point=(0, 0, 100.0))]
    return spo.Scene(bodies, hinges, contacts=pairs if contacts else away, gravity=(0, 0, 0))


def largest_rise(scene, q, qd, device):
    """Return the largest rise of energy in a step, over that at first, and in how many worlds bodies have met."""
    worlds, k = len(q), scene.values["contact_stiffness"][0, len(scene.contact_points) :]
    dyn, found, met = spo.Dynamics(scene, worlds, device=device, dtype="float64"), [], np.zeros(worlds, bool)
    gap, energy = np.zeros((worlds, scene.contact_count)), dyn.kinetic_energy(q, qd)
    force = np.zeros((*gap.shape, 3))
    for _ in range(120):
        q, qd = dyn.step(q, qd, None, H, contact_gap=gap, contact_f=force)
        depth = np.maximum(-gap[:, len(scene.contact_points) :], 0.0)  # before the step
        found.append(energy + 0.5 * depth**2 @ k)
        energy, met = dyn.kinetic_energy(q, qd), met | force.any(axis=(1, 2))
    return (np.diff(found, axis=0) / found[0]).max(), met.sum()


@pytest.mark.slow
def test_legs_that_cross_gain_no_more_than_free_ones(device):
    rng, worlds, scene = np.random.default_rng(0), 40, legs()
    q, qd = np.tile(scene.neutral_q, (worlds, 1)), 0.3 * rng.normal(size=(worlds, scene.dof_count))
    qd[:, 6], qd[:, 10] = -rng.uniform(1, 4, worlds), rng.uniform(1, 4, worlds)
    qd[:, [7, 9, 11, 13]] = rng.normal(size=(worlds, 4))
    (rise, met), (without, _) = (largest_rise(each, q, qd, device) for each in (scene, legs(contacts=False)))
    assert met > 30 and rise < without < 5e-4  # 3e-5 and 1.3e-4


def held(device, drives, force=grasp.FORCE):
    """Let a Panda lift a cube; return its slip in the last 5 s [m], how high it is, and all status words."""
    dyn = spo.Dynamics(grasp.scene(drives), 1, device=device, dtype="float64")
    heights, points, q = grasp.path(dyn, 7.0)
    qd, tau, target = np.zeros((1, dyn.scene.dof_count)), np.zeros((1, dyn.scene.dof_count)), q.copy()
    tau[:, 7:9], target[:, 7:9] = 0.0 if drives else -force, 0.0
    apart, status, words, cube_ = [], np.zeros(1, np.int32), set(), dyn.scene.body_count - 1
    for i in range(round(7.0 / H)):
        target[0, :7] = [np.interp(np.clip(i * H - 0.5, 0.0, 1.0), heights, points[:, j]) for j in range(7)]
        q, qd = dyn.step(q, qd, tau, H, target_q=target, status=status)
        words.add(int(status[0]))
        if i * H >= 2.0:
            apart.append(np.subtract(*dyn.frame_poses(q, [cube_, grasp.TIP])[0, :, :3]))
    return np.linalg.norm(np.ptp(apart, axis=0)), q[0, -5], words


@pytest.mark.slow
@pytest.mark.parametrize("drives", [False, True])
def test_a_gripper_holds_a_cube(device, drives):
    """0.5 kg, 40 N, friction 0.8, for 5 s: creep of 0.08 mm/s; fingers pressed by a force, and by saturated drives."""
    slip, height, words = held(device, drives)
    assert slip < 1e-3 and height > 0.15 and words == {spo.Status.OK}


FIND = "counts[pair] = find(pair, places, touches);"
BUGS = {
    "adhesion": (coupling_points, "touch.depth - h * normal > 0;", "true;"),
    "opens at last": (coupling_points, "(closing && closed) || ", ""),
    "no friction": (couples, "sides.add(a, touch.at);", ""),
    "no lever of friction": (couples, "skew[3 * i + j - 3]", "0"),
    "no lever of springs": (couples, "add_cross(load, push + 1, normal);", ""),
    "a pair of two is forgotten": (couples, FIND, FIND.replace("= find", "= e > first_pair_of(p) ? 0 : find")),
    "dampers before the step are forgotten": (couples, "FUSED(-K[e], start[(j + 3) % 6], load[i])", "load[i]"),
    "unequal forces": (coupled.CoupledStep._columns, "(1.0, -1.0)", "(1.0, -0.9)"),
    "no other dof": (aggregates.Node._system, "if other <= at:", "if other == at:"),
    "the base has no part": (aggregates.Node.close, "P.less(U[at], G[-1])", "P"),
    "the base stands still": (aggregates.Node.open, "x - dot(self.G[-1 - at], alpha) if self.G else x", "x"),
}
BUGS_OF_LIMBS = {
    "unequal forces": (coupling_shared, "side ? -at(s, from", "side ? (REAL)(-0.9) * at(s, from"),
    "no lever": (coupling_shared, "add_cross(f + 3, arm, f);", ""),
    "no other pair": (coupling_blocks, "limb_of(a) != limb_of(b)", "p != q"),
    "no friction": (coupling_points, "K[r * (r + 1) / 2 + r] += a;", ""),
    "a pair of two is forgotten": (coupling_shared, "if (touch.missing()) break;", "if (a > first_pair_of(p)) break;"),
    "the base has no part": (coupling_blocks, "at(s, AT_BASE + i) = h * inertia[i]", "at(s, AT_BASE + i) = 0"),
    "the base stands still": (coupling_blocks, "alpha[j] = h * at(s, ALPHA + j)", "alpha[j] = 0"),
}


def plant(monkeypatch, place, old, new):
    """Put a bug into native code, or into the text of a method."""
    if inspect.ismodule(place):
        assert place.NATIVE.count(old) == 1
        monkeypatch.setattr(place, "NATIVE", place.NATIVE.replace(old, new))
        return
    text, names = textwrap.dedent(inspect.getsource(place)), dict(place.__globals__)
    assert text.count(old) == 1
    exec(text.replace(old, new), names)
    owner = getattr(inspect.getmodule(place), place.__qualname__.split(".")[0])
    monkeypatch.setattr(owner, place.__name__, names[place.__name__])


TELLING = [0, 1, 20, 71, 112, 194]
"""Throws in which points open and close between passes: found as those whose step a planted bug changes."""


def test_a_cube_that_is_thrown_at_another(device, granularity=None):
    scene, q, qd = thrown(TELLING)
    dyn = spo.Dynamics(scene, len(q), device=device, dtype="float64", granularity=granularity)
    assert_is_dense(dyn, q, qd, 3)


@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS)
def test_a_planted_bug_is_seen(monkeypatch, device, bug):
    plant(monkeypatch, *BUGS[bug])
    with pytest.raises(AssertionError):
        test_a_cube_that_is_thrown_at_another(device, "tree")
        test_a_hand_is_the_dense_one(device, "tree")


@pytest.mark.slow
@pytest.mark.parametrize("bug", BUGS_OF_LIMBS)
def test_a_bug_of_limbs_is_seen(monkeypatch, device, bug):
    plant(monkeypatch, *BUGS_OF_LIMBS[bug])
    with pytest.raises(AssertionError):
        test_a_cube_that_is_thrown_at_another(device, "segment")
        test_a_hand_is_the_dense_one("cpu", "segment")  # a GPU has no room for its limbs in float64


STICK = dict(capsule=((0, 0, 0), (0, 0, 1), 0.1))
MISTAKES = {
    "itself": (lambda: [box(0, 0.1, other=box(0, 0.1))], ValueError, "of body 0 with itself"),
    "nobody": (lambda: [box(0, 0.1, other=box(3, 0.1))], ValueError, "with body 3; expected one of 2"),
    "no shape": (lambda: [box(0, 0.1, other=1)], ValueError, "has 0 contacts with the ground"),
    "nested": (lambda: [box(0, 0.1, other=box(1, 0.1, other=0))], ValueError, "an other= itself"),
    "kind": (lambda: [box(0, 0.1, other="cube")], TypeError, "other is 'cube'; expected a Contact"),
    "capsule": (lambda: [box(0, 0.1, other=spo.Contact(1, **STICK))], spo.UnsupportedError, "a capsule with a box"),
    "hull": (lambda: [spo.Contact(0, hull=np.eye(3), other=box(1, 0.1))], spo.UnsupportedError, "a hull in contact"),
    "dissipation": (lambda: [box(0, 0.1, other=box(1, 0.1), dissipation=1.0)], spo.UnsupportedError, "dissipation="),
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_mistakes_have_names(mistake):
    make, kind, message = MISTAKES[mistake]
    with pytest.raises(kind, match=message):
        free([cube(1.0, 0.1)] * 2, make())


def test_the_plan_takes_the_form_that_was_faster():
    """A thread a world for arms and for many worlds, limbs for cubes that are alike; see the measured facts."""
    forms = {}
    for name, scene in (("arm", grasp.scene()), ("stack", stack())):
        for worlds in (4096, 65536):
            chosen = plan.choose(scene, worlds, MEASURED, "float32")
            forms[name, worlds] = [chosen.of(routine) for routine in (PAIRED_STEP, CONTACT_STEP)]
    assert forms["arm", 4096] == forms["arm", 65536] == ["tree", "tree"]
    arm = grasp.scene()
    held = plan.choose(arm, 256, MEASURED, "float32")
    assert held.granularity == "tree" and "most of its links are on one path" in held.reason
    assert plan.choose(stack(), 256, MEASURED, "float32").granularity == "segment"
    assert forms["stack", 4096] == ["segment", "segment"] and forms["stack", 65536] == ["tree", "segment"]


def test_couples_have_warps_of_their_own_where_worlds_are_few(monkeypatch):
    """All warps of a block come to the same barriers, and only the first one stores."""
    monkeypatch.setattr("warp_spo.dynamics.dynamics.read_facts", lambda device: MEASURED)
    texts, scene = warp_machine.recorded(monkeypatch), hand()
    for worlds in (40, 1 << 17):
        sizes = dict(q=scene.coord_count, qd=scene.dof_count, tau=scene.dof_count)
        shapes = {name: (worlds, size) for name, size in sizes.items()} | dict(dt=(), passes=())
        dyn = spo.Dynamics(scene, worlds, "cpu", "float32", granularity="tree")
        dyn.programs.find(PAIRED_STEP, shapes, shapes["qd"], {"q_out": shapes["q"]})
    few, many = texts
    assert (few.frame.warps, few.frame.block, many.frame.warps) == (4, 128, 1) and many.cpu == many.cuda
    own, _, others = few.cuda.split("if (warp == 0) {")[1].rpartition("} else {")
    seen = r"bar.sync|couples::judge\(couples::FIRST|couples::judge\(turn|for \(int turn"
    first, later = (["bar.sync", f"couples::judge({stage}", "bar.sync"] for stage in ("couples::FIRST", "turn"))
    assert re.findall(seen, own)[-7:] == re.findall(seen, others) == [*first, "for (int turn", *later]
    assert "result_row" in own and "result_row" not in others


def test_calls_without_a_kernel_have_names(device):
    scene = stack((1.0, 1.0))
    q, qd = scene.neutral_q[None].astype(np.float32), np.zeros((1, 12), np.float32)
    many, states, rates = row(11)
    with pytest.raises(spo.UnsupportedError, match="granularity='segment' where pairs of bodies are not all on limbs"):
        spo.Dynamics(many, 2, device=device, granularity="segment").step(
            *np.float32([states]), *np.float32([rates]), None, H
        )
    still = spo.Contact(2, sphere=0.1, other=spo.Contact(-1, sphere=0.1))  # neither of the two can move
    fixed = shelf(2).with_contacts([*shelf(2).contacts, still])
    assert pair_pieces.by_limbs(shelf(2)) and not pair_pieces.by_limbs(fixed)
    with pytest.raises(spo.UnsupportedError, match="granularity='segment' where pairs of bodies are not all on limbs"):
        at = np.float32(shelf_states(0, 2)[0])
        spo.Dynamics(fixed, 2, device=device, granularity="segment").step(at, np.zeros_like(at[:, 2:]), None, H)
    alone = spo.Dynamics(scene.with_contacts(scene.contacts[:1]), device=device)
    with pytest.raises(ValueError, match="contact_residual is given, and no bodies of the scene touch each other"):
        alone.step(q, qd, None, H, contact_residual=np.zeros(1, np.float32))
    assert "1 pairs of bodies" in spo.Dynamics(scene, device=device).explain()
    torch = pytest.importorskip("torch")
    with pytest.raises(ValueError, match="contact between bodies"):
        spo.Dynamics(scene, device="cpu").step(torch.tensor(q, requires_grad=True), torch.tensor(qd), None, H)
